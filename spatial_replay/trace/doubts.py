"""Assumptions about how a log is read that the log itself contradicts."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import pi
from typing import Any, Final

from spatial_replay.text import Sentence, counted_from

MANY_TURNS: Final = 8 * pi
"""Angles in radians beyond four turns are taken for degrees."""

SHORTEST_PERIOD_NS: Final = 200_000
"""No robot is recorded at a higher rate: shorter intervals are times in another unit."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """A contradiction between a log and an assumption by which it was read.

    Attributes:
        assumption: its name, as `accept` in a mapping takes it.
        topic: the topic whose messages contradict it; "" for a log without topics.
        text: the measurement, and the key that settles it; it begins with the topic.
        objects, signals: names whose values rest on the assumption.
        is_accepted: whether the mapping accepts it, so that verdicts are not doubtful.
    """

    assumption: str
    topic: str
    text: Sentence
    objects: frozenset[str] = frozenset()
    signals: frozenset[str] = frozenset()
    is_accepted: bool = False

    def remark(self, log: str) -> Sentence:
        """Return the remark on a log that this doubt is about."""
        if self.is_accepted:
            return Sentence(f"{log}: accepted: ", self.text)
        remedy = f"`accept: [{self.assumption}]` in the mapping" if self.topic else "`--allow doubtful`"
        return Sentence(f"{log}: doubtful: ", self.text, f"; if the log is right, {remedy}")

    @property
    def title(self) -> str:
        """Its assumption and topic, as certificates list them."""
        return " ".join(filter(None, (self.assumption, self.topic, "(accepted)" * self.is_accepted)))


def metadata_from_doubts(doubts: Iterable[Doubt]) -> dict[str, str]:
    """Return doubts as a metadata record of a log: by title, each as JSON."""
    return {doubt.title: json.dumps(json_doubt(doubt), ensure_ascii=False) for doubt in doubts}


def json_doubt(doubt: Doubt) -> dict[str, Any]:
    """Return a doubt as JSON."""
    return {
        "assumption": doubt.assumption,
        "topic": doubt.topic,
        "text": str(doubt.text),
        "objects": sorted(doubt.objects),
        "signals": sorted(doubt.signals),
        "accepted": doubt.is_accepted,
    }


def doubts_from_metadata(record: Mapping[str, str]) -> Iterator[Doubt]:
    """Yield the doubts of a metadata record; entries that nothing of ours wrote are left out."""
    for text in record.values():
        try:
            entry = json.loads(text)
            yield Doubt(
                str(entry["assumption"]),
                str(entry["topic"]),
                Sentence(str(entry["text"])),
                frozenset(map(str, entry["objects"])),
                frozenset(map(str, entry["signals"])),
                entry["accepted"] is True,
            )
        except (ValueError, TypeError, KeyError, RecursionError):
            continue


def distinct_doubts(doubts: Iterable[Doubt], first_ns: int) -> tuple[Doubt, ...]:
    """Return each doubt once; its times count from `first_ns`, where it knows them."""
    return tuple(
        replace(doubt, text=counted_from([doubt.text], first_ns)[0]) for doubt in dict.fromkeys(doubts)
    )

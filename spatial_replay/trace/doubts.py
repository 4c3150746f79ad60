"""Doubts: contradictions between a log and the assumptions by which it is read."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import pi
from typing import Any, Final

from spatial_replay.text import Sentence, counted_from

MANY_TURNS: Final = 8 * pi
"""Largest plausible angle, radians: four turns. Larger angles are probably degrees."""

SHORTEST_PERIOD_NS: Final = 200_000
"""Shortest plausible period of a recording, ns; shorter periods are times in another unit."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """A contradiction between a log and an assumption by which it was read.

    Attributes:
        assumption: name of the assumption, as in `accept` of a mapping.
        topic: topic whose messages contradict the assumption; "" for a log without topics.
        text: sentence with the topic, the measurement, and the mapping key that settles the doubt.
        objects, signals: names whose values depend on the assumption.
        is_accepted: whether the mapping accepts the doubt. An accepted doubt makes no verdict doubtful.
    """

    assumption: str
    topic: str
    text: Sentence
    objects: frozenset[str] = frozenset()
    signals: frozenset[str] = frozenset()
    is_accepted: bool = False

    def remark(self, log: str) -> Sentence:
        """Return the remark with this doubt about the log named `log`."""
        if self.is_accepted:
            return Sentence(f"{log}: accepted: ", self.text)
        remedy = f"`accept: [{self.assumption}]` in the mapping" if self.topic else "`--allow doubtful`"
        return Sentence(f"{log}: doubtful: ", self.text, f"; if the log is right, {remedy}")

    @property
    def title(self) -> str:
        """The assumption and the topic, as in certificates."""
        return " ".join(filter(None, (self.assumption, self.topic, "(accepted)" * self.is_accepted)))


def metadata_from_doubts(doubts: Iterable[Doubt]) -> dict[str, str]:
    """Return doubts as a metadata record of a log: JSON texts by title."""
    return {doubt.title: json.dumps(json_doubt(doubt), ensure_ascii=False) for doubt in doubts}


def json_doubt(doubt: Doubt) -> dict[str, Any]:
    return {
        "assumption": doubt.assumption,
        "topic": doubt.topic,
        "text": str(doubt.text),
        "objects": sorted(doubt.objects),
        "signals": sorted(doubt.signals),
        "accepted": doubt.is_accepted,
    }


def doubts_from_metadata(record: Mapping[str, str]) -> Iterator[Doubt]:
    """Yield the doubts of a metadata record; entries in other formats are skipped."""
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
    """Return each doubt once, with the times in its text relative to `first_ns`."""
    return tuple(
        replace(doubt, text=counted_from([doubt.text], first_ns)[0]) for doubt in dict.fromkeys(doubts)
    )

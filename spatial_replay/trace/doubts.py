"""Assumptions about how a log is read that the log itself contradicts."""

from __future__ import annotations

from dataclasses import dataclass

from spatial_replay.text import Sentence


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

"""A mapping compared with the topics of a log: what has to be read, and how."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from spatial_replay.logs.foreign.messages import Topic
from spatial_replay.logs.mapping.model import Mapping


@dataclass(frozen=True, slots=True)
class Plan:
    """A mapping that fits a log.

    Attributes:
        topics: every topic to read: those mapped, and those with transforms where frames are needed.
        by_log_time: whether times of samples are log times; if not, which messages make the samples of a
            window is only known when they have been decoded.
        margin_ns: how far beyond the end of a window messages still count.
    """

    mapping: Mapping
    topics: tuple[str, ...]
    by_log_time: bool
    margin_ns: int

    @classmethod
    def of(cls, mapping: Mapping, topics: Sequence[Topic]) -> Plan:
        """
        Raises:
            UsageError: the mapping does not fit the topics; all faults are listed.
        """
        raise NotImplementedError

    def lookback_ns(self, topic: str) -> int | None:
        """How long before a window messages of a topic count; None for all of them, such as static ones."""
        raise NotImplementedError

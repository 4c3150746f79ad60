"""Which samples of a log are evaluated."""

from __future__ import annotations

from dataclasses import dataclass

from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.reading import read_blocks
from spatial_replay.logs.source import Source
from spatial_replay.trace.times import FOREVER


@dataclass(frozen=True, slots=True)
class Window:
    """Which samples are evaluated: from `start_ns` to before `end_ns`, of every `every`th of the log."""

    start_ns: int = 0
    end_ns: int = FOREVER
    every: int = 1

    def __post_init__(self) -> None:
        if self.every < 1:
            raise UsageError(f"every is {self.every}; give 1 or more: 2 keeps every second sample")
        if self.end_ns <= self.start_ns:
            raise UsageError(f"the window from {self.start_ns} ns to {self.end_ns} ns is empty")

    @property
    def is_whole(self) -> bool:
        return self == Window()


def first_sample_ns(source: Source) -> int:
    """The time of a log's first sample.

    Raises:
        LogError: it has none.
    """
    for block in read_blocks(source):
        if len(block.trace):
            return int(block.trace.times_ns[0])
    raise LogError(f"{source.name} has no sample")


def has_samples_from(source: Source, time_ns: int) -> bool:
    """Whether a log goes on at or after a time."""
    return any(len(block.trace) for block in read_blocks(source, time_ns))

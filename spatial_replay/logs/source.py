"""Sources: where samples come from, chosen by what a file holds.

Sources as they are read: how, and what is said when that fails.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from spatial_replay.errors import LogError
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.messages import BLOCK_SAMPLES, Attachment, Block
from spatial_replay.logs.read_options import FaultList
from spatial_replay.trace.sample import FOREVER, Sample
from spatial_replay.trace.trace import Trace, window_of


class Source(Protocol):
    """A log that can be read, any number of times, in blocks of bounded size."""

    @property
    def name(self) -> str:
        """What the log is called: a file's base name."""

    @property
    def kind(self) -> str:
        """The format, in a word."""

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """The samples from the first at or after `start_ns` to the last before `end_ns`.

        What could not be read stands in the blocks' `trace.faults`; the last block may hold nothing else.

        Raises:
            LogError: nothing in the log can be read as a sample.
            UsageError: a sound log of something else, without any topic for samples.
        """

    def attachments(self) -> tuple[Attachment, ...]:
        """The files kept in the log."""

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """The metadata records of the log, with their names."""


class _Bare:
    """A source that keeps nothing beside its samples."""

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`."""
        return ()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        return ()


@dataclass(frozen=True)
class MemorySource(_Bare):
    """A trace, or samples, that are in memory already."""

    trace: Trace
    name: str = "memory"
    kind: str = "memory"

    @classmethod
    def from_samples(cls, samples: Iterable[Sample], name: str = "memory") -> MemorySource:
        return cls(Trace.from_samples(samples), name)

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        window = within(self.trace, start_ns, end_ns)
        if len(window) <= BLOCK_SAMPLES:
            yield Block(window)
            return
        for begin in range(0, len(window), BLOCK_SAMPLES):
            block = window.slice(begin, begin + BLOCK_SAMPLES)
            yield Block(block if begin == 0 else replace(block, faults=()))


IterTraces = Callable[..., Iterator[Trace]]


@dataclass(frozen=True)
class TrackSource(_Bare):
    """A track file.

    Attributes:
        options: how it is read where that is not the default.
    """

    path: Path
    kind: str
    concave: Concave
    iter_traces: IterTraces
    options: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def name(self) -> str:
        return self.path.name

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        faults = FaultList()
        any_sample = False
        first_fault: str | None = None
        for trace in self.iter_traces(self.path, faults, concave=self.concave):
            any_sample = any_sample or len(trace) > 0
            lost = faults.take()
            first_fault = first_fault or next(iter(lost), None)
            yield Block(replace(within(trace, start_ns, end_ns), faults=lost))
        rest = faults.take(last=True)
        if not any_sample:
            reason = first_fault or next(iter(rest), f"{self.name} is empty")
            raise LogError(f"{self.name} holds no sample: {reason}")
        if rest:
            yield Block(replace(Trace.from_samples(()), faults=rest))


def within(trace: Trace, start_ns: int | None, end_ns: int | None) -> Trace:
    """The samples of a trace from `start_ns` up to, not including, `end_ns`."""
    begin, end = window_of(trace.times_ns, start_ns or 0, FOREVER if end_ns is None else end_ns)
    return trace if (begin, end) == (0, len(trace)) else trace.slice(begin, end)


def read_blocks(
    source: Source, start_ns: int | None = None, end_ns: int | None = None
) -> Generator[Block, None, None]:
    """The blocks of a source, as `Source.iter_blocks` gives them.

    Raises:
        LogError: what that raises, and when the machine cannot read the source: a disk that fails or is gone.
    """
    try:
        yield from source.iter_blocks(start_ns, end_ns)
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{source.name} could not be read: {reason}; copy it to another disk") from error


def read_ahead(blocks: Generator[Block, None, None]) -> Iterator[Block]:
    """The same blocks, each read on a thread of its own while the one before is worked on.

    Most of reading leaves the interpreter to others, so that on two cores it costs a replay little time.
    """
    with ThreadPoolExecutor(1, "reading") as thread:
        try:
            waiting = thread.submit(next, blocks, None)
            while (block := waiting.result()) is not None:
                waiting = thread.submit(next, blocks, None)
                yield block
        finally:
            # by the thread that read them, which alone may close a database; after an interruption while that
            # began, and when the interpreter ends, by whoever drops them last
            with suppress(ValueError, RuntimeError):
                thread.submit(blocks.close).result()


def reading_options(source: Source) -> dict[str, object]:
    """How a source is read, where that is not the default, as a log's metadata says it."""
    concave = getattr(source, "concave", "decompose")
    return dict(getattr(source, "options", {})) | ({} if concave == "decompose" else {"concave": concave})

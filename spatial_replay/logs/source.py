"""Sources of samples: a log, a track file, or a trace in memory, read in blocks of bounded size."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, TypeVar, cast

from spatial_replay.errors import LogError
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.messages import BLOCK_SAMPLES, Attachment, Block, noting_pauses
from spatial_replay.logs.read_options import FaultList, gap_ns
from spatial_replay.text import encodable
from spatial_replay.trace.trace import Sample, Trace, within
from spatial_replay.trace.units import OUR_AXES, Axes

_Read = TypeVar("_Read")


class Source(Protocol):
    """A log that can be read, any number of times, in blocks of bounded size."""

    @property
    def name(self) -> str:
        """The base name of its file."""

    @property
    def kind(self) -> str:
        """The format, in a word."""

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """Return the samples from the first at or after `start_ns` to the last before `end_ns`.

        Unreadable parts are in `trace.faults` of the blocks; the last block may hold nothing else.

        Raises:
            LogError: nothing in the log can be read as a sample.
            UsageError: a log without damage that has no topic for samples.
        """

    def attachments(self) -> tuple[Attachment, ...]:
        """Return the attachments of the log."""

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """Return the metadata records of the log, with their names."""


class _Bare:
    """A source of samples only."""

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`."""
        return ()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        return ()


@dataclass(frozen=True)
class MemorySource(_Bare):
    """A trace, or samples, in memory."""

    trace: Trace
    name: str = "memory"
    kind: str = "memory"

    @property
    def axes(self) -> Axes:
        """Ours, with the units that the trace declares."""
        return Axes.of_units(self.trace.units)

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
        options: those with which it is read, where they are not the defaults.
        axes: those of the file; samples have ours.
    """

    path: Path
    kind: str
    concave: Concave
    iter_traces: IterTraces
    options: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    axes: Axes = OUR_AXES

    @property
    def name(self) -> str:
        return encodable(self.path.name)

    @property
    def max_gap_ns(self) -> int | None:
        return gap_ns(cast("str | None", self.options.get("max_gap")))

    @noting_pauses
    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        faults = FaultList()
        any_sample = False
        first_fault: str | None = None
        for trace in self.iter_traces(self.path, faults, concave=self.concave):
            any_sample = any_sample or len(trace) > 0
            lost = faults.take()
            first_fault = first_fault or next(iter(lost), None)
            window = self.axes.convert_trace(within(trace, start_ns, end_ns))
            yield Block(replace(window, faults=lost))
        rest = faults.take(last=True)
        if not any_sample:
            reason = first_fault or next(iter(rest), f"{self.name} is empty")
            raise LogError(f"{self.name} holds no sample: {reason}")
        if rest:
            yield Block(replace(Trace.from_samples(()), faults=rest))


@dataclass(frozen=True)
class SourceOf:
    """Attributes that a derived source takes from its original: everything but its blocks."""

    source: Source

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def kind(self) -> str:
        return self.source.kind

    @property
    def axes(self) -> Axes:
        return axes_of(self.source)

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`."""
        return self.source.attachments()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        return self.source.metadata()


def read_blocks(
    source: Source, start_ns: int | None = None, end_ns: int | None = None
) -> Generator[Block, None, None]:
    """Yield the blocks of a source, as `Source.iter_blocks` does.

    Raises:
        LogError: what that raises, and if the disk fails or is gone.
    """
    try:
        yield from source.iter_blocks(start_ns, end_ns)
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{source.name} could not be read: {reason}; copy it to another disk") from error


def read_ahead(blocks: Generator[_Read, None, None]) -> Iterator[_Read]:
    """Yield the same blocks, each read while the previous one is processed."""
    thread = ThreadPoolExecutor(1, "reading-ahead")
    try:
        waiting = thread.submit(next, blocks, None)
        while (block := waiting.result()) is not None:
            waiting = thread.submit(next, blocks, None)
            yield block
    finally:
        # garbage collection may end this within the start of any thread, which must not wait for another one
        thread.shutdown(wait=False, cancel_futures=True)


def reading_only(source: Source, keep: tuple[str, ...] = ()) -> Source:
    """Return a source that reads its samples and, beside them, only messages of some topics.

    Args:
        keep: as `is_kept` takes them.
    """
    return cast(Source, replace(cast(Any, source), keep=keep)) if hasattr(source, "keep") else source


def axes_of(source: Source) -> Axes:
    """Return the axes of a source, or of what a log was recorded from; its samples have ours."""
    axes = getattr(source, "axes", None)
    return axes if isinstance(axes, Axes) else OUR_AXES


def reading_options(source: Source) -> dict[str, object]:
    """Return the options of a source that are not the defaults, for a log's metadata."""
    concave = getattr(source, "concave", "decompose")
    return dict(getattr(source, "options", {})) | ({} if concave == "decompose" else {"concave": concave})

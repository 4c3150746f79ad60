"""Sources: logs that can be read, any number of times, in blocks of bounded size."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from functools import wraps
from itertools import repeat
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.logs.messages import Attachment, Block
from spatial_replay.logs.read_options import DEFAULTS, FaultList, ReadOptions, gap_ns
from spatial_replay.logs.remote import LogFile, each_ahead
from spatial_replay.text import Sentence, encodable
from spatial_replay.trace.trace import Pauses, ReportsBack, Sample, Trace, within
from spatial_replay.trace.track_evidence import TrackEvidence
from spatial_replay.trace.units import OUR_AXES, Axes

BLOCK_SAMPLES = 12_288
"""Maximum number of samples of a block; the limit bounds memory for logs of any length."""


SAMPLES_A_GAP: Final = 10
"""Number of samples that are inserted for each `max_gap_ns` of a gap."""
_MOST_IN_GAP = 10_000
"""Approximate maximum number of samples that are inserted in one gap."""

IterBlocks = Callable[..., Iterator[Block]]


def noting_pauses(iter_blocks: IterBlocks) -> IterBlocks:
    """Decorate `iter_blocks`: fill pauses beyond `max_gap_ns`, remark on pauses and on steps back in time."""

    @wraps(iter_blocks)
    def wrapper(self: Any, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        pauses, reports = Pauses(), ReportsBack()
        sample: Trace | None = None
        for block in iter_blocks(self, start_ns, end_ns):
            trace = block.trace
            pauses.add(trace.times_ns, trace.is_unknown)
            reports.add(trace)
            if self.max_gap_ns is not None and len(trace):
                block = replace(block, trace=_without_gaps(sample or Trace.empty(), trace, self.max_gap_ns))
                sample = trace.slice(len(trace) - 1, len(trace))
            yield block
        pause_remark = pauses.remark("samples", self.max_gap_ns)
        remarks = [*([] if pause_remark is None else [pause_remark]), *reports.remarks()]
        if remarks:
            sentences = tuple(Sentence(f"{self.name}: ", remark) for remark in remarks)
            yield Block(Trace.empty(), remarks=sentences)

    return wrapper


def _without_gaps(before: Trace, trace: Trace, max_gap_ns: int) -> Trace:
    """Fill gaps between samples with samples in which every object and signal is unknown.

    Args:
        before: the last sample before `trace`; empty at the beginning of the log.
    """
    times_ns = np.concatenate([before.times_ns, trace.times_ns])
    gap_indices = np.flatnonzero(np.diff(times_ns) > max_gap_ns).tolist()
    traces, filled_to = [], 0
    for gap_index in gap_indices:
        next_index = gap_index + 1 - len(before)
        sample = trace.slice(next_index - 1, next_index) if next_index else before
        first_ns, next_ns = times_ns[gap_index : gap_index + 2].tolist()
        step_ns = max(max_gap_ns // SAMPLES_A_GAP, (next_ns - first_ns) // _MOST_IN_GAP, 1)
        # also 1 ns from both neighbours, so that objects are unknown in the whole gap
        fill_ns = np.union1d(np.arange(first_ns + step_ns, next_ns, step_ns), [first_ns + 1, next_ns - 1])
        unknown_rows = np.repeat(
            np.where(sample.rows >= 0, -2 - sample.rows, sample.rows), len(fill_ns), axis=0
        )
        signals = {name: np.full(len(fill_ns), np.nan) for name in sample.signals}
        unknown_samples = replace(
            sample,
            times_ns=fill_ns,
            rows=unknown_rows,
            signals=signals,
            reported_ns=None,
            signals_reported_ns={},
            faults=(),
            remarks=(),
        )
        traces += [trace.slice(filled_to, next_index), unknown_samples]
        filled_to = next_index
    return Trace.concatenate([*traces, trace.slice(filled_to, len(trace))]) if gap_indices else trace


_Read = TypeVar("_Read")


class Source:
    """A log that can be read, any number of times, in blocks of bounded size."""

    path: LogFile | None = None

    @property
    def name(self) -> str:
        """Base name of the log's file."""
        raise NotImplementedError

    @property
    def kind(self) -> str:
        """Name of the format."""
        raise NotImplementedError

    @property
    def axes(self) -> Axes:
        """Axes of the source; for our logs, axes of the recorded source. Samples use `OUR_AXES`."""
        return OUR_AXES

    @property
    def options(self) -> Mapping[str, object]:
        """Read options that differ from the defaults, for the metadata of a log."""
        return {}

    @property
    def max_gap_ns(self) -> int | None:
        """Longest pause; objects and signals are unknown in longer pauses. None for no limit."""
        return None

    @property
    def begin_ns(self) -> int | None:
        """A close lower bound of the first sample's time; None if only reading the samples shows the time."""
        return None

    def keeping(self, keep: tuple[str, ...] = ()) -> Source:
        """Return this source with its samples, and with other messages only on topics to keep.

        Args:
            keep: topic patterns, see `is_kept`.
        """
        return self

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """Iterate over the samples with times in [start_ns, end_ns).

        Unreadable parts are in `trace.faults` of the blocks; the last block may hold faults only.

        Raises:
            LogError: the log has no readable sample.
            UsageError: the log is undamaged, but has no topic of samples.
        """
        raise NotImplementedError

    def attachments(self) -> tuple[Attachment, ...]:
        """Return the attachments of the log."""
        return ()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """Return the metadata records of the log, with their names."""
        return ()


@dataclass(frozen=True)
class MemorySource(Source):
    """A trace, or samples, in memory."""

    trace: Trace
    name: str = "memory"
    kind: str = "memory"

    @property
    def axes(self) -> Axes:
        """Axes of our samples, `OUR_AXES`, with the units of the trace."""
        return Axes.of_units(self.trace.units)

    @classmethod
    def from_samples(cls, samples: Iterable[Sample], name: str = "memory") -> MemorySource:
        return cls(Trace.from_samples(samples), name)

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        window = within(self.trace, start_ns, end_ns)
        if len(window) <= BLOCK_SAMPLES:
            yield Block(window, doubts=window.doubts)
            return
        for begin in range(0, len(window), BLOCK_SAMPLES):
            block = window.slice(begin, begin + BLOCK_SAMPLES)
            yield Block(block if begin == 0 else replace(block, faults=()), doubts=block.doubts)


@dataclass(frozen=True)
class FileSource(Source):
    """The file of a log, with the options for reading it."""

    path: LogFile
    kind: str = ""
    reading: ReadOptions = DEFAULTS

    @property
    def name(self) -> str:
        return encodable(self.path.name or Path(self.path).absolute().name)

    @property
    def options(self) -> Mapping[str, object]:
        """See `Source.options`."""
        concave = self.reading.concave
        return {**self._given, **({} if concave == "decompose" else {"concave": concave})}

    @property
    def _given(self) -> Mapping[str, object]:
        return self.reading.non_defaults()

    @property
    def max_gap_ns(self) -> int | None:
        """See `Source.max_gap_ns`."""
        return gap_ns(self.reading.max_gap)


IterTraces = Callable[..., Iterator[Trace]]


@dataclass(frozen=True)
class TrackSource(FileSource):
    """A track file.

    Attributes:
        axes: axes of the file; samples use `OUR_AXES`.
    """

    _: KW_ONLY
    iter_traces: IterTraces
    axes: Axes = OUR_AXES

    @noting_pauses
    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        faults = FaultList()
        has_sample = False
        first_fault: str | None = None
        evidence = TrackEvidence()
        for trace in self.iter_traces(self.path, faults, concave=self.reading.concave):
            has_sample = has_sample or len(trace) > 0
            new_faults = faults.take()
            first_fault = first_fault or next(iter(new_faults), None)
            window = self.axes.convert_trace(within(trace, start_ns, end_ns))
            evidence.add(trace)
            yield Block(replace(window, faults=new_faults))
        if doubts := tuple(evidence.doubts()):
            yield Block(Trace.empty(), doubts=doubts)
        last_faults = faults.take(last=True)
        if not has_sample:
            reason = first_fault or next(iter(last_faults), f"{self.name} is empty")
            raise LogError(f"{self.name} holds no sample: {reason}")
        if last_faults:
            yield Block(replace(Trace.from_samples(()), faults=last_faults))


@dataclass(frozen=True)
class SourceOf(Source):
    """A source derived from another source, with the same attributes and attachments, but other blocks."""

    source: Source

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def kind(self) -> str:
        return self.source.kind

    @property
    def axes(self) -> Axes:
        return self.source.axes

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
        LogError: an error of `Source.iter_blocks`, or of the disk.
    """
    try:
        yield from source.iter_blocks(start_ns, end_ns)
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{source.name} could not be read: {reason}; copy it to another disk") from error


def read_ahead(blocks: Generator[_Read, None, None]) -> Iterator[_Read]:
    """Yield the blocks unchanged. From the third block on, a thread reads the next block in advance.

    A short log has one or two blocks, which are read in less time than a thread needs to start.
    """
    for _ in range(2):
        early_block = next(blocks, None)
        if early_block is None:
            return
        yield early_block
    for block in each_ahead(lambda _: next(blocks, None), repeat(None)):
        if block is None:
            return
        yield block

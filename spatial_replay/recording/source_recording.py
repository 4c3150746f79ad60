"""Recordings of a source, such as a bag: a log of its samples and verdicts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import BinaryIO

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.errors import LogError, OutputError, UsageError
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.output_file import Durability, open_output, refuse_inputs
from spatial_replay.logs.source import Source, read_blocks
from spatial_replay.logs.topics import DOUBTS
from spatial_replay.recording.interruption import leaving, uninterrupted
from spatial_replay.recording.log import Recording, RunEnd, refuse_templates
from spatial_replay.spec import check_names
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.formula import Specification
from spatial_replay.text import counted_from
from spatial_replay.trace.doubts import Doubt, distinct_doubts, metadata_from_doubts
from spatial_replay.trace.trace import Trace, checked_units


@dataclass(frozen=True, slots=True)
class Recorded:
    """The result of a recording.

    Attributes:
        samples: number of samples.
        start_ns, end_ns: times of the first and last sample.
        objects: names of the objects.
        faults: parts of the source that could not be read, each with its place.
        unreadable: number of observations with a number that is not finite.
        missing: names in the specifications that are in no sample.
        remarks: remarks of the source that report no loss.
    """

    samples: int
    start_ns: int
    end_ns: int
    objects: tuple[str, ...]
    faults: tuple[str, ...]
    unreadable: int
    missing: tuple[Diagnostic, ...]
    remarks: tuple[str, ...] = ()


def record_source(
    source: Source,
    output: Path,
    files: Sequence[Specification] = (),
    *,
    inputs: Sequence[Path] = (),
    unit: str = "",
    advance: Callable[[int], None] = lambda samples: None,
    durability: Durability = "process",
) -> Recorded:
    """Record the samples of a source into a file that has its final name from the start.

    Equal sources and specifications give equal bytes. An interruption leaves a shorter log that is closed
    and marked as interrupted.

    Args:
        inputs: input files, which the output must not overwrite.
        unit: unit of lengths, if the source declares none.
        advance: called with the number of samples of each recorded block.
        durability: "disk" to force each written chunk to the disk at once.

    Raises:
        UsageError: the output is an input, a specification cannot be recorded, or the source declares another
            unit.
        LogError: the source has no sample, or it cannot be read to its end.
        OutputError: the output cannot be written.
    """
    refuse_inputs(output, inputs)
    refuse_templates(files)
    tally = _Tally()
    traces = _traces(source, tally)
    # a source without samples raises before the output is created
    first_trace = next(traces)
    about = {"source": source.name, "options": json.dumps(dict(source.options))}
    about |= _units_metadata(source, unit)
    stream = open_output(output, durability)
    try:
        with leaving(output), stream, recording_in(stream, files, about) as (_, recording):
            for trace in chain([first_trace], traces):
                with uninterrupted():
                    recording.add(trace)
                advance(len(trace))
            if tally.doubts:
                recording.add_metadata(DOUBTS, tally.doubts_metadata())
    except OutputError:
        # the disk is full: a partial log is removed, because the source can be recorded again
        if output.is_file():
            output.unlink(missing_ok=True)
        raise
    return tally.summary(source.name, files)


def _units_metadata(source: Source, unit: str) -> dict[str, str]:
    """Return the metadata entries of axes and units; `unit`, if given, is the unit of lengths."""
    axes = source.axes
    if unit and axes.unit not in ("", unit):
        raise UsageError(f"{source.name} declares lengths in {axes.unit}, not in {unit}; leave the unit out")
    unit = checked_units({"": unit})[""] if unit else axes.unit
    return replace(axes, unit=unit).metadata()


def _traces(source: Source, tally: _Tally) -> Iterator[Trace]:
    """Read the samples of a source, in blocks of one or more.

    Raises:
        LogError: the source has no samples, or cannot be read.
    """
    has_samples = False
    for block in read_blocks(source):
        tally.add(block.trace)
        tally.remarks += block.remarks
        tally.doubts += block.doubts
        if len(block.trace):
            has_samples = True
            yield block.trace
    if not has_samples:
        raise LogError("; ".join([f"{source.name} has no sample", *tally.faults[:1]]))


@contextmanager
def recording_in(
    stream: BinaryIO,
    files: Sequence[Specification],
    about: Mapping[str, str] | None,
    known: Sequence[SpecAutomaton] = (),
) -> Iterator[tuple[LogWriter, Recording]]:
    """Begin a log, and write its end after the block. After an error, the log is marked as interrupted."""
    is_interrupted = True

    def end() -> None:
        with uninterrupted():
            recording.end(RunEnd(is_interrupted))
            writer.close()

    with ExitStack() as ending:
        # an interruption between two records would leave a log with a wrong index
        with uninterrupted():
            writer = LogWriter(stream)
            recording = Recording(writer, files, about, known)
            ending.callback(end)
        yield writer, recording
        is_interrupted = False


class _Tally:
    """Counts of recorded samples, faults and names."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._object_names: set[str] = set()
        self._signal_names: set[str] = set()
        self.faults: list[str] = []
        self.remarks: list[str] = []
        self.doubts: list[Doubt] = []
        self._sample_count = self._unreadable_count = 0

    def add(self, trace: Trace) -> None:
        self._sample_count += len(trace)
        self.faults += trace.faults
        self._unreadable_count += trace.unreadable_count
        self._object_names.update(trace.names)
        self._signal_names.update(trace.signals)
        if len(trace):
            self._times = [*self._times[:1], int(trace.times_ns[0]), int(trace.times_ns[-1])]

    def summary(self, name: str, files: Sequence[Specification]) -> Recorded:
        object_names, signal_names = sorted(self._object_names), sorted(self._signal_names)
        remarks = [remark for file in files for remark in check_names(file, object_names, signal_names)]
        doubts = (doubt.remark(name) for doubt in dict.fromkeys(self.doubts))
        return Recorded(
            self._sample_count,
            self._times[0],
            self._times[-1],
            tuple(object_names),
            counted_from(self.faults, self._times[0]),
            self._unreadable_count,
            tuple(remark for remark in remarks if remark.severity == "error"),
            counted_from((*doubts, *self.remarks), self._times[0]),
        )

    def doubts_metadata(self) -> dict[str, str]:
        """Return the metadata record of the doubts; {} if there are none."""
        return metadata_from_doubts(distinct_doubts(self.doubts, self._times[0]))

"""A source, such as a file of tracked objects, recorded as a log."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from spatial_replay.errors import LogError, OutputError, UsageError
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.output_file import Durability, open_output, refuse_inputs
from spatial_replay.logs.source import Source, axes_of, read_blocks, reading_options, units_of
from spatial_replay.recording.interruption import leaving, uninterrupted
from spatial_replay.recording.recording import Recording, refuse_templates
from spatial_replay.spec import check_names
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.formula import Specification
from spatial_replay.text import counted_from
from spatial_replay.trace.declared_units import checked_units, signal_units_metadata
from spatial_replay.trace.trace import Trace


@dataclass(frozen=True, slots=True)
class Recorded:
    """The result of a recording.

    Attributes:
        samples: number of samples.
        start_ns, end_ns: times of the first and the last.
        objects: names of the objects.
        faults: what was lost while reading, each with its place.
        unreadable: number of observations with a number that is not finite.
        missing: names in the specifications that no sample had.
        remarks: what the source reports about its samples where nothing was lost.
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
    """Record the samples of a source, in place under the final name.

    Equal sources and specifications give equal bytes. An interruption leaves a shorter log, closed properly
    and marked as interrupted.

    Args:
        inputs: files that the output must not be.
        unit: that of lengths, for readers, where the source declares none.
        advance: called with the number of samples of each block that is done.
        durability: "disk" for a log of which the disk has each chunk as soon as it is written.

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
    # a source without samples raises here, before the output is touched
    first = next(traces)
    about = {"source": source.name, "options": json.dumps(reading_options(source))}
    about |= _units_metadata(source, unit)
    stream = open_output(output, durability)
    try:
        with leaving(output), stream:
            _record(LogWriter(stream), about, files, chain([first], traces), advance)
    except OutputError:
        # a disk that is full: half of a log that can be recorded again is worth less than none
        if output.is_file():
            output.unlink(missing_ok=True)
        raise
    return tally.recorded(files)


def _units_metadata(source: Source, unit: str) -> dict[str, str]:
    """Return the entries for the log's metadata with axes and units; `unit` is that of lengths, if given."""
    axes = axes_of(source)
    if unit and axes.unit not in ("", unit):
        raise UsageError(f"{source.name} declares lengths in {axes.unit}, and not in {unit}; leave that out")
    unit = checked_units({"": unit})[""] if unit else axes.unit
    return replace(axes, unit=unit).metadata() | signal_units_metadata(units_of(source))


def _traces(source: Source, tally: _Tally) -> Iterator[Trace]:
    """Read the samples of a source, in blocks of one or more.

    Raises:
        LogError: there are none, or they cannot be read.
    """
    any_sample = False
    for block in read_blocks(source):
        tally.add(block.trace)
        tally.remarks += block.remarks
        if len(block.trace):
            any_sample = True
            yield block.trace
    if not any_sample:
        raise LogError("; ".join([f"{source.name} has no sample", *tally.faults[:1]]))


def _record(
    writer: LogWriter,
    about: Mapping[str, str],
    files: Sequence[Specification],
    traces: Iterator[Trace],
    advance: Callable[[int], None],
) -> None:
    """Write a whole log, up to the end of the traces or an interruption."""
    interrupted = True
    with ExitStack() as ending:
        # an interruption between two records would leave a log whose index does not fit
        with uninterrupted():
            recording = Recording(writer, files, about)
            ending.callback(lambda: _end(writer, recording, interrupted=interrupted))
        for trace in traces:
            with uninterrupted():
                recording.add(trace)
            advance(len(trace))
        interrupted = False


def _end(writer: LogWriter, recording: Recording, *, interrupted: bool) -> None:
    with uninterrupted():
        recording.end(interrupted=interrupted)
        writer.close()


class _Tally:
    """Counts of what was recorded so far."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._names: set[str] = set()
        self._signals: set[str] = set()
        self.faults: list[str] = []
        self.remarks: list[str] = []
        self._samples = self._unreadable = 0

    def add(self, trace: Trace) -> None:
        self._samples += len(trace)
        self.faults += trace.faults
        self._unreadable += trace.unreadable_count
        self._names.update(trace.names)
        self._signals.update(trace.signals)
        if len(trace):
            self._times = [*self._times[:1], int(trace.times_ns[0]), int(trace.times_ns[-1])]

    def recorded(self, files: Sequence[Specification]) -> Recorded:
        names, signals = sorted(self._names), sorted(self._signals)
        remarks = [remark for file in files for remark in check_names(file, names, signals)]
        return Recorded(
            self._samples,
            self._times[0],
            self._times[-1],
            tuple(names),
            counted_from(self.faults, self._times[0]),
            self._unreadable,
            tuple(remark for remark in remarks if remark.severity == "error"),
            counted_from(self.remarks, self._times[0]),
        )

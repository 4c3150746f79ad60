"""Track JSONL, one sample a line, and what every text format shares: lines, reported objects, columns.

A text file may be plain or gzip, and damaged anywhere. A line that cannot be read costs its own sample only,
so each is checked by itself.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import inf, nan
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias, cast

import numpy as np

from spatial_replay.geometry.arrays import starts_from_counts
from spatial_replay.geometry.footprint import Concave, FootprintBatch
from spatial_replay.logs.messages import BLOCK_SAMPLES
from spatial_replay.logs.read_options import FaultList
from spatial_replay.text import Sentence, is_encodable, text_number, times_apart
from spatial_replay.trace.observations import Observations, trace_from_observations
from spatial_replay.trace.sample import LATEST_NS
from spatial_replay.trace.trace import Trace, require_few

GZIP_MAGIC = b"\x1f\x8b"
LONGEST_LINE = 16 * 2**20
"""Bytes; a line beyond this is a file of another kind, or damage."""

MOST_BLANK_LINES = 10_000_000
"""Limit for a file; later lines are not read."""


def open_text(path: Path) -> BinaryIO:
    """Open a file for its bytes, decompressed if it begins as a gzip file does, whatever its name."""
    with path.open("rb") as stream:
        magic = stream.read(len(GZIP_MAGIC))
    return cast(BinaryIO, gzip.open(path, "rb")) if magic == GZIP_MAGIC else path.open("rb")


def iter_lines(path: Path, faults: FaultList) -> Iterator[tuple[int, str]]:
    """Yield each line that is not blank, numbered from 1; what cannot be read goes to `faults`."""
    number = blank = 0
    with open_text(path) as stream:
        while True:
            number += 1
            try:
                line = stream.readline(LONGEST_LINE)
                too_long = len(line) == LONGEST_LINE and not line.endswith(b"\n")
                while too_long and (rest := stream.readline(LONGEST_LINE)) and not rest.endswith(b"\n"):
                    pass
            except (EOFError, zlib.error, gzip.BadGzipFile) as error:
                faults.add(f"{path.name}:{number}: the compressed data breaks off here ({error})")
                return
            if not line:
                return
            if too_long:
                faults.add(f"{path.name}:{number}: the line is longer than {LONGEST_LINE} bytes")
                continue
            try:
                text = line.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                faults.add(f"{path.name}:{number}: byte {error.start + 1} of the line is not UTF-8")
                continue
            if not text.isspace():
                yield number, text
                continue
            blank += 1
            if blank > MOST_BLANK_LINES:
                most = f"{MOST_BLANK_LINES:,}"
                faults.add(f"{path.name}:{number}: it has more than {most} blank lines; the rest is not read")
                return


@dataclass(slots=True)
class ObjectReport:
    """One object as a line of a log reports it, unchecked; the defaults stand for missing fields.

    Attributes:
        vertices: x, y, x, y … of all parts.
        vertex_counts: number of vertices of each part.
        radii: rounding radius of each part.
    """

    name: str
    class_name: str | None = None
    vertices: list[float] = field(default_factory=list)
    vertex_counts: list[int] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    yaw: float = nan
    uncertainty: float = 0.0
    bottom: float = nan
    top: float = nan
    invalid: bool = False


ReportedSample: TypeAlias = tuple[int, str, list[ObjectReport], dict[str, float]]
"""Time, place in the file, objects and signals."""


class ReportColumns:
    """Collects samples for the trace of a block."""

    def __init__(self) -> None:
        self.times: list[int] = []
        self.places: list[str] = []
        self._reports: list[ObjectReport] = []
        self._counts: list[int] = []
        self._signals: list[dict[str, float]] = []

    def __len__(self) -> int:
        return len(self.times)

    @property
    def report_count(self) -> int:
        return len(self._reports)

    def add(self, time_ns: int, place: str, reports: list[ObjectReport], signals: dict[str, float]) -> None:
        """Add one sample; `place` says where it is in its file."""
        self.times.append(time_ns)
        self.places.append(place)
        self._reports += reports
        self._counts.append(len(reports))
        self._signals.append(signals)

    def trace(self, *, concave: Concave) -> tuple[Trace, list[str]]:
        """Return the samples that can be used, and what is wrong with the others, each with its place."""
        trace, faults = trace_from_observations(self._observations(), concave=concave)
        return trace, [f"{self.places[index]}: {what}" for index, what in sorted(faults.items())]

    def _observations(self) -> Observations:
        reports = self._reports
        names = {name: index for index, name in enumerate(dict.fromkeys(r.name for r in reports))}
        ordered = sorted({r.class_name for r in reports}, key=lambda c: (c is not None, c or ""))
        classes = {name: index for index, name in enumerate(ordered)}
        signals = sorted({name for values in self._signals for name in values})
        require_few(names, signals)
        return Observations(
            times_ns=np.array(self.times, np.int64),
            sample=np.repeat(np.arange(len(self.times)), self._counts),
            name=np.array([names[r.name] for r in reports], np.int64),
            names=list(names),
            class_code=np.array([classes[r.class_name] for r in reports], np.int64),
            classes=tuple(ordered),
            yaw=np.array([r.yaw for r in reports], np.float64),
            uncertainty=np.array([r.uncertainty for r in reports], np.float64),
            shapes=_shapes(reports),
            invalid=np.array([r.invalid for r in reports], np.bool_),
            signals={
                name: np.array([values.get(name, nan) for values in self._signals], np.float64)
                for name in signals
            },
        )


def _shapes(reports: list[ObjectReport]) -> FootprintBatch:
    return FootprintBatch(
        part_start=starts_from_counts(np.array([len(r.radii) for r in reports], np.int64)),
        vertex_start=starts_from_counts(np.array([n for r in reports for n in r.vertex_counts], np.int64)),
        vertices=np.array([x for r in reports for x in r.vertices], np.float64).reshape(-1, 2),
        radius=np.array([x for r in reports for x in r.radii], np.float64),
        bottom=np.array([r.bottom for r in reports], np.float64),
        top=np.array([r.top for r in reports], np.float64),
    )


_SAMPLE_KEYS = {"time_ns", "objects", "signals"}
_OBJECT_KEYS = {"name", "class", "polygon", "parts", "height", "yaw", "uncertainty"}
_PART_KEYS = {"vertices", "radius"}


class _NoSampleError(Exception):
    """A line that is not a sample; the text says why and what to give instead."""


def iter_jsonl(path: Path, faults: FaultList, *, concave: Concave = "decompose") -> Iterator[Trace]:
    """Yield the samples of a `.jsonl` file in blocks; lines without a sample go to `faults`."""
    return iter_traces(_jsonl_samples(path, faults), faults, concave)


def iter_traces(
    samples: Iterable[ReportedSample], faults: FaultList, concave: Concave, *, most_reports: float = inf
) -> Iterator[Trace]:
    """Yield reported samples in blocks; what has to be left out goes to `faults`.

    Args:
        most_reports: objects after which a block is closed, however few its samples are.
    """
    columns = ReportColumns()
    for sample in samples:
        columns.add(*sample)
        if len(columns) == BLOCK_SAMPLES or columns.report_count >= most_reports:
            yield _trace_of(columns, faults, concave)
            columns = ReportColumns()
    if len(columns):
        yield _trace_of(columns, faults, concave)


def _trace_of(columns: ReportColumns, faults: FaultList, concave: Concave) -> Trace:
    trace, left_out = columns.trace(concave=concave)
    for fault in left_out:
        faults.add(fault)
    return trace


def _jsonl_samples(path: Path, faults: FaultList) -> Iterator[ReportedSample]:
    latest = -1
    for number, line in iter_lines(path, faults):
        place = f"{path.name}:{number}"
        try:
            time_ns, reports, signals = _sample(line)
            if time_ns <= latest:
                at, before = times_apart(time_ns, latest)
                what = Sentence("its time is ", at, ", not after ", before, "; give times that increase")
                raise _NoSampleError(what)
        except _NoSampleError as error:
            faults.add(Sentence(f"{place}: ", *error.args))
            continue
        latest = time_ns
        yield time_ns, place, reports, signals


def _sample(line: str) -> tuple[int, list[ObjectReport], dict[str, float]]:
    try:
        sample = json.loads(line)
    except RecursionError:
        raise _NoSampleError("the line is nested too deeply for a sample") from None
    except ValueError as error:
        raise _NoSampleError(f"the line is not JSON ({error})") from None
    if not isinstance(sample, dict):
        raise _NoSampleError(f'the line is {_kind(sample)}; give {{"time_ns": …, "objects": […]}}')
    _check_keys(sample, _SAMPLE_KEYS, "the sample")
    time_ns = sample.get("time_ns")
    if type(time_ns) is not int or not 0 <= time_ns <= LATEST_NS:
        raise _NoSampleError(f"time_ns is {_short(time_ns)}; give integer nanoseconds from 0 to 2**63 - 1")
    reports = [_report(entry) for entry in _list(sample.get("objects", []), "objects")]
    names = [report.name for report in reports]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise _NoSampleError(f"object {twice!r} is there twice; name each object once")
    return time_ns, reports, _signals(sample.get("signals", {}))


def _report(entry: Any) -> ObjectReport:
    if not isinstance(entry, dict):
        raise _NoSampleError(f'an object is {_kind(entry)}; give {{"name": …, "polygon": […]}}')
    name = entry.get("name")
    if not isinstance(name, str) or not _is_text(name):
        raise _NoSampleError(f"an object's name is {_short(name)}; give a string that is not empty")
    what = f"object {name!r}"
    _check_keys(entry, _OBJECT_KEYS, what)
    class_name = entry.get("class")
    if class_name is not None and not (isinstance(class_name, str) and _is_text(class_name, empty=True)):
        raise _NoSampleError(f"{what}: class is {_short(class_name)}; give a string or leave it out")
    report = ObjectReport(name, class_name)
    if ("polygon" in entry) == ("parts" in entry):
        raise _NoSampleError(f"{what}: give one of polygon and parts")
    if "polygon" in entry:
        _add_part(report, entry["polygon"], 0.0, f"{what}: polygon")
    else:
        for part in _list(entry["parts"], f"{what}: parts"):
            if not isinstance(part, dict):
                wanted = '{"vertices": […], "radius": r}'
                raise _NoSampleError(f"{what}: a part is {_kind(part)}; give {wanted}")
            _check_keys(part, _PART_KEYS, f"a part of {what}")
            radius = _number(part.get("radius", 0.0), f"{what}: radius")
            _add_part(report, part.get("vertices"), radius, f"{what}: vertices")
    report.uncertainty = _number(entry.get("uncertainty", 0.0), f"{what}: uncertainty")
    if entry.get("height") is not None:
        height = _list(entry["height"], f"{what}: height")
        if len(height) != 2:
            raise _NoSampleError(f"{what}: height has {len(height)} numbers; give [bottom, top]")
        report.bottom, report.top = (_number(value, f"{what}: height") for value in height)
        report.invalid = report.bottom != report.bottom and report.top != report.top
    if entry.get("yaw") is not None:
        report.yaw = _number(entry["yaw"], f"{what}: yaw")
        report.invalid |= report.yaw != report.yaw
    return report


def _add_part(report: ObjectReport, vertices: Any, radius: float, what: str) -> None:
    listed = _list(vertices, what)
    flat = report.vertices
    for point in listed:
        if type(point) is not list or len(point) != 2:
            raise _NoSampleError(f"{what} holds {_short(point)}; give [x, y] pairs")
        x, y = point
        flat.append(x if type(x) is float else _number(x, what))
        flat.append(y if type(y) is float else _number(y, what))
    report.vertex_counts.append(len(listed))
    report.radii.append(radius)


def _signals(entry: Any) -> dict[str, float]:
    if not isinstance(entry, dict):
        raise _NoSampleError(f'signals are {_kind(entry)}; give {{"name": number}}')
    for name in entry:
        if not _is_text(name):
            raise _NoSampleError(f"a signal's name is {_short(name)}; give a string that is not empty")
    return {
        name: text_number(value) if isinstance(value, str) else _number(value, f"signal {name!r}")
        for name, value in entry.items()
    }


def _number(value: Any, what: str) -> float:
    """Return the number; null, like NaN, stands for an unknown one."""
    if value is None:
        return nan
    if type(value) is not int and type(value) is not float:
        raise _NoSampleError(f"{what} holds {_short(value)}; give a number, or null where it is not known")
    try:
        return float(value)
    except OverflowError:
        wanted = "a number that fits a double"
        raise _NoSampleError(f"{what} holds an integer beyond 1.8e308; give {wanted}") from None


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise _NoSampleError(f"{what}: {_short(value)}; give a list")
    return value


def _check_keys(entry: dict[str, Any], known: set[str], what: str) -> None:
    if not entry.keys() <= known:
        unknown, listed = ", ".join(map(repr, sorted(entry.keys() - known))), ", ".join(sorted(known))
        raise _NoSampleError(f"{what} has the unknown key {_shorten(unknown)}; known are {listed}")


def _is_text(text: str, *, empty: bool = False) -> bool:
    """Return whether a text fits UTF-8, unlike the halves of surrogate pairs that JSON can spell."""
    return is_encodable(text) if text else empty


def _kind(value: Any) -> str:
    kinds = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", type(None): "null"}
    return kinds.get(type(value), "a number")


def _short(value: Any) -> str:
    if isinstance(value, dict | list):
        return _kind(value)
    try:
        return _shorten(json.dumps(value))
    except ValueError:
        return "a number of too many digits"


def _shorten(text: str) -> str:
    return text if len(text) <= 60 else text[:59] + "…"

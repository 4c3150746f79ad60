"""Read track JSONL, track CSV and the Stanford Drone Dataset; shared parsing of lines and objects.

A text file may be plain or gzip, and damaged anywhere. An unreadable line loses only its own sample, so each
line is checked separately.
"""

from __future__ import annotations

import csv
import gzip
import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from math import cos, inf, isfinite, nan, sin
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Integers, flat_index, starts_from_counts
from spatial_replay.geometry.footprint import Concave, FootprintBatch
from spatial_replay.logs.read_options import FaultList, Lost, frame_times
from spatial_replay.logs.source import BLOCK_SAMPLES
from spatial_replay.text import Instant, Sentence, cut, is_encodable, text_number, times_apart
from spatial_replay.trace.observations import Observations, trace_from_observations
from spatial_replay.trace.trace import LATEST_NS, Trace, class_order, require_few

GZIP_MAGIC = b"\x1f\x8b"
LONGEST_LINE = 16 * 2**20
"""Longest line, bytes; a longer line is damage, or in a file of another kind."""

MOST_BLANK_LINES = 10_000_000
"""Maximum number of blank lines in a file; the lines after them are not read."""


def open_text(path: Path) -> BinaryIO:
    """Open a file as bytes; a file with the gzip magic is decompressed, whatever its name."""
    with path.open("rb") as stream:
        magic = stream.read(len(GZIP_MAGIC))
    return cast(BinaryIO, gzip.open(path, "rb")) if magic == GZIP_MAGIC else path.open("rb")


def iter_lines(path: Path, faults: FaultList) -> Iterator[tuple[int, str]]:
    """Yield the lines that are not blank, with numbers from 1; unreadable lines go to `faults`."""
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
    """The unchecked report of an object in a log; missing fields have the defaults.

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


class ReportedSample(NamedTuple):
    """An unchecked sample of a file; `place` is its position there, for messages."""

    time_ns: int
    place: str
    reports: list[ObjectReport]
    signals: dict[str, float]


def _observations_from_samples(samples: Sequence[ReportedSample]) -> Observations:
    reports = [report for sample in samples for report in sample.reports]
    names = {name: index for index, name in enumerate(dict.fromkeys(r.name for r in reports))}
    classes = class_order(r.class_name for r in reports)
    code = {name: index for index, name in enumerate(classes)}
    signals = sorted({name for sample in samples for name in sample.signals})
    require_few(names, signals)
    return Observations(
        times_ns=np.array([sample.time_ns for sample in samples], np.int64),
        sample=np.repeat(np.arange(len(samples)), [len(sample.reports) for sample in samples]),
        name=np.array([names[r.name] for r in reports], np.int64),
        names=list(names),
        class_code=np.array([code[r.class_name] for r in reports], np.int64),
        classes=classes,
        yaw=np.array([r.yaw for r in reports], np.float64),
        uncertainty=np.array([r.uncertainty for r in reports], np.float64),
        shapes=_shapes(reports),
        invalid=np.array([r.invalid for r in reports], np.bool_),
        signals={
            name: np.array([sample.signals.get(name, nan) for sample in samples], np.float64)
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
    """Yield reported samples in blocks; samples that are left out go to `faults`.

    Args:
        most_reports: number of object reports at which a block is closed.
    """
    block, count = list[ReportedSample](), 0
    for sample in samples:
        block.append(sample)
        count += len(sample.reports)
        if len(block) == BLOCK_SAMPLES or count >= most_reports:
            yield _trace_of(block, faults, concave)
            block, count = [], 0
    if block:
        yield _trace_of(block, faults, concave)


def _trace_of(samples: Sequence[ReportedSample], faults: FaultList, concave: Concave) -> Trace:
    trace, left_out = trace_from_observations(_observations_from_samples(samples), concave=concave)
    for index, what in sorted(left_out.items()):
        faults.add(f"{samples[index].place}: {what}")
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
        yield ReportedSample(time_ns, place, reports, signals)


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
                example = '{"vertices": […], "radius": r}'
                raise _NoSampleError(f"{what}: a part is {_kind(part)}; give {example}")
            _check_keys(part, _PART_KEYS, f"a part of {what}")
            radius = _number(part.get("radius", 0.0), f"{what}: radius")
            _add_part(report, part.get("vertices"), radius, f"{what}: vertices")
    report.uncertainty = _number(entry.get("uncertainty", 0.0), f"{what}: uncertainty")
    if entry.get("height") is not None:
        height = _list(entry["height"], f"{what}: height")
        if len(height) != 2:
            raise _NoSampleError(f"{what}: height has {len(height)} numbers; give [bottom, top]")
        report.bottom, report.top = (_number(value, f"{what}: height") for value in height)
        # given, but unknown: NaN differs from itself
        report.invalid = report.bottom != report.bottom and report.top != report.top
    if entry.get("yaw") is not None:
        report.yaw = _number(entry["yaw"], f"{what}: yaw")
        report.invalid |= report.yaw != report.yaw
    return report


def _add_part(report: ObjectReport, vertices: Any, radius: float, what: str) -> None:
    points = _list(vertices, what)
    flat = report.vertices
    for point in points:
        if type(point) is not list or len(point) != 2:
            raise _NoSampleError(f"{what} holds {_short(point)}; give [x, y] pairs")
        x, y = point
        # most numbers are floats, which need no check
        flat.append(x if type(x) is float else _number(x, what))
        flat.append(y if type(y) is float else _number(y, what))
    report.vertex_counts.append(len(points))
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
    """Return the number; null and NaN stand for an unknown number."""
    if value is None:
        return nan
    if type(value) is not int and type(value) is not float:
        raise _NoSampleError(f"{what} holds {_short(value)}; give a number, or null where it is not known")
    try:
        return float(value)
    except OverflowError:
        remedy = "give a number that fits a double"
        raise _NoSampleError(f"{what} holds an integer beyond 1.8e308; {remedy}") from None


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise _NoSampleError(f"{what}: {_short(value)}; give a list")
    return value


def _check_keys(entry: dict[str, Any], keys: set[str], what: str) -> None:
    if not entry.keys() <= keys:
        unknown, allowed = ", ".join(map(repr, sorted(entry.keys() - keys))), ", ".join(sorted(keys))
        raise _NoSampleError(f"{what} has the unknown key {cut(unknown, 60)}; known are {allowed}")


def _is_text(text: str, *, empty: bool = False) -> bool:
    """Return whether a text can be encoded as UTF-8; lone surrogates, which JSON can spell, cannot."""
    return is_encodable(text) if text else empty


def _kind(value: Any) -> str:
    kinds = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", type(None): "null"}
    return kinds.get(type(value), "a number")


def _short(value: Any) -> str:
    if isinstance(value, dict | list):
        return _kind(value)
    try:
        return cut(json.dumps(value), 60)
    except ValueError:
        return "a number of too many digits"


CSV_COLUMNS = ("time_ns", "name", "class", "x", "y", "yaw", "length", "width")


def iter_csv(path: Path, faults: FaultList, *, concave: Concave = "decompose") -> Iterator[Trace]:
    """Yield the samples of a track CSV in blocks.

    A sample with an unreadable line is left out, and the line goes to `faults`.

    Raises:
        LogError: the first line does not name the columns.
    """
    return iter_traces(_csv_samples(path, faults), faults, concave)


def _csv_samples(path: Path, faults: FaultList) -> Iterator[ReportedSample]:
    lines = iter_lines(path, faults)
    order = _column_order(path, next(lines, (1, ""))[1])
    time_ns, place, reports, broken = -1, "", dict[str, ObjectReport](), False
    for number, line in lines:
        line_place = f"{path.name}:{number}"
        try:
            row = _row(line, order)
            at = _time(row["time_ns"])
            if at < time_ns:
                this, last = times_apart(at, time_ns)
                what = Sentence("its time is ", this, ", before ", last, "; give times that do not go back")
                raise _NoSampleError(what)
        except _NoSampleError as error:
            faults.add(Sentence(f"{line_place}: ", *error.args))
            continue
        if at > time_ns:
            if reports and not broken:
                yield ReportedSample(time_ns, place, list(reports.values()), {})
            time_ns, place, reports, broken = at, line_place, {}, False
        try:
            report = _row_report(row)
            if report.name in reports:
                raise _NoSampleError(f"object {report.name!r} is there twice; name each object once a sample")
            reports[report.name] = report
        except _NoSampleError as error:
            faults.add(Sentence(f"{line_place}: {error}; the sample at ", Instant(at, 0), " is left out"))
            broken = True
    if reports and not broken:
        yield ReportedSample(time_ns, place, list(reports.values()), {})


def _column_order(path: Path, header: str) -> list[str]:
    order = [name.strip() for name in header.strip().split(",")]
    if sorted(order) != sorted(CSV_COLUMNS):
        raise LogError(
            f"{path.name}:1: the columns are {', '.join(order)[:200]!r}; a track CSV has"
            f" {','.join(CSV_COLUMNS)}"
        )
    return order


def _row(line: str, order: list[str]) -> dict[str, str]:
    try:
        # one line at a time, so that an open quote does not swallow later lines
        cells = next(csv.reader([line], strict=True))
    except (csv.Error, StopIteration) as error:
        raise _NoSampleError(f"the line is not CSV ({error}); a quoted cell ends on its own line") from None
    if len(cells) != len(order):
        raise _NoSampleError(f"the line has {len(cells)} cells; give {len(order)}")
    return dict(zip(order, cells, strict=True))


def _time(text: str) -> int:
    try:
        time_ns = int(text)
    except ValueError:
        time_ns = -1
    if not 0 <= time_ns <= LATEST_NS:
        raise _NoSampleError(f"time_ns is {text[:60]!r}; give integer nanoseconds from 0 to 2**63 - 1")
    return time_ns


def _row_report(row: dict[str, str]) -> ObjectReport:
    if not row["name"]:
        raise _NoSampleError("the name is empty; give each object a name")
    x, y, length, width = (_cell(row, column) for column in ("x", "y", "length", "width"))
    yaw = _cell(row, "yaw") if row["yaw"].strip() else nan
    if length < 0 or width < 0:
        raise _NoSampleError(f"length and width are {length:g} and {width:g}; give sizes of at least 0")
    # for an orientation that is not finite, NaN as cosine and sine makes the box unknown
    c, s = (1.0, 0.0) if not row["yaw"].strip() else (cos(yaw), sin(yaw)) if isfinite(yaw) else (nan, nan)
    vertices: list[float] = []
    for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)):
        vertices += (x + a * length * c + b * width * -s, y + a * length * s + b * width * c)
    return ObjectReport(row["name"], row["class"] or None, vertices, [4], [0.0], yaw=yaw)


def _cell(row: dict[str, str], column: str) -> float:
    """Return the number in a cell; an empty cell stands for an unknown number."""
    text = row[column].strip()
    try:
        return float(text) if text else nan
    except ValueError:
        remedy = "give a number, or nothing where it is not known"
        raise _NoSampleError(f"{column} is {text[:60]!r}; {remedy}") from None


FRAMES_A_SECOND = 30.0
"""Frame rate of the dataset's videos, Hz."""

DRONE_COLUMNS = ("id", "xmin", "ymin", "xmax", "ymax", "frame", "lost", "occluded", "generated", "label")

_LARGEST = 10**18 - 1
"""Largest integer of 18 digits; all integers of 18 digits fit 64 bits."""


_PACKED = struct.Struct("<qqq?4d")
_BOX = np.dtype([("id", "<i8"), ("frame", "<i8"), ("label", "<i8"), ("lost", "?"), ("corners", "<f8", 4)])
"""A line as a row of numbers; corners are xmin, ymin, xmax and ymax."""
_Boxes: TypeAlias = NDArray[np.void]

_BLOCK_BOXES = 2**16
"""Number of boxes at which a block is closed."""


def is_annotations(head: bytes) -> bool:
    """Return whether a complete line in the first bytes of a file is a row of annotations."""
    lines = head.removeprefix(b"\xef\xbb\xbf").split(b"\n")
    return any(map(_is_row, lines[:1] if len(lines) == 1 else lines[:-1]))


def iter_annotations(
    path: Path,
    faults: FaultList,
    *,
    concave: Concave = "decompose",
    rate: float = FRAMES_A_SECOND,
    lost: Lost = "drop",
) -> Iterator[Trace]:
    """Yield the samples of an `annotations.txt` in blocks; each frame in the file is a sample.

    Files are ordered by object, so the first frame is complete only after the last line. So all boxes are
    read first, in 57 bytes a line, and samples are built block by block.

    A frame with an unreadable line is left out, and the line goes to `faults`.

    Args:
        concave: without effect, because boxes are convex.
        rate: frames per second; frame 0 is at time 0.
        lost: whether rows marked as out of the picture are dropped or kept.
    """
    boxes, labels, broken = _read_boxes(path, faults, _last_frame(rate))
    frames, starts = np.unique(boxes["frame"], return_index=True)
    sound = ~np.isin(frames, np.fromiter(broken, np.int64))
    frames, starts, ends = frames[sound], starts[sound], np.append(starts, len(boxes))[1:][sound]
    classes, period = tuple(label or None for label in labels), frame_times(rate)
    after = 0
    while after < len(frames):
        first = after
        filled = int(np.searchsorted(ends, starts[first] + _BLOCK_BOXES, side="right"))
        after = min(first + BLOCK_SAMPLES, max(filled, first + 1))
        counts = ends[first:after] - starts[first:after]
        rows = boxes[flat_index(starts[first:after], counts)]
        sample = np.repeat(np.arange(after - first, dtype=np.int64), counts)
        if lost == "drop":
            rows, sample = rows[~rows["lost"]], sample[~rows["lost"]]
        times_ns = np.array([round(frame * period) for frame in frames[first:after].tolist()], np.int64)
        observations = _observations(times_ns, sample, rows, classes)
        trace, left_out = trace_from_observations(observations, concave=concave)
        for index, what in sorted(left_out.items()):
            faults.add(f"{path.name}: frame {frames[first + index]}: {what}")
        yield trace


def _read_boxes(path: Path, faults: FaultList, last_frame: int) -> tuple[_Boxes, list[str], set[int]]:
    """Read all readable lines.

    Returns:
        the boxes sorted by frame, in file order within a frame; their labels; the frames of unreadable lines.
    """
    packed, labels, broken = bytearray(), dict[str, int](), set[int]()
    for number, line in iter_lines(path, faults):
        cells = line.split(None, len(DRONE_COLUMNS) - 1)
        try:
            if len(cells) != len(DRONE_COLUMNS):
                raise _NoSampleError(f"the line has {len(cells)} columns; give {' '.join(DRONE_COLUMNS)}")
            frame = _integer(cells[5], "frame", last_frame)
        except _NoSampleError as error:
            faults.add(f"{path.name}:{number}: {error}")
            continue
        try:
            identity, corners, is_lost, label = _box(cells)
        except _NoSampleError as error:
            faults.add(f"{path.name}:{number}: {error}; frame {frame} is left out")
            broken.add(frame)
            continue
        packed += _PACKED.pack(identity, frame, labels.setdefault(label, len(labels)), is_lost, *corners)
    boxes = np.frombuffer(packed, _BOX)
    return boxes[np.argsort(boxes["frame"], kind="stable")], list(labels), broken


def _box(cells: list[str]) -> tuple[int, list[float], bool, str]:
    number = _integer(cells[0], "id", _LARGEST)
    try:
        corners = [float(cell) for cell in cells[1:5]]
    except ValueError:
        raise _NoSampleError(f"the box is {' '.join(cells[1:5])[:60]!r}; give four numbers") from None
    if corners[0] > corners[2] or corners[1] > corners[3]:
        raise _NoSampleError(f"the box is {' '.join(cells[1:5])[:60]!r}; give xmin ymin xmax ymax")
    if cells[6] not in ("0", "1"):
        raise _NoSampleError(f"lost is {cells[6][:60]!r}; give 0 or 1")
    label = cells[9].strip()
    if len(label) >= 2 and label[0] == label[-1] == '"':
        label = label[1:-1]
    return number, corners, cells[6] == "1", label


def _integer(text: str, what: str, last: int) -> int:
    # `int` also accepts signs, spaces, underscores and digits of other scripts
    is_number = len(text) <= len(str(_LARGEST)) and text.isascii() and text.isdecimal()
    if not is_number or int(text) > last:
        raise _NoSampleError(f"{what} is {text[:60]!r}; give an integer from 0 to {last}")
    return int(text)


def _last_frame(rate: float) -> int:
    """Return the last frame whose time a sample can have."""
    last = LATEST_NS // frame_times(rate) - 1
    return min(max(last, 0), _LARGEST)


def _observations(
    times_ns: Integers, sample: Integers, boxes: _Boxes, classes: tuple[str | None, ...]
) -> Observations:
    """Return boxes as observations; `sample` is the sample index of each box."""
    numbers, name = np.unique(boxes["id"], return_inverse=True)
    count, corners = len(boxes), boxes["corners"]
    return Observations(
        times_ns=times_ns,
        sample=sample,
        name=name,
        names=[str(number) for number in numbers.tolist()],
        class_code=boxes["label"],
        classes=classes,
        yaw=np.full(count, np.nan),
        uncertainty=np.zeros(count),
        # counter-clockwise corners if y points up
        shapes=FootprintBatch(
            part_start=np.arange(count + 1, dtype=np.int64),
            vertex_start=np.arange(count + 1, dtype=np.int64) * 4,
            vertices=corners[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2),
            radius=np.zeros(count),
            bottom=np.full(count, np.nan),
            top=np.full(count, np.nan),
        ),
        invalid=np.zeros(count, np.bool_),
        signals={},
    )


def _is_row(line: bytes) -> bool:
    cells = line.split(None, len(DRONE_COLUMNS) - 1)
    if len(cells) != len(DRONE_COLUMNS) or not (cells[0].isdigit() and cells[5].isdigit()):
        return False
    return all(flag in (b"0", b"1") for flag in cells[6:9])

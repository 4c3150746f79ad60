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
"""Longest line, bytes; a longer line is damaged, or its file is of another kind."""

MOST_BLANK_LINES = 10_000_000
"""Maximum number of blank lines in a file; further lines are not read."""


def open_text(path: Path) -> BinaryIO:
    """Open a file as bytes; a file with the gzip magic is decompressed."""
    with path.open("rb") as stream:
        magic = stream.read(len(GZIP_MAGIC))
    return cast(BinaryIO, gzip.open(path, "rb")) if magic == GZIP_MAGIC else path.open("rb")


def iter_lines(path: Path, faults: FaultList) -> Iterator[tuple[int, str]]:
    """Yield the lines that are not blank, with numbers from 1; unreadable lines go to `faults`."""
    line_number = blank_count = 0
    with open_text(path) as stream:
        while True:
            line_number += 1
            try:
                line = stream.readline(LONGEST_LINE)
                is_too_long = len(line) == LONGEST_LINE and not line.endswith(b"\n")
                while is_too_long and (piece := stream.readline(LONGEST_LINE)) and not piece.endswith(b"\n"):
                    pass
            except (EOFError, zlib.error, gzip.BadGzipFile) as error:
                faults.add(f"{path.name}:{line_number}: the compressed data breaks off here ({error})")
                return
            if not line:
                return
            if is_too_long:
                faults.add(f"{path.name}:{line_number}: the line is longer than {LONGEST_LINE} bytes")
                continue
            try:
                text = line.decode("utf-8-sig" if line_number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                faults.add(f"{path.name}:{line_number}: byte {error.start + 1} of the line is not UTF-8")
                continue
            if not text.isspace():
                yield line_number, text
                continue
            blank_count += 1
            if blank_count > MOST_BLANK_LINES:
                limit = f"{MOST_BLANK_LINES:,}"
                faults.add(
                    f"{path.name}:{line_number}: it has more than {limit} blank lines; the rest is not read"
                )
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
    """An unchecked sample of a file; `place` names the sample's position in the file, for messages."""

    time_ns: int
    place: str
    reports: list[ObjectReport]
    signals: dict[str, float]


def _observations_from_samples(samples: Sequence[ReportedSample]) -> Observations:
    reports = [report for sample in samples for report in sample.reports]
    name_indices = {name: index for index, name in enumerate(dict.fromkeys(r.name for r in reports))}
    class_names = class_order(r.class_name for r in reports)
    class_codes = {name: index for index, name in enumerate(class_names)}
    signal_names = sorted({name for sample in samples for name in sample.signals})
    require_few(name_indices, signal_names)
    return Observations(
        times_ns=np.array([sample.time_ns for sample in samples], np.int64),
        sample=np.repeat(np.arange(len(samples)), [len(sample.reports) for sample in samples]),
        name=np.array([name_indices[r.name] for r in reports], np.int64),
        names=list(name_indices),
        class_code=np.array([class_codes[r.class_name] for r in reports], np.int64),
        classes=class_names,
        yaw=np.array([r.yaw for r in reports], np.float64),
        uncertainty=np.array([r.uncertainty for r in reports], np.float64),
        shapes=_shapes(reports),
        invalid=np.array([r.invalid for r in reports], np.bool_),
        signals={
            name: np.array([sample.signals.get(name, nan) for sample in samples], np.float64)
            for name in signal_names
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
    block, report_count = list[ReportedSample](), 0
    for sample in samples:
        block.append(sample)
        report_count += len(sample.reports)
        if len(block) == BLOCK_SAMPLES or report_count >= most_reports:
            yield _trace_of(block, faults, concave)
            block, report_count = [], 0
    if block:
        yield _trace_of(block, faults, concave)


def _trace_of(samples: Sequence[ReportedSample], faults: FaultList, concave: Concave) -> Trace:
    trace, fault_by_index = trace_from_observations(_observations_from_samples(samples), concave=concave)
    for index, fault in sorted(fault_by_index.items()):
        faults.add(f"{samples[index].place}: {fault}")
    return trace


def _jsonl_samples(path: Path, faults: FaultList) -> Iterator[ReportedSample]:
    latest_ns = -1
    for line_number, line in iter_lines(path, faults):
        place = f"{path.name}:{line_number}"
        try:
            time_ns, reports, signals = _sample(line)
            if time_ns <= latest_ns:
                instant, latest = times_apart(time_ns, latest_ns)
                fault = Sentence(
                    "its time is ", instant, ", not after ", latest, "; give times that increase"
                )
                raise _NoSampleError(fault)
        except _NoSampleError as error:
            faults.add(Sentence(f"{place}: ", *error.args))
            continue
        latest_ns = time_ns
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
    object_names = [report.name for report in reports]
    if len(set(object_names)) < len(object_names):
        repeated_name = next(name for name in object_names if object_names.count(name) > 1)
        raise _NoSampleError(f"object {repeated_name!r} is there twice; name each object once")
    return time_ns, reports, _signals(sample.get("signals", {}))


def _report(entry: Any) -> ObjectReport:
    if not isinstance(entry, dict):
        raise _NoSampleError(f'an object is {_kind(entry)}; give {{"name": …, "polygon": […]}}')
    name = entry.get("name")
    if not isinstance(name, str) or not _is_text(name):
        raise _NoSampleError(f"an object's name is {_short(name)}; give a string that is not empty")
    object_text = f"object {name!r}"
    _check_keys(entry, _OBJECT_KEYS, object_text)
    class_name = entry.get("class")
    if class_name is not None and not (isinstance(class_name, str) and _is_text(class_name, empty=True)):
        raise _NoSampleError(f"{object_text}: class is {_short(class_name)}; give a string or leave it out")
    report = ObjectReport(name, class_name)
    if ("polygon" in entry) == ("parts" in entry):
        raise _NoSampleError(f"{object_text}: give one of polygon and parts")
    if "polygon" in entry:
        _add_part(report, entry["polygon"], 0.0, f"{object_text}: polygon")
    else:
        for part in _list(entry["parts"], f"{object_text}: parts"):
            if not isinstance(part, dict):
                example = '{"vertices": […], "radius": r}'
                raise _NoSampleError(f"{object_text}: a part is {_kind(part)}; give {example}")
            _check_keys(part, _PART_KEYS, f"a part of {object_text}")
            radius = _number(part.get("radius", 0.0), f"{object_text}: radius")
            _add_part(report, part.get("vertices"), radius, f"{object_text}: vertices")
    report.uncertainty = _number(entry.get("uncertainty", 0.0), f"{object_text}: uncertainty")
    if entry.get("height") is not None:
        height = _list(entry["height"], f"{object_text}: height")
        if len(height) != 2:
            raise _NoSampleError(f"{object_text}: height has {len(height)} numbers; give [bottom, top]")
        report.bottom, report.top = (_number(value, f"{object_text}: height") for value in height)
        # a height is invalid if both numbers are NaN, which differs from itself
        report.invalid = report.bottom != report.bottom and report.top != report.top
    if entry.get("yaw") is not None:
        report.yaw = _number(entry["yaw"], f"{object_text}: yaw")
        report.invalid |= report.yaw != report.yaw
    return report


def _add_part(report: ObjectReport, vertices: Any, radius: float, place: str) -> None:
    points = _list(vertices, place)
    coordinates = report.vertices
    for point in points:
        if type(point) is not list or len(point) != 2:
            raise _NoSampleError(f"{place} holds {_short(point)}; give [x, y] pairs")
        x, y = point
        # most numbers are floats, which need no check
        coordinates.append(x if type(x) is float else _number(x, place))
        coordinates.append(y if type(y) is float else _number(y, place))
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


def _number(value: Any, subject: str) -> float:
    """Return a JSON value as a number; null and NaN stand for an unknown number."""
    if value is None:
        return nan
    if type(value) is not int and type(value) is not float:
        raise _NoSampleError(f"{subject} holds {_short(value)}; give a number, or null where it is not known")
    try:
        return float(value)
    except OverflowError:
        remedy = "give a number that fits a double"
        raise _NoSampleError(f"{subject} holds an integer beyond 1.8e308; {remedy}") from None


def _list(value: Any, subject: str) -> list[Any]:
    if not isinstance(value, list):
        raise _NoSampleError(f"{subject}: {_short(value)}; give a list")
    return value


def _check_keys(entry: dict[str, Any], keys: set[str], subject: str) -> None:
    if not entry.keys() <= keys:
        unknown, allowed = ", ".join(map(repr, sorted(entry.keys() - keys))), ", ".join(sorted(keys))
        raise _NoSampleError(f"{subject} has the unknown key {cut(unknown, 60)}; known are {allowed}")


def _is_text(text: str, *, empty: bool = False) -> bool:
    """Return whether a text has an encoding in UTF-8. Lone surrogates in JSON have no encoding."""
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
    column_order = _column_order(path, next(lines, (1, ""))[1])
    time_ns, place, reports, is_broken = -1, "", dict[str, ObjectReport](), False
    for line_number, line in lines:
        line_place = f"{path.name}:{line_number}"
        try:
            row = _row(line, column_order)
            row_time_ns = _time(row["time_ns"])
            if row_time_ns < time_ns:
                row_instant, last_instant = times_apart(row_time_ns, time_ns)
                fault = Sentence(
                    "its time is ", row_instant, ", before ", last_instant, "; give times that do not go back"
                )
                raise _NoSampleError(fault)
        except _NoSampleError as error:
            faults.add(Sentence(f"{line_place}: ", *error.args))
            continue
        if row_time_ns > time_ns:
            if reports and not is_broken:
                yield ReportedSample(time_ns, place, list(reports.values()), {})
            time_ns, place, reports, is_broken = row_time_ns, line_place, {}, False
        try:
            report = _row_report(row)
            if report.name in reports:
                raise _NoSampleError(f"object {report.name!r} is there twice; name each object once a sample")
            reports[report.name] = report
        except _NoSampleError as error:
            faults.add(
                Sentence(f"{line_place}: {error}; the sample at ", Instant(row_time_ns, 0), " is left out")
            )
            is_broken = True
    if reports and not is_broken:
        yield ReportedSample(time_ns, place, list(reports.values()), {})


def _column_order(path: Path, header: str) -> list[str]:
    columns = [name.strip() for name in header.strip().split(",")]
    if sorted(columns) != sorted(CSV_COLUMNS):
        raise LogError(
            f"{path.name}:1: the columns are {', '.join(columns)[:200]!r}; a track CSV has"
            f" {','.join(CSV_COLUMNS)}"
        )
    return columns


def _row(line: str, columns: list[str]) -> dict[str, str]:
    try:
        # each line is parsed alone, so that an open quote does not swallow later lines
        cells = next(csv.reader([line], strict=True))
    except (csv.Error, StopIteration) as error:
        raise _NoSampleError(f"the line is not CSV ({error}); a quoted cell ends on its own line") from None
    if len(cells) != len(columns):
        raise _NoSampleError(f"the line has {len(cells)} cells; give {len(columns)}")
    return dict(zip(columns, cells, strict=True))


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
    # an orientation that is not finite has NaN as cosine and sine, so that the box is unknown
    cosine, sine = (
        (1.0, 0.0) if not row["yaw"].strip() else (cos(yaw), sin(yaw)) if isfinite(yaw) else (nan, nan)
    )
    vertices: list[float] = []
    for unit_x, unit_y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)):
        vertices += (
            x + unit_x * length * cosine + unit_y * width * -sine,
            y + unit_x * length * sine + unit_y * width * cosine,
        )
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
    read first, with 57 bytes per line. Then samples are built block by block.

    A frame with an unreadable line is left out, and the line goes to `faults`.

    Args:
        concave: without effect, because boxes are convex.
        rate: frames per second; frame 0 is at time 0.
        lost: whether rows marked as out of the picture are dropped or kept.
    """
    boxes, labels, broken_frames = _read_boxes(path, faults, _last_frame(rate))
    frames, first_boxes = np.unique(boxes["frame"], return_index=True)
    is_complete = ~np.isin(frames, np.fromiter(broken_frames, np.int64))
    frames, first_boxes, end_boxes = (
        frames[is_complete],
        first_boxes[is_complete],
        np.append(first_boxes, len(boxes))[1:][is_complete],
    )
    class_names, period_ns = tuple(label or None for label in labels), frame_times(rate)
    end = 0
    while end < len(frames):
        begin = end
        filled_end = int(np.searchsorted(end_boxes, first_boxes[begin] + _BLOCK_BOXES, side="right"))
        end = min(begin + BLOCK_SAMPLES, max(filled_end, begin + 1))
        box_counts = end_boxes[begin:end] - first_boxes[begin:end]
        block = boxes[flat_index(first_boxes[begin:end], box_counts)]
        sample_indices = np.repeat(np.arange(end - begin, dtype=np.int64), box_counts)
        if lost == "drop":
            block, sample_indices = block[~block["lost"]], sample_indices[~block["lost"]]
        times_ns = np.array([round(frame * period_ns) for frame in frames[begin:end].tolist()], np.int64)
        observations = _observations(times_ns, sample_indices, block, class_names)
        trace, fault_by_index = trace_from_observations(observations, concave=concave)
        for index, fault in sorted(fault_by_index.items()):
            faults.add(f"{path.name}: frame {frames[begin + index]}: {fault}")
        yield trace


def _read_boxes(path: Path, faults: FaultList, last_frame: int) -> tuple[_Boxes, list[str], set[int]]:
    """Read all readable lines.

    Returns:
        the boxes sorted by frame, in file order within a frame; their labels; the frames of unreadable lines.
    """
    packed_boxes, label_codes, broken_frames = bytearray(), dict[str, int](), set[int]()
    for line_number, line in iter_lines(path, faults):
        cells = line.split(None, len(DRONE_COLUMNS) - 1)
        try:
            if len(cells) != len(DRONE_COLUMNS):
                raise _NoSampleError(f"the line has {len(cells)} columns; give {' '.join(DRONE_COLUMNS)}")
            frame = _integer(cells[5], "frame", last_frame)
        except _NoSampleError as error:
            faults.add(f"{path.name}:{line_number}: {error}")
            continue
        try:
            object_id, corners, is_lost, label = _box(cells)
        except _NoSampleError as error:
            faults.add(f"{path.name}:{line_number}: {error}; frame {frame} is left out")
            broken_frames.add(frame)
            continue
        packed_boxes += _PACKED.pack(
            object_id, frame, label_codes.setdefault(label, len(label_codes)), is_lost, *corners
        )
    boxes = np.frombuffer(packed_boxes, _BOX)
    return boxes[np.argsort(boxes["frame"], kind="stable")], list(label_codes), broken_frames


def _box(cells: list[str]) -> tuple[int, list[float], bool, str]:
    object_id = _integer(cells[0], "id", _LARGEST)
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
    return object_id, corners, cells[6] == "1", label


def _integer(text: str, field_name: str, largest: int) -> int:
    # `int` also accepts signs, spaces, underscores and digits of other scripts
    is_number = len(text) <= len(str(_LARGEST)) and text.isascii() and text.isdecimal()
    if not is_number or int(text) > largest:
        raise _NoSampleError(f"{field_name} is {text[:60]!r}; give an integer from 0 to {largest}")
    return int(text)


def _last_frame(rate: float) -> int:
    """Return the last frame with a time within the limit of samples."""
    last_frame = LATEST_NS // frame_times(rate) - 1
    return min(max(last_frame, 0), _LARGEST)


def _observations(
    times_ns: Integers, sample_indices: Integers, boxes: _Boxes, classes: tuple[str | None, ...]
) -> Observations:
    """Return boxes as observations; `sample_indices` (n,) has the sample of each box."""
    object_ids, name_indices = np.unique(boxes["id"], return_inverse=True)
    box_count, corners = len(boxes), boxes["corners"]
    return Observations(
        times_ns=times_ns,
        sample=sample_indices,
        name=name_indices,
        names=[str(object_id) for object_id in object_ids.tolist()],
        class_code=boxes["label"],
        classes=classes,
        yaw=np.full(box_count, np.nan),
        uncertainty=np.zeros(box_count),
        # counter-clockwise corners if y points up
        shapes=FootprintBatch(
            part_start=np.arange(box_count + 1, dtype=np.int64),
            vertex_start=np.arange(box_count + 1, dtype=np.int64) * 4,
            vertices=corners[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2),
            radius=np.zeros(box_count),
            bottom=np.full(box_count, np.nan),
            top=np.full(box_count, np.nan),
        ),
        invalid=np.zeros(box_count, np.bool_),
        signals={},
    )


def _is_row(line: bytes) -> bool:
    cells = line.split(None, len(DRONE_COLUMNS) - 1)
    if len(cells) != len(DRONE_COLUMNS) or not (cells[0].isdigit() and cells[5].isdigit()):
        return False
    return all(flag in (b"0", b"1") for flag in cells[6:9])

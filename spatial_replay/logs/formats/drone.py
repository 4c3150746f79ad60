"""Annotations of the Stanford Drone Dataset: one box of one object in one frame a line."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.footprint import Concave, FootprintBatch
from spatial_replay.logs.formats.tracks import iter_lines
from spatial_replay.logs.messages import BLOCK_SAMPLES
from spatial_replay.logs.read_options import FaultList, Lost, frame_times
from spatial_replay.trace.observations import Observations, trace_from_observations
from spatial_replay.trace.sample import LATEST_NS
from spatial_replay.trace.trace import Trace

FRAMES_A_SECOND = 30.0
"""The rate of the dataset's videos."""

COLUMNS = ("id", "xmin", "ymin", "xmax", "ymax", "frame", "lost", "occluded", "generated", "label")

_LARGEST = 10**18 - 1
"""Any integer of so many digits fits 64 bits."""


_BLOCK_BOXES = 2**16
"""A block is closed when it holds this many, however few its frames are."""


class _NoBoxError(Exception):
    """A line that is not a box; the text says why and what to give instead."""


def is_annotations(head: bytes) -> bool:
    """Return whether some whole line at the beginning of a file is a row of annotations."""
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
    """Yield the frames of an `annotations.txt` in blocks; a frame that the file names is a sample.

    Files are ordered by object, so the first frame is complete only after the last line. All boxes are read
    first, as plain columns of 57 bytes a line; samples are built block by block.

    A frame with a line that cannot be read is left out as a whole and goes to `faults`.

    Args:
        concave: has no effect, since boxes are convex.
        rate: frames a second; frame 0 is at time 0.
        lost: whether rows marked as out of the picture are dropped or kept.
    """
    boxes, broken = _read_boxes(path, faults, _last_frame(rate))
    frames, starts = np.unique(boxes.frame, return_index=True)
    sound = ~np.isin(frames, np.fromiter(broken, np.int64))
    frames, starts, ends = frames[sound], starts[sound], np.append(starts[1:], len(boxes.frame))[sound]
    after = 0
    while after < len(frames):
        first = after
        filled = int(np.searchsorted(ends, starts[first] + _BLOCK_BOXES, side="right"))
        after = min(first + BLOCK_SAMPLES, max(filled, first + 1))
        block = slice(first, after)
        observations = _observations(boxes, frames[block], starts[block], ends[block], rate, lost)
        trace, left_out = trace_from_observations(observations, concave=concave)
        for index, what in sorted(left_out.items()):
            faults.add(f"{path.name}: frame {frames[first + index]}: {what}")
        yield trace


class _Boxes:
    """The lines of a file as columns, in the order of frames once `in_order` was called."""

    def __init__(self) -> None:
        self._numbers = {name: array("q") for name in ("id", "frame", "label")}
        self._corners = array("d")
        self._lost = array("b")
        self.labels: dict[str, int] = {}
        self.id = self.frame = self.label = np.zeros(0, np.int64)
        self.corners = np.zeros((0, 4))
        self.lost: NDArray[np.bool_] = np.zeros(0, np.bool_)

    def add(self, number: int, corners: list[float], frame: int, lost: bool, label: str) -> None:
        """Add one line."""
        code = self.labels.setdefault(label, len(self.labels))
        for name, value in (("id", number), ("frame", frame), ("label", code)):
            self._numbers[name].append(value)
        self._corners.extend(corners)
        self._lost.append(lost)

    def in_order(self) -> None:
        """Sort by frame, keeping the file's order within each."""
        frame = np.frombuffer(self._numbers["frame"], np.int64)
        order = np.argsort(frame, kind="stable")
        columns = (np.frombuffer(self._numbers[name], np.int64)[order] for name in ("id", "frame", "label"))
        self.id, self.frame, self.label = columns
        self.corners = np.frombuffer(self._corners, np.float64).reshape(-1, 4)[order]
        self.lost = np.frombuffer(self._lost, np.int8)[order].astype(np.bool_)
        self._numbers, self._corners, self._lost = {}, array("d"), array("b")


def _read_boxes(path: Path, faults: FaultList, last_frame: int) -> tuple[_Boxes, set[int]]:
    """Read every line that can be read; return the boxes, and the frames of the lines that cannot be read."""
    boxes = _Boxes()
    broken = set[int]()
    for number, line in iter_lines(path, faults):
        cells = line.split(None, len(COLUMNS) - 1)
        try:
            if len(cells) != len(COLUMNS):
                raise _NoBoxError(f"the line has {len(cells)} columns; give {' '.join(COLUMNS)}")
            frame = _integer(cells[5], "frame", last_frame)
        except _NoBoxError as error:
            faults.add(f"{path.name}:{number}: {error}")
            continue
        try:
            boxes.add(*_box(cells, frame))
        except _NoBoxError as error:
            faults.add(f"{path.name}:{number}: {error}; frame {frame} is left out")
            broken.add(frame)
    boxes.in_order()
    return boxes, broken


def _box(cells: list[str], frame: int) -> tuple[int, list[float], int, bool, str]:
    number = _integer(cells[0], "id", _LARGEST)
    try:
        corners = [float(cell) for cell in cells[1:5]]
    except ValueError:
        raise _NoBoxError(f"the box is {' '.join(cells[1:5])[:60]!r}; give four numbers") from None
    if corners[0] > corners[2] or corners[1] > corners[3]:
        raise _NoBoxError(f"the box is {' '.join(cells[1:5])[:60]!r}; give xmin ymin xmax ymax")
    if cells[6] not in ("0", "1"):
        raise _NoBoxError(f"lost is {cells[6][:60]!r}; give 0 or 1")
    label = cells[9].strip()
    if len(label) >= 2 and label[0] == label[-1] == '"':
        label = label[1:-1]
    return number, corners, frame, cells[6] == "1", label


def _integer(text: str, what: str, last: int) -> int:
    is_number = len(text) <= len(str(_LARGEST)) and text.isascii() and text.isdecimal()
    if not is_number or int(text) > last:
        raise _NoBoxError(f"{what} is {text[:60]!r}; give an integer from 0 to {last}")
    return int(text)


def _last_frame(rate: float) -> int:
    """Return the last frame whose time fits a sample."""
    last = LATEST_NS // frame_times(rate) - 1
    return min(max(last, 0), _LARGEST)


def _observations(
    boxes: _Boxes, frames: Integers, starts: Integers, ends: Integers, rate: float, lost: Lost
) -> Observations:
    """Return the boxes of some frames, those from `starts` up to `ends`."""
    counts = ends - starts
    sample = np.repeat(np.arange(len(frames), dtype=np.int64), counts)
    rows = np.concatenate([np.zeros(0, np.int64), *map(np.arange, starts, ends)])
    if lost == "drop":
        visible = ~boxes.lost[rows]
        sample, rows = sample[visible], rows[visible]
    numbers, name = np.unique(boxes.id[rows], return_inverse=True)
    period = frame_times(rate)
    return Observations(
        times_ns=np.array([round(frame * period) for frame in frames.tolist()], np.int64),
        sample=sample,
        name=name,
        names=[str(number) for number in numbers.tolist()],
        class_code=boxes.label[rows],
        classes=tuple(label or None for label in boxes.labels),
        yaw=np.full(len(rows), np.nan),
        uncertainty=np.zeros(len(rows)),
        shapes=_shapes(boxes.corners[rows]),
        invalid=np.zeros(len(rows), np.bool_),
        signals={},
    )


def _shapes(corners: Floats) -> FootprintBatch:
    """Return boxes from (R, 4) xmin, ymin, xmax, ymax, counter-clockwise where y grows upwards."""
    count = len(corners)
    return FootprintBatch(
        part_start=np.arange(count + 1, dtype=np.int64),
        vertex_start=np.arange(count + 1, dtype=np.int64) * 4,
        vertices=corners[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2),
        radius=np.zeros(count),
        bottom=np.full(count, np.nan),
        top=np.full(count, np.nan),
    )


def _is_row(line: bytes) -> bool:
    cells = line.split(None, len(COLUMNS) - 1)
    if len(cells) != len(COLUMNS) or not (cells[0].isdigit() and cells[5].isdigit()):
        return False
    return all(flag in (b"0", b"1") for flag in cells[6:9])

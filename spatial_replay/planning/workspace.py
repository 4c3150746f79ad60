"""The workspace: a grid of positions, orientations, reach and obstacles; and checks of such settings.

Checks collect what is wrong with all values, so that it is reported together.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.trace.sample import Sample

MOST_CELLS = 1_000_000
"""The most cells of a grid, over all orientations. Their maps take a gigabyte; more is a typing error."""

CELLS_AROUND = 80
"""Cells along the longer side of a default workspace."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A grid of square cells in the plane; a map has a value for the middle of each cell.

    Attributes:
        xmin, ymin: the corner of the first cell, in footprint units.
        cell_size: side of a cell, in footprint units.
        columns, rows: number of cells along x and along y.

    Raises:
        UsageError: invalid numbers, or more than `MOST_CELLS` cells.
    """

    xmin: float
    ymin: float
    cell_size: float
    columns: int
    rows: int

    def __post_init__(self) -> None:
        corner = {"xmin": self.xmin, "ymin": self.ymin}
        faults = number_faults(corner) + count_faults({"columns": self.columns, "rows": self.rows})
        if not (is_number(self.cell_size) and 0.0 < self.cell_size < math.inf):
            faults.append(f"cell_size is {self.cell_size!r}; give a finite number above 0")
        if not faults and self.columns * self.rows > MOST_CELLS:
            faults.append(
                f"a grid of {self.columns} x {self.rows} cells; give at most {MOST_CELLS:,} cells in all"
            )
        refuse_faults(faults)

    @classmethod
    def over(cls, xmin: float, ymin: float, xmax: float, ymax: float, cell_size: float) -> Grid:
        """Return the grid over a box; its last cells may extend beyond it.

        Raises:
            UsageError: an empty box, or invalid numbers.
        """
        box = f"the box ({xmin}, {ymin}, {xmax}, {ymax})"
        if not all(map(math.isfinite, (xmin, ymin, xmax, ymax))):
            raise UsageError(f"{box} is not finite; give four numbers")
        if not (xmin < xmax and ymin < ymax):
            raise UsageError(f"{box} is empty; give xmin, ymin, xmax, ymax")
        if not (is_number(cell_size) and cell_size > 0.0):
            raise UsageError(f"cell_size is {cell_size!r}; give a number above 0")
        # rounding must not add a cell to a box that is a whole number of cells long
        columns, rows = (math.ceil(length / cell_size - 1e-9) for length in (xmax - xmin, ymax - ymin))
        return cls(xmin, ymin, cell_size, columns, rows)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    def centres(self) -> Floats:
        """Return (rows * columns, 2): the middle of each cell, row by row."""
        x = self.xmin + (np.arange(self.columns) + 0.5) * self.cell_size
        y = self.ymin + (np.arange(self.rows) + 0.5) * self.cell_size
        centres = np.empty((*self.shape, 2))
        centres[:, :, 0], centres[:, :, 1] = x[None, :], y[:, None]
        return centres.reshape(-1, 2)

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """Return the middle (x, y) of a cell."""
        x = self.xmin + (column + 0.5) * self.cell_size
        return x, self.ymin + (row + 0.5) * self.cell_size

    def contains(self, points: Floats) -> Booleans:
        """Return whether each of the points (…, 2) lies in a cell, as (…)."""
        cells = (points - np.array([self.xmin, self.ymin])) / self.cell_size
        return np.asarray(((cells >= 0.0) & (cells < np.array([self.columns, self.rows]))).all(axis=-1))

    def reaching(self, x: float, y: float) -> Grid:
        """Return this grid, extended on up to two sides so that a point lies in it.

        A point farther away than the grid is long does not extend it.
        """
        row, column = self._cell(x, y)
        left, below = max(-column, 0), max(-row, 0)
        right, above = max(column + 1 - self.columns, 0), max(row + 1 - self.rows, 0)
        columns, rows = self.columns + left + right, self.rows + below + above
        added = max(left, below, right, above)
        if not added or added > max(self.shape) or columns * rows > MOST_CELLS:
            return self
        xmin, ymin = self.xmin - left * self.cell_size, self.ymin - below * self.cell_size
        return Grid(xmin, ymin, self.cell_size, columns, rows)

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Return the cell (row, column) of a point, or the nearest one to a point outside the grid."""
        row, column = self._cell(x, y)
        return min(max(row, 0), self.rows - 1), min(max(column, 0), self.columns - 1)

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        """Return the cell (row, column) of a point, as if the grid had no end."""
        return math.floor((y - self.ymin) / self.cell_size), math.floor((x - self.xmin) / self.cell_size)


@dataclass(frozen=True)
class Workspace:
    """The poses that a robot can bring objects to.

    Attributes:
        grid: the positions considered for the centre of an object.
        yaws: orientations in radians that an object may be given; empty to keep orientations. An object of
            unknown orientation is turned by these angles.
        keeps_yaw: whether an object may also keep the orientation that it has, and one of unknown
            orientation has to; settings that push say so.
        base: position (x, y) of the robot.
        nearest, farthest: the range of distances from the base that the robot reaches, in footprint units.
        obstacles: static obstacles, besides the objects of a sample.
        supports: names of objects on which others may be put; they are not obstacles.
        clearance: the least distance between objects, in footprint units.

    Raises:
        UsageError: invalid values, all of them reported.
    """

    grid: Grid
    yaws: tuple[float, ...] = ()
    base: tuple[float, float] = (0.0, 0.0)
    nearest: float = 0.0
    farthest: float = math.inf
    obstacles: tuple[Footprint, ...] = ()
    supports: frozenset[str] = field(default_factory=frozenset)
    clearance: float = 0.0
    keeps_yaw: bool = False

    def __post_init__(self) -> None:
        refuse_faults(self._faults())

    def _faults(self) -> Iterator[str]:
        yield from kind_faults("grid", self.grid, Grid, "a Grid")
        yield from kind_faults("yaws", self.yaws, tuple, "a tuple of angles in radians") or number_faults(
            {f"yaws[{place}]": yaw for place, yaw in enumerate(self.yaws)}
        )
        yield from point_faults("base", self.base)
        yield from self._size_faults()
        faults = number_faults({"nearest": self.nearest}, 0)
        yield from faults
        if not is_number(self.farthest):
            yield f"farthest is {self.farthest!r}; give a number, or math.inf"
        elif not faults and self.farthest < self.nearest:
            yield f"farthest is {self.farthest}; give at least nearest, {self.nearest}"
        yield from member_faults("obstacles", self.obstacles, tuple, Footprint, "a tuple of footprints")
        yield from member_faults("supports", self.supports, frozenset, str, "a frozenset of names")
        yield from number_faults({"clearance": self.clearance}, 0)

    def _size_faults(self) -> Iterator[str]:
        if isinstance(self.grid, Grid) and isinstance(self.yaws, tuple):
            cells, angles = self.grid.columns * self.grid.rows, len(self.yaws)
            if cells * angles > MOST_CELLS:
                yield (
                    f"a grid of {cells:,} cells in {angles:,} orientations; give at most {MOST_CELLS:,} "
                    "cells over all of them"
                )

    @classmethod
    def around(cls, sample: Sample) -> Workspace:
        """Return a workspace over all objects of a sample, with a margin of half their extent on each side.

        Raises:
            UsageError: the sample has no object.
        """
        tracked = [each for each in sample.objects.values() if isinstance(each, TrackedObject)]
        parts = [part for each in tracked for part in each.footprint.parts]
        if not parts:
            raise UsageError("there is nothing in the sample to lay a grid around; give a workspace")
        low = np.min([part.vertices.min(axis=0) - part.radius for part in parts], axis=0)
        high = np.max([part.vertices.max(axis=0) + part.radius for part in parts], axis=0)
        longer = float((high - low).max()) or 1.0
        (xmin, ymin), (xmax, ymax) = (low - longer / 2).tolist(), (high + longer / 2).tolist()
        return cls(Grid.over(xmin, ymin, xmax, ymax, 2.0 * longer / CELLS_AROUND))

    def turns(self, yaw: float | None) -> Floats:
        """Return (A,): the angles in radians by which an object of an orientation may be turned."""
        if not self.keeps_yaw:
            return np.array(self.yaws) - (yaw or 0.0) if self.yaws else np.zeros(1)
        # the shorter way round
        turned = () if yaw is None else (math.remainder(each - yaw, math.tau) for each in self.yaws)
        return np.array([0.0, *turned])

    def within_reach(self, grid: Grid) -> Booleans:
        """Return (rows, columns): whether the robot reaches the middle of each cell of a grid.

        Cells outside the workspace's own grid are out of reach.
        """
        if grid == self.grid and self.nearest <= 0.0 and self.farthest == math.inf:
            return np.ones(grid.shape, np.bool_)
        centres = grid.centres()
        distance = np.hypot(*(centres - np.array(self.base)).T)
        reached = (distance >= self.nearest) & (distance <= self.farthest) & self.grid.contains(centres)
        return np.asarray(reached.reshape(grid.shape))


def refuse_faults(faults: Iterable[str]) -> None:
    """Check that there are no faults.

    Raises:
        UsageError: with each fault on a line.
    """
    message = "\n".join(faults)
    if message:
        raise UsageError(message)


def is_number(value: object) -> bool:
    """Return whether a value is a number other than NaN; booleans are not numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)


def number_faults(values: Mapping[str, Any], least: float = -math.inf) -> list[str]:
    """Return what keeps values, by name, from being finite numbers of at least `least`."""
    wanted = "a finite number" if least == -math.inf else f"a finite number of at least {least:g}"
    return [
        f"{name} is {value!r}; give {wanted}"
        for name, value in values.items()
        if not (is_number(value) and math.isfinite(value) and value >= least)
    ]


def point_faults(name: str, value: Any) -> list[str]:
    """Return what keeps a value from being a point (x, y) of finite numbers."""
    if not isinstance(value, tuple) or len(value) != 2:
        return [f"{name} is {value!r}; give (x, y)"]
    return number_faults({f"{name}[{place}]": number for place, number in enumerate(value)})


def count_faults(values: Mapping[str, Any]) -> list[str]:
    """Return what keeps values, by name, from being whole numbers of at least 1."""
    return [
        f"{name} is {value!r}; give a whole number of at least 1"
        for name, value in values.items()
        if not isinstance(value, int) or isinstance(value, bool) or value < 1
    ]


def kind_faults(name: str, value: object, kind: type, wanted: str) -> list[str]:
    """Return what keeps a value from being of a type."""
    return [] if isinstance(value, kind) else [f"{name} is {value!r}; give {wanted}"]


def member_faults(
    name: str, members: Collection[Any], collection: type, member: type, wanted: str
) -> list[str]:
    """Return what keeps a value from being a collection with members of one type."""
    return kind_faults(name, members, collection, wanted) or [
        f"{name} has {each!r}; give {wanted}" for each in members if not isinstance(each, member)
    ]

"""Shortest paths over the free cells of a map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Booleans, Integers, read_only_integers
from spatial_replay.planning.path_kernel import search


@dataclass(frozen=True, eq=False)
class Path:
    """A path from cell to cell.

    Attributes:
        cells: (K, 2) rows and columns where it starts, turns and ends; in between it goes straight along
            rows, columns or diagonals.
        straight, diagonal: how many steps of each kind it has.
    """

    cells: Integers
    straight: int
    diagonal: int

    @property
    def length(self) -> float:
        """In cells."""
        return self.straight + math.sqrt(2.0) * self.diagonal


def shortest_path(free: Booleans, start: tuple[int, int], goals: Booleans) -> Path | None:
    """The shortest path from a cell to any goal, over free cells and past no corner of a blocked one.

    Found by jump-point search (Harabor and Grastien, 2011). The start need not be free.

    Args:
        free: (R, C), where the path may go.
        start: row and column.
        goals: (R, C), where it may end, if the cell is free.

    Returns:
        None where there is no path.

    Raises:
        UsageError: the start is outside, or the arrays differ in shape.
    """
    rows, columns = free.shape
    row, column = start
    if goals.shape != free.shape or not (0 <= row < rows and 0 <= column < columns):
        raise UsageError(f"no path from {start} over {free.shape} cells to goals among {goals.shape}")
    is_free = free.copy()
    is_free[row, column] = True
    ends = np.argwhere(goals & is_free)
    if not len(ends):
        return None
    first, last = ends.min(axis=0) + 1, ends.max(axis=0) + 1
    box = np.array([first[0], last[0], first[1], last[1]])
    # the border saves the search from looking where there are no cells
    cells = search(_bordered(is_free), _bordered(goals & is_free), box, row + 1, column + 1) - 1
    if not len(cells):
        return None
    steps = np.abs(np.diff(cells, axis=0))
    diagonal = int(steps.min(axis=1).sum())
    return Path(read_only_integers(cells), int(steps.max(axis=1).sum()) - diagonal, diagonal)


def _bordered(cells: Booleans) -> NDArray[np.int8]:
    return np.pad(cells, 1).astype(np.int8)

"""Shortest paths over the free cells of a grid, by jump-point search (Harabor and Grastien, 2011).

A step goes to one of the eight neighbours. A diagonal step needs both adjacent cells free, so that no corner
is cut. Among paths with the same steps in another order, the search follows only the path with its diagonal
steps first. It expands only goals and cells where a path may have to turn.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import kernel, piece
from spatial_replay.geometry.arrays import Booleans, Flags, Floats, Integers, read_only_integers

ROOT_2 = math.sqrt(2.0)


@dataclass(frozen=True, eq=False)
class Path:
    """A path over cells.

    Attributes:
        cells: (K, 2), rows and columns of the start, the turns and the end. Between them the path follows a
            row, a column or a diagonal.
        length: length, cells.
    """

    cells: Integers
    length: float


def shortest_path(free: Booleans, start: tuple[int, int], goals: Booleans) -> Path | None:
    """Return the shortest path over free cells from a cell to any goal; None if there is no path.

    Args:
        free: (R, C), whether a path may cross each cell; the start need not be free.
        start: row and column.
        goals: (R, C), whether a path may end in each cell, if the cell is free.
    """
    row, column = start
    is_free = free.copy()
    is_free[row, column] = True
    ends = np.argwhere(goals & is_free)
    if not len(ends):
        return None
    first, last = ends.min(axis=0) + 1, ends.max(axis=0) + 1
    box = np.array([first[0], last[0], first[1], last[1]])
    # with a border of blocked cells, the search needs no check of bounds
    cells = search(_add_border(is_free), _add_border(goals & is_free), box, row + 1, column + 1) - 1
    if not len(cells):
        return None
    steps = np.abs(np.diff(cells, axis=0))
    diagonal = int(steps.min(axis=1).sum())
    straight = int(steps.max(axis=1).sum()) - diagonal
    return Path(read_only_integers(cells), straight + ROOT_2 * diagonal)


def lengths_from(free: Booleans, start: tuple[int, int]) -> Floats:
    """Return the length of the shortest path from a cell to each cell, (rows, columns); inf without a path.

    Args:
        free: (R, C), whether a path may cross each cell; the start need not be free.
        start: row and column.
    """
    is_free = np.pad(free, 1)
    is_free[start[0] + 1, start[1] + 1] = True
    width, is_open = is_free.shape[1], is_free.ravel()
    lengths = np.full(is_free.size, np.inf)
    newest = np.array([(start[0] + 1) * width + start[1] + 1])
    lengths[newest] = 0.0
    # only cells that became nearer in the last round can bring others nearer
    while newest.size:
        nearer = []
        for down, right in product((-1, 0, 1), repeat=2):
            after, length = newest + down * width + right, ROOT_2 if down and right else 1.0
            # a diagonal step needs both adjacent cells free
            is_step = is_open[after] & is_open[newest + down * width] & is_open[newest + right]
            is_step &= lengths[newest] + length < lengths[after]
            lengths[after[is_step]] = lengths[newest[is_step]] + length
            nearer.append(after[is_step])
        newest = np.unique(np.concatenate(nearer))
    return np.asarray(lengths.reshape(is_free.shape)[1:-1, 1:-1])


def reachable(free: Booleans, cell: tuple[int, int]) -> Booleans:
    """Return the cells (rows, columns) that paths over free cells reach from a free cell."""
    reached = np.zeros(free.shape, np.bool_)
    reached[cell] = True
    while True:
        count = np.count_nonzero(reached)
        # four directions suffice, because a diagonal step needs both adjacent cells free
        for turns in range(4):
            # free cells behind a reached cell, without a blocked cell in between
            open_cells, view = np.rot90(free, turns), np.rot90(reached, turns)
            place = np.arange(len(view))[:, None]
            last_reached = np.maximum.accumulate(np.where(view, place, -1))
            view |= last_reached > np.maximum.accumulate(np.where(open_cells, -1, place))
        if np.count_nonzero(reached) == count:
            return reached


def _add_border(cells: Booleans) -> NDArray[np.int8]:
    return np.pad(cells, 1).astype(np.int8)


@kernel
def search(free: Flags, goals: Flags, box: Integers, start_row: int, start_column: int) -> Integers:
    """Return the shortest path from a cell to any goal.

    Args:
        free: (R, C), 1 for cells that a path may cross; the border must be 0.
        goals: (R, C), 1 for cells where a path may end; these cells must be free.
        box: (4,), first and last row with a goal, first and last column with a goal.

    Returns:
        (K, 2), the start, the turns and the goal; (0, 2) if there is no path.
    """
    rows, columns = free.shape
    straight = np.full(rows * columns, -1, np.int64)
    diagonal = np.zeros(rows * columns, np.int64)
    parent = np.full(rows * columns, -1, np.int64)
    closed = np.zeros(rows * columns, np.bool_)
    directions = np.zeros((8, 2), np.int64)
    first = start_row * columns + start_column
    straight[first] = 0
    # the number of the cell breaks ties, so that equal inputs give equal paths
    queue = [(_at_least(start_row, start_column, box), np.int64(first))]
    while len(queue) > 0:
        current = heapq.heappop(queue)[1]
        if closed[current]:
            continue
        closed[current] = True
        row, column = current // columns, current % columns
        if goals[row, column]:
            return _turns(parent, current, columns)
        if parent[current] < 0:
            count = 0
            for down in range(-1, 2):
                for right in range(-1, 2):
                    if down != 0 or right != 0:
                        directions[count, 0], directions[count, 1] = down, right
                        count += 1
        else:
            down = _sign(row - parent[current] // columns)
            right = _sign(column - parent[current] % columns)
            count = _directions(free, row, column, down, right, directions)
        for number in range(count):
            down, right = directions[number, 0], directions[number, 1]
            is_diagonal = down != 0 and right != 0
            if is_diagonal:
                steps = _jump_diagonal(free, goals, row, column, down, right)
            else:
                steps = _jump_straight(free, goals, row, column, down, right)
            if steps == 0:
                continue
            cell = (row + steps * down) * columns + column + steps * right
            new_straight = straight[current] + (0 if is_diagonal else steps)
            new_diagonal = diagonal[current] + (steps if is_diagonal else 0)
            # computed from step counts, so that equally long paths have bitwise equal lengths
            length = new_straight + ROOT_2 * new_diagonal
            if straight[cell] >= 0 and straight[cell] + ROOT_2 * diagonal[cell] <= length:
                continue
            straight[cell], diagonal[cell] = new_straight, new_diagonal
            parent[cell] = current
            least_ahead = _at_least(row + steps * down, column + steps * right, box)
            heapq.heappush(queue, (length + least_ahead, np.int64(cell)))
    return np.zeros((0, 2), np.int64)


@piece
def _at_least(row: int, column: int, box: Integers) -> float:
    """Return a lower bound of the distance to the goals: the distance to their box without obstacles."""
    rows = max(box[0] - row, row - box[1], 0)
    columns = max(box[2] - column, column - box[3], 0)
    return float(abs(rows - columns) + ROOT_2 * min(rows, columns))


@piece
def _directions(free: Flags, row: int, column: int, down: int, right: int, ways: Integers) -> int:
    """Write the possible next directions after a step into `ways`, and return their number."""
    if down != 0 and right != 0:
        ways[0, 0], ways[0, 1] = down, 0
        ways[1, 0], ways[1, 1] = 0, right
        ways[2, 0], ways[2, 1] = down, right
        return 3
    ways[0, 0], ways[0, 1] = down, right
    count = 1
    for side in (-1, 1):
        aside_down, aside_right = side * right, side * down
        beside_row, beside_column = row + aside_down, column + aside_right
        if free[beside_row, beside_column] and not free[beside_row - down, beside_column - right]:
            ways[count, 0], ways[count, 1] = aside_down, aside_right
            ways[count + 1, 0], ways[count + 1, 1] = down + aside_down, right + aside_right
            count += 2
    return count


@piece
def _jump_diagonal(free: Flags, goals: Flags, row: int, column: int, down: int, right: int) -> int:
    """Return the number of diagonal steps to the next cell where a path may turn or end; 0 for none."""
    steps = 0
    while True:
        if not (free[row + down, column] and free[row, column + right] and free[row + down, column + right]):
            return 0
        row += down
        column += right
        steps += 1
        if goals[row, column]:
            return steps
        if _jump_straight(free, goals, row, column, down, 0):
            return steps
        if _jump_straight(free, goals, row, column, 0, right):
            return steps


@piece
def _jump_straight(free: Flags, goals: Flags, row: int, column: int, down: int, right: int) -> int:
    """Return the number of straight steps to the next cell where a path may turn or end; 0 for none."""
    steps = 0
    while True:
        row += down
        column += right
        steps += 1
        if not free[row, column]:
            return 0
        if goals[row, column]:
            return steps
        for side in (-1, 1):
            beside_row, beside_column = row + side * right, column + side * down
            # the side cell is free, but the cell before it is blocked: its shortest path turns here
            if free[beside_row, beside_column] and not free[beside_row - down, beside_column - right]:
                return steps


@piece
def _sign(value: int) -> int:
    # numpy refuses to subtract booleans, and the kernel also runs uncompiled
    return int(value > 0) - int(value < 0)


@piece
def _turns(parent: Integers, last: np.int64, columns: int) -> Integers:
    """Return the cells (K, 2) from the start to `last`, by their parents."""
    count = 1
    at = last
    while parent[at] >= 0:
        at = parent[at]
        count += 1
    cells = np.empty((count, 2), np.int64)
    at = last
    for k in range(count - 1, -1, -1):
        cells[k, 0], cells[k, 1] = at // columns, at % columns
        at = parent[at]
    return cells

"""Shortest paths over the free cells of a grid, by jump-point search (Harabor and Grastien, 2011).

A step goes to one of the eight neighbours. A diagonal step needs both adjacent cells free, so that no corner
is cut. Among paths that differ only in the order of their steps, the search follows the path with diagonal
steps first. It expands only goals, and cells where a path may have to turn.
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
        cells: (K, 2), rows and columns of the start, the turns and the end. Between these cells, the path
            follows a row, a column or a diagonal.
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
    goal_cells = np.argwhere(goals & is_free)
    if not len(goal_cells):
        return None
    first_goal, last_goal = goal_cells.min(axis=0) + 1, goal_cells.max(axis=0) + 1
    goal_box = np.array([first_goal[0], last_goal[0], first_goal[1], last_goal[1]])
    # with a border of blocked cells, the search needs no check of bounds
    cells = search(_add_border(is_free), _add_border(goals & is_free), goal_box, row + 1, column + 1) - 1
    if not len(cells):
        return None
    steps = np.abs(np.diff(cells, axis=0))
    diagonal_steps = int(steps.min(axis=1).sum())
    straight_steps = int(steps.max(axis=1).sum()) - diagonal_steps
    return Path(read_only_integers(cells), straight_steps + ROOT_2 * diagonal_steps)


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
    newest_cells = np.array([(start[0] + 1) * width + start[1] + 1])
    lengths[newest_cells] = 0.0
    # only cells with a shorter length since the last round can shorten other lengths
    while newest_cells.size:
        nearer_cells = []
        for down, right in product((-1, 0, 1), repeat=2):
            neighbours, step_length = newest_cells + down * width + right, ROOT_2 if down and right else 1.0
            # a diagonal step needs both adjacent cells free
            is_step = (
                is_open[neighbours] & is_open[newest_cells + down * width] & is_open[newest_cells + right]
            )
            is_step &= lengths[newest_cells] + step_length < lengths[neighbours]
            lengths[neighbours[is_step]] = lengths[newest_cells[is_step]] + step_length
            nearer_cells.append(neighbours[is_step])
        newest_cells = np.unique(np.concatenate(nearer_cells))
    return np.asarray(lengths.reshape(is_free.shape)[1:-1, 1:-1])


def reachable(free: Booleans, cell: tuple[int, int]) -> Booleans:
    """Return whether a path over free cells leads from a free cell to each cell, (rows, columns)."""
    reached = np.zeros(free.shape, np.bool_)
    reached[cell] = True
    while True:
        reached_count = np.count_nonzero(reached)
        # four directions suffice, because a diagonal step needs both adjacent cells free
        for quarter_turns in range(4):
            # free cells behind a reached cell, without a blocked cell in between
            open_cells, reached_view = np.rot90(free, quarter_turns), np.rot90(reached, quarter_turns)
            row_indices = np.arange(len(reached_view))[:, None]
            last_reached = np.maximum.accumulate(np.where(reached_view, row_indices, -1))
            reached_view |= last_reached > np.maximum.accumulate(np.where(open_cells, -1, row_indices))
        if np.count_nonzero(reached) == reached_count:
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
    straights = np.full(rows * columns, -1, np.int64)
    diagonals = np.zeros(rows * columns, np.int64)
    parents = np.full(rows * columns, -1, np.int64)
    is_closed = np.zeros(rows * columns, np.bool_)
    directions = np.zeros((8, 2), np.int64)
    start_cell = start_row * columns + start_column
    straights[start_cell] = 0
    # the number of the cell breaks ties, so that equal inputs give equal paths
    queue = [(_at_least(start_row, start_column, box), np.int64(start_cell))]
    while len(queue) > 0:
        cell = heapq.heappop(queue)[1]
        if is_closed[cell]:
            continue
        is_closed[cell] = True
        row, column = cell // columns, cell % columns
        if goals[row, column]:
            return _turns(parents, cell, columns)
        if parents[cell] < 0:
            direction_count = 0
            for down in range(-1, 2):
                for right in range(-1, 2):
                    if down != 0 or right != 0:
                        directions[direction_count, 0], directions[direction_count, 1] = down, right
                        direction_count += 1
        else:
            down = _sign(row - parents[cell] // columns)
            right = _sign(column - parents[cell] % columns)
            direction_count = _directions(free, row, column, down, right, directions)
        for direction in range(direction_count):
            down, right = directions[direction, 0], directions[direction, 1]
            is_diagonal = down != 0 and right != 0
            if is_diagonal:
                steps = _jump_diagonal(free, goals, row, column, down, right)
            else:
                steps = _jump_straight(free, goals, row, column, down, right)
            if steps == 0:
                continue
            next_cell = (row + steps * down) * columns + column + steps * right
            new_straight = straights[cell] + (0 if is_diagonal else steps)
            new_diagonal = diagonals[cell] + (steps if is_diagonal else 0)
            # computed from step counts, so that equally long paths have bitwise equal lengths
            length = new_straight + ROOT_2 * new_diagonal
            if straights[next_cell] >= 0 and straights[next_cell] + ROOT_2 * diagonals[next_cell] <= length:
                continue
            straights[next_cell], diagonals[next_cell] = new_straight, new_diagonal
            parents[next_cell] = cell
            least_ahead = _at_least(row + steps * down, column + steps * right, box)
            heapq.heappush(queue, (length + least_ahead, np.int64(next_cell)))
    return np.zeros((0, 2), np.int64)


@piece
def _at_least(row: int, column: int, box: Integers) -> float:
    """Return a lower bound of the distance to the goals: the distance to the goals' box without obstacles."""
    row_gap = max(box[0] - row, row - box[1], 0)
    column_gap = max(box[2] - column, column - box[3], 0)
    return float(abs(row_gap - column_gap) + ROOT_2 * min(row_gap, column_gap))


@piece
def _directions(free: Flags, row: int, column: int, down: int, right: int, directions: Integers) -> int:
    """Write the possible next directions after a step into `directions`, and return their number.

    A direction is (`down`, `right`): rows and columns per step, -1, 0 or 1.
    """
    if down != 0 and right != 0:
        directions[0, 0], directions[0, 1] = down, 0
        directions[1, 0], directions[1, 1] = 0, right
        directions[2, 0], directions[2, 1] = down, right
        return 3
    directions[0, 0], directions[0, 1] = down, right
    direction_count = 1
    for side in (-1, 1):
        aside_down, aside_right = side * right, side * down
        beside_row, beside_column = row + aside_down, column + aside_right
        if free[beside_row, beside_column] and not free[beside_row - down, beside_column - right]:
            directions[direction_count, 0], directions[direction_count, 1] = aside_down, aside_right
            directions[direction_count + 1, 0], directions[direction_count + 1, 1] = (
                down + aside_down,
                right + aside_right,
            )
            direction_count += 2
    return direction_count


@piece
def _jump_diagonal(free: Flags, goals: Flags, row: int, column: int, down: int, right: int) -> int:
    """Return the number of diagonal steps to the next cell where a path may turn or end, or 0.

    A step goes `down` rows and `right` columns, each -1 or 1.
    """
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
    """Return the number of straight steps to the next cell where a path may turn or end, or 0.

    A step goes `down` rows and `right` columns, each -1, 0 or 1.
    """
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
            # the side cell is free, and its predecessor is blocked: its shortest path turns here
            if free[beside_row, beside_column] and not free[beside_row - down, beside_column - right]:
                return steps


@piece
def _sign(value: int) -> int:
    # numpy refuses to subtract booleans, and the kernel also runs uncompiled
    return int(value > 0) - int(value < 0)


@piece
def _turns(parents: Integers, last: np.int64, columns: int) -> Integers:
    """Return the cells (K, 2) from the start to `last`, by their parents."""
    cell_count = 1
    cell = last
    while parents[cell] >= 0:
        cell = parents[cell]
        cell_count += 1
    cells = np.empty((cell_count, 2), np.int64)
    cell = last
    for k in range(cell_count - 1, -1, -1):
        cells[k, 0], cells[k, 1] = cell // columns, cell % columns
        cell = parents[cell]
    return cells

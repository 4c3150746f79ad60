from __future__ import annotations

import heapq
import math
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay.planning.paths import shortest_path

ROOT_2 = math.sqrt(2.0)


def length_by_a_star(free, start, goals):
    """The length of a shortest path by plain best-first search over all cells, or None."""
    free = free.copy()
    free[start] = True
    best = {start: (0, 0)}
    queue = [(0.0, start)]
    done = set()
    while queue:
        _, cell = heapq.heappop(queue)
        if cell in done:
            continue
        done.add(cell)
        if goals[cell] and free[cell]:
            return best[cell][0] + ROOT_2 * best[cell][1]
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                other = cell[0] + down, cell[1] + right
                if (down, right) == (0, 0) or not is_step(free, cell, other):
                    continue
                diagonal = down != 0 and right != 0
                steps = best[cell][0] + (not diagonal), best[cell][1] + diagonal
                length = steps[0] + ROOT_2 * steps[1]
                if other not in best or length < best[other][0] + ROOT_2 * best[other][1]:
                    best[other] = steps
                    heapq.heappush(queue, (length, other))
    return None


def is_step(free, cell, other):
    """Whether one may go from a cell to a neighbour: never between two blocked cells, nor past a corner."""
    rows, columns = free.shape
    if not (0 <= other[0] < rows and 0 <= other[1] < columns):
        return False
    return bool(free[other] and free[cell[0], other[1]] and free[other[0], cell[1]])


def cells_of(path):
    """Every cell that a path goes over."""
    cells = [tuple(path.cells[0].tolist())]
    for turn in path.cells[1:].tolist():
        while cells[-1] != tuple(turn):
            down, right = (int(np.sign(to - at)) for at, to in zip(cells[-1], turn, strict=True))
            cells.append((cells[-1][0] + down, cells[-1][1] + right))
    return cells


@st.composite
def mazes(draw):
    rows, columns = draw(st.integers(1, 14)), draw(st.integers(1, 14))
    share = draw(st.sampled_from([0.1, 0.25, 0.4, 0.55]))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    free = random.random((rows, columns)) >= share
    start = draw(st.integers(0, rows - 1)), draw(st.integers(0, columns - 1))
    goals = random.random((rows, columns)) < draw(st.sampled_from([0.01, 0.05, 0.3]))
    return free, start, goals


@given(mazes())
def test_a_path_is_shortest_and_crosses_only_free_cells(maze):
    free, start, goals = maze
    path = shortest_path(free, start, goals)
    expected = length_by_a_star(free, start, goals)
    assert (None if path is None else path.length) == expected
    if path is not None:
        cells = cells_of(path)
        free = free.copy()
        free[start] = True
        assert cells[0] == start
        assert goals[cells[-1]]
        assert all(is_step(free, at, to) for at, to in pairwise(cells))


def test_large_grids_agree_with_plain_search():
    for seed in range(12):
        random = np.random.default_rng(seed)
        free = random.random((90, 90)) >= 0.05 + 0.03 * seed
        goals = np.zeros((90, 90), bool)
        goals[80:90, 80:90] = True
        path = shortest_path(free, (2, 3), goals)
        assert (None if path is None else path.length) == length_by_a_star(free, (2, 3), goals)


def test_a_path_around_a_wall_does_not_cut_its_corner():
    free = np.ones((5, 5), bool)
    free[1:, 2] = False
    goals = np.zeros((5, 5), bool)
    goals[4, 4] = True
    path = shortest_path(free, (4, 0), goals)
    assert (0, 1) in cells_of(path)
    assert (0, 3) in cells_of(path)


def test_a_start_that_is_a_goal_is_a_path():
    free = np.zeros((2, 2), bool)
    goals = np.ones((2, 2), bool)
    path = shortest_path(free, (1, 1), goals)
    assert path.length == 0.0
    assert path.cells.tolist() == [[1, 1]]


def test_without_a_goal_there_is_no_path():
    assert shortest_path(np.ones((3, 3), bool), (0, 0), np.zeros((3, 3), bool)) is None

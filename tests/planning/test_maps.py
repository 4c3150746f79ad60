from __future__ import annotations

import math

import numpy as np
import pytest

import spatial_replay as sr
from spatial_replay import UsageError
from spatial_replay.geometry.footprint import centre_of
from spatial_replay.planning import Grid, Workspace
from spatial_replay.planning.maps import (
    CONSTRAINED,
    FREE,
    OCCUPIED,
    OUT_OF_REACH,
    gradient_map,
    proposition_maps,
)

CUP = sr.TrackedObject(sr.Footprint.box(0, 0, 1, 1))
SAMPLE = sr.Sample(0, {"cup": CUP, "mat": sr.Footprint.box(4, 4, 8, 8), "jug": sr.Footprint.disc(1, 6, 1)})
GRID = Grid.over(0, 0, 10, 10, 1.0)


def propositions(*texts):
    return [sr.parse_specification(text).specs[0].formula for text in texts]


def maps(workspace, *texts, sample=SAMPLE):
    return proposition_maps(propositions(*texts), {}, sample, "cup", workspace)


def test_a_map_is_best_in_the_middle_of_the_enclosing_object():
    found = gradient_map(maps(Workspace(GRID), "cup enclosedin mat"), (((0, True),),), (), Workspace(GRID))
    row, column = np.unravel_index(int(np.argmax(found.robustness[0])), GRID.shape)
    assert GRID.centre(int(row), int(column)) in {(5.5, 5.5), (5.5, 6.5), (6.5, 5.5), (6.5, 6.5)}
    assert found.robustness[0, 5, 5] == 1.0


def test_a_centre_moves_with_its_object():
    turned = Workspace(GRID, yaws=(0.0, math.pi / 2), obstacles=(sr.Footprint.disc(9.5, 9.5, 0.2),))
    found = maps(turned, "center(cup) dist center(mat) <= 1", "center(jug) dist cup >= 1")
    to_mat = np.hypot(*(GRID.centres() - (6.0, 6.0)).T)
    assert found.lower[0].reshape(2, -1) == pytest.approx(np.tile(1.0 - to_mat, (2, 1)), abs=1e-12)
    assert found.lower[1, 0][GRID.cell(1.5, 9.5)] == pytest.approx(2.0)


def test_blocked_cells_have_a_reason():
    workspace = Workspace(
        GRID,
        base=(5.0, 5.0),
        farthest=6.0,
        obstacles=(sr.Footprint.disc(8.5, 1.5, 0.25),),
        supports=frozenset({"mat"}),
    )
    found = gradient_map(
        maps(workspace, "cup enclosedin mat", "0.4 <= cup dist mat <= 1.5"),
        (((0, True),),),
        (((1, True),),),
        workspace,
    )
    blocked = found.blocked[0]
    assert blocked[GRID.cell(0.5, 0.5)] == OUT_OF_REACH
    assert blocked[GRID.cell(1.5, 6.5)] == OCCUPIED
    assert blocked[GRID.cell(8.5, 1.5)] == OCCUPIED
    assert blocked[GRID.cell(9.5, 7.5)] == CONSTRAINED
    assert blocked[GRID.cell(5.5, 5.5)] == FREE
    assert (np.isnan(found.values) == (found.blocked != FREE)).all()


def test_an_object_that_is_not_a_support_is_in_the_way():
    found = gradient_map(maps(Workspace(GRID), "cup enclosedin mat"), (((0, True),),), (), Workspace(GRID))
    assert found.blocked[0][GRID.cell(5.5, 5.5)] == OCCUPIED


def test_a_blocked_set_is_the_minkowski_sum_of_obstacle_and_object():
    grid = Grid.over(0, 0, 10, 10, 0.25)
    workspace = Workspace(grid, obstacles=(sr.Footprint.box(5, 5, 6, 7),))
    sample = sr.Sample(0, {"cup": sr.Footprint.box(0, 0, 1, 2)})
    found = gradient_map(maps(workspace, "true", sample=sample), ((),), (), workspace)
    centres = grid.centres().reshape(*grid.shape, 2)
    x, y = centres[..., 0], centres[..., 1]
    inside = (x >= 4.5) & (x <= 6.5) & (y >= 4) & (y <= 8)
    assert ((found.blocked[0] == OCCUPIED) == inside).all()


def test_a_proposition_about_other_objects_is_the_same_in_every_cell():
    found = maps(Workspace(GRID), "jug leftof mat")
    assert np.unique(found.lower).tolist() == [2.0]


def test_a_missing_object_makes_every_cell_unknown():
    workspace = Workspace(GRID)
    found = maps(workspace, "cup leftof spoon", "cup below mat")
    assert gradient_map(found, (((0, True),),), (), workspace).best() == -math.inf
    assert (gradient_map(found, (((1, True),),), (((0, True),),), workspace).blocked == CONSTRAINED).all()


def test_a_margin_keeps_away_from_constraints():
    workspace = Workspace(GRID)
    found = maps(workspace, "cup leftof mat", "cup dist jug <= 2")
    narrow, wide = (
        gradient_map(found, (((0, True),),), (((1, True),),), workspace, margin).blocked == CONSTRAINED
        for margin in (0.0, 1.5)
    )
    assert narrow.sum() < wide.sum()
    assert (wide | ~narrow).all()


def test_there_is_a_map_for_each_orientation():
    fork = sr.TrackedObject(sr.Footprint.box(0, 0, 4, 0.5), yaw=0.0)
    knife = sr.TrackedObject(sr.Footprint.box(6, 6, 6.5, 9), yaw=math.pi / 2)
    sample = sr.Sample(0, {"cup": fork, "knife": knife})
    workspace = Workspace(GRID, yaws=(0.0, math.pi / 2))
    found = maps(workspace, "cup oriented[0.1] knife", "cup below knife", sample=sample)
    assert found.lower.shape == (2, 2, 10, 10)
    assert (found.lower[0, 0] < 0).all()
    assert np.allclose(found.lower[0, 1], 0.1)


def test_propositions_over_earlier_samples_have_no_map():
    with pytest.raises(UsageError, match="looks at earlier samples"):
        maps(Workspace(GRID), "cup moved[1] cup[-1]")


def test_an_object_outside_the_sample_cannot_be_moved():
    with pytest.raises(UsageError, match=r"spoon.*the sample has: cup, mat, jug"):
        proposition_maps([], {}, SAMPLE, "spoon", Workspace(GRID))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((0, 0, 0, 1, 0.1), "empty"),
        ((0, 0, 1, 1, 0.0), "cell_size"),
        ((0, 0, 1e9, 1e9, 0.1), "cells"),
        ((0, 0, math.inf, 1, 0.1), "finite"),
        ((0, 0, 1, 1, math.inf), "cell_size"),
        ((0, 0, 1, 1, "1"), "cell_size is '1'"),
    ],
)
def test_invalid_grids_are_refused(numbers, message):
    with pytest.raises(UsageError, match=message):
        Grid.over(*numbers)


def test_a_grid_has_whole_numbers_of_cells():
    with pytest.raises(UsageError, match=r"columns is 2.5(.|\n)*rows is 0(.|\n)*cell_size is -1"):
        Grid(0, 0, -1, 2.5, 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"yaws": (math.nan,)}, "finite"),
        ({"base": (math.inf, 0.0)}, "finite"),
        ({"nearest": 2.0, "farthest": 1.0}, "farthest is 1.0; give at least nearest, 2.0"),
        ({"nearest": -1.0, "clearance": "1"}, r"nearest is -1.0(.|\n)*clearance is '1'"),
        ({"farthest": math.nan}, "farthest is nan"),
        ({"base": 3.0}, "base is 3.0"),
        ({"base": (1.0, 2.0, 3.0)}, r"base is \(1.0, 2.0, 3.0\); give \(x, y\)"),
        ({"base": ("a", 2.0)}, r"base\[0\] is 'a'"),
        ({"yaws": 0.5}, "yaws is 0.5"),
        ({"supports": "plate"}, "supports is 'plate'"),
        ({"obstacles": (1,)}, "obstacles has 1"),
        ({"grid": (0, 0, 1, 1)}, "grid is"),
    ],
)
def test_invalid_workspaces_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        Workspace(**{"grid": GRID, **options})


def test_the_centre_of_points_is_their_mean():
    points = sr.Footprint.union([sr.Footprint.disc(0, 0, 0), sr.Footprint.disc(4, 2, 0)])
    assert centre_of(points) == (2.0, 1.0)
    assert centre_of(sr.Footprint.union([points, sr.Footprint.disc(1, 1, 1)])) == (1.0, 1.0)

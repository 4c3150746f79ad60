"""What is said before the first motion of what cannot be done, and targets narrower than a cell."""

from __future__ import annotations

from dataclasses import replace

import pytest

import spatial_replay as sr
from planning.kinematics import block, run
from spatial_replay import Planner, Settings
from spatial_replay.planning import Grid, Workspace

TABLE = Settings(
    Workspace(Grid.over(0, 0, 10, 7, 0.25), clearance=0.05),
    movable=("a", "b"),
    margin=0.02,
    constraint_margin=0.02,
)
THINGS = {"a": block(1, 1, size=1), "b": block(1, 5, size=1)}
TRAY = "region tray = box(5, 2, 8, 5)\n"


def reason(text, things=None, settings=TABLE):
    """Return why there is no path; nothing may have been moved."""
    objects = {**THINGS, **(things or {})}
    steps, _ = run(Planner(sr.parse_specification(f"{TRAY}spec s = {text}"), settings), objects)
    assert [step.kind for step in steps] == ["no path"]
    _, _, what = steps[0].reason.partition("what cannot be done: ")
    return what


@pytest.mark.parametrize("goal", ["a enclosedin tray", "a enclosedin tray and b above a"])
def test_what_stands_where_an_object_would_have_to_be_is_named(goal):
    why = reason(f"F ({goal})", {"can": block(6.5, 3.5, size=1.8)})
    assert why == "a enclosedin tray: can, which cannot be moved, stands wherever a would have to be"


def test_what_cannot_hold_together_is_named_with_what_stands_there():
    why = reason(
        "F (a enclosedin tray and b enclosedin tray and a leftof b)", {"can": block(7.2, 3.5, size=1.5)}
    )
    assert "a enclosedin tray and b enclosedin tray" in why
    assert "no places were found for all at once; can, which cannot be moved, stands there" in why


def test_a_place_that_is_too_small_is_said_to_be():
    why = reason("(F (b enclosedin tray)) and F (a enclosedin tiny)\nregion tiny = box(1, 3, 1.5, 3.5)")
    assert "a enclosedin tiny" in why
    assert "is missing at best" in why


def test_what_forbids_every_way_is_named():
    wall = sr.TrackedObject(sr.Footprint.box(3, -9, 3.5, 16))
    why = reason("(F (a enclosedin tray)) and G (a dist wall >= 0.3)", {"wall": wall})
    assert (
        why == "a: on every way there a constraint would hold, on the shortest one not (a dist wall >= 0.3)"
    )


def test_a_target_that_is_narrower_than_a_cell_is_found_between_cells():
    slot = "F (a enclosedin slot)\nregion slot = box(5.57, 2.57, 6.63, 3.63)"
    specification = sr.parse_specification(f"spec s = {slot}")
    steps, table = run(Planner(specification, TABLE), THINGS)
    assert [step.kind for step in steps] == ["execute", "hold"]
    assert steps[0].target.robustness >= TABLE.margin
    assert sr.evaluate(specification, sr.Trace.from_samples(table.samples)).verdict == "satisfied"
    in_turn = sr.parse_specification(f"spec s = (F (b enclosedin tray)) and {slot}\n{TRAY}")
    steps, _ = run(Planner(in_turn, TABLE), THINGS)
    assert [step.kind for step in steps] == ["execute", "execute", "hold"]


def test_where_cells_are_too_large_the_setting_is_named():
    slot = "F (a enclosedin slot)\nregion slot = box(5.57, 2.57, 6.63, 3.63)"
    assert "; smaller cells (cell_size) may help" in reason(slot, settings=replace(TABLE, skill="push"))

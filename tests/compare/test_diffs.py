"""Diffs of recorded and planned runs, of runs at different speeds, and of regions and groups."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import spatial_replay as sr
from compare.planned_runs import with_another_decision


def blocks(data: Path, name: str) -> tuple[sr.Trace, str]:
    """Every fifth sample of a recording of the paper, and its specification."""
    trace = sr.read_trace(data / "paper" / f"{name}.jsonl.gz")
    text = json.loads((data / "paper" / "expected.json").read_text())[name]["spec"]
    return trace.take(np.arange(0, len(trace), 5)), text


def test_a_goal_that_moved_is_named_with_the_node_that_no_longer_holds(data_folder: Path) -> None:
    trace, text = blocks(data_folder, "blocks_moving_passage")
    old = sr.parse_specification(text)
    moved = sr.parse_specification(text.replace("(250, 350), (50, 350)", "(250, 250), (50, 250)"))
    diff = sr.diff_specifications(trace, old, moved).spec("blocks")
    assert (str(diff.old.verdict), str(diff.new.verdict)) == ("satisfied", "violated")
    (cause,) = diff.cause
    assert (cause.kind, cause.subject, cause.spec) == ("region", "redGoal", "reach")
    assert cause.new == "red1 enclosedin redGoal"
    assert diff.new_places[cause].text.startswith("region redGoal")
    again = text.replace("region redGoal", "region  redGoal").replace("(250, 350)", "(250.0, 350)")
    assert sr.diff_specifications(trace, old, sr.parse_specification(again)).is_empty


def test_blocks_that_miss_their_goals_are_named_with_the_nodes_they_fail(data_folder: Path) -> None:
    trace, text = blocks(data_folder, "blocks_moving_passage")
    other, _ = blocks(data_folder, "blocks_move_violation")
    (spec,) = sr.diff_logs(trace, other, sr.parse_specification(text)).specs
    assert spec.is_flipped
    assert "F (red1 enclosedin redGoal)" in [spec.a.nodes[node].text for node in spec.nodes]
    assert {each.name for each in spec.moved} == {"red1", "red2", "green1", "green2"}


def test_an_object_that_differs_from_the_first_sample_on_comes_first() -> None:
    def run(*places: tuple[float, float]) -> sr.Trace:
        return sr.Trace.from_samples(
            sr.Sample(
                10**9 * second,
                {"cup": sr.Footprint.disc(cup, 0, 0.1), "plate": sr.Footprint.disc(plate, 5, 0.1)},
            )
            for second, (cup, plate) in enumerate(places)
        )

    specification = sr.parse_specification("spec near = G (cup dist plate <= 9)")
    diff = sr.diff_logs(run((0, 0), (0, 0), (0, 0)), run((1, 0), (1, 0), (1, 9)), specification)
    assert [(entry.name, entry.apart_ns) for entry in diff.objects] == [("cup", 0), ("plate", 2 * 10**9)]


ROUND = """\
spec near = cup dist plate <= 1
spec away = F ((cup dist plate <= 1) and F (cup dist plate >= 4))
"""


def drive(speed: float, waits_s: int = 0) -> sr.Trace:
    """A cup that waits, comes to a plate and leaves it; a sample each second."""
    plate = sr.Footprint.box(0, 0, 1, 1)
    ways = np.concatenate([np.zeros(waits_s), np.arange(0.0, 16.0 + speed / 2, speed)])
    return sr.Trace.from_samples(
        sr.Sample(10**9 * second, {"plate": plate, "cup": sr.Footprint.box(x, 0, x + 1, 1)})
        for second, x in enumerate((np.abs(8.0 - ways) + 1.25).tolist())
    )


def test_runs_of_different_speeds_are_aligned_by_their_progress() -> None:
    fast, slow = drive(1.0), drive(0.5)
    # the automaton of the first spec, which has no temporal operator, has no progress to align by
    specification = sr.parse_specification(ROUND)
    (by_time,) = sr.diff_logs(fast, slow, specification).objects
    by_progress = sr.diff_logs(fast, slow, specification, align="progress")
    assert by_progress.alignment is not None
    assert by_progress.alignment.about == "away"
    by_name = sr.diff_logs(fast, slow, specification, align="progress:away").alignment
    assert by_name is not None
    assert (by_name.about, by_name.knots) == ("away", by_progress.alignment.knots)
    with pytest.raises(sr.UsageError, match="did you mean 'away'"):
        sr.diff_logs(fast, slow, specification, align="progress:awy")
    assert len(by_progress.alignment.knots) >= 3
    assert by_time.greatest_shift > 5.0
    # between two changes of state the cup moves evenly, so that each sample has its counterpart
    assert all(each.greatest_shift <= 1.0 for each in by_progress.objects)
    assert not by_progress.is_empty


def test_runs_are_aligned_by_an_event() -> None:
    early, late = drive(1.0), drive(1.0, waits_s=7)
    specification = sr.parse_specification(ROUND)
    (by_time,) = sr.diff_logs(early, late, specification).objects
    by_event = sr.diff_logs(early, late, specification, align="near")
    assert by_time.greatest_shift > 5.0
    assert by_event.objects == ()
    assert by_event.alignment is not None
    ((a_ns, b_ns),) = by_event.alignment.knots
    assert b_ns - a_ns == 7 * 10**9


def test_of_planned_runs_the_first_decision_that_differs_is_named_with_its_maps(tmp_path: Path) -> None:
    run = Path(__file__).resolve().parents[2] / "recordings" / "push.mcap"
    diff = sr.diff_logs(run, with_another_decision(run, tmp_path / "other.mcap"))
    assert not diff.objects
    assert diff.decision is not None
    assert diff.decision.number == 1
    assert diff.decision.b == f"differently: {diff.decision.a}"
    assert len(diff.decision.maps) == 1
    assert "decision 1 is the first that differs" in repr(diff)
    same = sr.diff_logs(run, run)
    assert same.decision is None
    assert same.is_empty


def test_signals_with_other_values_are_listed_and_other_units_noticed() -> None:
    def run(values: list[float]) -> sr.Trace:
        cup = sr.Footprint.box(0, 0, 1, 1)
        return sr.Trace.from_samples(
            sr.Sample(second * 10**9, {"cup": cup}, {"battery": value, "speed": 1.0})
            for second, value in enumerate(values)
        )

    levels = [0.9, 0.8, 0.7]
    (battery,) = sr.diff_logs(run(levels), run([0.9, 0.8, 0.4])).signals
    assert (battery.name, battery.first_ns, battery.greatest_difference) == ("battery", 2 * 10**9, 0.7 - 0.4)
    diff = sr.diff_logs(run(levels), run([100 * level for level in levels]))
    assert not diff.is_empty
    assert "100 times as large in B: it may be in another unit there" in repr(diff)


def test_squares_differ_by_their_corners_alone() -> None:
    # one square turned into another: centre, spread and every sum over the corners stay
    corners = [(5, 0), (0, 5), (-5, 0), (0, -5)], [(3, 4), (-4, 3), (-3, -4), (4, -3)]
    one, other = (
        sr.Trace.from_samples([sr.Sample(0, {"tile": sr.Footprint.polygon(each)})]) for each in corners
    )
    (tile,) = sr.diff_logs(one, other).objects
    assert tile.name == "tile"
    assert tile.greatest_shift == 0.0
    assert tile.greatest_distance < 0.0


def test_a_group_under_another_name_is_the_same_group() -> None:
    text = "group NAME = red, green\nspec clear = G (NAME dist blue >= 1)"
    boxes = {name: sr.Footprint.box(x, 0, x + 1, 1) for name, x in (("red", 0), ("green", 2), ("blue", 5))}
    trace = sr.Trace.from_samples([sr.Sample(0, boxes)])
    old, new = (sr.parse_specification(text.replace("NAME", name)) for name in ("reds", "obstacles"))
    diff = sr.diff_specifications(trace, old, new)
    assert diff.is_empty, diff
    fewer = sr.parse_specification(text.replace("red, green", "red").replace("NAME", "reds"))
    edits = [edit for spec in sr.diff_specifications(trace, old, fewer).specs for edit in spec.edits]
    assert [(edit.kind, edit.subject) for edit in edits] == [("group", "reds")]


TWICE = """\
const near = 4  # how near
region goal = box(0, 0, 9, 9)
def beside(x, y) = x dist y <= near
spec calm = G (beside(red, green) and beside(green, blue)) and F (red dist blue <= near)
spec safe = G (forall x in all: x enclosedin goal) and F (red dist blue <= near)
"""


def three_blocks() -> sr.Trace:
    boxes = {name: sr.Footprint.box(x, 0, x + 1, 1) for name, x in (("red", 0), ("green", 2), ("blue", 4))}
    return sr.Trace.from_samples([sr.Sample(0, boxes)])


def test_an_edited_declaration_is_one_edit_with_its_line_however_often_it_is_used() -> None:
    old, new = (sr.parse_specification(TWICE.replace("near = 4", f"near = {near}")) for near in (4, 3.5))
    diff = sr.diff_specifications(three_blocks(), old, new)
    for spec in diff.specs:
        ((edit, place),) = spec.new_places.items()
        assert (edit.kind, edit.subject, place.line, place.text) == (
            "constant",
            "near",
            1,
            "const near = 3.5",
        )
        assert spec.old_places[edit].text == "const near = 4"
    assert repr(diff).count("+ <text>:1: const near = 3.5") == 1


def test_where_each_of_two_edits_flips_a_verdict_by_itself_that_is_said() -> None:
    new = TWICE.replace("near = 4", "near = 0.5").replace("x dist y <= near", "x dist y <= near and x ovlp y")
    diff = sr.diff_specifications(three_blocks(), *map(sr.parse_specification, (TWICE, new))).spec("calm")
    assert [edit.subject for edit in diff.cause] == ["near", "beside"]
    assert "each of these 2 edits is enough by itself; to get the old verdict back, undo both" in repr(
        [*diff.sentences(0)]
    )


@pytest.mark.parametrize(
    "edits",
    [
        {"goal": "target"},
        {"F (red dist blue <= near)": "(F ((red dist blue <= near)))"},
        {"beside(red, green) and beside(green, blue)": "(beside(green, blue)) and ((beside(red, green)))"},
        {"# how near": "", "near = 4": "near = 4.0 in [0, 4]"},
        {"x in all: x": "each in all: each", "beside(x, y)": "beside(y, x)", "x dist y": "y dist x"},
        {"const near = 4  # how near\n": "", "region": "const near = 4\nregion"},
        {"region goal": "const unused = 3\nregion goal"},
    ],
)
def test_edits_without_another_meaning_are_no_difference(edits: dict[str, str]) -> None:
    text = TWICE
    for before, after in edits.items():
        text = text.replace(before, after)
    diff = sr.diff_specifications(three_blocks(), *map(sr.parse_specification, (TWICE, text)))
    assert text != TWICE
    assert diff.is_empty, diff
    assert "edited" not in repr(diff)


@pytest.mark.parametrize(
    ("before", "after", "kind"),
    [
        (" and far_off", "", "removed"),
        ("and far_off", "and (not far_off)", "replaced"),
        ("far_off", "near", "replaced"),
        ("cup leftof plate", "cup rightof plate", "replaced"),
        ("x dist cup <= 1", "x dist cup <= 2", "constant"),
    ],
)
def test_what_was_edited_is_one_edit_with_its_line_though_specs_refer_to_others(
    before: str, after: str, kind: str
) -> None:
    text = """\
group plates = class "plate"
spec near = F (cup dist plate <= 1)
spec far_off = F (cup dist plate >= 4)
spec whole = F (cup leftof plate and cup ovlp plate) and far_off and G exists x in plates: x dist cup <= 1
"""
    declarations, whole = text.split("spec whole")
    edited = f"{declarations}spec whole{whole.replace(before, after)}"
    versions = sr.parse_specification(text), sr.parse_specification(edited)
    diff = sr.diff_specifications(drive(1.0), *versions).spec("whole")
    (edit,) = diff.edits
    assert (edit.kind, edit.spec) == (kind, "whole")
    assert (diff.old_places[edit].line, diff.new_places[edit].line) == (4, 4)
    assert diff.old_places[edit].text != diff.new_places[edit].text
    assert edit.kind != "constant" or edit.new == "x dist cup <= 2"

"""A log in memory, evaluated again with other values for the constants of its specifications."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from replay.runs import PAST, STEP_NS, PiecewiseSource, run
from spatial_replay import LogError, SpecificationError, UsageError
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.loaded_log import Evaluated, LoadedLog, constant_text, constant_values
from spatial_replay.replay.selection import ReplayOptions, Window

TEXT = """\
const far = {far}
const soon = {soon}
region goal = box(4, -1, 9, 2)
spec reach = F[0s, soon] (cube enclosedin goal)
spec apart = G (cube dist "cup 物" >= far)
spec both = reach and apart
"""
WRITTEN = TEXT.format(far="0.5", soon="2s")


def specification(text: str = WRITTEN, name: str = "blocks.spatial") -> sr.Specification:
    return sr.parse_specification(text, filename=name)


def loaded(*files: sr.Specification, size: int = 5, window: Window | None = None) -> LoadedLog:
    return LoadedLog(
        PiecewiseSource(run(40), size), files or [specification()], ReplayOptions(window or Window())
    )


def numbers(evaluated: Evaluated) -> list[np.ndarray]:
    return [stretch.series for stretch in evaluated.stretches]


def assert_equal(evaluated: Evaluated, evaluation: sr.Evaluation) -> None:
    expected = [result.series for result in evaluation.results]
    for own, other in zip(numbers(evaluated), expected, strict=True):
        np.testing.assert_array_equal(own, other)


DISTANCES = st.floats(-3.0, 3.0).map(lambda number: round(number, 3))
SECONDS = st.integers(1, 40).map(lambda number: f"{number / 4}s")


@examples(25)
@given(DISTANCES, SECONDS, st.integers(1, 41))
def test_other_values_give_the_numbers_of_the_edited_text(far: float, soon: str, size: int) -> None:
    evaluated = loaded(size=size).evaluate({"far": far, "soon": soon})
    edited = specification(TEXT.format(far=far, soon=soon))
    assert_equal(evaluated, sr.evaluate(edited, run(40)))


@examples(25)
@given(st.lists(st.tuples(DISTANCES, SECONDS), min_size=1, max_size=4))
def test_earlier_values_change_no_number(tried: list[tuple[float, str]]) -> None:
    held = loaded()
    for far, soon in tried:
        held.evaluate({"far": far, "soon": soon})
    assert_equal(held.evaluate(), sr.evaluate(specification(), run(40)))


def test_written_and_present_values_of_constants_are_reported() -> None:
    held = loaded()
    assert {name: constant_text(each) for name, each in held.constants.items()} == {
        "far": "0.5",
        "soon": "2s",
    }
    evaluated = held.evaluate({"far": 1})
    assert constant_values(evaluated.edited.constants) == {"far": 1.0, "soon": "2s"}
    assert constant_values(held.constants) == {"far": 0.5, "soon": "2s"}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"fat": 1.0}, "did you mean 'far'"),
        ({"far": "1"}, "far cannot be '1': it is a number"),
        ({"soon": 2.0}, "a duration, given as a text such as '2s'"),
        ({"soon": "two"}, "soon"),
        ({"far": float("nan")}, "finite number"),
        ({"far": float("inf")}, "finite number"),
    ],
)
def test_invalid_values_are_refused(values: dict[str, float | str], said: str) -> None:
    held = loaded()
    with pytest.raises(UsageError, match=said):
        held.evaluate(values)
    assert_equal(held.evaluate(), sr.evaluate(specification(), run(40)))


def test_a_value_that_makes_a_specification_invalid_is_refused() -> None:
    text = 'const wide = 0.5\nspec near = G (cube dist enlarge("cup 物", wide) >= 0)\n'
    held = loaded(specification(text))
    with pytest.raises(SpecificationError):
        held.evaluate({"wide": -1.0})


def test_a_constant_of_two_files_is_named_after_its_file() -> None:
    other = 'const far = 0.25\nconst own = 0.1\nspec wide = G (cube dist enlarge("cup 物", own) >= far)\n'
    held = loaded(specification(), specification(other, "wide.spatial"))
    assert list(held.constants) == ["blocks.far", "soon", "wide.far", "own"]
    evaluated = held.evaluate({"wide.far": 0.75})
    assert constant_values(evaluated.edited.constants)["blocks.far"] == 0.5
    assert constant_values(evaluated.edited.constants)["wide.far"] == 0.75
    with pytest.raises(UsageError, match=r"blocks\.far"):
        held.evaluate({"far": 1.0})


@pytest.mark.parametrize("window", [Window(2 * STEP_NS), Window(0, 20 * STEP_NS), Window(STEP_NS, every=3)])
def test_a_window_gives_the_numbers_of_a_replay(window: Window) -> None:
    held = LoadedLog(PiecewiseSource(run(40), 7), [specification(WRITTEN + PAST)], ReplayOptions(window))
    replayed = run_replay(
        PiecewiseSource(run(40), 4),
        [specification(WRITTEN + PAST)],
        ReplayOptions(window),
        keep_series=True,
    )
    expected = [result.series for result in replayed.results]
    for own, other in zip(numbers(held.evaluate()), expected, strict=True):
        assert other is not None
        np.testing.assert_array_equal(own, other)


def test_a_template_is_evaluated_for_its_objects() -> None:
    text = "const far = 0.5\nspec calm(ego) = G (ego dist cube >= far)\n"
    source = PiecewiseSource(run(12), 5)
    held = LoadedLog(source, [specification(text)], ReplayOptions(each={"ego": "class:dish"}))
    assert [tree.object for tree in held.evaluate({"far": 0.0}).evaluation.trees] == ["cup 物"]


def test_a_log_or_a_window_without_samples_is_an_error() -> None:
    with pytest.raises(LogError):
        LoadedLog(PiecewiseSource(run(0), 5), [specification()])
    with pytest.raises(UsageError, match="window"):
        loaded(window=Window(10**15))


def test_results_have_witnesses() -> None:
    evaluated = loaded().evaluate({"far": 4.0})
    assert evaluated.verdict == "violated"
    [both] = evaluated.replayed.results
    assert both.can_explain
    assert both.witness().verdict == "violated"

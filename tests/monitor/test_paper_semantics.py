"""The paper's own semantics: Def. 16 to the letter, and what the published code does beyond the run's end."""

from __future__ import annotations

import json
from math import inf, nan

import numpy as np
import pytest

from monitor.scenes import SECOND, judged, numbers, points, root
from monitor.test_published import SCENES, TOLERANCE, sample_from_frame
from spatial_replay import Monitor, Trace, UsageError, evaluate, parse_specification, read_trace
from spatial_replay.monitor.semantics import PaperRun
from spatial_replay.spec.formula import Atom, Signal, Temporal


def value(text, trace, **options):
    """The root's value on every prefix."""
    return root(text, trace, semantics="paper", **options).value.tolist()


def same(found, expected):
    return found == pytest.approx(expected, abs=0, nan_ok=True)


# ---------------------------------------------------------------- what others publish and have worked out


@pytest.fixture
def vectors(data_folder):
    cases = json.loads((data_folder / "vectors" / "semantics.json").read_text())["cases"]
    chosen = [case for case in cases if case["semantics"] == "paper"]
    assert len(chosen) > 50
    return chosen


def test_vectors_of_another_implementation(vectors):
    for case in vectors:
        trace = Trace.from_samples(map(sample_from_frame, case["frames"]))
        found = value(case["spec"], trace)
        expected = [nan if number is None else float(number) for number in case["value"]]
        np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE, err_msg=case["spec"])


def test_a_monitor_gives_the_same_bits_sample_by_sample(vectors):
    for case in vectors:
        specification = parse_specification(case["spec"])
        samples = list(map(sample_from_frame, case["frames"]))
        whole = evaluate(specification, Trace.from_samples(samples), semantics="paper").result()
        monitor = Monitor(specification, semantics="paper")
        updates = [monitor.update(sample).specs[0].numbers for sample in samples]
        assert np.stack(updates, axis=-1).tobytes() == whole.series.tobytes()


@pytest.mark.parametrize("scene", SCENES)
def test_scenes_of_the_paper_at_every_sample(data_folder, scene):
    expected = json.loads((data_folder / "paper" / "expected.json").read_text())[scene]
    trace = read_trace(data_folder / "paper" / f"{scene.removesuffix('_modified')}.jsonl.gz")
    specification, start_ns = (
        parse_specification(expected["spec"]),
        int(trace.times_ns[expected["start_sample"]]),
    )
    result = evaluate(specification, trace, semantics="paper", start_ns=start_ns).result()
    np.testing.assert_allclose(result.nodes[0].value, expected["value"], rtol=0, atol=TOLERANCE)
    assert result.verdict == ("satisfied" if expected["final"] >= 0 else "violated")
    first = expected["first_satisfied_sample"]
    assert result.first_satisfied_ns == (None if first is None else trace.times_ns[first])
    monitor = Monitor(specification, semantics="paper", start_ns=start_ns)
    updates = [monitor.update(sample).specs[0].numbers for sample in trace.samples()]
    assert np.stack(updates[expected["start_sample"] :], axis=-1).tobytes() == result.series.tobytes()


def test_objects_that_appear_one_by_one_leave_the_robustness_undetermined(data_folder):
    expected = json.loads((data_folder / "paper" / "expected.json").read_text())["table_scene5_parked"]
    trace = read_trace(data_folder / "paper" / "table_scene5.jsonl.gz")
    result = evaluate(parse_specification(expected["spec"]), trace, semantics="paper").result()
    assert result.verdict == "unknown"
    assert np.isnan(result.nodes[0].value).all()


# ------------------------------------------------------------------------------------- the run's end


def test_next_is_left_out_at_the_last_sample():
    trace = numbers(p=[3, -1, 2, -4])
    assert same(value("X p >= 0", trace), [nan, -1, -1, -1])
    assert same(value("X X p >= 0", trace), [nan, nan, 2, 2])
    assert same(value("F X p >= 0", trace), [nan, -1, 2, 2])
    assert same(value("G X p >= 0", trace), [nan, -1, -1, -4])
    assert same(value("p >= 0 and X p >= 0", trace), [3, -1, -1, -1])
    assert same(value("not X p >= 0", trace), [nan, 1, 1, 1])
    assert same(value("(X p >= 0) -> p >= 1", trace), [2, 2, 2, 2])
    assert same(value("p >= 0 xor X p >= 0", trace), [3, 1, 1, 1])


def test_an_empty_window_is_left_out():
    trace = numbers(p=[3, -1, 2, -4])
    assert same(value("F[2,3] p >= 0", trace), [nan, nan, 2, 2])
    assert same(value("G[2,3] p >= 0", trace), [nan, nan, 2, -4])
    assert same(value("p >= 0 U[1,2] p >= 1", trace), [nan, -2, -1, -1])
    assert same(value("G F[2,2] p >= 0", trace), [nan, nan, 2, -4])
    assert same(value("p >= 0 -> F[2,3] p >= 0", trace), [-3, -3, 2, 2])


def test_windows_in_seconds_go_by_the_samples_times():
    trace = numbers(p=[3, -1, 2, -4])
    assert same(value("G[1s,2s] p >= 0", trace), [nan, -1, -1, -1])
    assert same(value("F[1500ms,2500ms] p >= 0", trace), [nan, nan, 2, 2])
    assert same(value("F[1200ms,1800ms] p >= 0", trace), [nan, nan, nan, nan])
    assert same(value("F[2s,inf] p >= 0", trace), [nan, nan, 2, 2])


def test_terms_that_look_back_before_the_log_are_left_out():
    trace = points(a=[0, 3, 4, 9])
    assert same(value("a dist a[-1] <= 2", trace), [nan] * 4)
    assert same(value("G a dist a[-1] <= 2", trace), [nan, -1, -1, -3])
    assert same(value("a dist a[-1] <= 2 or a dist a <= 7", trace), [7, 7, 7, 7])
    assert same(value("F a dist a[-1500ms] >= 0", trace), [nan, nan, 4, 6])
    assert same(value("G a dist a[-1] <= 2", trace, start_ns=SECOND), [-1, -1, -3])


def test_a_result_of_samples_that_are_left_out_says_what_it_was_tested_by():
    (result,) = judged("spec s = (a dist a[-1] <= 1) and true", points(a=[0]), semantics="paper")
    assert (result.robustness, result.tested) == (inf, "full")


def test_quantifiers_are_left_out_as_a_whole():
    trace = points(a=[0, 3, 4], b=[1, 1, 1])
    assert same(value("G forall x in all: x dist x[-1] <= 2 and x dist b <= 9", trace), [nan, -1, -1])
    assert same(value("G forall x in all: x dist b <= 2", trace), [1, 0, -1])


# --------------------------------------------------------------------------- windows and until, to the letter


def test_a_bounded_operator_ignores_samples_after_its_window():
    trace = numbers(p=[5, 4, 3, 2, 1], q=[-1, -1, 4, -1, -1])
    assert same(value("F[0,1] G p >= 0", trace), [5, 4, 4, 4, 4])
    assert root("F[0,1] G p >= 0", trace).value.tolist() == [5, 4, 3, 2, 1]
    assert same(value("G[0,1] F q >= 0", trace), [-1, -1, -1, -1, -1])
    assert root("G[0,1] F q >= 0", trace).value.tolist() == [-1, -1, 4, 4, 4]


def test_the_left_operand_of_until_holds_up_to_the_end_and_there_too():
    trace = numbers(p=[3, 3, -2, -2], q=[-5, -5, 4, 9])
    assert same(value("p >= 0 U q >= 0", trace), [-5, -5, -2, -2])
    assert root("p >= 0 U q >= 0", trace).value.tolist() == [-5, -5, 3, 3]


def test_the_left_operand_of_until_ignores_samples_after_the_end():
    trace = numbers(p=[-1, 5, -1], q=[2, 2, 2])
    assert same(value("(F p >= 0) U q >= 0", trace), [-1, 2, 2])
    trace = numbers(p=[4, 3, -9], q=[1, 2, 5])
    assert same(value("(G p >= 0) U q >= 0", trace), [1, 2, 2])


def test_a_bounded_until_begins_with_its_window():
    trace = numbers(p=[-7, 3, 2, 1], q=[9, 0, 5, 8])
    assert same(value("p >= 0 U[1,2] q >= 0", trace), [nan, 0, 2, 2])
    assert root("p >= 0 U[1,2] q >= 0", trace).value.tolist() == [-inf, -7, -7, -7]
    # the published code takes the least, over the window, of until from there
    trace = numbers(p=[9, 9, 9, 9], q=[9, 5, -3, 1])
    assert same(value("p >= 0 U[1,2] q >= 0", trace), [nan, 5, 5, 5])


def test_until_leaves_out_operands_beyond_the_run():
    trace = numbers(p=[3, -2, 5], q=[4, 4, 4])
    assert same(value("(X p >= 0) U q >= 0", trace), [4, 4, 4])
    assert same(value("p >= 0 U X q >= 0", trace), [3, 3, 3])
    assert same(value("(X p >= 0) U X q >= 0", trace), [nan, 4, 4])


# ------------------------------------------------------------------------------------------ every node


def test_now_is_the_node_at_the_newest_sample_alone():
    result = judged("G (p >= 0 -> F[1,2] q >= 0)", numbers(p=[1, 2, 3], q=[-4, 5, -6]), semantics="paper")
    always, implies, p, eventually, q = result.result().nodes
    for node, expected in (
        (always, [-1, -2, -3]),
        (implies, [-1, -2, -3]),
        (p, [1, 2, 3]),
        (eventually, [nan, nan, nan]),
        (q, [-4, 5, -6]),
    ):
        assert same(node.now.tolist(), expected), node.text
        np.testing.assert_array_equal(node.lower, node.value)
        np.testing.assert_array_equal(node.upper, node.value)
    assert same(eventually.value.tolist(), [nan, 5, 5])
    assert same(always.value.tolist(), [-1, -2, -3])


def test_numbers_that_depend_on_something_unknown_are_undetermined():
    trace = points(a=[0, 0, 0, 0], b=[1, None, 1, 1])
    result = judged("G a dist b <= 2", trace, semantics="paper").result()
    assert same(result.nodes[0].value.tolist(), [1, nan, nan, nan])
    assert same(result.nodes[0].now.tolist(), [1, nan, 1, 1])
    assert (result.verdict, result.nodes[0].verdict) == ("unknown", "unknown")
    assert np.isnan(result.robustness)
    assert same(value("F (a dist b <= 2 or a dist a <= 7)", trace), [7, nan, nan, nan])
    assert same(value("F[0,0] a dist b <= 2", trace), [1, 1, 1, 1])
    assert same(value("F[2,3] a dist b <= 2", trace), [nan, nan, 1, 1])
    assert same(value("X a dist b <= 2", trace), [nan, nan, nan, nan])


def test_uncertainty_does_not_count():
    trace = points(a=[0, 0], b=[1, 2], uncertainty=5.0)
    assert same(value("F a dist b >= 1.5", trace), [-0.5, 0.5])
    assert judged("F a dist b >= 1.5", trace, semantics="paper").verdict == "satisfied"


@pytest.mark.parametrize(("p", "verdict"), [(1, "satisfied"), (0, "satisfied"), (-1, "violated")])
def test_the_verdict_is_the_sign_and_never_pending(p, verdict):
    monitor = Monitor(parse_specification("G p >= 0"), semantics="paper", start_ns=SECOND)
    samples = list(numbers(p=[7, p, 5, None]).samples())
    assert [monitor.update(sample).verdict for sample in samples] == ["unknown", verdict, verdict, "unknown"]


def test_a_template_starts_with_its_object():
    specification = parse_specification(
        "group others = all\nspec s(ego) = G ego dist (others except ego) >= 1"
    )
    trace = points(a=[None, 0, 0, None], b=[0, 1, 3, 3], classes={"a": "person"})
    result = evaluate(specification, trace, semantics="paper", each={"ego": "class:person"}).result()
    assert same(result.nodes[0].value.tolist(), [0, 0])


# --------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    "formula", ["p >= 0 W q >= 0", "p >= 0 R q >= 0", "WX p >= 0", "O p >= 0", "G H p >= 0", "F Y p >= 0"]
)
def test_other_operators_are_refused_with_their_place(formula):
    specification = parse_specification(f"spec fine = F p >= 0\nspec odd = {formula}", filename="odd.spatial")
    operator = next(word for word in formula.split() if word in ("W", "R", "WX", "O", "H", "Y"))
    for refuse in (
        lambda: Monitor(specification, semantics="paper"),
        lambda: evaluate(specification, numbers(p=[1], q=[1]), semantics="paper"),
    ):
        with pytest.raises(
            UsageError, match=rf"odd.spatial:2:\d+: .* has no {operator}, which odd uses; write"
        ):
            refuse()
    assert evaluate(specification, numbers(p=[1], q=[1])).result("odd").name == "odd"


def test_too_many_pairs_of_samples_are_refused():
    p, q = (Atom(name, "signal", Signal(name)) for name in "pq")
    formula = Temporal("G", (Temporal("U", (Temporal("F", (p,)), Temporal("G", (q,)))),))
    run = PaperRun(formula, (p, q), max_pairs=10)
    leaves = np.zeros((1, 2, 4))
    run.extend(leaves, np.arange(4))
    with pytest.raises(UsageError, match="over 8 samples, an until of two temporal operands"):
        run.extend(leaves, np.arange(4, 8))
    with pytest.raises(UsageError, match="over 50,000 samples"):
        PaperRun(formula, (p, q)).extend(np.zeros((1, 2, 50_000)), np.arange(50_000))

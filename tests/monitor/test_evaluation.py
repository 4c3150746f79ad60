"""Evaluating a specification over a trace: results, windows, and errors."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import pytest

from monitor.scenes import SECOND, judged, numbers, points, root
from spatial_replay import Monitor, Trace, UsageError, Verdict, evaluate, parse_specification
from spatial_replay.monitor.atoms.instructions import MAX_BINDINGS
from spatial_replay.monitor.online.program import MAX_VARIABLES
from spatial_replay.monitor.verdict import final_verdict, online_verdict, worst_verdict

TWO_SPECS = """\
spec near = F a dist b <= 2
spec low = G p >= 0
spec both = near and low
spec high = F p >= 9
"""


@pytest.fixture
def trace():
    return points(a=[0, 0, 0], b=[5, 1, 4], signals={"p": [3, 1, 2]})


# ----------------------------------------------------------------------------------------- what comes back


def test_results_are_the_specs_that_no_other_uses(trace):
    evaluation = judged(TWO_SPECS, trace)
    assert [(result.name, result.verdict) for result in evaluation] == [
        ("both", "satisfied"),
        ("high", "violated"),
    ]
    assert evaluation.verdict == "violated"
    assert evaluation.semantics == "ltlf"
    assert repr(evaluation) == (
        "<Evaluation: violated; <both: satisfied, robustness 1>, <high: violated, robustness -6>>"
    )


def test_every_node_of_the_tree_has_its_numbers(trace):
    nodes = judged(TWO_SPECS, trace).result("both").nodes
    assert [(node.id, node.parent, node.operator, node.name) for node in nodes] == [
        (0, None, "and", "both"),
        (1, 0, "F", "near"),
        (2, 1, "dist", None),
        (3, 0, "G", "low"),
        (4, 3, "signal", None),
    ]
    assert nodes[2].text == "a dist b <= 2"
    assert [node.value.tolist() for node in nodes] == [
        [-3, 1, 1],
        [-3, 1, 1],
        [-3, -3, -3],
        [3, 1, 1],
        [3, 3, 3],
    ]
    assert nodes[2].now.tolist() == [-3, 1, -2]
    assert [node.robustness for node in nodes] == [1, 1, -3, 1, 3]
    assert [str(node.verdict) for node in nodes[:2]] == ["satisfied", "satisfied"]


def test_a_node_is_selected_by_the_name_of_its_spec(trace):
    evaluation = judged(TWO_SPECS, trace)
    assert evaluation.node("near").robustness == 1
    assert evaluation.result("both").node("low").robustness == 1
    with pytest.raises(UsageError, match=r"no node is named 'far'; there are both, high, low, near"):
        evaluation.node("far")
    with pytest.raises(UsageError, match=r"no node is named 'high' in 'both'; there are both, near, low"):
        evaluation.result("both").node("high")


def test_an_unknown_node_name_is_answered_with_the_nearest(trace):
    specification = parse_specification(TWO_SPECS)
    evaluation = evaluate(specification, trace)
    update = Monitor(specification).update(next(iter(trace.samples())))
    for found in (evaluation, evaluation.result("both"), update):
        with pytest.raises(
            UsageError, match=r"no node is named 'nera'.*; did you mean 'near'\? there are both"
        ):
            found.node("nera")


def test_names_missing_from_the_trace_are_reported(trace):
    text = "region b = box(0, 0, 1, 1)\nspec s = (F (aa ovlp b)) and (G q >= 0) and F a ovlp b"
    evaluation = judged(text, trace)
    assert [(each.severity, each.line, each.message) for each in evaluation.remarks] == [
        ("warning", 1, "the log has an object 'b', which this definition hides"),
        ("warning", 2, "the log never has the object 'aa'"),
        ("warning", 2, "the log never has the signal 'q'"),
    ]
    assert "did you mean 'a'?" in evaluation.remarks[1].hint
    assert judged(TWO_SPECS, trace).remarks == ()


def test_an_object_absent_only_from_the_window_is_not_reported():
    trace = points(a=[0, None, None], b=[1, 1, 1])
    assert judged("F a ovlp b", trace, start_ns=SECOND).remarks == ()


def test_a_result_is_selected_by_name(trace):
    evaluation = judged(TWO_SPECS, trace)
    assert evaluation.result("high").robustness == -6
    with pytest.raises(UsageError, match=r"2 results fit name=None, object=None; there are both, high"):
        evaluation.result()
    with pytest.raises(UsageError, match=r"0 results fit name='near'.*: node\('near'\)"):
        evaluation.result("near")


def test_results_cannot_be_written_to(trace):
    result = judged(TWO_SPECS, trace).result("both")
    for array in (result.times_ns, result.series, result.final, result.nodes[0].value):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_the_first_satisfied_sample_counts_even_if_that_is_lost_later():
    result = judged("G p >= 0", numbers(p=[1, 1, -1])).result()
    assert result.first_satisfied_ns == 0
    assert result.verdict == "violated"
    assert judged("F p >= 0", numbers(p=[-1, -1, 2])).result().first_satisfied_ns == 2 * SECOND
    assert judged("F p >= 5", numbers(p=[-1, -1, 2])).result().first_satisfied_ns is None


def test_the_worst_verdict_is_that_of_all():
    satisfied, pending, unknown, violated = (
        Verdict.SATISFIED,
        Verdict.PENDING,
        Verdict.UNKNOWN,
        Verdict.VIOLATED,
    )
    assert worst_verdict([satisfied, unknown, violated, pending]) == violated
    assert worst_verdict([satisfied, pending, unknown]) == unknown
    assert worst_verdict([pending, satisfied]) == pending
    assert worst_verdict([]) == satisfied


def test_a_verdict_follows_from_the_ends_of_the_interval():
    assert final_verdict(0.0, inf) == "satisfied"
    assert final_verdict(-inf, -1e-300) == "violated"
    assert final_verdict(-1e-300, 0.0) == "unknown"
    assert online_verdict(-1.0, 1.0) == "pending"
    assert online_verdict(0.0, 1.0) == "satisfied"


# ------------------------------------------------------------------------------------- over which samples


def test_a_window_of_samples_is_half_open():
    trace = numbers(p=[1, 2, 3, 4])
    result = judged("G p >= 0", trace, start_ns=SECOND, end_ns=3 * SECOND).result()
    assert result.times_ns.tolist() == [SECOND, 2 * SECOND]
    assert result.nodes[0].value.tolist() == [2, 2]
    later = judged("G p >= 0", trace, start_ns=SECOND + 1).result()
    assert later.times_ns.tolist() == [2 * SECOND, 3 * SECOND]


def test_past_operators_start_with_the_window_and_terms_may_look_before_it():
    trace = points(a=[0, 1, 3, 6, 10])
    step = "a dist a[-1] <= 9"
    assert root(f"H {step}", trace, start_ns=3 * SECOND).now.tolist() == [6, 5]
    assert root("Y a dist a <= 0", trace, start_ns=3 * SECOND).now.tolist() == [-inf, 0]


def test_terms_look_back_by_samples_or_by_time():
    trace = points(a=[0, 1, 3, 6, 10])
    np.testing.assert_array_equal(root("a dist a[-2] >= 0", trace).now, [nan, nan, 3, 5, 7])
    np.testing.assert_array_equal(root("a dist a[-2s] >= 0", trace).now, [nan, nan, 3, 5, 7])
    np.testing.assert_array_equal(root("a dist a[-1500ms] >= 0", trace).now, [nan, nan, 3, 5, 7])
    np.testing.assert_array_equal(root("a dist a[-2.5s] >= 0", trace).now, [nan, nan, nan, 6, 9])


def test_groups_look_back():
    trace = points(a=[0, 0, 0], b=[1, None, None], c=[None, 7, 2])
    others = "(all except a)"
    assert root(f"a dist {others} >= 0", trace).now.tolist() == [1, 7, 2]
    text = "group g = all\nspec s = a dist g[-1] >= -5"
    np.testing.assert_array_equal(root(text, trace).now, [nan, 5, 5])
    # the members of then, where they are now
    members = "group g = all\nspec s = exists x in g[-1]: a dist x >= 1"
    np.testing.assert_array_equal(root(members, trace).now, [nan, nan, 1])


def test_an_empty_window_is_refused():
    trace = numbers(p=[1, 2, 3])
    with pytest.raises(
        UsageError, match=r"no sample lies from 5 ns to before 9 ns; the trace runs from 0 to"
    ):
        judged("p >= 0", trace, start_ns=5, end_ns=9)
    with pytest.raises(UsageError, match="to before the end; the trace runs"):
        judged("p >= 0", trace, start_ns=3 * SECOND)
    with pytest.raises(UsageError, match="the trace has no sample"):
        judged("p >= 0", Trace.from_samples([]))


def test_unknown_semantics_are_refused():
    with pytest.raises(UsageError, match=r"no semantics 'stl'; there are 'ltlf' and 'paper'"):
        evaluate(parse_specification("p >= 0"), numbers(p=[1]), semantics="stl")


# -------------------------------------------------------------------------------------------- what is kept


def test_an_edited_specification_reuses_the_measurements_of_a_trace():
    trace = points(a=[0, 0, 0], b=[5, 1, 4])
    judged("F a dist b <= 2", trace)
    assert root("G a dist b <= 6", trace).value.tolist() == [1, 1, 1]
    moved = "region home = box({0}, 0, {0}, 1)\nspec s = G a dist home <= 5"
    assert root(moved.format(2), trace).robustness == 3
    assert root(moved.format(4), trace).robustness == 1


def test_regions_with_equal_names_or_equal_shapes_are_not_confused():
    trace = points(a=[0])
    text = """\
region {0} = box(2, 0, 2, 1)
region {1} = box(2, 0, 2, 1)
spec s = a dist {0} <= 9 and a dist {1} <= 5
"""
    assert root(text.format("p", "q"), trace).robustness == 3
    assert root(text.format("q", "p"), trace).robustness == 3


# ------------------------------------------------------------------------------------------- what is too much


def test_more_nested_operators_than_a_table_can_hold_are_refused():
    text = "G p >= 0"
    for _ in range(MAX_VARIABLES):
        text = f"G (q >= 0 or F ({text}))"
    with pytest.raises(
        UsageError, match=rf"unbounded temporal operators under one G; {MAX_VARIABLES} is the"
    ):
        judged(text, numbers(p=[1], q=[1]))


def test_the_most_nested_operators_a_table_can_hold_are_evaluated():
    text = "p >= 0"
    for _ in range(MAX_VARIABLES):
        text = f"F (q >= 0 and {text})"
    assert root(text, numbers(p=[1, 2], q=[3, 1])).value.tolist() == [1, 1]


def test_tables_grow_linearly_with_both_polarities_at_every_level():
    text = "p >= 0"
    for _ in range(40):
        text = f"(F[0,1] p >= 0) xor ({text})"
    assert root(f"G {text}", numbers(p=[1, -1])).verdict in ("satisfied", "violated")


def test_too_many_bindings_are_refused():
    many = points(**{f"o{n}": [n] for n in range(30)})
    with pytest.raises(UsageError, match=rf"x, y, z over 30 objects gives .* {MAX_BINDINGS} is the limit"):
        judged("forall x, y, z in all: x dist y >= 0", many)
    with pytest.raises(UsageError, match=rf"{MAX_BINDINGS} is the limit"):
        judged("forall x in all: forall y in all: exists z in all: x closer y than z", many)


@pytest.mark.parametrize("given", ["F a ovlp b", None, Trace.from_samples([])])
def test_an_argument_that_is_no_specification_is_refused(trace, given):
    remedy = r"specification is .*; give a Specification, from parse_specification\(text\)"
    with pytest.raises(UsageError, match=remedy):
        evaluate(given, trace)
    with pytest.raises(UsageError, match=remedy):
        Monitor(given)


@pytest.mark.parametrize("given", [[1], "log.mcap", None])
def test_an_argument_that_is_no_trace_is_refused(given):
    with pytest.raises(UsageError, match=r"trace is .*; give a Trace, from read_trace\(path\)") as caught:
        evaluate(parse_specification("F a ovlp b"), given)
    assert f"trace is {given!r};" in str(caught.value)


# ------------------------------------------------------------------------------------------------------ units


UNITS = {"": "m", "p": "V"}


def test_sentences_and_numbers_have_the_units_that_the_samples_declare() -> None:
    spec = parse_specification("spec near = G a dist b <= 2\nspec high = G p >= 2")
    samples = list(points(a=[0, 0], b=[1, 5], signals={"p": [3, 1.5]}).samples())
    declared = evaluate(spec, Trace.from_samples(samples, units=UNITS))
    assert [each.unit for each in declared] == ["m", "V"]
    assert "a and b are 5 m apart" in declared.explain()
    assert "p is 1.5 V" in declared.explain()
    monitor = Monitor(spec, units=UNITS)
    *_, update = map(monitor.update, samples)
    assert [str(each) for each in update.violations] == [
        "a is 3 m too far from b: `a dist b <= 2` fails by 3 m at 1.000 s",
        "p is 0.5 V too low: `p >= 2` fails by 0.5 V at 1.000 s",
    ]
    assert [each.unit for each in monitor.endings()] == ["m", "V"]
    assert " m " not in evaluate(spec, Trace.from_samples(samples)).explain()


@pytest.mark.parametrize("units", ["m", {"": ""}, {"p": 3}, {1: "m"}, {"": "m" * 65}])
def test_units_that_are_no_texts_by_names_are_refused(units: Any) -> None:
    with pytest.raises(UsageError, match="unit"):
        Trace.from_samples([], units=units)
    with pytest.raises(UsageError, match="unit"):
        Monitor(parse_specification("G p >= 2"), units=units)


def test_a_verdict_is_no_truth_value() -> None:
    with pytest.raises(UsageError, match=r"write verdict == \"satisfied\" \(it is 'violated'\)"):
        bool(Verdict.VIOLATED)

"""What settled a verdict, and what decided nothing: both are true of every formula and run."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

import numpy as np
from hypothesis import HealthCheck, assume, given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from laws.strategies_monitor import LEAVES, formulas_of_leaves, leaf_runs, recordings, specifications
from spatial_replay import Specification
from spatial_replay.monitor.offline import evaluate_prefix
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.monitor.online.step import OnlineRun
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.witness.path import End, deciding_path
from spatial_replay.spec.format import format_term
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Boolean,
    Bound,
    Equality,
    Formula,
    NamedSpec,
    Quantified,
    Temporal,
    TrackedName,
    Truth,
    iter_nodes,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import iter_parts

_BEYOND = st.builds(
    Temporal, st.sampled_from(["F", "G"]), st.tuples(formulas_of_leaves), st.just(Bound(8, 9, "samples"))
)
"""Windows that begin behind the end of `signal_runs`."""
_OFTEN_UNTESTED = st.booleans().flatmap(lambda is_beyond: _BEYOND if is_beyond else formulas_of_leaves)
_NUMBERS = st.sampled_from([-9.0, -3.0, -1.5, 0.0, 0.25, 1.0, 2.5, 7.0])


@st.composite
def signal_runs(draw) -> sr.Trace:
    """Samples of three signals, some of them missing now and then."""
    known = draw(st.booleans())
    samples, time_ns = [], 0
    for _ in range(draw(st.integers(1, 8))):
        signals = {name: draw(_NUMBERS) for name in "pqr" if known or draw(st.integers(0, 5)) > 0}
        samples.append(sr.Sample(time_ns, {}, signals))
        time_ns += draw(st.sampled_from([50, 100, 100, 130, 400]))
    return sr.Trace.from_samples(samples)


def evaluated(formula: Formula, trace: sr.Trace) -> SpecResult:
    return sr.evaluate(Specification((NamedSpec("s", formula),), "paper"), trace).result()


def rebuilt(formula: Formula, node: int, change) -> Formula:
    """The formula with another one in place of a node."""
    if node == 0:
        return change(formula)
    operands, at = [], 1
    for operand in operands_of(formula):
        count = sum(1 for _ in iter_nodes(operand))
        operands.append(rebuilt(operand, node - at, change) if at <= node < at + count else operand)
        at += count
    return replace(formula, operands=tuple(operands))


@examples(200)
@given(formula=formulas_of_leaves, run=leaf_runs(max_size=8))
def test_a_log_that_may_go_on_has_the_intervals_of_a_monitor(formula, run):
    program = compile_formula(formula)
    leaves, times = run.values(program.leaves), np.array(run.times_ns)
    series = OnlineRun(program).extend(leaves, times)
    for count in range(1, len(times) + 1):
        done = evaluate_prefix(formula, program.leaves, leaves[:, :, :count], times[:count])
        for node, _, _ in iter_nodes(formula):
            low, high = done.ends(node)
            assert (low[0], high[0]) == tuple(series[node, 2:, count - 1])


@examples(200)
@given(formula=formulas_of_leaves, run=leaf_runs(max_size=8))
def test_what_settled_a_violation_has_the_number_of_that_moment(formula, run):
    program = compile_formula(formula)
    leaves, times = run.values(program.leaves), np.array(run.times_ns)
    upper = OnlineRun(program).extend(leaves, times)[:, 3]
    for node, _, _ in iter_nodes(formula):
        settled = np.flatnonzero(upper[node] < 0.0)
        if not len(settled):
            continue
        count = int(settled[0]) + 1
        done = evaluate_prefix(formula, program.leaves, leaves[:, :, :count], times[:count])
        path = deciding_path(done, node, End.HIGH)
        low, high = done.ends(path.steps[-1].node)
        number = (high if path.end is End.HIGH else -low)[path.steps[-1].sample]
        assert number == upper[node, count - 1]


@examples(150)
@given(parts=st.lists(formulas_of_leaves, min_size=2, max_size=4), trace=signal_runs(), data=st.data())
def test_causes_are_the_conjuncts_that_fail_and_the_settled_ones_come_first(parts, trace, data):
    named = [replace(part, name=f"part{k}") for k, part in enumerate(parts)]
    result = evaluated(Boolean("and", tuple(named)), trace)
    failing = {
        node.id: node for node in result.nodes if node.name and node.verdict is not sr.Verdict.SATISFIED
    }
    causes = result.causes
    assert bool(causes) == (result.verdict is not sr.Verdict.SATISFIED)
    assert {cause.spec for cause in causes} == {node.name for node in failing.values()}
    settled = [cause.settled_ns for cause in causes if cause.settled_ns is not None]
    assert settled == sorted(settled)
    assert [cause.settled_ns for cause in causes[: len(settled)]] == settled
    assert result.violated_at_ns == (settled[0] if settled else None)
    for cause in causes:
        assert cause.witness is not None
        assert cause.witness.verdict is cause.verdict
        assert cause.witness.node == cause.node
        if cause.settled_ns is not None:
            assert cause.witness.time_ns <= cause.settled_ns
            at = trace.times_ns.tolist().index(cause.settled_ns)
            assert result.nodes[cause.node].upper[at] == cause.witness.upper


@examples(200)
@given(formula=formulas_of_leaves, trace=signal_runs())
def test_a_vacuous_part_can_be_replaced_by_true(formula, trace):
    result = evaluated(formula, trace)
    for part in result.vacuous:
        nodes = list(iter_nodes(formula))
        assert part.message.startswith("`")
        if part.reason == "empty window":
            assert isinstance(nodes[part.node][2], Temporal)
            other = rebuilt(formula, part.node, _with_true_operands)
            replaced = evaluated(other, trace)
            if "where it counts" in part.message:
                assert replaced.verdict is result.verdict
                continue
            np.testing.assert_array_equal(
                [replaced.robustness, replaced.lower, replaced.upper],
                [result.robustness, result.lower, result.upper],
            )
        elif part.reason == "antecedent never held":
            other = rebuilt(formula, part.node, lambda _: Truth(True))
            assert evaluated(other, trace).verdict is result.verdict


@examples(200)
@given(condition=formulas_of_leaves, response=formulas_of_leaves, trace=signal_runs())
def test_every_spelling_of_an_implication_is_tested_by_the_same(condition, response, trace):
    # `not a or not b` has two conditions, and `not (not a and not b)` none
    assume("not" not in (operator_of(condition), operator_of(response)))

    def negation(operand: Formula) -> Formula:
        return Boolean("not", (operand,))

    spellings = (
        Boolean("->", (condition, response)),
        Boolean("or", (negation(condition), response)),
        Boolean("or", (response, negation(condition))),
        negation(Boolean("and", (condition, negation(response)))),
    )
    results = [evaluated(Temporal("G", (formula,)), trace) for formula in spellings]
    assert len({(result.verdict, result.tested) for result in results}) == 1


_WINDOWS = st.one_of(
    st.builds(
        lambda lower, width: Bound(lower, lower + width, "ns"), st.integers(0, 300), st.integers(0, 200)
    ),
    st.builds(
        lambda lower, width: Bound(lower, lower + width, "samples"), st.integers(0, 4), st.integers(0, 2)
    ),
)
_LOOKING = st.one_of(
    st.sampled_from([("Y", None), ("WX", None)]), st.tuples(st.sampled_from(["G", "H"]), _WINDOWS)
)


@examples(300)
@given(looking=_LOOKING, trace=signal_runs())
def test_a_response_is_tested_where_its_condition_holds_and_its_window_has_a_sample(looking, trace):
    operator, window = looking
    condition, measured, _ = LEAVES
    response = Temporal(operator, (measured,), window)
    result = evaluated(Temporal("G", (Boolean("->", (condition, response)),)), trace)
    assume(result.verdict is sr.Verdict.SATISFIED)
    bound = window or Bound(1, 1, "samples")
    places = trace.times_ns.tolist() if bound.unit == "ns" else list(range(len(trace)))
    way = 1 if operator in ("G", "WX") else -1
    numbers = trace.signals.get("p", np.full(len(trace), np.nan))
    activations = [place for place, number in zip(places, numbers, strict=True) if not number < 0.0]
    distances = [way * (place - activation) for activation in activations for place in places]
    assert (result.tested == "nothing") is not any(
        bound.lower <= distance <= bound.upper for distance in distances
    )


def _with_true_operands(node: Temporal) -> Temporal:
    return replace(node, operands=tuple(Truth(True) for _ in node.operands))


def without_end(formula: Formula) -> Formula:
    """The formula with a window for each operator that would end with the log."""
    if isinstance(formula, Temporal) and formula.operator in FUTURE_OPERATORS:
        operands = tuple(without_end(each) for each in formula.operands)
        if formula.operator in ("X", "WX"):
            return Temporal("X", operands)
        bound = formula.bound or Bound(0, None, "samples")
        bound = replace(bound, upper=bound.lower + 2) if bound.upper is None else bound
        return replace(formula, operands=operands, bound=bound)
    if isinstance(formula, Boolean | Temporal):
        return replace(formula, operands=tuple(without_end(each) for each in formula.operands))
    return formula


@examples(300)
@given(formula=formulas_of_leaves.map(without_end), trace=signal_runs(), later=signal_runs())
def test_no_later_sample_changes_a_verdict_that_no_cut_window_decides(formula, trace, later):
    result = evaluated(formula, trace)
    assume(result.tested != "cut" and result.verdict is not sr.Verdict.UNKNOWN)
    end = int(trace.times_ns[-1]) + 40
    samples = [replace(each, time_ns=each.time_ns + end) for each in later.samples()]
    longer = sr.Trace.from_samples([*trace.samples(), *samples])
    if result.tested == "full":
        assert evaluated(formula, longer).verdict is result.verdict


@examples(300, suppress_health_check=[HealthCheck.too_slow])
@given(formula=_OFTEN_UNTESTED, trace=signal_runs(), data=st.data())
def test_no_value_changes_a_verdict_that_nothing_tested(formula, trace, data):
    result = evaluated(formula, trace)
    assert result.tested != "nothing" or result.untested
    is_implied = any(
        isinstance(each, Boolean) and each.operator == "->" for _, _, each in iter_nodes(formula)
    )
    assume(result.tested == "nothing" and not is_implied)
    other = [replace(each, signals={name: data.draw(_NUMBERS) for name in "pqr"}) for each in trace.samples()]
    assert evaluated(formula, sr.Trace.from_samples(other)).verdict is result.verdict


@examples(200)
@given(formula=formulas_of_leaves, trace=signal_runs())
def test_no_infinite_pass_is_silent(formula, trace):
    assume(not any(isinstance(node, Truth) for _, _, node in iter_nodes(formula)))
    result = evaluated(formula, trace)
    if result.verdict is sr.Verdict.SATISFIED and result.robustness == np.inf:
        assert result.vacuous


@examples(60)
@given(specification=specifications(), recording=recordings())
def test_the_body_over_an_empty_group_can_be_replaced_by_true(specification, recording):
    trace = recording.trace()
    each = {"ego": "all"} if specification.specs[0].parameter else None
    for result in sr.evaluate(specification, trace, each=each):
        nodes = list(iter_nodes(result.formula))
        # modes and presence are infinite by themselves
        is_exact = any(isinstance(part, Equality) for part in iter_parts(result.formula))
        if result.verdict is sr.Verdict.SATISFIED and result.robustness == np.inf and not is_exact:
            assert result.vacuous or any(isinstance(node, Truth) for _, _, node in nodes)
        for vacuous in result.vacuous:
            node = nodes[vacuous.node][2]
            if vacuous.reason != "no members" or not isinstance(node, Quantified):
                continue
            # not one that the body is about
            named = tuple(each for each in node.group.excluded if isinstance(each, TrackedName))
            own = replace(node.group, excluded=named)
            if "ever" not in vacuous.message or f"`{format_term(own)}`" not in vacuous.message:
                continue
            other = rebuilt(result.formula, vacuous.node, lambda node: replace(node, body=Truth(True)))
            spec = replace(result.spec, formula=other)
            changed = sr.evaluate(replace(specification, specs=(spec,)), trace, each=each)
            replaced = changed.result(object=result.object)
            np.testing.assert_array_equal(
                [replaced.robustness, replaced.lower, replaced.upper],
                [result.robustness, result.lower, result.upper],
            )


@examples(150)
@given(trace=signal_runs(), limit=_NUMBERS)
def test_a_violated_invariant_lists_each_run_of_samples_that_violate_it(trace, limit):
    times, signals = trace.times_ns.tolist(), trace.signals
    missing = np.full(len(times), np.nan)
    p, q = (signals.get(name, missing) for name in "pq")
    for text, fails, enters in (
        (f"G (p >= {limit})", p < limit, None),
        (f"not F (p >= {limit})", p > limit, None),
        (f"G[0, 3] (p >= {limit} -> q >= 0)", (p > limit) & (q < 0) & (np.arange(len(p)) < 4), p >= limit),
    ):
        result = sr.evaluate(sr.parse_specification(text), trace).result()
        runs = [list(run) for is_failing, run in groupby(range(len(times)), fails.__getitem__) if is_failing]
        if not runs:
            assert result.violated_invariants == ()
            continue
        (invariant,) = result.violated_invariants
        spans = [(interval.start_ns, interval.end_ns, interval.samples) for interval in invariant.intervals]
        assert spans == [(times[run[0]], times[run[-1]], len(run)) for run in runs]
        assert result.upper == min(interval.robustness for interval in invariant.intervals)
        if enters is not None:
            window = range(min(len(times), 4))
            entries = [set(run) for has_entered, run in groupby(window, enters.__getitem__) if has_entered]
            missed = sum(any(run[0] in entry for run in runs) for entry in entries)
            assert (invariant.condition, invariant.entries) == (f"p >= {limit:g}", (len(entries), missed))

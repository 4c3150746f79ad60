"""Laws of every formula on every run, against a slow reading of the definitions."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from examples import examples
from laws.reference import Interval, Observed, numbers_of
from laws.strategies_monitor import (
    LEAVES,
    NAMES,
    WORDS,
    LeafRun,
    Recording,
    alike_windows,
    alternative_windows,
    bounds,
    cuts,
    formulas_of_leaves,
    lasting_windows,
    leaf_runs,
    nested_windows,
    past_over_windows,
    ramps,
    recordings,
    responses,
    specifications,
    time_bounds,
    tracked_objects,
    untils_of_lasting,
    widened,
    windows_of,
)
from spatial_replay import Monitor, Verdict, evaluate, parse_specification
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.monitor.online.step import OnlineRun
from spatial_replay.monitor.stream import EvaluationStream, find_instances
from spatial_replay.monitor.verdict import final_verdict, online_verdict
from spatial_replay.spec.formula import Boolean, Bound, Temporal, Truth, expand, iter_nodes
from spatial_replay.trace.trace import FOREVER

VALUE, NOW, LOWER, UPPER = range(4)

few = examples(50)
"""For laws whose examples are whole evaluations."""


def run_of(formula, run, *, room=256, cuts=()):
    """(N, 4, T) and (N, 2): what a run says of some leaves, in stretches."""
    program = compile_formula(formula)
    going = OnlineRun(program, room=room)
    leaves, times = run.values(program.leaves), np.array(run.times_ns)
    ends = cuts or (0, len(run))
    series = [going.extend(fewest(leaves[:, :, i:j]), times[i:j]) for i, j in pairwise(ends)]
    return np.concatenate(series, axis=2), going.final


def fewest(leaves):
    """As few channels as say all that these do, so that more of them come up while a run goes on."""
    for channels in (1, 2):
        spread = leaves[np.arange(len(leaves)) % channels]
        if np.array_equal(spread, leaves):
            return leaves[:channels]
    return leaves


def root_of(formula, run):
    """(4, T) and (2,) of the root."""
    series, final = run_of(formula, run)
    return series[0], final[0]


def assert_same(first, second):
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


def negated(formula):
    return Boolean("not", (formula,))


def both(*formulas):
    return Boolean("and", formulas)


def either(*formulas):
    return Boolean("or", formulas)


# ------------------------------------------------------------------------------------- the definitions


def assert_as_defined(data, formula, run, room):
    """Every number of every node, in stretches of a run, is that of the definitions."""
    series, final = run_of(formula, run, room=room, cuts=data.draw(cuts(len(run))))
    wide_leaf = run.wide_leaf if run.channels == 4 else run.nominal_leaf
    expected = numbers_of(formula, run.times_ns, run.nominal_leaf, wide_leaf)
    assert_same((series, final), (expected.series, expected.final))


@examples(500)
@given(data=st.data(), formula=formulas_of_leaves, run=leaf_runs(), room=st.integers(2, 8))
def test_every_node_on_every_prefix_equals_the_definitions(data, formula, run, room):
    assert_as_defined(data, formula, run, room)


@examples(60)
@given(data=st.data(), formula=nested_windows, run=leaf_runs(max_size=40), room=st.integers(2, 64))
def test_windows_below_windows_equal_the_definitions(data, formula, run, room):
    """On runs so long that windows close while others are open."""
    assert_as_defined(data, formula, run, room)


@examples(120)
@given(data=st.data(), formula=alternative_windows, run=leaf_runs(max_size=30), room=st.integers(2, 64))
def test_windows_beside_windows_equal_the_definitions(data, formula, run, room):
    assert_as_defined(data, formula, run, room)


@examples(200)
@given(data=st.data(), formula=alike_windows, run=leaf_runs(max_size=40), room=st.integers(2, 64))
def test_windows_that_begin_and_end_alike_equal_the_definitions(data, formula, run, room):
    assert_as_defined(data, formula, run, room)


@examples(150)
@given(data=st.data(), formula=untils_of_lasting, run=leaf_runs(max_size=24), room=st.integers(2, 32))
def test_untils_whose_left_operand_never_falls_equal_the_definitions(data, formula, run, room):
    assert_as_defined(data, formula, run, room)


@examples(60)
@given(data=st.data(), formula=alike_windows, run=ramps(), room=st.integers(2, 16))
def test_windows_alike_over_signals_that_go_one_way_equal_the_definitions(data, formula, run, room):
    assert_as_defined(data, formula, run, room)


@pytest.mark.parametrize("room", [8, 16])
@pytest.mark.parametrize("outer", ["G", "F"])
def test_windows_alike_equal_the_definitions_where_they_do_not_cross_for_long(outer, room):
    """What is before all that is open is forgotten by then, and then there is room for more."""
    early, size, sign = 3 * room, 7 * room, 1.0 if outer == "G" else -1.0
    times = np.cumsum([0] + [250 if index <= early else 450 // room for index in range(1, size)])
    falling = [sign * (-1e4 if index == early else 1e4) for index in range(size)]
    rising = [-sign * index for index in range(size)]
    numbers = {
        leaf.text: tuple(Interval(value, value) for value in values)
        for leaf, values in zip(LEAVES, (falling, rising, rising), strict=True)
    }
    run = LeafRun(tuple(times.tolist()), numbers, numbers, 1)
    inner, bound = "F" if outer == "G" else "G", Bound(0, 1000, "ns")
    windows = Temporal(outer, LEAVES[:1], bound), Temporal(inner, LEAVES[1:2], bound)
    formula = Temporal(outer, (either(*windows) if outer == "G" else both(*windows),))
    expected = numbers_of(formula, run.times_ns, run.nominal_leaf, run.nominal_leaf)
    assert_same(run_of(formula, run, room=room), (expected.series, expected.final))


@examples(200)
@given(data=st.data(), formula=past_over_windows, run=leaf_runs(max_size=30), room=st.integers(2, 64))
def test_past_operators_over_windows_equal_the_definitions(data, formula, run, room):
    assert_as_defined(data, formula, run, room)


@pytest.mark.parametrize("past", ["O", "H"])
@pytest.mark.parametrize("outer", ["F", "G"])
@given(run=leaf_runs(max_size=6))
def test_what_implies_a_window_ahead_has_its_own_number_now(outer, past, run):
    first, second = LEAVES[:2]
    ahead = Temporal(past, (Temporal("F", (second,), Bound(1, None, "samples")),))
    formula = Temporal(outer, (both(either(first, ahead), first),))
    assert_same([root_of(formula, run)[0]], [root_of(Temporal(outer, (first,)), run)[0]])


@examples(60)
@given(data=st.data(), formula=lasting_windows, run=leaf_runs(max_size=20), room=st.integers(2, 64))
def test_windows_that_recur_or_begin_later_equal_the_definitions(data, formula, run, room):
    assert_as_defined(data, formula, run, room)


@examples(150)
@given(data=st.data(), specification=specifications(), recording=recordings())
def test_specifications_over_recordings_equal_the_definitions(data, specification, recording):
    times = [sample.time_ns for sample in recording.samples]
    begin = data.draw(st.integers(0, len(times) - 1))
    end = data.draw(st.integers(begin + 1, len(times)))
    window = (times[begin], times[end] if end < len(times) else None)
    evaluation = evaluate(
        specification,
        recording.trace(),
        start_ns=window[0],
        end_ns=window[1],
        each={"ego": "all"} if specification.specs[0].parameter else None,
    )
    observed = observed_in(recording, specification)
    assert {result.object: result.times_ns.tolist() for result in evaluation} == {
        name: times[first : last + 1]
        for name, (first, last) in spans(specification, recording, begin, end).items()
    }
    for result in evaluation:
        bindings = {} if result.object is None else {"ego": result.object}
        start = times.index(result.times_ns[0])
        nominal, wide = (observed.leaf(start, bindings, uncertain=uncertain) for uncertain in (False, True))
        expected = numbers_of(result.formula, result.times_ns.tolist(), nominal, wide)
        assert_close(result.series, expected)
        np.testing.assert_allclose(result.final, expected.final, rtol=0, atol=1e-9)


def observed_in(recording, specification):
    samples = recording.samples
    return Observed(
        [sample.time_ns for sample in samples],
        [sample.objects for sample in samples],
        recording.unreadable,
        [sample.signals for sample in samples],
        specification.regions,
        {(t, name): ns for t, sample in enumerate(samples) for name, ns in sample.reported_ns.items()},
        frozenset().union(*(sample.lasting for sample in samples)),
    )


def spans(specification, recording, begin, end):
    """First and last sample of each instance by its object; None for a spec that is no template."""
    if specification.specs[0].parameter is None:
        return {None: (begin, end - 1)}
    seen = {
        name: [t for t in range(begin, end) if name in recording.samples[t].objects] for name in NAMES
    }  # fmt: skip
    return {name: (at[0], at[-1]) for name, at in seen.items() if at}


def assert_close(series, expected):
    """Equal but for rounding, which may also decide whether two ends of `value` are one."""
    undecided = np.isnan(series) ^ np.isnan(expected.series)
    assert (expected.slack[undecided[:, :2]] <= 1e-9).all()
    assert not undecided[:, 2:].any()
    np.testing.assert_allclose(
        np.where(undecided, 0.0, series), np.where(undecided, 0.0, expected.series), rtol=0, atol=1e-9
    )


# ---------------------------------------------------------------------------------- stretches of samples


@given(data=st.data(), formula=formulas_of_leaves, run=leaf_runs(max_size=40))
def test_blocks_and_room_change_no_bit(data, formula, run):
    whole = run_of(formula, run)
    parts = run_of(formula, run, room=data.draw(st.integers(2, 8)), cuts=data.draw(cuts(len(run))))
    assert [array.tobytes() for array in whole] == [array.tobytes() for array in parts]


@few
@given(data=st.data(), specification=specifications(), recording=recordings(max_size=8))
def test_a_stream_in_blocks_equals_an_evaluation_of_the_whole(data, specification, recording):
    trace = recording.trace()
    start_ns = int(data.draw(st.sampled_from([0, *trace.times_ns])))
    each = {"ego": "all"} if specification.specs[0].parameter else {}
    whole = evaluate(specification, trace, start_ns=start_ns, each=each)
    instances = find_instances(specification, each, [trace], start_ns, FOREVER)
    stream = EvaluationStream(instances, specification.regions)
    ends = data.draw(cuts(len(trace)))
    stretches = [stream.extend(trace.slice(i, j)) for i, j in pairwise(ends)]
    for number, result in enumerate(whole):
        series = np.concatenate([stretch[number].series for stretch in stretches], axis=2)
        assert series.tobytes() == result.series.tobytes()
        assert stream.streams[number].final.tobytes() == result.final.tobytes()
        assert stream.streams[number].first_satisfied_ns == result.first_satisfied_ns


@few
@given(data=st.data(), specification=specifications(templates=False), recording=recordings())
def test_a_monitor_equals_an_evaluation_sample_by_sample(data, specification, recording):
    assume(not recording.unreadable)
    trace = recording.trace()
    start_ns = int(data.draw(st.sampled_from([0, *trace.times_ns])))
    monitor = Monitor(specification, start_ns=start_ns)
    numbers = [monitor.update(sample).specs[0].numbers for sample in recording.samples]
    seen = [each for each in numbers if each is not None]
    series = evaluate(specification, trace, start_ns=start_ns).result().series
    assert np.stack(seen, axis=2).tobytes() == series.tobytes()


# ------------------------------------------------------------------------------------------- equivalences


@few
@given(
    spellings=st.sampled_from([("F", "true U"), ("O", "true S"), ("G", "false R")]),
    window=st.sampled_from(["", "[0, 2]", "[1, 3]", "[1, inf]", "[100ms, 300ms]"]),
    outer=st.sampled_from(["{}", "G ({})", "F[0, 2] ({})", "G[1, 2] ((a ovlp b) -> ({}))", "H ({})"]),
    run=recordings(),
)
def test_an_until_of_true_is_evaluated_as_finally(spellings, window, outer, run):
    texts = [outer.format(f"{operator}{window} (a dist b <= 1)") for operator in spellings]
    short, long = (evaluate(parse_specification(text), run.trace()).result() for text in texts)
    assert short.series[0].tobytes() == long.series[0].tobytes()
    assert short.final[0].tobytes() == long.final[0].tobytes()
    if outer == "{}":
        assert expand(long.formula) == replace(short.formula, name=None)


@examples(60)
@given(data=st.data(), shape=responses(st.sampled_from(LEAVES)), run=leaf_runs(max_size=30))
def test_windows_at_a_constant_cost_equal_windows_run_backwards(data, shape, run):
    wide = st.integers(0, 9).flatmap(
        lambda low: st.builds(Bound, st.just(low), st.integers(low, 20), st.just("samples"))
    )
    ahead = data.draw(windows_of(st.sampled_from(LEAVES), st.one_of(wide, time_bounds())))
    # always true, but only the general way looks through a window below a window
    always = Temporal("G", (Truth(True),), Bound(0, 0, "samples"))
    slow = replace(ahead, operands=tuple(both(operand, always) for operand in ahead.operands))
    leaf = data.draw(st.sampled_from(LEAVES))
    assert_same(*(root_of(with_window(shape, leaf, window), run) for window in (ahead, slow)))


@examples(60)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1), channels=st.sampled_from([1, 2]))
def test_windows_in_samples_equal_windows_in_seconds_of_even_samples(data, seed, channels):
    """Wide ones, below each other, for which there are other rules in samples."""
    wide = st.builds(
        lambda low, more: Bound(low, low + more, "samples"), st.integers(0, 3), st.integers(0, 40)
    )
    ahead = windows_of(st.sampled_from(LEAVES), wide)
    joined = st.builds(
        Boolean, st.sampled_from(["and", "or", "->"]), st.tuples(st.sampled_from(LEAVES), ahead)
    )
    formula = data.draw(responses(windows_of(st.one_of(ahead, joined), wide)))
    source = np.random.default_rng(seed)
    # quantities that go one way for a while, so that much of what windows hold changes, or none
    leaves = np.cumsum(source.integers(-2, 3, (channels, len(LEAVES), 120)), axis=2).astype(float)
    leaves.sort(axis=0)
    both_ways = []
    for each in (formula, in_seconds(formula)):
        program = compile_formula(each)
        order = [LEAVES.index(leaf) for leaf in program.leaves]
        run = OnlineRun(program)
        series = run.extend(leaves[:, order], np.arange(120) * 100)
        both_ways.append((series, run.final))
    assert_same(*both_ways)


def in_seconds(formula):
    """A formula with each of its windows in ns, over samples 100 ns apart."""
    if not isinstance(formula, Boolean | Temporal):
        return formula
    operands = tuple(map(in_seconds, formula.operands))
    if isinstance(formula, Boolean) or formula.bound is None:
        return replace(formula, operands=operands)
    bound = formula.bound
    return replace(formula, operands=operands, bound=Bound(bound.lower * 100, bound.upper * 100, "ns"))


def with_window(formula, leaf, window):
    """A formula with a window in place of a leaf."""
    if formula == leaf:
        return window
    operands = tuple(with_window(each, leaf, window) for each in getattr(formula, "operands", ()))
    return replace(formula, operands=operands) if operands else formula


def unbounded(formula):
    """How many operators go on without end."""
    nodes = (node for _, _, node in iter_nodes(formula))
    return sum(isinstance(node, Temporal) and node.bound is None for node in nodes)


@st.composite
def of_few_operators(draw):
    """A formula of which two below one operator stay within what a part may nest."""
    formula = draw(st.one_of(st.sampled_from(LEAVES), formulas_of_leaves))
    assume(unbounded(formula) <= 5)
    return formula


small = of_few_operators()


@given(p=small, q=small, run=leaf_runs())
def test_de_morgan(p, q, run):
    assert_same(root_of(negated(both(p, q)), run), root_of(either(negated(p), negated(q)), run))
    assert_same(root_of(negated(either(p, q)), run), root_of(both(negated(p), negated(q)), run))


@given(p=small, bound=bounds, run=leaf_runs())
def test_eventually_is_until_after_true(p, bound, run):
    assert_same(
        root_of(Temporal("F", (p,), bound), run), root_of(Temporal("U", (Truth(True), p), bound), run)
    )
    assert_same(
        root_of(Temporal("O", (p,), bound), run), root_of(Temporal("S", (Truth(True), p), bound), run)
    )


@given(p=small, bound=bounds, run=leaf_runs(), names=st.sampled_from(["FG", "GF", "OH", "HO"]))
def test_always_is_never_not(p, bound, run, names):
    strong, weak = names
    dual = negated(Temporal(strong, (negated(p),), bound))
    assert_same(root_of(Temporal(weak, (p,), bound), run), root_of(dual, run))


@given(p=small, run=leaf_runs())
def test_weak_next_is_not_next_not(p, run):
    assert_same(root_of(Temporal("WX", (p,)), run), root_of(negated(Temporal("X", (negated(p),))), run))


@given(p=small, q=small, bound=bounds, run=leaf_runs())
def test_release_is_the_dual_of_until(p, q, bound, run):
    dual = negated(Temporal("U", (negated(p), negated(q)), bound))
    assert_same(root_of(Temporal("R", (p, q), bound), run), root_of(dual, run))


@given(p=small, q=small, bound=bounds, run=leaf_runs())
def test_weak_until_is_until_or_always(p, q, bound, run):
    parts = either(Temporal("U", (p, q), bound), Temporal("G", (p,), bound))
    assert_same(root_of(Temporal("W", (p, q), bound), run), root_of(parts, run))


@given(p=small, run=leaf_runs())
def test_negation_mirrors_every_number(p, run):
    series, final = root_of(p, run)
    mirrored, mirrored_final = root_of(negated(p), run)
    np.testing.assert_array_equal(mirrored[VALUE], -series[VALUE])
    np.testing.assert_array_equal(mirrored[NOW], -series[NOW])
    np.testing.assert_array_equal(mirrored[[LOWER, UPPER]], -series[[UPPER, LOWER]])
    np.testing.assert_array_equal(mirrored_final, -final[::-1])


# ---------------------------------------------------------------------------- what is known, and how well


@given(formula=formulas_of_leaves, run=leaf_runs())
def test_samples_only_narrow_the_interval_and_value_lies_in_it(formula, run):
    series, final = run_of(formula, run)
    value, lower, upper = series[:, VALUE], series[:, LOWER], series[:, UPPER]
    assert (lower[:, 1:] >= lower[:, :-1]).all()
    assert (upper[:, 1:] <= upper[:, :-1]).all()
    known = ~np.isnan(value)
    assert (lower[known] <= value[known]).all()
    assert (value[known] <= upper[known]).all()
    assert (lower[:, -1] <= final[:, 0]).all()
    assert (final[:, 0] <= final[:, 1]).all()
    assert (final[:, 1] <= upper[:, -1]).all()


@given(formula=formulas_of_leaves, run=leaf_runs())
def test_a_verdict_stays_once_it_is_settled(formula, run):
    series, final = run_of(formula, run)
    for lower, upper, ends in zip(series[:, LOWER], series[:, UPPER], final, strict=True):
        verdicts = [online_verdict(*interval) for interval in zip(lower, upper, strict=True)]
        settled = [verdict for verdict in verdicts if verdict is not Verdict.PENDING]
        assert verdicts == [Verdict.PENDING] * (len(verdicts) - len(settled)) + settled
        assert set(settled) <= {final_verdict(*ends)}


@given(data=st.data(), formula=formulas_of_leaves, run=leaf_runs())
def test_knowing_less_only_widens(data, formula, run):
    run = replace(run, channels=4)
    series, final = run_of(formula, run)
    less, less_final = run_of(formula, data.draw(widened(run)))
    assert (less[:, LOWER] <= series[:, LOWER]).all()
    assert (less[:, UPPER] >= series[:, UPPER]).all()
    assert (less_final[:, 0] <= final[:, 0]).all()
    assert (less_final[:, 1] >= final[:, 1]).all()


@given(formula=formulas_of_leaves, run=leaf_runs(max_size=6))
def test_a_verdict_holds_for_every_value_of_the_unknown(formula, run):
    """Any numbers in the place of what is unknown or uncertain lead to the verdict, where there is one."""
    run = replace(run, channels=4)
    verdict = final_verdict(*run_of(formula, run)[1][0])
    for end in ("low", "high"):
        exact = {
            leaf: tuple(Interval(getattr(interval, end), getattr(interval, end)) for interval in intervals)
            for leaf, intervals in run.wide.items()
        }
        filled = replace(run, nominal=exact, wide=exact)
        assert verdict in (Verdict.UNKNOWN, final_verdict(*run_of(formula, filled)[1][0]))


@few
@given(data=st.data(), specification=specifications(), recording=recordings(), more=st.floats(0, 5))
def test_more_uncertainty_makes_no_verdict_more_certain(data, specification, recording, more):
    names = data.draw(st.sets(st.sampled_from(NAMES)))
    before = everything_of(specification, recording)
    after = everything_of(specification, less_certain(recording, names, more))
    assert_no_more_certain(before, after)
    for first, second in zip(before, after, strict=True):
        np.testing.assert_array_equal(second.series[:, [VALUE, NOW]], first.series[:, [VALUE, NOW]])


def everything_of(specification, recording):
    """A specification's evaluation, over a template for every object."""
    each = {"ego": "all"} if specification.specs[0].parameter else None
    return evaluate(specification, recording.trace(), each=each)


def assert_no_more_certain(before, after):
    for first, second in zip(before, after, strict=True):
        assert second.verdict in (first.verdict, Verdict.UNKNOWN)
        assert (second.final[:, 0] <= first.final[:, 0]).all()
        assert (second.final[:, 1] >= first.final[:, 1]).all()


def less_certain(recording, names, more):
    samples = tuple(
        replace(
            sample,
            objects={
                name: replace(tracked, uncertainty=tracked.uncertainty + more * (name in names))
                for name, tracked in sample.objects.items()
            },
        )
        for sample in recording.samples
    )
    return replace(recording, samples=samples)


@few
@given(data=st.data(), specification=specifications(), recording=recordings())
def test_an_object_that_turns_unreadable_reads_neither_as_satisfied_nor_as_violated(
    data, specification, recording
):
    seen = [(t, name) for t, sample in enumerate(recording.samples) for name in sample.objects]
    assume(seen)
    lost = recording.unreadable | data.draw(st.sets(st.sampled_from(seen), min_size=1))
    before = everything_of(specification, recording)
    # A class is not lost with the coordinates: the object stays in its groups
    after = everything_of(specification, replace(recording, unreadable=lost))
    assert_no_more_certain(before, after)


CLOSED_WORDS = replace(WORDS, classes=(), groups=("pair", "people"), quantifiers=False)


@few
@given(
    data=st.data(),
    specification=specifications(CLOSED_WORDS),
    recording=recordings(),
    stranger=tracked_objects(certain=True),
)
def test_an_object_outside_every_open_group_changes_nothing(data, specification, recording, stranger):
    joined = tuple(
        replace(sample, objects={**sample.objects, "stranger": replace(stranger, class_name="bird")})
        if data.draw(st.booleans())
        else sample
        for sample in recording.samples
    )
    each = {"ego": "class:person"} if specification.specs[0].parameter else None
    before = evaluate(specification, recording.trace(), each=each)
    after = evaluate(specification, Recording(joined, recording.unreadable).trace(), each=each)
    assert bits(before) == bits(after)


# -------------------------------------------------------------------------------------- the same every time


def bits(evaluation):
    return [(result.object, result.series.tobytes(), result.final.tobytes()) for result in evaluation]


@few
@given(first=specifications(), second=specifications(), recording=recordings())
def test_the_cache_of_a_trace_changes_no_later_evaluation(first, second, recording):
    trace = recording.trace()
    for specification in (first, second, first):
        each = {"ego": "all"} if specification.specs[0].parameter else None
        kept = evaluate(specification, trace, each=each)
        assert bits(kept) == bits(everything_of(specification, recording))


_PRINT_BITS = """
import hashlib
from spatial_replay import Footprint, Sample, Trace, TrackedObject
from spatial_replay import evaluate, parse_specification

text = '''
region goal = box(0, 0, 4, 4)
group pair = d, a
group people = class "person"
spec s = G ((forall x, y in people: x dist y >= 1) and F[0,2] (pair ovlp goal) xor (a leftof c) U (b ovlp c))
spec t(ego) = H ((all except ego) dist ego >= 1)
'''
samples = [
    Sample(t, {
        name: TrackedObject(Footprint.disc(i + t / 3, i * t % 5, 1), "person" if i % 2 else "cart")
        for i, name in enumerate("abcde")
    })
    for t in range(9)
]
evaluation = evaluate(parse_specification(text), Trace.from_samples(samples), each={"ego": "all"})
print([(r.name, r.object, hashlib.sha256(r.series.tobytes()).hexdigest()) for r in evaluation])
"""


def test_hash_seeds_change_no_bit():
    printed = {
        subprocess.run(
            [sys.executable, "-c", _PRINT_BITS],
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(printed) == 1

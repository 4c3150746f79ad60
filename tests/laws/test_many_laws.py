"""Many traces evaluated together, against one evaluation after the other."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import recordings, specifications
from spatial_replay import Footprint, Sample, Trace, TrackedObject, UsageError, evaluate, parse_specification
from spatial_replay.monitor.result import evaluate_many

BITS = ("values", "final", "settled_ns", "times_ns", "series")


def check_equal(specification, traces, semantics):
    together = list(evaluate_many(specification, map(replace, traces), semantics=semantics))
    assert len(together) == len(traces)
    for trace, joint in zip(traces, together, strict=True):
        alone = evaluate(specification, replace(trace), semantics=semantics)
        for result, expected in zip(joint, alone, strict=True):
            for name in BITS:
                assert getattr(result, name).tobytes() == getattr(expected, name).tobytes(), name
            assert result.first_satisfied_ns == expected.first_satisfied_ns
            if semantics == "ltlf":
                assert result.tested == expected.tested
        if semantics == "ltlf":
            assert joint.explain() == alone.explain()
        assert joint.left_out == alone.left_out


@examples(200)
@given(
    specification=specifications(templates=False),
    runs=st.lists(recordings(), min_size=1, max_size=4),
    semantics=st.sampled_from(["ltlf", "ltlf", "paper"]),
)
def test_traces_evaluated_together_give_the_bits_of_each_alone(specification, runs, semantics):
    traces = [run.trace() for run in runs]
    try:
        check_equal(specification, traces, semantics)
    except UsageError:
        # the paper's semantics knows X, F, G and U only
        assert semantics == "paper"
        with pytest.raises(UsageError):
            evaluate(specification, traces[0], semantics=semantics)


def push(distances, *, start_ns=0, others=()):
    """A trace of a puck that is moved; `others` are there as well, or are missing."""
    samples = []
    for place, distance in enumerate(distances):
        own = {"puck": 0.0, "goal": 0.1 + distance, **dict.fromkeys(others, 5.0)}
        objects = {name: TrackedObject(Footprint.box(x, 0, x + 0.1, 0.1)) for name, x in own.items()}
        samples.append(Sample(start_ns + place * 100_000_000, objects))
    return Trace.from_samples(samples)


@pytest.mark.parametrize("semantics", ["ltlf", "paper"])
def test_runs_of_other_lengths_objects_and_times_do_not_touch_each_other(semantics):
    specification = parse_specification(
        "spec reached = F (puck dist goal <= 0.05)\n"
        "spec soon    = F[0.1s,0.3s] (puck dist goal <= 0.2)\n"
        "spec answers = G ((puck dist goal <= 0.3) -> X (puck dist goal <= 0.2))\n"
        "spec clear   = G (puck dist lamp >= 1)\n"
    )
    traces = [
        push([0.5, 0.3, 0.1, 0.02]),
        push([0.02], start_ns=10**18),
        push([0.4, 0.4, 0.25, 0.4, 0.4, 0.4], others=["lamp"]),
        push([0.3, 0.01], start_ns=5, others=["lamp", "cup"]),
    ]
    check_equal(specification, traces, semantics)
    verdicts = [str(each.result("reached").verdict) for each in evaluate_many(specification, traces)]
    assert verdicts == ["satisfied", "satisfied", "violated", "satisfied"]


def test_terms_that_look_back_begin_in_each_trace():
    specification = parse_specification(
        "spec still = G (puck[-1] dist puck <= 0.01)\nspec slow = G (speed(goal) <= 5)"
    )
    check_equal(specification, [push([0.5, 0.3, 0.1]), push([0.5, 0.5]), push([0.2])], "ltlf")
    check_equal(specification, [push([0.5, 0.3, 0.1]), push([0.5, 0.5]), push([0.2])], "paper")

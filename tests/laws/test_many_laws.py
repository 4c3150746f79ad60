"""Many traces evaluated together, against one evaluation after the other."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import recordings, specifications
from spatial_replay import evaluate
from spatial_replay.monitor.result import evaluate_many


@examples(200)
@given(specification=specifications(templates=False), runs=st.lists(recordings(), min_size=1, max_size=4))
def test_traces_evaluated_together_give_the_bits_of_each_alone(specification, runs):
    traces = [run.trace() for run in runs]
    together = list(evaluate_many(specification, map(replace, traces)))
    assert len(together) == len(traces)
    for trace, joint in zip(traces, together, strict=True):
        alone = evaluate(specification, replace(trace))
        for result, expected in zip(joint, alone, strict=True):
            for name in ("values", "final", "settled_ns", "times_ns", "series"):
                assert getattr(result, name).tobytes() == getattr(expected, name).tobytes(), name
            assert (result.first_satisfied_ns, result.tested) == (
                expected.first_satisfied_ns,
                expected.tested,
            )
        assert joint.explain() == alone.explain()

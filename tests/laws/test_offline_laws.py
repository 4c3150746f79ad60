"""Robustness at every sample of finished logs, against a slow reading of the definitions."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from laws.reference import Prefix
from laws.strategies_monitor import formulas_of_leaves, leaf_runs
from spatial_replay.monitor.offline import evaluate_offline, full_signal, window_signal
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.spec.formula import iter_nodes


def nodes_of(formula):
    return [node for _, _, node in iter_nodes(formula)]


def number(interval):
    return interval.low if interval.low == interval.high else np.nan


def stretch(run, leaf, begin, end):
    """The samples from begin to before end of a run, as if there were no others."""
    return Prefix(run.times_ns[begin:end], lambda formula, t: leaf(formula, begin + t), goes_on=False)


@examples(400)
@given(formula=formulas_of_leaves, run=leaf_runs())
def test_every_node_at_every_sample_equals_the_definitions(formula, run):
    order, times = compile_formula(formula).leaves, np.array(run.times_ns)
    leaves = run.values(order)
    done = evaluate_offline(formula, order, leaves, times)
    kinds = [(False, run.nominal_leaf), (True, run.wide_leaf if run.channels == 4 else run.nominal_leaf)]
    for is_wide, leaf in kinds:
        whole = stretch(run, leaf, 0, len(run))
        for index, node in enumerate(nodes_of(formula)):
            expected = np.array([whole.rho(node, t) for t in range(len(run))]).T
            if run.channels == 1:
                expected[1] = expected[0]
            np.testing.assert_array_equal(done.ends(index, wide=is_wide), expected)
    whole = stretch(run, run.nominal_leaf, 0, len(run))
    signal = [[number(whole.rho(node, t)) for t in range(len(run))] for node in nodes_of(formula)]
    np.testing.assert_array_equal(full_signal(formula, order, leaves, times), signal)


@examples(200)
@given(formula=formulas_of_leaves, run=leaf_runs(), width_ns=st.sampled_from([1, 100, 101, 300, 10**6]))
def test_a_window_equals_a_run_of_its_own(formula, run, width_ns):
    order, times = compile_formula(formula).leaves, np.array(run.times_ns)
    signal = window_signal(formula, order, run.values(order), times, width_ns)
    for t in range(len(run)):
        begin = next(s for s in range(t + 1) if run.times_ns[s] > run.times_ns[t] - width_ns)
        window = stretch(run, run.nominal_leaf, begin, t + 1)
        np.testing.assert_array_equal(
            signal[:, t], [number(window.rho(node, 0)) for node in nodes_of(formula)]
        )

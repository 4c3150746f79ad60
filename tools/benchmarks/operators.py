"""Temporal operators alone, over a finished signal: the robustness at each sample to the end."""

from __future__ import annotations

import importlib.util
import random
import statistics
import time
from typing import Any

import numpy as np

import spatial_replay as sr
from spatial_replay.monitor.offline import full_signal
from spatial_replay.monitor.online.program import compile_formula

MILLION = 1_000_000
WIDTHS = (10, 1000, 100_000)
WIDER_LIMIT = 1.2
"""How much longer any width of a window may take than the quickest."""


def _formula(operator: str, bound: str) -> Any:
    left = "p >= 0 " if operator == "U" else ""
    right = "q >= 0" if operator == "U" else "p >= 0"
    return sr.parse_specification(f"{left}{operator}{bound} ({right})").specs[0].formula


def bench_operators(bench: Any) -> None:
    """F, G and U over a million samples, for windows of several widths, in samples and in seconds."""
    values = np.random.default_rng(0).normal(size=(1, 2, MILLION))
    times_ns = np.arange(MILLION, dtype=np.int64) * 10_000_000
    widths = [f"[0,{width}]" for width in WIDTHS]
    for operator in ("F", "G", "U"):
        medians = {}
        for bound, times in _times(operator, [*widths, "[0s,10s]", ""], values, times_ns).items():
            bench.quantile(f"{operator}{bound or ' unbounded'}", times, 0.5, unit="signal", limit_s=20e-3)
            medians[bound] = statistics.median(times)
        bounded = [medians[width] for width in widths]
        bench.ratio(f"{operator}: slowest width to quickest", max(bounded) / min(bounded), WIDER_LIMIT)
        bench.ratio(f"{operator}: unbounded to quickest", medians[""] / min(bounded), 1.0)


def _times(operator: str, bounds: list[str], values: Any, times_ns: Any) -> dict[str, list[float]]:
    """Of each bound in turn, so that what else the machine does falls on all alike."""
    formulas = {bound: _formula(operator, bound) for bound in bounds}
    orders = {bound: compile_formula(formula).leaves for bound, formula in formulas.items()}
    times: dict[str, list[float]] = {bound: [] for bound in bounds}
    for turn in range(10):
        for bound, formula in formulas.items():
            order = orders[bound]
            leaves = np.ascontiguousarray(values[:, : len(order)])
            start = time.perf_counter()
            full_signal(formula, order, leaves, times_ns)
            if turn > 0:
                times[bound].append(time.perf_counter() - start)
    return times


def bench_offline_peers(bench: Any) -> None:
    """A bounded until over 10,000 samples, by us and by rtamt, value for value the same."""
    if importlib.util.find_spec("rtamt") is None:
        bench.remark("rtamt is not installed, and not measured")
        return
    import rtamt

    count, width = 10_000, 100
    source = random.Random(0)
    signals = {name: [source.uniform(-1, 5) for _ in range(count)] for name in "pq"}
    specification = rtamt.StlDiscreteTimeSpecification()
    for name in signals:
        specification.declare_var(name, "float")
    specification.spec = f"(p >= 0) until[0:{width}] (q >= 0)"
    specification.parse()
    start = time.perf_counter()
    theirs = specification.evaluate({"time": list(range(count)), **signals})
    reference_s = time.perf_counter() - start
    trace = sr.Trace.from_samples(
        sr.Sample(k, signals={name: values[k] for name, values in signals.items()}) for k in range(count)
    )
    ours = sr.parse_specification(f"(p >= 0) U[0,{width}] (q >= 0)")
    inside = slice(0, count - width)
    if not np.array_equal(
        sr.evaluate(ours, trace).result().full_signal()[0][inside], [value for _, value in theirs][inside]
    ):
        raise RuntimeError("rtamt does not give the same values")
    inquiry = sr.evaluate(ours, trace).result()
    bench.measure(
        f"U over {width}: spatial-replay against rtamt",
        lambda _: inquiry.full_signal(),
        unit="signal",
        reference_s=reference_s,
    )

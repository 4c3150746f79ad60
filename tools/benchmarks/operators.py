"""Temporal operators alone: over a finished signal, and sample by sample with nested windows."""

from __future__ import annotations

import importlib.util
import random
import statistics
import time
from typing import Any

import numpy as np

import spatial_replay as sr
from spatial_replay.compiled import compile_ahead
from spatial_replay.monitor.offline import full_signal
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.monitor.online.step import OnlineRun

MILLION = 1_000_000
WIDTHS = (10, 1000, 100_000)
WIDER_LIMIT = 1.2
"""Limit of the ratio between the times of the slowest and of the fastest window width."""
LIMITS_S = {"F": 20e-3, "G": 20e-3, "U": 60e-3}


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
            bench.quantile(
                f"{operator}{bound or ' unbounded'}", times, 0.5, unit="signal", limit_s=LIMITS_S[operator]
            )
            medians[bound] = statistics.median(times)
        bounded = [medians[width] for width in widths]
        bench.ratio(f"{operator}: slowest width to quickest", max(bounded) / min(bounded), WIDER_LIMIT)
        bench.ratio(f"{operator}: unbounded to quickest", medians[""] / min(bounded), 1.0)


def _times(operator: str, bounds: list[str], values: Any, times_ns: Any) -> dict[str, list[float]]:
    """Return the times of each bound, measured in turn, so that other load affects all equally."""
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


ONLINE = 1_000_000
RESPONSES = {
    "G (a -> F[0,w] b)": "G (p >= 0 -> F{bound} q >= 0)",
    "G (a -> G[0,w] b)": "G (p >= 0 -> G{bound} q >= 0)",
    "G (a -> c U[0,w] b)": "G (p >= 0 -> q >= 1 U{bound} q >= 0)",
    "G (a -> F[0,5] G[0,w] b)": "G (p >= 0 -> F[0,5] G{bound} q >= 0)",
}
GENERAL = "G (a -> F[0,5] G[0,w] b)"
"""A formula whose windows are evaluated backwards at each sample."""


def bench_online_windows(bench: Any) -> None:
    """Bounded operators below an unbounded one, every prefix, against `G (a -> b)`; processor time."""
    compile_ahead()
    source = np.random.default_rng(0).normal(size=(1, 3, ONLINE))
    for name, text in RESPONSES.items():
        is_general = name == GENERAL
        widths = (10, 100) if is_general else (10, 100, 1000, 10_000, 100_000)
        in_samples = {f"{width}": text.format(bound=f"[0,{width}]") for width in widths}
        in_seconds = {f"{width / 100:g} s": text.format(bound=f"[0s,{width / 100}s]") for width in widths}
        plain = {"": "G (p >= 0 -> q >= 0)"}
        times = _online_times(
            plain | in_samples | in_seconds, source[:, :, :10_000] if is_general else source
        )
        for width, own in times.items():
            label = f"{name}, {width}" if width else "G (a -> b)"
            bench.quantile(label, own, 0.5, limit_s=None if is_general else 2e-6)
        if is_general:
            continue
        fastest = {width: min(own) for width, own in times.items()}
        for unit, group in (("samples", in_samples), ("seconds", in_seconds)):
            flat = [fastest[width] for width in group]
            bench.ratio(f"{name}, {unit}: slowest to quickest", max(flat) / min(flat), WIDER_LIMIT)
        # a formula without a window takes about 35 ns per sample, half of it for storing the numbers
        bench.ratio(f"{name}: to G (a -> b)", max(fastest.values()) / fastest[""], 8.0)


def _online_times(texts: dict[str, str], leaves: Any) -> dict[str, list[float]]:
    """Return processor times per sample of each formula, in turn, so that other load affects all equally."""
    programs = {
        name: compile_formula(sr.parse_specification(text).specs[0].formula) for name, text in texts.items()
    }
    times_ns = np.arange(leaves.shape[2], dtype=np.int64) * 10_000_000
    times: dict[str, list[float]] = {name: [] for name in texts}
    for turn in range(6):
        for name, program in programs.items():
            run = OnlineRun(program)
            start = time.process_time()
            run.extend(leaves[:, : len(program.leaves)], times_ns)
            if turn > 0:
                times[name].append((time.process_time() - start) / len(times_ns))
    return times


def bench_offline_peers(bench: Any) -> None:
    """A bounded until over 10,000 samples, by this package and by rtamt, with equal values."""
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

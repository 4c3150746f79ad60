"""Automata of specifications: by the compiler of the package, through MONA, and many at once."""

from __future__ import annotations

import shutil
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import spatial_replay as sr
from spatial_replay.simulation.worlds import default_specification

RESPONSES = " and ".join(f"(G ((a{n} >= 0) -> F b{n} >= 0))" for n in range(4))
"""Four requests, each of which is to be answered: 16 states, 256 transitions."""

PICK_PLACE = default_specification("pick-place").source
"""The paper's pick-and-place: 32 states, 243 transitions."""

DEADLINE = "G ((a >= 0) -> F[0, 1000] b >= 0)"
"""A request that is to be answered within 1000 samples: 1002 states, which MONA does not find."""

TASKS = {"4 responses": RESPONSES, "pick-place": PICK_PLACE}
LIMIT_S = 0.05


def bench_automaton(measure: Any) -> None:
    """From a parsed specification to an automaton with its guards."""
    for name, text in TASKS.items():
        specification = sr.parse_specification(text)
        measure(f"{name}, own", lambda _, it=specification: sr.automaton(it, compiler="own"), limit_s=LIMIT_S)
        if shutil.which("mona") is None:
            measure.remark(f"{name} through MONA is not measured: apt-get install mona")
            continue
        measure(
            f"{name}, MONA",
            lambda _, it=specification: sr.automaton(it, compiler="mona"),
            limit_s=LIMIT_S,
            # the library's own way to an automaton, on another machine
            reference_s=23.0 if text is RESPONSES else None,
        )
    deadline = sr.parse_specification(DEADLINE)
    measure("deadline in 1000 samples, own", lambda _: sr.automaton(deadline, compiler="own"))


def bench_automata_at_once(measure: Any) -> None:
    """100 automata from 4 processes at once, each compared with what one process alone makes."""
    compiler = "own" if shutil.which("mona") is None else "mona"
    jobs = [(list(TASKS.values())[n % 2], compiler) for n in range(100)]
    expected = [sr.automaton(sr.parse_specification(text), compiler="own") for text, _ in jobs]

    def run(_: object) -> None:
        with ProcessPoolExecutor(4) as pool:
            if list(pool.map(_compiled, jobs)) != expected:
                raise RuntimeError("automata made at once differ from those made alone")

    measure(f"4 processes, {compiler}", run, per=100, unit="automaton", runs=3)


def _compiled(job: tuple[str, Any]) -> sr.Automaton:
    text, compiler = job
    return sr.automaton(sr.parse_specification(text), compiler=compiler)

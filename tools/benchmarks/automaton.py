"""Automata of specifications: by the compiler of the package, through MONA, and many at once."""

from __future__ import annotations

import shutil
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import spatial_replay as sr

RESPONSES = " and ".join(f"(G ((a{n} >= 0) -> F b{n} >= 0))" for n in range(4))
"""Four requests, each of which is to be answered: 16 states, 256 transitions."""

PLACINGS = " and ".join(
    [*(f"(F item{n} enclosedin place{n})" for n in range(5)), "(G not (hand ovlp person))"]
)
"""Five items to be placed while a person keeps clear: 33 states, 276 transitions with that of the trap."""

TASKS = {"4 responses": RESPONSES, "5 placings": PLACINGS}
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

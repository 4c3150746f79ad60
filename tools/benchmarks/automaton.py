"""Automata of specifications, by the package's compiler, through MONA, and in several processes at once."""

from __future__ import annotations

import shutil
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import spatial_replay as sr
from spatial_replay.automata.automaton import Automaton
from spatial_replay.simulation.tabletop import default_specification


def _responses(count: int) -> str:
    return " and ".join(f"(G ((a{n} >= 0) -> F b{n} >= 0))" for n in range(count))


RESPONSES = _responses(4)
"""Four requests with responses: 16 states, 256 transitions."""

MANY_S = 1.0
"""Limit for twelve requests, seconds: 4,096 states, 49,152 decisions, 16.8 million transitions."""

DEADLINES = " and ".join(f"(F[0, 300] a{n} >= 0)" for n in range(4))
"""Four tasks, each with 300 samples: 4,503 states."""

PICK_PLACE = default_specification("pick-place").source
"""The paper's pick-and-place: 32 states, 243 transitions."""

DEADLINE = "G ((a >= 0) -> F[0, 1000] b >= 0)"
"""A request with a response within 1000 samples: 1002 states, which MONA does not find."""

TASKS = {"4 responses": RESPONSES, "pick-place": PICK_PLACE}
LIMIT_S = 0.05


def bench_automaton(measure: Any) -> None:
    """Time from a parsed specification to an automaton with its guards."""
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
            # the library's own compiler, measured on another machine
            reference_s=23.0 if text is RESPONSES else None,
        )
    deadline = sr.parse_specification(DEADLINE)
    measure("deadline in 1000 samples, own", lambda _: sr.automaton(deadline, compiler="own"))
    deadlines = sr.parse_specification(DEADLINES)
    measure("four deadlines in 300 samples, own", lambda _: sr.automaton(deadlines, compiler="own"))


def bench_many_responses(measure: Any) -> None:
    """Automata with too many transitions to list; the time may grow as the number of decisions, 24 times."""
    eight, twelve = (sr.parse_specification(_responses(count)) for count in (8, 12))
    few = measure("8 responses", lambda _: sr.automaton(eight, compiler="own"))
    many = measure("12 responses", lambda _: sr.automaton(twelve, compiler="own"), limit_s=MANY_S)
    measure.ratio("12 responses, of 8", many.median_s / few.median_s, 24.0)


def bench_doctor(measure: Any) -> None:
    """Findings of `doctor`, and the shortest runs of results, placed and evaluated."""
    spatial = " and ".join(f"(G (a{n} leftof b{n} -> F a{n} ovlp b{n}))" for n in range(12))
    several = "\n".join(
        f"spec s{n} = G (a dist b >= 0.{n + 10}) and F (a leftof c{n} and b ovlp c{n})" for n in range(12)
    )
    deadline = "G (a leftof b -> F[0, 1000] a ovlp b)"
    row = " and ".join(f"a{n} leftof a{n + 1}" for n in range(30))
    tasks = {"pick-place": PICK_PLACE, "12 responses": spatial, "12 specs": several, "1000 samples": deadline}
    shared = [
        f"(G (o{n % 5} leftof o{(n + 2) % 5} -> F[0, 3] o{n % 4} ovlp o{(3 * n + 1) % 4}))" for n in range(14)
    ]
    tasks["14 responses about 5 objects"] = " and ".join(shared)
    tasks["31 objects in a row, or in a ring"] = f"(F ({row})) or (F ({row} and a30 leftof a0))"
    for name, text in tasks.items():
        specification = sr.parse_specification(text)
        measure(f"doctor, {name}", lambda _, it=specification: sr.doctor(it), limit_s=1.0)


def bench_automata_at_once(measure: Any) -> None:
    """100 automata from 4 processes at once, each compared with the automaton of a single process."""
    compiler = "own" if shutil.which("mona") is None else "mona"
    jobs = [(list(TASKS.values())[n % 2], compiler) for n in range(100)]
    expected = [sr.automaton(sr.parse_specification(text), compiler="own") for text, _ in jobs]

    def run(_: object) -> None:
        with ProcessPoolExecutor(4) as pool:
            if list(pool.map(_compiled, jobs)) != expected:
                raise RuntimeError("automata made at once differ from those made alone")

    measure(f"4 processes, {compiler}", run, per=100, unit="automaton", runs=3)


def _compiled(job: tuple[str, Any]) -> Automaton:
    text, compiler = job
    return sr.automaton(sr.parse_specification(text), compiler=compiler)

"""Automata that MONA made, to compare with where there is no MONA.

python tests/automata/golden.py     writes golden.json; needs MONA
"""

from __future__ import annotations

import json
from pathlib import Path

from spatial_replay import automaton, parse_specification
from spatial_replay.automata.automaton import Automaton

FILE = Path(__file__).with_name("golden.json")
FORMULAS = (
    "p >= 0",
    "true",
    "false",
    "not (p >= 0)",
    "F p >= 0",
    "G p >= 0",
    "X p >= 0",
    "WX p >= 0",
    "X X WX p >= 0",
    "F G p >= 0",
    "G F p >= 0",
    "G ((p >= 0) -> F q >= 0)",
    "G ((p >= 0) -> X q >= 0)",
    "G ((p >= 0) <-> X q >= 0)",
    "(p >= 0) U (q >= 0)",
    "(p >= 0) R (q >= 0)",
    "(p >= 0) W (q >= 0)",
    "not ((p >= 0) W (q >= 0))",
    "((p >= 0) U (q >= 0)) U (r >= 0)",
    "(F p >= 0) xor (G q >= 0)",
    "(F p >= 0) <-> (X q >= 0)",
    "F[2, 4] p >= 0",
    "G[1, 3] p >= 0",
    "F[3, inf] p >= 0",
    "(p >= 0) U[1, 3] (q >= 0)",
    "(p >= 0) R[1, 2] (q >= 0)",
    "(p >= 0) W[0, 2] (q >= 0)",
    "(p >= 0) W[2, inf] (q >= 0)",
    "not ((p >= 0) W[1, 2] (q >= 0))",
    "F[0, 2] G[0, 2] p >= 0",
    "G ((p >= 0) -> F[0, 12] q >= 0)",
    "F ((p >= 0) and G[0, 12] q >= 0)",
    "G ((p >= 0) -> (r >= 0) U[0, 11] (q >= 0))",
    "F ((p >= 0) and ((r >= 0) R[0, 11] (q >= 0)))",
    "(G p >= 0) and (F not (p >= 0))",
    "(G ((p >= 0) -> F q >= 0)) and (G ((r >= 0) -> F s >= 0))",
    "(F p >= 0) and (F q >= 0) and (F r >= 0) and (G s >= 0) and ((not (p >= 0)) U (q >= 0))",
)


def as_values(machine: Automaton) -> dict[str, object]:
    """What of an automaton is compared."""
    return {
        "accepting": sorted(machine.accepting),
        "entries": list(machine.entries),
        "decisions": [list(row) for row in machine.decisions],
    }


if __name__ == "__main__":
    made = {text: as_values(automaton(parse_specification(text), compiler="mona")) for text in FORMULAS}
    lines = ",\n".join(f"  {json.dumps(text)}: {json.dumps(values)}" for text, values in made.items())
    FILE.write_text(f"{{\n{lines}\n}}\n")

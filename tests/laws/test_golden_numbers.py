"""The four numbers of every node over long runs stay the same to the bit.

`python tests/laws/test_golden_numbers.py` writes the hashes again, for a change of meaning only.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np

from spatial_replay import parse_specification
from spatial_replay.compiled import only
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.monitor.online.step import OnlineRun

GOLDEN = Path(__file__).with_suffix(".json")
SAMPLES = 20_000
PIECES = 7_000
"""Samples that come together."""

FORMULAS = (
    # no window
    "p",
    "not (p and q) xor r",
    "G p",
    "F (p and q) -> G r",
    "G (p -> F q)",
    "F G p",
    "p U (q and F r)",
    "(p R q) and (q W r)",
    "G (p -> (q U r))",
    "G (p -> F (q and F (r and F p)))",
    "(G p) U q",
    # past
    "G (p -> O q)",
    "H p and Y q",
    "G (p -> O[0,50] q)",
    "G (p -> H[0s,0.5s] q)",
    "G (p -> (q S r))",
    "F (p and (q S[10,200] r))",
    "G (p -> O[0.1s,inf] q)",
    "O F[0,20] p",
    "O (p and F[0,20] q)",
    "H (p -> G[0s,0.2s] q)",
    "G (p -> O[0,60] (q and F[0,60] r))",
    "p S (q and F[0,30] r)",
    "Y G[0,5] p",
    # one window
    "G (p -> F[0,10] q)",
    "G (p -> F[0,1000] q)",
    "G (p -> F[5,600] q)",
    "G (p -> F[0s,3s] q)",
    "G (p -> F[0.2s,0.7s] q)",
    "G (p -> G[0,300] q)",
    "F (p and G[0,300] q)",
    "F (p and F[0s,1s] q)",
    "G (p -> X q)",
    "F (p and WX q)",
    "G (p -> F[3,3] q)",
    "G (p -> (q U[0,100] r))",
    "G (p -> (q U[20,100] r))",
    "F (p and (q R[0s,1s] r))",
    "G (p -> (q W[0,100] r))",
    "G[0,5000] p",
    "F[100,5000] (p and q)",
    "p U[0,3000] q",
    "(p R[0s,60s] q) or r",
    "G (F[0,100] p or G[0,100] q)",
    "G (F[0,40] p and (q -> F[0,90] r))",
    "G ((p -> F[0,80] q) and (q -> F[0s,2s] r))",
    "p U (q and F[0,100] r)",
    # two windows
    "G (p -> F[0,60] (q and F[0,60] r))",
    "G (p -> F[0s,0.6s] (q and F[0s,0.6s] r))",
    "G (p -> F[0,60] G[0,60] q)",
    "G (p -> F[0,300] G[0,300] q)",
    "F (p and G[0,60] F[10,40] q)",
    "G (p -> F[0,60] (q U[0,60] r))",
    "G (p -> F (q and F[0,40] r))",
    "G (p -> (F[0,30] q) U[0,30] r)",
    "F (p and (G[0,40] (q S[0,20] r)))",
    "G[0,8000] (p -> F[0,60] (q and F[0,60] r))",
    "G[0s,90s] (p -> F (q and G[0,50] r))",
    "(G[0,30] p) U (F[0,30] q)",
    # three windows
    "G (p -> F[0,30] (q and F[0,30] (r and F[0,30] p)))",
    "G (p -> F[0,20] G[0,20] F[0,20] q)",
    # nodes that share parts
    "G (p -> F[0,40] q) and not F (r and G[5,15] p)",
    "G (p -> F[0,10] q) xor G[0,500] r",
)


def formula_of(text):
    return parse_specification(re.sub(r"\b[pqr]\b", r"\g<0> >= 0", text)).specs[0].formula


def signals():
    """The name of each signal, and what the leaves p, q and r are in its channels: (C, 3, SAMPLES)."""
    source = np.random.default_rng(44)
    noise = np.round(source.normal(size=(3, SAMPLES)), 2)
    slow = -np.arange(SAMPLES) / 1000
    # the condition always holds and the response gets worse: positions matter until their windows close
    falling = np.stack([np.full(SAMPLES, 1000.0), *(slow + source.normal(size=(2, SAMPLES)) * 0.3)])
    unknown = np.stack([noise, noise])
    lost = (source.random((3, SAMPLES)) < 0.02) & (np.arange(SAMPLES) > SAMPLES // 4)
    unknown[0, lost], unknown[1, lost] = -np.inf, np.inf
    spread = np.where(np.arange(SAMPLES) % 3000 < 1000, 0.25, 0.0)
    uncertain = np.concatenate([unknown, [unknown[0] - spread, unknown[1] + spread]])
    return {"noise": noise[None], "falling": falling[None], "unknown": unknown, "uncertain": uncertain}


def hash_of(program, leaves, times_ns):
    names = [leaf.text[0] for leaf in program.leaves]
    own = np.ascontiguousarray(leaves[:, ["pqr".index(name) for name in names]])
    run, digest = OnlineRun(program), hashlib.sha256()
    for begin in range(0, SAMPLES, PIECES):
        piece = slice(begin, begin + PIECES)
        digest.update(run.extend(own[:, :, piece], times_ns[piece]).tobytes())
        digest.update(run.final.tobytes())
    return digest.hexdigest()[:20]


def found():
    # 10 ms apart, but for some gaps and bursts
    steps = np.random.default_rng(45).choice([10, 10, 10, 10, 4, 16, 150], SAMPLES) * 10**6
    times_ns, of_signals = np.cumsum(steps), signals()
    programs = {text: compile_formula(formula_of(text)) for text in FORMULAS}
    with only("compiled"):
        return {
            text: {name: hash_of(program, leaves, times_ns) for name, leaves in of_signals.items()}
            for text, program in programs.items()
        }


def test_the_numbers_of_every_node_stay_the_same_to_the_bit():
    assert found() == json.loads(GOLDEN.read_text())


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps(found(), indent=1) + "\n")

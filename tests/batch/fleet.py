"""Short logs of a cart that passes a person, and batches over them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from cli.program import run_program

GATE = """\
# at least as far apart as in the standard
spec apart   "REQ-3: keep 30 cm from people" = G (cart dist person >= 0.3)
spec arrives "REQ-4: get to the person"      = F (cart dist person <= 1)
"""


def write_log(path: Path, distance: float, samples: int = 4) -> Path:
    """Write a log in which the cart's least distance from the person is this one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    y = 0.4 + distance
    person = {"name": "person", "polygon": [[0, y], [3, y], [3, y + 0.3], [0, y + 0.3]]}
    with path.open("w") as stream:
        for step in range(samples):
            x = 0.1 * step
            cart = {"name": "cart", "polygon": [[x, 0], [x + 0.4, 0], [x + 0.4, 0.4], [x, 0.4]]}
            stream.write(json.dumps({"time_ns": step * 100_000_000, "objects": [cart, person]}) + "\n")
    return path


def write_fleet(folder: Path, distances: list[float]) -> None:
    """Write a specification, and a log for each distance: logs/run-0.jsonl and so on."""
    (folder / "gate.spatial").write_text(GATE)
    for number, distance in enumerate(distances):
        write_log(folder / f"logs/run-{number}.jsonl", distance)


class Done(NamedTuple):
    """A command's exit code, and what it said."""

    code: int
    out: str
    err: str


def command(*arguments: str) -> Done:
    """Run the program in this process, from the current folder."""
    done = run_program(*arguments, cwd=Path())
    return Done(done.returncode, done.stdout, done.stderr)


def batch(*arguments: str) -> Done:
    """Run a batch in this process."""
    return command("batch", "--jobs", "1", *arguments)

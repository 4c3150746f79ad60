"""Damaged machine code on disk: it must be compiled again without a message, and never run."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from attacks.cases import Case, Outcome
from attacks.results import draw_edits, edit_file

_PROGRAM = """
import numpy as np
from spatial_replay.compiled import compile_ahead, kernel

@kernel
def doubled(number):
    return 2 * number

@kernel
def total(numbers):
    result = 0.0
    for number in numbers:
        result += doubled(number)
    return result

compile_ahead()
print(total(np.arange(100.0)))
"""


class Code:
    """A folder of machine code with random edits of its files, and a program that loads from the folder."""

    name = "code"
    most_cpu_s = None
    uses_files = True

    def ready(self) -> None:
        _sound()

    def draw(self, rng: random.Random) -> Case:
        return {"edits": draw_edits(rng), "keeps_time": rng.random() < 0.7}

    def kept(self, case: Case, folder: Path) -> Case:
        """See `Attack`."""
        return case

    def run(self, case: Case, folder: Path) -> Outcome:
        program = _sound()
        shutil.copytree(program.with_name("cache"), folder / "cache")
        for edit in case["edits"]:
            edit_file(folder / "cache", *edit, keeps_time=case["keeps_time"])
        # the second time, it loads what the first one has compiled again
        return Outcome([problem for _ in range(2) for problem in _problems(program, folder / "cache")])


@cache
def _sound() -> Path:
    """Return the program; its machine code is in the folder `cache` next to it."""
    program = Path(mkdtemp(prefix="campaign-")) / "work.py"
    program.write_text(_PROGRAM)
    if problems := _problems(program, program.with_name("cache")):
        raise RuntimeError(*problems)
    return program


def _problems(program: Path, cached: Path) -> list[str]:
    """Run the program with a folder of machine code; return the problems of its output."""
    own = {**os.environ, "SPATIAL_REPLAY_CACHE": str(cached), "SPATIAL_REPLAY_KERNELS": "compiled"}
    done = subprocess.run(
        [sys.executable, str(program)], env=own, capture_output=True, text=True, check=False
    )
    if (done.returncode, done.stdout) == (0, "9900.0\n") and "Traceback" not in done.stderr:
        return []
    return [f"the program ends with {done.returncode} and prints {done.stdout!r}: {done.stderr[-400:]}"]

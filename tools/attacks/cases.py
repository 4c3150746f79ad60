"""Cases of an attack: drawn from a seed, run in turn, and written as files if they find a problem.

A case is JSON, with all data of a second run. `draw` returns a case; `run` runs it and returns its problems.
"""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

Case = dict[str, Any]

MOST_MEMORY_BYTES = 500 * 10**6
"""Maximum memory of a process under attack, bytes."""


@dataclass
class Outcome:
    """Outcome of a case.

    Attributes:
        problems: a sentence for each problem.
        counts: figures whose sum over cases counts.
        worst: figures whose maximum over cases counts.
    """

    problems: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    worst: dict[str, float] = field(default_factory=dict)

    def take_in(self, other: Outcome) -> None:
        """Add the figures of another outcome."""
        for name, count in other.counts.items():
            self.counts[name] = self.counts.get(name, 0) + count
        for name, figure in other.worst.items():
            self.worst[name] = max(self.worst.get(name, 0.0), figure)


class Attack(Protocol):
    """A source of cases.

    Attributes:
        name: name of the attack on the command line.
        most_cpu_s: maximum processor time of a case, seconds; None for no limit.
        uses_files: whether a case needs a folder.
    """

    name: str
    most_cpu_s: float | None
    uses_files: bool

    def draw(self, rng: random.Random) -> Case:
        """Return a case."""

    def run(self, case: Case, folder: Path) -> Outcome:
        """Run a case in an empty folder."""

    def kept(self, case: Case, folder: Path) -> Case:
        """Return the case in its stored form, which does not depend on the drawing of cases."""

    def ready(self) -> None:
        """Prepare shared data before the first case is timed."""


def run_case(attack: Attack, case: Case, *, is_timed: bool) -> Outcome:
    """Run a case in a folder of its own.

    Args:
        is_timed: whether to check processor time and memory; a slow case runs twice.
    """
    outcome, cpu_s = _timed(attack, case)
    limit = attack.most_cpu_s
    if is_timed and limit is not None and cpu_s > limit:
        cpu_s = min(cpu_s, _timed(attack, case)[1])
        if cpu_s > limit:
            outcome.problems.append(f"it takes {cpu_s:.1f} s of processor time; the limit is {limit:.0f} s")
    outcome.worst["cpu_s"] = cpu_s
    if is_timed:
        held_mb = max(memory_bytes() / 1e6, outcome.worst.get("memory_mb", 0.0))
        outcome.worst["memory_mb"] = held_mb
        if held_mb > MOST_MEMORY_BYTES / 1e6:
            outcome.problems.append(f"a process holds {held_mb:.0f} MB")
    return outcome


def memory_bytes(process: int | str = "self") -> int:
    """Return the peak memory of a process."""
    # what `getrusage` returns is inherited from the process that started this one
    status = Path(f"/proc/{process}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


def _timed(attack: Attack, case: Case) -> tuple[Outcome, float]:
    with TemporaryDirectory(prefix="campaign-") if attack.uses_files else nullcontext("") as folder:
        began_s = time.process_time()
        try:
            outcome = attack.run(case, Path(folder))
        # whatever an attack raises is a finding
        except Exception as error:
            outcome = Outcome([f"{type(error).__name__}: {error}"])
        return outcome, time.process_time() - began_s


def run_cases(
    attack: Attack,
    seed: str,
    *,
    goes_on: Callable[[int], bool],
    findings: Path | None = None,
    current: Path | None = None,
    is_timed: bool = False,
) -> Outcome:
    """Run cases; the outcome has the problems of all cases.

    Args:
        seed: determines each case, together with the number of the case.
        goes_on: takes the number of cases so far; returns whether to go on.
        findings: folder for cases with problems.
        current: file whose first line is the running case, for a parent that outlives this process.
    """
    total = Outcome(counts={"cases": 0, "findings": 0})
    attack.ready()
    # open all the time: to open a file costs as much as to parse a text
    running = None if current is None else current.open("w")
    for number in _counting(goes_on):
        case = attack.draw(random.Random(f"{attack.name} {seed} {number}"))
        if running is not None:
            running.seek(0)
            running.write(json.dumps(case) + "\n")
            running.flush()
        outcome = run_case(attack, case, is_timed=is_timed)
        total.take_in(outcome)
        total.counts["cases"] += 1
        if outcome.problems:
            total.counts["findings"] += 1
            total.problems += outcome.problems
            if findings is not None:
                keep(attack, case, outcome.problems, findings)
    if running is not None:
        running.close()
    return total


def _counting(goes_on: Callable[[int], bool]) -> Iterator[int]:
    number = 0
    while goes_on(number):
        yield number
        number += 1


def keep(attack: Attack, case: Case, problems: list[str], findings: Path) -> Path:
    """Write a case to a file, which a test replays."""
    with TemporaryDirectory(prefix="campaign-") as folder:
        text = json.dumps(
            {"attack": attack.name, "found": problems, "case": attack.kept(case, Path(folder))}, indent=1
        )
    findings.mkdir(parents=True, exist_ok=True)
    path = findings / f"{attack.name}-{sha256(text.encode()).hexdigest()[:10]}.json"
    path.write_text(text + "\n")
    return path


def read_finding(path: Path) -> tuple[str, Case]:
    """Return the name of the attack and the case in a file of `keep`."""
    document = json.loads(path.read_text())
    return document["attack"], document["case"]

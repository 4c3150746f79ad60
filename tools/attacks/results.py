"""Damaged folders of results: no verdict, count or exit code may change silently."""

from __future__ import annotations

import json
import os
import random
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

from attacks.cases import Case, Outcome
from attacks.program import Said, problems_of, said_by

_DISTANCES = (0.5, 0.4, 0.2, 0.1, 0.3)
_SPECIFICATION = "spec apart = G (a dist b >= 0.3)\nspec near = F (a dist b <= 0.4)\n"


class Results:
    """A folder of results with random edits of its files, which is read and continued."""

    name = "results"
    most_cpu_s = 5.0
    uses_files = True

    def ready(self) -> None:
        _sound()

    def draw(self, rng: random.Random) -> Case:
        return {"edits": draw_edits(rng), "keeps_time": rng.random() < 0.5}

    def kept(self, case: Case, folder: Path) -> Case:
        """See `Attack`."""
        return case

    def run(self, case: Case, folder: Path) -> Outcome:
        sound, results = _sound(), folder / "results"
        shutil.copytree(sound.results, results)
        edited = {edit_file(results, *edit, keeps_time=case["keeps_time"]) for edit in case["edits"]}
        shown = said_by(["results", str(results)])
        evaluated = _batch(sound.logs, results)
        outcome = Outcome([*problems_of(shown), *problems_of(evaluated)], {f"exit {evaluated.code}": 1})
        if shown.code == 0 and shown.printed != sound.shown:
            outcome.problems.append("`results` shows another table without a remark")
        is_refused = evaluated.code == 2 and "format.json" in edited
        if not is_refused and (evaluated.code != sound.code or _rows(evaluated) != sound.rows):
            outcome.problems.append(f"the batch ends with {evaluated.code}, and its rows differ")
        return outcome


class _Sound(NamedTuple):
    logs: Path
    results: Path
    shown: str
    code: int
    rows: list[dict[str, Any]]


@cache
def _sound() -> _Sound:
    """Write logs and the results of a batch over them, once for this process."""
    folder = Path(mkdtemp(prefix="campaign-"))
    (folder / "logs").mkdir()
    (folder / "s.spatial").write_text(_SPECIFICATION)
    for number, distance in enumerate(_DISTANCES):
        boxes = {"a": 0.0, "b": 1.0 + distance}
        objects = [
            {"name": name, "polygon": [[x, 0], [x + 1, 0], [x + 1, 1], [x, 1]]} for name, x in boxes.items()
        ]
        (folder / f"logs/{number}.jsonl").write_text(json.dumps({"time_ns": 0, "objects": objects}))
    results = folder / "results"
    evaluated = _batch(folder / "logs", results)
    return _Sound(
        folder / "logs",
        results,
        said_by(["results", str(results)]).printed,
        evaluated.code,
        _rows(evaluated),
    )


def _batch(logs: Path, results: Path) -> Said:
    spec = ["--spec", str(logs.parent / "s.spatial")]
    return said_by(["batch", str(logs), *spec, "--jobs", "1", "-o", str(results), "--json", "-"])


def _rows(said: Said) -> list[dict[str, Any]]:
    rows = [json.loads(line) for line in said.printed.splitlines()]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def draw_edits(rng: random.Random) -> list[list[Any]]:
    """Draw edits of files of a folder, as `edit_file` takes them."""
    kinds = ("flip", "flip", "flip", "cut", "zero", "remove")
    return [
        [rng.random(), rng.choice(kinds), rng.random(), rng.randrange(8)]
        for _ in range(rng.choice((1, 1, 1, 2, 5)))
    ]


def edit_file(
    folder: Path, which: float, kind: str, place: float, bit: int, *, keeps_time: bool = False
) -> str:
    """Edit a file of the folder; return its name.

    Args:
        keeps_time: whether the file keeps its modification time.
    """
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    if not files:
        return ""
    file = files[int(which * len(files))]
    data, before = bytearray(file.read_bytes()), file.stat()
    at = int(place * len(data))
    if kind == "remove":
        file.unlink()
        return file.name
    if kind == "cut":
        del data[at:]
    elif kind == "zero":
        data[at : at + 64] = bytes(len(data[at : at + 64]))
    elif data:
        data[at] ^= 1 << bit
    file.write_bytes(data)
    if keeps_time:
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    return file.name

"""The limits that SECURITY.md states are those of the code."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

import spatial_replay as sr

TEXT = (Path(__file__).parents[1] / "SECURITY.md").read_text()
ROW = re.compile(
    r"^\| (?P<what>.+) \| (?P<limit>\d+)(?: (?P<unit>KiB|MiB|GiB|s))? "
    r"\| `(?P<file>\S+)\.py` `(?P<name>\w+)` \|$"
)
UNITS = {"": 1, "s": 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


def rows() -> list[tuple[str, str, str, int]]:
    section = TEXT.split("## Limits")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")][1:]
    found = [ROW.match(line) for line in lines]
    assert all(found), [line for line, match in zip(lines, found, strict=True) if not match]
    return [
        (match["what"], match["file"], match["name"], int(match["limit"]) * UNITS[match["unit"] or ""])
        for match in found
        if match
    ]


def test_every_limit_is_the_one_of_the_code() -> None:
    wrong = []
    for what, file, name, limit in rows():
        module = import_module(f"spatial_replay.{file.replace('/', '.')}")
        if getattr(module, name) != limit:
            wrong.append((what, limit, getattr(module, name)))
    assert not wrong
    assert len(rows()) > 30


@pytest.mark.parametrize(
    "text",
    [
        "G (a ovlp b) " + "#" * 2**18,
        "not " * 101 + "a ovlp b",
        " and ".join(["a ovlp b"] * 20_001),
        "(" * 10_000,
    ],
    ids=["length", "depth", "size", "brackets"],
)
def test_a_specification_beyond_a_limit_is_refused(text: str) -> None:
    with pytest.raises(sr.SpecificationError):
        sr.parse_specification(text)

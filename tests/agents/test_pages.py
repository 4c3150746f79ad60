"""The page of mistakes is right: in each row, the two spellings mean different things."""

from __future__ import annotations

import re
from pathlib import Path

import spatial_replay as sr

PAGE = Path(__file__).resolve().parents[2] / "docs" / "agents.md"
ATOMS = {
    "p": "cup enclosedin bowl",
    "a": "cup leftof plate",
    "b": "cup below plate",
    "open": "(door >= 1)",
    "warning": "alarm",
}


def test_the_spellings_of_each_row_mean_different_things() -> None:
    table = PAGE.read_text("utf-8").partition("## Mistakes, as they look")[2]
    rows = re.findall(r"^\| [^|`]+ \| `([^`]+)` \| `([^`]+)` \|", table, re.M)
    assert len(rows) >= 8
    for formulas in rows:
        texts = [
            re.sub(r"\b(p|a|b|open|warning)\b(?!\()", lambda match: ATOMS[match[0]], text)
            for text in formulas
        ]
        first, second = (
            sr.parse_specification(f"region bowl = box(0, 0, 1, 1)\nspec s = {text}") for text in texts
        )
        assert sr.distinguish(first, second).relation in ("stricter", "weaker", "different"), texts

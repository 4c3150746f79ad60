"""Text for people: counts, numbers in JSON, printable text, suggestions for misspelt names."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import Final

_LONGEST: Final = 300
"""Characters of a printable text."""
_LONGEST_NAME: Final = 100
_MOST_NAMES: Final = 2_000
"""Bounds of the comparison, which takes quadratic time: names come from logs and may be hostile."""


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: "1 sample", "1,579 samples"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def json_number(number: float) -> float | str | None:
    """Return a number as valid JSON: infinities become the strings "inf" and "-inf", NaN becomes null."""
    if math.isnan(number):
        return None
    if math.isinf(number):
        return "inf" if number > 0 else "-inf"
    return number


def printable(text: str, longest: int = _LONGEST) -> str:
    """Return a text with blanks in place of unprintable characters, cut to a length."""
    shown = "".join(character if character.isprintable() else " " for character in text)
    return shown if len(shown) <= longest else shown[: longest - 1] + "…"


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """Return "did you mean …?" with the known name closest to `name`, or ""."""
    if len(name) > _LONGEST_NAME:
        return ""
    candidates = [candidate for candidate in known if len(candidate) <= _LONGEST_NAME][:_MOST_NAMES]
    matches = difflib.get_close_matches(name, candidates, n=1)
    return f"did you mean {matches[0]!r}?" if matches else ""

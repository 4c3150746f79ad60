"""Numbers and texts of others as people read them.

Which known name somebody may have meant.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import Final

_LONGEST: Final = 300
"""Characters after which a text is cut."""


def counted(count: int, noun: str) -> str:
    """A number of things: "1 sample", "1,579 samples"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def json_number(number: float) -> float | str | None:
    """A number as JSON can hold it: infinite ones are the strings "inf" and "-inf", NaN is null."""
    if math.isnan(number):
        return None
    if math.isinf(number):
        return "inf" if number > 0 else "-inf"
    return number


def printable(text: str, longest: int = _LONGEST) -> str:
    """A text without what a page or a figure would not show as it stands, cut after so many characters."""
    shown = "".join(character if character.isprintable() else " " for character in text)
    return shown if len(shown) <= longest else shown[: longest - 1] + "…"


_LONGEST_NAME = 100
_MOST_NAMES = 2_000


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """The hint that names the known name most like `name`, or ""."""
    if len(name) > _LONGEST_NAME:
        return ""
    candidates = [candidate for candidate in known if len(candidate) <= _LONGEST_NAME][:_MOST_NAMES]
    matches = difflib.get_close_matches(name, candidates, n=1)
    return f"did you mean {matches[0]!r}?" if matches else ""

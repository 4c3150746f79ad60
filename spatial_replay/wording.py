"""Numbers and texts of others as people read them."""

from __future__ import annotations

import math
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

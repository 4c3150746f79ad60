"""The colours of robustness: blue for positive, vermillion for negative, grey for unknown robustness.

Blue and vermillion, and their mixtures with grey, are distinguishable with every common colour blindness.
Pages, panel and terminals have other shades, for contrast: see `report/page.py`, `panel/src/decisions.ts` and
`cli/terminal.py`.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

# red, green and blue from 0 to 1
POSITIVE: Final = (0.0, 0.447, 0.698)
NEGATIVE: Final = (0.835, 0.369, 0.0)
NEUTRAL: Final = (0.55, 0.55, 0.55)
HOLDING: Final = (0.337, 0.706, 0.914)
"""Colour of results that hold so far: light blue."""
PENDING: Final = (0.941, 0.894, 0.259)
"""Colour of pending results: yellow. Unknown results are grey."""
LABEL: Final = (0.95, 0.95, 0.95)
"""Colour of labels: nearly white."""

CURVES: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c8c8c")
"""Colours of curves in one plot, distinguishable with every common colour blindness (Okabe and Ito)."""


_LIGHTER: Final = 0.4


def hexadecimal(colour: tuple[float, float, float]) -> str:
    """Return a colour as hexadecimal text: "#0072b2"."""
    return "#" + "".join(f"{round(255.0 * share):02x}" for share in colour)


def light(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return a background colour for dark text: 30 % of the colour, mixed with white."""
    red, green, blue = (0.7 + 0.3 * share for share in colour)
    return red, green, blue


def lighter(colour: str) -> str:
    """Return a hexadecimal colour mixed with white, for viewers that darken colours."""
    shares = (int(colour[start : start + 2], 16) / 255.0 for start in (1, 3, 5))
    red, green, blue = (share + _LIGHTER * (1.0 - share) for share in shares)
    return hexadecimal((red, green, blue))


MAP: Final = (hexadecimal(NEGATIVE), "#f5f5f5", hexadecimal(POSITIVE))
"""Colours of a gradient map for the least robustness, for 0, and for the greatest robustness."""

SIGNS: Final = MappingProxyType(
    {
        "positive": hexadecimal(POSITIVE),
        "negative": hexadecimal(NEGATIVE),
        "neutral": hexadecimal(NEUTRAL),
    }
)
"""Colours of signs on pages."""

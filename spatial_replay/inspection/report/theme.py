"""The page's colours, on light ground and on dark."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from spatial_replay.palette import NEGATIVE, NEUTRAL, POSITIVE, hexadecimal

_BOTH: Final = MappingProxyType(
    {
        "positive": hexadecimal(POSITIVE),
        "negative": hexadecimal(NEGATIVE),
        "neutral": hexadecimal(NEUTRAL),
    }
)
LIGHT: Final[Mapping[str, str]] = MappingProxyType(
    {
        "paper": "#f6f6f3",
        "panel": "#ffffff",
        "ink": "#1f2328",
        "quiet": "#59626b",
        "line": "#d9dce0",
        "grid": "#e4e6e9",
        "band": "rgb(120 130 140 / 0.16)",
        "lit": "#ffe9a8",
        "positive-line": "#0072b2",
        "negative-line": "#d55e00",
        "positive-text": "#00598c",
        "negative-text": "#a34700",
    }
)
DARK: Final[Mapping[str, str]] = MappingProxyType(
    {
        "paper": "#111417",
        "panel": "#191d21",
        "ink": "#e8eaed",
        "quiet": "#a3acb5",
        "line": "#343a41",
        "grid": "#2b3137",
        "band": "rgb(170 180 190 / 0.15)",
        "lit": "#5c4a12",
        "positive-line": "#3fa2dd",
        "negative-line": "#f0802b",
        "positive-text": "#7cc3ee",
        "negative-text": "#ffa35c",
    }
)
"""By their names in the style sheets; texts in them stand out from paper and panel by 4.5 to 1 or more."""


def theme() -> str:
    """The colours as a style sheet: those of the system, unless the page was asked for the other ones."""
    light = _rule({"color-scheme": "light", **_variables(_BOTH), **_variables(LIGHT)})
    dark = _rule({"color-scheme": "dark", **_variables(DARK)})
    return (
        f':root{light}:root[data-theme="dark"]{dark}'
        f'@media (prefers-color-scheme:dark){{:root:not([data-theme="light"]){dark}}}'
        f'@media print{{:root,:root[data-theme="dark"],:root:not([data-theme="light"]){light}}}'
    )


def _variables(colours: Mapping[str, str]) -> dict[str, str]:
    return {f"--{name}": colour for name, colour in colours.items()}


def _rule(declarations: Mapping[str, str]) -> str:
    return "{" + "".join(f"{name}:{value};" for name, value in declarations.items()) + "}"

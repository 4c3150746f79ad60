"""Elements of HTML for notebooks and pages. Text is escaped. Colours suit light and dark pages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from types import MappingProxyType
from typing import Final

from spatial_replay.palette import NEGATIVE, NEUTRAL, PENDING, POSITIVE, hexadecimal
from spatial_replay.text import printable

_VERDICT_COLOURS: Final[Mapping[str, tuple[float, float, float]]] = MappingProxyType(
    {"satisfied": POSITIVE, "violated": NEGATIVE, "pending": PENDING}
)
_CELL: Final = "text-align:left; padding:0.1em 1em 0.1em 0; vertical-align:baseline; background:transparent"


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(tag: str, *content: str, **attributes: str) -> Html:
    """Return an element. Content that is not `Html` is escaped."""
    attribute_text = "".join(f' {name}="{escape(value)}"' for name, value in attributes.items())
    inner_html = "".join(piece if isinstance(piece, Html) else escape(printable(piece)) for piece in content)
    return Html(f"<{tag}{attribute_text}>{inner_html}</{tag}>")


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """Return a table."""
    head = element("tr", *(element("th", heading, style=_CELL) for heading in headings))
    body = [element("tr", *(element("td", cell, style=_CELL) for cell in row)) for row in rows]
    return element("table", element("thead", head), element("tbody", *body), style="border-collapse:collapse")


def code(*content: str) -> Html:
    """Return content in a monospaced font, with all its spaces."""
    return element("span", *content, style="font-family:ui-monospace,monospace; white-space:pre")


def details(summary: str, *content: str) -> Html:
    """Return content that unfolds on a click on its summary."""
    return element("details", element("summary", summary, style="cursor:pointer"), *content)


def quiet(text: str) -> Html:
    """Return text in a fainter colour."""
    return element("span", text, style="opacity:0.7")


def verdict_mark(verdict: str) -> Html:
    """Return a verdict with its colour."""
    colour = hexadecimal(_VERDICT_COLOURS.get(verdict, NEUTRAL))
    mark = element("span", "■", style=f"color:{colour}")
    return element("span", mark, " ", verdict, style="white-space:nowrap")

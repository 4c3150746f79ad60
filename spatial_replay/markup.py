"""HTML for notebooks: texts are escaped, and what is shown suits light pages and dark ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from types import MappingProxyType
from typing import Final

from spatial_replay.palette import NEGATIVE, NEUTRAL, POSITIVE, hexadecimal
from spatial_replay.wording import printable

_VERDICT_COLOURS: Final[Mapping[str, tuple[float, float, float]]] = MappingProxyType(
    {"satisfied": POSITIVE, "violated": NEGATIVE}
)
_CELL: Final = "text-align:left; padding:0.1em 1em 0.1em 0; vertical-align:baseline; background:transparent"


class Html(str):
    """A text that is HTML already."""

    __slots__ = ()


def element(tag: str, *content: str, **attributes: str) -> Html:
    """An element with some content; texts in it that are not `Html` are escaped."""
    written = "".join(f' {name}="{escape(value)}"' for name, value in attributes.items())
    inner = "".join(each if isinstance(each, Html) else escape(printable(each)) for each in content)
    return Html(f"<{tag}{written}>{inner}</{tag}>")


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """A table."""
    head = element("tr", *(element("th", each, style=_CELL) for each in headings))
    body = [element("tr", *(element("td", each, style=_CELL) for each in row)) for row in rows]
    return element("table", element("thead", head), element("tbody", *body), style="border-collapse:collapse")


def code(*content: str) -> Html:
    """Content in letters of one width, with all of its spaces."""
    return element("span", *content, style="font-family:ui-monospace,monospace; white-space:pre")


def folded(summary: str, *content: str) -> Html:
    """Content that unfolds where its summary is clicked."""
    return element("details", element("summary", summary, style="cursor:pointer"), *content)


def quiet(text: str) -> Html:
    """A text that matters less."""
    return element("span", text, style="opacity:0.7")


def verdict_mark(verdict: str) -> Html:
    """A verdict behind its colour."""
    colour = hexadecimal(_VERDICT_COLOURS.get(verdict, NEUTRAL))
    mark = element("span", "■", style=f"color:{colour}")
    return element("span", mark, " ", verdict, style="white-space:nowrap")

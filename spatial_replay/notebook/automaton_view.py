"""Automata in notebooks: drawn with short names for long propositions, and as a list of transitions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.text import (
    abbreviated,
    layout_text,
    meanings,
    size_words,
    state_colour,
    svg_text,
    words_text,
)
from spatial_replay.errors import OutputError, UsageError
from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import (
    INK,
    Html,
    code,
    draw_curve,
    draw_disc,
    element,
    folded,
    new_panel,
    plain,
    quiet,
)
from spatial_replay.palette import NEUTRAL, hexadecimal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_STATES: Final = 40
_MOST_CUBES: Final = 100
"""The most states, and cubes on arrows, of an automaton that a cell's output draws."""
_MOST_LINES: Final = 200
"""The most lines of the list of transitions."""
_ARROW: Final = hexadecimal(NEUTRAL)
_INCH: Final = 72.0
"""Points of Graphviz in an inch."""
_LONGEST_SIDE: Final = 40.0
"""The longest side of a figure, in inches."""


@html.register(Automaton)
def automaton_html(automaton: Automaton) -> Html:
    """Return the size of an automaton; if it is small, also a drawing and its transitions as text."""
    title = element("div", element("b", automaton.name), quiet(f" {size_words(automaton)}"))
    if _is_large(automaton):
        return element("div", title, quiet("too large to be drawn here; plot() draws it, to_dot() writes it"))
    drawing = automaton_svg(automaton)
    shown = quiet("install Graphviz to see it drawn") if drawing is None else Html(drawing)
    words = words_text(automaton).split("\n")
    lines = [element("div", code(line)) for line in words[:_MOST_LINES]]
    more = [quiet(f"… and {len(words) - _MOST_LINES:,} lines more")] if len(words) > _MOST_LINES else []
    drawn = element("div", shown, style="overflow-x:auto")
    return element("div", title, drawn, folded("in words", *lines, *more))


def automaton_svg(automaton: Automaton) -> str | None:
    """Return an automaton as SVG; None if it is large or Graphviz cannot draw it here."""
    if _is_large(automaton):
        return None
    try:
        drawing = svg_text(automaton)
    except (UsageError, OutputError):
        return None
    # the XML declaration and document type before it belong in files, not in pages
    return drawing[drawing.index("<svg") :]


def _is_large(automaton: Automaton) -> bool:
    # the transitions of an automaton with very many states take long to find
    if len(automaton.states) > _MOST_STATES or not automaton.is_listable:
        return True
    return sum(len(each.guard) for each in automaton.transitions) > _MOST_CUBES


@plot.register(Automaton)
def draw_automaton(automaton: Automaton, ax: Axes | None = None) -> Axes:
    """Draw the automaton with the layout of Graphviz.

    Raises:
        UsageError: Graphviz or matplotlib is not installed.
        OutputError: Graphviz fails, or takes too long.
    """
    short = abbreviated(automaton)
    layout = json.loads(layout_text(short))
    width, height = _point(layout["bb"].removeprefix("0,0,"))
    legend = meanings(short)
    if ax is None:
        inches = max(width / _INCH, 5.0), 0.5 + height / _INCH + 0.2 * len(legend)
        ax = new_panel((min(inches[0], _LONGEST_SIDE), min(inches[1], _LONGEST_SIDE)))
    ax.set_axis_off()
    ax.set_aspect("equal")
    ax.set_xlim(-2.0, width + 2.0)
    ax.set_ylim(-2.0, height + 2.0)
    for edge in layout["edges"]:
        _draw_edge(ax, edge)
    for node in layout["objects"]:
        _draw_state(ax, automaton, node)
    ax.set_title(plain(f"{automaton.name}: {size_words(automaton)}"), loc="left", fontsize=10)
    text = "\n".join(plain(line, 100) for line in legend)
    ax.annotate(
        text, (0, 0), (0, -6), xycoords="axes fraction", textcoords="offset points", va="top", fontsize=8.5
    )
    return ax


def _draw_state(ax: Axes, automaton: Automaton, node: Mapping[str, Any]) -> None:
    """Draw a circle with the number of a state, or the point before the first state, which has none."""
    x, y = _point(node["pos"])
    radius = float(node["width"]) * _INCH / 2
    is_state = node["name"].isdecimal()
    colour = state_colour(automaton, int(node["name"])) if is_state else INK
    outlines = [radius, radius - 4.0] if is_state and int(node["name"]) in automaton.accepting else [radius]
    for outline in outlines:
        draw_disc(ax, (x, y), outline, colour)
    if is_state:
        ax.text(x, y, node["name"], ha="center", va="center", fontsize=11, color=INK)


def _draw_edge(ax: Axes, edge: Mapping[str, Any]) -> None:
    """Draw a curve with a head, and the guard beside it."""
    head, *points = (_point(each.removeprefix("e,")) for each in edge["pos"].split())
    draw_curve(ax, points, _ARROW)
    ax.annotate(
        "", head, points[-1],
        arrowprops={"arrowstyle": "-|>", "color": _ARROW, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9},
    )  # fmt: skip
    if edge.get("label"):
        lines = [plain(line) for line in edge["label"].split("\\n")]
        x, y = _point(edge["lp"])
        ax.text(x, y, "\n".join(lines), ha="center", va="center", fontsize=8.5)


def _point(text: str) -> tuple[float, float]:
    x, y = map(float, text.split(","))
    return x, y

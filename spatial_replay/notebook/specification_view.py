"""Specifications in notebooks: their trees as tables and as figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import INK, Html, code, element, new_panel, plain, quiet, table
from spatial_replay.palette import NEUTRAL
from spatial_replay.spec.format import iter_branches, label_of, title_of
from spatial_replay.spec.formula import Formula, NamedSpec, Specification, iter_nodes, operands_of
from spatial_replay.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_NODES: Final = 200
"""The most nodes in a table."""
_MOST_DRAWN: Final = 60
"""The most nodes in a figure."""
_DEEPEST: Final = 40
"""The most levels that a table indents."""
_GAP: Final = 0.6
"""Distance of two trees in a figure, in rows."""
_PAPER: Final = (0.95, 0.95, 0.95)


@html.register(Specification)
def specification_html(specification: Specification) -> Html:
    """Return the declarations of a specification, and the trees of its results."""
    title = element("b", specification.filename)
    results = specification.results
    about = quiet(f" {counted(len(results), 'result')}, profile {specification.profile}")
    kinds = ("constants", "regions", "groups")
    names = {kind: ", ".join(getattr(specification, kind)) for kind in kinds}
    declared = [element("div", f"{kind}: {listed}") for kind, listed in names.items() if listed]
    warnings = [element("div", f"warning: {each.message}") for each in specification.warnings[:5]]
    return element("div", element("div", title, about), *declared, _trees(results), *warnings)


def _trees(results: Sequence[NamedSpec]) -> Html:
    """Return the trees one below the other, up to the most nodes."""
    left = _MOST_NODES
    rows: list[tuple[str]] = []
    for spec in results:
        shown = [(tree_cell(stem, node),) for _, stem, node in islice(iter_branches(spec.formula), left)]
        left -= len(shown)
        rows += shown
    return element("div", table(["tree"], rows), _left_out(results, len(rows)))


def tree_cell(stem: str, node: Formula) -> Html:
    """Return a node of a tree, with its name in bold."""
    indented = stem if len(stem) <= 3 * _DEEPEST else "⋯" + stem[-3:]
    name = [] if node.name is None else [element("b", node.name), " = "]
    return code(indented, *name, title_of(node))


def _left_out(results: Sequence[NamedSpec], shown: int) -> Html:
    nodes = _size(results)
    return quiet(f"… and {counted(nodes - shown, 'node')} more") if shown < nodes else Html("")


class _Place(NamedTuple):
    """The position of a node, in levels to the right and rows down, and that of its parent."""

    node: Formula
    x: float
    y: float
    above: tuple[float, float] | None


@plot.register(Specification)
def draw_specification(specification: Specification, ax: Axes | None = None) -> Axes:
    """Draw the trees of a specification's results, roots to the left.

    Raises:
        UsageError: matplotlib is not installed.
    """
    places = list(_places(specification.results))
    rows = 1 + max((place.y for place in places), default=0.0)
    levels = 1 + max((place.x for place in places), default=0.0)
    if ax is None:
        ax = new_panel((min(3.0 + 0.85 * levels, 14.0), 0.6 + 0.32 * rows))
    ax.set_axis_off()
    ax.set_xlim(-0.2, levels + 2.5)
    ax.set_ylim(rows - 0.4, -0.9)
    for place in places:
        if place.above is not None:
            (x, y), bend = place.above, place.x - 0.5
            ax.plot([x, bend, bend, place.x], [y, y, place.y, place.y], color=NEUTRAL, linewidth=1, zorder=1)
        _draw_node(ax, place)
    nodes = _size(specification.results)
    more = f", the first {len(places)} of {counted(nodes, 'node')}" if len(places) < nodes else ""
    ax.set_title(plain(specification.filename + more), loc="left", fontsize=10)
    return ax


def _places(results: Sequence[NamedSpec]) -> Iterator[_Place]:
    """Iterate over the positions of the first nodes, one tree below the other."""
    left, first_row = _MOST_DRAWN, 0.0
    for spec in results:
        nodes = list(islice(iter_nodes(spec.formula), left))
        left -= len(nodes)
        rows, used = _rows([parent for _, parent, _ in nodes], first_row)
        first_row += used + _GAP
        levels: list[int] = []
        for identifier, parent, node in nodes:
            levels.append(0 if parent is None else levels[parent] + 1)
            above = None if parent is None else (float(levels[parent]), rows[parent])
            yield _Place(node, float(levels[identifier]), rows[identifier], above)


def _rows(parents: Sequence[int | None], first_row: float) -> tuple[list[float], int]:
    """Return the row of each node, leaves one by one and parents amid their children; and how many rows."""
    below: list[list[int]] = [[] for _ in parents]
    for identifier, parent in enumerate(parents):
        if parent is not None:
            below[parent].append(identifier)
    rows = [0.0] * len(parents)
    leaves = [identifier for identifier, operands in enumerate(below) if not operands]
    for number, leaf in enumerate(leaves):
        rows[leaf] = first_row + number
    # parents come before their children, so that in reverse all children have their row
    for identifier in reversed(range(len(parents))):
        if below[identifier]:
            rows[identifier] = (rows[below[identifier][0]] + rows[below[identifier][-1]]) / 2
    return rows, len(leaves)


def _draw_node(ax: Axes, place: _Place) -> None:
    node = place.node
    box = {"boxstyle": "round,pad=0.3", "facecolor": _PAPER, "edgecolor": NEUTRAL, "linewidth": 0.8}
    is_leaf = not operands_of(node)
    ax.text(
        place.x, place.y, plain(label_of(node) if is_leaf else title_of(node)),
        ha="left" if is_leaf else "center", va="center", fontsize=8.5, color=INK, bbox=box, zorder=2,
    )  # fmt: skip
    if node.name is not None and not is_leaf:
        ax.text(
            place.x, place.y - 0.36, plain(node.name),
            ha="center", va="bottom", fontsize=8, fontweight="bold", zorder=2,
        )  # fmt: skip


def _size(results: Sequence[NamedSpec]) -> int:
    return sum(1 for spec in results for _ in iter_nodes(spec.formula))

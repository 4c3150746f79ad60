"""Formulas, traces, evaluations and automata in notebooks, as HTML, figures and tables."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import singledispatch
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from spatial_replay.annotate.scene.scene_template import outlines_of, rings_of
from spatial_replay.annotate.specification import unit_of, unit_words
from spatial_replay.automata.automaton import (
    Automaton,
    abbreviate,
    meanings,
    size_words,
    state_colour,
    words_text,
)
from spatial_replay.automata.drawing import layout_text, svg_text
from spatial_replay.errors import OutputError, UsageError, importing
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.html import Html, code, details, element, quiet, table, verdict_mark
from spatial_replay.monitor.atoms.terms import footprint_from_outline
from spatial_replay.monitor.result import RESULT_COLUMNS, RESULT_TIMES, Evaluation, SpecResult, worst_first
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import INK, draw_curve, draw_disc, new_panel, new_panels, plain
from spatial_replay.palette import CURVES, NEGATIVE, NEUTRAL, POSITIVE, hexadecimal
from spatial_replay.spec.format import iter_branches, label_of, title_of
from spatial_replay.spec.formula import Formula, NamedSpec, Specification, iter_nodes, operands_of
from spatial_replay.text import interval_text, plural, time_text
from spatial_replay.trace.trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_FORMULAS: Final = 200
"""Limit of nodes in a table."""
_MOST_DRAWN: Final = 60
"""Limit of nodes in a figure."""
_DEEPEST: Final = 40
"""Limit of indented levels in a table."""
_ROW_GAP: Final = 0.6
"""Gap between two trees in a figure, rows."""
_PAPER: Final = (0.95, 0.95, 0.95)


@html.register(Specification)
def specification_html(specification: Specification) -> Html:
    """Return a specification's declarations, the trees of its results and its first five warnings."""
    title = element("b", specification.filename)
    results = specification.results
    about = quiet(f" {plural(len(results), 'result')}, profile {specification.profile}")
    kinds = ("constants", "regions", "groups")
    names = {kind: ", ".join(getattr(specification, kind)) for kind in kinds}
    declared = [
        element("div", f"{kind}: {joined_names}") for kind, joined_names in names.items() if joined_names
    ]
    warnings = [element("div", f"warning: {warning.message}") for warning in specification.warnings[:5]]
    return element("div", element("div", title, about), *declared, _formula_trees(results), *warnings)


def _formula_trees(results: Sequence[NamedSpec]) -> Html:
    """Return the trees one below the other, with `_MOST_FORMULAS` nodes at most."""
    left = _MOST_FORMULAS
    rows: list[tuple[str]] = []
    for spec in results:
        cells = [(tree_cell(stem, node),) for _, stem, node in islice(iter_branches(spec.formula), left)]
        left -= len(cells)
        rows += cells
    return element("div", table(["tree"], rows), _left_out(results, len(rows)))


def tree_cell(stem: str, node: Formula) -> Html:
    """Return a node of a tree, with its name in bold."""
    indented = stem if len(stem) <= 3 * _DEEPEST else "⋯" + stem[-3:]
    name = [] if node.name is None else [element("b", node.name), " = "]
    return code(indented, *name, title_of(node))


def _left_out(results: Sequence[NamedSpec], rows: int) -> Html:
    nodes = _size(results)
    return quiet(f"… and {plural(nodes - rows, 'node')} more") if rows < nodes else Html("")


class _Place(NamedTuple):
    """A node in a drawing.

    Attributes:
        x: level from the left.
        y: row from the top.
        above: x and y of its parent; None for a root.
    """

    node: Formula
    x: float
    y: float
    above: tuple[float, float] | None


@plot.register(Specification)
def draw_specification(specification: Specification, ax: Axes | None = None) -> Axes:
    """Draw the trees of a specification's results, with the roots on the left.

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
    more = f", the first {len(places)} of {plural(nodes, 'node')}" if len(places) < nodes else ""
    ax.set_title(plain(specification.filename + more), loc="left", fontsize=10)
    return ax


def _places(results: Sequence[NamedSpec]) -> Iterator[_Place]:
    """Yield the first `_MOST_DRAWN` nodes with their positions, one tree below the other."""
    left, first_row = _MOST_DRAWN, 0.0
    for spec in results:
        nodes = list(islice(iter_nodes(spec.formula), left))
        left -= len(nodes)
        rows, used = _rows([parent for _, parent, _ in nodes], first_row)
        first_row += used + _ROW_GAP
        levels: list[int] = []
        for identifier, parent, node in nodes:
            levels.append(0 if parent is None else levels[parent] + 1)
            above = None if parent is None else (float(levels[parent]), rows[parent])
            yield _Place(node, float(levels[identifier]), rows[identifier], above)


def _rows(parents: Sequence[int | None], first_row: float) -> tuple[list[float], int]:
    """Return the row of each node, and the number of rows.

    Each leaf has its own row. Parents are halfway between their first and their last child.
    """
    below: list[list[int]] = [[] for _ in parents]
    for identifier, parent in enumerate(parents):
        if parent is not None:
            below[parent].append(identifier)
    rows = [0.0] * len(parents)
    leaves = [identifier for identifier, operands in enumerate(below) if not operands]
    for number, leaf in enumerate(leaves):
        rows[leaf] = first_row + number
    # `iter_nodes` yields parents first, so that the reverse order places children before their parents
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


_MOST_ROWS: Final = 40
_MOST_POINTS: Final = 2_000
"""Limits of objects in a table, and of points in a trail."""

_MOST_LABELS: Final = 25
_NAME_SIZE: Final = 8.0
"""Font size of object names, points."""
_STEPS: Final = (0.0, 1.2, -1.2, 2.4, -2.4, 3.6, -3.6, 4.8, -4.8)
"""Offsets of a name above its object, in the order of preference, as multiples of the font size."""


@html.register(Trace)
def trace_html(trace: Trace) -> Html:
    """Return the length of a trace, and the number of samples of each object."""
    counts = (trace.rows >= 0).sum(axis=0).tolist()
    rows = [(name, f"{count:,}") for name, count in zip(trace.names, counts, strict=True) if count]
    more = [quiet(f"… and {len(rows) - _MOST_ROWS:,} objects more")] if len(rows) > _MOST_ROWS else []
    return element(
        "div", element("b", _trace_title(trace)), table(("object", "samples"), rows[:_MOST_ROWS]), *more
    )


@plot.register(Trace)
def draw_trace(trace: Trace, ax: Axes | None = None, specification: Specification | None = None) -> Axes:
    """Draw each object's trail from above, with its outlines at the start (dashed) and at the end (filled).

    Args:
        ax: axes to draw into; None for a new figure.
        specification: specification whose regions are drawn, too.

    Raises:
        UsageError: matplotlib is not installed.
    """
    ax = new_panel((6.0, 6.0)) if ax is None else ax
    ax.set_aspect("equal")
    for name, outline in ({} if specification is None else specification.regions).items():
        for ring in outlines_of(footprint_from_outline(outline)):
            ax.fill(*ring.T, facecolor=NEUTRAL, alpha=0.15, edgecolor=NEUTRAL, linewidth=1.0)
            right, top = ring.max(axis=0).tolist()
            ax.text(right, top, plain(name), fontsize=8, ha="right", va="bottom")
    ends: list[tuple[float, float, str]] = []
    columns = [column for column in range(len(trace.names)) if (trace.rows[:, column] >= 0).any()]
    for number, column in enumerate(columns):
        rows = trace.rows[:, column]
        rows = rows[rows >= 0]
        colour = CURVES[number % len(CURVES)]
        sampled_rows = rows[np.unique(np.linspace(0, len(rows) - 1, _MOST_POINTS).astype(np.int64))]
        ax.plot(*_centres(trace, sampled_rows).T, color=colour, linewidth=1.0)
        for ring in _rings(trace, rows[:1]):
            ax.fill(*ring.T, facecolor="none", edgecolor=colour, linestyle="--", linewidth=1.0)
        for ring in _rings(trace, rows[-1:]):
            ax.fill(*ring.T, facecolor=colour, edgecolor=colour, alpha=0.5)
        if len(columns) <= _MOST_LABELS:
            [(x, y)] = _centres(trace, rows[-1:]).tolist()
            ends.append((x, y, plain(trace.names[column])))
    _write_names(ax, ends)
    unit = plain(trace.units.get("", "footprint units"))
    ax.set_xlabel(f"x [{unit}]")
    ax.set_ylabel(f"y [{unit}]")
    ax.set_title(plain(_trace_title(trace)), loc="left", fontsize=10)
    return ax


def _write_names(ax: Axes, ends: Sequence[tuple[float, float, str]]) -> None:
    """Write each name at its position (x, y, name), moved up or down if an earlier name is in its way."""
    # the transformation is final only after the aspect is applied
    ax.apply_aspect()
    inches = ax.transData + ax.figure.dpi_scale_trans.inverted()
    labels: list[tuple[float, float, float]] = []
    for x, y, name in ends:
        across, up = (72.0 * inches.transform((x, y))).tolist()
        # estimated half width: 0.6 of the font size per character
        half = 0.3 * _NAME_SIZE * len(name)
        for step in _STEPS:
            is_free = all(
                abs(across - label_across) > half + label_half
                or abs(up + step * _NAME_SIZE - row) >= _NAME_SIZE
                for label_across, row, label_half in labels
            )
            if is_free:
                break
        labels.append((across, up + step * _NAME_SIZE, half))
        ax.annotate(
            name,
            (x, y),
            (0.0, step * _NAME_SIZE),
            textcoords="offset points",
            fontsize=_NAME_SIZE,
            ha="center",
            va="center",
        )


def _trace_title(trace: Trace) -> str:
    if not len(trace):
        return "no samples"
    span = time_text(int(trace.times_ns[-1]), int(trace.times_ns[0]))
    return f"{plural(len(trace), 'sample')} over {span}"


def _rings(trace: Trace, rows: Integers) -> tuple[Floats, ...]:
    """Return the outlines of the observation in the only row."""
    return rings_of(trace.footprints.select(rows), 0.0).rings_of(0)


def _centres(trace: Trace, rows: Integers) -> Floats:
    """Return (R, 2), the centre of each observation's bounding box."""
    rings = rings_of(trace.footprints.select(rows), 0.0)
    begins = np.asarray(rings.start)[: len(rows)]
    low, high = (reduce.reduceat(rings.points, begins, axis=0) for reduce in (np.minimum, np.maximum))
    return np.asarray((low + high) / 2.0)


@singledispatch
def data_frame(value: Any) -> Any:
    """Return a value as a DataFrame.

    Raises:
        UsageError: the type has no DataFrame, its series were not stored, or pandas is not installed.
    """
    raise UsageError(f"there is no DataFrame of a {type(value).__name__}")


@data_frame.register
def _of_evaluation(evaluation: Evaluation) -> Any:
    """Return a row for each result."""
    pandas = _pandas()
    rows = [
        [*(getattr(result, name) for name in RESULT_COLUMNS), [doubt.assumption for doubt in result.doubts]]
        for result in evaluation.results
    ]
    frame = pandas.DataFrame(rows, columns=[*RESULT_COLUMNS, "doubts"])
    # pandas' nullable integers: a missing time would turn the other times into floats, which lose nanoseconds
    return frame.astype({"verdict": str} | dict.fromkeys(RESULT_TIMES, "Int64"))


@data_frame.register
def _of_result(result: SpecResult) -> Any:
    """Return a row for each sample, with four columns for each node."""
    pandas = _pandas()
    if not result.has_series:
        raise UsageError(
            f"the numbers of each sample of {result.title!r} were not kept; evaluate() keeps them"
        )
    columns = {"seconds": (result.times_ns - result.evidence.first_ns()) / 1e9}
    names = [node.name or f"{node.id}: {node.text}" for node in result.nodes]
    for name, node in zip(names, result.nodes, strict=True):
        title = name if names.count(name) == 1 else f"{node.id}: {name}"
        for quantity in ("value", "now", "lower", "upper"):
            columns[f"{title} {quantity}"] = np.array(getattr(node, quantity))
    return pandas.DataFrame(columns, index=pandas.Index(np.array(result.times_ns), name="time_ns"))


def _pandas() -> Any:
    with importing("a DataFrame needs pandas", extra="notebook"):
        import pandas
    return pandas


_MOST_RESULTS: Final = 50
_MOST_NODES: Final = 300
"""Limit of nodes in the trees of all results together."""
_MOST_PANELS: Final = 8
_MOST_CURVES: Final = 6
"""Limit of curves in a panel, including the result's curve."""
_WIDTH, _HEIGHT = 8.0, 2.4
"""Size of a panel, inches."""
_LONGEST_NAME: Final = 24
_SHADE: Final = 0.15
"""Opacity of the robustness interval."""
_GAP: Final = 0.11
"""Least distance of two labels, fraction of the panel's height."""


@html.register(Evaluation)
def evaluation_html(evaluation: Evaluation) -> Html:
    """Return the verdict, the table of results, and each result's tree with its final numbers."""
    name = element("b", evaluation.specification.filename)
    title = element("div", name, " ", verdict_mark(evaluation.verdict))
    worst = _worst_of(evaluation.results, _MOST_RESULTS)
    left_out = len(evaluation.results) - len(worst)
    more = quiet(f"… and {plural(left_out, 'result')} more, none of them worse") if left_out else Html("")
    return element("div", title, _results_table(worst), more, *_trees(worst))


@html.register(SpecResult)
def result_html(result: SpecResult) -> Html:
    """Return a result's row in a table, and its tree with the final numbers."""
    return element("div", _results_table([result]), *_trees([result]))


def _results_table(results: Sequence[SpecResult]) -> Html:
    rows = []
    for result in results:
        robustness = interval_text(result.robustness, result.lower, result.upper, result.unit)
        name, verdict = element("b", result.title), verdict_mark(result.verdict)
        marks = ", ".join([result.tested, *["doubtful"] * bool(result.doubts)])
        tested = element("span", marks, title=" ".join(result.remarks))
        rows.append((name, verdict, robustness, _first_satisfied_text(result), tested))
    return table(["result", "verdict", "robustness", "first satisfied", "tested"], rows)


def _first_satisfied_text(result: SpecResult) -> str:
    if result.verdict is Verdict.UNKNOWN:
        return "not known"
    at_ns = result.first_satisfied_ns
    return "never" if at_ns is None else time_text(at_ns, result.evidence.first_ns())


def _trees(results: Sequence[SpecResult]) -> Iterator[Html]:
    """Yield the trees of results, with `_MOST_NODES` nodes at most."""
    left = _MOST_NODES
    for result in results:
        if left <= 0:
            return
        rows = list(islice(_tree_rows(result), left))
        left -= len(rows)
        left_out = len(result.final) - len(rows)
        more = quiet(f"… and {plural(left_out, 'node')} more") if left_out else Html("")
        nodes = table(["verdict", "robustness", "node"], rows)
        yield details(f"tree of {result.title}, each node at the first sample", nodes, more)


def _tree_rows(result: SpecResult) -> Iterator[tuple[str, str, str]]:
    for identifier, stem, node in iter_branches(result.formula):
        lower, upper = result.final[identifier].tolist()
        value = float(result.series[identifier, 0, -1])
        verdict = verdict_mark(final_verdict(lower, upper))
        yield verdict, interval_text(value, lower, upper), tree_cell(stem, node)


def _worst_of(results: Sequence[SpecResult], most: int) -> Sequence[SpecResult]:
    """Return the `most` worst results, or all results in their order if they are fewer."""
    if len(results) <= most:
        return results
    return [results[place] for place in worst_first(results)[:most]]


class _Curve(NamedTuple):
    """A curve to draw with its name."""

    name: str
    values: Floats
    colour: str


@plot.register(Evaluation)
def draw_evaluation(evaluation: Evaluation, ax: Axes | Iterable[Axes] | None = None) -> tuple[Axes, ...]:
    """Draw each result in its own axes, one below the other.

    Args:
        ax: axes to draw into, one for each result; None for a new figure with the eight worst results.

    Raises:
        UsageError: the number of axes differs from the number of results, or matplotlib is not installed.
    """
    if ax is not None:
        axes = np.array(list(ax) if isinstance(ax, Iterable) else [ax], object)
        return _draw_results(evaluation.results, tuple(axes.flat))
    worst = _worst_of(evaluation.results, _MOST_PANELS)
    if not worst:
        return ()
    size = (_WIDTH, 0.4 + _HEIGHT * len(worst))
    panels = _draw_results(worst, new_panels(len(worst), 1, size, same_x=True))
    for panel in panels:
        panel.label_outer()
    if len(worst) < len(evaluation.results):
        left_out = plural(len(evaluation.results) - len(worst), "result")
        panels[-1].set_xlabel(f"{panels[-1].get_xlabel()}\nand {left_out} more, none worse")
    return panels


def _draw_results(results: Sequence[SpecResult], panels: tuple[Axes, ...]) -> tuple[Axes, ...]:
    if len(results) != len(panels):
        count = plural(len(results), "result")
        raise UsageError(f"ax has {len(panels)} axes for {count}; give one for each, or draw one result")
    for result, panel in zip(results, panels, strict=True):
        draw_result(result, panel)
    return panels


@plot.register(SpecResult)
def draw_result(result: SpecResult, ax: Axes | None = None) -> Axes:
    """Draw a result's robustness over time, its interval of possible values, and curves of named specs.

    Raises:
        UsageError: matplotlib is not installed.
    """
    ax = new_panel((_WIDTH, 0.4 + _HEIGHT)) if ax is None else ax
    seconds = (result.times_ns - result.evidence.first_ns()) / 1e9
    curves = _curves(result)
    low, high = _limits([curve.values for curve in curves])
    _, _, lower, upper = result.series[0]
    ax.set_xlim(seconds[0], seconds[-1] if len(seconds) > 1 else 1.0)
    ax.set_ylim(low, high)
    ax.axhline(0.0, color=NEUTRAL, linewidth=0.8, zorder=1)
    has_band = bool((lower < upper).any())
    ax.fill_between(
        seconds, np.clip(lower, low, high), np.clip(upper, low, high),
        color=curves[0].colour, alpha=_SHADE, linewidth=0,
    )  # fmt: skip
    for number, curve in enumerate(curves):
        # the result's curve is thicker, so that it stays visible below an equal curve of a named spec
        ax.plot(seconds, curve.values, color=curve.colour, linewidth=1.2 if number else 3.0)
    _name_curves(ax, curves, has_band)
    ax.set_title(_title(result), loc="left", fontsize=10)
    ax.set_xlabel("time from the first sample in s")
    ax.set_ylabel(plain(f"robustness [{unit_words(unit_of(result.formula, result.evidence.units))}]"))
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def _curves(result: SpecResult) -> list[_Curve]:
    """Return the curves of a result and of the first named specs in it."""
    colours = {Verdict.SATISFIED: POSITIVE, Verdict.VIOLATED: NEGATIVE}
    verdict_colour = hexadecimal(colours.get(result.verdict, NEUTRAL))
    named = {node.name: number for number, _, node in reversed(list(iter_nodes(result.formula))) if node.name}
    parts = sorted((number, name) for name, number in named.items() if number)
    # the first two colours mean satisfied and violated
    others = zip(parts, CURVES[2 : _MOST_CURVES + 1], strict=False)
    return [
        _Curve(result.title, _finite(result, 0), verdict_colour),
        *(_Curve(name, _finite(result, number), colour) for (number, name), colour in others),
    ]


def _finite(result: SpecResult, node: int) -> Floats:
    """Return the values of a node, with NaN instead of infinite ones."""
    values = result.series[node, 0]
    return np.where(np.isfinite(values), values, np.nan)


def _limits(curves: Sequence[Floats]) -> tuple[float, float]:
    """Return the limits of a panel's robustness axis, which always includes 0."""
    values = np.concatenate([[0.0], *(curve[~np.isnan(curve)] for curve in curves)])
    low, high = float(values.min()), float(values.max())
    margin = 0.1 * (high - low) or 1.0
    return low - margin, high + margin


def _name_curves(ax: Axes, curves: Sequence[_Curve], has_band: bool) -> None:
    """Write each curve's name to its right, and the name of the interval at the bottom, without overlap."""
    low, high = ax.get_ylim()
    ends = [(_last(curve.values) - low) / (high - low) for curve in curves]
    *places, bottom = _apart([*ends, 0.0])
    for place, curve in zip(places, curves, strict=True):
        _draw_key(ax, place, curve.name, curve.colour, is_bold=curve is curves[0])
    if has_band:
        _draw_key(ax, bottom, "still possible", curves[0].colour, alpha=2 * _SHADE)


def _draw_key(
    ax: Axes, place: float, name: str, colour: str, *, alpha: float = 1.0, is_bold: bool = False
) -> None:
    """Draw a coloured square to the right of the axes, with its name."""
    weight = "bold" if is_bold else "normal"
    mark, word = {"color": colour, "alpha": alpha}, {"fontweight": weight}
    for text, points, style in (("■", 5, mark), (plain(name, _LONGEST_NAME), 17, word)):
        ax.annotate(
            text, (1.0, place), (points, 0), xycoords="axes fraction", textcoords="offset points",
            va="center", fontsize=9, **style,
        )  # fmt: skip


def _last(values: Floats) -> float:
    """Return the last finite number of a curve; 0 if it has none."""
    finite = values[~np.isnan(values)]
    return float(finite[-1]) if len(finite) else 0.0


def _apart(places: Sequence[float]) -> list[float]:
    """Return places moved apart by at least `_GAP`, in the same order, and at most 1."""
    apart = list(places)
    order = sorted(range(len(places)), key=places.__getitem__)
    below = -np.inf
    for number in order:
        below = apart[number] = max(apart[number], below + _GAP)
    above = 1.0 + _GAP
    for number in reversed(order):
        above = apart[number] = min(apart[number], above - _GAP)
    return apart


def _title(result: SpecResult) -> str:
    robustness = interval_text(result.robustness, result.lower, result.upper, result.unit)
    return plain(f"{result.title}: {result.verdict}, robustness {robustness}")


_MOST_STATES: Final = 40
_MOST_CUBES: Final = 100
"""Limits of states and of cubes on arrows, up to which a cell's output draws an automaton."""
_MOST_LINES: Final = 200
"""Limit of lines in the list of transitions."""
_ARROW: Final = hexadecimal(NEUTRAL)
_INCH: Final = 72.0
"""Graphviz' points per inch: https://graphviz.org/docs/outputs/json/"""
_LONGEST_SIDE: Final = 40.0
"""Limit of a figure's sides, inches."""


@html.register(Automaton)
def automaton_html(automaton: Automaton) -> Html:
    """Return the size of an automaton, and for a small one its drawing and its transitions as text."""
    title = element("div", element("b", automaton.name), quiet(f" {size_words(automaton)}"))
    if _is_large(automaton):
        return element("div", title, quiet("too large to be drawn here; plot() draws it, to_dot() writes it"))
    drawing = automaton_svg(automaton)
    content = quiet("install Graphviz to see it drawn") if drawing is None else Html(drawing)
    words = words_text(automaton).split("\n")
    lines = [element("div", code(line)) for line in words[:_MOST_LINES]]
    more = [quiet(f"… and {len(words) - _MOST_LINES:,} lines more")] if len(words) > _MOST_LINES else []
    picture = element("div", content, style="overflow-x:auto")
    return element("div", title, picture, details("in words", *lines, *more))


def automaton_svg(automaton: Automaton) -> str | None:
    """Return an automaton as SVG; None if it is large, or Graphviz is missing or fails."""
    if _is_large(automaton):
        return None
    try:
        drawing = svg_text(automaton)
    except (UsageError, OutputError):
        return None
    # a page must not contain the XML declaration and document type that precede the element
    return drawing[drawing.index("<svg") :]


def _is_large(automaton: Automaton) -> bool:
    # listing the transitions of an automaton with very many states takes long
    if len(automaton.states) > _MOST_STATES or not automaton.is_listable:
        return True
    return sum(len(transition.guard) for transition in automaton.transitions) > _MOST_CUBES


@plot.register(Automaton)
def draw_automaton(automaton: Automaton, ax: Axes | None = None) -> Axes:
    """Draw the automaton with the layout of Graphviz.

    Raises:
        UsageError: Graphviz or matplotlib is not installed.
        OutputError: Graphviz fails or reaches its timeout.
    """
    short = abbreviate(automaton)
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
    """Draw a circle with the number of a state, or the unnumbered point before the initial state."""
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
    """Draw a curve with an arrow head, and the guard next to it."""
    # Graphviz writes the tip of the head first, as e,X,Y: https://graphviz.org/docs/attr-types/splineType/
    head, *points = (_point(point.removeprefix("e,")) for point in edge["pos"].split())
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

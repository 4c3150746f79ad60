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
    summary = quiet(f" {plural(len(results), 'result')}, profile {specification.profile}")
    declaration_kinds = ("constants", "regions", "groups")
    names_by_kind = {kind: ", ".join(getattr(specification, kind)) for kind in declaration_kinds}
    declarations = [
        element("div", f"{kind}: {joined_names}")
        for kind, joined_names in names_by_kind.items()
        if joined_names
    ]
    warnings = [element("div", f"warning: {warning.message}") for warning in specification.warnings[:5]]
    return element("div", element("div", title, summary), *declarations, _formula_trees(results), *warnings)


def _formula_trees(results: Sequence[NamedSpec]) -> Html:
    """Return the trees one below the other, with `_MOST_FORMULAS` nodes at most."""
    remaining_nodes = _MOST_FORMULAS
    rows: list[tuple[str]] = []
    for spec in results:
        cells = [
            (tree_cell(stem, node),) for _, stem, node in islice(iter_branches(spec.formula), remaining_nodes)
        ]
        remaining_nodes -= len(cells)
        rows += cells
    return element("div", table(["tree"], rows), _left_out(results, len(rows)))


def tree_cell(stem: str, node: Formula) -> Html:
    """Return a node of a tree, with its name in bold."""
    indented = stem if len(stem) <= 3 * _DEEPEST else "⋯" + stem[-3:]
    name = [] if node.name is None else [element("b", node.name), " = "]
    return code(indented, *name, title_of(node))


def _left_out(results: Sequence[NamedSpec], row_count: int) -> Html:
    node_count = _size(results)
    return (
        quiet(f"… and {plural(node_count - row_count, 'node')} more") if row_count < node_count else Html("")
    )


class _NodePosition(NamedTuple):
    """A node in a drawing.

    Attributes:
        x: level from the left.
        y: row from the top.
        parent: x and y of the parent; None for a root.
    """

    node: Formula
    x: float
    y: float
    parent: tuple[float, float] | None


@plot.register(Specification)
def draw_specification(specification: Specification, ax: Axes | None = None) -> Axes:
    """Draw the trees of a specification's results, with the roots on the left.

    Raises:
        UsageError: matplotlib is not installed.
    """
    positions = list(_positions(specification.results))
    row_count = 1 + max((position.y for position in positions), default=0.0)
    level_count = 1 + max((position.x for position in positions), default=0.0)
    if ax is None:
        ax = new_panel((min(3.0 + 0.85 * level_count, 14.0), 0.6 + 0.32 * row_count))
    ax.set_axis_off()
    ax.set_xlim(-0.2, level_count + 2.5)
    ax.set_ylim(row_count - 0.4, -0.9)
    for position in positions:
        if position.parent is not None:
            (x, y), bend = position.parent, position.x - 0.5
            ax.plot(
                [x, bend, bend, position.x],
                [y, y, position.y, position.y],
                color=NEUTRAL,
                linewidth=1,
                zorder=1,
            )
        _draw_node(ax, position)
    node_count = _size(specification.results)
    left_out_text = (
        f", the first {len(positions)} of {plural(node_count, 'node')}" if len(positions) < node_count else ""
    )
    ax.set_title(plain(specification.filename + left_out_text), loc="left", fontsize=10)
    return ax


def _positions(results: Sequence[NamedSpec]) -> Iterator[_NodePosition]:
    """Yield the first `_MOST_DRAWN` nodes with their positions, one tree below the other."""
    remaining_nodes, first_row = _MOST_DRAWN, 0.0
    for spec in results:
        nodes = list(islice(iter_nodes(spec.formula), remaining_nodes))
        remaining_nodes -= len(nodes)
        rows, row_count = _rows([parent for _, parent, _ in nodes], first_row)
        first_row += row_count + _ROW_GAP
        levels: list[int] = []
        for identifier, parent, node in nodes:
            levels.append(0 if parent is None else levels[parent] + 1)
            parent_position = None if parent is None else (float(levels[parent]), rows[parent])
            yield _NodePosition(node, float(levels[identifier]), rows[identifier], parent_position)


def _rows(parents: Sequence[int | None], first_row: float) -> tuple[list[float], int]:
    """Return the row of each node, and the number of rows.

    Each leaf has its own row. Parents are halfway between their first and their last child.
    """
    operands_by_node: list[list[int]] = [[] for _ in parents]
    for identifier, parent in enumerate(parents):
        if parent is not None:
            operands_by_node[parent].append(identifier)
    rows = [0.0] * len(parents)
    leaf_ids = [identifier for identifier, operands in enumerate(operands_by_node) if not operands]
    for leaf_row, leaf in enumerate(leaf_ids):
        rows[leaf] = first_row + leaf_row
    # `iter_nodes` yields parents first, so that the reverse order places children before their parents
    for identifier in reversed(range(len(parents))):
        if operands_by_node[identifier]:
            rows[identifier] = (
                rows[operands_by_node[identifier][0]] + rows[operands_by_node[identifier][-1]]
            ) / 2
    return rows, len(leaf_ids)


def _draw_node(ax: Axes, position: _NodePosition) -> None:
    node = position.node
    box_style = {"boxstyle": "round,pad=0.3", "facecolor": _PAPER, "edgecolor": NEUTRAL, "linewidth": 0.8}
    is_leaf = not operands_of(node)
    ax.text(
        position.x, position.y, plain(label_of(node) if is_leaf else title_of(node)),
        ha="left" if is_leaf else "center", va="center", fontsize=8.5, color=INK, bbox=box_style, zorder=2,
    )  # fmt: skip
    if node.name is not None and not is_leaf:
        ax.text(
            position.x, position.y - 0.36, plain(node.name),
            ha="center", va="bottom", fontsize=8, fontweight="bold", zorder=2,
        )  # fmt: skip


def _size(results: Sequence[NamedSpec]) -> int:
    return sum(1 for spec in results for _ in iter_nodes(spec.formula))


_MOST_ROWS: Final = 40
"""Limit of objects in a table."""
_MOST_POINTS: Final = 2_000
"""Limit of points in a trail."""

_MOST_LABELS: Final = 25
_NAME_SIZE: Final = 8.0
"""Font size of object names, points."""
_STEPS: Final = (0.0, 1.2, -1.2, 2.4, -2.4, 3.6, -3.6, 4.8, -4.8)
"""Offsets of a name above its object, in the order of preference, as multiples of the font size."""


@html.register(Trace)
def trace_html(trace: Trace) -> Html:
    """Return the length of a trace, and the number of samples of each object."""
    sample_counts = (trace.rows >= 0).sum(axis=0).tolist()
    rows = [(name, f"{count:,}") for name, count in zip(trace.names, sample_counts, strict=True) if count]
    left_out = [quiet(f"… and {len(rows) - _MOST_ROWS:,} objects more")] if len(rows) > _MOST_ROWS else []
    return element(
        "div", element("b", _trace_title(trace)), table(("object", "samples"), rows[:_MOST_ROWS]), *left_out
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
    end_labels: list[tuple[float, float, str]] = []
    columns = [column for column in range(len(trace.names)) if (trace.rows[:, column] >= 0).any()]
    for colour_index, column in enumerate(columns):
        rows = trace.rows[:, column]
        rows = rows[rows >= 0]
        colour = CURVES[colour_index % len(CURVES)]
        sampled_rows = rows[np.unique(np.linspace(0, len(rows) - 1, _MOST_POINTS).astype(np.int64))]
        ax.plot(*_centres(trace, sampled_rows).T, color=colour, linewidth=1.0)
        for ring in _rings(trace, rows[:1]):
            ax.fill(*ring.T, facecolor="none", edgecolor=colour, linestyle="--", linewidth=1.0)
        for ring in _rings(trace, rows[-1:]):
            ax.fill(*ring.T, facecolor=colour, edgecolor=colour, alpha=0.5)
        if len(columns) <= _MOST_LABELS:
            [(x, y)] = _centres(trace, rows[-1:]).tolist()
            end_labels.append((x, y, plain(trace.names[column])))
    _write_names(ax, end_labels)
    unit = plain(trace.units.get("", "footprint units"))
    ax.set_xlabel(f"x [{unit}]")
    ax.set_ylabel(f"y [{unit}]")
    ax.set_title(plain(_trace_title(trace)), loc="left", fontsize=10)
    return ax


def _write_names(ax: Axes, end_labels: Sequence[tuple[float, float, str]]) -> None:
    """Write names at positions (x, y, name). A name moves up or down to avoid earlier names."""
    # the transformation is final only after the aspect is applied
    ax.apply_aspect()
    inches_from_data = ax.transData + ax.figure.dpi_scale_trans.inverted()
    labels: list[tuple[float, float, float]] = []
    for x, y, name in end_labels:
        label_x, label_y = (72.0 * inches_from_data.transform((x, y))).tolist()
        # estimated half width: 0.6 of the font size per character
        half_width = 0.3 * _NAME_SIZE * len(name)
        for step in _STEPS:
            is_free = all(
                abs(label_x - other_x) > half_width + other_half
                or abs(label_y + step * _NAME_SIZE - other_y) >= _NAME_SIZE
                for other_x, other_y, other_half in labels
            )
            if is_free:
                break
        labels.append((label_x, label_y + step * _NAME_SIZE, half_width))
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
    """Return the outlines of one observation; `rows` has one row."""
    return rings_of(trace.footprints.select(rows), 0.0).rings_of(0)


def _centres(trace: Trace, rows: Integers) -> Floats:
    """Return (R, 2), the centre of each observation's bounding box."""
    rings = rings_of(trace.footprints.select(rows), 0.0)
    ring_begins = np.asarray(rings.start)[: len(rows)]
    lows, highs = (reduce.reduceat(rings.points, ring_begins, axis=0) for reduce in (np.minimum, np.maximum))
    return np.asarray((lows + highs) / 2.0)


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
    # nullable integers: with a missing time, other times would become floats, which lose nanoseconds
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
    node_names = [node.name or f"{node.id}: {node.text}" for node in result.nodes]
    for name, node in zip(node_names, result.nodes, strict=True):
        title = name if node_names.count(name) == 1 else f"{node.id}: {name}"
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
    worst_results = _worst_of(evaluation.results, _MOST_RESULTS)
    left_out_count = len(evaluation.results) - len(worst_results)
    left_out_note = (
        quiet(f"… and {plural(left_out_count, 'result')} more, none of them worse")
        if left_out_count
        else Html("")
    )
    return element("div", title, _results_table(worst_results), left_out_note, *_trees(worst_results))


@html.register(SpecResult)
def result_html(result: SpecResult) -> Html:
    """Return a result's row in a table, and its tree with the final numbers."""
    return element("div", _results_table([result]), *_trees([result]))


def _results_table(results: Sequence[SpecResult]) -> Html:
    rows = []
    for result in results:
        robustness = interval_text(result.robustness, result.lower, result.upper, result.unit)
        name, verdict = element("b", result.title), verdict_mark(result.verdict)
        tested_text = ", ".join([result.tested, *["doubtful"] * bool(result.doubts)])
        tested_cell = element("span", tested_text, title=" ".join(result.remarks))
        rows.append((name, verdict, robustness, _first_satisfied_text(result), tested_cell))
    return table(["result", "verdict", "robustness", "first satisfied", "tested"], rows)


def _first_satisfied_text(result: SpecResult) -> str:
    if result.verdict is Verdict.UNKNOWN:
        return "not known"
    at_ns = result.first_satisfied_ns
    return "never" if at_ns is None else time_text(at_ns, result.evidence.first_ns())


def _trees(results: Sequence[SpecResult]) -> Iterator[Html]:
    """Yield the trees of results, with `_MOST_NODES` nodes at most."""
    remaining_nodes = _MOST_NODES
    for result in results:
        if remaining_nodes <= 0:
            return
        rows = list(islice(_tree_rows(result), remaining_nodes))
        remaining_nodes -= len(rows)
        left_out_count = len(result.final) - len(rows)
        left_out_note = quiet(f"… and {plural(left_out_count, 'node')} more") if left_out_count else Html("")
        node_table = table(["verdict", "robustness", "node"], rows)
        yield details(f"tree of {result.title}, each node at the first sample", node_table, left_out_note)


def _tree_rows(result: SpecResult) -> Iterator[tuple[str, str, str]]:
    for identifier, stem, node in iter_branches(result.formula):
        lower, upper = result.final[identifier].tolist()
        value = float(result.series[identifier, 0, -1])
        verdict = verdict_mark(final_verdict(lower, upper))
        yield verdict, interval_text(value, lower, upper), tree_cell(stem, node)


def _worst_of(results: Sequence[SpecResult], most: int) -> Sequence[SpecResult]:
    """Return the `most` worst results. At most `most` results are returned unchanged."""
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
    worst_results = _worst_of(evaluation.results, _MOST_PANELS)
    if not worst_results:
        return ()
    size = (_WIDTH, 0.4 + _HEIGHT * len(worst_results))
    panels = _draw_results(worst_results, new_panels(len(worst_results), 1, size, same_x=True))
    for panel in panels:
        panel.label_outer()
    if len(worst_results) < len(evaluation.results):
        left_out_text = plural(len(evaluation.results) - len(worst_results), "result")
        panels[-1].set_xlabel(f"{panels[-1].get_xlabel()}\nand {left_out_text} more, none worse")
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
    axis_low, axis_high = _limits([curve.values for curve in curves])
    _, _, lower, upper = result.series[0]
    ax.set_xlim(seconds[0], seconds[-1] if len(seconds) > 1 else 1.0)
    ax.set_ylim(axis_low, axis_high)
    ax.axhline(0.0, color=NEUTRAL, linewidth=0.8, zorder=1)
    has_band = bool((lower < upper).any())
    ax.fill_between(
        seconds, np.clip(lower, axis_low, axis_high), np.clip(upper, axis_low, axis_high),
        color=curves[0].colour, alpha=_SHADE, linewidth=0,
    )  # fmt: skip
    for curve_index, curve in enumerate(curves):
        # the result's curve is thicker, so that it stays visible below an equal curve of a named spec
        ax.plot(seconds, curve.values, color=curve.colour, linewidth=1.2 if curve_index else 3.0)
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
    ids_by_name = {
        node.name: node_id for node_id, _, node in reversed(list(iter_nodes(result.formula))) if node.name
    }
    named_nodes = sorted((node_id, name) for name, node_id in ids_by_name.items() if node_id)
    # the first two colours mean satisfied and violated
    coloured_nodes = zip(named_nodes, CURVES[2 : _MOST_CURVES + 1], strict=False)
    return [
        _Curve(result.title, _finite(result, 0), verdict_colour),
        *(_Curve(name, _finite(result, node_id), colour) for (node_id, name), colour in coloured_nodes),
    ]


def _finite(result: SpecResult, node: int) -> Floats:
    """Return the values of a node, with NaN instead of infinite values."""
    values = result.series[node, 0]
    return np.where(np.isfinite(values), values, np.nan)


def _limits(curves: Sequence[Floats]) -> tuple[float, float]:
    """Return the limits of a panel's robustness axis, which always includes 0."""
    values = np.concatenate([[0.0], *(curve[~np.isnan(curve)] for curve in curves)])
    least, greatest = float(values.min()), float(values.max())
    margin = 0.1 * (greatest - least) or 1.0
    return least - margin, greatest + margin


def _name_curves(ax: Axes, curves: Sequence[_Curve], has_band: bool) -> None:
    """Write names to the right of the curves, and the interval's name at the bottom, without overlap."""
    axis_low, axis_high = ax.get_ylim()
    end_heights = [(_last(curve.values) - axis_low) / (axis_high - axis_low) for curve in curves]
    *label_heights, band_height = _apart([*end_heights, 0.0])
    for height, curve in zip(label_heights, curves, strict=True):
        _draw_key(ax, height, curve.name, curve.colour, is_bold=curve is curves[0])
    if has_band:
        _draw_key(ax, band_height, "still possible", curves[0].colour, alpha=2 * _SHADE)


def _draw_key(
    ax: Axes, height: float, name: str, colour: str, *, alpha: float = 1.0, is_bold: bool = False
) -> None:
    """Draw a coloured square to the right of the axes, with its name."""
    weight = "bold" if is_bold else "normal"
    square_style, name_style = {"color": colour, "alpha": alpha}, {"fontweight": weight}
    for text, offset_points, style in (("■", 5, square_style), (plain(name, _LONGEST_NAME), 17, name_style)):
        ax.annotate(
            text, (1.0, height), (offset_points, 0), xycoords="axes fraction", textcoords="offset points",
            va="center", fontsize=9, **style,
        )  # fmt: skip


def _last(values: Floats) -> float:
    """Return the last finite number of a curve; 0 without a finite number."""
    finite = values[~np.isnan(values)]
    return float(finite[-1]) if len(finite) else 0.0


def _apart(heights: Sequence[float]) -> list[float]:
    """Move heights apart by at least `_GAP`. The order stays, and no height exceeds 1."""
    moved_heights = list(heights)
    height_order = sorted(range(len(heights)), key=heights.__getitem__)
    below = -np.inf
    for index in height_order:
        below = moved_heights[index] = max(moved_heights[index], below + _GAP)
    above = 1.0 + _GAP
    for index in reversed(height_order):
        above = moved_heights[index] = min(moved_heights[index], above - _GAP)
    return moved_heights


def _title(result: SpecResult) -> str:
    robustness = interval_text(result.robustness, result.lower, result.upper, result.unit)
    return plain(f"{result.title}: {result.verdict}, robustness {robustness}")


_MOST_STATES: Final = 40
"""Limit of states of an automaton that a cell's output draws."""
_MOST_CUBES: Final = 100
"""Limit of cubes in all guards of an automaton that a cell's output draws."""
_MOST_LINES: Final = 200
"""Limit of lines in the list of transitions."""
_ARROW: Final = hexadecimal(NEUTRAL)
_INCH: Final = 72.0
"""Graphviz' points per inch: https://graphviz.org/docs/outputs/json/"""
_LONGEST_SIDE: Final = 40.0
"""Limit of a figure's sides, inches."""


@html.register(Automaton)
def automaton_html(automaton: Automaton) -> Html:
    """Return the size of an automaton; for a small automaton also its drawing and its transitions."""
    title = element("div", element("b", automaton.name), quiet(f" {size_words(automaton)}"))
    if _is_large(automaton):
        return element("div", title, quiet("too large to be drawn here; plot() draws it, to_dot() writes it"))
    drawing = automaton_svg(automaton)
    content = quiet("install Graphviz to see it drawn") if drawing is None else Html(drawing)
    text_lines = words_text(automaton).split("\n")
    line_elements = [element("div", code(line)) for line in text_lines[:_MOST_LINES]]
    left_out = (
        [quiet(f"… and {len(text_lines) - _MOST_LINES:,} lines more")]
        if len(text_lines) > _MOST_LINES
        else []
    )
    picture = element("div", content, style="overflow-x:auto")
    return element("div", title, picture, details("in words", *line_elements, *left_out))


def automaton_svg(automaton: Automaton) -> str | None:
    """Return an automaton as SVG; None for a large automaton, or if Graphviz is missing or fails."""
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
    short_automaton = abbreviate(automaton)
    layout = json.loads(layout_text(short_automaton))
    width, height = _point(layout["bb"].removeprefix("0,0,"))
    legend = meanings(short_automaton)
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
    legend_text = "\n".join(plain(line, 100) for line in legend)
    ax.annotate(
        legend_text,
        (0, 0),
        (0, -6),
        xycoords="axes fraction",
        textcoords="offset points",
        va="top",
        fontsize=8.5,
    )
    return ax


def _draw_state(ax: Axes, automaton: Automaton, node: Mapping[str, Any]) -> None:
    """Draw a circle with the number of a state, or the unnumbered point before the initial state."""
    x, y = _point(node["pos"])
    radius = float(node["width"]) * _INCH / 2
    is_state = node["name"].isdecimal()
    colour = state_colour(automaton, int(node["name"])) if is_state else INK
    radii = [radius, radius - 4.0] if is_state and int(node["name"]) in automaton.accepting else [radius]
    for circle_radius in radii:
        draw_disc(ax, (x, y), circle_radius, colour)
    if is_state:
        ax.text(x, y, node["name"], ha="center", va="center", fontsize=11, color=INK)


def _draw_edge(ax: Axes, edge: Mapping[str, Any]) -> None:
    """Draw a curve with an arrow head, and the guard next to it."""
    # Graphviz writes the tip of the head first, as e,X,Y: https://graphviz.org/docs/attr-types/splineType/
    tip, *points = (_point(point.removeprefix("e,")) for point in edge["pos"].split())
    draw_curve(ax, points, _ARROW)
    ax.annotate(
        "", tip, points[-1],
        arrowprops={"arrowstyle": "-|>", "color": _ARROW, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9},
    )  # fmt: skip
    if edge.get("label"):
        lines = [plain(line) for line in edge["label"].split("\\n")]
        x, y = _point(edge["lp"])
        ax.text(x, y, "\n".join(lines), ha="center", va="center", fontsize=8.5)


def _point(text: str) -> tuple[float, float]:
    x, y = map(float, text.split(","))
    return x, y

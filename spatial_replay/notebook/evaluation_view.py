"""Evaluations in notebooks: verdicts with trees of final numbers, and robustness as curves over time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from spatial_replay.annotate.specification import unit_of, unit_words
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.evaluate import Evaluation
from spatial_replay.monitor.result import SpecResult, worst_first
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import (
    Html,
    element,
    folded,
    new_panel,
    new_panels,
    plain,
    quiet,
    table,
    verdict_mark,
)
from spatial_replay.notebook.specification_view import tree_cell
from spatial_replay.palette import CURVES, NEGATIVE, NEUTRAL, POSITIVE, hexadecimal
from spatial_replay.spec.format import iter_branches
from spatial_replay.spec.formula import iter_nodes
from spatial_replay.text import counted, with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_RESULTS: Final = 50
_MOST_NODES: Final = 300
"""The most nodes in the trees of all results together."""
_MOST_PANELS: Final = 8
_MOST_CURVES: Final = 6
"""The most curves in a panel, including that of the result."""
_WIDTH, _HEIGHT = 8.0, 2.4
"""Size of a panel, in inches."""
_LONGEST_NAME: Final = 24
_SHADE: Final = 0.15
"""Opacity of the band."""
_GAP: Final = 0.11
"""Least distance of two labels, as a fraction of the height of a panel."""


@html.register(Evaluation)
def evaluation_html(evaluation: Evaluation) -> Html:
    """Return the verdict, a table of results, and a tree of each with its final numbers."""
    name = element("b", evaluation.specification.filename)
    title = element("div", name, " ", verdict_mark(evaluation.verdict))
    shown = _worst_of(evaluation.results, _MOST_RESULTS)
    left_out = len(evaluation.results) - len(shown)
    more = quiet(f"… and {counted(left_out, 'result')} more, none of them worse") if left_out else Html("")
    return element("div", title, _results_table(shown), more, *_trees(shown))


@html.register(SpecResult)
def result_html(result: SpecResult) -> Html:
    """Return a result as a table, and its tree with the final numbers."""
    return element("div", _results_table([result]), *_trees([result]))


def _title_of(result: SpecResult) -> str:
    """Return the name of a result, with its object if it has one."""
    return result.name if result.object is None else f"{result.name} for {result.object}"


def _robustness_text(value: float, lower: float, upper: float, unit: str = "") -> str:
    """Return a robustness with its unit, or its interval if it is unknown."""
    return (
        with_unit(value, unit) if value == value else f"{with_unit(lower, unit)} to {with_unit(upper, unit)}"
    )


def _results_table(results: Sequence[SpecResult]) -> Html:
    rows = []
    for each in results:
        robustness = _robustness_text(each.robustness, each.lower, each.upper, each.unit)
        name, verdict = element("b", _title_of(each)), verdict_mark(each.verdict)
        rows.append((name, verdict, robustness, _first_satisfied(each), _tested(each)))
    return table(["result", "verdict", "robustness", "first satisfied", "tested"], rows)


def _tested(result: SpecResult) -> Html:
    """Return what a result was tested by, with the sentences on the parts that were not."""
    return element("span", result.tested, title=" ".join(result.remarks))


def _first_satisfied(result: SpecResult) -> str:
    if result.verdict is Verdict.UNKNOWN:
        return "not known"
    at_ns = result.first_satisfied_ns
    return "never" if at_ns is None else f"{(at_ns - int(result.times_ns[0])) / 1e9:.3f} s"


def _trees(results: Sequence[SpecResult]) -> Iterator[Html]:
    """Iterate over the trees of results, up to the most nodes."""
    left = _MOST_NODES
    for result in results:
        if left <= 0:
            return
        rows = list(islice(_tree_rows(result), left))
        left -= len(rows)
        left_out = len(result.final) - len(rows)
        more = quiet(f"… and {counted(left_out, 'node')} more") if left_out else Html("")
        nodes = table(["verdict", "robustness", "node"], rows)
        yield folded(f"tree of {_title_of(result)}, each node at the first sample", nodes, more)


def _tree_rows(result: SpecResult) -> Iterator[tuple[str, str, str]]:
    for identifier, stem, node in iter_branches(result.formula):
        lower, upper = result.final[identifier].tolist()
        value = float(result.series[identifier, 0, -1])
        verdict = verdict_mark(final_verdict(lower, upper))
        yield verdict, _robustness_text(value, lower, upper), tree_cell(stem, node)


def _worst_of(results: Sequence[SpecResult], most: int) -> Sequence[SpecResult]:
    """Return the results, or the `most` worst ones if there are more."""
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
    """Draw each result in its own axes, one below the other; of many results, the worst ones.

    Args:
        ax: axes to draw into, one for each result.

    Raises:
        UsageError: more or fewer axes than results, or matplotlib is not installed.
    """
    if ax is not None:
        given = np.array(list(ax) if isinstance(ax, Iterable) else [ax], object)
        return _drawn(evaluation.results, tuple(given.flat))
    shown = _worst_of(evaluation.results, _MOST_PANELS)
    if not shown:
        return ()
    size = (_WIDTH, 0.4 + _HEIGHT * len(shown))
    panels = _drawn(shown, new_panels(len(shown), 1, size, same_x=True))
    for panel in panels:
        panel.label_outer()
    if len(shown) < len(evaluation.results):
        left_out = counted(len(evaluation.results) - len(shown), "result")
        panels[-1].set_xlabel(f"{panels[-1].get_xlabel()}\nand {left_out} more, none worse")
    return panels


def _drawn(results: Sequence[SpecResult], panels: tuple[Axes, ...]) -> tuple[Axes, ...]:
    """Draw each result in its axes."""
    if len(results) != len(panels):
        count = counted(len(results), "result")
        raise UsageError(f"ax has {len(panels)} axes for {count}; give one for each, or draw one result")
    for result, panel in zip(results, panels, strict=True):
        draw_result(result, panel)
    return panels


@plot.register(SpecResult)
def draw_result(result: SpecResult, ax: Axes | None = None) -> Axes:
    """Draw the robustness of a result over time, its interval of possible values, and that of named parts.

    Raises:
        UsageError: matplotlib is not installed.
    """
    ax = new_panel((_WIDTH, 0.4 + _HEIGHT)) if ax is None else ax
    seconds = (result.times_ns - result.times_ns[0]) / 1e9
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
        # the result's curve is thicker, so that it shows below an equal one of a part
        ax.plot(seconds, curve.values, color=curve.colour, linewidth=1.2 if number else 3.0)
    _name_curves(ax, curves, has_band)
    ax.set_title(_title(result), loc="left", fontsize=10)
    ax.set_xlabel("time from the first sample in s")
    ax.set_ylabel(plain(f"robustness [{unit_words(unit_of(result.formula, result.evidence.units))}]"))
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def _curves(result: SpecResult) -> list[_Curve]:
    """Return the curve of a result, and those of the first named specs in it."""
    colours = {Verdict.SATISFIED: POSITIVE, Verdict.VIOLATED: NEGATIVE}
    own = hexadecimal(colours.get(result.verdict, NEUTRAL))
    named = {node.name: number for number, _, node in reversed(list(iter_nodes(result.formula))) if node.name}
    parts = sorted((number, name) for name, number in named.items() if number)
    # the first two colours stand for satisfied and violated
    others = zip(parts, CURVES[2 : _MOST_CURVES + 1], strict=False)
    return [
        _Curve(_title_of(result), _finite(result, 0), own),
        *(_Curve(name, _finite(result, number), colour) for (number, name), colour in others),
    ]


def _finite(result: SpecResult, node: int) -> Floats:
    """Return the value of a node, NaN where it is infinite."""
    values = result.series[node, 0]
    return np.where(np.isfinite(values), values, np.nan)


def _limits(curves: Sequence[Floats]) -> tuple[float, float]:
    """Return the least and the greatest robustness of a panel, which always shows 0."""
    values = np.concatenate([[0.0], *(curve[~np.isnan(curve)] for curve in curves)])
    low, high = float(values.min()), float(values.max())
    margin = 0.1 * (high - low) or 1.0
    return low - margin, high + margin


def _name_curves(ax: Axes, curves: Sequence[_Curve], has_band: bool) -> None:
    """Write the name of each curve to its right, and that of the band below, without overlap."""
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
    """Return the last number of a curve; 0 without one."""
    known = values[~np.isnan(values)]
    return float(known[-1]) if len(known) else 0.0


def _apart(places: Sequence[float]) -> list[float]:
    """Return places moved apart, in their order, by at least the gap, and none above 1."""
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
    robustness = _robustness_text(result.robustness, result.lower, result.upper, result.unit)
    return plain(f"{_title_of(result)}: {result.verdict}, robustness {robustness}")

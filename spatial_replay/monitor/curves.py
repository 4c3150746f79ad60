"""Robustness as curves over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.figures import new_panel, new_panels, plain
from spatial_replay.geometry.arrays import Floats
from spatial_replay.markup import counted
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.monitor.verdict_table import robustness_text, title_of, worst_of
from spatial_replay.palette import CURVES, NEGATIVE, NEUTRAL, POSITIVE, hexadecimal
from spatial_replay.spec.formula import iter_nodes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from spatial_replay.monitor.evaluation import Evaluation, SpecResult

_MOST_PANELS: Final = 8
_MOST_CURVES: Final = 6
"""Curves in a panel, that of the result included."""
_WIDTH, _HEIGHT = 8.0, 2.4
"""Of a panel, in inches."""
_LONGEST_NAME: Final = 24
_GAP: Final = 0.11
"""Between two labels, as a share of a panel's height."""


class Curve(NamedTuple):
    """A curve and what it is called."""

    name: str
    values: Floats
    colour: str


def draw_evaluation(evaluation: Evaluation, ax: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
    """Draw each result in axes of its own, below each other; of many, the worst ones.

    Args:
        ax: axes to draw into, one for each result.

    Raises:
        UsageError: more or fewer axes than results, or matplotlib is not installed.
    """
    if ax is None:
        shown = worst_of(evaluation.results, _MOST_PANELS)
        size = (_WIDTH, 0.4 + _HEIGHT * len(shown))
        panels = new_panels(len(shown), 1, size, same_x=True) if shown else ()
    else:
        shown, panels = evaluation.results, tuple(ax) if isinstance(ax, Sequence) else (ax,)
    if len(shown) != len(panels):
        results = counted(len(shown), "result")
        raise UsageError(f"ax has {len(panels)} axes for {results}; give one for each, or draw one result")
    for result, panel in zip(shown, panels, strict=True):
        draw_result(result, panel)
        panel.label_outer()
    if len(shown) < len(evaluation.results):
        left_out = len(evaluation.results) - len(shown)
        panels[-1].set_xlabel(
            f"{panels[-1].get_xlabel()}\nand {counted(left_out, 'result')} more, none worse"
        )
    return panels


def draw_result(result: SpecResult, ax: Axes | None = None) -> Axes:
    """Draw a result's robustness on what was seen so far, what it can still become, and that of its parts.

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
    ax.fill_between(
        seconds, np.clip(lower, low, high), np.clip(upper, low, high),
        color=curves[0].colour, alpha=0.15, linewidth=0,
    )  # fmt: skip
    for number, curve in enumerate(curves):
        # the result's own shows below a part's where both are the same
        ax.plot(seconds, curve.values, color=curve.colour, linewidth=1.2 if number else 3.0)
    _name_curves(ax, curves)
    ax.set_title(_title(result), loc="left", fontsize=10)
    ax.set_xlabel("time from the first sample in s; shaded: what the robustness can still become")
    ax.set_ylabel("robustness")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def _curves(result: SpecResult) -> list[Curve]:
    """The result's own curve, and those of the first specs that it is made of."""
    colours = {Verdict.SATISFIED: POSITIVE, Verdict.VIOLATED: NEGATIVE}
    values = np.where(np.isfinite(result.series[:, 0]), result.series[:, 0], np.nan)
    curves = [Curve(title_of(result), values[0], hexadecimal(colours.get(result.verdict, NEUTRAL)))]
    named = {node.name: number for number, _, node in reversed(list(iter_nodes(result.formula))) if node.name}
    parts = sorted((number, name) for name, number in named.items() if number)
    # blue and vermillion say how the result is
    for (number, name), colour in zip(parts, CURVES[2 : _MOST_CURVES + 1], strict=False):
        curves.append(Curve(name, values[number], colour))
    return curves


def _limits(curves: Sequence[Floats]) -> tuple[float, float]:
    """The least and the greatest robustness that a panel shows; 0 lies between."""
    values = np.concatenate([[0.0], *(curve[~np.isnan(curve)] for curve in curves)])
    low, high = float(values.min()), float(values.max())
    margin = 0.1 * (high - low) or 1.0
    return low - margin, high + margin


def _name_curves(ax: Axes, curves: Sequence[Curve]) -> None:
    """Write each curve's name to the right of where it ends, none over another."""
    low, high = ax.get_ylim()
    ends = [_last(curve.values) for curve in curves]
    places = _apart([(end - low) / (high - low) for end in ends])
    for place, curve in zip(places, curves, strict=True):
        ax.plot(1.02, place, "s", color=curve.colour, transform=ax.transAxes, clip_on=False)
        weight = "bold" if curve is curves[0] else "normal"
        name = plain(curve.name, _LONGEST_NAME)
        ax.text(1.035, place, name, transform=ax.transAxes, va="center", fontsize=9, fontweight=weight)


def _last(values: Floats) -> float:
    """The last number of a curve; 0 where it has none."""
    known = values[~np.isnan(values)]
    return float(known[-1]) if len(known) else 0.0


def _apart(places: Sequence[float]) -> list[float]:
    """Places moved, in their order, so that none is nearer than the gap to another and none above 1."""
    apart = list(places)
    below = -np.inf
    for number in sorted(range(len(places)), key=places.__getitem__):
        below = apart[number] = max(places[number], below + _GAP)
    excess = max(below - 1.0, 0.0)
    return [place - excess for place in apart]


def _title(result: SpecResult) -> str:
    robustness = robustness_text(result.robustness, result.lower, result.upper)
    return plain(f"{title_of(result)}: {result.verdict}, robustness {robustness}")

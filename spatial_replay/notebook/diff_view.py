"""Diffs in notebooks: what changed as sentences, and both curves of each spec over time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from spatial_replay.compare.runs import LogDiff
from spatial_replay.compare.specifications import SpecDiff, SpecificationDiff
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import Html, element, new_panels
from spatial_replay.palette import CURVES, NEUTRAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_PANELS: Final = 8
_WIDTH, _HEIGHT = 8.0, 2.4
"""Size of a panel, in inches."""


class _Pair(NamedTuple):
    """Two curves, each with its name, over the same time axis."""

    title: str
    names: tuple[str, str]
    seconds: tuple[Floats, Floats]
    values: tuple[Floats, Floats]


@html.register(SpecificationDiff)
@html.register(LogDiff)
def diff_html(diff: SpecificationDiff | LogDiff) -> Html:
    """Return a diff in the words of the command `diff`."""
    return _lines_html(diff.lines())


@html.register(SpecDiff)
def spec_diff_html(diff: SpecDiff) -> Html:
    """Return what changed of one spec, in sentences."""
    first_ns = diff.old.evidence.first_ns()
    return _lines_html([diff.title, *(f"  {sentence}" for sentence in diff.sentences(first_ns))])


def _lines_html(lines: Iterable[str]) -> Html:
    style = "white-space:pre-wrap;text-align:left"
    return element("pre", "\n".join(lines), style=style)


@plot.register(SpecificationDiff)
def draw_specifications(diff: SpecificationDiff) -> tuple[Axes, ...]:
    """Draw the robustness of each changed spec before and after, one panel each, at most eight.

    Raises:
        UsageError: no spec changed, or matplotlib is not installed.
    """
    names = diff.old.filename, diff.new.filename
    return _draw([_changed(each, names) for each in diff.specs if each.edits or each.is_different])


@plot.register(SpecDiff)
def draw_spec(diff: SpecDiff) -> Axes:
    """Draw the robustness of a spec before and after the edit.

    Raises:
        UsageError: matplotlib is not installed.
    """
    return _draw([_changed(diff, ("before", "after"))])[0]


@plot.register(LogDiff)
def draw_runs(diff: LogDiff) -> tuple[Axes, ...]:
    """Draw the robustness of each spec in both runs, as they are aligned, one panel each, at most eight.

    Raises:
        UsageError: no spec was evaluated, or matplotlib is not installed.
    """
    sides = tuple(zip(diff.traces, (diff.alignment.a, diff.alignment.b), strict=True))
    seconds = (diff.traces[0].times_ns[diff.alignment.a] - diff.starts_ns[0]) / 1e9
    pairs = []
    for spec in diff.specs:
        columns = []
        for result, (trace, chosen) in zip((spec.a, spec.b), sides, strict=True):
            value = np.full(len(trace), np.nan)
            value[np.searchsorted(trace.times_ns, result.times_ns)] = result.series[0, 0]
            columns.append(value[chosen])
        pairs.append(_Pair(spec.a.title, ("A", "B"), (seconds, seconds), (columns[0], columns[1])))
    return _draw(pairs)


def _changed(diff: SpecDiff, names: tuple[str, str]) -> _Pair:
    results = diff.old, diff.new
    first_ns = diff.old.times_ns[0] if len(diff.old.times_ns) else 0
    one, other = ((result.times_ns - first_ns) / 1e9 for result in results)
    return _Pair(diff.title, names, (one, other), (diff.old.series[0, 0], diff.new.series[0, 0]))


def _draw(pairs: Sequence[_Pair]) -> tuple[Axes, ...]:
    if not pairs:
        raise UsageError("there is nothing to draw: no spec differs, or none was evaluated")
    shown = pairs[:_MOST_PANELS]
    panels = new_panels(len(shown), 1, (_WIDTH, 0.4 + _HEIGHT * len(shown)), same_x=True)
    for ax, pair in zip(panels, shown, strict=True):
        ax.axhline(0.0, color=NEUTRAL, linewidth=0.8, zorder=1)
        for number in range(2):
            values = np.where(np.isfinite(pair.values[number]), pair.values[number], np.nan)
            # the first curve is thicker, so that it shows below an equal one
            ax.plot(
                pair.seconds[number],
                values,
                color=CURVES[2 + number],
                linewidth=1.2 if number else 3.0,
                label=pair.names[number],
            )
        ax.set_title(pair.title, loc="left", fontsize=10)
        ax.set_ylabel("robustness")
        ax.legend(loc="best", fontsize=8, frameon=False)
        ax.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel("time from the first sample in s")
    return panels

"""Tuned specifications and differences in notebooks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from spatial_replay.compare.runs import LogDiff
from spatial_replay.compare.specifications import SpecDiff, SpecificationDiff
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.lazy import page_of
from spatial_replay.logs.output_file import replacing
from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import (
    INK,
    Html,
    element,
    new_panel,
    new_panels,
    picture,
    plain,
    quiet,
    signed_colours,
    table,
    verdict_mark,
)
from spatial_replay.palette import CURVES, NEGATIVE, NEUTRAL, POSITIVE
from spatial_replay.text import counted
from spatial_replay.tuning.tuned import Surface, Tuning

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_RUNS: Final = 50
"""The most runs in a table."""
_MOST_LINES: Final = 40
"""The most runs whose change of verdict is drawn as a line of its own."""
_MOST_MARGINS: Final = 10_000
"""Margins that a picture may take, unless its least resolution takes more."""


@html.register(Tuning)
def tuning_html(tuning: Tuning) -> Html:
    """Return the values found, or why there are none, and the runs, the closest first."""
    name = element("b", tuning.specification.filename)
    if tuning.conflict is not None:
        none = "no values fit" if tuning.conflict.is_proven else "found no values that fit"
        about = " ".join(
            f"{what.capitalize()}: {'; '.join(needs)}." for what, needs in tuning.conflict.sections
        )
        return element("div", name, f": {none} all runs. {about}")
    rows = [
        (each.name, str(each.value), str(each.written), f"{each.low} to {each.high}")
        for each in tuning.constants
    ]
    closest = sorted(tuning.runs, key=lambda run: run.margin)
    runs = [
        (run.name, "good" if run.is_good else "bad", verdict_mark(run.verdict), f"{run.robustness:.6g}")
        for run in closest[:_MOST_RUNS]
    ]
    left_out = len(closest) - len(runs)
    return element(
        "div",
        element(
            "div",
            name,
            f": margin {tuning.margin:.6g}{'' if tuning.is_widest else ', as far as was searched'}",
        ),
        table(["constant", "value", "as written", "every value that fits"], rows),
        table(["run", "is", "verdict", "robustness"], runs),
        quiet(f"… and {counted(left_out, 'run')} more") if left_out else Html(""),
    )


@plot.register(Tuning)
def draw_tuning(tuning: Tuning, *names: str, points: int | None = None, ax: Axes | None = None) -> Axes:
    """Draw the margins over one or two constants; without names over the first two.

    Args:
        points: how many values of each constant; without it as few runs allow, 25 to 60.

    Raises:
        UsageError: a constant that was not varied; matplotlib is not installed.
    """
    if points is None:
        points = int(np.clip(math.sqrt(_MOST_MARGINS / len(tuning.runs)), 25, 60))
    return draw_surface(tuning.surface(*names, points=points), ax)


@plot.register(Surface)
def draw_surface(surface: Surface, ax: Axes | None = None) -> Axes:
    """Draw where which runs have the right verdict.

    One constant gives a curve for each run. Two give the least margin as colours, and for each run a line
    where its verdict changes, dashed for bad runs. A circle marks the values found.

    Raises:
        UsageError: matplotlib is not installed.
    """
    ax = ax or new_panel((6.4, 4.4))
    (_draw_curves if len(surface.names) == 1 else _draw_colours)(surface, ax)
    ax.set_xlabel(_labelled(surface, 0))
    _name_runs(surface, ax)
    return ax


def write_surface(tuning: Tuning, output: Path) -> None:
    """Write the margins over the first two constants as a picture (.png, .svg), or as a page with the values.

    Raises:
        UsageError: matplotlib is not installed.
        OutputError: the file cannot be written.
    """
    ending = output.suffix.lower()
    data = picture(draw_tuning(tuning), "png" if ending == ".png" else "svg")
    if ending == ".html":
        drawing = data.decode("utf-8")
        head = '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Tuning</title></head>\n'
        body = f"<body style='font-family:system-ui,sans-serif'>{drawing[drawing.index('<svg') :]}\n"
        data = f"{head}{body}{tuning_html(tuning)}\n</body></html>\n".encode()
    with replacing(output) as stream:
        stream.write(data)


def _draw_curves(surface: Surface, ax: Axes) -> None:
    margins = _finite(surface.margins[:, 0])
    for (_, is_good), margin in zip(surface.runs, margins, strict=True):
        ax.plot(surface.x, margin, color=POSITIVE if is_good else NEGATIVE, linewidth=1, alpha=0.6)
    ax.plot(surface.x, margins.min(axis=0), color=INK, linewidth=2, label="least")
    ax.axhline(0.0, color=INK, linewidth=0.8, linestyle=":")
    if surface.found is not None:
        ax.axvline(surface.found[0], color=INK, linewidth=0.8)
    ax.set_ylabel("margin (robustness towards the right verdict)")
    ax.legend(loc="best", frameon=False)


def _draw_colours(surface: Surface, ax: Axes) -> None:
    least = _finite(surface.least)
    most = float(np.abs(least).max()) or 1.0
    # margins far below 0 would fade what fits, which is often little above
    most = min(most, 3 * float(least.max())) if least.max() > 0 else most
    mesh = ax.pcolormesh(
        surface.x,
        surface.y,
        least,
        cmap=signed_colours(),
        vmin=-most,
        vmax=most,
        alpha=0.6,
        shading="nearest",
    )
    extend = "min" if least.min() < -most else "neither"
    ax.figure.colorbar(mesh, ax=ax, label="least margin of all runs (robustness)", extend=extend)
    for (_, is_good), margins in list(zip(surface.runs, surface.margins, strict=True))[:_MOST_LINES]:
        if min(margins.shape) > 1 and margins.min() < 0.0 <= margins.max():
            ax.contour(
                surface.x,
                surface.y,
                _finite(margins),
                levels=[0.0],
                colors=[POSITIVE if is_good else NEGATIVE],
                linestyles="solid" if is_good else "dashed",
                linewidths=1,
            )
    if surface.found is not None:
        ax.plot(*surface.found, marker="o", markersize=7, color="white", markeredgecolor=INK)
    ax.set_ylabel(_labelled(surface, 1))


def _labelled(surface: Surface, axis: int) -> str:
    """Return the label of an axis: the constant, and in which unit it is; numbers are as in the file."""
    return plain(f"{surface.names[axis]} (s)" if surface.durations[axis] else surface.names[axis])


def _name_runs(surface: Surface, ax: Axes) -> None:
    good = sum(is_good for _, is_good in surface.runs)
    bad = len(surface.runs) - good
    runs = counted(good, "good run") + (f", {counted(bad, 'bad run')}" if bad else "")
    ax.set_title(plain(f"{runs}: margin over {' and '.join(surface.names)}"), loc="left", fontsize=10)


def _finite(margins: Floats) -> Floats:
    """Return margins with infinite ones in place by the largest finite one."""
    finite = np.abs(margins[np.isfinite(margins)])
    most = float(finite.max()) if len(finite) else 1.0
    clipped: Floats = np.clip(margins, -most, most)
    return clipped


_MOST_PANELS: Final = 8
_WIDTH, _HEIGHT = 8.0, 2.4
"""Size of a panel, in inches."""


class _Pair(NamedTuple):
    """Two curves, each with its name, over the same time axis."""

    title: str
    names: tuple[str, str]
    seconds: tuple[Floats, Floats]
    values: tuple[Floats, Floats]


@html.register(SpecDiff)
def spec_diff_html(diff: SpecDiff) -> str:
    """Return what changed of one spec, in sentences."""
    first_ns = diff.old.evidence.first_ns()
    return page_of([diff.title, *(f"  {sentence}" for sentence in diff.sentences(first_ns))])


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

"""A trace in notebooks: where its objects began, which way they went, and where they ended."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from spatial_replay.annotate.rings import outlines_of, rings_of
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.atoms.terms import footprint_from_outline
from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import Html, element, new_panel, plain, quiet, table
from spatial_replay.palette import CURVES, NEUTRAL
from spatial_replay.spec.formula import Specification
from spatial_replay.text import counted, time_text
from spatial_replay.trace.trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_ROWS: Final = 40
_MOST_POINTS: Final = 2_000
"""The most objects of a cell's table, and points of a trail."""

_MOST_LABELS: Final = 25
_NAME_SIZE: Final = 8.0
"""Of the names of objects, in points."""
_STEPS: Final = (0.0, 1.2, -1.2, 2.4, -2.4, 3.6, -3.6, 4.8, -4.8)
"""How far a name may be above its place, in multiples of its size."""


@html.register(Trace)
def trace_html(trace: Trace) -> Html:
    """Return how long a trace is, and in how many samples each object is."""
    counts = (trace.rows >= 0).sum(axis=0).tolist()
    rows = [(name, f"{count:,}") for name, count in zip(trace.names, counts, strict=True) if count]
    more = [quiet(f"… and {len(rows) - _MOST_ROWS:,} objects more")] if len(rows) > _MOST_ROWS else []
    return element("div", element("b", _title(trace)), table(("object", "samples"), rows[:_MOST_ROWS]), *more)


@plot.register(Trace)
def draw_trace(trace: Trace, ax: Axes | None = None, specification: Specification | None = None) -> Axes:
    """Draw the scene from above: each object's outline at its start (dashed) and end (filled), and its trail.

    Args:
        ax: axes to draw into; new ones without.
        specification: whose regions are drawn, too.

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
    shown = [column for column in range(len(trace.names)) if (trace.rows[:, column] >= 0).any()]
    for number, column in enumerate(shown):
        rows = trace.rows[:, column]
        rows = rows[rows >= 0]
        colour = CURVES[number % len(CURVES)]
        kept = rows[np.unique(np.linspace(0, len(rows) - 1, _MOST_POINTS).astype(np.int64))]
        ax.plot(*_centres(trace, kept).T, color=colour, linewidth=1.0)
        for ring in _rings(trace, rows[:1]):
            ax.fill(*ring.T, facecolor="none", edgecolor=colour, linestyle="--", linewidth=1.0)
        for ring in _rings(trace, rows[-1:]):
            ax.fill(*ring.T, facecolor=colour, edgecolor=colour, alpha=0.5)
        if len(shown) <= _MOST_LABELS:
            [(x, y)] = _centres(trace, rows[-1:]).tolist()
            ends.append((x, y, plain(trace.names[column])))
    _write_names(ax, ends)
    unit = plain(trace.units.get("", "footprint units"))
    ax.set_xlabel(f"x [{unit}]")
    ax.set_ylabel(f"y [{unit}]")
    ax.set_title(plain(_title(trace)), loc="left", fontsize=10)
    return ax


def _write_names(ax: Axes, ends: Sequence[tuple[float, float, str]]) -> None:
    """Write names at places (x, y, name), each above or below its place if another one is there already."""
    ax.apply_aspect()
    inches = ax.transData + ax.figure.dpi_scale_trans.inverted()
    taken: list[tuple[float, float, float]] = []
    for x, y, name in ends:
        across, up = (72.0 * inches.transform((x, y))).tolist()
        half = 0.3 * _NAME_SIZE * len(name)
        for step in _STEPS:
            is_free = all(
                abs(across - other) > half + other_half or abs(up + step * _NAME_SIZE - row) >= _NAME_SIZE
                for other, row, other_half in taken
            )
            if is_free:
                break
        taken.append((across, up + step * _NAME_SIZE, half))
        ax.annotate(
            name,
            (x, y),
            (0.0, step * _NAME_SIZE),
            textcoords="offset points",
            fontsize=_NAME_SIZE,
            ha="center",
            va="center",
        )


def _title(trace: Trace) -> str:
    if not len(trace):
        return "no samples"
    span = time_text(int(trace.times_ns[-1]), int(trace.times_ns[0]))
    return f"{counted(len(trace), 'sample')} over {span}"


def _rings(trace: Trace, rows: Integers) -> tuple[Floats, ...]:
    """Return the outlines of one observation."""
    return rings_of(trace.footprints.select(rows), 0.0).rings_of(0)


def _centres(trace: Trace, rows: Integers) -> Floats:
    """Return (R, 2) the middle of each observation's bounding box."""
    rings = rings_of(trace.footprints.select(rows), 0.0)
    begins = np.asarray(rings.start)[: len(rows)]
    low, high = (reduce.reduceat(rings.points, begins, axis=0) for reduce in (np.minimum, np.maximum))
    return np.asarray((low + high) / 2.0)

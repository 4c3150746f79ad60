"""Gradient maps in notebooks: drawn over the scene, and counted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from spatial_replay.figures import INK, new_panel, plain, signed_colours
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.inspection.rings import outlines_of
from spatial_replay.markup import Html, element, quiet, table
from spatial_replay.planning.maps import FREE, REASONS, GradientMap
from spatial_replay.planning.poses import moved_object
from spatial_replay.trace.sample import Sample
from spatial_replay.wording import counted

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from spatial_replay.planning.step import Target

_HATCHES: Final = ("", "////", "xxxx", "....", "oooo")
"""What covers blocked cells, by the number of the reason."""
_BLOCKED: Final = "#e4e4e4"
_HATCH: Final = "#9a9a9a"


def map_html(found: GradientMap) -> Html:
    """What a map is about, how good its best free cell is, and why how many cells are blocked."""
    grid = found.grid
    size = f"{grid.columns} x {grid.rows} cells of {grid.cell_size:g}"
    turned = f", {counted(len(found.turns), 'orientation')}" if len(found.turns) > 1 else ""
    best = found.best()
    words = "no free cell" if best == -math.inf else f"robustness {best:.4g} at the best free cell"
    counts = np.bincount(found.blocked.ravel(), minlength=len(REASONS)).tolist()
    rows = [(f"{count:,}", reason) for count, reason in zip(counts, REASONS, strict=True) if count]
    title = element("div", "gradient map of ", element("b", found.name), quiet(f" {size}{turned}"))
    return element("div", title, element("div", words), table(["cells", "which are"], rows))


def draw_map(
    found: GradientMap,
    ax: Axes | None = None,
    *,
    turn: int | None = None,
    sample: Sample | None = None,
    target: Target | None = None,
) -> Axes:
    """Draw a map: blue where the progress set would hold, vermillion where not, blocked cells hatched.

    Args:
        turn: which orientation, by its place among the map's; that of the target or the best free cell by
            default.
        sample: whose objects are drawn over it.
        target: where the object is to go; the way there is drawn too.

    Raises:
        UsageError: matplotlib is not installed.
    """
    ax = new_panel((6.4, 5.2)) if ax is None else ax
    image = draw_cells(found, ax, best_turn(found, target) if turn is None else turn, reach_of([found]))
    draw_objects(ax, sample, found.name)
    if target is not None:
        draw_target(ax, target, sample)
    ax.figure.colorbar(image, ax=ax, label="robustness of what is to hold")
    ax.set_title(plain(f"where {found.name} could go"), loc="left", fontsize=10)
    ax.set_xlabel("x in the unit of the log")
    ax.set_ylabel("y in the unit of the log")
    if keys := hatch_keys(ax, [found]):
        ax.legend(
            handles=keys, loc="upper left", bbox_to_anchor=(0.0, -0.14), ncols=2, frameon=False, fontsize=8.5
        )
    return ax


def best_turn(found: GradientMap, target: Target | None) -> int:
    """The orientation that the object is to have, or that of the best free cell, by its place."""
    if target is not None:
        return int(np.abs(found.turns - target.turn).argmin())
    best = np.where(found.blocked == FREE, found.robustness, -np.inf).max(axis=(1, 2))
    return int(best.argmax())


def reach_of(maps: Sequence[GradientMap]) -> float:
    """The greatest robustness in the free cells of some maps, whatever its sign: what colours reach up to."""
    values = np.abs(np.concatenate([found.values.ravel() for found in maps]))
    return float(values[np.isfinite(values)].max(initial=0.0)) or 1.0


def draw_cells(found: GradientMap, ax: Axes, turn: int, reach: float) -> AxesImage:
    """Draw the cells of one orientation.

    Args:
        reach: the robustness of the full colours.
    """
    grid = found.grid
    right, top = grid.xmin + grid.columns * grid.cell_size, grid.ymin + grid.rows * grid.cell_size
    ax.set_facecolor(_BLOCKED)
    image = ax.imshow(
        found.values[turn], cmap=signed_colours(), vmin=-reach, vmax=reach, origin="lower",
        extent=(grid.xmin, right, grid.ymin, top), interpolation="nearest",
    )  # fmt: skip
    for reason, hatch in enumerate(_HATCHES):
        cells = found.blocked[turn] == reason
        if hatch and cells.any() and min(cells.shape) > 1:
            x, y = (axis.reshape(grid.shape) for axis in grid.centres().T)
            hatched = ax.contourf(x, y, cells, levels=[0.5, 1.5], colors="none", hatches=[hatch])
            hatched.set(edgecolor=_HATCH, linewidth=0.0)
    return image


def draw_objects(ax: Axes, sample: Sample | None, name: str) -> None:
    """Draw the objects of a sample, the one that is to be moved in bolder lines."""
    for each, tracked in (sample.objects if sample is not None else {}).items():
        if isinstance(tracked, TrackedObject):
            _draw_footprint(ax, tracked.footprint, 2.0 if each == name else 1.0)
            x, y = np.concatenate(outlines_of(tracked.footprint)).max(axis=0).tolist()
            ax.annotate(
                plain(each, 24), (x, y), (2, 2), textcoords="offset points", fontsize=8.5, color=INK,
                annotation_clip=True,
            )  # fmt: skip


def draw_target(ax: Axes, target: Target, sample: Sample | None) -> None:
    """Draw where an object is to go, and the way there."""
    ax.plot(*zip(*target.waypoints, strict=True), color="white", linewidth=3.5, solid_capstyle="round")
    ax.plot(*zip(*target.waypoints, strict=True), color=INK, linewidth=1.5, solid_capstyle="round")
    ax.plot(target.x, target.y, "o", color="white", markeredgecolor=INK, markersize=6)
    tracked = None if sample is None else sample.objects.get(target.name)
    if isinstance(tracked, TrackedObject):
        there = moved_object(tracked, target.x, target.y, target.turn)
        _draw_footprint(ax, there.footprint, 1.5, "--")


def hatch_keys(ax: Axes, maps: Sequence[GradientMap]) -> list[Artist]:
    """What a legend says of the hatches that some maps have."""
    reasons = np.unique(np.concatenate([found.blocked.ravel() for found in maps])).tolist()
    return [
        ax.fill([], [], facecolor=_BLOCKED, edgecolor=_HATCH, hatch=_HATCHES[reason], label=REASONS[reason])[
            0
        ]
        for reason in reasons
        if reason != FREE
    ]


def _draw_footprint(ax: Axes, footprint: Footprint, width: float, style: str = "-") -> None:
    for ring in outlines_of(footprint):
        ax.fill(*ring.T, facecolor="none", edgecolor=INK, linewidth=width, linestyle=style)

"""Gradient maps and decisions of a planner in notebooks, as pages and as figures over the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from spatial_replay.annotate.scene.scene_template import outlines_of
from spatial_replay.geometry.footprint import Footprint, moved_object
from spatial_replay.lazy import page_of
from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import (
    INK,
    Html,
    element,
    new_panel,
    new_panels,
    plain,
    quiet,
    signed_colours,
    table,
)
from spatial_replay.planning.decision_log import decision_lines, decision_message
from spatial_replay.planning.decisions import Candidate, Consideration, Step
from spatial_replay.planning.maps import FREE, REASONS, GradientMap
from spatial_replay.planning.read import LoggedStep
from spatial_replay.text import counted
from spatial_replay.trace.trace import Sample

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from spatial_replay.planning.decisions import Target

_HATCHES: Final = ("", "////", "xxxx", "....", "oooo")
"""Hatches of blocked cells, by the number of the reason."""
_BLOCKED: Final = "#e4e4e4"
_HATCH: Final = "#9a9a9a"
_MOST_EDGES: Final = 4
_MOST_CANDIDATES: Final = 4
_PANEL: Final = 3.4
"""Side of a panel, in inches."""
_LINE: Final = 40
"""Characters in a line of a title."""


@html.register(GradientMap)
def map_html(gradient: GradientMap) -> Html:
    """Return the size of a map, its best robustness, and how many cells are blocked for each reason."""
    grid = gradient.grid
    size = f"{grid.columns} x {grid.rows} cells of {grid.cell_size:g}"
    turned = f", {counted(len(gradient.turns), 'orientation')}" if len(gradient.turns) > 1 else ""
    best = gradient.best()
    words = "no free cell" if best == -math.inf else f"robustness {best:.4g} at the best free cell"
    counts = np.bincount(gradient.blocked.ravel(), minlength=len(REASONS)).tolist()
    rows = [(f"{count:,}", reason) for count, reason in zip(counts, REASONS, strict=True) if count]
    title = element("div", "gradient map of ", element("b", gradient.name), quiet(f" {size}{turned}"))
    return element("div", title, element("div", words), table(["cells", "which are"], rows))


@plot.register(GradientMap)
def draw_map(
    gradient: GradientMap,
    ax: Axes | None = None,
    *,
    turn: int | None = None,
    sample: Sample | None = None,
    target: Target | None = None,
) -> Axes:
    """Draw a map: blue where the progress set would hold, vermillion where not, blocked cells hatched.

    Args:
        turn: index of the orientation; by default that of the target or of the best free cell.
        sample: the sample with objects to draw over the map.
        target: where the object is to go; its path is drawn too.

    Raises:
        UsageError: matplotlib is not installed.
    """
    ax = new_panel((6.4, 5.2)) if ax is None else ax
    turn = _best_turn(gradient, target) if turn is None else turn
    image = _draw_cells(gradient, ax, turn, _reach_of([gradient]))
    _draw_objects(ax, sample, gradient.name)
    if target is not None:
        _draw_target(ax, target, sample)
    ax.figure.colorbar(image, ax=ax, label="robustness of what is to hold")
    ax.set_title(plain(f"where {gradient.name} could go"), loc="left", fontsize=10)
    ax.set_xlabel("x in the unit of the log")
    ax.set_ylabel("y in the unit of the log")
    if keys := _hatch_keys(ax, [gradient]):
        place = (0.0, -0.14)
        ax.legend(handles=keys, loc="upper left", bbox_to_anchor=place, ncols=2, frameon=False, fontsize=8.5)
    return ax


def _best_turn(gradient: GradientMap, target: Target | None) -> int:
    """Return the index of the target's orientation, or of that of the best free cell."""
    if target is not None:
        return int(np.abs(gradient.turns - target.turn).argmin())
    best = np.where(gradient.blocked == FREE, gradient.robustness, -np.inf).max(axis=(1, 2))
    return int(best.argmax())


def _reach_of(maps: Sequence[GradientMap]) -> float:
    """Return the greatest absolute robustness in the free cells of some maps, the range of the colours."""
    values = np.abs(np.concatenate([gradient.values.ravel() for gradient in maps]))
    return float(values[np.isfinite(values)].max(initial=0.0)) or 1.0


def _draw_cells(gradient: GradientMap, ax: Axes, turn: int, reach: float) -> AxesImage:
    """Draw the cells of one orientation.

    Args:
        reach: the absolute robustness that gets the full colours.
    """
    grid = gradient.grid
    right, top = grid.xmin + grid.columns * grid.cell_size, grid.ymin + grid.rows * grid.cell_size
    ax.set_facecolor(_BLOCKED)
    image = ax.imshow(
        gradient.values[turn], cmap=signed_colours(), vmin=-reach, vmax=reach, origin="lower",
        extent=(grid.xmin, right, grid.ymin, top), interpolation="nearest",
    )  # fmt: skip
    for reason, hatch in enumerate(_HATCHES):
        cells = gradient.blocked[turn] == reason
        if hatch and cells.any() and min(cells.shape) > 1:
            x, y = (axis.reshape(grid.shape) for axis in grid.centres().T)
            hatched = ax.contourf(x, y, cells, levels=[0.5, 1.5], colors="none", hatches=[hatch])
            hatched.set(edgecolor=_HATCH, linewidth=0.0)
    return image


def _draw_objects(ax: Axes, sample: Sample | None, name: str) -> None:
    """Draw the objects of a sample, the one to be moved with bolder lines."""
    for each, tracked in (sample.objects if sample is not None else {}).items():
        _draw_footprint(ax, tracked.footprint, 2.0 if each == name else 1.0)
        x, y = np.concatenate(outlines_of(tracked.footprint)).max(axis=0).tolist()
        ax.annotate(
            plain(each, 24), (x, y), (2, 2), textcoords="offset points", fontsize=8.5, color=INK,
            annotation_clip=True,
        )  # fmt: skip


def _draw_target(ax: Axes, target: Target, sample: Sample | None) -> None:
    """Draw the target of an object and the path to it."""
    ax.plot(*zip(*target.waypoints, strict=True), color="white", linewidth=3.5, solid_capstyle="round")
    ax.plot(*zip(*target.waypoints, strict=True), color=INK, linewidth=1.5, solid_capstyle="round")
    ax.plot(target.x, target.y, "o", color="white", markeredgecolor=INK, markersize=6)
    tracked = None if sample is None else sample.objects.get(target.name)
    if tracked is not None:
        there = moved_object(tracked, target.x, target.y, target.turn)
        _draw_footprint(ax, there.footprint, 1.5, "--")


def _hatch_keys(ax: Axes, maps: Sequence[GradientMap]) -> list[Artist]:
    """Return the legend's entries for the hatches in some maps."""
    reasons = np.unique(np.concatenate([gradient.blocked.ravel() for gradient in maps])).tolist()
    style: dict[str, Any] = {"facecolor": _BLOCKED, "edgecolor": _HATCH}
    filled = (ax.fill([], [], hatch=_HATCHES[r], label=REASONS[r], **style) for r in reasons if r != FREE)
    return [entry for (entry,) in filled]


def _draw_footprint(ax: Axes, footprint: Footprint, width: float, style: str = "-") -> None:
    for ring in outlines_of(footprint):
        ax.fill(*ring.T, facecolor="none", edgecolor=INK, linewidth=width, linestyle=style)


@html.register(Step)
def step_html(step: Step) -> str:
    """Return the decision, with the edges and objects considered."""
    return page_of(decision_lines(decision_message(step)))


@plot.register(Step)
def draw_step(step: Step, sample: Sample | None = None) -> tuple[Axes, ...]:
    """Draw the maps of a step: a row for each edge considered, a column for each object.

    Args:
        sample: the sample of the decision; its objects are drawn over the maps.

    Returns:
        The axes of each map; none if the step has no map.

    Raises:
        UsageError: matplotlib is not installed.
    """
    edges = [edge for edge in step.considered if edge.candidates][-_MOST_EDGES:]
    if not edges:
        return ()
    columns = min(max(len(edge.candidates) for edge in edges), _MOST_CANDIDATES)
    size = (0.8 + _PANEL * columns, 0.5 + _PANEL * len(edges))
    panels = new_panels(len(edges), columns, size)
    places = [
        (row * columns + column, edge, candidate)
        for row, edge in enumerate(edges)
        for column, candidate in enumerate(edge.candidates[:columns])
    ]
    maps = [candidate.map for _, _, candidate in places]
    for panel in panels:
        panel.set_axis_off()
    drawn = tuple(panels[number] for number, _, _ in places)
    reach = _reach_of(maps)
    images = [
        _draw_candidate(panel, edge, candidate, sample, reach)
        for panel, (_, edge, candidate) in zip(drawn, places, strict=True)
    ]
    drawn[0].figure.colorbar(images[0], ax=panels, label="robustness of what is to hold", shrink=0.6)
    keys = _hatch_keys(drawn[0], maps)
    if keys:
        drawn[0].figure.legend(
            handles=keys, loc="outside lower left", ncols=len(keys), frameon=False, fontsize=8.5
        )
    return drawn


def _draw_candidate(
    ax: Axes, edge: Consideration, candidate: Candidate, sample: Sample | None, reach: float
) -> AxesImage:
    """Draw one map, titled with the choice made on it."""
    gradient = candidate.map
    ax.set_axis_on()
    image = _draw_cells(gradient, ax, _best_turn(gradient, candidate.target), reach)
    _draw_objects(ax, sample, candidate.name)
    if candidate.target is not None:
        _draw_target(ax, candidate.target, sample)
    question = plain(f"{_arrow(edge)}: move {candidate.name}?")
    ax.set_title(f"{question}\n{_choice_text(candidate)}", fontsize=9, loc="left")
    ax.tick_params(labelsize=7.5)
    return image


def _choice_text(candidate: Candidate) -> str:
    """Return whether a candidate is chosen, with its robustness, or why it was rejected."""
    if candidate.target is None:
        return "\n".join(wrap(plain(f"no: {candidate.rejected}", 90), _LINE))
    choice = "chosen" if candidate.is_chosen else "possible"
    return f"{choice}: robustness {candidate.target.robustness:.3g}"


def _arrow(edge: Consideration) -> str:
    return f"{edge.edge[0]} → {edge.edge[1]}"


@plot.register(LoggedStep)
def draw_logged_step(logged: LoggedStep) -> tuple[Axes, ...]:
    """Draw the maps of a logged step with the objects of its sample; see `draw_step`."""
    return draw_step(logged.step, logged.sample)

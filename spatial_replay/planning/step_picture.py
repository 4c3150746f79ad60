"""Decisions in notebooks: in words, and as the maps that they rest on."""

from __future__ import annotations

from textwrap import wrap
from typing import TYPE_CHECKING, Final

from spatial_replay.figures import new_panels, plain
from spatial_replay.markup import Html, element, quiet, table
from spatial_replay.planning.map_picture import (
    best_turn,
    draw_cells,
    draw_objects,
    draw_target,
    hatch_keys,
    reach_of,
)
from spatial_replay.planning.step import Candidate, Consideration, Step
from spatial_replay.trace.sample import Sample

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

_MOST_EDGES: Final = 4
_MOST_CANDIDATES: Final = 4
_PANEL: Final = 3.4
"""Its side, in inches."""
_LINE: Final = 40
"""Characters of a title's line."""


def step_html(step: Step) -> Html:
    """What was decided, on which edges and objects."""
    states = ", ".join(map(str, step.states))
    title = element("b", f"step {step.number}: {step.kind}")
    place = quiet(f" at {step.time_ns / 1e9:.3f} s in state {states}")
    shown = step.considered[-_MOST_EDGES:]
    left_out = len(step.considered) - len(shown)
    more = [element("div", quiet(f"{left_out} edges before were given up, too"))] if left_out else []
    return element(
        "div", element("div", title, place), element("div", step.reason), *more, *map(_edge, shown)
    )


def draw_step(step: Step, sample: Sample | None = None) -> tuple[Axes, ...]:
    """Draw the maps that a step rests on: a row for each edge looked into, a column for each object.

    Args:
        sample: what was seen then; its objects are drawn over the maps.

    Returns:
        The axes of each map; none where no map was needed.

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
    reach = reach_of(maps)
    images = [
        _draw_candidate(panel, edge, candidate, sample, reach)
        for panel, (_, edge, candidate) in zip(drawn, places, strict=True)
    ]
    drawn[0].figure.colorbar(images[0], ax=panels, label="robustness of what is to hold", shrink=0.6)
    keys = hatch_keys(drawn[0], maps)
    if keys:
        drawn[0].figure.legend(
            handles=keys, loc="outside lower left", ncols=len(keys), frameon=False, fontsize=8.5
        )
    return drawn


def _draw_candidate(
    ax: Axes, edge: Consideration, candidate: Candidate, sample: Sample | None, reach: float
) -> AxesImage:
    """Draw one map, and say what came of it."""
    found = candidate.map
    ax.set_axis_on()
    image = draw_cells(found, ax, best_turn(found, candidate.target), reach)
    draw_objects(ax, sample, candidate.name)
    if candidate.target is not None:
        draw_target(ax, candidate.target, sample)
    ax.set_title(
        plain(f"{_arrow(edge)}: move {candidate.name}?") + "\n" + _came_of(candidate), fontsize=9, loc="left"
    )
    ax.tick_params(labelsize=7.5)
    return image


def _came_of(candidate: Candidate) -> str:
    """Whether a candidate is the one to move, and how well that will do, or why not."""
    if candidate.target is None:
        return "\n".join(wrap(plain(f"no: {candidate.rejected}", 90), _LINE))
    choice = "chosen" if candidate.is_chosen else "possible"
    return f"{choice}: robustness {candidate.target.robustness:.3g}"


def _arrow(edge: Consideration) -> str:
    return f"{edge.edge[0]} → {edge.edge[1]}"


def _edge(edge: Consideration) -> Html:
    """An edge looked into, and a row for each object."""
    path = " → ".join(map(str, edge.path))
    rows = [
        (element("b", each.name), f"{each.map.best():.4g}", _came_of(each).replace("\n", " "), _way(each))
        for each in edge.candidates
    ]
    lines = [f"to reach: {edge.progress}"]
    if edge.constraints.texts:
        lines.append(f"never: {edge.constraints}")
    pruned = [element("div", element("b", "given up: "), edge.pruned.split(" (")[0])] if edge.pruned else []
    return element(
        "div",
        element("div", element("b", f"edge {_arrow(edge)}"), quiet(f" on the path {path}")),
        *(element("div", line) for line in lines),
        table(["object", "best", "choice", "way"], rows),
        *pruned,
        style="margin-top:0.5em",
    )


def _way(candidate: Candidate) -> str:
    target = candidate.target
    if target is None:
        return ""
    return f"to ({target.x:.4g}, {target.y:.4g}), {target.length:.3g} long"

"""Objects that could be moved to take an edge of the automaton, and which of them is.

Where on a map an object should go: the best cell, or the nearest good one that a free path leads to.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from spatial_replay.errors import TraceError
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.decisions import Candidate, Consideration, Guards, Target
from spatial_replay.planning.maps import (
    CONSTRAINED,
    FREE,
    OUT_OF_REACH,
    REASONS,
    GradientMap,
    PropositionMaps,
    centre_of,
    concerns,
    gradient_map,
    proposition_maps,
)
from spatial_replay.planning.paths import Path, shortest_path
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.workspace import Grid
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.sample import Sample

AVOIDED_CELLS = 2.0
"""How far from a place where an object could not be brought the next try stays, in cells."""


def find_target(
    found: GradientMap,
    tracked: TrackedObject,
    settings: Settings,
    failed: Collection[tuple[float, float]] = (),
) -> Target | str:
    """Where an object should go, or why nowhere.

    Args:
        found: the map of what is to hold.
        tracked: the object as it is.
        failed: places (x, y) where it could not be brought before.
    """
    good = (found.blocked == FREE) & (found.robustness >= settings.margin) & ~_near(failed, found.grid)
    if not good.any():
        return _why_nowhere(found, settings, bool(failed))
    if settings.skill == "place":
        return _best_cell(found, good, tracked, settings)
    return _nearest_cell(found, good, tracked, settings)


def _best_cell(found: GradientMap, good: np.ndarray, tracked: TrackedObject, settings: Settings) -> Target:
    roomy = good & (found.clearance >= settings.room)
    values = np.where(roomy if roomy.any() else good, found.robustness, -np.inf)
    turn, row, column = (int(index) for index in np.unravel_index(int(np.argmax(values)), values.shape))
    here, there = centre_of(tracked.footprint), found.grid.centre(row, column)
    return _target(found, tracked, (turn, row, column), (here, there))


def _nearest_cell(
    found: GradientMap, good: np.ndarray, tracked: TrackedObject, settings: Settings
) -> Target | str:
    here = centre_of(tracked.footprint)
    if not found.grid.contains(np.array(here)):
        return "it lies too far outside the workspace"
    cell = found.grid.cell(*here)
    way_in = _way_in(found, cell, settings)
    if way_in is None:
        return "no free path leads into reach"
    row, column = way_in.cells[-1].tolist()
    path = shortest_path(found.blocked[0] == FREE, (row, column), good[0])
    if path is None:
        return "no free path leads to a good place"
    cells = [(row, column) for row, column in (*way_in.cells.tolist(), *path.cells[1:].tolist())]
    # where it is in its own cell, it need not go to that cell's middle first
    first = 1 if cells[0] == cell and len(cells) > 1 else 0
    turns = [found.grid.centre(*each) for each in cells[first:]]
    return _target(found, tracked, (0, *cells[-1]), (here, *turns))


def _way_in(found: GradientMap, cell: tuple[int, int], settings: Settings) -> Path | None:
    """The way to the first free cell, over cells that are merely out of reach if it starts in such a one.

    From where a constraint would hold it goes over such cells, too, but not where anything stands; from
    where something stands, straight to the nearest cell where nothing does.
    """
    free = found.blocked[0] == FREE
    is_reached = settings.workspace.within_reach(found.grid)[cell]
    passable = free if is_reached else free | (found.blocked[0] == OUT_OF_REACH)
    if not passable[cell]:
        empty = found.clearance[0] > settings.workspace.clearance
        passable = passable | (empty & (found.blocked[0] == CONSTRAINED))
    return shortest_path(passable, cell if passable[cell] else _nearest(passable, cell), free)


def _nearest(cells: np.ndarray, cell: tuple[int, int]) -> tuple[int, int]:
    """Of some cells, the one nearest to another."""
    places = np.argwhere(cells)
    row, column = places[int(np.argmin(((places - np.array(cell)) ** 2).sum(axis=1)))].tolist()
    return row, column


def _target(
    found: GradientMap,
    tracked: TrackedObject,
    place: tuple[int, int, int],
    waypoints: tuple[tuple[float, float], ...],
) -> Target:
    x, y = waypoints[-1]
    turn = float(found.turns[place[0]])
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return Target(found.name, x, y, turn, yaw, waypoints, float(found.robustness[place]))


def _near(failed: Collection[tuple[float, float]], grid: Grid) -> np.ndarray:
    """(rows, columns): the cells near places that were tried in vain."""
    near = np.zeros(grid.shape, np.bool_)
    centres = grid.centres()
    for place in failed:
        away = np.hypot(*(centres - np.array(place)).T)
        near |= (away <= AVOIDED_CELLS * grid.cell_size).reshape(grid.shape)
    return near


def _why_nowhere(found: GradientMap, settings: Settings, has_failed: bool) -> str:
    enough = found.robustness >= settings.margin
    if not enough.any():
        best = float(found.robustness.max())
        return f"nowhere would it hold: {best:.4g} at best, {settings.margin:.4g} needed"
    where = found.blocked[enough]
    counts = np.bincount(where, minlength=len(REASONS))
    if counts[FREE] and has_failed:
        return "it was tried wherever it would hold"
    told = [
        f"{count} cells: {reason}"
        for count, reason in zip(counts[1:].tolist(), REASONS[1:], strict=True)
        if count
    ]
    return f"blocked wherever it would hold: {', '.join(told)}"


class Movables:
    """The objects of one sample that can be moved; what is measured of one serves every edge."""

    def __init__(
        self,
        propositions: Sequence[Formula],
        regions: Mapping[str, Outline],
        sample: Sample,
        settings: Settings,
    ) -> None:
        self._propositions, self._regions = propositions, regions
        self._sample, self._settings = sample, settings
        self._maps: dict[str, PropositionMaps] = {}

    def names_for(self, progress: Guards) -> list[str]:
        """The objects that a progress set is about, in the order of the settings."""
        about = {number for cube in progress.cubes for number, _ in cube}
        movable, seen = self._settings.movable, self._sample.objects
        return [
            name
            for name in (sorted(seen) if movable is None else movable)
            if name in seen and any(concerns(self._propositions[number], name) for number in about)
        ]

    def candidate(
        self, name: str, consideration: Consideration, failed: Collection[tuple[float, float]] = ()
    ) -> Candidate:
        """An object with its map for an edge, and where it should go or why it cannot.

        Args:
            failed: places (x, y) where it could not be brought before.

        Raises:
            TraceError: the sample says too little about it.
        """
        tracked = self._sample.objects[name]
        if not isinstance(tracked, TrackedObject):
            raise TraceError(f"object {name!r} is {tracked!r}; give a TrackedObject")
        found = gradient_map(
            self._maps_of(name, tracked),
            consideration.progress.cubes,
            consideration.constraints.cubes,
            self._settings.workspace,
            self._settings.constraint_margin,
        )
        target = find_target(found, tracked, self._settings, failed)
        if isinstance(target, str):
            return Candidate(name, found, None, target)
        return Candidate(name, found, target)

    def _maps_of(self, name: str, tracked: TrackedObject) -> PropositionMaps:
        if name not in self._maps:
            workspace = self._settings.workspace
            pushes = self._settings.skill == "push"
            # what is pushed goes over all cells from where it lies
            grid = workspace.grid.reaching(*centre_of(tracked.footprint)) if pushes else workspace.grid
            self._maps[name] = proposition_maps(
                self._propositions, self._regions, self._sample, name, workspace, grid
            )
        return self._maps[name]


def with_choice(
    consideration: Consideration, candidates: Sequence[Candidate], settings: Settings
) -> Consideration:
    """An edge with its candidates, the best of them chosen; given up, with the reasons, if none can do it.

    The best one has the shortest way if it is pushed, the greatest robustness if it is placed; of equals, the
    first.
    """
    costs = {
        number: each.target.length if settings.skill == "push" else -each.target.robustness
        for number, each in enumerate(candidates)
        if each.target is not None
    }
    if not costs:
        reasons = "; ".join(f"{each.name}: {each.rejected}" for each in candidates)
        reason = (
            f"no object can do it ({reasons})" if reasons else "no object that can be moved matters to it"
        )
        return replace(consideration, candidates=tuple(candidates), pruned=reason)
    chosen = min(costs, key=lambda number: costs[number])
    marked = (replace(each, is_chosen=number == chosen) for number, each in enumerate(candidates))
    return replace(consideration, candidates=tuple(marked))

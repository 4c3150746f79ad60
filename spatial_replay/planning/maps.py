"""Gradient maps (Def. 19): robustness of guards with one object at every cell of a grid.

The positions of the grid become the samples of traces in which only that object moves . So the
kernels that evaluate a log evaluate a map, and a cell has the number that a log's sample would.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.cores import over_cores
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.geometry.kernels import measure_rows
from spatial_replay.geometry.measure import MeasureRequest, Operand, Remeasured
from spatial_replay.geometry.poses import centre_of, fill_placed, with_poses
from spatial_replay.lazy import Displayed
from spatial_replay.monitor.atoms.measurements import MovedLeaves, leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.planning.workspace import Grid, Workspace, refuse_faults
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Atom,
    Formula,
    Group,
    Outline,
    Quantified,
    SignedDistance,
    Term,
    TrackedName,
)
from spatial_replay.spec.walks import base_of, iter_expressions, iter_formulas, looks_back, terms_of
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

Cube: TypeAlias = tuple[tuple[int, bool], ...]
"""A conjunction of literals: number of a proposition, and whether it has to hold. The empty one is true."""

Cubes: TypeAlias = tuple[Cube, ...]
"""A disjunction of cubes. The empty one is false."""

FREE: Final = 0
CONSTRAINED: Final = 1
OCCUPIED: Final = 2
OUT_OF_REACH: Final = 3
UNKNOWN: Final = 4
REASONS: Final = ("free", "a constraint would hold", "an obstacle is there", "out of reach", "unknown")
"""Why a cell is blocked, by its number in `GradientMap.blocked`."""

_TILE: Final = 2048
"""So many poses at most are measured together: what that takes stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class GradientMap(Displayed):
    """The robustness of a progress set with an object at each cell of a grid (Def. 19).

    Attributes:
        name: of the object.
        grid: the cells; larger than the workspace's if an object to be pushed lies outside.
        robustness: (A, rows, columns), in the unit of the relations; also at blocked cells.
        blocked: (A, rows, columns) uint8, `FREE` or why the object must not be there (see `REASONS`).
        clearance: (A, rows, columns), signed distance to the nearest obstacle; +inf without obstacles.
        turns: (A,) angles in radians by which the object is turned.
        made_of: what it was computed from, for `map_layers`.
    """

    name: str
    grid: Grid
    robustness: Floats
    blocked: NDArray[np.uint8]
    clearance: Floats
    turns: Floats
    made_of: MapParts = field(repr=False)

    @property
    def values(self) -> Floats:
        """(A, rows, columns): the robustness, NaN at blocked cells."""
        return np.where(self.blocked == FREE, self.robustness, np.nan)

    def best(self) -> float:
        """Return the greatest robustness at a free cell; -inf without one."""
        free = self.blocked == FREE
        return float(self.robustness[free].max()) if free.any() else -np.inf

    def cell_of(self, x: float, y: float, turn: float) -> tuple[int, int, int]:
        """Return the turn, row and column of a pose."""
        return (int(np.argmin(np.abs(self.turns - turn))), *self.grid.cell(x, y))

    def __repr__(self) -> str:
        cells = f"{self.grid.columns} x {self.grid.rows}"
        return f"<GradientMap of {self.name}: {cells} cells, {self.best():.4g} at best>"


def gradient_map(
    maps: PropositionMaps,
    progress: Cubes,
    constraints: Cubes,
    workspace: Workspace,
    margin: float = 0.0,
    after: PropositionMaps | None = None,
) -> GradientMap:
    """Return the map of a progress set, blocked where the constraint set would hold.

    Args:
        progress: one of these cubes has to hold.
        constraints: the robustness of each of these has to be less than -`margin`; unknown values count as
            holding.
        margin: in the unit of the relations, at least 0.
        after: the maps when other objects have been moved, too, for the robustness; cells are blocked as now.
    """
    shape = maps.clearance.shape
    then = maps if after is None else after
    robustness = _greatest(then.lower, then.upper, progress, shape)
    danger = danger_of(maps, constraints)
    blocked = np.zeros(shape, np.uint8)
    # later assignments win: a cell is reported as constrained even if it is also occupied or out of reach
    blocked[robustness == -np.inf] = UNKNOWN
    blocked[~np.broadcast_to(workspace.within_reach(maps.grid), shape)] = OUT_OF_REACH
    blocked[maps.clearance <= workspace.clearance] = OCCUPIED
    blocked[danger >= -margin] = CONSTRAINED
    parts = MapParts(maps, then, progress, constraints)
    return GradientMap(maps.name, maps.grid, robustness, blocked, maps.clearance, maps.turns, parts)


def danger_of(maps: PropositionMaps, constraints: Cubes) -> Floats:
    """Return (A, rows, columns): the greatest robustness that a constraint may have in each cell."""
    return _greatest(maps.upper, maps.lower, constraints, maps.clearance.shape)


def _greatest(positive: Floats, negative: Floats, cubes: Cubes, shape: tuple[int, ...]) -> Floats:
    """Return the greatest robustness of a cube (see `cube_robustness`); -inf without cubes."""
    if not cubes:
        return np.full(shape, -np.inf)
    first, *others = cubes
    greatest = cube_robustness(positive, negative, first, shape)
    for cube in others:
        np.maximum(greatest, cube_robustness(positive, negative, cube, shape), out=greatest)
    return greatest


def cube_robustness(positive: Floats, negative: Floats, cube: Cube, shape: tuple[int, ...]) -> Floats:
    """Return the robustness of a cube: the minimum over its literals.

    Args:
        positive, negative: bounds of propositions, for those that have to hold, and that must not.
    """
    if not cube:
        return np.full(shape, np.inf)
    (number, wanted), *others = cube
    least: Floats = positive[number].copy() if wanted else -negative[number]
    for number, wanted in others:
        np.minimum(least, positive[number] if wanted else -negative[number], out=least)
    return least


@dataclass(frozen=True, eq=False)
class PropositionMaps:
    """The robustness of P propositions with one object at every cell of a grid, in A orientations.

    Attributes:
        name: of the object.
        grid: the cells.
        lower, upper: (P, A, rows, columns), bounds of the robustness; -inf and +inf if it is unknown.
        clearance: (A, rows, columns), signed distance to the nearest obstacle; +inf without obstacles.
        distances: (O, A, rows, columns), that to each of `obstacles`.
        turns: (A,) angles in radians by which the object is turned.
        obstacles: names of what may be in the way; the last one, "", stands for those of the workspace.
        about: what was measured.
    """

    name: str
    grid: Grid
    lower: Floats
    upper: Floats
    clearance: Floats
    distances: Floats
    turns: Floats
    obstacles: tuple[str, ...]
    about: MapSubject = field(repr=False)

    def room(self, others: Collection[str] | None) -> Floats:
        """Return (A, rows, columns): the distance to the nearest of some objects; of all for None."""
        kept = [others is None or name in others for name in self.obstacles]
        return np.asarray(self.distances[kept].min(axis=0, initial=np.inf))


class MapSubject(NamedTuple):
    """What maps were measured of: propositions with their regions, and the sample whose object moves."""

    propositions: tuple[Formula, ...]
    regions: Mapping[str, Outline]
    sample: Sample


class MapParts(NamedTuple):
    """What a gradient map was computed from: maps as now and after other motions, progress, constraints."""

    now: PropositionMaps
    then: PropositionMaps
    progress: Cubes
    constraints: Cubes


def proposition_maps(
    propositions: Sequence[Formula],
    regions: Mapping[str, Outline],
    sample: Sample,
    name: str,
    workspace: Workspace,
    grid: Grid | None = None,
) -> PropositionMaps:
    """Return the robustness of propositions with the object `name` of a sample at every cell of a grid.

    Args:
        grid: cells to use instead of the workspace's.

    Raises:
        UsageError: the sample does not have the object, or a proposition looks at earlier samples.
    """
    refuse_delays(propositions)
    tracked = sample.objects.get(name)
    if not isinstance(tracked, TrackedObject):
        present = ", ".join(sample.objects) or "none"
        raise UsageError(f"there is no object {name!r} to move; the sample has: {present}")
    cells = workspace.grid if grid is None else grid
    turns, centres = workspace.turns(tracked.yaw), cells.centres()
    moves = np.array([concerns(each, name) for each in propositions], np.bool_)
    concerned = [each for each, is_moving in zip(propositions, moves, strict=True) if is_moving]
    others = [each for each, is_moving in zip(propositions, moves, strict=True) if not is_moving]
    obstacles = [each for each in sorted(sample.objects) if each not in (name, *workspace.supports)]
    formulas = [*concerned, *_obstacle_distances(propositions, name, obstacles)]
    here = Trace.from_samples([sample])
    lower, upper = (np.empty((len(propositions), len(turns), len(centres))) for _ in range(2))
    distances = np.empty((len(obstacles) + 1, len(turns), len(centres)))
    # propositions that do not depend on the object have the same value in every cell
    fixed = leaf_values(TraceScene(here, regions), others, {})[:2]
    tiles = list(_tiles(len(turns), len(centres)))
    differ = [False] * len(tiles)

    def poses_of(tile: tuple[slice, slice]) -> _Poses:
        some = centres[tile[1]], turns[tile[0]]
        return _Poses(here, tracked, name, formulas, regions, workspace.obstacles, *some)

    first = poses_of(tiles[0])

    def measure_tiles(begin: int, end: int) -> None:
        poses = first if begin == 0 else first.another()
        for number in range(begin, end):
            turn, cell = tiles[number]
            if not poses.suits(turns[turn]):
                poses = poses_of(tiles[number])
            found, distances[-1, turn, cell] = poses.measure(centres[cell], turns[turn])
            lower[moves, turn, cell] = found[0, : len(concerned)]
            distances[:-1, turn, cell] = found[0, len(concerned) :]
            differ[number] = len(found) > 1
            if differ[number]:
                upper[moves, turn, cell] = found[1, : len(concerned)]

    over_cores(measure_rows, measure_tiles, len(tiles), 1)
    lower[~moves] = fixed[0][..., None]
    # where all is known, as in most maps, there is one array
    if any(differ) or len(fixed) > 1:
        for (turn, cell), is_set in zip(tiles, differ, strict=True):
            if not is_set:
                upper[:, turn, cell] = lower[:, turn, cell]
        upper[~moves] = fixed[-1][..., None]
    else:
        upper = lower
    shape = (-1, len(turns), *cells.shape)
    distances = distances.reshape(shape)
    about = MapSubject(tuple(propositions), regions, sample)
    ways = distances.min(axis=0), distances, turns, (*obstacles, "")
    return PropositionMaps(name, cells, lower.reshape(shape), upper.reshape(shape), *ways, about)


def _tiles(turns: int, cells: int) -> Iterator[tuple[slice, slice]]:
    """Yield the turns and the cells of each tile: all tiles are of one size, so some may overlap."""
    most = min(max(_TILE // cells, 1), turns)
    size = math.ceil(cells / math.ceil(cells / _TILE))
    for turn in range(0, turns, most):
        first = min(turn, turns - most)
        for cell in range(0, cells, size):
            begin = min(cell, cells - size)
            yield slice(first, first + most), slice(begin, begin + size)


def _obstacle_distances(propositions: Sequence[Formula], name: str, obstacles: Sequence[str]) -> list[Atom]:
    """Return atoms for the distance from the object to each other object in its way.

    A distance is at most 0 exactly if the object's centre lies in the Minkowski sum of the other object and
    the mirrored one, the usual configuration-space obstacle.
    """
    atoms_read = (each for one in propositions for each in iter_formulas(one) if isinstance(each, Atom))
    measured = {part for each in atoms_read for part in iter_expressions(each.expression)}
    atoms = []
    for other in obstacles:
        one, two = TrackedName(name), TrackedName(other)
        # in the order of a proposition's own measurement, so that the kernel computes it only once
        swapped = SignedDistance(two, one)
        atoms.append(Atom("", "dist", swapped if swapped in measured else SignedDistance(one, two)))
    return atoms


class _Poses:
    """What is measured with one object of a sample in as many poses at a time, everything else as it is.

    Each thread needs its own, since it measures in the same room each time.

    Args:
        here: a trace of the one sample.
        tracked, name: the object.
        formulas: without temporal operators, with `regions`.
        obstacles: those that are no objects of the sample.
        centres, turns: (M, 2) and (A,), poses of which all others have the number.
    """

    def __init__(
        self,
        here: Trace,
        tracked: TrackedObject,
        name: str,
        formulas: Sequence[Formula],
        regions: Mapping[str, Outline],
        obstacles: Sequence[Footprint],
        centres: Floats,
        turns: Floats,
    ) -> None:
        everywhere = _trace_over_poses(here, tracked, name, centres, turns)
        scene = TraceScene(everywhere, regions)
        self._leaves, self._turns = MovedLeaves(scene, formulas, {}), turns
        batch = scene.batch
        self._static = None
        if obstacles:
            # after all others, so that these stay in their places
            rows = np.tile(np.arange(len(obstacles), dtype=np.int64) + len(batch), (len(everywhere), 1))
            batch = FootprintBatch.concatenate([batch, FootprintBatch.from_footprints(obstacles)])
            operands = (Operand(everywhere.rows[:, [everywhere.names.index(name)]]), Operand(rows))
            self._static = Remeasured(batch, operands, [MeasureRequest("signed_distance", 0, 1)])
        self._vertices = batch.vertices.copy()
        self._corners = np.concatenate([part.vertices for part in tracked.footprint.parts])
        self._centre = np.array(centre_of(tracked.footprint))
        self._first = len(here.footprints.vertices)
        self._shape = (len(turns), len(centres))

    def another(self) -> _Poses:
        """Return the same with room of its own."""
        made = copy(self)
        made._vertices, made._leaves = self._vertices.copy(), self._leaves.another()
        made._static = self._static and self._static.another()
        return made

    def suits(self, turns: Floats) -> bool:
        """Return whether these poses can be turned by the given angles (A,), too."""
        return not self._leaves.compares_turns or np.array_equal(turns, self._turns)

    def measure(self, centres: Floats, turns: Floats) -> tuple[Floats, Floats]:
        """Return the lower and the upper end of K formulas, and the distance to the nearest obstacle.

        Args:
            centres, turns: (M, 2) and (A,).

        Returns:
            (C, K, A, M), with C = 1 where both ends are equal everywhere, and (A, M), +inf without obstacles.
        """
        places = self._vertices[self._first : self._first + math.prod(self._shape) * len(self._corners)]
        placed = places.reshape(*self._shape, *self._corners.shape)
        for number, turn in enumerate(turns.tolist()):
            fill_placed(self._corners, self._centre, centres, turn, placed[number])
        found = self._leaves.values(self._vertices)[:2]
        static = np.full(self._shape, np.inf)
        if self._static is not None:
            static = self._static.measure(self._vertices)[0].reshape(self._shape)
        return found.reshape(*found.shape[:2], *self._shape), static


def _trace_over_poses(
    here: Trace, tracked: TrackedObject, name: str, centres: Floats, turns: Floats
) -> Trace:
    """Return a trace with the sample of `here` for each turn and position, the object moved there."""
    footprints = with_poses(here.footprints, tracked, centres, turns)
    count, column = len(footprints) - len(here.footprints), here.names.index(name)
    own = np.full(count, here.rows[0, column])
    rows = np.repeat(here.rows, count, axis=0)
    rows[:, column] = len(here.footprints) + np.arange(count)
    return Trace(
        times_ns=np.arange(count, dtype=np.int64),
        names=here.names,
        rows=rows,
        footprints=footprints,
        yaw=np.concatenate((here.yaw, here.yaw[own] + np.repeat(turns, count // len(turns)))),
        uncertainty=np.concatenate((here.uncertainty, here.uncertainty[own])),
        class_code=np.concatenate((here.class_code, here.class_code[own])),
        classes=here.classes,
        signals={signal: np.repeat(values, count) for signal, values in here.signals.items()},
    )


def concerns(formula: Formula, name: str) -> bool:
    """Return whether a formula depends on the pose of an object."""
    return any(
        isinstance(each, Quantified)
        or (isinstance(each, Atom) and any(_is_about(term, name) for term in terms_of(each.expression)))
        for each in iter_formulas(formula)
    )


def _is_about(term: Term, name: str) -> bool:
    base = base_of(term)
    if isinstance(base, Group):
        return base.members is None or name in base.members
    return isinstance(base, TrackedName) and base.name == name


def refuse_delays(propositions: Sequence[Formula]) -> None:
    """Check that propositions depend on one sample each.

    Raises:
        UsageError: one looks at earlier samples, which moving an object now does not change.
    """
    for proposition in propositions:
        for each in iter_formulas(proposition):
            terms = list(terms_of(each.expression)) if isinstance(each, Atom) else []
            terms += [each.group] if isinstance(each, Quantified) else []
            if any(map(looks_back, terms)):
                raise UsageError(
                    f"{format_formula(each)} looks at earlier samples, so there is no map of it; plan "
                    "without it, and evaluate it with replay"
                )


def refuse_unknown(names: Sequence[str], sample: Sample, propositions: Sequence[Formula]) -> None:
    """Check that objects are in a sample, or in a proposition, since these may appear later.

    Raises:
        UsageError: with every name that is in neither.
    """
    faults = []
    for name in names:
        if name not in sample.objects and not any(concerns(each, name) for each in propositions):
            hint = nearest_hint(name, sample.objects)
            faults.append(
                f"{name!r} is movable, but neither the specification nor the first sample has it; "
                f"{hint or 'the sample has: ' + (', '.join(sample.objects) or 'none')}"
            )
    refuse_faults(faults)

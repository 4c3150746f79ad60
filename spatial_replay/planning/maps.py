"""Gradient maps (Def. 19): robustness of guards with one object at every cell of a grid.

The positions of the grid become the samples of a trace in which only that object moves. So the kernels that
evaluate a log evaluate a map, all relations in one call, and a cell has the number that a log's sample would.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, starts_from_counts
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.lazy import Displayed
from spatial_replay.monitor.atoms.measurements import leaf_values
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

_FLAT: Final = 1e-12
"""Twice the area over the squared perimeter; a polygon with less has no centroid of its area."""


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
    robustness = np.full(shape, -np.inf)
    for cube in progress:
        np.maximum(robustness, cube_robustness(then.lower, then.upper, cube, shape), out=robustness)
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
    danger = np.full(maps.clearance.shape, -np.inf)
    for cube in constraints:
        np.maximum(danger, cube_robustness(maps.upper, maps.lower, cube, danger.shape), out=danger)
    return danger


def cube_robustness(positive: Floats, negative: Floats, cube: Cube, shape: tuple[int, ...]) -> Floats:
    """Return the robustness of a cube: the minimum over its literals.

    Args:
        positive, negative: bounds of propositions, for those that have to hold, and that must not.
    """
    least = np.full(shape, np.inf)
    for number, wanted in cube:
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
    turns = workspace.turns(tracked.yaw)
    here = Trace.from_samples([sample])
    everywhere = _trace_over_cells(here, tracked, name, cells, turns)
    moves = np.array([concerns(each, name) for each in propositions], np.bool_)
    concerned = [each for each, is_moving in zip(propositions, moves, strict=True) if is_moving]
    others = [each for each, is_moving in zip(propositions, moves, strict=True) if not is_moving]
    obstacles = [each for each in sorted(sample.objects) if each not in (name, *workspace.supports)]
    distances = _obstacle_distances(propositions, name, obstacles)
    shape = (len(turns), *cells.shape)
    over_cells = _intervals(everywhere, [*concerned, *distances], regions)
    # propositions that do not depend on the object have the same value in every cell
    fixed = _intervals(here, others, regions)
    ends = []
    for moving, still in zip(over_cells, fixed, strict=True):
        values = np.empty((len(propositions), len(everywhere)))
        values[moves], values[~moves] = moving[: len(concerned)], still
        ends.append(values.reshape(len(propositions), *shape))
    static = np.full(len(everywhere), np.inf)
    if workspace.obstacles:
        static = _to_static(everywhere, name, workspace)
    clearances = np.vstack((over_cells[0][len(concerned) :], static))
    clearance = clearances.min(axis=0).reshape(shape)
    lower, upper = ends
    about = MapSubject(tuple(propositions), regions, sample)
    ways = clearances.reshape(-1, *shape), turns, (*obstacles, "")
    return PropositionMaps(name, cells, lower, upper, clearance, *ways, about)


def _intervals(
    trace: Trace, formulas: Sequence[Formula], regions: Mapping[str, Outline]
) -> tuple[Floats, Floats]:
    """Return the lower and the upper robustness, (K, T) each, of formulas without temporal operators."""
    leaves = leaf_values(TraceScene(trace, regions), formulas, {})
    return leaves[0], leaves[min(1, len(leaves) - 1)]


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


def _to_static(trace: Trace, name: str, workspace: Workspace) -> Floats:
    """Return (T,) distances from the object to the workspace's obstacles."""
    own = trace.rows[:, [trace.names.index(name)]]
    static = np.arange(len(workspace.obstacles), dtype=np.int64) + len(trace.footprints)
    obstacles = FootprintBatch.from_footprints(workspace.obstacles)
    batch = FootprintBatch.concatenate([trace.footprints, obstacles])
    operands = (Operand(own), Operand(np.tile(static, (len(trace), 1))))
    return np.asarray(measure(batch, operands, [MeasureRequest("signed_distance", 0, 1)])[0])


def _trace_over_cells(here: Trace, tracked: TrackedObject, name: str, grid: Grid, turns: Floats) -> Trace:
    """Return a trace with the sample of `here` for each turn, row and column, the object moved there."""
    footprints = _with_moved(here.footprints, tracked, grid.centres(), turns)
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


def centre_of(footprint: Footprint) -> tuple[float, float]:
    """Return the centre (x, y) of an object: the centroid of its parts' areas.

    A part is weighted by its area, and has the centroid of its polygon before rounding, or the mean of the
    vertices if that polygon has no area. Areas of overlap count twice.
    """
    weights, centres = zip(*map(_weight_and_centre, footprint.parts), strict=True)
    if sum(weights) <= 0.0:
        weights = (1.0,) * len(centres)
    total = sum(weights)
    x, y = (sum(w * each[axis] for w, each in zip(weights, centres, strict=True)) / total for axis in (0, 1))
    return x, y


def radius_of(tracked: TrackedObject) -> float:
    """Return the distance from an object's centre to its farthest point."""
    centre = np.array(centre_of(tracked.footprint))
    return max(float(np.hypot(*(p.vertices - centre).T).max()) + p.radius for p in tracked.footprint.parts)


def moved_object(tracked: TrackedObject, x: float, y: float, turn: float = 0.0) -> TrackedObject:
    """Return the object with its centre at (x, y), turned by an angle in radians; heights stay."""
    footprint = tracked.footprint
    centre = np.array(centre_of(footprint))
    place = np.array([[x, y]])
    parts = []
    for part in footprint.parts:
        corners = part.vertices
        placed = np.empty((1, *corners.shape))
        _place(corners, centre, place, turn, placed)
        parts.append(ConvexPart(placed[0], part.radius))
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return replace(tracked, footprint=Footprint(tuple(parts)), yaw=yaw)


def _with_moved(
    batch: FootprintBatch, tracked: TrackedObject, positions: Floats, turns: Floats
) -> FootprintBatch:
    """Return a batch, and A * M more rows: the object turned by each angle (A,), at each position (M, 2)."""
    parts = tracked.footprint.parts
    centre = np.array(centre_of(tracked.footprint))
    count = len(positions) * len(turns)
    outlines = [part.vertices for part in parts]
    corners = np.concatenate(outlines)
    sizes = np.array([len(outline) for outline in outlines], np.int64)
    bottom, top = tracked.height or (math.nan, math.nan)
    part_start = batch.part_start[-1] + np.arange(count + 1, dtype=np.int64) * len(sizes)
    vertex_start = batch.vertex_start[-1] + starts_from_counts(np.tile(sizes, count))
    # of many cells, they are written where they stay
    vertices = np.empty((len(batch.vertices) + count * len(corners), 2))
    vertices[: len(batch.vertices)] = batch.vertices
    placed = vertices[len(batch.vertices) :].reshape(len(turns), len(positions), len(corners), 2)
    for number, turn in enumerate(turns.tolist()):
        _place(corners, centre, positions, turn, placed[number])
    return FootprintBatch.trusted(
        part_start=np.concatenate((batch.part_start[:-1], part_start)),
        vertex_start=np.concatenate((batch.vertex_start[:-1], vertex_start)),
        vertices=vertices,
        radius=np.concatenate((batch.radius, np.tile([part.radius for part in parts], count))),
        bottom=np.concatenate((batch.bottom, np.full(count, bottom))),
        top=np.concatenate((batch.top, np.full(count, top))),
    )


def _place(vertices: Floats, centre: Floats, positions: Floats, turn: float, placed: Floats) -> None:
    """Fill `placed` (M, n, 2): vertices (n, 2) turned around the centre, moved to each position (M, 2)."""
    local = vertices - centre
    if turn != 0.0:
        cosine, sine = math.cos(turn), math.sin(turn)
        x, y = local[:, 0], local[:, 1]
        local = np.stack((x * cosine - y * sine, x * sine + y * cosine), axis=1)
    # both coordinates in one go, as complex numbers, and along the many positions, not along the few vertices
    at = np.ascontiguousarray(positions, np.float64).view(np.complex128)[..., 0]
    filled = placed.view(np.complex128)[..., 0]
    for number, (x, y) in enumerate(local.tolist()):
        np.add(at, complex(x, y), out=filled[:, number])


def _weight_and_centre(part: ConvexPart) -> tuple[float, tuple[float, float]]:
    """Return a part's area, and the centroid of its polygon before rounding."""
    # plain numbers are quicker than arrays for the few vertices of a part
    corners = part.vertices.tolist()
    (x0, y0), *_ = corners
    doubled = sum_x = sum_y = length = 0.0
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        cross = (ax - x0) * (by - y0) - (bx - x0) * (ay - y0)
        doubled += cross
        sum_x += cross * (ax + bx - 2.0 * x0)
        sum_y += cross * (ay + by - 2.0 * y0)
        length += math.hypot(bx - ax, by - ay)
    # a rounded polygon is the polygon, a strip along its sides, and sectors at its corners that make a disc
    area = doubled / 2 + length * part.radius + math.pi * part.radius**2
    if len(corners) > 2 and doubled > _FLAT * length**2:
        return area, (x0 + sum_x / (3.0 * doubled), y0 + sum_y / (3.0 * doubled))
    count = len(corners)
    return area, (sum(x for x, _ in corners) / count, sum(y for _, y in corners) / count)

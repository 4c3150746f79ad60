"""Gradient maps (Def. 19): robustness of guards with one object at every cell of a grid.

The positions of the grid become the samples of traces in which only the object moves. The kernels that
evaluate a log also evaluate a map, so a cell and an equal sample of a log have the same robustness. Layers
name the conjunct that limits a cell, and the cause that blocks the cell.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import chain
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import Footprint, FootprintBatch, TrackedObject, with_poses
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.lazy import Displayed
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.planning.settings import Grid, Settings, Workspace, refuse_faults
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    Group,
    Outline,
    Quantified,
    SignedDistance,
    Term,
    TrackedName,
    expand,
)
from spatial_replay.spec.walks import (
    base_of,
    is_about_having_rates,
    iter_expressions,
    iter_formulas,
    looks_back,
    terms_of,
)
from spatial_replay.trace.trace import Sample, Trace

Cube: TypeAlias = tuple[tuple[int, bool], ...]
"""A conjunction of literals (number of a proposition, whether it must hold); the empty cube is true."""

Cubes: TypeAlias = tuple[Cube, ...]
"""A disjunction of cubes; no cube means false."""

FREE: Final = 0
CONSTRAINED: Final = 1
OCCUPIED: Final = 2
OUT_OF_REACH: Final = 3
UNKNOWN: Final = 4
REASONS: Final = ("free", "a constraint would hold", "an obstacle is there", "out of reach", "unknown")
"""Reasons why cells are blocked, by their numbers in `GradientMap.blocked`."""

_AT_ONCE: Final = 1 << 20
"""Maximum number of values that are measured at once; they take about 60 MB."""


@dataclass(frozen=True, eq=False)
class GradientMap(Displayed):
    """The robustness of a progress set with an object at each cell of a grid (Def. 19).

    Attributes:
        name: name of the object.
        grid: cells; the grid exceeds the workspace if a pushed object starts outside.
        robustness: (A, rows, columns), in the unit of the relations, also at blocked cells.
        blocked: (A, rows, columns) uint8, `FREE` or the reason why the cell is blocked (see `REASONS`).
        clearance: (A, rows, columns), signed distance to the nearest obstacle; +inf without obstacles.
        turns: (A,), angles by which the object is turned, radians.
        made_of: inputs of the map, for `map_layers`.
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
        """(A, rows, columns), robustness; NaN at blocked cells."""
        return np.where(self.blocked == FREE, self.robustness, np.nan)

    def best(self) -> float:
        """Return the greatest robustness at a free cell; -inf without free cells."""
        free = self.blocked == FREE
        return float(self.robustness[free].max()) if free.any() else -np.inf

    def best_poses(
        self, count: int, avoided: Sequence[tuple[float, float]] = ()
    ) -> list[tuple[float, float, float, float]]:
        """Return the best poses in free cells (x, y, turn, robustness), at least two cells from each other.

        Args:
            avoided: further places (x, y); the poses are at least two cells from each of these places.
        """
        # a stable sort, so that equally robust cells keep their order
        cell_order = np.argsort(
            -np.where(self.blocked == FREE, self.robustness, -np.inf), axis=None, kind="stable"
        )
        places, poses = [*avoided], list[tuple[float, float, float, float]]()
        for cell_index in cell_order[: int((self.blocked == FREE).sum())]:
            turn, row, column = map(int, np.unravel_index(int(cell_index), self.blocked.shape))
            place = self.grid.centre(row, column)
            if len(poses) == count:
                break
            if all(math.dist(place, other_place) >= 2.0 * self.grid.cell_size for other_place in places):
                places.append(place)
                poses.append((*place, float(self.turns[turn]), float(self.robustness[turn, row, column])))
        return poses

    def cell_of(self, x: float, y: float, turn: float) -> tuple[int, int, int]:
        """Return the indices of turn, row and column of a pose."""
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
    """Return the map of a progress set; cells are blocked where the constraint set would hold.

    Args:
        progress: cubes, one of which must hold.
        constraints: cubes whose robustness must be less than -`margin`; an unknown cube counts as holding.
        margin: margin of the constraints, in the unit of the relations, at least 0.
        after: maps after motions of other objects, which give the robustness; `maps` gives the blocked cells.
    """
    shape = maps.clearance.shape
    robustness_maps = maps if after is None else after
    robustness = _greatest(robustness_maps.lower, robustness_maps.upper, progress, shape)
    danger = danger_of(maps, constraints)
    blocked = np.zeros(shape, np.uint8)
    # later assignments take precedence: a constrained and occupied cell is reported as constrained
    blocked[robustness == -np.inf] = UNKNOWN
    blocked[~np.broadcast_to(workspace.within_reach(maps.grid), shape)] = OUT_OF_REACH
    blocked[maps.clearance <= workspace.clearance] = OCCUPIED
    blocked[danger >= -margin] = CONSTRAINED
    map_parts = MapParts(maps, robustness_maps, progress, constraints)
    return GradientMap(maps.name, maps.grid, robustness, blocked, maps.clearance, maps.turns, map_parts)


def danger_of(maps: PropositionMaps, constraints: Cubes) -> Floats:
    """Return the greatest robustness that a constraint may have in each cell, (A, rows, columns)."""
    return _greatest(maps.upper, maps.lower, constraints, maps.clearance.shape)


def _greatest(positive: Floats, negative: Floats, cubes: Cubes, shape: tuple[int, ...]) -> Floats:
    """Return the greatest robustness of a cube (see `cube_robustness`); -inf without cubes."""
    cube_values = (cube_robustness(positive, negative, cube, shape) for cube in cubes)
    return reduce(np.maximum, cube_values, np.full(shape, -np.inf))


def cube_robustness(positive: Floats, negative: Floats, cube: Cube, shape: tuple[int, ...]) -> Floats:
    """Return the robustness of a cube: the minimum over its literals.

    Args:
        positive, negative: bounds of the propositions, for positive literals and for negative literals.
    """
    literal_values = (positive[number] if value else -negative[number] for number, value in cube)
    return reduce(np.minimum, literal_values, np.full(shape, np.inf))


@dataclass(frozen=True, eq=False)
class PropositionMaps:
    """The robustness of P propositions with one object at every cell of a grid, in A orientations.

    Attributes:
        name: name of the object.
        grid: cells.
        lower, upper: (P, A, rows, columns), bounds of the robustness; -inf and +inf for unknown values.
        clearance: (A, rows, columns), signed distance to the nearest obstacle; +inf without obstacles.
        distances: (O, A, rows, columns), signed distance to each of `obstacles`.
        turns: (A,), angles by which the object is turned, radians.
        obstacles: names of objects; the last name, "", is for the obstacles of the workspace.
        about: subject of the maps.
        static: obstacles of the workspace by name.
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
    static: Mapping[str, Footprint] = field(repr=False)

    def room(self, others: Collection[str] | None) -> Floats:
        """Return the distance to the nearest of `others`, (A, rows, columns); None stands for all objects."""
        is_selected = [others is None or name in others for name in self.obstacles]
        return np.asarray(self.distances[is_selected].min(axis=0, initial=np.inf))

    def nearest(self) -> NDArray[np.int64]:
        """Return the index of each cell's nearest obstacle in `obstacles`, (A, rows, columns).

        An object that overlaps the moved object precedes the workspace's obstacles, because only objects have
        names.
        """
        distances = self.distances.copy()
        distances[-1, self.distances[:-1].min(axis=0, initial=np.inf) <= 0.0] = np.inf
        return np.asarray(distances.argmin(axis=0))


class MapSubject(NamedTuple):
    """Subject of maps: propositions, regions, and the sample in which one object is moved."""

    propositions: tuple[Formula, ...]
    regions: Mapping[str, Outline]
    sample: Sample


class MapParts(NamedTuple):
    """Inputs of a gradient map: maps now, maps after motions of other objects, progress, constraints."""

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
        grid: grid to use instead of the workspace's grid.

    Raises:
        UsageError: the sample does not have the object, or a proposition looks at earlier samples.
    """
    refuse_delays(propositions)
    tracked = sample.objects.get(name)
    if not isinstance(tracked, TrackedObject):
        present = ", ".join(sample.objects) or "none"
        raise UsageError(f"there is no object {name!r} to move; the sample has: {present}")
    map_grid = workspace.grid if grid is None else grid
    turns = workspace.turns(tracked.yaw)
    is_concerned = np.array([concerns(proposition, name) for proposition in propositions], np.bool_)
    moving_propositions = [
        proposition for proposition, is_moving in zip(propositions, is_concerned, strict=True) if is_moving
    ]
    fixed_propositions = [
        proposition
        for proposition, is_moving in zip(propositions, is_concerned, strict=True)
        if not is_moving
    ]
    obstacles = [
        obstacle for obstacle in sorted(sample.objects) if obstacle not in (name, *workspace.supports)
    ]
    formulas = [*moving_propositions, *_obstacle_distances(propositions, name, obstacles)]
    trace, centres = Trace.from_samples([sample]), map_grid.centres()
    shape = len(turns), len(centres)
    obstacle_distances: Floats = np.empty((len(obstacles) + 1, *shape))
    pieces: list[tuple[slice, Floats]] = []
    for cell_slice in _slices(len(centres), math.prod(shape) * len(formulas)):
        posed_trace = _trace_over_poses(trace, tracked, name, centres[cell_slice], turns)
        static_distances = _static_distance(posed_trace, name, workspace.obstacles).reshape(len(turns), -1)
        # the first two rows are bounds without uncertainty
        leaf_bounds = leaf_values(TraceScene(posed_trace, regions), formulas, {})[:2]
        leaf_bounds = leaf_bounds.reshape(*leaf_bounds.shape[:2], *static_distances.shape)
        obstacle_distances[:, :, cell_slice] = [*leaf_bounds[0, len(moving_propositions) :], static_distances]
        pieces.append((cell_slice, leaf_bounds[:, : len(moving_propositions)]))
    # propositions that do not depend on the object have the same value in every cell
    fixed_bounds = leaf_values(TraceScene(trace, regions), fixed_propositions, {})[:2, :, :, None]
    # in most maps everything is known, so that one array has both bounds
    bound_count = max(len(fixed_bounds), *(len(leaf_bounds) for _, leaf_bounds in pieces))
    bounds: Floats = np.empty((bound_count, len(propositions), *shape))
    bounds[:, ~is_concerned] = fixed_bounds
    for cell_slice, leaf_bounds in pieces:
        bounds[:, is_concerned, :, cell_slice] = leaf_bounds
    bounds = bounds.reshape(bound_count, len(propositions), len(turns), *map_grid.shape)
    obstacle_distances = obstacle_distances.reshape(-1, len(turns), *map_grid.shape)
    subject = MapSubject(tuple(propositions), regions, sample)
    distance_fields = obstacle_distances.min(axis=0), obstacle_distances, turns, (*obstacles, "")
    return PropositionMaps(
        name, map_grid, bounds[0], bounds[-1], *distance_fields, subject, workspace.named_obstacles
    )


def _slices(cell_count: int, value_count: int) -> Iterator[slice]:
    """Yield slices of the cells; each slice has at most `_AT_ONCE` values.

    Args:
        value_count: number of values of all cells.
    """
    slice_size = max(1, cell_count * _AT_ONCE // max(value_count, 1))
    yield from (slice(first, first + slice_size) for first in range(0, cell_count, slice_size))


def _obstacle_distances(propositions: Sequence[Formula], name: str, obstacles: Sequence[str]) -> list[Atom]:
    """Return atoms for the signed distance from the object to each obstacle.

    The distance is at most 0 exactly if the object's centre is in the Minkowski sum of the obstacle and the
    mirrored object, the usual configuration-space obstacle.
    """
    proposition_atoms = (
        part for proposition in propositions for part in iter_formulas(proposition) if isinstance(part, Atom)
    )
    measured_expressions = {part for atom in proposition_atoms for part in iter_expressions(atom.expression)}
    pairs = ((distance_between(name, obstacle), distance_between(obstacle, name)) for obstacle in obstacles)
    # operands have the order of a proposition's operands, so that the kernel measures each pair only once
    return [swapped if swapped.expression in measured_expressions else atom for atom, swapped in pairs]


def distance_between(first: str, second: str) -> Atom:
    """Return the atom whose robustness is the signed distance between two objects."""
    return Atom("", "dist", SignedDistance(TrackedName(first), TrackedName(second)))


def _static_distance(trace: Trace, name: str, obstacles: Sequence[Footprint]) -> Floats:
    """Return the distance from an object to the nearest obstacle, (T,); +inf without obstacles."""
    if not obstacles:
        return np.full(len(trace), np.inf)
    batch = FootprintBatch.concatenate([trace.footprints, FootprintBatch.from_footprints(obstacles)])
    obstacle_rows = np.tile(np.arange(len(trace.footprints), len(batch)), (len(trace), 1))
    operands = Operand(trace.rows[:, [trace.names.index(name)]]), Operand(obstacle_rows)
    return np.asarray(measure(batch, operands, [MeasureRequest("signed_distance", 0, 1)])[0])


def _trace_over_poses(
    trace: Trace, tracked: TrackedObject, name: str, centres: Floats, turns: Floats
) -> Trace:
    """Return a trace that repeats the only sample, once for each turn and position of the object."""
    footprints = with_poses(trace.footprints, tracked, centres, turns)
    pose_count, column = len(footprints) - len(trace.footprints), trace.names.index(name)
    object_rows = np.full(pose_count, trace.rows[0, column])
    rows = np.repeat(trace.rows, pose_count, axis=0)
    rows[:, column] = len(trace.footprints) + np.arange(pose_count)
    return Trace(
        times_ns=np.arange(pose_count, dtype=np.int64),
        names=trace.names,
        rows=rows,
        footprints=footprints,
        yaw=np.concatenate((trace.yaw, trace.yaw[object_rows] + np.repeat(turns, pose_count // len(turns)))),
        uncertainty=np.concatenate((trace.uncertainty, trace.uncertainty[object_rows])),
        class_code=np.concatenate((trace.class_code, trace.class_code[object_rows])),
        classes=trace.classes,
        signals={signal: np.repeat(values, pose_count) for signal, values in trace.signals.items()},
    )


def concerns(formula: Formula, name: str) -> bool:
    """Return whether a formula depends on the pose of an object."""
    return any(
        isinstance(part, Quantified)
        or (isinstance(part, Atom) and any(_is_about(term, name) for term in terms_of(part.expression)))
        for part in iter_formulas(formula)
    )


def _is_about(term: Term, name: str) -> bool:
    base = base_of(term)
    if isinstance(base, Group):
        return base.members is None or name in base.members
    return isinstance(base, TrackedName) and base.name == name


def refuse_delays(propositions: Sequence[Formula]) -> None:
    """Check that each proposition depends on one sample.

    Raises:
        UsageError: a proposition depends on earlier samples, which a motion does not change.
    """
    for proposition in propositions:
        for part in iter_formulas(proposition):
            if is_about_having_rates(part):
                # this part only tests whether a rate exists; a later part, the rate itself, is refused
                continue
            terms = list(terms_of(part.expression)) if isinstance(part, Atom) else []
            terms += [part.group] if isinstance(part, Quantified) else []
            if any(map(looks_back, terms)):
                raise UsageError(
                    f"{format_formula(part)} looks at earlier samples, so there is no map of it; plan "
                    "without it, and evaluate it with replay"
                )


def refuse_unknown(names: Sequence[str], sample: Sample, propositions: Sequence[Formula]) -> None:
    """Check that objects are in a sample or in a proposition; objects of propositions may appear later.

    Raises:
        UsageError: names every object that is in no proposition and not in the sample.
    """
    faults = []
    for name in names:
        if name not in sample.objects and not any(
            concerns(proposition, name) for proposition in propositions
        ):
            hint = nearest_hint(name, sample.objects)
            faults.append(
                f"{name!r} is movable, but neither the specification nor the first sample has it; "
                f"{hint or 'the sample has: ' + (', '.join(sample.objects) or 'none')}"
            )
    refuse_faults(faults)


# ----------------------------------------------------------------------------------------------------- layers

AVOIDED_CELLS: Final = 2.0
"""Distance of a new target from a place where a motion failed, cells."""
MOST_LAYERS: Final = 12
"""Maximum number of conjuncts with a layer in a log, varying conjuncts first; a log names all conjuncts."""
MOST_CAUSES: Final = 1000
"""Maximum number of listed causes; cells with a further cause refer to the last listed cause."""

CauseKind: TypeAlias = Literal["constraint", "object", "obstacle", "reach", "unknown", "failed"]
"""Reason why a cell is blocked: a constraint would hold, an object or an obstacle occupies the cell, or the
robot cannot reach the cell. "unknown": the progress set is unknown. "failed": a motion to a nearby place
failed."""

_KINDS: Final[tuple[CauseKind, ...]] = ("constraint", "object", "reach", "unknown", "failed")
_KIND_OF: Final = {CONSTRAINED: 0, OCCUPIED: 1, OUT_OF_REACH: 2, UNKNOWN: 3}
_FAILED: Final = 4
_NUMBERS: Final = 1 << 24
"""Number of codes for each kind of cause."""


class BlockedBy(NamedTuple):
    """A cause that blocks cells.

    Attributes:
        name: name of the object, or text of the constraint; empty for other kinds.
        cells: number of blocked cells, over all orientations.
    """

    kind: CauseKind
    name: str
    cells: int


@dataclass(frozen=True, slots=True, eq=False)
class MapLayers:
    """The conjuncts of a gradient map, and the causes that block its cells.

    Attributes:
        conjuncts: texts of the L relations in the progress set, or of their negations.
        required: whether each conjunct must hold; False for one of several alternatives.
        robustness: (L, A, rows, columns), robustness of each conjunct; -inf for unknown values.
        limiting: (A, rows, columns), index of the conjunct whose robustness equals the progress set's
            robustness; -1 without such a conjunct.
        causes: causes that block cells, most cells first.
        blocked_by: (A, rows, columns), index of each cell's cause; -1 for a free cell.
    """

    conjuncts: tuple[str, ...]
    required: tuple[bool, ...]
    robustness: Floats
    limiting: NDArray[np.int64]
    causes: tuple[BlockedBy, ...]
    blocked_by: NDArray[np.int64]


def map_layers(
    gradient: GradientMap,
    settings: Settings,
    failed: Collection[tuple[float, float]] = (),
    tried: Booleans | None = None,
) -> MapLayers:
    """Split a gradient map into the layers of its conjuncts and causes.

    Args:
        settings: settings of the planner.
        failed: places (x, y) where motions of the object failed, which the object avoids.
        tried: (A, rows, columns), further cells to avoid, near failed targets.
    """
    map_parts, shape = gradient.made_of, gradient.blocked.shape
    formulas = map_parts.then.about.propositions
    cube_parts = [
        [_Part.of(formulas[number], value) for number, value in cube] for cube in map_parts.progress
    ]
    leaves = tuple(dict.fromkeys(leaf for cube in cube_parts for part in cube for leaf in part.leaves()))
    lower, upper = _bounds_of(map_parts.then, [leaf.formula for leaf in leaves])
    layers = np.empty((len(leaves), *shape))
    for layer_index, leaf in enumerate(leaves):
        layers[layer_index] = lower[layer_index] if leaf.wanted else -upper[layer_index]
    layer_indices = {leaf: layer_index for layer_index, leaf in enumerate(leaves)}
    limits = (
        _limit_of([part.limit(layers, layer_indices) for part in cube], shape, is_every=True)
        for cube in cube_parts
    )
    _, limiting = _limit_of(limits, shape, is_every=False)
    is_avoided = avoided_cells(gradient, settings, failed)
    causes, blocked_by = _causes(gradient, is_avoided if tried is None else is_avoided | tried)
    texts = tuple(leaf.text for leaf in leaves)
    required_leaves = [{leaf for part in cube for leaf in part.required_leaves()} for cube in cube_parts]
    required = tuple(all(leaf in of_cube for of_cube in required_leaves) for leaf in leaves)
    return MapLayers(texts, required, layers, limiting, causes, blocked_by)


_Limit: TypeAlias = tuple[Floats, NDArray[np.int64]]
"""Robustness in each cell, and the index of the relation with this robustness; -1 for no relation."""


class _Part(NamedTuple):
    """A formula without temporal operators that must hold, or must not hold."""

    formula: Formula
    wanted: bool

    @classmethod
    def of(cls, formula: Formula, wanted: bool) -> _Part:
        """Return the part without outer definitions and negations."""
        formula = expand(formula)
        if isinstance(formula, Boolean) and formula.operator == "not":
            return cls.of(formula.operands[0], not wanted)
        return cls(formula, wanted)

    @property
    def text(self) -> str:
        return literal_text(self.formula, self.wanted)

    @property
    def brief(self) -> str:
        """The part's text; the name replaces the text of a named formula."""
        name = self.formula.name
        return self.text if name is None else name if self.wanted else f"not {name}"

    @property
    def members(self) -> list[_Part]:
        """The operands of a Boolean formula as parts; none for a relation."""
        operands = self.formula.operands if isinstance(self.formula, Boolean) else ()
        return [_Part.of(operand, self.wanted) for operand in operands]

    @property
    def is_every(self) -> bool:
        """Whether all members must hold; if not, one member is enough."""
        return not isinstance(self.formula, Boolean) or (self.formula.operator == "and") == self.wanted

    def leaves(self) -> Iterator[_Part]:
        """Iterate over all relations in the part."""
        members = self.members
        yield from chain.from_iterable(member.leaves() for member in members) if members else (self,)

    def required_leaves(self) -> Iterator[_Part]:
        """Iterate over the relations that must hold, without alternatives."""
        if not self.members:
            yield self
        elif self.is_every:
            yield from chain.from_iterable(member.required_leaves() for member in self.members)

    def options(self) -> Iterator[_Part]:
        """Iterate over alternatives: the part holds if any alternative holds."""
        yield from (
            (self,) if self.is_every else chain.from_iterable(member.options() for member in self.members)
        )

    def limit(self, layers: Floats, places: Mapping[_Part, int]) -> _Limit:
        """Return the robustness of the part, and the index of the relation with this robustness."""
        shape = layers.shape[1:]
        if (place := places.get(self)) is not None:
            return layers[place], np.full(shape, place, np.int64)
        limits = (member.limit(layers, places) for member in self.members)
        return _limit_of(limits, shape, is_every=self.is_every)


def literal_text(formula: Formula, wanted: bool) -> str:
    """Return the text of a formula that must hold, or of its negation."""
    text = format_formula(formula)
    return text if wanted else f"not ({text})"


def _limit_of(member_limits: Iterable[_Limit], shape: tuple[int, ...], *, is_every: bool) -> _Limit:
    """Return the least limit of members in each cell if `is_every`, else the greatest limit."""
    limit, limiting_index = np.full(shape, np.inf if is_every else -np.inf), np.full(shape, -1, np.int64)
    for member_value, member_index in member_limits:
        is_limiting = member_value < limit if is_every else member_value > limit
        limit, limiting_index = (
            np.where(is_limiting, member_value, limit),
            np.where(is_limiting, member_index, limiting_index),
        )
    return limit, limiting_index


def _bounds_of(maps: PropositionMaps, formulas: Sequence[Formula]) -> tuple[Floats, Floats]:
    """Return bounds (N, A, rows, columns) of the robustness of formulas in the cells of maps."""
    subject = maps.about
    tracked = subject.sample.objects[maps.name]
    yaw = tracked.yaw or 0.0 if isinstance(tracked, TrackedObject) else 0.0
    # all objects are declared supports, so that no distances to obstacles are measured
    all_names = frozenset(subject.sample.objects)
    free_workspace = Workspace(maps.grid, yaws=tuple((maps.turns + yaw).tolist()), supports=all_names)
    part_maps = proposition_maps(formulas, subject.regions, subject.sample, maps.name, free_workspace)
    return part_maps.lower, part_maps.upper


def _causes(gradient: GradientMap, is_avoided: Booleans) -> tuple[tuple[BlockedBy, ...], NDArray[np.int64]]:
    """Return the causes that block cells, and the index of each cell's cause."""
    maps, blocked = gradient.made_of.now, gradient.blocked
    # the kind and number of a cause are one integer, so that np.unique counts causes
    codes = np.full(blocked.shape, -1, np.int64)
    for reason, kind_index in _KIND_OF.items():
        codes[blocked == reason] = kind_index * _NUMBERS
    is_occupied = blocked == OCCUPIED
    codes[is_occupied] += maps.nearest()[is_occupied]
    is_constrained = blocked == CONSTRAINED
    texts: tuple[str, ...] = ()
    if is_constrained.any():
        texts, constraint_indices = most_dangerous(gradient.made_of, blocked.shape)
        codes[is_constrained] += constraint_indices[is_constrained]
    codes[(blocked == FREE) & is_avoided] = _FAILED * _NUMBERS
    unique_codes, counts = np.unique(codes[codes >= 0], return_counts=True)
    count_order = np.argsort(-counts, kind="stable")
    causes = []
    blocked_by = np.full(blocked.shape, -1, np.int64)
    for cause_index, (code, cell_count) in enumerate(
        zip(unique_codes[count_order].tolist(), counts[count_order].tolist(), strict=True)
    ):
        kind, cause_number = _KINDS[code // _NUMBERS], code % _NUMBERS
        name = (
            texts[cause_number]
            if kind == "constraint"
            else maps.obstacles[cause_number]
            if kind == "object"
            else ""
        )
        if kind == "object" and not name:
            kind = "obstacle"
        blocked_by[codes == code] = min(cause_index, MOST_CAUSES - 1)
        causes.append(BlockedBy(kind, name, cell_count))
    return tuple(causes[:MOST_CAUSES]), blocked_by


def most_dangerous(parts: MapParts, shape: tuple[int, ...]) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """Return the texts of the constraints, and the index of the most robust constraint in each cell.

    A guard of one proposition is split into its alternatives.
    """
    formulas = parts.now.about.propositions
    guards: list[tuple[_Part, ...]] = []
    for cube in parts.constraints:
        literals = tuple(_Part(formulas[number], value) for number, value in cube)
        guards += (
            [(option,) for option in _Part.of(*literals[0]).options()] if len(literals) == 1 else [literals]
        )
    guards = list(dict.fromkeys(guards))
    members = list(dict.fromkeys(part for guard in guards for part in guard))
    lower, upper = _bounds_of(parts.now, [member.formula for member in members])
    member_indices = {member: place for place, member in enumerate(members)}
    most_robust, danger = np.zeros(shape, np.int64), np.full(shape, -np.inf)
    for number, guard in enumerate(guards):
        cube = tuple((member_indices[part], part.wanted) for part in guard)
        robustness = cube_robustness(upper, lower, cube, shape)
        most_robust[robustness > danger] = number
        np.maximum(danger, robustness, out=danger)
    return tuple(" and ".join(part.brief for part in guard) for guard in guards), most_robust


def near(failed: Collection[tuple[float, float]], grid: Grid) -> Booleans:
    """Return whether each cell is near a place where a motion failed, (rows, columns)."""
    return distance_to(failed, grid) <= AVOIDED_CELLS * grid.cell_size


def distance_to(places: Collection[tuple[float, float]], grid: Grid) -> Floats:
    """Return the distance from each cell to the nearest of some places, (rows, columns)."""
    distances = np.full(grid.shape, np.inf)
    centres = grid.centres()
    for place in places:
        np.minimum(distances, np.hypot(*(centres - np.array(place)).T).reshape(grid.shape), out=distances)
    return distances


def avoided_cells(
    gradient: GradientMap, settings: Settings, failed: Collection[tuple[float, float]]
) -> Booleans:
    """Return whether a target avoids each cell after failed motions, (rows, columns)."""
    is_avoided = near(failed, gradient.grid)
    is_met = (gradient.blocked == FREE) & (gradient.robustness >= settings.margin)
    if is_met.any() and not (is_met & ~is_avoided).any():
        # a motion may fail by chance, so places are tried again, starting far from the failures
        distances = distance_to(failed, gradient.grid)
        return np.asarray(distances < distances[is_met.any(axis=0)].max() / 2.0)
    return is_avoided

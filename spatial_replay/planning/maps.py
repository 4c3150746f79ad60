"""Gradient maps (Def. 19): how well guards would hold with one object somewhere else.

The grid's positions are the samples of a trace in which nothing but that object moves, so the kernels that
evaluate a log evaluate a map, all relations in one call, and a map's number is that of a log's sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.geometry.measure import Operand, Request, measure
from spatial_replay.monitor.leaves import leaf_values
from spatial_replay.monitor.operands import Scene
from spatial_replay.planning.poses import moved_batch, turns_for
from spatial_replay.planning.workspace import Workspace
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Atom,
    Earlier,
    Enlarged,
    Formula,
    Group,
    Outline,
    Quantified,
    SignedDistance,
    Term,
    TrackedName,
)
from spatial_replay.spec.terms import base_of, iter_expressions, iter_formulas, terms_of
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

Cube: TypeAlias = tuple[tuple[int, bool], ...]
"""A conjunction of propositions, by number, each to hold or not to; the empty one always holds."""

Cubes: TypeAlias = tuple[Cube, ...]
"""A disjunction of cubes; none never holds."""

FREE: Final = 0
CONSTRAINED: Final = 1
OCCUPIED: Final = 2
OUT_OF_REACH: Final = 3
UNKNOWN: Final = 4
REASONS: Final = ("free", "a constraint would hold", "an obstacle is there", "out of reach", "unknown")
"""Why a cell is blocked, by the number that `GradientMap.blocked` has for it."""


@dataclass(frozen=True, eq=False)
class PropositionMaps:
    """Every proposition with one object at every cell of a grid, in A orientations.

    Attributes:
        name: of the object.
        lower, upper: (P, A, rows, columns), robustness; -inf and +inf where it is unknown.
        clearance: (A, rows, columns), signed distance to the nearest obstacle; +inf where there is none.
        turns: (A,) radians by which the object is turned.
    """

    name: str
    lower: Floats
    upper: Floats
    clearance: Floats
    turns: Floats


@dataclass(frozen=True, eq=False)
class GradientMap:
    """How well a progress set would hold with an object at each cell (Def. 19).

    Attributes:
        name: of the object.
        robustness: (A, rows, columns), in the unit of the relations; also at blocked cells.
        blocked: (A, rows, columns) uint8, `FREE` or why the object must not be there (see `REASONS`).
        clearance: (A, rows, columns), signed distance to the nearest obstacle; +inf where there is none.
        turns: (A,) radians by which the object is turned.
    """

    name: str
    robustness: Floats
    blocked: NDArray[np.uint8]
    clearance: Floats
    turns: Floats

    @property
    def values(self) -> Floats:
        """(A, rows, columns): the robustness, NaN where cells are blocked."""
        return np.where(self.blocked == FREE, self.robustness, np.nan)

    def best(self) -> float:
        """The greatest robustness at a free cell; -inf where there is none."""
        free = self.blocked == FREE
        return float(self.robustness[free].max()) if free.any() else -np.inf


def proposition_maps(
    propositions: Sequence[Formula],
    regions: Mapping[str, Outline],
    sample: Sample,
    name: str,
    workspace: Workspace,
) -> PropositionMaps:
    """Each proposition with the object `name` of a sample at every cell of a workspace.

    Raises:
        UsageError: the sample does not have the object, or a proposition looks at earlier samples.
    """
    refuse_delays(propositions)
    tracked = sample.objects.get(name)
    if not isinstance(tracked, TrackedObject):
        seen = ", ".join(sample.objects) or "none"
        raise UsageError(f"there is no object {name!r} to move; the sample has: {seen}")
    turns = turns_for(tracked, workspace.yaws)
    shape = (len(turns), *workspace.grid.shape)
    here = Trace.from_samples([sample])
    everywhere = _trace_over_cells(here, tracked, name, workspace, turns)
    moving = [concerns(each, name) for each in propositions]
    standing = _standing(propositions, sample, name, workspace)
    concerned = [each for each, moves in zip(propositions, moving, strict=True) if moves]
    over_cells = _intervals(everywhere, [*concerned, *standing], regions)
    fixed = _intervals(here, propositions, regions)
    ends = []
    for one, of_all in zip(over_cells, fixed, strict=True):
        # what the object has no part in is measured once
        values = np.repeat(of_all, len(everywhere), axis=1)
        values[moving] = one[: len(concerned)]
        ends.append(values.reshape(len(propositions), *shape))
    clearance = over_cells[0][len(concerned) :].min(axis=0, initial=np.inf)
    if workspace.obstacles:
        clearance = np.minimum(clearance, _to_static(everywhere, name, workspace))
    lower, upper = ends
    return PropositionMaps(name, lower, upper, clearance.reshape(shape), turns)


def gradient_map(
    maps: PropositionMaps,
    progress: Cubes,
    constraints: Cubes,
    workspace: Workspace,
    margin: float = 0.0,
) -> GradientMap:
    """The map of a progress set, blocked where the constraint set would hold.

    Args:
        progress: one of these cubes is to hold.
        constraints: none of these may hold, not even by -`margin`; what may hold for being unknown counts.
        margin: in the unit of the relations, at least 0.
    """
    shape = maps.clearance.shape
    robustness = np.full(shape, -np.inf)
    for cube in progress:
        np.maximum(robustness, _holds(maps.lower, maps.upper, cube, shape), out=robustness)
    danger = np.full(shape, -np.inf)
    for cube in constraints:
        np.maximum(danger, _holds(maps.upper, maps.lower, cube, shape), out=danger)
    blocked = np.zeros(shape, np.uint8)
    blocked[robustness == -np.inf] = UNKNOWN
    blocked[~np.broadcast_to(workspace.within_reach, shape)] = OUT_OF_REACH
    blocked[maps.clearance <= workspace.clearance] = OCCUPIED
    blocked[danger >= -margin] = CONSTRAINED
    return GradientMap(maps.name, robustness, blocked, maps.clearance, maps.turns)


def _holds(positive: Floats, negative: Floats, cube: Cube, shape: tuple[int, ...]) -> Floats:
    """How well a cube holds: the least of its literals."""
    least = np.full(shape, np.inf)
    for number, wanted in cube:
        np.minimum(least, positive[number] if wanted else -negative[number], out=least)
    return least


def concerns(formula: Formula, name: str) -> bool:
    """Whether what a formula says depends on where an object is."""
    for each in iter_formulas(formula):
        if isinstance(each, Quantified):
            return True
        if isinstance(each, Atom) and any(_is_about(term, name) for term in terms_of(each.expression)):
            return True
    return False


def _is_about(term: Term, name: str) -> bool:
    base = base_of(term)
    if isinstance(base, Group):
        return base.members is None or name in base.members
    return isinstance(base, TrackedName) and base.name == name


def refuse_delays(propositions: Sequence[Formula]) -> None:
    """That propositions are about one sample each.

    Raises:
        UsageError: one looks at earlier samples, which moving an object now does not change.
    """
    for proposition in propositions:
        for each in iter_formulas(proposition):
            terms = list(terms_of(each.expression)) if isinstance(each, Atom) else []
            terms += [each.group] if isinstance(each, Quantified) else []
            if any(map(_looks_back, terms)):
                raise UsageError(
                    f"{format_formula(each)} looks at earlier samples, so there is no map of it; plan "
                    "without it, and evaluate it with replay"
                )


def _looks_back(term: Term) -> bool:
    while isinstance(term, Enlarged):
        term = term.term
    return isinstance(term, Earlier)


def _intervals(
    trace: Trace, formulas: Sequence[Formula], regions: Mapping[str, Outline]
) -> tuple[Floats, Floats]:
    """(K, T), twice: formulas without temporal operators as intervals of their robustness."""
    leaves = leaf_values(Scene(trace, regions), formulas, {})
    return leaves[0], leaves[min(1, len(leaves) - 1)]


def _standing(propositions: Sequence[Formula], sample: Sample, name: str, workspace: Workspace) -> list[Atom]:
    """The distance from the object to each other one in its way.

    It is at most 0 just where the object's centre lies in the Minkowski sum of the other with the object
    mirrored.
    """
    measured = {
        part
        for proposition in propositions
        for each in iter_formulas(proposition)
        if isinstance(each, Atom)
        for part in iter_expressions(each.expression)
    }
    atoms = []
    for other in sorted(sample.objects):
        if other != name and other not in workspace.supports:
            one, two = TrackedName(name), TrackedName(other)
            # what a proposition measures anyway is not measured twice
            swapped = SignedDistance(two, one)
            atoms.append(Atom("", "dist", swapped if swapped in measured else SignedDistance(one, two)))
    return atoms


def _to_static(trace: Trace, name: str, workspace: Workspace) -> Floats:
    """(T,): the distance from the object to what stands in its way besides objects."""
    own = trace.rows[:, [trace.names.index(name)]]
    static = np.arange(len(workspace.obstacles), dtype=np.int64) + len(trace.footprints)
    obstacles = FootprintBatch.from_footprints(workspace.obstacles)
    batch = FootprintBatch.concatenate([trace.footprints, obstacles])
    operands = (Operand(own), Operand(np.tile(static, (len(trace), 1))))
    distance: Floats = measure(batch, operands, [Request("signed_distance", 0, 1)])[0]
    return distance


def _trace_over_cells(
    here: Trace, tracked: TrackedObject, name: str, workspace: Workspace, turns: Floats
) -> Trace:
    """A trace whose samples are that of `here` but for one object, put elsewhere by turn, row and column."""
    places = moved_batch(tracked, workspace.grid.centres(), turns)
    count, column = len(places), here.names.index(name)
    own = np.full(count, here.rows[0, column])
    rows = np.repeat(here.rows, count, axis=0)
    rows[:, column] = len(here.footprints) + np.arange(count)
    return Trace(
        times_ns=np.arange(count, dtype=np.int64),
        names=here.names,
        rows=rows,
        footprints=FootprintBatch.concatenate([here.footprints, places]),
        yaw=np.concatenate((here.yaw, here.yaw[own] + np.repeat(turns, count // len(turns)))),
        uncertainty=np.concatenate((here.uncertainty, here.uncertainty[own])),
        class_code=np.concatenate((here.class_code, here.class_code[own])),
        classes=here.classes,
        signals={signal: np.repeat(values, count) for signal, values in here.signals.items()},
    )

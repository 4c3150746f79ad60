"""How well propositions would hold with one object somewhere else.

The grid's positions are the samples of a trace in which nothing but that object moves, so the kernels that
evaluate a log evaluate a map, all relations in one call, and a map's number is that of a log's sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.geometry.measure import Operand, Request, measure
from spatial_replay.monitor.leaves import leaf_values
from spatial_replay.monitor.operands import Scene
from spatial_replay.planning.poses import moved_batch, turns_for
from spatial_replay.planning.subjects import concerns, refuse_delays
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.spec.formula import Atom, Formula, Outline, SignedDistance, TrackedName
from spatial_replay.spec.terms import iter_expressions, iter_formulas
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace


@dataclass(frozen=True, eq=False)
class PropositionMaps:
    """Every proposition with one object at every cell of a grid, in A orientations.

    Attributes:
        name: of the object.
        grid: the cells.
        lower, upper: (P, A, rows, columns), robustness; -inf and +inf where it is unknown.
        clearance: (A, rows, columns), signed distance to the nearest obstacle; +inf where there is none.
        turns: (A,) radians by which the object is turned.
    """

    name: str
    grid: Grid
    lower: Floats
    upper: Floats
    clearance: Floats
    turns: Floats


def proposition_maps(
    propositions: Sequence[Formula],
    regions: Mapping[str, Outline],
    sample: Sample,
    name: str,
    workspace: Workspace,
    grid: Grid | None = None,
) -> PropositionMaps:
    """Each proposition with the object `name` of a sample at every cell of a grid.

    Args:
        grid: other cells than those of the workspace.

    Raises:
        UsageError: the sample does not have the object, or a proposition looks at earlier samples.
    """
    refuse_delays(propositions)
    tracked = sample.objects.get(name)
    if not isinstance(tracked, TrackedObject):
        seen = ", ".join(sample.objects) or "none"
        raise UsageError(f"there is no object {name!r} to move; the sample has: {seen}")
    cells = workspace.grid if grid is None else grid
    turns = turns_for(tracked, workspace.yaws)
    here = Trace.from_samples([sample])
    everywhere = _trace_over_cells(here, tracked, name, cells, turns)
    moves = np.array([concerns(each, name) for each in propositions], np.bool_)
    concerned = [each for each, is_moving in zip(propositions, moves, strict=True) if is_moving]
    others = [each for each, is_moving in zip(propositions, moves, strict=True) if not is_moving]
    standing = _standing(propositions, sample, name, workspace)
    shape = (len(turns), *cells.shape)
    over_cells = _intervals(everywhere, [*concerned, *standing], regions)
    # what the object has no part in is measured once
    fixed = _intervals(here, others, regions)
    ends = []
    for moving, still in zip(over_cells, fixed, strict=True):
        values = np.empty((len(propositions), len(everywhere)))
        values[moves], values[~moves] = moving[: len(concerned)], still
        ends.append(values.reshape(len(propositions), *shape))
    clearance = over_cells[0][len(concerned) :].min(axis=0, initial=np.inf)
    if workspace.obstacles:
        clearance = np.minimum(clearance, _to_static(everywhere, name, workspace))
    lower, upper = ends
    return PropositionMaps(name, cells, lower, upper, clearance.reshape(shape), turns)


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


def _trace_over_cells(here: Trace, tracked: TrackedObject, name: str, grid: Grid, turns: Floats) -> Trace:
    """A trace whose samples are that of `here` but for one object, put elsewhere by turn, row and column."""
    places = moved_batch(tracked, grid.centres(), turns)
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

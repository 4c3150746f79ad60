"""Lookahead: a search for motions from a sample to acceptance, over predicted samples.

A predicted motion brings its object to the target at once. Objects are moved one at a time if possible. They
are arranged together if not, or if an object would have to be moved twice.

An arrangement assigns cells to several objects: a constraint satisfaction problem over the cells of a grid.
The demands on one object are a map. The demands on two objects depend only on the vector between them, and
are a stencil. The object with the fewest cells left comes first. Its cells are ordered by their robustness,
and by the number of cells that they leave to the other objects.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, count, islice, product
from typing import Final, TypeAlias

import numpy as np

from spatial_replay.automata.guards import Transition
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import (
    TrackedObject,
    centre_of,
    moved_copies,
    moved_object,
    radius_of,
)
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene, seam_texts
from spatial_replay.planning.decisions import Candidate, Consideration, Edge, Reason, Target
from spatial_replay.planning.edges import (
    LATER,
    Budget,
    Demand,
    Pose,
    alternatives,
    consideration_of,
    demands_of,
    equivalent_edges,
    idle_transitions,
    move_objects,
    moved_later,
    surplus,
    values_in,
    with_objects,
)
from spatial_replay.planning.maps import (
    AVOIDED_CELLS,
    concerns,
    distance_between,
    distance_to,
    gradient_map,
    literal_text,
    proposition_maps,
)
from spatial_replay.planning.motions import (
    Expectations,
    MotionOrder,
    Moved,
    Ordered,
    PredictedState,
    by_cost,
    choose_candidate,
)
from spatial_replay.planning.settings import Grid, Settings, Workspace
from spatial_replay.planning.targets import nearest_meeting
from spatial_replay.spec.formula import Atom, Formula, Outline, Quantified, TrackedName
from spatial_replay.spec.walks import base_of, iter_formulas, terms_of
from spatial_replay.trace.trace import Sample, Trace

# ----------------------------------------------------------------------------------------------- arrangements

_MOST_SETS: Final = 200
"""Maximum number of sets of objects to try for one conjunction."""
_MOST_VISITS: Final = 200
"""Maximum number of cells to try for one set of objects."""
_MOST_SOLUTIONS: Final = 6
"""Maximum number of arrangements of one set of objects."""
_WIDEST: Final = 360_000
"""Maximum number of cells of a stencil, over all orientations; larger pairs are only compared at the end.

Two objects on 300 x 300 cells need this number, if they are not turned. Without stencils, most placements
fail.
"""
_MISS: Final = 0.5
"""Cost of a placement that does not meet all demands, maps; it checks all cells of the remaining objects."""
_MOST_NAMED: Final = 3
"""Maximum number of objects that a sentence names."""
_ENOUGH: Final = 0.5
"""Share of its cells that each other object must keep after a choice by robustness."""
_STRICTLY: Final = 1e-12
"""Least margin of a constraint, because a constraint holds at robustness 0."""
_MOST_BETWEEN: Final = 3
"""Maximum number of sets, and of arrangements of each set, to try for places between cells."""
_MOST_STEPS: Final = 12
"""Maximum number of steps that move objects from cells to places between them."""
_MOST_STALLED: Final = 2
"""Maximum number of such steps without a gain."""
_STEP: Final = 0.5
"""Cost of such a step, maps."""
_TOWARDS: Final = (1.0 / 16.0, 1e-6)
"""Margins of demands at places between cells, as shares of a cell; the second is tried if the first fails."""
_NUDGES: Final = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
"""Displacements (x, y) that measure slopes, in small steps; the first is the object's own place."""
_OLDEST_CUTS: Final = 4
"""Number of previous steps whose linearized demands are kept."""

Cell: TypeAlias = tuple[int, int, int]
"""Index of an object's turn, and row and column of its centre."""


@dataclass(frozen=True, eq=False)
class _Field:
    """Values of one object's cells, with all other objects in place.

    Attributes:
        turns: (A,), angles by which the object is turned, radians.
        clearance: (A, rows, columns), distance to immovable objects minus the required clearance; -inf out of
            reach.
        standing: distance to each immovable object; "" is for the workspace's obstacles.
        apart: distance to each other movable object minus the required clearance.
        surplus: surplus of each demand on the object.
    """

    turns: Floats
    clearance: Floats
    standing: Mapping[str, Floats]
    apart: Mapping[str, Floats]
    surplus: Mapping[Demand, Floats]


class Arranger:
    """Search for arrangements of movable objects in one sample that meet demands."""

    def __init__(
        self,
        sample: Sample,
        regions: Mapping[str, Outline],
        settings: Settings,
        demands: Iterable[Demand],
        budget: Budget,
    ) -> None:
        self._sample, self._regions, self._settings, self._budget = sample, regions, settings, budget
        self._demands = tuple(dict.fromkeys(demands))
        self._grid = settings.workspace.grid
        order = sorted(sample.objects) if settings.movable is None else settings.movable
        self._movable = {name: sample.objects[name] for name in order if name in sample.objects}
        self._about = {demand: self._names(demand) for demand in self._demands}
        self._fields: dict[str, _Field] = {}
        self._stencils: dict[tuple[object, ...], Floats] = {}
        self._visits = 0
        # allowed shortfall of a demand at a cell's centre, because another place in the cell may meet it
        self._slack = 0.0
        self._is_placed = settings.refine and settings.skill == "place"

    def _names(self, demand: Demand) -> tuple[str, ...]:
        return tuple(name for name in self._movable if concerns(demand.formula, name))

    @cached_property
    def _unmet(self) -> tuple[Demand, ...]:
        met = zip(self._demands, self._surplus_in(self._sample), strict=True)
        return tuple(demand for demand, value in met if value < 0.0)

    def _surplus_in(self, sample: Sample) -> list[float]:
        """Return the surplus of each demand in a sample."""
        values = values_in(sample, [demand.formula for demand in self._demands], self._regions)
        return list(map(surplus, *values, self._demands))

    def why_hopeless(self) -> str:
        """Return why no arrangement can meet the demands; "" if no single object proves that."""
        for demand in self._unmet:
            if not self._about[demand]:
                return "no object that can be moved matters to it"
        for name in self._movable:
            demands = [demand for demand in self._demands if self._about[demand] == (name,)]
            if (
                demands
                and any(demand in self._unmet for demand in demands)
                and (field := self._field(name)) is not None
            ):
                met = np.minimum.reduce([field.surplus[demand] for demand in demands])
                least = -self._in_cell if self._is_placed else 0.0
                if not ((field.clearance > least) & (met >= least)).any():
                    if (met >= 0.0).any():
                        stands = _standing_text(self._standing(field, met >= 0.0))
                        return f"{stands or 'the robot does not reach'} wherever {name} would have to be"
                    missing = -float(met[field.clearance > 0.0].max(initial=-math.inf))
                    nowhere = f"{name}: nowhere would all of it hold, {missing:.4g} is missing at best"
                    seams = seam_texts((demand.formula for demand in demands), self._regions)
                    return "; ".join([nowhere, *seams])
        return ""

    @property
    def _in_cell(self) -> float:
        """The distance from the centre of a cell to its corners."""
        return self._grid.cell_size / math.sqrt(2.0)

    def what_stands(self) -> str:
        """Return a sentence on immovable objects at places where movable ones could go; "" without any."""
        names: dict[str, None] = {}
        for name, field in self._fields.items():
            cells = self._meeting_cells(field, name, tuple(self._movable))
            if not cells.all():
                names |= dict.fromkeys(self._standing(field, cells))
        return f"{_standing_text(list(names))} there" if names else ""

    def _standing(self, field: _Field, cells: Booleans) -> list[str]:
        """Return the immovable objects that occupy some of `cells`, most cells first."""
        clearance = self._settings.workspace.clearance
        counts = {name: int((cells & (away <= clearance)).sum()) for name, away in field.standing.items()}
        return sorted((name for name in counts if counts[name]), key=lambda name: -counts[name])

    def arrangements(self, most: int) -> Iterator[dict[str, Pose]]:
        """Yield arrangements, those of the smallest sets of objects first.

        If no arrangement over cells meets the demands, places between cells are tried.

        Args:
            most: maximum number of moved objects.
        """
        poses = None
        for poses in self._over_cells(most):
            yield poses
        if poses is None and self._is_placed:
            yield from self._between_cells(most)

    def cell_hint(self, most: int) -> str:
        """Return the advice to use smaller cells if only places between cells meet the demands, or ""."""
        fits = not self._is_placed and next(self._between_cells(most), None) is not None
        return "smaller cells (cell_size) may help" if fits else ""

    def _between_cells(self, most: int) -> Iterator[dict[str, Pose]]:
        self._slack = self._in_cell
        try:
            yield from self._over_cells(most)
        finally:
            self._slack = 0.0

    def _over_cells(self, most: int) -> Iterator[dict[str, Pose]]:
        # the number of a set comes before the set, so that equally good sets keep their order
        queue = [(self._hubs_in(group), len(group), n, group) for n, group in enumerate(self._bases(most))]
        heapq.heapify(queue)
        seen = {group for *_, group in queue}
        count = len(queue)
        most_sets, most_effort = (_MOST_BETWEEN,) * 2 if self._slack else (_MOST_SETS, _MOST_SOLUTIONS)
        for _ in range(most_sets):
            if not queue:
                return
            *_, group = heapq.heappop(queue)
            domains = self._domains(group)
            if domains is not None and all(domain.any() for domain in domains.values()):
                self._visits = 0
                stencils = self._conflicts(group, domains)
                effort = 0
                for cells in self._placements({}, domains, stencils):
                    poses: dict[str, Pose] | None = {name: self._pose(name, cells[name]) for name in cells}
                    if self._slack and poses:
                        poses = self._settle(poses)
                        # a failed attempt also counts, because it spends maps
                        effort += 1
                    if poses is not None and self.meets(move_objects(self._sample, poses)):
                        yield poses
                        effort += 1
                    elif not self._slack and not self._budget.spend(_MISS):
                        return
                    if effort >= most_effort:
                        break
            if len(group) < most and group:
                for name in self._in_the_way(group):
                    # in the order of the settings, so that equal sets are equal tuples
                    wider = tuple(movable for movable in self._movable if movable in group or movable == name)
                    if wider not in seen:
                        seen.add(wider)
                        count += 1
                        heapq.heappush(queue, (self._hubs_in(wider), len(wider), count, wider))

    def _bases(self, most: int) -> list[tuple[str, ...]]:
        """Return the smallest sets of objects that have an object of every unmet demand."""
        sets: dict[tuple[str, ...], None] = {(): None}
        for demand in self._unmet:
            wider: dict[tuple[str, ...], None] = {}
            for group in sets:
                if any(name in group for name in self._about[demand]):
                    wider[group] = None
                    continue
                for name in self._about[demand]:
                    both = tuple(movable for movable in self._movable if movable in group or movable == name)
                    if len(both) <= most:
                        wider[both] = None
            # sets without hubs first: moving only a hub seldom meets all its demands
            least = sorted(wider, key=self._hubs_in)
            sets = dict.fromkeys(least[:_MOST_SETS])
        return list(sets)

    def _hubs_in(self, group: Iterable[str]) -> int:
        """Return the number of hubs in a set: objects with unmet demands to several other objects."""
        return sum(name in self._hubs for name in group)

    @cached_property
    def _hubs(self) -> frozenset[str]:
        counts = Counter(name for demand in self._unmet for name in self._about[demand])
        pairs = {frozenset(self._about[demand]) for demand in self._unmet}
        # several demands on the same pair make neither object a hub
        partners = Counter(name for pair in pairs for name in pair if len(pair) > 1)
        return frozenset(name for name in counts if partners[name] > 1)

    def _in_the_way(self, chosen: tuple[str, ...]) -> list[str]:
        """Return up to four other objects that block the chosen ones, or take part in unmet demands."""
        counts = dict.fromkeys((movable for movable in self._movable if movable not in chosen), 0)
        for name in chosen:
            if (field := self._field(name)) is None:
                return []
            is_open = field.clearance > -self._slack
            cells = is_open & self._meeting_cells(field, name, chosen)
            if not cells.any():
                # no cell is good even without all others, but moving the partner may meet a demand on both
                cells = is_open
            for neighbour, apart in field.apart.items():
                if neighbour in counts:
                    counts[neighbour] += int((cells & (apart <= 0.0)).sum())
        tied = {name for demand in self._unmet for name in self._about[demand]}
        useful = [movable for movable, count in counts.items() if count or movable in tied]
        return sorted(useful, key=lambda movable: (movable not in tied, -counts[movable]))[:4]

    def _field(self, name: str) -> _Field | None:
        if name not in self._fields:
            if not self._budget.spend():
                return None
            self._fields[name] = self._measure_field(name)
        return self._fields[name]

    def _measure_field(self, name: str) -> _Field:
        workspace = self._settings.workspace
        others = [
            movable for movable in self._movable if movable != name and movable not in workspace.supports
        ]
        about = [demand for demand in self._demands if name in self._about[demand]]
        formulas = [
            *(demand.formula for demand in about),
            *(distance_between(name, neighbour) for neighbour in others),
        ]
        # other movable objects are no obstacles in this map; `apart` has their distances
        free = replace(workspace, supports=workspace.supports | set(others))
        maps = proposition_maps(formulas, self._regions, self._sample, name, free)
        met = dict(zip(about, map(surplus, maps.lower, maps.upper, about), strict=True))
        measured = zip(others, maps.lower[len(about) :], strict=True)
        apart = {neighbour: low - workspace.clearance for neighbour, low in measured}
        reached = np.broadcast_to(workspace.within_reach(maps.grid), maps.clearance.shape)
        clearance = np.where(reached, maps.clearance - workspace.clearance, -np.inf)
        standing = dict(zip(maps.obstacles, maps.distances, strict=True))
        return _Field(maps.turns, clearance, standing, apart, met)

    def _meeting_cells(self, field: _Field, name: str, chosen: tuple[str, ...]) -> Booleans:
        """Return the cells that meet all demands that concern no other chosen object."""
        met = np.ones(field.clearance.shape, np.bool_)
        for demand, values in field.surplus.items():
            if all(movable == name or movable not in chosen for movable in self._about[demand]):
                met &= values >= -self._slack
        return met

    def _domains(self, chosen: tuple[str, ...]) -> dict[str, Booleans] | None:
        """Return the possible cells of each chosen object, without regard to the other chosen ones."""
        domains = {}
        for name in chosen:
            if (field := self._field(name)) is None:
                return None
            domain = (field.clearance > -self._slack) & self._meeting_cells(field, name, chosen)
            for neighbour, apart in field.apart.items():
                if neighbour not in chosen:
                    domain = domain & (apart > -self._slack)
            domains[name] = domain
        return domains

    # ------------------------------------------------------------------------------------ two objects

    def _conflicts(
        self, chosen: tuple[str, ...], domains: Mapping[str, Booleans]
    ) -> dict[tuple[str, str], Booleans]:
        """Return the conflicts of each pair by the vector between its objects, (A, B, rows, columns)."""
        conflicts = {}
        # turns without possible cells are not measured
        used = {name: np.asarray(cells.any(axis=(1, 2))) for name, cells in domains.items()}
        for first, second in combinations(chosen, 2):
            if (stencil := self._stencil(first, second, chosen, used)) is not None:
                # both objects may be off the centres of their cells, so twice the slack is allowed
                conflicts[first, second] = is_conflict = stencil < -2.0 * self._slack
                # seen from the second object, the vector has the opposite sign
                conflicts[second, first] = is_conflict.transpose(1, 0, 2, 3)[:, :, ::-1, ::-1]
        return conflicts

    def _stencil(
        self, first: str, second: str, chosen: tuple[str, ...], used: Mapping[str, Booleans]
    ) -> Floats | None:
        """Return the least surplus of the demands on two objects; -inf for turns that are not measured."""
        demands = [
            demand
            for demand in self._demands
            if set(self._about[demand]) & set(chosen) == {first, second}
            and _is_of(demand.formula, (first, second))
        ]
        first_object, second_object = self._movable[first], self._movable[second]
        size, grid = self._grid.cell_size, self._grid
        supports = self._settings.workspace.supports
        apart = first not in supports and second not in supports
        reach = (
            radius_of(first_object) + radius_of(second_object) + self._settings.workspace.clearance
        ) / size + 1.0
        # without demands only contact matters, so the stencil ends where the objects cannot touch
        half = max(grid.shape) - 1 if demands else min(math.ceil(reach), max(grid.shape) - 1)
        turns, side = self._fields[first].turns, 2 * half + 1
        cells = side * side * int(used[first].sum()) * int(used[second].sum())
        if not (demands or apart) or cells > _WIDEST:
            return None
        key = first, second, *demands, used[first].tobytes(), used[second].tobytes()
        if key in self._stencils:
            return self._stencils[key]
        local = Grid(-(half + 0.5) * size, -(half + 0.5) * size, size, side, side)
        formulas = [demand.formula for demand in demands]
        workspace, measured = self._turned_in(local, used[second])
        met = np.full((len(turns), len(used[second]), side, side), -np.inf)
        for number in np.flatnonzero(used[first]).tolist():
            turn = float(turns[number])
            objects = {first: moved_object(first_object, 0.0, 0.0, turn), second: second_object}
            sample = Sample(self._sample.time_ns, objects, self._sample.signals)
            maps = proposition_maps(formulas, self._regions, sample, second, workspace)
            surpluses = list(map(surplus, maps.lower, maps.upper, demands))
            if apart:
                surpluses.append(maps.clearance - self._settings.workspace.clearance - _STRICTLY)
            met[number, measured] = np.minimum.reduce(surpluses)
        self._stencils[key] = met
        return met

    def _turned_in(self, grid: Grid, used: Booleans) -> tuple[Workspace, list[int]]:
        """Return a workspace without obstacles for the used turns, and the indices of these turns."""
        yaws, keeps = self._settings.workspace.yaws, self._settings.workspace.keeps_yaw
        if len(used) == 1:
            return Workspace(grid, () if keeps else yaws), [0]
        first = int(keeps)
        numbers = [number for number in range(first, len(used)) if used[number]]
        used_yaws = tuple(yaws[number - first] for number in numbers)
        return Workspace(grid, used_yaws, keeps_yaw=keeps), [*range(first), *numbers]

    # ----------------------------------------------------------------------------------------- search

    def _placements(
        self,
        cells: dict[str, Cell],
        domains: Mapping[str, Booleans],
        stencils: Mapping[tuple[str, str], Booleans],
    ) -> Iterator[dict[str, Cell]]:
        if not domains:
            yield cells
            return
        name = min(domains, key=lambda movable: int(domains[movable].sum()))
        others = {movable: domain for movable, domain in domains.items() if movable != name}
        for cell in self._choices(name, domains[name], others, stencils):
            if self._visits >= _MOST_VISITS:
                return
            self._visits += 1
            left = {
                movable: domain & ~_conflicts(stencils.get((name, movable)), cell, domain.shape)
                for movable, domain in others.items()
            }
            if all(domain.any() for domain in left.values()):
                yield from self._placements({**cells, name: cell}, left, stencils)

    def _choices(
        self,
        name: str,
        domain: Booleans,
        others: Mapping[str, Booleans],
        stencils: Mapping[tuple[str, str], Booleans],
    ) -> Iterator[Cell]:
        """Yield some cells: the most robust cell, the cell that leaves most to the others, and corners."""
        score = self._score(name)
        left = np.ones(domain.shape)
        for movable, cells in others.items():
            if (stencil := stencils.get((name, movable))) is not None:
                left = np.minimum(left, 1.0 - _count_losses(cells, stencil) / max(int(cells.sum()), 1))
        ranked = [(domain & (left >= _ENOUGH), score), (domain & (left > 0.0), left), (domain, score)]
        choices = [_best(among, values, score) for among, values in ranked if among.any()]
        rows, columns = np.indices(domain.shape, np.float64)[1:]
        among = domain & (left > 0.0)
        if among.any():
            choices += [_best(among, coordinate, left) for coordinate in (rows, -rows, columns, -columns)]
        yield from dict.fromkeys(choices)

    def _score(self, name: str) -> Floats:
        """Return the score of each cell of an object, without regard to other chosen objects."""
        field, settings = self._fields[name], self._settings
        gaps = np.minimum.reduce([field.clearance, *field.apart.values()])
        room = gaps + settings.workspace.clearance
        surpluses = [field.surplus[demand] for demand in field.surplus if self._about[demand] == (name,)]
        if surpluses:
            score: Floats = np.minimum.reduce(surpluses)
            # cells with too little room, and turns of pushed objects, come after all others
            is_last = room < settings.room
            is_last[1:] |= settings.workspace.keeps_yaw
            # more than the range of all scores
            behind = 2.0 * float(abs(score[np.isfinite(score)]).max(initial=1.0))
            return score - np.where(is_last, behind, 0.0)
        if settings.skill == "place":
            return np.asarray(np.minimum(room, 1e9))
        away = distance_to([centre_of(self._movable[name].footprint)], self._grid)
        return np.asarray(np.broadcast_to(-away, field.clearance.shape))

    # ------------------------------------------------------------------------------------------ poses

    def _pose(self, name: str, cell: Cell) -> Pose:
        x, y = self._grid.centre(cell[1], cell[2])
        return x, y, float(self._fields[name].turns[cell[0]])

    def _settle(self, poses: Mapping[str, Pose]) -> dict[str, Pose] | None:
        """Return poses near `poses` that meet all demands and touch nothing; None if none are found.

        Each step goes to the nearest places that meet the demands, which are linearized at this step and at
        previous steps.
        """
        workspace, size = self._settings.workspace, self._grid.cell_size
        # obstacles become objects, so that distances to them are demands like all others
        obstacles = {
            f"obstacle {number}": TrackedObject(obstacle)
            for number, obstacle in enumerate(workspace.obstacles)
        }
        sample = with_objects(self._sample, obstacles)
        others = [name for name in sample.objects if name not in workspace.supports]
        pairs = {
            frozenset((name, neighbour))
            for name in poses
            for neighbour in others
            if name not in workspace.supports
        }
        # sorted, because the order of a set of texts differs between processes, and plans must be equal
        apart = [
            Demand(distance_between(*sorted(pair)), True, workspace.clearance)
            for pair in sorted(pairs, key=sorted)
            if len(pair) == 2
        ]
        demands = [*self._demands, *apart]
        start = np.array([pose[:2] for pose in poses.values()])
        for towards in _TOWARDS:
            places, cuts, best, stalled = start, list[tuple[Floats, Floats]](), -math.inf, 0
            for _ in range(_MOST_STEPS):
                if not self._budget.spend(_STEP):
                    return None
                met, slopes = self._slopes(sample, demands, poses, places)
                stalled = stalled + 1 if met.min() <= best + 1e-3 * size else 0
                best = max(best, float(met.min()))
                if (met >= _STRICTLY).all() and self._grid.contains(places).all():
                    return {
                        name: (*place, poses[name][2])
                        for name, place in zip(poses, places.tolist(), strict=True)
                    }
                if stalled > _MOST_STALLED:
                    break
                # demands that are met by far do not limit the step
                near = met < 2.0 * size
                normals = slopes[near].reshape(-1, places.size)
                least = normals @ places.ravel() - met[near] + towards * size
                cuts = [*cuts, (normals, least)][-_OLDEST_CUTS:]
                every = (np.concatenate(arrays) for arrays in zip(*cuts, strict=True))
                places = nearest_meeting(places.ravel(), *every).reshape(-1, 2)
        return None

    def _slopes(
        self, sample: Sample, demands: Sequence[Demand], poses: Mapping[str, Pose], places: Floats
    ) -> tuple[Floats, Floats]:
        """Return the surplus of demands (D,) with objects at places (N, 2), and its slopes (D, N, 2)."""
        # slopes are forward differences
        step = 1e-4 * self._grid.cell_size
        objects: dict[str, TrackedObject] = {}
        nudges: list[tuple[str, TrackedObject]] = []
        for name, place in zip(poses, places, strict=True):
            objects[name], *nudged = moved_copies(
                sample.objects[name], place + step * _NUDGES, poses[name][2]
            )
            nudges += ((name, tracked) for tracked in nudged)
        scene = with_objects(sample, objects)
        # each sample gets a later time, because the times of a trace must increase
        samples = [
            scene,
            *(
                with_objects(scene, {name: tracked}, number)
                for number, (name, tracked) in enumerate(nudges, 1)
            ),
        ]
        trace = Trace.from_samples(samples)
        leaves = leaf_values(TraceScene(trace, self._regions), [demand.formula for demand in demands], {})
        values = np.stack(
            [leaves[0][n] if demand.wanted else -leaves[-1][n] for n, demand in enumerate(demands)]
        )
        values -= np.array([[demand.least] for demand in demands])
        return values[:, 0], ((values[:, 1:] - values[:, :1]) / step).reshape(-1, *places.shape)

    def meets(self, sample: Sample) -> bool:
        """Return whether a sample meets all demands."""
        return all(value >= 0.0 for value in self._surplus_in(sample))


def _standing_text(names: Sequence[str]) -> str:
    """Return the beginning of a sentence on immovable objects, with the first names; "" without names."""
    said = [name or "an obstacle of the workspace" for name in names[:_MOST_NAMED]]
    verb = "stand" if len(said) > 1 else "stands"
    return f"{' and '.join(said)}, which cannot be moved, {verb}" if said else ""


def _best(among: Booleans, values: Floats, then: Floats) -> Cell:
    """Return the cell with the greatest value; among equal ones, the cell with the greatest `then`."""
    best = np.where(among, values, -np.inf)
    ties = best == best.max()
    place = int(np.argmax(np.where(ties, then, -np.inf)))
    turn, row, column = np.unravel_index(place, among.shape)
    return int(turn), int(row), int(column)


def _conflicts(stencil: Booleans | None, cell: Cell, shape: tuple[int, ...]) -> Booleans:
    """Return the cells (B, rows, columns) of the second object that conflict with a cell of the first."""
    conflicts = np.zeros(shape, np.bool_)
    if stencil is None:
        return conflicts
    turn, *place = cell
    half = stencil.shape[2] // 2
    inside, of_stencil = [], []
    for at, size in zip(place, shape[1:], strict=True):
        low, high = max(at - half, 0), min(at + half + 1, size)
        inside.append(slice(low, high))
        of_stencil.append(slice(low - at + half, high - at + half))
    conflicts[:, inside[0], inside[1]] = stencil[turn][:, of_stencil[0], of_stencil[1]]
    return conflicts


def _count_losses(cells: Booleans, stencil: Booleans) -> Floats:
    """Return how many cells of the second object conflict with each cell of the first, (A, rows, columns).

    The counts are correlations of cells and stencil, computed by Fourier transforms.
    """
    half = stencil.shape[2] // 2
    rows, columns = cells.shape[1:]
    padded = np.fft.rfft2(np.pad(cells.astype(np.float64), ((0, 0), (half, half), (half, half))))
    shape = (rows + 2 * half, columns + 2 * half)
    kernels = np.fft.rfft2(stencil.astype(np.float64), s=shape)
    lost = np.fft.irfft2((padded[None] * kernels.conj()).sum(axis=1), s=shape)
    # counts are whole numbers, so rounding removes the errors of the transforms
    return np.rint(lost[:, :rows, :columns])


def _is_of(formula: Formula, names: Sequence[str]) -> bool:
    """Return whether a formula depends only on some objects."""
    for part in iter_formulas(formula):
        if isinstance(part, Quantified):
            return False
        terms = terms_of(part.expression) if isinstance(part, Atom) else ()
        for term in terms:
            base = base_of(term)
            if not (isinstance(base, TrackedName) and base.name in names):
                return False
    return True


# ---------------------------------------------------------------------------------------------- motions ahead

MOST_MAPS: Final = 230
"""Maximum number of maps of one decision; the evaluation of one sample counts as a quarter of a map."""
_MOST_WHY_NOT: Final = 60
"""Maximum number of maps for the reason of an infeasible task, after a decision without a result."""
_JOINT_SHARE: Final = 0.4
"""Maximum share of the remaining maps for one conjunction of demands on several objects."""
_HOPELESS_SHARE: Final = 0.5
"""Share of the remaining maps for finding edges that no arrangement can take."""
_MOST_EDGES: Final = 12
"""Maximum number of edges to try from one predicted state."""
_MOST_ORDERED: Final = 6
"""Maximum number of arrangements for which an order of motions is searched."""
_NOT_FOUND: Final = "no arrangement of objects brings it about"
_STILL_TURN: Final = math.radians(1.0)
"""Turn up to which an object counts as staying, radians."""


class Lookahead:
    """Search for motions from one sample to acceptance, for one decision."""

    def __init__(self, expected: Expectations, sample: Sample) -> None:
        """Begin from the newest sample of a run."""
        self._expected, self._first = expected, PredictedState(sample)
        self._automaton, self._formulas = expected.automaton, expected.formulas
        self._regions, self._settings = expected.regions, expected.settings
        self.movables = expected.movables(self._first)
        """The movable objects of the newest sample."""
        self._pruned: set[Edge] = set()
        self._known: dict[tuple[int, Moved], tuple[Target, ...] | None] = {}
        self._why: dict[str, None] = {}
        self._unordered = ""
        self._ruled_out: frozenset[Edge] = frozenset()

    def decide(
        self,
        consideration: Consideration,
        path: tuple[Transition, ...],
        pruned: Collection[Edge],
        *,
        together: bool = False,
    ) -> Consideration:
        """Return an edge with a candidate from which acceptance can be reached; pruned if there is none.

        With the setting `motions` = 1, there is no lookahead.

        Args:
            consideration: edge with the candidates that can take it by one motion, or pruned.
            path: path that begins with the edge.
            pruned: pruned edges.
            together: whether several motions may take the edge, and an object may be moved twice.
        """
        if self._settings.motions == 1:
            return consideration
        self._pruned = set(pruned)
        self._why.clear()
        for sequence in islice(self._joint(self._first, path, consideration), 4) if together else ():
            if (rest := self._ahead(sequence.scene, sequence.state)) is not None:
                return self._with_first_motion(consideration, sequence, rest)
        order = by_cost(consideration.candidates, self._settings)
        for number, target in order.items():
            if (rest := self._after(target, path[0])) is None:
                continue
            names = [target.name, *(motion.name for motion in rest)]
            if together or len(set(names)) == len(names):
                return choose_candidate(consideration, number, (target, *rest))
        if not order:
            return consideration
        why = "; ".join(islice(self._why, 3)) or "no sequence of motions was found"
        reason = Reason(LATER, why if together else f"not by one motion: {why}")
        return replace(choose_candidate(consideration, None), pruned=reason)

    # ------------------------------------------------------------------------------------ one at a time

    def _ahead(self, scene: PredictedState, state: int) -> tuple[Target, ...] | None:
        """Return motions from a state to acceptance; None if none are found."""
        if state in self._automaton.accepting:
            return ()
        key = state, scene.moved
        if key not in self._known:
            # None for now, so that a search that returns to this scene and state gives up
            self._known[key] = None
            self._known[key] = self._search(scene, state)
        return self._known[key]

    def _search(self, scene: PredictedState, state: int) -> tuple[Target, ...] | None:
        automaton, symbol = self._automaton, self._expected.symbol(scene)
        idle = idle_transitions(automaton, state, symbol)
        pruned = self._pruned - idle.edges
        looked_into: list[tuple[tuple[Transition, ...], Consideration]] = []
        while len(looked_into) < _MOST_EDGES and self._expected.budget.left > 0:
            pruned |= self._ruled_out
            if (path := next(automaton.paths(state, pruned), None)) is None:
                break
            if ahead := idle.along(path):
                return self._ahead(scene, ahead[-1])
            consideration = consideration_of(automaton, path, pruned, symbol)
            for sequence in self._ways(scene, path, consideration):
                if (rest := self._ahead(sequence.scene, sequence.state)) is not None:
                    return (*sequence.motions, *rest)
            looked_into.append((path, consideration))
            pruned.add(consideration.edge)
            pruned |= set(equivalent_edges(automaton, consideration, idle, pruned, symbol))
        # only after single motions have failed, because finding hopeless edges costs maps
        self._ruled_out = self._hopeless
        for path, consideration in looked_into:
            for sequence in islice(self._joint(scene, path, consideration), 2):
                if (rest := self._ahead(sequence.scene, sequence.state)) is not None:
                    return (*sequence.motions, *rest)
        return None

    def _ways(
        self, scene: PredictedState, path: tuple[Transition, ...], consideration: Consideration
    ) -> Iterator[Ordered]:
        """Yield single motions that take the first edge of a path, with the resulting scene and state."""
        movables = self._expected.movables(scene)
        candidates: list[Candidate] = []
        later = moved_later(path, self._expected.symbol(scene), self._formulas, movables.names)
        for name in movables.names_for(consideration.progress):
            if not self._expected.budget.spend():
                return
            candidates.append(movables.candidate(name, consideration, later))
        for target in by_cost(candidates, self._settings).values():
            after = scene.after(target.name, target.pose)
            if self._expected.states_after(after, path[0].source) == {path[0].target}:
                yield Ordered((target,), after, path[0].target)
        if not any(candidate.target for candidate in candidates):
            causes = "; ".join(f"{candidate.name}: {candidate.rejected}" for candidate in candidates)
            self._why[f"{consideration.progress}: {causes or 'nothing that can be moved matters to it'}"] = (
                None
            )

    def _after(self, target: Target, edge: Transition) -> tuple[Target, ...] | None:
        """Return the motions to acceptance after a first motion; () if the state after it is uncertain."""
        scene = self._first.after(target.name, target.pose)
        states = self._expected.states_after(scene, edge.source)
        return () if len(states) > 1 else self._ahead(scene, *states)

    # ------------------------------------------------------------------------------------ all together

    def _joint(
        self, scene: PredictedState, path: tuple[Transition, ...], consideration: Consideration
    ) -> Iterator[Ordered]:
        """Yield motions of several objects that take a whole path, or its first edge."""
        if self._settings.motions < 2:
            return
        numbers = count(1)
        # the whole path first, then only its first edge
        for length in dict.fromkeys((len(path), 1)):
            aims = path[:length]
            if any((aim.source, aim.target) in self._ruled_out for aim in aims):
                continue
            if scene is self._first:
                yield from self._resume(aims, consideration)
            for demands in self._demands_of(scene, aims):
                # a share of the maps is reserved for other edges
                least = self._expected.budget.left * (1.0 - _JOINT_SHARE)
                about = Arranger(scene.sample, self._regions, self._settings, demands, self._expected.budget)
                if self._expected.budget.left <= 0 or about.why_hopeless():
                    continue
                arrangements: Iterable[dict[str, Pose]] = islice(
                    about.arrangements(self._settings.motions), _MOST_ORDERED
                )
                if self._expected.attempts.are_any:
                    # a motion may fail by chance, so places of failed motions are tried after all others
                    arrangements = sorted(arrangements, key=self._is_near_failure)
                for number, poses in zip(numbers, arrangements, strict=False):
                    for sequence in self._ordered_from(scene, aims, consideration, about, poses, least):
                        yield sequence._replace(arrangement=number)

    def _resume(self, aims: Sequence[Transition], consideration: Consideration) -> Iterator[Ordered]:
        """Yield the motions to the places of the last decision, if they still take the edges.

        A new arrangement may need more motions than the old plan has left, and its motions may undo earlier
        motions.
        """
        scene, states = self._first, frozenset({aims[0].source})
        places: dict[str, Pose] = {}
        for motion in self._expected.attempts.planned:
            scene = scene.after(motion.name, motion.pose)
            states = self._automaton.step_set(states, self._expected.symbol(scene))
            places[motion.name] = dict(scene.moved)[motion.name]
            if states == {aims[-1].target}:
                robustness = self._expected.robustness(scene.sample, aims[0].guard)
                never = consideration.constraints.cubes
                order = MotionOrder(self._expected, self._first, aims, never, places, robustness, 0.0)
                if (sequence := order.find()) is not None:
                    yield sequence
                return

    def _demands_of(self, scene: PredictedState, aims: Sequence[Transition]) -> Iterator[tuple[Demand, ...]]:
        """Yield conjunctions of demands that take all edges and avoid traps."""
        never = self._expected.traps(aims[0].source)
        safety_demands: list[Demand] = []
        # slightly more than the margin, so that rounding does not leave a constraint at it
        least = self._settings.constraint_margin * (1.0 + 1e-9) + _STRICTLY
        for cube in never:
            if len(cube) == 1:
                ((number, value),) = cube
                ways = alternatives(self._formulas[number], not value)
                if len(ways) == 1:
                    safety_demands += (Demand(*literal, least) for literal in ways[0])
        # at most eight combinations of cubes, because their number grows exponentially with the path
        for cubes in islice(product(*(aim.guard for aim in aims)), 8):
            literals = tuple(dict.fromkeys(literal for cube in cubes for literal in cube))
            if any((number, not value) in literals for number, value in literals):
                continue
            for demands in demands_of(literals, self._formulas, self._settings.margin):
                yield (*demands, *safety_demands)

    def _is_near_failure(self, poses: Mapping[str, Pose]) -> bool:
        """Return whether an arrangement brings an object near a place where its motion failed."""
        near = AVOIDED_CELLS * self._settings.workspace.grid.cell_size
        return any(
            math.dist(pose[:2], place) <= near
            for name, pose in poses.items()
            for place in self._expected.attempts.places_of(name)
        )

    def _ordered_from(
        self,
        scene: PredictedState,
        aims: Sequence[Transition],
        consideration: Consideration,
        about: Arranger,
        poses: Mapping[str, Pose],
        least: float,
    ) -> Iterator[Ordered]:
        """Yield the motions to an arrangement in a possible order, if one is found."""
        self._expected.budget.arrangements += 1
        poses = self._without_staying(scene, about, poses)
        robustness = self._expected.robustness(move_objects(scene.sample, poses), aims[0].guard)
        never = consideration.constraints.cubes
        order = MotionOrder(self._expected, scene, aims, never, poses, robustness, least)
        if (sequence := order.find()) is not None:
            yield sequence
        elif scene is self._first and len(poses) > 1 and not self._unordered:
            self._unordered = " and ".join(sorted(poses))

    def _without_staying(
        self, scene: PredictedState, about: Arranger, poses: Mapping[str, Pose]
    ) -> Mapping[str, Pose]:
        """Return an arrangement without objects that barely move, if it meets the demands without them."""
        for name in list(poses):
            x, y, turn = poses[name]
            others = {moved: pose for moved, pose in poses.items() if moved != name}
            away = math.dist((x, y), centre_of(scene.sample.objects[name].footprint))
            is_still = away <= self._settings.workspace.grid.cell_size and abs(turn) <= _STILL_TURN
            if is_still and about.meets(move_objects(scene.sample, others)):
                poses = others
        return poses

    def _with_first_motion(
        self,
        consideration: Consideration,
        sequence: Ordered,
        rest: tuple[Target, ...],
    ) -> Consideration:
        """Return an edge with the first of several motions as its chosen candidate."""
        motions = sequence.motions
        first, sample = motions[0], self._first.sample
        # a parked object goes to its own place later, so the pose of its first motion is not final
        poses = {motion.name: motion.pose for motion in motions[1:] if motion.name != first.name}
        settings, now = self._settings, self.movables.maps_of(first.name)
        then = proposition_maps(
            self._formulas,
            self._regions,
            move_objects(sample, poses),
            first.name,
            settings.workspace,
            now.grid,
        )
        cubes = consideration.progress.cubes, consideration.constraints.cubes
        gradient = gradient_map(now, *cubes, settings.workspace, settings.constraint_margin, then)
        final_sample = move_objects(sample, {**poses, first.name: first.pose})
        target = replace(
            first, robustness=self._expected.robustness(final_sample, consideration.progress.cubes)
        )
        if all(motion.name != first.name for motion in motions[1:]):
            target = self._refine(target, consideration, poses, (*motions[1:], *rest))
        candidate = Candidate(first.name, gradient, target, is_chosen=True, rule=sequence.rule)
        rivals = (rival for rival in consideration.candidates if rival.name != first.name)
        others = tuple(replace(rival, is_chosen=False) for rival in rivals)
        planned = (target, *motions[1:], *rest)
        return replace(
            consideration, candidates=(*others, candidate), pruned=None, motions=planned, is_joint=True
        )

    def _refine(
        self,
        target: Target,
        consideration: Consideration,
        poses: Mapping[str, Pose],
        rest: tuple[Target, ...],
    ) -> Target:
        """Return the first of several motions with a refined target, if the later states stay the same."""
        start, *way, end = target.waypoints
        way = way if self._settings.skill == "push" else []
        straight = replace(target, waypoints=(start, *way, end))
        better = self.movables.refine(straight, consideration, None, poses)
        ways = self.movables.with_way(better, consideration.constraints.cubes)
        if isinstance(ways, str) or self.movables.is_repeated(ways) or better.robustness <= target.robustness:
            return target
        state = consideration.edge[0]
        before, after = (self._states_along((first, *rest), state) for first in (target, ways))
        return ways if before == after else target

    def _states_along(self, motions: Sequence[Target], state: int) -> list[frozenset[int]]:
        """Return the possible states after each motion, from the newest sample on."""
        scene, states, visited = self._first, frozenset({state}), []
        for motion in motions:
            scene = scene.after(motion.name, motion.pose)
            states = self._automaton.step_set(states, self._expected.symbol(scene))
            visited.append(states)
        return visited

    # --------------------------------------------------------------------------------------- what is seen

    @cached_property
    def _hopeless(self) -> frozenset[Edge]:
        """The edges that need a literal that no arrangement of the objects can fulfil."""
        return self._needing(self._hopeless_literals)

    def _needing(self, literals: Collection[tuple[int, bool]]) -> frozenset[Edge]:
        """Return the edges whose guards need one of these literals in every cube."""
        if not self._automaton.is_listable:
            return frozenset()
        return frozenset(
            (transition.source, transition.target)
            for transition in self._automaton.transitions
            if all(any(literal in literals for literal in cube) for cube in transition.guard)
        )

    @cached_property
    def _hopeless_literals(self) -> tuple[tuple[int, bool], ...]:
        """The literals that no arrangement of the objects can fulfil."""
        if not self._automaton.is_listable:
            return ()
        symbol = self._expected.symbol(self._first)
        literals = {
            literal
            for transition in self._automaton.transitions
            for cube in transition.guard
            for literal in cube
        }
        hopeless: list[tuple[int, bool]] = []
        budget = Budget(self._expected.budget.left * _HOPELESS_SHARE)
        for number, value in sorted(literals):
            # a literal that holds now is not hopeless; `is`, because None is unknown
            if symbol[number] is (not value) and budget.left > 0:
                why = self._why_hopeless(self._first.sample, number, value, budget)
                if why:
                    hopeless.append((number, value))
                    self._why[f"{self._automaton.propositions[number].literal(value)}: {why}"] = None
        self._expected.budget.spend(self._expected.budget.left * _HOPELESS_SHARE - budget.left)
        return tuple(hopeless)

    def why_not(self, state: int) -> str:
        """Return the infeasible condition of every path to acceptance, and the objects in the way.

        Without such a condition, return a sentence on objects for whose motions no order was found, or "".
        """
        for literal in self._hopeless_literals:
            if next(self._automaton.paths(state, self._needing({literal})), None) is None:
                return self._why_never(self._first.sample, literal)
        if not self._unordered:
            return ""
        return f"{self._unordered}: there are places for all, but no order of motions to them was found"

    def _why_never(self, sample: Sample, literal: tuple[int, bool]) -> str:
        """Return the demands of a literal that no arrangement meets, and the objects in the way."""
        budget = Budget(_MOST_WHY_NOT)
        every = demands_of((literal,), self._formulas, self._settings.margin)
        demands = next(iter(every), ())
        # demands that are not needed for the conflict are dropped, so that the reason names few demands
        core = list(demands)
        for demand in reversed(demands):
            fewer = tuple(member for member in core if member != demand)
            if fewer and budget.left > 0 and self._why_impossible(sample, fewer, budget):
                core = list(fewer)
        about = Arranger(sample, self._regions, self._settings, core, budget)
        what = " and ".join(literal_text(demand.formula, demand.wanted) for demand in core)
        if why := about.why_hopeless():
            return f"{what}: {'; '.join(filter(None, (why, about.cell_hint(self._settings.motions))))}"
        stands = about.what_stands()
        said = "no places were found for all at once", stands, about.cell_hint(self._settings.motions)
        return f"{what}: {'; '.join(filter(None, said))}"

    def _why_impossible(self, sample: Sample, demands: Sequence[Demand], budget: Budget) -> str:
        """Return "" if an arrangement meets demands, or else why none does, or that none was found."""
        about = Arranger(sample, self._regions, self._settings, demands, budget)
        why = about.why_hopeless()
        arrangement = None if why else next(about.arrangements(self._settings.motions), None)
        return why or (_NOT_FOUND if arrangement is None else "")

    def _why_hopeless(self, sample: Sample, number: int, wanted: bool, budget: Budget) -> str:
        why = "it never holds"
        for demands in demands_of(((number, wanted),), self._formulas, self._settings.margin):
            why = self._why_impossible(sample, demands, budget)
            if not why or (why == _NOT_FOUND and budget.left <= 0):
                return ""
        return why

"""Lookahead: a search for motions from a sample to acceptance, over predicted samples.

A predicted motion brings its object to the target at once. Objects are moved one at a time if possible.
Otherwise, or if an object would have to be moved twice, several objects are arranged together.

An arrangement assigns cells to several objects: a constraint satisfaction problem over the cells of a grid.
The demands on one object are a map. The demands on two objects depend only on the vector between the
objects, and are a stencil. The object with the fewest remaining cells comes first. Its cells are ordered by
robustness, and by the number of cells that each cell leaves to the other objects.
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
"""Maximum number of cells of a stencil, over all orientations.

A pair of objects that needs more cells has no stencil. Its demands are tested only in finished arrangements.

Two objects on 300 x 300 cells need this number, if they are not turned. Without stencils, most placements
fail.
"""
_MISS: Final = 0.5
"""Cost of a placement that does not meet all demands, maps.

The search for a placement tests all cells of the other objects.
"""
_MOST_NAMED: Final = 3
"""Maximum number of objects that a sentence names."""
_ENOUGH: Final = 0.5
"""Least share of cells that a cell chosen by robustness must leave to each other object."""
_STRICTLY: Final = 1e-12
"""Least margin of a constraint, because a constraint holds at robustness 0."""
_MOST_BETWEEN: Final = 3
"""Maximum number of sets, and of arrangements of each set, to try for places between cells."""
_MOST_STEPS: Final = 12
"""Maximum number of steps that move objects from cells to places between cells."""
_MOST_STALLED: Final = 2
"""Maximum number of steps between cells without a gain."""
_STEP: Final = 0.5
"""Cost of a step between cells, maps."""
_TOWARDS: Final = (1.0 / 16.0, 1e-6)
"""Margins of demands at places between cells, as shares of a cell, in the order in which they are tried."""
_NUDGES: Final = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
"""Displacements (x, y) that measure slopes, in small steps; the first displacement is zero."""
_OLDEST_CUTS: Final = 4
"""Number of previous steps whose linearized demands are kept."""

Cell: TypeAlias = tuple[int, int, int]
"""Index of an object's turn, and row and column of its centre."""


@dataclass(frozen=True, eq=False)
class _Field:
    """Values of one object's cells, with all other objects in place.

    Attributes:
        turns: (A,), angles by which the object is turned, radians.
        clearance: (A, rows, columns), distance to immovable objects minus the required clearance; -inf for
            cells out of reach.
        obstacle_distances: distance to each immovable object by name; "" is for the workspace's obstacles.
        gaps: distance to each other movable object by name, minus the required clearance.
        surplus: surplus of each demand on the object.
    """

    turns: Floats
    clearance: Floats
    obstacle_distances: Mapping[str, Floats]
    gaps: Mapping[str, Floats]
    surplus: Mapping[Demand, Floats]


class Arranger:
    """Search for arrangements of movable objects that meet demands, in one sample."""

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
        movable_names = sorted(sample.objects) if settings.movable is None else settings.movable
        self._movable = {name: sample.objects[name] for name in movable_names if name in sample.objects}
        self._names_by_demand = {demand: self._names(demand) for demand in self._demands}
        self._fields: dict[str, _Field] = {}
        self._stencils: dict[tuple[object, ...], Floats] = {}
        self._visit_count = 0
        # allowed shortfall of a demand at a cell's centre; another place in the cell may meet the demand
        self._slack = 0.0
        self._is_placed = settings.refine and settings.skill == "place"

    def _names(self, demand: Demand) -> tuple[str, ...]:
        return tuple(name for name in self._movable if concerns(demand.formula, name))

    @cached_property
    def _unmet_demands(self) -> tuple[Demand, ...]:
        demand_surpluses = zip(self._demands, self._surplus_in(self._sample), strict=True)
        return tuple(demand for demand, value in demand_surpluses if value < 0.0)

    def _surplus_in(self, sample: Sample) -> list[float]:
        values = values_in(sample, [demand.formula for demand in self._demands], self._regions)
        return list(map(surplus, *values, self._demands))

    def why_hopeless(self) -> str:
        """Return the reason why no arrangement can meet the demands; "" if no single object proves this."""
        for demand in self._unmet_demands:
            if not self._names_by_demand[demand]:
                return "no object that can be moved matters to it"
        for name in self._movable:
            demands = [demand for demand in self._demands if self._names_by_demand[demand] == (name,)]
            if (
                demands
                and any(demand in self._unmet_demands for demand in demands)
                and (field := self._field(name)) is not None
            ):
                least_surplus = np.minimum.reduce([field.surplus[demand] for demand in demands])
                tolerance = -self._corner_distance if self._is_placed else 0.0
                if not ((field.clearance > tolerance) & (least_surplus >= tolerance)).any():
                    if (least_surplus >= 0.0).any():
                        standing_text = _standing_text(self._standing(field, least_surplus >= 0.0))
                        return (
                            f"{standing_text or 'the robot does not reach'} wherever {name} would have to be"
                        )
                    shortfall = -float(least_surplus[field.clearance > 0.0].max(initial=-math.inf))
                    sentence = f"{name}: nowhere would all of it hold, {shortfall:.4g} is missing at best"
                    seams = seam_texts((demand.formula for demand in demands), self._regions)
                    return "; ".join([sentence, *seams])
        return ""

    @property
    def _corner_distance(self) -> float:
        """The distance from the centre of a cell to its corners."""
        return self._grid.cell_size / math.sqrt(2.0)

    def what_stands(self) -> str:
        """Return a sentence on immovable objects at possible places of movable objects, or ""."""
        object_names: dict[str, None] = {}
        for name, field in self._fields.items():
            cells = self._meeting_cells(field, name, tuple(self._movable))
            if not cells.all():
                object_names |= dict.fromkeys(self._standing(field, cells))
        return f"{_standing_text(list(object_names))} there" if object_names else ""

    def _standing(self, field: _Field, cells: Booleans) -> list[str]:
        """Return the immovable objects that occupy some of `cells`, sorted by descending number of cells."""
        clearance = self._settings.workspace.clearance
        cell_counts = {
            name: int((cells & (distance <= clearance)).sum())
            for name, distance in field.obstacle_distances.items()
        }
        return sorted(
            (name for name in cell_counts if cell_counts[name]), key=lambda name: -cell_counts[name]
        )

    def arrangements(self, most: int) -> Iterator[dict[str, Pose]]:
        """Yield arrangements, first for the smallest sets of objects.

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
        """Return the advice to use smaller cells, if only places between cells meet the demands; else ""."""
        fits = not self._is_placed and next(self._between_cells(most), None) is not None
        return "smaller cells (cell_size) may help" if fits else ""

    def _between_cells(self, max_moved: int) -> Iterator[dict[str, Pose]]:
        self._slack = self._corner_distance
        try:
            yield from self._over_cells(max_moved)
        finally:
            self._slack = 0.0

    def _over_cells(self, max_moved: int) -> Iterator[dict[str, Pose]]:
        # the number in a queue entry precedes the set, so that equally good sets keep their order
        queue = [
            (self._hubs_in(group), len(group), number, group)
            for number, group in enumerate(self._bases(max_moved))
        ]
        heapq.heapify(queue)
        queued_groups = {group for *_, group in queue}
        group_count = len(queue)
        max_groups, max_attempts = (_MOST_BETWEEN,) * 2 if self._slack else (_MOST_SETS, _MOST_SOLUTIONS)
        for _ in range(max_groups):
            if not queue:
                return
            *_, group = heapq.heappop(queue)
            domains = self._domains(group)
            if domains is not None and all(domain.any() for domain in domains.values()):
                self._visit_count = 0
                stencils = self._conflicts(group, domains)
                attempt_count = 0
                for cells in self._placements({}, domains, stencils):
                    poses: dict[str, Pose] | None = {name: self._pose(name, cells[name]) for name in cells}
                    if self._slack and poses:
                        poses = self._settle(poses)
                        # a failed attempt also counts, because it spends maps
                        attempt_count += 1
                    if poses is not None and self.meets(move_objects(self._sample, poses)):
                        yield poses
                        attempt_count += 1
                    elif not self._slack and not self._budget.spend(_MISS):
                        return
                    if attempt_count >= max_attempts:
                        break
            if len(group) < max_moved and group:
                for name in self._in_the_way(group):
                    # in the order of the settings, so that equal sets are equal tuples
                    wider = tuple(movable for movable in self._movable if movable in group or movable == name)
                    if wider not in queued_groups:
                        queued_groups.add(wider)
                        group_count += 1
                        heapq.heappush(queue, (self._hubs_in(wider), len(wider), group_count, wider))

    def _bases(self, max_moved: int) -> list[tuple[str, ...]]:
        """Return the smallest sets of objects that have at least one object of every unmet demand."""
        groups: dict[tuple[str, ...], None] = {(): None}
        for demand in self._unmet_demands:
            wider_groups: dict[tuple[str, ...], None] = {}
            for group in groups:
                if any(name in group for name in self._names_by_demand[demand]):
                    wider_groups[group] = None
                    continue
                for name in self._names_by_demand[demand]:
                    wider = tuple(movable for movable in self._movable if movable in group or movable == name)
                    if len(wider) <= max_moved:
                        wider_groups[wider] = None
            # sets without hubs first, because moving only a hub seldom meets all demands on the hub
            best_groups = sorted(wider_groups, key=self._hubs_in)
            groups = dict.fromkeys(best_groups[:_MOST_SETS])
        return list(groups)

    def _hubs_in(self, group: Iterable[str]) -> int:
        """Return the number of hubs in a set: objects with unmet demands to several other objects."""
        return sum(name in self._hubs for name in group)

    @cached_property
    def _hubs(self) -> frozenset[str]:
        demand_counts = Counter(
            name for demand in self._unmet_demands for name in self._names_by_demand[demand]
        )
        object_pairs = {frozenset(self._names_by_demand[demand]) for demand in self._unmet_demands}
        # several demands on the same pair make neither object a hub
        partner_counts = Counter(name for pair in object_pairs for name in pair if len(pair) > 1)
        return frozenset(name for name in demand_counts if partner_counts[name] > 1)

    def _in_the_way(self, group: tuple[str, ...]) -> list[str]:
        """Return up to four other objects that block the chosen objects or take part in unmet demands."""
        blocked_counts = dict.fromkeys((movable for movable in self._movable if movable not in group), 0)
        for name in group:
            if (field := self._field(name)) is None:
                return []
            is_open = field.clearance > -self._slack
            cells = is_open & self._meeting_cells(field, name, group)
            if not cells.any():
                # no cell meets all demands on the object, but a partner may move to meet one,
                # so all open cells count
                cells = is_open
            for neighbour, gap in field.gaps.items():
                if neighbour in blocked_counts:
                    blocked_counts[neighbour] += int((cells & (gap <= 0.0)).sum())
        unmet_names = {name for demand in self._unmet_demands for name in self._names_by_demand[demand]}
        blockers = [movable for movable, count in blocked_counts.items() if count or movable in unmet_names]
        return sorted(blockers, key=lambda movable: (movable not in unmet_names, -blocked_counts[movable]))[
            :4
        ]

    def _field(self, name: str) -> _Field | None:
        if name not in self._fields:
            if not self._budget.spend():
                return None
            self._fields[name] = self._measure_field(name)
        return self._fields[name]

    def _measure_field(self, name: str) -> _Field:
        workspace = self._settings.workspace
        neighbours = [
            movable for movable in self._movable if movable != name and movable not in workspace.supports
        ]
        demands = [demand for demand in self._demands if name in self._names_by_demand[demand]]
        formulas = [
            *(demand.formula for demand in demands),
            *(distance_between(name, neighbour) for neighbour in neighbours),
        ]
        # other movable objects are no obstacles in this map; `apart` has their distances
        free_workspace = replace(workspace, supports=workspace.supports | set(neighbours))
        maps = proposition_maps(formulas, self._regions, self._sample, name, free_workspace)
        surpluses = dict(zip(demands, map(surplus, maps.lower, maps.upper, demands), strict=True))
        distances = zip(neighbours, maps.lower[len(demands) :], strict=True)
        gaps = {neighbour: distance - workspace.clearance for neighbour, distance in distances}
        is_reached = np.broadcast_to(workspace.within_reach(maps.grid), maps.clearance.shape)
        clearance = np.where(is_reached, maps.clearance - workspace.clearance, -np.inf)
        obstacle_distances = dict(zip(maps.obstacles, maps.distances, strict=True))
        return _Field(maps.turns, clearance, obstacle_distances, gaps, surpluses)

    def _meeting_cells(self, field: _Field, name: str, group: tuple[str, ...]) -> Booleans:
        """Return the cells that meet all demands on an object, except demands on several chosen objects."""
        is_met = np.ones(field.clearance.shape, np.bool_)
        for demand, surpluses in field.surplus.items():
            if all(movable == name or movable not in group for movable in self._names_by_demand[demand]):
                is_met &= surpluses >= -self._slack
        return is_met

    def _domains(self, group: tuple[str, ...]) -> dict[str, Booleans] | None:
        """Return the possible cells of each chosen object, regardless of the other chosen objects."""
        domains = {}
        for name in group:
            if (field := self._field(name)) is None:
                return None
            domain = (field.clearance > -self._slack) & self._meeting_cells(field, name, group)
            for neighbour, gap in field.gaps.items():
                if neighbour not in group:
                    domain = domain & (gap > -self._slack)
            domains[name] = domain
        return domains

    # ------------------------------------------------------------------------------------ two objects

    def _conflicts(
        self, group: tuple[str, ...], domains: Mapping[str, Booleans]
    ) -> dict[tuple[str, str], Booleans]:
        """Return whether each pair of objects conflicts, by their offset, (A, B, rows, columns)."""
        conflicts = {}
        # turns without possible cells are not measured
        used_turns = {name: np.asarray(cells.any(axis=(1, 2))) for name, cells in domains.items()}
        for first_name, second_name in combinations(group, 2):
            if (stencil := self._stencil(first_name, second_name, group, used_turns)) is not None:
                # both objects may be off the centres of their cells, so the slack is doubled
                conflicts[first_name, second_name] = is_conflict = stencil < -2.0 * self._slack
                # seen from the second object, the vector has the opposite sign
                conflicts[second_name, first_name] = is_conflict.transpose(1, 0, 2, 3)[:, :, ::-1, ::-1]
        return conflicts

    def _stencil(
        self, first_name: str, second_name: str, group: tuple[str, ...], used_turns: Mapping[str, Booleans]
    ) -> Floats | None:
        """Return the least surplus of the demands on two objects; -inf for turns that are not measured."""
        demands = [
            demand
            for demand in self._demands
            if set(self._names_by_demand[demand]) & set(group) == {first_name, second_name}
            and _is_of(demand.formula, (first_name, second_name))
        ]
        first_object, second_object = self._movable[first_name], self._movable[second_name]
        cell_size, grid = self._grid.cell_size, self._grid
        supports = self._settings.workspace.supports
        must_be_apart = first_name not in supports and second_name not in supports
        reach_cells = (
            radius_of(first_object) + radius_of(second_object) + self._settings.workspace.clearance
        ) / cell_size + 1.0
        # without demands only contact matters, so the stencil ends where the objects cannot touch
        half_side = max(grid.shape) - 1 if demands else min(math.ceil(reach_cells), max(grid.shape) - 1)
        turns, side = self._fields[first_name].turns, 2 * half_side + 1
        cell_count = side * side * int(used_turns[first_name].sum()) * int(used_turns[second_name].sum())
        if not (demands or must_be_apart) or cell_count > _WIDEST:
            return None
        stencil_key = (
            first_name,
            second_name,
            *demands,
            used_turns[first_name].tobytes(),
            used_turns[second_name].tobytes(),
        )
        if stencil_key in self._stencils:
            return self._stencils[stencil_key]
        local_grid = Grid(
            -(half_side + 0.5) * cell_size, -(half_side + 0.5) * cell_size, cell_size, side, side
        )
        formulas = [demand.formula for demand in demands]
        workspace, turn_indices = self._turned_in(local_grid, used_turns[second_name])
        stencil = np.full((len(turns), len(used_turns[second_name]), side, side), -np.inf)
        for turn_index in np.flatnonzero(used_turns[first_name]).tolist():
            turn = float(turns[turn_index])
            objects = {first_name: moved_object(first_object, 0.0, 0.0, turn), second_name: second_object}
            sample = Sample(self._sample.time_ns, objects, self._sample.signals)
            maps = proposition_maps(formulas, self._regions, sample, second_name, workspace)
            surpluses = list(map(surplus, maps.lower, maps.upper, demands))
            if must_be_apart:
                surpluses.append(maps.clearance - self._settings.workspace.clearance - _STRICTLY)
            stencil[turn_index, turn_indices] = np.minimum.reduce(surpluses)
        self._stencils[stencil_key] = stencil
        return stencil

    def _turned_in(self, grid: Grid, used_turns: Booleans) -> tuple[Workspace, list[int]]:
        """Return a workspace without obstacles for the used turns, and the used turns' indices."""
        yaws, keeps_yaw = self._settings.workspace.yaws, self._settings.workspace.keeps_yaw
        if len(used_turns) == 1:
            return Workspace(grid, () if keeps_yaw else yaws), [0]
        first_yaw = int(keeps_yaw)
        used_indices = [number for number in range(first_yaw, len(used_turns)) if used_turns[number]]
        used_yaws = tuple(yaws[number - first_yaw] for number in used_indices)
        return Workspace(grid, used_yaws, keeps_yaw=keeps_yaw), [*range(first_yaw), *used_indices]

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
        other_domains = {movable: domain for movable, domain in domains.items() if movable != name}
        for cell in self._choices(name, domains[name], other_domains, stencils):
            if self._visit_count >= _MOST_VISITS:
                return
            self._visit_count += 1
            remaining_domains = {
                movable: domain & ~_conflicts(stencils.get((name, movable)), cell, domain.shape)
                for movable, domain in other_domains.items()
            }
            if all(domain.any() for domain in remaining_domains.values()):
                yield from self._placements({**cells, name: cell}, remaining_domains, stencils)

    def _choices(
        self,
        name: str,
        domain: Booleans,
        other_domains: Mapping[str, Booleans],
        stencils: Mapping[tuple[str, str], Booleans],
    ) -> Iterator[Cell]:
        """Yield the most robust cell, the cell that leaves most cells to other objects, and corner cells."""
        score = self._score(name)
        shares = np.ones(domain.shape)
        for movable, cells in other_domains.items():
            if (stencil := stencils.get((name, movable))) is not None:
                shares = np.minimum(shares, 1.0 - _count_losses(cells, stencil) / max(int(cells.sum()), 1))
        rankings = [(domain & (shares >= _ENOUGH), score), (domain & (shares > 0.0), shares), (domain, score)]
        choices = [
            _best(allowed_cells, values, score) for allowed_cells, values in rankings if allowed_cells.any()
        ]
        rows, columns = np.indices(domain.shape, np.float64)[1:]
        allowed_cells = domain & (shares > 0.0)
        if allowed_cells.any():
            choices += [
                _best(allowed_cells, coordinate, shares) for coordinate in (rows, -rows, columns, -columns)
            ]
        yield from dict.fromkeys(choices)

    def _score(self, name: str) -> Floats:
        """Return the score of each cell of an object, regardless of other chosen objects."""
        field, settings = self._fields[name], self._settings
        least_gap = np.minimum.reduce([field.clearance, *field.gaps.values()])
        room = least_gap + settings.workspace.clearance
        demand_surpluses = [
            field.surplus[demand] for demand in field.surplus if self._names_by_demand[demand] == (name,)
        ]
        if demand_surpluses:
            score: Floats = np.minimum.reduce(demand_surpluses)
            # cells with too little room, and turns of pushed objects, come after all other cells
            is_last = room < settings.room
            is_last[1:] |= settings.workspace.keeps_yaw
            # more than the range of all scores
            penalty = 2.0 * float(abs(score[np.isfinite(score)]).max(initial=1.0))
            return score - np.where(is_last, penalty, 0.0)
        if settings.skill == "place":
            return np.asarray(np.minimum(room, 1e9))
        distance = distance_to([centre_of(self._movable[name].footprint)], self._grid)
        return np.asarray(np.broadcast_to(-distance, field.clearance.shape))

    # ------------------------------------------------------------------------------------------ poses

    def _pose(self, name: str, cell: Cell) -> Pose:
        x, y = self._grid.centre(cell[1], cell[2])
        return x, y, float(self._fields[name].turns[cell[0]])

    def _settle(self, poses: Mapping[str, Pose]) -> dict[str, Pose] | None:
        """Return poses near `poses` that meet all demands and touch nothing; None if no such poses are found.

        Each step goes to the nearest places that meet the linearized demands. Demands are linearized at the
        places of this step and of previous steps.
        """
        workspace, cell_size = self._settings.workspace, self._grid.cell_size
        # obstacles become objects, so that distances to obstacles are demands like all other demands
        obstacles = {
            f"obstacle {number}": TrackedObject(obstacle)
            for number, obstacle in enumerate(workspace.obstacles)
        }
        sample = with_objects(self._sample, obstacles)
        obstacle_names = [name for name in sample.objects if name not in workspace.supports]
        name_pairs = {
            frozenset((name, neighbour))
            for name in poses
            for neighbour in obstacle_names
            if name not in workspace.supports
        }
        # sorted, because the order of a set of texts differs between processes, and plans must be equal
        apart_demands = [
            Demand(distance_between(*sorted(pair)), True, workspace.clearance)
            for pair in sorted(name_pairs, key=sorted)
            if len(pair) == 2
        ]
        demands = [*self._demands, *apart_demands]
        start_places = np.array([pose[:2] for pose in poses.values()])
        for margin_share in _TOWARDS:
            places, cuts, best_surplus, stalls = start_places, list[tuple[Floats, Floats]](), -math.inf, 0
            for _ in range(_MOST_STEPS):
                if not self._budget.spend(_STEP):
                    return None
                surpluses, slopes = self._slopes(sample, demands, poses, places)
                stalls = stalls + 1 if surpluses.min() <= best_surplus + 1e-3 * cell_size else 0
                best_surplus = max(best_surplus, float(surpluses.min()))
                if (surpluses >= _STRICTLY).all() and self._grid.contains(places).all():
                    return {
                        name: (*place, poses[name][2])
                        for name, place in zip(poses, places.tolist(), strict=True)
                    }
                if stalls > _MOST_STALLED:
                    break
                # demands with a large surplus do not limit the step
                is_near = surpluses < 2.0 * cell_size
                normals = slopes[is_near].reshape(-1, places.size)
                least_values = normals @ places.ravel() - surpluses[is_near] + margin_share * cell_size
                cuts = [*cuts, (normals, least_values)][-_OLDEST_CUTS:]
                all_cuts = (np.concatenate(arrays) for arrays in zip(*cuts, strict=True))
                places = nearest_meeting(places.ravel(), *all_cuts).reshape(-1, 2)
        return None

    def _slopes(
        self, sample: Sample, demands: Sequence[Demand], poses: Mapping[str, Pose], places: Floats
    ) -> tuple[Floats, Floats]:
        """Return the surplus of demands (D,) with objects at places (N, 2), and the slopes (D, N, 2)."""
        # slopes are forward differences
        nudge_length = 1e-4 * self._grid.cell_size
        objects: dict[str, TrackedObject] = {}
        nudges: list[tuple[str, TrackedObject]] = []
        for name, place in zip(poses, places, strict=True):
            objects[name], *nudged_copies = moved_copies(
                sample.objects[name], place + nudge_length * _NUDGES, poses[name][2]
            )
            nudges += ((name, tracked) for tracked in nudged_copies)
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
        surpluses = np.stack(
            [leaves[0][row] if demand.wanted else -leaves[-1][row] for row, demand in enumerate(demands)]
        )
        surpluses -= np.array([[demand.least] for demand in demands])
        return surpluses[:, 0], ((surpluses[:, 1:] - surpluses[:, :1]) / nudge_length).reshape(
            -1, *places.shape
        )

    def meets(self, sample: Sample) -> bool:
        """Return whether a sample meets all demands."""
        return all(value >= 0.0 for value in self._surplus_in(sample))


def _standing_text(names: Sequence[str]) -> str:
    """Return the beginning of a sentence that names immovable objects; "" without names."""
    phrases = [name or "an obstacle of the workspace" for name in names[:_MOST_NAMED]]
    verb = "stand" if len(phrases) > 1 else "stands"
    return f"{' and '.join(phrases)}, which cannot be moved, {verb}" if phrases else ""


def _best(is_allowed: Booleans, cell_values: Floats, tie_values: Floats) -> Cell:
    """Return the allowed cell with the greatest value; equal cells are decided by `tie_values`."""
    allowed_values = np.where(is_allowed, cell_values, -np.inf)
    is_best = allowed_values == allowed_values.max()
    best_index = int(np.argmax(np.where(is_best, tie_values, -np.inf)))
    turn, row, column = np.unravel_index(best_index, is_allowed.shape)
    return int(turn), int(row), int(column)


def _conflicts(stencil: Booleans | None, cell: Cell, shape: tuple[int, ...]) -> Booleans:
    """Return the second object's cells (B, rows, columns) that conflict with a cell of the first object."""
    conflicts = np.zeros(shape, np.bool_)
    if stencil is None:
        return conflicts
    turn, *centre = cell
    half_side = stencil.shape[2] // 2
    grid_slices, stencil_slices = [], []
    for centre_index, size in zip(centre, shape[1:], strict=True):
        low, high = max(centre_index - half_side, 0), min(centre_index + half_side + 1, size)
        grid_slices.append(slice(low, high))
        stencil_slices.append(slice(low - centre_index + half_side, high - centre_index + half_side))
    conflicts[:, grid_slices[0], grid_slices[1]] = stencil[turn][:, stencil_slices[0], stencil_slices[1]]
    return conflicts


def _count_losses(cells: Booleans, stencil: Booleans) -> Floats:
    """Count the second object's cells that conflict with each cell of the first object, (A, rows, columns).

    The counts are correlations of cells and stencil, computed by Fourier transforms.
    """
    half = stencil.shape[2] // 2
    rows, columns = cells.shape[1:]
    cells_transform = np.fft.rfft2(np.pad(cells.astype(np.float64), ((0, 0), (half, half), (half, half))))
    padded_shape = (rows + 2 * half, columns + 2 * half)
    stencil_transform = np.fft.rfft2(stencil.astype(np.float64), s=padded_shape)
    loss_counts = np.fft.irfft2(
        (cells_transform[None] * stencil_transform.conj()).sum(axis=1), s=padded_shape
    )
    # counts are whole numbers, so rounding removes the errors of the transforms
    return np.rint(loss_counts[:, :rows, :columns])


def _is_of(formula: Formula, object_names: Sequence[str]) -> bool:
    """Return whether a formula depends only on some objects."""
    for part in iter_formulas(formula):
        if isinstance(part, Quantified):
            return False
        terms = terms_of(part.expression) if isinstance(part, Atom) else ()
        for term in terms:
            base = base_of(term)
            if not (isinstance(base, TrackedName) and base.name in object_names):
                return False
    return True


# ---------------------------------------------------------------------------------------------- motions ahead

MOST_MAPS: Final = 230
"""Maximum number of maps of one decision; the evaluation of a sample counts as a quarter of a map."""
_MOST_WHY_NOT: Final = 60
"""Maximum number of maps for the reason why a task is infeasible."""
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
"""Turn up to which an object counts as unmoved, radians."""


class Lookahead:
    """Search for motions from one sample to acceptance, for one decision."""

    def __init__(self, expected: Expectations, sample: Sample) -> None:
        """Begin from the newest sample of a run."""
        self._expected, self._start = expected, PredictedState(sample)
        self._automaton, self._formulas = expected.automaton, expected.formulas
        self._regions, self._settings = expected.regions, expected.settings
        self.movables = expected.movables(self._start)
        """The movable objects of the newest sample."""
        self._pruned_edges: set[Edge] = set()
        self._solutions: dict[tuple[int, Moved], tuple[Target, ...] | None] = {}
        self._causes: dict[str, None] = {}
        self._unordered_names = ""
        self._excluded_edges: frozenset[Edge] = frozenset()

    def decide(
        self,
        consideration: Consideration,
        path: tuple[Transition, ...],
        pruned: Collection[Edge],
        *,
        together: bool = False,
    ) -> Consideration:
        """Return an edge with a candidate whose motion leads to acceptance; pruned without such a candidate.

        With the setting `motions` = 1, there is no lookahead.

        Args:
            consideration: edge with the candidates that can take the edge by one motion, or a pruned edge.
            path: path that begins with the edge.
            pruned: pruned edges.
            together: whether several motions may take the edge, and an object may be moved twice.
        """
        if self._settings.motions == 1:
            return consideration
        self._pruned_edges = set(pruned)
        self._causes.clear()
        for sequence in islice(self._joint(self._start, path, consideration), 4) if together else ():
            if (later_motions := self._ahead(sequence.scene, sequence.state)) is not None:
                return self._with_first_motion(consideration, sequence, later_motions)
        targets_by_index = by_cost(consideration.candidates, self._settings)
        for candidate_index, target in targets_by_index.items():
            if (later_motions := self._after(target, path[0])) is None:
                continue
            moved_names = [target.name, *(motion.name for motion in later_motions)]
            if together or len(set(moved_names)) == len(moved_names):
                return choose_candidate(consideration, candidate_index, (target, *later_motions))
        if not targets_by_index:
            return consideration
        causes = "; ".join(islice(self._causes, 3)) or "no sequence of motions was found"
        reason = Reason(LATER, causes if together else f"not by one motion: {causes}")
        return replace(choose_candidate(consideration, None), pruned=reason)

    # ------------------------------------------------------------------------------------ one at a time

    def _ahead(self, scene: PredictedState, state: int) -> tuple[Target, ...] | None:
        """Return motions from a state to acceptance; None if no motions are found."""
        if state in self._automaton.accepting:
            return ()
        search_key = state, scene.moved
        if search_key not in self._solutions:
            # None during the search, so that a search that returns to this scene and state gives up
            self._solutions[search_key] = None
            self._solutions[search_key] = self._search(scene, state)
        return self._solutions[search_key]

    def _search(self, scene: PredictedState, state: int) -> tuple[Target, ...] | None:
        automaton, symbol = self._automaton, self._expected.symbol(scene)
        idle = idle_transitions(automaton, state, symbol)
        pruned_edges = self._pruned_edges - idle.edges
        considered_paths: list[tuple[tuple[Transition, ...], Consideration]] = []
        while len(considered_paths) < _MOST_EDGES and self._expected.budget.left > 0:
            pruned_edges |= self._excluded_edges
            if (path := next(automaton.paths(state, pruned_edges), None)) is None:
                break
            if idle_states := idle.along(path):
                return self._ahead(scene, idle_states[-1])
            consideration = consideration_of(automaton, path, pruned_edges, symbol)
            for sequence in self._ways(scene, path, consideration):
                if (later_motions := self._ahead(sequence.scene, sequence.state)) is not None:
                    return (*sequence.motions, *later_motions)
            considered_paths.append((path, consideration))
            pruned_edges.add(consideration.edge)
            pruned_edges |= set(equivalent_edges(automaton, consideration, idle, pruned_edges, symbol))
        # hopeless edges are found only after single motions have failed, because that costs maps
        self._excluded_edges = self._hopeless
        for path, consideration in considered_paths:
            for sequence in islice(self._joint(scene, path, consideration), 2):
                if (later_motions := self._ahead(sequence.scene, sequence.state)) is not None:
                    return (*sequence.motions, *later_motions)
        return None

    def _ways(
        self, scene: PredictedState, path: tuple[Transition, ...], consideration: Consideration
    ) -> Iterator[Ordered]:
        """Yield single motions that take the first edge of a path, with the resulting scene and state."""
        movables = self._expected.movables(scene)
        candidates: list[Candidate] = []
        later_names = moved_later(path, self._expected.symbol(scene), self._formulas, movables.names)
        for name in movables.names_for(consideration.progress):
            if not self._expected.budget.spend():
                return
            candidates.append(movables.candidate(name, consideration, later_names))
        for target in by_cost(candidates, self._settings).values():
            next_scene = scene.after(target.name, target.pose)
            if self._expected.states_after(next_scene, path[0].source) == {path[0].target}:
                yield Ordered((target,), next_scene, path[0].target)
        if not any(candidate.target for candidate in candidates):
            causes = "; ".join(f"{candidate.name}: {candidate.rejected}" for candidate in candidates)
            self._causes[
                f"{consideration.progress}: {causes or 'nothing that can be moved matters to it'}"
            ] = None

    def _after(self, target: Target, edge: Transition) -> tuple[Target, ...] | None:
        """Return the motions to acceptance after a first motion; () if the next state is uncertain."""
        scene = self._start.after(target.name, target.pose)
        states = self._expected.states_after(scene, edge.source)
        return () if len(states) > 1 else self._ahead(scene, *states)

    # ------------------------------------------------------------------------------------ all together

    def _joint(
        self, scene: PredictedState, path: tuple[Transition, ...], consideration: Consideration
    ) -> Iterator[Ordered]:
        """Yield motions of several objects that take a whole path, or the first edge of the path."""
        if self._settings.motions < 2:
            return
        arrangement_numbers = count(1)
        # first the whole path, then only the first edge
        for aim_count in dict.fromkeys((len(path), 1)):
            aims = path[:aim_count]
            if any((aim.source, aim.target) in self._excluded_edges for aim in aims):
                continue
            if scene is self._start:
                yield from self._resume(aims, consideration)
            for demands in self._demands_of(scene, aims):
                # a share of the maps is reserved for other edges
                reserved_maps = self._expected.budget.left * (1.0 - _JOINT_SHARE)
                arranger = Arranger(
                    scene.sample, self._regions, self._settings, demands, self._expected.budget
                )
                if self._expected.budget.left <= 0 or arranger.why_hopeless():
                    continue
                arrangements: Iterable[dict[str, Pose]] = islice(
                    arranger.arrangements(self._settings.motions), _MOST_ORDERED
                )
                if self._expected.attempts.are_any:
                    # a motion may fail by chance, so places of failed motions are tried last
                    arrangements = sorted(arrangements, key=self._is_near_failure)
                for number, poses in zip(arrangement_numbers, arrangements, strict=False):
                    for sequence in self._ordered_from(
                        scene, aims, consideration, arranger, poses, reserved_maps
                    ):
                        yield sequence._replace(arrangement=number)

    def _resume(self, aims: Sequence[Transition], consideration: Consideration) -> Iterator[Ordered]:
        """Yield the motions to the places of the last decision, if these motions still take the edges.

        The motions of a new arrangement may be more than the remaining motions of the old plan, and may undo
        earlier motions.
        """
        scene, states = self._start, frozenset({aims[0].source})
        places: dict[str, Pose] = {}
        for motion in self._expected.attempts.planned:
            scene = scene.after(motion.name, motion.pose)
            states = self._automaton.step_set(states, self._expected.symbol(scene))
            places[motion.name] = dict(scene.moved)[motion.name]
            if states == {aims[-1].target}:
                robustness = self._expected.robustness(scene.sample, aims[0].guard)
                forbidden_cubes = consideration.constraints.cubes
                motion_order = MotionOrder(
                    self._expected, self._start, aims, forbidden_cubes, places, robustness, 0.0
                )
                if (sequence := motion_order.find()) is not None:
                    yield sequence
                return

    def _demands_of(self, scene: PredictedState, aims: Sequence[Transition]) -> Iterator[tuple[Demand, ...]]:
        """Yield conjunctions of demands that take all edges and avoid traps."""
        trap_cubes = self._expected.traps(aims[0].source)
        safety_demands: list[Demand] = []
        # slightly more than the margin, so that rounding does not bring a constraint back to the margin
        least_margin = self._settings.constraint_margin * (1.0 + 1e-9) + _STRICTLY
        for cube in trap_cubes:
            if len(cube) == 1:
                ((number, value),) = cube
                conjunctions = alternatives(self._formulas[number], not value)
                if len(conjunctions) == 1:
                    safety_demands += (Demand(*literal, least_margin) for literal in conjunctions[0])
        # at most eight combinations of cubes: their number grows exponentially with the path
        for cubes in islice(product(*(aim.guard for aim in aims)), 8):
            literals = tuple(dict.fromkeys(literal for cube in cubes for literal in cube))
            if any((number, not value) in literals for number, value in literals):
                continue
            for demands in demands_of(literals, self._formulas, self._settings.margin):
                yield (*demands, *safety_demands)

    def _is_near_failure(self, poses: Mapping[str, Pose]) -> bool:
        """Return whether an arrangement brings an object near a place where the object's motion failed."""
        near_distance = AVOIDED_CELLS * self._settings.workspace.grid.cell_size
        return any(
            math.dist(pose[:2], place) <= near_distance
            for name, pose in poses.items()
            for place in self._expected.attempts.places_of(name)
        )

    def _ordered_from(
        self,
        scene: PredictedState,
        aims: Sequence[Transition],
        consideration: Consideration,
        arranger: Arranger,
        poses: Mapping[str, Pose],
        reserved_maps: float,
    ) -> Iterator[Ordered]:
        """Yield the motions to an arrangement in a possible order, if such an order is found."""
        self._expected.budget.arrangements += 1
        poses = self._without_staying(scene, arranger, poses)
        robustness = self._expected.robustness(move_objects(scene.sample, poses), aims[0].guard)
        forbidden_cubes = consideration.constraints.cubes
        motion_order = MotionOrder(
            self._expected, scene, aims, forbidden_cubes, poses, robustness, reserved_maps
        )
        if (sequence := motion_order.find()) is not None:
            yield sequence
        elif scene is self._start and len(poses) > 1 and not self._unordered_names:
            self._unordered_names = " and ".join(sorted(poses))

    def _without_staying(
        self, scene: PredictedState, arranger: Arranger, poses: Mapping[str, Pose]
    ) -> Mapping[str, Pose]:
        """Drop objects that barely move from an arrangement, if the demands are still met."""
        for name in list(poses):
            x, y, turn = poses[name]
            other_poses = {moved_name: pose for moved_name, pose in poses.items() if moved_name != name}
            distance = math.dist((x, y), centre_of(scene.sample.objects[name].footprint))
            is_still = distance <= self._settings.workspace.grid.cell_size and abs(turn) <= _STILL_TURN
            if is_still and arranger.meets(move_objects(scene.sample, other_poses)):
                poses = other_poses
        return poses

    def _with_first_motion(
        self,
        consideration: Consideration,
        sequence: Ordered,
        later_motions: tuple[Target, ...],
    ) -> Consideration:
        """Return an edge whose chosen candidate makes the first of several motions."""
        motions = sequence.motions
        first_motion, sample = motions[0], self._start.sample
        # a parked object goes to its own place later, so its first motion's pose is not final
        poses = {motion.name: motion.pose for motion in motions[1:] if motion.name != first_motion.name}
        settings, current_maps = self._settings, self.movables.maps_of(first_motion.name)
        later_maps = proposition_maps(
            self._formulas,
            self._regions,
            move_objects(sample, poses),
            first_motion.name,
            settings.workspace,
            current_maps.grid,
        )
        cubes = consideration.progress.cubes, consideration.constraints.cubes
        gradient = gradient_map(
            current_maps, *cubes, settings.workspace, settings.constraint_margin, later_maps
        )
        final_sample = move_objects(sample, {**poses, first_motion.name: first_motion.pose})
        target = replace(
            first_motion, robustness=self._expected.robustness(final_sample, consideration.progress.cubes)
        )
        if all(motion.name != first_motion.name for motion in motions[1:]):
            target = self._refine(target, consideration, poses, (*motions[1:], *later_motions))
        candidate = Candidate(first_motion.name, gradient, target, is_chosen=True, rule=sequence.rule)
        rivals = (rival for rival in consideration.candidates if rival.name != first_motion.name)
        other_candidates = tuple(replace(rival, is_chosen=False) for rival in rivals)
        planned_motions = (target, *motions[1:], *later_motions)
        return replace(
            consideration,
            candidates=(*other_candidates, candidate),
            pruned=None,
            motions=planned_motions,
            is_joint=True,
        )

    def _refine(
        self,
        target: Target,
        consideration: Consideration,
        poses: Mapping[str, Pose],
        later_motions: tuple[Target, ...],
    ) -> Target:
        """Refine the target of the first motion, if the states after each motion do not change."""
        start, *corners, end = target.waypoints
        corners = corners if self._settings.skill == "push" else []
        direct_target = replace(target, waypoints=(start, *corners, end))
        refined_target = self.movables.refine(direct_target, consideration, None, poses)
        target_with_way = self.movables.with_way(refined_target, consideration.constraints.cubes)
        if (
            isinstance(target_with_way, str)
            or self.movables.is_repeated(target_with_way)
            or refined_target.robustness <= target.robustness
        ):
            return target
        state = consideration.edge[0]
        old_states, new_states = (
            self._states_along((motion, *later_motions), state) for motion in (target, target_with_way)
        )
        return target_with_way if old_states == new_states else target

    def _states_along(self, motions: Sequence[Target], state: int) -> list[frozenset[int]]:
        """Return the possible states after each motion; the first motion starts at the newest sample."""
        scene, states, states_by_motion = self._start, frozenset({state}), []
        for motion in motions:
            scene = scene.after(motion.name, motion.pose)
            states = self._automaton.step_set(states, self._expected.symbol(scene))
            states_by_motion.append(states)
        return states_by_motion

    # --------------------------------------------------------------------------------------- what is seen

    @cached_property
    def _hopeless(self) -> frozenset[Edge]:
        """The edges whose guards need a literal that no arrangement of the objects can fulfil."""
        return self._needing(self._hopeless_literals)

    def _needing(self, literals: Collection[tuple[int, bool]]) -> frozenset[Edge]:
        """Return the edges whose guards have one of these literals in every cube."""
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
        symbol = self._expected.symbol(self._start)
        literals = {
            literal
            for transition in self._automaton.transitions
            for cube in transition.guard
            for literal in cube
        }
        hopeless_literals: list[tuple[int, bool]] = []
        budget = Budget(self._expected.budget.left * _HOPELESS_SHARE)
        for number, is_wanted in sorted(literals):
            # a literal that holds now is not hopeless; `is`, because None is unknown
            if symbol[number] is (not is_wanted) and budget.left > 0:
                cause = self._why_hopeless(self._start.sample, number, is_wanted, budget)
                if cause:
                    hopeless_literals.append((number, is_wanted))
                    self._causes[f"{self._automaton.propositions[number].literal(is_wanted)}: {cause}"] = None
        self._expected.budget.spend(self._expected.budget.left * _HOPELESS_SHARE - budget.left)
        return tuple(hopeless_literals)

    def why_not(self, state: int) -> str:
        """Return a condition that no arrangement meets although every path to acceptance needs it.

        The text also names the objects in the way. Without such a condition, return a sentence on objects
        whose motions have no possible order, or "".
        """
        for literal in self._hopeless_literals:
            if next(self._automaton.paths(state, self._needing({literal})), None) is None:
                return self._why_never(self._start.sample, literal)
        if not self._unordered_names:
            return ""
        return f"{self._unordered_names}: there are places for all, but no order of motions to them was found"

    def _why_never(self, sample: Sample, literal: tuple[int, bool]) -> str:
        """Return a sentence on a literal's demands that no arrangement meets, and on objects in the way."""
        budget = Budget(_MOST_WHY_NOT)
        conjunctions = demands_of((literal,), self._formulas, self._settings.margin)
        demands = next(iter(conjunctions), ())
        # demands without which the conflict remains are dropped, so that the reason names few demands
        core_demands = list(demands)
        for demand in reversed(demands):
            fewer_demands = tuple(member for member in core_demands if member != demand)
            if fewer_demands and budget.left > 0 and self._why_impossible(sample, fewer_demands, budget):
                core_demands = list(fewer_demands)
        arranger = Arranger(sample, self._regions, self._settings, core_demands, budget)
        goals = " and ".join(literal_text(demand.formula, demand.wanted) for demand in core_demands)
        if cause := arranger.why_hopeless():
            return f"{goals}: {'; '.join(filter(None, (cause, arranger.cell_hint(self._settings.motions))))}"
        standing_text = arranger.what_stands()
        sentences = (
            "no places were found for all at once",
            standing_text,
            arranger.cell_hint(self._settings.motions),
        )
        return f"{goals}: {'; '.join(filter(None, sentences))}"

    def _why_impossible(self, sample: Sample, demands: Sequence[Demand], budget: Budget) -> str:
        """Return the reason why no arrangement of objects meets demands, or ""."""
        arranger = Arranger(sample, self._regions, self._settings, demands, budget)
        cause = arranger.why_hopeless()
        arrangement = None if cause else next(arranger.arrangements(self._settings.motions), None)
        return cause or (_NOT_FOUND if arrangement is None else "")

    def _why_hopeless(self, sample: Sample, number: int, wanted: bool, budget: Budget) -> str:
        cause = "it never holds"
        for demands in demands_of(((number, wanted),), self._formulas, self._settings.margin):
            cause = self._why_impossible(sample, demands, budget)
            if not cause or (cause == _NOT_FOUND and budget.left <= 0):
                return ""
        return cause

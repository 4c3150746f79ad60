"""Arrangements: cells for several objects at once, so that all demands of a formula hold together.

A constraint satisfaction problem over the cells of a grid. What an object's cell has to fulfil by itself is a
map; what two objects' cells have to fulfil together depends on the way from one to the other alone, and is a
stencil. The object with the fewest cells left comes first; its cells are tried by their robustness, and by
how many cells they leave to the others.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Final, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.geometry.poses import centre_of, moved_object, radius_of
from spatial_replay.planning.demands import Budget, Demand, surplus, values_in, with_moved
from spatial_replay.planning.maps import concerns, proposition_maps
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.targets import cell_hint
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.spec.formula import Atom, Formula, Outline, Quantified, SignedDistance, TrackedName
from spatial_replay.spec.walks import base_of, iter_formulas, terms_of
from spatial_replay.trace.sample import Sample

_MOST_SETS: Final = 24
"""The most sets of objects that are tried for one conjunction."""
_MOST_VISITS: Final = 200
"""The most cells tried for one set of objects."""
_MOST_SOLUTIONS: Final = 6
"""The most arrangements of one set of objects."""
_WIDEST: Final = 150_000
"""The most cells of a stencil, over all orientations; pairs with a larger one are compared at the end."""
_MOST_NAMED: Final = 3
"""The most things that a sentence names."""
_ENOUGH: Final = 0.5
"""The share of its cells that each other object keeps after a choice by robustness."""

Cell: TypeAlias = tuple[int, int, int]
"""A turn of an object, by its number, and the row and column of its centre."""


@dataclass(frozen=True, eq=False)
class _Field:
    """What the cells of one object are like, with everything that cannot be moved where it is.

    Attributes:
        turns: (A,) angles in radians.
        open: (A, rows, columns), whether the robot reaches a cell and nothing immovable stands there.
        clearance: (A, rows, columns), distance to what cannot be moved.
        standing: for each thing that cannot be moved, "" for the workspace's obstacles, the distance to it.
        apart: for each other movable object in the way, the distance to it less the clearance needed.
        surplus: for each demand about the object, that with everything else where it is.
    """

    turns: Floats
    open: Booleans
    clearance: Floats
    standing: Mapping[str, Floats]
    apart: Mapping[str, Floats]
    surplus: Mapping[Demand, Floats]


class Arranger:
    """The arrangements of movable objects in one sample that meet demands.

    Attributes:
        is_tight: whether an object was found that has a place between cells only.
    """

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
        present = {name: each for name, each in sample.objects.items() if isinstance(each, TrackedObject)}
        order = sorted(present) if settings.movable is None else settings.movable
        self._movable = {name: present[name] for name in order if name in present}
        self._about = {each: self._names(each) for each in self._demands}
        self._fields: dict[str, _Field] = {}
        self._visits = 0
        self.is_tight = False

    def _names(self, demand: Demand) -> tuple[str, ...]:
        return tuple(name for name in self._movable if concerns(demand.formula, name))

    @cached_property
    def _unmet(self) -> tuple[Demand, ...]:
        values = values_in(self._sample, [each.formula for each in self._demands], self._regions)
        columns = zip(self._demands, *values, strict=True)
        return tuple(each for each, low, high in columns if surplus(low, high, each) < 0.0)

    def why_hopeless(self) -> str:
        """Return why no arrangement at all meets the demands, if one object's cells show that; else ""."""
        for demand in self._unmet:
            if not self._about[demand]:
                return "no object that can be moved matters to it"
        for name in self._movable:
            own = [each for each in self._demands if self._about[each] == (name,)]
            if own and any(each in self._unmet for each in own) and (field := self._field(name)) is not None:
                met = np.minimum.reduce([field.surplus[each] for each in own])
                if not (field.open & (met >= 0.0)).any() and not self._fits_between(name, field, own):
                    if self._settings.rules > 3 and (met >= 0.0).any():
                        stands = _listed(self._standing(field, met >= 0.0))
                        return f"{stands or 'the robot does not reach'} wherever {name} would have to be"
                    best = max(float(met[field.open].max(initial=-math.inf)), -math.inf)
                    hint = cell_hint(-best, self._settings)
                    return f"{name}: nowhere would all of it hold, {-best:.4g} is missing at best{hint}"
        return ""

    def _fits_between(self, name: str, field: _Field, own: Sequence[Demand]) -> bool:
        """Return whether an object has a place between cells where demands hold, if targets are refined."""
        workspace, tracked = self._settings.workspace, self._movable[name]
        if self._settings.rules < 4 or not self._settings.refine or self._settings.skill == "push":
            return False
        met = np.minimum.reduce([field.surplus[each] for each in own])
        score = np.where(
            workspace.within_reach(self._grid),
            np.minimum(met, field.clearance - workspace.clearance),
            -np.inf,
        )
        turn, row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[turn, row, column] < -self._grid.cell_size or not self._budget.spend():
            return False
        x, y = self._grid.centre(int(row), int(column))
        size, yaw = self._grid.cell_size / 8.0, (tracked.yaw or 0.0) + float(field.turns[turn])
        supports = workspace.supports | {each for each in self._movable if each != name}
        yaws = (yaw,) if workspace.yaws else ()
        free = replace(workspace, supports=supports, yaws=yaws, keeps_yaw=False)
        grid = Grid(x - 8.5 * size, y - 8.5 * size, size, 17, 17)
        formulas = [each.formula for each in own]
        maps = proposition_maps(formulas, self._regions, self._sample, name, free, grid)
        good = (maps.clearance > workspace.clearance) & workspace.grid.contains(grid.centres()).reshape(
            grid.shape
        )
        for each, low, high in zip(own, maps.lower, maps.upper, strict=True):
            good &= ((low if each.wanted else -high) - each.least) >= 0.0
        self.is_tight |= bool(good.any())
        return bool(good.any())

    def what_stands(self) -> str:
        """Return what cannot be moved and stands where objects could go, as a sentence; "" for nothing."""
        names: dict[str, None] = {}
        for name, field in self._fields.items():
            wanted = self._met(field, name, tuple(self._movable))
            if not wanted.all():
                names |= dict.fromkeys(self._standing(field, wanted))
        return f"{_listed(list(names))} there" if names else ""

    def _standing(self, field: _Field, wanted: Booleans) -> list[str]:
        """Return what cannot be moved and stands in some cells, what is in most of them first."""
        clearance = self._settings.workspace.clearance
        counts = {each: int((wanted & (away <= clearance)).sum()) for each, away in field.standing.items()}
        return sorted((each for each in counts if counts[each]), key=lambda each: -counts[each])

    def arrangements(self, most: int) -> Iterator[dict[str, Cell]]:
        """Yield arrangements of the least sets of objects first.

        Args:
            most: the most objects that are moved.
        """
        queue = [(len(each), number, each) for number, each in enumerate(self._bases(most))]
        heapq.heapify(queue)
        seen = {each for *_, each in queue}
        count = len(queue)
        for _ in range(_MOST_SETS):
            if not queue:
                return
            *_, chosen = heapq.heappop(queue)
            domains = self._domains(chosen)
            if domains is not None and all(each.any() for each in domains.values()):
                self._visits = 0
                stencils = self._stencils(chosen, domains)
                found = 0
                for cells in self._placed({}, domains, stencils):
                    if self.meets(self.sample_with(cells)):
                        yield cells
                        found += 1
                    if found >= _MOST_SOLUTIONS:
                        break
            if len(chosen) < most and chosen:
                for name in self._in_the_way(chosen):
                    wider = tuple(each for each in self._movable if each in chosen or each == name)
                    if wider not in seen:
                        seen.add(wider)
                        count += 1
                        heapq.heappush(queue, (len(wider), count, wider))

    def _bases(self, most: int) -> list[tuple[str, ...]]:
        """Return the least sets of objects that matter to every unmet demand."""
        sets: dict[tuple[str, ...], None] = {(): None}
        for demand in self._unmet:
            wider: dict[tuple[str, ...], None] = {}
            for each in sets:
                if any(name in each for name in self._about[demand]):
                    wider[each] = None
                    continue
                for name in self._about[demand]:
                    both = tuple(one for one in self._movable if one in each or one == name)
                    if len(both) <= most:
                        wider[both] = None
            sets = dict(list(wider.items())[:_MOST_SETS])
        return list(sets)

    def _in_the_way(self, chosen: tuple[str, ...]) -> list[str]:
        """Return other objects, those first that stand where the chosen ones could go."""
        counts = dict.fromkeys((each for each in self._movable if each not in chosen), 0)
        for name in chosen:
            if (field := self._field(name)) is None:
                return []
            wanted = field.open & self._met(field, name, chosen)
            if not wanted.any():
                # nothing that is moved away would make room; a demand about two may be met by the other one
                wanted = field.open
            for other, apart in field.apart.items():
                if other in counts:
                    counts[other] += int((wanted & (apart <= 0.0)).sum())
        tied = {name for each in self._unmet for name in self._about[each]}
        useful = [each for each, count in counts.items() if count or each in tied]
        return sorted(useful, key=lambda each: (each not in tied, -counts[each]))[:4]

    def _field(self, name: str) -> _Field | None:
        if name not in self._fields:
            if not self._budget.spend():
                return None
            self._fields[name] = self._measured(name)
        return self._fields[name]

    def _measured(self, name: str) -> _Field:
        workspace = self._settings.workspace
        others = [each for each in self._movable if each != name and each not in workspace.supports]
        about = [each for each in self._demands if name in self._about[each]]
        distances = [
            Atom("", "dist", SignedDistance(TrackedName(name), TrackedName(each))) for each in others
        ]
        formulas = [*(each.formula for each in about), *distances]
        free = replace(workspace, supports=workspace.supports | set(others))
        maps = proposition_maps(formulas, self._regions, self._sample, name, free)
        met = {
            each: (low if each.wanted else -high) - each.least
            for each, low, high in zip(about, maps.lower, maps.upper, strict=False)
        }
        measured = zip(others, maps.lower[len(about) :], strict=True)
        apart = {other: low - workspace.clearance for other, low in measured}
        is_open = (maps.clearance > workspace.clearance) & workspace.within_reach(maps.grid)
        standing = dict(zip(maps.obstacles, maps.distances, strict=True))
        return _Field(maps.turns, is_open, maps.clearance, standing, apart, met)

    def _met(self, field: _Field, name: str, chosen: tuple[str, ...]) -> Booleans:
        """Return the cells where the demands hold that no other chosen object matters to."""
        met = np.ones(field.open.shape, np.bool_)
        for demand, values in field.surplus.items():
            if all(each == name or each not in chosen for each in self._about[demand]):
                met &= values >= 0.0
        return met

    def _domains(self, chosen: tuple[str, ...]) -> dict[str, Booleans] | None:
        """Return the cells of each chosen object, as far as the others do not matter."""
        domains = {}
        for name in chosen:
            if (field := self._field(name)) is None:
                return None
            domain = field.open & self._met(field, name, chosen)
            for other, apart in field.apart.items():
                if other not in chosen:
                    domain = domain & (apart > 0.0)
            domains[name] = domain
        return domains

    # ------------------------------------------------------------------------------------ two objects

    def _stencils(
        self, chosen: tuple[str, ...], domains: Mapping[str, Booleans]
    ) -> dict[tuple[str, str], Booleans]:
        """Return for each pair the conflicts by the way from one to the other: (A, B, rows, columns)."""
        stencils = {}
        # turns without any cell need not be measured
        used = {name: np.asarray(cells.any(axis=(1, 2))) for name, cells in domains.items()}
        if self._settings.rules < 3:
            used = {name: np.ones_like(each) for name, each in used.items()}
        for first, second in product(chosen, chosen):
            if first != second and (found := self._stencil(first, second, chosen, used)) is not None:
                stencils[first, second] = found
        return stencils

    def _stencil(
        self, first: str, second: str, chosen: tuple[str, ...], used: Mapping[str, Booleans]
    ) -> Booleans | None:
        demands = [
            each
            for each in self._demands
            if set(self._about[each]) & set(chosen) == {first, second}
            and _is_of(each.formula, (first, second))
        ]
        one, two = self._movable[first], self._movable[second]
        size, grid = self._grid.cell_size, self._grid
        supports = self._settings.workspace.supports
        apart = first not in supports and second not in supports
        reach = (radius_of(one) + radius_of(two) + self._settings.workspace.clearance) / size + 1.0
        half = max(grid.shape) - 1 if demands else min(math.ceil(reach), max(grid.shape) - 1)
        turns, side = self._fields[first].turns, 2 * half + 1
        cells = side * side * int(used[first].sum()) * int(used[second].sum())
        if not (demands or apart) or cells > _WIDEST:
            return None
        local = Grid(-(half + 0.5) * size, -(half + 0.5) * size, size, side, side)
        formulas = [each.formula for each in demands]
        workspace, measured = self._turned_in(local, used[second])
        conflicts = np.ones((len(turns), len(used[second]), side, side), np.bool_)
        for number in np.flatnonzero(used[first]).tolist():
            turn = float(turns[number])
            objects = {first: moved_object(one, 0.0, 0.0, turn), second: two}
            sample = Sample(self._sample.time_ns, objects, self._sample.signals)
            maps = proposition_maps(formulas, self._regions, sample, second, workspace)
            bad = np.zeros(maps.clearance.shape, np.bool_)
            if apart:
                bad |= maps.clearance <= self._settings.workspace.clearance
            for each, low, high in zip(demands, maps.lower, maps.upper, strict=True):
                bad |= ((low if each.wanted else -high) - each.least) < 0.0
            conflicts[number, measured] = bad
        return conflicts

    def _turned_in(self, grid: Grid, used: Booleans) -> tuple[Workspace, list[int]]:
        """Return a workspace without obstacles for those turns that are used, and their numbers."""
        yaws, keeps = self._settings.workspace.yaws, self._settings.workspace.keeps_yaw
        if len(used) == 1:
            return Workspace(grid, () if keeps else yaws), [0]
        first = int(keeps)
        numbers = [number for number in range(first, len(used)) if used[number]]
        chosen = tuple(yaws[number - first] for number in numbers)
        return Workspace(grid, chosen, keeps_yaw=keeps), [*range(first), *numbers]

    # ----------------------------------------------------------------------------------------- search

    def _placed(
        self,
        cells: dict[str, Cell],
        domains: Mapping[str, Booleans],
        stencils: Mapping[tuple[str, str], Booleans],
    ) -> Iterator[dict[str, Cell]]:
        if not domains:
            yield cells
            return
        name = min(domains, key=lambda each: int(domains[each].sum()))
        others = {each: domain for each, domain in domains.items() if each != name}
        for cell in self._choices(name, domains[name], others, stencils):
            if self._visits >= _MOST_VISITS:
                return
            self._visits += 1
            left = {
                each: domain & ~_conflicts(stencils.get((name, each)), cell, domain.shape)
                for each, domain in others.items()
            }
            if all(each.any() for each in left.values()):
                yield from self._placed({**cells, name: cell}, left, stencils)

    def _choices(
        self,
        name: str,
        domain: Booleans,
        others: Mapping[str, Booleans],
        stencils: Mapping[tuple[str, str], Booleans],
    ) -> Iterator[Cell]:
        """Yield some cells: the most robust one, the one that leaves most to the others, and corners."""
        score = self._score(name)
        left = np.ones(domain.shape)
        for other, cells in others.items():
            if (stencil := stencils.get((name, other))) is not None:
                left = np.minimum(left, 1.0 - _lost(cells, stencil) / max(int(cells.sum()), 1))
        ranked = [(domain & (left >= _ENOUGH), score), (domain & (left > 0.0), left), (domain, score)]
        chosen: dict[Cell, None] = {}
        for among, values in ranked:
            if among.any():
                chosen[_best(among, values, score)] = None
        rows, columns = np.indices(domain.shape)[1:]
        among = domain & (left > 0.0)
        for direction in (rows, -rows, columns, -columns) if among.any() else ():
            chosen[_best(among, direction.astype(np.float64), left)] = None
        yield from chosen

    def _score(self, name: str) -> Floats:
        """Return how good each cell of an object is, the other ones aside."""
        field, settings = self._fields[name], self._settings
        room = np.minimum.reduce([field.clearance, *field.apart.values()])
        own = [field.surplus[each] for each in field.surplus if self._about[each] == (name,)]
        if own:
            score: Floats = np.minimum.reduce(own)
            # cells with too little room come after all others, and so do turns of what is pushed
            is_last = room < settings.room
            is_last[1:] |= settings.workspace.keeps_yaw
            behind = 2.0 * float(abs(score[np.isfinite(score)]).max(initial=1.0))
            return score - np.where(is_last, behind, 0.0)
        if settings.skill == "place":
            return np.asarray(np.minimum(room, 1e9))
        here = np.array(centre_of(self._movable[name].footprint))
        away = np.hypot(*(self._grid.centres() - here).T).reshape(self._grid.shape)
        return np.asarray(np.broadcast_to(-away, field.open.shape))

    # ------------------------------------------------------------------------------------------ poses

    def pose(self, name: str, cell: Cell) -> tuple[float, float, float]:
        """Return x, y and turn of an object in a cell."""
        x, y = self._grid.centre(cell[1], cell[2])
        return x, y, float(self._fields[name].turns[cell[0]])

    def sample_with(self, cells: Mapping[str, Cell]) -> Sample:
        """Return the sample with objects in cells."""
        return with_moved(self._sample, {name: self.pose(name, cell) for name, cell in cells.items()})

    def meets(self, sample: Sample) -> bool:
        """Return whether a sample meets all demands."""
        values = values_in(sample, [each.formula for each in self._demands], self._regions)
        columns = zip(self._demands, *values, strict=True)
        return all(surplus(low, high, each) >= 0.0 for each, low, high in columns)


def _listed(names: Sequence[str]) -> str:
    """Return the first of some things as the beginning of a sentence about what cannot be moved."""
    said = [each or "an obstacle of the workspace" for each in names[:_MOST_NAMED]]
    verb = "stand" if len(said) > 1 else "stands"
    return f"{' and '.join(said)}, which cannot be moved, {verb}" if said else ""


def _best(among: Booleans, values: Floats, then: Floats) -> Cell:
    """Return the cell with the greatest value; of equal ones, the greatest of `then`."""
    best = np.where(among, values, -np.inf)
    ties = best == best.max()
    place = int(np.argmax(np.where(ties, then, -np.inf)))
    turn, row, column = np.unravel_index(place, among.shape)
    return int(turn), int(row), int(column)


def _conflicts(stencil: Booleans | None, cell: Cell, shape: tuple[int, ...]) -> Booleans:
    """Return the cells (B, rows, columns) of the second object in conflict with a cell of the first."""
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


def _lost(cells: Booleans, stencil: Booleans) -> Floats:
    """Return (A, rows, columns): how many cells of the second object each cell of the first takes away."""
    half = stencil.shape[2] // 2
    rows, columns = cells.shape[1:]
    padded = np.fft.rfft2(np.pad(cells.astype(np.float64), ((0, 0), (half, half), (half, half))))
    shape = (rows + 2 * half, columns + 2 * half)
    kernels = np.fft.rfft2(stencil.astype(np.float64), s=shape)
    lost = np.fft.irfft2((padded[None] * kernels.conj()).sum(axis=1), s=shape)
    # the counts are whole numbers, so rounding takes away what transforms add
    return np.rint(lost[:, :rows, :columns])


def _is_of(formula: Formula, names: Sequence[str]) -> bool:
    """Return whether a formula is about some objects alone, whatever stands elsewhere."""
    for each in iter_formulas(formula):
        if isinstance(each, Quantified):
            return False
        terms = terms_of(each.expression) if isinstance(each, Atom) else ()
        for term in terms:
            base = base_of(term)
            if not (isinstance(base, TrackedName) and base.name in names):
                return False
    return True

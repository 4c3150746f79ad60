"""Gradient maps taken apart: a layer for each conjunct, which of them limits a cell, and what blocks it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.decisions import Candidate, Target
from spatial_replay.planning.maps import (
    CONSTRAINED,
    FREE,
    OCCUPIED,
    OUT_OF_REACH,
    UNKNOWN,
    GradientMap,
    MapParts,
    PropositionMaps,
    cube_robustness,
    proposition_maps,
)
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Boolean, Formula, expand

AVOIDED_CELLS: Final = 2.0
"""Distance in cells that a new target keeps from a place where an attempt failed."""
MOST_LAYERS: Final = 12
"""Conjuncts that get a layer in a log, those that vary first; the others are named there."""
MOST_CAUSES: Final = 1000
"""Causes that are listed; cells of any further ones name the last."""

CauseKind: TypeAlias = Literal["constraint", "object", "obstacle", "reach", "unknown", "failed"]
"""What keeps an object out of a cell: something of the constraint set would hold; an object or an obstacle of
the workspace stands there; the robot's reach; an unknown progress set; a failed motion to a place near it."""

_KINDS: Final[tuple[CauseKind, ...]] = ("constraint", "object", "reach", "unknown", "failed")
_KIND_OF: Final = {CONSTRAINED: 0, OCCUPIED: 1, OUT_OF_REACH: 2, UNKNOWN: 3}
_FAILED: Final = 4
_NUMBERS: Final = 1 << 24
"""Numbers of a kind that a code has room for."""


class BlockedBy(NamedTuple):
    """What keeps an object out of cells.

    Attributes:
        name: of the object, or what of the constraint set would hold; else empty.
        cells: how many, over all orientations.
    """

    kind: CauseKind
    name: str
    cells: int


class RoomCost(NamedTuple):
    """What the room around a target costs: the robustness possible with less, and the room there."""

    robustness: float
    room: float


@dataclass(frozen=True, slots=True, eq=False)
class MapLayers:
    """A gradient map taken apart.

    Attributes:
        conjuncts: as text, the L relations that the progress set is made of, or their negations.
        robustness: (L, A, rows, columns), of each conjunct; -inf where it is unknown.
        limiting: (A, rows, columns), the conjunct whose robustness the progress set has, from 0; -1 where
            there is none.
        causes: what blocks cells, most cells first.
        blocked_by: (A, rows, columns), the cause of each cell, from 0; -1 where the cell is free.
    """

    conjuncts: tuple[str, ...]
    robustness: Floats
    limiting: NDArray[np.int64]
    causes: tuple[BlockedBy, ...]
    blocked_by: NDArray[np.int64]


def map_layers(
    gradient: GradientMap, settings: Settings, failed: Collection[tuple[float, float]] = ()
) -> MapLayers:
    """Take a gradient map apart.

    Args:
        settings: of the planner.
        failed: places (x, y) where motions of the object failed, from which it stays away.
    """
    parts, shape = gradient.made_of, gradient.blocked.shape
    formulas = parts.then.about.propositions
    progress = _any([_every([_Part(formulas[n], wanted) for n, wanted in cube]) for cube in parts.progress])
    leaves = tuple(dict.fromkeys(_leaves(progress)))
    lower, upper = _measured(parts.then, [each.formula for each in leaves])
    layers = np.empty((len(leaves), *shape))
    for place, leaf in enumerate(leaves):
        layers[place] = lower[place] if leaf.wanted else -upper[place]
    places = {leaf: place for place, leaf in enumerate(leaves)}
    _, limiting = _limit(progress, layers, places)
    causes, blocked_by = _causes(gradient, avoided_cells(gradient, settings, failed))
    texts = tuple(each.text for each in leaves)
    return MapLayers(texts, layers, np.broadcast_to(limiting, shape), causes, blocked_by)


class _Part(NamedTuple):
    """A formula about one sample that has to hold, or must not."""

    formula: Formula
    wanted: bool

    @property
    def text(self) -> str:
        text = format_formula(self.formula)
        return text if self.wanted else f"not ({text})"


class _Joined(NamedTuple):
    """Parts of which every one has to hold, or any one."""

    is_every: bool
    members: tuple[_Part | _Joined, ...]


def _every(members: Iterable[_Part | _Joined]) -> _Joined:
    return _Joined(True, tuple(map(_split, members)))


def _any(members: Iterable[_Part | _Joined]) -> _Joined:
    return _Joined(False, tuple(map(_split, members)))


def _split(part: _Part | _Joined) -> _Part | _Joined:
    """Return a part as what it is made of, down to relations."""
    if isinstance(part, _Joined):
        return part
    formula, wanted = expand(part.formula), part.wanted
    if not isinstance(formula, Boolean):
        return _Part(formula, wanted)
    if formula.operator == "not":
        return _split(_Part(formula.operands[0], not wanted))
    members = (_Part(each, wanted) for each in formula.operands)
    return _every(members) if (formula.operator == "and") == wanted else _any(members)


def _leaves(part: _Part | _Joined) -> Iterator[_Part]:
    if isinstance(part, _Part):
        yield part
    else:
        for each in part.members:
            yield from _leaves(each)


def _limit(
    part: _Part | _Joined, layers: Floats, places: Mapping[_Part, int]
) -> tuple[Floats, NDArray[np.int64]]:
    """Return the robustness of a part in each cell, and the leaf that has it; -1 if there is none."""
    if isinstance(part, _Part):
        place = places[part]
        return layers[place], np.full(layers.shape[1:], place, np.int64)
    value = np.full(layers.shape[1:], np.inf if part.is_every else -np.inf)
    limiting = np.full(layers.shape[1:], -1, np.int64)
    for each in part.members:
        other, its_limiting = _limit(each, layers, places)
        better = other < value if part.is_every else other > value
        value, limiting = np.where(better, other, value), np.where(better, its_limiting, limiting)
    return value, limiting


def _measured(maps: PropositionMaps, formulas: Sequence[Formula]) -> tuple[Floats, Floats]:
    """Return bounds (N, A, rows, columns) of the robustness of formulas in the cells of maps."""
    about = maps.about
    tracked = about.sample.objects[maps.name]
    here = tracked.yaw or 0.0 if isinstance(tracked, TrackedObject) else 0.0
    # what stands in the way was measured already
    everything = frozenset(about.sample.objects)
    free = Workspace(maps.grid, yaws=tuple((maps.turns + here).tolist()), supports=everything)
    found = proposition_maps(formulas, about.regions, about.sample, maps.name, free)
    return found.lower, found.upper


def _causes(gradient: GradientMap, avoided: Booleans) -> tuple[tuple[BlockedBy, ...], NDArray[np.int64]]:
    """Return what blocks cells, and the number of its cause for each."""
    maps, blocked = gradient.made_of.now, gradient.blocked
    codes = np.full(blocked.shape, -1, np.int64)
    for reason, family in _KIND_OF.items():
        codes[blocked == reason] = family * _NUMBERS
    stands = blocked == OCCUPIED
    codes[stands] += maps.distances.argmin(axis=0)[stands]
    held = blocked == CONSTRAINED
    texts: tuple[str, ...] = ()
    if held.any():
        texts, which = most_dangerous(gradient.made_of, blocked.shape)
        codes[held] += which[held]
    codes[(blocked == FREE) & avoided] = _FAILED * _NUMBERS
    found, counts = np.unique(codes[codes >= 0], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    causes = []
    blocked_by = np.full(blocked.shape, -1, np.int64)
    for place, (code, count) in enumerate(zip(found[order].tolist(), counts[order].tolist(), strict=True)):
        kind, number = _KINDS[code // _NUMBERS], code % _NUMBERS
        name = texts[number] if kind == "constraint" else maps.obstacles[number] if kind == "object" else ""
        if kind == "object" and not name:
            kind = "obstacle"
        blocked_by[codes == code] = min(place, MOST_CAUSES - 1)
        causes.append(BlockedBy(kind, name, count))
    return tuple(causes[:MOST_CAUSES]), blocked_by


def most_dangerous(parts: MapParts, shape: tuple[int, ...]) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """Return what may hold of the constraint set, as text, and by number that with the greatest robustness.

    A guard of one proposition is split into those of its parts of which any one makes it hold.
    """
    formulas = parts.now.about.propositions
    guards: list[tuple[_Part, ...]] = []
    for cube in parts.constraints:
        literals = tuple(_Part(formulas[number], wanted) for number, wanted in cube)
        guards += [(each,) for each in _options(literals[0])] if len(literals) == 1 else [literals]
    guards = list(dict.fromkeys(guards))
    members = list(dict.fromkeys(each for guard in guards for each in guard))
    lower, upper = _measured(parts.now, [each.formula for each in members])
    places = {each: place for place, each in enumerate(members)}
    which, danger = np.zeros(shape, np.int64), np.full(shape, -np.inf)
    for number, guard in enumerate(guards):
        cube = tuple((places[each], each.wanted) for each in guard)
        robustness = cube_robustness(upper, lower, cube, shape)
        which[robustness > danger] = number
        np.maximum(danger, robustness, out=danger)
    return tuple(" and ".join(each.text for each in guard) for guard in guards), which


def _options(part: _Part) -> Iterator[_Part]:
    """Iterate over parts of which any one has to hold for a part to hold."""
    formula, wanted = expand(part.formula), part.wanted
    if isinstance(formula, Boolean) and formula.operator == "not":
        yield from _options(_Part(formula.operands[0], not wanted))
    elif isinstance(formula, Boolean) and (formula.operator == "or") == wanted:
        for each in formula.operands:
            yield from _options(_Part(each, wanted))
    else:
        yield _Part(formula, wanted)


def near(failed: Collection[tuple[float, float]], grid: Grid) -> Booleans:
    """Return (rows, columns): whether each cell is near a place where an attempt failed."""
    return distance_to(failed, grid) <= AVOIDED_CELLS * grid.cell_size


def distance_to(places: Collection[tuple[float, float]], grid: Grid) -> Floats:
    """Return (rows, columns): the distance from each cell to the nearest of some places."""
    away = np.full(grid.shape, np.inf)
    centres = grid.centres()
    for place in places:
        np.minimum(away, np.hypot(*(centres - np.array(place)).T).reshape(grid.shape), out=away)
    return away


def avoided_cells(
    gradient: GradientMap, settings: Settings, failed: Collection[tuple[float, float]]
) -> Booleans:
    """Return (rows, columns): the cells that a target avoids after failed motions."""
    avoided = near(failed, gradient.grid)
    holds = (gradient.blocked == FREE) & (gradient.robustness >= settings.margin)
    if settings.rules > 1 and holds.any() and not (holds & ~avoided).any():
        # a motion may fail by chance: then places come again, those farther from the failures first
        away = distance_to(failed, gradient.grid)
        return np.asarray(away < away[holds.any(axis=0)].max() / 2.0)
    return avoided


def room_cost(candidate: Candidate, target: Target, settings: Settings) -> RoomCost | None:
    """Return what the room around a target costs; None if no more robustness was possible with less."""
    gradient = candidate.map
    if settings.skill != "place" or settings.room <= 0.0:
        return None
    good = (gradient.blocked == FREE) & ~avoided_cells(gradient, settings, candidate.failed)
    room = gradient.made_of.now.room(candidate.room_from)
    tight = good & (room < settings.room) & (gradient.robustness > target.robustness)
    if not tight.any():
        return None
    place = np.unravel_index(int(np.argmax(np.where(tight, gradient.robustness, -np.inf))), tight.shape)
    return RoomCost(float(gradient.robustness[place]), float(room[place]))

"""Objects that move by themselves: where everything is next, and how long a motion stays safe beside them.

An object goes on as between its newest two samples. The one that the robot moves goes on along its way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.automata.automaton import Automaton
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import TrackedObject, centre_of, moved_copies, moved_object
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.planning.decisions import Target, points_along
from spatial_replay.planning.edges import Attempts, Pose, with_objects
from spatial_replay.planning.maps import FREE
from spatial_replay.planning.motions import Movables
from spatial_replay.planning.settings import Settings, Skill
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.trace import Sample, Trace

AHEAD: Final = 90
"""How many samples ahead the motion of other objects is expected to go on."""
_NUMBERS: Final[tuple[int, ...]] = (*range(1, 31), *range(33, AHEAD + 1, 3))
"""The samples ahead that are looked at: all of the first, and every third after them."""
_UNSURE: Final = 2
"""By how many of its steps an object may be elsewhere than expected; it may have turned back."""
_JITTER: Final = 1.0 / 30.0
"""Motion of standing objects between two samples, in cells."""
_DIRECTIONS: Final = 16
_LENGTHS: Final = (8, 15, 30)
"""How far an object goes aside, in samples."""


def motions_between(before: Sample, sample: Sample) -> dict[str, Pose]:
    """Return by how much (x, y, turn) objects moved between two samples; those that stood are left out."""
    motions = {}
    for name, now in sample.objects.items():
        was = before.objects.get(name)
        if was is not None and was is not now and any(motion := _motion(was, now)):
            motions[name] = motion
    return motions


def _motion(was: TrackedObject, now: TrackedObject) -> Pose:
    """Return by how much an object moved, beyond the uncertainty of its position, and turned."""
    (u, v), (x, y) = centre_of(was.footprint), centre_of(now.footprint)
    turned = math.remainder((now.yaw or 0.0) - (was.yaw or 0.0), math.tau)
    if math.hypot(x - u, y - v) <= was.uncertainty + now.uncertainty:
        return 0.0, 0.0, turned
    return x - u, y - v, turned


def next_sample(before: Sample, sample: Sample, target: Target, skill: Skill) -> Sample:
    """Return the sample that is expected after two others while an object is moved to a target."""
    motions = motions_between(before, sample)
    objects = {name: _advance(sample.objects[name], motion) for name, motion in motions.items()}
    if target.name in motions:
        objects[target.name] = _advance_along(
            sample.objects[target.name], motions[target.name], target, skill
        )
    return with_objects(sample, objects)


def _advance(tracked: TrackedObject, motion: Pose) -> TrackedObject:
    x, y = centre_of(tracked.footprint)
    return moved_object(tracked, x + motion[0], y + motion[1], motion[2])


def _advance_along(tracked: TrackedObject, motion: Pose, target: Target, skill: Skill) -> TrackedObject:
    """Return the object that is moved, one sample later, no farther than its target unless it strays."""
    turned = 0.0
    if target.turn and target.yaw is not None and tracked.yaw is not None:
        left = math.remainder(target.yaw - tracked.yaw, math.tau)
        turned = math.copysign(min(abs(motion[2]), abs(left)), motion[2])
    x, y = centre_of(tracked.footprint)
    length = math.hypot(*motion[:2])
    if length == 0.0:
        return moved_object(tracked, x, y, turned) if turned else tracked
    before = x - motion[0], y - motion[1]
    strays = _beside_way(target.waypoints, (x, y)) - _beside_way(target.waypoints, before) > length / 2.0
    if strays:
        return moved_object(tracked, x + motion[0], y + motion[1], turned)
    if skill == "push" or len(target.waypoints) > 2:
        return moved_object(tracked, *_place_on_way(target.waypoints, (x, y), length), turned)
    # where the way does not matter, only its end is known
    share = min(1.0, math.dist((x, y), target.waypoints[-1]) / length)
    return moved_object(tracked, x + share * motion[0], y + share * motion[1], turned)


def _place_on_way(
    waypoints: Sequence[tuple[float, float]], place: tuple[float, float], length: float
) -> tuple[float, float]:
    """Return the place that is farther along a way by a length, as far beside it as a place is now."""
    passed, foot = _nearest_on_way(waypoints, place)
    x, y = _point_at(waypoints, passed + length)
    return x + place[0] - foot[0], y + place[1] - foot[1]


def _way_from(
    waypoints: Sequence[tuple[float, float]], tracked: TrackedObject
) -> tuple[tuple[float, float], ...]:
    """Return the part of a way that an object has not passed yet, from where it is."""
    place = centre_of(tracked.footprint)
    passed, _ = _nearest_on_way(waypoints, place)
    ahead, begin = [], 0.0
    for (u, v), (x, y) in pairwise(waypoints):
        begin += math.dist((u, v), (x, y))
        if begin > passed:
            ahead.append((x, y))
    return (place, *(ahead or waypoints[-1:]))


def _beside_way(waypoints: Sequence[tuple[float, float]], place: tuple[float, float]) -> float:
    """Return how far a place is from a way."""
    return math.dist(place, _nearest_on_way(waypoints, place)[1])


def _nearest_on_way(
    waypoints: Sequence[tuple[float, float]], place: tuple[float, float]
) -> tuple[float, tuple[float, float]]:
    """Return the point of a way that is nearest to a place, and how far it is from the way's beginning."""
    begin, nearest, at = 0.0, math.inf, (0.0, place)
    for (u, v), (x, y) in pairwise(waypoints):
        whole = math.dist((u, v), (x, y))
        if whole > 0.0:
            share = ((place[0] - u) * (x - u) + (place[1] - v) * (y - v)) / whole**2
            share = min(max(share, 0.0), 1.0)
            foot = u + share * (x - u), v + share * (y - v)
            if math.dist(foot, place) < nearest:
                nearest, at = math.dist(foot, place), (begin + share * whole, foot)
        begin += whole
    return at


def _point_at(waypoints: Sequence[tuple[float, float]], length: float) -> tuple[float, float]:
    """Return the point of a way that is a length from its beginning, or its end."""
    for (u, v), (x, y) in pairwise(waypoints):
        whole = math.dist((u, v), (x, y))
        if length <= whole and whole > 0.0:
            return u + length / whole * (x - u), v + length / whole * (y - v)
        length -= whole
    return waypoints[-1]


class Prospect(NamedTuple):
    """After how many samples acceptance would be lost; infinite if it would not be.

    Attributes:
        perhaps: if others may also stop, or turn back.
        surely: if others go on as they do.
    """

    perhaps: float
    surely: float


class Evasion(NamedTuple):
    """How an object keeps out of the way of others.

    Attributes:
        aside: where it goes; None if it stays.
        reason: why.
    """

    aside: Target | None
    reason: str


class Lookout:
    """Keeps an object out of the way of others that move by themselves."""

    def __init__(
        self,
        automaton: Automaton,
        formulas: Sequence[Formula],
        regions: Mapping[str, Outline],
        settings: Settings,
    ) -> None:
        self._automaton, self._formulas, self._regions = automaton, formulas, regions
        self._settings = settings

    def evasion(
        self,
        sample: Sample,
        states: frozenset[int],
        motions: Mapping[str, Pose],
        target: Target,
        pace: float,
    ) -> Evasion | None:
        """Return how an object keeps out of the way of others; None if its motion to a target may go on.

        Args:
            motions: of all objects, for each sample.
            pace: by how much the object is moved between two samples.
        """
        # standing objects jitter
        least = self._settings.workspace.grid.cell_size * _JITTER
        others = {
            name: motion
            for name, motion in motions.items()
            if name != target.name and math.hypot(*motion[:2]) > least
        }
        if not others:
            return None
        name, tracked = target.name, sample.objects[target.name]
        start, about = centre_of(tracked.footprint), (sample, states, others, target.name)
        ways: list[Sequence[tuple[float, float]]] = [_way_from(target.waypoints, tracked), (start,)]
        going, staying = self._prospects(*about, ways, pace)
        if going.perhaps == math.inf:
            return None
        best = max(going, staying)
        aside: Target | None = None
        if best.perhaps < math.inf:
            ways = self._clear_ways(sample, name, _ways_aside(start, pace))
            for way, prospect in zip(ways, self._prospects(*about, ways, pace), strict=True):
                if prospect > best:
                    aside = Target(name, *way[-1], 0.0, tracked.yaw, tuple(way), target.robustness)
                    best = prospect
        return Evasion(aside, f"{' and '.join(sorted(others))} may come too near") if best > going else None

    def _clear_ways(
        self, sample: Sample, name: str, ways: Sequence[Sequence[tuple[float, float]]]
    ) -> list[Sequence[tuple[float, float]]]:
        """Return the ways on which nothing stands where an object would go."""
        settings = self._settings
        movables = Movables(self._formulas, self._regions, sample, settings, Attempts())
        gradient = movables.gradient(name, ((),), ())
        grid, free = gradient.grid, gradient.blocked[0] == FREE
        clear = []
        for way in ways:
            points = list(points_along(way, grid.cell_size))
            # what is carried passes over others
            points = points if settings.skill == "push" else points[-1:]
            if grid.contains(np.array(points)).all() and all(free[grid.cell(*point)] for point in points):
                clear.append(way)
        return clear

    def _prospects(
        self,
        sample: Sample,
        states: frozenset[int],
        motions: Mapping[str, Pose],
        name: str,
        ways: Sequence[Sequence[tuple[float, float]]],
        pace: float,
    ) -> list[Prospect]:
        """Return the prospects of moving an object along some ways, at whose ends it stands.

        Args:
            motions: of the other objects, for each sample.
            pace: by how much the object is moved between two samples.
        """
        certain = {who: replace(tracked, uncertainty=0.0) for who, tracked in sample.objects.items()}
        others = self._others_ahead(certain, motions)
        points = [_point_at(way, number * pace) for way in ways for number in _NUMBERS]
        samples = [
            Sample(
                sample.time_ns + 1 + number,
                {**certain, **others[number % len(_NUMBERS)], name: tracked},
                sample.signals,
                sample.unknown,
            )
            for number, tracked in enumerate(_copies_at(certain[name], points))
        ]
        if not samples:
            return []
        leaves = leaf_values(TraceScene(Trace.from_samples(samples), self._regions), self._formulas, {})
        surely, perhaps = (leaves[0], leaves[min(1, len(leaves) - 1)]), (leaves[-2 % len(leaves)], leaves[-1])
        return [
            Prospect(
                *(
                    self._until_loss(states, [ends[:, begin : begin + len(_NUMBERS)] for ends in bounds])
                    for bounds in (perhaps, surely)
                )
            )
            for begin in range(0, len(samples), len(_NUMBERS))
        ]

    def _others_ahead(
        self, objects: Mapping[str, TrackedObject], motions: Mapping[str, Pose]
    ) -> list[dict[str, TrackedObject]]:
        """Return the objects that move by themselves in each of the next samples."""
        ahead: list[dict[str, TrackedObject]] = [{} for _ in _NUMBERS]
        for name, (x, y, turn) in motions.items():
            u, v = centre_of(objects[name].footprint)
            places = [(u + number * x, v + number * y) for number in _NUMBERS]
            copies = _copies_at(objects[name], places, turn)
            for number, moved, objects_then in zip(_NUMBERS, copies, ahead, strict=True):
                unsure = min(number, _UNSURE) * math.hypot(x, y)
                objects_then[name] = replace(moved, uncertainty=unsure)
        return ahead

    def _until_loss(self, states: frozenset[int], bounds: Sequence[Floats]) -> float:
        """Return after how many samples acceptance may be lost, by bounds (P, N) of the propositions."""
        can_accept = self._automaton.can_accept
        is_sure = states <= can_accept
        passed = 0
        rows = zip(*(ends.T.tolist() for ends in bounds), strict=True)
        for number, (lower, upper) in zip(_NUMBERS, rows, strict=True):
            values = zip(lower, upper, strict=True)
            symbol = tuple(None if low < 0.0 <= high else low >= 0.0 for low, high in values)
            # samples in between are taken to be the same
            for _ in range(number - passed):
                states = self._automaton.step_set(states, symbol)
            passed = number
            if not states <= can_accept if is_sure else states.isdisjoint(can_accept):
                return number
        return math.inf


def _copies_at(
    tracked: TrackedObject, points: Sequence[tuple[float, float]], turn: float = 0.0
) -> list[TrackedObject]:
    """Return an object at some places; with an angle, at those of `_NUMBERS`, turned by it at each sample."""
    if turn or not points:
        numbers = _NUMBERS[: len(points)]
        return [
            moved_object(tracked, *point, number * turn)
            for number, point in zip(numbers, points, strict=True)
        ]
    return moved_copies(tracked, np.array(points))


def _ways_aside(start: tuple[float, float], pace: float) -> list[tuple[tuple[float, float], ...]]:
    """Return straight ways from a place in all directions, short ones first."""
    angles = [math.tau * number / _DIRECTIONS for number in range(_DIRECTIONS)]
    return [
        (
            start,
            # two waypoints would mean that the way does not matter
            (start[0] + length / 2.0 * math.cos(angle), start[1] + length / 2.0 * math.sin(angle)),
            (start[0] + length * math.cos(angle), start[1] + length * math.sin(angle)),
        )
        for length in (samples * pace for samples in _LENGTHS)
        for angle in angles
    ]

"""Predictions of objects that move without the robot, and of the time for which a motion near them is safe.

An object is expected to repeat its motion between the newest two samples. The object that the robot moves is
expected to continue along the planned path.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.automata.automaton import Automaton
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import (
    TrackedObject,
    centre_of,
    moved_object,
    with_poses,
)
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.planning.decisions import Consideration, Target, points_along
from spatial_replay.planning.edges import Attempts, Pose, with_objects
from spatial_replay.planning.maps import FREE
from spatial_replay.planning.motions import Movables
from spatial_replay.planning.settings import Settings, Skill
from spatial_replay.planning.targets import target_in
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.trace import Sample, Trace

AHEAD: Final = 90
"""Minimum number of predicted samples.

With only 30 samples, ten of about 80 simulated runs past a person violated the specification.
"""
MOST_AHEAD: Final = 600
"""Maximum number of predicted samples, for long motions."""
_BEGINNINGS: Final = 15
"""Interval between the tested start times of a motion, samples."""
_MOST_BEGINNINGS: Final = 9
"""Maximum number of tested start times of a motion."""
_CORNER: Final = math.radians(2.0)
"""Least change of direction at which a pushing robot takes hold again, radians."""
_UNSURE: Final = 2
"""Maximum uncertainty of a predicted place, as a multiple of the motion between two samples.

The object may stop or turn back.
"""
_JITTER: Final = 1.0 / 30.0
"""Motion between two samples up to which an object counts as standing, cells."""
_DIRECTIONS: Final = 16
"""Number of tested directions of a motion aside."""
_LENGTHS: Final = (8, 15, 30)
"""Tested durations of a motion aside, samples."""


def motions_between(before: Sample, sample: Sample) -> dict[str, Pose]:
    """Return the motions (x, y, turn) of all objects that moved between two samples."""
    motions = {}
    for name, tracked in sample.objects.items():
        earlier = before.objects.get(name)
        if earlier is not None and earlier is not tracked and any(motion := _motion(earlier, tracked)):
            motions[name] = motion
    return motions


def _motion(earlier: TrackedObject, newest: TrackedObject) -> Pose:
    """Return the motion (x, y, turn) of an object; x and y are 0 within the uncertainty of its position."""
    (u, v), (x, y) = centre_of(earlier.footprint), centre_of(newest.footprint)
    turn = math.remainder((newest.yaw or 0.0) - (earlier.yaw or 0.0), math.tau)
    if math.hypot(x - u, y - v) <= earlier.uncertainty + newest.uncertainty:
        return 0.0, 0.0, turn
    return x - u, y - v, turn


def next_sample(before: Sample, sample: Sample, target: Target, skill: Skill) -> Sample:
    """Return the expected next sample, from the newest two samples, while an object moves to a target."""
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
    """Return the moved object one sample later; an object on its path stops at its target."""
    turn = 0.0
    if target.turn and target.yaw is not None and tracked.yaw is not None:
        remaining_turn = math.remainder(target.yaw - tracked.yaw, math.tau)
        turn = math.copysign(min(abs(motion[2]), abs(remaining_turn)), motion[2])
    x, y = centre_of(tracked.footprint)
    motion_length = math.hypot(*motion[:2])
    if motion_length == 0.0:
        return moved_object(tracked, x, y, turn) if turn else tracked
    previous_place = x - motion[0], y - motion[1]
    # more than half of the motion leads away from the path
    is_straying = (
        _beside_way(target.waypoints, (x, y)) - _beside_way(target.waypoints, previous_place)
        > motion_length / 2.0
    )
    if is_straying:
        return moved_object(tracked, x + motion[0], y + motion[1], turn)
    if skill == "push" or len(target.waypoints) > 2:
        return moved_object(tracked, *_place_on_way(target.waypoints, (x, y), motion_length), turn)
    # the robot chooses the path, so only the end of the path is known
    share = min(1.0, math.dist((x, y), target.waypoints[-1]) / motion_length)
    return moved_object(tracked, x + share * motion[0], y + share * motion[1], turn)


def _place_on_way(
    waypoints: Sequence[tuple[float, float]], place: tuple[float, float], length: float
) -> tuple[float, float]:
    """Return a place advanced along a path by a length, with the same offset from the path."""
    passed_length, path_point = _nearest_on_way(waypoints, place)
    x, y = _point_at(waypoints, passed_length + length)
    return x + place[0] - path_point[0], y + place[1] - path_point[1]


def _way_from(
    waypoints: Sequence[tuple[float, float]], tracked: TrackedObject
) -> tuple[tuple[float, float], ...]:
    """Return the remaining path from an object's current place."""
    place = centre_of(tracked.footprint)
    passed_length, _ = _nearest_on_way(waypoints, place)
    points_ahead, leg_end = [], 0.0
    for (u, v), (x, y) in pairwise(waypoints):
        leg_end += math.dist((u, v), (x, y))
        if leg_end > passed_length:
            points_ahead.append((x, y))
    return (place, *(points_ahead or waypoints[-1:]))


def _beside_way(waypoints: Sequence[tuple[float, float]], place: tuple[float, float]) -> float:
    """Return the distance of a place from a path."""
    return math.dist(place, _nearest_on_way(waypoints, place)[1])


def _nearest_on_way(
    waypoints: Sequence[tuple[float, float]], place: tuple[float, float]
) -> tuple[float, tuple[float, float]]:
    """Return the nearest point of a path to a place, as (length along the path, point)."""
    leg_start, least_distance, nearest_point = 0.0, math.inf, (0.0, place)
    for (u, v), (x, y) in pairwise(waypoints):
        leg_length = math.dist((u, v), (x, y))
        if leg_length > 0.0:
            share = ((place[0] - u) * (x - u) + (place[1] - v) * (y - v)) / leg_length**2
            share = min(max(share, 0.0), 1.0)
            leg_point = u + share * (x - u), v + share * (y - v)
            if math.dist(leg_point, place) < least_distance:
                least_distance, nearest_point = (
                    math.dist(leg_point, place),
                    (leg_start + share * leg_length, leg_point),
                )
        leg_start += leg_length
    return nearest_point


def _point_at(waypoints: Sequence[tuple[float, float]], length: float) -> tuple[float, float]:
    """Return the point at a length along a path; the end if the path is shorter."""
    for (u, v), (x, y) in pairwise(waypoints):
        leg_length = math.dist((u, v), (x, y))
        if length <= leg_length and leg_length > 0.0:
            return u + length / leg_length * (x - u), v + length / leg_length * (y - v)
        length -= leg_length
    return waypoints[-1]


class Timing(NamedTuple):
    """Speed and delays of a robot's motion; times are numbers of samples.

    Attributes:
        step: distance that the object moves between two samples.
        rest: longest remaining time until the object starts or continues to move; 0 while it moves.
        approach: longest time for which an object stood before it started or continued to move.
    """

    step: float
    rest: int = 0
    approach: int = 0


@dataclass
class MotionTimes:
    """Measured speeds and delays of a robot's motions, which predict the timing of the next motion.

    Attributes:
        approach: longest time for which an object stood before it started or continued to move, samples.
    """

    approach: int = 0
    _total_length: float = 0.0
    _sample_count: int = 0
    _newest_length: float = 0.0
    _standing_samples: int = 0

    def end(self) -> None:
        """End a motion."""
        self._newest_length, self._standing_samples = 0.0, 0

    def observe(self, length: float, least: float) -> None:
        """Add the distance that the object moved between two samples; up to `least`, the object stood."""
        if length <= least:
            self._newest_length = 0.0
            self._standing_samples += 1
            return
        self.approach = max(self.approach, self._standing_samples)
        self._newest_length, self._standing_samples = length, 0
        self._total_length += length
        self._sample_count += 1

    def timing(self, cell_size: float) -> Timing:
        """Return the expected timing of the current motion, or of the next motion.

        Without an earlier motion, the expected step is one cell.
        """
        mean_step = self._total_length / self._sample_count if self._sample_count else cell_size
        longest_rest = 0 if self._newest_length else max(self.approach - self._standing_samples, 0)
        return Timing(max(self._newest_length, mean_step), longest_rest, self.approach)


class Course(NamedTuple):
    """Predicted poses of an object.

    Attributes:
        places: (N, 2), predicted places.
        turn: turn of the object between two samples, radians.
        uncertainty: (N,), uncertainty of the places.
    """

    places: Floats
    turn: float = 0.0
    uncertainty: Floats | None = None


class Prospect(NamedTuple):
    """Number of samples until acceptance is lost; infinite if acceptance is not lost.

    Attributes:
        perhaps: number of samples if other objects may also stop or turn back.
        surely: number of samples if other objects continue their motions.
    """

    perhaps: float
    surely: float


class Evasion(NamedTuple):
    """A decision on how an object evades other objects.

    Attributes:
        aside: target of a motion aside; None if the object stays.
        reason: sentence on the reason.
    """

    aside: Target | None
    reason: str


class Lookout:
    """Chooses how an object evades other objects that move without the robot."""

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
        timing: Timing,
    ) -> Evasion | None:
        """Return how an object evades other objects; None if its motion to a target may continue.

        Args:
            motions: motions of all objects between two samples.
            timing: timing of the motion to the target.
        """
        other_motions = self._others(motions, target)
        if not other_motions:
            return None
        name, tracked = target.name, sample.objects[target.name]
        start, waypoints = centre_of(tracked.footprint), _way_from(target.waypoints, tracked)
        skill = self._settings.skill
        sample_numbers = _numbers_ahead(waypoints, timing, skill)
        scene_inputs = sample, states, other_motions, name, sample_numbers
        # the start time of the motion is unknown, so several start times are tested
        place_series = [
            _places(waypoints, timing, share, sample_numbers, skill)
            for share in _beginnings(waypoints, timing, skill)
        ]
        # the last prospect is for an object at rest
        *prospects, staying_prospect = self._prospects(
            *scene_inputs, [*place_series, np.tile(start, (len(sample_numbers), 1))]
        )
        going_prospect = Prospect(*map(min, zip(*prospects, strict=True)))
        if going_prospect.perhaps == math.inf:
            return None
        # tuples compare `perhaps` first, then `surely`
        best_prospect = max(going_prospect, staying_prospect)
        aside_target: Target | None = None
        if best_prospect.perhaps < math.inf:
            clear_ways = self._clear_ways(sample, name, _ways_aside(start, timing.step))
            # a motion aside is a new motion, which begins with the full approach
            new_timing = timing._replace(rest=timing.approach)
            place_series = [
                _places(clear_way, new_timing, 1.0, sample_numbers, skill) for clear_way in clear_ways
            ]
            for aside_way, prospect in zip(
                clear_ways, self._prospects(*scene_inputs, place_series), strict=True
            ):
                if prospect > best_prospect:
                    aside_target = Target(
                        name, *aside_way[-1], 0.0, tracked.yaw, tuple(aside_way), target.robustness
                    )
                    best_prospect = prospect
        return (
            Evasion(aside_target, f"{' and '.join(sorted(other_motions))} may come too near")
            if best_prospect > going_prospect
            else None
        )

    def past_others(
        self,
        sample: Sample,
        motions: Mapping[str, Pose],
        target: Target,
        aim: Consideration,
        timing: Timing,
    ) -> Target:
        """Return a push's target; its path has fewer corners if moving objects clear a straighter way.

        Args:
            motions: motions of all objects between two samples.
            aim: edge of the push.
            timing: timing of the push.
        """
        skill, other_motions = self._settings.skill, self._others(motions, target)
        stop_indices = _stops(target.waypoints, skill)
        if not other_motions or not stop_indices:
            return target
        last_number = _numbers_ahead(target.waypoints, timing, skill)[-1]
        moved_objects = {
            name: _advance(sample.objects[name], (last_number * x, last_number * y, last_number * turn))
            for name, (x, y, turn) in other_motions.items()
        }
        sample = with_objects(sample, moved_objects)
        movables = Movables(self._formulas, self._regions, sample, self._settings, Attempts())
        gradient = movables.gradient(target.name, aim.progress.cubes, aim.constraints.cubes)
        direct_target = target_in(gradient, sample.objects[target.name], self._settings, target.pose)
        if isinstance(direct_target, str) or len(_stops(direct_target.waypoints, skill)) >= len(stop_indices):
            return target
        return replace(target, waypoints=(*direct_target.waypoints[:-1], (target.x, target.y)))

    def _others(self, motions: Mapping[str, Pose], target: Target) -> dict[str, Pose]:
        """Return the motions of moving objects, without the object of the target."""
        least = least_motion(self._settings)
        return {
            name: motion
            for name, motion in motions.items()
            if name != target.name and math.hypot(*motion[:2]) > least
        }

    def _clear_ways(
        self, sample: Sample, name: str, ways: Sequence[Sequence[tuple[float, float]]]
    ) -> list[Sequence[tuple[float, float]]]:
        """Return the paths that are free for an object."""
        settings = self._settings
        movables = Movables(self._formulas, self._regions, sample, settings, Attempts())
        # without progress and constraints, cells are blocked only by objects, obstacles and reach
        gradient = movables.gradient(name, ((),), ())
        grid, is_free = gradient.grid, gradient.blocked[0] == FREE
        clear_ways = []
        for way in ways:
            points = list(points_along(way, grid.cell_size))
            # a carried object passes over others, so only the end of its path must be free
            points = points if settings.skill == "push" else points[-1:]
            if grid.contains(np.array(points)).all() and all(is_free[grid.cell(*point)] for point in points):
                clear_ways.append(way)
        return clear_ways

    def _prospects(
        self,
        sample: Sample,
        states: frozenset[int],
        motions: Mapping[str, Pose],
        name: str,
        sample_numbers: Sequence[int],
        place_series: Sequence[Floats],
    ) -> list[Prospect]:
        """Return the prospect of each path.

        Args:
            motions: motions of the other objects between two samples.
            sample_numbers: numbers of the predicted samples, counted from the newest sample.
            place_series: places (N, 2) of the object in the predicted samples, for each path.
        """
        if not place_series:
            return []
        # measured positions count as certain; only predictions of other objects are uncertain
        certain_objects = {
            object_name: replace(tracked, uncertainty=0.0) for object_name, tracked in sample.objects.items()
        }
        courses = {
            object_name: _course_ahead(certain_objects[object_name], motion, sample_numbers)
            for object_name, motion in motions.items()
        }
        courses[name] = Course(np.concatenate(place_series))
        trace = _trace_ahead(
            replace(sample, objects=certain_objects, reported_ns={}), courses, sample_numbers
        )
        leaves = leaf_values(TraceScene(trace, self._regions), self._formulas, {})
        # the first two rows are bounds without uncertainty, the last two rows are bounds with uncertainty
        sure_bounds, possible_bounds = (
            (leaves[0], leaves[min(1, len(leaves) - 1)]),
            (leaves[-2 % len(leaves)], leaves[-1]),
        )
        sample_count = len(sample_numbers)
        return [
            Prospect(
                *(
                    self._until_loss(
                        states,
                        [bound[:, first_row : first_row + sample_count] for bound in bounds],
                        sample_numbers,
                    )
                    for bounds in (possible_bounds, sure_bounds)
                )
            )
            for first_row in range(0, len(trace), sample_count)
        ]

    def _until_loss(
        self, states: frozenset[int], bounds: Sequence[Floats], sample_numbers: Sequence[int]
    ) -> float:
        """Return the number of samples until acceptance may be lost, by bounds (P, N) of the propositions."""
        can_accept = self._automaton.can_accept
        is_sure = states <= can_accept
        previous_number = 0
        bounds_by_sample = zip(*(bound.T.tolist() for bound in bounds), strict=True)
        for sample_number, (lower, upper) in zip(sample_numbers, bounds_by_sample, strict=True):
            value_bounds = zip(lower, upper, strict=True)
            symbol = tuple(None if low < 0.0 <= high else low >= 0.0 for low, high in value_bounds)
            # the samples since the previous predicted sample are assumed equal to this sample
            for _ in range(sample_number - previous_number):
                previous_states, states = states, self._automaton.step_set(states, symbol)
                if states == previous_states:
                    break
            previous_number = sample_number
            if not states <= can_accept if is_sure else states.isdisjoint(can_accept):
                return sample_number
        return math.inf


def least_motion(settings: Settings) -> float:
    """Return the distance between two samples up to which an object counts as standing."""
    return settings.workspace.grid.cell_size * _JITTER


def _numbers_ahead(way: Sequence[tuple[float, float]], timing: Timing, skill: Skill) -> tuple[int, ...]:
    """Return the numbers of the predicted samples until the end of a motion; later samples are sparser."""
    length = sum(math.dist(begin, end) for begin, end in pairwise(way))
    end_sample = timing.rest + len(_stops(way, skill)) * timing.approach + length / timing.step
    last_sample = math.ceil(min(max(end_sample, AHEAD), MOST_AHEAD))
    # every sample of the first second at 30 Hz, then every third up to `AHEAD`, then every ninth
    return (*range(1, 31), *range(33, AHEAD + 1, 3), *range(AHEAD + 9, last_sample + 9, 9))


def _beginnings(way: Sequence[tuple[float, float]], timing: Timing, skill: Skill) -> list[float]:
    """Return the tested lengths of a motion's rests, as shares of the longest rests."""
    longest_rest = max(timing.rest, timing.approach if _stops(way, skill) else 0)
    start_count = min(1 + math.ceil(longest_rest / _BEGINNINGS), _MOST_BEGINNINGS)
    return np.linspace(0.0, 1.0, start_count).tolist() if longest_rest else [0.0]


def _stops(way: Sequence[tuple[float, float]], skill: Skill) -> list[int]:
    """Return the indices of the path's points at which a robot takes hold again: the corners of a push."""
    if skill != "push":
        return []
    angles = [math.atan2(y - v, x - u) for (u, v), (x, y) in pairwise(way)]
    turns = (abs(math.remainder(next_angle - angle, math.tau)) for angle, next_angle in pairwise(angles))
    return [corner_index for corner_index, turn in enumerate(turns, 1) if turn > _CORNER]


def _places(
    way: Sequence[tuple[float, float]],
    timing: Timing,
    rest_share: float,
    sample_numbers: Sequence[int],
    skill: Skill,
) -> Floats:
    """Return the places (N, 2) of an object on a path in predicted samples.

    Args:
        rest_share: length of each rest, as a share of the longest rest.
    """
    points = np.array(way)
    path_lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    rests = np.zeros(len(way))
    rests[0] = timing.rest
    rests[_stops(way, skill)] = timing.approach
    leave_times = path_lengths / timing.step + rest_share * np.cumsum(rests)
    arrival_times = leave_times - rest_share * rests
    course_times = np.stack((arrival_times, leave_times), axis=1).reshape(-1)
    passed_lengths = np.interp(sample_numbers, course_times, np.repeat(path_lengths, 2))
    return np.stack([np.interp(passed_lengths, path_lengths, points[:, axis]) for axis in (0, 1)], axis=1)


def _course_ahead(tracked: TrackedObject, motion: Pose, sample_numbers: Sequence[int]) -> Course:
    sample_steps, length = np.array(sample_numbers, np.float64), math.hypot(*motion[:2])
    places = np.array(centre_of(tracked.footprint)) + sample_steps[:, None] * np.array(motion[:2])
    return Course(places, motion[2], np.minimum(sample_steps, _UNSURE) * length)


def _trace_ahead(sample: Sample, courses: Mapping[str, Course], sample_numbers: Sequence[int]) -> Trace:
    """Return a trace that repeats a sample, with some objects moved along courses.

    The trace is as long as the longest course. A shorter course has one place for each of `sample_numbers`,
    and is repeated.
    """
    start_trace = Trace.from_samples([sample])
    sample_count = max(len(course.places) for course in courses.values())
    footprints, footprint_rows = start_trace.footprints, np.repeat(start_trace.rows, sample_count, axis=0)
    yaws, uncertainties, class_codes = [start_trace.yaw], [start_trace.uncertainty], [start_trace.class_code]
    for name, course in courses.items():
        tracked, column, course_length = (
            sample.objects[name],
            start_trace.names.index(name),
            len(course.places),
        )
        footprint_rows[:, column] = len(footprints) + np.arange(sample_count) % course_length
        turns = course.turn * np.array(sample_numbers if course.turn else [0] * course_length, np.float64)
        # a turning object has another orientation at each place, so poses are added one by one
        if course.turn:
            for place, turn in zip(course.places, turns, strict=True):
                footprints = with_poses(footprints, tracked, place[None, :], np.array([turn]))
        else:
            footprints = with_poses(footprints, tracked, course.places, np.zeros(1))
        object_row = start_trace.rows[0, column]
        uncertainty = np.zeros(course_length) if course.uncertainty is None else course.uncertainty
        yaws.append(start_trace.yaw[object_row] + turns)
        uncertainties.append(uncertainty)
        class_codes.append(np.full(course_length, start_trace.class_code[object_row]))
    return Trace(
        times_ns=np.arange(sample_count, dtype=np.int64),
        names=start_trace.names,
        rows=footprint_rows,
        footprints=footprints,
        yaw=np.concatenate(yaws),
        uncertainty=np.concatenate(uncertainties),
        class_code=np.concatenate(class_codes),
        classes=start_trace.classes,
        signals={signal: np.repeat(values, sample_count) for signal, values in start_trace.signals.items()},
    )


def _ways_aside(start: tuple[float, float], pace: float) -> list[tuple[tuple[float, float], ...]]:
    """Return straight paths from a place in all directions, short paths first.

    Args:
        pace: length of a path per sample, footprint units.
    """
    angles = [math.tau * number / _DIRECTIONS for number in range(_DIRECTIONS)]
    return [
        (
            start,
            # a path of only two waypoints would leave the path to the robot
            (start[0] + length / 2.0 * math.cos(angle), start[1] + length / 2.0 * math.sin(angle)),
            (start[0] + length * math.cos(angle), start[1] + length * math.sin(angle)),
        )
        for length in (samples * pace for samples in _LENGTHS)
        for angle in angles
    ]

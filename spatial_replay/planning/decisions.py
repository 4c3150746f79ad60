"""Decisions of a planner as values: steps, considered edges and objects, targets, outcomes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, TypeAlias, get_args

from spatial_replay.errors import UsageError
from spatial_replay.geometry.footprint import centre_of
from spatial_replay.lazy import Displayed
from spatial_replay.text import time_text

if TYPE_CHECKING:
    # only for types, so that a report reads reasons without loading the kernels of maps
    from spatial_replay.planning.maps import Cubes, GradientMap

Kind: TypeAlias = Literal["execute", "hold", "wait", "no path"]
"""The kind of a step: move an object, hold because the specification is satisfied, wait, or stop because no
path to acceptance is left. A step waits for an observation, for time to pass, or for moving objects."""

Stage: TypeAlias = Literal["pick", "way", "place"]
"""Stages of a motion: picking the object, moving it, placing it at the target."""

Edge: TypeAlias = tuple[int, int]
"""A transition of the automaton, from one state to another."""


@dataclass(frozen=True, slots=True)
class Reason:
    """The reason why an edge was pruned.

    Attributes:
        kind: text that all edges with an equal cause share.
        detail: text that differs between edges, such as the cause for each object; may be empty.
    """

    kind: str
    detail: str = ""

    @classmethod
    def from_text(cls, text: str) -> Reason:
        """Parse a reason from its text in a log, the result of `str`."""
        kind, _, detail = text.partition(" (")
        return cls(kind, detail.removesuffix(")"))

    def __str__(self) -> str:
        return f"{self.kind} ({self.detail})" if self.detail else self.kind


@dataclass(frozen=True, slots=True)
class Guards:
    """A set of guards. One guard of a progress set must hold; no guard of a constraint set may hold.

    Attributes:
        cubes: guards as cubes over the automaton's propositions.
        texts: text of each cube.
    """

    cubes: Cubes
    texts: tuple[str, ...]

    def __str__(self) -> str:
        return either(self.texts)


def either(texts: Sequence[str]) -> str:
    """Return alternatives as one text."""
    return " or ".join(f"({text})" for text in texts) if len(texts) > 1 else "".join(texts)


@dataclass(frozen=True, slots=True)
class Target:
    """The target pose of an object.

    Attributes:
        name: name of the object.
        x, y: centre of the object at the target, footprint units.
        turn: angle by which the object is turned, radians.
        yaw: orientation of the object at the target, radians; None for an object without orientation.
        waypoints: points (x, y) of the path, including its start and end. The start and the end alone
            are given if the robot may choose the path.
        robustness: robustness of the progress set with the object at the target.
    """

    name: str
    x: float
    y: float
    turn: float
    yaw: float | None
    waypoints: tuple[tuple[float, float], ...]
    robustness: float

    @property
    def pose(self) -> tuple[float, float, float]:
        """The pose (x, y, turn)."""
        return self.x, self.y, self.turn

    @property
    def length(self) -> float:
        """Length of the path, footprint units."""
        return sum(math.dist(start, end) for start, end in pairwise(self.waypoints))


def points_along(waypoints: Sequence[tuple[float, float]], step: float) -> Iterator[tuple[float, float]]:
    """Yield points along a path, at most `step` apart."""
    yield waypoints[0]
    for (u, v), (x, y) in pairwise(waypoints):
        count = max(1, math.ceil(math.dist((u, v), (x, y)) / step))
        yield from ((u + k / count * (x - u), v + k / count * (y - v)) for k in range(1, count + 1))


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An object that could be moved to take an edge.

    Attributes:
        name: name of the object.
        map: robustness of the progress set over the positions of the object.
        target: target of the object; None for a rejected object.
        rejected: reason of the rejection; empty if the object was not rejected.
        is_chosen: whether the planner moves this object.
        failed: places (x, y) of earlier failed motions, which a target avoids.
        room_from: names of the objects from which the target keeps room; None for all objects.
        failures: targets of failed motions in the current scene.
        rule: rule by which the target was chosen together with other motions; empty for a target that was
            chosen alone.
    """

    name: str
    map: GradientMap = field(repr=False)
    target: Target | None
    rejected: str = ""
    is_chosen: bool = False
    failed: tuple[tuple[float, float], ...] = ()
    room_from: tuple[str, ...] | None = ()
    failures: tuple[Target, ...] = ()
    rule: str = ""


@dataclass(frozen=True, slots=True)
class Consideration:
    """An edge that a planner considered.

    Attributes:
        path: states from the current state to an accepting state; the edge is the path's first transition.
        edge: source and target state.
        progress: guard of the edge, which must hold to take the edge.
        constraints: guards of other edges, which must not hold before the edge is taken.
        candidates: considered objects in the order of the settings' `movable`; by name without `movable`.
        pruned: reason why the edge was pruned; None for an edge that was not pruned.
        motions: planned motions to acceptance, beginning with the chosen candidate's motion. Empty if the
            planner does not look ahead.
        is_joint: whether several objects are moved for the edge. The chosen candidate's map then has the
            other objects at the ends of their motions.
        failed: greatest number of failed motions that one object has for the edge.
        order: reason why the edge precedes edges of equally short paths; empty without such edges.
    """

    path: tuple[int, ...]
    edge: Edge
    progress: Guards
    constraints: Guards
    candidates: tuple[Candidate, ...]
    pruned: Reason | None = None
    motions: tuple[Target, ...] = ()
    is_joint: bool = False
    failed: int = 0
    order: str = ""


class Search(NamedTuple):
    """The search effort of a decision.

    Attributes:
        maps: number of computed maps; the evaluation of one sample counts as a quarter of a map.
        arrangements: number of arrangements of several objects for which an order of motions was searched.
        parking_places: number of parking places tried for objects that are in the way of other objects.
    """

    maps: float = 0.0
    arrangements: int = 0
    parking_places: int = 0


@dataclass(frozen=True, slots=True)
class Loss:
    """The loss of acceptance.

    Attributes:
        time_ns: time of the first sample from which the specification cannot be satisfied.
        text: forbidden condition that held in this sample; empty if unknown propositions hide the condition.
    """

    time_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Step(Displayed):
    """A decision.

    Attributes:
        number: number of the decision in its run, from 0.
        time_ns: time of the newest sample.
        kind: kind of the step.
        states: possible states of the automaton; more than one if propositions are unknown.
        considered: considered edges, in order; the last edge is the aim if it was not pruned.
        target: object to move and its target pose; None without a motion.
        pruned: all pruned edges with their reasons.
        reason: sentence on the decision.
        ahead: states that the automaton visits while only time passes, for a wait; otherwise empty.
        lost: time and cause of the loss of acceptance; None while the specification can be satisfied.
        search: search effort.
    """

    number: int
    time_ns: int
    kind: Kind
    states: tuple[int, ...]
    considered: tuple[Consideration, ...]
    target: Target | None
    pruned: tuple[tuple[Edge, Reason], ...]
    reason: str
    ahead: tuple[int, ...] = ()
    lost: Loss | None = None
    search: Search = field(default_factory=Search)

    @property
    def aim(self) -> Consideration | None:
        """The edge that the step works towards; None if there is no such edge."""
        return self.considered[-1] if self.considered and not self.considered[-1].pruned else None

    def alternatives(self, count: int) -> tuple[Target, ...]:
        """Return the best places apart from the target, the most robust first.

        These places are centres of free cells for any candidate of the aim. They are at least two cells from
        the target and from each other. The paths to these places, and later motions, are not checked.
        """
        targets = []
        for candidate in self.candidates:
            sample = candidate.map.made_of.now.about.sample
            tracked = sample.objects[candidate.name]
            start, yaw = centre_of(tracked.footprint), tracked.yaw
            avoided_places = [] if candidate.target is None else [(candidate.target.x, candidate.target.y)]
            targets += [
                Target(
                    candidate.name,
                    x,
                    y,
                    turn,
                    None if yaw is None else yaw + turn,
                    (start, (x, y)),
                    robustness,
                )
                for x, y, turn, robustness in candidate.map.best_poses(count, avoided_places)
            ]
        return tuple(sorted(targets, key=lambda target: -target.robustness)[:count])

    @property
    def progress(self) -> Guards:
        """Progress set: guards, one of which must hold next; empty without an aim."""
        return self.aim.progress if self.aim is not None else Guards((), ())

    @property
    def constraints(self) -> Guards:
        """Constraint set: guards that must not hold on the way; empty without an aim."""
        return self.aim.constraints if self.aim is not None else Guards((), ())

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """The considered objects of the aim."""
        return self.aim.candidates if self.aim is not None else ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of the execution of a step, according to the controller.

    Attributes:
        succeeded: whether the object is at its target, according to the controller.
        reason: sentence on the result.
        at: stage at which the motion failed; None for an unknown stage.
    """

    succeeded: bool
    reason: str = ""
    at: Stage | None = None

    def __post_init__(self) -> None:
        """Check the stage.

        Raises:
            UsageError: `at` is no stage.
        """
        if self.at is not None and self.at not in get_args(Stage):
            raise UsageError(f'a motion fails at {self.at!r}; give at="pick", "way" or "place", or None')


def wait_outcome(step: Step, states: tuple[int, ...]) -> Outcome:
    """Return the outcome of a wait that ended with the automaton in `states`."""
    if not step.ahead:
        # of these waits, only a wait for moving objects has an aim
        reason = "enough is seen" if step.aim is None else "nothing is in the way any more"
        return Outcome(succeeded=True, reason=reason)
    if states == step.ahead[-1:]:
        return Outcome(succeeded=True, reason="the time has passed")
    return Outcome(succeeded=False, reason="what is seen has changed")


def sentence_of(step: Step) -> str:
    """Return the reason of a step, with the time and cause of a loss of acceptance."""
    if step.lost is None:
        return step.reason
    cause_text = f", when this held: {step.lost.text}" if step.lost.text else ""
    return f"{step.reason}; that was lost at {time_text(step.lost.time_ns)}{cause_text}"


class Executor(Protocol):
    """A robot controller, which moves objects."""

    def execute(self, step: Step) -> Outcome:
        """Move `step.target.name` to its target, along the waypoints if the path matters to the robot.

        Return when the robot is at rest. The planner must observe samples during or after the motion. If the
        planner's `stop_reason` is not empty after a sample, stop the motion and return a failure with this
        reason.
        """

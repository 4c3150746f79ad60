"""Decisions of a planner as values: steps, the edges and objects considered, targets, outcomes."""

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
    # a report reads reasons without loading the kernels behind maps
    from spatial_replay.planning.maps import Cubes, GradientMap

Kind: TypeAlias = Literal["execute", "hold", "wait", "no path"]
"""The kind of a step: move an object, hold because the specification is satisfied, wait, or stop because no
path to acceptance is left. A step waits for an observation, for time to pass or for others that move."""

Stage: TypeAlias = Literal["pick", "way", "place"]
"""Stages of a motion: picking the object, moving it, placing it at the target."""

Edge: TypeAlias = tuple[int, int]
"""A transition of the automaton, from one state to another."""


@dataclass(frozen=True, slots=True)
class Reason:
    """Why an edge was pruned.

    Attributes:
        kind: the same text for all edges pruned for the same cause.
        detail: what differs from edge to edge, such as the cause for each object; may be empty.
    """

    kind: str
    detail: str = ""

    @classmethod
    def from_text(cls, text: str) -> Reason:
        """Read a reason from the text that `str` gives, as logs hold it."""
        kind, _, detail = text.partition(" (")
        return cls(kind, detail.removesuffix(")"))

    def __str__(self) -> str:
        return f"{self.kind} ({self.detail})" if self.detail else self.kind


@dataclass(frozen=True, slots=True)
class Guards:
    """A set of guards: in a progress set one of them has to hold, in a constraint set none may.

    Attributes:
        cubes: over the automaton's propositions.
        texts: each cube as text.
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
    """The pose that an object is to be moved to.

    Attributes:
        name: of the object.
        x, y: of its centre at the target, in footprint units.
        turn: angle in radians to turn the object by.
        yaw: its orientation at the target, in radians; None if it has none.
        waypoints: points (x, y) of the path, both ends included; only the ends if the path does not matter.
        robustness: of the progress set with the object at the target.
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
        """x, y and turn."""
        return self.x, self.y, self.turn

    @property
    def length(self) -> float:
        """Length of the path, in footprint units."""
        return sum(math.dist(start, end) for start, end in pairwise(self.waypoints))


def points_along(waypoints: Sequence[tuple[float, float]], step: float) -> Iterator[tuple[float, float]]:
    """Yield points on a way, no farther apart than a step."""
    yield waypoints[0]
    for (u, v), (x, y) in pairwise(waypoints):
        count = max(1, math.ceil(math.dist((u, v), (x, y)) / step))
        yield from ((u + k / count * (x - u), v + k / count * (y - v)) for k in range(1, count + 1))


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An object that could be moved to take an edge.

    Attributes:
        name: of the object.
        map: robustness of the progress set over the positions of the object.
        target: where it would go; None if it was rejected.
        rejected: why it was rejected; empty if it was not.
        is_chosen: whether this is the object to move.
        failed: places (x, y) where earlier motions failed, from which a target stays away.
        room_from: the objects from which its target keeps room; None for everything.
    """

    name: str
    map: GradientMap = field(repr=False)
    target: Target | None
    rejected: str = ""
    is_chosen: bool = False
    failed: tuple[tuple[float, float], ...] = ()
    room_from: tuple[str, ...] | None = ()


@dataclass(frozen=True, slots=True)
class Consideration:
    """An edge that a planner considered.

    Attributes:
        path: states from the current one to an accepting one; the edge is its first transition.
        edge: source and target state.
        progress: what has to hold for the edge to be taken.
        constraints: what must not hold on the way, since it takes another edge.
        candidates: the objects considered, in the order of the settings' `movable`; without it, by name.
        pruned: why the edge was pruned; None if it was not.
        motions: the motions planned from here to acceptance, the chosen candidate's first; empty if the
            planner does not look ahead.
        is_joint: whether objects are moved together for the edge; the chosen candidate's map then has the
            others where these motions bring them.
        failed: how many motions for the edge have failed before, of those that count as attempts.
        order: why the edge comes before those on paths that are as short; empty without any.
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
    """How much was searched for a decision.

    Attributes:
        maps: maps computed, up to a limit; a look at one sample counts as a quarter of a map.
        arrangements: of several objects, of which an order of motions was looked for.
        parking_places: that were tried for objects in the way of others.
    """

    maps: float = 0.0
    arrangements: int = 0
    parking_places: int = 0


@dataclass(frozen=True, slots=True)
class Loss:
    """How acceptance was lost.

    Attributes:
        time_ns: of the sample after which the specification could not be satisfied any more.
        text: what it had that the specification forbids; empty if too little was known to say.
    """

    time_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Step(Displayed):
    """A decision.

    Attributes:
        number: counts the decisions of a run from 0.
        time_ns: of the sample that it was made on.
        kind: what to do.
        states: where the automaton can be; more than one if propositions are unknown.
        considered: the edges considered, in order; the last one is the aim unless it was pruned.
        target: what to move where, if anything.
        pruned: all edges pruned so far, each with its reason.
        reason: the decision as a sentence.
        ahead: the states that a wait expects from time alone; empty if it waits for something else.
        lost: when and by what acceptance was lost; None while the specification can be satisfied.
        search: how much was searched.
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
        """The edge that the step is for, if any."""
        return self.considered[-1] if self.considered and not self.considered[-1].pruned else None

    def alternatives(self, count: int) -> tuple[Target, ...]:
        """Return the best places besides the target, the most robust first.

        They are middles of free cells for any object of the aim, at least two cells from the target and from
        each other. Whether a way leads there, and what follows, is not checked.
        """
        targets = []
        for candidate in self.candidates:
            sample = candidate.map.made_of.now.about.sample
            tracked = sample.objects[candidate.name]
            start, yaw = centre_of(tracked.footprint), tracked.yaw
            avoided = [] if candidate.target is None else [(candidate.target.x, candidate.target.y)]
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
                for x, y, turn, robustness in candidate.map.best_poses(count, avoided)
            ]
        return tuple(sorted(targets, key=lambda target: -target.robustness)[:count])

    @property
    def progress(self) -> Guards:
        """Progress set: propositions that have to hold next; empty without an aim."""
        return self.aim.progress if self.aim is not None else Guards((), ())

    @property
    def constraints(self) -> Guards:
        """Constraint set: propositions that must not hold on the way; empty without an aim."""
        return self.aim.constraints if self.aim is not None else Guards((), ())

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """The objects considered for the aim."""
        return self.aim.candidates if self.aim is not None else ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """How the execution of a step ended, according to the controller.

    Attributes:
        succeeded: whether the controller takes the object to be at its target.
        reason: what happened, as a sentence.
        at: the stage at which it failed; None if it is not known.
    """

    succeeded: bool
    reason: str = ""
    at: Stage | None = None

    def __post_init__(self) -> None:
        """Check the stage.

        Raises:
            UsageError: another stage.
        """
        if self.at is not None and self.at not in get_args(Stage):
            raise UsageError(f'a motion fails at {self.at!r}; give at="pick", "way" or "place", or None')


def wait_outcome(step: Step, states: tuple[int, ...]) -> Outcome:
    """Return the outcome of a wait that ended with the automaton in these states."""
    if not step.ahead:
        # only a wait for others is for an edge
        reason = "enough is seen" if step.aim is None else "nothing is in the way any more"
        return Outcome(succeeded=True, reason=reason)
    if states == step.ahead[-1:]:
        return Outcome(succeeded=True, reason="the time has passed")
    return Outcome(succeeded=False, reason="what is seen has changed")


def sentence_of(step: Step) -> str:
    """Return the reason of a step, with when and by what acceptance was lost."""
    if step.lost is None:
        return step.reason
    why = f", when this held: {step.lost.text}" if step.lost.text else ""
    return f"{step.reason}; that was lost at {time_text(step.lost.time_ns)}{why}"


class Executor(Protocol):
    """A robot controller, which moves objects."""

    def execute(self, step: Step) -> Outcome:
        """Move `step.target.name` to its target, along the waypoints if the path matters to the robot.

        Return once the robot is at rest. The planner observes samples during the motion, or after it. If its
        `stop_reason` is not empty after one, stop, and return that as the reason of a failure.
        """

"""What a planner decides, and what comes of it, as values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, Protocol, TypeAlias

from spatial_replay.lazy import Displayed
from spatial_replay.planning.maps import Cubes, GradientMap

Kind: TypeAlias = Literal["execute", "hold", "wait", "no path"]
"""What is to be done: move an object; nothing, for the specification is satisfied; nothing yet, for too
little is seen or time has to pass; nothing any more, for there is no path left."""

Edge: TypeAlias = tuple[int, int]
"""A transition of the automaton, from one state to another."""


@dataclass(frozen=True, slots=True)
class Guards:
    """A set of guards: one of them is to hold (a progress set), or none may (a constraint set).

    Attributes:
        cubes: over the automaton's propositions.
        texts: each cube in words.
    """

    cubes: Cubes
    texts: tuple[str, ...]

    def __str__(self) -> str:
        return " or ".join(f"({text})" for text in self.texts) if len(self.texts) > 1 else "".join(self.texts)


@dataclass(frozen=True, slots=True)
class Target:
    """Where an object is to go.

    Attributes:
        name: of the object.
        x, y: for its centre, in footprint units.
        turn: by how much it is to be turned, in radians.
        yaw: its orientation then, in radians; None if it has none.
        waypoints: points (x, y) on the way from where it is, both ends included; these alone where only the
            end matters.
        robustness: how well the progress set will hold.
    """

    name: str
    x: float
    y: float
    turn: float
    yaw: float | None
    waypoints: tuple[tuple[float, float], ...]
    robustness: float

    @property
    def length(self) -> float:
        """Of the way, in footprint units."""
        return sum(math.dist(one, other) for one, other in pairwise(self.waypoints))


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An object that could be moved to take an edge.

    Attributes:
        name: of the object.
        map: how well the progress set would hold with it elsewhere.
        target: where it would go; None if it was rejected.
        rejected: why, or "".
        is_chosen: whether this is the one to move.
    """

    name: str
    map: GradientMap = field(repr=False)
    target: Target | None
    rejected: str = ""
    is_chosen: bool = False


@dataclass(frozen=True, slots=True)
class Consideration:
    """An edge that a planner looked into.

    Attributes:
        path: the states from the current one to an accepting one that the edge begins.
        edge: from which state to which.
        progress: what is to hold for the edge to be taken.
        constraints: what must not hold on the way, for it leads elsewhere.
        candidates: the objects looked at, in the order of the settings' `movable`; without it, by name.
        pruned: why the edge was given up, or "".
    """

    path: tuple[int, ...]
    edge: Edge
    progress: Guards
    constraints: Guards
    candidates: tuple[Candidate, ...]
    pruned: str = ""


@dataclass(frozen=True, slots=True)
class Step(Displayed):
    """A decision.

    Attributes:
        number: how many decisions came before.
        time_ns: of the sample that it was made on.
        kind: what is to be done.
        states: where the automaton is; more than one where not enough is seen to tell.
        considered: the edges looked into, in order; the last one is aimed at unless it was given up.
        target: what to move where, if anything.
        pruned: all edges given up so far, each with its reason.
        reason: the decision in words.
        ahead: of a wait, the states to which time alone is to lead; none where too little is seen.
    """

    number: int
    time_ns: int
    kind: Kind
    states: tuple[int, ...]
    considered: tuple[Consideration, ...]
    target: Target | None
    pruned: tuple[tuple[Edge, str], ...]
    reason: str
    ahead: tuple[int, ...] = ()

    @property
    def aim(self) -> Consideration | None:
        """The edge aimed at; None where there is none."""
        return self.considered[-1] if self.considered and not self.considered[-1].pruned else None

    @property
    def progress(self) -> Guards:
        """What is to hold next; nothing where nothing is to be done."""
        return self.aim.progress if self.aim is not None else _NOTHING

    @property
    def constraints(self) -> Guards:
        """What must not hold on the way."""
        return self.aim.constraints if self.aim is not None else _NOTHING

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Every object that was considered for the edge aimed at."""
        return self.aim.candidates if self.aim is not None else ()


_NOTHING = Guards((), ())


@dataclass(frozen=True, slots=True)
class Outcome:
    """How the execution of a step went, as far as the controller can tell.

    Attributes:
        succeeded: whether it thinks that the object is where it was to be.
        reason: what happened, in words.
    """

    succeeded: bool
    reason: str = ""


def wait_outcome(step: Step, states: tuple[int, ...]) -> Outcome:
    """How a wait went that ended with the automaton in these states."""
    if not step.ahead:
        return Outcome(succeeded=True, reason="enough is seen")
    if states == step.ahead[-1:]:
        return Outcome(succeeded=True, reason="the time has passed")
    return Outcome(succeeded=False, reason="what is seen has changed")


class Executor(Protocol):
    """What moves objects: a controller of a robot."""

    def execute(self, step: Step) -> Outcome:
        """Move `step.target.name` to its target, along its waypoints if the way matters to the robot.

        It returns when the robot has come to rest; meanwhile, or after it, the planner observes samples.
        """

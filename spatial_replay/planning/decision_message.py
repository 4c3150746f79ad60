"""Decisions, and what came of them, as messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from spatial_replay.logs.messages.PlanDecision_pb2 import (
    PlanCandidate,
    PlanDecision,
    PlanEdge,
    PlanGuard,
    PlanMap,
    PlanOutcome,
    PlanTarget,
    PrunedEdge,
)
from spatial_replay.planning.map_message import TurnedMap, map_digest, maps_of
from spatial_replay.planning.step import Candidate, Consideration, Guards, Kind, Outcome, Step, Target

_KINDS: MappingProxyType[Kind, PlanDecision.Kind.ValueType] = MappingProxyType(
    {
        "execute": PlanDecision.KIND_EXECUTE,
        "hold": PlanDecision.KIND_HOLD,
        "wait": PlanDecision.KIND_WAIT,
        "no path": PlanDecision.KIND_NO_PATH,
    }
)


def decision_message(step: Step, specification: str, first_map: int) -> PlanDecision:
    """A decision, without an outcome.

    Args:
        first_map: how many maps the log has before those of this step.
    """
    numbers = {turned: number for number, turned in enumerate(maps_of(step), first_map)}
    return PlanDecision(
        time_ns=step.time_ns,
        number=step.number,
        specification=specification,
        kind=_KINDS[step.kind],
        states=step.states,
        considered=[_edge(each, numbers) for each in step.considered],
        target=None if step.target is None else _target(step.target),
        pruned=[
            PrunedEdge(source=source, target=target, reason=reason)
            for (source, target), reason in step.pruned
        ],
        reason=step.reason,
    )


def outcome_message(
    outcome: Outcome, end_ns: int, states: Sequence[int], travelled: Sequence[tuple[float, float]]
) -> PlanOutcome:
    """How a step went, and where its object and the automaton were then."""
    return PlanOutcome(
        end_ns=end_ns,
        succeeded=outcome.succeeded,
        reason=outcome.reason,
        states=states,
        travelled=[coordinate for point in travelled for coordinate in point],
    )


def _edge(consideration: Consideration, numbers: Mapping[TurnedMap, int]) -> PlanEdge:
    return PlanEdge(
        path=consideration.path,
        source=consideration.edge[0],
        target=consideration.edge[1],
        progress=_guards(consideration.progress),
        constraints=_guards(consideration.constraints),
        candidates=[_candidate(each, numbers) for each in consideration.candidates],
        pruned=consideration.pruned,
    )


def _guards(guards: Guards) -> list[PlanGuard]:
    return [
        PlanGuard(text=text, propositions=[number for number, _ in cube], values=[value for _, value in cube])
        for cube, text in zip(guards.cubes, guards.texts, strict=True)
    ]


def _candidate(candidate: Candidate, numbers: Mapping[TurnedMap, int]) -> PlanCandidate:
    return PlanCandidate(
        object=candidate.name,
        best=candidate.map.best(),
        map_sha256=map_digest(candidate.map),
        target=None if candidate.target is None else _target(candidate.target),
        rejected=candidate.rejected,
        chosen=candidate.is_chosen,
        maps=[
            PlanMap(number=numbers[TurnedMap(candidate, place)], turn=turn)
            for place, turn in enumerate(candidate.map.turns.tolist())
        ],
    )


def _target(target: Target) -> PlanTarget:
    return PlanTarget(
        object=target.name,
        x=target.x,
        y=target.y,
        turn=target.turn,
        yaw=target.yaw,
        waypoints=[coordinate for point in target.waypoints for coordinate in point],
        robustness=target.robustness,
    )

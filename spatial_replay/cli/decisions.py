"""Decisions of a planned run as text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any, Final

from spatial_replay.cli.terminal import fitted
from spatial_replay.text import counted, json_number, time_text

if TYPE_CHECKING:
    from google.protobuf.message import Message

    from spatial_replay.logs.remote import LogFile
    from spatial_replay.logs.schemas.PlanDecision_pb2 import (
        PlanCandidate,
        PlanDecision,
        PlanEdge,
        PlanTarget,
    )

_LONGEST: Final = 400
"""Characters of alternatives that are printed; JSON has all."""


def decision_lines(log: LogFile, decisions: Sequence[PlanDecision], width: int) -> Iterator[str]:
    """Yield lines about each decision: its aim, the candidates, the choice and the outcome.

    Args:
        width: of the lines, in characters.
    """
    yield from fitted_lines(_whole_lines(log, decisions), width)


def fitted_lines(lines: Iterable[str], width: int) -> Iterator[str]:
    """Yield lines that are no wider than a number of characters."""
    for line in lines:
        yield from fitted(line, width)


def decision_rows(decisions: Sequence[PlanDecision]) -> list[dict[str, Any]]:
    """Return decisions as values for JSON."""
    from google.protobuf.json_format import MessageToDict

    rows = [MessageToDict(decision, preserving_proto_field_name=True) for decision in decisions]
    for row, decision in zip(rows, decisions, strict=True):
        _write_numbers(row, decision)
        row["kind"] = decision.Kind.Name(decision.kind).removeprefix("KIND_").lower().replace("_", " ")
    return rows


def _write_numbers(row: dict[str, Any], message: Message) -> None:
    """Write numbers that protobuf writes as text, such as 64-bit integers, as in all our JSON."""
    for field, value in message.ListFields():
        written = row[field.name]
        if field.type == field.TYPE_FIXED64:
            row[field.name] = value
        elif field.type == field.TYPE_DOUBLE:
            many = isinstance(written, list)
            row[field.name] = [json_number(each) for each in value] if many else json_number(value)
        elif field.type == field.TYPE_MESSAGE:
            parts = zip(written, value, strict=True) if isinstance(written, list) else [(written, value)]
            for part, of_part in parts:
                _write_numbers(part, of_part)


def _whole_lines(log: LogFile, decisions: Sequence[PlanDecision]) -> Iterator[str]:
    *before, last = decisions
    motions = sum(decision.HasField("target") and decision.HasField("outcome") for decision in decisions)
    is_cut = last.HasField("target") and not last.HasField("outcome")
    yield (
        f"{log.name}: {counted(len(decisions), 'decision')} for {last.specification!r}, "
        f"{counted(motions, 'motion')}{' and one cut short' if is_cut else ''}, "
        f"{counted(len(last.pruned), 'edge')} given up"
    )
    for decision in before:
        yield from step_lines(decision)
    yield from step_lines(last)
    if is_cut:
        yield "  the log ends during this motion"


def step_lines(decision: PlanDecision) -> Iterator[str]:
    """Yield lines about one decision."""
    states = ", ".join(map(str, decision.states))
    yield f"step {decision.number} at {time_text(decision.time_ns)}, state {states}"
    for place, edge in enumerate(decision.considered, 1):
        yield from _edge_lines(edge, is_aim=place == len(decision.considered) and not edge.pruned)
    if not decision.HasField("target"):
        yield f"  {decision.reason}"
    else:
        yield f"  {choice_text(decision)}"
        yield f"  {_target(decision.target)}"
    if decision.HasField("lost"):
        why = f": {decision.lost.text}" if decision.lost.text else ""
        yield f"  since {time_text(decision.lost.time_ns)} it cannot be satisfied{why}"
    if decision.HasField("outcome"):
        outcome = decision.outcome
        how = "done" if outcome.succeeded else f"failed ({outcome.at})" if outcome.at else "failed"
        after = ", ".join(map(str, outcome.states))
        yield f"  {how} at {time_text(outcome.end_ns)}: {outcome.reason}; state {after}"


def choice_text(decision: PlanDecision) -> str:
    """Return what is done, without what has to hold next, which is in the decision's edges."""
    aim = _either([guard.text for edge in decision.considered[-1:] for guard in edge.progress])
    return decision.reason.removesuffix(f": {aim}")


def _edge_lines(edge: PlanEdge, *, is_aim: bool) -> Iterator[str]:
    from spatial_replay.planning.decisions import Reason, candidate_lines

    path = " -> ".join(map(str, edge.path))
    yield f"  {'aimed at' if is_aim else 'looked into'} {edge.source} -> {edge.target} on the path {path}"
    yield f"    to reach  {_some([guard.text for guard in edge.progress])}"
    if edge.constraints:
        yield f"    never     {_some([guard.text for guard in edge.constraints])}"
    for candidate in edge.candidates:
        yield f"    {_candidate(candidate)}"
        yield from (f"      {key:<11}{text}" for key, text in candidate_lines(candidate))
    if len(edge.motions) > 1:
        yield f"    planned   {', then '.join(_place(each) for each in edge.motions)}"
    if edge.pruned:
        yield f"    given up: {Reason.from_text(edge.pruned).kind}"


def _candidate(candidate: PlanCandidate) -> str:
    name = f"{candidate.object}{_maps(candidate)}"
    if candidate.rejected:
        return f"{name}: rejected, {candidate.rejected}"
    mark = "chosen" if candidate.chosen else "possible"
    return f"{name}: {mark}, {candidate.best:.4g} at best; {_target(candidate.target)}"


def _maps(candidate: PlanCandidate) -> str:
    """Return the numbers of its messages on the topic of gradient maps."""
    numbers = sorted(each.number for each in candidate.maps)
    if len(numbers) < 2:
        return "".join(f" (map {number})" for number in numbers)
    return f" (maps {numbers[0]} to {numbers[-1]})"


def _target(target: PlanTarget) -> str:
    points = list(zip(target.waypoints[::2], target.waypoints[1::2], strict=True))
    length = sum(math.dist(one, other) for one, other in pairwise(points))
    turned = f", turned by {math.degrees(target.turn):.3g} deg" if target.turn else ""
    return (
        f"{target.object} to ({target.x:.4g}, {target.y:.4g}){turned}, path length {length:.4g}, "
        f"robustness {target.robustness:.4g}"
    )


def _place(target: PlanTarget) -> str:
    return f"{target.object} to ({target.x:.4g}, {target.y:.4g})"


def _either(texts: Sequence[str]) -> str:
    return " or ".join(f"({text})" for text in texts) if len(texts) > 1 else "".join(texts)


def _some(texts: Sequence[str]) -> str:
    """Return alternatives, or the first of them and the number of the others."""
    ends = list(accumulate(map(len, texts)))
    count = max(1, sum(end <= _LONGEST for end in ends))
    more = f" or {len(texts) - count} more" if count < len(texts) else ""
    return (f"({texts[0]})" if more and count == 1 else _either(texts[:count])) + more

"""Decisions of a planner as messages of a log: outcomes, gradient maps with their layers, paths to draw."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import DecodeError, Message

from spatial_replay.annotate.scene.scene_frames import cell_colours
from spatial_replay.annotate.scene.scene_template import FRAME
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.footprint import TrackedObject, centre_of
from spatial_replay.logs.messages import Messages, merge, messages_of
from spatial_replay.logs.schemas.PlanDecision_pb2 import (
    PlanCandidate,
    PlanCause,
    PlanConjunct,
    PlanDecision,
    PlanEdge,
    PlanGuard,
    PlanLoss,
    PlanMap,
    PlanOutcome,
    PlanRoom,
    PlanSearch,
    PlanTarget,
    PrunedEdge,
)
from spatial_replay.logs.topics import (
    EVENT_LOG,
    GRADIENT_MAP,
    MAP_DRAWING,
    PLAN_DECISION,
    PLAN_PATH,
    protobuf_channel,
)
from spatial_replay.planning.decisions import (
    Candidate,
    Consideration,
    Guards,
    Outcome,
    Reason,
    Step,
    Target,
    either,
    wait_outcome,
)
from spatial_replay.planning.demands import Ban, ban_of, demand_of, rules_of, wanted_of
from spatial_replay.planning.map_drawing import DEPTH, MapFrame, map_drawing, map_frame, path_message
from spatial_replay.planning.maps import MOST_LAYERS, GradientMap, MapLayers, map_layers
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings import Settings, text_from_settings
from spatial_replay.planning.targets import (
    NOWHERE,
    Ways,
    good_cells,
    least_room,
    room_cost,
    tried_cells,
    ways_of,
)
from spatial_replay.text import json_number, plural, time_text
from spatial_replay.trace.trace import Sample

# ------------------------------------------------------------------------------------------------------- maps

_COLOURS: Final = ("red", "green", "blue", "alpha")
_FIELD_TYPES: Final[Mapping[str, PackedElementField.NumericType.ValueType]] = MappingProxyType(
    {
        "<f4": PackedElementField.FLOAT32,
        "<u2": PackedElementField.UINT16,
        "|u1": PackedElementField.UINT8,
    }
)
"""Type of a cell's field for each NumPy type."""


class TurnedMap(NamedTuple):
    """A candidate's map for one orientation of the object; `turn` is an index into the map's `turns`."""

    candidate: Candidate
    turn: int


def maps_of(step: Step) -> list[TurnedMap]:
    """Return all maps of a step, edge by edge, in the order of the log.

    The last map is the chosen object's map in its target orientation, because a viewer shows the last message
    of a topic.
    """
    return [
        TurnedMap(candidate, turn)
        for edge in step.considered
        for candidate in sorted(edge.candidates, key=lambda member: member.is_chosen)
        for turn in sorted(range(len(candidate.map.turns)), key=lambda turn: _is_aim(candidate, turn))
    ]


def _is_aim(candidate: Candidate, turn: int) -> bool:
    """Return whether `turn` is the map's orientation that is nearest to the target's orientation."""
    target = candidate.target
    return target is not None and candidate.map.cell_of(target.x, target.y, target.turn)[0] == turn


def map_digest(gradient: GradientMap) -> bytes:
    """Return the SHA-256 of a map's values: little-endian float64 by turn, row and column; NaN if blocked."""
    return hashlib.sha256(np.ascontiguousarray(gradient.values, "<f8").tobytes()).digest()


def map_message(turned: TurnedMap, time_ns: int, layers: MapLayers, ways: Ways | None = None) -> GridMessage:
    """Return a map as a message; viewers draw it below the scene. Blocked cells are NaN and transparent.

    Args:
        ways: ways that were compared for the push to the map's target, or None.
    """
    gradient = turned.candidate.map
    grid, values = gradient.grid, gradient.values[turned.turn]
    colours = dict(zip(_COLOURS, np.moveaxis(cell_colours(values), -1, 0), strict=True))
    fields = {"robustness": values.astype("<f4"), **colours, **dict(_fields(turned, layers))}
    if ways is not None and _is_aim(turned.candidate, turned.turn):
        fields["way"] = _singles(ways.lengths)
    # the schema foxglove.Grid packs all fields of a cell together
    packed_cells = np.empty(
        values.shape, [(name, field_values.dtype.str) for name, field_values in fields.items()]
    )
    for name, field_values in fields.items():
        packed_cells[name] = field_values
    cell_bytes = packed_cells.dtype.itemsize
    message = GridMessage(
        frame_id=FRAME,
        column_count=grid.columns,
        row_stride=cell_bytes * grid.columns,
        cell_stride=cell_bytes,
        data=packed_cells.tobytes(),
    )
    message.timestamp.FromNanoseconds(time_ns)
    message.pose.position.x, message.pose.position.y = grid.xmin, grid.ymin
    message.pose.position.z = -DEPTH * grid.cell_size
    message.pose.orientation.w = 1.0
    message.cell_size.x = message.cell_size.y = grid.cell_size
    offset = 0
    for name, field_values in fields.items():
        message.fields.add(name=name, offset=offset, type=_FIELD_TYPES[field_values.dtype.str])
        offset += field_values.dtype.itemsize
    return message


def _fields(turned: TurnedMap, layers: MapLayers) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the layers of a map for one orientation: pairs of a name and values (rows, columns)."""
    turn, gradient, room_from = turned.turn, turned.candidate.map, turned.candidate.room_from
    yield "limited_by", (layers.limiting[turn] + 1).astype("<u2")
    yield "blocked_by", (layers.blocked_by[turn] + 1).astype("<u2")
    yield "clearance", _singles(gradient.clearance[turn])
    yield "room", _singles(gradient.made_of.now.room(room_from)[turn])
    is_varying = [bool((layer != layer.flat[0]).any()) for layer in layers.robustness]
    conjunct_numbers = sorted(range(len(is_varying)), key=lambda number: not is_varying[number])[:MOST_LAYERS]
    for number in sorted(conjunct_numbers):
        # a leading number, so that no conjunct has the name of another field
        name = f"{number + 1}: {layers.conjuncts[number]}"
        yield name, _singles(layers.robustness[number, turn])


def _singles(values: np.ndarray) -> np.ndarray:
    """Return single-precision numbers for viewers, which need NaN instead of infinite numbers."""
    return np.where(np.isfinite(values), values, np.nan).astype("<f4")


def map_fields(message: GridMessage) -> dict[str, np.ndarray]:
    """Return each field of a map's message, (rows, columns); empty if the sizes in the message do not fit."""
    columns, cell_bytes, row_bytes = message.column_count, message.cell_stride, message.row_stride
    rows = len(message.data) // row_bytes if row_bytes else 0
    if not rows or not columns or cell_bytes * columns > row_bytes:
        return {}
    # a field without a type is read as a number
    type_names = {PackedElementField.UNKNOWN: "<f4"} | {kind: name for name, kind in _FIELD_TYPES.items()}
    return {
        field.name: np.ndarray(
            (rows, columns), type_names[field.type], message.data, field.offset, (row_bytes, cell_bytes)
        )
        for field in message.fields
        if field.type in type_names and field.offset + np.dtype(type_names[field.type]).itemsize <= cell_bytes
    }


def explain(
    message: PlanCandidate,
    candidate: Candidate,
    layers: MapLayers,
    settings: Settings,
    bans: Sequence[Ban],
    ways: Ways | None,
) -> None:
    """Add to a candidate its map's relations, the causes of blocked cells, and the rule for the target.

    Args:
        bans: constraint set of the candidate's edge.
        ways: ways that were compared for a push to the candidate's target, or None.
    """
    target = candidate.target
    if candidate.rejected.startswith(NOWHERE):
        limiting = layers.limiting.flat[candidate.map.robustness.argmax()]
        demand = demand_of(layers.conjuncts[limiting], bans, is_required=layers.required[limiting])
        message.rejected += f", and the best place is limited by {plain(demand)}"
    free_limits = layers.limiting[layers.blocked_by < 0]
    limit_counts = np.bincount(free_limits[free_limits >= 0], minlength=len(layers.conjuncts)).tolist()
    target_cell = None if target is None else candidate.map.cell_of(target.x, target.y, target.turn)
    for index, text in enumerate(layers.conjuncts):
        target_robustness = None if target_cell is None else float(layers.robustness[index][target_cell])
        words = demand_of(text, bans, is_required=layers.required[index])
        message.conjuncts.append(
            PlanConjunct(text=text, limits=limit_counts[index], at_target=target_robustness, words=words)
        )
    for cause in layers.causes:
        kind = PlanCause.Kind.Value(f"KIND_{cause.kind.upper()}")
        words = cause_sentence(kind, cause.name, bans, settings.constraint_margin)
        message.causes.append(PlanCause(kind=kind, text=cause.name, cells=cause.cells, words=words))
    if target is not None and (cost := room_cost(candidate, target, settings)) is not None:
        room = PlanRoom(wanted=settings.room, possible=cost.robustness, clearance=cost.room)
        message.room.CopyFrom(room)
    if target is None:
        return
    if candidate.rule:
        message.rule = candidate.rule
    elif ways is not None:
        message.least_way = ways.shortest
        message.rule = _push_rule(ways, target, candidate.map.grid.cell_size)
    elif settings.skill == "place":
        required_room = _least_room(candidate, settings)
        if required_room > 0.0:
            message.least_room = required_room
        message.rule = _place_rule(required_room, settings.room)


def _push_rule(ways: Ways, target: Target, cell_size: float) -> str:
    """Return the rule by which the target of a push is chosen among suitable places."""
    x, y = ways.end
    rule = f"of places that will do, ({x:.4g}, {y:.4g}) has the shortest way over cells, {ways.shortest:.4g}"
    if math.dist(ways.end, (target.x, target.y)) < 1e-6 * cell_size:
        return rule
    return f"{rule}; the target is a more robust place within 2 cells ({2.0 * cell_size:.4g}) of it"


def _place_rule(required_room: float, preferred_room: float) -> str:
    """Return the rule by which the target of a placement is chosen among suitable places."""
    if required_room > 0.0:
        places = f"of places with room {required_room:.4g} around them"
        return f"{places} the most robust is taken, of equal ones the nearest"
    lack_text = f"no place has the preferred room of {preferred_room:.4g}; " if preferred_room > 0.0 else ""
    return f"{lack_text}the most robust place is taken, of equal ones the nearest"


def _least_room(candidate: Candidate, settings: Settings) -> float:
    """Return the room that the target of a placement keeps; -inf if no place has the preferred room."""
    is_good = good_cells(candidate.map, settings, candidate.failed, candidate.failures)
    room = candidate.map.made_of.now.room(candidate.room_from)
    return least_room(is_good, room, settings, candidate.failures)


# -------------------------------------------------------------------------------------------------- decisions

PLAN_VERSION: Final = 4
"""Version of the messages; a log of another version cannot be recomputed."""

MOST_LISTED: Final = 3
"""Maximum number of listed conjuncts of a map, and of listed causes."""

_LONGEST: Final = 400
"""Maximum length of alternatives in a text, characters; JSON has all alternatives."""

_DECISIONS: Final = protobuf_channel(PLAN_DECISION, PlanDecision)
_MAPS: Final = protobuf_channel(GRADIENT_MAP, GridMessage)
_PATHS: Final = protobuf_channel(PLAN_PATH, SceneUpdate)
_DRAWINGS: Final = protobuf_channel(MAP_DRAWING, SceneUpdate)
_TIMINGS: Final = protobuf_channel(EVENT_LOG, Log)
_CHANNELS: Final = (_DECISIONS, _MAPS, _PATHS, _DRAWINGS, _TIMINGS)


class BlackBox:
    """A planner whose decisions are written as messages.

    It must receive all samples, decisions and outcomes in their order. Equal samples and outcomes give equal
    bytes, so that a log can be verified by recomputing its decisions.

    Attributes:
        planner: the planner.
        planning_s: wall time of the planning, s.
    """

    def __init__(
        self,
        planner: Planner,
        write: Callable[[Messages], None] = lambda messages: None,
        *,
        timings: bool = False,
    ) -> None:
        """Begin before the first sample.

        Args:
            write: called with the messages of each decision, and of each outcome.
            timings: also log the duration of each decision. With durations, logs of equal runs differ.
        """
        self.planner, self.planning_s = planner, 0.0
        self._write, self._has_timings = write, timings
        self._message_counts = dict.fromkeys(_CHANNELS, 0)
        self._sample: Sample | None = None
        self._step: Step | None = None
        self._last_message = PlanDecision()
        self._start_object: TrackedObject | None = None
        self._travelled_points: list[tuple[float, float]] = []
        self._map_frame: MapFrame | None = None

    def observe(self, sample: Sample) -> None:
        """Observe the next sample.

        Raises:
            TraceError: the sample's time is not after the previous sample's time.
        """
        start_s = time.perf_counter()
        self.planner.observe(sample)
        self._sample = sample
        tracked = self._moving_object()
        if tracked is not None:
            self._travelled_points.append(centre_of(tracked.footprint))
        self.planning_s += time.perf_counter() - start_s

    def next_step(self) -> Step:
        """Return the planner's next step, and write the step unless the previous wait continues.

        The outcome of a wait is written with the next decision.

        Raises:
            UsageError: no sample was observed yet, or the last step was not concluded.
        """
        start_s = time.perf_counter()
        step = self.planner.next_step()
        duration_s = time.perf_counter() - start_s
        if step is self._step:
            return step
        last_wait = self._ended_wait(step.time_ns)
        self._step = step
        self._start_object = self._moving_object()
        self._travelled_points = (
            [] if self._start_object is None else [centre_of(self._start_object.footprint)]
        )
        layers, ways = _layers_of(step, self.planner), _ways_of(step, self.planner)
        self._last_message = explained_decision(step, self.planner, self._message_counts[_MAPS], layers, ways)
        turned_maps = maps_of(step)
        maps = [
            map_message(
                turned_map, step.time_ns, layers[turned_map.candidate], ways.get(turned_map.candidate)
            )
            for turned_map in turned_maps
        ]
        path = path_message(step.target, self._start_object, step.time_ns)
        if turned_maps:
            gradient, turn = turned_maps[-1].candidate.map, turned_maps[-1].turn
            settings = self.planner.settings
            obstacles = settings.workspace.named_obstacles
            self._map_frame = map_frame(gradient, turn, settings.margin, obstacles)
        drawing = map_drawing(self._map_frame, step.target, self._start_object, step.time_ns)
        timings = [[_timing(step, duration_s)]] if self._has_timings else []
        messages = self._messages(
            step.time_ns, [*last_wait, self._last_message], maps, [path], [drawing], *timings
        )
        self.planning_s += time.perf_counter() - start_s
        self._write(messages)
        return step

    def conclude(self, outcome: Outcome) -> None:
        """Record the outcome of the last step, and write the outcome.

        Raises:
            UsageError: no step is being executed.
        """
        self.planner.conclude(outcome)
        if self._step is None or self._sample is None:
            raise UsageError("no step is being executed; decide on one first")
        step, end_ns = self._step, self._sample.time_ns
        path = path_message(step.target, self._start_object, end_ns, self._travelled_points)
        self._step = None
        self._write(self._messages(end_ns, [self._with_outcome(outcome, end_ns)], [], [path]))

    def _ended_wait(self, end_ns: int) -> list[PlanDecision]:
        """Return the last decision with its outcome, if the decision was a wait; else an empty list."""
        if self._step is None or self._step.kind != "wait":
            return []
        return [self._with_outcome(wait_outcome(self._step, self.planner.states), end_ns)]

    def _with_outcome(self, outcome: Outcome, end_ns: int) -> PlanDecision:
        """Return the last decision with its outcome."""
        message = PlanOutcome(
            end_ns=end_ns,
            succeeded=outcome.succeeded,
            reason=outcome.reason,
            at=outcome.at or "",
            states=self.planner.states,
            travelled=[coordinate for point in self._travelled_points for coordinate in point],
        )
        self._last_message.outcome.CopyFrom(message)
        return self._last_message

    def _moving_object(self) -> TrackedObject | None:
        """Return the object that the last step moves, from the newest sample."""
        if self._step is None or self._step.target is None or self._sample is None:
            return None
        return self._sample.objects.get(self._step.target.name)

    def _messages(self, time_ns: int, *channel_messages: Sequence[Message]) -> Messages:
        """Return the messages of all channels, with consecutive numbers in each channel."""
        streams = []
        # the last channel, for timings, is often absent
        for channel, messages in zip(_CHANNELS, channel_messages, strict=False):
            first_number = self._message_counts[channel]
            self._message_counts[channel] += len(messages)
            # deterministic, because a verification compares bytes
            payloads = [message.SerializeToString(deterministic=True) for message in messages]
            times_ns = np.full(len(payloads), time_ns, np.int64)
            streams.append(messages_of(channel, times_ns, payloads, first_number))
        return merge(streams)


def _timing(step: Step, duration_s: float) -> Log:
    """Return a message on the duration of a decision; its topic is not part of the log's certificate."""
    text = f"decision {step.number} took {duration_s * 1e3:.1f} ms"
    message = Log(level=Log.INFO, message=text, name="planner")
    message.timestamp.FromNanoseconds(step.time_ns)
    return message


def plan_metadata(planner: Planner, filename: str) -> dict[str, str]:
    """Return the metadata from which the decisions of a log can be recomputed.

    Args:
        filename: name of the specification's file in the log.
    """
    return {
        "settings": text_from_settings(planner.settings),
        "file": filename,
        "specification": planner.automaton.name,
        "version": str(PLAN_VERSION),
        **({} if planner.rate_hz is None else {"rate_hz": repr(planner.rate_hz)}),
    }


def decision_from_payload(payload: bytes) -> PlanDecision:
    """Decode a message on the topic of decisions.

    Raises:
        LogError: the message is damaged.
    """
    try:
        return PlanDecision.FromString(payload)
    except DecodeError as error:
        raise LogError(f"a message on {PLAN_DECISION} cannot be read: {error}") from error


def latest_decisions(decisions: Iterable[PlanDecision]) -> tuple[PlanDecision, ...]:
    """Return the latest message of each decision, sorted by number.

    A log has each decision a second time, with its outcome.
    """
    by_number = {decision.number: decision for decision in decisions}
    return tuple(by_number[number] for number in sorted(by_number))


def _layers_of(step: Step, planner: Planner) -> dict[Candidate, MapLayers]:
    candidates = (candidate for edge in step.considered for candidate in edge.candidates)
    return {candidate: layers_of(candidate, planner.settings) for candidate in candidates}


def layers_of(candidate: Candidate, settings: Settings) -> MapLayers:
    """Return the layers of a candidate's map."""
    tried = tried_cells(candidate, settings) if candidate.failures else None
    return map_layers(candidate.map, settings, candidate.failed, tried)


def _ways_of(step: Step, planner: Planner) -> dict[Candidate, Ways]:
    """Return the ways that were compared for the chosen candidate's push; empty without a comparison."""
    if planner.settings.skill != "push":
        return {}
    return {
        candidate: ways
        for candidate in step.candidates
        if candidate.is_chosen and candidate.target is not None and not candidate.rule
        if (ways := ways_of(candidate, candidate.target, planner.settings)) is not None
    }


def explained_decision(
    step: Step,
    planner: Planner,
    first_map: int = 0,
    layers: Mapping[Candidate, MapLayers] | None = None,
    ways: Mapping[Candidate, Ways] | None = None,
) -> PlanDecision:
    """Return a decision as a message without an outcome, with the layers of its maps.

    Args:
        planner: planner that made the decision.
        first_map: number of the step's first map in the log.
        layers: layers of the maps; None to compute the layers.
        ways: ways of the chosen candidate; None to compute the ways.
    """
    layers = layers or _layers_of(step, planner)
    ways = _ways_of(step, planner) if ways is None else ways
    message = decision_message(step, planner.automaton.name, first_map)
    message.margin = planner.settings.margin
    for edge, edge_message in zip(step.considered, message.considered, strict=True):
        bans = planner.bans(edge, step.pruned)
        edge_message.wanted[:] = wanted_of(edge.progress.texts, bans)
        edge_message.rules[:] = rules_of(bans)
        for candidate, candidate_message in zip(edge.candidates, edge_message.candidates, strict=True):
            explain(
                candidate_message, candidate, layers[candidate], planner.settings, bans, ways.get(candidate)
            )
    return message


def decision_message(step: Step, specification: str = "", first_map: int = 0) -> PlanDecision:
    """Return a decision as a message without an outcome, and without the layers of its maps."""
    map_numbers = {turned_map: number for number, turned_map in enumerate(maps_of(step), first_map)}
    pruned_edges = (
        PrunedEdge(source=edge[0], target=edge[1], reason=str(reason)) for edge, reason in step.pruned
    )
    return PlanDecision(
        time_ns=step.time_ns,
        number=step.number,
        specification=specification,
        kind=PlanDecision.Kind.Value(f"KIND_{step.kind.upper().replace(' ', '_')}"),
        states=step.states,
        considered=[_edge(consideration, map_numbers) for consideration in step.considered],
        target=None if step.target is None else target_message(step.target),
        pruned=pruned_edges,
        reason=step.reason,
        lost=None if step.lost is None else PlanLoss(time_ns=step.lost.time_ns, text=step.lost.text),
        search=PlanSearch(**step.search._asdict()),
    )


def _edge(consideration: Consideration, map_numbers: Mapping[TurnedMap, int]) -> PlanEdge:
    return PlanEdge(
        path=consideration.path,
        source=consideration.edge[0],
        target=consideration.edge[1],
        progress=_guards(consideration.progress),
        constraints=_guards(consideration.constraints),
        candidates=[_candidate(candidate, map_numbers) for candidate in consideration.candidates],
        pruned=str(consideration.pruned or ""),
        motions=map(target_message, consideration.motions),
        joint=consideration.is_joint,
        failed=consideration.failed,
        order=consideration.order,
    )


def _guards(guards: Guards) -> list[PlanGuard]:
    return [
        PlanGuard(text=text, propositions=[number for number, _ in cube], values=[value for _, value in cube])
        for cube, text in zip(guards.cubes, guards.texts, strict=True)
    ]


def _candidate(candidate: Candidate, map_numbers: Mapping[TurnedMap, int]) -> PlanCandidate:
    return PlanCandidate(
        object=candidate.name,
        best=candidate.map.best(),
        map_sha256=map_digest(candidate.map),
        target=None if candidate.target is None else target_message(candidate.target),
        rejected=candidate.rejected,
        chosen=candidate.is_chosen,
        maps=[
            PlanMap(number=map_numbers[TurnedMap(candidate, index)], turn=turn)
            for index, turn in enumerate(candidate.map.turns.tolist())
        ],
    )


def target_message(target: Target) -> PlanTarget:
    """Return a target as a message."""
    return PlanTarget(
        object=target.name,
        x=target.x,
        y=target.y,
        turn=target.turn,
        yaw=target.yaw,
        waypoints=[coordinate for point in target.waypoints for coordinate in point],
        robustness=target.robustness,
    )


# ------------------------------------------------------------------------------------------------------- text


def plan_lines(name: str, decisions: Sequence[PlanDecision]) -> Iterator[str]:
    """Yield lines on all decisions of a log."""
    *earlier_decisions, last_decision = decisions
    motion_count = sum(decision.HasField("target") and decision.HasField("outcome") for decision in decisions)
    is_cut = last_decision.HasField("target") and not last_decision.HasField("outcome")
    yield (
        f"{name}: {plural(len(decisions), 'decision')} for {last_decision.specification!r}, "
        f"{plural(motion_count, 'motion')}{' and one cut short' if is_cut else ''}"
    )
    for decision in earlier_decisions:
        yield from decision_lines(decision)
    yield from decision_lines(last_decision)
    if is_cut:
        yield "  the log ends during this motion"
    edges_by_kind: dict[str, list[str]] = {}
    for edge in last_decision.pruned:
        edges_by_kind.setdefault(Reason.from_text(edge.reason).kind, []).append(
            f"{edge.source} -> {edge.target}"
        )
    for kind, edge_names in edges_by_kind.items():
        yield f"given up: {', '.join(edge_names)}: {kind}"


def decision_lines(decision: PlanDecision) -> Iterator[str]:
    """Yield lines on one decision."""
    yield _heading(decision)
    yield f"  {decision.reason}"
    if decision.considered:
        yield f"  {effort_text(decision)}"
    if decision.HasField("target"):
        yield f"  {_target_text(decision.target)}{joint_suffix(decision.considered[-1])}"
    first_edges: dict[tuple[str, ...], str] = {}
    aim = aim_of(decision)
    for edge in decision.considered:
        yield from _edge_lines(edge, first_edges, is_aim=edge is aim)
    if decision.HasField("lost"):
        cause_text = f": {decision.lost.text}" if decision.lost.text else ""
        yield f"  since {time_text(decision.lost.time_ns)} it cannot be satisfied{cause_text}"
    if decision.HasField("outcome"):
        yield f"  {_outcome_text(decision)}"


def brief_lines(decision: PlanDecision) -> Iterator[str]:
    """Yield at most five lines on one decision."""
    yield f"{_heading(decision)}: {decision.reason}"
    if decision.considered:
        *earlier_edges, edge = decision.considered
        yield f"  wanted   {'; '.join([_either(edge.wanted), *map(plain, edge.rules)])}"
        for candidate in edge.candidates:
            if candidate.chosen:
                yield f"  there    {_place_facts(candidate, edge, decision.margin)}"
        rival_texts = [
            *(f"path {_path(pruned)}: {Reason.from_text(pruned.pruned).kind}" for pruned in earlier_edges),
            *_rival_texts([candidate for candidate in edge.candidates if not candidate.chosen]),
        ]
        if rival_texts:
            yield f"  instead  {'; '.join(rival_texts)}"
    if decision.HasField("outcome"):
        yield f"  {_outcome_text(decision)}"


def plain(sentence: str) -> str:
    """Return a sentence for a terminal, without backquotes."""
    return sentence.replace("`", "")


def _either(sentences: Sequence[str]) -> str:
    """Return alternatives for a terminal."""
    return _some([plain(sentence) for sentence in sentences])


def _heading(decision: PlanDecision) -> str:
    edge = aim_of(decision)
    attempt = f" (attempt {edge.failed + 1})" if edge is not None and edge.failed else ""
    states = ", ".join(map(str, decision.states))
    return f"decision {decision.number}{attempt} at {time_text(decision.time_ns)}, state {states}"


def _place_facts(candidate: PlanCandidate, edge: PlanEdge, margin: float) -> str:
    """Return a target's robustness, tightest relations, path length, cost of room, and rule."""
    target = candidate.target
    # negations are left out: a negation is often one of several alternatives, which limits nothing
    relations = [conjunct for conjunct in candidate.conjuncts if not conjunct.text.startswith("not (")]
    tight_conjuncts = sorted(
        (conjunct for conjunct in relations if conjunct.at_target > 0.0),
        key=lambda conjunct: conjunct.at_target,
    )
    facts = [f"robustness {target.robustness:.4g}{joint_suffix(edge)} ({margin:.4g} needed)"]
    if tight_conjuncts:
        second_text = "".join(
            f", then {conjunct.text} ({conjunct.at_target:.4g})" for conjunct in tight_conjuncts[1:2]
        )
        facts.append(f"tightest: {tight_conjuncts[0].text}{second_text}")
    facts += [f"path length {_length(target):.4g}", room_sentence(candidate), candidate.rule]
    return "; ".join(filter(None, facts))


def _rival_texts(candidates: Sequence[PlanCandidate]) -> Iterator[str]:
    """Yield the reasons why other objects are not moved; objects with the same reason share a text."""
    names_by_reason: dict[str, list[str]] = {}
    for candidate in candidates:
        if candidate.rejected:
            names_by_reason.setdefault(candidate.rejected, []).append(candidate.object)
        else:
            yield f"{place_text(candidate.target)}, robustness {candidate.target.robustness:.4g}"
    yield from (f"{', '.join(objects)}: {reason}" for reason, objects in names_by_reason.items())


def effort_text(decision: PlanDecision) -> str:
    """Return the number of the attempt at a decision's edge, and the search effort, in words."""
    search, edge = decision.search, decision.considered[-1] if decision.considered else None
    attempt_text = f"attempt {edge.failed + 1}" if edge is not None and decision.HasField("target") else ""
    effort_counts = (search.arrangements, "arrangement"), (search.parking_places, "parking place")
    effort_texts = [f"{search.maps:.4g} maps", *(plural(*count) for count in effort_counts if count[0])]
    return ", ".join([*filter(None, [attempt_text]), *effort_texts])


def _outcome_text(decision: PlanDecision) -> str:
    outcome = decision.outcome
    result_text = "done" if outcome.succeeded else f"failed ({outcome.at})" if outcome.at else "failed"
    states_text = ", ".join(map(str, outcome.states))
    return f"{result_text} at {time_text(outcome.end_ns)}: {outcome.reason}; state {states_text}"


def joint_suffix(edge: PlanEdge) -> str:
    """Return " once all 3 motions are done" for a robustness after all motions; "" for a single motion."""
    return f" once all {len(edge.motions)} motions are done" if edge.joint and len(edge.motions) > 1 else ""


def _edge_lines(edge: PlanEdge, first_edges: dict[tuple[str, ...], str], *, is_aim: bool) -> Iterator[str]:
    """Yield lines on an edge. A rejected candidate with the lines of an earlier edge refers to that edge.

    Args:
        first_edges: name of the first edge for the lines of each candidate; this function adds its edge.
    """
    route = _path(edge) + (edge.order and f"; {edge.order}")
    yield f"  {'aimed at' if is_aim else 'looked into'} {edge.source} -> {edge.target} on the path {route}"
    yield f"    wanted      {_either(edge.wanted)}"
    for number, rule in enumerate(edge.rules):
        yield f"    {'' if number else 'on the way':<12}{plain(rule)}"
    for candidate in edge.candidates:
        lines = [f"      {key:<11}{text}" for key, text in candidate_lines(candidate)]
        # the comparison excludes the numbers of maps, which always differ
        edge_name = f"{edge.source} -> {edge.target}"
        first_edge = first_edges.setdefault((candidate.object, candidate.rejected, *lines), edge_name)
        if candidate.rejected and first_edge != edge_name:
            yield f"    {candidate.object}{_maps(candidate)}: rejected as for {first_edge}"
            continue
        yield f"    {_candidate_text(candidate)}"
        yield from lines
    if len(edge.motions) > 1:
        yield f"    planned     {', then '.join(place_text(motion) for motion in edge.motions)}"
    if edge.pruned:
        yield f"    given up: {Reason.from_text(edge.pruned).kind}"


def _path(edge: PlanEdge) -> str:
    return " -> ".join(map(str, edge.path))


def _candidate_text(candidate: PlanCandidate) -> str:
    name = f"{candidate.object}{_maps(candidate)}"
    if candidate.rejected:
        return f"{name}: rejected, {candidate.rejected}"
    role = "chosen" if candidate.chosen else "possible"
    return f"{name}: {role}, {best_robustness(candidate):.4g} at best; {_target_text(candidate.target)}"


def _maps(candidate: PlanCandidate) -> str:
    """Return the numbers of a candidate's maps on the topic of gradient maps."""
    map_numbers = sorted(turned_map.number for turned_map in candidate.maps)
    if len(map_numbers) < 2:
        return "".join(f" (map {number})" for number in map_numbers)
    return f" (maps {map_numbers[0]} to {map_numbers[-1]})"


def _length(target: PlanTarget) -> float:
    points = list(zip(target.waypoints[::2], target.waypoints[1::2], strict=True))
    return sum(math.dist(start, end) for start, end in pairwise(points))


def _target_text(target: PlanTarget) -> str:
    turn_text = f", turned by {math.degrees(target.turn):.3g} deg" if target.turn else ""
    return (
        f"{target.object} to ({target.x:.4g}, {target.y:.4g}){turn_text}, path length {_length(target):.4g}, "
        f"robustness {target.robustness:.4g}"
    )


def place_text(target: PlanTarget) -> str:
    """Return the name and place of a target."""
    return f"{target.object} to ({target.x:.4g}, {target.y:.4g})"


def _some(texts: Sequence[str]) -> str:
    """Return alternatives as text; a long text ends with the number of further alternatives."""
    text_ends = list(accumulate(map(len, texts)))
    listed_count = max(1, sum(end <= _LONGEST for end in text_ends))
    rest_text = f" or {len(texts) - listed_count} more" if listed_count < len(texts) else ""
    return (f"({texts[0]})" if rest_text and listed_count == 1 else either(texts[:listed_count])) + rest_text


def limiting_conjuncts(candidate: PlanCandidate) -> list[PlanConjunct]:
    """Return the conjuncts that limit free cells, most cells first."""
    limiting = (conjunct for conjunct in candidate.conjuncts if conjunct.limits)
    return sorted(limiting, key=lambda conjunct: -conjunct.limits)


def best_robustness(candidate: PlanCandidate) -> float:
    """Return the greatest robustness at the centre of a free cell, or at the (refined) target."""
    target_robustness = candidate.target.robustness if candidate.HasField("target") else -math.inf
    return max(candidate.best, target_robustness)


def candidate_lines(candidate: PlanCandidate) -> Iterator[tuple[str, str]]:
    """Yield pairs (key, text) on limiting conjuncts, blocking causes and the cost of room."""
    for conjunct in limiting_conjuncts(candidate)[:MOST_LISTED]:
        at_target = (
            f", {conjunct.at_target:.4g} in the target's cell" if conjunct.HasField("at_target") else ""
        )
        demand = plain(demand_words(conjunct))
        yield "limited by", f"{demand} in {plural(conjunct.limits, 'cell')}{at_target}"
    for cause in candidate.causes[:MOST_LISTED]:
        yield "blocked", f"{plural(cause.cells, 'cell')}: {plain(cause.words)}"
    if candidate.HasField("room"):
        yield "room", room_sentence(candidate)
    if candidate.rule:
        yield "rule", candidate.rule


def demand_words(conjunct: PlanConjunct) -> str:
    """Return a conjunct as a demand, with its formula between backquotes."""
    # logs of earlier versions have no words
    return conjunct.words or f"`{conjunct.text}`"


def room_sentence(candidate: PlanCandidate) -> str:
    """Return a sentence on the cost of the room around a target; "" if there is no cost."""
    if not candidate.HasField("room"):
        return ""
    room = candidate.room
    return (
        f"{candidate.target.robustness:.4g} chosen, {room.possible:.4g} possible with less room "
        f"({max(room.clearance, 0.0):.3g} of {room.wanted:.3g})"
    )


def cause_sentence(kind: PlanCause.Kind.ValueType, text: str, bans: Sequence[Ban], margin: float) -> str:
    """Return the reason why an object must not be in a cell, with formulas between backquotes.

    Args:
        text: guard that would hold, or name of the object in the cell.
        bans: constraint set of the guard.
        margin: margin by which constraints must be false.
    """
    if kind == PlanCause.KIND_CONSTRAINT:
        margin_text = f" with a margin of {margin:.4g}" if margin else ""
        return f"on the way, {ban_of(text, bans).rule}{margin_text}"
    text_by_kind = {
        PlanCause.KIND_OBJECT: f"{text} stands there",
        PlanCause.KIND_OBSTACLE: "an obstacle of the workspace stands there",
        PlanCause.KIND_REACH: "the robot does not reach it",
        PlanCause.KIND_FAILED: "a motion to a place near it failed",
    }
    return text_by_kind.get(kind, "something that has to hold is unknown there")


def kind_text(decision: PlanDecision) -> str:
    """Return the kind of a decision, as in `Step.kind`: "no path"."""
    return decision.Kind.Name(decision.kind).removeprefix("KIND_").lower().replace("_", " ")


def aim_of(decision: PlanDecision) -> PlanEdge | None:
    """Return the aim of a decision, as in `Step.aim`; None without an aim."""
    last_edge = decision.considered[-1] if decision.considered else None
    return None if last_edge is None or last_edge.pruned else last_edge


def decision_rows(decisions: Sequence[PlanDecision]) -> list[dict[str, Any]]:
    """Return decisions as values for JSON."""
    rows = [MessageToDict(decision, preserving_proto_field_name=True) for decision in decisions]
    for row, decision in zip(rows, decisions, strict=True):
        _write_numbers(row, decision)
        row["kind"] = kind_text(decision)
    return rows


def _write_numbers(row: dict[str, Any], message: Message) -> None:
    """Rewrite numbers for JSON: protobuf writes 64-bit integers as text, and infinity as "Infinity"."""
    for field, value in message.ListFields():
        json_value = row[field.name]
        if field.type == field.TYPE_FIXED64:
            row[field.name] = value
        elif field.type == field.TYPE_DOUBLE:
            is_list = isinstance(json_value, list)
            row[field.name] = [json_number(number) for number in value] if is_list else json_number(value)
        elif field.type == field.TYPE_MESSAGE:
            part_pairs = (
                zip(json_value, value, strict=True) if isinstance(json_value, list) else [(json_value, value)]
            )
            for json_part, message_part in part_pairs:
                _write_numbers(json_part, message_part)

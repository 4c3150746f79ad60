"""Messages of an annotated log → what a report shows of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from spatial_replay.inspection.report.decisions import Plan, PlanMaker
from spatial_replay.inspection.report.events import ReportedEvent, event_of
from spatial_replay.inspection.report.film import Film, FilmMaker
from spatial_replay.inspection.report.states import StatePath, StatePathMaker
from spatial_replay.logs.block import Messages
from spatial_replay.logs.messages.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.topics import AUTOMATON, EVENTS, GRADIENT_MAP, PLAN_DECISION, SCENE


class Taken(NamedTuple):
    """Where a message stands in its topic: its time, and its sequence number."""

    time_ns: int
    sequence: int


class Collector:
    """Takes the messages of a run as they come, and keeps what a page has room for."""

    def __init__(self) -> None:
        self._film = FilmMaker()
        self._plan = PlanMaker()
        self._events: list[ReportedEvent] = []
        self._paths: dict[tuple[str, str], StatePathMaker] = {}

    def add(self, messages: Messages) -> None:
        """Take in the next messages."""
        topics = {number: channel.topic for number, channel in messages.channels.items()}
        for index, number in enumerate(messages.channel.tolist()):
            take = _TAKERS.get(topics[number])
            if take is not None:
                taken = Taken(int(messages.log_time_ns[index]), int(messages.sequence[index]))
                take(self, taken, messages.payloads[index])

    @property
    def film(self) -> Film:
        return self._film.film()

    @property
    def plan(self) -> Plan:
        return self._plan.plan()

    @property
    def events(self) -> tuple[ReportedEvent, ...]:
        return tuple(self._events)

    def path(self, name: str, object: str | None) -> StatePath:
        """Where the automaton of a result was; nowhere if it has none."""
        return self._paths.get((name, object or ""), StatePathMaker()).path()

    def _take_scene(self, taken: Taken, payload: bytes) -> None:
        self._film.add(taken.time_ns, payload)

    def _take_event(self, _: Taken, payload: bytes) -> None:
        self._events.append(event_of(payload))

    def _take_state(self, _: Taken, payload: bytes) -> None:
        message = AutomatonState.FromString(payload)
        self._paths.setdefault((message.specification, message.object), StatePathMaker()).add(message)

    def _take_decision(self, _: Taken, payload: bytes) -> None:
        self._plan.add_decision(payload)

    def _take_map(self, taken: Taken, payload: bytes) -> None:
        self._plan.add_map(taken.sequence, payload)


_TAKERS: Final[Mapping[str, Callable[[Collector, Taken, bytes], None]]] = MappingProxyType(
    {
        SCENE: Collector._take_scene,
        EVENTS: Collector._take_event,
        AUTOMATON: Collector._take_state,
        PLAN_DECISION: Collector._take_decision,
        GRADIENT_MAP: Collector._take_map,
    }
)

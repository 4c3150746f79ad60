"""Does what viewers want: plays, seeks, evaluates again, and sends what comes of it.

How much of a fast playback viewers are sent.

Where a session tells viewers what it has to say.

What an evaluation comes to, in a line.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from enum import Enum, auto
from typing import Final, NamedTuple, Protocol

import numpy as np

from spatial_replay.annotate.curves import CURVES_CHANNEL
from spatial_replay.errors import SpatialReplayError
from spatial_replay.logs.messages import Messages, messages_of, select
from spatial_replay.logs.topics import CURVES_TOPIC, EVENT_LOG, EVENTS
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.replay.engine import ReplayedSpec
from spatial_replay.replay.playback import Playback
from spatial_replay.replay.tuning import Tuned, constant_text, constant_values
from spatial_replay.serve.session import Session, State, Values, Wishes


class Level(Enum):
    """How much a note matters."""

    INFO = auto()
    WARNING = auto()
    ERROR = auto()


class Note(NamedTuple):
    """A sentence that viewers show beside the data; it takes the place of one about the same."""

    about: str
    level: Level
    text: str


class Outlet(Protocol):
    """All viewers together. Nothing here waits for a viewer, nor fails because of one."""

    def wants(self, topic: str) -> bool:
        """Whether anybody has subscribed to a topic."""

    def publish(self, messages: Messages) -> None:
        """Send messages to whoever has subscribed to their topics."""

    def tell_state(self, state: State) -> None:
        """Say what the playback does, where that is not the answer to a viewer."""

    def tell_time(self, time_ns: int) -> None:
        """Say at which time of the log the playback is."""

    def tell_values(self, values: Mapping[str, float | str]) -> None:
        """Say what the constants are, where that is not the answer to a viewer."""

    def tell(self, note: Note) -> None:
        """Show a note."""


_EACH_COUNTS: Final = (EVENTS, EVENT_LOG)
"""Topics of which no message is left out."""


def thinned(messages: Messages, most: int) -> Messages:
    """Of the messages of each topic those of at most so many times, spread over all and with the last.

    One time more than that is by chance, in a stretch cut out of many, and makes no difference.
    """
    kept = np.ones(len(messages), np.bool_)
    for number, channel in messages.channels.items():
        own = messages.channel == number
        times_ns, which = np.unique(messages.log_time_ns[own], return_inverse=True)
        if len(times_ns) > most + 1 and channel.topic not in _EACH_COUNTS:
            chosen = np.zeros(len(times_ns), np.bool_)
            chosen[np.linspace(len(times_ns) - 1, 0, most, endpoint=False).astype(np.int64)] = True
            kept[own] = chosen[which]
    return messages if kept.all() else select(messages, np.flatnonzero(kept))


VERDICT = "verdict"
CONSTANTS = "constants"
LOG = "log"
"""What notes are about."""

_MOST = 5
"""Results, and constants, that a line names."""


def verdict_note(tuned: Tuned) -> Note:
    """The verdict of each result, the worst first, and the constants that are not as they are written."""
    order = (Verdict.VIOLATED, Verdict.UNKNOWN, Verdict.SATISFIED)
    results = sorted(tuned.replayed.results, key=lambda result: order.index(result.verdict))
    text = "; ".join(map(_result, results[:_MOST])) or "no object was there for a template to stand for"
    if len(results) > _MOST:
        text += f"; and {len(results) - _MOST} more, none worse"
    level = Level.INFO if tuned.verdict is Verdict.SATISFIED else Level.WARNING
    return Note(VERDICT, level, text + _changes(tuned))


def _result(result: ReplayedSpec) -> str:
    title = result.name if result.object is None else f"{result.name}({result.object})"
    robustness = float(result.robustness[0])
    number = "not determined" if math.isnan(robustness) else f"{robustness:.6g}"
    return f"`{title}` is {result.verdict}: robustness {number}"


def _changes(tuned: Tuned) -> str:
    written = tuned.tuning.constants
    changed = [
        f"{name} = {constant_text(constant)}"
        for name, constant in tuned.edited.constants.items()
        if constant != written[name]
    ]
    more = ", …" if len(changed) > _MOST else ""
    return f" ({', '.join(changed[:_MOST])}{more})" if changed else ""


PERIOD_S: Final = 1 / 30
"""From one stretch that is sent to the next."""

MOST_A_SECOND: Final = 600
"""Samples that are sent, so that a fast playback is no more than viewers take."""

_CURVES_EVERY: Final = 60
"""Stretches after which the curves are sent again: some viewers forget them while they open their panels."""

_MOST_SAMPLES: Final = 4_096
"""Samples that are worked on at once: what is slower than it should be still answers."""


class Player:
    """All the work of a session; on one thread, so that nothing has to wait for anything else."""

    def __init__(self, playback: Playback, session: Session, outlet: Outlet) -> None:
        self._playback = playback
        self._session = session
        self._outlet = outlet
        self._stretches = 0

    def run(self) -> None:
        """Do what viewers want until the session is stopped."""
        try:
            while not (wishes := self._session.next_wishes(PERIOD_S)).stop:
                try:
                    self._fulfil(wishes)
                    self._play_on()
                except SpatialReplayError as error:
                    self._outlet.tell(Note(LOG, Level.ERROR, str(error)))
                    self._outlet.tell_state(self._session.pause())
        finally:
            self._session.end()

    def _fulfil(self, wishes: Wishes) -> None:
        time_ns = self._playback.time_ns if wishes.sought_ns is None else wishes.sought_ns
        if wishes.values is not None:
            self._evaluate(wishes.values, time_ns)
        if wishes.values is not None or wishes.sought_ns is not None:
            self._seek(time_ns)
        if wishes.topics:
            self._show(wishes.topics)
        self._session.answer(self._playback.tuned)

    def _evaluate(self, values: Values, time_ns: int) -> None:
        """Evaluate the whole log with other constants; what was shown before is out of date.

        Where that cannot be done, the old values come back.
        """
        before = self._playback.tuned
        try:
            self._playback.tuned = before.tuning.evaluate(values)
        except SpatialReplayError as error:
            self._outlet.tell(Note(CONSTANTS, Level.ERROR, str(error)))
            self._outlet.tell_values(self._session.take_back(constant_values(before.edited.constants)))
            return
        self._outlet.tell_state(self._session.state._replace(time_ns=time_ns, did_seek=True))
        self._outlet.tell(verdict_note(self._playback.tuned))

    def _seek(self, time_ns: int) -> None:
        """Show what stands at a time, and go on from there."""
        self._show_curves(time_ns)
        self._outlet.publish(self._playback.seek(time_ns))
        self._outlet.tell_time(time_ns)
        self._session.go_on_from(time_ns)

    def _show(self, topics: Collection[str]) -> None:
        """Send again what stands on some topics."""
        time_ns = self._playback.time_ns
        if CURVES_TOPIC in topics:
            self._show_curves(time_ns)
            self._outlet.tell(verdict_note(self._playback.tuned))
        self._outlet.publish(_on_topics(self._playback.seek(time_ns), topics))
        self._outlet.tell_state(self._session.state)
        self._outlet.tell_time(time_ns)

    def _show_curves(self, time_ns: int) -> None:
        """Show what is known of the whole log; viewers forget it whenever they go to another time."""
        if self._outlet.wants(CURVES_TOPIC):
            curves = [self._playback.tuned.curves]
            self._outlet.publish(messages_of(CURVES_CHANNEL, np.array([time_ns]), curves, 0))

    def _play_on(self) -> None:
        """Send what has come since the last stretch, if it plays."""
        passage = self._session.play_up_to(self._playback.reach_ns(_MOST_SAMPLES))
        if passage is None:
            return
        time_ns = passage.time_ns
        most = max(1, math.ceil(MOST_A_SECOND * passage.lasted_s))
        self._outlet.publish(thinned(self._playback.advance_to(time_ns), most))
        self._outlet.tell_time(time_ns)
        self._stretches += 1
        if self._stretches % _CURVES_EVERY == 0:
            self._show_curves(time_ns)
        if time_ns == self._playback.end_ns:
            self._outlet.tell_state(self._session.pause())


def _on_topics(messages: Messages, topics: Collection[str]) -> Messages:
    numbers = [number for number, channel in messages.channels.items() if channel.topic in topics]
    return select(messages, np.flatnonzero(np.isin(messages.channel, numbers)))

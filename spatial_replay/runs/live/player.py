"""Does what viewers want: plays, seeks, evaluates again, and sends what comes of it."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Final

import numpy as np

from spatial_replay.errors import SpatialReplayError
from spatial_replay.inspection.curves import CURVES_CHANNEL
from spatial_replay.logs.block import Messages, messages_of
from spatial_replay.logs.merging import select
from spatial_replay.logs.topics import CURVES_TOPIC
from spatial_replay.replay.playback import Playback
from spatial_replay.replay.tuning import values_of
from spatial_replay.runs.live.outlet import Level, Note, Outlet
from spatial_replay.runs.live.session import Session
from spatial_replay.runs.live.thinning import thinned
from spatial_replay.runs.live.wishes import Values, Wishes
from spatial_replay.runs.live.words import CONSTANTS, LOG, verdict_note

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
            self._outlet.tell_values(self._session.take_back(values_of(before.constants)))
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

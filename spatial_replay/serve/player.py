"""The thread that does what viewers request: it plays, seeks and evaluates again, and sends the messages."""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum, auto
from typing import Final, NamedTuple, Protocol

import numpy as np

from spatial_replay.annotate.curves import CURVES_CHANNEL
from spatial_replay.errors import SpatialReplayError
from spatial_replay.logs.messages import Messages, messages_of, select
from spatial_replay.logs.topics import CURVES_TOPIC
from spatial_replay.replay.loaded_log import EditedFiles, Playback, constant_values
from spatial_replay.serve.pace import PlaybackState, Status
from spatial_replay.serve.requests import PendingRequests, Values
from spatial_replay.serve.session import ARROW, Session
from spatial_replay.serve.thinning import PlaybackThinning
from spatial_replay.text import nearest_hint


class Level(Enum):
    """The severity of a note."""

    INFO = auto()
    WARNING = auto()
    ERROR = auto()


class Note(NamedTuple):
    """A status message of viewers; it replaces an earlier one about the same subject."""

    about: str
    level: Level
    text: str


class Viewers(Protocol):
    """All viewers together. No method waits for a viewer, or fails because of one."""

    def wants(self, topic: str) -> bool:
        """Say whether a viewer has subscribed to a topic."""

    def publish(self, messages: Messages) -> None:
        """Send messages to the viewers that have subscribed to their topics."""

    def send_state(self, state: PlaybackState) -> None:
        """Send the state of the playback, if it is not the reply to a viewer."""

    def send_time(self, time_ns: int) -> None:
        """Send the present time of the log."""

    def send_values(self, values: Values) -> None:
        """Send the constants, if they are not the reply to a viewer."""

    def send_playback(self) -> None:
        """Send the parameters of the playback, if they are not the reply to a viewer."""

    def send_note(self, note: Note) -> None:
        """Send a note."""

    def remove_note(self, about: str) -> None:
        """Remove the note about a subject."""


_MOST_NAMED: Final = 10
"""The most results that a note lists."""

CONSTANTS = "constants"
LOG = "log"
SPECIFICATION = "specification"
"""The subjects of notes."""

PERIOD_S: Final = 1 / 30
"""The time between two turns."""

_CURVES_EVERY: Final = 60
"""Turns after which the curves are sent again: some viewers drop them while they open their panels."""

_PLAYBACK_EVERY: Final = 15
"""Turns after which the parameters of the playback are sent again."""

_MOST_SAMPLES: Final = 4_096
"""The most samples of one turn, so that a slow log does not block other requests."""


class Player:
    """All the work of a session, on one thread: a playback needs no locks."""

    def __init__(self, playback: Playback, session: Session, viewers: Viewers) -> None:
        self._playback = playback
        self._session = session
        self._viewers = viewers
        self._thinning = PlaybackThinning()
        self._turns = 0
        self._shows_again = False

    def run(self) -> None:
        """Do what is requested until the session is stopped."""
        try:
            while not (requests := self._next_requests()).stop:
                try:
                    self._do(requests)
                    self._play_on()
                except SpatialReplayError as error:
                    self._viewers.send_note(Note(LOG, Level.ERROR, str(error)))
                    self._viewers.send_state(self._session.pause())
        finally:
            self._session.end()

    def _next_requests(self) -> PendingRequests:
        return self._session.next_requests(PERIOD_S, is_due=self._shows_again)

    def _do(self, requests: PendingRequests) -> None:
        shows_again, self._shows_again = self._shows_again, False
        time_ns = self._playback.time_ns if requests.seek_ns is None else requests.seek_ns
        is_changed = requests.edited is not None and self._evaluate(requests.edited)
        is_moved = requests.arrow is not None and self._point_at(requests.arrow)
        if is_moved or is_changed or requests.seek_ns is not None:
            self._seek(time_ns)
        elif shows_again and self._session.state.status is not Status.PLAYING:
            self._show(time_ns)
        if requests.topics:
            self._resend(requests.topics)
        self._session.provide_evaluation(self._playback.evaluated)

    def _evaluate(self, edited: EditedFiles) -> bool:
        """Evaluate the whole log with other constants; after an error, restore the former values."""
        before = self._playback.evaluated
        try:
            self._playback.evaluated = edited.loaded.evaluate(edited)
        except SpatialReplayError as error:
            self._viewers.send_note(Note(CONSTANTS, Level.ERROR, str(error)))
            self._viewers.send_values(self._session.restore(before.edited, error))
            return False
        if edited.loaded is not before.loaded:
            # viewers know the constants that they set, not those of a file that was saved
            self._viewers.send_values(constant_values(edited.constants))
        self._viewers.remove_note(CONSTANTS)
        return True

    def _point_at(self, arrow: str) -> bool:
        """Choose the result that the arrow is about; say whether there is such a one."""
        trees = self._playback.evaluated.evaluation.trees
        if arrow and not any(tree.is_called(arrow) for tree in trees):
            titles = [tree.title for tree in trees]
            named = ", ".join(titles[:_MOST_NAMED]) + (", …" if len(titles) > _MOST_NAMED else "")
            hint = nearest_hint(arrow, titles) or f"the results are: {named}"
            self._viewers.send_note(Note(ARROW, Level.ERROR, f"there is no result {arrow!r}; {hint}"))
            self._session.point_at(self._playback.arrow)
            self._viewers.send_playback()
            return False
        self._playback.arrow = arrow
        return True

    def _seek(self, time_ns: int) -> None:
        """Send what is shown at a time, and go on from there.

        Viewers drop what they have when time steps back, or a state says that it jumped: both come first. A
        viewer that drops messages later than that is sent them once more while it is paused.
        """
        self._viewers.send_time(time_ns)
        self._viewers.send_state(self._session.state._replace(time_ns=time_ns, did_seek=True))
        self._show(time_ns)
        self._session.continue_from(time_ns)
        self._shows_again = True

    def _show(self, time_ns: int) -> None:
        self._send_curves(time_ns)
        self._viewers.publish(self._playback.seek(time_ns))
        self._viewers.send_time(time_ns)

    def _resend(self, topics: Collection[str]) -> None:
        """Send again what is shown of some topics."""
        time_ns = self._playback.time_ns
        if CURVES_TOPIC in topics:
            self._send_curves(time_ns)
        self._viewers.publish(_on_topics(self._playback.seek(time_ns), topics))
        self._viewers.send_state(self._session.state)
        self._viewers.send_time(time_ns)

    def _send_curves(self, time_ns: int) -> None:
        """Send the curves of the whole log; viewers drop them whenever they go to another time."""
        if self._viewers.wants(CURVES_TOPIC):
            curves = [self._playback.evaluated.curves]
            self._viewers.publish(messages_of(CURVES_CHANNEL, np.array([time_ns]), curves, 0))

    def _play_on(self) -> None:
        """Send what has come since the last turn, if it plays."""
        span = self._session.play_up_to(self._playback.reach_ns(_MOST_SAMPLES))
        if span is None:
            return
        time_ns = span.time_ns
        coming = self._playback.advance_to(time_ns)
        self._viewers.publish(self._thinning.thin(coming, span.elapsed_s))
        self._viewers.send_time(time_ns)
        self._turns += 1
        if self._turns % _CURVES_EVERY == 0:
            self._send_curves(time_ns)
        if time_ns == self._playback.end_ns:
            self._viewers.send_state(self._session.finish())
            self._viewers.send_playback()
        elif self._turns % _PLAYBACK_EVERY == 0:
            self._viewers.send_playback()


def _on_topics(messages: Messages, topics: Collection[str]) -> Messages:
    numbers = [number for number, channel in messages.channels.items() if channel.topic in topics]
    return select(messages, np.flatnonzero(np.isin(messages.channel, numbers)))

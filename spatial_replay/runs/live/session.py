"""A log that several viewers look at together: one place in it, one value for each constant."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from threading import Condition
from typing import Final, TypeVar

import numpy as np

from spatial_replay.errors import LogError, SpatialReplayError, UsageError
from spatial_replay.inspection.annotator import messages_of
from spatial_replay.inspection.curves import CURVES_CHANNEL
from spatial_replay.logs.block import Channel, Messages
from spatial_replay.logs.merging import select
from spatial_replay.logs.topics import CURVES_TOPIC
from spatial_replay.replay.playback import Playback
from spatial_replay.replay.tuning import Tuned, Tuning, values_of
from spatial_replay.runs.live.outlet import Level, Note, Outlet
from spatial_replay.runs.live.thinning import thinned
from spatial_replay.runs.live.transport import State, Status, Transport
from spatial_replay.runs.live.wishes import Question, Values, Wishes
from spatial_replay.runs.live.words import CONSTANTS, LOG, verdict_note

PERIOD_S: Final = 1 / 30
"""From one stretch that is sent to the next."""

MOST_TIMES: Final = 20
"""Samples of a stretch that are sent, so that a fast playback is no more than viewers take."""

_MOST_SAMPLES: Final = 4_096
"""Samples that are worked on at once: what is slower than it should be still answers."""

_OVER: Final = "the server is stopping"

_Answer = TypeVar("_Answer")


class Session:
    """Plays a log to viewers and evaluates it again as they wish.

    `run` does all work, on one thread. What viewers want may be said on any thread, and returns at once but
    for `ask`; of wishes that come faster than they are met, the last one counts.

    Attributes:
        channels: all that there can be messages of.
        start_ns, end_ns: first and last time.
    """

    def __init__(self, tuning: Tuning, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Evaluate the log as it is written, paused at its start.

        Raises:
            LogError: the log cannot be read.
        """
        self._tuning = tuning
        self._clock = clock
        self._playback = Playback(tuning.evaluate())
        self.start_ns, self.end_ns = self._playback.start_ns, self._playback.end_ns
        first = self._playback.seek(self.start_ns)
        channels = (*first.channels.values(), *self._playback.channels, CURVES_CHANNEL)
        self.channels: tuple[Channel, ...] = tuple(dict.fromkeys(channels))
        self._transport = Transport(self.start_ns, self.end_ns)
        self._values = self._shown = values_of(tuning.constants)
        self._wishes = Wishes()
        self._questions: deque[Question] = deque()
        self._wished = Condition()
        self._is_over = False

    @property
    def name(self) -> str:
        """What the log is called."""
        return self._tuning.name

    @property
    def tuned(self) -> Tuned:
        """What is shown."""
        return self._playback.tuned

    @property
    def values(self) -> Mapping[str, float | str]:
        """The constants as viewers want them: numbers and, as texts, durations."""
        return self._values

    # ------------------------------------------------------------------------- what viewers want

    def control(self, *, is_playing: bool, speed: float, seek_ns: int | None = None) -> State:
        """Play or pause, as fast as is asked for, from another time on if one is given.

        What plays on from the end begins again.
        """
        with self._wished:
            now = self._clock()
            if seek_ns is None and is_playing and self._transport.state(now).status is Status.ENDED:
                seek_ns = self.start_ns
            self._transport.set_speed(speed, now)
            if seek_ns is not None:
                self._transport.move_to(seek_ns, now)
                self._wishes.is_moved = True
            (self._transport.play if is_playing else self._transport.pause)(now)
            self._wishes.is_steered = True
            self._wished.notify()
            return self._transport.state(now, did_seek=seek_ns is not None)

    def change(self, values: Mapping[str, float | str]) -> None:
        """Give constants other values; all of them or, with an error, none.

        Raises:
            UsageError: no such constant, or a value of another kind.
            SpecificationError: the specification means nothing with these values.
        """
        with self._wished:
            wished = {**self._values, **values}
            self._tuning.specifications(wished)
            self._values = self._wishes.values = wished
            self._wished.notify()

    def show_again(self, topic: str) -> None:
        """Send what stands on a topic, to whoever has just subscribed to it."""
        with self._wished:
            self._wishes.topics.add(topic)
            self._wished.notify()

    def ask(self, work: Callable[[Tuned], _Answer]) -> _Answer:
        """Work something out from what is shown, in turn; what `work` raises is raised here.

        Raises:
            UsageError: the session is over.
        """
        question = Question(work)
        with self._wished:
            if self._is_over:
                raise UsageError(_OVER)
            self._questions.append(question)
            self._wished.notify()
        answer: _Answer = question.answer.result()
        return answer

    def stop(self) -> None:
        """End `run`."""
        with self._wished:
            self._wishes.stop = True
            self._wished.notify()

    # --------------------------------------------------------------------------- what is done

    def run(self, outlet: Outlet) -> None:
        """Do what viewers want until the session is stopped."""
        try:
            while not (wishes := self._next_wishes()).stop:
                try:
                    self._fulfil(wishes, outlet)
                    self._play_on(outlet)
                except LogError as error:
                    outlet.tell(Note(LOG, Level.ERROR, str(error)))
                    self._pause(outlet)
        finally:
            with self._wished:
                self._is_over = True
            for question in self._questions:
                question.answer.set_exception(UsageError(_OVER))

    def _next_wishes(self) -> Wishes:
        """What is wanted by now or, while nothing plays, once something is."""
        with self._wished:
            is_playing = self._transport.state(self._clock()).status is Status.PLAYING
            self._wished.wait_for(lambda: self._wishes or self._questions, PERIOD_S if is_playing else None)
            wishes, self._wishes = self._wishes, Wishes()
            return wishes

    def _fulfil(self, wishes: Wishes, outlet: Outlet) -> None:
        is_changed = wishes.values is not None and self._evaluate(wishes.values, outlet)
        if wishes.is_moved or is_changed:
            self._seek(outlet)
        if wishes.topics:
            self._show(wishes.topics, outlet)
        while self._questions:
            self._questions.popleft().settle(self.tuned)

    def _evaluate(self, values: Values, outlet: Outlet) -> bool:
        """Evaluate the whole log with other constants; False, and the old ones stay, if that cannot be."""
        try:
            tuned = self._tuning.evaluate(values)
        except SpatialReplayError as error:
            outlet.tell(Note(CONSTANTS, Level.ERROR, str(error)))
            with self._wished:
                if self._wishes.values is None:
                    self._values = self._shown
            outlet.tell_constants()
            return False
        self._shown = values
        self._playback.tuned = tuned
        # what was played before is of other constants
        outlet.tell_state(self._state(did_seek=True))
        return True

    def _seek(self, outlet: Outlet) -> None:
        """Show what stands where the playback is now."""
        time_ns = self._state().time_ns
        self._show_whole(time_ns, outlet)
        outlet.publish(self._playback.seek(time_ns))
        outlet.tell_time(time_ns)

    def _show(self, topics: Collection[str], outlet: Outlet) -> None:
        """Send again what stands on some topics."""
        if CURVES_TOPIC in topics:
            self._show_whole(self._playback.time_ns, outlet)
        outlet.publish(_on_topics(self._playback.seek(self._playback.time_ns), topics))
        outlet.tell_state(self._state())
        outlet.tell_time(self._playback.time_ns)

    def _show_whole(self, time_ns: int, outlet: Outlet) -> None:
        """Show what is known of the whole log: curves and verdict."""
        if outlet.wants(CURVES_TOPIC):
            outlet.publish(messages_of(CURVES_CHANNEL, np.array([time_ns]), [self.tuned.curves], 0))
        outlet.tell(verdict_note(self.tuned))

    def _play_on(self, outlet: Outlet) -> None:
        """Send what has come since the last stretch, if it plays."""
        time_ns = self._next_time_ns()
        if time_ns is None:
            return
        outlet.publish(thinned(self._playback.advance_to(time_ns), MOST_TIMES))
        outlet.tell_time(time_ns)
        if time_ns < self.end_ns:
            return
        self._pause(outlet)

    def _pause(self, outlet: Outlet) -> None:
        """Stay here, unless somebody wants to be elsewhere."""
        with self._wished:
            if not self._wishes.is_moved:
                self._transport.pause(self._clock())
        outlet.tell_state(self._state())

    def _next_time_ns(self) -> int | None:
        """Up to where to play now; a playback that does not keep up with the clock falls behind."""
        with self._wished:
            now = self._clock()
            state = self._transport.state(now)
            if state.status is not Status.PLAYING or self._wishes.is_moved:
                return None
            time_ns = min(state.time_ns, self._playback.reach_ns(_MOST_SAMPLES))
            if time_ns < state.time_ns:
                self._transport.move_to(time_ns, now)
            return time_ns

    def _state(self, *, did_seek: bool = False) -> State:
        with self._wished:
            return self._transport.state(self._clock(), did_seek=did_seek)


def _on_topics(messages: Messages, topics: Collection[str]) -> Messages:
    numbers = [number for number, channel in messages.channels.items() if channel.topic in topics]
    return select(messages, np.flatnonzero(np.isin(messages.channel, numbers)))

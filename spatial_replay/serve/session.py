"""What several viewers of one log share: one time in it, one value for each constant."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from threading import Condition
from typing import Final, NamedTuple

from spatial_replay.errors import SpatialReplayError, UsageError
from spatial_replay.replay.loaded_log import EditedFiles, Evaluated, LoadedLog, constant_values
from spatial_replay.serve.pace import FASTEST, SLOWEST, Pace, PlaybackState, Status, Transport
from spatial_replay.serve.requests import PendingRequests, Values, session_over

PLAYBACK: Final = ("playback.time", "playback.play", "playback.speed", "playback.loop")
"""The parameters that steer the playback, for viewers without controls of their own: seconds after the first
sample, whether it plays, seconds of the log in a second, whether it begins again at the end."""

ARROW: Final = "scene.arrow"
"""The parameter with the title of the result whose violation the arrow points at; "" for the first one."""

_LONGEST_S: Final = 9e9


class PlaySpan(NamedTuple):
    """What is to be played now: up to which time of the log, and the seconds that its last turn took."""

    time_ns: int
    elapsed_s: float


class Session:
    """Collect viewers' requests, on any thread, and hand them to the thread that does them.

    No method but `wait_for_evaluation` waits for work. Of requests that come faster than they are done, the
    last one counts.

    Attributes:
        failure: why the last change that could not be evaluated could not, or None.
    """

    def __init__(
        self, loaded: LoadedLog, start_ns: int, end_ns: int, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Pause at the start, with constants as they are written.

        Args:
            start_ns, end_ns: first and last time.
            clock: seconds by which it plays.
        """
        self._log = loaded
        self._pace = Pace(clock)
        self._transport = Transport(start_ns, end_ns)
        self._edited = loaded.edit({})
        self._pending = PendingRequests()
        self._awaited: Future[Evaluated] | None = None
        self._requested = Condition()
        self._is_over = False
        self._loops = False
        self._is_behind = False
        self._arrow = ""
        self.failure: SpatialReplayError | None = None

    @property
    def name(self) -> str:
        """The log's name."""
        return self._log.name

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time."""
        return self._transport.start_ns, self._transport.end_ns

    @property
    def values(self) -> Values:
        """The constants as viewers set them."""
        return constant_values(self._edited.constants)

    @property
    def edited(self) -> EditedFiles:
        """The specifications with these values."""
        return self._edited

    @property
    def state(self) -> PlaybackState:
        """The state of the playback."""
        with self._requested:
            return self._transport.state(self._pace.now())

    @property
    def playback(self) -> Mapping[str, float | bool]:
        """The values of `PLAYBACK`."""
        state = self.state
        seconds = round((state.time_ns - self._transport.start_ns) / 1e9, 3)
        is_playing = state.status is Status.PLAYING
        return dict(zip(PLAYBACK, (seconds, is_playing, state.speed, self._loops), strict=True))

    @property
    def arrow(self) -> str:
        """The value of `ARROW`."""
        return self._arrow

    # ------------------------------------------------------------------------ called for viewers

    def control(self, *, is_playing: bool, speed: float, seek_ns: int | None = None) -> PlaybackState:
        """Play or pause at a speed, from another time on if one is given.

        At the end, playing begins again.
        """
        with self._requested:
            now = self._pace.now()
            if seek_ns is None and is_playing and self._transport.state(now).status is Status.ENDED:
                seek_ns = self._transport.start_ns
            # what was played since the last turn is still to be sent
            self._is_behind = seek_ns is None and not is_playing and (self._is_behind or self._plays(now))
            self._transport.set_speed(speed, now)
            if seek_ns is not None:
                self._transport.move_to(seek_ns, now)
                self._pending.seek_ns = self._transport.time_ns(now)
            (self._transport.play if is_playing else self._transport.pause)(now)
            self._pending.is_controlled = True
            self._requested.notify()
            # the player says that it jumped, right before it sends what is there
            return self._transport.state(now)

    def _plays(self, now: float) -> bool:
        return self._transport.state(now).status is Status.PLAYING

    def steer(self, values: Mapping[str, float | str | bool]) -> PlaybackState:
        """Play, pause, seek, change the speed or begin again at the end, as some of `PLAYBACK` say.

        Raises:
            UsageError: a value of another kind, or a number that is out of the question.
        """
        now = self.playback
        time, play, speed, loop = PLAYBACK
        for name, value in values.items():
            is_flag = isinstance(now[name], bool)
            if isinstance(value, str) or isinstance(value, bool) != is_flag:
                kind = "true or false" if is_flag else "a number"
                raise UsageError(f"{name} cannot be {value!r}: give {kind}")
            if name == speed and not (SLOWEST <= value <= FASTEST):
                raise UsageError(f"{name} cannot be {value!r}: give a number from {SLOWEST:g} to {FASTEST:g}")
            if not is_flag and not (0.0 <= value < float("inf")):
                raise UsageError(f"{name} cannot be {value!r}: give a number of seconds, at least 0")
        self._loops = bool(values.get(loop, self._loops))
        seek_ns = None
        if time in values:
            seek_ns = self._transport.start_ns + round(min(float(values[time]), _LONGEST_S) * 1e9)
        return self.control(
            is_playing=bool(values.get(play, now[play])),
            speed=float(values.get(speed, now[speed])),
            seek_ns=seek_ns,
        )

    def point_at(self, arrow: float | str | bool) -> None:
        """Let the arrow point at the violation of one result, by its title, or at the first one for "".

        Raises:
            UsageError: a value that is no text.
        """
        if not isinstance(arrow, str):
            raise UsageError(f'{ARROW} cannot be {arrow!r}: give the title of a result, or "" for the first')
        with self._requested:
            self._pending.arrow = self._arrow = arrow
            self._requested.notify()

    def set_constants(self, values: Values) -> None:
        """Give constants other values; all of them or, with an error, none.

        Raises:
            UsageError: no such constant, or a value of another kind.
            SpecificationError: the specification is invalid with these values.
        """
        with self._requested:
            edited = self._edited
            self._pending.edited = self._edited = edited.loaded.edit({**edited.given, **values})
            self._requested.notify()

    def replace_log(self, loaded: LoadedLog) -> None:
        """Evaluate other specifications over the same log.

        Constants that viewers changed keep their values, unless the text changed them, too.
        """
        with self._requested:
            before = self._edited
            written = before.loaded.constants
            kept = {
                name: value
                for name, value in before.given.items()
                if name in loaded.constants
                # what a viewer set while a former value of it was being written is newer than the file
                and (loaded.constants[name] == written[name] or loaded.was_written(name))
            }
            try:
                edited = loaded.edit(kept)
            except SpatialReplayError:
                edited = loaded.edit({})
            self._pending.edited = self._edited = edited
            self._requested.notify()

    def resend(self, topic: str) -> None:
        """Send the latest messages of a topic again, for a viewer that has just subscribed to it."""
        with self._requested:
            self._pending.topics.add(topic)
            self._requested.notify()

    def wait_for_evaluation(self) -> Evaluated:
        """Return what is shown, once the requests made so far are done.

        Raises:
            UsageError: the session is over.
        """
        with self._requested:
            if self._is_over:
                raise session_over()
            awaited = self._awaited = self._awaited or Future()
            self._requested.notify()
        return awaited.result()

    def stop(self) -> None:
        """End the session, and let the player's thread know."""
        self.end()
        with self._requested:
            self._pending.stop = True
            self._requested.notify()

    # -------------------------------------------------------------------------- called by the player

    def next_requests(self, patience_s: float, *, is_due: bool = False) -> PendingRequests:
        """Return what was requested; wait for a request, but while it plays or work is due, only so long."""
        with self._requested:
            is_playing = self._transport.state(self._pace.now()).status is Status.PLAYING
            self._requested.wait_for(
                lambda: self._pending or self._awaited is not None,
                patience_s if is_playing or is_due else None,
            )
            pending, self._pending = self._pending, PendingRequests()
            return pending

    def play_up_to(self, reach_ns: int) -> PlaySpan | None:
        """Return what to play now, after a pause up to its time; None if nothing, or if it has to seek first.

        Args:
            reach_ns: as far as can be played at once; it falls behind the clock rather than go farther.
        """
        with self._requested:
            elapsed_s = self._pace.next_turn()
            now = self._pace.now()
            state = self._transport.state(now)
            is_due = self._is_behind or state.status is Status.PLAYING
            self._is_behind = False
            if not is_due or self._pending.seek_ns is not None:
                return None
            if reach_ns < state.time_ns:
                self._transport.move_to(reach_ns, now)
            return PlaySpan(min(state.time_ns, reach_ns), elapsed_s)

    def continue_from(self, time_ns: int) -> None:
        """Play on from what was just shown, unless a seek is pending; showing it takes no playing time."""
        with self._requested:
            if self._pending.seek_ns is None:
                self._transport.move_to(time_ns, self._pace.now())

    def restore(self, edited: EditedFiles, failure: SpatialReplayError) -> Values:
        """Go back to former specifications, unless a change is pending; return the present constants.

        Args:
            failure: why the latest ones could not be evaluated.
        """
        with self._requested:
            self.failure = failure
            if self._pending.edited is None:
                self._edited = edited
            return constant_values(self._edited.constants)

    def pause(self) -> PlaybackState:
        """Stay at the present time, unless a seek is pending."""
        with self._requested:
            now = self._pace.now()
            if self._pending.seek_ns is None:
                self._transport.pause(now)
            return self._transport.state(now)

    def finish(self) -> PlaybackState:
        """Pause at the end, or begin again."""
        if self._loops:
            return self.control(is_playing=True, speed=self.state.speed, seek_ns=self._transport.start_ns)
        return self.pause()

    def provide_evaluation(self, evaluated: Evaluated) -> None:
        """Let `wait_for_evaluation` return."""
        awaited = self._take_awaited()
        if awaited is not None:
            awaited.set_result(evaluated)

    def end(self) -> None:
        """Let `wait_for_evaluation` raise, now and from now on."""
        with self._requested:
            self._is_over = True
        awaited = self._take_awaited()
        if awaited is not None:
            awaited.set_exception(session_over())

    def _take_awaited(self) -> Future[Evaluated] | None:
        with self._requested:
            awaited, self._awaited = self._awaited, None
            return awaited

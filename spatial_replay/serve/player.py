"""Playback of a log to viewers: the state that all viewers share, and the thread that performs requests."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from functools import partial
from queue import SimpleQueue
from threading import Condition, Lock
from typing import Any, Final, NamedTuple, Protocol, TypeVar

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.annotate.robustness import CURVES_CHANNEL
from spatial_replay.errors import SpatialReplayError, UsageError
from spatial_replay.geometry.arrays import Booleans, Integers, select
from spatial_replay.logs.messages import Channel, Messages, messages_of
from spatial_replay.logs.topics import (
    CAMERA_ANNOTATIONS,
    CURVES_TOPIC,
    EVENT_LOG,
    EVENTS,
    GRADIENT_MAP,
    MAP_DRAWING,
    PLAN_DECISION,
    PLAN_PATH,
    RECENT_EVENTS,
    REDONE_DRAWING,
    REDONE_MAP,
    REDONE_PATH,
    SCENE,
    STANDING,
    is_image_type,
)
from spatial_replay.replay.loaded_log import EditedFiles, Evaluated, LoadedLog, Playback, constant_values

MOST_LATE_S: Final = 0.15
"""Longest playing time of one turn of the player's loop, s; viewers lose messages in larger bursts."""


class Pace:
    """The playing time of a log, measured in turns of the player's loop.

    A turn adds at most `MOST_LATE_S`. After a longer turn the playback lags behind the clock, so that no turn
    sends more than viewers can read.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        """Begin the first turn."""
        self._clock = clock
        self._lag_s = 0.0
        self._turn_start_s = clock()

    def now(self) -> float:
        """Return the playing time in seconds: the clock's time without the skipped parts of long turns."""
        return self._at(self._clock())

    def next_turn(self) -> float:
        """Begin the next turn, and return the playing time of the last turn in seconds."""
        clock_s = self._clock()
        now_s = self._at(clock_s)
        elapsed_s = now_s - self._turn_start_s
        self._lag_s, self._turn_start_s = clock_s - now_s, now_s
        return elapsed_s

    def _at(self, clock_s: float) -> float:
        return min(clock_s - self._lag_s, self._turn_start_s + MOST_LATE_S)


SLOWEST: Final = 0.01
FASTEST: Final = 100.0


class Status(Enum):
    """The status of a playback."""

    PLAYING = auto()
    PAUSED = auto()
    ENDED = auto()


class PlaybackState(NamedTuple):
    """The state of a playback, as viewers show it.

    Attributes:
        speed: seconds of the log per second of the clock.
        did_seek: whether playback jumped to this time, so that viewers must drop earlier messages.
    """

    status: Status
    time_ns: int
    speed: float
    did_seek: bool = False


class Transport:
    """The position of a playback. Callers pass the time of their clock as `now`, in seconds.

    Attributes:
        start_ns, end_ns: first and last time of the log.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        """Pause at the start."""
        self.start_ns, self.end_ns = start_ns, end_ns
        self._is_playing = False
        self._speed = 1.0
        self._from_ns, self._since_s = start_ns, 0.0

    def time_ns(self, now: float) -> int:
        """Return the present time of the log."""
        if not self._is_playing:
            return self._from_ns
        played_ns = round((now - self._since_s) * self._speed * 1e9)
        return min(self._from_ns + max(played_ns, 0), self.end_ns)

    def state(self, now: float) -> PlaybackState:
        """Return the state at the time `now`."""
        time_ns = self.time_ns(now)
        status = Status.PLAYING if self._is_playing else Status.PAUSED
        if not self._is_playing and time_ns >= self.end_ns:
            status = Status.ENDED
        return PlaybackState(status, time_ns, self._speed)

    def play(self, now: float) -> None:
        """Play from the present time. Playback from the last time stays at that time."""
        self.move_to(self.time_ns(now), now)
        self._is_playing = True

    def pause(self, now: float) -> None:
        """Stay at the present time."""
        self.move_to(self.time_ns(now), now)
        self._is_playing = False

    def move_to(self, time_ns: int, now: float) -> None:
        """Go to a time, clipped to the log."""
        self._from_ns, self._since_s = min(max(time_ns, self.start_ns), self.end_ns), now

    def set_speed(self, speed: float, now: float) -> None:
        """Set the speed, clipped to `SLOWEST` and `FASTEST`; ignore 0, negative numbers, infinity and NaN."""
        if speed > 0.0 and not math.isinf(speed):
            self.move_to(self.time_ns(now), now)
            self._speed = min(max(speed, SLOWEST), FASTEST)


Values = Mapping[str, float | str]
"""Values by name of constant. Durations are texts, other values are numbers."""

MOST_OPEN: Final = 8
"""Limit of open questions."""

_Answer = TypeVar("_Answer")


@dataclass
class PendingRequests:
    """Requests that the player has not performed yet.

    A new request replaces the earlier request of its kind. Only topics are collected.

    Attributes:
        edited: changed specifications or constants; None for no change.
        is_controlled: whether a viewer set play, pause or the speed.
        seek_ns: time to seek to; None for no seek.
        topics: newly subscribed topics.
        arrow: title of the result that the arrow shall point at; None for no change.
        stop: whether the session shall end.
    """

    edited: EditedFiles | None = None
    is_controlled: bool = False
    seek_ns: int | None = None
    topics: set[str] = field(default_factory=set)
    arrow: str | None = None
    stop: bool = False

    def __bool__(self) -> bool:
        return self != PendingRequests()


class Questions:
    """A queue of questions, which a separate thread answers one by one, so that playback continues."""

    def __init__(self, wait_for_evaluation: Callable[[], Evaluated]) -> None:
        """Begin with an empty queue.

        Args:
            wait_for_evaluation: returns the evaluation that viewers see; see `Session.wait_for_evaluation`.
        """
        self._wait_for_evaluation = wait_for_evaluation
        self._queue: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._open_answers: list[Future[Any]] = []
        self._lock = Lock()
        self._is_over = False

    def ask(self, work: Callable[[Evaluated], _Answer]) -> _Answer:
        """Return the result of `work` on the present evaluation, once earlier questions are answered.

        Raises:
            UsageError: too many questions are open, or the session is over.
            Exception: any error of `work`.
        """
        evaluated, answer = self._wait_for_evaluation(), Future[_Answer]()
        with self._lock:
            if self._is_over:
                raise session_over()
            if len(self._open_answers) >= MOST_OPEN:
                raise UsageError(f"{MOST_OPEN} questions are open already; ask again when they are answered")
            self._open_answers.append(answer)
            self._queue.put((answer, partial(work, evaluated)))
        return answer.result()

    def run(self) -> None:
        """Answer questions until `stop`."""
        while (question := self._queue.get()) is not None:
            answer, work = question
            # `stop` may refuse the question before or during its computation
            with suppress(InvalidStateError):
                if not answer.done():
                    try:
                        answer.set_result(work())
                    except Exception as error:
                        answer.set_exception(error)
            with self._lock:
                self._open_answers.remove(answer)

    def stop(self) -> None:
        """Refuse all open and all later questions."""
        with self._lock:
            self._is_over = True
            for answer in self._open_answers:
                with suppress(InvalidStateError):
                    answer.set_exception(session_over())
            self._queue.put(None)


def session_over() -> UsageError:
    """Return the error of a request after the end of the session."""
    return UsageError("the server is stopping")


PLAYBACK: Final = ("playback.time", "playback.play", "playback.speed", "playback.loop")
"""Parameters of the playback for viewers without controls.

Their values are the time in seconds after the log's zero, whether the log plays, the seconds of the log per
second, and whether the log starts again at its end."""

ARROW: Final = "scene.arrow"
"""Name of the parameter that chooses the arrow: a result's title, or "" for the first violated result."""

# int64 nanoseconds reach 9.2e9 seconds
_LONGEST_S: Final = 9e9


class PlaySpan(NamedTuple):
    """The next stretch to play: its end in the log's time, and the playing time of the last turn."""

    time_ns: int
    elapsed_s: float


class Session:
    """Requests of viewers. Any thread adds requests, and the player's thread performs them.

    Only `wait_for_evaluation` waits for the player. If requests arrive faster than the player performs them,
    a request replaces an earlier request of its kind.

    Attributes:
        edited: the specifications with the constants as viewers set them.
        arrow: the value of `ARROW`.
        failure: error of the last change that failed to evaluate, or None.
    """

    def __init__(
        self, loaded: LoadedLog, start_ns: int, end_ns: int, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Pause at the start, with the constants of the files.

        Args:
            start_ns, end_ns: first and last time of the log.
            clock: clock of the playback, in seconds.
        """
        self._log = loaded
        self._pace = Pace(clock)
        self._transport, self._zero_ns = Transport(start_ns, end_ns), loaded.first_ns
        self.edited = loaded.edit({})
        self._pending = PendingRequests()
        # the evaluation after the next requests, and the evaluation after the present requests
        self._next_evaluation: Future[Evaluated] | None = None
        self._due_evaluation: Future[Evaluated] | None = None
        self._condition = Condition()
        self._is_over = False
        self._is_looping = False
        self._is_behind = False
        self.arrow = ""
        self.failure: SpatialReplayError | None = None

    @property
    def name(self) -> str:
        """The log's name."""
        return self._log.name

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time of the log."""
        return self._transport.start_ns, self._transport.end_ns

    @property
    def values(self) -> Values:
        """The constants as viewers set them."""
        return constant_values(self.edited.constants)

    @property
    def state(self) -> PlaybackState:
        """The state of the playback."""
        with self._condition:
            return self._transport.state(self._pace.now())

    @property
    def playback(self) -> Mapping[str, float | bool]:
        """The values of the parameters in `PLAYBACK`, by name."""
        state = self.state
        time_s = round((state.time_ns - self._zero_ns) / 1e9, 3)
        is_playing = state.status is Status.PLAYING
        return dict(zip(PLAYBACK, (time_s, is_playing, state.speed, self._is_looping), strict=True))

    # ------------------------------------------------------------------------ called for viewers

    def control(self, *, is_playing: bool, speed: float, seek_ns: int | None = None) -> PlaybackState:
        """Play or pause at a speed, after a seek if `seek_ns` is given.

        At the end of the log, playback starts again at the first time.
        """
        with self._condition:
            now_s = self._pace.now()
            status = self._transport.state(now_s).status
            if seek_ns is None and is_playing and status is Status.ENDED:
                seek_ns = self._transport.start_ns
            # the messages since the last turn are not sent yet
            is_behind = self._is_behind or status is Status.PLAYING
            self._is_behind = seek_ns is None and not is_playing and is_behind
            self._transport.set_speed(speed, now_s)
            if seek_ns is not None:
                self._transport.move_to(seek_ns, now_s)
                self._pending.seek_ns = self._transport.time_ns(now_s)
            (self._transport.play if is_playing else self._transport.pause)(now_s)
            self._pending.is_controlled = True
            self._condition.notify()
            # without did_seek: the player reports the jump right before it sends the messages of that time
            return self._transport.state(now_s)

    def steer(self, values: Mapping[str, float | str | bool]) -> PlaybackState:
        """Set some parameters of `PLAYBACK`, and return the state.

        Raises:
            UsageError: a value has another type, or a number is outside its limits.
        """
        current_values = self.playback
        time_name, play_name, speed_name, loop_name = PLAYBACK
        for name, value in values.items():
            is_flag = isinstance(current_values[name], bool)
            if isinstance(value, str) or isinstance(value, bool) != is_flag:
                kind_text = "true or false" if is_flag else "a number"
                raise UsageError(f"{name} cannot be {value!r}: give {kind_text}")
            if name == speed_name and not (SLOWEST <= value <= FASTEST):
                raise UsageError(f"{name} cannot be {value!r}: give a number from {SLOWEST:g} to {FASTEST:g}")
            if not is_flag and not (0.0 <= value < float("inf")):
                raise UsageError(f"{name} cannot be {value!r}: give a number of seconds, at least 0")
        self._is_looping = bool(values.get(loop_name, self._is_looping))
        seek_ns = None
        if time_name in values:
            seek_ns = self._zero_ns + round(min(float(values[time_name]), _LONGEST_S) * 1e9)
        return self.control(
            is_playing=bool(values.get(play_name, current_values[play_name])),
            speed=float(values.get(speed_name, current_values[speed_name])),
            seek_ns=seek_ns,
        )

    def point_at(self, arrow: float | str | bool) -> None:
        """Point the arrow at the violation of the result with this title; "" for the first violated result.

        Raises:
            UsageError: the value is not a text.
        """
        if not isinstance(arrow, str):
            raise UsageError(f'{ARROW} cannot be {arrow!r}: give the title of a result, or "" for the first')
        with self._condition:
            self._pending.arrow = self.arrow = arrow
            self._condition.notify()

    def set_constants(self, values: Values) -> None:
        """Set the values of constants. After an error, all constants are unchanged.

        Raises:
            UsageError: a constant does not exist, or its value has another type.
            SpecificationError: the specification is invalid with these values.
        """
        with self._condition:
            edited = self.edited
            self._pending.edited = self.edited = edited.loaded.edit({**edited.given, **values})
            self._condition.notify()

    def replace_log(self, loaded: LoadedLog) -> None:
        """Evaluate other specifications over the same log.

        A constant that a viewer changed keeps the viewer's value, unless its file changed, too.
        """
        with self._condition:
            edited_before = self.edited
            constants_before = edited_before.loaded.constants
            values_from_viewers = {
                name: value
                for name, value in edited_before.given.items()
                if name in loaded.constants
                # `write_constants` wrote the viewer's earlier value; the viewer's present value may be newer
                and (loaded.constants[name] == constants_before[name] or loaded.was_written(name))
            }
            try:
                edited = loaded.edit(values_from_viewers)
            except SpatialReplayError:
                edited = loaded.edit({})
            self._pending.edited = self.edited = edited
            self._condition.notify()

    def resend(self, topic: str) -> None:
        """Send the latest messages of a topic again, for a viewer that has just subscribed to it."""
        with self._condition:
            self._pending.topics.add(topic)
            self._condition.notify()

    def wait_for_evaluation(self) -> Evaluated:
        """Return the evaluation that viewers see, once all earlier requests are performed.

        Raises:
            UsageError: the session is over.
        """
        with self._condition:
            if self._is_over:
                raise session_over()
            evaluation = self._next_evaluation = self._next_evaluation or Future()
            self._condition.notify()
        return evaluation.result()

    def stop(self) -> None:
        """End the session, and wake the player's thread."""
        self.end()
        with self._condition:
            self._pending.stop = True
            self._condition.notify()

    # -------------------------------------------------------------------------- called by the player

    def next_requests(self, patience_s: float, *, is_due: bool = False) -> PendingRequests:
        """Wait for requests, and return the pending requests.

        Args:
            patience_s: longest wait while the log plays or work is due, seconds. Otherwise the wait has no
                limit.
            is_due: whether the player has work that needs no request.
        """
        with self._condition:
            is_playing = self._transport.state(self._pace.now()).status is Status.PLAYING
            self._condition.wait_for(
                lambda: self._pending or self._next_evaluation is not None,
                patience_s if is_playing or is_due else None,
            )
            pending, self._pending = self._pending, PendingRequests()
            self._due_evaluation, self._next_evaluation = self._next_evaluation, None
            return pending

    def play_up_to(self, reach_ns: int) -> PlaySpan | None:
        """Return the next stretch to play; None while the log is paused, or a seek is pending.

        The first turn after a pause still plays the stretch up to the time of the pause.

        Args:
            reach_ns: latest time that one turn can reach. If the clock is later, playback lags behind.
        """
        with self._condition:
            elapsed_s = self._pace.next_turn()
            now_s = self._pace.now()
            state = self._transport.state(now_s)
            is_due = self._is_behind or state.status is Status.PLAYING
            self._is_behind = False
            if not is_due or self._pending.seek_ns is not None:
                return None
            if reach_ns < state.time_ns:
                self._transport.move_to(reach_ns, now_s)
            return PlaySpan(min(state.time_ns, reach_ns), elapsed_s)

    def continue_from(self, time_ns: int) -> None:
        """Continue at the time that was just shown, unless a seek is pending.

        While the player shows a time, the playback does not advance.
        """
        with self._condition:
            if self._pending.seek_ns is None:
                self._transport.move_to(time_ns, self._pace.now())

    def restore(self, edited: EditedFiles, failure: SpatialReplayError) -> Values:
        """Restore former specifications and return the present constants. A pending newer change stays.

        Args:
            failure: error of the latest specifications.
        """
        with self._condition:
            self.failure = failure
            if self._pending.edited is None:
                self.edited = edited
            return constant_values(self.edited.constants)

    def pause(self) -> PlaybackState:
        """Pause unless a seek is pending; return the state."""
        with self._condition:
            now_s = self._pace.now()
            if self._pending.seek_ns is None:
                self._transport.pause(now_s)
            return self._transport.state(now_s)

    def finish(self) -> PlaybackState:
        """Pause at the end, or start again if `playback.loop` is set."""
        if self._is_looping:
            return self.control(is_playing=True, speed=self.state.speed, seek_ns=self._transport.start_ns)
        return self.pause()

    def provide_evaluation(self, evaluated: Evaluated) -> None:
        """Give an evaluation to all calls of `wait_for_evaluation` before the last `next_requests`."""
        with self._condition:
            due_evaluation, self._due_evaluation = self._due_evaluation, None
        if due_evaluation is not None:
            due_evaluation.set_result(evaluated)

    def end(self) -> None:
        """Refuse waiting and later calls of `wait_for_evaluation` by an error."""
        with self._condition:
            self._is_over = True
            open_futures = [
                future for future in (self._next_evaluation, self._due_evaluation) if future is not None
            ]
            self._next_evaluation = self._due_evaluation = None
        for future in open_futures:
            future.set_exception(session_over())


MOST_A_SECOND: Final = 600
"""Rate limit of topics that the layout does not draw, samples per second; viewers read no more."""

MOST_DRAWN_A_SECOND: Final = 50
"""Rate limit of a topic that the layout draws, messages per second of wall time.

It equals the rate of the scene in annotated logs, so that playback at speed 1 sends every message."""

_MOST_AT_ONCE: Final = math.ceil(MOST_DRAWN_A_SECOND * MOST_LATE_S) + 1
"""Burst allowance, messages: the messages of the longest turn at speed 1.

One message more than the rate allows may be in a turn, depending on when the turn begins."""

_NEVER_THINNED: Final = (EVENTS, EVENT_LOG)
_DRAWN: Final = (
    SCENE,
    STANDING,
    RECENT_EVENTS,
    PLAN_DECISION,
    GRADIENT_MAP,
    PLAN_PATH,
    MAP_DRAWING,
    REDONE_MAP,
    REDONE_PATH,
    REDONE_DRAWING,
    CAMERA_ANNOTATIONS,
)


class PlaybackThinning:
    """Drops messages above the rate limits, turn by turn, on the player's thread.

    Topics that the layout draws send at most `MOST_DRAWN_A_SECOND` messages per second of wall time, and
    fewer than 60 in any one second. Other topics send the messages of at most `MOST_A_SECOND` samples per
    second. The last message of each turn and all events are sent.
    """

    def __init__(self) -> None:
        self._elapsed_s = 0.0
        self._allowances: dict[str, tuple[float, float]] = {}

    def thin(self, messages: Messages, elapsed_s: float) -> Messages:
        """Return the messages to send, from the messages of a turn of `elapsed_s` seconds."""
        self._elapsed_s += elapsed_s
        most_samples = max(1, math.ceil(MOST_A_SECOND * elapsed_s))
        is_sent = np.ones(len(messages), np.bool_)
        payloads: dict[int, bytes] = {}
        for channel, message_indices in messages.by_channel():
            if channel.topic in _NEVER_THINNED:
                continue
            times_ns, time_indices = np.unique(messages.log_time_ns[message_indices], return_inverse=True)
            # a turn at the rate limit may have one sample more than its limit, depending on its phase
            limit = self._take(channel.topic, len(times_ns)) if _is_drawn(channel) else most_samples
            if len(times_ns) <= limit + (not _is_drawn(channel)):
                continue
            is_chosen = np.zeros(len(times_ns), np.bool_)
            is_chosen[np.linspace(len(times_ns) - 1, 0, limit, endpoint=False).astype(np.int64)] = True
            is_sent[message_indices] = is_chosen[time_indices]
            if channel.topic == SCENE:
                payloads |= _with_deletions(messages.payloads, message_indices, is_sent)
        if is_sent.all():
            return messages
        sent_indices = np.flatnonzero(is_sent)
        sent_messages = select(messages, sent_indices)
        if not payloads:
            return sent_messages
        return replace(
            sent_messages,
            payloads=[payloads.get(index, messages.payloads[index]) for index in sent_indices.tolist()],
        )

    def _take(self, topic: str, count: int) -> int:
        """Return how many messages a drawn topic may send in this turn, at least 1.

        At most `count` messages are charged to the topic's allowance.
        """
        allowance, last_turn_s = self._allowances.get(topic, (float(_MOST_AT_ONCE), self._elapsed_s))
        allowance = min(allowance + MOST_DRAWN_A_SECOND * (self._elapsed_s - last_turn_s), _MOST_AT_ONCE)
        limit = max(1, math.floor(allowance))
        self._allowances[topic] = allowance - min(count, limit), self._elapsed_s
        return limit


def _is_drawn(channel: Channel) -> bool:
    # frames of a video are decoded with the frames before them
    schema = "" if channel.schema is None else channel.schema.name
    return channel.topic in _DRAWN or (is_image_type(schema) and not schema.endswith("Video"))


def _with_deletions(payloads: Sequence[bytes], places: Integers, is_kept: Booleans) -> dict[int, bytes]:
    """Return the kept scenes after dropped scenes, by index, with the deletions of the dropped scenes."""
    scene_by_index = {}
    missed_deletions = SceneUpdate()
    for place in places.tolist():
        if not is_kept[place]:
            missed_deletions.deletions.extend(SceneUpdate.FromString(payloads[place]).deletions)
        elif missed_deletions.deletions:
            # parsers join the lists of concatenated messages; a viewer deletes before it draws:
            # https://protobuf.dev/programming-guides/encoding/#last-one-wins
            scene_by_index[place] = missed_deletions.SerializeToString(deterministic=True) + payloads[place]
            missed_deletions = SceneUpdate()
    return scene_by_index


class Note(NamedTuple):
    """An error message for viewers. It replaces an earlier message about the same subject."""

    about: str
    text: str


CONSTANTS = "constants"
LOG = "log"
SPECIFICATION = "specification"
"""The subjects of notes: `CONSTANTS`, `LOG` and `SPECIFICATION`."""

PERIOD_S: Final = 1 / 30
"""Time between two turns, seconds."""

_CURVES_EVERY: Final = 60
"""Turns between two messages with the curves; some viewers drop the curves while their panels open."""

_PLAYBACK_EVERY: Final = 15
"""Turns between two updates of the playback's parameters."""

_MOST_SAMPLES: Final = 4_096
"""Limit of samples in one turn, so that a slow log does not block other requests."""


class Viewers(Protocol):
    """All viewers of a playback."""

    def wants(self, topic: str) -> bool:
        """Return whether a viewer has subscribed to a topic."""

    def publish(self, messages: Messages) -> None:
        """Send messages to all viewers."""

    def send_time(self, time_ns: int) -> None:
        """Send the time of the log."""

    def send_state(self, state: PlaybackState) -> None:
        """Send the state of the playback."""

    def send_playback(self) -> None:
        """Send the parameters of the playback."""

    def send_values(self, values: Values) -> None:
        """Send the values of constants."""

    def send_note(self, note: Note) -> None:
        """Show a note until it is removed."""

    def remove_note(self, about: str) -> None:
        """Remove the note on a subject."""


class Player:
    """Does the work of a session on one thread, so that the playback needs no locks."""

    def __init__(self, playback: Playback, session: Session, viewers: Viewers) -> None:
        self._playback = playback
        self._session = session
        self._viewers = viewers
        self._thinning = PlaybackThinning()
        self._turn_count = 0
        self._shows_again = False

    def run(self) -> None:
        """Perform requests until the session is stopped."""
        try:
            while not (requests := self._session.next_requests(PERIOD_S, is_due=self._shows_again)).stop:
                try:
                    self._turn(requests)
                except SpatialReplayError as error:
                    self._viewers.send_note(Note(LOG, str(error)))
                    self._viewers.send_state(self._session.pause())
        finally:
            self._session.end()

    def _turn(self, requests: PendingRequests) -> None:
        try:
            self._do(requests)
        finally:
            self._session.provide_evaluation(self._playback.evaluated)
        self._play_on()

    def _do(self, requests: PendingRequests) -> None:
        shows_again, self._shows_again = self._shows_again, False
        time_ns = self._playback.time_ns if requests.seek_ns is None else requests.seek_ns
        is_changed = requests.edited is not None and self._evaluate(requests.edited)
        is_arrow_moved = requests.arrow is not None and self._point_at(requests.arrow)
        if is_arrow_moved or is_changed or requests.seek_ns is not None:
            self._seek(time_ns)
        elif shows_again and self._session.state.status is not Status.PLAYING:
            self._show(time_ns)
        if requests.topics:
            self._resend(requests.topics)

    def _evaluate(self, edited: EditedFiles) -> bool:
        """Evaluate the whole log with other constants, and return whether that succeeded.

        After an error, viewers get the former values.
        """
        evaluated_before = self._playback.evaluated
        try:
            self._playback.evaluated = edited.loaded.evaluate(edited)
        except SpatialReplayError as error:
            self._viewers.send_note(Note(CONSTANTS, str(error)))
            self._viewers.send_values(self._session.restore(evaluated_before.edited, error))
            return False
        if edited.loaded is not evaluated_before.loaded:
            # viewers know the constants that they set, but not the constants of a saved file
            self._viewers.send_values(constant_values(edited.constants))
        self._viewers.remove_note(CONSTANTS)
        return True

    def _point_at(self, arrow: str) -> bool:
        """Point the arrow at a result, and return whether that result exists."""
        try:
            self._playback.evaluated.evaluation.check_arrow(arrow)
        except UsageError as error:
            self._viewers.send_note(Note(ARROW, str(error)))
            self._session.point_at(self._playback.arrow)
            self._viewers.send_playback()
            return False
        self._playback.arrow = arrow
        return True

    def _seek(self, time_ns: int) -> None:
        """Show a time and continue from it.

        Some viewers drop messages only some time after a jump, so a paused playback sends the messages again.
        """
        self._viewers.send_state(self._session.state._replace(time_ns=time_ns, did_seek=True))
        self._show(time_ns)
        self._session.continue_from(time_ns)
        self._shows_again = True

    def _show(self, time_ns: int) -> None:
        """Make viewers drop earlier messages, then send the messages of a time.

        Viewers drop messages when time steps back, or at a state with `did_seek`. Times can overtake messages
        on their way to a viewer.
        """
        self._viewers.send_time(self._playback.start_ns)
        self._viewers.send_time(time_ns)
        present_messages = self._playback.seek(time_ns)
        self._viewers.publish(self._playback.past)
        self._send_curves(time_ns)
        self._viewers.publish(present_messages)
        self._viewers.send_time(time_ns)

    def _resend(self, topics: Collection[str]) -> None:
        """Send the present messages of some topics again."""
        time_ns = self._playback.time_ns
        if CURVES_TOPIC in topics:
            self._send_curves(time_ns)
        self._viewers.publish(self._playback.seek(time_ns).of_topics(topics))
        self._viewers.send_state(self._session.state)
        self._viewers.send_time(time_ns)

    def _send_curves(self, time_ns: int) -> None:
        """Send the curves of the whole log, which viewers drop at each jump."""
        if self._viewers.wants(CURVES_TOPIC):
            curves = [self._playback.evaluated.curves]
            self._viewers.publish(messages_of(CURVES_CHANNEL, np.array([time_ns]), curves, 0))

    def _play_on(self) -> None:
        """Send the messages since the last turn, if the log plays."""
        span = self._session.play_up_to(self._playback.reach_ns(_MOST_SAMPLES))
        if span is None:
            return
        time_ns = span.time_ns
        new_messages = self._playback.advance_to(time_ns)
        self._viewers.publish(self._thinning.thin(new_messages, span.elapsed_s))
        self._viewers.send_time(time_ns)
        self._turn_count += 1
        if self._turn_count % _CURVES_EVERY == 0:
            self._send_curves(time_ns)
        if time_ns == self._playback.end_ns:
            self._viewers.send_state(self._session.finish())
            self._viewers.send_playback()
        elif self._turn_count % _PLAYBACK_EVERY == 0:
            self._viewers.send_playback()

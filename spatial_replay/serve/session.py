"""What several viewers of one log want: one place in it, one value for each constant.

What viewers want of a session, until its thread gets to it.

Where a playback is: playing or paused, how fast, at which time.

The clock of a playback: it waits for whoever plays.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum, auto
from threading import Condition
from typing import Any, Final, NamedTuple, TypeVar

from spatial_replay.errors import UsageError
from spatial_replay.replay.tuning import Tuned, Tuning, constant_values

MOST_LATE_S: Final = 0.15
"""What passes from one turn to the next, at most; viewers take what is played in that time at once."""


class Pace:
    """Seconds by which a log is played, turn by turn.

    A turn that comes late finds that little more has passed than in time: the playback falls behind, and no
    turn has more to do than viewers take.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        """Begin the first turn."""
        self._clock = clock
        self._behind_s = 0.0
        self._turn = clock()

    def now(self) -> float:
        """What has passed by now."""
        return self._at(self._clock())

    def next_turn(self) -> float:
        """Begin another turn; the seconds that the last one took, at most `MOST_LATE_S`."""
        read = self._clock()
        now = self._at(read)
        lasted_s = now - self._turn
        self._behind_s, self._turn = read - now, now
        return lasted_s

    def _at(self, read: float) -> float:
        return min(read - self._behind_s, self._turn + MOST_LATE_S)


SLOWEST: Final = 0.01
FASTEST: Final = 100.0


class Status(Enum):
    """What a playback does."""

    PLAYING = auto()
    PAUSED = auto()
    ENDED = auto()


class State(NamedTuple):
    """What viewers are told of a playback.

    Attributes:
        speed: seconds of the log in a second.
        did_seek: whether it is at this time because it was set there, so that what was shown is out of date.
    """

    status: Status
    time_ns: int
    speed: float
    did_seek: bool = False


class Transport:
    """Plays, pauses and seeks, by a clock that whoever asks brings along: `now`, in seconds.

    Attributes:
        start_ns, end_ns: first and last time.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        """Pause at the start."""
        self.start_ns, self.end_ns = start_ns, end_ns
        self._is_playing = False
        self._speed = 1.0
        self._from_ns, self._since = start_ns, 0.0

    def time_ns(self, now: float) -> int:
        """Where it is."""
        if not self._is_playing:
            return self._from_ns
        played_ns = round((now - self._since) * self._speed * 1e9)
        return min(self._from_ns + max(played_ns, 0), self.end_ns)

    def state(self, now: float, *, did_seek: bool = False) -> State:
        """What to tell viewers."""
        time_ns = self.time_ns(now)
        status = Status.PLAYING if self._is_playing else Status.PAUSED
        if not self._is_playing and time_ns >= self.end_ns:
            status = Status.ENDED
        return State(status, time_ns, self._speed, did_seek)

    def play(self, now: float) -> None:
        """Go on from where it is; at the end, that is over at once."""
        self.move_to(self.time_ns(now), now)
        self._is_playing = True

    def pause(self, now: float) -> None:
        """Stay where it is."""
        self.move_to(self.time_ns(now), now)
        self._is_playing = False

    def move_to(self, time_ns: int, now: float) -> None:
        """Go on from another time, within the log."""
        self._from_ns, self._since = min(max(time_ns, self.start_ns), self.end_ns), now

    def set_speed(self, speed: float, now: float) -> None:
        """Go on faster or slower, within limits; what is no number above 0 changes nothing."""
        if speed > 0.0 and not math.isinf(speed):
            self.move_to(self.time_ns(now), now)
            self._speed = min(max(speed, SLOWEST), FASTEST)


Values = dict[str, float | str]
"""Numbers and, as texts, durations, by the names of constants."""

OVER: Final = "the server is stopping"


@dataclass(frozen=True)
class Question:
    """Something to be worked out from the present evaluation, and where the answer goes."""

    work: Callable[[Tuned], Any]
    answer: Future[Any] = field(default_factory=Future)

    def settle(self, tuned: Tuned) -> None:
        """Work it out, unless it comes too late."""
        if self.answer.done():
            return
        with suppress(InvalidStateError):  # it was refused meanwhile
            try:
                self.answer.set_result(self.work(tuned))
            except Exception as error:
                self.answer.set_exception(error)

    def refuse(self) -> None:
        """Say that it comes too late, also if it is being worked out."""
        with suppress(InvalidStateError):
            self.answer.set_exception(UsageError(OVER))


@dataclass
class Wishes:
    """What has been asked for and is not done yet; of several of a kind the last one counts.

    Attributes:
        values: those of the constants that differ from what is written, if they are to change.
        is_steered: whether to play, pause or change the speed.
        sought_ns: another time to go to.
        topics: which topics somebody has subscribed to.
        stop: whether the session is to end.
    """

    values: Values | None = None
    is_steered: bool = False
    sought_ns: int | None = None
    topics: set[str] = field(default_factory=set)
    stop: bool = False

    def __bool__(self) -> bool:
        return self != Wishes()


_Answer = TypeVar("_Answer")


class Passage(NamedTuple):
    """What is to be played now: up to which time of the log, in place of how many seconds of waiting."""

    time_ns: int
    lasted_s: float


class Session:
    """Takes down what viewers want, on any thread, and hands it to the one that does it.

    Nothing here waits for work but `ask`. Of wishes that come faster than they are met, the last one counts.
    """

    def __init__(
        self, tuning: Tuning, start_ns: int, end_ns: int, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Pause at the start, with constants as they are written.

        Args:
            start_ns, end_ns: first and last time.
            clock: seconds by which it plays.
        """
        self._tuning = tuning
        self._pace = Pace(clock)
        self._transport = Transport(start_ns, end_ns)
        self._values = constant_values(tuning.constants)
        self._wishes = Wishes()
        self._questions: list[Question] = []
        self._wished = Condition()
        self._is_over = False

    @property
    def name(self) -> str:
        """What the log is called."""
        return self._tuning.name

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time."""
        return self._transport.start_ns, self._transport.end_ns

    @property
    def values(self) -> Mapping[str, float | str]:
        """The constants as viewers want them: numbers and, as texts, durations."""
        return self._values

    @property
    def state(self) -> State:
        """Where it is, and what it does."""
        with self._wished:
            return self._transport.state(self._pace.now())

    # --------------------------------------------------------------------------- what viewers want

    def control(self, *, is_playing: bool, speed: float, seek_ns: int | None = None) -> State:
        """Play or pause, as fast as is asked for, from another time on if one is given.

        What plays on from the end begins again.
        """
        with self._wished:
            now = self._pace.now()
            if seek_ns is None and is_playing and self._transport.state(now).status is Status.ENDED:
                seek_ns = self._transport.start_ns
            self._transport.set_speed(speed, now)
            if seek_ns is not None:
                self._transport.move_to(seek_ns, now)
                self._wishes.sought_ns = self._transport.time_ns(now)
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
            self._tuning.edit(wished)
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
                raise UsageError(OVER)
            self._questions.append(question)
            self._wished.notify()
        answer: _Answer = question.answer.result()
        return answer

    def stop(self) -> None:
        """Be over, and let whoever does the work know."""
        self.end()
        with self._wished:
            self._wishes.stop = True
            self._wished.notify()

    # ------------------------------------------------------------------------------- what is done

    def next_wishes(self, patience_s: float) -> Wishes:
        """What is wanted by now, or once something is; while it plays, that is waited for so long only."""
        with self._wished:
            is_playing = self._transport.state(self._pace.now()).status is Status.PLAYING
            self._wished.wait_for(lambda: self._wishes or self._questions, patience_s if is_playing else None)
            wishes, self._wishes = self._wishes, Wishes()
            return wishes

    def play_up_to(self, reach_ns: int) -> Passage | None:
        """What to play now; None if it does not play, or is to go on from elsewhere first.

        Args:
            reach_ns: as far as can be played at once; it falls behind the clock rather than go farther.
        """
        with self._wished:
            lasted_s = self._pace.next_turn()
            now = self._pace.now()
            state = self._transport.state(now)
            if state.status is not Status.PLAYING or self._wishes.sought_ns is not None:
                return None
            if reach_ns < state.time_ns:
                self._transport.move_to(reach_ns, now)
            return Passage(min(state.time_ns, reach_ns), lasted_s)

    def go_on_from(self, time_ns: int) -> None:
        """Play from what was just shown, which takes no time, unless somebody wants to be elsewhere."""
        with self._wished:
            if self._wishes.sought_ns is None:
                self._transport.move_to(time_ns, self._pace.now())

    def take_back(self, values: Values) -> Mapping[str, float | str]:
        """Give the constants the values that they had, unless somebody wants others; what they are then."""
        with self._wished:
            if self._wishes.values is None:
                self._values = values
            return self._values

    def pause(self) -> State:
        """Stay here, unless somebody wants to be elsewhere."""
        with self._wished:
            now = self._pace.now()
            if self._wishes.sought_ns is None:
                self._transport.pause(now)
            return self._transport.state(now)

    def answer(self, tuned: Tuned) -> None:
        """Settle what was asked so far."""
        for question in self._taken():
            question.settle(tuned)

    def end(self) -> None:
        """Leave no question open, and take no more."""
        with self._wished:
            self._is_over = True
        for question in self._taken():
            question.refuse()

    def _taken(self) -> list[Question]:
        with self._wished:
            taken, self._questions = self._questions, []
            return taken

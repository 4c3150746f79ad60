"""What several viewers of one log want: one place in it, one value for each constant."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from threading import Condition
from typing import NamedTuple, TypeVar

from spatial_replay.errors import UsageError
from spatial_replay.replay.tuning import Tuned, Tuning, values_of
from spatial_replay.runs.live.pace import Pace
from spatial_replay.runs.live.transport import State, Status, Transport
from spatial_replay.runs.live.wishes import OVER, Question, Values, Wishes

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
        self._values = values_of(tuning.constants)
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

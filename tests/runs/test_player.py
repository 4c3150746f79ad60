"""What a player sends by a clock that the test turns."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import SimpleQueue

import pytest

import spatial_replay as sr
from replay.runs import STEP_NS, PiecewiseSource, run
from spatial_replay.errors import UsageError
from spatial_replay.inspection.curves import CURVES_CHANNEL
from spatial_replay.logs.block import Messages
from spatial_replay.logs.topics import ROBUSTNESS
from spatial_replay.replay.playback import Playback
from spatial_replay.replay.tuning import Tuning
from spatial_replay.runs.live.outlet import Note
from spatial_replay.runs.live.player import MOST_TIMES, Player
from spatial_replay.runs.live.session import Session
from spatial_replay.runs.live.transport import State, Status

PATIENCE_S = 10.0
TEXT = 'const far = 0.5\nspec apart = F (cube dist "cup 物" >= far)\n'


@dataclass
class Kept:
    """An outlet that keeps what it is told, in order."""

    told: SimpleQueue[Messages | State | Note | int] = field(default_factory=SimpleQueue)

    def wants(self, topic: str) -> bool:
        return True

    def publish(self, messages: Messages) -> None:
        self.told.put(messages)

    def tell_state(self, state: State) -> None:
        self.told.put(state)

    def tell_time(self, time_ns: int) -> None:
        self.told.put(time_ns)

    def tell(self, note: Note) -> None:
        self.told.put(note)

    def until(self, is_wanted: Callable[[object], bool]) -> list[object]:
        """All that is told up to the first that is wanted."""
        found: list[object] = []
        deadline = time.monotonic() + PATIENCE_S
        while not found or not is_wanted(found[-1]):
            found.append(self.told.get(timeout=max(0.0, deadline - time.monotonic())))
        return found


@dataclass
class Clock:
    now: float = 0.0

    def __call__(self) -> float:
        return self.now


@contextmanager
def playing(count: int, clock: Clock) -> Iterator[tuple[Session, Kept]]:
    specification = sr.parse_specification(TEXT, filename="blocks.spatial")
    tuning = Tuning(PiecewiseSource(run(count), 1_000), [specification])
    playback = Playback(tuning.evaluate())
    playback.seek(0)
    session = Session(tuning, playback.start_ns, playback.end_ns, clock=clock)
    outlet = Kept()
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(Player(playback, session, outlet).run)
        try:
            yield session, outlet
        finally:
            session.stop()
            running.result(PATIENCE_S)


def robustness_times(told: list[object]) -> list[int]:
    return [
        time_ns
        for each in told
        if isinstance(each, Messages)
        for time_ns, number in zip(each.log_time_ns.tolist(), each.channel.tolist(), strict=True)
        if each.channels[number].topic == ROBUSTNESS
    ]


def is_over(told: object) -> bool:
    return isinstance(told, State) and told.status is Status.ENDED


def test_what_passes_by_the_clock_is_sent_once_and_in_order() -> None:
    clock = Clock()
    with playing(30, clock) as (session, outlet):
        session.control(is_playing=True, speed=1.0)
        sent = []
        for step in range(1, 5):
            clock.now = step * 0.5
            session.show_again("/nothing")  # wakes the player
            sent += outlet.until(lambda told, now=clock.now: told == round(now * 1e9))
        assert sorted(set(robustness_times(sent))) == [index * STEP_NS for index in range(1, 9)]


def test_a_clock_that_runs_away_is_followed_in_pieces() -> None:
    clock = Clock()
    with playing(6_000, clock) as (session, outlet):
        session.control(is_playing=True, speed=1.0, seek_ns=0)
        outlet.until(lambda told: told == 0)
        clock.now = 1e6
        first, second = (outlet.until(lambda told: isinstance(told, int) and told > 0) for _ in range(2))
        # the first piece is as long as it may be; by the clock the second begins where that ended
        assert len(robustness_times(first)) == MOST_TIMES
        clock.now = 2e6
        told = second + outlet.until(is_over)
        times = [each for each in told if isinstance(each, int)]
        assert times == sorted(times)
        assert times[-1] == 5_999 * STEP_NS


def test_curves_are_sent_again_while_it_plays() -> None:
    with playing(40, Clock()) as (session, outlet):
        session.control(is_playing=True, speed=1.0)
        told = outlet.until(
            lambda told: isinstance(told, Messages) and CURVES_CHANNEL in told.channels.values()
        )
        assert not any(isinstance(each, State) for each in told)


def test_nobody_is_answered_after_the_end() -> None:
    with playing(5, Clock()) as (session, _):
        assert session.ask(lambda tuned: tuned.verdict) == "satisfied"
    with pytest.raises(UsageError, match="stopping"):
        session.ask(lambda tuned: tuned.verdict)


def test_an_error_in_an_answer_is_that_of_who_asked() -> None:
    with playing(5, Clock()) as (session, _):
        with pytest.raises(ZeroDivisionError):
            session.ask(lambda tuned: 1 // 0)
        assert session.ask(lambda tuned: 1) == 1


def test_a_change_while_it_plays_loses_no_sample() -> None:
    clock = Clock()
    with playing(40, clock) as (session, outlet):
        session.control(is_playing=True, speed=1.0, seek_ns=0)
        sent = outlet.until(lambda told: told == 0)
        clock.now = 2.0
        sent += outlet.until(lambda told: told == 2_000_000_000)
        session.change({"far": 1.0})
        session.ask(lambda tuned: None)  # it is done by then
        clock.now = 4.0
        sent += outlet.until(lambda told: told == 4_000_000_000 or is_over(told))
        counts = Counter(robustness_times(sent))
        assert set(counts) == {index * STEP_NS for index in range(17)}

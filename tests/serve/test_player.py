"""What a player sends, by a clock that the test sets."""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from queue import SimpleQueue
from threading import Event

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from replay.runs import STEP_NS, PiecewiseSource, run
from spatial_replay import UsageError
from spatial_replay.annotate.robustness import CURVES_CHANNEL
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.schemas.Robustness_pb2 import Robustness
from spatial_replay.logs.topics import ROBUSTNESS, SCENE, STANDING
from spatial_replay.replay.loaded_log import Evaluated, LoadedLog, Playback
from spatial_replay.serve.player import (
    MOST_A_SECOND,
    MOST_LATE_S,
    MOST_OPEN,
    Note,
    PlaybackState,
    Player,
    Questions,
    Session,
    Status,
)

PATIENCE_S = 10.0
MOST_SAMPLES = math.ceil(MOST_A_SECOND * MOST_LATE_S)
TEXT = 'const far = 0.5\nspec apart = F (cube dist "cup 物" >= far)\n'


@dataclass
class RecordingViewers:
    """Viewers that record what they are sent, in order."""

    sent: SimpleQueue[Messages | PlaybackState | Note | Mapping[str, float | str] | int] = field(
        default_factory=SimpleQueue
    )

    def wants(self, topic: str) -> bool:
        return True

    def publish(self, messages: Messages) -> None:
        self.sent.put(messages)

    def send_state(self, state: PlaybackState) -> None:
        self.sent.put(state)

    def send_time(self, time_ns: int) -> None:
        self.sent.put(time_ns)

    def send_values(self, values: Mapping[str, float | str]) -> None:
        self.sent.put(values)

    def send_playback(self) -> None:
        self.sent.put({"playback": "sent"})

    def send_note(self, note: Note) -> None:
        self.sent.put(note)

    def remove_note(self, about: str) -> None:
        pass

    def until(self, is_wanted: Callable[[object], bool]) -> list[object]:
        """Return all that is sent up to the first that is wanted."""
        received: list[object] = []
        deadline = time.monotonic() + PATIENCE_S
        while not received or not is_wanted(received[-1]):
            received.append(self.sent.get(timeout=max(0.0, deadline - time.monotonic())))
        return received


@dataclass
class Clock:
    now: float = 0.0

    def __call__(self) -> float:
        return self.now


def loaded_of(count: int, step_ns: int = STEP_NS) -> LoadedLog:
    trace = replace(run(count), times_ns=np.arange(count) * step_ns)
    return LoadedLog(PiecewiseSource(trace, 1_000), [sr.parse_specification(TEXT, filename="blocks.spatial")])


@contextmanager
def playing(
    loaded: LoadedLog, clock: Clock, viewers: RecordingViewers | None = None
) -> Iterator[tuple[Session, RecordingViewers]]:
    playback = Playback(loaded.evaluate())
    playback.seek(0)
    session = Session(loaded, playback.start_ns, playback.end_ns, clock=clock)
    viewers = viewers or RecordingViewers()
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(Player(playback, session, viewers).run)
        try:
            yield session, viewers
        finally:
            session.stop()
            running.result(PATIENCE_S)


def robustness_times(sent: list[object]) -> list[int]:
    """The times of samples; the last message of all is about the finished log."""
    return [
        time_ns
        for each in sent
        if isinstance(each, Messages)
        for time_ns, number, payload in zip(
            each.log_time_ns.tolist(), each.channel.tolist(), each.payloads, strict=True
        )
        if each.channels[number].topic == ROBUSTNESS and not Robustness.FromString(payload).final
    ]


def is_over(sent: object) -> bool:
    return isinstance(sent, PlaybackState) and sent.status is Status.ENDED


def play_to_the_end(session: Session, clock: Clock, waits: list[float]) -> None:
    """Move the clock after each turn of the player, until the log is over."""
    for wait_s in itertools.cycle(waits):
        clock.now += wait_s
        session.wait_for_evaluation()
        state = session.state
        if state.status is Status.ENDED:
            return


def test_samples_are_sent_once_and_in_order() -> None:
    clock = Clock()
    with playing(loaded_of(30), clock) as (session, viewers):
        session.control(is_playing=True, speed=4.0)
        sent = []
        for step in range(1, 5):
            clock.now = step * 0.125
            session.resend("/nothing")  # wakes the player
            sent += viewers.until(lambda sent, now=clock.now: sent == round(4.0 * now * 1e9))
        assert sorted(set(robustness_times(sent))) == [index * STEP_NS for index in range(1, 9)]


RATES = [
    (1e9 / MOST_A_SECOND, 1.0),
    (1e9 / MOST_A_SECOND, 0.3),
    (100e9 / MOST_A_SECOND, 100.0),
    (19e9 / MOST_A_SECOND, 19.0),
    (STEP_NS, 100.0),
]
"""From sample to sample in nanoseconds, and speeds that play at most the samples a second that are sent."""


@pytest.mark.parametrize(("step_ns", "speed"), RATES)
@examples(10)
@given(waits=st.lists(st.floats(0.001, 5.0), min_size=1, max_size=6))
def test_late_turns_lose_no_sample(step_ns: float, speed: float, waits: list[float]) -> None:
    clock, step_ns = Clock(), math.ceil(step_ns)
    with playing(loaded_of(300, step_ns), clock) as (session, viewers):
        session.control(is_playing=True, speed=speed)
        play_to_the_end(session, clock, [*waits, 0.2])
        counts = Counter(robustness_times(viewers.until(is_over)))
        assert counts == {index * step_ns: 1 for index in range(1, 300)}


@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
def test_after_a_pause_viewers_show_the_time_of_the_pause(speed: float) -> None:
    clock, step_ns = Clock(), 10_000_000
    with playing(loaded_of(3_000, step_ns), clock) as (session, viewers):
        session.control(is_playing=True, speed=speed)
        clock.now += 0.1
        sent = viewers.until(lambda each: isinstance(each, int) and each > 0)
        clock.now += 0.1
        paused_ns = session.control(is_playing=False, speed=speed).time_ns
        sent += viewers.until(lambda each: each == paused_ns)
        assert robustness_times(sent)[-1] == paused_ns // step_ns * step_ns
        assert session.state.time_ns == paused_ns


def test_at_the_end_viewers_learn_that_nothing_plays() -> None:
    clock = Clock()
    with playing(loaded_of(20), clock) as (session, viewers):
        session.control(is_playing=True, speed=1.0)
        play_to_the_end(session, clock, [0.1])
        viewers.until(is_over)
        assert viewers.until(lambda each: each == {"playback": "sent"})
        assert session.playback["playback.play"] is False


def test_a_fast_playback_is_thinned_to_what_viewers_can_take() -> None:
    clock, step_ns = Clock(), 1_000_000
    with playing(loaded_of(2_000, step_ns), clock) as (session, viewers):
        session.control(is_playing=True, speed=4.0)
        play_to_the_end(session, clock, [0.03125])
        sent = robustness_times(viewers.until(is_over))
        assert 0.5 * MOST_A_SECOND <= len(sent) <= 0.55 * MOST_A_SECOND
        assert sent[-1] == 1_999 * step_ns
        assert max(np.diff(sent)) <= 8 * step_ns


@pytest.mark.parametrize("speed", [1.0, 4.0, 20.0, 100.0])
def test_the_scene_and_the_standing_have_at_most_50_messages_a_second_at_any_speed(speed: float) -> None:
    clock = Clock()
    with playing(loaded_of(400, 10_000_000), clock) as (session, viewers):
        session.control(is_playing=True, speed=speed)
        play_to_the_end(session, clock, [0.03125])
        sent = [each for each in viewers.until(is_over) if isinstance(each, Messages)]
        for topic in (SCENE, STANDING):
            times_ns = [
                time_ns
                for each in sent
                for time_ns, number in zip(each.log_time_ns.tolist(), each.channel.tolist(), strict=True)
                if each.channels[number].topic == topic
            ]
            # a few may come at once at the start
            assert 0.8 * 50 * clock.now <= len(times_ns) <= 50 * clock.now + 10
            assert times_ns[-1] >= 3_980_000_000


def test_a_late_playback_falls_behind_the_clock() -> None:
    clock = Clock()
    with playing(loaded_of(6_000), clock) as (session, viewers):
        session.control(is_playing=True, speed=100.0)
        clock.now = 1e6
        assert session.state.time_ns == round(100.0 * MOST_LATE_S * 1e9)
        sent = viewers.until(lambda each: isinstance(each, int) and each > 0)
        assert len(robustness_times(sent)) <= MOST_SAMPLES
        assert session.state.time_ns == sent[-1]


def test_curves_are_sent_again_while_a_log_plays() -> None:
    with playing(loaded_of(40), Clock()) as (session, viewers):
        session.control(is_playing=True, speed=1.0)
        sent = viewers.until(
            lambda each: isinstance(each, Messages) and CURVES_CHANNEL in each.channels.values()
        )
        assert not any(isinstance(each, PlaybackState) for each in sent)


def test_requests_after_the_end_are_refused() -> None:
    with playing(loaded_of(5), Clock()) as (session, _):
        assert session.wait_for_evaluation().verdict == "satisfied"
    with pytest.raises(UsageError, match="stopping"):
        session.wait_for_evaluation()


def test_a_change_during_playback_loses_no_sample() -> None:
    clock = Clock()
    with playing(loaded_of(40), clock) as (session, viewers):
        session.control(is_playing=True, speed=20.0, seek_ns=0)
        sent = viewers.until(lambda sent: isinstance(sent, Messages))
        sent += viewers.until(lambda sent: sent == 0)
        clock.now = 0.1
        sent += viewers.until(lambda sent: sent == 2_000_000_000)
        session.set_constants({"far": 1.0})
        session.wait_for_evaluation()
        clock.now = 0.2
        sent += viewers.until(lambda sent: sent == 4_000_000_000 or is_over(sent))
        counts = Counter(robustness_times(sent))
        assert set(counts) == {index * STEP_NS for index in range(17)}


def test_a_change_that_cannot_be_evaluated_restores_the_former_values() -> None:
    text = "const wide = 1\nregion goal = box(0, 0, wide, 1)\nspec reach = F (cube ovlp goal)\n"
    loaded = LoadedLog(PiecewiseSource(run(5), 5), [sr.parse_specification(text, filename="blocks.spatial")])
    with playing(loaded, Clock()) as (session, viewers):
        session.set_constants({"wide": 1e300})
        *_, note, values = viewers.until(lambda sent: isinstance(sent, Mapping))
        assert isinstance(note, Note)
        assert note.about == "constants"
        assert "1e+300" in note.text
        assert values == session.values == {"wide": 1}
        session.set_constants({"wide": 2})
        viewers.until(lambda each: isinstance(each, PlaybackState) and each.did_seek)
        assert "(wide = 2)" in session.wait_for_evaluation().summary


@contextmanager
def answering(session: Session) -> Iterator[Questions]:
    questions = Questions(session.wait_for_evaluation)
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(questions.run)
        try:
            yield questions
        finally:
            questions.stop()
            running.result(PATIENCE_S)


def test_an_evaluation_has_what_was_set_before_it_was_asked_for() -> None:
    is_sending, may_send = Event(), Event()

    class BusyViewers(RecordingViewers):
        def publish(self, messages: Messages) -> None:
            is_sending.set()
            may_send.wait(PATIENCE_S)

    with (
        playing(loaded_of(5), Clock(), BusyViewers()) as (session, _),
        ThreadPoolExecutor(1) as asking,
    ):
        session.resend(ROBUSTNESS)
        assert is_sending.wait(PATIENCE_S)
        session.set_constants({"far": 3.0})
        asked = asking.submit(session.wait_for_evaluation)
        while not asked.running():
            pass
        may_send.set()
        assert asked.result(PATIENCE_S).edited.given == {"far": 3.0}


def test_an_error_in_an_answer_is_raised_where_it_was_asked() -> None:
    with playing(loaded_of(5), Clock()) as (session, _), answering(session) as questions:
        with pytest.raises(ZeroDivisionError):
            questions.ask(lambda evaluated: 1 // 0)
        assert questions.ask(lambda evaluated: 1) == 1


def test_a_long_question_does_not_hold_up_the_playback() -> None:
    clock, is_asked, may_answer = Clock(), Event(), Event()

    def long_work(evaluated: Evaluated) -> str:
        is_asked.set()
        may_answer.wait(PATIENCE_S)
        return str(evaluated.verdict)

    with (
        playing(loaded_of(30), clock) as (session, viewers),
        answering(session) as questions,
        ThreadPoolExecutor(MOST_OPEN) as asking,
    ):
        asked = [asking.submit(questions.ask, long_work) for _ in range(MOST_OPEN)]
        assert is_asked.wait(PATIENCE_S)
        session.control(is_playing=True, speed=100.0)
        play_to_the_end(session, clock, [0.1])
        assert max(robustness_times(viewers.until(is_over))) == 29 * STEP_NS
        may_answer.set()
        assert [each.result(PATIENCE_S) for each in asked] == ["satisfied"] * MOST_OPEN


def test_open_questions_are_refused_at_the_end() -> None:
    is_asked, may_end = Event(), Event()

    def long_work(evaluated: Evaluated) -> bool:
        is_asked.set()
        return may_end.wait(PATIENCE_S)

    with (
        playing(loaded_of(5), Clock()) as (session, _),
        answering(session) as questions,
        ThreadPoolExecutor(2) as asking,
    ):
        asked = [asking.submit(questions.ask, long_work) for _ in range(2)]
        assert is_asked.wait(PATIENCE_S)
        questions.stop()
        for each in asked:
            with pytest.raises(UsageError, match="stopping"):
                each.result(PATIENCE_S)
        may_end.set()


def test_the_number_of_open_questions_is_limited() -> None:
    may_answer = Event()
    with (
        playing(loaded_of(5), Clock()) as (session, _),
        answering(session) as questions,
        ThreadPoolExecutor(MOST_OPEN + 1) as asking,
    ):
        asked = [
            asking.submit(questions.ask, lambda evaluated: may_answer.wait(PATIENCE_S))
            for _ in range(MOST_OPEN + 1)
        ]
        refused = next(as_completed(asked, PATIENCE_S))
        with pytest.raises(UsageError, match="open already"):
            refused.result()
        may_answer.set()
        assert sum(each.exception(PATIENCE_S) is None for each in asked) == MOST_OPEN

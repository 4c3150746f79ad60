"""The topic with which viewers show how all results stand."""

from __future__ import annotations

import colorsys
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from google.protobuf.message import Message
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.reader import make_reader

import spatial_replay as sr
from spatial_replay.logs.schemas.Robustness_pb2 import (
    HOLDS_SO_FAR,
    PENDING,
    SATISFIED,
    UNKNOWN,
    VIOLATED,
    Robustness,
    Standing,
    StandingUpdate,
)
from spatial_replay.logs.source import MemorySource
from spatial_replay.logs.wire import round_numbers
from spatial_replay.replay.engine import run_replay

STEP_NS = 10**8

COLOURS = """
#4e98e2 #f5774d #f7df71 #5cd6a9 #61cbff #a395e2 #cad660
#e24ee2 #77f54d #71f79c #6c5cd6 #e461ff #e295ae #60d6a7
#e2984e #4dcbf5 #7189f7 #d65c89 #ff9561 #d4e295 #6c60d6
#4ee24e #cb4df5 #f771cc #c6d65c #7cff61 #95e2ca #d6608f
"""
PALETTE = COLOURS.split()
"""The colours of states in Lichtblick 1.28, and in the last open Foxglove Studio: a state has that of its
number modulo 28, whatever it is called."""


def hue_and_chroma(standing: int) -> tuple[float, float]:
    colour = PALETTE[standing % len(PALETTE)]
    red, green, blue = (int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return 360 * colorsys.rgb_to_hls(red, green, blue)[0], max(red, green, blue) - min(red, green, blue)


def test_viewers_draw_what_holds_in_blue_what_is_violated_in_vermillion_and_the_rest_pale() -> None:
    assert len(PALETTE) == 28
    assert [number % 28 for number in (SATISFIED, HOLDS_SO_FAR, PENDING, VIOLATED)] == [0, 4, 5, 1]
    assert len({number % 28 for number in Standing.values() if number}) == 5
    hues = {number: hue_and_chroma(number)[0] for number in Standing.values() if number}
    assert 195 < hues[HOLDS_SO_FAR] < hues[SATISFIED] < 215
    assert hues[VIOLATED] < 20
    pale = max(hue_and_chroma(number)[1] for number in (PENDING, UNKNOWN))
    assert pale < 0.75 * min(hue_and_chroma(number)[1] for number in (SATISFIED, HOLDS_SO_FAR, VIOLATED))


def annotated(folder: Path, text: str, samples: list[sr.Sample]) -> Path:
    output = folder / "annotated.mcap"
    run_replay(MemorySource.from_samples(samples), [sr.parse_specification(text)], output=output)
    return output


def messages(log: Path, kind: type[Message], topic: str) -> list[tuple[int, Message]]:
    with log.open("rb") as stream:
        return [
            (message.log_time, kind.FromString(message.data))
            for _, _, message in make_reader(stream).iter_messages([topic])
        ]


def moving(places: list[float], step_ns: int = STEP_NS) -> list[sr.Sample]:
    return [
        sr.Sample(
            index * step_ns,
            {"a": sr.Footprint.box(0, 0, 1, 1), "b": sr.Footprint.box(x, 0, x + 1, 1)},
        )
        for index, x in enumerate(places)
    ]


TEXT = "spec met = F a closeto[1] b\nspec apart = G a farfrom[1] b\nspec late = F[1s, 9s] a closeto[1] b"


def test_every_message_says_how_all_results_stand_and_the_last_what_the_log_comes_to(tmp_path: Path) -> None:
    log = annotated(tmp_path, TEXT, moving([5.0, 4.0, 1.5, 3.0]))
    found = [message for _, message in messages(log, StandingUpdate, "/spatial/standing")]
    assert [[each.standing for each in message.results] for message in found] == [
        [PENDING, HOLDS_SO_FAR, PENDING],
        [PENDING, HOLDS_SO_FAR, PENDING],
        [SATISFIED, VIOLATED, PENDING],
        [SATISFIED, VIOLATED, PENDING],
        [SATISFIED, VIOLATED, VIOLATED],
    ]
    assert [each.name for each in found[0].results] == ["met", "apart", "late"]
    assert [message.final for message in found] == [False] * 4 + [True]
    assert [message.worst for message in found] == ["met", "met", "apart", "apart", "apart"]
    states = [message.results[1].automaton for message in found]
    assert states[1].endswith("satisfied if nothing more came")
    assert states[2].endswith("permanently violated")
    assert found[0].results[0].automaton.endswith("still to come: a closeto[1] b")


def test_a_set_of_states_is_described_by_all_that_it_may_be(tmp_path: Path) -> None:
    """Before an object is first seen, an invariant may hold or be violated permanently."""
    samples = moving([5.0, 4.0, 1.5])
    samples[:2] = [replace(each, objects={"a": each.objects["a"]}) for each in samples[:2]]
    log = annotated(tmp_path, "spec away = G (a dist b >= 0.5)\nspec met = F (a dist b <= 1)", samples)
    found = [message for _, message in messages(log, StandingUpdate, "/spatial/standing")]
    away, met = ([message.results[index].automaton for message in found] for index in (0, 1))
    assert away[0].startswith("one of the states 0, 1: either ")
    assert set(away[0].partition("either ")[2].split("; or ")) == {
        "satisfied if nothing more came",
        "permanently violated",
    }
    assert set(met[0].partition("either ")[2].split("; or ")) == {
        "permanently satisfied",
        "not satisfied yet",
    }


def test_standing_has_the_worst_result_first(tmp_path: Path) -> None:
    text = """
        spec never = F (a dist b <= 0.5)
        spec goes_on = F G (a dist b >= 1.5)
        spec unseen = G (a dist c >= 1)
        spec last = G (a dist b >= 2)
        spec early = G (a dist b >= 3.5)
        spec met = F (a dist b <= 2)
        spec later = F (a dist b <= 0.25)
    """
    log = annotated(tmp_path, text, moving([5.0, 4.5, 4.0, 2.0]))
    found = [message for _, message in messages(log, StandingUpdate, "/spatial/standing")]
    assert [each.worst for each in found] == ["never", "never", "early", "early", "early"]
    assert [each.name for each in found[-1].violated] == ["early", "last", "never", "goes_on", "later"]


def test_messages_say_since_when_by_how_much_and_over_what_results_are_violated(tmp_path: Path) -> None:
    log = annotated(tmp_path, TEXT, moving([5.0, 4.0, 1.5, 1.25, 3.0]))
    found = [message for _, message in messages(log, StandingUpdate, "/spatial/standing")]
    rows = [
        [(each.name, each.since, each.by, each.at, each.over) for each in message.violated]
        for message in found
    ]
    nothing = ("nothing is violated", 0.0, 0.0, 0.0, "")
    assert rows[:-1] == [
        [nothing],
        [nothing],
        [("apart", 0.2, 0.5, 0.2, "a farfrom[1] b")],
        [("apart", 0.2, 0.75, 0.3, "a farfrom[1] b")],
        [("apart", 0.2, 0.75, 0.3, "a farfrom[1] b")],
    ]
    # the log has ended before the window of the other one began
    apart, late = rows[-1]
    assert apart == rows[-2][0]
    assert (late[0], math.isnan(late[2])) == ("late", True)


def test_the_last_message_on_robustness_has_the_verdict_of_the_finished_log(tmp_path: Path) -> None:
    log = annotated(
        tmp_path, "spec met = F a closeto[1] b\nspec apart = G a farfrom[1] b", moving([5.0, 4.0])
    )
    found = messages(log, Robustness, "/spatial/robustness")
    finals = [(time_ns, message) for time_ns, message in found if message.final]
    assert finals == found[-2:]
    for time_ns, message in finals:
        root = message.nodes[0]
        assert time_ns == message.time_ns == STEP_NS
        assert root.lower == root.upper == root.value
    assert [message.nodes[0].standing for _, message in finals] == [VIOLATED, SATISFIED]


def test_a_fast_log_has_no_topic_for_viewers_above_60_hz(tmp_path: Path) -> None:
    log = annotated(tmp_path, "spec apart = G a farfrom[1] b", moving([5.0] * 400, step_ns=10**6))
    for topic, kind in (("/spatial/standing", StandingUpdate), ("/spatial/scene", Message)):
        with log.open("rb") as stream:
            times = [each.log_time for _, _, each in make_reader(stream).iter_messages([topic])]
        assert len(times) <= 60 * 0.4, (topic, kind)


@given(st.floats(1e-15, 1e15, exclude_max=True), st.sampled_from([1.0, -1.0]))
@example(1e3, 1.0)
@example(float(np.nextafter(1e-3, 0.0)), 1.0)
@example(float(np.nextafter(1e12, 0.0)), -1.0)
def test_numbers_of_tables_have_four_digits(size: float, sign: float) -> None:
    [shown] = round_numbers(np.array([sign * size])).tolist()
    # halves may go either way
    assert abs(shown - sign * size) <= 0.5001 * 10.0 ** (np.floor(np.log10(size)) - 3)
    assert shown == float(f"{shown:.4g}")


def test_what_is_no_usual_number_stays_in_tables() -> None:
    numbers = [np.inf, -np.inf, 0.0, 3e200, 1e-300]
    assert round_numbers(np.array(numbers)).tolist() == numbers
    assert np.isnan(round_numbers(np.array([np.nan]))).all()

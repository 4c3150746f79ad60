"""How a fast playback is thinned to what viewers can take."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay.logs.messages import Channel, Messages, messages_of
from spatial_replay.logs.topics import EVENTS, OBJECTS, ROBUSTNESS, SCENE, STANDING
from spatial_replay.serve.player import MOST_A_SECOND, MOST_DRAWN_A_SECOND, MOST_LATE_S, PlaybackThinning

CHANNELS = {
    number: Channel(topic, "protobuf", None) for number, topic in enumerate((EVENTS, ROBUSTNESS, OBJECTS))
}


def messages(times: list[tuple[int, int]]) -> Messages:
    times_ns = np.array([time_ns for time_ns, _ in times], np.int64)
    return Messages(
        channels=CHANNELS,
        channel=np.array([number for _, number in times], np.int64),
        sequence=np.arange(len(times)),
        log_time_ns=times_ns,
        publish_time_ns=times_ns,
        payloads=[bytes([index % 256]) for index in range(len(times))],
    )


def thin(whole: Messages, most: int) -> Messages:
    """Thin the messages of a turn in which so many samples of a topic may be sent."""
    return PlaybackThinning().thin(whole, (most - 0.5) / MOST_A_SECOND)


def kept(of: Messages) -> list[tuple[int, int, bytes]]:
    return list(zip(of.log_time_ns.tolist(), of.channel.tolist(), of.payloads, strict=True))


TIMES = st.lists(st.tuples(st.integers(0, 60), st.sampled_from([0, 1, 1, 2]))).map(sorted)


@given(TIMES, st.integers(1, 20))
def test_each_topic_keeps_at_most_so_many_times_and_its_last(times: list[tuple[int, int]], most: int) -> None:
    whole = messages(times)
    sent = kept(thin(whole, most))
    assert [each for each in kept(whole) if each in sent] == sent
    for number, channel in CHANNELS.items():
        before = [time_ns for time_ns, own in times if own == number]
        after = [time_ns for time_ns, own, _ in sent if own == number]
        count = len(set(before))
        is_whole = channel.topic == EVENTS or count <= most + 1
        assert len(set(after)) == (count if is_whole else most)
        assert before[-1:] == after[-1:]
        assert all(Counter(after)[time_ns] == Counter(before)[time_ns] for time_ns in after)


def test_the_times_that_stay_are_spread_evenly() -> None:
    sent = thin(messages([(time_ns, 1) for time_ns in range(100)]), 5)
    assert set(np.diff(sent.log_time_ns).tolist()) <= {19, 20}


def on_topic(topic: str, times_ns: list[int], payloads: list[bytes] | None = None) -> Messages:
    return messages_of(
        Channel(topic, "protobuf", None), np.array(times_ns, np.int64), payloads or [b""] * len(times_ns), 0
    )


TURNS = st.lists(st.floats(0.025, MOST_LATE_S), min_size=10, max_size=60)


@pytest.mark.parametrize("speed", [1, 4, 20, 100])
@given(TURNS, st.sampled_from([5, 20, 50]))
def test_a_topic_that_is_drawn_has_less_than_60_messages_in_any_second(
    speed: int, turns: list[float], rate: int
) -> None:
    thinning = PlaybackThinning()
    ends_s = np.cumsum(turns)
    step_ns = 10**9 // rate
    counts, until_ns = [], 0
    for end_s, elapsed_s in zip(ends_s, turns, strict=True):
        end_ns = round(end_s * speed * 1e9)
        coming = list(range(-(-until_ns // step_ns) * step_ns, end_ns, step_ns))
        until_ns = end_ns
        sent = thinning.thin(on_topic(STANDING, coming), elapsed_s).log_time_ns.tolist()
        assert sent[-1:] == coming[-1:]
        if speed * rate <= MOST_DRAWN_A_SECOND:
            assert sent == coming
        counts.append(len(sent))
    for first, start_s in enumerate(ends_s):
        within = (ends_s >= start_s) & (ends_s < start_s + 1)
        assert sum(np.array(counts)[within]) < 60, f"from turn {first}"


def test_what_a_scene_that_is_left_out_deletes_is_deleted_by_the_next_one() -> None:
    scenes = []
    for number in range(100):
        scene = SceneUpdate()
        scene.entities.add(id=f"object/{number}")
        scene.deletions.add(id=f"object/{number - 1}", type=SceneEntityDeletion.MATCHING_ID)
        scenes.append(scene.SerializeToString())
    sent = PlaybackThinning().thin(on_topic(SCENE, list(range(100)), scenes), 0.1)
    decoded = [SceneUpdate.FromString(payload) for payload in sent.payloads]
    assert len(decoded) < 10
    assert [each.id for scene in decoded for each in scene.deletions] == [
        f"object/{n - 1}" for n in range(100)
    ]
    assert [scene.entities[0].id for scene in decoded] == [f"object/{n}" for n in sent.log_time_ns]

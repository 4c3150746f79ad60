"""How a fast playback is thinned to what viewers can take."""

from __future__ import annotations

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay.logs import Channel, Messages
from spatial_replay.logs.topics import EVENTS, ROBUSTNESS, SCENE
from spatial_replay.serve.player import thin

CHANNELS = {
    number: Channel(topic, "protobuf", None) for number, topic in enumerate((EVENTS, ROBUSTNESS, SCENE))
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

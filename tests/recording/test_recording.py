"""A recording in memory: what is written when."""

from __future__ import annotations

import pytest

from replay.runs import SPECIFICATION, run
from spatial_replay import TraceError, parse_specification
from spatial_replay.logs.messages import MemorySink
from spatial_replay.logs.topics import ENDING
from spatial_replay.recording.log import Recording, RunEnd


def test_metadata_comes_before_the_samples() -> None:
    sink = MemorySink()
    Recording(sink, [parse_specification(SPECIFICATION)], {"seed": "7"})
    assert [name for name, _ in sink.metadata] == ["spatial_replay", "spatial_replay_automata"]
    assert sink.metadata[0][1]["seed"] == "7"
    assert sink.attachments[0].name == "recorded/text.spatial"
    assert all(each.name.startswith("automata/recorded/") for each in sink.attachments[1:])
    assert sink.messages == []


def test_messages_do_not_depend_on_how_samples_are_split() -> None:
    sinks = [MemorySink() for _ in range(2)]
    for sink, size in zip(sinks, (1, 100), strict=True):
        recording = Recording(sink, [parse_specification(SPECIFICATION)])
        for begin in range(0, 12, size):
            recording.add(run().slice(begin, begin + size))
        recording.end()
        assert len(recording) == 12
    payloads = [[payload for block in sink.messages for payload in block.payloads] for sink in sinks]
    assert payloads[0] == payloads[1]
    assert sinks[0].metadata == sinks[1].metadata


def test_the_end_counts_the_samples() -> None:
    sink = MemorySink()
    recording = Recording(sink)
    recording.add(run())
    recording.end(RunEnd(interrupted=True, dropped=3))
    assert sink.metadata[-2] == (ENDING, {"samples": "12", "dropped": "3", "interrupted": "true"})


def test_times_of_samples_increase() -> None:
    recording = Recording(MemorySink(), [parse_specification(SPECIFICATION)])
    recording.add(run())
    with pytest.raises(TraceError, match="order of their times"):
        recording.add(run())

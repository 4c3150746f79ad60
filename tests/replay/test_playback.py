"""A log played from any time on is the annotated log."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from annotate.layouts import panels, paths_of
from annotate.message_paths import values
from examples import examples
from replay.runs import STEP_NS, PiecewiseSource, content_of, record, run, sample
from spatial_replay.annotate.robustness import CURVES_CHANNEL
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Block, Channel, Messages, merge, messages_of
from spatial_replay.logs.objects import encode_objects
from spatial_replay.logs.output_file import open_output
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import (
    CURVES_TOPIC,
    EVENT_LOG,
    EVENTS,
    OBJECTS,
    RECENT_EVENTS,
    ROBUSTNESS,
    SCENE,
    SPECIFICATION,
    STANDING,
    protobuf_channel,
)
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.loaded_log import LoadedLog, Playback
from spatial_replay.replay.selection import ReplayOptions, Window
from spatial_replay.sources import open_source

ROOT = Path(__file__).parents[2]
TEXT = """\
const far = 0.5
region goal = box(4, -1, 9, 2)
spec reach = F (cube enclosedin goal)
spec apart = G (cube dist "cup 物" >= far)
"""
COUNT = 24
Sent = tuple[str, int, bytes]


def specification() -> sr.Specification:
    return sr.parse_specification(TEXT, filename="blocks.spatial")


def playback(source: Source | None = None, window: Window | None = None) -> Playback:
    source = source or PiecewiseSource(run(COUNT), 7)
    return Playback(LoadedLog(source, [specification()], ReplayOptions(window or Window())).evaluate())


def sent(messages: Messages) -> list[Sent]:
    topics = [messages.channels[number].topic for number in messages.channel.tolist()]
    return list(zip(topics, messages.log_time_ns.tolist(), messages.payloads, strict=True))


def annotated(source: Source, output: Path, window: Window | None = None) -> list[Sent]:
    """What a replay writes."""
    run_replay(source, [specification()], ReplayOptions(window or Window()), output=output)
    return [(topic, time_ns, data) for topic, time_ns, _, _, data in content_of(output).messages]


def played(of: Playback, from_ns: int, until: Sequence[int] = ()) -> list[Sent]:
    """All that is sent from a time on, in stretches up to some times and then to the end."""
    found = sent(of.seek(from_ns))
    for time_ns in (*sorted(until), of.end_ns):
        found += sent(of.advance_to(time_ns))
    return found


@cache
def whole() -> list[Sent]:
    with TemporaryDirectory() as folder:
        return annotated(PiecewiseSource(run(COUNT), 5), Path(folder) / "a.mcap")


TIMES = st.lists(st.integers(0, COUNT * STEP_NS), max_size=6)


@examples(25)
@given(TIMES)
def test_a_playback_from_the_start_is_the_annotated_log_however_it_is_split(until: list[int]) -> None:
    assert played(playback(), 0, until) == whole()


@examples(25)
@given(st.lists(st.integers(0, COUNT * STEP_NS), min_size=1, max_size=3), TIMES)
def test_a_playback_after_seeks_is_the_annotated_log_from_there_on(
    sought: list[int], until: list[int]
) -> None:
    player = playback()
    for time_ns in sought:
        player.seek(time_ns)
    from_ns = sought[-1]
    found = [each for each in played(player, from_ns, until) if each[1] > from_ns]
    expected = [each for each in whole() if each[1] > from_ns]
    # samples are so far apart that each is drawn
    assert found == expected


@examples(25)
@given(st.integers(0, 2 * COUNT * STEP_NS))
def test_a_seek_sends_the_latest_messages(time_ns: int) -> None:
    found = sent(playback().seek(time_ns))
    for topic in (OBJECTS, ROBUSTNESS):
        last_ns = max(each[1] for each in whole() if each[0] == topic and each[1] <= time_ns)
        newest = [each for each in whole() if each[0] == topic and each[1] == last_ns]
        assert [each for each in found if each[0] == topic] == newest
    [specified] = [data for topic, _, data in found if topic == SPECIFICATION]
    assert specified == next(data for topic, _, data in whole() if topic == SPECIFICATION)
    lines = [each for each in whole() if each[0] == "/spatial/log" and each[1] <= time_ns]
    assert [each for each in found if each[0] == "/spatial/log"] == lines


def test_a_seek_shows_the_last_outline_of_an_object_that_a_specification_misses() -> None:
    player = playback()
    player.seek(2 * STEP_NS)
    [drawn] = [data for topic, _, data in sent(player.seek(3 * STEP_NS)) if topic == SCENE]
    update = SceneUpdate.FromString(drawn)
    assert "cup 物" not in sample(3).objects
    [left] = [each for each in update.entities if each.id == "object/cup 物"]
    assert [each.text for each in left.texts] == ["cup 物, last seen"]
    assert [each.type for each in left.lines] == [LinePrimitive.LINE_LIST]
    [again] = [data for topic, _, data in sent(player.seek(3 * STEP_NS)) if topic == SCENE]
    assert again == drawn


@pytest.mark.parametrize("window", [Window(), Window(3 * STEP_NS, 17 * STEP_NS), Window(every=3)])
@pytest.mark.parametrize("is_recorded", [False, True])
def test_a_window_is_played_as_a_replay_writes_it(window: Window, is_recorded: bool, tmp_path: Path) -> None:
    source: Source = PiecewiseSource(run(COUNT), 7)
    if is_recorded:
        source = open_source(record(run(COUNT), tmp_path / "run.mcap"))
    expected = annotated(source, tmp_path / "annotated.mcap", window)
    player = playback(source, window)
    times_ns = np.arange(player.start_ns, player.end_ns, STEP_NS // 2).tolist()
    assert played(player, 0, times_ns) == expected


def apart(messages: list[tuple[str, int, bytes]]) -> list[tuple[str, int, bytes]]:
    """Messages by time, ours after others: in a file they have chunks of their own, in either order."""
    return sorted(messages, key=lambda message: (message[1], message[0].startswith("/spatial/")))


def test_external_messages_are_played_and_sent_again_after_a_seek(tmp_path: Path) -> None:
    source = open_source(ROOT / "recordings/push.mcap")
    file = sr.load_specification(ROOT / "recordings/push.spatial")
    run_replay(source, [file], output=tmp_path / "annotated.mcap")
    content = content_of(tmp_path / "annotated.mcap")
    whole = [(topic, time_ns, data) for topic, time_ns, _, _, data in content.messages]
    player = Playback(LoadedLog(source, [file]).evaluate())
    middle_ns = (player.start_ns + player.end_ns) // 2
    steps = range(player.start_ns, player.end_ns, 333_333_333)
    assert apart(played(player, 0, steps)) == apart(whole)
    found = sent(player.seek(middle_ns))
    others = {topic for topic in content.topics() if topic.startswith("/plan/")}
    assert others
    for topic in others:
        before = [each for each in whole if each[0] == topic and each[1] <= middle_ns]
        assert [each for each in found if each[0] == topic] == before[-1:]


@dataclass(frozen=True)
class SpokenSource(PiecewiseSource):
    """A trace whose blocks begin with a message of another program."""

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        channel = Channel("/words", "json", None)
        for block in super().iter_blocks(start_ns, end_ns):
            times_ns = block.trace.times_ns[:1]
            yield replace(block, messages=messages_of(channel, times_ns, [b"1"] * len(times_ns), 0))


def test_a_playback_of_several_blocks_from_time_0_has_all_samples(tmp_path: Path) -> None:
    source = SpokenSource(run(COUNT), 5)
    expected = annotated(source, tmp_path / "annotated.mcap")
    assert apart(played(playback(source), 0)) == apart(expected)


def talking(path: Path) -> Path:
    """A log in which others speak before its first sample, at 1 s, and after its last one."""
    trace = run(COUNT).slice(4, COUNT)
    times_ns = np.array([0, STEP_NS, COUNT * STEP_NS])
    words = messages_of(Channel("/words", "json", None), times_ns, [b"1", b"2", b"3"], 0)
    objects = messages_of(protobuf_channel(OBJECTS, ObjectStates), trace.times_ns, encode_objects(trace), 0)
    with open_output(path) as stream:
        writer = LogWriter(stream)
        writer.write_messages(merge([words, objects]))
        writer.close()
    return path


def test_a_playback_starts_at_the_first_sample_with_the_messages_before_it(tmp_path: Path) -> None:
    source = open_source(talking(tmp_path / "talking.mcap"))
    expected = annotated(source, tmp_path / "annotated.mcap")
    player = playback(source)
    assert player.start_ns == 4 * STEP_NS
    found = sent(player.seek(0))
    assert [data for topic, _, data in found if topic == "/words"] == [b"2"]
    assert {SPECIFICATION, OBJECTS, ROBUSTNESS, SCENE} <= {topic for topic, *_ in found}
    found += sent(player.advance_to(player.end_ns))
    assert apart(found[1:]) == apart([each for each in expected if each[1] >= player.start_ns])


def test_the_end_of_the_log_comes_last_and_once(tmp_path: Path) -> None:
    source = open_source(talking(tmp_path / "talking.mcap"))
    expected = apart(annotated(source, tmp_path / "annotated.mcap"))
    ended = (EVENTS, EVENT_LOG, RECENT_EVENTS, ROBUSTNESS, ROBUSTNESS, SCENE, STANDING)
    count = len(ended)
    assert [(topic, time_ns) for topic, time_ns, _ in expected[-count - 1 :]] == [
        (topic, COUNT * STEP_NS) for topic in ("/words", *ended)
    ]
    player = playback(source)
    assert sent(player.seek(player.end_ns))[-count:] == expected[-count:]
    assert not len(player.advance_to(player.end_ns))


def test_another_evaluation_is_shown_at_the_present_time() -> None:
    player = playback()
    player.seek(5 * STEP_NS)
    player.evaluated = player.evaluated.loaded.evaluate({"far": 2.0})
    fresh = Playback(player.evaluated)
    assert sent(player.seek(player.time_ns)) == sent(fresh.seek(5 * STEP_NS))


@examples(25)
@given(st.lists(st.integers(-STEP_NS, 2 * COUNT * STEP_NS), min_size=2, max_size=6))
def test_a_playback_stays_within_the_log_and_never_goes_back(times_ns: list[int]) -> None:
    player = playback()
    places = []
    for time_ns in times_ns:
        player.advance_to(time_ns)
        places.append(player.time_ns)
    assert all(first <= second for first, second in pairwise(places))
    assert places[-1] <= player.end_ns == (COUNT - 1) * STEP_NS


@pytest.mark.parametrize("name", ["table.jsonl", "push.mcap"])
def test_every_path_of_the_layout_is_in_the_messages(name: str, tmp_path: Path) -> None:
    log = ROOT / "recordings" / name
    file = sr.load_specification(log.with_suffix(".spatial"))
    evaluated = LoadedLog(open_source(log), [file]).evaluate()
    player = Playback(evaluated)
    output = tmp_path / "sent.mcap"
    with open_output(output) as stream:
        writer = LogWriter(stream)
        writer.write_messages(messages_of(CURVES_CHANNEL, np.array([player.start_ns]), [evaluated.curves], 0))
        writer.write_messages(player.seek(player.start_ns))
        writer.write_messages(player.advance_to(player.end_ns))
        writer.close()
    layout = json.loads(evaluated.layout.data)
    assert panels(layout) == set(layout["configById"])
    assert {"Plot!whole", "Parameters!constants"} <= set(layout["configById"])
    tabs = layout["configById"]["Tab!details"]
    is_planned = tabs["tabs"][tabs["activeTabIdx"]]["layout"] == "RawMessages!decision"
    assert is_planned == (name == "push.mcap")
    paths = paths_of(layout["configById"])
    assert any(path.startswith(CURVES_TOPIC) for path in paths)
    for path in paths:
        assert values(output, path), path

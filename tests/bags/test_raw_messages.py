"""Raw messages of logs by other software: all that a copy needs, byte for byte."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Reader as Reader1

from bags.bag_files import (
    MAPPING,
    POINT,
    ROS1,
    ROS2,
    SECOND,
    START_NS,
    TEXT,
    Sent,
    drive,
    text,
    write_ros1,
    write_ros2,
)
from spatial_replay import read_trace
from spatial_replay.bags.open import open_messages
from spatial_replay.mapping.mapped_source import MappedSource
from spatial_replay.sources import open_source

BAGS = ("apriltags_table.bag", "two_turtles.bag", "two_turtles_lz4.bag", "pose_db3", "talker_mcap")
BAGS += ("talker_sqlite3", "two_turtles_mcap", "two_turtles_sqlite3")

Written = Counter[tuple[str, int, bytes]]


@pytest.fixture
def mapping(tmp_path: Path) -> Path:
    path = tmp_path / "drive.yaml"
    path.write_text(MAPPING)
    return path


def kept_by(log: Path, mapping: Path, *keep: str) -> Written:
    source = open_source(log, mapping=mapping)
    assert isinstance(source, MappedSource)
    found: Written = Counter()
    for block in replace(source, keep=keep).iter_blocks():
        messages = block.messages
        topics = [messages.channels[number].topic for number in messages.channel.tolist()]
        found.update(zip(topics, messages.log_time_ns.tolist(), messages.payloads, strict=True))
    return found


def read_by_others(log: Path) -> Written:
    """Read a log with the libraries of its container alone."""
    for file in log.glob("*.mcap"):
        with file.open("rb") as stream:
            read = make_reader(stream).iter_messages()
            return Counter((channel.topic, each.log_time, each.data) for _, channel, each in read)
    for file in log.glob("*.db3"):
        with closing(sqlite3.connect(file)) as database:
            query = "SELECT name, timestamp, data FROM messages JOIN topics ON topic_id = topics.id"
            return Counter(database.execute(query).fetchall())
    with Reader1(log) as reader:
        return Counter((each.topic, time_ns, bytes(data)) for each, time_ns, data in reader.messages())


def written(sent: Sequence[Sent], *, as_ros1: bool) -> Written:
    serialize = ROS1.serialize_ros1 if as_ros1 else ROS2.serialize_cdr
    return Counter((each.topic, each.time_ns, bytes(serialize(each.content, each.type))) for each in sent)


@pytest.mark.parametrize("name", BAGS)
def test_every_message_of_a_recording_comes_as_it_was_recorded(data_folder: Path, name: str) -> None:
    log = data_folder / "bags" / name
    reader = open_messages(log)
    topics = [topic.name for topic in reader.topics()]
    channels = reader.channels(topics)
    found: Written = Counter()
    for columns in reader.iter_columns(topics):
        assert [channels[number].topic for number in columns.channel.tolist()] == list(columns.topics)
        found.update(zip(columns.topics, columns.log_time_ns.tolist(), columns.payloads, strict=True))
    assert found == read_by_others(log)


@pytest.mark.parametrize("name", BAGS)
def test_channels_say_how_their_messages_are_decoded(data_folder: Path, name: str) -> None:
    reader = open_messages(data_folder / "bags" / name)
    channels = reader.channels([topic.name for topic in reader.topics()])
    encodings = ("ros1", "ros1msg") if name.endswith(".bag") else ("cdr", "ros2msg")
    for channel in channels.values():
        assert channel.schema is not None
        assert (channel.encoding, channel.schema.encoding) == encodings
        assert channel.schema.data.strip() and "/" in channel.schema.name


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3", "message"])
def test_a_source_keeps_all_messages_the_mapped_ones_or_those_of_patterns(
    tmp_path: Path, mapping: Path, kind: Any
) -> None:
    sent = [*drive(), Sent("/camera/left", TEXT, START_NS + 5 * SECOND, text("an image"))]
    if kind == "ros1":
        log = write_ros1(tmp_path / "a.bag", sent)
    elif kind == "message":
        log = write_ros2(tmp_path / "bag", sent, compression="message")
    else:
        log = write_ros2(tmp_path / "bag", sent, storage=kind)
    everything = written(sent, as_ros1=kind == "ros1")
    of = {topic: {each for each in everything if each[0] == topic} for topic, _, _ in everything}
    assert kept_by(log, mapping, "all") == everything
    assert kept_by(log, mapping, "mapped").keys() == of["/a"] | of["/b"]
    assert kept_by(log, mapping, "/camera/*").keys() == of["/camera/left"]
    assert kept_by(log, mapping, "mapped", "/w*").keys() == of["/a"] | of["/b"] | of["/words"]


def test_what_is_kept_changes_no_sample(tmp_path: Path, mapping: Path) -> None:
    sent = drive(300)
    # a topic whose clock jumps back is only copied, so it is no error
    sent.append(Sent("/old", TEXT, START_NS + 20 * SECOND, text("late")))
    sent.append(Sent("/old", TEXT, START_NS, text("early")))
    log = write_ros1(tmp_path / "a.bag", sent)
    source = open_source(log, mapping=mapping)
    assert isinstance(source, MappedSource)
    traces = [block.trace for block in replace(source, keep=("all",)).iter_blocks()]
    assert type(traces[0]).concatenate(traces) == read_trace(log, mapping=mapping)
    assert kept_by(log, mapping, "all") == read_by_others(log)


def test_messages_of_two_definitions_on_one_topic_keep_their_own(tmp_path: Path, mapping: Path) -> None:
    """They cannot be mapped, since either may be meant; a copy has both."""
    log = tmp_path / "mixed.mcap"
    with log.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("", "test")
        numbers = [writer.register_channel(topic, "json", 0) for topic in ("/a", "/b")]
        mixed = [
            writer.register_channel("/mixed", "json", writer.register_schema(name, "jsonschema", b"{}"))
            for name in ("One", "Other")
        ]
        for index in range(10):
            time_ns = START_NS + index * SECOND
            for number in numbers:
                writer.add_message(number, time_ns, json.dumps({"x": index, "y": 0}).encode(), time_ns)
            writer.add_message(mixed[index % 2], time_ns, b"{}", time_ns - 1, sequence=index)
        writer.add_attachment(time_ns, time_ns, "notes.txt", "text/plain", b"windy")
        writer.add_metadata("robot", {"name": "Ada"})
        writer.finish()
    source = open_source(log, mapping=mapping)
    assert isinstance(source, MappedSource)
    names = []
    for block in replace(source, keep=("/mixed",)).iter_blocks():
        for number in block.messages.channel.tolist():
            schema = block.messages.channels[number].schema
            names.append(schema.name if schema else None)
        assert (block.messages.publish_time_ns == block.messages.log_time_ns - 1).all()
    assert names == ["One", "Other"] * 5
    assert [(each.name, each.data) for each in source.attachments()] == [("notes.txt", b"windy")]
    assert source.metadata() == (("robot", {"name": "Ada"}),)


def test_channels_of_another_log_stay_as_they_are_declared(data_folder: Path) -> None:
    log = data_folder / "osi" / "osi_centerline_example.mcap"
    reader = open_messages(log)
    ours = reader.channels([topic.name for topic in reader.topics()]).values()
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        theirs = [(each, summary.schemas.get(each.schema_id)) for each in summary.channels.values()]
    assert sorted((each.topic, each.encoding, dict(each.metadata)) for each in ours) == sorted(
        (channel.topic, channel.message_encoding, dict(channel.metadata)) for channel, _ in theirs
    )
    assert {each.schema.data for each in ours if each.schema} == {
        schema.data for _, schema in theirs if schema
    }


def test_a_type_that_the_log_does_not_define_keeps_its_name(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", drive(2), storage="sqlite3")
    database = sqlite3.connect(next(folder.glob("*.db3")))
    database.execute("DELETE FROM message_definitions")
    database.execute("UPDATE topics SET type = 'arm_msgs/msg/Grip' WHERE name = '/words'")
    database.commit()
    database.close()
    channels = {each.topic: each for each in open_messages(folder).channels(["/a", "/words"]).values()}
    standard, unknown = channels["/a"].schema, channels["/words"].schema
    assert standard is not None and unknown is not None
    assert (standard.name, standard.encoding) == (POINT, "ros2msg") and b"float64 x" in standard.data
    assert (unknown.name, unknown.encoding, unknown.data) == ("arm_msgs/msg/Grip", "", b"")

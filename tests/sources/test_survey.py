"""Surveys of external logs: what they report, and how much they decode."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from mcap.writer import Writer

from spatial_replay.bags.reader import MessageReader
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.sources import messages_in, survey

Write = Callable[[dict[str, Sequence[object]]], MessageReader]


@pytest.fixture
def log(tmp_path: Path) -> Write:
    """Write a log of JSON messages, a millisecond apart on each topic."""

    def write(topics: dict[str, Sequence[object]]) -> MessageReader:
        path = tmp_path / "run.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema("any.Thing", "jsonschema", b'{"type": "object"}')
            for topic, messages in topics.items():
                channel = writer.register_channel(topic, "json", schema)
                for number, each in enumerate(messages):
                    data = json.dumps(each).encode()
                    writer.add_message(channel, number * 10**6, data, number * 10**6)
            writer.finish()
        reader = messages_in(path)
        assert reader is not None
        return reader

    return write


TAG = {"id": 1, "position": {"x": 0.5, "y": 1.5}}


def test_topics_are_counted_and_timed(log: Write) -> None:
    found = survey(log({"/a": [{"x": 1.0, "y": 2.0}] * 30, "/b": [{"text": "hello"}] * 5}))
    assert (found.kind, found.messages, found.start_ns, found.end_ns) == ("MCAP", 35, 0, 29 * 10**6)
    assert [(each.topic.name, each.messages, bool(each.entry)) for each in found.topics] == [
        ("/a", 30, True),
        ("/b", 5, False),
    ]
    assert found.faults == found.remarks == ()


@pytest.mark.parametrize("whole", [True, False])
def test_objects_that_appear_later_are_listed(log: Write, whole: bool) -> None:
    found = survey(log({"/tags": [{"tags": []}] * 300 + [{"tags": [TAG]}] * 800}), whole=whole)
    (topic,) = parse_mapping(found.mapping).topics
    assert (topic.objects, topic.name) == ("tags[*]", "tag{id}")


def test_a_suggestion_needs_no_more_than_a_start(log: Write) -> None:
    seen: list[int] = []
    reader = log({"/a": [{"x": 1.0, "y": 2.0}] * 30_000, "/b": [{"x": 1.0, "y": 2.0}] * 3})
    found = survey(reader, seen.append, whole=False)
    assert found.messages < 2000
    assert len(parse_mapping(found.mapping).topics) == 2
    assert sum(seen) == 0
    assert survey(reader, seen.append).messages == 30_003
    assert sum(seen) == 30_000


def test_large_messages_are_looked_at_once(log: Write) -> None:
    picture = {"data": "0" * 3_000_000}
    found = survey(log({"/camera": [picture] * 10, "/pose": [{"x": 1.0, "y": 2.0}]}))
    assert [each.topic for each in parse_mapping(found.mapping).topics] == ["/pose"]


def test_messages_that_cannot_be_decoded_are_remarks(log: Write) -> None:
    found = survey(log({"/a": [{"x": 1.0, "y": 2.0}], "/list": [[1, 2]]}))
    assert [each.messages for each in found.topics] == [1, 1]
    assert all("'/list'" in remark for remark in found.remarks)


def test_a_later_message_that_cannot_be_decoded_is_remarked_once(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("any.Thing", "jsonschema", b"{}")
        channel = writer.register_channel("/a", "json", schema)
        broken = writer.register_channel("/b", "wire", schema)
        for number, data in enumerate([b"{}", b"{", b"{}", b"["]):
            writer.add_message(channel, number, data, number)
            writer.add_message(broken, number, data, number)
        writer.finish()
    reader = messages_in(path)
    assert reader is not None
    found = [remark for remark in survey(reader).remarks if "/a" in remark]
    assert len(found) == 1
    assert "(2 of 4 messages looked at)" in found[0]
    assert ", at 0.000 s (" in found[0]
    assert all(remark.count("topic '/b': ") <= 1 for remark in survey(reader).remarks)


def test_logs_that_name_their_objects_need_no_survey(tmp_path: Path) -> None:
    tracks = tmp_path / "run.jsonl"
    tracks.write_text('{"time_ns": 0}\n')
    assert messages_in(tracks) is None
    assert messages_in(tmp_path) is None

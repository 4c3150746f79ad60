"""`recover`: all that can be read of a damaged log is saved, and what is missing is listed."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

import spatial_replay as sr
from bags.bag_files import drive, write_json_mcap, write_ros1, write_ros2
from replay.runs import content_of
from spatial_replay.bags.open import open_messages
from spatial_replay.cli.application import application


def call(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(application, [str(each) for each in arguments], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return int(result.return_value), result.output


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A recording of 12 s, whose chunks hold a second each."""
    lines = []
    for n in range(120):
        square = [[x + 0.1 * n, y] for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
        plate = {"name": "plate", "polygon": [[3, 0], [4, 0], [4, 1]]}
        lines.append({"time_ns": n * 10**8, "objects": [{"name": "cup", "polygon": square}, plate]})
    (tmp_path / "run.jsonl").write_text("\n".join(map(json.dumps, lines)))
    (tmp_path / "s.spatial").write_text("spec over = F (cup ovlp plate)")
    call(
        "record",
        "tracks",
        tmp_path / "run.jsonl",
        "--spec",
        tmp_path / "s.spatial",
        "-o",
        tmp_path / "run.mcap",
    )
    return tmp_path / "run.mcap"


def messages_of(path: Path) -> list[Any]:
    reader = open_messages(path)
    return list(reader.iter_messages({topic.name for topic in reader.topics()}))


def metadata_of(path: Path) -> dict[str, dict[str, str]]:
    return {name: dict(data) for name, data in content_of(path).metadata}


def without_chunk(path: Path, number: int, output: Path) -> Path:
    """A copy of a log in which one chunk does not decompress."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    data = bytearray(path.read_bytes())
    samples = [each for each in summary.chunk_indexes if 1 in each.message_index_offsets]
    data[samples[number].chunk_start_offset + 200] ^= 0xFF
    output.write_bytes(data)
    return output


def test_what_a_broken_chunk_takes_is_listed_by_time_sample_and_topic(recorded: Path, tmp_path: Path) -> None:
    broken = without_chunk(recorded, 4, tmp_path / "broken.mcap")
    code, said = call("recover", broken, "-o", tmp_path / "saved.mcap")
    assert code == 3
    assert "10 samples among them" in said
    assert "  time     4.000 s to 4.900 s" in said
    assert "  samples  40 to 49, after 3.900 s and before 5.000 s" in said
    assert "  topic    /spatial/objects: 10 of 120 messages" in said
    record = metadata_of(tmp_path / "saved.mcap")["spatial_replay_recovery"]
    assert record["source"] == "broken.mcap"
    assert json.loads(record["samples"]) == [[40, 49]]
    assert json.loads(record["spans_ns"]) == [[4 * 10**9, 49 * 10**8]]
    assert json.loads(record["messages"])["/spatial/objects"] == 10
    whole, saved = sr.read_trace(recorded), sr.read_trace(tmp_path / "saved.mcap")
    assert saved == whole.take([*range(40), *range(50, 120)])


def test_a_recovered_log_has_an_index_and_is_recovered_to_the_same_bytes(
    recorded: Path, tmp_path: Path
) -> None:
    (tmp_path / "cut.mcap").write_bytes(recorded.read_bytes()[:20_000])
    assert call("recover", tmp_path / "cut.mcap", "-o", tmp_path / "saved.mcap")[0] == 3
    with (tmp_path / "saved.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert len(list(reader.iter_messages())) == summary.statistics.message_count
    code, said = call("recover", tmp_path / "saved.mcap", "-o", tmp_path / "again.mcap")
    assert code == 0
    assert "nothing is missing" in said
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "saved.mcap").read_bytes()


def test_every_message_attachment_and_metadata_record_of_a_whole_log_is_copied(
    recorded: Path, tmp_path: Path
) -> None:
    code, said = call("recover", recorded, "-o", tmp_path / "saved.mcap")
    assert code == 0
    assert "nothing is missing" in said
    assert messages_of(tmp_path / "saved.mcap") == messages_of(recorded)
    assert metadata_of(tmp_path / "saved.mcap") == metadata_of(recorded)
    assert content_of(tmp_path / "saved.mcap").attachments == content_of(recorded).attachments
    assert call("verify", tmp_path / "saved.mcap")[0] == 0


def test_what_is_recovered_of_any_damage_is_of_the_undamaged_log_and_the_rest_is_counted(
    recorded: Path, tmp_path: Path
) -> None:
    chance, whole = random.Random(7), messages_of(recorded)
    data = recorded.read_bytes()
    for _ in range(25):
        damaged = bytearray(data[: chance.choice([len(data), chance.randrange(20_000, len(data))])])
        damaged[chance.randrange(8, len(damaged))] ^= 1 << chance.randrange(8)
        (tmp_path / "broken.mcap").write_bytes(damaged)
        code, said = call("recover", tmp_path / "broken.mcap", "-o", tmp_path / "saved.mcap")
        saved = messages_of(tmp_path / "saved.mcap")
        there = iter(whole)
        assert all(each in there for each in saved), "a message that was not there, or in another order"
        assert code == 3 or saved == whole, said


def test_what_reads_a_recovered_log_warns_of_what_is_missing(recorded: Path, tmp_path: Path) -> None:
    broken = without_chunk(recorded, 4, tmp_path / "broken.mcap")
    call("recover", broken, "-o", tmp_path / "saved.mcap")
    call("replay", tmp_path / "saved.mcap", "-o", tmp_path / "annotated.mcap")
    for arguments in (["replay"], ["info"], ["explain"]):
        for name in ("saved.mcap", "annotated.mcap"):
            code, said = call(*arguments, tmp_path / name)
            assert code == 0
            assert "was recovered from broken.mcap: " in said


def test_a_log_with_a_damaged_beginning_is_recovered_by_its_name(recorded: Path, tmp_path: Path) -> None:
    (tmp_path / "headless.mcap").write_bytes(b"\0" * 8 + recorded.read_bytes()[8:])
    code, said = call("recover", tmp_path / "headless.mcap", "-o", tmp_path / "saved.mcap")
    assert code == 3
    assert "first bytes" in said
    assert sr.read_trace(tmp_path / "saved.mcap") == sr.read_trace(recorded)


def test_attachments_of_external_logs_keep_their_times(tmp_path: Path) -> None:
    with (tmp_path / "drive.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, 5, b"{}", 4, 9)
        writer.add_attachment(7, 8, "camera.yaml", "text/yaml", b"fx: 1")
        writer.finish()
    call("recover", tmp_path / "drive.mcap", "-o", tmp_path / "saved.mcap")
    with (tmp_path / "saved.mcap").open("rb") as stream:
        reader = make_reader(stream)
        (attachment,) = reader.iter_attachments()
        assert (attachment.create_time, attachment.log_time, attachment.data) == (7, 8, b"fx: 1")
        assert reader.get_header().profile == "ros2"


@pytest.mark.parametrize("kind", ["ros1", "ros2 mcap", "ros2 db3", "json"])
def test_bags_and_external_logs_become_an_indexed_log_with_the_same_messages(
    kind: str, tmp_path: Path
) -> None:
    sent = drive(40)
    match kind:
        case "ros1":
            path = write_ros1(tmp_path / "drive.bag", sent)
        case "ros2 mcap":
            path = write_ros2(tmp_path / "drive", sent)
        case "ros2 db3":
            path = write_ros2(tmp_path / "drive", sent, storage="sqlite3")
        case _:
            path = write_json_mcap(tmp_path / "drive.mcap", [(e.topic, e.time_ns, {"x": 1}) for e in sent])
    code, said = call("recover", path, "-o", tmp_path / "saved.mcap")
    assert code == 0, said
    assert messages_of(tmp_path / "saved.mcap") == messages_of(path)


def test_a_bag_that_breaks_off_is_saved_up_to_its_last_whole_message(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "drive.bag", drive(60), chunk_bytes=4_000)
    data, whole = path.read_bytes(), messages_of(path)
    ends = dict[int, int]()
    for number, message in enumerate(whole):
        ends[number] = data.index(message.payload, ends.get(number - 1, 0)) + len(message.payload)
    for size in range(len(data) * 6 // 10, len(data) * 6 // 10 + 600, 9):
        path.write_bytes(data[:size])
        reader = open_messages(path)
        messages = list(reader.iter_messages({topic.name for topic in reader.topics()}))
        assert messages == [whole[number] for number, end in ends.items() if end <= size], size
        assert len(reader.take_faults()) == 2, size
    code, said = call("recover", path, "-o", tmp_path / "saved.mcap")
    assert code == 3
    assert "the file breaks off in a chunk" in said
    assert messages_of(tmp_path / "saved.mcap") == messages_of(path)


@pytest.fixture
def uncompressed(tmp_path: Path) -> Path:
    """A log of 60 messages of different lengths in several uncompressed chunks."""
    with (tmp_path / "drive.mcap").open("wb") as stream:
        writer = Writer(stream, chunk_size=1_000, compression=CompressionType.NONE)
        writer.start("", "test")
        channels = [writer.register_channel(f"/{name}", "json", 0) for name in "ab"]
        for n in range(60):
            payload = json.dumps({"n": n, "rest": "x" * (n * 7 % 40)}).encode()
            writer.add_message(channels[n % 2], (n + 1) * 10**8, payload, (n + 1) * 10**8, n)
        writer.finish()
    return tmp_path / "drive.mcap"


def test_whole_messages_of_an_uncompressed_chunk_that_breaks_off_are_saved(
    uncompressed: Path, tmp_path: Path
) -> None:
    data, whole = uncompressed.read_bytes(), messages_of(uncompressed)
    ends = [data.index(each.payload) + len(each.payload) for each in whole]
    cut = tmp_path / "cut.mcap"
    for size in range(ends[0], len(data), 7):
        cut.write_bytes(data[:size])
        reader = open_messages(cut)
        messages = list(reader.iter_messages({topic.name for topic in reader.topics()}))
        assert messages == [each for each, end in zip(whole, ends, strict=True) if end <= size], size
        assert len(reader.take_faults()) == 1, size


@pytest.mark.parametrize(("behind", "lost"), [(0, "a record"), (5, "a head"), (40, "a payload")])
def test_a_chunk_that_breaks_off_is_reported_once(
    uncompressed: Path, tmp_path: Path, behind: int, lost: str
) -> None:
    data, last = uncompressed.read_bytes(), messages_of(uncompressed)[49].payload
    (tmp_path / "cut.mcap").write_bytes(data[: data.index(last) + len(last) + behind])
    code, said = call("recover", tmp_path / "cut.mcap", "-o", tmp_path / "saved.mcap")
    assert code == 3
    assert len(messages_of(tmp_path / "saved.mcap")) == 50
    assert said.count("the file breaks off") == 1, lost
    assert "after 4.900 s cannot be read" in said


def test_what_a_damaged_page_of_a_database_takes_is_listed_by_time(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", drive(600), storage="sqlite3")
    whole = messages_of(folder)
    path = next(folder.glob("*.db3"))
    data = bytearray(path.read_bytes())
    page = len(data) // 2 // 4096 * 4096
    data[page : page + 4096] = bytes(4096)
    path.write_bytes(data)
    code, said = call("recover", folder, "-o", tmp_path / "saved.mcap")
    assert code == 3
    saved = messages_of(tmp_path / "saved.mcap")
    lost = [each for each in whole if each not in saved]
    assert 5 < len(lost) < 100
    start_ns = whole[0].log_time_ns
    record = metadata_of(tmp_path / "saved.mcap")["spatial_replay_recovery"]
    ((first_ns, last_ns),) = json.loads(record["spans_ns"])
    assert first_ns < lost[0].log_time_ns and lost[-1].log_time_ns < last_ns
    assert last_ns - first_ns < 2 * (lost[-1].log_time_ns - lost[0].log_time_ns)
    assert f"  time     {(first_ns - start_ns) / 1e9:.3f} s to {(last_ns - start_ns) / 1e9:.3f} s" in said


def test_text_files_and_files_without_a_message_are_refused(tmp_path: Path) -> None:
    (tmp_path / "run.jsonl").write_text('{"time_ns": 0, "objects": []}\n')
    with pytest.raises(sr.UsageError, match="record tracks"):
        call("recover", tmp_path / "run.jsonl", "-o", tmp_path / "saved.mcap")
    (tmp_path / "empty.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(sr.LogError, match=r"nothing of empty[.]mcap can be recovered"):
        call("recover", tmp_path / "empty.mcap", "-o", tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()


def test_records_of_unknown_kinds_are_passed_over_in_our_own_logs(recorded: Path, tmp_path: Path) -> None:
    whole = recorded.read_bytes()
    head = 8 + 9 + int.from_bytes(whole[9:17], "little")
    data = whole[: int.from_bytes(whole[-28:-20], "little")]
    unknown = b"\x42" + (3).to_bytes(8, "little") + b"new"
    # without a summary, whose places would be wrong
    log = tmp_path / "new.mcap"
    log.write_bytes(data[:head] + unknown + data[head:] + whole[-37:-28] + bytes(20) + whole[-8:])
    assert call("verify", log)[0] == 0
    assert sr.read_trace(log) == sr.read_trace(recorded)
    assert "1 record" in sr.read_trace(log).remarks[0]
    assert call("recover", log, "-o", tmp_path / "again.mcap")[0] == 0
    assert sr.read_trace(tmp_path / "again.mcap") == sr.read_trace(recorded)

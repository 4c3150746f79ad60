"""Logs of messages as sources of samples, in every container."""

from __future__ import annotations

import random
import shutil
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Writer1

from bags.bag_files import (
    MAPPING,
    POINT,
    POSE,
    ROS1,
    ROS2,
    SECOND,
    START_NS,
    TEXT,
    Sent,
    drive,
    point,
    split_ros2,
    text,
    write_json_mcap,
    write_mcap,
    write_ros1,
    write_ros2,
)
from spatial_replay import Footprint, LogError, Trace, UsageError, read_trace
from spatial_replay.annotate.certificate import SampleHash
from spatial_replay.cli import run
from spatial_replay.logs.messages import Block
from spatial_replay.sources import open_source
from spatial_replay.trace.trace import within


@pytest.fixture
def mapping(tmp_path: Path) -> Path:
    path = tmp_path / "drive.yaml"
    path.write_text(MAPPING)
    return path


def hash_of(trace: Trace) -> str:
    samples = SampleHash()
    samples.add(trace)
    return samples.hexdigest()


def test_a_drive_is_the_same_in_every_container(tmp_path: Path, mapping: Path) -> None:
    sent = drive()
    parts = [
        write_ros2(tmp_path / f"part{index}", sent[begin : begin + 90]) for index, begin in enumerate((0, 90))
    ]
    logs = [
        write_ros1(tmp_path / "a.bag", sent),
        write_ros1(tmp_path / "b.bag", sent, compression="bz2"),
        write_ros1(tmp_path / "c.bag", sent, compression="lz4", chunk_bytes=10_000),
        write_ros2(tmp_path / "mcap", sent),
        write_ros2(tmp_path / "sqlite", sent, storage="sqlite3"),
        write_ros2(tmp_path / "packed", sent, compression="message"),
        split_ros2(tmp_path / "split", parts),
        write_json_mcap(
            tmp_path / "json.mcap",
            [
                (each.topic, each.time_ns, {"x": each.content.x, "y": each.content.y})
                for each in sent
                if each.type == POINT
            ],
        ),
    ]
    traces = [read_trace(log, mapping=mapping) for log in logs]
    assert len(traces[0]) == 60
    assert traces[0].names == ("a", "b")
    assert all(trace == traces[0] for trace in traces)
    assert len({hash_of(trace) for trace in traces}) == 1


def blocks_of(log: Path, mapping: Path, *window: int | None) -> list[Block]:
    return list(open_source(log, mapping=mapping).iter_blocks(*window))


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_a_window_holds_what_the_whole_log_holds_there(tmp_path: Path, mapping: Path, kind: Any) -> None:
    log = (
        write_ros1(tmp_path / "a.bag", drive())
        if kind == "ros1"
        else write_ros2(tmp_path / "bag", drive(), storage=kind)
    )
    whole = read_trace(log, mapping=mapping)
    for begin, end in ((0.0, 2.05), (1.0, 3.0), (2.55, 9.0), (0.1, 0.2)):
        start_ns, end_ns = START_NS + int(begin * SECOND), START_NS + int(end * SECOND)
        blocks = blocks_of(log, mapping, start_ns, end_ns)
        expected = within(whole, start_ns, end_ns)
        assert Trace.concatenate([block.trace for block in blocks]) == expected
        times = np.concatenate([block.messages.log_time_ns for block in blocks])
        assert len(times) == 2 * len(expected)
        assert times.min() >= start_ns and times.max() < end_ns


def test_mapped_messages_stay_as_they_are(tmp_path: Path, mapping: Path) -> None:
    sent = drive()
    blocks = blocks_of(write_ros2(tmp_path / "bag", sent), mapping)
    payloads = {topic: [] for topic in ("/a", "/b")}  # type: dict[str, list[bytes]]
    for block in blocks:
        messages = block.messages
        for number, payload in zip(messages.channel.tolist(), messages.payloads, strict=True):
            channel = messages.channels[number]
            assert channel.schema is not None
            assert (channel.encoding, channel.schema.name, channel.schema.encoding) == (
                "cdr",
                POINT,
                "ros2msg",
            )
            payloads[channel.topic].append(payload)
    for topic, found in payloads.items():
        assert found == [bytes(ROS2.serialize_cdr(s.content, POINT)) for s in sent if s.topic == topic]


def test_messages_never_run_ahead_of_their_samples(tmp_path: Path, mapping: Path) -> None:
    """So that a copy is written in the order of time, block by block."""
    blocks = blocks_of(write_ros1(tmp_path / "a.bag", drive(3_000)), mapping)
    assert len(blocks) > 2
    latest = -1
    for block in blocks[:-1]:
        times = block.messages.log_time_ns
        assert (np.diff(times) >= 0).all()
        if len(times):
            assert latest < times[0] and times[-1] <= block.trace.times_ns[-1]
            latest = int(times[-1])


def test_the_first_sample_needs_only_the_beginning(tmp_path: Path, mapping: Path) -> None:
    log = write_ros1(tmp_path / "a.bag", drive(2_000))
    data = bytearray(log.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 100] = bytes(100)
    log.write_bytes(data)
    first = next(block for block in open_source(log, mapping=mapping).iter_blocks() if len(block.trace))
    assert first.trace.times_ns[0] == START_NS + 1_000
    assert first.trace.faults == ()


def bytes_read() -> int:
    """How many bytes this process has read from files so far."""
    counters = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(counters["rchar"])


@pytest.mark.skipif(not Path("/proc/self/io").exists(), reason="the system does not count what is read")
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_window_of_an_indexed_log_reads_only_its_chunks(tmp_path: Path, mapping: Path, kind: str) -> None:
    filling = [Sent("/words", TEXT, START_NS + step * SECOND // 5, text("x" * 20_000)) for step in range(500)]
    sent = sorted([*drive(1000), *filling], key=lambda each: each.time_ns)
    if kind == "ros1":
        log = write_ros1(tmp_path / "a.bag", sent, chunk_bytes=100_000)
    else:
        log = write_mcap(
            tmp_path / "a.mcap",
            [("/a", "json", "", "", b""), ("/b", "json", "", "", b""), ("/words", "json", "", "", b"")],
            [
                (each.topic, each.time_ns, b"x" * 20_000 if each.type == TEXT else b'{"x": 1, "y": 2}')
                for each in sent
            ],
            chunk_bytes=100_000,
            compression=CompressionType.NONE,
        )
    size = log.stat().st_size
    assert size > 8_000_000
    window = (START_NS + 50 * SECOND, START_NS + 51 * SECOND)
    # the first time, modules are read, too
    blocks_of(log, mapping, *window)
    before = bytes_read()
    blocks = blocks_of(log, mapping, *window)
    read = bytes_read() - before
    assert sum(len(block.trace) for block in blocks) == 10
    # some ten seconds before and after count for what is late, old or silent
    assert read < 0.35 * size


def test_a_definition_is_added_to_a_copy_of_a_log_without(data_folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "pose.yaml"
    path.write_text("topics:\n  /pose: {shape: {disc: 0.5}}\n")
    (block, *_) = blocks_of(data_folder / "bags" / "pose_db3", path)
    (channel,) = block.messages.channels.values()
    assert channel.schema is not None
    assert channel.schema.data.startswith(b"std_msgs/Header header\ngeometry_msgs/Pose pose\n")


def test_logs_without_a_mapping_ask_for_one(tmp_path: Path, mapping: Path) -> None:
    for log in (write_ros1(tmp_path / "a.bag", drive(3)), write_ros2(tmp_path / "bag", drive(3))):
        with pytest.raises(UsageError, match="does not say what its objects are; give a mapping file"):
            read_trace(log)
    with pytest.raises(UsageError, match="a mapping file says which of them carry objects"):
        read_trace(write_json_mcap(tmp_path / "a.mcap", [("/a", START_NS, {})]))
    with pytest.raises(UsageError, match=r"--mapping .* does not apply to ours\.mcap \(MCAP\)"):
        read_trace(annotated(tmp_path, mapping), mapping=mapping)


def annotated(folder: Path, mapping: Path, name: str = "ours.mcap") -> Path:
    """An annotated copy of a drive."""
    (folder / "near.spatial").write_text("G (a dist b <= 100)")
    log = write_ros2(folder / f"source-{name}", drive())
    out = folder / name
    arguments = ["replay", str(log), "--mapping", str(mapping), "--spec", str(folder / "near.spatial")]
    assert run([*arguments, "-o", str(out), "--topics", "all"]) == 0
    return out


def test_an_annotated_copy_needs_no_mapping(tmp_path: Path, mapping: Path) -> None:
    out = annotated(tmp_path, mapping)
    assert read_trace(out) == read_trace(tmp_path / "source-ours.mcap", mapping=mapping)
    topics: set[str] = set()
    for block in open_source(out).iter_blocks():
        topics |= {channel.topic for channel in block.messages.channels.values()}
    # the topic that no mapping reads is copied, too
    assert topics == {"/a", "/b", "/words", "/spatial/objects"}


def test_extensions_do_not_matter(tmp_path: Path, mapping: Path) -> None:
    expected = read_trace(write_ros1(tmp_path / "a.bag", drive()), mapping=mapping)
    shutil.copy(tmp_path / "a.bag", tmp_path / "a.csv")
    assert read_trace(tmp_path / "a.csv", mapping=mapping) == expected
    folder = write_ros2(tmp_path / "bag", drive(), storage="sqlite3")
    shutil.copy(next(folder.glob("*.db3")), tmp_path / "a.mcap")
    assert read_trace(tmp_path / "a.mcap", mapping=mapping) == expected


@pytest.mark.parametrize("encoding", ["cdr", "protobuf", "flatbuffer"])
def test_a_mapped_topic_that_cannot_be_decoded_is_damage(
    tmp_path: Path, mapping: Path, encoding: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_mcap(
        tmp_path / "a.mcap",
        [("/a", encoding, "a/msg/A", "ros2msg", b"what is this"), ("/b", "json", "", "", b"")],
        [("/a", START_NS, b""), ("/b", START_NS, b'{"x": 1, "y": 2}')],
    )
    with pytest.raises(LogError, match=r"a\.mcap: topic '/a'"):
        read_trace(log, mapping=mapping)
    (tmp_path / "a.spatial").write_text("G (a dist b <= 100)")
    arguments = ["replay", str(log), "--mapping", str(mapping), "--spec", str(tmp_path / "a.spatial")]
    assert run(arguments) == 3
    assert "topic '/a'" in capsys.readouterr().err


def test_messages_that_cannot_be_decoded_are_reported_one_by_one(tmp_path: Path, mapping: Path) -> None:
    good = b'{"x": 1, "y": 2}'
    log = write_mcap(
        tmp_path / "a.mcap",
        [("/a", "json", "", "", b""), ("/b", "json", "", "", b"")],
        [
            (topic, START_NS + step, good if step != 3 else b"{")
            for step in range(9)
            for topic in ("/a", "/b")
        ],
    )
    trace = read_trace(log, mapping=mapping, allow_damage=True)
    assert len(trace) >= 8
    assert len(trace.faults) == 2
    assert all("not JSON" in fault for fault in trace.faults)


def test_any_damage_is_reported_without_a_traceback(
    tmp_path: Path, mapping: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not in a traceback; reported damage is exit code 3."""
    (tmp_path / "near.spatial").write_text("G (a dist b <= 100)")
    randomly = random.Random(4)
    logs = [
        write_ros1(tmp_path / "a.bag", drive(20)),
        next(write_ros2(tmp_path / "mcap", drive(20)).glob("*.mcap")),
        next(write_ros2(tmp_path / "sqlite", drive(20), storage="sqlite3").glob("*.db3")),
    ]
    codes = []
    for log in logs:
        data = log.read_bytes()
        broken = tmp_path / f"broken{log.suffix}"
        for _ in range(12):
            changed = bytearray(data)
            if randomly.random() < 0.5:
                del changed[randomly.randrange(20, len(changed)) :]
            else:
                changed[randomly.randrange(20, len(changed))] ^= 1 << randomly.randrange(8)
            broken.write_bytes(changed)
            arguments = ["replay", str(broken), "--mapping", str(mapping)]
            codes.append(run([*arguments, "--spec", str(tmp_path / "near.spatial")]))
            said = capsys.readouterr().err
            assert "Traceback" not in said
            assert codes[-1] != 2 or "broken" in said
    assert set(codes) <= {0, 1, 2, 3, 4}
    assert codes.count(3) > 12


def restarted() -> list[Sent]:
    """A drive of six seconds, and the same again from its second second on, recorded after it."""
    again = [
        each._replace(time_ns=each.time_ns + 1) for each in drive(60) if each.time_ns > START_NS + SECOND
    ]
    return [*drive(60), *again]


@pytest.mark.parametrize("chunk_bytes", [1_000, 10**6])
@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_a_clock_that_jumps_back_is_refused_or_ends_the_log(
    tmp_path: Path, mapping: Path, kind: Any, chunk_bytes: int
) -> None:
    sent = restarted()
    if kind == "ros1":
        log = write_ros1(tmp_path / "a.bag", sent, chunk_bytes=chunk_bytes)
    else:
        log = write_ros2(tmp_path / "bag", sent, storage=kind)
    with pytest.raises(LogError, match=r"time jumps back: .*--read on_time_jump=split"):
        read_trace(log, mapping=mapping)
    first = read_trace(log, mapping=mapping, on_time_jump="split")
    assert first == read_trace(write_ros2(tmp_path / "once", drive(60)), mapping=mapping)


def test_a_jump_in_a_later_part_of_a_split_bag_is_detected(tmp_path: Path, mapping: Path) -> None:
    sent = restarted()
    cuts = (0, 90, 210, len(sent))
    parts = [
        write_ros2(tmp_path / f"part{index}", sent[begin:end])
        for index, (begin, end) in enumerate(pairwise(cuts))
    ]
    log = split_ros2(tmp_path / "whole", parts)
    with pytest.raises(LogError, match="time jumps back"):
        read_trace(log, mapping=mapping)
    assert len(read_trace(log, mapping=mapping, on_time_jump="split")) == 60


def test_a_log_put_together_topic_by_topic_does_not_jump(tmp_path: Path, mapping: Path) -> None:
    sent = sorted(drive(60), key=lambda each: each.topic)
    expected = read_trace(write_ros2(tmp_path / "bag", drive(60)), mapping=mapping)
    assert read_trace(write_ros1(tmp_path / "a.bag", sent), mapping=mapping) == expected
    assert read_trace(write_ros2(tmp_path / "b", sent, storage="sqlite3"), mapping=mapping) == expected


def test_messages_late_by_less_than_a_second_are_in_order(tmp_path: Path, mapping: Path) -> None:
    sent = drive(60)
    late = [*sent[:60], *sent[75:78], *sent[60:75], *sent[78:]]
    expected = read_trace(write_ros2(tmp_path / "bag", sent), mapping=mapping)
    for on_time_jump in ("error", "split"):
        options: Any = {"mapping": mapping, "on_time_jump": on_time_jump}
        assert read_trace(write_ros1(tmp_path / f"{on_time_jump}.bag", late), **options) == expected


def test_messages_may_be_as_late_as_is_said(tmp_path: Path, mapping: Path) -> None:
    sent = drive(60)
    expected = read_trace(write_ros2(tmp_path / "bag", sent), mapping=mapping)
    # a detector that takes three seconds
    late = [*sent[:20], *sent[24:90], *sent[20:24], *sent[90:]]
    log = write_ros1(tmp_path / "late.bag", late, chunk_bytes=10**6)
    with pytest.raises(LogError, match=r"time jumps back.* at \d\.\d{3} s.*--read max_lateness=5s"):
        read_trace(log, mapping=mapping)
    assert read_trace(log, mapping=mapping, max_lateness="5s") == expected
    assert read_trace(log, mapping=mapping, max_lateness="all") == expected
    with pytest.raises(
        UsageError, match="max_lateness is 'soon'; give a duration such as 2s or 500ms, or all"
    ):
        read_trace(log, mapping=mapping, max_lateness="soon")


def test_chunks_of_a_ros_1_bag_may_come_in_any_order(tmp_path: Path, mapping: Path) -> None:
    sent = drive(60)
    expected = read_trace(write_ros1(tmp_path / "a.bag", sent), mapping=mapping)
    mixed = write_ros1(tmp_path / "b.bag", [*sent[80:], *sent[:40], *sent[40:80]], chunk_bytes=1)
    assert read_trace(mixed, mapping=mapping) == expected


def test_objects_are_where_their_messages_say(tmp_path: Path, mapping: Path) -> None:
    sent = [Sent("/a", POINT, START_NS, point(1.0, 2.0)), Sent("/b", POINT, START_NS, point(3.0, 4.0))]
    (sample,) = read_trace(write_ros2(tmp_path / "bag", sent), mapping=mapping).samples()
    found = {name: each.footprint for name, each in sample.objects.items() if not isinstance(each, Footprint)}
    assert found["a"].parts[0].vertices.tolist() == [[1.0, 2.0]]
    assert found["b"].parts[0].vertices.mean(axis=0).tolist() == [3.0, 4.0]


def test_headers_of_two_publishers_do_not_count_together(tmp_path: Path, mapping: Path) -> None:
    mapping.write_text("topics: {/p: {}}")
    with Writer1(tmp_path / "a.bag") as writer:
        for callerid, seq, x in (("/one", 900, 1.0), ("/two", 3, 2.0)):
            types = ROS1.types
            head = types["std_msgs/msg/Header"](seq, types["builtin_interfaces/msg/Time"](0, 0), "map")
            place = types["geometry_msgs/msg/Point"](x, 0.0, 0.0)
            turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            message = types[POSE](head, types["geometry_msgs/msg/Pose"](place, turn))
            sender = writer.add_connection("/p", POSE, typestore=ROS1, callerid=callerid)
            writer.write(sender, START_NS, bytes(ROS1.serialize_ros1(message, POSE)))
    trace = read_trace(tmp_path / "a.bag", mapping=mapping)
    assert trace.footprints.vertices[trace.rows[0], 0].tolist() == [2.0]


def test_a_clock_that_steps_back_is_remarked_in_every_container(tmp_path: Path, mapping: Path) -> None:
    """Headers of ROS 1 are numbered by their publisher; nothing numbers the rows of a database."""
    mapping.write_text("topics: {/p: {}}")
    sent = {False: list[Sent](), True: list[Sent]()}
    for tick in range(40):
        time_ns = START_NS + tick * SECOND // 10 - (SECOND * 3 // 4 if tick >= 20 else 0)
        for is_ros1, messages in sent.items():
            types = (ROS1 if is_ros1 else ROS2).types
            stamp = types["builtin_interfaces/msg/Time"](0, 0)
            head = types["std_msgs/msg/Header"](*([tick] if is_ros1 else []), stamp, "map")
            place = types["geometry_msgs/msg/Point"](float(tick), 0.0, 0.0)
            pose = types["geometry_msgs/msg/Pose"](
                place, types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            )
            messages.append(Sent("/p", POSE, time_ns, types[POSE](head, pose)))
    said = "/p: times step back in the order of recording, first by 0.650 s at 1700000001.900 s: its messages"
    for log, how in (
        (write_ros1(tmp_path / "a.bag", sent[True]), "numbered on"),
        (write_ros2(tmp_path / "b", sent[False], storage="sqlite3"), "sorted by time"),
    ):
        blocks = list(open_source(log, mapping=mapping).iter_blocks())
        points = (each.trace.footprints.vertices[each.trace.rows[:, 0], 0].tolist() for each in blocks)
        x = list(chain.from_iterable(points))
        (remark,) = (remark for each in blocks for remark in each.remarks)
        assert (x == sorted(x)) == (how == "numbered on")
        assert f"{said} are {how}" in remark

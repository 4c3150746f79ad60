"""Logs of messages in every container: the same messages, as declared, and no more read than asked for."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from bags.bag_files import (
    MAPPING,
    POINT,
    SECOND,
    START_NS,
    Sent,
    drive,
    point,
    split_ros2,
    write_ros1,
    write_ros2,
)
from spatial_replay import (
    Footprint,
    LogError,
    MissingFileError,
    Recorder,
    Sample,
    UsageError,
    read_trace,
)
from spatial_replay.bags.decoders import Topic
from spatial_replay.bags.open import open_messages
from spatial_replay.bags.reader import MessageReader
from spatial_replay.cli import run

Write = Callable[[Path, list[Sent]], Path]

CONTAINERS: dict[str, Write] = {
    "ros1": lambda folder, sent: write_ros1(folder / "drive.bag", sent),
    "ros1 bz2": lambda folder, sent: write_ros1(folder / "drive.bag", sent, compression="bz2"),
    "ros1 lz4": lambda folder, sent: write_ros1(folder / "drive.bag", sent, compression="lz4"),
    "mcap": lambda folder, sent: write_ros2(folder / "drive", sent),
    "mcap file": lambda folder, sent: next(write_ros2(folder / "drive", sent).glob("*.mcap")),
    "mcap by message": lambda folder, sent: write_ros2(folder / "drive", sent, compression="message"),
    "mcap by file": lambda folder, sent: write_ros2(folder / "drive", sent, compression="file"),
    "db3": lambda folder, sent: write_ros2(folder / "drive", sent, storage="sqlite3"),
    "db3 file": lambda folder, sent: next(
        write_ros2(folder / "drive", sent, storage="sqlite3").glob("*.db3")
    ),
    "db3 by message": lambda folder, sent: write_ros2(
        folder / "drive", sent, storage="sqlite3", compression="message"
    ),
    "db3 by file": lambda folder, sent: write_ros2(
        folder / "drive", sent, storage="sqlite3", compression="file"
    ),
}

containers = pytest.mark.parametrize("write", CONTAINERS.values(), ids=CONTAINERS)


def topic_of(reader: MessageReader, name: str) -> Topic:
    return next(topic for topic in reader.topics() if topic.name == name)


def points_of(reader: MessageReader, topic: str, *window: int | None) -> list[tuple[int, float, float]]:
    """Time and coordinates of each message."""
    decode: Callable[[bytes], Any] = reader.decoder(topic)
    found = []
    for message in reader.iter_messages([topic], *window):
        assert message.topic == topic
        decoded = decode(message.payload)
        found.append((message.log_time_ns, decoded.x, decoded.y))
    return found


def sent_points(sent: list[Sent], topic: str) -> list[tuple[int, float, float]]:
    return [(each.time_ns, each.content.x, each.content.y) for each in sent if each.topic == topic]


@containers
def test_every_message_is_read_and_decoded(tmp_path: Path, write: Write) -> None:
    sent = drive()
    reader = open_messages(write(tmp_path, sent))
    assert [(topic.name, topic.type) for topic in reader.topics()] == [
        ("/a", POINT),
        ("/b", POINT),
        ("/words", "std_msgs/msg/String"),
    ]
    assert all(topic.unreadable is None for topic in reader.topics())
    assert points_of(reader, "/a") == sent_points(sent, "/a")
    assert points_of(reader, "/b") == sent_points(sent, "/b")
    assert reader.take_faults() == () and reader.take_remarks() == ()


@containers
def test_messages_of_several_topics_come_in_the_order_of_time(tmp_path: Path, write: Write) -> None:
    reader = open_messages(write(tmp_path, drive()))
    times = [message.log_time_ns for message in reader.iter_messages(["/a", "/words"])]
    assert len(times) == 120
    assert times == sorted(times)


@containers
def test_a_window_holds_its_first_and_not_its_last_instant(tmp_path: Path, write: Write) -> None:
    sent = drive()
    reader = open_messages(write(tmp_path, sent))
    start_ns, end_ns = START_NS + SECOND, START_NS + 3 * SECOND
    expected = [each for each in sent_points(sent, "/a") if start_ns <= each[0] < end_ns]
    assert len(expected) == 20
    assert points_of(reader, "/a", start_ns, end_ns) == expected
    assert points_of(reader, "/a", None, end_ns) + points_of(reader, "/a", end_ns) == sent_points(sent, "/a")
    assert reader.take_faults() == ()


def test_what_a_container_declares_is_known(tmp_path: Path) -> None:
    for name in ("ros1", "mcap", "mcap file", "db3", "db3 file"):
        (tmp_path / name).mkdir()
        reader = open_messages(CONTAINERS[name](tmp_path / name, drive(7)))
        assert [topic.count for topic in reader.topics()] == [7, 7, 7], name


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("compression", ["none", "file"])
def test_a_split_bag_is_one_log(tmp_path: Path, storage: Any, compression: Any) -> None:
    sent = drive()
    parts = [
        write_ros2(
            tmp_path / f"part{index}", sent[begin : begin + 60], storage=storage, compression=compression
        )
        for index, begin in enumerate((0, 60, 120))
    ]
    reader = open_messages(split_ros2(tmp_path / "whole", parts))
    assert points_of(reader, "/a") == sent_points(sent, "/a")
    assert [topic.count for topic in reader.topics()] == [60, 60, 60]
    assert points_of(reader, "/b", START_NS + 5 * SECOND) == sent_points(sent, "/b")[50:]
    assert reader.take_faults() == ()


def test_parts_that_overlap_in_time_are_merged(tmp_path: Path) -> None:
    sent = drive()
    parts = [
        write_ros2(tmp_path / f"part{index}", [each for each in sent if each.topic == topic])
        for index, topic in enumerate(("/b", "/a", "/words"))
    ]
    reader = open_messages(split_ros2(tmp_path / "whole", parts))
    times = [message.log_time_ns for message in reader.iter_messages(["/a", "/b", "/words"])]
    assert times == [each.time_ns for each in sent]


def test_a_missing_part_is_reported(tmp_path: Path) -> None:
    sent = drive()
    parts = [
        write_ros2(tmp_path / f"part{index}", sent[begin : begin + 90]) for index, begin in enumerate((0, 90))
    ]
    folder = split_ros2(tmp_path / "whole", parts)
    (folder / "whole_1.mcap").unlink()
    reader = open_messages(folder)
    assert points_of(reader, "/a") == sent_points(sent, "/a")[:30]
    faults = reader.take_faults()
    assert "'whole_1.mcap' is missing" in faults[0]
    assert "declares 60 messages on '/a'; 30 could be read" in faults[-1]


def test_a_part_that_is_not_listed_is_remarked(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", drive())
    (folder / "other.mcap").write_bytes(b"\x89MCAP0\r\n")
    reader = open_messages(folder)
    assert len(points_of(reader, "/a")) == 60
    assert reader.take_faults() == ()
    (remark,) = reader.take_remarks()
    assert "'other.mcap' is not listed in metadata.yaml" in remark


def test_a_recorder_that_was_killed_leaves_files_without_metadata(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", drive(), storage="sqlite3")
    (folder / "metadata.yaml").unlink()
    reader = open_messages(folder)
    assert len(points_of(reader, "/a")) == 60
    assert "metadata.yaml is missing" in reader.take_faults()[0]


@pytest.mark.parametrize(
    ("before", "after", "reported"),
    [
        ("message_count: 60", "message_count: 61", "declares 61 messages on '/a'; 60 could be read"),
        ("message_count: 60", "message_count: many", "the message_count of topic '/a' is 'many'"),
        (POINT, "a/msg/B", "declares messages of 'a/msg/B' on '/a'; they are of 'geometry_msgs/msg/Point'"),
        ("drive.mcap", "../drive.mcap", None),
        ("drive.mcap", "gone.mcap", "its file 'gone.mcap' is missing"),
        ("rosbag2_bagfile_information", "a", "'topics_with_message_count' in it is not a list"),
        ("relative_file_paths:", "relative_file_paths: &a [*a]\n  x:", "it refers to parts of itself"),
        ("ros_distro: rosbags", "ros_distro: *a", "it refers to parts of itself"),
        ("topic_metadata", "topic", "has no 'topic_metadata'"),
        ("compression_mode: ''", "compression_mode: sponge", "compressed by 'sponge'"),
        ("version: 9", "version: !!python/object/apply:os.system ['false']", "it is no YAML"),
    ],
)
def test_wrong_metadata_are_reported(tmp_path: Path, before: str, after: str, reported: str | None) -> None:
    folder = write_ros2(tmp_path / "drive", [each for each in drive() if each.topic == "/a"])
    metadata = folder / "metadata.yaml"
    said = metadata.read_text()
    assert before in said
    head, _, tail = said.rpartition("topics_with_message_count")
    part = "topics_with_message_count" + tail if before in tail else said
    metadata.write_text((head if before in tail else "") + part.replace(before, after))
    reader = open_messages(folder)
    try:
        assert len(points_of(reader, "/a")) == 60
        faults = "\n".join(reader.take_faults())
    except LogError as error:
        faults = str(error)
    assert reported in faults if reported else not faults


def test_a_topic_that_no_file_has_cannot_be_read(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", drive(3))
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("name: /b", "name: /c"))
    topic = topic_of(open_messages(folder), "/c")
    assert (topic.count, topic.unreadable) == (3, "topic '/c' is in none of the bag's files")


def test_quality_of_service_never_hides_messages(tmp_path: Path) -> None:
    """Metadata and storage may write the same quality of service in two ways."""
    folder = write_ros2(tmp_path / "drive", drive(3))
    metadata = folder / "metadata.yaml"
    said = metadata.read_text().replace("offered_qos_profiles: []", 'offered_qos_profiles: "- depth: 1"')
    metadata.write_text(said)
    reader = open_messages(folder)
    assert len(points_of(reader, "/a")) == 3
    assert reader.take_faults() == ()


@pytest.mark.parametrize("name", ["talker_mcap", "talker_sqlite3"])
def test_a_bag_of_two_qualities_of_service_is_read_whole(data_folder: Path, name: str) -> None:
    reader = open_messages(data_folder / "bags" / name)
    declared = {topic.name: topic.count for topic in reader.topics() if topic.count}
    assert sum(declared.values()) == 20
    assert sum(1 for _ in reader.iter_messages(list(declared))) == 20
    assert reader.take_faults() == ()
    decode: Callable[[bytes], Any] = reader.decoder("/topic")
    said = [decode(message.payload).data for message in reader.iter_messages(["/topic"])]
    assert said == [f"Hello, world! {number}" for number in range(10)]


def test_recordings_are_the_same_in_four_containers(data_folder: Path) -> None:
    topics = ["/turtle1/pose", "/turtle2/pose"]
    found = []
    for name in ("two_turtles.bag", "two_turtles_lz4.bag", "two_turtles_mcap", "two_turtles_sqlite3"):
        reader = open_messages(data_folder / "bags" / name)
        decoders: dict[str, Callable[[bytes], Any]] = {topic: reader.decoder(topic) for topic in topics}
        poses = []
        for message in reader.iter_messages(topics):
            pose = decoders[message.topic](message.payload)
            poses.append((message.topic, message.log_time_ns, pose.x, pose.y, pose.theta))
        assert reader.take_faults() == ()
        found.append(poses)
    assert len(found[0]) == 2688
    assert all(poses == found[0] for poses in found)


def test_standard_types_need_no_definition(data_folder: Path) -> None:
    """Bags of early releases hold none."""
    reader = open_messages(data_folder / "bags" / "pose_db3")
    decode: Callable[[bytes], Any] = reader.decoder("/pose")
    frames = {decode(message.payload).header.frame_id for message in reader.iter_messages(["/pose"])}
    assert len(frames) == 1
    assert topic_of(reader, "/pose").count == 1565


def test_a_type_without_any_definition_says_so(tmp_path: Path) -> None:
    path = next(write_ros2(tmp_path / "drive", drive(3), storage="sqlite3").glob("*.db3"))
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE topics SET type = 'own_msgs/msg/Point' WHERE name = '/a'")
    database.close()
    reader = open_messages(path)
    unreadable = topic_of(reader, "/a").unreadable
    assert unreadable is not None and "no definition of 'own_msgs/msg/Point'" in unreadable
    assert len(points_of(reader, "/b")) == 3


def test_an_interrupted_database_says_what_is_missing(tmp_path: Path) -> None:
    path = next(write_ros2(tmp_path / "drive", drive(3), storage="sqlite3").glob("*.db3"))
    path.with_name(path.name + "-wal").write_bytes(b"changes")
    reader = open_messages(path)
    assert len(points_of(reader, "/a")) == 3
    assert f"what {path.name}-wal holds was not read" in reader.take_faults()[0]


def test_a_database_may_not_compute_its_messages(tmp_path: Path) -> None:
    path = tmp_path / "trap.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id FROM n)"
            " SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
        )
    database.close()
    with pytest.raises(LogError, match="no tables 'topics' and 'messages'"):
        open_messages(path).topics()


def test_many_publishers_of_a_topic_are_one_topic(tmp_path: Path) -> None:
    path = tmp_path / "drive.bag"
    write_ros1(path, drive(4))
    reader = open_messages(path)
    assert topic_of(reader, "/a").count == 4


def test_messages_out_of_order_come_in_order_within_reach(tmp_path: Path) -> None:
    times = [START_NS + step * SECOND // 10 for step in (0, 3, 1, 2, 5, 4, 6)]
    sent = [Sent("/a", POINT, time_ns, point(1.0, 2.0)) for time_ns in times]
    for name in ("ros1", "mcap", "db3"):
        (tmp_path / name).mkdir()
        reader = open_messages(CONTAINERS[name](tmp_path / name, sent))
        assert [each[0] for each in points_of(reader, "/a")] == sorted(times), name


def test_a_file_that_is_not_a_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError):
        open_messages(tmp_path / "gone.bag")
    (tmp_path / "text.bag").write_text("hello")
    with pytest.raises(LogError, match="neither a ROS bag nor an MCAP log"):
        open_messages(tmp_path / "text.bag")
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="not a ROS 2 bag that can be read"):
        open_messages(tmp_path / "empty").topics()


def test_a_bag_may_be_given_by_its_metadata(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", drive(5))
    mapping = tmp_path / "m.yaml"
    mapping.write_text(MAPPING)
    assert read_trace(folder / "metadata.yaml", mapping=mapping) == read_trace(folder, mapping=mapping)


def test_one_file_of_a_split_bag_says_that_there_are_others(tmp_path: Path) -> None:
    parts = [write_ros2(tmp_path / f"part{number}", drive(5)) for number in (0, 1)]
    bag = split_ros2(tmp_path / "drive", parts)
    mapping = tmp_path / "m.yaml"
    mapping.write_text(MAPPING)
    first = next(each for each in sorted(bag.iterdir()) if each.suffix != ".yaml")
    assert "one of the 2 files of a bag; give its folder" in read_trace(first, mapping=mapping).remarks[-1]
    (alone,) = write_ros2(tmp_path / "alone", drive(5)).glob("*.mcap")
    assert read_trace(alone, mapping=mapping).remarks == ()


def test_folders_and_files_that_are_no_logs_say_what_to_give(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingFileError, match="there is nothing in this folder"):
        read_trace(tmp_path / "empty")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("words")
    with pytest.raises(MissingFileError, match=r"no file of a ROS 2 bag .* give the path of a log$"):
        read_trace(tmp_path / "other")
    (tmp_path / "other" / "run.jsonl").write_text("")
    with pytest.raises(MissingFileError, match=r"such as .*run\.jsonl; batch takes a folder$"):
        read_trace(tmp_path / "other")
    several = tmp_path / "several"
    several.mkdir()
    for name in ("a.mcap", "b.mcap"):
        with Recorder(several / name) as recorder:
            recorder.write(Sample(0, {"cup": Footprint.disc(0, 0, 1)}))
    with pytest.raises(UsageError, match=r"without metadata.yaml; give one of its logs, .*a\.mcap"):
        read_trace(several)
    packed = next(write_ros2(tmp_path / "drive", drive(5), compression="file").glob("*.zstd"))
    with pytest.raises(LogError, match="compressed file of a ROS 2 bag; give its folder"):
        read_trace(packed)


def test_a_survey_names_two_definitions_of_a_topic(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    definitions = ((f"{kind} x\nfloat64 y\n").encode() for kind in ("float64", "float32"))
    log = tmp_path / "two.mcap"
    with log.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        for definition in definitions:
            channel = writer.register_channel(
                "/a", "cdr", writer.register_schema("b/msg/P", "ros2msg", definition)
            )
            writer.add_message(channel, START_NS, bytes(20), START_NS)
        writer.finish()
    run(["info", str(log)])
    said = capsys.readouterr().err
    assert "warning: topic '/a' has messages of 'b/msg/P' in two definitions" in said
    assert "bytes" not in said

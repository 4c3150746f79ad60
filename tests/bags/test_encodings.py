"""External MCAP logs in every encoding."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from bags.bag_files import (
    POINT,
    ROS1,
    ROS2,
    SECOND,
    START_NS,
    point,
    write_json_mcap,
    write_mcap,
)
from spatial_replay import LogError, read_trace
from spatial_replay.bags.open import open_messages

POSES = build_file_descriptor_set(PosesInFrame).SerializeToString()


def poses_log(path: Path, schema: bytes = POSES, **options: Any) -> Path:
    messages = []
    for index in range(20):
        poses = PosesInFrame(frame_id="map")
        poses.poses.add().position.x = 0.5 * index
        messages.append(("/poses", START_NS + index * SECOND, poses.SerializeToString()))
    channels = [("/poses", "protobuf", "foxglove.PosesInFrame", "protobuf", schema)]
    return write_mcap(path, channels, messages, **options)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_protobuf_is_decoded_by_the_descriptors_in_the_log(
    tmp_path: Path, compression: CompressionType
) -> None:
    reader = open_messages(poses_log(tmp_path / "poses.mcap", compression=compression))
    (topic,) = reader.topics()
    assert (topic.type, topic.encoding, topic.count) == ("foxglove.PosesInFrame", "protobuf", 20)
    decode: Callable[[bytes], Any] = reader.decoder("/poses")
    found = [decode(message.payload).poses[0].position.x for message in reader.iter_messages(["/poses"])]
    assert found == [0.5 * index for index in range(20)]
    with pytest.raises(LogError, match=r"a message is not a foxglove\.PosesInFrame"):
        decode(b"\xff\xff\xff")


def test_files_of_descriptors_may_come_in_any_order(tmp_path: Path) -> None:
    described = FileDescriptorSet.FromString(POSES)
    turned = FileDescriptorSet(file=list(reversed(described.file)))
    (topic,) = open_messages(poses_log(tmp_path / "poses.mcap", turned.SerializeToString())).topics()
    assert topic.unreadable is None


@pytest.mark.parametrize(
    ("schema", "reported"),
    [
        (b"", "cannot be used"),
        (b"\xff\xff", "cannot be used"),
        (POSES.replace(b"PosesInFrame", b"PosesInCrate"), "cannot be used"),
        (POSES[: len(POSES) // 2], "cannot be used"),
    ],
)
def test_descriptors_that_do_not_describe_the_type_are_reported(
    tmp_path: Path, schema: bytes, reported: str
) -> None:
    (topic,) = open_messages(poses_log(tmp_path / "poses.mcap", schema)).topics()
    assert topic.unreadable is not None and reported in topic.unreadable


def test_json_needs_no_schema(tmp_path: Path) -> None:
    log = write_json_mcap(tmp_path / "a.mcap", [("/a", START_NS, {"x": 1.5}), ("/a", START_NS + 1, [1])])
    reader = open_messages(log)
    (topic,) = reader.topics()
    assert (topic.type, topic.encoding, topic.unreadable) == ("", "json", None)
    decode = reader.decoder("/a")
    assert [decode(message.payload) for message in reader.iter_messages(["/a"])] == [{"x": 1.5}, [1]]
    for bad in (b"{", b"\xff", b"[" * 100_000):
        with pytest.raises(LogError, match="a message is not JSON"):
            decode(bad)


def test_ros1_messages_in_mcap_are_read(tmp_path: Path) -> None:
    text, _ = ROS1.generate_msgdef(POINT)
    payload = bytes(ROS1.serialize_ros1(point(1.0, 2.0), POINT))
    log = write_mcap(
        tmp_path / "a.mcap",
        [("/a", "ros1", "geometry_msgs/Point", "ros1msg", text.encode())],
        [("/a", START_NS, payload)],
        profile="ros1",
    )
    reader = open_messages(log)
    decode: Callable[[bytes], Any] = reader.decoder("/a")
    (message,) = reader.iter_messages(["/a"])
    decoded = decode(message.payload)
    assert (decoded.x, decoded.y) == (1.0, 2.0)
    assert reader.topics()[0].type == POINT
    assert (message.log_time_ns, message.publish_time_ns) == (START_NS, START_NS - 1_000)


def test_service_events_do_not_prevent_reading_a_log(tmp_path: Path) -> None:
    """Nor does a profile that is not that of ROS 2."""
    text, _ = ROS2.generate_msgdef(POINT, ros_version=2)
    payload = bytes(ROS2.serialize_cdr(point(1.0, 2.0), POINT))
    event = b"own_msgs/Request[<=1] request\n" + b"=" * 80 + b"\nMSG: own_msgs/Request\nint32 x\n"
    log = write_mcap(
        tmp_path / "a.mcap",
        [
            ("/a", "cdr", POINT, "ros2msg", text.encode()),
            ("/ask/_service_event", "cdr", "own_msgs/srv/Ask_Event", "ros2msg", event),
        ],
        [("/a", START_NS, payload), ("/ask/_service_event", START_NS, bytes(8))],
    )
    reader = open_messages(log)
    assert [topic.type for topic in reader.topics()] == [POINT, "own_msgs/srv/Ask_Event"]
    assert len(list(reader.iter_messages(["/a"]))) == 1
    assert reader.take_faults() == ()


def test_what_cannot_be_decoded_says_why_and_hides_nothing_else(tmp_path: Path) -> None:
    log = write_mcap(
        tmp_path / "a.mcap",
        [
            ("/cbor", "cbor", "", "", b""),
            ("/flat", "flatbuffer", "foxglove.Grid", "flatbuffer", b""),
            ("/json", "json", "", "", b""),
            ("/nothing", "cdr", "", "", b""),
            ("/protobuf", "protobuf", "", "", b""),
        ],
        [("/json", START_NS, b"{}"), ("/cbor", START_NS, b"\x00")],
    )
    reader = open_messages(log)
    reasons = {topic.name: topic.unreadable for topic in reader.topics()}
    assert reasons.pop("/json") is None
    reported = [str(reason).split(";")[0] for reason in reasons.values()]
    assert reported == [
        "topic '/cbor': the encoding 'cbor' is not known",
        "topic '/flat': the encoding 'flatbuffer' is not known",
        "topic '/nothing': the log has no message definition and no type of it",
        "topic '/protobuf': the definition of '' is missing",
    ]
    assert [message.payload for message in reader.iter_messages(["/json"])] == [b"{}"]


def test_a_topic_of_two_types_is_unreadable(tmp_path: Path) -> None:
    text, _ = ROS2.generate_msgdef(POINT, ros_version=2)
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for name in (POINT, "own_msgs/msg/Point"):
            schema = writer.register_schema(name, "ros2msg", text.encode())
            writer.add_message(writer.register_channel("/a", "cdr", schema), START_NS, b"", START_NS)
        writer.finish()
    (topic,) = open_messages(path).topics()
    assert topic.unreadable is not None and "more than one type" in topic.unreadable


def test_a_log_without_summary_is_read(tmp_path: Path) -> None:
    path = poses_log(tmp_path / "poses.mcap", chunk_bytes=200)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    path.write_bytes(path.read_bytes()[: summary.chunk_indexes[4].chunk_start_offset + 10])
    reader = open_messages(path)
    messages = list(reader.iter_messages(["/poses"]))
    assert [message.sequence for message in messages] == list(range(len(messages)))
    assert 4 <= len(messages) < 20
    assert "breaks off" in reader.take_faults()[0]


def test_an_external_log_is_read_whole(data_folder: Path) -> None:
    reader = open_messages(data_folder / "osi" / "osi_centerline_example.mcap")
    (topic,) = reader.topics()
    assert (topic.type, topic.count) == ("osi3.GroundTruth", 91)
    decode: Callable[[bytes], Any] = reader.decoder(topic.name)
    vehicles: set[int] = set()
    for message in reader.iter_messages([topic.name]):
        vehicles.update(each.id.value for each in decode(message.payload).moving_object)
    assert len(vehicles) == 14


def test_types_that_every_protobuf_library_has_may_be_missing_from_a_set(tmp_path: Path) -> None:
    described = FileDescriptorSet.FromString(POSES)
    own = [each for each in described.file if not each.name.startswith("google/protobuf/")]
    assert len(own) < len(described.file)
    reader = open_messages(
        poses_log(tmp_path / "poses.mcap", FileDescriptorSet(file=own).SerializeToString())
    )
    (topic,) = reader.topics()
    assert topic.unreadable is None
    decode: Callable[[bytes], Any] = reader.decoder("/poses")
    assert [decode(each.payload).frame_id for each in reader.iter_messages(["/poses"])] == ["map"] * 20


def idl_log(path: Path, members: str, payload: bytes) -> Path:
    text = (
        f"{'=' * 80}\nIDL: a/msg/Cup\nmodule a {{ module msg {{\n  enum Kind {{ NONE, FULL }};\n"
        f"  struct Cup {{ {members} }};\n}}; }};\n"
    )
    channels = [("/cup", "cdr", "a/msg/Cup", "ros2idl", text.encode())]
    return write_mcap(path, channels, [("/cup", START_NS, payload)])


def test_enums_of_idl_are_integers_of_four_bytes(tmp_path: Path) -> None:
    members = "uint8 first; Kind kind; sequence<a::msg::Kind> kinds; double x;"
    body = struct.pack("<B3xIIIId", 7, 1, 2, 1, 0, 2.5)
    reader = open_messages(idl_log(tmp_path / "cup.mcap", members, b"\0\1\0\0" + body + bytes(4)))
    decode: Callable[[bytes], Any] = reader.decoder("/cup")
    (message,) = reader.iter_messages(["/cup"])
    cup = decode(message.payload)
    assert (cup.first, cup.kind, list(cup.kinds)) == (7, 1, [1, 0])


def test_wide_texts_are_refused_by_their_name(tmp_path: Path) -> None:
    (topic,) = open_messages(idl_log(tmp_path / "cup.mcap", "wstring label;", bytes(8))).topics()
    assert topic.unreadable is not None
    assert "'label' of 'a/msg/Cup' is a wstring, which is not read" in topic.unreadable
    channels = [("/cup", "cdr", "a/msg/Cup", "ros2msg", b"wstring label\n")]
    (topic,) = open_messages(write_mcap(tmp_path / "b.mcap", channels, [])).topics()
    assert topic.unreadable is not None and "is a wstring" in topic.unreadable


def test_a_channel_without_a_schema_is_read_by_the_type_that_the_mapping_names(tmp_path: Path) -> None:
    payload = bytes(ROS2.serialize_cdr(point(1.0, 2.0), POINT))
    log = write_mcap(tmp_path / "a.mcap", [("/a", "cdr", "", "", b"")], [("/a", START_NS, payload)])
    mapping = tmp_path / "m.yaml"
    mapping.write_text("topics: {/a: {type: geometry_msgs/msg/PoseStamped}}")
    with pytest.raises(LogError, match="a message is not a geometry_msgs"):
        read_trace(log, mapping=mapping)
    mapping.write_text("topics: {/a: {position: [x, y]}}")
    with pytest.raises(LogError, match="topic '/a': the log has no message definition"):
        read_trace(log, mapping=mapping)
    pose = ROS2.types["geometry_msgs/msg/PoseStamped"]
    header = ROS2.types["std_msgs/msg/Header"](ROS2.types["builtin_interfaces/msg/Time"](0, 0), "map")
    turn = ROS2.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    message = pose(header, ROS2.types["geometry_msgs/msg/Pose"](point(1.0, 2.0), turn))
    payload = bytes(ROS2.serialize_cdr(message, "geometry_msgs/msg/PoseStamped"))
    log = write_mcap(tmp_path / "b.mcap", [("/a", "cdr", "", "", b"")], [("/a", START_NS, payload)])
    mapping.write_text("topics: {/a: {type: geometry_msgs/PoseStamped}}")
    assert read_trace(log, mapping=mapping).footprints.vertices.tolist() == [[1.0, 2.0]]

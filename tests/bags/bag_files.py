"""Small logs of messages, written with other libraries."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

SECOND = 1_000_000_000
START_NS = 1_700_000_000 * SECOND

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)

POSE = "geometry_msgs/msg/PoseStamped"
POINT = "geometry_msgs/msg/Point"
TEXT = "std_msgs/msg/String"

MAPPING = """\
sample: {topic: /b}
topics:
  /a: {position: [x, y], shape: {disc: 0.5}}
  /b: {position: [x, y], shape: {box: [1, 1]}}
"""
"""Of the messages of `drive`."""


class Sent(NamedTuple):
    """A message to write."""

    topic: str
    type: str
    time_ns: int
    content: Any


def point(x: float, y: float, z: float = 0.0) -> Any:
    return ROS2.types[POINT](x, y, z)


def text(words: str) -> Any:
    return ROS2.types[TEXT](words)


def drive(count: int = 60, step_ns: int = SECOND // 10) -> list[Sent]:
    """Two points that move, and strings that no object needs."""
    sent = []
    for index in range(count):
        time_ns = START_NS + index * step_ns
        sent.append(Sent("/a", POINT, time_ns, point(0.1 * index, 1.0)))
        sent.append(Sent("/b", POINT, time_ns + 1_000, point(5.0, 0.1 * index)))
        sent.append(Sent("/words", TEXT, time_ns + 2_000, text(f"number {index}")))
    return sent


def write_ros1(
    path: Path,
    messages: Iterable[Sent],
    *,
    compression: Literal["none", "bz2", "lz4"] = "none",
    chunk_bytes: int = 1_000,
) -> Path:
    writer = Writer1(path)
    writer.chunk_threshold = chunk_bytes
    if compression != "none":
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    with writer:
        connections: dict[str, Any] = {}
        for topic, type_name, time_ns, content in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=ROS1)
            writer.write(connections[topic], time_ns, bytes(ROS1.serialize_ros1(content, type_name)))
    return path


def write_ros2(
    folder: Path,
    messages: Iterable[Sent],
    *,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    compression: Literal["none", "file", "message"] = "none",
    typestore: Typestore = ROS2,
) -> Path:
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer2(folder, version=9, storage_plugin=plugin)
    if compression != "none":
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, type_name, time_ns, content in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=typestore)
            writer.write(connections[topic], time_ns, bytes(typestore.serialize_cdr(content, type_name)))
    return folder


def write_mcap(
    path: Path,
    channels: Sequence[tuple[str, str, str, str, bytes]],
    messages: Iterable[tuple[str, int, bytes]],
    *,
    chunk_bytes: int = 1_000,
    profile: str = "",
    compression: CompressionType = CompressionType.ZSTD,
) -> Path:
    """An MCAP log by the MCAP library.

    Args:
        channels: topic, message encoding, schema name, schema encoding, schema.
        messages: topic, log time, payload; published a microsecond earlier.
    """
    with path.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=chunk_bytes, compression=compression)
        writer.start(profile, "test")
        numbers = {}
        for topic, encoding, name, schema_encoding, schema in channels:
            schema_id = writer.register_schema(name, schema_encoding, schema) if name else 0
            numbers[topic] = writer.register_channel(topic, encoding, schema_id)
        for sequence, (topic, time_ns, payload) in enumerate(messages):
            writer.add_message(numbers[topic], time_ns, payload, time_ns - 1_000, sequence)
        writer.finish()
    return path


def write_json_mcap(path: Path, messages: Iterable[tuple[str, int, object]], **options: Any) -> Path:
    """An MCAP log whose messages are JSON without a schema."""
    listed = [(topic, time_ns, json.dumps(content).encode()) for topic, time_ns, content in messages]
    channels = [(topic, "json", "", "", b"") for topic in dict.fromkeys(topic for topic, _, _ in listed)]
    return write_mcap(path, channels, listed, **options)


def split_ros2(folder: Path, parts: Sequence[Path]) -> Path:
    """One bag of several: their files in one folder, and what their metadata say together."""
    import yaml

    folder.mkdir()
    abouts = []
    for index, part in enumerate(parts):
        about = yaml.safe_load((part / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        (name,) = about["relative_file_paths"]
        new_name = f"{folder.name}_{index}.{name.partition('.')[2]}"
        (part / name).rename(folder / new_name)
        abouts.append(about | {"relative_file_paths": [new_name]})
    topics: dict[str, Any] = {}
    for about in abouts:
        for each in about["topics_with_message_count"]:
            name = each["topic_metadata"]["name"]
            before = topics.get(name, {"message_count": 0})
            topics[name] = each | {"message_count": each["message_count"] + before["message_count"]}
    whole = abouts[0] | {
        "relative_file_paths": [about["relative_file_paths"][0] for about in abouts],
        "message_count": sum(about["message_count"] for about in abouts),
        "topics_with_message_count": list(topics.values()),
    }
    whole.pop("files", None)
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": whole}))
    return folder

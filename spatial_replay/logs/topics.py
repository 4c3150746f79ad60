"""Names of topics, metadata records and attachments in logs; channels with these topics."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from fnmatch import fnmatchcase
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from spatial_replay.logs.messages import Channel, Schema

if TYPE_CHECKING:
    from google.protobuf.descriptor import FileDescriptor
    from google.protobuf.message import Message


OWN_PREFIX = "/spatial/"
"""Prefix of our topics, which a log stores in separate chunks."""

OBJECTS = "/spatial/objects"
OBJECTS_TYPE = "spatial_replay.ObjectStates"
SCENE = "/spatial/scene"
SPECIFICATION = "/spatial/specification"
FRAME = "/spatial/frame"
STANDING = "/spatial/standing"
ROBUSTNESS = "/spatial/robustness"
AUTOMATON = "/spatial/automaton"
EVENTS = "/spatial/events"
EVENT_LOG = "/spatial/log"
RECENT_EVENTS = "/spatial/recent_events"

_DERIVED_TYPES: Final = MappingProxyType(
    {
        SCENE: "foxglove.SceneUpdate",
        FRAME: "foxglove.FrameTransform",
        SPECIFICATION: "spatial_replay.Specification",
        STANDING: "spatial_replay.StandingUpdate",
        ROBUSTNESS: "spatial_replay.Robustness",
        AUTOMATON: "spatial_replay.AutomatonState",
        EVENTS: "foxglove.Event",
        EVENT_LOG: "foxglove.Log",
        RECENT_EVENTS: "spatial_replay.RecentEvents",
    }
)
DERIVED = frozenset(_DERIVED_TYPES)
"""Topics computed from the samples and a specification; a replay replaces them."""


def has_our_type(channel: Channel) -> bool:
    """Return whether a channel on `OBJECTS` or a `DERIVED` topic has the message type that we write there."""
    type_name = OBJECTS_TYPE if channel.topic == OBJECTS else _DERIVED_TYPES.get(channel.topic)
    schema = channel.schema.name if channel.schema else ""
    return (channel.encoding, schema) == ("protobuf", type_name)


ORIGINAL_PREFIX = "/original"
"""Topic prefix in copies, for messages of other programs on one of our topics."""


def copied_channel(channel: Channel) -> Channel:
    """Return the channel of a copy for messages of another program; our topics get `ORIGINAL_PREFIX`."""
    is_ours = channel.topic == OBJECTS or channel.topic in DERIVED
    return replace(channel, topic=ORIGINAL_PREFIX + channel.topic) if is_ours else channel


def remarks_on_copies(name: str, channels: Iterable[Channel]) -> list[str]:
    """Return remarks on the channels of a log that a copy stores on other topics."""
    renamed_topics = {channel.topic for channel in channels if copied_channel(channel) != channel}
    return [
        f"{name}: a copy has its messages on {topic} on {ORIGINAL_PREFIX}{topic},"
        " because a replay writes that topic"
        for topic in sorted(renamed_topics)
    ]


CURVES_TOPIC = "/spatial/curves"
"""Curves of the whole log, published by a live server; no file has this topic."""

PLAN_DECISION = "/plan/decision"
GRADIENT_MAP = "/plan/gradient_map"
PLAN_PATH = "/plan/path"
MAP_DRAWING = "/plan/map_drawing"
REDONE_DECISION = "/plan/redone/decision"
REDONE_MAP = "/plan/redone/gradient_map"
REDONE_PATH = "/plan/redone/path"
REDONE_DRAWING = "/plan/redone/map_drawing"
BEHAVIOUR_TREE = "/plan/behaviour_tree"
"""Topics of a planner, of its recomputed decisions, and of the robot; a replay copies them."""

CAMERA_VIDEO = "/camera/video"
CAMERA_ANNOTATIONS = "/camera/annotations"
CAMERA_CALIBRATION = "/camera/calibration"
CAMERA_FRAMES = "/tf"
"""Topics of a run with a camera; a replay copies them."""


def topic_of_camera(topic: str, number: int) -> str:
    """Return the topic of a camera by its number, from 1: `/camera/video`, `/camera2/video`."""
    return topic if number == 1 else topic.replace("/camera/", f"/camera{number}/", 1)


MAGIC = b"\x89MCAP0\r\n"
"""The first eight and the last eight bytes of an MCAP file."""

LIBRARY = "spatial-replay"
"""Library name in the header of our logs."""

METADATA = "spatial_replay"
"""The first metadata record: writer, source and options of the log."""

ZERO = "zero_ns"
"""Key in `METADATA`: time zero of texts about the log; by default, the time of the first sample."""

ENDING = "spatial_replay_ending"
"""The metadata record at the end of a recording: number of samples, and how the recording ended."""

TRIGGER = "spatial_replay_trigger"
"""The metadata record of a clip: trigger and its time, and the requested and the available durations."""

CERTIFICATE = "spatial_replay_certificate"
"""The last metadata record: hashes of inputs and results."""

PLAN_METADATA = "spatial_replay_plan"
"""The metadata record with the settings and the specification of a planner."""

RECOVERY = "spatial_replay_recovery"
"""The metadata record of a log that was recovered from a damaged log: source and losses."""

VERDICTS = "spatial_replay_verdicts"
"""The metadata record with the verdict and robustness of each result of a replay."""

DOUBTS = "spatial_replay_doubts"
"""The metadata record with assumptions that the source of the log contradicts; see `Doubt`."""

AUTOMATA = "spatial_replay_automata"
"""The metadata record with the sizes of automata, or the reason why a specification has none."""

AUTOMATA_PREFIX = "automata/"
"""Prefix of attachments with automata; the specification's prefix follows it."""

LAYOUT = "layout.json"
"""The attachment that arranges a viewer's panels; a replay replaces it."""

RECORDED_PREFIX = "recorded/"
"""Prefix of attachments with inputs of a recording, which stay in every copy."""

CAMERA_PREFIX = "camera/"
"""Prefix of the attachment with the tags file of a camera's run, which stays in every copy."""

REPLAYED_PREFIX = "replayed/"
"""Prefix of attachments with inputs of a replay, which the next replay replaces."""


_IMAGES = frozenset({"CompressedImage", "CompressedVideo", "Image", "RawImage"})


def is_image_type(name: str) -> bool:
    """Return whether messages of a type are images or video frames of ROS or Foxglove."""
    # ROS writes sensor_msgs/msg/Image, Foxglove foxglove.RawImage
    package, _, short_name = name.replace(".", "/").rpartition("/")
    return short_name in _IMAGES and package.split("/")[0] in ("sensor_msgs", "foxglove", "foxglove_msgs")


def image_topics(channels: Iterable[Channel]) -> set[str]:
    """Return the topics whose messages are images."""
    return {
        channel.topic
        for channel in channels
        if channel.schema is not None and is_image_type(channel.schema.name)
    }


ALL, MAPPED = "all", "mapped"
"""Special patterns of `is_kept`: every topic, or the topics of the samples."""


def is_kept(topic: str, keep: Collection[str], mapped: Collection[str]) -> bool:
    """Return whether a copy of a log keeps the messages of a topic.

    Args:
        keep: "all", "mapped", or topic patterns such as "/camera/*", of which one must match.
        mapped: topics of the samples.
    """
    return any(
        pattern == ALL or (pattern == MAPPED and topic in mapped) or fnmatchcase(topic, pattern)
        for pattern in keep
    )


def protobuf_channel(topic: str, message: type[Message]) -> Channel:
    """Return the channel of a topic of one protobuf type, with all descriptors that decoding needs."""
    # imported here because readers do not need this module
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    descriptors = FileDescriptorSet()
    for file in _with_dependencies(message.DESCRIPTOR.file, {}):
        file.CopyToProto(descriptors.file.add())
    data = descriptors.SerializeToString(deterministic=True)
    return Channel(topic, "protobuf", Schema(message.DESCRIPTOR.full_name, "protobuf", data))


def _with_dependencies(file: Any, file_by_name: dict[str, FileDescriptor]) -> Iterable[FileDescriptor]:
    """Return the descriptors of a file and its imports; each file follows its own imports."""
    for dependency in file.dependencies:
        if dependency.name not in file_by_name:
            _with_dependencies(dependency, file_by_name)
    file_by_name[file.name] = file
    return file_by_name.values()

"""Names in logs: topics, metadata records and attachments, and channels that have a meaning."""

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
"""Topics of ours; a log has them in chunks of their own."""

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
"""Topics computed from the samples and a specification: a replay replaces them."""


def has_our_type(channel: Channel) -> bool:
    """Return whether a channel has the messages that we write on its topic, one of `OBJECTS` or `DERIVED`."""
    type_name = OBJECTS_TYPE if channel.topic == OBJECTS else _DERIVED_TYPES.get(channel.topic)
    schema = channel.schema.name if channel.schema else ""
    return (channel.encoding, schema) == ("protobuf", type_name)


ORIGINAL_PREFIX = "/original"
"""Begins the topic on which a copy has the messages that others wrote on one of our topics."""


def copied_channel(channel: Channel) -> Channel:
    """Return the channel on which a copy has messages that others wrote: not on a topic of ours."""
    is_ours = channel.topic == OBJECTS or channel.topic in DERIVED
    return replace(channel, topic=ORIGINAL_PREFIX + channel.topic) if is_ours else channel


def remarks_on_copies(name: str, channels: Iterable[Channel]) -> list[str]:
    """Return remarks on channels of a log that a copy has on another topic."""
    topics = {channel.topic for channel in channels if copied_channel(channel) != channel}
    return [
        f"{name}: a copy has its messages on {topic} on {ORIGINAL_PREFIX}{topic},"
        " because a replay writes that topic"
        for topic in sorted(topics)
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
"""Topics that a planner writes, what it would have decided otherwise, and the robot; a replay copies them."""

CAMERA_VIDEO = "/camera/video"
CAMERA_ANNOTATIONS = "/camera/annotations"
CAMERA_CALIBRATION = "/camera/calibration"
CAMERA_FRAMES = "/tf"
"""Topics of a run that a camera saw; a replay copies them."""


def topic_of_camera(topic: str, number: int) -> str:
    """Return the topic of one of several cameras, from 1: `/camera/video`, `/camera2/video`."""
    return topic if number == 1 else topic.replace("/camera/", f"/camera{number}/", 1)


MAGIC = b"\x89MCAP0\r\n"
"""The first bytes of an MCAP file, and the last."""

LIBRARY = "spatial-replay"
"""How our writer names itself in the header of a log."""

METADATA = "spatial_replay"
"""The metadata record that comes first: who wrote the log, from what, with which options."""

ZERO = "zero_ns"
"""Its entry of the time that texts about the log count from; without it, they count from the first sample."""

ENDING = "spatial_replay_ending"
"""The metadata record at the end of a recording: how many samples it holds, and how it ended."""

TRIGGER = "spatial_replay_trigger"
"""The metadata record of a clip: what fired, when, and how much around it was asked for and held."""

CERTIFICATE = "spatial_replay_certificate"
"""The metadata record that comes last: hashes of inputs and results."""

PLAN_METADATA = "spatial_replay_plan"
"""The metadata record with the settings and the specification that a planner's decisions depend on."""

RECOVERY = "spatial_replay_recovery"
"""The metadata record of a log that was recovered from a damaged one: what is missing in it."""

VERDICTS = "spatial_replay_verdicts"
"""The metadata record with the verdict and robustness of each result of a replay."""

DOUBTS = "spatial_replay_doubts"
"""The metadata record with the assumptions that a log's source contradicts; see `Doubt`."""

AUTOMATA = "spatial_replay_automata"
"""The metadata record with the sizes of automata, and why a specification has none."""

AUTOMATA_PREFIX = "automata/"
"""Attachments with automata; the prefix of their specification comes next."""

LAYOUT = "layout.json"
"""The attachment that arranges a viewer's panels; a replay replaces it."""

RECORDED_PREFIX = "recorded/"
"""Inputs of a recording as attachments; they stay in every copy."""

CAMERA_PREFIX = "camera/"
"""The tags file of a camera's run as an attachment; it stays in every copy."""

REPLAYED_PREFIX = "replayed/"
"""Inputs of a replay as attachments; the next replay replaces them."""


_IMAGES = frozenset({"CompressedImage", "CompressedVideo", "Image", "RawImage"})


def is_image_type(name: str) -> bool:
    """Return whether messages of a type are images or frames of a video: of ROS or of Foxglove."""
    package, _, short = name.replace(".", "/").rpartition("/")
    return short in _IMAGES and package.split("/")[0] in ("sensor_msgs", "foxglove", "foxglove_msgs")


def image_topics(channels: Iterable[Channel]) -> set[str]:
    """Return the topics whose messages are images."""
    return {
        channel.topic
        for channel in channels
        if channel.schema is not None and is_image_type(channel.schema.name)
    }


ALL, MAPPED = "all", "mapped"
"""Values of `is_kept` besides patterns: every topic, or the topics of the samples."""


def is_kept(topic: str, keep: Collection[str], mapped: Collection[str]) -> bool:
    """Return whether a copy of a log keeps the messages of a topic.

    Args:
        keep: "all", "mapped", or patterns of topics such as "/camera/*"; one that says so is enough.
        mapped: the topics that the samples are made of.
    """
    return any(
        pattern == ALL or (pattern == MAPPED and topic in mapped) or fnmatchcase(topic, pattern)
        for pattern in keep
    )


def protobuf_channel(topic: str, message: type[Message]) -> Channel:
    """Return the channel of a topic with messages of one protobuf type, with all it takes to decode them."""
    # imported here since readers need none of it
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    descriptors = FileDescriptorSet()
    for file in _with_dependencies(message.DESCRIPTOR.file, {}):
        file.CopyToProto(descriptors.file.add())
    data = descriptors.SerializeToString(deterministic=True)
    return Channel(topic, "protobuf", Schema(message.DESCRIPTOR.full_name, "protobuf", data))


def _with_dependencies(file: Any, files: dict[str, FileDescriptor]) -> Iterable[FileDescriptor]:
    """Return a file of message types and all that it imports, each behind its own imports."""
    for dependency in file.dependencies:
        if dependency.name not in files:
            _with_dependencies(dependency, files)
    files[file.name] = file
    return files.values()

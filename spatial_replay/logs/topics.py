"""Names in our logs: topics, metadata, attachments; what every MCAP file begins with."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from spatial_replay.logs.messages import Channel, Schema

if TYPE_CHECKING:
    from google.protobuf.descriptor import FileDescriptor
    from google.protobuf.message import Message

OWN_PREFIX = "/spatial/"
"""Topics of ours; a log has them in chunks of their own."""

OBJECTS = "/spatial/objects"
SCENE = "/spatial/scene"
SPECIFICATION = "/spatial/specification"
FRAME = "/spatial/frame"
STANDING = "/spatial/standing"
ROBUSTNESS = "/spatial/robustness"
AUTOMATON = "/spatial/automaton"
EVENTS = "/spatial/events"
EVENT_LOG = "/spatial/log"
RECENT_EVENTS = "/spatial/recent_events"

DERIVED = frozenset(
    {SCENE, FRAME, SPECIFICATION, STANDING, ROBUSTNESS, AUTOMATON, EVENTS, EVENT_LOG, RECENT_EVENTS}
)
"""Topics computed from the samples and a specification: a replay replaces them."""

CURVES_TOPIC = "/spatial/curves"
"""Curves of the whole log, published by a live server; no file has this topic."""

PLAN_DECISION = "/plan/decision"
GRADIENT_MAP = "/plan/gradient_map"
PLAN_PATH = "/plan/path"
REDONE_DECISION = "/plan/redone/decision"
REDONE_MAP = "/plan/redone/gradient_map"
REDONE_PATH = "/plan/redone/path"
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
    return {each.topic for each in channels if each.schema is not None and is_image_type(each.schema.name)}


ALL, MAPPED = "all", "mapped"
"""Values of `is_kept` besides patterns: every topic, or the topics of the samples."""


def is_kept(topic: str, keep: Collection[str], mapped: Collection[str]) -> bool:
    """Return whether a copy of a log keeps the messages of a topic.

    Args:
        keep: "all", "mapped", or patterns of topics such as "/camera/*"; one that says so is enough.
        mapped: the topics that the samples are made of.
    """
    return any(
        each == ALL or (each == MAPPED and topic in mapped) or fnmatchcase(topic, each) for each in keep
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


def _with_dependencies(file: Any, found: dict[str, FileDescriptor]) -> Iterable[FileDescriptor]:
    """Return a file of message types and all that it imports, each behind its own imports."""
    for each in file.dependencies:
        if each.name not in found:
            _with_dependencies(each, found)
    found[file.name] = file
    return found.values()

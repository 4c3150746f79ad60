"""Names that our logs use: topics, metadata, attachments."""

from __future__ import annotations

from google.protobuf.message import Message
from mcap_protobuf.schema import build_file_descriptor_set

from spatial_replay.logs.messages import Channel, Schema

OBJECTS = "/spatial/objects"
SCENE = "/spatial/scene"
SPECIFICATION = "/spatial/specification"
ROBUSTNESS = "/spatial/robustness"
AUTOMATON = "/spatial/automaton"
EVENTS = "/spatial/events"
EVENT_LOG = "/spatial/log"

DERIVED = frozenset({SCENE, SPECIFICATION, ROBUSTNESS, AUTOMATON, EVENTS, EVENT_LOG})
"""Topics computed from the samples and a specification: a replay replaces them."""

CURVES_TOPIC = "/spatial/curves"
"""What a live server says of the whole log; no file has it."""

PLAN_DECISION = "/plan/decision"
GRADIENT_MAP = "/plan/gradient_map"
PLAN_PATH = "/plan/path"
"""What a planner writes; a replay keeps them."""

METADATA = "spatial_replay"
"""The metadata record that comes first: who wrote the log, from what, with which options."""

ENDING = "spatial_replay_ending"
"""The metadata record at the end of a recording: how many samples it holds, and how it came to its end."""

CERTIFICATE = "spatial_replay_certificate"
"""The metadata record that comes last: hashes of what went in and what came out."""

AUTOMATA = "spatial_replay_automata"
"""The metadata record with the sizes of automata, and why a specification has none."""

AUTOMATA_PREFIX = "automata/"
"""Attachments with automata; the prefix of the specification that they are of comes next."""

RECORDED_PREFIX = "recorded/"
"""Attachments that a recording was made with; they stay in every copy."""

REPLAYED_PREFIX = "replayed/"
"""Attachments that a replay was made with; the next replay replaces them."""


def protobuf_channel(topic: str, message: type[Message]) -> Channel:
    """The channel of a topic whose messages are of one protobuf type, with everything needed to read them."""
    descriptors = build_file_descriptor_set(message).SerializeToString(deterministic=True)
    return Channel(topic, "protobuf", Schema(message.DESCRIPTOR.full_name, "protobuf", descriptors))

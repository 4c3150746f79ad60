"""Topics of a log of messages, as the log describes them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from spatial_replay.logs.messages import Schema

Decoder = Callable[[bytes], object]
"""A payload to an object with fields: attributes of ROS and protobuf messages, keys of a JSON object."""

_LATCHED = re.compile(r"durability: *(1|transient_local)\b")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a log, of one type and encoding.

    Attributes:
        type: as rosbags names ROS types (`turtlesim/msg/Pose`), else the schema's name
            (`foxglove.SceneUpdate`); empty where the log does not say.
        encoding: of the messages: ros1, cdr, protobuf, json.
        count: how many messages the log declares, or None.
        schema: the definition as the log has it, or None.
        latched: whether its last message before a window still counts (latched, transient local).
        unreadable: why its messages cannot be decoded, or None.
        metadata: of its channel, as an MCAP log has it.
    """

    name: str
    type: str
    encoding: str
    count: int | None = None
    schema: Schema | None = None
    latched: bool = False
    unreadable: str | None = None
    metadata: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}), hash=False)


def is_latched(qos: str) -> bool:
    """Return whether a ROS 2 publisher's quality of service keeps messages for late subscribers."""
    return _LATCHED.search(qos) is not None

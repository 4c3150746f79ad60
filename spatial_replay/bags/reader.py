"""What every log of messages offers, whoever recorded it: topics, raw messages, and a way to decode them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple, Protocol

from spatial_replay.logs.messages import Schema
from spatial_replay.logs.read_options import FaultList

Decoder = Callable[[bytes], object]
"""A payload to an object with fields: attributes of ROS and protobuf messages, keys of a JSON object."""


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
        metadata: of its channel, as an MCAP log keeps it.
    """

    name: str
    type: str
    encoding: str
    count: int | None = None
    schema: Schema | None = None
    latched: bool = False
    unreadable: str | None = None
    metadata: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}), hash=False)


class Message(NamedTuple):
    """One message as it stands in the log.

    Attributes:
        log_time_ns: when it was recorded.
        publish_time_ns: when it was sent; the log time where the container does not know.
        sequence: number within its topic as in the log, 0 where the log has none; of messages of one topic
            and time, the later one comes later.
        payload: in its topic's encoding.
    """

    topic: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    payload: bytes


class MessageReader(Protocol):
    """A log of messages; it is read from the file anew each time."""

    @property
    def name(self) -> str:
        """What the log is called: the base name of its file or folder."""

    @property
    def kind(self) -> str:
        """The format, in a word."""

    def topics(self) -> tuple[Topic, ...]:
        """The topics, by name.

        Raises:
            LogError: the log is too damaged to tell.
        """

    def iter_messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """The messages of some topics in the order of their log time, as far as the log keeps it.

        Args:
            start_ns, end_ns: only those logged from `start_ns` up to, not including, `end_ns`.

        Raises:
            LogError: nothing can be read.
        """

    def take_faults(self) -> tuple[str, ...]:
        """What was lost since the last call, each with its place, on topics that were asked for."""

    def move_faults(self, other: FaultList) -> None:
        """Hand over what `take_faults` would give, with the count of what is no longer told one by one."""

    def take_remarks(self) -> tuple[str, ...]:
        """What is wrong with the log since the last call without a loss on topics that were asked for."""

    def decoder(self, topic: str) -> Decoder:
        """How to decode the messages of a topic.

        The function that is returned raises LogError, saying what is wrong, for a payload that does not fit.

        Raises:
            LogError: the topic's definition is missing or cannot be understood.
        """

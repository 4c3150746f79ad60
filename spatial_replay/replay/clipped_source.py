"""A log cut to a window, after the messages that are still valid when it begins."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from spatial_replay.bags.decoders import Topic, decoder_of, full_type_name
from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import select
from spatial_replay.logs.mcap.read import McapSource
from spatial_replay.logs.messages import Block, Channel, Messages, merge
from spatial_replay.logs.source import Source, SourceOf, read_blocks
from spatial_replay.logs.topics import OBJECTS
from spatial_replay.mapping.field_paths import get_field
from spatial_replay.mapping.message_types import TRANSFORM_TYPES, short_type
from spatial_replay.replay.selection import KEEP_ALL, source_keeping
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace, window_of

CLIP_METADATA: Final = "spatial_replay_clip"
"""The metadata record that says what a clip was cut from."""


@dataclass(frozen=True)
class _ClippedSource(SourceOf):
    """A log from one time to before another, after the messages that are still valid then."""

    start_ns: int
    end_ns: int
    latched: Messages
    about: Mapping[str, str]

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        first = max(self.start_ns, start_ns or 0)
        last = min(self.end_ns, FOREVER if end_ns is None else end_ns)
        if len(self.latched) and (start_ns or 0) <= self.start_ns:
            yield Block(Trace.from_samples(()), self.latched)
        for block in self.source.iter_blocks(first, last):
            # an external log is read from before the window, for what is valid in it
            yield replace(block, messages=_between(block.messages, first, last))

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        records = tuple(each for each in self.source.metadata() if each[0] != CLIP_METADATA)
        return (*records, (CLIP_METADATA, self.about))


def clipped_source(source: Source, about: Mapping[str, str]) -> Source:
    """Return the part of a log that a clip has, as its metadata says.

    Args:
        about: the metadata record of the clip: the times of its first and last sample, and what it keeps.

    Raises:
        LogError: the record cannot be read. UsageError: a pattern that no topic of the log fits.
    """
    try:
        start_ns, end_ns = int(about["start_ns"]), int(about["end_ns"])
        keep = json.loads(about.get("keep", json.dumps(KEEP_ALL)))
        kept = source_keeping(source, tuple(map(str, keep)))
    except (LookupError, TypeError, ValueError) as error:
        raise LogError(f"the metadata {CLIP_METADATA} of the clip cannot be read: {error}") from error
    return _ClippedSource(kept, start_ns, end_ns + 1, _latched(kept, start_ns), about)


def _latched(source: Source, start_ns: int) -> Messages:
    """Return the last message before a time of each topic but the samples, and of each frame's transform."""
    latest: dict[tuple[Channel, str], Messages] = {}
    frames: dict[Channel, Callable[[bytes], Sequence[str]]] = {}
    for messages in _messages_before(source, start_ns):
        for number, channel in messages.channels.items():
            own = np.flatnonzero(messages.channel == number)
            if channel.topic == OBJECTS or not len(own):
                continue
            if channel not in frames:
                frames[channel] = _frame_names(channel)
            kind = short_type(channel.schema.name) if channel.schema is not None else ""
            for index in own.tolist() if kind in TRANSFORM_TYPES else own[-1:].tolist():
                message = select(messages, np.array([index]))
                for frame in frames[channel](message.payloads[0]):
                    latest[channel, frame] = message
    distinct = {id(message): message for message in latest.values()}
    return merge(list(distinct.values()))


def _messages_before(source: Source, end_ns: int) -> Iterator[Messages]:
    if isinstance(source, McapSource):
        with source.open_walk() as walk:
            topics = {channel.topic for channel in walk.channels.values()} - {OBJECTS}
            # with samples alone, and what is derived from them, there is nothing to look for
            if not any(map(source.is_wanted, topics)):
                return
    for block in read_blocks(source, None, end_ns):
        yield _between(block.messages, 0, end_ns)


def _between(messages: Messages, start_ns: int, end_ns: int) -> Messages:
    begin, end = window_of(messages.log_time_ns, start_ns, end_ns)
    return messages if end - begin == len(messages) else select(messages, np.arange(begin, end))


def _frame_names(channel: Channel) -> Callable[[bytes], Sequence[str]]:
    """Return a function from a message to the frames that it places; one name for other messages."""
    kind = "" if channel.schema is None else channel.schema.name
    decode: Callable[[bytes], Any] | None = None
    if short_type(kind) in TRANSFORM_TYPES:
        with suppress(LogError):
            name = full_type_name(kind) if channel.encoding in ("ros1", "cdr") else kind
            topic = Topic(channel.topic, name, channel.encoding, schema=channel.schema)
            decode = decoder_of(topic)

    def names(payload: bytes) -> Sequence[str]:
        try:
            return [""] if decode is None else _children(decode(payload))
        except (LogError, LookupError, ValueError, AttributeError, TypeError):
            # a broken message counts like one of another topic
            return [""]

    return names


def _children(message: Any) -> list[str]:
    try:
        transforms: Any = get_field(message, "transforms")
    except (LookupError, AttributeError, TypeError):
        transforms = [message]
    return [str(get_field(each, "child_frame_id")) for each in transforms] or [""]

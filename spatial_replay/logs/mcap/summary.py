"""A summary of an MCAP log: channels, counts, metadata and attachments."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from spatial_replay.logs.mcap.index import iter_attachments, iter_metadata
from spatial_replay.logs.mcap.read import ChunkWalk, McapSource
from spatial_replay.logs.messages import Channel
from spatial_replay.logs.remote import file_size
from spatial_replay.logs.topics import OBJECTS


@dataclass(frozen=True, slots=True)
class ChannelSummary:
    """A channel and how many messages it has."""

    channel: Channel
    messages: int


@dataclass(frozen=True, slots=True)
class AttachmentSummary:
    """An attachment without its content; `size` in bytes."""

    name: str
    media_type: str
    size: int


@dataclass(frozen=True, slots=True)
class LogSummary:
    """Content of an MCAP log.

    Attributes:
        name: the file's base name.
        size: in bytes.
        library: the software that wrote it, as it names itself.
        messages: in all channels.
        chunks: how many parts of the file are compressed on their own.
        start_ns, end_ns: log times of the first and the last message; None in a log without messages.
        channels: by topic.
        metadata: records in the order of the file; a name may occur more than once.
        attachments: in the order of the file.
        faults: what is damaged, each with its place.
    """

    name: str
    size: int
    library: str
    messages: int
    chunks: int
    start_ns: int | None
    end_ns: int | None
    channels: tuple[ChannelSummary, ...]
    metadata: tuple[tuple[str, Mapping[str, str]], ...]
    attachments: tuple[AttachmentSummary, ...]
    faults: tuple[str, ...]

    @property
    def damaged(self) -> bool:
        return bool(self.faults)

    @property
    def has_objects(self) -> bool:
        """Whether there is a channel for samples."""
        return any(each.channel.topic == OBJECTS for each in self.channels)


def summarise_mcap(source: McapSource) -> LogSummary:
    """Summarise an MCAP log; a log without a summary of its own is read as a whole for this."""
    with source.open_walk() as walk:
        counts, start_ns, end_ns = _counts(walk)
        directory, opened = walk.directory, (walk.stream, walk.directory, walk.faults, source.name)
        channels = [ChannelSummary(channel, counts[number]) for number, channel in walk.channels.items()]
        return LogSummary(
            name=source.name,
            size=file_size(source.path),
            library=directory.header.library if directory.header else "",
            messages=counts.total(),
            chunks=sum(place.compressed for place in directory.chunks),
            start_ns=start_ns,
            end_ns=end_ns,
            channels=tuple(sorted(channels, key=lambda each: each.channel.topic)),
            metadata=tuple(iter_metadata(*opened)),
            attachments=tuple(
                AttachmentSummary(a.name, a.media_type, len(a.data)) for a in iter_attachments(*opened)
            ),
            faults=walk.faults.take(last=True),
        )


def _counts(walk: ChunkWalk) -> tuple[Counter[int], int | None, int | None]:
    """Count messages by channel; return also the times of the first and the last."""
    statistics = walk.directory.statistics
    if statistics is not None:
        counts = Counter(statistics.channel_message_counts)
        times = [statistics.message_start_time, statistics.message_end_time] if counts.total() else []
    else:
        counts, times = Counter(), []
        for _, messages in walk.iter_messages(walk.places):
            counts.update(messages.heads["channel"].tolist())
            times += messages.heads["log_time"].tolist()
            times = [min(times), max(times)] if times else []
    return counts, (times[0] if times else None), (times[-1] if times else None)

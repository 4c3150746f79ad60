"""What is in an MCAP log, at a glance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from spatial_replay.logs.mcap.index import Directory, iter_attachments, iter_metadata, read_directory
from spatial_replay.logs.mcap.reader import ChunkWalk
from spatial_replay.logs.messages import Attachment, Channel
from spatial_replay.logs.read_options import FaultList
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
    """What is in a log.

    Attributes:
        name: the file's base name.
        size: in bytes.
        library: what wrote it, in its own words.
        messages: in all channels.
        chunks: how many parts of the file are compressed on their own.
        start_ns, end_ns: log times of the first and the last message; None in a log without messages.
        channels: by topic.
        metadata: records by the order in the file; a name may be there more than once.
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


def summarise_mcap(path: Path) -> LogSummary:
    """What is in an MCAP log; a log without a summary of its own is read as a whole for this."""
    faults = FaultList()
    with path.open("rb") as stream:
        directory = read_directory(stream, faults, path.name)
        walk = ChunkWalk(stream, directory, faults, path.name)
        counts, start_ns, end_ns = _counts(directory, walk)
        channels = [ChannelSummary(channel, counts[number]) for number, channel in walk.channels.items()]
        return LogSummary(
            name=path.name,
            size=path.stat().st_size,
            library=directory.header.library if directory.header else "",
            messages=counts.total(),
            chunks=sum(place.compressed for place in directory.chunks),
            start_ns=start_ns,
            end_ns=end_ns,
            channels=tuple(sorted(channels, key=lambda each: each.channel.topic)),
            metadata=tuple(iter_metadata(stream, directory, faults, path.name)),
            attachments=_attachments(iter_attachments(stream, directory, faults, path.name)),
            faults=faults.take(last=True),
        )


def _counts(directory: Directory, walk: ChunkWalk) -> tuple[Counter[int], int | None, int | None]:
    """Messages by channel, and the times of the first and the last."""
    statistics = directory.statistics
    if statistics is not None:
        counts = Counter(statistics.channel_message_counts)
        times = [statistics.message_start_time, statistics.message_end_time] if counts.total() else []
    else:
        counts, times = Counter(), []
        for _, messages in walk.iter_messages(walk.places):
            counts.update(channel for _, channel, *_ in messages)
            times += [time_ns for time_ns, *_ in messages]
            times = [min(times), max(times)] if times else []
    return counts, (times[0] if times else None), (times[-1] if times else None)


def _attachments(attachments: Iterable[Attachment]) -> tuple[AttachmentSummary, ...]:
    return tuple(
        AttachmentSummary(attachment.name, attachment.media_type, len(attachment.data))
        for attachment in attachments
    )

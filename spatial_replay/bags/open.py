"""Open a log of messages with a reader for its content; readers of MCAP files and of bag folders.

The reader of MCAP is our own for three reasons. The MCAP library fails 112 of the 416 files of the format's
conformance suite. It gives up on truncated and unindexed files, which crashed recorders leave behind. It
yields an object for each message, but our reader yields the messages of a chunk as columns.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from itertools import accumulate
from pathlib import Path
from typing import TypeAlias

import numpy as np

from spatial_replay.bags.decoders import Topic, topic_of, topics_by_name
from spatial_replay.bags.definitions import full_type_name
from spatial_replay.bags.reader import (
    Columns,
    MessageColumns,
    MessageReader,
    in_order,
    merge_files,
    places_in,
)
from spatial_replay.bags.ros1 import BAG_MAGIC, Ros1Bag
from spatial_replay.bags.sqlite import (
    LARGEST_METADATA,
    SQLITE_MAGIC,
    ZSTD_MAGIC,
    BagMetadata,
    SqliteBag,
    bag_metadata_from_bytes,
    decompress_message,
    temporary_folder,
    unpack_file,
    unpacked_size,
)
from spatial_replay.errors import LogError, MissingFileError
from spatial_replay.geometry.arrays import select
from spatial_replay.logs.mcap.index import (
    ChunkPlace,
    Directory,
    iter_attachments,
    iter_metadata,
    read_directory,
)
from spatial_replay.logs.mcap.read import ChunkWalk, directory_remarks, most_waiting
from spatial_replay.logs.messages import Attachment, Channel, Messages
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.remote import BAG_METADATA, LogFile, open_file
from spatial_replay.logs.topics import MAGIC
from spatial_replay.text import Instant, Sentence


class McapLog(MessageReader):
    """An MCAP log of any encoding, read chunk by chunk."""

    kind = "MCAP"

    def __init__(self, path: LogFile) -> None:
        super().__init__(path)
        self._file = path
        self._read_count, self._is_all_read = 0, False
        self._is_remarked = False

    @cached_property
    def _walk(self) -> ChunkWalk:
        with open_file(self._file) as stream:
            directory = read_directory(stream, self._faults, self.name)
            return ChunkWalk(stream, directory, self._faults, self.name)

    @property
    def _directory(self) -> Directory:
        return self._walk.directory

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        statistics = self._directory.statistics
        counts = statistics.channel_message_counts if statistics else None
        if statistics and not counts and statistics.message_count:
            # the format lets writers leave out the counts of channels
            counts = None
        if statistics and counts and sum(counts.values()) != statistics.message_count:
            self._faults.add(
                f"{self.name}: its statistics contradict themselves: {statistics.message_count} messages,"
                f" and {sum(counts.values())} on its channels"
            )
        return topics_by_name(
            topic_of(channel, None if counts is None else counts.get(number, 0))
            for number, channel in sorted(self._walk.channels.items())
        )

    @property
    def profile(self) -> str:
        header = self._directory.header
        return header.profile if header else ""

    def take_remarks(self) -> tuple[str, ...]:
        is_first, self._is_remarked = not self._is_remarked, True
        return directory_remarks(self.name, self._directory, self.metadata()) if is_first else ()

    @cached_property
    def _declared(self) -> Mapping[int, Channel]:
        # a copy, because reading may find channels that the index lacks
        return dict(self._walk.channels)

    @property
    def channel_topics(self) -> frozenset[str]:
        """Topics of the log's channels; definitions are not checked."""
        return frozenset(channel.topic for channel in self._declared.values())

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        return min((place.start_ns for place in self._directory.chunks), default=None)

    def _read(self, topics: Collection[str], first_ns: int, end_ns: int, *, as_recorded: bool) -> Columns:
        directory, channel_numbers = self._directory, self._channel_numbers(topics)
        places = [
            (rank, place)
            for rank, place in enumerate(directory.chunks)
            if place.start_ns < end_ns
            and place.end_ns >= first_ns
            and (place.channels is None or not place.channels.isdisjoint(channel_numbers))
        ]
        if not as_recorded:
            places.sort(key=lambda ranked: ranked[1].start_ns)
        self._read_count, self._is_all_read = 0, len(places) == len(directory.chunks)
        with open_file(self._file) as stream:
            walk = copy(self._walk)
            walk.stream = stream
            statistics = directory.statistics
            # without counts of channels, all messages are read to compare their number with the total
            is_counting_all = statistics is not None and not statistics.channel_message_counts
            messages_of_places = walk.iter_messages(
                [place for _, place in places], lambda topic: is_counting_all or topic in topics
            )
            chunk_columns = (
                self._columns(rank, place, messages, channel_numbers, first_ns, end_ns)
                for (rank, _), (place, messages) in zip(places, messages_of_places, strict=True)
            )
            if as_recorded:
                yield from chunk_columns
                return
            most_bytes = most_waiting(place.length for _, place in places)
            yield from in_order([place.start_ns for _, place in places], chunk_columns, self.name, most_bytes)

    def _count(self, columns: Columns, topics: Collection[str], name: str | None = None) -> Columns:
        yield from super()._count(columns, topics, name)
        statistics = self._directory.statistics
        # without counts of channels, only the total can be compared
        if statistics and not statistics.channel_message_counts and self._is_all_read:
            declared_total = statistics.message_count
            if declared_total != self._read_count:
                self._faults.add(
                    f"{self.name}: it declares {declared_total} messages in all;"
                    f" {self._read_count} could be read"
                )

    def attachments(self) -> tuple[Attachment, ...]:
        with open_file(self._file) as stream:
            return tuple(iter_attachments(stream, self._directory, FaultList(), self.name))

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        with open_file(self._file) as stream:
            return tuple(iter_metadata(stream, self._directory, FaultList(), self.name))

    def _columns(
        self,
        rank: int,
        place: ChunkPlace,
        messages: Messages,
        wanted_channels: list[int],
        first_ns: int,
        end_ns: int,
    ) -> MessageColumns:
        """Return the wanted messages of a chunk; report messages of channels that the index lacks."""
        self._read_count += len(messages)
        unknown_channels = np.setdiff1d(messages.channel, self._numbers)
        if len(unknown_channels):
            fault = (
                f"at byte {place.offset}: some messages are of a channel {unknown_channels[0]} that is not"
                " declared"
            )
            self._faults.add(f"{self.name}: {fault} in the index")
        times_ns = messages.log_time_ns
        wanted_indices = np.flatnonzero(
            np.isin(messages.channel, wanted_channels) & (times_ns >= first_ns) & (times_ns < end_ns)
        )
        wanted_messages = select(messages, wanted_indices)
        times_of_messages = wanted_messages.log_time_ns, wanted_messages.publish_time_ns
        return self._make_columns(
            wanted_messages.channel,
            times_of_messages,
            wanted_messages.sequence,
            wanted_messages.payloads,
            places_in(rank, wanted_indices),
        )


_ENDINGS = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")

_CDR_BEGIN = b"\x00"
"""First byte of every plain message of ROS 2, but of no compressed message."""

_MOST_UNPACKED = 2**26
"""Size at which a batch of decompressed messages is closed, bytes."""

_File: TypeAlias = McapLog | SqliteBag


def files_of_bag_around(path: Path) -> tuple[str, ...]:
    """Return the names of all files of the bag around a file; () if no metadata lists the file."""
    try:
        with path.with_name(BAG_METADATA).open("rb") as stream:
            files = bag_metadata_from_bytes(stream.read(LARGEST_METADATA + 1)).files
    except (OSError, LogError):
        return ()
    return files if path.name in files else ()


class BagFolder(MessageReader):
    """A folder with the files of one ROS 2 bag."""

    kind = "ROS 2 bag"

    @cached_property
    def _metadata(self) -> BagMetadata | None:
        path = self._path / BAG_METADATA
        try:
            with path.open("rb") as stream:
                return bag_metadata_from_bytes(stream.read(LARGEST_METADATA + 1))
        except FileNotFoundError:
            fault = "is missing: its recorder was interrupted"
        except OSError as error:
            raise MissingFileError.of(path, error) from None
        except LogError as error:
            fault = f"cannot be used: {error}"
        self._faults.add(f"{self.name}: {BAG_METADATA} {fault}; the files in the folder were read without it")
        return None

    @cached_property
    def _files(self) -> tuple[_File, ...]:
        present_names = sorted(
            (entry.name for entry in self._path.iterdir() if entry.name.endswith(_ENDINGS)), key=_rank
        )
        listed_names = self._metadata.files if self._metadata else tuple(present_names)
        for name in listed_names:
            if not (self._path / name).is_file():
                self._faults.add(f"{self.name}: its file {name!r} is missing; what it holds is lost")
        for name in sorted(set(present_names) - set(listed_names)):
            self._remarks.add(
                f"{self.name}: the file {name!r} is not listed in {BAG_METADATA}; it was not read"
            )
        readers = [self._open(self._path / name) for name in listed_names if (self._path / name).is_file()]
        files = tuple(file for file in readers if file is not None)
        if not files:
            reason = next(iter(self._faults.take()), "it has no .db3 and no .mcap file")
            raise LogError(f"{self.name} is not a ROS 2 bag that can be read: {reason}")
        self._part_readers = files
        return files

    @cached_property
    def _unpacked_files(self) -> Path:
        return temporary_folder(self)

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        file_topics: list[Topic] = []
        for file in self._files:
            try:
                file_topics += file.topics()
            except LogError as error:
                self._faults.add(f"{self.name}: {error}")
        metadata = self._metadata
        topics = topics_by_name(file_topics, self._distribution)
        if metadata is None:
            return topics
        missing_names = metadata.counts.keys() - {topic.name for topic in file_topics}
        missing_topics = [
            Topic(
                name,
                metadata.types[name],
                "cdr",
                metadata.counts[name],
                unreadable=f"topic {name!r} is in none of the bag's files",
            )
            for name in missing_names
        ]
        counted_topics = [replace(topic, count=metadata.counts.get(topic.name, 0)) for topic in topics]
        return tuple(sorted([*counted_topics, *missing_topics], key=lambda topic: topic.name))

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        return min((file.start_ns for file in self._files if file.start_ns is not None), default=None)

    @property
    def _distribution(self) -> str | None:
        return self._metadata.distribution if self._metadata else None

    def topics(self) -> tuple[Topic, ...]:
        return self._topics

    def _read(self, topics: Collection[str], first_ns: int, end_ns: int, *, as_recorded: bool) -> Columns:
        def read(file_number: int, file: _File) -> Columns:
            # a place has the file's number from bit 48 on, the chunk's from bit 28 on, and the row below
            for columns_of_file in file.iter_columns(topics, first_ns, end_ns, as_recorded=as_recorded):
                file_place, first_channel = np.int64(file_number) << 48, self._first_channels[file_number]
                channel_numbers = first_channel + columns_of_file.channel
                yield replace(
                    columns_of_file,
                    channels=self._channels,
                    channel=channel_numbers,
                    place=file_place + columns_of_file.place,
                )

        openers = [partial(read, file_number, file) for file_number, file in enumerate(self._files)]
        if as_recorded or len(openers) == 1:
            merged: Columns = (columns_of_file for open_file in openers for columns_of_file in open_file())
        else:
            file_reads = zip(self._files, openers, strict=True)
            merged = merge_files((file.start_ns or 0, open_file) for file, open_file in file_reads)
        if self._metadata and self._metadata.compression == "message":
            return self._unpack_all(merged)
        return merged

    def _unpack_all(self, columns: Columns) -> Columns:
        """Decompress messages; remark once on each topic with plain messages."""
        plain_topics = set[str]()
        for packed_messages in columns:
            # in batches of bounded size after decompression
            begin = unpacked_bytes = 0
            for end, payload in enumerate(packed_messages.payloads, 1):
                unpacked_bytes += unpacked_size(payload)
                if unpacked_bytes >= _MOST_UNPACKED or end == len(packed_messages):
                    yield self._unpack(select(packed_messages, slice(begin, end)), plain_topics)
                    begin, unpacked_bytes = end, 0

    @cached_property
    def _declared(self) -> Mapping[int, Channel]:
        return dict(enumerate(channel for file in self._files for channel in file._channels.values()))

    def attachments(self) -> tuple[Attachment, ...]:
        return tuple(attachment for file in self._files for attachment in file.attachments())

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        return tuple(record for file in self._files for record in file.metadata())

    @cached_property
    def _first_channels(self) -> tuple[int, ...]:
        """Number of each file's first channel, if all files' channels are numbered from 0 on."""
        return tuple(accumulate((len(file._channels) for file in self._files[:-1]), initial=0))

    def _count(self, columns: Columns, topics: Collection[str], name: str | None = None) -> Columns:
        if self._metadata is None:
            # without metadata of the bag, the reader of each file compares the counts of its file
            return columns
        name = name or f"{self.name}/{BAG_METADATA}"
        for topic in self._topics:
            type_name = self._metadata.types.get(topic.name, topic.type)
            # recorders write both pkg/Type and pkg/msg/Type for a type
            if topic.name in topics and full_type_name(type_name) != full_type_name(topic.type):
                self._faults.add(
                    f"{name}: it declares messages of {type_name!r:.100} on {topic.name!r}; they are of"
                    f" {topic.type!r}"
                )
        return super()._count(columns, topics, name)

    def _open(self, path: Path) -> _File | None:
        """Open a file by its content; report an unreadable file as a fault, and return None."""
        try:
            with path.open("rb") as stream:
                first_bytes = stream.read(len(SQLITE_MAGIC))
            if first_bytes.startswith(ZSTD_MAGIC):
                unpacked_file, damage = unpack_file(path, self._unpacked_files)
                if damage:
                    self._faults.add(f"{self.name}: {damage}")
                return self._open(unpacked_file)
        except OSError as error:
            raise MissingFileError.of(path, error) from None
        except LogError as error:
            self._faults.add(f"{self.name}: {error}; what it holds is lost")
            return None
        if first_bytes == SQLITE_MAGIC:
            return SqliteBag(path)
        if first_bytes.startswith(MAGIC):
            return McapLog(path)
        self._faults.add(f"{self.name}: {path.name!r} is neither SQLite nor MCAP; what it holds is lost")
        return None

    def _unpack(self, packed: MessageColumns, plain_topics: set[str]) -> MessageColumns:
        payloads: list[bytes] = []
        indices: list[int] = []
        faults: dict[str, list[Sentence]] = {}
        for index, (topic, payload) in enumerate(zip(packed.topics, packed.payloads, strict=True)):
            instant = Instant(int(packed.log_time_ns[index]), 0)
            try:
                if not payload.startswith(_CDR_BEGIN):
                    payloads.append(decompress_message(payload))
                else:
                    payloads.append(payload)
                    if topic not in plain_topics:
                        plain_topics.add(topic)
                        self._remarks.add(
                            Sentence(
                                f"{self.name}: messages on {topic!r} are plain, the first at ",
                                Sentence(instant, f", although {BAG_METADATA} declares them as compressed"),
                                "; they are read as they are",
                            )
                        )
                indices.append(index)
            except LogError as error:
                faults.setdefault(topic, []).append(Sentence(f"on {topic!r} at ", instant, f": {error}"))
        for first_fault, *other_faults in faults.values():
            latest = Instant(int(packed.log_time_ns[-1]), 0)
            more = Sentence(f"; so are {len(other_faults)} more up to ", latest) if other_faults else ""
            self._faults.add(Sentence(f"{self.name}: ", first_fault, ", and is lost", more))
        return replace(select(packed, np.array(indices, np.int64)), payloads=payloads)


def _rank(name: str) -> tuple[str | int, ...]:
    """Return a key that sorts bag_10.db3 after bag_9.db3."""
    return tuple(int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", name)[:80])


READERS: dict[bytes, type[MessageReader]] = {BAG_MAGIC: Ros1Bag, SQLITE_MAGIC: SqliteBag, MAGIC: McapLog}
"""Readers by the first bytes of a file."""


def is_log(path: LogFile) -> bool:
    """Return whether a file or a folder looks like a log of messages.

    Raises:
        MissingFileError: there is no such file, or it cannot be opened.
    """
    first_bytes = _head(path)
    return first_bytes is None or any(first_bytes.startswith(magic) for magic in READERS)


def open_messages(path: LogFile) -> MessageReader:
    """Return a reader of the log in a file or a folder; the content decides, not the name.

    Raises:
        MissingFileError: there is no such file, or it cannot be opened.
        LogError: the file or folder is not a log of messages.
    """
    first_bytes = _head(path)
    if first_bytes is None and isinstance(path, Path):
        return BagFolder(path)
    for magic, reader in READERS.items():
        if first_bytes is not None and first_bytes.startswith(magic):
            return reader(path)
    raise LogError(f"{path.name} is neither a ROS bag nor an MCAP log")


def _head(path: LogFile) -> bytes | None:
    """Return the first bytes of a file; None for a folder.

    Raises:
        MissingFileError: there is no such file, or it cannot be opened.
    """
    try:
        if isinstance(path, Path) and path.is_dir():
            return None
        with open_file(path) as stream:
            return stream.read(len(SQLITE_MAGIC))
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None

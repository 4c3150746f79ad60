"""Records of an MCAP log: a chunk's content split into messages as columns, in one compiled pass."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from numpy.typing import NDArray

from spatial_replay.compiled import elementwise, long_kernel
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.payloads import Payloads

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of the body that follows."""

_Record = TypeVar("_Record")


class DamageError(Exception):
    """Bytes that are not what they should be. The text says what is wrong; the catcher knows where."""


def encoded(*several: records.McapRecord) -> bytes:
    """Encode records one after the other, each with its head."""
    builder = RecordBuilder()
    for record in several:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def decoded(read: Callable[[ReadDataStream], _Record], body: bytes) -> _Record:
    """Decode the record in a body.

    Raises:
        DamageError: the body is too short, or holds impossible lengths or texts that are not UTF-8.
    """
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise DamageError(f"a record cannot be read ({type(error).__name__}: {error})") from None


Bytes = NDArray[np.uint8]
Words = NDArray[np.uint64]

_RECORD_HEAD = RECORD_HEAD.size
MessageHeads: TypeAlias = np.ndarray[Any, np.dtype[np.void]]
"""(M,) with the fields channel, sequence, log_time and publish_time."""
_MESSAGE_FIELDS = np.dtype(
    [("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")]
)
_MESSAGE_BYTES = _MESSAGE_FIELDS.itemsize
_LAST_OF_LOG_TIME = 13
"""Where the highest byte of its log time is in a message."""
_SCHEMA, _CHANNEL, _MESSAGE = 3, 4, 5


class RecordHeads(NamedTuple):
    """N schemas, channels and messages.

    Attributes:
        opcode: (N,) int64.
        begin, end: (N,) int64, where their bodies are.
        channel, sequence, log_time, publish_time: (N,) uint64, of messages; 0 for other records.
    """

    opcode: Integers
    begin: Integers
    end: Integers
    channel: Words
    sequence: Words
    log_time: Words
    publish_time: Words


def walk_records(content: bytes) -> tuple[RecordHeads, bool]:
    """Return the schemas, channels and messages in some bytes, and whether the last record breaks off."""
    walk = _Walk(copies=False)
    end = walk.over(content, np.array([len(content)]), np.empty(0, np.uint8))
    fields = (walk.heads[name].astype(np.uint64) for name in _MESSAGE_FIELDS.names or ())
    return RecordHeads(*walk.places[:3].copy(), *fields), end < len(content)


class _Walk:
    """Walks over the records of chunks, some chunks after the other; its arrays serve for all of them.

    Attributes:
        count, declarations: how many records the last ones have, and how many of them are not messages.
        channel: the one of all its messages; -1 without any, -2 if they differ or have times beyond int64.
        payloads: theirs, one after the other in the first `used` bytes, if they are copied.
    """

    def __init__(self, *, copies: bool) -> None:
        """Begin; `copies` says whether payloads are copied."""
        self._copies = copies
        self._places = np.empty((5, 0), np.int64)
        self._heads = np.empty(0, np.uint8)
        self._state = np.zeros(6, np.int64)
        self.payloads = np.empty(0, np.uint8)
        self.count = self.used = self.declarations = 0
        self.channel = -1

    def over(self, content: bytes | memoryview, ends: Integers, passed_over: Bytes) -> int:
        """Walk over the records in some bytes; return where the last whole one ends.

        Args:
            ends: (C,) int64, where chunks end, in each of which the records must be whole.
            passed_over: by channel, 1 if its messages are not wanted.
        """
        view = np.frombuffer(content, np.uint8)
        if self._copies and len(self.payloads) < len(content):
            # the next chunk is about as large
            self.payloads = np.empty(len(content) + len(content) // 8, np.uint8)
        # room for as many records as there could be would be many times the bytes
        if (enough := len(content) // 128 + 32) > self._places.shape[1]:
            self._make_room(2 * enough)
        self._state[:] = 0, 0, 0, 0, 0, -1
        while True:
            _walk_on(view, ends, passed_over, self._state, self._places, self._heads, self.payloads)
            position, _, self.count, self.used, self.declarations, self.channel = self._state.tolist()
            if self.count < self._places.shape[1]:
                return int(position)
            self._make_room(2 * self.count)

    def _make_room(self, count: int) -> None:
        more = count - self._places.shape[1]
        self._places = np.concatenate([self._places, np.empty((5, more), np.int64)], axis=1)
        self._heads = np.concatenate([self._heads, np.empty(_MESSAGE_BYTES * more, np.uint8)])

    @property
    def places(self) -> Integers:
        """(5, N) int64: opcode, begin and end of each record; begin and end of its payload in `payloads`."""
        return self._places[:, : self.count]

    @property
    def heads(self) -> MessageHeads:
        """(N,) the heads of the records that are messages; those of others are 0."""
        heads = self._heads[: _MESSAGE_BYTES * self.count].copy().view(_MESSAGE_FIELDS)
        if self.declarations:
            heads[self._places[0, : self.count] != _MESSAGE] = 0
        return heads


@elementwise
@long_kernel
def _walk_on(
    content: Bytes,
    ends: Integers,
    passed_over: Bytes,
    state: Integers,
    places: Integers,
    heads: Bytes,
    payloads: Bytes,
) -> None:
    """Fill in the records from a position on that there is room for: where they are, heads and payloads.

    Args:
        state: position, chunk, records, bytes of payloads, declarations and the channel so far; see `_Walk`.
    """
    position, chunk, count, used, declarations, only = (
        state[0],
        state[1],
        state[2],
        state[3],
        state[4],
        state[5],
    )
    size = ends[chunk]
    while count < places.shape[1]:
        if position == size and chunk + 1 < ends.shape[0]:
            chunk += 1
            size = ends[chunk]
            continue
        if position + _RECORD_HEAD > size:
            break
        begin = position + _RECORD_HEAD
        # from the highest byte on, so that no length, however large, overflows
        length = 0
        for k in range(begin - 1, position, -1):
            length = min(256 * length + content[k], size)
        if length > size - begin:
            break
        end = begin + length
        opcode = content[position]
        is_taken = _SCHEMA <= opcode <= _CHANNEL
        before = used
        if is_taken:
            declarations += 1
        elif opcode == _MESSAGE and length >= _MESSAGE_BYTES:
            channel = content[begin] + 256 * content[begin + 1]
            is_taken = channel >= passed_over.shape[0] or passed_over[channel] == 0
            if is_taken:
                if only == -1:
                    only = channel
                if only != channel or content[begin + _LAST_OF_LOG_TIME] >= 128:
                    only = -2
                payload = begin + _MESSAGE_BYTES
                heads[_MESSAGE_BYTES * count : _MESSAGE_BYTES * (count + 1)] = content[begin:payload]
                if payloads.shape[0] > 0:
                    used += end - payload
                    payloads[before:used] = content[payload:end]
        if is_taken:
            places[0, count], places[1, count], places[2, count] = opcode, begin, end
            places[3, count], places[4, count] = before, used
            count += 1
        position = end
    state[0], state[1], state[2] = position, chunk, count
    state[3], state[4], state[5] = used, declarations, only


Declaration: TypeAlias = records.Schema | records.Channel


@dataclass(frozen=True, slots=True, eq=False)
class RawMessages:
    """M messages of chunks as columns.

    Attributes:
        heads: (M,) channel, sequence, log_time and publish_time.
        payloads: M encoded messages.
        channel: the one of all, if they are known to have one, and times below 2**63; else negative.
    """

    heads: MessageHeads
    payloads: Payloads
    channel: int = -2

    @classmethod
    def join(cls, several: Sequence[RawMessages]) -> RawMessages:
        """Join messages, one after the other."""
        heads = np.concatenate([np.empty(0, _MESSAGE_FIELDS), *(each.heads for each in several)])
        return cls(heads, Payloads.join([each.payloads for each in several]))

    def __len__(self) -> int:
        return len(self.heads)

    def take(self, chosen: Integers) -> RawMessages:
        """Return the messages with the given indices, in that order."""
        return RawMessages(self.heads[chosen], self.payloads.take(chosen))

    def compact(self) -> RawMessages:
        """Return the same messages in a buffer that holds nothing else."""
        return RawMessages(self.heads, Payloads.of(list(self.payloads)))

    def __getitem__(self, part: slice) -> RawMessages:
        return RawMessages(self.heads[part], self.payloads[part])


@dataclass(frozen=True, slots=True)
class Records:
    """The records of a chunk that a reader needs, in their order.

    Attributes:
        damage: why the chunk's end could not be read, or None.
    """

    messages: RawMessages
    declarations: Sequence[Declaration]
    damage: str | None = None


def split_records(content: bytes) -> Records:
    """Return the messages and declarations in decompressed records, up to where one breaks off."""
    return Splitter().split(content)


class Splitter:
    """Splits the records of chunks, some chunks after the other, as `split_records` does; for one thread."""

    def __init__(self, passed_over: Collection[int] = ()) -> None:
        """Begin.

        Args:
            passed_over: channels whose messages are not wanted.
        """
        self._passed_over = np.zeros(max(passed_over, default=-1) + 1, np.uint8)
        self._passed_over[list(passed_over)] = 1
        self._walk = _Walk(copies=True)

    def split(self, content: bytes | memoryview, sizes: Sequence[int] = ()) -> Records:
        """See `split_records`.

        Args:
            sizes: of the chunks that the content is made of; it is one chunk without.
        """
        walk = self._walk
        ends = np.cumsum(sizes or [len(content)])
        end = walk.over(content, ends, self._passed_over)
        damage = "a record breaks off" if end < len(content) else None
        heads, bounds = walk.heads, walk.places[3:].copy()
        declarations: list[Declaration] = []
        if walk.declarations:
            opcode, begin, stop = walk.places[:3].tolist()
            is_message = walk.places[0] == _MESSAGE
            for index in np.flatnonzero(~is_message).tolist():
                read = records.Schema.read if opcode[index] == Opcode.SCHEMA else records.Channel.read
                try:
                    declarations.append(decoded(read, bytes(content[begin[index] : stop[index]])))
                except DamageError as error:
                    damage = str(error)
                    is_message[index:] = False
                    break
            heads, bounds = heads[is_message], bounds[:, is_message]
        payloads = Payloads(walk.payloads[: walk.used].tobytes(), bounds[0], bounds[1])
        return Records(RawMessages(heads, payloads, walk.channel), declarations, damage)

"""Records of an MCAP log: a chunk's content split into messages as columns, in one compiled pass."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import accumulate
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from numpy.typing import NDArray

from spatial_replay.compiled import bytes_at, copying_kernel, elementwise, integers_at, long_kernel
from spatial_replay.geometry.arrays import Booleans, Integers
from spatial_replay.logs.payloads import Payloads

if TYPE_CHECKING:
    from spatial_replay.logs.objects.sample_columns import SampleColumns

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
_MOST_RECENT = 8
"""So many runs of declarations are remembered, which the next chunks may begin with, too."""


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
    walk = _Walk()
    end = walk.over(np.frombuffer(content, np.uint8), np.array([len(content)]), np.empty(0, np.uint8))
    opcode, begins, ends = walk.places.copy()
    heads = np.zeros(len(opcode), _MESSAGE_FIELDS)
    messages = np.flatnonzero(opcode == _MESSAGE)
    heads[messages] = _heads_at(np.frombuffer(content, np.uint8), begins[messages])
    fields = (heads[name].astype(np.uint64) for name in _MESSAGE_FIELDS.names or ())
    return RecordHeads(opcode, begins, ends, *fields), end < len(content)


def _heads_at(content: Bytes, begin: Integers) -> MessageHeads:
    """Return (n,) the heads of messages whose bodies begin at `begin`, (n,)."""
    rows = content[begin[:, None] + np.arange(_MESSAGE_BYTES)]
    return np.asarray(rows.view(_MESSAGE_FIELDS).reshape(-1))


class _Walk:
    """Walks over the records of chunks, some chunks after the other; its arrays serve for all of them.

    Attributes:
        count, declarations: how many records the last ones have, and how many of them are not messages.
        used: the size of the messages' payloads, in bytes.
        channel: the one of all messages; -1 without any, -2 if they differ or have times beyond int64.
    """

    def __init__(self) -> None:
        self._places = np.empty((3, 0), np.int64)
        self._state = np.zeros(6, np.int64)
        self.count = self.used = self.declarations = 0
        self.channel = -1

    def over(self, content: Bytes, ends: Integers, passed_over: Bytes, channel: int = -1) -> int:
        """Walk over the records in some bytes; return where the last whole one ends.

        Args:
            ends: (C,) int64, where chunks end, in each of which the records must be whole.
            passed_over: by channel, 1 if its messages are not wanted.
            channel: as the attribute, of messages before.
        """
        # room for as many records as there could be would be many times the bytes
        if (enough := len(content) // 128 + 32) > self._places.shape[1]:
            self._places = np.empty((3, 2 * enough), np.int64)
        self._state[:] = 0, 0, 0, 0, 0, channel
        while True:
            _walk_on(content, ends, passed_over, self._state, self._places)
            position, _, self.count, self.used, self.declarations, self.channel = self._state.tolist()
            if self.count < self._places.shape[1]:
                return int(position)
            more = np.empty((3, self.count), np.int64)
            self._places = np.concatenate([self._places, more], axis=1)

    @property
    def places(self) -> Integers:
        """(3, N) int64: opcode, begin and end of each record."""
        return self._places[:, : self.count]


@elementwise
@long_kernel
def _walk_on(content: Bytes, ends: Integers, passed_over: Bytes, state: Integers, places: Integers) -> None:
    """Fill in where the records from a position on are, as many as there is room for.

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
        length = high = 0
        for k in range(position + 4, position, -1):
            length = 256 * length + content[k]
        for k in range(position + 5, begin):
            high += content[k]
        # no content has 4 GiB
        if high > 0 or length > size - begin:
            break
        end = begin + length
        opcode = content[position]
        is_taken = _SCHEMA <= opcode <= _CHANNEL
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
                used += length - _MESSAGE_BYTES
        if is_taken:
            places[0, count], places[1, count], places[2, count] = opcode, begin, end
            count += 1
        position = end
    state[0], state[1], state[2] = position, chunk, count
    state[3], state[4], state[5] = used, declarations, only


def _copied_by_join(
    content: Bytes, places: Integers, heads: Bytes, payloads: Bytes, starts: Integers, first: int
) -> int:
    """See `_copy_messages`."""
    begin, end = places[1:, places[0] == _MESSAGE]
    count = first + len(begin)
    heads[_MESSAGE_BYTES * first : _MESSAGE_BYTES * count] = _heads_at(content, begin).view(np.uint8)
    view = content.data
    joined = b"".join(map(view.__getitem__, map(slice, (begin + _MESSAGE_BYTES).tolist(), end.tolist())))
    payloads[starts[first] : starts[first] + len(joined)] = np.frombuffer(joined, np.uint8)
    starts[first + 1 : count + 1] = starts[first] + np.cumsum(end - begin - _MESSAGE_BYTES)
    return count


@copying_kernel(_copied_by_join, times=1.0)
def _copy_messages(
    content: Bytes, places: Integers, heads: Bytes, payloads: Bytes, starts: Integers, first: int
) -> int:
    """Copy the heads and payloads of the messages among some records; return how many there are then.

    Args:
        content: where the records are, at `places` as `_Walk` has them.
        heads, payloads: where to, one after the other.
        starts: (m + 1,) int64, where payloads begin; that of the first is there already.
        first: how many messages there were before.
    """
    source, target, heads_at = content.ctypes.data, payloads.ctypes.data, heads.ctypes.data
    for record in range(places.shape[1]):
        if places[0, record] != _MESSAGE:
            continue
        at, head = source + places[1, record], heads_at + _MESSAGE_BYTES * first
        body, to = at + _MESSAGE_BYTES, target + starts[first]
        length = places[2, record] - places[1, record] - _MESSAGE_BYTES
        # 22 bytes, as three words of which the last two overlap
        integers_at(head, 2)[0] = integers_at(at, 2)[0]
        integers_at(head, 2)[1] = integers_at(at, 2)[1]
        integers_at(head + _MESSAGE_BYTES - 8, 1)[0] = integers_at(body - 8, 1)[0]
        words = length // 8
        for k in range(words):
            integers_at(to, words)[k] = integers_at(body, words)[k]
        for k in range(8 * words, length):
            bytes_at(to, length)[k] = bytes_at(body, length)[k]
        starts[first + 1] = starts[first] + length
        first += 1
    return first


Declaration: TypeAlias = records.Schema | records.Channel


@dataclass(frozen=True, slots=True, eq=False)
class RawMessages:
    """M messages of chunks as columns.

    Attributes:
        heads: (M,) channel, sequence, log_time and publish_time.
        buffers: M encoded messages, in one buffer or several, one after the other.
        channel: the one of all, if they are known to have one, and times below 2**63; else negative.
        samples: all of the messages that are samples, as columns, in the order of the messages; None where
            they are not.
    """

    heads: MessageHeads
    buffers: tuple[Payloads, ...]
    channel: int = -2
    samples: tuple[SampleColumns, ...] | None = None

    @classmethod
    def join(cls, several: Sequence[RawMessages]) -> RawMessages:
        """Join messages, one after the other."""
        heads = np.concatenate([np.empty(0, _MESSAGE_FIELDS), *(each.heads for each in several)])
        buffers = tuple(buffer for each in several for buffer in each.buffers)
        parts = [each.samples for each in several if len(each)]
        if None in parts:
            return cls(heads, buffers)
        return cls(heads, buffers, samples=tuple(part for each in parts for part in each or ()))

    @property
    def payloads(self) -> Payloads:
        """M encoded messages; several buffers are joined whenever it is asked for."""
        return self.buffers[0] if len(self.buffers) == 1 else Payloads.join(self.buffers)

    @property
    def buffer_bytes(self) -> int:
        """The size of the buffers."""
        return sum(len(each.data) for each in self.buffers)

    def __len__(self) -> int:
        return len(self.heads)

    def take(self, chosen: Integers) -> RawMessages:
        """Return the messages with the given indices, in that order."""
        return RawMessages(self.heads[chosen], (self.payloads.take(chosen),))

    def divided(self, count: int, chosen: Booleans) -> tuple[RawMessages, RawMessages]:
        """Return the first messages, and the others in a buffer that holds nothing else.

        Args:
            chosen: by channel, those of samples.
        """
        if count == len(self):
            return self, RawMessages.join([])
        first, rest = self.heads[:count], self.heads[count:]
        payloads = self.payloads
        samples = self.samples, self.samples
        if self.samples is not None:
            samples = _divided(self.samples, int(np.count_nonzero(chosen[first["channel"]])))
        return (
            RawMessages(first, (payloads[:count],), samples=samples[0]),
            RawMessages(rest, (Payloads.of(list(payloads[count:])),), samples=samples[1]),
        )


def _divided(
    columns: Sequence[SampleColumns], count: int
) -> tuple[tuple[SampleColumns, ...], tuple[SampleColumns, ...]]:
    first: list[SampleColumns] = []
    rest: list[SampleColumns] = []
    for each in columns:
        if own := min(count, len(each)):
            first.append(each[:own])
        if own < len(each):
            rest.append(each[own:])
        count -= own
    return tuple(first), tuple(rest)


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
        self._walk = _Walk()
        self._heads = np.empty(0, np.uint8)
        self._starts = np.zeros(1, np.int64)
        self._known: dict[tuple[int, int], list[tuple[bytes, Declaration]]] = {}
        self._recent = deque[tuple[bytes, list[Declaration]]](maxlen=_MOST_RECENT)
        self._begin(0)

    def _begin(self, size: int) -> None:
        self._size = size
        self._payloads = np.empty(0, np.uint8)
        self._count, self._channel = 0, -1
        self._declarations: list[Declaration] = []
        self._damage: str | None = None

    def split(self, content: bytes | memoryview) -> Records:
        """See `split_records`."""
        self._begin(len(content))
        self.add(content, [len(content)])
        return self.records()

    def begin(self, size: int) -> None:
        """Begin with other chunks, of so many bytes in all."""
        self._begin(size)

    def add(self, content: bytes | memoryview, sizes: Sequence[int]) -> bool:
        """Take in the next chunks, whose sizes are given; return whether all their records are sound."""
        walk, view = self._walk, np.frombuffer(content, np.uint8)
        end = walk.over(view, np.array(list(accumulate(sizes))), self._passed_over, self._channel)
        self._channel = walk.channel
        if end < len(content):
            self._damage = "a record breaks off"
        places = walk.places
        if walk.declarations:
            places = self._declared(content, places)
        self._make_room(places.shape[1], len(content))
        self._count = _copy_messages(view, places, self._heads, self._payloads, self._starts, self._count)
        return self._damage is None

    def records(self) -> Records:
        """Return the records that were taken in."""
        heads = self._heads[: _MESSAGE_BYTES * self._count].copy().view(_MESSAGE_FIELDS)
        starts = self._starts[: self._count + 1].copy()
        payloads = Payloads(self._payloads.data[: starts[-1]], starts[:-1], starts[1:])
        messages = RawMessages(heads, (payloads,), self._channel)
        return Records(messages, self._declarations, self._damage)

    def _declared(self, content: bytes | memoryview, places: Integers) -> Integers:
        """Take in the declarations among records; return the records before one that cannot be read."""
        others = np.flatnonzero(places[0] != _MESSAGE)
        opcodes, begins, ends = places[:, others].tolist()
        k, count = 0, len(opcodes)
        while k < count:
            # side by side, so that no message between them is kept with them
            after = k + 1
            while after < count and begins[after] - _RECORD_HEAD == ends[after - 1]:
                after += 1
            # many chunks begin with the same ones; comparing is quicker than a hash of a long schema
            block = bytes(content[begins[k] - _RECORD_HEAD : ends[after - 1]])
            found = next((each for known, each in self._recent if known == block), None)
            if found is None:
                found = self._decoded(
                    content, zip(*(each[k:after] for each in (opcodes, begins, ends)), strict=True)
                )
                if len(found) < after - k:
                    self._declarations += found
                    return places[:, : others[k + len(found)]]
                self._recent.append((block, found))
            self._declarations += found
            k = after
        return places

    def _decoded(
        self, content: bytes | memoryview, places: Iterable[tuple[int, int, int]]
    ) -> list[Declaration]:
        """Return the declarations in some places, up to one that cannot be read."""
        found: list[Declaration] = []
        for opcode, begin, end in places:
            body = bytes(content[begin:end])
            alike = self._known.setdefault((opcode, len(body)), [])
            known = next((each for known_body, each in alike if known_body == body), None)
            if known is None:
                read = records.Schema.read if opcode == Opcode.SCHEMA else records.Channel.read
                try:
                    known = decoded(read, body)
                except DamageError as error:
                    self._damage = str(error)
                    break
                alike.append((body, known))
            found.append(known)
        return found

    def _make_room(self, count: int, size: int) -> None:
        """Make room for some records more, of which the payloads are those of the walk."""
        if (most := self._count + count) >= len(self._starts):
            self._heads = _longer(self._heads, 2 * _MESSAGE_BYTES * most)
            self._starts = _longer(self._starts, 2 * most + 1)
        used = int(self._starts[self._count]) + self._walk.used
        if used > len(self._payloads):
            # those of the other chunks are about as large
            share = self._walk.used * self._size // max(size, 1)
            self._payloads = _longer(self._payloads, max(used, min(share + share // 16, self._size)))


_Number = TypeVar("_Number", bound=np.generic)


def _longer(array: NDArray[_Number], length: int) -> NDArray[_Number]:
    longer = np.empty(length, array.dtype)
    longer[: len(array)] = array
    return longer

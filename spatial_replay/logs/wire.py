"""Many messages of one layout at once.

In protobuf's encoding, numbers of a fixed width are at the same place in every message that has the same
fields, texts and list lengths. One message, encoded by the protobuf library, therefore is a template for all
of its layout. Only the slots differ; slots of many messages are filled or read together.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, TypeAlias, overload

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Booleans, Floats, Integers, combined_code, equal_places

Bytes: TypeAlias = NDArray[np.uint8]
Words: TypeAlias = NDArray[np.uint64]

# fields of one width for every number, so that a message keeps its length with other numbers in them
_WIDE = (FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FIXED64)
_NARROW = FieldDescriptor.TYPE_ENUM

# Two sets of sentinels that differ in every byte, and are finite as doubles: where two encodings differ,
# there is a slot.
_SENTINELS = ((0x40404040 << 32, 1), (0xBFBFBFBF << 32 | 0xFFFFFFFF, 2))


class LayoutError(ValueError):
    """A message that cannot serve as a template."""


@dataclass(frozen=True, eq=False)
class WireTemplate:
    """The layout that some messages share.

    Slots are numbered in the order of the fields. A word is a slot of 8 bytes, little-endian: a double or
    a fixed64. A mark is an enumeration with values from 1 to 127, a slot of one byte.

    Attributes:
        payload: (L,) uint8, an encoded message with every slot 0.
        word_offsets: (W,) int64, where the words begin.
        mark_offsets: (M,) int64, where the marks are.
    """

    payload: Bytes
    word_offsets: Integers
    mark_offsets: Integers

    @classmethod
    def of(cls, message: Message) -> WireTemplate:
        """Return the layout of a message; numbers that shall be slots must be present in it.

        Raises:
            LayoutError: a message with fields that the schema does not have.
        """
        first, second = (_encode(message, *sentinels) for sentinels in _SENTINELS)
        if len(first) != len(second):
            raise LayoutError("the message's length depends on its numbers")
        differing = np.flatnonzero(first != second)
        offsets = {8: list[int](), 1: list[int]()}
        begin = 0
        for width in _slot_widths(message):
            slot = differing[begin : begin + width]
            if len(slot) < width or slot[-1] - slot[0] != width - 1:
                raise LayoutError("the message's slots are not where its fields are")
            offsets[width].append(int(slot[0]))
            begin += width
        payload = first.copy()
        payload[differing] = 0
        return cls(payload, np.array(offsets[8], np.int64), np.array(offsets[1], np.int64))

    def __len__(self) -> int:
        return len(self.payload)

    @cached_property
    def fixed(self) -> Bytes:
        """(L,) uint8, 0 in all slots, 0xFF elsewhere."""
        fixed = np.full(len(self), 0xFF, np.uint8)
        fixed[self.mark_offsets] = 0
        for offset in self.word_offsets.tolist():
            fixed[offset : offset + 8] = 0
        return fixed

    def fill(self, words: Words, marks: Bytes | None = None) -> Bytes:
        """Encode n messages: words (n, W) and marks (n, M) → (n, L) uint8."""
        rows = np.empty((len(words), len(self)), np.uint8)
        # in the processor's cache the same rows are written twice in half the time
        step = max(1, _CACHED_BYTES // max(len(self), 1))
        for begin in range(0, len(rows), step):
            part, own_words = rows[begin : begin + step], words[begin : begin + step]
            part[:] = self.payload
            if words.size:
                # any 8 bytes of a row, as a word
                anywhere = np.ndarray((len(part), len(self) - 7), "<u8", part, 0, (len(self), 1))
                anywhere[:, self.word_offsets] = own_words
            if marks is not None:
                part[:, self.mark_offsets] = marks[begin : begin + step]
        return rows

    def encode(self, words: Words, marks: Bytes | None = None) -> Payloads:
        """Encode n messages as `fill` does."""
        return Payloads.from_rows(self.fill(words, marks))

    def matches(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return (n,) which of n encoded messages (n, L) have this layout."""
        return np.asarray(~((rows ^ self.payload) & self.fixed).any(axis=1))

    def words(self, rows: Bytes) -> Words:
        """Return (n, W) the words of n messages (n, L) of this layout."""
        if not self.word_offsets.size:
            return np.empty((len(rows), 0), np.uint64)
        anywhere = np.ndarray((len(rows), len(self) - 7), "<u8", rows, 0, (len(self), 1))
        return np.asarray(anywhere[:, self.word_offsets], np.uint64)


class Payloads(Sequence[bytes]):
    """M encoded messages as stretches of a few buffers. One becomes bytes only when it is asked for.

    Attributes:
        buffers: (B,) uint8 each.
        buffer: (M,) int64, the buffer that each message is in.
        start, size: (M,) int64, its place there and its length, in bytes.
    """

    __slots__ = ("buffer", "buffers", "size", "start")

    def __init__(self, buffers: Sequence[Bytes], buffer: Integers, start: Integers, size: Integers) -> None:
        self.buffers, self.buffer, self.start, self.size = tuple(buffers), buffer, start, size

    @classmethod
    def from_rows(cls, rows: Bytes) -> Payloads:
        """Return (n, L) uint8 as n messages."""
        count, length = rows.shape
        start = np.arange(count, dtype=np.int64) * length
        return cls((rows.reshape(-1),), np.zeros(count, np.int64), start, np.full(count, length))

    @classmethod
    def of(cls, payloads: Sequence[bytes]) -> Payloads:
        """Return messages as they are, or small ones joined and large ones each as a buffer."""
        if isinstance(payloads, Payloads):
            return payloads
        count = len(payloads)
        size = np.fromiter(map(len, payloads), np.int64, count)
        total = int(size.sum())
        if total > _LARGE_BYTES * count:
            buffers = [np.frombuffer(payload, np.uint8) for payload in payloads]
            return cls(buffers, np.arange(count), np.zeros(count, np.int64), size)
        joined = np.frombuffer(b"".join(payloads), np.uint8)
        return cls((joined,), np.zeros(count, np.int64), np.cumsum(size) - size, size)

    @classmethod
    def concatenate(cls, parts: Sequence[Sequence[bytes]]) -> Payloads:
        """Join messages, one part after the other. Small buffers become one, so that few remain."""
        groups = [cls.of(part) for part in parts if len(part)]
        small = [buffer for group in groups for buffer in group.buffers if len(buffer) < _JOINED_BYTES]
        buffers = [np.concatenate(small)] if small else []
        starts = iter(np.cumsum([0, *map(len, small)]).tolist())
        numbers, starts_of = list[int](), list[int]()
        for buffer in (buffer for group in groups for buffer in group.buffers):
            is_small = len(buffer) < _JOINED_BYTES
            numbers.append(0 if is_small else len(buffers))
            starts_of.append(next(starts) if is_small else 0)
            if not is_small:
                buffers.append(buffer)
        firsts = np.cumsum([0, *(len(group.buffers) for group in groups)]).tolist()
        old = [group.buffer + first for group, first in zip(groups, firsts, strict=False)]
        places = np.concatenate([np.empty(0, np.int64), *old])
        start = np.concatenate([np.empty(0, np.int64), *(group.start for group in groups)])
        size = np.concatenate([np.empty(0, np.int64), *(group.size for group in groups)])
        if not len(places):
            return cls((), places, start, size)
        return cls(buffers, np.array(numbers)[places], start + np.array(starts_of)[places], size)

    def __len__(self) -> int:
        return len(self.size)

    @overload
    def __getitem__(self, place: int) -> bytes: ...
    @overload
    def __getitem__(self, place: slice) -> Payloads: ...
    def __getitem__(self, place: int | slice) -> bytes | Payloads:
        """Return one message, or a stretch of them."""
        if isinstance(place, slice):
            return self.select(place)
        start = int(self.start[place])
        return bytes(self.buffers[self.buffer[place]][start : start + int(self.size[place])])

    @property
    def nbytes(self) -> int:
        """Size of the messages in bytes."""
        return int(self.size.sum())

    def select(self, places: Integers | slice) -> Payloads:
        """Return some messages, in the order given."""
        return Payloads(self.buffers, self.buffer[places], self.start[places], self.size[places])

    def without(self, is_empty: Booleans) -> Payloads:
        """Return the messages with nothing in some of them, (M,)."""
        return Payloads(self.buffers, self.buffer, self.start, np.where(is_empty, 0, self.size))

    def join(self, counts: Integers) -> Payloads:
        """Return (n,) messages, each joined from the next `counts` (n,) of these."""
        ends = np.append(0, np.cumsum(self.size))
        target = np.empty(ends[-1], np.uint8)
        self.copy_into(target, ends[:-1])
        edges = ends[np.append(0, np.cumsum(counts))]
        return Payloads((target,), np.zeros(len(counts), np.int64), edges[:-1], np.diff(edges))

    def copy_into(self, target: Bytes, starts: Integers) -> None:
        """Copy the messages into a buffer, each to its start there."""
        for places in equal_places(combined_code([self.buffer, self.size], len(self))):
            source, size = self.buffers[self.buffer[places[0]]], int(self.size[places[0]])
            if len(places) < _FEW:
                for begin, end in zip(self.start[places].tolist(), starts[places].tolist(), strict=True):
                    target[end : end + size] = source[begin : begin + size]
            elif size:
                step = max(1, _CACHED_BYTES // size)
                for begin in range(0, len(places), step):
                    some = places[begin : begin + step]
                    stretches(target, size)[starts[some]] = stretches(source, size)[self.start[some]]


def stretches(buffer: Bytes, size: int) -> NDArray[np.void]:
    """Return all stretches of some bytes in a buffer as a view: the element at a place begins there."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer, 0, (1,))


_CACHED_BYTES: Final = 2**17
"""Rows that are written to more than once at a time: half a processor core's cache."""
_LARGE_BYTES: Final = 2**12
"""Mean size of messages from which joining them costs more than a buffer each."""
_JOINED_BYTES: Final = 2**20
_FEW: Final = 4
"""Messages of one size that are copied one by one."""


def rows_of(payloads: Sequence[bytes]) -> Bytes:
    """Return n payloads of one length L as (n, L) uint8."""
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), -1)


def words_of(columns: Sequence[NDArray[Any]]) -> Words:
    """Return columns of 8-byte numbers, (n, k) each, side by side: (n, W)."""
    return np.concatenate([np.ascontiguousarray(column).view(np.uint64) for column in columns], axis=1)


def join_in_order(groups: Sequence[tuple[Integers, Payloads]]) -> Payloads:
    """Return messages in the order of their places, which are given for each group."""
    places = np.concatenate([np.empty(0, np.int64), *(places for places, _ in groups)])
    return Payloads.concatenate([payloads for _, payloads in groups]).select(np.argsort(places))


_POWERS = np.array([float(f"1e{digits}") for digits in range(20)])
_POWERS.flags.writeable = False


def round_numbers(numbers: Floats) -> Floats:
    """Return numbers with four digits, so that viewers print them short; very large and small ones stay."""
    size = np.abs(numbers)
    is_usual = (size >= 1e-15) & (size < 1e15)
    usual = np.where(is_usual, numbers, 1.0)
    digits = (3.0 - np.floor(np.log10(np.abs(usual)))).astype(np.int64)
    power = _POWERS[np.abs(digits)]
    # quotients and products of whole numbers, so that the result is the number nearest to those digits
    short_numbers = np.where(digits < 0, np.round(usual / power) * power, np.round(usual * power) / power)
    return np.where(is_usual, short_numbers, numbers)


def _encode(message: Message, word: int, mark: int) -> Bytes:
    """Encode a message with sentinels in all slots."""
    copy = type(message)()
    copy.CopyFrom(message)
    _write_sentinels(copy, word, mark)
    return np.frombuffer(copy.SerializeToString(deterministic=True), np.uint8)


def _write_sentinels(message: Message, word: int, mark: int) -> None:
    double = struct.unpack("<d", struct.pack("<Q", word))[0]
    values = {FieldDescriptor.TYPE_DOUBLE: double, FieldDescriptor.TYPE_FIXED64: word, _NARROW: mark}
    for field, value in message.ListFields():
        single = isinstance(value, Message | int | float)
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            for inner in (value,) if single else value:
                _write_sentinels(inner, word, mark)
        elif field.type in values and single:
            setattr(message, field.name, values[field.type])
        elif field.type in values:
            value[:] = [values[field.type]] * len(value)


def _slot_widths(message: Message) -> Iterator[int]:
    """Yield the widths in bytes of all slots, in the order in which the library encodes fields."""
    for field, value in message.ListFields():
        single = isinstance(value, Message | int | float)
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            for inner in (value,) if single else value:
                yield from _slot_widths(inner)
        elif field.type in (*_WIDE, _NARROW):
            yield from [1 if field.type == _NARROW else 8] * (1 if single else len(value))

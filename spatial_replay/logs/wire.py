"""Encode and decode many messages of one layout at once.

Messages with equal fields, texts and list lengths have a common layout: in protobuf, their numbers of fixed
width have equal offsets, the slots. One message, encoded by the protobuf library, is the template of its
layout. Other messages of a layout differ only in the slots, which are filled or read for many messages
together.
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

# field types of fixed width: their values do not change the length of a message
_WIDE = (FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FIXED64)
_NARROW = FieldDescriptor.TYPE_ENUM

# Two sets of sentinels that differ in every byte and are finite as doubles. A message is encoded with each
# set: the bytes that differ are its slots.
_SENTINELS = ((0x40404040 << 32, 1), (0xBFBFBFBF << 32 | 0xFFFFFFFF, 2))


class LayoutError(ValueError):
    """A message that cannot serve as a template."""


@dataclass(frozen=True, eq=False)
class WireTemplate:
    """Layout of messages that differ only in their slots.

    Slots are numbered in the order of the fields. A word is a slot of 8 bytes, little-endian: a double or
    a fixed64. A mark is an enumeration with values from 1 to 127, a slot of one byte.

    Attributes:
        payload: (L,) uint8, an encoded message with every slot 0.
        word_offsets: (W,) int64, offset of each word, bytes.
        mark_offsets: (M,) int64, offset of each mark, bytes.
    """

    payload: Bytes
    word_offsets: Integers
    mark_offsets: Integers

    @classmethod
    def of(cls, message: Message) -> WireTemplate:
        """Return the layout of a message. Each number that is present in the message becomes a slot.

        Raises:
            LayoutError: a message with fields that the schema does not have.
        """
        first_encoding, second_encoding = (_encode(message, *sentinels) for sentinels in _SENTINELS)
        if len(first_encoding) != len(second_encoding):
            raise LayoutError("the message's length depends on its numbers")
        slot_bytes = np.flatnonzero(first_encoding != second_encoding)
        offsets_by_width = {8: list[int](), 1: list[int]()}
        begin = 0
        for width in _slot_widths(message):
            slot = slot_bytes[begin : begin + width]
            if len(slot) < width or slot[-1] - slot[0] != width - 1:
                raise LayoutError("the message's slots are not where its fields are")
            offsets_by_width[width].append(int(slot[0]))
            begin += width
        payload = first_encoding.copy()
        payload[slot_bytes] = 0
        return cls(payload, np.array(offsets_by_width[8], np.int64), np.array(offsets_by_width[1], np.int64))

    def __len__(self) -> int:
        return len(self.payload)

    @cached_property
    def fixed(self) -> Bytes:
        """(L,) uint8, 0 in all slots, 0xFF elsewhere."""
        fixed_mask = np.full(len(self), 0xFF, np.uint8)
        fixed_mask[self.mark_offsets] = 0
        for offset in self.word_offsets.tolist():
            fixed_mask[offset : offset + 8] = 0
        return fixed_mask

    def fill(self, words: Words, marks: Bytes | None = None) -> Bytes:
        """Encode n messages: words (n, W) and marks (n, M) → (n, L) uint8."""
        rows = np.empty((len(words), len(self)), np.uint8)
        # rows are written twice, which takes half the time if they stay in the processor's cache
        batch_size = max(1, _CACHED_BYTES // max(len(self), 1))
        for begin in range(0, len(rows), batch_size):
            batch_rows, batch_words = rows[begin : begin + batch_size], words[begin : begin + batch_size]
            batch_rows[:] = self.payload
            if words.size:
                # a view of the 8 bytes from each offset of a row, since words are not aligned
                word_view = np.ndarray((len(batch_rows), len(self) - 7), "<u8", batch_rows, 0, (len(self), 1))
                word_view[:, self.word_offsets] = batch_words
            if marks is not None:
                batch_rows[:, self.mark_offsets] = marks[begin : begin + batch_size]
        return rows

    def encode(self, words: Words, marks: Bytes | None = None) -> Payloads:
        """Encode n messages as `fill` does."""
        return Payloads.from_rows(self.fill(words, marks))

    def matches(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return (n,) whether each of n encoded messages (n, L) has this layout."""
        # XOR is 0 where bytes are equal; `fixed` leaves out the slots
        return np.asarray(~((rows ^ self.payload) & self.fixed).any(axis=1))

    def words(self, rows: Bytes) -> Words:
        """Return (n, W) the words of n messages (n, L) of this layout."""
        if not self.word_offsets.size:
            return np.empty((len(rows), 0), np.uint64)
        word_view = np.ndarray((len(rows), len(self) - 7), "<u8", rows, 0, (len(self), 1))
        return np.asarray(word_view[:, self.word_offsets], np.uint64)


class Payloads(Sequence[bytes]):
    """M encoded messages as slices of a few buffers. A message is copied to bytes only on access.

    Attributes:
        buffers: uint8 arrays of any length.
        buffer: (M,) int64, index of each message's buffer.
        start, size: (M,) int64, offset in the buffer and length of each message, bytes.
    """

    __slots__ = ("buffer", "buffers", "size", "start")

    def __init__(self, buffers: Sequence[Bytes], buffer: Integers, start: Integers, size: Integers) -> None:
        self.buffers, self.buffer, self.start, self.size = tuple(buffers), buffer, start, size

    @classmethod
    def from_rows(cls, rows: Bytes) -> Payloads:
        """Return the rows (n, L) uint8 as n messages."""
        count, length = rows.shape
        starts = np.arange(count, dtype=np.int64) * length
        return cls((rows.reshape(-1),), np.zeros(count, np.int64), starts, np.full(count, length))

    @classmethod
    def of(cls, payloads: Sequence[bytes]) -> Payloads:
        """Convert messages. Messages are joined into one buffer, unless their mean size is large."""
        if isinstance(payloads, Payloads):
            return payloads
        message_count = len(payloads)
        sizes = np.fromiter(map(len, payloads), np.int64, message_count)
        total_bytes = int(sizes.sum())
        if total_bytes > _LARGE_BYTES * message_count:
            buffers = [np.frombuffer(payload, np.uint8) for payload in payloads]
            return cls(buffers, np.arange(message_count), np.zeros(message_count, np.int64), sizes)
        joined_buffer = np.frombuffer(b"".join(payloads), np.uint8)
        return cls((joined_buffer,), np.zeros(message_count, np.int64), np.cumsum(sizes) - sizes, sizes)

    @classmethod
    def concatenate(cls, parts: Sequence[Sequence[bytes]]) -> Payloads:
        """Concatenate messages. Small buffers are merged into one, to keep the number of buffers low."""
        groups = [cls.of(part) for part in parts if len(part)]
        small_buffers = [
            buffer for group in groups for buffer in group.buffers if len(buffer) < _JOINED_BYTES
        ]
        buffers = [np.concatenate(small_buffers)] if small_buffers else []
        small_starts = iter(np.cumsum([0, *map(len, small_buffers)]).tolist())
        new_indices, new_starts = list[int](), list[int]()
        for buffer in (buffer for group in groups for buffer in group.buffers):
            is_small = len(buffer) < _JOINED_BYTES
            new_indices.append(0 if is_small else len(buffers))
            new_starts.append(next(small_starts) if is_small else 0)
            if not is_small:
                buffers.append(buffer)
        first_indices = np.cumsum([0, *(len(group.buffers) for group in groups)]).tolist()
        group_indices = [
            group.buffer + first_index for group, first_index in zip(groups, first_indices, strict=False)
        ]
        old_indices = np.concatenate([np.empty(0, np.int64), *group_indices])
        starts = np.concatenate([np.empty(0, np.int64), *(group.start for group in groups)])
        sizes = np.concatenate([np.empty(0, np.int64), *(group.size for group in groups)])
        if not len(old_indices):
            return cls((), old_indices, starts, sizes)
        return cls(
            buffers, np.array(new_indices)[old_indices], starts + np.array(new_starts)[old_indices], sizes
        )

    def __len__(self) -> int:
        return len(self.size)

    @overload
    def __getitem__(self, place: int) -> bytes: ...
    @overload
    def __getitem__(self, place: slice) -> Payloads: ...
    def __getitem__(self, place: int | slice) -> bytes | Payloads:
        """Return one message, or a slice of the messages."""
        if isinstance(place, slice):
            return self.select(place)
        start = int(self.start[place])
        return bytes(self.buffers[self.buffer[place]][start : start + int(self.size[place])])

    @property
    def nbytes(self) -> int:
        """Size of the messages in bytes."""
        return int(self.size.sum())

    def select(self, places: Integers | slice) -> Payloads:
        """Return the messages at the given places."""
        return Payloads(self.buffers, self.buffer[places], self.start[places], self.size[places])

    def without(self, is_empty: Booleans) -> Payloads:
        """Replace the messages that `is_empty` (M,) marks by empty messages."""
        return Payloads(self.buffers, self.buffer, self.start, np.where(is_empty, 0, self.size))

    def join(self, counts: Integers) -> Payloads:
        """Join runs of consecutive messages; `counts` (n,) has the number of messages in each run."""
        message_ends = np.append(0, np.cumsum(self.size))
        joined_buffer = np.empty(message_ends[-1], np.uint8)
        self.copy_into(joined_buffer, message_ends[:-1])
        run_edges = message_ends[np.append(0, np.cumsum(counts))]
        return Payloads((joined_buffer,), np.zeros(len(counts), np.int64), run_edges[:-1], np.diff(run_edges))

    def copy_into(self, target: Bytes, starts: Integers) -> None:
        """Copy each message into a buffer, at its offset in `starts` (M,)."""
        for indices in equal_places(combined_code([self.buffer, self.size], len(self))):
            source, size = self.buffers[self.buffer[indices[0]]], int(self.size[indices[0]])
            if len(indices) < _FEW:
                for start, new_start in zip(
                    self.start[indices].tolist(), starts[indices].tolist(), strict=True
                ):
                    target[new_start : new_start + size] = source[start : start + size]
            elif size:
                batch_size = max(1, _CACHED_BYTES // size)
                for start in range(0, len(indices), batch_size):
                    batch = indices[start : start + batch_size]
                    # void elements copy whole messages, without an index for each byte
                    stretches(target, size)[starts[batch]] = stretches(source, size)[self.start[batch]]


def stretches(buffer: Bytes, size: int) -> NDArray[np.void]:
    """Return a view of all slices of `size` bytes; element i begins at byte i of the buffer."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer, 0, (1,))


_CACHED_BYTES: Final = 2**17
"""Size of the parts in which rows are written, bytes: half the cache of a processor core."""
_LARGE_BYTES: Final = 2**12
"""Mean message size, bytes, above which each message keeps a buffer, because joining would cost more."""
_JOINED_BYTES: Final = 2**20
"""Size below which buffers are merged, bytes."""
_FEW: Final = 4
"""Least number of messages of one size to copy together; fewer messages are copied one by one."""


def rows_of(payloads: Sequence[bytes]) -> Bytes:
    """Return n payloads of one length L as (n, L) uint8."""
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), -1)


def words_of(columns: Sequence[NDArray[Any]]) -> Words:
    """Concatenate columns of 8-byte numbers, (n, k) each, to words (n, W)."""
    return np.concatenate([np.ascontiguousarray(column).view(np.uint64) for column in columns], axis=1)


def join_in_order(groups: Sequence[tuple[Integers, Payloads]]) -> Payloads:
    """Join groups of messages, and sort the messages by their places; a group is (places, messages)."""
    places = np.concatenate([np.empty(0, np.int64), *(places for places, _ in groups)])
    return Payloads.concatenate([payloads for _, payloads in groups]).select(np.argsort(places))


_POWERS = np.array([float(f"1e{digits}") for digits in range(20)])
_POWERS.flags.writeable = False


def round_numbers(numbers: Floats) -> Floats:
    """Round numbers to four digits, which viewers print short.

    Numbers below 1e-15, and from 1e15 on, stay unchanged.
    """
    magnitudes = np.abs(numbers)
    is_usual = (magnitudes >= 1e-15) & (magnitudes < 1e15)
    usual = np.where(is_usual, numbers, 1.0)
    decimals = (3.0 - np.floor(np.log10(np.abs(usual)))).astype(np.int64)
    powers = _POWERS[np.abs(decimals)]
    # a product or quotient of integers is the double nearest to the decimal number
    short_numbers = np.where(
        decimals < 0, np.round(usual / powers) * powers, np.round(usual * powers) / powers
    )
    return np.where(is_usual, short_numbers, numbers)


def _encode(message: Message, word: int, mark: int) -> Bytes:
    """Encode a message with sentinels in all slots."""
    message_copy = type(message)()
    message_copy.CopyFrom(message)
    _write_sentinels(message_copy, word, mark)
    return np.frombuffer(message_copy.SerializeToString(deterministic=True), np.uint8)


def _write_sentinels(message: Message, word: int, mark: int) -> None:
    double = struct.unpack("<d", struct.pack("<Q", word))[0]
    sentinels = {FieldDescriptor.TYPE_DOUBLE: double, FieldDescriptor.TYPE_FIXED64: word, _NARROW: mark}
    for field, value in message.ListFields():
        is_single = isinstance(value, Message | int | float)
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            for submessage in (value,) if is_single else value:
                _write_sentinels(submessage, word, mark)
        elif field.type in sentinels and is_single:
            setattr(message, field.name, sentinels[field.type])
        elif field.type in sentinels:
            value[:] = [sentinels[field.type]] * len(value)


def _slot_widths(message: Message) -> Iterator[int]:
    """Yield the widths in bytes of all slots, in the order in which the library encodes fields."""
    for field, value in message.ListFields():
        is_single = isinstance(value, Message | int | float)
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            for submessage in (value,) if is_single else value:
                yield from _slot_widths(submessage)
        elif field.type in (*_WIDE, _NARROW):
            yield from [1 if field.type == _NARROW else 8] * (1 if is_single else len(value))

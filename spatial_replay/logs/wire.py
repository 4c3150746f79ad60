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
from typing import Any, TypeAlias

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers

Bytes: TypeAlias = NDArray[np.uint8]
Words: TypeAlias = NDArray[np.uint64]

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
        first, second = (_encoded(message, *sentinels) for sentinels in _SENTINELS)
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
        rows[:] = self.payload
        if words.size:
            # any 8 bytes of a row, as a word
            anywhere = np.ndarray((len(words), len(self) - 7), "<u8", rows, 0, (len(self), 1))
            anywhere[:, self.word_offsets] = words
        if marks is not None:
            rows[:, self.mark_offsets] = marks
        return rows

    def encode(self, words: Words, marks: Bytes | None = None) -> list[bytes]:
        """Encode n messages as `fill` does, each by itself."""
        return payloads_of(self.fill(words, marks))

    def matches(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return (n,) which of n encoded messages (n, L) have this layout."""
        return np.asarray(~((rows ^ self.payload) & self.fixed).any(axis=1))

    def words(self, rows: Bytes) -> Words:
        """Return (n, W) the words of n messages (n, L) of this layout."""
        if not self.word_offsets.size:
            return np.empty((len(rows), 0), np.uint64)
        anywhere = np.ndarray((len(rows), len(self) - 7), "<u8", rows, 0, (len(self), 1))
        return np.asarray(anywhere[:, self.word_offsets], np.uint64)


def rows_of(payloads: Sequence[bytes]) -> Bytes:
    """Return n payloads of one length L as (n, L) uint8."""
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), -1)


def payloads_of(rows: Bytes) -> list[bytes]:
    """Return (n, L) uint8 as n payloads."""
    count, length = rows.shape
    if not length:
        return [b""] * count
    joined = rows.tobytes()
    return [joined[begin : begin + length] for begin in range(0, count * length, length)]


def words_of(columns: Sequence[NDArray[Any]]) -> Words:
    """Return columns of 8-byte numbers, (n, k) each, side by side: (n, W)."""
    return np.concatenate([np.ascontiguousarray(each).view(np.uint64) for each in columns], axis=1)


def placed(count: int, groups: Sequence[tuple[Integers, Sequence[bytes]]]) -> list[bytes]:
    """Return messages by their places among `count`, each group with its own places."""
    payloads = [b""] * count
    for places, own in groups:
        for place, payload in zip(places.tolist(), own, strict=True):
            payloads[place] = payload
    return payloads


_POWERS = np.array([float(f"1e{digits}") for digits in range(20)])
_POWERS.flags.writeable = False


def rounded(numbers: Floats) -> Floats:
    """Return numbers with four digits, so that viewers print them short; very large and small ones stay."""
    size = np.abs(numbers)
    is_usual = (size >= 1e-15) & (size < 1e15)
    usual = np.where(is_usual, numbers, 1.0)
    digits = (3.0 - np.floor(np.log10(np.abs(usual)))).astype(np.int64)
    power = _POWERS[np.abs(digits)]
    # quotients and products of whole numbers, so that the result is the number nearest to those digits
    shown = np.where(digits < 0, np.round(usual / power) * power, np.round(usual * power) / power)
    return np.where(is_usual, shown, numbers)


def _encoded(message: Message, word: int, mark: int) -> Bytes:
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

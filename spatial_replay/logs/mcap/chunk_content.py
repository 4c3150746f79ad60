"""Messages laid out as the records of chunks, in one compiled pass.

Other threads run during that pass: compression, reading and evaluation wait for the interpreter often enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from spatial_replay.compiled import (
    bytes_at,
    copying_kernel,
    integers_at,
    kernel,
    merged,
)
from spatial_replay.geometry.arrays import Integers, equal_places, starts_from_counts
from spatial_replay.logs.mcap.chunk_records import RECORD_HEAD
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.payloads import Bytes, Filled, MixedPayloads, Part, Payloads, columns_of

_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_HEAD: Final = _MESSAGE.itemsize
INDEX_HEAD: Final = 15
INDEX_ENTRY: Final = 16
"""Bytes of a record that indexes the messages of a channel, without its entries, and of one of these."""
_MESSAGE_INDEX: Final = int(Opcode.MESSAGE_INDEX)
_NONE: Final = np.empty(0, np.int64)


class _Parts(NamedTuple):
    """The parts of payloads as kernels take them.

    Attributes:
        table: (P, 10) int64, of each part what `_FILLED` and `_BUFFERED` say, by addresses.
        slots: (S, 2) int64, of all templates: where a word is in a message, and which one of its part it is.
        marked: (K,) int64, of all templates: where marks are.
        listed: numbers of the parts that are lists of messages, which kernels leave out.
        kept: what is at the addresses.
    """

    table: Integers
    slots: Integers
    marked: Integers
    listed: list[int]
    kept: list[object]

    @classmethod
    def of(cls, parts: Sequence[Part]) -> _Parts:
        """Return the parts of some payloads."""
        table = np.zeros((len(parts), _COLUMNS), np.int64)
        slots, marked = [np.empty((0, 2), np.int64)], [_NONE]
        slot = mark = 0
        listed, kept = list[int](), list[object]()
        for row, part in zip(table, parts, strict=True):
            if isinstance(part, Filled):
                template = part.template
                pattern = np.frombuffer(template.pattern, np.uint8)
                words, marks = np.ascontiguousarray(part.words), np.ascontiguousarray(part.marks)
                offsets = template.word_offsets
                order = np.arange(len(offsets)) if part.order is None else part.order
                row[: _MARKS + 1] = (
                    _FILLED,
                    _at(pattern),
                    len(pattern),
                    _at(words),
                    words.shape[1],
                    _at(marks),
                )
                row[_MARKS + 1 :] = slot, slot + len(offsets), mark, mark + marks.shape[1]
                slots.append(np.stack([offsets, order], axis=1))
                marked.append(template.mark_offsets)
                slot, mark = slot + len(offsets), mark + marks.shape[1]
                kept += [template, pattern, words, marks]
            elif isinstance(part, Payloads):
                data = np.frombuffer(part.data, np.uint8)
                begin, end = np.ascontiguousarray(part.begin), np.ascontiguousarray(part.end)
                row[: _END + 1] = _BUFFERED, _at(data), _at(begin), _at(end)
                kept += [data, begin, end]
            else:
                row[_KIND] = _LISTED
        listed = np.flatnonzero(table[:, _KIND] == _LISTED).tolist()
        return cls(table, np.concatenate(slots), np.concatenate(marked), listed, kept)


_KIND, _PATTERN, _LENGTH, _WORDS, _WIDTH, _MARKS, _SLOT, _LAST_SLOT, _MARK, _LAST_MARK = range(10)
_COLUMNS: Final = 10
_FILLED: Final = 0
"""A part of one template: its pattern and how long that is, words (n, N) and N, marks (n, K), and which of
all slots and marked places are its own."""
_DATA, _BEGIN, _END = 1, 2, 3
_BUFFERED: Final = 1
"""A part in a buffer: this, and where its messages begin and end."""
_LISTED: Final = 2


def _at(array: NDArray[Any]) -> int:
    return array.ctypes.data


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Messages as records.

    Attributes:
        heads: (M, 31), the encoded heads.
        payloads: what follows them.
        parts: those of the payloads.
        start: (M + 1,) int64, where each begins and the last one ends, side by side.
        times_ns: (M,) int64, their log times.
        numbers: (M,) int64, the numbers of their channels; and as a list `channels`.
    """

    heads: Bytes
    payloads: MixedPayloads
    parts: _Parts
    start: Integers
    times_ns: Integers
    numbers: Integers
    channels: list[int]

    def __len__(self) -> int:
        return len(self.heads)

    @classmethod
    def of(cls, messages: Messages, numbers: Integers) -> Batch:
        """Return messages as records, with channel numbers (M,)."""
        payloads = columns_of(messages.payloads)
        sizes = payloads.sizes
        heads = np.zeros(len(payloads), _MESSAGE)
        heads["opcode"] = Opcode.MESSAGE
        heads["length"] = sizes + (_HEAD - RECORD_HEAD.size)
        heads["channel"] = numbers
        heads["sequence"] = messages.sequence
        heads["log_time"] = messages.log_time_ns
        heads["publish_time"] = messages.publish_time_ns
        encoded = heads.view(np.uint8).reshape(len(heads), _HEAD)
        start, parts = starts_from_counts(sizes + _HEAD), _Parts.of(payloads.parts)
        return cls(encoded, payloads, parts, start, messages.log_time_ns, numbers, numbers.tolist())


@dataclass(frozen=True, slots=True, eq=False)
class MessageRange:
    """The messages of a batch from `begin` up to, not including, `stop`."""

    batch: Batch
    begin: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.begin

    @property
    def size(self) -> int:
        """How many bytes its records have."""
        return int(self.batch.start[self.stop] - self.batch.start[self.begin])

    @property
    def channels(self) -> set[int]:
        """The numbers of the channels with messages in it."""
        return set(self.batch.channels[self.begin : self.stop])

    @property
    def start_ns(self) -> int:
        """Log time of its first message."""
        return int(self.batch.times_ns[self.begin])


class OpenChunk(NamedTuple):
    """A chunk to be packed.

    Attributes:
        ranges: its messages, at least one.
        message_bytes: how many bytes their records have.
        declaring: the declarations that it begins with.
        is_own: whether the messages are ours, and so each much like the one before.
    """

    ranges: Sequence[MessageRange]
    message_bytes: int
    declaring: bytes
    is_own: bool

    @property
    def size(self) -> int:
        """How many bytes its content has."""
        return len(self.declaring) + self.message_bytes


class LaidOut(NamedTuple):
    """The contents of C chunks in one buffer.

    Attributes:
        begin: (C + 1,) int64, where each begins and the last one ends.
        low_ns, high_ns: (C,) int64, log times of the first and the last message.
        counts: (C, K) int64, how many messages of each channel there are.
        indexes: the records that index the messages, by chunk and channel.
        index_begin: (C + 1,) int64, where those of each chunk begin and the last ones end.
    """

    begin: Integers
    low_ns: Integers
    high_ns: Integers
    counts: Integers
    indexes: memoryview
    index_begin: Integers


def lay_out(chunks: Sequence[OpenChunk], content: memoryview) -> LaidOut:
    """Write the content of chunks, one after the other, into a buffer of their size."""
    begin = starts_from_counts([chunk.size for chunk in chunks])
    ranges: list[MessageRange] = []
    shifts: list[int] = []
    for chunk, place in zip(chunks, begin.tolist(), strict=False):
        content[place : place + len(chunk.declaring)] = chunk.declaring
        place += len(chunk.declaring)
        for each in chunk.ranges:
            ranges.append(each)
            shifts.append(place - int(each.batch.start[each.begin]))
            place += each.size
    starts = [
        _written(content, ranges[first:last], shifts[first:last]) for first, last in _of_one_batch(ranges)
    ]
    first = starts_from_counts([sum(map(len, chunk.ranges)) for chunk in chunks])
    numbers = np.concatenate([each.batch.numbers[each.begin : each.stop] for each in ranges])
    times_ns = np.concatenate([each.batch.times_ns[each.begin : each.stop] for each in ranges])
    counts = np.zeros((len(chunks), int(numbers.max()) + 1), np.int64)
    low_ns, high_ns = np.empty(len(chunks), np.int64), np.empty(len(chunks), np.int64)
    index = bytearray(INDEX_ENTRY * len(numbers) + INDEX_HEAD * min(counts.size, len(numbers)) + 8)
    # every 8 bytes of it as a word, at whatever place they begin
    words = np.ndarray((len(index) - 7,), np.int64, index, 0, (1,))
    index_begin, cursor = np.zeros(len(begin), np.int64), np.empty(counts.shape[1], np.int64)
    chunks_of = first, begin, index_begin, low_ns, high_ns
    _index(*chunks_of, np.concatenate(starts), numbers, times_ns, counts, cursor, words)
    return LaidOut(begin, low_ns, high_ns, counts, memoryview(index), index_begin)


def _of_one_batch(ranges: Sequence[MessageRange]) -> list[tuple[int, int]]:
    """Return where ranges begin and end that follow each other in one batch: those are written together."""
    edges = [
        at
        for at, (before, after) in enumerate(pairwise(ranges), 1)
        if before.batch is not after.batch or before.stop != after.begin
    ]
    return list(pairwise([0, *edges, len(ranges)]))


def _written(content: memoryview, ranges: Sequence[MessageRange], shifts: Sequence[int]) -> Integers:
    """Write the records of ranges that follow each other in one batch; return where they begin (m,).

    Args:
        shifts: of each range, how far its records are from where the batch has them.
    """
    batch, own = ranges[0].batch, slice(ranges[0].begin, ranges[-1].stop)
    start = batch.start[own] + np.repeat(np.array(shifts, np.int64), [len(each) for each in ranges])
    payloads, parts = batch.payloads, batch.parts
    part, row = payloads.part[own], payloads.row[own]
    for number in parts.listed:
        for message in np.flatnonzero(part == number).tolist():
            payload, place = payloads[own.start + message], int(start[message]) + _HEAD
            content[place : place + len(payload)] = payload
    content_at, heads_at = _at(np.frombuffer(content, np.uint8)), _at(batch.heads[own])
    _write(content_at, len(content), heads_at, start, part, row, parts.table, parts.slots, parts.marked)
    return start


def _write_by_part(
    content_at: int,
    size: int,
    heads_at: int,
    start: Integers,
    part: Integers,
    row: Integers,
    table: Integers,
    slots: Integers,
    marked: Integers,
) -> None:
    """Do what `_write` does, the messages of a part together."""
    content = bytes_at(content_at, size)
    content[start[:, None] + np.arange(_HEAD)] = bytes_at(heads_at, _HEAD * len(start)).reshape(-1, _HEAD)
    for places in equal_places(part):
        about, rows, begin = table[part[places[0]]].tolist(), row[places], start[places] + _HEAD
        most = int(rows.max()) + 1
        if about[_KIND] == _FILLED:
            encoded = np.empty((len(rows), about[_LENGTH]), np.uint8)
            encoded[:] = bytes_at(about[_PATTERN], about[_LENGTH])
            if about[_SLOT] < about[_LAST_SLOT]:
                words = integers_at(about[_WORDS], most * about[_WIDTH]).reshape(most, -1)
                offsets, order = slots[about[_SLOT] : about[_LAST_SLOT]].T
                shape = len(rows), about[_LENGTH] - 7
                anywhere = np.ndarray(shape, np.int64, encoded, 0, (about[_LENGTH], 1))
                anywhere[:, offsets] = words[rows][:, order]
            if about[_MARK] < about[_LAST_MARK]:
                marks = bytes_at(about[_MARKS], most * (about[_LAST_MARK] - about[_MARK])).reshape(most, -1)
                encoded[:, marked[about[_MARK] : about[_LAST_MARK]]] = marks[rows]
            content[begin[:, None] + np.arange(about[_LENGTH])] = encoded
        elif about[_KIND] == _BUFFERED:
            first, last = integers_at(about[_BEGIN], most)[rows], integers_at(about[_END], most)[rows]
            data = bytes_at(about[_DATA], int(last.max()))
            for place, low, high in zip(begin.tolist(), first.tolist(), last.tolist(), strict=True):
                content[place : place + high - low] = data[low:high]


@copying_kernel(_write_by_part)
def _write(
    content_at: int,
    size: int,
    heads_at: int,
    start: Integers,
    part: Integers,
    row: Integers,
    table: Integers,
    slots: Integers,
    marked: Integers,
) -> None:
    """Write records: heads (m, 31), side by side, at `start` (m,), and payloads, as `_Parts` has them.

    Args:
        content_at, size: where the content is, and how many bytes there are.
        heads_at: where the heads are.
    """
    for i in range(start.shape[0]):
        at = content_at + start[i]
        _copy(at, heads_at + i * _HEAD, _HEAD)
        at += _HEAD
        about, r = table[part[i]], row[i]
        if about[_KIND] == _FILLED:
            _copy(at, about[_PATTERN], about[_LENGTH])
            words = integers_at(about[_WORDS] + 8 * about[_WIDTH] * r, about[_WIDTH])
            for k in range(about[_SLOT], about[_LAST_SLOT]):
                integers_at(at + slots[k, 0], 1)[0] = words[slots[k, 1]]
            count = about[_LAST_MARK] - about[_MARK]
            marks = bytes_at(about[_MARKS] + count * r, count)
            for k in range(count):
                bytes_at(at + marked[about[_MARK] + k], 1)[0] = marks[k]
        elif about[_KIND] == _BUFFERED:
            begin, end = integers_at(about[_BEGIN] + 8 * r, 1)[0], integers_at(about[_END] + 8 * r, 1)[0]
            _copy(at, about[_DATA] + begin, end - begin)


@merged
def _copy(target_at: int, source_at: int, size: int) -> None:
    """Copy bytes between addresses, eight at a time, the last eight once more if need be."""
    if size < 8:
        some, others = bytes_at(target_at, size), bytes_at(source_at, size)
        for k in range(size):
            some[k] = others[k]
        return
    target, source = integers_at(target_at, size // 8), integers_at(source_at, size // 8)
    for k in range(size // 8):
        target[k] = source[k]
    integers_at(target_at + size - 8, 1)[0] = integers_at(source_at + size - 8, 1)[0]


@kernel
def _index(
    first: Integers,
    begin: Integers,
    index_begin: Integers,
    low_ns: Integers,
    high_ns: Integers,
    start: Integers,
    numbers: Integers,
    times_ns: Integers,
    counts: Integers,
    cursor: Integers,
    words: Integers,
) -> None:
    """Fill in bounds of times, counts and the index, as `LaidOut` has them.

    Args:
        first: (C + 1,) where the messages of each chunk begin.
        begin: (C + 1,) where its content begins.
        start: (M,) where each message's record begins.
        cursor: (K,), used while it runs.
        words: the index, every 8 bytes of it.
    """
    for c in range(first.shape[0] - 1):
        low_ns[c] = high_ns[c] = times_ns[first[c]]
        for i in range(first[c], first[c + 1]):
            counts[c, numbers[i]] += 1
            low_ns[c], high_ns[c] = min(low_ns[c], times_ns[i]), max(high_ns[c], times_ns[i])
        at = index_begin[c]
        for k in range(counts.shape[1]):
            if counts[c, k] > 0:
                size = INDEX_ENTRY * counts[c, k]
                # opcode, length, channel, size: each word overwrites what the one before has too much
                words[at] = _MESSAGE_INDEX
                words[at + 1] = size + 6
                words[at + 9] = k | size << 16
                cursor[k] = at + INDEX_HEAD
                at += INDEX_HEAD + size
        index_begin[c + 1] = at
        for i in range(first[c], first[c + 1]):
            at = cursor[numbers[i]]
            words[at] = times_ns[i]
            words[at + 8] = start[i] - begin[c]
            cursor[numbers[i]] = at + INDEX_ENTRY

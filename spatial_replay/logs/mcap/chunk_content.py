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

from spatial_replay.compiled import copying_kernel, elementwise, kernel, merged
from spatial_replay.geometry.arrays import Integers, equal_places, starts_from_counts
from spatial_replay.logs.mcap.chunk_records import RECORD_HEAD
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.payloads import Bytes, Filled, MixedPayloads, Payloads, Words, columns_of

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
_NONE: Final = np.empty(0, np.int64)
_PADDING: Final = bytes(9)
"""Makes two words or more of a buffer that is nearly empty, so that kernels are compiled for one layout."""


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Messages as records.

    Attributes:
        heads: (M, 31), the encoded heads.
        payloads: what follows them.
        start: (M + 1,) int64, where each begins and the last one ends, side by side.
        times_ns: (M,) int64, their log times.
        numbers: (M,) int64, the numbers of their channels; and as a list `channels`.
    """

    heads: Bytes
    payloads: MixedPayloads
    start: Integers
    times_ns: Integers
    numbers: Integers
    channels: list[int]

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
        start = starts_from_counts(sizes + _HEAD)
        return cls(encoded, payloads, start, messages.log_time_ns, numbers, numbers.tolist())


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
    """A chunk to be packed: its messages, at least one, and the declarations that it begins with."""

    ranges: Sequence[MessageRange]
    declaring: bytes

    @property
    def size(self) -> int:
        """How many bytes its content has."""
        return len(self.declaring) + sum(each.size for each in self.ranges)


class LaidOut(NamedTuple):
    """The contents of C chunks in one buffer.

    Attributes:
        begin: (C + 1,) int64, where each begins and the last one ends.
        low_ns, high_ns: (C,) int64, log times of the first and the last message.
        entries: (M, 2) int64, the time and the place in its chunk of each message, by chunk and channel.
        counts: (C, K) int64, how many messages of each channel there are.
    """

    begin: Integers
    low_ns: Integers
    high_ns: Integers
    entries: Integers
    counts: Integers


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
    entries = np.empty((len(numbers), 2), np.int64)
    _index(first, begin, np.concatenate(starts), numbers, times_ns, counts, low_ns, high_ns, entries)
    return LaidOut(begin, low_ns, high_ns, entries, counts)


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
    payloads = batch.payloads
    part, row, begin = payloads.part[own], payloads.row[own], start + _HEAD
    filled: list[tuple[Integers, Filled, Integers]] = []
    columns = _columns(_PADDING, _NONE, _NONE, _NONE)
    for places in equal_places(part):
        of_part, rows = payloads.parts[part[places[0]]], row[places]
        if isinstance(of_part, Filled):
            filled.append((begin[places], of_part, rows))
        elif isinstance(of_part, Payloads) and not len(columns.place):
            columns = _columns(of_part.data, of_part.begin[rows], of_part.end[rows], begin[places])
        else:
            for place, each in zip(begin[places].tolist(), rows.tolist(), strict=True):
                payload = of_part[each]
                content[place : place + len(payload)] = payload
    heads = batch.heads[own].reshape(-1)
    target = np.frombuffer(content, np.uint8)
    _write(target, _words(content), start, heads, _words(heads), columns, _joined(filled))
    return start


class _Columns(NamedTuple):
    """Payloads in a buffer, from `begin` (m,) to `end` (m,), and the places (m,) that they are copied to."""

    data: Bytes
    words: Words
    begin: Integers
    end: Integers
    place: Integers


class _Templates(NamedTuple):
    """Payloads of T templates, those of one template together.

    Attributes:
        place: (n,) where they are written; those of a template are from `first` (T + 1,) on.
        pattern, pattern_words, offsets, marked: of all templates, from `pattern_start`, `offsets_start` and
            `marked_start` (T + 1,) on: their bytes, and where words and marks are in them.
        words, marks: to be filled in, message by message.
    """

    place: Integers
    first: Integers
    pattern: Bytes
    pattern_words: Words
    pattern_start: Integers
    offsets: Integers
    offsets_start: Integers
    marked: Integers
    marked_start: Integers
    words: Words
    marks: Bytes


def _joined(filled: Sequence[tuple[Integers, Filled, Integers]]) -> _Templates:
    """Join what is to be filled in: places, messages of a template, and which of them."""
    templates = [each.template for _, each, _ in filled]
    words = np.empty(sum(len(rows) * len(each.template.word_offsets) for _, each, rows in filled), np.uint64)
    marks = np.empty(sum(len(rows) * each.marks.shape[1] for _, each, rows in filled), np.uint8)
    word = mark = 0
    for _, each, rows in filled:
        word = _take_words(each, rows, words, word)
        mark = _take(each.marks, rows, marks, mark)
    pattern = np.frombuffer(bytearray().join([*(each.pattern for each in templates), _PADDING]), np.uint8)
    return _Templates(
        np.concatenate([_NONE, *(places for places, _, _ in filled)]),
        starts_from_counts([len(places) for places, _, _ in filled]),
        pattern,
        _words(pattern),
        starts_from_counts(list(map(len, templates))),
        np.concatenate([_NONE, *(each.word_offsets for each in templates)]),
        starts_from_counts([len(each.word_offsets) for each in templates]),
        np.concatenate([_NONE, *(each.mark_offsets for each in templates)]),
        starts_from_counts([len(each.mark_offsets) for each in templates]),
        words,
        marks,
    )


def _take_words(filled: Filled, rows: Integers, joined: Words, begin: int) -> int:
    """Copy the words of some messages, one after the other; return where they end."""
    if filled.order is None:
        return _take(filled.words, rows, joined, begin)
    end = begin + len(filled.order) * len(rows)
    target = joined[begin:end].reshape(len(rows), -1)
    np.take(filled.words[rows], filled.order, axis=1, out=target, mode="clip")
    return end


def _take(columns: NDArray[Any], rows: Integers, joined: NDArray[Any], begin: int) -> int:
    """Copy rows, one after the other; return where they end."""
    end = begin + columns[:1].size * len(rows)
    # whatever the mode, rows are within bounds; only this one fills the target at once
    np.take(columns, rows, axis=0, out=joined[begin:end].reshape(len(rows), -1), mode="clip")
    return end


def _columns(data: bytes, begin: Integers, end: Integers, place: Integers) -> _Columns:
    view = np.frombuffer(data.ljust(len(_PADDING), b"\0"), np.uint8)
    # one kind of array, whatever the buffer is: a kernel is compiled for each
    view.flags.writeable = False
    return _Columns(view, _words(view), begin, end, place)


def _words(buffer: memoryview | Bytes) -> Words:
    """Return every 8 bytes of a buffer as a word, at whatever place they begin."""
    return np.ndarray((max(len(buffer) - 7, 0),), "<u8", buffer, 0, (1,))


@copying_kernel
def _write(
    content: Bytes,
    anywhere: Words,
    start: Integers,
    heads: Bytes,
    head_words: Words,
    columns: _Columns,
    templates: _Templates,
) -> None:
    """Write records: heads (m, 31), side by side, at `start` (m,), and payloads.

    Args:
        anywhere, head_words: the content, and the heads, as `_words` gives them.
    """
    for i in range(start.shape[0]):
        _copy(content, anywhere, start[i], heads, head_words, i * _HEAD, _HEAD)
    for i in range(columns.place.shape[0]):
        begin = columns.begin[i]
        _copy(content, anywhere, columns.place[i], columns.data, columns.words, begin, columns.end[i] - begin)
    word = mark = 0
    for t in range(templates.first.shape[0] - 1):
        pattern, size = (
            templates.pattern_start[t],
            templates.pattern_start[t + 1] - templates.pattern_start[t],
        )
        offsets = templates.offsets[templates.offsets_start[t] : templates.offsets_start[t + 1]]
        marked = templates.marked[templates.marked_start[t] : templates.marked_start[t + 1]]
        for i in range(templates.first[t], templates.first[t + 1]):
            place = templates.place[i]
            _copy(content, anywhere, place, templates.pattern, templates.pattern_words, pattern, size)
            anywhere[place + offsets] = templates.words[word : word + offsets.shape[0]]
            word += offsets.shape[0]
            content[place + marked] = templates.marks[mark : mark + marked.shape[0]]
            mark += marked.shape[0]


@merged
def _copy(
    content: Bytes, anywhere: Words, place: int, source: Bytes, source_words: Words, begin: int, size: int
) -> None:
    """Copy bytes, eight at a time, the last eight once more if need be."""
    if size < 8:
        content[place : place + size] = source[begin : begin + size]
        return
    anywhere[place : place + size - 7 : 8] = source_words[begin : begin + size - 7 : 8]
    anywhere[place + size - 8] = source_words[begin + size - 8]


@elementwise
@kernel
def _index(
    first: Integers,
    begin: Integers,
    start: Integers,
    numbers: Integers,
    times_ns: Integers,
    counts: Integers,
    low_ns: Integers,
    high_ns: Integers,
    entries: Integers,
) -> None:
    """Fill in counts, bounds of times and entries, as `LaidOut` has them.

    Args:
        first: (C + 1,) where the messages of each chunk begin.
        begin: (C + 1,) where its content begins.
        start: (M,) where each message's record begins.
    """
    for c in range(first.shape[0] - 1):
        low_ns[c] = high_ns[c] = times_ns[first[c]]
        for i in range(first[c], first[c + 1]):
            counts[c, numbers[i]] += 1
            low_ns[c], high_ns[c] = min(low_ns[c], times_ns[i]), max(high_ns[c], times_ns[i])
        # where the entries of each channel begin, moved on to where they end
        at = first[c]
        for k in range(counts.shape[1]):
            at, counts[c, k] = at + counts[c, k], at
        for i in range(first[c], first[c + 1]):
            at = counts[c, numbers[i]]
            entries[at, 0], entries[at, 1] = times_ns[i], start[i] - begin[c]
            counts[c, numbers[i]] = at + 1
        end = first[c]
        for k in range(counts.shape[1]):
            end, counts[c, k] = counts[c, k], counts[c, k] - end

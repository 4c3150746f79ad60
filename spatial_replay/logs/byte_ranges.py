"""Ranges of bytes of a file that is read in parts: joined where they are near, held, and read ahead."""

from __future__ import annotations

import io
import os
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import BinaryIO, Final, Protocol, TypeAlias

Range: TypeAlias = tuple[int, int]
"""Bytes from the first up to, not including, the second."""

_BATCH_BYTES: Final = 2**26
"""What is read at once if that is all; of more, the first batches are smaller, and one is read ahead."""
MOST_HELD_BYTES: Final = 2**28
_WASTE: Final = 0.08
"""The share of bytes that may be read between ranges, unused, to save requests."""


class FileInParts(Protocol):
    """A file that gives ranges of its bytes."""

    @property
    def size(self) -> int:
        """In bytes."""

    def read(self, begin: int, end: int) -> bytes:
        """Return a range, less where the file ends before that."""

    def fetch(self, ranges: Iterable[Range]) -> None:
        """Read ranges, to be held until they are asked for."""


class RangeStream(io.RawIOBase):
    """A position in a file, and the ranges that are going to be read from it, in batches."""

    def __init__(self, file: FileInParts) -> None:
        super().__init__()
        self._file = file
        self._position = 0
        self._batches: list[list[Range]] = []
        self._batch_of: dict[int, int] = {}
        self._fetching: dict[int, Future[None]] = {}
        self._thread: ThreadPoolExecutor | None = None

    def plan(self, ranges: Iterable[Range]) -> None:
        """Announce which ranges are going to be read, in this order.

        They are fetched in batches when the first of them is read, and one batch ahead.
        """
        batch, size, most = list[Range](), 0, _BATCH_BYTES
        wanted = list(ranges)
        if sum(end - begin for begin, end in wanted) > _BATCH_BYTES:
            # the reader may stop after the first messages
            most = _BATCH_BYTES // 32
        for begin, end in wanted:
            batch.append((begin, end))
            self._batch_of.setdefault(begin, len(self._batches))
            size += end - begin
            if size >= most:
                self._batches.append(batch)
                batch, size, most = [], 0, min(4 * most, _BATCH_BYTES // 2)
        if batch:
            self._batches.append(batch)

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position}.get(whence)
        self._position = (self._file.size if base is None else base) + offset
        return self._position

    def read(self, size: int = -1) -> bytes:
        end = self._file.size if size < 0 else self._position + size
        if (batch := self._batch_of.get(self._position)) is not None:
            self._fetch(batch)
        data = self._file.read(self._position, end)
        self._position += len(data)
        return data

    def close(self) -> None:
        if self._thread is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)
        super().close()

    def _fetch(self, batch: int) -> None:
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "remote-batches")
        # not ahead of the first one: a search for the first sample needs no other
        for each in range(batch, min(batch + 1 + bool(batch), len(self._batches))):
            if each not in self._fetching:
                self._fetching[each] = self._thread.submit(self._file.fetch, self._batches[each])
        self._fetching[batch].result()


def plan_reads(stream: BinaryIO, ranges: Iterable[Range]) -> None:
    """Announce the ranges that are going to be read from a stream, if it is of a remote file."""
    if isinstance(stream, RangeStream):
        stream.plan(ranges)


def is_planned(stream: BinaryIO) -> bool:
    """Return whether a stream reads announced ranges ahead, and joined: that of a remote file."""
    return isinstance(stream, RangeStream)


def joined_ranges(ranges: Sequence[Range]) -> list[Range]:
    """Return ranges in order, joined over the smallest gaps as long as these add up to little."""
    ordered = sorted(each for each in ranges if each[1] > each[0])
    wanted = sum(end - begin for begin, end in ordered)
    gaps = sorted((after[0] - before[1], i) for i, (before, after) in enumerate(pairwise(ordered)))
    bridged, wasted = set[int](), 0
    for gap, index in gaps:
        wasted += max(gap, 0)
        if wasted > _WASTE * wanted:
            break
        bridged.add(index)
    result: list[Range] = []
    for index, (begin, end) in enumerate(ordered):
        if index - 1 in bridged:
            result[-1] = (result[-1][0], max(result[-1][1], end))
        else:
            result.append((begin, end))
    return result


class HeldBytes:
    """Parts of a file that do not overlap; the oldest are dropped when there are too many."""

    def __init__(self) -> None:
        self._begins: list[int] = []
        self._parts: dict[int, bytes] = {}
        self._size = 0

    def missing(self, begin: int, end: int) -> list[Range]:
        """Return the parts of a range that are not held."""
        gaps = []
        for start, data in self._overlapping(begin, end):
            if start > begin:
                gaps.append((begin, start))
            begin = max(begin, start + len(data))
        return [*gaps, (begin, end)] if begin < end else gaps

    def read(self, begin: int, end: int) -> bytes:
        """Return a range that is held."""
        return b"".join(
            data[max(begin - start, 0) : end - start] for start, data in self._overlapping(begin, end)
        )

    def add(self, begin: int, data: bytes) -> None:
        """Take in what is not held of a part."""
        for start, end in self.missing(begin, begin + len(data)):
            self._begins.insert(bisect_right(self._begins, start), start)
            self._parts[start] = data if end - start == len(data) else data[start - begin : end - begin]
            self._size += end - start
        while self._size > MOST_HELD_BYTES and len(self._parts) > 1:
            oldest = next(iter(self._parts))
            self._size -= len(self._parts.pop(oldest))
            self._begins.remove(oldest)

    def _overlapping(self, begin: int, end: int) -> Iterator[tuple[int, bytes]]:
        index = max(bisect_right(self._begins, begin) - 1, 0)
        while index < len(self._begins) and self._begins[index] < end:
            start = self._begins[index]
            if start + len(self._parts[start]) > begin:
                yield start, self._parts[start]
            index += 1

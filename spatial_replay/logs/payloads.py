"""Contents of many messages as columns: encoded only where somebody wants bytes.

Messages of one template differ in a few numbers. Until a log is written, only these are kept, and messages
are put in order by their places; the writer encodes them straight into a chunk.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Protocol, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Integers, starts_from_counts

Bytes: TypeAlias = NDArray[np.uint8]
Words: TypeAlias = NDArray[np.uint64]

_FEW: Final = 16
"""So many messages are encoded at once: columns would cost more than they save."""


@dataclass(frozen=True, slots=True, eq=False)
class Payloads(Sequence[bytes]):
    """M encoded messages in one buffer; each becomes an object of its own when it is asked for.

    Attributes:
        data: the buffer, of single bytes.
        begin, end: (M,) int64, where each lies in it.
    """

    data: bytes | memoryview
    begin: Integers
    end: Integers

    @classmethod
    def of(cls, payloads: Sequence[bytes]) -> Payloads:
        """Return some messages in one buffer."""
        if isinstance(payloads, cls):
            return payloads
        starts = starts_from_counts(np.fromiter(map(len, payloads), np.int64, len(payloads)))
        return cls(b"".join(payloads), starts[:-1], starts[1:])

    @classmethod
    def join(cls, several: Sequence[Payloads]) -> Payloads:
        """Join messages, one after the other."""
        sizes = starts_from_counts(list(map(len, [each.data for each in several])))[:-1]
        shifts = np.repeat(sizes, list(map(len, several)))
        views = [np.frombuffer(each.data, np.uint8) for each in several]
        return cls(
            np.concatenate([np.empty(0, np.uint8), *views]).data,
            np.concatenate([sizes[:0], *(each.begin for each in several)]) + shifts,
            np.concatenate([sizes[:0], *(each.end for each in several)]) + shifts,
        )

    def __len__(self) -> int:
        return len(self.begin)

    @overload
    def __getitem__(self, index: int) -> bytes: ...

    @overload
    def __getitem__(self, index: slice) -> Payloads: ...

    def __getitem__(self, index: int | slice) -> bytes | Payloads:
        if isinstance(index, slice):
            return Payloads(self.data, self.begin[index], self.end[index])
        return bytes(self.data[self.begin[index] : self.end[index]])

    def __iter__(self) -> Iterator[bytes]:
        return map(bytes, map(self.data.__getitem__, map(slice, self.begin.tolist(), self.end.tolist())))

    @property
    def nbytes(self) -> int:
        """The size of all messages in bytes."""
        return int(self.lengths.sum())

    @property
    def lengths(self) -> Integers:
        """(M,) int64, in bytes."""
        return np.asarray(self.end - self.begin)

    def take(self, chosen: Integers) -> Payloads:
        """Return the messages with the given indices, in that order."""
        return Payloads(self.data, self.begin[chosen], self.end[chosen])

    def rows(self) -> NDArray[np.uint8]:
        """Return messages of one length L as (M, L) uint8."""
        first, length = (int(self.begin[0]), int(self.lengths[0])) if len(self) else (0, 0)
        if not length:
            return np.empty((len(self), 0), np.uint8)
        if (self.begin[1:] - self.begin[:-1] == length).all():
            # they follow each other, as where samples are all that was read
            return np.ndarray((len(self), length), np.uint8, self.data, first)
        anywhere = np.ndarray((len(self.data) - length + 1, length), np.uint8, self.data, 0, (1, 1))
        return anywhere[self.begin]


class Template(Protocol):
    """The layout of some messages, as `WireTemplate` has it."""

    @property
    def pattern(self) -> bytes: ...

    @property
    def word_offsets(self) -> Integers: ...

    @property
    def mark_offsets(self) -> Integers: ...

    def __len__(self) -> int: ...

    def fill(self, words: Words, marks: Bytes | None = None) -> Bytes: ...


@dataclass(frozen=True, slots=True, eq=False)
class Filled:
    """Messages of one template.

    Attributes:
        template: its W words and K marks are to be filled in.
        words: (n, N) of each message.
        marks: (n, K).
        order: (W,) which of them each word of the template is; without it N is W, and they are in order.
    """

    template: Template
    words: Words
    marks: Bytes
    order: Integers | None = None

    def __len__(self) -> int:
        return len(self.words)

    def words_of(self, rows: Integers | slice) -> Words:
        """Return (k, W) the words of some of the messages."""
        return self.words[rows] if self.order is None else self.words[rows].take(self.order, axis=1)

    def encoded(self, rows: Integers | slice) -> Bytes:
        """Encode some of the messages, (k, L) uint8."""
        return self.template.fill(self.words_of(rows), self.marks[rows])


Part: TypeAlias = "Filled | Sequence[bytes]"


@dataclass(frozen=True, eq=False)
class MixedPayloads(Sequence[bytes]):
    """M encoded messages, made when they are asked for.

    Attributes:
        parts: the messages, those of one template together.
        part: (M,) int64, in which part each message is.
        row: (M,) int64, and where in it.
    """

    parts: tuple[Part, ...]
    part: Integers
    row: Integers

    def __len__(self) -> int:
        return len(self.part)

    @overload
    def __getitem__(self, index: int) -> bytes: ...

    @overload
    def __getitem__(self, index: slice) -> MixedPayloads: ...

    def __getitem__(self, index: int | slice) -> bytes | MixedPayloads:
        if isinstance(index, slice):
            return MixedPayloads(self.parts, self.part[index], self.row[index])
        part, row = self.parts[self.part[index]], int(self.row[index])
        return part.encoded(slice(row, row + 1)).tobytes() if isinstance(part, Filled) else part[row]

    def __iter__(self) -> Iterator[bytes]:
        is_used = np.bincount(self.part, minlength=len(self.parts)) > 0
        every: list[Sequence[bytes]] = [
            () if not used else _listed(part) if isinstance(part, Filled) else part
            for part, used in zip(self.parts, is_used.tolist(), strict=True)
        ]
        return (every[part][row] for part, row in zip(self.part.tolist(), self.row.tolist(), strict=True))

    @cached_property
    def sizes(self) -> Integers:
        """(M,) how many bytes each message has."""
        alike = [len(part.template) if isinstance(part, Filled) else 0 for part in self.parts]
        sizes = np.array(alike, np.int64)[self.part]
        for number, part in enumerate(self.parts):
            if isinstance(part, Filled):
                continue
            own = self.part == number
            if isinstance(part, Payloads):
                sizes[own] = part.lengths[self.row[own]]
            else:
                sizes[own] = np.fromiter(map(len, part), np.int64, len(part))[self.row[own]]
        return sizes

    def take(self, chosen: Integers) -> MixedPayloads:
        """Return the messages with the given indices, in that order."""
        return MixedPayloads(self.parts, self.part[chosen], self.row[chosen])


def filled_in(count: int, groups: Sequence[tuple[Integers, Filled]]) -> Sequence[bytes]:
    """Return messages by their places among `count`, each group with its own."""
    if count <= _FEW:
        payloads = [b""] * count
        for places, filled in groups:
            for place, payload in zip(places.tolist(), _listed(filled), strict=True):
                payloads[place] = payload
        return payloads
    part, row = np.empty(count, np.int64), np.empty(count, np.int64)
    for number, (places, filled) in enumerate(groups):
        part[places], row[places] = number, np.arange(len(filled))
    return MixedPayloads(tuple(filled for _, filled in groups), part, row)


def columns_of(payloads: Sequence[bytes]) -> MixedPayloads:
    """Return messages as columns."""
    if isinstance(payloads, MixedPayloads):
        return payloads
    return MixedPayloads((payloads,), np.zeros(len(payloads), np.int64), np.arange(len(payloads)))


def joined_payloads(several: Sequence[Sequence[bytes]]) -> Sequence[bytes]:
    """Join messages, one sequence after the other."""
    if not any(isinstance(each, Payloads | MixedPayloads) for each in several):
        return [payload for each in several for payload in each]
    every = [columns_of(each) for each in several if len(each)]
    if not every:
        return []
    begins = np.cumsum([0, *(len(each.parts) for each in every)]).tolist()
    return MixedPayloads(
        tuple(part for each in every for part in each.parts),
        np.concatenate([each.part + begin for each, begin in zip(every, begins, strict=False)]),
        np.concatenate([each.row for each in every]),
    )


def chosen_payloads(payloads: Sequence[bytes], chosen: Integers) -> Sequence[bytes]:
    """Return the payloads with the given indices, in that order."""
    if isinstance(payloads, Payloads | MixedPayloads):
        return payloads.take(chosen)
    return [payloads[index] for index in chosen.tolist()]


def iter_alike(payloads: Sequence[bytes]) -> Iterator[tuple[Integers, bytes]]:
    """Yield messages in groups: their places (k,), and one of those that differ in a few numbers only."""
    columns = columns_of(payloads)
    for part, places in zip(columns.parts, _places(columns.part, len(columns.parts)), strict=True):
        if isinstance(part, Filled):
            if len(places):
                yield places, columns[int(places[0])]
        else:
            yield from ((np.array([place]), columns[place]) for place in places.tolist())


def _places(part: Integers, parts: int) -> list[Integers]:
    """Return the places of each part's messages."""
    order = np.argsort(part, kind="stable")
    return np.split(order, np.cumsum(np.bincount(part, minlength=parts))[:-1])


def side_by_side(payloads: Sequence[bytes], chosen: Integers) -> tuple[Integers, bytes | memoryview]:
    """Return the lengths (m,) of chosen payloads, and their bytes, one after the other."""
    columns = columns_of(payloads)
    if isinstance(part := columns.parts[0], Payloads) and len(columns.parts) == 1 and len(chosen):
        own = part.take(columns.row[chosen])
        if (own.begin[1:] == own.end[:-1]).all():
            # as they were read, and so without a copy
            return own.lengths, memoryview(own.data)[own.begin[0] : own.end[-1]]
    listed = [payloads[index] for index in chosen.tolist()]
    return np.fromiter(map(len, listed), np.int64, len(listed)), b"".join(listed)


def _listed(part: Filled) -> list[bytes]:
    encoded = part.encoded(slice(None))
    length, whole = len(part.template), encoded.tobytes()
    return (
        [whole[begin : begin + length] for begin in range(0, encoded.size, length)]
        if length
        else [b""] * len(part)
    )

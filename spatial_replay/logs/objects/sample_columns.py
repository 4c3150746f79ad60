"""Samples from messages straight into columns, one layout at a time, on threads that read.

Most messages of a log differ only in their numbers, and nearly all are sound. Those are compared with their
layout, checked and taken apart in one pass, without the interpreter lock. Any others are left to `decode`,
which says what is wrong with them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import copying_kernel, floats_at, integers_at
from spatial_replay.geometry.arrays import Floats, Integers, starts_from_counts
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.outline import are_normalised
from spatial_replay.logs.objects.decode import (
    FIRST_LAYOUTS,
    SAMPLES_PER_LAYOUT,
    UNKNOWN,
    SlotLayout,
    WrongMessageError,
    layout_of,
    parsed,
)
from spatial_replay.logs.objects.wire import LayoutError, WireTemplate
from spatial_replay.logs.payloads import Bytes, Payloads
from spatial_replay.trace.trace import Trace

_MOST_PARTS = 4
"""So many layouts may follow each other in what is read at once."""


class _Places(NamedTuple):
    """Where messages of one layout have the numbers of their columns, one after the other.

    Attributes:
        pattern: (L,) uint8, a message.
        fixed: (L,) uint8, 0xFF where all messages have the bytes of the pattern, else 0.
        offsets: (M,) int64, where each number is, or `UNKNOWN` or `ZERO`.
        ends: (5,) int64, where corners, numbers that are at least 0, and finite ones end among them; where
            the heights begin, bottoms before tops; and where the time is in a message.
    """

    pattern: Bytes
    fixed: Bytes
    offsets: Integers
    ends: Integers


def _taken_by_column(
    data: Bytes,
    begin: Integers,
    end: Integers,
    times: Integers,
    places: _Places,
    vertices: Floats,
    numbers: Floats,
) -> int:
    """See `_taken`."""
    pattern, fixed, offsets, ends = places
    corners, positive, finite, heights, time = ends.tolist()
    alike = end - begin == len(pattern)
    count = len(begin) if alike.all() else int(np.argmin(alike))
    rows = data[begin[:count, None] + np.arange(len(pattern))]
    is_sound = ~((rows ^ pattern) & fixed).any(axis=1)
    stated = np.ascontiguousarray(rows[:, time : time + 8]).view(np.int64).reshape(-1)
    is_sound &= (stated == times[:count]) & (np.diff(times[:count], prepend=-1) > 0)
    values = np.empty((count, len(offsets)))
    for column, offset in enumerate(offsets.tolist()):
        if offset < 0:
            values[:, column] = np.nan if offset == UNKNOWN else 0.0
        else:
            slot = np.ascontiguousarray(rows[:, offset : offset + 8])
            values[:, column] = slot.view(np.float64).reshape(-1)
            if column < finite:
                is_sound &= np.isfinite(values[:, column])
    is_sound &= (values[:, corners:positive] >= 0).all(axis=1)
    middle = (heights + finite) // 2
    is_sound &= ~(values[:, heights:middle] > values[:, middle:finite]).any(axis=1)
    count = count if is_sound.all() else int(np.argmin(is_sound))
    vertices[:count], numbers[:count] = values[:count, :corners], values[:count, corners:]
    return count


@copying_kernel(_taken_by_column, times=1.0)
def _taken(
    data: Bytes,
    begin: Integers,
    end: Integers,
    times: Integers,
    places: _Places,
    vertices: Floats,
    numbers: Floats,
) -> int:
    """Take the numbers of messages up to the first that is not sound; return how many that are.

    A message is sound if it has the layout, the time given, which is after that of the one before, no number
    that is not finite, but for signals, no negative radius or uncertainty, and no height upside down.

    Args:
        data: (B,) uint8, where messages begin and end at `begin` and `end`, (n,).
        times: (n,) int64.
        vertices, numbers: (n, V) and (n, M - V), to be filled in.
    """
    length, corners = places.pattern.shape[0], places.ends[0]
    positive, finite, heights, time = places.ends[1], places.ends[2], places.ends[3], places.ends[4]
    middle = (heights + finite) // 2
    words = length // 8
    pattern, fixed = places.pattern.ctypes.data, places.fixed.ctypes.data
    wanted, mask = integers_at(pattern, words), integers_at(fixed, words)
    last_wanted, last_mask = integers_at(pattern + length - 8, 1)[0], integers_at(fixed + length - 8, 1)[0]
    before = -1
    count = len(begin)
    for k in range(count):
        if end[k] - begin[k] != length or times[k] <= before:
            return k
        before = times[k]
        at = data.ctypes.data + begin[k]
        message = integers_at(at, words)
        differing = (integers_at(at + length - 8, 1)[0] ^ last_wanted) & last_mask
        for i in range(words):
            differing |= (message[i] ^ wanted[i]) & mask[i]
        if differing != 0 or integers_at(at + time, 1)[0] != before:
            return k
        wrong = 0
        for i in range(corners):
            value = floats_at(at + places.offsets[i], 1)[0]
            vertices[k, i] = value
            wrong += value - value != 0.0
        for i in range(corners, places.offsets.shape[0]):
            offset = places.offsets[i]
            if offset < 0:
                numbers[k, i - corners] = np.nan if offset == UNKNOWN else 0.0
                continue
            value = floats_at(at + offset, 1)[0]
            numbers[k, i - corners] = value
            wrong += i < finite and value - value != 0.0
            wrong += i < positive and value < 0.0
        for i in range(heights - corners, middle - corners):
            wrong += numbers[k, i] > numbers[k, i + middle - heights]
        if wrong > 0:
            return k
    return count


@dataclass(frozen=True, eq=False)
class SampleLayout:
    """What all messages of one layout have in common, as columns of a trace, and where their numbers are.

    Attributes:
        names: of the J objects, in order of code points.
        class_code: (J,) int64.
        part_counts: (J,) int64, parts of each object.
        vertex_counts: (P,) int64, vertices of each part.
        fields: by column of the trace, the range of its numbers in a row of `SampleColumns.numbers`, or the
            one number that it has everywhere.
        signals: by name, where its number is in such a row.
    """

    template: WireTemplate
    names: tuple[str, ...]
    class_code: Integers
    classes: tuple[str | None, ...]
    part_counts: Integers
    vertex_counts: Integers
    fields: dict[str, tuple[int, int] | float]
    signals: dict[str, int]
    places: _Places

    @classmethod
    def of(cls, payload: bytes) -> SampleLayout | None:
        """Return the layout of a message; None if it is not one of which all messages could be sound."""
        try:
            message = parsed(payload)
            template, slots = WireTemplate.of(message), layout_of(message)
        except (WrongMessageError, LayoutError):
            return None
        is_same = (
            len(template) == len(payload) and template.matches(np.frombuffer(payload, np.uint8)[None])[0]
        )
        is_named_once = len(set(slots.names)) == len(slots.names) > 0
        if not is_same or not is_named_once or slots.time == UNKNOWN:
            return None
        if not slots.part_counts.all() or not slots.vertex_counts.all():
            return None
        return cls._of(template, slots)

    @classmethod
    def _of(cls, template: WireTemplate, slots: SlotLayout) -> SampleLayout:
        order = sorted(range(len(slots.names)), key=slots.names.__getitem__)
        parts = _in_rows(np.arange(len(slots.vertex_counts)), slots.part_counts, order)
        vertices = _in_rows(slots.coordinates, 2 * slots.vertex_counts, parts.tolist())
        classes = tuple(sorted(set(slots.classes), key=lambda name: (name is not None, name or "")))
        columns = {
            "radius": slots.radius[parts],
            "uncertainty": slots.uncertainty[order],
            "yaw": slots.yaw[order],
            "bottom": slots.bottom[order],
            "top": slots.top[order],
        }
        fields = dict[str, tuple[int, int] | float]()
        taken, ends = [vertices], [len(vertices)]
        for name, column in columns.items():
            if len(column) and column.max() < 0 and column.min() == column.max():
                fields[name] = np.nan if column[0] == UNKNOWN else 0.0
                column = column[:0]
            else:
                fields[name] = ends[-1] - len(vertices), ends[-1] - len(vertices) + len(column)
            taken.append(column)
            ends.append(ends[-1] + len(column))
        signals = sorted(slots.signals)
        used = np.concatenate([*taken, np.array([slots.signals[name] for name in signals], np.int64)])
        offsets = np.where(used < 0, used, template.word_offsets[np.maximum(used, 0)])
        time = template.word_offsets[slots.time]
        return cls(
            template=template,
            names=tuple(slots.names[index] for index in order),
            class_code=np.array([classes.index(slots.classes[index]) for index in order], np.int64),
            classes=classes,
            part_counts=slots.part_counts[order],
            vertex_counts=slots.vertex_counts[parts],
            fields=fields,
            signals={name: ends[-1] - len(vertices) + index for index, name in enumerate(signals)},
            places=_Places(
                template.payload,
                template.fixed,
                offsets,
                np.array([ends[0], ends[2], ends[5], ends[3], time], np.int64),
            ),
        )

    def __len__(self) -> int:
        return len(self.template)

    def read(self, payloads: Payloads, times_ns: Integers) -> SampleColumns:
        """Read messages up to the first that is not a sound one of this layout.

        Args:
            times_ns: (n,) int64, their log times.
        """
        count, corners = len(payloads), int(self.places.ends[0])
        vertices = np.empty((count, corners))
        numbers = np.empty((count, len(self.places.offsets) - corners))
        data = np.frombuffer(payloads.data, np.uint8)
        taken = _taken(data, payloads.begin, payloads.end, times_ns, self.places, vertices, numbers)
        if taken and not are_normalised(self.shared(taken).vertex_start, vertices[:taken].reshape(-1, 2)):
            taken = 0
        return SampleColumns(self, times_ns[:taken], vertices[:taken], numbers[:taken])

    def shared(self, count: int) -> _Shared:
        """Return the columns that all samples have in common, of a number of samples."""
        objects, parts = len(self.part_counts), len(self.vertex_counts)
        if (most := self._most[0]).samples < count:
            # those of few are the first of those of many
            self._most[0] = most = self._shared_by(2 * count)
        return _Shared(
            count,
            most.rows[:count],
            most.class_code[: count * objects],
            most.part_start[: count * objects + 1],
            most.vertex_start[: count * parts + 1],
            {
                name: values[: count * (parts if name == "radius" else objects)]
                for name, values in most.constant.items()
            },
        )

    @cached_property
    def _most(self) -> list[_Shared]:
        return [self._shared_by(1)]

    def _shared_by(self, count: int) -> _Shared:
        objects, parts = len(self.part_counts), len(self.vertex_counts)
        return _Shared(
            count,
            np.arange(count * objects).reshape(count, objects),
            np.tile(self.class_code, count),
            starts_from_counts(np.tile(self.part_counts, count)),
            starts_from_counts(np.tile(self.vertex_counts, count)),
            {
                name: np.full(count * (parts if name == "radius" else objects), value)
                for name, value in self.fields.items()
                if isinstance(value, float)
            },
        )

    def trace(self, several: Sequence[SampleColumns]) -> Trace:
        """Return samples of this layout as a trace, all whose times increase."""
        times = np.concatenate([each.times_ns for each in several])
        shared = self.shared(len(times))

        def column(begin: int, end: int) -> Floats:
            return np.concatenate([each.numbers[:, begin:end] for each in several]).reshape(-1)

        columns = shared.constant | {
            name: column(*place) for name, place in self.fields.items() if isinstance(place, tuple)
        }
        return Trace(
            times_ns=times,
            names=self.names,
            rows=shared.rows,
            footprints=FootprintBatch.trusted(
                part_start=shared.part_start,
                vertex_start=shared.vertex_start,
                vertices=np.concatenate([each.vertices for each in several]).reshape(-1, 2),
                radius=columns["radius"],
                bottom=columns["bottom"],
                top=columns["top"],
            ),
            yaw=columns["yaw"],
            uncertainty=columns["uncertainty"],
            class_code=shared.class_code,
            classes=self.classes,
            signals={name: column(place, place + 1) for name, place in self.signals.items()},
        )


class _Shared(NamedTuple):
    """Columns that all traces of a layout with as many samples have: of fewer, the first numbers.

    Attributes:
        constant: by name, those whose numbers are all the same.
    """

    samples: int
    rows: Integers
    class_code: Integers
    part_start: Integers
    vertex_start: Integers
    constant: dict[str, Floats]


@dataclass(frozen=True, eq=False)
class SampleColumns:
    """n samples of one layout, checked, with normalised outlines.

    Attributes:
        times_ns: (n,) int64.
        vertices: (n, 2 V) float64, of all objects.
        numbers: (n, M) float64, the others.
    """

    layout: SampleLayout
    times_ns: Integers
    vertices: Floats
    numbers: Floats

    def __len__(self) -> int:
        return len(self.times_ns)

    def __getitem__(self, part: slice) -> SampleColumns:
        return SampleColumns(self.layout, self.times_ns[part], self.vertices[part], self.numbers[part])


def trace_of(columns: Iterable[SampleColumns]) -> Trace:
    """Return samples as a trace: as `decode_objects` would, bit for bit.

    Args:
        columns: whose times increase, from one to the next, too.
    """
    runs = groupby(columns, key=lambda each: id(each.layout))
    traces = [several[0].layout.trace(several) for several in (list(run) for _, run in runs)]
    return traces[0] if len(traces) == 1 else Trace.concatenate(traces)


class ColumnReader:
    """Reads samples of a log as columns, on any thread; remembers their layouts."""

    def __init__(self) -> None:
        self._layouts: dict[int, tuple[SampleLayout, ...]] = {}
        self._making = Lock()
        self._tried = self._served = 0

    def read(self, payloads: Payloads, times_ns: Integers) -> tuple[SampleColumns, ...] | None:
        """Return messages as columns, if all are sound, their times increase, and few layouts serve them all.

        Args:
            times_ns: (n,) int64, their log times.
        """
        columns: list[SampleColumns] = []
        begin, count = 0, len(payloads)
        while begin < count:
            rest = payloads[begin:]
            read = self._first_columns(rest, times_ns[begin:])
            if read is None or len(columns) == _MOST_PARTS:
                return None
            columns.append(read)
            begin += len(read)
        self._served += count
        return tuple(columns)

    def _first_columns(self, payloads: Payloads, times_ns: Integers) -> SampleColumns | None:
        length = int(payloads.end[0] - payloads.begin[0])
        tried: tuple[SampleLayout, ...] = ()
        while True:
            known = self._layouts.get(length, ())
            for layout in known:
                if layout not in tried and len(read := layout.read(payloads, times_ns)):
                    return read
            tried = known
            with self._making:
                if len(self._layouts.get(length, ())) > len(known):
                    # made by another thread in the meantime
                    continue
                if (self._tried - FIRST_LAYOUTS) * SAMPLES_PER_LAYOUT > self._served:
                    return None
                self._tried += 1
                if (made := SampleLayout.of(payloads[0])) is None:
                    return None
                self._layouts[length] = (*known, made)


def _in_rows(values: NDArray[np.int64], counts: Integers, order: Sequence[int]) -> Integers:
    """Return the values of ragged rows, the rows in another order."""
    rows = np.split(values, np.cumsum(counts)[:-1])
    return np.concatenate([values[:0], *(rows[index] for index in order)])

"""Encode samples as messages of /spatial/objects and decode them, many at a time.

Most messages of a log differ only in their numbers. So the protobuf library parses one message of a layout,
and the numbers of the other messages are read or written at the layout's offsets (see `wire`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Final

import numpy as np
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import (
    Floats,
    Integers,
    combined_code,
    equal_places,
    select,
    starts_from_counts,
)
from spatial_replay.geometry.footprint import Concave, FootprintBatch
from spatial_replay.logs.messages import Messages, messages_of
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.topics import OBJECTS, protobuf_channel
from spatial_replay.logs.wire import Bytes, LayoutError, Payloads, WireTemplate, Words, join_in_order, rows_of
from spatial_replay.text import Instant, Sentence
from spatial_replay.trace.observations import Observations, trace_from_observations
from spatial_replay.trace.trace import ABSENT, Trace, class_order, require_few

UNKNOWN, ZERO = -2, -1
"""Indices of two extra columns, NaN and 0, for numbers that are missing in a message."""


OBJECTS_CHANNEL: Final = protobuf_channel(OBJECTS, ObjectStates)


class WrongMessageError(Exception):
    """Bytes that are not an ObjectStates message; the text says why."""


@dataclass(frozen=True, eq=False)
class SlotLayout:
    """Slot of each field in a message; `UNKNOWN` or `ZERO` for a missing field.

    Attributes:
        time: slot of the sample's time.
        names, classes: names and classes of the J objects.
        lasting: names of objects that hold their pose until their next report.
        part_counts: (J,) number of parts of each object.
        vertex_counts: (P,) number of vertices of each part.
        coordinates: (2 V,) slots of x, y, x, y …
        radius: (P,) slots.
        yaw, bottom, top, uncertainty, reported: (J,) slots.
        signals, signals_reported: slots of each signal's value, and of the time of its report.
    """

    time: int
    names: tuple[str, ...]
    classes: tuple[str | None, ...]
    lasting: frozenset[str]
    part_counts: Integers
    vertex_counts: Integers
    coordinates: Integers
    radius: Integers
    yaw: Integers
    bottom: Integers
    top: Integers
    uncertainty: Integers
    reported: Integers
    signals: dict[str, int]
    signals_reported: dict[str, int]


def parse_object_states(payload: bytes) -> ObjectStates:
    """Parse a message, or a piece of a message with some of its fields.

    Raises:
        WrongMessageError: invalid bytes, an object without a name, or a vertex without y.
    """
    message = ObjectStates()
    try:
        message.ParseFromString(payload)
    except DecodeError:
        raise WrongMessageError("the message is not an ObjectStates message") from None
    for state in message.objects:
        if not state.name:
            raise WrongMessageError("an object has no name")
        if any(len(part.coordinates) % 2 for part in state.parts):
            raise WrongMessageError(f"object {state.name!r} has a part with an odd number of coordinates")
    return message


def layout_of(message: ObjectStates) -> SlotLayout:
    """Return the slots of `WireTemplate.of(message)` by field.

    Raises:
        WrongMessageError: a signal without a name, or two signals of one name.
    """
    slots = count()

    def slot(is_present: bool, default_slot: int) -> int:
        return next(slots) if is_present else default_slot

    time_slot = slot(message.HasField("time_ns"), UNKNOWN)
    column_names = ("coordinates", "radius", "yaw", "bottom", "top", "uncertainty", "reported")
    slots_by_column: dict[str, list[int]] = {name: [] for name in column_names}
    for state in message.objects:
        # slots are taken in the order in which protobuf encodes the fields
        for part in state.parts:
            slots_by_column["coordinates"] += (next(slots) for _ in part.coordinates)
            slots_by_column["radius"].append(slot(part.HasField("radius"), ZERO))
        slots_by_column["yaw"].append(slot(state.HasField("yaw"), UNKNOWN))
        missing_slot = ZERO if state.HasField("height") else UNKNOWN
        slots_by_column["bottom"].append(slot(state.height.HasField("bottom"), missing_slot))
        slots_by_column["top"].append(slot(state.height.HasField("top"), missing_slot))
        slots_by_column["uncertainty"].append(slot(state.HasField("uncertainty"), ZERO))
        slots_by_column["reported"].append(slot(state.HasField("reported_ns"), UNKNOWN))
    signals: dict[str, int] = {}
    signals_reported: dict[str, int] = {}
    for signal in message.signals:
        signals[signal.name] = slot(signal.HasField("value"), ZERO)
        signals_reported[signal.name] = slot(signal.HasField("reported_ns"), UNKNOWN)
    if "" in signals or len(signals) < len(message.signals):
        raise WrongMessageError("a signal has no name, or one that another signal has")
    counts = (len(part.coordinates) // 2 for state in message.objects for part in state.parts)
    return SlotLayout(
        time=time_slot,
        names=tuple(state.name for state in message.objects),
        classes=tuple(s.class_name if s.HasField("class_name") else None for s in message.objects),
        lasting=frozenset(state.name for state in message.objects if state.lasting),
        part_counts=np.array([len(state.parts) for state in message.objects], np.int64),
        vertex_counts=np.fromiter(counts, np.int64),
        signals=signals,
        signals_reported=signals_reported,
        **{name: np.array(column_slots, np.int64) for name, column_slots in slots_by_column.items()},
    )


SAMPLES_PER_LAYOUT = 32
"""Least mean number of messages per layout. The setup of a layout takes as long as decoding 32 messages in
pieces."""
FIRST_LAYOUTS = 16
"""Number of layouts that are set up even if they serve few messages."""

# field number times 8 plus wire type: https://protobuf.dev/programming-guides/encoding
_TIME_TAG, _OBJECT_TAG, _SIGNAL_TAG = 0x09, 0x12, 0x1A


@dataclass(frozen=True, eq=False)
class _Group:
    """K samples of one layout: indices (K,), and numbers (K, W + 2) with the columns `UNKNOWN` and `ZERO`."""

    samples: Integers
    layout: SlotLayout
    numbers: Floats


@dataclass(frozen=True, slots=True)
class _Pieces:
    """Encoded messages or parts of messages, with the sample index of each."""

    samples: Integers
    payloads: Sequence[bytes]


def decode_objects(
    payloads: Sequence[bytes], times_ns: Integers, *, concave: Concave = "decompose"
) -> tuple[Trace, list[Sentence]]:
    """Decode ObjectStates messages to a trace.

    Args:
        payloads: T messages.
        times_ns: (T,) int64, log times of the messages, which increase.
        concave: how polygons that are not convex are handled; our own logs hold none.

    Returns:
        the trace of the valid messages, and one fault per invalid message, with the message's time.
    """
    faults: dict[int, str] = {}
    groups = _groups(payloads, faults)
    faults = _late_reports(groups, times_ns) | _signals_given_twice(groups) | faults
    faults = _wrong_times(groups, times_ns) | faults
    trace, observation_faults = trace_from_observations(_observations(groups, times_ns), concave=concave)
    faults = observation_faults | faults
    if faults.keys() - observation_faults.keys():
        is_valid = np.ones(len(times_ns), np.bool_)
        is_valid[list(faults)] = False
        trace = trace.take(np.searchsorted(trace.times_ns, times_ns[is_valid]))
    return trace, [
        Sentence("sample at ", Instant(int(times_ns[index]), 0), f": {fault}")
        for index, fault in sorted(faults.items())
    ]


def _groups(payloads: Sequence[bytes], faults: dict[int, str]) -> list[_Group]:
    """Group the numbers of all messages by layout; invalid payloads go to `faults`.

    If layouts serve too few messages, messages are split into objects and signals, because objects of many
    messages share a layout.
    """
    whole_messages = _Pieces(np.arange(len(payloads), dtype=np.int64), payloads)
    groups, leftover_pieces = _group_by_layout(whole_messages, faults, SAMPLES_PER_LAYOUT)
    if len(leftover_pieces.samples):
        message_fields = [_fields(payload) or [payload] for payload in leftover_pieces.payloads]
        piece_samples = np.repeat(leftover_pieces.samples, [len(fields) for fields in message_fields])
        pieces = _Pieces(piece_samples, [piece for fields in message_fields for piece in fields])
        groups += _group_by_layout(pieces, faults, 0)[0]
    return groups


def _group_by_layout(pieces: _Pieces, faults: dict[int, str], worth: int) -> tuple[list[_Group], _Pieces]:
    """Group pieces by layout; return also the pieces left over when layouts serve too few pieces.

    Args:
        worth: least mean number of pieces per layout, not counting the first `FIRST_LAYOUTS`.
    """
    groups: list[_Group] = []
    leftover_indices: list[Integers] = []
    layouts_tried = pieces_served = 0
    lengths = np.fromiter(map(len, pieces.payloads), np.int64, len(pieces.payloads))
    distinct_lengths, length_counts = np.unique(lengths, return_counts=True)
    # frequent lengths first: their layouts serve most pieces
    for length in distinct_lengths[np.argsort(-length_counts, kind="stable")].tolist():
        piece_indices = np.flatnonzero(lengths == length)
        if (layouts_tried - FIRST_LAYOUTS) * worth > pieces_served:
            leftover_indices.append(piece_indices)
            continue
        piece_rows = rows_of(select(pieces, piece_indices).payloads)
        while len(piece_indices) and (layouts_tried - FIRST_LAYOUTS) * worth <= pieces_served:
            layouts_tried += 1
            group, is_same_layout = _first_group(select(pieces, piece_indices[:1]), piece_rows, faults)
            if group is not None:
                groups.append(replace(group, samples=pieces.samples[piece_indices[is_same_layout]]))
            pieces_served += int(np.count_nonzero(is_same_layout))
            if not is_same_layout.all():
                piece_rows = piece_rows[~is_same_layout]
            piece_indices = piece_indices[~is_same_layout]
        leftover_indices.append(piece_indices)
    all_leftover = np.concatenate([np.empty(0, np.int64), *leftover_indices])
    return groups, select(pieces, np.sort(all_leftover))


def _first_group(
    first_piece: _Pieces, rows: Bytes, faults: dict[int, str]
) -> tuple[_Group | None, NDArray[np.bool_]]:
    """Return the group of rows (n, L) with the first row's layout, and a mask (n,) of finished rows.

    If the first row is not a valid message, the group is None, and only the first row is finished.
    """
    is_first_row = np.zeros(len(rows), np.bool_)
    is_first_row[0] = True
    try:
        message = parse_object_states(first_piece.payloads[0])
        template, layout = WireTemplate.of(message), layout_of(message)
    except (WrongMessageError, LayoutError) as error:
        faults[int(first_piece.samples[0])] = str(error)
        return None, is_first_row
    is_same_layout = template.matches(rows) if len(template) == rows.shape[1] else ~is_first_row
    if is_same_layout[0]:
        matching_rows = rows if is_same_layout.all() else rows[is_same_layout]
        return _Group(first_piece.samples, layout, _pad(template.words(matching_rows))), is_same_layout
    # another encoder wrote the fields in another order, so the library encodes the message again
    first_row = rows_of([message.SerializeToString(deterministic=True)])
    return _Group(first_piece.samples, layout, _pad(template.words(first_row))), is_first_row


def _fields(payload: bytes) -> list[bytes] | None:
    """Split a message into fields, each a valid message; None if a field is unknown or time is repeated."""
    pieces: list[bytes] = []
    begin, end, time_count = 0, len(payload), 0
    while begin < end:
        tag, position = payload[begin], begin + 1
        if tag == _TIME_TAG:
            position += 8
            time_count += 1
        elif tag in (_OBJECT_TAG, _SIGNAL_TAG):
            # a varint: https://protobuf.dev/programming-guides/encoding/#varints
            length = shift = 0
            while position < end:
                length |= (payload[position] & 0x7F) << shift
                shift += 7
                position += 1
                if payload[position - 1] < 0x80:
                    break
            position += length
        else:
            return None
        if position > end or time_count > 1:
            return None
        pieces.append(payload[begin:position])
        begin = position
    return pieces


def _wrong_times(groups: Sequence[_Group], times_ns: Integers) -> dict[int, str]:
    stated_ns = np.zeros(len(times_ns), np.int64)
    has_time = np.zeros(len(times_ns), np.bool_)
    for group in groups:
        if group.layout.time != UNKNOWN:
            stated_ns[group.samples] = _whole(group, group.layout.time)
            has_time[group.samples] = True
    indices = np.flatnonzero(has_time & (stated_ns != times_ns)).tolist()
    faults = {index: f"time_ns is {stated_ns[index]}, not the log time of the message" for index in indices}
    return faults | dict.fromkeys(np.flatnonzero(~has_time).tolist(), "the message has no time_ns")


def _late_reports(groups: Sequence[_Group], times_ns: Integers) -> dict[int, str]:
    faults: dict[int, str] = {}
    for group in groups:
        named_slots = [*zip(group.layout.names, group.layout.reported.tolist(), strict=True)]
        for name, slot in (*named_slots, *group.layout.signals_reported.items()):
            if slot != UNKNOWN:
                reported_ns = _whole(group, slot)
                is_wrong = (reported_ns < 0) | (reported_ns > times_ns[group.samples])
                fault = f"reported_ns of {name!r} is not a time up to that of the sample"
                faults |= dict.fromkeys(group.samples[is_wrong].tolist(), fault)
    return faults


def _whole(group: _Group, slot: int) -> Integers:
    """Return (K,) int64, the integers in a slot."""
    return np.ascontiguousarray(group.numbers[:, slot]).view(np.int64)


def _signals_given_twice(groups: Sequence[_Group]) -> dict[int, str]:
    faults: dict[int, str] = {}
    for name in {name for group in groups for name in group.layout.signals}:
        samples_of_groups = np.concatenate(
            [group.samples for group in groups if name in group.layout.signals]
        )
        samples, sample_counts = np.unique(samples_of_groups, return_counts=True)
        faults |= {int(index): f"signal {name!r} is there twice" for index in samples[sample_counts > 1]}
    return faults


def _pad(words: Words) -> Floats:
    padded_words = np.empty((len(words), words.shape[1] + 2))
    padded_words[:, :-2] = words.view(np.float64)
    # the extra columns are `UNKNOWN` and `ZERO`
    padded_words[:, -2:] = np.nan, 0.0
    return padded_words


def _observations(groups: Sequence[_Group], times_ns: Integers) -> Observations:
    name_codes = {
        name: code for code, name in enumerate(dict.fromkeys(n for g in groups for n in g.layout.names))
    }
    class_names = class_order(name for group in groups for name in group.layout.classes)
    class_codes = {name: code for code, name in enumerate(class_names)}

    def column(field: str) -> Floats:
        group_columns = [np.take(g.numbers, getattr(g.layout, field), axis=1).reshape(-1) for g in groups]
        return np.concatenate([np.empty(0), *group_columns])

    def repeat(group_values: Iterable[tuple[_Group, Sequence[int] | Integers]]) -> Integers:
        tiled_values = (np.tile(np.asarray(v, np.int64), len(g.samples)) for g, v in group_values)
        return np.concatenate([np.empty(0, np.int64), *tiled_values])

    signal_names = sorted({name for g in groups for name in g.layout.signals})
    require_few(name_codes, signal_names)
    sample_columns = (np.repeat(g.samples, len(g.layout.names)) for g in groups)
    return Observations(
        times_ns=times_ns,
        sample=np.concatenate([np.empty(0, np.int64), *sample_columns]),
        name=repeat((g, [name_codes[n] for n in g.layout.names]) for g in groups),
        names=list(name_codes),
        class_code=repeat((g, [class_codes[c] for c in g.layout.classes]) for g in groups),
        classes=class_names,
        yaw=column("yaw"),
        uncertainty=column("uncertainty"),
        shapes=FootprintBatch(
            part_start=starts_from_counts(repeat((g, g.layout.part_counts) for g in groups)),
            vertex_start=starts_from_counts(repeat((g, g.layout.vertex_counts) for g in groups)),
            vertices=column("coordinates").reshape(-1, 2),
            radius=column("radius"),
            bottom=column("bottom"),
            top=column("top"),
        ),
        invalid=np.concatenate([np.empty(0, np.bool_), *map(_invalid, groups)]),
        signals={name: _signal(name, groups, len(times_ns)) for name in signal_names},
        reported_ns=_report_times(groups, times_ns),
        signals_reported_ns=_signal_report_times(groups, times_ns),
        lasting=frozenset().union(*(group.layout.lasting for group in groups)),
    )


def _report_times(groups: Sequence[_Group], times_ns: Integers) -> Integers | None:
    """Return the report time of each observation, (R,); None if every report has its sample's time."""
    if all((group.layout.reported == UNKNOWN).all() for group in groups):
        return None
    report_columns = [np.empty(0, np.int64)]
    for group in groups:
        slots = group.layout.reported
        stated_ns = np.ascontiguousarray(group.numbers[:, slots]).view(np.int64)
        report_columns.append(np.where(slots == UNKNOWN, times_ns[group.samples, None], stated_ns).ravel())
    return np.concatenate(report_columns)


def _signal_report_times(groups: Sequence[_Group], times_ns: Integers) -> dict[str, Integers]:
    report_times: dict[str, Integers] = {}
    for group in groups:
        for name, slot in group.layout.signals_reported.items():
            if slot != UNKNOWN:
                report_times.setdefault(name, times_ns.copy())[group.samples] = _whole(group, slot)
    return report_times


def _invalid(group: _Group) -> NDArray[np.bool_]:
    """Return (K * J,) whether an orientation or a height is given but not finite."""
    layout = group.layout
    is_invalid = np.zeros((len(group.samples), len(layout.names)), np.bool_)
    for slots in (layout.yaw, layout.bottom, layout.top):
        is_invalid |= (slots != UNKNOWN) & ~np.isfinite(group.numbers[:, slots])
    return is_invalid.ravel()


def _signal(name: str, groups: Sequence[_Group], sample_count: int) -> Floats:
    signal_values = np.full(sample_count, np.nan)
    for group in groups:
        if name in group.layout.signals:
            signal_values[group.samples] = group.numbers[:, group.layout.signals[name]]
    return signal_values


def sample_messages(trace: Trace, first: int) -> Messages:
    """Return the samples of a trace as messages, with sequence numbers from `first`."""
    return messages_of(OBJECTS_CHANNEL, trace.times_ns, encode_objects(trace), first)


def encode_objects(trace: Trace) -> Payloads:
    """Encode each sample of a trace as one ObjectStates message.

    In protobuf, two concatenated encodings decode to one message with the fields of both messages. So a
    sample is joined from pieces: its time, its objects and its signals. Pieces of one layout are encoded
    together.
    """
    # https://protobuf.dev/programming-guides/encoding/#last-one-wins
    sample_count = len(trace)
    time_pieces = _pieces(ObjectStates(time_ns=0), trace.times_ns.view(np.float64)[:, None])
    signal_pieces = [_signal_pieces(trace, name) for name in trace.signals]
    sample_indices = np.arange(sample_count)
    object_samples = np.nonzero(trace.rows != ABSENT)[0]
    piece_samples = np.concatenate([sample_indices, object_samples, *[sample_indices] * len(signal_pieces)])
    pieces = Payloads.concatenate([time_pieces, _object_pieces(trace), *signal_pieces])
    return pieces.select(np.argsort(piece_samples, kind="stable")).join(
        np.bincount(piece_samples, minlength=sample_count)
    )


def _object_pieces(trace: Trace) -> Payloads:
    """Encode every object of every sample, in the order of sample and name."""
    is_present = trace.rows != ABSENT
    marked_rows = trace.rows[is_present]
    # the row number -2 - row marks an unreadable observation, see `Trace`
    row_indices = np.where(marked_rows < 0, -2 - marked_rows, marked_rows)
    name_indices = np.nonzero(is_present)[1]
    pieces = list[tuple[Integers, Payloads]]()
    reported_ns = np.zeros(0, np.int64) if trace.reported_ns is None else trace.reported_ns[is_present]
    is_earlier = np.zeros(len(row_indices), np.bool_)
    if trace.reported_ns is not None:
        is_earlier = reported_ns != trace.times_ns[np.nonzero(is_present)[0]]
    layout_codes = combined_code(
        [name_indices, marked_rows < 0, is_earlier, _row_layout(trace)[row_indices]], len(row_indices)
    )
    for object_indices in equal_places(layout_codes):
        first_index = int(object_indices[0])
        message = _message(
            trace,
            int(name_indices[first_index]),
            int(row_indices[first_index]),
            is_unreadable=bool(marked_rows[first_index] < 0),
        )
        numbers = _numbers(trace, message, row_indices[object_indices])
        if is_earlier[first_index]:
            message.objects[0].reported_ns = 0
            numbers = np.column_stack([numbers, reported_ns[object_indices].view(np.float64)])
        pieces.append((object_indices, _pieces(message, numbers)))
    return join_in_order(pieces)


def _signal_pieces(trace: Trace, name: str) -> Payloads:
    """Encode a signal of every sample; an unknown value gives an empty piece."""
    message, signal_values = ObjectStates(), trace.signals[name]
    signal = message.signals.add(name=name, value=0.0)
    pieces = _pieces(message, signal_values[:, None])
    reported_ns = trace.signals_reported_ns.get(name, trace.times_ns)
    is_earlier = reported_ns != trace.times_ns
    if is_earlier.any():
        signal.reported_ns = 0
        numbers = np.column_stack([signal_values[is_earlier], reported_ns[is_earlier].view(np.float64)])
        current_samples, earlier_samples = np.flatnonzero(~is_earlier), np.flatnonzero(is_earlier)
        pieces = join_in_order(
            [(current_samples, pieces.select(current_samples)), (earlier_samples, _pieces(message, numbers))]
        )
    return pieces.without(np.isnan(signal_values))


def _pieces(message: Message, numbers: Floats) -> Payloads:
    """Encode n copies of a message with the numbers (n, W)."""
    return WireTemplate.of(message).encode(np.ascontiguousarray(numbers).view(np.uint64))


def _row_layout(trace: Trace) -> Integers:
    """Return layout codes (R,); messages of observations with equal codes differ only in numbers and name."""
    shapes = trace.footprints
    part_counts = np.diff(shapes.part_start)
    vertex_counts = np.diff(shapes.vertex_start)
    columns = [part_counts, trace.class_code, np.isnan(trace.yaw), np.isnan(shapes.bottom)]
    for part_index in range(int(part_counts.max(initial=0))):
        has_part = part_counts > part_index
        column = np.zeros(len(part_counts), np.int64)
        column[has_part] = vertex_counts[shapes.part_start[:-1][has_part] + part_index]
        columns.append(column)
    return combined_code(columns, len(part_counts))


def _message(trace: Trace, name_index: int, row: int, *, is_unreadable: bool) -> ObjectStates:
    """Return the message of one observation, with 0 for every number.

    An unreadable observation gets orientation and height, because its orientation or its height is not
    finite.
    """
    shapes = trace.footprints
    message = ObjectStates()
    state = message.objects.add(name=trace.names[name_index], uncertainty=0.0)
    state.lasting = not is_unreadable and state.name in trace.lasting
    class_name = trace.classes[trace.class_code[row]]
    if class_name is not None:
        state.class_name = class_name
    for part_index in range(shapes.part_start[row], shapes.part_start[row + 1]):
        vertex_count = int(shapes.vertex_start[part_index + 1] - shapes.vertex_start[part_index])
        state.parts.add(coordinates=[0.0] * (2 * vertex_count), radius=0.0)
    if is_unreadable or not np.isnan(trace.yaw[row]):
        state.yaw = 0.0
    if is_unreadable or not np.isnan(shapes.bottom[row]):
        state.height.bottom = state.height.top = 0.0
    return message


def _numbers(trace: Trace, message: ObjectStates, rows: Integers) -> Floats:
    """Return (K, W) the numbers of observations of one layout, in the order of the message's fields."""
    (state,) = message.objects
    shapes = trace.footprints
    number_columns: list[Floats] = []
    first_parts = shapes.part_start[rows]
    for part_index, part in enumerate(state.parts):
        first_vertices = shapes.vertex_start[first_parts + part_index]
        vertex_offsets = np.arange(len(part.coordinates) // 2)
        number_columns.append(
            shapes.vertices[first_vertices[:, None] + vertex_offsets].reshape(
                len(rows), len(part.coordinates)
            )
        )
        number_columns.append(shapes.radius[first_parts + part_index, None])
    if state.HasField("yaw"):
        number_columns.append(trace.yaw[rows, None])
    if state.HasField("height"):
        number_columns += [shapes.bottom[rows, None], shapes.top[rows, None]]
    number_columns.append(trace.uncertainty[rows, None])
    return np.concatenate(number_columns, axis=1)

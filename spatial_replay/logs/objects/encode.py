"""Encode traces as messages of /spatial/objects, many samples at a time."""

from __future__ import annotations

import numpy as np
from google.protobuf.message import Message

from spatial_replay.geometry.arrays import Floats, Integers, combined, equal_places, starts_from_counts
from spatial_replay.logs.objects.wire import WireTemplate, payloads_of
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.trace.trace import ABSENT, Trace


def encode_objects(trace: Trace) -> list[bytes]:
    """Encode each sample of a trace as one ObjectStates message.

    Two encodings side by side are the encoding of both messages' fields. So a sample is joined from pieces:
    its time, each of its objects and each of its signals, and all pieces of one layout are encoded at once.
    """
    times = _pieces(ObjectStates(time_ns=0), trace.times_ns.view(np.float64)[:, None])
    objects = _object_pieces(trace)
    begins = starts_from_counts(np.count_nonzero(trace.rows != ABSENT, axis=1)).tolist()
    columns = [_signal_pieces(name, values) for name, values in trace.signals.items()]
    signals = list(zip(*columns, strict=True))
    return [
        b"".join((time, *objects[begins[index] : begins[index + 1]], *(signals[index] if signals else ())))
        for index, time in enumerate(times)
    ]


def _object_pieces(trace: Trace) -> list[bytes]:
    """Encode every object of every sample, by sample and name."""
    present = trace.rows != ABSENT
    marked = trace.rows[present]
    rows = np.where(marked < 0, -2 - marked, marked)
    name = np.nonzero(present)[1]
    pieces = [b""] * len(rows)
    for places in equal_places(combined([name, marked < 0, _row_layout(trace)[rows]], len(rows))):
        first = int(places[0])
        message = _message(trace, int(name[first]), int(rows[first]), unreadable=bool(marked[first] < 0))
        encoded = _pieces(message, _numbers(trace, message, rows[places]))
        for place, piece in zip(places.tolist(), encoded, strict=True):
            pieces[place] = piece
    return pieces


def _signal_pieces(name: str, values: Floats) -> list[bytes]:
    """Encode a signal in every sample: nothing where its value is not known."""
    message = ObjectStates()
    message.signals.add(name=name, value=0.0)
    pieces = _pieces(message, values[:, None])
    for place in np.flatnonzero(np.isnan(values)).tolist():
        pieces[place] = b""
    return pieces


def _pieces(message: Message, numbers: Floats) -> list[bytes]:
    """Encode a message with other numbers (n, W)."""
    return payloads_of(WireTemplate.of(message).fill(np.ascontiguousarray(numbers).view(np.uint64)))


def _row_layout(trace: Trace) -> Integers:
    """Return (R,) a number that is equal for observations whose messages differ only in numbers and name."""
    shapes = trace.footprints
    counts = np.diff(shapes.part_start)
    vertex_counts = np.diff(shapes.vertex_start)
    columns = [counts, trace.class_code, np.isnan(trace.yaw), np.isnan(shapes.bottom)]
    for place in range(int(counts.max(initial=0))):
        has_part = counts > place
        column = np.zeros(len(counts), np.int64)
        column[has_part] = vertex_counts[shapes.part_start[:-1][has_part] + place]
        columns.append(column)
    return combined(columns, len(counts))


def _message(trace: Trace, name: int, row: int, *, unreadable: bool) -> ObjectStates:
    """Return a message of one observation with everything but its numbers.

    An unreadable one always has orientation and height: either may be what is not finite.
    """
    shapes = trace.footprints
    message = ObjectStates()
    state = message.objects.add(name=trace.names[name], uncertainty=0.0)
    class_name = trace.classes[trace.class_code[row]]
    if class_name is not None:
        state.class_name = class_name
    for part in range(shapes.part_start[row], shapes.part_start[row + 1]):
        corners = int(shapes.vertex_start[part + 1] - shapes.vertex_start[part])
        state.parts.add(coordinates=[0.0] * (2 * corners), radius=0.0)
    if unreadable or not np.isnan(trace.yaw[row]):
        state.yaw = 0.0
    if unreadable or not np.isnan(shapes.bottom[row]):
        state.height.bottom = state.height.top = 0.0
    return message


def _numbers(trace: Trace, message: ObjectStates, rows: Integers) -> Floats:
    """Return (K, W) the numbers of observations of one layout, in the order of the message's fields."""
    (state,) = message.objects
    shapes = trace.footprints
    columns: list[Floats] = []
    parts = shapes.part_start[rows]
    for place, part in enumerate(state.parts):
        begin = shapes.vertex_start[parts + place]
        corners = np.arange(len(part.coordinates) // 2)
        columns.append(shapes.vertices[begin[:, None] + corners].reshape(len(rows), len(part.coordinates)))
        columns.append(shapes.radius[parts + place, None])
    if state.HasField("yaw"):
        columns.append(trace.yaw[rows, None])
    if state.HasField("height"):
        columns += [shapes.bottom[rows, None], shapes.top[rows, None]]
    columns.append(trace.uncertainty[rows, None])
    return np.concatenate(columns, axis=1)

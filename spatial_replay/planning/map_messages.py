"""Gradient maps as messages: cells with all their layers, and what of them a decision says in words."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField

from spatial_replay.annotate.scene.scene_entities import FRAME
from spatial_replay.annotate.scene.scene_frames import cell_colours
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanCandidate, PlanCause, PlanConjunct, PlanRoom
from spatial_replay.planning.decisions import Candidate, Step
from spatial_replay.planning.map_layers import MOST_LAYERS, CauseKind, MapLayers, room_cost
from spatial_replay.planning.maps import GradientMap
from spatial_replay.planning.settings import Settings

_CELL: Final = np.dtype([("robustness", "<f4"), ("colour", "u1", (4,))])
"""What every map has of a cell: its robustness, NaN where it is blocked, and red, green, blue and alpha."""

_COLOURS: Final = ("red", "green", "blue", "alpha")
_DEPTH: Final = 0.1
"""Depth of a map below the plane, in cells, so that it does not hide the regions in the plane."""

_CAUSES: MappingProxyType[CauseKind, PlanCause.Kind.ValueType] = MappingProxyType(
    {
        "constraint": PlanCause.KIND_CONSTRAINT,
        "object": PlanCause.KIND_OBJECT,
        "obstacle": PlanCause.KIND_OBSTACLE,
        "reach": PlanCause.KIND_REACH,
        "unknown": PlanCause.KIND_UNKNOWN,
        "failed": PlanCause.KIND_FAILED,
    }
)


class TurnedMap(NamedTuple):
    """A candidate's map for one orientation of the object, the index into the map's turns."""

    candidate: Candidate
    turn: int


def maps_of(step: Step) -> list[TurnedMap]:
    """Return all maps that a step depends on, by edge, in the order in which a log has them.

    The chosen object in its target orientation comes last, since a viewer shows the last message of a topic.
    """
    return [
        TurnedMap(candidate, turn)
        for edge in step.considered
        for candidate in sorted(edge.candidates, key=lambda each: each.is_chosen)
        for turn in sorted(range(len(candidate.map.turns)), key=lambda turn: _is_aim(candidate, turn))
    ]


def _is_aim(candidate: Candidate, turn: int) -> bool:
    """Return whether this is the orientation nearest to that of the target, which may be turned from it."""
    target = candidate.target
    return target is not None and candidate.map.cell_of(target.x, target.y, target.turn)[0] == turn


def map_digest(gradient: GradientMap) -> bytes:
    """Return the SHA-256 of a map's values: little-endian float64 by turn, row and column, NaN if blocked."""
    return hashlib.sha256(np.ascontiguousarray(gradient.values, "<f8").tobytes()).digest()


def map_message(turned: TurnedMap, time_ns: int, layers: MapLayers | None = None) -> GridMessage:
    """Return a map as a message, drawn under the scene; blocked cells are transparent.

    Args:
        layers: what it is made of; None for a map as older logs have it.
    """
    gradient = turned.candidate.map
    grid, values = gradient.grid, gradient.values[turned.turn]
    added = {} if layers is None else dict(_fields(turned, layers))
    kinds = [(name, values.dtype.str) for name, values in added.items()]
    cells = np.empty(values.shape, np.dtype([*_CELL.descr, *kinds]))
    cells["robustness"] = values
    cells["colour"] = cell_colours(values)
    for name, own in added.items():
        cells[name] = own
    size = cells.dtype.itemsize
    message = GridMessage(
        frame_id=FRAME,
        column_count=grid.columns,
        row_stride=size * grid.columns,
        cell_stride=size,
        data=cells.tobytes(),
    )
    message.timestamp.FromNanoseconds(time_ns)
    message.pose.position.x, message.pose.position.y = grid.xmin, grid.ymin
    message.pose.position.z = -_DEPTH * grid.cell_size
    message.pose.orientation.w = 1.0
    message.cell_size.x = message.cell_size.y = grid.cell_size
    message.fields.add(name="robustness", offset=0, type=PackedElementField.FLOAT32)
    for offset, name in enumerate(_COLOURS, 4):
        message.fields.add(name=name, offset=offset, type=PackedElementField.UINT8)
    offset = _CELL.itemsize
    for name, own in added.items():
        kind = PackedElementField.FLOAT32 if own.dtype.kind == "f" else PackedElementField.UINT16
        message.fields.add(name=name, offset=offset, type=kind)
        offset += own.dtype.itemsize
    return message


def _fields(turned: TurnedMap, layers: MapLayers) -> Iterator[tuple[str, np.ndarray]]:
    """Yield what a map is made of, for one orientation, (rows, columns) each, with names."""
    turn, gradient, room_from = turned.turn, turned.candidate.map, turned.candidate.room_from
    yield "limited_by", (layers.limiting[turn] + 1).astype("<u2")
    yield "blocked_by", (layers.blocked_by[turn] + 1).astype("<u2")
    yield "clearance", _singles(gradient.clearance[turn])
    yield "room", _singles(gradient.made_of.now.room(room_from)[turn])
    varying = [bool((layer != layer.flat[0]).any()) for layer in layers.robustness]
    chosen = sorted(range(len(varying)), key=lambda place: not varying[place])[:MOST_LAYERS]
    for place in sorted(chosen):
        # a number in front, so that no conjunct is named like another field
        name = f"{place + 1}: {layers.conjuncts[place]}"
        yield name, _singles(layers.robustness[place, turn])


def _singles(values: np.ndarray) -> np.ndarray:
    """Return numbers as a viewer draws them, NaN where they are not finite."""
    return np.where(np.isfinite(values), values, np.nan).astype("<f4")


def map_fields(message: GridMessage) -> dict[str, np.ndarray]:
    """Return each field of a map's message as (rows, columns); nothing if the sizes in it do not fit."""
    columns, cell, row = message.column_count, message.cell_stride, message.row_stride
    rows = len(message.data) // row if row else 0
    if not rows or not columns or cell * columns > row:
        return {}
    types = {
        # a field without a type is a number
        PackedElementField.UNKNOWN: "<f4",
        PackedElementField.FLOAT32: "<f4",
        PackedElementField.UINT16: "<u2",
        PackedElementField.UINT8: "u1",
    }
    return {
        field.name: np.ndarray((rows, columns), types[field.type], message.data, field.offset, (row, cell))
        for field in message.fields
        if field.type in types and field.offset + np.dtype(types[field.type]).itemsize <= cell
    }


def explain(message: PlanCandidate, candidate: Candidate, layers: MapLayers, settings: Settings) -> None:
    """Add what a candidate's map is made of, what blocks its cells, and what room costs."""
    target = candidate.target
    free = layers.limiting[layers.blocked_by < 0]
    counts = np.bincount(free[free >= 0], minlength=len(layers.conjuncts)).tolist()
    place = None if target is None else candidate.map.cell_of(target.x, target.y, target.turn)
    for number, text in enumerate(layers.conjuncts):
        at_target = None if place is None else float(layers.robustness[number][place])
        message.conjuncts.append(PlanConjunct(text=text, limits=counts[number], at_target=at_target))
    for cause in layers.causes:
        message.causes.append(PlanCause(kind=_CAUSES[cause.kind], text=cause.name, cells=cause.cells))
    if target is not None and (cost := room_cost(candidate, target, settings)) is not None:
        room = PlanRoom(wanted=settings.room, possible=cost.robustness, clearance=cost.room)
        message.room.CopyFrom(room)

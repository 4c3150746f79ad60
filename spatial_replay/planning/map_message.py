"""Gradient maps as messages that viewers draw, one for each way in which an object may be turned."""

from __future__ import annotations

import hashlib
from typing import Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField

from spatial_replay.inspection.drawing import FRAME
from spatial_replay.inspection.shades import cell_colours
from spatial_replay.planning.maps import GradientMap
from spatial_replay.planning.step import Candidate, Step

CELL: Final = np.dtype([("robustness", "<f4"), ("colour", "u1", (4,))])
"""A map's cell: its robustness, NaN where it is blocked, and red, green, blue and alpha."""

_COLOURS: Final = ("red", "green", "blue", "alpha")
_DEPTH: Final = 0.1
"""How far below the plane a map lies, by the size of its cells: regions are drawn in the plane."""


class TurnedMap(NamedTuple):
    """A candidate's map with the object turned in one way, by its place among the map's turns."""

    candidate: Candidate
    turn: int


def maps_of(step: Step) -> list[TurnedMap]:
    """Every map that a step rests on, edge after edge, in the order in which a log has them.

    Viewers draw the last one: that of the object chosen, turned as it is to be.
    """
    return [
        TurnedMap(candidate, turn)
        for edge in step.considered
        for candidate in sorted(edge.candidates, key=lambda each: each.is_chosen)
        for turn in sorted(range(len(candidate.map.turns)), key=lambda turn: _is_meant(candidate, turn))
    ]


def _is_meant(candidate: Candidate, turn: int) -> bool:
    """Whether the object is to be turned in this way."""
    return candidate.target is not None and candidate.target.turn == candidate.map.turns[turn]


def map_message(turned: TurnedMap, time_ns: int) -> GridMessage:
    """A map that lies under the scene, in its colours; those of blocked cells are clear."""
    found = turned.candidate.map
    grid, values = found.grid, found.values[turned.turn]
    cells = np.empty(values.shape, CELL)
    cells["robustness"] = values
    cells["colour"] = cell_colours(values)
    message = GridMessage(
        frame_id=FRAME,
        column_count=grid.columns,
        row_stride=CELL.itemsize * grid.columns,
        cell_stride=CELL.itemsize,
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
    return message


def map_digest(found: GradientMap) -> bytes:
    """SHA-256 of a map's values: little-endian float64 by turn, row and column, NaN where blocked."""
    return hashlib.sha256(np.ascontiguousarray(found.values, "<f8").tobytes()).digest()

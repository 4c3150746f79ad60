"""Messages of /spatial/scene → the scene as an animation: outlines and colours, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.annotate.scene_entities import REGION, WITNESS
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.report.compact import Packing

MOST_FRAMES: Final = 3_000
"""How many frames a page has at most."""
MOST_CORNERS: Final = 2_000_000
"""How many corners the outlines of all frames have at most, all together."""
_ABSENT: Final = 65_535
_STEPS: Final = 65_535
"""Into how many steps each side of the scene is divided: finer than any screen."""


class Outlined(NamedTuple):
    """What is drawn of an entity in one frame: rings, (n, 2) each, and a colour."""

    rings: tuple[Floats, ...]
    colour: tuple[int, int, int]


class Pointed(NamedTuple):
    """The arrow at the worst violation of one frame: from where to where it leads, (2, 2), and its number."""

    ends: Floats
    label: str


class Frame(NamedTuple):
    """What a page draws of one message.

    Attributes:
        outlined: by the ids of entities.
        pointed: None where nothing is pointed at.
    """

    outlined: Mapping[str, Outlined]
    pointed: Pointed | None

    @property
    def corners(self) -> int:
        """How many corners its outlines have."""
        return sum(len(ring) for each in self.outlined.values() for ring in each.rings)


@dataclass(frozen=True, eq=False)
class Film:
    """Frames of a scene.

    Attributes:
        times_ns: (F,) int64.
        stride: of how many messages one is a frame.
    """

    times_ns: Integers
    frames: tuple[Frame, ...]
    stride: int


class FilmMaker:
    """Takes frames from messages as they come, ever fewer of them if there are too many."""

    def __init__(self) -> None:
        self._kept: list[tuple[int, Frame]] = []
        self._seen, self._stride, self._corners = 0, 1, 0

    def add(self, time_ns: int, payload: bytes) -> None:
        """Take in the next message."""
        if self._seen % self._stride == 0:
            frame = _frame(SceneUpdate.FromString(payload))
            self._kept.append((time_ns, frame))
            self._corners += frame.corners
        self._seen += 1
        while len(self._kept) > MOST_FRAMES or (self._corners > MOST_CORNERS and len(self._kept) > 2):
            self._kept = self._kept[::2]
            self._stride *= 2
            self._corners = sum(frame.corners for _, frame in self._kept)

    def film(self) -> Film:
        """What was taken so far."""
        times_ns = np.array([time_ns for time_ns, _ in self._kept], np.int64)
        return Film(times_ns, tuple(frame for _, frame in self._kept), self._stride)


def _frame(message: SceneUpdate) -> Frame:
    outlined = {entity.id: _outlined(entity) for entity in message.entities if entity.lines}
    pointed = [_pointed(entity) for entity in message.entities if entity.id == WITNESS and entity.arrows]
    return Frame(outlined, pointed[0] if pointed else None)


def _outlined(entity: SceneEntity) -> Outlined:
    rings = tuple(
        np.array([(point.x, point.y) for point in line.points], np.float64) for line in entity.lines
    )
    colour = entity.lines[0].color
    return Outlined(rings, (_byte(colour.r), _byte(colour.g), _byte(colour.b)))


def _byte(share: float) -> int:
    return round(255.0 * share)


def _pointed(entity: SceneEntity) -> Pointed:
    arrow = entity.arrows[0]
    x, y = arrow.pose.position.x, arrow.pose.position.y
    angle = 2.0 * math.atan2(arrow.pose.orientation.z, arrow.pose.orientation.w)
    length = arrow.shaft_length + arrow.head_length
    ends = np.array([(x, y), (x + length * math.cos(angle), y + length * math.sin(angle))])
    return Pointed(ends, entity.texts[0].text.strip())


class _Box(NamedTuple):
    """The part of the plane that everything lies in: its lower left corner, and its size, above 0."""

    low: Floats
    size: Floats

    def steps(self, points: Floats) -> Floats:
        """Points (n, 2) as the page has them: in steps of the box."""
        return np.asarray(np.round((points - self.low) / self.size * _STEPS))


def film_value(film: Film, first_ns: int, packing: Packing) -> Mapping[str, Any]:
    """The film as the page reads it; coordinates are in steps of the box that everything lies in."""
    entities = _entities(film.frames)
    pointed = {number: frame.pointed for number, frame in enumerate(film.frames) if frame.pointed}
    arrows = list(pointed.values())
    box = _box(entities, arrows)
    return {
        "times": packing.add((film.times_ns - first_ns) / 1e9, "f8"),
        "stride": film.stride,
        "low": box.low.tolist(),
        "high": (box.low + box.size).tolist(),
        "entities": [
            _entity_value(identifier, shown, len(film.frames), box, packing)
            for identifier, shown in sorted(entities.items(), key=_drawing_order)
        ],
        "witness": {
            "frames": packing.add(np.array(list(pointed)), "i4"),
            "points": packing.add(box.steps(_joined([each.ends for each in arrows])), "u2"),
            "labels": [each.label for each in arrows],
        },
    }


def _drawing_order(item: tuple[str, Any]) -> tuple[bool, str]:
    """Regions lie below objects."""
    return not item[0].startswith(REGION), item[0]


def _entities(frames: Sequence[Frame]) -> Mapping[str, dict[int, Outlined]]:
    """By entity and frame, what is drawn."""
    found: dict[str, dict[int, Outlined]] = {}
    for number, frame in enumerate(frames):
        for identifier, outlined in frame.outlined.items():
            found.setdefault(identifier, {})[number] = outlined
    return found


def _box(entities: Mapping[str, Mapping[int, Outlined]], pointed: Sequence[Pointed]) -> _Box:
    rings = [ring for shown in entities.values() for each in shown.values() for ring in each.rings]
    everything = _joined([*rings, *(each.ends for each in pointed)])
    if not len(everything):
        return _Box(np.zeros(2), np.ones(2))
    low, size = everything.min(axis=0), np.ptp(everything, axis=0)
    return _Box(low, np.where(size > 0.0, size, 1.0))


def _joined(points: Sequence[Floats]) -> Floats:
    """All points, (n, 2)."""
    return np.concatenate([np.empty((0, 2)), *points])


def _entity_value(
    identifier: str, shown: Mapping[int, Outlined], frames: int, box: _Box, packing: Packing
) -> Mapping[str, Any]:
    """One entity: in which form it is shown in each frame, and the points and colours of those frames."""
    forms: dict[tuple[int, ...], int] = {}
    of_frame = np.full(frames, _ABSENT, np.int64)
    for number, each in shown.items():
        form = tuple(len(ring) for ring in each.rings)
        of_frame[number] = forms.setdefault(form, len(forms))
    kind, _, name = identifier.partition("/")
    rings = [ring for each in shown.values() for ring in each.rings]
    return {
        "kind": kind,
        "name": name,
        "forms": list(forms),
        "form": packing.add(of_frame, "u2"),
        "points": packing.add(box.steps(_joined(rings)), "u2"),
        "colours": packing.add(np.array([each.colour for each in shown.values()]), "u1"),
    }

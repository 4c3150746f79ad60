"""Messages of /spatial/scene → the scene as an animation: outlines and colours, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.inspection.layout import WITNESS
from spatial_replay.inspection.report.packing import Packing

MOST_FRAMES: Final = 3_000
"""How many frames a page has at most."""
_MOST_BYTES: Final = 24_000_000
"""How many bytes the messages of the frames have at most."""
_ABSENT: Final = 65_535
_STEPS: Final = 65_535
"""Into how many steps each side of the scene is divided: finer than any screen."""


@dataclass(frozen=True, eq=False)
class Film:
    """Frames of a scene, each the whole message.

    Attributes:
        times_ns: (F,) int64.
        stride: of how many messages one is a frame.
    """

    times_ns: Integers
    frames: tuple[SceneUpdate, ...]
    stride: int


class FilmMaker:
    """Takes frames from messages as they come, ever fewer of them if there are too many."""

    def __init__(self) -> None:
        self._kept: list[tuple[int, bytes]] = []
        self._seen, self._stride, self._size = 0, 1, 0

    def add(self, time_ns: int, payload: bytes) -> None:
        """Take in the next message."""
        if self._seen % self._stride == 0:
            self._kept.append((time_ns, payload))
            self._size += len(payload)
        self._seen += 1
        while len(self._kept) > MOST_FRAMES or (self._size > _MOST_BYTES and len(self._kept) > 2):
            self._kept = self._kept[::2]
            self._stride *= 2
            self._size = sum(len(kept) for _, kept in self._kept)

    def film(self) -> Film:
        """What was taken so far."""
        times_ns = np.array([time_ns for time_ns, _ in self._kept], np.int64)
        frames = tuple(SceneUpdate.FromString(payload) for _, payload in self._kept)
        return Film(times_ns, frames, self._stride)


class _Outlined(NamedTuple):
    """What is drawn of an entity in one frame: rings, (n, 2) each, and a colour."""

    rings: list[Floats]
    colour: tuple[int, int, int]


def film_value(film: Film, first_ns: int, packing: Packing) -> Mapping[str, Any]:
    """The film as the page reads it.

    Coordinates are in steps of the bounding box of all frames, from its lower left corner.
    """
    entities = _entities(film.frames)
    pointed = [_pointed(frame) for frame in film.frames]
    low, high = _bounds(entities, pointed)
    size = np.where(high > low, high - low, 1.0)

    def steps(points: Floats) -> Floats:
        return np.asarray(np.round((points - low) / size * _STEPS))

    return {
        "times": packing.add((film.times_ns - first_ns) / 1e9, "f8"),
        "stride": film.stride,
        "low": low.tolist(),
        "high": (low + size).tolist(),
        "entities": [
            _entity_value(identifier, shown, len(film.frames), steps, packing)
            for identifier, shown in sorted(entities.items(), key=_drawing_order)
        ],
        "witness": {
            "frames": packing.add(np.flatnonzero([each is not None for each in pointed]), "i4"),
            "points": packing.add(
                steps(np.array([each[0] for each in pointed if each is not None]).reshape(-1, 2)), "u2"
            ),
            "labels": [each[1] for each in pointed if each is not None],
        },
    }


def _drawing_order(item: tuple[str, Any]) -> tuple[bool, str]:
    """Regions lie below objects."""
    return not item[0].startswith("region/"), item[0]


def _entities(frames: Sequence[SceneUpdate]) -> Mapping[str, dict[int, _Outlined]]:
    """By entity and frame, what is drawn."""
    found: dict[str, dict[int, _Outlined]] = {}
    for number, frame in enumerate(frames):
        for entity in frame.entities:
            if entity.lines:
                found.setdefault(entity.id, {})[number] = _outlined(entity)
    return found


def _outlined(entity: SceneEntity) -> _Outlined:
    rings = [np.array([(point.x, point.y) for point in line.points], np.float64) for line in entity.lines]
    colour = entity.lines[0].color
    return _Outlined(rings, (_byte(colour.r), _byte(colour.g), _byte(colour.b)))


def _byte(share: float) -> int:
    return min(255, max(0, round(255.0 * share)))


def _pointed(frame: SceneUpdate) -> tuple[list[tuple[float, float]], str] | None:
    """From where to where the arrow at the worst violation leads, and its number."""
    for entity in frame.entities:
        if entity.id == WITNESS and entity.arrows:
            return list(_ends(entity.arrows[0])), entity.texts[0].text.strip()
    return None


def _ends(arrow: ArrowPrimitive) -> Iterator[tuple[float, float]]:
    x, y = arrow.pose.position.x, arrow.pose.position.y
    angle = 2.0 * math.atan2(arrow.pose.orientation.z, arrow.pose.orientation.w)
    length = arrow.shaft_length + arrow.head_length
    yield x, y
    yield x + length * math.cos(angle), y + length * math.sin(angle)


def _bounds(entities: Mapping[str, Mapping[int, _Outlined]], pointed: Iterable[Any]) -> tuple[Floats, Floats]:
    """The lower left and the upper right corner of everything."""
    points = [ring for shown in entities.values() for each in shown.values() for ring in each.rings]
    points += [np.array(each[0]) for each in pointed if each is not None]
    everything = np.concatenate([*points, np.empty((0, 2))])
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything):
        return np.zeros(2), np.ones(2)
    return np.asarray(everything.min(axis=0)), np.asarray(everything.max(axis=0))


def _entity_value(
    identifier: str, shown: Mapping[int, _Outlined], frames: int, steps: Any, packing: Packing
) -> Mapping[str, Any]:
    """One entity: in which form it is shown in each frame, and the points and colours of those frames."""
    forms: dict[tuple[int, ...], int] = {}
    of_frame = np.full(frames, _ABSENT, np.int64)
    for number, each in shown.items():
        form = tuple(len(ring) for ring in each.rings)
        of_frame[number] = forms.setdefault(form, len(forms))
    kind, _, name = identifier.partition("/")
    return {
        "kind": kind,
        "name": name,
        "forms": list(forms),
        "form": packing.add(of_frame, "u2"),
        "points": packing.add(
            steps(np.concatenate([ring for each in shown.values() for ring in each.rings])), "u2"
        ),
        "colours": packing.add(np.array([each.colour for each in shown.values()]), "u1"),
    }

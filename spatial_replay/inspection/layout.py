"""Messages of /spatial/scene of one layout: the same entities with the same primitives, many at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.timestamp_pb2 import Timestamp

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.inspection.drawing import (
    ARROW_HEAD,
    FRAME,
    OBJECT_OPACITY,
    REGION_OPACITY,
    Elevation,
    draw,
    point_at,
)
from spatial_replay.inspection.rings import Form
from spatial_replay.logs.wire import Bytes, Template
from spatial_replay.spec.formula import Outline

OBJECT: Final = "object/"
REGION: Final = "region/"
WITNESS: Final = "witness"

LABEL_LENGTH: Final = 8
"""Characters of a witness' number, spaces around it included."""

_LABEL_LIFT: Final = 0.01
"""How far above a region its name stands, by the region's size."""


class Layout(NamedTuple):
    """What decides where the numbers of a message stand.

    Attributes:
        deleted: objects that were in the message before and are not seen now.
        objects: name and form of those seen.
        witness: whether the worst violation is pointed at; or, with None, was so in the message before.
    """

    deleted: tuple[str, ...]
    objects: tuple[tuple[str, Form], ...]
    witness: bool | None = False


class Region(NamedTuple):
    """A region as it is drawn.

    Attributes:
        name: its name.
        outline: its border, as the specification says it.
        rings: its convex parts, each (n, 2).
    """

    name: str
    outline: Outline
    rings: tuple[Floats, ...]


@dataclass(frozen=True, eq=False)
class SceneTemplate:
    """Messages of one layout, but for their times, coordinates and colours.

    Attributes:
        template: its words are what is to be filled in.
        stamps: where a timestamp's content begins.
    """

    template: Template
    stamps: tuple[int, ...]

    def fill(self, times_ns: Integers, words: Floats) -> Bytes:
        """(S,) times and (S, W) numbers → (S, L) encoded messages."""
        rows = self.template.fill(words.view(np.uint64))
        stamps = _encoded_stamps(times_ns)
        for begin in self.stamps:
            rows[:, begin : begin + _STAMP] = stamps
        return rows


def make_template(layout: Layout, regions: tuple[Region, ...], lift: float) -> SceneTemplate:
    """The template of a layout.

    Args:
        lift: how far flat objects are drawn above the plane, so that they cover regions.
    """
    message = SceneUpdate()
    for name in layout.deleted:
        message.deletions.add(id=OBJECT + name, type=SceneEntityDeletion.MATCHING_ID, timestamp=_A_STAMP)
    if layout.witness is None:
        message.deletions.add(id=WITNESS, type=SceneEntityDeletion.MATCHING_ID, timestamp=_A_STAMP)
    for region in regions:
        _add_region(_add_entity(message, REGION + region.name), region)
    for name, form in layout.objects:
        _add_object(_add_entity(message, OBJECT + name), name, form, lift)
    if layout.witness:
        point_at(_add_entity(message, WITNESS), _A_LABEL, lift)
    payload = np.frombuffer(message.SerializeToString(deterministic=True), np.uint8).copy()
    words = Template.of(message).word_offsets
    slots = words[np.isnan(payload[words[:, None] + np.arange(8)].view("<f8")[:, 0])]
    if layout.witness:
        # the last text of all: names come before it
        slots = np.append(slots, payload.tobytes().rindex(_A_LABEL.encode()))
    payload[slots[:, None] + np.arange(8)] = 0
    return SceneTemplate(Template(payload, slots, np.empty(0, np.int64)), _stamp_offsets(payload.tobytes()))


def words_of_region(region: Region, colour: Floats) -> list[Floats]:
    """What a template leaves open in a region: the colours (S, 3) of its lines and faces."""
    primitives = _region_entity(region)
    return [colour] * (len(primitives.lines) + len(primitives.triangles))


def words_of_object(
    form: Form, points: Floats, bottom: Floats, top: Floats, colour: Floats, lift: float
) -> list[Floats]:
    """What a template leaves open in an object, in the order of its primitives' fields.

    Args:
        points: (S, P, 2), its rings, one after the other.
        bottom, top: (S,) its height interval, if it has one.
        colour: (S, 3).
        lift: how far above the top the name stands.

    Returns:
        columns (S, n), each of one or more words.
    """
    rings = _split(points, form.rings)
    upper = [top[:, None]] if form.has_height else []
    words = []
    for ring in rings:
        words += [*upper, _flat(ring), colour]
    for ring in rings:
        if ring.shape[1] > 2:
            words += [*upper, _flat(ring), colour]
    if form.has_height:
        for ring in rings:
            if ring.shape[1] > 1:
                words += [bottom[:, None], _flat(ring), _raised(ring, top - bottom), colour]
    # half the sum of the ends does not depend on the order in which points are added up
    words.append((points.min(axis=1) + points.max(axis=1)) / 2.0)
    return words + [height + lift for height in upper]


def words_of_witness(points: Floats, z: Floats, scale: float, labels: Sequence[str]) -> list[Floats]:
    """What a template leaves open in the arrow at the worst violation.

    Args:
        points: (S, 2, 2), where it begins and where it ends.
        z: (S,), how high.
        scale: the size of objects in the scene.
        labels: S texts, of at most `LABEL_LENGTH` ASCII characters.

    Returns:
        columns (S, n).
    """
    begin, end = points[:, 0], points[:, 1]
    length = np.hypot(*(end - begin).T)
    half = 0.5 * np.arctan2(*(end - begin).T[::-1])
    head = np.minimum(0.5 * length, ARROW_HEAD * scale)
    arrow = [begin, z, np.sin(half), np.cos(half), length - head, head]
    middle = [(begin + end) / 2.0, z + ARROW_HEAD * scale]
    text = "".join([label.center(LABEL_LENGTH) for label in labels]).encode()
    label = np.frombuffer(text, "<f8")
    return [column.reshape(len(points), -1) for column in (*arrow, *middle, label)]


def _add_entity(message: SceneUpdate, identifier: str) -> SceneEntity:
    return message.entities.add(id=identifier, frame_id=FRAME, timestamp=_A_STAMP)


def _add_region(entity: SceneEntity, region: Region) -> None:
    """A region's border as it was written, or for a disc its ring, and its convex parts as faces.

    The name stands at its upper edge, where objects inside do not cover it.
    """
    corners = np.array(region.outline.vertices, np.float64)
    outlines = list(region.rings) if region.outline.is_disc else [corners]
    bottom, top = region.outline.height or (0.0, 0.0)
    sides = None if region.outline.height is None else (bottom, top - bottom)
    everything = np.concatenate(region.rings)
    (left, low), (right, high) = everything.min(axis=0).tolist(), everything.max(axis=0).tolist()
    label = top + _LABEL_LIFT * max(right - left, high - low)
    draw(
        entity,
        region.name,
        outlines,
        list(region.rings),
        ((left + right) / 2.0, high),
        Elevation(top, sides, label),
        REGION_OPACITY,
    )


def _region_entity(region: Region) -> SceneEntity:
    entity = SceneEntity()
    _add_region(entity, region)
    return entity


def _add_object(entity: SceneEntity, name: str, form: Form, lift: float) -> None:
    rings = [np.full((length, 2), np.nan) for length in form.rings]
    elevation = Elevation(lift, None, 2.0 * lift)
    if form.has_height:
        elevation = Elevation(np.nan, (np.nan, np.nan), np.nan)
    draw(entity, name, rings, rings, (np.nan, np.nan), elevation, OBJECT_OPACITY)


def _split(points: Floats, lengths: tuple[int, ...]) -> list[Floats]:
    ends = np.cumsum(lengths).tolist()
    return [points[:, end - length : end] for end, length in zip(ends, lengths, strict=True)]


def _flat(ring: Floats) -> Floats:
    return ring.reshape(len(ring), -1)


def _raised(ring: Floats, height: Floats) -> Floats:
    """(S, n, 2) points and (S,) heights → (S, 3 n): x, y, z, x, y, z …"""
    z = np.broadcast_to(height[:, None, None], (*ring.shape[:2], 1))
    return _flat(np.concatenate([ring, z], axis=2))


_A_LABEL: Final = "#" * LABEL_LENGTH


# ------------------------------------------------------------------------------------------- timestamps

# Numbers of variable length may be padded: written with five bytes each, all stamps have one length.
_SECONDS, _NANOS = (1 << 34) - 1, (1 << 30) - 1
_A_STAMP: Final = Timestamp(seconds=_SECONDS, nanos=_NANOS)
# its bytes of all ones are in no text, and every other number is a slot or an ordinary constant
_STAMP_BYTES: Final = _A_STAMP.SerializeToString()
_STAMP: Final = len(_STAMP_BYTES)
_NS: Final = 1_000_000_000


def _stamp_offsets(payload: bytes) -> tuple[int, ...]:
    offsets = []
    begin = payload.find(_STAMP_BYTES)
    while begin >= 0:
        offsets.append(begin)
        begin = payload.find(_STAMP_BYTES, begin + _STAMP)
    return tuple(offsets)


def _encoded_stamps(times_ns: Integers) -> Bytes:
    """(S,) nanoseconds → (S, 12) the contents of timestamps."""
    rows = np.tile(np.frombuffer(_STAMP_BYTES, np.uint8), (len(times_ns), 1))
    shifts = np.arange(0, 35, 7)
    more = np.array([0x80, 0x80, 0x80, 0x80, 0x00])
    for begin, number in ((1, times_ns // _NS), (7, times_ns % _NS)):
        rows[:, begin : begin + 5] = number[:, None] >> shifts & 0x7F | more
    return rows

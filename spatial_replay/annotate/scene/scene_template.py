"""Templates of messages of /spatial/scene, and the numbers that fill them.

Messages of one layout have the same entities with the same primitives. Their template is encoded once, with
`SLOT` instead of coordinates and colours. Filling in these numbers encodes many messages at once.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Final, Literal, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.timestamp_pb2 import Timestamp

from spatial_replay.geometry.arrays import (
    Floats,
    Integers,
    combined_code,
    equal_places,
    flat_index,
    starts_from_counts,
)
from spatial_replay.geometry.footprint import Footprint, FootprintBatch
from spatial_replay.logs.wire import Payloads, WireTemplate, Words
from spatial_replay.palette import LABEL, NEGATIVE, NEUTRAL
from spatial_replay.spec.formula import Outline, RegionName, TrackedName

ROUND: Final = 32
"""Number of points on the ring of a rounded part."""


class Rings(NamedTuple):
    """The rings of R footprints, as ragged rows.

    Attributes:
        start: (R + 1,) int64, start of each footprint's points.
        points: (P, 2), points of the rings, counter-clockwise.
        form: (R,) int64, index into `forms`.
        forms: the distinct forms.
        has_round: whether any part is rounded, or a point.
    """

    start: Integers
    points: Floats
    form: Integers
    forms: tuple[Form, ...]
    has_round: bool

    def rings_of(self, footprint: int) -> tuple[Floats, ...]:
        """Return the rings (n, 2) of one of the footprints."""
        end, rings = int(self.start[footprint]), []
        for length in self.forms[self.form[footprint]].rings:
            begin, end = end, end + length
            rings.append(self.points[begin:end])
        return tuple(rings)


class Dashes(NamedTuple):
    """Dashed outlines.

    Attributes:
        rows: points (n, 2) of each outline: two points per dash, then the position of a name.
        rings: rings (n, 2) of each outline.
    """

    rows: Sequence[Floats]
    rings: Sequence[tuple[Floats, ...]]


_DASHES: Final = 4
"""Parts of each side of a dashed outline; every second part is drawn."""


def dashes_of(rings: Sequence[Floats]) -> Floats:
    """Return the ends (n, 2) of the dashes along some rings, two ends per dash."""
    shares = (np.arange(_DASHES) / _DASHES)[:, None]
    sides = [(ring[:, None], (np.roll(ring, -1, axis=0) - ring)[:, None]) for ring in rings]
    return np.concatenate([(begin + shares * along).reshape(-1, 2) for begin, along in sides])


class Form(NamedTuple):
    """The primitives of a footprint: lengths of rings, and whether the footprint has a height."""

    rings: tuple[int, ...]
    has_height: bool


def rings_of(footprints: FootprintBatch, point_radius: float) -> Rings:
    """Return the rings of footprints. A point without radius becomes a disc of `point_radius`."""
    vertex_counts = np.diff(footprints.vertex_start)
    is_round = (vertex_counts == 1) | (footprints.radius > 0.0)
    ring_lengths = np.where(is_round, ROUND, vertex_counts)
    part_start = starts_from_counts(ring_lengths)
    form_indices, forms = _forms(footprints, ring_lengths)
    if not is_round.any():
        corners = footprints.vertices[footprints.vertex_start[0] : footprints.vertex_start[-1]]
        return Rings(part_start[footprints.part_start], corners, form_indices, forms, False)
    points = np.empty((part_start[-1], 2))
    is_straight = ~is_round
    points[flat_index(part_start[:-1][is_straight], vertex_counts[is_straight])] = footprints.vertices[
        flat_index(footprints.vertex_start[:-1][is_straight], vertex_counts[is_straight])
    ]
    for vertex_count in np.unique(vertex_counts[is_round]).tolist():
        part_indices = np.flatnonzero(is_round & (vertex_counts == vertex_count))
        corners = footprints.vertices[
            footprints.vertex_start[part_indices][:, None] + np.arange(vertex_count)
        ]
        radii = np.where(footprints.radius[part_indices] > 0.0, footprints.radius[part_indices], point_radius)
        points[part_start[part_indices][:, None] + np.arange(ROUND)] = _rounded_rings(corners, radii)
    return Rings(part_start[footprints.part_start], points, form_indices, forms, True)


def outlines_of(footprint: Footprint) -> list[Floats]:
    """Return the ring (n, 2) of each part of one footprint."""
    return list(rings_of(FootprintBatch.from_footprints([footprint]), 0.0).rings_of(0))


def extents(footprints: FootprintBatch) -> Floats:
    """Return (R,) the longer side of each footprint's bounding box."""
    if not len(footprints):
        return np.empty(0)
    vertex_starts = footprints.vertex_start[footprints.part_start]
    radii = np.repeat(footprints.radius, np.diff(footprints.vertex_start))[:, None]
    sides = (
        boxes(footprints.vertices + radii, vertex_starts)[1]
        - boxes(footprints.vertices - radii, vertex_starts)[0]
    )
    return np.asarray(np.maximum(sides[:, 0], sides[:, 1]))


def boxes(points: Floats, start: Integers) -> tuple[Floats, Floats]:
    """Return the low and high corners, (R, 2) each, of the bounding boxes of R rows of points.

    Args:
        points: (P, 2), points of all rows.
        start: (R + 1,), start of each row, and the end of the last row. No row is empty.
    """
    if len(start) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    points = points[: start[-1]]
    return np.minimum.reduceat(points, start[:-1]), np.maximum.reduceat(points, start[:-1])


_ANGLES = np.arange(ROUND) * (2.0 * np.pi / ROUND)
_DIRECTIONS: Final = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def _rounded_rings(corners: Floats, radius: Floats) -> Floats:
    """Return the rings (M, ROUND, 2) of M rounded parts: their outermost point in each direction.

    Args:
        corners: (M, n, 2), corners of the parts.
        radius: (M,), radius of the rounding.
    """
    x, y = _DIRECTIONS[:, :1], _DIRECTIONS[:, 1:]
    projections = corners[:, None, :, 0] * x + corners[:, None, :, 1] * y
    outermost = np.take_along_axis(corners, projections.argmax(axis=2)[:, :, None], axis=1)
    return np.asarray(outermost + radius[:, None, None] * _DIRECTIONS)


def _forms(footprints: FootprintBatch, lengths: Integers) -> tuple[Integers, tuple[Form, ...]]:
    """Return (R,), the index of each footprint's form, and the distinct forms."""
    part_counts = np.diff(footprints.part_start)
    has_height = ~np.isnan(footprints.bottom)
    columns = [part_counts, has_height]
    for part_index in range(int(part_counts.max(initial=0))):
        has_part = part_counts > part_index
        part_indices = np.where(has_part, footprints.part_start[:-1] + part_index, 0)
        columns.append(np.where(has_part, lengths[part_indices], 0))
    form_indices, forms = np.zeros(len(footprints), np.int64), list[Form]()
    for footprint_indices in equal_places(combined_code(columns, len(footprints))):
        form_indices[footprint_indices], first_footprint = len(forms), int(footprint_indices[0])
        ring_lengths = lengths[
            footprints.part_start[first_footprint] : footprints.part_start[first_footprint + 1]
        ]
        forms.append(Form(tuple(ring_lengths.tolist()), bool(has_height[first_footprint])))
    return form_indices, tuple(forms)


FRAME: Final = "world"

FRAMES: Final = (FRAME, "spatial")
"""The frame of the scene, and a child frame that makes the frame known to viewers."""

ARROW_HEAD: Final = 0.15
"""Length of an arrow's head, fraction of the objects' size; at most half of the arrow."""

_LINE_PIXELS: Final = 2.0
_LABEL_PIXELS: Final = 14.0
SLOT_BYTES: Final = b"\xfe" + b"\xff" * 7
SLOT: Final[float] = struct.unpack("<d", SLOT_BYTES)[0]
"""Placeholder for a number: a NaN whose bytes occur in no text and in no other number of a message.

UTF-8 has no bytes 0xfe and 0xff: https://www.rfc-editor.org/rfc/rfc3629#section-1"""


def encode_frame(time_ns: int) -> bytes:
    """Return the message that introduces the scene's frame to viewers, by a child frame at the origin."""
    message = FrameTransform(parent_frame_id=FRAME, child_frame_id=FRAMES[1])
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)
    message.rotation.w = 1.0
    return message.SerializeToString(deterministic=True)


class Elevation(NamedTuple):
    """The heights of an entity in footprint units; `SLOT` for heights that messages fill in.

    Attributes:
        fill: height of the filled face: the top of an object, the floor of a region.
        sides: bottom and height of a prism's sides; None for a flat entity.
        label: height of the name.
    """

    fill: float
    sides: tuple[float, float] | None
    label: float


def draw(
    entity: SceneEntity,
    name: str,
    outlines: list[Floats],
    faces: list[Floats],
    anchor: tuple[float, float],
    elevation: Elevation,
    opacity: float,
) -> None:
    """Add outlines, filled faces and the label to an entity, with slots for all colours except the label's.

    Templates fill in the numbers in this order.

    Args:
        name: text of the label; "" for no label.
        outlines, faces: rings (n, 2); a face is convex.
        anchor: position of the label.
        opacity: opacity of the faces.
    """
    for ring in outlines:
        _add_outline(entity, ring, elevation.fill)
    for ring in faces:
        if len(ring) > 2:
            _add_face(entity, ring, elevation.fill, opacity)
    if elevation.sides is not None:
        for ring in outlines:
            if len(ring) > 1:
                _add_sides(entity, ring, *elevation.sides, opacity)
    if name:
        _add_label(entity, name, anchor, elevation.label)


def _add_label(entity: SceneEntity, text: str, anchor: tuple[float, float], z: float) -> None:
    label = entity.texts.add(
        billboard=True, font_size=_LABEL_PIXELS, scale_invariant=True, text=text, pose=lying_at(z)
    )
    label.pose.position.x, label.pose.position.y = anchor
    label.color.r, label.color.g, label.color.b, label.color.a = *LABEL, 1.0


def _add_dashes(entity: SceneEntity, ends: Floats, z: float) -> None:
    line = entity.lines.add(
        type=LinePrimitive.LINE_LIST, thickness=_LINE_PIXELS, scale_invariant=True, pose=lying_at(z)
    )
    for x, y in ends.tolist():
        line.points.add(x=x, y=y)
    line.color.r, line.color.g, line.color.b, line.color.a = *NEUTRAL, 1.0


def point_at(entity: SceneEntity, label: str, lift: float, names: Sequence[str] = ()) -> None:
    """Add an arrow, names and the label to an entity, with slots for positions and the arrow's length.

    Args:
        lift: height of flat objects above the plane, which also scales the arrow's width.
    """
    arrow = entity.arrows.add(
        shaft_length=SLOT, shaft_diameter=5.0 * lift, head_length=SLOT, head_diameter=12.0 * lift
    )
    arrow.pose.position.x = arrow.pose.position.y = arrow.pose.position.z = SLOT
    arrow.pose.orientation.z = arrow.pose.orientation.w = SLOT
    arrow.color.r, arrow.color.g, arrow.color.b, arrow.color.a = *NEGATIVE, 1.0
    for text in (*names, label):
        _add_label(entity, text, (SLOT, SLOT), SLOT)


def missing_words(name: str) -> str:
    """Return the words at the last outline of a missing object."""
    return f"{name}, last seen"


def _add_outline(entity: SceneEntity, ring: Floats, z: float) -> None:
    line = entity.lines.add(
        type=LinePrimitive.LINE_LOOP, thickness=_LINE_PIXELS, scale_invariant=True, pose=lying_at(z)
    )
    for x, y in ring.tolist():
        line.points.add(x=x, y=y)
    line.color.r, line.color.g, line.color.b, line.color.a = SLOT, SLOT, SLOT, 1.0


def _add_face(entity: SceneEntity, ring: Floats, z: float, opacity: float) -> None:
    face = entity.triangles.add(pose=lying_at(z))
    for x, y in ring.tolist():
        face.points.add(x=x, y=y)
    for corner in range(1, len(ring) - 1):
        face.indices.extend((0, corner, corner + 1))
    face.color.r, face.color.g, face.color.b, face.color.a = SLOT, SLOT, SLOT, opacity


def _add_sides(entity: SceneEntity, ring: Floats, bottom: float, height: float, opacity: float) -> None:
    sides = entity.triangles.add(pose=lying_at(bottom))
    for x, y in ring.tolist():
        sides.points.add(x=x, y=y)
    for x, y in ring.tolist():
        sides.points.add(x=x, y=y, z=height)
    corner_count = len(ring)
    for corner in range(corner_count):
        next_corner = (corner + 1) % corner_count
        sides.indices.extend((corner, next_corner, corner_count + corner))
        sides.indices.extend((next_corner, corner_count + next_corner, corner_count + corner))
    sides.color.r, sides.color.g, sides.color.b, sides.color.a = SLOT, SLOT, SLOT, opacity


def lying_at(z: float) -> Pose:
    pose = Pose()
    pose.position.z = z
    pose.orientation.w = 1.0
    return pose


OBJECT_OPACITY: Final = 0.55
"""Opacity of an object's faces, greater than the opacity of the region around it."""

REGION_OPACITY: Final = 0.3
"""Opacity of a region's faces."""

OBJECT: Final = "object/"
REGION: Final = "region/"
WITNESS: Final = "witness"

LEVELS: Final = 8
"""Highest level of flat objects; smaller objects have higher levels."""

_LABEL_LIFT: Final = 0.01
"""Height of a region's name above the region, fraction of the region's size."""


class CauseText(NamedTuple):
    """Label of an arrow.

    Attributes:
        text: text before the number.
        length: length of the number with its unit, bytes.
        dashes: dashed outlines at the earlier sample of the arrow: x and y of the dashes' ends.
        names: objects and regions of the deciding atom.
    """

    text: str
    length: int
    dashes: tuple[float, ...] = ()
    names: tuple[TrackedName | RegionName, ...] = ()

    def ends(self, numbers: Sequence[bytes]) -> list[bytes]:
        """Return the last bytes of labels with their numbers: at least 8 bytes, the size of a slot."""
        text = self.text.encode().rjust(8)
        return [(text + number)[-max(8, self.length) :] for number in numbers]

    @property
    def words(self) -> list[int]:
        """The starts of the 8-byte slots in the last bytes of a label; the last two slots may overlap."""
        last = max(8, self.length) - 8
        return [*range(0, last, 8), last]


class DrawnObject(NamedTuple):
    """The drawing of an object.

    Attributes:
        level: height, 0 to `LEVELS`. Smaller objects are higher, so that larger objects do not hide them.
        label: name, with a mark if the object violated a result; "" for no label.
    """

    name: str
    form: Form
    level: int
    label: str


class SceneLayout(NamedTuple):
    """The structure of a message, which determines the offsets of all numbers.

    Attributes:
        deleted: objects of the previous message that are gone.
        objects: observed objects.
        missing: names of missing objects that a specification mentions, with the number of points of their
            last outlines (see `Dashes`).
        witness: label of the arrow at the violation; "deleted" to delete the previous arrow; None without
            an arrow.
        names: names at the arrow; with any, the message has no other names.
    """

    deleted: tuple[str, ...]
    objects: tuple[DrawnObject, ...]
    missing: tuple[tuple[str, int], ...] = ()
    witness: CauseText | Literal["deleted"] | None = None
    names: tuple[str, ...] = ()

    @property
    def has_heights(self) -> bool:
        """Whether any object has a height."""
        return any(figure.form.has_height for figure in self.objects)


class Region(NamedTuple):
    """A region with its convex parts for drawing.

    Attributes:
        name: name of the region.
        outline: border in the specification.
        rings: convex parts, (n, 2) each.
    """

    name: str
    outline: Outline
    rings: tuple[Floats, ...]

    @property
    def size(self) -> float:
        """The longer side of the region's bounding box."""
        return float(np.ptp(np.concatenate(self.rings), axis=0).max())


@dataclass(frozen=True, eq=False)
class SceneTemplate:
    """Messages of one layout, without their times, coordinates and colours.

    Attributes:
        template: encoded message with words to fill in.
        order: (W,), index of the number for each word. Most numbers fill several words.
    """

    template: WireTemplate
    order: Integers

    def encode(self, numbers: Words) -> Payloads:
        """Encode K messages from their N numbers, (K, N)."""
        return self.template.encode(numbers.take(self.order, axis=1))


class EncodedRegions(NamedTuple):
    """The encoded regions of all messages.

    Attributes:
        number: number of regions.
        entities: encoded entities, without colours and timestamps.
        order: index of the number for each word of the entities.
    """

    number: int
    entities: bytes
    order: list[int]


def encode_regions(regions: Sequence[Region], *, named: bool = True) -> EncodedRegions:
    """Encode regions, with or without names. Larger regions are lower, and do not hide smaller regions."""
    sizes = [region.size for region in regions]
    message, number_indices = SceneUpdate(), list[int]()
    for region_index, (region, size) in enumerate(zip(regions, sizes, strict=True)):
        smaller_count = sum(other_size < size for other_size in sizes)
        depth = _LABEL_LIFT * smaller_count / len(regions) * min(sizes)
        entity = _add_entity(message, REGION + region.name)
        _add_region(entity, region, depth, named=named)
        first_colour = len(_STAMP_WORDS) + 3 * region_index
        number_indices += [first_colour, first_colour + 1, first_colour + 2] * (
            len(entity.lines) + len(entity.triangles)
        )
    return EncodedRegions(len(regions), _encode(message), number_indices)


def make_template(layout: SceneLayout, regions: EncodedRegions, lift: float) -> SceneTemplate:
    """Return the template of a layout.

    A message has these numbers in this order: timestamp (2), colours of the regions (3 each), points of all
    objects (2 each), colours of the objects (3 each), and positions of names (2 each). If an object has a
    height, four numbers per object follow: top, bottom, height, and height of the name. The last outlines of
    missing objects follow (see `Dashes`). The numbers of the arrow and of its names come last.

    Args:
        lift: height of flat objects above the plane, so that they cover regions.
    """
    deletions, last_entities = SceneUpdate(), SceneUpdate()
    for name in layout.deleted:
        deletions.deletions.add(id=OBJECT + name, type=SceneEntityDeletion.MATCHING_ID, timestamp=_A_STAMP)
    if layout.witness == "deleted":
        deletions.deletions.add(id=WITNESS, type=SceneEntityDeletion.MATCHING_ID, timestamp=_A_STAMP)
    places_by_object, end = _places(layout, regions.number)
    label_words, number_indices = list[int](), [*regions.order]
    for figure, object_places in zip(layout.objects, places_by_object, strict=True):
        number_indices += _order_of_object(figure, object_places)
    for name, length in layout.missing:
        entity = _add_entity(last_entities, OBJECT + name)
        _add_dashes(entity, np.full((length - 1, 2), SLOT), lift)
        number_indices += range(end, end + 2 * (length - 1))
        if not isinstance(layout.witness, CauseText):
            _add_label(entity, missing_words(name), (SLOT, SLOT), 2.5 * lift)
            number_indices += range(end + 2 * (length - 1), end + 2 * length)
        end += 2 * length
    if isinstance(layout.witness, CauseText):
        number_text = "#" * layout.witness.length
        entity = _add_entity(last_entities, WITNESS)
        if layout.witness.dashes:
            _add_dashes(entity, np.reshape(layout.witness.dashes, (-1, 2)), lift)
        point_at(entity, layout.witness.text + number_text, lift, layout.names)
        label_words = layout.witness.words
        names_begin = end + _ARROW_NUMBERS
        label_begin = names_begin + 2 * len(layout.names)
        number_indices += range(end, names_begin)
        for name_begin in range(names_begin, label_begin, 2):
            number_indices += [name_begin, name_begin + 1, label_begin + 2]
        number_indices += range(label_begin, label_begin + 3 + len(label_words))
    encoded_objects = [_encoded_object(figure, lift) for figure in layout.objects]
    # parsers join the lists of concatenated messages:
    # https://protobuf.dev/programming-guides/encoding/#last-one-wins
    encoded = b"".join([_encode(deletions), regions.entities, *encoded_objects, _encode(last_entities)])
    # the arrow's label is the last field, so its slots are at the end
    slot_offsets = [
        *_offsets(encoded, SLOT_BYTES),
        *(len(encoded) - 8 - label_words[-1] + offset for offset in label_words),
    ]
    stamp_offsets = _offsets(encoded, _STAMP_BYTES)
    payload = np.frombuffer(encoded.replace(SLOT_BYTES, bytes(8)), np.uint8)
    word_offsets = [
        *slot_offsets,
        *(stamp_offset + offset for stamp_offset in stamp_offsets for offset in _STAMP_WORDS),
    ]
    template = WireTemplate(payload, np.array(word_offsets, np.int64), np.empty(0, np.int64))
    return SceneTemplate(template, np.array(number_indices + [0, 1] * len(stamp_offsets), np.int64))


def _encode(message: SceneUpdate) -> bytes:
    return message.SerializeToString(deterministic=True)


def border_of(region: Region) -> list[Floats]:
    """Return the rings (n, 2) that outline a region: the ring of a disc, or the specified border."""
    return list(region.rings) if region.outline.is_disc else [np.array(region.outline.vertices, np.float64)]


class _Places(NamedTuple):
    """The starts of an object's numbers among the numbers of a message, see `make_template`."""

    points: int
    colour: int
    middle: int
    heights: int


def _places(layout: SceneLayout, region_count: int) -> tuple[list[_Places], int]:
    """Return the starts of the numbers of each object, and their end."""
    point_numbers = [2 * sum(figure.form.rings) for figure in layout.objects]
    first_begin = len(_STAMP_WORDS) + 3 * region_count
    *point_begins, colour_begin = accumulate(point_numbers, initial=first_begin)
    middle_begin = colour_begin + 3 * len(point_numbers)
    height_begin = middle_begin + 2 * len(point_numbers)
    end = height_begin + (4 * len(point_numbers) if layout.has_heights else 0)
    return [
        _Places(point_begin, colour_begin + 3 * index, middle_begin + 2 * index, height_begin + 4 * index)
        for index, point_begin in enumerate(point_begins)
    ], end


def _order_of_object(figure: DrawnObject, places: _Places) -> list[int]:
    """Return the index of the number for each word of an object, in the order of its primitives."""
    rings, form = _corners(figure.form.rings, places.points), figure.form
    colour_numbers = list(range(places.colour, places.colour + 3))
    top, bottom, height, label = range(places.heights, places.heights + 4)
    top_numbers = [top] if form.has_height else []
    flat_points = [[number_index for corner in ring for number_index in corner] for ring in rings]
    number_indices = []
    for points in flat_points:
        number_indices += [*top_numbers, *points, *colour_numbers]
    for points in flat_points:
        if len(points) > 4:
            number_indices += [*top_numbers, *points, *colour_numbers]
    if form.has_height:
        for ring, points in zip(rings, flat_points, strict=True):
            if len(ring) > 1:
                raised_points = [number_index for x, y in ring for number_index in (x, y, height)]
                number_indices += [bottom, *points, *raised_points, *colour_numbers]
    if figure.label:
        number_indices += [places.middle, places.middle + 1, *([label] if form.has_height else [])]
    return number_indices


def _corners(ring_lengths: tuple[int, ...], begin: int) -> list[list[tuple[int, int]]]:
    """Return the indices of x and y of each point, by ring."""
    ends = np.cumsum(ring_lengths).tolist()
    return [
        [(begin + 2 * point, begin + 2 * point + 1) for point in range(end - length, end)]
        for end, length in zip(ends, ring_lengths, strict=True)
    ]


_ARROW_NUMBERS: Final = 7
"""Numbers of the arrow itself: the columns of `numbers_of_witness` before names and label."""


def numbers_of_witness(
    points: Floats,
    z: Floats,
    names: Floats,
    label_places: Floats,
    scale: float,
    labels: Sequence[bytes],
    words: Sequence[int],
) -> list[Floats]:
    """Return the columns of numbers of the arrow, its names and its label.

    Args:
        points: (S, 2, 2), begin and end of the arrow.
        z: (S,), height of the arrow.
        names: (S, names, 2), centres of the names at the arrow.
        label_places: (S, 2), centres of the labels on the plane.
        scale: size of objects in the scene.
        labels: last bytes of S labels, of equal lengths (see `CauseText.ends`).
        words: starts of the slots in these bytes (see `CauseText.words`).
    """
    begins, ends = points[:, 0], points[:, 1]
    lengths = np.hypot(*(ends - begins).T)
    half_angles = 0.5 * np.arctan2(*(ends - begins).T[::-1])
    head_lengths = np.minimum(0.5 * lengths, ARROW_HEAD * scale)
    arrow_columns = [
        begins,
        z,
        np.sin(half_angles),
        np.cos(half_angles),
        lengths - head_lengths,
        head_lengths,
    ]
    label_centres = [label_places, z + ARROW_HEAD * scale]
    label_bytes = b"".join([label[start : start + 8] for label in labels for start in words])
    label_numbers = np.frombuffer(label_bytes, "<f8")
    return [
        column.reshape(len(points), -1) for column in (*arrow_columns, names, *label_centres, label_numbers)
    ]


def _add_entity(message: SceneUpdate, identifier: str) -> SceneEntity:
    return message.entities.add(id=identifier, frame_id=FRAME, timestamp=_A_STAMP)


def _add_region(entity: SceneEntity, region: Region, depth: float, *, named: bool) -> None:
    """Add a region: its border, its convex parts as faces, and its name at the upper edge.

    At the upper edge, objects inside seldom cover the name. The face of a prism is its floor, because a roof
    would hide the objects inside.

    Args:
        depth: depth of a flat region below the plane.
    """
    bottom, top = region.outline.height or (0.0, 0.0)
    sides = None if region.outline.height is None else (bottom, top - bottom)
    all_points = np.concatenate(region.rings)
    (left, low), (right, high) = all_points.min(axis=0).tolist(), all_points.max(axis=0).tolist()
    label_height = top + _LABEL_LIFT * max(right - left, high - low)
    draw(
        entity,
        region.name if named else "",
        border_of(region),
        list(region.rings),
        ((left + right) / 2.0, high),
        Elevation(-depth if sides is None else bottom, sides, label_height),
        REGION_OPACITY,
    )


@lru_cache(4096)
def _encoded_object(figure: DrawnObject, lift: float) -> bytes:
    """Encode an object, cached because consecutive layouts share most objects."""
    message = SceneUpdate()
    rings = [np.full((length, 2), SLOT) for length in figure.form.rings]
    elevation = Elevation(lift * (1.0 + figure.level / LEVELS), None, 2.5 * lift)
    if figure.form.has_height:
        elevation = Elevation(SLOT, (SLOT, SLOT), SLOT)
    entity = _add_entity(message, OBJECT + figure.name)
    draw(entity, figure.label, rings, rings, (SLOT, SLOT), elevation, OBJECT_OPACITY)
    return _encode(message)


# ------------------------------------------------------------------------------------------- timestamps

# Varints may be padded (https://protobuf.dev/programming-guides/encoding/#varints): with five bytes each, all
# stamps have one length.
_SECONDS, _NANOS = (1 << 34) - 1, (1 << 30) - 1
_A_STAMP: Final = Timestamp(seconds=_SECONDS, nanos=_NANOS)
# no text has the bytes 0xff of this stamp, and all other numbers are slots or ordinary constants
_STAMP_BYTES: Final = _A_STAMP.SerializeToString()
_STAMP: Final = len(_STAMP_BYTES)
_STAMP_WORDS: Final = (0, _STAMP - 8)
_NS: Final = 1_000_000_000


def _offsets(payload: bytes, pattern: bytes) -> list[int]:
    return [hit.start() for hit in re.finditer(re.escape(pattern), payload)]


def encoded_stamps(times_ns: Integers) -> Words:
    """Encode nanoseconds (S,) as timestamps: (S, 2) overlapping words at the offsets `_STAMP_WORDS`."""
    seconds, nanos = map(_five_bytes, np.divmod(times_ns, _NS))
    # a timestamp is a tag, five bytes, a tag, five bytes; the words are its first and its last eight bytes
    first_words = 0x08 | seconds << 8 | 0x10 << 48 | nanos << 56
    last_words = seconds >> 24 | 0x10 << 16 | nanos << 24
    return np.stack([first_words, last_words], axis=1).view(np.uint64)


def _five_bytes(numbers: Integers) -> Integers:
    """Encode numbers below 2^35 as varints of five bytes."""
    padded = np.full(len(numbers), 0x80808080)
    for byte_index in range(5):
        padded |= (numbers >> 7 * byte_index & 0x7F) << 8 * byte_index
    return padded

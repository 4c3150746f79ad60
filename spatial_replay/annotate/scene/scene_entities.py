"""How the entities of the scene are drawn: outlines, faces, sides, labels and arrows.

Every part of a footprint is drawn as one ring of points (`rings`). Numbers that differ between messages are
`SLOT` here and filled in later (`scene_template`).
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity

from spatial_replay.geometry.arrays import Floats
from spatial_replay.palette import LABEL, NEGATIVE

FRAME: Final = "world"

FRAMES: Final = (FRAME, "spatial")
"""The frame of the scene, and the child by which viewers know it."""

ARROW_HEAD: Final = 0.15
"""The length of an arrow's head by the size of the objects in a scene; of a short arrow it is half."""

_LINE_PIXELS: Final = 2.0
_LABEL_PIXELS: Final = 14.0
SLOT_BYTES: Final = b"\xfe" + b"\xff" * 7
SLOT: Final[float] = struct.unpack("<d", SLOT_BYTES)[0]
"""A number that is to be filled in: a NaN whose bytes are in no text, and in no message but where it is."""


def encode_frame(time_ns: int) -> bytes:
    """Return the message that makes the scene's frame known to viewers: a frame in the same place."""
    message = FrameTransform(parent_frame_id=FRAME, child_frame_id=FRAMES[1])
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)
    message.rotation.w = 1.0
    return message.SerializeToString(deterministic=True)


class Elevation(NamedTuple):
    """The heights of an entity, in footprint units; `SLOT` where it is to be filled in.

    Attributes:
        fill: of its filled face, the upper one of a prism.
        sides: from where to where a prism's sides reach: bottom and height; None for a flat entity.
        label: of its name.
    """

    fill: float
    sides: tuple[float, float] | None
    label: float


def draw(
    entity: SceneEntity,
    name: str | None,
    outlines: list[Floats],
    faces: list[Floats],
    anchor: tuple[float, float],
    elevation: Elevation,
    opacity: float,
) -> None:
    """Add outlines, filled faces and the label to an entity; every colour but the label's is to be filled in.

    `scene_template` fills in the numbers in this order.

    Args:
        name: what the label says; None leaves it out.
        outlines, faces: rings (n, 2); a face is convex.
        anchor: the position of the label.
        opacity: of the faces.
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
    if name is None:
        return
    label = entity.texts.add(
        billboard=True,
        font_size=_LABEL_PIXELS,
        scale_invariant=True,
        text=name,
        pose=lying_at(elevation.label),
    )
    label.pose.position.x, label.pose.position.y = anchor
    label.color.r, label.color.g, label.color.b, label.color.a = *LABEL, 1.0


def point_at(entity: SceneEntity, label: str, lift: float) -> None:
    """Add an arrow and its label to an entity; their positions and the arrow's length are to be filled in.

    Args:
        lift: height of flat objects above the plane, and a fifth of an arrow's width.
    """
    arrow = entity.arrows.add(
        shaft_length=SLOT, shaft_diameter=5.0 * lift, head_length=SLOT, head_diameter=12.0 * lift
    )
    arrow.pose.position.x = arrow.pose.position.y = arrow.pose.position.z = SLOT
    arrow.pose.orientation.z = arrow.pose.orientation.w = SLOT
    arrow.color.r, arrow.color.g, arrow.color.b, arrow.color.a = *NEGATIVE, 1.0
    text = entity.texts.add(billboard=True, font_size=_LABEL_PIXELS, scale_invariant=True, text=label)
    text.pose.position.x = text.pose.position.y = text.pose.position.z = SLOT
    text.pose.orientation.w = 1.0
    text.color.r, text.color.g, text.color.b, text.color.a = *LABEL, 1.0


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
    count = len(ring)
    for low in range(count):
        following = (low + 1) % count
        sides.indices.extend((low, following, count + low, following, count + following, count + low))
    sides.color.r, sides.color.g, sides.color.b, sides.color.a = SLOT, SLOT, SLOT, opacity


def lying_at(z: float) -> Pose:
    pose = Pose()
    pose.position.z = z
    pose.orientation.w = 1.0
    return pose

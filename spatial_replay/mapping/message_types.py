"""Layouts of messages: the type of a topic and its entry in the mapping in, a `MessageLayout` out.

Built-in types have their own layouts. All other types share one layout, which lists common field names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping as Table
from dataclasses import dataclass, field, replace
from fnmatch import translate
from types import MappingProxyType
from typing import Literal, TypeAlias

from spatial_replay.mapping.field_paths import name_from_topic
from spatial_replay.mapping.mapping_file import (
    ClassMapping,
    Measure,
    ShapeMapping,
    Stamp,
    TopicMapping,
    Uncertainty,
)

Alternatives: TypeAlias = tuple[str, ...]
"""Alternative field paths; the first path that resolves is used."""

_NO_CLASSES: Table[str, str | None] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class MessageLayout:
    """Paths of the fields of objects in a topic's messages, before the first message is read.

    Attributes:
        objects: path of the list of objects; "" for a message that is one object.
        complete: whether a message lists all existing objects.
        stays: whether an object stays valid until it is deleted.
        name: name template.
        position: alternatives, each the path of a point or the paths of its coordinates.
        orientation: alternatives, each the path of a quaternion or the paths of its x, y, z and w.
        order: order of the four numbers of a quaternion in a list; "" if unknown.
        yaw: alternative paths of an angle.
        angle_scale: radians per unit of `yaw`; negative if the angle counts clockwise.
        angle_zero: yaw in radians at angle 0.
        polygon: path of the corners, or paths of the bounds' four numbers.
        is_bounds: whether `polygon` is two opposite corners of an axis-aligned box.
        bounds_have_size: whether the last two numbers are width and height instead of a corner.
        sizes: alternatives, each the paths of length, width and maybe height of a box.
        frame, stamp: alternative paths in the object or, with `$.`, in the message. An object with an empty
            frame has the message's frame.
        own_stamp: path of an object's own stamp; transforms are looked up at this stamp instead of the
            message's stamp. "" if objects have no own stamp.
        solids: kind of message that lists an object's solids; "" for objects with a single shape.
        is_generic: whether the fields are guesses for an unknown type.
        origin: latitude and longitude of (0, 0) for positions in degrees; None for other positions.
        is_geojson: whether features are in a JSON text, with longitudes and latitudes as corners.
        corner_origin: latitude and longitude of (0, 0) for corners in degrees; None for other corners.
        scale: units of the log per unit of positions, sizes, heights and uncertainties.
        invalid: numbers that stand for a missing value.
    """

    objects: str = ""
    complete: bool = False
    stays: bool = False
    name: str = "{topic}"
    position: tuple[Alternatives, ...] = ()
    orientation: tuple[str | Alternatives, ...] = ()
    order: Literal["", "xyzw", "wxyz"] = ""
    yaw: Alternatives = ()
    angle_scale: float = 1.0
    angle_zero: float = 0.0
    polygon: Alternatives = ()
    is_bounds: bool = False
    bounds_have_size: bool = False
    sizes: tuple[Alternatives, ...] = ()
    class_name: str | None = None
    class_field: Alternatives = ()
    class_table: Table[str, str | None] = field(default_factory=lambda: _NO_CLASSES, hash=False)
    class_other: str | None = None
    class_has_other: bool = False
    class_changes: Literal["remark", "split", "first"] = "remark"
    covariance: str = ""
    frame: Alternatives = ("$.header.frame_id",)
    frame_name: str | None = None
    stamp: tuple[Stamp, ...] = (Stamp("$.header.stamp"),)
    own_stamp: str = ""
    solids: Literal["", "marker", "scene", "primitive"] = ""
    shape: ShapeMapping | None = None
    height: tuple[Measure, Measure] | None = None
    uncertainty: Uncertainty | None = None
    is_generic: bool = False
    origin: tuple[float, float] | None = None
    is_geojson: bool = False
    corner_origin: tuple[float, float] | None = None
    scale: float = 1.0
    invalid: tuple[float, ...] = ()

    @property
    def is_geodetic(self) -> bool:
        """Whether positions or corners are degrees, to be converted to metres from the mapping's origin."""
        return self.origin is not None or self.corner_origin is not None


# classification codes of derived_object_msgs/Object, from 0
_UNKNOWN = ("unknown", "unknown_small", "unknown_medium", "unknown_big")
_KNOWN = ("pedestrian", "bike", "car", "truck", "motorcycle", "other_vehicle", "barrier", "sign")
_OBJECT_CLASSES = MappingProxyType({str(i): name for i, name in enumerate((*_UNKNOWN, *_KNOWN))})

# names of the field in successive versions of vision_msgs
_RESULT_CLASS = ("results[best].hypothesis.class_id", "results[best].id", "results[best].hypothesis.id")

_POSE = MessageLayout(position=(("pose.position",),), orientation=("pose.orientation",))
_POSE_WITH_COVARIANCE = MessageLayout(
    position=(("pose.pose.position",),), orientation=("pose.pose.orientation",), covariance="pose.covariance"
)
_POSES = MessageLayout(
    objects="poses[*]",
    complete=True,
    name="{topic}_{index}",
    position=(("position",),),
    orientation=("orientation",),
)
_OWN_FRAME = ("header.frame_id", "$.header.frame_id")
_DETECTIONS = MessageLayout(
    objects="detections[*]",
    complete=True,
    name="{topic}_{id|tracking_id|index}",
    class_field=_RESULT_CLASS,
    frame=_OWN_FRAME,
    own_stamp="header.stamp",
)
_TRANSFORM = MessageLayout(
    name="{child_frame_id}",
    position=(("transform.translation",),),
    orientation=("transform.rotation",),
    frame=("header.frame_id",),
    stamp=(Stamp("header.stamp"),),
)
_FRAME_TRANSFORM = MessageLayout(
    name="{child_frame_id}",
    position=(("translation",),),
    orientation=("rotation",),
    frame=("parent_frame_id",),
    stamp=(Stamp("timestamp"),),
)
_MARKER = MessageLayout(
    name="{ns|topic}_{id}",
    stays=True,
    solids="marker",
    frame=("header.frame_id",),
    stamp=(Stamp("header.stamp"),),
)

GEODETIC: Alternatives = ("latitude", "longitude")
"""Fields of a fix, in degrees."""
# the layout has no frame, because a receiver's frame does not affect latitude and longitude. The status is
# negative without a fix (sensor_msgs/NavSatStatus).
_FIX = MessageLayout(position=((*GEODETIC, "status.status"), GEODETIC), frame=())

BUILT_IN: Table[str, MessageLayout] = MappingProxyType(
    {
        "geometry_msgs/PoseStamped": _POSE,
        "geometry_msgs/PoseWithCovarianceStamped": _POSE_WITH_COVARIANCE,
        "nav_msgs/Odometry": _POSE_WITH_COVARIANCE,
        "geometry_msgs/PoseArray": _POSES,
        "geometry_msgs/PolygonStamped": MessageLayout(polygon=("polygon.points",)),
        "geometry_msgs/TransformStamped": _TRANSFORM,
        "tf2_msgs/TFMessage": replace(_TRANSFORM, objects="transforms[*]"),
        # the type of tf in ROS 1, before tf2
        "tf/tfMessage": replace(_TRANSFORM, objects="transforms[*]"),
        "visualization_msgs/Marker": _MARKER,
        "visualization_msgs/MarkerArray": replace(_MARKER, objects="markers[*]"),
        "vision_msgs/Detection2DArray": replace(
            _DETECTIONS,
            # vision_msgs 4 has a point in the centre, earlier versions have x and y
            position=(
                ("bbox.center.position.x", "bbox.center.position.y"),
                ("bbox.center.x", "bbox.center.y"),
            ),
            yaw=("bbox.center.theta",),
            sizes=(("bbox.size_x", "bbox.size_y"),),
        ),
        "vision_msgs/Detection3DArray": replace(
            _DETECTIONS,
            position=(("bbox.center.position",),),
            orientation=("bbox.center.orientation",),
            sizes=(("bbox.size.x", "bbox.size.y", "bbox.size.z"),),
        ),
        "apriltag_msgs/AprilTagDetectionArray": MessageLayout(
            objects="detections[*]",
            complete=True,
            name="tag{id}",
            polygon=("corners",),
            class_field=("family",),
        ),
        "derived_object_msgs/ObjectArray": MessageLayout(
            objects="objects[*]",
            complete=True,
            name="object_{id}",
            position=(("pose.position",),),
            orientation=("pose.orientation",),
            frame=_OWN_FRAME,
            own_stamp="header.stamp",
            solids="primitive",
            class_field=("classification",),
            class_table=_OBJECT_CLASSES,
        ),
        "foxglove/SceneUpdate": MessageLayout(
            objects="entities[*]",
            stays=True,
            name="{id|index}",
            solids="scene",
            frame=("frame_id",),
            stamp=(Stamp("timestamp"),),
        ),
        "foxglove/PosesInFrame": replace(_POSES, frame=("$.frame_id",), stamp=(Stamp("$.timestamp"),)),
        "foxglove/PoseInFrame": replace(_POSE, frame=("$.frame_id",), stamp=(Stamp("$.timestamp"),)),
        "foxglove/FrameTransform": _FRAME_TRANSFORM,
        "sensor_msgs/NavSatFix": _FIX,
        "foxglove/LocationFix": replace(_FIX, stamp=(Stamp("$.timestamp"),)),
        "foxglove/GeoJSON": MessageLayout(
            objects="features[*]",
            complete=True,
            name="{id|properties.name|index}",
            polygon=("geometry",),
            frame=(),
            stamp=(),
            is_geojson=True,
        ),
        "foxglove/FrameTransforms": replace(_FRAME_TRANSFORM, objects="transforms[*]"),
    }
)

TRANSFORM_TYPES = frozenset(kind for kind, layout in BUILT_IN.items() if layout.name == "{child_frame_id}")

GEODETIC_TYPES = frozenset(
    kind for kind, layout in BUILT_IN.items() if GEODETIC in layout.position or layout.is_geojson
)

_POINTS = ("pose.pose.position", "pose.position", "position", "base.position", "pose", "center", "centre")

GENERIC = MessageLayout(
    position=(*((path,) for path in _POINTS), ("x", "y", "z"), ("x", "y")),
    orientation=("pose.pose.orientation", "pose.orientation", "orientation"),
    yaw=("theta", "yaw", "heading", "pose.theta", "pose.yaw", "base.orientation.yaw"),
    frame=(
        *("header.frame_id", "$.header.frame_id", "frame_id", "$.frame_id"),
        # names in ProtoJSON (https://protobuf.dev/programming-guides/json/)
        *("header.frameId", "$.header.frameId", "frameId", "$.frameId"),
    ),
    stamp=tuple(
        Stamp(path)
        for path in ("header.stamp", "$.header.stamp", "stamp", "$.stamp", "timestamp", "$.timestamp")
    ),
    is_generic=True,
)
"""Layout of an unknown type: common names of the fields of poses."""


_LATITUDE, _LONGITUDE = re.compile(r"lat(itude)?", re.I), re.compile(r"lon|lng|long(itude)?", re.I)


def geodetic_order(paths: Alternatives) -> Alternatives | None:
    """Return the paths named latitude and longitude among a position's paths; None without these names."""
    last_names = [path.rpartition(".")[2] for path in paths]
    latitude_paths = [path for path, name in zip(paths, last_names, strict=True) if _LATITUDE.fullmatch(name)]
    longitude_paths = [
        path for path, name in zip(paths, last_names, strict=True) if _LONGITUDE.fullmatch(name)
    ]
    return (latitude_paths[0], longitude_paths[0]) if latitude_paths and longitude_paths else None


def geodetic_paths(layout: MessageLayout) -> Alternatives | None:
    """Return the paths of latitude and longitude of a layout; None for coordinates in metres."""
    return next(filter(None, map(geodetic_order, layout.position[:1])), None)


def short_type(name: str) -> str:
    """Return `pkg/Name` for the name of a type in ROS 1, ROS 2, protobuf or Foxglove's JSON schemas."""
    words = re.split(r"[/.]|::", name)
    short_name = f"{words[0]}/{words[-1]}" if len(words) > 1 else name
    return re.sub(r"^(ros_)?foxglove_msgs/", "foxglove/", short_name)


def name_pattern(layout: MessageLayout, mapping: TopicMapping) -> str:
    """Return a regular expression for the possible names of a topic's objects."""
    template_parts = re.split(r"\{([^{}]+)\}", layout.name)
    topic_names = [
        name_from_topic(mapping.topic) if part == "topic" else None for part in template_parts[1::2]
    ]
    field_patterns = [".+" if text is None else re.escape(text) for text in topic_names]
    literals = [re.escape(part) for part in template_parts[::2]]
    template = literals[0] + "".join(
        field_pattern + text for field_pattern, text in zip(field_patterns, literals[1:], strict=True)
    )
    only_pattern, without_pattern = (
        "|".join(map(translate, patterns)) for patterns in (mapping.only, mapping.without)
    )
    if layout.class_changes == "split":
        template += "(_.+)?"
    return (
        (f"(?={only_pattern})" if only_pattern else "")
        + (f"(?!{without_pattern})" if without_pattern else "")
        + template
    )


def possible_classes(layout: MessageLayout) -> frozenset[str] | None:
    """Return the possible classes of objects, in lower case; None if any class is possible."""
    if not layout.class_field:
        return frozenset({layout.class_name.casefold()} if layout.class_name else ())
    if not layout.class_has_other:
        return None
    names = (*layout.class_table.values(), layout.class_other)
    return frozenset(name.casefold() for name in names if name)


def layout_of_topic(topic_type: str, mapping: TopicMapping) -> MessageLayout:
    """Return the layout of a topic: the layout of its type, with the changes of its mapping."""
    layout = BUILT_IN.get(short_type(mapping.type or topic_type), GENERIC)
    is_list = mapping.objects is not None
    if is_list and mapping.objects != layout.objects:
        # elements of a list other than the type's list of objects have other fields
        layout = GENERIC
    changes: dict[str, object] = {}
    if is_list:
        changes["objects"] = mapping.objects
        changes["complete"] = layout.complete or layout.is_generic
    if mapping.complete is not None:
        changes["complete"] = mapping.complete
    if mapping.name is not None:
        changes["name"] = mapping.name
    elif is_list and layout.is_generic:
        changes["name"] = "{topic}_{id|index}"
    changes |= _pose_changes(mapping) | _shape_changes(mapping) | _class_changes(mapping.class_name)
    if mapping.frame is not None or mapping.frame_field is not None:
        paths = (mapping.frame_field,) if mapping.frame_field else ()
        changes |= {"frame_name": mapping.frame, "frame": paths}
    if mapping.stamp is not None:
        changes |= {"stamp": (mapping.stamp,), "own_stamp": ""}
    if mapping.uncertainty is not None:
        changes["uncertainty"] = mapping.uncertainty
    changes |= {"scale": mapping.scale, "invalid": mapping.invalid}
    return replace(layout, **changes)  # type: ignore[arg-type]


def _pose_changes(mapping: TopicMapping) -> dict[str, object]:
    changes: dict[str, object] = {}
    if mapping.position is not None:
        paths = (mapping.position,) if isinstance(mapping.position, str) else mapping.position
        changes |= {"position": (paths,), "polygon": (), "solids": ""}
        if geodetic_order(paths) is not None:
            changes["frame"] = ()
    if mapping.orientation is not None:
        changes |= {"orientation": (mapping.orientation,), "yaw": ()}
    if mapping.yaw is not None:
        changes |= {"yaw": (mapping.yaw.field,), "orientation": ()}
        changes |= {"angle_scale": mapping.yaw.scale, "angle_zero": mapping.yaw.zero}
    if mapping.order is not None:
        changes["order"] = mapping.order
    return changes


def _shape_changes(mapping: TopicMapping) -> dict[str, object]:
    changes: dict[str, object] = {}
    if mapping.polygon is not None:
        changes |= {"polygon": (mapping.polygon,), "sizes": (), "solids": ""}
    if mapping.bounds is not None:
        paths = (mapping.bounds,) if isinstance(mapping.bounds, str) else mapping.bounds
        changes |= {"polygon": paths, "is_bounds": True, "bounds_have_size": mapping.bounds_have_size}
        changes |= {"sizes": (), "solids": ""}
    if mapping.shape is not None:
        changes |= {"shape": mapping.shape, "polygon": (), "sizes": (), "solids": ""}
    if mapping.height is not None:
        changes["height"] = mapping.height
    return changes


def _class_changes(class_name: str | ClassMapping | None) -> dict[str, object]:
    if class_name is None:
        return {}
    if isinstance(class_name, str):
        return {"class_name": class_name, "class_field": ()}
    return {
        "class_field": (class_name.field,),
        "class_table": class_name.table,
        "class_other": class_name.other,
        "class_has_other": class_name.has_other,
        "class_changes": class_name.changes,
    }

"""Messages of all types, added to an assembler as a reader would add them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from spatial_replay import Trace
from spatial_replay.bags.decoders import Topic
from spatial_replay.bags.definitions import Decoder
from spatial_replay.bags.reader import Message
from spatial_replay.mapping.assemble import Assembler
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan
from spatial_replay.trace.doubts import Doubt

SECOND = 10**9

_DEFINITIONS = {
    "vision_msgs/msg/BoundingBox2D": "Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/Pose2D": "Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\n",
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox2D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nDetection2D[] detections\n",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": "string family\nint32 id\nPoint centre\nPoint[4] corners\n",
    "apriltag_msgs/msg/AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections\n",
    "derived_object_msgs/msg/Object": (
        "std_msgs/Header header\nuint32 id\ngeometry_msgs/Pose pose\ngeometry_msgs/Polygon polygon\n"
        "shape_msgs/SolidPrimitive shape\nuint8 classification\n"
    ),
    "derived_object_msgs/msg/ObjectArray": "std_msgs/Header header\nObject[] objects\n",
    "turtlesim/msg/Pose": "float32 x\nfloat32 y\nfloat32 theta\n",
}


@cache
def types() -> Typestore:
    """Return the types of ROS 2, with some of further packages."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def ros(name: str, **values: Any) -> Any:
    """Make a ROS message; fields that are not given are 0 or empty."""
    package, _, short = name.partition("/")
    kind = types().types[f"{package}/msg/{short}"]
    _, fields = types().fielddefs[f"{package}/msg/{short}"]
    return kind(**{key: values[key] if key in values else _default(definition) for key, definition in fields})


def _default(definition: Any) -> Any:
    node, detail = definition
    if node.name == "BASE":
        return "" if detail[0] == "string" else 0
    if node.name == "NAME":
        package, _, short = detail.partition("/msg/")
        return ros(f"{package}/{short}")
    (inner, _), count = detail[0], detail[1]
    return [0.0] * count if node.name == "ARRAY" and inner.name == "BASE" else []


def header(frame: str = "", time_ns: int = 0) -> Any:
    stamp = ros("builtin_interfaces/Time", sec=time_ns // SECOND, nanosec=time_ns % SECOND)
    return ros("std_msgs/Header", stamp=stamp, frame_id=frame)


def pose(x: float, y: float, z: float = 0.0, turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Any:
    return ros(
        "geometry_msgs/Pose",
        position=ros("geometry_msgs/Point", x=x, y=y, z=z),
        orientation=ros("geometry_msgs/Quaternion", **dict(zip("xyzw", turn, strict=True))),
    )


def pose_stamped(x: float, y: float, frame: str = "map", time_ns: int = 0, **more: Any) -> Any:
    return ros("geometry_msgs/PoseStamped", header=header(frame, time_ns), pose=pose(x, y, **more))


def transform(
    parent: str,
    child: str,
    at: Sequence[float],
    turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    time_ns: int = 0,
) -> Any:
    moved = ros(
        "geometry_msgs/Transform",
        translation=ros("geometry_msgs/Vector3", **dict(zip("xyz", at, strict=True))),
        rotation=ros("geometry_msgs/Quaternion", **dict(zip("xyzw", turn, strict=True))),
    )
    return ros(
        "geometry_msgs/TransformStamped",
        header=header(parent, time_ns),
        child_frame_id=child,
        transform=moved,
    )


def tf(*transforms: Any) -> Any:
    return ros("tf2_msgs/TFMessage", transforms=list(transforms))


def type_of(content: Any) -> str:
    """Return the type of a message as logs name it."""
    descriptor = getattr(content, "DESCRIPTOR", None)
    return str(getattr(content, "__msgtype__", "unknown") if descriptor is None else descriptor.full_name)


@dataclass
class Feed:
    """Messages in the order in which they were logged, as (topic, log time in ns, content)."""

    messages: list[tuple[str, int, Any]] = field(default_factory=list)
    latched: frozenset[str] = frozenset()
    types: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    is_numbered: bool = True

    def add(self, topic: str, time_ns: int, content: Any) -> Feed:
        self.messages.append((topic, time_ns, content))
        return self

    def topics(self) -> list[Topic]:
        kinds = {topic: type_of(content) for topic, _, content in reversed(self.messages)} | self.types
        in_json = {topic for topic, _, content in self.messages if isinstance(content, dict)}
        return [
            Topic(
                name,
                kind,
                "json" if name in in_json else "cdr",
                latched=name in self.latched,
                count=self.counts.get(name),
            )
            for name, kind in sorted(kinds.items())
        ]

    def decoder(self, topic: str) -> Decoder:
        return lambda payload: self.messages[int(payload)][2]

    def raw(self) -> list[Message]:
        return [
            Message(topic, time_ns, time_ns, number * self.is_numbered, str(number).encode())
            for number, (topic, time_ns, _) in enumerate(self.messages)
        ]


@dataclass(frozen=True)
class Made:
    """A trace with faults, remarks and doubts."""

    trace: Trace
    faults: tuple[str, ...]
    remarks: tuple[str, ...]
    doubts: tuple[Doubt, ...] = ()

    def centre(self, sample: int, name: str) -> tuple[float, float]:
        """Return the mean of an object's corners, rounded."""
        vertices = self.footprint_row(sample, name)
        x, y = vertices.mean(axis=0).tolist()
        return round(x, 9), round(y, 9)

    def footprint_row(self, sample: int, name: str) -> Any:
        row = int(self.trace.rows[sample, self.trace.names.index(name)])
        assert row >= 0, f"{name} is not known in sample {sample}"
        shapes = self.trace.footprints
        parts = shapes.part_start[row], shapes.part_start[row + 1]
        return shapes.vertices[shapes.vertex_start[parts[0]] : shapes.vertex_start[parts[1]]]

    def states(self, name: str) -> str:
        """Return the state of an object in each sample: + known, ? unknown, - absent."""
        if name not in self.trace.names:
            return "-" * len(self.trace)
        rows = self.trace.rows[:, self.trace.names.index(name)].tolist()
        return "".join("+" if row >= 0 else "-" if row == -1 else "?" for row in rows)


def make(mapping: str, feed: Feed, *, batch: int = 1000, late_ns: int = SECOND, **options: Any) -> Made:
    """Map the messages of a feed to samples."""
    plan = ReadingPlan.of(parse_mapping(mapping, "test.yaml"), feed.topics(), late_ns)
    assembler = Assembler(plan, feed.decoder, name="test.bag", **options)
    raw = [message for message in feed.raw() if message.topic in plan.topics]
    static = {topic.name for topic in plan.planned if topic.is_static}
    assembler.know_static([message for message in raw if message.topic in static])
    traces = [assembler.add(raw[begin : begin + batch]) for begin in range(0, len(raw), batch)]
    traces.append(assembler.finish())
    trace = Trace.concatenate(traces)
    remarks = (*plan.remarks, *assembler.take_remarks())
    return Made(trace, assembler.take_faults(), remarks, assembler.take_doubts())

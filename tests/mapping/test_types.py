"""Objects from messages of every built-in type, and of others by field paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import cos, pi, sin
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from mapping.feeding import SECOND, Feed, Made, header, make, pose, pose_stamped, ros, tf, transform
from spatial_replay import (
    Footprint,
    Monitor,
    SpecificationError,
    TrackedObject,
    UsageError,
    evaluate,
    parse_specification,
)
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.text import text_number

QUARTER = (0.0, 0.0, sin(pi / 4), cos(pi / 4))


def one(content: Any, keys: str = "") -> Made:
    return make(f"topics: {{/thing: {{{keys}}}}}", Feed().add("/thing", SECOND, content))


def objects(content: Any, keys: str = "") -> dict[str, TrackedObject]:
    made = one(content, keys)
    assert made.faults == ()
    (sample,) = made.trace.samples()
    return {name: tracked for name, tracked in sample.objects.items() if isinstance(tracked, TrackedObject)}


def corners(tracked: TrackedObject) -> set[tuple[float, float]]:
    return {
        (round(x, 9) + 0.0, round(y, 9) + 0.0)
        for part in tracked.footprint.parts
        for x, y in part.vertices.tolist()
    }


def test_a_pose_is_an_object_named_after_its_topic() -> None:
    found = objects(pose_stamped(1.0, 2.0, turn=QUARTER))
    assert found["thing"].footprint == Footprint.disc(1.0, 2.0, 0.0)
    assert found["thing"].yaw == pytest.approx(pi / 2)


def test_an_enum_of_protobuf_is_a_text_and_numbers_without_a_name_stay_numbers() -> None:
    feed = Feed()
    for second, level in enumerate((Log.Level.INFO, Log.Level.ERROR, 77), 1):
        feed.add("/log", second * SECOND, Log(level=level))
    plain = make("topics: {/log: {signals: {level: level}}}", feed).trace
    assert plain.signals["level"].tolist() == [text_number("INFO"), text_number("ERROR"), 77.0]
    table = "{field: level, names: {INFO: 1, ERROR: 5}}"
    named = make(f"topics: {{/log: {{signals: {{level: {table}}}}}}}", feed).trace
    assert np.array_equal(named.signals["level"], [1.0, 5.0, np.nan], equal_nan=True)


def test_a_pose_takes_the_shape_and_the_height_that_the_mapping_gives() -> None:
    keys = "name: robot, class: agv, shape: {box: [2, 1], offset: [1, 0]}, height: [0, 0.5]"
    found = objects(pose_stamped(1.0, 2.0, z=0.25, turn=QUARTER), keys)["robot"]
    assert corners(found) == {(0.5, 2.0), (1.5, 2.0), (1.5, 4.0), (0.5, 4.0)}
    assert found.class_name == "agv"
    assert found.height == (0.25, 0.75)


def test_odometry_has_a_covariance() -> None:
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = [[0.04, 0.0], [0.0, 0.01]]
    content = ros(
        "nav_msgs/Odometry",
        header=header("odom"),
        pose=ros("geometry_msgs/PoseWithCovariance", pose=pose(3.0, 4.0), covariance=covariance.ravel()),
    )
    assert objects(content)["thing"].uncertainty == 0.0
    assert objects(content, "uncertainty: covariance")["thing"].uncertainty == pytest.approx(0.4)
    keys = "uncertainty: {covariance: pose.covariance, sigmas: 3}"
    assert objects(content, keys)["thing"].uncertainty == pytest.approx(0.6)
    assert objects(content, "uncertainty: 0.25")["thing"].uncertainty == 0.25


def test_a_negative_variance_makes_the_object_unknown() -> None:
    covariance = np.zeros(36)
    covariance[0] = -1.0
    content = ros(
        "nav_msgs/Odometry",
        pose=ros("geometry_msgs/PoseWithCovariance", pose=pose(3.0, 4.0), covariance=covariance),
    )
    assert one(content, "uncertainty: covariance").states("thing") == "?"


def test_poses_of_an_array_are_numbered() -> None:
    content = ros("geometry_msgs/PoseArray", header=header("map"), poses=[pose(1.0, 0.0), pose(2.0, 0.0)])
    found = objects(content)
    assert list(found) == ["thing_0", "thing_1"]
    assert found["thing_1"].footprint == Footprint.disc(2.0, 0.0, 0.0)


def test_a_polygon_is_its_own_footprint() -> None:
    points = [ros("geometry_msgs/Point32", x=x, y=y) for x, y in ((0, 0), (2, 0), (2, 1), (0, 1))]
    content = ros("geometry_msgs/PolygonStamped", polygon=ros("geometry_msgs/Polygon", points=points))
    assert objects(content)["thing"].footprint == Footprint.box(0, 0, 2, 1)


def test_transforms_are_objects_named_after_their_frames() -> None:
    content = tf(transform("world", "turtle1", (1, 2, 0)), transform("world", "turtle2", (3, 4, 0)))
    found = objects(content)
    assert found["turtle1"].footprint == Footprint.disc(1, 2, 0)
    assert found["turtle2"].footprint == Footprint.disc(3, 4, 0)
    assert list(objects(content, "only: ['*2']")) == ["turtle2"]
    assert list(objects(content, "except: [turtle2]")) == ["turtle1"]


def marker(kind: int, number: int = 0, **values: Any) -> Any:
    defaults: dict[str, Any] = {
        "header": header("map"),
        "ns": "cup",
        "id": number,
        "type": kind,
        "pose": pose(1.0, 2.0, 0.5),
        "scale": ros("geometry_msgs/Vector3", x=2.0, y=1.0, z=1.0),
    }
    return ros("visualization_msgs/Marker", **(defaults | values))


def test_markers_are_boxes_discs_and_unions() -> None:
    scale = ros("geometry_msgs/Vector3", x=2.0, y=2.0, z=1.0)
    points = [ros("geometry_msgs/Point", x=x, y=0.0) for x in (0.0, 10.0)]
    array = ros(
        "visualization_msgs/MarkerArray",
        markers=[marker(1), marker(3, 1, scale=scale), marker(6, 2, points=points), marker(9, 3)],
    )
    made = one(array)
    (sample,) = made.trace.samples()
    cube, cylinder, cubes = (sample.objects[f"cup_{number}"] for number in range(3))
    assert isinstance(cube, TrackedObject)
    assert cube.footprint == Footprint.box(0.0, 1.5, 2.0, 2.5)
    assert cube.height == (0.0, 1.0)
    assert isinstance(cylinder, TrackedObject)
    assert cylinder.footprint == Footprint.disc(1.0, 2.0, 1.0)
    assert isinstance(cubes, TrackedObject)
    assert cubes.footprint == Footprint.union(
        [Footprint.box(0.0, 1.5, 2.0, 2.5), Footprint.box(10.0, 1.5, 12.0, 2.5)]
    )
    assert "1 object was left out" in made.remarks[0]


def test_markers_stay_until_they_are_deleted_or_their_time_is_up() -> None:
    def array(*markers: Any) -> Any:
        return ros("visualization_msgs/MarkerArray", markers=list(markers))

    lifetime = ros("builtin_interfaces/Duration", sec=2)
    feed = Feed()
    feed.add("/m", 0, array(marker(1, 0), marker(1, 1, lifetime=lifetime), marker(1, 2)))
    feed.add("/m", 3 * SECOND, array(marker(1, 0, action=2)))
    feed.add("/m", 20 * SECOND, array(marker(1, 0, action=3), marker(1, 5)))
    made = make("sample: {every: 1s}\ntopics: {/m: {}}", feed)
    assert made.states("cup_0") == "+++" + "-" * 18
    assert made.states("cup_1") == "++" + "-" * 19
    assert made.states("cup_2") == "+" * 20 + "-"
    assert made.states("cup_5") == "-" * 20 + "+"


def hypotheses(name: str) -> list[Any]:
    inner = ros("vision_msgs/ObjectHypothesis", class_id=name, score=0.5)
    return [ros("vision_msgs/ObjectHypothesisWithPose", hypothesis=inner)]


def test_detections_in_an_image_are_boxes() -> None:
    centre = ros("vision_msgs/Pose2D", position=ros("vision_msgs/Point2D", x=10.0, y=20.0), theta=pi / 2)
    box = ros("vision_msgs/BoundingBox2D", center=centre, size_x=4.0, size_y=2.0)
    detections = [
        ros("vision_msgs/Detection2D", bbox=box, id="7", results=hypotheses("cup")),
        ros("vision_msgs/Detection2D", bbox=box),
    ]
    found = objects(ros("vision_msgs/Detection2DArray", detections=detections))
    assert list(found) == ["thing_1", "thing_7"]
    assert corners(found["thing_7"]) == {(9.0, 18.0), (11.0, 18.0), (11.0, 22.0), (9.0, 22.0)}
    assert (found["thing_7"].class_name, found["thing_1"].class_name) == ("cup", None)


def test_detections_in_space_have_heights() -> None:
    size = ros("geometry_msgs/Vector3", x=2.0, y=1.0, z=3.0)
    box = ros("vision_msgs/BoundingBox3D", center=pose(1.0, 1.0, 2.0), size=size)
    detection = ros("vision_msgs/Detection3D", bbox=box, id="car1")
    found = objects(ros("vision_msgs/Detection3DArray", detections=[detection]), "name: '{id}'")
    assert found["car1"].footprint == Footprint.box(0.0, 0.5, 2.0, 1.5)
    assert found["car1"].height == (0.5, 3.5)


def test_tags_are_polygons_of_their_corners() -> None:
    points = [ros("apriltag_msgs/Point", x=x, y=y) for x, y in ((0, 0), (0, 1), (1, 1), (1, 0))]
    detection = ros("apriltag_msgs/AprilTagDetection", id=4, family="36h11", corners=points)
    found = objects(ros("apriltag_msgs/AprilTagDetectionArray", detections=[detection]))
    assert found["tag4"].footprint == Footprint.box(0, 0, 1, 1)
    assert found["tag4"].class_name == "36h11"


def test_perceived_objects_are_solids_with_a_class() -> None:
    def perceived(number: int, kind: int, sizes: list[float], classification: int) -> Any:
        solid = ros("shape_msgs/SolidPrimitive", type=kind, dimensions=np.array(sizes))
        return ros(
            "derived_object_msgs/Object",
            id=number,
            pose=pose(0.0, 0.0, 1.0),
            shape=solid,
            classification=classification,
        )

    listed = [perceived(1, 1, [4.0, 2.0, 2.0], 6), perceived(2, 3, [2.0, 0.5], 4), perceived(3, 0, [], 0)]
    found = objects(ros("derived_object_msgs/ObjectArray", objects=listed))
    assert found["object_1"].footprint == Footprint.box(-2, -1, 2, 1)
    assert found["object_1"].height == (0.0, 2.0)
    assert found["object_2"].footprint == Footprint.disc(0, 0, 0.5)
    assert found["object_3"].footprint == Footprint.disc(0, 0, 0)
    assert [found[f"object_{n}"].class_name for n in (1, 2, 3)] == ["car", "pedestrian", "unknown"]


def test_entities_of_a_scene_are_unions_that_stay() -> None:
    first = SceneUpdate()
    for name in ("table", "cup"):
        entity = first.entities.add(id=name, frame_id="map")
        cube = entity.cubes.add()
        cube.pose.position.x = 1.0
        cube.size.x, cube.size.y, cube.size.z = 2.0, 1.0, 1.0
    sphere = first.entities[0].spheres.add()
    sphere.size.x = sphere.size.y = sphere.size.z = 0.5
    first.entities.add(id="label").texts.add(text="no body")
    second = SceneUpdate()
    second.deletions.add(id="cup")
    third = SceneUpdate()
    third.deletions.add(type=1)  # type: ignore[arg-type]
    feed = Feed().add("/scene", 0, first).add("/scene", 5 * SECOND, second).add("/scene", 9 * SECOND, third)
    made = make("topics: {/scene: {}}", feed)
    assert (made.states("table"), made.states("cup")) == ("++-", "+--")
    assert "label" not in made.trace.names
    table = made.trace.observation(int(made.trace.rows[0, made.trace.names.index("table")]))
    assert table.footprint == Footprint.union([Footprint.box(0, -0.5, 2, 0.5), Footprint.disc(0, 0, 0.25)])
    assert table.height == (-0.5, 0.5)


def test_foxglove_poses_and_transforms() -> None:
    poses = PosesInFrame(frame_id="map")
    poses.poses.add().position.x = 3.0
    assert objects(poses)["thing_0"].footprint == Footprint.disc(3, 0, 0)
    single = FrameTransform(parent_frame_id="map", child_frame_id="arm")
    single.translation.y = 2.0
    assert objects(single)["arm"].footprint == Footprint.disc(0, 2, 0)
    assert objects(FrameTransforms(transforms=[single]))["arm"].footprint == Footprint.disc(0, 2, 0)


def test_a_scene_update_in_json_is_read_the_same() -> None:
    content = {
        "deletions": [],
        "entities": [
            {
                "id": "table",
                "frame_id": "map",
                "timestamp": {"sec": 1, "nsec": 0},
                "lifetime": {"sec": 0, "nsec": 0},
                "cubes": [
                    {
                        "pose": {
                            "position": {"x": 1.0, "y": 0.0, "z": 0.0},
                            "orientation": {"x": 0, "y": 0, "z": 0, "w": 1},
                        },
                        "size": {"x": 2.0, "y": 1.0, "z": 1.0},
                    }
                ],
            }
        ],
    }
    feed = Feed(types={"/scene": "foxglove.SceneUpdate"}).add("/scene", 0, content)
    made = make("topics: {/scene: {}}", feed)
    assert made.trace.observation(0).footprint == Footprint.box(0, -0.5, 2, 0.5)


def test_a_turtlesim_pose_is_read_by_common_field_names() -> None:
    found = objects(ros("turtlesim/Pose", x=1.0, y=2.0, theta=0.5), "shape: {disc: 0.5}")
    assert found["thing"].footprint == Footprint.disc(1, 2, 0.5)
    assert found["thing"].yaw == 0.5


def test_any_other_type_is_read_by_field_paths() -> None:
    content = {
        "stamp": {"sec": 1, "nanosec": 0},
        "things": [
            {"id": {"value": 3}, "at": [1.0, 2.0], "size": {"l": 2.0, "w": 1.0}, "angle": 90, "kind": 2},
            {"id": {"value": 4}, "at": [5.0, None], "size": {"l": 2.0, "w": 1.0}, "angle": 0, "kind": 9},
        ],
    }
    keys = (
        "objects: 'things[*]', name: 'v{id.value}', position: at, yaw: {field: angle, unit: deg},"
        " shape: {box: [size.l, size.w]}, class: {field: kind, names: {2: car}, else: other},"
        " height: [0, size.w], uncertainty: size.w"
    )
    made = one(content, keys)
    car = made.trace.observation(int(made.trace.rows[0, 0]))
    assert corners(car) == {(0.5, 1.0), (1.5, 1.0), (1.5, 3.0), (0.5, 3.0)}
    assert (car.class_name, car.height, car.uncertainty) == ("car", (0.0, 1.0), 1.0)
    assert made.states("v4") == "?"


@pytest.mark.parametrize("polygon", [[0, 0, 2, 0, 2, 1, 0, 1], [[0, 0], [2, 0], [2, 1], [0, 1]]])
def test_corners_may_be_pairs_or_numbers_in_turn(polygon: list[Any]) -> None:
    assert objects({"outline": polygon}, "polygon: outline")["thing"].footprint == Footprint.box(0, 0, 2, 1)


def test_a_quaternion_of_zeros_is_no_rotation_and_no_orientation() -> None:
    found = objects(pose_stamped(0.0, 0.0, turn=(0, 0, 0, 0)), "shape: {box: [2, 1]}")["thing"]
    assert found.footprint == Footprint.box(-1, -0.5, 1, 0.5)
    assert found.yaw is None


def test_a_tilted_box_is_its_outline_from_above() -> None:
    # rolled by 45 degrees about its long axis
    roll = (sin(pi / 8), 0.0, 0.0, cos(pi / 8))
    size = ros("geometry_msgs/Vector3", x=4.0, y=1.0, z=1.0)
    box = ros("vision_msgs/BoundingBox3D", center=pose(0.0, 0.0, 2.0, turn=roll), size=size)
    detection = ros("vision_msgs/Detection3D", bbox=box, id="crate")
    found = objects(ros("vision_msgs/Detection3DArray", detections=[detection]), "name: '{id}'")["crate"]
    half = 2**0.5 / 2
    assert corners(found) == {(x, round(y, 9)) for x in (-2.0, 2.0) for y in (-half, half)}
    assert found.height == pytest.approx((2 - half, 2 + half))


def test_an_outline_that_crosses_itself_makes_only_its_object_unknown() -> None:
    content = {"list": [{"id": 1, "p": [0, 0, 1, 1, 1, 0, 0, 1]}, {"id": 2, "p": [0, 0, 1, 0, 1, 1]}]}
    made = one(content, "objects: 'list[*]', name: 'o{id}', polygon: p")
    assert (made.states("o1"), made.states("o2")) == ("?", "+")
    assert "/thing at 1.000 s: object 'o1': the polygon's boundary crosses" in made.faults[0]


def test_a_name_that_appears_twice_makes_the_object_unknown() -> None:
    content = {"list": [{"id": 1, "x": 0, "y": 0}, {"id": 1, "x": 1, "y": 0}, {"id": 2, "x": 1, "y": 0}]}
    made = one(content, "objects: 'list[*]', name: 'o{id}', position: [x, y]")
    assert (made.states("o1"), made.states("o2")) == ("?", "+")
    assert "object 'o1' is there twice in one message" in made.faults[0]


def test_fixes_of_a_satellite_receiver_become_metres_from_the_origin() -> None:
    def fixed(latitude: float, longitude: float, status: int = 0) -> Any:
        own = ros("sensor_msgs/NavSatStatus", status=status)
        return ros("sensor_msgs/NavSatFix", latitude=latitude, longitude=longitude, status=own)

    feed = Feed()
    for second, place in enumerate([(52.0, 13.0), (52.001, 13.0), (52.0, 13.001), (0.0, 0.0, -1)], 1):
        feed.add("/fix", second * SECOND, fixed(*place))
    made = make("origin: [52.0, 13.0]\ntopics: {/fix: {shape: {disc: 0.5}}}", feed)
    assert made.states("fix") == "+++?"
    # metres to a thousandth of a degree at 52 degrees north, by the ellipsoid of WGS 84
    for sample, expected in enumerate([(0, 0), (0, 111.267), (68.678, 0)]):
        assert made.centre(sample, "fix") == pytest.approx(expected, abs=2e-3)
    with pytest.raises(UsageError, match=r"give the file an `origin: \[latitude, longitude\]`"):
        make("topics: {/fix: {}}", feed)


def test_joints_are_read_by_their_names_whatever_their_order() -> None:
    feed = Feed()
    for second, names in enumerate([("elbow", "wrist"), ("wrist", "elbow"), ("wrist",)], 1):
        position = [{"elbow": 0.5, "wrist": 1.5}[name] for name in names]
        joints = ros("sensor_msgs/JointState", position=position)
        joints.name = list(names)
        feed.add("/joints", second * SECOND, joints)
    made = make('topics: {/joints: {signals: {elbow: "position[name=elbow]"}}}', feed)
    assert made.trace.signals["elbow"].tolist() == pytest.approx([0.5, 0.5, np.nan], nan_ok=True)
    assert made.faults == ()
    with pytest.raises(UsageError, match="name has no 'elbo'; did you mean 'elbow'"):
        make('topics: {/joints: {signals: {elbow: "position[name=elbo]"}}}', feed)


def test_objects_are_named_by_a_list_next_to_theirs() -> None:
    feed = Feed(types={"/models": "gazebo_msgs/msg/ModelStates"})
    for number, order in enumerate((("cup", "robot"), ("robot", "cup"), (), ("cup",))):
        poses = [{"position": {"x": float(len(name)), "y": 0.0}} for name in order]
        feed.add("/models", number * SECOND, {"name": list(order), "pose": poses})
    text = "topics: {/models: {objects: 'pose[*]', name: '{$.name[index]}', except: [none]}}"
    made = make(text, feed)
    assert [made.centre(sample, "cup") for sample in (0, 1)] == [(3.0, 0.0)] * 2
    assert [made.centre(sample, "robot") for sample in (0, 1)] == [(5.0, 0.0)] * 2
    assert (made.states("cup"), made.states("robot")) == ("++-+", "++--")
    assert made.remarks == made.faults == ()
    assert make(text, feed, batch=1).trace == made.trace
    # names that are fewer than the poses
    feed.add("/models", 4 * SECOND, {"name": ["cup"], "pose": [{"position": {"x": 0.0, "y": 0.0}}] * 2})
    assert "/models at 4.000 s" in make(text, feed).faults[0]


def test_the_keys_of_a_json_object_name_its_objects() -> None:
    feed = Feed(types={"/all": "a/All"})
    for number, names in enumerate((("cup", "plate"), ("plate", "cup"), ("plate",))):
        feed.add("/all", number * SECOND, {"objects": {name: {"x": len(name), "y": 0} for name in names}})
    made = make("topics: {/all: {objects: 'objects[*]', name: '{index}'}}", feed)
    assert (made.states("cup"), made.states("plate")) == ("++-", "+++")
    assert made.centre(1, "cup") == (3.0, 0.0)
    assert made.remarks == ()


def test_a_message_may_be_the_json_object_that_names_its_objects() -> None:
    feed = Feed(types={"/all": "a/All"})
    feed.add("/all", 0, {"time": 1.5, "cup": {"x": 1, "y": 0}, "plate": {"x": 2, "y": 0}, "frame": "map"})
    made = make("topics: {/all: {objects: '[*]', name: '{index}'}}", feed)
    assert made.trace.names == ("cup", "plate")
    assert made.centre(0, "plate") == (2.0, 0.0)


def test_texts_become_signals_by_their_names() -> None:
    feed = Feed(types={"/m": "a/Mode"})
    for time, mode in enumerate(("AUTO", "MANUAL", "HOLD", "AUTO")):
        feed.add("/m", time * SECOND, {"mode": mode})
    made = make("topics: {/m: {signals: {mode: {field: mode, names: {AUTO: 1, MANUAL: 0}}}}}", feed)
    assert made.trace.signals["mode"].tolist()[:2] == [1, 0]
    assert np.isnan(made.trace.signals["mode"][2])
    assert "lacks 'HOLD'; it is unknown there" in made.remarks[0]
    compared = make("topics: {/m: {signals: {mode: mode}}}", feed).trace
    assert (
        evaluate(parse_specification('G (mode == "AUTO" or mode == "HOLD")'), compared).verdict == "violated"
    )
    assert evaluate(parse_specification('F[3, 3] mode == "AUTO"'), compared).verdict == "satisfied"


NUMBERED = "{0: NO, 1: INFO, 4: ERROR}"


@pytest.mark.parametrize(
    ("contents", "names"),
    [
        ([{"m": "INFO"}, {"m": "ERROR"}], "{NO: 0, INFO: 1, ERROR: 4}"),
        ([{"m": 1}, {"m": 4}], NUMBERED),
        ([{"m": 1}, {"m": 4}], "{INFO: 1, ERROR: 4}"),
        ([ros("std_msgs/UInt8", data=1), ros("std_msgs/UInt8", data=4)], NUMBERED),
        ([ros("std_msgs/String", data="INFO"), ros("std_msgs/String", data="ERROR")], NUMBERED),
        ([Log(level=Log.Level.INFO), Log(level=Log.Level.ERROR)], NUMBERED),
        ([Log(level=Log.Level.INFO), Log(level=Log.Level.ERROR)], "{2: info, 4: error}"),
    ],
)
def test_numbers_are_compared_by_their_names(contents: Sequence[object], names: str) -> None:
    feed = Feed(types={"/m": "a/Mode"} if isinstance(contents[0], dict) else {})
    for second, content in enumerate(contents):
        feed.add("/m", second * SECOND, content)
    field = next(each for each in ("level", "data", "m") if hasattr(contents[0], each) or each == "m")
    mapping = f"topics: {{/m: {{signals: {{mode: {{field: {field}, names: {names}}}}}}}}}"
    units = parse_mapping(mapping).axes.units
    trace = replace(make(mapping, feed).trace, units=units)
    info, error = ("info", "error") if "info" in names else ("INFO", "ERROR")
    number = trace.signals["mode"][0]
    for text in (f'mode == "{info}" and X mode == "{error}"', f"mode == {number} and X mode >= 4"):
        specification = parse_specification(text)
        assert evaluate(specification, trace).verdict == "satisfied"
        monitor = Monitor(specification, units=units)
        assert [monitor.update(each) for each in trace.samples()][-1].verdict == "satisfied"
    never = evaluate(parse_specification(f'G (mode != "{error}")'), trace)
    assert f'mode is 4 ("{error}")' in never.explain()
    other = parse_specification('F (mode == "HOLD")')
    for compare in (partial(evaluate, other, trace), partial(Monitor, other, units=units)):
        with pytest.raises(SpecificationError, match='no number of mode is called "HOLD"') as raised:
            compare()
        assert f'"{info}", "{error}"' in str(raised.value)


def test_objects_that_only_places_distinguish_are_remarked() -> None:
    def poses(count: int) -> Feed:
        return Feed().add(
            "/p", 0, ros("geometry_msgs/PoseArray", header=header("map"), poses=[pose(0, 0)] * count)
        )

    assert "only the places in the list distinguish objects" in make("topics: {/p: {}}", poses(2)).remarks[0]
    assert make("topics: {/p: {}}", poses(1)).remarks == ()


def test_objects_that_lose_their_id_are_remarked() -> None:
    feed = Feed()
    for second, own in enumerate(("7", "7", "")):
        box = ros("vision_msgs/Detection3D", header=header("map"), id=own)
        boxes = ros("vision_msgs/Detection3DArray", header=header("map"), detections=[box])
        feed.add("/seen", second * SECOND, boxes)
    assert "objects without an id: objects swap" in make("topics: {/seen: {}}", feed).remarks[0]
    assert make("topics: {/seen: {}}", Feed(feed.messages[:2])).remarks == ()


def test_the_class_of_a_detection_is_that_of_its_best_result() -> None:
    results = [
        ros(
            "vision_msgs/ObjectHypothesisWithPose",
            hypothesis=ros("vision_msgs/ObjectHypothesis", class_id=c, score=s),
        )
        for c, s in (("cup", 0.2), ("person", 0.9))
    ]
    detection = ros("vision_msgs/Detection2D", id="a", results=results)
    feed = Feed().add("/det", 0, ros("vision_msgs/Detection2DArray", detections=[detection]))
    assert make("topics: {/det: {}}", feed).trace.classes == ("person",)


def points(*pairs: tuple[float, float]) -> list[dict[str, float]]:
    return [{"x": x, "y": y} for x, y in pairs]


RECTANGLE = points((-3, -1), (3, -1), (3, 1), (-3, 1))


@pytest.mark.parametrize("outline", [RECTANGLE, {"points": RECTANGLE}])
@pytest.mark.parametrize("offset", [0.0, 2.0])
def test_outlines_in_the_objects_own_frame_lie_at_their_poses(outline: object, offset: float) -> None:
    feed = Feed(types={"/t": "a/Tracks"})
    thing = {"position": {"x": 10.0, "y": 10.0}, "yaw": pi / 2, "shape": {"footprint": outline}}
    feed.add("/t", 0, {"tracks": [thing]})
    shape = f"{{polygon: shape.footprint, offset: [{offset}, 0]}}"
    made = make(f"topics: {{/t: {{objects: 'tracks[*]', name: car, yaw: yaw, shape: {shape}}}}}", feed)
    expected = [(11, 7), (11, 13), (9, 13), (9, 7)]
    found = made.footprint_row(0, "car")
    assert sorted(map(tuple, found.round(9).tolist())) == sorted((x, y + offset) for x, y in expected)


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("key", ["polygon: outline", "shape: {polygon: outline}"])
def test_fewer_than_three_corners_are_no_outline(count: int, key: str) -> None:
    feed = Feed(types={"/t": "a/Tracks"})
    for time, outline in enumerate((RECTANGLE, RECTANGLE[:count], RECTANGLE)):
        thing = {"id": 1, "x": 1.0, "y": 1.0, "outline": outline}
        feed.add("/t", time * SECOND, {"tracks": [thing, {**thing, "id": 2, "outline": RECTANGLE}]})
    made = make(f"topics: {{/t: {{objects: 'tracks[*]', name: '{{id}}', {key}}}}}", feed)
    assert (made.states("1"), made.states("2"), made.faults) == ("+?+", "+++", ())
    assert "/t: 1 outline with fewer than three corners" in made.remarks[0]


@pytest.mark.parametrize(
    "box", [[10, 20, 30, 60], [30, 60, 10, 20], [[10, 60], [30, 20]], points((10, 20), (30, 60))]
)
def test_two_opposite_corners_are_a_box_by_a_key_of_its_own(box: object) -> None:
    feed = Feed(types={"/b": "a/Boxes"})
    feed.add("/b", 0, {"boxes": [{"id": 1, "box": box}, {"id": 2, "box": box}]})
    made = make("topics: {/b: {objects: 'boxes[*]', name: '{id}', bounds: box}}", feed)
    for name in ("1", "2"):
        found = made.footprint_row(0, name).tolist()
        assert found == [[10, 20], [30, 20], [30, 60], [10, 60]]


@pytest.mark.parametrize(
    "bounds",
    [
        "[left, low, right, top]",
        "{field: [left, low, right, top], form: xyxy}",
        "{field: [left, low, width, height], form: xywh}",
        "{field: box, form: xywh}",
    ],
)
def test_bounds_are_four_fields_or_a_corner_with_a_size(bounds: str) -> None:
    box = {"left": 10, "low": 20, "right": 30, "top": 60, "width": 20, "height": 40}
    feed = Feed(types={"/b": "a/Boxes"})
    feed.add("/b", 0, {"boxes": [{"id": 1, **box, "box": [10, 20, 20, 40]}]})
    made = make(f"topics: {{/b: {{objects: 'boxes[*]', name: '{{id}}', bounds: {bounds}}}}}", feed)
    assert made.footprint_row(0, "1").tolist() == [[10, 20], [30, 20], [30, 60], [10, 60]]


def test_bounds_of_a_negative_size_make_an_object_unknown() -> None:
    feed = Feed(types={"/b": "a/Boxes"})
    feed.add("/b", 0, {"boxes": [{"id": 1, "box": [10, 20, -20, 40]}]})
    made = make("topics: {/b: {objects: 'boxes[*]', name: '{id}', bounds: {field: box, form: xywh}}}", feed)
    assert made.states("1") == "?"


def test_an_outline_is_given_once() -> None:
    for pair in ("polygon: a, bounds: b", "bounds: a, shape: {disc: 1}", "polygon: a, shape: {polygon: b}"):
        with pytest.raises(UsageError, match="give one of the two"):
            make(f"topics: {{/b: {{{pair}}}}}", Feed())


def test_angles_in_degrees_and_poses_of_zeros_are_remarked() -> None:
    def remarks(*contents: Any, keys: str = "") -> tuple[str, ...]:
        feed = Feed()
        for second, content in enumerate(contents):
            feed.add("/thing", second * SECOND, content)
        return make(f"topics: {{/thing: {{{keys}}}}}", feed).remarks

    turns = [{"x": 0.0, "y": 0.0, "theta": theta} for theta in (0.0, -9.0)]
    assert remarks(*turns, keys="yaw: theta") == (
        "test.bag: /thing: its angles reach 9 and are read as radians; `yaw: {field: PATH, unit: deg}` reads"
        " degrees",
    )
    assert remarks(*turns, keys="yaw: {field: theta, unit: deg}") == ()
    known, lost = pose_stamped(1, 2), pose_stamped(0, 0, turn=(0.0, 0.0, 0.0, 0.0))
    assert remarks(known, lost, known) == (
        "test.bag: /thing: 1 of 3 poses have a quaternion of zeros, as trackers send for what they have lost;"
        " they count as poses without a turn",
    )
    assert remarks(lost, lost) == remarks(known, known) == ()

"""Suggested mappings: what is found in messages, and that the text is a valid mapping."""

from __future__ import annotations

import json
from math import cos, pi, radians, sin
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, message_factory
from mcap.writer import Writer

from spatial_replay import UsageError, read_trace
from spatial_replay.bags.decoders import Topic
from spatial_replay.cli import run
from spatial_replay.mapping.mapping_file import (
    FOREVER_NS,
    Angle,
    LogMapping,
    ShapeMapping,
    TopicMapping,
    parse_mapping,
)
from spatial_replay.mapping.suggest import suggest_mapping
from spatial_replay.sources import open_source

POINT = {"x": 1.0, "y": 2.0, "z": 0.0}
COMPASS = Angle("heading", scale=-pi / 180, zero=pi / 2, is_plain=False)
TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
STAMP = {"sec": 0, "nanosec": 0}


def suggested(**examples: Any) -> tuple[str, LogMapping]:
    """Suggest a mapping for topics with one example each; return its text and its values."""
    topics = [Topic(f"/{name}", f"a/msg/{name.title()}", "json") for name in examples]
    text = suggest_mapping("run.bag", topics, {f"/{name}": [each] for name, each in examples.items()})
    return text, parse_mapping(text)


def suggested_for(messages: list[Any], kind: str = "a/msg/Own") -> tuple[str, TopicMapping]:
    """Suggest a mapping for one topic; return its text and the topic's entry."""
    text = suggest_mapping("run.bag", [Topic("/tracks", kind, "json")], {"/tracks": messages})
    (topic,) = parse_mapping(text).topics
    return text, topic


def test_a_pose_is_an_object_of_its_topic() -> None:
    text, mapping = suggested(robot={"pose": {"position": POINT, "orientation": TURN}})
    (topic,) = mapping.topics
    assert (topic.topic, topic.name, topic.position) == ("/robot", "robot", "pose.position")
    assert topic.orientation == "pose.orientation"
    assert topic.shape == ShapeMapping("disc", (0.5,))
    assert "no size" in text


def test_topics_of_others_with_our_names_are_suggested() -> None:
    (topic,) = suggested(**{"spatial/scene": {"x": 1.0, "y": 2.0}})[1].topics
    assert (topic.topic, topic.position) == ("/spatial/scene", ("x", "y"))


def test_bare_coordinates_are_a_position() -> None:
    _, mapping = suggested(pose={"x": 1.0, "y": 2.0, "theta": 0.0, "velocity": POINT})
    (topic,) = mapping.topics
    assert (topic.position, topic.yaw, topic.orientation) == (("x", "y"), Angle("theta"), None)


def test_a_nested_list_of_objects_is_suggested() -> None:
    vehicle = {
        "id": {"value": 7},
        "base": {"position": POINT, "dimension": {"length": 4.0, "width": 2.0, "height": 1.5}},
        "velocity": POINT,
    }
    sign = {"id": {"value": 8}, "base": {"position": POINT}}
    text, mapping = suggested(truth={"world": {"traffic_sign": [sign], "moving_object": [vehicle]}})
    (topic,) = mapping.topics
    assert topic.objects == "world.moving_object[*]"
    assert topic.name == "moving_object{id.value}"
    assert topic.position == "base.position"
    assert topic.shape == ShapeMapping(
        "box", ("base.dimension.length", "base.dimension.width", "base.dimension.height")
    )
    assert "world.traffic_sign[*]" in text


def test_corners_are_an_outline() -> None:
    tag = {"id": 3, "family": "mit", "center": POINT, "corners": [POINT] * 4}
    _, mapping = suggested(detector={"tags": [tag]})
    (topic,) = mapping.topics
    assert (topic.objects, topic.polygon, topic.name) == ("tags[*]", "corners", "tag{id}")
    assert topic.position is topic.shape is None


def test_outlines_in_the_frames_of_objects_and_of_messages_are_distinguished() -> None:
    around = [{"x": x, "y": y} for x, y in ((-2, -1), (2, -1), (2, 1), (-2, 1))]
    there = [{"x": 50 + each["x"], "y": each["y"]} for each in around]
    pose = {"position": {"x": 50.0, "y": 0.0, "z": 0.0}, "orientation": TURN}
    for corners, is_own in ((around, True), (there, False)):
        track = {"name": "car", "pose": pose, "shape": {"footprint": {"points": corners}}}
        (topic,) = suggested(cars={"tracks": [track]})[1].topics
        own = topic.shape is not None and topic.shape.outline == "shape.footprint.points"
        assert (own, topic.polygon, topic.position) == (
            (True, None, "pose.position") if is_own else (False, "shape.footprint.points", None)
        )


def test_boxes_by_two_corners_are_suggested() -> None:
    _, mapping = suggested(cup={"boxes": [{"label": "cup", "xyxy": [1, 2, 3, 6]}]})
    (topic,) = mapping.topics
    assert (topic.objects, topic.name, topic.bounds) == ("boxes[*]", "{label}", "xyxy")


def test_the_order_of_quaternions_is_that_in_which_objects_stand_upright() -> None:
    turns = [(cos(angle), 0.0, 0.0, sin(angle)) for angle in (0.1, 0.7, 1.3, 2.0)]
    for order, shift in (("wxyz", 0), ("xyzw", 1)):
        messages = [
            {"position": [second, 0.0, 0.0], "q": [*turn[shift:], *turn[:shift]]}
            for second, turn in enumerate(turns)
        ]
        text, topic = suggested_for(messages)
        assert (topic.position, topic.orientation, topic.order) == ("position", "q", order)
        assert ("0 of 4 objects stand upright" in text) == (order == "wxyz")


def test_angles_are_read_as_objects_move() -> None:
    def yaw(name: str, *values: float, **more: Any) -> Angle | None:
        # a way around a circle, in degrees from x
        messages = [
            {"x": 9 * cos(radians(turn)), "y": 9 * sin(radians(turn)), name: value, **more}
            for turn, value in zip(range(0, 360, 10), values, strict=True)
        ]
        return suggested_for(messages)[1].yaw

    courses = [turn + 95 for turn in range(0, 360, 10)]
    assert yaw("yaw", *map(radians, courses)) == Angle("yaw")
    assert yaw("yaw", *courses) == Angle("yaw", scale=pi / 180)
    compass = [(90 - course) % 360 for course in courses]
    assert yaw("heading", *compass) == COMPASS
    fixes = [{"latitude": 52.0 + 1e-5 * k, "longitude": 5.0, "heading": 511.0} for k in range(4)]
    fixes += [{**fix, "heading": 90.0} for fix in fixes]
    text, topic = suggested_for(fixes)
    assert (topic.yaw, topic.invalid) == (COMPASS, (511.0,))
    assert "invalid: [511], since otherwise its yaw reaches 511," in text


def test_places_that_are_not_available_are_left_out_rather_than_scaled() -> None:
    fixes = [{"lat": 52.0 + 1e-5 * k, "lon": 4.5, "heading": 511 if k == 5 else 0} for k in range(20)]
    fixes[7] |= {"lat": 91.0, "lon": 181.0}
    topic = suggested_for(fixes)[1]
    assert (topic.invalid, topic.scale) == ((511, 91, 181), 1.0)


def test_lists_of_changes_are_not_complete() -> None:
    def part(second: int) -> dict[str, Any]:
        ids = (1, 2) if second % 2 else (3, 4)
        return {"targets": [{"id": number, "x": number * 5.0, "y": 0.1 * second} for number in ids]}

    assert suggested_for([part(second) for second in range(20)])[1].complete is False
    whole = [{"targets": part(0)["targets"] + part(1)["targets"]} for _ in range(20)]
    assert suggested_for(whole)[1].complete is None


def test_outlines_of_geojson_are_found() -> None:
    ring = [[5.0, 52.0], [5.1, 52.0], [5.1, 52.1], [5.0, 52.0]]
    geometry = {"type": "Polygon", "coordinates": [ring]}
    _, topic = suggested_for([{"features": [{"id": "a", "type": "Feature", "geometry": geometry}]}])
    assert (topic.objects, topic.polygon, topic.class_name) == ("features[*]", "geometry", None)
    feature = {"type": "Feature", "properties": {"name": "field"}, "geometry": geometry}
    text = json.dumps({"type": "FeatureCollection", "features": [feature]})
    message = {"geojson": text}
    suggestion = suggest_mapping("run", [Topic("/zones", "foxglove.GeoJSON", "json")], {"/zones": [message]})
    mapping = parse_mapping(suggestion)
    assert (mapping.topics[0].polygon, mapping.origin) == (None, (52.0, 5.0))


def test_sizes_that_are_never_set_are_no_sizes() -> None:
    def shape(*widths: float) -> tuple[str, ShapeMapping | None]:
        things = [{"id": k, "x": 5.0 * k, "y": 0.0, "size": {"x": w, "y": w}} for k, w in enumerate(widths)]
        text, topic = suggested_for([{"objects": things}])
        return text, topic.shape

    text, footprint = shape(0.0, 0.0)
    assert footprint == ShapeMapping("disc", (0.5,))
    assert "sizes are 0 in all messages" in text
    text, footprint = shape(0.0, 1.0)
    assert footprint == ShapeMapping("box", ("size.x", "size.y"))
    assert "1 of 2 outlines have no extent" in text
    tracks = [
        {"id": k, "x": 9.0 * k, "y": 0.0, "size": {"x": w, "y": w, "z": 1.5}, "footprint": {"points": points}}
        for k, (w, points) in enumerate([(1.0, []), (0.0, [POINT] * 4)])
    ]
    assert "`shape: {polygon: footprint.points}` reads these" in suggested_for([{"objects": tracks}])[0]


def test_each_list_of_objects_in_a_message_has_an_entry() -> None:
    def thing(number: int, x: float, **more: Any) -> dict[str, Any]:
        return {"id": number, "x": x, "y": 0.0, "length": 1.0, "width": 1.0, **more}

    cars = [thing(1, 0.0), thing(2, 9.0)]
    message = {"cars": cars, "walkers": [thing(1, 5.0, yaw=0.5)], "signs": [{"id": 4, "x": 1.0, "y": 2.0}]}
    text = suggest_mapping("run", [Topic("/state", "own/State", "json")], {"/state": [message]})
    lists = {topic.objects: topic.name for topic in parse_mapping(text).topics}
    assert lists == {"cars[*]": "car{id}", "walkers[*]": "walker{id}"}
    assert "other lists that look like objects: signs[*]" in text
    # a list of the same objects is none of its own; lists of one name have that of what holds them
    for other, names in (
        ({"detections": cars, "tracks": cars}, ["detection{id}"]),
        ({"left": {"tracks": cars}, "right": {"tracks": [thing(1, 30.0)]}}, ["track{id}", "right_track{id}"]),
    ):
        text = suggest_mapping("run", [Topic("/state", "own/State", "json")], {"/state": [other]})
        assert sorted(str(topic.name) for topic in parse_mapping(text).topics) == sorted(names)


def test_sizes_and_turns_are_found_in_lists() -> None:
    annotation = {
        "instance": "a",
        "translation": [373.2, 1130.4, 0.8],
        "size": [0.6, 0.7, 1.6],
        "rotation": [0.98, 0.0, 0.0, -0.18],
    }
    text, topic = suggested_for([{"annotations": [annotation, {**annotation, "instance": "b"}]}] * 3)
    assert topic.shape == ShapeMapping("box", ("size[0]", "size[1]", "size[2]"))
    assert (topic.position, topic.orientation, topic.order) == ("translation", "rotation", "wxyz")
    assert "size is read as length, width and height" in text


def test_floors_are_named() -> None:
    def text(*levels: str) -> str:
        robots = [{"name": f"r{k}", "x": 1.0, "y": 2.0, "level_name": name} for k, name in enumerate(levels)]
        return suggested_for([{"robots": robots}])[0]

    assert "level_name names floors" in text("L1", "L2")
    assert "floors" not in text("L1", "L1")


def test_boxes_by_four_numbers_are_read_as_their_values_allow() -> None:
    names = ("xmin", "ymin", "xmax", "ymax")
    box = dict(zip(names, (1, 2, 3, 6), strict=True))
    _, topic = suggested_for([{"boxes": [{"id": 1, "roi": box}]}])
    assert (topic.bounds, topic.bounds_have_size) == (tuple(f"roi.{name}" for name in names), False)
    for numbers, has_size in (((100, 100, 20, 30), True), ((100, 100, 120, 130), False)):
        text, topic = suggested_for([{"boxes": [{"bbox": [0, 0, 10, 10]}, {"bbox": list(numbers)}]}])
        assert (topic.bounds, topic.bounds_have_size) == ("bbox", has_size)
        assert "# bbox " in text
    # the ends of a line are no corners of a box
    line = {"x1": 3.0, "y1": 0.0, "x2": 1.0, "y2": 4.0}
    with pytest.raises(UsageError, match="no topic was chosen"):
        parse_mapping(suggest_mapping("run", [Topic("/a", "own/A", "json")], {"/a": [{"lines": [line]}]}))


def test_zeros_that_json_leaves_out_are_suggested_as_such() -> None:
    def models(*places: dict[str, float]) -> dict[str, Any]:
        poses = [
            {"name": f"m{k}", "position": place, "orientation": {"w": 1}} for k, place in enumerate(places)
        ]
        return {"pose": poses}

    for places in (({}, {"x": 2, "z": 0.1}), ({"x": 1, "y": 2}, {"y": 1})):
        (topic,) = suggested(world=models(*places))[1].topics
        assert (topic.has_zeros_left_out, topic.name, topic.position) == (True, "{name}", "position")
        assert topic.orientation == "orientation"
    (topic,) = suggested(world=models({"x": 1, "y": 2}, {"x": 0, "y": 1}))[1].topics
    assert not topic.has_zeros_left_out
    # an object without a position at all is another thing
    partial = {"pose": [{"name": "a", "position": POINT}, {"name": "b"}]}
    text = suggest_mapping("run", [Topic("/world", "a/World", "json")], {"/world": [partial]})
    assert "missing: 0" not in text


def test_classes_are_texts() -> None:
    people = {"name": "anna", "class_name": "person", "position": POINT, "radius": 0.4}
    _, mapping = suggested(people={"tracks": [people]})
    (topic,) = mapping.topics
    assert topic.name == "{name}"
    assert topic.class_name is not None
    assert topic.shape == ShapeMapping("disc", ("radius",))


@pytest.mark.parametrize(
    ("kind", "needs_shape"),
    [
        ("geometry_msgs/msg/PoseStamped", True),
        ("nav_msgs/msg/Odometry", True),
        ("visualization_msgs/msg/MarkerArray", False),
        ("apriltag_msgs/msg/AprilTagDetectionArray", False),
        ("foxglove.SceneUpdate", False),
        ("foxglove.PosesInFrame", True),
    ],
)
def test_built_in_types_need_no_fields(kind: str, needs_shape: bool) -> None:
    (topic,) = parse_mapping(suggest_mapping("run", [Topic("/a", kind, "cdr")], {})).topics
    assert (topic.shape is not None) == needs_shape
    assert topic.position is topic.objects is None


TRANSFORM = {"header": {"frame_id": "map", "stamp": STAMP}, "child_frame_id": "base"}


def test_transforms_are_suggested_as_objects_only_without_other_objects() -> None:
    tf = Topic("/tf", "tf2_msgs/msg/TFMessage", "cdr")
    pose = Topic("/pose", "geometry_msgs/msg/PoseStamped", "cdr")
    (alone,) = parse_mapping(suggest_mapping("run", [tf], {})).topics
    assert alone.topic == "/tf"
    text = suggest_mapping("run", [pose, tf], {"/tf": [{"transforms": [TRANSFORM]}]})
    mapping = parse_mapping(text)
    assert [each.topic for each in mapping.topics] == ["/pose"]
    assert mapping.fixed_frame is None
    assert "# fixed_frame: map" in text


def test_the_root_frame_is_suggested_for_several_frames() -> None:
    pose = {"position": POINT}
    examples = {
        "/one": [{"header": {"frame_id": "map"}, "pose": pose}],
        "/two": [{"header": {"frame_id": "/base"}, "pose": pose}],
        "/tf": [{"transforms": [TRANSFORM]}],
    }
    kinds = {"/one": "a/msg/One", "/two": "a/msg/Two", "/tf": "tf2_msgs/msg/TFMessage"}
    topics = [Topic(name, kind, "json") for name, kind in kinds.items()]
    assert parse_mapping(suggest_mapping("run", topics, examples)).fixed_frame == "map"
    # without the transforms, what is in another frame is left out
    text = suggest_mapping("run", topics[:2], examples)
    assert "frames base, map" in text
    assert "  # /one: " in text and "in map, apart from base" in text
    mapping = parse_mapping(text)
    assert ([each.topic for each in mapping.topics], mapping.fixed_frame) == (["/two"], "base")


def test_frames_inside_lists_count_and_only_a_common_root_is_suggested() -> None:
    odometry = {"header": {"frame_id": "odom"}, "pose": {"pose": {"position": POINT, "orientation": TURN}}}
    markers = {"markers": [{"header": {"frame_id": "map"}, "ns": "a", "id": 1}]}
    examples: dict[str, list[object]] = {"/odom": [odometry], "/markers": [markers]}
    kinds = {
        "/odom": "nav_msgs/msg/Odometry",
        "/markers": "visualization_msgs/msg/MarkerArray",
        "/tf": "tf2_msgs/msg/TFMessage",
    }
    topics = [Topic(name, kind, "json") for name, kind in kinds.items()]

    def suggested_with(*edges: tuple[str, str]) -> str:
        moved = [{"header": {"frame_id": one}, "child_frame_id": other} for one, other in edges]
        return suggest_mapping("run", topics, {**examples, "/tf": [{"transforms": moved}]})

    joined = parse_mapping(suggested_with(("map", "odom"), ("odom", "base")))
    assert joined.fixed_frame == "map"
    assert {each.topic: each.max_age_ns for each in joined.topics} == {"/odom": None, "/markers": FOREVER_NS}
    assert parse_mapping(suggested_with(("world", "map"), ("map", "odom"))).fixed_frame == "world"
    for apart in ([("map", "laser"), ("odom", "base")], []):
        mapping = parse_mapping(suggested_with(*apart))
        assert ([each.topic for each in mapping.topics], mapping.fixed_frame) == (["/markers"], "map")


def test_a_topic_without_frames_beside_others_is_remarked() -> None:
    robot = {"header": {"frame_id": "odom"}, "pose": {"position": POINT, "orientation": TURN}}
    text, _ = suggested(robot=robot, cup={"x": 1.0, "y": 2.0})
    lines = text.splitlines()
    (place,) = (number for number, line in enumerate(lines) if line.startswith("  /cup:"))
    assert "name no frame" in lines[place - 1]
    assert text.count("name no frame") == 1
    assert "name no frame" not in suggested(cup={"x": 1.0, "y": 2.0})[0]


def test_json_that_is_nested_deeply_is_surveyed() -> None:
    inner: Any = {}
    for _ in range(5000):
        inner = {"a": inner}
    _, mapping = suggested(robot={"position": POINT, "rest": inner})
    assert mapping.topics[0].position == "position"


def test_transforms_as_objects_are_brought_into_their_root() -> None:
    moved = [{"header": {"frame_id": a}, "child_frame_id": b} for a, b in (("map", "odom"), ("odom", "base"))]
    tf = Topic("/tf", "tf2_msgs/msg/TFMessage", "json")
    assert parse_mapping(suggest_mapping("run", [tf], {"/tf": [{"transforms": moved}]})).fixed_frame == "map"


def test_pixels_and_metres_do_not_meet_in_one_suggestion() -> None:
    corners = [{"x": x, "y": y, "z": 0.0} for x, y in ((300, 200), (340, 200), (340, 240), (300, 240))]
    robot = {"pose": {"position": POINT, "orientation": TURN}}
    text, mapping = suggested(robot=robot, tags={"tags": [{"id": 1, "corners": corners}]})
    assert [each.topic for each in mapping.topics] == ["/robot"]
    assert "# /tags: " in text
    assert "in pixels" in text
    # alone, they are the scene, with y down
    _, mapping = suggested(tags={"tags": [{"id": 1, "corners": corners}]})
    assert (mapping.topics[0].polygon, mapping.axes.y) == ("corners", "down")
    # beside a pose that lies elsewhere, the pose counts
    tag = {"id": 1, "center": {"x": 320.0, "y": 220.0}, "corners": corners, "pose": robot}
    _, mapping = suggested(robot=robot, tags={"tags": [tag]})
    assert {each.topic: each.position for each in mapping.topics} == {
        "/robot": "pose.position",
        "/tags": "pose.pose.position",
    }


def test_north_east_down_is_recognised_by_the_names_of_px4() -> None:
    position = {"x": 0.0, "y": 2.0, "z": -5.0, "heading": 1.5}
    topic = Topic("/fmu/out/vehicle_local_position", "px4_msgs/msg/VehicleLocalPosition", "json")
    text = suggest_mapping("run", [topic], {topic.name: [position]})
    assert parse_mapping(text).axes.y == "down"
    assert "x is north, y east, z down" in text
    # beside coordinates that are not, they are left out
    robot = Topic("/robot", "geometry_msgs/msg/PoseStamped", "json")
    mapping = parse_mapping(suggest_mapping("run", [topic, robot], {topic.name: [position]}))
    assert ([each.topic for each in mapping.topics], mapping.axes.y) == (["/robot"], "up")
    mavros = Topic("/mavros/local_position/pose", "geometry_msgs/msg/PoseStamped", "json")
    assert "north, east, down" in suggest_mapping("run", [mavros], {})


def test_a_suggestion_for_any_log_is_small_enough_to_be_read() -> None:
    topics = [
        Topic(f"/{number}/{'x' * 100}", "geometry_msgs/msg/PoseStamped", "cdr") for number in range(5000)
    ]
    topics.append(Topic("/" + "y" * 2000, "geometry_msgs/msg/PoseStamped", "cdr"))
    text = suggest_mapping("run", topics, {})
    assert 100 < len(parse_mapping(text).topics) < 5000
    assert "more" in text.splitlines()[-1]


def test_numbers_are_suggested_as_signals() -> None:
    text, mapping = suggested(robot={"position": POINT}, battery={"header": {"seq": 1}, "percentage": 0.8})
    assert len(mapping.topics) == 1
    assert "# /battery: {signals: {battery_percentage: percentage}}" in text


def test_ids_distinguish_objects_rather_than_places_in_a_list() -> None:
    for name, values in {"fiducial_id": (4, 9), "trackId": (1, 2), "tag_id": ("a", "b")}.items():
        listed = [{name: value, "class_id": 1, "position": POINT} for value in values]
        _, mapping = suggested(detector={"tags": listed})
        assert mapping.topics[0].name == f"tag{{{name}}}"
    # a name that two objects share distinguishes neither
    twins = [{"name": "cup", "id": 1, "position": POINT}, {"name": "cup", "id": 2, "position": POINT}]
    assert suggested(detector={"tags": twins})[1].topics[0].name == "tag{id}"
    text, mapping = suggested(detector={"tags": [{"class_id": 1, "position": POINT}] * 2})
    assert mapping.topics[0].name == "tag{index}"
    assert "objects swap" in text


def test_identities_are_found_in_bytes_lists_of_one_and_lists_side_by_side() -> None:
    def tracks(**identity: Any) -> dict[str, Any]:
        return {
            "tracks": [
                {**{key: value[k] for key, value in identity.items()}, "position": POINT} for k in (0, 1)
            ]
        }

    one, other = list(range(16)), list(range(1, 17))
    table = {"cup": {"x": 1.0, "y": 2.0}, "plate": {"x": 1.0, "y": 3.0}}
    cases = {
        "track{object_id.uuid}": tracks(object_id=({"uuid": one}, {"uuid": other})),
        "track{uuid}": tracks(uuid=(one, other)),
        "track{id}": tracks(id=([4], [5])),
        "{$.names[index]}": {"names": ["cup", "plate"], "poses": [{"position": POINT}] * 2},
        "{$.world.name[index]}": {"world": {"name": ["cup", "plate"], "pose": [{"position": POINT}] * 2}},
        "{index}": {"objects": table},
    }
    for name, message in [*cases.items(), ("{index}", {**table, "time": 3.0})]:
        text, mapping = suggested(thing=message)
        assert mapping.topics[0].name == name
        assert "objects swap" not in text
    # lists that do not name each element once
    for names in (["cup", "cup"], ["cup"], "cup"):
        text, _ = suggested(thing={"names": names, "poses": [{"position": POINT}] * 2})
        assert "objects swap" in text
    # the parts of one object are no objects by name
    _, mapping = suggested(box={"box": {"min": {"x": 1.0, "y": 2.0}, "max": {"x": 2.0, "y": 3.0}}})
    assert not any(topic.reads_objects for topic in mapping.topics)


@pytest.mark.parametrize(("ids", "swap"), [(("", ""), True), (("a", "b"), False)])
def test_empty_ids_leave_only_places_in_the_list(ids: tuple[str, str], swap: bool) -> None:
    box = {"center": {"x": 1, "y": 1, "theta": 0}, "size_x": 1, "size_y": 1}
    detections = {"detections": [{"id": each, "bbox": box} for each in ids]}
    topic = Topic("/det", "vision_msgs/msg/Detection2DArray", "json")
    assert ("objects swap" in suggest_mapping("run", [topic], {"/det": [detections]})) == swap


def test_ids_that_take_turns_name_one_object_a_message() -> None:
    def names(field: str, *values: Any) -> str | None:
        return suggested_for([{field: value, **POINT} for value in values])[1].name

    assert names("track_id", 4, 7, 4, 9) == "track{track_id}"
    assert names("name", "cup", "cup", "plate", "cup") == "{name}"
    # counters, and what is the same or changes for a while, name no object
    for values in ((1, 2, 3, 4), (5, 5, 5), (1, 1, 2, 2, 3), (7,)):
        assert names("id", *values) == "tracks"
    odometry = [
        {"child_frame_id": name, "pose": {"pose": {"position": POINT, "orientation": TURN}}}
        for name in ("r1", "r2", "r1")
    ]
    assert suggested_for(odometry, "nav_msgs/msg/Odometry")[1].name == "{child_frame_id}"
    assert suggested_for(odometry[:2], "nav_msgs/msg/Odometry")[1].name is None


def test_objects_in_a_protobuf_map_are_named_by_its_keys() -> None:
    field_type = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="scene.proto", package="own", syntax="proto3")
    thing, scene = file.message_type.add(name="Thing"), file.message_type.add(name="Scene")
    entry = scene.nested_type.add(name="ObjectsEntry")
    entry.options.map_entry = True
    for number, name in enumerate(("x", "y", "radius"), 1):
        thing.field.add(name=name, number=number, type=field_type.TYPE_DOUBLE)
    entry.field.add(name="key", number=1, type=field_type.TYPE_STRING)
    value = {"type": field_type.TYPE_MESSAGE, "number": 2}
    entry.field.add(name="value", type_name=".own.Thing", **value)
    listed = {"label": field_type.LABEL_REPEATED, "type_name": ".own.Scene.ObjectsEntry"}
    scene.field.add(name="objects", **listed, **value)
    message = message_factory.GetMessages([file])["own.Scene"]()
    message.objects["cup"].x = 1.0
    _, topic = suggested_for([message], "own.Scene")
    assert (topic.objects, topic.name, topic.position) == ("objects[*]", "{index}", ("x", "y"))
    assert topic.shape == ShapeMapping("disc", ("radius",))


def test_plans_are_no_objects() -> None:
    pose = {"position": POINT, "orientation": TURN}
    poses = [{"pose": pose}, {"pose": pose}]
    cases = [
        ("/plan", "nav_msgs/msg/Path", {"poses": poses}),
        ("/global_path", "own/msg/Poses", {"poses": poses}),
        ("/mission", "own/msg/Mission", {"waypoints": [{"id": 1, "pose": pose}, {"id": 2, "pose": pose}]}),
    ]
    for name, kind, message in cases:
        text = suggest_mapping("run", [Topic(name, kind, "json")], {name: [message]})
        assert f"  # {name}: {{objects: " in text
        assert "no objects" in text
        with pytest.raises(UsageError, match="no topic was chosen"):
            parse_mapping(text)
    # the robot beside its plan
    state = {"nodeStates": [{"nodePosition": POINT}], "agvPosition": {"x": 1.0, "y": 2.0, "theta": 0.5}}
    _, topic = suggested_for([{**state, "lastNodePosition": POINT}])
    assert (topic.objects, topic.position, topic.yaw) == (None, "agvPosition", Angle("agvPosition.theta"))


def test_the_origin_is_the_first_fix_that_is_one() -> None:
    def fix(latitude: float, longitude: float, status: int) -> dict[str, Any]:
        return {"status": {"status": status}, "latitude": latitude, "longitude": longitude}

    topic = Topic("/fix", "sensor_msgs/msg/NavSatFix", "json")
    fixes = [fix(0.0, 0.0, -1), fix(1.0, 2.0, -1), fix(0.0, 0.0, 0), fix(52.0, 5.0, 0), fix(52.1, 5.0, 0)]
    assert parse_mapping(suggest_mapping("run", [topic], {"/fix": fixes})).origin == (52.0, 5.0)
    receivers = [{"frame_id": f"gps_{number}", **fix(48.0, number, 0)} for number in (2, 3)]
    text = suggest_mapping("run", [Topic("/fixes", "a.Fixes", "json")], {"/fixes": [{"fixes": receivers}]})
    mapping = parse_mapping(text)
    assert (mapping.origin, mapping.fixed_frame) == ((48.0, 2.0), None)
    assert (mapping.topics[0].position, mapping.topics[0].name) == (
        ("latitude", "longitude"),
        "fix{frame_id}",
    )


def test_topics_that_cannot_be_read_as_suggested_are_comments_with_the_reason() -> None:
    topics = [Topic("/boat", "own/Boat", "json"), Topic("/box", "vision_msgs/msg/Detection2DArray", "json")]
    center = {"center": {"x": 1, "y": 1}}
    examples: dict[str, list[object]] = {
        "/boat": [{"latitude": 0.0, "longitude": 0.0}],
        "/box": [{"detections": [{"id": "a", "bbox": center}]}],
    }
    text = suggest_mapping("run", topics, examples)
    assert "# Nothing can be read as an object; the reasons are below." in text
    assert "no message looked at has a fix in degrees" in text
    assert "has no field 'theta'" in text
    robot = Topic("/robot", "own/Robot", "json")
    text = suggest_mapping("run", [*topics, robot], {**examples, "/robot": [{"x": 1.0, "y": 1.0}, {"a": 1}]})
    assert [topic.topic for topic in parse_mapping(text).topics] == ["/robot"]
    assert "1 of 2 messages looked at cannot be read" in text


def test_names_that_several_topics_share_get_the_topic_as_prefix() -> None:
    tag = {"id": 3, "corners": [POINT] * 4}
    _, mapping = suggested(left={"tags": [tag]}, right={"tags": [tag]})
    assert [each.name for each in mapping.topics] == ["left_tag{id}", "right_tag{id}"]
    kinds = {"/a/odom": "nav_msgs/msg/Odometry", "/a/pose": "geometry_msgs/msg/PoseStamped"}
    topics = [Topic(name, kind, "cdr") for name, kind in kinds.items()]
    names = [each.name for each in parse_mapping(suggest_mapping("run", topics, {})).topics]
    assert names == ["a_odom", "a_pose"]


def test_mounts_velocities_and_times_are_no_objects() -> None:
    _, mapping = suggested(
        camera={"mounting_position": POINT, "sensor": {"position": POINT}, "gain": 2.0},
        cmd_vel={"x": 1.0, "y": 0.0},
        map={"info": {"origin": {"position": POINT}}},
        tracker={"tracks": [{"id": 1, "velocity": POINT, "camera_pose": {"position": POINT}}]},
        gripper={"closed": True, "stamp": 3, "header": {"seq": 1}, "time_of_day": 4.0, "force": 0.5},
    )
    assert not any(each.reads_objects for each in mapping.topics)
    signals = {each.name: each.field for topic in mapping.topics for each in topic.signals}
    assert {"gripper_closed": "closed", "gripper_force": "force"}.items() <= signals.items()
    assert not any("stamp" in name or "time" in name or "seq" in name for name in signals)
    mounts = [{**TRANSFORM, "child_frame_id": name} for name in ("base", "front_camera", "lidar")]
    topics = [Topic(name, "tf2_msgs/msg/TFMessage", "cdr") for name in ("/tf", "/tf_static")]
    (topic,) = parse_mapping(suggest_mapping("run", topics, {"/tf": [{"transforms": mounts}]})).topics
    assert (topic.topic, topic.without) == ("/tf", ("front_camera", "lidar"))


def test_joints_are_signals_by_their_names() -> None:
    joints = {"header": {"seq": 1}, "name": ["elbow", "wrist"], "position": [0.5, 1.5], "effort": []}
    _, mapping = suggested(joint_states=joints)
    (topic,) = mapping.topics
    assert {each.name: each.field for each in topic.signals} == {
        "joint_states_elbow_position": "position[name=elbow]",
        "joint_states_wrist_position": "position[name=wrist]",
    }


def test_a_log_without_objects_and_numbers_has_no_topic_chosen() -> None:
    text = suggest_mapping("run", [Topic("/text", "own/Text", "cdr")], {"/text": [{"words": "a"}]})
    assert "# no topic was chosen" in text
    with pytest.raises(UsageError, match="topics: no topic was chosen"):
        parse_mapping(text)


def test_a_message_that_is_one_text_is_suggested_as_a_signal() -> None:
    text = suggest_mapping(
        "run", [Topic("/mode", "std_msgs/msg/String", "cdr")], {"/mode": [{"data": "AUTO"}]}
    )
    (topic,) = parse_mapping(text).topics
    assert {each.name: each.field for each in topic.signals} == {"mode_data": "data"}


@pytest.mark.parametrize(
    "name",
    [
        "apriltags_table.bag",
        "pose_db3",
        "talker_mcap",
        "talker_sqlite3",
        "two_turtles.bag",
        "two_turtles_lz4.bag",
        "two_turtles_mcap",
        "two_turtles_sqlite3",
    ],
)
def test_what_is_suggested_for_a_log_is_accepted_as_it_is(
    data_folder: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log, file = data_folder / "bags" / name, tmp_path / "suggested.yaml"
    assert run(["info", str(log), "--suggest-mapping"]) == 0
    printed = capsys.readouterr().out
    file.write_text(printed)
    trace = next(block.trace for block in open_source(log, mapping=file).iter_blocks() if len(block.trace))
    assert tuple(trace.signals) == ("topic_data",) if name.startswith("talker") else trace.names
    assert trace.faults == ()


def test_what_is_suggested_for_protobuf_is_accepted_as_it_is(
    data_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, file = data_folder / "osi" / "osi_centerline_example.mcap", tmp_path / "suggested.yaml"
    assert run(["info", str(log), "--suggest-mapping"]) == 0
    file.write_text(capsys.readouterr().out)
    assert len(read_trace(log, mapping=file).names) == 14


def test_topics_without_objects_are_listed_as_comments() -> None:
    topics = [
        Topic("/rosout", "rcl_interfaces/msg/Log", "cdr", 12),
        Topic("/odd name\n", "b\n: c", "x", unreadable="no\ndefinition"),
        Topic("/text", "own/Text", "cdr"),
    ]
    text = suggest_mapping(
        "run\n.bag", topics, {"/text": [{"words": "hello"}], "/rosout": [{"x": 1.0, "y": 1.0}]}
    )
    assert all(
        line.startswith("#") or line.split(":")[0] in ("clock", "topics")
        for line in map(str.strip, text.splitlines())
        if line
    )
    assert "/rosout: rcl_interfaces/msg/Log, 12 messages" in text
    assert "cannot be read: no definition" in text


def test_topic_names_are_quoted_if_need_be() -> None:
    topics = [
        Topic(name, "geometry_msgs/msg/PoseStamped", "cdr")
        for name in ("no", "a: b", "#", "ünï", "'", '"', "a\n")
    ]
    mapping = parse_mapping(suggest_mapping("run", topics, {}))
    assert [each.topic for each in mapping.topics] == [each.name for each in topics]


def test_stamps_are_the_clock_if_delays_differ() -> None:
    kind = "geometry_msgs/msg/PoseStamped"
    topics = [Topic(name, kind, "json") for name in ("/robot", "/tracker")]
    seconds = [100.0 + k / 10 for k in range(10)]

    def clock(delay_s: float, unit: float = 1.0, **header: Any) -> tuple[str, str]:
        delays = {"/robot": 0.002, "/tracker": delay_s}
        stamps = {
            name: [
                dict(zip(("sec", "nanosec"), divmod(round((time - late) * 1e9 * unit), 10**9), strict=True))
                for time in seconds
            ]
            for name, late in delays.items()
        }
        pose = {"position": POINT, "orientation": TURN}
        examples = {
            name: [
                {"header": {"frame_id": "map", "stamp": stamp, **header}, "pose": pose} for stamp in listed
            ]
            for name, listed in stamps.items()
        }
        times_ns = {name: [round(time * 1e9) for time in seconds] for name in delays}
        text = suggest_mapping("run", topics, examples, times_ns)
        return parse_mapping(text).clock, text

    name, text = clock(0.302)
    assert name == "header"
    assert "stamps of /tracker are 0.3 s later recorded than those of /robot" in text
    assert clock(0.012)[0] == "log"
    # another clock, stamps of 0, and stamps in another unit
    for change in ({"delay_s": 18.0}, {"delay_s": 0.3, "stamp": STAMP}, {"delay_s": 0.3, "unit": 1e-3}):
        assert clock(**change)[0] == "log"
    assert "so they are of two clocks" in clock(18.0)[1]


def test_the_last_topic_to_start_is_sampled() -> None:
    topics = [Topic(name, "geometry_msgs/msg/PoseStamped", "cdr", 100) for name in ("/a", "/b", "/late")]
    begins = {"/a": [10], "/b": [20], "/late": [10**10]}
    assert parse_mapping(suggest_mapping("run", topics, {}, begins)).sampling.topic == "/b"
    assert parse_mapping(suggest_mapping("run", topics, {})).sampling.topic == "/a"


def test_detections_in_images_are_turned_over() -> None:
    image = Topic("/detections", "vision_msgs/msg/Detection2DArray", "cdr")
    ground = Topic("/robot", "geometry_msgs/msg/PoseStamped", "cdr")
    assert "axes: {y: down}\n" in suggest_mapping("a.bag", [image], {})
    assert "axes:" not in suggest_mapping("a.bag", [image, ground], {})


def test_a_robot_and_markers_in_two_frames_get_their_true_distance_or_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # odometry begins 2 m from the origin of the map, and the marker is 1.5 m from that
    pose = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": TURN}
    marker = {"ns": "a", "id": 1, "type": 1, "action": 0, "lifetime": {"sec": 0, "nanosec": 0}}
    marker |= {
        "header": {"frame_id": "map", "stamp": STAMP},
        "pose": {**pose, "position": {"x": 1.5, "y": 0, "z": 0}},
    }
    shift = {"translation": {"x": 2, "y": 0, "z": 0}, "rotation": TURN}
    placed = {"header": {"frame_id": "map", "stamp": STAMP}, "child_frame_id": "odom", "transform": shift}
    mapping = str(tmp_path / "m.yaml")
    for transforms, code in (([placed], 1), ([], 4)):
        messages = {
            ("/tf", "tf2_msgs/msg/TFMessage"): {"transforms": transforms},
            ("/odom", "nav_msgs/msg/Odometry"): {
                "header": {"frame_id": "odom", "stamp": STAMP},
                "pose": {"pose": pose},
            },
            ("/m", "visualization_msgs/msg/MarkerArray"): {
                "markers": [{**marker, "scale": {"x": 1, "y": 1, "z": 1}}]
            },
        }
        log = tmp_path / f"{code}.mcap"
        with log.open("wb") as stream:
            writer = Writer(stream)
            writer.start("", "test")
            for (topic, kind), message in messages.items():
                schema = writer.register_schema(kind, "jsonschema", b"{}")
                channel = writer.register_channel(topic, "json", schema)
                writer.add_message(channel, 10**9, json.dumps(message).encode(), 10**9)
            writer.finish()
        Path(mapping).unlink(missing_ok=True)
        assert run(["info", str(log), "--suggest-mapping", "-o", mapping]) == 0
        capsys.readouterr()
        assert run(["replay", str(log), "--mapping", mapping, "--spec", "G (odom dist a_1 >= 0)"]) == code
        said = capsys.readouterr()
        assert ("violated   robustness -0.5" if transforms else "unknown") in said.out + said.err

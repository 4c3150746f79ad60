"""Keys and paths of mapping files, for fields that their names alone do not explain."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FieldDescriptorProto
from google.protobuf.json_format import MessageToDict
from google.protobuf.struct_pb2 import Struct
from mcap.writer import Writer

from mapping.feeding import SECOND, Feed, Made, make, ros
from spatial_replay import Footprint, Trace, UsageError
from spatial_replay.geometry.measure import contact
from spatial_replay.mapping.assemble import LiveAssembler
from spatial_replay.mapping.mapped_source import MappedSource
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan


def read(keys: str, *contents: Any, mapping: str = "", name: str = "a/Thing") -> Made:
    """Read contents, one each second, of the topic /t with some keys."""
    feed = Feed(types={"/t": name})
    for second, content in enumerate(contents):
        feed.add("/t", second * SECOND, content)
    return make(f"{mapping}\ntopics:\n  /t: {{{keys}}}", feed)


def test_flat_keys_are_read_in_quotes() -> None:
    content = {"pose.x": 1.0, "pose.y": 2.0, "größe": 3.0, "tag": "cup"}
    keys = """name: "{'tag'}", position: ["'pose.x'", "'pose.y'"], shape: {disc: "'größe'"}"""
    assert read(keys, content).centre(0, "cup") == (1.0, 2.0)
    with pytest.raises(UsageError, match=r"a key with a dot stands in quotes: 'pose\.x'"):
        read("position: [pose.x, pose.y]", content)


def test_an_element_is_chosen_by_its_field() -> None:
    def nodes(**states: str) -> dict[str, Any]:
        return {"log": [{"node": node, "state": state} for node, state in states.items()]}

    contents = nodes(Spin="RUNNING", Follow="RUNNING"), nodes(Spin="FAILURE"), nodes(Follow="FAILURE")
    made = read("signals: {follow: 'log[node=Follow].state', last: 'log[-1].state'}", *contents)
    follow, last = (made.trace.signals[name].tolist() for name in ("follow", "last"))
    # the node that a message leaves out is unknown there
    assert [value == other for value, other in zip(follow, last, strict=True)] == [True, False, True]
    assert follow[1] != follow[1]
    assert made.faults == ()
    with pytest.raises(UsageError, match="has no field 'nod'; did you mean 'node'"):
        read("signals: {follow: 'log[nod=Follow].state'}", *contents)


def test_the_fields_of_a_protobuf_struct_are_read_by_name() -> None:
    message = Struct()
    message.update({"robots": {"r1": {"x": 1.0, "y": 2.0}, "r2": {"x": 3.0, "y": 4.0}}, "charge": 0.5})
    made = read("objects: 'robots[*]', name: '{index}', signals: {charge: charge, x: robots.r2.x}", message)
    assert [made.centre(0, name) for name in ("r1", "r2")] == [(1.0, 2.0), (3.0, 4.0)]
    assert [made.trace.signals[name][0] for name in ("charge", "x")] == [0.5, 3.0]


@pytest.mark.parametrize(
    ("keys", "stamps"),
    [
        ("stamp: time", ["2026-03-02T10:00:01.5Z", "2026-03-02T12:00:03+02:00"]),
        ("stamp: time", ["1772445601.5s", "1772445603s"]),
        ("stamp: {field: time, unit: ms}", ["1772445601500", "1772445603000"]),
        ("stamp: time", [[1772445601, 500_000_000], [1772445603, 0]]),
    ],
)
def test_stamps_are_texts_or_pairs(keys: str, stamps: list[Any]) -> None:
    contents = [{"x": 0.0, "y": 0.0, "time": stamp} for stamp in stamps]
    made = read(keys, *contents, mapping="clock: header")
    assert made.trace.times_ns.tolist() == [1772445601_500_000_000, 1772445603_000_000_000]


def test_seconds_and_nanoseconds_may_be_two_fields() -> None:
    contents = [{"x": 0.0, "y": 0.0, "s": second, "ns": 5} for second in (1, 2)]
    made = read("stamp: [s, ns]", *contents, mapping="clock: header")
    assert made.trace.times_ns.tolist() == [SECOND + 5, 2 * SECOND + 5]


@pytest.mark.parametrize("stamp", ["2026-03-02T10:00:01", "soon", [1, 2, 3]])
def test_a_stamp_that_is_no_time_is_refused_with_another_clock(stamp: Any) -> None:
    content = {"x": 0.0, "y": 0.0, "stamp": stamp}
    with pytest.raises(UsageError, match="`clock: log`"):
        read("stamp: stamp", content, mapping="clock: header")
    with pytest.raises(UsageError, match=r"is not a time; .*`clock: log`"):
        read("", content, mapping="clock: header")
    assert read("", {**content, "stamp": "soon"}).states("t") == "+"


def scene(
    *names: str, second: int = 0, deletes: tuple[str, ...] = (), deleted_second: int = 9
) -> SceneUpdate:
    """Return an update with discs at (0, 0); "*" deletes all."""
    update = SceneUpdate()
    for name in deletes:
        deletion = update.deletions.add(id="" if name == "*" else name, type=int(name == "*"))  # type: ignore[arg-type]
        deletion.timestamp.seconds = deleted_second
    for name in names:
        entity = update.entities.add(id=name, frame_id="map")
        entity.timestamp.seconds = second
        entity.lifetime.seconds = 2 * (name == "brief")
        cylinder = entity.cylinders.add()
        cylinder.pose.position.y = 1.0
        cylinder.pose.orientation.w = 1.0
        cylinder.size.x = cylinder.size.y = cylinder.size.z = 3.0
    return update


def test_json_is_read_as_protobuf_writes_it() -> None:
    updates = [
        scene("crate", "silo", "brief", second=1),
        scene(deletes=("crate",)),
        scene(deletes=("*",)),
        scene("crate", second=9),
    ]
    for messages in (updates, [MessageToDict(update) for update in updates]):
        made = read("", *messages, name="foxglove.SceneUpdate")
        assert [made.states(name) for name in ("crate", "silo", "brief")] == ["+--+", "++--", "++--"]
        # a cylinder whose scales are not set has its full width
        footprint = made.trace.observation(int(made.trace.rows[0, 0])).footprint
        assert (footprint.parts[0].radius, made.centre(0, "silo")) == (1.5, (0.0, 1.0))
        assert made.faults == ()
    pose = PoseInFrame(frame_id="map")
    pose.pose.position.x = 2.0
    assert read("", MessageToDict(pose), name="foxglove.PoseInFrame").centre(0, "t") == (2.0, 0.0)


@pytest.mark.parametrize("name", ["crate", "*"])
def test_a_deletion_leaves_entities_that_are_later(name: str) -> None:
    updates = [scene("crate", second=4), scene(deletes=(name,), deleted_second=3), scene(deletes=(name,))]
    assert read("", *updates, name="foxglove.SceneUpdate").states("crate") == "++-"
    # a deletion without a timestamp deletes what there is
    unset = [scene("crate", second=4), scene(deletes=(name,), deleted_second=0)]
    assert read("", *unset, name="foxglove.SceneUpdate").states("crate") == "+-"


QUARTER = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
"""The quaternion x, y, z, w of a quarter turn."""


@pytest.mark.parametrize(
    ("keys", "fields"),
    [
        ("orientation: q, order: xyzw", {"q": list(QUARTER)}),
        ("orientation: q, order: wxyz", {"q": [QUARTER[3], *QUARTER[:3]]}),
        ("order: wxyz", {"orientation": [QUARTER[3], *QUARTER[:3]]}),
        ("orientation: [qx, qy, qz, qw]", dict(zip(("qx", "qy", "qz", "qw"), QUARTER, strict=True))),
        ("yaw: {field: a, unit: deg, zero: north, clockwise: true}", {"a": 360.0}),
        ("yaw: {field: a, unit: deg, zero: east, clockwise: true}", {"a": 270.0}),
        ("yaw: {field: a, unit: deg, zero: north, clockwise: false}", {"a": 0.0}),
    ],
)
def test_turns_are_read_from_any_zero_in_any_order(keys: str, fields: dict[str, Any]) -> None:
    made = read(f"{keys}, shape: {{box: [4, 2]}}", {"x": 0.0, "y": 0.0, **fields})
    assert sorted(made.footprint_row(0, "t").round(9).tolist()) == [[-1, -2], [-1, 2], [1, -2], [1, 2]]


@pytest.mark.parametrize(
    ("keys", "fault"),
    [
        ("order: wxyz, orientation: [a, b, c, d]", "test.yaml:3: .*order: the four paths"),
        ("order: wxyz, yaw: a", "test.yaml:3: .*order: .* there is `yaw`"),
        ("yaw: {field: a, zero: north}", "test.yaml:3: .*yaw: .*add `clockwise: true`"),
        ("yaw: {zero: north}", "test.yaml:3: .*yaw: the key 'field' is missing"),
        ("orientation: q", "q: the four numbers have no names; `order: wxyz`"),
        ("", "orientation: the four numbers have no names"),
        ("orientation: named, order: wxyz", "named: its fields are named"),
    ],
)
def test_turns_that_contradict_themselves_are_refused(keys: str, fault: str) -> None:
    numbers = {"q": list(QUARTER), "orientation": list(QUARTER)}
    content = {"x": 0.0, "y": 0.0, "named": dict(zip("xyzw", QUARTER, strict=True)), **numbers}
    with pytest.raises(UsageError, match=fault):
        read(keys, content)


def test_a_heading_beside_fixes_is_remarked_unless_its_zero_is_given() -> None:
    content = {"latitude": 52.0, "longitude": 5.0, "heading": 90.0}
    keys = "position: [latitude, longitude], shape: {box: [4, 2]}, yaw: {field: heading, unit: deg"
    (remark,) = read(f"{keys}}}", content, mapping="origin: [52, 5]").remarks
    assert "`yaw: {field: heading, unit: deg, zero: north, clockwise: true}`" in remark
    made = read(f"{keys}, zero: north, clockwise: true}}", content, mapping="origin: [52, 5]")
    assert made.remarks == ()
    assert sorted(made.footprint_row(0, "t").round(6).tolist()) == [[-2, -1], [-2, 1], [2, -1], [2, 1]]


def test_numbers_that_stand_for_nothing_are_unknown() -> None:
    contents = [
        {"x": 0.0, "y": 0.0, "theta": theta, "speed": speed} for theta, speed in ((1.0, 2), (511, 4095))
    ]
    made = read("invalid: [511, 4095], shape: {box: [2, 1]}, signals: {speed: speed}", *contents)
    assert made.states("t") == "+?"
    assert made.trace.signals["speed"].tolist()[0] == 2.0
    assert made.trace.signals["speed"][1] != made.trace.signals["speed"][1]


def test_a_topic_has_a_scale_of_its_own() -> None:
    contents = [{"x": 1000.0, "y": 2000.0, "length": 400.0}]
    keys = "shape: {box: [length, 200]}, height: [0, 500], uncertainty: 10, scale: 0.001"
    made = read(keys, *contents, mapping="scale: 100")
    (sample,) = made.trace
    thing = sample.objects["t"]
    assert sorted(made.footprint_row(0, "t").tolist()) == [[80, 190], [80, 210], [120, 190], [120, 210]]
    assert (thing.height, thing.uncertainty) == ((0.0, 50.0), 1.0)


def test_an_enum_of_protobuf_is_a_class_by_its_name_or_number() -> None:
    update = scene(deletes=("crate", "*"))
    keys = "objects: 'deletions[*]', name: 'd{index}', position: [timestamp.nanos, timestamp.nanos], class: "
    for names, classes in (
        ("{field: type}", ["MATCHING_ID", "ALL"]),
        ("{field: type, names: {ALL: all, '0': one}}", ["one", "all"]),
    ):
        (sample,) = read(keys + names, update).trace
        assert [sample.objects[name].class_name for name in ("d0", "d1")] == classes


def test_a_position_that_protobuf_did_not_set_is_unknown() -> None:
    unset, origin = PoseInFrame(frame_id="map"), PoseInFrame(frame_id="map")
    unset.pose.orientation.w = origin.pose.orientation.w = 1.0
    origin.pose.position.SetInParent()
    made = read("signals: {x: pose.position.x}, name: t", origin, unset, origin, name="foxglove.PoseInFrame")
    assert made.states("t") == "+?+"
    assert made.trace.signals["x"].tolist()[::2] == [0.0, 0.0]
    assert made.trace.signals["x"][1] != made.trace.signals["x"][1]
    assert "1 object did not set pose.position.x, " in made.remarks[0]


def test_an_optional_number_that_protobuf_did_not_set_is_unknown() -> None:
    contents = FieldDescriptorProto(number=0, label=1), FieldDescriptorProto(name="x")  # type: ignore[arg-type]
    made = read("signals: {number: number, label: label}", *contents)
    assert made.trace.signals["number"][0] == 0.0
    # the default of the enum is its first number, 1
    assert np.isnan([made.trace.signals[name] for name in ("number", "label")])[:, 1].all()


@pytest.mark.parametrize(
    ("changes", "states", "classes"),
    [
        ("remark", {"o1": "++++"}, {"o1": "walker, bike, bike, walker"}),
        ("first", {"o1": "++++"}, {"o1": "walker, walker, walker, walker"}),
        (
            "split",
            {"o1_bike": "-++-", "o1_walker": "+--+"},
            {"o1_bike": "bike, bike", "o1_walker": "walker, walker"},
        ),
    ],
)
def test_an_object_that_changes_its_class_is_one_or_two(
    changes: str, states: dict[str, str], classes: dict[str, str]
) -> None:
    contents = [
        {"objects": [{"id": 1, "label": label, "x": 0.0, "y": 0.0}]}
        for label in ("walker", "bike", "bike", "walker")
    ]
    keys = f"objects: 'objects[*]', name: 'o{{id}}', class: {{field: label, changes: {changes}}}"
    made = read(keys, *contents)
    assert {name: made.states(name) for name in made.trace.names} == states
    samples = list(made.trace)
    for name, listed in classes.items():
        assert ", ".join(str(s.objects[name].class_name) for s in samples if name in s.objects) == listed
    assert bool(made.remarks) == (changes == "remark")


def test_a_scale_beside_an_origin_is_that_of_degrees() -> None:
    content = {"lat": 520_000_000, "lon": 50_010_000, "radius": 2.0}
    keys = "position: [lat, lon], shape: {disc: radius}, scale: 1e-7"
    made = read(keys, content, mapping="origin: [52, 5]")
    (sample,) = made.trace
    assert made.centre(0, "t") == pytest.approx((68.7, 0.0), abs=0.1)
    assert sample.objects["t"].footprint.parts[0].radius == 2.0


def square(left: float, right: float) -> list[list[float]]:
    """Return a ring, closed as GeoJSON has it."""
    return [[left, left], [right, left], [right, right], [left, right], [left, left]]


RINGS = [square(0, 10), square(3, 7)]


def as_points(ring: list[list[float]]) -> dict[str, Any]:
    return {"points": [{"x": x, "y": y} for x, y in ring[:-1]]}


@pytest.mark.parametrize(
    ("keys", "fields"),
    [
        ("polygon: geometry.coordinates", {"geometry": {"type": "Polygon", "coordinates": RINGS}}),
        ("polygon: geometry", {"geometry": {"type": "MultiPolygon", "coordinates": [RINGS]}}),
        ("polygon: rings", {"rings": RINGS}),
        ("polygon: outer.points", {"outer": as_points(RINGS[0]), "inner": [as_points(RINGS[1])]}),
        ("shape: {polygon: area.outer}, position: at", {"area": {"outer": RINGS[0], "inner": [RINGS[1]]}}),
    ],
)
def test_polygons_keep_their_holes(keys: str, fields: dict[str, Any]) -> None:
    content = {"things": [{"id": "a", "at": {"x": 0, "y": 0}, **fields}]}
    (sample,) = read(f"objects: 'things[*]', name: '{{id}}', {keys}", content).trace
    zone, inside = sample.objects["a"].footprint, Footprint.box(4.8, 4.8, 5.2, 5.2)
    assert contact(zone, inside).distance == pytest.approx(1.8)
    assert contact(zone, Footprint.box(1, 1, 2, 2)).distance < 0


def test_geojson_of_foxglove_is_read_in_metres() -> None:
    def feature(name: str, kind: str, coordinates: Any) -> dict[str, Any]:
        geometry = {"type": kind, "coordinates": coordinates}
        return {"type": "Feature", "properties": {"name": name}, "geometry": geometry}

    corners = [[5.0, 52.0], [5.001, 52.0], [5.001, 52.001], [5.0, 52.001], [5.0, 52.0]]
    features = [feature("field", "Polygon", [corners]), feature("post", "Point", [5.0, 52.0])]
    content = {"geojson": json.dumps({"type": "FeatureCollection", "features": features})}
    with pytest.raises(UsageError, match="foxglove/GeoJSON holds degrees"):
        read("", content, name="foxglove.GeoJSON")
    made = read("", content, mapping="origin: [52, 5]", name="foxglove.GeoJSON")
    assert made.footprint_row(0, "field").max(axis=0) == pytest.approx((68.68, 111.27), abs=0.1)
    assert made.states("post") == "?"


LISTS = """
max_age: 1s
topics:
  /scene:
    - {objects: "cars[*]", name: "car{id}", position: [x, y], signals: {light: light}}
    - {objects: "walkers[*]", name: "walker{id}", position: at, class: person}
  /post: {name: post, position: at}
"""


def scenes() -> Feed:
    feed = Feed(types={"/scene": "a/Scene", "/post": "a/Post"}, counts={"/scene": 5, "/post": 1})
    feed.add("/post", 0, {"at": [0, 0]})
    for second in range(5):
        cars = [{"id": 1, "x": float(second), "y": 0.0}] * (second != 3)
        walkers = [{"id": 1, "at": [0.0, float(second)]}]
        feed.add("/scene", second * SECOND, {"cars": cars, "walkers": walkers, "light": second})
    return feed


def test_a_message_may_have_two_lists_of_objects() -> None:
    made = make(LISTS, scenes())
    assert [made.states(name) for name in ("car1", "walker1", "post")] == ["+++-+", "+++++", "++???"]
    assert (made.centre(2, "car1"), made.centre(2, "walker1")) == ((2.0, 0.0), (0.0, 2.0))
    assert made.trace.signals["light"].tolist() == [0, 1, 2, 3, 4]
    one_name = LISTS.replace("walker{id}", "car{id}")
    with pytest.raises(UsageError, match=r"both /scene and /scene\[1\] have an object 'car1'"):
        make(one_name, scenes())
    with pytest.raises(UsageError, match=r"test.yaml:6: topics./scene\[1\].positon: unknown key"):
        make(LISTS.replace("position: at, class", "positon: at, class"), scenes())


def test_two_lists_in_a_message_are_the_same_live_and_in_a_log() -> None:
    feed = scenes()
    plan = ReadingPlan.of(parse_mapping(LISTS), feed.topics())
    assembler = LiveAssembler(plan, feed.decoder, name="", max_delay_s=1.0)
    assert assembler.topics == ("/scene", "/post")
    traces = [assembler.add([message], message.log_time_ns / 1e9) for message in feed.raw()]
    trace = Trace.concatenate([*traces, assembler.flush()])
    assert trace == make(LISTS, feed).trace
    # silence makes the objects of both lists unknown
    lost = assembler.lose(["/scene"], 9.0)
    assert [int(lost.rows[-1, lost.names.index(name)]) < -1 for name in ("car1", "walker1")] == [True, True]


def test_numbers_and_frames_are_read_as_json_of_protobuf_has_them() -> None:
    contents = [{"x": "12", "y": y, "frameId": "map"} for y in (1, "NaN", "3.5")]
    made = read("", *contents, mapping="fixed_frame: map")
    assert (made.states("t"), made.centre(2, "t"), made.faults) == ("+?+", (12.0, 3.5), ())


def test_a_key_that_a_map_lacks_is_unknown() -> None:
    first, second = Struct(), Struct()
    first.update({"levels": {"tank 1": 0.5}})
    second.update({"levels": {"tank 2": 0.5}})
    made = read("signals: {level: levels.'tank 1'}", first, second)
    assert np.isnan(made.trace.signals["level"]).tolist() == [False, True]
    assert made.faults == ()


def test_a_topic_of_two_publishers_is_two_objects(tmp_path: Path) -> None:
    path = tmp_path / "merged.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200)
        writer.start("", "test")
        channels = [writer.register_channel("/odom", "json", 0) for _ in range(2)]
        for tick in range(20):
            x = 30.0 * (tick % 2) + 0.01 * tick
            content = json.dumps({"x": x, "y": 0.0}).encode()
            writer.add_message(channels[tick % 2], SECOND + tick * SECOND // 10, content, SECOND, tick)
        writer.finish()

    def log(entries: str) -> MappedSource:
        mapping = parse_mapping(f"topics: {{/odom: {entries}}}", "two.yaml")
        return MappedSource(path, mapping=mapping)

    part = "position: [x, y], shape: {disc: 0.3}"
    entries = f"[{{name: a, publisher: 1, {part}}}, {{name: b, publisher: 2, {part}}}]"
    blocks = list(log(entries).iter_blocks())
    *_, sample = Trace.concatenate([block.trace for block in blocks])
    assert sorted(sample.objects) == ["a", "b"]
    assert contact(*(sample.objects[name].footprint for name in "ab")).distance == pytest.approx(
        29.4, abs=0.1
    )
    assert [doubt for block in blocks for doubt in block.doubts] == []
    with pytest.raises(UsageError, match=r"publisher 3; the topic has 2 channels"):
        list(log(f"{{name: a, publisher: 3, {part}}}").iter_blocks())


def test_invalid_numbers_of_single_precision_are_found() -> None:
    pose = ros("turtlesim/Pose", x=float(np.float32(327.67)), y=0.0)
    assert read("invalid: [327.67]", pose, name="turtlesim/Pose").states("t") == "?"

"""Keys and paths of mapping files, for fields that their names alone do not explain."""

from __future__ import annotations

from typing import Any

import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.json_format import MessageToDict
from google.protobuf.struct_pb2 import Struct

from mapping.feeding import SECOND, Feed, Made, make
from spatial_replay import UsageError


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

"""Messages with arbitrary content: readable ones are read, the others are reported, nothing else is
raised."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from mapping.feeding import SECOND, Feed, make
from spatial_replay import LogError, UsageError

POINT = {"x": 1.0, "y": 2.0, "z": 0.0}
TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
POSE = {"position": POINT, "orientation": TURN}
HEADER = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "map"}
MARKER = {
    "header": HEADER,
    "ns": "cup",
    "id": 1,
    "type": 1,
    "action": 0,
    "pose": POSE,
    "scale": POINT,
    "lifetime": {"sec": 0, "nanosec": 0},
    "points": [POINT, POINT, POINT],
}
TRANSFORM = {
    "header": HEADER,
    "child_frame_id": "base",
    "transform": {"translation": POINT, "rotation": TURN},
}
ENTITY = {
    "id": "table",
    "frame_id": "map",
    "timestamp": {"sec": 1, "nsec": 0},
    "lifetime": {"sec": 0, "nsec": 0},
    "cubes": [{"pose": POSE, "size": POINT}],
    "cylinders": [{"pose": POSE, "size": POINT, "bottom_scale": 1, "top_scale": 0}],
    "triangles": [{"pose": POSE, "points": [POINT, POINT, POINT], "indices": [0, 1, 2]}],
}
PERCEIVED = {
    "header": HEADER,
    "id": 3,
    "pose": POSE,
    "polygon": {"points": [POINT, POINT, POINT]},
    "shape": {"type": 1, "dimensions": [1.0, 2.0, 3.0]},
    "classification": 6,
}
DETECTION = {
    "id": "7",
    "results": [{"hypothesis": {"class_id": "cup"}}],
    "bbox": {"center": {"position": POINT, "theta": 0.0}, "size_x": 1.0, "size_y": 2.0},
}
EXAMPLES: dict[str, Any] = {
    "geometry_msgs/msg/PoseStamped": {"header": HEADER, "pose": POSE},
    "nav_msgs/msg/Odometry": {"header": HEADER, "pose": {"pose": POSE, "covariance": [0.1] * 36}},
    "geometry_msgs/msg/PolygonStamped": {"header": HEADER, "polygon": {"points": [POINT, TURN, POINT]}},
    "visualization_msgs/msg/MarkerArray": {"markers": [MARKER, {**MARKER, "id": 2, "type": 6}]},
    "tf2_msgs/msg/TFMessage": {"transforms": [TRANSFORM]},
    "foxglove.SceneUpdate": {"entities": [ENTITY], "deletions": [{"type": 0, "id": "cup"}]},
    "derived_object_msgs/msg/ObjectArray": {"header": HEADER, "objects": [PERCEIVED]},
    "vision_msgs/msg/Detection2DArray": {"header": HEADER, "detections": [DETECTION]},
    "own/msg/List": {"header": HEADER, "list": [{"id": 1, "p": [0, 0, 1, 0, 1, 1]}]},
}
KEYS = {
    "nav_msgs/msg/Odometry": "uncertainty: covariance, signals: {sigma: 'pose.covariance[0]'}",
    "own/msg/List": "objects: 'list[*]', name: 'o{id}', polygon: p",
}

anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("xyzw"), inner, max_size=3),
    max_leaves=5,
)


def places(value: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return every place in a message."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [here, *(place for key, each in inner for place in places(each, (*here, key)))]


@st.composite
def damaged(draw: st.DrawFn, example: Any) -> Any:
    """Draw a message with one value replaced or removed."""
    place = draw(st.sampled_from(places(example)))
    if not place:
        return draw(anything)
    message = copy.deepcopy(example)
    parent = message
    for step in place[:-1]:
        parent = parent[step]
    if draw(st.booleans()):
        del parent[place[-1]]
    else:
        parent[place[-1]] = draw(anything)
    return message


@pytest.mark.parametrize("kind", EXAMPLES)
@pytest.mark.parametrize("head", ["", "fixed_frame: map\n", "clock: header\n"])
@examples(20)
@given(data=st.data())
def test_a_damaged_message_affects_no_other(kind: str, head: str, data: st.DataObject) -> None:
    example = EXAMPLES[kind]
    feed = Feed(types={"/a": kind})
    feed.add("/a", SECOND, example)
    feed.add("/a", SECOND + 1, data.draw(damaged(example)))
    feed.add("/a", SECOND + 2, example)
    try:
        made = make(f"{head}topics: {{/a: {{{KEYS.get(kind, '')}}}}}", feed)
    except LogError as error:
        # a stamp that lies far back
        assert "time jumps" in str(error)
        return
    except UsageError as error:
        assert "stamp" in str(error)
        return
    assert len(made.trace) >= 1
    assert all(fault.startswith("test.bag: /a at ") for fault in made.faults)


def test_a_lifetime_beyond_the_times_of_a_log_is_reported() -> None:
    marker = {**MARKER, "lifetime": {"sec": 2**63 // 10**9 + 1, "nanosec": 0}}
    kind = "visualization_msgs/msg/Marker"
    log = make("topics: {/a: {}}", Feed(types={"/a": kind}).add("/a", 0, marker).add("/a", 1, MARKER))
    assert "outside the times of a log" in " ".join(log.faults)
    assert log.trace.names == ("cup_1",)


@pytest.mark.parametrize("kind", EXAMPLES)
@examples(20)
@given(data=st.data())
def test_a_damaged_first_message_is_reported(kind: str, data: st.DataObject) -> None:
    feed = (
        Feed(types={"/a": kind}).add("/a", 0, data.draw(damaged(EXAMPLES[kind]))).add("/a", 1, EXAMPLES[kind])
    )
    try:
        make(f"topics: {{/a: {{{KEYS.get(kind, '')}}}}}", feed)
    except UsageError as error:
        assert str(error).startswith("test.yaml: ")

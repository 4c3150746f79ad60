"""Suggested mappings are accepted by a replay, for messages of every make."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from mapping.feeding import Feed, make
from spatial_replay.mapping.mapping_file import NO_TOPIC
from spatial_replay.mapping.suggest import suggest_mapping

numbers = st.one_of(st.floats(-200, 200, allow_subnormal=False), st.integers(-3, 600), st.just(0))
names = st.sampled_from(["a", "b", "", "cup 1"])
points = st.fixed_dictionaries({"x": numbers, "y": numbers}, optional={"z": numbers, "theta": numbers})
turns = st.fixed_dictionaries({axis: st.floats(-1, 1) for axis in "xyzw"})
FIELDS: dict[str, st.SearchStrategy[Any]] = {
    **dict.fromkeys(("x", "y", "z", "yaw", "heading", "latitude", "longitude", "radius", "w"), numbers),
    **dict.fromkeys(("length", "width", "xmin", "ymin", "xmax", "ymax", "id", "seq"), numbers),
    **dict.fromkeys(("name", "frame_id", "child_frame_id", "class", "label", "level_name"), names),
    **dict.fromkeys(("position", "center", "agvPosition", "size", "dimensions", "velocity"), points),
    "bbox": st.lists(numbers, min_size=3, max_size=4),
    "q": st.lists(st.floats(-1, 1), min_size=4, max_size=4),
    "uuid": st.lists(st.integers(0, 255), min_size=16, max_size=16),
    "orientation": turns,
    "polygon": st.lists(points, max_size=5),
    "header": st.fixed_dictionaries({"frame_id": names}, optional={"stamp": st.integers(0, 10**10)}),
    "pose": st.fixed_dictionaries({"position": points}, optional={"orientation": turns}),
    "status": st.none(),
}
things = st.dictionaries(st.sampled_from(sorted(FIELDS)), st.none(), min_size=1, max_size=8).flatmap(
    lambda keys: st.fixed_dictionaries({key: FIELDS[key] for key in keys})
)
messages = things | st.dictionaries(
    st.sampled_from(["objects", "tracks", "poses", "waypoints", "name", "header", "polygons"]),
    st.lists(things, max_size=3) | names | st.dictionaries(names, things, max_size=3),
    min_size=1,
    max_size=3,
)
topics = st.tuples(
    st.sampled_from(["own/msg/A", "nav_msgs/msg/Path", "px4_msgs/msg/B", "geometry_msgs/msg/PoseStamped"]),
    messages.flatmap(lambda message: st.lists(st.just(message) | messages, min_size=1, max_size=4)),
)


@given(st.lists(topics, min_size=1, max_size=3))
def test_a_replay_accepts_each_suggested_mapping(log: list[tuple[str, list[Any]]]) -> None:
    feed = Feed()
    for number, (kind, contents) in enumerate(log):
        feed.types[f"/t{number}"] = kind
        for time_ns, content in enumerate(contents):
            feed.add(f"/t{number}", 10**9 * (1 + time_ns), content)
    feed.messages.sort(key=lambda message: message[1])
    examples = {
        name: [content for topic, _, content in feed.messages if topic == name] for name in feed.types
    }
    text = suggest_mapping("run", feed.topics(), examples)
    if f"# {NO_TOPIC}" not in text:
        assert len(make(text, feed).trace)

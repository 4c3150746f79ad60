"""Field paths and name templates on messages of every encoding."""

from __future__ import annotations

from typing import Any

import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.struct_pb2 import Struct

from mapping.feeding import pose_stamped, tf, transform
from spatial_replay import UsageError
from spatial_replay.mapping.binding import Codes, Namer
from spatial_replay.mapping.field_paths import (
    FieldError,
    FieldPath,
    NameTemplate,
    field_names,
    getter,
    iter_elements,
    name_from_topic,
    tuple_getter,
    walk,
)


def scene() -> SceneUpdate:
    update = SceneUpdate()
    for name in ("cup", "plate"):
        update.entities.add(id=name).cubes.add().size.x = 2.0
    return update


def struct() -> Struct:
    message = Struct()
    message.update({"robot": {"battery": {"levels": [1, 0.5], "level": None}}})
    return message


MESSAGES: list[tuple[Any, str, Any]] = [
    (pose_stamped(1.0, 2.0), "pose.position.y", 2.0),
    (tf(transform("map", "base", (1, 2, 3))), "transforms[0].child_frame_id", "base"),
    (scene(), "entities[1].cubes[0].size.x", 2.0),
    ({"a": [{"b-c": [1, 2]}]}, "a[0].b-c[1]", 2),
    ({"a": [{"b": 1}, {"b": 2}]}, "a[-1].b", 2),
    ({"pose.x": 1, "größe": {"in m": 2}}, "'pose.x'", 1),
    ({"pose.x": 1, "größe": {"in m": 2}}, "'größe'.'in m'", 2),
    ({"a": [{"id": 7, "x": 1}, {"id": 8, "x": 2}, {"id": 7, "x": 3}]}, "a[id=7].x", 3),
    ({"a": [{"id": {"value": 7.0}, "x": 1}]}, "a[id.value=7].x", 1),
    ({"a": [{"id": 7}]}, "a[id=8].x", None),
    (scene(), "entities[id=plate].cubes[-1].size.x", 2.0),
    (struct(), "robot.battery.level", None),
    (struct(), "robot.battery.levels[1]", 0.5),
]


@pytest.mark.parametrize(("message", "text", "value"), MESSAGES)
def test_a_path_leads_to_its_value_in_every_encoding(message: Any, text: str, value: Any) -> None:
    path = FieldPath.of(text)
    assert walk(path, message) == value
    assert getter(path, message)(message) == value
    assert tuple_getter([path, path], message)(message) == (value, value)


def test_a_path_iterates_over_nested_lists() -> None:
    message = {"rows": [{"cells": [1, 2]}, {"cells": []}, {"cells": [3]}]}
    assert list(iter_elements(FieldPath.of("rows[*].cells[*]"), message)) == [1, 2, 3]
    entities = iter_elements(FieldPath.of("entities[*]"), scene())
    assert [walk(FieldPath.of("id"), entity) for entity in entities] == ["cup", "plate"]


@pytest.mark.parametrize(
    ("message", "text", "what"),
    [
        (
            pose_stamped(0, 0),
            "pose.positon",
            "geometry_msgs/msg/Pose has no field 'positon'; did you mean 'position'",
        ),
        (pose_stamped(0, 0), "header.frame_id.x", "a text has no field 'x'"),
        (scene(), "entitys", "foxglove.SceneUpdate has no field 'entitys'; did you mean 'entities'"),
        (scene(), "entities[7]", r"\[7\] is out of range, there are 2 elements"),
        (scene(), "entities[0].id[0]", "needs a list, got a text"),
        ({"a": 1}, "b", "the JSON object has no field 'b'; its fields are a"),
        ({"a": None}, "a.b", "nothing has no field 'b'"),
        # what every object has in Python is no field
        (pose_stamped(0, 0), "__class__", "has no field '__class__'"),
        (scene(), "SerializeToString", "has no field 'SerializeToString'"),
        ({"a": 1}, "keys", "has no field 'keys'"),
    ],
)
def test_a_path_that_leads_nowhere_lists_the_existing_fields(message: Any, text: str, what: str) -> None:
    with pytest.raises(FieldError, match=what):
        walk(FieldPath.of(text), message)


@pytest.mark.parametrize("text", ["", "a..b", ".a", "a.", "a[", "a[x]", "1a", "a b", "a()", "$a", "a.$.b"])
def test_an_invalid_path_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is not a field path"):
        FieldPath.of(text)


def test_the_fields_of_a_message_are_listed_in_every_encoding() -> None:
    assert field_names(pose_stamped(0, 0)) == ("header", "pose")
    assert field_names(scene()) == ("deletions", "entities")
    assert field_names({"a": 1, "b": 2}) == ("a", "b")
    assert field_names([1]) == field_names("x") == field_names(None) == ()


def test_the_best_of_some_results_has_the_highest_score() -> None:
    path = FieldPath.of("results[best].id")

    def best(*results: dict[str, Any]) -> object:
        message = {"results": list(results)}
        assert walk(path, message) == getter(path, message)(message)
        return walk(path, message)

    assert best({"id": 1, "score": 0.2}, {"id": 2, "score": 0.9}, {"id": 3, "score": 0.9}) == 2
    assert best({"id": 1, "hypothesis": {"score": 0.2}}, {"id": 2, "hypothesis": {"score": 0.9}}) == 2
    assert best({"id": 1, "probability": float("nan")}, {"id": 2, "probability": 0.0}) == 2
    assert best({"id": 1}, {"id": 2}) == 1
    with pytest.raises(FieldError, match="out of range"):
        walk(path, {"results": []})


def names(template: str, *things: dict[str, Any], topic: str = "/a/pose") -> list[str]:
    codes = Codes()
    namer = Namer(NameTemplate.of(template), topic, codes, (), ())
    found = namer.codes(things, range(len(things)))
    texts = list(codes)
    return [texts[code] for code in found]


def test_a_template_makes_names() -> None:
    assert names("robot", {}, {}) == ["robot", "robot"]
    assert names("tag{id}", {"id": 3}, {"id": 4}, {"id": 3}) == ["tag3", "tag4", "tag3"]
    assert names("{ns}_{id}", {"ns": "cup", "id": 1.0}) == ["cup_1"]
    assert names("{ns|topic}_{id|index}", {"ns": "", "id": ""}, {"id": 7}) == ["a_0", "a_7"]
    assert names("{index}", {"index": 9}) == ["9"]
    assert names("{a.b[0]}", {"a": {"b": ["x"]}}) == ["x"]
    assert names("tag{id}", {"id": [3]}, {"id": [4, 5]}) == ["tag3", "tag4_5"]
    identity = bytes([0xAB, *range(15)])
    for each in (identity, list(identity), {"uuid": identity}):
        assert names("{id}", {"id": each}) == ["ab000102030405060708090a0b0c0d0e"]
    # the UUID of zeros is none
    assert names("{id|index}", {"id": bytes(16)}) == ["0"]


@pytest.mark.parametrize(
    ("template", "thing"),
    [
        ("{id}", {"id": ""}),
        ("{id}", {}),
        ("{id}", {"id": []}),
        ("{id}", {"id": "a\nb"}),
        ("{id}", {"id": "x" * 999}),
    ],
)
def test_an_unusable_name_is_an_error(template: str, thing: dict[str, Any]) -> None:
    with pytest.raises(FieldError):
        names(template, thing)


@pytest.mark.parametrize("text", ["{", "}", "a{b", "{}", "{a b}", "{a|}", ""])
def test_an_invalid_template_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is not a name"):
        NameTemplate.of(text)


def test_objects_are_named_after_topics() -> None:
    found = [name_from_topic(topic) for topic in ("/turtle1/pose", "/pose", "/a/b/scan", "/", "/robot/odom")]
    assert found == ["turtle1", "pose", "a_b_scan", "object", "robot"]

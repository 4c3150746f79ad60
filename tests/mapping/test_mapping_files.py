"""Mapping files: their content, and all their errors reported together."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from mapping.feeding import Feed, make, pose_stamped
from spatial_replay import MissingFileError, UsageError
from spatial_replay.bags.decoders import Topic
from spatial_replay.mapping.mapping_file import (
    FOREVER_NS,
    Sampling,
    ShapeMapping,
    SignalMapping,
    Uncertainty,
    load_mapping,
    parse_mapping,
)
from spatial_replay.mapping.reading_plan import ReadingPlan

EXAMPLE = """
fixed_frame: world
clock: header
sample: {every: 100ms}
max_age: 1.5s
topics:
  /turtle1/pose: {name: turtle1, shape: {disc: 0.5}}
  /tags: {objects: "detections[*]", name: "tag{id}", polygon: corners, class: tag}
  /odom: {shape: robot, uncertainty: covariance, height: [0, 0.4], max_age: forever}
  /battery: {signals: {battery: {field: percentage, unit: "1"}}}
  /plain:
shapes:
  robot: {box: [0.6, 0.4], offset: [0.1, 0]}
"""


def test_a_mapping_file_is_parsed_to_values() -> None:
    mapping = parse_mapping(EXAMPLE)
    turtle, tags, odom, battery, plain = mapping.topics
    assert (mapping.fixed_frame, mapping.clock, mapping.max_age_ns) == ("world", "header", 1_500_000_000)
    assert mapping.sampling == Sampling(None, 100_000_000)
    assert (turtle.name, turtle.shape) == ("turtle1", ShapeMapping("disc", (0.5,)))
    assert (tags.objects, tags.name, tags.polygon, tags.class_name) == (
        "detections[*]",
        "tag{id}",
        "corners",
        "tag",
    )
    assert odom.shape == ShapeMapping("box", (0.6, 0.4), offset=(0.1, 0.0))
    assert (odom.uncertainty, odom.height) == (Uncertainty("", True), (0.0, 0.4))
    assert odom.max_age_ns == FOREVER_NS
    assert (battery.signals, battery.reads_objects) == ((SignalMapping("battery", "percentage", "1"),), False)
    assert plain.reads_objects


def test_the_hash_ignores_layout_and_comments() -> None:
    one = parse_mapping("topics:\n  /a:\n    name: x  # a comment\n", "one.yaml")
    other = parse_mapping('{"topics": {"/a": {"name": "x"}}}', "other.yaml")
    different = parse_mapping("topics: {/a: {name: y}}")
    assert one.sha256 == other.sha256 != different.sha256


@pytest.mark.parametrize("word", ["no", "on", "12:30", "2020-01-01", "0x10", "1_000"])
def test_plain_words_stay_texts(word: str) -> None:
    (topic,) = parse_mapping(f"topics: {{/a: {{name: {word}}}}}").topics
    assert topic.name == word


def test_every_error_is_reported_with_its_line_and_what_belongs_there() -> None:
    text = """
fixed_fram: world
clock: logs
sample: {every: 0ms}
max_age: 5
topics:
  /a: {shape: {dics: 0.5}, nam: x}
  /b: {objects: "detections[*", name: "tag{id", class: {fild: x}}
  /c: {shape: robt, uncertainty: -1, position: [x]}
  /d: {signals: {battery: {field: percentage, unit: 1}}, yaw: a, orientation: b, polygon: a..b}
shapes:
  robot: {box: [0.6, -0.4], offset: [0.1]}
"""
    with pytest.raises(UsageError) as caught:
        parse_mapping(text, "drive.yaml")
    errors = str(caught.value).splitlines()
    for line in (
        "drive.yaml:2: fixed_fram: unknown key; did you mean 'fixed_frame'?",
        "drive.yaml:3: clock: expected one of log, publish, header; got \"logs\"; did you mean 'log'?",
        "drive.yaml:4: sample.every: '0ms' is not a time; give a duration above 0",
        "drive.yaml:5: max_age: expected a duration above 0 such as 500ms, or forever; got 5",
        "drive.yaml:7: topics./a.nam: unknown key; did you mean 'name'?",
        "drive.yaml:7: topics./a.shape.dics: unknown key; did you mean 'disc'?",
        "drive.yaml:8: topics./b.class.fild: unknown key; did you mean 'field'?",
        "drive.yaml:9: topics./c.shape: there is no shape 'robt'; did you mean 'robot'?",
        'drive.yaml:10: topics./d.polygon: expected a field path such as pose.position.x; got "a..b"',
        "drive.yaml:10: topics./d.yaw: there is 'orientation' already; give one of the two",
        'drive.yaml:10: topics./d.signals.battery.unit: expected a unit as text, such as "m/s" or "1"; got 1',
        "drive.yaml:12: shapes.robot.offset: expected two numbers [x, y]; got [0.1]",
    ):
        assert line in errors
    assert any("topics./b.objects" in line for line in errors)
    assert any("topics./b.name" in line for line in errors)
    assert any("topics./c.uncertainty" in line for line in errors)
    assert any("topics./c.position" in line for line in errors)
    assert any("shapes.robot.box[1]" in line for line in errors)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("topics: {/a: {}, /a: {}}", "the key '/a' appears twice; the first is in line 1"),
        ("a: &x [1]\nb: *x", "m.yaml:2: \\*x repeats another part"),
        (
            "topics: !!python/object:os.system {}",
            "the tag tag:yaml.org,2002:python/object:os.sys",
        ),
        ('topics: {/a: {class: "\\ud800"}}', "holds half a character"),
        ("topics: !own {}", "the tag !own means nothing"),
        ("[" * 5000, "nested more than 20 deep"),
        ("topics: [1", "this is not YAML"),
        ("a: \x00", "this is not YAML"),
        ("", "got null"),
        ("topics: {}", "topics"),
        (
            "topics: {/a: {shape: {disc: .nan}}}",
            r"shape.disc: .nan is no finite number; give one, such as 0.5",
        ),
        ("topics: {/a: {shape: {box: [.inf, 1]}}}", r"shape.box.0.: .inf is no finite number"),
        ("topics: {/a: {shape: {disc: 1, offset: [0, .NaN]}}}", "offset.1.: .NaN is no finite number"),
        ("topics: {/a: {height: [0, .nan]}}", "height.1.: .nan is no finite number"),
        ("topics: {/a: {uncertainty: .nan}}", "uncertainty: .nan is no finite number"),
        ("scale: .nan", "scale: .nan is no finite number"),
        ("scale: 1e999", "scale: 1e999 is no finite number"),
        ("topics: {'': {}}", "a name is empty"),
        ("? [a, b]\n: c", "a key is a list or a mapping"),
        ("topics: {/a: {name: '{a b}'}}", "is not a name"),
        ("x" * 300_000, "larger than 256 KiB"),
        ("a: 1\n---\nb: 2", "this is not YAML"),
    ],
)
def test_an_invalid_mapping_is_refused(text: str, what: str) -> None:
    with pytest.raises(UsageError, match=what):
        parse_mapping(text, "m.yaml")


def test_an_unreadable_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no such file"):
        load_mapping(tmp_path / "missing.yaml")
    with pytest.raises(UsageError, match=r"a\.spatial is a specification, not a mapping; give it by --spec"):
        load_mapping(tmp_path / "a.spatial")
    (tmp_path / "latin.yaml").write_bytes(b"topics:\n  /\xe4: {}\n")
    with pytest.raises(UsageError, match=r"latin.yaml:2: a byte is not UTF-8"):
        load_mapping(tmp_path / "latin.yaml")
    (tmp_path / "good.yaml").write_text("\ufefftopics: {/a: }\n", encoding="utf-8")
    assert load_mapping(tmp_path / "good.yaml").topics[0].topic == "/a"


def test_the_published_schema_is_the_one_in_use() -> None:
    used = files("spatial_replay.mapping").joinpath("mapping.schema.json").read_text(encoding="utf-8")
    Draft202012Validator.check_schema(json.loads(used))
    published = Path(__file__).parents[2] / "schemas" / "mapping.schema.json"
    assert published.read_text(encoding="utf-8") == used


def test_topics_missing_from_the_log_are_reported_with_a_hint() -> None:
    mapping = parse_mapping(
        "sample: {topic: /tick}\ntopics: {/pse: {}, /scan: {}, /other: {type: foo/Bar}}", "m.yaml"
    )
    with pytest.raises(UsageError) as caught:
        ReadingPlan.of(
            mapping, [Topic("/pose", "geometry_msgs/msg/PoseStamped", "cdr"), Topic("/other", "", "cdr")]
        )
    assert str(caught.value).splitlines() == [
        "m.yaml: topics./pse: the log has no topic '/pse'; did you mean '/pose'?",
        "m.yaml: topics./scan: the log has no topic '/scan'; its topics are /other, /pose; where only some "
        "logs have it, add `optional: true`",
        "m.yaml: sample.topic: the log has no topic '/tick'; its topics are /other, /pose",
        *[line for line in str(caught.value).splitlines() if "'foo/Bar' is not a known type" in line],
    ]


def test_a_mapped_topic_that_cannot_be_decoded_is_refused() -> None:
    broken = Topic("/pose", "geometry_msgs/msg/PoseStamped", "cdr", unreadable="its definition is missing")
    with pytest.raises(UsageError, match="its messages cannot be decoded: its definition is miss"):
        ReadingPlan.of(parse_mapping("topics: {/pose: {}}"), [broken])


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        (
            "position: pose.positon",
            "has no field 'positon'; did you mean 'position'[?]; its fields are posi",
        ),
        ("position: header.stamp", "has no x and y; its fields are sec, nanosec"),
        ("yaw: pose", "expected a number, got geometry_msgs/msg/Pose"),
        ("orientation: pose.position", "has no x and y|not a quaternion"),
        ("polygon: pose", "expected a list of corners, got geometry_msgs/msg/Pose"),
        ("objects: 'poses[*]'", "has no field 'poses'"),
        ("objects: 'header[*]'", r"\[\*\] needs a list, got std_msgs/msg/Header"),
        ("name: 'x{id}'", "has no field 'id'"),
        ("class: {field: kind}", "has no field 'kind'"),
        ("shape: {disc: size}", "has no field 'size'"),
        ("uncertainty: {covariance: pose}", "expected a covariance"),
        ("name: p, signals: {speed: speed}", "has no field 'speed'"),
        ("name: p, signals: {speed: header.stamp}", "its value is neither a number nor a text"),
        ("yaw: $.header.stamp.sec", "give a field of the object"),
    ],
)
def test_a_path_that_leads_nowhere_is_reported_with_the_existing_fields(keys: str, what: str) -> None:
    feed = Feed().add("/p", 0, pose_stamped(0, 0))
    with pytest.raises(UsageError, match=rf"test.yaml: topics./p: .*({what})"):
        make(f"topics: {{/p: {{{keys}}}}}", feed)


def test_two_topics_with_an_object_of_one_name_are_refused() -> None:
    feed = Feed().add("/a", 0, pose_stamped(0, 0)).add("/b", 0, pose_stamped(0, 0))
    with pytest.raises(UsageError, match="both /a and /b have an object 'cup'; give one of them"):
        make("topics: {/a: {name: cup}, /b: {name: cup}}", feed)


def test_a_topic_can_be_read_as_a_built_in_type() -> None:
    feed = Feed().add("/p", 0, {"pose": {"position": {"x": 1.0, "y": 2.0, "z": 0.0}}, "header": {}})
    with pytest.raises(UsageError, match="has no field 'orientation'"):
        make("topics: {/p: {type: geometry_msgs/PoseStamped}}", feed)
    assert make("topics: {/p: {}}", feed).centre(0, "p") == (1.0, 2.0)


def test_a_signal_has_a_unit_or_names_that_differ() -> None:
    def fault(keys: str) -> str:
        with pytest.raises(UsageError) as raised:
            parse_mapping(f"topics: {{/m: {{signals: {{mode: {{field: m, {keys}}}}}}}}}")
        return str(raised.value)

    assert "two numbers are called 'AUTO'; give each its own name" in fault("names: {1: AUTO, 2: AUTO}")
    assert "with unit: TEXT or names: {NUMBER: NAME}" in fault("unit: m, names: {1: AUTO}")
    assert 'expected a number; got "one"' in fault("names: {AUTO: one}")

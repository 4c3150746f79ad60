"""Logs that others recorded, from end to end: as they are, annotated, and replayed again."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from mcap.writer import Writer

from annotate.layouts import layout_of
from bags.bag_files import SECOND, write_json_mcap
from spatial_replay import read_trace
from spatial_replay.cli import run
from spatial_replay.logs.schemas.Robustness_pb2 import StandingUpdate
from spatial_replay.logs.schemas.Specification_pb2 import Specification
from spatial_replay.logs.topics import EVENT_LOG, EVENTS, OBJECTS, SCENE, STANDING, protobuf_channel

TURTLES = """\
sample: {topic: /turtle2/pose}    # the later of the two: no sample without the other
topics:
  /turtle1/pose: {shape: {disc: 0.5}}
  /turtle2/pose: {shape: {disc: 0.5}}
"""
SPECIFICATION = """\
spec meet = F (turtle1 ovlp turtle2)
spec near = G (turtle1 dist turtle2 <= 2.9)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a mapping and a specification."""
    (tmp_path / "turtles.yaml").write_text(TURTLES)
    (tmp_path / "turtles.spatial").write_text(SPECIFICATION)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def replayed(capsys: pytest.CaptureFixture[str], log: Path, *more: str, code: int = 0) -> Any:
    """What a replay of a log prints as JSON, with every number of every node."""
    capsys.readouterr()
    arguments = ["replay", str(log), "--spec", "turtles.spatial", "--json", "-", "--series", *more]
    assert run(arguments) == code
    return json.loads(capsys.readouterr().out)


def test_a_bag_is_replayed_annotated_and_replayed_again(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = data_folder / "bags" / "two_turtles.bag"
    first = replayed(capsys, bag, "--mapping", "turtles.yaml", "-o", "annotated.mcap")
    again = replayed(capsys, folder / "annotated.mcap")
    assert first["specifications"] == again["specifications"]
    assert first["certificate"]["samples_sha256"] == again["certificate"]["samples_sha256"]
    meet, near = first["specifications"]
    # the discs touch when their centres are 1 apart
    assert meet["robustness"] == pytest.approx(1 - 0.0721, abs=1e-4)
    assert near["robustness"] == pytest.approx(2.9 + 1 - 3.8663, abs=1e-4)
    assert run(["info", "annotated.mcap", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["topics"]
    topics = {each["topic"]: each for each in listed}
    assert topics["/turtle1/pose"]["messages"] == 1344
    assert topics["/turtle1/pose"]["encoding"] == "ros1"
    assert topics["/spatial/objects"]["messages"] == first["log"]["samples"]
    # what is not mapped is kept too, here of several publishers with a channel each
    assert sum(each["messages"] for each in listed if each["topic"] == "/rosout") == 10


def test_four_containers_of_one_recording_give_one_verdict(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    containers = ("two_turtles.bag", "two_turtles_lz4.bag", "two_turtles_mcap", "two_turtles_sqlite3")
    found = [
        replayed(capsys, data_folder / "bags" / each, "--mapping", "turtles.yaml") for each in containers
    ]
    for each in found[1:]:
        assert each["specifications"] == found[0]["specifications"]
        assert each["certificate"]["samples_sha256"] == found[0]["certificate"]["samples_sha256"]


def test_a_bag_is_recorded_as_a_log(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = str(data_folder / "bags" / "two_turtles_lz4.bag")
    assert run(["record", "tracks", bag, "--mapping", "turtles.yaml", "-o", "run.mcap"]) == 0
    direct = replayed(capsys, Path(bag), "--mapping", "turtles.yaml")
    assert replayed(capsys, folder / "run.mcap")["specifications"] == direct["specifications"]


def test_names_are_compared_with_those_of_the_mapping(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = str(data_folder / "bags" / "two_turtles_lz4.bag")
    assert run(["check", "turtles.spatial", "--log", bag, "--mapping", "turtles.yaml"]) == 0
    (folder / "other.spatial").write_text("F (turtle1 ovlp turtle3)")
    assert run(["check", "other.spatial", "--log", bag, "--mapping", "turtles.yaml", "--strict-names"]) == 2
    assert "turtle2" in capsys.readouterr().err
    assert run(["check", "turtles.spatial", "--mapping", "turtles.yaml"]) == 2


def test_a_mapping_is_required_checked_and_never_overwritten(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = str(data_folder / "bags" / "two_turtles_lz4.bag")
    replay = ["replay", bag, "--spec", "turtles.spatial"]
    assert run(replay) == 2
    assert "--mapping" in capsys.readouterr().err
    assert run([*replay, "--mapping", "absent.yaml"]) == 2
    assert "absent.yaml: no such file" in capsys.readouterr().err
    (folder / "wrong.yaml").write_text("topics:\n  /turtle1/pose: {shape: {disk: 0.5}}\n")
    assert run([*replay, "--mapping", "wrong.yaml"]) == 2
    assert "wrong.yaml:2" in capsys.readouterr().err
    assert run([*replay, "--mapping", "turtles.yaml", "-o", "turtles.yaml"]) == 2
    assert (folder / "turtles.yaml").read_text() == TURTLES


def test_drone_annotations_are_replayed(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = data_folder / "sdd" / "quad_video1_annotations.txt"
    (folder / "turtles.spatial").write_text(
        "use spatial_spec\ngroup anyone = all\nspec apart(ego) = G (ego dist (anyone except ego) >= 15)\n"
    )
    each = ("--each", "ego=class:biker", "--to", "2s")
    dropped = replayed(capsys, log, *each, "--semantics", "paper")
    kept = replayed(capsys, log, *each, "--semantics", "paper", "--read", "lost=keep", "--read", "rate=60")
    assert dropped["log"]["samples"] == 60
    assert kept["log"]["samples"] == 120
    assert len(kept["specifications"]) > len(dropped["specifications"]) > 0
    assert run(["replay", str(log), "--spec", "turtles.spatial", "--mapping", "turtles.yaml"]) == 2
    assert "--mapping turtles.yaml (mapping='turtles.yaml') does not apply to" in capsys.readouterr().err


def test_messages_of_others_on_our_topics_stay_in_every_copy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Topics below /spatial with another encoding than ours, and with the same type."""
    log, mapping, copy = tmp_path / "drive.mcap", tmp_path / "m.yaml", tmp_path / "copy.mcap"
    scene = protobuf_channel(SCENE, SceneUpdate)
    assert scene.schema is not None
    with log.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(scene.schema.name, "protobuf", scene.schema.data)
        channels = {topic: writer.register_channel(topic, "json", 0) for topic in (OBJECTS, EVENT_LOG, "/x")}
        channels[SCENE] = writer.register_channel(SCENE, "protobuf", schema)
        for n in range(5):
            for topic, channel in channels.items():
                payload = b"" if topic == SCENE else json.dumps({"x": n, "y": 0}).encode()
                writer.add_message(channel, n * 10**8, payload, n * 10**8)
        writer.finish()
    mapping.write_text("topics:\n  /spatial/objects: {name: cart, position: [x, y], shape: {disc: 0.2}}\n")
    specification = "region w = box(9, 0, 10, 1)\nspec clear = G (cart dist w >= 0.5)"
    assert run(["replay", str(log), "--mapping", str(mapping), "--spec", specification, "-o", str(copy)]) == 0
    warnings = capsys.readouterr().err
    for topic in (OBJECTS, EVENT_LOG, SCENE):
        assert f"on {topic} on /original{topic}" in warnings
    again = tmp_path / "again.mcap"
    assert run(["replay", str(copy), "--spec", specification, "-o", str(again)]) == 0
    for path in (copy, again):
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None and summary.statistics is not None
        counts = summary.statistics.channel_message_counts
        originals = {
            channel.topic: counts[number]
            for number, channel in summary.channels.items()
            if channel.topic.startswith("/original")
        }
        assert originals == {f"/original{topic}": 5 for topic in (OBJECTS, EVENT_LOG, SCENE)}


def test_a_commonroad_scenario_is_replayed(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = data_folder / "commonroad" / "ZAM_Tutorial-1_2_T-1.xml"
    (folder / "turtles.spatial").write_text(
        'spec ahead = G ("42" leftof "44")\nspec clear = G not ("42" ovlp "43")\n'
    )
    first = replayed(capsys, log, "-o", "annotated.mcap")
    assert first["log"]["samples"] == 41
    assert replayed(capsys, folder / "annotated.mcap")["specifications"] == first["specifications"]


def test_stale_observations_are_unknown_and_reported_but_not_damage(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "turtles.yaml").write_text("max_age: 1ns\n" + TURTLES)
    bag = data_folder / "bags" / "two_turtles_lz4.bag"
    arguments = ["replay", str(bag), "--spec", "turtles.spatial", "--mapping", "turtles.yaml", "--json", "-"]
    assert run(arguments) == 4
    said = capsys.readouterr()
    document = json.loads(said.out)["log"]
    assert document["damaged"] is False
    assert document["unreadable_observations"] == 1344
    (remark,) = document["remarks"]
    assert "turtle1" in remark
    assert remark in said.err
    assert read_trace(bag, mapping="turtles.yaml").remarks == (remark,)
    record = ["record", "tracks", str(bag), "--mapping", "turtles.yaml", "-o", "run.mcap"]
    assert run(record) == 0
    assert remark in capsys.readouterr().err
    assert run(["info", str(bag), "--mapping", "turtles.yaml"]) == 0
    said = capsys.readouterr()
    assert remark in said.err
    assert "1,344 unknown" in said.out
    assert run(["batch", *arguments[1:6]]) == 4
    # the log is named once
    assert f"warning: {remark.removeprefix(f'{bag.name}: ')} (in {bag})" in capsys.readouterr().err


def test_a_clock_that_jumps_back_is_an_error_or_ends_the_log(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (folder / "jump.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("any.Pose", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/pose", "json", schema)
        # the simulation restarts, and its stamps with it, while recording continues
        for number, seconds in enumerate([*range(1, 11), *range(1, 6)]):
            data = json.dumps({"stamp": seconds * 10**9, "x": float(number), "y": 0.0}).encode()
            writer.add_message(channel, number * 10**9, data, number * 10**9)
        writer.finish()
    (folder / "turtles.yaml").write_text(
        "clock: header\ntopics:\n  /pose: {name: robot, stamp: stamp, shape: {disc: 0.5}}\n"
    )
    (folder / "turtles.spatial").write_text(
        "region start = box(-1, -1, 1, 1)\nspec leaves = F (robot farfrom[8] start)\n"
    )
    arguments = ["replay", "jump.mcap", "--spec", "turtles.spatial", "--mapping", "turtles.yaml"]
    assert run(arguments) == 3
    assert "--read on_time_jump" in capsys.readouterr().err
    assert run([*arguments, "--read", "on_time_jump=split", "--json", "-"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["log"]["samples"] == 10
    assert "the log is taken to end there" in said.err


def test_a_declared_unit_of_lengths_is_at_axes_in_tables_in_sentences_and_in_what_is_made_of_the_log(
    data_folder: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "metres.yaml").write_text("unit: m\n" + TURTLES)
    described = "/spatial/specification"
    bag, spec = str(data_folder / "bags" / "two_turtles.bag"), ["--spec", "turtles.spatial"]
    run(["replay", bag, *spec, "--mapping", "metres.yaml", "--to", "2s", "-o", "annotated.mcap"])
    run(["replay", "annotated.mcap", *spec, "-o", "again.mcap"])
    for log in ("annotated.mcap", "again.mcap"):
        panels = layout_of(folder / log)["configById"]
        assert panels["Plot!robustness"]["yAxisLabel"] == "m"
        assert panels["3D!scene"]["lichtblickPanelTitle"] == "Scene, y up; lengths in m"
        with (folder / log).open("rb") as stream:
            messages = [
                (channel.topic, message.data) for _, channel, message in make_reader(stream).iter_messages()
            ]
        standing = [StandingUpdate.FromString(data) for topic, data in messages if topic == STANDING]
        assert {each.unit for message in standing for each in message.results} == {"m"}
        events = [Event.FromString(data) for topic, data in messages if topic == EVENTS]
        [end] = [each.metadata for each in events if "`meet` is violated" in each.metadata[-1].value]
        assert "`turtle1 ovlp turtle2` failed by 1.514 m" in end[-1].value
        drawn = [SceneUpdate.FromString(data) for topic, data in messages if topic == SCENE]
        [arrow] = [each for each in drawn[-1].entities if each.id == "witness"]
        assert arrow.texts[-1].text.strip() == "turtle1 ovlp turtle2 now: -1.53 m"
        [found] = [Specification.FromString(data) for topic, data in messages if topic == described]
        assert {node.unit for result in found.results for node in result.nodes} == {"m"}
    capsys.readouterr()
    run(["replay", "annotated.mcap", *spec])
    run(["explain", "annotated.mcap", *spec])
    said = capsys.readouterr().out
    assert "meet  violated   robustness -1.514 m\n" in said
    assert "`meet` is violated, for the log has ended: robustness -1.514 m." in said
    assert "fails by 1.514 m at 1.809 s" in said
    assert "turtle1 and turtle2 are 1.514 m apart" in said
    assert "with `turtle1 dist turtle2 <= 1.514` instead of `turtle1 ovlp turtle2`." in said
    run(["report", "annotated.mcap", "-o", "run.html"])
    page = (folder / "run.html").read_text(encoding="utf-8")
    assert "robustness \N{MINUS SIGN}1.514 m" in page
    facts = re.search(r'id="facts">(.*?)</script>', page)
    assert facts is not None
    assert {node["unit"] for each in json.loads(facts[1])["results"] for node in each["nodes"]} == {"m"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("rat=30", "give KEY=VALUE with one of max_gap, max_lateness, rate, lost"),
        ("lost", "give KEY=VALUE"),
        ("y_down=perhaps", "give y_down=true or y_down=false"),
        ("rate=fast", "rate is 'fast'; give frames a second"),
        ("lost=sometimes", "lost is 'sometimes'; give one of drop, keep"),
    ],
)
def test_an_invalid_option_of_reading_names_the_valid_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: str, message: str
) -> None:
    log = tmp_path / "annotations.txt"
    log.write_text('1 0 0 10 10 0 0 0 0 "Biker"\n')
    assert run(["info", str(log), "--read", given]) == 2
    assert message in capsys.readouterr().err


def test_names_of_numbers_are_compared_in_every_log_of_a_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_json_mcap(folder / "run.mcap", [("/m", second * SECOND, {"code": second}) for second in (1, 2, 3)])
    (folder / "m.yaml").write_text(
        "topics: {/m: {signals: {mode: {field: code, names: {1: MANUAL, 2: AUTO, 3: HOLD}}}}}"
    )
    (folder / "m.spatial").write_text('spec drives = F (mode == "AUTO")\nspec calm = G (mode != "HOLD")\n')
    mapped = ["run.mcap", "--mapping", "m.yaml", "--spec", "m.spatial"]
    assert run(["replay", *mapped, "-o", "annotated.mcap"]) == 1
    first = capsys.readouterr().out.splitlines()
    assert 'mode is 3 ("HOLD")' in first[2]
    # the names are in the new log
    for again in (["annotated.mcap"], ["annotated.mcap", "--spec", "m.spatial"]):
        assert run(["replay", *again]) == 1
        assert capsys.readouterr().out.splitlines()[1:] == first[1:-1]
    for same in (["verify", "annotated.mcap"], ["diff", *mapped, "--spec", "m.spatial"]):
        assert run(same) == 0
    assert run(["diff", "annotated.mcap", "annotated.mcap", "--align", "progress"]) == 0
    capsys.readouterr()
    (folder / "two.yaml").write_text(
        "topics: {/m: {signals: {mode: {field: code, names: {1: MANUAL, 2: AUTO}}}}}"
    )
    (folder / "m.spatial").write_text('spec drives = G (mode == "AUTO" or mode == "MANUAL")')
    assert run(["replay", "run.mcap", "--mapping", "two.yaml", "--spec", "m.spatial"]) == 1
    assert "mode is 3, which has no name" in capsys.readouterr().out
    (folder / "m.spatial").write_text('spec drives = F (mode == "AUTOMATIC")')
    for command in (
        ["replay", *mapped],
        ["explain", *mapped],
        ["report", *mapped, "-o", "r.html"],
        ["check", "m.spatial", "--log", *mapped[:3]],
    ):
        assert run(command) == 2
        said = capsys.readouterr().err
        assert 'no number of mode is called "AUTOMATIC"' in said
        assert 'its names are "MANUAL", "AUTO", "HOLD"' in said

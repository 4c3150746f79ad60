"""`spatial-replay info`: what a log holds."""

from __future__ import annotations

import json
import re
import zipfile
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import pytest
from mcap.writer import Writer

from replay.runs import SPECIFICATION, PiecewiseSource
from replay.runs import run as recorded_run
from spatial_replay import parse_specification
from spatial_replay.annotate.rerun_blueprint import blueprint_rows
from spatial_replay.cli import run
from spatial_replay.logs.schemas.Robustness_pb2 import StandingUpdate
from spatial_replay.logs.topics import STANDING
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.replay.engine import run_replay
from spatial_replay.sources import open_source

CUBE = '{"name": "cube", "class": "block", "polygon": [[0, 0], [1, 0], [1, 1]]}'
LOST_CUBE = '{"name": "cube", "class": "block", "polygon": [[NaN, 0], [1, 0], [1, 1]]}'
HAND = '{"name": "hand", "parts": [{"vertices": [[9, 9]], "radius": 1}]}'
SAMPLES = (
    f'{{"time_ns": 1000000000, "objects": [{CUBE}], "signals": {{"battery": 0.5}}}}',
    f'{{"time_ns": 3500000000, "objects": [{LOST_CUBE}, {HAND}]}}',
)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "run.jsonl"
    path.write_text("\n".join(SAMPLES) + "\n")
    return path


def test_samples_objects_and_signals_are_listed(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(log)]) == 0
    said = capsys.readouterr().out
    assert "2 samples" in said
    assert "(2.500 s)" in said
    assert "cube" in said
    assert "battery" in said


def test_long_metadata_is_cut_in_text_and_whole_in_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout, path = "x" * 5000, tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("theirs", {"layout": layout, **{f"key {n}": "short" for n in range(99)}})
        writer.finish()
    assert run(["info", str(path)]) == 0
    said = capsys.readouterr().out
    assert f"layout  {'x' * 120}… (5,000 characters; --json prints all)\n" in said
    assert (said.count("short"), "  … and 80 more; --json prints all\n" in said) == (19, True)
    assert run(["info", str(path), "--json"]) == 0
    (record,) = json.loads(capsys.readouterr().out)["metadata"]
    assert (record["data"]["layout"], len(record["data"])) == (layout, 100)


def test_many_verdicts_of_a_log_are_counted_and_the_worst_come_first(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec, annotated = log.with_name("s.spatial"), log.with_name("out.mcap")
    limits = [-1, 9, -1, 9, -1, -1, 9]
    spec.write_text("".join(f"spec s{k} = G (battery >= {limit})\n" for k, limit in enumerate(limits)))
    assert run(["replay", str(log), "--spec", str(spec), "-o", str(annotated)]) == 1
    capsys.readouterr()
    assert run(["info", str(annotated)]) == 0
    said = capsys.readouterr().out
    head, *lines = said[said.index("verdicts") :].splitlines()[: len(limits) + 1]
    counts = [line.split()[1].rstrip(",") for line in lines]
    assert counts == sorted(counts, key=["violated", "unknown", "satisfied"].index)
    assert len(set(counts)) > 1
    kinds = dict.fromkeys(counts)
    assert head == "verdicts: " + ", ".join(f"{counts.count(kind)} {kind}" for kind in kinds)


def test_an_annotated_log_shows_its_verdicts(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec, annotated = log.with_name("s.spatial"), log.with_name("out.mcap")
    spec.write_text("spec charged = G (battery >= 0.6)\nspec alone = G (hand dist hand <= 1)\n")
    recorded = log.with_name("recorded.mcap")
    assert run(["replay", str(log), "--spec", str(spec), "-o", str(annotated)]) == 1
    assert run(["record", "tracks", str(log), "--spec", str(spec), "-o", str(recorded)]) == 0
    for path in (annotated, recorded):
        capsys.readouterr()
        assert run(["info", str(path)]) == 0
        assert (
            "verdicts\n  charged  violated, robustness between -inf and -0.1\n  alone    unknown, robustness"
            in capsys.readouterr().out
        )
    assert run(["info", str(annotated), "--json"]) == 0
    metadata = {each["name"]: each["data"] for each in json.loads(capsys.readouterr().out)["metadata"]}
    assert list(metadata["spatial_replay_verdicts"]) == ["charged", "alone"]


@pytest.mark.parametrize(
    ("formula", "said"),
    [
        ("F (cube dist cube <= 1)", "satisfied, robustness"),
        ("G (cube dist cube >= 9 -> cube dist cube >= 10)", "satisfied, tested by nothing, robustness"),
        ("G[0s, 60s] (cube dist cube <= 1)", "satisfied, cut by the end of the log, robustness"),
    ],
)
def test_the_verdicts_of_an_annotated_log_say_how_they_were_tested(
    formula: str, said: str, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec, annotated = log.with_name("s.spatial"), log.with_name("out.mcap")
    log.write_text(f"{SAMPLES[0]}\n{SAMPLES[0].replace('1000000000', '3500000000')}\n")
    spec.write_text(f"spec s = {formula}")
    run(["replay", str(log), "--spec", str(spec), "-o", str(annotated)])
    capsys.readouterr()
    assert run(["info", str(annotated)]) == 0
    assert f"verdicts\n  s  {said}" in capsys.readouterr().out


def test_the_verdicts_of_a_log_say_which_requirements_they_are_about(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec, other, each = (log.with_name(f"{name}.spatial") for name in ("s", "other", "each"))
    annotated, recorded = log.with_name("out.mcap"), log.with_name("recorded.mcap")
    spec.write_text('spec calm "REQ-12: no one is hit" = G (hand dist cube >= 0)\nspec b = F true')
    other.write_text('spec b "REQ-13: it begins" = F true')
    each.write_text('spec near(who) "stay near" = G (who dist hand <= 99)')
    given = [str(log), "--spec", str(spec), "--spec", str(other)]
    run(["replay", *given, "--spec", str(each), "--each", "who=cube", "-o", str(annotated)])
    assert run(["record", "tracks", *given, "-o", str(recorded)]) == 0
    for path, templates in ((annotated, ["  stay near"]), (recorded, [])):
        capsys.readouterr()
        assert run(["info", str(path)]) == 0
        lines = capsys.readouterr().out.splitlines()
        calm, *rest, b, other_b = lines[lines.index("verdicts") + 1 : lines.index("topics")]
        assert "calm" in calm and calm.endswith("  REQ-12: no one is hit")
        assert "s.b" in b and "REQ" not in b
        assert "other.b" in other_b and other_b.endswith("  REQ-13: it begins")
        assert [line[-len("  stay near") :] for line in rest] == templates
        assert run(["info", str(path), "--json"]) == 0
        verdict = json.loads(capsys.readouterr().out)["verdicts"][0]
        assert (verdict["requirement"], verdict["title"]) == ("REQ-12", "no one is hit")


def test_a_topic_of_several_publishers_is_listed_once(
    data_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, mapping, annotated = (
        data_folder / "bags" / "two_turtles.bag",
        tmp_path / "m.yaml",
        tmp_path / "a.mcap",
    )
    assert run(["replay", str(bag), "--spec", str(tmp_path / "s.spatial")]) == 2
    assert f"spatial-replay info {bag} --suggest-mapping" in capsys.readouterr().err
    assert run(["info", str(bag), "--suggest-mapping"]) == 0
    mapping.write_text(capsys.readouterr().out)
    (tmp_path / "s.spatial").write_text("F (turtle1 dist turtle2 <= 1)")
    options = ["--mapping", str(mapping), "--spec", str(tmp_path / "s.spatial"), "-o", str(annotated)]
    assert run(["replay", str(bag), *options, "--to", "3s"]) in (0, 1)
    capsys.readouterr()
    assert run(["info", str(annotated)]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.split()[:1] == ["/tf"])
    assert line.endswith("messages  2 publishers")


def test_json_counts_samples_and_observations(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(log), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["samples"], document["start_ns"], document["end_ns"]) == (2, 10**9, 3_500_000_000)
    assert document["objects"] == [
        {"name": "cube", "classes": ["block"], "samples": 2, "unreadable": 1},
        {"name": "hand", "classes": [], "samples": 1, "unreadable": 0},
    ]
    assert document["damaged"] is False


def test_damage_is_reported_and_has_its_own_code(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log.write_text("\n".join([*SAMPLES, "no sample"]))
    assert run(["info", str(log), "--json"]) == 3
    said = capsys.readouterr()
    assert json.loads(said.out)["damaged"] is True
    assert "run.jsonl:3" in said.err


@pytest.mark.parametrize(("content", "code"), [(b"", 3), (b"\x89PNG\r\n\x1a\n", 2), (b"hello\n", 2)])
def test_a_file_of_another_kind_is_not_a_log(tmp_path: Path, content: bytes, code: int) -> None:
    other = tmp_path / "other"
    other.write_bytes(content)
    assert run(["info", str(other)]) == code


@pytest.fixture
def layer(tmp_path: Path) -> Path:
    """A sound log without samples: what was found in a run, without the run."""
    path = tmp_path / "layer.mcap"
    spec = parse_specification(SPECIFICATION, filename="blocks.spatial")
    run_replay(PiecewiseSource(recorded_run(), 5), [spec], output=path, layer=True)
    return path


def test_an_mcap_file_without_samples_is_listed(layer: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(layer), "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert (document["samples"], document["objects"], said.err) == (0, [], "")
    assert "/spatial/robustness" in {each["topic"] for each in document["topics"]}
    # what was drawn of a run is no record of it
    assert {each["mapping"] for each in document["topics"]} == {None}
    assert "replayed/blocks.spatial" in {each["name"] for each in document["attachments"]}
    assert "spatial_replay_certificate" in {each["name"] for each in document["metadata"]}


def test_an_mcap_file_without_samples_cannot_be_evaluated_but_is_not_damaged(
    layer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = tmp_path / "a.spatial"
    spec.write_text("F cube ovlp cube")
    for arguments in (["replay", str(layer), "--spec", str(spec)], ["check", str(spec), "--log", str(layer)]):
        assert run(arguments) == 2
        said = capsys.readouterr().err
        assert "no topic '/spatial/objects' in layer.mcap; it has '/spatial/" in said
        assert "'/spatial/robustness'" in said
        assert "give the log that the layer was made from" in said


def test_a_damaged_attachment_is_reported_by_info_and_replay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, spec = tmp_path / "whole.mcap", tmp_path / "a.spatial"
    spec.write_text("F cube ovlp cube")
    run_replay(PiecewiseSource(recorded_run(), 5), [parse_specification(SPECIFICATION)], output=log)
    content = log.read_bytes()
    log.write_bytes(content.replace(SPECIFICATION.encode(), SPECIFICATION.upper().encode()))
    assert log.read_bytes() != content
    for arguments in (["info", str(log)], ["replay", str(log), "--spec", str(spec)]):
        assert run(arguments) == 3
        said = capsys.readouterr().err
        assert said.count("an attachment's checksum does not fit") == 1


def test_a_scenario_without_objects_is_not_damaged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty.xml"
    empty.write_text('<?xml version="1.0"?><commonRoad timeStepSize="0.1"/>')
    assert run(["info", str(empty)]) == 0
    said = capsys.readouterr()
    assert "CommonRoad scenario, 0 samples" in said.out
    assert "without obstacles" in said.err


def test_an_external_log_lists_the_topics_that_could_map_to_objects(
    data_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = data_folder / "bags" / "two_turtles_lz4.bag"
    assert run(["info", str(bag)]) == 0
    said = capsys.readouterr().out
    assert "ROS 1 bag, 8,647 messages" in said
    assert "/turtle1/pose:  {name: turtle1, position: [x, y], yaw: theta, shape: {disc: 0.5}}" in said
    assert "spatial-replay info two_turtles_lz4.bag --suggest-mapping" in said


def test_topics_of_an_external_log_are_available_as_json(
    data_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", str(data_folder / "bags" / "pose_db3"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["kind"], document["samples"], document["messages"]["count"]) == ("ROS 2 bag", 0, 4695)
    (pose,) = (each for each in document["topics"] if each["topic"] == "/pose")
    assert pose == {
        "topic": "/pose",
        "schema": "geometry_msgs/msg/PoseStamped",
        "encoding": "cdr",
        "messages": 1565,
        "mapping": "{shape: {disc: 0.5}}",
        "unreadable": None,
    }


def test_bags_that_other_readers_take_for_empty_are_read(
    data_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("talker_mcap", "talker_sqlite3"):
        assert run(["info", str(data_folder / "bags" / name), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["messages"]["count"] == 20


def test_a_mapping_is_suggested_and_nothing_else_is_printed(
    data_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", str(data_folder / "bags" / "two_turtles.bag"), "--suggest-mapping"]) == 0
    printed = capsys.readouterr().out
    mapping = parse_mapping(printed)
    assert [topic.topic for topic in mapping.topics] == ["/turtle1/pose", "/turtle2/pose"]
    mapped = tmp_path / "turtles.yaml"
    mapped.write_text(printed)
    assert (
        run(["info", str(data_folder / "bags" / "two_turtles.bag"), "--mapping", str(mapped), "--json"]) == 0
    )
    document = json.loads(capsys.readouterr().out)
    assert {each["name"]: each["samples"] for each in document["objects"]} == {
        "turtle1": 1344,
        "turtle2": 1344,
    }


def test_no_mapping_is_suggested_if_none_is_needed(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(log), "--suggest-mapping"]) == 2
    assert "run.jsonl needs no mapping" in capsys.readouterr().err
    assert run(["info", str(log), "--suggest-mapping", "--json"]) == 2
    log.write_bytes(b"\x89PNG\r\n\x1a\n")
    assert run(["info", str(log), "--suggest-mapping"]) == 3


def test_a_folder_without_a_bag_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for more in ([], ["--suggest-mapping"]):
        assert run(["info", str(tmp_path), *more]) == 2
        assert "there is nothing in this folder; give the path of a log" in capsys.readouterr().err


def test_a_damaged_bag_is_reported(
    data_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.bag"
    cut.write_bytes((data_folder / "bags" / "two_turtles.bag").read_bytes()[:860_000])
    assert run(["info", str(cut)]) == 3
    said = capsys.readouterr()
    assert "cut.bag" in said.err
    assert "damaged" in said.out
    assert run(["info", str(cut), "--suggest-mapping"]) == 3
    assert parse_mapping(capsys.readouterr().out).topics


def test_the_layout_stored_in_a_log_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    annotated = tmp_path / "annotated.mcap"
    run_replay(PiecewiseSource(recorded_run(), 12), [parse_specification(SPECIFICATION)], output=annotated)
    assert run(["info", str(annotated), "--layout"]) == 0
    assert "3D!scene" in json.loads(capsys.readouterr().out)["configById"]


def test_a_blueprint_for_rerun_names_the_results_and_its_library(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, annotated = tmp_path / "run.jsonl", tmp_path / "annotated.mcap"
    log.write_text(Path("recordings/table.jsonl").read_text())
    output = ["-o", str(tmp_path / "run.rbl")]
    assert run(["info", str(log), "--blueprint", *output]) == 2
    assert "run.jsonl has no results to show; replay -o writes a log that has them" in capsys.readouterr().err
    run(["replay", str(log), "--spec", "recordings/table_edited.spatial", "-o", str(annotated)])
    assert run(["info", str(annotated), "--blueprint"]) == 2
    assert "name it with -o run.rbl" in capsys.readouterr().err
    payloads = [payload for batch, _ in open_source(annotated).iter_payloads(STANDING) for payload in batch]
    first, last = (StandingUpdate.FromString(payload) for payload in (payloads[0], payloads[-1]))
    rows = blueprint_rows(first)
    assert rows[0] == ("table_set", "", ".results[0]", "#0072b2")
    # a place in a message stands for one result in all of them
    assert [row.title for row in rows] == [result.name for result in last.results]
    code = run(["info", str(annotated), "--blueprint", *output])
    if find_spec("rerun") is None:
        assert code == 2
        assert "a blueprint needs rerun, which is not installed" in capsys.readouterr().err
    else:
        from rerun.chunk import RrdReader

        assert code == 0 and (tmp_path / "run.rbl").stat().st_size
        recording = tmp_path / "run.rrd"
        assert run(["info", str(annotated), "--blueprint", "-o", str(recording)]) == 0
        chunks = {chunk.entity_path: chunk for chunk in RrdReader(recording).stream() if not chunk.is_static}
        assert STANDING in chunks
        batch = chunks["/spatial/scene/object/fork"].to_record_batch()
        corners = batch.column(batch.schema.names.index("LineStrips3D:strips"))[0][0].as_py()
        assert corners[0] == corners[-1] and len(corners) > 3
        assert len(RrdReader(recording).blueprints()) == 1


def test_for_a_log_without_a_layout_the_error_says_how_to_get_one(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", str(log), "--layout"]) == 2
    assert "run.jsonl has no layout" in capsys.readouterr().err
    assert run(["info", str(log), "--layout", "--json"]) == 2
    assert run(["info", str(log), "--layout", "--decisions"]) == 2
    assert "--decisions and --layout print different things" in capsys.readouterr().err


def test_an_overview_goes_to_a_file_and_never_to_the_log(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", str(log)]) == 0
    printed, file = capsys.readouterr().out, log.with_name("info.txt")
    assert run(["info", str(log), "-o", str(file)]) == 0
    assert (file.read_text(), capsys.readouterr().out) == (printed, "")
    before = log.read_bytes()
    assert run(["info", str(log), "-o", str(log)]) == 2
    assert log.read_bytes() == before


def test_the_extension_for_viewers_is_written(
    log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(log.parent)
    assert run(["info", "--panel"]) == 0
    assert capsys.readouterr().out == "wrote spatial-replay.foxe\n"
    content = Path("spatial-replay.foxe").read_bytes()
    assert len(content) <= 200_000
    with zipfile.ZipFile(BytesIO(content)) as archive:
        assert archive.testzip() is None
        assert {each.date_time for each in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        package = json.loads(archive.read("package.json"))
        script = archive.read(package["main"].removeprefix("./"))
    # viewers install by these
    assert package["name"] and package["publisher"] and package["version"]
    # a text of a log is never read as HTML, or as code
    assert not re.search(rb"innerHTML|outerHTML|insertAdjacentHTML|\beval\(|new Function", script)
    assert run(["info", "--panel", "-o", "panels.foxe"]) == 0
    assert Path("panels.foxe").read_bytes() == content
    assert run(["info", "--panel", str(log)]) == 2
    assert run(["info", "--panel", "--json"]) == 2
    assert run(["info"]) == 2


def test_faults_of_track_files_count_seconds_from_the_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start_ns = 1_700_000_000_000_000_000
    columns = "time_ns,name,class,x,y,yaw,length,width\n"
    rows = [f"{start_ns + late * 10**6},{name},,0,0,0,1,1\n" for late, name in ((0, "a"), (200, "a"))]
    rows += [f"{start_ns + 10**8},a,,0,0,0,1,1\n", f"{start_ns + 3 * 10**8},,,0,0,0,1,1\n"]
    (tmp_path / "run.csv").write_text(columns + "".join(rows))
    lines = [json.dumps({"time_ns": start_ns + late * 10**6, "objects": []}) for late in (0, 200, 100)]
    (tmp_path / "run.jsonl").write_text("\n".join(lines))
    assert run(["info", str(tmp_path / "run.csv")]) == 3
    said = capsys.readouterr().err
    assert "run.csv:4: its time is 0.100 s, before 0.200 s" in said
    assert "the sample at 0.300 s is left out" in said
    assert run(["info", str(tmp_path / "run.jsonl")]) == 3
    assert "run.jsonl:3: its time is 0.100 s, not after 0.200 s" in capsys.readouterr().err


def test_the_rate_is_the_usual_one_where_samples_pause(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "paused.jsonl"
    times = [step * 10**8 for step in (*range(6), *range(60, 66))]
    log.write_text("".join(f'{{"time_ns": {each}, "objects": [{HAND}]}}\n' for each in times))
    assert run(["info", str(log)]) == 0
    assert "10 samples a second: F[0, 10] looks 1 s ahead" in capsys.readouterr().out

"""Assumptions that a log contradicts: for each a log that does, and one that only looks like it."""

from __future__ import annotations

import json
from math import inf
from pathlib import Path

import pytest

from bags.bag_files import write_mcap
from spatial_replay.cli import run as run_program
from spatial_replay.mapping.assumptions import NAMES
from spatial_replay.mapping.yaml_document import schema_of
from tests.mapping.contradicting_logs import BOT, CASES, FIXES, Case, Said, read
from tests.mapping.feeding import SECOND


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.assumption}: {case.label}")
def test_a_log_contradicts_an_assumption_or_only_looks_like_it(case: Case, tmp_path: Path) -> None:
    trace = read(tmp_path, f"{case.mapping}\naccept: [{case.assumption}]", case.messages)
    in_vain = f"`accept: [{case.assumption}]` has no effect"
    assert any(in_vain in remark for remark in trace.remarks) == (not case.contradicts), trace.remarks
    # what only looks like it raises no other doubt
    if not case.contradicts:
        assert [str(doubt.text) for doubt in trace.doubts] == []


def test_every_assumption_has_a_log_that_contradicts_it_and_one_that_only_looks_like_it() -> None:
    for contradicts in (True, False):
        assert {case.assumption for case in CASES if case.contradicts == contradicts} == set(NAMES)


def test_an_accepted_contradiction_is_a_remark_and_another_name_is_remarked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = [json.dumps({"x": 1.0, "y": 2.0, "yaw": 90.0 * number}).encode() for number in range(5)]
    log, mapping, spec = (tmp_path / name for name in ("run.mcap", "m.yaml", "s.spatial"))
    channels = [("/bot", "json", "Pose", "jsonschema", b'{"type":"object"}')]
    write_mcap(log, channels, (("/bot", number * SECOND, pose) for number, pose in enumerate(poses, 1)))
    spec.write_text("region zone = box(0, 0, 9, 9)\nspec stays = G (bot enclosedin zone)")
    command = ["replay", str(log), "--mapping", str(mapping), "--spec", str(spec)]
    for accept, code, said in (
        ("", 4, "doubtful: /bot: its angles reach 360"),
        ("accept: [radians, origin]", 0, "accepted: /bot: its angles reach 360"),
        ("accept: [radians, origin]", 0, "m.yaml: `accept: [origin]` has no effect"),
        ("\naccept:\n- radian", 2, "m.yaml:5: accept[0]: expected the name of an assumption"),
        ("accept: [radian]", 2, "did you mean 'radians'?"),
    ):
        mapping.write_text(f"topics:\n  /bot: {{position: [x, y], yaw: yaw, shape: {{disc: 0.1}}}}\n{accept}")
        assert run_program(command) == code
        assert said in capsys.readouterr().err


def test_the_schema_of_mappings_names_every_assumption() -> None:
    assert schema_of("mapping", "mapping")["properties"]["accept"]["items"]["enum"] == list(NAMES)


def test_info_shows_the_evidence_of_each_topic_with_what_contradicts_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, mapping = tmp_path / "run.mcap", tmp_path / "m.yaml"
    kinds = (("/people", "People"), ("/bot", "Pose"))
    channels = [(topic, "json", name, "jsonschema", b'{"type":"object"}') for topic, name in kinds]
    messages = []
    for number in range(20):
        time_ns = (10 + number // 10) * SECOND + number * SECOND // 10
        listed = [{"id": i, "kind": "person", "x": 0.1 * number, "y": float(i)} for i in range(3)]
        messages.append(("/people", time_ns, json.dumps({"of": listed}).encode()))
        pose = {"x": 0.2 * number, "y": 2.0, "yaw": 100.0}
        messages.append(("/bot", time_ns, json.dumps(pose).encode()))
    write_mcap(log, channels, messages)
    mapping.write_text(
        "unit: m\ntopics:\n"
        "  /people: {objects: 'of[*]', name: 'p{id}', class: {field: kind}, position: [x, y],"
        " shape: {disc: 0.3}}\n"
        "  /bot: {position: [x, y], yaw: yaw, shape: {box: [1, 0.5]}, height: [0, 1.5]}\n"
    )
    command = ["info", str(log), "--mapping", str(mapping)]
    assert run_program(command) == 0
    evidence = capsys.readouterr().out.split("evidence\n")[1]
    bot, people = evidence.split("  /people: ")
    # the pause is named with its end
    assert bot.startswith(
        "  /bot: 20 messages from 0.000 s to 2.900 s, every 0.1 s, at most 1.1 s apart, until 2."
    )
    assert "    DOUBTFUL    radians: its angles reach 100 and are read as radians" in bot
    for line in (
        "names       `p{id}`, 3 names, up to 3 at once: p0, p1, p2",
        "classes     person",
        "sizes       longer side always 0.6 m; shorter always 0.6 m",
        "places      x 0 to 1.9, y 0 to 2",
        "speed       median 1 m/s, at most 1 m/s at ",
    ):
        assert line in people
    assert "heights     0 to 1.5 m" in bot
    assert run_program([*command, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [(doubt["assumption"], doubt["topic"]) for doubt in document["doubts"]] == [("radians", "/bot")]
    facts = {topic["topic"]: topic for topic in document["evidence"]}
    assert facts["/bot"]["period_s"]["greatest"] == pytest.approx(1.1)
    assert (facts["/people"]["names"], facts["/people"]["most_at_once"]) == (["p0", "p1", "p2"], 3)


@pytest.mark.filterwarnings("error")
def test_places_that_are_infinite_are_read_without_a_warning_of_python(tmp_path: Path) -> None:
    trace = read(
        tmp_path, BOT, [Said(0.1 * k, {"x": inf if k == 5 else 0.1 * k, "y": 0.0}) for k in range(9)]
    )
    assert trace.doubts == ()


def test_a_latitude_that_is_not_available_is_one_doubt_with_the_key_that_settles_it(tmp_path: Path) -> None:
    fixes = [{"latitude": 52.0 + 1e-5 * k, "longitude": 5.0, "heading": 90.0} for k in range(20)]
    fixes[7] = {"latitude": 91.0, "longitude": 181.0, "heading": 90.0}
    trace = read(tmp_path, FIXES, [Said(0.1 * k, fix) for k, fix in enumerate(fixes)])
    (doubt,) = trace.doubts
    assert doubt.assumption == "latitude"
    assert "`invalid: [91, 181]`" in str(doubt.text)

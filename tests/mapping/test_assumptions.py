"""Assumptions that a log contradicts: for each a log that does, and one that only looks like it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import pytest

from bags.bag_files import write_mcap
from spatial_replay.cli import run as run_program
from spatial_replay.mapping.assumptions import NAMES
from spatial_replay.mapping.yaml_document import schema_of
from tests.mapping.feeding import SECOND, Feed, make


def doubts(mapping: str, *messages: tuple[str, float, object]) -> list[str]:
    """Return the names of the contradicted assumptions; each message has a topic, a time and a content."""
    feed = Feed()
    for topic, seconds, content in messages:
        feed.add(topic, round(seconds * SECOND), content)
    return [doubt.assumption for doubt in make(mapping, feed).doubts]


def run(topic: str, contents: Iterable[object]) -> list[tuple[str, float, object]]:
    """Return messages at 10 Hz."""
    return [(topic, 1.0 + number / 10, content) for number, content in enumerate(contents)]


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ((0.707106781, 0.0, 0.0, 0.707106781), ["quaternion_order"]),
        ((0.0, 0.0, 0.707106781, 0.707106781), []),
        # one that lies on its side in both orders
        ((0.5, 0.5, 0.5, 0.5), []),
    ],
)
def test_quaternions_in_the_other_order_stand_upright(
    numbers: tuple[float, ...], expected: list[str]
) -> None:
    mapping = "topics: {/uav: {name: uav, position: p, orientation: q, order: xyzw, shape: {box: [2, 1]}}}"
    messages = run("/uav", ({"p": {"x": float(i), "y": 0.0}, "q": list(numbers)} for i in range(10)))
    assert doubts(mapping, *messages) == expected


def test_an_object_that_leaps_there_and_back_is_two_objects() -> None:
    mapping = "topics: {/bot: {name: bot, position: [x, y], shape: {disc: 0.3}}}"
    alternating = ({"x": i * 0.1 + 30.0 * (i % 2), "y": 0.0} for i in range(20))
    assert doubts(mapping, *run("/bot", alternating)) == ["one_object"]
    # one that goes to and fro within its own size, and one that is placed anew
    trembling = ({"x": 0.2 * (i % 2), "y": 0.0} for i in range(20))
    assert doubts(mapping, *run("/bot", trembling)) == []
    placed = ({"x": i * 0.1 + 30.0 * (i > 9), "y": 0.0} for i in range(20))
    assert doubts(mapping, *run("/bot", placed)) == []


def test_a_list_that_comes_in_parts_is_not_complete() -> None:
    mapping = "topics: {/radar: {objects: 'of[*]', name: 't{id}', position: [x, y], shape: {disc: 0.3}}}"

    def part(numbers: Iterable[int], x: float) -> dict[str, object]:
        return {"of": [{"id": number, "x": x, "y": 5.0 * number} for number in numbers]}

    halves = (part((0, 1) if i % 2 else (2, 3), i / 10) for i in range(20))
    assert doubts(mapping, *run("/radar", halves)) == ["complete_list"]
    # detections that are missed now and then
    flickering = (part((0, 1) if i % 3 == 1 else (0, 1, 2, 3), i / 10) for i in range(20))
    assert doubts(mapping, *run("/radar", flickering)) == []


def test_an_accepted_contradiction_is_a_remark_and_one_in_vain_is_said(
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

"""Logs are judged from where they can be placed to where they can be placed, and all of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import spatial_replay as sr
from bags.bag_files import SECOND, write_json_mcap, write_mcap
from spatial_replay.cli import run
from spatial_replay.monitor.ends import Needs, RunEnds
from spatial_replay.trace.spans import TopicSpan

MS = SECOND // 1000
START = 100 * SECOND

PAIR = """\
topics:
  /robot: {name: robot, shape: {disc: 0.3}}
  /cart: {name: cart, shape: {disc: 0.3}}
"""
APART = "spec apart = G (robot dist cart >= 1)\n"

Messages = list[tuple[str, int, object]]


def positions(topic: str, times_ms: range, step: float = 0.0, x: float = 0.0) -> Messages:
    """Messages of a point that moves by a step between two of them."""
    return [
        (topic, START + at * MS, {"x": x + step * number, "y": 0.0}) for number, at in enumerate(times_ms)
    ]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.spatial").write_text(APART)
    return tmp_path


def write(folder: Path, mapping: str, *streams: Messages) -> None:
    (folder / "m.yaml").write_text(mapping)
    messages = sorted((message for stream in streams for message in stream), key=lambda message: message[1])
    write_json_mcap(folder / "log.mcap", messages)


def replay(
    capsys: pytest.CaptureFixture[str], *more: str, log: str = "log.mcap", code: int | None = None
) -> tuple[Any, str]:
    """The JSON of a replay, and what is said besides."""
    capsys.readouterr()
    mapped = ("--mapping", "m.yaml") if log == "log.mcap" else ()
    exit_code = run(["replay", log, *mapped, "--spec", "s.spatial", "--json", "-", *more])
    output = capsys.readouterr()
    assert code is None or exit_code == code, output.err
    return json.loads(output.out), output.err


@pytest.mark.parametrize("sample", ["", "sample: {topic: /robot}\n"])
def test_samples_go_on_where_the_sampled_topic_ends(
    folder: Path, capsys: pytest.CaptureFixture[str], sample: str
) -> None:
    mapping = sample + PAIR.replace(
        "shape: {disc: 0.3}}\n  /cart", "max_age: forever, shape: {disc: 0.3}}\n  /cart"
    )
    cart = positions("/cart", range(0, 18_000, 100), -0.05, 6.0)
    write(folder, mapping, positions("/robot", range(0, 5_000, 20)), cart)
    document, said = replay(capsys, code=1)
    assert document["log"]["samples"] == 250 + 130
    assert document["log"]["end_ns"] == START + 17_900 * MS
    assert (
        "samples are taken at /robot, which ends at 4.980 s; those after, until 17.900 s, are at /cart"
        in said
    )
    # a window has the samples of the whole log, also where it lies after the end
    for start, end, count in ((2, 4, 100), (4, 8, 50 + 30), (10, 12, 20), (16, 18, 20)):
        window, _ = replay(capsys, "--from", f"{start}s", "--to", f"{end}s")
        assert window["log"]["samples"] == count


def test_a_silent_object_grows_stale_after_the_sampled_topic_has_ended(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(
        folder,
        PAIR,
        positions("/robot", range(0, 5_000, 20)),
        positions("/cart", range(0, 18_000, 100), 0, 6.0),
    )
    _, said = replay(capsys, code=4)
    assert "/robot: robot is unknown in up to 120 samples, the first at 6.000 s" in said


def test_samples_begin_where_another_topic_begins(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mapping = "sample: {topic: /robot}\n" + PAIR
    robot = positions("/robot", range(5_000, 8_000, 100))
    write(folder, mapping, robot, positions("/cart", range(0, 8_000, 200), 0, 6.0))
    (folder / "s.spatial").write_text("region home = circle((0, 0), 1)\nspec far = G (cart dist home >= 7)\n")
    document, said = replay(capsys, code=1)
    assert document["log"]["samples"] == 25 + 30
    assert "which begins at 5.000 s; those before, from 0.000 s on, are at /cart" in said
    for start, end, count in ((1, 3, 10), (4, 6, 5 + 10), (6, 7, 10)):
        window, _ = replay(capsys, "--from", f"{start}s", "--to", f"{end}s")
        assert window["log"]["samples"] == count


def test_a_pause_of_the_sampled_topic_is_judged_at_the_others(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapping = PAIR.replace("robot, ", "robot, max_age: forever, ")
    # the cart drives through the robot and away again while the robot says nothing
    robot = positions("/robot", range(0, 5_000, 20)) + positions("/robot", range(10_000, 12_000, 20))
    robot += positions("/robot", range(14_000, 15_000, 20))
    away, near = (
        positions("/cart", range(0, 6_500, 100), 0, 6.0),
        positions("/cart", range(6_500, 8_500, 100)),
    )
    write(folder, mapping, robot, away, near, positions("/cart", range(8_500, 15_000, 100), 0, 6.0))
    document, said = replay(capsys, code=1)
    assert document["log"]["samples"] == 250 + 50 + 100 + 20 + 50
    assert (
        "samples are taken at /robot, which pauses from 4.980 s to 10.000 s;"
        " those between and in 1 more pause are at /cart" in said
    )
    for start, end, code, count in ((4, 6, 0, 50 + 10), (6, 9, 1, 30), (9, 11, 0, 10 + 50), (12, 14, 0, 20)):
        window, _ = replay(capsys, "--from", f"{start}s", "--to", f"{end}s", code=code)
        assert window["log"]["samples"] == count


def test_objects_of_a_sampled_topic_grow_stale_in_its_pause(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = positions("/robot", range(0, 5_000, 20)) + positions("/robot", range(9_000, 12_000, 20))
    write(folder, PAIR, robot, positions("/cart", range(0, 12_000, 100), 0, 6.0))
    _, said = replay(capsys, code=4)
    assert "/robot: robot is unknown in up to 30 samples, the first at 6.000 s" in said
    replay(capsys, "--to", "5.9s", code=0)


@pytest.mark.parametrize("period_ms", [500, 2_000, 9_000])
def test_a_topic_that_is_sampled_slowly_makes_all_samples(
    folder: Path, capsys: pytest.CaptureFixture[str], period_ms: int
) -> None:
    mapping = "sample: {topic: /robot}\n" + PAIR
    robot = positions("/robot", range(0, 6 * period_ms, period_ms))
    write(folder, mapping, robot, positions("/cart", range(0, 5 * period_ms + 1, 100), 0, 6.0))
    document, said = replay(capsys, code=0)
    assert document["log"]["samples"] == 6
    assert "those" not in said


def test_a_latched_topic_that_came_regularly_and_stops_is_remarked(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapping = "sample: {topic: /cart}\n" + PAIR.replace("robot, ", "robot, max_age: forever, ")
    write(
        folder,
        mapping,
        positions("/robot", range(0, 3_000, 100)),
        positions("/cart", range(0, 9_000, 100), 0, 6.0),
    )
    _, said = replay(capsys, code=0)
    assert "/robot: its messages stop at 2.900 s, where one usually comes every 0.1 s" in said


ODOMETRY = """\
fixed_frame: map
sample: {topic: /odom}
topics:
  /odom: {name: robot, frame: odom, shape: {disc: 0.3}}
  /people: {objects: "people[*]", name: "{id}", class: person, frame: odom, shape: {disc: 0.3}}
"""


NEAR = """\
region home = circle((0, 0), 1)
spec near = G (robot dist home <= 9)
"""


def write_frames(
    folder: Path,
    transforms_ms: range,
    *,
    mapping: str = ODOMETRY,
    persons: Sequence[tuple[str, int, object]] = (),
    until_ms: int = 4_000,
) -> None:
    """Odometry at 20 Hz for four seconds, transforms, and people."""
    (folder / "m.yaml").write_text(mapping)
    schema = ("foxglove.FrameTransform", "jsonschema", b"{}")
    channels = [("/odom", "json", "", "", b""), ("/tf", "json", *schema), ("/people", "json", "", "", b"")]
    messages = positions("/odom", range(0, until_ms, 50)) + list(persons)
    for at in transforms_ms:
        time_ns = START + at * MS
        stamp = {"sec": time_ns // SECOND, "nsec": time_ns % SECOND}
        placed = {"translation": {"x": 0, "y": 0, "z": 0}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}
        names = {"parent_frame_id": "map", "child_frame_id": "odom"}
        messages.append(("/tf", time_ns, {"timestamp": stamp, **names, **placed}))
    listed = [(topic, at, json.dumps(content).encode()) for topic, at, content in messages]
    write_mcap(folder / "log.mcap", channels, sorted(listed, key=lambda message: message[1]))


def people(times_ms: range, *names: str, x: float = 6.0) -> Messages:
    return [
        ("/people", START + at * MS, {"people": [{"id": name, "x": x, "y": 0.0} for name in names]})
        for at in times_ms
    ]


def test_one_sample_is_left_out_at_a_time(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "s.spatial").write_text(NEAR)
    write_frames(folder, range(0, 4_000, 100))
    _, said = replay(capsys, code=0)
    assert "1 sample at the end is left out, at 3.950 s: no transform places /odom then" in said


def test_a_check_against_a_log_compares_the_samples_of_its_replay(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "s.spatial").write_text(NEAR)
    write_frames(folder, range(90, 3_900, 100))
    assert run(["check", "s.spatial", "--log", "log.mcap", "--mapping", "m.yaml"]) == 0
    output = capsys.readouterr()
    assert "compared with 76 samples of log.mcap over 3.750 s" in output.out
    assert "log.mcap: 2 samples at the end are left out, from 3.900 s to 3.950 s" in output.err
    assert "robot is missing" not in output.err


def test_constants_and_lines_come_from_the_samples_of_a_replay(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "s.spatial").write_text(
        "const near = 0.2 in [0.1, 9]\nspec apart = G (robot dist cart >= near)\n"
    )
    logs = {f"{name}.mcap": x for name, x in {"g1": 4.0, "g2": 5.0, "b1": 1.0, "b2": 1.5}.items()}
    for log, x in logs.items():
        write(
            folder,
            PAIR,
            positions("/robot", range(0, 3_000, 50)),
            positions("/cart", range(300, 3_000, 50), 0, x),
        )
        (folder / "log.mcap").rename(log)
    good, bad = (tuple(log for log in logs if log.startswith(kind)) for kind in "gb")
    labelled = [part for log in good for part in ("--good", log)] + [
        part for log in bad for part in ("--bad", log)
    ]
    assert run(["tune", "--spec", "s.spatial", *labelled, "--mapping", "m.yaml"]) == 0
    assert "widest margin for 2 good runs and 2 bad runs: 1.25" in capsys.readouterr().out
    bad_options = [part for log in bad for part in ("--bad", log)]
    assert run(["learn", *good, *bad_options, "--mapping", "m.yaml", "-o", "learned.spatial"]) == 0
    assert "violated by 2 of 2" in capsys.readouterr().out


LISTS = """\
sample: {topic: /robot}
topics:
  /robot: {name: robot, shape: {disc: 0.3}}
  /near: {objects: "people[*]", name: "{id}", shape: {disc: 0.3}}
  /far: {objects: "people[*]", name: "{id}", shape: {disc: 0.3}}
"""


@pytest.mark.parametrize("comes_ms", [0, 2_000])
def test_a_log_begins_at_the_same_sample_whenever_an_object_comes(
    folder: Path, capsys: pytest.CaptureFixture[str], comes_ms: int
) -> None:
    (folder / "s.spatial").write_text("spec met = F[0s, 1s] (robot dist p <= 9)\n")
    listed = [
        ("/near", START + at * MS, {"people": [{"id": "p", "x": 3.0, "y": 0.0}] if at >= comes_ms else []})
        for at in range(0, 4_000, 200)
    ]
    others: Messages = [("/far", START + at * MS, {"people": []}) for at in range(500, 4_000, 200)]
    write(folder, LISTS, positions("/robot", range(0, 4_000, 50)), listed, others)
    document, said = replay(capsys, code=4 if comes_ms else 0)
    # a run that has not seen p does not know which list will have it
    assert document["log"]["start_ns"] == START + 500 * MS
    assert "/far begins at 0.500 s" in said


def test_samples_that_are_left_out_are_said_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(
        folder,
        PAIR,
        positions("/robot", range(0, 9_000, 50)),
        positions("/cart", range(500, 9_000, 50), 0, 6.0),
    )
    document, said = replay(capsys, code=0)
    assert document["log"]["samples"] == 170
    assert (
        "10 samples at the beginning are left out, from 0.000 s to 0.450 s: /cart begins at 0.500 s" in said
    )
    assert "the window" not in said


@pytest.mark.parametrize("window", [(), ("--to", "3.5s")])
def test_a_group_whose_topic_begins_later_than_is_waited_for_is_remarked(
    folder: Path, capsys: pytest.CaptureFixture[str], window: tuple[str, ...]
) -> None:
    (folder / "s.spatial").write_text(
        'group people = class "person"\nspec apart = G (forall x in people: robot dist x >= 0.1)\n'
    )
    write_frames(folder, range(0, 4_050, 50), persons=people(range(3_000, 4_000, 200), "p"))
    _, said = replay(capsys, *window, code=0)
    assert (
        "/people begins at 3.000 s, more than 1s after the first sample: its objects are absent"
        " before, also from groups" in said
    )


def test_odometry_without_a_transform_behind_it_is_left_out(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "s.spatial").write_text(NEAR)
    write_frames(folder, range(90, 3_900, 100))
    document, said = replay(capsys, "-o", "annotated.mcap", code=0)
    # transforms from 0.09 s to 3.89 s: odometry from 0.10 s to 3.85 s
    assert document["log"]["samples"] == 76
    assert (document["log"]["start_ns"], document["log"]["end_ns"]) == (START + 100 * MS, START + 3_850 * MS)
    assert "2 samples at the beginning are left out, from 0.000 s to 0.050 s" in said
    assert (
        "2 samples at the end are left out, from 3.900 s to 3.950 s: no transform places /odom then" in said
    )
    again, _ = replay(capsys, log="annotated.mcap", code=0)
    assert again["log"]["samples"] == 76
    assert again["certificate"]["samples_sha256"] == document["certificate"]["samples_sha256"]
    assert run(["verify", "annotated.mcap", "--source", "log.mcap", "--mapping", "m.yaml"]) == 0
    (folder / "m.yaml").write_text("ends: keep\n" + ODOMETRY)
    kept, said = replay(capsys, code=4)
    assert kept["log"]["samples"] == 80
    assert "left out" not in said


def test_a_trace_is_trimmed_as_its_log_is(folder: Path) -> None:
    write_frames(folder, range(90, 3_900, 100))
    trace = sr.read_trace("log.mcap", mapping="m.yaml")
    assert len(trace) == 80
    evaluation = sr.evaluate(sr.parse_specification(NEAR), trace)
    assert evaluation.verdict == "satisfied"
    assert len(evaluation.result().times_ns) == 76
    assert [text[:20] for text in map(str, evaluation.left_out)] == [
        "2 samples at the beg",
        "2 samples at the end",
    ]
    whole = sr.evaluate(
        sr.parse_specification(NEAR),
        trace,
        start_ns=START,
        end_ns=START + 4 * SECOND,
    )
    assert whole.verdict == "unknown"


def test_a_hole_at_an_end_stays_unknown(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "s.spatial").write_text(NEAR)
    write_frames(folder, range(0, 2_900, 100))
    document, said = replay(capsys, code=4)
    assert document["log"]["samples"] == 80
    assert "left out" not in said


def test_a_given_window_overrides_trimming(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "s.spatial").write_text(NEAR)
    write_frames(folder, range(90, 3_900, 100))
    assert replay(capsys, "--from", "1s", code=0)[0]["log"]["samples"] == 58
    assert replay(capsys, "--to", "3.95s", code=4)[0]["log"]["samples"] == 77


def test_only_needed_topics_are_waited_for(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_frames(folder, range(0, 5_000, 100), persons=people(range(700, 3_500, 100)))
    for text, samples in (
        (NEAR, 80),
        ("spec all_far = G (forall p in people: robot dist p >= 1)", 66),
        ("spec far = G (robot dist anna >= 1)", 66),
        ("spec others = G (forall c in chairs: robot dist c >= 1)", 80),
    ):
        (folder / "s.spatial").write_text(
            'group people = class "person"\ngroup chairs = class "chair"\n' + text + "\n"
        )
        assert replay(capsys)[0]["log"]["samples"] == samples, text


def test_an_object_that_is_not_in_view_yet_is_unknown(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "s.spatial").write_text("spec met = F[0s, 1s] (robot dist anna <= 9)\n")
    empty, seen = people(range(0, 400, 100)), people(range(400, 4_000, 100), "anna")
    write_frames(folder, range(0, 5_000, 100), persons=empty + seen)
    document, said = replay(capsys, code=0)
    assert document["log"]["samples"] == 80
    assert "left out" not in said


def test_times_may_count_from_the_last_sample(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(
        folder,
        PAIR,
        positions("/robot", range(0, 2_001, 100)),
        positions("/cart", range(0, 2_001, 100), 0, 6.0),
    )
    for window, samples in (
        (("--to", "-500ms"), 15),
        (("--from", "-0.5s"), 6),
        (("--from", "-1s", "--to", "-200ms"), 8),
    ):
        assert replay(capsys, *window, code=0)[0]["log"]["samples"] == samples
    assert run(["explain", "log.mcap", "--mapping", "m.yaml", "--spec", "s.spatial", "--at", "-1s"]) == 4
    arguments = ["--mapping", "m.yaml", "--spec", "s.spatial", "--to", "-500ms", "-o", "results"]
    assert run(["batch", "log.mcap", *arguments]) == 0
    assert run(["replay", "log.mcap", "--mapping", "m.yaml", "--spec", "s.spatial", "--to", "-3h"]) == 2
    assert "-200ms before its last" in capsys.readouterr().err


@pytest.mark.parametrize("start_ns", [0, 1_000_000_000])
def test_a_topic_that_never_comes_leaves_a_hole_from_time_0_on_too(start_ns: int) -> None:
    span = TopicSpan("/cup", frozenset(), "cup", frozenset(), None, 1_000_000_000, None, None, None, None)
    ends = RunEnds(Needs(frozenset({"cup"})))
    counting = [
        trace
        for offset_ns in (0, 500_000_000, 1_100_000_000, 1_200_000_000)
        for trace in ends.add(
            replace(sr.Trace.from_samples([sr.Sample(start_ns + offset_ns)]), spans=(span,))
        )
    ]
    assert sum(map(len, [*counting, *ends.finish()])) == 4

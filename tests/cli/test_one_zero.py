"""Seconds in texts count from one zero, whichever command says them of whichever part of a log."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import spatial_replay as sr
from annotate.layouts import layout_of
from bags.bag_files import MAPPING, SECOND, START_NS, TEXT, Sent, drive, text, write_ros1, write_ros2
from cli.program import run_program

GIVEN = ("--mapping", "m.yaml", "--spec", "s.spatial")
LEAST = " at 3.000 s"
"""The distance of `drive` is least after three seconds, and below 2 from 2.1 s on."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    early = Sent("/words", TEXT, START_NS - 7 * SECOND, text("on"))
    write_ros1(tmp_path / "run.bag", [early, *drive()])
    write_ros2(tmp_path / "run_ros2", [early, *drive()])
    (tmp_path / "m.yaml").write_text(MAPPING)
    (tmp_path / "s.spatial").write_text("spec apart = G (a dist b >= 2)")
    return tmp_path


def said(folder: Path, *arguments: str) -> str:
    ran = run_program(*arguments, cwd=folder)
    assert ran.returncode in (0, 1), ran.stderr
    return ran.stdout


def events(log: Path) -> list[float]:
    """The seconds that a viewer lists beside the newest events."""
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        lists = reader.iter_decoded_messages(["/spatial/recent_events"])
        return [event.at for event in [each.decoded_message for each in lists][-1].events]


def test_a_part_of_a_log_has_the_times_of_the_whole(folder: Path) -> None:
    said(folder, "replay", "run.bag", *GIVEN, "-o", "whole.mcap")
    assert LEAST in said(folder, "replay", "run.bag", *GIVEN, "--from", "1.55s", "-o", "part.mcap")
    assert LEAST in said(folder, "clip", "run.bag", *GIVEN, "-o", "clip.mcap")
    for log in ("whole.mcap", "part.mcap", "clip.mcap"):
        assert LEAST in said(folder, "explain", log), log
        document = json.loads(said(folder, "replay", log, "--json", "-"))
        assert document["log"]["zero_ns"] == START_NS + 1_000, log
        assert " at 2.100 s" in document["specifications"][0]["worst"]["explanation"][1], log
        assert "match" in said(folder, "verify", log)
        assert "match" in said(folder, "verify", log, "--source", "run.bag", "--mapping", "m.yaml")
        assert events(folder / log)[-1] == pytest.approx(events(folder / "whole.mcap")[-1]), log
        light = layout_of(folder / log)["configById"]["Indicator!result0"]["foxglovePanelTitle"]
        assert f"{LEAST} (22:13:23.000 UTC)" in light, log
    # options take the times that are printed
    assert "3 samples" in said(folder, "replay", "part.mcap", "--from", "1.7s", "--to", "2s")


def test_runs_are_compared_and_gated_by_the_times_of_the_whole(folder: Path) -> None:
    said(folder, "replay", "run.bag", *GIVEN, "-o", "whole.mcap")
    said(folder, "replay", "run.bag", *GIVEN, "--from", "1.55s", "-o", "part.mcap")
    # both logs are cut at the same moment
    assert "the same 31 samples" in said(folder, "diff", "whole.mcap", "part.mcap", "--from", "2.9s")
    apart = said(folder, "diff", "whole.mcap", "part.mcap")
    assert "44 of A beside 44 of B" in apart
    assert "differs since" not in apart
    (folder / "far.spatial").write_text("spec apart = G (a dist b >= 1.7)")
    edited = (*GIVEN[:2], "--spec", "far.spatial", "--spec", "s.spatial")
    assert "first differs at 1.600 s" in said(folder, "diff", "run.bag", *edited, "--from", "1.55s")
    said(folder, "batch", "run.bag", *GIVEN, "--from", "1.55s", "-o", "results", "--json", "rows.json")
    row = json.loads((folder / "rows.json").read_text())
    assert LEAST in row["reason"]
    assert row["zero_ns"] == START_NS + 1_000


def test_explanations_in_python_count_like_the_command(folder: Path) -> None:
    # the first sample is left out, since b is not in it
    trace = sr.read_trace(folder / "run.bag", mapping=folder / "m.yaml")
    result = sr.evaluate(sr.load_specification(folder / "s.spatial"), trace).results[0]
    assert LEAST in result.explain()


@pytest.mark.parametrize(
    ("log", "options", "offset"),
    [
        ("run.bag", (), "7.000 s after the start of this log"),
        ("run.bag", ("--from", "1.55s"), "1.600 s before the start of this log"),
        ("run.bag", ("--layer",), "7.000 s after the start of run.bag"),
        # its messages stay in the bag, which is opened next to the annotated log
        ("run_ros2", ("--from", "1.55s"), "7.000 s after the start of run_ros2"),
    ],
)
def test_the_layout_says_where_0_is_on_a_viewers_axis(
    folder: Path, log: str, options: tuple[str, ...], offset: str
) -> None:
    said(folder, "replay", log, *GIVEN, *options, "-o", "annotated.mcap")
    panels = layout_of(folder / "annotated.mcap")["configById"]
    assert panels["Plot!robustness"]["xAxisLabel"] == f"time [s]; texts count from {offset}"
    title = panels["RawMessages!specification"]["foxglovePanelTitle"]
    assert title == f"Specification; 0 s = 2023-11-14 22:13:20.000 UTC, {offset}"
    events = panels["Table!events"]["foxglovePanelTitle"]
    assert events == "Events; 0 s = 22:13:20.000 UTC"


def test_tables_and_warnings_of_a_part_count_like_the_whole(folder: Path) -> None:
    said(folder, "replay", "run.bag", *GIVEN, "--from", "1.55s", "-o", "part.mcap")
    said(folder, "export", "part.mcap", "-o", "part.csv")
    first = (folder / "part.csv").read_text().splitlines()[1]
    assert float(first.split(",")[1]) == pytest.approx(1.6)
    outside = run_program("replay", "part.mcap", "--from", "9s", cwd=folder)
    assert "its samples are from 1.600 s to 5.900 s" in outside.stderr

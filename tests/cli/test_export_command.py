"""`spatial-replay export`, from outside."""

from __future__ import annotations

import csv
import gc
import sys
from pathlib import Path

import pytest

from bags.bag_files import MAPPING, drive, write_ros2
from cli.program import run_program
from replay.runs import SPECIFICATION, PiecewiseSource, record, run
from spatial_replay import parse_specification
from spatial_replay.cli import run as run_in_process
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.table import export_table
from spatial_replay.sources import open_source


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with an annotated log."""
    monkeypatch.chdir(tmp_path)
    spec = parse_specification(SPECIFICATION)
    run_replay(PiecewiseSource(run(), 5), [spec], output=tmp_path / "annotated.mcap")
    return tmp_path


def test_the_command_reports_what_it_wrote(folder: Path) -> None:
    done = run_program("export", "annotated.mcap", "-o", "run.csv", cwd=folder)
    said = "wrote run.csv: 12 rows, 4 nodes\n"
    assert (done.returncode, done.stdout, done.stderr) == (0, said, "")
    lines = (folder / "run.csv").read_text().splitlines()
    assert lines[0] == (
        'time_ns,seconds,reach,reach: cube enclosedin goal,apart,"apart: cube dist ""cup 物"" >= 0.5",'
        "reach/automaton,apart/automaton"
    )
    assert lines[2].startswith("250000000,0.25,")
    assert len(lines) == 13


def test_the_quantity_can_be_chosen(folder: Path) -> None:
    assert run_in_process(["export", "annotated.mcap", "-o", "value.csv"]) == 0
    assert run_in_process(["export", "annotated.mcap", "-o", "upper.csv", "--quantity", "upper"]) == 0
    assert (folder / "upper.csv").read_text() != (folder / "value.csv").read_text()


def test_a_title_that_is_a_formula_for_spreadsheets_is_quoted(folder: Path) -> None:
    spec = 'region goal = box(4, -1, 9, 2)\nspec "=HYPERLINK(1)" = F (cube dist goal >= 99)\n'
    (folder / "names.spatial").write_text(spec)
    assert run_in_process(["export", "annotated.mcap", "--spec", "names.spatial", "-o", "run.csv"]) == 0
    with (folder / "run.csv").open(newline="") as stream:
        titles, first, *_ = csv.reader(stream)
    assert {title[:2] for title in titles[2:]} == {"'="}
    assert float(first[2]) < 0.0


@pytest.mark.parametrize(
    ("log", "output", "code", "said"),
    [
        ("none.mcap", "run.csv", 2, "none.mcap: no such file"),
        ("annotated.mcap", "run.txt", 2, "run.txt ends in neither .csv nor .parquet"),
        ("annotated.mcap", "none/run.csv", 2, "there is no folder none"),
        ("tracks.csv", "run.csv", 2, "tracks.csv is not an annotated log; give --spec"),
        ("recorded.mcap", "run.csv", 2, "recorded.mcap holds no /spatial/robustness; write it with"),
        ("annotated.mcap", "-", 2, "'-' is not a file"),
    ],
)
def test_an_export_that_cannot_work_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], log: str, output: str, code: int, said: str
) -> None:
    (folder / "tracks.csv").write_text("time_ns,name,polygon\n0,a,0 0 1 0 1 1\n")
    record(run(), folder / "recorded.mcap")
    assert run_in_process(["export", log, "-o", output]) == code
    assert said in capsys.readouterr().err
    assert not (folder / "run.csv").exists()
    assert not (folder / "-").exists()


def test_the_readable_part_of_a_damaged_log_is_exported_with_code_3(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (folder / "annotated.mcap").read_bytes()
    (folder / "broken.mcap").write_bytes(whole[:-200])
    assert run_in_process(["export", "broken.mcap", "-o", "run.csv"]) == 3
    assert "broken.mcap" in capsys.readouterr().err
    assert len((folder / "run.csv").read_text().splitlines()) == 13


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_an_export_that_is_interrupted_at_its_end_leaves_nothing_and_says_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    complaints: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", complaints.append)
    before = sorted(folder.iterdir())

    def interrupt(rows: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_table(open_source("annotated.mcap"), folder / f"run.{ending}", advance=interrupt)
    gc.collect()
    assert (sorted(folder.iterdir()), complaints) == (before, [])


DRIVE = "spec apart = G (a dist b >= 0.1)\n"


def test_a_bag_becomes_a_table_in_one_step(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_ros2(folder / "drive", drive(10))
    (folder / "m.yaml").write_text(MAPPING)
    (folder / "s.spatial").write_text(DRIVE)
    given = ["--mapping", "m.yaml", "--spec", "s.spatial"]
    assert run_in_process(["export", str(bag), *given, "-o", "a.csv"]) == 0
    assert run_in_process(["replay", str(bag), *given, "-o", "annotated2.mcap"]) == 0
    assert run_in_process(["export", "annotated2.mcap", "-o", "b.csv"]) == 0
    assert (folder / "a.csv").read_bytes() == (folder / "b.csv").read_bytes()
    # an annotated log is evaluated again where the command says how
    assert run_in_process(["export", "annotated2.mcap", "--to", "0.35s", "-o", "c.csv"]) == 0
    assert len((folder / "c.csv").read_text().splitlines()) == 1 + 4
    # before anything is evaluated, the name of the output is checked
    assert run_in_process(["export", str(bag), *given, "-o", "a.txt"]) == 2
    assert "ends in neither" in capsys.readouterr().err

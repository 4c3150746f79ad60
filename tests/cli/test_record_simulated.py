"""`spatial-replay record push` and its like, from outside."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cli.interruptions import interrupted
from cli.program import PROGRAM, environment, run_process, run_program
from replay.runs import content_of
from spatial_replay import read_trace
from spatial_replay.cli import run

LONG = ("record", "push", "-o", "run.mcap", "--duration", "3000s")


@pytest.fixture(autouse=True)
def _simulator() -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")


def test_equal_options_give_equal_bytes_in_every_process(tmp_path: Path) -> None:
    options = ("--seed", "7", "--noise", "0.001", "--inject", "slip@0.5s", "--duration", "1s")
    for name, hash_seed in [("one.mcap", "1"), ("two.mcap", "2")]:
        done = run_process("record", "push", "-o", name, *options, cwd=tmp_path, PYTHONHASHSEED=hash_seed)
        said = f"wrote {name}: 31 samples over 1.000 s of 3 objects: green, red, blue\n"
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout == said + "the robot: stopped in the middle of its motion\n"
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()
    about = dict(content_of(tmp_path / "one.mcap").metadata)["spatial_replay"]
    assert (about["source"], about["seed"]) == ("push", "7")
    assert json.loads(about["options"]) == {"seed": 7, "noise_m": 0.001, "inject": ["slip@0.5s"]}


def test_a_specification_replaces_that_of_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "a.spatial").write_text("spec left = F (red leftof blue)\n")
    options = ("-o", "run.mcap", "--duration", "100ms")
    assert run_program("record", "push", *options, "--spec", "a.spatial", cwd=tmp_path).returncode == 0
    kept = [name for name, _ in content_of(tmp_path / "run.mcap").attachments]
    assert "recorded/a.spatial" in kept
    assert "recorded/push.spatial" not in kept


def test_names_that_are_not_in_the_world_leave_the_output_untouched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, specification = tmp_path / "run.mcap", tmp_path / "a.spatial"
    path.write_text("kept")
    specification.write_text("spec left = F (gren leftof blue and speed >= 1)\n")
    assert run(["record", "push", "-o", str(path), "--spec", str(specification)]) == 2
    said = capsys.readouterr().err
    assert "a.spatial:1:16: error: the world never has the object 'gren'" in said
    assert "did you mean 'green'?" in said
    assert "the world never has the signal 'speed'" in said
    assert path.read_text() == "kept"


@pytest.mark.parametrize(
    "wrong", [["--inject", "drop@1s"], ["--duration", "0s"], ["--inject", "quake"], ["--noise", "inf"]]
)
def test_options_that_cannot_be_simulated_leave_the_output_untouched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: list[str]
) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("kept")
    assert run(["record", "push", "-o", str(path), *wrong]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("spatial-replay: error: ")
    assert path.read_text() == "kept"


@pytest.mark.parametrize(
    ("scenario", "module", "name"),
    [("push", "pybullet", "PyBullet"), ("table-setting", "py_trees", "py_trees")],
)
def test_without_the_extra_the_error_says_what_to_install(
    tmp_path: Path, scenario: str, module: str, name: str
) -> None:
    program = f"import sys; sys.modules[{module!r}] = None; from spatial_replay.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "record", scenario, "-o", "run.mcap"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert name in done.stderr
    assert "pip install 'spatial-replay[sim]'" in done.stderr
    assert not (tmp_path / "run.mcap").exists()


def test_an_interrupted_simulation_is_a_valid_shorter_log(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    code, said = interrupted([*PROGRAM, *LONG], signal.SIGINT, tmp_path, lambda: _size(path) > 10**5)
    assert (code, said.splitlines()) == (
        130,
        [
            "spatial-replay: error: interrupted",
            "  run.mcap holds the samples up to the interruption, and is marked as interrupted",
        ],
    )
    count = len(read_trace(path))
    assert count > 30
    ending = {"samples": str(count), "dropped": "0", "interrupted": "true"}
    assert dict(content_of(path).metadata)["spatial_replay_ending"] == ending


def test_a_killed_simulation_leaves_a_readable_log(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with subprocess.Popen(
        [*PROGRAM, *LONG], cwd=tmp_path, env=environment(), stdout=subprocess.DEVNULL
    ) as process:
        while _size(path) < 10**5 and process.poll() is None:
            time.sleep(0.01)
        process.kill()
    trace = read_trace(path, allow_damage=True)
    assert len(trace) > 30
    assert trace.names == ("blue", "green", "red")


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0

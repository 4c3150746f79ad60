"""`spatial-replay record`: files to logs, from outside."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from cli.interruptions import MANY, interrupted, write_many
from cli.program import PROGRAM, run_process, run_program
from replay.runs import content_of, run, write_tracks
from spatial_replay import read_trace
from spatial_replay.cli import run as run_in_process


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    return write_tracks(run(), tmp_path / "run.jsonl")


def test_the_command_reports_what_it_wrote(tracks: Path) -> None:
    done = run_program("record", "tracks", "run.jsonl", "-o", "run.mcap", cwd=tracks.parent)
    said = "wrote run.mcap: 12 samples over 2.750 s of 2 objects: cube, cup 物\n"
    assert (done.returncode, done.stdout, done.stderr) == (0, said, "")
    assert read_trace(tracks.parent / "run.mcap") == run()


def test_a_log_can_be_recorded_again(tracks: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tracks.parent)
    assert run_in_process(["record", "tracks", "run.jsonl", "-o", "once.mcap"]) == 0
    assert run_in_process(["record", "tracks", "once.mcap", "-o", "twice.mcap"]) == 0
    assert content_of(Path("once.mcap")).messages == content_of(Path("twice.mcap")).messages


def test_unknown_names_are_a_warning(
    tracks: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tracks.parent)
    Path("a.spatial").write_text("F cub ovlp cube")
    assert run_in_process(["record", "tracks", "run.jsonl", "--spec", "a.spatial", "-o", "run.mcap"]) == 0
    said = capsys.readouterr().err
    assert "a.spatial:1:3: warning: the log never has the object 'cub'" in said
    assert "'cube'" in said


def test_a_full_disk_gives_code_70_and_one_line(tracks: Path) -> None:
    if not Path("/dev/full").is_char_device():
        pytest.skip("no /dev/full here")
    done = run_process("record", "tracks", "run.jsonl", "-o", "/dev/full", cwd=tracks.parent)
    assert (done.returncode, done.stdout) == (70, "")
    expected = "spatial-replay: error: /dev/full could not be written: no space left on the device\n"
    assert done.stderr == expected


def test_an_interrupted_recording_is_a_valid_shorter_log(tmp_path: Path) -> None:
    write_many(tmp_path / "run.jsonl")
    (tmp_path / "a.spatial").write_text("spec s = F cube ovlp cube\nspec t = G cube ovlp cube\n")
    command = [*PROGRAM, "record", "tracks", "run.jsonl", "--spec", "a.spatial", "-o", "run.mcap"]
    code, said = interrupted(command, signal.SIGTERM, tmp_path, lambda: _size(tmp_path / "run.mcap") > 10**4)
    assert (code, said.splitlines()) == (
        130,
        [
            "spatial-replay: error: interrupted",
            "  run.mcap holds the samples up to the interruption, and is marked as interrupted",
        ],
    )
    count = len(read_trace(tmp_path / "run.mcap"))
    assert 0 < count < MANY
    content = content_of(tmp_path / "run.mcap")
    ending = {"samples": str(count), "dropped": "0", "interrupted": "true"}
    assert dict(content.metadata)["spatial_replay_ending"] == ending
    # and once more each about the recording as it ended
    assert len(content.of("/spatial/robustness")) == 2 * count + 2


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0

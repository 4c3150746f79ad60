"""`spatial-replay replay --watch`, as it is run in a terminal."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import time
from pathlib import Path
from threading import Thread

import pytest

from cli.program import PROGRAM, environment
from spatial_replay.cli import run

RECORDINGS = Path(__file__).parents[2] / "recordings"
LOG = str(RECORDINGS / "table.jsonl")


def test_the_table_follows_the_file_and_a_key_writes_constants(tmp_path: Path) -> None:
    path = tmp_path / "table.spatial"
    text = (RECORDINGS / "table.spatial").read_text()
    path.write_text(text)
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [*PROGRAM, "replay", LOG, "--spec", str(path), "--watch", "--const", "near=0.09"],
        env=environment(),
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        lines = iter(process.stdout.readline, "")

        def wait_for(said: str) -> None:
            passed = []
            for line in lines:
                passed.append(line)
                if said in line:
                    return
            pytest.fail(f"{said!r} is not in {passed}")

        wait_for("table_set  satisfied")
        wait_for("watching table.spatial; w writes constants into it")
        path.write_text(text.replace("deadline = 8s", "deadline = 1s"))
        wait_for("table.spatial saved")
        wait_for("table_set  violated")
        path.write_text(text.replace("const deadline", "cosnt deadline"))
        wait_for("error: ")
        wait_for("the evaluation before stays")
        path.write_text(text)
        wait_for("table_set  satisfied")
        os.write(ours, b"w")
        wait_for("near = 0.09 written into table.spatial")
        assert path.read_text() == text.replace("near = 0.08", "near = 0.09")
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
    os.close(ours)
    os.close(theirs)


def test_a_file_that_is_broken_at_the_start_is_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "table.spatial"
    text = (RECORDINGS / "table.spatial").read_text()
    shown: list[str] = []

    def wait_for(problem: str) -> None:
        said = ""
        while problem not in said or "waiting for table.spatial to be saved" not in said:
            time.sleep(0.02)
            said += capsys.readouterr().err

    def save() -> None:
        wait_for("no such file")
        path.write_text(text.replace("const deadline", "cosnt deadline"))
        wait_for("cosnt")
        path.write_text(text)
        while "watching table.spatial" not in (said := capsys.readouterr()).out:
            shown.append(said.out)
            time.sleep(0.02)
        shown.append(said.out)
        # Ctrl-C
        signal.raise_signal(signal.SIGINT)

    saving = Thread(target=save)
    saving.start()
    assert run(["replay", LOG, "--spec", str(path), "--watch"]) == 130
    saving.join()
    assert "table_set  satisfied" in "".join(shown)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--watch",), "give --spec FILE"),
        (
            ("--spec", str(RECORDINGS / "table.spatial"), "--watch", "--json", "-"),
            "--json is not for --watch",
        ),
        (("--spec", "none/none.spatial", "--watch"), "none.spatial: no such file"),
    ],
)
def test_what_cannot_be_watched_is_refused(
    options: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", LOG, *options]) == 2
    assert said in capsys.readouterr().err

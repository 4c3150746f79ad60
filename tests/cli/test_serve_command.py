"""`spatial-replay serve`, as it is run in a terminal or by a program."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cli.program import PROGRAM, environment, run_program
from serve.viewer import State, viewer
from spatial_replay.logs.topics import CURVES_TOPIC

RECORDINGS = Path(__file__).parents[2] / "recordings"
TABLE = ("serve", str(RECORDINGS / "table.jsonl"), "--spec", str(RECORDINGS / "table.spatial"))


@contextmanager
def running(
    *options: str, spec: Path = RECORDINGS / "table.spatial"
) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """The program at work, its address, and what it said until then."""
    with subprocess.Popen(
        [*PROGRAM, *TABLE[:-1], str(spec), *options],
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        said = ""
        while line := process.stdout.readline():
            said += line
            if found := re.search(r"serving at (ws://\S+);", line):
                try:
                    yield process, found[1], said
                except BaseException:
                    # or the test would wait for a server that no one stops
                    process.kill()
                    raise
                return
        pytest.fail(f"it ended: {process.communicate()[1]}")


def test_the_server_prints_verdict_and_address_and_stops_on_ctrl_c() -> None:
    with running("--port", "0") as (process, address, said):
        assert "table_set  satisfied" in said

        async def looking() -> None:
            async with viewer(address) as own:
                assert await own.constants() == {"deadline": 8, "near": 0.08}

        asyncio.run(looking())
        process.send_signal(signal.SIGINT)
        _, warned = process.communicate(timeout=60)
        assert (process.returncode, warned) == (130, "")


def test_play_starts_playing_at_once_with_the_chosen_semantics() -> None:
    options = ("--play", "--to", "5s", "--semantics", "paper")
    with running("--port", "0", *options) as (process, address, _):

        async def looking() -> None:
            async with viewer(address) as own:
                await own.subscribe()
                await own.next_of(State, lambda each: each.time_ns > 0)
                assert (await own.call("evaluate", {}))["semantics"] == "paper"
                with pytest.raises(ValueError, match="semantics"):
                    await own.call("explain", {})

        asyncio.run(looking())
        process.send_signal(signal.SIGINT)


def test_an_address_that_others_can_reach_is_a_warning_and_a_termination_ends_the_server() -> None:
    with running("--port", "0", "--host", "0.0.0.0") as (process, address, _):
        process.send_signal(signal.SIGTERM)
        _, warned = process.communicate(timeout=60)
    assert process.returncode == 130
    assert re.fullmatch(r"ws://0\.0\.0\.0:\d+/\?token=[\w-]{20,}", address)
    assert "who has this address, with its token, can read this log" in warned


def test_viewers_follow_a_saved_file_and_write_constants_into_it(tmp_path: Path) -> None:
    path = tmp_path / "table.spatial"
    text = (RECORDINGS / "table.spatial").read_text()
    path.write_text(text)
    edited = text.replace("near = 0.08", "near = 0.01").replace("deadline = 8s", "deadline = 9s")
    assert edited != text
    with running("--port", "0", "--watch", spec=path) as (process, address, _):

        async def looking() -> None:
            async with viewer(address) as own:
                await own.subscribe([CURVES_TOPIC])
                await own.message(CURVES_TOPIC)
                await own.send(op="subscribeParameterUpdates", parameterNames=["near", "deadline"])
                path.write_text(edited)
                assert "`table_set` is violated" in await own.summary("violated")
                assert await own.constants() == {"deadline": 9, "near": 0.01}
                path.write_text(edited.replace("const near", "cosnt near"))
                assert "cosnt" in await own.note("specification")
                assert await own.constants() == {"deadline": 9, "near": 0.01}
                path.write_text(edited)
                await own.set(near=0.09)
                assert "`table_set` is satisfied" in await own.summary("(near = 0.09)")
                # what was changed by hand stays while something else is edited, until it is written
                path.write_text(edited.replace("deadline = 9s", "deadline = 8s"))
                await own.summary("(near = 0.09)")
                answer = await own.call("write_constants", {})
                assert (answer["written"], answer["constants"]["near"]) == ({"near": 0.09}, 0.09)
                assert path.read_text() == text.replace("near = 0.08", "near = 0.09")
                with pytest.raises(ValueError, match="did you mean 'near'"):
                    await own.call("write_constants", {"constants": {"naer": 1}})

        asyncio.run(looking())
        process.send_signal(signal.SIGINT)
        said, warned = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "table.spatial saved" in said
    assert "the evaluation before stays" in warned


def test_the_layout_is_printed(tmp_path: Path) -> None:
    done = run_program(*TABLE, "--layout", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "Parameters!constants" in json.loads(done.stdout)["configById"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--host", "no.such.host.invalid"), "cannot listen at no.such.host.invalid"),
        (("--host", "8.8.8.8"), "choose an address of this machine with --host"),
        (("--host", ""), "cannot listen at no address"),
        (("--semantics", "stl"), "stl"),
        (("--port", "70000"), "70000"),
        (("--from", "99s"), "no sample in the requested window"),
    ],
)
def test_options_that_cannot_work_are_refused(options: tuple[str, ...], said: str, tmp_path: Path) -> None:
    done = run_program(*TABLE, *options, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr


def test_without_the_library_the_error_says_what_to_install(tmp_path: Path) -> None:
    program = "import sys; sys.modules['foxglove'] = None; from spatial_replay.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, *TABLE, "--port", "0"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 2
    assert "pip install 'spatial-replay[live]'" in done.stderr

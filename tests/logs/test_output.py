"""Output files appear when they are complete, and only their own errors are output errors."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import count
from pathlib import Path
from types import FrameType

import pytest

from spatial_replay import MissingFileError, OutputError, Recorder, UsageError, read_trace
from spatial_replay.logs.output_file import open_output, refuse_inputs, replacing


def test_an_output_appears_when_it_is_complete(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with replacing(output) as stream:
        stream.write(b"whole")
        assert not output.exists()
    assert output.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [output]


def test_an_error_of_the_block_is_not_an_output_error(tmp_path: Path) -> None:
    output = tmp_path / "out"
    output.write_bytes(b"before")
    with pytest.raises(FileNotFoundError, match="absent"), replacing(output) as stream:
        stream.write(b"half")
        (tmp_path / "absent").read_bytes()
    assert output.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [output]


# a file that an interruption leaves open is closed when it is collected
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_interrupted_at_any_step_an_output_is_whole_or_not_there(tmp_path: Path) -> None:
    output, before = tmp_path / "out", sys.gettrace()
    left = 0

    def step(frame: FrameType, event: str, _: object) -> object:
        nonlocal left
        left -= event == "line"
        if left == 0:
            sys.settrace(before)
            raise KeyboardInterrupt
        return step

    for at in count(1):
        left = at
        try:
            sys.settrace(step)
            with replacing(output) as stream:
                stream.write(b"whole")
        except KeyboardInterrupt:
            pass
        finally:
            sys.settrace(before)
        if left > 0:
            break
        assert [each.name for each in tmp_path.iterdir()] in ([], ["out"]), at
        if output.exists():
            assert output.read_bytes() == b"whole"
            output.unlink()
    assert at > 50


@pytest.mark.parametrize("size", [1, 1 << 22], ids=["when it is closed", "while it is written"])
@pytest.mark.parametrize("opened", [replacing, open_output])
def test_a_full_disk_is_an_output_error_from_any_writer(opened: type, size: int) -> None:
    full = Path("/dev/full")
    if not full.is_char_device():
        pytest.skip("no /dev/full here")
    with (
        pytest.raises(OutputError, match="/dev/full could not be written: no space left"),
        opened(full) as stream,
    ):
        stream.write(bytes(size))


def test_a_file_that_cannot_be_opened_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="absent/out could not be written: "):
        open_output(tmp_path / "absent" / "out")


def test_nothing_is_written_into_a_log_that_is_a_folder(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    (bag / "inner").mkdir(parents=True)
    for output in (
        bag / "out.mcap",
        bag / "inner" / "out.mcap",
        tmp_path / "bag" / ".." / "bag" / "out.mcap",
    ):
        with pytest.raises(UsageError, match="is an input; write it elsewhere"):
            refuse_inputs(output, [bag])
    refuse_inputs(tmp_path / "bag.mcap", [bag])


@pytest.mark.parametrize("name", ["a" * 300, "a\0b"])
def test_a_name_that_no_file_can_have_is_an_error_of_its_own(tmp_path: Path, name: str) -> None:
    with pytest.raises(MissingFileError, match=r"too long|null"):
        read_trace(tmp_path / name)
    with pytest.raises(UsageError, match="give the output another name"):
        Recorder(tmp_path / name)


def test_a_conversion_that_does_not_fit_on_the_disk_leaves_no_half_log(tmp_path: Path) -> None:
    with (tmp_path / "tracks.jsonl").open("w") as stream:
        for tick in range(3_000):
            box = {"name": "a", "polygon": [[0, 0], [1, 0], [1, 1 + tick]]}
            stream.write(json.dumps({"time_ns": tick, "objects": [box]}) + "\n")
    # bytecode must not be cut off at that size, where other tests would find it
    program = (
        "import resource, signal, sys; sys.dont_write_bytecode = True; from spatial_replay.cli import run;"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000));"
        "sys.exit(run(['record', 'tracks', 'tracks.jsonl', '-o', 'run.mcap']))"
    )
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "run.mcap could not be written" in ended.stderr, ended
    assert not (tmp_path / "run.mcap").exists()

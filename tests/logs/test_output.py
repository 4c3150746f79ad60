"""Output files appear when they are complete, and only their own errors are output errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from spatial_replay import OutputError, UsageError
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

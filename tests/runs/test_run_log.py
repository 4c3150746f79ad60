"""The log of a run: samples, and messages about decisions in between."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import spatial_replay as sr
from spatial_replay.logs.messages import Channel, Messages
from spatial_replay.replay.verification import verify_certificate
from spatial_replay.runs.scripted import RunLog, run_log
from spatial_replay.sources import open_source

REMARKS = Channel("/remarks", "json", None)


def sample(number: int) -> sr.Sample:
    return sr.Sample(number * 10**8, {"cup": sr.Footprint.disc(number / 10, 0, 1)})


def remark(number: int, sequence: int) -> Messages:
    time = np.array([number * 10**8], np.int64)
    return Messages(
        {0: REMARKS}, np.zeros(1, np.int64), np.array([sequence]), time, time, [b'{"at": %d}' % number]
    )


def remarks(path: Path) -> list[bytes]:
    return [each for batch, _ in open_source(path).iter_payloads("/remarks") for each in batch]


@pytest.mark.parametrize("every", [1, 7, 30, 31])
def test_messages_and_samples_make_one_log_with_one_certificate(tmp_path: Path, every: int) -> None:
    numbers = list(range(0, 100, every))
    with run_log(tmp_path / "run.mcap") as log:
        for number in range(100):
            log.write(sample(number))
            if number in numbers:
                log.write_messages(remark(number, numbers.index(number)))
    assert remarks(tmp_path / "run.mcap") == [b'{"at": %d}' % number for number in numbers]
    assert len(sr.read_trace(tmp_path / "run.mcap")) == 100
    verified = verify_certificate(open_source(tmp_path / "run.mcap"))
    assert verified.recorded
    assert verified.differences == ()


def test_no_message_is_lost_at_the_end(tmp_path: Path) -> None:
    with run_log(tmp_path / "run.mcap") as log:
        log.write(sample(0))
        log.flush()
        log.write_messages(remark(0, 0))
    assert remarks(tmp_path / "run.mcap") == [b'{"at": 0}']


def test_samples_written_before_an_error_can_be_read(tmp_path: Path) -> None:
    def fail(log: RunLog) -> None:
        log.write(sample(0))
        log.write_messages(remark(0, 0))
        raise RuntimeError("the robot is on fire")

    with pytest.raises(RuntimeError, match="fire"), run_log(tmp_path / "run.mcap") as log:
        fail(log)
    assert len(sr.read_trace(tmp_path / "run.mcap")) == 1
    assert remarks(tmp_path / "run.mcap") == [b'{"at": 0}']
    ending = dict(open_source(tmp_path / "run.mcap").metadata())["spatial_replay_ending"]
    assert ending["interrupted"] == "true"

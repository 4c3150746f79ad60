"""What a script learns from the exit code."""

from __future__ import annotations

import errno
import random

import click
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay import errors
from spatial_replay.cli.application import (
    ExitCode,
    exit_code_from_error,
    exit_code_from_verdicts,
    message_from_error,
    most_severe,
)
from spatial_replay.spec.diagnostics import Diagnostic

FAULT = Diagnostic("error", "unknown relation 'ovlap'", "a.spatial", 1, 3, "a ovlap b", 5)
ORDER = (130, 70, 2, 3, 1, 4, 0)
codes = st.sampled_from([ExitCode(code) for code in ORDER])


@given(st.lists(codes, min_size=1), st.randoms(use_true_random=False))
def test_of_several_codes_the_most_severe_stands_whatever_their_order(
    several: list[ExitCode], source: random.Random
) -> None:
    expected = next(code for code in ORDER if code in several)
    source.shuffle(several)
    assert most_severe(several) == expected


@pytest.mark.parametrize(
    ("verdicts", "damaged", "code"),
    [
        ([], False, 0),
        (["satisfied", "satisfied"], False, 0),
        (["satisfied", "unknown"], False, 4),
        (["unknown", "violated", "satisfied"], False, 1),
        (["satisfied"], True, 3),
        (["violated"], True, 3),
    ],
)
def test_verdicts_determine_the_exit_code(verdicts: list[str], damaged: bool, code: int) -> None:
    assert exit_code_from_verdicts(verdicts, damaged) == code


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), 130),
        (click.Abort(), 130),
        (click.UsageError("no"), 2),
        (click.FileError("x"), 2),
        (errors.UsageError("no"), 2),
        (errors.MissingFileError("no"), 2),
        (errors.SpecificationError([FAULT]), 2),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "x"), 2),
        (errors.LogError("no"), 3),
        (errors.TraceError("no"), 3),
        (errors.GeometryError("no"), 3),
        (errors.OutputError("no"), 70),
        (OSError(errno.ENOSPC, "No space left on device", "x"), 70),
        (MemoryError(), 70),
        (RuntimeError("no"), 70),
    ],
)
def test_every_error_has_an_exit_code_and_a_short_message(error: BaseException, code: int) -> None:
    assert exit_code_from_error(error) == code
    message = message_from_error(error)
    assert message
    assert len(message.splitlines()) <= 3


def test_an_internal_error_asks_for_a_report_and_a_full_disk_does_not() -> None:
    assert "please report" in message_from_error(ZeroDivisionError("division by zero"))
    full = OSError(errno.ENOSPC, "No space left on device", "run.mcap")
    assert message_from_error(full) == "run.mcap: No space left on device"

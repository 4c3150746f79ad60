"""What the process says when it ends."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of every command."""

    SATISFIED = 0
    VIOLATED = 1
    USAGE = 2
    """Wrong usage, a missing file, a faulty specification or mapping, an output that is an input."""
    DAMAGED = 3
    """The log is damaged or breaks its format."""
    UNKNOWN = 4
    """No violation, but at least one specification stays unknown."""
    FAULT = 70
    """A fault of this program or of the machine."""
    INTERRUPTED = 130
    CLOSED_PIPE = 141
    """Whoever read the output left; the code a shell gives to a program that this signal ends."""


_VERDICTS = {"satisfied": ExitCode.SATISFIED, "violated": ExitCode.VIOLATED, "unknown": ExitCode.UNKNOWN}
_GRAVITY = (
    ExitCode.CLOSED_PIPE,
    ExitCode.INTERRUPTED,
    ExitCode.FAULT,
    ExitCode.USAGE,
    ExitCode.DAMAGED,
    ExitCode.VIOLATED,
    ExitCode.UNKNOWN,
    ExitCode.SATISFIED,
)


def gravest(codes: Iterable[ExitCode]) -> ExitCode:
    """The code that stands for several; `SATISFIED` for none."""
    return min(codes, key=_GRAVITY.index, default=ExitCode.SATISFIED)


def exit_code_from_verdicts(verdicts: Iterable[str], damaged: bool = False) -> ExitCode:
    """The code for the verdicts "satisfied", "violated" and "unknown" of an evaluation.

    Args:
        damaged: whether the log lost something, so that the verdicts are those of what was left.
    """
    codes = [_VERDICTS[verdict] for verdict in verdicts]
    return gravest([*codes, ExitCode.DAMAGED] if damaged else codes)

"""The program under attack, in this process or in a forked process."""

from __future__ import annotations

import faulthandler
import io
import os
import re
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from typing import NamedTuple

from spatial_replay.cli import run

CODES = (0, 1, 2, 3, 4)
PATIENCE_S = 120.0
"""How long a command on a terminal may take."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_OURS = re.compile(
    r"\x1b\[(?:[0-3]|[39][0-7]|38;5;\d+|22|0;\d\d)?m|\r(?:\x1b\[1A)?\x1b\[2K|\x1b\[(?:1A|2K|\?25[lh])|\r\n"
)
"""Colours, line ends of a terminal, and the moves of the progress bar."""


class Said(NamedTuple):
    """Output of a command.

    Attributes:
        printed, said: standard output, and standard error.
    """

    arguments: Sequence[str]
    code: int
    printed: str
    said: str


def said_by(arguments: Sequence[str]) -> Said:
    """Run a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(list(arguments))
    return Said(arguments, code, out.getvalue(), err.getvalue())


def problems_of(said: Said, codes: Sequence[int] = CODES) -> list[str]:
    """Return the problems of a command's output and exit code."""
    problems = []
    command = " ".join(said.arguments[:1])
    if said.code not in codes:
        problems.append(f"{command} exits with {said.code}: {said.said[-400:]}")
    if "Traceback" in said.said or "internal error" in said.said:
        problems.append(f"{command} has an internal error: {said.said[-400:]}")
    if said.code in (2, 3) and not said.said.strip():
        problems.append(f"{command} exits with {said.code} and says nothing")
    if wrong := unprintable(said.printed + said.said):
        problems.append(f"{command} prints {wrong!r}")
    return problems


def unprintable(text: str) -> str:
    """Return the unprintable parts of a text for a terminal, except our colours and the progress bar."""
    plain = _OURS.sub("", text)
    return "".join(each for each in plain if not each.isprintable() and each != "\n")[:40]


def on_terminal(
    arguments: Sequence[str], during: Callable[[int], None] = lambda process: None
) -> tuple[int, bytes]:
    """Run a command in a forked process on a terminal; return its exit code and its output.

    Args:
        during: called with the process id while the process runs.
    """
    ours, theirs = os.openpty()
    # a signal waits until the program is there to take it
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    process = os.fork()
    if process == 0:
        _become(theirs, arguments)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    os.close(theirs)
    during(process)
    written = bytearray()
    end_s = time.monotonic() + PATIENCE_S
    # how Linux says that the other end of a terminal is closed
    with suppress(OSError):
        while True:
            if not select.select([ours], [], [], max(0.0, end_s - time.monotonic()))[0]:
                # it prints where each of its threads is, and ends
                os.kill(process, signal.SIGABRT)
                end_s += PATIENCE_S
            if not (block := os.read(ours, 65_536)):
                break
            written += block
    os.close(ours)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), bytes(written)


def _become(terminal: int, arguments: Sequence[str]) -> None:
    """Run the program in this process, and end the process."""
    code = 70
    try:
        for descriptor in (0, 1, 2):
            os.dup2(terminal, descriptor)
        for name in ("stdin", "stdout", "stderr"):
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, os.fdopen(os.dup(1), mode, encoding="utf-8", errors="backslashreplace"))
        faulthandler.enable(sys.stderr)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.argv = ["spatial-replay", *arguments]
        from spatial_replay.cli.application import main

        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        main()
    except SystemExit as leaving:
        code = int(leaving.code or 0)
    except KeyboardInterrupt:
        code = 130
    finally:
        with suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def interrupt_after(seconds: float, number: int) -> Callable[[int], None]:
    """Return a function that sends a signal to a process after some time."""

    def send(process: int) -> None:
        time.sleep(seconds)
        with suppress(ProcessLookupError):
            os.kill(process, number)

    return send

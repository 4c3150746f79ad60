"""Running the program as a user does, in this process or in one of its own."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Mapping
from contextlib import chdir
from pathlib import Path

from click.testing import CliRunner

from spatial_replay.cli import run

PROGRAM = (sys.executable, "-m", "spatial_replay")


def environment(**variables: str) -> dict[str, str]:
    """This process' environment without what changes colours, with some variables set."""
    kept = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "FORCE_COLOR")}
    return {**kept, "TERM": "xterm", **variables}


def run_program(*arguments: str, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the program in this process, from a folder; it finds pipes as standard output and error."""
    unset = {"NO_COLOR": None, "FORCE_COLOR": None}
    with chdir(cwd), CliRunner().isolation(env=unset | {"TERM": "xterm"} | variables) as (out, err, _):
        code = run(arguments)
        sys.stderr.flush()
    return subprocess.CompletedProcess(arguments, code, out.getvalue().decode(), err.getvalue().decode())


def run_process(*arguments: str, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the program in a process of its own."""
    return subprocess.run(
        [*PROGRAM, *arguments],
        cwd=cwd,
        env=environment(**variables),
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def standard_error_on_terminal(command: tuple[str, ...], cwd: Path, variables: Mapping[str, str]) -> str:
    """What a command writes to standard error if that is a terminal."""
    return written_on_terminal(command, cwd, variables, subprocess.DEVNULL)


def written_on_terminal(
    command: tuple[str, ...], cwd: Path, variables: Mapping[str, str], stdout: int | None = None
) -> str:
    """What a command writes to a terminal, to standard output unless that goes elsewhere, too."""
    ours, theirs = pty.openpty()
    output = theirs if stdout is None else stdout
    with subprocess.Popen(command, cwd=cwd, env=environment(**variables), stdout=output, stderr=theirs):
        os.close(theirs)
        written = bytearray()
        try:
            while block := os.read(ours, 4096):
                written += block
        except OSError:
            # how Linux says that the other end of a terminal is closed
            pass
        finally:
            os.close(ours)
    return written.decode()

"""The program `spatial-replay`: its commands, and how every error ends."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

import click

from spatial_replay import __version__
from spatial_replay.cli.commands import LazyCommands
from spatial_replay.cli.exit_codes import ExitCode
from spatial_replay.cli.failures import exit_code_of, report

PROGRAM = "spatial-replay"
COMPLETION_VARIABLE = "_SPATIAL_REPLAY_COMPLETE"


@click.group(
    cls=LazyCommands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Exit codes: 0 satisfied, 1 violated, 4 unknown; 2 usage or specification, 3 damaged log, "
    "70 fault of the program or the machine, 130 interrupted.",
)
@click.version_option(__version__, "-V", "--version", prog_name=PROGRAM, message="%(prog)s %(version)s")
def application() -> None:
    """Say whether a recorded run did what it should, where and when, and by how much.

    \b
    Example:
      spatial-replay check blocks.spatial --log run.mcap
    """


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the program with these arguments (those of the process without any) and return its exit code."""
    try:
        code = application.main(
            args=None if arguments is None else list(arguments),
            prog_name=PROGRAM,
            complete_var=COMPLETION_VARIABLE,
            standalone_mode=False,
            color=False if os.environ.get("NO_COLOR") else None,
        )
        sys.stdout.flush()
    except SystemExit as leaving:
        # click leaves by itself in two cases: it has completed a line for a shell, or the pipe is closed
        return int(leaving.code or 0) if COMPLETION_VARIABLE in os.environ else ExitCode.CLOSED_PIPE
    except BrokenPipeError:
        # what is still buffered has no reader either, and must not fail again when the process ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.CLOSED_PIPE
    except (Exception, KeyboardInterrupt) as error:
        report(error)
        return exit_code_of(error)
    return int(code or 0)


def main() -> NoReturn:
    """The program's entry point; a request to terminate ends it as Ctrl-C does, with everything put away."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(run())

"""The program `spatial-replay`: its commands, and how every error ends.

The commands by name, each imported when it is used.

`--help` lists them without loading any: importing one may load the compiler and the readers of logs.

What the process says when it ends.

From an error to an exit code and a message of a few lines.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Iterable, Sequence
from enum import IntEnum
from importlib import import_module
from typing import NoReturn

import click

from spatial_replay import __version__
from spatial_replay.errors import (
    GeometryError,
    LogError,
    OutputError,
    SpatialReplayError,
    SpecificationError,
    TraceError,
    UsageError,
)

COMMANDS: dict[str, str] = {
    "check": "Check a specification and show its tree.",
    "completion": "Print the script that completes commands in a shell.",
    "explain": "Say why a verdict is what it is.",
    "export": "Write an annotated log's numbers as a table.",
    "info": "Say what a log holds.",
    "plan": "Plan a run in a simulated world.",
    "record": "Record a run as a log.",
    "replay": "Evaluate specifications over a log.",
    "report": "Write what a run did as one page.",
    "serve": "Look at a replay in a viewer, and change constants there.",
    "verify": "Say whether a log is what it says it is.",
}
"""Name and summary; `spatial_replay/cli/NAME.py` holds the command under its name."""


class LazyCommands(click.Group):
    """A group of the commands in `COMMANDS`."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command = getattr(import_module(f"spatial_replay.cli.{cmd_name}"), cmd_name)
        if not isinstance(command, click.Command):
            raise TypeError(f"spatial_replay.cli.{cmd_name}.{cmd_name} is no command but {command!r}")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


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


DEBUG_VARIABLE = "SPATIAL_REPLAY_DEBUG"

_CODES: tuple[tuple[type[BaseException] | tuple[type[BaseException], ...], ExitCode], ...] = (
    ((click.Abort, KeyboardInterrupt), ExitCode.INTERRUPTED),
    ((click.ClickException, UsageError, SpecificationError), ExitCode.USAGE),
    ((LogError, TraceError, GeometryError), ExitCode.DAMAGED),
    (OutputError, ExitCode.FAULT),
    ((FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError), ExitCode.USAGE),
)


def exit_code_of(error: BaseException) -> ExitCode:
    """The exit code for an error that ended a command."""
    for kinds, code in _CODES:
        if isinstance(error, kinds):
            return code
    return ExitCode.FAULT


def message_of(error: BaseException) -> str:
    """What an error says to the one who ran the command."""
    match error:
        case click.Abort() | KeyboardInterrupt():
            # the command line's library puts an error of its own in the place of the interruption
            notes = getattr(error.__cause__ or error, "__notes__", ())
            return "\n  ".join(["interrupted", *notes])
        case click.UsageError(ctx=click.Context() as context):
            return f"{error.format_message()}\n  '{context.command_path} --help' shows what it takes"
        case click.ClickException():
            return error.format_message()
        case SpecificationError(diagnoses=[_, *_] as diagnoses):
            count = "one fault" if len(diagnoses) == 1 else f"{len(diagnoses)} faults"
            return f"the specification has {count}, shown above"
        case SpatialReplayError():
            return str(error)
        case OSError(strerror=str(reason)):
            return f"{error.filename}: {reason}" if error.filename is not None else reason
        case MemoryError():
            return "the machine has no memory left for this"
        case _:
            kind = type(error).__name__
            return (
                f"a fault of spatial-replay itself: {kind}: {error}\n"
                f"  please report it, with the output of the same command under {DEBUG_VARIABLE}=1"
            )


def report(error: BaseException) -> None:
    """Write an error to standard error; with its traceback if SPATIAL_REPLAY_DEBUG is set."""
    if os.environ.get(DEBUG_VARIABLE):
        click.echo("".join(traceback.format_exception(error)), err=True, nl=False)
    if isinstance(error, SpecificationError):
        for diagnosis in error.diagnoses:
            click.echo(diagnosis, err=True)
    say("error", message_of(error), colour="red")


def say(severity: str, message: str, colour: str) -> None:
    """Write a remark to standard error: "spatial-replay: warning: ...", in colour on a terminal."""
    coloured = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    label = click.style(f"{severity}:", fg=colour, bold=True) if coloured else f"{severity}:"
    click.echo(f"spatial-replay: {label} {message}", err=True, color=coloured)


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

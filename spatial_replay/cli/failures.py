"""From an error to an exit code and a message of a few lines."""

from __future__ import annotations

import os
import sys
import traceback

import click

from spatial_replay.cli.exit_codes import ExitCode
from spatial_replay.errors import (
    GeometryError,
    LogError,
    OutputError,
    SpatialReplayError,
    SpecificationError,
    TraceError,
    UsageError,
)

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

"""The program `spatial-replay`: its commands, its exit codes, and its reports of errors.

A command is imported when it is used, because the import may load numba and the log readers. `--help` lists
the commands without importing them.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterable, Sequence
from enum import IntEnum
from importlib import import_module
from types import FrameType
from typing import Any, NoReturn

import click

from spatial_replay.cli.terminal import PROGRAM, show, show_diagnostics, show_message
from spatial_replay.errors import (
    GeometryError,
    LogError,
    OutputError,
    SpatialReplayError,
    SpecificationError,
    TraceError,
    UsageError,
)
from spatial_replay.text import nearest_hint, plural
from spatial_replay.version import __version__

COMPLETION_VARIABLE = "_SPATIAL_REPLAY_COMPLETE"
DEBUG_VARIABLE = "SPATIAL_REPLAY_DEBUG"

GROUPS: dict[str, dict[str, str]] = {
    "Start here": {
        "record": "Record a run as a log.",
        "replay": "Evaluate specifications over a log.",
        "explain": "Explain a verdict.",
        "report": "Write an HTML report of a run.",
        "serve": "Replay live to a viewer that can change constants.",
    },
    "Specifications": {
        "check": "Check a specification and print its tree.",
        "doctor": "Find faults of a specification before any run.",
        "distinguish": "Find a run that one of two specifications accepts.",
        "tune": "Find the constants that fit recorded runs.",
        "learn": "Find a specification that distinguishes good runs from bad ones.",
        "falsify": "Search for simulated runs that violate a specification.",
    },
    "Logs": {
        "info": "Show the content of a log.",
        "clip": "Copy the smallest part of a log that shows a verdict.",
        "diff": "Compare two specifications over a log, or two logs.",
        "verify": "Recompute a log's certificate and compare.",
        "recover": "Save the readable part of a damaged log.",
        "export": "Export the robustness of every node as a table.",
        "tags": "Print AprilTags, and calibrate a camera.",
    },
    "Many logs": {
        "batch": "Evaluate many logs, and show the failures.",
        "judge": "Judge episodes, and check their success labels.",
        "results": "Show the results of a batch.",
    },
    "Live": {"monitor": "Monitor a running robot."},
    "Agents": {"mcp": "Serve the commands as tools of agents."},
    "Planning": {"plan": "Plan a run in a simulated world."},
}
"""Commands by the headings of the help, with their summaries."""

COMMANDS: dict[str, str] = {
    **{name: summary for group in GROUPS.values() for name, summary in group.items()},
    "completion": "Print a shell completion script.",
    "warmup": "Compile everything once, for images.",
}
"""Summaries by name, also of hidden commands; `cli/NAME.py` defines the command NAME."""

FAMILIES = {
    "results": "batch",
    "doctor": "check",
    "learn": "tune",
    "report": "replay",
    "export": "replay",
    "explain": "replay",
    "recover": "clip",
    "verify": "clip",
    "serve": "replay",
}
"""Commands that are defined in the module of another command."""

FORMER_OPTIONS = {
    "--max-gap": "write --read max_gap=T",
    "--max-lateness": "write --read max_lateness=T",
    "--plugin": "allow the module in pyproject.toml: [tool.spatial-replay] plugins = [MODULE]",
    "--profile": "write `use spatial_spec` in the first line of the specification",
    "--result": "explain takes it: spatial-replay explain LOG --spec SPEC --result NAME",
}
"""Remedies for options of earlier versions and of other commands."""


class LazyCommands(click.Group):
    """A group of the commands in `COMMANDS`."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def invoke(self, ctx: click.Context) -> Any:
        # imported here so that --help stays fast
        from spatial_replay.cli.terminal import progress
        from spatial_replay.logs.remote import showing_downloads

        with showing_downloads(progress):
            return super().invoke(ctx)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f"spatial_replay.cli.{FAMILIES.get(cmd_name, cmd_name)}")
        command: click.Command = getattr(module, cmd_name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            hint = nearest_hint(name, COMMANDS) or f"the commands are {', '.join(COMMANDS)}"
            ctx.fail(f"no command is named {name!r}; {hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, COMMANDS))
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), summary) for name, summary in commands.items()])


@click.group(
    cls=LazyCommands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Exit codes: 0 satisfied, 1 violated, 4 unknown, untested or doubtful; 2 usage error or "
    "invalid specification, 3 damaged log, 70 internal or system error, 130 interrupted.",
)
@click.version_option(__version__, "-V", "--version", prog_name=PROGRAM, message="%(prog)s %(version)s")
def application() -> None:
    """Check whether a recorded run satisfies its specification: where, when, and by how much.

    \b
    Example:
      spatial-replay check blocks.spatial --log run.mcap
    """


def main() -> NoReturn:
    """Run the program and exit."""
    # SIGTERM cleans up as Ctrl-C does; background jobs of a shell ignore Ctrl-C
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGALRM, _interrupt)
    sys.unraisablehook = _interrupt_again
    # a short run has little garbage, and a hundred collections take 5 % of its time
    gc.set_threshold(50_000, 20, 20)
    exit_code = run()
    if exit_code == ExitCode.INTERRUPTED:
        _end_waiting_threads(exit_code)
    sys.exit(exit_code)


_PATIENCE_S = 0.5
"""Time that an interrupted program waits for its threads, seconds."""


def _end_waiting_threads(exit_code: int) -> None:
    """End the process if a thread still waits, for example for data of a pipe."""
    deadline_s = time.monotonic() + _PATIENCE_S
    main_thread = threading.main_thread()
    # a thread that was interrupted before its start has no `ident`, and cannot be joined
    threads = [
        thread
        for thread in threading.enumerate()
        if thread is not main_thread and not thread.daemon and thread.ident is not None
    ]
    for thread in threads:
        thread.join(max(deadline_s - time.monotonic(), 0.0))
    if any(thread.is_alive() for thread in threads):
        # `sys.exit` would wait for the thread
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(exit_code)


_AGAIN_S = 0.05
"""Delay before an ignored interruption is repeated, seconds."""


class _Interruption(KeyboardInterrupt):
    """An interruption that can be caught everywhere.

    A plain KeyboardInterrupt may pass through an `exec`, as in the definition of a dataclass. The interpreter
    then ends the process by SIGINT, even if the exception is caught.
    """


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise _Interruption


def _interrupt_again(ignored: sys.UnraisableHookArgs) -> None:
    """Repeat an ignored interruption after a moment. A callback of numba, for example, ignores it."""
    if isinstance(ignored.exc_value, _Interruption):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
    else:
        sys.__unraisablehook__(ignored)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the program, and return its exit code.

    Args:
        arguments: command line without the program's name; None for the arguments of the process.
    """
    try:
        exit_code = application.main(
            args=None if arguments is None else list(arguments),
            prog_name=PROGRAM,
            complete_var=COMPLETION_VARIABLE,
            standalone_mode=False,
            # https://no-color.org
            color=False if os.environ.get("NO_COLOR") else None,
        )
        sys.stdout.flush()
    except SystemExit as exit_request:
        # click exits by itself in two cases: after completing a line for a shell, and on a broken pipe
        return int(exit_request.code or 0) if COMPLETION_VARIABLE in os.environ else ExitCode.BROKEN_PIPE
    except BrokenPipeError:
        # buffered output must not fail again at exit:
        # https://docs.python.org/3/library/signal.html#note-on-sigpipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.BROKEN_PIPE
    except (Exception, KeyboardInterrupt) as error:
        # click raises Abort for an interruption and for every EOFError; their causes differ
        is_end_of_file = isinstance(error, click.Abort) and isinstance(error.__cause__, EOFError)
        reported_error = error.__cause__ or error if is_end_of_file else error
        report_error(reported_error)
        return exit_code_from_error(reported_error)
    return int(exit_code or 0)


class ExitCode(IntEnum):
    """Exit codes of every command."""

    SATISFIED = 0
    VIOLATED = 1
    USAGE = 2
    """Wrong usage, a missing file, an invalid specification or mapping, an output that is an input."""
    DAMAGED = 3
    """The log is damaged or breaks its format."""
    UNKNOWN = 4
    """No violation, but at least one specification stays unknown."""
    INTERNAL = 70
    """An internal error, or a failure of the machine."""
    INTERRUPTED = 130
    BROKEN_PIPE = 141
    """The reader of the pipe closed it. Shells report SIGPIPE with this code."""


_VERDICTS = {
    "satisfied": ExitCode.SATISFIED,
    "violated": ExitCode.VIOLATED,
    "unknown": ExitCode.UNKNOWN,
    "pending": ExitCode.UNKNOWN,
}
_MOST_SEVERE_FIRST = (
    ExitCode.BROKEN_PIPE,
    ExitCode.INTERRUPTED,
    ExitCode.INTERNAL,
    ExitCode.USAGE,
    ExitCode.DAMAGED,
    ExitCode.VIOLATED,
    ExitCode.UNKNOWN,
    ExitCode.SATISFIED,
)


def most_severe(codes: Iterable[ExitCode]) -> ExitCode:
    """Return the most severe of several codes; `SATISFIED` for none."""
    return min(codes, key=_MOST_SEVERE_FIRST.index, default=ExitCode.SATISFIED)


def exit_code_from_verdicts(verdicts: Iterable[str], damaged: bool = False) -> ExitCode:
    """Return the code for the verdicts of an evaluation; "pending" counts as "unknown".

    Args:
        damaged: whether parts of the log are missing; the verdicts cover the readable parts.
    """
    codes = [_VERDICTS[verdict] for verdict in verdicts]
    return most_severe([*codes, ExitCode.DAMAGED] if damaged else codes)


_CODES: tuple[tuple[type[BaseException] | tuple[type[BaseException], ...], ExitCode], ...] = (
    ((click.Abort, KeyboardInterrupt), ExitCode.INTERRUPTED),
    ((click.ClickException, UsageError, SpecificationError), ExitCode.USAGE),
    ((LogError, TraceError, GeometryError), ExitCode.DAMAGED),
    (OutputError, ExitCode.INTERNAL),
    ((FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError), ExitCode.USAGE),
)


def exit_code_from_error(error: BaseException) -> ExitCode:
    """Return the exit code for an error that ended a command."""
    return next((code for kinds, code in _CODES if isinstance(error, kinds)), ExitCode.INTERNAL)


def message_from_error(error: BaseException) -> str:
    """Return the message of an error for the user, in a few lines."""
    match error:
        case click.Abort() | KeyboardInterrupt():
            # click replaces the interruption by an Abort; the interruption is its cause, and has the notes
            notes = getattr(error.__cause__ or error, "__notes__", ())
            return "\n  ".join(["interrupted", *notes])
        case click.UsageError(ctx=click.Context() as context):
            command_path, message = context.command_path, error.format_message()
            if isinstance(error, click.MissingParameter):
                # click lists the choices of a parameter one per line, after tabs
                message = " ".join(message.split())
            if isinstance(error, click.NoSuchOption):
                remedy = new_form(error.option_name, context.command)
                message = f"no option {error.option_name}; {remedy}" if remedy else message
            parameters = context.command.params
            if "unexpected extra" in message and any("--spec" in parameter.opts for parameter in parameters):
                message += (
                    f"; specifications come after --spec: {command_path} LOG --spec FILE; "
                    "batch takes many logs"
                )
            if "'--spec'" in message and any(parameter.name == "specification" for parameter in parameters):
                message += f" {command_path} FILE takes the specification without it."
            return f"{message}\n  see '{command_path} --help'"
        case click.ClickException():
            return error.format_message()
        case SpecificationError(diagnoses=[_, *_] as diagnoses):
            return f"the specification has {plural(len(diagnoses), 'error')}, shown above"
        case SpatialReplayError():
            return str(error)
        case OSError(strerror=str(reason)):
            return f"{error.filename}: {reason}" if error.filename is not None else reason
        case MemoryError():
            return "out of memory"
        case _:
            return (
                f"internal error: {type(error).__name__}: {error}\n"
                f"  please report it, with the output of the same command under {DEBUG_VARIABLE}=1"
            )


def new_form(option: str, command: click.Command) -> str | None:
    """Return the remedy for an option of an earlier version; None for any other option."""
    from spatial_replay.mapping.yaml_document import schema_of

    setting_key = option.removeprefix("--").replace("-", "_")
    has_settings = any("--set" in parameter.opts for parameter in command.params)
    if has_settings and setting_key in schema_of("planning", "settings")["properties"]:
        return f"write --set {setting_key}=VALUE"
    return FORMER_OPTIONS.get(option)


def report_error(error: BaseException) -> None:
    """Write an error to standard error. SPATIAL_REPLAY_DEBUG adds the traceback."""
    if os.environ.get(DEBUG_VARIABLE):
        show(*"".join(traceback.format_exception(error)).splitlines(), err=True)
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        # a command without arguments shows its help, which is no error message
        show(*error.format_message().splitlines(), err=True)
        return
    if isinstance(error, SpecificationError):
        show_diagnostics(error.diagnoses)
    show_message("error", message_from_error(error), "red")

"""What commands that evaluate a log have in common: which log, which specifications, which samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spatial_replay.cli.options import Reading, profile_option, reading_options
from spatial_replay.cli.times import read_for, time_point_from_text
from spatial_replay.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from spatial_replay.logs.source import Source
    from spatial_replay.recording.tracks import Recorded
    from spatial_replay.replay import Replayed, Window
    from spatial_replay.spec import Specification

_OPTIONS = (
    click.option(
        "--spec",
        "specs",
        metavar="SPEC",
        multiple=True,
        type=click.Path(path_type=Path),
        help="A specification file; repeat it for several.  [default: those in the log]",
    ),
    click.option("--from", "start", metavar="T", help="From the first sample at or after this time …"),
    click.option("--to", "end", metavar="T", help="… to the last one before this time."),
    click.option(
        "--every",
        metavar="N",
        type=click.IntRange(min=1),
        default=1,
        help="Keep every Nth sample, counted from the log's first; bounds in samples count those kept.",
    ),
    click.option(
        "--each",
        "choices",
        multiple=True,
        metavar="VAR=class:C",
        help="The objects that a template's parameter stands for; VAR=all for every one.",
    ),
    profile_option,
)


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for on the command line."""

    log: Path
    specs: tuple[Path, ...]
    start: str | None
    end: str | None
    every: int
    choices: tuple[str, ...]
    profile: str | None
    reading: Reading

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files that are read."""
        mapping = self.reading["mapping"]
        return (self.log, *self.specs, *([] if mapping is None else [mapping]))


@dataclass(frozen=True, slots=True)
class Task:
    """A log and specifications that are ready to be evaluated."""

    source: Source
    files: Sequence[Specification]
    window: Window
    each: Mapping[str, str]


def evaluation_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """LOG, and the options that say what to evaluate over it; the command takes them as `request`."""

    @wraps(command)
    def with_request(**given: Any) -> Any:
        names = [name for name in Request.__slots__ if name in given]
        return command(request=Request(**{name: given.pop(name) for name in names}), **given)

    decorated: Callable[..., Any] = reading_options(with_request)
    for option in reversed(_OPTIONS):
        decorated = option(decorated)
    return click.argument("log", type=click.Path(path_type=Path))(decorated)


def prepared(request: Request) -> Task:
    """Open the log and load the specifications; their warnings go to standard error.

    Raises:
        UsageError: an option that cannot work.
        LogError, SpecificationError: what cannot be read.
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.logs.source import open_source
    from spatial_replay.replay import load_files

    source = open_source(request.log, **request.reading)
    files = load_files(request.specs, source, profile=request.profile)
    for warning in (warning for file in files for warning in file.warnings):
        click.echo(warning, err=True)
    return Task(source, files, _window(source, request), _each(request.choices))


def report_reading(found: Replayed | Recorded) -> None:
    """Say what was lost, odd or unreadable in a log."""
    from spatial_replay.cli.failures import say

    for warning in (*found.faults, *found.remarks):
        say("warning", warning, colour="yellow")
    if found.unreadable:
        several = found.unreadable != 1
        counted = f"{found.unreadable} observation{'s' if several else ''}"
        remark = f"{counted} {'hold' if several else 'holds'} a number that is not finite: unknown there"
        if found.remarks:
            remark = f"{counted} {'are' if several else 'is'} unknown: see above, or not finite"
        say("warning", remark, colour="yellow")


def _each(choices: tuple[str, ...]) -> dict[str, str]:
    each: dict[str, str] = {}
    for choice in choices:
        parameter, equals, objects = choice.partition("=")
        if not equals or not parameter:
            raise UsageError(
                f"--each {choice!r} chooses nothing; write --each VAR=class:NAME or --each VAR=all"
            )
        if parameter in each:
            raise UsageError(f"--each gives {parameter!r} twice: {each[parameter]!r} and {objects!r}")
        each[parameter] = objects
    return each


def _window(source: Source, request: Request) -> Window:
    from spatial_replay.replay import Window, first_sample_ns

    if request.start is None and request.end is None:
        return Window(every=request.every)
    with read_for("--from"):
        start_point = None if request.start is None else time_point_from_text(request.start)
    with read_for("--to"):
        end_point = None if request.end is None else time_point_from_text(request.end)
    first_ns = first_sample_ns(source)
    whole = Window()
    start_ns = whole.start_ns if start_point is None else start_point.absolute_ns(first_ns)
    end_ns = whole.end_ns if end_point is None else end_point.absolute_ns(first_ns)
    if end_ns <= start_ns:
        named = (("--from", request.start), ("--to", request.end))
        window = " ".join(f"{name} {text}" for name, text in named if text)
        raise UsageError(f"the window {window} is empty; --to is the time after its last sample")
    return Window(start_ns, end_ns, request.every)

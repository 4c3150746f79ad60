"""Options that several commands have.

What commands that evaluate a log have in common: which log, which specifications, which samples.

Times and durations as they are written on the command line.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, TypeVar

import click

from spatial_replay.errors import UsageError
from spatial_replay.trace.sample import LATEST_NS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from spatial_replay.logs.source import Source
    from spatial_replay.recording.record_source import Recorded
    from spatial_replay.replay import Replayed, Window
    from spatial_replay.spec.formula import Specification

_Command = TypeVar("_Command", bound=Callable[..., Any])


class _OutputFile(click.Path):
    """A path to write to; "-" is none."""

    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> str | bytes | os.PathLike[str]:
        if value == "-":
            self.fail("- is no file; name one. `replay … --json -` writes to standard output", param, ctx)
        return super().convert(value, param, ctx)


def output_option(text: str, *, required: bool = False) -> Callable[[_Command], _Command]:
    """`-o FILE`, with its help."""
    return click.option("-o", "--output", type=_OutputFile(path_type=Path), required=required, help=text)


semantics_option = click.option(
    "--semantics",
    type=click.Choice(["ltlf", "paper"]),
    default="ltlf",
    show_default=True,
    help="What a formula means: robustness over finite traces, or the paper's Def. 16 to the letter.",
)

profile_option = click.option(
    "--profile",
    type=click.Choice(["paper", "spatial_spec"]),
    help="Relation profile of files without a `use` line.  [default: paper]",
)


def refuse_several(specification: Specification, of: str | None) -> None:
    """That it is clear which result of a specification is meant.

    Raises:
        UsageError: it has several, and none was chosen.
    """
    if of is None and len(specification.results) > 1:
        names = ", ".join(spec.name for spec in specification.results)
        raise UsageError(f"{specification.filename} has several results; choose one with --of: {names}")


_READING = (
    click.option(
        "--mapping",
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="Which topics of a log by others carry which objects (YAML).",
    ),
    click.option(
        "--on-time-jump",
        type=click.Choice(["error", "split"]),
        default="error",
        help="What becomes of a log of messages whose clock jumps back.  [default: error]",
    ),
    click.option(
        "--rate", metavar="N", type=float, help="Frames a second of drone annotations.  [default: 30]"
    ),
    click.option(
        "--lost",
        type=click.Choice(["drop", "keep"]),
        default="drop",
        help="What becomes of drone annotations marked as lost.  [default: drop]",
    ),
    click.option(
        "--concave",
        type=click.Choice(["decompose", "hull"]),
        default="decompose",
        help="A polygon that is not convex becomes convex parts, or its hull.  [default: decompose]",
    ),
)


class Reading(TypedDict):
    """How a log is to be read: what `open_source` takes beside its path."""

    mapping: Path | None
    on_time_jump: Literal["error", "split"]
    rate: float | None
    lost: Literal["drop", "keep"]
    concave: Literal["decompose", "hull"]


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say how a log is read; the command takes them together, as `reading`."""

    @wraps(command)
    def with_reading(**given: Any) -> Any:
        reading: dict[str, Any] = {name: given.pop(name) for name in Reading.__annotations__}
        return command(reading=reading, **given)

    decorated: Callable[..., Any] = with_reading
    for option in reversed(_READING):
        decorated = option(decorated)
    return decorated


_DURATION = re.compile(
    r"(?P<number>\d{1,19}(?:\.\d{1,30})?(?:e[+-]?\d{1,2})?)(?P<unit>s|ms)", re.ASCII | re.I
)
_ABSOLUTE = re.compile(r"\d{1,19}", re.ASCII)
_CALENDAR = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[T ](?P<time>\d\d:\d\d:\d\d)(?:\.(?P<fraction>\d{1,9}))?"
    r"(?P<offset>Z|[+-]\d\d:\d\d)",
    re.ASCII | re.IGNORECASE,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class TimePoint:
    """A time in a log, as somebody asked for it.

    Attributes:
        nanoseconds: since the first sample, or since the log's own zero.
        origin: which of the two.
    """

    nanoseconds: int
    origin: Literal["first sample", "zero"]

    def absolute_ns(self, first_ns: int) -> int:
        """The same time on the clock of a log whose first sample has time `first_ns`."""
        return first_ns + self.nanoseconds if self.origin == "first sample" else self.nanoseconds


def time_point_from_text(text: str) -> TimePoint:
    """Read `12.5s` or `1500ms` after the first sample, integer nanoseconds, or an RFC 3339 time.

    Raises:
        UsageError: for anything else, and for a time that no log can hold.
    """
    if _DURATION.fullmatch(text):
        return TimePoint(duration_ns_from_text(text), "first sample")
    if _ABSOLUTE.fullmatch(text):
        return TimePoint(_checked_ns(int(text), text), "zero")
    if calendar := _CALENDAR.fullmatch(text):
        return TimePoint(_checked_ns(_ns_from_calendar(calendar, text), text), "zero")
    raise UsageError(
        f"{text!r} is not a time; write 12.5s or 1500ms after the log's first sample, "
        "integer nanoseconds, or 2026-01-31T12:00:00Z"
    )


def duration_ns_from_text(text: str) -> int:
    """Read a duration such as `2s`, `0.5s` or `1500ms` as nanoseconds, rounded to the nearest.

    Raises:
        UsageError: for anything else.
    """
    match = _DURATION.fullmatch(text)
    if match is None:
        raise UsageError(f"{text!r} is not a duration; write it as 2s, 0.5s or 1500ms")
    unit_ns = 10**9 if match["unit"].lower() == "s" else 10**6
    nanoseconds = Decimal(match["number"]) * unit_ns
    # compared before it becomes an integer, which might be one of a hundred digits
    return (
        int(nanoseconds.to_integral_value()) if nanoseconds <= LATEST_NS else _checked_ns(LATEST_NS + 1, text)
    )


@contextmanager
def read_for(option: str) -> Iterator[None]:
    """Name the option in what is said of a time or duration that cannot be read."""
    try:
        yield
    except UsageError as error:
        raise UsageError(f"{option}: {error}") from None


def text_from_duration_ns(nanoseconds: int) -> str:
    """A duration as `duration_ns_from_text` reads it, to the nanosecond: "2s", "0.25s"."""
    seconds, fraction_ns = divmod(nanoseconds, 10**9)
    return f"{seconds}.{fraction_ns:09d}".rstrip("0").rstrip(".") + "s"


def _ns_from_calendar(match: re.Match[str], text: str) -> int:
    offset = "+00:00" if match["offset"] in "Zz" else match["offset"]
    try:
        whole_seconds = datetime.fromisoformat(f"{match['date']}T{match['time']}{offset}")
    except ValueError as error:
        raise UsageError(f"{text!r} is no time of the calendar: {error}") from error
    fraction_ns = int((match["fraction"] or "").ljust(9, "0"))
    return (whole_seconds - _EPOCH) // timedelta(seconds=1) * 10**9 + fraction_ns


def _checked_ns(nanoseconds: int, text: str) -> int:
    if not 0 <= nanoseconds <= LATEST_NS:
        raise UsageError(f"{text!r} is longer than a log can be, or outside its times, 0 to 2**63 - 1 ns")
    return nanoseconds


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
    from spatial_replay.replay import load_files
    from spatial_replay.sources.open_log import open_source

    source = open_source(request.log, **request.reading)
    files = load_files(request.specs, source, profile=request.profile)
    for warning in (warning for file in files for warning in file.warnings):
        click.echo(warning, err=True)
    return Task(source, files, _window(source, request), _each(request.choices))


def report_reading(found: Replayed | Recorded) -> None:
    """Say what was lost, odd or unreadable in a log."""
    from spatial_replay.cli.application import say

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

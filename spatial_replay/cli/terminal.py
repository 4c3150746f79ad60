"""Output to the terminal.

All printed text passes through this module, so names from a log cannot control a terminal.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from textwrap import wrap
from threading import Timer
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import click

from spatial_replay.text import escape_text, without_repetition

if TYPE_CHECKING:
    from pathlib import Path

    from rich.progress import Progress

    from spatial_replay.errors import Diagnosis


PROGRAM: Final = "spatial-replay"


_HUES: Final = MappingProxyType({"blue": 32, "red": 166, "yellow": 130, "cyan": 30})
"""Terminal colours (of 256) that are readable on black and on white."""


class Coloured(NamedTuple):
    """A piece of a line, bold and in one of the colours `blue`, `red`, `yellow` and `cyan`."""

    text: str
    colour: str


Line: TypeAlias = str | tuple[str | Coloured, ...]


_NO_BREAK: Final = "\N{NO-BREAK SPACE}"
_BEFORE_UNIT: Final = re.compile(r"(?<=\d) (?=[^\W\d][\w/^²]{0,4}(?![\w]))")
"""A space between a number and a short word, which may be its unit."""
_LEAST_WIDTH: Final = 60
"""Least width of lines, characters."""


def show(*lines: Line, err: bool = False) -> None:
    """Print lines, with escapes such as `\\x1b` for unprintable characters.

    Lines that are too long for a terminal are broken at spaces.

    Args:
        lines: lines without line ends; a line end within a line is escaped.
        err: print to standard error.
    """
    for line in lines:
        pieces = (line,) if isinstance(line, (str, Coloured)) else line
        text = "".join(escape_text(piece.text if isinstance(piece, Coloured) else piece) for piece in pieces)
        first_line, *other_lines = [text]
        if (sys.stderr if err else sys.stdout).isatty():
            first_line, *other_lines = _fit_lines(text)
        styled = "\n".join([_style(pieces, len(first_line)), *other_lines])
        click.echo(styled, err=err, color=False if os.environ.get("NO_COLOR") else None)


def _style(pieces: Iterable[str | Coloured], max_length: int) -> str:
    """Return the first `max_length` characters of a line, in colours."""
    styled_text = ""
    for piece in pieces:
        text = escape_text(piece.text if isinstance(piece, Coloured) else piece)[:max_length]
        max_length -= len(text)
        colour = _HUES[piece.colour] if isinstance(piece, Coloured) else None
        styled_text += text if colour is None else click.style(text, fg=colour, bold=True)
    return styled_text


class StatusLine:
    """A line at the bottom of a terminal that is updated in place. Without a terminal, nothing is printed."""

    def __init__(self) -> None:
        self._is_shown = False

    def show(self, text: str) -> None:
        """Replace the line."""
        if sys.stderr.isatty():
            # some terminals wrap a line that fills the last column
            width = shutil.get_terminal_size().columns - 1
            click.echo(f"\r\x1b[K{escape_text(text)[:width]}", nl=False, err=True)
            self._is_shown = True

    def clear(self) -> None:
        """Remove the line before other output."""
        if self._is_shown:
            click.echo("\r\x1b[K", nl=False, err=True)
            self._is_shown = False


def terminal_width() -> int:
    """Return the width of the terminal, characters; 100 without a terminal."""
    return shutil.get_terminal_size((100, 24)).columns


def _fit_lines(line: str) -> list[str]:
    """Cut a line at spaces to the width of the terminal. Lines after the first are indented."""
    indent = " " * (len(line) - len(line.lstrip(" ")) + 4)
    width = max(terminal_width(), _LEAST_WIDTH)
    # a no-break space keeps a number with its unit
    text = _BEFORE_UNIT.sub(_NO_BREAK, line)
    lines = wrap(text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return [piece.replace(_NO_BREAK, " ") for piece in lines] or [line]


def show_json(value: Any, indent: int | None = 2) -> None:
    """Print a value as JSON, with JSON's escapes for unprintable characters."""
    text = json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False)
    click.echo(
        "".join(
            character if character == "\n" or character.isprintable() else json.dumps(character)[1:-1]
            for character in text
        )
    )


class Listener(NamedTuple):
    """Receives the results of commands as values, and the progress of their work.

    Attributes:
        document: called with each result, as values for JSON.
        progress: called with a label, the steps so far, and the total or None.
    """

    document: Callable[[Any], None]
    progress: Callable[[str, int, int | None], None]


_LISTENER: Final[ContextVar[Listener | None]] = ContextVar("listener", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Give a listener the results and the progress of commands that run inside the block."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def show_result(document: Callable[[], Any], lines: Callable[[], Iterable[Line]], as_json: bool) -> None:
    """Print a result as JSON or as text. A listener always receives the document, too."""
    if (listener := _LISTENER.get()) is not None:
        listener.document(document())
    if as_json:
        show_json(document())
    else:
        show(*lines())


def show_file(text: str) -> None:
    """Print the text of a file: unchanged to a file or a pipe, escaped to a terminal."""
    if sys.stdout.isatty():
        text = "\n".join(escape_text(line, "\t") for line in text.splitlines()) + "\n"
    click.echo(text, nl=not text.endswith("\n"))


@contextmanager
def printing_to(output: Path | None, inputs: Iterable[Path] = ()) -> Iterator[None]:
    """Redirect standard output to a file within this context; None redirects nothing.

    Raises:
        UsageError: the output is an input or a folder, or its folder is missing.
        OutputError: the output cannot be written.
    """
    if output is None:
        yield
        return
    from spatial_replay.logs.output_file import replacing

    with replacing(output, inputs) as stream:
        text_stream = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
        with redirect_stdout(text_stream):
            yield
        stream.write(text_stream.buffer.getvalue())


def show_diagnostics(diagnostics: Iterable[Diagnosis]) -> None:
    """Print errors and warnings about a specification to standard error."""
    for diagnostic in diagnostics:
        show(*str(diagnostic).split("\n"), err=True)


def show_message(severity: str, message: str, colour: str) -> None:
    """Print "spatial-replay: SEVERITY: MESSAGE" to standard error; further lines are indented."""
    first_line, *other_lines = message.split("\n")
    label = Coloured(f"{severity}:", colour)
    # indented lines stay as they are, because carets point into the line above
    indented_lines = (line if line.startswith("  ") else f"  {line}" for line in other_lines)
    show((f"{PROGRAM}: ", label, f" {first_line}"), *indented_lines, err=True)


def warn(*messages: str) -> None:
    """Print warnings to standard error as "spatial-replay: warning: …". Similar warnings are printed once."""
    for message in without_repetition(messages):
        show_message("warning", message, "yellow")


PATIENCE_S = 1.0
"""Delay before a progress bar appears, seconds."""
COMPILING = "compiling, once on this machine"
"""Label of a bar while kernels are compiled."""

_NOTEBOOK = "JPY_PARENT_PID"
"""Environment variable that notebook kernels set for programs in their cells."""

Advance = Callable[[int], None]


@contextmanager
def progress(label: str, total: int | None = None) -> Iterator[Advance]:
    """Show the progress of some work: `with progress("reading", len(items)) as advance: ... advance(1)`.

    If standard error is a terminal, a bar appears after a second. The bar is removed at the end of the work.
    Its label says when kernels are compiled. A cell of a notebook shows no bar, although it runs
    `!spatial-replay …` on a terminal.

    Args:
        total: number of steps; None if unknown.
    """
    if (listener := _LISTENER.get()) is not None:
        yield _counting(listener, label, total)
        return
    if not sys.stderr.isatty() or _NOTEBOOK in os.environ:
        yield lambda steps: None
        return
    # this import is slow, but all work that is worth a bar needs it anyway
    from spatial_replay.compiled import compilations

    bar = _Bar(label, total)
    try:
        with compilations(bar.show_compiling):
            yield bar.advance
    finally:
        bar.close()


def _counting(listener: Listener, label: str, total: int | None) -> Advance:
    """Return a function that reports the number of all steps so far to a listener."""
    step_count = 0

    def advance(steps: int) -> None:
        nonlocal step_count
        step_count += steps
        listener.progress(label, step_count, total)

    listener.progress(label, 0, total)
    return advance


class _Bar:
    """A bar that appears after `PATIENCE_S`, even before the first step.

    A timer shows the bar, because the first step may take long while kernels are compiled.
    """

    def __init__(self, label: str, total: int | None) -> None:
        self._label = self._description = label
        self._total = total
        self._step_count = 0
        self._progress: Progress | None = None
        self._timer = Timer(PATIENCE_S, self._appear)
        self._timer.daemon = True
        self._timer.start()

    def advance(self, steps: int) -> None:
        self._step_count += steps
        self._description = self._label
        self._update()

    def show_compiling(self) -> None:
        """Change the label until the next step."""
        self._description = COMPILING
        self._update()

    def _update(self) -> None:
        if self._progress is not None:
            self._progress.update(
                self._progress.task_ids[0], description=self._description, completed=self._step_count
            )

    def _appear(self) -> None:
        # `_start_bar` returns None inside other work, which already has a bar
        self._progress = _start_bar(self._description, self._total, self._step_count)
        # steps may have been done while the bar was made
        self._update()

    def close(self) -> None:
        self._timer.cancel()
        # the timer may be about to show the bar
        self._timer.join()
        if self._progress is not None:
            self._progress.stop()


def _start_bar(label: str, total: int | None, step_count: int) -> Progress | None:
    # importing rich would take a quarter of the time of `--help`
    from rich.console import Console
    from rich.errors import LiveError
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        # the share of finished work; without a total, the number of finished steps
        TaskProgressColumn(text_format_no_percentage="{task.completed:,.0f}"),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    bar.add_task(label, total=total, completed=step_count)
    try:
        bar.start()
    except LiveError:
        return None
    return bar

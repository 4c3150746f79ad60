"""Faults of a specification's text with their places; all faults of a text are reported together."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from spatial_replay.errors import SpecificationError
from spatial_replay.text import escape_text
from spatial_replay.text import nearest_hint as nearest_hint

MAX_FAULTS = 100
"""Maximum number of faults in one report; further faults are only counted."""

_MAX_SUGGESTION_EFFORT = 10_000
"""Maximum number of name comparisons for the hints of one text; large texts could need millions."""
# not str.splitlines, which also splits at form feeds and Unicode line separators
_LINE_END = re.compile(r"\r\n|\r|\n")


class Span(NamedTuple):
    """Place in a source text: half-open range of character offsets, from `start` to before `end`."""

    start: int
    end: int


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """Error or warning about a specification, with its place.

    Attributes:
        severity: "error" or "warning".
        line, column: position, counted from 1; columns are characters.
        source_line: text of the line.
        width: number of underlined characters, at least 1.
        hint: remedy, or "".
    """

    severity: Literal["error", "warning"]
    message: str
    filename: str
    line: int
    column: int
    source_line: str
    width: int = 1
    hint: str = ""

    def __str__(self) -> str:
        piece_start = max(0, self.column - _SHOWN_BEFORE) if len(self.source_line) > _SHOWN else 0
        piece = self.source_line[piece_start : piece_start + _SHOWN]
        # control characters of a text would act on the terminal
        printable_piece = "".join(character if character.isprintable() else " " for character in piece)
        caret_offset = self.column - 1 - piece_start
        caret = " " * caret_offset + "^" * max(1, min(self.width, _SHOWN - caret_offset))
        place = f"{escape_text(self.filename)}:{self.line}:{self.column}"
        head = f"{place}: {self.severity}: {escape_text(self.message)}"
        tail = f"\n  {escape_text(self.hint)}" if self.hint else ""
        return f"{head}\n  {printable_piece}\n  {caret}{tail}"


_SHOWN = 200
"""Maximum number of characters of a source line in a message; a longer line is cut around the fault."""
_SHOWN_BEFORE = 100
"""Characters before the fault in a cut line."""


@dataclass(frozen=True, slots=True)
class SourceText:
    """Text with its file name and an index of its lines."""

    text: str
    filename: str
    line_starts: tuple[int, ...]

    @classmethod
    def of(cls, text: str, filename: str) -> SourceText:
        """Index the lines of a text."""
        return cls(text, filename, (0, *(line_end.end() for line_end in _LINE_END.finditer(text))))

    def line_of(self, offset: int) -> int:
        """Return the line of an offset, counted from 1."""
        return bisect_right(self.line_starts, offset)

    def diagnostic(
        self, severity: Literal["error", "warning"], span: Span, message: str, hint: str = ""
    ) -> Diagnostic:
        """Return an error or a warning about a span; the underline ends with the first line of the span."""
        line = self.line_of(span.start)
        line_start = self.line_starts[line - 1]
        line_end = self.line_starts[line] if line < len(self.line_starts) else len(self.text)
        source_line = self.text[line_start:line_end].rstrip("\r\n")
        column = min(span.start - line_start, len(source_line)) + 1
        width = max(1, min(span.end - span.start, len(source_line) - column + 1))
        return Diagnostic(severity, message, self.filename, line, column, source_line, width, hint)


@dataclass(slots=True)
class Faults:
    """Faults of one text: at most one for each place, and at most `MAX_FAULTS` in all."""

    source: SourceText
    found: dict[Span, Diagnostic] = field(default_factory=dict)
    unreported: int = 0
    effort: int = 0

    @property
    def is_full(self) -> bool:
        """Whether further faults are only counted and need no hints."""
        return len(self.found) >= MAX_FAULTS

    @property
    def count(self) -> int:
        """Number of faults, unreported ones included."""
        return len(self.found) + self.unreported

    def add(self, span: Span, message: str, hint: str = "") -> None:
        """Add a fault unless its place already has one. If the report is full, only `count` grows."""
        if span in self.found:
            return
        if self.is_full:
            self.unreported += 1
            return
        self.found[span] = self.source.diagnostic("error", span, _crop(message), _crop(hint))

    def nearest(self, name: str, known: Iterable[str]) -> str:
        """Return a hint with the known name closest to an unknown name; "" if none is close."""
        if self.is_full or self.effort > _MAX_SUGGESTION_EFFORT:
            return ""
        candidates = tuple(known)
        self.effort += len(candidates)
        return nearest_hint(name, candidates)

    def raise_if_any(self) -> None:
        """Raise one error with all faults in text order.

        Raises:
            SpecificationError: the text has a fault.
        """
        if not self.found:
            return
        diagnostics = sorted(self.found.values(), key=lambda fault: (fault.line, fault.column))
        if self.unreported:
            end_span = Span(len(self.source.text), len(self.source.text))
            remark = f"{self.unreported} further faults are not shown"
            diagnostics.append(self.source.diagnostic("error", end_span, remark, "mend these first"))
        raise SpecificationError(diagnostics)


_LONGEST_MESSAGE = 400


def _crop(message: str) -> str:
    """Cut the middle out of a long message, such as one that quotes a very long name."""
    if len(message) <= _LONGEST_MESSAGE:
        return message
    half_length = _LONGEST_MESSAGE // 2
    return f"{message[:half_length]} ... {message[-half_length:]}"

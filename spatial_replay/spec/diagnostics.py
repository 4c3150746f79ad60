"""Faults of a specification's text: each with its place, collected so that all are reported together."""

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
"""Faults reported together; beyond, only their number."""

_MAX_SUGGESTION_EFFORT = 10_000
"""Names compared for hints in one text; a text with a fault in every line would compare millions."""
_LINE_END = re.compile(r"\r\n|\r|\n")


class Span(NamedTuple):
    """A place in a source text: characters `start` up to, not including, `end`."""

    start: int
    end: int


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """An error or a warning about a specification, with its place.

    Attributes:
        severity: "error" or "warning".
        line, column: counted from 1; the column in characters.
        source_line: the line itself.
        width: how many characters the caret underlines, at least 1.
        hint: what to write instead, or "".
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
        first = max(0, self.column - _SHOWN_BEFORE) if len(self.source_line) > _SHOWN else 0
        piece = self.source_line[first : first + _SHOWN]
        printable_piece = "".join(character if character.isprintable() else " " for character in piece)
        offset = self.column - 1 - first
        caret = " " * offset + "^" * max(1, min(self.width, _SHOWN - offset))
        place = f"{escape_text(self.filename)}:{self.line}:{self.column}"
        head = f"{place}: {self.severity}: {escape_text(self.message)}"
        tail = f"\n  {escape_text(self.hint)}" if self.hint else ""
        return f"{head}\n  {printable_piece}\n  {caret}{tail}"


_SHOWN = 200
"""Characters of a line that a message shows; of a longer one, those around the fault."""
_SHOWN_BEFORE = 100


@dataclass(frozen=True, slots=True)
class SourceText:
    """A text and the name of its file; turns offsets into lines and columns."""

    text: str
    filename: str
    line_starts: tuple[int, ...]

    @classmethod
    def of(cls, text: str, filename: str) -> SourceText:
        """Index the lines of a text."""
        return cls(text, filename, (0, *(line_end.end() for line_end in _LINE_END.finditer(text))))

    def line_of(self, offset: int) -> int:
        """Return the line, counted from 1, that an offset lies in."""
        return bisect_right(self.line_starts, offset)

    def diagnostic(
        self, severity: Literal["error", "warning"], span: Span, message: str, hint: str = ""
    ) -> Diagnostic:
        """Return an error or a warning about a span, which is marked up to the end of its first line."""
        line = self.line_of(span.start)
        start = self.line_starts[line - 1]
        end = self.line_starts[line] if line < len(self.line_starts) else len(self.text)
        source_line = self.text[start:end].rstrip("\r\n")
        column = min(span.start - start, len(source_line)) + 1
        width = max(1, min(span.end - span.start, len(source_line) - column + 1))
        return Diagnostic(severity, message, self.filename, line, column, source_line, width, hint)


@dataclass(slots=True)
class Faults:
    """The faults found so far in one text: at most one for each place, and a bounded number."""

    source: SourceText
    found: dict[Span, Diagnostic] = field(default_factory=dict)
    unreported: int = 0
    effort: int = 0

    @property
    def is_full(self) -> bool:
        """Whether further faults are only counted, so that no hint need be worked out for them."""
        return len(self.found) >= MAX_FAULTS

    @property
    def count(self) -> int:
        """All faults, reported or only counted."""
        return len(self.found) + self.unreported

    def add(self, span: Span, message: str, hint: str = "") -> None:
        """Add a fault, unless its place has one already; when full, only count it."""
        if span in self.found:
            return
        if self.is_full:
            self.unreported += 1
            return
        self.found[span] = self.source.diagnostic("error", span, _crop(message), _crop(hint))

    def nearest(self, name: str, known: Iterable[str]) -> str:
        """Return a hint with the known name most like one that is unknown, or ""."""
        if self.is_full or self.effort > _MAX_SUGGESTION_EFFORT:
            return ""
        candidates = tuple(known)
        self.effort += len(candidates)
        return nearest_hint(name, candidates)

    def raise_if_any(self) -> None:
        """Raise the error of all faults, in the order of the text.

        Raises:
            SpecificationError: there is a fault.
        """
        if not self.found:
            return
        diagnoses = sorted(self.found.values(), key=lambda fault: (fault.line, fault.column))
        if self.unreported:
            end = Span(len(self.source.text), len(self.source.text))
            remark = f"{self.unreported} further faults are not shown"
            diagnoses.append(self.source.diagnostic("error", end, remark, "mend these first"))
        raise SpecificationError(diagnoses)


_LONGEST_MESSAGE = 400


def _crop(message: str) -> str:
    """Shorten the middle of a long message, such as one about a name of several pages."""
    if len(message) <= _LONGEST_MESSAGE:
        return message
    half = _LONGEST_MESSAGE // 2
    return f"{message[:half]} ... {message[-half:]}"

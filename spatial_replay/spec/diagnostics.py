"""Where faults of a text are collected, each with its place, so that they can all be told at once."""

from __future__ import annotations

import difflib
import re
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

from spatial_replay.errors import SpecificationError
from spatial_replay.spec.formula import Diagnostic, Span

MAX_FAULTS = 100
"""Faults told at once; beyond, only their number."""

_MAX_SUGGESTION_EFFORT = 10_000
_LINE_END = re.compile(r"\r\n|\r|\n")


@dataclass(frozen=True, slots=True)
class Source:
    """A text and the name of its file; turns offsets into lines and columns."""

    text: str
    filename: str
    line_starts: tuple[int, ...]

    @classmethod
    def of(cls, text: str, filename: str) -> Source:
        """The source of a text, with its lines found."""
        return cls(text, filename, (0, *(found.end() for found in _LINE_END.finditer(text))))

    def line_of(self, offset: int) -> int:
        """The line, counted from 1, that an offset lies in."""
        return bisect_right(self.line_starts, offset)

    def diagnostic(
        self, severity: Literal["error", "warning"], span: Span, message: str, hint: str = ""
    ) -> Diagnostic:
        """A fault or a remark about a span, which is marked up to the end of its first line."""
        line = self.line_of(span.start)
        start = self.line_starts[line - 1]
        end = self.line_starts[line] if line < len(self.line_starts) else len(self.text)
        source_line = self.text[start:end].rstrip("\r\n")
        column = min(span.start - start, len(source_line)) + 1
        width = max(1, min(span.end - span.start, len(source_line) - column + 1))
        return Diagnostic(severity, message, self.filename, line, column, source_line, width, hint)


@dataclass(slots=True)
class Faults:
    """The faults found so far in one source: at most one for each place, and a bounded number."""

    source: Source
    found: dict[Span, Diagnostic] = field(default_factory=dict)
    untold: int = 0
    effort: int = 0

    @property
    def is_full(self) -> bool:
        """Whether further faults are only counted, so that nothing need be found out about them."""
        return len(self.found) >= MAX_FAULTS

    @property
    def count(self) -> int:
        """All faults, told or not."""
        return len(self.found) + self.untold

    def add(self, span: Span, message: str, hint: str = "") -> None:
        """Take in a fault, unless its place has one already; when full, only count it."""
        if span in self.found:
            return
        if self.is_full:
            self.untold += 1
            return
        self.found[span] = self.source.diagnostic("error", span, _cropped(message), _cropped(hint))

    def nearest(self, name: str, known: Iterable[str]) -> str:
        """The hint that names the known name most like one that is unknown, or ""."""
        if self.is_full or self.effort > _MAX_SUGGESTION_EFFORT:
            return ""
        candidates = tuple(known)
        self.effort += len(candidates)
        return nearest_hint(name, candidates)

    def raise_if_any(self) -> None:
        """
        Raises:
            SpecificationError: with every fault, in the order of the text.
        """
        if not self.found:
            return
        diagnoses = sorted(self.found.values(), key=lambda fault: (fault.line, fault.column))
        if self.untold:
            end = Span(len(self.source.text), len(self.source.text))
            remark = f"{self.untold} further faults are not shown"
            diagnoses.append(self.source.diagnostic("error", end, remark, "mend these first"))
        raise SpecificationError(diagnoses)


_LONGEST_MESSAGE = 400
_LONGEST_COMPARED = 64


def _cropped(message: str) -> str:
    """A message of a length to be read, even about a name of pages."""
    if len(message) <= _LONGEST_MESSAGE:
        return message
    half = _LONGEST_MESSAGE // 2
    return f"{message[:half]} ... {message[-half:]}"


def nearest_name(name: str, known: Iterable[str]) -> str | None:
    """The known name most like `name`, if one is like it at all."""
    if len(name) > _LONGEST_COMPARED:
        return None
    comparable = [candidate for candidate in known if len(candidate) <= _LONGEST_COMPARED]
    matches = difflib.get_close_matches(name, comparable, n=1)
    return matches[0] if matches else None


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """The hint that names the known name most like `name`, or ""."""
    match = nearest_name(name, known)
    return f"did you mean {match!r}?" if match is not None else ""

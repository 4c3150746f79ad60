"""Declarations that two versions of a text do not share: constants, regions, groups, macros, scales.

Any of them can be edited in the old text, or left as it was in the new one, without the others: that shows
which nodes of a formula follow from it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from difflib import SequenceMatcher
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, TypeAlias

from lark import Token

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.spec.diagnostics import Faults, SourceText
from spatial_replay.spec.formula import Span, Specification
from spatial_replay.spec.load import parse_specification
from spatial_replay.spec.parser import split_statements
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.tokens import span_of, tokenize

DeclarationKind: TypeAlias = Literal["constant", "region", "group", "definition"]

_KINDS: Final[Mapping[str, DeclarationKind]] = MappingProxyType(
    {
        "CONST": "constant",
        "REGION": "region",
        "GROUP": "group",
        "DEF": "definition",
        "SCALE": "definition",
        "USE": "definition",
    }
)
_MOST_CHANGES: Final = 32
"""Declarations that edits are traced back to; two texts that differ in more are hardly versions of one."""


class TextPlace(NamedTuple):
    """A line of a specification file, from 1, or a statement that begins there, written on one line."""

    filename: str
    line: int
    text: str


class DeclarationChange(NamedTuple):
    """A declaration that the versions do not share; `old` or `new` is None if only the other has it."""

    kind: DeclarationKind
    name: str
    old: TextPlace | None
    new: TextPlace | None


class _Statement(NamedTuple):
    span: Span
    place: TextPlace
    words: tuple[str, ...]


_Key: TypeAlias = tuple[str, str]
"""The word that a statement begins with, and the name that it declares."""


class TextVersions:
    """Two versions of a text, and what lies between them: some declarations of one put into the other.

    Holds what was parsed, for one diff.

    Attributes:
        old, new: the specifications.
        changes: the declarations that differ by more than blanks and comments; of very many, the first.
    """

    def __init__(self, old: Specification, new: Specification) -> None:
        self.old, self.new = old, new
        self._statements = statements_of(old), statements_of(new)
        one, other = self._statements
        # specs are compared node by node
        keys = [key for key in dict.fromkeys((*one, *other)) if key[0] != "SPEC"]
        self._keys = [key for key in keys if _words(one, key) != _words(other, key)][:_MOST_CHANGES]
        self.changes = tuple(
            DeclarationChange(_KINDS[key[0]], key[1], _place(one, key), _place(other, key))
            for key in self._keys
        )
        self._known: dict[tuple[bool, frozenset[int]], Specification | None] = {}

    def applied(self, changes: Collection[int]) -> Specification | None:
        """Return the old text with some declarations of the new one, by number; None if it has errors."""
        return self._version(frozenset(changes), is_old=True)

    def undone(self, changes: Collection[int]) -> Specification | None:
        """Return the new text with some declarations of the old one, by number; None if it has errors."""
        return self._version(frozenset(changes), is_old=False)

    def edited_lines(
        self, specs: Sequence[tuple[str, str]], spans: tuple[Span | None, Span | None]
    ) -> tuple[TextPlace | None, TextPlace | None]:
        """Return a line that differs of the first of some specs that was edited, in either text.

        None stands for a line that the other text does not have, or, twice, for no such spec.

        Args:
            specs: their names in the old text and in the new one.
            spans: of several lines that differ, that of either of these is looked for.
        """
        for names in specs:
            found = [of.get(("SPEC", name)) for of, name in zip(self._statements, names, strict=True)]
            one, other = found
            if one is not None and other is not None and one.words != other.words:
                break
        else:
            return None, None
        old = _lines_of(self.old, one.span, spans[0])
        new = _lines_of(self.new, other.span, spans[1])
        one_words, other_words = (
            [tuple(line.place.text.partition("#")[0].split()) for line in lines] for lines in (old, new)
        )
        codes = SequenceMatcher(None, one_words, other_words, autojunk=False).get_opcodes()
        blocks = [(old[a:b], new[c:d]) for kind, a, b, c, d in codes if kind != "equal"]
        return _chosen(max(blocks, key=lambda block: sum(line.is_wanted for line in (*block[0], *block[1]))))

    def _version(self, changes: frozenset[int], *, is_old: bool) -> Specification | None:
        if (is_old, changes) not in self._known:
            keys = [self._keys[number] for number in changes]
            # what is exchanged may need declarations that only the other text has
            texts = (self._exchanged(keys, is_old, is_strict) for is_strict in (True, False))
            found = (self._parsed(text, keys, is_old) for text in texts)
            self._known[is_old, changes] = next((each for each in found if each is not None), None)
        return self._known[is_old, changes]

    def _exchanged(self, keys: Collection[_Key], is_old: bool, is_strict: bool) -> str:
        base, other = self._statements if is_old else self._statements[::-1]
        file, source = (self.old, self.new) if is_old else (self.new, self.old)
        pieces: list[tuple[Span, str]] = []
        first = []
        for key in self._keys:
            if key in base and key in other and key in keys:
                pieces.append((base[key].span, _text(source, other[key].span)))
            elif key not in base and (key in keys or not is_strict):
                first.append(_text(source, other[key].span))
            elif key not in other and key in keys and is_strict:
                pieces.append((base[key].span, ""))
        text = file.source
        for span, piece in sorted(pieces, reverse=True):
            text = text[: span.start] + piece + text[span.end :]
        return "\n".join((*first, text))

    def _parsed(self, text: str, keys: Iterable[_Key], is_old: bool) -> Specification | None:
        file, other = (self.old, self.new) if is_old else (self.new, self.old)
        profile = other.profile if any(word == "USE" for word, _ in keys) else file.profile
        with suppress(SpecificationError, UsageError):
            return parse_specification(text, filename=file.filename, profile=profile)
        return None


class _Line(NamedTuple):
    """A line of a statement; wanted is that of a certain place."""

    place: TextPlace
    is_wanted: bool


def _lines_of(file: Specification, statement: Span, span: Span | None) -> list[_Line]:
    first, last = (file.source.count("\n", 0, at) for at in (statement.start, statement.end))
    wanted = -1 if span is None or span == Span(0, 0) else file.source.count("\n", 0, span.start)
    lines = file.source.split("\n")
    return [
        _Line(TextPlace(file.filename, number + 1, lines[number].strip()), number == wanted)
        for number in range(first, last + 1)
    ]


def _chosen(block: tuple[Sequence[_Line], Sequence[_Line]]) -> tuple[TextPlace | None, TextPlace | None]:
    """Return the wanted line of either text, or else the one as far down as that of the other."""
    wanted = [number for lines in block for number, line in enumerate(lines) if line.is_wanted]
    old, new = (
        next((line.place for line in lines if line.is_wanted), None)
        or (lines[min(next(iter(wanted), 0), len(lines) - 1)].place if lines else None)
        for lines in block
    )
    return old, new


def statements_of(file: Specification) -> dict[_Key, _Statement]:
    """Return the statements of a specification's text by what they declare."""
    source = SourceText.of(file.source, file.filename)
    faults = Faults(source)
    found: dict[_Key, _Statement] = {}
    for group in split_statements(tokenize(file.source, RELATION_NAMES | file.relations, faults), faults):
        first, last = group.tokens[0], group.tokens[-1]
        if first.type not in (*_KINDS, "SPEC") or first is last:
            continue
        span = Span(span_of(first).start, span_of(last).end)
        place = TextPlace(file.filename, source.line_of(span.start), _on_one_line(file.source, group.tokens))
        name = "profile" if first.type == "USE" else str(group.tokens[1].value)
        words = tuple(f"{token.type} {token.value}" for token in group.tokens)
        found.setdefault((first.type, name), _Statement(span, place, words))
    return found


def _on_one_line(source: str, tokens: Sequence[Token]) -> str:
    """Return a statement as written, but for ends of lines and comments within it."""
    pieces: list[str] = []
    at = span_of(tokens[0]).start
    for token in tokens:
        start, end = span_of(token)
        gap = source[at:start]
        pieces += [gap if gap.isspace() and "\n" not in gap else " " * bool(gap), source[start:end]]
        at = end
    return "".join(pieces)


def _words(statements: Mapping[_Key, _Statement], key: _Key) -> tuple[str, ...] | None:
    return statements[key].words if key in statements else None


def _place(statements: Mapping[_Key, _Statement], key: _Key) -> TextPlace | None:
    return statements[key].place if key in statements else None


def _text(file: Specification, span: Span) -> str:
    return file.source[span.start : span.end]

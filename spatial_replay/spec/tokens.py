"""Tokens of a text: the words, numbers and signs of the language, with their places.

A token is lark's `Token`: `type` as declared in grammar.lark, `value` (of a quoted name, the name
itself), `start_pos`, `end_pos` and `line`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

from lark import Token

from spatial_replay.spec.diagnostics import Faults
from spatial_replay.spec.formula import Span
from spatial_replay.spec.spellings import STARTS_FORMULA, meant_sign, read_spellings, unit_hint

STATEMENT_TYPES: frozenset[str] = frozenset({"USE", "CONST", "SCALE", "REGION", "GROUP", "DEF", "SPEC"})
BINARY_TYPES: frozenset[str] = frozenset({"AND", "OR", "XOR", "IMPLIES", "IFF", "INFIX"})

KEYWORDS: Mapping[str, str] = MappingProxyType(
    {
        **{word: word.upper() for word in ("use", "const", "region", "group", "def", "spec")},
        **{word: word.upper() for word in ("in", "except", "all", "class", "height", "enlarge", "than")},
        **{word: word.upper() for word in ("polygon", "box", "circle", "dist", "closer", "between")},
        **{word: word.upper() for word in ("not", "and", "or", "xor", "implies")},
        "not_t": "NOT",
        "implies_t": "IMPLIES",
        "forall": "QUANTIFIER",
        "exists": "QUANTIFIER",
        "true": "TRUTH",
        "false": "TRUTH",
        **dict.fromkeys(("F", "G", "X", "WX", "Y", "O", "H"), "PREFIX"),
        **dict.fromkeys(("U", "R", "W", "S"), "INFIX"),
    }
)
"""Reserved words, apart from the names of relations."""

_SIGNS: Mapping[str, str] = MappingProxyType(
    {
        "<->": "IFF",
        "->": "IMPLIES",
        "!": "NOT",
        **dict.fromkeys(("&", "&&"), "AND"),
        **dict.fromkeys(("|", "||"), "OR"),
        "=>": "IMPLIES",
        **dict.fromkeys(("<=", ">=", "==", "!=", "<", ">"), "COMPARE"),
        "(": "LPAR",
        ")": "RPAR",
        "[": "LSQB",
        "]": "RSQB",
        ",": "COMMA",
        ":": "COLON",
        "=": "EQUAL",
        "-": "MINUS",
        "+": "PLUS",
        "*": "STAR",
        "/": "SLASH",
    }
)

_TOKEN = re.compile(
    r"""
      (?P<line>\r\n|\r|\n)
    | (?P<blank>[ \t\f\v\u00a0]+ | \#[^\r\n]*)
    | (?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?(?P<unit>[A-Za-z_][A-Za-z0-9_]*)?)
    | (?P<word>[A-Za-z_][A-Za-z0-9_]*)
    | (?P<quoted>"(?:[^"\\\r\n]|\\[^\r\n])*")
    | (?P<foreign>/\\|\\/|\\[A-Za-z]+|<=>|<-->|-->|==>|~>|//[^\r\n]*|/\*[^\r\n]*|--[ \t][^\r\n]*)
    | (?P<sign><->|->|<=|>=|==|=>|!=|&&|\|\||[<>!&|()\[\],:=+*/-])
    | (?P<unknown>"[^\r\n]*|[^\sA-Za-z0-9_"\#()\[\],:=<>!&|.+*/-]+|.)
    """,
    re.VERBOSE | re.DOTALL,
)
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_ESCAPED = re.compile(r"\\(.)", re.DOTALL)


def is_reserved(word: str, relations: Iterable[str]) -> bool:
    """Return whether a word is part of the language, given the names of its relations."""
    return word in KEYWORDS or word in relations


def written_name(name: str, relations: Iterable[str]) -> str:
    """Return a name as written in a text: in quotes unless it is an identifier that is not reserved."""
    if _IDENTIFIER.match(name) and not is_reserved(name, relations):
        return name
    return quoted(name)


def quoted(name: str) -> str:
    """Return a name in quotes."""
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def span_of(token: Token) -> Span:
    """Return the place of a token of `tokenize`."""
    return Span(token.start_pos or 0, token.end_pos or 0)


MAX_TOKENS = 40_000
"""Words, numbers and signs of a text."""


def tokenize(text: str, relations: frozenset[str], faults: Faults) -> list[Token]:
    """Return the tokens of a text; anything else is reported, and becomes a token of type ERROR.

    Of a text of more than `MAX_TOKENS`, those up to the bound, which is reported.
    """
    tokens: list[Token] = []
    line = 1
    for found in _TOKEN.finditer(text):
        kind, value = found.lastgroup, found.group()
        span = Span(found.start(), found.end())
        if kind == "line":
            line += 1
            continue
        if kind == "blank":
            continue
        if len(tokens) == MAX_TOKENS:
            message = f"the text has more than {MAX_TOKENS} words and signs"
            faults.add(span, message, "split it into several files")
            break
        if kind == "word":
            token_type = KEYWORDS.get(value) or ("RELATION" if value in relations else "NAME")
        elif kind == "sign":
            token_type = _SIGNS[value]
        elif kind == "quoted":
            token_type = "TITLE" if _is_title_expected(tokens) else "NAME"
            value = _unquoted(value, span, faults)
        elif kind == "foreign":
            sign = value[:2] if value.startswith(("//", "/*", "-- ", "--\t")) else value
            faults.add(span, f"'{sign}' is not part of the language", meant_sign(sign))
            token_type = "ERROR"
        elif kind == "unknown":
            _report_unknown(value, span, faults, tokens, text[found.end() : found.end() + 1])
            token_type = "ERROR"
        else:
            token_type = "NUMBER"
            unit = found.group("unit")
            if unit is not None and unit not in ("s", "ms"):
                hint = _unit_hint(value, unit)
                faults.add(span, f"{value!r} is neither a number, nor a duration, nor a name", hint)
                value = value[: -len(unit)]
        tokens.append(Token(token_type, value, span.start, line, None, line, None, span.end))
    return read_spellings(_with_scales(_join_published_spellings(tokens)), faults)


def _with_scales(tokens: list[Token]) -> list[Token]:
    """Read `scale NAME =` as a statement; anywhere else `scale` is a name like others."""
    for index, token in enumerate(tokens[:-2]):
        following = [each.type for each in tokens[index + 1 : index + 3]]
        if token.value == "scale" and token.type == "NAME" and following == ["NAME", "EQUAL"]:
            before = tokens[index - 1] if index else None
            if before is None or before.line != token.line:
                token.type = "SCALE"
    return tokens


def _is_title_expected(before: list[Token]) -> bool:
    """Return whether a quoted text is the title of a spec: behind its name, or its parameter."""
    if not before:
        return False
    if before[-1].type == "NAME":
        return len(before) > 1 and before[-2].type == "SPEC"
    # no quoted name can follow a closing bracket
    return before[-1].type == "RPAR"


def _unquoted(literal: str, span: Span, faults: Faults) -> str:
    name = literal[1:-1]
    if not name:
        faults.add(span, "a name is empty", "write at least one character between the quotes")
        return "?"
    for escape in _ESCAPED.finditer(name):
        if escape.group(1) not in '"\\':
            at = span.start + 1 + escape.start()
            hint = 'in quotes, \\" stands for a quote and \\\\ for a backslash'
            faults.add(Span(at, at + 2), f"unknown escape {escape.group()!r} in a name", hint)
    return _ESCAPED.sub(r"\1", name)


def _unit_hint(text: str, unit: str) -> str:
    hint = unit_hint(text.removesuffix(unit), unit)
    return hint or f"units of time are s and ms; a name is written in quotes: {quoted(text)}"


def _report_unknown(text: str, span: Span, faults: Faults, before: Sequence[Token], after: str) -> None:
    if text == "." and (not after or after.isspace()):
        faults.add(span, "a full stop behind a statement", meant_sign(";"))
        return
    if text == "}" and any(token.value == "{" for token in before[-8:]):
        # it is reported where it opens
        return
    if text == "." and before and before[-1].type == "NAME" and before[-1].end_pos == span.start:
        owner = before[-1].value
        message = f"an object has no fields, so nothing is behind {owner!r}"
        hint = (
            f"compare places by relations, such as {owner} leftof b; a name with a dot is written in quotes"
        )
        faults.add(span, message, hint)
        return
    if text.startswith('"'):
        faults.add(span, "a quoted name does not end on its line", 'close it with "')
        return
    hint = meant_sign(text) or "a name with other characters than A-Z, a-z, 0-9 and _ is written in quotes"
    faults.add(span, f"the character {text[0]!r} is not part of the language", hint)


def _join_published_spellings(tokens: list[Token]) -> list[Token]:
    """Read `!t` and `->t` as one operator where an operand follows them, not an object named t."""
    joined: list[Token] = []
    for index, token in enumerate(tokens):
        if (
            token.value == "t"
            and joined
            and joined[-1].value in ("!", "->")
            and joined[-1].end_pos == token.start_pos
            and (token.end_pos or 0) - (token.start_pos or 0) == 1
            and index + 1 < len(tokens)
            and tokens[index + 1].type in STARTS_FORMULA
        ):
            sign = joined.pop()
            value = sign.value + "t"
            joined.append(
                Token(sign.type, value, sign.start_pos, sign.line, None, sign.line, None, token.end_pos)
            )
        else:
            joined.append(token)
    return joined

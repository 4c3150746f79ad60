"""Spellings of other tools: those that are clear are read as ours, others get the one that is meant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType

from lark import Token

from spatial_replay.spec.diagnostics import Faults
from spatial_replay.spec.formula import Span

_PREFIX_WORDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "always": ("PREFIX", "G"),
        "eventually": ("PREFIX", "F"),
        "next": ("PREFIX", "X"),
        "once": ("PREFIX", "O"),
        "historically": ("PREFIX", "H"),
        "NOT": ("NOT", "not"),
    }
)
_INFIX_WORDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "until": ("INFIX", "U"),
        "release": ("INFIX", "R"),
        "since": ("INFIX", "S"),
        "AND": ("AND", "and"),
        "OR": ("OR", "or"),
        "XOR": ("XOR", "xor"),
        "IMPLIES": ("IMPLIES", "->"),
    }
)
_MEANT: Mapping[str, str] = MappingProxyType(
    {"f": "F", "g": "G", "x": "X", "globally": "G", "finally": "F", "Always": "G", "Eventually": "F"}
)
"""Words that may just as well be names, and the operators they are taken for."""

_BEFORE_FORMULA = frozenset({"EQUAL", "LPAR", "RSQB", "COLON", "AND", "OR", "XOR", "IMPLIES", "IFF", "NOT"})
_AFTER_OPERAND = frozenset({"NAME", "RPAR", "RSQB", "NUMBER", "TRUTH"})
STARTS_FORMULA = frozenset(
    {"LPAR", "NAME", "NOT", "PREFIX", "TRUTH", "QUANTIFIER", "NUMBER", "MINUS", "ENLARGE", "ALL", "CLASS"}
)
_RELATIONS = frozenset({"RELATION", "DIST", "CLOSER", "BETWEEN", "COMPARE"})


def read_spellings(tokens: list[Token], faults: Faults) -> list[Token]:
    """Return the tokens with operators in the place of words that can be nothing else.

    A word counts only where no name could stand, so objects called `always` or `until` keep their names.
    """
    macros = {name.value for word, name in pairwise(tokens) if word.type in ("DEF", "SPEC")}
    result: list[Token] = []
    brackets: list[str] = []
    for index, token in enumerate(tokens):
        if token.type in ("LPAR", "LSQB"):
            brackets.append(token.type)
        elif token.type in ("RPAR", "RSQB") and brackets:
            brackets.pop()
        following = tokens[index + 1 : index + 3]
        if token.type == "COLON" and brackets and brackets[-1] == "LSQB":
            # G[0:5], as other tools write windows
            result.append(_as(token, "COMMA", ","))
        elif token.type == "NAME" and following and not _is_quoted(token):
            written = _word(token, result, following, macros)
            if written.type == "ERROR" and not _holds_formula(tokens[index + 1 :]):
                written = token
            if written.type == "ERROR":
                _report(token, faults)
            result.append(written)
        else:
            result.append(token)
    return result


def _word(token: Token, before: Sequence[Token], after: Sequence[Token], macros: set[str]) -> Token:
    prefix, infix = _PREFIX_WORDS.get(token.value), _INFIX_WORDS.get(token.value)
    if infix is not None and _is_between(before, after):
        return _as(token, *infix)
    if (prefix is None and token.value not in _MEANT) or not _is_in_front(before, after):
        return token
    if token.value in macros and after[0].type == "LPAR":
        return token
    return _as(token, "ERROR", token.value) if prefix is None else _as(token, *prefix)


def _holds_formula(after: Sequence[Token]) -> bool:
    """Return whether what follows is no list of arguments: up to its closing bracket, it relates objects."""
    depth = 0
    for token in after:
        depth += {"LPAR": 1, "LSQB": 1, "RPAR": -1, "RSQB": -1}.get(token.type, 0)
        if token.type in _RELATIONS:
            return True
        if depth <= 0 and token.type == "RPAR":
            return False
    return False


def _report(token: Token, faults: Faults) -> None:
    meant = _MEANT[token.value]
    hint = f"the operator is written {meant}, as in {meant} (a ovlp b); a macro is defined with def"
    faults.add(Span(token.start_pos or 0, token.end_pos or 0), f"{token.value!r} is not an operator", hint)


def _is_in_front(before: Sequence[Token], after: Sequence[Token]) -> bool:
    """Return whether a prefix operator can stand here, and no name can."""
    first = not before or before[-1].type in _BEFORE_FORMULA or before[-1].type in ("PREFIX", "INFIX")
    if not first and not (len(before) > 1 and before[-2].type == "USE"):
        return False
    if after[0].type == "LSQB":
        return len(after) > 1 and after[1].type != "MINUS"
    # "always until p" is the name `always`, unless a relation follows: then `until` is one
    if after[0].value in _INFIX_WORDS and after[0].type == "NAME":
        return len(after) > 1 and after[1].type in _RELATIONS
    return after[0].type in STARTS_FORMULA - {"MINUS"}


def _is_between(before: Sequence[Token], after: Sequence[Token]) -> bool:
    """Return whether an infix operator can stand here, and no name can."""
    if not before or before[-1].type not in _AFTER_OPERAND:
        return False
    if len(before) > 1 and before[-2].type in ("USE", "SPEC", "DEF", "CONST", "REGION", "GROUP", "SCALE"):
        return False
    if after[0].type == "LSQB":
        return len(after) > 1 and after[1].type != "MINUS"
    return after[0].type in STARTS_FORMULA


def _as(token: Token, kind: str, value: str) -> Token:
    return Token(kind, value, token.start_pos, token.line, None, token.line, None, token.end_pos)


def _is_quoted(token: Token) -> bool:
    return (token.end_pos or 0) - (token.start_pos or 0) > len(token.value)

"""What is legal, and may not mean what its author thinks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from lark import Token

from spatial_replay.spec.faults import Source
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    PAST_OPERATORS,
    Diagnostic,
    Formula,
    NamedSpec,
    Span,
    Temporal,
    operands_of,
)
from spatial_replay.spec.namespace import Namespace, kind_of
from spatial_replay.spec.syntax import BrokenStatement, SpecStatement
from spatial_replay.spec.tokens import BINARY_TYPES, STATEMENT_TYPES, span_of

_TIGHTNESS = MappingProxyType({"IFF": 0, "IMPLIES": 1, "OR": 2, "XOR": 3, "AND": 4})


@dataclass(slots=True)
class _Level:
    """Operators met since a bracket opened."""

    prefix: Token | None = None
    negation: Token | None = None
    binary: Token | None = None


def reach_warnings(tokens: Sequence[Token], source: Source, published: bool) -> Iterator[Diagnostic]:
    """Operators that, without brackets, reach further or elsewhere than a reader may think.

    Args:
        published: warn too wherever the published grammar groups otherwise. It knows no precedence:
            Boolean operators group to the right, `not` reaches as far as F and G, and U takes all
            on both of its sides.
    """
    levels = [_Level()]
    for token in tokens:
        level = levels[-1]
        if token.type in STATEMENT_TYPES:
            levels = [_Level()]
        elif token.type == "LPAR":
            levels.append(_Level())
        elif token.type == "RPAR":
            if len(levels) > 1:
                levels.pop()
        elif token.type == "PREFIX":
            levels[-1] = _Level(prefix=token)
        elif token.type == "COLON":
            levels[-1] = _Level()
        elif token.type == "NOT":
            level.negation = level.negation or token
        elif token.type in BINARY_TYPES:
            if level.prefix is not None:
                yield _reach(level.prefix, token, source)
                level.prefix = None
            if published:
                yield from _regrouped(level, token, source)
            level.binary = token


def _reach(prefix: Token, operator: Token, source: Source) -> Diagnostic:
    message = f"{prefix.value!r} reaches over {operator.value!r} up to the closing bracket"
    hint = f"write ({prefix.value} ...) {operator.value} ... or {prefix.value} (... {operator.value} ...)"
    return source.diagnostic("warning", span_of(prefix), message, hint)


def _regrouped(level: _Level, operator: Token, source: Source) -> Iterator[Diagnostic]:
    if level.negation is not None:
        message = f"the published grammar takes 'not' over {operator.value!r} as well; here it ends before it"
        yield source.diagnostic("warning", span_of(level.negation), message, "write the brackets you mean")
        level.negation = None
    elif level.binary is not None and _differs(level.binary, operator):
        pair = f"{level.binary.value!r} and {operator.value!r}"
        message = f"the published grammar groups {pair} the other way round"
        yield source.diagnostic("warning", span_of(operator), message, "write the brackets you mean")


def _differs(first: Token, second: Token) -> bool:
    if "INFIX" in (first.type, second.type):
        return first.type != second.type
    return _TIGHTNESS[first.type] > _TIGHTNESS[second.type]


def past_warnings(specs: Sequence[NamedSpec], source: Source) -> Iterator[Diagnostic]:
    """Past operators outside any future one: at the first sample, where there is no past, they stay."""
    warned: set[Span] = set()
    for spec in specs:
        stack: list[Formula] = [spec.formula] if spec.is_result else []
        while stack:
            node = stack.pop()
            if isinstance(node, Temporal) and node.operator in FUTURE_OPERATORS:
                continue
            if isinstance(node, Temporal) and node.operator in PAST_OPERATORS:
                if node.span not in warned:
                    warned.add(node.span)
                    message = f"{node.operator!r} looks back from the first sample, where there is no past"
                    hint = f"put it inside a future operator, such as G ({node.operator} ...)"
                    yield source.diagnostic("warning", node.span, message, hint)
                continue
            stack.extend(operands_of(node))


def unused_warnings(names: Namespace, source: Source) -> Iterator[Diagnostic]:
    """Definitions that nothing refers to; a spec is a result by itself."""
    for name, statement in names.definitions.items():
        if isinstance(statement, (SpecStatement, BrokenStatement)) or name in names.used:
            continue
        message = f"{name!r} is {kind_of(statement)} that nothing uses"
        yield source.diagnostic("warning", statement.name.span, message, "use it or leave it out")

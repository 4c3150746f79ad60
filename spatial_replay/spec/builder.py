"""Syntax nodes from parsed rules: one method for each rule of grammar.lark."""

from __future__ import annotations

from decimal import Decimal
from math import isfinite
from types import MappingProxyType
from typing import Any

from lark import Token

from spatial_replay.spec.formula import Span
from spatial_replay.spec.syntax import (
    Arithmetic,
    BooleanSyntax,
    BoundSyntax,
    Call,
    ComparisonSyntax,
    ConstStatement,
    DefStatement,
    Delayed,
    DistanceSyntax,
    Duration,
    Enlargement,
    Exclusion,
    FormulaSyntax,
    GroupStatement,
    Name,
    NumberSyntax,
    OpenGroup,
    Point,
    QuantifierSyntax,
    Quantity,
    RegionStatement,
    RelationSyntax,
    ScaleStatement,
    Shape,
    SpecStatement,
    TemporalSyntax,
    TruthSyntax,
    UseStatement,
    depth_of,
)
from spatial_replay.spec.tokens import span_of

MAX_DEPTH = 100
"""Brackets and operators within one another."""

MAX_EXCLUDED = 1000
"""Objects that one term leaves out of a group."""

MAX_DURATION_NS = 2**63 - 1

_BOOLEAN = MappingProxyType({"AND": "and", "OR": "or", "XOR": "xor", "IMPLIES": "->", "IFF": "<->"})
MIRRORED = MappingProxyType({"<=": ">=", "<": ">", ">=": "<=", ">": "<", "==": "==", "!=": "!="})
_NS = MappingProxyType({"s": Decimal(10**9), "ms": Decimal(10**6)})


class StatementError(Exception):
    """A fault found while a rule is built."""

    def __init__(self, span: Span, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.span, self.message, self.hint = span, message, hint


def _span(piece: Any) -> Span:
    return span_of(piece) if isinstance(piece, Token) else piece.span


def _cover(children: list[Any]) -> Span:
    present = [child for child in children if child is not None]
    return Span(_span(present[0]).start, _span(present[-1]).end)


def _deeper(operands: tuple[FormulaSyntax, ...], span: Span) -> int:
    depth = 1 + max(depth_of(operand) for operand in operands)
    if depth > MAX_DEPTH:
        hint = "give parts of it names of their own, with spec"
        raise StatementError(span, f"more than {MAX_DEPTH} operators within one another", hint)
    return depth


def _chain_hint(below: str, above: str) -> str:
    if {"==", "!="} & {below, above}:
        return "write a dist b == c, or c1 <= a dist b <= c2"
    if below[0] == above[0]:
        return "write the lesser limit first: c1 <= a dist b <= c2"
    return "write it as c1 <= a dist b <= c2, or as two comparisons joined by and"


def read_number(text: str, span: Span) -> float | Duration:
    """Return the value of a number or a duration as written.

    Raises:
        StatementError: for one too large, or a duration of less than whole nanoseconds.
    """
    unit = "ms" if text.endswith("ms") else "s" if text.endswith("s") else ""
    digits = text.removesuffix(unit)
    if not unit:
        value = float(digits)
        if not isfinite(value):
            hint = "numbers reach up to about 1.7e308"
            raise StatementError(span, f"{text} is too large for a number", hint)
        return value
    seconds = Decimal(digits)
    if seconds and not -40 < seconds.adjusted() < 40:
        raise StatementError(span, f"{text} is not a usable duration", "durations go from 1e-9s to 9e9s")
    ns = seconds * _NS[unit]
    if ns != int(ns) or ns > MAX_DURATION_NS:
        raise StatementError(span, f"{text} is not a usable duration", "give whole nanoseconds, at most 9e9s")
    return Duration(int(ns))


def _title(token: Token) -> str:
    text: str = token.value.strip()
    if not text:
        raise StatementError(span_of(token), "a title is empty", 'write "REQ-12: what must hold", or nothing')
    return text


def _arithmetic(operator: Any, operands: tuple[Quantity, ...], children: list[Any]) -> Arithmetic:
    span = _cover(children)
    depth = 1 + max([each.depth for each in operands if isinstance(each, Arithmetic)], default=0)
    if depth > MAX_DEPTH:
        hint = "give parts of it names of their own, with const"
        raise StatementError(span, f"more than {MAX_DEPTH} operations within one another", hint)
    return Arithmetic(operator, operands, span, depth)


def _looking_back(written: Quantity) -> Quantity:
    """Return how far a delay looks back: n of `[-n]`.

    Raises:
        StatementError: no minus sign leads what is written.
    """
    if isinstance(written, Arithmetic):
        leftmost: Quantity = written
        while isinstance(leftmost, Arithmetic) and len(leftmost.operands) == 2:
            leftmost = leftmost.operands[0]
        if isinstance(leftmost, Arithmetic):
            if leftmost is written:
                return written.operands[0]
            return Arithmetic("-", (written,), written.span, written.depth + 1)
    hint = "write [-3] for three samples earlier, [-2.5s] for 2.5 seconds"
    if isinstance(written, Name):
        hint = f"leave [{written.text}] out for what it is now; {hint}"
    raise StatementError(written.span, "the brackets behind an object look back, so expected '-'", hint)


class TreeBuilder:
    """Builds a node from the pieces of each rule, tokens included; lark calls a method by the rule's name."""

    # ------------------------------------------------------------------------------------ statements

    def use(self, children: list[Any]) -> UseStatement:
        return UseStatement(children[1])

    def const(self, children: list[Any]) -> ConstStatement:
        return ConstStatement(children[1], children[3], children[5])

    def scale(self, children: list[Any]) -> ScaleStatement:
        return ScaleStatement(children[1], children[3])

    def region(self, children: list[Any]) -> RegionStatement:
        _, name, _, shape, *height = children
        if height[0] is None:
            return RegionStatement(name, shape, None, None)
        return RegionStatement(name, shape, (height[2], height[4]), _cover(height))

    def group(self, children: list[Any]) -> GroupStatement:
        _, name, _, members = children
        if isinstance(members, OpenGroup):
            return GroupStatement(name, None, members)
        return GroupStatement(name, members, None)

    def definition(self, children: list[Any]) -> DefStatement:
        return DefStatement(children[1], children[3] or (), children[6])

    def spec(self, children: list[Any]) -> SpecStatement:
        _, name, _, parameters, _, title, _, formula = children
        return SpecStatement(name, parameters or (), formula, None if title is None else _title(title))

    def names(self, children: list[Any]) -> tuple[Name, ...]:
        return tuple(child for child in children if isinstance(child, Name))

    def name(self, children: list[Token]) -> Name:
        return Name(children[0].value, span_of(children[0]))

    def polygon(self, children: list[Any]) -> Shape:
        return Shape("polygon", children[2] or (), None, _cover(children))

    def box(self, children: list[Any]) -> Shape:
        corners = ((children[2], children[4]), (children[6], children[8]))
        return Shape("box", corners, None, _cover(children))

    def circle(self, children: list[Any]) -> Shape:
        return Shape("circle", (children[2],), children[4], _cover(children))

    def points(self, children: list[Any]) -> tuple[Any, ...]:
        return tuple(child for child in children if not isinstance(child, Token))

    parameters = arguments = points

    def point(self, children: list[Any]) -> Point:
        return (children[1], children[3])

    def number(self, children: list[Token]) -> NumberSyntax:
        span = _cover(children)
        return NumberSyntax(read_number(children[0].value, span), span)

    def negative(self, children: list[Any]) -> Arithmetic:
        return _arithmetic("-", (children[1],), children)

    def arithmetic(self, children: list[Any]) -> Arithmetic:
        first, token, second = children
        return _arithmetic(token.value, (first, second), children)

    def grouped(self, children: list[Any]) -> Quantity:
        inner: Quantity = children[1]
        return inner if isinstance(inner, Name) else inner._replace(span=_cover(children))

    # -------------------------------------------------------------------------------------- formulas

    def chain(self, children: list[Any]) -> BooleanSyntax:
        left, token, right = children
        operator: Any = _BOOLEAN[token.type]
        span = _cover(children)
        depth = _deeper((left, right), span_of(token))
        gathers = operator in ("and", "or") and isinstance(left, BooleanSyntax)
        if gathers and left.operator == operator and not left.is_bracketed:
            left.operands.append(right)
            return BooleanSyntax(operator, left.operands, span, max(left.depth, 1 + depth_of(right)))
        return BooleanSyntax(operator, [left, right], span, depth)

    def negation(self, children: list[Any]) -> BooleanSyntax:
        token, operand = children
        return BooleanSyntax("not", [operand], _cover(children), _deeper((operand,), span_of(token)))

    def infix(self, children: list[Any]) -> TemporalSyntax:
        left, token, bound, right = children
        depth = _deeper((left, right), span_of(token))
        return TemporalSyntax(token.value, span_of(token), bound, (left, right), _cover(children), depth)

    def prefix(self, children: list[Any]) -> TemporalSyntax:
        token, bound, operand = children
        depth = _deeper((operand,), span_of(token))
        return TemporalSyntax(token.value, span_of(token), bound, (operand,), _cover(children), depth)

    def bound(self, children: list[Any]) -> BoundSyntax:
        return BoundSyntax(children[1], children[3], _cover(children))

    def quantifier(self, children: list[Any]) -> QuantifierSyntax:
        token, variables, _, group, _, body = children
        depth = _deeper((body,), span_of(token))
        return QuantifierSyntax(token.value, variables, group, body, _cover(children), depth)

    def truth(self, children: list[Token]) -> TruthSyntax:
        return TruthSyntax(children[0].value == "true", span_of(children[0]))

    def call(self, children: list[Any]) -> Call:
        return Call(children[0], children[2] or (), _cover(children))

    def bracketed(self, children: list[Any]) -> Any:
        inner = children[1]
        if isinstance(inner, BooleanSyntax):
            return inner._replace(span=_cover(children), is_bracketed=True)
        return inner._replace(span=_cover(children))

    def relation(self, children: list[Any]) -> RelationSyntax:
        first, token, parameters, second = children
        operator = span_of(token)
        return RelationSyntax(token.value, operator, (first, second), parameters or (), _cover(children))

    def closer(self, children: list[Any]) -> RelationSyntax:
        first, token, second, _, third = children
        return RelationSyntax("closer", span_of(token), (first, second, third), (), _cover(children))

    def between(self, children: list[Any]) -> RelationSyntax:
        first, token, parameters, _, second, _, third, _ = children
        terms = (first, second, third)
        return RelationSyntax("between", span_of(token), terms, parameters or (), _cover(children))

    def distance(self, children: list[Any]) -> DistanceSyntax:
        first, _, second, token, limit = children
        if token.value == "!=":
            hint = "write what is too near or too far: a dist b <= c, a dist b >= c"
            raise StatementError(span_of(token), "a distance is hardly ever exactly a number", hint)
        return DistanceSyntax(first, second, ((token.value, limit),), _cover(children))

    def distance_within(self, children: list[Any]) -> DistanceSyntax:
        lower, below, first, _, second, above, upper = children
        for token, side in ((below, "left"), (above, "right")):
            if token.value not in ("<=", "<"):
                message = f"{token.value!r} cannot stand on the {side} of a chained comparison, only <= or <"
                raise StatementError(span_of(token), message, _chain_hint(below.value, above.value))
        comparisons = ((MIRRORED[below.value], lower), (above.value, upper))
        return DistanceSyntax(first, second, comparisons, _cover(children))

    def comparison(self, children: list[Any]) -> ComparisonSyntax:
        signal, token, limit = children
        return ComparisonSyntax(signal, token.value, limit, _cover(children))

    def turned_comparison(self, children: list[Any]) -> ComparisonSyntax:
        limit, token, signal = children
        return ComparisonSyntax(signal, MIRRORED[token.value], limit, _cover(children))

    # ----------------------------------------------------------------------------------------- terms

    def open_group(self, children: list[Any]) -> OpenGroup:
        if len(children) == 1:
            return OpenGroup(None, _cover(children))
        if children[1].text == "*":
            hint = "the group of every object is `all`"
            raise StatementError(children[1].span, "no class is named '*'", hint)
        return OpenGroup(children[1].text, _cover(children))

    def exclusion(self, children: list[Any]) -> Exclusion:
        group, _, name = children
        if isinstance(group, Exclusion):
            if len(group.excluded) >= MAX_EXCLUDED:
                hint = "name those that belong to the group instead"
                raise StatementError(name.span, f"more than {MAX_EXCLUDED} objects left out", hint)
            return Exclusion(group.group, (*group.excluded, name), _cover(children))
        return Exclusion(group, (name,), _cover(children))

    def enlarge(self, children: list[Any]) -> Enlargement:
        return Enlargement(children[2], children[4], _cover(children))

    def delayed(self, children: list[Any]) -> Delayed:
        term, _, amount, _ = children
        span = _cover(children)
        if isinstance(term, Delayed):
            raise StatementError(span, "a delay of a delayed object", "add the two up in one [-n]")
        return Delayed(term, _looking_back(amount), span)

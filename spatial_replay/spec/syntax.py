"""Syntax nodes of statements, formulas and terms, with their places; names are not resolved yet.

Nodes are named tuples, because declaring a named tuple takes a tenth of the time of a dataclass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

from lark import Token

from spatial_replay.spec.diagnostics import Span


@dataclass(frozen=True, slots=True)
class Duration:
    """Length of time, in whole nanoseconds."""

    ns: int


class Name(NamedTuple):
    """Name of an object or of a definition."""

    text: str
    span: Span

    @property
    def is_quoted(self) -> bool:
        """Whether the name is quoted in the text."""
        # a span includes the quotes, `text` does not
        return self.span.end - self.span.start > len(self.text)


class NumberSyntax(NamedTuple):
    """Number or duration in the text."""

    value: float | Duration
    span: Span


class Arithmetic(NamedTuple):
    """`first * second` or another operation; `-` with one operand is a negation.

    In formulas an operand can be a number, a signal or a distance; any other operand is a fault that name
    resolution reports.
    """

    operator: Literal["+", "-", "*", "/"]
    operands: tuple[Any, ...]
    span: Span
    depth: int


Quantity: TypeAlias = Name | NumberSyntax | Arithmetic

# ---------------------------------------------------------------------------------------------- terms


class OpenGroup(NamedTuple):
    """`all` (no class name) or `class "name"`."""

    class_name: str | None
    span: Span


class Exclusion(NamedTuple):
    """`group except a except b`."""

    group: TermSyntax
    excluded: tuple[Name, ...]
    span: Span


class Delayed(NamedTuple):
    """`term[-amount]`."""

    term: TermSyntax
    amount: Quantity
    span: Span


class Enlargement(NamedTuple):
    """`enlarge(term, radius)`."""

    term: TermSyntax
    radius: Quantity
    span: Span


class CentreSyntax(NamedTuple):
    """`center(term)`."""

    term: TermSyntax
    span: Span


DERIVED_TERMS = (OpenGroup, Exclusion, Delayed, Enlargement, CentreSyntax)
"""Kinds of terms that are not just a name; a name can also denote a number or a formula."""

TermSyntax: TypeAlias = Name | OpenGroup | Exclusion | Delayed | Enlargement | CentreSyntax

# ------------------------------------------------------------------------------------------- formulas


class TruthSyntax(NamedTuple):
    """`true` or `false`."""

    value: bool
    span: Span


class Call(NamedTuple):
    """`name(argument, ...)`: a use of a `def`, `present` or `abs`."""

    name: Name
    arguments: tuple[ArgumentSyntax, ...]
    span: Span


class RelationSyntax(NamedTuple):
    """`first relation[parameters] others`; `operator` is the place of the relation name."""

    relation: str
    operator: Span
    terms: tuple[TermSyntax, ...]
    parameters: tuple[Quantity, ...]
    span: Span


class DistanceSyntax(NamedTuple):
    """`first dist second`."""

    first: TermSyntax
    second: TermSyntax
    span: Span


class RateSyntax(NamedTuple):
    """`speed(a)`, `speed(a, b)` or `rate(signal)`; `function` is "speed" or "rate"."""

    function: str
    arguments: tuple[ArgumentSyntax, ...]
    span: Span


class ComparisonSyntax(NamedTuple):
    """`signal >= 3.0`, or a chain with three operands and two operators: `1 <= a dist b <= 2`."""

    operands: tuple[FormulaSyntax, ...]
    operators: tuple[Token, ...]
    span: Span


class BooleanSyntax(NamedTuple):
    """Boolean operator; consecutive `and` or `or` without brackets are one node with several operands."""

    operator: Literal["not", "and", "or", "xor", "->", "<->"]
    # a list, because the parser appends to it while it reads a chain
    operands: list[FormulaSyntax]
    span: Span
    depth: int
    is_bracketed: bool = False


class BoundSyntax(NamedTuple):
    """`[lower, upper]`: window of a temporal operator."""

    lower: Quantity
    upper: Quantity
    span: Span


class TemporalSyntax(NamedTuple):
    """Temporal operator; `keyword` is the place of its word."""

    operator: str
    keyword: Span
    bound: BoundSyntax | None
    operands: tuple[FormulaSyntax, ...]
    span: Span
    depth: int


class QuantifierSyntax(NamedTuple):
    """`forall variables in group: body`, or the same with `exists`."""

    quantifier: Literal["forall", "exists"]
    variables: tuple[Name, ...]
    group: TermSyntax
    body: FormulaSyntax
    span: Span
    depth: int


FormulaSyntax: TypeAlias = (
    Quantity
    | TruthSyntax
    | Call
    | RelationSyntax
    | DistanceSyntax
    | RateSyntax
    | ComparisonSyntax
    | BooleanSyntax
    | TemporalSyntax
    | QuantifierSyntax
)


ArgumentSyntax: TypeAlias = TermSyntax | FormulaSyntax


def depth_of(formula: FormulaSyntax) -> int:
    """Return the depth of a formula: nested operators above the deepest atom, plus 1 for the atom."""
    return formula.depth if isinstance(formula, (BooleanSyntax, TemporalSyntax, QuantifierSyntax)) else 1


# ----------------------------------------------------------------------------------------- statements

Point: TypeAlias = tuple[Quantity, Quantity]


class Shape(NamedTuple):
    """`polygon`, `box` or `circle`.

    Attributes:
        points: corners of a polygon, two opposite corners of a box, or the centre of a circle.
        radius: radius of a circle, else None.
    """

    kind: Literal["polygon", "box", "circle"]
    points: tuple[Point, ...]
    radius: Quantity | None
    span: Span


class UseStatement(NamedTuple):
    """`use profile`."""

    name: Name


class ConstStatement(NamedTuple):
    """`const name = value in [low, high]`; `range` is None if it is not written."""

    name: Name
    value: Quantity
    range: BoundSyntax | None


class ScaleStatement(NamedTuple):
    """`scale signal = value`, or `scale lengths = value`."""

    name: Name
    value: Quantity


class RegionStatement(NamedTuple):
    """`region name = shape height (bottom, top)`; `height` and `height_span` are None if not written."""

    name: Name
    shape: Shape
    height: tuple[Quantity, Quantity] | None
    height_span: Span | None


class GroupStatement(NamedTuple):
    """`group name = members`; an open group has `open_group` instead of `members`."""

    name: Name
    members: tuple[Name, ...] | None
    open_group: OpenGroup | None


class DefStatement(NamedTuple):
    """`def name(parameters) = body`."""

    name: Name
    parameters: tuple[Name, ...]
    body: FormulaSyntax


class SpecStatement(NamedTuple):
    """`spec name "title" = formula`; a spec with a parameter is a template."""

    name: Name
    parameters: tuple[Name, ...]
    formula: FormulaSyntax
    title: str | None = None


class BrokenStatement(NamedTuple):
    """Statement with a fault and a readable name; uses of the name are not reported as further faults."""

    name: Name


Statement: TypeAlias = (
    UseStatement
    | ConstStatement
    | ScaleStatement
    | RegionStatement
    | GroupStatement
    | DefStatement
    | SpecStatement
    | BrokenStatement
)

"""Statements, formulas and terms as written, with their places, before names are resolved.

They are named tuples: there are many kinds, and declaring one takes a tenth of what a dataclass takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

from lark import Token

from spatial_replay.spec.diagnostics import Span


@dataclass(frozen=True, slots=True)
class Duration:
    """A length of time in whole nanoseconds."""

    ns: int


class Name(NamedTuple):
    """The name of an object or of a definition."""

    text: str
    span: Span

    @property
    def is_quoted(self) -> bool:
        """Whether it was written in quotes."""
        return self.span.end - self.span.start > len(self.text)


class NumberSyntax(NamedTuple):
    """A number or a duration, as a value."""

    value: float | Duration
    span: Span


class Arithmetic(NamedTuple):
    """`first * second` or another operation; `-` with one operand is its negative.

    In formulas the operands are what was written there: a number, a signal, a distance or a mistake.
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
"""Kinds of terms without names, which may also be those of numbers or formulas."""

TermSyntax: TypeAlias = Name | OpenGroup | Exclusion | Delayed | Enlargement | CentreSyntax

# ------------------------------------------------------------------------------------------- formulas


class TruthSyntax(NamedTuple):
    """`true` or `false`."""

    value: bool
    span: Span


class Call(NamedTuple):
    """`name(argument, ...)`: a use of a `def`, or `abs`."""

    name: Name
    arguments: tuple[ArgumentSyntax, ...]
    span: Span


class RelationSyntax(NamedTuple):
    """`first relation[parameters] others`; `operator` is the place of the relation's name."""

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
    """`signal >= 3.0` or, with three operands, `1 <= a dist b <= 2`; `operators` are between them."""

    operands: tuple[FormulaSyntax, ...]
    operators: tuple[Token, ...]
    span: Span


class BooleanSyntax(NamedTuple):
    """A Boolean operator; `and` and `or` gather their operands until a bracket closes."""

    operator: Literal["not", "and", "or", "xor", "->", "<->"]
    operands: list[FormulaSyntax]
    span: Span
    depth: int
    is_bracketed: bool = False


class BoundSyntax(NamedTuple):
    """`[lower, upper]`, the window of a temporal operator."""

    lower: Quantity
    upper: Quantity
    span: Span


class TemporalSyntax(NamedTuple):
    """A temporal operator; `keyword` is the place of the operator itself."""

    operator: str
    keyword: Span
    bound: BoundSyntax | None
    operands: tuple[FormulaSyntax, ...]
    span: Span
    depth: int


class QuantifierSyntax(NamedTuple):
    """`forall variables in group: body`, or `exists`."""

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
    """Return the number of operators above the deepest atom, counting that atom."""
    return formula.depth if isinstance(formula, (BooleanSyntax, TemporalSyntax, QuantifierSyntax)) else 1


# ----------------------------------------------------------------------------------------- statements

Point: TypeAlias = tuple[Quantity, Quantity]


class Shape(NamedTuple):
    """`polygon`, `box` or `circle`.

    Attributes:
        points: corners of a polygon, two opposite corners of a box, the centre of a circle.
        radius: of a circle.
    """

    kind: Literal["polygon", "box", "circle"]
    points: tuple[Point, ...]
    radius: Quantity | None
    span: Span


class UseStatement(NamedTuple):
    """`use profile`."""

    name: Name


class ConstStatement(NamedTuple):
    """`const name = value in [low, high]`; without a range, that is None."""

    name: Name
    value: Quantity
    range: BoundSyntax | None


class ScaleStatement(NamedTuple):
    """`scale signal = value`, or `scale lengths = value`."""

    name: Name
    value: Quantity


class RegionStatement(NamedTuple):
    """`region name = shape height (bottom, top)`; without a height, both are None."""

    name: Name
    shape: Shape
    height: tuple[Quantity, Quantity] | None
    height_span: Span | None


class GroupStatement(NamedTuple):
    """`group name = members`; exactly one of `members` and `open_group` is given."""

    name: Name
    members: tuple[Name, ...] | None
    open_group: OpenGroup | None


class DefStatement(NamedTuple):
    """`def name(parameters) = body`."""

    name: Name
    parameters: tuple[Name, ...]
    body: FormulaSyntax


class SpecStatement(NamedTuple):
    """`spec name "title" = formula`; with a parameter, a template."""

    name: Name
    parameters: tuple[Name, ...]
    formula: FormulaSyntax
    title: str | None = None


class BrokenStatement(NamedTuple):
    """A statement that could not be read, but whose name is known: using it is not another fault."""

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

"""Statements, formulas and terms as written, with their places, before names are resolved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from spatial_replay.spec.formula import Span


@dataclass(frozen=True, slots=True)
class Duration:
    """A length of time in whole nanoseconds."""

    ns: int


@dataclass(frozen=True, slots=True)
class Name:
    """The name of an object or of a definition."""

    text: str
    span: Span

    @property
    def is_quoted(self) -> bool:
        """Whether it was written in quotes."""
        return self.span.end - self.span.start > len(self.text)


@dataclass(frozen=True, slots=True)
class NumberSyntax:
    """A number or a duration, as a value."""

    value: float | Duration
    span: Span


@dataclass(frozen=True, slots=True)
class Arithmetic:
    """`first * second` or another operation; `-` with one operand is its negative."""

    operator: Literal["+", "-", "*", "/"]
    operands: tuple[Quantity, ...]
    span: Span
    depth: int


Quantity: TypeAlias = Name | NumberSyntax | Arithmetic

# ---------------------------------------------------------------------------------------------- terms


@dataclass(frozen=True, slots=True)
class OpenGroup:
    """`all` (no class name) or `class "name"`."""

    class_name: str | None
    span: Span


@dataclass(frozen=True, slots=True)
class Exclusion:
    """`group except a except b`."""

    group: TermSyntax
    excluded: tuple[Name, ...]
    span: Span


@dataclass(frozen=True, slots=True)
class Delayed:
    """`term[-amount]`."""

    term: TermSyntax
    amount: Quantity
    span: Span


@dataclass(frozen=True, slots=True)
class Enlargement:
    """`enlarge(term, radius)`."""

    term: TermSyntax
    radius: Quantity
    span: Span


TermSyntax: TypeAlias = Name | OpenGroup | Exclusion | Delayed | Enlargement

# ------------------------------------------------------------------------------------------- formulas


@dataclass(frozen=True, slots=True)
class TruthSyntax:
    """`true` or `false`."""

    value: bool
    span: Span


@dataclass(frozen=True, slots=True)
class Call:
    """`name(argument, ...)`: a use of a `def`."""

    name: Name
    arguments: tuple[TermSyntax | NumberSyntax | Arithmetic, ...]
    span: Span


@dataclass(frozen=True, slots=True)
class RelationSyntax:
    """`first relation[parameters] others`; `operator` is the place of the relation's name."""

    relation: str
    operator: Span
    terms: tuple[TermSyntax, ...]
    parameters: tuple[Quantity, ...]
    span: Span


@dataclass(frozen=True, slots=True)
class DistanceSyntax:
    """`first dist second <= c`, or `c1 <= first dist second <= c2`.

    Attributes:
        comparisons: in the order written, each as if the distance stood on the left.
    """

    first: TermSyntax
    second: TermSyntax
    comparisons: tuple[tuple[str, Quantity], ...]
    span: Span


@dataclass(frozen=True, slots=True)
class ComparisonSyntax:
    """`signal >= 3.0`."""

    signal: Name
    operator: str
    limit: Quantity
    span: Span


@dataclass(frozen=True, slots=True)
class BooleanSyntax:
    """A Boolean operator; `and` and `or` gather their operands until a bracket closes."""

    operator: Literal["not", "and", "or", "xor", "->", "<->"]
    operands: list[FormulaSyntax]
    span: Span
    depth: int
    is_bracketed: bool = False


@dataclass(frozen=True, slots=True)
class BoundSyntax:
    """`[lower, upper]`, the window of a temporal operator."""

    lower: Quantity
    upper: Quantity
    span: Span


@dataclass(frozen=True, slots=True)
class TemporalSyntax:
    """A temporal operator; `keyword` is the place of the operator itself."""

    operator: str
    keyword: Span
    bound: BoundSyntax | None
    operands: tuple[FormulaSyntax, ...]
    span: Span
    depth: int


@dataclass(frozen=True, slots=True)
class QuantifierSyntax:
    """`forall variables in group: body`, or `exists`."""

    quantifier: Literal["forall", "exists"]
    variables: tuple[Name, ...]
    group: TermSyntax
    body: FormulaSyntax
    span: Span
    depth: int


FormulaSyntax: TypeAlias = (
    Name
    | TruthSyntax
    | Call
    | RelationSyntax
    | DistanceSyntax
    | ComparisonSyntax
    | BooleanSyntax
    | TemporalSyntax
    | QuantifierSyntax
)


def depth_of(formula: FormulaSyntax) -> int:
    """Return the number of operators above the deepest atom, counting that atom."""
    return formula.depth if isinstance(formula, (BooleanSyntax, TemporalSyntax, QuantifierSyntax)) else 1


# ----------------------------------------------------------------------------------------- statements

Point: TypeAlias = tuple[Quantity, Quantity]


@dataclass(frozen=True, slots=True)
class Shape:
    """`polygon`, `box` or `circle`.

    Attributes:
        points: corners of a polygon, two opposite corners of a box, the centre of a circle.
        radius: of a circle.
    """

    kind: Literal["polygon", "box", "circle"]
    points: tuple[Point, ...]
    radius: Quantity | None
    span: Span


@dataclass(frozen=True, slots=True)
class UseStatement:
    """`use profile`."""

    name: Name


@dataclass(frozen=True, slots=True)
class ConstStatement:
    """`const name = value in [low, high]`; without a range, that is None."""

    name: Name
    value: Quantity
    range: BoundSyntax | None


@dataclass(frozen=True, slots=True)
class ScaleStatement:
    """`scale signal = value`, or `scale lengths = value`."""

    name: Name
    value: Quantity


@dataclass(frozen=True, slots=True)
class RegionStatement:
    """`region name = shape height (bottom, top)`; without a height, both are None."""

    name: Name
    shape: Shape
    height: tuple[Quantity, Quantity] | None
    height_span: Span | None


@dataclass(frozen=True, slots=True)
class GroupStatement:
    """`group name = members`; exactly one of `members` and `open_group` is given."""

    name: Name
    members: tuple[Name, ...] | None
    open_group: OpenGroup | None


@dataclass(frozen=True, slots=True)
class DefStatement:
    """`def name(parameters) = body`."""

    name: Name
    parameters: tuple[Name, ...]
    body: FormulaSyntax


@dataclass(frozen=True, slots=True)
class SpecStatement:
    """`spec name "title" = formula`; with a parameter, a template."""

    name: Name
    parameters: tuple[Name, ...]
    formula: FormulaSyntax
    title: str | None = None


@dataclass(frozen=True, slots=True)
class BrokenStatement:
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

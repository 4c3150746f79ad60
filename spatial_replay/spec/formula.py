"""Terms, expressions, formulas and specifications, as frozen values.

Three layers, each built of the one before:

- a *term* names footprints: a tracked object, a region, a group, one of these earlier in time or
  enlarged;
- an *expression* is a number computed from terms in one sample: signed distance, enclosure,
  projections, and their sums, minima and maxima. Every spatial relation is such an expression
  (see `relations`), positive where the relation holds;
- a *formula* combines atoms (an expression, as it was written) by Boolean and temporal operators.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from spatial_replay.lazy import Displayed
from spatial_replay.spec.expressions import (
    ANY_CLASS,
    Axis,
    CentroidProjection,
    Earlier,
    Enlarged,
    Equality,
    Expression,
    Group,
    Maximum,
    Measurement,
    Minimum,
    Misalignment,
    Negative,
    Number,
    Projection,
    Protrusion,
    RegionName,
    Scaled,
    Side,
    Signal,
    SignedDistance,
    Sum,
    Term,
    TrackedName,
    Variable,
    as_expression,
    maximum,
    minimum,
)

if TYPE_CHECKING:
    from spatial_replay.spec.diagnostics import Diagnostic

# one home for all values of the language; those of `expressions` are passed on
__all__ = [  # noqa: RUF022
    "ANY_CLASS", "Axis", "CentroidProjection", "Earlier", "Enlarged", "Equality", "Expression", "Group",
    "Maximum", "Measurement", "Minimum", "Misalignment", "Negative", "Number", "Projection", "Protrusion",
    "RegionName",
    "Scaled", "Side", "Signal", "SignedDistance", "Sum", "Term", "TrackedName", "Variable", "as_expression",
    "maximum", "minimum",
    "Atom", "Boolean", "BooleanOperator", "Bound", "Constant", "Formula", "NamedSpec", "Outline",
    "Quantified", "Scale", "Span", "Specification", "Temporal", "TemporalOperator", "Truth",
    "FUTURE_OPERATORS", "PAST_OPERATORS", "expand", "iter_nodes", "operands_of", "operator_of",
]  # fmt: skip

# ------------------------------------------------------------------------------------------- formulas


class Span(NamedTuple):
    """A place in a source text: characters `start` up to, not including, `end`."""

    start: int
    end: int


@dataclass(frozen=True, slots=True)
class Bound:
    """The window of a temporal operator, both ends included; in samples or in nanoseconds.

    Attributes:
        lower: 0 <= lower.
        upper: lower <= upper; None where there is no upper end.
        unit: "samples" or "ns".
    """

    lower: int
    upper: int | None
    unit: Literal["samples", "ns"]


_NO_SPAN = Span(0, 0)


@dataclass(frozen=True, slots=True)
class Truth:
    """`true` or `false`: +inf or -inf."""

    value: bool
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)


@dataclass(frozen=True, slots=True)
class Atom:
    """A relation or a comparison: one number in each sample, at least 0 where it holds.

    Attributes:
        text: its canonical text, in the profile of its specification.
        relation: the relation's name ("closeto", "dist", ...; "signal" for a comparison of a signal).
        expression: its robustness.
        terms: what the relation is about, in the order written; none for a signal.
        parameters: what is written besides: numbers, an axis, a comparison's operators.
    """

    text: str
    relation: str
    expression: Expression
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)
    terms: tuple[Term, ...] = ()
    parameters: tuple[float | str, ...] = ()


BooleanOperator: TypeAlias = Literal["not", "and", "or", "xor", "->", "<->", "spec"]
"""`spec` has one operand and is that operand: a spec that only repeats another under its own name."""


@dataclass(frozen=True, slots=True)
class Boolean:
    """A Boolean operator: `not` and `spec` have one operand; `and` and `or` two or more; the rest two.

    Its `expansion` is the formula that defines it; None for `not`, `and` and `or` (see `expand`).
    """

    operator: BooleanOperator
    operands: tuple[Formula, ...]
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)
    expansion: Formula | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "expansion", _expansion(self.operator, self.operands))


TemporalOperator: TypeAlias = Literal["X", "WX", "F", "G", "U", "R", "W", "Y", "O", "H", "S"]
FUTURE_OPERATORS: frozenset[str] = frozenset({"X", "WX", "F", "G", "U", "R", "W"})
PAST_OPERATORS: frozenset[str] = frozenset({"Y", "O", "H", "S"})


@dataclass(frozen=True, slots=True)
class Temporal:
    """A temporal operator: U, R, W and S have two operands, the others one; X, WX and Y have no bound.

    Its `expansion` is the formula that defines R, W and WX; None for the others (see `expand`).
    """

    operator: TemporalOperator
    operands: tuple[Formula, ...]
    bound: Bound | None = None
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)
    expansion: Formula | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "expansion", _expansion(self.operator, self.operands, self.bound))


@dataclass(frozen=True, slots=True)
class Quantified:
    """`forall` or `exists` over an open group: one node, its members bound in each sample.

    Over several variables the members are ordered tuples of distinct ones. The body holds no temporal
    operator.

    Attributes:
        group: an open `Group`, or one `Earlier` (its members are those of then).
    """

    quantifier: Literal["forall", "exists"]
    variables: tuple[str, ...]
    group: Group | Earlier
    body: Formula
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)


Formula: TypeAlias = Truth | Atom | Boolean | Temporal | Quantified


def expand(formula: Formula) -> Formula:
    """Return a formula of the same value whose own operator is one that engines implement.

    These are `not`, `and`, `or`, X, F, G, U, Y, O, H and S. All others are written in terms of them when a
    node is made; trees, texts and ids are those of the formula as written. Operands stay as they are.
    """
    while isinstance(formula, (Boolean, Temporal)) and formula.expansion is not None:
        formula = formula.expansion
    return formula


def _expansion(operator: str, operands: tuple[Formula, ...], bound: Bound | None = None) -> Formula | None:
    first, last = operands[0], operands[-1]
    match operator:
        case "spec":
            return first
        case "->":
            return Boolean("or", (_not(first), last))
        case "xor":
            one, other = Boolean("and", (first, _not(last))), Boolean("and", (_not(first), last))
            return Boolean("or", (one, other))
        case "<->":
            one, other = Boolean("or", (_not(first), last)), Boolean("or", (_not(last), first))
            return Boolean("and", (one, other))
        case "WX":
            return _not(Temporal("X", (_not(first),)))
        case "R":
            return _not(Temporal("U", (_not(first), _not(last)), bound))
        case "W" if bound is None:
            # not "U or G": that would count as two unbounded operators, each doubling the online state
            return Temporal("R", (last, Boolean("or", (first, last))))
        case "W":
            return Boolean("or", (Temporal("U", operands, bound), Temporal("G", (first,), bound)))
    return None


def _not(operand: Formula) -> Boolean:
    return Boolean("not", (operand,))


def operands_of(formula: Formula) -> tuple[Formula, ...]:
    """Return the formulas directly below a node of the tree; a quantifier over an open group has none."""
    if isinstance(formula, (Boolean, Temporal)):
        return formula.operands
    return ()


def operator_of(formula: Formula) -> str:
    """Return the operator shown for a node: "and", "F", "forall", an atom's relation, "true", "false"."""
    match formula:
        case Boolean() | Temporal():
            return formula.operator
        case Quantified():
            return formula.quantifier
        case Truth():
            return "true" if formula.value else "false"
        case Atom():
            return formula.relation


def iter_nodes(formula: Formula) -> Iterator[tuple[int, int | None, Formula]]:
    """Yield the tree's nodes as (id, parent's id, node), from the root, 0, in the order of the text."""
    stack: list[tuple[int | None, Formula]] = [(None, formula)]
    identifier = 0
    while stack:
        parent, node = stack.pop()
        yield identifier, parent, node
        stack.extend((identifier, operand) for operand in reversed(operands_of(node)))
        identifier += 1


# -------------------------------------------------------------------------------------- specifications


@dataclass(frozen=True, slots=True)
class Outline:
    """A region's shape: a polygon, or with one vertex and a radius, a disc.

    Attributes:
        vertices: corners (x, y), in the order written; for a box counter-clockwise from (xmin, ymin).
        radius: rounding radius, 0 for polygons and boxes.
        height: (bottom, top), or None.
    """

    vertices: tuple[tuple[float, float], ...]
    radius: float = 0.0
    height: tuple[float, float] | None = None

    @property
    def is_disc(self) -> bool:
        """Whether it is a disc about its only vertex."""
        return self.radius > 0.0


@dataclass(frozen=True, slots=True)
class NamedSpec:
    """One `spec` statement.

    Attributes:
        parameter: the object parameter of a template, or None.
        is_result: whether no other spec of the file uses it; these are the results listed.
        id, title: "REQ-12" and "no one is hit" of `spec calm "REQ-12: no one is hit" = ...`, or None.
    """

    name: str
    formula: Formula
    parameter: str | None = None
    is_result: bool = True
    span: Span = field(default=_NO_SPAN, compare=False)
    id: str | None = None
    title: str | None = None


@dataclass(frozen=True, slots=True)
class Constant:
    """What a `const` statement stands for: a number, or the seconds of a duration.

    Attributes:
        duration_ns: None for a number.
        range: the least and greatest value that its line allows, or None.
        is_computed: whether it follows from other constants.
    """

    value: float
    duration_ns: int | None = None
    range: tuple[float, float] | None = None
    is_computed: bool = False


@dataclass(frozen=True, slots=True)
class Scale:
    """What the numbers of some atoms are divided by: those about one signal, or (None) about lengths."""

    signal: str | None
    divisor: float


@dataclass(frozen=True)
class Specification(Displayed):
    """All specs of one text, parsed: macros, constants and named quantifiers expanded.

    Equality is of meaning: the source text, its file name, constants and warnings do not count.

    Attributes:
        specs: every `spec`, in the order of the text.
        profile: the relation profile, "paper" or "spatial_spec".
        regions: shapes by name.
        groups: declared groups by name.
        relations: names of the relations that were given in Python.
        constants: by name; formulas have their values already.
        scales: what the numbers of atoms are divided by; formulas have that already.
        source: the text it was parsed from, without a byte order mark; spans are offsets into it.
        filename: base name of the file it came from, or "<text>".
        warnings: what `check` warns of.
    """

    specs: tuple[NamedSpec, ...]
    profile: str
    regions: dict[str, Outline] = field(default_factory=dict)
    groups: dict[str, Group] = field(default_factory=dict)
    relations: frozenset[str] = frozenset()
    constants: dict[str, Constant] = field(default_factory=dict, compare=False)
    source: str = field(default="", compare=False)
    filename: str = field(default="<text>", compare=False)
    warnings: tuple[Diagnostic, ...] = field(default=(), compare=False)
    scales: tuple[Scale, ...] = ()

    @property
    def results(self) -> tuple[NamedSpec, ...]:
        """The specs that no other spec uses: what an evaluation reports on."""
        return tuple(spec for spec in self.specs if spec.is_result)

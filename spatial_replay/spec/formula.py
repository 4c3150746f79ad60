"""Terms, expressions, formulas and specifications, as frozen values.

Three layers, each built of the one before:

- a *term* names footprints: a tracked object, a region, a group, one of these earlier in time or
  enlarged, or its centre;
- an *expression* is a number computed from terms in one sample: signed distance, enclosure,
  projections, and their sums, minima and maxima. Every spatial relation is such an expression
  (see `relations`), positive where the relation holds;
- a *formula* combines atoms (an expression, as it was written) by Boolean and temporal operators.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import ClassVar, Final, Literal, Self, TypeAlias

from spatial_replay.lazy import Displayed
from spatial_replay.spec.diagnostics import Diagnostic, Span

Axis: TypeAlias = Literal["x", "y", "z"]
Side: TypeAlias = Literal["min", "max"]

# -------------------------------------------------------------------------------------------- numbers


class NamedNumber(float):
    """A number that constants give, which stays equal to the number alone.

    Attributes:
        constants: the names of the constants that it is computed from.
        is_plain: whether it is the value of the only one of them.
    """

    __slots__ = ("constants", "is_plain")
    constants: tuple[str, ...]
    is_plain: bool

    def __new__(cls, value: float, constants: tuple[str, ...] = (), *, is_plain: bool = False) -> Self:
        number = super().__new__(cls, value)
        number.constants, number.is_plain = constants, is_plain
        return number


# ---------------------------------------------------------------------------------------------- terms


@dataclass(frozen=True, slots=True)
class TrackedName:
    """A tracked object of the log, by its name."""

    name: str


@dataclass(frozen=True, slots=True)
class Variable:
    """An object still to be bound: by an open quantifier, or the parameter of a template."""

    name: str


@dataclass(frozen=True, slots=True)
class RegionName:
    """A region of the specification, by its name; `Specification.regions` holds its shape."""

    name: str


@dataclass(frozen=True, slots=True)
class Group:
    """A set of tracked objects; as a term, the union of its members' footprints.

    Exactly one of `members` (a named group) and `class_name` (an open group) is given.

    Attributes:
        name: the name it was declared under; "" for one written in place.
        members: names of the members, in the order written; None for an open group.
        class_name: objects of this class in the sample, ignoring case; `ANY_CLASS` for every object.
        excluded: members left out, by name or by variable.
    """

    name: str
    members: tuple[str, ...] | None = None
    class_name: str | None = None
    excluded: tuple[TrackedName | Variable, ...] = ()

    @property
    def is_open(self) -> bool:
        """Whether members are those of the current sample rather than fixed by name."""
        return self.members is None


ANY_CLASS = "*"
"""The `class_name` of the open group of every object (`group g = all`)."""


@dataclass(frozen=True, slots=True)
class Earlier:
    """A term as it was earlier; exactly one of `samples`, `duration_ns` and `rate` is given.

    `a[-3]` is that of 3 samples before, `a[-2.5s]` that of the last sample at or before that much earlier.
    A rate moves a term back by its own velocity between the last two reports, over the shortest time between
    two reports of any of the terms in `rate`.
    """

    term: TrackedName | Variable | RegionName | Group
    samples: int | None = None
    duration_ns: int | None = None
    rate: tuple[TrackedName | Variable | Group, ...] = ()


@dataclass(frozen=True, slots=True)
class Enlarged:
    """The Minkowski sum of a term with a disc in the plane (`enlarge(a, r)`); heights stay."""

    term: Term
    radius: float


@dataclass(frozen=True, slots=True)
class Centre:
    """The point at a term's centroid (`center(a)`), halfway up; of a group, that of each member."""

    term: TrackedName | Variable | RegionName | Group | Earlier


DerivedTerm: TypeAlias = Earlier | Enlarged | Centre
"""A term made of another, which it has as `term`; `replace` makes the same of a further one."""
Term: TypeAlias = TrackedName | Variable | RegionName | Group | DerivedTerm

# ---------------------------------------------------------------------------------------- expressions


class _Arithmetic:
    """Operators of expressions, so that a relation reads like its definition."""

    __slots__ = ()

    def __add__(self, other: Expression | float) -> Sum:
        return Sum(as_expression(self), as_expression(other))

    def __radd__(self, other: Expression | float) -> Sum:
        return Sum(as_expression(other), as_expression(self))

    def __sub__(self, other: Expression | float) -> Sum:
        return Sum(as_expression(self), Negative(as_expression(other)))

    def __rsub__(self, other: Expression | float) -> Sum:
        return Sum(as_expression(other), Negative(as_expression(self)))

    def __neg__(self) -> Negative:
        return Negative(as_expression(self))


@dataclass(frozen=True, slots=True)
class Number(_Arithmetic):
    """A constant, in the units of the footprints or of the signal it is compared with."""

    value: float


class Measurement(_Arithmetic):
    """A number that geometry computes of one or two terms.

    A group is the union of its members: the measurement is that of the members that `extrema` picks.

    Attributes:
        unit: of its number.
        needs_orientation: whether it compares the orientations of single objects, not footprints.
    """

    __slots__ = ()
    unit: ClassVar[Literal["length", "orientation"]] = "length"
    needs_orientation: ClassVar[bool] = False

    @property
    @abstractmethod
    def quantity(self) -> str:
        """Its name in explanations; if it measures footprints, a key of `kernels.QUANTITY_CODES`, too."""

    @property
    @abstractmethod
    def terms(self) -> tuple[Term, ...]:
        """The one or two terms that it measures."""

    @abstractmethod
    def with_terms(self, *terms: Term) -> Self:
        """Return the same measurement of other terms, as many as in `terms`."""

    @property
    @abstractmethod
    def extrema(self) -> tuple[Side, ...]:
        """Which member of a group decides, for each term; that of the first one is picked last."""

    @property
    def radius_effects(self) -> tuple[int, ...]:
        """How much the number grows with the radius by which each term is enlarged: 1, 0 or -1."""
        return (0,) * len(self.terms)


@dataclass(frozen=True, slots=True)
class _OfTwo(Measurement):
    first: Term
    second: Term

    @property
    def terms(self) -> tuple[Term, Term]:
        return self.first, self.second

    def with_terms(self, *terms: Term) -> Self:
        return type(self)(*terms)

    @property
    def extrema(self) -> tuple[Side, Side]:
        return "min", "min"


@dataclass(frozen=True, slots=True)
class _AlongAxis(Measurement):
    term: Term
    axis: Axis
    side: Side

    @property
    def terms(self) -> tuple[Term]:
        return (self.term,)

    def with_terms(self, *terms: Term) -> Self:
        (term,) = terms
        return type(self)(term, self.axis, self.side)

    @property
    def extrema(self) -> tuple[Side]:
        return (self.side,)


@dataclass(frozen=True, slots=True)
class _OfSeveral(_Arithmetic):
    operands: tuple[Expression, ...]


class SignedDistance(_OfTwo):
    """Distance of two footprints when apart, minus their penetration depth when not (Def. 2-4)."""

    __slots__ = ()
    quantity = "signed_distance"
    radius_effects = (-1, -1)


@dataclass(frozen=True, slots=True)
class Protrusion(Measurement):
    """How far `inner` sticks out: max over hull(inner) of the signed distance to outer (Prop. 2)."""

    inner: Term
    outer: Term
    quantity = "protrusion"
    extrema = ("max", "min")
    radius_effects = (1, -1)

    @property
    def terms(self) -> tuple[Term, Term]:
        return self.inner, self.outer

    def with_terms(self, *terms: Term) -> Self:
        return type(self)(*terms)


class Projection(_AlongAxis):
    """Least or greatest coordinate of a footprint along an axis (Def. 8)."""

    __slots__ = ()

    @property
    def quantity(self) -> str:
        return f"{self.side}_{self.axis}"

    @property
    def radius_effects(self) -> tuple[int]:
        # a disc in the plane leaves heights
        return (0 if self.axis == "z" else 1 if self.side == "max" else -1,)


class CentroidProjection(_AlongAxis):
    """Least or greatest coordinate, along x or y, of the centroids of a footprint's parts."""

    __slots__ = ()

    @property
    def quantity(self) -> str:
        return f"centroid_{self.side}_{self.axis}"


class Misalignment(_OfTwo):
    """Half the squared distance of two unit orientation vectors, 1 - cos of their angle (Def. 10)."""

    __slots__ = ()
    quantity = "misalignment"
    unit = "orientation"
    needs_orientation = True


@dataclass(frozen=True, slots=True)
class Signal(_Arithmetic):
    """A named numeric signal of the log."""

    name: str


@dataclass(frozen=True, slots=True)
class ComputedSignal(Signal):
    """A signal that a plug-in computes of each sample; `plugin` is its module or file (see `relations`)."""

    plugin: str


@dataclass(frozen=True, slots=True)
class PreviousSignal(Signal):
    """A signal at its last report but the one that the sample shows."""

    signal: Signal


@dataclass(frozen=True, slots=True)
class Rate(Signal):
    """A rate of change between reports, per second: `speed(a)`, `speed(a, b)`, `rate(signal)`.

    To sentences and rules it is a signal; its numbers are computed (see `walks.change_of`).

    Attributes:
        name: as written.
        terms: those of a speed.
        signal: that of `rate`, else None.
    """

    terms: tuple[Term, ...]
    signal: Signal | None = None


@dataclass(frozen=True, slots=True)
class ReportStep(Signal):
    """The seconds between the two reports that a rate compares; of several terms, the shortest time.

    Attributes:
        terms: those of a speed that move.
        signal: that of `rate`, else None.
    """

    terms: tuple[TrackedName | Variable | Group, ...]
    signal: Signal | None = None


@dataclass(frozen=True, slots=True)
class HasRate(Signal):
    """Whether a rate has a value: 1 or 0; unknown where an object or the signal of it is missing."""

    rate: Rate


@dataclass(frozen=True, slots=True)
class Present(Signal):
    """Whether a sample has an object, wherever it is: 1 or 0, never unknown (`present(a)`)."""

    term: TrackedName | Variable


@dataclass(frozen=True, slots=True)
class Equality(_Arithmetic):
    """+inf where a signal is equal to a number, -inf where it is not; unknown where the signal is.

    A text is its `text_number`; whether a number is equal to a text is unknown.
    """

    signal: Signal
    value: float


@dataclass(frozen=True, slots=True)
class Sum(_Arithmetic):
    """`first` + `second`."""

    first: Expression
    second: Expression


@dataclass(frozen=True, slots=True)
class Negative(_Arithmetic):
    """-`operand`: how far a relation is from holding becomes how far it is from failing."""

    operand: Expression


class Minimum(_OfSeveral):
    """The least of its operands, as in a conjunction."""

    __slots__ = ()


class Maximum(_OfSeveral):
    """The greatest of its operands, as in a disjunction."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Product(_Arithmetic):
    """`factor` * `operand`; factor > 0."""

    factor: float
    operand: Expression


@dataclass(frozen=True, slots=True)
class Scaled(_Arithmetic):
    """`operand` / `divisor`: written so, or of a `scale` line; divisor > 0."""

    operand: Expression
    divisor: float


Expression: TypeAlias = (
    Number | Measurement | Signal | Equality | Sum | Negative | Minimum | Maximum | Product | Scaled
)


def as_expression(value: object) -> Expression:
    """Return a number as an expression, and an expression as it is.

    Raises:
        TypeError: for anything else.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, _Arithmetic)):
        raise TypeError(f"{value!r} is neither a number nor an expression over terms")
    if isinstance(value, (int, float)):
        return Number(value if isinstance(value, float) else float(value))
    return value  # type: ignore[return-value]


def minimum(*operands: Expression | float) -> Minimum:
    """Return the least of some expressions."""
    return Minimum(tuple(as_expression(operand) for operand in operands))


def maximum(*operands: Expression | float) -> Maximum:
    """Return the greatest of some expressions."""
    return Maximum(tuple(as_expression(operand) for operand in operands))


# ------------------------------------------------------------------------------------------- formulas


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
        relation: the relation's name ("closeto", "dist", ...; "signal" for a comparison of a signal; "sum"
            for one of computed numbers).
        expression: its robustness.
        terms: what the relation is about, in the order written; none for a signal.
        parameters: what is written besides: numbers, an axis, a comparison's operators. The text of a "sum"
            is that of its expression.
    """

    text: str
    relation: str
    expression: Expression
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)
    terms: tuple[Term, ...] = ()
    parameters: tuple[float | str, ...] = ()


BooleanOperator: TypeAlias = Literal["not", "and", "or", "xor", "->", "<->", "spec", "given", "with"]
"""`spec` has one operand and is that operand: a spec that only repeats another under its own name.

`given` and `with` are in expansions alone: an operand of an operator that leaves samples without a rate out
(see `judged_operands`). Their first operand is that there is a rate, their last one what was written.
"""


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

    Its `expansion` is the formula that defines R, W and WX, and any operator over a rate (see
    `judged_operands`); None for the others (see `expand`).
    """

    operator: TemporalOperator
    operands: tuple[Formula, ...]
    bound: Bound | None = None
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)
    expansion: Formula | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        operands = judged_operands(self.operator, self.operands)
        expansion: Formula | None = None
        if operands is self.operands:
            expansion = _expansion(self.operator, operands, self.bound)
        else:
            expansion = Temporal(self.operator, operands, self.bound)
        object.__setattr__(self, "expansion", expansion)


@dataclass(frozen=True, slots=True)
class Quantified:
    """`forall` or `exists` over an open group: one node, its members bound in each sample.

    Over several variables the members are ordered tuples of distinct ones. The body holds no temporal
    operator.

    Attributes:
        group: an open `Group`, or one `Earlier` (its members are those of then).
        judged: the body that is evaluated: it leaves members without a rate out (see `judged_operands`).
    """

    quantifier: Literal["forall", "exists"]
    variables: tuple[str, ...]
    group: Group | Earlier
    body: Formula
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)
    judged: Formula = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "judged", judged_operands(self.quantifier, (self.body,))[0])


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
        case "->" | "given":
            return Boolean("or", (_not(first), last))
        case "with":
            return Boolean("and", operands)
        case "xor":
            first_alone, last_alone = Boolean("and", (first, _not(last))), Boolean("and", (_not(first), last))
            return Boolean("or", (first_alone, last_alone))
        case "<->":
            forward, backward = Boolean("or", (_not(first), last)), Boolean("or", (_not(last), first))
            return Boolean("and", (forward, backward))
        case "WX":
            return _not(Temporal("X", (_not(first),)))
        # over a window that begins later, F takes less than half of the time of U
        case "U" if first == Truth(True):
            return Temporal("F", (last,), bound)
        case "S" if first == Truth(True):
            return Temporal("O", (last,), bound)
        case "R" if first == Truth(False):
            return Temporal("G", (last,), bound)
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


_LEFT_OUT_AS: Final[Mapping[str, tuple[BooleanOperator, ...]]] = MappingProxyType(
    {
        **dict.fromkeys(("G", "H", "forall"), ("given",)),
        **dict.fromkeys(("F", "O", "exists"), ("with",)),
        **dict.fromkeys(("U", "S", "W"), ("given", "with")),
        "R": ("with", "given"),
    }
)
"""How each operator that ranges over samples or members leaves one out, by operand."""


def judged_operands(operator: str, operands: tuple[Formula, ...]) -> tuple[Formula, ...]:
    """Return operands with the samples or members left out in which a rate has no value yet.

    They are the same tuple where no rate stands in them without such an operator in between.
    """
    conditions = [rate_conditions(operand) for operand in operands] if operator in _LEFT_OUT_AS else []
    if not any(conditions):
        return operands
    return tuple(
        Boolean(how, (_all(operand_conditions), operand), name=operand.name)
        if operand_conditions
        else operand
        for how, operand_conditions, operand in zip(_LEFT_OUT_AS[operator], conditions, operands, strict=True)
    )


def judged_operator(formula: Temporal) -> Temporal:
    """Return a temporal operator with the operands that it reads (see `judged_operands`)."""
    expansion = formula.expansion
    is_judged = isinstance(expansion, Temporal) and expansion.operator == formula.operator
    return expansion if is_judged else formula  # type: ignore[return-value]


def rate_conditions(formula: Formula) -> list[Formula]:
    """Return that each rate in a formula has a value, in the samples in which the formula reads them.

    Rates within an operator that leaves samples out itself do not count. Before the first sample and after
    the last one there is nothing to leave out, and so the conditions hold there.
    """
    match formula:
        case Atom():
            return [_has_value(rate) for rate in dict.fromkeys(_rates_of(formula.expression))]
        case Boolean() if formula.operator not in ("given", "with"):
            return list(
                dict.fromkeys(condition for part in formula.operands for condition in rate_conditions(part))
            )
        case Temporal(operator="X" | "WX"):
            return [Temporal("WX", (condition,)) for condition in rate_conditions(formula.operands[0])]
        case Temporal(operator="Y"):
            return [
                _not(Temporal("Y", (_not(condition),))) for condition in rate_conditions(formula.operands[0])
            ]
    return []


def _has_value(rate: Rate) -> Atom:
    return Atom(f"{rate.name} has a value", "signal", Equality(HasRate(rate.name, rate), 1.0))


def _rates_of(expression: Expression) -> Iterator[Rate]:
    match expression:
        case Rate():
            yield expression
        case Sum(first, second):
            yield from _rates_of(first)
            yield from _rates_of(second)
        case Negative(operand) | Product(operand=operand) | Scaled(operand):
            yield from _rates_of(operand)
        case Minimum(operands) | Maximum(operands):
            for operand in operands:
                yield from _rates_of(operand)


def _all(formulas: list[Formula]) -> Formula:
    return formulas[0] if len(formulas) == 1 else Boolean("and", tuple(formulas))


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
    """Value of a `const` statement: a number, or the seconds of a duration.

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
    """Divisor of the numbers of some atoms: atoms of one signal, or (None) of lengths."""

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
        relations: names of the relations that were given in Python, or by plug-ins.
        plugins: the SHA-256 of the file of each plug-in that the text uses.
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
    plugins: dict[str, str] = field(default_factory=dict)
    constants: dict[str, Constant] = field(default_factory=dict, compare=False)
    source: str = field(default="", compare=False)
    filename: str = field(default="<text>", compare=False)
    warnings: tuple[Diagnostic, ...] = field(default=(), compare=False)
    scales: tuple[Scale, ...] = ()

    @property
    def results(self) -> tuple[NamedSpec, ...]:
        """The specs that no other spec uses: what an evaluation reports on."""
        return tuple(spec for spec in self.specs if spec.is_result)

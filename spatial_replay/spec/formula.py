"""Terms, expressions, formulas and specifications, as frozen values.

There are three layers:

- A *term* names footprints: a tracked object, a region or a group. A term can also be delayed, enlarged or
  reduced to its centre.
- An *expression* is a number computed from terms in one sample: signed distance, enclosure,
  projections, and their sums, minima and maxima. Every spatial relation is an expression that is positive
  where the relation holds (see `relations`).
- A *formula* combines atoms by Boolean and temporal operators. An atom is an expression with its text.
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
    """Number that is computed from constants; it is equal to the same number without names.

    Attributes:
        constants: names of the constants.
        is_plain: whether the number is the value of a single constant, without arithmetic.
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
    """Tracked object of the log, by name."""

    name: str


@dataclass(frozen=True, slots=True)
class Variable:
    """Variable for an object: the variable of an open quantifier, or the parameter of a template."""

    name: str


@dataclass(frozen=True, slots=True)
class RegionName:
    """Region of the specification, by name; its shape is in `Specification.regions`."""

    name: str


@dataclass(frozen=True, slots=True)
class Group:
    """Set of tracked objects; as a term, the union of its members' footprints.

    A named group has `members`, an open group has `class_name`; the other attribute is None.

    Attributes:
        name: declared name; "" for a group written inside a formula.
        members: names of the members in text order.
        class_name: class of the members in each sample, ignoring case; `ANY_CLASS` for every object.
        excluded: excluded objects or variables.
    """

    name: str
    members: tuple[str, ...] | None = None
    class_name: str | None = None
    excluded: tuple[TrackedName | Variable, ...] = ()

    @property
    def is_open(self) -> bool:
        """Whether the members are determined in each sample instead of listed by name."""
        return self.members is None


ANY_CLASS = "*"
"""The `class_name` of the open group of every object (`group g = all`)."""


@dataclass(frozen=True, slots=True)
class Earlier:
    """Delayed term; exactly one of `samples`, `duration_ns` and `rate` is given.

    `a[-3]` is the term 3 samples earlier. `a[-2.5s]` is the term in the last sample that is at least 2.5 s
    earlier. With `rate`, the term is moved back along its velocity between its last two reports. The time of
    this motion is the shortest report interval of the terms in `rate`.
    """

    term: TrackedName | Variable | RegionName | Group
    samples: int | None = None
    duration_ns: int | None = None
    rate: tuple[TrackedName | Variable | Group, ...] = ()


@dataclass(frozen=True, slots=True)
class Enlarged:
    """Minkowski sum of a term with a disc in the plane (`enlarge(a, r)`); heights do not change."""

    term: Term
    radius: float


@dataclass(frozen=True, slots=True)
class Centre:
    """Centroid of a term at half its height (`center(a)`); a group has one centroid for each member."""

    term: TrackedName | Variable | RegionName | Group | Earlier


DerivedTerm: TypeAlias = Earlier | Enlarged | Centre
"""Term with an inner term, `term`; `replace(term, term=...)` derives another term in the same way."""
Term: TypeAlias = TrackedName | Variable | RegionName | Group | DerivedTerm

# ---------------------------------------------------------------------------------------- expressions


class _Arithmetic:
    """Arithmetic operators, so that the code of a relation looks like its definition."""

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
    """Constant, in the unit of the footprints or of the signal in the same comparison."""

    value: float


class Measurement(_Arithmetic):
    """Number that geometry computes from one or two terms.

    For a group, the number is computed for each member, and `extrema` selects one of these numbers.

    Attributes:
        unit: unit of the number.
        needs_orientation: whether orientations of single objects are compared instead of footprints.
    """

    __slots__ = ()
    unit: ClassVar[Literal["length", "orientation"]] = "length"
    needs_orientation: ClassVar[bool] = False

    @property
    @abstractmethod
    def quantity(self) -> str:
        """Name in explanations; the name of a footprint measurement is a key of `kernels.QUANTITY_CODES`."""

    @property
    @abstractmethod
    def terms(self) -> tuple[Term, ...]:
        """The measured terms, one or two."""

    @abstractmethod
    def with_terms(self, *terms: Term) -> Self:
        """Return the measurement with its terms replaced, one for one."""

    @property
    @abstractmethod
    def extrema(self) -> tuple[Side, ...]:
        """Extreme over the members of a group, one per term; the last term's extreme is computed first."""

    @property
    def radius_effects(self) -> tuple[int, ...]:
        """Change of the number per unit of a term's enlargement, by term: 1, 0 or -1."""
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
    """Distance of two footprints; if they overlap, minus their penetration depth (Def. 2-4)."""

    __slots__ = ()
    quantity = "signed_distance"
    radius_effects = (-1, -1)


@dataclass(frozen=True, slots=True)
class Protrusion(Measurement):
    """Protrusion of `inner` from `outer`: maximum over hull(inner) of the signed distance (Prop. 2)."""

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
        # `enlarge` adds a disc in the plane, which does not change heights
        return (0 if self.axis == "z" else 1 if self.side == "max" else -1,)


class CentroidProjection(_AlongAxis):
    """Least or greatest coordinate, along x or y, of the centroids of a footprint's parts."""

    __slots__ = ()

    @property
    def quantity(self) -> str:
        return f"centroid_{self.side}_{self.axis}"


class Misalignment(_OfTwo):
    """Half the squared distance of two unit orientation vectors: 1 - cos of their angle (Def. 10)."""

    __slots__ = ()
    quantity = "misalignment"
    unit = "orientation"
    needs_orientation = True


@dataclass(frozen=True, slots=True)
class Signal(_Arithmetic):
    """Numeric signal of the log, by name."""

    name: str


@dataclass(frozen=True, slots=True)
class ComputedSignal(Signal):
    """Signal that a plug-in computes from each sample; `plugin` is its module or file (see `relations`)."""

    plugin: str


@dataclass(frozen=True, slots=True)
class PreviousSignal(Signal):
    """Value of a signal one report earlier than its value in the sample."""

    signal: Signal


@dataclass(frozen=True, slots=True)
class Rate(Signal):
    """Rate of change between reports, per second: `speed(a)`, `speed(a, b)`, `rate(signal)`.

    A rate is handled like a signal in explanations and checks, but its numbers are computed (see
    `walks.change_of`).

    Attributes:
        name: text of the rate.
        terms: terms of a speed.
        signal: signal of `rate`; None for a speed.
    """

    terms: tuple[Term, ...]
    signal: Signal | None = None


@dataclass(frozen=True, slots=True)
class ReportStep(Signal):
    """Time between the last two reports of a rate's terms or signal, seconds; the shortest of several times.

    Attributes:
        terms: terms of a speed, without regions.
        signal: signal of `rate`; None for a speed.
    """

    terms: tuple[TrackedName | Variable | Group, ...]
    signal: Signal | None = None


@dataclass(frozen=True, slots=True)
class HasRate(Signal):
    """Whether a rate has a value: 1 or 0; unknown if its object or signal is missing."""

    rate: Rate


@dataclass(frozen=True, slots=True)
class Present(Signal):
    """Whether a sample contains an object: 1 or 0, never unknown (`present(a)`)."""

    term: TrackedName | Variable


@dataclass(frozen=True, slots=True)
class Equality(_Arithmetic):
    """+inf where a signal equals a number, -inf elsewhere; unknown where the signal is unknown.

    A text is represented by its `text_number`. The comparison of a number with a text is unknown.
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
    """-`operand`; as a robustness, the negation of a relation."""

    operand: Expression


class Minimum(_OfSeveral):
    """Minimum of the operands, as in a conjunction."""

    __slots__ = ()


class Maximum(_OfSeveral):
    """Maximum of the operands, as in a disjunction."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Product(_Arithmetic):
    """`factor` * `operand`; factor > 0."""

    factor: float
    operand: Expression


@dataclass(frozen=True, slots=True)
class Scaled(_Arithmetic):
    """`operand` / `divisor`, from a formula or a `scale` line; divisor > 0."""

    operand: Expression
    divisor: float


Expression: TypeAlias = (
    Number | Measurement | Signal | Equality | Sum | Negative | Minimum | Maximum | Product | Scaled
)


def as_expression(value: object) -> Expression:
    """Return a number as an expression; return an expression unchanged.

    Raises:
        TypeError: neither a number nor an expression.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, _Arithmetic)):
        raise TypeError(f"{value!r} is neither a number nor an expression over terms")
    if isinstance(value, (int, float)):
        return Number(value if isinstance(value, float) else float(value))
    return value  # type: ignore[return-value]


def minimum(*operands: Expression | float) -> Minimum:
    """Return the minimum of some expressions."""
    return Minimum(tuple(as_expression(operand) for operand in operands))


def maximum(*operands: Expression | float) -> Maximum:
    """Return the maximum of some expressions."""
    return Maximum(tuple(as_expression(operand) for operand in operands))


# ------------------------------------------------------------------------------------------- formulas


@dataclass(frozen=True, slots=True)
class Bound:
    """Window of a temporal operator, both ends included.

    Attributes:
        lower: lower end, at least 0.
        upper: upper end, at least `lower`; None for an unbounded window.
        unit: unit of both ends, "samples" or "ns".
    """

    lower: int
    upper: int | None
    unit: Literal["samples", "ns"]


# places do not count in comparisons: equal formulas can be at two places of a text
_NO_SPAN = Span(0, 0)


@dataclass(frozen=True, slots=True)
class Truth:
    """`true` or `false`: +inf or -inf."""

    value: bool
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)


@dataclass(frozen=True, slots=True)
class Atom:
    """Relation or comparison: one number in each sample, at least 0 where the atom holds.

    Attributes:
        text: canonical text in the profile of the specification.
        relation: name of the relation, such as "closeto" or "dist"; "signal" for the comparison of one
            signal, "sum" for a comparison of computed numbers.
        expression: robustness.
        terms: terms of the relation in text order; none for a signal.
        parameters: numbers, axis and comparison operators in text order. A "sum" has only the operators and
            numbers, because its text is made from its expression.
    """

    text: str
    relation: str
    expression: Expression
    name: str | None = None
    span: Span = field(default=_NO_SPAN, compare=False)
    terms: tuple[Term, ...] = ()
    parameters: tuple[float | str, ...] = ()


BooleanOperator: TypeAlias = Literal["not", "and", "or", "xor", "->", "<->", "spec", "given", "with"]
"""Boolean operators of the language, and three internal operators.

`spec` has the value of its one operand. It stands for a spec that only repeats another spec under a new name.
`given` and `with` occur only in expansions. They make an operator skip samples in which a rate has no value
(see `judged_operands`). Their first operand is the condition that the rate has a value. Their last operand is
the operand as written.
"""


@dataclass(frozen=True, slots=True)
class Boolean:
    """Boolean operator: `not` and `spec` have one operand, `and` and `or` two or more, other operators two.

    Attributes:
        expansion: formula that defines the operator; None for `not`, `and` and `or` (see `expand`).
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
    """Temporal operator: U, R, W and S have two operands, other operators one; X, WX and Y have no bound.

    Attributes:
        expansion: formula that defines the operator (see `expand`), for R, W, WX, operators over a rate (see
            `judged_operands`), and U and S with `true` on the left. Other operators have None.
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
    """`forall` or `exists` over an open group: one node, whose variables are bound in each sample.

    Several variables are bound to ordered tuples of distinct members. The body has no temporal operator.

    Attributes:
        group: open `Group`; `Earlier` of a group for its members in an earlier sample.
        judged: evaluated body, which skips members without a rate (see `judged_operands`).
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
    """Return an equal formula whose outermost operator is implemented by the engines.

    Engines implement `not`, `and`, `or`, X, F, G, U, Y, O, H and S. The node of every other
    operator has an `expansion` into these operators. Trees, texts and node ids show the formula as written.
    Operands are not expanded.
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
            only_first, only_last = Boolean("and", (first, _not(last))), Boolean("and", (_not(first), last))
            return Boolean("or", (only_first, only_last))
        case "<->":
            forward, backward = Boolean("or", (_not(first), last)), Boolean("or", (_not(last), first))
            return Boolean("and", (forward, backward))
        case "WX":
            return _not(Temporal("X", (_not(first),)))
        # over a window that begins later, U takes up to 2.7 times as long as the equal F
        case "U" if first == Truth(True):
            return Temporal("F", (last,), bound)
        case "S" if first == Truth(True):
            return Temporal("O", (last,), bound)
        case "R" if first == Truth(False):
            return Temporal("G", (last,), bound)
        case "R":
            return _not(Temporal("U", (_not(first), _not(last)), bound))
        case "W" if bound is None:
            # not "U or G", whose two unbounded operators would each double the state of a monitor
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
"""Internal operator of each operand (see `judged_operands`), by temporal operator or quantifier."""


def judged_operands(operator: str, operands: tuple[Formula, ...]) -> tuple[Formula, ...]:
    """Return operands that skip the samples or members in which a rate has no value yet.

    If there is nothing to skip, the result is `operands` itself.
    """
    conditions = [rate_conditions(operand) for operand in operands] if operator in _LEFT_OUT_AS else []
    if not any(conditions):
        return operands
    return tuple(
        Boolean(internal_operator, (_all(operand_conditions), operand), name=operand.name)
        if operand_conditions
        else operand
        for internal_operator, operand_conditions, operand in zip(
            _LEFT_OUT_AS[operator], conditions, operands, strict=True
        )
    )


def judged_operator(formula: Temporal) -> Temporal:
    """Return a temporal operator with its evaluated operands (see `judged_operands`)."""
    expansion = formula.expansion
    is_judged = isinstance(expansion, Temporal) and expansion.operator == formula.operator
    return expansion if is_judged else formula  # type: ignore[return-value]


def rate_conditions(formula: Formula) -> list[Formula]:
    """Return one condition for each rate in a formula: the rate has a value where the formula reads it.

    A rate inside an operator that already skips samples has no condition. X and WX read the next sample, Y
    reads the previous sample. If the log has no such sample, the condition holds.
    """
    match formula:
        case Atom():
            return [_has_value(rate) for rate in dict.fromkeys(_rates_of(formula.expression))]
        case Boolean() if formula.operator not in ("given", "with"):
            return list(
                dict.fromkeys(
                    condition for operand in formula.operands for condition in rate_conditions(operand)
                )
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
    """Return the children of a node in the tree; a quantifier over an open group has none."""
    if isinstance(formula, (Boolean, Temporal)):
        return formula.operands
    return ()


def operator_of(formula: Formula) -> str:
    """Return the operator of a node for display: "and", "F", "forall", "true", or an atom's relation."""
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
    """Yield the nodes of the tree as (id, id of the parent, node), in text order; the root is 0."""
    stack: list[tuple[int | None, Formula]] = [(None, formula)]
    node_id = 0
    while stack:
        parent, node = stack.pop()
        yield node_id, parent, node
        stack.extend((node_id, operand) for operand in reversed(operands_of(node)))
        node_id += 1


# -------------------------------------------------------------------------------------- specifications


@dataclass(frozen=True, slots=True)
class Outline:
    """Shape of a region: a polygon, or a disc, which has one vertex and a radius.

    Attributes:
        vertices: corners (x, y) in text order; for a box, counter-clockwise from (xmin, ymin).
        radius: radius of a disc; 0 for polygons and boxes.
        height: bottom and top, or None.
    """

    vertices: tuple[tuple[float, float], ...]
    radius: float = 0.0
    height: tuple[float, float] | None = None

    @property
    def is_disc(self) -> bool:
        """Whether the shape is a disc around its only vertex."""
        return self.radius > 0.0


@dataclass(frozen=True, slots=True)
class NamedSpec:
    """One `spec` statement.

    Attributes:
        parameter: object parameter of a template, or None.
        is_result: whether evaluations report the spec: no other spec of the file uses it.
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
        duration_ns: nanoseconds of a duration; None for a number.
        range: least and greatest value that the `const` line allows, or None.
        is_computed: whether the value is computed from other constants.
    """

    value: float
    duration_ns: int | None = None
    range: tuple[float, float] | None = None
    is_computed: bool = False


@dataclass(frozen=True, slots=True)
class Scale:
    """Divisor of all atoms that compare one signal, or lengths if `signal` is None."""

    signal: str | None
    divisor: float


@dataclass(frozen=True)
class Specification(Displayed):
    """All specs of one text, with macros, constants and quantifiers over named groups expanded.

    Specifications are equal if they mean the same: source, file name, constants and warnings are ignored.

    Attributes:
        specs: all specs in text order.
        profile: relation profile, "paper" or "spatial_spec".
        regions: shapes by name.
        groups: declared groups by name.
        relations: names of relations from Python or plug-ins.
        plugins: SHA-256 of the file of each used plug-in, by name.
        constants: constants by name; formulas already contain their values.
        scales: divisors of numbers of atoms; formulas already contain them.
        source: parsed text without a byte order mark; spans are offsets into it.
        filename: base name of the parsed file, or "<text>".
        warnings: warnings of `check`.
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
        """The specs that no other spec uses; evaluations report these."""
        return tuple(spec for spec in self.specs if spec.is_result)

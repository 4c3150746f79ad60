"""Terms, which name footprints, and expressions, the numbers computed from them in one sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self, TypeAlias

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
        made = super().__new__(cls, value)
        made.constants, made.is_plain = constants, is_plain
        return made


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
    """A term as it was earlier: exactly one of `samples` and `duration_ns` is given (`a[-3]`, `a[-2.5s]`).

    With a duration it is the last sample at or before that much earlier.
    """

    term: TrackedName | Variable | RegionName | Group
    samples: int | None = None
    duration_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Enlarged:
    """The Minkowski sum of a term with a disc in the plane (`enlarge(a, r)`); heights stay."""

    term: Term
    radius: float


Term: TypeAlias = TrackedName | Variable | RegionName | Group | Earlier | Enlarged

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


@dataclass(frozen=True, slots=True)
class _OfTwo(_Arithmetic):
    first: Term
    second: Term


@dataclass(frozen=True, slots=True)
class _AlongAxis(_Arithmetic):
    term: Term
    axis: Axis
    side: Side


@dataclass(frozen=True, slots=True)
class _OfSeveral(_Arithmetic):
    operands: tuple[Expression, ...]


class SignedDistance(_OfTwo):
    """Distance of two footprints when apart, minus their penetration depth when not (Def. 2-4)."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Protrusion(_Arithmetic):
    """How far `inner` sticks out: max over hull(inner) of the signed distance to outer (Prop. 2)."""

    inner: Term
    outer: Term


class Projection(_AlongAxis):
    """Least or greatest coordinate of a footprint along an axis (Def. 8)."""

    __slots__ = ()


class CentroidProjection(_AlongAxis):
    """Least or greatest coordinate, along x or y, of the centroids of a footprint's parts."""

    __slots__ = ()


class Misalignment(_OfTwo):
    """Half the squared distance of two unit orientation vectors, 1 - cos of their angle (Def. 10)."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Signal(_Arithmetic):
    """A named numeric signal of the log."""

    name: str


@dataclass(frozen=True, slots=True)
class Equality(_Arithmetic):
    """+inf where a signal is equal to a number, -inf where it is not.

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
class Scaled(_Arithmetic):
    """`operand` / `divisor`, so that numbers of different units can be compared; divisor > 0."""

    operand: Expression
    divisor: float


Measurement: TypeAlias = SignedDistance | Protrusion | Projection | CentroidProjection | Misalignment
"""An expression that geometry answers."""

Expression: TypeAlias = Number | Measurement | Signal | Equality | Sum | Negative | Minimum | Maximum | Scaled


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

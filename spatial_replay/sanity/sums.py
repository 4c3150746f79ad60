"""Expressions as weighted sums of measured quantities, below minima and maxima."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fractions import Fraction
from itertools import product
from math import isfinite
from typing import Final, Literal, NamedTuple, TypeAlias

from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.spec.formula import (
    Atom,
    CentroidProjection,
    Earlier,
    Enlarged,
    Expression,
    Group,
    Maximum,
    Measurement,
    Minimum,
    Misalignment,
    Negative,
    Number,
    Outline,
    Projection,
    Protrusion,
    RegionName,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Term,
    TrackedName,
    Variable,
)
from spatial_replay.spec.walks import base_of, measured_terms
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

MAX_INEQUALITIES: Final = 64
"""How many inequalities one relation is written as at most; one of more is not looked into."""

Quantity: TypeAlias = Measurement | Signal
Weights: TypeAlias = tuple[tuple[Quantity, Fraction], ...]


class Linear(NamedTuple):
    """A weighted sum of quantities, plus a constant."""

    weights: Weights
    constant: Fraction = Fraction(0)


class LeastOrGreatest(NamedTuple):
    """The least or the greatest of some numbers."""

    kind: Literal["min", "max"]
    options: tuple[Linear | LeastOrGreatest, ...]


Tree: TypeAlias = Linear | LeastOrGreatest


def tree_of(expression: Expression, regions: Mapping[str, Outline]) -> Tree | None:
    """Return an expression as sums below minima and maxima; None for one with too many sums."""
    try:
        tree = _built(expression, regions)
    except (_TooManyError, OverflowError):
        return None
    return tree


class _TooManyError(Exception):
    """An expression of more than `MAX_INEQUALITIES` sums."""


def _built(expression: Expression, regions: Mapping[str, Outline]) -> Tree:
    match expression:
        case Number():
            return Linear((), exact(expression.value))
        case Signal():
            return Linear(((expression, Fraction(1)),))
        case Sum():
            return _added(_built(expression.first, regions), _built(expression.second, regions))
        case Negative():
            return _times(_built(expression.operand, regions), Fraction(-1))
        case Scaled():
            return _times(_built(expression.operand, regions), 1 / exact(expression.divisor))
        case Minimum() | Maximum():
            options = tuple(_built(each, regions) for each in expression.operands)
            return _chosen("min" if isinstance(expression, Minimum) else "max", options)
        case _:
            return _measured(expression, regions)


def exact(value: float) -> Fraction:
    """Return the decimal fraction that a number is written as.

    Raises:
        OverflowError: it is not finite.
    """
    if not isfinite(value):
        raise OverflowError("not finite")
    return Fraction(repr(float(value)))


def _added(one: Tree, other: Tree) -> Tree:
    if isinstance(one, LeastOrGreatest):
        return _chosen(one.kind, tuple(_added(each, other) for each in one.options))
    if isinstance(other, LeastOrGreatest):
        return _added(other, one)
    total = dict(one.weights)
    for quantity, weight in other.weights:
        total[quantity] = total.get(quantity, Fraction(0)) + weight
    weights = sorted(((key, value) for key, value in total.items() if value), key=lambda each: repr(each[0]))
    return Linear(tuple(weights), one.constant + other.constant)


def _times(tree: Tree, factor: Fraction) -> Tree:
    if isinstance(tree, LeastOrGreatest):
        kind = tree.kind if factor > 0 else "max" if tree.kind == "min" else "min"
        return LeastOrGreatest(kind, tuple(_times(each, factor) for each in tree.options))
    weights = tuple((quantity, weight * factor) for quantity, weight in tree.weights)
    return Linear(weights, tree.constant * factor)


def _chosen(kind: Literal["min", "max"], options: tuple[Tree, ...]) -> Tree:
    if sum(map(_size, options)) > MAX_INEQUALITIES:
        raise _TooManyError
    return options[0] if len(options) == 1 else LeastOrGreatest(kind, options)


def _size(tree: Tree) -> int:
    return 1 if isinstance(tree, Linear) else sum(map(_size, tree.options))


def _measured(measurement: Measurement, regions: Mapping[str, Outline]) -> Tree:
    """Return a measurement of unions as the least or greatest of measurements of their members."""
    kind: Literal["min", "max"]
    each: list[Measurement]
    if all(isinstance(without_radius(plain(term)), RegionName) for term in measured_terms(measurement)):
        return _of_regions(measurement, regions)
    match measurement:
        case SignedDistance() | Misalignment():
            kind, of = "min", type(measurement)
            pairs = product(members(measurement.first), members(measurement.second))
            each = [of(*sorted(pair, key=repr)) for pair in pairs]
        case Protrusion():
            # of a union as the outer one nothing is known: a part of it may hold each part of the inner one
            kind, outer = "max", plain(measurement.outer)
            each = [Protrusion(inner, outer) for inner in members(measurement.inner)]
        case Projection():
            kind, axis = measurement.side, measurement.axis
            each = [Projection(term, axis, kind) for term in members(measurement.term)]
        case CentroidProjection():
            kind, axis = measurement.side, measurement.axis
            terms = map(without_radius, members(measurement.term))
            each = [CentroidProjection(term, axis, kind) for term in terms]
    return _chosen(kind, tuple(_shifted(one, regions) for one in each))


def _of_regions(measurement: Measurement, regions: Mapping[str, Outline]) -> Linear:
    """Return what is measured of regions alone: a number, as they are where they are, or else unknown."""
    nothing = TraceScene(Trace.from_samples([Sample(0, {})]), regions)
    values = leaf_values(nothing, [Atom("", "", measurement)], {})[:, 0, 0]
    is_known = len(set(values.tolist())) == 1 and isfinite(values[0])
    return Linear((), exact(float(values[0]))) if is_known else Linear(((measurement, Fraction(1)),))


def _shifted(measurement: Measurement, regions: Mapping[str, Outline]) -> Linear:
    """Return a measurement of enlarged terms by that of the terms, where that is exact."""
    one = Fraction(1)
    match measurement:
        case Projection() if measurement.axis != "z":
            radius = radius_of(measurement.term)
            bare = Projection(without_radius(measurement.term), measurement.axis, measurement.side)
            return Linear(((bare, one),), radius if measurement.side == "max" else -radius)
        case SignedDistance() if is_flat(measurement.first, regions) or is_flat(measurement.second, regions):
            terms = measurement.first, measurement.second
            bare_pair = SignedDistance(*sorted(map(without_radius, terms), key=repr))
            return Linear(((bare_pair, one),), -sum(map(radius_of, terms), Fraction(0)))
        case Protrusion() if is_flat(measurement.inner, regions) or is_flat(measurement.outer, regions):
            bare_in = Protrusion(without_radius(measurement.inner), without_radius(measurement.outer))
            return Linear(((bare_in, one),), radius_of(measurement.inner) - radius_of(measurement.outer))
    return Linear(((measurement, one),))


# -------------------------------------------------------------------------------------------- terms


def members(term: Term) -> tuple[Term, ...]:
    """Return the terms whose union a term is: the members of a named group, otherwise itself."""
    term = plain(term)
    if isinstance(term, Enlarged):
        return tuple(Enlarged(each, term.radius) for each in members(term.term))
    group = term.term if isinstance(term, Earlier) else term
    if not isinstance(group, Group) or group.members is None:
        return (term,)
    if any(isinstance(each, Variable) for each in group.excluded):
        return (term,)
    left_out = {each.name for each in group.excluded}
    names = [TrackedName(name) for name in group.members if name not in left_out]
    if not names:
        return (term,)
    if isinstance(term, Earlier):
        return tuple(Earlier(name, term.samples, term.duration_ns) for name in names)
    return tuple(names)


def plain(term: Term) -> Term:
    """Return a term with its enlargements as one, and a region as it always is."""
    if isinstance(term, Enlarged):
        inner = plain(term.term)
        radius = term.radius + (inner.radius if isinstance(inner, Enlarged) else 0.0)
        return Enlarged(without_radius(inner), radius) if radius else inner
    if isinstance(term, Earlier) and isinstance(term.term, RegionName):
        return term.term
    return term


def without_radius(term: Term) -> Term:
    """Return a term before it is enlarged."""
    return term.term if isinstance(term, Enlarged) else term


def radius_of(term: Term) -> Fraction:
    """Return by how much a term is enlarged."""
    return exact(term.radius) if isinstance(term, Enlarged) else Fraction(0)


def is_flat(term: Term, regions: Mapping[str, Outline]) -> bool:
    """Return whether a term certainly has no height: distances to it are those in the plane."""
    base = without_radius(term)
    return isinstance(base, RegionName) and base.name in regions and regions[base.name].height is None


def is_solid(term: Term) -> bool:
    """Return whether a term covers something in every sample in which it is known."""
    return not isinstance(base_of(term), Group)


def terms_in(quantities: Iterable[Quantity]) -> list[Term]:
    """Return the terms that quantities measure, each once, without enlargements."""
    found = (term for each in quantities if not isinstance(each, Signal) for term in measured_terms(each))
    return list(dict.fromkeys(without_radius(term) for term in found))

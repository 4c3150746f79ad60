"""The atom that decides a leaf at one sample: its measurements and objects, or why it is unknown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations, product
from typing import Any

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint
from spatial_replay.geometry.measure import Contact, candidate_pairs, contact, enlarged, protrusion_contact
from spatial_replay.monitor.atoms.closest_pair import closest_pair_of
from spatial_replay.monitor.atoms.measurements import leaf_values, measured, quantity_of
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.witness.path import End, Extremum, Interval, SignedOperand, chosen, extremum_of
from spatial_replay.spec.format import format_term
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    CentroidProjection,
    DerivedTerm,
    Earlier,
    Equality,
    Expression,
    Formula,
    Group,
    Maximum,
    Measurement,
    Minimum,
    Misalignment,
    Negative,
    Number,
    PreviousSignal,
    Projection,
    Protrusion,
    Quantified,
    Rate,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Term,
    TrackedName,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import (
    base_of,
    change_of,
    iter_expressions,
    logged_signals,
    measured_terms,
    named_members,
    standing,
    substitute,
    terms_of,
)
from spatial_replay.text import is_text_number
from spatial_replay.trace.trace import ABSENT


def unknowns_of(scene: TraceScene, atom: Atom) -> tuple[str, ...]:
    """Return what is unknown in the one sample of a scene, each reason once, in the order of the atom."""
    parts = list(iter_expressions(atom.expression))
    exact = [part.signal for part in parts if isinstance(part, Equality)]
    reasons = (reason for part in parts if part not in exact for reason in _reasons(scene, part))
    return tuple(dict.fromkeys(reasons))


def _reasons(scene: TraceScene, part: Expression) -> Iterator[str]:
    match part:
        case Rate():
            for inner in iter_expressions(change_of(part)):
                yield from _reasons(scene, inner)
        case Signal() | Equality():
            signal, compared = (part, 0.0) if isinstance(part, Signal) else (part.signal, part.value)
            name, value = signal.name, scene.signal(signal)[0]
            if any(each not in scene.trace.signals for each in logged_signals(signal)):
                yield f"there is no signal {name!r}"
            elif not np.isfinite(value):
                before = " before" if isinstance(part, PreviousSignal) else ""
                yield f"signal {name!r} has no finite value in the sample{before}"
            elif is_text_number(compared) != is_text_number(value):
                kinds = "a text, not a number; `names` of its mapping give texts numbers"
                if is_text_number(compared):
                    kinds = "a number, not a text; `names` of its mapping give numbers names"
                yield f"signal {name!r} is {kinds}"
        case Number() | Sum() | Negative() | Minimum() | Maximum() | Scaled():
            return
        case _:
            for term in terms_of(part):
                yield from _reasons_of_term(scene, part, term)


def _reasons_of_term(scene: TraceScene, part: Expression, term: Term) -> Iterator[str]:
    found = scene.resolve(term)
    if found.unknown[0]:
        yield from _missing(scene, term)
    elif isinstance(part, Misalignment) and np.isnan(found.yaw[0]):
        yield f"{format_term(term)} has no orientation"
    elif isinstance(part, Projection) and part.axis == "z":
        rows = found.operand.rows[0]
        bottoms = scene.batch.bottom[rows[rows >= 0]]
        if np.isnan(bottoms).any():
            yield f"{format_term(term)} has no height"


def _missing(scene: TraceScene, term: Term) -> Iterator[str]:
    """Iterate over the reasons why a term is unknown."""
    term = standing(term)
    if isinstance(term, Earlier) and _is_before_the_first(scene, term):
        yield f"{format_term(term)} looks back to before the first sample"
        return
    members = _members(base_of(term))
    rows = scene.resolve(term).operand.rows[0]
    for name, row in zip(members or [format_term(term)] * len(rows), rows.tolist(), strict=True):
        when = " then" if isinstance(term, Earlier) else ""
        if row < ABSENT:
            yield f"the position of {name} is unknown{when}"
        elif row == ABSENT and members:
            yield f"{name} is not in the sample{when and f' that {format_term(term)} looks at'}"


def _members(base: Term) -> Sequence[str]:
    """Return the objects a term stands for, if they are named."""
    match base:
        case TrackedName():
            return [base.name]
        case Group():
            return named_members(base)
    return ()


def _is_before_the_first(scene: TraceScene, term: Earlier) -> bool:
    if term.samples is not None:
        return term.samples > scene.skip
    times_ns = scene.trace.times_ns
    return int(times_ns[scene.skip]) - (term.duration_ns or 0) < int(times_ns[0])


@dataclass(frozen=True, slots=True)
class Measured:
    """A number that decides an atom.

    Attributes:
        quantity: "signed_distance", "protrusion", "max_x", …, "misalignment", "signal", "speed", "rate".
        names: the objects or regions measured, each with its delay and enlargement; or the signal.
        value: the number.
        spread: its uncertainty, from that of the objects.
        contact: for distances, where they are attained; otherwise None.
    """

    quantity: str
    names: tuple[str, ...]
    value: float
    spread: float = 0.0
    contact: Contact | None = None


@dataclass(frozen=True, slots=True)
class DecidingAtom:
    """An atom in one sample.

    Attributes:
        atom: with the objects that its variables stand for.
        end: which end of its interval decides.
        value: its robustness with every uncertainty at 0; NaN if unknown.
        lower, upper: the ends of its interval.
        branch: the summands of its number: numbers, signals and measurements, each with its sign; empty if
            it is unknown.
        measured: the signals and measurements among them.
        unknown: the reasons why it is unknown.
    """

    atom: Atom = field(repr=False)
    end: End
    value: float
    lower: float
    upper: float
    branch: tuple[tuple[int, Expression], ...] = field(repr=False)
    measured: tuple[Measured, ...]
    unknown: tuple[str, ...]

    @property
    def text(self) -> str:
        """The atom as it is written, its variables replaced."""
        return self.atom.text

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects, regions and groups that the atom is about, in the order written."""
        bases = (base_of(term) for term in self.atom.terms)
        return tuple(dict.fromkeys(base.name or format_term(base) for base in bases))


def deciding_atom(scene: TraceScene, leaf: Formula, end: End) -> DecidingAtom | None:
    """Return the atom that decides a leaf in the one sample of a scene; None if its group is empty."""
    while not isinstance(leaf, Atom):
        below = _below(scene, leaf, end)
        if below is None:
            return None
        leaf, end = below
    (nominal,), ((lower, upper),) = (_intervals(scene, [leaf], wide=wide) for wide in (False, True))
    value = nominal[0] if nominal[0] == nominal[1] else float("nan")
    unknown = unknowns_of(scene, leaf)
    branch = () if unknown else tuple(_branch(scene, leaf.expression, end, 1))
    found = tuple(_measured(scene, part) for _, part in branch if not isinstance(part, Number))
    return DecidingAtom(leaf, end, value, lower, upper, branch, found, unknown)


def failed_implication(scene: TraceScene, leaf: Formula, end: End) -> tuple[Formula, Formula, bool] | None:
    """Return the condition and the response of the outermost implication that fails below a quantifier.

    The third value is whether the atom that decides the leaf is in the condition.
    """
    while not isinstance(leaf, Atom):
        below = _below(scene, leaf, end)
        if below is None:
            return None
        if operator_of(leaf) == "->" and _intervals(scene, [leaf])[0][1] < 0.0:
            condition, response = operands_of(leaf)
            return condition, response, below[0] is condition
        leaf, end = below
    return None


def _intervals(scene: TraceScene, formulas: Sequence[Formula], *, wide: bool = True) -> list[Interval]:
    """Return the interval of each formula in the one sample of a scene."""
    values = leaf_values(scene, formulas, {})[:, :, 0]
    low, high = low_and_high(len(values), wide=wide)
    return [(float(a), float(b)) for a, b in zip(values[low], values[high], strict=True)]


def _below(scene: TraceScene, leaf: Formula, end: End) -> tuple[Formula, End] | None:
    """Return the operand or the binding that decides a leaf, and which of its ends."""
    match leaf:
        case Boolean():
            formulas = list(leaf.operands)
            extremum = extremum_of(leaf.operator, range(len(formulas)))
        case Quantified():
            formulas = list(_bodies(scene, leaf))
            extremum = Extremum(leaf.quantifier == "forall", tuple(map(SignedOperand, range(len(formulas)))))
        case _:
            return None
    if not formulas:
        return None
    intervals = _intervals(scene, formulas)
    first, *_ = chosen(extremum, end, intervals.__getitem__)
    return formulas[first.index], end.turned if first.negated else end


def _bodies(scene: TraceScene, formula: Quantified) -> Iterator[Formula]:
    """Iterate over the body for each binding of the variables to members of the group."""
    names, members, _ = scene.members(formula.group)
    present = [name for name, is_member in zip(names, members[0].tolist(), strict=True) if is_member]
    for bound in _may_decide(scene, formula, present):
        yield substitute(formula.body, dict(zip(formula.variables, map(TrackedName, bound), strict=True)))


def _may_decide(scene: TraceScene, formula: Quantified, present: Sequence[str]) -> Iterable[tuple[str, ...]]:
    """Return the bindings among which is one that decides a quantifier: of distances, those of near pairs."""
    pair = closest_pair_of(formula)
    everyone = permutations(present, len(formula.variables))
    if pair is None or len(present) < 3:
        return everyone
    rows = np.array([scene.resolve(TrackedName(name)).operand.rows[0, 0] for name in present])
    if (rows < 0).any():
        return everyone
    found = candidate_pairs(scene.batch, rows, scene.trace.uncertainty, pair.enlargement)
    return [(present[a], present[b]) for a, b in found.tolist()]


# ------------------------------------------------------------------------------------------ expressions


def _branch(
    scene: TraceScene, expression: Expression, end: End, sign: int
) -> Iterator[tuple[int, Expression]]:
    """Iterate over the signed summands of an expression, once minima and maxima have taken an operand."""
    match expression:
        case Sum():
            yield from _branch(scene, expression.first, end, sign)
            yield from _branch(scene, expression.second, end, sign)
        case Negative():
            yield from _branch(scene, expression.operand, end.turned, -sign)
        case Scaled():
            yield from _branch(scene, expression.operand, end, sign)
        case Equality():
            yield sign, expression.signal
        case Minimum() | Maximum():
            operands = expression.operands
            intervals = _intervals(scene, [_as_atom(each) for each in operands])
            extremum = Extremum(
                isinstance(expression, Minimum), tuple(map(SignedOperand, range(len(operands))))
            )
            first, *_ = chosen(extremum, end, intervals.__getitem__)
            yield from _branch(scene, operands[first.index], end, sign)
        case _:
            yield sign, expression


def _as_atom(expression: Expression) -> Atom:
    return Atom("", "", expression)


# ----------------------------------------------------------------------------------------- measurements


def _measured(scene: TraceScene, part: Expression) -> Measured:
    """Return a signal or a measurement of single objects: of groups, the members that attain it."""
    match part:
        case Rate():
            low, high = _intervals(scene, [_as_atom(part)])[0]
            names = tuple(map(format_term, part.terms)) or ((part.signal or part).name,)
            return Measured("speed" if part.terms else "rate", names, (low + high) / 2, (high - low) / 2)
        case Signal():
            return Measured("signal", (part.name,), float(scene.signal(part)[0]))
        case Misalignment():
            single: Measurement = part
        case SignedDistance():
            pairs = product(_singles(scene, part.first), _singles(scene, part.second))
            single = _attaining(np.argmin, scene, (SignedDistance(*pair) for pair in pairs))
        case Protrusion():
            inners = [
                _attaining(
                    np.argmin, scene, (Protrusion(inner, outer) for outer in _singles(scene, part.outer))
                )
                for inner in _singles(scene, part.inner)
            ]
            single = _attaining(np.argmax, scene, inners)
        case Projection() | CentroidProjection():
            projections = [replace(part, term=term) for term in _singles(scene, part.term)]
            single = _attaining(np.argmin if part.side == "min" else np.argmax, scene, projections)
        case _:
            raise TypeError(f"{part!r} is no measurement")
    (value,), (spread,) = (column[:, 0].tolist() for column in measured(scene, [single]))
    names = tuple(map(format_term, measured_terms(single)))
    quantity = "misalignment" if isinstance(single, Misalignment) else quantity_of(single)
    return Measured(quantity, names, value, spread, _contact(scene, single))


def _attaining(pick: Callable[[Floats], Any], scene: TraceScene, candidates: Iterable[Any]) -> Any:
    """Return the measurement of some that has the least or greatest number (`np.argmin`, `np.argmax`)."""
    listed = list(candidates)
    return listed[int(pick(measured(scene, listed)[0][:, 0]))]


def _singles(scene: TraceScene, term: Term) -> list[Term]:
    """Return the objects or regions a term stands for in the sample; the term itself if there are none."""
    base = base_of(term)
    if not isinstance(base, Group):
        return [term]
    if base.members is None:
        group: Any = standing(term)
        names, members, _ = scene.members(group)
        present = [name for name, is_member in zip(names, members[0].tolist(), strict=True) if is_member]
    else:
        present = [*named_members(base)]
    return [_of_member(term, name) for name in present] or [term]


def _of_member(term: Term, name: str) -> Term:
    if not isinstance(term, DerivedTerm):
        return TrackedName(name)
    inner: Any = _of_member(term.term, name)
    return replace(term, term=inner)


def _contact(scene: TraceScene, part: Measurement) -> Contact | None:
    match part:
        case SignedDistance():
            first, second = _footprint(scene, part.first), _footprint(scene, part.second)
            return contact(first, second) if first and second else None
        case Protrusion():
            inner, outer = _footprint(scene, part.inner), _footprint(scene, part.outer)
            return protrusion_contact(inner, outer) if inner and outer else None
    return None


def _footprint(scene: TraceScene, term: Term) -> Footprint | None:
    """Return the footprint of a single object or region; None for an empty group."""
    operand = scene.resolve(term).operand
    rows = operand.rows[0]
    if len(rows) != 1 or rows[0] < 0:
        return None
    return enlarged(scene.batch.footprint(int(rows[0])), operand.enlargement)

"""Which change of one number in the deciding atom flips a verdict."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.offline import evaluate_offline, new_leaves
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.verdict import Verdict, final_verdict, online_verdict
from spatial_replay.monitor.witness.atom import DecidingAtom
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.path import End
from spatial_replay.monitor.witness.unfinished import evaluate_unfinished
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Enlarged,
    Expression,
    Formula,
    Maximum,
    Measurement,
    Minimum,
    Negative,
    Number,
    Projection,
    Protrusion,
    Quantified,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Temporal,
    Term,
    Truth,
)
from spatial_replay.spec.walks import iter_formulas, map_leaves, map_terms


@dataclass(frozen=True, slots=True)
class Dial:
    """A number that an atom's robustness depends on.

    Attributes:
        kind: a number that the atom compares with; the radius by which a term is enlarged; or, where the
            text has neither, the margin that the relation has to hold by, which is 0.
        value: the number.
        slope: what adding 1 to it adds to the robustness of the atom's deciding branch.
        is_uniform: whether it adds that in every sample, whichever branch decides.
        is_exact: whether the atom holds at one number only (`a dist b == c`).
    """

    kind: Literal["number", "radius", "margin"]
    value: float
    slope: float
    is_uniform: bool
    is_exact: bool

    @classmethod
    def of(cls, deciding: DecidingAtom) -> Dial:
        """Choose the first number of the deciding branch written in the atom, else a radius, else 0."""
        atom = deciding.atom
        is_exact = "==" in atom.parameters
        divisor = atom.expression.divisor if isinstance(atom.expression, Scaled) else 1.0
        for sign, part in deciding.branch:
            if isinstance(part, Number) and part.value in atom.parameters:
                slopes = _slopes(atom.expression, part.value)
                slope = sign / divisor
                return cls("number", part.value, slope, slopes == {slope}, is_exact)
        for sign, part in deciding.branch:
            for radius in _radii(part):
                # of prisms, how high they are may decide instead
                slope = sign * _slope_of_radius(part, radius) / divisor
                return cls("radius", radius, slope, False, is_exact)
        return cls("margin", 0.0, -1, True, is_exact)

    def turned(self, expression: Expression, value: float) -> Expression:
        """Return the expression with another number in its place."""
        if self.kind == "margin":
            return Sum(expression, Number(-value))
        return _replaced(expression, self.kind, self.value, value)


def rewritten(formula: Formula, is_meant: Callable[[Atom], bool], change: Callable[[Atom], Atom]) -> Formula:
    """Return a formula of the same shape with some of its atoms changed."""
    match formula:
        case Atom():
            return change(formula) if is_meant(formula) else formula
        case Truth():
            return formula
        case Quantified():
            return replace(formula, body=rewritten(formula.body, is_meant, change))
        case Boolean() | Temporal():
            operands = tuple([rewritten(each, is_meant, change) for each in formula.operands])
            return replace(formula, operands=operands)


def _slopes(expression: Expression, number: float) -> set[float]:
    """Return what adding 1 to every such number adds to the expression, for each branch that may decide."""
    match expression:
        case Number():
            return {int(expression.value == number)}
        case Sum():
            first, second = _slopes(expression.first, number), _slopes(expression.second, number)
            return {a + b for a in first for b in second}
        case Negative():
            return {-slope for slope in _slopes(expression.operand, number)}
        case Scaled(operand, divisor):
            return {slope / divisor for slope in _slopes(operand, number)}
        case Minimum() | Maximum():
            return {slope for each in expression.operands for slope in _slopes(each, number)}
    return {0}


def _slope_of_radius(expression: Expression, radius: float) -> int:
    def count(term: Term) -> int:
        return sum(each == radius for each in _radii_of(term))

    match expression:
        case SignedDistance():
            return -count(expression.first) - count(expression.second)
        case Protrusion():
            return count(expression.inner) - count(expression.outer)
        case Projection() if expression.axis != "z":
            return count(expression.term) * (1 if expression.side == "max" else -1)
    return 0


def _radii(expression: Expression) -> list[float]:
    """Iterate over the radii that a measurement depends on, in the order written."""
    match expression:
        case SignedDistance():
            return _radii_of(expression.first) + _radii_of(expression.second)
        case Protrusion():
            return _radii_of(expression.inner) + _radii_of(expression.outer)
        case Projection() if expression.axis != "z":
            return _radii_of(expression.term)
    return []


def _radii_of(term: Term) -> list[float]:
    radii = []
    while isinstance(term, Enlarged):
        radii.append(term.radius)
        term = term.term
    return radii


def _replaced(expression: Expression, kind: str, old: float, new: float) -> Expression:
    def term(old_term: Term) -> Term:
        if not isinstance(old_term, Enlarged):
            return old_term
        is_meant = kind == "radius" and old_term.radius == old
        return Enlarged(term(old_term.term), new if is_meant else old_term.radius)

    def leaf(part: Number | Signal | Measurement) -> Expression:
        match part:
            case Number():
                return Number(new) if kind == "number" and part.value == old else part
            case SignedDistance() | Protrusion() | Projection():
                return map_terms(part, term)
        # these take no radius: turning and centroids are the same for an enlarged term
        return part

    return map_leaves(expression, leaf)


_FAR = 1e300
_DOUBLINGS = 40
_ROUNDS, _PARTS = 4, 16
"""Search for a number that does not move all samples alike: each round reads the log once, and divides the
interval between a number that does not flip the verdict and one that does into so many parts."""


@dataclass(frozen=True, slots=True)
class Threshold:
    """The number that decides an atom, and where it would flip the verdict.

    Attributes:
        value: the number as written in the specification. Without one (`a leftof b`), 0: the margin by
            which the relation has to hold.
        flips_at: the nearest number that changes the verdict, up to rounding (for a relation under an open
            quantifier, or between two limits, to within 0.01 %).
        is_written: whether the number is in the text.
        is_exact: whether only this number flips it, and none beyond (`a dist b == c`).
        verdict: the verdict at `flips_at`.
    """

    value: float
    flips_at: float
    is_written: bool
    is_exact: bool
    verdict: Verdict


Obstacle: TypeAlias = Literal["others", "limits", "infinity"]
"""Why no number of an atom flips a verdict: other atoms decide it too; no number that can be written is large
enough; or the atom is infinite."""


def threshold_of(
    evidence: Evidence,
    leaves: Floats,
    times_ns: Integers,
    node: int,
    verdict: Verdict,
    deciding: DecidingAtom,
    *,
    goes_on: bool = False,
) -> Threshold | Obstacle | None:
    """Compute how far the deciding atom's number has to move to flip a verdict, or why no number does.

    All atoms that were written in the same place move together: those that a quantifier over a named group,
    or a macro, made of one text.

    Args:
        leaves: (C, A, T), the instance's leaves in each sample.
        node: whose verdict.
        goes_on: whether samples may follow: then the verdict is that over every continuation.

    Returns:
        None of an atom that is itself open.
    """
    if deciding.end is End.OPEN or deciding.unknown:
        return None
    if not math.isfinite(deciding.lower) or not math.isfinite(deciding.upper):
        return "infinity"
    search = _Search(evidence, leaves, times_ns, node, verdict, deciding, goes_on=goes_on)
    flips_at = search.number()
    if flips_at is None:
        return "limits" if search.would_flip() else "others"
    dial = search.dial
    flipped = search.verdicts([flips_at])[0]
    return Threshold(dial.value, flips_at, dial.kind != "margin", dial.is_exact, flipped)


class _Search:
    def __init__(
        self,
        evidence: Evidence,
        leaves: Floats,
        times_ns: Integers,
        node: int,
        verdict: Verdict,
        deciding: DecidingAtom,
        *,
        goes_on: bool,
    ) -> None:
        self._evidence = evidence
        self._evaluate = evaluate_unfinished if goes_on else evaluate_offline
        self._verdict_of = online_verdict if goes_on else final_verdict
        self._formula, self._order = evidence.instance.formula, evidence.instance.program.leaves
        self._leaves, self._times, self._node = leaves, times_ns, node
        self._verdict, self._deciding = verdict, deciding
        self.dial = Dial.of(deciding)
        # from the formula: equal leaves share the place of the first, wherever it was written
        meant = {each.expression for each in _atoms_of([self._formula]) if self._is_meant(each)}
        self._moving = {
            index: leaf
            for index, leaf in enumerate(self._order)
            if isinstance(leaf, Atom) and leaf.expression in meant
        }
        quantifiers = [each for each in iter_formulas(self._formula) if isinstance(each, Quantified)]
        in_group = any(map(self._is_meant, _atoms_of(quantifiers)))
        self._is_uniform = self.dial.is_uniform and not in_group
        self._rises = deciding.end is End.HIGH

    def number(self) -> float | None:
        """Return the nearest number that flips the verdict."""
        if self.dial.slope == 0:
            return None
        nearest = abs(self._deciding.lower if self._deciding.end is End.LOW else self._deciding.upper)
        if self._flips([nearest])[0]:
            return self._moved(nearest)
        size = self._size_by_samples(nearest) if self._is_uniform else self._size_by_rounds(nearest)
        return None if size is None else self._moved(size)

    def would_flip(self) -> bool:
        """Return whether the verdict flips if the atom is moved arbitrarily far."""
        far = _FAR if self._rises else -_FAR

        def change(atom: Atom) -> Atom:
            return replace(atom, expression=Sum(atom.expression, Number(far)))

        formula = rewritten(self._formula, self._is_meant, change)
        added = new_leaves(formula, self._order)
        return self._evaluated(formula, added, self._columns(added)) is not self._verdict

    def verdicts(self, numbers: Sequence[float]) -> list[Verdict]:
        """Return the verdict with each number in place of the dial's."""
        formulas = [self._turned(number) for number in numbers]
        added = [new_leaves(formula, self._order) for formula in formulas]
        if self._is_uniform:
            columns = [self._shifted(leaves, number) for leaves, number in zip(added, numbers, strict=True)]
        else:
            every = self._columns([leaf for leaves in added for leaf in leaves])
            ends = np.cumsum([0, *map(len, added)]).tolist()
            columns = [every[:, begin:end] for begin, end in pairwise(ends)]
        return [self._evaluated(*each) for each in zip(formulas, added, columns, strict=True)]

    def _flips(self, sizes: Sequence[float]) -> list[bool]:
        numbers = [self._moved(size) for size in sizes]
        possible = [number for number in numbers if math.isfinite(number)]
        verdicts = dict(zip(possible, self.verdicts(possible), strict=True)) if possible else {}
        return [verdicts.get(number, self._verdict) is not self._verdict for number in numbers]

    def _moved(self, size: float) -> float:
        """Return the number that moves the atom by `size` and a little more, so that rounding cannot undo it.

        A radius goes no lower than 0.
        """
        value, slope = self.dial.value, self.dial.slope
        beyond = 0.0 if self.dial.is_exact else 8.0 * float(np.spacing(max(abs(value) + size, 1.0)))
        number = value + math.copysign((size + beyond) / slope, slope if self._rises else -slope)
        return max(number, 0.0) if self.dial.kind == "radius" else number

    def _size_by_samples(self, nearest: float) -> float | None:
        """Where the dial moves the atom alike in every sample, one of them decides when the verdict flips."""
        sizes = np.unique(np.abs(self._leaves[:, list(self._moving)]))
        listed = sizes[np.isfinite(sizes) & (sizes > nearest)].tolist()
        at = bisect_left(listed, True, key=lambda size: self._flips([size])[0])
        return listed[at] if at < len(listed) else None

    def _size_by_rounds(self, nearest: float) -> float | None:
        unit = max(nearest, 1e-6 * (abs(self.dial.value) + 1.0))
        sizes = [nearest, *(unit * 2.0**k for k in range(1, _DOUBLINGS))]
        for _ in range(_ROUNDS):
            flips = self._flips(sizes)
            if not any(flips):
                return None
            first = max(flips.index(True), 1)
            sizes = np.linspace(sizes[first - 1], sizes[first], _PARTS + 1).tolist()
        return sizes[-1]

    def _is_meant(self, atom: Atom) -> bool:
        """Return whether an atom was written where the deciding one was."""
        meant = self._deciding.atom
        if meant.span.start == meant.span.end:
            return atom.expression == meant.expression
        return (atom.span, atom.relation, atom.parameters) == (meant.span, meant.relation, meant.parameters)

    def _turned(self, number: float) -> Formula:
        return rewritten(self._formula, self._is_meant, lambda atom: self._turned_atom(atom, number))

    def _turned_atom(self, atom: Atom, number: float) -> Atom:
        return replace(atom, expression=self.dial.turned(atom.expression, number))

    def _shifted(self, added: Sequence[Formula], number: float) -> Floats:
        """Return columns of turned atoms, shifted from those of the original ones."""
        shift = self.dial.slope * (number - self.dial.value)
        indices = {self._turned_atom(atom, number).expression: index for index, atom in self._moving.items()}
        return self._leaves[:, [indices[leaf.expression] for leaf in added if isinstance(leaf, Atom)]] + shift

    def _columns(self, formulas: Sequence[Formula]) -> Floats:
        return self._evidence.columns(formulas)[:, :, : len(self._times)]

    def _evaluated(self, formula: Formula, added: Sequence[Atom | Quantified], columns: Floats) -> Verdict:
        channels = max(len(columns), len(self._leaves))
        leaves = np.concatenate([in_channels(self._leaves, channels), in_channels(columns, channels)], axis=1)
        done = self._evaluate(formula, (*self._order, *added), leaves, self._times)
        low, high = done.ends(self._node)
        return self._verdict_of(float(low[0]), float(high[0]))


def _atoms_of(formulas: Iterable[Formula]) -> Iterator[Atom]:
    """Iterate over every atom in some formulas, those in the bodies of quantifiers too."""
    for formula in formulas:
        for each in iter_formulas(formula):
            if isinstance(each, Atom):
                yield each

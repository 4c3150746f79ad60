"""Find the change of one number in the deciding atom that flips a verdict."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Context, Decimal
from functools import partial
from itertools import pairwise
from typing import Final, Literal, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.offline import evaluate_offline, evaluate_prefix, new_leaves
from spatial_replay.monitor.online.codes import joined_channels
from spatial_replay.monitor.verdict import Verdict, final_verdict, online_verdict
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.path import DecidingAtom, End
from spatial_replay.spec.format import format_atom
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Enlarged,
    Expression,
    Formula,
    Maximum,
    Measurement,
    Minimum,
    NamedNumber,
    Negative,
    Number,
    Product,
    Quantified,
    Scaled,
    Signal,
    Sum,
    Temporal,
    Term,
)
from spatial_replay.spec.walks import (
    iter_atoms,
    iter_expressions,
    iter_formulas,
    leaf_key,
    map_leaves,
    nodes_of,
    operand_signs,
    rewritten,
)
from spatial_replay.text import DIGITS


@dataclass(frozen=True, slots=True)
class Dial:
    """A number of an atom that is varied to flip a verdict.

    Attributes:
        kind: "number": a number that the atom compares with. "radius": the enlargement of a term. "margin":
            the amount by which the relation has to hold, which is 0 in the text.
        value: the number.
        is_exact: whether the atom holds at one number only (`a dist b == c`).
        constant: name of the constant with this value, if it is varied in all atoms; else "".
    """

    kind: Literal["number", "radius", "margin"]
    value: float
    is_exact: bool
    constant: str = ""

    @classmethod
    def of(cls, deciding: DecidingAtom) -> Dial:
        """Choose the first written number of the deciding branch, else its first radius, else the margin."""
        atom = deciding.atom
        is_exact = "==" in atom.parameters
        branch_parts = [part for _, part in deciding.branch]
        numbers = [part.value for part in branch_parts if isinstance(part, Number)]
        for number in numbers:
            if number in atom.parameters:
                return cls("number", number, is_exact)
        for radius in (radius for part in branch_parts for radius in _radii(part)):
            return cls("radius", radius, is_exact)
        return cls("margin", 0.0, is_exact)

    def with_constant(self, formula: Formula) -> Dial | None:
        """Return the dial of the number's constant.

        The result is None without a constant, and for a constant that is also used in arithmetic.
        """
        if not isinstance(self.value, NamedNumber) or not self.value.is_plain:
            return None
        (constant,) = self.value.constants
        numbers = [number for atom in iter_atoms(formula) for number in _numbers(atom.expression)]
        is_entangled = any(
            constant in number.constants and not number.is_plain
            for number in numbers
            if isinstance(number, NamedNumber)
        )
        return None if is_entangled else replace(self, constant=constant)

    def is_at(self, kind: Literal["number", "radius"], number: float) -> bool:
        """Return whether the dial varies a number of the given kind."""
        if self.constant:
            return isinstance(number, NamedNumber) and self.constant in number.constants
        return kind == self.kind and number == self.value

    def turn(self, expression: Expression, value: float) -> Expression:
        """Return the expression with the dial at another value."""
        if self.kind == "margin":
            divisor = expression.divisor if isinstance(expression, Scaled) else 1.0
            return Sum(expression, Number(-value / divisor))

        def term(old: Term) -> Term:
            if not isinstance(old, Enlarged):
                return old
            return Enlarged(term(old.term), value if self.is_at("radius", old.radius) else old.radius)

        def leaf(part: Number | Signal | Measurement) -> Expression:
            match part:
                case Number():
                    return Number(value) if self.is_at("number", part.value) else part
                case Measurement() if any(part.radius_effects):
                    return part.with_terms(*map(term, part.terms))
            return part

        return map_leaves(expression, leaf)

    def slopes(self, expression: Expression) -> set[float]:
        """Return the derivatives of the expression with respect to the dial, over all branches."""
        if self.kind == "margin":
            return {-1.0 / (expression.divisor if isinstance(expression, Scaled) else 1.0)}
        match expression:
            case Number():
                return {int(self.is_at("number", expression.value))}
            case Sum():
                first_slopes, second_slopes = self.slopes(expression.first), self.slopes(expression.second)
                return {a + b for a in first_slopes for b in second_slopes}
            case Negative():
                return {-slope for slope in self.slopes(expression.operand)}
            case Product(factor, operand):
                return {slope * factor for slope in self.slopes(operand)}
            case Scaled(operand, divisor):
                return {slope / divisor for slope in self.slopes(operand)}
            case Minimum() | Maximum():
                return {slope for operand in expression.operands for slope in self.slopes(operand)}
            case Measurement():
                effects = zip(expression.radius_effects, expression.terms, strict=True)
                return {sum(effect * self._radii_in(term) for effect, term in effects)}
        return {0}

    def _radii_in(self, term: Term) -> int:
        return sum(self.is_at("radius", radius) for radius in _radii_of(term))


def _radii(expression: Expression) -> list[float]:
    """Return the radii that a measurement depends on, in the order of the text."""
    if not isinstance(expression, Measurement):
        return []
    effects = zip(expression.radius_effects, expression.terms, strict=True)
    return [radius for effect, term in effects if effect for radius in _radii_of(term)]


def _radii_of(term: Term) -> list[float]:
    radii = []
    while isinstance(term, Enlarged):
        radii.append(term.radius)
        term = term.term
    return radii


def _numbers(expression: Expression) -> Iterator[float]:
    for part in iter_expressions(expression):
        match part:
            case Number(value=number) | Product(factor=number) | Scaled(divisor=number):
                yield number
            case _:
                yield from _radii(part)


def _signed_atoms(formula: Formula, signs: frozenset[int] = frozenset({1})) -> Iterator[tuple[Atom, int]]:
    """Iterate over the atoms of a formula, with the signs of their effects on the formula's robustness."""
    match formula:
        case Atom():
            yield from ((formula, sign) for sign in signs)
        case Quantified():
            yield from _signed_atoms(formula.body, signs)
        case Boolean() | Temporal():
            for operand_index, operand in enumerate(formula.operands):
                operand_signs_below = {
                    sign * sign_below
                    for sign in signs
                    for sign_below in operand_signs(formula, operand_index)
                }
                yield from _signed_atoms(operand, frozenset(operand_signs_below))


RESIDUE: Final = 1e-12
"""Largest relative difference of two numbers that is attributed to rounding."""
_PRECISION: Final = 60
_FAR = 1e300
_STEPS = 8.0
"""Floating-point steps by which a flipping number is moved further, so that rounding cannot undo the flip."""
_DOUBLINGS = 40
_ROUNDS, _PARTS = 4, 16
"""Number of search rounds for dials that do not shift all samples equally, and interval parts per round.

Each round reads the log once, and divides the interval between a number that flips the verdict and a number
that does not flip it.
"""
_AT_FIRST = 64
"""Number of candidates in the first pass of a search in both directions.

In such a search, a larger change need not flip the verdict, so bisection could miss the nearest number.
"""


@dataclass(frozen=True, slots=True)
class Threshold:
    """The number of an atom, and the nearest number that would flip the verdict.

    Attributes:
        value: number in the specification. For an atom without a number (`a leftof b`), the value is 0, the
            margin by which the relation has to hold.
        flips_at: nearest number that flips the verdict, rounded away from `value` to a few digits.
        is_written: whether the number is in the text.
        is_exact: whether numbers beyond `flips_at` need not flip the verdict (`a dist b == c`).
        verdict: the verdict at `flips_at`.
        constant: name of the constant for which `flips_at` is a value; "" for other numbers.
        replacement: text with a number that flips the verdict, for an atom without a number; else "".
    """

    value: float
    flips_at: float
    is_written: bool
    is_exact: bool
    verdict: Verdict
    constant: str = ""
    replacement: str = ""


Obstacle: TypeAlias = Literal["others", "unknown", "limits", "infinity"]
"""The reason why no number of an atom flips a verdict.

"others": other atoms decide the verdict, too. "unknown": unknown samples decide the verdict, too. "limits":
no number that can be written is large enough. "infinity": the atom's robustness is infinite.
"""


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
    """Find the nearest number of the deciding atom that flips a verdict, or the reason why no number does.

    A constant is varied in all its atoms. A number without a name is varied in all atoms from the same place
    in the text. A macro, or a quantifier over a named group, creates several such atoms.

    Args:
        leaves: (C, A, T), leaves of the instance in each sample.
        node: id of the node with the verdict.
        goes_on: whether samples may follow. The verdict then holds over every continuation.

    Returns:
        the threshold or the obstacle. None if the deciding atom is open or unknown.
    """
    if deciding.end is End.OPEN or deciding.unknown:
        return None
    if not math.isfinite(deciding.lower) or not math.isfinite(deciding.upper):
        return "infinity"

    def search_of(dial: Dial) -> _Search:
        return _Search(evidence, leaves, times_ns, node, verdict, deciding, dial, goes_on=goes_on)

    dial = Dial.of(deciding)
    constant = dial.with_constant(evidence.instance.formula)
    threshold = None if constant is None else search_of(constant).threshold()
    if threshold is not None:
        return threshold
    search = search_of(dial)
    return search.threshold() or search.obstacle()


class _Search:
    def __init__(
        self,
        evidence: Evidence,
        leaves: Floats,
        times_ns: Integers,
        node: int,
        verdict: Verdict,
        deciding: DecidingAtom,
        dial: Dial,
        *,
        goes_on: bool,
    ) -> None:
        self._evidence = evidence
        self._evaluate = evaluate_prefix if goes_on else evaluate_offline
        self._verdict_of = online_verdict if goes_on else final_verdict
        self._formula, self._leaf_order = evidence.instance.formula, evidence.instance.program.leaves
        self._leaves, self._times_ns, self._node = leaves, times_ns, node
        self._deciding, self._dial, self._goes_on, self._verdict = deciding, dial, goes_on, verdict
        atoms = filter(self._is_meant, iter_atoms(self._formula))
        slopes_by_expression = {atom.expression: dial.slopes(atom.expression) for atom in atoms}
        # slopes come from the formula, because equal leaves share an index although their spans differ
        self._moving_leaves: dict[int, Atom | Quantified] = {}
        self._slopes: dict[int, float] = {}
        for index, leaf in enumerate(self._leaf_order):
            bare_atom_and_sign = _bare(leaf)
            if bare_atom_and_sign is not None and (
                atom_slopes := slopes_by_expression.get(bare_atom_and_sign[0].expression)
            ):
                self._moving_leaves[index], self._slopes[index] = (
                    leaf,
                    bare_atom_and_sign[1] * max(atom_slopes),
                )
        quantifiers = [part for part in iter_formulas(self._formula) if isinstance(part, Quantified)]
        # only a quantifier over a single atom shifts like the atom; with radii, a prism's height may decide
        self._is_uniform = (
            all(len(atom_slopes) == 1 for atom_slopes in slopes_by_expression.values())
            and not any(
                self._is_meant(atom)
                for quantifier in quantifiers
                if not _bare(quantifier)
                for atom in iter_atoms(quantifier)
            )
            and not any(
                dial.is_at("radius", radius)
                for expression in slopes_by_expression
                for radius in _radii_in(expression)
            )
        )
        signs = {
            math.copysign(1.0, sign * slope)
            for atom, sign in _signed_atoms(nodes_of(self._formula)[node])
            if self._is_meant(atom)
            for slope in slopes_by_expression[atom.expression]
            if slope
        }
        # a violated formula has to rise, and a satisfied formula has to fall
        self._directions = [sign if verdict is Verdict.VIOLATED else -sign for sign in sorted(signs)]
        low, high = self._evaluate(self._formula, self._leaf_order, leaves, times_ns).interval(node)
        distance_from_flip = abs(high if verdict is Verdict.VIOLATED else low)
        steepest_slope = max(
            (abs(slope) for atom_slopes in slopes_by_expression.values() for slope in atom_slopes),
            default=0.0,
        )
        # robustness changes by at most the slope times the change
        self._least_change = (
            distance_from_flip / steepest_slope
            if steepest_slope and math.isfinite(distance_from_flip)
            else 0.0
        )

    def threshold(self) -> Threshold | None:
        """Return the nearest number that flips the verdict, or None."""
        dial = self._dial
        flipping_numbers = [
            number for side in self._directions if (number := self._nearest(side)) is not None
        ]
        for number in sorted(flipping_numbers, key=lambda number: abs(number - dial.value)):
            candidates = list(filter(self._is_possible, _short_numbers(number, dial.value)))
            # one of the first two candidates nearly always flips the verdict, and each candidate costs a
            # measurement of all bindings
            for candidate_batch in filter(None, (candidates[:2], candidates[2:])):
                verdicts = self._verdicts(candidate_batch, is_shifted=False)
                for candidate, verdict in zip(candidate_batch, verdicts, strict=True):
                    if self._is_flipped(verdict):
                        is_exact = dial.is_exact or len(self._directions) > 1
                        is_written = dial.kind != "margin"
                        replacement = "" if is_written else self._replacement(candidate)
                        return Threshold(
                            dial.value, candidate, is_written, is_exact, verdict, dial.constant, replacement
                        )
        return None

    def _replacement(self, margin: float) -> str:
        """Return the deciding atom's text with a margin that flips the verdict; "" without such a text."""
        atom = self._deciding.atom
        for variant in _variants(atom, margin):
            formula = self._change_atoms(variant)
            added_leaves = new_leaves(formula, self._leaf_order)
            # the verdict is computed, because heights or rounding may decide instead of the margin
            if self._is_flipped(self._verdict_with(formula, added_leaves, self._columns(added_leaves))):
                changed_atom = variant(atom)
                return format_atom(
                    changed_atom.relation,
                    changed_atom.expression,
                    changed_atom.terms,
                    changed_atom.parameters,
                )
        return ""

    def obstacle(self) -> Obstacle:
        """Return why no number flips the verdict, from the verdict with the atom shifted by `_FAR`."""
        far_shift = _FAR if self._deciding.end is End.HIGH else -_FAR

        def change(atom: Atom) -> Atom:
            return replace(atom, expression=Sum(atom.expression, Number(far_shift)))

        formula = self._change_atoms(change)
        added_leaves = new_leaves(formula, self._leaf_order)
        verdict = self._verdict_with(formula, added_leaves, self._columns(added_leaves))
        if self._is_flipped(verdict):
            return "limits"
        return "others" if verdict is self._verdict else "unknown"

    def _is_flipped(self, verdict: Verdict) -> bool:
        """Return whether a verdict is flipped; an unknown verdict is flipped only if samples may follow."""
        return verdict is not self._verdict and (self._goes_on or verdict is not Verdict.UNKNOWN)

    def _is_possible(self, number: float) -> bool:
        return math.isfinite(number) and (self._dial.kind != "radius" or number >= 0.0)

    def _nearest(self, direction: float) -> float | None:
        """Return a number just beyond the nearest number in a direction that flips the verdict, or None."""
        find_size = self._size_by_samples if self._is_uniform else self._size_by_rounds
        size = find_size(direction)
        return None if size is None else self._number_beyond(size, direction)

    def _size_by_samples(self, direction: float) -> float | None:
        """Return the least change that flips the verdict, for a dial that shifts all samples equally.

        Robustness is the shifted number of one sample, so only one change per sample is tried.
        """
        changes = [
            -direction * self._leaves[:, index].ravel() / slope
            for index, slope in self._slopes.items()
            if slope
        ]
        sizes = np.sort(np.concatenate(changes))
        # the tolerance includes the deciding sample, whose quotient may be rounded down
        sizes = sizes[np.isfinite(sizes) & (sizes >= self._least_change * (1.0 - 1e-9))]
        candidates = np.concatenate([[self._least_change], sizes])

        def flips(size: float) -> bool:
            return self._flips([size], direction)[0]

        begin, stop = 0, len(candidates)
        stride = max(stop // _AT_FIRST, 1) if len(self._directions) > 1 else stop
        # the first candidate that flips the verdict ends an interval, which is bisected
        for end in (0, *range(stride, stop, stride), stop - 1):
            if flips(candidates[end]):
                return float(candidates[bisect_left(candidates, True, begin, end, key=flips)])
            begin = end + 1
        return None

    def _size_by_rounds(self, direction: float) -> float | None:
        # sizes double, starting at the least change that can flip the verdict, which may be 0
        first_size = max(self._least_change, 1e-6 * (abs(self._dial.value) + 1.0))
        sizes = [self._least_change, *(first_size * 2.0**exponent for exponent in range(1, _DOUBLINGS))]
        for _ in range(_ROUNDS):
            is_flipping = self._flips(sizes, direction)
            if not any(is_flipping):
                return None
            if is_flipping[0]:
                return sizes[0]
            first_flip = is_flipping.index(True)
            sizes = np.linspace(sizes[first_flip - 1], sizes[first_flip], _PARTS + 1).tolist()
        return sizes[-1]

    def _flips(self, sizes: Sequence[float], direction: float) -> list[bool]:
        numbers = [self._number_beyond(size, direction) for size in sizes]
        possible_numbers = [number for number in numbers if self._is_possible(number)]
        verdicts = dict(zip(possible_numbers, self._verdicts(possible_numbers), strict=True))
        return [self._is_flipped(verdicts.get(number, self._verdict)) for number in numbers]

    def _number_beyond(self, size: float, direction: float) -> float:
        """Return the dial's value moved by `size` and a few rounding steps. A radius is at least 0."""
        value = self._dial.value
        rounding_step = (
            0.0 if self._dial.is_exact else _STEPS * float(np.spacing(max(abs(value) + size, 1.0)))
        )
        number = value + direction * (size + rounding_step)
        return max(number, 0.0) if self._dial.kind == "radius" else number

    def _verdicts(self, numbers: Sequence[float], *, is_shifted: bool = True) -> list[Verdict]:
        """Return the verdict with the dial at each number.

        Args:
            is_shifted: whether atoms may be shifted instead of measured again. The results differ only by
                rounding.
        """
        formulas = [self._formula_at(number) for number in numbers]
        added_leaves = [new_leaves(formula, self._leaf_order) for formula in formulas]
        if self._is_uniform and is_shifted:
            columns = [
                self._shift_columns(leaves, number)
                for leaves, number in zip(added_leaves, numbers, strict=True)
            ]
        elif numbers:
            all_columns = self._columns([leaf for leaves in added_leaves for leaf in leaves])
            column_ends = np.cumsum([0, *map(len, added_leaves)]).tolist()
            columns = [all_columns[:, begin:end] for begin, end in pairwise(column_ends)]
        else:
            columns = []
        return [
            self._verdict_with(*arguments) for arguments in zip(formulas, added_leaves, columns, strict=True)
        ]

    def _is_meant(self, atom: Atom) -> bool:
        """Return whether the search varies an atom.

        A constant is varied in all its atoms. Another number is varied in all atoms from the deciding atom's
        place in the text.
        """
        if self._dial.constant:
            return any(self._dial.is_at("number", number) for number in _numbers(atom.expression))
        deciding_atom = self._deciding.atom
        if deciding_atom.span.start == deciding_atom.span.end:
            return atom.expression == deciding_atom.expression
        return (atom.span, atom.relation, atom.parameters) == (
            deciding_atom.span,
            deciding_atom.relation,
            deciding_atom.parameters,
        )

    def _formula_at(self, number: float) -> Formula:
        return self._change_atoms(lambda atom: self._atom_at(atom, number))

    def _change_atoms(self, change: Callable[[Atom], Atom]) -> Formula:
        return rewritten(self._formula, lambda atom: change(atom) if self._is_meant(atom) else atom)

    def _atom_at(self, atom: Atom, number: float) -> Atom:
        return replace(atom, expression=self._dial.turn(atom.expression, number))

    def _shift_columns(self, added_leaves: Sequence[Formula], number: float) -> Floats:
        """Return the columns of leaves with the dial at a number, by a shift of the original columns."""
        index_of_key = {
            leaf_key(rewritten(leaf, lambda atom: self._atom_at(atom, number))): index
            for index, leaf in self._moving_leaves.items()
        }
        leaf_indices = [index_of_key[leaf_key(leaf)] for leaf in added_leaves]
        shifts = [self._slopes[index] * (number - self._dial.value) for index in leaf_indices]
        shifted_columns: Floats = self._leaves[:, leaf_indices] + np.array(shifts).reshape(1, -1, 1)
        return shifted_columns

    def _columns(self, formulas: Sequence[Formula]) -> Floats:
        return self._evidence.columns(formulas)[:, :, : len(self._times_ns)]

    def _verdict_with(
        self, formula: Formula, added_leaves: Sequence[Atom | Quantified], added_columns: Floats
    ) -> Verdict:
        all_leaves = joined_channels([self._leaves, added_columns], axis=1)
        nodes = self._evaluate(formula, (*self._leaf_order, *added_leaves), all_leaves, self._times_ns)
        return self._verdict_of(*nodes.interval(self._node))


def _bare(formula: Formula) -> tuple[Atom, int] | None:
    """Return the atom and the sign of a leaf with only quantifiers and negations above it; else None."""
    sign = 1
    while not isinstance(formula, Atom):
        if isinstance(formula, Boolean) and formula.operator == "not":
            (formula,), sign = formula.operands, -sign
        elif isinstance(formula, Quantified):
            formula = formula.body
        else:
            return None
    return formula, sign


def _radii_in(expression: Expression) -> list[float]:
    return [radius for part in iter_expressions(expression) for radius in _radii(part)]


def _variants(atom: Atom, margin: float) -> Iterator[Callable[[Atom], Atom]]:
    """Yield changes of an atom without a number, after which it requires a margin."""
    match atom.relation, atom.expression:
        case "ovlp", _:
            yield partial(_as_distance, margin=margin)
        case "sum", Sum(_, Negative()):
            yield partial(_with_summand, margin=margin)
    # a term may be enlarged by the margin, if this shifts every branch by the same amount
    radius, slope = abs(margin), -math.copysign(1.0, margin)
    dial = Dial("radius", radius, is_exact=False)
    for term_index in range(len(atom.terms)):
        variant = partial(_enlarge_term, term_index=term_index, radius=radius)
        if dial.slopes(variant(atom).expression) == {slope}:
            yield variant


def _as_distance(atom: Atom, margin: float) -> Atom:
    """Return `a ovlp b` as `a dist b <= -margin`."""
    expression = Dial("margin", 0.0, is_exact=False).turn(atom.expression, margin)
    return replace(atom, relation="dist", parameters=("<=", -margin), expression=expression)


def _with_summand(atom: Atom, margin: float) -> Atom:
    """Return `x >= y` as `x >= y + margin`."""
    if not isinstance(atom.expression, Sum) or not isinstance(atom.expression.second, Negative):
        raise TypeError(f"{atom.text} is no comparison of computed numbers")
    left_side, right_side = atom.expression.first, atom.expression.second.operand
    if str(atom.parameters[0]).startswith(">"):
        right_side = _plus(right_side, margin)
    else:
        left_side = _plus(left_side, -margin)
    return replace(atom, expression=Sum(left_side, Negative(right_side)))


def _plus(expression: Expression, number: float) -> Expression:
    summand = Number(abs(number))
    return Sum(expression, summand if number >= 0.0 else Negative(summand))


def _enlarge_term(atom: Atom, term_index: int, radius: float) -> Atom:
    enlarged_term = Enlarged(atom.terms[term_index], radius)

    def leaf(part: Number | Signal | Measurement) -> Expression:
        if not isinstance(part, Measurement):
            return part
        return part.with_terms(
            *(enlarged_term if term == enlarged_term.term else term for term in part.terms)
        )

    terms = (*atom.terms[:term_index], enlarged_term, *atom.terms[term_index + 1 :])
    return replace(atom, expression=map_leaves(atom.expression, leaf), terms=terms)


def _short_numbers(number: float, value: float) -> Iterator[float]:
    """Iterate over short numbers near `number`, rounded to nearest or away from `value`, then `number`."""
    exact_number, change = Decimal(number), Decimal(number) - Decimal(value)
    rounding_away = ROUND_CEILING if change > 0 else ROUND_FLOOR
    # a number near 0 may be a rounding error, so the digits of the change are used
    digit_source = (
        change if abs(number) <= max(RESIDUE * abs(value), _STEPS * np.spacing(1.0)) else exact_number
    )
    last_digit = min(digit_source.adjusted() - DIGITS, change.adjusted() - DIGITS + 1) + 1
    for decimal_place in (last_digit, last_digit - DIGITS):
        # the nearest short number may not flip the verdict, but a short number beyond it does
        for rounding in (ROUND_HALF_EVEN, rounding_away):
            short_number = exact_number.quantize(
                Decimal(1).scaleb(decimal_place), context=Context(_PRECISION, rounding)
            )
            yield float(short_number) + 0.0
    yield number

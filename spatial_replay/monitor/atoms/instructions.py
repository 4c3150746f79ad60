"""Leaves (atoms and open quantifiers) compiled to instructions over columns of samples.

Each instruction writes one column in every channel (see `online.codes`). It computes the column from earlier
columns, measurements, signals or constants.

For some quantifiers, only the closest two members of a group are measured.
`forall p, q in people: p dist q >= 0.5` has a binding for each ordered pair, 39,800 for 200 people. The
body's robustness depends only on the distance of p and q, and rises with this distance. The closest pair
therefore has the least robustness. In `exists p, q`, the closest pair has the greatest robustness if
robustness falls as the distance rises.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from math import inf, perm
from typing import Any, NamedTuple, Protocol

import numpy as np

from spatial_replay.compiled import elementwise, inlined, long_kernel
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Flags, Floats, Integers
from spatial_replay.monitor.atoms.terms import Bindings
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Earlier,
    Enlarged,
    Equality,
    Expression,
    Formula,
    Group,
    HasRate,
    Maximum,
    Measurement,
    Minimum,
    Negative,
    Number,
    Present,
    Product,
    Projection,
    Quantified,
    Rate,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Temporal,
    Term,
    TrackedName,
    Truth,
    Variable,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import (
    change_of,
    map_leaves,
    presence_of,
    step_of,
    substitute_term,
)
from spatial_replay.text import TEXTS


@dataclass(frozen=True, slots=True)
class ClosestPair:
    """The signed distance of the closest two members of an open group.

    Attributes:
        enlargement: sum of the enlargements of both members, in footprint units.
    """

    group: Group
    enlargement: float


def closest_pair_of(formula: Quantified) -> ClosestPair | None:
    """Return the closest pair if its distance alone decides a quantifier; else None."""
    closest = number_of_closest(formula)
    return None if closest is None else closest[0]


def number_of_closest(formula: Quantified) -> tuple[ClosestPair, Expression] | None:
    """Return the closest pair that decides a quantifier, and the quantifier's robustness as an expression.

    The expression contains the pair instead of the distance. The result is None for other quantifiers.
    """
    body, sign = formula.body, 1 if formula.quantifier == "forall" else -1
    is_negated = False
    while isinstance(body, Boolean) and body.operator == "not":
        (body,) = body.operands
        is_negated = not is_negated
    if len(formula.variables) != 2 or not isinstance(formula.group, Group) or not isinstance(body, Atom):
        return None
    leaf_effects = {
        (effect, _enlargement(leaf, formula.variables))
        for effect, leaf in _leaves(body.expression, -sign if is_negated else sign)
        if not isinstance(leaf, Number)
    }
    if len(leaf_effects) != 1:
        return None
    ((effect, enlargement),) = leaf_effects
    if effect < 0 or enlargement is None:
        return None
    pair: Any = ClosestPair(formula.group, enlargement)
    number = map_leaves(body.expression, lambda leaf: leaf if isinstance(leaf, Number) else pair)
    return pair, Negative(number) if is_negated else number


def _leaves(expression: Expression, sign: int) -> Iterator[tuple[int, Expression]]:
    """Iterate over the leaves of an expression, with the sign of their effect.

    A minimum or maximum is treated as a leaf. One unknown operand makes it unknown, so it is not monotone.
    """
    match expression:
        case Sum(first, second):
            yield from _leaves(first, sign)
            yield from _leaves(second, sign)
        case Negative(operand):
            yield from _leaves(operand, -sign)
        case Product(operand=operand) | Scaled(operand):
            yield from _leaves(operand, sign)
        case _:
            yield sign, expression


def _enlargement(leaf: Expression, variables: tuple[str, ...]) -> float | None:
    """Return the total enlargement of a distance between the variables; None for other leaves."""
    if not isinstance(leaf, SignedDistance):
        return None
    names, radii = zip(*(_variable_and_radius(term) for term in (leaf.first, leaf.second)), strict=True)
    return sum(radii) if set(names) == set(variables) else None


def _variable_and_radius(term: Term) -> tuple[str | None, float]:
    """Return the name and the enlargement of a variable. The name is None for other terms."""
    match term:
        case Enlarged(inner, radius):
            name, inner_radius = _variable_and_radius(inner)
            return name, inner_radius + radius
        case Variable(name):
            return name, 0.0
    return None, 0.0


# operations of instructions (operation, a, b, c); an undefined number is NaN
CONSTANT, MEASURED, SIGNAL = 0, 1, 2  # constant, measurement or signal a
ADD, NEGATE, LEAST, GREATEST = 3, 4, 5, 6  # of numbers; NaN where an operand is NaN
HOLDS = 7  # a number as an interval: [-inf, inf] where it is NaN
AND, OR = 8, 9  # of intervals
AND_MEMBER, OR_MEMBER = 10, 11  # a with b where membership c is 1, with [-inf, inf] where it is -1
DIVIDE = 12  # a by constant b, which is positive
CLOSEST = 13  # closest pair a, as an interval
EQUAL = 14  # +inf or -inf for signal a and constant b; NaN for a missing signal, or a text and a number
QUOTIENT = 15  # a by b, which is positive and equal in all channels
HAS_VALUE = 16  # +inf where a is a number, else -inf; NaN where b is NaN
MULTIPLY = 17  # a by constant b, which is positive

TILE = 128
"""Number of samples processed together, small enough for the columns to stay in the CPU cache."""


@inlined
def _copy_to(source: Floats, begin: int, count: int, columns: Floats, target: int) -> None:
    for offset in range(count):
        columns[target, offset] = source[begin + offset]


@inlined
def _copy_from(
    columns: Floats, source: int, leaves: Floats, channel: int, leaf: int, begin: int, count: int
) -> None:
    for offset in range(count):
        leaves[channel, leaf, begin + offset] = columns[source, offset]


@elementwise
@long_kernel
def run_instructions(
    code: Integers,
    constants: Floats,
    values: Floats,
    spreads: Floats,
    signals: Floats,
    closest: Floats,
    members: Flags | Integers,
    outputs: Integers,
    leaves: Floats,
    begin: int,
    end: int,
) -> None:
    """Run the instructions over the samples from `begin` to before `end`.

    Args:
        code: operation, a, b and c of each instruction.
        values, spreads, signals, closest, members: rows of T numbers each; a closest pair has four rows.
        outputs: (A,), number of the instruction that computes each leaf.
        leaves: (C, A, T), output.
    """
    channel_count, sample_count, instruction_count = leaves.shape[0], leaves.shape[2], len(code) // 4
    columns = np.empty((instruction_count * channel_count, min(TILE, end - begin)))
    for tile_start in range(begin, end, TILE):
        tile_length = min(TILE, end - tile_start)
        for instruction in range(instruction_count):
            op, a, b, c = (
                code[4 * instruction],
                code[4 * instruction + 1],
                code[4 * instruction + 2],
                code[4 * instruction + 3],
            )
            input_index, member_index = a * sample_count + tile_start, c * sample_count + tile_start
            for channel in range(channel_count):
                mirror_channel = channel ^ 1 if channel_count > 1 else channel
                # rows are indexed, because a slice of an array takes as long as ten samples
                target_row, mirror_row = (
                    instruction * channel_count + channel,
                    a * channel_count + mirror_channel,
                )
                first_row, second_row = a * channel_count + channel, b * channel_count + channel
                # one loop per operation, because a single loop would test the operation at each sample
                if op == CONSTANT:
                    for offset in range(tile_length):
                        columns[target_row, offset] = constants[a]
                elif op == MEASURED:
                    # channels 2 and 3 are the low and high end with uncertainty
                    sign = 0.0 if channel < 2 else -1.0 if channel == 2 else 1.0
                    _copy_to(values, input_index, tile_length, columns, target_row)
                    if sign:
                        for offset in range(tile_length):
                            columns[target_row, offset] += sign * spreads[input_index + offset]
                elif op == SIGNAL:
                    for offset in range(tile_length):
                        value = signals[input_index + offset]
                        # a text is stored as a number up to `TEXTS`, but counts as undefined
                        columns[target_row, offset] = np.nan if -np.inf < value <= TEXTS else value
                elif op == CLOSEST:
                    for offset in range(tile_length):
                        columns[target_row, offset] = closest[
                            (4 * a + channel) * sample_count + tile_start + offset
                        ]
                elif op == ADD:
                    for offset in range(tile_length):
                        columns[target_row, offset] = columns[first_row, offset] + columns[second_row, offset]
                elif op == NEGATE:
                    for offset in range(tile_length):
                        columns[target_row, offset] = -columns[mirror_row, offset]
                elif op == LEAST:
                    for offset in range(tile_length):
                        left, right = columns[first_row, offset], columns[second_row, offset]
                        is_number = left == left and right == right
                        columns[target_row, offset] = min(left, right) if is_number else np.nan
                elif op == GREATEST:
                    for offset in range(tile_length):
                        left, right = columns[first_row, offset], columns[second_row, offset]
                        is_number = left == left and right == right
                        columns[target_row, offset] = max(left, right) if is_number else np.nan
                elif op == HOLDS:
                    unbounded_end = np.inf if channel % 2 else -np.inf
                    for offset in range(tile_length):
                        number, mirror_number = columns[first_row, offset], columns[mirror_row, offset]
                        is_number = number == number and mirror_number == mirror_number
                        columns[target_row, offset] = number if is_number else unbounded_end
                elif op == AND:
                    for offset in range(tile_length):
                        columns[target_row, offset] = min(
                            columns[first_row, offset], columns[second_row, offset]
                        )
                elif op == EQUAL:
                    for offset in range(tile_length):
                        value = signals[input_index + offset]
                        truth = np.inf if value == constants[b] else -np.inf
                        is_comparable = value == value and (value <= TEXTS) == (constants[b] <= TEXTS)
                        columns[target_row, offset] = truth if is_comparable else np.nan
                elif op == DIVIDE:
                    for offset in range(tile_length):
                        columns[target_row, offset] = columns[first_row, offset] / constants[b]
                elif op == MULTIPLY:
                    for offset in range(tile_length):
                        columns[target_row, offset] = columns[first_row, offset] * constants[b]
                elif op == QUOTIENT:
                    for offset in range(tile_length):
                        columns[target_row, offset] = columns[first_row, offset] / columns[second_row, offset]
                elif op == HAS_VALUE:
                    for offset in range(tile_length):
                        left, right = columns[first_row, offset], columns[second_row, offset]
                        has_value = np.inf if left == left else -np.inf
                        columns[target_row, offset] = has_value if right == right else np.nan
                elif op == OR:
                    for offset in range(tile_length):
                        columns[target_row, offset] = max(
                            columns[first_row, offset], columns[second_row, offset]
                        )
                else:
                    for offset in range(tile_length):
                        value = columns[second_row, offset]
                        # with unknown membership, the body may count, so its interval is [-inf, inf]
                        if members[member_index + offset] < 0:
                            value = np.inf if channel % 2 else -np.inf
                        if members[member_index + offset] == 0:
                            columns[target_row, offset] = columns[first_row, offset]
                        elif op == AND_MEMBER:
                            columns[target_row, offset] = min(columns[first_row, offset], value)
                        else:
                            columns[target_row, offset] = max(columns[first_row, offset], value)
        for leaf in range(len(outputs)):
            for channel in range(channel_count):
                _copy_from(
                    columns,
                    outputs[leaf] * channel_count + channel,
                    leaves,
                    channel,
                    leaf,
                    tile_start,
                    tile_length,
                )


MAX_BINDINGS = 20_000
"""Limit on bindings of variables in all open quantifiers of a formula."""
MAX_CLOSEST = 20_000
"""Limit on members of an open group whose closest pair is searched."""


class OpenGroups(Protocol):
    """The possible members of open groups in some samples."""

    def candidates(self, group: Group | Earlier) -> tuple[str, ...]:
        """Return the names of objects that are members in any sample."""

    def may_be_unknown(self, group: Group | Earlier) -> bool:
        """Return whether a group ever looks back to a time before the first sample."""


class Membership(NamedTuple):
    """A binding of an open quantifier, with a flag for each sample.

    The flag is 1 in samples in which all `candidates` are members, else 0. Without candidates, the flag is -1
    in samples with unknown members, else 0.

    Attributes:
        candidates: indices of objects among the candidates of the group.
    """

    group: Group | Earlier
    candidates: tuple[int, ...]


class LeafCode:
    """Instructions for leaves, operands first. Equal instructions share a column.

    Attributes:
        rows: number of each instruction, by (operation, a, b, c).
        constants, measurements, signals, closest, members: index of each input among inputs of its kind.
    """

    def __init__(self, groups: OpenGroups) -> None:
        self._groups = groups
        self._bindings = 0
        self.rows: dict[tuple[int, int, int, int], int] = {}
        self.constants: dict[float, int] = {}
        self.measurements: dict[Measurement, int] = {}
        self.signals: dict[Signal, int] = {}
        self.closest: dict[ClosestPair, int] = {}
        self.members: dict[Membership, int] = {}

    def add_leaves(self, leaves: Sequence[Formula], bindings: Bindings) -> list[int]:
        """Return the numbers of the instructions that compute the leaves of a formula, as intervals.

        Raises:
            UsageError: the bindings exceed `MAX_BINDINGS`.
        """
        self._bindings = 0
        return [self._add(leaf, bindings) for leaf in leaves]

    def _add(self, formula: Formula, bindings: Bindings) -> int:
        """Return the number of the instruction that computes a formula without temporal operators."""
        match formula:
            case Truth():
                return self._constant(inf if formula.value else -inf)
            case Atom():
                return self._row(HOLDS, self._expression(formula.expression, bindings))
            case Quantified():
                return self._quantifier(formula, bindings)
            case Boolean():
                row_of_operand = {id(operand): self._add(operand, bindings) for operand in formula.operands}
                return self._expansion_row(formula.expansion or formula, row_of_operand)
            case Temporal():
                raise TypeError("a temporal operator in the body of an open quantifier")

    def _row(self, op: int, a: int = 0, b: int = 0, c: int = 0) -> int:
        return self.rows.setdefault((op, a, b, c), len(self.rows))

    def _constant(self, value: float) -> int:
        return self._row(CONSTANT, self.constants.setdefault(value, len(self.constants)))

    def _expression(self, expression: Expression | ClosestPair, bindings: Bindings) -> int:
        if isinstance(expression, ClosestPair):
            return self._row(CLOSEST, self.closest.setdefault(expression, len(self.closest)))
        match expression:
            case Number():
                return self._constant(expression.value)
            case Rate():
                terms = tuple(substitute_term(term, bindings) for term in expression.terms)
                bound_rate = replace(expression, terms=terms)
                step_row = self._expression(step_of(bound_rate), {})
                return self._row(QUOTIENT, self._expression(change_of(bound_rate), {}), step_row)
            case Signal():
                return self._row(SIGNAL, self.signals.setdefault(expression, len(self.signals)))
            case Sum():
                first_row = self._expression(expression.first, bindings)
                return self._row(ADD, first_row, self._expression(expression.second, bindings))
            case Negative():
                return self._row(NEGATE, self._expression(expression.operand, bindings))
            case Equality(HasRate(rate=rate)):
                return self._row(HAS_VALUE, self._expression(rate, bindings), self._current(rate, bindings))
            case Equality(signal, value):
                if isinstance(signal, Present):
                    term: Any = substitute_term(signal.term, bindings)
                    signal = presence_of(term).signal
                constant_number = self.constants.setdefault(value, len(self.constants))
                return self._row(EQUAL, self.signals.setdefault(signal, len(self.signals)), constant_number)
            case Product(factor, operand):
                constant_number = self.constants.setdefault(factor, len(self.constants))
                return self._row(MULTIPLY, self._expression(operand, bindings), constant_number)
            case Scaled(operand, divisor):
                constant_number = self.constants.setdefault(divisor, len(self.constants))
                return self._row(DIVIDE, self._expression(operand, bindings), constant_number)
            case Minimum() | Maximum():
                op = LEAST if isinstance(expression, Minimum) else GREATEST
                row, *other_rows = [self._expression(operand, bindings) for operand in expression.operands]
                for other_row in other_rows:
                    row = self._row(op, row, other_row)
                return row
        measurement = expression.with_terms(*(substitute_term(term, bindings) for term in expression.terms))
        return self._row(MEASURED, self.measurements.setdefault(measurement, len(self.measurements)))

    def _current(self, rate: Rate, bindings: Bindings) -> int:
        """Return a row that is NaN in samples that lack the rate's signal or one of its objects."""
        if rate.signal is not None:
            return self._expression(rate.signal, bindings)
        row, *other_rows = [self._expression(Projection(term, "x", "min"), bindings) for term in rate.terms]
        for other_row in other_rows:
            row = self._row(ADD, row, other_row)
        return row

    def _expansion_row(self, formula: Formula, rows: Mapping[int, int]) -> int:
        """Return the row of an expansion.

        An expansion repeats operands. Compilation of each repetition would take 2**depth steps.

        Args:
            rows: rows of the original operands, by the `id` of the operand.
        """
        if id(formula) in rows:
            return rows[id(formula)]
        row, *other_rows = [self._expansion_row(operand, rows) for operand in operands_of(formula)]
        operator = operator_of(formula)
        if operator == "not":
            return self._row(NEGATE, row)
        for other_row in other_rows:
            row = self._row(AND if operator == "and" else OR, row, other_row)
        return row

    def _quantifier(self, formula: Quantified, bindings: Bindings) -> int:
        is_forall = formula.quantifier == "forall"
        group: Any = substitute_term(formula.group, bindings)
        if (pair_and_number := number_of_closest(replace(formula, group=group))) is not None:
            if (candidate_count := len(self._groups.candidates(group))) > MAX_CLOSEST:
                use_text = f"{formula.quantifier} {', '.join(formula.variables)} looks for the closest two"
                raise UsageError(
                    f"{use_text} of {candidate_count} objects; {MAX_CLOSEST} is the limit:"
                    " use a smaller group"
                )
            return self._row(HOLDS, self._expression(pair_and_number[1], bindings))
        candidate_names = self._groups.candidates(group)
        self._check_bindings(formula, len(candidate_names))
        op = AND_MEMBER if is_forall else OR_MEMBER
        # the quantifier's value over no member
        row = self._constant(inf if is_forall else -inf)
        if self._groups.may_be_unknown(group):
            # the quantifier is unknown in samples with unknown members
            row = self._row(op, row, row, self._member(group, ()))
        # members are permuted, because different variables stand for different members
        for indices in permutations(range(len(candidate_names)), len(formula.variables)):
            members = [TrackedName(candidate_names[index]) for index in indices]
            member_bindings = {**bindings, **dict(zip(formula.variables, members, strict=True))}
            body_row = self._add(formula.judged, member_bindings)
            row = self._row(op, row, body_row, self._member(group, indices))
        return row

    def _member(self, group: Group | Earlier, candidates: tuple[int, ...]) -> int:
        return self.members.setdefault(Membership(group, candidates), len(self.members))

    def _check_bindings(self, formula: Quantified, member_count: int) -> None:
        self._bindings += perm(member_count, len(formula.variables))
        if self._bindings > MAX_BINDINGS:
            raise UsageError(
                f"{formula.quantifier} {', '.join(formula.variables)} over {member_count} objects gives a "
                f"formula {self._bindings} bindings; {MAX_BINDINGS} is the limit: use a smaller group or "
                "fewer variables"
            )

"""One formula evaluated by Def. 16 of the paper, as samples come.

Differs from `OnlineRun` beyond the ends of the run: an operand that would need samples from there is left out
of minima and maxima. And where something is unknown: every number that depends on it is undetermined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from types import MappingProxyType
from typing import Final, TypeAlias

import numpy as np

from spatial_replay.compiled import kernel
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Booleans, Empty, Floats, Integers
from spatial_replay.monitor.atoms.delays import iter_delays
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.spec.diagnostics import SourceText
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    Quantified,
    Specification,
    Temporal,
    Truth,
    iter_nodes,
)
from spatial_replay.spec.walks import has_rate, is_spatial, leaf_key, nodes_with_operands

Numbers: TypeAlias = Floats
"""(2, …): numbers, NaN where they are left out, and whether something unknown matters to them (1, else 0)."""

_LEFT_OUT: Final = np.array([[np.nan], [0.0]])
_PICKS: Mapping[str, np.ufunc] = MappingProxyType({"X": np.fmax, "F": np.fmax, "G": np.fmin, "U": np.fmax})
OPERATORS = frozenset(_PICKS)
"""The temporal operators that there are."""


def _joined(numbers: Floats, lost: Floats) -> Numbers:
    made = np.empty((2, *numbers.shape))
    made[0], made[1] = numbers, lost
    return made


def _combined(operator: str, operands: Sequence[Numbers]) -> Numbers:
    """Apply a Boolean operator."""
    numbers = [each[0] for each in operands]
    one, other = numbers[0], numbers[-1]
    match operator:
        case "not":
            number = -one
        case "and":
            number = reduce(np.fmin, numbers)
        case "or":
            number = reduce(np.fmax, numbers)
        case "->":
            number = np.fmax(-one, other)
        case "xor":
            number = np.fmax(np.fmin(one, -other), np.fmin(-one, other))
        case "<->":
            number = np.fmin(np.fmax(-one, other), np.fmax(-other, one))
        case _:
            number = one
    return _joined(number, reduce(np.maximum, [each[1] for each in operands]))


def _accumulated(pick: np.ufunc, numbers: Numbers) -> Numbers:
    """Return the least or greatest number so far."""
    return _joined(pick.accumulate(numbers[0]), np.maximum.accumulate(numbers[1]))


def _to_the_end(pick: np.ufunc, numbers: Numbers) -> Numbers:
    """Return the least or greatest number from each place to the last one."""
    return _accumulated(pick, numbers[:, ::-1])[:, ::-1]


def _carried(pick: np.ufunc, before: Numbers, numbers: Numbers) -> Numbers:
    """Return the least or greatest number so far, and before."""
    return _accumulated(pick, np.concatenate([before, numbers], axis=1))[:, 1:]


@kernel
def scan_until(left: Floats, right: Floats, into: Floats) -> None:
    """Run until from each sample to the last one; the left operand depends on no later sample.

    The best over later ends is capped by the left operand here. An end of which everything was left out so
    far takes on the left operand here, which is then as good as any.

    Args:
        left, right, into: (2, T), as `Numbers`.
    """
    best, is_lost, is_any_left_out = np.nan, 0.0, False
    for t in range(left.shape[1] - 1, -1, -1):
        mine, other = left[0, t], right[0, t]
        if not np.isnan(mine):
            if is_any_left_out:
                best = mine
            elif not np.isnan(best):
                best = min(mine, best)
            is_any_left_out = False
        here = mine if np.isnan(other) else other if np.isnan(mine) else min(other, mine)
        if np.isnan(here):
            is_any_left_out = True
        elif np.isnan(best) or here > best:
            best = here
        is_lost = max(is_lost, left[1, t], right[1, t])
        into[0, t], into[1, t] = best, is_lost


MAX_PAIRS = 1 << 27
"""The most pairs of samples that untils may store a number for: about 11,000 samples, 2 GB."""


class PaperRun:
    """The numbers of every node on every prefix by Def. 16.

    A temporal operator over plain formulas, which are about one sample, carries one number. Below another
    temporal operator it carries numbers for every sample so far, and each sample takes time in proportion to
    them.
    """

    def __init__(
        self, formula: Formula, leaves: Sequence[Atom | Quantified], *, max_pairs: int = MAX_PAIRS
    ) -> None:
        """Start before the first sample.

        Args:
            leaves: the formula's atoms and open quantifiers, in the order in which `extend` is given them.
            max_pairs: the most pairs of samples to compare.
        """
        self._max_pairs = max_pairs
        tree = nodes_with_operands(formula)
        self._nodes, self._operands = [node for node, _ in tree], [operands for _, operands in tree]
        keys = [leaf_key(leaf) for leaf in leaves]
        is_leaf = [isinstance(node, Atom | Quantified) for node in self._nodes]
        self._leaf = {n: keys.index(leaf_key(node)) for n, node in enumerate(self._nodes) if is_leaf[n]}
        self._is_plain = [is_spatial(node) for node in self._nodes]
        # which nodes are needed at every sample, and which of all later samples change in more than one place
        self._is_wanted = [False] * len(self._nodes)
        self._nested: list[int] = []
        for n, (node, operands) in enumerate(tree):
            if self._is_plain[n]:
                is_nested = False
            elif isinstance(node, Temporal):
                is_nested = self._is_wanted[n] or not all(self._is_plain[each] for each in operands)
            else:
                is_nested = self._is_wanted[n]
            for each in operands:
                self._is_wanted[each] = is_nested
            if is_nested:
                self._nested.insert(0, n)
        self._position, self._first_ns = 0, 0
        self._elapsed = np.empty(0, np.int64)
        kept = [n for n, is_wanted in enumerate(self._is_wanted) if is_wanted or n in self._nested]
        self._columns = {n: np.empty((2, 0)) for n in kept}
        untils = [n for n in self._nested if len(self._operands[n]) == 2 and self._is_until(n)]
        self._pairs = {n: np.empty((2, 0, 0)) for n in untils if not any(self._plain_sides(n))}
        self._ends = {n: np.empty((2, 0)) for n in untils if self._plain_sides(n) == [False, True]}
        self._value = np.repeat(_LEFT_OUT, len(self._nodes), axis=1)
        self._least_left = np.repeat(_LEFT_OUT, len(self._nodes), axis=1)

    def __len__(self) -> int:
        """Return how many samples were added."""
        return self._position

    @property
    def final(self) -> Floats:
        """(N, 2): twice each node's value on the samples so far; NaN where it is undetermined."""
        return np.repeat(_determined(self._value)[:, None], 2, axis=1)

    def extend(self, leaves: Floats, times_ns: Integers, empty: Empty = np.empty) -> Floats:
        """Add samples.

        Args:
            leaves: (C, A, T), as for `OnlineRun.extend`, with NaN where a leaf is left out (see `left_out`).
            times_ns: (T,), increasing and after the previous samples.
            empty: gives memory for what is returned.

        Returns:
            (N, 4, T): value, now, lower and upper of each node; the last two are the first.

        Raises:
            UsageError: more pairs of samples than allowed.
        """
        series = empty((len(self._nodes), 4, len(times_ns)))
        if not len(times_ns):
            return series
        if self._position == 0:
            self._first_ns = int(times_ns[0])
        now = self._now(leaves)
        elapsed = times_ns - self._first_ns
        values: dict[int, Numbers] = {}
        if self._nested:
            self._make_room(elapsed)
            values = self._run_nested(now)
        for n in reversed(range(len(self._nodes))):
            if n not in values:
                values[n] = self._at_first(n, now, values, elapsed)
            self._value[:, n] = values[n][:, -1]
            series[n, 0] = series[n, 2] = series[n, 3] = _determined(values[n])
            series[n, 1] = _determined(now[n])
        self._position += len(times_ns)
        return series

    def _now(self, leaves: Floats) -> dict[int, Numbers]:
        """Return each node on each sample alone."""
        # Def. 16 knows no uncertainty: nominal ends only, and a number is lost where they differ
        low, high = low_and_high(len(leaves), wide=False)
        now: dict[int, Numbers] = {}
        for n in reversed(range(len(self._nodes))):
            node, operands = self._nodes[n], [now[each] for each in self._operands[n]]
            match node:
                case Truth():
                    now[n] = np.zeros((2, leaves.shape[2]))
                    now[n][0] = np.inf if node.value else -np.inf
                case Boolean():
                    now[n] = _combined(node.operator, operands)
                case Temporal():
                    is_later = node.operator == "X" or (node.bound is not None and node.bound.lower > 0)
                    now[n] = _combined("and", operands)
                    if is_later:
                        now[n][:] = _LEFT_OUT
                case _:
                    ends = leaves[low, self._leaf[n]], leaves[high, self._leaf[n]]
                    now[n] = _joined(ends[0], (ends[0] != ends[1]) & ~np.isnan(ends[0]))
        return now

    def _at_first(
        self, n: int, now: Mapping[int, Numbers], values: Mapping[int, Numbers], elapsed: Integers
    ) -> Numbers:
        """Return a node that is not nested at the first sample, on the samples up to each."""
        node, count = self._nodes[n], len(elapsed)
        if self._is_plain[n]:
            return np.repeat(self._value[:, [n]] if self._position else now[n][:, :1], count, axis=1)
        if isinstance(node, Boolean):
            return _combined(node.operator, [values[each] for each in self._operands[n]])
        assert isinstance(node, Temporal)
        positions = np.arange(self._position, self._position + count)
        inside = _is_within(node, elapsed if _is_timed(node) else positions)
        right = np.where(inside, now[self._operands[n][-1]], _LEFT_OUT)
        if node.operator == "U":
            left = np.where(inside, now[self._operands[n][0]], _LEFT_OUT)
            least = _carried(np.fmin, self._least_left[:, [n]], left)
            self._least_left[:, n] = least[:, -1]
            right = np.where(inside, _combined("and", [right, least]), _LEFT_OUT)
        return _carried(_PICKS[node.operator], self._value[:, [n]], right)

    # ------------------------------------------------------------------------------ one below another

    def _make_room(self, elapsed: Integers) -> None:
        """Add the times of the next samples, and room for numbers at them."""
        if self._pairs and self._position**2 > self._max_pairs:
            raise UsageError(
                f"after {self._position} samples, an until of two temporal operands below a temporal "
                "operator compares too many pairs of them; bound it, evaluate fewer samples, or use "
                "the semantics 'ltlf'"
            )
        self._elapsed = np.concatenate([self._elapsed[: self._position], elapsed])
        wanted = self._position + len(elapsed)
        for columns in (self._columns, self._ends):
            for n, column in columns.items():
                columns[n] = _with_room(column, wanted, 1)
        for n, pairs in self._pairs.items():
            pairs = _with_room(pairs, wanted, 1)
            self._pairs[n] = _with_room(pairs, wanted if self._is_wanted[n] else 1, 2)

    def _run_nested(self, now: Mapping[int, Numbers]) -> dict[int, Numbers]:
        """Return the nested nodes at the first sample, on the samples up to each of some."""
        count = now[0].shape[1]
        values = {n: np.empty((2, count)) for n in self._nested}
        plain = [n for n in self._columns if self._is_plain[n]]
        for n in plain:
            self._columns[n][:, self._position : self._position + count] = now[n]
        for k in range(count):
            for n in self._nested:
                self._update(n, self._position + k)
                values[n][:, k] = self._columns[n][:, 0]
        return values

    def _update(self, n: int, last: int) -> None:
        """Compute a node on the samples up to `last`, at each sample where that changes it."""
        node, into = self._nodes[n], self._columns[n]
        operands = [self._columns[each][:, : last + 1] for each in self._operands[n]]
        if isinstance(node, Boolean):
            into[:, : last + 1] = _combined(node.operator, operands)
            return
        assert isinstance(node, Temporal)
        size = last + 1 if self._is_wanted[n] else 1
        if node.operator == "X":
            size = min(size, last)
            into[:, :size] = operands[0][:, 1 : size + 1]
            return
        here, starts = np.arange(size), np.arange(size)
        if node.bound is not None:
            # the samples in whose windows the last one is, and where these windows begin
            places = self._elapsed[: last + 1] if _is_timed(node) else np.arange(last + 1)
            here = np.flatnonzero(_is_within(node, places[last] - places[:size]))
            starts = np.searchsorted(places, places[here] + node.bound.lower)
        if len(here):
            first = int(starts[0])
            if node.operator == "U":
                inner = self._until(n, operands[0], operands[1], first)
            else:
                inner = _to_the_end(_PICKS[node.operator], operands[0][:, first:])
            into[:, here] = inner[:, starts - first]

    def _until(self, n: int, left: Numbers, right: Numbers, first: int) -> Numbers:
        """Return until to the last sample, from each sample from `first` on."""
        last, left, right = left.shape[1] - 1, left[:, first:], right[:, first:]
        if self._plain_sides(n)[0]:
            inner = np.empty(left.shape)
            scan_until(np.ascontiguousarray(left), np.ascontiguousarray(right), inner)
            return inner
        still = _to_the_end(np.fmin, left)
        if n in self._ends:
            # until to the sample before is known
            inner = self._ends[n][:, first : last + 1]
            best = _combined("and", [still, np.repeat(right[:, -1:], still.shape[1], axis=1)])
            inner[:] = _combined("or", [inner, best])
            return inner
        # each end has its own least of the left operand, on the samples up to it
        begins = slice(first, last + 1) if self._is_wanted[n] else slice(0, 1)
        pairs = self._pairs[n]
        pairs[:, last, begins] = still[:, : begins.stop - begins.start]
        ends = pairs[:, first : last + 1, begins]
        numbers, lost = np.fmin(ends[0], right[0][:, None]), np.maximum(ends[1], right[1][:, None])
        is_later = np.tri(*numbers.shape, dtype=np.bool_)
        greatest = np.fmax.reduce(numbers, axis=0, where=is_later, initial=np.nan)
        return _joined(greatest, lost.max(axis=0, where=is_later, initial=0.0))

    def _is_until(self, n: int) -> bool:
        node = self._nodes[n]
        return isinstance(node, Temporal) and node.operator == "U"

    def _plain_sides(self, n: int) -> list[bool]:
        """Return which operands of a node are about one sample."""
        return [self._is_plain[each] for each in self._operands[n]]


def _is_timed(node: Temporal) -> bool:
    return node.bound is not None and node.bound.unit == "ns"


def _is_within(node: Temporal, distances: Integers) -> Booleans:
    """Return which distances from a sample are in the window of an operator there."""
    lower, upper = (0, None) if node.bound is None else (node.bound.lower, node.bound.upper)
    if node.operator == "X":
        lower = upper = 1
    is_within: Booleans = distances >= lower
    return is_within if upper is None else is_within & (distances <= upper)


def _determined(numbers: Numbers) -> Floats:
    """Return numbers, (…), NaN where something unknown matters.

    Adding zero turns -0.0 into 0.0, so that equal numbers are equal bits.
    """
    return np.where(np.isnan(numbers[0]) | (numbers[1] > 0.0), np.nan, numbers[0] + 0.0)


def _with_room(numbers: Numbers, wanted: int, axis: int) -> Numbers:
    """Return numbers with room for so many along an axis, or more; what is new is left out."""
    length = numbers.shape[axis]
    if wanted <= length:
        return numbers
    shape = [*numbers.shape]
    shape[axis] = max(wanted, 2 * length) - length
    new = np.zeros(shape)
    new[0] = np.nan
    return np.concatenate([numbers, new], axis=axis)


def left_out(
    values: Floats,
    leaves: Sequence[Atom | Quantified],
    positions: Integers,
    times_ns: Integers,
    first_ns: int,
) -> Floats:
    """Return leaves with NaN where one, or the body of a quantifier, looks back (`a[-3]`) to before the log.

    Args:
        values: (C, A, T) of these leaves.
        positions: (T,), how many samples of the log come before each.
        times_ns: (T,).
        first_ns: the time of the log's first sample.
    """
    is_before = np.zeros(values.shape[1:], np.bool_)
    for row, leaf in zip(is_before, leaves, strict=True):
        for samples, duration_ns in set(iter_delays([leaf])):
            row |= positions < (samples or 0)
            if duration_ns is not None:
                row |= times_ns - duration_ns < first_ns
    return np.where(is_before, np.nan, values) if is_before.any() else values


def check_operators(specification: Specification) -> None:
    """Check that all temporal operators of the result specs are the paper's.

    Raises:
        UsageError: the first other operator, with its place.
    """
    for spec in specification.results:
        for _, _, node in iter_nodes(spec.formula):
            if isinstance(node, Temporal) and node.operator not in OPERATORS:
                source = SourceText.of(specification.source, specification.filename)
                fault = source.diagnostic("error", node.span, f"the paper's semantics has no {node.operator}")
                remedy = "write it with X, F, G and U"
                if node is spec.formula and has_rate(node):
                    remedy = "a rate of change is read from the second sample on: write X in front"
                raise UsageError(
                    f"{fault.filename}:{fault.line}:{fault.column}: {fault.message}, as {spec.name} has; "
                    f"{remedy}, or evaluate with the semantics 'ltlf'"
                )

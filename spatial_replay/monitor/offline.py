"""Offline robustness: rho(t, node) of every node at each sample t, evaluated from t to the last sample.

A monitor, in contrast, computes robustness only at the first and the newest sample. A sliding window is
evaluated as a separate log at each position.

The last sample is known, so each operator takes one pass, independent of the width of its window.
A future operator is a past operator in reversed time: kernels number *steps* 0, 1, … and look back. For a
past operator, step i is sample begin + i. For a future operator, step i is sample end - 1 - i.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, kernel, piece
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers, roomy, writable
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.codes import OFFLINE_TARGET, joined_channels, low_and_high
from spatial_replay.monitor.online.program import SignalTable, array_of_rows
from spatial_replay.monitor.online.signals import past_value
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Bound,
    Formula,
    Quantified,
    Signal,
    Temporal,
    expand,
    judged_operator,
    operator_of,
)
from spatial_replay.spec.walks import nodes_with_operands
from spatial_replay.trace.trace import LATEST_NS


class Steps(NamedTuple):
    """Samples in the direction in which an operator reads them.

    Attributes:
        stamps: times of all samples in ns.
        origin, stride: step i is sample origin + stride * i.
        length: number of steps.
    """

    stamps: Integers
    origin: int
    stride: int
    length: int


@inlined
def _at(steps: Steps, step: int) -> int:
    return steps.origin + steps.stride * step


@inlined
def _distance(steps: Steps, unit: int, earlier: int, later: int) -> int:
    """Return the distance between two steps, in samples or ns."""
    if unit == codes.SAMPLES:
        return later - earlier
    return int(abs(steps.stamps[_at(steps, later)] - steps.stamps[_at(steps, earlier)]))


@piece
def _run_past(code: int, first_operand: Floats, second_operand: Floats, target: Floats, steps: Steps) -> None:
    """Run an unbounded O, H or S."""
    value = np.inf if code == codes.HISTORICALLY else -np.inf
    for step in range(steps.length):
        sample = _at(steps, step)
        value = past_value(code, first_operand[sample], second_operand[sample], value)
        target[sample] = value


@piece
def _run_delay(
    source: Floats, target: Floats, steps: Steps, unit: int, distance: int, missing_value: float
) -> None:
    """Delay a column: each step gets the value of the latest step that is at least `distance` earlier."""
    source_step = -1
    for step in range(steps.length):
        while source_step < step and _distance(steps, unit, source_step + 1, step) >= distance:
            source_step += 1
        target[_at(steps, step)] = source[_at(steps, source_step)] if source_step >= 0 else missing_value


@piece
def _slide(
    source: Floats, target: Floats, steps: Steps, unit: int, near: int, far: int, sign: float, extrema: Floats
) -> None:
    """Compute the sliding maximum (sign 1) or minimum (sign -1) of a column.

    The window of a step has the steps that are `near` to `far` earlier.

    Two stacks hold the window. `extrema` has the extremum from each older step up to `middle`, and
    `recent_extremum` is the extremum from `middle` on. Each step enters each stack once, regardless of the
    window's width.
    """
    window_start, middle, window_end = 0, 0, 0
    recent_extremum = -np.inf
    for step in range(steps.length):
        while window_end <= step and _distance(steps, unit, window_end, step) >= near:
            recent_extremum = max(recent_extremum, sign * source[_at(steps, window_end)])
            window_end += 1
        while window_start < window_end and _distance(steps, unit, window_start, step) > far:
            window_start += 1
        # the older stack is empty: move the recent steps into it, with running extrema from the newest down
        if window_start >= middle:
            extremum = -np.inf
            for older_step in range(window_end - 1, window_start - 1, -1):
                extremum = max(extremum, sign * source[_at(steps, older_step)])
                extrema[older_step] = extremum
            middle = window_end
            recent_extremum = -np.inf
        older_extremum = extrema[window_start] if window_start < middle else -np.inf
        target[_at(steps, step)] = sign * max(older_extremum, recent_extremum)


@piece
def _run_boolean(
    row: Integers, columns: Floats, channel: int, mirror_channel: int, target: Floats, begin: int, end: int
) -> None:
    """Compute the row of a Boolean operator in one channel; a negation reads `mirror_channel`."""
    code, first_column, second_column = row[0], row[1], row[2]
    first_operand, second_operand = columns[channel, first_column], columns[channel, second_column]
    if code == codes.CONSTANT:
        # rows hold integers, so an infinity is stored as its sign
        target[begin:end] = row[4] * np.inf
    elif code == codes.NOT:
        for sample in range(begin, end):
            target[sample] = -columns[mirror_channel, first_column, sample]
    elif code == codes.AND:
        for sample in range(begin, end):
            target[sample] = min(first_operand[sample], second_operand[sample])
    elif code == codes.OR:
        for sample in range(begin, end):
            target[sample] = max(first_operand[sample], second_operand[sample])


@kernel
def run_offline(
    rows: Integers, leaves: Floats, stamps: Integers, begin: int, end: int, columns: Floats, extrema: Floats
) -> None:
    """Compute all rows on the samples from `begin` to before `end` as on a separate log.

    Args:
        rows: (R, OFFLINE_WIDTH), operands first.
        leaves: (C, A, T) in one, two or four channels.
        stamps: (T,), ns.
        columns: (C, K, T), output.
        extrema: (T,), work space.
    """
    channel_count = leaves.shape[0]
    for row_number in range(rows.shape[0]):
        row = rows[row_number]
        code = row[0]
        is_ahead = code >= codes.AHEAD
        past_code = code - codes.AHEAD if is_ahead else code
        steps = Steps(stamps, end - 1 if is_ahead else begin, -1 if is_ahead else 1, end - begin)
        for channel in range(channel_count):
            # a negation swaps the low and the high end (see `codes`)
            mirror_channel = channel ^ 1 if channel_count > 1 else channel
            target = columns[channel, row[codes.OFFLINE_TARGET]]
            if code == codes.LEAF:
                # elements are copied singly, because a slice's check of lengths takes seconds to compile
                for sample in range(begin, end):
                    target[sample] = leaves[channel, row[1], sample]
                continue
            source = columns[channel, row[1]]
            if past_code < codes.ONCE:
                _run_boolean(row, columns, channel, mirror_channel, target, begin, end)
            elif past_code <= codes.SINCE:
                _run_past(past_code, source, columns[channel, row[2]], target, steps)
            elif past_code == codes.DELAY:
                _run_delay(source, target, steps, row[3], row[4], row[5] * np.inf)
            else:
                sign = 1.0 if past_code == codes.WINDOW_MAX else -1.0
                _slide(source, target, steps, row[3], row[4], row[5], sign, extrema)


@kernel
def run_windows(
    rows: Integers, leaves: Floats, stamps: Integers, starts: Integers, columns: Floats, extrema: Floats,
    result: Floats,
) -> None:  # fmt: skip
    """Evaluate all nodes on a sliding window, at the start of each window. A window ends at each sample.

    Args:
        starts: (T,), first sample of each window.
        result: (C, N, T), output for the first N columns.
    """
    for sample in range(len(stamps)):
        run_offline(rows, leaves, stamps, starts[sample], sample + 1, columns, extrema)
        for channel in range(leaves.shape[0]):
            for node in range(result.shape[1]):
                result[channel, node, sample] = columns[channel, node, starts[sample]]


_MIRRORED = MappingProxyType({"X": "Y", "F": "O", "G": "H", "U": "S"})
"""Past operators by the future operators that they equal in reversed time."""


class OfflineTable(SignalTable):
    """Instruction rows in which future operators are past operators in reversed time.

    Reversed time starts at the last sample, so the table serves finished traces only. Each operator is a
    single pass.
    """

    def _added_row(self, formula: Formula, operands: list[int]) -> int:
        if isinstance(formula, Temporal) and formula.operator in _MIRRORED:
            return self._temporal(_MIRRORED[formula.operator], operands, formula.bound, codes.AHEAD)
        return super()._added_row(formula, operands)

    def instructions(self, nodes: Sequence[int]) -> Integers:
        """Return instruction rows with their input and output columns.

        Node n writes column n. Rows without a node write the columns after the nodes' columns.

        Args:
            nodes: (N,), row of each node.

        Returns:
            (R, OFFLINE_WIDTH), operands first.
        """
        # nodes are reversed, so that the first of several equal nodes owns the row
        column_of_row = {row: node for node, row in reversed(list(enumerate(nodes)))}
        other_rows = (row for row in range(len(self._rows)) if row not in column_of_row)
        column_of_row |= dict(zip(other_rows, count(len(nodes)), strict=False))
        instruction_rows = []
        for row_number, (code, first_operand, second_operand, *window) in enumerate(self._rows):
            operands = (
                (first_operand, second_operand)
                if code == codes.LEAF
                else (column_of_row[first_operand], column_of_row[second_operand])
            )
            instruction_rows.append((code, *operands, *window, column_of_row[row_number]))
        # equal nodes share a row, but each has its own column: `and` of a column with itself is a copy
        copies = [
            (codes.AND, column_of_row[row], column_of_row[row], 0, 0, 0, n) for n, row in enumerate(nodes)
        ]
        instruction_rows += [copy for copy in copies if copy[1] != copy[-1]]
        return array_of_rows(instruction_rows, codes.OFFLINE_WIDTH)


@dataclass(frozen=True, eq=False)
class OfflineNodes:
    """The robustness of every node of a formula at every sample.

    Attributes:
        times_ns: (T,).
        columns: (C, N, T), ends of each node's interval, in channels (see `online.codes`).
        conditions: (C, T) by operand id, the condition that all rates of the operand have values. Only
            operands with rates below a temporal operator have a condition (see `_judged_operands`).
        goes_on: whether samples may follow.
    """

    formula: Formula
    times_ns: Integers
    columns: Floats
    conditions: Mapping[int, Floats] = field(default_factory=dict)
    goes_on: bool = False

    @cached_property
    def tree(self) -> list[tuple[Formula, list[int]]]:
        """Every node, by id, with the ids of its operands."""
        return nodes_with_operands(self.formula)

    def ends(self, node: int, *, wide: bool = True) -> tuple[Floats, Floats]:
        """Return the ends (T,) of a node's robustness at each sample.

        Args:
            wide: whether the ends include the uncertainty of objects.
        """
        low, high = low_and_high(len(self.columns), wide=wide)
        return self.columns[low, node], self.columns[high, node]

    def judged_ends(self, operand: int) -> tuple[Floats, Floats]:
        """Return the ends (T,) of an operand's robustness, neutral at samples that its operator omits."""
        low, high = self.ends(operand)
        condition = self.conditions.get(operand)
        if condition is None:
            return low, high
        condition_low, condition_high = condition[[*low_and_high(len(condition), wide=True)]]
        if self._judged[operand].operator == "with":
            return np.minimum(condition_low, low), np.minimum(condition_high, high)
        return np.maximum(-condition_high, low), np.maximum(-condition_low, high)

    def is_left_out(self, operand: int, sample: int) -> bool:
        """Return whether the operator above an operand leaves a sample out."""
        return operand in self.conditions and bool((self.conditions[operand][:, sample] == -np.inf).all())

    @cached_property
    def _judged(self) -> dict[int, Boolean]:
        return _judged_operands(self.tree)

    def interval(self, node: int, sample: int = 0, *, wide: bool = True) -> tuple[float, float]:
        """Return the ends of a node's robustness at one sample."""
        low, high = self.ends(node, wide=wide)
        # adding zero turns -0.0 into 0.0
        return float(low[sample]) + 0.0, float(high[sample]) + 0.0


@dataclass(frozen=True, eq=False)
class OfflineFormula:
    """A formula compiled once for evaluation over several logs.

    Attributes:
        table: (R, OFFLINE_WIDTH), instruction rows of the formula.
        nodes: number of nodes.
        width: number of columns that the rows write.
        conditions: column of an operand's condition, by operand id (see `OfflineNodes`).
    """

    formula: Formula
    table: Integers
    nodes: int
    width: int
    conditions: Mapping[int, int]

    @classmethod
    def of(
        cls, formula: Formula, order: Sequence[Atom | Quantified], stand_ins: Sequence[Formula] = ()
    ) -> OfflineFormula:
        """Compile a formula.

        Args:
            order: leaves of the formula in the order of their numbers.
            stand_ins: formulas to compute instead of `computed_formulas(formula)`, if there are any.
        """
        table, tree = OfflineTable(order), nodes_with_operands(formula)
        rows = [table.add(computed_formula) for computed_formula in stand_ins or computed_formulas(formula)]
        instructions = table.instructions(rows)
        conditions = dict(zip(_judged_operands(tree), range(len(tree), len(rows)), strict=True))
        return cls(
            formula, instructions, len(tree), int(instructions[:, OFFLINE_TARGET].max()) + 1, conditions
        )

    def evaluate(self, leaves: Floats, times_ns: Integers) -> OfflineNodes:
        """Evaluate every node over all samples (see `evaluate_offline`)."""
        columns = roomy((len(leaves), self.width, len(times_ns)), np.float64)
        extrema = np.empty(len(times_ns))
        stamps = writable(times_ns)
        run_offline(self.table, writable(leaves), stamps, 0, len(stamps), columns, extrema)
        conditions = {operand: columns[:, column] for operand, column in self.conditions.items()}
        return OfflineNodes(self.formula, times_ns, columns[:, : self.nodes], conditions)


def computed_formulas(formula: Formula) -> list[Formula]:
    """Return the nodes of a formula in the order of their ids, then the conditions of `_judged_operands`."""
    tree = nodes_with_operands(formula)
    return [
        *(node for node, _ in tree),
        *(operand.operands[0] for operand in _judged_operands(tree).values()),
    ]


def _judged_operands(tree: Sequence[tuple[Formula, list[int]]]) -> dict[int, Boolean]:
    """Return the operands of temporal operators that contain rates, by id, as `given` or `with` formulas.

    A temporal operator leaves out samples in which a rate of its operand has no value. The operand is
    therefore judged by a `given` or `with` formula. This formula's first operand is the condition that all
    rates have values. Its second operand is the judged operand.
    """
    return {
        identifier: operand
        for node, operands in tree
        if isinstance(node, Temporal)
        for identifier, operand in zip(operands, judged_operator(node).operands, strict=True)
        if isinstance(operand, Boolean) and operand.operator in ("given", "with")
    }


def evaluate_offline(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers
) -> OfflineNodes:
    """Evaluate every node over all samples.

    Args:
        order: leaves of the formula in the order of their numbers.
        leaves: (C, A, T), intervals of the leaves (see `leaf_values`).
        times_ns: (T,), increasing; T at least 1.
    """
    return OfflineFormula.of(formula, order).evaluate(leaves, times_ns)


def evaluate_prefix(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers
) -> OfflineNodes:
    """Evaluate every node over samples that further samples may follow.

    Values after the last sample are unknown, [-inf, +inf], so the robustness at the first sample is that of
    a monitor. A deciding path ends at the atom that settled a verdict before the log ended. Arguments are as
    for `evaluate_offline`.
    """
    return replace(_evaluate_beyond(formula, order, leaves, times_ns, _is_open), goes_on=True)


def evaluate_with_whole_windows(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers
) -> OfflineNodes:
    """Evaluate every node over a finished log, as if cut windows continued with unknown values.

    Windows are cut as in `is_cut`. Arguments are as for `evaluate_offline`.
    """
    return _evaluate_beyond(formula, order, leaves, times_ns, is_cut)


def _evaluate_beyond(
    formula: Formula,
    leaf_order: Sequence[Atom | Quantified],
    leaves: Floats,
    times_ns: Integers,
    find_open: Callable[[Temporal, Integers], Booleans],
) -> OfflineNodes:
    open_formulas = _OpenFormulas(times_ns, find_open)
    stand_ins = [open_formulas.of(node_formula) for node_formula in computed_formulas(formula)]
    is_open = np.array(open_formulas.columns, np.bool_).reshape(-1, len(times_ns))
    unknown_ends = np.stack([np.full(is_open.shape, -np.inf), np.where(is_open, np.inf, -np.inf)])
    compiled = OfflineFormula.of(formula, (*leaf_order, *open_formulas.leaves), stand_ins)
    return compiled.evaluate(joined_channels([leaves, unknown_ends], axis=1), times_ns)


class _OpenFormulas:
    """Formulas with an extra leaf for the unknown values in each open window.

    Attributes:
        leaves: one leaf for each operator whose window is open at some sample.
        columns: (T,) for each leaf, whether the leaf is unknown at a sample. At all other samples, the leaf
            is `false`.
    """

    def __init__(self, times_ns: Integers, find_open: Callable[[Temporal, Integers], Booleans]) -> None:
        """Start without leaves.

        Args:
            find_open: returns whether an operator's window is open at each sample, (T,).
        """
        self.leaves: list[Atom] = []
        self.columns: list[Booleans] = []
        self._times_ns, self._find_open = times_ns, find_open
        # formulas are stored to stay alive, because a new formula could reuse the id of a freed formula
        self._stand_ins: dict[int, tuple[Formula, Formula]] = {}

    def of(self, formula: Formula) -> Formula:
        """Return the formula to compute instead of `formula`."""
        if id(formula) not in self._stand_ins:
            self._stand_ins[id(formula)] = formula, self._stand_in_of(formula)
        return self._stand_ins[id(formula)][1]

    def _stand_in_of(self, formula: Formula) -> Formula:
        expanded = formula if operator_of(formula) == "WX" else expand(formula)
        if expanded is not formula:
            return self.of(expanded)
        if not isinstance(formula, Boolean | Temporal):
            return formula
        node = replace(formula, operands=tuple([self.of(operand) for operand in formula.operands]))
        if not isinstance(node, Temporal):
            return node
        is_open = self._find_open(node, self._times_ns)
        if not is_open.any():
            return node
        # no specification can write this name, so the leaf equals no other leaf
        leaf = Atom("", "signal", Signal(f"\0{len(self.leaves)}"))
        self.leaves.append(leaf)
        self.columns.append(is_open)
        match node.operator:
            case "F":
                return Boolean("or", (node, leaf))
            case "G":
                return Boolean("and", (node, Boolean("not", (leaf,))))
            case "U":
                # a later sample may fulfil the `U`, up to the minimum of the left operand so far
                left_so_far = Temporal("G", node.operands[:1])
                return Boolean("or", (node, Boolean("and", (leaf, left_so_far))))
        return Boolean("and", (Boolean("or", (node, leaf)), Boolean("not", (leaf,))))


def is_cut(formula: Temporal, times_ns: Integers) -> Booleans:
    """Return for each sample whether the end of a log cuts an operator's window short, (T,).

    An operator without an upper bound ends with the log and is not cut. WX is not cut, because it is defined
    at the last sample. As an exception, a log of one sample cuts every G, because it shows no duration.
    """
    bound = formula.bound
    is_bounded = formula.operator == "X" or (bound is not None and bound.upper is not None)
    is_moment = formula.operator == "G" and len(times_ns) == 1
    return _is_open(formula, times_ns) & (is_bounded or is_moment)


def _is_open(formula: Temporal, times_ns: Integers) -> Booleans:
    """Return for each sample whether an operator's window at that sample may get later samples, (T,)."""
    bound = Bound(1, 1, "samples") if formula.operator in ("X", "WX") else formula.bound
    return ~is_closed(bound, times_ns) & (formula.operator in FUTURE_OPERATORS)


def is_closed(bound: Bound | None, times_ns: Integers) -> Booleans:
    """Return for each sample whether a future operator's window at that sample is complete, (T,)."""
    sample_count = len(times_ns)
    if bound is None or bound.upper is None:
        return np.zeros(sample_count, np.bool_)
    if bound.unit == "samples":
        # the bound is capped, because the sum could exceed 64 bits
        return np.arange(sample_count) + min(bound.upper, sample_count) < sample_count
    # Python integers: a time and a duration may add up to more than 64 bits
    last_closed_ns = int(times_ns[-1]) - bound.upper
    return np.arange(sample_count) < bisect_left(times_ns, last_closed_ns + 1)


def windows_of(
    formula: Temporal, times_ns: Integers, samples: Integers | None = None
) -> tuple[Integers, Integers]:
    """Return the first sample (T,) of an operator's window at each sample, and the last sample plus one (T,).

    Args:
        samples: indices of the samples whose windows are returned; None for all.
    """
    sample_count = len(times_ns)
    indices = np.arange(sample_count, dtype=np.int64)
    is_ahead = formula.operator in FUTURE_OPERATORS
    bound = Bound(1, 1, "samples") if formula.operator in ("X", "WX", "Y") else formula.bound
    if bound is None:
        positions = indices if samples is None else samples
        log_edges = np.full(len(positions), sample_count if is_ahead else 0, np.int64)
        return (positions, log_edges) if is_ahead else (log_edges, positions + 1)
    # sums fit 64 bits, because bounds are capped and times count from the first sample
    offsets = indices if bound.unit == "samples" else times_ns - times_ns[0]
    longest_distance = int(offsets[-1]) + 1
    near_distance = min(bound.lower, longest_distance)
    far_distance = longest_distance if bound.upper is None else min(bound.upper, longest_distance)
    origins = offsets if samples is None else offsets[samples]
    first_offsets, last_offsets = (
        (origins + near_distance, origins + far_distance)
        if is_ahead
        else (origins - far_distance, origins - near_distance)
    )
    if bound.unit == "samples":
        return np.clip(first_offsets, 0, sample_count), np.clip(last_offsets + 1, 0, sample_count)
    first_samples = np.searchsorted(offsets, first_offsets, side="left").astype(np.int64)
    return first_samples, np.searchsorted(offsets, last_offsets, side="right").astype(np.int64)


def full_signal(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers
) -> Floats:
    """Return each node's robustness (N, T) from each sample to the end of the log; NaN if undetermined."""
    # only the nominal ends are evaluated, because a curve of robustness ignores uncertainty
    return _determined_numbers(evaluate_offline(formula, order, leaves[:2], times_ns).columns)


def window_signal(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers, width_ns: int
) -> Floats:
    """Return the robustness (N, T) of each node over the window (t - width, t] of each sample t.

    Each window is evaluated at its first sample as a separate log, so past operators start there.
    Undetermined values are NaN. The computing time of a window is proportional to its number of samples.

    Raises:
        UsageError: the width is not a positive number of ns.
    """
    if isinstance(width_ns, bool) or not isinstance(width_ns, int) or not 0 < width_ns <= LATEST_NS:
        raise UsageError(f"a window of {width_ns!r} ns; give its width as an integer, 1 to 2**63 - 1 ns")
    compiled = OfflineFormula.of(formula, order)
    leaves = np.ascontiguousarray(leaves[:2])
    starts = np.searchsorted(times_ns, times_ns - width_ns, side="right").astype(np.int64)
    columns = np.empty((len(leaves), compiled.width, len(times_ns)))
    window_ends = np.empty((len(leaves), compiled.nodes, len(times_ns)))
    run_windows(
        compiled.table, leaves, writable(times_ns), starts, columns, np.empty(len(times_ns)), window_ends
    )
    return _determined_numbers(window_ends)


def new_leaves(formula: Formula, order: Sequence[Atom | Quantified]) -> list[Atom | Quantified]:
    """Return the leaves of a formula that are not in `order`."""
    table = OfflineTable(order)
    table.add(formula)
    return table.leaves[len(order) :]


def _determined_numbers(ends: Floats) -> Floats:
    """Return the robustness (N, T) from its ends (C, N, T), in place; NaN where the ends differ.

    Adding zero turns -0.0 into 0.0, so that equal numbers have equal bits.
    """
    determined: Floats = ends[0]
    determined += 0.0
    if len(ends) > 1:
        determined[determined != ends[1]] = np.nan
    return determined

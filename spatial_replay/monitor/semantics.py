"""The two semantics of a formula, chosen by name, and an online evaluation of Def. 16 of the paper.

`PaperRun` differs from `OnlineRun` in two ways. Minima and maxima leave out an operand that needs samples
beyond the ends of the run. A number that depends on an unknown value is undetermined.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, cast, get_args

import numpy as np

from spatial_replay.compiled import inlined, kernel, piece
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Empty, Flags, Floats, Integers
from spatial_replay.monitor.atoms.terms import TO_REPORTS, iter_delays
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.step import ROOM, TILE, OnlineRun
from spatial_replay.monitor.verdict import Semantics
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
    rate_conditions,
)
from spatial_replay.spec.walks import is_spatial, leaf_key, nodes_with_operands


class PaperMemory(NamedTuple):
    """State between samples.

    NaN marks a number that is left out. An undetermined number is marked in the parallel array `lost_…`.

    Attributes:
        stamps: (room,), times of the samples in ns; only the first time if there are no columns.
        columns: (K, room), stored numbers at each sample, on the samples so far.
        value: (N,), each node at the first sample.
        now: (N,), each node at the newest sample.
        left: (N,), running minimum of an until's left operand, for the until at the first sample.
        starts: (N,), first sample in the window of sample `opens`; -1 before it is known.
        opens: (N,), earliest sample whose window is still open.
        pairs: minimum of an until's left operand from each sample to each end, one row per end.
        pair_starts: (P, room), `pair_starts[p, t] + s` is the index in `pairs` for sample s and end t.
        pair_end: (1,), used length of `pairs`.
    """

    stamps: Integers
    columns: Floats
    lost_columns: Flags
    value: Floats
    lost_value: Flags
    now: Floats
    lost_now: Flags
    left: Floats
    lost_left: Flags
    starts: Integers
    opens: Integers
    pairs: Floats
    lost_pairs: Flags
    pair_starts: Integers
    pair_end: Integers


@piece
def _set_now(rows: Integers, operands: Integers, n: int, numbers: Floats, lost: Flags) -> None:
    """Compute a node on the newest sample alone, from its operands there."""
    code, first, end = rows[n, CODE], rows[n, FIRST], rows[n, END]
    # such a window needs later samples: on the newest sample alone, the node is left out
    if code == NEXT or (code > NEXT and rows[n, LOW] > 0):
        numbers[n], lost[n] = np.nan, 0
        return
    left = operands[first]
    if code in (EVENTUALLY, ALWAYS):
        numbers[n], lost[n] = numbers[left], lost[left]
        return
    if code > ALWAYS:
        right = operands[end - 1]
        numbers[n], lost[n] = least(numbers[left], numbers[right]), lost[left] | lost[right]
        return
    _fold(code, operands[first:end], numbers, lost, n)


@piece
def _fold(code: int, operands: Integers, numbers: Floats, lost: Flags, n: int) -> None:
    """Compute a Boolean node from its operands."""
    number, is_lost = numbers[operands[0]], lost[operands[0]]
    number = combine(code, number, number) if len(operands) == 1 else number
    for operand in operands[1:]:
        number = combine(code, number, numbers[operand])
        is_lost |= lost[operand]
    numbers[n], lost[n] = number, is_lost


@piece
def _set_column(rows: Integers, operands: Integers, n: int, last: int, memory: PaperMemory) -> None:
    """Compute a Boolean node at every sample, from its operands."""
    code, first, end = rows[n, CODE], rows[n, FIRST], rows[n, END]
    row = rows[n, COLUMN]
    target, target_lost = memory.columns[row], memory.lost_columns[row]
    source_row = rows[operands[first], COLUMN]
    source, source_lost = memory.columns[source_row], memory.lost_columns[source_row]
    for t in range(last + 1):
        target[t] = combine(code, source[t], source[t]) if end - first == 1 else source[t]
        target_lost[t] = source_lost[t]
    for place in range(first + 1, end):
        source_row = rows[operands[place], COLUMN]
        source, source_lost = memory.columns[source_row], memory.lost_columns[source_row]
        for t in range(last + 1):
            target[t] = combine(code, target[t], source[t])
            target_lost[t] |= source_lost[t]


@piece
def _window_at_first(rows: Integers, n: int, last: int, time_ns: int, memory: PaperMemory) -> bool:
    """Return whether the last sample is in the first sample's window; record the start of that window."""
    passed = time_ns - memory.stamps[0] if rows[n, IS_IN_NS] else last
    if memory.starts[n] < 0 and passed >= rows[n, LOW]:
        memory.starts[n] = last
    return bool(memory.starts[n] >= 0 and (rows[n, HIGH] < 0 or passed <= rows[n, HIGH]))


@piece
def _step_first(
    rows: Integers, operands: Integers, n: int, last: int, time_ns: int, memory: PaperMemory
) -> None:
    """Update a temporal node that is needed only at the first sample."""
    code, value, lost = rows[n, CODE], memory.value, memory.lost_value
    right = operands[rows[n, END] - 1]
    right_row = rows[right, COLUMN]
    is_plain = rows[right, IS_PLAIN] != 0
    if code == NEXT:
        if is_plain and last == 1:
            value[n], lost[n] = memory.now[right], memory.lost_now[right]
        if not is_plain and last >= 1:
            value[n], lost[n] = memory.columns[right_row, 1], memory.lost_columns[right_row, 1]
        return
    if not _window_at_first(rows, n, last, time_ns, memory):
        return
    start = memory.starts[n]
    if code in (EVENTUALLY, ALWAYS):
        # the number of a plain operand at a sample never changes: a running extremum suffices
        if is_plain:
            value[n] = pick(code == ALWAYS, value[n], memory.now[right])
            lost[n] |= memory.lost_now[right]
        else:
            numbers, marks = memory.columns[right_row], memory.lost_columns[right_row]
            value[n], lost[n] = total(code == ALWAYS, numbers, marks, start, last)
        return
    left = operands[rows[n, FIRST]]
    if rows[left, IS_PLAIN]:
        memory.left[n] = least(memory.left[n], memory.now[left])
        memory.lost_left[n] |= memory.lost_now[left]
    else:
        left_row = rows[left, COLUMN]
        numbers, marks = memory.columns[left_row], memory.lost_columns[left_row]
        memory.left[n], memory.lost_left[n] = total(True, numbers, marks, start, last)
    if is_plain:
        value[n] = most(value[n], least(memory.now[right], memory.left[n]))
        lost[n] |= memory.lost_now[right] | memory.lost_left[n]
        return
    inner = rows[n, INNER]
    memory.columns[inner, last], memory.lost_columns[inner, last] = memory.left[n], memory.lost_left[n]
    value[n], lost[n] = np.nan, 0
    for t in range(start, last + 1):
        value[n] = most(value[n], least(memory.columns[right_row, t], memory.columns[inner, t]))
        lost[n] |= memory.lost_columns[right_row, t] | memory.lost_columns[inner, t]


@piece
def _apart(rows: Integers, n: int, earlier: int, later: int, memory: PaperMemory) -> int:
    """Return the distance of two samples, in the unit of a node's window."""
    return memory.stamps[later] - memory.stamps[earlier] if rows[n, IS_IN_NS] else later - earlier


@piece
def _step_column(rows: Integers, operands: Integers, n: int, last: int, memory: PaperMemory) -> None:
    """Update a temporal node that is needed at every sample; only samples with open windows change."""
    code = rows[n, CODE]
    row, inner = rows[n, COLUMN], rows[n, INNER]
    target, target_lost = memory.columns[row], memory.lost_columns[row]
    right_row = rows[operands[rows[n, END] - 1], COLUMN]
    right, right_lost = memory.columns[right_row], memory.lost_columns[right_row]
    if code == NEXT:
        for t in range(last):
            target[t], target_lost[t] = right[t + 1], right_lost[t + 1]
        target[last], target_lost[last] = np.nan, 0
        return
    low, high = rows[n, LOW], rows[n, HIGH]
    while high >= 0 and _apart(rows, n, memory.opens[n], last, memory) > high:
        memory.opens[n] += 1
    start = max(memory.starts[n], memory.opens[n])
    while start <= last and _apart(rows, n, memory.opens[n], start, memory) < low:
        start += 1
    memory.starts[n] = start
    if start <= last:
        _scan_node(rows, operands, n, start, last, memory)
    if inner == row:
        return
    for t in range(memory.opens[n], last + 1):
        while start <= last and _apart(rows, n, t, start, memory) < low:
            start += 1
        if start <= last:
            target[t], target_lost[t] = memory.columns[inner, start], memory.lost_columns[inner, start]
        else:
            target[t], target_lost[t] = np.nan, 0


@piece
def _scan_node(
    rows: Integers, operands: Integers, n: int, start: int, last: int, memory: PaperMemory
) -> None:
    """Compute the unbounded operator from each sample to the last one, for the samples from `start` on."""
    code, inner = rows[n, CODE], rows[n, INNER]
    target, target_lost = memory.columns[inner], memory.lost_columns[inner]
    right_node, left_node = operands[rows[n, END] - 1], operands[rows[n, FIRST]]
    right_row, left_row = rows[right_node, COLUMN], rows[left_node, COLUMN]
    right, right_lost = memory.columns[right_row], memory.lost_columns[right_row]
    left, left_lost = memory.columns[left_row], memory.lost_columns[left_row]
    if code in (EVENTUALLY, ALWAYS):
        scan(code == ALWAYS, right, right_lost, start, last, target, target_lost)
    elif rows[left_node, IS_PLAIN]:
        scan_until(left, left_lost, right, right_lost, start, last, target, target_lost)
    elif rows[right_node, IS_PLAIN]:
        scan_until_by_last(left, left_lost, right[last], right_lost[last], start, last, target, target_lost)
    else:
        pair_starts, end = memory.pair_starts[rows[n, PAIRS]], memory.pair_end[0]
        pair_starts[last] = end - start
        memory.pair_end[0] = end + last + 1 - start
        row, lost_row = memory.pairs[end:], memory.lost_pairs[end:]
        scan(True, left[start:], left_lost[start:], 0, last - start, row, lost_row)
        scan_until_by_pairs(
            memory.pairs, memory.lost_pairs, pair_starts, right, right_lost, start, last, target, target_lost
        )


@kernel
def step_paper(
    rows: Integers, operands: Integers, leaves: Floats, lost_leaves: Flags, times_ns: Integers,
    t: int, count: int, position: int, memory: PaperMemory, series: Floats,
) -> None:  # fmt: skip
    """Add the samples from t to before t + count, after `position` earlier samples.

    Args:
        leaves: (A, T), NaN where a leaf is left out.
        lost_leaves: (A, T), 1 where a leaf is unknown.
        series: (N, 4, T), output: value, now, lower and upper of each node.
    """
    nodes = rows.shape[0]
    for k in range(t, t + count):
        last = position + k - t
        # without columns, only the first time is stored
        if last < memory.stamps.shape[0]:
            memory.stamps[last] = times_ns[k]
        # operands have greater ids than their parents
        for n in range(nodes - 1, -1, -1):
            code, is_plain = rows[n, CODE], rows[n, IS_PLAIN] != 0
            if code == LEAF_NODE:
                leaf = rows[n, LEAF]
                memory.now[n], memory.lost_now[n] = leaves[leaf, k], lost_leaves[leaf, k]
            elif code == TRUTH:
                memory.now[n] = np.inf * rows[n, LEAF]
            else:
                _set_now(rows, operands, n, memory.now, memory.lost_now)
            column = rows[n, COLUMN]
            if is_plain:
                if column >= 0:
                    memory.columns[column, last] = memory.now[n]
                    memory.lost_columns[column, last] = memory.lost_now[n]
                if last == 0:
                    memory.value[n], memory.lost_value[n] = memory.now[n], memory.lost_now[n]
            elif column >= 0:
                if code >= NEXT:
                    _step_column(rows, operands, n, last, memory)
                else:
                    _set_column(rows, operands, n, last, memory)
                memory.value[n] = memory.columns[column, 0]
                memory.lost_value[n] = memory.lost_columns[column, 0]
            elif code >= NEXT:
                _step_first(rows, operands, n, last, times_ns[k], memory)
            else:
                node_operands = operands[rows[n, FIRST] : rows[n, END]]
                _fold(code, node_operands, memory.value, memory.lost_value, n)
            # adding zero turns -0.0 into 0.0, so that equal numbers have equal bits
            series[n, 0, k] = np.nan if memory.lost_value[n] else memory.value[n] + 0.0
            series[n, 1, k] = np.nan if memory.lost_now[n] else memory.now[n] + 0.0
            # Def. 16 has no continuations, so both bounds are the value
            series[n, 2, k] = series[n, 3, k] = series[n, 0, k]


# columns of the table
CODE, FIRST, END, IS_IN_NS, LOW, HIGH, IS_PLAIN, COLUMN, INNER, PAIRS, LEAF = range(11)
WIDTH = 11
NOTHING = -1
"""Table entry for no upper bound, no column, and no row of pairs."""

# codes of nodes; Boolean nodes have the codes of reports. Each node has a row as written, without expansion,
# because Def. 16 gives a number to each
LEAF_NODE, TRUTH = 0, 1
NEXT, EVENTUALLY, ALWAYS, UNTIL = 9, 10, 11, 12

_TEMPORAL_CODES = {"X": NEXT, "F": EVENTUALLY, "G": ALWAYS, "U": UNTIL}
OPERATORS = frozenset(_TEMPORAL_CODES)
"""The temporal operators of the paper's semantics."""


@dataclass(frozen=True, eq=False)
class PaperTable:
    """A formula's nodes, by id.

    Attributes:
        rows: (N, WIDTH), the columns `CODE` to `LEAF`. `FIRST` and `END` index `operands`; `COLUMN`, `INNER`
            and `PAIRS` index arrays of `PaperMemory`. `LEAF` is a leaf's number, or a constant's sign.
        operands: ids of the operands, node after node.
        columns: number of stored columns.
        pairs: number of stored tables over pairs of samples.
    """

    rows: Integers
    operands: Integers
    columns: int
    pairs: int


def paper_table(formula: Formula, leaves: Sequence[Atom | Quantified]) -> PaperTable:
    """Compile a formula of `OPERATORS` over these leaves."""
    nodes = nodes_with_operands(formula)
    numbers: dict[object, int] = {leaf_key(leaf): number for number, leaf in enumerate(leaves)}
    is_plain = [is_spatial(node) for node, _ in nodes]
    has_column = _columns(nodes, is_plain)
    rows = np.zeros((len(nodes), WIDTH), np.int64)
    columns = pairs = begin = 0
    for identifier, (node, operand_ids) in enumerate(nodes):
        row = rows[identifier]
        row[[CODE, LEAF]] = _code(node, numbers)
        row[[FIRST, END]] = begin, begin + len(operand_ids)
        row[IS_PLAIN] = is_plain[identifier]
        row[[HIGH, COLUMN, INNER, PAIRS]] = NOTHING
        begin += len(operand_ids)
        if has_column[identifier]:
            row[COLUMN], columns = columns, columns + 1
        if isinstance(node, Temporal):
            if node.bound is not None:
                upper = NOTHING if node.bound.upper is None else node.bound.upper
                row[[IS_IN_NS, LOW, HIGH]] = node.bound.unit == "ns", node.bound.lower, upper
            is_until_nested = node.operator == "U" and not is_plain[operand_ids[-1]]
            # without a bound the numbers of the operator are those of its scan: one column serves both
            if has_column[identifier] and row[LOW] == 0 and row[HIGH] == NOTHING:
                row[INNER] = row[COLUMN]
            elif has_column[identifier] or is_until_nested:
                row[INNER], columns = columns, columns + 1
            if has_column[identifier] and is_until_nested and not is_plain[operand_ids[0]]:
                row[PAIRS], pairs = pairs, pairs + 1
    return PaperTable(
        rows,
        np.array([operand_id for _, operand_ids in nodes for operand_id in operand_ids], np.int64),
        columns,
        pairs,
    )


def _columns(nodes: Sequence[tuple[Formula, Sequence[int]]], is_plain: Sequence[bool]) -> list[bool]:
    """Return whether each node is needed at all samples; parents precede their operands."""
    needs_column = [False] * len(nodes)
    for identifier, (node, operands) in enumerate(nodes):
        for operand in operands:
            if isinstance(node, Temporal):
                needs_column[operand] = needs_column[identifier] or not is_plain[operand]
            else:
                needs_column[operand] = needs_column[identifier] and not is_plain[identifier]
    return needs_column


def _code(node: Formula, leaves: Mapping[object, int]) -> tuple[int, int]:
    """Return a node's code, and its leaf or the sign of its infinity."""
    match node:
        case Truth():
            return TRUTH, 1 if node.value else -1
        case Boolean():
            return codes.REPORT_OF_BOOLEAN[node.operator], 0
        case Temporal():
            return _TEMPORAL_CODES[node.operator], 0
        case _:
            return LEAF_NODE, leaves[leaf_key(node)]


@inlined
def least(first: float, second: float) -> float:
    """Return the lesser of two numbers; NaN stands for a left-out operand."""
    if np.isnan(first):
        return second
    if np.isnan(second):
        return first
    return min(first, second)


@inlined
def most(first: float, second: float) -> float:
    """Return the greater of two numbers; NaN stands for a left-out operand."""
    if np.isnan(first):
        return second
    if np.isnan(second):
        return first
    return max(first, second)


@inlined
def pick(is_least: bool, first: float, second: float) -> float:
    """Return `least` or `most` of two numbers."""
    return least(first, second) if is_least else most(first, second)


@inlined
def combine(code: int, first: float, second: float) -> float:
    """Apply a Boolean operator to two numbers; a unary operator gets its operand twice."""
    if code == codes.REPORT_AND:
        return least(first, second)
    if code == codes.REPORT_OR:
        return most(first, second)
    if code == codes.REPORT_NOT:
        return -first
    if code == codes.REPORT_IMPLIES:
        return most(-first, second)
    if code == codes.REPORT_XOR:
        return most(least(first, -second), least(-first, second))
    if code == codes.REPORT_IFF:
        return least(most(-first, second), most(-second, first))
    return first


@piece
def total(
    is_least: bool, numbers: Floats, lost: Flags, first: int, last: int
) -> tuple[float, int]:  # fmt: skip
    """Return the least or greatest number from sample `first` to `last`."""
    extremum, is_lost = np.nan, 0
    for t in range(first, last + 1):
        extremum = pick(is_least, extremum, numbers[t])
        is_lost |= lost[t]
    return extremum, is_lost


@piece
def scan(
    is_least: bool, numbers: Floats, lost: Flags, first: int, last: int, target: Floats, target_lost: Flags
) -> None:
    """Compute the least or greatest number from each sample to `last`, for the samples from `first` on."""
    extremum, is_lost = np.nan, 0
    for t in range(last, first - 1, -1):
        extremum = pick(is_least, extremum, numbers[t])
        is_lost |= lost[t]
        target[t], target_lost[t] = extremum, is_lost


@piece
def scan_until(
    left: Floats, left_lost: Flags, right: Floats, right_lost: Flags,
    first: int, last: int, target: Floats, target_lost: Flags,
) -> None:  # fmt: skip
    """Compute until from each sample to `last`, for a left operand that depends on no later sample.

    The scan goes backwards, and the left operand at each sample caps the best value over later ends. If all
    numbers of an end were left out so far, its value is the left operand, which no other end can exceed.
    """
    best, is_lost, is_any_left_out = np.nan, 0, False
    for t in range(last, first - 1, -1):
        end_value = least(right[t], left[t])
        if not np.isnan(left[t]):
            if is_any_left_out:
                best = left[t]
            elif not np.isnan(best):
                best = min(left[t], best)
            is_any_left_out = False
        if np.isnan(end_value):
            is_any_left_out = True
        best = most(best, end_value)
        is_lost |= left_lost[t] | right_lost[t]
        target[t], target_lost[t] = best, is_lost


@piece
def scan_until_by_last(
    left: Floats, left_lost: Flags, right: float, right_lost: int,
    first: int, last: int, target: Floats, target_lost: Flags,
) -> None:  # fmt: skip
    """Update until from each sample to `last`, given its values up to the sample before."""
    least_left, is_lost = np.nan, right_lost
    target[last], target_lost[last] = np.nan, 0
    for t in range(last, first - 1, -1):
        least_left = least(least_left, left[t])
        is_lost |= left_lost[t]
        target[t] = most(target[t], least(right, least_left))
        target_lost[t] |= is_lost


@piece
def scan_until_by_pairs(
    least_left: Floats, least_left_lost: Flags, starts: Integers, right: Floats, right_lost: Flags,
    first: int, last: int, target: Floats, target_lost: Flags,
) -> None:  # fmt: skip
    """Compute until from each sample to `last`, given the left operand's minimum for each start and end."""
    target[first : last + 1], target_lost[first : last + 1] = np.nan, 0
    for end in range(first, last + 1):
        for t in range(first, end + 1):
            place = starts[end] + t
            target[t] = most(target[t], least(right[end], least_left[place]))
            target_lost[t] |= right_lost[end] | least_left_lost[place]


_TILE = 256
"""Number of samples per call of the kernel."""
_FIRST_ROOM = 1024
"""Initial capacity of the columns, samples."""
MAX_PAIRS = 1 << 26
"""Limit on pairs of samples for which untils store a number: about 11,600 samples, 0.6 GB."""


class PaperRun:
    """The numbers of every node on every prefix by Def. 16.

    A temporal operator over formulas without temporal operators stores one number. Below another temporal
    operator it stores a number for every sample so far, and each new sample takes time proportional to them.
    """

    def __init__(
        self, formula: Formula, leaves: Sequence[Atom | Quantified], *, max_pairs: int = MAX_PAIRS
    ) -> None:
        """Start before the first sample.

        Args:
            leaves: atoms and open quantifiers of the formula, in the order in which `extend` receives them.
            max_pairs: limit on compared pairs of samples.
        """
        self._max_pairs = max_pairs
        self._table = paper_table(formula, leaves)
        # a kernel with memory between samples: NumPy took 0.35 to 0.64 ms for an update instead of 0.03
        self._memory = _first_memory(self._table)
        self._position = 0
        self._value = np.full(len(self._table.rows), np.nan)

    def __len__(self) -> int:
        """Return the number of added samples."""
        return self._position

    @property
    def final(self) -> Floats:
        """(N, 2): each node's value on the samples so far, in both columns; NaN if undetermined."""
        return np.repeat(self._value[:, None], 2, axis=1)

    def extend(self, leaves: Floats, times_ns: Integers, empty: Empty = np.empty) -> Floats:
        """Add samples.

        Args:
            leaves: (C, A, T), as for `OnlineRun.extend`, with NaN where a leaf is left out (see `left_out`).
            times_ns: (T,), increasing and after the previous samples.
            empty: allocator of the result.

        Returns:
            (N, 4, T): value, now, lower and upper of each node; lower and upper equal the value.

        Raises:
            UsageError: the pairs of samples exceed the limit.
        """
        # Def. 16 has no uncertainty: only nominal ends count, and a number is lost where they differ
        low, high = low_and_high(len(leaves), wide=False)
        numbers = np.ascontiguousarray(leaves[low])
        lost = ((numbers != leaves[high]) & ~np.isnan(numbers)).astype(np.int8)
        times_ns = np.array(times_ns, np.int64)  # writable, because kernels are compiled for writable arrays
        series = empty((len(self._table.rows), 4, len(times_ns)))
        samples, rows = self._position + len(times_ns), self._table.rows
        # unbounded windows only: pairs of bounded ones are counted when their samples come
        lows = rows[(rows[:, PAIRS] >= 0) & (rows[:, HIGH] < 0) & (rows[:, IS_IN_NS] == 0), LOW]
        # half of all pairs, because no end comes before its start
        self._check_pairs(int((np.maximum(samples - lows, 0) ** 2 // 2).sum()), samples)
        for t in range(0, len(times_ns), _TILE):
            count = min(_TILE, len(times_ns) - t)
            self._make_room(self._position + count)
            step_paper(
                self._table.rows, self._table.operands, numbers, lost, times_ns,
                t, count, self._position, self._memory, series,
            )  # fmt: skip
            self._position += count
        if len(times_ns):
            self._value = series[:, 0, -1].copy()
        return series

    def _make_room(self, samples: int) -> None:
        """Grow the memory to hold the given number of samples."""
        memory, pairs = self._memory, self._table.pairs
        if self._table.columns and samples > len(memory.stamps):
            # doubled, so that a long run copies each number a constant number of times
            more = max(samples, 2 * len(memory.stamps)) - len(memory.stamps)
            memory = memory._replace(
                stamps=_longer(memory.stamps, more),
                columns=_longer(memory.columns, more),
                lost_columns=_longer(memory.lost_columns, more),
                pair_starts=_longer(memory.pair_starts, more),
            )
        if pairs:
            used = int(memory.pair_end[0])
            required_length = used + pairs * samples * (samples - self._position)
            self._check_pairs(used, self._position)
            if required_length > len(memory.pairs):
                more = max(required_length, min(2 * used, self._max_pairs)) - len(memory.pairs)
                memory = memory._replace(
                    pairs=_longer(memory.pairs, more), lost_pairs=_longer(memory.lost_pairs, more)
                )
        self._memory = memory

    def _check_pairs(self, pairs: int, samples: int) -> None:
        if pairs > self._max_pairs:
            raise UsageError(
                f"over {samples:,} samples, an until of two temporal operands below a temporal operator "
                "compares too many pairs of samples; bound it, evaluate fewer samples, or use the semantics "
                "'ltlf'"
            )


def left_out(
    values: Floats,
    leaves: Sequence[Atom | Quantified],
    positions: Integers,
    times_ns: Integers,
    first_ns: int,
) -> Floats:
    """Return leaves with NaN where they are left out: they look back (`a[-3]`) beyond the log.

    A leaf with a rate is also NaN where the rate has no value, if an operator leaves such samples out.

    Args:
        values: (C, A, T), numbers of these leaves.
        positions: (T,), number of samples of the log before each.
        times_ns: (T,).
        first_ns: time of the log's first sample.
    """
    is_before = np.zeros(values.shape[1:], np.bool_)
    numbers = {leaf_key(leaf): number for number, leaf in enumerate(leaves)}
    for row, leaf in zip(is_before, leaves, strict=True):
        for delay in set(iter_delays([leaf])):
            # no report comes before those of the first sample
            row |= positions < (1 if delay == TO_REPORTS else delay.samples or 0)
            if delay.duration_ns is not None:
                row |= times_ns - delay.duration_ns < first_ns
        for condition in rate_conditions(leaf):
            if (number := numbers.get(leaf_key(condition))) is not None:
                row |= (values[:, number] == -np.inf).all(axis=0)
    return np.where(is_before, np.nan, values) if is_before.any() else values


def _first_memory(table: PaperTable) -> PaperMemory:
    nodes, room = len(table.rows), _FIRST_ROOM if table.columns else 1
    return PaperMemory(
        stamps=np.zeros(room, np.int64),
        columns=np.full((table.columns, room), np.nan),
        lost_columns=np.zeros((table.columns, room), np.int8),
        value=np.full(nodes, np.nan),
        lost_value=np.zeros(nodes, np.int8),
        now=np.full(nodes, np.nan),
        lost_now=np.zeros(nodes, np.int8),
        left=np.full(nodes, np.nan),
        lost_left=np.zeros(nodes, np.int8),
        starts=np.full(nodes, -1, np.int64),
        opens=np.zeros(nodes, np.int64),
        pairs=np.empty(0),
        lost_pairs=np.empty(0, np.int8),
        pair_starts=np.zeros((table.pairs, room), np.int64),
        pair_end=np.zeros(1, np.int64),
    )


def _longer(array: np.ndarray, more: int) -> np.ndarray:
    """Return the array with `more` zeros at the end of its last axis."""
    return np.concatenate([array, np.zeros((*array.shape[:-1], more), array.dtype)], axis=-1)


def check_operators(specification: Specification) -> None:
    """Check that the paper's semantics has all temporal operators of the result specs.

    Raises:
        UsageError: an operator is not the paper's; the message gives its place.
    """
    for spec in specification.results:
        for _, _, node in iter_nodes(spec.formula):
            if isinstance(node, Temporal) and node.operator not in OPERATORS:
                source = SourceText.of(specification.source, specification.filename)
                fault = source.diagnostic("error", node.span, f"the paper's semantics has no {node.operator}")
                remedy = "write it with X, F, G and U"
                raise UsageError(
                    f"{fault.filename}:{fault.line}:{fault.column}: {fault.message}, which {spec.name} uses; "
                    f"{remedy}, or evaluate with the semantics 'ltlf'"
                )


def checked_semantics(name: str, specifications: Iterable[Specification] = ()) -> Semantics:
    """Return the semantics of a name, which has to define all operators of the specifications.

    Raises:
        UsageError: an unknown name, or an operator that the semantics does not define.
    """
    if name not in get_args(Semantics):
        choices = " and ".join(repr(choice) for choice in get_args(Semantics))
        raise UsageError(f"no semantics {name!r}; there are {choices}")
    if name == "paper":
        for specification in specifications:
            check_operators(specification)
    return cast(Semantics, name)


class Run(Protocol):
    """The evaluation of one formula over a stream of samples."""

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the log ends here."""

    def extend(self, leaves: Floats, times_ns: Integers, empty: Empty = np.empty) -> Floats:
        """Add samples; return value, now, lower and upper of each node, (N, 4, T), allocated by `empty`."""

    def __len__(self) -> int:
        """Return the number of added samples."""


class Evaluator(NamedTuple):
    """A formula with its program, evaluated under some semantics.

    Attributes:
        program: program of the formula; both semantics evaluate its leaves.
    """

    formula: Formula
    program: Program
    semantics: Semantics

    @property
    def has_open_end(self) -> bool:
        """Whether numbers before the end of a log hold for all its continuations."""
        return self.semantics == "ltlf"

    def begin(self, *, is_live: bool = False, samples: int | None = None) -> Run:
        """Start a run before the first sample.

        Args:
            is_live: whether samples are added one by one.
            samples: number of samples in all, if known; a short run allocates less memory.
        """
        if self.semantics == "paper":
            return PaperRun(self.formula, self.program.leaves)
        if is_live:
            return OnlineRun(self.program, room=ROOM, tile=1)
        if samples is not None and samples < TILE:
            return OnlineRun(self.program, room=samples, tile=samples)
        return OnlineRun(self.program)

    def leaves_within_log(
        self, leaves: Floats, positions: Integers, times_ns: Integers, first_ns: int
    ) -> Floats:
        """Return leaves, marked as the semantics requires where they look back beyond the log.

        Args:
            leaves: (C, A, T).
            positions: (T,), number of samples of the log before each.
            times_ns: (T,).
            first_ns: time of the log's first sample.
        """
        if self.semantics == "paper":
            return left_out(leaves, self.program.leaves, positions, times_ns, first_ns)
        return leaves  # their intervals are unbounded there already

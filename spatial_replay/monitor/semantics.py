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
        columns: (K, room), numbers of the K stored nodes at each sample, on the samples so far.
        value: (N,), value of each node at the first sample.
        now: (N,), value of each node at the newest sample.
        left: (N,), running minimum of an until's left operand, for the until at the first sample.
        starts: (N,), first sample in the window of sample `opens`; -1 until this window begins.
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
def _set_now(rows: Integers, operands: Integers, node: int, numbers: Floats, lost_flags: Flags) -> None:
    """Compute a node on the newest sample alone, from its operands there."""
    code, operand_start, operand_end = rows[node, CODE], rows[node, FIRST], rows[node, END]
    # the window needs later samples, so the node is left out on the newest sample alone
    if code == NEXT or (code > NEXT and rows[node, LOW] > 0):
        numbers[node], lost_flags[node] = np.nan, 0
        return
    left_node = operands[operand_start]
    if code in (EVENTUALLY, ALWAYS):
        numbers[node], lost_flags[node] = numbers[left_node], lost_flags[left_node]
        return
    if code > ALWAYS:
        right_node = operands[operand_end - 1]
        numbers[node], lost_flags[node] = (
            least(numbers[left_node], numbers[right_node]),
            lost_flags[left_node] | lost_flags[right_node],
        )
        return
    _fold(code, operands[operand_start:operand_end], numbers, lost_flags, node)


@piece
def _fold(code: int, operands: Integers, numbers: Floats, lost_flags: Flags, node: int) -> None:
    """Compute a Boolean node from its operands."""
    number, is_lost = numbers[operands[0]], lost_flags[operands[0]]
    number = combine(code, number, number) if len(operands) == 1 else number
    for operand in operands[1:]:
        number = combine(code, number, numbers[operand])
        is_lost |= lost_flags[operand]
    numbers[node], lost_flags[node] = number, is_lost


@piece
def _set_column(rows: Integers, operands: Integers, node: int, last_sample: int, memory: PaperMemory) -> None:
    """Compute a Boolean node at every sample, from its operands."""
    code, operand_start, operand_end = rows[node, CODE], rows[node, FIRST], rows[node, END]
    target_row = rows[node, COLUMN]
    target, target_lost = memory.columns[target_row], memory.lost_columns[target_row]
    source_row = rows[operands[operand_start], COLUMN]
    source, source_lost = memory.columns[source_row], memory.lost_columns[source_row]
    for sample in range(last_sample + 1):
        target[sample] = (
            combine(code, source[sample], source[sample])
            if operand_end - operand_start == 1
            else source[sample]
        )
        target_lost[sample] = source_lost[sample]
    for operand_index in range(operand_start + 1, operand_end):
        source_row = rows[operands[operand_index], COLUMN]
        source, source_lost = memory.columns[source_row], memory.lost_columns[source_row]
        for sample in range(last_sample + 1):
            target[sample] = combine(code, target[sample], source[sample])
            target_lost[sample] |= source_lost[sample]


@piece
def _window_at_first(rows: Integers, node: int, last_sample: int, time_ns: int, memory: PaperMemory) -> bool:
    """Return whether the last sample is in the first sample's window; record the start of that window."""
    elapsed = time_ns - memory.stamps[0] if rows[node, IS_IN_NS] else last_sample
    if memory.starts[node] < 0 and elapsed >= rows[node, LOW]:
        memory.starts[node] = last_sample
    return bool(memory.starts[node] >= 0 and (rows[node, HIGH] < 0 or elapsed <= rows[node, HIGH]))


@piece
def _step_first(
    rows: Integers, operands: Integers, node: int, last_sample: int, time_ns: int, memory: PaperMemory
) -> None:
    """Update a temporal node that is needed only at the first sample."""
    code, value, lost_value = rows[node, CODE], memory.value, memory.lost_value
    right_node = operands[rows[node, END] - 1]
    right_row = rows[right_node, COLUMN]
    is_plain = rows[right_node, IS_PLAIN] != 0
    if code == NEXT:
        if is_plain and last_sample == 1:
            value[node], lost_value[node] = memory.now[right_node], memory.lost_now[right_node]
        if not is_plain and last_sample >= 1:
            value[node], lost_value[node] = memory.columns[right_row, 1], memory.lost_columns[right_row, 1]
        return
    if not _window_at_first(rows, node, last_sample, time_ns, memory):
        return
    start = memory.starts[node]
    if code in (EVENTUALLY, ALWAYS):
        # a plain operand's number at a sample never changes, so a running extremum suffices
        if is_plain:
            value[node] = pick(code == ALWAYS, value[node], memory.now[right_node])
            lost_value[node] |= memory.lost_now[right_node]
        else:
            operand_numbers, operand_lost = memory.columns[right_row], memory.lost_columns[right_row]
            value[node], lost_value[node] = total(
                code == ALWAYS, operand_numbers, operand_lost, start, last_sample
            )
        return
    left_node = operands[rows[node, FIRST]]
    if rows[left_node, IS_PLAIN]:
        memory.left[node] = least(memory.left[node], memory.now[left_node])
        memory.lost_left[node] |= memory.lost_now[left_node]
    else:
        left_row = rows[left_node, COLUMN]
        operand_numbers, operand_lost = memory.columns[left_row], memory.lost_columns[left_row]
        memory.left[node], memory.lost_left[node] = total(
            True, operand_numbers, operand_lost, start, last_sample
        )
    if is_plain:
        value[node] = most(value[node], least(memory.now[right_node], memory.left[node]))
        lost_value[node] |= memory.lost_now[right_node] | memory.lost_left[node]
        return
    inner_column = rows[node, INNER]
    memory.columns[inner_column, last_sample], memory.lost_columns[inner_column, last_sample] = (
        memory.left[node],
        memory.lost_left[node],
    )
    value[node], lost_value[node] = np.nan, 0
    for sample in range(start, last_sample + 1):
        value[node] = most(
            value[node], least(memory.columns[right_row, sample], memory.columns[inner_column, sample])
        )
        lost_value[node] |= memory.lost_columns[right_row, sample] | memory.lost_columns[inner_column, sample]


@piece
def _apart(rows: Integers, node: int, earlier: int, later: int, memory: PaperMemory) -> int:
    """Return the distance of two samples, in the unit of a node's window."""
    return memory.stamps[later] - memory.stamps[earlier] if rows[node, IS_IN_NS] else later - earlier


@piece
def _step_column(
    rows: Integers, operands: Integers, node: int, last_sample: int, memory: PaperMemory
) -> None:
    """Update a temporal node that is needed at every sample; only samples with open windows change."""
    code = rows[node, CODE]
    target_column, inner_column = rows[node, COLUMN], rows[node, INNER]
    target, target_lost = memory.columns[target_column], memory.lost_columns[target_column]
    right_row = rows[operands[rows[node, END] - 1], COLUMN]
    right_numbers, right_lost = memory.columns[right_row], memory.lost_columns[right_row]
    if code == NEXT:
        for sample in range(last_sample):
            target[sample], target_lost[sample] = right_numbers[sample + 1], right_lost[sample + 1]
        target[last_sample], target_lost[last_sample] = np.nan, 0
        return
    window_low, window_high = rows[node, LOW], rows[node, HIGH]
    while window_high >= 0 and _apart(rows, node, memory.opens[node], last_sample, memory) > window_high:
        memory.opens[node] += 1
    start = max(memory.starts[node], memory.opens[node])
    while start <= last_sample and _apart(rows, node, memory.opens[node], start, memory) < window_low:
        start += 1
    memory.starts[node] = start
    if start <= last_sample:
        _scan_node(rows, operands, node, start, last_sample, memory)
    if inner_column == target_column:
        return
    for sample in range(memory.opens[node], last_sample + 1):
        while start <= last_sample and _apart(rows, node, sample, start, memory) < window_low:
            start += 1
        if start <= last_sample:
            target[sample], target_lost[sample] = (
                memory.columns[inner_column, start],
                memory.lost_columns[inner_column, start],
            )
        else:
            target[sample], target_lost[sample] = np.nan, 0


@piece
def _scan_node(
    rows: Integers, operands: Integers, node: int, start: int, last_sample: int, memory: PaperMemory
) -> None:
    """Compute the unbounded operator from each sample to the last sample, for the samples from `start` on."""
    code, inner_column = rows[node, CODE], rows[node, INNER]
    target, target_lost = memory.columns[inner_column], memory.lost_columns[inner_column]
    right_node, left_node = operands[rows[node, END] - 1], operands[rows[node, FIRST]]
    right_row, left_row = rows[right_node, COLUMN], rows[left_node, COLUMN]
    right_numbers, right_lost = memory.columns[right_row], memory.lost_columns[right_row]
    left_numbers, left_lost = memory.columns[left_row], memory.lost_columns[left_row]
    if code in (EVENTUALLY, ALWAYS):
        scan(code == ALWAYS, right_numbers, right_lost, start, last_sample, target, target_lost)
    elif rows[left_node, IS_PLAIN]:
        scan_until(
            left_numbers, left_lost, right_numbers, right_lost, start, last_sample, target, target_lost
        )
    elif rows[right_node, IS_PLAIN]:
        scan_until_by_last(
            left_numbers,
            left_lost,
            right_numbers[last_sample],
            right_lost[last_sample],
            start,
            last_sample,
            target,
            target_lost,
        )
    else:
        pair_starts, pair_end = memory.pair_starts[rows[node, PAIRS]], memory.pair_end[0]
        pair_starts[last_sample] = pair_end - start
        memory.pair_end[0] = pair_end + last_sample + 1 - start
        pair_row, lost_pair_row = memory.pairs[pair_end:], memory.lost_pairs[pair_end:]
        scan(True, left_numbers[start:], left_lost[start:], 0, last_sample - start, pair_row, lost_pair_row)
        scan_until_by_pairs(
            memory.pairs,
            memory.lost_pairs,
            pair_starts,
            right_numbers,
            right_lost,
            start,
            last_sample,
            target,
            target_lost,
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
    node_count = rows.shape[0]
    for sample in range(t, t + count):
        last_sample = position + sample - t
        # without columns, only the first time is stored
        if last_sample < memory.stamps.shape[0]:
            memory.stamps[last_sample] = times_ns[sample]
        # operands have greater ids than their parents
        for node in range(node_count - 1, -1, -1):
            code, is_plain = rows[node, CODE], rows[node, IS_PLAIN] != 0
            if code == LEAF_NODE:
                leaf = rows[node, LEAF]
                memory.now[node], memory.lost_now[node] = leaves[leaf, sample], lost_leaves[leaf, sample]
            elif code == TRUTH:
                memory.now[node] = np.inf * rows[node, LEAF]
            else:
                _set_now(rows, operands, node, memory.now, memory.lost_now)
            column = rows[node, COLUMN]
            if is_plain:
                if column >= 0:
                    memory.columns[column, last_sample] = memory.now[node]
                    memory.lost_columns[column, last_sample] = memory.lost_now[node]
                if last_sample == 0:
                    memory.value[node], memory.lost_value[node] = memory.now[node], memory.lost_now[node]
            elif column >= 0:
                if code >= NEXT:
                    _step_column(rows, operands, node, last_sample, memory)
                else:
                    _set_column(rows, operands, node, last_sample, memory)
                memory.value[node] = memory.columns[column, 0]
                memory.lost_value[node] = memory.lost_columns[column, 0]
            elif code >= NEXT:
                _step_first(rows, operands, node, last_sample, times_ns[sample], memory)
            else:
                node_operands = operands[rows[node, FIRST] : rows[node, END]]
                _fold(code, node_operands, memory.value, memory.lost_value, node)
            # adding zero turns -0.0 into 0.0, so that equal numbers have equal bits
            series[node, 0, sample] = np.nan if memory.lost_value[node] else memory.value[node] + 0.0
            series[node, 1, sample] = np.nan if memory.lost_now[node] else memory.now[node] + 0.0
            # Def. 16 has no continuations, so both bounds are the value
            series[node, 2, sample] = series[node, 3, sample] = series[node, 0, sample]


# columns of the table
CODE, FIRST, END, IS_IN_NS, LOW, HIGH, IS_PLAIN, COLUMN, INNER, PAIRS, LEAF = range(11)
WIDTH = 11
NOTHING = -1
"""Table entry for no upper bound, no column, and no row of pairs."""

# codes of nodes. Boolean nodes have the codes of reports. Nodes are not expanded, because Def. 16 gives a
# number to each node as written
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
    """Compile a formula of `OPERATORS` over the given leaves."""
    nodes = nodes_with_operands(formula)
    number_of_leaf: dict[object, int] = {leaf_key(leaf): number for number, leaf in enumerate(leaves)}
    is_plain = [is_spatial(node) for node, _ in nodes]
    has_column = _columns(nodes, is_plain)
    rows = np.zeros((len(nodes), WIDTH), np.int64)
    column_count = pair_table_count = operand_start = 0
    for identifier, (node, operand_ids) in enumerate(nodes):
        row = rows[identifier]
        row[[CODE, LEAF]] = _code(node, number_of_leaf)
        row[[FIRST, END]] = operand_start, operand_start + len(operand_ids)
        row[IS_PLAIN] = is_plain[identifier]
        row[[HIGH, COLUMN, INNER, PAIRS]] = NOTHING
        operand_start += len(operand_ids)
        if has_column[identifier]:
            row[COLUMN], column_count = column_count, column_count + 1
        if isinstance(node, Temporal):
            if node.bound is not None:
                upper = NOTHING if node.bound.upper is None else node.bound.upper
                row[[IS_IN_NS, LOW, HIGH]] = node.bound.unit == "ns", node.bound.lower, upper
            is_until_nested = node.operator == "U" and not is_plain[operand_ids[-1]]
            # without a bound, the operator's numbers equal its scan's numbers, so one column serves both
            if has_column[identifier] and row[LOW] == 0 and row[HIGH] == NOTHING:
                row[INNER] = row[COLUMN]
            elif has_column[identifier] or is_until_nested:
                row[INNER], column_count = column_count, column_count + 1
            if has_column[identifier] and is_until_nested and not is_plain[operand_ids[0]]:
                row[PAIRS], pair_table_count = pair_table_count, pair_table_count + 1
    return PaperTable(
        rows,
        np.array([operand_id for _, operand_ids in nodes for operand_id in operand_ids], np.int64),
        column_count,
        pair_table_count,
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
    """Return a node's code, and the number of its leaf or the sign of its constant."""
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
    for sample in range(first, last + 1):
        extremum = pick(is_least, extremum, numbers[sample])
        is_lost |= lost[sample]
    return extremum, is_lost


@piece
def scan(
    is_least: bool, numbers: Floats, lost: Flags, first: int, last: int, target: Floats, target_lost: Flags
) -> None:
    """Compute the least or greatest number from each sample to `last`, for the samples from `first` on."""
    extremum, is_lost = np.nan, 0
    for sample in range(last, first - 1, -1):
        extremum = pick(is_least, extremum, numbers[sample])
        is_lost |= lost[sample]
        target[sample], target_lost[sample] = extremum, is_lost


@piece
def scan_until(
    left: Floats, left_lost: Flags, right: Floats, right_lost: Flags,
    first: int, last: int, target: Floats, target_lost: Flags,
) -> None:  # fmt: skip
    """Compute until from each sample to `last`, for a left operand that depends on no later sample.

    The scan runs backwards, and the left operand at each sample caps the best value over later ends. An end
    whose numbers were all left out so far gets the next left operand that is not left out. No other end can
    exceed this value.
    """
    best_value, is_lost, is_any_left_out = np.nan, 0, False
    for sample in range(last, first - 1, -1):
        end_value = least(right[sample], left[sample])
        if not np.isnan(left[sample]):
            if is_any_left_out:
                best_value = left[sample]
            elif not np.isnan(best_value):
                best_value = min(left[sample], best_value)
            is_any_left_out = False
        if np.isnan(end_value):
            is_any_left_out = True
        best_value = most(best_value, end_value)
        is_lost |= left_lost[sample] | right_lost[sample]
        target[sample], target_lost[sample] = best_value, is_lost


@piece
def scan_until_by_last(
    left: Floats, left_lost: Flags, right: float, right_lost: int,
    first: int, last: int, target: Floats, target_lost: Flags,
) -> None:  # fmt: skip
    """Update until from each sample to `last`, given its values up to the previous sample."""
    least_left, is_lost = np.nan, right_lost
    target[last], target_lost[last] = np.nan, 0
    for sample in range(last, first - 1, -1):
        least_left = least(least_left, left[sample])
        is_lost |= left_lost[sample]
        target[sample] = most(target[sample], least(right, least_left))
        target_lost[sample] |= is_lost


@piece
def scan_until_by_pairs(
    least_left: Floats, least_left_lost: Flags, starts: Integers, right: Floats, right_lost: Flags,
    first: int, last: int, target: Floats, target_lost: Flags,
) -> None:  # fmt: skip
    """Compute until from each sample to `last`, given the left operand's minimum for each start and end."""
    target[first : last + 1], target_lost[first : last + 1] = np.nan, 0
    for end in range(first, last + 1):
        for sample in range(first, end + 1):
            pair_index = starts[end] + sample
            target[sample] = most(target[sample], least(right[end], least_left[pair_index]))
            target_lost[sample] |= right_lost[end] | least_left_lost[pair_index]


_TILE = 256
"""Number of samples per call of the kernel."""
_FIRST_ROOM = 1024
"""Initial capacity of the columns, as a number of samples."""
MAX_PAIRS = 1 << 26
"""Limit on pairs of samples for which untils store a number: about 11,600 samples, 0.6 GB."""


class PaperRun:
    """The numbers of every node on every prefix by Def. 16.

    A temporal operator over formulas without temporal operators stores one number. Below another temporal
    operator, it stores a number for every sample so far, and the time of an update grows with the number of
    samples.
    """

    def __init__(
        self, formula: Formula, leaves: Sequence[Atom | Quantified], *, max_pairs: int = MAX_PAIRS
    ) -> None:
        """Start before the first sample.

        Args:
            leaves: atoms and open quantifiers of the formula, in the order in which `extend` receives them.
            max_pairs: limit on pairs of samples for which untils store a number.
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
        # Def. 16 has no uncertainty: only nominal ends are used, and a number is lost where they differ
        low_channel, high_channel = low_and_high(len(leaves), wide=False)
        numbers = np.ascontiguousarray(leaves[low_channel])
        lost_flags = ((numbers != leaves[high_channel]) & ~np.isnan(numbers)).astype(np.int8)
        times_ns = np.array(times_ns, np.int64)  # kernels are compiled for writable arrays
        series = empty((len(self._table.rows), 4, len(times_ns)))
        sample_count, rows = self._position + len(times_ns), self._table.rows
        # only unbounded windows are checked, because pairs of bounded windows are counted with their samples
        window_lows = rows[(rows[:, PAIRS] >= 0) & (rows[:, HIGH] < 0) & (rows[:, IS_IN_NS] == 0), LOW]
        # half of all pairs count, because no end comes before its start
        self._check_pairs(int((np.maximum(sample_count - window_lows, 0) ** 2 // 2).sum()), sample_count)
        for tile_start in range(0, len(times_ns), _TILE):
            tile_length = min(_TILE, len(times_ns) - tile_start)
            self._make_room(self._position + tile_length)
            step_paper(
                self._table.rows, self._table.operands, numbers, lost_flags, times_ns,
                tile_start, tile_length, self._position, self._memory, series,
            )  # fmt: skip
            self._position += tile_length
        if len(times_ns):
            self._value = series[:, 0, -1].copy()
        return series

    def _make_room(self, sample_count: int) -> None:
        memory, pair_table_count = self._memory, self._table.pairs
        if self._table.columns and sample_count > len(memory.stamps):
            # the capacity is doubled, so that a long run copies each number a constant number of times
            added_length = max(sample_count, 2 * len(memory.stamps)) - len(memory.stamps)
            memory = memory._replace(
                stamps=_longer(memory.stamps, added_length),
                columns=_longer(memory.columns, added_length),
                lost_columns=_longer(memory.lost_columns, added_length),
                pair_starts=_longer(memory.pair_starts, added_length),
            )
        if pair_table_count:
            used_length = int(memory.pair_end[0])
            required_length = used_length + pair_table_count * sample_count * (sample_count - self._position)
            self._check_pairs(used_length, self._position)
            if required_length > len(memory.pairs):
                added_length = max(required_length, min(2 * used_length, self._max_pairs)) - len(memory.pairs)
                memory = memory._replace(
                    pairs=_longer(memory.pairs, added_length),
                    lost_pairs=_longer(memory.lost_pairs, added_length),
                )
        self._memory = memory

    def _check_pairs(self, pair_count: int, sample_count: int) -> None:
        if pair_count > self._max_pairs:
            raise UsageError(
                f"over {sample_count:,} samples, an until of two temporal operands below a temporal operator "
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
    """Return leaves with NaN where they are left out, because they look back (`a[-3]`) beyond the log.

    A leaf with a rate is also NaN where the rate has no value, if an operator omits samples without a value.

    Args:
        values: (C, A, T), numbers of the leaves.
        positions: (T,), number of samples of the log before each sample.
        times_ns: (T,).
        first_ns: time of the log's first sample.
    """
    is_before = np.zeros(values.shape[1:], np.bool_)
    number_of_leaf = {leaf_key(leaf): number for number, leaf in enumerate(leaves)}
    for is_leaf_before, leaf in zip(is_before, leaves, strict=True):
        for delay in set(iter_delays([leaf])):
            # no report precedes the reports of the first sample
            is_leaf_before |= positions < (1 if delay == TO_REPORTS else delay.samples or 0)
            if delay.duration_ns is not None:
                is_leaf_before |= times_ns - delay.duration_ns < first_ns
        for condition in rate_conditions(leaf):
            if (number := number_of_leaf.get(leaf_key(condition))) is not None:
                is_leaf_before |= (values[:, number] == -np.inf).all(axis=0)
    return np.where(is_before, np.nan, values) if is_before.any() else values


def _first_memory(table: PaperTable) -> PaperMemory:
    node_count, room = len(table.rows), _FIRST_ROOM if table.columns else 1
    return PaperMemory(
        stamps=np.zeros(room, np.int64),
        columns=np.full((table.columns, room), np.nan),
        lost_columns=np.zeros((table.columns, room), np.int8),
        value=np.full(node_count, np.nan),
        lost_value=np.zeros(node_count, np.int8),
        now=np.full(node_count, np.nan),
        lost_now=np.zeros(node_count, np.int8),
        left=np.full(node_count, np.nan),
        lost_left=np.zeros(node_count, np.int8),
        starts=np.full(node_count, -1, np.int64),
        opens=np.zeros(node_count, np.int64),
        pairs=np.empty(0),
        lost_pairs=np.empty(0, np.int8),
        pair_starts=np.zeros((table.pairs, room), np.int64),
        pair_end=np.zeros(1, np.int64),
    )


def _longer(array: np.ndarray, added_length: int) -> np.ndarray:
    """Return the array with `added_length` zeros at the end of its last axis."""
    return np.concatenate([array, np.zeros((*array.shape[:-1], added_length), array.dtype)], axis=-1)


def check_operators(specification: Specification) -> None:
    """Check that the paper's semantics has all temporal operators of the result specs.

    Raises:
        UsageError: the paper's semantics lacks an operator. The message gives the operator's place.
    """
    for spec in specification.results:
        for _, _, node in iter_nodes(spec.formula):
            if isinstance(node, Temporal) and node.operator not in OPERATORS:
                source = SourceText.of(specification.source, specification.filename)
                diagnostic = source.diagnostic(
                    "error", node.span, f"the paper's semantics has no {node.operator}"
                )
                remedy = "write it with X, F, G and U"
                raise UsageError(
                    f"{diagnostic.filename}:{diagnostic.line}:{diagnostic.column}: {diagnostic.message},"
                    f" which {spec.name} uses; {remedy}, or evaluate with the semantics 'ltlf'"
                )


def checked_semantics(name: str, specifications: Iterable[Specification] = ()) -> Semantics:
    """Return a semantics by name, after a check that it defines all operators of the specifications.

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
            samples: number of all samples, if known. A short run allocates less memory.
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
        """Return leaves with the values that the semantics requires where they look back beyond the log.

        Args:
            leaves: (C, A, T).
            positions: (T,), number of samples of the log before each sample.
            times_ns: (T,).
            first_ns: time of the log's first sample.
        """
        if self.semantics == "paper":
            return left_out(leaves, self.program.leaves, positions, times_ns, first_ns)
        return leaves  # intervals of leaves are already unbounded beyond the log

"""Compile formulas for the step kernels: flat tables of what to do with each sample.

A formula becomes three tables, each with operands first:

- *signals*: every subformula without a future operator. Its robustness at a sample is final with that
  sample, so it is computed forwards, with a little state for past operators.
- *parts*: one for each node that is a temporal operator and looks ahead, in negation normal form over
  signals, so that its robustness is monotone in all its operands.
- *reports*: the tree as the user wrote it; Boolean nodes combine the numbers of their operands.

`OnlineRun` runs samples through them.

Some bounds of a part follow from the rows of its root alone. A root that joins by the minimum, such as `G`,
cannot exceed the least of its closed positions, and later samples may always be worse. For the maximum, as in
`F`, it is the reverse.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.operators import (
    NOTHING,
    PartRows,
    Row,
    SignalTable,
    array_of_rows,
    operand_rows,
    part_of,
)
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Formula,
    Quantified,
    Temporal,
)
from spatial_replay.spec.walks import looks_ahead, nodes_with_operands

NEVER = codes.SAMPLES, NOTHING
"""The end of a root that has none."""


class _Direction(NamedTuple):
    """Operands of a root that joins by the minimum; for the maximum it is the reverse.

    Attributes:
        either, both: the nodes that are as great as the greater, and as the smaller one of their operands.
        until: those that are great once their operand is.
        release: those that are great as long as it is.
        worst, best: the bounds of the smallest, and of the greatest continuation.
    """

    either: int
    both: int
    until: int
    release: int
    worst: int
    best: int


_BY_MINIMUM = _Direction(
    codes.PART_OR, codes.PART_AND, codes.UNTIL, codes.RELEASE, codes.OPEN_LOW, codes.OPEN_HIGH
)
_BY_MAXIMUM = _Direction(
    codes.PART_AND, codes.PART_OR, codes.RELEASE, codes.UNTIL, codes.OPEN_HIGH, codes.OPEN_LOW
)
_DIRECTIONS: Mapping[int, _Direction] = MappingProxyType(
    {codes.RELEASE: _BY_MINIMUM, codes.UNTIL: _BY_MAXIMUM}
)


def _direction_of(rows: tuple[Row, ...]) -> _Direction | None:
    """Return what a part's root is in, if it is a variable: one that never ends, or not before its window."""
    if not rows or rows[-1][codes.NODE_VARIABLE] == NOTHING:
        return None
    return _DIRECTIONS.get(rows[-1][codes.NODE_CODE])


def root_end(rows: tuple[Row, ...], signals: SignalTable) -> tuple[int, int]:
    """Return how far from the first sample on a root joins what its operand is, and in which unit."""
    left = rows[-1][codes.NODE_A]
    if left == NOTHING:
        return NEVER
    code, signal, *_ = rows[left]
    return (signals.elapsed_at(signal) or NEVER) if code == codes.LITERAL else NEVER


def known_bounds(rows: tuple[Row, ...], *, is_bounded: bool) -> int:
    """Return which bounds follow from a part's table, whatever is open, a bit for each.

    Later samples may always violate `G x`, so its lower bound is -inf. Its upper one is as
    great as can be wherever x is: where it is `F y`, which what comes may always satisfy, or `F y or z`, say.
    The table then says what follows from what has closed, if the same holds for all of its variables.

    Once a root with a window is over, what comes does not violate it any more, but may still satisfy what
    never ends below it.

    Args:
        is_bounded: whether the root has a window, within which it joins all that its operand is.
    """
    way = _direction_of(rows)
    if way is None:
        return 0
    # whether a node is as great as can be in the best continuation
    outdone: list[bool] = []
    for code, a, b, *_ in rows:
        if code == way.either:
            outdone.append(outdone[a] or outdone[b])
        elif code == way.both:
            outdone.append(outdone[a] and outdone[b])
        elif code == way.until:
            outdone.append(a == NOTHING or outdone[a] or outdone[b])
        else:
            outdone.append(code == way.release and outdone[b])
    variables = [node for node, row in enumerate(rows) if row[codes.NODE_VARIABLE] != NOTHING]
    known = 1 << way.worst if is_bounded or rows[-1][codes.NODE_A] == NOTHING else 0
    if all(outdone[node] for node in variables):
        known |= (1 | codes.EVEN_IF_OVER) << way.best
    return known


def directions(rows: tuple[Row, ...]) -> list[tuple[bool, bool]]:
    """Return for each node whether what it is never falls, and whether it never rises, as samples come.

    That is as if the run ended with the newest sample: an operator that looks ahead finds nothing after it.
    """
    found = list[tuple[bool, bool]]()
    for code, a, b, weak, *_ in rows:
        below = [found[each] for each in operand_rows(code, a, b)]
        rises, falls = all(up for up, _ in below), all(down for _, down in below)
        if code in (codes.UNTIL, codes.RELEASE, codes.SHIFT):
            rises, falls = rises and not weak, falls and bool(weak)
        found.append((rises and code != codes.PART_WINDOW_MIN, falls and code != codes.PART_WINDOW_MAX))
    return found


def is_monotone(rows: tuple[Row, ...]) -> bool:
    """Return whether what a root joins by the minimum never falls, or the other way round."""
    way = _direction_of(rows)
    if way is None or rows[-1][codes.NODE_A] != NOTHING or any(row[codes.NODE_DEPENDS] for row in rows[:-1]):
        return False
    return directions(rows)[rows[-1][codes.NODE_B]][0 if way is _BY_MINIMUM else 1]


@dataclass(frozen=True, eq=False)
class Program:
    """A formula as tables (see `codes` for what the columns mean).

    Attributes:
        leaves: atoms and open quantifiers, whose values in each sample are given to the kernel.
        signals: (S, SIGNAL_WIDTH).
        parts: (P, NODE_WIDTH).
        part_rows: for each part (D + 1, NODE_WIDTH), its nodes and itself.
        reports: (N, REPORT_WIDTH), in the order of node ids.
        rows: (…, NODE_WIDTH), all tables in one: a row with their offsets, signals, parts, reports, the ids
            of the nodes below each node of the tree, and the parts' nodes.
        windows: how many rings of positions the signals keep.
        table_size: how many numbers the tables of parts without windows hold for one channel.
        keeps_history: whether any window, delay or part looks at more than the newest sample.
    """

    leaves: tuple[Atom | Quantified, ...]
    signals: Integers
    parts: Integers
    part_rows: tuple[Integers, ...]
    reports: Integers
    rows: Integers
    windows: int
    table_size: int
    keeps_history: bool


def compile_formula(formula: Formula) -> Program:
    """Compile a formula to tables.

    Raises:
        UsageError: more than `MAX_VARIABLES` unbounded future operators under one node.
    """
    signals, parts = SignalTable(), _Parts()
    reports: list[Row] = []
    operand_ids: list[int] = []
    for node, operands in nodes_with_operands(formula):
        ends = (len(operand_ids), len(operand_ids) + len(operands))
        operand_ids.extend(operands)
        if not looks_ahead(node):
            reports.append((codes.REPORT_SIGNAL, signals.add(node), 0, *ends))
        elif isinstance(node, Boolean):
            reports.append((codes.REPORT_OF_BOOLEAN[node.operator], 0, 0, *ends))
        elif isinstance(node, Temporal):
            reports.append((codes.REPORT_PART, parts.add(node, signals), _now_rule(node), *ends))
    signal_rows, report_rows = signals.array(parts.literals), array_of_rows(reports, codes.REPORT_WIDTH)
    return Program(
        leaves=tuple(signals.leaves),
        signals=signal_rows,
        parts=array_of_rows([rows[-1] for rows in parts.rows], codes.NODE_WIDTH),
        part_rows=tuple(array_of_rows(rows, codes.NODE_WIDTH) for rows in parts.rows),
        reports=report_rows,
        rows=_joined_rows(signal_rows, parts.rows, report_rows, operand_ids),
        windows=signals.windows,
        table_size=parts.table_size,
        keeps_history=signals.keeps_history or parts.keeps_history,
    )


def _joined_rows(
    signals: Integers, parts: Sequence[Sequence[Row]], reports: Integers, operands: Sequence[int]
) -> Integers:
    """Return the rows of a program (see `Program`)."""
    width = codes.NODE_WIDTH
    parts_at = 1 + len(signals)
    reports_at = parts_at + len(parts)
    operands_at = reports_at + len(reports)
    first = operands_at + -(-len(operands) // width)
    rows = np.zeros((first + sum(len(own) - 1 for own in parts), width), np.int64)
    rows[0, :7] = 1, len(signals), parts_at, len(parts), reports_at, len(reports), operands_at
    rows[1:parts_at, : codes.SIGNAL_WIDTH] = signals
    rows[reports_at:operands_at, : codes.REPORT_WIDTH] = reports
    rows[operands_at:first].reshape(-1)[: len(operands)] = operands
    for number, own in enumerate(parts):
        rows[first : first + len(own) - 1] = array_of_rows(own[:-1], width)
        rows[parts_at + number] = own[-1]
        rows[parts_at + number, [codes.PART_FIRST, codes.PART_END]] = first, first + len(own) - 1
        first += len(own) - 1
    return rows


class _Parts:
    """The parts of a formula, one after the other; equal ones share a place.

    Attributes:
        literals: the signals that parts with windows look at.
        rows: of each part, those of its nodes and its own.
    """

    def __init__(self) -> None:
        self.table_size = 0
        self.keeps_history = False
        self.literals = set[int]()
        self.rows: list[tuple[Row, ...]] = []
        self._built: dict[tuple[tuple[Row, ...], bool], int] = {}

    def add(self, node: Temporal, signals: SignalTable) -> int:
        """Add the part of a node that looks ahead, and return its number."""
        part = part_of(signals, node)
        nodes = tuple(_looked_up(row, signals) for row in part.rows())
        has_now = node.operator not in FUTURE_OPERATORS
        key = nodes, has_now
        if key not in self._built:
            self._built[key] = len(self.rows)
            self.rows.append((*_with_times(nodes), self._own_row(nodes, part, signals, has_now=has_now)))
        return self._built[key]

    def _own_row(self, nodes: tuple[Row, ...], part: PartRows, signals: SignalTable, *, has_now: bool) -> Row:
        end = NEVER if part.is_flat else root_end(nodes, signals)
        row = (
            0,
            len(nodes),
            codes.TABLE if part.is_flat else codes.WINDOWED,
            part.variables,
            part.tables,
            part.end_corner,
            self.table_size,
            known_bounds(nodes, is_bounded=end != NEVER),
            *end,
            int(has_now),
            int(is_monotone(nodes)),
        )
        if part.is_flat:
            self.table_size += 1 << part.variables
        else:
            self.keeps_history = True
            self.literals |= {row[codes.NODE_A] for row in nodes if row[codes.NODE_CODE] == codes.LITERAL}
        return row


def _with_times(nodes: tuple[Row, ...]) -> Iterator[Row]:
    """Yield rows with the numbers of their windows in seconds."""
    timed = 0
    for row in nodes:
        code, unit = row[codes.NODE_CODE], row[codes.NODE_UNIT]
        is_timed = unit != codes.SAMPLES and code in (*codes.AHEAD_OF, *codes.PAST_WINDOWS, codes.PAST_DELAY)
        yield (*row, timed if is_timed else NOTHING)
        timed += is_timed


def _looked_up(row: Row, signals: SignalTable) -> Row:
    """Return a row whose numbers, if it is a literal, are those of a signal."""
    code, signal, is_negated, *rest = row
    if code != codes.LITERAL or not is_negated:
        return row
    return (code, signals.row(codes.NOT, signal), 0, *rest)


def _now_rule(node: Temporal) -> int:
    """Return where an operator's number on the newest sample alone (`now`) comes from.

    That of a future operator follows from its operands' own, that of a past one is kept in its part.
    """
    if node.operator not in FUTURE_OPERATORS:
        return codes.NOW_OF_PART
    weak = node.operator in ("G", "R", "W", "WX")
    if node.operator in ("X", "WX") or (node.bound is not None and node.bound.lower > 0):
        return codes.NOW_TRUE if weak else codes.NOW_FALSE
    return codes.NOW_EITHER if node.operator == "W" else codes.NOW_LAST_OPERAND

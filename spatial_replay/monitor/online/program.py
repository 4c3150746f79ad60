"""Compile formulas for the step kernels: flat tables of what to do with each sample.

A formula becomes three tables, each with operands first:

- *signals*: every subformula without a future operator. Its robustness at a sample is final with that
  sample, so it is computed forwards, with a little state for past operators.
- *parts*: one for each node that is a temporal operator and looks ahead, in negation normal form over
  signals, so that its robustness is monotone in all its operands.
- *reports*: the tree as the user wrote it; Boolean nodes combine the numbers of their operands.

`OnlineRun` runs samples through them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.operators import (
    NOTHING,
    Row,
    SignalTable,
    array_of_rows,
    operand_rows,
    part_of,
)
from spatial_replay.monitor.online.rewriting import after_lasting, at_last, looks_ahead
from spatial_replay.monitor.online.root_bounds import (
    NEVER,
    cutting_windows,
    is_monotone,
    known_bounds,
    limit_of,
    root_end,
)
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Formula,
    Quantified,
    Temporal,
    iter_nodes,
)


@dataclass(frozen=True, eq=False)
class Program:
    """A formula as tables (see `codes` for what the columns mean).

    Attributes:
        leaves: atoms and open quantifiers, whose values in each sample are given to the kernel.
        signals: (S, SIGNAL_WIDTH).
        nodes: (D, NODE_WIDTH), the nodes of all parts, part after part.
        parts: (P, PART_WIDTH).
        reports: (N, REPORT_WIDTH), in the order of node ids.
        operands: ids of the nodes below each node of the tree, node after node.
        windows: how many rings of positions the signals keep.
        table_size: how many numbers the parts' tables hold for one channel.
        cells: how many rows of bookkeeping the parts need.
        timed: how many windows in seconds parts run over what is open.
        keeps_history: whether any window, delay or part looks at more than the newest sample.
    """

    leaves: tuple[Atom | Quantified, ...]
    signals: Integers
    nodes: Integers
    parts: Integers
    reports: Integers
    operands: Integers
    windows: int
    table_size: int
    cells: int
    timed: int
    keeps_history: bool


def compile_formula(formula: Formula) -> Program:
    """Compile a formula to tables.

    Raises:
        UsageError: more than `MAX_VARIABLES` unbounded future operators under one node.
    """
    signals, parts = SignalTable(), _Parts()
    reports: list[Row] = []
    operand_ids: list[int] = []
    # the parts of past operators, and whether these are their operand at the first sample; the other parts
    asked, others = dict[int, bool](), set[int]()
    for node, operands in _nodes_with_operands(formula):
        ends = (len(operand_ids), len(operand_ids) + len(operands))
        operand_ids.extend(operands)
        if not looks_ahead(node):
            reports.append((codes.REPORT_SIGNAL, signals.add(node), 0, *ends))
        elif isinstance(node, Boolean):
            reports.append((codes.REPORT_OF_BOOLEAN[node.operator], 0, 0, *ends))
        elif isinstance(node, Temporal) and (awaited := after_lasting(node)) is not None:
            number = parts.add_node(awaited, signals)
            others.add(number)
            reports.append((codes.REPORT_LASTING, number, _now_rule(node), *ends))
        elif isinstance(node, Temporal):
            last = None if node.operator in FUTURE_OPERATORS else at_last(node)
            if isinstance(last, Temporal) and looks_ahead(last):
                number = parts.add_node(last, signals)
                others.add(number)
                reports.append((codes.REPORT_PAST, number, codes.NOW_OF_VALUE, *ends))
            elif last is not None:
                reports.append((codes.REPORT_PAST, signals.add(last), codes.NOW_OF_SIGNAL, *ends))
            else:
                number = parts.add_node(node, signals)
                reports.append((codes.REPORT_PART, number, _now_rule(node), *ends))
                if node.operator in FUTURE_OPERATORS:
                    others.add(number)
                else:
                    is_operand = node.operator != "Y" and (node.bound is None or node.bound.lower == 0)
                    asked[number] = is_operand and asked.get(number, True)
    part_rows = parts.finished(
        {number: is_operand and number not in others for number, is_operand in asked.items()}
    )
    reports = [
        (codes.REPORT_PAST, *rest) if _is_said_at_last_only(code, rest, part_rows) else (code, *rest)
        for code, *rest in reports
    ]
    return Program(
        leaves=tuple(signals.leaves),
        signals=signals.array(parts.literals),
        nodes=array_of_rows(parts.node_rows, codes.NODE_WIDTH),
        parts=array_of_rows(part_rows, codes.PART_WIDTH),
        reports=array_of_rows(reports, codes.REPORT_WIDTH),
        operands=np.array(operand_ids, np.int64),
        windows=signals.windows,
        table_size=parts.table_size,
        cells=parts.cells,
        timed=parts.timed,
        keeps_history=signals.keeps_history or parts.keeps_history,
    )


def _is_said_at_last_only(code: int, rest: Sequence[int], part_rows: Sequence[Row]) -> bool:
    """Return whether a report is of a part that a run says nothing of but what it is at the last sample."""
    number, rule, *_ = rest
    is_last = code == codes.REPORT_PART and rule == codes.NOW_OF_PART
    return is_last and part_rows[number][codes.PART_NUMBERS] == codes.LAST_NUMBERS


class _Parts:
    """The parts of a formula, one after the other; equal ones share a place.

    Attributes:
        literals: the signals that parts with windows look at.
        node_rows: the rows of all nodes, part after part.
    """

    def __init__(self) -> None:
        self.table_size = 0
        self.cells = 0
        self.timed = 0
        self.keeps_history = False
        self.literals = set[int]()
        self.node_rows: list[Row] = []
        self._built: dict[tuple[tuple[Row, ...], bool], int] = {}
        self._part_rows: list[Row] = []
        self._rows: list[tuple[Row, ...]] = []
        self._limits: list[int] = []
        self._root_ends: list[tuple[int, int]] = []

    def add_node(self, node: Temporal, signals: SignalTable) -> int:
        """Add the part of a node that looks ahead, and return its number."""
        part = part_of(signals, node)
        # with windows, what is negated is a signal of its own
        rows = part.rows() if part.is_flat else tuple(_looked_up(row, signals) for row in part.rows())
        key = rows, part.is_flat
        if key in self._built:
            return self._built[key]
        self._built[key] = len(self._part_rows)
        first, cutting = len(self.node_rows), cutting_windows(rows)
        self._part_rows.append(
            (
                first,
                first + len(rows),
                part.variables,
                part.tables,
                self.table_size,
                self.cells,
                codes.TABLE if part.is_flat else codes.WINDOWED,
                0,
                part.end_corner,
                int(part.is_nested),
                int(cutting is not None),
            )
        )
        self._rows.append(rows)
        limit = NOTHING if part.is_flat or part.is_nested else limit_of(rows, signals)
        self._limits.append(limit)
        self._root_ends.append(NEVER if part.is_flat else root_end(rows, signals))
        self.literals |= {limit} - {NOTHING}
        for number, row in enumerate(rows):
            is_timed = row[codes.NODE_CODE] in codes.AHEAD_OF and row[codes.NODE_UNIT] != codes.SAMPLES
            cuts = cutting is not None and number in cutting
            self.node_rows.append((*row, self.timed if is_timed else NOTHING, int(cuts)))
            if row[codes.NODE_CODE] == codes.LITERAL and not part.is_flat:
                self.literals.add(row[codes.NODE_A])
            self.timed += is_timed
        self.table_size += part.tables << part.variables
        self.cells += 1 + part.variables + part.tables
        self.keeps_history |= not part.is_flat
        return self._built[key]

    def finished(self, asked: Mapping[int, bool]) -> list[Row]:
        """Return the rows of all parts.

        Args:
            asked: the parts of which it is asked what they are at the last sample, and whether that is all
                there is to ask, if another part says so.
        """
        last_in = self._nodes_at_last(asked)
        hosts = {number for number, _ in last_in.values()}
        beside = {number for number, (host, _) in last_in.items() if asked[number] and host != number}
        return [
            (
                *row[: codes.PART_IS_REMEMBERING],
                int(number in hosts),
                *row[codes.PART_IS_REMEMBERING + 1 :],
                *last_in.get(number, (NOTHING, NOTHING)),
                known_bounds(self._rows[number], is_bounded=self._root_ends[number] != NEVER),
                self._limits[number],
                int(not row[codes.PART_IS_NESTED] and is_monotone(self._rows[number])),
                *self._root_ends[number],
                codes.LAST_NUMBERS if number in beside else codes.ALL_NUMBERS,
            )
            for number, row in enumerate(self._part_rows)
        ]

    def _nodes_at_last(self, asked: Collection[int]) -> dict[int, tuple[int, int]]:
        """Return for parts that are asked for at the last sample the part, and the node of it, that say so.

        Below an operator that never ends, a past one is run at every position anyway.
        """
        found, known = dict[int, tuple[int, int]](), dict[int, tuple[int, int]]()
        trees_known = dict[Row, int]()
        for number, (part, rows) in enumerate(zip(self._part_rows, self._rows, strict=True)):
            if part[codes.PART_KIND] != codes.WINDOWED:
                continue
            trees = _trees(rows, trees_known)
            if number in asked:
                found[number] = known.get(trees[-1], (number, len(rows) - 1))
            code, high = rows[-1][codes.NODE_CODE], rows[-1][codes.NODE_HIGH]
            never_ends = code in (codes.UNTIL, codes.RELEASE) and high <= 0
            if never_ends or found.get(number, (NOTHING,))[0] == number:
                known = {tree: (number, node) for node, tree in enumerate(trees)} | known
        return found


def _trees(rows: tuple[Row, ...], known: dict[Row, int]) -> list[int]:
    """Return for each row of a part a number that it has in common with all that say the same.

    Args:
        known: these numbers, extended.
    """
    trees: list[int] = []
    for row in rows:
        code, a, b = row[: codes.NODE_B + 1]
        below = (a, b) if code == codes.LITERAL else tuple(trees[each] for each in operand_rows(code, a, b))
        # without the numbers of its variable and its table, which are its part's own
        tree = (code, *row[codes.NODE_WEAK : codes.NODE_VARIABLE], *below)
        trees.append(known.setdefault(tree, len(known)))
    return trees


def _looked_up(row: Row, signals: SignalTable) -> Row:
    """Return a row whose numbers, if it is a literal, are those of a signal."""
    code, signal, is_negated, *rest = row
    if code != codes.LITERAL or not is_negated:
        return row
    return (code, signals.row(codes.NOT, signal), 0, *rest)


def _nodes_with_operands(formula: Formula) -> list[tuple[Formula, list[int]]]:
    """Return every node of a tree, by id, with the ids of its operands."""
    nodes: list[tuple[Formula, list[int]]] = []
    for identifier, parent, node in iter_nodes(formula):
        nodes.append((node, []))
        if parent is not None:
            nodes[parent][1].append(identifier)
    return nodes


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

"""Compile formulas for the step kernels: flat tables of what to do with each sample.

A formula becomes three tables, each with operands first:

- *signals*: every subformula without a future operator. Its robustness at a sample is final with that
  sample, so it is computed forwards, with a little state for past operators.
- *parts*: one for each node that is a temporal operator and looks ahead, in negation normal form over
  signals, so that its robustness is monotone in all its operands; or as clauses, which are signals.
- *reports*: the tree as the user wrote it; Boolean nodes combine the numbers of their operands.

`OnlineRun` runs samples through them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.clauses import Clauses, clauses_of
from spatial_replay.monitor.online.operators import (
    NOTHING,
    PartRows,
    Row,
    SignalTable,
    array_of_rows,
    operand_rows,
    part_of,
)
from spatial_replay.monitor.online.rewriting import at_last, looks_ahead
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
        windows: how many signals keep a ring of positions.
        table_size: how many numbers the parts' tables hold for one channel.
        cells: how many rows of bookkeeping the parts need.
        timed: how many windows in seconds parts run over what is open.
        rows: how many nodes of a part need rows at once, at most.
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
    rows: int
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
    node_rows, part_rows, most_rows = parts.finished(
        {number: is_operand and number not in others for number, is_operand in asked.items()}
    )
    reports = [
        (codes.REPORT_PAST, *rest) if _is_said_at_last_only(code, rest, part_rows) else (code, *rest)
        for code, *rest in reports
    ]
    return Program(
        leaves=tuple(signals.leaves),
        signals=signals.array(parts.literals),
        nodes=array_of_rows(node_rows, codes.NODE_WIDTH),
        parts=array_of_rows(part_rows, codes.PART_WIDTH),
        reports=array_of_rows(reports, codes.REPORT_WIDTH),
        operands=np.array(operand_ids, np.int64),
        windows=signals.windows,
        table_size=parts.table_size,
        cells=parts.cells,
        timed=parts.timed,
        rows=most_rows,
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
    """

    def __init__(self) -> None:
        self.table_size = 0
        self.cells = 0
        self.timed = 0
        self.keeps_history = False
        self.literals = set[int]()
        self._built: dict[tuple[tuple[Row, ...], bool] | Row, int] = {}
        self._part_rows: list[Row] = []
        self._node_rows: list[Row] = []
        self._rows: list[tuple[Row, ...]] = []
        self._limits: list[int] = []
        self._root_ends: list[tuple[int, int]] = []

    def add_node(self, node: Temporal, signals: SignalTable) -> int:
        """Add the part of a node that looks ahead, and return its number."""
        part = part_of(signals, node)
        clauses = clauses_of(signals, part)
        return self.add(part, signals) if clauses is None else self.add_clauses(clauses, signals)

    def add_clauses(self, clauses: Clauses, signals: SignalTable) -> int:
        """Add a part that is made of signals, after the part beside it, and return its number."""
        beside = NOTHING if clauses.beside is None else self.add(clauses.beside, signals)
        own = (clauses.ending, clauses.lower, clauses.upper, int(clauses.is_minimum), beside)
        if own not in self._built:
            self._built[own] = len(self._part_rows)
            end = len(self._node_rows)
            self._part_rows.append(
                (end, end, 0, 0, self.table_size, self.cells, codes.CLAUSES, 0, 0, 0, *own, 0)
            )
            self._rows.append(())
            self._limits.append(NOTHING)
            self._root_ends.append(_NEVER)
        return self._built[own]

    def add(self, part: PartRows, signals: SignalTable) -> int:
        """Add a part and return its number.

        Args:
            signals: receives those that a part with windows looks at negated.
        """
        rows = part.rows() if part.is_flat else tuple(_looked_up(row, signals) for row in part.rows())
        key = rows, part.is_flat
        if key in self._built:
            return self._built[key]
        self._built[key] = len(self._part_rows)
        first, cutting = len(self._node_rows), _cutting(rows)
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
                *[NOTHING] * 5,
                int(cutting is not None),
            )
        )
        self._rows.append(rows)
        limit = NOTHING if part.is_flat or part.is_nested else _limit(rows, signals)
        self._limits.append(limit)
        self._root_ends.append(_NEVER if part.is_flat else _root_end(rows, signals))
        self.literals |= {limit} - {NOTHING}
        for number, row in enumerate(rows):
            is_timed = row[codes.NODE_CODE] in codes.AHEAD_OF and row[codes.NODE_UNIT] != codes.SAMPLES
            cuts = cutting is not None and number in cutting
            self._node_rows.append((*row, self.timed if is_timed else NOTHING, int(cuts)))
            if row[codes.NODE_CODE] == codes.LITERAL and not part.is_flat:
                self.literals.add(row[codes.NODE_A])
            self.timed += is_timed
        self.table_size += part.tables << part.variables
        self.cells += 1 + part.variables + part.tables
        self.keeps_history |= not part.is_flat
        return self._built[key]

    def finished(self, asked: Mapping[int, bool]) -> tuple[list[Row], list[Row], int]:
        """Return the rows of all nodes, those of all parts, and how many nodes of a part need rows at once.

        Args:
            asked: the parts of which it is asked what they are at the last sample, and whether that is all
                there is to ask, if another part says so.
        """
        last_in = self._nodes_at_last(asked)
        hosts = {number for number, _ in last_in.values()}
        beside = {number for number, (host, _) in last_in.items() if asked[number] and host != number}
        parts = [
            (
                *row[: codes.PART_IS_REMEMBERING],
                int(number in hosts),
                *row[codes.PART_IS_REMEMBERING + 1 :],
                *last_in.get(number, (NOTHING, NOTHING)),
                _known_bounds(self._rows[number], is_bounded=self._root_ends[number] != _NEVER),
                self._limits[number],
                codes.BY_NOTHING if row[codes.PART_IS_NESTED] else _outdone_by(self._rows[number]),
                *self._root_ends[number],
                codes.LAST_NUMBERS if number in beside else codes.ALL_NUMBERS,
            )
            for number, row in enumerate(self._part_rows)
        ]
        places: list[int] = []
        for number, rows in enumerate(self._rows):
            places += _places_of_rows(rows, {node for host, node in last_in.values() if host == number})
        nodes = [(*row, place) for row, place in zip(self._node_rows, places, strict=True)]
        return nodes, parts, 1 + max(places, default=NOTHING)

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


_NEVER = codes.SAMPLES, NOTHING
"""The end of a root that has none."""


class _Direction(NamedTuple):
    """What a root that joins by the minimum meets below it; by the maximum, all of it the other way round.

    Attributes:
        either, both: the nodes that are as great as the greater, and as the smaller one of their operands.
        signal_either, signal_both: the same for signals.
        window, past_window, until: those that are great once their operand is.
        release: those that are great as long as it is.
        worst, best: the bounds of the smallest, and of the greatest continuation.
        weak: what `NODE_WEAK` is where what is still to come counts as small.
    """

    either: int
    both: int
    signal_either: int
    signal_both: int
    window: int
    past_window: int
    until: int
    release: int
    worst: int
    best: int
    weak: int


_BY_MINIMUM = _Direction(
    codes.PART_OR, codes.PART_AND, codes.OR, codes.AND, codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX,
    codes.UNTIL, codes.RELEASE, codes.LOWER, codes.UPPER, 0,
)  # fmt: skip
_BY_MAXIMUM = _Direction(
    codes.PART_AND, codes.PART_OR, codes.AND, codes.OR, codes.PART_WINDOW_MIN, codes.PAST_WINDOW_MIN,
    codes.RELEASE, codes.UNTIL, codes.UPPER, codes.LOWER, 1,
)  # fmt: skip


def _direction_of(rows: tuple[Row, ...]) -> _Direction | None:
    """Return what a part's root is in, if it is a variable: one that never ends, or not before its window."""
    if not rows or rows[-1][codes.NODE_VARIABLE] == NOTHING:
        return None
    return {codes.RELEASE: _BY_MINIMUM, codes.UNTIL: _BY_MAXIMUM}.get(rows[-1][codes.NODE_CODE])


def _never_ends(rows: tuple[Row, ...]) -> bool:
    """Return whether a root joins all that its operand is from some position on."""
    return rows[-1][codes.NODE_A] == NOTHING and rows[-1][codes.NODE_HIGH] <= 0


def _root_end(rows: tuple[Row, ...], signals: SignalTable) -> tuple[int, int]:
    """Return how far from the first sample on a root joins what its operand is, and in which unit."""
    _, left, _, _, unit, _, high, *_ = rows[-1]
    if left == NOTHING:
        return (unit, high) if high > 0 else _NEVER
    code, signal, *_ = rows[left]
    return (signals.elapsed_at(signal) or _NEVER) if code == codes.LITERAL else _NEVER


def _known_bounds(rows: tuple[Row, ...], *, is_bounded: bool) -> int:
    """Return which bounds follow from a part's table, whatever is open, a bit for each.

    What comes may always violate `G x`, so that its lower bound is as small as can be. Its upper one is as
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


def _limit(rows: tuple[Row, ...], signals: SignalTable) -> int:
    """Return the signal that what a root joins never passes, whatever comes; -1 for none.

    `F[0,9] x` is at least what x is there, `x or y` at least what x is, though y looks ahead, and so on. What
    `G` joins matters no more once it is known to be at least what `G` cannot exceed any more.

    Args:
        signals: extended.
    """
    way = _direction_of(rows)
    if way is None or not _never_ends(rows):
        return NOTHING
    limits: list[int] = []
    for code, a, b, _, _, low, *_ in rows[: rows[-1][codes.NODE_B] + 1]:
        limit = NOTHING
        if code == codes.LITERAL:
            limit = a
        elif code in (way.window, way.past_window) and low == 0:
            limit = limits[a]
        elif code == way.until:
            limit = limits[b]
        elif code in (way.either, way.both) and NOTHING not in (limits[a], limits[b]):
            join = way.signal_either if code == way.either else way.signal_both
            limit = signals.row(join, limits[a], limits[b])
        elif code == way.either:
            # one is known, or none
            limit = limits[b] if limits[a] == NOTHING else limits[a]
        limits.append(limit)
    return limits[-1]


def _outdone_by(rows: tuple[Row, ...]) -> int:
    """Return what says that what a root joins by the minimum falls no more, or the other way round.

    What `F` finds remains, and what is still to come can only add to it, so that its value says so. Of `G`
    only what has closed does: where it is open, the worst may still come.
    """
    way = _direction_of(rows)
    if way is None or not _never_ends(rows):
        return codes.BY_NOTHING
    free = (codes.LITERAL, codes.PART_AND, codes.PART_OR, codes.PAST_DELAY, *codes.PAST_WINDOWS)
    ahead = (way.window, way.until, codes.SHIFT)
    found = codes.BY_VALUE
    for row in rows[:-1]:
        code, low = row[codes.NODE_CODE], row[codes.NODE_LOW]
        if code in free or (code in ahead and row[codes.NODE_WEAK] == way.weak):
            continue
        # one that has not begun would be as good as can be
        if code not in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN) or low > 0:
            return codes.BY_NOTHING
        found = codes.BY_WORST
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


def _places_of_rows(rows: tuple[Row, ...], kept: set[int]) -> list[int]:
    """Return where the rows of each node are, in as few places as will do; -1 for literals.

    A node takes the place of an operand that nothing else looks at again, unless it would replace what it is
    still going to look at itself: windows that begin elsewhere than with their position do.

    Args:
        kept: nodes that are looked at after all others.
    """
    looked_at = {each: number for number, row in enumerate(rows) for each in operand_rows(*row[:3])}
    looked_at |= dict.fromkeys(kept, len(rows))
    places, free = list[int](), list[int]()
    for number, (code, *operands) in enumerate(rows):
        if code == codes.LITERAL:
            places.append(NOTHING)
            continue
        below = operand_rows(code, *operands[:2])
        ended = [places[each] for each in dict.fromkeys(below) if looked_at[each] == number]
        ended = [place for place in ended if place != NOTHING]
        is_window = code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN)
        if not ended or code in codes.PAST_WINDOWS or (is_window and operands[codes.NODE_LOW - 1] > 0):
            ended = [free.pop() if free else 1 + max((*places, *free), default=NOTHING), *ended]
        places.append(ended[0])
        free += ended[1:]
    return places


def _cutting(rows: tuple[Row, ...]) -> set[int] | None:
    """Return the windows that are the greatest while they are open, of a root that joins by the minimum.

    Where one is open, what it stands in is no bound; anywhere else, the best that may come is what counts for
    the value, too. The same upside down. None where other nodes make a difference between the two.
    """
    code, left, body, *_ = rows[-1]
    if code not in (codes.UNTIL, codes.RELEASE) or left != NOTHING:
        return None
    is_weak = code == codes.RELEASE
    window = codes.PART_WINDOW_MAX if is_weak else codes.PART_WINDOW_MIN
    either, both = (codes.PART_OR, codes.PART_AND) if is_weak else (codes.PART_AND, codes.PART_OR)
    differs: list[bool] = []
    for own, a, b, weak, *_ in rows[: body + 1]:
        operands = {codes.LITERAL: (), either: (a, b), both: (a, b)}.get(own, (a,))
        is_free = own in (codes.LITERAL, either, both, *codes.AHEAD_OF)
        is_open = own == window or (own == codes.SHIFT and bool(weak) != is_weak)
        differs.append(not is_free or is_open or any(differs[each] for each in operands))
    found, waiting = set[int](), [body]
    while waiting:
        row = waiting.pop()
        own, a, b, *_ = rows[row]
        if own == either:
            waiting += (a, b)
        elif own == window and not differs[a]:
            found.add(row)
        elif differs[row]:
            return None
    return found


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

"""Compile formulas for the step kernels: flat tables of instructions for each sample.

A formula becomes three tables, each with operands first:

- *signals*: every subformula without a future operator. Its robustness at a sample is final once that
  sample has come, so it is computed forwards, with a little state for past operators.
- *parts*: one part for each temporal operator that looks ahead. A part is in negation normal form over
  signals, so its robustness is monotone in all its operands.
- *reports*: the tree as the user wrote it. Boolean nodes combine the numbers of their operands.

`OnlineRun` evaluates samples by these tables. docs/design/monitor.md explains the tables with an example.

Some bounds of a part follow from its rows alone. A root that joins by the minimum, such as `G`, is at most
the least value of its closed positions. The lower bound of `G` is -inf, because later samples may always be
worse. The reverse holds for a root that joins by the maximum, such as `F`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Bound,
    Formula,
    Quantified,
    Temporal,
    Truth,
    expand,
    operands_of,
)
from spatial_replay.spec.walks import leaf_key, looks_ahead, nodes_with_operands

Row = tuple[int, ...]
"""A row of a table. The columns are listed in `codes`."""

NOTHING = -1
"""Entry of a row for a missing operand, upper end, variable, table or window."""


def window_of(bound: Bound | None) -> tuple[int, int, int | None]:
    """Return the unit, the lower end and the upper end of an operator's window; None for no upper end."""
    if bound is None:
        return codes.SAMPLES, 0, None
    return (codes.SAMPLES if bound.unit == "samples" else codes.NANOSECONDS), bound.lower, bound.upper


def array_of_rows(rows: Sequence[Row], width: int) -> Integers:
    """Return rows as an array (R, width). Shorter rows are padded with zeros."""
    padded_rows = [(*row, *(0,) * (width - len(row))) for row in rows]
    return np.array(padded_rows, np.int64).reshape(len(rows), width)


def _operands_of_row(row: Row) -> tuple[int, ...]:
    code, first_operand, second_operand, *_ = row
    if code in (codes.LEAF, codes.CONSTANT, codes.ELAPSED):
        return ()
    return (first_operand, second_operand) if code in (codes.AND, codes.OR, codes.SINCE) else (first_operand,)


class SignalTable:
    """Collects rows of signals, operands first. Equal subformulas share a row.

    Attributes:
        leaves: atoms and open quantifiers, in the order of their numbers.
    """

    def __init__(self, leaves: Sequence[Atom | Quantified] = ()) -> None:
        """Start with numbered leaves."""
        self.leaves: list[Atom | Quantified] = []
        self._leaf_numbers: dict[object, int] = {}
        self._rows: dict[Row, int] = {}
        # without this cache, nested expansions, which repeat operands, would take 2**depth steps
        self._row_by_id: dict[int, tuple[Formula, int]] = {}
        for leaf in leaves:
            self._leaf_number(leaf)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._rows)

    @property
    def windows(self) -> int:
        """Number of rings of positions that the rows need."""
        return sum(row[0] in codes.RINGS for row in self._rows)

    @property
    def keeps_history(self) -> bool:
        """Whether any row reads more than the newest sample."""
        return any(row[0] in (*codes.RINGS, codes.DELAY) for row in self._rows)

    def array(self, kept_rows: Iterable[int]) -> Integers:
        """Return the table (S, SIGNAL_WIDTH), with each row's ring and whether its history is read.

        Args:
            kept_rows: rows that parts read at earlier samples.
        """
        ring_rows = [row for row in self._rows if row[0] in codes.RINGS]
        history_rows = set(kept_rows)
        for row in self._rows:
            if row[0] in (*codes.RINGS, codes.DELAY):
                history_rows.update(_operands_of_row(row))
        rows = [
            (*row, ring_rows.index(row) if row in ring_rows else NOTHING, int(number in history_rows))
            for number, row in enumerate(self._rows)
        ]
        return array_of_rows(rows, codes.SIGNAL_WIDTH)

    def add(self, formula: Formula) -> int:
        """Return the row of a formula without future operators."""
        formula = expand(formula)
        if id(formula) not in self._row_by_id:
            operands = [self.add(operand) for operand in operands_of(formula)]
            # the formula is stored to stay alive, because a new formula could reuse the id of a freed formula
            self._row_by_id[id(formula)] = formula, self._added_row(formula, operands)
        return self._row_by_id[id(formula)][1]

    def _added_row(self, formula: Formula, operands: list[int]) -> int:
        match formula:
            case Truth():
                return self.row(codes.CONSTANT, low=1 if formula.value else -1)
            case Atom() | Quantified():
                return self.row(codes.LEAF, self._leaf_number(formula))
            case Boolean():
                return self._boolean(formula.operator, operands)
            case Temporal():
                return self._temporal(formula.operator, operands, formula.bound)

    def row(self, code: int, a: int = 0, b: int = 0, unit: int = 0, low: int = 0, high: int = 0) -> int:
        """Return the number of a row, which is added if no equal row exists."""
        return self._rows.setdefault((code, a, b, unit, low, high), len(self._rows))

    def _leaf_number(self, formula: Atom | Quantified) -> int:
        key = leaf_key(formula)
        if key not in self._leaf_numbers:
            self._leaf_numbers[key] = len(self.leaves)
            self.leaves.append(formula)
        return self._leaf_numbers[key]

    def _boolean(self, operator: str, operands: list[int]) -> int:
        joined_row, *other_operands = operands
        if operator == "not":
            return self.row(codes.NOT, joined_row)
        for operand in other_operands:
            joined_row = self.row(codes.AND if operator == "and" else codes.OR, joined_row, operand)
        return joined_row

    def _temporal(self, operator: str, operands: list[int], bound: Bound | None, ahead: int = 0) -> int:
        """Add a past operator or, with `codes.AHEAD`, the future operator that it equals in reversed time."""
        unit, low, high = window_of(bound)
        match operator:
            case "Y":
                return self.delay(operands[0], codes.SAMPLES, 1, ahead)
            case "S":
                left, right = operands
                return self.since(left, right, unit, low, high, ahead)
        is_weak = operator == "H"
        if high is not None:
            code = codes.WINDOW_MIN if is_weak else codes.WINDOW_MAX
            return self.row(code + ahead, operands[0], 0, unit, low, high)
        unbounded_row = self.row((codes.HISTORICALLY if is_weak else codes.ONCE) + ahead, operands[0])
        return unbounded_row if low == 0 else self.delay(unbounded_row, unit, low, ahead, is_weak=is_weak)

    def since(self, left: int, right: int, unit: int, low: int, high: int | None, ahead: int = 0) -> int:
        """Add a since over a window, phi S[a,b] psi.

        It is rewritten as O[a,b] psi and phi S[a,inf] psi. phi S[a,inf] psi is rewritten as H[0,a-1] phi
        and, delayed by a, phi S psi. Both identities are exact for robustness, because min distributes over
        max.
        """
        row = self.row(codes.SINCE + ahead, left, right)
        if low > 0:
            delayed_row = self.delay(row, unit, low, ahead)
            left_row = self.row(codes.WINDOW_MIN + ahead, left, 0, unit, 0, low - 1)
            row = self.row(codes.AND, left_row, delayed_row)
        if high is not None:
            window_row = self.row(codes.WINDOW_MAX + ahead, right, 0, unit, low, high)
            row = self.row(codes.AND, window_row, row)
        return row

    def infinity_after(self, unit: int, distance: int, sign: int) -> int:
        """Add an infinity that has `sign` from a distance after the first sample on, and -`sign` before."""
        return self.row(codes.ELAPSED, unit=unit, low=distance, high=sign)

    def delay(self, operand: int, unit: int, distance: int, ahead: int = 0, *, is_weak: bool = False) -> int:
        """Add an operand delayed by a distance. Before the first sample, it is +inf if weak, else -inf."""
        return self.row(codes.DELAY + ahead, operand, 0, unit, distance, 1 if is_weak else -1)


MAX_VARIABLES = 12
"""Limit on unbounded future operators in a part, because its table has 2**variables entries."""

LAST = (1 << 63) - 1
"""Largest distance of a sample, in samples or ns."""

_RUNNING = (codes.UNTIL, codes.RELEASE)
_RECURRENT_PAST = (codes.PAST_SINCE, codes.PAST_TRIGGER)


def part_of(signals: SignalTable, node: Temporal) -> PartRows:
    """Return the part of a node that looks ahead.

    Raises:
        UsageError: the part has more than `MAX_VARIABLES` unbounded future operators.
    """
    part = PartRows(signals, node)
    if part.variables > MAX_VARIABLES:
        raise UsageError(
            f"a formula nests {part.variables} unbounded temporal operators under one {node.operator}; "
            f"{MAX_VARIABLES} is the limit: split it into specs joined by `and`"
        )
    return part


class PartRows:
    """The distinct rows of a node that looks ahead, in negation normal form, operands first.

    Attributes:
        variables: number of operators whose value depends on the next sample.
        tables: number of tables: the part's table, and one table for each unbounded since or trigger.
    """

    def __init__(self, signals: SignalTable, root: Temporal) -> None:
        """Build the part of a node, and add the subformulas that do not look ahead to `signals`."""
        self.variables = 0
        self.tables = 1
        self._rows: dict[Row, int] = {}
        self._signals = signals
        self._is_past = root.operator not in FUTURE_OPERATORS
        self._row_by_id: dict[tuple[int, bool], tuple[Formula, int]] = {}
        is_bounded = root.bound is not None or root.operator in ("X", "WX")
        if is_bounded and not self._is_past:
            self._ending(root, True)
        else:
            self._add(root, True)

    def rows(self) -> tuple[Row, ...]:
        """Return the rows with three more columns.

        They are the row's variable, its table, and whether the row depends on a variable or table.
        """
        next_variable = 0
        next_table = 1  # 0 is the part's own table
        numbered_rows: list[Row] = []
        for *fields, is_variable in self._rows:
            has_table = fields[0] in _RECURRENT_PAST
            depends_below = any(numbered_rows[operand_row][-1] for operand_row in operand_rows(*fields[:3]))
            numbered_rows.append(
                (
                    *fields,
                    next_variable if is_variable else NOTHING,
                    next_table if has_table else NOTHING,
                    int(is_variable or has_table or depends_below),
                )
            )
            next_variable += is_variable
            next_table += has_table
        return tuple(numbered_rows)

    @property
    def is_flat(self) -> bool:
        """Whether the part has no window, shift or past operator, so that only variables are pending."""
        flat_codes = (codes.LITERAL, codes.PART_AND, codes.PART_OR)
        # all rows of `H[0,5] G G x` are flat, but a past root also reports its value at the newest sample
        is_flat = all(row[0] in flat_codes or (row[0] in _RUNNING and row[-1]) for row in self._rows)
        return is_flat and not self._is_past

    @property
    def end_corner(self) -> int:
        """The corner of the table that ends a run: +inf for weak operators, -inf for strong operators."""
        weak_flags = [row[3] for row in self._rows if row[-1]]
        return sum(1 << variable for variable, is_weak in enumerate(weak_flags) if is_weak)

    def row(
        self,
        code: int,
        a: int = 0,
        b: int = 0,
        weak: int = 0,
        unit: int = 0,
        low: int = 0,
        high: int = 0,
        variable: bool = False,
    ) -> int:
        """Return the number of a row, which is added if no equal row exists."""
        key = (code, a, b, weak, unit, low, high, int(variable))
        if key not in self._rows:
            self._rows[key] = len(self._rows)
            self.variables += variable
            self.tables += code in _RECURRENT_PAST
        return self._rows[key]

    def _add(self, formula: Formula, is_positive: bool) -> int:
        """Return the row of a formula or, if not `is_positive`, of its negation, in negation normal form.

        A formula's row and its negation's row are each built once, because `xor` expands to both.
        """
        formula = expand(formula)
        while isinstance(formula, Boolean) and formula.operator == "not":
            formula, is_positive = expand(formula.operands[0]), not is_positive
        key = (id(formula), is_positive)
        if key not in self._row_by_id:
            self._row_by_id[key] = formula, self._build(formula, is_positive)
        return self._row_by_id[key][1]

    def _build(self, formula: Formula, is_positive: bool) -> int:
        if isinstance(formula, Boolean | Temporal) and looks_ahead(formula):
            operands = [self._add(operand, is_positive) for operand in formula.operands]
            if isinstance(formula, Boolean):
                is_both = (formula.operator == "and") == is_positive
                return reduce(partial(self._join, is_both=is_both), operands)
            build = self._future if formula.operator in FUTURE_OPERATORS else self._past
            return build(formula.operator, operands, formula.bound, is_positive)
        return self.row(codes.LITERAL, self._signals.add(formula), 0 if is_positive else 1)

    def _join(self, first: int, second: int, *, is_both: bool) -> int:
        return self.row(codes.PART_AND if is_both else codes.PART_OR, first, second)

    def _future(self, operator: str, operands: list[int], bound: Bound | None, is_positive: bool) -> int:
        left, right, bound = _as_until(operator, operands, bound)
        # negation turns an until into a release, and a release into an until
        is_until = (operator != "G") == is_positive
        return self._bounded_until(left, right, *window_of(bound), is_until=is_until)

    def _bounded_until(
        self, left: int, right: int, unit: int, low: int, high: int | None, *, is_until: bool
    ) -> int:
        """Add until or release over a window, by the identity of `SignalTable.since`."""
        is_weak = int(not is_until)
        right_code, left_code = _by_kind(codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN, is_until)
        window_row = None if high is None else self.row(right_code, right, 0, is_weak, unit, low, high)
        if window_row is not None and left == NOTHING:
            return window_row
        code = codes.UNTIL if is_until else codes.RELEASE
        until_row = self.row(code, left, right, is_weak, variable=high is None)
        if low > 0 or high is not None:
            until_row = self.row(
                codes.SHIFT, until_row, 0, is_weak, unit, low, NOTHING if high is None else high
            )
        if low > 0 and left != NOTHING:
            lead_row = self.row(left_code, left, 0, 1 - is_weak, unit, 0, low - 1)
            until_row = self._join(lead_row, until_row, is_both=is_until)
        return until_row if window_row is None else self._join(window_row, until_row, is_both=is_until)

    def _past(self, operator: str, operands: list[int], bound: Bound | None, is_positive: bool) -> int:
        unit, low, high = window_of(bound)
        if operator == "Y":
            return self.row(codes.PAST_DELAY, operands[0], 0, int(not is_positive), codes.SAMPLES, 1)
        left, right = (NOTHING, operands[0]) if operator in ("O", "H") else operands
        is_since = (operator in ("O", "S")) == is_positive
        is_weak = int(not is_since)
        right_code, left_code = _by_kind(codes.PAST_WINDOW_MAX, codes.PAST_WINDOW_MIN, is_since)
        window_row = None if high is None else self.row(right_code, right, 0, is_weak, unit, low, high)
        if window_row is not None and left == NOTHING:
            return window_row
        since_row = self.row(codes.PAST_SINCE if is_since else codes.PAST_TRIGGER, left, right, is_weak)
        if low > 0:
            since_row = self.row(codes.PAST_DELAY, since_row, 0, is_weak, unit, low)
            if left != NOTHING:
                lead_row = self.row(left_code, left, 0, 1 - is_weak, unit, 0, low - 1)
                since_row = self._join(lead_row, since_row, is_both=is_since)
        return since_row if window_row is None else self._join(window_row, since_row, is_both=is_since)

    def _ending(self, formula: Formula, is_positive: bool) -> int:
        """Return the row of a bounded operator that is needed only at the first sample.

        The operator's window is a fixed interval of the run. In an until, positions outside the window are
        -inf. From the window's end on, the left operand is -inf, too, so later samples have no effect.
        """
        formula = expand(formula)
        if isinstance(formula, Boolean) and formula.operator == "not":
            return self._ending(formula.operands[0], not is_positive)
        if not isinstance(formula, Temporal):
            # W expands to `U or G`
            rows = [self._ending(operand, is_positive) for operand in operands_of(formula)]
            return reduce(partial(self._join, is_both=not is_positive), rows)
        operands = [self._add(operand, is_positive) for operand in formula.operands]
        left, right, bound = _as_until(formula.operator, operands, formula.bound)
        unit, low, high = window_of(bound)
        is_until = (formula.operator != "G") == is_positive
        outside_sign = -1 if is_until else 1
        if low > 0:
            right = self._join(right, self._infinity_after(unit, low, -outside_sign), is_both=is_until)
        if high is not None:
            after_end = self._infinity_after(unit, high, outside_sign)
            left = after_end if left == NOTHING else self._join(left, after_end, is_both=is_until)
            # `high` + 1 has to fit 64 bits
            if high < LAST:
                right = self._join(
                    right, self._infinity_after(unit, high + 1, outside_sign), is_both=is_until
                )
        code = codes.UNTIL if is_until else codes.RELEASE
        return self.row(code, left, right, int(not is_until), variable=True)

    def _infinity_after(self, unit: int, distance: int, sign: int) -> int:
        """Return the row of an infinity that changes its sign at a distance after the first sample."""
        return self.row(codes.LITERAL, self._signals.infinity_after(unit, distance, sign))


def _as_until(operator: str, operands: list[int], bound: Bound | None) -> tuple[int, int, Bound | None]:
    """Return a future operator's left operand, right operand and bound as an until.

    X is F[1,1]. X, F and G have no left operand.
    """
    if operator == "U":
        return operands[0], operands[1], bound
    return NOTHING, operands[0], Bound(1, 1, "samples") if operator == "X" else bound


def _by_kind(greatest: int, least: int, is_strong: bool) -> tuple[int, int]:
    """Return the codes of the window extrema for the right and the left operand of an until or since."""
    return (greatest, least) if is_strong else (least, greatest)


def operand_rows(code: int, a: int, b: int) -> tuple[int, ...]:
    """Return the rows of a node's operands."""
    if code == codes.LITERAL:
        return ()
    if code in codes.BINARY_NODES:
        return (a, b) if a != NOTHING else (b,)
    return (a,)


class _Direction(NamedTuple):
    """Codes of nodes below a root that joins by the minimum, or their duals for the maximum.

    Attributes:
        either, both: codes of "or" and "and".
        until, release: codes of until and release.
        worst, best: bounds for the lowest and the highest later values.
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
    """Return the direction of a part's root; None if the root is not a variable."""
    if not rows or rows[-1][codes.NODE_VARIABLE] == NOTHING:
        return None
    return _DIRECTIONS.get(rows[-1][codes.NODE_CODE])


def known_bounds(rows: tuple[Row, ...]) -> int:
    """Return the bounds that follow from a part's table regardless of open positions, one bit per bound.

    Later samples may always violate `G x`, so the lower bound of `G x` is -inf. Its upper bound depends on
    closed positions alone if later samples can satisfy x at every open position. This is so for x = `F y`
    and x = `F y or z`. All variables of the table have to fulfil this condition.
    """
    direction = _direction_of(rows)
    if direction is None:
        return 0
    # whether a node is infinite under the best continuation
    is_infinite: list[bool] = []
    for code, first_operand, second_operand, *_ in rows:
        if code == direction.either:
            is_infinite.append(is_infinite[first_operand] or is_infinite[second_operand])
        elif code == direction.both:
            is_infinite.append(is_infinite[first_operand] and is_infinite[second_operand])
        elif code == direction.until:
            is_infinite.append(
                first_operand == NOTHING or is_infinite[first_operand] or is_infinite[second_operand]
            )
        else:
            is_infinite.append(code == direction.release and is_infinite[second_operand])
    variable_nodes = [node for node, row in enumerate(rows) if row[codes.NODE_VARIABLE] != NOTHING]
    bound_bits = 1 << direction.worst if rows[-1][codes.NODE_A] == NOTHING else 0
    if all(is_infinite[node] for node in variable_nodes):
        bound_bits |= 1 << direction.best
    return bound_bits


def directions(rows: tuple[Row, ...]) -> list[tuple[bool, bool]]:
    """Return for each node whether its numbers never fall with new samples, and whether they never rise.

    A number belongs to a run that ends with the newest sample.
    """
    node_directions = list[tuple[bool, bool]]()
    for code, first_operand, second_operand, is_weak, *_ in rows:
        operand_directions = [
            node_directions[operand] for operand in operand_rows(code, first_operand, second_operand)
        ]
        rises, falls = all(up for up, _ in operand_directions), all(down for _, down in operand_directions)
        if code in (codes.UNTIL, codes.RELEASE, codes.SHIFT):
            rises, falls = rises and not is_weak, falls and bool(is_weak)
        node_directions.append(
            (rises and code != codes.PART_WINDOW_MIN, falls and code != codes.PART_WINDOW_MAX)
        )
    return node_directions


def is_monotone(rows: tuple[Row, ...]) -> bool:
    """Return whether the operand of a root that joins by the minimum never falls.

    For a root that joins by the maximum, return whether the operand never rises.
    """
    direction = _direction_of(rows)
    if (
        direction is None
        or rows[-1][codes.NODE_A] != NOTHING
        or any(row[codes.NODE_DEPENDS] for row in rows[:-1])
    ):
        return False
    return directions(rows)[rows[-1][codes.NODE_B]][0 if direction is _BY_MINIMUM else 1]


@dataclass(frozen=True, eq=False)
class Program:
    """A formula as tables. Their columns are listed in `codes`.

    Attributes:
        leaves: atoms and open quantifiers, the inputs of the kernels at each sample.
        signals: (S, SIGNAL_WIDTH).
        parts: (P, NODE_WIDTH).
        part_rows: for each part (D + 1, NODE_WIDTH), its nodes, then the part itself.
        reports: (N, REPORT_WIDTH), in the order of node ids.
        rows: (…, NODE_WIDTH), all tables joined: a row with the tables' offsets, signals, parts, reports,
            operand ids of the tree's nodes, and nodes of the parts.
        windows: number of rings of positions that the signals need.
        table_size: total size of all tables of parts without windows, in numbers per channel.
        keeps_history: whether any window, delay or part reads more than the newest sample.
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
        UsageError: a node has more than `MAX_VARIABLES` unbounded future operators below it.
    """
    signals, parts = SignalTable(), _Parts()
    reports: list[Row] = []
    operand_ids: list[int] = []
    for node, operands in nodes_with_operands(formula):
        operand_range = (len(operand_ids), len(operand_ids) + len(operands))
        operand_ids.extend(operands)
        if not looks_ahead(node):
            reports.append((codes.REPORT_SIGNAL, signals.add(node), 0, *operand_range))
        elif isinstance(node, Boolean):
            reports.append((codes.REPORT_OF_BOOLEAN[node.operator], 0, 0, *operand_range))
        elif isinstance(node, Temporal):
            reports.append((codes.REPORT_PART, parts.add(node, signals), _now_rule(node), *operand_range))
    signal_rows, report_rows = signals.array(parts.literals), array_of_rows(reports, codes.REPORT_WIDTH)
    return Program(
        leaves=tuple(signals.leaves),
        signals=signal_rows,
        parts=array_of_rows([rows[-1] for rows in parts.rows], codes.NODE_WIDTH),
        part_rows=tuple(array_of_rows(rows, codes.NODE_WIDTH) for rows in parts.rows),
        reports=report_rows,
        rows=_join_rows(signal_rows, parts.rows, report_rows, operand_ids),
        windows=signals.windows,
        table_size=parts.table_size,
        keeps_history=signals.keeps_history or parts.keeps_history,
    )


def _join_rows(
    signals: Integers, parts: Sequence[Sequence[Row]], reports: Integers, operands: Sequence[int]
) -> Integers:
    """Return the rows of a program (see `Program`)."""
    width = codes.NODE_WIDTH
    parts_begin = 1 + len(signals)
    reports_begin = parts_begin + len(parts)
    operands_begin = reports_begin + len(reports)
    # ceiling division, because operand ids fill whole rows
    next_row = operands_begin + -(-len(operands) // width)
    # a single array, because each array argument of a kernel costs time at every sample
    rows = np.zeros((next_row + sum(len(part_rows) - 1 for part_rows in parts), width), np.int64)
    rows[0, :7] = 1, len(signals), parts_begin, len(parts), reports_begin, len(reports), operands_begin
    rows[1:parts_begin, : codes.SIGNAL_WIDTH] = signals
    rows[reports_begin:operands_begin, : codes.REPORT_WIDTH] = reports
    rows[operands_begin:next_row].reshape(-1)[: len(operands)] = operands
    for part_number, part_rows in enumerate(parts):
        rows[next_row : next_row + len(part_rows) - 1] = array_of_rows(part_rows[:-1], width)
        rows[parts_begin + part_number, : len(part_rows[-1])] = part_rows[-1]
        rows[parts_begin + part_number, [codes.PART_FIRST, codes.PART_END]] = (
            next_row,
            next_row + len(part_rows) - 1,
        )
        next_row += len(part_rows) - 1
    return rows


class _Parts:
    """The distinct parts of a formula.

    Attributes:
        literals: signals that parts with windows read.
        rows: rows of each part: its nodes, then the part itself.
    """

    def __init__(self) -> None:
        self.table_size = 0
        self.keeps_history = False
        self.literals = set[int]()
        self.rows: list[tuple[Row, ...]] = []
        self._number_of: dict[tuple[tuple[Row, ...], bool], int] = {}

    def add(self, node: Temporal, signals: SignalTable) -> int:
        """Add the part for a node that looks ahead, and return the part's number."""
        part = part_of(signals, node)
        node_rows = tuple(_with_signal_row(row, signals) for row in part.rows())
        has_now = node.operator not in FUTURE_OPERATORS
        part_key = node_rows, has_now
        if part_key not in self._number_of:
            self._number_of[part_key] = len(self.rows)
            self.rows.append((*_with_times(node_rows), self._own_row(node_rows, part, has_now=has_now)))
        return self._number_of[part_key]

    def _own_row(self, node_rows: tuple[Row, ...], part: PartRows, *, has_now: bool) -> Row:
        row = (
            0,
            len(node_rows),
            codes.TABLE if part.is_flat else codes.WINDOWED,
            part.variables,
            part.tables,
            part.end_corner,
            self.table_size,
            known_bounds(node_rows),
            int(has_now),
            int(is_monotone(node_rows)),
        )
        if part.is_flat:
            self.table_size += 1 << part.variables
        else:
            self.keeps_history = True
            self.literals |= {row[codes.NODE_A] for row in node_rows if row[codes.NODE_CODE] == codes.LITERAL}
        return row


def _with_times(nodes: tuple[Row, ...]) -> Iterator[Row]:
    """Yield the rows with one more column, the number of a window or shift in seconds."""
    timed_count = 0
    for row in nodes:
        code, unit = row[codes.NODE_CODE], row[codes.NODE_UNIT]
        is_timed = unit != codes.SAMPLES and code in (*codes.AHEAD_OF, *codes.PAST_WINDOWS, codes.PAST_DELAY)
        yield (*row, timed_count if is_timed else NOTHING)
        timed_count += is_timed


def _with_signal_row(row: Row, signals: SignalTable) -> Row:
    """Return a row, with a literal of the negated signal instead of a negated literal."""
    code, signal, is_negated, *fields = row
    if code != codes.LITERAL or not is_negated:
        return row
    return (code, signals.row(codes.NOT, signal), 0, *fields)


def _now_rule(node: Temporal) -> int:
    """Return the rule for an operator's number on the newest sample alone (`now`).

    The number of a future operator follows from its operands' numbers. The number of a past operator is
    stored in its part.
    """
    if node.operator not in FUTURE_OPERATORS:
        return codes.NOW_OF_PART
    is_weak = node.operator in ("G", "R", "W", "WX")
    if node.operator in ("X", "WX") or (node.bound is not None and node.bound.lower > 0):
        return codes.NOW_TRUE if is_weak else codes.NOW_FALSE
    return codes.NOW_EITHER if node.operator == "W" else codes.NOW_LAST_OPERAND

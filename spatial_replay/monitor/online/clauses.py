"""Clauses: a part whose windows stand right below its root, as signals, at a constant cost for each sample.

Take `G` over a body in negation normal form. As a conjunction of disjunctions, the body splits, since minima
may be taken in any order: G (x and y) is G x and G y. So consider one clause, `max(p, window of b)`, whose
*condition* p is without future operators, and the least of its responses over all positions i up to now.

- *A window of the same kind*, `p or G[l,h] b`: min over i of max(p_i, min over j of b_j) is min over j of
  max(b_j, min over the i whose window holds j of p_i). The inner minimum is over a window behind j.
- *A window of the other kind*, `p or F[l,h] b`: what closed windows hold is settled, and b_j counts for all
  windows that have begun and are open, so those over which it is the greatest so far form a single segment.

Of a clause of two windows that begin and end alike, and nothing else:

- *One of each kind*, `G[l,h] b or F[l,h] c`: the later a window that is open begins, the more is the least of
  b in it, and the less the greatest of c. So the least of all is where they cross, which only moves forward.
- *Both of the same kind*, `G[0,h] b or G[0,h] c`: the least over all windows is that over any two samples
  that one of them holds, max(b_j, c_k) or max(c_j, b_k), with k up to h behind j.

With a left operand, `a R (…)`, p counts as the greater of p and every a before, and before the next sample,
where what is open begins, that is all. Where `G` joins a window from the first sample on, p counts as
infinite at positions outside, and what is open is the least that it can be until the window has closed. `F`
and `U` are the same upside down. Two windows alike have neither a left operand nor such a window.

Other clauses with windows of both kinds, or with one of the other kind over a window, are none of this: they
stay with `windows`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.operators import LAST, NOTHING, PartRows, Row, SignalTable

MAX_CLAUSES = 16
"""How many clauses a body may have, each a few signals; they may grow as 2**operators."""
MAX_TABLE = 5
"""How many unbounded operators may stand beside windows."""

Clause = frozenset[int]
"""Rows of a part that are joined by `or` below a weak root, by `and` below a strong one."""


@dataclass(frozen=True)
class Clauses:
    """A part as signals.

    Attributes:
        ending: its value if the run ends here.
        lower, upper: its value with the worst and the best continuation.
        is_minimum: whether clauses are joined by the minimum: whether the root is `G` or `R`.
        beside: those clauses that have no window, which are joined with the others.
    """

    ending: int
    lower: int
    upper: int
    is_minimum: bool
    beside: PartRows | None


def clauses_of(signals: SignalTable, part: PartRows) -> Clauses | None:
    """Return a part as clauses, for which signals are added; None if it has to be run as it is."""
    code, left, body, is_weak, *_, is_variable = part.fields[-1]
    if not is_variable or code not in (codes.UNTIL, codes.RELEASE) or part.is_flat or part.is_brief:
        return None
    if left != NOTHING and part.fields[left][0] != codes.LITERAL:
        return None
    clauses = _normal_form(part.fields, body, is_weak=bool(is_weak))
    if clauses is None:
        return None
    before = len(signals)
    window = part.root_window if part.ends else None
    builder = _Builder(signals, part.fields, left, window, is_weak=bool(is_weak))
    found = builder.result() if all(map(builder.add, clauses)) else None
    if found is None:
        signals.drop(before)
    return found


def _normal_form(rows: tuple[Row, ...], body: int, *, is_weak: bool) -> list[Clause] | None:
    """Return a body's clauses, without those that another one implies; None if they are too many."""
    forms: list[list[Clause] | None] = []
    for row, (code, a, b, *_) in enumerate(rows[: body + 1]):  # operands come first
        if code not in (codes.PART_AND, codes.PART_OR):
            forms.append([frozenset((row,))])
            continue
        first, second = forms[a], forms[b]
        if first is None or second is None:
            forms.append(None)
            continue
        if (code == codes.PART_AND) == is_weak:
            both = first + second
        else:
            both = [one | other for one in first for other in second]
        distinct = list(dict.fromkeys(both))
        needed = [each for each in distinct if not any(other < each for other in distinct)]
        forms.append(needed if len(needed) <= MAX_CLAUSES else None)
    return forms[body]


class _Builder:
    """Collects the signals of one part, clause by clause."""

    def __init__(
        self,
        signals: SignalTable,
        rows: tuple[Row, ...],
        left: int,
        window: tuple[int, int, int] | None,
        *,
        is_weak: bool,
    ) -> None:
        """Begin without clauses.

        Args:
            window: the unit and the ends of what the root joins, if it ends.
        """
        self._signals = signals
        self._rows = rows
        self._left = left
        self._ends = window
        self._is_weak = is_weak
        self._both, self._either = (codes.AND, codes.OR) if is_weak else (codes.OR, codes.AND)
        self._running, self._before = (
            (codes.HISTORICALLY, codes.ONCE) if is_weak else (codes.ONCE, codes.HISTORICALLY)
        )
        self._window = codes.WINDOW_MIN if is_weak else codes.WINDOW_MAX
        self._same, self._other = (
            (codes.PART_WINDOW_MIN, codes.PART_WINDOW_MAX)
            if is_weak
            else (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN)
        )
        # by clause: settled whatever comes, if the run ends here, and as bad as it may come
        self._settled: list[int] = []
        self._ending: list[int] = []
        self._open: list[int] = []
        # with each, the signal that stands for its literals, if there is one
        self._tabled: list[tuple[Clause, int]] = []

    def add(self, clause: Clause, beside: int = NOTHING) -> bool:
        """Add a clause, joined with a signal beside it; return whether there is a rule for it."""
        rows = self._rows
        literals = sorted(each for each in clause if rows[each][0] == codes.LITERAL)
        others = sorted(clause.difference(literals), key=lambda each: rows[each][0])
        condition = self._condition(literals, beside)
        if not others:
            self._add_same(self._signals.row(self._running, condition))
            return True
        if len(others) == 1 and rows[others[0]][0] in (self._same, self._other):
            return self._add_window(condition, rows[others[0]])
        if {rows[each][0] for each in others} == {self._other}:
            return self._add_windows(condition, [rows[each] for each in others])
        windows = sorted((rows[each] for each in others), key=lambda row: row[0] != self._same)
        if [row[0] for row in windows] in ([self._same, self._other], [self._same, self._same]):
            is_whole = not literals and beside == NOTHING and self._left == NOTHING and self._ends is None
            return is_whole and self._add_two(*windows)
        if all(self._unbounded(each) is not None for each in others):
            self._tabled.append((clause, NOTHING if beside == NOTHING else condition))
            return True
        if len(others) == 1 and rows[others[0]][0] == codes.SHIFT:
            return self._add_later(condition, others[0])
        return self._add_release(condition, [rows[each] for each in others])

    def result(self) -> Clauses | None:
        """Return what was added; None if there was no window or if the table beside would be too large."""
        if self._tabled and self._ends is not None:
            return None
        beside = self._table() if self._tabled else None
        if not self._ending or (beside is not None and beside.variables > MAX_TABLE):
            return None
        best = self._signals.row(codes.CONSTANT, low=1 if self._is_weak else -1)
        ending, settled = self._joined(self._ending), self._joined(self._settled or [best])
        if self._ends is not None:
            last = self._joined([*self._open, self._elapsed(self._ends[2])])
        elif self._left == NOTHING:
            last = self._nothing()
        else:  # what is open may begin with the next sample
            last = self._joined([*self._open, self._signals.row(self._before, self._literal(self._left))])
        lower, upper = (last, settled) if self._is_weak else (settled, last)
        return Clauses(ending, lower, upper, self._is_weak, beside)

    def _add_window(self, condition: int, window: Row) -> bool:
        code, operand, _, _, unit, low, high, *_ = window
        if self._rows[operand][0] != codes.LITERAL:
            return code == self._same and self._add_within(condition, window)
        number = self._literal(operand)
        if code == self._same:
            behind = self._signals.row(self._window, condition, 0, unit, low, high)
            self._add_joined(behind, number, condition, (unit, low, high))
            return True
        kind = codes.CLOSED_MIN_OF_MAX if self._is_weak else codes.CLOSED_MAX_OF_MIN
        closed = self._signals.row(kind, condition, number, unit, low, high)
        begun = codes.BEGUN_MIN if self._is_weak else codes.BEGUN_MAX
        ending = [closed, self._signals.row(begun, condition, number, unit, low, high)]
        if low > 0:
            ending.append(self._signals.row(self._window, condition, 0, unit, 0, low - 1))
        self._settled.append(closed)
        self._ending.append(self._joined(ending))
        self._open.append(self._ending[-1])
        return True

    def _add_within(self, condition: int, window: Row) -> bool:
        """Add a clause with a window of the same kind over more than a literal.

        That counts for all positions whose window holds it, so that their conditions are its own, together.
        """
        _, operand, _, _, unit, low, high, *_ = window
        clauses = _normal_form(self._rows, operand, is_weak=self._is_weak)
        if clauses is None or self._left != NOTHING or self._ends is not None:
            return False
        behind = self._signals.row(self._window, condition, 0, unit, low, high)
        return all(self.add(clause, behind) for clause in clauses)

    def _add_windows(self, condition: int, windows: list[Row]) -> bool:
        """Add a clause with several windows of the other kind, which begin alike.

        Until the first of them closes, a number counts in whichever it is. Then what a position has found is
        a condition, with which it goes on to look for what the others hold.
        """
        starts = {(unit, low) for _, _, _, _, unit, low, *_ in windows}
        if len(starts) > 1 or self._left != NOTHING:
            return False
        if {self._rows[window[1]][0] for window in windows} != {codes.LITERAL}:
            return False
        ((unit, low),) = starts
        row, kind = self._signals.row, codes.CLOSED_MIN_OF_MAX if self._is_weak else codes.CLOSED_MAX_OF_MIN
        ending = list[int]()
        begun = codes.BEGUN_MIN if self._is_weak else codes.BEGUN_MAX
        each = codes.CLOSED_EACH_MAX if self._is_weak else codes.CLOSED_EACH_MIN
        if low > 0:
            ending.append(row(self._window, condition, 0, unit, 0, low - 1))
        near, ends = low, sorted({window[6] for window in windows})
        for high in ends:
            numbers = [self._literal(window[1]) for window in windows if window[6] >= high]
            number = reduce(lambda one, other: row(self._either, one, other), numbers)
            ending.append(row(begun, condition, number, unit, near, high))
            if high < ends[-1]:
                condition = row(each, condition, number, unit, near, high)
            else:
                closed = row(kind, condition, number, unit, near, high)
                self._settled.append(closed)
                ending.append(closed)
            near = high
        self._ending += ending
        self._open += ending
        return True

    def _add_two(self, falling: Row, other: Row) -> bool:
        """Add a clause of two windows and nothing else that begin and end alike, the first of the same kind.

        While they are open, the first can only fall, and another kind only rise (below a strong root, the
        other way round). Two of the same kind are as little as any two numbers in one window are.
        """
        unit, low, high = falling[4:7]
        operands = {self._rows[window[1]][0] for window in (falling, other)}
        if falling[4:7] != other[4:7] or operands != {codes.LITERAL}:
            return False
        if other[0] == self._same and low > 0:
            return False  # between two samples there may be none that a window of both begins from
        row, (first, second) = self._signals.row, (self._literal(each[1]) for each in (falling, other))
        if other[0] == self._same:
            behind = [row(self._window, each, 0, unit, 0, high) for each in (first, second)]
            pairs = [row(self._either, *pair) for pair in zip((second, first), behind, strict=True)]
            self._add_same(row(self._running, self._joined(pairs)))
            return True
        each = codes.CLOSED_EACH_MIN if self._is_weak else codes.CLOSED_EACH_MAX
        found = row(each, row(codes.CONSTANT, low=1 if self._is_weak else -1), first, unit, low, high)
        kind = codes.CLOSED_MIN_OF_MAX if self._is_weak else codes.CLOSED_MAX_OF_MIN
        closed = row(kind, found, second, unit, low, high)
        crossing = codes.CROSSING_MIN if self._is_weak else codes.CROSSING_MAX
        self._settled.append(closed)
        self._ending += [closed, row(crossing, first, second, unit, low, high)]
        return True

    def _add_later(self, condition: int, row: int) -> bool:
        """Add a clause with an until (a release, below a strong root) of literals that begins later.

        Until it begins, nothing is found, and then it counts where it begins.
        """
        _, a, _, _, unit, low, *_ = self._rows[row]
        kind = codes.UNTIL if self._is_weak else codes.RELEASE
        if self._left != NOTHING or self._rows[a][0] != kind or self._unbounded(row, later=True) is None:
            return False
        code = codes.ARRIVED_MIN if self._is_weak else codes.ARRIVED_MAX
        arrived = self._signals.row(code, condition, 0, unit, low)
        self._tabled.append((frozenset((row,)), arrived))
        self._ending.append(self._signals.row(self._window, condition, 0, unit, 0, low - 1))
        return True

    def _add_joined(self, behind: int, number: int, condition: int, window: tuple[int, int, int]) -> None:
        """Add a clause by what its conditions are, together, where its window holds each number."""
        value = self._signals.row(self._running, self._signals.row(self._either, behind, number))
        if self._left == NOTHING and self._ends is None:
            self._add_same(value)
            return
        unit, low, high = window
        kind = codes.CLOSED_MIN_OF_MIN if self._is_weak else codes.CLOSED_MAX_OF_MAX
        open_ = [self._signals.row(kind, condition, number, unit, low, high)]
        if high > 0:
            open_.append(self._signals.row(self._window, condition, 0, unit, 0, high - 1))
        self._settled.append(value)
        self._ending.append(value)
        self._open.append(self._joined(open_))

    def _add_same(self, value: int) -> None:
        for each in (self._settled, self._ending, self._open):
            each.append(value)

    def _add_release(self, condition: int, others: list[Row]) -> bool:
        """Add a clause with a release over a window (an until, below a strong root), as it is expanded.

        At i that is min over j of max(b_j, greatest a from i to before j), so that all conditions together
        are, at j, a trigger over the window behind.
        """
        windows = [row for row in others if row[0] == self._same]
        shifts = [row for row in others if row[0] == codes.SHIFT]
        if len(windows) != 1 or len(shifts) != 1 or self._left != NOTHING or self._ends is not None:
            return False
        _, operand, _, _, unit, low, high, *_ = windows[0]
        release = self._rows[shifts[0][1]]
        code, a, b = release[:3]
        kind = codes.RELEASE if self._is_weak else codes.UNTIL
        if (code, b, release[7]) != (kind, operand, 0) or shifts[0][4:7] != (unit, low, high):
            return False
        # as long as the window has not begun
        expected = (self._other, a, 0, 1 - release[3], unit, 0, low - 1, 0)
        if [row for row in others if row not in (windows[0], shifts[0])] != ([expected] if low > 0 else []):
            return False
        if {self._rows[each][0] for each in (a, b)} != {codes.LITERAL}:
            return False
        earlier = self._signals.delay(self._literal(a), codes.SAMPLES, 1)
        if self._is_weak:
            earlier, condition = (self._signals.row(codes.NOT, each) for each in (earlier, condition))
        behind = self._signals.since(earlier, condition, unit, low, high)
        if self._is_weak:
            behind = self._signals.row(codes.NOT, behind)
        self._add_joined(behind, self._literal(b), condition, (unit, low, high))
        return True

    def _condition(self, literals: list[int], beside: int) -> int:
        found = [self._literal(each) for each in literals]
        if beside != NOTHING:
            found.append(beside)
        elif self._ends is not None:
            found += self._outside()
        if self._left != NOTHING:
            before = self._signals.row(self._before, self._literal(self._left))
            # what stands before the first sample is the least that it can be
            found.append(self._signals.delay(before, codes.SAMPLES, 1, is_weak=not self._is_weak))
        return reduce(
            lambda one, other: self._signals.row(self._either, one, other), found or [self._nothing()]
        )

    def _outside(self) -> list[int]:
        """Return signals of which one is infinite where a position is not in the root's window."""
        assert self._ends is not None
        _, low, high = self._ends
        early = [self._signals.row(codes.NOT, self._elapsed(low))] if low > 0 else []
        late = [self._elapsed(high + 1)] if high < LAST else []
        return [*early, *late]

    def _elapsed(self, distance: int) -> int:
        """Return a signal that, once a distance from the first sample on, is as good as a clause can be."""
        assert self._ends is not None
        return self._signals.elapsed(self._ends[0], distance, 1 if self._is_weak else -1)

    def _literal(self, row: int) -> int:
        _, signal, is_negated = self._rows[row][:3]
        return self._signals.row(codes.NOT, signal) if is_negated else signal

    def _nothing(self) -> int:
        return self._signals.row(codes.CONSTANT, low=-1 if self._is_weak else 1)

    def _joined(self, values: list[int]) -> int:
        return reduce(lambda one, other: self._signals.row(self._both, one, other), values)

    def _unbounded(self, row: int, *, later: bool = False) -> Row | None:
        """Return an until or a release of literals without a window; None for anything else.

        It begins at once, unless `later`. One with a window is expanded to the extremum over it, and the same
        operator without. Where the first holds, it makes no difference how the second goes on behind the
        window.
        """
        code, a, _, _, _, low, *_ = self._rows[row]
        if code == codes.SHIFT and (low == 0 or later):
            code = self._rows[a][0]
            kind = codes.UNTIL if self._is_weak else codes.RELEASE
            if code != kind:
                return None
            row = a
        elif code not in (codes.UNTIL, codes.RELEASE) or not self._rows[row][-1]:
            return None
        fields = self._rows[row]
        operands = [each for each in fields[1:3] if each != NOTHING]
        return fields if all(self._rows[each][0] == codes.LITERAL for each in operands) else None

    def _table(self) -> PartRows:
        """Return the clauses without a window as a part of their own, under the same root."""
        part = PartRows()

        def literal(row: int) -> int:
            if row == NOTHING:
                return NOTHING
            _, signal, is_negated = self._rows[row][:3]
            return part.row(codes.LITERAL, signal, is_negated)

        def added(row: int) -> int:
            operator = self._unbounded(row, later=True) if self._rows[row][0] != codes.LITERAL else None
            if operator is None:
                return literal(row)
            code, a, b, weak, *_ = operator
            return part.row(code, literal(a), literal(b), weak, variable=True)

        both, either = (codes.PART_AND, codes.PART_OR) if self._is_weak else (codes.PART_OR, codes.PART_AND)
        bodies = []
        for clause, signal in self._tabled:
            rows = [row for row in sorted(clause) if signal == NOTHING or self._rows[row][0] != codes.LITERAL]
            joined = [part.row(codes.LITERAL, signal)] if signal != NOTHING else []
            joined += map(added, rows)
            bodies.append(reduce(lambda one, other: part.row(either, one, other), joined))
        body = reduce(lambda one, other: part.row(both, one, other), bodies)
        root = codes.RELEASE if self._is_weak else codes.UNTIL
        part.row(root, literal(self._left), body, int(self._is_weak), variable=True)
        return part

"""Bounds of a part from the rows of its root alone.

A root that joins by the minimum, such as `G`, cannot exceed the least of its closed positions, and later
samples may always be worse. For the maximum, as in `F`, it is the reverse.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.operators import NOTHING, Row, SignalTable, operand_rows

NEVER = codes.SAMPLES, NOTHING
"""The end of a root that has none."""


class _Direction(NamedTuple):
    """Operands of a root that joins by the minimum; for the maximum it is the reverse.

    Attributes:
        either, both: the nodes that are as great as the greater, and as the smaller one of their operands.
        window, until: those that are great once their operand is.
        release: those that are great as long as it is.
        worst, best: the bounds of the smallest, and of the greatest continuation.
        weak: what `NODE_WEAK` is where what is still to come counts as small.
    """

    either: int
    both: int
    window: int
    until: int
    release: int
    worst: int
    best: int
    weak: int


_BY_MINIMUM = _Direction(
    codes.PART_OR, codes.PART_AND, codes.PART_WINDOW_MAX, codes.UNTIL, codes.RELEASE, codes.OPEN_LOW,
    codes.OPEN_HIGH, 0,
)  # fmt: skip
_BY_MAXIMUM = _Direction(
    codes.PART_AND, codes.PART_OR, codes.PART_WINDOW_MIN, codes.RELEASE, codes.UNTIL, codes.OPEN_HIGH,
    codes.OPEN_LOW, 1,
)  # fmt: skip
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


def cutting_windows(rows: tuple[Row, ...]) -> set[int] | None:
    """Return the windows that are the greatest while they are open, of a root that joins by the minimum.

    Where one is open, what it stands in is no bound; anywhere else, the best that may come is what counts for
    the value, too. The same upside down. None where other nodes make a difference between the two.
    """
    code, left, body, *_ = rows[-1]
    way = _DIRECTIONS.get(code)
    if way is None or left != NOTHING:
        return None
    differs: list[bool] = []
    for own, a, b, weak, *_ in rows[: body + 1]:
        operands = {codes.LITERAL: (), way.either: (a, b), way.both: (a, b)}.get(own, (a,))
        is_free = own in (codes.LITERAL, way.either, way.both, *codes.AHEAD_OF)
        is_open = own == way.window or (own == codes.SHIFT and weak == way.weak)
        differs.append(not is_free or is_open or any(differs[each] for each in operands))
    found, waiting = set[int](), [body]
    while waiting:
        row = waiting.pop()
        own, a, b, *_ = rows[row]
        if own == way.either:
            waiting += (a, b)
        elif own == way.window and not differs[a]:
            found.add(row)
        elif differs[row]:
            return None
    return found


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

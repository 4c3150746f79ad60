"""What a part's root says of its bounds, and of positions that matter no more, by its rows alone.

A root that joins by the minimum, as `G` does, cannot exceed any more what has closed of what it joins, and
what comes may always be worse; by the maximum, as `F` does, all of it is the other way round.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.operators import NOTHING, Row, SignalTable

NEVER = codes.SAMPLES, NOTHING
"""The end of a root that has none."""
_LOOKING_AHEAD = (codes.UNTIL, codes.RELEASE, *codes.AHEAD_OF)
"""Nodes whose number may depend on what is still to come."""


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
_DIRECTIONS: Mapping[int, _Direction] = MappingProxyType(
    {codes.RELEASE: _BY_MINIMUM, codes.UNTIL: _BY_MAXIMUM}
)


def _direction_of(rows: tuple[Row, ...]) -> _Direction | None:
    """Return what a part's root is in, if it is a variable: one that never ends, or not before its window."""
    if not rows or rows[-1][codes.NODE_VARIABLE] == NOTHING:
        return None
    return _DIRECTIONS.get(rows[-1][codes.NODE_CODE])


def _joins_all(rows: tuple[Row, ...]) -> bool:
    """Return whether a root joins all that its operand is, until its window is over if it has one."""
    return rows[-1][codes.NODE_A] == NOTHING


def root_end(rows: tuple[Row, ...], signals: SignalTable) -> tuple[int, int]:
    """Return how far from the first sample on a root joins what its operand is, and in which unit."""
    _, left, _, _, unit, _, high, *_ = rows[-1]
    if left == NOTHING:
        return (unit, high) if high > 0 else NEVER
    code, signal, *_ = rows[left]
    return (signals.elapsed_at(signal) or NEVER) if code == codes.LITERAL else NEVER


def known_bounds(rows: tuple[Row, ...], *, is_bounded: bool) -> int:
    """Return which bounds follow from a part's table, whatever is open, a bit for each.

    What comes may always violate `G x`, so that its lower bound is as small as can be. Its upper one is as
    great as can be wherever x is: where it is `F y`, which what comes may always satisfy, or `F y or z`, say.
    The table then says what follows from what has closed, if the same holds for all of its variables.

    Once a root with a window is over, what comes does not violate it any more, but may still satisfy what
    never ends below it. Where all that is open below it counts as violated until something comes, the value
    is the lower bound; where all of it counts as satisfied, the upper one.

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
    open_weak = {row[codes.NODE_WEAK] for row in rows[:-1] if row[codes.NODE_CODE] in _LOOKING_AHEAD}
    if is_bounded and len(open_weak) == 1:
        known |= codes.SAME_IF_OVER << (codes.UPPER if 1 in open_weak else codes.LOWER)
    if all(outdone[node] for node in variables):
        known |= (1 | codes.EVEN_IF_OVER) << way.best
    return known


def limit_of(rows: tuple[Row, ...], signals: SignalTable) -> int:
    """Return the signal that what a root joins never passes, whatever comes; -1 for none.

    `F[0,9] x` is at least what x is there, `x or y` at least what x is, though y looks ahead, and so on. What
    `G` joins matters no more once it is known to be at least what `G` cannot exceed any more.

    Args:
        signals: extended.
    """
    way = _direction_of(rows)
    if way is None or not _joins_all(rows):
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


def is_monotone(rows: tuple[Row, ...]) -> bool:
    """Return whether what a root joins by the minimum falls no more, or the other way round.

    What `F` finds remains, and what is still to come can only add to it.
    """
    way = _direction_of(rows)
    if way is None or not _joins_all(rows):
        return False
    free = (codes.LITERAL, codes.PART_AND, codes.PART_OR, codes.PAST_DELAY, *codes.PAST_WINDOWS)
    ahead = (way.window, way.until, codes.SHIFT)
    return all(
        row[codes.NODE_CODE] in free or (row[codes.NODE_CODE] in ahead and row[codes.NODE_WEAK] == way.weak)
        for row in rows[:-1]
    )


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

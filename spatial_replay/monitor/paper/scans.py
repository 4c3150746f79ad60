"""Minima and maxima that leave out NaN, and temporal operators over whole runs of numbers.

Every number has a mark beside it, 1 where it is lost; whatever is made of lost numbers is lost.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, piece
from spatial_replay.geometry.arrays import Flags, Floats, Integers
from spatial_replay.monitor.paper.table import AND, IFF, IMPLIES, NOT, OR, XOR


@inlined
def least(one: float, other: float) -> float:
    """The lesser number; that which is not left out; NaN if both are."""
    if np.isnan(one):
        return other
    if np.isnan(other):
        return one
    return min(one, other)


@inlined
def most(one: float, other: float) -> float:
    """As `least`, the greater."""
    if np.isnan(one):
        return other
    if np.isnan(other):
        return one
    return max(one, other)


@inlined
def pick(is_least: bool, one: float, other: float) -> float:
    """`least` or `most`."""
    return least(one, other) if is_least else most(one, other)


@inlined
def combine(code: int, one: float, other: float) -> float:
    """A Boolean operator; of one operand, both are that operand."""
    if code == AND:
        return least(one, other)
    if code == OR:
        return most(one, other)
    if code == NOT:
        return -one
    if code == IMPLIES:
        return most(-one, other)
    if code == XOR:
        return most(least(one, -other), least(-one, other))
    if code == IFF:
        return least(most(-one, other), most(-other, one))
    return one


@piece
def total(
    is_least: bool, numbers: Floats, lost: Flags, first: int, last: int
) -> tuple[float, int]:  # fmt: skip
    """The least or the greatest number from `first` to `last`."""
    result, is_lost = np.nan, 0
    for t in range(first, last + 1):
        result = pick(is_least, result, numbers[t])
        is_lost |= lost[t]
    return result, is_lost


@piece
def scan(
    is_least: bool, numbers: Floats, lost: Flags, first: int, last: int, into: Floats, into_lost: Flags
) -> None:
    """For each sample from `first` on: the least or the greatest number from there to `last`."""
    result, is_lost = np.nan, 0
    for t in range(last, first - 1, -1):
        result = pick(is_least, result, numbers[t])
        is_lost |= lost[t]
        into[t], into_lost[t] = result, is_lost


@piece
def scan_until(
    left: Floats, left_lost: Flags, right: Floats, right_lost: Flags,
    first: int, last: int, into: Floats, into_lost: Flags,
) -> None:  # fmt: skip
    """Until, from each sample from `first` on to `last`, of a left operand that depends on no later sample.

    The best over later ends is capped by the left operand here. An end of which everything was left out so
    far takes on the left operand here, which is then as good as any.
    """
    best, is_lost, is_any_left_out = np.nan, 0, False
    for t in range(last, first - 1, -1):
        here = least(right[t], left[t])
        if not np.isnan(left[t]):
            if is_any_left_out:
                best = left[t]
            elif not np.isnan(best):
                best = min(left[t], best)
            is_any_left_out = False
        if np.isnan(here):
            is_any_left_out = True
        best = most(best, here)
        is_lost |= left_lost[t] | right_lost[t]
        into[t], into_lost[t] = best, is_lost


@piece
def scan_until_by_last(
    left: Floats, left_lost: Flags, right: float, right_lost: int,
    first: int, last: int, into: Floats, into_lost: Flags,
) -> None:  # fmt: skip
    """Until, from each sample to `last`, given until to the sample before: the right operand is settled."""
    still, is_lost = np.nan, right_lost
    into[last], into_lost[last] = np.nan, 0
    for t in range(last, first - 1, -1):
        still = least(still, left[t])
        is_lost |= left_lost[t]
        into[t] = most(into[t], least(right, still))
        into_lost[t] |= is_lost


@piece
def scan_until_by_pairs(
    still: Floats, still_lost: Flags, starts: Integers, right: Floats, right_lost: Flags,
    first: int, last: int, into: Floats, into_lost: Flags,
) -> None:  # fmt: skip
    """Until, from each sample to `last`, given the least left operand for each beginning and end."""
    into[first : last + 1], into_lost[first : last + 1] = np.nan, 0
    for end in range(first, last + 1):
        for t in range(first, end + 1):
            at = starts[end] + t
            into[t] = most(into[t], least(right[end], still[at]))
            into_lost[t] |= right_lost[end] | still_lost[at]

"""Positions of samples in a run, and how far windows in samples or in time reach from them.

`stamps` holds the times of the samples offset, offset + 1, … of the run; `last` is the newest of them that
counts.
"""

from __future__ import annotations

from spatial_replay.compiled import piece
from spatial_replay.geometry.batch import Integers
from spatial_replay.monitor.codes import SAMPLES


@piece
def first_after(stamps: Integers, offset: int, last: int, position: int, distance: int) -> int:
    """The first position, offset … last, at least so many ns after another; last + 1 if there is none.

    Times are compared by their differences, which fit where a time plus the distance might not.
    """
    low, high = 0, last - offset + 1
    origin = stamps[position - offset]
    while low < high:
        middle = (low + high) >> 1
        if stamps[middle] - origin < distance:
            low = middle + 1
        else:
            high = middle
    return offset + low


@piece
def first_onward(stamps: Integers, offset: int, last: int, position: int, distance: int, before: int) -> int:
    """`first_after`, sought step by step from what it was for a position before."""
    origin = stamps[position - offset]
    while before <= last and stamps[before - offset] - origin < distance:
        before += 1
    return before


@piece
def ahead(stamps: Integers, offset: int, last: int, position: int, unit: int, distance: int) -> int:
    """The first position at least so far ahead (it may lie after `last`)."""
    if unit == SAMPLES:
        return position + distance
    if position > last:
        return last + 1
    return first_after(stamps, offset, last, position, distance)


@piece
def last_ahead(stamps: Integers, offset: int, last: int, position: int, unit: int, distance: int) -> int:
    """The last position at most so far ahead, and known: `last` at most."""
    if unit == SAMPLES:
        return min(position + distance, last)
    if position > last:
        return last
    return first_after(stamps, offset, last, position, distance + 1) - 1


@piece
def is_closed(stamps: Integers, offset: int, last: int, position: int, unit: int, distance: int) -> bool:
    """Whether no later sample can fall into the window that ends so far ahead of a position."""
    if position > last:
        return False
    if unit == SAMPLES:
        return position + distance <= last
    return bool(stamps[last - offset] - stamps[position - offset] >= distance)


@piece
def behind(stamps: Integers, offset: int, position: int, unit: int, distance: int) -> int:
    """The last position at least so far behind; before `offset` if there is none."""
    if unit == SAMPLES:
        return position - distance
    return first_after(stamps, offset, position, position, 1 - distance) - 1


@piece
def first_behind(stamps: Integers, offset: int, position: int, unit: int, distance: int) -> int:
    """The first position at most so far behind, `offset` at least."""
    if unit == SAMPLES:
        return max(position - distance, offset)
    return first_after(stamps, offset, position, position, -distance)

"""What numbers are from each on, or up to each: columns run through from one end to the other.

What follows from the number before, or after, is found by doubling within rows of numbers, so that loops are
vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from spatial_replay.compiled import row_loop, uncounted
from spatial_replay.compiler import ROW, Lanes
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.online.sliding import either

_APART = tuple(1 << doubled for doubled in range(ROW.bit_length() - 1))
"""So many places apart, one after the other, numbers of a row are joined until each has all from it on."""


def _extremes(lanes: Lanes, join: Any, row: Any, numbers: Any, side: int) -> Any:
    """Return the extremes of what comes from beyond a row and of its numbers from each on, or up to each."""
    for by in _APART:
        numbers = join(numbers, lanes.moved(numbers, side * by))
    found = join(row, numbers)
    return lanes.spread(found, 0 if side > 0 else ROW - 1), found


def _greatest_back(lanes: Lanes, row: Any, numbers: Any) -> Any:
    return _extremes(lanes, lanes.greater, row, numbers, 1)


def _least_back(lanes: Lanes, row: Any, numbers: Any) -> Any:
    return _extremes(lanes, lanes.lesser, row, numbers, 1)


def _greatest_on(lanes: Lanes, row: Any, numbers: Any) -> Any:
    return _extremes(lanes, lanes.greater, row, numbers, -1)


def _least_on(lanes: Lanes, row: Any, numbers: Any) -> Any:
    return _extremes(lanes, lanes.lesser, row, numbers, -1)


def _greatest_on_beside(lanes: Lanes, row: Any, numbers: Any, before: Any) -> Any:
    row, found = _greatest_on(lanes, row, numbers)
    return row, lanes.greater(before, found)


def _least_on_beside(lanes: Lanes, row: Any, numbers: Any, before: Any) -> Any:
    row, found = _least_on(lanes, row, numbers)
    return row, lanes.lesser(before, found)


_run_greatest_back = row_loop(backwards=True)(_greatest_back)
_run_least_back = row_loop(backwards=True)(_least_back)
_run_greatest_on, _run_least_on = row_loop()(_greatest_on), row_loop()(_least_on)
_join_greatest_on, _join_least_on = row_loop()(_greatest_on_beside), row_loop()(_least_on_beside)


@uncounted
def extrema_from(is_greatest: bool, source: Floats, start: float, row: Floats, target: Floats) -> None:
    """Enter the extremum of a number and of all numbers from each on.

    Args:
        row: (ROW,), room to work in.
    """
    count, value = len(target), start
    rest = count % ROW
    if count >= ROW:
        row[:] = start
        shape = count // ROW, ROW
        numbers, rows = source[rest:count].reshape(shape), target[rest:].reshape(shape)
        if is_greatest:
            _run_greatest_back(row, numbers, rows)
        else:
            _run_least_back(row, numbers, rows)
        value = row[0]
    for k in range(1, rest + 1):
        value = either(is_greatest, value, source[rest - k])
        target[rest - k] = value


@uncounted
def extrema_up_to(is_greatest: bool, source: Floats, start: float, row: Floats, target: Floats) -> None:
    """Enter the extremum of a number and of all numbers up to each (see `extrema_from`)."""
    count, value = len(target), start
    whole = count - count % ROW
    if count >= ROW:
        row[:] = start
        shape = count // ROW, ROW
        numbers, rows = source[:whole].reshape(shape), target[:whole].reshape(shape)
        if is_greatest:
            _run_greatest_on(row, numbers, rows)
        else:
            _run_least_on(row, numbers, rows)
        value = row[0]
    for k in range(whole, count):
        value = either(is_greatest, value, source[k])
        target[k] = value


@uncounted
def join_extrema_up_to(is_greatest: bool, source: Floats, start: float, row: Floats, target: Floats) -> None:
    """Join numbers with what `extrema_up_to` enters."""
    count, value = len(target), start
    whole = count - count % ROW
    if count >= ROW:
        row[:] = start
        shape = count // ROW, ROW
        numbers, rows = source[:whole].reshape(shape), target[:whole].reshape(shape)
        if is_greatest:
            _join_greatest_on(row, numbers, rows, rows)
        else:
            _join_least_on(row, numbers, rows, rows)
        value = row[0]
    for k in range(whole, count):
        value = either(is_greatest, value, source[k])
        target[k] = either(is_greatest, target[k], value)


def _let_through(lanes: Lanes, join: Any, limit: Any, row: Any, lefts: Any, rights: Any, side: int) -> Any:
    """Return what an operator with a left operand finds from each number of a row on, or up to each.

    What so many numbers do together is what one does: they limit what comes from beyond, and join it.
    """
    for by in _APART:
        rights = join(rights, limit(lefts, lanes.moved(rights, side * by)))
        lefts = limit(lefts, lanes.moved(lefts, side * by))
    found = join(rights, limit(lefts, row))
    return lanes.spread(found, 0 if side > 0 else ROW - 1), found


def _until_back(lanes: Lanes, row: Any, lefts: Any, rights: Any) -> Any:
    return _let_through(lanes, lanes.greater, lanes.lesser, row, lefts, rights, 1)


def _release_back(lanes: Lanes, row: Any, lefts: Any, rights: Any) -> Any:
    return _let_through(lanes, lanes.lesser, lanes.greater, row, lefts, rights, 1)


def _since_on(lanes: Lanes, row: Any, lefts: Any, rights: Any) -> Any:
    return _let_through(lanes, lanes.greater, lanes.lesser, row, lefts, rights, -1)


def _trigger_on(lanes: Lanes, row: Any, lefts: Any, rights: Any) -> Any:
    return _let_through(lanes, lanes.lesser, lanes.greater, row, lefts, rights, -1)


_run_until_back = row_loop(backwards=True)(_until_back)
_run_release_back = row_loop(backwards=True)(_release_back)
_run_since_on, _run_trigger_on = row_loop()(_since_on), row_loop()(_trigger_on)


@uncounted
def found_along(
    is_strong: bool, is_ahead: bool, left: Floats, right: Floats, row: Floats, target: Floats
) -> None:
    """Enter what an operator with a left operand finds from each number on, or up to each, and no further.

    Args:
        is_strong: whether it is an until or a since, or else a release or a trigger.
        row: (ROW,), room to work in.
    """
    count, value = len(target), -np.inf if is_strong else np.inf
    rest = count % ROW
    begin, end = (rest, count) if is_ahead else (0, count - rest)
    if begin < end:
        row[:] = value
        shape = (end - begin) // ROW, ROW
        lefts, rights = left[begin:end].reshape(shape), right[begin:end].reshape(shape)
        rows = target[begin:end].reshape(shape)
        if is_strong and is_ahead:
            _run_until_back(row, lefts, rights, rows)
        elif is_ahead:
            _run_release_back(row, lefts, rights, rows)
        elif is_strong:
            _run_since_on(row, lefts, rights, rows)
        else:
            _run_trigger_on(row, lefts, rights, rows)
        value = row[0]
    for step in range(rest):
        k = rest - 1 - step if is_ahead else end + step
        value = either(is_strong, right[k], either(not is_strong, left[k], value))
        target[k] = value

"""Rows of numbers joined with each other, one at a time or many neighbouring ones one after the other.

A formula is here for the greater and for the lesser number; which of them it is, is asked once for a loop.
What is joined are rows, arrays of rows, or numbers that stand for a row of nothing else (see `row_loop`).
"""

from __future__ import annotations

from typing import Any

from spatial_replay.compiled import inlined, row_code, row_loop
from spatial_replay.compiler import Lanes
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.online.sliding import greater, lesser


@row_code
def fill_row(lanes: Lanes, values: Any) -> Any:
    """Copy a row, or fill one with a number."""
    return values


@row_code
def fill_row_until(lanes: Lanes, at: Any, value: Any, row: Any) -> Any:
    """Fill a row with a number up to a place."""
    return lanes.parted(at, value, row)


@row_loop()
def repeat(lanes: Lanes, row: Any) -> Any:
    """Copy one row into many."""
    return row


# -------------------------------------------------------------------------------------------- formulas


def _greater_from(lanes: Lanes, row: Any, at: Any, other: Any) -> Any:
    return lanes.parted(at, row, lanes.greater(row, other))


def _lesser_from(lanes: Lanes, row: Any, at: Any, other: Any) -> Any:
    return lanes.parted(at, row, lanes.lesser(row, other))


def _greater_later(lanes: Lanes, row: Any, at: Any, other: Any) -> Any:
    return _greater_from(lanes, row, lanes.later(at), other)


def _lesser_later(lanes: Lanes, row: Any, at: Any, other: Any) -> Any:
    return _lesser_from(lanes, row, lanes.later(at), other)


def _greater_beside(lanes: Lanes, row: Any, other: Any, before: Any) -> Any:
    found = lanes.greater(row, other)
    return found, lanes.greater(before, found)


def _lesser_beside(lanes: Lanes, row: Any, other: Any, before: Any) -> Any:
    found = lanes.lesser(row, other)
    return found, lanes.lesser(before, found)


def _greater_later_beside(lanes: Lanes, row: Any, at: Any, other: Any, before: Any) -> Any:
    found = _greater_later(lanes, row, at, other)
    return found, lanes.greater(before, found)


def _lesser_later_beside(lanes: Lanes, row: Any, at: Any, other: Any, before: Any) -> Any:
    found = _lesser_later(lanes, row, at, other)
    return found, lanes.lesser(before, found)


def _greater_than(lanes: Lanes, row: Any, before: Any) -> Any:
    return row, lanes.greater(before, row)


def _lesser_than(lanes: Lanes, row: Any, before: Any) -> Any:
    return row, lanes.lesser(before, row)


def _each_greater(lanes: Lanes, row: Any, first: Any, second: Any) -> Any:
    return row, lanes.greater(first, second)


def _each_lesser(lanes: Lanes, row: Any, first: Any, second: Any) -> Any:
    return row, lanes.lesser(first, second)


def _strong(lanes: Lanes, row: Any, left: Any, right: Any) -> Any:
    return lanes.greater(lanes.lesser(row, left), right)


def _weak(lanes: Lanes, row: Any, left: Any, right: Any) -> Any:
    return lanes.lesser(lanes.greater(row, left), right)


_one_greater, _one_lesser = row_code(greater), row_code(lesser)
_one_greater_from, _one_lesser_from = row_code(_greater_from), row_code(_lesser_from)
_all_greater, _all_lesser = row_loop(is_last_only=True)(greater), row_loop(is_last_only=True)(lesser)
_all_greater_from = row_loop(is_last_only=True)(_greater_later)
_all_lesser_from = row_loop(is_last_only=True)(_lesser_later)
_on_greater, _on_lesser = row_loop()(greater), row_loop()(lesser)
_back_greater, _back_lesser = row_loop(backwards=True)(greater), row_loop(backwards=True)(lesser)
_back_greater_from = row_loop(backwards=True)(_greater_later)
_back_lesser_from = row_loop(backwards=True)(_lesser_later)
_extend_greater, _extend_lesser = row_loop()(_greater_beside), row_loop()(_lesser_beside)
_extend_greater_from = row_loop()(_greater_later_beside)
_extend_lesser_from = row_loop()(_lesser_later_beside)
_repeat_greater, _repeat_lesser = row_loop()(_greater_than), row_loop()(_lesser_than)
_join_each_greater, _join_each_lesser = row_loop()(_each_greater), row_loop()(_each_lesser)
_since, _trigger = row_loop()(_strong), row_loop()(_weak)
_until, _release = row_loop(backwards=True)(_strong), row_loop(backwards=True)(_weak)


# ----------------------------------------------------------------------------------------- joined rows


@inlined
def join_rows(is_greatest: bool, first: Floats, second: Any, target: Floats) -> None:
    """Fill a row with the greater, or the lesser, of each two numbers; `target` may be one of the rows."""
    if is_greatest:
        _one_greater(first, second, target)
    else:
        _one_lesser(first, second, target)


@inlined
def join_rows_from(is_greatest: bool, first: Floats, at: int, second: Any, target: Floats) -> None:
    """Join the samples from a place on, and copy those before (see `join_rows`)."""
    if is_greatest:
        _one_greater_from(first, at, second, target)
    else:
        _one_lesser_from(first, at, second, target)


@inlined
def join_all(is_greatest: bool, row: Floats, rows: Any) -> None:
    """Join a row with many."""
    if is_greatest:
        _all_greater(row, rows)
    else:
        _all_lesser(row, rows)


@inlined
def join_all_from(is_greatest: bool, row: Floats, at: int, rows: Any) -> None:
    """The same for the samples from a place on, which is one later for each next row."""
    if is_greatest:
        _all_greater_from(row, at, rows)
    else:
        _all_lesser_from(row, at, rows)


@inlined
def join_each(is_greatest: bool, row: Floats, first: Any, second: Any, target: Floats) -> None:
    """Join each two rows at the same place; `row` is any row, which stays as it is."""
    if is_greatest:
        _join_each_greater(row, first, second, target)
    else:
        _join_each_lesser(row, first, second, target)


@inlined
def repeat_joined(is_greatest: bool, row: Floats, before: Any, target: Floats) -> None:
    """Join one row with each of many."""
    if is_greatest:
        _repeat_greater(row, before, target)
    else:
        _repeat_lesser(row, before, target)


@inlined
def run_on(is_greatest: bool, row: Floats, rows: Any, target: Floats) -> None:
    """Join a row with many, the first one first, and store it after each."""
    if is_greatest:
        _on_greater(row, rows, target)
    else:
        _on_lesser(row, rows, target)


@inlined
def run_back(is_greatest: bool, row: Floats, rows: Any, target: Floats) -> None:
    """Join a row with many, the last one first, and store it after each."""
    if is_greatest:
        _back_greater(row, rows, target)
    else:
        _back_lesser(row, rows, target)


@inlined
def run_back_from(is_greatest: bool, row: Floats, at: int, rows: Any, target: Floats) -> None:
    """The same for the samples from a place on, which is one later for each next row."""
    if is_greatest:
        _back_greater_from(row, at, rows, target)
    else:
        _back_lesser_from(row, at, rows, target)


@inlined
def extend(is_greatest: bool, row: Floats, rows: Any, before: Any, target: Floats) -> None:
    """Join a row with many, the first one first, and store it after each, joined with what comes before."""
    if is_greatest:
        _extend_greater(row, rows, before, target)
    else:
        _extend_lesser(row, rows, before, target)


@inlined
def extend_from(is_greatest: bool, row: Floats, at: int, rows: Any, before: Any, target: Floats) -> None:
    """The same for the samples from a place on, which is one later for each next row."""
    if is_greatest:
        _extend_greater_from(row, at, rows, before, target)
    else:
        _extend_lesser_from(row, at, rows, before, target)


@inlined
def run_unbounded(
    is_strong: bool, is_ahead: bool, row: Floats, left: Any, right: Any, target: Floats
) -> None:
    """Run an until or release back from a row, a since or trigger on from it; store it after each."""
    if is_ahead and is_strong:
        _until(row, left, right, target)
    elif is_ahead:
        _release(row, left, right, target)
    elif is_strong:
        _since(row, left, right, target)
    else:
        _trigger(row, left, right, target)

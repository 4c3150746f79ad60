"""Rows of numbers joined with each other, one at a time or many neighbouring ones one after the other.

Most are here twice, for the greater and for the lesser number: which of them it is, is asked once for a loop.
"""

from __future__ import annotations

from typing import Any

from spatial_replay.compiled import inlined, row_code, row_loop
from spatial_replay.compiler import Lanes
from spatial_replay.geometry.arrays import Floats


@row_code
def fill_row(lanes: Lanes, values: Any) -> Any:
    """Copy a row, or fill one with a number."""
    return values


@row_code
def fill_row_until(lanes: Lanes, at: Any, value: Any, row: Any) -> Any:
    """Fill a row with a number up to a place."""
    return lanes.parted(at, value, row)


@row_code
def greater(lanes: Lanes, first: Any, second: Any) -> Any:
    return lanes.greater(first, second)


@row_code
def lesser(lanes: Lanes, first: Any, second: Any) -> Any:
    return lanes.lesser(first, second)


@row_code
def greater_from(lanes: Lanes, at: Any, first: Any, second: Any) -> Any:
    return lanes.parted(at, first, lanes.greater(first, second))


@row_code
def lesser_from(lanes: Lanes, at: Any, first: Any, second: Any) -> Any:
    return lanes.parted(at, first, lanes.lesser(first, second))


@row_loop()
def run_greater(lanes: Lanes, row: Any, other: Any) -> Any:
    return lanes.greater(row, other)


@row_loop()
def run_lesser(lanes: Lanes, row: Any, other: Any) -> Any:
    return lanes.lesser(row, other)


@row_loop(backwards=True)
def run_back_greater(lanes: Lanes, row: Any, other: Any) -> Any:
    return lanes.greater(row, other)


@row_loop(backwards=True)
def run_back_lesser(lanes: Lanes, row: Any, other: Any) -> Any:
    return lanes.lesser(row, other)


@row_loop(backwards=True)
def run_back_greater_from(lanes: Lanes, row: Any, at: Any, other: Any) -> Any:
    return lanes.parted(lanes.later(at), row, lanes.greater(row, other))


@row_loop(backwards=True)
def run_back_lesser_from(lanes: Lanes, row: Any, at: Any, other: Any) -> Any:
    return lanes.parted(lanes.later(at), row, lanes.lesser(row, other))


@row_loop()
def extend_greater(lanes: Lanes, row: Any, other: Any, before: Any) -> Any:
    found = lanes.greater(row, other)
    return found, lanes.greater(before, found)


@row_loop()
def extend_lesser(lanes: Lanes, row: Any, other: Any, before: Any) -> Any:
    found = lanes.lesser(row, other)
    return found, lanes.lesser(before, found)


@row_loop()
def extend_greater_from(lanes: Lanes, row: Any, at: Any, other: Any, before: Any) -> Any:
    found = lanes.parted(lanes.later(at), row, lanes.greater(row, other))
    return found, lanes.greater(before, found)


@row_loop()
def extend_lesser_from(lanes: Lanes, row: Any, at: Any, other: Any, before: Any) -> Any:
    found = lanes.parted(lanes.later(at), row, lanes.lesser(row, other))
    return found, lanes.lesser(before, found)


@row_loop(is_last_only=True)
def join_greater(lanes: Lanes, row: Any, other: Any) -> Any:
    return lanes.greater(row, other)


@row_loop(is_last_only=True)
def join_lesser(lanes: Lanes, row: Any, other: Any) -> Any:
    return lanes.lesser(row, other)


@row_loop()
def repeat(lanes: Lanes, row: Any) -> Any:
    return row


@row_loop()
def repeat_greater(lanes: Lanes, row: Any, before: Any) -> Any:
    return row, lanes.greater(before, row)


@row_loop()
def repeat_lesser(lanes: Lanes, row: Any, before: Any) -> Any:
    return row, lanes.lesser(before, row)


@row_loop()
def each_greater(lanes: Lanes, row: Any, first: Any, second: Any) -> Any:
    return row, lanes.greater(first, second)


@row_loop()
def each_lesser(lanes: Lanes, row: Any, first: Any, second: Any) -> Any:
    return row, lanes.lesser(first, second)


@row_loop()
def run_since(lanes: Lanes, row: Any, left: Any, right: Any) -> Any:
    return lanes.greater(lanes.lesser(row, left), right)


@row_loop()
def run_trigger(lanes: Lanes, row: Any, left: Any, right: Any) -> Any:
    return lanes.lesser(lanes.greater(row, left), right)


@row_loop(backwards=True)
def run_until(lanes: Lanes, row: Any, left: Any, right: Any) -> Any:
    return lanes.greater(lanes.lesser(row, left), right)


@row_loop(backwards=True)
def run_release(lanes: Lanes, row: Any, left: Any, right: Any) -> Any:
    return lanes.lesser(lanes.greater(row, left), right)


@inlined
def join_rows(is_greatest: bool, first: Floats, second: Floats, target: Floats) -> None:
    """Fill a row with the greater, or the lesser, of each two numbers; `target` may be one of the rows."""
    if is_greatest:
        greater(first, second, target)
    else:
        lesser(first, second, target)


@inlined
def join_number(is_greatest: bool, first: Floats, number: float, target: Floats) -> None:
    """Join a row with a number (see `join_rows`)."""
    if is_greatest:
        greater(first, number, target)
    else:
        lesser(first, number, target)


@inlined
def join_rows_from(is_greatest: bool, first: Floats, second: Floats, target: Floats, begin: int) -> None:
    """Join the samples from `begin` on, and copy those before."""
    if is_greatest:
        greater_from(begin, first, second, target)
    else:
        lesser_from(begin, first, second, target)


@inlined
def join_number_from(is_greatest: bool, first: Floats, number: float, target: Floats, begin: int) -> None:
    if is_greatest:
        greater_from(begin, first, number, target)
    else:
        lesser_from(begin, first, number, target)

"""Numbers of many messages, gathered from columns into the rows that templates take, in one compiled pass.

Other threads run during that pass. Each number goes straight from where it was computed to its message.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from spatial_replay.compiled import bytes_at, copying_kernel, floats_at, inlined, integers_at
from spatial_replay.geometry.arrays import Floats, Integers


class Columns(NamedTuple):
    """Numbers that messages have side by side.

    Attributes:
        numbers: (R, k), words of 8 bytes, or bytes; of any strides.
        rows: (n,) int64, the row of each message; None if messages have one row each, in order.
        is_rounded: whether messages have them as `rounded` gives them.
    """

    numbers: NDArray[Any]
    rows: Integers | None = None
    is_rounded: bool = False


def runs(rows: Floats, count: int) -> Floats:
    """Return, of rows (R, k), from each on as many as that side by side: (R - count + 1, count * k)."""
    rows = np.ascontiguousarray(rows)
    shape = max(len(rows) - count + 1, 0), count * rows.shape[1]
    return as_strided(rows, shape, rows.strides, writeable=False)


def gathered(columns: Sequence[Columns], count: int, kind: type = np.uint64) -> NDArray[Any]:
    """Return the rows (count, N) of messages, which have all columns one after the other.

    Args:
        kind: that of the result, whose size all numbers have.
    """
    table = np.zeros((len(columns), _FIELDS), np.int64)
    kept = []
    for row, (numbers, rows, is_rounded) in zip(table, columns, strict=True):
        rows = None if rows is None else np.ascontiguousarray(rows)
        rows_at = 0 if rows is None else rows.ctypes.data
        row[:] = (_place(numbers), *numbers.strides, numbers.shape[1], rows_at, is_rounded)
        kept.append(rows)
    out: NDArray[Any] = np.empty((count, int(table[:, _COUNT].sum())), kind)
    if out.size:
        _gather(table, _POWERS, out.ctypes.data, count, out.shape[1], out.itemsize)
    return out


def _place(numbers: NDArray[Any]) -> int:
    return int(numbers.__array_interface__["data"][0])


_AT, _ROW, _COLUMN, _COUNT, _ROWS, _IS_ROUNDED = range(6)
_FIELDS: Final = 6
"""Of each of `Columns`: the address, the strides of rows and of columns, how many columns there are, the
address of the rows or 0, and whether numbers are rounded."""

_TILE: Final = 128
"""Messages that get a column at once: what is written stays within the processor's cache."""

_POWERS: Final = np.array([float(f"1e{digits}") for digits in range(20)])
_POWERS.flags.writeable = False


def _gather_by_columns(
    table: Integers, powers: Floats, out_at: int, count: int, width: int, size: int
) -> None:
    """Do what `_gather` does, the same columns of all messages together."""
    at, kind = (bytes_at, np.uint8) if size == 1 else (integers_at, np.int64)
    out, begin = at(out_at, (count, width)), 0
    for address, *strides, columns, rows_at, is_rounded in table.tolist():
        rows = integers_at(rows_at, count) if rows_at else np.arange(count)
        shape = int(rows.max()) + 1, columns
        numbers = as_strided(np.asarray(at(address, 1), kind), shape, strides)[rows]
        if is_rounded:
            numbers = rounded(numbers.view(np.float64)).view(np.int64)
        out[:, begin : begin + columns] = numbers
        begin += columns


@copying_kernel(_gather_by_columns)
def _gather(table: Integers, powers: Floats, out_at: int, count: int, width: int, size: int) -> None:
    """Fill in rows (count, width) of numbers of a size; see `_FIELDS` for the table."""
    for first in range(0, count, _TILE):
        last = min(first + _TILE, count)
        to = out_at + first * width * size
        for s in range(table.shape[0]):
            columns, rows_at = table[s, _COUNT], table[s, _ROWS]
            source, down, across = table[s, _AT], table[s, _ROW], table[s, _COLUMN]
            if size == 8 and across == 8 and not table[s, _IS_ROUNDED]:
                # side by side as in messages: row by row
                for i in range(first, last):
                    row = integers_at(rows_at + 8 * i, 1)[0] if rows_at else i
                    place, target = source + row * down, to + (i - first) * width * 8
                    for k in range(columns):
                        integers_at(target, columns)[k] = integers_at(place, columns)[k]
                to += 8 * columns
                continue
            for _ in range(columns):
                if size == 1:
                    for i in range(first, last):
                        row = integers_at(rows_at + 8 * i, 1)[0] if rows_at else i
                        bytes_at(to + (i - first) * width, 1)[0] = bytes_at(source + row * down, 1)[0]
                elif table[s, _IS_ROUNDED]:
                    for i in range(first, last):
                        place = source + down * (integers_at(rows_at + 8 * i, 1)[0] if rows_at else i)
                        number, word = floats_at(place, 1)[0], integers_at(place, 1)[0]
                        floats_at(to + (i - first) * width * 8, 1)[0] = _four_digits(number, word, powers)
                else:
                    for i in range(first, last):
                        place = source + down * (integers_at(rows_at + 8 * i, 1)[0] if rows_at else i)
                        integers_at(to + (i - first) * width * 8, 1)[0] = integers_at(place, 1)[0]
                source, to = source + across, to + size


@inlined
def _four_digits(number: float, word: int, powers: Floats) -> float:
    """Return a number, which is also given as a word, as `rounded` does."""
    size = abs(number)
    if not (1e-15 <= size < 1e15):
        return number
    # the exponent of two times log10(2): what is left of the number has four digits or five before the point
    digits = 3 - (((word >> 52 & 0x7FF) - 1023) * 1233 >> 12)
    power: float = powers[abs(digits)]
    scaled = number * power if digits >= 0 else number / power
    if abs(scaled) >= 10_000.0:
        digits -= 1
        power = powers[abs(digits)]
        scaled = number * power if digits >= 0 else number / power
    whole = nearest_whole(scaled)
    return whole / power if digits >= 0 else whole * power


@inlined
def nearest_whole(number: float) -> float:
    """Return the nearest whole number as `np.round` does, the even one of two."""
    return (number + _WHOLE) - _WHOLE


_WHOLE: Final = 1.5 * 2.0**52
"""Added to a number that is not large, it leaves no room for digits after the point."""

_TOGETHER: Final = 4096
"""Numbers that are rounded at once: all passes over them stay within the processor's cache."""


def rounded(numbers: Floats) -> Floats:
    """Return numbers with four digits, so that viewers print them short; very large and small ones stay."""
    shown = np.array(numbers, np.float64, order="C")
    flat = shown.reshape(-1)
    for begin in range(0, len(flat), _TOGETHER):
        part = flat[begin : begin + _TOGETHER]
        part[:] = _rounded(part)
    return shown


def _rounded(numbers: Floats) -> Floats:
    size = np.abs(numbers)
    is_usual = (size >= 1e-15) & (size < 1e15)
    usual = numbers
    if not is_usual.all():
        size, usual = np.where(is_usual, size, 1.0), np.where(is_usual, numbers, 0.0)
    digits = (3.0 - np.floor(np.log10(size))).astype(np.int64)
    power = _POWERS[np.abs(digits)]
    # quotients and products of whole numbers, so that the result is the number nearest to those digits
    shown = np.round(usual * power) / power
    if (digits < 0).any():
        shown = np.where(digits < 0, np.round(usual / power) * power, shown)
    return np.where(is_usual, shown, numbers) if usual is not numbers else shown

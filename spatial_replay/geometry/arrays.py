"""Array types, ragged rows, and tables as dataclasses of columns.

Ragged rows keep rows of unequal length in one flat array: row r is `values[start[r] : start[r + 1]]`.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import cache
from itertools import chain
from typing import Any, Final, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.int8]
Booleans: TypeAlias = NDArray[np.bool_]

Empty: TypeAlias = Callable[[tuple[int, ...]], Floats]
"""Allocator of arrays of a shape, like `numpy.empty`; the numbers are not set."""


_Number = TypeVar("_Number", np.float64, np.int64)

_LARGE_BYTES: Final = 2**24
"""Least size of arrays in a temporary file, bytes. If the disk is full, arrays stay in memory."""


def roomy(shape: tuple[int, ...], dtype: type[_Number]) -> NDArray[_Number]:
    """Return an array whose numbers are not set; a large array is mapped from a temporary file.

    The system can write pages of a mapped file to disk. So a long log needs disk instead of memory. For a
    million samples and 30 parts, memory fell from 0.64 to 0.25 GB.
    """
    size_bytes = np.dtype(dtype).itemsize * math.prod(shape)
    if size_bytes >= _LARGE_BYTES:
        with suppress(OSError), tempfile.TemporaryFile() as file:
            # without reserved blocks, a later write to a full disk would end the process with SIGBUS
            os.posix_fallocate(file.fileno(), 0, size_bytes)
            return np.frombuffer(mmap.mmap(file.fileno(), size_bytes), dtype).reshape(shape)
    return np.empty(shape, dtype)


def join_arrays(parts: Sequence[NDArray[_Number]], axis: int = 0) -> NDArray[_Number]:
    """Concatenate arrays of one type into a `roomy` array."""
    shape = list(parts[0].shape)
    shape[axis] = sum(part.shape[axis] for part in parts)
    return np.concatenate(parts, axis=axis, out=roomy(tuple(shape), parts[0].dtype.type))


def read_only_floats(values: ArrayLike) -> Floats:
    """Return a contiguous, read-only float64 view, or a copy where a view is not possible."""
    view = np.ascontiguousarray(values, dtype=np.float64).view()
    view.flags.writeable = False
    return view


def read_only_integers(values: ArrayLike) -> Integers:
    """Return a contiguous, read-only int64 view, or a copy where a view is not possible."""
    view = np.ascontiguousarray(values, dtype=np.int64).view()
    view.flags.writeable = False
    return view


def writable(values: NDArray[_Number]) -> NDArray[_Number]:
    """Return a contiguous, writable view, or a copy where a view is not possible.

    Numba gives read-only arrays another type, for which it would compile a kernel again.
    """
    view = np.ascontiguousarray(values).view()
    try:
        view.flags.writeable = True
    except ValueError:  # the owner of the memory is read-only
        return view.copy()
    return view


def starts_from_counts(counts: Sequence[int] | Integers) -> Integers:
    """Return the starts of n rows of the given lengths, then the end of the last row, (n + 1,)."""
    start = np.zeros(len(counts) + 1, np.int64)
    np.add.accumulate(np.asarray(counts, np.int64), out=start[1:])
    return start


def flat_index(first: Integers, counts: Integers) -> Integers:
    """Return the flat indices of the elements of rows starting at `first` (n,) with lengths `counts` (n,)."""
    if len(counts) and (counts == counts[0]).all():
        # the common case of equal lengths, such as only boxes
        return np.asarray((first[:, None] + np.arange(counts[0], dtype=np.int64)).reshape(-1))
    row_starts = starts_from_counts(counts)
    return np.asarray(np.repeat(first - row_starts[:-1], counts) + np.arange(row_starts[-1], dtype=np.int64))


def count_in_rows(flags: Booleans, start: Integers) -> Integers:
    """Return the number of set flags in each row; rows may be empty."""
    if not flags.any():
        return np.zeros(len(start) - 1, np.int64)
    running_counts = starts_from_counts(flags.astype(np.int64))
    return np.asarray(running_counts[start[1:]] - running_counts[start[:-1]])


_MOST: Final = 2**62
"""Largest product of column widths, so that combined codes fit into int64."""


def combined_code(columns: Iterable[NDArray[Any]], length: int) -> Integers:
    """Return a code per row (length,). Rows have equal codes exactly if they are equal in all columns."""
    code, code_count = np.zeros(length, np.int64), 1
    for column in columns:
        if not length or (column == column[0]).all():
            continue
        least_value = int(column.min())
        width = int(column.max()) - least_value + 1
        offsets = column.astype(np.int64) - least_value
        # ranks keep codes small before the product would overflow
        if code_count * width > _MOST:
            (code, code_count), (offsets, width) = _ranks(code), _ranks(offsets)
        code, code_count = code * width + offsets, code_count * width
    return code


def _ranks(column: Integers) -> tuple[Integers, int]:
    """Return dense ranks of numbers and the count of distinct numbers."""
    distinct_values, ranks = np.unique(column, return_inverse=True)
    return ranks.astype(np.int64), len(distinct_values)


def equal_places(code: Integers) -> Iterator[Integers]:
    """Yield for each distinct code the indices (K,) of its elements, in ascending order of codes."""
    if len(code) and (code == code[0]).all():
        yield np.arange(len(code))
        return
    code_order = np.argsort(code, kind="stable")
    group_starts = np.flatnonzero(np.diff(code[code_order])) + 1
    yield from (indices for indices in np.split(code_order, group_starts) if len(indices))


_Table = TypeVar("_Table")


def select(table: _Table, rows: Integers | slice) -> _Table:
    """Return the given rows of a dataclass of columns, in the given order.

    Arrays and sequences are columns with one element per row. Mappings are shared by all rows.
    """
    if isinstance(rows, slice):
        return _map_columns(table, lambda name: getattr(table, name)[rows])
    # `cache` converts the rows at most once, for the first column that is not an array
    row_numbers = cache(rows.tolist)

    def selected_column(name: str) -> Any:
        column = getattr(table, name)
        if isinstance(column, np.ndarray):
            return column[rows]
        return column.select(rows) if hasattr(column, "select") else [column[row] for row in row_numbers()]

    return _map_columns(table, selected_column)


def concatenate_tables(tables: Sequence[_Table]) -> _Table:
    """Join one or more dataclasses of columns by rows; mappings come from the last table (see `select`)."""
    if len(tables) == 1:
        return tables[0]

    def joined_column(name: str) -> Any:
        columns = [getattr(table, name) for table in tables]
        if isinstance(columns[0], np.ndarray):
            return np.concatenate(columns)
        column_types = [type(column) for column in columns if hasattr(column, "concatenate")]
        return column_types[0].concatenate(columns) if column_types else list(chain.from_iterable(columns))

    return _map_columns(tables[-1], joined_column)


def _map_columns(table: _Table, column: Callable[[str], Any]) -> _Table:
    names = (column_field.name for column_field in fields(cast(Any, table)))
    columns = {name: column(name) for name in names if not isinstance(getattr(table, name), Mapping)}
    return cast(_Table, replace(cast(Any, table), **columns))

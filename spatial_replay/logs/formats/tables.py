"""Metadata in JSON, and columns of Arrow and Parquet as arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from spatial_replay.errors import LogError, importing
from spatial_replay.geometry.arrays import Floats

if TYPE_CHECKING:
    import pyarrow as pa

_LARGEST_INFO: Final = 64 * 2**20
"""Largest metadata file, bytes."""


def read_head(file: Path) -> bytes:
    """Read a metadata file up to `_LARGEST_INFO`; return b"" for a missing file."""
    if not file.is_file():
        return b""
    with file.open("rb") as stream:
        return stream.read(_LARGEST_INFO)


def read_json(file: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        LogError: the file holds no JSON object.
    """
    try:
        value = json.loads(read_head(file))
    except (ValueError, RecursionError) as error:
        raise LogError(f"{file.name} is not JSON: {error}") from None
    if not isinstance(value, dict):
        raise LogError(f"{file.name} holds no JSON object")
    return value


def arrow() -> Any:
    """Return the library for Arrow and Parquet.

    Raises:
        UsageError: pyarrow is not installed.
    """
    with importing("data sets in Parquet need pyarrow", extra="datasets"):
        import pyarrow
        import pyarrow.compute
        import pyarrow.parquet
    return pyarrow


def numbers_from_column(column: pa.ChunkedArray) -> Floats | None:
    """Return a column as (T,) or (T, W) float64, null as NaN; None for texts, or lists of several lengths."""
    pyarrow = arrow()
    types = pyarrow.types
    array, list_widths = column.combine_chunks(), list[int]()
    if isinstance(array, pyarrow.ChunkedArray):
        array = array.chunk(0) if array.num_chunks else pyarrow.array([], column.type)
    row_count, is_null = len(array), np.zeros(0, np.bool_)
    while (
        types.is_list(array.type) or types.is_large_list(array.type) or types.is_fixed_size_list(array.type)
    ):
        if array.null_count and not list_widths:
            is_null = array.is_null().to_numpy(zero_copy_only=False)
        lengths = np.unique(pyarrow.compute.list_value_length(array).drop_null().to_numpy())
        if len(lengths) > 1:
            return None
        list_widths.append(int(lengths[0]) if len(lengths) else 0)
        array = array.flatten()
    if not (types.is_floating(array.type) or types.is_integer(array.type) or types.is_boolean(array.type)):
        return None
    if types.is_boolean(array.type):
        array = array.cast(pyarrow.uint8())
    if array.null_count or not types.is_float64(array.type):
        array = array.cast(pyarrow.float64(), safe=False)
    numbers = array.to_numpy(zero_copy_only=False)
    if not list_widths:
        return cast("Floats", numbers)
    width = int(np.prod(list_widths))
    if len(is_null) == 0:
        return cast("Floats", numbers.reshape(row_count, width))
    # `flatten` drops lists that are null
    padded_numbers = np.full((row_count, width), np.nan)
    padded_numbers[~is_null] = numbers.reshape(-1, width)
    return padded_numbers

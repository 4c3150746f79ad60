"""HDF5 files read with care: no data of other files, and no shapes larger than the file can hold.

HDF5 follows links into other files and allocates the shape that a file claims. Every object is looked at
before its numbers are read.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from spatial_replay.errors import LogError, importing
from spatial_replay.geometry.arrays import Floats

SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
MOST_BYTES: Final = 8 * 2**30
"""Bytes of one array in memory."""
_BEST_RATIO: Final = 1100
"""Bytes of data that one byte of a file holds at most: deflate reaches 1,032."""
_SMALL: Final = 2**26
"""Bytes of an array that need no look at the size of the file."""
_LARGEST_ATTRIBUTE: Final = 2**24
"""Bytes of an attribute."""
_DEEPEST: Final = 12
"""Groups inside each other, and soft links one after the other."""
_WIDEST: Final = 4096
"""Numbers a frame; more are an image."""


@contextmanager
def open_archive(path: Path) -> Iterator[Any]:
    """Open an HDF5 file, as a context.

    Raises:
        UsageError: h5py is not installed.
        LogError: the file is damaged, or in use by a writer.
    """
    with importing("data sets in HDF5 need h5py", extra="datasets"):
        import h5py
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        # damaged names, types and encodings are all of these in h5py
        raise LogError(
            f"{path.name} cannot be read: {first_line(error)}; close its writer or copy it again"
        ) from None


def first_line(error: Exception) -> str:
    return str(error.args[0] if error.args else error).splitlines()[0]


def member(group: Any, path: str, top: Any = None, depth: int = 0) -> Any | None:
    """Return an object at a path below a group; None if there is none.

    Args:
        top: the group that soft links may not leave; `group` itself by default.

    Raises:
        LogError: a link to another file or out of the group.
    """
    import h5py

    top = group if top is None else top
    for name in filter(None, path.split("/")):
        links, key = getattr(getattr(group, "id", None), "links", None), name.encode()
        if not isinstance(group, h5py.Group) or links is None or not links.exists(key):
            return None
        kind = links.get_info(key).type
        if kind == h5py.h5l.TYPE_HARD:
            group = group[name]
            continue
        place = f"{group.name.rstrip('/')}/{name}"
        if kind != h5py.h5l.TYPE_SOFT or depth == _DEEPEST:
            raise LogError(f"{place} is a link to another file, which is not read; {_COPY}")
        target = links.get_val(key).decode("utf-8", "replace")
        home = top.name.rstrip("/") + "/"
        absolute = target if target.startswith("/") else f"{group.name.rstrip('/')}/{target}"
        if home == "/" or not absolute.startswith(home):
            raise LogError(f"{place} is a link out of {top.name}, which is not followed; {_COPY}")
        group = member(top, absolute.removeprefix(home), top, depth + 1)
    return group


_COPY: Final = "copy its data into the file"


def names_in(group: Any) -> list[str]:
    """Return the names in a group, without looking at the objects."""
    # h5py gives names that are not UTF-8 as bytes
    return [name for name in group if isinstance(name, str)] if hasattr(group, "keys") else []


def arrays_in(top: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays below a group with their paths from it; links that leave it are left out."""
    import h5py

    visited: set[bytes] = set()

    def arrays(group: Any, prefix: str, depth: int) -> Iterator[tuple[str, Any]]:
        for name in names_in(group):
            try:
                item = member(group, name, top)
            except LogError:
                continue
            if isinstance(item, h5py.Dataset):
                yield f"{prefix}{name}", item
            elif isinstance(item, h5py.Group) and depth < _DEEPEST:
                # hard links may make circles
                address = h5py.h5o.get_info(item.id).addr
                if address not in visited:
                    visited.add(address)
                    yield from arrays(item, f"{prefix}{name}/", depth + 1)

    return arrays(top, "", 0)


def width_of(array: Any) -> int:
    """Return the numbers a frame of an array; 0 for images, texts and objects."""
    if array.dtype.kind not in "fiub" or array.shape is None or array.ndim == 0:
        return 0
    width = math.prod(array.shape[1:])
    is_image = array.dtype == np.uint8 and array.ndim > 2
    return 0 if is_image or width > _WIDEST else width


def numbers(array: Any, rows: slice = slice(None)) -> Floats:
    """Read an array as (T,) or (T, W) float64.

    Raises:
        LogError: it holds no numbers, or cannot be read without risk.
    """
    check_array(array)
    if width_of(array) == 0:
        raise LogError(f"{array.name} holds no numbers of frames: {array.dtype}, {array.shape}")
    try:
        with np.errstate(invalid="ignore"):
            values = np.asarray(array[rows], np.float64)
    except (OSError, RuntimeError, ValueError) as error:
        raise LogError(f"{array.name} cannot be read: {first_line(error)}; copy the file again") from None
    return values.reshape(len(values), -1) if values.ndim > 1 else values


def row_count(array: Any) -> int:
    """Return the number of rows of an array that can be read without risk, see `check_array`."""
    check_array(array)
    return int(array.shape[0])


def check_array(array: Any) -> None:
    """Refuse an array whose data are elsewhere, larger than the file can hold, or behind a missing filter.

    Raises:
        LogError: it is such an array.
    """
    import h5py

    if array.is_virtual or array.external:
        raise LogError(f"{array.name} has its data in other files, which are not read; {_COPY}")
    size = math.prod(array.shape or ()) * array.dtype.itemsize
    largest = max(size, math.prod(array.chunks or ()) * array.dtype.itemsize)
    held = array.file.id.get_filesize()
    if largest > max(_SMALL, _BEST_RATIO * held) or largest > MOST_BYTES:
        raise LogError(
            f"{array.name} claims {largest:,} bytes ({array.shape}) in a file of {held:,}: it is damaged, or"
            " too large"
        )
    settings = array.id.get_create_plist()
    for index in range(settings.get_nfilters()):
        code, _, _, name = settings.get_filter(index)
        if not h5py.h5z.filter_avail(code):
            filter_name = name.decode("utf-8", "replace").split(";")[0] or f"filter {code}"
            raise LogError(
                f"{array.name} is compressed by {filter_name}, which this h5py does not have; rewrite the"
                " file: h5repack -f GZIP=4 OLD NEW"
            )


def attribute(group: Any, name: str) -> Any | None:
    """Return an attribute with one value; None if there is none.

    Raises:
        LogError: it claims to be very large.
    """
    if name not in group.attrs:
        return None
    about = group.attrs.get_id(name)
    if math.prod(about.shape or ()) * about.dtype.itemsize > _LARGEST_ATTRIBUTE:
        raise LogError(f"the attribute {name} of {group.name} claims the shape {about.shape}; it is damaged")
    value = group.attrs[name]
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def text_attribute(group: Any, name: str) -> str:
    """Return an attribute that is a text; "" for any other."""
    value = attribute(group, name)
    return str(value) if isinstance(value, str) else ""


def json_attribute(group: Any, name: str) -> Mapping[str, Any]:
    """Return an attribute that is a JSON object; an empty one for any other."""
    try:
        value = json.loads(text_attribute(group, name) or "{}")
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def integer_attribute(group: Any, name: str) -> int | None:
    """Return an attribute that is an integer; None for any other."""
    value = attribute(group, name)
    return int(value) if isinstance(value, (int, np.integer)) and not isinstance(value, bool) else None

"""Safe reading of HDF5 files: no data of other files, and no shapes larger than the file can hold.

The HDF5 library follows links into other files and allocates any shape that a file claims. So every object
is checked before its numbers are read.
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
from spatial_replay.logs.formats.episodes import MOST_BYTES

# the limit of deflate: https://www.zlib.net/zlib_tech.html
_BEST_RATIO: Final = 1100
"""Largest compression ratio; deflate reaches 1,032."""
_SMALL: Final = 2**26
"""Largest array that is accepted in a file of any size, bytes."""
_LARGEST_ATTRIBUTE: Final = 2**24
"""Largest attribute, bytes."""
_DEEPEST: Final = 12
"""Deepest nesting of groups, and longest chain of soft links."""
_WIDEST: Final = 4096
"""Maximum width of a feature per frame, in numbers; a wider array counts as an image."""
_COPY: Final = "copy its data into the file"


@contextmanager
def open_archive(path: Path) -> Iterator[Group]:
    """Open an HDF5 file, as a context.

    Raises:
        UsageError: h5py is not installed.
        LogError: the file is damaged, or in use by a writer.
    """
    with importing("data sets in HDF5 need h5py", extra="datasets"):
        import h5py
    try:
        with h5py.File(path, "r") as file:
            yield Group(file)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        # h5py raises any of these errors for damaged names, types and encodings
        raise LogError(
            f"{path.name} cannot be read: {_first_line(error)}; close its writer or copy it again"
        ) from None


def _first_line(error: Exception) -> str:
    return str(error.args[0] if error.args else error).splitlines()[0]


class Group:
    """A group of an HDF5 file. Links to other files, and soft links out of the group `top`, are refused.

    Methods with a path raise LogError for a refused link.
    """

    def __init__(self, group: Any, top: Any = None) -> None:
        self._group, self._top = group, group if top is None else top

    @property
    def names(self) -> list[str]:
        """Names in the group, except names that are not UTF-8, which h5py gives as bytes."""
        return [name for name in self._group if isinstance(name, str)]

    def group(self, path: str) -> Group | None:
        """Return the group at a path; None if the path has no group."""
        node = self._node(path)
        return Group(node, self._top) if hasattr(node, "keys") else None

    def array(self, path: str) -> Any | None:
        """Return the array at a path, without its numbers; None for a single value or a missing array."""
        node = self._node(path)
        return node if getattr(node, "shape", None) else None

    def episode(self, path: str, place: str) -> Group:
        """Return the group of an episode; soft links in an episode must not lead out of its group.

        Raises:
            LogError: the path has no group.
        """
        node = self._node(path)
        if not hasattr(node, "keys"):
            raise LogError(f"{place}: {path.strip('/')} holds no episode")
        return Group(node)

    def arrays(self) -> Iterator[tuple[str, Any]]:
        """Yield the arrays below the group with their paths; refused links are left out."""
        import h5py

        visited_addresses: set[bytes] = set()

        def arrays(group: Any, prefix: str, depth: int) -> Iterator[tuple[str, Any]]:
            for name in Group(group).names:
                try:
                    node = Group(group, self._top)._node(name)
                except LogError:
                    continue
                if isinstance(node, h5py.Dataset):
                    yield f"{prefix}{name}", node
                elif isinstance(node, h5py.Group) and depth < _DEEPEST:
                    # hard links may form cycles
                    address = h5py.h5o.get_info(node.id).addr
                    if address not in visited_addresses:
                        visited_addresses.add(address)
                        yield from arrays(node, f"{prefix}{name}/", depth + 1)

        return arrays(self._group, "", 0)

    def _node(self, path: str, depth: int = 0) -> Any | None:
        import h5py

        group = self._group
        for name in filter(None, path.split("/")):
            links, link_name = getattr(getattr(group, "id", None), "links", None), name.encode()
            if not isinstance(group, h5py.Group) or links is None or not links.exists(link_name):
                return None
            # the type of a link is checked before h5py follows the link
            link_type = links.get_info(link_name).type
            if link_type == h5py.h5l.TYPE_HARD:
                group = group[name]
                continue
            place = f"{group.name.rstrip('/')}/{name}"
            if link_type != h5py.h5l.TYPE_SOFT or depth == _DEEPEST:
                raise LogError(f"{place} is a link to another file, which is not read; {_COPY}")
            target = links.get_val(link_name).decode("utf-8", "replace")
            top_path = self._top.name.rstrip("/") + "/"
            target_path = target if target.startswith("/") else f"{group.name.rstrip('/')}/{target}"
            if top_path == "/" or not target_path.startswith(top_path):
                raise LogError(f"{place} is a link out of {self._top.name}, which is not followed; {_COPY}")
            group = Group(self._top)._node(target_path.removeprefix(top_path), depth + 1)
        return group

    def attribute(self, name: str) -> Any | None:
        """Return the value of an attribute; None for a missing attribute.

        Raises:
            LogError: the attribute claims more than 16 MiB.
        """
        if name not in self._group.attrs:
            return None
        attribute_id = self._group.attrs.get_id(name)
        if math.prod(attribute_id.shape or ()) * attribute_id.dtype.itemsize > _LARGEST_ATTRIBUTE:
            raise LogError(
                f"the attribute {name} of {self._group.name} claims the shape {attribute_id.shape};"
                " it is damaged"
            )
        value = self._group.attrs[name]
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else value

    def text(self, name: str) -> str:
        """Return a text attribute; "" for a missing attribute, or for another type."""
        value = self.attribute(name)
        return str(value) if isinstance(value, str) else ""

    def integer(self, name: str) -> int | None:
        """Return an integer attribute; None for a missing attribute, or for another type."""
        value = self.attribute(name)
        return int(value) if isinstance(value, (int, np.integer)) and not isinstance(value, bool) else None

    def json(self, name: str) -> Mapping[str, Any]:
        """Return the JSON object in a text attribute; an empty object for any other attribute."""
        try:
            value = json.loads(self.text(name) or "{}")
        except (ValueError, RecursionError):
            return {}
        return value if isinstance(value, dict) else {}


def width_of(array: Any) -> int:
    """Return how many numbers an array has per frame; 0 for images, texts and objects."""
    if array.dtype.kind not in "fiub" or not array.shape:
        return 0
    width = math.prod(array.shape[1:])
    is_image = array.dtype == np.uint8 and array.ndim > 2
    return 0 if is_image or width > _WIDEST else width


def numbers(array: Any, rows: slice = slice(None)) -> Floats:
    """Read an array as (T,) or (T, W) float64.

    Raises:
        LogError: the array holds no numbers, is refused by `row_count`, or cannot be read.
    """
    row_count(array)
    if width_of(array) == 0:
        raise LogError(f"{array.name} holds no numbers of frames: {array.dtype}, {array.shape}")
    try:
        with np.errstate(invalid="ignore"):
            values = np.asarray(array[rows], np.float64)
    except (OSError, RuntimeError, ValueError) as error:
        raise LogError(f"{array.name} cannot be read: {_first_line(error)}; copy the file again") from None
    return values.reshape(len(values), -1) if values.ndim > 1 else values


def row_count(array: Any) -> int:
    """Check that reading an array is safe; return the array's number of rows.

    Raises:
        LogError: the array is in another file, larger than its own file, or needs a missing filter.
    """
    import h5py

    if array.is_virtual or array.external:
        raise LogError(f"{array.name} has its data in other files, which are not read; {_COPY}")
    array_bytes = math.prod(array.shape) * array.dtype.itemsize
    # HDF5 decompresses a whole chunk, even for one row
    largest_bytes = max(array_bytes, math.prod(array.chunks or ()) * array.dtype.itemsize)
    file_bytes = array.file.id.get_filesize()
    if largest_bytes > max(_SMALL, _BEST_RATIO * file_bytes) or largest_bytes > MOST_BYTES:
        raise LogError(
            f"{array.name} claims {largest_bytes:,} bytes ({array.shape}) in a file of {file_bytes:,}: it is"
            " damaged, or too large"
        )
    creation_settings = array.id.get_create_plist()
    for filter_index in range(creation_settings.get_nfilters()):
        filter_code, _, _, name = creation_settings.get_filter(filter_index)
        if not h5py.h5z.filter_avail(filter_code):
            filter_name = name.decode("utf-8", "replace").split(";")[0] or f"filter {filter_code}"
            raise LogError(
                f"{array.name} is compressed by {filter_name}, which this h5py does not have; rewrite the"
                " file: h5repack -f GZIP=4 OLD NEW"
            )
    return int(array.shape[0])

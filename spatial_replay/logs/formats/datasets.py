"""Find robot-learning data sets and their episodes by content."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from os import PathLike, fspath
from pathlib import Path
from typing import Final

from spatial_replay.errors import LogError, UsageError, system_reason
from spatial_replay.logs.formats.episodes import DataSet
from spatial_replay.logs.formats.hdf5 import open_hdf5
from spatial_replay.logs.formats.lerobot import open_lerobot
from spatial_replay.logs.formats.minari import open_minari
from spatial_replay.logs.formats.steps import open_npz

DATA_SET_ENDINGS: Final = (".hdf5", ".h5", ".npz")
"""File name endings of data sets."""
_ADDRESS: Final = re.compile(r"(.+)#(?:([0-9]{1,9})|[^#]*)", re.DOTALL)
FORMATS: Final[tuple[Callable[[Path], DataSet | None], ...]] = (
    open_lerobot,
    open_npz,
    open_hdf5,
    open_minari,
)
"""Functions that open a data set of one format, and return None for other formats."""


def data_set_address(text: str | PathLike[str]) -> tuple[str, int] | None:
    """Split an address such as `push_v3#17` into a data set's path and an episode's number, or return None.

    The name of an existing file is no address.

    Raises:
        UsageError: the text after the data set is not a number.
    """
    match = _ADDRESS.fullmatch(fspath(text))
    if match is None or "://" in match[1]:
        return None
    try:
        # the paths are texts, because paths of pathlib would take most of the time
        is_address = os.path.exists(match[1]) and not os.path.exists(match[0])  # noqa: PTH110
    except (OSError, ValueError):
        return None
    if is_address and match[2] is None and (data_set := open_data_set(match[1])) is not None:
        raise UsageError(f"{match[0]}: episodes go by number; {data_set.range_text}")
    return (match[1], int(match[2])) if is_address and match[2] is not None else None


def open_data_set(path: str | PathLike[str]) -> DataSet | None:
    """Open the data set in a folder or a file; None for a path without a data set.

    The last four data sets are cached until their files change.

    Raises:
        UsageError: a library is not installed, or the format is of an unknown version.
        LogError: the metadata of the data set cannot be read.
    """
    folder = Path(path)
    try:
        return _open(folder, _file_states(folder))
    except (OSError, ValueError) as error:
        raise LogError(f"{folder.name} cannot be read: {system_reason(error)}") from error


@lru_cache(maxsize=4)
def _open(path: Path, state: tuple[object, ...]) -> DataSet | None:
    data_sets = (open_format(path) for open_format in FORMATS)
    return next((data_set for data_set in data_sets if data_set is not None), None)


_DESCRIBING: Final = (
    *("", "/meta", "/meta/info.json", "/meta/episodes", "/meta/episodes.jsonl"),
    *("/metadata.json", "/data/metadata.json", "/data/main_data.hdf5"),
)
"""Files that describe a data set, as suffixes of the data set's path."""


def _file_states(path: Path) -> tuple[object, ...]:
    """Return a cache key: identity, size and modification time of the files that describe a data set."""
    # the paths are texts, because paths of pathlib would take most of the time
    files = [*(f"{path}{name}" for name in _DESCRIBING), f"{path.with_suffix('.json')}"]
    states = []
    for file in files:
        with suppress(FileNotFoundError, NotADirectoryError):
            state = os.stat(file)  # noqa: PTH116
            states.append((file, state.st_ino, state.st_size, state.st_mtime_ns))
    return tuple(states)

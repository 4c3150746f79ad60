"""Data sets of arrays over all steps. Flags mark the ends of episodes: OGBench in npz files, D4RL in HDF5."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.logs.formats.archive import Group, numbers, open_archive, width_of
from spatial_replay.logs.formats.episodes import (
    MOST_BYTES,
    DataSet,
    Episode,
    EpisodeColumns,
    Feature,
    Run,
)
from spatial_replay.logs.formats.mujoco import model_from_file
from spatial_replay.text import plural


class _Steps(DataSet):
    """A data set whose arrays cover the steps of all episodes.

    Attributes:
        qpos: name of the array of joint positions, which a model needs.
    """

    qpos = "qpos"

    def divide(self, is_end: Booleans, missing: str) -> None:
        """Divide the steps into episodes.

        Args:
            missing: predicate of the remark on a last episode without an end, such as "does not end with a
                terminal".
        """
        end_steps = np.flatnonzero(is_end)
        if len(is_end) and (len(end_steps) == 0 or end_steps[-1] != len(is_end) - 1):
            last_step_count = len(is_end) - 1 - (int(end_steps[-1]) if len(end_steps) else -1)
            self.remarks += (f"its last episode, of {plural(last_step_count, 'step')}, {missing}",)
            end_steps = np.append(end_steps, len(is_end) - 1)
        self._bounds = [0, *(end_steps + 1).tolist()]
        numbered_counts = enumerate(np.diff(self._bounds).tolist())
        self.episodes = tuple(Episode(number, str(number), count) for number, count in numbered_counts)

    def rows_of(self, episode: Episode) -> slice:
        """Return the rows of an episode."""
        return slice(self._bounds[episode.number], self._bounds[episode.number + 1])

    def count_states(self, run: Run) -> int:
        return run.episode.frames or 0

    def poses(self, run: Run, count: int) -> EpisodeColumns:
        columns = super().poses(run, count)
        model_file = run.reading.model
        if model_file is None:
            return columns
        qpos = self.read(run.group, {self.qpos}).get(self.qpos)
        if qpos is None:
            raise UsageError(
                f"{self.name} has no array {self.qpos!r} for `model`; name objects by `features:`"
            )
        model = model_from_file(model_file, run.reading.assets)
        bodies = model.bodies(qpos, f"{self.name}: {self.qpos}")
        return replace(columns, bodies=tuple(bodies), remarks=model.remarks)


class D4rl(_Steps):
    """A data set of D4RL: `terminals` and `timeouts` end episodes."""

    kind = "D4RL HDF5"

    def __init__(self, path: Path, file: Group) -> None:
        self.path = path
        terminals, timeouts = file.array("terminals"), file.array("timeouts")
        is_end = numbers(terminals).reshape(-1) > 0
        if timeouts is not None:
            is_end |= numbers(timeouts).reshape(-1) > 0
        self.divide(is_end, "has no terminal and no timeout")
        self.features = tuple(
            Feature(name, (), width_of(array))
            for name, array in file.arrays()
            if array.shape and array.shape[0] == len(is_end) and name not in ("terminals", "timeouts")
        )
        self.qpos = "infos/qpos" if self.feature("infos/qpos") else "qpos"

    @staticmethod
    def is_layout(file: Group) -> bool:
        """Return whether a file has the arrays of D4RL."""
        return file.array("terminals") is not None and file.array("observations") is not None

    @contextmanager
    def open_episode(self, episode: Episode) -> Iterator[tuple[Group, slice]]:
        with open_archive(self.path) as file:
            yield file, self.rows_of(episode)

    def read(self, group: tuple[Group, slice], names: AbstractSet[str]) -> dict[str, Floats]:
        file, rows = group
        arrays = {name: file.array(name) for name in names}
        return {name: numbers(array, rows) for name, array in arrays.items() if array is not None}


def open_npz(path: Path) -> DataSet | None:
    """Open a data set of OGBench; None if the file is not an npz file with the array `terminals`."""
    if path.suffix != ".npz" or not path.is_file():
        return None
    with _raising_log_errors(path), zipfile.ZipFile(path) as archive:
        is_ogbench = "terminals.npy" in archive.namelist()
    return _Npz(path) if is_ogbench else None


class _Npz(_Steps):
    """A data set of OGBench: `terminals` end episodes."""

    kind = "OGBench npz"

    def __init__(self, path: Path) -> None:
        self.path = path
        self._arrays: dict[str, Floats] = {}
        with _raising_log_errors(path):
            self._shapes = dict(self._read_shapes())
        is_end = self._array("terminals").reshape(-1) > 0
        self.divide(is_end, "does not end with a terminal")
        self.features = tuple(
            Feature(name, (), int(np.prod(shape[1:])))
            for name, shape in self._shapes.items()
            if name != "terminals" and shape[0] == len(is_end)
        )

    def _read_shapes(self) -> Iterator[tuple[str, tuple[int, ...]]]:
        """Yield the names and shapes of arrays of numbers."""
        with zipfile.ZipFile(self.path) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                with archive.open(entry) as stream:
                    # the header is checked first, so that no pickle and no too large array is loaded
                    shape, dtype = _npy_header(cast("BinaryIO", stream), f"{self.name}: {name}")
                if dtype.hasobject:
                    self.remarks += (f"{name} holds Python objects (a pickle), which are never loaded",)
                elif dtype.kind in "fiub" and shape:
                    size = int(np.prod([float(size) for size in shape])) * dtype.itemsize
                    if size > min(entry.file_size, MOST_BYTES):
                        raise LogError(
                            f"{self.name}: {name} has the shape {shape}, and {entry.file_size:,} bytes; it is"
                            " damaged, or too large"
                        )
                    yield name, shape

    def open_episode(self, episode: Episode) -> AbstractContextManager[slice]:
        return nullcontext(self.rows_of(episode))

    def read(self, group: slice, names: AbstractSet[str]) -> dict[str, Floats]:
        return {name: self._array(name)[group] for name in names if name in self._shapes}

    def _array(self, name: str) -> Floats:
        if name not in self._arrays:
            with _raising_log_errors(self.path), np.load(self.path, allow_pickle=False) as arrays:
                array = np.asarray(arrays[name], np.float64)
            self._arrays[name] = array.reshape(len(array), -1) if array.ndim > 1 else array
        return self._arrays[name]


@contextmanager
def _raising_log_errors(path: Path) -> Iterator[None]:
    """Convert the errors of reading a damaged archive to LogError."""
    try:
        yield
    except (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise LogError(f"{path.name} cannot be read: {error}; copy the file again") from None


def _npy_header(stream: BinaryIO, place: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the shape and the type of an array, without its numbers.

    Raises:
        LogError: the stream is not an array of NumPy.
    """
    npy_format = np.lib.format
    try:
        is_version_1 = npy_format.read_magic(stream) == (1, 0)
        read_header = npy_format.read_array_header_1_0 if is_version_1 else npy_format.read_array_header_2_0
        shape, _, dtype = read_header(stream)
    except ValueError as error:
        raise LogError(f"{place} is no array of NumPy: {error}") from None
    return shape, dtype

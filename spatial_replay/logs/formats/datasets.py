"""Find robot-learning data sets and their episodes by format; read those of LeRobot (v2, v3) and OGBench.

Only files below the folder of a data set are read: templates of paths in its metadata are not followed.
"""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from os import PathLike, fspath
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, cast

import numpy as np

from spatial_replay.errors import LogError, UsageError, system_reason
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.formats.episodes import (
    AS_STORED,
    Body,
    DataSet,
    Episode,
    EpisodeColumns,
    EpisodeReading,
    Feature,
    Label,
    as_label,
    frame_times_ns,
)
from spatial_replay.logs.formats.hdf5 import is_hdf5, open_hdf5
from spatial_replay.logs.formats.minari import is_minari, open_minari
from spatial_replay.logs.formats.mujoco import model_from_file
from spatial_replay.logs.formats.tables import arrow, numbers_from_column, read_head, read_json
from spatial_replay.text import counted, listed, nearest_hint

DATA_SET_ENDINGS: Final = (".hdf5", ".h5", ".npz")
"""Endings of the names of data sets that are files."""
_ADDRESS: Final = re.compile(r"(.+)#(?:([0-9]{1,9})|[^#]*)", re.DOTALL)
_MOST_BYTES: Final = 8 * 2**30
"""Bytes of the columns of one file, uncompressed."""


class Format(NamedTuple):
    """A format of data sets.

    Attributes:
        recognise: whether the folder or file at a path is of this format.
        open: the data set at that path.
    """

    recognise: Callable[[Path], bool]
    open: Callable[[Path], DataSet]


def data_set_address(text: str | PathLike[str]) -> tuple[str, int] | None:
    """Split `push_v3#17` into the path of a data set and a number; None if it is no such address.

    A file with that very name is no address.

    Raises:
        UsageError: the data set has something else than a number behind it.
    """
    match = _ADDRESS.fullmatch(fspath(text))
    if match is None or "://" in match[1]:
        return None
    try:
        # as texts: paths would take most of the time
        is_address = os.path.exists(match[1]) and not os.path.exists(match[0])  # noqa: PTH110
    except (OSError, ValueError):
        return None
    if is_address and match[2] is None and (data_set := open_data_set(match[1])) is not None:
        raise UsageError(f"{match[0]}: episodes go by number; {data_set.range_text}")
    return (match[1], int(match[2])) if is_address and match[2] is not None else None


def open_data_set(path: str | PathLike[str]) -> DataSet | None:
    """Open the data set in a folder or a file; None if it is none.

    The last few stay open while their files do not change.

    Raises:
        UsageError: a library is not installed, or the format is of an unknown version.
        LogError: its metadata cannot be read.
    """
    folder = Path(path)
    try:
        return _open(folder, _file_states(folder))
    except (OSError, ValueError) as error:
        raise LogError(f"{folder.name} cannot be read: {system_reason(error)}") from error


@lru_cache(maxsize=4)
def _open(path: Path, state: tuple[object, ...]) -> DataSet | None:
    return next((kind.open(path) for kind in FORMATS.values() if kind.recognise(path)), None)


_DESCRIBING: Final = (
    *("", "/meta", "/meta/info.json", "/meta/episodes", "/meta/episodes.jsonl"),
    *("/metadata.json", "/data/metadata.json", "/data/main_data.hdf5"),
)
"""Files of a data set that say what is in it."""


def _file_states(path: Path) -> tuple[object, ...]:
    """Return what changes with the files that say what is in a data set."""
    # as texts: paths would take most of the time
    files = [*(f"{path}{name}" for name in _DESCRIBING), f"{path.with_suffix('.json')}"]
    states = []
    for file in files:
        with suppress(FileNotFoundError, NotADirectoryError):
            state = os.stat(file)  # noqa: PTH116
            states.append((file, state.st_ino, state.st_size, state.st_mtime_ns))
    return tuple(states)


# ---------------------------------------------------------------------------------------------------- LeRobot

_SUCCESS: Final = "next.success"
_OWN_COLUMNS: Final = ("episode_index", "frame_index", "timestamp", "next.done")
_INDICES: Final = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index"})
"""Columns of LeRobot that say when and where a frame is."""
_TIME_ERROR_S: Final = 1e-3
"""A time in float32 may differ so much from the exact one, or by half a frame of it."""


def _is_lerobot(path: Path) -> bool:
    return path.is_dir() and (path / "meta" / "info.json").is_file()


class _LeRobot(DataSet):
    """A data set of LeRobot."""

    def __init__(self, path: Path) -> None:
        info = read_json(path / "meta" / "info.json")
        version = str(info.get("codebase_version") or "without codebase_version")
        if not re.match(r"v[23]\.", version):
            raise UsageError(
                f"{path.name} is LeRobot {version}; v2.0 to v3.x are read; convert it with lerobot's script"
            )
        self.path, self.kind, self.robot = path, f"LeRobot {version}", str(info.get("robot_type") or "")
        fps = info.get("fps")
        self.fps = float(fps) if isinstance(fps, (int, float)) and 0 < fps <= 1e9 else None
        features = info.get("features")
        self.features = tuple(_features(features if isinstance(features, dict) else {}))
        has_label = any(feature.name == _SUCCESS for feature in self.features)
        self.label = Label(_SUCCESS, is_about_next=True, is_stored=False) if has_label else None
        self._file_of, self.episodes, remarks = _episodes(path)
        self._files = sorted((path / "data").rglob("*.parquet"))
        self._file_by_end = {
            end: file for file in self._files for end in (file.name, f"{file.parent.name}/{file.name}")
        }
        self._rows: dict[Path, Mapping[int, tuple[int, int, bool]]] = {}
        total = info.get("total_episodes")
        if isinstance(total, int) and total != len(self.episodes):
            remarks.append(
                f"meta/info.json says {counted(total, 'episode')}, and meta has {len(self.episodes)}"
            )
        if info.get("chunks_size") == 1 and _lacks_files(path):
            remarks.append(
                "it looks like a copy by forge-robotics, which leaves out labels, poses of objects and names"
                " of numbers; use the original"
            )
        self.remarks = tuple(remarks)
        # a file, the columns that were looked for in it, and those that it has
        self._loaded: tuple[object, frozenset[str], Mapping[str, Floats]] = (None, frozenset(), {})

    def columns(
        self, number: int, reading: EpisodeReading = AS_STORED, features: Sequence[str] | None = None
    ) -> EpisodeColumns:
        """See `DataSet.columns`."""
        episode, fps = self.episode(number), self.required_fps(reading)
        label = self._label(reading)
        if features is None:
            features = [feature.name for feature in self.features if feature.width]
        wanted = {*features, *_OWN_COLUMNS, *([] if label is None else [label])}
        pieces = [
            {name: values[begin:end] for name, values in self._table(file, wanted).items()}
            for file, begin, end in self._places(number)
        ]
        whole = pieces[0] if len(pieces) == 1 else _join_pieces(pieces)
        frames = whole.get("frame_index", np.arange(len(whole["episode_index"]), dtype=np.float64))
        remarks = list(_remarks(whole, frames, fps, episode.frames))
        back = np.flatnonzero(np.diff(frames) <= 0)
        unjudged = ""
        if len(back):
            at = int(back[0])
            unjudged = (
                f"its frame_index goes from {frames[at]:g} to {frames[at + 1]:g} at row {at + 1}: more than"
                " one run is in the episode, so it is not judged; record each run as an episode"
            )
            frames = np.arange(len(frames), dtype=np.float64)
        return EpisodeColumns(
            frame_times_ns(frames.astype(np.int64), fps),
            {name: whole[name] for name in features if name in whole},
            success=None
            if label is None or label not in whole
            else as_label(whole[label], f"{self.name}: {label}"),
            remarks=tuple(remarks),
            unjudged=unjudged,
        )

    def files(self, number: int) -> list[Path]:
        """See `DataSet.files`."""
        meta = [self.path / "meta" / "info.json", self.path / "meta" / "episodes.jsonl"]
        meta += sorted((self.path / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
        return [file for file in meta if file.exists()] + [file for file, *_ in self._places(number)]

    def _label(self, reading: EpisodeReading) -> str | None:
        name = reading.label or (self.label.field if self.label else None)
        if reading.label is not None and self.feature(reading.label) is None:
            names = [feature.name for feature in self.features]
            hint = nearest_hint(reading.label, names) or f"it has {listed(names)}"
            raise UsageError(f"{self.name} has no feature {reading.label!r} for `label`; {hint}")
        return name

    def _places(self, number: int) -> list[tuple[Path, int, int]]:
        """Return the files with the rows of an episode, and where they begin and end in each.

        Raises:
            LogError: no file has them.
        """
        likely = self._file_of.get(number)
        named = self._file_by_end.get(likely or "")
        if named is not None and "episode_" in named.name and number in self._rows_of(named):
            places = [(named, *self._rows_of(named)[number])]
        else:
            # whatever the metadata says: files that were copied or merged have wrong numbers there
            places = [
                (file, *self._rows_of(file)[number]) for file in self._files if number in self._rows_of(file)
            ]
        if not places:
            file = f" ({likely} is missing)" if likely and named is None else ""
            raise LogError(
                f"{self.name}#{number}: no file in data/ has its rows{file}; download the whole data set"
            )
        if not all(is_whole for *_, is_whole in places):
            raise LogError(f"{self.name}#{number}: its rows lie between those of other episodes; sort them")
        return [(file, begin, end) for file, begin, end, _ in places]

    def _rows_of(self, file: Path) -> Mapping[int, tuple[int, int, bool]]:
        """Return where the rows of each episode begin and end in a file, and whether all are between."""
        if file not in self._rows:
            numbers = _read_columns(file, {"episode_index"}).get("episode_index")
            if numbers is None:
                raise LogError(f"{file.name} has no column episode_index")
            firsts = np.flatnonzero(np.diff(numbers, prepend=np.nan) != 0)
            ends = [*firsts[1:].tolist(), len(numbers)]
            rows: dict[int, tuple[int, int, bool]] = {}
            for first, end in zip(firsts.tolist(), ends, strict=True):
                number = int(numbers[first])
                is_whole = number not in rows
                rows[number] = (first, end, True) if is_whole else (rows[number][0], end, False)
            self._rows[file] = rows
        return self._rows[file]

    def _table(self, file: Path, wanted: set[str]) -> Mapping[str, Floats]:
        """Return columns of a file; those of the last file stay in memory."""
        key = (file, file.stat().st_mtime_ns)
        names, table = self._loaded[1:] if self._loaded[0] == key else (frozenset[str](), {})
        unread = wanted - names
        if unread:
            self._loaded = (key, names | wanted, {**table, **_read_columns(file, unread)})
        return self._loaded[2]


def _lacks_files(path: Path) -> bool:
    """Return whether the tables of episodes do not say in which files of data the episodes are."""
    tables = sorted((path / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
    return bool(tables) and "data/file_index" not in arrow().parquet.read_schema(tables[0]).names


def _features(features: Mapping[str, Any]) -> Iterator[Feature]:
    for name, about in features.items():
        about = about if isinstance(about, dict) else {}
        shape = about.get("shape")
        shape = [1] if not isinstance(shape, list) else [size for size in shape if isinstance(size, int)]
        width = int(np.prod(shape)) if about.get("dtype") not in ("video", "image", "string") else 0
        yield Feature(name, _places_of(about.get("names"), width), width)


def _places_of(names: object, width: int) -> tuple[str, ...]:
    """Return the names of the numbers of a feature: a list, or the only list in an object."""
    if isinstance(names, dict):
        lists = [part for part in names.values() if isinstance(part, list)]
        names = lists[0] if len(lists) == 1 else None
    if not isinstance(names, list) or len(names) != width or len(set(map(str, names))) != width:
        return ()
    return tuple(map(str, names))


def _episodes(path: Path) -> tuple[dict[int, str], tuple[Episode, ...], list[str]]:
    """Return the end of the path of each episode's file, the episodes, and remarks."""
    rows, remarks = list(_episode_rows(path)), []
    if not rows:
        remarks.append("meta has no episodes; their numbers are those in data/")
        files = sorted((path / "data").rglob("*.parquet"))
        numbers = {
            int(number)
            for file in files
            for number in _read_columns(file, {"episode_index"})["episode_index"]
        }
        rows = [{"episode_index": number} for number in numbers]
    by_number: dict[int, Mapping[str, Any]] = {}
    for row in rows:
        if isinstance(row.get("episode_index"), int):
            by_number.setdefault(row["episode_index"], row)
    if len(by_number) < len(rows):
        remarks.append(
            f"meta lists {counted(len(rows) - len(by_number), 'episode')} twice or without a number"
        )
    episodes = []
    file_of = {}
    for number, row in sorted(by_number.items()):
        tasks = row.get("tasks")
        task = next(iter(tasks), None) if isinstance(tasks, list) else tasks
        length = row.get("length")
        episodes.append(
            Episode(
                number,
                str(number),
                length if isinstance(length, int) else None,
                task if isinstance(task, str) and task else None,
            )
        )
        chunk, file = row.get("data/chunk_index"), row.get("data/file_index")
        file_of[number] = (
            f"episode_{number:06d}.parquet" if file is None else f"chunk-{chunk:03d}/file-{file:03d}.parquet"
        )
    return file_of, tuple(episodes), remarks


_EPISODE_COLUMNS: Final = ("episode_index", "tasks", "length", "data/chunk_index", "data/file_index")


def _episode_rows(path: Path) -> Iterator[Mapping[str, Any]]:
    # tools for repairs add tables of other names
    files = sorted((path / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
    if files:
        library = arrow()
        for file in files:
            try:
                present = [
                    name for name in library.parquet.read_schema(file).names if name in _EPISODE_COLUMNS
                ]
                yield from library.parquet.read_table(file, columns=present).to_pylist()
            except library.ArrowException as error:
                raise LogError(f"{file.relative_to(path)} cannot be read: {error}") from None
        return
    for number, line in enumerate(read_head(path / "meta" / "episodes.jsonl").splitlines(), 1):
        if line.strip():
            try:
                row = json.loads(line)
            except ValueError as error:
                raise LogError(f"meta/episodes.jsonl:{number}: the line is not JSON ({error})") from None
            if isinstance(row, dict):
                yield row


def _read_columns(file: Path, wanted: Iterable[str]) -> dict[str, Floats]:
    """Read columns of a Parquet file as float64; those that it does not have are left out.

    Raises:
        LogError: the file cannot be read.
    """
    library = arrow()
    try:
        with library.parquet.ParquetFile(file) as parquet:
            schema, rows = parquet.schema_arrow, parquet.metadata.num_rows
            names = [name for name in schema.names if name in wanted]
            if 8 * rows * max(1, len(names)) > _MOST_BYTES:
                raise LogError(f"{file.name} has {rows:,} rows; split it into smaller files")
            table = parquet.read(columns=names)
    except (OSError, library.ArrowException) as error:
        raise LogError(
            f"{file.name} cannot be read: {str(error).splitlines()[0]}; download it again"
        ) from None
    columns = ((name, numbers_from_column(table.column(name))) for name in table.column_names)
    return {name: values for name, values in columns if values is not None}


def _join_pieces(pieces: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
    names = set.intersection(*(set(piece) for piece in pieces))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def _remarks(
    columns: Mapping[str, Floats], frames: Floats, fps: float, expected: int | None
) -> Iterator[str]:
    """Yield remarks on the rows of an episode whose values are odd, although all are read."""
    if expected is not None and expected != len(frames):
        yield f"meta says {counted(expected, 'frame')}, and data has {len(frames)}"
    steps = np.diff(frames)
    odd = np.flatnonzero(steps != 1)
    if len(frames) and frames[0] != 0:
        yield f"its frame_index starts at {frames[0]:g}, and so its time at {frames[0] / fps:.3f} s"
    if len(odd) and (steps > 0).all():
        at = int(odd[0])
        yield f"its frame_index goes from {frames[at]:g} to {frames[at + 1]:g}: frames are missing"
    if "timestamp" in columns:
        off = np.abs(columns["timestamp"].reshape(-1) - frames / fps)
        at = int(np.nan_to_num(off, nan=0.0).argmax()) if len(off) else 0
        if len(off) and off[at] > max(_TIME_ERROR_S, float(np.spacing(np.float32(frames[at] / fps)))):
            yield (
                f"its timestamp is {columns['timestamp'].reshape(-1)[at]:.6g} s at frame {frames[at]:g},"
                f" which is {frames[at] / fps:.6g} s by frame_index and {fps:g} fps; frame_index counts"
            )
    if "next.done" in columns and columns["next.done"].reshape(-1)[:-1].any():
        at = int(columns["next.done"].reshape(-1).argmax())
        yield f"its next.done is true at frame {frames[at]:g}, before its last one"


# ---------------------------------------------------------------------------------------------------- OGBench


def _is_npz(path: Path) -> bool:
    if path.suffix != ".npz" or not path.is_file():
        return False
    with zipfile.ZipFile(path) as archive:
        return "terminals.npy" in archive.namelist()


class _Npz(DataSet):
    """A data set of OGBench: arrays of all steps, and `terminals`, which end episodes."""

    kind = "OGBench npz"

    def __init__(self, path: Path) -> None:
        self.path = path
        features, remarks = [], list[str]()
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                with archive.open(entry) as stream:
                    shape, dtype = _npy_header(cast("BinaryIO", stream), f"{path.name}: {name}")
                if dtype.hasobject:
                    remarks.append(f"{name} holds Python objects (a pickle), which are never loaded")
                elif dtype.kind in "fiub" and shape:
                    if int(np.prod([float(size) for size in shape])) * dtype.itemsize > min(
                        entry.file_size, _MOST_BYTES
                    ):
                        raise LogError(
                            f"{path.name}: {name} has the shape {shape}, and {entry.file_size:,} bytes; it is"
                            " damaged, or too large"
                        )
                    features.append(Feature(name, (), int(np.prod(shape[1:]))))
        self.features = tuple(feature for feature in features if feature.name != "terminals")
        self._arrays: dict[str, Floats] = {}
        ends = np.flatnonzero(self._array("terminals"))
        count = len(self._array("terminals"))
        if len(ends) == 0 or ends[-1] != count - 1:
            last = count - 1 - (int(ends[-1]) if len(ends) else -1)
            remarks.append(f"its last episode, of {counted(last, 'step')}, does not end with a terminal")
            ends = np.append(ends, count - 1)
        self._bounds = [0, *(ends + 1).tolist()]
        self.episodes = tuple(
            Episode(number, str(number), self._bounds[number + 1] - self._bounds[number])
            for number in range(len(ends))
        )
        self.remarks = tuple(remarks)

    def columns(
        self, number: int, reading: EpisodeReading = AS_STORED, features: Sequence[str] | None = None
    ) -> EpisodeColumns:
        """See `DataSet.columns`."""
        self.episode(number)
        rows = slice(self._bounds[number], self._bounds[number + 1])
        names = [feature.name for feature in self.features] if features is None else features
        frames: Integers = np.arange(rows.stop - rows.start, dtype=np.int64)
        success = None
        if reading.label is not None:
            success = as_label(self._array(reading.label)[rows], f"{self.name}: {reading.label}")
        bodies, remarks = list[Body](), tuple[str, ...]()
        if reading.model is not None:
            model = model_from_file(reading.model, reading.assets)
            bodies, remarks = model.bodies(self._array("qpos")[rows], f"{self.name}: qpos"), model.remarks
        return EpisodeColumns(
            frame_times_ns(frames, self.required_fps(reading)),
            {name: self._array(name)[rows] for name in names},
            tuple(bodies),
            success,
            remarks=remarks,
        )

    def _array(self, name: str) -> Floats:
        if name not in self._arrays:
            with np.load(self.path, allow_pickle=False) as arrays:
                if name not in arrays:
                    hint = nearest_hint(name, list(arrays)) or f"it has {listed(list(arrays))}"
                    raise UsageError(f"{self.name} has no array {name!r}; {hint}")
                values = np.asarray(arrays[name], np.float64)
            self._arrays[name] = values.reshape(len(values), -1) if values.ndim > 1 else values
        return self._arrays[name]


def _npy_header(stream: BinaryIO, what: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and the type of an array, without its numbers.

    Raises:
        LogError: it is none.
    """
    try:
        version = np.lib.format.read_magic(stream)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(stream)
    except ValueError as error:
        raise LogError(f"{what} is no array of NumPy: {error}") from None
    return shape, dtype


FORMATS: Final[dict[str, Format]] = {
    "LeRobot": Format(_is_lerobot, _LeRobot),
    "OGBench npz": Format(_is_npz, _Npz),
    "HDF5": Format(is_hdf5, open_hdf5),
    "Minari": Format(is_minari, open_minari),
}

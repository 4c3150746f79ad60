"""LeRobot data sets (v2, v3): rows of Parquet files, found by `episode_index`.

Only files in the folder of a data set are read; path templates in its metadata are ignored.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.formats.episodes import (
    MOST_BYTES,
    SECOND_RUN,
    DataSet,
    Episode,
    EpisodeColumns,
    Feature,
    Label,
    Run,
    frame_times_ns,
    integer_or_none,
)
from spatial_replay.logs.formats.tables import arrow, numbers_from_column, read_head, read_json
from spatial_replay.text import listing, plural

_SUCCESS: Final = "next.success"
_TIME_ERROR_S: Final = 1e-3
"""Largest error of a time in float32, seconds."""
_EPISODE_COLUMNS: Final = ("episode_index", "tasks", "length", "data/chunk_index", "data/file_index")


class _Rows(NamedTuple):
    """Rows of an episode in a file.

    Attributes:
        is_whole: whether no rows of other episodes are between `begin` and `end`.
    """

    file: Path
    begin: int
    end: int
    is_whole: bool = True


def open_lerobot(path: Path) -> DataSet | None:
    """Open a data set of LeRobot; None for another folder.

    Raises:
        UsageError: the version of the format is unknown, or pyarrow is not installed.
        LogError: the metadata of the data set cannot be read.
    """
    return _LeRobot(path) if (path / "meta" / "info.json").is_file() else None


class _LeRobot(DataSet):
    always_read = ("episode_index", "frame_index", "timestamp", "next.done")

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
        if self.feature(_SUCCESS) is not None:
            self.label = Label(_SUCCESS, is_about_next=True, is_stored=False)
        self._file_of, self.episodes, remarks = _episodes(path)
        self._files = sorted((path / "data").rglob("*.parquet"))
        self._file_by_end = {
            end: file for file in self._files for end in (file.name, f"{file.parent.name}/{file.name}")
        }
        self._rows: dict[Path, Mapping[int, _Rows]] = {}
        # some third-party copies have the metadata of versions 2 and 3, and other file names
        is_third_party = version.startswith("v3") and (path / "meta" / "episodes.jsonl").exists()
        missing = [file for file in dict.fromkeys(self._file_of.values()) if file not in self._file_by_end]
        if missing and not is_third_party:
            remarks.append(
                f"meta names files that are not in data/: {listing(missing, 3)}; rows are found by"
                " episode_index"
            )
        stated_count = info.get("total_episodes")
        if isinstance(stated_count, int) and stated_count != len(self.episodes):
            remarks.append(
                f"meta/info.json says {plural(stated_count, 'episode')}, and meta has {len(self.episodes)}"
            )
        if info.get("chunks_size") == 1 and _lacks_files(path):
            remarks.append(
                "it looks like a copy by forge-robotics, which leaves out labels, poses of objects and names"
                " of numbers; use the original"
            )
        self.remarks = tuple(remarks)
        # cache of the last read: the file with its time, the names of requested columns, and these columns
        self._loaded: tuple[object, AbstractSet[str], Mapping[str, Floats]] = (None, frozenset(), {})

    def open_episode(self, episode: Episode) -> AbstractContextManager[list[_Rows]]:
        return nullcontext(self._places(episode.number))

    def read(self, group: list[_Rows], names: AbstractSet[str]) -> dict[str, Floats]:
        pieces = [
            {name: table[name][rows.begin : rows.end] for name in names & table.keys()}
            for rows in group
            for table in [self._table(rows.file, names)]
        ]
        if len(pieces) == 1:
            return pieces[0]
        common_names = set.intersection(*(set(piece) for piece in pieces))
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in common_names}

    def count_states(self, run: Run) -> int:
        return len(run.arrays["episode_index"])

    def poses(self, run: Run, count: int) -> EpisodeColumns:
        """Return the times of `frame_index`, which are exact, unlike `timestamp`; see `DataSet.poses`."""
        episode, arrays = run.episode, run.arrays
        fps, all_frames = self.required_fps(run.reading), np.arange(count, dtype=np.float64)
        frames = arrays.get("frame_index", all_frames)
        remarks, unjudged = tuple(_remarks(arrays, frames, fps, episode.frames)), ""
        named_file, row_files = (
            self._file_by_end.get(self._file_of[episode.number]),
            [rows.file for rows in run.group],
        )
        if named_file is not None and named_file not in row_files:
            row_file = row_files[0].relative_to(self.path)
            remarks += (
                f"its rows are in {row_file}, and not in {named_file.relative_to(self.path)} as meta says",
            )
        jump_rows = np.flatnonzero(np.diff(frames) <= 0)
        if len(jump_rows):
            row = int(jump_rows[0])
            jump = f"from {frames[row]:g} to {frames[row + 1]:g} at row {row + 1}"
            unjudged = f"its frame_index goes {jump}: {SECOND_RUN}"
            frames = all_frames
        times_ns = frame_times_ns(frames.astype(np.int64), fps)
        return EpisodeColumns(times_ns, remarks=remarks, unjudged=unjudged)

    def shared_files(self) -> list[Path]:
        files = [self.path / "meta" / "info.json", self.path / "meta" / "episodes.jsonl"]
        files += sorted((self.path / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
        return [file for file in files if file.exists()]

    def files_of(self, number: int) -> list[Path]:
        return [rows.file for rows in self._places(number)]

    def _places(self, number: int) -> list[_Rows]:
        """Return the rows of an episode, from its own file or from all files.

        Raises:
            LogError: no file has rows of the episode, or rows of other episodes are between its rows.
        """
        likely_ending = self._file_of[number]
        named_file = self._file_by_end.get(likely_ending)
        # a file of version 2 that holds its episode needs no search
        is_alone = (
            named_file is not None
            and named_file.name == likely_ending
            and number in self._rows_of(named_file)
        )
        # metadata of copied or merged data sets names wrong files, so all files are searched
        files = [named_file] if named_file is not None and is_alone else self._files
        row_ranges = [rows for file in files if (rows := self._rows_of(file).get(number)) is not None]
        if not row_ranges:
            missing_note = "" if named_file else f" ({likely_ending} is missing)"
            raise LogError(
                f"{self.name}#{number}: no file in data/ has its rows{missing_note}; download the"
                " whole data set"
            )
        if not all(rows.is_whole for rows in row_ranges):
            raise LogError(f"{self.name}#{number}: its rows lie between those of other episodes; sort them")
        return row_ranges

    def _rows_of(self, file: Path) -> Mapping[int, _Rows]:
        if file not in self._rows:
            episode_numbers = _read_columns(file, {"episode_index"}).get("episode_index")
            if episode_numbers is None:
                raise LogError(f"{file.name} has no column episode_index")
            # NaN differs from every number, so row 0 is a first row, too
            first_rows = np.flatnonzero(np.diff(episode_numbers, prepend=np.nan) != 0)
            end_rows = [*first_rows[1:].tolist(), len(episode_numbers)]
            rows_by_number: dict[int, _Rows] = {}
            for first_row, end_row in zip(first_rows.tolist(), end_rows, strict=True):
                number = int(episode_numbers[first_row])
                earlier_rows = rows_by_number.get(number)
                rows_by_number[number] = (
                    _Rows(file, first_row, end_row)
                    if earlier_rows is None
                    else _Rows(file, earlier_rows.begin, end_row, False)
                )
            self._rows[file] = rows_by_number
        return self._rows[file]

    def _table(self, file: Path, names: AbstractSet[str]) -> Mapping[str, Floats]:
        """Return columns of a file; the columns of the last file are cached."""
        # columns are read whole and filtered in memory: 0.06 ms for an episode of 85 frames
        file_version = (file, file.stat().st_mtime_ns)
        read_names, table = self._loaded[1:] if self._loaded[0] == file_version else (frozenset[str](), {})
        if unread_names := names - read_names:
            self._loaded = (file_version, read_names | names, {**table, **_read_columns(file, unread_names)})
        return self._loaded[2]


def _lacks_files(path: Path) -> bool:
    """Return whether the episode tables lack the column with file numbers."""
    tables = sorted((path / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
    return bool(tables) and "data/file_index" not in arrow().parquet.read_schema(tables[0]).names


def _features(features: Mapping[str, Any]) -> Iterator[Feature]:
    for name, description in features.items():
        description = description if isinstance(description, dict) else {}
        shape = description.get("shape")
        shape = [1] if not isinstance(shape, list) else [size for size in shape if isinstance(size, int)]
        width = int(np.prod(shape)) if description.get("dtype") not in ("video", "image", "string") else 0
        yield Feature(name, _places_of(description.get("names"), width), width)


def _places_of(names: object, width: int) -> tuple[str, ...]:
    """Return the names of a feature's numbers, from a list or from an object with one list."""
    if isinstance(names, dict):
        lists = [value for value in names.values() if isinstance(value, list)]
        names = lists[0] if len(lists) == 1 else None
    if not isinstance(names, list) or len(names) != width or len(set(map(str, names))) != width:
        return ()
    return tuple(map(str, names))


def _episodes(path: Path) -> tuple[dict[int, str], tuple[Episode, ...], list[str]]:
    """Return path endings of files by episode number, the episodes, and remarks."""
    episode_rows, remarks = list(_episode_rows(path)), []
    if not episode_rows:
        remarks.append("meta has no episodes; their numbers are those in data/")
        files = sorted((path / "data").rglob("*.parquet"))
        episode_numbers = {
            int(number)
            for file in files
            for number in _read_columns(file, {"episode_index"})["episode_index"]
        }
        episode_rows = [{"episode_index": number} for number in episode_numbers]
    row_by_number: dict[int, Mapping[str, Any]] = {}
    for row in episode_rows:
        if isinstance(row.get("episode_index"), int):
            row_by_number.setdefault(row["episode_index"], row)
    if len(row_by_number) < len(episode_rows):
        remarks.append(
            f"meta lists {plural(len(episode_rows) - len(row_by_number), 'episode')} twice or without a"
            " number"
        )
    episodes, file_of = [], {}
    for number, row in sorted(row_by_number.items()):
        tasks = row.get("tasks")
        task = next(iter(tasks), None) if isinstance(tasks, list) else tasks
        frames = integer_or_none(row.get("length"))
        episodes.append(Episode(number, str(number), frames, str(task) if task else None))
        file_numbers = row.get("data/chunk_index"), row.get("data/file_index")
        # version 2 names files by episode, version 3 by chunk and file number
        file_of[number] = f"episode_{number:06d}.parquet"
        if all(isinstance(file_number, int) for file_number in file_numbers):
            file_of[number] = "chunk-{:03d}/file-{:03d}.parquet".format(*file_numbers)
    return file_of, tuple(episodes), remarks


def _episode_rows(path: Path) -> Iterator[Mapping[str, Any]]:
    # repair tools add tables with other names
    files = sorted((path / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
    if files:
        pyarrow = arrow()
        for file in files:
            try:
                column_names = pyarrow.parquet.read_schema(file).names
                columns = [name for name in column_names if name in _EPISODE_COLUMNS]
                yield from pyarrow.parquet.read_table(file, columns=columns).to_pylist()
            except pyarrow.ArrowException as error:
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


def _read_columns(file: Path, names: AbstractSet[str]) -> dict[str, Floats]:
    """Read columns of a Parquet file as float64; missing columns, and columns of texts, are left out.

    Raises:
        LogError: the file cannot be read, or is too large.
    """
    pyarrow = arrow()
    try:
        with pyarrow.parquet.ParquetFile(file) as parquet:
            schema, row_count = parquet.schema_arrow, parquet.metadata.num_rows
            present_names = [name for name in schema.names if name in names]
            if 8 * row_count * max(1, len(present_names)) > MOST_BYTES:
                raise LogError(f"{file.name} has {row_count:,} rows; split it into smaller files")
            table = parquet.read(columns=present_names)
    except (OSError, pyarrow.ArrowException) as error:
        raise LogError(
            f"{file.name} cannot be read: {str(error).splitlines()[0].rstrip('.')}; download it again"
        ) from None
    columns = ((name, numbers_from_column(table.column(name))) for name in table.column_names)
    return {name: values for name, values in columns if values is not None}


def _remarks(
    columns: Mapping[str, Floats], frames: Floats, fps: float, expected_count: int | None
) -> Iterator[str]:
    """Yield remarks on unusual values in the rows of an episode; all rows are read nevertheless."""
    if expected_count is not None and expected_count != len(frames):
        yield f"meta says {plural(expected_count, 'frame')}, and data has {len(frames)}"
    frame_steps = np.diff(frames)
    irregular_rows = np.flatnonzero(frame_steps != 1)
    if len(frames) and frames[0] != 0:
        yield f"its frame_index starts at {frames[0]:g}, and so its time at {frames[0] / fps:.3f} s"
    if len(irregular_rows) and (frame_steps > 0).all():
        row = int(irregular_rows[0])
        yield f"its frame_index goes from {frames[row]:g} to {frames[row + 1]:g}: frames are missing"
    if "timestamp" in columns:
        time_errors_s = np.abs(columns["timestamp"].reshape(-1) - frames / fps)
        row = int(np.nan_to_num(time_errors_s, nan=0.0).argmax()) if len(time_errors_s) else 0
        # float32 can store late times with an error above `_TIME_ERROR_S`
        if len(time_errors_s) and time_errors_s[row] > max(
            _TIME_ERROR_S, float(np.spacing(np.float32(frames[row] / fps)))
        ):
            yield (
                f"its timestamp is {columns['timestamp'].reshape(-1)[row]:.6g} s at frame {frames[row]:g},"
                f" which is {frames[row] / fps:.6g} s by frame_index and {fps:g} fps; frame_index counts"
            )
    if "next.done" in columns and columns["next.done"].reshape(-1)[:-1].any():
        row = int(columns["next.done"].reshape(-1).argmax())
        yield f"its next.done is true at frame {frames[row]:g}, before its last one"

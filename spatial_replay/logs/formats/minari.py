"""Data sets of Minari: one HDF5 file, or a folder of Arrow or Parquet files for each episode.

Observations and infos have one row more than actions: the state after the last action.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.logs.formats.archive import (
    arrays_in,
    first_line,
    integer_attribute,
    member,
    names_in,
    numbers,
    open_archive,
    width_of,
)
from spatial_replay.logs.formats.episodes import (
    AS_STORED,
    DataSet,
    Episode,
    EpisodeColumns,
    EpisodeReading,
    Feature,
    Label,
    frame_times_ns,
)
from spatial_replay.logs.formats.grouped import episode_group, success_of_states, with_last
from spatial_replay.logs.formats.tables import arrow, numbers_from_column, read_head, read_json
from spatial_replay.text import counted, listed, nearest_hint

_LABELS: Final = ("infos/success", "infos/is_success")
_OF_STEPS: Final = ("actions", "rewards", "terminations", "truncations")
_ENDS: Final = ("terminations", "truncations")


def is_minari(path: Path) -> bool:
    """Return whether a folder is a data set of Minari, or the `data` folder of one."""
    return path.is_dir() and b'"minari_version"' in read_head(_folder(path) / "metadata.json")


def open_minari(path: Path) -> DataSet:
    """Open a data set of Minari.

    Raises:
        UsageError: its storage is of an unknown kind, or a library is not installed.
        LogError: it cannot be read.
    """
    storage = str(read_json(_folder(path) / "metadata.json").get("data_format", "hdf5"))
    if storage == "hdf5":
        return _Hdf5(path)
    if storage in ("arrow", "parquet"):
        return _Tables(path)
    raise UsageError(f"{path.name} is stored as {storage}; hdf5, arrow and parquet are read")


def _folder(path: Path) -> Path:
    return path / "data" if (path / "data" / "metadata.json").is_file() else path


class _Minari(DataSet):
    """A data set of Minari."""

    def __init__(self, path: Path) -> None:
        self.path, self.folder = path, _folder(path)
        about = read_json(self.folder / "metadata.json")
        self.kind = f"Minari {about.get('minari_version')} ({about.get('data_format', 'hdf5')})"
        self.episodes = tuple(self.list_episodes(_task(about)))
        if not self.episodes:
            raise LogError(f"{path.name} has no episodes")
        widths = self.widths(self.episodes[0])
        self.features = tuple(Feature(name, (), width) for name, width in widths.items() if name not in _ENDS)
        label = next((name for name in _LABELS if widths.get(name)), None)
        self.label = Label(label) if label else None
        self.remarks = tuple(self._remarks(about))

    def _remarks(self, about: Mapping[str, Any]) -> Iterator[str]:
        total, combined = about.get("total_episodes"), about.get("combined_datasets")
        if isinstance(total, int) and total != len(self.episodes):
            yield f"metadata.json says {counted(total, 'episode')}, and the data have {len(self.episodes)}"
        if isinstance(combined, list):
            names = listed(list(dict.fromkeys(map(str, combined))))
            yield f"it combines {names}: episodes that were filtered out of these are in it again"

    def list_episodes(self, task: str | None) -> Iterator[Episode]:
        """Yield its episodes by number."""
        raise NotImplementedError

    def widths(self, episode: Episode) -> dict[str, int]:
        """Return the numbers a frame of each array of an episode."""
        raise NotImplementedError

    def arrays(self, episode: Episode, names: set[str]) -> dict[str, Floats]:
        """Read arrays of an episode; those of steps without the padding of their storage."""
        raise NotImplementedError

    def columns(
        self, number: int, reading: EpisodeReading = AS_STORED, features: Sequence[str] | None = None
    ) -> EpisodeColumns:
        """See `DataSet.columns`."""
        episode, fps = self.episode(number), self.required_fps(reading)
        names = [feature.name for feature in self.features if feature.width] if features is None else features
        label = reading.label or (self.label.field if self.label else None)
        arrays = self.arrays(episode, {*names, *_ENDS, *([label] if label else [])})
        steps = len(arrays["terminations"]) if "terminations" in arrays else (episode.frames or 1) - 1
        counts = [len(values) for name, values in arrays.items() if name.split("/")[0] not in _OF_STEPS]
        count = max(counts, default=steps + 1)
        frames: Integers = np.arange(count, dtype=np.int64)
        return EpisodeColumns(
            frame_times_ns(frames, fps),
            {name: with_last(arrays[name], count) for name in names if name in arrays},
            success=self._success(arrays, label, count, reading),
            unjudged=_two_runs(arrays, steps, count),
        )

    def _success(
        self, arrays: Mapping[str, Floats], label: str | None, count: int, reading: EpisodeReading
    ) -> Booleans | None:
        if label is not None and label in arrays:
            return success_of_states(arrays[label], count, f"{self.name}: {label}")
        if reading.label is not None:
            names = [feature.name for feature in self.features]
            hint = nearest_hint(reading.label, names) or f"it has {listed(names)}"
            raise UsageError(f"{self.name} has no {reading.label!r} for `label`; {hint}")
        return None


def _task(about: Mapping[str, Any]) -> str | None:
    try:
        specification = json.loads(about.get("env_spec") or "{}")
    except (TypeError, ValueError):
        return None
    name = specification.get("id") if isinstance(specification, dict) else None
    return name if isinstance(name, str) else None


def _two_runs(arrays: Mapping[str, Floats], steps: int, count: int) -> str:
    """Return why an episode is not judged: updating a data set appends a run to an episode of its number."""
    why = "more than one run is in the episode, so it is not judged; record each run as an episode"
    for name in _ENDS:
        ends = np.flatnonzero(arrays.get(name, np.empty(0))[:-1] > 0)
        if len(ends):
            return f"its {name} end a run at step {ends[0]} of {steps}: {why}"
    if count != steps + 1:
        return f"it has {counted(count, 'state')} for {counted(steps, 'step')}: {why}"
    return ""


class _Hdf5(_Minari):
    """A data set in `main_data.hdf5`, with a group for each episode."""

    @property
    def _file(self) -> Path:
        return self.folder / "main_data.hdf5"

    def list_episodes(self, task: str | None) -> Iterator[Episode]:
        with open_archive(self._file) as file:
            numbered = [
                int(key.removeprefix("episode_"))
                for key in names_in(file)
                if key.removeprefix("episode_").isdecimal()
            ]
            for number in sorted(numbered):
                key = f"episode_{number}"
                group = episode_group(file, key, f"{self.name}#{number}")
                steps = integer_attribute(group, "total_steps")
                frames = None if steps is None else steps + 1
                yield Episode(number, key, frames, task, integer_attribute(group, "seed"))

    def widths(self, episode: Episode) -> dict[str, int]:
        with open_archive(self._file) as file:
            group = episode_group(file, episode.key, f"{self.name}#{episode.number}")
            return {_arrow_path(name): width_of(array) for name, array in arrays_in(group)}

    def arrays(self, episode: Episode, names: set[str]) -> dict[str, Floats]:
        with open_archive(self._file) as file:
            group = episode_group(file, episode.key, f"{self.name}#{episode.number}")
            arrays = {name: member(group, _hdf5_path(name)) for name in names}
            return {
                name: numbers(array)
                for name, array in arrays.items()
                if array is not None and width_of(array)
            }


def _arrow_path(name: str) -> str:
    """Return the name of an array as Arrow has it: parts of tuples are numbers."""
    return "/".join(part.removeprefix("_index_") for part in name.split("/"))


def _hdf5_path(name: str) -> str:
    return "/".join(f"_index_{part}" if part.isdecimal() else part for part in name.split("/"))


class _Tables(_Minari):
    """A data set with a folder of Arrow or Parquet files for each episode."""

    def list_episodes(self, task: str | None) -> Iterator[Episode]:
        numbered = [
            int(child.name) for child in self.folder.iterdir() if child.name.isdecimal() and child.is_dir()
        ]
        for number in sorted(numbered):
            file = self.folder / str(number) / "metadata.json"
            about = read_json(file) if file.is_file() else {}
            steps, seed = about.get("total_steps"), about.get("seed")
            yield Episode(
                number,
                str(number),
                steps + 1 if isinstance(steps, int) else None,
                task,
                seed if isinstance(seed, int) else None,
            )

    def widths(self, episode: Episode) -> dict[str, int]:
        widths = {}
        for name, column in self._columns(episode).items():
            values = numbers_from_column(column)
            widths[name] = 0 if values is None else int(np.prod(values.shape[1:]))
        return widths

    def arrays(self, episode: Episode, names: set[str]) -> dict[str, Floats]:
        arrays = dict[str, Floats]()
        for name, column in self._columns(episode).items():
            values = numbers_from_column(column) if name in names else None
            if values is not None:
                # the last row of steps is padding: nothing follows the last state
                is_of_steps = name.split("/")[0] in _OF_STEPS
                arrays[name] = values[: (episode.frames or len(values)) - 1] if is_of_steps else values
        return arrays

    def _columns(self, episode: Episode) -> dict[str, Any]:
        """Return the columns of an episode; the fields of structures apart."""
        library, folder = arrow(), self.folder / episode.key
        files = sorted([*folder.glob("*.arrow"), *folder.glob("*.parquet")])
        if not files:
            raise LogError(f"{self.name}#{episode.number}: {folder.name} has no data; download it again")
        try:
            table = library.concat_tables([_table(file, library) for file in files])
            table.validate(full=True)
            return dict(_leaves(table, library))
        except (OSError, ValueError, library.ArrowException) as error:
            raise LogError(
                f"{self.name}#{episode.number} cannot be read: {first_line(error)}; download it again"
            ) from None


def _leaves(table: Any, library: Any) -> Iterator[tuple[str, Any]]:
    pending = [(name, table.column(name)) for name in reversed(table.column_names)]
    while pending:
        name, column = pending.pop()
        if not library.types.is_struct(column.type):
            yield name, column
            continue
        fields = [column.type.field(index).name for index in range(column.type.num_fields)]
        pending += [
            (f"{name}/{field}", library.compute.struct_field(column, [index]))
            for index, field in reversed(list(enumerate(fields)))
        ]


def _table(file: Path, library: Any) -> Any:
    if file.suffix == ".parquet":
        return library.parquet.read_table(file)
    with library.OSFile(str(file)) as stream, library.ipc.open_file(stream) as reader:
        return reader.read_all()

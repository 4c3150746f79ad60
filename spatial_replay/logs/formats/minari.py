"""Data sets of Minari: one HDF5 file, or a folder of Arrow or Parquet files for each episode.

Observations and infos have one row more than actions: the state after the last action.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.formats.archive import open_archive, width_of
from spatial_replay.logs.formats.episodes import (
    SECOND_RUN,
    DataSet,
    Episode,
    EpisodeColumns,
    Feature,
    Label,
    Run,
    integer_or_none,
)
from spatial_replay.logs.formats.hdf5 import InGroups
from spatial_replay.logs.formats.tables import arrow, numbers_from_column, read_head, read_json
from spatial_replay.text import listing, plural

_LABELS: Final = ("infos/success", "infos/is_success")
_OF_STEPS: Final = ("actions", "rewards", "terminations", "truncations")
_ENDS: Final = ("terminations", "truncations")


def open_minari(path: Path) -> DataSet | None:
    """Open a data set of Minari, or its `data` folder; None for anything else.

    Raises:
        UsageError: the storage of the data set is of an unknown kind, or a library is not installed.
        LogError: the data set cannot be read.
    """
    folder = path / "data" if (path / "data" / "metadata.json").is_file() else path
    if b'"minari_version"' not in read_head(folder / "metadata.json"):
        return None
    metadata = read_json(folder / "metadata.json")
    storage = str(metadata.get("data_format", "hdf5"))
    if storage == "hdf5":
        return _Hdf5(path, folder, metadata)
    if storage in ("arrow", "parquet"):
        return _Tables(path, folder, metadata)
    raise UsageError(f"{path.name} is stored as {storage}; hdf5, arrow and parquet are read")


class _Minari(DataSet):
    always_read = _ENDS

    def __init__(self, path: Path, folder: Path, metadata: Mapping[str, Any]) -> None:
        self.path, self.home = path, folder
        self.kind = f"Minari {metadata.get('minari_version')} ({metadata.get('data_format', 'hdf5')})"
        self.episodes = tuple(self.list_episodes(_task(metadata)))
        if not self.episodes:
            raise LogError(f"{path.name} has no episodes")
        widths = self.widths(self.episodes[0])
        self.features = tuple(Feature(name, (), width) for name, width in widths.items() if name not in _ENDS)
        label = next((name for name in _LABELS if widths.get(name)), None)
        self.label = Label(label) if label else None
        self.remarks = tuple(self._remarks(metadata))

    def _remarks(self, metadata: Mapping[str, Any]) -> Iterator[str]:
        stated_count, combined = metadata.get("total_episodes"), metadata.get("combined_datasets")
        if isinstance(stated_count, int) and stated_count != len(self.episodes):
            yield (
                f"metadata.json says {plural(stated_count, 'episode')}, and the data have"
                f" {len(self.episodes)}"
            )
        if isinstance(combined, list):
            data_set_names = listing(list(dict.fromkeys(map(str, combined))))
            yield f"it combines {data_set_names}: episodes that were filtered out of these are in it again"

    def list_episodes(self, task: str | None) -> Iterator[Episode]:
        """Yield the episodes in the order of their numbers."""
        raise NotImplementedError

    def widths(self, episode: Episode) -> dict[str, int]:
        """Return how many numbers each array of an episode has per frame."""
        raise NotImplementedError

    def count_states(self, run: Run) -> int:
        counts = [len(rows) for name, rows in run.arrays.items() if name.split("/")[0] not in _OF_STEPS]
        return max(counts, default=_count_steps(run) + 1)

    def poses(self, run: Run, count: int) -> EpisodeColumns:
        times_ns = super().poses(run, count).times_ns
        unjudged = _second_run(run.arrays, _count_steps(run), count)
        return EpisodeColumns(times_ns, unjudged=unjudged)


def _task(metadata: Mapping[str, Any]) -> str | None:
    try:
        specification = json.loads(metadata.get("env_spec") or "{}")
    except (TypeError, ValueError):
        return None
    name = specification.get("id") if isinstance(specification, dict) else None
    return name if isinstance(name, str) else None


def _count_steps(run: Run) -> int:
    return len(run.arrays["terminations"]) if "terminations" in run.arrays else (run.episode.frames or 1) - 1


def _second_run(arrays: Mapping[str, Floats], steps: int, count: int) -> str:
    """Return the reason why an episode with two runs gets no verdict; "" for an episode with one run.

    When a data set is updated, Minari appends a run to an existing episode of the same number.
    """
    for name in _ENDS:
        end_steps = np.flatnonzero(arrays.get(name, np.empty(0))[:-1] > 0)
        if len(end_steps):
            return f"its {name} end a run at step {end_steps[0]} of {steps}: {SECOND_RUN}"
    if count != steps + 1:
        return f"it has {plural(count, 'state')} for {plural(steps, 'step')}: {SECOND_RUN}"
    return ""


class _Hdf5(_Minari, InGroups):
    """A data set in `main_data.hdf5`, with a group for each episode."""

    @property
    def archive(self) -> Path:
        return self.home / "main_data.hdf5"

    def list_episodes(self, task: str | None) -> Iterator[Episode]:
        with open_archive(self.archive) as file:
            episode_names = [name.removeprefix("episode_") for name in file.names]
            for number in sorted(int(name) for name in episode_names if name.isdecimal()):
                group_name = f"episode_{number}"
                group = file.episode(group_name, f"{self.name}#{number}")
                steps = group.integer("total_steps")
                yield Episode(
                    number, group_name, None if steps is None else steps + 1, task, group.integer("seed")
                )

    def widths(self, episode: Episode) -> dict[str, int]:
        """See `_Minari.widths`; elements of a tuple are named by their index, as in Arrow."""
        with self.open_episode(episode) as group:
            return {
                "/".join(part.removeprefix("_index_") for part in name.split("/")): width_of(array)
                for name, array in group.arrays()
            }

    def array_path(self, name: str) -> str:
        # in HDF5, Minari names the elements of a tuple _index_0, _index_1 …
        return "/".join(f"_index_{part}" if part.isdecimal() else part for part in name.split("/"))


class _Tables(_Minari):
    """A data set with a folder of Arrow or Parquet files for each episode."""

    def list_episodes(self, task: str | None) -> Iterator[Episode]:
        folder_names = [
            child.name for child in self.home.iterdir() if child.name.isdecimal() and child.is_dir()
        ]
        for number in sorted(map(int, folder_names)):
            file = self.home / str(number) / "metadata.json"
            metadata = read_json(file) if file.is_file() else {}
            steps, seed = integer_or_none(metadata.get("total_steps")), integer_or_none(metadata.get("seed"))
            yield Episode(number, str(number), None if steps is None else steps + 1, task, seed)

    def widths(self, episode: Episode) -> dict[str, int]:
        widths = {}
        for name, column in self._columns(episode).items():
            numbers = numbers_from_column(column)
            widths[name] = 0 if numbers is None else int(np.prod(numbers.shape[1:]))
        return widths

    def open_episode(self, episode: Episode) -> AbstractContextManager[Episode]:
        return nullcontext(episode)

    def read(self, group: Episode, names: AbstractSet[str]) -> dict[str, Floats]:
        episode, arrays = group, dict[str, Floats]()
        for name, column in self._columns(episode).items():
            numbers = numbers_from_column(column) if name in names else None
            if numbers is not None:
                # the last row of steps is padding: nothing follows the last state
                is_of_steps = name.split("/")[0] in _OF_STEPS
                arrays[name] = numbers[: (episode.frames or len(numbers)) - 1] if is_of_steps else numbers
        return arrays

    def _columns(self, episode: Episode) -> dict[str, Any]:
        """Return the columns of an episode; each field of a struct is a separate column."""
        pyarrow, folder = arrow(), self.home / episode.key
        files = sorted([*folder.glob("*.arrow"), *folder.glob("*.parquet")])
        if not files:
            raise LogError(f"{self.name}#{episode.number}: {folder.name} has no data; download it again")
        try:
            table = pyarrow.concat_tables([_table(file, pyarrow) for file in files])
            # a damaged file can have offsets outside its buffers
            table.validate(full=True)
            return dict(_leaves(table, pyarrow))
        except (OSError, ValueError, pyarrow.ArrowException) as error:
            reason = str(error).splitlines()[0]
            place = f"{self.name}#{episode.number}"
            raise LogError(f"{place} cannot be read: {reason}; download it again") from None


def _leaves(table: Any, pyarrow: Any) -> Iterator[tuple[str, Any]]:
    pending_columns = [(name, table.column(name)) for name in reversed(table.column_names)]
    while pending_columns:
        name, column = pending_columns.pop()
        if not pyarrow.types.is_struct(column.type):
            yield name, column
            continue
        field_names = [column.type.field(index).name for index in range(column.type.num_fields)]
        pending_columns += [
            (f"{name}/{field_name}", pyarrow.compute.struct_field(column, [index]))
            for index, field_name in reversed(list(enumerate(field_names)))
        ]


def _table(file: Path, pyarrow: Any) -> Any:
    if file.suffix == ".parquet":
        return pyarrow.parquet.read_table(file)
    with pyarrow.OSFile(str(file)) as stream, pyarrow.ipc.open_file(stream) as reader:
        return reader.read_all()

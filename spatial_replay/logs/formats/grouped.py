"""Data sets in HDF5 with a group for each episode: their columns, labels and poses."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.logs.formats.archive import (
    arrays_in,
    attribute,
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
    as_label,
    natural_key,
)
from spatial_replay.text import counted, listed, nearest_hint

NUMBERED: Final = re.compile(r"[a-z]+_([0-9]{1,9})")
"""The name of an episode's group."""


class GroupedEpisodes(DataSet):
    """A data set in HDF5 with a group for each episode.

    Attributes:
        folder: the group that holds the episodes.
        left_out: arrays that are no features, by the first part of their paths.
    """

    folder = ""
    left_out = frozenset[str]()

    def __init__(self, path: Path, file: Any) -> None:
        self.path = path
        home = member(file, self.folder)
        keys = sorted((key for key in names_in(home) if NUMBERED.fullmatch(key)), key=natural_key)
        numbered = [int(key.rpartition("_")[2]) for key in keys]
        if len(set(numbered)) < len(keys):
            numbered = list(range(len(keys)))
        self.episodes = tuple(map(partial(self._episode, home), numbered, keys))
        first = member(file, f"{self.folder}/{keys[0]}")
        rows = self.count_frames(first, f"{self.name}#{numbered[0]}")
        self.features = tuple(
            Feature(name, (), width_of(array))
            for name, array in arrays_in(first)
            if array.shape and array.shape[0] in (rows, rows - 1) and name.split("/")[0] not in self.left_out
        )

    def _episode(self, home: Any, number: int, key: str) -> Episode:
        try:
            return self.describe(home, number, key)
        except LogError:
            # reading it says why
            return Episode(number, key)

    def describe(self, home: Any, number: int, key: str) -> Episode:
        """Return the number, key, task and seed of an episode."""
        raise NotImplementedError

    def count_frames(self, group: Any, place: str) -> int:
        """Return the number of states of an episode."""
        raise NotImplementedError

    def read(self, group: Any, count: int, reading: EpisodeReading, place: str) -> EpisodeColumns:
        """Return times, bodies and messages of an episode."""
        raise NotImplementedError

    def columns(
        self, number: int, reading: EpisodeReading = AS_STORED, features: Sequence[str] | None = None
    ) -> EpisodeColumns:
        """See `DataSet.columns`."""
        episode, place = self.episode(number), f"{self.name}#{number}"
        with open_archive(self.path) as file:
            group = episode_group(file, f"{self.folder}/{episode.key}", place)
            count = self.count_frames(group, place)
            read = self.read(group, count, reading, place)
            names = (
                [feature.name for feature in self.features if feature.width] if features is None else features
            )
            values, remarks = self._features_of(group, count, names)
            return EpisodeColumns(
                read.times_ns,
                values,
                read.bodies,
                self.success_in(group, count, episode, reading),
                read.faults,
                (*read.remarks, *remarks),
                read.unjudged,
            )

    def success(self, number: int, reading: EpisodeReading = AS_STORED) -> Booleans | None:
        """See `DataSet.success`."""
        episode, place = self.episode(number), f"{self.name}#{number}"
        with open_archive(self.path) as file:
            group = episode_group(file, f"{self.folder}/{episode.key}", place)
            return self.success_in(group, self.count_frames(group, place), episode, reading)

    def _features_of(
        self, group: Any, count: int, names: Sequence[str]
    ) -> tuple[dict[str, Floats], list[str]]:
        """Return features of an episode; those of steps have NaN in the state after the last step."""
        values, remarks = dict[str, Floats](), list[str]()
        for name in names:
            array = member(group, name)
            if array is None or not width_of(array):
                continue
            if len(array) not in (count, count - 1):
                remarks.append(f"{name} has {counted(len(array), 'row')} for {count} states; it is not read")
                continue
            values[name] = with_last(numbers(array), count)
        return values, remarks

    def success_in(
        self, group: Any, count: int, episode: Episode, reading: EpisodeReading
    ) -> Booleans | None:
        """Return the label of an episode, of each state or of all; None without one."""
        field = reading.label or (self.label.field if self.label else None)
        if field is None:
            return None
        array = member(group, field)
        if array is not None and width_of(array):
            return success_of_states(numbers(array), count, f"{self.name}#{episode.number}: {field}")
        value = attribute(group, field)
        if value is not None:
            return np.array(bool(value))
        if reading.label is not None and self.feature(field) is None:
            names = [feature.name for feature in self.features]
            hint = nearest_hint(field, names) or f"it has {listed(names)}"
            raise UsageError(f"{self.name} has no {field!r} for `label`; {hint}")
        return None


def episode_group(file: Any, path: str, place: str) -> Any:
    """Return the group of an episode.

    Raises:
        LogError: it is none, or a link out of the file.
    """
    group = member(file, path)
    if group is None or not hasattr(group, "keys"):
        raise LogError(f"{place}: {path.strip('/')} holds no episode")
    return group


def with_last(values: Floats, count: int) -> Floats:
    """Return an array of steps with a row of NaN for each state after the last step."""
    lost = count - len(values)
    return values if lost <= 0 else np.concatenate([values, np.full((lost, *values.shape[1:]), np.nan)])


def success_of_states(labels: Floats, count: int, place: str) -> Booleans:
    """Return the label (T,) of each state; a label of a step is about the state after it.

    Raises:
        LogError: there are neither as many labels as states, nor one less.
    """
    is_success = as_label(labels, place)
    if len(labels) == count - 1:
        return np.concatenate([[False], is_success])
    if len(labels) != count:
        raise LogError(f"{place} has {counted(len(labels), 'row')} for {counted(count, 'state')}")
    return is_success


def unit_quaternions(quaternions: Floats, place: str, order: str) -> Floats:
    """Return quaternions (T, 4) as x y z w.

    Raises:
        LogError: they are not of unit length.
    """
    lengths = np.linalg.norm(quaternions, axis=1)
    off = np.flatnonzero(np.abs(lengths - 1) > 0.01)
    if len(off):
        raise LogError(
            f"{place} has a quaternion of length {lengths[off[0]]:.3g} at row {off[0]}; an orientation has"
            " length 1, so these are other numbers"
        )
    return quaternions if order == "xyzw" else quaternions[:, [1, 2, 3, 0]]


def pose_rows(array: Any, place: str, width: int, rows: slice = slice(None)) -> Floats:
    """Read the first numbers of each row of an array.

    Raises:
        LogError: its rows are shorter.
    """
    values = numbers(array, rows)
    if values.ndim != 2 or values.shape[1] < width:
        raise LogError(f"{place} has the shape {values.shape}; a pose has {width} numbers")
    return values


def mapping_or_empty(value: object) -> Mapping[str, Any]:
    """Return a value that is a JSON object; an empty one for any other."""
    return value if isinstance(value, dict) else {}


def first_group(group: Any, prefix: str) -> Any | None:
    """Return the first group whose name is a prefix and a number."""
    keys = [key for key in names_in(group) if NUMBERED.fullmatch(key) and key.startswith(prefix)]
    return member(group, min(keys, key=natural_key)) if keys else None

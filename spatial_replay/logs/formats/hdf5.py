"""Robot-learning data sets in HDF5: ManiSkill, Isaac Lab, robosuite with robomimic and LIBERO, and D4RL."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.logs.formats.archive import (
    SIGNATURE,
    arrays_in,
    attribute,
    integer_attribute,
    json_attribute,
    member,
    names_in,
    numbers,
    open_archive,
    row_count,
    text_attribute,
    width_of,
)
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
    natural_key,
    quaternion_order,
)
from spatial_replay.logs.formats.grouped import (
    GroupedEpisodes,
    episode_group,
    first_group,
    mapping_or_empty,
    pose_rows,
    unit_quaternions,
)
from spatial_replay.logs.formats.mujoco import model_from_file, model_from_xml
from spatial_replay.logs.formats.tables import read_json
from spatial_replay.text import counted, listed, nearest_hint


def is_hdf5(path: Path) -> bool:
    """Return whether a file begins as one of HDF5."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(SIGNATURE)) == SIGNATURE


def open_hdf5(path: Path) -> DataSet:
    """Open a data set in an HDF5 file.

    Raises:
        UsageError: its layout is none of those that are read, or h5py is not installed.
        LogError: it cannot be read.
    """
    with open_archive(path) as file:
        for layout in (_ManiSkill, _IsaacLab, _Robosuite, _D4rl):
            if layout.is_layout(file):
                return layout(path, file)
        raise UsageError(
            f"{path.name} is an HDF5 file with {listed(names_in(file)) or 'nothing in it'}, no layout that is"
            " read: ManiSkill (traj_0), Isaac Lab, robosuite, robomimic or LIBERO (data/demo_0), D4RL"
            " (terminals)"
        )


# -------------------------------------------------------------------------------------------------- ManiSkill


class _ManiSkill(GroupedEpisodes):
    """Trajectories of ManiSkill: `traj_0` with `env_states/actors`, and a JSON file next to it."""

    kind = "ManiSkill"
    fps = 20.0

    def __init__(self, path: Path, file: Any) -> None:
        about = path.with_suffix(".json")
        info = read_json(about) if about.is_file() else {}
        rows = info.get("episodes")
        self._rows: dict[str, Mapping[str, Any]] = {
            f"traj_{row.get('episode_id')}": row
            for row in (rows if isinstance(rows, list) else ())
            if isinstance(row, dict)
        }
        environment = mapping_or_empty(info.get("env_info"))
        self._task = str(environment["env_id"]) if environment.get("env_id") else None
        options = mapping_or_empty(environment.get("env_kwargs"))
        fps = options.get("control_freq") or mapping_or_empty(options.get("sim_config")).get("control_freq")
        if isinstance(fps, (int, float)) and 0 < fps <= 1e6:
            self.fps = float(fps)
        super().__init__(path, file)
        first = member(file, self.episodes[0].key)
        self.names_bodies = bool(names_in(member(first, "env_states/actors")))
        has_label = member(first, "success") is not None or any(
            "success" in row for row in self._rows.values()
        )
        # the first state has no label, and each other one that of the step before it
        self.label = Label("success") if has_label else None
        self.remarks = tuple(self._compare(about))

    @staticmethod
    def is_layout(file: Any) -> bool:
        first = first_group(file, "traj_")
        return any(member(first, name) is not None for name in ("env_states", "obs")) if first else False

    def _compare(self, about: Path) -> Iterator[str]:
        """Yield remarks on the JSON file next to the trajectories."""
        keys = {episode.key for episode in self.episodes}
        if not self._rows:
            yield f"{about.name} is missing or has no episodes: seeds are not known, and the rate is 20 Hz"
        elif keys != self._rows.keys():
            differing = sorted(keys ^ self._rows.keys(), key=natural_key)
            yield f"{about.name} and {self.name} differ in their episodes: {listed(differing)}"
        if not self.names_bodies:
            yield "env_states has no actors by name; name objects by `features:`"

    def describe(self, home: Any, number: int, key: str) -> Episode:
        row = self._rows.get(key, {})
        seed, steps = row.get("episode_seed"), row.get("elapsed_steps")
        return Episode(
            number,
            key,
            steps + 1 if isinstance(steps, int) else None,
            self._task,
            seed if isinstance(seed, int) else None,
        )

    def count_frames(self, group: Any, place: str) -> int:
        for folder in ("env_states", "obs"):
            item: Any = member(group, folder)
            arrays = [item] if hasattr(item, "shape") else [array for _, array in arrays_in(item)]
            if arrays and arrays[0].shape:
                return row_count(arrays[0])
        raise LogError(f"{place} has neither env_states nor obs; record with `record_env_state=True`")

    def read(self, group: Any, count: int, reading: EpisodeReading, place: str) -> EpisodeColumns:
        bodies, actors = [], member(group, "env_states/actors")
        for name in names_in(actors):
            where = f"{place}: env_states/actors/{name}"
            poses = pose_rows(member(actors, name, group), where, 7)
            quaternions = unit_quaternions(poses[:, 3:7], where, reading.order or "wxyz")
            bodies.append(Body(name, poses[:, :3], quaternions))
        frames: Integers = np.arange(count, dtype=np.int64)
        return EpisodeColumns(frame_times_ns(frames, self.required_fps(reading)), bodies=tuple(bodies))

    def success_in(
        self, group: Any, count: int, episode: Episode, reading: EpisodeReading
    ) -> Booleans | None:
        success = super().success_in(group, count, episode, reading)
        value = self._rows.get(episode.key, {}).get("success")
        return np.array(value) if success is None and isinstance(value, bool) else success


# -------------------------------------------------------------------------------------------------- Isaac Lab


_BODIES: Final = "states/rigid_object"
_ASKED: Final = 32
"""Episodes whose quaternions are looked at."""


class _IsaacLab(GroupedEpisodes):
    """Demonstrations of Isaac Lab, RoboLab and Arena: `data/demo_0/states/rigid_object`.

    The states are those after each step. Quaternions are x y z w since 2026 and w x y z before, and the
    files do not say which.
    """

    kind = "Isaac Lab"
    folder = "data"
    names_bodies = True
    left_out = frozenset({"initial_state"})

    def __init__(self, path: Path, file: Any) -> None:
        about = json_attribute(member(file, "data"), "env_args")
        self._task = str(about.get("env_name") or "") or None
        steps = mapping_or_empty(about.get("sim_args"))
        try:
            self.fps = 1 / (float(steps["dt"]) * int(steps["decimation"]))
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            self.fps = None
        self._has_label = False
        super().__init__(path, file)
        self.label = Label("success") if self._has_label else None
        self._order: str | None = None

    @staticmethod
    def is_layout(file: Any) -> bool:
        first = first_group(member(file, "data"), "demo_")
        return first is not None and bool(names_in(member(first, _BODIES)))

    def describe(self, home: Any, number: int, key: str) -> Episode:
        demo = member(home, key)
        self._has_label = self._has_label or attribute(demo, "success") is not None
        frames, seed = integer_attribute(demo, "num_samples"), integer_attribute(demo, "seed")
        return Episode(number, key, frames, self._task, seed)

    def count_frames(self, group: Any, place: str) -> int:
        names = names_in(member(group, _BODIES))
        if not names:
            raise LogError(f"{place} has no {_BODIES}; record with the recorder of states")
        array = member(group, f"{_BODIES}/{names[0]}/root_pose")
        if array is None or not array.shape:
            raise LogError(f"{place}: {_BODIES}/{names[0]} has no root_pose")
        return row_count(array)

    def read(self, group: Any, count: int, reading: EpisodeReading, place: str) -> EpisodeColumns:
        frames: Integers = np.arange(count, dtype=np.int64)
        times_ns, order = frame_times_ns(frames, self.required_fps(reading)), reading.order or self._decide()
        bodies, home = [], member(group, _BODIES)
        for name in names_in(home):
            poses, where = _poses(home, name, group, place), f"{place}: {_BODIES}/{name}"
            if len(poses) != count:
                raise LogError(f"{where} has {len(poses)} poses, and the first body {count}; record it again")
            bodies.append(Body(name, poses[:, :3], unit_quaternions(poses[:, 3:7], where, order)))
        return EpisodeColumns(times_ns, bodies=tuple(bodies))

    def _decide(self) -> str:
        """Return the order of the quaternions.

        Raises:
            UsageError: the data do not show it.
        """
        if self._order is None:
            with open_archive(self.path) as file:
                # objects stand still and upright at the start of most episodes
                starts = quaternion_order(self._quaternions(file, slice(1)))
                self._order = starts or quaternion_order(self._quaternions(file, slice(None)))
        if self._order is None:
            raise UsageError(
                f"{self.name} does not show the order of its quaternions; say `order: xyzw` (Isaac Lab since"
                " 2026) or `order: wxyz` (before) in the mapping"
            )
        return self._order

    def _quaternions(self, file: Any, rows: slice) -> Iterator[Floats]:
        for episode in self.episodes[:_ASKED]:
            place = f"{self.name}#{episode.number}"
            group = episode_group(file, f"{self.folder}/{episode.key}", place)
            home = member(group, _BODIES)
            for name in names_in(home):
                yield _poses(home, name, group, place, rows)[:, 3:7]


def _poses(home: Any, body: str, episode: Any, place: str, rows: slice = slice(None)) -> Floats:
    where, array = f"{place}: {_BODIES}/{body}/root_pose", member(home, f"{body}/root_pose", episode)
    if array is None:
        raise LogError(f"{where} is missing; record it again")
    return pose_rows(array, where, 7, rows)


# -------------------------------------------------------------------------------------------------- robosuite

_SUCCESSES_ONLY: Final = (1, 4)
"""The version since which robosuite's recorder drops failed episodes."""


class _Robosuite(GroupedEpisodes):
    """Demonstrations of robosuite, robomimic and LIBERO: `data/demo_0` with `states` of a `model_file`.

    A state is the one before the action of its step, so the state after the last action is not stored.
    """

    folder = "data"
    has_times = True
    names_bodies = True
    left_out = frozenset({"next_obs"})

    def __init__(self, path: Path, file: Any) -> None:
        home = member(file, "data")
        about = json_attribute(home, "env_args")
        options = mapping_or_empty(about.get("env_kwargs"))
        version = text_attribute(home, "repository_version")
        is_libero = attribute(home, "bddl_file_name") is not None
        self.kind = "LIBERO" if is_libero else f"robosuite {version}" if version else "robomimic"
        self.robot = str(robots) if isinstance(robots := options.get("robots"), str) else ""
        name = text_attribute(home, "env") or str(about.get("env_name") or "")
        instruction = json_attribute(home, "problem_info").get("language_instruction")
        self._task = str(instruction or name) or None
        self._has_label = False
        super().__init__(path, file)
        field = self._label_field(options, version)
        self.label = Label(field, is_about_next=True, is_stored=False) if field else None
        if field == "successful":
            self.remarks = ("it holds successes only: robosuite's recorder drops failed episodes",)

    @staticmethod
    def is_layout(file: Any) -> bool:
        first = first_group(member(file, "data"), "demo_")
        return first is not None and hasattr(member(first, "states"), "shape")

    def _label_field(self, options: Mapping[str, Any], version: str) -> str:
        if self._has_label:
            return "success"
        if options.get("reward_shaping") is False and self.feature("rewards") is not None:
            return "rewards"
        parts = tuple(map(int, re.findall(r"\d+", version)[:2]))
        return "successful" if parts >= _SUCCESSES_ONLY else ""

    def describe(self, home: Any, number: int, key: str) -> Episode:
        demo = member(home, key)
        self._has_label = self._has_label or attribute(demo, "success") is not None
        task = json_attribute(demo, "ep_meta").get("lang")
        frames, seed = integer_attribute(demo, "num_samples"), integer_attribute(demo, "seed")
        return Episode(number, key, frames, task if isinstance(task, str) and task else self._task, seed)

    def count_frames(self, group: Any, place: str) -> int:
        states: Any = member(group, "states")
        if states is None or not states.shape:
            raise LogError(f"{place} has no states")
        return row_count(states)

    def read(self, group: Any, count: int, reading: EpisodeReading, place: str) -> EpisodeColumns:
        if reading.model is None:
            xml = text_attribute(group, "model_file")
            if not xml:
                raise UsageError(f"{place} has no model_file; give the MuJoCo model by `model: scene.xml`")
            model = model_from_xml(xml, f"the model_file of {self.name}", reading.assets)
        else:
            model = model_from_file(reading.model, reading.assets)
        seconds, bodies = model.states(numbers(member(group, "states")), f"{place}: states")
        if not np.isfinite(seconds).all():
            row = int(np.flatnonzero(~np.isfinite(seconds))[0])
            raise LogError(f"{place}: the time of state {row} is {seconds[row]}")
        times_ns: Integers = np.round(seconds * 1e9).astype(np.int64)
        remarks, unjudged, back = list(model.remarks), "", np.flatnonzero(np.diff(times_ns) <= 0)
        if len(back):
            row = int(back[0])
            unjudged = (
                f"its time goes from {seconds[row]:g} s to {seconds[row + 1]:g} s at state {row + 1}: more"
                " than one run is in the episode, so it is not judged; record each run as an episode"
            )
            times_ns = frame_times_ns(np.arange(count, dtype=np.int64), reading.fps or 20.0)
        elif count and seconds[0] > 0:
            remarks.append(f"its time starts at {seconds[0]:.3f} s")
        return EpisodeColumns(times_ns, bodies=tuple(bodies), remarks=tuple(remarks), unjudged=unjudged)

    def success_in(
        self, group: Any, count: int, episode: Episode, reading: EpisodeReading
    ) -> Booleans | None:
        if reading.label is None and self.label is not None and self.label.field == "successful":
            return np.array(True)
        return super().success_in(group, count, episode, reading)


# ------------------------------------------------------------------------------------------------------- D4RL


class _D4rl(DataSet):
    """A data set of D4RL: arrays of all steps; `terminals` and `timeouts` end episodes."""

    kind = "D4RL HDF5"

    def __init__(self, path: Path, file: Any) -> None:
        self.path = path
        terminals = numbers(member(file, "terminals")).reshape(-1) > 0
        count, timeouts = len(terminals), member(file, "timeouts")
        is_end = terminals if timeouts is None else terminals | (numbers(timeouts).reshape(-1) > 0)
        ends = np.flatnonzero(is_end)
        if count and (len(ends) == 0 or ends[-1] != count - 1):
            last = count - 1 - (int(ends[-1]) if len(ends) else -1)
            self.remarks = (f"its last episode, of {counted(last, 'step')}, has no terminal and no timeout",)
            ends = np.append(ends, count - 1)
        self._bounds = [0, *(ends + 1).tolist()]
        self.episodes = tuple(
            Episode(number, str(number), self._bounds[number + 1] - self._bounds[number])
            for number in range(len(ends))
        )
        self.features = tuple(
            Feature(name, (), width_of(array))
            for name, array in arrays_in(file)
            if array.shape and array.shape[0] == count and name not in ("terminals", "timeouts")
        )

    @staticmethod
    def is_layout(file: Any) -> bool:
        arrays: list[Any] = [member(file, name) for name in ("terminals", "observations")]
        return all(hasattr(array, "shape") and array.shape for array in arrays)

    def columns(
        self, number: int, reading: EpisodeReading = AS_STORED, features: Sequence[str] | None = None
    ) -> EpisodeColumns:
        """See `DataSet.columns`."""
        self.episode(number)
        rows = slice(self._bounds[number], self._bounds[number + 1])
        names = [feature.name for feature in self.features if feature.width] if features is None else features
        frames: Integers = np.arange(rows.stop - rows.start, dtype=np.int64)
        times_ns = frame_times_ns(frames, self.required_fps(reading))
        with open_archive(self.path) as file:
            values = {name: self._array(file, name, rows) for name in names}
            label, bodies, remarks = reading.label, list[Body](), tuple[str, ...]()
            success = None
            if label is not None:
                success = as_label(self._array(file, label, rows), f"{self.name}: {label}")
            if reading.model is not None:
                name = "infos/qpos" if self.feature("infos/qpos") else "qpos"
                model = model_from_file(reading.model, reading.assets)
                bodies = model.bodies(self._array(file, name, rows), f"{self.name}: {name}")
                remarks = model.remarks
        return EpisodeColumns(times_ns, values, tuple(bodies), success, remarks=remarks)

    def _array(self, file: Any, name: str, rows: slice) -> Floats:
        array = member(file, name)
        if array is None:
            names = [feature.name for feature in self.features]
            hint = nearest_hint(name, names) or f"it has {listed(names)}"
            raise UsageError(f"{self.name} has no array {name!r}; {hint}")
        return numbers(array, rows)

"""Data sets in HDF5 with a group for each episode: ManiSkill, Isaac Lab, robosuite, robomimic and LIBERO."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.formats.archive import Group, numbers, open_archive, row_count, width_of
from spatial_replay.logs.formats.episodes import (
    SECOND_RUN,
    Body,
    DataSet,
    Episode,
    EpisodeColumns,
    Feature,
    Label,
    Run,
    frame_times_ns,
    integer_or_none,
    natural_key,
    quaternion_order,
)
from spatial_replay.logs.formats.mujoco import model_from_file, model_from_xml
from spatial_replay.logs.formats.steps import D4rl
from spatial_replay.logs.formats.tables import read_json
from spatial_replay.text import listing

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_NUMBERED: Final = re.compile(r"[a-z]+_([0-9]{1,9})")
"""The name of an episode's group."""


def open_hdf5(path: Path) -> DataSet | None:
    """Open a data set in an HDF5 file; None for any other file.

    Raises:
        UsageError: the layout is unknown, or h5py is not installed.
        LogError: the file cannot be read.
    """
    if not path.is_file():
        return None
    with path.open("rb") as stream:
        if stream.read(len(_SIGNATURE)) != _SIGNATURE:
            return None
    with open_archive(path) as file:
        for layout in (_ManiSkill, _IsaacLab, _Robosuite, D4rl):
            if layout.is_layout(file):
                return layout(path, file)
        raise UsageError(
            f"{path.name} is an HDF5 file with {listing(file.names) or 'nothing in it'}, which is no known"
            " layout; known are ManiSkill (traj_0), Isaac Lab, robosuite, robomimic and LIBERO (data/demo_0),"
            " D4RL (terminals)"
        )


class InGroups(DataSet):
    """A data set in HDF5 with a group for each episode.

    Attributes:
        folder: path of the group that holds the episodes.
    """

    folder = ""

    @property
    def archive(self) -> Path:
        """Path of the HDF5 file."""
        return self.path

    @contextmanager
    def open_episode(self, episode: Episode) -> Iterator[Group]:
        with open_archive(self.archive) as file:
            yield file.episode(f"{self.folder}/{episode.key}", f"{self.name}#{episode.number}")

    def read(self, group: Group, names: AbstractSet[str]) -> dict[str, Floats]:
        arrays = {name: group.array(self.array_path(name)) for name in names}
        return {
            name: numbers(array) for name, array in arrays.items() if array is not None and width_of(array)
        }

    def array_path(self, name: str) -> str:
        """Return the path of a feature in the group of an episode."""
        return name

    def whole_label(self, run: Run, label: str) -> bool | None:
        """Return the label from an attribute; see `DataSet.whole_label`."""
        value = run.group.attribute(label)
        return None if value is None else bool(value)


class _Demonstrations(InGroups):
    """A data set whose episodes are numbered groups.

    Attributes:
        left_out: names of groups in an episode whose arrays are not features, such as `next_obs`.
        task: task of episodes that name no task.
    """

    left_out = frozenset[str]()
    task: str | None = None

    def list_episodes(self, path: Path, file: Group) -> Group:
        """Set `episodes`, and `features` from the first episode; return the group of the first episode."""
        self.path = path
        episodes_group = file.group(self.folder) or file
        keys = sorted((key for key in episodes_group.names if _NUMBERED.fullmatch(key)), key=natural_key)
        episode_numbers = [int(key.rpartition("_")[2]) for key in keys]
        # groups with different prefixes may share a number
        episode_numbers = (
            episode_numbers if len(set(episode_numbers)) == len(keys) else list(range(len(keys)))
        )
        self.episodes = tuple(
            self._describe(episodes_group, episode_number, key)
            for episode_number, key in zip(episode_numbers, keys, strict=True)
        )
        first_group = file.episode(f"{self.folder}/{keys[0]}", f"{self.name}#{episode_numbers[0]}")
        count = self.count_states(Run(self.episodes[0], first_group, {}))
        self.features = tuple(
            Feature(name, (), width_of(array))
            for name, array in first_group.arrays()
            if array.shape
            and array.shape[0] in (count, count - 1)
            and name.split("/")[0] not in self.left_out
        )
        return first_group

    def _describe(self, episodes_group: Group, number: int, key: str) -> Episode:
        try:
            return self.describe(episodes_group, number, key)
        except LogError:
            # reading the episode reports the damage
            return Episode(number, key)

    def describe(self, home: Group, number: int, key: str) -> Episode:
        """Return the number, key, task and seed of an episode."""
        demo = home.group(key)
        if demo is None:
            return Episode(number, key)
        task = demo.json("ep_meta").get("lang")
        task = task if isinstance(task, str) and task else self.task
        return Episode(number, key, demo.integer("num_samples"), task, demo.integer("seed"))


def _first_group(group: Group | None, prefix: str) -> Group | None:
    """Return the first group with a name of the prefix and a number; None without such a group."""
    names = [] if group is None else [name for name in group.names if _NUMBERED.fullmatch(name)]
    names = [name for name in names if name.startswith(prefix)]
    return group.group(min(names, key=natural_key)) if group is not None and names else None


def _body(poses: Any | None, name: str, place: str, component_order: str) -> Body:
    """Return a body from an array of poses, whose rows begin with a position and a quaternion.

    Raises:
        LogError: the array is missing or too narrow, or the quaternions are not of unit length.
    """
    pose_rows = _pose_rows(poses, place)
    quaternions = pose_rows[:, 3:7]
    quaternion_lengths = np.linalg.norm(quaternions, axis=1)
    wrong_rows = np.flatnonzero(np.abs(quaternion_lengths - 1) > 0.01)
    if len(wrong_rows):
        raise LogError(
            f"{place} has a quaternion of length {quaternion_lengths[wrong_rows[0]]:.3g} at row"
            f" {wrong_rows[0]}; an orientation has length 1, so these are other numbers"
        )
    return Body(
        name, pose_rows[:, :3], quaternions if component_order == "xyzw" else quaternions[:, [1, 2, 3, 0]]
    )


def _pose_rows(poses: Any | None, place: str, rows: slice = slice(None)) -> Floats:
    if poses is None:
        raise LogError(f"{place} is missing; record it again")
    pose_rows = numbers(poses, rows)
    if pose_rows.ndim != 2 or pose_rows.shape[1] < 7:
        raise LogError(f"{place} has the shape {pose_rows.shape}; a pose has 7 numbers")
    return pose_rows


def _object(value: object) -> Mapping[str, Any]:
    """Return a JSON object unchanged; an empty object for other values."""
    return value if isinstance(value, dict) else {}


# -------------------------------------------------------------------------------------------------- ManiSkill


class _ManiSkill(_Demonstrations):
    """Trajectories of ManiSkill: `traj_0` with `env_states/actors`, and a JSON file next to it."""

    kind = "ManiSkill"
    fps = 20.0

    def __init__(self, path: Path, file: Group) -> None:
        json_file = path.with_suffix(".json")
        info = read_json(json_file) if json_file.is_file() else {}
        episode_rows = info.get("episodes")
        self._rows = {
            f"traj_{row.get('episode_id')}": row
            for row in (episode_rows if isinstance(episode_rows, list) else ())
            if isinstance(row, dict)
        }
        environment = _object(info.get("env_info"))
        self.task = str(environment["env_id"]) if environment.get("env_id") else None
        env_kwargs = _object(environment.get("env_kwargs"))
        fps = env_kwargs.get("control_freq") or _object(env_kwargs.get("sim_config")).get("control_freq")
        if isinstance(fps, (int, float)) and 0 < fps <= 1e6:
            self.fps = float(fps)
        first_group = self.list_episodes(path, file)
        actors = first_group.group("env_states/actors")
        self.names_bodies = actors is not None and bool(actors.names)
        # the label of a step is moved to the state after the step; the first state has no label
        if first_group.array("success") is not None or any("success" in row for row in self._rows.values()):
            self.label = Label("success")
        self.remarks = tuple(self._remarks(json_file))

    @staticmethod
    def is_layout(file: Group) -> bool:
        """Return whether a file has trajectories."""
        first_group = _first_group(file, "traj_")
        return first_group is not None and not {"env_states", "obs"}.isdisjoint(first_group.names)

    def _remarks(self, json_file: Path) -> Iterator[str]:
        episode_keys = {episode.key for episode in self.episodes}
        if not self._rows:
            yield (
                f"{json_file.name} is missing or has no episodes: seeds are not known, and the rate is 20 Hz"
            )
        elif episode_keys != self._rows.keys():
            differing_keys = sorted(episode_keys ^ self._rows.keys(), key=natural_key)
            yield f"{json_file.name} and {self.name} differ in their episodes: {listing(differing_keys)}"
        if not self.names_bodies:
            yield "env_states has no actors by name; name objects by `features:`"

    def describe(self, home: Group, number: int, key: str) -> Episode:
        row = self._rows.get(key, {})
        seed, step_count = integer_or_none(row.get("episode_seed")), integer_or_none(row.get("elapsed_steps"))
        return Episode(number, key, None if step_count is None else step_count + 1, self.task, seed)

    def count_states(self, run: Run) -> int:
        for folder in ("env_states", "obs"):
            states, single = run.group.group(folder), run.group.array(folder)
            first_array = single if states is None else next((array for _, array in states.arrays()), None)
            if first_array is not None and first_array.shape:
                return row_count(first_array)
        place = f"{self.name}#{run.episode.number}"
        raise LogError(f"{place} has neither env_states nor obs; record with `record_env_state=True`")

    def poses(self, run: Run, count: int) -> EpisodeColumns:
        folder, times_ns = "env_states/actors", super().poses(run, count).times_ns
        actors = run.group.group(folder)
        bodies = [
            _body(
                run.group.array(f"{folder}/{name}"),
                name,
                f"{self.name}#{run.episode.number}: {folder}/{name}",
                run.reading.order or "wxyz",
            )
            for name in (actors.names if actors is not None else ())
        ]
        return EpisodeColumns(times_ns, bodies=tuple(bodies))

    def whole_label(self, run: Run, label: str) -> bool | None:
        """Return the label from an attribute or the JSON file; see `DataSet.whole_label`."""
        attribute = super().whole_label(run, label)
        row = self._rows.get(run.episode.key, {})
        return row["success"] if attribute is None and isinstance(row.get("success"), bool) else attribute


# -------------------------------------------------------------------------------------------------- Isaac Lab


_BODIES: Final = "states/rigid_object"
_MOST_EXAMINED: Final = 32
"""Maximum number of episodes whose quaternions are examined."""


class _IsaacLab(_Demonstrations):
    """Demonstrations of Isaac Lab, RoboLab and Arena: `data/demo_0/states/rigid_object`.

    States are recorded after each step. Quaternions are x y z w since 2026 and w x y z before; the files do
    not store their order.
    """

    kind = "Isaac Lab"
    folder = "data"
    names_bodies = True
    left_out = frozenset({"initial_state"})

    def __init__(self, path: Path, file: Group) -> None:
        data_group = file.group("data") or file
        env_args = data_group.json("env_args")
        self.task = str(env_args.get("env_name") or "") or None
        sim_args = _object(env_args.get("sim_args"))
        try:
            # a step of the environment has `decimation` steps of physics
            self.fps = 1 / (float(sim_args["dt"]) * int(sim_args["decimation"]))
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            self.fps = None
        self.list_episodes(path, file)
        if _has_success(data_group, self.episodes):
            self.label = Label("success")
        self._component_order: str | None = None

    @staticmethod
    def is_layout(file: Group) -> bool:
        """Return whether a file has demonstrations with bodies by name."""
        first_group = _first_group(file.group("data"), "demo_")
        bodies = None if first_group is None else first_group.group(_BODIES)
        return bodies is not None and bool(bodies.names)

    def count_states(self, run: Run) -> int:
        place, bodies = f"{self.name}#{run.episode.number}", run.group.group(_BODIES)
        if bodies is None or not bodies.names:
            raise LogError(f"{place} has no {_BODIES}; record with the recorder of states")
        poses = bodies.array(f"{bodies.names[0]}/root_pose")
        if poses is None:
            raise LogError(f"{place}: {_BODIES}/{bodies.names[0]} has no root_pose")
        return row_count(poses)

    def poses(self, run: Run, count: int) -> EpisodeColumns:
        times_ns = super().poses(run, count).times_ns
        component_order, bodies = run.reading.order or self._decide_order(), []
        for name, place, poses in self._bodies_in(run.episode, run.group):
            body = _body(poses, name, place, component_order)
            if len(body.positions) != count:
                pose_count = len(body.positions)
                raise LogError(f"{place} has {pose_count} poses, and the first body {count}; record it again")
            bodies.append(body)
        return EpisodeColumns(times_ns, bodies=tuple(bodies))

    def _bodies_in(self, episode: Episode, group: Group) -> Iterator[tuple[str, str, Any | None]]:
        bodies = group.group(_BODIES)
        for name in bodies.names if bodies is not None else ():
            place = f"{self.name}#{episode.number}: {_BODIES}/{name}"
            yield name, place, group.array(f"{_BODIES}/{name}/root_pose")

    def _decide_order(self) -> str:
        """Return the order of the quaternions.

        Raises:
            UsageError: the quaternions are ambiguous.
        """
        if self._component_order is None:
            # objects stand still and upright at the start of most episodes
            order_at_start = quaternion_order(self._quaternions(slice(1)))
            self._component_order = order_at_start or quaternion_order(self._quaternions(slice(None)))
        if self._component_order is None:
            raise UsageError(
                f"{self.name} does not show the order of its quaternions; say `order: xyzw` (Isaac Lab since"
                " 2026) or `order: wxyz` (before) in the mapping"
            )
        return self._component_order

    def _quaternions(self, rows: slice) -> Iterator[Floats]:
        for episode in self.episodes[:_MOST_EXAMINED]:
            with self.open_episode(episode) as group:
                for _, place, poses in self._bodies_in(episode, group):
                    yield _pose_rows(poses, place, rows)[:, 3:7]


def _has_success(home: Group, episodes: tuple[Episode, ...]) -> bool:
    """Return whether any episode has the attribute `success`."""
    demos = (home.group(episode.key) for episode in episodes)
    return any(demo is not None and demo.attribute("success") is not None for demo in demos)


# -------------------------------------------------------------------------------------------------- robosuite

_SUCCESSES_ONLY: Final = (1, 4)
"""First version of robosuite whose recorder drops failed episodes."""


class _Robosuite(_Demonstrations):
    """Demonstrations of robosuite, robomimic and LIBERO: `data/demo_0` with `states` of a `model_file`.

    States are recorded before the action of each step, so the state after the last action is missing.
    """

    folder = "data"
    has_times = True
    names_bodies = True
    left_out = frozenset({"next_obs"})
    always_read = ("states",)

    def __init__(self, path: Path, file: Group) -> None:
        data_group = file.group("data") or file
        env_args = data_group.json("env_args")
        env_kwargs = _object(env_args.get("env_kwargs"))
        version = data_group.text("repository_version")
        is_libero = data_group.attribute("bddl_file_name") is not None
        self.kind = "LIBERO" if is_libero else f"robosuite {version}" if version else "robomimic"
        self.robot = str(robots) if isinstance(robots := env_kwargs.get("robots"), str) else ""
        environment = data_group.text("env") or str(env_args.get("env_name") or "")
        self.task = str(data_group.json("problem_info").get("language_instruction") or environment) or None
        self.list_episodes(path, file)
        if _has_success(data_group, self.episodes):
            label_field = "success"
        elif env_kwargs.get("reward_shaping") is False and self.feature("rewards") is not None:
            label_field = "rewards"
        else:
            is_recent = tuple(map(int, re.findall(r"\d+", version)[:2])) >= _SUCCESSES_ONLY
            label_field = "successful" if is_recent else ""
        if label_field:
            self.label = Label(label_field, is_about_next=True, is_stored=False)
        if label_field == "successful":
            self.remarks = ("it holds successes only: robosuite's recorder drops failed episodes",)

    @staticmethod
    def is_layout(file: Group) -> bool:
        """Return whether a file has demonstrations with states."""
        first_group = _first_group(file.group("data"), "demo_")
        return first_group is not None and first_group.array("states") is not None

    def count_states(self, run: Run) -> int:
        states = run.group.array("states")
        if states is None:
            raise LogError(f"{self.name}#{run.episode.number} has no states")
        return row_count(states)

    def poses(self, run: Run, count: int) -> EpisodeColumns:
        place = f"{self.name}#{run.episode.number}"
        if run.reading.model is not None:
            model = model_from_file(run.reading.model, run.reading.assets)
        elif xml := run.group.text("model_file"):
            model = model_from_xml(xml, f"the model_file of {self.name}", run.reading.assets)
        else:
            raise UsageError(f"{place} has no model_file; give the MuJoCo model by `model: scene.xml`")
        times_s, bodies = model.states(run.arrays["states"], f"{place}: states")
        if not np.isfinite(times_s).all():
            row = int(np.flatnonzero(~np.isfinite(times_s))[0])
            raise LogError(f"{place}: the time of state {row} is {times_s[row]}")
        times_ns: Integers = np.round(times_s * 1e9).astype(np.int64)
        remarks, unjudged, jump_rows = list(model.remarks), "", np.flatnonzero(np.diff(times_ns) <= 0)
        if len(jump_rows):
            row = int(jump_rows[0])
            jump = f"from {times_s[row]:g} s to {times_s[row + 1]:g} s at state {row + 1}"
            unjudged = f"its time goes {jump}: {SECOND_RUN}"
            times_ns = frame_times_ns(np.arange(count, dtype=np.int64), run.reading.fps or 20.0)
        elif count and times_s[0] > 0:
            remarks.append(f"its time starts at {times_s[0]:.3f} s")
        return EpisodeColumns(times_ns, bodies=tuple(bodies), remarks=tuple(remarks), unjudged=unjudged)

    def whole_label(self, run: Run, label: str) -> bool | None:
        """Return the label from an attribute, or True if the recorder drops failures."""
        if self.label is not None and label == self.label.field == "successful":
            return True
        return super().whole_label(run, label)

"""Robot-learning data sets and their episodes: features and bodies as arrays, and labels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.text import listing, nearest_hint, plural
from spatial_replay.trace.trace import LATEST_NS


class Feature(NamedTuple):
    """A column of a data set.

    Attributes:
        places: names of the feature's numbers; () for numbers without names.
        width: number of numbers per frame; 0 for images, videos and texts.
    """

    name: str
    places: tuple[str, ...] = ()
    width: int = 1


class Label(NamedTuple):
    """The success label of a data set.

    Attributes:
        field: name of the label in the data set.
        is_about_next: whether a frame's label describes the state after the frame's action.
        is_stored: whether the data set stores the state after the last action.
    """

    field: str
    is_about_next: bool = False
    is_stored: bool = True


class Episode(NamedTuple):
    """An episode of a data set.

    Attributes:
        number: number in the address, such as 17 in `push_v3#17`.
        key: name in the data set, such as `demo_10`; the number for an episode without a name.
        frames: number of frames; None if the frames can be counted only by reading the episode.
    """

    number: int
    key: str
    frames: int | None = None
    task: str | None = None
    seed: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A body that the data set names, so that no mapping is needed.

    Attributes:
        positions: (T, 3) float64.
        quaternions: (T, 4) float64, x y z w; None for a body without orientation.
        shapes: T footprints with heights, in the world frame; None for a point.
    """

    name: str
    positions: Floats
    quaternions: Floats | None = None
    shapes: FootprintBatch | None = None


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeColumns:
    """One episode as arrays.

    Attributes:
        times_ns: (T,) int64, increasing.
        features: arrays by name, (T,) or (T, W) float64.
        bodies: bodies with a name in the data set.
        success: (T,) label of each frame, or () label of the episode; None without a label.
        faults: messages about lost frames.
        remarks: other messages, each without the name of the data set.
        unjudged: reason why the episode gets no verdict, such as two runs in one episode; "" otherwise.
    """

    times_ns: Integers
    features: Mapping[str, Floats] = field(default_factory=lambda: MappingProxyType({}))
    bodies: tuple[Body, ...] = ()
    success: Booleans | None = None
    faults: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    unjudged: str = ""

    @property
    def label(self) -> bool | None:
        """Whether any frame, or the episode, is labelled a success; None without a label."""
        return None if self.success is None else bool(self.success.any())


class EpisodeReading(NamedTuple):
    """Keys of a mapping for reading a data set; None stands for the value of the data set.

    Attributes:
        fps: frames per second.
        label: name of the field with the label.
        model: path of a MuJoCo model, for data sets without a model.
        order: order of the bodies' quaternions, "xyzw" or "wxyz".
        assets: folder with the meshes of models.
    """

    fps: float | None = None
    label: str | None = None
    model: Path | None = None
    order: str | None = None
    assets: Path | None = None


AS_STORED: Final = EpisodeReading()


class Run(NamedTuple):
    """An episode while it is read.

    Attributes:
        group: value of `DataSet.open_episode`.
        arrays: arrays of numbers by name.
        label: name of the label; None without a label.
    """

    episode: Episode
    group: Any
    arrays: Mapping[str, Floats]
    reading: EpisodeReading = AS_STORED
    label: str | None = None


class DataSet:
    """A robot-learning data set: a folder or a file with episodes, whose arrays have names.

    A format reads the arrays of an episode (`open_episode`, `read`, `count_states`) and finds its `poses`.

    Attributes:
        path: path of the folder or file.
        kind: name of the format with its version, such as `LeRobot v3.0`.
        fps: frames per second; None if the data set does not store them.
        has_times: whether frames have times, so that `fps` is not needed.
        robot: type of the robot; "" if the data set does not name it.
        features: columns that a mapping can use, in the data set's order.
        episodes: episodes in the order of their numbers.
        label: success label; None without a label.
        remarks: messages about the whole data set.
        names_bodies: whether the data set names bodies, so that no mapping is needed.
        always_read: arrays that `poses` needs.
    """

    path: Path
    kind: str
    fps: float | None = None
    has_times: bool = False
    robot: str = ""
    features: tuple[Feature, ...] = ()
    episodes: tuple[Episode, ...] = ()
    label: Label | None = None
    remarks: tuple[str, ...] = ()
    names_bodies: bool = False
    always_read: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Base name of the data set's folder or file."""
        return self.path.name or self.path.absolute().name

    def columns(
        self, number: int, reading: EpisodeReading = AS_STORED, features: Sequence[str] | None = None
    ) -> EpisodeColumns:
        """Read an episode.

        Args:
            number: number of the episode.
            features: names of the features to read; None for all features with numbers.

        Raises:
            UsageError: no such episode, or the mapping lacks a key, such as `fps`.
            LogError: the data cannot be read.
        """
        feature_names = (
            [feature.name for feature in self.features if feature.width] if features is None else features
        )
        with self._open_run(number, feature_names, reading) as run:
            arrays, count = run.arrays, self.count_states(run)
            columns, success = self.poses(run, count), self._success(run, count)
        feature_arrays, remarks = dict[str, Floats](), list(columns.remarks)
        for name in feature_names:
            if name in arrays and len(arrays[name]) in (count, count - 1):
                feature_arrays[name] = _with_last(arrays[name], count)
            elif name in arrays:
                row_text = plural(len(arrays[name]), "row")
                remarks.append(f"{name} has {row_text} for {count} states; it is not read")
        return replace(columns, features=feature_arrays, success=success, remarks=tuple(remarks))

    def success(self, number: int, reading: EpisodeReading = AS_STORED) -> Booleans | None:
        """Read the label of an episode without its poses; see `EpisodeColumns.success`.

        Raises:
            UsageError, LogError: see `columns`.
        """
        with self._open_run(number, (), reading) as run:
            return self._success(run, self.count_states(run))

    @contextmanager
    def _open_run(self, number: int, names: Iterable[str], reading: EpisodeReading) -> Iterator[Run]:
        episode = self.episode(number)
        with self.open_episode(episode) as group:
            label_name = reading.label or (self.label.field if self.label else None)
            arrays = self.read(
                group, {*names, *self.always_read, *([] if label_name is None else [label_name])}
            )
            yield Run(episode, group, arrays, reading, label_name)

    def open_episode(self, episode: Episode) -> AbstractContextManager[Any]:
        """Open an episode as a context; the context's value is the `group` of `read`.

        Raises:
            LogError: the episode cannot be read.
        """
        raise NotImplementedError

    def read(self, group: Any, names: AbstractSet[str]) -> dict[str, Floats]:
        """Return the arrays in `names`, (T,) or (T, W); arrays without numbers are left out."""
        raise NotImplementedError

    def count_states(self, run: Run) -> int:
        """Return the number of states; arrays with one row per step may have one row fewer."""
        raise NotImplementedError

    def poses(self, run: Run, count: int) -> EpisodeColumns:
        """Return the times of all states, with bodies and messages."""
        frames: Integers = np.arange(count, dtype=np.int64)
        return EpisodeColumns(frame_times_ns(frames, self.required_fps(run.reading)))

    def whole_label(self, run: Run, label: str) -> bool | None:
        """Return the label of the whole episode, if no array has labels; None without a label."""
        return None

    def _success(self, run: Run, count: int) -> Booleans | None:
        """Return the label of each state (T,), or of the episode (); None without a label."""
        label_name = run.label
        if label_name is None:
            return None
        if label_name in run.arrays:
            return _success_of_states(run.arrays[label_name], count, f"{self.name}: {label_name}")
        episode_label = self.whole_label(run, label_name)
        if episode_label is None and run.reading.label is not None and self.feature(label_name) is None:
            feature_names = [feature.name for feature in self.features]
            hint = nearest_hint(label_name, feature_names) or f"it has {listing(feature_names)}"
            raise UsageError(f"{self.name} has no {label_name!r} for `label`; {hint}")
        return None if episode_label is None else np.array(episode_label)

    def shared_files(self) -> list[Path]:
        """Return the files that every episode depends on; by default, all files."""
        if self.path.is_file():
            json_file = self.path.with_suffix(".json")
            return [self.path, *([json_file] if json_file.is_file() else [])]
        return sorted(file for file in self.path.rglob("*") if file.is_file())

    def files_of(self, number: int) -> list[Path]:
        """Return the files that only this episode depends on.

        Raises:
            LogError: the files cannot be found.
        """
        return []

    def episode(self, number: int) -> Episode:
        """Return the episode with a number.

        Raises:
            UsageError: no episode has the number.
        """
        # episodes are usually numbered from 0, so the index `number` is tried first
        likely_episodes = self.episodes[number : number + 1]
        for episode in (*likely_episodes, *self.episodes):
            if episode.number == number:
                return episode
        raise UsageError(f"{self.name} has no episode {number}; {self.range_text}")

    @property
    def range_text(self) -> str:
        """A clause with the number of episodes, and the addresses of the first and the last episode."""
        if not self.episodes:
            return "it has no episodes"
        first_number, last_number = self.episodes[0].number, self.episodes[-1].number
        return (
            f"it has {plural(len(self.episodes), 'episode')}, {self.name}#{first_number} to"
            f" {self.name}#{last_number}"
        )

    def feature(self, name: str) -> Feature | None:
        """Return the feature with a name; None if no feature has the name."""
        return next((feature for feature in self.features if feature.name == name), None)

    def required_fps(self, reading: EpisodeReading) -> float:
        """Return the frames per second from the mapping or, if the mapping lacks `fps`, from the data set.

        Raises:
            UsageError: neither the mapping nor the data set has frames per second.
        """
        fps = self.fps if reading.fps is None else reading.fps
        if fps is None:
            raise UsageError(
                f"{self.name} ({self.kind}) does not say how many frames a second it has; add `fps: 20`"
                " to the mapping"
            )
        return fps


MOST_BYTES: Final = 8 * 2**30
"""Maximum uncompressed size of the numbers that are read at once, bytes."""
SECOND_RUN: Final = "more than one run is in the episode, so it is not judged; record each run as an episode"


def _with_last(values: Floats, count: int) -> Floats:
    """Append a row of NaN to an array of steps, for the state after the last step."""
    extra = count - len(values)
    return values if not extra else np.concatenate([values, np.full((extra, *values.shape[1:]), np.nan)])


def _success_of_states(labels: Floats, count: int, place: str) -> Booleans:
    """Return the label (T,) of each state; a step's label describes the state after the step.

    Raises:
        LogError: the number of labels is neither the number of states nor smaller by one.
    """
    is_success = _as_label(labels, place)
    if len(labels) == count - 1:
        return np.concatenate([[False], is_success])
    if len(labels) != count:
        raise LogError(f"{place} has {plural(len(labels), 'row')} for {plural(count, 'state')}")
    return is_success


def frame_times_ns(frames: Integers, fps: float) -> Integers:
    """Return the times of frames (T,), exact to the nearest nanosecond.

    Raises:
        LogError: a negative frame, or a frame later than the latest time of a log.
    """
    period_ns = Fraction(10**9) / Fraction(repr(float(fps)))
    if len(frames) and (frames.min() < 0 or int(frames.max()) * period_ns > LATEST_NS):
        raise LogError(f"frames {int(frames.min())} to {int(frames.max())} are no valid numbers of frames")
    # products fit int64, as checked above; a period that is no integer takes fractions
    if period_ns.denominator == 1 and period_ns.numerator < 2**31:
        return frames.astype(np.int64) * period_ns.numerator
    return np.array([round(frame * period_ns) for frame in frames.tolist()], np.int64)


def integer_or_none(value: object) -> int | None:
    """Return an integer of metadata; None for anything else."""
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def natural_key(name: str) -> tuple[Any, ...]:
    """Return a key that sorts `demo_2` before `demo_10`."""
    digits = name[len(name.rstrip("0123456789")) :]
    return (name[: len(name) - len(digits)], int(digits or -1), name)


def _as_label(values: Floats, place: str) -> Booleans:
    """Return the label (T,) of each row of a column (T, …): whether the row has a number above 0.

    Raises:
        UsageError: the column has negative or different positive numbers, such as a shaped reward.
    """
    rows = np.nan_to_num(values.reshape(len(values), -1))
    wrong_numbers = rows[(rows < 0) | (rows != rows.max(initial=0.0)) & (rows > 0)]
    if wrong_numbers.size:
        raise UsageError(
            f"{place} is no label: it has {wrong_numbers[0]:.4g}; a label has 0 and 1, or true and false"
        )
    return np.asarray((rows > 0).any(axis=1))


def quaternion_order(quaternions: Iterable[Floats]) -> str | None:
    """Return the order of quaternions (T, 4) of mostly upright bodies; None for an ambiguous order.

    A turn about the vertical axis is (0, 0, s, c) as x y z w, and (c, 0, 0, s) as w x y z. (0, 0, 0, 1) is
    upright in both orders: no turn as x y z w, half a turn as w x y z. So (0, 0, 0, 1) is no evidence.
    """
    is_zero = np.abs(np.concatenate([np.empty((0, 4)), *quaternions])) < 0.01
    begins_with_zeros = is_zero[:, 0] & is_zero[:, 1]
    if (is_zero[:, 1] & is_zero[:, 2] & ~is_zero[:, 0]).any():
        return None if begins_with_zeros.any() else "wxyz"
    return "xyzw" if (begins_with_zeros & ~is_zero[:, 2]).any() else None

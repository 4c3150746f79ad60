"""Episodes of data sets as sources: columns of an episode and a mapping in; a block of samples out.

All frames of an episode become samples by operations on arrays. Several short episodes are read together.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import accumulate, groupby, pairwise
from typing import Final, NamedTuple, TypeAlias, cast

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers, concatenate_tables, select
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.logs.formats.episodes import Body, DataSet, EpisodeColumns
from spatial_replay.logs.messages import Block
from spatial_replay.logs.read_options import DEFAULTS, FaultList, ReadOptions, gap_ns
from spatial_replay.logs.source import Source, noting_pauses
from spatial_replay.mapping.detections import Detections
from spatial_replay.mapping.episode_evidence import jump_remark, order_remarks
from spatial_replay.mapping.feature_reader import (
    FeatureReading,
    bind_features,
    detections_of_body,
    join_objects,
)
from spatial_replay.mapping.mapping_file import LogMapping
from spatial_replay.mapping.tracker import ObservationRows, rows_from_detections
from spatial_replay.mapping.transforms import matrices_from_quaternions
from spatial_replay.text import Instant, Sentence, encodable, listing
from spatial_replay.trace.trace import Trace, class_order, within
from spatial_replay.trace.units import OUR_AXES, Axes

Report: TypeAlias = Callable[[str, int, str], None]
"""Receiver of invalid footprints: name of the object, frame number, and the sentence without its subject."""


class ReadEpisode(NamedTuple):
    """An episode in memory.

    Attributes:
        faults: sentences on lost frames and invalid footprints.
    """

    columns: EpisodeColumns
    trace: Trace
    faults: tuple[str, ...]


@dataclass(frozen=True)
class EpisodeSource(Source):
    """An episode of a data set, with a mapping from its features to objects.

    Attributes:
        number: number of the episode.
        mapped_by: mapping of the episode; None for a data set that names its bodies.
        episode: content read in advance; None if iteration reads the data set.
    """

    data_set: DataSet
    number: int
    mapped_by: LogMapping | None = None
    reading: ReadOptions = DEFAULTS
    episode: ReadEpisode | None = field(default=None, repr=False, compare=False)

    @property
    def name(self) -> str:
        """Address of the episode without the folder, such as `push_v3#17`."""
        return encodable(f"{self.data_set.name}#{self.number}")

    @property
    def kind(self) -> str:
        """See `Source.kind`."""
        return f"{self.data_set.kind} episode"

    @property
    def axes(self) -> Axes:
        """Axes of the features; samples always have y up."""
        return OUR_AXES if self.mapped_by is None else self.mapped_by.axes

    @property
    def options(self) -> Mapping[str, object]:
        """See `Source.options`."""
        mapping, concave = self.mapped_by, self.reading.concave
        options = {**self.reading.non_defaults(), **({} if concave == "decompose" else {"concave": concave})}
        if mapping is not None:
            options |= {"mapping": mapping.name, "mapping_sha256": mapping.sha256}
        return options

    @property
    def max_gap_ns(self) -> int | None:
        """See `Source.max_gap_ns`."""
        mapped_ns = None if self.mapped_by is None else self.mapped_by.max_gap_ns
        return gap_ns(self.reading.max_gap) or mapped_ns

    def columns(self) -> EpisodeColumns:
        """Return the episode as arrays: features of the mapping, bodies, and label.

        Raises:
            UsageError: the mapping does not fit the data set.
            LogError: the data cannot be read.
        """
        if self.mapped_by is None:
            return self.data_set.columns(self.number, features=())
        features = _bind(self.mapped_by, self.data_set).features
        return self.data_set.columns(self.number, self.mapped_by.episodes, features)

    @noting_pauses
    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`; also raises LogError for an episode that cannot have a verdict."""
        columns, trace, faults = self.episode or self._read()
        if not len(trace):
            raise LogError(f"{self.name} has no frame")
        remarks: list[str] = [
            f"{self.name}: {remark}" for remark in (*columns.remarks, *self._point_remarks(columns))
        ]
        if self.mapped_by is not None:
            remarks += [
                f"{self.name}: it has no feature {feature!r}, which {self.mapped_by.name} marks as optional"
                for feature in _bind(self.mapped_by, self.data_set).absent
            ]
            objects = _bind(self.mapped_by, self.data_set).objects
            remarks += [f"{self.name}: {remark}" for remark in order_remarks(objects, columns.features)]
        if (jump := jump_remark(trace, self.name)) is not None:
            remarks.append(jump)
        if start_ns is not None or end_ns is not None:
            trace = within(trace, start_ns, end_ns)
        if faults:
            trace = replace(trace, faults=faults)
        yield Block(trace, remarks=tuple(remarks))

    def _point_remarks(self, columns: EpisodeColumns) -> Iterator[str]:
        """Yield a remark on bodies to which neither the data set nor the mapping gives a shape."""
        shapes = {} if self.mapped_by is None else self.mapped_by.shapes
        names = [body.name for body in columns.bodies if body.shapes is None and body.name not in shapes]
        if names:
            subject = f"{listing(names)} {'is a point' if len(names) == 1 else 'are points'}"
            yield (
                f"{subject} without a shape in the data; give it by `shapes: {{{names[0]}: …}}`, or"
                " the meshes of a model by `assets:`"
            )

    def _read(self) -> ReadEpisode:
        """Read the episode as a trace with one sample per frame.

        Raises:
            UsageError: the mapping does not fit the numbers, or one of its objects has the name of a body.
            LogError: the files of the data set lack a feature, or the episode cannot have a verdict.
        """
        columns, faults = self.columns(), FaultList()
        if columns.unjudged:
            raise LogError(f"{self.name}: {columns.unjudged}")
        for fault in columns.faults:
            faults.add(f"{self.name}: {fault}")
        report = partial(self._report, times_ns=columns.times_ns, faults=faults)
        trace = self._frames(columns, report).trace(columns.times_ns)
        return ReadEpisode(columns, trace, faults.take(last=True))

    def _frames(self, columns: EpisodeColumns, report: Report) -> _Frames:
        """Return the observations and signals of T frames.

        Raises:
            UsageError: the mapping does not fit the numbers, or one of its objects has the name of a body.
            LogError: the files of the data set lack a feature.
        """
        mapping, frame_count = self.mapped_by, len(columns.times_ns)
        features = FeatureReading() if mapping is None else _bind(mapping, self.data_set)
        shapes = {} if mapping is None else mapping.shapes
        if mapping is not None and mapping.episodes.model is not None and not columns.bodies:
            raise UsageError(
                f"{mapping.name}: model: {self.data_set.name} ({self.data_set.kind}) has no states of a"
                " model; leave it out"
            )
        class_by_name = {bound_object.name: bound_object.class_name for bound_object in features.objects}
        # NumPy does not warn, because NaN and infinity in features make objects unknown
        with np.errstate(all="ignore"):
            detections = {
                bound_object.name: bound_object.detections(
                    columns.features, frame_count, mapping.name if mapping else "", self.name
                )
                for bound_object in features.objects
            }
            rows_by_name: dict[str, ObservationRows] = {}
            for body in columns.bodies:
                if body.name in class_by_name:
                    raise UsageError(
                        f"{self.data_set.name} has a body {body.name!r}; give the object of the mapping"
                        " another `name`"
                    )
                class_by_name[body.name] = None
                if (shape := shapes.get(body.name)) is None:
                    rows_by_name[body.name] = _rows_of_body(body, self.axes)
                else:
                    detections[body.name] = detections_of_body(body, shape)
            names, rows = self._rows(detections, rows_by_name, frame_count, report)
            signals = {
                signal.name: signal.values(columns.features, frame_count, self.name)
                for signal in features.signals
            }
        if not names and not signals:
            names_of_features = [feature.name for feature in self.data_set.features if feature.width]
            remedy = (
                f"name its `features`: {listing(names_of_features)}"
                if names_of_features
                else "it has no numbers"
            )
            raise UsageError(
                f"{mapping.name if mapping else self.name} names no objects of {self.data_set.name}; {remedy}"
            )
        return _Frames(names, rows, signals, class_by_name)

    def _rows(
        self,
        detections: Mapping[str, Detections],
        rows_by_name: Mapping[str, ObservationRows],
        frame_count: int,
        report: Report,
    ) -> tuple[list[str], ObservationRows]:
        """Return the names of objects, and observations in all frames, ordered by object.

        Objects are checked together, because a check of few rows costs as much as a check of many rows.
        Frames without a valid footprint are faults.
        """
        names, row_parts = list(rows_by_name), list(rows_by_name.values())
        for has_height in (False, True):
            group_names = [
                name
                for name, object_detections in detections.items()
                if (object_detections.height is not None) == has_height
            ]
            if not group_names:
                continue

            def report_row(index: int, fault: str, group_names: Sequence[str] = group_names) -> None:
                object_index, frame = divmod(index, frame_count)
                report(group_names[object_index], frame, fault)

            joined_detections = join_objects([detections[name] for name in group_names])
            row_parts.append(
                rows_from_detections(joined_detections, None, self.axes, self.reading.concave, report_row)
            )
            names += group_names
        return names, row_parts[0] if len(row_parts) == 1 else concatenate_tables([_NO_ROWS, *row_parts])

    def _report(self, name: str, frame: int, fault: str, *, times_ns: Integers, faults: FaultList) -> None:
        instant = Instant(int(times_ns[frame]), 0)
        faults.add(Sentence(f"{self.name} at ", instant, f": object {name!r}{fault}"))


class _Frames(NamedTuple):
    """The observations and signals of T frames.

    Attributes:
        names: names of N objects.
        rows: (N * T,) observations, object by object.
        signals: numbers (T,) of each signal, by name.
        class_of: class of each object, by name.
    """

    names: Sequence[str]
    rows: ObservationRows
    signals: Mapping[str, Floats]
    class_of: Mapping[str, str | None]

    def trace(self, times_ns: Integers) -> Trace:
        """Return the frames as samples at times (T,)."""
        names, rows = self.names, self.rows
        row_indices = np.arange(len(rows), dtype=np.int64)
        row_numbers = np.where(rows.is_valid, row_indices, -2 - row_indices).reshape(
            len(names), len(times_ns)
        )
        name_order = sorted(range(len(names)), key=names.__getitem__)
        classes = class_order(self.class_of.values())
        class_codes = np.array([classes.index(self.class_of[name]) for name in names], np.int64)
        return Trace(
            times_ns=times_ns,
            names=tuple(names[index] for index in name_order),
            rows=np.ascontiguousarray(row_numbers[name_order].T),
            footprints=rows.shapes,
            yaw=rows.yaw,
            uncertainty=rows.uncertainty,
            class_code=np.repeat(class_codes, len(times_ns)),
            classes=classes,
            signals=self.signals,
        )

    def divide(self, starts: Sequence[int]) -> Iterator[_Frames]:
        """Yield the frames between successive starts."""
        object_starts = np.arange(len(self.names), dtype=np.int64)[:, None] * starts[-1]
        part_rows = [(object_starts + np.arange(begin, end)).ravel() for begin, end in pairwise(starts)]
        rows = select(self.rows, np.concatenate(part_rows))
        for begin, end in pairwise(starts):
            rows_of_part = rows.slice(len(self.names) * begin, len(self.names) * end)
            signals = {name: values[begin:end] for name, values in self.signals.items()}
            yield self._replace(rows=rows_of_part, signals=signals)


_MOST_FRAMES: Final = 2**15
"""Limit of frames read together, which bounds the memory."""


def read_together(sources: Sequence[Source]) -> list[Source]:
    """Read consecutive episodes of one data set and mapping together; return all sources in the same order.

    An unreadable episode stays unread, so that iterating over its blocks raises the error.
    """
    read_sources: list[Source] = []
    for is_episode, group in groupby(sources, lambda source: isinstance(source, EpisodeSource)):
        if not is_episode:
            read_sources += group
            continue
        episodes = cast(Iterator[EpisodeSource], group)
        for _, alike_sources in groupby(
            episodes, lambda source: (id(source.data_set), id(source.mapped_by), source.reading)
        ):
            read_sources += _read_alike(list(alike_sources))
    return read_sources


def _read_alike(sources: Sequence[EpisodeSource]) -> Iterator[EpisodeSource]:
    """Yield episodes of one data set and mapping; episodes with equal feature shapes are read together."""
    columns_by_index: dict[int, EpisodeColumns] = {}
    frame_count = 0
    for index, source in enumerate(sources if sources[0].mapped_by is not None else ()):
        # all errors are suppressed, because one episode must not end the reading of other episodes
        with suppress(Exception):
            columns = source.columns()
            frame_count += len(columns.times_ns)
            if frame_count > _MOST_FRAMES:
                break
            columns_by_index[index] = columns
    frame_shape = _shape_of(next(iter(columns_by_index.values()))) if columns_by_index else None
    joinable_columns = {
        index: columns
        for index, columns in columns_by_index.items()
        if len(columns.times_ns) and not columns.unjudged and _shape_of(columns) == frame_shape
    }
    episodes: dict[int, ReadEpisode] = {}
    if frame_shape is not None and len(joinable_columns) > 1:
        with suppress(Exception):
            episode_columns = [(sources[index], columns) for index, columns in joinable_columns.items()]
            episodes = dict(zip(joinable_columns, _read_parts(episode_columns), strict=True))
    for index, source in enumerate(sources):
        yield replace(source, episode=episodes.get(index))


def _shape_of(columns: EpisodeColumns) -> tuple[object, ...] | None:
    """Return the shape of each feature in a frame; None for columns that cannot be joined."""
    if columns.bodies or any(len(values) != len(columns.times_ns) for values in columns.features.values()):
        return None
    return tuple(sorted((name, values.shape[1:]) for name, values in columns.features.items()))


def _read_parts(episodes: Sequence[tuple[EpisodeSource, EpisodeColumns]]) -> list[ReadEpisode]:
    """Read episodes together; their features must have equal shapes."""
    first_frames = [0, *accumulate(len(columns.times_ns) for _, columns in episodes)]
    features = {
        name: np.concatenate([columns.features[name] for _, columns in episodes])
        for name in episodes[0][1].features
    }
    fault_lists = [FaultList() for _ in episodes]
    for (source, columns), faults in zip(episodes, fault_lists, strict=True):
        for fault in columns.faults:
            faults.add(f"{source.name}: {fault}")

    def report(name: str, frame: int, fault: str) -> None:
        part_index = bisect_right(first_frames, frame) - 1
        source, columns = episodes[part_index]
        source._report(
            name,
            frame - first_frames[part_index],
            fault,
            times_ns=columns.times_ns,
            faults=fault_lists[part_index],
        )

    frame_numbers = np.arange(first_frames[-1], dtype=np.int64)
    frames = episodes[0][0]._frames(EpisodeColumns(frame_numbers, features), report)
    return [
        ReadEpisode(columns, frames_of_part.trace(columns.times_ns), faults.take(last=True))
        for (_, columns), faults, frames_of_part in zip(
            episodes, fault_lists, frames.divide(first_frames), strict=True
        )
    ]


_NO_ROWS = ObservationRows.blank(np.empty(0, np.int64))


@lru_cache(maxsize=16)
def _bind(mapping: LogMapping, data_set: DataSet) -> FeatureReading:
    return bind_features(mapping, data_set)


def _rows_of_body(body: Body, axes: Axes) -> ObservationRows:
    """Return the observations of a body that a data set names, with the body's shapes or as a point."""
    frame_count = len(body.positions)
    is_valid: Booleans = np.asarray(np.isfinite(body.positions).all(axis=1))
    yaw: Floats = np.full(frame_count, np.nan)
    if body.quaternions is not None:
        is_valid &= np.isfinite(body.quaternions).all(axis=1)
        _, yaw = matrices_from_quaternions(body.quaternions)
    shapes = body.shapes
    if shapes is None:
        shapes = FootprintBatch.without_checks(
            part_start=np.arange(frame_count + 1, dtype=np.int64),
            vertex_start=np.arange(frame_count + 1, dtype=np.int64),
            vertices=np.ascontiguousarray(body.positions[:, :2]),
            radius=np.zeros(frame_count),
            bottom=body.positions[:, 2].copy(),
            top=body.positions[:, 2].copy(),
        )
    no_class = np.zeros(frame_count, np.int64)
    return ObservationRows(
        axes.convert_shapes(shapes), axes.convert_yaw(yaw), np.zeros(frame_count), no_class, is_valid
    )

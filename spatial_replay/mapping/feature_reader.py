"""Read features of a data set: entries of a mapping and columns of an episode in; detections and signals out.

An entry is bound once to the features of a data set. All frames of an episode are read together.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats, concatenate_tables
from spatial_replay.logs.formats.episodes import Body, DataSet, Feature
from spatial_replay.mapping.binding import Binding
from spatial_replay.mapping.detections import (
    Detections,
    Solids,
    heights_from_numbers,
    poses_from_numbers,
    radii_from_numbers,
    solids_of_shape,
)
from spatial_replay.mapping.mapping_file import LogMapping, Measure, ShapeMapping, SignalMapping, TopicMapping
from spatial_replay.mapping.message_types import MessageLayout, layout_of_topic
from spatial_replay.mapping.topic_reader import with_single_precision
from spatial_replay.text import listing, nearest_hint, number_text, plural

_SLICE: Final = re.compile(r"(.*)\[(?:(-?\d{1,9})|(-?\d{1,9})?:(-?\d{1,9})?)\]", re.DOTALL)
_NAME_ENDS: Final = re.compile(r"[./]")
_LENGTH_ERROR: Final = 0.01
"""Largest error of a quaternion's length."""

Columns: TypeAlias = Mapping[str, Floats]


class NumberPlace(NamedTuple):
    """Place of a number in the rows of a feature.

    Attributes:
        number: column of the number.
        name: name of the number, for errors.
    """

    feature: str
    number: int
    name: str


@dataclass(frozen=True, slots=True)
class BoundObject:
    """An object from an entry of a mapping, with the places of the object's numbers.

    Attributes:
        key: key of the entry, for errors.
        places: place of each column of `binding`.
        quaternion: places of the orientation's x, y, z and w; () without an orientation.
    """

    name: str
    class_name: str | None
    key: str
    layout: MessageLayout
    binding: Binding
    places: tuple[NumberPlace, ...]
    quaternion: tuple[NumberPlace, ...] = ()

    def detections(self, columns: Columns, times: int, mapping_name: str, episode: str) -> Detections:
        """Return the object in each of T = `times` frames, with 0 as the code of its name and class.

        Raises:
            UsageError: the four numbers of the orientation are not a quaternion.
            LogError: the files of the data set lack a feature.
        """
        numbers = np.empty((times, self.binding.width))
        for column, place in enumerate(self.places):
            numbers[:, column] = column_of(columns, place, times, episode)
        if self.layout.invalid:
            numbers[np.isin(numbers, with_single_precision(self.layout.invalid))] = nan
        if self.quaternion:
            quaternions = numbers[:, list(self.binding.orientation)]
            self._check_quaternions(quaternions, mapping_name, episode)
            # all numbers become NaN, because a disc without an orientation would keep its position
            numbers[~np.isfinite(quaternions).all(axis=1)] = nan
        return detections_of(self.layout, self.binding, numbers)

    def _check_quaternions(self, quaternions: Floats, mapping_name: str, episode: str) -> None:
        lengths = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))
        # zeros are an unset orientation; NaN and infinity make the object unknown
        is_wrong = np.isfinite(lengths) & (lengths > 0) & (np.abs(lengths - 1) > _LENGTH_ERROR)
        if not is_wrong.any():
            return
        frame = int(is_wrong.argmax())
        widest_column = int(np.fmax.reduce(np.abs(quaternions[is_wrong]), axis=0).argmax())
        least, greatest = (
            np.fmin.reduce(quaternions[:, widest_column]),
            np.fmax.reduce(quaternions[:, widest_column]),
        )
        number_names = listing([place.name for place in self.quaternion])
        raise UsageError(
            f"{mapping_name}: {self.key}.orientation: {number_names} have the length"
            f" {number_text(float(lengths[frame]))} in frame {frame} of {episode}, so they are no quaternion"
            f" ({self.quaternion[widest_column].name} goes from {number_text(float(least))} to"
            f" {number_text(float(greatest))}); give its four numbers, or leave `orientation` out"
        )


class BoundSignal(NamedTuple):
    """A signal from an entry of a mapping, with the place of the signal's number."""

    name: str
    place: NumberPlace
    invalid: tuple[float, ...]

    def values(self, columns: Columns, times: int, episode: str) -> Floats:
        """Return the signal's value (T,) in each of T = `times` frames."""
        values = column_of(columns, self.place, times, episode)
        if self.invalid:
            return np.where(np.isin(values, with_single_precision(self.invalid)), nan, values)
        return values


@dataclass(frozen=True)
class FeatureReading:
    """The entries of a mapping, bound to a data set.

    Attributes:
        objects: bound objects, in the order of the mapping.
        absent: optional features that the data set lacks.
    """

    objects: tuple[BoundObject, ...] = ()
    signals: tuple[BoundSignal, ...] = ()
    absent: tuple[str, ...] = ()

    @cached_property
    def features(self) -> tuple[str, ...]:
        """Names of the features to read."""
        places = [place for bound_object in self.objects for place in bound_object.places]
        places += [signal.place for signal in self.signals]
        return tuple(dict.fromkeys(place.feature for place in places))


def bind_features(mapping: LogMapping, data_set: DataSet) -> FeatureReading:
    """Bind the entries of a mapping to the features of a data set.

    Raises:
        UsageError: the mapping does not fit the data set; all errors are listed.
    """
    objects: dict[str, BoundObject] = {}
    signals: dict[str, BoundSignal] = {}
    absent_features, faults = [], []
    entry_count_of: dict[str, int] = {}
    for entry in mapping.features:
        entry_number = entry_count_of[entry.topic] = entry_count_of.get(entry.topic, -1) + 1
        key = f"features.{entry.topic}" + (f"[{entry_number}]" if entry_number else "")
        feature = data_set.feature(entry.topic)
        if feature is None and entry.optional:
            absent_features.append(entry.topic)
            continue
        try:
            if feature is None:
                feature_names = [feature.name for feature in data_set.features]
                hint = (
                    nearest_hint(entry.topic, feature_names) or f"its features are {listing(feature_names)}"
                )
                raise UsageError(f"{key}: {data_set.name} has no such feature; {hint}")
            places = _Places(data_set, feature, key)
            for signal in entry.signals:
                _claim(signals, signal.name, key, "signal")
                signals[signal.name] = _bind_signal(signal, entry, places)
            if entry.position is not None:
                bound_object = _bind_object(entry, places, mapping.episodes.order)
                _claim(objects, bound_object.name, key, "object")
                objects[bound_object.name] = bound_object
        except UsageError as error:
            faults.append(f"{mapping.name}: {error}")
    if faults:
        raise UsageError("\n".join(faults))
    return FeatureReading(tuple(objects.values()), tuple(signals.values()), tuple(absent_features))


def _claim(by_name: Mapping[str, object], name: str, key: str, kind: str) -> None:
    if name in by_name:
        raise UsageError(f"{key}: there is another {kind} {name!r}; give one of them another name")


def _bind_signal(signal: SignalMapping, entry: TopicMapping, places: _Places) -> BoundSignal:
    return BoundSignal(signal.name, places.single(f"signals.{signal.name}", signal.field), entry.invalid)


def _bind_object(entry: TopicMapping, places: _Places, default_order: str | None) -> BoundObject:
    """Bind an entry with a position.

    Raises:
        UsageError: the places of the entry do not fit the feature.
    """
    columns: dict[NumberPlace, int] = {}

    def column(place: NumberPlace) -> int:
        return columns.setdefault(place, len(columns))

    def measure(key: str, value: Measure) -> float | int:
        return column(places.single(key, value)) if isinstance(value, str) else value

    position = places.several("position", entry.position or (), (2, 3))
    quaternion: tuple[NumberPlace, ...] = ()
    if entry.orientation is not None:
        quaternion = places.several("orientation", entry.orientation, (4,))
        default_order = (
            entry.order or default_order or ("xyzw" if isinstance(entry.orientation, tuple) else None)
        )
        if default_order is None:
            raise UsageError(
                f"{places.key}.orientation: the four numbers have no names; `order: wxyz` says that w comes"
                " first, `order: xyzw` that it comes last"
            )
        quaternion = tuple(quaternion[default_order.index(name)] for name in "xyzw")
    shape = entry.shape
    if shape is not None and shape.outline:
        raise UsageError(f"{places.key}.shape: a feature has no list of corners; give [[x, y], …]")
    uncertainty = entry.uncertainty
    binding = Binding(
        style="keys",
        width=0,
        position=tuple(map(column, position)),
        orientation=tuple(map(column, quaternion)),
        yaw=None if entry.yaw is None else column(places.single("yaw", entry.yaw.field)),
        shape_sizes=tuple(measure("shape", size) for size in shape.sizes) if shape is not None else (),
        height=tuple(measure("height", bound) for bound in entry.height or ()),
        uncertainty=None if uncertainty is None else measure("uncertainty", uncertainty.measure),
    )
    name = entry.name or _NAME_ENDS.split(entry.topic)[-1] or "object"
    class_name = entry.class_name if isinstance(entry.class_name, str) else None
    return BoundObject(
        name,
        class_name,
        places.key,
        layout_of_topic("", entry),
        replace(binding, width=len(columns)),
        tuple(columns),
        quaternion,
    )


def detections_of(layout: MessageLayout, binding: Binding, numbers: Floats) -> Detections:
    """Return the detections of one object in T frames from the object's numbers (T, W)."""
    frame_count = len(numbers)
    poses, no_codes = poses_from_numbers(layout, binding, numbers), np.zeros(frame_count, np.int64)
    detections = Detections(
        message=np.arange(frame_count, dtype=np.int64),
        name=no_codes,
        class_code=no_codes,
        poses=poses,
        solids=solids_of_shape(layout, binding, poses, numbers),
        uncertainty=radii_from_numbers(binding, numbers, frame_count),
        height=heights_from_numbers(binding, numbers),
        numbers=numbers,
    )
    return detections if layout.scale == 1.0 else detections.scale(layout.scale)


def join_objects(objects: Sequence[Detections]) -> Detections:
    """Join detections of several objects, each in all frames; all objects have heights, or none has."""
    if len(objects) == 1:
        return objects[0]
    solids, frame_counts = (
        [detections.solids for detections in objects],
        [len(detections.name) for detections in objects],
    )
    first_frame, first_points = (
        np.cumsum([0, *frame_counts]),
        np.cumsum([0, *(len(object_solids.points) for object_solids in solids)]),
    )
    point_starts = [
        object_solids.point_start[:-1] + start
        for object_solids, start in zip(solids, first_points[:-1], strict=True)
    ]
    heights = [detections.height for detections in objects if detections.height is not None]
    return Detections(
        message=np.concatenate([detections.message for detections in objects]),
        name=np.repeat(np.arange(len(objects)), frame_counts),
        class_code=np.concatenate([detections.class_code for detections in objects]),
        poses=concatenate_tables([detections.poses for detections in objects]),
        solids=Solids(
            owner=np.concatenate(
                [
                    object_solids.owner + start
                    for object_solids, start in zip(solids, first_frame, strict=False)
                ]
            ),
            kind=np.concatenate([object_solids.kind for object_solids in solids]),
            position=np.concatenate([object_solids.position for object_solids in solids]),
            rotation=np.concatenate([object_solids.rotation for object_solids in solids]),
            size=np.concatenate([object_solids.size for object_solids in solids]),
            point_start=np.concatenate([*point_starts, first_points[-1:]]),
            points=np.concatenate([object_solids.points for object_solids in solids]),
        ),
        uncertainty=np.concatenate([detections.uncertainty for detections in objects]),
        height=np.concatenate(heights) if heights else None,
    )


def detections_of_body(body: Body, shape: ShapeMapping) -> Detections:
    """Return the detections, in T frames, of a body from the data set with a shape from the mapping.

    Raises:
        UsageError: a size of the shape is a field, but a body has no fields.
    """
    measures = (*shape.sizes, *(shape.height or ()))
    if shape.outline or any(isinstance(measure, str) for measure in measures):
        raise UsageError(f"shapes.{body.name}: a body has no fields; give numbers")
    has_turn = body.quaternions is not None
    numbers = body.positions if body.quaternions is None else np.hstack([body.positions, body.quaternions])
    binding = Binding(
        style="keys",
        width=numbers.shape[1],
        position=(0, 1, 2),
        orientation=(3, 4, 5, 6) if has_turn else (),
        shape_sizes=tuple(float(size) for size in shape.sizes),
        height=tuple(float(bound) for bound in shape.height or ()),
    )
    return detections_of(MessageLayout(shape=shape), binding, numbers)


def column_of(columns: Columns, place: NumberPlace, times: int, episode: str) -> Floats:
    """Return the numbers (T,) at a place in T = `times` frames; NaN in the last frame for actions.

    Data sets have one fewer action than states, because no action follows the last state.

    Raises:
        LogError: the data set's files lack the feature, or have another number of rows or columns.
    """
    values = columns.get(place.feature)
    if values is None:
        raise LogError(f"{episode}: its files have no numbers of {place.feature}; download them again")
    value_rows = values.reshape(len(values), -1)
    if place.number >= value_rows.shape[1]:
        raise LogError(f"{episode}: {place.feature} has {value_rows.shape[1]} numbers a frame in its files")
    column: Floats = value_rows[:, place.number]
    if len(column) == times - 1:
        return np.append(column, nan)
    if len(column) != times:
        raise LogError(f"{episode}: {place.feature} has {len(column)} rows, and there are {times} frames")
    return column


@dataclass(frozen=True, slots=True)
class _Places:
    """Resolver of an entry's places, which may belong to other features."""

    data_set: DataSet
    feature: Feature
    key: str

    def several(
        self, key: str, texts: str | tuple[str, ...], counts: tuple[int, ...]
    ) -> tuple[NumberPlace, ...]:
        """Return the places in some texts.

        Raises:
            UsageError: a text names no place, or the number of places is not in `counts`.
        """
        path_texts = (texts,) if isinstance(texts, str) else texts
        places = tuple(place for text in path_texts for place in self._places(key, text))
        if len(places) not in counts:
            needed_text = f"{' or '.join(map(str, counts))} {'is' if counts == (1,) else 'are'} needed"
            raise UsageError(
                f"{self.key}.{key}: {listing(list(path_texts))} has {plural(len(places), 'number')}, and"
                f" {needed_text}; write {self._example(counts[-1])}"
            )
        return places

    def single(self, key: str, text: str) -> NumberPlace:
        """Return the single place in a text.

        Raises:
            UsageError: the text names no place, or several places.
        """
        (place,) = self.several(key, text, (1,))
        return place

    def _example(self, count: int) -> str:
        return "[0]" if count == 1 else f'"[0:{count}]"'

    def _places(self, key: str, place_text: str) -> Iterator[NumberPlace]:
        feature = self.feature
        if place_text in feature.places:
            yield NumberPlace(feature.name, feature.places.index(place_text), place_text)
            return
        whole_feature = self.data_set.feature(place_text)
        if whole_feature is not None:
            yield from (_place(whole_feature, index) for index in range(whole_feature.width))
            return
        slice_match = _SLICE.fullmatch(place_text)
        source = (
            feature if slice_match is None or not slice_match[1] else self.data_set.feature(slice_match[1])
        )
        if slice_match is None or source is None:
            raise UsageError(
                f"{self.key}.{key}: {feature.name} has no place {place_text!r}; {self._hint(place_text)}"
            )
        if slice_match[2] is None:
            begin, end = (
                None if bound_text is None else int(bound_text) for bound_text in slice_match.groups()[2:]
            )
            yield from (_place(source, index) for index in range(*slice(begin, end).indices(source.width)))
            return
        index = int(slice_match[2])
        if not -source.width <= index < source.width:
            raise UsageError(
                f"{self.key}.{key}: {source.name} has {plural(source.width, 'number')}, so there is no"
                f" {place_text}; write [0] to [{source.width - 1}]"
            )
        yield _place(source, index % source.width)

    def _hint(self, place_text: str) -> str:
        places, width = self.feature.places, self.feature.width
        known_names = [*places, *(feature.name for feature in self.data_set.features)]
        if hint := nearest_hint(place_text, known_names):
            return hint
        if places:
            return f"its places are {listing(list(places))}"
        return f"its {width} numbers have no names; write [0] to [{width - 1}]"


def _place(feature: Feature, index: int) -> NumberPlace:
    name = feature.places[index] if feature.places else f"{feature.name}[{index}]"
    return NumberPlace(feature.name, index, name)

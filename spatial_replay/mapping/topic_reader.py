"""Read one topic: raw messages in, columns of detections and signals out.

A message passes three steps: decoding, reading of signals, and reading of objects (by `Extractor`). Each step
may fail for single messages. One boolean mask per batch marks the good messages. A step skips bad messages,
reports its failures, and clears the flags of failing messages.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain, compress
from math import nan
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.bags.definitions import Decoder
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.mapping.binding import (
    Binding,
    Codes,
    Namer,
    TimeGetter,
    bind,
    bind_time,
    class_codes,
    ns_from_json,
)
from spatial_replay.mapping.detections import (
    DELETE_ALL_ENTITIES,
    EVERY_OBJECT,
    MARKER_ADD,
    MARKER_DELETE,
    MARKER_DELETE_ALL,
    DetectionChunk,
    Detections,
    covariances,
    detections_from_chunks,
    lenient_getter,
    local_metres,
    solids_of_entity,
    solids_of_marker,
    solids_of_perceived_object,
)
from spatial_replay.mapping.field_paths import (
    ContentError,
    FieldError,
    FieldPath,
    Get,
    NameTemplate,
    elements_of,
    enum_names,
    field_names,
    from_protobuf_json,
    getter,
    is_set,
    iter_elements,
    keys_of,
    leads_somewhere,
    list_getter,
    may_be_unset,
    sparse,
    style_of,
    walk,
)
from spatial_replay.mapping.mapping_file import (
    UNITS_NS,
    LogMapping,
    SignalMapping,
    TopicMapping,
)
from spatial_replay.mapping.message_types import (
    GENERIC,
    MessageLayout,
)
from spatial_replay.mapping.outlines import (
    features_in,
    outlines_from_lists,
    outlines_from_rings,
    points_from_lists,
    read_rows,
)
from spatial_replay.mapping.reading_plan import PlannedTopic
from spatial_replay.mapping.transforms import LEAST_STEP_NS, TransformReader
from spatial_replay.text import names_from_unit, text_number
from spatial_replay.trace.trace import LATEST_NS

_SOLIDS_OF = {"marker": solids_of_marker, "scene": solids_of_entity, "primitive": solids_of_perceived_object}


class _Objects(NamedTuple):
    """Objects in columns: decoded values, indices of their messages, codes of their names."""

    values: list[Any]
    message: list[int]
    name: list[int]

    def where(self, keep: list[bool]) -> _Objects:
        return self if all(keep) else _Objects(*(list(compress(column, keep)) for column in self))


class Extractor:
    """Reader of the objects of one topic.

    The field paths of the layout are bound to the first object. All other objects are read with the bound
    paths.

    Args:
        names, classes: codes that all topics share.
        needs_frame: whether frames of objects are read, because the mapping has a fixed frame.
    """

    def __init__(
        self, layout: MessageLayout, mapping: TopicMapping, names: Codes, classes: Codes, *, needs_frame: bool
    ) -> None:
        self.noted_frames: set[str] = set()
        self.unseen: tuple[str, ...] = ()
        """Position paths if the mapping has `missing: 0`; () once an object has any of these fields."""
        if mapping.has_zeros_left_out and mapping.position is not None:
            self.unseen = (mapping.position,) if isinstance(mapping.position, str) else mapping.position
        self.cornerless = 0
        """Number of outlines with too few corners; their objects are unknown."""
        self.stamp_faults: list[str] = []
        """Reasons why fields with names of stamps are not times."""
        self.unset: Counter[str] = Counter()
        """Number of objects in which a protobuf field is not set, by field path."""
        self._scene_stamps_ns: dict[int, int] = {}
        """Timestamps of existing scene entities, by name code."""
        self.boxes, self.leftward, self.downward = 0, 0, 0
        """Numbers of bounds: of all bounds, of bounds with the second corner left of the first corner, and of
        bounds with the second corner below the first corner."""
        self.corner_low, self.corner_high = np.full((2, 2), np.inf), np.full((2, 2), -np.inf)
        """Least and greatest coordinates of bounds: one row for first corners, one row for second corners."""
        self.differences = 0
        """Number of messages marked as a list of changes by their field `is_diff`."""
        self.turned, self.unturned = 0, 0
        """Numbers of poses with a quaternion, and of poses with a quaternion of zeros."""
        self.layout = layout
        self._names, self._classes = names, classes
        self._first_classes: dict[int, int] = {}
        self.namer = Namer(NameTemplate.of(layout.name), mapping.topic, names, mapping.only, mapping.without)
        self._needs_frame = needs_frame
        self._list_path = FieldPath.of(layout.objects) if layout.objects else None
        self._get_list: Get | None = None
        self._binding: Binding | None = None
        self._time: TimeGetter | None = None
        self._time_of_empty: TimeGetter | None = None
        self._is_time_bound = False

    @property
    def binding(self) -> Binding | None:
        """Getters of the object's fields; None before the first object."""
        return self._binding

    @property
    def is_bound(self) -> bool:
        """Whether an object was read, which shows that all paths resolve."""
        return self._binding is not None

    @property
    def is_timed(self) -> bool:
        """Whether messages have stamps."""
        return self._time is not None

    @property
    def lacks_stamp(self) -> bool:
        """Whether the first message with an object lacks a stamp."""
        return self._is_time_bound and self._time is None

    def stamp(self, message: object) -> int | None:
        """Return the stamp of a message, or the stamp of its first object; None without a stamp.

        A message without objects has a stamp, too: the time from which there are no objects.

        Raises:
            FieldError: the path of the stamp does not resolve.
        """
        first_object = next(iter(self._elements(message)), None)
        if first_object is None:
            return self._stamp_of_empty(message)
        self._bind_time(first_object, message)
        if self._time is None:
            return None
        return self._time.nanoseconds([message if self._time.path.from_message else first_object])[0]

    def _stamp_of_empty(self, message: object) -> int | None:
        time_getter = self._time
        if time_getter is None or not time_getter.path.from_message:
            if self._time_of_empty is None:
                stamps = [stamp for stamp in self.layout.stamp if FieldPath.of(stamp.field).from_message]
                self._time_of_empty = bind_time(stamps, message, message)
            time_getter = self._time_of_empty
        return None if time_getter is None else time_getter.nanoseconds([message])[0]

    def read(self, messages: Sequence[object], places: Integers, *, is_early: bool = False) -> DetectionChunk:
        """Extract the objects of some messages.

        Args:
            places: (N,) indices of the messages in their batch.
            is_early: whether the messages will be read again, in the order of their times.

        Raises:
            FieldError, AttributeError, LookupError, TypeError, ValueError, OverflowError: a message lacks
                fields of the first message, or has fields of other types. Only a FieldError names the fields.
        """
        object_values, message_indices, list_keys = self._flatten(messages)
        # `is_diff` marks a list of changes, as in moveit_msgs/PlanningScene
        if messages and "is_diff" in field_names(messages[0]):
            get = lenient_getter(style_of(messages[0]))
            self.differences += sum(bool(get(message, "is_diff")) for message in messages)
        message_of_object = (
            [messages[message_index] for message_index in message_indices]
            if self.namer.needs_messages
            else None
        )
        objects = _Objects(
            object_values, message_indices, self.namer.codes(object_values, list_keys, message_of_object)
        )
        deletions: list[tuple[int, int]] = []
        scene_stamps_ns = self._scene_stamps_ns
        if self.layout.solids == "marker":
            objects, deletions = _split_deleted_markers(objects)
        elif self.layout.solids == "scene":
            deletions, scene_stamps_ns = self._deleted_entities(messages, objects)
        if self.namer.is_filtering:
            objects = objects.where(self.namer.select(objects.name))
        chunk = DetectionChunk(places, deletions)
        if objects.values:
            if self._binding is None:
                example, message = objects.values[0], messages[objects.message[0]]
                self._binding = bind(self.layout, example, message, needs_frame=self._needs_frame)
                self._bind_time(example, message)
            self._fill(chunk, self._binding, messages, objects)
            unseen_paths = list(map(FieldPath.of, self.unseen))
            if any(leads_somewhere(path, element) for path in unseen_paths for element in objects.values):
                self.unseen = ()
        if not is_early:
            # stamps are set last, because the messages are read again one by one after a failure
            self._scene_stamps_ns = scene_stamps_ns
        return chunk

    def detections(self, chunks: Sequence[DetectionChunk], good: Booleans) -> Detections:
        """Join the chunks of a batch; see `detections_from_chunks`."""
        detections = detections_from_chunks(self.layout, self._binding, chunks, good)
        if self.layout.class_changes != "remark":
            detections = self._with_one_class(detections)
        is_in_degrees = self.layout.origin is not None or self.layout.corner_origin is not None
        return (
            detections if is_in_degrees or self.layout.scale == 1.0 else detections.scale(self.layout.scale)
        )

    def _with_one_class(self, detections: Detections) -> Detections:
        """Return detections whose objects keep their first class, or have the class in their name."""
        name_codes, classes = detections.name.tolist(), detections.class_code.tolist()
        if self.layout.class_changes == "first":
            first_classes = self._first_classes
            classes = [
                first_classes.setdefault(name, code) for name, code in zip(name_codes, classes, strict=True)
            ]
            return replace(detections, class_code=np.array(classes, np.int64))
        # the new name depends only on the class, so it is equal in a window and in the whole log
        name_codes = [self._name_of_class(name, code) for name, code in zip(name_codes, classes, strict=True)]
        return replace(detections, name=np.array(name_codes, np.int64))

    def _name_of_class(self, name: int, code: int) -> int:
        class_name = self._classes.by_code[code]
        return name if class_name is None else self._names[f"{self._names.by_code[name]}_{class_name}"]

    def _fill(
        self, chunk: DetectionChunk, binding: Binding, messages: Sequence[object], objects: _Objects
    ) -> None:
        cornerless = 0
        if self.layout.solids:
            get, solids_of = lenient_getter(binding.style), _SOLIDS_OF[self.layout.solids]
            solids = [solids_of(element, get) for element in objects.values]
            chunk.solids = list(filter(None, solids))
            chunk.skipped = len(solids) - len(chunk.solids)
            objects = objects.where(list(map(bool, solids)))
            if self.layout.stays:
                chunk.locked = [bool(get(element, "frame_locked")) for element in objects.values]
        elif binding.polygon is not None:
            corners = list(map(binding.polygon, objects.values))
            if self.layout.is_bounds and not self.layout.bounds_have_size:
                self._count_corners(corners)
            if binding.has_rings:
                chunk.outline_counts, chunk.corner_counts, chunk.corners, cornerless = outlines_from_rings(
                    corners
                )
            else:
                chunk.corner_counts, chunk.corners, cornerless = outlines_from_lists(
                    corners, is_bounds=self.layout.is_bounds, have_size=self.layout.bounds_have_size
                )
                chunk.outline_counts = np.ones(len(corners), np.int64)
            if self.layout.corner_origin is not None:
                fixes = chunk.corners[:, 1::-1] * self.layout.scale
                chunk.corners[:, :2] = local_metres(fixes, self.layout.corner_origin)
        values = objects.values
        if binding.numbers is not None:
            chunk.numbers = read_rows(binding.numbers, values, binding.width, binding.style)
            self._forget_unset(binding, chunk.numbers, values)
            if self.layout.invalid:
                chunk.numbers[np.isin(chunk.numbers, with_single_precision(self.layout.invalid))] = nan
            if self.layout.origin is not None:
                # positions may be degrees times 10,000,000, while sizes are metres
                chunk.numbers[:, list(binding.position[:2])] *= self.layout.scale
            if binding.orientation:
                is_turned = chunk.numbers[:, list(binding.orientation)].any(axis=1)
                self.turned += len(values)
                self.unturned += len(values) - int(is_turned.sum())
        chunk.covariance = covariances(self.layout, binding, values)
        chunk.class_code = class_codes(self.layout, binding, values, self._classes)
        chunk.frames = self._frames(binding, messages, objects)
        self._fill_stamps(chunk, binding, messages, objects)
        if binding.lifetime is not None:
            chunk.lifetimes = binding.lifetime.nanoseconds(values)
        elif self.layout.stays:
            chunk.lifetimes = [ns_from_json(element.get("lifetime")) for element in values]
        chunk.message, chunk.name = objects.message, objects.name
        self.cornerless += cornerless

    def _forget_unset(self, binding: Binding, numbers: Floats, objects: Sequence[object]) -> None:
        """Replace the default of each unset protobuf field by NaN."""
        for column, path, default in binding.unset:
            # a number other than the default was set; for the default, the field's presence decides
            for row in np.flatnonzero(numbers[:, column] == default).tolist():
                if not is_set(path, objects[row]):
                    numbers[row, column] = nan
                    self.unset[path.text] += 1

    def _count_corners(self, corner_lists: Sequence[Any]) -> None:
        """Count the boxes of a chunk by the direction from their first to their second corner."""
        corner_counts, points = points_from_lists([corners for corners in corner_lists if len(corners)])
        first_corners = (np.cumsum(corner_counts) - corner_counts)[corner_counts == 2]
        diagonals = points[first_corners + 1] - points[first_corners] if len(first_corners) else points[:0]
        self.boxes += len(diagonals)
        self.leftward += int(np.count_nonzero(diagonals[:, 0] < 0))
        self.downward += int(np.count_nonzero(diagonals[:, 1] < 0))
        for corner, point_indices in enumerate(
            (first_corners, first_corners + 1) if len(first_corners) else ()
        ):
            self.corner_low[corner] = np.fmin(
                self.corner_low[corner], np.fmin.reduce(points[point_indices, :2])
            )
            self.corner_high[corner] = np.fmax(
                self.corner_high[corner], np.fmax.reduce(points[point_indices, :2])
            )

    def _flatten(self, messages: Sequence[object]) -> tuple[list[Any], list[int], list[int | str]]:
        """Return all objects, each object's message index, and each object's index or key in its list."""
        if self._list_path is None:
            return list(messages), list(range(len(messages))), [0] * len(messages)
        if self._get_list is None and messages:
            # the first message is read step by step, because errors of the fast getter do not name the fields
            list(iter_elements(self._list_path, messages[0]))
            self._get_list = list_getter(self._list_path, messages[0]) or self._elements
        object_lists = list(map(self._get_list, messages)) if self._get_list is not None else []
        keys_by_list = (
            map(str, keys_of(holder)) if isinstance(holder, Mapping) else range(len(holder))
            for holder in object_lists
        )
        list_keys: list[int | str] = list(chain.from_iterable(keys_by_list))
        object_lists = list(map(elements_of, object_lists))
        message_indices = np.repeat(np.arange(len(object_lists)), list(map(len, object_lists))).tolist()
        return list(chain.from_iterable(object_lists)), message_indices, list_keys

    def _elements(self, message: object) -> list[object]:
        return [message] if self._list_path is None else list(iter_elements(self._list_path, message))

    def _deleted_entities(
        self, messages: Sequence[object], entities: _Objects
    ) -> tuple[list[tuple[int, int]], dict[int, int]]:
        """Return (message, name) of each deletion in a foxglove.SceneUpdate, and all remaining stamps.

        A deletion concerns only earlier entities
        (https://docs.foxglove.dev/docs/sdk/schemas/scene-entity-deletion). A message's entities are added
        after its deletions.
        """
        deletions: list[tuple[int, int]] = []
        stamps_ns = dict(self._scene_stamps_ns)
        entity_starts = np.searchsorted(entities.message, np.arange(len(messages) + 1)).tolist()
        stamps = [_stamp_of_scene(entity) for entity in entities.values]
        for message_index, message in enumerate(messages):
            get = lenient_getter(style_of(message))
            for deletion in get(message, "deletions") or ():
                # a deletion without a timestamp concerns all earlier entities
                stamp_ns = _stamp_of_scene(deletion) or LATEST_NS
                if get(deletion, "type") in DELETE_ALL_ENTITIES:
                    candidate_names = list(stamps_ns)
                else:
                    candidate_names = self.namer.codes([deletion], [0], [message])
                deleted_names = [name for name in candidate_names if stamps_ns.get(name, 0) <= stamp_ns]
                for name in deleted_names:
                    stamps_ns.pop(name, None)
                deletions += [(message_index, name) for name in deleted_names]
            message_entities = slice(entity_starts[message_index], entity_starts[message_index + 1])
            stamps_ns.update(zip(entities.name[message_entities], stamps[message_entities], strict=True))
        return deletions, stamps_ns

    def _bind_time(self, example: object, message: object) -> None:
        if not self._is_time_bound:
            self._time = bind_time(self.layout.stamp, example, message, self.stamp_faults)
            self._is_time_bound = True

    def _frames(self, binding: Binding, messages: Sequence[object], objects: _Objects) -> list[str] | None:
        """Return the frame of each object; None if frames are not needed, or messages name no frame."""
        if self.layout.frame_name is not None:
            self.noted_frames.add(self.layout.frame_name)
            return [self.layout.frame_name] * len(objects.values) if self._needs_frame else None
        if binding.frame is None or not objects.values:
            return None
        get, from_message = binding.frame
        frames = [str(get(root)).removeprefix("/") for root in (messages if from_message else objects.values)]
        if binding.outer_frame is not None and not all(frames):
            outer_frames = [str(binding.outer_frame(message)).removeprefix("/") for message in messages]
            frames = [
                frame or outer_frames[index] for frame, index in zip(frames, objects.message, strict=True)
            ]
        self.noted_frames.update(frames)
        if not self._needs_frame:
            return None
        return [frames[index] for index in objects.message] if from_message else frames

    def _fill_stamps(
        self, chunk: DetectionChunk, binding: Binding, messages: Sequence[object], objects: _Objects
    ) -> None:
        """Read the stamps of objects if frames are needed; otherwise only the first stamp of the chunk."""
        if self._time is None:
            return
        from_message = self._time.path.from_message
        if not self._needs_frame:
            first_root = messages[:1] if from_message else objects.values[:1]
            stamps = self._time.nanoseconds(first_root)
            chunk.noted_stamps = list(zip(chunk.places[:1].tolist(), stamps, strict=False))
        elif from_message:
            stamps = self._time.nanoseconds(messages)
            chunk.stamps = [stamps[index] for index in objects.message]
            if binding.own_stamp is not None:
                own_stamps = binding.own_stamp.nanoseconds(objects.values)
                # a stamp of 0 was not set
                chunk.stamps = [
                    stamp or message_stamp
                    for stamp, message_stamp in zip(own_stamps, chunk.stamps, strict=True)
                ]
            chunk.noted_stamps = list(zip(chunk.places.tolist(), stamps, strict=True))
        else:
            chunk.stamps = self._time.nanoseconds(objects.values)
            batch_indices = chunk.places[objects.message].tolist()
            chunk.noted_stamps = list(zip(batch_indices, chunk.stamps, strict=True))


def _stamp_of_scene(entity: Any) -> int:
    """Return the timestamp of an entity or a deletion, nanoseconds; 0 without a timestamp."""
    if isinstance(entity, dict):
        return ns_from_json(entity.get("timestamp"))
    stamp = entity.timestamp
    # a protobuf Timestamp, or a ROS 2 time
    return int(
        stamp.seconds * 10**9 + stamp.nanos
        if hasattr(stamp, "seconds")
        else stamp.sec * 10**9 + stamp.nanosec
    )


def _split_deleted_markers(objects: _Objects) -> tuple[_Objects, list[tuple[int, int]]]:
    """Return the added markers, and (message, name) of each deleted marker."""
    deletions: list[tuple[int, int]] = []
    if not objects.values:
        return objects, deletions
    get = lenient_getter(style_of(objects.values[0]))
    actions = [get(marker, "action") for marker in objects.values]
    if not any(actions):
        return objects, deletions
    for action, message, name in zip(actions, objects.message, objects.name, strict=True):
        if action == MARKER_DELETE_ALL:
            deletions.append((message, EVERY_OBJECT))
        elif action == MARKER_DELETE:
            deletions.append((message, name))
    return objects.where([action == MARKER_ADD or not action for action in actions]), deletions


MISFITS = (FieldError, AttributeError, LookupError, TypeError, ValueError, OverflowError)
"""Errors of reading a message that does not fit the mapping."""

ReportFault: TypeAlias = Callable[[str, int, str], None]
"""Receiver of lost messages: topic, log time, and reason."""

_NO_STAMP = (
    "the clock is header, but its messages have no stamp; give `stamp`, or `clock: log` for this topic"
)

_PATIENCE = 100
"""Number of misfitting messages, before any fitting message, that shows a wrong mapping."""

_MOST_UNNAMED, _LONGEST_UNNAMED = 8, 40
"""Limits of remarks on texts without a number: number of texts, and characters of a text."""

_CHUNK = 256
"""Limit of messages decoded together. It is low, so that decoded contents are freed soon."""
_CHUNK_BYTES = 2**14
"""Usual size of messages that are decoded together, bytes."""


class TopicColumns(NamedTuple):
    """Columns of N messages of a topic, M of them good.

    Attributes:
        good: (N,) whether each message could be read.
        detections: objects of the M good messages; None for a topic without objects.
        signals: (M, S) value of each signal in each good message.
        stamps: (K, 2) message index and stamp of some of the N messages, nanoseconds.
    """

    good: Booleans
    detections: Detections | None
    signals: Floats
    stamps: Integers


class TopicReader:
    """Reader of one topic: decoder of messages, and reader of stamps, objects and signals.

    Args:
        names, classes: codes that all topics share.
        decodes_early: whether messages with frames of objects are decoded on arrival.
        report: receiver of lost messages.
    """

    def __init__(
        self,
        planned: PlannedTopic,
        mapping: LogMapping,
        decoder: Callable[[str], Decoder],
        names: Codes,
        classes: Codes,
        *,
        decodes_early: bool,
        report: ReportFault,
    ) -> None:
        needs_frame = mapping.fixed_frame is not None
        self.planned = planned
        self.needs_frame = needs_frame
        self.name = planned.name
        self.axes = mapping.axes
        self.pending = PendingMessages(has_own_clock=planned.clock == "header")
        self.decodes_on_arrival = (
            planned.is_transforms
            or planned.clock == "header"
            or (decodes_early and needs_frame and planned.layout is not None)
        )
        self.transforms = TransformReader() if planned.is_transforms else None
        self.extractor: Extractor | None = None
        self.unstamped = 0
        """Number of messages that have no time on the clock `header`: without a stamp, or with stamp 0."""
        self._is_stamped = False
        if planned.layout is not None and planned.mapping is not None:
            self.extractor = Extractor(
                planned.layout, planned.mapping, names, classes, needs_frame=needs_frame
            )
        self._mapping_name = mapping.name
        self._report = report
        is_decoded = self.is_mapped or self.decodes_on_arrival
        self._decode: Decoder = decoder(planned.topic) if is_decoded else _skip
        decode = self._decode
        if is_decoded and planned.layout is not None and planned.layout.is_geojson:
            self._decode = lambda payload: features_in(decode(payload))
        elif is_decoded and planned.is_protobuf_json:
            objects_path = planned.layout.objects if planned.layout is not None else ""
            self._decode = lambda payload: from_protobuf_json(decode(payload), objects_path)
        if is_decoded and planned.mapping is not None and planned.mapping.has_zeros_left_out:
            decode_fully = self._decode
            self._decode = lambda payload: sparse(decode_fully(payload))
        self._time: TimeGetter | None = None
        self._is_time_bound = False
        self._signal_fields = () if planned.mapping is None else planned.mapping.signals
        self._signals: list[Get] | None = None
        self.unnamed: dict[str, dict[str, None]] = {}
        """Examples of texts for which the mapping has no number, by signal."""
        self._misfits: dict[str, tuple[int, str]] = {}

    @property
    def is_mapped(self) -> bool:
        """Whether the mapping has an entry of this topic."""
        return self.planned.mapping is not None

    @property
    def repeats_times(self) -> bool:
        """Whether messages with equal times are all valid, because they have different objects."""
        if self.extractor is None or self.planned.layout is None:
            return self.transforms is not None
        return not (self.planned.layout.complete or self.extractor.namer.is_constant)

    @property
    def advances_time(self) -> bool:
        """Whether the topic's times advance the time of the log.

        Log times advance the log's time. Stamps of transforms and of latched messages do not, because these
        stamps may be in the future or the past.
        """
        if self.planned.clock == "log":
            return True
        return not self.planned.is_latched and (self.transforms is None or self.extractor is not None)

    def decode(self, payloads: Sequence[bytes], log_times_ns: Sequence[int], good: Booleans) -> list[Any]:
        """Decode the good messages; None for other messages, and for messages that cannot be decoded."""
        return self._read_each(self._decode, payloads, log_times_ns, good)

    def stamps(self, messages: Sequence[Any], log_times_ns: Sequence[int], good: Booleans) -> Integers:
        """Return the stamp (N,) of each message, nanoseconds; clear the flags of messages without a stamp.

        Raises:
            UsageError: the path of the stamp does not resolve.
        """

        def read(message: object) -> int | None:
            stamp_ns = self._stamp(message)
            if stamp_ns is not None and not 0 <= stamp_ns <= LATEST_NS:
                raise ContentError(f"its stamp {stamp_ns} ns lies outside the times of a log")
            # a stamp of 0 was not set; simulators send it before they have a time
            return stamp_ns or (0 if self.planned.is_static else None)

        stamps_ns = self._read_each(read, messages, log_times_ns, good)
        # a message with an empty list and without a header has no stamp
        has_stamp = np.array([time_ns is not None for time_ns in stamps_ns], np.bool_)
        self.unstamped += int(np.count_nonzero(good & ~has_stamp))
        good &= has_stamp
        if not self._is_stamped and good.any():
            self._is_stamped = True
            first_index = int(good.argmax())
            unit = unit_of_stamp(stamps_ns[first_index] or 0, log_times_ns[first_index])
            if unit != "ns":
                raise self._misfit_error(
                    f"stamps in {unit} are read as ns; write `stamp: {{field: PATH, unit: {unit}}}`"
                )
        return np.array([time_ns or 0 for time_ns in stamps_ns], np.int64)

    def read(self, log_times_ns: Integers, contents: Sequence[Any]) -> TopicColumns:
        """Read objects and signals.

        Args:
            contents: payloads, or decoded messages if the reader `decodes_on_arrival`.

        Raises:
            UsageError: many messages came, and the mapping fits none of them.
        """
        good = np.ones(len(contents), np.bool_)
        chunks: list[DetectionChunk] = []
        signal_rows: list[list[float]] = []
        all_times_ns = log_times_ns.tolist()
        chunk_size = _chunk_size(contents)
        for begin in range(0, len(contents), chunk_size):
            messages, chunk_times_ns = (
                contents[begin : begin + chunk_size],
                all_times_ns[begin : begin + chunk_size],
            )
            # `is_chunk_good` is a view, so that clearing its flags clears the flags in `good`
            is_chunk_good = good[begin : begin + chunk_size]
            if not self.decodes_on_arrival:
                messages = self.decode(messages, chunk_times_ns, is_chunk_good)
            chunk_signals = (
                self._read_each(self._signal_values, messages, chunk_times_ns, is_chunk_good)
                if self._signal_fields
                else []
            )
            if self.extractor is not None:
                chunks += self._read_objects(self.extractor, messages, begin, chunk_times_ns, is_chunk_good)
            signal_rows += compress(chunk_signals, is_chunk_good.tolist())
        return TopicColumns(
            good=good,
            detections=None if self.extractor is None else self.extractor.detections(chunks, good),
            signals=np.array(signal_rows, np.float64).reshape(int(good.sum()), len(self._signal_fields)),
            stamps=np.array([stamp for chunk in chunks for stamp in chunk.noted_stamps], np.int64).reshape(
                -1, 2
            ),
        )

    def finish(self) -> None:
        """Check after the last message that the mapping fitted at least one message.

        Raises:
            UsageError: there were messages, but the mapping fitted none of them.
        """
        if self.unstamped and not self._is_stamped and self.is_mapped:
            raise self._misfit_error(_NO_STAMP)
        for kind, (_, first_reason) in self._misfits.items():
            is_bound = self._signals is not None
            if kind == "objects":
                is_bound = self.extractor is None or self.extractor.is_bound
            if not is_bound:
                raise self._misfit_error(first_reason)
        if self.extractor is not None and self.extractor.is_bound and self.extractor.unseen:
            paths = ", ".join(self.extractor.unseen)
            raise self._misfit_error(
                f"none of its messages has {paths}; with `missing: 0` the position would be 0 in all of them"
            )

    def _read_each(
        self,
        read: Callable[[Any], Any],
        arguments: Sequence[Any],
        log_times_ns: Sequence[int],
        is_good: Booleans,
    ) -> list[Any]:
        """Apply `read` to the good arguments; report the failures and clear their flags."""
        results: list[Any] = [None] * len(arguments)
        for index in np.flatnonzero(is_good).tolist():
            try:
                results[index] = read(arguments[index])
            except (*MISFITS, LogError) as error:
                is_good[index] = False
                reason = str(error)
                if not isinstance(error, FieldError | LogError):
                    reason = f"the message differs from the others: {error}"
                self._report(self.name, log_times_ns[index], reason)
        return results

    def _read_objects(
        self,
        extractor: Extractor,
        messages: Sequence[Any],
        first_index: int,
        log_times_ns: Sequence[int],
        is_good: Booleans,
    ) -> list[DetectionChunk]:
        """Read the objects of the good messages: all together or, if a message does not fit, one by one.

        Args:
            first_index: index of the first message in its batch.
        """
        good_indices = np.flatnonzero(is_good)
        try:
            return [
                extractor.read(
                    [messages[index] for index in good_indices.tolist()], first_index + good_indices
                )
            ]
        except MISFITS:
            pass

        # one message has another form, and is found by reading each message alone
        def read(indexed_message: tuple[int, object]) -> DetectionChunk:
            index, message = indexed_message
            was_bound = extractor.is_bound
            try:
                return extractor.read([message], np.array([index]))
            except ContentError:
                # a bad value is no evidence against the mapping
                raise
            except MISFITS as error:
                if not was_bound:
                    self._count_misfit("objects", error)
                raise

        chunks = self._read_each(read, list(enumerate(messages, first_index)), log_times_ns, is_good)
        return [chunk for chunk in chunks if chunk is not None]

    def _signal_values(self, message: object) -> list[float]:
        if self._signals is None:
            try:
                self._signals = [self._bind_signal(signal, message) for signal in self._signal_fields]
            except FieldError as error:
                self._count_misfit("signals", error)
                raise
        return [read(message) for read in self._signals]

    def _bind_signal(self, signal: SignalMapping, message: object) -> Get:
        path = FieldPath.of(signal.field)
        walk(path, message)
        get_value, number_by_name = _getter_of_set_values(path, message), names_from_unit(signal.unit)
        enum_name_by_number = enum_names(path, message)
        if enum_name_by_number and not (
            number_by_name and number_by_name.keys().isdisjoint(enum_name_by_number.values())
        ):
            get_number = get_value

            def get_value(message: object) -> object:
                # the enum's name, as in ProtoJSON; a number without a name stays a number
                code = get_number(message)
                return enum_name_by_number.get(
                    code, str(code) if number_by_name and code is not None else code
                )

        try:
            _number(get_value(message))
        except (TypeError, OverflowError):
            raise FieldError(f"{signal.field}: its value is neither a number nor a text") from None

        invalid = with_single_precision(() if self.planned.mapping is None else self.planned.mapping.invalid)

        def number_of(message: object) -> float:
            value = get_value(message)
            if invalid and value in invalid:
                return nan
            if not (number_by_name and isinstance(value, str)):
                return _number(value)
            if value not in number_by_name:
                unnamed_texts = self.unnamed.setdefault(signal.name, {})
                if len(unnamed_texts) < _MOST_UNNAMED:
                    unnamed_texts.setdefault(value[:_LONGEST_UNNAMED])
            return number_by_name.get(value, nan)

        return number_of

    def _stamp(self, message: object) -> int | None:
        if self.transforms is not None and self.extractor is None:
            return self.transforms.stamp(message)
        try:
            if self.extractor is not None:
                time_ns = self.extractor.stamp(message)
                if self.extractor.lacks_stamp:
                    raise self._misfit_error(next(iter(self.extractor.stamp_faults), _NO_STAMP))
                return time_ns
            if not self._is_time_bound:
                entry = self.planned.mapping
                stamps = GENERIC.stamp if entry is None or entry.stamp is None else (entry.stamp,)
                self._time = bind_time(stamps, message, message)
                self._is_time_bound = True
        except FieldError as error:
            # without an earlier stamp the mapping is wrong; otherwise only this message is wrong
            if self._is_time_bound or (self.extractor is not None and self.extractor.is_timed):
                raise
            raise self._misfit_error(f"the clock is header, but {error}") from None
        if self._time is None:
            raise self._misfit_error(_NO_STAMP)
        return self._time.nanoseconds([message])[0]

    def _count_misfit(self, kind: str, error: Exception) -> None:
        """Count a misfitting message; called only before the first fitting message.

        Raises:
            UsageError: there were many misfitting messages.
        """
        misfit_count, first_reason = self._misfits.get(kind, (0, ""))
        reason = str(error) if isinstance(error, FieldError) else f"its messages are not as expected: {error}"
        self._misfits[kind] = misfit_count + 1, first_reason or reason
        if misfit_count + 1 >= _PATIENCE:
            raise self._misfit_error(first_reason)

    def _misfit_error(self, reason: str) -> UsageError:
        return UsageError(f"{self._mapping_name}: topics.{self.name}: {reason}")


def with_single_precision(numbers: Sequence[float]) -> list[float]:
    """Return numbers, and the same numbers rounded to float32, because a field may have this type."""
    # 0.1 in a field of type float32 is read as 0.10000000149011612
    return [*numbers, *np.array(numbers, np.float32).astype(np.float64).tolist()]


def _getter_of_set_values(path: FieldPath, example: object) -> Get:
    """Return the getter of a path, which returns None for an unset protobuf field."""
    get = getter(path, example)
    if not may_be_unset(path, example):
        return get

    def get_if_set(message: object) -> object:
        return get(message) if is_set(path, message) else None

    return get_if_set


def unit_of_stamp(stamp: int, log_time_ns: int) -> str:
    """Return the unit in which a stamp is within an hour of the log time; "ns" if no unit fits."""
    near_units = (
        unit for unit, unit_ns in UNITS_NS.items() if abs(stamp * unit_ns - log_time_ns) < 3600 * 10**9
    )
    return next(near_units, "ns")


class ClockStep(NamedTuple):
    """A step back of a topic's times in the order of recording.

    Attributes:
        is_sorted: whether messages are sorted by time, because sequence numbers do not give their order.
    """

    from_ns: int
    to_ns: int
    is_sorted: bool


class PendingMessages:
    """Messages of one topic that wait until no earlier message can arrive.

    Attributes:
        first_step: first step back of the times; None without a step back.
        taken_ns: latest time of the messages that were taken.
    """

    def __init__(self, *, has_own_clock: bool) -> None:
        self.first_step: ClockStep | None = None
        self.taken_ns = -1
        self._has_own_clock = has_own_clock
        self._columns: list[tuple[Integers, Integers, Integers, Integers]] = []
        self._contents: list[Any] = []

    def __len__(self) -> int:
        return len(self._contents)

    @property
    def first_ns(self) -> int | None:
        """Time of the earliest waiting message; None without a waiting message."""
        return min((int(times_ns.min()) for times_ns, *_ in self._columns if len(times_ns)), default=None)

    @property
    def times_ns(self) -> Integers:
        """Times of the waiting messages, in the order of arrival."""
        return np.concatenate([np.empty(0, np.int64), *(times_ns for times_ns, *_ in self._columns)])

    def add(self, columns: tuple[Integers, Integers, Integers, Integers], contents: list[Any]) -> None:
        """Add messages in the order of arrival.

        Args:
            columns: times, sequence numbers, log times, and record numbers, which increase in the order of
                recording.
            contents: payloads, or decoded messages.
        """
        self._columns.append(columns)
        self._contents += contents

    def take(self, upto_ns: int) -> tuple[Integers, Integers, list[Any]]:
        """Remove the messages up to a time; return their times, log times and contents.

        The order is by time, then sequence number, then arrival. If the clock stepped back, later messages
        get times right after the messages before the step.
        """
        no_integers = np.empty(0, np.int64)
        column_parts = zip((no_integers, no_integers, no_integers, no_integers), *self._columns, strict=True)
        times_ns, sequence_numbers, log_times_ns, record_numbers = map(np.concatenate, column_parts)
        contents = self._contents
        if not (record_numbers[1:] > record_numbers[:-1]).all() or not (times_ns[1:] >= times_ns[:-1]).all():
            times_ns = self._without_steps(times_ns, sequence_numbers, record_numbers, upto_ns)
        if len(times_ns) and not (times_ns[1:] > times_ns[:-1]).all():
            # lexsort is stable, so that the order of arrival decides last
            time_order = np.lexsort((sequence_numbers, times_ns))
            times_ns, sequence_numbers, log_times_ns = (
                times_ns[time_order],
                sequence_numbers[time_order],
                log_times_ns[time_order],
            )
            record_numbers, contents = (
                record_numbers[time_order],
                [contents[index] for index in time_order.tolist()],
            )
        end = int(np.searchsorted(times_ns, upto_ns, "right"))
        self._columns = [
            (
                times_ns[end:],
                sequence_numbers[end:],
                log_times_ns[end:],
                record_numbers[end:],
            )
        ]
        self._contents = contents[end:]
        self.taken_ns = max(self.taken_ns, int(times_ns[:end].max(initial=-1)))
        return times_ns[:end], log_times_ns[:end], contents[:end]

    def _without_steps(
        self, times_ns: Integers, sequence_numbers: Integers, record_numbers: Integers, upto_ns: int
    ) -> Integers:
        """Return times without steps back; unchanged times unless all sequence numbers increase."""
        record_order = np.argsort(record_numbers, kind="stable")
        recorded_times_ns = times_ns[record_order]
        step_indices = np.flatnonzero(recorded_times_ns[1:] < recorded_times_ns[:-1] - LEAST_STEP_NS)
        # the log's sequence numbers do not order messages on the sender's clock
        is_sorted = self._has_own_clock or not (np.diff(sequence_numbers[record_order]) > 0).all()
        if is_sorted and len(step_indices):
            # steps of later messages wait, because earlier recorded messages may still arrive
            step_indices = step_indices[recorded_times_ns[step_indices + 1] <= upto_ns]
            step_indices = step_indices[np.argsort(recorded_times_ns[step_indices + 1], kind="stable")]
        if not len(step_indices):
            return times_ns
        first_step = int(step_indices[0])
        self.first_step = self.first_step or ClockStep(
            int(recorded_times_ns[first_step]), int(recorded_times_ns[first_step + 1]), is_sorted
        )
        if is_sorted:
            return times_ns
        # times increase strictly, so that a message recorded later is valid later
        message_numbers = np.arange(len(recorded_times_ns))
        moved_times_ns = np.empty_like(recorded_times_ns)
        moved_times_ns[record_order] = (
            np.maximum.accumulate(recorded_times_ns - message_numbers) + message_numbers
        )
        return moved_times_ns


def _number(value: object) -> float:
    """Return the value of a signal; NaN for None, and the `text_number` of a text."""
    try:
        return float("nan") if value is None else float(value)  # type: ignore[arg-type]
    except ValueError:
        return text_number(str(value))


def _skip(payload: bytes) -> None:
    """Decode nothing, for a topic that is read only for its times."""


def _chunk_size(contents: Sequence[Any]) -> int:
    if not contents or not isinstance(contents[0], bytes):
        return _CHUNK
    return max(8, min(_CHUNK, _CHUNK_BYTES * len(contents) // max(1, sum(map(len, contents)))))

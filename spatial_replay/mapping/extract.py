"""Extract the objects of one topic: decoded messages in, chunks of detections out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain, compress
from typing import Any, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Integers
from spatial_replay.mapping.binding import Binding, TimeGetter, bind, bind_time
from spatial_replay.mapping.detections import (
    EVERY_OBJECT,
    DetectionChunk,
    Detections,
    covariances,
    detections_from_chunks,
    outlines_from_lists,
    rows_from_tuples,
)
from spatial_replay.mapping.field_paths import (
    FieldPath,
    Get,
    NameTemplate,
    elements_of,
    iter_elements,
    keys_of,
    leads_somewhere,
    list_getter,
    style_of,
)
from spatial_replay.mapping.footprints import (
    DELETE_ALL_ENTITIES,
    MARKER_ADD,
    MARKER_DELETE,
    MARKER_DELETE_ALL,
    lenient_getter,
    solids_of_entity,
    solids_of_marker,
    solids_of_perceived_object,
)
from spatial_replay.mapping.message_types import MessageLayout
from spatial_replay.mapping.model import TopicMapping
from spatial_replay.mapping.names import Codes, Namer, class_codes

_SOLIDS_OF = {"marker": solids_of_marker, "scene": solids_of_entity, "primitive": solids_of_perceived_object}


class _Objects(NamedTuple):
    """Objects in columns: their decoded values, the index of each one's message, the code of its name."""

    values: list[Any]
    message: list[int]
    name: list[int]

    def where(self, keep: list[bool]) -> _Objects:
        return self if all(keep) else _Objects(*(list(compress(column, keep)) for column in self))


class Extractor:
    """Reads the objects of one topic.

    The field paths of the layout are bound to the first object; all others are read with the bound paths.

    Args:
        names, classes: codes that all topics share.
        needs_frame: whether there is a fixed frame, so that frames matter.
    """

    def __init__(
        self, layout: MessageLayout, mapping: TopicMapping, names: Codes, classes: Codes, *, needs_frame: bool
    ) -> None:
        self.noted_frames: set[str] = set()
        self.unseen: tuple[str, ...] = ()
        """With zeros left out, the paths of the position while no object had any of them."""
        if mapping.has_zeros_left_out and mapping.position is not None:
            self.unseen = (mapping.position,) if isinstance(mapping.position, str) else mapping.position
        self.cornerless = 0
        """Outlines with too few corners, whose objects are unknown."""
        self._layout = layout
        self._classes = classes
        self._namer = Namer(NameTemplate.of(layout.name), mapping.topic, names, mapping.only, mapping.without)
        self._needs_frame = needs_frame
        self._path = FieldPath.of(layout.objects) if layout.objects else None
        self._list: Get | None = None
        self._binding: Binding | None = None
        self._time: TimeGetter | None = None
        self._time_of_empty: TimeGetter | None = None
        self._is_time_bound = False

    @property
    def is_bounds(self) -> bool:
        """Whether outlines are boxes by two of their corners."""
        return self._layout.is_bounds

    @property
    def is_by_place(self) -> bool:
        """Whether nothing but their places in a list distinguished some objects."""
        return self._namer.is_by_place

    @property
    def is_bound(self) -> bool:
        """Whether an object was read, so that every path is known to lead somewhere."""
        return self._binding is not None

    @property
    def is_timed(self) -> bool:
        """Whether stamps were found."""
        return self._time is not None

    @property
    def lacks_stamp(self) -> bool:
        """Whether a message was read that has no stamp where there could be one."""
        return self._is_time_bound and self._time is None

    def stamp(self, message: object) -> int | None:
        """Return the stamp of a message, or that of its first object; None if it has none.

        A message without objects has its own stamp, if its type has one: it says that there are none.

        Raises:
            FieldError: there is no stamp where the layout says.
        """
        first = next(iter(self._elements(message)), None)
        if first is None:
            return self._stamp_of_empty(message)
        self._bind_time(first, message)
        if self._time is None:
            return None
        return self._time.nanoseconds([message if self._time.path.from_message else first])[0]

    def _stamp_of_empty(self, message: object) -> int | None:
        time = self._time
        if time is None or not time.path.from_message:
            if self._time_of_empty is None:
                own = [each for each in self._layout.stamp if FieldPath.of(each.field).from_message]
                self._time_of_empty = bind_time(own, message, message)
            time = self._time_of_empty
        return None if time is None else time.nanoseconds([message])[0]

    def read(self, messages: Sequence[object], places: Integers) -> DetectionChunk:
        """Extract the objects of some messages.

        Args:
            places: (N,) the place of each message in its batch.

        Raises:
            FieldError, AttributeError, LookupError, TypeError, ValueError, OverflowError: a message differs
                from the others; FieldError says how.
        """
        values, index, order = self._flatten(messages)
        style = style_of(messages[0]) if messages else "attributes"
        deleted: list[tuple[int, int]] = []
        if self._layout.solids == "scene":
            deleted = self._deleted_entities(messages)
        of_message = [messages[number] for number in index] if self._namer.needs_messages else None
        objects = _Objects(values, index, self._namer.codes(values, order, style, of_message))
        if self._layout.solids == "marker":
            objects, deleted = _split_deleted_markers(objects)
        if self._namer.is_filtering:
            objects = objects.where(self._namer.wanted(objects.name))
        chunk = DetectionChunk(places, deleted)
        if objects.values:
            if self._binding is None:
                example, message = objects.values[0], messages[objects.message[0]]
                self._binding = bind(self._layout, example, message, needs_frame=self._needs_frame)
                self._bind_time(example, message)
            self._fill(chunk, self._binding, messages, objects)
            paths = [FieldPath.of(each) for each in self.unseen]
            if any(leads_somewhere(path, each) for path in paths for each in objects.values):
                self.unseen = ()
        return chunk

    def detections(self, chunks: Sequence[DetectionChunk], good: Booleans) -> Detections:
        """Join the chunks of a batch; see `detections_from_chunks`."""
        return detections_from_chunks(self._layout, self._binding, chunks, good)

    def _fill(
        self, chunk: DetectionChunk, binding: Binding, messages: Sequence[object], objects: _Objects
    ) -> None:
        cornerless = 0
        if self._layout.solids:
            get, solids_of = lenient_getter(binding.style), _SOLIDS_OF[self._layout.solids]
            solids = [solids_of(each, get) for each in objects.values]
            chunk.solids = [each for each in solids if each]
            chunk.skipped = len(solids) - len(chunk.solids)
            objects = objects.where([bool(each) for each in solids])
            if self._layout.stays:
                chunk.locked = [bool(get(each, "frame_locked")) for each in objects.values]
        elif binding.polygon is not None:
            corners = [binding.polygon(each) for each in objects.values]
            outlines = outlines_from_lists(corners, is_bounds=self._layout.is_bounds)
            chunk.corner_counts, chunk.corners, cornerless = outlines
        values = objects.values
        if binding.numbers is not None:
            rows = map(binding.numbers, values)
            chunk.numbers = rows_from_tuples(rows, len(values), binding.width, binding.style)
        chunk.covariance = covariances(self._layout, binding, values)
        chunk.class_code = class_codes(self._layout, binding, values, self._classes)
        chunk.frames = self._frames(binding, messages, objects)
        chunk.stamps = self._stamps(messages, objects)
        if binding.lifetime is not None:
            chunk.lifetimes = binding.lifetime.nanoseconds(values)
        chunk.message, chunk.name = objects.message, objects.name
        self.cornerless += cornerless

    def _flatten(self, messages: Sequence[object]) -> tuple[list[Any], list[int], list[int | str]]:
        """Return all objects, the index of each one's message, and its index, or key, in that message."""
        if self._path is None:
            return list(messages), list(range(len(messages))), [0] * len(messages)
        if self._list is None and messages:
            # step by step once, because the errors of the fast getter name no fields
            list(iter_elements(self._path, messages[0]))
            self._list = list_getter(self._path, style_of(messages[0])) or self._elements
        lists = list(map(self._list, messages)) if self._list is not None else []
        counts = [len(each) for each in lists]
        index = np.repeat(np.arange(len(counts)), counts).tolist()
        order: list[int | str] = list(chain.from_iterable(map(range, counts)))
        if any(isinstance(each, Mapping) for each in lists):
            keys = (map(str, keys_of(e)) if isinstance(e, Mapping) else range(len(e)) for e in lists)
            order = list(chain.from_iterable(keys))
            lists = list(map(elements_of, lists))
            counts = [len(each) for each in lists]
            index = np.repeat(np.arange(len(counts)), counts).tolist()
        return list(chain.from_iterable(lists)), index, order

    def _elements(self, message: object) -> list[object]:
        return [message] if self._path is None else list(iter_elements(self._path, message))

    def _deleted_entities(self, messages: Sequence[object]) -> list[tuple[int, int]]:
        """Return (message, name) of each deletion in a foxglove.SceneUpdate."""
        deleted: list[tuple[int, int]] = []
        for number, message in enumerate(messages):
            get = lenient_getter(style_of(message))
            for deletion in get(message, "deletions") or ():
                if get(deletion, "type") == DELETE_ALL_ENTITIES:
                    deleted.append((number, EVERY_OBJECT))
                else:
                    (code,) = self._namer.codes([deletion], [0], style_of(deletion), [message])
                    deleted.append((number, code))
        return deleted

    def _bind_time(self, example: object, message: object) -> None:
        if not self._is_time_bound:
            self._time = bind_time(self._layout.stamp, example, message)
            self._is_time_bound = True

    def _frames(self, binding: Binding, messages: Sequence[object], objects: _Objects) -> list[str] | None:
        """Return the frame of each object; None if all are in the fixed frame."""
        if self._layout.frame_name is not None:
            self.noted_frames.add(self._layout.frame_name)
            return [self._layout.frame_name] * len(objects.values) if self._needs_frame else None
        if binding.frame is None or not objects.values:
            return None
        get, from_message = binding.frame
        if not self._needs_frame:
            # one of many, enough to remark that topics are in different frames
            example = messages[objects.message[0]] if from_message else objects.values[0]
            self.noted_frames.add(str(get(example)))
            return None
        frames = [str(get(each)).removeprefix("/") for each in (messages if from_message else objects.values)]
        self.noted_frames.update(frames)
        return [frames[index] for index in objects.message] if from_message else frames

    def _stamps(self, messages: Sequence[object], objects: _Objects) -> list[int] | None:
        if self._time is None or not self._needs_frame:
            return None
        if self._time.path.from_message:
            of_message = self._time.nanoseconds(messages)
            return [of_message[index] for index in objects.message]
        return self._time.nanoseconds(objects.values)


def _split_deleted_markers(objects: _Objects) -> tuple[_Objects, list[tuple[int, int]]]:
    """Return the markers that are shown, and (message, name) of those that are deleted."""
    deleted: list[tuple[int, int]] = []
    if not objects.values:
        return objects, deleted
    get = lenient_getter(style_of(objects.values[0]))
    actions = [get(each, "action") for each in objects.values]
    if not any(actions):
        return objects, deleted
    for action, message, name in zip(actions, objects.message, objects.name, strict=True):
        if action == MARKER_DELETE_ALL:
            deleted.append((message, EVERY_OBJECT))
        elif action == MARKER_DELETE:
            deleted.append((message, name))
    return objects.where([action == MARKER_ADD or not action for action in actions]), deleted

"""Decoded messages of one topic to columns: objects, their poses and bodies, who left."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, compress
from typing import Any

import numpy as np

from spatial_replay.mapping.binding import Binding, bind
from spatial_replay.mapping.detections import (
    EVERY_OBJECT,
    DetectionChunk,
    Detections,
    bodies_of,
    covariances,
    detections_from_chunks,
    points_of,
    rows_of,
)
from spatial_replay.mapping.field_paths import (
    FieldPath,
    Get,
    NameTemplate,
    iter_elements,
    list_getter,
    style_of,
)
from spatial_replay.mapping.footprints import (
    DELETE_ALL_ENTITIES,
    MARKER_ADD,
    MARKER_DELETE,
    MARKER_DELETE_ALL,
    reader_of,
)
from spatial_replay.mapping.message_types import MessageLayout
from spatial_replay.mapping.names import Codes, Namer, class_codes
from spatial_replay.mapping.stamps import TimeGetter, bind_time


class Extractor:
    """Reads the objects of one topic.

    Args:
        names, classes: codes that all topics share.
        needs_frame: whether frames matter: whether there is a fixed one.
    """

    def __init__(
        self,
        reading: MessageLayout,
        topic: str,
        names: Codes,
        classes: Codes,
        *,
        only: Sequence[str] = (),
        without: Sequence[str] = (),
        needs_frame: bool = False,
    ) -> None:
        self.reading = reading
        self._names, self._classes = names, classes
        self._namer = Namer(NameTemplate.of(reading.name), topic, names, only, without)
        self._needs_frame = needs_frame
        self._path = FieldPath.of(reading.objects) if reading.objects else None
        self._list: Get | None = None
        self._binding: Binding | None = None
        self._time: TimeGetter | None = None
        self._has_time = False
        self.noted_frames: set[str] = set()

    @property
    def is_bound(self) -> bool:
        """Whether an object has been seen, so that every path is known to lead somewhere."""
        return self._binding is not None

    @property
    def is_timed(self) -> bool:
        """Whether it is known how stamps are read."""
        return self._time is not None

    @property
    def lacks_stamp(self) -> bool:
        """Whether a message was seen, and there was no stamp where there could be one."""
        return self._has_time and self._time is None

    def message_times(self, messages: Sequence[object]) -> list[int | None]:
        """The stamp of each message: its own, or that of its first object; None where it has none.

        Raises:
            FieldError: there is no stamp where the reading says.
        """
        times: list[int | None] = []
        for message in messages:
            first = next(iter(self._elements(message)), None)
            own = first if first is not None else message
            if not self._has_time:
                if first is None:
                    times.append(None)
                    continue
                self._bind_time(own, message)
            if self._time is None:
                times.append(None)
            elif self._time.path.from_message:
                times.append(self._time.nanoseconds([message])[0])
            else:
                times.append(None if first is None else self._time.nanoseconds([first])[0])
        return times

    def harvest(self, messages: Sequence[object], first: int) -> DetectionChunk:
        """What some messages tell of objects; `first` is the number of the first of them.

        Raises:
            FieldError, AttributeError, LookupError, TypeError, ValueError, OverflowError: a message that is
                not as the others; the first says what is wrong.
        """
        objects, index, places = self._objects(messages)
        gone: list[tuple[int, int]] = []
        if self.reading.solids == "scene":
            gone = self._deleted_entities(messages)
        names = self._namer.codes(objects, places, style_of(messages[0]) if messages else "attributes")
        if self.reading.solids == "marker":
            objects, index, names, gone = self._without_deleted(objects, index, names)
        if self._namer.is_filtering():
            texts = list(self._names)
            keep = [self._namer.wants(code, texts[code]) for code in names]
            objects, index, names = _kept(keep, objects, index, names)
        part = DetectionChunk(gone=[(number + first, name) for number, name in gone])
        if not objects:
            return part
        if self._binding is None:
            message = messages[index[0]]
            self._binding = bind(self.reading, objects[0], message, needs_frame=self._needs_frame)
            self._bind_time(objects[0], message)
        self._fill(part, self._binding, messages, objects, index, names)
        part.message = [number + first for number in part.message] if first else part.message
        return part

    def _fill(
        self,
        part: DetectionChunk,
        binding: Binding,
        messages: Sequence[object],
        objects: list[Any],
        index: list[int],
        names: list[int],
    ) -> None:
        if self.reading.solids:
            bodies = bodies_of(self.reading, binding, objects)
            count = len(objects)
            keep = [bool(each) for each in bodies]
            objects, index, names = _kept(keep, objects, index, names)
            part.bodies = [each for each in bodies if each]
            part.skipped = count - len(objects)
        elif binding.polygon is not None:
            part.corner_counts, part.corners = points_of([binding.polygon(each) for each in objects])
        if binding.numbers is not None:
            found = map(binding.numbers, objects)
            part.numbers = rows_of(found, len(objects), binding.width, binding.style)
        part.covariance = covariances(self.reading, binding, objects)
        part.class_code = class_codes(self.reading, binding, objects, self._classes)
        part.frames = self._frames(messages, objects, index)
        part.stamps = self._stamps(messages, objects, index)
        if binding.lifetime is not None:
            part.lifetimes = binding.lifetime.nanoseconds(objects)
        part.message, part.name = index, names

    def seen(self, parts: Sequence[DetectionChunk]) -> Detections:
        """The parts of consecutive messages as columns."""
        return detections_from_chunks(self.reading, self._binding, parts)

    def _objects(self, messages: Sequence[object]) -> tuple[list[Any], list[int], list[int]]:
        """All objects, the message of each, and its place in that."""
        if self._path is None:
            return list(messages), list(range(len(messages))), [0] * len(messages)
        if self._list is None and messages:
            # the first message is taken step by step, so that a wrong path is told well
            list(iter_elements(self._path, messages[0]))
            self._list = list_getter(self._path, style_of(messages[0])) or self._elements
        lists = list(map(self._list, messages)) if self._list is not None else []
        counts = [len(each) for each in lists]
        index = np.repeat(np.arange(len(counts)), counts).tolist()
        places = list(chain.from_iterable(map(range, counts)))
        return list(chain.from_iterable(lists)), index, places

    def _elements(self, message: object) -> list[object]:
        return [message] if self._path is None else list(iter_elements(self._path, message))

    def _deleted_entities(self, messages: Sequence[object]) -> list[tuple[int, int]]:
        gone: list[tuple[int, int]] = []
        for number, message in enumerate(messages):
            read = reader_of(style_of(message))
            for deletion in read(message, "deletions") or ():
                if read(deletion, "type") == DELETE_ALL_ENTITIES:
                    gone.append((number, EVERY_OBJECT))
                else:
                    (code,) = self._namer.codes([deletion], [0], style_of(deletion))
                    gone.append((number, code))
        return gone

    def _without_deleted(
        self, objects: list[Any], index: list[int], names: list[int]
    ) -> tuple[list[Any], list[int], list[int], list[tuple[int, int]]]:
        """The markers that are shown, and those that are deleted."""
        gone: list[tuple[int, int]] = []
        if not objects:
            return objects, index, names, gone
        read = reader_of(style_of(objects[0]))
        actions = [read(each, "action") for each in objects]
        if any(actions):
            for action, number, name in zip(actions, index, names, strict=True):
                if action == MARKER_DELETE_ALL:
                    gone.append((number, EVERY_OBJECT))
                elif action == MARKER_DELETE:
                    gone.append((number, name))
            keep = [action == MARKER_ADD or not action for action in actions]
            objects, index, names = _kept(keep, objects, index, names)
        return objects, index, names, gone

    def _bind_time(self, example: object, message: object) -> None:
        if not self._has_time:
            self._time = bind_time(self.reading.stamp, example, message) if self.reading.stamp else None
            self._has_time = True

    def _frames(self, messages: Sequence[object], objects: list[Any], index: list[int]) -> list[str] | None:
        """The frame of each object; None where all are taken to be in the fixed frame."""
        if self.reading.frame_name is not None:
            return [self.reading.frame_name] * len(objects) if self._needs_frame else None
        if self._binding is None or self._binding.frame is None or not objects:
            return None
        get, from_message = self._binding.frame
        if not self._needs_frame:
            # one of many, to be able to say that they differ
            self.noted_frames.add(str(get(messages[index[0]] if from_message else objects[0])))
            return None
        if from_message:
            of_message = [str(get(message)).removeprefix("/") for message in messages]
            return [of_message[number] for number in index]
        return [str(get(each)).removeprefix("/") for each in objects]

    def _stamps(self, messages: Sequence[object], objects: list[Any], index: list[int]) -> list[int] | None:
        if self._time is None or not self._needs_frame:
            return None
        if self._time.path.from_message:
            of_message = self._time.nanoseconds(messages)
            return [of_message[number] for number in index]
        return self._time.nanoseconds(objects)


def _kept(
    keep: list[bool], objects: list[Any], index: list[int], names: list[int]
) -> tuple[list[Any], list[int], list[int]]:
    if all(keep):
        return objects, index, names
    return list(compress(objects, keep)), list(compress(index, keep)), list(compress(names, keep))

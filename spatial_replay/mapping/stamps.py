"""Times inside messages: where they stand, and how they are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from spatial_replay.mapping.field_paths import (
    FieldError,
    FieldPath,
    Get,
    below,
    field_names,
    getter,
    is_number,
    leads_somewhere,
    style_of,
    tuple_getter,
    type_name,
    walk,
)
from spatial_replay.mapping.model import Stamp
from spatial_replay.trace.sample import LATEST_NS

SECOND_NS = 10**9

_TIME_FIELDS = (
    ("sec", "nanosec"),
    ("sec", "nsec"),
    ("secs", "nsecs"),
    ("seconds", "nanos"),
    ("sec", "nanos"),
)


@dataclass(frozen=True, slots=True)
class TimeGetter:
    """How a time is read: two fields, or one number of `unit_ns`."""

    path: FieldPath
    get: Get
    parts: tuple[str, str] | None
    unit_ns: int

    def nanoseconds(self, values: Sequence[object]) -> list[int]:
        """The times in what `path` begins at.

        Raises:
            FieldError: one lies outside the times that a log can have.
            TypeError, ValueError, OverflowError: one is no time.
        """
        found = map(self.get, values)
        if self.parts is None:
            unit = self.unit_ns
            return [self._checked(v * unit if type(v) is int else round(float(v) * unit)) for v in found]
        pairs = np.fromiter(chain.from_iterable(found), np.int64, 2 * len(values))
        seconds, rest = pairs[::2], pairs[1::2]
        if len(seconds) and max(np.abs(seconds).max(), np.abs(rest).max()) >= LATEST_NS // SECOND_NS:
            raise FieldError(f"{self.path.text}: the time lies outside those of a log")
        times: list[int] = (seconds * SECOND_NS + rest).tolist()
        return times

    def _checked(self, time_ns: int) -> int:
        if abs(time_ns) > LATEST_NS:
            raise FieldError(f"{self.path.text}: the time lies outside those of a log")
        return time_ns


def bind_time(stamps: Sequence[Stamp], example: object, message: object) -> TimeGetter | None:
    """How the first of some stamps that is there is read; None if none is.

    Raises:
        FieldError: the only stamp leads nowhere, or to something that is no time.
    """
    for stamp in stamps:
        path = FieldPath.of(stamp.field)
        root = message if path.from_message else example
        if len(stamps) > 1 and not leads_somewhere(path, root):
            continue
        value = walk(path, root)
        style = style_of(root)
        names = field_names(value)
        for parts in _TIME_FIELDS:
            if all(part in names for part in parts):
                pair = tuple_getter([below(path, part) for part in parts], style)
                return TimeGetter(path, pair, parts, 1)
        if is_number(value):
            return TimeGetter(path, getter(path, style), None, stamp.unit_ns)
        raise FieldError(f"{path.text}: {type_name(value)} is no time; give the path of a stamp or a number")
    return None

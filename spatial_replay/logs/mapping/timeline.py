"""What is known of each object over time: events, and the state at the times of samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.mapping.model import FOREVER_NS
from spatial_replay.trace.trace import ABSENT

GONE = -1
"""Instead of a row: the object has left."""

STALE = -2
"""Instead of a row: the object is there, but what was known of it is too old."""


@dataclass(frozen=True, slots=True)
class Events:
    """E events of one topic's objects, by name, then in the order in which they happened.

    Attributes:
        name: (E,) int64.
        time_ns: (E,) int64.
        row: (E,) int64, the observation, or `GONE`.
        expires_ns: (E,) int64, from when the object has left by itself.
        class_code: (E,) int64.
    """

    name: Integers
    time_ns: Integers
    row: Integers
    expires_ns: Integers
    class_code: Integers

    @classmethod
    def none(cls) -> Events:
        return cls(*(np.empty(0, np.int64) for _ in range(5)))

    def select(self, chosen: Integers) -> Events:
        columns = (self.name, self.time_ns, self.row, self.expires_ns, self.class_code)
        return Events(*(column[chosen] for column in columns))

    def last(self) -> Events:
        """The last event of each name, but for those who have left."""
        is_last = np.append(self.name[1:] != self.name[:-1], True)[: len(self.name)]
        return self.select(np.flatnonzero(is_last & (self.row != GONE)))

    def after(self, before: Events) -> Events:
        """These events after earlier ones of the same topic."""
        columns = [
            np.concatenate([getattr(before, name), getattr(self, name)])
            for name in ("name", "time_ns", "row", "expires_ns", "class_code")
        ]
        joined = Events(*columns)
        return joined.select(np.argsort(joined.name, kind="stable"))

    def state(self, times_ns: Integers, max_age_ns: int) -> tuple[Integers, Integers, Integers]:
        """What is known at some times.

        Returns:
            names (N,), each once; rows (T, N): a row, `ABSENT`, or `STALE`; class codes (T, N).
        """
        starts = np.flatnonzero(np.diff(self.name, prepend=-1))
        ends = np.append(starts[1:], len(self.name))[: len(starts)]
        rows = np.full((len(times_ns), len(starts)), ABSENT, np.int64)
        classes = np.zeros((len(times_ns), len(starts)), np.int64)
        for column, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            at = np.searchsorted(self.time_ns[start:end], times_ns, "right") - 1 + start
            has_come = at >= start
            at = np.maximum(at, start)
            found = self.row[at]
            too_old = times_ns - self.time_ns[at] > max_age_ns
            left = ~has_come | (found == GONE) | (times_ns >= self.expires_ns[at])
            rows[:, column] = np.where(left, ABSENT, np.where(too_old, STALE, found))
            classes[:, column] = self.class_code[at]
        return self.name[starts], rows, classes


def events_of(
    *,
    name: Integers,
    message: Integers,
    class_code: Integers,
    times_ns: Integers,
    rows: Integers,
    lifetime_ns: Integers | None,
    gone: list[tuple[int, int]],
    alive: Events,
    is_complete: bool,
) -> Events:
    """The events of messages in order.

    Args:
        name, message, class_code, rows: (R,) of each object that was seen; `message` increases.
        times_ns: (M,) of each message.
        gone: (message, name) of those that were deleted, before whoever the same message tells of.
        alive: the last event of each object before.
        is_complete: whether those that a message leaves out have left.
    """
    expires = np.full(len(name), FOREVER_NS, np.int64)
    if lifetime_ns is not None:
        limited = np.flatnonzero(lifetime_ns > 0)
        expires[limited] = times_ns[message[limited]] + lifetime_ns[limited]
    left_name, left_message = np.empty(0, np.int64), np.empty(0, np.int64)
    if is_complete:
        left_name, left_message = _left_out(name, message, alive.name, len(times_ns))
    if gone:
        told = np.array(gone, np.int64)
        left_message = np.concatenate([left_message, told[:, 0]])
        left_name = np.concatenate([left_name, told[:, 1]])
    every_name = np.concatenate([left_name, name])
    every_message = np.concatenate([left_message, message])
    # those who left come first, so that a name that a message deletes and tells of is there
    order = np.lexsort((every_message, every_name))
    count = len(left_name)

    def column(left: int, seen: Integers) -> Integers:
        return np.concatenate([np.full(count, left, np.int64), seen])[order]

    return Events(
        name=every_name[order],
        time_ns=times_ns[every_message[order]],
        row=column(GONE, rows),
        expires_ns=column(FOREVER_NS, expires),
        class_code=column(0, class_code),
    )


def _left_out(name: Integers, message: Integers, alive: Integers, messages: int) -> tuple[Integers, Integers]:
    """Who is left out by the message after one that told of them: names, and those messages."""
    every_name = np.concatenate([alive, name])
    every_message = np.concatenate([np.full(len(alive), -1, np.int64), message])
    order = np.lexsort((every_message, every_name))
    name, message = every_name[order], every_message[order]
    following = np.append(np.where(name[1:] == name[:-1], message[1:], messages), messages)[: len(name)]
    left = np.flatnonzero((following > message + 1) & (message + 1 < messages))
    return name[left], message[left] + 1

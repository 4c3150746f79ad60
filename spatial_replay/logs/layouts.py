"""Where the numbers stand in ObjectStates messages of one layout."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.messages.ObjectStates_pb2 import ObjectState, ObjectStates

UNKNOWN, ZERO = -2, -1
"""Places of numbers that a message does not hold, after the last slot: they are NaN and 0."""


class WrongMessageError(Exception):
    """Bytes that are no ObjectStates message; its text says why."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Which slot of a message holds what; `UNKNOWN` or `ZERO` where none does.

    Attributes:
        time: slot of the sample's time.
        names, classes: of the J objects.
        part_counts: (J,) parts of each object.
        vertex_counts: (P,) vertices of each part.
        coordinates: (2 V,) slots of x, y, x, y …
        radius: (P,) slots.
        yaw, bottom, top, uncertainty: (J,) slots.
        stated: slots of yaw and height that the message holds, and (of the same length) whose they are.
        signals: slot of each signal's value.
    """

    time: int
    names: tuple[str, ...]
    classes: tuple[str | None, ...]
    part_counts: Integers
    vertex_counts: Integers
    coordinates: Integers
    radius: Integers
    yaw: Integers
    bottom: Integers
    top: Integers
    uncertainty: Integers
    stated: Integers
    stated_by: Integers
    signals: dict[str, int]


def parsed(payload: bytes) -> ObjectStates:
    """The message, or a piece of one, in an encoding.

    Raises:
        WrongMessageError: it is none, an object has no name or a vertex no y.
    """
    message = ObjectStates()
    try:
        message.ParseFromString(payload)
    except DecodeError:
        raise WrongMessageError("the message is no ObjectStates") from None
    for state in message.objects:
        if not state.name:
            raise WrongMessageError("an object has no name")
        if any(len(part.coordinates) % 2 for part in state.parts):
            raise WrongMessageError(f"object {state.name!r} has a part with an odd number of coordinates")
    return message


def layout_of(message: ObjectStates) -> Layout:
    """Where `Template.of(message)` has its slots.

    Raises:
        WrongMessageError: a signal without a name, or with one that another has.
    """
    slots = _Slots()
    time = slots.next_if(message.HasField("time_ns"), UNKNOWN)
    objects = [_object_slots(state, slots) for state in message.objects]
    signals = {signal.name: slots.next_if(signal.HasField("value"), ZERO) for signal in message.signals}
    if "" in signals or len(signals) < len(message.signals):
        raise WrongMessageError("a signal has no name, or one that another signal has")
    stated = [
        (slot, index)
        for index, state in enumerate(objects)
        for slot in (state.yaw, state.bottom, state.top)
        if slot != UNKNOWN
    ]
    return Layout(
        time=time,
        names=tuple(state.name for state in message.objects),
        classes=tuple(s.class_name if s.HasField("class_name") else None for s in message.objects),
        part_counts=_integers(len(state.radius) for state in objects),
        vertex_counts=_integers(len(part.coordinates) // 2 for s in message.objects for part in s.parts),
        coordinates=_integers(slot for state in objects for slot in state.coordinates),
        radius=_integers(slot for state in objects for slot in state.radius),
        yaw=_integers(state.yaw for state in objects),
        bottom=_integers(state.bottom for state in objects),
        top=_integers(state.top for state in objects),
        uncertainty=_integers(state.uncertainty for state in objects),
        stated=_integers(slot for slot, _ in stated),
        stated_by=_integers(index for _, index in stated),
        signals=signals,
    )


class _ObjectSlots(NamedTuple):
    coordinates: list[int]
    radius: list[int]
    yaw: int
    bottom: int
    top: int
    uncertainty: int


def _object_slots(state: ObjectState, slots: _Slots) -> _ObjectSlots:
    """The slots of one object, taken in the order of the fields."""
    coordinates, radius = list[int](), list[int]()
    for part in state.parts:
        coordinates += [slots.next_if(True, UNKNOWN) for _ in part.coordinates]
        radius.append(slots.next_if(part.HasField("radius"), ZERO))
    absent = ZERO if state.HasField("height") else UNKNOWN
    return _ObjectSlots(
        coordinates,
        radius,
        yaw=slots.next_if(state.HasField("yaw"), UNKNOWN),
        bottom=slots.next_if(state.height.HasField("bottom"), absent),
        top=slots.next_if(state.height.HasField("top"), absent),
        uncertainty=slots.next_if(state.HasField("uncertainty"), ZERO),
    )


class _Slots:
    """Hands out slots one after the other."""

    def __init__(self) -> None:
        self._next = 0

    def next_if(self, present: bool, otherwise: int) -> int:
        """The next slot for a number that is present, the given place for one that is not."""
        if not present:
            return otherwise
        self._next += 1
        return self._next - 1


def _integers(values: Iterable[int]) -> Integers:
    return np.fromiter(values, np.int64)

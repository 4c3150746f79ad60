"""Objects that messages tell of, in columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.mapping.binding import Binding
from spatial_replay.logs.mapping.bodies import Body
from spatial_replay.logs.mapping.poses import Poses, poses_of
from spatial_replay.logs.mapping.readings import Reading
from spatial_replay.logs.mapping.solids import Solids
from spatial_replay.logs.mapping.substance import polygons, shapes, solids_of_bodies

EVERYONE = -1
"""Instead of a name: everything that the topic has told of."""


@dataclass(slots=True)
class Seen:
    """R objects that M messages of a topic tell of.

    Attributes:
        message: (R,) int64, increasing: the message of each object.
        name, class_code: (R,) int64.
        frames: the name of the frame of each, or None where all are in the fixed frame.
        stamp_ns: (R,) int64 of each, or None where messages have no stamps.
        poses: where they are.
        solids: what they consist of.
        height: (R, 2) above the origin of each; None for the heights of the solids.
        uncertainty: (R,) radius.
        covariance: (R, 3, 3) of the position with the number of deviations applied, or None.
        lifetime_ns: (R,) 0 for ever; None for all of them.
        gone: (message, name's code or `EVERYONE`) of those that were deleted.
        skipped: how many objects had nothing that is a body.
    """

    message: Integers
    name: Integers
    class_code: Integers
    frames: list[str] | None
    stamp_ns: Integers | None
    poses: Poses
    solids: Solids
    height: Floats | None
    uncertainty: Floats
    covariance: Floats | None
    lifetime_ns: Integers | None
    gone: list[tuple[int, int]]
    skipped: int


@dataclass(slots=True)
class Part:
    """What a few messages tell of, before it is put into columns; attributes as of `Seen`."""

    gone: list[tuple[int, int]]
    message: list[int] = field(default_factory=list)
    name: list[int] = field(default_factory=list)
    class_code: list[int] = field(default_factory=list)
    frames: list[str] | None = None
    stamps: list[int] | None = None
    numbers: Floats = field(default_factory=lambda: np.empty((0, 0)))
    covariance: Floats | None = None
    lifetimes: list[int] = field(default_factory=list)
    bodies: list[list[Body]] = field(default_factory=list)
    corner_counts: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    corners: Floats = field(default_factory=lambda: np.empty((0, 3)))
    skipped: int = 0

    def shifted(self, count: int) -> Part:
        """The same of messages that come so many later."""
        self.message = [number + count for number in self.message]
        self.gone = [(number + count, name) for number, name in self.gone]
        return self


def seen_from_parts(reading: Reading, binding: Binding | None, parts: Sequence[Part]) -> Seen:
    """The parts of consecutive messages as columns."""
    gone = [each for part in parts for each in part.gone]
    skipped = sum(part.skipped for part in parts)
    parts = [part for part in parts if part.name]
    if binding is None or not parts:
        return _nobody(gone, skipped)
    name = _joined(part.name for part in parts)
    numbers = np.empty((len(name), 0))
    if binding.numbers is not None:
        numbers = np.concatenate([part.numbers for part in parts])
    if reading.solids:
        solids, poses = solids_of_bodies(list(chain.from_iterable(part.bodies for part in parts)))
    else:
        poses = poses_of(reading, binding, numbers)
        if binding.polygon is not None:
            counts = np.concatenate([part.corner_counts for part in parts])
            solids = polygons(counts, np.concatenate([part.corners for part in parts]))
        else:
            solids = shapes(reading, binding, poses, numbers)
    has_frames, has_stamps = parts[0].frames is not None, parts[0].stamps is not None
    spreads = [part.covariance for part in parts if part.covariance is not None]
    return Seen(
        message=_joined(part.message for part in parts),
        name=name,
        class_code=_joined(part.class_code for part in parts),
        frames=list(chain.from_iterable(part.frames or () for part in parts)) if has_frames else None,
        stamp_ns=_joined(part.stamps or () for part in parts) if has_stamps else None,
        poses=poses,
        solids=solids,
        height=_measured(binding.height, numbers),
        uncertainty=_uncertainty(binding, numbers, len(name)),
        covariance=np.concatenate(spreads) if spreads else None,
        lifetime_ns=_joined(part.lifetimes for part in parts) if binding.lifetime is not None else None,
        gone=gone,
        skipped=skipped,
    )


def _joined(columns: Iterable[Sequence[int]]) -> Integers:
    return np.fromiter(chain.from_iterable(columns), np.int64)


def _measured(measures: tuple[float | int, ...], numbers: Floats) -> Floats | None:
    """(R, K) numbers of K measures."""
    if not measures:
        return None
    columns = [
        numbers[:, each] if isinstance(each, int) else np.full(len(numbers), each) for each in measures
    ]
    return np.stack(columns, axis=1)


def _uncertainty(binding: Binding, numbers: Floats, count: int) -> Floats:
    if isinstance(binding.uncertainty, int):
        return numbers[:, binding.uncertainty]
    return np.full(count, binding.uncertainty or 0.0)


def covariances(reading: Reading, binding: Binding, objects: list[Any]) -> Floats | None:
    """(R, 3, 3) the position's part, times the square of the number of deviations."""
    if binding.covariance is None or reading.uncertainty is None:
        return None
    rows = np.array([list(binding.covariance(each)) for each in objects], np.float64)
    size = {4: 2, 9: 3, 36: 6}[rows.shape[1]]
    used = min(size, 3)
    found = np.zeros((len(objects), 3, 3))
    found[:, :used, :used] = rows.reshape(-1, size, size)[:, :used, :used]
    return found * reading.uncertainty.sigmas**2


def _nobody(gone: list[tuple[int, int]], skipped: int) -> Seen:
    none = np.empty(0, np.int64)
    empty = np.empty((0, 3))
    matrices = np.empty((0, 3, 3))
    return Seen(
        message=none,
        name=none,
        class_code=none,
        frames=None,
        stamp_ns=None,
        poses=Poses(empty, matrices, np.empty(0)),
        solids=Solids(
            none, np.empty(0, np.int8), empty, matrices, empty, np.zeros(1, np.int64), np.empty((0, 3))
        ),
        height=None,
        uncertainty=np.empty(0),
        covariance=None,
        lifetime_ns=None,
        gone=gone,
        skipped=skipped,
    )

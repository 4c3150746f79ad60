"""Objects as they were seen, brought into the fixed frame and checked, in columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.mapping.frames import Transforms
from spatial_replay.logs.mapping.seen import Seen
from spatial_replay.logs.mapping.solids import Solids, footprints_from_solids
from spatial_replay.trace.observations import Observations, trace_from_observations
from spatial_replay.trace.trace import ABSENT

Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Rows:
    """R observations as a trace holds them.

    Attributes:
        is_readable: (R,) bool; where not, some number is not finite.
    """

    shapes: FootprintBatch
    yaw: Floats
    uncertainty: Floats
    class_code: Integers
    is_readable: Flags

    def __len__(self) -> int:
        return len(self.yaw)

    @classmethod
    def blank(cls, class_code: Integers) -> Rows:
        """Objects of which nothing is known but their class."""
        count = len(class_code)
        nowhere = FootprintBatch(
            part_start=np.arange(count + 1),
            vertex_start=np.arange(count + 1),
            vertices=np.full((count, 2), np.nan),
            radius=np.zeros(count),
            bottom=np.full(count, np.nan),
            top=np.full(count, np.nan),
        )
        return cls(nowhere, np.full(count, np.nan), np.zeros(count), class_code, np.zeros(count, np.bool_))

    def select(self, rows: Integers) -> Rows:
        return Rows(
            self.shapes.select(rows),
            self.yaw[rows],
            self.uncertainty[rows],
            self.class_code[rows],
            self.is_readable[rows],
        )

    @classmethod
    def concatenate(cls, several: Sequence[Rows]) -> Rows:
        return cls(
            FootprintBatch.concatenate([rows.shapes for rows in several]),
            np.concatenate([np.empty(0), *(rows.yaw for rows in several)]),
            np.concatenate([np.empty(0), *(rows.uncertainty for rows in several)]),
            np.concatenate([np.empty(0, np.int64), *(rows.class_code for rows in several)]),
            np.concatenate([np.empty(0, np.bool_), *(rows.is_readable for rows in several)]),
        )


def rows_from_seen(
    seen: Seen, transforms: Transforms | None, concave: Concave, fault: Callable[[int, str], None]
) -> Rows:
    """The observations in the fixed frame; blank where the transform is not known or there is no footprint.

    Args:
        transforms: fixed_from_frame of each object, or None where all are in the fixed frame.
        fault: takes the index of an object that makes no footprint, and what comes after its name.
    """
    poses, solids, count = seen.poses, seen.solids, len(seen.name)
    unknown = np.zeros(count, np.bool_)
    covariance = seen.covariance
    if transforms is not None:
        poses, solids = poses.moved(transforms), _moved(solids, transforms)
        unknown = ~transforms.known
        if covariance is not None:
            turn = transforms.rotation
            covariance = turn @ covariance @ np.swapaxes(turn, 1, 2)
    shapes = footprints_from_solids(solids, count)
    if seen.height is not None:
        heights = poses.position[:, 2, None] + seen.height
        shapes = replace(shapes, bottom=heights[:, 0], top=heights[:, 1])
    uncertainty = seen.uncertainty if covariance is None else _radius(covariance)
    return _checked(seen, shapes, poses.yaw, uncertainty, unknown, concave, fault)


def _moved(solids: Solids, transforms: Transforms) -> Solids:
    rotation = transforms.rotation[solids.owner]
    position = np.einsum("nij,nj->ni", rotation, solids.position) + transforms.translation[solids.owner]
    return replace(solids, position=position, rotation=rotation @ solids.rotation)


def _radius(covariance: Floats) -> Floats:
    """(R,) the longest half axis of the ellipses of covariances (R, 3, 3), seen from above.

    NaN for those with a negative variance, by which some programs say that they know nothing.
    """
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    largest = (a + d) / 2 + np.hypot((a - d) / 2, b)
    return np.asarray(np.where((a < 0) | (d < 0), np.nan, np.sqrt(np.maximum(largest, 0.0))))


def _checked(
    seen: Seen,
    shapes: FootprintBatch,
    yaw: Floats,
    uncertainty: Floats,
    unknown: Flags,
    concave: Concave,
    fault: Callable[[int, str], None],
) -> Rows:
    """Each observation as a sample of its own, so that one that makes no footprint costs no other."""
    count = len(seen.name)
    each = np.arange(count, dtype=np.int64)
    trace, faults = trace_from_observations(
        Observations(
            times_ns=each,
            sample=each,
            name=np.zeros(count, np.int64),
            names=("",),
            class_code=seen.class_code,
            classes=(None,) * (int(seen.class_code.max(initial=-1)) + 1),
            yaw=yaw,
            uncertainty=uncertainty,
            shapes=shapes,
            invalid=unknown,
            signals={},
        ),
        concave=concave,
    )
    for index, what in faults.items():
        fault(index, what.removeprefix("object ''"))
    kept = trace.rows[:, 0]
    is_good = np.zeros(count, np.bool_)
    is_good[trace.times_ns] = kept > ABSENT
    row = np.where(kept > ABSENT, kept, -2 - kept)
    is_kept = np.zeros(count, np.bool_)
    is_kept[trace.times_ns] = ~unknown[trace.times_ns]
    placed = Rows(
        trace.footprints, trace.yaw, trace.uncertainty, trace.class_code, np.ones(len(trace), np.bool_)
    )
    if is_kept.all() and (row == each).all():
        return replace(placed, is_readable=is_good)
    # blank rows come after the others
    number = np.arange(count, dtype=np.int64) + len(placed)
    number[trace.times_ns] = np.where(unknown[trace.times_ns], number[trace.times_ns], row)
    both = Rows.concatenate([placed, Rows.blank(seen.class_code)])
    return replace(both.select(number), is_readable=is_good & is_kept)

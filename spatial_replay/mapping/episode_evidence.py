"""Remarks on an episode of a data set: jumps of objects, and quaternions in the wrong order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from spatial_replay.logs.formats.episodes import quaternion_order
from spatial_replay.mapping.evidence import extents
from spatial_replay.mapping.feature_reader import BoundObject, Columns
from spatial_replay.mapping.suggest_features import HANDS
from spatial_replay.text import Instant, Sentence, number_text
from spatial_replay.trace.trace import Trace

_FAR: Final = 0.05
"""Least length of a jump, as a share of the scene's extent."""
_SUDDEN: Final = 20.0
"""Least ratio of a jump to the steps before and after it."""
_GRAVITY: Final = 9.81
"""Standard gravity, metres per second squared."""


def jump_remark(trace: Trace, episode: str) -> Sentence | None:
    """Return a remark on the longest jump of an object between two frames; None without a jump.

    A thrown or pushed object moves for several frames. A jumping object is at rest, or much slower, before
    and after the jump. Usual causes are exchanged ranges of frames, and frames from before a reset.
    """
    # a jump is compared with the steps next to it, so it needs three frames
    if len(trace) < 3 or not len(trace.footprints.radius):
        return None
    shapes, rows = trace.footprints, trace.rows.T
    are_points = len(shapes.vertices) == len(shapes.part_start) - 1
    centres = shapes.vertices if are_points else extents(shapes)[0]
    positions = np.column_stack([centres, shapes.bottom])
    # (N, T, 3): x and y of each object's centre, and its bottom
    positions = np.where((rows >= 0)[:, :, None], positions[np.maximum(rows, 0)], np.nan)
    positions[:, :, 2][np.isnan(positions[:, :, 2])] = 0.0
    displacements = np.diff(positions, axis=1)
    step_lengths = np.sqrt(np.einsum("ijk,ijk->ij", displacements, displacements))
    # the longer of the steps before and after each step
    neighbour_lengths = np.zeros_like(step_lengths)
    neighbour_lengths[:, 1:] = step_lengths[:, :-1]
    neighbour_lengths[:, :-1] = np.fmax(neighbour_lengths[:, :-1], step_lengths[:, 1:])
    # twice the fall of a body from rest within one frame
    fall_distance = _GRAVITY * (np.diff(trace.times_ns) / 1e9) ** 2
    with np.errstate(invalid="ignore"):
        is_jump = (step_lengths > _SUDDEN * neighbour_lengths) & (step_lengths > fall_distance)
    if not is_jump.any():
        return None
    extent = np.nan_to_num(
        np.fmax.reduce(positions, axis=(0, 1)) - np.fmin.reduce(positions, axis=(0, 1))
    ).max()
    is_jump &= step_lengths > _FAR * extent
    if not is_jump.any():
        return None
    object_index, frame = np.unravel_index(
        int(np.where(is_jump, step_lengths, 0.0).argmax()), step_lengths.shape
    )
    jump_count = int(np.count_nonzero(is_jump))
    return Sentence(
        f"{episode} at ",
        Instant(int(trace.times_ns[frame + 1]), 0),
        f": {trace.names[object_index]} jumps by {number_text(float(step_lengths[object_index, frame]))}, and"
        f" moves at most {number_text(float(neighbour_lengths[object_index, frame]))} in the frames next to"
        " it"
        f"{f' ({jump_count} jumps in all)' if jump_count > 1 else ''}; frames may be missing, exchanged, or"
        " from another run",
    )


def order_remarks(objects: Iterable[BoundObject], columns: Columns) -> Iterator[str]:
    """Yield a remark on each object that stands upright only if its quaternion is read as w x y z.

    Quaternions whose numbers have names are skipped.
    """
    for bound_object in objects:
        places = bound_object.quaternion
        if (
            not places
            or HANDS.search(bound_object.name)
            or not all(place.name.endswith("]") for place in places)
        ):
            continue
        feature_rows = [columns[place.feature].reshape(len(columns[place.feature]), -1) for place in places]
        quaternions = np.column_stack(
            [row[:, place.number] for row, place in zip(feature_rows, places, strict=True)]
        )
        if quaternion_order([quaternions]) == "wxyz":
            name = bound_object.name
            yield f"{name} stands upright only if its orientation has the other order; check `order`"

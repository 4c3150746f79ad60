"""Places of names and of an arrow's label: off outlines, arrows and each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Floats

LETTER: Final = 0.5
"""Width of a letter by the height of a line."""
_GAP: Final = 0.25
"""Distance of a name from what it names, by the height of a line."""
_SIDES: Final = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1)], np.float64)
_SIDES.flags.writeable = False
"""The eight positions in the order in which they are tried: above, below, right, left, corners."""


Box = tuple[Floats, Floats]
"""Low and high corners (2, K) of a box in each of K scenes; NaN where there is none."""


def columns_of(boxes: Floats) -> list[Box]:
    """Return boxes (K, B, 2, 2) of K scenes, one after the other: numpy compares long columns, not pairs."""
    return [(box[:, 0].T.copy(), box[:, 1].T.copy()) for box in boxes.swapaxes(0, 1)]


def place_names(low: Floats, high: Floats, letters: Floats, blocked: Sequence[Box], line: Floats) -> Floats:
    """Return the middles (K, N, 2) of N names in each of K scenes: each at the first side that is free.

    A name without a free side is placed above all of its scene's boxes.

    Args:
        low, high: (K, N, 2), corners of the boxes of what is named.
        letters: (K, N), lengths of the names.
        blocked: boxes that no name may cover.
        line: (K,), the heights of names.
    """
    middles = np.empty(low.shape)
    boxes = list(blocked)
    for number in range(low.shape[1]):
        half = half_sizes(letters[:, number], line)
        middle = (low[:, number] + high[:, number]).T / 2.0
        reach = (high[:, number] - low[:, number]).T / 2.0 + half + _GAP * line
        centres = _first_free(middle, reach, half, boxes, line)
        middles[:, number] = centres.T
        boxes.append((centres - half, centres + half))
    return middles


def half_sizes(letters: Floats, line: Floats) -> Floats:
    """Return half the widths and heights (2, K) of texts."""
    return np.stack([LETTER * letters * line / 2.0, line / 2.0])


def _first_free(middle: Floats, reach: Floats, half: Floats, boxes: Sequence[Box], line: Floats) -> Floats:
    """Return the middles (2, K) of one name in each scene: at the first free side, or above all boxes."""
    centres = np.empty(middle.shape)
    left = np.arange(middle.shape[1])
    for side in _SIDES:
        is_first = len(left) == middle.shape[1]
        columns = [middle, reach, half] if is_first else [column[:, left] for column in (middle, reach, half)]
        places = columns[0] + side[:, None] * columns[1]
        centres[:, left] = places
        begin, end = places - columns[2], places + columns[2]
        is_covered = np.zeros(len(left), np.bool_)
        for low, high in boxes:
            if not is_first:
                low, high = low[:, left], high[:, left]
            is_covered |= (begin[0] < high[0]) & (low[0] < end[0]) & (begin[1] < high[1]) & (low[1] < end[1])
        left = left[is_covered]
        if not len(left):
            return centres
    centres[:, left] = _above_all(middle, half, boxes, line)[:, left]
    return centres


def _above_all(middle: Floats, half: Floats, boxes: Sequence[Box], line: Floats) -> Floats:
    """Return the places (2, K) above all boxes."""
    top = np.nanmax([high[1] for _, high in boxes], axis=0, initial=-np.inf)
    return np.stack([middle[0], top + half[1] + _GAP * line])


_FAR: Final = (0.0, 1.0, 3.0, 6.0)
"""Distances of labels from what they belong to, by the height of a line."""


def place_labels(
    half: Floats, arrow: Box, blocked: Sequence[Box], others: Box, scene: Box, margin: Floats, line: Floats
) -> Floats:
    """Return the middles (K, 2) of one label in each of K scenes.

    A label is at the first free place: beside the arrow, beside all blocked boxes, above or below the scene.
    It covers other objects only if every place in the view does, and leaves the view only if every place in
    it covers a blocked box.

    Args:
        half: (2, K), half the widths and heights of labels.
        arrow: its box.
        blocked: boxes that no label may cover.
        others: (2, K, N) each, boxes that a label avoids.
        scene: the box of all objects.
        margin: (K,), how far the view reaches beyond the middle of the scene.
        line: (K,), the height of a line.
    """
    around = (
        np.nanmin([low for low, _ in blocked], axis=0),
        np.nanmax([high for _, high in blocked], axis=0),
    )
    middle, centre = (arrow[0] + arrow[1]) / 2.0, (scene[0] + scene[1]) / 2.0
    room = np.maximum(margin - half, 0.0)
    left, best = np.arange(half.shape[1]), np.full(half.shape[1], 8)
    labels = _above_all(middle, half, blocked, line)
    for candidate in _label_places(middle, half, arrow, around, scene, line):
        places = candidate[:, left]
        places[0] = np.clip(places[0], (centre - room)[0, left], (centre + room)[0, left])
        begin, end = places - half[:, left], places + half[:, left]
        is_outside = np.abs(places[1] - centre[1, left]) > room[1, left]
        low, high = others[0][:, left], others[1][:, left]
        covers = np.all((begin[..., None] < high) & (low < end[..., None]), axis=0)
        rank = 2 * is_outside + np.any(covers, axis=1)
        for low, high in blocked:
            rank[np.all((begin < high[:, left]) & (low[:, left] < end), axis=0)] = 8
        is_better = rank < best[left]
        labels[:, left[is_better]], best[left[is_better]] = places[:, is_better], rank[is_better]
        left = left[best[left] > 0]
        if not len(left):
            break
    return labels.T


def _label_places(
    middle: Floats, half: Floats, arrow: Box, around: Box, scene: Box, line: Floats
) -> Iterator[Floats]:
    """Yield the places (2, K) that a label may have, the best first."""
    for far in _FAR:
        for low, high in (arrow, around):
            reach = (high - low) / 2.0 + half + (_GAP + far) * line
            yield from ((low + high) / 2.0 + side[:, None] * reach for side in _SIDES)
    for far in _FAR:
        distance = half[1] + (_GAP + far) * line
        yield np.stack([middle[0], scene[1][1] + distance])
        yield np.stack([middle[0], scene[0][1] - distance])

"""Places of names and of an arrow's label: off outlines, arrows and each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats, Integers

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
    top = np.fmax.reduce([high[1] for _, high in boxes], axis=0)
    return np.stack([middle[0], top + half[1] + _GAP * line])


_FAR: Final = (0.0, 1.5, 4.0)
"""Distances of labels from what they belong to, by the height of a line."""


class LabelRoom(NamedTuple):
    """The room for one label in each of K scenes.

    Attributes:
        half: (2, K), half the width and height of the label.
        arrow: the box of its arrow.
        around: the box around all blocked boxes.
        blocked: (B, 2, K) each, boxes that it may not cover.
        others: (N, 2, K) each, boxes that it avoids.
        scene: the box of all objects.
        margin: (K,), how far the view reaches beyond the middle of the scene.
        line: (K,), the height of a line.
    """

    half: Floats
    arrow: Box
    around: Box
    blocked: Box
    others: Box
    scene: Box
    margin: Floats
    line: Floats

    def of_scenes(self, places: Booleans) -> LabelRoom:
        """Return the room in some of the scenes."""
        boxes = [
            (low[..., places], high[..., places])
            for low, high in (self.arrow, self.around, self.blocked, self.others, self.scene)
        ]
        return LabelRoom(self.half[:, places], *boxes, self.margin[places], self.line[places])


def place_labels(room: LabelRoom) -> Floats:
    """Return the middles (K, 2) of one label in each of K scenes.

    A label is at the first free place: beside all blocked boxes, beside the arrow, above or below the scene.
    It covers other objects only if every place in the view does, and leaves the view only if every place in
    it covers a blocked box.
    """
    middle = (room.arrow[0] + room.arrow[1]) / 2.0
    labels, ranks = _above_all(middle, room.half, [room.around], room.line), np.full(len(room.line), _NOWHERE)
    left, rest = np.arange(len(room.line)), room
    for number in range(_CANDIDATES):
        places, is_possible = _candidate(number, rest)
        if not is_possible.any():
            continue
        rank = np.where(is_possible, _rank(places, rest), _NOWHERE)
        is_better = rank < ranks[left]
        better = left[is_better]
        labels[:, better], ranks[better] = places[:, is_better], rank[is_better]
        is_left = ranks[left] > 0
        if not is_left.any():
            break
        # copies of half of the scenes cost more than another look at them
        if is_left.mean() < _FEW:
            left, rest = left[is_left], rest.of_scenes(is_left)
    return labels.T


_FEW: Final = 0.7
_NOWHERE: Final = 4
"""The rank of a place that covers a blocked box; 2 is outside the view, 1 is on another object."""

_CANDIDATES: Final = 2 * len(_SIDES) + 4 * len(_FAR) - 2


def _rank(places: Floats, room: LabelRoom) -> Integers:
    """Return how bad places (2, K) are, 0 for a free one."""
    begin, end = places - room.half, places + room.half
    (low, high), centre = room.others, (room.scene[0][1] + room.scene[1][1]) / 2.0
    rank = _is_covered(begin, end, low, high) + 2 * (np.abs(places[1] - centre) > room.margin - room.half[1])
    rank[_is_covered(begin, end, *room.blocked)] = _NOWHERE
    return np.asarray(rank)


def _is_covered(begin: Floats, end: Floats, low: Floats, high: Floats) -> Booleans:
    """Return (K,), whether texts from `begin` to `end` (2, K) cover any of the boxes (B, 2, K)."""
    # the heights first: most boxes are above or below
    covers = (begin[1] < high[:, 1]) & (low[:, 1] < end[1])
    covers &= (begin[0] < high[:, 0]) & (low[:, 0] < end[0])
    return np.asarray(covers.any(axis=0))


def _candidate(number: int, room: LabelRoom) -> tuple[Floats, Booleans]:
    """Return one place for each label (2, K), the best first, and where it is possible (K,)."""
    middle, half, gap = (room.arrow[0] + room.arrow[1]) / 2.0, room.half, _GAP * room.line
    centre = (room.scene[0][0] + room.scene[1][0]) / 2.0
    reach = np.maximum(room.margin - half[0], 0.0)
    if number < 2 * len(_SIDES):
        low, high = room.around if number < len(_SIDES) else room.arrow
        side = _SIDES[number % len(_SIDES)]
        places = (low + high) / 2.0 + side[:, None] * ((high - low) / 2.0 + half + gap)
        if side[0]:
            return places, np.abs(places[0] - centre) <= reach
    else:
        number -= 2 * len(_SIDES)
        far, is_below = divmod(number, 2)
        is_of_scene = far >= len(_FAR) - 1
        low, high = room.scene if is_of_scene else room.around
        distance = half[1] + gap + _FAR[far - len(_FAR) + 1 if is_of_scene else far + 1] * room.line
        places = np.stack([middle[0], low[1] - distance if is_below else high[1] + distance])
    places[0] = np.clip(places[0], centre - reach, centre + reach)
    return places, np.ones(len(reach), np.bool_)

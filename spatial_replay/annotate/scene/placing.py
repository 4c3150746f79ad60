"""Places of names and of an arrow's label: off outlines, arrows and each other."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats, Integers

LETTER: Final = 0.5
"""Width of a letter by the height of a line."""
_GAP: Final = 0.25
"""Distance of a text from what it belongs to, by the height of a line."""
_FAR: Final = (1.5, 4.0)
"""Further distances of labels, by the height of a line."""
_SIDES: Final = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1)], np.float64)
_SIDES.flags.writeable = False
"""The eight positions in the order in which they are tried: above, below, right, left, corners."""

_NAME_PLACES: Final = len(_SIDES)
_LABEL_PLACES: Final = 2 * len(_SIDES) + 2 * len(_FAR) + 2 * (len(_FAR) + 1)
"""Numbers of places that are tried for a name, and for a label."""

_NOWHERE: Final = 4
"""Rank of a place that covers a blocked box; 2 is outside the view, 1 is on another object, 0 is free."""

_FEW: Final = 0.7
"""Share of scenes that still need a place, below which they are copied to look at no others."""

Box = tuple[Floats, Floats]
"""Low and high corners (..., 2, K) of boxes in K scenes; NaN where there is none."""


class Surroundings(NamedTuple):
    """The boxes of K scenes.

    Attributes:
        blocked: (B, 2, K) each, boxes that no text may cover.
        others: (N, 2, K) each, boxes that texts avoid.
        scene: the box of all objects.
        margin: (K,), how far the view reaches beyond the middle of the scene.
        line: (K,), the height of a text.
    """

    blocked: Box
    others: Box
    scene: Box
    margin: Floats
    line: Floats

    def of_scenes(self, places: Integers) -> Surroundings:
        """Return those of some of the scenes."""
        return Surroundings(
            _part(self.blocked, places),
            _part(self.others, places),
            _part(self.scene, places),
            self.margin[places],
            self.line[places],
        )


def place_names(low: Floats, high: Floats, letters: Floats, around: Surroundings) -> Floats:
    """Return the middles (N, 2, K) of N names in each of K scenes: each at the first of eight sides.

    Args:
        low, high: (N, 2, K), corners of the boxes of what is named.
        letters: (N, K), lengths of the names.
        around: its last N blocked boxes are set to those of the names.
    """
    middles = np.empty(low.shape)
    for number in range(len(low)):
        half = half_sizes(letters[number], around.line)
        box = low[number], high[number]
        middles[number] = _place(half, box, box, around, _NAME_PLACES)
        place = number - len(low)
        around.blocked[0][place], around.blocked[1][place] = middles[number] - half, middles[number] + half
    return middles


def free_names(
    middles: Floats, letters: Floats, movable: Booleans, boxes: Box, around: Surroundings
) -> Floats:
    """Return the middles (N, 2, K) of names, moved to a free side where they cover other objects or names.

    A box that contains an object is its background: the name of the object may cover it.

    Args:
        middles: the usual places (N, 2, K); NaN without a name.
        letters: (N,), lengths of the names.
        movable: (N, K), the names that may be moved.
        boxes: those of what is named, (N, 2, K) each.
        around: the view, whose boxes do not count.
    """
    middles = middles.copy()
    halves = np.stack([half_sizes(length * np.ones_like(around.line), around.line) for length in letters])
    for number in np.flatnonzero(movable.any(axis=1)).tolist():
        rest = np.flatnonzero(np.arange(len(middles)) != number)
        low = np.concatenate([boxes[0][rest], (middles - halves)[rest]])
        high = np.concatenate([boxes[1][rest], (middles + halves)[rest]])
        own, half = (boxes[0][number], boxes[1][number]), halves[number]
        is_background = ((low <= own[0]) & (own[1] <= high)).all(axis=1)
        covers = _overlaps(middles[number] - half, middles[number] + half, (low, high)) & ~is_background
        places = np.flatnonzero(covers.any(axis=0) & movable[number])
        if not len(places):
            continue
        own, half = _part(own, places), half.take(places, axis=-1)
        others = _part((np.where(is_background[:, None], np.nan, low), high), places)
        nothing = np.empty((0, 2, len(places))), np.empty((0, 2, len(places)))
        near = Surroundings(
            nothing, others, _part(around.scene, places), around.margin[places], around.line[places]
        )
        moved = _place(half, own, own, near, _NAME_PLACES)
        is_free = ~_is_covered(moved - half, moved + half, others)
        middles[number][:, places[is_free]] = moved[:, is_free]
    return middles


def place_labels(letters: Floats, arrow: Box, around: Surroundings) -> Floats:
    """Return the middles (2, K) of one label in each of K scenes.

    A label is at the first free place: beside all blocked boxes, beside the arrow, above or below the scene.

    Args:
        letters: (K,), lengths of the labels.
        arrow: the box of the arrow.
    """
    nearest = np.fmin.reduce(around.blocked[0], axis=0), np.fmax.reduce(around.blocked[1], axis=0)
    return _place(half_sizes(letters, around.line), nearest, arrow, around, _LABEL_PLACES)


def half_sizes(letters: Floats, line: Floats) -> Floats:
    """Return half the widths and heights (2, K) of texts."""
    return np.stack([LETTER * letters * line / 2.0, line / 2.0])


def _place(half: Floats, nearest: Box, arrow: Box, around: Surroundings, most: int) -> Floats:
    """Return the middles (2, K) of one text in each of K scenes: the first of the best places.

    A text covers other objects only if every place in the view does, and leaves the view only if every place
    in it covers a blocked box.

    Args:
        half: half the sizes of the texts.
        nearest: the box that the text is beside.
        arrow: the box that it is beside if there is no room.
        most: the number of places to try.
    """
    centres, ranks = np.empty(half.shape), np.full(half.shape[1], _NOWHERE)
    left, of_left = np.arange(half.shape[1]), _Text(half, nearest, arrow, around)
    for number in range(most):
        places, is_possible = _candidate(number, of_left)
        if not is_possible.any():
            continue
        rank = np.where(is_possible, _ranks(places, of_left), _NOWHERE)
        is_better = rank < ranks[left]
        better = left[is_better]
        centres[:, better], ranks[better] = places[:, is_better], rank[is_better]
        waiting = np.flatnonzero(ranks[left] > 0)
        if not len(waiting):
            return centres
        if len(waiting) < _FEW * len(left):
            left, of_left = left[waiting], of_left.of_scenes(waiting)
    nowhere = ranks == _NOWHERE
    if nowhere.any():
        top = np.fmax.reduce(around.blocked[1][:, 1, nowhere], axis=0)
        above = top + half[1, nowhere] + _GAP * around.line[nowhere]
        centres[:, nowhere] = (nearest[0][0] + nearest[1][0])[nowhere] / 2.0, above
    return centres


class _Text(NamedTuple):
    """One text in each of some scenes, see `_place`."""

    half: Floats
    nearest: Box
    arrow: Box
    around: Surroundings

    def of_scenes(self, places: Integers) -> _Text:
        """Return those of some of the scenes."""
        return _Text(
            self.half.take(places, axis=-1),
            _part(self.nearest, places),
            _part(self.arrow, places),
            self.around.of_scenes(places),
        )


def _part(box: Box, places: Integers) -> Box:
    return box[0].take(places, axis=-1), box[1].take(places, axis=-1)


def _ranks(places: Floats, text: _Text) -> Integers:
    """Return how bad places (2, K) of texts are, 0 for a free one."""
    half, around = text.half, text.around
    begin, end = places - half, places + half
    centre = (around.scene[0][1] + around.scene[1][1]) / 2.0
    is_outside = np.abs(places[1] - centre) > around.margin - half[1]
    ranks = _is_covered(begin, end, around.others) + 2 * is_outside
    ranks[_is_covered(begin, end, around.blocked)] = _NOWHERE
    return np.asarray(ranks)


def _is_covered(begin: Floats, end: Floats, boxes: Box) -> Booleans:
    """Return (K,), whether texts from `begin` to `end` (2, K) cover any of the boxes (B, 2, K)."""
    return np.asarray(_overlaps(begin, end, boxes).any(axis=0))


def _overlaps(begin: Floats, end: Floats, boxes: Box) -> Booleans:
    """Return (B, K), which of the boxes (B, 2, K) texts from `begin` to `end` (2, K) cover."""
    low, high = boxes
    covers = (begin[1] < high[:, 1]) & (low[:, 1] < end[1])
    covers &= (begin[0] < high[:, 0]) & (low[:, 0] < end[0])
    return np.asarray(covers)


def _candidate(number: int, text: _Text) -> tuple[Floats, Booleans]:
    """Return one place for each text (2, K), the best first, and where it is possible (K,)."""
    half, nearest, arrow, around = text
    gap, centre = _GAP * around.line, (around.scene[0][0] + around.scene[1][0]) / 2.0
    reach = np.maximum(around.margin - half[0], 0.0)
    if number < 2 * len(_SIDES):
        low, high = nearest if number < len(_SIDES) else arrow
        side = _SIDES[number % len(_SIDES)]
        places = (low + high) / 2.0 + side[:, None] * ((high - low) / 2.0 + half + gap)
        if side[0]:
            return places, np.abs(places[0] - centre) <= reach
    else:
        far, is_below = divmod(number - 2 * len(_SIDES), 2)
        low, high = nearest if far < len(_FAR) else around.scene
        distance = half[1] + gap + (*_FAR, 0.0, *_FAR)[far] * around.line
        places = np.stack(
            [(arrow[0] + arrow[1])[0] / 2.0, low[1] - distance if is_below else high[1] + distance]
        )
    places[0] = np.clip(places[0], centre - reach, centre + reach)
    return places, np.ones(len(reach), np.bool_)

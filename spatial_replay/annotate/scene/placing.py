"""Positions of names and of an arrow's label, free of outlines, arrows and other texts."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats, Integers

LETTER: Final = 0.5
"""Width of a letter, fraction of the line height."""
_GAP: Final = 0.25
"""Distance of a text from its object, fraction of the line height."""
_FAR: Final = (1.5, 4.0)
"""Larger distances of labels, multiples of the line height."""
_SIDES: Final = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1)], np.float64)
_SIDES.flags.writeable = False
"""The eight positions around a box in the order of preference: above, below, right, left, corners."""

_NAME_PLACES: Final = len(_SIDES)
_LABEL_PLACES: Final = 2 * len(_SIDES) + 2 * len(_FAR) + 2 * (len(_FAR) + 1)
"""Numbers of candidate positions for a name and for a label."""

_NOWHERE: Final = 4
"""Rank of a position on a blocked box. Rank 2 is outside the view, 1 is on another object, 0 is free."""

_FEW: Final = 0.7
"""Share of scenes without a free position, below which the remaining scenes are copied to skip the others."""

Box = tuple[Floats, Floats]
"""Low and high corners (..., 2, K) of boxes in K scenes; NaN for no box."""


class Surroundings(NamedTuple):
    """The boxes of K scenes.

    Attributes:
        blocked: (B, 2, K) each, boxes that no text may cover.
        others: (N, 2, K) each, boxes that texts avoid.
        scene: box of all objects.
        margin: (K,), half the size of the view, from the centre of the scene.
        line: (K,), line height.
    """

    blocked: Box
    others: Box
    scene: Box
    margin: Floats
    line: Floats

    def of_scenes(self, places: Integers) -> Surroundings:
        """Return the surroundings of some of the scenes."""
        return Surroundings(
            _part(self.blocked, places),
            _part(self.others, places),
            _part(self.scene, places),
            self.margin[places],
            self.line[places],
        )


def place_names(low: Floats, high: Floats, letters: Floats, around: Surroundings) -> Floats:
    """Return the centres (N, 2, K) of N names in each of K scenes, each at the best of eight sides.

    Args:
        low, high: (N, 2, K), corners of the boxes of the named things.
        letters: (N, K), lengths of the names.
        around: surroundings, whose last N blocked boxes receive the boxes of the names.
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
    """Return the centres (N, 2, K) of names. A name that covers another object or name moves to a free side.

    A box around a named object is its background, which the object's name may cover.

    Args:
        middles: usual centres (N, 2, K); NaN without a name.
        letters: (N,), lengths of the names.
        movable: (N, K), whether each name may move.
        boxes: boxes of the named objects, (N, 2, K) each.
        around: the view; its boxes are ignored.
    """
    middles = middles.copy()
    halves = np.stack([half_sizes(length * np.ones_like(around.line), around.line) for length in letters])
    for number in np.flatnonzero(movable.any(axis=1)).tolist():
        rest = np.flatnonzero(np.arange(len(middles)) != number)
        low = np.concatenate([boxes[0][rest], (middles - halves)[rest]])
        high = np.concatenate([boxes[1][rest], (middles + halves)[rest]])
        named, half = (boxes[0][number], boxes[1][number]), halves[number]
        is_background = ((low <= named[0]) & (named[1] <= high)).all(axis=1)
        covers = _overlaps(middles[number] - half, middles[number] + half, (low, high)) & ~is_background
        places = np.flatnonzero(covers.any(axis=0) & movable[number])
        if not len(places):
            continue
        named, half = _part(named, places), half.take(places, axis=-1)
        others = _part((np.where(is_background[:, None], np.nan, low), high), places)
        nothing = np.empty((0, 2, len(places))), np.empty((0, 2, len(places)))
        near = Surroundings(
            nothing, others, _part(around.scene, places), around.margin[places], around.line[places]
        )
        moved = _place(half, named, named, near, _NAME_PLACES)
        is_free = ~_is_covered(moved - half, moved + half, others)
        middles[number][:, places[is_free]] = moved[:, is_free]
    return middles


def place_labels(letters: Floats, arrow: Box, around: Surroundings) -> Floats:
    """Return the centres (2, K) of one label in each of K scenes.

    A label has the first free position next to all blocked boxes, next to the arrow, or above or below.

    Args:
        letters: (K,), lengths of the labels.
        arrow: box of the arrow.
    """
    nearest = np.fmin.reduce(around.blocked[0], axis=0), np.fmax.reduce(around.blocked[1], axis=0)
    return _place(half_sizes(letters, around.line), nearest, arrow, around, _LABEL_PLACES)


def half_sizes(letters: Floats, line: Floats) -> Floats:
    """Return half the width and half the height of texts, (2, K)."""
    return np.stack([LETTER * letters * line / 2.0, line / 2.0])


def _place(half: Floats, nearest: Box, arrow: Box, around: Surroundings, most: int) -> Floats:
    """Return the centres (2, K) of one text in each of K scenes, at the first position of the best rank.

    A text covers other objects only if all positions in the view do. It leaves the view only if all
    positions in the view cover a blocked box.

    Args:
        half: half the sizes of the texts.
        nearest: box next to which the text is placed.
        arrow: box for positions without room next to `nearest`.
        most: number of candidate positions.
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
    """One text in each of some scenes; its fields are arguments of `_place`."""

    half: Floats
    nearest: Box
    arrow: Box
    around: Surroundings

    def of_scenes(self, places: Integers) -> _Text:
        """Return the text in some of the scenes."""
        return _Text(
            self.half.take(places, axis=-1),
            _part(self.nearest, places),
            _part(self.arrow, places),
            self.around.of_scenes(places),
        )


def _part(box: Box, places: Integers) -> Box:
    return box[0].take(places, axis=-1), box[1].take(places, axis=-1)


def _ranks(places: Floats, text: _Text) -> Integers:
    """Return (K,), the ranks of positions (2, K) of texts; see `_NOWHERE`."""
    half, around = text.half, text.around
    begin, end = places - half, places + half
    centre = (around.scene[0][1] + around.scene[1][1]) / 2.0
    is_outside = np.abs(places[1] - centre) > around.margin - half[1]
    ranks = _is_covered(begin, end, around.others) + 2 * is_outside
    ranks[_is_covered(begin, end, around.blocked)] = _NOWHERE
    return np.asarray(ranks)


def _is_covered(begin: Floats, end: Floats, boxes: Box) -> Booleans:
    """Return (K,), whether texts with corners `begin` and `end` (2, K) cover any of the boxes (B, 2, K)."""
    return np.asarray(_overlaps(begin, end, boxes).any(axis=0))


def _overlaps(begin: Floats, end: Floats, boxes: Box) -> Booleans:
    """Return (B, K), whether the texts with corners `begin` and `end` (2, K) cover each box (B, 2, K)."""
    low, high = boxes
    covers = (begin[1] < high[:, 1]) & (low[:, 1] < end[1])
    covers &= (begin[0] < high[:, 0]) & (low[:, 0] < end[0])
    return np.asarray(covers)


def _candidate(number: int, text: _Text) -> tuple[Floats, Booleans]:
    """Return a candidate position (2, K) for each text by its number, and (K,) whether it is possible."""
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

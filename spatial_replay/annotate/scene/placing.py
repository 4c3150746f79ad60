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
"""Number of candidate positions for a name."""

_LABEL_PLACES: Final = 2 * len(_SIDES) + 2 * len(_FAR) + 2 * (len(_FAR) + 1)
"""Number of candidate positions for a label."""

_NOWHERE: Final = 4
"""Rank of a position on a blocked box. Rank 2 is outside the view, 1 is on another object, 0 is free."""

_FEW: Final = 0.7
"""Fraction of the open scenes.

If fewer scenes still lack a free position, a copy of these scenes replaces the open scenes."""

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
    for name_index in range(len(low)):
        half_size = half_sizes(letters[name_index], around.line)
        box = low[name_index], high[name_index]
        middles[name_index] = _place(half_size, box, box, around, _NAME_PLACES)
        blocked_index = name_index - len(low)
        around.blocked[0][blocked_index] = middles[name_index] - half_size
        around.blocked[1][blocked_index] = middles[name_index] + half_size
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
    name_half_sizes = np.stack(
        [half_sizes(length * np.ones_like(around.line), around.line) for length in letters]
    )
    for name_index in np.flatnonzero(movable.any(axis=1)).tolist():
        other_indices = np.flatnonzero(np.arange(len(middles)) != name_index)
        lows = np.concatenate([boxes[0][other_indices], (middles - name_half_sizes)[other_indices]])
        highs = np.concatenate([boxes[1][other_indices], (middles + name_half_sizes)[other_indices]])
        object_box, half_size = (boxes[0][name_index], boxes[1][name_index]), name_half_sizes[name_index]
        is_background = ((lows <= object_box[0]) & (object_box[1] <= highs)).all(axis=1)
        covers = (
            _overlaps(middles[name_index] - half_size, middles[name_index] + half_size, (lows, highs))
            & ~is_background
        )
        scene_indices = np.flatnonzero(covers.any(axis=0) & movable[name_index])
        if not len(scene_indices):
            continue
        object_box, half_size = _part(object_box, scene_indices), half_size.take(scene_indices, axis=-1)
        other_boxes = _part((np.where(is_background[:, None], np.nan, lows), highs), scene_indices)
        no_boxes = np.empty((0, 2, len(scene_indices))), np.empty((0, 2, len(scene_indices)))
        surroundings = Surroundings(
            no_boxes,
            other_boxes,
            _part(around.scene, scene_indices),
            around.margin[scene_indices],
            around.line[scene_indices],
        )
        moved_centres = _place(half_size, object_box, object_box, surroundings, _NAME_PLACES)
        is_free = ~_is_covered(moved_centres - half_size, moved_centres + half_size, other_boxes)
        middles[name_index][:, scene_indices[is_free]] = moved_centres[:, is_free]
    return middles


def place_labels(letters: Floats, arrow: Box, around: Surroundings) -> Floats:
    """Return the centres (2, K) of one label in each of K scenes.

    A label has the first free position next to all blocked boxes, next to the arrow, or above or below.

    Args:
        letters: (K,), lengths of the labels.
        arrow: box of the arrow.
    """
    blocked_box = np.fmin.reduce(around.blocked[0], axis=0), np.fmax.reduce(around.blocked[1], axis=0)
    return _place(half_sizes(letters, around.line), blocked_box, arrow, around, _LABEL_PLACES)


def half_sizes(letters: Floats, line: Floats) -> Floats:
    """Return half the width and half the height of texts, (2, K)."""
    return np.stack([LETTER * letters * line / 2.0, line / 2.0])


def _place(half_size: Floats, nearest: Box, arrow: Box, around: Surroundings, candidate_count: int) -> Floats:
    """Return the centres (2, K) of one text in each of K scenes, at the first position of the best rank.

    A text covers other objects only if all positions in the view do. A text leaves the view only if all
    positions in the view cover a blocked box.

    Args:
        half_size: half the sizes of the texts.
        nearest: box next to which the text is placed.
        arrow: box for positions without room next to `nearest`.
        candidate_count: number of candidate positions.
    """
    centres, best_ranks = np.empty(half_size.shape), np.full(half_size.shape[1], _NOWHERE)
    open_scenes, open_text = np.arange(half_size.shape[1]), _Text(half_size, nearest, arrow, around)
    for candidate_index in range(candidate_count):
        candidate_centres, is_possible = _candidate(candidate_index, open_text)
        if not is_possible.any():
            continue
        candidate_ranks = np.where(is_possible, _ranks(candidate_centres, open_text), _NOWHERE)
        is_better = candidate_ranks < best_ranks[open_scenes]
        better_scenes = open_scenes[is_better]
        centres[:, better_scenes] = candidate_centres[:, is_better]
        best_ranks[better_scenes] = candidate_ranks[is_better]
        waiting_indices = np.flatnonzero(best_ranks[open_scenes] > 0)
        if not len(waiting_indices):
            return centres
        if len(waiting_indices) < _FEW * len(open_scenes):
            open_scenes, open_text = open_scenes[waiting_indices], open_text.of_scenes(waiting_indices)
    is_nowhere = best_ranks == _NOWHERE
    if is_nowhere.any():
        top = np.fmax.reduce(around.blocked[1][:, 1, is_nowhere], axis=0)
        above = top + half_size[1, is_nowhere] + _GAP * around.line[is_nowhere]
        centres[:, is_nowhere] = (nearest[0][0] + nearest[1][0])[is_nowhere] / 2.0, above
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


def _part(box: Box, scene_indices: Integers) -> Box:
    return box[0].take(scene_indices, axis=-1), box[1].take(scene_indices, axis=-1)


def _ranks(centres: Floats, text: _Text) -> Integers:
    """Return (K,), the ranks of positions (2, K) of texts; see `_NOWHERE`."""
    half, around = text.half, text.around
    lows, highs = centres - half, centres + half
    view_centre = (around.scene[0][1] + around.scene[1][1]) / 2.0
    is_outside = np.abs(centres[1] - view_centre) > around.margin - half[1]
    ranks = _is_covered(lows, highs, around.others) + 2 * is_outside
    ranks[_is_covered(lows, highs, around.blocked)] = _NOWHERE
    return np.asarray(ranks)


def _is_covered(lows: Floats, highs: Floats, boxes: Box) -> Booleans:
    """Return (K,), whether texts with corners `lows` and `highs` (2, K) cover any of the boxes (B, 2, K)."""
    return np.asarray(_overlaps(lows, highs, boxes).any(axis=0))


def _overlaps(lows: Floats, highs: Floats, boxes: Box) -> Booleans:
    """Return (B, K), whether the texts with corners `lows` and `highs` (2, K) cover each box (B, 2, K)."""
    box_lows, box_highs = boxes
    covers = (lows[1] < box_highs[:, 1]) & (box_lows[:, 1] < highs[1])
    covers &= (lows[0] < box_highs[:, 0]) & (box_lows[:, 0] < highs[0])
    return np.asarray(covers)


def _candidate(candidate_index: int, text: _Text) -> tuple[Floats, Booleans]:
    """Return the candidate positions (2, K) with an index, and (K,), whether each position is possible."""
    half, nearest, arrow, around = text
    gap, view_centre = _GAP * around.line, (around.scene[0][0] + around.scene[1][0]) / 2.0
    reach = np.maximum(around.margin - half[0], 0.0)
    if candidate_index < 2 * len(_SIDES):
        low, high = nearest if candidate_index < len(_SIDES) else arrow
        side = _SIDES[candidate_index % len(_SIDES)]
        centres = (low + high) / 2.0 + side[:, None] * ((high - low) / 2.0 + half + gap)
        if side[0]:
            return centres, np.abs(centres[0] - view_centre) <= reach
    else:
        distance_index, is_below = divmod(candidate_index - 2 * len(_SIDES), 2)
        low, high = nearest if distance_index < len(_FAR) else around.scene
        distance = half[1] + gap + (*_FAR, 0.0, *_FAR)[distance_index] * around.line
        centres = np.stack(
            [(arrow[0] + arrow[1])[0] / 2.0, low[1] - distance if is_below else high[1] + distance]
        )
    centres[0] = np.clip(centres[0], view_centre - reach, view_centre + reach)
    return centres, np.ones(len(reach), np.bool_)

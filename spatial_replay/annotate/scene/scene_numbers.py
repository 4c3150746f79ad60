"""Coordinates, colours and labels of the scene, as columns of the numbers that its templates take."""

from __future__ import annotations

from typing import Final

import numpy as np

from spatial_replay.annotate.scene.scene_frames import SceneContent
from spatial_replay.annotate.scene.scene_template import (
    CauseText,
    SceneLayout,
    encoded_stamps,
    numbers_of_witness,
)
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.wire import Words, words_of

LIFT: Final = 0.01
"""Height of flat objects above the plane, by the scale of the scene."""


class SceneNumbers:
    """The numbers of S messages that show R objects in all."""

    def __init__(
        self,
        times_ns: Integers,
        regions: Floats,
        objects: Floats,
        content: SceneContent,
        scale: float,
    ) -> None:
        """Take over what the messages show.

        Args:
            times_ns: (S,).
            regions: (S, regions, 3), their colours.
            objects: (R, 3), colours of the objects that are shown, message by message.
            content: of the messages.
            scale: the size of objects in the scene.
        """
        self._stamps = encoded_stamps(times_ns)
        self._regions = regions.reshape(len(times_ns), -1)
        self._content, self._scale = content, scale
        self._of_objects = [objects, content.middles]
        if any(form.has_height for form in content.rings.forms):
            top, bottom = content.footprints.top, content.footprints.bottom
            self._of_objects.append(np.stack([top, bottom, top - bottom, top + LIFT * scale], axis=-1))

    def of_messages(self, layout: SceneLayout, samples: Integers) -> Words:
        """Return (K, N) what to fill in a layout's template, each number once, in some messages (K,)."""
        columns = [self._stamps[samples], self._regions[samples]]
        content, count = self._content, len(layout.objects)
        if count:
            # those that are shown follow each other
            first = content.observations[samples, content.names.index(layout.objects[0].name)]
            corners = sum(sum(drawn.form.rings) for drawn in layout.objects)
            columns.append(_runs(content.rings.points, content.rings.start[first], corners))
            of_objects = self._of_objects[: 3 if layout.has_heights else 2]
            columns += [_runs(each, first, count) for each in of_objects]
        if isinstance(layout.witness, CauseText):
            found, labels = content.violations, [content.numbers[index] for index in samples.tolist()]
            z = np.fmax(found.top[samples], 0.0) + 3.0 * LIFT * self._scale
            columns += numbers_of_witness(found.points[samples], z, self._scale, labels, layout.witness.words)
        return words_of(columns)


def _runs(rows: Floats, first: Integers, count: int) -> Floats:
    """Return rows (R, k) side by side, `count` from each of the first ones (K,) on: (K, count * k)."""
    return np.asarray(rows[first[:, None] + np.arange(count)].reshape(len(first), -1))

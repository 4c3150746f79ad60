"""The colours of robustness."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from spatial_replay.annotate.scene.scene_frames import cell_colours

MAPS = arrays(np.float64, (3, 4), elements=st.floats())


@given(MAPS)
def test_a_cell_shows_its_sign_and_a_blocked_one_nothing(robustness):
    red, _, blue, alpha = np.moveaxis(cell_colours(robustness).astype(int), -1, 0)
    assert np.array_equal(alpha == 0, np.isnan(robustness))
    assert (blue > red)[robustness >= 0.0].all()
    assert (red > blue)[robustness < 0.0].all()


def test_the_largest_cell_of_a_map_has_the_fullest_colour():
    slight, middle, large = cell_colours(np.array([[0.0, 1.0, 2.0]]))[0, :, 2].tolist()
    assert slight < middle < large

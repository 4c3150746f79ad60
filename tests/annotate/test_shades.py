"""The colours of robustness."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from spatial_replay.annotate.scene.scene_frames import cell_colours
from spatial_replay.palette import NEGATIVE, POSITIVE

MAPS = arrays(np.float64, (3, 4), elements=st.floats())


@given(MAPS)
def test_a_better_cell_is_less_red_and_more_blue_and_a_blocked_one_shows_nothing(robustness):
    cells = cell_colours(robustness).astype(int)
    assert np.array_equal(cells[..., 3] == 0, np.isnan(robustness))
    redness = (cells[..., 0] - cells[..., 2]).ravel()[np.argsort(robustness, axis=None)]
    known = np.count_nonzero(~np.isnan(robustness))
    assert (np.diff(redness[:known]) <= 1).all()  # each colour is rounded to a whole number


def test_a_map_is_white_at_zero_and_ends_in_the_colours_of_verdicts():
    worst, zero, best = cell_colours(np.array([[-1.0, 0.0, 1.0]]))[0, :, :3] / 255.0
    np.testing.assert_allclose(worst, NEGATIVE, atol=0.005)
    np.testing.assert_allclose(best, POSITIVE, atol=0.005)
    assert len(set(zero)) == 1
    assert zero[0] > 0.9

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
def test_a_better_cell_is_lighter_and_a_blocked_one_shows_nothing(robustness):
    cells = cell_colours(robustness).astype(int)
    assert np.array_equal(cells[..., 3] == 0, np.isnan(robustness))
    greens = cells[..., 1].ravel()[np.argsort(robustness, axis=None)]
    known = np.count_nonzero(~np.isnan(robustness))
    assert (np.diff(greens[:known]) >= 0).all()


def test_a_map_has_no_colour_of_a_verdict():
    cells = cell_colours(np.linspace(-1.0, 1.0, 201)[None])[0, :, :3] / 255.0
    for colour in (POSITIVE, NEGATIVE):
        assert np.abs(cells - colour).max(axis=1).min() > 0.2

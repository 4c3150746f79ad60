"""Laws of data sets of robot learning."""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay.logs.formats.datasets import open_data_set
from spatial_replay.logs.formats.episodes import EpisodeReading

h5py = pytest.importorskip("h5py")

# half a turn is (0, 0, 1, 0) as x y z w, and as w x y z it reads as no turn at all
yaws = st.floats(-3.0, 3.0, allow_nan=False)
tilts = st.one_of(st.just(0.0), st.floats(-math.pi, math.pi, allow_nan=False))


turned = st.lists(yaws, min_size=1, max_size=3).filter(lambda starts: max(map(abs, starts)) > 0.1)
"""Of bodies of which one at least is turned: (0, 0, 0, 1) alone fits both orders."""


@given(starts=turned, tilt=tilts)
def test_both_orders_of_quaternions_give_one_pose(starts: list[float], tilt: float) -> None:
    """A body that stands upright at the start may tilt later, about the x axis."""
    upright = [[0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)] for yaw in starts]
    tilted = [math.sin(tilt / 2), 0.0, 0.0, math.cos(tilt / 2)]
    for columns in ([0, 1, 2, 3], [3, 0, 1, 2]):
        with TemporaryDirectory() as folder:
            path = Path(folder) / "set.hdf5"
            with h5py.File(path, "w") as file:
                for number, start in enumerate(upright):
                    poses = np.hstack([np.zeros((2, 3)), np.array([start, tilted])[:, columns]])
                    file[f"data/demo_{number}/states/rigid_object/cup/root_pose"] = poses
            data_set = open_data_set(path)
            assert data_set is not None
            (body,) = data_set.columns(0, EpisodeReading(fps=20)).bodies
            np.testing.assert_allclose(body.quaternions, [upright[0], tilted], atol=1e-12)

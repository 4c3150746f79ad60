"""Simulated worlds, recorded while their robot follows its script."""

from __future__ import annotations

import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def bench_simulated_run(measure: Any) -> None:
    """Ten simulated seconds of each world, with its own specification evaluated."""
    if find_spec("pybullet") is None:
        measure.remark("worlds are not simulated: PyBullet is not installed (the extra `sim`)")
        return
    from spatial_replay.runs.scripted import record_script
    from spatial_replay.simulation.tabletop import SCENARIOS

    with tempfile.TemporaryDirectory() as folder:
        for scenario in SCENARIOS:
            output = Path(folder) / f"{scenario}.mcap"
            measure(
                f"{scenario}, 10 s of it",
                lambda _, scenario=scenario, output=output: record_script(
                    scenario, output, duration_ns=10 * 10**9
                ),
                runs=3,
                limit_s=5.0,
            )

"""Formulas evaluated sample by sample, each sample as it comes: what a monitor runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Protocol

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.leaf_plans import SampleLeaves
from spatial_replay.monitor.program import Program
from spatial_replay.monitor.run import Run
from spatial_replay.spec.formula import Outline
from spatial_replay.trace.sample import Sample

ROOM = 64
"""Recent samples that there is room for at first: few, so that they stay in the processor's cache."""


class LiveEvaluation(Protocol):
    """Some formulas under some semantics, on their way through the samples."""

    def take(self, sample: Sample) -> list[Floats | None]:
        """Take in the next sample, whose time comes after the last one's.

        Returns:
            (N, 4) for each formula: value, now, lower and upper of each node; None before the start.
        """


class LiveRuns:
    """The programs of some formulas, fed by plans that samples of the same objects share."""

    def __init__(self, programs: Sequence[Program], regions: Mapping[str, Outline], start_ns: int) -> None:
        """Start before the first sample; those before `start_ns` are only there to be looked back at."""
        ends = accumulate((len(program.leaves) for program in programs), initial=0)
        self._runs = [
            (Run(program, room=ROOM, tile=1), slice(*ends))
            for program, ends in zip(programs, pairwise(ends), strict=True)
        ]
        self._leaves = SampleLeaves([program.leaves for program in programs], regions)
        self._start_ns = start_ns

    def take(self, sample: Sample) -> list[Floats | None]:
        samples = self._leaves.look_at(sample)
        if sample.time_ns < self._start_ns:
            return [None] * len(self._runs)
        leaves, times_ns = self._leaves.values(samples), np.array([sample.time_ns])
        return [run.extend(leaves[:, own], times_ns)[:, :, 0] for run, own in self._runs]

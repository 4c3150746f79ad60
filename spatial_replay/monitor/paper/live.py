"""Formulas under the paper's semantics, sample by sample, each sample as it comes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.leaf_plans import SampleLeaves
from spatial_replay.monitor.paper.run import PaperRun, left_out
from spatial_replay.monitor.program import Program
from spatial_replay.spec.formula import Formula, Outline, Truth, iter_nodes
from spatial_replay.trace.sample import Sample


class PaperRuns:
    """Some formulas on their way through the samples (see `LiveRuns`).

    Before the start every number is undetermined: NaN.
    """

    def __init__(
        self,
        formulas: Sequence[Formula],
        programs: Sequence[Program],
        regions: Mapping[str, Outline],
        start_ns: int,
    ) -> None:
        """Start before the first sample; those before `start_ns` are only there to be looked back at.

        Args:
            programs: of the formulas; their leaves are evaluated.
        """
        self._leaves = tuple(program.leaves for program in programs)
        self._runs = tuple(map(PaperRun, formulas, self._leaves))
        self._nodes = tuple(sum(1 for _ in iter_nodes(formula)) for formula in formulas)
        ends = accumulate(map(len, self._leaves), initial=0)
        self._own = tuple(slice(*ends) for ends in pairwise(ends))
        self._values = SampleLeaves(self._leaves, regions)
        self._start_ns = start_ns
        self._first_ns: int | None = None
        self._position = -1
        # compiles the kernel now rather than at the first sample
        PaperRun(Truth(True), ()).extend(np.empty((1, 0, 1)), np.zeros(1, np.int64))

    def take(self, sample: Sample) -> list[Floats | None]:
        """Take in the next sample; (N, 4) for each formula."""
        self._position += 1
        if self._first_ns is None:
            self._first_ns = sample.time_ns
        samples = self._values.look_at(sample)
        if sample.time_ns < self._start_ns:
            return [np.full((nodes, 4), np.nan) for nodes in self._nodes]
        values = self._values.values(samples)
        position, time_ns = np.array([self._position]), np.array([sample.time_ns])
        return [
            run.extend(left_out(values[:, own], leaves, position, time_ns, self._first_ns), time_ns)[:, :, 0]
            for run, own, leaves in zip(self._runs, self._own, self._leaves, strict=True)
        ]

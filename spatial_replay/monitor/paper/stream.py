"""The paper's own semantics: one instance of a specification by Def. 16, on its way through the samples.

It differs from what `InstanceStream` does in what lies beyond the run: an operand that would need it is left
out of minima and maxima. And in what is not known: whatever depends on it is undetermined.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.leaves import leaf_values
from spatial_replay.monitor.operands import Scene
from spatial_replay.monitor.paper.run import PaperRun, left_out
from spatial_replay.monitor.paper.table import OPERATORS
from spatial_replay.monitor.stream import Stretch
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec.faults import Source
from spatial_replay.spec.formula import Specification, Temporal, iter_nodes
from spatial_replay.trace.trace import window_of


def check_operators(specification: Specification) -> None:
    """That what is to be evaluated has no other temporal operators than the paper.

    Raises:
        UsageError: it has; the first is named, with its place.
    """
    for spec in specification.results:
        for _, _, node in iter_nodes(spec.formula):
            if isinstance(node, Temporal) and node.operator not in OPERATORS:
                source = Source.of(specification.source, specification.filename)
                fault = source.diagnostic("error", node.span, f"the paper's semantics has no {node.operator}")
                raise UsageError(
                    f"{fault.filename}:{fault.line}:{fault.column}: {fault.message}, as {spec.name} has; "
                    "write it with X, F, G and U, or evaluate with the semantics 'ltlf'"
                )


class PaperStream:
    """One instance under the semantics of the paper (see `InstanceStream`)."""

    def __init__(self, instance: Instance) -> None:
        self.instance = instance
        self.first_satisfied_ns: int | None = None
        self._leaves = instance.program.leaves
        self._run = PaperRun(instance.formula, self._leaves)
        self._robustness = np.full(sum(1 for _ in iter_nodes(instance.formula)), np.nan)

    def __len__(self) -> int:
        """How many samples it was evaluated over."""
        return len(self._run)

    @property
    def final(self) -> Floats:
        """(N, 2): twice each node's value on the samples so far; NaN where that is undetermined."""
        return np.repeat(self._robustness[:, None], 2, axis=1)

    @property
    def robustness(self) -> Floats:
        """(N,): each node's value on the samples so far."""
        return self._robustness.copy()

    @property
    def verdict(self) -> Verdict:
        """The sign of the root's value; unknown where that is undetermined."""
        return final_verdict(float(self._robustness[0]), float(self._robustness[0]))

    def extend(self, scene: Scene) -> Stretch:
        """Take in the samples of a scene that fall into the instance's window."""
        times = scene.trace.times_ns[scene.skip :]
        begin, end = window_of(times, self.instance.start_ns, self.instance.end_ns)
        times = times[begin:end]
        if not len(times):
            no_leaves = np.empty((1, len(self._leaves), 0))
            return Stretch(times, np.empty((len(self._robustness), 4, 0)), no_leaves)
        leaves = leaf_values(scene, self._leaves, self.instance.bindings)[:, :, begin:end]
        positions = np.arange(scene.skip + begin, scene.skip + end, dtype=np.int64)
        first_ns = int(scene.trace.times_ns[0])
        series = self._run.extend(left_out(leaves, self._leaves, positions, times, first_ns), times)
        self._robustness = series[:, 0, -1].copy()
        if self.first_satisfied_ns is None:
            satisfied = np.flatnonzero(series[0, 0] >= 0.0)
            self.first_satisfied_ns = int(times[satisfied[0]]) if len(satisfied) else None
        return Stretch(times, series, leaves)

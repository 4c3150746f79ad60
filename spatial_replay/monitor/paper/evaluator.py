"""Formulas under the paper's semantics, sample by sample, each sample as it comes.

One formula under the paper's semantics on one stream of samples: the state, and its growth.

The paper's own semantics: one instance of a specification by Def. 16, on its way through the samples.

It differs from what `InstanceStream` does in what lies beyond the run: an operand that would need it is left
out of minima and maxima. And in what is not known: whatever depends on it is undetermined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.atoms.live import SampleLeaves
from spatial_replay.monitor.atoms.live_rows import iter_delays
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.paper.kernel import PaperMemory, step_paper
from spatial_replay.monitor.paper.scans import OPERATORS, PaperTable, paper_table
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec.diagnostics import SourceText
from spatial_replay.spec.formula import (
    Atom,
    Formula,
    Outline,
    Quantified,
    Specification,
    Temporal,
    Truth,
    iter_nodes,
)
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import window_of

_TILE = 256
_FIRST_ROOM = 1024
MAX_PAIRS = 1 << 27
"""Pairs of samples that untils may keep a number for: some 16,000 samples, 1.2 GB."""


class PaperRun:
    """The numbers of every node on every prefix by Def. 16, as samples come.

    A formula whose temporal operators stand over plain formulas alone carries one number for each. What is
    below another temporal operator carries numbers for every sample so far, and a sample then takes time in
    proportion to them.
    """

    def __init__(
        self, formula: Formula, leaves: Sequence[Atom | Quantified], *, max_pairs: int = MAX_PAIRS
    ) -> None:
        """Start before the first sample.

        Args:
            leaves: the formula's atoms and open quantifiers, in the order in which `extend` is given them.
            max_pairs: after how many pairs of samples to give up.
        """
        self._max_pairs = max_pairs
        self._table = paper_table(formula, leaves)
        self._memory = _first_memory(self._table)
        self._position = 0

    def __len__(self) -> int:
        """How many samples were taken in."""
        return self._position

    def extend(self, leaves: Floats, times_ns: Integers) -> Floats:
        """Take in more samples.

        Args:
            leaves: (C, A, T), as `Run.extend` takes them, but for NaN where a leaf is left out (`left_out`).
            times_ns: (T,), increasing, also beyond the samples before.

        Returns:
            (N, 4, T): value, now, lower and upper of each node; the last two are the first.

        Raises:
            UsageError: more pairs of samples than allowed.
        """
        low, high = low_and_high(len(leaves), wide=False)
        numbers = np.ascontiguousarray(leaves[low])
        lost = ((numbers != leaves[high]) & ~np.isnan(numbers)).astype(np.int8)
        times_ns = np.array(times_ns, np.int64)  # writable, since kernels are compiled for that
        series = np.empty((len(self._table.rows), 4, len(times_ns)))
        for t in range(0, len(times_ns), _TILE):
            count = min(_TILE, len(times_ns) - t)
            self._make_room(self._position + count)
            step_paper(
                self._table.rows, self._table.operands, numbers, lost, times_ns,
                t, count, self._position, self._memory, series,
            )  # fmt: skip
            self._position += count
        return series

    def _make_room(self, samples: int) -> None:
        """See to it that so many samples fit."""
        memory, pairs = self._memory, self._table.pairs
        if self._table.columns and samples > len(memory.stamps):
            more = max(samples, 2 * len(memory.stamps)) - len(memory.stamps)
            memory = memory._replace(
                stamps=_longer(memory.stamps, more),
                columns=_longer(memory.columns, more),
                lost_columns=_longer(memory.lost_columns, more),
                pair_starts=_longer(memory.pair_starts, more),
            )
        if pairs:
            used = int(memory.pair_end[0])
            wanted = used + pairs * samples * (samples - self._position)
            if used > self._max_pairs:
                raise UsageError(
                    f"after {self._position} samples, an until of two temporal operands below a temporal "
                    "operator compares too many pairs of them; bound it, evaluate fewer samples, or use "
                    "the semantics 'ltlf'"
                )
            if wanted > len(memory.pairs):
                more = max(wanted, 2 * used) - len(memory.pairs)
                memory = memory._replace(
                    pairs=_longer(memory.pairs, more), lost_pairs=_longer(memory.lost_pairs, more)
                )
        self._memory = memory


def left_out(
    values: Floats,
    leaves: Sequence[Atom | Quantified],
    positions: Integers,
    times_ns: Integers,
    first_ns: int,
) -> Floats:
    """Leaves with NaN where one looks back (`a[-3]`) to before the log; a quantifier, where its body does.

    Args:
        values: (C, A, T) of these leaves.
        positions: (T,), how many samples of the log come before each.
        times_ns: (T,).
        first_ns: the time of the log's first sample.
    """
    is_before = np.zeros(values.shape[1:], np.bool_)
    for row, leaf in zip(is_before, leaves, strict=True):
        for samples, duration_ns in set(iter_delays([leaf])):
            row |= positions < (samples or 0)
            if duration_ns is not None:
                row |= times_ns - duration_ns < first_ns
    return np.where(is_before, np.nan, values) if is_before.any() else values


def _first_memory(table: PaperTable) -> PaperMemory:
    nodes, room = len(table.rows), _FIRST_ROOM if table.columns else 1
    return PaperMemory(
        stamps=np.zeros(room, np.int64),
        columns=np.full((table.columns, room), np.nan),
        lost_columns=np.zeros((table.columns, room), np.int8),
        value=np.full(nodes, np.nan),
        lost_value=np.zeros(nodes, np.int8),
        now=np.full(nodes, np.nan),
        lost_now=np.zeros(nodes, np.int8),
        left=np.full(nodes, np.nan),
        lost_left=np.zeros(nodes, np.int8),
        starts=np.full(nodes, -1, np.int64),
        opens=np.zeros(nodes, np.int64),
        pairs=np.empty(0),
        lost_pairs=np.empty(0, np.int8),
        pair_starts=np.zeros((table.pairs, room), np.int64),
        pair_end=np.zeros(1, np.int64),
    )


def _longer(array: np.ndarray, more: int) -> np.ndarray:
    """The array with room for more along its last axis."""
    return np.concatenate([array, np.zeros((*array.shape[:-1], more), array.dtype)], axis=-1)


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


def check_operators(specification: Specification) -> None:
    """That what is to be evaluated has no other temporal operators than the paper.

    Raises:
        UsageError: it has; the first is named, with its place.
    """
    for spec in specification.results:
        for _, _, node in iter_nodes(spec.formula):
            if isinstance(node, Temporal) and node.operator not in OPERATORS:
                source = SourceText.of(specification.source, specification.filename)
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

    def extend(self, scene: TraceScene) -> SeriesBlock:
        """Take in the samples of a scene that fall into the instance's window."""
        times = scene.trace.times_ns[scene.skip :]
        begin, end = window_of(times, self.instance.start_ns, self.instance.end_ns)
        times = times[begin:end]
        if not len(times):
            no_leaves = np.empty((1, len(self._leaves), 0))
            return SeriesBlock(times, np.empty((len(self._robustness), 4, 0)), no_leaves)
        leaves = leaf_values(scene, self._leaves, self.instance.bindings)[:, :, begin:end]
        positions = np.arange(scene.skip + begin, scene.skip + end, dtype=np.int64)
        first_ns = int(scene.trace.times_ns[0])
        series = self._run.extend(left_out(leaves, self._leaves, positions, times, first_ns), times)
        self._robustness = series[:, 0, -1].copy()
        if self.first_satisfied_ns is None:
            satisfied = np.flatnonzero(series[0, 0] >= 0.0)
            self.first_satisfied_ns = int(times[satisfied[0]]) if len(satisfied) else None
        return SeriesBlock(times, series, leaves)

"""One formula under the paper's semantics on one stream of samples: the state, and its growth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.channels import low_and_high
from spatial_replay.monitor.paper.kernel import PaperMemory, step_paper
from spatial_replay.monitor.paper.table import PaperTable, paper_table
from spatial_replay.monitor.recent import iter_delays
from spatial_replay.spec.formula import Atom, Formula, Quantified

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

"""One formula evaluated by Def. 16 of the paper, as samples come.

Differs from `OnlineRun` beyond the ends of the run: an operand that would need samples from there is left out
of minima and maxima. And where something is unknown: every number that depends on it is undetermined.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Empty, Floats, Integers
from spatial_replay.monitor.atoms.delays import iter_delays
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.paper.kernel import PaperMemory, step_paper
from spatial_replay.monitor.paper.scans import OPERATORS, PaperTable, paper_table
from spatial_replay.spec.diagnostics import SourceText
from spatial_replay.spec.formula import Atom, Formula, Quantified, Specification, Temporal, iter_nodes
from spatial_replay.spec.walks import has_rate

_TILE = 256
_FIRST_ROOM = 1024
MAX_PAIRS = 1 << 27
"""The most pairs of samples that untils may store a number for: about 16,000 samples, 1.2 GB."""


class PaperRun:
    """The numbers of every node on every prefix by Def. 16.

    A temporal operator over plain formulas carries one number. Below another temporal operator it carries
    numbers for every sample so far, and each sample takes time in proportion to them.
    """

    def __init__(
        self, formula: Formula, leaves: Sequence[Atom | Quantified], *, max_pairs: int = MAX_PAIRS
    ) -> None:
        """Start before the first sample.

        Args:
            leaves: the formula's atoms and open quantifiers, in the order in which `extend` is given them.
            max_pairs: the most pairs of samples to compare.
        """
        self._max_pairs = max_pairs
        self._table = paper_table(formula, leaves)
        self._memory = _first_memory(self._table)
        self._position = 0
        self._value = np.full(len(self._table.rows), np.nan)

    def __len__(self) -> int:
        """Return how many samples were added."""
        return self._position

    @property
    def final(self) -> Floats:
        """(N, 2): twice each node's value on the samples so far; NaN where it is undetermined."""
        return np.repeat(self._value[:, None], 2, axis=1)

    def extend(self, leaves: Floats, times_ns: Integers, empty: Empty = np.empty) -> Floats:
        """Add samples.

        Args:
            leaves: (C, A, T), as for `OnlineRun.extend`, with NaN where a leaf is left out (see `left_out`).
            times_ns: (T,), increasing and after the previous samples.
            empty: gives memory for what is returned.

        Returns:
            (N, 4, T): value, now, lower and upper of each node; the last two are the first.

        Raises:
            UsageError: more pairs of samples than allowed.
        """
        # Def. 16 knows no uncertainty: nominal ends only, and a number is lost where they differ
        low, high = low_and_high(len(leaves), wide=False)
        numbers = np.ascontiguousarray(leaves[low])
        lost = ((numbers != leaves[high]) & ~np.isnan(numbers)).astype(np.int8)
        times_ns = np.array(times_ns, np.int64)  # writable, since kernels are compiled for that
        series = empty((len(self._table.rows), 4, len(times_ns)))
        for t in range(0, len(times_ns), _TILE):
            count = min(_TILE, len(times_ns) - t)
            self._make_room(self._position + count)
            step_paper(
                self._table.rows, self._table.operands, numbers, lost, times_ns,
                t, count, self._position, self._memory, series,
            )  # fmt: skip
            self._position += count
        if len(times_ns):
            self._value = series[:, 0, -1].copy()
        return series

    def _make_room(self, samples: int) -> None:
        """Grow the memory to hold the given number of samples."""
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
    """Return leaves with NaN where one, or the body of a quantifier, looks back (`a[-3]`) to before the log.

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
    """Return the array with room for more along its last axis."""
    return np.concatenate([array, np.zeros((*array.shape[:-1], more), array.dtype)], axis=-1)


def check_operators(specification: Specification) -> None:
    """Check that all temporal operators of the result specs are the paper's.

    Raises:
        UsageError: the first other operator, with its place.
    """
    for spec in specification.results:
        for _, _, node in iter_nodes(spec.formula):
            if isinstance(node, Temporal) and node.operator not in OPERATORS:
                source = SourceText.of(specification.source, specification.filename)
                fault = source.diagnostic("error", node.span, f"the paper's semantics has no {node.operator}")
                remedy = "write it with X, F, G and U"
                if node is spec.formula and has_rate(node):
                    remedy = "a rate of change is read from the second sample on: write X in front"
                raise UsageError(
                    f"{fault.filename}:{fault.line}:{fault.column}: {fault.message}, as {spec.name} has; "
                    f"{remedy}, or evaluate with the semantics 'ltlf'"
                )

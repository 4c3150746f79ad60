"""Offline robustness: rho(t, node) of every node from each sample to the end of a finished log.

A monitor's numbers, in contrast, are about the first and the newest sample. A sliding window is evaluated as
a log of its own at each position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from types import MappingProxyType

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers, roomy, writable
from spatial_replay.monitor.offline_kernel import run_offline, run_windows
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.codes import OFFLINE_TARGET, low_and_high
from spatial_replay.monitor.online.operators import SignalTable, array_of_rows
from spatial_replay.spec.formula import Atom, Formula, Quantified, Temporal, iter_nodes
from spatial_replay.trace.sample import LATEST_NS

_MIRRORED = MappingProxyType({"X": "Y", "F": "O", "G": "H", "U": "S"})
"""Future operators and the past ones that they are in reversed time."""


class OfflineTable(SignalTable):
    """Rows of past operators, and of future operators as past ones in reversed time.

    That needs the samples' end, so it is for a stretch that is finished; there, unlike for a stretch that
    grows, every operator is a single pass.
    """

    def _added_row(self, formula: Formula, operands: list[int]) -> int:
        if isinstance(formula, Temporal) and formula.operator in _MIRRORED:
            return self._temporal(_MIRRORED[formula.operator], operands, formula.bound, codes.AHEAD)
        return super()._added_row(formula, operands)

    def instructions(self, nodes: Sequence[int]) -> Integers:
        """Return rows with the columns they read and write: n for node n, then those of other rows.

        Args:
            nodes: (N,), the row of each node.

        Returns:
            (R, OFFLINE_WIDTH), operands first.
        """
        column = {row: node for node, row in reversed(list(enumerate(nodes)))}
        others = (row for row in range(len(self._rows)) if row not in column)
        column |= dict(zip(others, count(len(nodes)), strict=False))
        result = []
        for number, (code, a, b, *rest) in enumerate(self._rows):
            operands = (a, b) if code == codes.LEAF else (column[a], column[b])
            result.append((code, *operands, *rest, column[number]))
        # equal nodes share a row, but each has a column of its own
        copies = [(codes.AND, column[row], column[row], 0, 0, 0, n) for n, row in enumerate(nodes)]
        result += [copy for copy in copies if copy[1] != copy[-1]]
        return array_of_rows(result, codes.OFFLINE_WIDTH)


@dataclass(frozen=True, eq=False)
class OfflineNodes:
    """Every node at every sample.

    Attributes:
        columns: (C, N, T), the ends of each node's interval (see `channels`).
    """

    columns: Floats

    def ends(self, node: int, *, wide: bool = True) -> tuple[Floats, Floats]:
        """Return the ends (T,) of a node's robustness at each sample, with uncertainty if `wide`."""
        low, high = low_and_high(len(self.columns), wide=wide)
        return self.columns[low, node], self.columns[high, node]


@dataclass(frozen=True, eq=False)
class OfflineFormula:
    """A formula compiled once, to be evaluated over several logs.

    Attributes:
        table: (R, OFFLINE_WIDTH), its rows.
        nodes, width: how many nodes it has, and columns with those of other rows.
    """

    table: Integers
    nodes: int
    width: int

    @classmethod
    def of(cls, formula: Formula, order: Sequence[Atom | Quantified]) -> OfflineFormula:
        """Compile a formula.

        Args:
            order: which leaf is which.
        """
        table = OfflineTable(order)
        nodes = [table.add(node) for _, _, node in iter_nodes(formula)]
        instructions = table.instructions(nodes)
        return cls(instructions, len(nodes), int(instructions[:, OFFLINE_TARGET].max()) + 1)

    def evaluate(self, leaves: Floats, times_ns: Integers) -> OfflineNodes:
        """Evaluate every node over all samples; see `evaluate_offline`."""
        columns = roomy((len(leaves), self.width, len(times_ns)), np.float64)
        extrema = np.empty(len(times_ns))
        stamps = writable(times_ns)
        run_offline(self.table, writable(leaves), stamps, 0, len(stamps), columns, extrema)
        return OfflineNodes(columns[:, : self.nodes])


def evaluate_offline(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers
) -> OfflineNodes:
    """Evaluate every node over all samples.

    Args:
        order: which leaf is which.
        leaves: (C, A, T), their intervals (see `leaf_values`).
        times_ns: (T,), increasing.
    """
    return OfflineFormula.of(formula, order).evaluate(leaves, times_ns)


def full_signal(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers
) -> Floats:
    """Compute each node's robustness at each sample, to the end of the log, (N, T); NaN: not determined."""
    return _determined(evaluate_offline(formula, order, leaves[:2], times_ns).columns)


def window_signal(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers, width_ns: int
) -> Floats:
    """Compute each node's robustness over the samples in (t - width, t], at each sample's t, (N, T).

    It is that at the first of these samples, on these samples alone: past operators start there. NaN where it
    is not determined. Takes time in proportion to the samples in a window.

    Raises:
        UsageError: a width that is no positive number of ns.
    """
    if isinstance(width_ns, bool) or not isinstance(width_ns, int) or not 0 < width_ns <= LATEST_NS:
        raise UsageError(f"a window of {width_ns!r} ns; give its width as an integer, 1 to 2**63 - 1 ns")
    compiled = OfflineFormula.of(formula, order)
    leaves = np.ascontiguousarray(leaves[:2])
    starts = np.searchsorted(times_ns, times_ns - width_ns, side="right").astype(np.int64)
    columns = np.empty((len(leaves), compiled.width, len(times_ns)))
    result = np.empty((len(leaves), compiled.nodes, len(times_ns)))
    run_windows(compiled.table, leaves, writable(times_ns), starts, columns, np.empty(len(times_ns)), result)
    return _determined(result)


def new_leaves(formula: Formula, order: Sequence[Atom | Quantified]) -> list[Atom | Quantified]:
    """Return the leaves of a formula that are not in `order`."""
    table = OfflineTable(order)
    table.add(formula)
    return table.leaves[len(order) :]


def _determined(ends: Floats) -> Floats:
    """Reduce the ends (C, N, T) to determined numbers (N, T), in place.

    Adding zero turns -0.0 into 0.0, so that equal numbers are equal bits.
    """
    determined: Floats = ends[0]
    determined += 0.0
    if len(ends) > 1:
        determined[determined != ends[1]] = np.nan
    return determined

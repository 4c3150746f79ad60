"""Every subformula of a formula, compiled for `finished_kernel.run_finished`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from types import MappingProxyType

from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor import codes
from spatial_replay.monitor.signal_table import SignalTable, array_of_rows
from spatial_replay.spec.formula import FUTURE_OPERATORS, Formula, Temporal

_MIRRORED = MappingProxyType({"X": "Y", "F": "O", "G": "H", "U": "S"})
"""Future operators and the past ones that they are in reversed time."""


class FinishedTable(SignalTable):
    """Rows of past operators, and of future operators as past ones in reversed time.

    That needs the samples' end, so it is for a stretch that is finished; there, unlike for a stretch that
    grows, every operator is a single pass.
    """

    def add(self, formula: Formula) -> int:
        """The row of a formula."""
        if isinstance(formula, Temporal) and formula.operator in FUTURE_OPERATORS:
            return self._future(formula, [self.add(each) for each in formula.operands])
        return super().add(formula)

    def instructions(self, nodes: Sequence[int]) -> Integers:
        """Rows with the columns that they read and write: that of node n is n, others come after.

        Args:
            nodes: (N,), the row of each node.

        Returns:
            (R, FINISHED_WIDTH), operands first.
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
        return array_of_rows(result, codes.FINISHED_WIDTH)

    def _future(self, formula: Temporal, operands: list[int]) -> int:
        match formula.operator:
            case "WX":
                return self._delay(operands[0], codes.SAMPLES, 1, codes.AHEAD, is_weak=True)
            case "R":
                negated = [self._row(codes.NOT, each) for each in operands]
                until = self._temporal("S", negated, formula.bound, codes.AHEAD)
                return self._row(codes.NOT, until)
            case "W":
                until = self._temporal("S", operands, formula.bound, codes.AHEAD)
                always = self._temporal("H", operands[:1], formula.bound, codes.AHEAD)
                return self._row(codes.OR, until, always)
        return self._temporal(_MIRRORED[formula.operator], operands, formula.bound, codes.AHEAD)

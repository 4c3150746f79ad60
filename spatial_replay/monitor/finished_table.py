"""Every subformula of a formula, compiled for `finished_kernel.run_finished`."""

from __future__ import annotations

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

    def rows(self) -> Integers:
        """(R, FINISHED_WIDTH), operands first."""
        return array_of_rows(list(self._rows), codes.FINISHED_WIDTH)

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

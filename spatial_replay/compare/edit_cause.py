"""Which of the edits of a formula changed its result, found by evaluating it with some of them only."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.compare.edits import TreeDiff
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.offline import evaluate_offline, new_leaves
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.paper.evaluator import PaperRun
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec.formula import Atom, Formula, Quantified
from spatial_replay.text import json_number

_MOST_EVALUATIONS: Final = 256
"""Formulas that are evaluated to find the cause of one change; the cause found by then stands."""


class EditOutcome(NamedTuple):
    """The result of a formula on a finished log; the robustness is NaN if not determined."""

    verdict: Verdict
    robustness: float
    lower: float
    upper: float

    @classmethod
    def of(cls, result: SpecResult) -> EditOutcome:
        return cls(result.verdict, result.robustness, result.lower, result.upper)

    def same_as(self, other: EditOutcome, *, verdict_only: bool = False) -> bool:
        """Say whether two outcomes have one verdict and, unless that is all that counts, the same numbers."""
        if verdict_only:
            return self.verdict is other.verdict
        pairs = zip(self[1:], other[1:], strict=True)
        return self.verdict is other.verdict and all(a == b or (a != a and b != b) for a, b in pairs)

    @property
    def document(self) -> dict[str, Any]:
        """The same as values for JSON."""
        numbers = {name: json_number(getattr(self, name)) for name in ("robustness", "lower", "upper")}
        return {"verdict": str(self.verdict), **numbers}


class EditOutcomes:
    """What the old formula gives with some units of edits; atoms are those that were evaluated already."""

    def __init__(self, one: SpecResult, other: SpecResult, diff: TreeDiff) -> None:
        self._diff = diff
        self._times_ns = one.times_ns
        self._semantics = one.semantics
        self._rows: dict[Atom | Quantified, Floats] = {}
        blocks = [(each, each.leaves) for each in (one, other) if each.leaves is not None]
        channels = max((len(leaves) for _, leaves in blocks), default=0)
        for each, leaves in blocks:
            columns = in_channels(leaves, channels)
            for index, leaf in enumerate(each.evidence.instance.program.leaves):
                self._rows[leaf] = columns[:, index]
        self._known: dict[frozenset[int], EditOutcome] = {}
        self.count = 0

    def __call__(self, units: Sequence[int]) -> EditOutcome:
        """Return the outcome of the old formula with only these units of edits made."""
        chosen = frozenset(units)
        if chosen not in self._known:
            self.count += 1
            self._known[chosen] = self._evaluated(self._diff.formula(chosen))
        return self._known[chosen]

    def _evaluated(self, formula: Formula) -> EditOutcome:
        leaves = new_leaves(formula, ())
        shape = next(iter(self._rows.values())).shape if self._rows else (1, len(self._times_ns))
        rows = [self._rows[leaf] for leaf in leaves]
        columns = np.stack(rows, axis=1) if rows else np.empty((shape[0], 0, shape[1]))
        if self._semantics == "paper":
            run = PaperRun(formula, leaves)
            run.extend(columns, self._times_ns)
            value = float(run.final[0, 0])
            return EditOutcome(final_verdict(value, value), value, value, value)
        done = evaluate_offline(formula, leaves, columns, self._times_ns)
        lower, upper = (float(end[0]) + 0.0 for end in done.ends(0))
        least, greatest = (float(end[0]) + 0.0 for end in done.ends(0, wide=False))
        return EditOutcome(
            final_verdict(lower, upper), least if least == greatest else math.nan, lower, upper
        )


def find_cause(
    diff: TreeDiff, outcome: Callable[[Sequence[int]], EditOutcome], old: EditOutcome, new: EditOutcome
) -> tuple[int, ...]:
    """Return the units of edits that changed a verdict or, if that stayed, the numbers; deepest first.

    Making only these gives the new verdict (numbers), making all the others the old one, and none of them can
    be left out. A single one is looked for first, the deepest before others.

    Args:
        outcome: returns the outcome of the old formula with some of the units.
    """
    if old.same_as(new):
        return ()
    verdict_only = old.verdict is not new.verdict
    units = sorted(diff.effective, key=lambda number: -max(edit.depth for edit in diff.units[number]))
    evaluated = 0

    def suffices(chosen: Sequence[int]) -> bool:
        nonlocal evaluated
        evaluated += 1
        others = [number for number in units if number not in chosen]
        return (
            evaluated <= _MOST_EVALUATIONS
            and outcome(chosen).same_as(new, verdict_only=verdict_only)
            and outcome(others).same_as(old, verdict_only=verdict_only)
        )

    for number in units:
        if suffices((number,)):
            return (number,)
    return tuple(minimised(units, suffices))


def minimised(parts: Sequence[int], holds: Callable[[Sequence[int]], bool]) -> list[int]:
    """Return some of the parts for which a condition, which holds for all of them, still holds.

    None of these can be left out alone (delta debugging: larger pieces are left out first).
    """
    current = list(parts)
    size = max(len(current) // 2, 1)
    while True:
        at, removed = 0, False
        while at < len(current):
            rest = current[:at] + current[at + size :]
            if rest and holds(rest):
                current, removed = rest, True
            else:
                at += size
        if size == 1 and not removed:
            return current
        size = max(size // 2, 1)

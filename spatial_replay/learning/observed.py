"""The numbers of one run that limits are fitted to: each quantity's extremes, its ends, and some samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.learning.quantities import Quantity
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.offline import OfflineFormula, new_leaves
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.spec.formula import Formula
from spatial_replay.trace.trace import Trace

_AT_ONCE: Final = 1 << 22
"""Numbers of a run that are held at once."""
_SAMPLED: Final = 64
"""Samples that say how often a relation holds."""


@dataclass(frozen=True, eq=False)
class Observed:
    """A run's numbers, each as a lower and an upper end: they differ where something is unknown or uncertain.

    Attributes:
        trace: its samples.
        least, greatest, first, last: (2, 2, Q) for Q quantities: by direction, the quantity itself and
            its negative, and by end.
        sampled: (2, Q, S), the lower ends in some samples, by direction.
        travel: (Q,), by how much each quantity varies.
        shifts: how far the corners of each object come from where they begin until the end; infinite if it is
            not there.
    """

    trace: Trace
    least: Floats
    greatest: Floats
    first: Floats
    last: Floats
    sampled: Floats
    travel: Floats
    shifts: Mapping[str, float]

    @classmethod
    def of(cls, trace: Trace, quantities: Sequence[Quantity]) -> Observed:
        """Measure every quantity in every sample."""
        scene = TraceScene(trace, {})
        step = max(1, _AT_ONCE // max(1, len(trace)))
        some = np.unique(np.linspace(0, len(trace) - 1, _SAMPLED).astype(np.int64))
        found: list[tuple[Floats, ...]] = []
        for start in range(0, len(quantities), step):
            values = directed(scene, quantities[start : start + step])
            nominal = np.where(np.isfinite(values[0]), values[0], np.nan).mean(axis=0)
            known = np.isfinite(nominal)
            span = np.where(known, nominal, -np.inf).max(axis=1) - np.where(known, nominal, np.inf).min(
                axis=1
            )
            found.append(
                (
                    values.min(axis=3),
                    values.max(axis=3),
                    values[..., 0],
                    values[..., -1],
                    values[:, 0][..., some],
                    np.maximum(span, 0.0),
                )
            )
        least, greatest, first, last, sampled, travel = zip(*found, strict=True)
        return cls(
            trace,
            np.concatenate(least, axis=2),
            np.concatenate(greatest, axis=2),
            np.concatenate(first, axis=2),
            np.concatenate(last, axis=2),
            np.concatenate(sampled, axis=1),
            np.concatenate(travel),
            {name: _shift(trace, column) for column, name in enumerate(trace.names)},
        )

    def first_time(self, quantity: Quantity, direction: int, limit: float, *, surely: bool) -> int:
        """Return the first sample in which a quantity, or its negative, is at least a limit; T if none.

        Args:
            direction: 0 for the quantity, 1 for its negative.
            surely: whether its lower end is to be, rather than its upper end.
        """
        values = directed(TraceScene(self.trace, {}), [quantity])[direction, 0 if surely else 1, 0]
        holds = values >= limit if surely else values > limit
        return int(holds.argmax()) if holds.any() else len(holds)


def _shift(trace: Trace, column: int) -> float:
    """Return how far an object's corners are, in the mean, from where they were in the first sample."""
    rows = trace.rows[[0, -1], column]
    if (rows < 0).any():
        return np.inf
    shapes = trace.footprints
    first, last = (
        shapes.vertices[
            shapes.vertex_start[shapes.part_start[row]] : shapes.vertex_start[shapes.part_start[row + 1]]
        ]
        for row in rows.tolist()
    )
    if first.shape != last.shape:
        return np.inf
    return float(np.hypot(*(last - first).mean(axis=0)))


def directed(scene: TraceScene, quantities: Sequence[Quantity]) -> Floats:
    """Return quantities and their negatives, with their ends, in each sample: (2, 2, Q, T)."""
    result = np.empty((2, 2, len(quantities), len(scene)))
    formulas = [each.formula for each in quantities]
    values = leaf_values(scene, formulas, {})
    low, high = low_and_high(len(values), wide=True)
    result[0] = values[low], values[high]
    result[1] = -values[high], -values[low]
    others = [index for index, each in enumerate(quantities) if each.reach is not each.formula]
    if others:
        # the negative of the least number of all members says nothing about the greatest one
        values = leaf_values(scene, [quantities[index].reach for index in others], {})
        low, high = low_and_high(len(values), wide=True)
        result[1][:, others] = values[low], values[high]
    return result


def robustness_of(formula: Formula, trace: Trace) -> tuple[float, float]:
    """Return the ends of a formula's robustness over a whole run, as a replay of its log has them."""
    order = new_leaves(formula, ())
    leaves = leaf_values(TraceScene(trace, {}), order, {})
    low, high = OfflineFormula.of(formula, order).evaluate(leaves, trace.times_ns).ends(0)
    return float(low[0]), float(high[0])

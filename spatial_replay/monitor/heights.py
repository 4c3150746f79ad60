"""Find comparisons of distances that heights decide, because one object is above the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.plausibility import bound_nodes, over_bindings
from spatial_replay.spec.formula import Atom, Outline, Quantified, SignedDistance, Specification
from spatial_replay.spec.walks import iter_expressions, looks_back, terms_of
from spatial_replay.text import Instant, Sentence, plural
from spatial_replay.trace.trace import Trace

_MOST_SAMPLES: Final = 64
"""Limit on compared samples per block."""


@dataclass(slots=True)
class _Comparison:
    """A comparison of a distance, with the number of samples in which heights decide it.

    Attributes:
        first_ns: time of the first sample in which heights decide.
        holds: whether the comparison holds in that sample.
        decided_count: number of samples in which heights decide.
        compared_count: number of samples that were compared.
    """

    atom: Atom
    bound: tuple[Quantified, ...]
    first_ns: int = 0
    holds: bool = False
    decided_count: int = 0
    compared_count: int = 0


class HeightComparisons:
    """Counts the samples in which a comparison would have the opposite result without heights."""

    def __init__(self, specifications: Sequence[Specification]) -> None:
        """Start before the first sample."""
        self._comparisons = [
            (specification, list(_comparisons_of(specification))) for specification in specifications
        ]

    def restart(self) -> HeightComparisons:
        """Return the same comparisons for another log, before its first sample."""
        heights = copy(self)
        heights._comparisons = [
            (specification, [_Comparison(comparison.atom, comparison.bound) for comparison in comparisons])
            for specification, comparisons in self._comparisons
        ]
        return heights

    def add(self, trace: Trace) -> None:
        """Add the next samples."""
        for specification, comparisons in self._comparisons:
            samples = _samples_with_one_above(trace, specification) if comparisons else np.empty(0, np.int64)
            if not len(samples):
                continue
            # a spread of few samples, because a block may have thousands of such samples
            compared_trace = trace.take(samples[:: 1 + len(samples) // _MOST_SAMPLES]).compact()
            scenes = (
                TraceScene(compared_trace, specification.regions),
                TraceScene(_without_heights(compared_trace), _flat(specification)),
            )
            for comparison in comparisons:
                formula = over_bindings("forall", comparison.bound, comparison.atom)
                # channel 0 is the low end, so a comparison with unknown values counts as false
                holds_in_space, holds_from_above = (
                    leaf_values(scene, [formula], {})[0, 0] >= 0 for scene in scenes
                )
                differing_samples = np.flatnonzero(holds_in_space != holds_from_above)
                comparison.compared_count += len(holds_in_space)
                if len(differing_samples) and not comparison.decided_count:
                    comparison.first_ns = int(compared_trace.times_ns[differing_samples[0]])
                    comparison.holds = bool(holds_in_space[differing_samples[0]])
                comparison.decided_count += len(differing_samples)

    def remarks(self) -> Iterator[Sentence]:
        """Yield a sentence on each comparison that heights decide."""
        for comparison in (comparison for _, comparisons in self._comparisons for comparison in comparisons):
            if comparison.decided_count:
                holds, opposite = ("holds", "does not") if comparison.holds else ("fails", "holds")
                samples_text = plural(comparison.compared_count, "sample")
                share_text = f"in {comparison.decided_count:,} of {samples_text} looked at"
                yield Sentence(
                    f"`{comparison.atom.text}` {holds} at ",
                    Instant(comparison.first_ns, 0),
                    f" because of heights: seen from above it {opposite} ({share_text})",
                )


def _comparisons_of(specification: Specification) -> Iterator[_Comparison]:
    comparisons: dict[str, _Comparison] = {}
    for node, bound in bound_nodes(specification):
        parts = list(iter_expressions(node.expression)) if isinstance(node, Atom) else []
        has_distance = any(isinstance(part, SignedDistance) for part in parts)
        if isinstance(node, Atom) and has_distance and not any(map(looks_back, terms_of(node.expression))):
            comparisons.setdefault(node.text, _Comparison(node, bound))
    yield from comparisons.values()


def _samples_with_one_above(trace: Trace, specification: Specification) -> Integers:
    """Return the samples in which an object or region is wholly above another object or region."""
    batch = trace.footprints
    # logs without heights are not compared again
    if not len(batch.bottom) or np.isnan(batch.bottom).all():
        return np.empty(0, np.int64)
    # the row of an absent object points to the appended infinity, which is ignored by `max` and `min`
    rows = np.where(trace.rows >= 0, trace.rows, len(batch.bottom))
    heights = [outline.height for outline in specification.regions.values() if outline.height is not None]
    highest_bottom = np.append(np.where(np.isnan(batch.bottom), -np.inf, batch.bottom), -np.inf)[rows].max(
        axis=1
    )
    lowest_top = np.append(np.where(np.isnan(batch.top), np.inf, batch.top), np.inf)[rows].min(axis=1)
    highest_bottom = np.maximum(highest_bottom, max((bottom for bottom, _ in heights), default=-np.inf))
    lowest_top = np.minimum(lowest_top, min((top for _, top in heights), default=np.inf))
    # if the highest bottom is above the lowest top, an object is above another
    return np.flatnonzero(highest_bottom > lowest_top)


def _without_heights(trace: Trace) -> Trace:
    no_heights = np.full(len(trace.footprints.bottom), np.nan)
    return replace(trace, footprints=replace(trace.footprints, bottom=no_heights, top=no_heights))


def _flat(specification: Specification) -> dict[str, Outline]:
    return {name: replace(outline, height=None) for name, outline in specification.regions.items()}

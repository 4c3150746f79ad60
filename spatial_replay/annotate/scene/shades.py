"""What is asked of each object itself: conjuncts of requirements, and what quantifiers bind, with numbers.

An object is coloured by what is about it: of `a dist c >= 1 and b dist c >= 1`, `a` by the first conjunct,
and of `forall p in people: p dist c >= 1` each person by its own distance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from types import MappingProxyType
from typing import Final

import numpy as np

from spatial_replay.annotate.deciding_leaf import leaf_key
from spatial_replay.annotate.requirements import Requirement
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.spec.formula import Formula, Outline, Quantified, TrackedName, iter_nodes
from spatial_replay.spec.walks import iter_terms, looks_back, substitute
from spatial_replay.trace.trace import Trace

_MOST_BINDINGS: Final = 64
"""Of a quantifier that binds more, all members have the number of the worst."""

_NO_NUMBERS: Final[Mapping[str, Floats]] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Shade:
    """A part of a requirement, with its numbers in the sign that counts.

    Attributes:
        requirement: the part.
        bound: of each object that the part's quantifier binds, its own number (T,) in the samples of a block;
            NaN where the part holds.
        least: the least number of the part so far.
        is_known: whether the part was known in all samples.
        least_bound: the least of `bound` so far.
        leaf: which of the program's leaves the quantifier is; -1 if the part is none.
        bodies: what the quantifier asks of each of its bindings.
        worst: (T,), which of them decides it in each sample of the block; -1 where the part holds.
    """

    requirement: Requirement
    bound: Mapping[str, Floats] = field(default_factory=lambda: _NO_NUMBERS)
    least: float = math.inf
    is_known: bool = True
    least_bound: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    leaf: int = -1
    bodies: tuple[Formula, ...] = ()
    worst: Integers = field(default_factory=lambda: np.empty(0, np.int64))

    def outcome(self, whole: Floats) -> Floats:
        """Return what the part comes to over a finished log, given what its obligation does, (S,)."""
        if not self.requirement.is_invariant or not (whole < 0.0).any():
            return whole
        number = self.least if self.is_known or self.least < 0.0 else math.nan
        return np.where(whole < 0.0, number, whole)

    def outcome_of(self, name: str, part: Floats) -> Floats:
        """Return what it comes to for one of the objects that the quantifier binds, given the part."""
        if not self.requirement.is_invariant or not self.least_bound:
            return part
        # where it never failed, it held by no less than 0
        number = self.least_bound.get(name, 0.0)
        return np.where(part < 0.0, number, part)

    def now_of(self, name: str, now: Floats, at: Sequence[int] | np.ndarray) -> Floats:
        """Return the number of one of the objects that the quantifier binds, given the part's (S,)."""
        own = self.bound.get(name)
        if own is None:
            return now
        return np.where((now < 0.0) & ~np.isnan(own[at]), own[at], now)


class ShadeTracker:
    """Follows the parts of one result's requirements; cutting the samples into blocks changes nothing."""

    def __init__(
        self, instance: Instance, parts: Sequence[Requirement], regions: Mapping[str, Outline]
    ) -> None:
        """Start before the first sample."""
        self._regions = regions
        nodes = [node for _, _, node in iter_nodes(instance.formula)]
        self._leaves = [
            _separable(substitute(nodes[each.node], instance.bindings), each.sign) for each in parts
        ]
        numbers = {leaf_key(leaf): index for index, leaf in enumerate(instance.program.leaves)}
        self.shades: tuple[Shade, ...] = tuple(
            Shade(each, leaf=-1 if leaf is None else numbers[leaf_key(nodes[each.node])])
            for each, leaf in zip(parts, self._leaves, strict=True)
        )

    def extend(self, trace: Trace, block: SeriesBlock) -> None:
        """Take in the next samples."""
        if len(block.times_ns):
            self.shades = tuple(
                self._extended(shade, leaf, trace, block)
                for shade, leaf in zip(self.shades, self._leaves, strict=True)
            )

    def _extended(self, shade: Shade, leaf: Quantified | None, trace: Trace, block: SeriesBlock) -> Shade:
        part = shade.requirement
        now = part.sign * block.series[part.node, 1]
        known = now[~np.isnan(now)]
        least = min(shade.least, float(known.min(initial=math.inf)))
        is_known = shade.is_known and len(known) == len(now)
        fails = np.flatnonzero(now < 0.0)
        bound: dict[str, Floats] = {}
        bodies, worst = tuple[Formula, ...](), np.full(len(now), -1, np.int64)
        if leaf is not None and len(fails):
            chosen = trace.take(np.searchsorted(trace.times_ns, block.times_ns[fails]))
            tuples, bodies, of_fails = _numbers_of(leaf, part.sign, TraceScene(chosen, self._regions))
            if bodies:
                is_least = of_fails == now[fails]
                worst[fails] = np.where(is_least.any(axis=0), is_least.argmax(axis=0), -1)
            for names, own in zip(tuples, of_fails, strict=True):
                for name in names:
                    numbers = bound.setdefault(name, np.full(len(now), np.nan))
                    numbers[fails] = np.fmin(numbers[fails], own)
        least_bound = dict(shade.least_bound)
        for name, numbers in bound.items():
            least_bound[name] = float(np.fmin.reduce(numbers, initial=least_bound.get(name, math.inf)))
        return Shade(part, bound, least, is_known, least_bound, shade.leaf, bodies, worst)


def _separable(leaf: Formula, sign: float) -> Quantified | None:
    """Return a quantifier that needs all that it binds, in one sample; None for others."""
    if not isinstance(leaf, Quantified) or leaf.quantifier != ("forall" if sign > 0.0 else "exists"):
        return None
    return None if any(map(looks_back, iter_terms([leaf]))) else leaf


def _numbers_of(
    leaf: Quantified, sign: float, scene: TraceScene
) -> tuple[Sequence[tuple[str, ...]], tuple[Formula, ...], Floats]:
    """Return the B bindings of a quantifier, what it asks of each, and its numbers (B, T); not of many."""
    names, none = scene.candidates(leaf.group), np.empty((0, len(scene.trace)))
    if math.perm(len(names), len(leaf.variables)) > _MOST_BINDINGS:
        return (), (), none
    tuples = list(permutations(names, len(leaf.variables)))
    bodies = tuple(
        substitute(leaf.body, dict(zip(leaf.variables, map(TrackedName, each), strict=True)))
        for each in tuples
    )
    if not bodies:
        return (), (), none
    values = leaf_values(scene, bodies, {})
    low, high = low_and_high(len(values), wide=False)
    return tuples, bodies, np.where(values[low] == values[high], sign * values[low], np.nan)

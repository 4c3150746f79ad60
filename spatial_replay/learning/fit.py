"""What holds in all good runs: limits with a margin, the bad runs that they distinguish, orders of events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from functools import cached_property
from itertools import product
from math import floor, log10
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.learning.facts import LimitedRelation, Line, Pattern, ordered
from spatial_replay.learning.observed import Observed
from spatial_replay.learning.quantities import WITH_LIMIT, Party, Quantity, members_of

PATTERNS: Final[tuple[Pattern, ...]] = ("always", "finally", "eventually")
ALWAYS, FINALLY, EVENTUALLY = range(3)
_MARGIN: Final = 3.0
"""Mean distances between the good runs' values that a limit keeps from the nearest of them."""
_FINEST: Final = 0.01
"""The least margin, as a part of the value itself."""
_SURE: Final = 4.0
"""A bad run so many margins away is distinguished as surely as any."""
_MOST_EVENTS: Final = 40
_STILL: Final = 1e-3
"""What varies by less than this part of the greatest distance does not move."""
_STAYS: Final = 0.05
"""What ends by less than this part of the farthest way from where it began is a landmark."""
_SCORED_RUNS: Final = 10
_MOST_BITS: Final = 6.0


@dataclass(frozen=True, eq=False)
class FittedLimits:
    """Every quantity's limits, fitted to some runs.

    Attributes:
        quantities: Q of them.
        good, bad: the numbers of the runs.
        limits: (3, 2, Q) by pattern and direction; NaN where no limit holds in all good runs.
        lowest: (3, 2, Q), the lowest value of the good runs.
        margins: (3, 2, Q), how far limits keep from it.
        apart: (3, 2, Q, B), how surely each bad run is distinguished, 0 to 1.
    """

    quantities: tuple[Quantity, ...]
    good: tuple[Observed, ...]
    bad: tuple[Observed, ...]
    limits: Floats
    lowest: Floats
    margins: Floats
    apart: Floats

    @classmethod
    def to(
        cls, quantities: Sequence[Quantity], good: Sequence[Observed], bad: Sequence[Observed]
    ) -> FittedLimits:
        """FittedLimits limits to the runs.

        A limit keeps a margin from the lowest value of the good runs: three times the mean distance of their
        values, or half the way to the nearest bad run beyond it, if that is less. A bad run that no limit
        distinguishes this way moves the limit that it is farthest behind, in margins, to the middle between
        it and the good runs.
        """
        values = np.stack([_by_pattern(each, 0) for each in good], axis=-1)
        lowest = values.min(axis=-1)
        with np.errstate(invalid="ignore"):
            spread = values.max(axis=-1) - lowest
            margins = np.maximum(_MARGIN * spread / (len(good) - 1), _FINEST * np.abs(lowest))
        with_limit = np.array([each.relation in WITH_LIMIT for each in quantities])
        valid = np.isfinite(lowest) & np.isfinite(margins) & (with_limit | (lowest >= 0.0))
        _leave_out(valid, quantities, lowest)
        limits = np.where(with_limit, lowest - margins, 0.0)
        # what is never nearer than at a distance is not said to overlap
        is_distance = np.array([each.relation == "dist" for each in quantities])
        limits[:, 0] = np.where(
            is_distance & (lowest[:, 0] >= 0.0), np.maximum(limits[:, 0], 0.0), limits[:, 0]
        )
        limits = np.where(valid, limits, np.nan)
        if not bad:
            return cls(
                tuple(quantities), tuple(good), (), limits, lowest, margins, np.empty((*limits.shape, 0))
            )
        reached = np.stack([_by_pattern(each, 1) for each in bad], axis=-1)
        beyond = reached < limits[..., None]
        nearest = np.where(beyond, reached, -np.inf).max(axis=-1)
        limits = np.where(with_limit, np.fmax(limits, (lowest + nearest) / 2.0), limits)
        limits = np.where(valid, limits, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (lowest[..., None] - reached) / margins[..., None]
        moved: list[tuple[int, ...]] = []
        for run in np.flatnonzero(~beyond.any(axis=(0, 1, 2))).tolist():
            behind = np.where(valid & with_limit & (reached[..., run] < lowest), far[..., run], 0.0)
            where = np.unravel_index(int(behind.argmax()), behind.shape)
            if behind[where] > 0.0:
                limits[where] = max(limits[where], (lowest[where] + reached[(*where, run)]) / 2.0)
                moved.append((*map(int, where), run))
        beyond = reached < limits[..., None]
        apart = np.where(beyond, np.clip(np.nan_to_num(far / _SURE, nan=1.0, posinf=1.0), 0.05, 1.0), 0.0)
        for each in moved:
            apart[each] = 1.0
        return cls(tuple(quantities), tuple(good), tuple(bad), limits, lowest, margins, apart)

    def fact(self, pattern: int, direction: int, quantity: int) -> LimitedRelation:
        """Return a quantity with its limit, as a short decimal that still holds."""
        found = self.quantities[quantity]
        if found.relation not in WITH_LIMIT:
            return LimitedRelation(found, direction, 0.0)
        where = pattern, direction, quantity
        limit, lowest = float(self.limits[where]), float(self.lowest[where])
        if not self.bad and (plain := _one_digit(limit, lowest)) is not None:
            return LimitedRelation(found, direction, plain)
        return LimitedRelation(
            found, direction, _short(limit, max(lowest - limit, _FINEST * abs(lowest)), lowest)
        )

    @cached_property
    def scale(self) -> float:
        """The greatest distance of any pair in the good runs."""
        found = [
            each.greatest[0, 1, index]
            for each in self.good[:_SCORED_RUNS]
            for index, quantity in enumerate(self.quantities)
            if quantity.relation == "dist"
        ]
        return max((float(each) for each in found if np.isfinite(each)), default=1.0) or 1.0

    @cached_property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """For each quantity that is about a class, those about its members; none for the others."""
        classes = members_of(self.good[0].trace)
        numbers = {
            (each.relation, parties): index
            for index, each in enumerate(self.quantities)
            for parties in ([each.parties, each.parties[::-1]] if each.is_symmetric else [each.parties])
        }
        found = []
        for each in self.quantities:
            named = [
                [Party(name) for name in classes.get(party.name, ())] if party.is_class else [party]
                for party in each.parties
            ]
            own: set[int] = set()
            if any(party.is_class for party in each.parties):
                pairs = product(*named)
                own = {index for pair in pairs if (index := numbers.get((each.relation, pair), -1)) >= 0}
            found.append(tuple(sorted(own)))
        return tuple(found)

    @cached_property
    def moves(self) -> Booleans:
        """(Q,), whether each quantity varies in a good run."""
        travel = np.max([each.travel for each in self.good], axis=0)
        is_length = np.array([each.relation not in ("oriented", "signal") for each in self.quantities])
        return np.asarray(travel > np.where(is_length, _STILL * self.scale, 0.0))

    @cached_property
    def landmarks(self) -> frozenset[Party]:
        """The objects, and whole classes, that stay where they are in all good runs."""
        shifts = {
            name: max(each.shifts[name] for each in self.good)
            for name in set.intersection(*(set(each.shifts) for each in self.good))
        }
        farthest = max((each for each in shifts.values() if np.isfinite(each)), default=0.0)
        still = {name for name, shift in shifts.items() if shift < _STAYS * farthest}
        classes = [members_of(each.trace) for each in self.good]
        whole = {name for name in classes[0] if all(name in each and each[name] <= still for each in classes)}
        return frozenset([*map(Party, still), *(Party(name, True) for name in whole)])

    def bits_between(self, quantity: int) -> float:
        """Return how much it says that a distance is between both its limits at the end."""
        limits = self.limits[FINALLY, :, quantity, None]
        limits = np.where(np.isfinite(limits), limits, -np.inf)
        inside = [
            (each.sampled[:, quantity] >= limits).all(axis=0).mean() for each in self.good[:_SCORED_RUNS]
        ]
        return float(-np.log2(max(float(np.mean(inside)), 2.0**-_MOST_BITS)))

    @cached_property
    def bits(self) -> Floats:
        """(3, 2, Q), how much is said: of what holds at some time, how seldom it holds; of what always does,
        how near it comes to not holding, as a part of how it varies."""
        some = self.good[:_SCORED_RUNS]
        share = np.mean(
            [(each.sampled[None] >= self.limits[..., None]).mean(axis=-1) for each in some], axis=0
        )
        bits = -np.log2(np.maximum(share, 2.0**-_MOST_BITS))
        travel = np.max([each.travel for each in self.good], axis=0)
        is_distance = np.array([each.relation == "dist" for each in self.quantities])
        other = np.array([each.relation in ("signal", "oriented") for each in self.quantities])
        near = np.maximum(np.abs(self.lowest[ALWAYS]) + self.margins[ALWAYS], 1e-12)
        with np.errstate(invalid="ignore", divide="ignore"):
            tight = np.log2(np.where(is_distance, self.scale / 2.0, travel) / near)
        # that a relation never holds, and what a signal's limits are, may be an accident
        tight[1, ~is_distance] = 0.0
        tight[:, other | ~self.moves] = 0.0
        bits[ALWAYS] = tight
        return np.where(np.isfinite(self.limits), np.clip(bits, 0.0, _MOST_BITS), 0.0)

    def events(self) -> list[LimitedRelation]:
        """Return facts that hold at the end of all good runs, not at their beginning, the rarest first."""
        begun = np.stack([each.first[:, 1] for each in self.good], axis=-1).max(axis=-1)
        limits = self.limits[FINALLY]
        found = np.isfinite(limits) & (begun < limits) & (self.bits[FINALLY] > 0.0)
        found[0] &= np.array([each.relation != "dist" for each in self.quantities])
        where = np.argwhere(found)
        order = np.argsort(-self.bits[FINALLY][found], kind="stable")[:_MOST_EVENTS]
        return [self.fact(FINALLY, direction, index) for direction, index in where[order].tolist()]

    def times(self, facts: Sequence[LimitedRelation], runs: Sequence[Observed]) -> tuple[Integers, Integers]:
        """Return in which sample each fact first holds for sure, and in which it first may, (F, R) each."""
        found = [
            [
                [each.first_time(fact.quantity, fact.direction, fact.limit, surely=surely) for each in runs]
                for fact in facts
            ]
            for surely in (True, False)
        ]
        sure, possible = np.array(found, np.int64).reshape(2, len(facts), len(runs))
        return sure, possible

    def orders(self, facts: Sequence[LimitedRelation]) -> list[tuple[Line, int, Booleans]]:
        """Return which facts come before which others in all good runs.

        Returns:
            Each line, the fewest samples between both facts, and which bad runs have the other order.
        """
        facts = [each.near for each in facts]
        sure, possible = self.times(facts, self.good)
        bad_sure, bad_possible = self.times(facts, self.bad)
        lengths = np.array([len(each.trace) for each in self.good])
        found = []
        for one, first in enumerate(facts):
            for other, later in enumerate(facts):
                if one == other or first.quantity.pair == later.quantity.pair:
                    continue
                gap = int((possible[other] - sure[one]).min())
                if gap > 0 and (sure[other] < lengths).all():
                    violating = bad_sure[other] < bad_possible[one]
                    found.append((ordered(first, later), gap, violating))
        return found


def _by_pattern(run: Observed, end: int) -> Floats:
    """Return what decides each pattern, by direction, (3, 2, Q): the least, last and greatest number."""
    return np.stack((run.least[:, end], run.last[:, end], run.greatest[:, end]))


def _leave_out(valid: Booleans, quantities: Sequence[Quantity], lowest: Floats) -> None:
    """Mark what another quantity says better, or what no one would write."""
    inside: dict[frozenset[Party], Booleans] = {}
    for index, quantity in enumerate(quantities):
        if quantity.relation == "enclosedin":
            inside[quantity.pair] = inside.get(quantity.pair, np.zeros(3, bool)) | valid[:, 0, index]
    for index, quantity in enumerate(quantities):
        if quantity.relation == "oriented":
            valid[:, 1, index] = False
        elif quantity.relation == "dist":
            # how deep two overlap, or that they were far apart at some time
            valid[:, 0, index] &= lowest[:, 0, index] >= 0.0
            valid[:, 1, index] &= lowest[:, 1, index] <= 0.0
            valid[EVENTUALLY, 0, index] = False
        elif quantity.relation == "ovlp":
            # what is inside overlaps, too
            valid[:, 0, index] &= ~inside.get(quantity.pair, np.zeros(3, bool))
            valid[:, 1, index] = False
        elif quantity.relation not in WITH_LIMIT:
            # that it does not hold is worth saying if it never does
            valid[1:, 1, index] = False


def _short(limit: float, margin: float, lowest: float) -> float:
    """Return a limit rounded down to a part of its margin, at most the lowest value."""
    if margin <= 0.0:
        return limit
    exponent = floor(log10(margin)) - 1
    rounded = Decimal(limit).scaleb(-exponent).to_integral_value(ROUND_FLOOR).scaleb(exponent)
    found = float(rounded)
    return found if found <= lowest else lowest


def _one_digit(limit: float, lowest: float) -> float | None:
    """Return the number of one digit from a limit up to the lowest value; None if there is none, or several.

    People write 0.05 rather than 0.0487, and good runs that come near a limit say no more.
    """
    step = Decimal(1).scaleb(floor(log10(max(abs(limit), abs(lowest)) or 1.0)))
    first = (Decimal(limit) / step).to_integral_value(ROUND_CEILING)
    last = (Decimal(lowest) / step).to_integral_value(ROUND_FLOOR)
    return float(first * step) if first == last != 0 else None

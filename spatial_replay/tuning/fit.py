"""Relations with limits that all good runs keep, the bad runs that they distinguish, and orders of events."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from functools import cached_property
from itertools import product
from math import floor, log10
from types import MappingProxyType
from typing import Final, Literal, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.spec.format import format_number
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.tokens import quote_name, written_name
from spatial_replay.text import number_text
from spatial_replay.tuning.quantities import WITH_LIMIT, Observed, Party, Quantity, members_of, variables_of

# ------------------------------------------------------------------------------------------ relations as text

Pattern: TypeAlias = Literal["always", "finally", "eventually", "until", "before"]
Phrases: TypeAlias = Mapping[str, tuple[str, str]]

_OPERATORS: Mapping[Pattern, str] = MappingProxyType({"always": "G", "finally": "F G", "eventually": "F"})
_PHRASES: Phrases = MappingProxyType(
    {
        "enclosedin": ("inside {b}", "not inside {b}"),
        "ovlp": ("overlapping {b}", "clear of {b}"),
        "leftof": ("left of {b}", "not left of {b}"),
        "below": ("below {b}", "not below {b}"),
        "prec": ("lower than {b}", "not lower than {b}"),
    }
)
"""Phrases for a relation and for its negation."""
_NAMED: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "dist": ("apart", "near"),
        "oriented": ("aligned", "aligned"),
        "signal": ("at_least", "at_most"),
        "enclosedin": ("in", "outside"),
        "ovlp": ("overlap", "clear"),
        "leftof": ("left", "not_left"),
        "below": ("below", "not_below"),
        "prec": ("lower", "not_lower"),
    }
)
"""Words for a relation and for its negation in names of specs."""


@dataclass(frozen=True, slots=True)
class LimitedRelation:
    """Relation with a limit, which holds or fails in each sample.

    Attributes:
        direction: 0 if the limit is for the quantity, 1 if it is for the negated quantity.
        limit: lower limit; 0.0 for relations without a number.
        other_limit: for a distance between two limits, lower limit of the negated distance; else None.
    """

    quantity: Quantity
    direction: int
    limit: float
    other_limit: float | None = None

    def text(self, taken: set[str]) -> str:
        """Return the text of the relation in a specification; no variable has a name in `taken`."""
        parties = self.quantity.parties
        if not parties:
            name = written_name(self.quantity.signal, RELATION_NAMES)
            return f"{name} {self._compared}"
        variables = variables_of(parties, taken)
        a, b = (
            variable if party.is_class else written_name(party.name, RELATION_NAMES)
            for party, variable in zip(parties, variables, strict=True)
        )
        text = self._atom(a, b)
        if parties[0].is_class and parties[0] == parties[1]:
            return f"forall {a}, {b} in class {quote_name(parties[0].name)}: {text}"
        for party, variable in reversed(list(zip(parties, variables, strict=True))):
            if party.is_class:
                text = f"forall {variable} in class {quote_name(party.name)}: {text}"
        return text

    def _atom(self, a: str, b: str) -> str:
        relation = self.quantity.relation
        if relation == "dist":
            if self.other_limit is not None:
                return f"{format_number(self.limit)} <= {a} dist {b} <= {format_number(-self.other_limit)}"
            return f"{a} dist {b} {self._compared}"
        if relation == "oriented":
            return f"{a} oriented[{format_number(-self.limit)}] {b}"
        bracket = "[z]" if relation == "prec" else ""
        text = f"{a} {relation}{bracket} {b}"
        return f"not ({text})" if self.direction else text

    @property
    def _compared(self) -> str:
        # 0 - limit instead of -limit, which would be -0.0 for 0.0
        return (
            f"<= {format_number(0.0 - self.limit)}" if self.direction else f">= {format_number(self.limit)}"
        )

    def words(self, verb: Callable[[str], str]) -> str:
        """Return the relation in words, such as "red and blue are at least 0.05 apart".

        Args:
            verb: function that returns the words for "are" or "is".
        """
        quantity = self.quantity
        number = number_text(0.0 - self.limit if self.direction else self.limit)
        if not quantity.parties:
            return f"{quantity.signal} {verb('is')} {'at most' if self.direction else 'at least'} {number}"
        first, second = quantity.parties
        if first == second:
            both, a, b = f"any two of class {first.name}", f"any {first.name}", "any other"
        else:
            a, b = _party_text(first), _party_text(second)
            both = f"{a} and {b}"
        if quantity.relation == "dist":
            if self.other_limit is not None:
                far = number_text(0.0 - self.other_limit)
                return f"{both} {verb('are')} {number} to {far} apart"
            return f"{both} {verb('are')} {'at most' if self.direction else 'at least'} {number} apart"
        if quantity.relation == "oriented":
            return f"{a} {verb('is')} turned as {b} is"
        return f"{a} {verb('is')} {_PHRASES[quantity.relation][self.direction].format(b=b)}"

    @property
    def name(self) -> str:
        """Name of a spec with the relation, in letters, digits and underscores."""
        which = _NAMED[self.quantity.relation][self.direction if self.other_limit is None else 1]
        names = [party.name for party in dict.fromkeys(self.quantity.parties)] or [self.quantity.signal]
        parts = [names[0], which, *names[1:]]
        text = "_".join("".join(c if c.isascii() and c.isalnum() else "_" for c in part) for part in parts)
        return text if text[0].isalpha() else f"_{text}"

    @property
    def near(self) -> LimitedRelation:
        """The relation; a distance between two limits keeps only its upper limit."""
        return self if self.other_limit is None else LimitedRelation(self.quantity, 1, self.other_limit)

    def opposite(self) -> LimitedRelation:
        """Return the negated relation."""
        return replace(self, direction=1 - self.direction, limit=0.0 - self.limit)


def _party_text(party: Party) -> str:
    return f"every {party.name}" if party.is_class else party.name


@dataclass(frozen=True, slots=True)
class Line:
    """One learned spec: a relation with a temporal pattern, or an order of two relations.

    Attributes:
        fact: relation that holds always, finally or eventually; for "before" and "until", the first one.
        later: for "before" and "until", relation that does not hold before the first one; else None.
    """

    pattern: Pattern
    fact: LimitedRelation
    later: LimitedRelation | None = None

    def formula(self, taken: set[str]) -> str:
        """Return the text of the formula; no variable has a name in `taken`."""
        text = self.fact.text(taken)
        if self.later is None:
            return f"{_OPERATORS[self.pattern]} ({text})"
        held = (
            self.later.opposite().text(taken)
            if self.pattern == "until"
            else f"not ({self.later.text(taken)})"
        )
        return f"({held}) U ({text})"

    @property
    def title(self) -> str:
        """The line in words."""
        words = self.fact.words
        if self.later is not None:
            if self.pattern == "until":
                return f"{self.later.opposite().words(str)} until {words(str)}"
            return f"{words(str)} before {self.later.words(str)}"
        if self.pattern == "finally":
            return words(lambda be: {"are": "end", "is": "ends"}[be])
        return words(lambda be: f"{be} {'always' if self.pattern == 'always' else 'once'}")

    @property
    def name(self) -> str:
        """Name of the spec."""
        if self.later is not None:
            if self.pattern == "until":
                return f"{self.later.opposite().name}_until_{self.fact.name}"
            return f"{self.fact.name}_before_{self.later.name}"
        ends = {"always": "always", "finally": "at_end", "eventually": "once"}
        return f"{self.fact.name}_{ends[self.pattern]}"


def order_line(first: LimitedRelation, later: LimitedRelation) -> Line:
    """Return the line for one relation before another, in the pattern with fewer negations."""
    is_positive = later.quantity.relation not in WITH_LIMIT and not later.direction
    return Line("before" if is_positive else "until", first, later)


# ----------------------------------------------------------------------------------------------------- limits

PATTERNS: Final[tuple[Pattern, ...]] = ("always", "finally", "eventually")
ALWAYS, FINALLY, EVENTUALLY = range(3)
_MARGIN: Final = 3.0
"""Margin of a limit from the nearest good run, in mean distances between the values of good runs."""
_FINEST: Final = 0.01
"""Least margin, as a fraction of the value."""
_SURE: Final = 4.0
"""Distance from the good runs, in margins, at which a bad run is fully distinguished."""
_MOST_EVENTS: Final = 40
_STILL: Final = 1e-3
"""Least movement, as a fraction of the greatest distance."""
_STAYS: Final = 0.05
"""Greatest displacement of a landmark, as a fraction of the farthest displacement of an object."""
_SCORED_RUNS: Final = 10
_MOST_BITS: Final = 6.0


@dataclass(frozen=True, eq=False)
class FittedLimits:
    """Limits of all quantities, fitted to some runs.

    Attributes:
        quantities: Q quantities.
        good, bad: measured runs, among them B bad ones.
        limits: (3, 2, Q), limits by pattern and direction; NaN if no limit holds in all good runs.
        lowest: (3, 2, Q), lowest values of the good runs.
        margins: (3, 2, Q), margins between lowest values and limits before bad runs move the limits.
        apart: (3, 2, Q, B), degree to which a limit distinguishes each bad run, 0 to 1.
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
        """Fit limits to the runs.

        A limit keeps a margin from the lowest value of the good runs. The margin is three times the mean
        distance of their values, and at most half of the way to the nearest bad run. If no limit
        distinguishes a bad run, one limit moves to the middle between that run and the good runs. It is the
        limit with the greatest gap between them, in margins.
        """
        values = np.stack([_by_pattern(run, 0) for run in good], axis=-1)
        lowest = values.min(axis=-1)
        # unknown values are infinite, and inf - inf is NaN, which `valid` excludes
        with np.errstate(invalid="ignore"):
            spread = values.max(axis=-1) - lowest
            margins = np.maximum(_MARGIN * spread / (len(good) - 1), _FINEST * np.abs(lowest))
        with_limit = np.array([quantity.relation in WITH_LIMIT for quantity in quantities])
        valid = np.isfinite(lowest) & np.isfinite(margins) & (with_limit | (lowest >= 0.0))
        _leave_out(valid, quantities, lowest)
        limits = np.where(with_limit, lowest - margins, 0.0)
        # objects that never overlapped get a limit of at least 0, which excludes overlaps
        is_distance = np.array([quantity.relation == "dist" for quantity in quantities])
        limits[:, 0] = np.where(
            is_distance & (lowest[:, 0] >= 0.0), np.maximum(limits[:, 0], 0.0), limits[:, 0]
        )
        limits = np.where(valid, limits, np.nan)
        if not bad:
            return cls(
                tuple(quantities), tuple(good), (), limits, lowest, margins, np.empty((*limits.shape, 0))
            )
        reached = np.stack([_by_pattern(run, 1) for run in bad], axis=-1)
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
        for index in moved:
            apart[index] = 1.0
        return cls(tuple(quantities), tuple(good), tuple(bad), limits, lowest, margins, apart)

    def fact(self, pattern: int, direction: int, quantity: int) -> LimitedRelation:
        """Return the relation of a quantity with its limit, rounded to a short decimal that still holds."""
        subject = self.quantities[quantity]
        if subject.relation not in WITH_LIMIT:
            return LimitedRelation(subject, direction, 0.0)
        where = pattern, direction, quantity
        limit, lowest = float(self.limits[where]), float(self.lowest[where])
        if not self.bad and (plain := _one_digit(limit, lowest)) is not None:
            return LimitedRelation(subject, direction, plain)
        return LimitedRelation(
            subject, direction, _short(limit, max(lowest - limit, _FINEST * abs(lowest)), lowest)
        )

    @cached_property
    def scale(self) -> float:
        """The greatest distance of two objects in the first good runs."""
        distances = [
            run.greatest[0, 1, index]
            for run in self.good[:_SCORED_RUNS]
            for index, quantity in enumerate(self.quantities)
            if quantity.relation == "dist"
        ]
        return max((float(distance) for distance in distances if np.isfinite(distance)), default=1.0) or 1.0

    @cached_property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """Indices of quantities: for each quantity of a class, those of the class members; else empty."""
        classes = members_of(self.good[0].trace)
        numbers = {
            (quantity.relation, parties): index
            for index, quantity in enumerate(self.quantities)
            for parties in (
                [quantity.parties, quantity.parties[::-1]] if quantity.is_symmetric else [quantity.parties]
            )
        }
        members = []
        for quantity in self.quantities:
            named = [
                [Party(name) for name in classes.get(party.name, ())] if party.is_class else [party]
                for party in quantity.parties
            ]
            member_numbers: set[int] = set()
            if any(party.is_class for party in quantity.parties):
                pairs = product(*named)
                member_numbers = {
                    index for pair in pairs if (index := numbers.get((quantity.relation, pair), -1)) >= 0
                }
            members.append(tuple(sorted(member_numbers)))
        return tuple(members)

    @cached_property
    def moves(self) -> Booleans:
        """(Q,), whether each quantity varies in some good run."""
        travel = np.max([run.travel for run in self.good], axis=0)
        is_length = np.array(
            [quantity.relation not in ("oriented", "signal") for quantity in self.quantities]
        )
        return np.asarray(travel > np.where(is_length, _STILL * self.scale, 0.0))

    @cached_property
    def landmarks(self) -> frozenset[Party]:
        """Objects, and classes of objects, that stay in place in all good runs."""
        shifts = {
            name: max(run.shifts[name] for run in self.good)
            for name in set.intersection(*(set(run.shifts) for run in self.good))
        }
        farthest = max((shift for shift in shifts.values() if np.isfinite(shift)), default=0.0)
        still = {name for name, shift in shifts.items() if shift < _STAYS * farthest}
        classes = [members_of(run.trace) for run in self.good]
        whole = {
            name
            for name in classes[0]
            if all(name in names_by_class and names_by_class[name] <= still for names_by_class in classes)
        }
        return frozenset([*map(Party, still), *(Party(name, True) for name in whole)])

    def bits_between(self, quantity: int) -> float:
        """Return the information of "the distance is between its limits at the end", bits."""
        limits = self.limits[FINALLY, :, quantity, None]
        limits = np.where(np.isfinite(limits), limits, -np.inf)
        inside = [(run.sampled[:, quantity] >= limits).all(axis=0).mean() for run in self.good[:_SCORED_RUNS]]
        return float(-np.log2(max(float(np.mean(inside)), 2.0**-_MOST_BITS)))

    @cached_property
    def bits(self) -> Floats:
        """(3, 2, Q), information of each line, bits.

        It is higher for a line with `F` that holds in fewer samples. It is higher for a line with `G` that
        comes closer to failing, relative to its variation.
        """
        some = self.good[:_SCORED_RUNS]
        share = np.mean([(run.sampled[None] >= self.limits[..., None]).mean(axis=-1) for run in some], axis=0)
        bits = -np.log2(np.maximum(share, 2.0**-_MOST_BITS))
        travel = np.max([run.travel for run in self.good], axis=0)
        is_distance = np.array([quantity.relation == "dist" for quantity in self.quantities])
        has_no_length = np.array(
            [quantity.relation in ("signal", "oriented") for quantity in self.quantities]
        )
        near = np.maximum(np.abs(self.lowest[ALWAYS]) + self.margins[ALWAYS], 1e-12)
        with np.errstate(invalid="ignore", divide="ignore"):
            tight = np.log2(np.where(is_distance, self.scale / 2.0, travel) / near)
        # a relation that never holds, and the limits of a signal, may be accidental
        tight[1, ~is_distance] = 0.0
        tight[:, has_no_length | ~self.moves] = 0.0
        bits[ALWAYS] = tight
        return np.where(np.isfinite(self.limits), np.clip(bits, 0.0, _MOST_BITS), 0.0)

    def events(self) -> list[LimitedRelation]:
        """Return relations that hold at the end of all good runs but at no beginning, the rarest first."""
        begun = np.stack([run.first[:, 1] for run in self.good], axis=-1).max(axis=-1)
        limits = self.limits[FINALLY]
        is_event = np.isfinite(limits) & (begun < limits) & (self.bits[FINALLY] > 0.0)
        is_event[0] &= np.array([quantity.relation != "dist" for quantity in self.quantities])
        where = np.argwhere(is_event)
        order = np.argsort(-self.bits[FINALLY][is_event], kind="stable")[:_MOST_EVENTS]
        return [self.fact(FINALLY, direction, index) for direction, index in where[order].tolist()]

    def times(self, facts: Sequence[LimitedRelation], runs: Sequence[Observed]) -> tuple[Integers, Integers]:
        """Return the first samples in which relations certainly hold, and may hold, (F, R) each."""
        first_times = [
            [
                [run.first_time(fact.quantity, fact.direction, fact.limit, surely=surely) for run in runs]
                for fact in facts
            ]
            for surely in (True, False)
        ]
        sure, possible = np.array(first_times, np.int64).reshape(2, len(facts), len(runs))
        return sure, possible

    def orders(self, facts: Sequence[LimitedRelation]) -> list[tuple[Line, int, Booleans]]:
        """Return the orders of relations that are the same in all good runs.

        Returns:
            For each order: its line, the least number of samples between the relations, and a flag for each
            bad run with the reverse order.
        """
        facts = [fact.near for fact in facts]
        sure, possible = self.times(facts, self.good)
        bad_sure, bad_possible = self.times(facts, self.bad)
        lengths = np.array([len(run.trace) for run in self.good])
        lines = []
        for first_index, first in enumerate(facts):
            for later_index, later in enumerate(facts):
                if first_index == later_index or first.quantity.pair == later.quantity.pair:
                    continue
                gap = int((possible[later_index] - sure[first_index]).min())
                if gap > 0 and (sure[later_index] < lengths).all():
                    violating = bad_sure[later_index] < bad_possible[first_index]
                    lines.append((order_line(first, later), gap, violating))
        return lines


def _by_pattern(run: Observed, end: int) -> Floats:
    """Return the deciding number of each pattern and direction, (3, 2, Q): least, last and greatest."""
    return np.stack((run.least[:, end], run.last[:, end], run.greatest[:, end]))


def _leave_out(valid: Booleans, quantities: Sequence[Quantity], lowest: Floats) -> None:
    """Mark limits as invalid that another quantity expresses better, or that no one would write."""
    inside: dict[frozenset[Party], Booleans] = {}
    for index, quantity in enumerate(quantities):
        if quantity.relation == "enclosedin":
            inside[quantity.pair] = inside.get(quantity.pair, np.zeros(3, bool)) | valid[:, 0, index]
    for index, quantity in enumerate(quantities):
        if quantity.relation == "oriented":
            valid[:, 1, index] = False
        elif quantity.relation == "dist":
            # left out are the depth of an overlap, and a large distance at some time
            valid[:, 0, index] &= lowest[:, 0, index] >= 0.0
            valid[:, 1, index] &= lowest[:, 1, index] <= 0.0
            valid[EVENTUALLY, 0, index] = False
        elif quantity.relation == "ovlp":
            # an object inside another one overlaps it, too
            valid[:, 0, index] &= ~inside.get(quantity.pair, np.zeros(3, bool))
            valid[:, 1, index] = False
        elif quantity.relation not in WITH_LIMIT:
            # a negated relation is written only if the relation never holds
            valid[1:, 1, index] = False


def _short(limit: float, margin: float, lowest: float) -> float:
    """Return a limit rounded down to two digits of its margin, at most the lowest value."""
    if margin <= 0.0:
        return limit
    exponent = floor(log10(margin)) - 1
    rounded = Decimal(limit).scaleb(-exponent).to_integral_value(ROUND_FLOOR).scaleb(exponent)
    short = float(rounded)
    return short if short <= lowest else lowest


def _one_digit(limit: float, lowest: float) -> float | None:
    """Return the only number with one digit between a limit and the lowest value; None if there is none.

    People write 0.05 instead of 0.0487, and good runs alone do not decide between the two.
    """
    step = Decimal(1).scaleb(floor(log10(max(abs(limit), abs(lowest)) or 1.0)))
    first = (Decimal(limit) / step).to_integral_value(ROUND_CEILING)
    last = (Decimal(lowest) / step).to_integral_value(ROUND_FLOOR)
    return float(first * step) if first == last != 0 else None

"""Limits of relations that hold in all good runs, bad runs that violate them, and orders of events."""

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
        """Return the text of the relation in a specification; variables avoid the names in `taken`."""
        parties = self.quantity.parties
        if not parties:
            name = written_name(self.quantity.signal, RELATION_NAMES)
            return f"{name} {self._comparison}"
        variables = variables_of(parties, taken)
        left_text, right_text = (
            variable if party.is_class else written_name(party.name, RELATION_NAMES)
            for party, variable in zip(parties, variables, strict=True)
        )
        text = self._atom(left_text, right_text)
        if parties[0].is_class and parties[0] == parties[1]:
            return f"forall {left_text}, {right_text} in class {quote_name(parties[0].name)}: {text}"
        for party, variable in reversed(list(zip(parties, variables, strict=True))):
            if party.is_class:
                text = f"forall {variable} in class {quote_name(party.name)}: {text}"
        return text

    def _atom(self, left: str, right: str) -> str:
        relation = self.quantity.relation
        if relation == "dist":
            if self.other_limit is not None:
                return (
                    f"{format_number(self.limit)} <= {left} dist {right} "
                    f"<= {format_number(-self.other_limit)}"
                )
            return f"{left} dist {right} {self._comparison}"
        if relation == "oriented":
            return f"{left} oriented[{format_number(-self.limit)}] {right}"
        bracket = "[z]" if relation == "prec" else ""
        text = f"{left} {relation}{bracket} {right}"
        return f"not ({text})" if self.direction else text

    @property
    def _comparison(self) -> str:
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
        limit_text = number_text(0.0 - self.limit if self.direction else self.limit)
        if not quantity.parties:
            return (
                f"{quantity.signal} {verb('is')} {'at most' if self.direction else 'at least'} {limit_text}"
            )
        first_party, second_party = quantity.parties
        if first_party == second_party:
            both_text, left_text, right_text = (
                f"any two of class {first_party.name}",
                f"any {first_party.name}",
                "any other",
            )
        else:
            left_text, right_text = _party_text(first_party), _party_text(second_party)
            both_text = f"{left_text} and {right_text}"
        if quantity.relation == "dist":
            if self.other_limit is not None:
                far_text = number_text(0.0 - self.other_limit)
                return f"{both_text} {verb('are')} {limit_text} to {far_text} apart"
            return (
                f"{both_text} {verb('are')} {'at most' if self.direction else 'at least'} {limit_text} apart"
            )
        if quantity.relation == "oriented":
            return f"{left_text} {verb('is')} turned as {right_text} is"
        return f"{left_text} {verb('is')} {_PHRASES[quantity.relation][self.direction].format(b=right_text)}"

    @property
    def name(self) -> str:
        """Name of a spec with the relation, in letters, digits and underscores."""
        relation_word = _NAMED[self.quantity.relation][self.direction if self.other_limit is None else 1]
        party_names = [party.name for party in dict.fromkeys(self.quantity.parties)] or [self.quantity.signal]
        name_parts = [party_names[0], relation_word, *party_names[1:]]
        text = "_".join(
            "".join(c if c.isascii() and c.isalnum() else "_" for c in part) for part in name_parts
        )
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
        fact: relation that holds always, finally or eventually; for "before" and "until", the first relation.
        later: for "before" and "until", relation that does not hold before `fact`; else None.
    """

    pattern: Pattern
    fact: LimitedRelation
    later: LimitedRelation | None = None

    def formula(self, taken: set[str]) -> str:
        """Return the text of the formula; variables avoid the names in `taken`."""
        text = self.fact.text(taken)
        if self.later is None:
            return f"{_OPERATORS[self.pattern]} ({text})"
        prior_condition = (
            self.later.opposite().text(taken)
            if self.pattern == "until"
            else f"not ({self.later.text(taken)})"
        )
        return f"({prior_condition}) U ({text})"

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
        endings = {"always": "always", "finally": "at_end", "eventually": "once"}
        return f"{self.fact.name}_{endings[self.pattern]}"


def order_line(first: LimitedRelation, later: LimitedRelation) -> Line:
    """Return the line for one relation before another, in the pattern with fewer negations."""
    is_positive = later.quantity.relation not in WITH_LIMIT and not later.direction
    return Line("before" if is_positive else "until", first, later)


# ----------------------------------------------------------------------------------------------------- limits

PATTERNS: Final[tuple[Pattern, ...]] = ("always", "finally", "eventually")
ALWAYS, FINALLY, EVENTUALLY = range(3)
_MARGIN: Final = 3.0
"""Margin of a limit from the nearest good run, divided by the mean distance between good runs' values."""
_FINEST: Final = 0.01
"""Least margin, as a fraction of the value."""
_SURE: Final = 4.0
"""Distance from the good runs at which a bad run is fully distinguished, as a multiple of the margin."""
_MOST_EVENTS: Final = 40
_STILL: Final = 1e-3
"""Greatest variation of a length that is ignored, as a fraction of `FittedLimits.scale`."""
_STAYS: Final = 0.05
"""Greatest displacement of a landmark, as a fraction of the farthest displacement of an object."""
_SCORED_RUNS: Final = 10
_MOST_BITS: Final = 6.0


@dataclass(frozen=True, eq=False)
class FittedLimits:
    """Limits of all quantities, fitted to some runs.

    Attributes:
        quantities: Q quantities.
        good, bad: measured good runs, and B measured bad runs.
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
        distance between good runs' values, and at most half of the distance to the nearest bad run.

        A bad run that no limit distinguishes moves one limit: the limit with the greatest gap, in margins,
        between that run and the good runs. The limit moves to the middle of the gap.
        """
        good_values = np.stack([_by_pattern(run, 0) for run in good], axis=-1)
        lowest = good_values.min(axis=-1)
        # unknown values are infinite, and inf - inf is NaN, which `is_valid` excludes
        with np.errstate(invalid="ignore"):
            spread = good_values.max(axis=-1) - lowest
            margins = np.maximum(_MARGIN * spread / (len(good) - 1), _FINEST * np.abs(lowest))
        has_limit = np.array([quantity.relation in WITH_LIMIT for quantity in quantities])
        is_valid = np.isfinite(lowest) & np.isfinite(margins) & (has_limit | (lowest >= 0.0))
        _leave_out(is_valid, quantities, lowest)
        limits = np.where(has_limit, lowest - margins, 0.0)
        # objects that never overlapped get a limit of at least 0, which excludes overlaps
        is_distance = np.array([quantity.relation == "dist" for quantity in quantities])
        limits[:, 0] = np.where(
            is_distance & (lowest[:, 0] >= 0.0), np.maximum(limits[:, 0], 0.0), limits[:, 0]
        )
        limits = np.where(is_valid, limits, np.nan)
        if not bad:
            return cls(
                tuple(quantities), tuple(good), (), limits, lowest, margins, np.empty((*limits.shape, 0))
            )
        bad_values = np.stack([_by_pattern(run, 1) for run in bad], axis=-1)
        is_beyond_limit = bad_values < limits[..., None]
        nearest_bad_value = np.where(is_beyond_limit, bad_values, -np.inf).max(axis=-1)
        limits = np.where(has_limit, np.fmax(limits, (lowest + nearest_bad_value) / 2.0), limits)
        limits = np.where(is_valid, limits, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            distances_in_margins = (lowest[..., None] - bad_values) / margins[..., None]
        moved_limits: list[tuple[int, ...]] = []
        for run_index in np.flatnonzero(~is_beyond_limit.any(axis=(0, 1, 2))).tolist():
            distances_behind = np.where(
                is_valid & has_limit & (bad_values[..., run_index] < lowest),
                distances_in_margins[..., run_index],
                0.0,
            )
            limit_index = np.unravel_index(int(distances_behind.argmax()), distances_behind.shape)
            if distances_behind[limit_index] > 0.0:
                limits[limit_index] = max(
                    limits[limit_index], (lowest[limit_index] + bad_values[(*limit_index, run_index)]) / 2.0
                )
                moved_limits.append((*map(int, limit_index), run_index))
        is_beyond_limit = bad_values < limits[..., None]
        apart = np.where(
            is_beyond_limit,
            np.clip(np.nan_to_num(distances_in_margins / _SURE, nan=1.0, posinf=1.0), 0.05, 1.0),
            0.0,
        )
        for apart_index in moved_limits:
            apart[apart_index] = 1.0
        return cls(tuple(quantities), tuple(good), tuple(bad), limits, lowest, margins, apart)

    def fact(self, pattern: int, direction: int, quantity: int) -> LimitedRelation:
        """Return the relation of a quantity with its limit, rounded to a short decimal that still holds."""
        limited_quantity = self.quantities[quantity]
        if limited_quantity.relation not in WITH_LIMIT:
            return LimitedRelation(limited_quantity, direction, 0.0)
        limit_index = pattern, direction, quantity
        limit, lowest_value = float(self.limits[limit_index]), float(self.lowest[limit_index])
        if not self.bad and (one_digit_limit := _one_digit(limit, lowest_value)) is not None:
            return LimitedRelation(limited_quantity, direction, one_digit_limit)
        return LimitedRelation(
            limited_quantity,
            direction,
            _short(limit, max(lowest_value - limit, _FINEST * abs(lowest_value)), lowest_value),
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
        """For each quantity of a class, indices of the members' quantities; () for other quantities."""
        names_by_class = members_of(self.good[0].trace)
        index_by_relation = {
            (quantity.relation, parties): index
            for index, quantity in enumerate(self.quantities)
            for parties in (
                [quantity.parties, quantity.parties[::-1]] if quantity.is_symmetric else [quantity.parties]
            )
        }
        all_members = []
        for quantity in self.quantities:
            party_members = [
                [Party(name) for name in names_by_class.get(party.name, ())] if party.is_class else [party]
                for party in quantity.parties
            ]
            member_indices: set[int] = set()
            if any(party.is_class for party in quantity.parties):
                party_pairs = product(*party_members)
                member_indices = {
                    index
                    for pair in party_pairs
                    if (index := index_by_relation.get((quantity.relation, pair), -1)) >= 0
                }
            all_members.append(tuple(sorted(member_indices)))
        return tuple(all_members)

    @cached_property
    def moves(self) -> Booleans:
        """(Q,), whether each quantity varies in some good run."""
        travels = np.max([run.travel for run in self.good], axis=0)
        is_length = np.array(
            [quantity.relation not in ("oriented", "signal") for quantity in self.quantities]
        )
        return np.asarray(travels > np.where(is_length, _STILL * self.scale, 0.0))

    @cached_property
    def landmarks(self) -> frozenset[Party]:
        """Objects, and classes of objects, that stay in place in all good runs."""
        shift_by_name = {
            name: max(run.shifts[name] for run in self.good)
            for name in set.intersection(*(set(run.shifts) for run in self.good))
        }
        farthest = max((shift for shift in shift_by_name.values() if np.isfinite(shift)), default=0.0)
        still_names = {name for name, shift in shift_by_name.items() if shift < _STAYS * farthest}
        classes_by_run = [members_of(run.trace) for run in self.good]
        still_classes = {
            name
            for name in classes_by_run[0]
            if all(
                name in names_by_class and names_by_class[name] <= still_names
                for names_by_class in classes_by_run
            )
        }
        return frozenset([*map(Party, still_names), *(Party(name, True) for name in still_classes)])

    def bits_between(self, quantity: int) -> float:
        """Return the information of a line that limits the distance at the end from both sides, bits."""
        limits = self.limits[FINALLY, :, quantity, None]
        limits = np.where(np.isfinite(limits), limits, -np.inf)
        inside_shares = [
            (run.sampled[:, quantity] >= limits).all(axis=0).mean() for run in self.good[:_SCORED_RUNS]
        ]
        return float(-np.log2(max(float(np.mean(inside_shares)), 2.0**-_MOST_BITS)))

    @cached_property
    def bits(self) -> Floats:
        """(3, 2, Q), information of each line, bits.

        A line with `F` has more information if it holds in fewer samples. A line with `G` has more
        information if it comes closer to failing, relative to its variation.
        """
        scored_runs = self.good[:_SCORED_RUNS]
        holding_shares = np.mean(
            [(run.sampled[None] >= self.limits[..., None]).mean(axis=-1) for run in scored_runs], axis=0
        )
        bits = -np.log2(np.maximum(holding_shares, 2.0**-_MOST_BITS))
        travels = np.max([run.travel for run in self.good], axis=0)
        is_distance = np.array([quantity.relation == "dist" for quantity in self.quantities])
        has_no_length = np.array(
            [quantity.relation in ("signal", "oriented") for quantity in self.quantities]
        )
        failure_distances = np.maximum(np.abs(self.lowest[ALWAYS]) + self.margins[ALWAYS], 1e-12)
        with np.errstate(invalid="ignore", divide="ignore"):
            tightness_bits = np.log2(np.where(is_distance, self.scale / 2.0, travels) / failure_distances)
        # a relation that never holds, and the limits of a signal, may be accidental
        tightness_bits[1, ~is_distance] = 0.0
        tightness_bits[:, has_no_length | ~self.moves] = 0.0
        bits[ALWAYS] = tightness_bits
        return np.where(np.isfinite(self.limits), np.clip(bits, 0.0, _MOST_BITS), 0.0)

    def events(self) -> list[LimitedRelation]:
        """Return relations that hold at the end of every good run, but not at its beginning; rarest first."""
        greatest_starts = np.stack([run.first[:, 1] for run in self.good], axis=-1).max(axis=-1)
        limits = self.limits[FINALLY]
        is_event = np.isfinite(limits) & (greatest_starts < limits) & (self.bits[FINALLY] > 0.0)
        is_event[0] &= np.array([quantity.relation != "dist" for quantity in self.quantities])
        event_indices = np.argwhere(is_event)
        bit_order = np.argsort(-self.bits[FINALLY][is_event], kind="stable")[:_MOST_EVENTS]
        return [
            self.fact(FINALLY, direction, index) for direction, index in event_indices[bit_order].tolist()
        ]

    def times(self, facts: Sequence[LimitedRelation], runs: Sequence[Observed]) -> tuple[Integers, Integers]:
        """Return the first samples in which relations certainly hold, and in which they may hold.

        Both arrays are (F, R) for F relations and R runs.
        """
        first_times = [
            [
                [run.first_time(fact.quantity, fact.direction, fact.limit, surely=surely) for run in runs]
                for fact in facts
            ]
            for surely in (True, False)
        ]
        sure_times, possible_times = np.array(first_times, np.int64).reshape(2, len(facts), len(runs))
        return sure_times, possible_times

    def orders(self, facts: Sequence[LimitedRelation]) -> list[tuple[Line, int, Booleans]]:
        """Return the orders of two relations that all good runs have in common.

        Returns:
            For each order: its line, the least number of samples between the relations, and a flag for each
            bad run with the reverse order.
        """
        facts = [fact.near for fact in facts]
        sure_times, possible_times = self.times(facts, self.good)
        bad_sure_times, bad_possible_times = self.times(facts, self.bad)
        sample_counts = np.array([len(run.trace) for run in self.good])
        lines = []
        for first_index, first_fact in enumerate(facts):
            for later_index, later_fact in enumerate(facts):
                if first_index == later_index or first_fact.quantity.pair == later_fact.quantity.pair:
                    continue
                gap_samples = int((possible_times[later_index] - sure_times[first_index]).min())
                if gap_samples > 0 and (sure_times[later_index] < sample_counts).all():
                    is_violating = bad_sure_times[later_index] < bad_possible_times[first_index]
                    lines.append((order_line(first_fact, later_fact), gap_samples, is_violating))
        return lines


def _by_pattern(run: Observed, end: int) -> Floats:
    """Return the deciding number of each pattern and direction, (3, 2, Q): least, last and greatest.

    Args:
        end: 0 for lower ends of the numbers, 1 for upper ends.
    """
    return np.stack((run.least[:, end], run.last[:, end], run.greatest[:, end]))


def _leave_out(is_valid: Booleans, quantities: Sequence[Quantity], lowest: Floats) -> None:
    """Invalidate limits that another quantity expresses better, or that people do not write."""
    inside_by_pair: dict[frozenset[Party], Booleans] = {}
    for index, quantity in enumerate(quantities):
        if quantity.relation == "enclosedin":
            inside_by_pair[quantity.pair] = (
                inside_by_pair.get(quantity.pair, np.zeros(3, bool)) | is_valid[:, 0, index]
            )
    for index, quantity in enumerate(quantities):
        if quantity.relation == "oriented":
            is_valid[:, 1, index] = False
        elif quantity.relation == "dist":
            # limits of an overlap's depth, and a large distance at some time, are left out
            is_valid[:, 0, index] &= lowest[:, 0, index] >= 0.0
            is_valid[:, 1, index] &= lowest[:, 1, index] <= 0.0
            is_valid[EVENTUALLY, 0, index] = False
        elif quantity.relation == "ovlp":
            # an object inside another object also overlaps it
            is_valid[:, 0, index] &= ~inside_by_pair.get(quantity.pair, np.zeros(3, bool))
            is_valid[:, 1, index] = False
        elif quantity.relation not in WITH_LIMIT:
            # a negated relation is written only if the relation never holds
            is_valid[1:, 1, index] = False


def _short(limit: float, margin: float, lowest: float) -> float:
    """Return a limit rounded down to the second digit of its margin; at most the lowest value."""
    if margin <= 0.0:
        return limit
    exponent = floor(log10(margin)) - 1
    rounded_limit = Decimal(limit).scaleb(-exponent).to_integral_value(ROUND_FLOOR).scaleb(exponent)
    short_limit = float(rounded_limit)
    return short_limit if short_limit <= lowest else lowest


def _one_digit(limit: float, lowest: float) -> float | None:
    """Return the only number with one digit between a limit and the lowest value; None if there is none.

    People write 0.05 instead of 0.0487, and good runs alone do not decide between these numbers.
    """
    step = Decimal(1).scaleb(floor(log10(max(abs(limit), abs(lowest)) or 1.0)))
    first_multiple = (Decimal(limit) / step).to_integral_value(ROUND_CEILING)
    last_multiple = (Decimal(lowest) / step).to_integral_value(ROUND_FLOOR)
    return float(first_multiple * step) if first_multiple == last_multiple != 0 else None

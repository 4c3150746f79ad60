"""Specifications learned from runs: lines, evidence for each line, and a check by cross-validation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.lazy import Printed
from spatial_replay.monitor.ends import Needs, trim_trace
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec import parse_specification
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import ANY_CLASS, NamedSpec, Specification
from spatial_replay.spec.relations import DEFAULT_PROFILE, PROFILES
from spatial_replay.spec.tokens import quote_name
from spatial_replay.text import json_value, number_text, plural, printable
from spatial_replay.trace.trace import Trace
from spatial_replay.tuning.fit import (
    ALWAYS,
    EVENTUALLY,
    FINALLY,
    PATTERNS,
    FittedLimits,
    LimitedRelation,
    Line,
    Pattern,
)
from spatial_replay.tuning.margins import LabelledRun
from spatial_replay.tuning.quantities import Observed, Party, Quantity, robustness_of, scope_of
from spatial_replay.tuning.tuned import require_comparable

# -------------------------------------------------------------------------------------------------- selection

_LEAST_BITS: Final = 0.25
"""Least information of a line, bits."""
_LEAST_BITS_NEAR: Final = 1.5
"""Least information of a line such as "always near" or "always inside", bits."""
_ALIKE: Final = 1.25
"""Greatest ratio between similar limits of a class's members, in lines about the end."""
_ALIKE_ALWAYS: Final = 2.0
"""Greatest ratio between similar limits of a class's members, in lines with `G`."""
_NEXT_LINE: Final = 0.6
"""Factor of the weight of a line for each earlier line with the same object."""
_LEAST_GAIN: Final = 0.25
"""Least total weight of the bad runs that a further line distinguishes."""
_LESS: Final = 0.5
"""Fraction of its weight that a bad run loses for each line that distinguishes the run."""
_NEVER: Final = 0.3
"""Weight of a bad run in a line about an order, if the first event never happens in the run.

A line about the end says more about such a run.
"""
_DISTANCES: Final = 2
"""Maximum number of distances from landmarks for one object; two leave two possible places in the plane."""
_LEAST_BITS_PLACED: Final = 2.0
"""Least information of a distance from the nearest landmark and of an object inside a landmark, bits."""
_SHARE_OF_ALWAYS: Final = 1 / 3
"""Greatest share of lines with `G`, and of lines about orders, if there are no bad runs."""
_PLAIN_BEFORE: Final = 0.8
"""Weight of a distinguished bad run in lines with the pattern "before"; see `_plainness`."""
_PLAIN_UNTIL: Final = 0.6
"""Weight of a distinguished bad run in lines with the pattern "until"; see `_plainness`."""
_DIRECTIONS: Final = frozenset({"leftof", "below", "prec"})


def chosen_lines(fit: FittedLimits, most: int) -> tuple[Line, ...]:
    """Return at most `most` lines for the specification, the most distinctive first."""
    lines = _distinctive(fit, most) if fit.bad else _characteristic(fit, most)
    return tuple(_join_limits(lines))


def _distinctive(fit: FittedLimits, most_lines: int) -> list[Line]:
    """Return lines; each next line distinguishes the most bad runs that the earlier lines miss."""
    limit_indices = np.argwhere((fit.apart > 0.0).any(axis=-1))
    events = fit.events()
    sample_counts = np.array([len(run.trace) for run in fit.bad])
    is_missing_by_event = dict(zip(events, fit.times(events, fit.bad)[1] >= sample_counts, strict=True))
    orders = [(line, violating) for line, _, violating in fit.orders(events) if violating.any()]
    weights = [fit.apart[tuple(limit_index)] for limit_index in limit_indices]
    weights += [
        np.where(violating, np.where(is_missing_by_event[line.fact], _NEVER, 1.0), 0.0)
        for line, violating in orders
    ]
    plainness = [_plainness(fit, *limit_index) for limit_index in limit_indices.tolist()]
    plainness += [_PLAIN_BEFORE if line.pattern == "before" else _PLAIN_UNTIL for line, _ in orders]
    bits = [round(float(fit.bits[tuple(limit_index)]), 3) for limit_index in limit_indices] + [
        0.0 for _ in orders
    ]
    run_weights = np.array(weights).reshape(len(weights), len(fit.bad))
    row_by_limit = {tuple(limit_index): row for row, limit_index in enumerate(limit_indices.tolist())}
    run_factors = np.ones(len(fit.bad))
    selected_lines: list[Line] = []
    while len(selected_lines) < min(most_lines, len(weights)):
        gains = np.round(run_weights @ run_factors * plainness, 3)
        best_row = max(range(len(weights)), key=lambda row: (gains[row], bits[row], -row))
        if gains[best_row] < _LEAST_GAIN:
            break
        if best_row < len(limit_indices):
            pattern, direction, quantity = limit_indices[best_row].tolist()
            selected_lines.append(Line(PATTERNS[pattern], fit.fact(pattern, direction, quantity)))
            # a line about a class includes its members
            member_rows = [row_by_limit.get((pattern, direction, member)) for member in fit.members[quantity]]
            run_weights[[row for row in member_rows if row is not None]] = 0.0
        else:
            selected_lines.append(orders[best_row - len(limit_indices)][0])
        run_factors = run_factors * (1.0 - run_weights[best_row] * _LESS)
        run_weights[best_row] = 0.0
    return selected_lines


def _plainness(fit: FittedLimits, pattern: int, direction: int, quantity: int) -> float:
    """Return the weight of a distinguished bad run: higher for kinds of lines that people often write."""
    relation = fit.quantities[quantity].relation
    if pattern == ALWAYS and relation == "dist" and not direction:
        return 1.0
    if pattern == FINALLY and not direction and relation in ("enclosedin", "oriented"):
        return 1.0
    if pattern == ALWAYS and relation == "dist":
        return 0.4
    weight = (
        0.9 if pattern == FINALLY and (relation in _DIRECTIONS or (relation == "dist" and direction)) else 0.7
    )
    return weight * (0.7 if pattern == EVENTUALLY else 1.0)


def _join(groups: list[set[Party]], pair: tuple[Party, ...]) -> bool:
    """Join the groups of two objects; return whether the objects were in different groups."""
    overlapping_groups = [group for group in groups if not group.isdisjoint(pair)]
    groups[:] = [
        *(group for group in groups if group not in overlapping_groups),
        set(pair).union(*overlapping_groups),
    ]
    return not any(group.issuperset(pair) for group in overlapping_groups)


def _characteristic(fit: FittedLimits, most_lines: int) -> list[Line]:
    """Return lines that describe all good runs: goals first, then invariants, then orders."""
    share_count = max(1, int(most_lines * _SHARE_OF_ALWAYS))
    invariants = _invariants(fit)[:share_count]
    goals = _goals(fit)[: max(1, most_lines - len(invariants))]
    orders = list(_chain(fit, [line.fact for line in goals if line.pattern == "finally"]))
    return [
        *goals,
        *invariants,
        *orders[: max(0, min(share_count, most_lines - len(goals) - len(invariants)))],
    ]


def _goals(fit: FittedLimits) -> list[Line]:
    """Return lines about the end of good runs: a distance for each object, and relations that changed."""
    scored_lines: list[tuple[float, int, Line]] = []
    party_groups, distance_counts = list[set[Party]](), Counter[Party]()
    scored_pairs = set()
    covered_indices: set[int] = set()
    centre = _centre(fit)
    for _, index in sorted(_distances(fit), key=lambda item: (-item[0], item[1])):
        quantity = fit.quantities[index]
        if index not in covered_indices and (
            _places(fit, quantity, distance_counts, centre)
            if fit.landmarks
            else _join(party_groups, quantity.parties)
        ):
            covered_indices.update(fit.members[index])
            fact = upper_relation = fit.fact(FINALLY, 1, index)
            if fit.limits[FINALLY, 0, index] > 0.0:
                fact = replace(fit.fact(FINALLY, 0, index), other_limit=upper_relation.limit)
            bits = fit.bits_between(index)
            if centre in quantity.parties or any(distance_counts[party] == 1 for party in quantity.parties):
                # the nearest landmark describes a place best, for any path of the object
                bits = max(bits, _LEAST_BITS_PLACED)
            scored_lines.append((bits, index, Line("finally", fact)))
            scored_pairs |= {quantity.pair, *(fit.quantities[member].pair for member in fit.members[index])}
    followers: dict[tuple[str, Party], set[Party]] = {}
    relations = [
        (bits, index)
        for index, quantity in enumerate(fit.quantities)
        if quantity.relation not in ("dist", "signal")
        and (not fit.landmarks or fit.landmarks.intersection(quantity.parties))
        and (bits := _said_at_end(fit, index)) >= _LEAST_BITS
        and fit.moves[index]
        and _agrees(fit, FINALLY, 0, index)
    ]
    for bits, index in sorted(relations, key=lambda item: _by_worth(fit, *item)):
        quantity = fit.quantities[index]
        is_changed = _begins_otherwise(fit, index)
        if index in covered_indices or not (is_changed or quantity.pair in scored_pairs):
            continue
        if quantity.relation == "ovlp" and quantity.pair in scored_pairs:
            # an object inside another object also overlaps it
            continue
        covered_indices.update(fit.members[index])
        if quantity.relation in _DIRECTIONS:
            first_party, second_party = quantity.parties
            if _leads(followers, quantity.relation, first_party, second_party):
                continue
            followers.setdefault((quantity.relation, first_party), set()).add(second_party)
        scored_lines.append((bits, index, Line("finally", fit.fact(FINALLY, 0, index))))
        scored_pairs |= {quantity.pair, *(fit.quantities[member].pair for member in fit.members[index])}
    scored_lines += _visits(fit, scored_pairs)
    sorted_lines = sorted(scored_lines, key=lambda item: (-item[0], item[1]))
    return _spread([(bits, line) for bits, _, line in sorted_lines], fit.landmarks)


def _begins_otherwise(fit: FittedLimits, index: int) -> bool:
    """Return whether a relation that holds at the end fails at the beginning of every good run."""
    return bool(max(run.first[0, 1, index] for run in fit.good) < fit.limits[FINALLY, 0, index])


def _said_at_end(fit: FittedLimits, index: int) -> float:
    """Return the information of a relation at the end, bits."""
    quantity, bits = fit.quantities[index], float(fit.bits[FINALLY, 0, index])
    is_put = quantity.relation == "enclosedin" and quantity.parties[1] in fit.landmarks
    if is_put and _begins_otherwise(fit, index):
        # an object is put into a landmark on purpose, even if this happens early in each run
        return max(bits, _LEAST_BITS_PLACED)
    return bits


def _centre(fit: FittedLimits) -> Party | None:
    """Return the landmark that is nearest to most objects at the end, such as a plate.

    The result is None if no landmark is nearest to two objects.
    """
    nearest_landmarks: dict[Party, tuple[float, Party]] = {}
    for index, quantity in enumerate(fit.quantities):
        still_parties = [party for party in quantity.parties if party in fit.landmarks and not party.is_class]
        moved_parties = [
            party for party in quantity.parties if party not in fit.landmarks and not party.is_class
        ]
        if quantity.relation == "dist" and len(still_parties) == len(moved_parties) == 1 and fit.moves[index]:
            landmark_distance = float(fit.lowest[FINALLY, 0, index]), still_parties[0]
            nearest_landmarks[moved_parties[0]] = min(
                nearest_landmarks.get(moved_parties[0], landmark_distance), landmark_distance
            )
    landmark_counts = Counter(landmark for _, landmark in nearest_landmarks.values())
    return max(
        (landmark for landmark in landmark_counts if landmark_counts[landmark] > 1),
        key=lambda landmark: (landmark_counts[landmark], landmark),
        default=None,
    )


def _places(
    fit: FittedLimits, quantity: Quantity, distance_counts: Counter[Party], centre: Party | None
) -> bool:
    """Return whether a landmark distance helps to define the place of a moved object.

    If it does, the number of the object's distances in `distance_counts` grows by 1.

    An object needs at most `_DISTANCES` distances. The distance from the centre is always used.
    """
    moved_parties = [party for party in quantity.parties if party not in fit.landmarks]
    if len(moved_parties) != 1 or (
        distance_counts[moved_parties[0]] >= _DISTANCES and centre not in quantity.parties
    ):
        return False
    distance_counts.update(moved_parties)
    return True


def _by_worth(fit: FittedLimits, bits: float, index: int) -> tuple[bool, float, bool, int]:
    """Return the sort key of a relation: overlaps last, rare relations first, classes before members."""
    return fit.quantities[index].relation == "ovlp", -round(bits, 1), not fit.members[index], index


def _spread(scored_lines: list[tuple[float, Line]], landmarks: frozenset[Party]) -> list[Line]:
    """Return lines sorted by bits; each earlier line about the same moved object reduces the bits."""
    party_counts = Counter[Party]()
    ordered_lines = []
    remaining_lines = [(bit, line, set(line.fact.quantity.parties) - landmarks) for bit, line in scored_lines]
    while remaining_lines:
        weights = [
            bit * _NEXT_LINE ** min((party_counts[party] for party in moved_parties), default=0)
            for bit, _, moved_parties in remaining_lines
        ]
        _, line, moved_parties = remaining_lines.pop(weights.index(max(weights)))
        ordered_lines.append(line)
        party_counts.update(moved_parties)
    return ordered_lines


def _agrees(fit: FittedLimits, pattern: int, direction: int, index: int) -> bool:
    """Return whether all members of a quantity's class have similar limits.

    Then one line about the class replaces the lines about its members.
    """
    limit = abs(float(fit.limits[pattern, direction, index]))
    greatest_ratio = _ALIKE_ALWAYS if pattern == ALWAYS else _ALIKE
    for member in fit.members[index]:
        member_limit = abs(float(fit.limits[pattern, direction, member]))
        if not fit.bits[pattern, direction, member] >= _LEAST_BITS or max(
            member_limit, limit
        ) > greatest_ratio * min(member_limit, limit):
            return False
    return True


def _distances(fit: FittedLimits) -> Iterator[tuple[float, int]]:
    """Yield distances at the end as weight and index.

    With landmarks, the weight is nearness. Without landmarks, it measures how well a distance defines a
    place.
    """
    for index, quantity in enumerate(fit.quantities):
        lower_limit, negated_upper_limit = fit.limits[FINALLY, :, index]
        if quantity.relation != "dist" or not negated_upper_limit < 0.0 or not fit.moves[index]:
            continue
        bits = fit.bits_between(index)
        is_apart = len(quantity.pair) == 2 and fit.lowest[FINALLY, 0, index] >= 0.0
        if fit.landmarks:
            if is_apart and not fit.members[index]:
                yield negated_upper_limit, index
        elif is_apart and bits >= _LEAST_BITS and _agrees(fit, FINALLY, 1, index):
            interval_width = -negated_upper_limit - (lower_limit if np.isfinite(lower_limit) else 0.0)
            travel = max(float(run.travel[index]) for run in fit.good)
            precision_bits = np.log2(travel / max(interval_width, 1e-3 * travel))
            closeness_bits = np.log2(fit.scale / max(-negated_upper_limit, 0.02 * fit.scale))
            yield float(min(bits, 3.0) + min(precision_bits, 4.0) + closeness_bits), index


def _leads(
    followers: dict[tuple[str, Party], set[Party]], relation: str, first: Party, second: Party
) -> bool:
    """Return whether a chain of already written directions leads from one object to another."""
    reachable_parties, pending_parties = {first}, [first]
    while pending_parties:
        for follower in followers.get((relation, pending_parties.pop()), ()):
            if follower not in reachable_parties:
                reachable_parties.add(follower)
                pending_parties.append(follower)
    return second in reachable_parties


def _visits(fit: FittedLimits, pairs: set[frozenset[Party]]) -> Iterator[tuple[float, int, Line]]:
    """Yield lines about relations that hold during good runs, but not at the beginning or the end."""
    for index, quantity in enumerate(fit.quantities):
        if quantity.relation not in ("enclosedin", "dist") or quantity.pair in pairs or fit.members[index]:
            continue
        direction = 1 if quantity.relation == "dist" else 0
        limit, bits = fit.limits[EVENTUALLY, direction, index], float(fit.bits[EVENTUALLY, direction, index])
        end_values = [
            max(float(run.first[direction, 1, index]), float(run.last[direction, 1, index]))
            for run in fit.good
        ]
        travel = max(float(run.travel[index]) for run in fit.good)
        if np.isfinite(limit) and bits >= 2.0 and fit.moves[index] and max(end_values) < limit - travel / 4.0:
            yield bits / 2.0, index, Line("eventually", fit.fact(EVENTUALLY, direction, index))


def _invariants(fit: FittedLimits) -> list[Line]:
    """Return lines with `G`, closest to failing first; lines of a class replace lines of its members."""
    scored_lines = []
    for direction, index in np.argwhere(fit.bits[ALWAYS] >= _LEAST_BITS).tolist():
        fact, bits = fit.fact(ALWAYS, direction, index), float(fit.bits[ALWAYS, direction, index])
        is_distance = fact.quantity.relation == "dist"
        is_informative = fact.limit > 0.0 if is_distance and not direction else bits >= _LEAST_BITS_NEAR
        is_writable = is_distance or fact.quantity.relation == "enclosedin"
        if is_informative and is_writable and _agrees(fit, ALWAYS, direction, index):
            scored_lines.append((-round(bits, 3), index, Line("always", fact)))
    scored_lines.sort(key=lambda item: item[:2])
    member_facts = {
        (line.fact.direction, member) for _, index, line in scored_lines for member in fit.members[index]
    }
    return [line for _, index, line in scored_lines if (line.fact.direction, index) not in member_facts]


def _chain(fit: FittedLimits, goals: Sequence[LimitedRelation]) -> Iterator[Line]:
    """Yield lines for the order in which goals are reached."""
    goals = [goal.near for goal in goals]
    goal_times, _ = fit.times(goals, fit.good)
    orders_by_pair = {(line.fact, line.later): (line, gap) for line, gap, _ in fit.orders(goals)}
    # a goal that holds in the first sample has no place in the order
    reached_goals = [
        goals[index]
        for index in np.argsort(np.median(goal_times, axis=1), kind="stable").tolist()
        if goal_times[index].min() > 0
    ]
    pending_goal: LimitedRelation | None = None
    for first_goal, later_goal in pairwise(reached_goals):
        goal_pair = pending_goal or first_goal, later_goal
        if goal_pair in orders_by_pair:
            yield orders_by_pair[goal_pair][0]
            pending_goal = None
        else:
            # both goals are reached at the same time, so the next goal is compared with the earlier goal
            pending_goal = pending_goal or first_goal


def _join_limits(lines: Sequence[Line]) -> Iterator[Line]:
    """Yield lines; two lines with the limits of one distance become one line."""
    limits: dict[tuple[str, Quantity, int], LimitedRelation] = {
        (line.pattern, line.fact.quantity, line.fact.direction): line.fact
        for line in lines
        if line.fact.quantity.relation == "dist" and line.pattern in ("always", "finally")
    }
    joined_keys = set()
    for line in lines:
        lower_relation, upper_relation = (
            limits.get((line.pattern, line.fact.quantity, direction)) for direction in (0, 1)
        )
        if (
            line.later is not None
            or lower_relation is None
            or upper_relation is None
            or lower_relation.other_limit is not None
        ):
            yield line
        elif (line.pattern, line.fact.quantity) not in joined_keys:
            joined_keys.add((line.pattern, line.fact.quantity))
            yield Line(line.pattern, replace(lower_relation, other_limit=upper_relation.limit))


# ------------------------------------------------------------------------------------------ the specification

MOST_LINES: Final = 100
DEFAULT_LINES: Final = 20
_MOST_MISSED: Final = 10
"""Maximum number of missed bad runs in the text; JSON lists all."""
_FOLDS: Final = 10
_FEWEST_SAMPLES: Final = 3
_MOST_NAMED: Final = 3
_LONGEST: Final = 1_000
"""Longest comment, characters."""


@dataclass(frozen=True, slots=True)
class LearnedLine:
    """One learned spec with its evidence.

    Attributes:
        name, title, text: name, title and formula of the spec.
        pattern: temporal pattern.
        lowest: lowest robustness of a good run.
        lowest_run: name of the good run with the lowest robustness.
        violated_by: names of the bad runs that violate the spec.
    """

    name: str
    title: str
    text: str
    pattern: Pattern
    lowest: float
    lowest_run: str
    violated_by: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class CheckedRun:
    """Run with its verdict under lines that were learned without it."""

    name: str
    is_good: bool
    verdict: Verdict

    @property
    def is_right(self) -> bool:
        """Whether a good run is satisfied, or a bad run violated."""
        return self.verdict is (Verdict.SATISFIED if self.is_good else Verdict.VIOLATED)


@dataclass(frozen=True, eq=False)
class Learned(Printed):
    """Specification learned from runs.

    Attributes:
        text: specification file with the evidence in comments; "" if nothing was found.
        specification: parsed text; None if nothing was found.
        specs: specs in the order of the file, the most distinctive first.
        runs: name of each run and whether it is good, in the given order.
        missed: names of bad runs that no line distinguishes.
        checked: runs with verdicts by cross-validation; empty with fewer than three good runs.
        left_out: phrases for objects, pairs and signals that were not compared.
    """

    text: str
    specification: Specification | None
    specs: tuple[LearnedLine, ...]
    runs: tuple[tuple[str, bool], ...]
    missed: tuple[str, ...]
    checked: tuple[CheckedRun, ...]
    left_out: tuple[str, ...]

    @property
    def is_found(self) -> bool:
        """Whether there are lines that together distinguish every bad run."""
        return bool(self.specs) and not self.missed

    def __repr__(self) -> str:
        return f"<Learned from {plural(len(self.runs), 'run')}: {plural(len(self.specs), 'spec')}>"

    def lines(self) -> Iterator[str]:
        """Yield the lines of text that the command `learn` prints: specs with their evidence."""
        bad_count = sum(not is_good for _, is_good in self.runs)
        good_count = len(self.runs) - bad_count
        runs_text = plural(good_count, "good run") + (
            f" and {plural(bad_count, 'bad run')}" if bad_count else ""
        )
        if self.specs:
            yield f"learned {plural(len(self.specs), 'spec')} from {runs_text}:"
        else:
            predicate = "distinguishes any bad run" if bad_count else "is worth a line"
            yield f"nothing that holds in all of {plural(good_count, 'good run')} {predicate}"
        width = max((len(line.title) for line in self.specs), default=0)
        for line in self.specs:
            evidence_text = (
                f"  violated by {len(line.violated_by)} of {bad_count}"
                if bad_count
                else f"  robustness at least {line.lowest:.4g}"
            )
            yield f"  {line.title:<{width}}{evidence_text}"
        if self.checked:
            yield checked_text(self.checked).rstrip(".")
        for name in self.missed[:_MOST_MISSED] if self.specs else ():
            yield f"{name} violates none of these lines"
        if self.specs and len(self.missed) > _MOST_MISSED:
            yield f"… nor do {plural(len(self.missed) - _MOST_MISSED, 'more bad run')}"
        for omission in self.left_out:
            yield f"not compared: {omission}"

    @property
    def document(self) -> dict[str, Any]:
        """The result as values for JSON."""
        return {
            "found": self.is_found,
            "text": self.text,
            "lines": json_value(self.specs),
            "runs": [{"name": name, "good": is_good} for name, is_good in self.runs],
            "missed": list(self.missed),
            "checked": json_value(self.checked),
            "left_out": list(self.left_out),
        }


def learn_runs(
    runs: Sequence[LabelledRun],
    *,
    lines: int = DEFAULT_LINES,
    profile: str = DEFAULT_PROFILE,
    advance: Callable[[int], None] = lambda runs: None,
) -> Learned:
    """Learn a specification of relations that hold in all good runs, but not in bad runs.

    Args:
        lines: greatest number of specs.
        profile: profile of the relations.
        advance: function that is called with the number of runs measured since its last call.

    Raises:
        UsageError: fewer than two good runs, a run that is too short, equal runs, runs in different units,
            runs without common objects or signals, or an invalid option.
    """
    if not 1 <= lines <= MOST_LINES:
        raise UsageError(f"{lines} lines cannot be learned; give 1 to {MOST_LINES}")
    if profile not in PROFILES:
        raise UsageError(f"unknown profile {profile!r}; the profiles are {', '.join(PROFILES)}")
    runs = [replace(run, trace=trim_trace(run.trace, _needs(run.trace))[0]) for run in runs]
    _check(runs)
    good = [run for run in runs if run.is_good]
    bad = [run for run in runs if not run.is_good]
    quantities, not_compared = scope_of([run.trace for run in good], profile)
    if not quantities:
        raise UsageError(_nothing_in_common(good))
    left_out = (*_missing(good), *not_compared)
    observed_by_id: dict[int, Observed] = {}
    for run in runs:
        observed_by_id[id(run)] = Observed.of(run.trace, quantities)
        advance(1)
    writer = _Writer(profile, {name for run in runs for name in run.trace.names})

    def learn(training_runs: Sequence[LabelledRun]) -> _Written | None:
        groups = (
            [observed_by_id[id(run)] for run in training_runs if run.is_good is is_good]
            for is_good in (True, False)
        )
        candidates = chosen_lines(FittedLimits.to(quantities, *groups), lines)
        return writer.write_lines(candidates, training_runs)

    draft = learn(runs)
    if draft is not None and bad:
        draft = writer.order(draft, bad)
    learned_lines = [_evidence(*pair, good, bad) for pair in draft.pairs] if draft is not None else []
    violating_names = {name for line in learned_lines for name in line.violated_by}
    checked_runs = tuple(_check_folds(good, bad, learn))
    missed = tuple(run.name for run in bad if run.name not in violating_names)
    text = ""
    if draft is not None:
        head_lines = list(_head(good, bad, missed, checked_runs, left_out))
        text = writer.text(draft, head_lines, learned_lines, len(good), len(bad))
    return Learned(
        text,
        parse_specification(text, filename="learned.spatial") if text else None,
        tuple(learned_lines),
        tuple((run.name, run.is_good) for run in runs),
        missed,
        checked_runs,
        left_out,
    )


def _needs(trace: Trace) -> Needs:
    """Return the needs of a specification that mentions everything in a trace."""
    return Needs(frozenset(trace.names), frozenset(trace.signals), frozenset({ANY_CLASS}))


def _check(runs: Sequence[LabelledRun]) -> None:
    good = [run for run in runs if run.is_good]
    if len(good) < 2:
        have_text = "there is no good run" if not good else f"{good[0].name} is the only good run"
        raise UsageError(f"{have_text}; give at least two, better five, to show what can vary")
    require_comparable(runs, "learn from")
    for run in runs:
        if len(run.trace) < _FEWEST_SAMPLES:
            have_text = plural(len(run.trace), "sample")
            raise UsageError(f"{run.name} is too short to learn from: it has {have_text}; leave it out")
    for first_run in good:
        for second_run in runs:
            if second_run is first_run or (len(first_run.trace), first_run.trace.names) != (
                len(second_run.trace),
                second_run.trace.names,
            ):
                continue
            if first_run.trace == second_run.trace:
                if first_run.name == second_run.name:
                    raise UsageError(f"{first_run.name} is given twice; give each run once")
                kind = "good" if second_run.is_good else "bad"
                raise UsageError(
                    f"the {kind} run {second_run.name} holds the same samples as the good run "
                    f"{first_run.name}; leave one of them out"
                )


def _missing(good: Sequence[LabelledRun]) -> Iterator[str]:
    """Yield phrases for objects in at least half of the good runs, but not in all good runs."""
    run_counts = Counter(name for run in good for name in run.trace.names)
    partial_names = [name for name in sorted(run_counts) if len(good) / 2 <= run_counts[name] < len(good)]
    for name in partial_names[:_MOST_NAMED]:
        yield f"{name}, which is missing in {len(good) - run_counts[name]} of {plural(len(good), 'good run')}"
    if len(partial_names) > _MOST_NAMED:
        yield f"{plural(len(partial_names) - _MOST_NAMED, 'more object')} that some good runs lack"


def _nothing_in_common(good: Sequence[LabelledRun]) -> str:
    names_text = "; ".join(
        f"{run.name} has {printable(', '.join(run.trace.names), 60) or 'none'}" for run in good[:_MOST_NAMED]
    )
    return (
        "no two objects, classes or signals are in all good runs, so there is nothing to compare: "
        f"{names_text}. Give runs of one scene, or a mapping that gives objects the same names or classes"
    )


class _Written(NamedTuple):
    """Lines with a specification that has one spec for each line."""

    lines: tuple[Line, ...]
    specification: Specification

    @property
    def pairs(self) -> Iterator[tuple[Line, NamedSpec]]:
        """Pairs of a line and its spec."""
        return zip(self.lines, self.specification.specs, strict=True)


@dataclass(frozen=True)
class _Writer:
    """Writer of lines as a specification; specs and variables avoid `taken`, the names of objects."""

    profile: str
    taken: set[str]

    def write_lines(self, lines: Sequence[Line], runs: Sequence[LabelledRun]) -> _Written | None:
        """Return the lines that all good runs satisfy and some bad run violates; None if there are none.

        Each line is evaluated as written, with its rounded limit. Without bad runs, the good runs decide.
        """
        if not lines:
            return None
        kept_lines = [
            line for line, spec in zip(lines, self._parse(lines).specs, strict=True) if _is_kept(spec, runs)
        ]
        return _Written(tuple(kept_lines), self._parse(kept_lines)) if kept_lines else None

    def order(self, draft: _Written, bad: Sequence[LabelledRun]) -> _Written:
        """Sort the lines: among lines that the same bad runs violate, shorter lines come first."""
        lines_by_verdicts: dict[tuple[bool, ...], list[Line]] = {}
        verdict_keys = []
        for line, spec in draft.pairs:
            verdict_keys.append(tuple(robustness_of(spec.formula, run.trace)[1] < 0.0 for run in bad))
            lines_by_verdicts.setdefault(verdict_keys[-1], []).append(line)
        for lines in lines_by_verdicts.values():
            lines.sort(key=lambda line: len(line.formula(self.taken).split()))
        lines = [lines_by_verdicts[verdict_key].pop(0) for verdict_key in verdict_keys]
        return _Written(tuple(lines), self._parse(lines))

    def _parse(self, lines: Sequence[Line]) -> Specification:
        used_names: set[str] = set()
        texts = [f"use {self.profile}"]
        for line_number, line in enumerate(lines, 1):
            name = base_name = line.name
            suffix = 2
            while name in used_names or name in self.taken:
                name, suffix = f"{base_name}_{suffix}", suffix + 1
            used_names.add(name)
            title = quote_name(f"LEARNED-{line_number}: {printable(line.title)}")
            texts.append(f"spec {name} {title} = {line.formula(self.taken)}")
        return parse_specification("\n".join([*texts, ""]))

    def text(
        self,
        draft: _Written,
        head_lines: Sequence[str],
        evidence: Sequence[LearnedLine],
        good_count: int,
        bad_count: int,
    ) -> str:
        """Return the text of the file: each spec in canonical form, under a comment with its evidence."""
        lines = [*map(_comment, head_lines), f"use {self.profile}"]
        for spec, line in zip(draft.specification.specs, evidence, strict=True):
            lowest_text = f"lowest robustness {number_text(line.lowest)} in {line.lowest_run}"
            lines += [
                "",
                _comment(f"Holds in {good_count} of {plural(good_count, 'good run')}, {lowest_text}."),
            ]
            if bad_count:
                violating_text = (
                    f"{len(line.violated_by)} of {plural(bad_count, 'bad run')}"
                    f"{_names_text(line.violated_by)}"
                )
                lines.append(_comment(f"Violated by {violating_text}."))
            title = quote_name(f"{spec.id}: {spec.title}")
            lines.append(f"spec {spec.name} {title} = {format_formula(spec.formula)}")
        return "\n".join([*lines, ""])


def _is_kept(spec: NamedSpec, runs: Sequence[LabelledRun]) -> bool:
    """Return whether all good runs satisfy a spec and, if there are bad runs, some bad run violates it."""
    bad = [run for run in runs if not run.is_good]
    return all(robustness_of(spec.formula, run.trace)[0] >= 0.0 for run in runs if run.is_good) and (
        not bad or any(robustness_of(spec.formula, run.trace)[1] < 0.0 for run in bad)
    )


def _comment(text: str) -> str:
    return f"# {printable(text, _LONGEST)}"


def _names_text(names: Sequence[str]) -> str:
    if not names:
        return ""
    more_text = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return f": {', '.join(names[:_MOST_NAMED])}{more_text}"


def _evidence(
    line: Line, spec: NamedSpec, good: Sequence[LabelledRun], bad: Sequence[LabelledRun]
) -> LearnedLine:
    lowest_robustness, run_index = min(
        (robustness_of(spec.formula, run.trace)[0], index) for index, run in enumerate(good)
    )
    violating_names = tuple(run.name for run in bad if robustness_of(spec.formula, run.trace)[1] < 0.0)
    text = format_formula(spec.formula)
    return LearnedLine(
        spec.name,
        spec.title or "",
        text,
        line.pattern,
        lowest_robustness,
        good[run_index].name,
        violating_names,
    )


def _check_folds(
    good: Sequence[LabelledRun],
    bad: Sequence[LabelledRun],
    learn: Callable[[Sequence[LabelledRun]], _Written | None],
) -> Iterator[CheckedRun]:
    """Yield each run with its verdict under the lines that are learned without the run's fold."""
    if len(good) < _FEWEST_SAMPLES:
        return
    fold_count = min(_FOLDS, max(len(good), len(bad)))
    # each fold leaves at least two good runs to learn from
    if len(good) - -(-len(good) // fold_count) < 2:
        fold_count = len(good)
    for fold in range(fold_count):
        test_runs = [*good[fold::fold_count], *bad[fold::fold_count]]
        training_runs = [run for run in (*good, *bad) if not any(run is test_run for test_run in test_runs)]
        draft = learn(training_runs)
        for run in test_runs:
            lower = upper = float("inf")
            for spec in () if draft is None else draft.specification.specs:
                low, high = robustness_of(spec.formula, run.trace)
                lower, upper = min(lower, low), min(upper, high)
            yield CheckedRun(run.name, run.is_good, final_verdict(lower, upper))


def _head(
    good: Sequence[LabelledRun],
    bad: Sequence[LabelledRun],
    missed: Sequence[str],
    checked: Sequence[CheckedRun],
    left_out: Sequence[str],
) -> Iterator[str]:
    runs_text = plural(len(good), "good run") + (f" and {plural(len(bad), 'bad run')}" if bad else "")
    yield f"Learned from {runs_text}."
    if missed:
        verb = "violates" if len(missed) == 1 else "violate"
        yield f"{plural(len(missed), 'bad run')} {verb} none of these lines{_names_text(missed)}."
    if checked:
        yield checked_text(checked)
    else:
        yield "Not checked on runs left out: that takes three good runs."
    for omission in left_out:
        yield f"Not compared: {omission}."


def checked_text(checked: Sequence[CheckedRun]) -> str:
    """Return a sentence with the verdicts of the runs that were left out in turn."""
    phrases = []
    for is_good, verdict_text in ((True, "satisfied"), (False, "violated")):
        runs = [run for run in checked if run.is_good is is_good]
        if runs:
            right_count = sum(run.is_right for run in runs)
            phrases.append(
                f"{right_count} of {len(runs)} {'good' if is_good else 'bad'} runs are {verdict_text}"
            )
    return f"Checked on runs left out in turn: {', '.join(phrases)}."

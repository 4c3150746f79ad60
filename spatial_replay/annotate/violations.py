"""How well objects and regions meet the requirements in each sample, and where the first violation is.

The scene is coloured by the one, and an arrow in it points at the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, permutations
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.annotate.deciding_leaf import LeafPairs, Pair, SettledViolation, pair_of
from spatial_replay.annotate.requirements import ClassMembers, Requirement
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.measure import Operand, contacts
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.stream import Instance, SeriesBlock
from spatial_replay.spec.formula import ANY_CLASS, Formula, Outline, Quantified, TrackedName
from spatial_replay.spec.walks import iter_terms, leaf_key, looks_back, nodes_of, substitute
from spatial_replay.trace.trace import LATEST_NS, Trace

_MOST_BINDINGS: Final = 64
"""If a quantifier binds more, all members have the number of the worst."""

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
        numbers = self.bound.get(name)
        if numbers is None:
            return now
        return np.where((now < 0.0) & ~np.isnan(numbers[at]), numbers[at], now)


class ShadeTracker:
    """Follows the parts of one result's requirements; cutting the samples into blocks changes nothing."""

    def __init__(
        self, instance: Instance, parts: Sequence[Requirement], regions: Mapping[str, Outline]
    ) -> None:
        """Start before the first sample."""
        self._regions = regions
        nodes = nodes_of(instance.formula)
        self._leaves = [
            _separable(substitute(nodes[part.node], instance.bindings), part.sign) for part in parts
        ]
        numbers = {leaf_key(leaf): index for index, leaf in enumerate(instance.program.leaves)}
        self.shades: tuple[Shade, ...] = tuple(
            Shade(part, leaf=-1 if leaf is None else numbers[leaf_key(nodes[part.node])])
            for part, leaf in zip(parts, self._leaves, strict=True)
        )

    def extend(self, trace: Trace, block: SeriesBlock) -> None:
        """Take in the next samples."""
        if len(block.times_ns):
            self.shades = tuple(
                self._extend_shade(shade, leaf, trace, block)
                for shade, leaf in zip(self.shades, self._leaves, strict=True)
            )

    def _extend_shade(self, shade: Shade, leaf: Quantified | None, trace: Trace, block: SeriesBlock) -> Shade:
        part = shade.requirement
        now = part.sign * block.series[part.node, 1]
        determined = now[~np.isnan(now)]
        least = min(shade.least, float(determined.min(initial=math.inf)))
        is_known = shade.is_known and len(determined) == len(now)
        fails = np.flatnonzero(now < 0.0)
        bound: dict[str, Floats] = {}
        bodies, worst = tuple[Formula, ...](), np.full(len(now), -1, np.int64)
        if leaf is not None and len(fails):
            failing = trace.take(np.searchsorted(trace.times_ns, block.times_ns[fails]))
            tuples, bodies, of_fails = _numbers_of(leaf, part.sign, TraceScene(failing, self._regions))
            if bodies:
                is_least = of_fails == now[fails]
                worst[fails] = np.where(is_least.any(axis=0), is_least.argmax(axis=0), -1)
            for names, binding_numbers in zip(tuples, of_fails, strict=True):
                for name in names:
                    numbers = bound.setdefault(name, np.full(len(now), np.nan))
                    numbers[fails] = np.fmin(numbers[fails], binding_numbers)
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
    return (tuples, *_numbers_of_bindings(leaf, sign, scene, tuples)) if tuples else ((), (), none)


def _numbers_of_bindings(
    leaf: Quantified, sign: float, scene: TraceScene, tuples: Sequence[tuple[str, ...]]
) -> tuple[tuple[Formula, ...], Floats]:
    """Return what a quantifier asks of some bindings, at least one, and their numbers (B, T)."""
    bodies = tuple(
        substitute(leaf.body, dict(zip(leaf.variables, map(TrackedName, names), strict=True)))
        for names in tuples
    )
    values = leaf_values(scene, bodies, {})
    low, high = low_and_high(len(values), wide=False)
    return bodies, np.where(values[low] == values[high], sign * values[low], np.nan)


class EvaluatedResult(NamedTuple):
    """One result over some samples, as the scene shows it.

    Attributes:
        requirements: the formula's.
        block: the numbers of nodes and leaves.
        leaf_pairs: what its violations can be traced to; None leaves them out.
        since_ns: (R,), since when each requirement's conjunct is violated for certain (see
            `violated_since`); None for an equal time.
        settled: what settled the violation of the formula, if it is.
        is_final: whether the block is about the finished log.
        shades: the parts of the requirements that objects are coloured by; None for the requirements.
    """

    requirements: tuple[Requirement, ...]
    block: SeriesBlock
    leaf_pairs: LeafPairs | None = None
    since_ns: Integers | None = None
    settled: SettledViolation | None = None
    is_final: bool = False
    shades: tuple[Shade, ...] | None = None


class Presence(NamedTuple):
    """Which objects are in S samples.

    Attributes:
        times_ns: (S,) int64.
        names: the objects' names.
        class_code: (S, len(names)) int64, index into `classes`; -1 where the object is absent.
        classes: class names, or None.
    """

    times_ns: Integers
    names: Sequence[str]
    class_code: Integers
    classes: Sequence[str | None]


class Violations(NamedTuple):
    """The violation to point at in each of S samples, and where it can be pointed at.

    Attributes:
        result: (S,) int64, which of the results it is of; -1 where nothing is violated.
        node: (S,) int64, id of the requirement that is violated, or of the atom that settled the violation.
        leaf: (S,) int64, index of what decides it among the leaves of the result's program; -1 for none.
        is_shown: (S,), whether there are two points to show it between.
        points: (S, 2, 2), a point of the first of the pair and one of the second.
        top: (S,), the upper end of the higher one, NaN if neither has a height.
        robustness: (S,), at most 0: of the requirement, or of the atom that settled the violation; in the
            unit of the log, where `scale` divides the number of the atom.
        holds: (S,), whether the atom holds, where it should not.
        moment_ns: (S,) int64, of which sample the number is; -1 for the sample itself.
        atom: (S,) int64, which of `atoms` decides the leaf, if that is a quantifier; else -1.
        atoms: those, with the objects that a quantifier binds.
    """

    result: Integers
    node: Integers
    leaf: Integers
    is_shown: NDArray[np.bool_]
    points: Floats
    top: Floats
    robustness: Floats
    holds: NDArray[np.bool_]
    moment_ns: Integers
    atom: Integers
    atoms: list[BoundAtom]


class BoundAtom(NamedTuple):
    """An atom of a quantifier with the objects that decide it: in words, and the pair that it relates."""

    text: str
    pair: Pair


def violated_since(requirements: Sequence[Requirement], block: SeriesBlock, before_ns: Integers) -> Integers:
    """Return (R,) since when the conjunct of each requirement is violated for certain, or `LATEST_NS`.

    Args:
        block: the next samples.
        before_ns: the same before them.
    """
    since_ns = before_ns.copy()
    at = np.arange(len(block.times_ns))
    for number in np.flatnonzero(since_ns == LATEST_NS).tolist():
        certain = np.flatnonzero(~requirements[number].conjunct.is_open(block.series, at))
        if len(certain):
            since_ns[number] = block.times_ns[certain[0]]
    return since_ns


def worst_robustness(
    results: Sequence[EvaluatedResult], presence: Presence, regions: Sequence[str]
) -> tuple[Floats, Floats]:
    """Return the least robustness of what is asked of each object and region, in the sign that counts.

    In a conjunction or quantifier, it is the part about the object itself. For a finished log it is the
    outcome of the obligations, otherwise their present state.

    Returns:
        (S, objects) and (S, regions); NaN where no requirement is known.
    """
    objects = np.full(presence.class_code.shape, np.nan)
    places = np.full((len(presence.times_ns), len(regions)), np.nan)
    for result in results:
        of = Requirement.outcome if result.is_final else Requirement.robustness
        shades = tuple(map(Shade, result.requirements)) if result.shades is None else result.shades
        parts = result._replace(requirements=tuple(shade.requirement for shade in shades))
        own_ns = result.block.times_ns
        at = np.minimum(np.searchsorted(own_ns, presence.times_ns), max(len(own_ns) - 1, 0))
        for shade, (requirement, whole) in zip(
            shades, _robustness(parts, presence.times_ns, of), strict=False
        ):
            now = shade.outcome(whole) if result.is_final else whole
            for column in _columns(requirement.objects, presence.names):
                objects[:, column] = np.fmin(objects[:, column], now)
            for column in _columns(requirement.regions, regions):
                places[:, column] = np.fmin(places[:, column], now)
            for group in requirement.groups:
                bound = np.broadcast_to(now[:, None], objects.shape).copy()
                for column, name in enumerate(presence.names):
                    if result.is_final:
                        bound[:, column] = shade.outcome_of(name, now)
                    elif name in shade.bound:
                        bound[:, column] = shade.now_of(name, now, at)
                objects = np.where(_members(group, presence), np.fmin(objects, bound), objects)
    return objects, places


def first_violations(results: Sequence[EvaluatedResult], trace: Trace, samples: Integers) -> Violations:
    """Return the violation to point at in some samples of a trace: of those now, what was certain first.

    It is shown at the atom that gives the requirement its number, between the two points that attain the
    signed distance of its terms. For an enclosure it follows the protrusion. In the sample that settled the
    formula's violation that is the atom that settled it. A requirement with a deadline or in response to a
    condition keeps its arrow afterwards, between the places and with the number that settled it. Conditions
    of implications are not pointed at: those hold, and what had to follow does not.

    Args:
        samples: (S,) int64, indices.
    """
    times_ns = trace.times_ns[samples]
    which, requirement, robustness = _first(results, times_ns)
    violations = Violations(
        result=which,
        node=np.full(len(samples), -1, np.int64),
        leaf=np.full(len(samples), -1, np.int64),
        is_shown=np.zeros(len(samples), np.bool_),
        points=np.full((len(samples), 2, 2), np.nan),
        top=np.full(len(samples), np.nan),
        robustness=robustness,
        holds=np.zeros(len(samples), np.bool_),
        moment_ns=np.full(len(samples), -1, np.int64),
        atom=np.full(len(samples), -1, np.int64),
        atoms=[],
    )
    for index, result in enumerate(results):
        places = np.flatnonzero(which == index)
        if result.leaf_pairs is not None and len(places):
            nodes = np.array([demand.node for demand in result.requirements], np.int64)
            violations.node[places] = nodes[requirement[places]]
            at = np.searchsorted(result.block.times_ns, times_ns[places])
            violations.leaf[places], violations.holds[places] = _deciding(
                result, result.leaf_pairs, requirement[places], at
            )
            _point_at_settling_leaf(result, times_ns, places, violations)
            leaf = violations.leaf[places]
            located = places[leaf >= 0]
            violations.robustness[located] *= result.leaf_pairs.divisors[leaf[leaf >= 0]]
            _locate(result, trace, samples, places, violations)
    return violations


def _shows_settling_leaf(result: EvaluatedResult, times_ns: Integers) -> NDArray[np.bool_]:
    """Return (S,), in which samples a result is pointed at by what settled its violation.

    That is the sample that settled it and, if the atom is not asked of every sample, all after it.
    """
    settled = result.settled
    if result.leaf_pairs is None or settled is None or settled.shown is None:
        return np.zeros(len(times_ns), np.bool_)
    within = _requirement_of(result, settled.shown.node)
    if within is None:
        return np.zeros(len(times_ns), np.bool_)
    is_after = times_ns >= settled.time_ns
    return np.asarray(times_ns == settled.time_ns) if within.is_invariant else is_after


def _requirement_of(result: EvaluatedResult, node: int) -> Requirement | None:
    """Return the requirement that a leaf is in."""
    within = [requirement for requirement in result.requirements if requirement.node <= node]
    return within[-1] if within else None


def _point_at_settling_leaf(
    result: EvaluatedResult, times_ns: Integers, places: Integers, violations: Violations
) -> None:
    """Name the leaf that settled the violation, where that is what is pointed at."""
    if result.settled is None:
        return
    violations.leaf[places[times_ns[places] == result.settled.time_ns]] = -1
    leaf = result.settled.shown
    settled_places = places[_shows_settling_leaf(result, times_ns[places])]
    if leaf is None or not len(settled_places):
        return
    violations.leaf[settled_places], violations.node[settled_places] = leaf.leaf, leaf.node
    violations.robustness[settled_places] = -abs(leaf.number)
    violations.holds[settled_places] = leaf.number > 0.0
    violations.moment_ns[settled_places] = np.where(
        times_ns[settled_places] == leaf.time_ns, -1, leaf.time_ns
    )


def _robustness(
    result: EvaluatedResult,
    times_ns: Integers,
    of: Callable[[Requirement, Floats, Integers], Floats] = Requirement.robustness,
) -> Iterator[tuple[Requirement, Floats]]:
    """Yield each requirement with its robustness (S,) at some times; NaN where it is not evaluated."""
    own_ns = result.block.times_ns
    if not len(own_ns):
        return
    at = np.minimum(np.searchsorted(own_ns, times_ns), len(own_ns) - 1)
    is_evaluated = own_ns[at] == times_ns
    for requirement in result.requirements:
        numbers = of(requirement, result.block.series, at)
        yield requirement, np.where(is_evaluated, numbers, np.nan)


def _first(results: Sequence[EvaluatedResult], times_ns: Integers) -> tuple[Integers, Integers, Floats]:
    """Return (S,) the first violation at each time: the result, the place of its requirement, its robustness.

    A requirement of -inf is passed over: it has no members to satisfy it, and so no place in the scene.
    """
    which, place = np.full(len(times_ns), -1, np.int64), np.full(len(times_ns), -1, np.int64)
    violated = np.full(len(times_ns), np.nan)
    earliest = np.full(len(times_ns), LATEST_NS)
    for index, result in enumerate(results):
        if result.leaf_pairs is None:
            continue
        since_ns = (
            np.zeros(len(result.requirements), np.int64) if result.since_ns is None else result.since_ns
        )
        is_over = np.zeros(len(times_ns), np.bool_)
        if result.settled is not None:
            is_over = times_ns >= result.settled.time_ns
        for number, (requirement, now) in enumerate(_robustness(result, times_ns)):
            if requirement.is_condition:
                continue
            is_first = (now < 0.0) & (now > -np.inf) & (since_ns[number] < earliest)
            if not requirement.is_invariant:
                is_first &= ~is_over
            which[is_first], place[is_first], violated[is_first] = index, number, now[is_first]
            earliest[is_first] = since_ns[number]
        if result.settled is not None and result.settled.shown is not None:
            # what settled a violation may be a goal whose time is over
            is_first = _shows_settling_leaf(result, times_ns) & (result.settled.time_ns < earliest)
            which[is_first], violated[is_first] = index, -abs(result.settled.shown.number)
            earliest[is_first] = result.settled.time_ns
    return which, place, violated


def _deciding(
    result: EvaluatedResult, pairs: LeafPairs, requirement: Integers, at: Integers
) -> tuple[Integers, NDArray[np.bool_]]:
    """Return (H,) the leaf that gives a requirement (H,) its number in a sample (H,), -1 for none. Also
    return whether that leaf is negated, so that it holds where the requirement fails."""
    leaf, is_turned = np.full(len(at), -1, np.int64), np.zeros(len(at), np.bool_)
    leaves = result.block.leaves
    low, high = low_and_high(len(leaves), wide=False)
    for number in np.unique(requirement[requirement >= 0]).tolist():
        samples = np.flatnonzero(requirement == number)
        below, demand = pairs.below[number], result.requirements[number]
        if not len(below.indices):
            continue  # a constant
        places = below.indices[:, None], at[samples][None, :]
        lows, highs = leaves[low][places], leaves[high][places]
        now = result.block.series[demand.node, 1, at[samples]]
        is_hit = (lows == highs) & (lows * below.signs[:, None] == now)
        first = is_hit.argmax(axis=0)
        leaf[samples] = np.where(is_hit.any(axis=0), below.indices[first], -1)
        is_turned[samples] = demand.sign * below.signs[first] < 0.0
    return leaf, is_turned


def _locate(
    result: EvaluatedResult, trace: Trace, samples: Integers, places: Integers, violations: Violations
) -> None:
    """Fill in the points at `places` (H,), whose leaves are given, and the atoms of quantifiers."""
    if result.leaf_pairs is None:
        return
    is_past = violations.moment_ns[places] >= 0
    _point_at_past(result, result.leaf_pairs, places[is_past], violations)
    places = places[(violations.leaf[places] >= 0) & ~is_past]
    if not len(places):
        return
    # of all samples, these are often few
    leaf, scene = violations.leaf[places], TraceScene(trace.take(samples[places]), result.leaf_pairs.regions)
    for index in np.unique(leaf).tolist():
        with_leaf = np.flatnonzero(leaf == index)
        pair = result.leaf_pairs.pairs[index]
        if pair is not None:
            _point_at(scene, pair, with_leaf, places[with_leaf], violations)
        for body, members in _iter_deciding(result, result.leaf_pairs, index, scene, with_leaf):
            of_body = pair_of(body)
            deciding_places = with_leaf[members]
            if of_body is not None and len(deciding_places):
                violations.atom[places[deciding_places]] = len(violations.atoms)
                violations.atoms.append(BoundAtom(result.leaf_pairs.text_of(body), of_body))
                _point_at(scene, of_body, deciding_places, places[deciding_places], violations)


def _point_at_past(
    result: EvaluatedResult, pairs: LeafPairs, places: Integers, violations: Violations
) -> None:
    """Point at what settled a violation in an earlier sample, where it stood then."""
    settled = result.settled
    pair = None if settled is None or settled.atom is None else pair_of(settled.atom)
    if not len(places) or settled is None or settled.atom is None or settled.sample is None or pair is None:
        return
    violations.atom[places] = len(violations.atoms)
    violations.atoms.append(BoundAtom(pairs.text_of(settled.atom), pair))
    _point_at(TraceScene(settled.sample, pairs.regions), pair, np.zeros(1, np.int64), places[:1], violations)
    for column in (violations.points, violations.top, violations.is_shown):
        column[places] = column[places[0]]


def _iter_deciding(
    result: EvaluatedResult, pairs: LeafPairs, leaf: int, scene: TraceScene, samples: Integers
) -> Iterator[tuple[Formula, Integers]]:
    """Yield what a quantifier asks of the objects that decide it, and at which of some samples (k,)."""
    shades = [shade for shade in result.shades or () if shade.leaf == leaf]
    if not shades:
        return
    if not shades[0].bodies:
        yield from _iter_worst(pairs.leaves[leaf], shades[0].requirement.sign, scene, samples)
        return
    # of the finished log there is the last sample alone
    at = np.searchsorted(result.block.times_ns, scene.trace.times_ns[samples]) - (
        len(result.block.times_ns) if result.is_final else 0
    )
    worst = shades[0].worst[at]
    for which in np.unique(worst[worst >= 0]).tolist():
        yield shades[0].bodies[which], np.flatnonzero(worst == which)


def _iter_worst(
    leaf: Formula, sign: float, scene: TraceScene, samples: Integers
) -> Iterator[tuple[Formula, Integers]]:
    """Yield what a quantifier with many bindings asks of those with the least number, as `_iter_deciding`."""
    if not isinstance(leaf, Quantified):
        return
    part_scene = TraceScene(scene.trace.take(samples), scene.regions)
    tuples = permutations(part_scene.candidates(leaf.group), len(leaf.variables))
    least, bodies = np.full(len(samples), np.inf), dict[int, Formula]()
    worst = np.full(len(samples), -1, np.int64)
    begin = 0
    while some := list(islice(tuples, _MOST_BINDINGS)):
        of_some, numbers = _numbers_of_bindings(leaf, sign, part_scene, some)
        numbers = np.where(np.isnan(numbers), np.inf, numbers)
        is_less = numbers.min(axis=0) < least
        worst[is_less] = begin + numbers.argmin(axis=0)[is_less]
        least = np.minimum(least, numbers.min(axis=0))
        bodies |= {begin + place: of_some[place] for place in set((worst[is_less] - begin).tolist())}
        begin += len(some)
    for which in np.unique(worst[worst >= 0]).tolist():
        yield bodies[which], np.flatnonzero(worst == which)


def _point_at(
    scene: TraceScene, pair: Pair, samples: Integers, places: Integers, violations: Violations
) -> None:
    """Fill in the points of some samples of a scene, those of the violations at `places`."""
    operands = [scene.resolve(term).operand for term in (pair.first, pair.second)]
    first, second = (Operand(operand.rows[samples], operand.enlargement) for operand in operands)
    numbers = contacts(scene.batch, first, second, is_protrusion=pair.is_protrusion)
    violations.points[places] = numbers[:, :4].reshape(-1, 2, 2)
    violations.top[places] = numbers[:, 5]
    violations.is_shown[places] = np.isfinite(numbers[:, :5]).all(axis=1)


def _columns(chosen: frozenset[str], names: Sequence[str]) -> list[int]:
    return [column for column, name in enumerate(names) if name in chosen]


def _members(group: ClassMembers, presence: Presence) -> NDArray[np.bool_]:
    """Return (S, objects), which objects belong to an open group in each sample."""
    fits = [group.class_name in (ANY_CLASS, (name or "").casefold()) for name in presence.classes]
    included = np.array([name not in group.excluded for name in presence.names], np.bool_)
    # absent objects have the code -1, and so the last entry
    return np.array([*fits, False], np.bool_)[presence.class_code] & included

"""The robustness of objects and regions in each sample, and the position of the first violation.

Robustness gives the colours of the scene, and the position gives its arrow.
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
"""Limit of bindings with numbers of their own; beyond it, all members get the number of the worst."""

_NO_NUMBERS: Final[Mapping[str, Floats]] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Shade:
    """A part of a requirement that objects are coloured by, with numbers times the part's sign.

    Attributes:
        requirement: the part.
        bound: number (T,) of each object that the part's quantifier binds, in the samples of a block; NaN
            where the part holds.
        least: least number of the part so far.
        is_known: whether the part was known in all samples.
        least_bound: least number of each bound object so far.
        leaf: index of the quantifier among the program's leaves; -1 for another part.
        bodies: the quantifier's body for each of its bindings.
        worst: (T,), index of the deciding body in each sample of the block; -1 where the part holds.
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
        """Return (S,), the part's outcome over a finished log.

        Args:
            whole: (S,), outcome of the part's obligation.
        """
        if not self.requirement.is_invariant or not (whole < 0.0).any():
            return whole
        number = self.least if self.is_known or self.least < 0.0 else math.nan
        return np.where(whole < 0.0, number, whole)

    def outcome_of(self, name: str, part: Floats) -> Floats:
        """Return (S,), the outcome of a bound object over a finished log.

        Args:
            part: (S,), outcome of the part.
        """
        if not self.requirement.is_invariant or not self.least_bound:
            return part
        # only failing samples have numbers: without one the object never failed, and held by at least 0
        number = self.least_bound.get(name, 0.0)
        return np.where(part < 0.0, number, part)

    def now_of(self, name: str, now: Floats, at: Sequence[int] | np.ndarray) -> Floats:
        """Return (S,), the present number of a bound object.

        Args:
            now: (S,), present numbers of the part, for samples in which the object has no number.
            at: (S,) indices of samples in the block.
        """
        numbers = self.bound.get(name)
        if numbers is None:
            return now
        return np.where((now < 0.0) & ~np.isnan(numbers[at]), numbers[at], now)


class ShadeTracker:
    """Follows the parts of one result's requirements. The cut of samples into blocks does not count."""

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
        """Add the next samples."""
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
                # exactly equal, because the quantifier's number is the least of these numbers
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
    """Return a leaf if it is a quantifier that needs all its bindings within one sample; else None."""
    if not isinstance(leaf, Quantified) or leaf.quantifier != ("forall" if sign > 0.0 else "exists"):
        return None
    return None if any(map(looks_back, iter_terms([leaf]))) else leaf


def _numbers_of(
    leaf: Quantified, sign: float, scene: TraceScene
) -> tuple[Sequence[tuple[str, ...]], tuple[Formula, ...], Floats]:
    """Return the bindings of a quantifier, its body for each binding, and their numbers (B, T).

    All three are empty for more than `_MOST_BINDINGS` bindings.
    """
    names, none = scene.candidates(leaf.group), np.empty((0, len(scene.trace)))
    if math.perm(len(names), len(leaf.variables)) > _MOST_BINDINGS:
        return (), (), none
    tuples = list(permutations(names, len(leaf.variables)))
    return (tuples, *_numbers_of_bindings(leaf, sign, scene, tuples)) if tuples else ((), (), none)


def _numbers_of_bindings(
    leaf: Quantified, sign: float, scene: TraceScene, tuples: Sequence[tuple[str, ...]]
) -> tuple[tuple[Formula, ...], Floats]:
    """Return a quantifier's body for each of at least one binding, and the numbers (B, T) of these."""
    bodies = tuple(
        substitute(leaf.body, dict(zip(leaf.variables, map(TrackedName, names), strict=True)))
        for names in tuples
    )
    values = leaf_values(scene, bodies, {})
    low, high = low_and_high(len(values), wide=False)
    return bodies, np.where(values[low] == values[high], sign * values[low], np.nan)


class EvaluatedResult(NamedTuple):
    """The numbers of one result over some samples, for the scene.

    Attributes:
        requirements: requirements of the formula.
        block: numbers of nodes and leaves.
        leaf_pairs: pairs that an arrow can point at; None for a result without arrows.
        since_ns: (R,), start of the certain violation of each requirement's conjunct (see `violated_since`);
            None for equal times.
        settled: the formula's violation that is certain before the end, or None.
        is_final: whether the block is the last sample with intervals over the finished log.
        shades: parts of the requirements that objects are coloured by; None for the requirements themselves.
    """

    requirements: tuple[Requirement, ...]
    block: SeriesBlock
    leaf_pairs: LeafPairs | None = None
    since_ns: Integers | None = None
    settled: SettledViolation | None = None
    is_final: bool = False
    shades: tuple[Shade, ...] | None = None


class Presence(NamedTuple):
    """The presence of objects in S samples.

    Attributes:
        times_ns: (S,) int64, times of the samples.
        names: names of the objects.
        class_code: (S, len(names)) int64, index into `classes`; -1 where the object is absent.
        classes: class names, or None.
    """

    times_ns: Integers
    names: Sequence[str]
    class_code: Integers
    classes: Sequence[str | None]


class Violations(NamedTuple):
    """The violation with the arrow in each of S samples, and the ends of the arrow.

    Attributes:
        result: (S,) int64, index of the result; -1 without a violation.
        node: (S,) int64, id of the violated requirement, or of the atom that settled the violation.
        leaf: (S,) int64, index of the deciding leaf in the result's program; -1 for none.
        is_shown: (S,), whether the arrow has two ends.
        points: (S, 2, 2), ends of the arrow on the first and on the second object or region of the pair.
        top: (S,), upper end of the higher one of both; NaN if neither has a height.
        robustness: (S,), at most 0, of the requirement or of the settling atom. It is in the unit of the log:
            a division by `scale` is undone.
        holds: (S,), whether the atom holds but must not.
        moment_ns: (S,) int64, time of the sample of the number; -1 for the sample itself.
        atom: (S,) int64, index in `atoms` of the atom that decides a quantifier; else -1.
        atoms: atoms of quantifiers with their bound objects.
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
    """An atom of a quantifier with its deciding objects: its text, and the pair that it relates."""

    text: str
    pair: Pair


def violated_since(requirements: Sequence[Requirement], block: SeriesBlock, before_ns: Integers) -> Integers:
    """Return (R,), the start of the certain violation of each requirement's conjunct, or `LATEST_NS`.

    Args:
        block: the next samples.
        before_ns: (R,), the result for all earlier samples.
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
    """Return the least robustness of the requirements on each object and region, times their signs.

    From a conjunction or quantifier, only the part about the object itself counts. The numbers are outcomes
    of obligations for a finished log, and present numbers otherwise.

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
    """Return the violation with the arrow in some samples of a trace.

    Among the violations in a sample, it is the one that was certain first.

    The arrow is at the deciding atom of the requirement, between the two points that attain the signed
    distance of its terms, or along the protrusion of an enclosure. In the sample that settled the formula's
    violation, the arrow is at the settling atom. A requirement with a deadline or in response to a condition
    keeps the arrow, its ends and its number after that sample. Conditions of implications have no arrow,
    because the missing response is the fault.

    Args:
        samples: (S,) int64, indices of samples.
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
    """Return (S,), whether the arrow of a result is at the leaf that settled its violation.

    It is in the sample that settled the violation. If the atom is not an invariant, it is in all later
    samples, too.
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
    """Return the requirement that contains a node; requirements are in the order of their ids."""
    within = [requirement for requirement in result.requirements if requirement.node <= node]
    return within[-1] if within else None


def _point_at_settling_leaf(
    result: EvaluatedResult, times_ns: Integers, places: Integers, violations: Violations
) -> None:
    """Put the arrow at the leaf that settled the violation, in samples of `_shows_settling_leaf`."""
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
    """Yield each requirement with its robustness (S,) at some times; NaN at times without evaluation."""
    own_ns = result.block.times_ns
    if not len(own_ns):
        return
    at = np.minimum(np.searchsorted(own_ns, times_ns), len(own_ns) - 1)
    is_evaluated = own_ns[at] == times_ns
    for requirement in result.requirements:
        numbers = of(requirement, result.block.series, at)
        yield requirement, np.where(is_evaluated, numbers, np.nan)


def _first(results: Sequence[EvaluatedResult], times_ns: Integers) -> tuple[Integers, Integers, Floats]:
    """Return (S,) indices of results, (S,) indices of requirements and (S,) robustness of first violations.

    A requirement with robustness -inf is skipped: no object can fulfil it, so the arrow would have no ends.
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
            # a goal after its deadline may have settled the violation
            is_first = _shows_settling_leaf(result, times_ns) & (result.settled.time_ns < earliest)
            which[is_first], violated[is_first] = index, -abs(result.settled.shown.number)
            earliest[is_first] = result.settled.time_ns
    return which, place, violated


def _deciding(
    result: EvaluatedResult, pairs: LeafPairs, requirement: Integers, at: Integers
) -> tuple[Integers, NDArray[np.bool_]]:
    """Return (H,) deciding leaves of requirements (H,) in samples (H,), and whether each leaf is negated.

    A leaf is -1 if no leaf has the requirement's number. A negated leaf holds if its requirement fails.
    """
    leaf, is_turned = np.full(len(at), -1, np.int64), np.zeros(len(at), np.bool_)
    leaves = result.block.leaves
    low, high = low_and_high(len(leaves), wide=False)
    for number in np.unique(requirement[requirement >= 0]).tolist():
        samples = np.flatnonzero(requirement == number)
        below, demand = pairs.below[number], result.requirements[number]
        if not len(below.indices):
            continue  # a constant formula has no leaves
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
    """Set the ends of arrows and the atoms of quantifiers at `places` (H,), whose leaves are set."""
    if result.leaf_pairs is None:
        return
    is_past = violations.moment_ns[places] >= 0
    _point_at_past(result, result.leaf_pairs, places[is_past], violations)
    places = places[(violations.leaf[places] >= 0) & ~is_past]
    if not len(places):
        return
    # a trace of only these samples, which are often few, is faster to measure
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
    """Set the arrow at the leaf that settled a violation in an earlier sample, with the ends at that time."""
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
    """Yield a quantifier's body for each deciding binding, with the indices (k,) in `samples`."""
    shades = [shade for shade in result.shades or () if shade.leaf == leaf]
    if not shades:
        return
    if not shades[0].bodies:
        yield from _iter_worst(pairs.leaves[leaf], shades[0].requirement.sign, scene, samples)
        return
    # the shades are of the last block, but a final block has only its last sample
    at = np.searchsorted(result.block.times_ns, scene.trace.times_ns[samples]) - (
        len(result.block.times_ns) if result.is_final else 0
    )
    worst = shades[0].worst[at]
    for which in np.unique(worst[worst >= 0]).tolist():
        yield shades[0].bodies[which], np.flatnonzero(worst == which)


def _iter_worst(
    leaf: Formula, sign: float, scene: TraceScene, samples: Integers
) -> Iterator[tuple[Formula, Integers]]:
    """Yield the bodies of deciding bindings for a quantifier with many bindings; see `_iter_deciding`.

    A binding decides in the samples in which its number is the least.
    """
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
    """Set the ends of the arrows at `places`, measured between the pair in some samples of a scene."""
    operands = [scene.resolve(term).operand for term in (pair.first, pair.second)]
    first, second = (Operand(operand.rows[samples], operand.enlargement) for operand in operands)
    numbers = contacts(scene.batch, first, second, is_protrusion=pair.is_protrusion)
    violations.points[places] = numbers[:, :4].reshape(-1, 2, 2)
    violations.top[places] = numbers[:, 5]
    violations.is_shown[places] = np.isfinite(numbers[:, :5]).all(axis=1)


def _columns(chosen: frozenset[str], names: Sequence[str]) -> list[int]:
    return [column for column, name in enumerate(names) if name in chosen]


def _members(group: ClassMembers, presence: Presence) -> NDArray[np.bool_]:
    """Return (S, objects), whether each object belongs to an open group in each sample."""
    fits = [group.class_name in (ANY_CLASS, (name or "").casefold()) for name in presence.classes]
    included = np.array([name not in group.excluded for name in presence.names], np.bool_)
    # the class code -1 of absent objects indexes the last entry
    return np.array([*fits, False], np.bool_)[presence.class_code] & included

"""The robustness of objects and regions in each sample, and the position of the first violation.

Robustness gives the colours of the scene, and the position gives the arrow.
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
"""Limit of a quantifier's bindings; above the limit, all bound objects have the worst number."""

_NO_NUMBERS: Final[Mapping[str, Floats]] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Shade:
    """A part of a requirement that colours objects. Its numbers are multiplied by the part's sign.

    Attributes:
        requirement: the part.
        bound: numbers (T,) of each object that the part's quantifier binds; NaN where the part holds.
        least: least number of the part so far.
        is_known: whether the part was known in all samples.
        least_bound: least number of each bound object so far.
        leaf: index of the quantifier among the program's leaves; -1 for another part.
        bodies: the quantifier's body for each binding.
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
        # only failing samples have numbers, so an object without a number held by at least 0
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
    """Follows the parts of one result's requirements, for any cut of samples into blocks."""

    def __init__(
        self, instance: Instance, parts: Sequence[Requirement], regions: Mapping[str, Outline]
    ) -> None:
        """Start before the first sample."""
        self._regions = regions
        nodes = nodes_of(instance.formula)
        self._leaves = [
            _separable(substitute(nodes[part.node], instance.bindings), part.sign) for part in parts
        ]
        leaf_indices = {leaf_key(leaf): index for index, leaf in enumerate(instance.program.leaves)}
        self.shades: tuple[Shade, ...] = tuple(
            Shade(part, leaf=-1 if leaf is None else leaf_indices[leaf_key(nodes[part.node])])
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
        numbers_now = part.sign * block.series[part.node, 1]
        known_numbers = numbers_now[~np.isnan(numbers_now)]
        least_number = min(shade.least, float(known_numbers.min(initial=math.inf)))
        is_known = shade.is_known and len(known_numbers) == len(numbers_now)
        failing_samples = np.flatnonzero(numbers_now < 0.0)
        numbers_by_object: dict[str, Floats] = {}
        bodies, worst_bodies = tuple[Formula, ...](), np.full(len(numbers_now), -1, np.int64)
        if leaf is not None and len(failing_samples):
            failing_trace = trace.take(np.searchsorted(trace.times_ns, block.times_ns[failing_samples]))
            bindings, bodies, failing_numbers = _numbers_of(
                leaf, part.sign, TraceScene(failing_trace, self._regions)
            )
            if bodies:
                # exactly equal, because the quantifier's number is the least of these numbers
                is_least = failing_numbers == numbers_now[failing_samples]
                worst_bodies[failing_samples] = np.where(is_least.any(axis=0), is_least.argmax(axis=0), -1)
            for object_names, binding_numbers in zip(bindings, failing_numbers, strict=True):
                for name in object_names:
                    object_numbers = numbers_by_object.setdefault(name, np.full(len(numbers_now), np.nan))
                    object_numbers[failing_samples] = np.fmin(
                        object_numbers[failing_samples], binding_numbers
                    )
        least_bound = dict(shade.least_bound)
        for name, object_numbers in numbers_by_object.items():
            least_bound[name] = float(np.fmin.reduce(object_numbers, initial=least_bound.get(name, math.inf)))
        return Shade(
            part, numbers_by_object, least_number, is_known, least_bound, shade.leaf, bodies, worst_bodies
        )


def _separable(leaf: Formula, sign: float) -> Quantified | None:
    """Return a leaf if it is a quantifier that needs all its bindings within one sample; else None."""
    if not isinstance(leaf, Quantified) or leaf.quantifier != ("forall" if sign > 0.0 else "exists"):
        return None
    return None if any(map(looks_back, iter_terms([leaf]))) else leaf


def _numbers_of(
    leaf: Quantified, sign: float, scene: TraceScene
) -> tuple[Sequence[tuple[str, ...]], tuple[Formula, ...], Floats]:
    """Return the bindings of a quantifier, the body for each binding, and the bodies' numbers (B, T).

    All three are empty for more than `_MOST_BINDINGS` bindings.
    """
    names, no_numbers = scene.candidates(leaf.group), np.empty((0, len(scene.trace)))
    if math.perm(len(names), len(leaf.variables)) > _MOST_BINDINGS:
        return (), (), no_numbers
    bindings = list(permutations(names, len(leaf.variables)))
    return (
        (bindings, *_numbers_of_bindings(leaf, sign, scene, bindings)) if bindings else ((), (), no_numbers)
    )


def _numbers_of_bindings(
    leaf: Quantified, sign: float, scene: TraceScene, bindings: Sequence[tuple[str, ...]]
) -> tuple[tuple[Formula, ...], Floats]:
    """Return a quantifier's body for each of B bindings, and the bodies' numbers (B, T); B is at least 1."""
    bodies = tuple(
        substitute(leaf.body, dict(zip(leaf.variables, map(TrackedName, names), strict=True)))
        for names in bindings
    )
    values = leaf_values(scene, bodies, {})
    low_channel, high_channel = low_and_high(len(values), wide=False)
    return bodies, np.where(values[low_channel] == values[high_channel], sign * values[low_channel], np.nan)


class EvaluatedResult(NamedTuple):
    """The numbers of one result over some samples, for the scene.

    Attributes:
        requirements: requirements of the formula.
        block: numbers of nodes and leaves.
        leaf_pairs: pairs that an arrow can point at; None for a result without arrows.
        since_ns: (R,), start of each conjunct's certain violation, by requirement (see `violated_since`);
            None if all conjuncts have the same start.
        settled: the formula's violation, if it is certain before the end of the log; else None.
        is_final: whether the block is the last sample with intervals over the finished log.
        shades: parts of the requirements that colour objects; None if whole requirements colour objects.
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
    """For each of S samples, the violation that has the arrow, and the ends of the arrow.

    Attributes:
        result: (S,) int64, index of the result; -1 without a violation.
        node: (S,) int64, id of the violated requirement, or of the atom that settled the violation.
        leaf: (S,) int64, index of the deciding leaf in the result's program; -1 for none.
        is_shown: (S,), whether the arrow has two ends.
        points: (S, 2, 2), ends of the arrow on the first and on the second object or region of the pair.
        top: (S,), upper end of the pair's higher member; NaN if neither member has a height.
        robustness: (S,), robustness of the requirement or of the settling atom, at most 0, in the unit of the
            log: a division by `scale` is undone.
        holds: (S,), whether the atom holds but must not.
        moment_ns: (S,) int64, time of the earlier sample that has this robustness; -1 if the sample itself
            has this robustness.
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
    """An atom of a quantifier with its deciding objects: the atom's text and pair of terms."""

    text: str
    pair: Pair


def violated_since(requirements: Sequence[Requirement], block: SeriesBlock, before_ns: Integers) -> Integers:
    """Return (R,), the start of each conjunct's certain violation, by requirement, or `LATEST_NS`.

    Args:
        block: the next samples.
        before_ns: (R,), the result for all earlier samples.
    """
    since_ns = before_ns.copy()
    samples = np.arange(len(block.times_ns))
    for requirement_index in np.flatnonzero(since_ns == LATEST_NS).tolist():
        violated_samples = np.flatnonzero(
            ~requirements[requirement_index].conjunct.is_open(block.series, samples)
        )
        if len(violated_samples):
            since_ns[requirement_index] = block.times_ns[violated_samples[0]]
    return since_ns


def worst_robustness(
    results: Sequence[EvaluatedResult], presence: Presence, regions: Sequence[str]
) -> tuple[Floats, Floats]:
    """Return the least robustness of the requirements on each object and region, times their signs.

    For a conjunction or quantifier, only the part about the object itself is used. For a finished log, the
    robustness is the outcome of the obligation. Otherwise, it is the robustness in the sample.

    Returns:
        (S, objects) and (S, regions); NaN where no requirement is known.
    """
    object_robustness = np.full(presence.class_code.shape, np.nan)
    region_robustness = np.full((len(presence.times_ns), len(regions)), np.nan)
    for result in results:
        robustness_of = Requirement.outcome if result.is_final else Requirement.robustness
        shades = tuple(map(Shade, result.requirements)) if result.shades is None else result.shades
        shaded_result = result._replace(requirements=tuple(shade.requirement for shade in shades))
        block_times_ns = result.block.times_ns
        block_samples = np.minimum(
            np.searchsorted(block_times_ns, presence.times_ns), max(len(block_times_ns) - 1, 0)
        )
        for shade, (requirement, part_numbers) in zip(
            shades, _robustness(shaded_result, presence.times_ns, robustness_of), strict=False
        ):
            numbers = shade.outcome(part_numbers) if result.is_final else part_numbers
            for column in _columns(requirement.objects, presence.names):
                object_robustness[:, column] = np.fmin(object_robustness[:, column], numbers)
            for column in _columns(requirement.regions, regions):
                region_robustness[:, column] = np.fmin(region_robustness[:, column], numbers)
            for group in requirement.groups:
                member_numbers = np.broadcast_to(numbers[:, None], object_robustness.shape).copy()
                for column, name in enumerate(presence.names):
                    if result.is_final:
                        member_numbers[:, column] = shade.outcome_of(name, numbers)
                    elif name in shade.bound:
                        member_numbers[:, column] = shade.now_of(name, numbers, block_samples)
                object_robustness = np.where(
                    _members(group, presence), np.fmin(object_robustness, member_numbers), object_robustness
                )
    return object_robustness, region_robustness


def first_violations(results: Sequence[EvaluatedResult], trace: Trace, samples: Integers) -> Violations:
    """Return the violation that has the arrow, for some samples of a trace.

    Among the violations in a sample, the violation that was certain first has the arrow.

    The arrow is at the requirement's deciding atom. It joins the two points that attain the terms' signed
    distance, or shows the protrusion of an enclosure. In the sample that settled the formula's
    violation, the arrow is at the settling atom. If the requirement has a deadline or is a response, this
    arrow stays in all later samples. Conditions of implications have no arrow, because the missing response
    is the fault.

    Args:
        samples: (S,) int64, indices of samples.
    """
    times_ns = trace.times_ns[samples]
    result_indices, requirement_indices, robustness = _first(results, times_ns)
    violations = Violations(
        result=result_indices,
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
        positions = np.flatnonzero(result_indices == index)
        if result.leaf_pairs is not None and len(positions):
            requirement_nodes = np.array([requirement.node for requirement in result.requirements], np.int64)
            violations.node[positions] = requirement_nodes[requirement_indices[positions]]
            block_samples = np.searchsorted(result.block.times_ns, times_ns[positions])
            violations.leaf[positions], violations.holds[positions] = _deciding(
                result, result.leaf_pairs, requirement_indices[positions], block_samples
            )
            _point_at_settling_leaf(result, times_ns, positions, violations)
            leaf_indices = violations.leaf[positions]
            located_positions = positions[leaf_indices >= 0]
            violations.robustness[located_positions] *= result.leaf_pairs.divisors[
                leaf_indices[leaf_indices >= 0]
            ]
            _locate(result, trace, samples, positions, violations)
    return violations


def _shows_settling_leaf(result: EvaluatedResult, times_ns: Integers) -> NDArray[np.bool_]:
    """Return (S,), whether the arrow of a result is at the leaf that settled its violation.

    The arrow is at that leaf in the sample that settled the violation. If the requirement is not an
    invariant, the arrow stays there in all later samples.
    """
    settled = result.settled
    if result.leaf_pairs is None or settled is None or settled.shown is None:
        return np.zeros(len(times_ns), np.bool_)
    requirement = _requirement_of(result, settled.shown.node)
    if requirement is None:
        return np.zeros(len(times_ns), np.bool_)
    is_after = times_ns >= settled.time_ns
    return np.asarray(times_ns == settled.time_ns) if requirement.is_invariant else is_after


def _requirement_of(result: EvaluatedResult, node: int) -> Requirement | None:
    """Return the requirement that contains a node; the requirements are sorted by node id."""
    candidates = [requirement for requirement in result.requirements if requirement.node <= node]
    return candidates[-1] if candidates else None


def _point_at_settling_leaf(
    result: EvaluatedResult, times_ns: Integers, positions: Integers, violations: Violations
) -> None:
    """Put the arrow at the leaf that settled the violation, in samples of `_shows_settling_leaf`."""
    if result.settled is None:
        return
    violations.leaf[positions[times_ns[positions] == result.settled.time_ns]] = -1
    leaf = result.settled.shown
    settled_positions = positions[_shows_settling_leaf(result, times_ns[positions])]
    if leaf is None or not len(settled_positions):
        return
    violations.leaf[settled_positions], violations.node[settled_positions] = leaf.leaf, leaf.node
    violations.robustness[settled_positions] = -abs(leaf.number)
    violations.holds[settled_positions] = leaf.number > 0.0
    violations.moment_ns[settled_positions] = np.where(
        times_ns[settled_positions] == leaf.time_ns, -1, leaf.time_ns
    )


def _robustness(
    result: EvaluatedResult,
    times_ns: Integers,
    robustness_of: Callable[[Requirement, Floats, Integers], Floats] = Requirement.robustness,
) -> Iterator[tuple[Requirement, Floats]]:
    """Yield each requirement with its robustness (S,) at some times; NaN at times without evaluation."""
    block_times_ns = result.block.times_ns
    if not len(block_times_ns):
        return
    block_samples = np.minimum(np.searchsorted(block_times_ns, times_ns), len(block_times_ns) - 1)
    is_evaluated = block_times_ns[block_samples] == times_ns
    for requirement in result.requirements:
        numbers = robustness_of(requirement, result.block.series, block_samples)
        yield requirement, np.where(is_evaluated, numbers, np.nan)


def _first(results: Sequence[EvaluatedResult], times_ns: Integers) -> tuple[Integers, Integers, Floats]:
    """Return the results, the requirements (indices) and the robustness of first violations, (S,) each.

    A requirement with robustness -inf is skipped: no object can fulfil it, so the arrow would have no ends.
    """
    result_indices, requirement_indices = (
        np.full(len(times_ns), -1, np.int64),
        np.full(len(times_ns), -1, np.int64),
    )
    robustness = np.full(len(times_ns), np.nan)
    earliest_ns = np.full(len(times_ns), LATEST_NS)
    for index, result in enumerate(results):
        if result.leaf_pairs is None:
            continue
        since_ns = (
            np.zeros(len(result.requirements), np.int64) if result.since_ns is None else result.since_ns
        )
        is_settled = np.zeros(len(times_ns), np.bool_)
        if result.settled is not None:
            is_settled = times_ns >= result.settled.time_ns
        for requirement_index, (requirement, numbers) in enumerate(_robustness(result, times_ns)):
            if requirement.is_condition:
                continue
            is_first = (numbers < 0.0) & (numbers > -np.inf) & (since_ns[requirement_index] < earliest_ns)
            if not requirement.is_invariant:
                is_first &= ~is_settled
            result_indices[is_first], requirement_indices[is_first], robustness[is_first] = (
                index,
                requirement_index,
                numbers[is_first],
            )
            earliest_ns[is_first] = since_ns[requirement_index]
        if result.settled is not None and result.settled.shown is not None:
            # the violation may have been settled earlier, for example by the missed deadline of a goal
            is_first = _shows_settling_leaf(result, times_ns) & (result.settled.time_ns < earliest_ns)
            result_indices[is_first], robustness[is_first] = index, -abs(result.settled.shown.number)
            earliest_ns[is_first] = result.settled.time_ns
    return result_indices, requirement_indices, robustness


def _deciding(
    result: EvaluatedResult, pairs: LeafPairs, requirement_indices: Integers, block_samples: Integers
) -> tuple[Integers, NDArray[np.bool_]]:
    """Return (H,) deciding leaves of requirements (H,) in samples (H,), and whether each leaf is negated.

    A leaf is -1 if no leaf has the requirement's number. A negated leaf holds if its requirement fails.
    """
    leaf_indices, is_negated = (
        np.full(len(block_samples), -1, np.int64),
        np.zeros(len(block_samples), np.bool_),
    )
    leaves = result.block.leaves
    low_channel, high_channel = low_and_high(len(leaves), wide=False)
    for requirement_index in np.unique(requirement_indices[requirement_indices >= 0]).tolist():
        positions = np.flatnonzero(requirement_indices == requirement_index)
        leaves_of_requirement, requirement = (
            pairs.below[requirement_index],
            result.requirements[requirement_index],
        )
        if not len(leaves_of_requirement.indices):
            continue  # a constant formula has no leaves
        leaves_and_samples = leaves_of_requirement.indices[:, None], block_samples[positions][None, :]
        lows, highs = leaves[low_channel][leaves_and_samples], leaves[high_channel][leaves_and_samples]
        requirement_numbers = result.block.series[requirement.node, 1, block_samples[positions]]
        is_hit = (lows == highs) & (lows * leaves_of_requirement.signs[:, None] == requirement_numbers)
        first_hits = is_hit.argmax(axis=0)
        leaf_indices[positions] = np.where(is_hit.any(axis=0), leaves_of_requirement.indices[first_hits], -1)
        is_negated[positions] = requirement.sign * leaves_of_requirement.signs[first_hits] < 0.0
    return leaf_indices, is_negated


def _locate(
    result: EvaluatedResult, trace: Trace, samples: Integers, positions: Integers, violations: Violations
) -> None:
    """Set the ends of arrows and the atoms of quantifiers at `positions` (H,); the leaves are set before."""
    if result.leaf_pairs is None:
        return
    is_past = violations.moment_ns[positions] >= 0
    _point_at_past(result, result.leaf_pairs, positions[is_past], violations)
    positions = positions[(violations.leaf[positions] >= 0) & ~is_past]
    if not len(positions):
        return
    # only these samples are measured, because they are often few
    leaf_indices, scene = (
        violations.leaf[positions],
        TraceScene(trace.take(samples[positions]), result.leaf_pairs.regions),
    )
    for leaf_index in np.unique(leaf_indices).tolist():
        leaf_positions = np.flatnonzero(leaf_indices == leaf_index)
        pair = result.leaf_pairs.pairs[leaf_index]
        if pair is not None:
            _point_at(scene, pair, leaf_positions, positions[leaf_positions], violations)
        for body, deciding_indices in _iter_deciding(
            result, result.leaf_pairs, leaf_index, scene, leaf_positions
        ):
            body_pair = pair_of(body)
            deciding_positions = leaf_positions[deciding_indices]
            if body_pair is not None and len(deciding_positions):
                violations.atom[positions[deciding_positions]] = len(violations.atoms)
                violations.atoms.append(BoundAtom(result.leaf_pairs.text_of(body), body_pair))
                _point_at(scene, body_pair, deciding_positions, positions[deciding_positions], violations)


def _point_at_past(
    result: EvaluatedResult, pairs: LeafPairs, positions: Integers, violations: Violations
) -> None:
    """Set the arrow at the leaf that settled a violation in an earlier sample, with the ends at that time."""
    settled = result.settled
    pair = None if settled is None or settled.atom is None else pair_of(settled.atom)
    if (
        not len(positions)
        or settled is None
        or settled.atom is None
        or settled.sample is None
        or pair is None
    ):
        return
    violations.atom[positions] = len(violations.atoms)
    violations.atoms.append(BoundAtom(pairs.text_of(settled.atom), pair))
    _point_at(
        TraceScene(settled.sample, pairs.regions), pair, np.zeros(1, np.int64), positions[:1], violations
    )
    for column in (violations.points, violations.top, violations.is_shown):
        column[positions] = column[positions[0]]


def _iter_deciding(
    result: EvaluatedResult, pairs: LeafPairs, leaf: int, scene: TraceScene, samples: Integers
) -> Iterator[tuple[Formula, Integers]]:
    """Yield the body of each deciding binding, with the indices (k,) in `samples` where it decides."""
    shades = [shade for shade in result.shades or () if shade.leaf == leaf]
    if not shades:
        return
    if not shades[0].bodies:
        yield from _iter_worst(pairs.leaves[leaf], shades[0].requirement.sign, scene, samples)
        return
    # the shades are of the last block, but a final block has only its last sample
    block_samples = np.searchsorted(result.block.times_ns, scene.trace.times_ns[samples]) - (
        len(result.block.times_ns) if result.is_final else 0
    )
    worst_bodies = shades[0].worst[block_samples]
    for body_index in np.unique(worst_bodies[worst_bodies >= 0]).tolist():
        yield shades[0].bodies[body_index], np.flatnonzero(worst_bodies == body_index)


def _iter_worst(
    leaf: Formula, sign: float, scene: TraceScene, samples: Integers
) -> Iterator[tuple[Formula, Integers]]:
    """Yield the bodies of deciding bindings for a quantifier with many bindings; see `_iter_deciding`.

    A binding decides in the samples in which its number is the least.
    """
    if not isinstance(leaf, Quantified):
        return
    part_scene = TraceScene(scene.trace.take(samples), scene.regions)
    bindings = permutations(part_scene.candidates(leaf.group), len(leaf.variables))
    least_numbers, bodies = np.full(len(samples), np.inf), dict[int, Formula]()
    worst_indices = np.full(len(samples), -1, np.int64)
    first_index = 0
    while next_bindings := list(islice(bindings, _MOST_BINDINGS)):
        next_bodies, numbers = _numbers_of_bindings(leaf, sign, part_scene, next_bindings)
        numbers = np.where(np.isnan(numbers), np.inf, numbers)
        is_less = numbers.min(axis=0) < least_numbers
        worst_indices[is_less] = first_index + numbers.argmin(axis=0)[is_less]
        least_numbers = np.minimum(least_numbers, numbers.min(axis=0))
        bodies |= {
            first_index + index: next_bodies[index]
            for index in set((worst_indices[is_less] - first_index).tolist())
        }
        first_index += len(next_bindings)
    for binding_index in np.unique(worst_indices[worst_indices >= 0]).tolist():
        yield bodies[binding_index], np.flatnonzero(worst_indices == binding_index)


def _point_at(
    scene: TraceScene, pair: Pair, samples: Integers, positions: Integers, violations: Violations
) -> None:
    """Set the ends of the arrows at `positions`, measured between the pair in some samples of a scene."""
    operands = [scene.resolve(term).operand for term in (pair.first, pair.second)]
    first_operand, second_operand = (
        Operand(operand.rows[samples], operand.enlargement) for operand in operands
    )
    contact_columns = contacts(scene.batch, first_operand, second_operand, is_protrusion=pair.is_protrusion)
    violations.points[positions] = contact_columns[:, :4].reshape(-1, 2, 2)
    violations.top[positions] = contact_columns[:, 5]
    violations.is_shown[positions] = np.isfinite(contact_columns[:, :5]).all(axis=1)


def _columns(selected_names: frozenset[str], names: Sequence[str]) -> list[int]:
    return [column for column, name in enumerate(names) if name in selected_names]


def _members(group: ClassMembers, presence: Presence) -> NDArray[np.bool_]:
    """Return (S, objects), whether each object belongs to an open group in each sample."""
    is_class_member = [group.class_name in (ANY_CLASS, (name or "").casefold()) for name in presence.classes]
    is_included = np.array([name not in group.excluded for name in presence.names], np.bool_)
    # the class code -1 of absent objects indexes the last entry
    return np.array([*is_class_member, False], np.bool_)[presence.class_code] & is_included

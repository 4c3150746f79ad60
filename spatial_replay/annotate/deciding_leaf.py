"""The deciding leaf of a node, found by comparing numbers instead of evaluating the log again.

Robustness consists of minima, maxima and negations. So the number of a node equals, up to the sign, the
number of a leaf in some sample. If that sample is the newest sample, `find_leaf` finds the leaf by
comparison.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.annotate.requirements import Requirement
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.atoms.terms import Bindings, TraceScene, look_back
from spatial_replay.monitor.offline import OfflineNodes, evaluate_offline, evaluate_prefix
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.sentences import conjuncts_of, divisor_of, find_causes
from spatial_replay.monitor.stream import NEVER, Instance, SeriesBlock, join_blocks
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.monitor.witness.path import (
    DecidingPath,
    End,
    MissedResponse,
    deciding_atom,
    deciding_path,
    missed_response,
)
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Atom,
    Formula,
    Outline,
    Protrusion,
    Quantified,
    RegionName,
    SignedDistance,
    Term,
    TrackedName,
)
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.walks import (
    base_of,
    iter_expressions,
    leaf_key,
    looks_back,
    nodes_of,
    nodes_with_operands,
    operand_signs,
    substitute,
)
from spatial_replay.trace.trace import Trace


class LeavesBelow(NamedTuple):
    """The leaves below one node, with one entry per leaf and sign.

    Attributes:
        indices: (L,) int64, index among the program's leaves.
        signs: (L,), 1 or -1.
    """

    indices: Integers
    signs: Floats


class DecidingLeaf(NamedTuple):
    """A leaf, and the sample at which the leaf decides.

    Attributes:
        leaf: index among the program's leaves.
        number: nominal number of the leaf in the sample, with the leaf's own sign.
        end: whether `number` is the low or the high end of the leaf's interval.
        time_ns: time of the sample.
        node: id of the leaf in the formula's tree; -1 if only the leaf's number was compared.
        bound: deciding end of the leaf's interval with uncertainty.
        missed: the failed implication that causes the violation, or None.
        response: for a missed response, the leaf that came closest to fulfilling the response, or None.
    """

    leaf: int
    number: float
    end: End
    time_ns: int
    node: int = -1
    bound: float = math.nan
    missed: MissedResponse | None = None
    response: DecidingLeaf | None = None

    @property
    def shown(self) -> DecidingLeaf:
        """The leaf at which arrows point: `response` for a missed response, otherwise this leaf."""
        return self if self.response is None else self.response


def leaves_below(formula: Formula, leaves: Sequence[Formula]) -> list[LeavesBelow]:
    """Return the leaves below each node of a formula, by id.

    Args:
        leaves: the program's leaves, without duplicates.
    """
    leaf_indices = {leaf_key(leaf): index for index, leaf in enumerate(leaves)}
    nodes = nodes_with_operands(formula)
    entries_of_nodes: list[dict[tuple[int, int], None]] = [{} for _ in nodes]
    for node_entries, (node, operands) in zip(entries_of_nodes[::-1], nodes[::-1], strict=True):
        if isinstance(node, Atom | Quantified):
            node_entries[leaf_indices[leaf_key(node)], 1] = None
        for operand_index, operand in enumerate(operands):
            for sign in operand_signs(node, operand_index):
                node_entries.update(
                    dict.fromkeys((leaf, leaf_sign * sign) for leaf, leaf_sign in entries_of_nodes[operand])
                )
    return [_columns(list(entries)) for entries in entries_of_nodes]


def find_leaf(
    below: LeavesBelow, ends: tuple[Floats, Floats], number: float, time_ns: int, *, low: bool
) -> DecidingLeaf | None:
    """Compare the leaves below a node with the node's number in a sample, and return the first equal leaf.

    Args:
        ends: (A,), low and high end of each of the program's leaves in the sample.
        number: number of the node. NaN finds the first unknown leaf; an infinite number finds no leaf.
        time_ns: time of the sample.
        low: whether the number is the low end of the node's interval; False for the high end.
    """
    if np.isinf(number):
        return None
    lows, highs = (end[below.indices] for end in ends)
    leaf_ends = np.where((below.signs > 0.0) == low, lows, highs)
    is_unknown = (lows == -np.inf) & (highs == np.inf)
    equal_indices = np.flatnonzero(is_unknown if np.isnan(number) else leaf_ends * below.signs == number)
    if not len(equal_indices):
        return None
    end = End.LOW if (below.signs[equal_indices[0]] > 0.0) == low else End.HIGH
    # adding 0.0 turns -0.0 into 0.0
    leaf_number = number if np.isnan(number) else float(leaf_ends[equal_indices[0]]) + 0.0
    return DecidingLeaf(int(below.indices[equal_indices[0]]), leaf_number, end, time_ns)


def _columns(entries: Sequence[tuple[int, int]]) -> LeavesBelow:
    pairs = np.array(entries, np.int64).reshape(-1, 2)
    return LeavesBelow(pairs[:, 0], pairs[:, 1].astype(np.float64))


_RECENT: Final = 1024
"""Largest distance from a change to the sample with a quantifier's deciding objects, samples."""


class NewestSamples:
    """The newest samples, for finding the deciding objects of quantifiers.

    Results do not depend on the cut of samples into blocks.
    """

    def __init__(self) -> None:
        """Start before the first sample."""
        self._blocks: deque[Trace] = deque()
        self._sample_count = 0

    def extend(self, trace: Trace) -> None:
        """Add the next samples."""
        while self._blocks and self._sample_count - len(self._blocks[0]) >= _RECENT:
            self._sample_count -= len(self._blocks.popleft())
        self._blocks.append(trace)
        self._sample_count += len(trace)

    def deciding_atom(
        self, leaf: Formula, found: DecidingLeaf, now_ns: int, regions: Mapping[str, Outline]
    ) -> tuple[Atom, float] | None:
        """Return the deciding atom of a quantifier, with the deciding objects and the atom's own number.

        Return None if the sample is not recent, the quantifier needs earlier samples, or no atom has the
        quantifier's number.

        Args:
            leaf: the quantifier, with the object in place of a template's parameter.
            found: number and sample of the quantifier.
            now_ns: time of the change; the sample must be recent at that time.
        """
        sample = self.sample(found.time_ns, now_ns)
        if sample is None or look_back([leaf]):
            return None
        deciding = deciding_atom(TraceScene(sample, regions), leaf, found.end)
        if deciding is None:
            return None
        is_turned = deciding.end is not found.end
        number = -found.number if is_turned else found.number
        atom_ends = deciding.value, deciding.lower if deciding.end is End.LOW else deciding.upper
        return (deciding.atom, number) if number in atom_ends else None

    def sample(self, time_ns: int, now_ns: int) -> Trace | None:
        """Return the sample at a time, at most `_RECENT` samples before `now_ns`; None for older samples."""
        sample_distance = 0
        for trace in reversed(self._blocks):
            end_index, now_index = np.searchsorted(trace.times_ns, [time_ns, now_ns], side="right").tolist()
            sample_distance += now_index - end_index
            if end_index:
                is_recent = trace.times_ns[end_index - 1] == time_ns and sample_distance < _RECENT
                return trace.slice(end_index - 1, end_index) if is_recent else None
        return None


MOST_NUMBERS: Final = 1 << 22
"""Limit of stored leaf numbers per result: 32 MiB."""
_END_OF: Final = {Verdict.SATISFIED: End.LOW, Verdict.VIOLATED: End.HIGH}


class SettledViolation(NamedTuple):
    """A violation that was certain before the end of a log.

    Attributes:
        time_ns: time of the sample from which on the violation is certain.
        leaf: deciding leaf, perhaps of an earlier sample; None if no leaf decided.
        atom: formula at which the arrow points: a leaf or, for a quantifier, its deciding atom with objects.
        sample: sample of the leaf to point at; None if that sample was not recent at `time_ns`.
    """

    time_ns: int
    leaf: DecidingLeaf | None
    atom: Formula | None = None
    sample: Trace | None = None

    @property
    def shown(self) -> DecidingLeaf | None:
        """The leaf that arrows point at, or None."""
        return None if self.leaf is None else self.leaf.shown

    @property
    def objects(self) -> list[str]:
        """The objects at the ends of the arrow at the atom."""
        pair = None if self.atom is None else pair_of(self.atom)
        terms = [] if pair is None else [base_of(pair.first), base_of(pair.second)]
        return [term.name for term in terms if isinstance(term, TrackedName)]


class LeafHistory:
    """The leaves of one result in all samples so far, for any cut of samples into blocks."""

    def __init__(
        self, formula: Formula, order: Sequence[Atom | Quantified], bindings: Bindings | None = None
    ) -> None:
        """Start before the first sample.

        Args:
            order: leaves in the order of `SeriesBlock.leaves`.
            bindings: object by the parameter of a template.
        """
        self._bindings = bindings or {}
        self._formula = formula
        self._leaf_order = order
        self._nodes = nodes_of(formula)
        leaf_indices = {leaf_key(leaf): index for index, leaf in enumerate(order)}
        self._leaf_by_node = [
            leaf_indices[leaf_key(node)] if isinstance(node, Atom | Quantified) else None
            for node in self._nodes
        ]
        self._blocks: list[SeriesBlock] = []
        self._sample_count = 0
        # the limit assumes four channels, so that uncertain leaves in a block do not change it
        self._sample_limit = MOST_NUMBERS // max(4 * len(order), 1)

    def extend(self, block: SeriesBlock) -> None:
        """Add the next samples. Beyond `MOST_NUMBERS`, all stored samples are dropped."""
        self._sample_count += len(block.times_ns)
        if self._sample_count > self._sample_limit:
            self._blocks.clear()
        elif len(block.times_ns):
            empty = np.empty((len(block.series), 4, 0))
            self._blocks.append(SeriesBlock(block.times_ns, empty, block.leaves))

    @property
    def is_complete(self) -> bool:
        """Whether all samples so far are stored."""
        return self._sample_count <= self._sample_limit

    def settling_leaf(self, node: int, series: Floats, time_ns: int, verdict: Verdict) -> DecidingLeaf | None:
        """Return the leaf that settled a node's verdict at a sample; None beyond `MOST_NUMBERS`.

        A violated conjunction has the leaf that settled the first violated conjunct.

        Args:
            series: (N, 4), numbers of all nodes at that sample.
        """
        block = self._until(time_ns)
        if block is None:
            return None
        if verdict is Verdict.VIOLATED:
            conjuncts = conjuncts_of(self._nodes[node], "", node)
            node = next(conjunct.node for conjunct in conjuncts if series[conjunct.node, 3] < 0.0)
        evaluation = evaluate_prefix(self._formula, self._leaf_order, block.leaves, block.times_ns)
        return self._leaf(deciding_path(evaluation, node, _END_OF[verdict]), block, evaluation, verdict)

    def final_leaf(self, node: int, values: Floats, final: Floats) -> DecidingLeaf | None:
        """Return the deciding leaf of a node that was pending at the end; None beyond `MOST_NUMBERS`.

        A violated conjunction has the deciding leaf of the first cause (see `find_causes`).

        Args:
            values: (N,), each node's value on the whole log.
            final: (N, 2), lower and upper end of each node's value over the finished log.
        """
        block = self._until(None)
        verdict = final_verdict(*final[node].tolist())
        if block is None or verdict not in _END_OF:
            return None
        if verdict is Verdict.VIOLATED:
            pending, conjuncts = np.full(final.shape, NEVER), conjuncts_of(self._nodes[node], "", node)
            node = find_causes(conjuncts, values, final, pending)[0].node
        evaluation = evaluate_offline(self._formula, self._leaf_order, block.leaves, block.times_ns)
        return self._leaf(deciding_path(evaluation, node, _END_OF[verdict]), block, evaluation, verdict)

    def _until(self, time_ns: int | None) -> SeriesBlock | None:
        """Return the samples up to a time, or all samples; None without stored samples."""
        if not self._blocks:
            return None
        self._blocks = [join_blocks(self._blocks)]
        return self._blocks[0] if time_ns is None else self._blocks[0].between(0, time_ns + 1)

    def _leaf(
        self, path: DecidingPath, block: SeriesBlock, evaluation: OfflineNodes, verdict: Verdict
    ) -> DecidingLeaf | None:
        """Return the leaf at the end of a path, with the missed response of a violation.

        None if the leaf has no finite number.
        """
        deciding_leaf = self._end_of(path, block)
        if deciding_leaf is None or verdict is not Verdict.VIOLATED:
            return deciding_leaf
        missed, closest_path = missed_response(path, evaluation, self._bindings)
        response = None if closest_path is None else self._end_of(closest_path, block)
        return deciding_leaf._replace(missed=missed, response=response)

    def _end_of(self, path: DecidingPath, block: SeriesBlock) -> DecidingLeaf | None:
        node, sample = path.steps[-1].node, path.steps[-1].sample
        leaf_index = self._leaf_by_node[node]
        if leaf_index is None:
            return None
        low, high = low_and_high(len(block.leaves), wide=True)
        bound = float(block.leaves[high if path.end is End.HIGH else low, leaf_index, sample])
        if not math.isfinite(bound):
            return None
        low, high = low_and_high(len(block.leaves), wide=False)
        number = float(block.leaves[high if path.end is End.HIGH else low, leaf_index, sample])
        # a nominal number of the other sign would contradict the verdict
        if not math.isfinite(number) or (number >= 0.0) != (bound >= 0.0):
            number = bound
        time_ns = int(block.times_ns[sample])
        return DecidingLeaf(leaf_index, number + 0.0, path.end, time_ns, node, bound + 0.0)


class Pair(NamedTuple):
    """Two terms of an atom, related by a distance or by the protrusion of the first term from the second."""

    first: Term
    second: Term
    is_protrusion: bool

    @property
    def names(self) -> tuple[TrackedName | RegionName, ...]:
        """The related objects and regions, each once."""
        bases = dict.fromkeys((base_of(self.first), base_of(self.second)))
        return tuple(base for base in bases if isinstance(base, TrackedName | RegionName))


class LeafPairs(NamedTuple):
    """The pairs of objects and regions that the leaves of one result relate.

    Attributes:
        leaves: leaves of the program, with the object in place of a template's parameter.
        pairs: pair of each leaf; None for a leaf without two terms in one sample.
        below: leaves below each requirement of the formula.
        regions: shapes by name.
        divisors: number by which `scale` divides each leaf's robustness; 1 without `scale`.
        texts: text of each leaf in the language.
        relations: names of relations that texts may use.
    """

    leaves: tuple[Formula, ...]
    pairs: tuple[Pair | None, ...]
    below: tuple[LeavesBelow, ...]
    regions: Mapping[str, Outline]
    divisors: Floats
    texts: tuple[str, ...]
    relations: frozenset[str]

    def text_of(self, formula: Formula) -> str:
        """Return the text of a formula in the language."""
        return format_formula(formula, relations=self.relations)


def leaf_pairs(
    instance: Instance,
    requirements: Sequence[Requirement],
    regions: Mapping[str, Outline],
    relations: frozenset[str] = frozenset(),
) -> LeafPairs:
    """Return the pairs of the leaves of an instance.

    Args:
        relations: names of relations that the file defines.
    """
    leaves_by_node = leaves_below(instance.formula, instance.program.leaves)
    leaves = tuple(substitute(leaf, instance.bindings) for leaf in instance.program.leaves)
    pairs, relation_names = tuple(map(pair_of, leaves)), RELATION_NAMES | relations
    texts = tuple(format_formula(leaf, relations=relation_names) for leaf in leaves)
    divisors = np.array([divisor_of(leaf) for leaf in instance.program.leaves])
    leaves_by_requirement = tuple(leaves_by_node[requirement.node] for requirement in requirements)
    return LeafPairs(leaves, pairs, leaves_by_requirement, regions, divisors, texts, relation_names)


def pair_of(leaf: Formula) -> Pair | None:
    """Return the first distance or enclosure in an atom, or else the distance of its first two terms.

    Return None for other leaves, and for terms that look back in time.
    """
    if not isinstance(leaf, Atom):
        return None
    for pair in _pairs(leaf):
        if not any(map(looks_back, (pair.first, pair.second))):
            return pair
    return None


def _pairs(atom: Atom) -> Iterator[Pair]:
    for expression in iter_expressions(atom.expression):
        match expression:
            case SignedDistance():
                yield Pair(expression.first, expression.second, False)
            case Protrusion():
                yield Pair(expression.inner, expression.outer, True)
    if len(atom.terms) > 1:
        yield Pair(atom.terms[0], atom.terms[1], False)

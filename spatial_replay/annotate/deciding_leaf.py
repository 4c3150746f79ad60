"""The leaf that gives a node its number, found by comparing numbers instead of walking through the log.

Robustness is made of minima and maxima, so each number is that of some leaf at some sample, perhaps with its
sign turned. If that sample is the newest, `find_leaf` compares the numbers of the leaves there.
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
    """The leaves below one node, each once for each sign in which it counts.

    Attributes:
        indices: (L,) int64, index among the program's leaves.
        signs: (L,), 1 or -1.
    """

    indices: Integers
    signs: Floats


class DecidingLeaf(NamedTuple):
    """A leaf at the sample at which it decides.

    Attributes:
        leaf: index among the program's leaves.
        number: its own number there, its sign not turned, without what is uncertain.
        end: which end of its interval that is.
        time_ns: of the sample.
        node: its id in the formula's tree; -1 where only its number was compared.
        bound: the same number with what is uncertain: the end of its interval that decides.
        missed: the implication above it that failed, if a violation is due to one.
        response: where it is the condition's, the leaf by which the response came closest, if one did.
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
        """The leaf to point at: that of a response that was missed, not of the condition that held."""
        return self if self.response is None else self.response


def leaves_below(formula: Formula, leaves: Sequence[Formula]) -> list[LeavesBelow]:
    """Return the leaves below each node of a formula, by id.

    Args:
        leaves: the program's leaves, of which equal ones are one.
    """
    numbers = {leaf_key(leaf): index for index, leaf in enumerate(leaves)}
    nodes = nodes_with_operands(formula)
    entries_of_nodes: list[dict[tuple[int, int], None]] = [{} for _ in nodes]
    for own_leaves, (node, operands) in zip(entries_of_nodes[::-1], nodes[::-1], strict=True):
        if isinstance(node, Atom | Quantified):
            own_leaves[numbers[leaf_key(node)], 1] = None
        for place, operand in enumerate(operands):
            for sign in operand_signs(node, place):
                own_leaves.update(
                    dict.fromkeys((leaf, leaf_sign * sign) for leaf, leaf_sign in entries_of_nodes[operand])
                )
    return [_columns(list(entries)) for entries in entries_of_nodes]


def find_leaf(
    below: LeavesBelow, ends: tuple[Floats, Floats], number: float, time_ns: int, *, low: bool
) -> DecidingLeaf | None:
    """Return the first leaf below a node that has the node's number, in one sample.

    Args:
        ends: (A,) low and high end of each of the program's leaves in that sample.
        number: of the node; NaN finds the first that is unknown, an infinite one identifies no leaf.
        time_ns: of the sample.
        low: whether the number is the low end of the node's interval, or the high one.
    """
    if np.isinf(number):
        return None
    lows, highs = (end[below.indices] for end in ends)
    numbers = np.where((below.signs > 0.0) == low, lows, highs)
    is_unknown = (lows == -np.inf) & (highs == np.inf)
    hits = np.flatnonzero(is_unknown if np.isnan(number) else numbers * below.signs == number)
    if not len(hits):
        return None
    end = End.LOW if (below.signs[hits[0]] > 0.0) == low else End.HIGH
    leaf_number = number if np.isnan(number) else float(numbers[hits[0]]) + 0.0
    return DecidingLeaf(int(below.indices[hits[0]]), leaf_number, end, time_ns)


def _columns(entries: Sequence[tuple[int, int]]) -> LeavesBelow:
    pairs = np.array(entries, np.int64).reshape(-1, 2)
    return LeavesBelow(pairs[:, 0], pairs[:, 1].astype(np.float64))


_RECENT: Final = 1024
"""Samples before a change in which the object that decides a quantifier is looked for."""


class NewestSamples:
    """The newest samples, in which quantifiers are traced to the objects that decide them.

    Cutting the samples into blocks changes nothing.
    """

    def __init__(self) -> None:
        """Start before the first sample."""
        self._blocks: deque[Trace] = deque()
        self._older = 0

    def extend(self, trace: Trace) -> None:
        """Take in the next samples."""
        while self._blocks and self._older - len(self._blocks[0]) >= _RECENT:
            self._older -= len(self._blocks.popleft())
        self._blocks.append(trace)
        self._older += len(trace)

    def deciding_atom(
        self, leaf: Formula, found: DecidingLeaf, now_ns: int, regions: Mapping[str, Outline]
    ) -> tuple[Atom, float] | None:
        """Return the atom of the objects that give a quantifier its number, with the atom's own number.

        None if the sample is not recent, if earlier samples would be needed, or if no atom has
        that number.

        Args:
            leaf: with the object of a template.
            now_ns: the time of the sample from which the number is looked back at.
        """
        sample = self.sample(found.time_ns, now_ns)
        if sample is None or look_back([leaf]):
            return None
        decided = deciding_atom(TraceScene(sample, regions), leaf, found.end)
        if decided is None:
            return None
        is_turned = decided.end is not found.end
        number = -found.number if is_turned else found.number
        ends = decided.value, decided.lower if decided.end is End.LOW else decided.upper
        return (decided.atom, number) if number in ends else None

    def sample(self, time_ns: int, now_ns: int) -> Trace | None:
        """Return the sample of a time, if it is recent."""
        between = 0
        for trace in reversed(self._blocks):
            at, now = np.searchsorted(trace.times_ns, [time_ns, now_ns], side="right").tolist()
            between += now - at
            if at:
                is_there = trace.times_ns[at - 1] == time_ns and between < _RECENT
                return trace.slice(at - 1, at) if is_there else None
        return None


MOST_NUMBERS: Final = 1 << 22
"""Numbers of leaves that are kept of one result, at most: 32 MiB of them."""
_END_OF: Final = {Verdict.SATISFIED: End.LOW, Verdict.VIOLATED: End.HIGH}


class SettledViolation(NamedTuple):
    """The leaf that made a violation certain before the end of a log.

    Attributes:
        time_ns: of the sample since which it is certain.
        leaf: what decided it then, perhaps at an earlier sample; None if no leaf did.
        atom: the leaf to point at or, for a quantifier, the atom of the objects that decide it.
        sample: the sample of that leaf, if it was recent then.
    """

    time_ns: int
    leaf: DecidingLeaf | None
    atom: Formula | None = None
    sample: Trace | None = None

    @property
    def shown(self) -> DecidingLeaf | None:
        """The leaf to point at, if there is one."""
        return None if self.leaf is None else self.leaf.shown

    @property
    def objects(self) -> list[str]:
        """The objects that the atom relates, as it can be pointed at."""
        pair = None if self.atom is None else pair_of(self.atom)
        terms = [] if pair is None else [base_of(pair.first), base_of(pair.second)]
        return [term.name for term in terms if isinstance(term, TrackedName)]


class LeafHistory:
    """The leaves of one result in the samples so far; cutting the samples into blocks changes nothing."""

    def __init__(
        self, formula: Formula, order: Sequence[Atom | Quantified], bindings: Bindings | None = None
    ) -> None:
        """Start before the first sample.

        Args:
            order: which leaf is which.
            bindings: what the parameter of a template stands for.
        """
        self._bindings = bindings or {}
        self._formula = formula
        self._order = order
        self._nodes = nodes_of(formula)
        numbers = {leaf_key(leaf): index for index, leaf in enumerate(order)}
        self._leaf_of = [
            numbers[leaf_key(node)] if isinstance(node, Atom | Quantified) else None for node in self._nodes
        ]
        self._blocks: list[SeriesBlock] = []
        self._samples = 0
        # two channels at least, so that the bound does not depend on whether a block has uncertain leaves
        self._most = MOST_NUMBERS // max(4 * len(order), 1)

    def extend(self, block: SeriesBlock) -> None:
        """Take in the next samples."""
        self._samples += len(block.times_ns)
        if self._samples > self._most:
            self._blocks.clear()
        elif len(block.times_ns):
            empty = np.empty((len(block.series), 4, 0))
            self._blocks.append(SeriesBlock(block.times_ns, empty, block.leaves))

    @property
    def is_complete(self) -> bool:
        """Whether all samples so far are kept."""
        return self._samples <= self._most

    def settling_leaf(self, node: int, series: Floats, time_ns: int, verdict: Verdict) -> DecidingLeaf | None:
        """Return what settled a node's verdict at a sample; None beyond the bound.

        For a violated conjunction it settled the first violated conjunct.

        Args:
            series: (N, 4), the numbers of all nodes at that sample.
        """
        samples = self._until(time_ns)
        if samples is None:
            return None
        if verdict is Verdict.VIOLATED:
            conjuncts = conjuncts_of(self._nodes[node], "", node)
            node = next(conjunct.node for conjunct in conjuncts if series[conjunct.node, 3] < 0.0)
        evaluation = evaluate_prefix(self._formula, self._order, samples.leaves, samples.times_ns)
        return self._leaf(deciding_path(evaluation, node, _END_OF[verdict]), samples, evaluation, verdict)

    def final_leaf(self, node: int, values: Floats, final: Floats) -> DecidingLeaf | None:
        """Return what decides a node that was pending up to the end of the log; None beyond the bound.

        For a violated conjunction it decides the first cause (see `find_causes`).

        Args:
            values: (N,), each node's value on the whole log.
            final: (N, 2), lower and upper end of each node's value over the finished log.
        """
        samples = self._until(None)
        verdict = final_verdict(*final[node].tolist())
        if samples is None or verdict not in _END_OF:
            return None
        if verdict is Verdict.VIOLATED:
            pending, conjuncts = np.full(final.shape, NEVER), conjuncts_of(self._nodes[node], "", node)
            node = find_causes(conjuncts, values, final, pending)[0].node
        evaluation = evaluate_offline(self._formula, self._order, samples.leaves, samples.times_ns)
        return self._leaf(deciding_path(evaluation, node, _END_OF[verdict]), samples, evaluation, verdict)

    def _until(self, time_ns: int | None) -> SeriesBlock | None:
        """Return the samples up to a time, or all."""
        if not self._blocks:
            return None
        self._blocks = [join_blocks(self._blocks)]
        return self._blocks[0] if time_ns is None else self._blocks[0].between(0, time_ns + 1)

    def _leaf(
        self, path: DecidingPath, samples: SeriesBlock, done: OfflineNodes, verdict: Verdict
    ) -> DecidingLeaf | None:
        """Return the leaf at the end of a path, with what was missed; None if it has no finite number."""
        deciding = self._end_of(path, samples)
        if deciding is None or verdict is not Verdict.VIOLATED:
            return deciding
        missed, closest = missed_response(path, done, self._bindings)
        response = None if closest is None else self._end_of(closest, samples)
        return deciding._replace(missed=missed, response=response)

    def _end_of(self, path: DecidingPath, samples: SeriesBlock) -> DecidingLeaf | None:
        node, sample = path.steps[-1].node, path.steps[-1].sample
        index = self._leaf_of[node]
        if index is None:
            return None
        low, high = low_and_high(len(samples.leaves), wide=True)
        bound = float(samples.leaves[high if path.end is End.HIGH else low, index, sample])
        if not math.isfinite(bound):
            return None
        low, high = low_and_high(len(samples.leaves), wide=False)
        number = float(samples.leaves[high if path.end is End.HIGH else low, index, sample])
        if not math.isfinite(number) or (number >= 0.0) != (bound >= 0.0):
            number = bound
        time_ns = int(samples.times_ns[sample])
        return DecidingLeaf(index, number + 0.0, path.end, time_ns, node, bound + 0.0)


class Pair(NamedTuple):
    """Two terms that an atom relates: by their distance, or by how far one sticks out of the other."""

    first: Term
    second: Term
    is_protrusion: bool

    @property
    def names(self) -> tuple[TrackedName | RegionName, ...]:
        """The objects and regions that are related, each once."""
        bases = dict.fromkeys((base_of(self.first), base_of(self.second)))
        return tuple(base for base in bases if isinstance(base, TrackedName | RegionName))


class LeafPairs(NamedTuple):
    """The pairs of objects and regions that the leaves of one result relate.

    Attributes:
        leaves: those of the program, with the object of a template.
        pairs: of each of the program's leaves; None for one that does not relate two things in one sample.
        below: of each requirement of the formula, its leaves.
        regions: shapes by name.
        divisors: of each leaf, what `scale` divides its number by.
        texts: of each leaf, in the language.
        relations: the names of those that texts may use.
    """

    leaves: tuple[Formula, ...]
    pairs: tuple[Pair | None, ...]
    below: tuple[LeavesBelow, ...]
    regions: Mapping[str, Outline]
    divisors: Floats
    texts: tuple[str, ...]
    relations: frozenset[str]

    def text_of(self, formula: Formula) -> str:
        """Return a part of the formula in the language."""
        return format_formula(formula, relations=self.relations)


def leaf_pairs(
    instance: Instance,
    requirements: Sequence[Requirement],
    regions: Mapping[str, Outline],
    relations: frozenset[str] = frozenset(),
) -> LeafPairs:
    """Return what the leaves of an instance relate.

    Args:
        relations: the names of those that the file defines.
    """
    below = leaves_below(instance.formula, instance.program.leaves)
    leaves = tuple(substitute(leaf, instance.bindings) for leaf in instance.program.leaves)
    pairs, relation_names = tuple(map(pair_of, leaves)), RELATION_NAMES | relations
    texts = tuple(format_formula(leaf, relations=relation_names) for leaf in leaves)
    divisors = np.array([divisor_of(leaf) for leaf in instance.program.leaves])
    of_requirements = tuple(below[requirement.node] for requirement in requirements)
    return LeafPairs(leaves, pairs, of_requirements, regions, divisors, texts, relation_names)


def pair_of(leaf: Formula) -> Pair | None:
    """Return the first distance or enclosure in an atom, or the distance of its first terms."""
    if not isinstance(leaf, Atom):
        return None
    for pair in _pairs(leaf):
        if not any(map(looks_back, (pair.first, pair.second))):
            return pair
    return None


def _pairs(atom: Atom) -> Iterator[Pair]:
    for part in iter_expressions(atom.expression):
        match part:
            case SignedDistance():
                yield Pair(part.first, part.second, False)
            case Protrusion():
                yield Pair(part.inner, part.outer, True)
    if len(atom.terms) > 1:
        yield Pair(atom.terms[0], atom.terms[1], False)

"""The leaf that settled a verdict, found on the deciding path through the samples so far.

The history of a result's leaves is kept up to a bound, so that a recording of any length fits into memory;
beyond it, `deciding_leaf` finds leaves by their numbers where it can.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.annotate.deciding_leaf import LeafValue, leaf_key
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.atoms.terms import Bindings
from spatial_replay.monitor.causes import conjuncts_of, find_causes
from spatial_replay.monitor.offline import OfflineNodes, evaluate_offline
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.stream import NEVER, SeriesBlock, join_blocks
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.monitor.witness.path import (
    DecidingPath,
    End,
    MissedResponse,
    deciding_path,
    missed_response,
)
from spatial_replay.monitor.witness.unfinished import UnfinishedNodes, evaluate_unfinished
from spatial_replay.spec.formula import Atom, Formula, Quantified, iter_nodes
from spatial_replay.spec.walks import substitute

MOST_NUMBERS: Final = 1 << 22
"""Numbers of leaves that are kept of one result, at most: 32 MiB of them."""
_END_OF: Final = {Verdict.SATISFIED: End.LOW, Verdict.VIOLATED: End.HIGH}


class DecidingLeaf(NamedTuple):
    """A leaf at the sample at which it decides.

    Attributes:
        node: its id in the formula's tree.
        leaf: index among the program's leaves.
        number: its own number there, its sign not turned, without what is uncertain.
        bound: the same with what is uncertain: the end of its interval that decides.
        time_ns: of the sample.
        end: which end of its interval the number is.
        missed: the implication above it that failed, if a violation is due to one.
        response: where it is the condition's, the leaf by which the response came closest, if one did.
    """

    node: int
    leaf: int
    number: float
    time_ns: int
    end: End
    missed: MissedResponse | None = None
    response: DecidingLeaf | None = None
    bound: float = math.nan

    @property
    def shown(self) -> DecidingLeaf:
        """The leaf to point at: that of a response that was missed, not of the condition that held."""
        return self if self.response is None else self.response

    @property
    def value(self) -> LeafValue:
        """The leaf without its node and what was missed."""
        return LeafValue(self.leaf, self.number, self.end, self.time_ns)


class SettledViolation(NamedTuple):
    """What made a violation certain before the end of a log.

    Attributes:
        time_ns: of the sample since which it is certain.
        leaf: what decided it then, perhaps at an earlier sample; None if no leaf did.
    """

    time_ns: int
    leaf: DecidingLeaf | None

    @property
    def shown(self) -> DecidingLeaf | None:
        """The leaf to point at, if there is one."""
        return None if self.leaf is None else self.leaf.shown


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
        self._nodes = [node for _, _, node in iter_nodes(formula)]
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

    def settled(self, node: int, series: Floats, time_ns: int, verdict: Verdict) -> DecidingLeaf | None:
        """Return what settled a node's verdict at a sample, whatever comes; None beyond the bound.

        Of a violated conjunction that is what settled its first conjunct that is violated then.

        Args:
            series: (N, 4), the numbers of all nodes at that sample.
        """
        samples = self._until(time_ns)
        if samples is None:
            return None
        if verdict is Verdict.VIOLATED:
            conjuncts = (node + each.node for each in conjuncts_of(self._nodes[node], ""))
            node = next(each for each in conjuncts if series[each, 3] < 0.0)
        done = evaluate_unfinished(self._formula, self._order, samples.leaves, samples.times_ns)
        path = deciding_path(self._formula, done, samples.times_ns, node, _END_OF[verdict], goes_on=True)
        return self._leaf(path, samples, done, verdict, goes_on=True)

    def finished(self, node: int, values: Floats, final: Floats) -> DecidingLeaf | None:
        """Return what decides a node that was pending up to the end of the log; None beyond the bound.

        Of a violated conjunction that is what decides its first cause (see `find_causes`).

        Args:
            values: (N,), each node's value on the whole log.
            final: (N, 2), lower and upper end of each node's value over the finished log.
        """
        samples = self._until(None)
        verdict = final_verdict(*final[node].tolist())
        if samples is None or verdict not in _END_OF:
            return None
        if verdict is Verdict.VIOLATED:
            pending = np.full((len(final) - node, 2), NEVER, np.int64)
            conjuncts = conjuncts_of(self._nodes[node], "")
            first, *_ = find_causes(conjuncts, values[node:], final[node:], pending, lambda *_: None)
            node += first.node
        done = evaluate_offline(self._formula, self._order, samples.leaves, samples.times_ns)
        path = deciding_path(self._formula, done, samples.times_ns, node, _END_OF[verdict])
        return self._leaf(path, samples, done, verdict)

    def _until(self, time_ns: int | None) -> SeriesBlock | None:
        """Return the samples up to a time, or all."""
        if not self._blocks:
            return None
        self._blocks = [join_blocks(self._blocks)]
        return self._blocks[0] if time_ns is None else self._blocks[0].between(0, time_ns + 1)

    def _leaf(
        self,
        path: DecidingPath,
        samples: SeriesBlock,
        done: OfflineNodes | UnfinishedNodes,
        verdict: Verdict,
        *,
        goes_on: bool = False,
    ) -> DecidingLeaf | None:
        """Return the leaf at the end of a path, with what was missed; None if it has no finite number."""
        found = self._end_of(path, samples)
        if found is None or verdict is not Verdict.VIOLATED:
            return found
        nodes = [substitute(each, self._bindings) for each in self._nodes]
        missed = missed_response(path, nodes, done, samples.times_ns)
        response = None
        if missed is not None and missed.is_condition:
            at = missed.node, End.HIGH
            best = deciding_path(
                self._formula, done, samples.times_ns, *at, goes_on=goes_on, sample=missed.sample
            )
            response = self._end_of(best, samples)
        return found._replace(missed=missed, response=response)

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
        return DecidingLeaf(node, index, number + 0.0, time_ns, path.end, bound=bound + 0.0)

"""The smallest window of a log whose replay has the verdict, robustness and witness of the whole log.

The part that settled a violation first keeps its own, too.

No window is measured again: atoms are those of the first replay, except the first few that look back to
before the window, where a clip has no samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.logs.source import Source
from spatial_replay.monitor.atoms.delays import look_back
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.offline import evaluate_offline
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.verdict import final_verdict
from spatial_replay.monitor.witness.path import End, deciding_path
from spatial_replay.replay.selection import ReplayOptions, Selection
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import Outline, Specification
from spatial_replay.trace.trace import ABSENT, Trace, window_of
from spatial_replay.tuning.number_search import last_that_holds


class KeptNode(NamedTuple):
    """A node whose verdict a clip keeps, by its id, and what it is called."""

    result: SpecResult
    node: int
    title: str


def chosen_nodes(results: Sequence[SpecResult], of: Sequence[str]) -> list[KeptNode]:
    """Return the results, or the results and named specs within them that are asked for."""
    if not of:
        return [KeptNode(result, 0, result.title) for result in results]
    found, known = [], dict[str, None]()
    for result in results:
        names = {node.name: node.id for node in reversed(result.nodes) if node.name is not None}
        known |= dict.fromkeys([result.title, *names])
        if result.title in of or result.name in of:
            found.append(KeptNode(result, 0, result.title))
        found += [KeptNode(result, names[name], name) for name in of if names.get(name)]
    for name in of:
        if name not in known and all(name != result.name for result in results):
            hint = nearest_hint(name, known) or f"there are {', '.join(known)}"
            raise UsageError(f"no spec is named {name!r}; {hint}")
    return found


def _first_causes(kept: Sequence[KeptNode]) -> Iterator[KeptNode]:
    """Yield the part of each node that settled its violation: not always the one that its number is of."""
    for each in kept:
        first = each.result.first_cause(each.node)
        if first is not None and first.settled_ns is not None and first.node != each.node:
            yield KeptNode(each.result, first.node, each.title)


class _Reason(NamedTuple):
    """A result on some samples, as a clip has to repeat it.

    Attributes:
        ends: lower and upper end, the nominal ones, too.
        nodes: the ids on the path to the deciding atom.
        decided_ns: the sample that decides.
    """

    ends: tuple[float, ...]
    nodes: tuple[int, ...]
    decided_ns: int


class _Part:
    """One node of a result, evaluated over any window of its samples."""

    def __init__(self, kept: KeptNode, trace: Trace | None, regions: Mapping[str, Outline]) -> None:
        result = kept.result
        if result.leaves is None:
            raise UsageError("a clip needs the leaves of every sample, which were not stored")
        self._result, self._node = result, kept.node
        self._leaves, self._times_ns = result.leaves, result.times_ns
        self._order = result.evidence.instance.program.leaves
        self._trace, self._regions = trace, regions
        self._reach = look_back([result.formula])
        # an instance lasts from the first to the last appearance of its object
        self._seen_ns: Integers | None = None
        if result.object is not None and trace is not None:
            self._seen_ns = trace.times_ns[_appearances(trace, result.object)]
        self.reason = self._reason(self._leaves, self._times_ns)

    def over(self, start_ns: int, end_ns: int) -> _Reason | None:
        """Return the reason over the samples from one time to another, both included; None without any."""
        if self._seen_ns is not None:
            begin, end = window_of(self._seen_ns, start_ns, end_ns + 1)
            if begin == end:
                return None
            start_ns, end_ns = self._seen_ns[[begin, end - 1]].tolist()
        begin, end = window_of(self._times_ns, start_ns, end_ns + 1)
        if begin == end:
            return None
        return self._reason(self._within(begin, end, start_ns), self._times_ns[begin:end])

    def _within(self, begin: int, end: int, first_ns: int) -> Floats:
        """Return the leaves of a window as a log of its own has them: nothing is known before its start."""
        leaves = self._leaves[:, :, begin:end]
        samples, duration_ns = self._reach
        if self._trace is None or (samples, duration_ns) == (0, 0):
            return leaves
        times_ns = self._times_ns[begin:end]
        count = max(samples, int(np.searchsorted(times_ns, first_ns + duration_ns)))
        from_, to = window_of(self._trace.times_ns, int(times_ns[0]), int(times_ns[-1]) + 1)
        head = self._trace.slice(from_, min(from_ + count, to))
        if not len(head):
            return leaves
        instance = self._result.evidence.instance
        known = leaf_values(TraceScene(head, self._regions), self._order, instance.bindings)
        channels = max(len(known), len(leaves))
        leaves = np.array(in_channels(leaves, channels))
        leaves[:, :, : len(head)] = in_channels(known, channels)
        return leaves

    def _reason(self, leaves: Floats, times_ns: Integers) -> _Reason:
        done = evaluate_offline(self._result.formula, self._order, np.ascontiguousarray(leaves), times_ns)
        ends = tuple(
            float(end[0]) + 0.0 for wide in (True, False) for end in done.ends(self._node, wide=wide)
        )
        verdict = final_verdict(*ends[:2])
        end = End.of(verdict)
        steps = deciding_path(self._result.formula, done, times_ns, self._node, end).steps
        return _Reason(ends, tuple(step.node for step in steps), int(times_ns[steps[-1].sample]))


class ClipSearch:
    """Searches the window: from the samples that decide outwards, then from both ends inwards."""

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        options: ReplayOptions,
        kept: Sequence[KeptNode],
        around_ns: int,
    ) -> None:
        results = [each.result for each in kept]
        needs_samples = any(
            result.object is not None or look_back([result.formula]) != (0, 0) for result in results
        )
        trace = None
        if needs_samples:
            trace = Selection(source, files, options).trace()
        self._parts = [
            _Part(each, trace, _regions(files, each.result))
            for each in (*kept, *_first_causes(kept))
            if len(each.result.times_ns)
        ]
        self._times_ns = _joined_times([result.times_ns for result in results])
        decided = [part.reason.decided_ns for part in self._parts]
        last = len(self._times_ns) - 1
        self._inner = (
            int(np.searchsorted(self._times_ns, min(decided) - around_ns)),
            min(last, int(np.searchsorted(self._times_ns, max(decided) + around_ns, side="right")) - 1),
        )
        self._known: dict[tuple[int, int], bool] = {}

    def window(self) -> tuple[int, int]:
        """Return the times of the first and the last sample of the clip."""
        first, last = self._outwards()
        while True:
            begin = self._cut(first, self._inner[0], partial(self._holds, last=last))
            end = self._cut(last, self._inner[1], partial(self._holds, begin))
            if (begin, end) == (first, last):
                return int(self._times_ns[first]), int(self._times_ns[last])
            first, last = begin, end

    def _outwards(self) -> tuple[int, int]:
        """Widen the window in doubling steps until it has the results; small ones cost least."""
        low, high = self._inner
        last, step = len(self._times_ns) - 1, 0
        while True:
            window = max(low - step, 0), min(high + step, last)
            if window == (0, last) or self._holds(*window):
                return window
            step = max(2 * step, 1)

    def _cut(self, outer: int, inner: int, holds: Callable[[int], bool]) -> int:
        """Return an end near the inner one that holds; the outer one does, and windows near it cost most."""
        if inner == outer or holds(inner):
            return inner
        towards = 1 if outer > inner else -1
        return last_that_holds(inner, outer - towards, lambda at: not holds(at)) + towards

    def _holds(self, first: int, last: int) -> bool:
        """Say whether a window has every result, for the same reason."""
        if (first, last) not in self._known:
            times = int(self._times_ns[first]), int(self._times_ns[last])
            self._known[first, last] = all(_same(part.over(*times), part.reason) for part in self._parts)
        return self._known[first, last]


def _same(one: _Reason | None, other: _Reason) -> bool:
    return one is not None and one == other


def _joined_times(times_ns: Sequence[Integers]) -> Integers:
    first = times_ns[0]
    # objects of a template may come one after the other, each for as many samples
    if all(np.array_equal(each, first) for each in times_ns):
        return first
    return np.unique(np.concatenate(times_ns))


def _regions(files: Sequence[Specification], result: SpecResult) -> Mapping[str, Outline]:
    """Return the regions of the file that a result comes from."""
    return next((file.regions for file in files for spec in file.specs if spec.formula is result.formula), {})


def _appearances(trace: Trace, name: str) -> Booleans:
    return np.asarray(trace.rows[:, trace.names.index(name)] != ABSENT)

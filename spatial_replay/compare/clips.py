"""Clips: the smallest part of a log that shows its verdicts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spatial_replay.compare.runs import file_of
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.remote import RemoteFile
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import ZERO
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene, look_back
from spatial_replay.monitor.offline import OfflineNodes, evaluate_offline, evaluate_prefix
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.stream import InstanceStream
from spatial_replay.monitor.verdict import Verdict, final_verdict, require_ltlf
from spatial_replay.monitor.witness.path import End, MissedResponse, deciding_path, missed_response
from spatial_replay.replay.engine import Replay, Replayed, run_replay
from spatial_replay.replay.selection import (
    DEFAULT_OPTIONS,
    KEEP_ALL,
    ReplayOptions,
    Selection,
    Window,
    clipped_source,
)
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.format import format_duration
from spatial_replay.spec.formula import Outline, Specification
from spatial_replay.text import Instant, Sentence, counted_from
from spatial_replay.trace.trace import ABSENT, Trace, window_of
from spatial_replay.tuning.tuned import last_that_holds


class KeptNode(NamedTuple):
    """Node whose verdict a clip keeps, by result and id, with its title."""

    result: SpecResult
    node: int
    title: str


def chosen_nodes(results: Sequence[SpecResult], of: Sequence[str]) -> list[KeptNode]:
    """Return the results and named specs in `of`; by default the violated results, else all results.

    Raises:
        UsageError: a name that no result or spec has.
    """
    if not of:
        violated = [result for result in results if result.verdict is Verdict.VIOLATED]
        return [KeptNode(result, 0, result.title) for result in violated or results]
    nodes, spec_names = [], dict[str, None]()
    for result in results:
        # in reverse, so that the first of several nodes with one name remains
        names = {node.name: node.id for node in reversed(result.nodes) if node.name is not None}
        spec_names |= dict.fromkeys([result.title, *names])
        if result.title in of or result.name in of:
            nodes.append(KeptNode(result, 0, result.title))
        nodes += [KeptNode(result, names[name], name) for name in of if names.get(name)]
    for name in of:
        if name not in spec_names and all(name != result.name for result in results):
            hint = nearest_hint(name, spec_names) or f"there are {', '.join(spec_names)}"
            raise UsageError(f"no spec is named {name!r}; {hint}")
    return nodes


class _Path(NamedTuple):
    """Path from a node to its deciding atom.

    Attributes:
        nodes: ids of the nodes on the path.
        decided_ns: time of the deciding sample.
        number: robustness interval of the last node at that sample.
        missed: failed implication on the path, or None.
    """

    nodes: tuple[int, ...]
    decided_ns: int
    number: tuple[float, float]
    missed: MissedResponse | None


class _Decision(NamedTuple):
    """Verdict of a node and its reason, which a clip must repeat.

    Attributes:
        verdict: verdict of the node.
        certain_ns: time of the sample that made the verdict certain, or None.
        numbers: deciding ends of the robustness interval and of the nominal interval, for the node and its
            cause. The other ends are left out: a sample that decides nothing can make them unknown.
        cause: id of the part that failed first, or None.
        path: path to the deciding atom of the node over all samples.
        settled: path to the atom that settled the cause or the verdict, at that time.
    """

    verdict: Verdict
    certain_ns: int | None
    numbers: tuple[float, ...]
    cause: int | None
    path: _Path
    settled: _Path

    def difference(self, other: _Decision | None) -> str:
        """Return a verb phrase for the difference of another decision from this one."""
        if other is None:
            return "has no sample"
        if self.verdict is not other.verdict:
            return f"is {other.verdict}"
        if self.numbers != other.numbers:
            return "has another robustness"
        return "is certain at another time" if self.certain_ns != other.certain_ns else "has another reason"


class _Part:
    """Node of a result that can be evaluated over any window of its samples."""

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
            column = trace.names.index(result.object)
            self._seen_ns = trace.times_ns[trace.rows[:, column] != ABSENT]
        self._decision = self._decide(result, self._leaves)
        # of several events at one time, the last entry is shown
        self._moments = {
            self._decision.settled.decided_ns: f", where `{kept.title}` was settled",
            self._decision.path.decided_ns: f", where the robustness of `{kept.title}` is decided",
        }
        if self._decision.certain_ns is not None:
            certain = f", where `{kept.title}` became {self._decision.verdict} for certain"
            self._moments[self._decision.certain_ns] = certain
        self.span_ns = min(self._moments), max(self._moments)
        self._title = kept.title

    def moment(self, time_ns: int) -> str | None:
        """Return the event at a deciding time as a clause; None at other times."""
        return self._moments.get(time_ns)

    def holds_over(self, start_ns: int, end_ns: int) -> bool:
        """Return whether the decision is the same over the samples between two times, both included."""
        return self._decision_over(start_ns, end_ns) == self._decision

    def change_over(self, start_ns: int, end_ns: int) -> str | None:
        """Return the change over the samples between two times as a clause; None without a change."""
        decision = self._decision_over(start_ns, end_ns)
        if decision == self._decision:
            return None
        return f": in a shorter clip `{self._title}` {self._decision.difference(decision)}"

    def _decision_over(self, start_ns: int, end_ns: int) -> _Decision | None:
        """Return the decision over the samples between two times; None without a sample."""
        if self._seen_ns is not None:
            begin, end = window_of(self._seen_ns, start_ns, end_ns + 1)
            if begin == end:
                return None
            start_ns, end_ns = self._seen_ns[[begin, end - 1]].tolist()
        begin, end = window_of(self._times_ns, start_ns, end_ns + 1)
        if begin == end:
            return None
        leaves = self._within(begin, end, start_ns)
        stream = InstanceStream(self._result.evidence.instance)
        block = stream.extend_leaves(leaves, self._times_ns[begin:end])
        result = SpecResult.from_stream(stream, self._result.evidence, block)
        return self._decide(result, leaves)

    def _within(self, begin: int, end: int, first_ns: int) -> Floats:
        """Return the leaves that a log of the window alone has; nothing is known before its start."""
        leaves = np.ascontiguousarray(self._leaves[:, :, begin:end])
        samples, duration_ns, to_reports = self._reach
        if self._trace is None or not self._reach:
            return leaves
        times_ns = self._times_ns[begin:end]
        count = max(samples, to_reports, int(np.searchsorted(times_ns, first_ns + duration_ns)))
        if to_reports and (self._trace.reported_ns is not None or self._trace.signals_reported_ns):
            # a rate reads the last two reports: up to the second report in the window, one is from before it
            count = len(times_ns)
        from_, to = window_of(self._trace.times_ns, int(times_ns[0]), int(times_ns[-1]) + 1)
        head = self._trace.slice(from_, min(from_ + count, to))
        if not len(head):
            return leaves
        instance = self._result.evidence.instance
        head_leaves = leaf_values(TraceScene(head, self._regions), self._order, instance.bindings)
        channels = max(len(head_leaves), len(leaves))
        leaves = np.array(in_channels(leaves, channels))
        leaves[:, :, : len(head)] = in_channels(head_leaves, channels)
        return leaves

    def _decide(self, result: SpecResult, leaves: Floats) -> _Decision:
        """Return the verdict over the samples of a result with given leaves, and its reason."""
        times_ns, certain_ns = result.times_ns, result.certain_ns(self._node)
        cause = result.first_cause(self._node)
        part, settled_ns = (self._node, certain_ns) if cause is None else (cause.node, cause.settled_ns)
        evaluation = evaluate_offline(result.formula, self._order, leaves, times_ns)
        path = _path(evaluation, self._node)
        if settled_ns is None:
            settled = _path(evaluation, part)
        else:
            count = int(np.searchsorted(times_ns, settled_ns, side="right"))
            first = evaluate_prefix(result.formula, self._order, leaves[:, :, :count], times_ns[:count])
            settled = _path(first, part)
        numbers = (*_deciding_numbers(evaluation, self._node), *_deciding_numbers(evaluation, part))
        verdict = final_verdict(*evaluation.interval(self._node))
        return _Decision(verdict, certain_ns, numbers, None if cause is None else part, path, settled)


def _deciding_numbers(done: OfflineNodes, node: int) -> tuple[float, ...]:
    """Return the deciding ends of a node's interval and nominal interval; none if the verdict is open."""
    end = End.of(final_verdict(*done.interval(node)))
    if end is End.OPEN:
        return ()
    which = int(end is End.HIGH)
    return done.interval(node)[which], done.interval(node, wide=False)[which]


def _path(done: OfflineNodes, node: int) -> _Path:
    end = End.of(final_verdict(*done.interval(node)))
    path = deciding_path(done, node, end)
    last = path.steps[-1]
    return _Path(
        tuple(step.node for step in path.steps),
        int(done.times_ns[last.sample]),
        done.interval(last.node, last.sample),
        missed_response(path, done)[0] if end is End.HIGH else None,
    )


class ClipSearch:
    """Search for the window of a clip: outwards from the deciding samples, then inwards from both ends."""

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        options: ReplayOptions,
        kept: Sequence[KeptNode],
        around_ns: int,
    ) -> None:
        results = [node.result for node in kept]
        needs_samples = any(result.object is not None or look_back([result.formula]) for result in results)
        # only delayed terms and objects that come and go need samples, which take time to read
        trace = Selection(source, files, options).trace() if needs_samples else None
        self._parts = []
        for node in kept:
            if len(node.result.times_ns):
                file = file_of(files, node.result)
                self._parts.append(_Part(node, trace, {} if file is None else file.regions))
        self._times_ns = _join_times([result.times_ns for result in results])
        first_ns = min(part.span_ns[0] for part in self._parts) - around_ns
        last_ns = max(part.span_ns[1] for part in self._parts) + around_ns
        last = len(self._times_ns) - 1
        self._inner = (
            int(np.searchsorted(self._times_ns, first_ns)),
            min(last, int(np.searchsorted(self._times_ns, last_ns, side="right")) - 1),
        )
        self._around_ns = around_ns
        self._known: dict[tuple[int, int], bool] = {}

    def reasons(self, start_ns: int, end_ns: int) -> Iterator[Sentence]:
        """Yield sentences on why the window cannot begin later or end earlier; times count from 0."""
        first, last = np.searchsorted(self._times_ns, [start_ns, end_ns]).tolist()
        for verb, at, shorter in (("begins", first, (first + 1, last)), ("ends", last, (first, last - 1))):
            time_ns = int(self._times_ns[at])
            moments = (part.moment(time_ns) for part in self._parts)
            window = [int(self._times_ns[place]) for place in shorter] if first < last else []
            changes = (part.change_over(*window) for part in self._parts if window)
            reason = next(filter(None, (*moments, *changes)), None)
            is_border = at in (0, len(self._times_ns) - 1)
            if reason is None and self._around_ns and at in self._inner and not is_border:
                reason = f", {format_duration(self._around_ns)} from the samples that decide, by --around"
            if window and reason is not None:
                yield Sentence(f"it {verb} at ", Instant(time_ns, 0), reason)

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
        """Widen the window in doubling steps until it has the results, because small windows cost least."""
        low, high = self._inner
        last, step = len(self._times_ns) - 1, 0
        while True:
            window = max(low - step, 0), min(high + step, last)
            if window == (0, last) or self._holds(*window):
                return window
            step = max(2 * step, 1)

    def _cut(self, outer: int, inner: int, holds: Callable[[int], bool]) -> int:
        """Return the end of the shortest window that still has the results, between two ends.

        The window with the outer end has them. The search starts inside, because long windows cost most.
        """
        if inner == outer or holds(inner):
            return inner
        towards = 1 if outer > inner else -1
        return last_that_holds(inner, outer - towards, lambda at: not holds(at)) + towards

    def _holds(self, first: int, last: int) -> bool:
        """Return whether a window has every result for the same reason."""
        if (first, last) not in self._known:
            times = int(self._times_ns[first]), int(self._times_ns[last])
            self._known[first, last] = all(part.holds_over(*times) for part in self._parts)
        return self._known[first, last]


def _join_times(times_ns: Sequence[Integers]) -> Integers:
    first = times_ns[0]
    # times are compared, not lengths: objects that appear one after another can have equally many samples
    if all(np.array_equal(sample_times, first) for sample_times in times_ns):
        return first
    return np.unique(np.concatenate(times_ns))


@dataclass(frozen=True, eq=False)
class Clip:
    """Written clip.

    Attributes:
        whole, replayed: replay of the log without a certificate, and replay of the clip.
        start_ns, end_ns: times of the first and the last sample of the clip.
        kept: titles of results, and names of specs in them, with the same decision as in the log.
        source_bytes, clip_bytes: sizes of the files; `source_bytes` is None if the log is not a single file.
        reasons: sentences on why the clip cannot begin later or end earlier.
    """

    whole: Replayed
    replayed: Replayed
    start_ns: int
    end_ns: int
    kept: tuple[str, ...]
    source_bytes: int | None
    clip_bytes: int
    reasons: tuple[Sentence, ...] = ()

    @property
    def left_out(self) -> tuple[str, ...]:
        """Titles of results without a kept node, in the order of the log."""
        kept_names = {*self.kept}
        return tuple(
            result.title
            for result in self.whole.results
            if kept_names.isdisjoint({result.title, *(node.name for node in result.nodes if node.name)})
        )

    @property
    def is_whole(self) -> bool:
        """Whether the clip has all samples, because no smaller part has the same verdict and witness."""
        return self.replayed.samples == self.whole.samples

    @property
    def changed(self) -> tuple[str, ...]:
        """Titles of results with another verdict than in the log; kept results are not among them."""
        verdicts = {result.title: result.verdict for result in self.whole.results}
        return tuple(
            result.title
            for result in self.replayed.results
            if verdicts.get(result.title) is not result.verdict
        )

    @property
    def added(self) -> tuple[str, ...]:
        """Named parts that fail in the clip but not in the log, in results with an unchanged verdict."""
        results = {result.title: result for result in self.whole.results}
        parts = (
            cause.spec
            for result in self.replayed.results
            if result.title not in self.changed
            for cause in result.causes
            if cause.spec not in {cause.spec for cause in results[result.title].causes}
        )
        return tuple(dict.fromkeys(parts))


def cut_clip(
    source: Source,
    files: Sequence[Specification],
    output: Path,
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    around_ns: int = 0,
    of: Sequence[str] = (),
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> Clip:
    """Write the smallest part of a log that has its verdicts, robustness and witnesses.

    If either end is cut by one more sample, or by any power of two of samples, a result changes. The clip has
    all messages in its window. It also has the last message of each topic, and the last transform of each
    frame, before the window. Times do not change.

    Args:
        options: options of the evaluation; `keep` selects the topics.
        around_ns: least time that is kept before and after the deciding samples.
        of: names of the specs to keep; by default the violated results, or all if none is violated.
        inputs: files that the output must not overwrite.

    Raises:
        UsageError: an unknown spec, an option that clips do not support, or an output that is an input.
        LogError: the log has no sample.
        OutputError: the output cannot be written.
    """
    if options.window.every != 1:
        raise UsageError("a clip keeps every sample; leave out --every")
    require_ltlf(options.semantics, "a clip")
    # the first pass only evaluates, so it copies no messages
    first_pass = replace(options, keep=())
    whole = Replay(source, files, first_pass, keep_leaves=True, certify=False).run(advance=advance)
    nodes = chosen_nodes(whole.results, of)
    search = ClipSearch(source, files, first_pass, nodes, around_ns)
    start_ns, end_ns = search.window()
    keep = KEEP_ALL if options.keep is None else options.keep
    about = {
        "source": source.name,
        "samples": str(whole.samples),
        "start_ns": str(start_ns),
        "end_ns": str(end_ns),
        ZERO: str(whole.first_ns),
        "keep": json.dumps(list(keep)),
        "kept": ", ".join(node.title for node in nodes),
    }
    clipped = clipped_source(source, about)
    replayed = run_replay(
        clipped,
        files,
        replace(options, window=Window(), keep=None),
        keep_leaves=True,
        output=output,
        inputs=inputs,
    )
    return Clip(
        whole,
        replayed,
        start_ns,
        end_ns,
        tuple(node.title for node in nodes),
        _size_of(source),
        output.stat().st_size,
        counted_from(search.reasons(start_ns, end_ns), whole.first_ns),
    )


def _size_of(source: Source) -> int | None:
    """Return the size of a log that is a single file; None for other logs."""
    path = source.path
    if isinstance(path, RemoteFile):
        return path.size
    return path.stat().st_size if isinstance(path, Path) and path.is_file() else None

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
    """Node whose verdict a clip keeps: its result, its id in the result's tree, and its title."""

    result: SpecResult
    node: int
    title: str


def chosen_nodes(results: Sequence[SpecResult], of: Sequence[str]) -> list[KeptNode]:
    """Return the results and named specs in `of`.

    Without names, these are the violated results. If no result is violated, these are all results.

    Raises:
        UsageError: a name that no result or spec has.
    """
    if not of:
        violated_results = [result for result in results if result.verdict is Verdict.VIOLATED]
        return [KeptNode(result, 0, result.title) for result in violated_results or results]
    kept_nodes, spec_names = [], dict[str, None]()
    for result in results:
        # in reverse, so that the first of several nodes with one name remains
        ids_by_name = {node.name: node.id for node in reversed(result.nodes) if node.name is not None}
        spec_names |= dict.fromkeys([result.title, *ids_by_name])
        if result.title in of or result.name in of:
            kept_nodes.append(KeptNode(result, 0, result.title))
        kept_nodes += [KeptNode(result, ids_by_name[name], name) for name in of if ids_by_name.get(name)]
    for name in of:
        if name not in spec_names and all(name != result.name for result in results):
            hint = nearest_hint(name, spec_names) or f"there are {', '.join(spec_names)}"
            raise UsageError(f"no spec is named {name!r}; {hint}")
    return kept_nodes


class _Path(NamedTuple):
    """Path from a node to its deciding atom.

    Attributes:
        nodes: ids of the nodes on the path.
        decided_ns: time of the deciding sample.
        number: robustness interval of the last node at the deciding sample.
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
            cause. Other ends are left out, because samples that decide nothing can make these ends unknown.
        cause: id of the part that failed first, or None.
        path: path to the deciding atom of the node over all samples.
        settled: path from the cause to the deciding atom, over the samples until the cause was settled.
            Without a cause, the path begins at the node.
    """

    verdict: Verdict
    certain_ns: int | None
    numbers: tuple[float, ...]
    cause: int | None
    path: _Path
    settled: _Path

    def difference(self, other: _Decision | None) -> str:
        """Return a verb phrase on the first property in which another decision differs."""
        if other is None:
            return "has no sample"
        if self.verdict is not other.verdict:
            return f"is {other.verdict}"
        if self.numbers != other.numbers:
            return "has another robustness"
        return "is certain at another time" if self.certain_ns != other.certain_ns else "has another reason"


class _Part:
    """Node of a result that can be evaluated over any window of the result's samples."""

    def __init__(self, kept_node: KeptNode, trace: Trace | None, regions: Mapping[str, Outline]) -> None:
        result = kept_node.result
        if result.leaves is None:
            raise UsageError("a clip needs the leaves of every sample, which were not stored")
        self._result, self._node = result, kept_node.node
        self._leaves, self._times_ns = result.leaves, result.times_ns
        self._leaf_order = result.evidence.instance.program.leaves
        self._trace, self._regions = trace, regions
        self._look_back = look_back([result.formula])
        # an instance lasts from the first to the last appearance of its object
        self._object_times_ns: Integers | None = None
        if result.object is not None and trace is not None:
            object_column = trace.names.index(result.object)
            self._object_times_ns = trace.times_ns[trace.rows[:, object_column] != ABSENT]
        self._decision = self._decide(result, self._leaves)
        # if several events have the same time, the last entry is shown
        self._moment_clauses = {
            self._decision.settled.decided_ns: f", where `{kept_node.title}` was settled",
            self._decision.path.decided_ns: f", where the robustness of `{kept_node.title}` is decided",
        }
        if self._decision.certain_ns is not None:
            certain_clause = f", where `{kept_node.title}` became {self._decision.verdict} for certain"
            self._moment_clauses[self._decision.certain_ns] = certain_clause
        self.span_ns = min(self._moment_clauses), max(self._moment_clauses)
        self._title = kept_node.title

    def moment(self, time_ns: int) -> str | None:
        """Return the event at a deciding time as a clause; None at other times."""
        return self._moment_clauses.get(time_ns)

    def holds_over(self, start_ns: int, end_ns: int) -> bool:
        """Return whether the samples between two times, inclusive, have the decision of the whole log."""
        return self._decision_over(start_ns, end_ns) == self._decision

    def change_over(self, start_ns: int, end_ns: int) -> str | None:
        """Return a clause on the decision over the samples between two times; None if it is unchanged."""
        decision = self._decision_over(start_ns, end_ns)
        if decision == self._decision:
            return None
        return f": in a shorter clip `{self._title}` {self._decision.difference(decision)}"

    def _decision_over(self, start_ns: int, end_ns: int) -> _Decision | None:
        """Return the decision over the samples between two times; None without a sample."""
        if self._object_times_ns is not None:
            begin_index, end_index = window_of(self._object_times_ns, start_ns, end_ns + 1)
            if begin_index == end_index:
                return None
            start_ns, end_ns = self._object_times_ns[[begin_index, end_index - 1]].tolist()
        begin_index, end_index = window_of(self._times_ns, start_ns, end_ns + 1)
        if begin_index == end_index:
            return None
        leaves = self._within(begin_index, end_index, start_ns)
        stream = InstanceStream(self._result.evidence.instance)
        block = stream.extend_leaves(leaves, self._times_ns[begin_index:end_index])
        result = SpecResult.from_stream(stream, self._result.evidence, block)
        return self._decide(result, leaves)

    def _within(self, begin_index: int, end_index: int, start_ns: int) -> Floats:
        """Return the leaves that the window's samples have in a log that begins at `start_ns`."""
        leaves = np.ascontiguousarray(self._leaves[:, :, begin_index:end_index])
        delay_samples, delay_ns, has_report_delay = self._look_back
        if self._trace is None or not self._look_back:
            return leaves
        times_ns = self._times_ns[begin_index:end_index]
        head_length = max(
            delay_samples, has_report_delay, int(np.searchsorted(times_ns, start_ns + delay_ns))
        )
        if has_report_delay and (self._trace.reported_ns is not None or self._trace.signals_reported_ns):
            # a rate needs two reports; up to the window's second report, the earlier one is before the window
            head_length = len(times_ns)
        trace_begin, trace_end = window_of(self._trace.times_ns, int(times_ns[0]), int(times_ns[-1]) + 1)
        head_trace = self._trace.slice(trace_begin, min(trace_begin + head_length, trace_end))
        if not len(head_trace):
            return leaves
        instance = self._result.evidence.instance
        head_leaves = leaf_values(TraceScene(head_trace, self._regions), self._leaf_order, instance.bindings)
        channel_count = max(len(head_leaves), len(leaves))
        leaves = np.array(in_channels(leaves, channel_count))
        leaves[:, :, : len(head_trace)] = in_channels(head_leaves, channel_count)
        return leaves

    def _decide(self, result: SpecResult, leaves: Floats) -> _Decision:
        """Return the verdict of the node and its reason, from a result and the result's leaves."""
        times_ns, certain_ns = result.times_ns, result.certain_ns(self._node)
        cause = result.first_cause(self._node)
        deciding_node, settled_ns = (
            (self._node, certain_ns) if cause is None else (cause.node, cause.settled_ns)
        )
        evaluation = evaluate_offline(result.formula, self._leaf_order, leaves, times_ns)
        path = _path(evaluation, self._node)
        if settled_ns is None:
            settled_path = _path(evaluation, deciding_node)
        else:
            prefix_length = int(np.searchsorted(times_ns, settled_ns, side="right"))
            prefix_evaluation = evaluate_prefix(
                result.formula, self._leaf_order, leaves[:, :, :prefix_length], times_ns[:prefix_length]
            )
            settled_path = _path(prefix_evaluation, deciding_node)
        numbers = (*_deciding_numbers(evaluation, self._node), *_deciding_numbers(evaluation, deciding_node))
        verdict = final_verdict(*evaluation.interval(self._node))
        return _Decision(
            verdict, certain_ns, numbers, None if cause is None else deciding_node, path, settled_path
        )


def _deciding_numbers(evaluation: OfflineNodes, node: int) -> tuple[float, ...]:
    """Return the deciding ends of a node's interval and nominal interval; () if the verdict is open."""
    deciding_end = End.of(final_verdict(*evaluation.interval(node)))
    if deciding_end is End.OPEN:
        return ()
    end_index = int(deciding_end is End.HIGH)
    return evaluation.interval(node)[end_index], evaluation.interval(node, wide=False)[end_index]


def _path(evaluation: OfflineNodes, node: int) -> _Path:
    deciding_end = End.of(final_verdict(*evaluation.interval(node)))
    path = deciding_path(evaluation, node, deciding_end)
    last_step = path.steps[-1]
    return _Path(
        tuple(step.node for step in path.steps),
        int(evaluation.times_ns[last_step.sample]),
        evaluation.interval(last_step.node, last_step.sample),
        missed_response(path, evaluation)[0] if deciding_end is End.HIGH else None,
    )


class ClipSearch:
    """Search for a clip's window. It grows from the deciding samples, and then shrinks from both ends."""

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        options: ReplayOptions,
        kept: Sequence[KeptNode],
        around_ns: int,
    ) -> None:
        results = [kept_node.result for kept_node in kept]
        needs_samples = any(result.object is not None or look_back([result.formula]) for result in results)
        # only delayed terms and objects that come and go need samples, which take time to read
        trace = Selection(source, files, options).trace() if needs_samples else None
        self._parts = []
        for kept_node in kept:
            if len(kept_node.result.times_ns):
                file = file_of(files, kept_node.result)
                self._parts.append(_Part(kept_node, trace, {} if file is None else file.regions))
        self._times_ns = _join_times([result.times_ns for result in results])
        inner_start_ns = min(part.span_ns[0] for part in self._parts) - around_ns
        inner_end_ns = max(part.span_ns[1] for part in self._parts) + around_ns
        last_index = len(self._times_ns) - 1
        self._inner_window = (
            int(np.searchsorted(self._times_ns, inner_start_ns)),
            min(last_index, int(np.searchsorted(self._times_ns, inner_end_ns, side="right")) - 1),
        )
        self._around_ns = around_ns
        self._known_windows: dict[tuple[int, int], bool] = {}

    def reasons(self, start_ns: int, end_ns: int) -> Iterator[Sentence]:
        """Yield sentences on why the window cannot begin later or end earlier; times are absolute."""
        first_index, last_index = np.searchsorted(self._times_ns, [start_ns, end_ns]).tolist()
        for verb, edge_index, shorter_window in (
            ("begins", first_index, (first_index + 1, last_index)),
            ("ends", last_index, (first_index, last_index - 1)),
        ):
            time_ns = int(self._times_ns[edge_index])
            moment_clauses = (part.moment(time_ns) for part in self._parts)
            window_ns = (
                [int(self._times_ns[index]) for index in shorter_window] if first_index < last_index else []
            )
            change_clauses = (part.change_over(*window_ns) for part in self._parts if window_ns)
            reason = next(filter(None, (*moment_clauses, *change_clauses)), None)
            is_log_end = edge_index in (0, len(self._times_ns) - 1)
            if reason is None and self._around_ns and edge_index in self._inner_window and not is_log_end:
                reason = f", {format_duration(self._around_ns)} from the samples that decide, by --around"
            if window_ns and reason is not None:
                yield Sentence(f"it {verb} at ", Instant(time_ns, 0), reason)

    def window(self) -> tuple[int, int]:
        """Return the times of the first and the last sample of the clip."""
        first_index, last_index = self._outwards()
        while True:
            cut_first = self._cut(first_index, self._inner_window[0], partial(self._holds, last=last_index))
            cut_last = self._cut(last_index, self._inner_window[1], partial(self._holds, cut_first))
            if (cut_first, cut_last) == (first_index, last_index):
                return int(self._times_ns[first_index]), int(self._times_ns[last_index])
            first_index, last_index = cut_first, cut_last

    def _outwards(self) -> tuple[int, int]:
        """Widen the window in doubling steps until it has the same decisions. Small windows cost least."""
        inner_first, inner_last = self._inner_window
        last_index, margin_samples = len(self._times_ns) - 1, 0
        while True:
            window = max(inner_first - margin_samples, 0), min(inner_last + margin_samples, last_index)
            if window == (0, last_index) or self._holds(*window):
                return window
            margin_samples = max(2 * margin_samples, 1)

    def _cut(self, outer_index: int, inner_index: int, holds: Callable[[int], bool]) -> int:
        """Return the end of the shortest window with the same decisions, between an inner and an outer end.

        The window up to the outer end has these decisions. The search starts at the inner end, because long
        windows cost most.
        """
        if inner_index == outer_index or holds(inner_index):
            return inner_index
        direction = 1 if outer_index > inner_index else -1
        return last_that_holds(inner_index, outer_index - direction, lambda at: not holds(at)) + direction

    def _holds(self, first: int, last: int) -> bool:
        """Return whether all decisions are unchanged over a window, given by sample indices."""
        if (first, last) not in self._known_windows:
            window_ns = int(self._times_ns[first]), int(self._times_ns[last])
            self._known_windows[first, last] = all(part.holds_over(*window_ns) for part in self._parts)
        return self._known_windows[first, last]


def _join_times(times_ns: Sequence[Integers]) -> Integers:
    first_times_ns = times_ns[0]
    # times are compared, because objects that appear one after another can have equally many samples
    if all(np.array_equal(result_times_ns, first_times_ns) for result_times_ns in times_ns):
        return first_times_ns
    return np.unique(np.concatenate(times_ns))


@dataclass(frozen=True, eq=False)
class Clip:
    """A clip and the log that it was cut from.

    Attributes:
        whole: replay of the log, without a certificate.
        replayed: replay of the clip.
        start_ns, end_ns: times of the first and the last sample of the clip.
        kept: titles of the results and names of the specs that have the same decision as in the log.
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
        """Titles of results whose verdict differs from the log. Kept results never differ."""
        verdicts = {result.title: result.verdict for result in self.whole.results}
        return tuple(
            result.title
            for result in self.replayed.results
            if verdicts.get(result.title) is not result.verdict
        )

    @property
    def added(self) -> tuple[str, ...]:
        """Names of parts that fail only in the clip. Results with a changed verdict are left out."""
        results = {result.title: result for result in self.whole.results}
        part_names = (
            cause.spec
            for result in self.replayed.results
            if result.title not in self.changed
            for cause in result.causes
            if cause.spec not in {cause.spec for cause in results[result.title].causes}
        )
        return tuple(dict.fromkeys(part_names))


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
    """Write the smallest part of a log that has the log's verdicts, robustness and witnesses.

    If either end loses one more sample, a result changes. The clip has all messages in its window. From
    before the window, it has the last message of each topic, and the last transform of each frame. Times do
    not change.

    Args:
        options: options of the evaluation; `keep` selects the topics.
        around_ns: least duration that is kept before and after the deciding samples, ns.
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
    first_options = replace(options, keep=())
    log_replay = Replay(source, files, first_options, keep_leaves=True, certify=False).run(advance=advance)
    kept_nodes = chosen_nodes(log_replay.results, of)
    search = ClipSearch(source, files, first_options, kept_nodes, around_ns)
    start_ns, end_ns = search.window()
    kept_topics = KEEP_ALL if options.keep is None else options.keep
    clip_record = {
        "source": source.name,
        "samples": str(log_replay.samples),
        "start_ns": str(start_ns),
        "end_ns": str(end_ns),
        ZERO: str(log_replay.first_ns),
        "keep": json.dumps(list(kept_topics)),
        "kept": ", ".join(kept_node.title for kept_node in kept_nodes),
    }
    clip_source = clipped_source(source, clip_record)
    clip_replay = run_replay(
        clip_source,
        files,
        replace(options, window=Window(), keep=None),
        keep_leaves=True,
        output=output,
        inputs=inputs,
    )
    return Clip(
        log_replay,
        clip_replay,
        start_ns,
        end_ns,
        tuple(kept_node.title for kept_node in kept_nodes),
        _size_of(source),
        output.stat().st_size,
        counted_from(search.reasons(start_ns, end_ns), log_replay.first_ns),
    )


def _size_of(source: Source) -> int | None:
    """Return the size of a log's file, bytes; None if the log is not a single file."""
    path = source.path
    if isinstance(path, RemoteFile):
        return path.size
    return path.stat().st_size if isinstance(path, Path) and path.is_file() else None

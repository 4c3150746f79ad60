"""Evaluate specifications over a recorded run, and write its annotated log."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from spatial_replay.annotate.certificate import EvaluationHashes, specifications_json
from spatial_replay.annotate.evaluation import AnnotatedEvaluation
from spatial_replay.annotate.specification import (
    ReportedTree,
    logged_specifications,
    specification_attachments,
)
from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.logs.mcap.read import McapSource
from spatial_replay.logs.messages import Attachment, Block, Messages, Sink, merge
from spatial_replay.logs.source import Source, read_ahead
from spatial_replay.logs.topics import (
    AUTOMATA,
    AUTOMATA_PREFIX,
    CERTIFICATE,
    DOUBTS,
    ENDING,
    LAYOUT,
    METADATA,
    PLAN_METADATA,
    RECORDED_PREFIX,
    REPLAYED_PREFIX,
    VERDICTS,
    ZERO,
    image_topics,
)
from spatial_replay.monitor.departures import Departure, Departures
from spatial_replay.monitor.doubtful import doubts_of_instances
from spatial_replay.monitor.heights import HeightComparisons
from spatial_replay.monitor.result import SpecResult, worst_first
from spatial_replay.monitor.sentences import verdict_text
from spatial_replay.monitor.stillness import Stillness
from spatial_replay.monitor.stream import Instance, InstanceStream, SeriesBlock, join_blocks
from spatial_replay.monitor.vacuity import UntestedPart, idle_templates
from spatial_replay.monitor.verdict import Semantics, Verdict, worst_verdict
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.replay.selection import (
    DEFAULT_OPTIONS,
    KEEP_ALL,
    LogNames,
    ReplayOptions,
    Selection,
    Window,
    default_keep,
    first_message_ns,
    log_zero_ns,
)
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.format import format_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import SpecificationText, load_specifications, parse_specification
from spatial_replay.text import Instant, Sentence, counted_from, plural
from spatial_replay.trace.doubts import Doubt, distinct_doubts, metadata_from_doubts
from spatial_replay.trace.trace import FOREVER, LATEST_NS, LONG_PAUSE, Trace
from spatial_replay.version import __version__

if TYPE_CHECKING:
    from spatial_replay.annotate.automaton_state import SpecAutomaton
    from spatial_replay.annotate.scene.scene_frames import SceneFrames


_MOST_DIGITS = 18
"""Maximum number of digits of a count in a log's metadata."""
_KEPT_BYTES, _MOST_KEPT_BYTES = 2**22, 2**26
"""Limits of the samples kept in memory for explanations, bytes: per result and in total."""
_SAMPLES_AT_ONCE, _RESULTS_AT_ONCE = 2**12, 2**16
"""Limits of messages that are written together, some 30 MB: samples, and samples times results.

Small parts reuse the memory of earlier messages. Filling new memory from the system takes twice as long.
"""


@dataclass(frozen=True, slots=True)
class Dropped:
    """Samples that a recorder dropped.

    Attributes:
        count: number of dropped samples.
        of: number of all samples, dropped samples included.
        was_interrupted: whether the recording was interrupted.
    """

    count: int
    of: int
    was_interrupted: bool = False

    @property
    def text(self) -> str:
        """A sentence on the dropped samples; "" if no sample was dropped."""
        return f"the recorder dropped {self.count:,} of {plural(self.of, 'sample')}" if self.count else ""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on dropped samples and on an interruption."""
        ended = "the recording was interrupted" if self.was_interrupted else ""
        return tuple(filter(None, (self.text, ended)))


@dataclass(frozen=True, eq=False)
class Replayed:
    """The results of a replay.

    Attributes:
        log: base name of the log.
        samples: number of evaluated samples, without the samples that fill pauses.
        first_ns: zero of times in texts: the log's first sample (evaluated or not), or the zero that a cut
            log records.
        start_ns, end_ns: times of the first and the last evaluated sample.
        faults: losses while reading, each with its place.
        remarks: remarks on the samples, without the losses in `faults`; doubts come first.
        missing: a warning for each name that the log lacks; objects and signals of these names are unknown.
        dropped: samples that the recorder dropped.
        unreadable: number of observations without a usable value: not finite, or too old.
        results: one result per spec, or per object of a template.
        vacuous: templates without instances. Other parts that decided nothing are in `vacuous` of their
            result.
        certificate: hashes of inputs and results; empty unless requested.
        semantics: the semantics of the formulas.
        left: absences near a threshold, of group members and of objects in `present` (see `Departures`).
            `remarks` has sentences on these absences, too.
        doubts: assumptions that the log contradicts; each result has the doubts about its own assumptions.
    """

    log: str
    samples: int
    first_ns: int
    start_ns: int
    end_ns: int
    faults: tuple[str, ...]
    remarks: tuple[str, ...]
    missing: tuple[Diagnostic, ...]
    dropped: Dropped
    unreadable: int
    results: tuple[SpecResult, ...]
    vacuous: tuple[UntestedPart, ...]
    certificate: Mapping[str, str]
    semantics: Semantics = "ltlf"
    left: tuple[Departure, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    @property
    def verdict(self) -> Verdict:
        return worst_verdict(result.verdict for result in self.results)


@dataclass(frozen=True, eq=False)
class ReplayPlan:
    """Specifications prepared for logs with the same units.

    Attributes:
        files: the specifications, as an annotated log stores them.
        instances: instances of the specs in each file.
        departures: empty collector of departures for each file.
        heights: empty counter of height comparisons for all files.
    """

    files: Sequence[Specification]
    instances: Sequence[Sequence[Instance]]
    departures: Sequence[Departures]
    heights: HeightComparisons

    @classmethod
    def of(cls, selection: Selection) -> ReplayPlan:
        """Prepare the specifications of a selection. Templates read the log once to find their objects.

        Raises:
            UsageError: the objects of a template are not given.
        """
        units = selection.source.axes.units
        files = logged_specifications(selection.files, units)
        instances = [selection.instances(file) for file in files]
        departures = [
            Departures(instances_of_file, file.regions, units.get("", ""))
            for instances_of_file, file in zip(instances, files, strict=True)
        ]
        return cls(files, instances, departures, HeightComparisons(files))


class LogAccount:
    """Collects names, losses, remarks and doubts of a log, block by block.

    Attributes:
        samples: number of evaluated samples, without the samples that fill pauses.
    """

    def __init__(self, plan: ReplayPlan) -> None:
        """Start before the first sample."""
        self.samples = 0
        self._unreadable = 0
        self._times_ns: list[int] = []
        self._faults: list[str] = []
        self._remarks: list[str] = []
        self._doubts: list[Doubt] = []
        self._names = LogNames()
        self._stillness = Stillness()
        self._heights = plan.heights.restart()
        self._departures = [departures.restart() for departures in plan.departures]

    def add(self, block: Block, trace: Trace) -> None:
        """Add the next block and its evaluated samples."""
        self._remarks += block.remarks
        self._doubts += block.doubts
        self._faults += trace.faults
        self._names.add(trace)
        self._stillness.add(trace)
        self._heights.add(trace)
        for departures in self._departures:
            departures.add(trace)
        samples = trace.without_filling()
        self.samples += len(samples)
        self._unreadable += samples.unreadable_count
        if len(trace):
            self._times_ns = [*self._times_ns[:1], int(trace.times_ns[0]), int(trace.times_ns[-1])]

    def check_samples(self, selection: Selection) -> None:
        """Check that a sample was evaluated.

        Raises:
            LogError, UsageError: no sample was evaluated.
        """
        if not self.samples:
            raise selection.nothing_to_evaluate(self._faults)

    def doubts(self, first_ns: int) -> tuple[Doubt, ...]:
        """Return the doubts about the log. Times in their sentences are relative to `first_ns`."""
        return distinct_doubts(self._doubts, first_ns)

    def summary(
        self,
        selection: Selection,
        first_ns: int,
        results: Sequence[SpecResult],
        certificate: Mapping[str, str] = MappingProxyType({}),
    ) -> Replayed:
        """Return the results together with the collected facts about the log.

        Args:
            first_ns: zero of times in texts.

        Raises:
            SpecificationError: a name is missing, and names are strict.
        """
        missing_names = selection.missing_names(self._names)
        dropped = dropped_samples(selection.source)
        all_departures, doubts = self._departures_by_time(first_ns), self.doubts(first_ns)
        log_name, options = selection.source.name, selection.options
        return Replayed(
            log=log_name,
            samples=self.samples,
            first_ns=first_ns,
            start_ns=self._times_ns[0],
            end_ns=self._times_ns[-1],
            faults=counted_from(self._faults, first_ns),
            remarks=(
                *(doubt.remark(log_name) for doubt in doubts),
                *counted_from(self._remarks, first_ns),
                *dropped.remarks,
                *self._empty_ends(selection.window, first_ns),
                *(departure.message for departure in all_departures),
                *self._stillness.remarks(),
                *counted_from(self._heights.remarks(), first_ns),
            ),
            missing=missing_names,
            dropped=dropped,
            unreadable=self._unreadable,
            results=tuple(results),
            vacuous=idle_templates(
                (spec for file in selection.files for spec in file.results),
                (result.formula for result in results),
                options.each,
                self._names.classes,
            ),
            certificate=certificate,
            semantics=options.semantics,
            left=all_departures,
            doubts=doubts,
        )

    def _departures_by_time(self, first_ns: int) -> tuple[Departure, ...]:
        """Return the distinct departures of objects in all specifications, sorted by time."""
        departure_by_start = {
            (departure.start_ns, departure.name): departure
            for departures in self._departures
            for departure in departures.departures
        }
        return tuple(
            replace(departure, message=counted_from([departure.message], first_ns)[0])
            for _, departure in sorted(departure_by_start.items())
        )

    def _empty_ends(self, window: Window, first_ns: int) -> Iterator[Sentence]:
        """Yield a remark for each end of the window at which the log has no samples."""
        first_sample_ns, last_sample_ns = self._times_ns[0], self._times_ns[-1]
        mean_step_ns = (last_sample_ns - first_sample_ns) / max(self.samples - 1, 1)
        window_start_ns = max(window.start_ns, first_ns) if window.start_ns else first_sample_ns
        for gap_start_ns, gap_end_ns in (
            (window_start_ns, first_sample_ns),
            (last_sample_ns, window.end_ns),
        ):
            if 0 < LONG_PAUSE * mean_step_ns < gap_end_ns - gap_start_ns and gap_end_ns != FOREVER:
                gap_start, gap_end = Instant(gap_start_ns, first_ns), Instant(gap_end_ns, first_ns)
                yield Sentence("the window has no sample from ", gap_start, " to ", gap_end)


class Replay:
    """One evaluation of a source, which returns verdicts and writes messages.

    Attributes:
        files: the specifications, as an annotated log stores them.
        trees: formula tree and reported name of each result.
    """

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        options: ReplayOptions = DEFAULT_OPTIONS,
        *,
        keep_series: bool = False,
        keep_leaves: bool = False,
        certify: bool = True,
        show: Callable[[SceneFrames], None] = lambda frames: None,
    ) -> None:
        """Prepare the evaluation. Templates read the source once to find their objects.

        Args:
            keep_series: whether the robustness of all nodes at each sample is kept in memory.
            keep_leaves: whether the values of all atoms at each sample are kept, for witnesses and signals.
            certify: whether inputs and results are hashed, which takes about as long as the evaluation.
            show: function that receives the frames of the scene.

        Raises:
            UsageError: an option does not fit the specifications: objects or parameters of templates, an
                operator that the semantics lack, or an arrow without a result.
        """
        self._source = source
        self._written_files = files
        self._selection = Selection(source, files, options)
        self._run_ends = self._selection.run_ends()
        plan = ReplayPlan.of(self._selection)
        self.files = plan.files
        self._account = LogAccount(plan)
        self._evaluation = AnnotatedEvaluation(
            plan.files,
            plan.instances,
            options.semantics,
            source.attachments,
            show=show,
            arrow=options.arrow,
            units=source.axes.units,
            plan=plan_of(source),
        )
        self.trees = self._evaluation.trees
        self._keep_series, self._keep_leaves = keep_series, keep_leaves
        self._kept_blocks: list[list[SeriesBlock]] = [[] for _ in self.trees]
        self._hashes = (
            EvaluationHashes([(tree.name, tree.object) for tree in self.trees]) if certify else None
        )
        self._own_topics: set[str] = set()
        self._image_topics: set[str] = set()
        self._encoded_count = self._last_message_ns = 0
        self._first_message_ns, self._is_layer = LATEST_NS, False
        self._zero_ns: int | None = None
        self._traces = _KeptTraces(self._selection, min(_KEPT_BYTES * len(self.trees), _MOST_KEPT_BYTES))

    def run(
        self,
        write: Callable[[Messages], None] | None = None,
        *,
        layer: bool = False,
        begin: Callable[[int], None] = lambda zero_ns: None,
        advance: Callable[[int], None] = lambda samples: None,
    ) -> Replayed:
        """Evaluate the whole source and return the results.

        Args:
            write: function that receives the messages of the annotated log, block by block; None makes no
                messages.
            begin: function that is called before `write` with the zero of times in texts.
            layer: whether the source's own messages are left out.
            advance: function that is called with the number of samples of each evaluated block.

        Raises:
            LogError: the log has no sample.
            UsageError: the window has no sample.
            SpecificationError: a name is missing, and names are strict.
        """
        self._is_layer = layer
        needs_messages = write is not None or self._hashes is not None
        # while the messages of this block are made, a free core evaluates the next block
        for block, trace, stretches in read_ahead(self._evaluate(messages=needs_messages)):
            self._traces.add(trace)
            window_samples = self._selection.inside(trace)
            messages = Messages()
            if needs_messages:
                messages = self._selection.own_messages(block, self._encoded_count)
            self._encoded_count += len(self._selection.inside(block.trace))
            self._account.add(block, window_samples)
            if not layer:
                self._own_topics.update(channel.topic for channel in messages.channels.values())
                self._image_topics |= image_topics(messages.channels.values())
            self._keep(window_samples, messages, stretches)
            if self._zero_ns is None:
                self._zero_ns = log_zero_ns(self._source, self._selection.window, self._run_ends)
                begin(self._zero_ns)
            if write is not None:
                self._evaluation.annotator.count_from(self._zero_ns)
                self._annotate(write, window_samples, stretches, Messages() if layer else messages)
            advance(len(window_samples))
        replayed = self._results()
        if write is not None:
            annotator, finals = self._evaluation.annotator, self._evaluation.finals
            write(merge(annotator.end(self._last_message_ns, finals, replayed.results)))
        return replayed

    def _annotate(
        self,
        write: Callable[[Messages], None],
        trace: Trace,
        stretches: Sequence[SeriesBlock],
        own_messages: Messages,
    ) -> None:
        """Write the messages of a block in parts, because messages of many results are large."""
        part_length = max(1, min(_SAMPLES_AT_ONCE, _RESULTS_AT_ONCE // max(len(stretches), 1)))
        part_begins = range(0, max(len(trace), 1), part_length)
        # the log's own messages may be earlier than its first sample or later than its last sample
        part_starts_ns = [
            -FOREVER,
            *(int(trace.times_ns[begin]) for begin in part_begins[1:]),
            FOREVER,
        ]
        for begin, (start_ns, end_ns) in zip(part_begins, pairwise(part_starts_ns), strict=True):
            part_samples = trace.slice(begin, min(begin + part_length, len(trace)))
            derived_messages = self._evaluation.annotator.messages(*with_stretches(part_samples, stretches))
            messages = merge([*derived_messages, own_messages.within(start_ns, end_ns)])
            self._first_message_ns = min(
                self._first_message_ns, *messages.log_time_ns[:1].tolist(), LATEST_NS
            )
            write(messages)

    def draw_samples(
        self, results: Sequence[SpecResult], times_ns: Sequence[int], show: Callable[[SceneFrames], None]
    ) -> None:
        """Draw the scene at given samples. The annotated log need not have a scene message at these times.

        Args:
            results: results of `run`, with series and leaves.
            times_ns: increasing times of the samples.
            show: function that receives the scene at each time.
        """
        if not times_ns:
            return
        stretches = [
            SeriesBlock(result.times_ns, result.series, result.leaves)
            for result in results
            if result.leaves is not None
        ]
        scene = replace(self._evaluation.annotator.scene, written_ns=None, shown=(), last={})
        annotator = self._evaluation.new_annotator(scene, self._selection.options.arrow, show)
        next_times_ns = deque(times_ns)
        for trace in self._traces.read():
            samples = self._selection.inside(trace)
            while next_times_ns and len(samples) and next_times_ns[0] <= int(samples.times_ns[-1]):
                sample_index = int(np.searchsorted(samples.times_ns, next_times_ns.popleft()))
                annotator.pass_over(*with_stretches(samples.slice(0, sample_index), stretches))
                annotator.draw(*with_stretches(samples.slice(sample_index, sample_index + 1), stretches))
                samples = samples.slice(sample_index + 1, len(samples))
            if not next_times_ns:
                return
            annotator.pass_over(*with_stretches(samples, stretches))

    @property
    def automata(self) -> Sequence[SpecAutomaton]:
        """The automaton of each result in `trees`, or the reason why there is none."""
        return self._evaluation.automata

    def attachments(self) -> list[Attachment]:
        """Return the texts and automata of the specifications, as an annotated log stores them."""
        from spatial_replay.annotate.automaton_state import automata_attachments

        texts = specification_attachments(self.files, REPLAYED_PREFIX)
        return [*texts, *automata_attachments(self.automata, REPLAYED_PREFIX)]

    def layout(self) -> Attachment:
        """Return the viewer layout of the annotated log. It needs a finished `run`."""
        planner_file = planned_for(self._source, self.files)
        return self._evaluation.layout(
            self._own_topics,
            self._source.axes,
            self._image_topics,
            planner_file,
            self._shown_start(),
            planned_result(self._source),
        )

    def _shown_start(self) -> tuple[int, str]:
        """Return the time of the first message that a viewer shows, and the name of the message's log.

        An annotated log without the source's messages is opened next to the source.
        """
        is_bag = self._selection.options.keep == () and not isinstance(self._source, McapSource)
        start_ns = first_message_ns(self._source) if self._is_layer or is_bag else None
        return (self._first_message_ns, "this log") if start_ns is None else (start_ns, self._source.name)

    def _evaluate(self, *, messages: bool) -> Generator[tuple[Block, Trace, list[SeriesBlock]], None, None]:
        with closing(self._selection.read_blocks(messages=messages, ends=self._run_ends)) as blocks:
            for block, trace in blocks:
                yield block, trace, self._evaluation.extend(trace)

    def _keep(self, trace: Trace, messages: Messages, stretches: Sequence[SeriesBlock]) -> None:
        if len(messages):
            self._last_message_ns = max(self._last_message_ns, int(messages.log_time_ns[-1]))
        if self._hashes is not None:
            self._hashes.add_samples(trace, messages)
            self._hashes.add_results(stretches)
        for result_index, stretch in enumerate(stretches):
            if self._keep_series or self._keep_leaves:
                kept_blocks = self._kept_blocks[result_index]
                kept_blocks.append(self._kept_part(stretch))
                # joined arrays are in temporary files: a million samples take 0.25 instead of 0.64 GB
                while len(kept_blocks) > 1 and len(kept_blocks[-2].times_ns) <= len(kept_blocks[-1].times_ns):
                    kept_blocks[-2:] = [join_blocks(kept_blocks[-2:])]

    def _kept_part(self, stretch: SeriesBlock) -> SeriesBlock:
        """Return a stretch with series and leaves, which are empty if they are not kept."""
        series = stretch.series if self._keep_series else np.empty((len(stretch.series), 4, 0))
        leaves = stretch.leaves if self._keep_leaves else np.empty((1, stretch.leaves.shape[1], 0))
        return SeriesBlock(stretch.times_ns, series, leaves)

    def _results(self) -> Replayed:
        self._account.check_samples(self._selection)
        first_ns = self._zero_ns or 0
        doubts = self._account.doubts(first_ns)
        results = replayed_specs(
            self._evaluation.streams,
            self.trees,
            self.files,
            [join_blocks(blocks) if blocks else None for blocks in self._kept_blocks],
            self._traces.read,
            first_ns,
            units=self._evaluation.units,
            has_series=self._keep_series,
            has_leaves=self._keep_leaves,
            doubts=doubts,
        )
        certificate: Mapping[str, str] = {}
        if self._hashes is not None:
            certificate = self._hashes.certificate(
                self._written_files,
                dict(self._source.metadata()).get(PLAN_METADATA),
                (doubt.title for doubt in doubts),
            )
        return self._account.summary(self._selection, first_ns, results, certificate)


def with_stretches(trace: Trace, stretches: Sequence[SeriesBlock]) -> tuple[Trace, list[SeriesBlock]]:
    """Return samples and the part of each stretch at the times of these samples."""
    if not len(trace):
        return trace, [stretch.between(0, 0) for stretch in stretches]
    first_ns, last_ns = trace.times_ns[[0, -1]].tolist()
    return trace, [stretch.between(first_ns, last_ns + 1) for stretch in stretches]


class _KeptTraces:
    """The samples of a short log in memory. Explanations of longer logs read the log again."""

    def __init__(self, selection: Selection, most_bytes: int) -> None:
        self._selection = selection
        self._most_bytes = most_bytes
        self._traces: list[Trace] | None = []
        self._bytes = 0

    def add(self, trace: Trace) -> None:
        """Keep the next samples. Above the limit, all samples are dropped."""
        self._bytes += trace.nbytes
        if self._bytes > self._most_bytes:
            self._traces = None
        elif self._traces is not None:
            self._traces.append(trace)

    def read(self) -> Iterator[Trace]:
        return self._selection.iter_traces() if self._traces is None else iter(self._traces)


def dropped_samples(source: Source) -> Dropped:
    """Return the dropped samples and the interruption of a recording from the log's metadata."""
    ending = dict(source.metadata()).get(ENDING, {})
    count_texts = [ending.get(name, "0") for name in ("samples", "dropped")]
    # the metadata of a log may be any text; 18 digits fit into 64 bits
    written_count, dropped_count = (
        int(text) if text.isascii() and text.isdecimal() and len(text) <= _MOST_DIGITS else 0
        for text in count_texts
    )
    return Dropped(dropped_count, written_count + dropped_count, ending.get("interrupted") == "true")


def replayed_specs(
    streams: Sequence[InstanceStream],
    trees: Sequence[ReportedTree],
    files: Sequence[Specification],
    blocks: Sequence[SeriesBlock | None],
    traces: Callable[[], Iterable[Trace]],
    zero_ns: int,
    *,
    units: Mapping[str, str],
    has_series: bool = True,
    has_leaves: bool = True,
    doubts: Sequence[Doubt] = (),
) -> tuple[SpecResult, ...]:
    """Return the results of streams after the last sample.

    Args:
        trees: formula tree and reported name of each stream.
        blocks: all samples of each stream as one block; None if nothing was kept.
        traces: function that reads the samples again.
        zero_ns: zero of times in sentences.
        units: declared units, see `unit_of`.
        has_series, has_leaves: whether the blocks have series, and whether they have leaves.
        doubts: doubts about the log.
    """
    doubts_by_result = doubts_of_instances([stream.instance for stream in streams], doubts, traces)
    return tuple(
        SpecResult.from_stream(
            stream,
            Evidence(stream.instance, files[tree.file].regions, traces, units, zero_ns),
            block,
            name=tree.name,
            has_series=has_series,
            has_leaves=has_leaves,
            doubts=doubts_of_result,
        )
        for tree, stream, block, doubts_of_result in zip(
            trees, streams, blocks, doubts_by_result, strict=True
        )
    )


_REPLACED = (REPLAYED_PREFIX, AUTOMATA_PREFIX + REPLAYED_PREFIX)
"""Prefixes of the attachments that a replay replaces."""


def plan_of(source: Source) -> Mapping[str, str]:
    """Return the metadata of the plan that was recorded with a log; empty without a plan."""
    return dict(source.metadata()).get(PLAN_METADATA, {})


def planned_result(source: Source) -> str:
    """Return the name of the result that was the planner's goal; "" without a plan."""
    return plan_of(source).get("specification", "")


def planned_for(source: Source, files: Sequence[Specification]) -> str:
    """Return the name of the planner's specification file; "" if an evaluated file has the same meaning."""
    file_name = plan_of(source).get("file", "")
    text_by_name = {
        attachment.name: attachment.data.decode("utf-8", "replace") for attachment in source.attachments()
    }
    plan_text = text_by_name.get(RECORDED_PREFIX + file_name)
    with suppress(SpecificationError):
        file_texts = [format_specification(file) for file in files]
        if plan_text is not None and format_specification(parse_specification(plan_text)) not in file_texts:
            return file_name
    return ""


def run_replay(
    source: Source,
    files: Sequence[Specification],
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    keep_series: bool = False,
    keep_leaves: bool = False,
    output: Path | None = None,
    inputs: Sequence[Path] = (),
    layer: bool = False,
    certify: bool = True,
    advance: Callable[[int], None] = lambda samples: None,
) -> Replayed:
    """Evaluate specifications over a source, and write the annotated log if an output is given.

    Equal sources, specifications and options give equal results and an equal file. A replay of an annotated
    log equals a replay of the log's source.

    Args:
        keep_series: whether the robustness of all nodes at each sample is kept in memory.
        keep_leaves: whether the values of all atoms at each sample are kept, for witnesses and signals.
        output: path of the annotated log; an existing file is replaced only when the log is complete.
        inputs: files that the output must not overwrite.
        layer: whether the source's own messages, metadata and attachments are left out of the output.
        certify: whether inputs and results are hashed, which also reads the messages. With an output, they
            are always hashed.
        advance: function that is called with the number of samples of each evaluated block.

    Raises:
        UsageError: an option is invalid, the window has no sample, or the output is an input.
        SpecificationError: a name is missing, and names are strict.
        LogError: the log has no sample.
        OutputError: the output cannot be written.
    """
    if options.keep is None and output is not None and not layer:
        options = replace(options, keep=default_keep(source))
    replay = Replay(
        source,
        files,
        options,
        keep_series=keep_series,
        keep_leaves=keep_leaves,
        certify=certify or output is not None,
    )
    if output is None:
        return replay.run(advance=advance)
    # the import is here, because a replay without an annotated log needs no writer
    from spatial_replay.logs.mcap.write import WHOLE_CHUNK_NS, LogWriter
    from spatial_replay.logs.output_file import replacing

    # long chunks are cheaper to write, and no one reads this log before it is complete
    with ExitStack() as stack:
        sink = stack.enter_context(
            LogWriter(stack.enter_context(replacing(output, inputs)), chunk_ns=WHOLE_CHUNK_NS)
        )
        begin = partial(_begin, sink, source, replay, options, layer=layer)
        replayed = replay.run(sink.write_messages, layer=layer, begin=begin, advance=advance)
        layout = replay.layout()
        sink.add_attachment(layout.name, layout.media_type, layout.data)
        verdict_texts = {
            result.title: verdict_text(
                result.verdict,
                (result.robustness, result.lower, result.upper),
                result.unit,
                result.tested,
                is_doubtful=bool(result.doubts),
            )
            for result in (replayed.results[index] for index in worst_first(replayed.results))
        }
        sink.add_metadata(VERDICTS, verdict_texts)
        if replayed.doubts:
            sink.add_metadata(DOUBTS, metadata_from_doubts(replayed.doubts))
        sink.add_metadata(CERTIFICATE, replayed.certificate)
    return replayed


def load_files(
    paths: Sequence[Path],
    source: Source,
    *,
    constants: Mapping[str, float | str] | None = None,
) -> list[Specification]:
    """Load the specifications at given paths, or the log's own specifications without a path.

    A replayed log has the specifications of its last replay. Other logs have the recorded specifications.

    Args:
        constants: values that replace those in the specifications, see `load_specifications`.

    Raises:
        UsageError: no path is given and the log has no specification, or a constant is in no specification.
        SpecificationError: a specification has errors.
    """
    specifications: Sequence[Path | SpecificationText] = tuple(dict.fromkeys(paths)) or recorded_texts(source)
    if not specifications:
        raise UsageError(f"{source.name} holds no specification of its own; give one with --spec FILE")
    return load_specifications(specifications, constants=constants)


def recorded_texts(source: Source) -> list[SpecificationText]:
    """Return the texts of the specifications in a log.

    A replayed log has the specifications of its last replay. Other logs have the recorded specifications.
    """
    attachments = source.attachments()
    for prefix in (REPLAYED_PREFIX, RECORDED_PREFIX):
        texts = [
            SpecificationText(
                attachment.data.decode("utf-8", "replace"), attachment.name.removeprefix(prefix)
            )
            for attachment in attachments
            if attachment.name.startswith(prefix)
        ]
        if texts:
            return texts
    return []


def _begin(
    sink: Sink, source: Source, replay: Replay, options: ReplayOptions, zero_ns: int, *, layer: bool
) -> None:
    """Write the metadata and the attachments, which an annotated log has before its first message."""
    source_record = dict(source.metadata()).get(METADATA, {})
    is_replayed = source_record.get("written_by") == "replay"
    record = {
        "version": __version__,
        "written_by": "replay",
        "semantics": options.semantics,
        # a replay of a replay names the first source, so that both logs are equal
        "source": source_record.get("source", source.name) if is_replayed else source.name,
        "specifications": specifications_json(replay.files),
        "options": json.dumps(_recorded_options(source, options, layer=layer)),
        ZERO: str(zero_ns),
    }
    record |= source.axes.metadata()
    source_entries = {
        entry: value for entry, value in source_record.items() if entry not in record and entry != "source"
    }
    if not is_replayed and "options" in source_record:
        source_entries["recorded_options"] = source_record["options"]
    sink.add_metadata(METADATA, {**record, **source_entries})
    sink.add_metadata(AUTOMATA, {automaton.name: automaton.summary for automaton in replay.automata})
    if not layer:
        _copy_metadata(sink, source)
    for attachment in replay.attachments():
        sink.add_attachment(attachment.name, attachment.media_type, attachment.data)


def _copy_metadata(sink: Sink, source: Source) -> None:
    """Copy the source's metadata and attachments, except those that a replay replaces."""
    for name, record in source.metadata():
        if name not in (METADATA, AUTOMATA, VERDICTS, DOUBTS, CERTIFICATE):
            sink.add_metadata(name, record)
    for attachment in source.attachments():
        if not attachment.name.startswith(_REPLACED) and attachment.name != LAYOUT:
            sink.add_attachment(attachment.name, attachment.media_type, attachment.data)


def _recorded_options(source: Source, options: ReplayOptions, *, layer: bool) -> dict[str, object]:
    """Return the options that differ from the defaults, in the format that `verification` reads.

    Args:
        layer: whether the source's own messages are left out of the output.
    """
    default_window = Window()
    recorded_options = dict(source.options)
    recorded_options |= {
        option: getattr(options.window, option)
        for option in ("start_ns", "end_ns", "every")
        if getattr(options.window, option) != getattr(default_window, option)
    }
    if options.each:
        recorded_options["each"] = dict(sorted(options.each.items()))
    if options.arrow:
        recorded_options["arrow"] = options.arrow
    if layer:
        recorded_options["layer"] = True
    elif options.keep not in (None, KEEP_ALL):
        recorded_options["keep"] = list(options.keep or ())
    return recorded_options

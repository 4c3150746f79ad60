"""A recorded run evaluated again: source and specifications to verdicts and an annotated log.

What a replay found: numbers, verdicts, and what can still be asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.annotate.annotator import AnnotatedEvaluation
from spatial_replay.annotate.automaton_state import KeptAutomaton
from spatial_replay.annotate.certificate import Hashing, MessageHash, ResultHash, SampleHash, certificate
from spatial_replay.annotate.specification import ReportedTree, kept_files, specification_attachments
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.messages import Attachment, Messages, merge
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import REPLAYED_PREFIX
from spatial_replay.monitor.evaluate import Inquiry
from spatial_replay.monitor.semantics import Semantics, checked_semantics
from spatial_replay.monitor.stream import InstanceEvaluation, SeriesBlock, join_blocks
from spatial_replay.monitor.verdict import Verdict, final_verdict, worst_verdict
from spatial_replay.monitor.witness.path import Evidence
from spatial_replay.replay.selection import Selection, Window, first_sample_ns
from spatial_replay.spec.formula import Formula, Specification
from spatial_replay.trace.trace import Trace


@dataclass(frozen=True, eq=False)
class ReplayedSpec:
    """What a replay found for one spec, or one object's instance of a template.

    Attributes:
        name: the spec's name; with its file's stem before it where two files have a spec of that name.
        object: the object that a template's parameter stands for, or None.
        robustness: (N,), each node's value on the whole log.
        final: (N, 2), lower and upper end of each node for the finished log.
        first_satisfied_ns: the first sample with a value of at least 0, or None.
        times_ns, series: every sample's numbers, (T,) and (N, 4, T), if they were asked for.
        inquiry: answers what the numbers leave open, if that was asked for.
    """

    name: str
    object: str | None
    formula: Formula
    robustness: Floats
    final: Floats
    first_satisfied_ns: int | None
    times_ns: Integers | None = None
    series: Floats | None = None
    inquiry: Inquiry | None = None

    @property
    def verdict(self) -> Verdict:
        return final_verdict(*self.final[0].tolist())


@dataclass(frozen=True, eq=False)
class Replayed:
    """What a replay found.

    Attributes:
        log: base name of the log.
        samples: how many samples were evaluated.
        first_ns: time of the log's first sample, evaluated or not.
        start_ns, end_ns: times of the first and the last of those evaluated.
        faults: what was lost while reading, each with its place.
        remarks: what else the source says of its samples, where nothing was lost.
        unreadable: how many observations are there and say nothing: a number is not finite, or too old.
        results: one per spec and object.
        certificate: hashes of what went in and came out.
        semantics: what the formulas meant.
    """

    log: str
    samples: int
    first_ns: int
    start_ns: int
    end_ns: int
    faults: tuple[str, ...]
    remarks: tuple[str, ...]
    unreadable: int
    results: tuple[ReplayedSpec, ...]
    certificate: Mapping[str, str]
    semantics: Semantics = "ltlf"

    @property
    def verdict(self) -> Verdict:
        return worst_verdict(result.verdict for result in self.results)


def replayed_spec(
    tree: ReportedTree,
    stream: InstanceEvaluation,
    evidence: Evidence,
    kept: SeriesBlock | None,
    semantics: Semantics,
    *,
    has_series: bool,
    has_leaves: bool,
) -> ReplayedSpec:
    """What was found for a result, once its stream has taken in all samples.

    Args:
        kept: what was kept of every sample, if anything.
        has_series, has_leaves: whether its numbers, and its atoms, are among that.
    """
    inquiry = None
    if has_leaves and kept is not None:
        inquiry = Inquiry(evidence, kept.times_ns, kept.leaves, semantics)
    return ReplayedSpec(
        tree.name,
        tree.object,
        tree.formula,
        stream.robustness,
        stream.final,
        stream.first_satisfied_ns,
        None if kept is None else kept.times_ns,
        kept.series if kept is not None and has_series else None,
        inquiry,
    )


class Replay:
    """One pass over a source: samples in, verdicts out, and messages for whoever writes them.

    Attributes:
        files: the specifications, as an annotated log keeps them.
        trees: every result, under the name it is reported by.
    """

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        *,
        window: Window | None = None,
        each: Mapping[str, str] | None = None,
        semantics: Semantics = "ltlf",
        keep_series: bool = False,
        keep_leaves: bool = False,
    ) -> None:
        """Prepare; templates read the source once for the objects that they stand for.

        Args:
            keep_series: keep every sample's numbers in memory.
            keep_leaves: keep every sample's atoms in memory, so that results can be inquired into.

        Raises:
            UsageError: a template without its objects, or objects for a parameter that no template has; an
                operator that the semantics lacks.
        """
        self._semantics = checked_semantics(semantics, files)
        self._source = source
        self._files = files
        self.files = kept_files(files)
        self._selection = Selection(source, window or Window(), files)
        self._instances = [self._selection.instances(file, each or {}) for file in self.files]
        self._evaluation = AnnotatedEvaluation(
            self.files, self._instances, self._semantics, source.attachments
        )
        self.trees = self._evaluation.trees
        self._keep_series, self._keep_leaves = keep_series, keep_leaves
        self._kept: list[list[SeriesBlock]] = [[] for _ in self.trees]
        hashing = Hashing()
        self._sample_hash, self._message_hash = SampleHash(hashing), MessageHash(hashing)
        self._result_hash = ResultHash([(tree.name, tree.object) for tree in self.trees], hashing)
        self._faults: list[str] = []
        self._remarks: list[str] = []
        self._topics: set[str] = set()
        self._names: set[str] = set()
        self._signals: set[str] = set()
        self._samples = self._unreadable = self._encoded = self._end_ns = 0
        self._times: list[int] = []

    def iter_messages(self, *, annotate: bool = False, layer: bool = False) -> Iterator[tuple[Messages, int]]:
        """Evaluate the whole source, yielding for each block what an annotated log holds, and its samples.

        What the end of the log brings comes last, with no samples.

        Args:
            annotate: yield messages; without it, nothing.
            layer: leave out the source's own messages.
        """
        for block, trace in self._selection.iter_blocks():
            stretches = self._evaluation.extend(trace)
            inside = self._selection.inside(trace)
            own = self._selection.own_messages(block, self._encoded)
            self._encoded += len(self._selection.inside(block.trace))
            self._remarks += block.remarks
            if not layer:
                self._topics.update(channel.topic for channel in own.channels.values())
            self._count(inside, own, stretches)
            derived = self._evaluation.messages(inside, stretches) if annotate else []
            written = [*derived, *([] if layer else [own])]
            yield (merge(written) if annotate else Messages()), len(inside)
        if annotate and self._samples:
            yield self._evaluation.end(self._end_ns), 0

    def result(self) -> Replayed:
        """What was found, once all of `iter_messages` was taken.

        Raises:
            LogError: no sample in the log.
            UsageError: no sample in the window.
            SpecificationError: names that the log never has.
        """
        if not self._samples:
            raise self._selection.nothing_to_evaluate(self._faults)
        self._selection.check_names(self._names, self._signals)
        return Replayed(
            log=self._source.name,
            samples=self._samples,
            first_ns=first_sample_ns(self._source) if self._selection.window.start_ns else self._times[0],
            start_ns=self._times[0],
            end_ns=self._times[-1],
            faults=tuple(self._faults),
            remarks=tuple(self._remarks),
            unreadable=self._unreadable,
            results=tuple(self._results()),
            certificate=self.certificate(),
            semantics=self._semantics,
        )

    @property
    def automata(self) -> Sequence[KeptAutomaton]:
        """The automaton of each of `trees`, or why it has none."""
        return self._evaluation.automata

    def automata_metadata(self) -> Mapping[str, str]:
        """For each spec, how large its automaton is, or why there is none."""
        return self._evaluation.automata_metadata()

    def attachments(self) -> list[Attachment]:
        """What an annotated log keeps of the specifications: their texts and their automata."""
        texts = specification_attachments(self.files, REPLAYED_PREFIX)
        return [*texts, *self._evaluation.automata_attachments(REPLAYED_PREFIX)]

    def layout(self) -> Attachment:
        """How to open the annotated log in a viewer, once all messages were taken."""
        return self._evaluation.layout(self._topics)

    def certificate(self) -> Mapping[str, str]:
        """The certificate over what was taken in so far."""
        return certificate(self._sample_hash, self._message_hash, self._files, self._result_hash)

    def _count(self, trace: Trace, own: Messages, stretches: Sequence[SeriesBlock]) -> None:
        self._faults += trace.faults
        self._names.update(trace.names)
        self._signals.update(trace.signals)
        self._samples += len(trace)
        self._unreadable += trace.unreadable_count
        if len(trace):
            self._times = [*self._times[:1], int(trace.times_ns[0]), int(trace.times_ns[-1])]
        if len(own):
            self._end_ns = max(self._end_ns, int(own.log_time_ns[-1]))
        self._sample_hash.add(trace)
        self._message_hash.add(own)
        for index, stretch in enumerate(stretches):
            self._result_hash.add(index, stretch.series)
            if self._keep_series or self._keep_leaves:
                self._kept[index].append(self._worth_keeping(stretch))

    def _worth_keeping(self, stretch: SeriesBlock) -> SeriesBlock:
        series = stretch.series if self._keep_series else np.empty((len(stretch.series), 4, 0))
        leaves = stretch.leaves if self._keep_leaves else np.empty((1, stretch.leaves.shape[1], 0))
        return SeriesBlock(stretch.times_ns, series, leaves)

    def _results(self) -> Iterator[ReplayedSpec]:
        regions = [file.regions for file, own in zip(self.files, self._instances, strict=True) for _ in own]
        for tree, stream, kept, own in zip(
            self.trees, self._evaluation.streams, self._kept, regions, strict=True
        ):
            evidence = Evidence(stream.instance, own, self._selection.iter_traces)
            yield replayed_spec(
                tree,
                stream,
                evidence,
                join_blocks(kept) if kept else None,
                self._semantics,
                has_series=self._keep_series,
                has_leaves=self._keep_leaves,
            )

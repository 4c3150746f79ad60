"""A recorded run evaluated again: source and specifications to verdicts and an annotated log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.errors import LogError, SpecificationError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.inspection.annotation import (
    AnnotatedEvaluation,
    kept_files,
    specification_attachments,
)
from spatial_replay.inspection.annotator import messages_of
from spatial_replay.inspection.certificate import MessageHash, ResultHash, SampleHash, certificate
from spatial_replay.inspection.hashing import Hashing
from spatial_replay.logs.block import Block, Messages
from spatial_replay.logs.merging import merge, select
from spatial_replay.logs.messages.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.objects import encode_objects
from spatial_replay.logs.reading import read_blocks
from spatial_replay.logs.sink import Attachment
from spatial_replay.logs.source import Source, within
from spatial_replay.logs.topics import OBJECTS, REPLAYED_PREFIX, protobuf_channel
from spatial_replay.monitor.inquiry import Inquiry
from spatial_replay.monitor.instances import Choice, Instance, find_instances
from spatial_replay.monitor.semantics import Semantics, checked_semantics
from spatial_replay.monitor.stream import Stretch, join_stretches, look_back
from spatial_replay.monitor.verdict import Verdict, final_verdict, worst_verdict
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.replay.window import Window, first_sample_ns
from spatial_replay.spec import check_names
from spatial_replay.spec.formula import Diagnostic, Formula, Specification
from spatial_replay.trace.trace import Trace, window_of


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
        self._window = window or Window()
        self.files = kept_files(files)
        self._instances = [self._find_instances(file, each or {}) for file in self.files]
        self._evaluation = AnnotatedEvaluation(
            self.files, self._instances, self._semantics, source.attachments
        )
        self.trees = self._evaluation.trees
        self._keep_series, self._keep_leaves = keep_series, keep_leaves
        self._kept: list[list[Stretch]] = [[] for _ in self.trees]
        hashing = Hashing()
        self._sample_hash, self._message_hash = SampleHash(hashing), MessageHash(hashing)
        self._result_hash = ResultHash([(tree.name, tree.object) for tree in self.trees], hashing)
        self._faults: list[str] = []
        self._remarks: list[str] = []
        self._topics: set[str] = set()
        self._names: set[str] = set()
        self._signals: set[str] = set()
        self._samples = self._unreadable = self._encoded = 0
        self._times: list[int] = []

    def iter_messages(self, *, annotate: bool = False, layer: bool = False) -> Iterator[tuple[Messages, int]]:
        """Evaluate the whole source, yielding for each block what an annotated log holds, and its samples.

        Args:
            annotate: yield messages; without it, nothing.
            layer: leave out the source's own messages.
        """
        for block, trace in self._iter_blocks():
            stretches = self._evaluation.extend(trace)
            inside = within(trace, self._window.start_ns, self._window.end_ns)
            own = self._own_messages(block)
            self._remarks += block.remarks
            if not layer:
                self._topics.update(channel.topic for channel in own.channels.values())
            self._count(inside, own, stretches)
            derived = self._evaluation.messages(inside, stretches) if annotate else []
            written = [*derived, *([] if layer else [own])]
            yield (merge(written) if annotate else Messages()), len(inside)

    def result(self) -> Replayed:
        """What was found, once all of `iter_messages` was taken.

        Raises:
            LogError: no sample in the log.
            UsageError: no sample in the window.
            SpecificationError: names that the log never has.
        """
        if not self._samples:
            raise self._nothing_to_evaluate()
        self._check_names()
        return Replayed(
            log=self._source.name,
            samples=self._samples,
            first_ns=first_sample_ns(self._source) if self._window.start_ns else self._times[0],
            start_ns=self._times[0],
            end_ns=self._times[-1],
            faults=tuple(self._faults),
            remarks=tuple(self._remarks),
            unreadable=self._unreadable,
            results=tuple(self._results()),
            certificate=self.certificate(),
            semantics=self._semantics,
        )

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

    def _find_instances(self, file: Specification, each: Mapping[str, str]) -> list[Instance]:
        parameters = {spec.parameter for spec in file.results}
        own = {parameter: choice for parameter, choice in each.items() if parameter in parameters}
        choices = [Choice.parse(parameter, choice) for parameter, choice in own.items()]
        classes: set[str | None] = set()
        traces = self._iter_with_classes(classes)
        instances = find_instances(file, own, traces, self._window.start_ns, self._window.end_ns)
        for choice in choices:
            self._check_class(choice, classes)
        return instances

    def _iter_with_classes(self, classes: set[str | None]) -> Iterator[Trace]:
        """The samples that count; the classes of their objects go to `classes`."""
        for block, trace in self._iter_blocks():
            classes.update(block.trace.classes)
            yield trace

    def _iter_traces(self) -> Iterator[Trace]:
        """The samples that count."""
        for _, trace in self._iter_blocks():
            yield trace

    def _check_class(self, choice: Choice, classes: set[str | None]) -> None:
        """That some object of the log is of the class that was chosen, if none of those in the window is."""
        if not any(map(choice.fits, classes)) and not self._window.is_whole:
            for block in read_blocks(self._source):
                classes.update(block.trace.classes)
        if choice.class_name is not None and not any(map(choice.fits, classes)):
            known = ", ".join(sorted(name for name in classes if name)) or "none"
            raise UsageError(
                f"no object of {self._source.name} is of the class {choice.class_name!r}; "
                f"its classes are: {known}"
            )

    def _iter_blocks(self) -> Iterator[tuple[Block, Trace]]:
        """Each block, with the samples that count."""
        window = self._window
        looks_back = any(look_back([spec.formula for spec in file.specs]) != (0, 0) for file in self._files)
        from_start = looks_back or window.every > 1
        seen = 0
        for block in read_blocks(self._source, None if from_start else window.start_ns, window.end_ns):
            trace = block.trace
            if window.every > 1:
                chosen = np.arange(-seen % window.every, len(trace), window.every, dtype=np.int64)
                seen += len(trace)
                trace = trace.take(chosen)
            yield block, trace

    def _own_messages(self, block: Block) -> Messages:
        """The source's messages in the window, and its samples where those are not among its messages."""
        messages = block.messages
        begin, end = window_of(messages.log_time_ns, self._window.start_ns, self._window.end_ns)
        inside = messages if end - begin == len(messages) else select(messages, np.arange(begin, end))
        if any(channel.topic == OBJECTS for channel in messages.channels.values()):
            # in the source, messages of one time come in the order of its numbers of channels
            return merge([inside])
        trace = within(block.trace, self._window.start_ns, self._window.end_ns)
        self._encoded += len(trace)
        first = self._encoded - len(trace)
        return merge([inside, messages_of(_OBJECTS, trace.times_ns, encode_objects(trace), first)])

    def _count(self, trace: Trace, own: Messages, stretches: Sequence[Stretch]) -> None:
        self._faults += trace.faults
        self._names.update(trace.names)
        self._signals.update(trace.signals)
        self._samples += len(trace)
        self._unreadable += trace.unreadable_count
        if len(trace):
            self._times = [*self._times[:1], int(trace.times_ns[0]), int(trace.times_ns[-1])]
        self._sample_hash.add(trace)
        self._message_hash.add(own)
        for index, stretch in enumerate(stretches):
            self._result_hash.add(index, stretch.series)
            if self._keep_series or self._keep_leaves:
                self._kept[index].append(self._worth_keeping(stretch))

    def _worth_keeping(self, stretch: Stretch) -> Stretch:
        series = stretch.series if self._keep_series else np.empty((len(stretch.series), 4, 0))
        leaves = stretch.leaves if self._keep_leaves else np.empty((1, stretch.leaves.shape[1], 0))
        return Stretch(stretch.times_ns, series, leaves)

    def _results(self) -> Iterator[ReplayedSpec]:
        regions = [file.regions for file, own in zip(self.files, self._instances, strict=True) for _ in own]
        for tree, stream, kept, own in zip(
            self.trees, self._evaluation.streams, self._kept, regions, strict=True
        ):
            stretch = join_stretches(kept) if kept else None
            inquiry = None
            if self._keep_leaves and stretch is not None:
                evidence = Evidence(stream.instance, own, self._iter_traces)
                inquiry = Inquiry(evidence, stretch.times_ns, stretch.leaves, self._semantics)
            yield ReplayedSpec(
                tree.name,
                tree.object,
                tree.formula,
                stream.robustness,
                stream.final,
                stream.first_satisfied_ns,
                None if stretch is None else stretch.times_ns,
                stretch.series if stretch is not None and self._keep_series else None,
                inquiry,
            )

    def _check_names(self) -> None:
        """That the log has every object and signal that a specification names."""
        missing = self._missing_names()
        if missing and not self._window.is_whole:
            for block in read_blocks(self._source):
                self._names.update(block.trace.names)
                self._signals.update(block.trace.signals)
            missing = self._missing_names()
        if missing:
            raise SpecificationError(missing)

    def _missing_names(self) -> list[Diagnostic]:
        names, signals = sorted(self._names), sorted(self._signals)
        remarks = [remark for file in self._files for remark in check_names(file, names, signals)]
        return [remark for remark in remarks if remark.severity == "error"]

    def _nothing_to_evaluate(self) -> LogError | UsageError:
        name = self._source.name
        spans = [
            (int(block.trace.times_ns[0]), int(block.trace.times_ns[-1]))
            for block in read_blocks(self._source)
            if len(block.trace)
        ]
        if not spans:
            return LogError("; ".join([f"{name} has no sample", *self._faults[:1]]))
        first_ns, last_ns = spans[0][0], spans[-1][1]
        return UsageError(
            f"{name} has no sample in the window asked for; its samples are from {first_ns} to {last_ns} ns, "
            f"{(last_ns - first_ns) / 1e9:.3f} s"
        )


_OBJECTS = protobuf_channel(OBJECTS, ObjectStates)

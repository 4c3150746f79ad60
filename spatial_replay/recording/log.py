"""A log during its recording: samples, messages of the evaluation, and changes of verdicts."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from spatial_replay import compiled
from spatial_replay.annotate.automaton_state import SpecAutomaton, automata_attachments
from spatial_replay.annotate.certificate import EvaluationHashes, specifications_json
from spatial_replay.annotate.evaluation import AnnotatedEvaluation
from spatial_replay.annotate.events import (
    FAILING,
    HOLDING,
    SATISFIED,
    UNKNOWN,
    VIOLATED,
    NodeStates,
    change_sentence,
    track,
)
from spatial_replay.annotate.specification import logged_specifications, specification_attachments
from spatial_replay.errors import OutputError, UsageError
from spatial_replay.geometry.footprint import Footprint, FootprintBatch, TrackedObject
from spatial_replay.geometry.measure import Operand, contacts
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Attachment, Channel, Messages, Sink, merge
from spatial_replay.logs.objects import sample_messages
from spatial_replay.logs.output_file import Durability, open_output, refuse_ending
from spatial_replay.logs.topics import (
    AUTOMATA,
    CERTIFICATE,
    DERIVED,
    DOUBTS,
    ENDING,
    METADATA,
    PLAN_METADATA,
    RECORDED_PREFIX,
    VERDICTS,
    ZERO,
    image_topics,
)
from spatial_replay.monitor.monitor import SpecUpdate, Update
from spatial_replay.monitor.sentences import verdict_text
from spatial_replay.monitor.stream import find_instances
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.spec import object_names, signal_names
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.walks import declared_unit
from spatial_replay.text import requirement_text
from spatial_replay.trace.doubts import Doubt, metadata_from_doubts
from spatial_replay.trace.trace import FOREVER, LATEST_NS, Sample, Trace
from spatial_replay.trace.units import Axes
from spatial_replay.version import __version__

if TYPE_CHECKING:
    from spatial_replay.planning.planner import Planner


class RunEvent(NamedTuple):
    """An external event of a run, such as a lost connection.

    Attributes:
        time_ns: time on the clock of the samples.
        what: name of the event, such as "connection lost".
        sentence: description of the event and its consequence.
    """

    time_ns: int
    what: str
    sentence: str


class RunEnd(NamedTuple):
    """The end of a recording.

    Attributes:
        interrupted: whether the recording ended early.
        dropped, messages_dropped: numbers of dropped samples and messages.
        doubts: assumptions that the source contradicts.
    """

    interrupted: bool = False
    dropped: int = 0
    messages_dropped: int = 0
    doubts: tuple[Doubt, ...] = ()


_WHOLE: Final = RunEnd()


class Recording:
    """Write samples to a sink as they arrive, in blocks of any length.

    Attributes:
        files: specifications in the form that the log stores.
    """

    def __init__(
        self,
        sink: Sink,
        files: Sequence[Specification] = (),
        about: Mapping[str, str] | None = None,
        known: Sequence[SpecAutomaton] = (),
    ) -> None:
        """Write the records before the first sample: metadata and specifications.

        Args:
            files: specifications to evaluate and to store in the log.
            about: further metadata, such as the origin of the samples, a seed, or the time zero of a clip.
            known: compiled automata of specs in these files.

        Raises:
            UsageError: a specification has a template, whose objects are not yet known.
        """
        refuse_templates(files)
        self._axes = Axes.from_metadata(about or {})
        self.files = files = logged_specifications(files, self._axes.units)
        self._sink = sink
        self._evaluation = AnnotatedEvaluation(
            files,
            [find_instances(file, {}, (), 0, FOREVER) for file in files],
            known=known,
            units=self._axes.units,
        )
        self._sample_count = self._message_count = self._end_ns = 0
        self._start_ns = LATEST_NS
        self._topics: set[str] = set()
        self._plan: Mapping[str, str] | None = None
        self._doubts: tuple[str, ...] = ()
        self._image_topics: set[str] = set()
        self._hashes = EvaluationHashes([(tree.name, tree.object) for tree in self._evaluation.trees])
        if about is not None and ZERO in about:
            self._evaluation.annotator.count_from(int(about[ZERO]))
        sink.add_metadata(METADATA, _metadata(files, about or {}))
        if self._evaluation.trees:
            sink.add_metadata(AUTOMATA, {automaton.name: automaton.summary for automaton in self.automata})
        automata = automata_attachments(self.automata, RECORDED_PREFIX)
        for attachment in [*specification_attachments(files, RECORDED_PREFIX), *automata]:
            sink.add_attachment(attachment.name, attachment.media_type, attachment.data)

    def __len__(self) -> int:
        """Return the number of samples so far."""
        return self._sample_count

    @property
    def automata(self) -> Sequence[SpecAutomaton]:
        """The automaton of each result, or the reason why there is no automaton."""
        return self._evaluation.automata

    @property
    def verdicts(self) -> Mapping[str, Verdict]:
        """The verdict of each result by name, if the log ended now."""
        results = zip(self._evaluation.trees, self._evaluation.streams, strict=True)
        return {tree.name: stream.verdict for tree, stream in results}

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels of the evaluation's messages."""
        return self._evaluation.channels

    def layout_ahead(self) -> Attachment:
        """Return the layout for viewers before the first sample, with panels for all possible contents."""
        # the import is late, because only live viewers need a layout before the end of the log
        from spatial_replay.annotate.foxglove_layout import layout_attachment

        return layout_attachment(self._evaluation.contents(None, (), self._axes))

    def add(self, trace: Trace, beside: Messages | None = None) -> None:
        """Write the next samples, with the messages of their evaluation.

        Args:
            beside: messages of other topics that are not derived from samples, sorted by time within each
                topic. A replay copies these messages.

        Raises:
            TraceError: samples that are not after the earlier samples.
        """
        blocks = self._evaluation.extend(trace)
        messages = self._count_messages(trace, beside)
        self._sink.write_messages(merge([messages, *self._evaluation.annotator.messages(trace, blocks)]))
        self._hashes.add_results(blocks)

    def add_samples(self, trace: Trace, beside: Messages | None = None) -> None:
        """Write the next samples without an evaluation; `evaluate` must receive them later, in order."""
        self._sink.write_messages(self._count_messages(trace, beside))

    def evaluate(self, trace: Trace) -> None:
        """Evaluate samples that `add_samples` wrote, and write the messages of their results."""
        blocks = self._evaluation.extend(trace)
        self._sink.write_messages(merge(self._evaluation.annotator.messages(trace, blocks)))
        self._hashes.add_results(blocks)

    def report(self, event: RunEvent) -> None:
        """Write an external event of the run.

        A replay does not reproduce the event, only its effect on the samples: unknown values.
        """
        self._sink.write_messages(merge(self._evaluation.annotator.occurrence(*event)))

    def _count_messages(self, trace: Trace, beside: Messages | None) -> Messages:
        """Count and hash the next samples and other messages; return them as messages to write."""
        certified_messages = sample_messages(trace, self._sample_count)
        messages = certified_messages
        if beside is not None and len(beside):
            # a replay does not copy messages on topics of this package, such as planning times
            replayed_messages = beside.of_topics(
                {channel.topic for channel in beside.channels.values()} - DERIVED
            )
            certified_messages, messages = (
                merge([certified_messages, replayed_messages]),
                merge([certified_messages, beside]),
            )
            self._topics.update(channel.topic for channel in beside.channels.values())
            self._image_topics |= image_topics(beside.channels.values())
            self._message_count += len(replayed_messages)
        if len(messages):
            self._start_ns = min(self._start_ns, int(messages.log_time_ns[0]))
            self._end_ns = max(self._end_ns, int(messages.log_time_ns[-1]))
        self._sample_count += len(trace)
        self._hashes.add_samples(trace, certified_messages)
        return messages

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Write a metadata record; the certificate covers records of a plan and of doubts."""
        self._sink.add_metadata(name, data)
        if name == DOUBTS:
            self._doubts = tuple(data)
        if name == PLAN_METADATA:
            self._plan = dict(data)
            self._evaluation.annotator.add_map(data)

    def end(self, end: RunEnd = _WHOLE) -> None:
        """Write the records after the last sample; the certificate equals the certificate of a replay."""
        ending_metadata = self._ending(end)
        if end.doubts:
            self.add_metadata(DOUBTS, metadata_from_doubts(end.doubts))
        if self._sample_count:
            annotator = self._evaluation.annotator
            self._sink.write_messages(merge(annotator.end(self._end_ns, self._evaluation.finals)))
        start_and_name = self._start_ns, "this log"
        planned_specification = (self._plan or {}).get("specification", "")
        layout = self._evaluation.layout(
            self._topics, self._axes, self._image_topics, start=start_and_name, planned=planned_specification
        )
        self._sink.add_attachment(layout.name, layout.media_type, layout.data)
        streams = self._evaluation.streams
        if self._sample_count and streams:
            tree_indices = self._evaluation.annotator.standing.order
            results = [
                (self._evaluation.trees[tree_index], streams[tree_index]) for tree_index in tree_indices
            ]
            texts = {
                tree.title: verdict_text(
                    stream.verdict,
                    (float(stream.robustness[0]), *stream.final[0].tolist()),
                    declared_unit(tree.formula, self._evaluation.units),
                )
                for tree, stream in results
            }
            self._sink.add_metadata(VERDICTS, texts)
        self._sink.add_metadata(ENDING, ending_metadata)
        self._sink.add_metadata(CERTIFICATE, self._hashes.certificate(self.files, self._plan, self._doubts))

    def break_off(self, end: RunEnd) -> None:
        """Write the end of a log whose last samples could not be written. The log has no certificate."""
        self._sink.add_metadata(ENDING, self._ending(end._replace(interrupted=True)) | {"failed": "true"})

    def _ending(self, end: RunEnd) -> dict[str, str]:
        ending_metadata = {
            "samples": str(self._sample_count),
            "dropped": str(end.dropped),
            "interrupted": json.dumps(end.interrupted),
        }
        if self._message_count or end.messages_dropped:
            ending_metadata |= {
                "messages": str(self._message_count),
                "messages_dropped": str(end.messages_dropped),
            }
        return ending_metadata


def _metadata(files: Sequence[Specification], about: Mapping[str, str]) -> dict[str, str]:
    return {
        "version": __version__,
        "written_by": "record",
        "specifications": specifications_json(files),
        "options": "{}",
        **about,
    }


def refuse_templates(files: Sequence[Specification]) -> None:
    """Check that specifications can be evaluated as samples arrive.

    Raises:
        UsageError: a template, since its objects are not known yet.
    """
    for file in files:
        for spec in file.results:
            if spec.parameter is not None:
                raise UsageError(
                    f"{spec.name}({spec.parameter}) in {file.filename} is a template: it stands for objects "
                    "that are not known before the end; record without it and replay it over the log"
                )


GATHER_S: Final = 0.2
"""Time for which samples are gathered before they are encoded, s.

A few samples cost hardly more than one sample. While no sample is encoded, the caller's thread does not wait
for the interpreter lock.
"""


_EVALUATING_S: Final = 0.05
"""Target duration of an evaluation between two writes, s."""
_AT_FIRST, _MOST_AT_ONCE = 16, 1024
"""Initial and maximum number of samples that are evaluated at once."""


Missed: TypeAlias = Literal["sample", "message"]


class RecorderLog:
    """Log of a recorder's writing thread. Other threads call only `miss` and `close`.

    Attributes:
        gather_s: time to gather samples before the next call of `add`, s.
        backlog: number of added samples that wait for their evaluation.
    """

    gather_s = GATHER_S
    backlog = 0

    @property
    def is_busy(self) -> bool:
        """Whether `add` should be called again at once, even without new samples."""
        return False

    def add(self, samples: Sequence[Sample], trace: Trace, messages: Messages) -> None:
        """Write messages and the next samples; `samples` and `trace` are the same samples."""
        raise NotImplementedError

    def miss(self, time_ns: int, kind: Missed) -> None:
        """Record the time of a dropped sample or message; the caller's threads call it."""

    def report(self, event: RunEvent) -> None:
        """Write an external event of the run."""

    def flush(self) -> None:
        """Hand all written data to the operating system."""

    def end(self, end: RunEnd) -> None:
        """Write the records after the last sample."""

    def break_off(self, end: RunEnd) -> None:
        """Write the end of the log after a failure, if possible."""

    def close(self) -> None:
        """Close files, also after a failure."""


class FileLog(RecorderLog):
    """One log in one file, written in place.

    Samples are written before they are evaluated. An evaluation can be repeated from the log; lost samples
    cannot be recovered.
    """

    def __init__(
        self,
        path: Path,
        files: Sequence[Specification],
        about: Mapping[str, str] | None,
        durability: Durability = "process",
        *,
        overwrite: bool = True,
    ) -> None:
        """Begin the file, and compile all code that later writes need."""
        self._unevaluated: deque[Trace] = deque()
        self._plans: deque[Mapping[str, str]] = deque()
        self._batch_size = _AT_FIRST
        refuse_ending(path)
        self._stream = open_output(path, durability, overwrite=overwrite)
        try:
            # with a clock, chunks are closed after a second, so that a kill loses little
            self._writer = LogWriter(self._stream, clock=time.monotonic)
            self._recording = Recording(self._writer, files, about)
            self.flush()
            warm_up(self._recording.files, self._recording.automata)
        except BaseException:
            # the stream is closed also after an interruption of the compilation
            with suppress(OutputError):
                self._stream.close()
            raise

    def add(self, samples: Sequence[Sample], trace: Trace, messages: Messages) -> None:
        """See `RecorderLog`."""
        while self._plans:
            self._recording.add_metadata(PLAN_METADATA, self._plans.popleft())
        if len(trace) or len(messages):
            self._recording.add_samples(trace, messages)
        if len(trace):
            self.backlog += len(trace)
            self._unevaluated.append(trace)
        if self._unevaluated:
            self._evaluate_some()

    def report(self, event: RunEvent) -> None:
        """See `RecorderLog`."""
        self._recording.report(event)

    def add_plan(self, planner: Planner, number: int) -> None:
        """Write the settings of a planner with the next `add`; any thread may call it.

        Args:
            number: index of the planner's specification.
        """
        # the import is late, because a log without a planner does not need the planner's code
        from spatial_replay.planning.decision_log import plan_metadata

        self._plans.append(plan_metadata(planner, self._recording.files[number].filename))

    @property
    def is_busy(self) -> bool:
        """Whether samples wait for their evaluation."""
        return bool(self._unevaluated)

    def _evaluate_some(self) -> None:
        """Evaluate the next samples, about as many as take `_EVALUATING_S`."""
        trace = self._unevaluated.popleft()
        sample_count = min(self._batch_size, len(trace))
        if sample_count < len(trace):
            self._unevaluated.appendleft(trace.slice(sample_count, len(trace)))
        begin_s = time.monotonic()
        self._recording.evaluate(trace.slice(0, sample_count))
        self.backlog -= sample_count
        # the next batch follows from the measured speed
        duration_s = max(time.monotonic() - begin_s, 1e-6)
        self._batch_size = max(1, min(int(sample_count * _EVALUATING_S / duration_s), _MOST_AT_ONCE))

    def flush(self) -> None:
        """See `RecorderLog`."""
        self._writer.flush()
        self._stream.flush()

    def end(self, end: RunEnd) -> None:
        """See `RecorderLog`."""
        while self._unevaluated:
            self._evaluate_some()
        self._recording.end(end)
        self._writer.close()

    def break_off(self, end: RunEnd) -> None:
        """See `RecorderLog`."""
        self._recording.break_off(end)
        self._writer.close()

    def close(self) -> None:
        """See `RecorderLog`."""
        self._stream.close()


def encodable(samples: Sequence[Sample]) -> list[Sample]:
    """Return the samples before the first sample that cannot be encoded."""
    encodable_samples: list[Sample] = []
    with suppress(Exception):
        for sample in samples:
            Trace.from_samples([sample])
            encodable_samples.append(sample)
    return encodable_samples


def warm_up(files: Sequence[Specification], automata: Sequence[SpecAutomaton]) -> None:
    """Record some samples into memory, so that the compiled code for the specifications is loaded.

    With an empty compiler cache, code is interpreted until a child process has compiled it.

    Args:
        automata: compiled automata of the specifications.
    """
    compiled.start("record and replay", partial(_record_trial, files, automata))


def _record_trial(files: Sequence[Specification], automata: Sequence[SpecAutomaton]) -> None:
    writer = LogWriter(BytesIO())
    recording = Recording(writer, files, known=automata)
    objects = ["object", *(name for file in files for name in object_names(file))]
    signals = {name: 0.0 for file in files for name in signal_names(file)}
    samples = [
        Sample(
            time_s * 10**9,
            {
                name: _example_object(index + time_s, 0.1 * index + time_s)
                for index, name in enumerate(dict.fromkeys(objects))
            },
            signals,
        )
        for time_s in range(4)
    ]
    recording.add(Trace.from_samples(samples[:1]))
    recording.add(Trace.from_samples(samples[1:]))
    # a sample without objects, because intervals of unknown atoms run separate code
    recording.add(Trace.from_samples([Sample(10**10, {})]))
    recording.end()
    writer.close()
    # compile the code of arrows at violations, because these samples may have no violation
    footprints = FootprintBatch.from_footprints([Footprint.box(x, 0, x + 1, 1) for x in range(2)])
    contacts(footprints, *(Operand(np.array([[row]])) for row in range(2)), is_protrusion=False)


def _example_object(shape_index: int, x: float) -> TrackedObject:
    box, disc = Footprint.box(x, 0, x + 1, 1), Footprint.disc(x + 0.5, 0.5, 0.5)
    footprint = (box, disc, Footprint((*box.parts, *disc.parts)))[shape_index % 3]
    return TrackedObject(footprint, class_name="thing", yaw=x, height=(0.0, 1.0), uncertainty=0.01)


_WORDS: Final = {
    HOLDING: "holds",
    FAILING: "pending",
    UNKNOWN: "unknown",
    SATISFIED: "satisfied",
    VIOLATED: "violated",
}


class VerdictChange(NamedTuple):
    """A change of a spec's verdict or, while the spec is pending, of its robustness' sign.

    A changed verdict is reported at once. A changed sign is reported after three samples,
    as in the events of a log.

    Attributes:
        time_ns: time of the sample that confirms the change.
        spec: name of the spec.
        state: "satisfied" or "violated" permanently; "holds", "pending" or "unknown" until decided.
        sentence: change and reason.
        is_first: whether the spec had no known state before.
    """

    time_ns: int
    spec: str
    state: str
    sentence: str
    is_first: bool


class VerdictChanges:
    """The current states of all results of some specifications."""

    def __init__(self, files: Sequence[Specification]) -> None:
        """Start before the first sample."""
        self._states = [[NodeStates.begin(1) for _ in file.results] for file in files]
        self._root = np.zeros(1, np.int64)

    def after(self, updates: Sequence[Update]) -> Iterator[VerdictChange]:
        """Yield the changes at a sample, from the update of each specification."""
        for node_states, update in zip(self._states, updates, strict=True):
            for spec_index, spec in enumerate(update.specs):
                if spec.numbers is None or node_states[spec_index].are_final:
                    continue
                times_ns = np.array([update.time_ns], np.int64)
                former_states = node_states[spec_index]
                tracked = track(former_states, times_ns, spec.numbers[:1, :, None].copy(), self._root)
                node_states[spec_index] = tracked.states
                is_first = not former_states.integers[0, 0] and tracked.states.integers[0, 0]
                if tracked.changes or is_first:
                    yield self._change(tracked.states, spec, update, is_first=bool(is_first))

    def _change(
        self, states: NodeStates, spec: SpecUpdate, update: Update, *, is_first: bool
    ) -> VerdictChange:
        period = states.period(0)
        name = spec.spec.name
        requirement = requirement_text(spec.spec.id, spec.spec.title)
        title = f"`{name}` ({requirement})" if requirement else f"`{name}`"
        reasons = [result.reason for result in update.satisfied if result.spec is spec.spec]
        sentence = change_sentence(
            title, period, reasons[0] if period.code == SATISFIED and reasons else "", spec.unit
        )
        if period.code == VIOLATED:
            node_names = {node for node in spec.names if node is not None} | {name}
            reasons = [str(violation) for violation in update.violations if violation.spec in node_names]
            sentence = f"{title} is permanently violated: {'; '.join(reasons)}." if reasons else sentence
        return VerdictChange(update.time_ns, name, _WORDS[period.code], sentence, is_first)

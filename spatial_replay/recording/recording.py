"""A log as it is recorded: samples in, samples and the messages of an evaluation out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from spatial_replay import __version__
from spatial_replay.annotate.annotated_evaluation import AnnotatedEvaluation
from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.annotate.certificate import EvaluationHashes, specifications_json
from spatial_replay.annotate.specification import logged_specifications, specification_attachments
from spatial_replay.errors import UsageError
from spatial_replay.logs.messages import Attachment, Channel, Messages, Sink, merge, messages_of, select
from spatial_replay.logs.objects.encode import encode_objects
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.topics import (
    AUTOMATA,
    CERTIFICATE,
    DERIVED,
    ENDING,
    METADATA,
    OBJECTS,
    PLAN_METADATA,
    RECORDED_PREFIX,
    VERDICTS,
    image_topics,
    protobuf_channel,
)
from spatial_replay.monitor.instances import find_instances
from spatial_replay.monitor.sentences import verdict_text
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.units import declared_unit
from spatial_replay.trace.axes import Axes, units_from_metadata
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace


class RunEvent(NamedTuple):
    """What happens to a run beside its samples.

    Attributes:
        time_ns: on the clock of the samples.
        what: in a few words: "connection lost".
        sentence: with its consequence.
    """

    time_ns: int
    what: str
    sentence: str


class Recording:
    """Write samples to a sink as they arrive, in blocks of any length."""

    def __init__(
        self,
        sink: Sink,
        files: Sequence[Specification] = (),
        about: Mapping[str, str] | None = None,
        known: Sequence[SpecAutomaton] = (),
    ) -> None:
        """Write what comes before the first sample: metadata and specifications.

        Args:
            files: specifications to evaluate and write beside the samples.
            about: further metadata: where the samples come from, a seed.
            known: automata of specs of these files, which are not compiled again.

        Raises:
            UsageError: a template, since its objects are not known yet.
        """
        refuse_templates(files)
        self._files = files = logged_specifications(files)
        self._sink = sink
        self._axes = Axes.from_metadata(about or {})
        self._evaluation = AnnotatedEvaluation(
            files,
            [find_instances(file, {}, (), 0, FOREVER) for file in files],
            known=known,
            units=units_from_metadata(about or {}),
        )
        self._samples = self._messages = self._end_ns = 0
        self._topics: set[str] = set()
        self._plan: Mapping[str, str] | None = None
        self._images: set[str] = set()
        self._hashes = EvaluationHashes([(tree.name, tree.object) for tree in self._evaluation.trees])
        sink.add_metadata(METADATA, _metadata(files, about or {}))
        if self._evaluation.trees:
            sink.add_metadata(AUTOMATA, self._evaluation.automata_metadata())
        automata = self._evaluation.automata_attachments(RECORDED_PREFIX)
        for attachment in [*specification_attachments(files, RECORDED_PREFIX), *automata]:
            sink.add_attachment(attachment.name, attachment.media_type, attachment.data)

    def __len__(self) -> int:
        """Return the number of samples so far."""
        return self._samples

    @property
    def files(self) -> Sequence[Specification]:
        """The specifications, as the log stores them."""
        return self._files

    @property
    def automata(self) -> Sequence[SpecAutomaton]:
        """The automaton of each result, or the reason why it has none."""
        return self._evaluation.automata

    @property
    def verdicts(self) -> Mapping[str, Verdict]:
        """The verdict of each result, by its name, if the log ends here."""
        reported = zip(self._evaluation.trees, self._evaluation.streams, strict=True)
        return {tree.name: stream.verdict for tree, stream in reported}

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels of the messages that annotate a sample."""
        return self._evaluation.channels

    def layout_ahead(self) -> Attachment:
        """Return the layout for viewers before there are samples: all that may come has its place."""
        # imported here since a log that is written has its layout at its end
        from spatial_replay.annotate.foxglove_layout import layout_attachment

        return layout_attachment(self._evaluation.contents(None, (), self._axes))

    def redraw(self) -> None:
        """Draw the whole scene with the next sample, for a viewer that shows nothing yet."""
        self._evaluation.redraw()

    def add(self, trace: Trace, beside: Messages | None = None) -> None:
        """Write the next samples, with the messages of their evaluation.

        Args:
            beside: messages of other topics that are not derived from samples, those of each topic in the
                order of time; a replay keeps them.

        Raises:
            TraceError: samples that are not after those before.
        """
        stretches = self._evaluation.extend(trace)
        own = self._own(trace, beside)
        self._sink.write_messages(merge([own, *self._evaluation.messages(trace, stretches)]))
        self._hashes.add_results(stretches)

    def add_samples(self, trace: Trace, beside: Messages | None = None) -> None:
        """Write the next samples alone; `evaluate` them later, in any pieces, before more than these."""
        self._sink.write_messages(self._own(trace, beside))

    def evaluate(self, trace: Trace) -> None:
        """Write the messages of the evaluation of samples that were added before."""
        stretches = self._evaluation.extend(trace)
        self._sink.write_messages(merge(self._evaluation.messages(trace, stretches)))
        self._hashes.add_results(stretches)

    def report(self, event: RunEvent) -> None:
        """Write what happens to the run beside its samples.

        A replay, which knows nothing of it, has only what it makes unknown.
        """
        self._sink.write_messages(self._evaluation.occurrence(*event))

    def _own(self, trace: Trace, beside: Messages | None) -> Messages:
        """Return samples and messages beside them as they are written; count and hash them."""
        own = messages_of(_OBJECTS, trace.times_ns, encode_objects(trace), self._samples)
        written = own
        if beside is not None and len(beside):
            kept = _kept(beside)
            own, written = merge([own, kept]), merge([own, beside])
            self._topics.update(channel.topic for channel in beside.channels.values())
            self._images |= image_topics(beside.channels.values())
            self._messages += len(kept)
        if len(written):
            self._end_ns = max(self._end_ns, int(written.log_time_ns[-1]))
        self._samples += len(trace)
        self._hashes.add_samples(trace, own)
        return written

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Write a metadata record; the certificate covers that of a plan."""
        self._sink.add_metadata(name, data)
        if name == PLAN_METADATA:
            self._plan = dict(data)

    def end(self, *, interrupted: bool = False, dropped: int = 0, messages_dropped: int = 0) -> None:
        """Write what follows the last sample; the certificate is that of a replay of the log.

        Args:
            interrupted: whether the recording ended early.
            dropped, messages_dropped: how many samples, and messages beside them, found no place.
        """
        ending = self._ending(interrupted, dropped, messages_dropped)
        if self._samples:
            self._sink.write_messages(self._evaluation.end(self._end_ns))
        layout = self._evaluation.layout(self._topics, self._axes, self._images)
        self._sink.add_attachment(layout.name, layout.media_type, layout.data)
        streams = self._evaluation.streams
        if self._samples and streams:
            results = [
                (self._evaluation.trees[place], streams[place]) for place in self._evaluation.worst_first
            ]
            texts = {
                tree.title: verdict_text(
                    each.verdict,
                    float(each.robustness[0]),
                    declared_unit(tree.formula, self._evaluation.units),
                )
                for tree, each in results
            }
            self._sink.add_metadata(VERDICTS, texts)
        self._sink.add_metadata(ENDING, ending)
        self._sink.add_metadata(CERTIFICATE, self._hashes.certificate(self._files, self._plan))

    def break_off(self, *, dropped: int = 0, messages_dropped: int = 0) -> None:
        """Write the end of a log whose last samples could not be written: it has no certificate."""
        ending = self._ending(True, dropped, messages_dropped) | {"failed": "true"}
        self._sink.add_metadata(ENDING, ending)

    def _ending(self, interrupted: bool, dropped: int, messages_dropped: int) -> dict[str, str]:
        ending = {
            "samples": str(self._samples),
            "dropped": str(dropped),
            "interrupted": json.dumps(interrupted),
        }
        if self._messages or messages_dropped:
            ending |= {"messages": str(self._messages), "messages_dropped": str(messages_dropped)}
        return ending


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


_OBJECTS = protobuf_channel(OBJECTS, ObjectStates)


def _kept(messages: Messages) -> Messages:
    """Return messages without those on topics that a replay does not keep, such as planning times."""
    derived = [number for number, channel in messages.channels.items() if channel.topic in DERIVED]
    if not derived:
        return messages
    return select(messages, np.flatnonzero(~np.isin(messages.channel, derived)))

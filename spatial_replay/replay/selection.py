"""The samples of a source that are evaluated, with the messages beside them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.errors import LogError, SpecificationError, UsageError
from spatial_replay.logs.block import Block, Messages, messages_of
from spatial_replay.logs.merging import merge, select
from spatial_replay.logs.messages.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.objects import encode_objects
from spatial_replay.logs.reading import read_ahead, read_blocks
from spatial_replay.logs.source import Source, within
from spatial_replay.logs.topics import OBJECTS, protobuf_channel
from spatial_replay.monitor.instances import Choice, Instance, find_instances
from spatial_replay.monitor.stream import look_back
from spatial_replay.replay.window import Window
from spatial_replay.spec import check_names
from spatial_replay.spec.formula import Diagnostic, Specification
from spatial_replay.trace.trace import Trace, window_of


@dataclass(frozen=True, eq=False)
class Selection:
    """What of a source specifications are evaluated over; it can be read any number of times.

    Attributes:
        files: the specifications: what they look back at is read, too.
    """

    source: Source
    window: Window
    files: Sequence[Specification]

    def iter_blocks(self) -> Iterator[tuple[Block, Trace]]:
        """Each block, with the samples that count: those in the window, and before it, if any looks back."""
        window = self.window
        looks_back = any(look_back([spec.formula for spec in file.specs]) != (0, 0) for file in self.files)
        from_start = looks_back or window.every > 1
        seen = 0
        blocks = read_blocks(self.source, None if from_start else window.start_ns, window.end_ns)
        for block in read_ahead(blocks):
            trace = block.trace
            if window.every > 1:
                chosen = np.arange(-seen % window.every, len(trace), window.every, dtype=np.int64)
                seen += len(trace)
                trace = trace.take(chosen)
            yield block, trace

    def iter_traces(self) -> Iterator[Trace]:
        """The samples that count."""
        for _, trace in self.iter_blocks():
            yield trace

    def inside(self, trace: Trace) -> Trace:
        """Those samples that are in the window."""
        return within(trace, self.window.start_ns, self.window.end_ns)

    def own_messages(self, block: Block, first: int) -> Messages:
        """The source's messages in the window, and its samples where those are not among its messages.

        Args:
            first: the number of the block's first sample in the window.
        """
        messages = block.messages
        begin, end = window_of(messages.log_time_ns, self.window.start_ns, self.window.end_ns)
        chosen = messages if end - begin == len(messages) else select(messages, np.arange(begin, end))
        if any(channel.topic == OBJECTS for channel in messages.channels.values()):
            # in the source, messages of one time come in the order of its numbers of channels
            return merge([chosen])
        trace = self.inside(block.trace)
        return merge([chosen, messages_of(_OBJECTS, trace.times_ns, encode_objects(trace), first)])

    def instances(self, file: Specification, each: Mapping[str, str]) -> list[Instance]:
        """What is to be evaluated of a specification; a template reads the source for its objects.

        Args:
            each: for each parameter of a template, of this file or another, the objects that it stands for.

        Raises:
            UsageError: a template without its objects, or objects of a class that the log does not have.
        """
        parameters = {spec.parameter for spec in file.results}
        own = {parameter: choice for parameter, choice in each.items() if parameter in parameters}
        choices = [Choice.parse(parameter, choice) for parameter, choice in own.items()]
        classes: set[str | None] = set()
        traces = self._iter_with_classes(classes)
        found = find_instances(file, own, traces, self.window.start_ns, self.window.end_ns)
        for choice in choices:
            self._check_class(choice, classes)
        return found

    def check_names(self, objects: Collection[str], signals: Collection[str]) -> None:
        """That the log has every object and signal that a specification names.

        Args:
            objects, signals: names that were met in the window.

        Raises:
            SpecificationError: it lacks some.
        """
        missing = self._missing_names(set(objects), set(signals))
        if missing and not self.window.is_whole:
            names, others = set(objects), set(signals)
            for block in read_blocks(self.source):
                names.update(block.trace.names)
                others.update(block.trace.signals)
            missing = self._missing_names(names, others)
        if missing:
            raise SpecificationError(missing)

    def nothing_to_evaluate(self, faults: Sequence[str]) -> LogError | UsageError:
        """What to say where no sample is in the window.

        Args:
            faults: of the log, as far as they are known.
        """
        name = self.source.name
        spans = [
            (int(block.trace.times_ns[0]), int(block.trace.times_ns[-1]))
            for block in read_blocks(self.source)
            if len(block.trace)
        ]
        if not spans:
            return LogError("; ".join([f"{name} has no sample", *faults[:1]]))
        first_ns, last_ns = spans[0][0], spans[-1][1]
        return UsageError(
            f"{name} has no sample in the window asked for; its samples are from {first_ns} to {last_ns} ns, "
            f"{(last_ns - first_ns) / 1e9:.3f} s"
        )

    def _iter_with_classes(self, classes: set[str | None]) -> Iterator[Trace]:
        """The samples that count; the classes of their objects go to `classes`."""
        for block, trace in self.iter_blocks():
            classes.update(block.trace.classes)
            yield trace

    def _check_class(self, choice: Choice, classes: set[str | None]) -> None:
        """That some object of the log is of the class that was chosen, if none of those in the window is."""
        if not any(map(choice.fits, classes)) and not self.window.is_whole:
            for block in read_blocks(self.source):
                classes.update(block.trace.classes)
        if choice.class_name is not None and not any(map(choice.fits, classes)):
            known = ", ".join(sorted(name for name in classes if name)) or "none"
            raise UsageError(
                f"no object of {self.source.name} is of the class {choice.class_name!r}; "
                f"its classes are: {known}"
            )

    def _missing_names(self, objects: set[str], signals: set[str]) -> list[Diagnostic]:
        remarks = [
            remark for file in self.files for remark in check_names(file, sorted(objects), sorted(signals))
        ]
        return [remark for remark in remarks if remark.severity == "error"]


_OBJECTS = protobuf_channel(OBJECTS, ObjectStates)

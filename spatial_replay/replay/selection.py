"""The samples of a source that are evaluated, with the messages beside them.

Which samples of a log are evaluated.

The messages of a log itself, from any time on, and those of them that still stand then.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from spatial_replay.errors import LogError, SpecificationError, UsageError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.messages import Block, Channel, Messages, merge, messages_of, select
from spatial_replay.logs.objects.encode import encode_objects
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.source import Source, read_ahead, read_blocks, within
from spatial_replay.logs.topics import OBJECTS, protobuf_channel
from spatial_replay.monitor.instances import Choice, Instance, find_instances
from spatial_replay.monitor.stream import look_back
from spatial_replay.spec import check_names
from spatial_replay.spec.formula import Diagnostic, Specification
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace, window_of


@dataclass(frozen=True, slots=True)
class Window:
    """Which samples are evaluated: from `start_ns` to before `end_ns`, of every `every`th of the log."""

    start_ns: int = 0
    end_ns: int = FOREVER
    every: int = 1

    def __post_init__(self) -> None:
        if self.every < 1:
            raise UsageError(f"every is {self.every}; give 1 or more: 2 keeps every second sample")
        if self.end_ns <= self.start_ns:
            raise UsageError(f"the window from {self.start_ns} ns to {self.end_ns} ns is empty")

    @property
    def is_whole(self) -> bool:
        return self == Window()


def first_sample_ns(source: Source) -> int:
    """The time of a log's first sample.

    Raises:
        LogError: it has none.
    """
    for block in read_blocks(source):
        if len(block.trace):
            return int(block.trace.times_ns[0])
    raise LogError(f"{source.name} has no sample")


def has_samples_from(source: Source, time_ns: int) -> bool:
    """Whether a log goes on at or after a time."""
    return any(len(block.trace) for block in read_blocks(source, time_ns))


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


_FEW: Final = 2_000
_FEW_BYTES: Final = 1 << 26
"""Messages of one topic, and bytes of all such topics, that are held in memory."""

_PIECE: Final = 256
"""Samples that are made messages of at once."""


class OwnMessages:
    """What a copy of a log keeps of it: messages of any topic, samples where they are not among those.

    Topics with few messages are held in memory, since viewers show each message until the next one of its
    topic, however old it is; the others are read again when they are played.

    Attributes:
        channels: in the order in which they were met.
        start_ns, end_ns: times of the first and the last message or sample; 0 and -1 if there are none.
    """

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._samples: list[Trace] = []
        self._few: dict[Channel, list[Messages]] = {}
        self._counts: dict[Channel, int] = {}
        self._bytes = 0
        self.start_ns, self.end_ns = 0, -1

    @property
    def channels(self) -> tuple[Channel, ...]:
        return tuple(self._counts)

    def add(self, block: Block) -> None:
        """Take in the next block of the log."""
        window = self._selection.window
        begin, end = window_of(block.messages.log_time_ns, window.start_ns, window.end_ns)
        messages = select(block.messages, np.arange(begin, end))
        self._span(messages.log_time_ns)
        self._span(self._selection.inside(block.trace).times_ns)
        self._count(messages)
        if self._counts:
            self._samples = []
        else:
            self._samples.append(block.trace)

    def iter_from(self, start_ns: int) -> Iterator[Messages]:
        """Those at or after a time, in order, in pieces of bounded size.

        Raises:
            LogError: the log cannot be read any more.
        """
        selection = self._selection
        first = 0
        for block in self._iter_blocks(max(start_ns, selection.window.start_ns)):
            yield selection.own_messages(block, first)
            first += len(selection.inside(block.trace))

    def few_before(self, time_ns: int) -> Messages:
        """Of each topic with few messages the last one before a time."""
        before = [
            select(messages, np.arange(np.searchsorted(messages.log_time_ns, time_ns)))
            for pieces in self._few.values()
            for messages in pieces
        ]
        return standing(merge(before), time_ns)

    def _iter_blocks(self, start_ns: int) -> Iterator[Block]:
        """The log from a time on; from memory, in small pieces, where its samples are all that it has."""
        if self._counts:
            yield from read_blocks(self._selection.source, start_ns, self._selection.window.end_ns)
            return
        if len(self._samples) > 1:
            self._samples = [Trace.concatenate(self._samples)]
        for trace in self._samples:
            begin = int(np.searchsorted(trace.times_ns, start_ns))
            for at in range(begin, len(trace), _PIECE):
                yield Block(trace.slice(at, at + _PIECE))

    def _span(self, times_ns: Integers) -> None:
        if len(times_ns):
            first_ns, last_ns = times_ns[[0, -1]].tolist()
            self.start_ns = first_ns if self.end_ns < 0 else min(self.start_ns, first_ns)
            self.end_ns = max(self.end_ns, last_ns)

    def _count(self, messages: Messages) -> None:
        """Take in messages in the window; topics that have many are held no longer."""
        for number, channel in messages.channels.items():
            chosen = np.flatnonzero(messages.channel == number)
            if not len(chosen):
                continue
            if channel not in self._counts:
                self._few[channel] = []
            self._counts[channel] = self._counts.get(channel, 0) + len(chosen)
            if channel in self._few:
                own = select(messages, chosen)
                self._few[channel].append(own)
                self._bytes += _size(own)
                if self._counts[channel] > _FEW or self._bytes > _FEW_BYTES:
                    self._bytes -= sum(map(_size, self._few.pop(channel)))


class Reading:
    """A log's own messages from a time on, taken stretch by stretch."""

    def __init__(self, own: OwnMessages, start_ns: int) -> None:
        self._pieces = own.iter_from(start_ns)
        self._waiting = Messages()
        self._taken = 0
        self._is_over = False

    def take_before(self, end_ns: int) -> Messages:
        """Those before a time that were not taken yet.

        Raises:
            LogError: the log cannot be read any more.
        """
        while not self._is_over and not _reaches(self._waiting, end_ns):
            piece = next(self._pieces, None)
            if piece is None:
                self._is_over = True
            else:
                rest = select(self._waiting, np.arange(self._taken, len(self._waiting)))
                self._waiting, self._taken = merge([rest, piece]), 0
        begin = self._taken
        self._taken = max(begin, int(np.searchsorted(self._waiting.log_time_ns, end_ns)))
        return select(self._waiting, np.arange(begin, self._taken))


def standing(messages: Messages, time_ns: int) -> Messages:
    """Of each channel the messages from a time on or, where there are none, the last one before."""
    _, last = np.unique(messages.channel[::-1], return_index=True)
    chosen = messages.log_time_ns >= time_ns
    chosen[len(messages) - 1 - last] = True
    return select(messages, np.flatnonzero(chosen))


def _reaches(messages: Messages, end_ns: int) -> bool:
    return len(messages) > 0 and int(messages.log_time_ns[-1]) >= end_ns


def _size(messages: Messages) -> int:
    payloads: Sequence[bytes] = messages.payloads
    return sum(map(len, payloads))

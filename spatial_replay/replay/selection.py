"""Selection from a log: the messages that its copies keep, and logs cut to a window."""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.decoders import Topic, decoder_of
from spatial_replay.bags.definitions import full_type_name
from spatial_replay.errors import LogError, SpecificationError, UsageError
from spatial_replay.geometry.arrays import select
from spatial_replay.logs.mcap.read import McapSource
from spatial_replay.logs.messages import Block, Channel, Messages, merge
from spatial_replay.logs.objects import sample_messages
from spatial_replay.logs.remote import LogFile
from spatial_replay.logs.source import SAMPLES_A_GAP, MemorySource, Source, SourceOf, read_ahead, read_blocks
from spatial_replay.logs.topics import ALL, MAPPED, METADATA, OBJECTS, ZERO, is_kept
from spatial_replay.mapping.field_paths import get_field
from spatial_replay.mapping.message_types import TRANSFORM_TYPES, short_type
from spatial_replay.monitor.atoms.terms import look_back
from spatial_replay.monitor.ends import Needs, RunEnds
from spatial_replay.monitor.semantics import checked_semantics
from spatial_replay.monitor.stream import Instance, check_parameters, find_instances
from spatial_replay.monitor.verdict import Semantics
from spatial_replay.spec import check_names
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.format import format_bound, format_duration
from spatial_replay.spec.formula import Specification, Temporal
from spatial_replay.spec.walks import iter_formulas
from spatial_replay.text import Sentence, listing, time_text
from spatial_replay.trace.trace import FOREVER, LATEST_NS, TimePoint, Trace, within

if TYPE_CHECKING:
    from spatial_replay.bags.reader import MessageReader


KEEP_ALL: Final = (ALL,)
"""Topics that a copy keeps by default: all."""

_DECIMAL: Final = re.compile(r"\d{1,19}", re.ASCII)
CLIP_METADATA: Final = "spatial_replay_clip"
"""Name of the metadata record that describes a clip's origin."""


def default_keep(source: Source) -> tuple[str, ...]:
    """Return the topics of a source that an annotated log keeps: none for ROS 2, else all.

    rosbags refuses a file with a channel that is not ROS, and `ros2 bag` does not play such a file.
    Therefore the annotated log is opened next to the unchanged bag.
    """
    reader = _external(source)
    return () if reader is not None and reader.profile == "ros2" else KEEP_ALL


def source_keeping(source: Source, keep: Sequence[str] | None) -> Source:
    """Return a source whose blocks hold the samples and the messages that a copy keeps.

    Args:
        keep: "all", "mapped" for the topics of the samples, or patterns of topics such as "/camera/*".
            Several entries are combined. None leaves the source unchanged.

    Raises:
        UsageError: no topic of the log fits a pattern.
    """
    if keep is None:
        return source
    patterns = [pattern for pattern in keep if pattern not in (ALL, MAPPED)]
    if patterns:
        _check_patterns(source, patterns)
    return source.keeping(tuple(keep))


def _check_patterns(source: Source, patterns: Sequence[str]) -> None:
    """Check that every pattern fits a topic, because a misspelt pattern would lose messages."""
    topics = _topics(source)
    if not topics:
        raise UsageError(f"{source.name} has no messages to keep; it holds samples only")
    for pattern in patterns:
        if not any(is_kept(topic, (pattern,), ()) for topic in topics):
            raise UsageError(
                f"no topic of {source.name} fits {pattern!r}; it has {listing(topics)}; "
                "'all' keeps everything, 'mapped' the topics of the samples"
            )


def _topics(source: Source) -> list[str]:
    if isinstance(source, McapSource):
        with source.open_walk() as walk:
            return sorted({channel.topic for channel in walk.channels.values()})
    reader = _external(source)
    return [] if reader is None else [topic.name for topic in reader.topics()]


def _external(source: Source) -> MessageReader | None:
    """Return a reader of a source's external log; None for sources without a mapping."""
    path = source.path
    if not hasattr(source, "mapping") or not isinstance(path, LogFile):
        return None
    # readers of external logs are imported only for such a log
    from spatial_replay.bags.open import open_messages

    return open_messages(path)


@dataclass(frozen=True, slots=True)
class Window:
    """The samples to evaluate: one in `every` samples of the log, from `start_ns` to before `end_ns`."""

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


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How specifications are evaluated over a log.

    Attributes:
        window: the samples to evaluate.
        each: objects for each parameter of a template: "all", "class:NAME" or a name.
        semantics: "ltlf", or "paper": Def. 16 of the paper to the letter.
        strict_names: whether missing names are errors. Otherwise missing objects and signals are unknown, and
            a template has no result for a missing class.
        keep: messages of the log that a copy keeps: "all", "mapped", or patterns of topics; () for samples
            only. A copy with None keeps the topics of `default_keep`. Without a copy, None leaves the source
            unchanged.
        arrow: title of the result whose violation the scene points at; "" for the first result.
    """

    window: Window = Window()
    each: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    semantics: Semantics = "ltlf"
    strict_names: bool = False
    keep: tuple[str, ...] | None = None
    arrow: str = ""


DEFAULT_OPTIONS = ReplayOptions()

_FIRST_NS = 10**8
"""Duration after a log's first message in which the first sample is searched, nanoseconds."""


def look_before(files: Sequence[Specification]) -> bool:
    """Return whether specifications look back at samples before a window."""
    return any(look_back([spec.formula for spec in file.specs]) for file in files)


def first_sample_ns(source: Source) -> int:
    """Return the time of a log's first sample.

    Raises:
        LogError: the log has no sample.
    """
    source = source.keeping()
    begin_ns = source.begin_ns
    # if the index has the log's begin, a short part is read before the whole log
    for search_end_ns in (None,) if begin_ns is None else (begin_ns + _FIRST_NS, None):
        for block in read_blocks(source, None, search_end_ns):
            if len(block.trace):
                return int(block.trace.times_ns[0])
    raise LogError(f"{source.name} has no sample")


def named_zero_ns(source: Source) -> int | None:
    """Return the zero in a log's metadata: the time of the original log's first sample, or None."""
    records = dict(source.metadata())
    for record_name in (METADATA, CLIP_METADATA):
        zero_text = records.get(record_name, {}).get(ZERO, "")
        if _DECIMAL.fullmatch(zero_text) and int(zero_text) <= LATEST_NS:
            return int(zero_text)
    return None


def zero_ns(source: Source) -> int:
    """Return the zero of times in texts about a log: the zero in its metadata, or its first sample.

    Raises:
        LogError: the log has no sample.
    """
    recorded_zero_ns = named_zero_ns(source)
    return first_sample_ns(source) if recorded_zero_ns is None else recorded_zero_ns


def first_message_ns(source: Source) -> int | None:
    """Return the time of a log's first message, in nanoseconds; None if no index has it."""
    path = source.path
    if not isinstance(path, LogFile) or not (isinstance(source, McapSource) or hasattr(source, "mapping")):
        return None
    # readers of external logs are imported only for such a log
    from spatial_replay.bags.open import open_messages

    return open_messages(path).start_ns


def log_zero_ns(source: Source, window: Window, ends: RunEnds) -> int:
    """Return the zero of a log whose samples were read (see `zero_ns`)."""
    if window.start_ns or ends.begin_ns is None:
        return known_zero_ns(source)
    recorded_zero_ns = named_zero_ns(source)
    return ends.log_begin_ns if recorded_zero_ns is None else recorded_zero_ns


def last_sample_ns(source: Source) -> int:
    """Return the time of a log's last sample. The whole log is read.

    Raises:
        LogError: the log has no sample.
    """
    last_times_ns = [
        int(block.trace.times_ns[-1]) for block in read_blocks(source.keeping()) if len(block.trace)
    ]
    if not last_times_ns:
        raise LogError(f"{source.name} has no sample")
    return last_times_ns[-1]


def absolute_ns(point: TimePoint, source: Source) -> int:
    """Return a time on the clock of a log.

    Raises:
        LogError: the time is relative to a sample, and the log has no sample.
    """
    if point.origin == "last sample":
        return point.absolute_ns(last_ns=last_sample_ns(source))
    return point.absolute_ns(zero_ns(source) if point.origin == "first sample" else 0)


def window_from_points(
    source: Source, start: TimePoint | None, end: TimePoint | None, every: int = 1
) -> Window:
    """Return the window from `start` to before `end`; None stands for that end of the log.

    Raises:
        UsageError: the window is empty.
        LogError: a time is relative to a sample, and the log has no sample.
    """
    whole_log = Window()
    start_ns = whole_log.start_ns if start is None else absolute_ns(start, source)
    end_ns = whole_log.end_ns if end is None else absolute_ns(end, source)
    return Window(start_ns, end_ns, every)


def known_zero_ns(source: Source) -> int:
    """Return the zero of a log; 0 if it has no sample."""
    try:
        return zero_ns(source)
    except LogError:
        return 0


def has_samples_from(source: Source, time_ns: int) -> bool:
    """Return whether a log has samples at or after a time."""
    return any(len(block.trace) for block in read_blocks(source.keeping(), time_ns))


@dataclass(slots=True)
class LogNames:
    """Names of objects, signals and classes in a log, collected while it is read."""

    objects: set[str] = field(default_factory=set)
    signals: set[str] = field(default_factory=set)
    classes: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, trace: Trace) -> LogNames:
        """Return the names in a whole log."""
        names = cls()
        names.add(trace)
        return names

    def add(self, trace: Trace) -> None:
        """Add the names in some samples."""
        self.objects.update(trace.names)
        self.signals.update(trace.signals)
        self.classes.update(name for name in trace.classes if name)

    def frozen(self) -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
        """Return the names of objects, signals and classes as immutable sets."""
        return frozenset(self.objects), frozenset(self.signals), frozenset(self.classes)

    def check(self, file: Specification, each: Mapping[str, str]) -> tuple[Diagnostic, ...]:
        """Compare the names in a specification with the names in the log (see `check_names`)."""
        objects, signals, classes = sorted(self.objects), sorted(self.signals), sorted(self.classes)
        return check_names(file, objects, signals, classes=classes, each=each)


class CheckedTrace(NamedTuple):
    """The evaluated samples of a log.

    Attributes:
        missing: a warning for each missing name.
        zero_ns: zero of times in texts about the log (see function `zero_ns`).
    """

    trace: Trace
    missing: tuple[Diagnostic, ...]
    zero_ns: int


@dataclass(frozen=True, eq=False)
class Selection:
    """The part of a source that specifications are evaluated over. It can be read any number of times.

    Attributes:
        files: specifications. If they look back at samples before the window, these samples are read, too.
        needs: names in the specifications.
        looks_back: whether the specifications look back at samples before the window.

    Raises:
        UsageError: no template has a given parameter, the semantics lack an operator, or a time window fits
            between two samples of a pause (`max_gap`).
    """

    source: Source
    files: Sequence[Specification]
    options: ReplayOptions
    needs: Needs = field(init=False, repr=False)
    looks_back: bool = field(init=False, repr=False)
    _missing_names: Callable[..., list[Diagnostic]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", source_keeping(self.source, self.options.keep))
        object.__setattr__(self, "needs", Needs.of(self.files, self.options.each))
        object.__setattr__(self, "looks_back", look_before(self.files))
        # many logs of a batch have the same names
        object.__setattr__(self, "_missing_names", lru_cache(maxsize=16)(self._find_missing))
        templates = [spec for file in self.files for spec in file.results if spec.parameter is not None]
        check_parameters(templates, self.options.each)
        _check_windows(self.files, self.source.max_gap_ns or 0)
        checked_semantics(self.options.semantics, self.files)

    def over(self, source: Source) -> Selection:
        """Return the selection for another log.

        Raises:
            UsageError: a time window fits between two samples of a pause (`max_gap`).
        """
        _check_windows(self.files, source.max_gap_ns or 0)
        selection = copy(self)
        object.__setattr__(selection, "source", source_keeping(source, self.options.keep))
        return selection

    @property
    def window(self) -> Window:
        return self.options.window

    def run_ends(self) -> RunEnds:
        """Return the rule for the ends of the log. A window's start or end overrides the rule."""
        return RunEnds(self.needs, start=not self.window.start_ns, end=self.window.end_ns >= FOREVER)

    def read_blocks(
        self, *, messages: bool = True, ends: RunEnds | None = None
    ) -> Generator[tuple[Block, Trace], None, None]:
        """Read each block and its samples in the window.

        If a specification looks back or samples are thinned, samples before the window are read, too.

        Args:
            messages: whether the blocks need their messages.
            ends: a new result of `run_ends`, which callers can read afterwards.
        """
        ends = ends or self.run_ends()
        pending_blocks: deque[Block] = deque()
        for block, trace in self._read_samples(messages=messages):
            pending_blocks.append(block)
            for evaluated_trace in ends.add(trace):
                yield _trim(pending_blocks.popleft(), ends), evaluated_trace
        for evaluated_trace in ends.finish():
            yield _trim(pending_blocks.popleft(), ends), evaluated_trace
        if ends.remarks:
            remarks = tuple(Sentence(f"{self.source.name}: ", remark) for remark in ends.remarks)
            yield Block(Trace.empty(), remarks=remarks), Trace.empty()

    def _read_samples(self, *, messages: bool) -> Iterator[tuple[Block, Trace]]:
        """Read each block, and every Nth of its samples."""
        window = self.window
        # every Nth sample is counted from the log's first sample, independent of the window
        reads_from_start = self.looks_back or window.every > 1
        read_count = 0
        source = self.source if messages else self.source.keeping()
        for block in read_blocks(source, None if reads_from_start else window.start_ns, window.end_ns):
            trace = block.trace
            if window.every > 1:
                sample_indices = np.arange(
                    -read_count % window.every, len(trace), window.every, dtype=np.int64
                )
                read_count += len(trace)
                trace = trace.take(sample_indices)
            yield block, trace

    def iter_traces(self, ends: RunEnds | None = None) -> Iterator[Trace]:
        """Read the samples that `read_blocks` yields, with the doubts of their blocks."""
        for block, trace in read_ahead(self.read_blocks(messages=False, ends=ends)):
            yield replace(trace, doubts=block.doubts) if block.doubts else trace

    def trace(
        self, advance: Callable[[int], None] = lambda samples: None, ends: RunEnds | None = None
    ) -> Trace:
        """Read the samples that `read_blocks` yields, as one trace.

        Args:
            advance: function that is called with the number of samples of each block.
            ends: see `read_blocks`.
        """
        if isinstance(self.source, MemorySource) and self.window.is_whole and not self.source.trace.spans:
            # this trace has cached measurements
            advance(len(self.source.trace))
            return self.source.trace
        traces = []
        for trace in self.iter_traces(ends):
            traces.append(trace)
            advance(len(trace))
        return replace(Trace.concatenate(traces), units=self.source.axes.units)

    def checked_trace(self, advance: Callable[[int], None]) -> CheckedTrace:
        """Return the trace with a warning for each missing name (see `missing_names`).

        Raises:
            LogError, UsageError: the window has no sample.
            SpecificationError: a name is missing, and names are strict.
        """
        run_ends = self.run_ends()
        trace = self.trace(advance, run_ends)
        if not len(self.inside(trace)):
            raise self.nothing_to_evaluate(trace.faults)
        missing_names = self.missing_names(LogNames.of(trace))
        return CheckedTrace(trace, missing_names, log_zero_ns(self.source, self.window, run_ends))

    def inside(self, trace: Trace) -> Trace:
        """Return the samples in the window."""
        return within(trace, self.window.start_ns, self.window.end_ns)

    def own_messages(self, block: Block, first: int) -> Messages:
        """Return a block's messages in the window. Samples are encoded if no message contains them.

        Args:
            first: number of the window's samples in earlier blocks.
        """
        messages = block.messages
        window_messages = messages.within(self.window.start_ns, self.window.end_ns)
        if any(channel.topic == OBJECTS for channel in messages.channels.values()):
            # the source orders messages of equal time by channel number; `merge` orders them by content
            return merge([window_messages])
        trace = self.inside(block.trace)
        return merge([window_messages, sample_messages(trace, first)])

    def instances(self, file: Specification) -> list[Instance]:
        """Return the instances of a specification. Templates read the source to find their objects.

        Raises:
            UsageError: the objects of a template are not given.
        """
        parameters = {spec.parameter for spec in file.results}
        choices = {
            parameter: choice for parameter, choice in self.options.each.items() if parameter in parameters
        }
        return find_instances(file, choices, self.iter_traces(), self.window.start_ns, self.window.end_ns)

    def missing_names(self, names: LogNames) -> tuple[Diagnostic, ...]:
        """Return a warning for each missing object, signal and class of the specifications.

        Args:
            names: names in the evaluated samples.

        Raises:
            SpecificationError: a name is missing, and names are strict.
        """
        diagnostics = self._missing_names(*names.frozen())
        if diagnostics and not self.window.is_whole:
            # an object that appears outside the window is no mistake in the specification
            log_names = LogNames()
            for block in read_blocks(self.source.keeping()):
                log_names.add(block.trace)
            diagnostics = self._missing_names(*log_names.frozen())
        if diagnostics and self.options.strict_names:
            raise SpecificationError(diagnostics)
        return tuple(replace(diagnostic, severity="warning") for diagnostic in diagnostics)

    def nothing_to_evaluate(self, faults: Sequence[str]) -> LogError | UsageError:
        """Return the error for a window without any sample.

        Args:
            faults: faults of the log until now.
        """
        log_name = self.source.name
        block_spans_ns = [
            (int(block.trace.times_ns[0]), int(block.trace.times_ns[-1]))
            for block in read_blocks(self.source.keeping())
            if len(block.trace)
        ]
        if not block_spans_ns:
            return LogError("; ".join([f"{log_name} has no sample", *faults[:1]]))
        log_start_ns, log_end_ns = block_spans_ns[0][0], block_spans_ns[-1][1]
        recorded_zero_ns = named_zero_ns(self.source)
        origin_ns = log_start_ns if recorded_zero_ns is None else recorded_zero_ns
        pause_text = " and pause there" if log_start_ns < self.window.start_ns < log_end_ns else ""
        return UsageError(
            f"{log_name} has no sample in the requested window; its samples are from "
            f"{time_text(log_start_ns, origin_ns)} to {time_text(log_end_ns, origin_ns)} "
            f"({log_start_ns} to {log_end_ns} ns on its clock){pause_text}"
        )

    def _find_missing(
        self, objects: frozenset[str], signals: frozenset[str], classes: frozenset[str]
    ) -> list[Diagnostic]:
        names = LogNames({*objects}, {*signals}, {*classes})
        remarks = [diagnostic for file in self.files for diagnostic in names.check(file, self.options.each)]
        return [diagnostic for diagnostic in remarks if diagnostic.severity == "error"]


def _trim(block: Block, ends: RunEnds) -> Block:
    """Return a block with its trimmed samples and all its messages."""
    return replace(block, trace=ends.trim(block.trace))


def _check_windows(files: Sequence[Specification], max_gap_ns: int) -> None:
    """Check that no time window fits between two samples of a pause."""
    if not max_gap_ns:
        return
    sample_step_ns = max_gap_ns // SAMPLES_A_GAP
    nodes = (node for file in files for spec in file.results for node in iter_formulas(spec.formula))
    for bound in (node.bound for node in nodes if isinstance(node, Temporal) and node.bound is not None):
        excludes_present = bound.unit == "ns" and bound.lower > 0 and bound.upper is not None
        if excludes_present and (bound.upper or 0) - bound.lower < sample_step_ns:
            problem = (
                f"the window {format_bound(bound)} is too narrow for max_gap: it may lie between two samples"
            )
            remedy = f"make it {format_duration(sample_step_ns)} long, or max_gap shorter"
            raise UsageError(f"{problem} of a pause, {format_duration(sample_step_ns)} apart; {remedy}")


@dataclass(frozen=True)
class _ClippedSource(SourceOf):
    """A log between two times, preceded by the earlier messages that are still valid.

    Attributes:
        start_ns, end_ns: begin of the part, and its exclusive end.
        latched: last message of each topic before the part (see `_last_before`).
        about: metadata record of the clip.
    """

    start_ns: int
    end_ns: int
    latched: Messages
    about: Mapping[str, str]

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        read_start_ns = max(self.start_ns, start_ns or 0)
        read_end_ns = min(self.end_ns, FOREVER if end_ns is None else end_ns)
        if len(self.latched) and (start_ns or 0) <= self.start_ns:
            yield Block(Trace.from_samples(()), self.latched)
        for block in self.source.iter_blocks(read_start_ns, read_end_ns):
            # an external log is read from before the window, to find the values at its start
            yield replace(block, messages=block.messages.within(read_start_ns, read_end_ns))

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        records = tuple(record for record in self.source.metadata() if record[0] != CLIP_METADATA)
        return (*records, (CLIP_METADATA, self.about))


def clipped_source(source: Source, about: Mapping[str, str]) -> Source:
    """Return the part of a log that a clip contains, by the clip's metadata.

    Args:
        about: metadata record of the clip: times of the clip's first and last sample, and the kept topics.

    Raises:
        LogError: the record cannot be read.
        UsageError: no topic of the log fits a pattern.
    """
    try:
        start_ns, end_ns = int(about["start_ns"]), int(about["end_ns"])
        kept_topics = json.loads(about.get("keep", json.dumps(KEEP_ALL)))
        kept_source = source_keeping(source, tuple(map(str, kept_topics)))
    except (LookupError, TypeError, ValueError) as error:
        raise LogError(f"the metadata {CLIP_METADATA} of the clip cannot be read: {error}") from error
    # the record has the time of the last sample, but the end of the part is exclusive
    return _ClippedSource(kept_source, start_ns, end_ns + 1, _last_before(kept_source, start_ns), about)


def _last_before(source: Source, start_ns: int) -> Messages:
    """Return the last message of each topic before a time. Transforms have one message per frame.

    Samples are left out.
    """
    latest_messages: dict[tuple[Channel, str], Messages] = {}
    frame_readers: dict[Channel, Callable[[bytes], Sequence[str]]] = {}
    for messages in _messages_before(source, start_ns):
        for channel, message_rows in messages.by_channel():
            if channel.topic == OBJECTS:
                continue
            if channel not in frame_readers:
                frame_readers[channel] = _frame_names(channel)
            type_name = short_type(channel.schema.name) if channel.schema is not None else ""
            for row in message_rows.tolist() if type_name in TRANSFORM_TYPES else message_rows[-1:].tolist():
                message = select(messages, np.array([row]))
                for frame in frame_readers[channel](message.payloads[0]):
                    latest_messages[channel, frame] = message
    # one message may have the transforms of several frames
    distinct_messages = {id(message): message for message in latest_messages.values()}
    return merge(list(distinct_messages.values()))


def _messages_before(source: Source, end_ns: int) -> Iterator[Messages]:
    if isinstance(source, McapSource):
        with source.open_walk() as walk:
            topics = {channel.topic for channel in walk.channels.values()} - {OBJECTS}
            # a log of samples and derived messages has no latched messages
            if not any(map(source.is_wanted, topics)):
                return
    for block in read_blocks(source, None, end_ns):
        yield block.messages.within(0, end_ns)


def _frame_names(channel: Channel) -> Callable[[bytes], Sequence[str]]:
    """Return a function that reads the child frames of a message, or [""] if the message has none."""
    schema_name = "" if channel.schema is None else channel.schema.name
    decode: Callable[[bytes], Any] | None = None
    if short_type(schema_name) in TRANSFORM_TYPES:
        with suppress(LogError):
            type_name = full_type_name(schema_name) if channel.encoding in ("ros1", "cdr") else schema_name
            topic = Topic(channel.topic, type_name, channel.encoding, schema=channel.schema)
            decode = decoder_of(topic)

    def names(payload: bytes) -> Sequence[str]:
        try:
            return [""] if decode is None else _children(decode(payload))
        except (LogError, LookupError, ValueError, AttributeError, TypeError):
            # a broken message counts like a message without frames
            return [""]

    return names


def _children(message: Any) -> list[str]:
    try:
        transforms: Any = get_field(message, "transforms")
    except (LookupError, AttributeError, TypeError):
        transforms = [message]
    return [str(get_field(transform, "child_frame_id")) for transform in transforms] or [""]

"""A log in memory, evaluated repeatedly with other values for the constants of its specifications.

`LoadedLog` holds the log, `EditedFiles` the edited specifications, and `Evaluated` their results.
`OwnMessages` holds the log's own messages, and `Playback` plays all messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import PurePath
from types import MappingProxyType
from typing import Final

import numpy as np

from spatial_replay.annotate.annotator import shown_regions
from spatial_replay.annotate.evaluation import AnnotatedEvaluation
from spatial_replay.annotate.foxglove_layout import TextZero, layout_attachment
from spatial_replay.annotate.robustness import encode_curves
from spatial_replay.annotate.scene.extent import SceneBounds, SceneExtent, map_area
from spatial_replay.annotate.scene.scene_update import SceneState, scene_start
from spatial_replay.annotate.specification import logged_specifications
from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.geometry.arrays import Integers, select
from spatial_replay.logs.messages import Attachment, Block, Channel, Messages, join, merge
from spatial_replay.logs.source import MemorySource, Source, read_ahead, read_blocks
from spatial_replay.logs.topics import EVENT_LOG, EVENTS, RECENT_EVENTS, STANDING
from spatial_replay.monitor.ends import Needs
from spatial_replay.monitor.result import SpecResult, worst_first
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.monitor.vacuity import idle_templates
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.replay.engine import (
    Replayed,
    dropped_samples,
    plan_of,
    replayed_specs,
    with_stretches,
)
from spatial_replay.replay.selection import (
    DEFAULT_OPTIONS,
    KEEP_ALL,
    LogNames,
    ReplayOptions,
    Selection,
    log_zero_ns,
    look_before,
)
from spatial_replay.replay.specification_files import SpecificationFiles, constant_value
from spatial_replay.spec import parse_specification
from spatial_replay.spec.checks import with_numbers
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.format import format_duration, format_specification
from spatial_replay.spec.formula import Constant, Specification, iter_nodes
from spatial_replay.text import counted_from, interval_text, listing
from spatial_replay.trace.doubts import Doubt, distinct_doubts
from spatial_replay.trace.trace import Trace, within

_FEW: Final = 2_000
"""Maximum number of messages of a topic that is kept in memory."""
_FEW_BYTES: Final = 1 << 26
"""Maximum size of all topics that are kept in memory, bytes."""

_PIECE: Final = 256
"""Samples per encoded piece."""


class OwnMessages:
    """The messages of a copy of a log: the log's own messages, and its samples if no message contains them.

    Topics with few messages (a map, a transform) are kept in memory, because viewers show a message until the
    topic's next message. The other topics are read again for playback.

    Attributes:
        channels: channels in the order of their first messages.
        start_ns, end_ns: times of the first and the last message or sample; 0 and -1 for an empty log.
    """

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._samples: list[Trace] = []
        self._few_messages: dict[Channel, list[Messages]] = {}
        self._message_counts: dict[Channel, int] = {}
        self._few_bytes = 0
        self._sample_span_ns: tuple[int, int] = 0, 0
        self.start_ns, self.end_ns = 0, -1

    @property
    def channels(self) -> tuple[Channel, ...]:
        return tuple(self._message_counts)

    def add(self, block: Block) -> None:
        """Add the next block of the log."""
        window = self._selection.window
        messages = block.messages.within(window.start_ns, window.end_ns)
        self._span(messages.log_time_ns)
        times_ns = self._selection.inside(block.trace).times_ns
        self._span(times_ns)
        if len(times_ns):
            span_start_ns, span_end_ns = self._sample_span_ns
            # the end is tested, because a log may begin at 0
            self._sample_span_ns = (span_start_ns if span_end_ns else int(times_ns[0])), int(times_ns[-1]) + 1
        self._count(messages)
        # a log without messages is played from memory; other logs are read again
        if self._message_counts:
            self._samples = []
        else:
            self._samples.append(block.trace)

    def iter_from(self, start_ns: int) -> Iterator[Messages]:
        """Read the messages at or after a time in the order of time, in pieces of limited size.

        Raises:
            LogError: the log can no longer be read.
        """
        selection = self._selection
        first_sample = 0
        for block in self._iter_blocks(max(start_ns, selection.window.start_ns)):
            yield selection.own_messages(block, first_sample)
            first_sample += len(selection.inside(block.trace))

    def few_before(self, time_ns: int) -> Messages:
        """For each topic in memory, return the last message before a time."""
        earlier_messages = [
            select(messages, np.arange(np.searchsorted(messages.log_time_ns, time_ns)))
            for channel_pieces in self._few_messages.values()
            for messages in channel_pieces
        ]
        return latest_messages(merge(earlier_messages), time_ns)

    def _iter_blocks(self, start_ns: int) -> Iterator[Block]:
        """Read the log from a time on. A log without messages is read from memory, in small pieces."""
        if self._message_counts:
            for block in read_blocks(self._selection.source, start_ns, self._selection.window.end_ns):
                # trimmed samples at the ends of the log are left out
                yield replace(block, trace=within(block.trace, *self._sample_span_ns))
            return
        if len(self._samples) > 1:
            self._samples = [Trace.concatenate(self._samples)]
        for trace in self._samples:
            first_index = int(np.searchsorted(trace.times_ns, start_ns))
            for piece_begin in range(first_index, len(trace), _PIECE):
                yield Block(trace.slice(piece_begin, piece_begin + _PIECE))

    def _span(self, times_ns: Integers) -> None:
        if len(times_ns):
            first_ns, last_ns = times_ns[[0, -1]].tolist()
            self.start_ns = first_ns if self.end_ns < 0 else min(self.start_ns, first_ns)
            self.end_ns = max(self.end_ns, last_ns)

    def _count(self, messages: Messages) -> None:
        """Count messages in the window. Topics with many messages are removed from memory."""
        for channel, message_rows in messages.by_channel():
            if channel not in self._message_counts:
                self._few_messages[channel] = []
            self._message_counts[channel] = self._message_counts.get(channel, 0) + len(message_rows)
            if channel in self._few_messages:
                channel_messages = select(messages, message_rows)
                self._few_messages[channel].append(channel_messages)
                self._few_bytes += _size(channel_messages)
                if self._message_counts[channel] > _FEW or self._few_bytes > _FEW_BYTES:
                    self._few_bytes -= sum(map(_size, self._few_messages.pop(channel)))


class MessageCursor:
    """A position in a log's own messages. It only moves forward."""

    def __init__(self, own_messages: OwnMessages, start_ns: int) -> None:
        self._message_pieces = own_messages.iter_from(start_ns)
        self._buffer = Messages()
        self._next_row = 0
        self._is_exhausted = False

    def take_before(self, end_ns: int) -> Messages:
        """Move to a time, and return the earlier messages that were not returned yet.

        Raises:
            LogError: the log can no longer be read.
        """
        while not self._is_exhausted and not _reaches(self._buffer, end_ns):
            next_messages = next(self._message_pieces, None)
            if next_messages is None:
                self._is_exhausted = True
            else:
                remaining_messages = select(self._buffer, np.arange(self._next_row, len(self._buffer)))
                self._buffer, self._next_row = merge([remaining_messages, next_messages]), 0
        first_row = self._next_row
        self._next_row = max(first_row, int(np.searchsorted(self._buffer.log_time_ns, end_ns)))
        return select(self._buffer, np.arange(first_row, self._next_row))


def latest_messages(messages: Messages, time_ns: int) -> Messages:
    """Return each channel's messages from a time on, or else the channel's last message."""
    # the first index of a channel in reversed order is its last message
    _, reversed_rows = np.unique(messages.channel[::-1], return_index=True)
    is_shown = messages.log_time_ns >= time_ns
    is_shown[len(messages) - 1 - reversed_rows] = True
    return select(messages, np.flatnonzero(is_shown))


def _reaches(messages: Messages, end_ns: int) -> bool:
    return len(messages) > 0 and int(messages.log_time_ns[-1]) >= end_ns


def _size(messages: Messages) -> int:
    payloads: Sequence[bytes] = messages.payloads
    return sum(map(len, payloads))


MOST_NUMBERS: Final = 1 << 27
"""Maximum number of values in an evaluation, four per node and sample: 1 GiB."""


@dataclass(frozen=True, slots=True)
class EditedFiles:
    """The specifications with edited constants.

    Attributes:
        loaded: the evaluated log.
        files: edited specifications, as an annotated log stores them.
        given: edited values, by name.
        constants: all constants after the edits, by the names in `LoadedLog.constants`.
    """

    loaded: LoadedLog
    files: tuple[Specification, ...]
    given: Mapping[str, float | str]
    constants: Mapping[str, Constant]


class LoadedLog:
    """A log in memory, with specifications whose constants can be edited.

    Measurements between footprints are cached, so an edit computes only new measurements.

    Attributes:
        name: the log's name.
        options: options of the evaluation.
        constants: constants of the specifications as written, by the names that edits use.
        trace: all read samples, including samples before the window that operators look back at.
        inside: samples in the window.
        own: the log's own messages.
        faults, remarks: losses while reading, and other remarks of the source.
        doubts: assumptions that the log contradicts.
        missing: a warning for each missing name in the specifications.
        dropped: samples that the recorder dropped.
        plan: metadata of the plan that was recorded with the log; empty without a plan.
    """

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        options: ReplayOptions = DEFAULT_OPTIONS,
        *,
        saved: SpecificationFiles | None = None,
        advance: Callable[[int], None] = lambda samples: None,
    ) -> None:
        """Read the log.

        Args:
            saved: files of the specifications, if constants may be written into these files.
            advance: function that is called with the number of samples of each read block.

        Raises:
            LogError: the log has no sample, or cannot be read.
            UsageError: the window has no sample, or an option is invalid.
            SpecificationError: a name is missing, and names are strict.
        """
        keep = KEEP_ALL if options.keep is None else options.keep
        selection = Selection(source, tuple(files), replace(options, keep=keep))
        # evaluations read the samples in memory, which have no messages
        self.name, self.options, self._kept_topics = source.name, replace(options, keep=None), options.keep
        self._source, self._saved_files = source, saved
        self._looks_back = look_before(files)
        self._attachments = source.attachments
        self._files, self._logged_files = tuple(files), logged_specifications(files, source.axes.units)
        self.own = OwnMessages(selection)
        traces: list[Trace] = []
        remarks: list[str] = []
        doubts: list[Doubt] = []
        run_ends = selection.run_ends()
        for block, trace in read_ahead(selection.read_blocks(ends=run_ends)):
            traces.append(trace)
            remarks += block.remarks
            doubts += block.doubts
            self.own.add(block)
            advance(len(trace))
        self.trace = replace(Trace.concatenate(traces), units=source.axes.units)
        self.faults, self.remarks = tuple(self.trace.faults), tuple(dict.fromkeys(remarks))
        self.inside = selection.inside(self.trace)
        if not len(self.inside):
            raise selection.nothing_to_evaluate(self.faults)
        self.missing = selection.missing_names(LogNames.of(self.trace))
        self.dropped = dropped_samples(source)
        self.plan = plan_of(source)
        self.first_ns = log_zero_ns(source, options.window, run_ends)
        self.doubts = distinct_doubts(doubts, self.first_ns)
        self._needs, self._has_spans = run_ends.needs, run_ends.has_spans
        self._constant_places = _places(self._files)
        self.constants: Mapping[str, Constant] = self._constants(self._files)

    def with_files(self, files: Sequence[Specification]) -> LoadedLog:
        """Return the log with other specifications. Both logs share the samples and the cached measurements.

        The log is read again if only the new specifications look back at samples before the window. A log
        with trimmed ends is also read again if the new specifications name other objects or signals.

        Raises:
            UsageError: an option does not fit the specifications.
            SpecificationError: a name is missing, and names are strict.
        """
        looks_back_farther = self.options.window.start_ns and look_before(files) and not self._looks_back
        if looks_back_farther or (self._has_spans and Needs.of(files, self.options.each) != self._needs):
            options = replace(self.options, keep=self._kept_topics)
            return LoadedLog(self._source, files, options, saved=self._saved_files)
        # a shallow copy shares the samples and their cached measurements
        log = copy(self)
        log._files, log._logged_files = tuple(files), logged_specifications(files, self.trace.units)
        selection = Selection(self._source, tuple(files), self.options)
        log.missing = selection.missing_names(LogNames.of(self.trace))
        log._constant_places = _places(log._files)
        log.constants = log._constants(log._files)
        return log

    def write_constants(self, values: Mapping[str, float | str]) -> Mapping[str, float | str]:
        """Write values of constants into the files of the specifications. Only numbers change.

        Returns:
            The changed values.

        Raises:
            UsageError: the files may not be written, a constant is missing, or a later save changed a
                constant.
            SpecificationError, MissingFileError, OutputError: see `write_constants`.
        """
        if self._saved_files is None:
            raise UsageError(
                "constants are written into files that are watched; give --spec FILE and --watch"
            )
        return self._saved_files.write(self._by_file(values), self._files)

    def was_written(self, name: str) -> bool:
        """Return whether a constant's file still has the value that `write_constants` wrote."""
        return self._saved_files is not None and self._saved_files.was_written(*self._constant_places[name])

    def _by_file(self, values: Mapping[str, float | str]) -> list[dict[str, float | str]]:
        values_by_file = [dict[str, float | str]() for _ in self._files]
        for name, value in values.items():
            file_index, constant_name = self._place(name, value)
            values_by_file[file_index][constant_name] = value
        return values_by_file

    def edit(self, values: Mapping[str, float | str]) -> EditedFiles:
        """Return the specifications with other values for some constants. Only changed files are parsed.

        Args:
            values: numbers, or durations as texts ("2s"), by name of a constant. Other constants keep their
                written values.

        Raises:
            UsageError: a constant is missing, or a value is of another kind.
            SpecificationError: a specification is invalid with these values.
        """
        values_by_file = self._by_file(values)
        files = [
            _edit_file(file, file_values)
            for file, file_values in zip(self._files, values_by_file, strict=True)
        ]
        stored_files = [
            logged_file
            if file is file_as_written
            else with_numbers(_storable(file, file_as_written, logged_file), self.trace.units)
            for file, file_as_written, logged_file in zip(files, self._files, self._logged_files, strict=True)
        ]
        return EditedFiles(self, tuple(stored_files), MappingProxyType(dict(values)), self._constants(files))

    def evaluate(self, values: Mapping[str, float | str] | EditedFiles | None = None) -> Evaluated:
        """Evaluate the specifications over all samples, with other values for some constants.

        Args:
            values: as for `edit`, or a result of `edit`.

        Raises:
            UsageError: a constant is missing, a value is of another kind, or the numbers do not fit into
                memory.
            SpecificationError: a specification is invalid with these values.
        """
        edited_files = values if isinstance(values, EditedFiles) else self.edit(values or {})
        # `every` was applied when the samples were read
        options = replace(self.options, window=replace(self.options.window, every=1))
        selection = Selection(MemorySource(self.trace, self.name), edited_files.files, options)
        instances = [selection.instances(file) for file in edited_files.files]
        evaluation = AnnotatedEvaluation(
            edited_files.files, instances, options.semantics, self._attachments, units=self.trace.units
        )
        self._check_size(evaluation)
        stretches = evaluation.extend(self.trace)
        return Evaluated(self, edited_files, selection, evaluation, tuple(stretches))

    def _constants(self, files: Sequence[Specification]) -> Mapping[str, Constant]:
        return MappingProxyType(
            {
                name: files[file_index].constants[constant_name]
                for name, (file_index, constant_name) in self._constant_places.items()
            }
        )

    def _place(self, name: str, value: object) -> tuple[int, str]:
        """Check the kind of a constant's value, and return the index of its file and its name in the file."""
        if name not in self._constant_places:
            constant_names = tuple(self._constant_places)
            hint = (
                nearest_hint(name, constant_names)
                or f"the constants are: {', '.join(constant_names) or 'none'}"
            )
            raise UsageError(f"there is no constant {name!r} to change; {hint}")
        constant = self.constants[name]
        if isinstance(value, str) != (constant.duration_ns is not None):
            expected_kind = (
                "a number" if constant.duration_ns is None else "a duration, given as a text such as '2s'"
            )
            raise UsageError(
                f"{name} cannot be {value!r}: it is {expected_kind} ({constant_text(constant)} as written)"
            )
        return self._constant_places[name]

    def _check_size(self, evaluation: AnnotatedEvaluation) -> None:
        node_count = sum(1 for tree in evaluation.trees for _ in iter_nodes(tree.formula))
        number_count = 4 * node_count * len(self.inside)
        if number_count > MOST_NUMBERS:
            raise UsageError(
                f"{node_count} nodes at {len(self.inside)} samples are {number_count} numbers, more than the "
                f"{MOST_NUMBERS} that are held at once; narrow the window with --from and --to, or keep "
                "every Nth sample with --every"
            )


_MOST_NAMED: Final = 5
"""Maximum number of results, and of constants, that a summary names."""


@dataclass(frozen=True, eq=False)
class Evaluated:
    """An evaluation of the whole log with edited constants.

    Attributes:
        edited: the specifications with edited constants.
        selection: selection of the samples in memory.
        evaluation: the evaluation after the last sample.
        stretches: values of all nodes in all samples, one stretch for each tree of `evaluation`.
    """

    loaded: LoadedLog
    edited: EditedFiles
    selection: Selection
    evaluation: AnnotatedEvaluation
    stretches: tuple[SeriesBlock, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the results."""
        return worst_verdict(stream.verdict for stream in self.evaluation.streams)

    @cached_property
    def replayed(self) -> Replayed:
        """The results in the form of a replay. They have no certificate, because no log is written."""
        loaded = self.loaded
        times_ns = loaded.inside.times_ns
        return Replayed(
            log=loaded.name,
            samples=len(loaded.inside),
            first_ns=loaded.first_ns,
            start_ns=int(times_ns[0]),
            end_ns=int(times_ns[-1]),
            faults=counted_from(loaded.faults, loaded.first_ns),
            remarks=(
                *(doubt.remark(loaded.name) for doubt in loaded.doubts),
                *counted_from(loaded.remarks, loaded.first_ns),
                *loaded.dropped.remarks,
            ),
            missing=loaded.missing,
            dropped=loaded.dropped,
            unreadable=loaded.inside.unreadable_count,
            results=replayed_specs(
                self.evaluation.streams,
                self.evaluation.trees,
                self.edited.files,
                self.stretches,
                self.selection.iter_traces,
                loaded.first_ns,
                units=self.evaluation.units,
                doubts=loaded.doubts,
            ),
            vacuous=idle_templates(
                (spec for file in self.edited.files for spec in file.results),
                (tree.formula for tree in self.evaluation.trees),
                loaded.options.each,
                [class_name for class_name in loaded.inside.classes if class_name],
            ),
            certificate=MappingProxyType({}),
            semantics=loaded.options.semantics,
            doubts=loaded.doubts,
        )

    @cached_property
    def curves(self) -> bytes:
        """The message of /spatial/curves."""
        times_ns, results = self.loaded.inside.times_ns, self.replayed.results
        return encode_curves(times_ns, results, self.loaded.first_ns, self.summary)

    @property
    def summary(self) -> str:
        """A text with the verdicts of the results, the worst first, and with the edited constants."""
        sorted_results = [self.replayed.results[index] for index in worst_first(self.replayed.results)]
        text = "; ".join(map(_result_text, sorted_results[:_MOST_NAMED])) or "the template matched no objects"
        if len(sorted_results) > _MOST_NAMED:
            text += f"; and {len(sorted_results) - _MOST_NAMED} more, none worse"
        written_constants = self.loaded.constants
        changed_texts = [
            f"{name} = {constant_text(constant)}"
            for name, constant in self.edited.constants.items()
            if constant != written_constants[name]
        ]
        return text + (f" ({listing(changed_texts, _MOST_NAMED)})" if changed_texts else "")

    @cached_property
    def layout(self) -> Attachment:
        """The viewer layout for a server of this log."""
        topics = {channel.topic for channel in self.loaded.own.channels}
        extent = SceneBounds.of(self.loaded.inside, map_area(self.loaded.plan))
        contents = self.evaluation.contents(extent, topics)
        result_order = worst_first(self.replayed.results)
        text_zero = TextZero(self.loaded.first_ns, int(self.loaded.inside.times_ns[0]), "this playback")
        contents = contents._replace(
            order=result_order, zero=text_zero, planned=self.loaded.plan.get("specification", "")
        )
        return layout_attachment(contents, live=True)

    def part(self, begin: int, end: int) -> tuple[Trace, list[SeriesBlock]]:
        """Return samples in the window with their evaluation, from index `begin` to before `end`."""
        return with_stretches(self.loaded.inside.slice(begin, end), self.stretches)


def _result_text(result: SpecResult) -> str:
    number = interval_text(result.robustness, result.lower, result.upper)
    return f"`{result.title}` is {result.verdict}: robustness {number}"


def constant_text(constant: Constant) -> str:
    """Write a constant as a specification does: `70`, `2s`."""
    if constant.duration_ns is not None:
        return format_duration(constant.duration_ns)
    return repr(constant.value).removesuffix(".0")


def constant_values(constants: Mapping[str, Constant]) -> dict[str, float | str]:
    """Return constants as arguments of `LoadedLog.edit`."""
    return {name: constant_value(constant) for name, constant in constants.items()}


def _places(files: Sequence[Specification]) -> dict[str, tuple[int, str]]:
    """Return the file index and the name of each constant, by unique name.

    Names that several files have begin with the stem of the file.
    """
    all_names = [name for file in files for name in file.constants]
    return {
        f"{PurePath(file.filename).stem}.{name}" if all_names.count(name) > 1 else name: (
            file_index,
            name,
        )
        for file_index, file in enumerate(files)
        for name in file.constants
    }


def _edit_file(file: Specification, values: Mapping[str, float | str]) -> Specification:
    if all(value == constant_value(file.constants[name]) for name, value in values.items()):
        return file
    return parse_specification(file.source, filename=file.filename, profile=file.profile, constants=values)


def _storable(edited: Specification, written: Specification, stored: Specification) -> Specification:
    """Return an edited specification as a log stores it, with the new values in its text.

    Messages refer to nodes by places in the text. If the log stores a canonical text, the canonical text of
    the edited specification is parsed for its places.

    Args:
        stored: the written specification as a log stores it.
    """
    if stored.source == written.source:
        return replace(edited, filename=stored.filename)
    with suppress(SpecificationError):
        canonical_file = parse_specification(format_specification(edited), filename=edited.filename)
        if canonical_file == edited:
            return replace(canonical_file, filename=stored.filename)
    return replace(edited, filename=stored.filename)


_LOOK_BACK_NS: Final = 2_000_000_000
"""Time before a seek that is searched for the latest message of each topic, nanoseconds."""

_MOST_EVENTS: Final = 500
"""Maximum number of earlier events that a seek sends."""

_MOST_CHANGES: Final = 100
"""Maximum number of earlier changes of verdicts that a seek sends."""


class Playback:
    """The messages that an annotated log would have, in the order of time.

    After a seek, the messages equal the messages of a replay, for any sequence of `advance_to`. Only the
    scene differs: a seek draws it again, and deletes entities of other times.

    Attributes:
        evaluated: the evaluation. Another evaluation of the same log may replace it before a `seek`.
        start_ns, end_ns: times of the first sample, and of the last sample or message of the log.
        arrow: title of the result whose violation the scene points at; "" for the first result. The next
            `seek` applies a change.
        time_ns: time up to which messages were returned, inclusive.
        past: messages with the latest changes of results before the last `seek`, by time.
    """

    def __init__(self, evaluated: Evaluated) -> None:
        """Start before the first message. The first call must be `seek`."""
        log_messages = evaluated.loaded.own
        self._times_ns = evaluated.loaded.inside.times_ns
        self.start_ns, self.end_ns = int(self._times_ns[0]), log_messages.end_ns
        self.time_ns = self.start_ns
        self.past = Messages()
        self.evaluated = evaluated
        self.arrow = ""
        self._regions = shown_regions(evaluated.edited.files)
        self._start_scene = self._scene_start()
        self._annotator = evaluated.evaluation.new_annotator(self._start_scene)
        self._own_cursor = MessageCursor(log_messages, self.start_ns)
        self._next_sample = 0
        self._has_ended = False

    def _scene_start(self) -> SceneState:
        """Return the state of the scene before its first message."""
        loaded = self.evaluated.loaded
        start = scene_start(loaded.inside, self._regions, loaded.first_ns)
        return replace(start, extent=SceneExtent().with_area(map_area(loaded.plan)))

    @property
    def channels(self) -> tuple[Channel, ...]:
        """All channels that may have messages."""
        log_messages = self.evaluated.loaded.own
        first_messages = MessageCursor(log_messages, self.start_ns).take_before(self.start_ns + 1)
        derived_messages = Messages(channels=dict(enumerate(self.evaluated.evaluation.channels)))
        return tuple(
            dict.fromkeys(
                (*join([derived_messages, first_messages]).channels.values(), *log_messages.channels)
            )
        )

    def seek(self, time_ns: int) -> Messages:
        """Go to a time, and return the messages that a viewer shows at that time.

        These are the messages of the last sample, the specification, the latest events, and the last message
        of each of the log's own topics. `past` then has the changes of results before that sample.

        Raises:
            LogError: the log can no longer be read.
        """
        self.time_ns = min(max(time_ns, self.start_ns), self.end_ns)
        self._next_sample = int(np.searchsorted(self._times_ns, self.time_ns, side="right"))
        sample_index = max(self._next_sample - 1, 0)
        regions = shown_regions(self.evaluated.edited.files)
        if regions != self._regions:
            self._regions = regions
            self._start_scene = self._scene_start()
        scene = replace(self._annotator.scene, written_ns=None, last={}, extent=self._start_scene.extent)
        self._annotator = self.evaluated.evaluation.new_annotator(scene, self.arrow)
        self._has_ended = False
        earlier_messages = merge(
            self._annotator.pass_over(*self.evaluated.part(0, sample_index), _MOST_CHANGES)
        )
        self.past = earlier_messages.of_topics((STANDING,))
        events = _last(earlier_messages.of_topics((EVENTS, EVENT_LOG, RECENT_EVENTS)))
        derived_messages = self._annotator.messages(*self.evaluated.part(sample_index, self._next_sample))
        shown_messages = merge([events, *derived_messages, self._seek_own(int(self._times_ns[sample_index]))])
        return join([shown_messages, _last(self._end())])

    def advance_to(self, time_ns: int) -> Messages:
        """Play up to a time, inclusive, and return the messages since the last call.

        Raises:
            LogError: the log can no longer be read.
        """
        self.time_ns = min(max(time_ns, self.time_ns), self.end_ns)
        first_sample = self._next_sample
        self._next_sample = int(np.searchsorted(self._times_ns, self.time_ns, side="right"))
        derived_messages = self._annotator.messages(*self.evaluated.part(first_sample, self._next_sample))
        next_messages = merge([*derived_messages, self._own_cursor.take_before(self.time_ns + 1)])
        return join([next_messages, self._end()])

    def reach_ns(self, samples: int) -> int:
        """Return the time of the sample that is `samples` ahead; the log's end if fewer samples are left."""
        sample_index = self._next_sample + samples - 1
        return int(self._times_ns[sample_index]) if sample_index < len(self._times_ns) else self.end_ns

    def _end(self) -> Messages:
        """Return the final messages once, when the end of the log is reached."""
        if self._has_ended or self.time_ns < self.end_ns:
            return Messages()
        self._has_ended = True
        return merge(self._annotator.end(self.end_ns, self.evaluated.evaluation.finals))

    def _seek_own(self, sample_ns: int) -> Messages:
        """Return the latest of the log's own messages of each topic, and all own messages at `time_ns`."""
        log_messages = self.evaluated.loaded.own
        since_ns = max(min(self.time_ns - _LOOK_BACK_NS, sample_ns), log_messages.start_ns)
        self._own_cursor = MessageCursor(log_messages, since_ns)
        messages = merge([log_messages.few_before(since_ns), self._own_cursor.take_before(self.time_ns + 1)])
        return latest_messages(messages, self.time_ns)


def _last(events: Messages) -> Messages:
    event_rows = [
        channel_rows[-1 if channel.topic == RECENT_EVENTS else -_MOST_EVENTS :]
        for channel, channel_rows in events.by_channel()
    ]
    return select(events, np.sort(np.concatenate([np.empty(0, np.int64), *event_rows])))

"""The smallest part of a log that still shows why a verdict is what it is, as a log of its own.

A window of samples is searched whose replay has the verdict, the robustness and the witness of the whole log.
No window is measured again: atoms are those of the first replay, except the first few that look back to before
the window, where a clip has no samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.decoders import decoder_of
from spatial_replay.bags.topic import Topic
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.logs.mcap.reader import McapSource
from spatial_replay.logs.messages import Attachment, Block, Channel, Messages, merge, select
from spatial_replay.logs.source import Source, axes_of, read_blocks
from spatial_replay.logs.topics import OBJECTS
from spatial_replay.mapping.field_paths import get_field
from spatial_replay.mapping.message_types import TRANSFORM_TYPES, short_type
from spatial_replay.monitor.atoms.delays import look_back
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.offline import evaluate_offline
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.monitor.witness.path import End, deciding_path
from spatial_replay.replay.annotated import run_replay
from spatial_replay.replay.engine import Replayed
from spatial_replay.replay.kept_messages import source_keeping
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions, Selection, Window
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import Outline, Specification
from spatial_replay.trace.axes import Axes
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import ABSENT, Trace, window_of

CLIP_METADATA: Final = "spatial_replay_clip"
"""The metadata record that says what a clip was cut from."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A clip that was written.

    Attributes:
        whole, replayed: the replay of the log, and that of the clip.
        start_ns, end_ns: times of the first and the last sample of the clip.
        kept: the titles of the results that the clip has in common with the log.
        source_bytes, clip_bytes: sizes of the files; None for a log that is not one file.
    """

    whole: Replayed
    replayed: Replayed
    start_ns: int
    end_ns: int
    kept: tuple[str, ...]
    source_bytes: int | None
    clip_bytes: int

    @property
    def is_whole(self) -> bool:
        """Whether nothing smaller has the same verdict and witness."""
        return self.replayed.samples == self.whole.samples

    @property
    def changed(self) -> tuple[str, ...]:
        """The titles of results with another verdict than in the log; none of `kept`."""
        verdicts = {result.title: result.verdict for result in self.whole.results}
        return tuple(
            result.title
            for result in self.replayed.results
            if verdicts.get(result.title) is not result.verdict
        )


def clip_log(
    source: Source,
    files: Sequence[Specification],
    output: Path,
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    around_ns: int = 0,
    of: Sequence[str] = (),
    inputs: Sequence[Path] = (),
    source_bytes: int | None = None,
    advance: Callable[[int], None] = lambda samples: None,
) -> Clip:
    """Write the smallest part of a log that has its verdicts, robustness and witnesses.

    Neither end can be cut further, by one sample or by any power of two, without another result. Messages are
    those in the window, and before it the last of each topic and the last transform of each frame; times stay.

    Args:
        options: what is evaluated; `keep` chooses the topics.
        around_ns: keep at least so much before and after the samples that decide.
        of: names of the results to keep; all of them without it.
        inputs: files that the output must not be.
        source_bytes: the size of the log, for the record.

    Raises:
        UsageError: no such result, an option that cannot work, an output that is an input.
        LogError: no sample in the log. OutputError: the output cannot be written.
    """
    if options.window.every != 1:
        raise UsageError("a clip keeps every sample; leave out --every")
    if options.semantics != "ltlf":
        raise UsageError("clips are cut by witnesses, which only the semantics 'ltlf' has")
    first_pass = replace(options, keep=())
    whole = run_replay(source, files, first_pass, keep_leaves=True, advance=advance)
    chosen = _chosen(whole.results, of)
    search = _Search(source, files, first_pass, chosen, around_ns)
    start_ns, end_ns = search.window()
    kept = source_keeping(source, options.keep)
    clipped = _ClippedSource(
        kept,
        start_ns,
        end_ns + 1,
        _latched(kept, start_ns),
        {
            "source": source.name,
            "samples": str(whole.samples),
            "start_ns": str(start_ns),
            "end_ns": str(end_ns),
            "kept": ", ".join(result.title for result in chosen),
        },
    )
    replayed = run_replay(
        clipped, files, replace(options, window=Window(), keep=None), keep_leaves=True, output=output, inputs=inputs
    )
    return Clip(
        whole,
        replayed,
        start_ns,
        end_ns,
        tuple(result.title for result in chosen),
        source_bytes,
        output.stat().st_size,
    )


def _chosen(results: Sequence[SpecResult], of: Sequence[str]) -> list[SpecResult]:
    names = [name for result in results for name in (result.title, result.name)]
    for name in of:
        if name not in names:
            known = ", ".join(dict.fromkeys(result.title for result in results))
            hint = nearest_hint(name, names) or f"there are {known}"
            raise UsageError(f"no result is named {name!r}; {hint}")
    return [result for result in results if not of or result.title in of or result.name in of]


class _Reason(NamedTuple):
    """A result on some samples, as a clip has to repeat it.

    Attributes:
        ends: lower and upper end, the nominal ones, too.
        nodes: the ids on the path to the deciding atom.
        decided_ns: the sample that decides.
    """

    ends: tuple[float, ...]
    nodes: tuple[int, ...]
    decided_ns: int


class _Part:
    """One result, evaluated over any window of its samples."""

    def __init__(self, result: SpecResult, trace: Trace | None, regions: Mapping[str, Outline]) -> None:
        if result.leaves is None:
            raise UsageError("a clip needs the leaves of every sample, which were not stored")
        self._result = result
        self._leaves, self._times_ns = result.leaves, result.times_ns
        self._order = result.evidence.instance.program.leaves
        self._trace, self._regions = trace, regions
        self._reach = look_back([result.formula])
        # an instance lasts from the first to the last appearance of its object
        self._seen_ns: Integers | None = None
        if result.object is not None and trace is not None:
            self._seen_ns = trace.times_ns[_appearances(trace, result.object)]
        self.reason = self._reason(self._leaves, self._times_ns)

    def over(self, start_ns: int, end_ns: int) -> _Reason | None:
        """Return the reason over the samples from one time to another, both included; None without any."""
        if self._seen_ns is not None:
            begin, end = window_of(self._seen_ns, start_ns, end_ns + 1)
            if begin == end:
                return None
            start_ns, end_ns = self._seen_ns[[begin, end - 1]].tolist()
        begin, end = window_of(self._times_ns, start_ns, end_ns + 1)
        if begin == end:
            return None
        return self._reason(self._within(begin, end, start_ns), self._times_ns[begin:end])

    def _within(self, begin: int, end: int, first_ns: int) -> Floats:
        """Return the leaves of a window as a log of its own has them: nothing is known before its start."""
        leaves = self._leaves[:, :, begin:end]
        samples, duration_ns = self._reach
        if self._trace is None or (samples, duration_ns) == (0, 0):
            return leaves
        times_ns = self._times_ns[begin:end]
        count = max(samples, int(np.searchsorted(times_ns, first_ns + duration_ns)))
        from_, to = window_of(self._trace.times_ns, int(times_ns[0]), int(times_ns[-1]) + 1)
        head = self._trace.slice(from_, min(from_ + count, to))
        if not len(head):
            return leaves
        instance = self._result.evidence.instance
        known = leaf_values(TraceScene(head, self._regions), self._order, instance.bindings)
        channels = max(len(known), len(leaves))
        leaves = np.array(in_channels(leaves, channels))
        leaves[:, :, : len(head)] = in_channels(known, channels)
        return leaves

    def _reason(self, leaves: Floats, times_ns: Integers) -> _Reason:
        done = evaluate_offline(self._result.formula, self._order, np.ascontiguousarray(leaves), times_ns)
        ends = tuple(float(end[0]) + 0.0 for wide in (True, False) for end in done.ends(0, wide=wide))
        verdict = final_verdict(*ends[:2])
        end = {Verdict.SATISFIED: End.LOW, Verdict.VIOLATED: End.HIGH}.get(verdict, End.OPEN)
        steps = deciding_path(self._result.formula, done, times_ns, 0, end).steps
        return _Reason(ends, tuple(step.node for step in steps), int(times_ns[steps[-1].sample]))


class _Search:
    """Searches the window: from the samples that decide outwards, then from both ends inwards."""

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        options: ReplayOptions,
        results: Sequence[SpecResult],
        around_ns: int,
    ) -> None:
        needs_samples = any(
            result.object is not None or look_back([result.formula]) != (0, 0) for result in results
        )
        trace = None
        if needs_samples:
            trace = Trace.concatenate(list(Selection(source, files, options).iter_traces()))
        self._parts = [
            _Part(result, trace, _regions(files, result)) for result in results if len(result.times_ns)
        ]
        self._times_ns = _joined_times([result.times_ns for result in results])
        decided = [part.reason.decided_ns for part in self._parts]
        last = len(self._times_ns) - 1
        self._inner = (
            int(np.searchsorted(self._times_ns, min(decided) - around_ns)),
            min(last, int(np.searchsorted(self._times_ns, max(decided) + around_ns, side="right")) - 1),
        )
        self._known: dict[tuple[int, int], bool] = {}

    def window(self) -> tuple[int, int]:
        """Return the times of the first and the last sample of the clip."""
        first, last = self._outwards()
        while True:
            begin = self._cut(first, self._inner[0], lambda at, other=last: self._holds(at, other))
            end = self._cut(last, self._inner[1], lambda at, other=begin: self._holds(other, at))
            if (begin, end) == (first, last):
                return int(self._times_ns[first]), int(self._times_ns[last])
            first, last = begin, end

    def _outwards(self) -> tuple[int, int]:
        """Widen the window in doubling steps until it has the results; small ones cost least."""
        low, high = self._inner
        last, step = len(self._times_ns) - 1, 0
        while True:
            window = max(low - step, 0), min(high + step, last)
            if window == (0, last) or self._holds(*window):
                return window
            step = max(2 * step, 1)

    def _cut(self, outer: int, inner: int, holds: Callable[[int], bool]) -> int:
        """Return the end nearest to the inner one that holds, among those at doubling distances, then halves."""
        direction = 1 if inner >= outer else -1
        distance = abs(inner - outer)
        step = 0
        fails: int | None = None
        while step < distance:
            at = inner - direction * step
            if holds(at):
                break
            fails, step = at, max(2 * step, 1)
        else:
            at = outer
        if fails is None:
            return at
        while abs(fails - at) > 1:
            middle = (fails + at) // 2
            if holds(middle):
                at = middle
            else:
                fails = middle
        return at

    def _holds(self, first: int, last: int) -> bool:
        """Say whether a window has every result, for the same reason."""
        if (first, last) not in self._known:
            times = int(self._times_ns[first]), int(self._times_ns[last])
            self._known[first, last] = all(_same(part.over(*times), part.reason) for part in self._parts)
        return self._known[first, last]


def _same(one: _Reason | None, other: _Reason) -> bool:
    return one is not None and one == other


def _joined_times(times_ns: Sequence[Integers]) -> Integers:
    longest = max(times_ns, key=len)
    return longest if all(len(each) == len(longest) for each in times_ns) else np.unique(np.concatenate(times_ns))


def _regions(files: Sequence[Specification], result: SpecResult) -> Mapping[str, Outline]:
    """Return the regions of the file that a result comes from."""
    return next((file.regions for file in files for spec in file.specs if spec.formula is result.formula), {})


def _appearances(trace: Trace, name: str) -> Booleans:
    return np.asarray(trace.rows[:, trace.names.index(name)] != ABSENT)


# --------------------------------------------------------------------------------- the log of the clip


@dataclass(frozen=True)
class _ClippedSource:
    """A log from one time to before another, after the messages that are still valid then."""

    source: Source
    start_ns: int
    end_ns: int
    latched: Messages
    about: Mapping[str, str]

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def kind(self) -> str:
        return self.source.kind

    @property
    def axes(self) -> Axes:
        return axes_of(self.source)

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        first = max(self.start_ns, start_ns or 0)
        last = min(self.end_ns, FOREVER if end_ns is None else end_ns)
        if len(self.latched) and (start_ns or 0) <= self.start_ns:
            yield Block(Trace.from_samples(()), self.latched)
        yield from self.source.iter_blocks(first, last)

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`."""
        return self.source.attachments()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        records = tuple(each for each in self.source.metadata() if each[0] != CLIP_METADATA)
        return (*records, (CLIP_METADATA, self.about))


def _latched(source: Source, start_ns: int) -> Messages:
    """Return the last message before a time of each topic but the samples, and of each frame's transform."""
    latest: dict[tuple[Channel, str], Messages] = {}
    frames: dict[Channel, Callable[[bytes], Sequence[str]]] = {}
    for messages in _messages_before(source, start_ns):
        for number, channel in messages.channels.items():
            own = np.flatnonzero(messages.channel == number)
            if channel.topic == OBJECTS or not len(own):
                continue
            if channel not in frames:
                frames[channel] = _frame_names(channel)
            kind = short_type(channel.schema.name) if channel.schema is not None else ""
            for index in own.tolist() if kind in TRANSFORM_TYPES else own[-1:].tolist():
                message = select(messages, np.array([index]))
                for frame in frames[channel](message.payloads[0]):
                    latest[channel, frame] = message
    distinct = {id(message): message for message in latest.values()}
    return merge(list(distinct.values()))


def _messages_before(source: Source, end_ns: int) -> Iterator[Messages]:
    if isinstance(source, McapSource):
        with source.open_walk() as walk:
            if {channel.topic for channel in walk.channels.values()} <= {OBJECTS}:
                return
    for block in read_blocks(source, None, end_ns):
        yield block.messages


def _frame_names(channel: Channel) -> Callable[[bytes], Sequence[str]]:
    """Return a function from a message to the frames that it places; one name for other messages."""
    kind = "" if channel.schema is None else channel.schema.name
    decode: Callable[[bytes], Any] | None = None
    if short_type(kind) in TRANSFORM_TYPES:
        with suppress(LogError):
            topic = Topic(channel.topic, kind, channel.encoding, schema=channel.schema, metadata=channel.metadata)
            decode = decoder_of(topic)

    def names(payload: bytes) -> Sequence[str]:
        try:
            return [""] if decode is None else _children(decode(payload))
        except (LogError, LookupError, ValueError, AttributeError, TypeError):
            # a broken message counts like one of another topic
            return [""]

    return names


def _children(message: Any) -> list[str]:
    try:
        transforms = get_field(message, "transforms")
    except (LookupError, AttributeError, TypeError):
        transforms = [message]
    return [str(get_field(each, "child_frame_id")) for each in transforms] or [""]

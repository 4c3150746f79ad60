"""The smallest part of a log that still shows why a verdict is what it is, as a log of its own.

A window of samples is searched whose replay has the verdict, the robustness and the witness of the whole log,
and those of the part that settled a violation first.
No window is measured again: atoms are those of the first replay, except the first few that look back to
before the window, where a clip has no samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.decoders import decoder_of
from spatial_replay.bags.ros_definitions import full_type_name
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
from spatial_replay.monitor.semantics import require_ltlf
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.monitor.witness.path import End, deciding_path
from spatial_replay.replay.annotated import run_replay
from spatial_replay.replay.engine import Replayed
from spatial_replay.replay.kept_messages import KEEP_ALL, source_keeping
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
        kept: the titles of the results, and names of specs within them, that are as in the log.
        source_bytes, clip_bytes: sizes of the files; None for a log that is not one file here.
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


def cut_clip(
    source: Source,
    files: Sequence[Specification],
    output: Path,
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    around_ns: int = 0,
    of: Sequence[str] = (),
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> Clip:
    """Write the smallest part of a log that has its verdicts, robustness and witnesses.

    Neither end can be cut further, by one sample or by any power of two, without another result. Messages are
    those in the window, and before it the last of each topic and the last transform of each frame. Times
    stay.

    Args:
        options: what is evaluated; `keep` chooses the topics.
        around_ns: keep at least so much before and after the samples that decide.
        of: names of the specs to keep; all results without it.
        inputs: files that the output must not be.

    Raises:
        UsageError: no such spec, an option that cannot work, an output that is an input.
        LogError: no sample in the log. OutputError: the output cannot be written.
    """
    if options.window.every != 1:
        raise UsageError("a clip keeps every sample; leave out --every")
    require_ltlf(options.semantics, "a clip")
    first_pass = replace(options, keep=())
    whole = run_replay(source, files, first_pass, keep_leaves=True, advance=advance)
    chosen = _chosen(whole.results, of)
    search = _Search(source, files, first_pass, chosen, around_ns)
    start_ns, end_ns = search.window()
    kept = source_keeping(source, KEEP_ALL if options.keep is None else options.keep)
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
            "kept": ", ".join(each.title for each in chosen),
        },
    )
    replayed = run_replay(
        clipped,
        files,
        replace(options, window=Window(), keep=None),
        keep_leaves=True,
        output=output,
        inputs=inputs,
    )
    return Clip(
        whole,
        replayed,
        start_ns,
        end_ns,
        tuple(each.title for each in chosen),
        _size_of(source),
        output.stat().st_size,
    )


def _size_of(source: Source) -> int | None:
    """Return the size of a log on this machine that is one file."""
    path = getattr(source, "path", None)
    return path.stat().st_size if isinstance(path, Path) and path.is_file() else None


class _Kept(NamedTuple):
    """A node whose verdict a clip keeps, by its id, and what it is called."""

    result: SpecResult
    node: int
    title: str


def _chosen(results: Sequence[SpecResult], of: Sequence[str]) -> list[_Kept]:
    """Return the results, or the results and named specs within them that are asked for."""
    if not of:
        return [_Kept(result, 0, result.title) for result in results]
    found, known = [], dict[str, None]()
    for result in results:
        names = {node.name: node.id for node in reversed(result.nodes) if node.name is not None}
        known |= dict.fromkeys([result.title, *names])
        if result.title in of or result.name in of:
            found.append(_Kept(result, 0, result.title))
        found += [_Kept(result, names[name], name) for name in of if names.get(name)]
    for name in of:
        if name not in known and all(name != result.name for result in results):
            hint = nearest_hint(name, known) or f"there are {', '.join(known)}"
            raise UsageError(f"no spec is named {name!r}; {hint}")
    return found


def _first_causes(kept: Sequence[_Kept]) -> Iterator[_Kept]:
    """Yield the part of each node that settled its violation: not always the one that its number is of."""
    for each in kept:
        first = next(iter(each.result.causes_of(each.node)), None)
        if first is not None and first.settled_ns is not None and first.node != each.node:
            yield _Kept(each.result, first.node, each.title)


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
    """One node of a result, evaluated over any window of its samples."""

    def __init__(self, kept: _Kept, trace: Trace | None, regions: Mapping[str, Outline]) -> None:
        result = kept.result
        if result.leaves is None:
            raise UsageError("a clip needs the leaves of every sample, which were not stored")
        self._result, self._node = result, kept.node
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
        ends = tuple(
            float(end[0]) + 0.0 for wide in (True, False) for end in done.ends(self._node, wide=wide)
        )
        verdict = final_verdict(*ends[:2])
        end = {Verdict.SATISFIED: End.LOW, Verdict.VIOLATED: End.HIGH}.get(verdict, End.OPEN)
        steps = deciding_path(self._result.formula, done, times_ns, self._node, end).steps
        return _Reason(ends, tuple(step.node for step in steps), int(times_ns[steps[-1].sample]))


class _Search:
    """Searches the window: from the samples that decide outwards, then from both ends inwards."""

    def __init__(
        self,
        source: Source,
        files: Sequence[Specification],
        options: ReplayOptions,
        kept: Sequence[_Kept],
        around_ns: int,
    ) -> None:
        results = [each.result for each in kept]
        needs_samples = any(
            result.object is not None or look_back([result.formula]) != (0, 0) for result in results
        )
        trace = None
        if needs_samples:
            trace = Selection(source, files, options).trace()
        self._parts = [
            _Part(each, trace, _regions(files, each.result))
            for each in (*kept, *_first_causes(kept))
            if len(each.result.times_ns)
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
            begin = self._cut(first, self._inner[0], partial(self._holds, last=last))
            end = self._cut(last, self._inner[1], partial(self._holds, begin))
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
        """Return an end near the inner one that holds: at doubling distances first, then by halves."""
        direction = 1 if inner >= outer else -1
        fails, step, at = None, 0, inner
        while step < abs(inner - outer) and not holds(at):
            fails, step = at, max(2 * step, 1)
            at = inner - direction * step
        if step >= abs(inner - outer):
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
    return (
        longest
        if all(len(each) == len(longest) for each in times_ns)
        else np.unique(np.concatenate(times_ns))
    )


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
        for block in self.source.iter_blocks(first, last):
            # an external log is read from before the window, for what is valid in it
            yield replace(block, messages=_between(block.messages, first, last))

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
        yield _between(block.messages, 0, end_ns)


def _between(messages: Messages, start_ns: int, end_ns: int) -> Messages:
    begin, end = window_of(messages.log_time_ns, start_ns, end_ns)
    return messages if end - begin == len(messages) else select(messages, np.arange(begin, end))


def _frame_names(channel: Channel) -> Callable[[bytes], Sequence[str]]:
    """Return a function from a message to the frames that it places; one name for other messages."""
    kind = "" if channel.schema is None else channel.schema.name
    decode: Callable[[bytes], Any] | None = None
    if short_type(kind) in TRANSFORM_TYPES:
        with suppress(LogError):
            name = full_type_name(kind) if channel.encoding in ("ros1", "cdr") else kind
            topic = Topic(channel.topic, name, channel.encoding, schema=channel.schema)
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
        transforms: Any = get_field(message, "transforms")
    except (LookupError, AttributeError, TypeError):
        transforms = [message]
    return [str(get_field(each, "child_frame_id")) for each in transforms] or [""]

"""Clips (parts of a run that a recorder writes around a trigger) and conditions of triggers."""

from __future__ import annotations

import json
import math
import queue
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from spatial_replay.errors import OutputError, UsageError, system_reason
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Channel, Messages, Row
from spatial_replay.logs.output_file import open_output
from spatial_replay.logs.topics import TRIGGER, ZERO
from spatial_replay.monitor.monitor import Monitor, Update
from spatial_replay.recording.log import (
    GATHER_S,
    Missed,
    RecorderLog,
    Recording,
    RunEnd,
    RunEvent,
    VerdictChanges,
    warm_up,
)
from spatial_replay.spec.formula import Specification, iter_nodes
from spatial_replay.text import named_arguments, nearest_hint, plural
from spatial_replay.trace.trace import Sample, Trace
from spatial_replay.trace.units import Axes

MOST_BYTES: Final = 256 * 2**20
"""Default memory limit of a ring, bytes."""

EVENT: Final = "event"
"""Condition that any event fulfils."""

MANUAL: Final = "manual"
"""Condition that is never fulfilled, for triggers that only fire by hand."""

_VERDICTS: Final = ("violated", "satisfied")
_BELOW: Final = re.compile(
    r"(?P<name>.+?)\s*<=?\s*(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)(?P<possible>\s+possible)?$"
)

Condition: TypeAlias = Callable[[Sequence[Update], bool], str | None]


class _Below(NamedTuple):
    """Threshold of a robustness interval.

    The upper end must be below the threshold. With `is_possible`, the lower end is enough.
    """

    threshold: float
    is_possible: bool


@named_arguments
@dataclass(frozen=True, slots=True)
class Trigger:
    """The condition at which a recorder writes a clip, and the length of the clip.

    Attributes:
        when: one condition, or a sequence of conditions. "violated" and "satisfied" are for any spec, "NAME
            violated" for one spec. "NAME < 0.2" fires when the spec's robustness is certainly below a number,
            "NAME < 0.2 possible" when it may be below. "event" fires at every change of a verdict or of a
            lasting sign. "manual" never fires by itself; `Recorder.trigger` fires any trigger. The recorder,
            which has the specifications, checks the names.
        before_s, after_s: time before and after the trigger in the clip, on the clock of the samples.
        most_bytes: memory limit of the ring. A ring that is too small for `before_s` is reported.
    """

    when: str | Sequence[str] = "violated"
    before_s: float = 10.0
    after_s: float = 5.0
    most_bytes: int = MOST_BYTES

    def __post_init__(self) -> None:
        for name in ("before_s", "after_s"):
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value >= 0):
                raise UsageError(f"{name} is {value!r}; give seconds, 0 or more")
        if self.most_bytes < 2**20:
            raise UsageError(f"most_bytes is {self.most_bytes}; a ring takes 1 MB (1048576) or more")
        for condition_text in self.texts:
            _parse_condition(condition_text)

    @property
    def texts(self) -> list[str]:
        """The conditions; each condition fires the trigger."""
        return [condition.strip() for condition in ([self.when] if isinstance(self.when, str) else self.when)]


def condition_of(text: str, files: Sequence[Specification], monitors: Sequence[Monitor]) -> Condition:
    """Return the function that checks a condition.

    The function maps a sample's updates to the reason for firing, or to None.

    Args:
        monitors: monitors of the specifications, which give the updates.

    Raises:
        UsageError: the text is no condition, or names no spec.
    """
    name, target = _parse_condition(text)
    if target == MANUAL:
        return lambda updates, has_changed: None
    if target == EVENT:
        return lambda updates, has_changed: EVENT if has_changed else None
    if not files:
        raise UsageError(f"the trigger {text!r} waits for a spec, but there is none; give a specification")
    if not name:
        return lambda updates, _: next(
            (
                f"{spec.spec.name} {target}"
                for update in updates
                for spec in update.specs
                if str(spec.verdict) == target
            ),
            None,
        )
    names = {
        node.name
        for file in files
        for spec in file.results
        for _, _, node in iter_nodes(spec.formula)
        if node.name is not None
    } | {spec.name for file in files for spec in file.results}
    if name not in names:
        hint = nearest_hint(name, names) or f"the specs are {', '.join(sorted(names))}"
        raise UsageError(f"the trigger {text!r} names no spec: {name!r}; {hint}")
    if isinstance(target, _Below):
        monitor = next(monitor for monitor in monitors if name in monitor.names)
        reason = f"{name} {'possibly ' if target.is_possible else ''}below {target.threshold:g}"
        # a robustness is possibly below if its lower end is below, certainly if its upper end is below
        bound = 0 if target.is_possible else 1
        return lambda updates, _: reason if monitor.interval(name)[bound] < target.threshold else None
    return lambda updates, _: f"{name} {target}" if _verdict(updates, name) == target else None


def _parse_condition(text: str) -> tuple[str, str | _Below]:
    """Return the spec of a condition, "" for none, and a verdict, `EVENT`, `MANUAL` or a threshold.

    Raises:
        UsageError: the text is no condition.
    """
    name, _, verdict = text.rpartition(" ")
    if text in (*_VERDICTS, EVENT, MANUAL):
        return "", text
    if name and verdict in _VERDICTS:
        return name.strip(), verdict
    if (match := _BELOW.match(text)) is not None:
        with suppress(ValueError):
            return match["name"], _Below(float(match["number"]), match["possible"] is not None)
    hint = nearest_hint(text, [*_VERDICTS, EVENT, MANUAL])
    raise UsageError(
        f"the trigger {text!r} is not understood; {f'{hint}; ' if hint else ''}write 'violated',"
        " 'NAME violated', 'NAME satisfied', 'NAME < 0.2', 'NAME < 0.2 possible', 'event' or 'manual'"
    )


def _verdict(updates: Sequence[Update], name: str) -> str:
    """Return the verdict of a spec; "" before the first evaluation."""
    for update in updates:
        if name in update.places and update.specs[update.places[name][0]].numbers is not None:
            return str(update.node(name).verdict)
    return ""


_SLICE_BYTES: Final = 8 * 2**20
"""Approximate amount that is written to a clip between two reads of the queue, bytes."""

_LATE_S: Final = 2.0
"""Time for which a clip waits for late samples, s; a source may delay its last samples for a second."""

_LATE_NS: Final = 10**9
"""Maximum delay of messages behind samples, ns."""

_MESSAGE_BYTES, _SAMPLE_BYTES, _OBJECT_BYTES = 320, 400, 600
"""Memory of a message without its payload, of a sample, and of a sample's object without corners, bytes."""

_MOST_STATIC: Final = 256
"""Maximum number of static transforms in memory."""
_MOST_EVENTS: Final = 256
"""Maximum number of external events in memory."""
_MOST_MISSED: Final = 2**18
"""Maximum number of dropped samples whose times are in memory; dropped messages have the same limit."""
_STATIC: Final = "tf_static"
"""Last part of the name of a topic with static transforms, which every clip needs regardless of their age."""


@dataclass(frozen=True, slots=True)
class TriggeredClip:
    """A log that a trigger has written.

    Attributes:
        path: path of the log.
        reason: first condition that fired during the clip.
        time_ns: time at which the trigger fired.
        held_s: time before the trigger that the clip covers, s.
        dropped: number of samples in the clip's time that were dropped because the queue was full.
    """

    path: Path
    reason: str
    time_ns: int
    held_s: float
    dropped: int


class _RingEntry(NamedTuple):
    """A message, sample or external event in the ring; `size` is its memory in bytes."""

    time_ns: int
    content: Row | Sample | RunEvent
    size: int = _MESSAGE_BYTES


class _ManualTrigger(NamedTuple):
    """A trigger by hand, with the times of the newest queued sample and message, -1 for none."""

    reason: str
    sample_ns: int
    message_ns: int


class _OpenClip:
    """An unfinished clip with the entries that wait to be written."""

    def __init__(
        self,
        path: Path,
        files: Sequence[Specification],
        about: Mapping[str, str],
        reason: str,
        trigger_ns: int,
    ) -> None:
        self.path, self.reasons, self.trigger_ns = path, [reason], trigger_ns
        self.waiting_entries: deque[_RingEntry] = deque()
        self.waiting_bytes = 0
        self.begin_ns = self.until_ns = trigger_ns
        self.first_ns: int | None = None
        self.last_put_s = time.monotonic()
        self.channels: Mapping[int, Channel] = {}
        self._stream = open_output(path)
        try:
            # with a clock, chunks are closed after a second, so that a kill loses little
            self._writer = LogWriter(self._stream, clock=time.monotonic)
            self._recording = Recording(self._writer, files, {**about, "trigger": reason})
        except BaseException:
            with suppress(OutputError):
                self._stream.close()
            raise
        self._last_sample_ns = -1

    def put(self, entry: _RingEntry) -> None:
        self.waiting_entries.append(entry)
        self.waiting_bytes += entry.size
        self.last_put_s = time.monotonic()

    def write(self, most_bytes: float = _SLICE_BYTES) -> None:
        """Write waiting entries, up to about `most_bytes`."""
        samples: list[Sample] = []
        messages: list[Row] = []
        events: list[RunEvent] = []
        written_bytes = 0
        while self.waiting_entries and written_bytes < most_bytes:
            entry = self.waiting_entries.popleft()
            written_bytes += entry.size
            self.first_ns = entry.time_ns if self.first_ns is None else min(self.first_ns, entry.time_ns)
            if isinstance(entry.content, Row):
                messages.append(entry.content._replace(log_time_ns=entry.time_ns))
            elif isinstance(entry.content, RunEvent):
                events.append(entry.content)
            # times of samples in a log must increase
            elif entry.time_ns > self._last_sample_ns:
                samples.append(entry.content)
                self._last_sample_ns = entry.time_ns
        self.waiting_bytes -= written_bytes
        if not (samples or messages or events):
            return
        self._recording.add(Trace.from_samples(samples), Messages.from_rows(self.channels, messages))
        for event in events:
            self._recording.report(event)

    def flush(self) -> None:
        self._writer.flush()
        self._stream.flush()

    def finish(self, end: RunEnd, before_s: float, after_s: float) -> TriggeredClip:
        """Write all waiting entries, and close the log."""
        try:
            self.write(math.inf)
            held_s = 0.0 if self.first_ns is None else max(0.0, (self.trigger_ns - self.first_ns) / 1e9)
            record = {
                "reasons": json.dumps(self.reasons),
                "time_ns": str(self.trigger_ns),
                "before_s": repr(before_s),
                "after_s": repr(after_s),
                "held_before_s": repr(held_s),
            }
            self._writer.add_metadata(TRIGGER, record)
            self._recording.end(end)
            self._writer.close()
        finally:
            self._stream.close()
        return TriggeredClip(self.path, self.reasons[0], self.trigger_ns, held_s, end.dropped)


class ClipLog(RecorderLog):
    """The ring of a recorder with a trigger, and its clips; see `RecorderLog`.

    A trigger that fires during a clip extends the clip. If the ring has evicted entries between the clip and
    the trigger, another clip begins instead.

    Attributes:
        held_bytes: memory of the ring, bytes.
        written: completed clips.
    """

    gather_s = GATHER_S / 4

    def __init__(
        self, folder: Path, files: Sequence[Specification], about: Mapping[str, str] | None, trigger: Trigger
    ) -> None:
        """Compile the specifications, and create the folder."""
        self._folder, self._files, self._about = folder, files, dict(about or {})
        self._trigger = trigger
        condition_texts = trigger.texts
        units = Axes.from_metadata(self._about).units
        self._monitors = [Monitor(file, units=units) for file in files]
        self._conditions = [(text, condition_of(text, files, self._monitors)) for text in condition_texts]
        self._was_fulfilled = dict.fromkeys(condition_texts, False)
        self._before_ns, self._after_ns = round(trigger.before_s * 1e9), round(trigger.after_s * 1e9)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: {system_reason(error)}") from None
        self._changes = VerdictChanges(files)
        warm_up(files, ())
        self._samples: deque[_RingEntry] = deque()
        self._messages: deque[_RingEntry] = deque()
        self._static: deque[_RingEntry] = deque(maxlen=_MOST_STATIC)
        self._events: deque[_RingEntry] = deque(maxlen=_MOST_EVENTS)
        self._missed: dict[Missed, deque[int]] = {
            "sample": deque(maxlen=_MOST_MISSED),
            "message": deque(maxlen=_MOST_MISSED),
        }
        self._channels: Mapping[int, Channel] = {}
        self.held_bytes = 0
        self._newest_ns = self._evicted_ns = -1
        self._zero_ns: int | None = None
        # time of the newest entry, ns, and its arrival on the monotonic clock, s
        self._latest_arrivals: dict[type, tuple[int, float]] = {}
        self._open: _OpenClip | None = None
        self._manual_triggers: deque[_ManualTrigger] = deque()
        self._remarks: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._has_overflowed = False
        self.written: tuple[TriggeredClip, ...] = ()

    @property
    def is_busy(self) -> bool:
        """Whether entries of a clip wait to be written, or a trigger by hand is due."""
        return self._is_due or (self._open is not None and bool(self._open.waiting_entries))

    def fire(self, reason: str, sample_ns: int, message_ns: int) -> None:
        """Fire by hand, from any thread.

        Args:
            sample_ns, message_ns: times of the newest queued sample and message, -1 for none. The clip is
                around the later of both times. If both are -1, the next sample or message is taken.
        """
        self._manual_triggers.append(_ManualTrigger(reason, sample_ns, message_ns))

    def take_remarks(self) -> tuple[str, ...]:
        """Return the remarks since the last call."""
        remarks: list[str] = []
        with suppress(queue.Empty):
            while True:
                remarks.append(self._remarks.get_nowait())
        return tuple(remarks)

    def add(self, samples: Sequence[Sample], trace: Trace, messages: Messages) -> None:
        """Add the next samples and messages to the ring, and write entries of an open clip."""
        entries = [*self._held_messages(messages)]
        entries += [_RingEntry(sample.time_ns, sample, _sample_bytes(sample)) for sample in samples]
        self._begin_due()
        # entries are added in order of time, so that the ring holds the messages around the sample that fires
        for entry in sorted(entries, key=lambda entry: entry.time_ns):
            if self._zero_ns is None and isinstance(entry.content, Sample):
                self._zero_ns = entry.time_ns
            self._hold(entry)
            if isinstance(entry.content, Sample):
                self._evaluate(entry.content)
            self._begin_due()
        if self._open is not None:
            self._open.write()
            # a clip may not hold more memory than the ring
            while self._open.waiting_bytes > self._trigger.most_bytes:
                self._open.write()
            if not self._open.waiting_entries and self._is_past(self._open.until_ns):
                self._finish(is_interrupted=False)

    def miss(self, time_ns: int, kind: Missed) -> None:
        """Record the time of a dropped sample or message. A clip counts the drops within its time."""
        self._missed[kind].append(time_ns)

    def report(self, event: RunEvent) -> None:
        """Add an external event to the ring; fire if the trigger has the condition `EVENT`."""
        entry = _RingEntry(event.time_ns, event)
        self._events.append(entry)
        if self._open is not None and event.time_ns <= self._open.until_ns:
            self._open.put(entry)
        if EVENT in self._trigger.texts:
            self._begin(event.what, event.time_ns)

    def flush(self) -> None:
        """Hand written data to the operating system, and finish a clip if no more samples arrive."""
        if self._open is None:
            return
        self._open.flush()
        # if no entry comes for longer than the clip lasts, the run has stopped
        if (
            not self._open.waiting_entries
            and time.monotonic() - self._open.last_put_s > self._trigger.after_s + 2.0
        ):
            self._finish(is_interrupted=True)

    def end(self, end: RunEnd) -> None:
        """Finish the open clip."""
        if self._open is not None:
            is_whole = self._newest_ns >= self._open.until_ns
            self._finish(is_interrupted=end.interrupted or not is_whole)

    break_off = end

    def close(self) -> None:
        """Empty the ring."""
        self._samples.clear()
        self._messages.clear()

    def _evaluate(self, sample: Sample) -> None:
        """Fire for each condition that holds now and did not hold at the previous sample."""
        updates = [monitor.update(sample) for monitor in self._monitors]
        changes = list(self._changes.after(updates))
        has_changed = not all(change.is_first for change in changes)
        for condition_text, condition in self._conditions:
            reason = condition(updates, has_changed)
            if reason is not None and not self._was_fulfilled[condition_text]:
                self._begin(reason, sample.time_ns)
            # every event fires; any other condition fires only when it begins to hold
            self._was_fulfilled[condition_text] = reason is not None and condition_text != EVENT

    @property
    def _is_due(self) -> bool:
        """Whether the ring has reached the time of the oldest trigger by hand; False before any entry."""
        if not self._manual_triggers or self._newest_ns < 0:
            return False
        evaluated_ns, _ = self._latest_arrivals.get(Sample, (-1, 0.0))
        return (
            self._manual_triggers[0].sample_ns <= evaluated_ns
            and self._manual_triggers[0].message_ns <= self._newest_ns
        )

    def _begin_due(self) -> None:
        """Open the clips of all due triggers by hand."""
        while self._is_due:
            manual = self._manual_triggers.popleft()
            reached_ns = max(manual.sample_ns, manual.message_ns)
            self._begin(manual.reason, self._newest_ns if reached_ns < 0 else reached_ns)

    def _is_past(self, time_ns: int) -> bool:
        """Return whether no more samples and messages up to a time are expected."""
        now_s = time.monotonic()
        return all(
            newest_ns > time_ns or now_s - arrived_s > _LATE_S
            for newest_ns, arrived_s in self._latest_arrivals.values()
        )

    def _held_messages(self, messages: Messages) -> Iterator[_RingEntry]:
        self._channels = messages.channels or self._channels
        static_ids = {
            channel_id
            for channel_id, channel in messages.channels.items()
            if channel.topic.rsplit("/", 1)[-1] == _STATIC
        }
        for row in messages.rows():
            entry = _RingEntry(row.log_time_ns, row, _MESSAGE_BYTES + len(row.payload))
            if row.channel in static_ids:
                self._static.append(entry)
            yield entry

    def _hold(self, entry: _RingEntry) -> None:
        content_type: type = Sample if isinstance(entry.content, Sample) else Row
        (self._samples if content_type is Sample else self._messages).append(entry)
        self.held_bytes += entry.size
        self._newest_ns = max(self._newest_ns, entry.time_ns)
        newest_ns = (
            max(self._latest_arrivals[content_type][0], entry.time_ns)
            if content_type in self._latest_arrivals
            else entry.time_ns
        )
        self._latest_arrivals[content_type] = newest_ns, time.monotonic()
        self._evict()
        clip = self._open
        if clip is not None and entry.time_ns <= clip.until_ns:
            clip.channels = self._channels
            clip.put(entry)

    def _begin(self, reason: str, at_ns: int) -> None:
        """Open a clip around a time, or extend the open clip if the ring has all entries since its end."""
        if self._open is not None:
            until_ns = self._open.until_ns
            if self._evicted_ns > until_ns or (at_ns > until_ns and self._is_past(until_ns)):
                self._finish(is_interrupted=False)
        if self._open is not None:
            clip = self._open
            clip.reasons.append(reason)
            following_entries = self._between(clip.until_ns + 1, at_ns + self._after_ns)
        else:
            clip_number = len(self.written) + 1
            # logs of an earlier run in this folder keep their numbers
            while any(self._folder.glob(f"{clip_number:04d}-*.mcap")):
                clip_number += 1
            slug = re.sub(r"[^A-Za-z0-9_]+", "-", reason).strip("-")[:60] or "trigger"
            path = self._folder / f"{clip_number:04d}-{slug}.mcap"
            zero_metadata = {} if self._zero_ns is None else {ZERO: str(self._zero_ns)}
            clip = self._open = _OpenClip(path, self._files, {**self._about, **zero_metadata}, reason, at_ns)
            clip.channels = self._channels
            begin_ns = clip.begin_ns = at_ns - self._before_ns
            for static_entry in self._static:
                if static_entry.time_ns < begin_ns:
                    # older static transforms are repeated at the clip's begin
                    clip.put(static_entry._replace(time_ns=max(begin_ns, 0)))
            following_entries = self._between(begin_ns, at_ns + self._after_ns)
        for entry in following_entries:
            clip.put(entry)
        clip.until_ns = max(clip.until_ns, at_ns + self._after_ns)

    def _between(self, begin_ns: int, end_ns: int) -> list[_RingEntry]:
        entries = [*self._messages, *self._samples, *self._events]
        entries_within = [entry for entry in entries if begin_ns <= entry.time_ns <= end_ns]
        return sorted(entries_within, key=lambda entry: entry.time_ns)

    def _evict(self) -> None:
        """Evict entries that are too old, and then the oldest entries above the memory limit."""
        # a late sample may fire, so the age of entries counts from the newest sample
        reached_ns, arrived_s = self._latest_arrivals.get(Sample, (self._newest_ns, 0.0))
        if time.monotonic() - arrived_s > _LATE_S:
            reached_ns = self._newest_ns
        oldest_ns = reached_ns - self._before_ns - _LATE_NS
        while self._samples or self._messages:
            ring = self._messages
            if not self._messages or (self._samples and self._samples[0].time_ns < self._messages[0].time_ns):
                ring = self._samples
            is_too_large = self.held_bytes > self._trigger.most_bytes
            if ring[0].time_ns >= oldest_ns and not is_too_large:
                return
            evicted_entry = ring.popleft()
            self._evicted_ns = max(self._evicted_ns, evicted_entry.time_ns)
            self.held_bytes -= evicted_entry.size
            # this entry was within `before_s`, so the ring is too small
            if is_too_large and evicted_entry.time_ns >= oldest_ns + _LATE_NS and not self._has_overflowed:
                self._has_overflowed = True
                held_s = max(0.0, (reached_ns - evicted_entry.time_ns) / 1e9)
                needed_bytes = self._trigger.most_bytes * self._trigger.before_s / max(held_s, 1e-3)
                self._remarks.put(
                    f"the ring of {_megabytes(self._trigger.most_bytes)} holds {held_s:.1f} s, not the "
                    f"{self._trigger.before_s:g} s asked for; about {_megabytes(needed_bytes * 1.1)} would do"
                )

    def _finish(self, *, is_interrupted: bool) -> None:
        clip, self._open = self._open, None
        if clip is None:
            return
        begin_ns, until_ns = clip.begin_ns, clip.until_ns
        missed_counts = {
            kind: sum(begin_ns <= time_ns <= until_ns for time_ns in tuple(times_ns))
            for kind, times_ns in self._missed.items()
        }
        end = RunEnd(is_interrupted, missed_counts["sample"], missed_counts["message"])
        finished_clip = clip.finish(end, self._trigger.before_s, self._trigger.after_s)
        self.written = (*self.written, finished_clip)
        further_text = plural(len(clip.reasons) - 1, "further trigger") if len(clip.reasons) > 1 else ""
        dropped_text = "".join(
            f"; {plural(count, kind)} of it {'was' if count == 1 else 'were'} dropped"
            for kind, count in missed_counts.items()
            if count
        )
        self._remarks.put(
            f"wrote {clip.path}: {finished_clip.held_s:.1f} s before and up to {self._trigger.after_s:g} s"
            f" after {finished_clip.reason}{f', and {further_text}' if further_text else ''}{dropped_text}"
        )


def _sample_bytes(sample: Sample) -> int:
    sample_bytes = _SAMPLE_BYTES
    for tracked in sample.objects.values():
        sample_bytes += _OBJECT_BYTES + sum(len(part.packed) for part in tracked.footprint.parts)
    return sample_bytes


def _megabytes(size_bytes: float) -> str:
    return f"{size_bytes / 2**20:,.0f} MB"

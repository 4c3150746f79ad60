"""Find the samples of a log that are evaluated: from its begin to its end for all needed topics.

Recorded logs, traces and running robots follow one rule. Evaluation begins at the first sample where each
needed topic has sent a message that transforms can place. It ends at the last such sample.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.spec.checks import group_classes, object_names, signal_names
from spatial_replay.spec.format import format_duration
from spatial_replay.spec.formula import ANY_CLASS, Specification
from spatial_replay.text import Instant, Sentence, plural
from spatial_replay.trace.spans import TopicSpan
from spatial_replay.trace.trace import FOREVER, Trace, within


@dataclass(frozen=True, slots=True)
class Needs:
    """The objects, signals and classes that specifications name.

    Attributes:
        classes: in lower case; `ANY_CLASS` for objects of any class.
    """

    objects: frozenset[str] = frozenset()
    signals: frozenset[str] = frozenset()
    classes: frozenset[str] = frozenset()

    @classmethod
    def of(cls, files: Iterable[Specification], each: Mapping[str, str]) -> Needs:
        """Return the needs of specifications.

        Args:
            each: choice of objects for each template parameter: "all", "class:NAME" or a name.
        """
        objects: set[str] = set()
        signals: set[str] = set()
        classes: set[str] = set()
        for file in files:
            objects.update(object_names(file))
            signals.update(signal_names(file))
            classes.update(group_classes(file))
            for parameter in {spec.parameter for spec in file.results} - {None}:
                kind, _, name = each.get(parameter or "", "all").partition(":")
                if kind == "class":
                    classes.add(name)
                elif kind == "all":
                    classes.add(ANY_CLASS)
                else:
                    # the name of an object may contain a colon
                    objects.add(kind if not name else f"{kind}:{name}")
        return cls(frozenset(objects), frozenset(signals), frozenset(name.casefold() for name in classes))

    def choose(self, spans: Sequence[TopicSpan]) -> list[TopicSpan]:
        """Return the spans of topics that carry, or may carry, a needed object or signal."""
        unseen = self.objects.difference(*(span.objects for span in spans))
        return [span for span in spans if self._is_needed(span, unseen)]

    def choose_first(self, spans: Sequence[TopicSpan]) -> list[TopicSpan]:
        """Return the spans that are needed regardless of the objects that appear later.

        A live run cannot know later objects, but it has to begin where a replay of its log begins.
        """
        patterns = {span.pattern for span in spans}
        # the pattern of a topic with one fixed object is the escaped name
        fixed = {name: re.escape(name) for name in self.objects if re.escape(name) in patterns}
        unseen = self.objects - fixed.keys()
        return [span for span in spans if span.pattern in fixed.values() or self._is_needed(span, unseen)]

    def _is_needed(self, span: TopicSpan, unseen: frozenset[str]) -> bool:
        if not (self.objects.isdisjoint(span.objects) and self.signals.isdisjoint(span.signals)):
            return True
        if span.pattern is None:
            return False
        of_class = bool(self.classes) and (
            ANY_CLASS in self.classes or span.classes is None or not self.classes.isdisjoint(span.classes)
        )
        return of_class or any(map(span.may_have, unseen))


class RunEnds:
    """Leaves out samples at both ends of a log, where a needed topic cannot be judged.

    Samples are left out before a needed topic begins, after it ends, and where no transform places it.
    At each end at most the topic's `limit_ns` is left out. No sample is left out for a topic that is missing
    for longer.

    Args:
        start, end: whether samples may be left out at the start, and at the end.
        is_rest: whether earlier samples were evaluated; then all samples may be left out.
        within_ns: limit at the start, instead of the topics' own limits.

    Attributes:
        log_begin_ns: time of the first sample.
        begin_ns: time of the first evaluated sample; None until it is decided.
        end_ns: time from which samples are left out; set by `finish`.
        late: needed topics that came too late, so that evaluation began without them.
    """

    def __init__(
        self,
        needs: Needs,
        *,
        start: bool = True,
        end: bool = True,
        is_rest: bool = False,
        within_ns: int | None = None,
    ) -> None:
        self.needs = needs
        self._start, self._end, self._is_rest, self._within_ns = start, end, is_rest, within_ns
        self._spans: dict[str, TopicSpan] = {}
        self._since_ns: dict[str, int | None] = {}
        self._pending_traces: list[Trace] = []
        self._released_ns = -1
        self.log_begin_ns = self._log_end_ns = 0
        self._is_empty = True
        self.begin_ns: int | None = None
        self.end_ns = FOREVER
        self.late: tuple[str, ...] = ()
        self.remarks: tuple[Sentence, ...] = ()

    @property
    def has_spans(self) -> bool:
        """Whether any sample so far came with spans of topics."""
        return bool(self._spans)

    def add(self, trace: Trace) -> list[Trace]:
        """Add the next samples and return the samples that are ready for evaluation.

        One trace is returned for each added trace, perhaps later, without the samples left out.
        """
        # evaluation has begun, and no end is searched: nothing has to be recorded
        if self.begin_ns is not None and not self._end and not self.late:
            return [trace]
        if len(trace):
            if self._is_empty:
                self.log_begin_ns, self._is_empty = int(trace.times_ns[0]), False
            self._log_end_ns = int(trace.times_ns[-1])
            self._note(trace)
        self._pending_traces.append(trace)
        if self.begin_ns is None and not self._decide_begin():
            return []
        return self._release(self._open_since_ns())

    def release(self) -> list[Trace]:
        """Return the pending samples, which are all evaluated; none before evaluation begins."""
        return [] if self.begin_ns is None else self._release(FOREVER)

    def finish(self) -> list[Trace]:
        """Return the remaining evaluated samples at the end of the log."""
        if self._is_empty:
            return self._release(FOREVER)
        if self.begin_ns is None:
            self._begin()
        self.end_ns = self._open_since_ns()
        if self.end_ns < FOREVER:
            self._remark_end()
        for span in self.needs.choose(tuple(self._spans.values())):
            if span.topic in self.late:
                self._remark_late(span)
        return self._release(FOREVER)

    def _note(self, trace: Trace) -> None:
        times_ns = trace.times_ns
        for span in trace.spans:
            earlier_span = self._spans.get(span.topic)
            self._spans[span.topic] = span if earlier_span is None else earlier_span.join(span)
            # the sample after the last sample in which the topic could be judged
            next_sample = 0 if span.last_ns is None else int(np.searchsorted(times_ns, span.last_ns, "right"))
            since_ns = int(times_ns[next_sample]) if next_sample < len(times_ns) else None
            # the topic was missing at the end of the previous trace already
            if next_sample == 0 and earlier_span is not None and self._since_ns[span.topic] is not None:
                since_ns = self._since_ns[span.topic]
            self._since_ns[span.topic] = since_ns

    def _limit_ns(self, span: TopicSpan) -> int:
        return span.limit_ns if self._within_ns is None else self._within_ns

    def _decide_begin(self) -> bool:
        """Begin evaluation if no needed topic is awaited; return whether it began."""
        passed_ns = self._log_end_ns - self.log_begin_ns
        is_waiting = self._is_empty or (
            self._start
            and any(
                span.first_ns is None and passed_ns <= self._limit_ns(span)
                for span in self.needs.choose_first(tuple(self._spans.values()))
            )
        )
        if not is_waiting:
            self._begin()
        return not is_waiting

    def _begin(self) -> None:
        needed = self.needs.choose_first(tuple(self._spans.values())) if self._start else []
        delays = [
            (span, FOREVER if span.first_ns is None else span.first_ns - self.log_begin_ns) for span in needed
        ]
        self.late = tuple(span.topic for span, delay in delays if delay > self._limit_ns(span))
        in_time = [span for span, delay in delays if delay <= self._limit_ns(span)]
        # the latest topic decides
        self.begin_ns = max((span.first_ns or 0 for span in in_time), default=self.log_begin_ns)
        latest_span = max(in_time, key=lambda span: span.first_ns or 0, default=None)
        if latest_span is not None and self.begin_ns > self.log_begin_ns:
            self._remark_begin(latest_span, self.begin_ns)

    def _remark_begin(self, span: TopicSpan, begin_ns: int) -> None:
        times_ns = np.concatenate([trace.times_ns for trace in self._pending_traces])
        left_out = times_ns[times_ns < begin_ns]
        reason: list[str | Instant] = [f"no transform places {span.topic} before"]
        # else the topic had messages, but no transform
        if span.begun_ns is not None and span.begun_ns > int(left_out[-1]):
            reason = [f"{span.topic} begins at ", Instant(span.begun_ns, 0)]
        self._remark("beginning", left_out, reason)

    def _remark_late(self, span: TopicSpan) -> None:
        """Add a remark that the objects of a late topic are absent until it begins."""
        if span.pattern is None or span.begun_ns is None or span.begun_ns <= self.log_begin_ns:
            return
        limit = format_duration(self._limit_ns(span))
        reason = f", more than {limit} after the first sample: its objects are absent before,"
        begun = Instant(span.begun_ns, 0)
        self.remarks = (
            *self.remarks,
            Sentence(f"{span.topic} begins at ", begun, reason, " also from groups"),
        )

    def _remark_end(self) -> None:
        span = min(self._open_spans(), key=lambda span: self._since_ns[span.topic] or FOREVER)
        times_ns = np.concatenate([trace.times_ns for trace in self._pending_traces])
        left_out = times_ns[times_ns >= self.end_ns]
        reason: list[str | Instant] = [f"no transform places {span.topic} then"]
        if span.heard_ns is not None and self.end_ns - span.heard_ns > span.limit_ns:
            reason = [f"{span.topic} ends at ", Instant(span.heard_ns, 0)]
        self._remark("end", left_out, reason)

    def _remark(self, which: str, left_out: Integers, reason: Iterable[str | Instant]) -> None:
        first, last = (Instant(int(at), 0) for at in left_out[[0, -1]])
        count = plural(len(left_out), "sample")
        verb = "is" if len(left_out) == 1 else "are"
        times = ("at ", first) if len(left_out) == 1 else ("from ", first, " to ", last)
        sentence = Sentence(f"{count} at the {which} {verb} left out, ", *times, ": ", *reason)
        self.remarks = (*self.remarks, sentence)

    def _open_spans(self) -> Iterator[TopicSpan]:
        """Yield needed spans that ended before the newest sample, by no more than their limits."""
        if not self._end:
            return
        for span in self.needs.choose(tuple(self._spans.values())):
            since_ns = self._since_ns[span.topic]
            # released samples are evaluated, so they cannot be left out any more
            before_ns = max(self._released_ns, -1 if self._is_rest else self.begin_ns or 0)
            if since_ns is not None and since_ns > before_ns and self._log_end_ns - since_ns <= span.limit_ns:
                yield span

    def _open_since_ns(self) -> int:
        """Return the time from which a needed topic may have ended, the earliest of them; else FOREVER."""
        return min((self._since_ns[span.topic] or FOREVER for span in self._open_spans()), default=FOREVER)

    def _release(self, before_ns: int) -> list[Trace]:
        """Remove and return the pending traces that end before a time."""
        count = 0
        for trace in self._pending_traces:
            # traces are released whole, because callers expect one trace for each added trace
            if len(trace) and int(trace.times_ns[-1]) >= before_ns:
                break
            if len(trace):
                self._released_ns = int(trace.times_ns[-1])
            count += 1
        released, self._pending_traces = self._pending_traces[:count], self._pending_traces[count:]
        return [self.trim(trace) for trace in released]

    def trim(self, trace: Trace) -> Trace:
        """Return the samples of a trace from `begin_ns` to before `end_ns`."""
        counting = within(trace, self.begin_ns, self.end_ns)
        return replace(counting, spans=()) if counting.spans else counting


def trim_trace(
    trace: Trace, needs: Needs, *, start: bool = True, end: bool = True, is_rest: bool = False
) -> tuple[Trace, tuple[Sentence, ...]]:
    """Return the evaluated samples of a trace, and remarks on samples left out (see `RunEnds`)."""
    if not trace.spans:
        return trace, ()
    ends = RunEnds(needs, start=start, end=end, is_rest=is_rest)
    (counting,) = [*ends.add(trace), *ends.finish()]
    # an untrimmed trace stays the same object, so its cache of measurements stays in use
    return (counting, ends.remarks) if ends.remarks else (trace, ())

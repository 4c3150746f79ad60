"""Find the evaluated samples of a log: the samples at both ends without a needed topic are left out.

Recorded logs, traces and running robots follow one rule. Evaluation begins at the first sample where each
needed topic has sent a message that transforms can locate. It ends at the last such sample.
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
        classes: class names in lower case; `ANY_CLASS` stands for any class.
    """

    objects: frozenset[str] = frozenset()
    signals: frozenset[str] = frozenset()
    classes: frozenset[str] = frozenset()

    @classmethod
    def of(cls, files: Iterable[Specification], each: Mapping[str, str]) -> Needs:
        """Return the needs of specifications.

        Args:
            each: choice of objects by template parameter: "all", "class:NAME" or an object's name.
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
        unseen_objects = self.objects.difference(*(span.objects for span in spans))
        return [span for span in spans if self._is_needed(span, unseen_objects)]

    def choose_first(self, spans: Sequence[TopicSpan]) -> list[TopicSpan]:
        """Return the spans that are needed regardless of the objects that appear later.

        A live run cannot know later objects, but it has to begin where a replay of its log begins.
        """
        patterns = {span.pattern for span in spans}
        # the pattern of a topic with one fixed object is the escaped name
        fixed_patterns = {name: re.escape(name) for name in self.objects if re.escape(name) in patterns}
        unseen_objects = self.objects - fixed_patterns.keys()
        return [
            span
            for span in spans
            if span.pattern in fixed_patterns.values() or self._is_needed(span, unseen_objects)
        ]

    def _is_needed(self, span: TopicSpan, unseen_objects: frozenset[str]) -> bool:
        if not (self.objects.isdisjoint(span.objects) and self.signals.isdisjoint(span.signals)):
            return True
        if span.pattern is None:
            return False
        may_have_class = bool(self.classes) and (
            ANY_CLASS in self.classes or span.classes is None or not self.classes.isdisjoint(span.classes)
        )
        return may_have_class or any(map(span.may_have, unseen_objects))


class RunEnds:
    """Leaves out samples at both ends of a log, where a needed topic cannot be judged.

    Samples are left out before a needed topic begins, after it ends, and where no transform locates it.
    At most the topic's `limit_ns` is left out at each end. If a topic is missing for longer, no samples are
    left out because of that topic.

    Args:
        start, end: whether samples may be left out at the start, and at the end.
        is_rest: whether the log has earlier samples, which were evaluated. Then all samples may be left out.
        within_ns: limit at the start, ns, instead of the topics' own limits.

    Attributes:
        log_begin_ns: time of the first sample.
        begin_ns: time of the first evaluated sample; None until it is decided.
        end_ns: time from which on samples are left out; set by `finish`.
        late: needed topics without which evaluation began, because they came too late.
        remarks: sentences on the samples left out and on late topics.
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
        self._may_trim_start, self._may_trim_end = start, end
        self._is_rest, self._start_limit_ns = is_rest, within_ns
        self._spans: dict[str, TopicSpan] = {}
        self._ended_ns: dict[str, int | None] = {}
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
        """Whether any added trace has spans of topics."""
        return bool(self._spans)

    def add(self, trace: Trace) -> list[Trace]:
        """Add the next samples and return the samples that are ready for evaluation.

        Each added trace is returned by this call or a later call, without the samples left out.
        """
        # after the beginning, spans are needed only to find the end and for remarks on late topics
        if self.begin_ns is not None and not self._may_trim_end and not self.late:
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
        """Return all pending samples for evaluation; none before evaluation begins."""
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
            if next_sample == 0 and earlier_span is not None and self._ended_ns[span.topic] is not None:
                since_ns = self._ended_ns[span.topic]
            self._ended_ns[span.topic] = since_ns

    def _limit_ns(self, span: TopicSpan) -> int:
        return span.limit_ns if self._start_limit_ns is None else self._start_limit_ns

    def _decide_begin(self) -> bool:
        """Begin evaluation if no needed topic is awaited; return whether it began."""
        elapsed_ns = self._log_end_ns - self.log_begin_ns
        is_waiting = self._is_empty or (
            self._may_trim_start
            and any(
                span.first_ns is None and elapsed_ns <= self._limit_ns(span)
                for span in self.needs.choose_first(tuple(self._spans.values()))
            )
        )
        if not is_waiting:
            self._begin()
        return not is_waiting

    def _begin(self) -> None:
        needed_spans = self.needs.choose_first(tuple(self._spans.values())) if self._may_trim_start else []
        span_delays = [
            (span, FOREVER if span.first_ns is None else span.first_ns - self.log_begin_ns)
            for span in needed_spans
        ]
        self.late = tuple(span.topic for span, delay_ns in span_delays if delay_ns > self._limit_ns(span))
        timely_spans = [span for span, delay_ns in span_delays if delay_ns <= self._limit_ns(span)]
        # evaluation begins with the latest of these topics
        self.begin_ns = max((span.first_ns or 0 for span in timely_spans), default=self.log_begin_ns)
        latest_span = max(timely_spans, key=lambda span: span.first_ns or 0, default=None)
        if latest_span is not None and self.begin_ns > self.log_begin_ns:
            self._remark_begin(latest_span, self.begin_ns)

    def _remark_begin(self, span: TopicSpan, begin_ns: int) -> None:
        times_ns = np.concatenate([trace.times_ns for trace in self._pending_traces])
        omitted_ns = times_ns[times_ns < begin_ns]
        reason: list[str | Instant] = [f"no transform places {span.topic} before"]
        # otherwise the topic had messages, but no transform located them
        if span.begun_ns is not None and span.begun_ns > int(omitted_ns[-1]):
            reason = [f"{span.topic} begins at ", Instant(span.begun_ns, 0)]
        self._remark("beginning", omitted_ns, reason)

    def _remark_late(self, span: TopicSpan) -> None:
        """Add a remark that the objects of a late topic are absent until it begins."""
        if span.pattern is None or span.begun_ns is None or span.begun_ns <= self.log_begin_ns:
            return
        limit_text = format_duration(self._limit_ns(span))
        reason = f", more than {limit_text} after the first sample: its objects are absent before,"
        begin_time = Instant(span.begun_ns, 0)
        self.remarks = (
            *self.remarks,
            Sentence(f"{span.topic} begins at ", begin_time, reason, " also from groups"),
        )

    def _remark_end(self) -> None:
        span = min(self._open_spans(), key=lambda span: self._ended_ns[span.topic] or FOREVER)
        times_ns = np.concatenate([trace.times_ns for trace in self._pending_traces])
        omitted_ns = times_ns[times_ns >= self.end_ns]
        reason: list[str | Instant] = [f"no transform places {span.topic} then"]
        if span.heard_ns is not None and self.end_ns - span.heard_ns > span.limit_ns:
            reason = [f"{span.topic} ends at ", Instant(span.heard_ns, 0)]
        self._remark("end", omitted_ns, reason)

    def _remark(self, place: str, omitted_ns: Integers, reason: Iterable[str | Instant]) -> None:
        first_time, last_time = (Instant(int(time_ns), 0) for time_ns in omitted_ns[[0, -1]])
        count_text = plural(len(omitted_ns), "sample")
        verb = "is" if len(omitted_ns) == 1 else "are"
        time_parts = ("at ", first_time) if len(omitted_ns) == 1 else ("from ", first_time, " to ", last_time)
        sentence = Sentence(f"{count_text} at the {place} {verb} left out, ", *time_parts, ": ", *reason)
        self.remarks = (*self.remarks, sentence)

    def _open_spans(self) -> Iterator[TopicSpan]:
        """Yield needed spans that ended after the released samples, at most `limit_ns` before the newest."""
        if not self._may_trim_end:
            return
        for span in self.needs.choose(tuple(self._spans.values())):
            since_ns = self._ended_ns[span.topic]
            # released samples are evaluated, so they cannot be left out any more
            earliest_ns = max(self._released_ns, -1 if self._is_rest else self.begin_ns or 0)
            if (
                since_ns is not None
                and since_ns > earliest_ns
                and self._log_end_ns - since_ns <= span.limit_ns
            ):
                yield span

    def _open_since_ns(self) -> int:
        """Return the earliest time at which a needed topic may have ended; FOREVER without such a topic."""
        return min((self._ended_ns[span.topic] or FOREVER for span in self._open_spans()), default=FOREVER)

    def _release(self, before_ns: int) -> list[Trace]:
        """Remove and return the pending traces that end before `before_ns`."""
        ready_count = 0
        for trace in self._pending_traces:
            # traces are released whole, because callers expect one trace for each added trace
            if len(trace) and int(trace.times_ns[-1]) >= before_ns:
                break
            if len(trace):
                self._released_ns = int(trace.times_ns[-1])
            ready_count += 1
        ready_traces, self._pending_traces = (
            self._pending_traces[:ready_count],
            self._pending_traces[ready_count:],
        )
        return [self.trim(trace) for trace in ready_traces]

    def trim(self, trace: Trace) -> Trace:
        """Return the samples of a trace from `begin_ns` to before `end_ns`."""
        trimmed_trace = within(trace, self.begin_ns, self.end_ns)
        return replace(trimmed_trace, spans=()) if trimmed_trace.spans else trimmed_trace


def trim_trace(
    trace: Trace, needs: Needs, *, start: bool = True, end: bool = True, is_rest: bool = False
) -> tuple[Trace, tuple[Sentence, ...]]:
    """Return the evaluated samples of a trace, and remarks on samples left out (see `RunEnds`)."""
    if not trace.spans:
        return trace, ()
    ends = RunEnds(needs, start=start, end=end, is_rest=is_rest)
    (trimmed_trace,) = [*ends.add(trace), *ends.finish()]
    # an untrimmed trace is returned itself, so that its cache of measurements is used again
    return (trimmed_trace, ends.remarks) if ends.remarks else (trace, ())

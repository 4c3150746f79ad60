"""Spans of samples in which each mapped topic of a log could be judged."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class TopicSpan:
    """The samples in which one topic could be judged.

    A topic can be judged from its first message on, while messages arrive and transforms locate them.

    Attributes:
        objects: names of its objects so far.
        pattern: regular expression for the names of its possible objects; None without objects.
        signals: names of its signals.
        classes: classes of its possible objects, in lower case; None for any class.
        limit_ns: longest time that may be left out at an end of the log because of this topic, ns.
        begun_ns, heard_ns: times of its first and last message; None without messages.
        first_ns, last_ns: times of the first and the last sample in which the topic could be judged, or None.
    """

    topic: str
    objects: frozenset[str]
    pattern: str | None
    signals: frozenset[str]
    classes: frozenset[str] | None
    limit_ns: int
    begun_ns: int | None
    heard_ns: int | None
    first_ns: int | None
    last_ns: int | None

    def may_have(self, name: str) -> bool:
        """Return whether the topic may report an object of this name."""
        # DOTALL, because a name may contain a line break
        return self.pattern is not None and re.fullmatch(self.pattern, name, re.DOTALL) is not None

    def join(self, later: TopicSpan) -> TopicSpan:
        """Return the span that covers this span and a later span of the same topic."""
        return replace(
            later,
            objects=self.objects | later.objects,
            begun_ns=later.begun_ns if self.begun_ns is None else self.begun_ns,
            heard_ns=self.heard_ns if later.heard_ns is None else later.heard_ns,
            first_ns=later.first_ns if self.first_ns is None else self.first_ns,
            last_ns=self.last_ns if later.last_ns is None else later.last_ns,
        )


def join_spans(stretches: Iterable[tuple[TopicSpan, ...]]) -> tuple[TopicSpan, ...]:
    """Join the spans of consecutive parts of a log, by topic."""
    spans: dict[str, TopicSpan] = {}
    for stretch in stretches:
        for span in stretch:
            earlier_span = spans.get(span.topic)
            spans[span.topic] = span if earlier_span is None else earlier_span.join(span)
    return tuple(spans.values())

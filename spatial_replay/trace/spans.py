"""When each mapped topic of a log could be judged, from its first usable sample to its last."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class TopicSpan:
    """When one topic could be judged: it had begun, went on, and transforms placed its messages.

    Attributes:
        objects: names of its objects so far.
        pattern: a regular expression for the names that its objects may have; None without objects.
        signals: names of its signals.
        classes: classes that its objects may have, in lower case; None for any.
        limit_ns: how much of an end of the log may be left out because of this topic.
        begun_ns, heard_ns: times of its first and last message; None without any.
        first_ns, last_ns: times of the first and the last sample where it could be judged; None without any.
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
        """Whether an object of this name may come on the topic."""
        return self.pattern is not None and re.fullmatch(self.pattern, name, re.DOTALL) is not None

    def join(self, later: TopicSpan) -> TopicSpan:
        """Return the span over these samples and later ones."""
        return replace(
            later,
            objects=self.objects | later.objects,
            begun_ns=later.begun_ns if self.begun_ns is None else self.begun_ns,
            heard_ns=self.heard_ns if later.heard_ns is None else later.heard_ns,
            first_ns=later.first_ns if self.first_ns is None else self.first_ns,
            last_ns=self.last_ns if later.last_ns is None else later.last_ns,
        )


def join_spans(stretches: Iterable[tuple[TopicSpan, ...]]) -> tuple[TopicSpan, ...]:
    """Return the spans over stretches of a log in order."""
    spans: dict[str, TopicSpan] = {}
    for stretch in stretches:
        for span in stretch:
            before = spans.get(span.topic)
            spans[span.topic] = span if before is None else before.join(span)
    return tuple(spans.values())

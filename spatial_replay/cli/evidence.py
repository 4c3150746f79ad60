"""Evidence about the reading of each topic of a log, as lines for a check at a glance."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from spatial_replay.text import counted_from, escape_text, listing, number_text, plural, time_text, with_unit

if TYPE_CHECKING:
    from spatial_replay.sources.overview import Overview
    from spatial_replay.trace.facts import Distribution, TopicFacts

_AXES: Final = ("x", "y", "z")
_LONG_PAUSE: Final = 2.0
"""Length above which a pause is shown with its time, in median periods."""


def evidence_lines(overview: Overview) -> Iterator[str]:
    """Yield lines for each mapped topic of a log; topics that contradict an assumption come first."""
    log_start_ns, unit = overview.start_ns or 0, overview.axes.units.get("", "")
    contradictions = {facts.topic: list(_contradictions(overview, facts.topic)) for facts in overview.facts}
    for facts in sorted(overview.facts, key=lambda facts: not contradictions[facts.topic]):
        yield escape_text(f"{facts.topic}: {_arrivals(facts, log_start_ns)}")
        for label, text in (*contradictions[facts.topic], *_rows(facts, unit, log_start_ns)):
            if text:
                yield escape_text(f"  {label:<12}{text}")


def _contradictions(overview: Overview, topic: str) -> Iterator[tuple[str, str]]:
    """Yield the doubts and the remarks about a topic, each with a mark."""
    for doubt in overview.doubts:
        if doubt.topic == topic:
            mark = "accepted" if doubt.is_accepted else "DOUBTFUL"
            yield mark, f"{doubt.assumption}: {doubt.text.removeprefix(f'{topic}: ')}"
    prefix = f"{overview.name}: {topic}: "
    for remark in counted_from(overview.remarks, overview.start_ns or 0):
        if remark.startswith(prefix):
            yield "REMARK", remark.removeprefix(prefix)


def _arrivals(facts: TopicFacts, log_start_ns: int) -> str:
    messages_text, period_s = plural(facts.messages, "message"), facts.period_s
    if facts.first_ns is None or facts.last_ns is None or period_s is None:
        return messages_text
    span_text = f"from {time_text(facts.first_ns, log_start_ns)} to {time_text(facts.last_ns, log_start_ns)}"
    is_pause = period_s.greatest > _LONG_PAUSE * period_s.median and period_s.greatest_ns is not None
    pause_end = f", until {time_text(period_s.greatest_ns or 0, log_start_ns)}" if is_pause else ""
    longest_text = f"at most {number_text(period_s.greatest)} s apart{pause_end}"
    return f"{messages_text} {span_text}, every {number_text(period_s.median)} s, {longest_text}"


def _rows(facts: TopicFacts, unit: str, log_start_ns: int) -> Iterator[tuple[str, str]]:
    """Yield a label and a text for each kind of facts. The text of a missing kind is ""."""
    if facts.lateness_s is not None:
        yield "lateness", f"{_range(facts.lateness_s, 's')} after the stamps"
    yield "publishers", plural(facts.publishers, "channel") if facts.publishers > 1 else ""
    yield "frames", listing([frame or "''" for frame in facts.frames])
    yield "signals", listing(facts.signals)
    if not facts.objects:
        return
    names_text = plural(len(facts.names), "name")
    pattern = f"`{facts.name}`, " if facts.name else ""
    yield "names", f"{pattern}{names_text}, up to {facts.most_at_once} at once: {listing(facts.names)}"
    changes_text = f"; {plural(facts.class_changes, 'change')} of class" if facts.class_changes else ""
    yield "classes", listing([name or "none" for name in facts.classes]) + changes_text
    if facts.size is not None and facts.shorter_side is not None:
        yield "sizes", f"longer side {_range(facts.size, unit)}; shorter {_range(facts.shorter_side, unit)}"
    axis_ranges = zip(_AXES, facts.low, facts.high, strict=False)
    yield (
        "places",
        ", ".join(f"{axis} {number_text(low)} to {number_text(high)}" for axis, low, high in axis_ranges),
    )
    if facts.speed is not None:
        yield "speed", _motion(facts.speed, f"{unit}/s" if unit else "a second", log_start_ns)
    if facts.turn_rate is not None:
        least, median, greatest = map(math.degrees, facts.turn_rate[:3])
        turn_rate = facts.turn_rate._replace(least=least, median=median, greatest=greatest)
        yield "turning", _motion(turn_rate, "deg/s", log_start_ns)
    if facts.bottom is not None and facts.top is not None:
        yield "heights", f"{number_text(facts.bottom.least)} to {with_unit(facts.top.greatest, unit)}"
    if facts.uncertainty is not None:
        yield "uncertainty", _range(facts.uncertainty, unit)


def _range(numbers: Distribution, unit: str) -> str:
    least_text, greatest_text = number_text(numbers.least), with_unit(numbers.greatest, unit)
    if least_text == number_text(numbers.greatest):
        return f"always {greatest_text}"
    return f"{least_text} to {greatest_text} (median {number_text(numbers.median)})"


def _motion(numbers: Distribution, unit: str, log_start_ns: int) -> str:
    at_text = "" if numbers.greatest_ns is None else f" at {time_text(numbers.greatest_ns, log_start_ns)}"
    return f"median {with_unit(numbers.median, unit)}, at most {with_unit(numbers.greatest, unit)}{at_text}"

"""Plan what to read of a log: a mapping and the log's topics in, the topics to read and their layouts out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from spatial_replay.bags.columns import DISORDER_NS
from spatial_replay.bags.topic import Topic
from spatial_replay.errors import UsageError
from spatial_replay.mapping.message_types import (
    BUILT_IN,
    GEODETIC,
    GEODETIC_TYPES,
    TRANSFORM_TYPES,
    MessageLayout,
    layout_of_topic,
    short_type,
)
from spatial_replay.mapping.model import DEFAULT_MAX_AGE_NS, FOREVER_NS, Clock, LogMapping, TopicMapping
from spatial_replay.mapping.transforms import HISTORY_NS
from spatial_replay.text import counted, nearest_hint


@dataclass(frozen=True, slots=True)
class PlannedTopic:
    """How one topic is read.

    Attributes:
        mapping: its entry; None for topics that are read for transforms or times only.
        layout: where its objects are; None for a topic without objects.
        max_age_ns: how long an observation or a signal stays valid.
        between_ns: its objects are unknown between transforms that are farther apart.
        is_transforms: whether its transforms place frames; `is_static`: at all times.
        is_lasting: whether a message counts however old it is.
        is_latched: whether it may have been sent long before it was recorded.
    """

    name: str
    clock: Clock
    mapping: TopicMapping | None
    layout: MessageLayout | None
    max_age_ns: int
    between_ns: int
    is_transforms: bool
    is_static: bool
    is_lasting: bool
    is_latched: bool = False


@dataclass(frozen=True, slots=True)
class ReadingPlan:
    """What to read of a log for a mapping that fits it.

    Attributes:
        topics: every topic to read: those mapped, and those with transforms if frames are needed.
        by_log_time: whether the times of samples are log times. If not, the messages of a window are known
            only when all have been decoded.
        late_ns: how far messages may be out of order; it is also how long samples wait for late messages.
        margin_ns: how far beyond the end of a window messages still count.
        planned: how each topic is read, in the order of `topics`.
        lost: topics with transforms that cannot be decoded, with the reason.
        absent: optional topics that the log lacks.
        sampled_topic: the topic whose messages are sampled; None for samples at multiples of a step.
        remarks: what is doubtful about the choice of that topic.
    """

    mapping: LogMapping
    topics: tuple[str, ...]
    by_log_time: bool
    margin_ns: int
    late_ns: int = DISORDER_NS
    planned: tuple[PlannedTopic, ...] = ()
    sampled_topic: str | None = None
    lost: tuple[tuple[str, str], ...] = ()
    absent: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @classmethod
    def of(cls, mapping: LogMapping, topics: Sequence[Topic], late_ns: int = DISORDER_NS) -> ReadingPlan:
        """Compare a mapping with the topics of a log.

        Raises:
            UsageError: the mapping does not fit the topics; all errors are listed.
        """
        known = {topic.name: topic for topic in topics}
        faults = _faults(mapping, known)
        if faults:
            raise UsageError("\n".join(f"{mapping.name}: {fault}" for fault in faults))
        mapped = {entry.topic: entry for entry in mapping.topics}
        needs_frames = mapping.fixed_frame is not None
        names = [topic for topic in mapped if topic in known]
        others = [topic for topic in topics if needs_frames and topic.name not in mapped]
        transforms = [topic for topic in others if short_type(topic.type) in TRANSFORM_TYPES]
        names += [topic.name for topic in transforms if topic.unreadable is None]
        lost = [(each.name, each.unreadable) for each in transforms if each.unreadable and each.count != 0]
        is_stepped = mapping.sampling.step_ns is not None
        sampled = None if is_stepped else mapping.sampling.topic or _most_frequent(mapping, known)
        if sampled is not None and sampled not in names:
            names.append(sampled)
        planned = tuple(_planned(mapping, mapped.get(name), known[name], needs_frames) for name in names)
        waits_for_frames = any(topic.is_transforms and not topic.is_static for topic in planned)
        return cls(
            mapping=mapping,
            topics=tuple(names),
            by_log_time=all(topic.clock == "log" for topic in planned),
            late_ns=late_ns,
            margin_ns=late_ns + max(HISTORY_NS if waits_for_frames else 0, mapping.max_gap_ns or 0),
            planned=planned,
            sampled_topic=sampled,
            lost=tuple(lost),
            absent=tuple(topic for topic in mapped if topic not in known),
            remarks=_slow_sampling(sampled, [known[topic] for topic in mapped if topic in known], known),
        )

    def lookback_ns(self, topic: str) -> int | None:
        """Return how long before a window messages of a topic count; None for all, as of static
        transforms."""
        planned = next(each for each in self.planned if each.name == topic)
        ages = [
            each.max_age_ns
            for each in self.planned
            if each.layout is not None and not each.is_lasting and not each.is_transforms
        ]
        own = planned.max_age_ns if planned.mapping is not None else 0
        if planned.is_transforms and not planned.is_static:
            # an observation of the window may be that old, and is placed by a transform of its time
            own = max(own, HISTORY_NS + max(ages, default=0))
            if any(each.is_lasting and each.layout is not None for each in self.planned):
                return None
        return None if planned.is_lasting or own + self.late_ns >= FOREVER_NS else own + self.late_ns


def _faults(mapping: LogMapping, known: dict[str, Topic]) -> list[str]:
    faults: list[str] = []
    named = [entry.topic for entry in mapping.topics]
    sampled = mapping.sampling.topic
    optional = {entry.topic for entry in mapping.topics if entry.optional}
    for name in [*named, *([sampled] if sampled is not None and sampled not in named else [])]:
        where = f"topics.{name}" if name in named else "sample.topic"
        if name in optional and name not in known:
            if name == sampled:
                faults.append(
                    f"sample.topic: the log has no topic {name!r}, so no sample can be taken; name one that"
                    " every log has, or {every: 100ms}"
                )
        elif name not in known:
            listed = ", ".join(sorted(known)[:20]) or "none"
            hint = nearest_hint(name, known) or f"its topics are {listed}"
            if name in named and not hint.endswith("?"):
                hint += "; where only some logs have it, add `optional: true`"
            faults.append(f"{where}: the log has no topic {name!r}; {hint}")
        elif (reason := known[name].unreadable) is not None:
            faults.append(f"{where}: its messages cannot be decoded: {reason}")
    if optional.issuperset(named) and known.keys().isdisjoint(named):
        listed = ", ".join(sorted(known)[:20]) or "none"
        faults.append(f"topics: the log has none of these optional topics; its topics are {listed}")
    for entry in mapping.topics:
        kind = short_type(entry.type or (known[entry.topic].type if entry.topic in known else ""))
        if (
            kind in GEODETIC_TYPES
            and entry.reads_objects
            and entry.position is None
            and mapping.origin is None
        ):
            faults.append(
                f"topics.{entry.topic}: {kind} holds degrees; give the file an"
                " `origin: [latitude, longitude]`, and positions are metres east and north of it"
            )
        if entry.type is not None and short_type(entry.type) not in BUILT_IN:
            hint = nearest_hint(short_type(entry.type), BUILT_IN) or f"known are {', '.join(BUILT_IN)}"
            faults.append(f"topics.{entry.topic}.type: {entry.type!r} is not a known type; {hint}")
    return faults


def _most_frequent(mapping: LogMapping, known: Mapping[str, Topic]) -> str:
    """Return the topic that is sampled by default: of those with objects, if any, the one with most messages.

    Where a log does not say how many there are, the first one counts.
    """
    present = [entry for entry in mapping.topics if entry.topic in known]
    names = [entry.topic for entry in present if entry.reads_objects] or [entry.topic for entry in present]
    counts = [known[name].count for name in names]
    return names[0] if None in counts else max(names, key=lambda name: known[name].count or 0)


_MANY_TIMES = 10


def _slow_sampling(
    sampled: str | None, mapped: Sequence[Topic], known: Mapping[str, Topic]
) -> tuple[str, ...]:
    """Return a remark if a mapped topic has many times the messages of the one that is sampled."""
    most = max(mapped, key=lambda topic: topic.count or 0)
    count = None if sampled is None else known[sampled].count
    if count is None or most.count is None or most.count < _MANY_TIMES * max(count, 1):
        return ()
    messages = counted(count, "message")
    return (
        f"samples are taken at {sampled}, which has {messages}, where {most.name} has {most.count};"
        f" `sample: {{topic: {most.name}}}` takes one at each of these",
    )


def _planned(
    mapping: LogMapping, entry: TopicMapping | None, topic: Topic, needs_frames: bool
) -> PlannedTopic:
    is_transforms = needs_frames and short_type(topic.type) in TRANSFORM_TYPES
    is_static = is_transforms and (topic.latched or topic.name.rsplit("/", 1)[-1] == "tf_static")
    layout = layout_of_topic(topic.type, entry) if entry is not None and entry.reads_objects else None
    if layout is not None and GEODETIC in layout.position:
        layout = replace(layout, origin=mapping.origin)
    stays = topic.latched or (layout is not None and layout.stays)
    default = FOREVER_NS if stays else DEFAULT_MAX_AGE_NS
    given = (entry.max_age_ns if entry is not None else None) or mapping.max_age_ns
    max_age_ns = FOREVER_NS if is_static else given or default
    return PlannedTopic(
        name=topic.name,
        clock=(entry.clock if entry is not None else None) or mapping.clock,
        mapping=entry,
        layout=layout,
        max_age_ns=max_age_ns,
        between_ns=min(given or DEFAULT_MAX_AGE_NS, HISTORY_NS),
        is_transforms=is_transforms,
        is_static=is_static,
        is_latched=topic.latched,
        is_lasting=is_static or (layout is not None and max_age_ns >= FOREVER_NS),
    )

"""Plan the reading of a log: compare a mapping with the topics of the log.

`ReadingPlan.of` finds a mapping's faults that depend on the log. It decides which topics are read, for which
purpose, and how far outside a window.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from spatial_replay.bags.decoders import Topic
from spatial_replay.bags.reader import DISORDER_NS
from spatial_replay.errors import UsageError
from spatial_replay.mapping.mapping_file import (
    DEFAULT_MAX_AGE_NS,
    FOREVER_NS,
    Clock,
    LogMapping,
    TopicMapping,
)
from spatial_replay.mapping.message_types import (
    BUILT_IN,
    GEODETIC,
    GEODETIC_TYPES,
    TRANSFORM_TYPES,
    MessageLayout,
    geodetic_order,
    layout_of_topic,
    short_type,
)
from spatial_replay.mapping.transforms import HISTORY_NS
from spatial_replay.text import nearest_hint, plural
from spatial_replay.trace.trace import LONG_PAUSE

# with this bound, a window needs messages only up to 11 s after its end and 13 s before its start
_LONGEST_SILENCE_NS: Final = 10 * 10**9
"""Silence of the sampled topic, nanoseconds, that is always a pause, even if messages are rare."""


@dataclass(frozen=True, slots=True)
class PlannedTopic:
    """Plan for one topic, or for one list of objects in its messages.

    Attributes:
        name: topic; from the topic's second entry on, with the index of the entry: `/scene`, `/scene[1]`.
        topic: topic of the log.
        mapping: entry of the mapping; None for topics read only for transforms or times.
        layout: places of object fields; None for a topic without objects.
        max_age_ns: validity of an observation or a signal, nanoseconds.
        between_ns: longest gap between two transforms that interpolation bridges, nanoseconds. Objects in a
            longer gap are unknown.
        silence_ns: silence after which the topic has ended, nanoseconds. The topic ends even if its last
            message stays valid.
        is_transforms: whether the messages are transforms between frames.
        is_static: whether the transforms hold at all times.
        is_lasting: whether a message stays valid forever.
        is_latched: whether messages may have been sent long before recording.
        is_protobuf_json: whether messages are JSON of a Foxglove type, which protobuf may have written.
    """

    name: str
    topic: str
    clock: Clock
    mapping: TopicMapping | None
    layout: MessageLayout | None
    max_age_ns: int
    between_ns: int
    silence_ns: int
    is_transforms: bool
    is_static: bool
    is_lasting: bool
    is_latched: bool = False
    is_protobuf_json: bool = False

    @property
    def is_geodetic(self) -> bool:
        """Whether positions are latitudes and longitudes, counted from the mapping's origin."""
        return self.layout is not None and self.layout.is_geodetic


@dataclass(frozen=True, slots=True)
class ReadingPlan:
    """Messages to read for a mapping that fits the log.

    Attributes:
        topics: topics to read: mapped topics, and topics of transforms if frames are needed.
        by_log_time: whether times of samples are log times. Otherwise all messages must be
            decoded to find the messages of a window.
        late_ns: largest disorder of messages, nanoseconds. Samples wait for late messages for this time.
        wait_ns: waiting time of samples for messages that affect them, nanoseconds.
        margin_ns: time after a window's end in which messages still affect the window, nanoseconds.
        planned: plan for each topic, in the order of `topics`.
        lost: (topic, reason) of transform topics that cannot be decoded.
        absent: optional topics that the log lacks.
        sampled_topic: topic with a sample at each message; None for samples at multiples of a step.
        fallback_topics: topics that are sampled while the sampled topic is silent.
        silence_ns: least silence of the sampled topic before fallback topics are sampled, nanoseconds.
        longest_silence_ns: silence after which fallback topics are always sampled, nanoseconds.
        remarks: doubts about the choice of the sampled topic.
    """

    mapping: LogMapping
    topics: tuple[str, ...]
    by_log_time: bool
    wait_ns: int
    margin_ns: int
    late_ns: int = DISORDER_NS
    planned: tuple[PlannedTopic, ...] = ()
    sampled_topic: str | None = None
    fallback_topics: frozenset[str] = frozenset()
    silence_ns: int = DEFAULT_MAX_AGE_NS
    longest_silence_ns: int = 0
    lost: tuple[tuple[str, str], ...] = ()
    absent: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @classmethod
    def of(cls, mapping: LogMapping, topics: Sequence[Topic], late_ns: int = DISORDER_NS) -> ReadingPlan:
        """Compare a mapping with the topics of a log.

        Raises:
            UsageError: the mapping does not fit the topics; all errors are listed.
        """
        by_name = {topic.name: topic for topic in topics}
        faults = _faults_of(mapping, by_name)
        if faults:
            raise UsageError("\n".join(f"{mapping.name}: {fault}" for fault in faults))
        entries_by_topic: dict[str, list[TopicMapping | None]] = {}
        for entry in mapping.topics:
            entries_by_topic.setdefault(entry.topic, []).append(entry)
        needs_frames = mapping.fixed_frame is not None
        topic_names = [topic for topic in entries_by_topic if topic in by_name]
        unmapped_topics = [topic for topic in topics if needs_frames and topic.name not in entries_by_topic]
        transform_topics = [topic for topic in unmapped_topics if short_type(topic.type) in TRANSFORM_TYPES]
        topic_names += [topic.name for topic in transform_topics if topic.unreadable is None]
        lost_topics = [
            (topic.name, topic.unreadable)
            for topic in transform_topics
            if topic.unreadable and topic.count != 0
        ]
        is_stepped = mapping.sampling.step_ns is not None
        sampled_topic = None if is_stepped else mapping.sampling.topic or _most_frequent(mapping, by_name)
        if sampled_topic is not None and sampled_topic not in topic_names:
            topic_names.append(sampled_topic)
        planned = tuple(
            _plan_of_topic(mapping, entry, by_name[name], entry_index, needs_frames)
            for name in topic_names
            for entry_index, entry in enumerate(entries_by_topic.get(name, [None]))
        )
        has_all_topics = all(topic in by_name for topic in entries_by_topic)
        if mapping.origin is not None and has_all_topics and not any(topic.is_geodetic for topic in planned):
            raise UsageError(
                f"{mapping.name}: origin: it has no effect, since no topic has positions in degrees; name"
                " fields called latitude and longitude as `position`, or leave it out"
            )
        waits_for_frames = any(topic.is_transforms and not topic.is_static for topic in planned)
        fallback_topics = _fallback_topics(planned, sampled_topic)
        silences_ns = (topic.silence_ns for topic in planned if topic.name == sampled_topic)
        silence_ns = max([DEFAULT_MAX_AGE_NS, *silences_ns])
        longest_silence_ns = max(silence_ns, _LONGEST_SILENCE_NS) if sampled_topic and fallback_topics else 0
        wait_ns = late_ns + max(HISTORY_NS if waits_for_frames else 0, mapping.max_gap_ns or 0)
        return cls(
            mapping=mapping,
            topics=tuple(topic_names),
            by_log_time=all(topic.clock == "log" for topic in planned),
            late_ns=late_ns,
            wait_ns=wait_ns,
            margin_ns=max(wait_ns, late_ns + longest_silence_ns),
            planned=planned,
            sampled_topic=sampled_topic,
            fallback_topics=fallback_topics,
            silence_ns=silence_ns,
            longest_silence_ns=longest_silence_ns,
            lost=tuple(lost_topics),
            absent=tuple(topic for topic in entries_by_topic if topic not in by_name),
            remarks=(
                *_slow_sampling(
                    sampled_topic, [by_name[topic] for topic in entries_by_topic if topic in by_name], by_name
                ),
                *doubts_of(topics, has_frames=needs_frames, has_stamps=mapping.clock == "header"),
            ),
        )

    def lookback_ns(self, topic: str) -> int | None:
        """Return the time before a window in which a topic's messages affect the window, nanoseconds.

        None means that all earlier messages affect the window, for example static transforms.
        """
        lookbacks_ns = [self._lookback_ns(planned) for planned in self.planned if planned.topic == topic]
        return None if None in lookbacks_ns else max(filter(None, lookbacks_ns), default=0)

    def _lookback_ns(self, planned: PlannedTopic) -> int | None:
        ages_ns = [
            topic.max_age_ns
            for topic in self.planned
            if topic.layout is not None and not topic.is_lasting and not topic.is_transforms
        ]
        lookback_ns = planned.max_age_ns if planned.mapping is not None else 0
        if planned.name == self.sampled_topic:
            # a pause is recognised by the two messages before it
            pauses_ns = self.longest_silence_ns + self.longest_silence_ns // LONG_PAUSE
            lookback_ns = max(lookback_ns, pauses_ns)
        if planned.is_transforms and not planned.is_static:
            # an observation of this age may be valid in the window, and needs a transform at its time
            lookback_ns = max(lookback_ns, HISTORY_NS + max(ages_ns, default=0))
            if any(topic.is_lasting and topic.layout is not None for topic in self.planned):
                return None
        lookback_ns += self.late_ns
        return None if planned.is_lasting or lookback_ns >= FOREVER_NS else lookback_ns

    def first_read_ns(self, start_ns: int) -> int:
        """Return the log time from which messages affect a window that starts at `start_ns`."""
        lookbacks_ns = [self.lookback_ns(topic) for topic in self.topics]
        return max(
            0,
            start_ns
            - max((lookback_ns for lookback_ns in lookbacks_ns if lookback_ns is not None), default=0),
        )


def _faults_of(mapping: LogMapping, by_name: dict[str, Topic]) -> list[str]:
    if not mapping.topics:
        return ["its keys are for data sets of episodes, and this log has messages; name its `topics`"]
    faults: list[str] = []
    mapped_names = [entry.topic for entry in mapping.topics]
    sampled_topic = mapping.sampling.topic
    optional_names = {entry.topic for entry in mapping.topics if entry.optional}
    for name in [
        *mapped_names,
        *([sampled_topic] if sampled_topic is not None and sampled_topic not in mapped_names else []),
    ]:
        key_path = f"topics.{name}" if name in mapped_names else "sample.topic"
        if name in optional_names and name not in by_name:
            if name == sampled_topic:
                faults.append(
                    f"sample.topic: the log has no topic {name!r}, so no sample can be taken; name one that"
                    " every log has, or {every: 100ms}"
                )
        elif name not in by_name:
            hint = nearest_hint(name, by_name) or f"its topics are {_topics_in_words(by_name)}"
            if name in mapped_names and not hint.endswith("?"):
                hint += "; where only some logs have it, add `optional: true`"
            faults.append(f"{key_path}: the log has no topic {name!r}; {hint}")
        elif (reason := by_name[name].unreadable) is not None:
            faults.append(f"{key_path}: its messages cannot be decoded: {reason}")
    if optional_names.issuperset(mapped_names) and by_name.keys().isdisjoint(mapped_names):
        topic_text = _topics_in_words(by_name)
        faults.append(f"topics: the log has none of these optional topics; its topics are {topic_text}")
    for entry in mapping.topics:
        type_name = short_type(entry.type or (by_name[entry.topic].type if entry.topic in by_name else ""))
        if (
            type_name in GEODETIC_TYPES
            and entry.reads_objects
            and entry.position is None
            and entry.polygon is None
            and mapping.origin is None
        ):
            faults.append(
                f"topics.{entry.topic}: {type_name} holds degrees; give the file an"
                " `origin: [latitude, longitude]`, and positions are metres east and north of it"
            )
        if entry.type is not None and short_type(entry.type) not in BUILT_IN:
            hint = nearest_hint(short_type(entry.type), BUILT_IN) or f"known are {', '.join(BUILT_IN)}"
            faults.append(f"topics.{entry.topic}.type: {entry.type!r} is not a known type; {hint}")
    return faults


def _topics_in_words(by_name: Mapping[str, Topic]) -> str:
    return ", ".join(sorted(by_name)[:20]) or "none"


def _most_frequent(mapping: LogMapping, by_name: Mapping[str, Topic]) -> str:
    """Return the topic to sample by default: the topic with objects and most messages.

    If no topic has objects, all topics are candidates. If the log does not give message counts, the first
    candidate is sampled.
    """
    existing_entries = [entry for entry in mapping.topics if entry.topic in by_name]
    candidate_names = [entry.topic for entry in existing_entries if entry.reads_objects] or [
        entry.topic for entry in existing_entries
    ]
    message_counts = [by_name[name].count for name in candidate_names]
    return (
        candidate_names[0]
        if None in message_counts
        else max(candidate_names, key=lambda name: by_name[name].count or 0)
    )


def _fallback_topics(planned: Sequence[PlannedTopic], sampled: str | None) -> frozenset[str]:
    """Return the topics to sample while the sampled topic is silent.

    Topics of static transforms, topics of markers and latched topics are excluded, because they are sent
    rarely.
    """
    frequent_topics = [
        topic
        for topic in planned
        if topic.mapping is not None
        and not (topic.is_static or topic.is_latched or (topic.layout is not None and topic.layout.stays))
    ]
    topics_with_objects = [topic for topic in frequent_topics if topic.layout is not None]
    return frozenset(topic.name for topic in topics_with_objects or frequent_topics if topic.topic != sampled)


_MANY_TIMES = 10
"""Least ratio of message counts for a remark on slow sampling."""


def _slow_sampling(
    sampled: str | None, mapped: Sequence[Topic], by_name: Mapping[str, Topic]
) -> tuple[str, ...]:
    """Return a remark if a mapped topic has many times more messages than the sampled topic."""
    busiest_topic = max(mapped, key=lambda topic: topic.count or 0)
    sampled_count = None if sampled is None else by_name[sampled].count
    if (
        sampled_count is None
        or busiest_topic.count is None
        or busiest_topic.count < _MANY_TIMES * max(sampled_count, 1)
    ):
        return ()
    messages = plural(sampled_count, "message")
    return (
        f"samples are taken at {sampled}, which has {messages}, where {busiest_topic.name} has"
        f" {busiest_topic.count}; `sample: {{topic: {busiest_topic.name}}}` takes one at each of these",
    )


def doubts_of(
    topics: Iterable[Topic], *, has_frames: bool = False, has_stamps: bool = False
) -> Iterator[str]:
    """Yield doubts about unused information in the log: transforms of several robots, and simulated time.

    Args:
        has_frames: whether transforms place objects in a fixed frame.
        has_stamps: whether the mapping has `clock: header`.
    """
    topics = tuple(topics)
    transform_topics = [topic.name for topic in topics if short_type(topic.type) in TRANSFORM_TYPES]
    moving_topics = [topic_name for topic_name in transform_topics if not topic_name.endswith("tf_static")]
    if len(moving_topics) > 1 and not has_frames:
        yield (
            f"transforms come on {' and '.join(moving_topics)}, so frames of one name may be of two robots;"
            " without `fixed_frame`, coordinates are taken to be in one frame"
        )
    clock_topic = next(
        (topic.name for topic in topics if short_type(topic.type) == "rosgraph_msgs/Clock"), None
    )
    if clock_topic is not None and not has_stamps:
        yield (
            f"{clock_topic} has simulated time, which may run at another rate than the recording; `clock:"
            " header` takes the stamps of messages"
        )


def _plan_of_topic(
    mapping: LogMapping, entry: TopicMapping | None, topic: Topic, entry_index: int, needs_frames: bool
) -> PlannedTopic:
    type_name = short_type((entry.type if entry is not None else None) or topic.type)
    # only the first entry of a topic adds the topic's transforms
    is_transforms = needs_frames and short_type(topic.type) in TRANSFORM_TYPES and entry_index == 0
    is_static = is_transforms and (topic.latched or topic.name.rsplit("/", 1)[-1] == "tf_static")
    layout = layout_of_topic(topic.type, entry) if entry is not None and entry.reads_objects else None
    if layout is not None and GEODETIC in layout.position:
        layout = replace(layout, origin=mapping.origin)
    elif layout is not None and mapping.origin is not None and layout.position:
        paths = geodetic_order(layout.position[0])
        if paths is not None:
            layout = replace(layout, origin=mapping.origin, position=(paths,))
    if layout is not None and layout.polygon and layout.polygon[-1].rpartition(".")[2] in _GEOMETRIES:
        layout = replace(layout, corner_origin=mapping.origin)
    stays_valid = topic.latched or (layout is not None and layout.stays)
    default_age_ns = FOREVER_NS if stays_valid else DEFAULT_MAX_AGE_NS
    mapped_ns = (entry.max_age_ns if entry is not None else None) or mapping.max_age_ns
    max_age_ns = FOREVER_NS if is_static else mapped_ns or default_age_ns
    return PlannedTopic(
        name=f"{topic.name}[{entry_index}]" if entry_index else topic.name,
        topic=topic.name,
        clock=(entry.clock if entry is not None else None) or mapping.clock,
        mapping=entry,
        layout=layout,
        max_age_ns=max_age_ns,
        between_ns=min(mapped_ns or DEFAULT_MAX_AGE_NS, HISTORY_NS),
        silence_ns=DEFAULT_MAX_AGE_NS if mapped_ns is None or mapped_ns >= FOREVER_NS else mapped_ns,
        is_transforms=is_transforms,
        is_static=is_static,
        is_latched=topic.latched,
        is_protobuf_json=topic.encoding == "json" and type_name.startswith("foxglove/"),
        is_lasting=is_static or (layout is not None and max_age_ns >= FOREVER_NS),
    )


_GEOMETRIES = frozenset({"geometry", "coordinates"})
"""Fields of GeoJSON. Their corners are longitude and latitude, in this order (RFC 7946)."""

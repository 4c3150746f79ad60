"""Suggest a mapping file: the topics of a log and example messages in, YAML with comments out.

A topic of a known type needs no fields. In other messages, fields that look like the position, orientation,
size and name of an object are found by their names and the types of their values.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from operator import itemgetter
from types import MappingProxyType

from spatial_replay.bags.topic import Topic
from spatial_replay.logs.topics import DERIVED
from spatial_replay.mapping.field_paths import (
    FieldPath,
    field_names,
    get_field,
    getter,
    name_from_topic,
    style_of,
)
from spatial_replay.mapping.message_types import (
    BUILT_IN,
    GEODETIC,
    GEODETIC_TYPES,
    TRANSFORM_TYPES,
    short_type,
)
from spatial_replay.mapping.model import NO_TOPIC
from spatial_replay.mapping.recognise import Guess, frame_of, guess_objects, numbers_in
from spatial_replay.text import counted
from spatial_replay.trace.sample import FOREVER

EXAMPLES = 20
"""Decoded messages of each topic to use at most."""

_RADIUS = "0.5"
_TOGETHER_NS = 10**9
_NOT_KNOWN: Mapping[str, int] = MappingProxyType({})
_MOST_SIGNALS = 12
_PLAIN = re.compile(r"/?[A-Za-z_][\w/.-]*", re.ASCII)
_MIDDLEWARE = frozenset({"rosout", "rosout_agg", "parameter_events", "clock", "diagnostics"})
"""Topics about programs rather than objects, by the last part of their names."""
_SENSORS = re.compile("camera|optical|lidar|laser|velodyne|radar|imu|gps|gnss|sensor", re.IGNORECASE)
"""Names of frames that are mounted on an object."""


@dataclass(frozen=True, slots=True)
class TopicSuggestion:
    """A suggestion for one topic.

    Attributes:
        fields: its entry in a mapping, by key, in YAML's flow style; None if nothing looks like an object.
        name: the template of its objects' names, by default or as in the entry.
        remarks: what a reader should know or change.
        is_transforms: whether it carries transforms. They are suggested as objects only if there are no
            others.
        frame: the frame of its coordinates.
        numbers: paths of possible signals.
    """

    topic: Topic
    fields: Mapping[str, str] | None = None
    name: str = ""
    remarks: tuple[str, ...] = ()
    is_transforms: bool = False
    frame: str | None = None
    numbers: tuple[str, ...] = ()

    @property
    def entry(self) -> str:
        """The entry in YAML's flow style; empty if nothing looks like an object."""
        return "" if self.fields is None else _flow(self.fields)

    @property
    def signals(self) -> str:
        """An entry that takes the numbers as signals; empty without any."""
        prefix = _topic_words(self.topic.name)
        names = {f"{prefix}_{_signal_name(path)}": path for path in self.numbers[:_MOST_SIGNALS]}
        listed = _flow({_text(name): _text(path) for name, path in names.items()})
        return f"{{signals: {listed}}}" if names else ""


def suggest_topics(
    topics: Sequence[Topic], examples: Mapping[str, Sequence[object]]
) -> tuple[TopicSuggestion, ...]:
    """Suggest an entry for each topic.

    Args:
        examples: some decoded messages of each topic, by its name.
    """
    return tuple(_suggestion(topic, examples.get(topic.name, ())) for topic in topics)


def suggest_mapping(
    log: str,
    topics: Sequence[Topic],
    examples: Mapping[str, Sequence[object]],
    first_ns: Mapping[str, int] = _NOT_KNOWN,
) -> str:
    """Return the text of a mapping file, with comments; it is valid if some topic holds objects.

    Args:
        log: the log's name.
        examples: some decoded messages of each topic, by its name.
        first_ns: log time of the first message of each topic, by its name.
    """
    suggestions = suggest_topics(topics, examples)
    mapped = [each for each in suggestions if each.entry and not each.is_transforms]
    transforms = [each for each in suggestions if each.is_transforms]
    active = _distinguished(mapped or [each for each in transforms if each.entry])
    signals = [] if active else [each for each in suggestions if each.signals]
    chosen = {each.topic.name: each.entry for each in active} | {e.topic.name: e.signals for e in signals}
    lines = [f"# How messages of {_comment(log)} become objects: a start, made from the first of them."]
    if not active:
        lines.append(f"# Nothing looks like an object{': these are signals' if signals else ''}.")
    lines += [
        *_frame_lines(active, transforms, examples),
        *_axes_lines(active),
        *_origin_lines(active, examples),
        *_time_lines(active or signals, first_ns),
        "topics:",
    ]
    if not chosen:
        lines.append(f"  # {NO_TOPIC}, such as")
        lines.append("  # /robot/state: {name: robot, position: [x, y], yaw: theta, shape: {disc: 0.5}}")
    for each in active or signals:
        lines += [f"  # {_described(each.topic)}", *(f"  # {remark}" for remark in each.remarks)]
        lines.append(f"  {_text(each.topic.name)}: {chosen[each.topic.name]}")
    rest = [each for each in suggestions if each.topic.name not in chosen]
    if rest:
        lines += ["", "  # not used:", *(line for each in rest for line in _unused(each))]
    return "\n".join(lines) + "\n"


def _distinguished(active: Sequence[TopicSuggestion]) -> list[TopicSuggestion]:
    """Return suggestions with the topic in those names that several topics share."""
    shared = Counter(each.name for each in active)
    return [_with_own_name(each) if shared[each.name] > 1 else each for each in active]


def _with_own_name(each: TopicSuggestion) -> TopicSuggestion:
    prefix = _topic_words(each.topic.name)
    name = f"{prefix}_{each.name}" if "{" in each.name else prefix
    fields = {**(each.fields or {}), "name": _text(name)}
    # of a list, its path comes first
    ordered = sorted(fields.items(), key=lambda field: {"objects": 0, "name": 1}.get(field[0], 2))
    return replace(each, fields=dict(ordered))


def _origin_lines(
    active: Sequence[TopicSuggestion], examples: Mapping[str, Sequence[object]]
) -> Iterator[str]:
    """Yield the line about where local metres are counted from: the first fix."""
    for each in active:
        if short_type(each.topic.type) in GEODETIC_TYPES:
            for message in examples.get(each.topic.name, ()):
                place = [float(getter(FieldPath.of(name), style_of(message))(message)) for name in GEODETIC]
                if all(map(isfinite, place)):
                    yield "# where (0, 0) is, here at the first fix; x is in metres east of it, y north"
                    yield f"origin: [{place[0]!r}, {place[1]!r}]"
                    return


def _axes_lines(active: Sequence[TopicSuggestion]) -> Iterator[str]:
    """Yield the lines about axes, if all coordinates are those of an image."""
    if active and all(short_type(each.topic.type) in _IN_IMAGES for each in active):
        yield "# rows of pixels are counted downwards; samples have y up, so that above means above"
        yield "axes: {y: down}"


def _suggestion(topic: Topic, examples: Sequence[object]) -> TopicSuggestion:
    if topic.name in DERIVED or topic.name.rstrip("/").split("/")[-1] in _MIDDLEWARE:
        return TopicSuggestion(topic)
    kind = short_type(topic.type)
    frame = next((name for each in examples if (name := frame_of(each)) is not None), None)
    if topic.unreadable is not None:
        return TopicSuggestion(topic, remarks=(f"cannot be read: {_comment(topic.unreadable)}",))
    if kind in TRANSFORM_TYPES:
        return _of_transforms(topic, examples)
    if kind in BUILT_IN:
        reading = BUILT_IN[kind]
        has_outline = bool(reading.polygon or reading.sizes or reading.solids)
        name = reading.name.replace("{topic}", name_from_topic(topic.name))
        return TopicSuggestion(
            topic, {} if has_outline else _POINT, name, () if has_outline else _SIZELESS, frame=frame
        )
    guess = guess_objects(topic.name, topic.type, examples)
    if guess is None:
        return TopicSuggestion(topic, numbers=numbers_in(examples[0]) if examples else ())
    name = _name(topic, guess)
    return TopicSuggestion(topic, _fields(name, guess), name, _remarks(guess), frame=frame)


def _of_transforms(topic: Topic, examples: Sequence[object]) -> TopicSuggestion:
    """Suggest the frames of transforms, without those that are mounted on others."""
    if topic.latched or topic.name.rsplit("/", 1)[-1] == "tf_static":
        remark = "static transforms place frames, such as those of sensors; they are no objects"
        return TopicSuggestion(topic, remarks=(remark,), is_transforms=True)
    children = {child for message in examples for _, child in _edges(message)}
    mounted = sorted(child for child in children if _SENSORS.search(child))
    left_out = (
        {"except": f"[{', '.join(map(_text, mounted))}]"} if mounted and len(mounted) < len(children) else {}
    )
    return TopicSuggestion(topic, {**left_out, **_POINT}, "{child_frame_id}", _SIZELESS, is_transforms=True)


_IN_IMAGES = frozenset({"vision_msgs/Detection2DArray", "apriltag_msgs/AprilTagDetectionArray"})
"""Types whose coordinates are pixels."""

_SIZELESS = (f"messages have no size: {_RADIUS} is a guess, {{box: [length, width]}} is another shape",)


_POINT = MappingProxyType({"shape": f"{{disc: {_RADIUS}}}"})
_INDEXED = "only the places in the list distinguish objects: objects swap where these change"


def _fields(name: str, guess: Guess) -> dict[str, str]:
    parts: list[tuple[str, str | tuple[str, ...] | None]] = [
        ("objects", guess.objects),
        ("name", name),
        ("class", guess.class_name),
        ("position", guess.position),
        ("orientation", guess.orientation),
        ("yaw", guess.yaw),
        ("polygon", guess.polygon),
    ]
    fields = {key: _value(key, value) for key, value in parts if value is not None}
    return fields if guess.polygon is not None else {**fields, "shape": _shape(guess)}


def _flow(fields: Mapping[str, str]) -> str:
    return "{" + ", ".join(f"{key}: {value}" for key, value in fields.items()) + "}"


def _topic_words(topic: str) -> str:
    return "_".join(word for word in topic.split("/") if word) or "object"


def _signal_name(path: str) -> str:
    """Return a name for a path: `position[name=elbow]` → elbow_position."""
    before, _, key = path.removesuffix("]").partition("[name=")
    return re.sub(r"\W", "_", f"{key}_{before}" if key else path, flags=re.ASCII)


def _value(key: str, value: str | tuple[str, ...]) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_text, value))}]"
    return f"{{field: {_text(value)}}}" if key == "class" else _text(value)


def _shape(guess: Guess) -> str:
    if not guess.size:
        return f"{{disc: {_RADIUS}}}"
    return f"{{disc: {guess.size[0]}}}" if len(guess.size) == 1 else f"{{box: [{', '.join(guess.size)}]}}"


def _name(topic: Topic, guess: Guess) -> str:
    if guess.objects is None:
        return name_from_topic(topic.name)
    word = guess.objects.removesuffix("[*]").split(".")[-1].removesuffix("s") or "object"
    return f"{word}{{{guess.names[0] if guess.names else 'index'}}}"


def _remarks(guess: Guess) -> tuple[str, ...]:
    sizeless = () if guess.polygon is not None or guess.size else _SIZELESS
    others = (f"other lists that look like objects: {', '.join(guess.others[:6])}",) if guess.others else ()
    indexed = (_INDEXED,) if guess.objects is not None and not guess.names else ()
    return sizeless + indexed + others


def _frame_lines(
    active: Sequence[TopicSuggestion],
    transforms: Sequence[TopicSuggestion],
    examples: Mapping[str, Sequence[object]],
) -> Iterator[str]:
    """Yield the lines about the fixed frame, which coordinates in more than one frame need."""
    frames = sorted({each.frame for each in active if each.frame is not None})
    messages = (message for each in transforms for message in examples.get(each.topic.name, ()))
    edges = {edge for message in messages for edge in _edges(message)}
    roots = sorted({parent for parent, _ in edges} - {child for _, child in edges})
    if len(frames) > 1:
        yield f"# coordinates are in the frames {_comment(', '.join(frames))}: bring them into one"
        known = {name for edge in edges for name in edge}
        fixed = next((root for root in roots if known.issuperset(frames)), None)
        yield f"{'' if fixed else '# '}fixed_frame: {_text(fixed or frames[0])}"
    elif edges:
        yield "# without a fixed frame, coordinates are taken as they are"
        yield f"# fixed_frame: {_text((roots or frames or ['map'])[0])}"


def _edges(message: object) -> Iterator[tuple[str, str]]:
    """Iterate over the pairs (parent, child) of frames in a message with transforms."""
    listed = getattr(message, "transforms", None)
    if isinstance(message, dict):
        listed = message.get("transforms")
    for each in [message] if listed is None else listed:
        known = field_names(each)
        parent = frame_of(each) or ("parent_frame_id" in known and get_field(each, "parent_frame_id"))
        child = "child_frame_id" in known and get_field(each, "child_frame_id")
        if isinstance(parent, str) and isinstance(child, str) and parent and child:
            yield parent.removeprefix("/"), child.removeprefix("/")


def _time_lines(active: Sequence[TopicSuggestion], first_ns: Mapping[str, int]) -> Iterator[str]:
    yield "clock: log    # when a message was recorded; publish: when it was sent; header: its own stamp"
    if active:
        topic = _text(_sampled(active, first_ns).name)
        yield f"sample: {{topic: {topic}}}    # a sample at each of its messages; or {{every: 100ms}}"
        yield "max_age: 1s    # after which an object that nothing is heard of is unknown"


def _sampled(active: Sequence[TopicSuggestion], first_ns: Mapping[str, int]) -> Topic:
    """Choose the topic to sample: the last to start of those that start together, so that none is missing."""
    topics = [each.topic for each in active]
    begins = [first_ns.get(topic.name, FOREVER) for topic in topics]
    often = max(topic.count or 0 for topic in topics)
    together = [
        (begin, topic)
        for begin, topic in zip(begins, topics, strict=True)
        if begin <= min(begins) + _TOGETHER_NS and 2 * (topic.count or 0) >= often
    ]
    return max(together, key=itemgetter(0))[1] if together else topics[0]


def _unused(each: TopicSuggestion) -> Iterator[str]:
    topic = _text(each.topic.name)
    if each.entry:
        yield f"  # {topic}: {each.entry}    # {_described(each.topic)}"
    elif each.signals:
        yield f"  # {topic}: {each.signals}    # {_described(each.topic)}"
    else:
        remark = "".join(f"; {remark}" for remark in each.remarks)
        yield f"  # {topic}: {_described(each.topic)}{remark}"


def _described(topic: Topic) -> str:
    kind = _comment(topic.type) or "type unknown"
    return kind if topic.count is None else f"{kind}, {counted(topic.count, 'message')}"


def _comment(text: str) -> str:
    """Return a text that fits on one line."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())[:200]


def _text(text: str) -> str:
    """Return a text as a YAML scalar."""
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=True)

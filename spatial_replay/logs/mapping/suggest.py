"""A mapping file to start from, out of what a log holds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from types import MappingProxyType

from spatial_replay.logs.foreign.messages import Topic
from spatial_replay.logs.mapping.guess import Guess, frame_of, guess_from, numbers_in
from spatial_replay.logs.mapping.readings import BUILT_IN, TRANSFORM_TYPES, short_type
from spatial_replay.logs.mapping.templates import name_from_topic
from spatial_replay.logs.topics import DERIVED
from spatial_replay.trace.times import FOREVER

EXAMPLES = 20
"""Decoded messages of each topic that are worth a look."""

_RADIUS = "0.5"
_TOGETHER_NS = 10**9
_NOT_KNOWN: Mapping[str, int] = MappingProxyType({})
_MOST_SIGNALS = 8
_PLAIN = re.compile(r"/?[A-Za-z_][\w/.-]*", re.ASCII)
_WORDS = frozenset({"true", "false", "null", "yes", "no", "on", "off", "y", "n"})
"""Words that some readers of YAML take for something else than text."""
_MIDDLEWARE = frozenset({"rosout", "rosout_agg", "parameter_events", "clock", "diagnostics"})
"""Topics about programs rather than things, by the last part of their names."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A topic that may be mapped.

    Attributes:
        entry: what a mapping says of it, in YAML's flow style; empty where nothing looks like an object.
        remarks: what a reader should know or change.
        is_transforms: whether its objects are frames, which other topics may need rather than name.
        frame: the frame that its coordinates are in.
        numbers: paths of what may be signals.
    """

    topic: Topic
    entry: str = ""
    remarks: tuple[str, ...] = ()
    is_transforms: bool = False
    frame: str | None = None
    numbers: tuple[str, ...] = ()


def candidates(topics: Sequence[Topic], examples: Mapping[str, Sequence[object]]) -> tuple[Candidate, ...]:
    """What each topic could be read as.

    Args:
        examples: some decoded messages of each topic, by its name.
    """
    return tuple(_candidate(topic, examples.get(topic.name, ())) for topic in topics)


def suggest_mapping(
    log: str,
    topics: Sequence[Topic],
    examples: Mapping[str, Sequence[object]],
    first_ns: Mapping[str, int] = _NOT_KNOWN,
) -> str:
    """A mapping file with comments, as text; it can be used at once where some topic holds objects.

    Args:
        log: the log's name.
        examples: some decoded messages of each topic, by its name.
        first_ns: log time of the first message of each topic, by its name.
    """
    found = candidates(topics, examples)
    mapped = [each for each in found if each.entry and not each.is_transforms]
    transforms = [each for each in found if each.is_transforms]
    active = mapped or [each for each in transforms if each.entry]
    lines = [f"# How messages of {_comment(log)} become objects: a start, made from the first of them."]
    lines += [*_frame_lines(active, transforms, examples), *_time_lines(active, first_ns), "topics:"]
    if not active:
        lines.append("  # nothing looks like an object; name the fields of a topic that is one, such as")
        lines.append("  # /robot/state: {name: robot, position: [x, y], yaw: theta, shape: {disc: 0.5}}")
    for each in active:
        lines += [f"  # {_described(each.topic)}", *(f"  # {remark}" for remark in each.remarks)]
        lines.append(f"  {_text(each.topic.name)}: {each.entry}")
    rest = [each for each in found if each not in active]
    if rest:
        lines += ["", "  # not used:", *(line for each in rest for line in _unused(each))]
    return "\n".join(lines) + "\n"


def _candidate(topic: Topic, examples: Sequence[object]) -> Candidate:
    if topic.name in DERIVED or topic.name.rstrip("/").split("/")[-1] in _MIDDLEWARE:
        return Candidate(topic)
    kind = short_type(topic.type)
    frame = next((name for each in examples if (name := frame_of(each)) is not None), None)
    if topic.unreadable is not None:
        return Candidate(topic, remarks=(f"cannot be read: {_comment(topic.unreadable)}",))
    if kind in TRANSFORM_TYPES:
        return Candidate(topic, f"{{shape: {{disc: {_RADIUS}}}}}", _SIZELESS, is_transforms=True)
    if kind in BUILT_IN:
        reading = BUILT_IN[kind]
        has_outline = bool(reading.polygon or reading.sizes or reading.solids)
        entry = "{}" if has_outline else f"{{shape: {{disc: {_RADIUS}}}}}"
        return Candidate(topic, entry, () if has_outline else _SIZELESS, frame=frame)
    guesses = [guess for each in examples if (guess := guess_from(each)) is not None]
    if not guesses:
        return Candidate(topic, numbers=numbers_in(examples[0]) if examples else ())
    best = max(guesses, key=lambda guess: guess.score)
    return Candidate(topic, _entry(topic, best), _remarks(best), frame=frame)


_SIZELESS = (f"messages have no size: {_RADIUS} is a guess, {{box: [length, width]}} is another shape",)


def _entry(topic: Topic, guess: Guess) -> str:
    parts: list[tuple[str, str | tuple[str, ...] | None]] = [
        ("objects", guess.objects),
        ("name", _name(topic, guess)),
        ("class", guess.class_name),
        ("position", guess.position),
        ("orientation", guess.orientation),
        ("yaw", guess.yaw),
        ("polygon", guess.polygon),
    ]
    texts = [f"{key}: {_value(key, value)}" for key, value in parts if value is not None]
    if guess.polygon is None:
        texts.append(f"shape: {_shape(guess)}")
    return "{" + ", ".join(texts) + "}"


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
    return f"{word}{{{guess.name or 'index'}}}"


def _remarks(guess: Guess) -> tuple[str, ...]:
    sizeless = () if guess.polygon is not None or guess.size else _SIZELESS
    others = (f"other lists that look like objects: {', '.join(guess.others[:6])}",) if guess.others else ()
    return sizeless + others


def _frame_lines(
    active: Sequence[Candidate], transforms: Sequence[Candidate], examples: Mapping[str, Sequence[object]]
) -> Iterator[str]:
    """The fixed frame: needed as soon as coordinates are in more than one."""
    frames = sorted({each.frame for each in active if each.frame is not None})
    edges = {
        edge
        for each in transforms
        for message in examples.get(each.topic.name, ())
        for edge in _edges(message)
    }
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
    """The frames that a message with transforms joins, parent first."""
    listed = getattr(message, "transforms", None)
    if isinstance(message, dict):
        listed = message.get("transforms")
    for each in [message] if listed is None else listed:
        fields = each if isinstance(each, dict) else _Attributes(each)
        parent = frame_of(each) or fields.get("parent_frame_id")
        child = fields.get("child_frame_id")
        if isinstance(parent, str) and isinstance(child, str) and parent and child:
            yield parent.removeprefix("/"), child.removeprefix("/")


class _Attributes:
    """The attributes of a message, got as the keys of a JSON object are."""

    def __init__(self, message: object) -> None:
        self._message = message

    def get(self, name: str) -> object:
        return getattr(self._message, name, None)


def _time_lines(active: Sequence[Candidate], first_ns: Mapping[str, int]) -> Iterator[str]:
    yield "clock: log    # when a message was recorded; publish: when it was sent; header: its own stamp"
    if active:
        topic = _text(_sampled(active, first_ns).name)
        yield f"sample: {{topic: {topic}}}    # a sample at each of its messages; or {{every: 100ms}}"
        yield "max_age: 1s    # after which an object that nothing is heard of is unknown"


def _sampled(active: Sequence[Candidate], first_ns: Mapping[str, int]) -> Topic:
    """Where to take samples: at the last of the topics that begin together, so that none is missing."""
    topics = [each.topic for each in active]
    begins = [first_ns.get(topic.name, FOREVER) for topic in topics]
    often = max(topic.count or 0 for topic in topics)
    together = [
        (begin, topic)
        for begin, topic in zip(begins, topics, strict=True)
        if begin <= min(begins) + _TOGETHER_NS and 2 * (topic.count or 0) >= often
    ]
    return max(together, key=itemgetter(0))[1] if together else topics[0]


def _unused(each: Candidate) -> Iterator[str]:
    topic = _text(each.topic.name)
    if each.entry:
        yield f"  # {topic}: {each.entry}    # {_described(each.topic)}"
    elif each.numbers:
        path = {number: _text(number.replace(".", "_")) for number in each.numbers[:_MOST_SIGNALS]}
        signals = ", ".join(f"{_signal_name(each.topic, name)}: {number}" for number, name in path.items())
        yield f"  # {topic}: {{signals: {{{signals}}}}}    # {_described(each.topic)}"
    else:
        remark = "".join(f"; {remark}" for remark in each.remarks)
        yield f"  # {topic}: {_described(each.topic)}{remark}"


def _signal_name(topic: Topic, name: str) -> str:
    return f"{name_from_topic(topic.name)}_{name}"


def _described(topic: Topic) -> str:
    kind = _comment(topic.type) or "type unknown"
    return (
        kind if topic.count is None else f"{kind}, {topic.count:,} message{'' if topic.count == 1 else 's'}"
    )


def _comment(text: str) -> str:
    """A text that stays on its line."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())[:200]


def _text(text: str) -> str:
    """A text as a YAML scalar."""
    return (
        text if _PLAIN.fullmatch(text) and not text.endswith("[*]") else json.dumps(text, ensure_ascii=True)
    )

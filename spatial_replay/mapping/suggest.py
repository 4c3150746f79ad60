"""Suggest a mapping file: the topics of a log and example messages in, YAML with comments out.

A topic of a known type needs no fields. In other messages, fields that look like the position, orientation,
size and name of an object are found by their names and the types of their values.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from types import MappingProxyType

from spatial_replay.bags.topic import Topic
from spatial_replay.logs.topics import DERIVED
from spatial_replay.mapping.field_paths import field_names, get_field, is_list, name_from_topic
from spatial_replay.mapping.message_types import BUILT_IN, TRANSFORM_TYPES, short_type
from spatial_replay.text import counted
from spatial_replay.trace.sample import FOREVER

EXAMPLES = 20
"""Decoded messages of each topic to use at most."""

_RADIUS = "0.5"
_TOGETHER_NS = 10**9
_NOT_KNOWN: Mapping[str, int] = MappingProxyType({})
_MOST_SIGNALS = 8
_PLAIN = re.compile(r"/?[A-Za-z_][\w/.-]*", re.ASCII)
_MIDDLEWARE = frozenset({"rosout", "rosout_agg", "parameter_events", "clock", "diagnostics"})
"""Topics about programs rather than objects, by the last part of their names."""

_DEEPEST = 4
"""Levels of nested fields to search."""
_POSITIONS = ("position", "center", "centre", "translation", "location", "point")
_TURNS = ("orientation", "rotation", "quaternion")
_YAWS = ("yaw", "theta", "heading", "angle")
_SIZES = ("dimension", "dimensions", "size", "scale", "extent", "shape", "bbox")
_OUTLINES = ("corners", "polygon", "points", "vertices", "outline", "footprint", "contour")
_NAMES = ("name", "id", "track_id", "object_id", "tracking_id", "child_frame_id", "uuid", "label")
_CLASSES = ("class", "class_name", "classification", "category", "label", "object_type", "type")
_LISTS = re.compile("object|detection|track|tag|agent|obstacle|pose|vehicle|pedestrian|marker")
_NOT_PLACES = frozenset(
    {"velocity", "acceleration", "twist", "linear", "angular", "header", "stamp", "covariance"}
)


@dataclass(frozen=True, slots=True)
class TopicSuggestion:
    """A suggestion for one topic.

    Attributes:
        entry: its entry in a mapping, in YAML's flow style; empty if nothing looks like an object.
        remarks: what a reader should know or change.
        is_transforms: whether it carries transforms. They are suggested as objects only if there are no
            others.
        frame: the frame of its coordinates.
        numbers: paths of possible signals.
    """

    topic: Topic
    entry: str = ""
    remarks: tuple[str, ...] = ()
    is_transforms: bool = False
    frame: str | None = None
    numbers: tuple[str, ...] = ()


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
    active = mapped or [each for each in transforms if each.entry]
    lines = [f"# How messages of {_comment(log)} become objects: a start, made from the first of them."]
    lines += [
        *_frame_lines(active, transforms, examples),
        *_axes_lines(active),
        *_time_lines(active, first_ns),
        "topics:",
    ]
    if not active:
        lines.append("  # nothing looks like an object; name the fields of a topic that is one, such as")
        lines.append("  # /robot/state: {name: robot, position: [x, y], yaw: theta, shape: {disc: 0.5}}")
    for each in active:
        lines += [f"  # {_described(each.topic)}", *(f"  # {remark}" for remark in each.remarks)]
        lines.append(f"  {_text(each.topic.name)}: {each.entry}")
    rest = [each for each in suggestions if each not in active]
    if rest:
        lines += ["", "  # not used:", *(line for each in rest for line in _unused(each))]
    return "\n".join(lines) + "\n"


def _axes_lines(active: Sequence[TopicSuggestion]) -> Iterator[str]:
    """Yield the lines about axes, if all coordinates are those of an image."""
    if active and all(short_type(each.topic.type) in _IN_IMAGES for each in active):
        yield "# rows of pixels are counted downwards; samples have y up, so that above means above"
        yield "axes: {y: down}"


def _suggestion(topic: Topic, examples: Sequence[object]) -> TopicSuggestion:
    if topic.name in DERIVED or topic.name.rstrip("/").split("/")[-1] in _MIDDLEWARE:
        return TopicSuggestion(topic)
    kind = short_type(topic.type)
    frame = next((name for each in examples if (name := _frame_of(each)) is not None), None)
    if topic.unreadable is not None:
        return TopicSuggestion(topic, remarks=(f"cannot be read: {_comment(topic.unreadable)}",))
    if kind in TRANSFORM_TYPES:
        return TopicSuggestion(topic, f"{{shape: {{disc: {_RADIUS}}}}}", _SIZELESS, is_transforms=True)
    if kind in BUILT_IN:
        reading = BUILT_IN[kind]
        has_outline = bool(reading.polygon or reading.sizes or reading.solids)
        entry = "{}" if has_outline else f"{{shape: {{disc: {_RADIUS}}}}}"
        return TopicSuggestion(topic, entry, () if has_outline else _SIZELESS, frame=frame)
    guesses = [guess for each in examples if (guess := _guess(each)) is not None]
    if not guesses:
        return TopicSuggestion(topic, numbers=_numbers_in(examples[0]) if examples else ())
    best = max(guesses, key=lambda guess: guess.score)
    return TopicSuggestion(topic, _entry(topic, best), _remarks(best), frame=frame)


_IN_IMAGES = frozenset({"vision_msgs/Detection2DArray", "apriltag_msgs/AprilTagDetectionArray"})
"""Types whose coordinates are pixels."""

_SIZELESS = (f"messages have no size: {_RADIUS} is a guess, {{box: [length, width]}} is another shape",)


def _entry(topic: Topic, guess: _Guess) -> str:
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


def _shape(guess: _Guess) -> str:
    if not guess.size:
        return f"{{disc: {_RADIUS}}}"
    return f"{{disc: {guess.size[0]}}}" if len(guess.size) == 1 else f"{{box: [{', '.join(guess.size)}]}}"


def _name(topic: Topic, guess: _Guess) -> str:
    if guess.objects is None:
        return name_from_topic(topic.name)
    word = guess.objects.removesuffix("[*]").split(".")[-1].removesuffix("s") or "object"
    return f"{word}{{{guess.name or 'index'}}}"


def _remarks(guess: _Guess) -> tuple[str, ...]:
    sizeless = () if guess.polygon is not None or guess.size else _SIZELESS
    others = (f"other lists that look like objects: {', '.join(guess.others[:6])}",) if guess.others else ()
    return sizeless + others


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
        parent = _frame_of(each) or ("parent_frame_id" in known and get_field(each, "parent_frame_id"))
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
    elif each.numbers:
        prefix, numbers = name_from_topic(each.topic.name), each.numbers[:_MOST_SIGNALS]
        signals = ", ".join(f"{prefix}_{_text(path.replace('.', '_'))}: {path}" for path in numbers)
        yield f"  # {topic}: {{signals: {{{signals}}}}}    # {_described(each.topic)}"
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


@dataclass(frozen=True, slots=True)
class _Guess:
    """Fields of a message that look like those of an object; texts are field paths.

    Attributes:
        objects: of the list of objects, or None for a single one.
        position: of a point, or of x and y.
        size: of length, width and maybe height; or of a radius.
        others: of further lists whose elements look like objects.
    """

    objects: str | None = None
    position: str | tuple[str, ...] | None = None
    orientation: str | None = None
    yaw: str | None = None
    polygon: str | None = None
    size: tuple[str, ...] = ()
    name: str | None = None
    class_name: str | None = None
    others: tuple[str, ...] = ()

    @property
    def score(self) -> int:
        """How many fields of an object there are; a place counts most."""
        parts = (self.polygon, self.size, self.name, self.orientation or self.yaw, self.class_name)
        return 10 * (self.polygon is not None or self.position is not None) + sum(map(bool, parts))


def _guess(message: object) -> _Guess | None:
    """Find an object, or a list of them, in a message; None if nothing looks like one."""
    itself = _object_in(message)
    lists = sorted(
        ((guess, path) for path, guess in _iter_lists(message)),
        key=lambda each: (-_list_rank(each[1]), -each[0].score),
    )
    if lists and (itself is None or itself.polygon is None):
        best, path = lists[0]
        return replace(best, objects=path, others=tuple(other for _, other in lists[1:]))
    return itself


def _numbers_in(message: object) -> tuple[str, ...]:
    """Return the paths of the numbers in a message, except those in lists and in the header."""
    fields = _iter_fields(message, skipped=frozenset({"header", "stamp"}))
    return tuple(path for path, value in fields if _is_number(value))


def _frame_of(message: object) -> str | None:
    """Return the frame of a message's coordinates, if the message names it."""
    for path, value in _iter_fields(message, skipped=frozenset()):
        if path.split(".")[-1] == "frame_id" and isinstance(value, str) and value:
            return value.removeprefix("/")
    return None


def _iter_lists(message: object) -> Iterator[tuple[str, _Guess]]:
    for path, value in _iter_fields(message):
        if is_list(value) and len(value) and field_names(value[0]):
            guess = _object_in(value[0])
            # the corners of an outline are points, not objects
            if guess is not None and not (path.split(".")[-1] in _OUTLINES and guess.score <= 10):
                yield f"{path}[*]", guess


def _object_in(value: object) -> _Guess | None:
    """Find the fields of one object in a message or an element of a list."""
    fields = dict(_iter_fields(value))
    polygon = next((path for path in _named(fields, _OUTLINES) if _is_outline(fields[path])), None)
    position = _position_in(fields)
    if polygon is None and position is None:
        return None
    yaw = _first(fields, _YAWS, _is_number) if polygon is None else None
    turn = next((path for path in _named(fields, _TURNS) if _has(fields[path], "xyzw")), None)
    return _Guess(
        position=position if polygon is None else None,
        orientation=turn if polygon is None else None,
        yaw=None if turn else yaw,
        polygon=polygon,
        size=_size_in(fields) if polygon is None else (),
        name=_name_in(fields),
        class_name=_first(fields, _CLASSES, lambda each: isinstance(each, str)),
    )


def _position_in(fields: dict[str, object]) -> str | tuple[str, ...] | None:
    for path in _named(fields, _POSITIONS):
        if _has(fields[path], "xy"):
            return path
    if _is_number(fields.get("x")) and _is_number(fields.get("y")) and not _is_number(fields.get("w")):
        return ("x", "y")
    return None


def _size_in(fields: dict[str, object]) -> tuple[str, ...]:
    for path in _named(fields, _SIZES):
        for names in (("length", "width", "height"), ("x", "y", "z"), ("size_x", "size_y", "size_z")):
            known = field_names(fields[path])
            if all(name in known and _is_number(get_field(fields[path], name)) for name in names[:2]):
                return tuple(f"{path}.{name}" for name in names if name in known)
    for names in (("length", "width", "height"), ("size_x", "size_y", "size_z")):
        if all(_is_number(fields.get(name)) for name in names[:2]):
            return tuple(name for name in names if name in fields)
    return ("radius",) if _is_number(fields.get("radius")) else ()


def _name_in(fields: dict[str, object]) -> str | None:
    for path in _named(fields, _NAMES):
        value = fields[path]
        if isinstance(value, str | int) and not isinstance(value, bool):
            return path
        if "value" in field_names(value):
            return f"{path}.value"
    return None


def _named(fields: dict[str, object], names: tuple[str, ...]) -> list[str]:
    """Return the paths that end in one of some names, by depth, then in the order of the names."""
    paths = [path for path in fields if path.split(".")[-1].lower() in names]
    return sorted(paths, key=lambda path: (path.count("."), names.index(path.split(".")[-1].lower())))


def _first(fields: dict[str, object], names: tuple[str, ...], fits: Callable[[object], bool]) -> str | None:
    return next((path for path in _named(fields, names) if fits(fields[path])), None)


def _iter_fields(
    value: object, path: str = "", depth: int = 0, *, skipped: frozenset[str] = _NOT_PLACES
) -> Iterator[tuple[str, object]]:
    """Iterate over the fields of a message and its parts, with their paths; lists are not entered."""
    for name in field_names(value) if depth < _DEEPEST else ():
        inner = get_field(value, name)
        full = f"{path}.{name}" if path else name
        if name not in skipped:
            yield full, inner
            yield from _iter_fields(inner, full, depth + 1, skipped=skipped)


def _list_rank(path: str) -> int:
    """Return how well the name of a list suits objects that move."""
    last = path.removesuffix("[*]").split(".")[-1].lower()
    return 2 * ("moving" in last or "dynamic" in last) + bool(_LISTS.search(last))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _has(value: object, names: str) -> bool:
    """Return whether a message has numbers as fields with these names of one letter."""
    known = field_names(value)
    return all(name in known and _is_number(get_field(value, name)) for name in names)


def _is_outline(value: object) -> bool:
    if not is_list(value):
        return "points" in field_names(value) and _is_outline(get_field(value, "points"))
    return len(value) >= 3 and _has(value[0], "xy")

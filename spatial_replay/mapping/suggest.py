"""Suggest a mapping file: the topics of a log and example messages in, YAML with comments out.

The entry of a built-in type needs no fields. In messages of other types, `object_fields` finds them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

from spatial_replay.bags.decoders import Topic
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.messages import Channel
from spatial_replay.logs.topics import has_our_type
from spatial_replay.mapping.binding import BY_PLACE, Codes, Namer
from spatial_replay.mapping.field_paths import (
    INDEX,
    FieldError,
    FieldPath,
    NameTemplate,
    field_names,
    get_field,
    iter_elements,
    leads_somewhere,
    name_from_topic,
    walk,
)
from spatial_replay.mapping.mapping_file import NO_TOPIC, TopicMapping
from spatial_replay.mapping.message_types import (
    BUILT_IN,
    TRANSFORM_TYPES,
    MessageLayout,
    geodetic_paths,
    layout_of_topic,
    short_type,
)
from spatial_replay.mapping.object_fields import (
    Guess,
    frame_of,
    guess_objects,
    share_places,
    signals_in,
    takes_turns,
)
from spatial_replay.mapping.reading_plan import doubts_of
from spatial_replay.mapping.trial import (
    FROM_NORTH,
    choose_entry,
    flow_text,
    lateness_s,
    readable_messages,
    yaml_text,
)
from spatial_replay.mapping.yaml_document import LARGEST_TEXT
from spatial_replay.text import plural
from spatial_replay.trace.trace import FOREVER

EXAMPLES = 20
"""Number of first messages of each topic to decode; later messages are decoded more and more rarely."""

_RADIUS = "0.5"
_TOGETHER_NS = 10**9
_ONE_CLOCK_S, _EXACT_S = 5.0, 0.05
"""Limits, seconds: difference of median delays on one clock, and difference of delays that is ignored."""
_NO_TIMES: Mapping[str, Sequence[int]] = MappingProxyType({})
_MOST_SIGNALS = 12
_MOST_LISTS = 6
_TEXTS = frozenset({"name", "label"})
_MIDDLEWARE = frozenset({"rosout", "rosout_agg", "parameter_events", "clock", "diagnostics"})
"""Last words of the topics of programs, which have no objects."""
_SENSORS = re.compile("camera|optical|lidar|laser|velodyne|radar|imu|gps|gnss|sensor", re.IGNORECASE)
"""Names of sensor frames, which are mounted on objects."""
# PX4 publishes in the frame north, east, down (https://docs.px4.io/main/en/ros2/user_guide.html)
_NORTH_EAST_DOWN = re.compile(
    r"(?<![a-z0-9])(px4|ned|fmu|vehicle_local_position|vehicle_odometry)(?![a-z0-9])", re.IGNORECASE
)
"""Names of topics, types and frames with x north, y east and z down."""
_MAVROS = re.compile(r"(?<![a-z0-9])mavros(?![a-z0-9])", re.IGNORECASE)

_LARGEST_SUGGESTION = LARGEST_TEXT // 2
"""Size limit of a suggestion, bytes: half the limit of mappings, so that a user can add entries."""
_LONGEST_KEY = 500
"""Length limit of a topic name as a key; YAML allows 1,024 characters in a key."""

_Axes: TypeAlias = Literal["plane", "north", "image"]
_AXES: Mapping[_Axes, str] = MappingProxyType({"plane": "", "north": "x north, y east", "image": "in pixels"})
"""Kinds of axes, in words. A scene has one kind; the suggestion uses the first kind that the log has."""


@dataclass(frozen=True, slots=True)
class TopicSuggestion:
    """A suggestion for one topic.

    Attributes:
        fields: entry of a mapping, as values in YAML's flow style by key; None if no field looks like an
            object.
        name: template of object names, from the entry or by default.
        remarks: notes for the user, which become comments.
        is_transforms: whether messages are transforms, which are objects only in a log without other objects.
        frames: frames of coordinates, according to the entry.
        axes: kind of axes of coordinates.
        numbers: paths of possible signals.
        aside: reason why the entry is not used; "" if it is used.
        layout: layout of the entry; None without an entry.
        lateness_s: (N,) time from each message's stamp to its recording; None if stamps are not a clock.
        path: path of the list of objects.
        further: suggestions for further lists of objects in the messages.
    """

    topic: Topic
    fields: Mapping[str, str] | None = None
    name: str = ""
    remarks: tuple[str, ...] = ()
    is_transforms: bool = False
    frames: frozenset[str] = frozenset()
    axes: _Axes = "plane"
    numbers: tuple[str, ...] = ()
    aside: str = ""
    layout: MessageLayout | None = None
    lateness_s: Floats | None = None
    path: str = ""
    further: tuple[TopicSuggestion, ...] = ()

    @property
    def entry(self) -> str:
        """Entry in YAML's flow style; "" if no field looks like an object."""
        entries = ", ".join(self.entries)
        return f"[{entries}]" if self.further else entries

    @property
    def entries(self) -> tuple[str, ...]:
        """Entry of each list of objects; () if no field looks like an object."""
        suggestions = (self, *self.further)
        return tuple(flow_text(part.fields) for part in suggestions if part.fields is not None)

    @property
    def signals(self) -> str:
        """Entry with all `numbers` as signals; "" without numbers."""
        prefix = _topic_words(self.topic.name)
        path_by_name = {f"{prefix}_{_signal_name(path)}": path for path in self.numbers[:_MOST_SIGNALS]}
        signals = flow_text({yaml_text(name): yaml_text(path) for name, path in path_by_name.items()})
        return f"{{signals: {signals}}}" if path_by_name else ""


def suggest_topics(
    topics: Sequence[Topic],
    examples: Mapping[str, Sequence[object]],
    times_ns: Mapping[str, Sequence[int]] = _NO_TIMES,
) -> tuple[TopicSuggestion, ...]:
    """Suggest an entry for each topic.

    Args:
        examples: some decoded messages of each topic, by name.
        times_ns: log times of the example messages, by topic; by default, one second apart.
    """
    suggestions = []
    for topic in topics:
        messages = examples.get(topic.name, ())
        log_times_ns = times_ns.get(topic.name) or [second * 10**9 for second in range(len(messages))]
        list_suggestions = [
            _with_trial(entry, messages, log_times_ns) for entry in _suggestions(topic, messages)
        ]
        suggestions.append(_join_lists(list_suggestions))
    return tuple(suggestions)


def suggest_mapping(
    log: str,
    topics: Sequence[Topic],
    examples: Mapping[str, Sequence[object]],
    times_ns: Mapping[str, Sequence[int]] = _NO_TIMES,
) -> str:
    """Return the text of a mapping file, with comments.

    The text is a valid mapping if a topic has objects or signals.

    Args:
        log: name of the log.
        examples: some decoded messages of each topic, by name.
        times_ns: log times of the example messages, by topic.
    """
    suggestions = suggest_topics(topics, examples, times_ns)
    first_ns = {name: times[0] for name, times in times_ns.items() if times}
    usable_suggestions = [
        suggestion
        for suggestion in suggestions
        if len(yaml_text(suggestion.topic.name)) <= _LONGEST_KEY and not suggestion.aside
    ]
    mapped_suggestions = [
        suggestion for suggestion in usable_suggestions if suggestion.entry and not suggestion.is_transforms
    ]
    axes: _Axes = next(
        (axes for axes in _AXES if any(suggestion.axes == axes for suggestion in mapped_suggestions)), "plane"
    )
    mapped_suggestions = [suggestion for suggestion in mapped_suggestions if suggestion.axes == axes]
    mapped_suggestions = mapped_suggestions or [
        suggestion for suggestion in usable_suggestions if suggestion.entry and suggestion.is_transforms
    ]
    transform_topics = [suggestion.topic.name for suggestion in suggestions if suggestion.is_transforms]
    frame_lines, reason_by_topic = _choose_frame(
        mapped_suggestions, [message for name in transform_topics for message in examples.get(name, ())]
    )
    active_suggestions = _with_distinct_names(
        [suggestion for suggestion in mapped_suggestions if suggestion.topic.name not in reason_by_topic]
    )
    if any(suggestion.frames for suggestion in active_suggestions):
        active_suggestions = [
            _with_frame_remark(suggestion) if examples.get(suggestion.topic.name) else suggestion
            for suggestion in active_suggestions
        ]
    signals = (
        [] if active_suggestions else [suggestion for suggestion in usable_suggestions if suggestion.signals]
    )
    lines = [f"# How messages of {_comment(log)} become objects: a start, made from the first of them."]
    if not active_suggestions:
        has_refused = any(suggestion.aside for suggestion in suggestions)
        lines.append(
            "# Nothing can be read as an object; the reasons are below."
            if has_refused
            else f"# Nothing looks like an object{': these are signals' if signals else ''}."
        )
    lines += [
        *frame_lines,
        *_axes_lines(axes if active_suggestions else "plane"),
        *_origin_lines(active_suggestions, examples),
        *(f"# {_comment(doubt)}" for doubt in doubts_of(topics)),
        *_time_lines(active_suggestions or signals, first_ns),
        "topics:",
    ]
    if not active_suggestions and not signals:
        lines.append(f"  # {NO_TOPIC}, such as")
        lines.append("  # /robot/state: {name: robot, position: [x, y], yaw: theta, shape: {disc: 0.5}}")
    entries = {
        suggestion.topic.name: "\n".join(_entry_lines(suggestion))
        for suggestion in active_suggestions or signals
    }
    entries_that_fit = _first_that_fit(list(entries.items()), _LARGEST_SUGGESTION - len("\n".join(lines)))
    unused_suggestions = [
        suggestion for suggestion in suggestions if suggestion.topic.name not in dict(entries_that_fit)
    ]
    unused_suggestions = [
        replace(unused, aside=reason_by_topic.get(unused.topic.name, unused.aside))
        for unused in unused_suggestions
    ]
    unused_lines = {
        suggestion.topic.name: _unused_line(suggestion, axes) for suggestion in unused_suggestions
    }
    remaining_bytes = _LARGEST_SUGGESTION - len("\n".join([*lines, *dict(entries_that_fit).values()]))
    unused_that_fit = _first_that_fit(list(unused_lines.items()), remaining_bytes)
    lines += dict(entries_that_fit).values()
    if unused_that_fit:
        lines += ["", "  # not used:", *dict(unused_that_fit).values()]
    if len(unused_that_fit) < len(unused_lines):
        lines.append(f"  # … and {plural(len(unused_lines) - len(unused_that_fit), 'topic')} more")
    return "\n".join(lines) + "\n"


def _entry_lines(suggestion: TopicSuggestion) -> Iterator[str]:
    yield from (f"  # {text}" for text in (_description(suggestion.topic), *suggestion.remarks))
    topic = yaml_text(suggestion.topic.name)
    if suggestion.further:
        yield f"  {topic}:"
        yield from (f"    - {entry}" for entry in suggestion.entries)
    else:
        yield f"  {topic}: {suggestion.entry or suggestion.signals}"


def _first_that_fit(named_texts: Sequence[tuple[str, str]], byte_limit: int) -> list[tuple[str, str]]:
    """Return the first (name, text) pairs whose texts fit into `byte_limit` bytes."""
    texts_that_fit: list[tuple[str, str]] = []
    for name, text in named_texts:
        byte_limit -= len(text.encode()) + 1
        if byte_limit < 0:
            break
        texts_that_fit.append((name, text))
    return texts_that_fit


def _with_distinct_names(suggestions: Sequence[TopicSuggestion]) -> list[TopicSuggestion]:
    """Return suggestions with the topic as a prefix of names that several topics share."""
    lists_by_topic = {suggestion.topic.name: (suggestion, *suggestion.further) for suggestion in suggestions}
    name_counts = Counter(
        list_suggestion.name
        for list_suggestions in lists_by_topic.values()
        for list_suggestion in list_suggestions
    )
    return [
        _with_prefix(suggestion, _topic_words(suggestion.topic.name))
        if any(
            name_counts[list_suggestion.name] > 1 for list_suggestion in lists_by_topic[suggestion.topic.name]
        )
        else suggestion
        for suggestion in suggestions
    ]


def _with_frame_remark(suggestion: TopicSuggestion) -> TopicSuggestion:
    return suggestion if suggestion.frames else replace(suggestion, remarks=(*suggestion.remarks, _FRAMELESS))


def _with_prefix(suggestion: TopicSuggestion, prefix: str) -> TopicSuggestion:
    name = f"{prefix}_{suggestion.name}" if "{" in suggestion.name else prefix
    fields = {**(suggestion.fields or {}), "name": yaml_text(name)}
    # `objects` comes first, then `name`, as in handwritten mappings
    ordered_fields = sorted(fields.items(), key=lambda field: {"objects": 0, "name": 1}.get(field[0], 2))
    further = tuple(_with_prefix(part, prefix) for part in suggestion.further)
    return replace(suggestion, fields=dict(ordered_fields), name=name, further=further)


def _with_trial(
    suggestion: TopicSuggestion, examples: Sequence[object], times_ns: Sequence[int]
) -> TopicSuggestion:
    """Return a suggestion after a trial on messages, with the reason in `aside` if no message can be read."""
    topic, layout = suggestion.topic, suggestion.layout
    entry = suggestion.entry or suggestion.signals
    if not entry or not examples or suggestion.is_transforms:
        return suggestion
    origin = ""
    if layout is not None and (layout.is_geojson or geodetic_paths(layout) is not None):
        first_fix = _first_fix(layout, examples)
        if first_fix is None:
            return replace(
                suggestion, aside="no message looked at has a fix in degrees, to count metres from"
            )
        origin = f"origin: [{first_fix[0]!r}, {first_fix[1]!r}]\n"
    try:
        readable_examples, reasons = readable_messages(topic, entry, examples, origin)
    except UsageError as error:
        return replace(suggestion, aside=_comment(str(error).partition(f"{topic.name}: ")[2] or str(error)))
    if reasons:
        first_reason = f"cannot be read: {_comment(reasons[0])}"
        remark = f"{len(reasons)} of {len(examples)} messages looked at {first_reason}"
        frames = suggestion.frames if layout is None else frozenset(_iter_frames(layout, readable_examples))
        suggestion = replace(suggestion, remarks=(*suggestion.remarks, remark), frames=frames)
    if suggestion.fields is None:
        return suggestion
    fields, remarks = choose_entry(topic, suggestion.fields, examples, times_ns, origin)
    return replace(
        suggestion,
        fields=fields,
        remarks=(*suggestion.remarks, *map(_comment, remarks)),
        lateness_s=lateness_s(topic, flow_text(fields), examples, times_ns, origin),
    )


def _origin_lines(
    active: Sequence[TopicSuggestion], examples: Mapping[str, Sequence[object]]
) -> Iterator[str]:
    """Yield the lines of the key `origin`, with the first fix."""
    for suggestion in active:
        layout = suggestion.layout
        first_fix = None if layout is None else _first_fix(layout, examples.get(suggestion.topic.name, ()))
        if first_fix is not None:
            yield "# where (0, 0) is, here at the first fix; x is in metres east of it, y north"
            yield f"origin: [{first_fix[0]!r}, {first_fix[1]!r}]"
            return


def _first_fix(layout: MessageLayout, examples: Sequence[object]) -> tuple[float, float] | None:
    """Return latitude and longitude of the first fix, in degrees; None without a fix."""
    paths = geodetic_paths(layout)
    if layout.is_geojson:
        return next(filter(None, map(_first_corner, examples)), None)
    if paths is None:
        return None
    positions = (_place_of_fix(fix, paths) for _, fix in _iter_objects(layout, examples))
    return next((position for position in positions if position is not None), None)


def _first_corner(message: object) -> tuple[float, float] | None:
    """Return latitude and longitude of the first position in a GeoJSON message; None without a position."""
    try:
        geojson_text = str(walk(FieldPath.of("geojson"), message))
    except FieldError:
        return None
    # longitude comes before latitude (RFC 7946, section 3.1.1)
    coordinates_match = re.search(r'"coordinates":[\s[]*(-?[\d.]+)\s*,\s*(-?[\d.]+)', geojson_text)
    return None if coordinates_match is None else (float(coordinates_match[2]), float(coordinates_match[1]))


def _place_of_fix(fix: object, paths: Sequence[str]) -> tuple[float, float] | None:
    """Return latitude and longitude in degrees; None without a fix, or if both are 0."""
    status = FieldPath.of("status.status")
    try:
        latitude, longitude = (float(walk(FieldPath.of(path), fix)) for path in paths)  # type: ignore[arg-type]
        is_fix = not leads_somewhere(status, fix) or float(walk(status, fix)) >= 0  # type: ignore[arg-type]
    except (FieldError, TypeError, ValueError):
        return None
    if 90 < abs(latitude) <= 90e7 and abs(longitude) <= 360e7:
        # MAVLink sends integers, degrees * 10^7
        latitude, longitude = round(latitude * 1e-7, 7), round(longitude * 1e-7, 7)
    is_place = abs(latitude) <= 90 and abs(longitude) <= 360 and (latitude, longitude) != (0.0, 0.0)
    return (latitude, longitude) if is_fix and is_place else None


def _axes_lines(axes: _Axes) -> Iterator[str]:
    if axes == "image":
        yield "# rows of pixels are counted downwards; samples have y up, so that above means above"
        yield "axes: {y: down}"
    elif axes == "north":
        yield "# x is north, y east, z down (NED); with y down, pictures are not mirrored, and north is right"
        yield "axes: {y: down}"


def _suggestions(topic: Topic, examples: Sequence[object]) -> list[TopicSuggestion]:
    """Return one suggestion per list of objects in a topic's messages, and at least one suggestion."""
    is_ours = has_our_type(Channel(topic.name, topic.encoding, topic.schema))
    if is_ours or topic.name.rstrip("/").split("/")[-1] in _MIDDLEWARE:
        return [TopicSuggestion(topic)]
    type_name = short_type(topic.type)
    if topic.unreadable is not None:
        return [TopicSuggestion(topic, remarks=(f"cannot be read: {_comment(topic.unreadable)}",))]
    if type_name in TRANSFORM_TYPES:
        return [_of_transforms(topic, examples)]
    if type_name in BUILT_IN:
        return [_of_known_type(topic, BUILT_IN[type_name], examples)]
    guess = guess_objects(topic.name, topic.type, examples)
    if guess is None:
        return [TopicSuggestion(topic, numbers=signals_in(examples[0]) if examples else ())]
    body_guesses = [body for body in guess.others if body.is_body and not share_places(guess, body, examples)]
    other_guesses = tuple(other_guess for other_guess in guess.others if other_guess not in body_guesses)
    guesses = [replace(guess, others=other_guesses), *body_guesses]
    return [_of_guess(topic, guess, examples) for guess in guesses[:_MOST_LISTS]]


def _of_known_type(topic: Topic, reading: MessageLayout, examples: Sequence[object]) -> TopicSuggestion:
    has_outline = bool(reading.polygon or reading.sizes or reading.solids)
    name = reading.name.replace("{topic}", name_from_topic(topic.name))
    fields: Mapping[str, str] = {} if has_outline else _POINT
    if reading.name == "{topic}" and takes_turns(_children(examples)):
        # several child frames on one topic, such as the odometry of several robots
        name = "{child_frame_id}"
        fields = {"name": yaml_text(name), **fields}
    remarks = () if has_outline else _SIZELESS
    if _is_by_place(topic, reading, examples):
        remarks = (*remarks, BY_PLACE)
    return _with_frames(topic, reading, examples, fields, name, remarks)


def _of_guess(topic: Topic, guess: Guess, examples: Sequence[object]) -> TopicSuggestion:
    name = _name(topic, guess)
    entry = TopicMapping(topic.name, objects=guess.objects, position=guess.position)
    layout = layout_of_topic(topic.type, entry)
    suggestion = _with_frames(topic, layout, examples, _fields(name, guess), name, _remarks(guess))
    aside = _OF_PLANS if guess.is_plan else ""
    axes = "image" if guess.is_in_pixels else suggestion.axes
    return replace(suggestion, axes=axes, aside=aside, path=guess.objects or "")


def _join_lists(suggestions: Sequence[TopicSuggestion]) -> TopicSuggestion:
    first_suggestion, *other_suggestions = suggestions
    further_suggestions = [
        suggestion
        for suggestion in other_suggestions
        if not suggestion.aside and suggestion.axes == first_suggestion.axes and suggestion.fields is not None
    ]
    if first_suggestion.aside or not further_suggestions:
        return first_suggestion
    name_counts = Counter(suggestion.name for suggestion in (first_suggestion, *further_suggestions))
    further_suggestions = [
        _with_prefix(suggestion, _topic_words(suggestion.path.rpartition(".")[0].replace(".", "/")))
        if name_counts[suggestion.name] > 1
        else suggestion
        for suggestion in further_suggestions
    ]
    return replace(
        first_suggestion,
        further=tuple(further_suggestions),
        remarks=(
            *first_suggestion.remarks,
            *(remark for suggestion in further_suggestions for remark in suggestion.remarks),
        ),
        frames=first_suggestion.frames.union(*(suggestion.frames for suggestion in further_suggestions)),
    )


def _with_frames(
    topic: Topic,
    layout: MessageLayout,
    examples: Sequence[object],
    fields: Mapping[str, str],
    name: str,
    remarks: tuple[str, ...],
) -> TopicSuggestion:
    """Return a suggestion with frames, axes, and `max_age` where needed."""
    frames = frozenset(_iter_frames(layout, examples))
    fields = {**fields, "max_age": "forever"} if layout.stays or topic.latched else fields
    axes: _Axes = "plane"
    if short_type(topic.type) in _IN_IMAGES:
        axes = "image"
    elif any(map(_NORTH_EAST_DOWN.search, (topic.name, topic.type, *frames))):
        axes = "north"
    elif any(map(_MAVROS.search, (topic.name, topic.type))):
        remarks = (*remarks, _OF_MAVROS)
    return TopicSuggestion(topic, fields, name, remarks, frames=frames, axes=axes, layout=layout)


def _children(messages: Sequence[object]) -> list[str]:
    """Return the `child_frame_id` of each message that has this field."""
    return [
        str(get_field(message, "child_frame_id"))
        for message in messages
        if "child_frame_id" in field_names(message)
    ]


def _is_by_place(topic: Topic, layout: MessageLayout, examples: Sequence[object]) -> bool:
    """Return whether some objects are named by their index in a list."""
    if f"{INDEX}}}" not in layout.name:
        return False
    namer = Namer(NameTemplate.of(layout.name), topic.name, Codes(), (), ())
    for message in examples:
        elements = [element for _, element in _iter_objects(layout, [message])]
        with suppress(FieldError):
            namer.codes(elements, range(len(elements)))
    return namer.is_by_place


def _iter_frames(layout: MessageLayout, examples: Sequence[object]) -> Iterator[str]:
    """Yield the frame of each object, at the layout's path; objects without a frame are skipped."""
    alternatives = [FieldPath.of(path) for path in layout.frame]
    for message, element in _iter_objects(layout, examples):
        roots = [(path, message if path.from_message else element) for path in alternatives]
        frame = next((walk(path, root) for path, root in roots if leads_somewhere(path, root)), None)
        if isinstance(frame, str) and frame:
            yield frame.removeprefix("/")


def _iter_objects(layout: MessageLayout, examples: Sequence[object]) -> Iterator[tuple[object, object]]:
    """Yield (message, object) for each object in the messages."""
    path = FieldPath.of(layout.objects) if layout.objects else None
    for message in examples:
        try:
            yield from (
                (message, element) for element in (iter_elements(path, message) if path else (message,))
            )
        except FieldError:
            continue


def _of_transforms(topic: Topic, examples: Sequence[object]) -> TopicSuggestion:
    """Suggest child frames of transforms as objects, except frames of sensors."""
    if topic.latched or topic.name.rsplit("/", 1)[-1] == "tf_static":
        remark = "static transforms place frames, such as those of sensors; they are no objects"
        return TopicSuggestion(topic, remarks=(remark,), is_transforms=True)
    child_frames = {child for message in examples for _, child in _edges(message)}
    sensor_frames = sorted(child for child in child_frames if _SENSORS.search(child))
    exclusions = (
        {"except": f"[{', '.join(map(yaml_text, sensor_frames))}]"}
        if sensor_frames and len(sensor_frames) < len(child_frames)
        else {}
    )
    frames = frozenset(parent for message in examples for parent, _ in _edges(message))
    return TopicSuggestion(
        topic, {**exclusions, **_POINT}, "{child_frame_id}", _SIZELESS, is_transforms=True, frames=frames
    )


_IN_IMAGES = frozenset({"vision_msgs/Detection2DArray", "apriltag_msgs/AprilTagDetectionArray"})
"""Types whose coordinates are pixels."""

_SIZELESS = (f"messages have no size: {_RADIUS} is a guess, {{box: [length, width]}} is another shape",)


_FRAMELESS = "its messages name no frame: they are taken to be in that of the others, or give them a `frame`"
_OF_MAVROS = (
    "MAVROS turns local positions to x east, y north, z up; raw MAVLink messages are north, east, down: for"
    " these, axes: {y: down}"
)
_FORM_OF_BOUNDS = (
    "{0} fits as two corners in each box looked at; {{field: {0}, form: xywh}} reads a corner and a size",
    "{0} has a corner and a size: as two corners, some boxes would end left of or below their beginning",
)
_OF_PLANS = "places to go to, as of a plan, are no objects"
_POINT = MappingProxyType({"shape": f"{{disc: {_RADIUS}}}"})


def _fields(name: str, guess: Guess) -> dict[str, str]:
    key_values: list[tuple[str, str | tuple[str, ...] | None]] = [
        ("objects", guess.objects),
        ("name", name),
        ("class", guess.class_name),
        ("position", guess.position),
        ("orientation", guess.orientation),
        ("order", "xyzw" if guess.has_order else None),
        ("yaw", guess.yaw),
        ("polygon", None if guess.is_own else guess.polygon),
        ("bounds", guess.bounds),
    ]
    fields = {key: _value(key, value) for key, value in key_values if value is not None}
    if guess.bounds_have_size:
        fields["bounds"] = f"{{field: {fields['bounds']}, form: xywh}}"
    if guess.has_compass:
        fields["yaw"] = f"{{field: {fields['yaw']}, {FROM_NORTH}}}"
    if guess.has_zeros_left_out:
        fields["missing"] = "0"
    return fields if {"polygon", "bounds"} & fields.keys() else {**fields, "shape": _shape(guess)}


def _topic_words(topic: str) -> str:
    return "_".join(word for word in topic.split("/") if word) or "object"


def _signal_name(path: str) -> str:
    """Return a name for a path: `position[name=elbow]` → elbow_position."""
    list_path, _, element_name = path.removesuffix("]").partition("[name=")
    return re.sub(r"\W", "_", f"{element_name}_{list_path}" if element_name else path, flags=re.ASCII)


def _value(key: str, value: str | tuple[str, ...]) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(yaml_text, value))}]"
    return f"{{field: {yaml_text(value)}}}" if key == "class" else yaml_text(value)


def _shape(guess: Guess) -> str:
    if guess.polygon is not None:
        return f"{{polygon: {yaml_text(guess.polygon)}}}"
    if not guess.size:
        return f"{{disc: {_RADIUS}}}"
    size_text = ", ".join(map(yaml_text, guess.size))
    return f"{{disc: {size_text}}}" if len(guess.size) == 1 else f"{{box: [{size_text}]}}"


def _name(topic: Topic, guess: Guess) -> str:
    if guess.objects is None and not guess.names:
        return name_from_topic(topic.name)
    path = guess.names[0] if guess.names else INDEX
    if guess.names and (path == INDEX or path.startswith("$.") or path.split(".")[-1] in _TEXTS):
        # the value is a name; only a number needs a word in front
        return f"{{{path}}}"
    word = name_from_topic(topic.name) if guess.objects is None else guess.objects.removesuffix("[*]")
    return f"{re.sub('(?<=x)es$|s$', '', word.split('.')[-1]) or 'object'}{{{path}}}"


def _remarks(guess: Guess) -> tuple[str, ...]:
    object_remarks: tuple[str, ...] = ()
    if guess.objects is None and guess.names:
        object_remarks = (f"one object a message: {guess.names[0]} takes turns",)
    size_remarks = () if guess.polygon or guess.bounds or guess.size else _SIZELESS
    if guess.size[:1] and guess.size[0].endswith("[0]"):
        size_remarks = (f"{guess.size[0][:-3]} is read as length, width and height, in this order",)
    if guess.is_sizeless:
        size_remarks = (f"its sizes are 0 in all messages looked at: {_RADIUS} is a guess",)
    paths = [str(unused.objects) for unused in guess.others[:6]]
    list_remarks = (f"other lists that look like objects: {', '.join(paths)}",) if paths else ()
    if isinstance(guess.bounds, str) and "xy" not in guess.bounds:
        size_remarks = (_FORM_OF_BOUNDS[guess.bounds_have_size].format(guess.bounds),)
    index_remarks = (BY_PLACE,) if guess.objects is not None and not guess.names else ()
    if guess.other_outline is not None:
        shape_text = f"shape: {{polygon: {guess.other_outline}}}"
        object_remarks = (
            *object_remarks,
            f"objects whose size is 0 have corners; `{shape_text}` reads these, and not the boxes",
        )
    if guess.plane is not None:
        floors_remark = f"{guess.plane} names floors or maps; objects on all of them are in one plane here"
        floor_remark = f"frame: {{field: {guess.plane}}} with `fixed_frame: FLOOR` evaluates one of them"
        object_remarks = (*object_remarks, floors_remark, floor_remark)
    if guess.has_compass:
        object_remarks = (
            *object_remarks,
            f"{guess.yaw} beside latitude and longitude counts from north, clockwise",
        )
    return object_remarks + size_remarks + index_remarks + list_remarks


def _choose_frame(
    suggestions: Sequence[TopicSuggestion], transforms: Sequence[object]
) -> tuple[list[str], dict[str, str]]:
    """Choose the fixed frame: the frame in which most topics can be placed.

    Args:
        transforms: messages with transforms.

    Returns:
        Lines of the mapping, and reasons why topics cannot be placed, by topic.
    """
    frames = sorted(frozenset().union(*(suggestion.frames for suggestion in suggestions)))
    edges = sorted({edge for message in transforms for edge in _edges(message)})
    roots = sorted({parent for parent, _ in edges} - {child for _, child in edges})
    if len(frames) < 2:
        fixed_frame = yaml_text((roots or frames or ["map"])[0])
        mapping_lines = [
            "# without a fixed frame, coordinates are taken as they are",
            f"# fixed_frame: {fixed_frame}",
        ]
        return (mapping_lines if edges else []), {}
    frames_by_root = {root: _below(root, edges).intersection(frames) for root in (*roots, *frames)}

    def rank(root: str) -> tuple[int, int]:
        topics = [suggestion.topic for suggestion in suggestions if frames_by_root[root] & suggestion.frames]
        return len(topics), sum(topic.count or 0 for topic in topics)

    fixed_frame = max(frames_by_root, key=rank)
    other_frames = sorted(set(frames) - frames_by_root[fixed_frame])
    reason_by_topic = {
        suggestion.topic.name: (
            f"in {_comment(', '.join(sorted(suggestion.frames)))}, apart from {fixed_frame}"
        )
        for suggestion in suggestions
        if suggestion.frames and not frames_by_root[fixed_frame] & suggestion.frames
    }
    mapping_lines = [f"# coordinates are in the frames {_comment(', '.join(frames))}"]
    if other_frames:
        mapping_lines.append(
            f"# no transforms join {_comment(', '.join(other_frames))} with {fixed_frame}: what is in these"
            " is unknown or left out; `frame` of a topic overrides its frame"
        )
    return [*mapping_lines, f"fixed_frame: {yaml_text(fixed_frame)}"], reason_by_topic


def _below(root: str, edges: Sequence[tuple[str, str]]) -> set[str]:
    """Return a frame and all its descendants in the tree of transforms."""
    frames_below = {root}
    while new_frames := {child for parent, child in edges if parent in frames_below} - frames_below:
        frames_below |= new_frames
    return frames_below


def _edges(message: object) -> Iterator[tuple[str, str]]:
    """Iterate over the pairs (parent, child) of frames in a message with transforms."""
    transforms = getattr(message, "transforms", None)
    if isinstance(message, dict):
        transforms = message.get("transforms")
    for transform in [message] if transforms is None else transforms:
        transform_fields = field_names(transform)
        parent = frame_of(transform) or (
            "parent_frame_id" in transform_fields and get_field(transform, "parent_frame_id")
        )
        child = "child_frame_id" in transform_fields and get_field(transform, "child_frame_id")
        if isinstance(parent, str) and isinstance(child, str) and parent and child:
            yield parent.removeprefix("/"), child.removeprefix("/")


def _time_lines(active: Sequence[TopicSuggestion], first_ns: Mapping[str, int]) -> Iterator[str]:
    clock, reason = _clock(active)
    if reason:
        yield f"# {reason}"
    yield f"clock: {clock}    # log: when a message was recorded; publish: when sent; header: its own stamp"
    if active:
        topic = yaml_text(_topic_to_sample(active, first_ns).name)
        yield f"sample: {{topic: {topic}}}    # a sample at each of its messages; or {{every: 100ms}}"
        yield "max_age: 1s    # after which an object that nothing is heard of is unknown"


def _clock(active: Sequence[TopicSuggestion]) -> tuple[str, str]:
    """Return the clock, "log" or "header", and the reason for the choice.

    The clock is "header" if stamps are of one clock, and the delays from stamps to recording differ too much.
    """
    lateness_by_topic = [(suggestion.topic.name, suggestion.lateness_s) for suggestion in active]
    stampless_topics = [topic for topic, lateness in lateness_by_topic if lateness is None]
    median_by_topic = {
        topic: float(np.median(lateness)) for topic, lateness in lateness_by_topic if lateness is not None
    }
    if not median_by_topic:
        return "log", ""
    earliest_topic, latest_topic = (
        min(median_by_topic, key=median_by_topic.__getitem__),
        max(median_by_topic, key=median_by_topic.__getitem__),
    )
    apart_s = median_by_topic[latest_topic] - median_by_topic[earliest_topic]
    sentence = (
        f"stamps of {_comment(latest_topic)} are {apart_s:.3g} s later recorded than those of"
        f" {_comment(earliest_topic)}"
    )
    widest_spread = max(
        ((float(np.ptp(lateness)), topic) for topic, lateness in lateness_by_topic if lateness is not None),
        key=itemgetter(0),
    )
    if apart_s > _ONE_CLOCK_S:
        return "log", f"{sentence}, so they are of two clocks"
    if stampless_topics:
        return "log", f"{_comment(stampless_topics[0])} has no stamps that advance with its messages"
    if max(apart_s, widest_spread[0]) <= _EXACT_S:
        return (
            "log",
            f"stamps and times of recording advance together, to {max(apart_s, widest_spread[0]):.2g} s",
        )
    if apart_s >= widest_spread[0]:
        return "header", sentence
    return (
        "header",
        f"{_comment(widest_spread[1])} is recorded with a delay that varies by {widest_spread[0]:.3g} s",
    )


def _topic_to_sample(active: Sequence[TopicSuggestion], first_ns: Mapping[str, int]) -> Topic:
    """Choose the topic to sample: the topic with the latest start among frequent topics that start early.

    So all these topics have a message at the first sample.
    """
    topics = [suggestion.topic for suggestion in active]
    begin_times_ns = [first_ns.get(topic.name, FOREVER) for topic in topics]
    greatest_count = max(topic.count or 0 for topic in topics)
    # topics with at least half as many messages as the most frequent topic
    eligible_topics = [
        (begin_ns, topic)
        for begin_ns, topic in zip(begin_times_ns, topics, strict=True)
        if begin_ns <= min(begin_times_ns) + _TOGETHER_NS and 2 * (topic.count or 0) >= greatest_count
    ]
    return max(eligible_topics, key=itemgetter(0))[1] if eligible_topics else topics[0]


def _unused_line(suggestion: TopicSuggestion, axes: _Axes) -> str:
    topic, description = yaml_text(suggestion.topic.name), _description(suggestion.topic)
    reason_aside = suggestion.aside
    if suggestion.entry and suggestion.axes != axes and not suggestion.is_transforms:
        reason_aside = reason_aside or f"{_AXES[suggestion.axes]}: for a mapping of its own with y down"
    if suggestion.entry or suggestion.signals:
        reason = f"; {reason_aside}" if reason_aside else ""
        return f"  # {topic}: {suggestion.entry or suggestion.signals}    # {description}{reason}"
    return "; ".join([f"  # {topic}: {description}", *suggestion.remarks])


def _description(topic: Topic) -> str:
    kind = _comment(topic.type) or "type unknown"
    return kind if topic.count is None else f"{kind}, {plural(topic.count, 'message')}"


def _comment(text: str) -> str:
    """Return a text on one line, of at most 200 characters."""
    return " ".join("".join(character if character.isprintable() else " " for character in text).split())[
        :200
    ]

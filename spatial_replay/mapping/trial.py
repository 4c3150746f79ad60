"""Entries of a mapping on trial: an entry and some messages of its topic in, what contradicts it out.

`choose_entry` changes an entry by the keys that settle the contradictions, as long as fewer remain.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import compress
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from spatial_replay.bags.decoders import Topic
from spatial_replay.bags.reader import Message
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.mapping.assemble import Assembler
from spatial_replay.mapping.assumptions import ASSUMPTIONS
from spatial_replay.mapping.binding import Codes
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan
from spatial_replay.mapping.topic_reader import TopicReader
from spatial_replay.trace.doubts import Doubt

Fields: TypeAlias = Mapping[str, str]
"""An entry of a topic: values in YAML's flow style, by their keys."""

FROM_NORTH = "zero: north, clockwise: true"
"""Keys of the angle of a compass."""
_PLAIN = re.compile(r"/?[A-Za-z_][\w/.-]*", re.ASCII)


def yaml_text(text: str) -> str:
    """Return a text as a YAML scalar."""
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=True)


def flow_text(fields: Fields) -> str:
    """Return an entry in YAML's flow style."""
    return "{" + ", ".join(f"{key}: {value}" for key, value in fields.items()) + "}"


def readable_messages(
    topic: Topic, entry: str, messages: Sequence[object], origin: str = ""
) -> tuple[list[object], list[str]]:
    """Return the messages that an entry can read, and why it cannot read the others.

    Raises:
        UsageError: it reads none of them.
    """
    reasons: list[str] = []
    reader = _reader(topic, entry, origin, reasons)
    good = reader.read(np.arange(len(messages)), messages).good
    reader.finish()
    if not good.any():
        raise UsageError(reasons[0])
    return list(compress(messages, good)), reasons


def lateness_s(
    topic: Topic, entry: str, messages: Sequence[object], times_ns: Sequence[int], origin: str = ""
) -> Floats | None:
    """Return how much later each message was recorded than its stamp says, seconds.

    Returns:
        None if stamps are no clock: some are missing or 0, or they do not advance with the messages.
    """
    good = np.ones(len(messages), np.bool_)
    try:
        stamps_ns = _reader(topic, entry, f"{origin}clock: header\n", []).stamps(messages, times_ns, good)
    except UsageError:
        return None
    is_clock = good.all() and (stamps_ns > 0).all() and (np.diff(stamps_ns) > 0).all()
    # in another unit they advance a thousand times as fast; a simulation may be some times as fast
    advance = np.ptp(stamps_ns) / max(1, np.ptp(times_ns))
    if not is_clock or (len(messages) > 1 and not 1 / _FASTEST < advance < _FASTEST):
        return None
    return (np.asarray(times_ns) - stamps_ns) / 1e9


_FASTEST = 20
"""Seconds of stamps in one second of recording, and the reverse."""


def _reader(topic: Topic, entry: str, head: str, reasons: list[str]) -> TopicReader:
    """Return a reader of decoded messages; it adds why it cannot read some."""
    mapping = parse_mapping(f"{head}topics:\n  {yaml_text(topic.name)}: {entry}")
    (planned,) = ReadingPlan.of(mapping, [topic]).planned
    return TopicReader(
        planned,
        mapping,
        lambda topic: lambda message: message,
        Codes(),
        Codes(),
        decodes_early=False,
        report=lambda topic, time_ns, reason: reasons.append(reason),
    )


def choose_entry(
    topic: Topic, fields: Fields, messages: Sequence[object], times_ns: Sequence[int], origin: str = ""
) -> tuple[Fields, list[str]]:
    """Return an entry that fewer measurements contradict, with the reasons of each change and the rest.

    Args:
        fields: an entry that can read the messages.
        times_ns: when each of the messages was recorded.
        origin: the line of a mapping about the origin.
    """
    reasons: list[str] = []
    doubts = _doubts(topic, fields, messages, times_ns, origin)
    untried = dict(_ALTERNATIVES)
    while doubt := next((doubt for doubt in doubts if doubt.assumption in untried), None):
        trials = [
            (changed, rest)
            for changed in untried.pop(doubt.assumption)(fields)
            for rest in [_doubts(topic, changed, messages, times_ns, origin)]
            if doubt.assumption not in {contradiction.assumption for contradiction in rest}
        ]
        if not trials:
            continue
        # another contradiction may come to light, such as a number that stands for "not available"
        changed, rest = min(trials, key=lambda trial: len(trial[1]))
        if len(rest) <= len(doubts):
            keys = [f"{key}: {value}" for key, value in changed.items() if fields.get(key) != value]
            reasons.append(f"{', '.join(keys)}, since otherwise {_clause(doubt)}")
            fields, doubts = changed, rest
    return fields, [*reasons, *(_clause(doubt, with_remedy=True) for doubt in doubts)]


def _doubts(
    topic: Topic, fields: Fields, messages: Sequence[object], times_ns: Sequence[int], origin: str
) -> tuple[Doubt, ...]:
    """Return what contradicts an entry, in the order of the table of assumptions."""
    text = f"{origin}max_age: forever\ntopics:\n  {yaml_text(topic.name)}: {flow_text(fields)}"
    plan = ReadingPlan.of(replace(parse_mapping(text), accept=()), [topic])
    assembler = Assembler(plan, lambda topic: lambda payload: messages[int(payload)], name="")
    try:
        assembler.add(
            [
                Message(topic.name, time_ns, time_ns, number, str(number).encode())
                for number, time_ns in enumerate(times_ns)
            ]
        )
        assembler.finish()
    except (UsageError, LogError):
        # times of recording that jump say nothing about the entry
        return ()
    return tuple(doubt for doubt in assembler.take_doubts() if doubt.assumption not in _OF_ALL_TOPICS)


_OF_ALL_TOPICS = frozenset({"one_frame", "one_clock", "one_unit", "one_publisher"})
"""Assumptions about all topics of a log together."""


def _clause(doubt: Doubt, *, with_remedy: bool = False) -> str:
    """Return the measurement of a doubt, without its topic."""
    remedy = next(assumption.remedy for assumption in ASSUMPTIONS if assumption.name == doubt.assumption)
    clause = str(doubt.text).removeprefix(f"{doubt.topic}: ")
    return clause if with_remedy else clause.removesuffix(f"; {remedy}")


def _yaws(fields: Fields) -> Iterator[Fields]:
    yaw = fields.get("yaw")
    if yaw is None:
        return
    path = yaw.removeprefix("{field: ").split(",")[0]
    kinds = ["unit: deg", f"unit: deg, {FROM_NORTH}", FROM_NORTH]
    if FROM_NORTH in yaw:
        kinds = [f"unit: deg, {FROM_NORTH}"]
    for kind in kinds:
        yield {**fields, "yaw": f"{{field: {path}, {kind}}}"}


def _orders(fields: Fields) -> Iterator[Fields]:
    if "order" in fields:
        yield {**fields, "order": "xyzw" if fields["order"] == "wxyz" else "wxyz"}


def _bounds(fields: Fields) -> Iterator[Fields]:
    bounds = fields.get("bounds", "{")
    if not bounds.startswith("{"):
        yield {**fields, "bounds": f"{{field: {bounds}, form: xywh}}"}


def _degrees(fields: Fields) -> Iterator[Fields]:
    for number in _NOT_AVAILABLE:
        yield {**fields, "invalid": f"[{number}]"}
    yield {**fields, "yaw": fields.get("yaw", "").replace("unit: deg", "unit: cdeg")}


def _latitudes(fields: Fields) -> Iterator[Fields]:
    invalid = fields.get("invalid", "[]").strip("[]")
    yield {**fields, "invalid": f"[{', '.join(filter(None, (invalid, '91, 181')))}]"}
    yield {**fields, "scale": "1e-7"}


_NOT_AVAILABLE = (511, 4095, 65535)
"""Numbers that stand for an angle that is not available: in AIS, in 12 and in 16 bits."""

_ALTERNATIVES: Mapping[str, Callable[[Fields], Iterator[Fields]]] = MappingProxyType(
    {
        "radians": _yaws,
        "heading": _yaws,
        "quaternion_order": _orders,
        "corners": _bounds,
        "degrees": _degrees,
        "latitude": _latitudes,
        "complete_list": lambda fields: iter([{**fields, "complete": "false"}]),
    }
)
"""The entries that settle a contradicted assumption, by its name."""

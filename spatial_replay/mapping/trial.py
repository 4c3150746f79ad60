"""Trials of mapping entries: an entry and some messages of its topic in, contradictions out.

To resolve a contradiction, `choose_entry` adds keys to an entry. Keys that cause more contradictions
than they resolve are not added.
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
"""Entry of a topic: values in YAML's flow style, by key."""

FROM_NORTH = "zero: north, clockwise: true"
"""Keys of a mapping for a compass angle."""
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
    """Return the messages that an entry can read, and the reasons why it cannot read other messages.

    Raises:
        UsageError: the entry can read no message.
    """
    reasons: list[str] = []
    reader = _reader(topic, entry, origin, reasons)
    is_good = reader.read(np.arange(len(messages)), messages).good
    reader.finish()
    if not is_good.any():
        raise UsageError(reasons[0])
    return list(compress(messages, is_good)), reasons


def lateness_s(
    topic: Topic, entry: str, messages: Sequence[object], times_ns: Sequence[int], origin: str = ""
) -> Floats | None:
    """Return the time from each message's stamp to its recording, seconds.

    Returns:
        None if stamps are not a clock: a stamp is missing or 0, or stamps do not advance with the recording.
    """
    is_good = np.ones(len(messages), np.bool_)
    try:
        stamps_ns = _reader(topic, entry, f"{origin}clock: header\n", []).stamps(messages, times_ns, is_good)
    except UsageError:
        return None
    is_clock = is_good.all() and (stamps_ns > 0).all() and (np.diff(stamps_ns) > 0).all()
    # stamps in another unit advance by a factor of 1,000; a simulation may run some times faster than real
    # time
    advance_ratio = np.ptp(stamps_ns) / max(1, np.ptp(times_ns))
    if not is_clock or (len(messages) > 1 and not 1 / _FASTEST < advance_ratio < _FASTEST):
        return None
    return (np.asarray(times_ns) - stamps_ns) / 1e9


_FASTEST = 20
"""Greatest ratio of stamp time to recording time. The reciprocal is the least ratio."""


def _reader(topic: Topic, entry_text: str, mapping_head: str, reasons: list[str]) -> TopicReader:
    """Return a reader of decoded messages that adds a reason to `reasons` for each unreadable message."""
    mapping = parse_mapping(f"{mapping_head}topics:\n  {yaml_text(topic.name)}: {entry_text}")
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
    """Return an entry with fewer contradictions, and a text on each change and each remaining contradiction.

    Args:
        fields: entry that can read the messages.
        times_ns: time of recording of each message.
        origin: line of the mapping with the key `origin`; "" without an origin.
    """
    reasons: list[str] = []
    doubts = _doubts(topic, fields, messages, times_ns, origin)
    untried_alternatives = dict(_ALTERNATIVES)
    while doubt := next((doubt for doubt in doubts if doubt.assumption in untried_alternatives), None):
        trials = [
            (changed_fields, remaining_doubts)
            for changed_fields in untried_alternatives.pop(doubt.assumption)(fields)
            for remaining_doubts in [_doubts(topic, changed_fields, messages, times_ns, origin)]
            if doubt.assumption not in {contradiction.assumption for contradiction in remaining_doubts}
        ]
        if not trials:
            continue
        # a change may reveal another contradiction, such as a number that stands for a missing value
        changed_fields, remaining_doubts = min(trials, key=lambda trial: len(trial[1]))
        if len(remaining_doubts) <= len(doubts):
            changed_keys = [
                f"{key}: {value}" for key, value in changed_fields.items() if fields.get(key) != value
            ]
            reasons.append(f"{', '.join(changed_keys)}, since otherwise {_clause(doubt)}")
            fields, doubts = changed_fields, remaining_doubts
    return fields, [*reasons, *(_clause(doubt, with_remedy=True) for doubt in doubts)]


def _doubts(
    topic: Topic, fields: Fields, messages: Sequence[object], times_ns: Sequence[int], origin: str
) -> tuple[Doubt, ...]:
    """Return the contradictions of an entry, in the order of the table of assumptions."""
    mapping_text = f"{origin}max_age: forever\ntopics:\n  {yaml_text(topic.name)}: {flow_text(fields)}"
    plan = ReadingPlan.of(replace(parse_mapping(mapping_text), accept=()), [topic])
    assembler = Assembler(plan, lambda topic: lambda payload: messages[int(payload)], name="")
    try:
        assembler.add(
            [
                Message(topic.name, time_ns, time_ns, message_index, str(message_index).encode())
                for message_index, time_ns in enumerate(times_ns)
            ]
        )
        assembler.finish()
    except (UsageError, LogError):
        # an error, such as a jump of log times, is no evidence against the entry
        return ()
    return tuple(doubt for doubt in assembler.take_doubts() if doubt.assumption not in _OF_ALL_TOPICS)


_OF_ALL_TOPICS = frozenset({"one_frame", "one_clock", "one_unit", "one_publisher"})
"""Assumptions that concern all topics of a log together."""


def _clause(doubt: Doubt, *, with_remedy: bool = False) -> str:
    """Return the text of a doubt without its topic, and without its remedy by default."""
    remedy = next(assumption.remedy for assumption in ASSUMPTIONS if assumption.name == doubt.assumption)
    clause = str(doubt.text).removeprefix(f"{doubt.topic}: ")
    return clause if with_remedy else clause.removesuffix(f"; {remedy}")


def _yaws(fields: Fields) -> Iterator[Fields]:
    yaw = fields.get("yaw")
    if yaw is None:
        return
    path = yaw.removeprefix("{field: ").split(",")[0]
    interpretations = ["unit: deg", f"unit: deg, {FROM_NORTH}", FROM_NORTH]
    if FROM_NORTH in yaw:
        interpretations = [f"unit: deg, {FROM_NORTH}"]
    for interpretation in interpretations:
        yield {**fields, "yaw": f"{{field: {path}, {interpretation}}}"}


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
    invalid_numbers = fields.get("invalid", "[]").strip("[]")
    # AIS sends 91 and 181 degrees for a missing position (ITU-R M.1371); GNSS receivers send degrees * 10^7
    yield {**fields, "invalid": f"[{', '.join(filter(None, (invalid_numbers, '91, 181')))}]"}
    yield {**fields, "scale": "1e-7"}


_NOT_AVAILABLE = (511, 4095, 65535)
"""Numbers for a missing angle: 511 in AIS (ITU-R M.1371), and the greatest numbers of 12 and 16 bits."""

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
"""Functions from an entry to changed entries that may resolve a contradiction, by name of the assumption."""

"""Where a log and a new evaluation of it differ first: in samples, messages, specifications, results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import zip_longest

import numpy as np

from spatial_replay import __version__
from spatial_replay.annotate.certificate import PLAN_SHA256
from spatial_replay.bags.columns import Message
from spatial_replay.bags.mcap_log import McapLog
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.remote import LogFile
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.schemas.Robustness_pb2 import Robustness
from spatial_replay.logs.schemas.Specification_pb2 import Specification
from spatial_replay.logs.topics import DERIVED, OBJECTS, ROBUSTNESS, SPECIFICATION
from spatial_replay.text import Instant, Sentence, printable

_QUANTITIES = ("value", "now", "lower", "upper")
_LONGEST_LINE = 80


class FirstDifferences:
    """Compares the messages of a log with those of a new evaluation, topic by topic, as they come."""

    def __init__(self, log: LogFile) -> None:
        self._reader = McapLog(log)
        self._recorded: dict[str, Iterator[Message]] = {}
        self._counts: dict[str, int] = {}
        self._found: dict[str, Sentence] = {}

    def add(self, messages: Messages) -> None:
        """Compare the next messages of the evaluation."""
        topics = {number: channel.topic for number, channel in messages.channels.items()}
        rows = zip(messages.channel.tolist(), messages.log_time_ns.tolist(), messages.payloads, strict=True)
        for number, time_ns, payload in rows:
            topic = topics[number]
            if topic not in self._found:
                self._compare(topic, time_ns, payload)

    def finish(self) -> dict[str, Sentence]:
        """Compare what the log has beyond the evaluation; return the first difference of each topic."""
        for topic in (each.name for each in self._reader.topics()):
            is_compared = topic in self._recorded or topic not in DERIVED
            if topic not in self._found and is_compared:
                extra = next(self._messages(topic), None)
                if extra is not None:
                    when = Instant(extra.log_time_ns, 0)
                    self._found[topic] = Sentence("the one at ", when, " is only in the log")
        return self._found

    def _compare(self, topic: str, time_ns: int, payload: bytes) -> None:
        recorded = next(self._messages(topic), None)
        if recorded is None:
            self._found[topic] = Sentence("the one at ", Instant(time_ns, 0), " is not in the log")
        elif recorded.log_time_ns != time_ns:
            now, then = Instant(time_ns, 0), Instant(recorded.log_time_ns, 0)
            self._found[topic] = Sentence("one is at ", now, " now, and was at ", then)
        elif recorded.payload != payload:
            what = _difference(topic, payload, recorded.payload)
            if what is not None:
                self._found[topic] = Sentence("at ", Instant(time_ns, 0), f": {what}")

    def _messages(self, topic: str) -> Iterator[Message]:
        if topic not in self._recorded:
            self._recorded[topic] = self._reader.iter_messages({topic})
        return self._recorded[topic]


def explain_differences(
    recorded: Mapping[str, str], computed: Mapping[str, str], found: Mapping[str, Sentence]
) -> list[Sentence]:
    """Return for each part of a certificate whether it is the same, and where it differs first.

    Args:
        found: the first difference of each topic, in a clause; see `FirstDifferences`.
    """
    beside = {topic: what for topic, what in found.items() if topic not in DERIVED and topic != OBJECTS}
    first = next((Sentence(f"on {topic}, ", what) for topic, what in sorted(beside.items())), None)
    parts = (
        ("samples", found.get(OBJECTS)),
        ("messages", first or found.get(OBJECTS)),
        ("specification", found.get(SPECIFICATION)),
        ("results", found.get(ROBUSTNESS)),
    )
    lines = []
    for name, where in parts:
        key = f"{name}_sha256"
        if recorded.get(key) == computed.get(key):
            lines.append(Sentence(f"{name:<14} the same"))
        elif where is None:
            lines.append(Sentence(f"{name:<14} differ from those certified; the log does not show where"))
        else:
            lines.append(Sentence(f"{name:<14} differ first ", where))
    if PLAN_SHA256 in recorded:
        is_same = recorded[PLAN_SHA256] == computed.get(PLAN_SHA256)
        lines.append(
            Sentence(f"{'plan settings':<14} {'the same' if is_same else 'differ from those certified'}")
        )
    version = recorded.get("spatial_replay_version", "unknown")
    is_same = version == __version__
    lines.append(
        Sentence(f"{'program':<14} " + ("the same" if is_same else f"{__version__} now, {version} recorded"))
    )
    return lines


def _difference(topic: str, now: bytes, then: bytes) -> str | None:
    """Return how a message differs from the recorded one; None if it only is encoded in another way."""
    try:
        match topic:
            case "/spatial/objects":
                return _of_samples(ObjectStates.FromString(now), ObjectStates.FromString(then))
            case "/spatial/robustness":
                return _of_results(Robustness.FromString(now), Robustness.FromString(then))
            case "/spatial/specification":
                return _of_specifications(Specification.FromString(now), Specification.FromString(then))
    # what is recorded need not be a message of ours
    except ValueError:
        return "what is recorded cannot be decoded"
    return f"{len(now)} bytes now, {len(then)} recorded, of other content"


def _of_samples(now: ObjectStates, then: ObjectStates) -> str | None:
    objects, before = ({each.name: each for each in sample.objects} for sample in (now, then))
    for name in sorted(objects.keys() | before.keys()):
        if name not in objects or name not in before:
            return f"`{name}` is {'only in the log' if name in before else 'not in the log'}"
        for field in ("class_name", "parts", "yaw", "height", "uncertainty"):
            if getattr(objects[name], field) != getattr(before[name], field):
                what = {"class_name": "class", "parts": "footprint"}.get(field, field)
                return f"`{name}` has another {what}"
    signals, old = ({each.name: each.value for each in sample.signals} for sample in (now, then))
    for name in sorted(signals.keys() | old.keys()):
        if signals.get(name) != old.get(name):
            values = [side.get(name, "missing") for side in (signals, old)]
            return f"the signal `{name}` is {values[0]} now, {values[1]} recorded"
    return None


def _of_results(now: Robustness, then: Robustness) -> str | None:
    if (now.specification, now.object) != (then.specification, then.object):
        return f"`{now.specification}` now, `{then.specification}` recorded"
    for one, other in zip_longest(now.nodes, then.nodes):
        if one is None or other is None:
            return f"`{now.specification}` has {len(now.nodes)} nodes now, {len(then.nodes)} recorded"
        for name in _QUANTITIES:
            values = getattr(one, name), getattr(other, name)
            if not np.array_equal(*values, equal_nan=True):
                node = f"`{one.name or f'node {one.id}'}` in `{now.specification}`"
                return f"{name} of {node} is {values[0]!r} now, {values[1]!r} recorded"
    return None


def _of_specifications(now: Specification, then: Specification) -> str | None:
    for one, other in zip_longest(now.files, then.files):
        if one is None or other is None:
            return f"{len(now.files)} files now, {len(then.files)} recorded"
        lines = zip_longest(one.canonical.splitlines(), other.canonical.splitlines(), fillvalue="")
        for number, (line, before) in enumerate(lines, 1):
            if line != before:
                shown = [printable(each, _LONGEST_LINE) for each in (line, before)]
                return f"{one.name}, line {number} as formatted: `{shown[0]}` now, `{shown[1]}` recorded"
    return None

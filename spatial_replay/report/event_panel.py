"""Messages of /spatial/events → the rows of the page's list."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from foxglove_schemas_protobuf.Event_pb2 import Event

from spatial_replay.report.compact import sentence_parts

MOST_EVENTS: Final = 2_000
"""Events of a page, at most: the first ones."""


class ReportedEvent(NamedTuple):
    """One change.

    Attributes:
        start_ns: the first sample of what began.
        facts: the metadata of the event, by key.
    """

    start_ns: int
    facts: Mapping[str, str]


def event_of(payload: bytes) -> ReportedEvent:
    """Decode a message of /spatial/events."""
    event = Event.FromString(payload)
    facts = {each.key: each.value for each in event.metadata}
    return ReportedEvent(event.start_time.ToNanoseconds(), facts)


def event_values(events: Sequence[ReportedEvent], first_ns: int) -> list[Mapping[str, Any]]:
    """Return the list as the page reads it, by start time."""
    ordered = sorted(events, key=lambda each: each.start_ns)
    return [
        {
            "time": (each.start_ns - first_ns) / 1e9,
            "status": _status(each.facts),
            "specification": each.facts.get("specification", ""),
            "object": each.facts.get("object"),
            "parts": sentence_parts(each.facts.get("message", "")),
        }
        for each in ordered[:MOST_EVENTS]
    ]


def _status(facts: Mapping[str, str]) -> str:
    if "vacuous" in facts:
        return "vacuous"
    if facts.get("verdict") != "pending":
        return facts.get("verdict", "")
    return "holding" if facts.get("sign") == "positive" else "pending"

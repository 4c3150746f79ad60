"""Topics by name, out of what each file or publisher says of them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

from spatial_replay.logs.foreign.decoders import same_definition, why_unreadable
from spatial_replay.logs.foreign.messages import Topic

_LATCHED = re.compile(r"durability: *(1|transient_local)\b")


def is_latched(qos: str) -> bool:
    """Whether a ROS 2 publisher's quality of service keeps messages for whoever comes later."""
    return _LATCHED.search(qos) is not None


def topics_named(described: Iterable[Topic], distribution: str | None = None) -> tuple[Topic, ...]:
    """One topic for each name, in order; those that cannot be decoded say why.

    Args:
        distribution: the release of ROS that the log names.
    """
    named: dict[str, Topic] = {}
    for topic in described:
        before = named.get(topic.name)
        named[topic.name] = topic if before is None else _joined(before, topic)
    return tuple(
        topic if topic.unreadable else replace(topic, unreadable=why_unreadable(topic, distribution))
        for _, topic in sorted(named.items())
    )


def _joined(one: Topic, other: Topic) -> Topic:
    known = None not in (one.count, other.count)
    joined = replace(
        one,
        count=(one.count or 0) + (other.count or 0) if known else None,
        latched=one.latched or other.latched,
        schema=one.schema or other.schema,
    )
    for what in ("type", "encoding"):
        if getattr(one, what) != getattr(other, what):
            said = f"{getattr(one, what)!r} and {getattr(other, what)!r}"
            return replace(
                joined, unreadable=f"topic {one.name!r} has messages of more than one {what}: {said}"
            )
    if None not in (one.schema, other.schema) and not same_definition(one, other):
        return replace(
            joined, unreadable=f"topic {one.name!r} has messages of {one.type!r} in two definitions"
        )
    return joined

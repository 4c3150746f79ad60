"""What viewers can take of a fast playback: the messages of each turn, thinned to a rate for each topic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.geometry.arrays import Booleans, Integers
from spatial_replay.logs.messages import Channel, Messages, select
from spatial_replay.logs.topics import (
    CAMERA_ANNOTATIONS,
    EVENT_LOG,
    EVENTS,
    GRADIENT_MAP,
    PLAN_DECISION,
    PLAN_PATH,
    REDONE_MAP,
    REDONE_PATH,
    SCENE,
    STANDING,
    is_image_type,
)
from spatial_replay.serve.pace import MOST_LATE_S

MOST_A_SECOND: Final = 600
"""The most samples sent in a second, since viewers can take no more."""

MOST_DRAWN_A_SECOND: Final = 50
"""The most messages a second of a topic that the layout draws: as many as a second of a log has."""

_MOST_AT_ONCE: Final = math.ceil(MOST_DRAWN_A_SECOND * MOST_LATE_S) + 1
"""So many of them may come at once after a pause: at speed 1 all those of a late turn, and one by chance."""

_NEVER_THINNED: Final = (EVENTS, EVENT_LOG)
_DRAWN: Final = (
    SCENE,
    STANDING,
    PLAN_DECISION,
    GRADIENT_MAP,
    PLAN_PATH,
    REDONE_MAP,
    REDONE_PATH,
    CAMERA_ANNOTATIONS,
)


class PlaybackThinning:
    """Thin the messages of a playback, turn by turn; in the thread of its player.

    Of a topic that the layout draws, at most `MOST_DRAWN_A_SECOND` messages are sent for each second that
    passes, and in any second less than 60; of any other, those of `MOST_A_SECOND` times. The last of each
    turn is always sent, and so is every event.
    """

    def __init__(self) -> None:
        """Begin with as many messages left as may come at once."""
        self._passed_s = 0.0
        self._left: dict[str, tuple[float, float]] = {}

    def thin(self, messages: Messages, elapsed_s: float) -> Messages:
        """Return what to send of the messages that came in a turn of so many seconds."""
        self._passed_s += elapsed_s
        most = max(1, math.ceil(MOST_A_SECOND * elapsed_s))
        kept = np.ones(len(messages), np.bool_)
        payloads: dict[int, bytes] = {}
        for number, channel in messages.channels.items():
            if channel.topic in _NEVER_THINNED:
                continue
            own = np.flatnonzero(messages.channel == number)
            times_ns, which = np.unique(messages.log_time_ns[own], return_inverse=True)
            # one time more than that comes by chance
            count = self._take(channel.topic, len(times_ns)) if _is_drawn(channel) else most
            if len(times_ns) <= count + (not _is_drawn(channel)):
                continue
            chosen = np.zeros(len(times_ns), np.bool_)
            chosen[np.linspace(len(times_ns) - 1, 0, count, endpoint=False).astype(np.int64)] = True
            kept[own] = chosen[which]
            if channel.topic == SCENE:
                payloads |= _with_deletions(messages.payloads, own, kept)
        if kept.all():
            return messages
        places = np.flatnonzero(kept)
        sent = select(messages, places)
        if not payloads:
            return sent
        return replace(
            sent, payloads=[payloads.get(place, messages.payloads[place]) for place in places.tolist()]
        )

    def _take(self, topic: str, wanted: int) -> int:
        """Return how many messages of a topic that is drawn may be sent, at least the last one."""
        left, at_s = self._left.get(topic, (float(_MOST_AT_ONCE), self._passed_s))
        left = min(left + MOST_DRAWN_A_SECOND * (self._passed_s - at_s), _MOST_AT_ONCE)
        most = max(1, math.floor(left))
        self._left[topic] = left - min(wanted, most), self._passed_s
        return most


def _is_drawn(channel: Channel) -> bool:
    # the frames of a video depend on those before
    schema = "" if channel.schema is None else channel.schema.name
    return channel.topic in _DRAWN or (is_image_type(schema) and not schema.endswith("Video"))


def _with_deletions(payloads: Sequence[bytes], own: Integers, kept: Booleans) -> dict[int, bytes]:
    """Return scenes that are kept, each with what is deleted by those left out before it."""
    with_more = {}
    missed = SceneUpdate()
    for place in own.tolist():
        if not kept[place]:
            missed.deletions.extend(SceneUpdate.FromString(payloads[place]).deletions)
        elif missed.deletions:
            # a viewer deletes before it draws
            with_more[place] = missed.SerializeToString(deterministic=True) + payloads[place]
            missed = SceneUpdate()
    return with_more

"""How much of a fast playback viewers are sent."""

from __future__ import annotations

from typing import Final

import numpy as np

from spatial_replay.logs.block import Messages
from spatial_replay.logs.merging import select
from spatial_replay.logs.topics import EVENT_LOG, EVENTS

_EACH_COUNTS: Final = (EVENTS, EVENT_LOG)
"""Topics of which no message is left out."""


def thinned(messages: Messages, most: int) -> Messages:
    """Of the messages of each topic those of at most so many times, spread over all and with the last.

    One time more than that is by chance, in a stretch cut out of many, and makes no difference.
    """
    kept = np.ones(len(messages), np.bool_)
    for number, channel in messages.channels.items():
        own = messages.channel == number
        times_ns, which = np.unique(messages.log_time_ns[own], return_inverse=True)
        if len(times_ns) > most + 1 and channel.topic not in _EACH_COUNTS:
            chosen = np.zeros(len(times_ns), np.bool_)
            chosen[np.linspace(len(times_ns) - 1, 0, most, endpoint=False).astype(np.int64)] = True
            kept[own] = chosen[which]
    return messages if kept.all() else select(messages, np.flatnonzero(kept))

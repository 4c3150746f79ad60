"""A log with what an evaluation says of it, as messages from any time on."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from spatial_replay.annotate.scene_update import SceneState, scene_scale
from spatial_replay.logs.messages import Channel, Messages, join, merge, select
from spatial_replay.replay.selection import Reading, standing
from spatial_replay.replay.tuning import Tuned

_STANDS_NS: Final = 2_000_000_000
"""How far back a message is looked for that a viewer shows until the next one of its topic."""

_MOST_EVENTS: Final = 500
"""How many messages are sent at once of what was told before."""


class Playback:
    """The messages that an annotated log would have, in the order of time.

    From a place on they are those that a replay writes, into however many stretches they are cut, but for the
    scene: a viewer may still show what is gone, which is deleted then, and it is drawn anew at once.

    Attributes:
        tuned: what an evaluation says; another one of the same log may take its place before a `seek`.
        start_ns, end_ns: from the first sample to the last sample or message of the log.
        time_ns: up to where messages were taken, that included.
    """

    def __init__(self, tuned: Tuned) -> None:
        """Begin before the first message; `seek` first."""
        own = tuned.tuning.own
        self._times_ns = tuned.tuning.inside.times_ns
        self.start_ns, self.end_ns = int(self._times_ns[0]), own.end_ns
        self.time_ns = self.start_ns
        self.tuned = tuned
        self._annotator = tuned.annotator(SceneState(scale=scene_scale(tuned.tuning.inside)))
        self._reading = Reading(own, self.start_ns)
        self._next = 0
        self._has_ended = False

    @property
    def channels(self) -> tuple[Channel, ...]:
        """All that there can be messages of."""
        own = self.tuned.tuning.own
        first = Reading(own, self.start_ns).take_before(self.start_ns + 1)
        derived = Messages(channels=dict(enumerate(self.tuned.evaluation.channels)))
        return tuple(dict.fromkeys((*join([derived, first]).channels.values(), *own.channels)))

    def seek(self, time_ns: int) -> Messages:
        """Go to a time: what stands there, and what is at that time.

        That is the sample at or before it with all that is said of it, the specification, what was told so
        far (the last of it, if it is much), and of the log's own topics the last message.

        Raises:
            LogError: the log cannot be read any more.
        """
        self.time_ns = min(max(time_ns, self.start_ns), self.end_ns)
        self._next = int(np.searchsorted(self._times_ns, self.time_ns, side="right"))
        shown = max(self._next - 1, 0)
        self._annotator = self.tuned.annotator(replace(self._annotator.scene, written_ns=None))
        self._has_ended = False
        told = _last(merge(self._annotator.pass_over(*self.tuned.part(0, shown))))
        derived = self._annotator.messages(*self.tuned.part(shown, self._next))
        found = merge([told, *derived, self._seek_own(int(self._times_ns[shown]))])
        return join([found, _last(self._end())])

    def advance_to(self, time_ns: int) -> Messages:
        """What comes after the messages taken so far, up to a time, that included.

        Raises:
            LogError: the log cannot be read any more.
        """
        self.time_ns = min(max(time_ns, self.time_ns), self.end_ns)
        begin = self._next
        self._next = int(np.searchsorted(self._times_ns, self.time_ns, side="right"))
        derived = self._annotator.messages(*self.tuned.part(begin, self._next))
        coming = merge([*derived, self._reading.take_before(self.time_ns + 1)])
        return join([coming, self._end()])

    def reach_ns(self, samples: int) -> int:
        """The time of the sample that comes so many after the last one taken, or the end."""
        index = self._next + samples - 1
        return int(self._times_ns[index]) if index < len(self._times_ns) else self.end_ns

    def _end(self) -> Messages:
        """What comes last of all, if that was not taken yet and the end is reached."""
        if self._has_ended or self.time_ns < self.end_ns:
            return Messages()
        self._has_ended = True
        return merge(self._annotator.end(self.end_ns, self.tuned.evaluation.finals))

    def _seek_own(self, sample_ns: int) -> Messages:
        """The log's own messages that stand at the present time, and those at that time."""
        own = self.tuned.tuning.own
        since_ns = max(min(self.time_ns - _STANDS_NS, sample_ns), own.start_ns)
        self._reading = Reading(own, since_ns)
        found = merge([own.few_before(since_ns), self._reading.take_before(self.time_ns + 1)])
        return standing(found, self.time_ns)


def _last(told: Messages) -> Messages:
    return select(told, np.arange(max(0, len(told) - _MOST_EVENTS), len(told)))

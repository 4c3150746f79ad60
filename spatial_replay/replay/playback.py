"""The messages of an annotated log, made from any time on while it is played."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from spatial_replay.annotate.annotator import shown_regions
from spatial_replay.annotate.scene.scene_update import scene_start
from spatial_replay.logs.messages import Channel, Messages, join, merge, select
from spatial_replay.replay.loaded_log import Evaluated
from spatial_replay.replay.own_messages import MessageCursor, latest_messages

_LOOK_BACK_NS: Final = 2_000_000_000
"""How far before a seek the latest message of each topic is looked for."""

_MOST_EVENTS: Final = 500
"""The most earlier events that a seek sends."""


class Playback:
    """The messages that an annotated log would have, in the order of time.

    From a seek on they are those that a replay writes, however they are split into stretches, except for the
    scene: it is drawn again at once, and what a viewer may still show of another time is deleted.

    Attributes:
        evaluated: the evaluation; another one of the same log may replace it before a `seek`.
        start_ns, end_ns: from the first sample to the last sample or message of the log.
        arrow: the title of the result whose violation the scene points at, from the next `seek` on; "" for
            the first one.
        time_ns: the time up to which messages were taken, inclusive.
    """

    def __init__(self, evaluated: Evaluated) -> None:
        """Begin before the first message; `seek` first."""
        own = evaluated.loaded.own
        self._times_ns = evaluated.loaded.inside.times_ns
        self.start_ns, self.end_ns = int(self._times_ns[0]), own.end_ns
        self.time_ns = self.start_ns
        self.evaluated = evaluated
        self.arrow = ""
        self._regions = shown_regions(evaluated.edited.files)
        self._start = scene_start(evaluated.loaded.inside, self._regions)
        self._annotator = evaluated.annotator(self._start)
        self._own = MessageCursor(own, self.start_ns)
        self._next = 0
        self._has_ended = False

    @property
    def channels(self) -> tuple[Channel, ...]:
        """All channels that may have messages."""
        own = self.evaluated.loaded.own
        first = MessageCursor(own, self.start_ns).take_before(self.start_ns + 1)
        derived = Messages(channels=dict(enumerate(self.evaluated.evaluation.channels)))
        return tuple(dict.fromkeys((*join([derived, first]).channels.values(), *own.channels)))

    def seek(self, time_ns: int) -> Messages:
        """Go to a time, and return what a viewer shows there.

        That is the sample at or before it with all its messages, the specification, the events so far (the
        latest, if they are many), and the last message of each of the log's own topics.

        Raises:
            LogError: the log can no longer be read.
        """
        self.time_ns = min(max(time_ns, self.start_ns), self.end_ns)
        self._next = int(np.searchsorted(self._times_ns, self.time_ns, side="right"))
        shown = max(self._next - 1, 0)
        regions = shown_regions(self.evaluated.edited.files)
        if regions != self._regions:
            self._start, self._regions = scene_start(self.evaluated.loaded.inside, regions), regions
        scene = replace(self._annotator.scene, written_ns=None, place=self._start.place)
        self._annotator = self.evaluated.annotator(scene, self.arrow)
        self._has_ended = False
        events = _last(merge(self._annotator.pass_over(*self.evaluated.part(0, shown))))
        derived = self._annotator.messages(*self.evaluated.part(shown, self._next))
        shown_there = merge([events, *derived, self._seek_own(int(self._times_ns[shown]))])
        return join([shown_there, _last(self._end())])

    def advance_to(self, time_ns: int) -> Messages:
        """Return the messages after those taken so far, up to and including a time.

        Raises:
            LogError: the log can no longer be read.
        """
        self.time_ns = min(max(time_ns, self.time_ns), self.end_ns)
        begin = self._next
        self._next = int(np.searchsorted(self._times_ns, self.time_ns, side="right"))
        derived = self._annotator.messages(*self.evaluated.part(begin, self._next))
        coming = merge([*derived, self._own.take_before(self.time_ns + 1)])
        return join([coming, self._end()])

    def reach_ns(self, samples: int) -> int:
        """Return the time of the sample that comes so many after the last one taken, or the end."""
        index = self._next + samples - 1
        return int(self._times_ns[index]) if index < len(self._times_ns) else self.end_ns

    def _end(self) -> Messages:
        """Return the messages at the end of the log, once it is reached."""
        if self._has_ended or self.time_ns < self.end_ns:
            return Messages()
        self._has_ended = True
        return merge(self._annotator.end(self.end_ns, self.evaluated.evaluation.finals))

    def _seek_own(self, sample_ns: int) -> Messages:
        """Return the latest of the log's own messages of each topic, and all those at the present time."""
        own = self.evaluated.loaded.own
        since_ns = max(min(self.time_ns - _LOOK_BACK_NS, sample_ns), own.start_ns)
        self._own = MessageCursor(own, since_ns)
        messages = merge([own.few_before(since_ns), self._own.take_before(self.time_ns + 1)])
        return latest_messages(messages, self.time_ns)


def _last(events: Messages) -> Messages:
    return select(events, np.arange(max(0, len(events) - _MOST_EVENTS), len(events)))

"""Where a playback is: playing or paused, how fast, at which time."""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import Final, NamedTuple

SLOWEST: Final = 0.01
FASTEST: Final = 100.0


class Status(Enum):
    """What a playback does."""

    PLAYING = auto()
    PAUSED = auto()
    ENDED = auto()


class State(NamedTuple):
    """What viewers are told of a playback.

    Attributes:
        speed: seconds of the log in a second.
        did_seek: whether it is at this time because it was set there, so that what was shown is out of date.
    """

    status: Status
    time_ns: int
    speed: float
    did_seek: bool = False


class Transport:
    """Plays, pauses and seeks, by a clock that whoever asks brings along: `now`, in seconds.

    Attributes:
        start_ns, end_ns: first and last time.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        """Pause at the start."""
        self.start_ns, self.end_ns = start_ns, end_ns
        self._is_playing = False
        self._speed = 1.0
        self._from_ns, self._since = start_ns, 0.0

    def time_ns(self, now: float) -> int:
        """Where it is."""
        if not self._is_playing:
            return self._from_ns
        played_ns = round((now - self._since) * self._speed * 1e9)
        return min(self._from_ns + max(played_ns, 0), self.end_ns)

    def state(self, now: float, *, did_seek: bool = False) -> State:
        """What to tell viewers."""
        time_ns = self.time_ns(now)
        status = Status.PLAYING if self._is_playing else Status.PAUSED
        if not self._is_playing and time_ns >= self.end_ns:
            status = Status.ENDED
        return State(status, time_ns, self._speed, did_seek)

    def play(self, now: float) -> None:
        """Go on from where it is; at the end, that is over at once."""
        self.move_to(self.time_ns(now), now)
        self._is_playing = True

    def pause(self, now: float) -> None:
        """Stay where it is."""
        self.move_to(self.time_ns(now), now)
        self._is_playing = False

    def move_to(self, time_ns: int, now: float) -> None:
        """Go on from another time, within the log."""
        self._from_ns, self._since = min(max(time_ns, self.start_ns), self.end_ns), now

    def set_speed(self, speed: float, now: float) -> None:
        """Go on faster or slower, within limits; what is no number above 0 changes nothing."""
        if speed > 0.0 and not math.isinf(speed):
            self.move_to(self.time_ns(now), now)
            self._speed = min(max(speed, SLOWEST), FASTEST)

"""The time of a playback: how fast it moves, whether it plays, and where in the log it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto
from typing import Final, NamedTuple

MOST_LATE_S: Final = 0.15
"""The most time that passes between two turns; viewers can take what is played in that time at once."""


class Pace:
    """The seconds by which a log is played, turn by turn.

    After a turn that took too long, at most `MOST_LATE_S` count: the playback falls behind the clock, so that
    no turn has more to send than viewers can take.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        """Begin the first turn."""
        self._clock = clock
        self._behind_s = 0.0
        self._turn = clock()

    def now(self) -> float:
        """Return the seconds that have passed."""
        return self._at(self._clock())

    def next_turn(self) -> float:
        """Begin another turn; return the seconds of the last one, at most `MOST_LATE_S`."""
        read = self._clock()
        now = self._at(read)
        elapsed_s = now - self._turn
        self._behind_s, self._turn = read - now, now
        return elapsed_s

    def _at(self, read: float) -> float:
        return min(read - self._behind_s, self._turn + MOST_LATE_S)


SLOWEST: Final = 0.01
FASTEST: Final = 100.0


class Status(Enum):
    """The status of a playback."""

    PLAYING = auto()
    PAUSED = auto()
    ENDED = auto()


class PlaybackState(NamedTuple):
    """The state of a playback, as viewers show it.

    Attributes:
        speed: seconds of the log in a second.
        did_seek: whether it jumped to this time, so that what viewers show is out of date.
    """

    status: Status
    time_ns: int
    speed: float
    did_seek: bool = False


class Transport:
    """Play, pause and seek; callers pass the time of their clock, `now`, in seconds.

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
        """Return the present time of the log."""
        if not self._is_playing:
            return self._from_ns
        played_ns = round((now - self._since) * self._speed * 1e9)
        return min(self._from_ns + max(played_ns, 0), self.end_ns)

    def state(self, now: float) -> PlaybackState:
        """Return the state to show."""
        time_ns = self.time_ns(now)
        status = Status.PLAYING if self._is_playing else Status.PAUSED
        if not self._is_playing and time_ns >= self.end_ns:
            status = Status.ENDED
        return PlaybackState(status, time_ns, self._speed)

    def play(self, now: float) -> None:
        """Play from the present time; at the end, that is over at once."""
        self.move_to(self.time_ns(now), now)
        self._is_playing = True

    def pause(self, now: float) -> None:
        """Stay at the present time."""
        self.move_to(self.time_ns(now), now)
        self._is_playing = False

    def move_to(self, time_ns: int, now: float) -> None:
        """Go to another time, within the log."""
        self._from_ns, self._since = min(max(time_ns, self.start_ns), self.end_ns), now

    def set_speed(self, speed: float, now: float) -> None:
        """Play at another speed, within limits; anything but a positive number changes nothing."""
        if speed > 0.0 and not math.isinf(speed):
            self.move_to(self.time_ns(now), now)
            self._speed = min(max(speed, SLOWEST), FASTEST)

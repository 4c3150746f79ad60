"""The clock of a playback: it waits for whoever plays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

MOST_LATE_S: Final = 0.15
"""What passes from one turn to the next, at most; viewers take what is played in that time at once."""


class Pace:
    """Seconds by which a log is played, turn by turn.

    A turn that comes late finds that little more has passed than in time: the playback falls behind, and no
    turn has more to do than viewers take.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        """Begin the first turn."""
        self._clock = clock
        self._behind_s = 0.0
        self._turn = clock()

    def now(self) -> float:
        """What has passed by now."""
        return self._at(self._clock())

    def next_turn(self) -> float:
        """Begin another turn; the seconds that the last one took, at most `MOST_LATE_S`."""
        read = self._clock()
        now = self._at(read)
        lasted_s = now - self._turn
        self._behind_s, self._turn = read - now, now
        return lasted_s

    def _at(self, read: float) -> float:
        return min(read - self._behind_s, self._turn + MOST_LATE_S)

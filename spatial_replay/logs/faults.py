"""What was lost while reading, in words: the first ones in full, the others counted."""

from __future__ import annotations

import re
from collections.abc import Sequence

KEPT_IN_FULL = 100
"""How many faults of one log are told one by one."""

_MORE = re.compile(r"… and (\d+) more faults? of")


def count_of(faults: Sequence[str]) -> int:
    """How many faults are told, those among them that a last line only counts."""
    uncounted = _MORE.match(faults[-1]) if faults else None
    return len(faults) + (int(uncounted[1]) - 1 if uncounted else 0)


class FaultList:
    """Faults as they are found; `take` hands over those that nobody has taken yet."""

    def __init__(self) -> None:
        self._count = 0
        self._moved = 0
        self._waiting: list[str] = []

    def __len__(self) -> int:
        return self._count

    def add(self, fault: str) -> None:
        self._count += 1
        if self._count <= KEPT_IN_FULL:
            self._waiting.append(fault)

    def move_to(self, other: FaultList) -> None:
        """Hand over to another list what nobody has taken yet, counted as here."""
        for fault in self.take():
            other.add(fault)
        beyond = max(0, self._count - KEPT_IN_FULL)
        other._count += beyond - self._moved
        self._moved = beyond

    def take(self, *, last: bool = False) -> tuple[str, ...]:
        """The faults since the last call; with `last`, a line that counts those beyond the limit."""
        taken, self._waiting = self._waiting, []
        if last and self._count > KEPT_IN_FULL:
            more = self._count - KEPT_IN_FULL
            taken.append(f"… and {more} more fault{'s' if more > 1 else ''} of this kind or another")
        return tuple(taken)

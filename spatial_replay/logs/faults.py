"""What was lost while reading, in words: the first ones in full, the others counted."""

from __future__ import annotations

KEPT_IN_FULL = 100
"""How many faults of one log are told one by one."""


class FaultList:
    """Faults as they are found; `take` hands over those that nobody has taken yet."""

    def __init__(self) -> None:
        self._count = 0
        self._waiting: list[str] = []

    def __len__(self) -> int:
        return self._count

    def add(self, fault: str) -> None:
        self._count += 1
        if self._count <= KEPT_IN_FULL:
            self._waiting.append(fault)

    def take(self, *, last: bool = False) -> tuple[str, ...]:
        """The faults since the last call; with `last`, a line that counts those beyond the limit."""
        taken, self._waiting = self._waiting, []
        if last and self._count > KEPT_IN_FULL:
            taken.append(f"… and {self._count - KEPT_IN_FULL} more faults of this kind or another")
        return tuple(taken)

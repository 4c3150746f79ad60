"""What viewers want of a session, until its thread gets to it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

from spatial_replay.errors import UsageError
from spatial_replay.replay.tuning import Tuned

Values = dict[str, float | str]
"""Numbers and, as texts, durations, by the names of constants."""

OVER: Final = "the server is stopping"


@dataclass(frozen=True)
class Question:
    """Something to be worked out from the present evaluation, and where the answer goes."""

    work: Callable[[Tuned], Any]
    answer: Future[Any] = field(default_factory=Future)

    def settle(self, tuned: Tuned) -> None:
        """Work it out, unless it comes too late."""
        if self.answer.done():
            return
        with suppress(InvalidStateError):  # it was refused meanwhile
            try:
                self.answer.set_result(self.work(tuned))
            except Exception as error:
                self.answer.set_exception(error)

    def refuse(self) -> None:
        """Say that it comes too late, also if it is being worked out."""
        with suppress(InvalidStateError):
            self.answer.set_exception(UsageError(OVER))


@dataclass
class Wishes:
    """What has been asked for and is not done yet; of several of a kind the last one counts.

    Attributes:
        values: those of the constants that differ from what is written, if they are to change.
        is_steered: whether to play, pause or change the speed.
        sought_ns: another time to go to.
        topics: which topics somebody has subscribed to.
        stop: whether the session is to end.
    """

    values: Values | None = None
    is_steered: bool = False
    sought_ns: int | None = None
    topics: set[str] = field(default_factory=set)
    stop: bool = False

    def __bool__(self) -> bool:
        return self != Wishes()

"""Requests of viewers: pending ones for the player's thread, and questions for a thread of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from queue import SimpleQueue
from threading import Lock
from typing import Any, Final, TypeVar

from spatial_replay.errors import UsageError
from spatial_replay.replay.loaded_log import EditedFiles, Evaluated

Values = Mapping[str, float | str]
"""Numbers and, as texts, durations, by the names of constants."""

MOST_OPEN: Final = 8
"""The most questions that may be open at once."""

_Answer = TypeVar("_Answer")


@dataclass
class PendingRequests:
    """Requests that were made and are not done yet; of several of a kind the last one counts.

    Attributes:
        edited: the specifications with other constants, if those are to change.
        is_controlled: whether to play, pause or change the speed.
        seek_ns: another time to go to.
        topics: topics that were subscribed to.
        arrow: the title of the result to point at, if that is to change.
        stop: whether the session is to end.
    """

    edited: EditedFiles | None = None
    is_controlled: bool = False
    seek_ns: int | None = None
    topics: set[str] = field(default_factory=set)
    arrow: str | None = None
    stop: bool = False

    def __bool__(self) -> bool:
        return self != PendingRequests()


class Questions:
    """Answer one question after the other, on a thread of its own, so that no playback waits for them."""

    def __init__(self, wait_for_evaluation: Callable[[], Evaluated]) -> None:
        """Begin without a question.

        Args:
            wait_for_evaluation: returns what is shown; see `Session.wait_for_evaluation`.
        """
        self._wait_for_evaluation = wait_for_evaluation
        self._waiting: SimpleQueue[_Question | None] = SimpleQueue()
        self._open: list[_Question] = []
        self._changing = Lock()
        self._is_over = False

    def ask(self, work: Callable[[Evaluated], _Answer]) -> _Answer:
        """Compute something from what is shown now, in turn; what `work` raises is raised here.

        Raises:
            UsageError: too many questions are open, or the session is over.
        """
        question = _Question(work, self._wait_for_evaluation())
        with self._changing:
            if self._is_over:
                raise session_over()
            if len(self._open) >= MOST_OPEN:
                raise UsageError(f"{MOST_OPEN} questions are open already; ask again when they are answered")
            self._open.append(question)
            self._waiting.put(question)
        answer: _Answer = question.answer.result()
        return answer

    def run(self) -> None:
        """Answer questions until `stop`."""
        while (question := self._waiting.get()) is not None:
            question.settle()
            with self._changing:
                self._open.remove(question)

    def stop(self) -> None:
        """Refuse all open questions, and any more."""
        with self._changing:
            self._is_over = True
            for question in self._open:
                question.refuse()
            self._waiting.put(None)


def session_over() -> UsageError:
    """Return the error of a request that comes too late."""
    return UsageError("the server is stopping")


@dataclass(frozen=True, eq=False)
class _Question:
    """Something to compute from an evaluation, and the place for the answer."""

    work: Callable[[Evaluated], Any]
    evaluated: Evaluated
    answer: Future[Any] = field(default_factory=Future)

    def settle(self) -> None:
        """Compute the answer, unless it was refused."""
        if self.answer.done():
            return
        # it may be refused while it is computed
        with suppress(InvalidStateError):
            try:
                self.answer.set_result(self.work(self.evaluated))
            except Exception as error:
                self.answer.set_exception(error)

    def refuse(self) -> None:
        """Answer that it comes too late, also if it is being computed."""
        with suppress(InvalidStateError):
            self.answer.set_exception(session_over())

"""Questions that take long, answered apart from what is shown."""

from __future__ import annotations

from collections.abc import Callable
from queue import SimpleQueue
from threading import Lock
from typing import Final, TypeVar

from spatial_replay.errors import UsageError
from spatial_replay.replay.tuning import Tuned
from spatial_replay.runs.live.session import Session
from spatial_replay.runs.live.wishes import OVER, Question

MOST_OPEN: Final = 8

_Answer = TypeVar("_Answer")


class Questions:
    """Answers one question after the other, on a thread of its own, so that nobody who looks waits for it."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._waiting: SimpleQueue[tuple[Question, Tuned] | None] = SimpleQueue()
        self._open: list[Question] = []
        self._changing = Lock()
        self._is_over = False

    def ask(self, work: Callable[[Tuned], _Answer]) -> _Answer:
        """Work something out from what is shown now, in turn; what `work` raises is raised here.

        Raises:
            UsageError: too many questions are open, or the session is over.
        """
        question = Question(work)
        tuned = self._session.ask(lambda tuned: tuned)
        with self._changing:
            if self._is_over:
                raise UsageError(OVER)
            if len(self._open) >= MOST_OPEN:
                raise UsageError(f"{MOST_OPEN} questions are open already; ask again when they are answered")
            self._open.append(question)
            self._waiting.put((question, tuned))
        answer: _Answer = question.answer.result()
        return answer

    def run(self) -> None:
        """Answer what is asked until `stop`."""
        while (next_one := self._waiting.get()) is not None:
            question, tuned = next_one
            question.settle(tuned)
            with self._changing:
                self._open.remove(question)

    def stop(self) -> None:
        """Leave no question open, and take no more."""
        with self._changing:
            self._is_over = True
            for question in self._open:
                question.refuse()
            self._waiting.put(None)

"""Questions that take long, answered apart from what is shown."""

from __future__ import annotations

from collections.abc import Callable
from queue import Full, Queue
from threading import Lock
from typing import Final, TypeVar

from spatial_replay.errors import UsageError
from spatial_replay.replay.tuning import Tuned
from spatial_replay.runs.live.session import Session
from spatial_replay.runs.live.wishes import OVER, Question

_MOST_WAITING: Final = 8

_Answer = TypeVar("_Answer")


class Questions:
    """Answers one question after the other, on a thread of its own, so that nobody who looks waits for it."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._waiting: Queue[tuple[Question, Tuned] | None] = Queue(_MOST_WAITING)
        self._asking = Lock()
        self._is_over = False

    def ask(self, work: Callable[[Tuned], _Answer]) -> _Answer:
        """Work something out from what is shown now, in turn; what `work` raises is raised here.

        Raises:
            UsageError: too many questions are waiting, or the session is over.
        """
        question = Question(work)
        tuned = self._session.ask(lambda tuned: tuned)
        with self._asking:
            if self._is_over:
                raise UsageError(OVER)
            try:
                self._waiting.put_nowait((question, tuned))
            except Full:
                raise UsageError(
                    f"{_MOST_WAITING} questions are waiting already; ask again when they are answered"
                ) from None
        answer: _Answer = question.answer.result()
        return answer

    def run(self) -> None:
        """Answer what is asked until `stop`."""
        while (next_one := self._waiting.get()) is not None:
            question, tuned = next_one
            question.settle(tuned)

    def stop(self) -> None:
        """Leave no question open but the one that is worked on, and take no more."""
        with self._asking:
            self._is_over = True
            while not self._waiting.empty():
                if (next_one := self._waiting.get_nowait()) is not None:
                    next_one[0].refuse()
            self._waiting.put_nowait(None)

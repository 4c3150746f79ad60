"""Work that the end of the process does not wait for."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread


def in_background(work: Callable[[], None], name: str) -> Future[None]:
    """Do something on a thread of its own; whoever waits for it is told how it ended."""
    ended: Future[None] = Future()

    def run() -> None:
        try:
            work()
        except BaseException as error:
            ended.set_exception(error)
        else:
            ended.set_result(None)

    Thread(target=run, name=name, daemon=True).start()
    return ended

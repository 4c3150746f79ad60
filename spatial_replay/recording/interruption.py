"""Interruptions that come when nothing is half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

TERMINATED = 128 + signal.SIGTERM
"""The exit code of a process that ended because of SIGTERM, as a shell tells it."""


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold SIGINT and SIGTERM back for a while; one that came then does what it does without this.

    Signals that are ignored, or end the process at once, stay as they are; so do all outside the main thread,
    which alone may handle them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    came: list[int] = []
    for number, handler in handlers.items():
        if callable(handler):
            signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if callable(handler):
                signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])


@contextmanager
def leaving(output: Path) -> Iterator[None]:
    """Note on an interruption that ends the block where the shorter log is."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        interruption.add_note(
            f"{output} holds what was recorded until then, and says that it was interrupted"
        )
        raise


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM raise SystemExit for a while, so that what is open is closed before the process ends.

    A program that handles or ignores SIGTERM, before or meanwhile, keeps its own way; outside the main
    thread, nothing changes.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, _leave)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGTERM) is _leave:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(TERMINATED)

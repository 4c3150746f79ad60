"""Handling of signals during a recording: a program closes its log, or finishes a step, before it ends."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

TERMINATED = 128 + signal.SIGTERM
"""Exit code that shells report for a process that SIGTERM ended."""


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay SIGINT and SIGTERM during the block; the first signal that arrived is raised after the block.

    Ignored signals and signals without a handler are not delayed. Outside the main thread nothing is delayed,
    because Python handles signals only in the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # the default and ignoring "handlers" are constants, which are not callable
    handlers = {
        signal_number: signal.getsignal(signal_number) for signal_number in (signal.SIGINT, signal.SIGTERM)
    }
    arrived_signals: list[int] = []
    for signal_number, handler in handlers.items():
        if callable(handler):
            # an exception in the handler would leave a partial record
            signal.signal(signal_number, lambda arrived_number, _: arrived_signals.append(arrived_number))
    try:
        yield
    finally:
        for signal_number, handler in handlers.items():
            if callable(handler):
                signal.signal(signal_number, handler)
    if arrived_signals:
        signal.raise_signal(arrived_signals[0])


@contextmanager
def leaving(output: Path) -> Iterator[None]:
    """Add to a KeyboardInterrupt the note that the shorter log can be used."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        interruption.add_note(
            f"{output} holds the samples up to the interruption, and is marked as interrupted"
        )
        raise


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM raise SystemExit during the block, so that logs are closed before the process ends.

    A handler of the program, installed before or during the block, takes precedence. Outside the main thread
    the block has no effect.
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


def _leave(signal_number: int, frame: FrameType | None) -> None:
    raise SystemExit(TERMINATED)

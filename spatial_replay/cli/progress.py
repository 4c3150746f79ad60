"""A progress bar for people, nothing for pipes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Timer
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

PATIENCE_S = 1.0
"""Work that is done within this time shows no bar."""
COMPILING = "compiling, once on this machine"
"""What a bar says while the first run on a machine waits for the compiler."""

Advance = Callable[[int], None]


@contextmanager
def progress(label: str, total: int | None = None) -> Iterator[Advance]:
    """Show how far some work is: `with progress("reading", len(items)) as advance: ... advance(1)`.

    The bar goes to standard error if that is a terminal, once the work has taken a second, and is
    gone when the work is done. While code is compiled, it says so instead.

    Args:
        total: how many steps there are; None if nobody knows.
    """
    if not sys.stderr.isatty():
        yield lambda steps: None
        return
    # who has work for a bar has work for the numerical libraries
    from spatial_replay.compiled import compilations

    bar = _Bar(label, total)
    try:
        with compilations(bar.tell_compiling):
            yield bar.advance
    finally:
        bar.close()


class _Bar:
    """A bar that appears after `PATIENCE_S`, even if no step has been done by then.

    The first steps may be long in coming: kernels are compiled before them where no cache holds them.
    """

    def __init__(self, label: str, total: int | None) -> None:
        self._label = self._told = label
        self._total = total
        self._done = 0
        self._shown: Progress | None = None
        self._timer = Timer(PATIENCE_S, self._appear)
        self._timer.daemon = True
        self._timer.start()

    def advance(self, steps: int) -> None:
        self._done += steps
        self._told = self._label
        self._update()

    def tell_compiling(self) -> None:
        """Say that code is compiled, until the next step is done."""
        self._told = COMPILING
        self._update()

    def _update(self) -> None:
        if self._shown is not None:
            self._shown.update(self._shown.task_ids[0], description=self._told, completed=self._done)

    def _appear(self) -> None:
        self._shown = _started(self._told, self._total, self._done)

    def close(self) -> None:
        self._timer.cancel()
        # it may just be putting up the bar
        self._timer.join()
        if self._shown is not None:
            self._shown.stop()


def _started(label: str, total: int | None, done: int) -> Progress:
    # rich takes a quarter of the time in which `--help` must answer
    from rich.console import Console
    from rich.progress import Progress

    shown = Progress(console=Console(stderr=True), transient=True)
    shown.add_task(label, total=total, completed=done)
    shown.start()
    return shown

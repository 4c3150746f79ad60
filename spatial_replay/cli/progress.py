"""A progress bar on terminals."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Timer
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

PATIENCE_S = 1.0
"""Shorter work shows no bar."""
COMPILING = "compiling, once on this machine"
"""Label of a bar while kernels are compiled."""

_NOTEBOOK = "JPY_PARENT_PID"
"""What kernels of notebooks set for the programs that their cells run."""

Advance = Callable[[int], None]


@contextmanager
def progress(label: str, total: int | None = None) -> Iterator[Advance]:
    """Show the progress of some work: `with progress("reading", len(items)) as advance: ... advance(1)`.

    The bar appears on standard error, if that is a terminal, once the work has taken a second. It is removed
    at the end of the work. While kernels are compiled, its label says so. A cell of a notebook shows none,
    though it runs `!spatial-replay …` on a terminal.

    Args:
        total: number of steps; None if it is not known.
    """
    if not sys.stderr.isatty() or _NOTEBOOK in os.environ:
        yield lambda steps: None
        return
    # imports the compiler, which all work that is worth a bar needs anyway
    from spatial_replay.compiled import compilations

    bar = _Bar(label, total)
    try:
        with compilations(bar.show_compiling):
            yield bar.advance
    finally:
        bar.close()


class _Bar:
    """A bar that appears after `PATIENCE_S`, even if no step has been done by then.

    A timer shows it: the first step may take long, because kernels are compiled before it.
    """

    def __init__(self, label: str, total: int | None) -> None:
        self._label = self._description = label
        self._total = total
        self._done = 0
        self._shown: Progress | None = None
        self._timer = Timer(PATIENCE_S, self._appear)
        self._timer.daemon = True
        self._timer.start()

    def advance(self, steps: int) -> None:
        self._done += steps
        self._description = self._label
        self._update()

    def show_compiling(self) -> None:
        """Change the label until the next step is done."""
        self._description = COMPILING
        self._update()

    def _update(self) -> None:
        if self._shown is not None:
            self._shown.update(self._shown.task_ids[0], description=self._description, completed=self._done)

    def _appear(self) -> None:
        # there is one bar at a time: that of the work as a whole
        self._shown = _started(self._description, self._total, self._done)
        # the work went on while the bar was made
        self._update()

    def close(self) -> None:
        self._timer.cancel()
        # the timer may be showing the bar right now
        self._timer.join()
        if self._shown is not None:
            self._shown.stop()


def _started(label: str, total: int | None, done: int) -> Progress | None:
    # importing rich would take a quarter of the time of `--help`
    from rich.console import Console
    from rich.errors import LiveError
    from rich.progress import Progress

    shown = Progress(console=Console(stderr=True), transient=True)
    shown.add_task(label, total=total, completed=done)
    try:
        shown.start()
    except LiveError:
        return None
    return shown

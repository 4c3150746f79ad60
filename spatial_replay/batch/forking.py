"""Processes that are copies of one that has imported everything already."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Sequence
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext


def forking_context(modules: Sequence[str]) -> ForkServerContext:
    """Start the process that others are copies of, with Ctrl-C blocked, which all of them inherit.

    Ctrl-C goes to all processes of a terminal; the first one decides.

    Args:
        modules: imported by that process, if it is not there yet.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*modules])
    # it unblocks Ctrl-C itself when it starts
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context

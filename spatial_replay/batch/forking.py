"""Fork server that imports all modules once, and then forks workers."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Sequence
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext


def forking_context(modules: Sequence[str]) -> ForkServerContext:
    """Start the fork server with SIGINT blocked, and return its context.

    Workers inherit the blocked signal: Ctrl-C reaches all processes of a terminal, and only the parent
    handles it.

    Args:
        modules: modules that the server imports. A running server imports no further modules.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*modules])
    # the resource tracker starts before SIGINT is blocked, because its start unblocks SIGINT
    resource_tracker.ensure_running()
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
    return context

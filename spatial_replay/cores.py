"""Work shared among the processor's cores."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def over_cores(
    used: Callable[..., object], run: Callable[[int, int], object], count: int, least: int
) -> None:
    """Call `run(begin, end)` for shares that make up range(count), each share on a core of its own.

    Args:
        used: the long kernel that `run` calls; all is one share until it is compiled.
        least: the least length of a share, which takes at least about a millisecond.
    """
    shares = min(cores(), count // max(least, 1)) if getattr(used, "is_compiled", False) else 1
    if shares < 2:
        run(0, count)
        return
    ends = [count * share // shares for share in range(shares + 1)]
    with ThreadPoolExecutor(shares - 1) as threads:
        others = [threads.submit(run, begin, end) for begin, end in pairwise(ends[1:])]
        run(0, ends[1])
        for each in others:
            each.result()

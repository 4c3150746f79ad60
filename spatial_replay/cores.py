"""Work shared among the processor's cores.

As many threads work as there are cores, with the one that hands work out: more of them would take the
interpreter's lock from each other, and leave cores idle while they do. So no thread waits for work that has
not begun: the one that needs its result does it, or, while another is at it, some of the work that waits.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache, partial
from typing import Any, Generic, TypeAlias, TypeVar

_Result = TypeVar("_Result")
_Waiting: TypeAlias = "list[tuple[Callable[[], _Result], Future[_Result]]]"
"""What to do, and where its result goes; empty once a thread has begun."""

_MOST_THREADS = 7
"""More would wait for the one that hands work out."""


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Work(Generic[_Result]):
    """Something to do, on another thread or on the one that cannot go on without it."""

    def __init__(self, run: Callable[[], _Result], *, waits: bool = False) -> None:
        """Hand it out.

        Args:
            waits: it may wait for other work, or for what is not on this machine, so no thread does it in
                between: only one that has nothing else to do, or that needs it.
        """
        self._result = Future[_Result]()
        self._waiting = [(run, self._result)]
        _threads().hand_out(self._waiting, waits=waits)

    @property
    def is_done(self) -> bool:
        """Whether there is a result, or an error."""
        return self._result.done()

    def result(self) -> _Result:
        """Return the result, or raise the error, once it is done."""
        _do(self._waiting)
        while not self.is_done and _threads().do_one():
            pass
        return self._result.result()


def drop(works: Iterable[Work[Any]]) -> None:
    """Have no thread begin with work, and wait until none is at it; it has no result unless it was done."""
    dropped = list(works)
    for work in dropped:
        with suppress(IndexError):
            _, result = work._waiting.pop()
            result.cancel()
    for work in dropped:
        if not work._result.cancelled():
            work._result.exception()


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
    others = [Work(partial(run, *ends[share : share + 2])) for share in range(1, shares)]
    try:
        run(0, ends[1])
    except BaseException:
        drop(others)
        raise
    for each in others:
        each.result()


class _Threads:
    """The threads of this process that do what others hand out."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(min(max(cores() - 1, 1), _MOST_THREADS), "sharing")
        self._short: deque[_Waiting[Any]] = deque()
        self._long: deque[_Waiting[Any]] = deque()

    def hand_out(self, waiting: _Waiting[Any], *, waits: bool) -> None:
        (self._long if waits else self._short).append(waiting)
        # while the interpreter ends, no thread takes anything any more: then the one that needs it does it
        with suppress(RuntimeError):
            self._threads.submit(self._do_any)

    def do_one(self) -> bool:
        """Do on this thread the first that waits for nothing itself; return whether there is any."""
        return _do_first(self._short)

    def _do_any(self) -> None:
        if not self.do_one():
            _do_first(self._long)


@cache
def _threads() -> _Threads:
    return _Threads()


if hasattr(os, "register_at_fork"):
    # a process that is forked has none of the threads
    os.register_at_fork(after_in_child=_threads.cache_clear)


def _do_first(several: deque[_Waiting[Any]]) -> bool:
    """Do the first with which no thread has begun; return whether there is any."""
    with suppress(IndexError):
        while not _do(several.popleft()):
            pass
        return True
    return False


def _do(waiting: _Waiting[Any]) -> bool:
    """Do what waits, unless a thread has begun with it; return whether it was done."""
    try:
        run, result = waiting.pop()
    except IndexError:
        return False
    try:
        result.set_result(run())
    except Exception as error:
        result.set_exception(error)
    except BaseException as error:
        # an interruption is for the thread that it came to, too
        result.set_exception(error)
        raise
    return True

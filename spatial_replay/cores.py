"""Work shared among the processor's cores.

As many threads work as there are cores, with the one that hands work out: more of them would take the
interpreter's lock from each other, and leave cores idle while they do. So no thread waits for work that has
not begun: the one that needs its result does it, or, while another is at it, some of its own work that waits.

The main thread may be interrupted between any two steps (Ctrl-C). What it has begun then has an outcome all
the same, or begins again elsewhere; no thread waits for it forever, and nothing that others have handed out
is touched.
"""

from __future__ import annotations

import atexit
import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError
from contextlib import suppress
from functools import cache, partial
from queue import SimpleQueue
from threading import Lock, Thread, get_ident
from typing import Any, Final, Generic, TypeAlias, TypeVar, cast

_Result = TypeVar("_Result")
_Claim: TypeAlias = tuple[int]
"""The thread that does the work, or 0 for none; compared by identity."""

_MOST_THREADS: Final = 7
"""More would wait for the one that hands work out."""


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Work(Generic[_Result]):
    """Something to do, by another thread or by the one that cannot go on without it."""

    def __init__(self, run: Callable[[], _Result], *, waits: bool = False) -> None:
        """Prepare it; `hand_out` is apart, so that what has to drop it can know it before it begins.

        Args:
            waits: it may wait for other work, or for another machine, so threads take it when there is no
                other; nor may it be repeated, as all else may that was interrupted.
        """
        self.waits = waits
        self._run = run
        self._claims: dict[str, _Claim] = {}
        self._outcome: tuple[_Result | None, BaseException | None] | None = None
        self._waiters: list[Any] = []

    @property
    def is_done(self) -> bool:
        """Whether there is a result, or an error."""
        return self._outcome is not None

    def hand_out(self) -> None:
        """Let other threads do it."""
        _pool().take(self)

    def result(self) -> _Result:
        """Return the result, or raise the error, once it is done.

        Raises:
            CancelledError: it was dropped.
        """
        self.do()
        self.wait()
        value, error = cast("tuple[_Result, BaseException | None]", self._outcome)
        if error is not None:
            raise error
        return value

    def do(self) -> bool:
        """Do it on this thread, unless a thread has begun; return whether it was done."""
        if self._claims:
            return False
        _pool().forget(self)
        return self.do_taken()

    def do_taken(self) -> bool:
        """Do what is in no line any more; see `do`."""
        claim = (get_ident(),)
        try:
            if self._claims.setdefault("", claim) is not claim:
                return False
            self._settle(self._run(), None)
        except BaseException as error:
            if self._claims.get("") is not claim:
                raise
            if not isinstance(error, Exception) and not self.waits and self._outcome is None:
                self._claims.clear()
                self.hand_out()
                raise
            self._settle(None, error)
            if not isinstance(error, Exception):
                raise
        return True

    def wait(self) -> None:
        """Wait until it is over."""
        own = Lock()
        own.acquire()
        self._waiters.append(own)
        if self._outcome is None:
            own.acquire()

    def refuse(self) -> None:
        """Have no thread begin with it; what this one has begun, and was kept from ending, is over."""
        claim = self._claims.setdefault("", (0,))
        if claim[0] in (0, get_ident()):
            self._settle(None, CancelledError("the work was dropped"))
            _pool().forget(self)

    def _settle(self, value: _Result | None, error: BaseException | None) -> None:
        if self._outcome is None:
            self._outcome = value, error
        # what it holds is not needed any more
        self._run = cast(Any, None)
        with suppress(IndexError):
            while True:
                self._waiters.pop().release()


def first_result(works: Iterable[Work[_Result]]) -> _Result:
    """Return the result of the first; as long as another thread is at it, do the others on this one."""
    first, *others = works
    first.do()
    for work in others:
        if first.is_done:
            break
        work.do()
    return first.result()


def drop(works: Iterable[Work[Any]]) -> None:
    """Have no thread begin with work, and wait until no other is at it."""
    dropped = list(works)
    for work in dropped:
        work.refuse()
    for work in dropped:
        work.wait()


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
        for each in others:
            each.hand_out()
        run(0, ends[1])
        for each in others:
            each.result()
    finally:
        drop(others)


class _Pool:
    """The threads of this process that do what others hand out."""

    def __init__(self) -> None:
        # taken from in one step each, so that an interruption leaves nothing locked
        self._calls: SimpleQueue[bool] = SimpleQueue()
        self._short: deque[Work[Any]] = deque()
        self._long: deque[Work[Any]] = deque()
        count = min(max(cores() - 1, 1), _MOST_THREADS)
        self._threads = [Thread(target=self._do_all, name="sharing", daemon=True) for _ in range(count)]
        for thread in self._threads:
            thread.start()
        atexit.register(self._end)

    def take(self, work: Work[Any]) -> None:
        (self._long if work.waits else self._short).append(work)
        self._calls.put(True)

    def forget(self, work: Work[Any]) -> None:
        """Keep no work whose result somebody has."""
        with suppress(ValueError):
            (self._long if work.waits else self._short).remove(work)

    def _do_all(self) -> None:
        while self._calls.get():
            # errors are those of the work, and raised where its result is needed
            with suppress(BaseException):
                self._do_one()

    def _do_one(self) -> None:
        for works in (self._short, self._long):
            with suppress(IndexError):
                while not works.popleft().do_taken():
                    pass
                return

    def _end(self) -> None:
        for _ in self._threads:
            self._calls.put(False)
        for thread in self._threads:
            thread.join()


@cache
def _pool() -> _Pool:
    return _Pool()


if hasattr(os, "register_at_fork"):
    # a process that is forked has none of the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)

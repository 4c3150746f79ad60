"""Processes that work on many tasks: on this machine, or on a Dask cluster.

Both take a function and tasks and yield results as they come. A worker that dies takes no other task with it:
its task runs again once, and then its result says so. There is no scheduler here: processes are those of
`concurrent.futures`, clusters are Dask's.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from itertools import islice
from multiprocessing.connection import Connection
from typing import Any, Final, Protocol, TypeAlias, TypeVar, cast

from spatial_replay.batch.forking import forking_context
from spatial_replay.errors import ClusterError, UsageError, importing
from spatial_replay.recording.interruption import uninterrupted

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")

Progress: TypeAlias = Callable[[str, int | None], AbstractContextManager[Callable[[int], None]]]
"""Shows work: takes a label and the number of steps, and yields what is called with the steps done."""

_AHEAD: Final = 2
"""Tasks for each process that are handed out at once, so that none has to wait for its next."""
_PRELOADED: Final = "spatial_replay.batch.run"
"""Imported once, by the process that all workers are copies of."""
_PATIENCE_S: Final = 10
"""How long no task of a cluster ends before its lack of workers is said."""
_ANSWER_S: Final = 15
"""How long the scheduler of a cluster has to answer."""


def no_progress(label: str, total: int | None) -> AbstractContextManager[Callable[[int], None]]:
    """Show nothing."""
    return nullcontext(lambda steps: None)


class WorkerLost(Exception):  # noqa: N818 - a result, not raised by this module
    """The result of a task whose worker died twice while it worked on it."""


class Workers(Protocol):
    """Executor of tasks."""

    def results(
        self, work: Callable[[_Task], _Result], tasks: Iterable[_Task]
    ) -> Iterator[tuple[_Task, _Result | WorkerLost]]:
        """Yield each task with its result, in any order; what `work` raises is raised."""


class ThisProcess:
    """Works on one task after the other, in this process."""

    def results(
        self, work: Callable[[_Task], _Result], tasks: Iterable[_Task]
    ) -> Iterator[tuple[_Task, _Result | WorkerLost]]:
        """See `Workers.results`."""
        for task in tasks:
            yield task, work(task)


class LocalProcesses:
    """Works in several processes on this machine; they end with this one, however that ends."""

    def __init__(self, count: int) -> None:
        self._count = count

    def results(
        self, work: Callable[[_Task], _Result], tasks: Iterable[_Task]
    ) -> Iterator[tuple[_Task, _Result | WorkerLost]]:
        """See `Workers.results`."""
        rest = iter(tasks)
        while True:
            suspects: list[_Task] = []
            with _pool(self._count, suspects) as pool:
                yield from _results(pool, work, rest, self._count * _AHEAD, suspects)
            if not suspects:
                return
            # one of them ended its process, so each gets one for itself
            for task in suspects:
                again: list[_Task] = []
                with _pool(1, again) as pool:
                    yield from _results(pool, work, iter([task]), 1, again)
                if again:
                    yield task, WorkerLost(f"its process ended while it was evaluated by itself{_MEMORY}")


_MEMORY: Final = "; is there memory enough for it?"


def _results(
    pool: Executor,
    work: Callable[[_Task], _Result],
    tasks: Iterator[_Task],
    ahead: int,
    suspects: list[_Task],
) -> Iterator[tuple[_Task, _Result]]:
    """Yield results until the tasks end, or the pool breaks: then `suspects` gets the tasks it had."""
    waiting: dict[Future[_Result], _Task] = {}
    is_whole = True
    while True:
        for task in islice(tasks, ahead - len(waiting) if is_whole else 0):
            try:
                # a process that is half started could not be ended
                with uninterrupted():
                    waiting[pool.submit(work, task)] = task
            except BrokenProcessPool:
                is_whole = False
                suspects.append(task)
                break
        if not waiting:
            return
        for future in wait(waiting, return_when=FIRST_COMPLETED).done:
            task = waiting.pop(future)
            try:
                result = future.result()
            except BrokenProcessPool:
                is_whole = False
                suspects.append(task)
                continue
            yield task, result


@contextmanager
def _pool(count: int, suspects: Sequence[object]) -> Iterator[Executor]:
    """Start processes; they are ended at once when the block ends early, or with suspects."""
    context = forking_context([_PRELOADED])
    others = set(multiprocessing.active_children())
    ours, theirs = multiprocessing.Pipe(duplex=False)
    try:
        with ProcessPoolExecutor(count, context, _begin_worker, (ours,)) as pool:
            try:
                yield pool
            except BaseException:
                theirs.close()
                pool.shutdown(wait=False, cancel_futures=True)
                # those that are still starting would miss what this process takes away as it ends
                for process in set(multiprocessing.active_children()) - others:
                    process.kill()
                raise
            if suspects:
                # the executor would wait for a process that it was starting as another one died
                theirs.close()
    finally:
        theirs.close()
        ours.close()


def _begin_worker(connection: Connection) -> None:
    """End this process when the other end of the connection is closed, or its process ends."""
    # a server that was there before may not block it
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(connection,), daemon=True).start()


def _end_with(connection: Connection) -> None:
    try:
        connection.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)


class DaskCluster:
    """Works on a Dask cluster, through the executor of its client.

    The cluster's scheduler decides how often the task of a worker that died runs again. Each use has a
    connection of its own: a client that was closed cannot be opened again.
    """

    def __init__(self, address: str, report: Callable[[str], None] = lambda text: None) -> None:
        """Take a scheduler that answers.

        Args:
            address: such as "tcp://scheduler:8786".
            report: takes what a user who waits should know.

        Raises:
            UsageError: Dask is not installed, or no scheduler answers.
        """
        self._address = address
        self._report = report
        with self._connection():
            pass

    def results(
        self, work: Callable[[_Task], _Result], tasks: Iterable[_Task]
    ) -> Iterator[tuple[_Task, _Result | WorkerLost]]:
        """See `Workers.results`.

        Raises:
            UsageError: no scheduler answers.
            ClusterError: it answers no more.
        """
        rest = iter(tasks)
        waiting: dict[Future[_Result], _Task] = {}
        is_reported = False
        with self._connection() as client:
            pool = client.get_executor(pure=False)
            try:
                while self._hand_out(client, pool, work, rest, waiting):
                    finished = wait(waiting, timeout=_PATIENCE_S, return_when=FIRST_COMPLETED).done
                    if not finished and not is_reported and not client.nthreads():
                        self._report(
                            f"--dask {self._address}: the scheduler has no workers, so nothing is evaluated; "
                            f"start some with `dask worker {self._address}`, or stop with Ctrl-C"
                        )
                        is_reported = True
                    for future in finished:
                        task = waiting.pop(future)
                        yield task, self._result(future)
            finally:
                # without waiting for them, as the executor would: its scheduler may be gone
                for future in waiting:
                    future.cancel()

    def _hand_out(
        self,
        client: Any,
        pool: Executor,
        work: Callable[[_Task], _Result],
        tasks: Iterator[_Task],
        waiting: dict[Future[_Result], _Task],
    ) -> bool:
        """Submit as many tasks as keep all workers busy, and return whether any is under way."""
        try:
            ahead = _AHEAD * max(1, sum(client.nthreads().values())) - len(waiting)
            for task in islice(tasks, max(0, ahead)):
                waiting[pool.submit(work, task)] = task
        except (OSError, RuntimeError, ValueError) as error:
            # a connection that is closed has many names
            raise self._scheduler_loss() from error
        return bool(waiting)

    def _result(self, future: Future[Any]) -> Any:
        """Return the result of a task, or that its workers were lost; what its work raised is raised."""
        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker:
            return WorkerLost(f"the workers that evaluated it died{_MEMORY}")
        except CancelledError as error:
            raise self._scheduler_loss() from error

    def _scheduler_loss(self) -> ClusterError:
        return ClusterError(
            f"--dask {self._address}: the scheduler answers no more; the results so far stay, and the same "
            "command goes on from there"
        )

    @contextmanager
    def _connection(self) -> Iterator[Any]:
        """Connect a client, which closes whatever has become of the cluster."""
        with importing("clusters need Dask", extra="cluster"):
            import distributed
        client_type = cast(Any, distributed).Client
        # made before it connects, so that one that cannot is closed here and not when Python ends
        client = client_type.__new__(client_type)
        try:
            client.__init__(self._address, timeout=_ANSWER_S, set_as_default=False)
        except (OSError, ValueError) as error:
            with suppress(OSError, RuntimeError, CancelledError):
                client.close()
            raise UsageError(
                f"--dask {self._address}: no scheduler answers ({str(error).splitlines()[0]:.200}); "
                "start one with `dask scheduler`, and workers with `dask worker`"
            ) from None
        with _silent("distributed.client", "distributed.core", "tornado.application"):
            try:
                yield client
            finally:
                with suppress(OSError, RuntimeError, CancelledError):
                    client.close()


@contextmanager
def _silent(*loggers: str) -> Iterator[None]:
    """Keep loggers from writing tracebacks about what is raised as an error of ours."""
    named_loggers = [logging.getLogger(name) for name in loggers]
    before = [logger.disabled for logger in named_loggers]
    try:
        for logger in named_loggers:
            logger.disabled = True
        yield
    finally:
        for logger, was in zip(named_loggers, before, strict=True):
            logger.disabled = was

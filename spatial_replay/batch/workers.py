"""Processes that work on many tasks: on this machine, or on a Dask cluster.

An executor applies a function to tasks, and yields the results as they arrive. If a worker on this machine
dies, the tasks of its pool run once more, one by one. A task whose worker dies again has the result
`WorkerLost`. `concurrent.futures` and Dask schedule the tasks.
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
"""Progress factory: (label, total) → context manager that yields `advance(steps)`."""

_AHEAD: Final = 2
"""Submitted tasks per process, so that no process waits for its next task."""
_PRELOADED: Final = "spatial_replay.batch.run"
"""Module that the fork server imports once for all workers."""
_PATIENCE_S: Final = 10
"""Idle time of a cluster before its lack of workers is reported, seconds."""
_ANSWER_S: Final = 15
"""Timeout for the scheduler of a cluster, seconds."""


def no_progress(label: str, total: int | None) -> AbstractContextManager[Callable[[int], None]]:
    """Show nothing."""
    return nullcontext(lambda steps: None)


class WorkerLost(Exception):  # noqa: N818 - a result, not raised by this module
    """The result of a task whose workers died."""


class Workers(Protocol):
    """Executor of tasks."""

    def results(
        self, work: Callable[[_Task], _Result], tasks: Iterable[_Task]
    ) -> Iterator[tuple[_Task, _Result | WorkerLost]]:
        """Yield each task with its result, in any order. Errors of `work` are raised."""


class ThisProcess:
    """Works on one task after the other, in this process."""

    def results(
        self, work: Callable[[_Task], _Result], tasks: Iterable[_Task]
    ) -> Iterator[tuple[_Task, _Result | WorkerLost]]:
        """See `Workers.results`."""
        for task in tasks:
            yield task, work(task)


class LocalProcesses:
    """Works in several processes on this machine. They end with this process, even if it is killed."""

    def __init__(self, count: int) -> None:
        self._count = count

    def results(
        self, work: Callable[[_Task], _Result], tasks: Iterable[_Task]
    ) -> Iterator[tuple[_Task, _Result | WorkerLost]]:
        """See `Workers.results`."""
        remaining_tasks = iter(tasks)
        while True:
            suspects: list[_Task] = []
            with _pool(self._count, suspects) as pool:
                yield from _results(pool, work, remaining_tasks, self._count * _AHEAD, suspects)
            if not suspects:
                return
            # one of these tasks killed its process; each runs alone, to find that task
            for task in suspects:
                lost_tasks: list[_Task] = []
                with _pool(1, lost_tasks) as pool:
                    yield from _results(pool, work, iter([task]), 1, lost_tasks)
                if lost_tasks:
                    yield task, WorkerLost(f"its process ended while it was evaluated by itself{_MEMORY}")


_MEMORY: Final = "; is there memory enough for it?"


def _results(
    pool: Executor,
    work: Callable[[_Task], _Result],
    tasks: Iterator[_Task],
    most_pending: int,
    suspects: list[_Task],
) -> Iterator[tuple[_Task, _Result]]:
    """Yield results until the tasks end or the pool breaks.

    Args:
        most_pending: maximum number of submitted tasks.
        suspects: receives the unfinished tasks of a broken pool.
    """
    tasks_by_future: dict[Future[_Result], _Task] = {}
    is_usable = True
    while True:
        # a broken pool gets no further tasks
        for task in islice(tasks, most_pending - len(tasks_by_future) if is_usable else 0):
            try:
                # an interrupted `submit` could leave a process that `_pool` does not find
                with uninterrupted():
                    tasks_by_future[pool.submit(work, task)] = task
            except BrokenProcessPool:
                is_usable = False
                suspects.append(task)
                break
        if not tasks_by_future:
            return
        for future in wait(tasks_by_future, return_when=FIRST_COMPLETED).done:
            task = tasks_by_future.pop(future)
            try:
                result = future.result()
            except BrokenProcessPool:
                is_usable = False
                suspects.append(task)
                continue
            yield task, result


@contextmanager
def _pool(count: int, suspects: Sequence[object]) -> Iterator[Executor]:
    """Start processes, and end them at once if the block raises an error or adds suspects."""
    context = forking_context([_PRELOADED])
    other_processes = set(multiprocessing.active_children())
    receiver, sender = multiprocessing.Pipe(duplex=False)
    try:
        with ProcessPoolExecutor(count, context, _begin_worker, (receiver,)) as pool:
            try:
                yield pool
            except BaseException:
                sender.close()
                pool.shutdown(wait=False, cancel_futures=True)
                # a starting process would fail when this process removes its resources
                for process in set(multiprocessing.active_children()) - other_processes:
                    process.kill()
                raise
            if suspects:
                # otherwise the executor waits for a process that was starting when another process died
                sender.close()
    finally:
        sender.close()
        receiver.close()


def _begin_worker(connection: Connection) -> None:
    """Make this process end when the other end of the connection is closed."""
    # a fork server from another module may not block Ctrl-C
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(connection,), daemon=True).start()


def _end_with(connection: Connection) -> None:
    try:
        connection.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)


class DaskCluster:
    """Works on a Dask cluster, through the executor of its client.

    The scheduler decides how often the task of a dead worker runs again. Each use has a new client, because a
    closed client cannot be reopened.
    """

    def __init__(self, address: str, report: Callable[[str], None] = lambda text: None) -> None:
        """Check that the scheduler answers.

        Args:
            address: address of the scheduler, such as "tcp://scheduler:8786".
            report: receives messages for a waiting user.

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
            ClusterError: the scheduler stopped answering.
        """
        remaining_tasks = iter(tasks)
        tasks_by_future: dict[Future[_Result], _Task] = {}
        is_reported = False
        with self._connection() as client:
            # by default, Dask would give equal calls one shared result
            pool = client.get_executor(pure=False)
            try:
                while self._hand_out(client, pool, work, remaining_tasks, tasks_by_future):
                    finished = wait(tasks_by_future, timeout=_PATIENCE_S, return_when=FIRST_COMPLETED).done
                    if not finished and not is_reported and not client.nthreads():
                        self._report(
                            f"--dask {self._address}: the scheduler has no workers, so nothing is evaluated; "
                            f"start some with `dask worker {self._address}`, or stop with Ctrl-C"
                        )
                        is_reported = True
                    for future in finished:
                        task = tasks_by_future.pop(future)
                        yield task, self._result(future)
            finally:
                # the executor would wait for these tasks, and the scheduler may be gone
                for future in tasks_by_future:
                    future.cancel()

    def _hand_out(
        self,
        client: Any,
        pool: Executor,
        work: Callable[[_Task], _Result],
        tasks: Iterator[_Task],
        tasks_by_future: dict[Future[_Result], _Task],
    ) -> bool:
        """Submit enough tasks to keep all workers busy. Return whether any task is pending."""
        try:
            free_slots = _AHEAD * max(1, sum(client.nthreads().values())) - len(tasks_by_future)
            for task in islice(tasks, max(0, free_slots)):
                tasks_by_future[pool.submit(work, task)] = task
        except (OSError, RuntimeError, ValueError) as error:
            # distributed raises errors of several types for a closed connection
            raise self._scheduler_loss() from error
        return bool(tasks_by_future)

    def _result(self, future: Future[Any]) -> Any:
        """Return the result of a task, or `WorkerLost`. Errors of its work are raised."""
        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker:
            return WorkerLost(f"the workers that evaluated it died{_MEMORY}")
        except CancelledError as error:
            raise self._scheduler_loss() from error

    def _scheduler_loss(self) -> ClusterError:
        return ClusterError(
            f"--dask {self._address}: the scheduler stopped answering; the results so far are stored, "
            "and the same command continues from them"
        )

    @contextmanager
    def _connection(self) -> Iterator[Any]:
        """Connect a client, and close it at the end, even if the cluster is gone."""
        with importing("clusters need Dask", extra="cluster"):
            import distributed
        client_type = cast(Any, distributed).Client
        # `__init__` is a separate step, so that a client that cannot connect is closed here
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
    """Silence loggers with tracebacks of errors that this module raises itself."""
    named_loggers = [logging.getLogger(name) for name in loggers]
    disabled_before = [logger.disabled for logger in named_loggers]
    try:
        for logger in named_loggers:
            logger.disabled = True
        yield
    finally:
        for logger, was_disabled in zip(named_loggers, disabled_before, strict=True):
            logger.disabled = was_disabled

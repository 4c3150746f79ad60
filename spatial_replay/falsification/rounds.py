"""Runs in rounds: cases to workers, their runs to a file, and all of a round back to who asked for them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Generic, TypeAlias, TypeVar

from spatial_replay.batch.workers import WorkerLost, Workers
from spatial_replay.errors import OutputError
from spatial_replay.falsification.failures import SearchedRun
from spatial_replay.falsification.parameters import Case, key_of
from spatial_replay.falsification.run_file import RunFile
from spatial_replay.falsification.simulations import Simulation
from spatial_replay.monitor.evaluate import evaluate
from spatial_replay.monitor.verdict import worst_verdict
from spatial_replay.spec.units import declared_unit

_Result = TypeVar("_Result")

Rounds: TypeAlias = Generator[Sequence[Case], Sequence[SearchedRun], _Result]
"""Yields the cases of a round, and is sent their runs."""


@dataclass(frozen=True, slots=True)
class _Task:
    """A case to simulate; `log` is written if it violates."""

    number: int
    case: Case
    log: Path | None


def simulate_rounds(
    rounds: Rounds[_Result],
    simulation: Simulation,
    workers: Workers,
    file: Path,
    advance: Callable[[int], None],
    logs: Path | None = None,
) -> _Result:
    """Simulate the cases of each round that are not in a file yet, and return what the rounds return.

    Args:
        file: gets a line for each run, in the order of the cases.
        advance: called with the number of runs that are there.
        logs: the folder for the logs of those that violate; None for none.

    Raises:
        LogError: the file is damaged.
        OutputError: a file cannot be written, or a worker died.
    """
    with closing(RunFile(file)) as known:
        queue = _Queue(rounds, known, advance, logs)
        for task, run in workers.results(partial(_simulate, simulation), queue):
            if isinstance(run, WorkerLost):
                raise lost(run)
            queue.take(task, run)
        return queue.result


class _Queue(Generic[_Result]):
    """The tasks of one round after the other: none while runs of a round are missing, more when it is whole.

    An iterator of this kind has an end several times, as workers ask again after each result.

    Attributes:
        result: what the rounds have returned, once the last one is whole.
    """

    result: _Result

    def __init__(
        self, rounds: Rounds[_Result], known: RunFile, advance: Callable[[int], None], logs: Path | None
    ) -> None:
        self._rounds, self._known, self._advance, self._logs = rounds, known, advance, logs
        self._waiting: deque[_Task] = deque()
        self._round: Sequence[Case] = ()
        self._arrived: dict[int, SearchedRun] = {}
        # numbers of the first case of the round, and of the next one whose run is to be written
        self._first = self._next = 1
        self._begin(None)

    def __iter__(self) -> Iterator[_Task]:
        return self

    def __next__(self) -> _Task:
        if not self._waiting:
            raise StopIteration
        return self._waiting.popleft()

    def take(self, task: _Task, run: SearchedRun) -> None:
        """Take the run of a task; runs are written in the order of the tasks, whichever ends first."""
        self._arrived[task.number] = run
        self._write()
        if all(case in self._known for case in self._round):
            self._begin([self._of(case) for case in self._round])

    def _begin(self, runs: Sequence[SearchedRun] | None) -> None:
        """Begin the next round of which something is not known."""
        while True:
            self._first = self._next = self._first + len(self._round)
            try:
                self._round = next(self._rounds) if runs is None else self._rounds.send(runs)
            except StopIteration as end:
                self._round, self.result = (), end.value
                return
            missing = 0
            for number, case in enumerate(self._round, start=self._first):
                if case not in self._known:
                    missing += 1
                    log = None if self._logs is None else self._logs / f"run-{number:04d}.mcap"
                    self._waiting.append(_Task(number, case, log))
            self._advance(len(self._round) - missing)
            if missing:
                return
            runs = [self._of(case) for case in self._round]

    def _write(self) -> None:
        while self._next < self._first + len(self._round):
            case = self._round[self._next - self._first]
            if case not in self._known:
                if self._next not in self._arrived:
                    return
                self._known.add(self._arrived.pop(self._next))
                self._advance(1)
            self._next += 1

    def _of(self, case: Case) -> SearchedRun:
        run = self._known.get(case)
        assert run is not None
        return run


def _simulate(simulation: Simulation, task: _Task) -> SearchedRun:
    """Simulate and evaluate a case; write its log if it violates."""
    try:
        simulated = simulation.run(task.case)
    except Exception as error:
        error.add_note(f"in the case {key_of(task.case)}")
        raise
    results = [result for file in simulation.files for result in evaluate(file, simulated.trace)]
    worst = min(results, key=lambda result: result.upper)
    verdict = worst_verdict(result.verdict for result in results)
    times_ns = simulated.trace.times_ns
    run = SearchedRun(
        task.number,
        task.case,
        verdict,
        worst.upper,
        worst.title,
        declared_unit(worst.formula, {"": simulated.unit}),
        int(times_ns[-1] - times_ns[0]) / 1e9,
    )
    if run.is_violated and task.log is not None:
        write_whole(simulated.write, task.log)
    return run


def write_whole(write: Callable[[Path], None], log: Path) -> None:
    """Write a log under another name first, so that it is whole or not there."""
    unfinished = log.with_name(f".{log.name}.partial")
    write(unfinished)
    unfinished.replace(log)


def lost(worker: WorkerLost) -> OutputError:
    """Return the error about a worker that died."""
    return OutputError(f"a run could not be simulated: {worker}; the same command goes on from there")

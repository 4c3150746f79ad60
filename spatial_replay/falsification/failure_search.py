"""Search for failing simulated runs; failures are then reduced and cut to clips.

Runs are simulated in rounds. CMA-ES chooses the next cases by the robustness of earlier runs. A repeated
search reads the file of its earlier runs. No other module imports the package `cma`.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import Any, Final, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from spatial_replay.batch.run import meaning_hash, workers_of
from spatial_replay.batch.store import LocalFolder
from spatial_replay.batch.workers import Progress, WorkerLost, Workers, no_progress
from spatial_replay.compare.clips import cut_clip
from spatial_replay.errors import LogError, OutputError, UsageError
from spatial_replay.falsification.simulations import (
    TENTHS,
    Case,
    Parameter,
    Simulation,
    Space,
    key_of,
    own_simulation,
    scenario_simulation,
)
from spatial_replay.lazy import Printed
from spatial_replay.logs.output_file import output_error, refuse_addresses
from spatial_replay.logs.remote import local_copy
from spatial_replay.monitor.result import evaluate
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.replay.selection import DEFAULT_OPTIONS
from spatial_replay.sanity import refuse_constant_results
from spatial_replay.sources.open_log import open_source
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import load_specifications
from spatial_replay.spec.walks import declared_unit
from spatial_replay.text import json_fields, json_number, json_value, named_arguments, plural, with_unit
from spatial_replay.trace.trace import Sample
from spatial_replay.version import __version__

_MOST_FAILURES: Final = 20
"""Maximum number of failures in the text; JSON lists all."""


@dataclass(frozen=True, slots=True)
class SearchedRun:
    """Simulated run.

    Attributes:
        number: number of the run in the search, from 1.
        case: value of each parameter by name; None for a parameter without a value.
        verdict: worst verdict of all specifications.
        robustness: least upper end of all robustness intervals, below 0 if and only if a spec is violated.
        spec: title of the spec with this robustness.
        unit: unit of the robustness; "" if none is declared.
        seconds: duration of the run in simulated time.
    """

    number: int
    case: Case
    verdict: Verdict
    robustness: float
    spec: str
    unit: str
    seconds: float

    @property
    def is_violated(self) -> bool:
        """Whether a specification is violated."""
        return self.verdict is Verdict.VIOLATED

    @property
    def document(self) -> dict[str, Any]:
        """The run as values for JSON."""
        values = json_fields(self)
        return {"run": values.pop("number"), **values}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> SearchedRun:
        """Return a run from its JSON document.

        Raises:
            KeyError, TypeError, ValueError: the document has another form.
        """
        case = {
            str(name): None if value is None else float(value) for name, value in document["case"].items()
        }
        return cls(
            int(document["run"]),
            case,
            Verdict(document["verdict"]),
            float(document["robustness"]),
            str(document["spec"]),
            str(document["unit"]),
            float(document["seconds"]),
        )


@dataclass(frozen=True, slots=True)
class Failure:
    """Run that violates a specification.

    Attributes:
        run: run of the search.
        smaller: run with fewer or smaller variations; `run` itself if nothing can be reduced.
        log, smaller_log: logs of both runs; the same path if nothing can be reduced.
        clip: shortest part of `smaller_log` that shows the violation.
        command: command that records `smaller` as a log; None for a user's simulation.
    """

    run: SearchedRun
    smaller: SearchedRun
    log: Path
    smaller_log: Path
    clip: Path
    command: str | None

    @property
    def is_smaller(self) -> bool:
        """Whether a variation could be reduced."""
        return self.smaller.case != self.run.case


@dataclass(frozen=True, slots=True)
class Coverage:
    """Tried values of one parameter.

    Attributes:
        low, high: range; for a time in a run, `high` is the end of the first run.
        runs: number of runs with a value in each tenth of the range.
        least_robustness: least robustness in each tenth of the range; None without a run.
    """

    parameter: str
    low: float
    high: float
    unit: str
    runs: tuple[int, ...]
    least_robustness: tuple[float | None, ...]


@dataclass(frozen=True, eq=False)
class Falsification(Printed):
    """Result of a search for failures.

    Attributes:
        name: name of the scenario or the simulation.
        parameters: varied parameters.
        runs: all runs in the order of the search; the first run has no variation.
        failures: violating runs, the worst first.
        impossible: number of cases that were skipped because objects would overlap.
        simulations: number of further runs for reducing failures.
        is_exhausted: whether the search ended early because there was no new case.
    """

    name: str
    parameters: tuple[Parameter, ...]
    runs: tuple[SearchedRun, ...]
    failures: tuple[Failure, ...]
    impossible: int
    simulations: int
    is_exhausted: bool

    @property
    def first(self) -> SearchedRun:
        """The run without variations."""
        return self.runs[0]

    @property
    def lowest(self) -> SearchedRun:
        """The run with the least robustness."""
        return min(self.runs, key=lambda run: run.robustness)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all runs."""
        return worst_verdict(run.verdict for run in self.runs)

    @cached_property
    def coverage(self) -> tuple[Coverage, ...]:
        """The tried values of each parameter."""
        return tuple(map(self._coverage_of, self.parameters))

    def text_of(self, case: Case) -> str:
        """Return the variations of a case as text: "noise 0.004 m, slip@3.2s, start.red 0.47,-0.09,0.4"."""
        texts_by_group: dict[str, str] = {}
        for parameter in self.parameters:
            value = case[parameter.name]
            if value is None or (value == parameter.rest and not parameter.is_drawn):
                continue
            # the values of a group share one text
            group_text = texts_by_group.get(parameter.group)
            if parameter.group == parameter.name:
                texts_by_group[parameter.group] = parameter.text_of(value)
            else:
                texts_by_group[parameter.group] = (
                    f"{parameter.group} {value:.12g}" if group_text is None else f"{group_text},{value:.12g}"
                )
        return ", ".join(texts_by_group.values()) or "nothing varied"

    def lines(self) -> Iterator[str]:
        """Yield lines of text: the failures from the worst on, or else the lowest run; then the coverage."""
        yield f"run 1, with nothing varied: {_verdict_text(self.first)}"
        for parameter in self.parameters:
            if parameter.unit == "s" and self.first.seconds < parameter.high < math.inf:
                range_text = f"{parameter.low:g}s:{parameter.high:g}s"
                yield (
                    f"{parameter.name}@{range_text} goes on after the end of that run, at"
                    f" {self.first.seconds:g} s: from there on nothing happens"
                )
        if self.first.is_violated:
            yield "  the search ended with it: what fails without any variation needs no search"
        unknown_count = sum(run.verdict == "unknown" for run in self.runs)
        unknown_text = f", {unknown_count:,} unknown" if unknown_count else ""
        runs_text = plural(len(self.runs), "run")
        if self.failures:
            yield (
                f"{runs_text} of {self.name}: {len(self.failures):,} violated{unknown_text}; the worst first:"
            )
            for failure in self.failures[:_MOST_FAILURES]:
                yield from self._lines_of(failure)
            if len(self.failures) > _MOST_FAILURES:
                yield f"  … and {len(self.failures) - _MOST_FAILURES:,} more in failures.json"
        else:
            lowest_run = self.lowest
            yield f"{runs_text} of {self.name}: none violated{unknown_text}"
            case_text = self.text_of(lowest_run.case)
            yield f"  the lowest: run {lowest_run.number}, {_verdict_text(lowest_run)}, with {case_text}"
            if len({run.robustness for run in self.runs}) == 1 < len(self.runs):
                yield "  it is the same in every run: what is varied does not change it"
            elif not self.is_exhausted:
                yield "  that is no proof: the same command with a larger --budget goes on from there"
        if self.is_exhausted:
            yield "  the search ended early: there was nothing else to try"
        if len(self.runs) > 1:
            yield "covered, with the runs in each tenth of a range:"
            yield from _table(self.coverage)
        if self.impossible:
            yield f"  {plural(self.impossible, 'case')} left out, in which objects would lie in each other"
        if self.simulations:
            yield f"{plural(self.simulations, 'more run')} made the failures smaller"
        worst_failure = min(self.failures, key=lambda failure: failure.smaller.robustness, default=None)
        if worst_failure is not None and worst_failure.command is not None:
            less_text = " with less" if worst_failure.is_smaller else ""
            yield f"the worst again, run {worst_failure.run.number}{less_text}: {worst_failure.command}"

    def _lines_of(self, failure: Failure) -> Iterator[str]:
        run = failure.run
        yield f"  {failure.log}  {run.spec} {with_unit(run.robustness, run.unit)}  {self.text_of(run.case)}"
        if failure.is_smaller:
            smaller = failure.smaller
            robustness_text = with_unit(smaller.robustness, smaller.unit)
            case_text = self.text_of(smaller.case)
            yield f"    with less: {failure.smaller_log}  {smaller.spec} {robustness_text}  {case_text}"
        yield f"    clip: {failure.clip}"

    @property
    def document(self) -> dict[str, Any]:
        """The result as values for JSON: first run, lowest run, failures, coverage; paths are relative."""
        return {
            "simulation": self.name,
            "runs": len(self.runs),
            "verdict": str(self.verdict),
            "unknown": sum(run.verdict is Verdict.UNKNOWN for run in self.runs),
            "impossible": self.impossible,
            "exhausted": self.is_exhausted,
            "smaller_runs": self.simulations,
            "first": self.first.document,
            "lowest": self.lowest.document,
            "failures": [
                {
                    **failure.run.document,
                    "log": _relative(failure.log),
                    "smaller": failure.smaller.document["case"],
                    "smaller_robustness": json_number(failure.smaller.robustness),
                    "smaller_log": _relative(failure.smaller_log),
                    "clip": _relative(failure.clip),
                    "command": failure.command,
                }
                for failure in self.failures
            ],
            "covered": json_value(self.coverage),
        }

    def _coverage_of(self, parameter: Parameter) -> Coverage:
        # the first run has no variation, and parameters can lack a value
        values_with_robustness = [
            (value, run.robustness)
            for run in self.runs[1:]
            if (value := run.case[parameter.name]) is not None
        ]
        robustness_by_tenth: list[list[float]] = [[] for _ in range(TENTHS)]
        for value, robustness in values_with_robustness:
            robustness_by_tenth[parameter.tenth_of(value)].append(robustness)
        return Coverage(
            parameter.name,
            parameter.low,
            parameter.high,
            parameter.unit,
            tuple(map(len, robustness_by_tenth)),
            tuple(min(robustnesses, default=None) for robustnesses in robustness_by_tenth),
        )


def _relative(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


def _verdict_text(run: SearchedRun) -> str:
    return f"{run.verdict}, {run.spec} {with_unit(run.robustness, run.unit)}"


def _table(coverages: tuple[Coverage, ...]) -> Iterator[str]:
    name_width = max(len(coverage.parameter) for coverage in coverages)
    range_texts = [
        f"{coverage.low:g} to {coverage.high:g}{f' {coverage.unit}' if coverage.unit else ''}"
        for coverage in coverages
    ]
    range_width = max(map(len, range_texts))
    for coverage, range_text in zip(coverages, range_texts, strict=True):
        counts_text = " ".join(f"{count:3}" for count in coverage.runs)
        yield f"  {coverage.parameter:<{name_width}}  {range_text:<{range_width}}  {counts_text}"


# --------------------------------------------------------------------------------------------------- descents

LARGEST_COST: Final = 1e9
"""Substitute for an infinite cost, because the optimiser needs finite costs; impossible cases cost more."""
_LOOK: Final = 10
"""Number of points before each descent, which are spread over the whole space."""
_STEP: Final = 0.2
"""Initial standard deviation of a descent, as a fraction of the ranges."""
_NARROWEST: Final = 2e-3
"""Standard deviation at which a descent ends, as a fraction of the ranges."""
_FLAT: Final = 3
"""Number of generations with equal costs after which a descent ends."""
_STALLED: Final = 5
_FALLS: Final = 1e-3
"""A descent ends after `_STALLED` generations without a decrease of the least cost by this fraction."""
_PROPOSED: Final = 20
"""Number of proposals of CMA-ES for each simulated point."""
_PARTS: Final = 3
"""Number of rounds of a generation; costs of earlier rounds decide the points of the next round."""
_KNOWN: Final = 80
"""Number of points for fitting the model: the newest points and the best older points, half each."""
_LENGTHS: Final = (0.15, 0.3, 0.6)
"""Candidate length scales of the costs, as fractions of the ranges; the likeliest scale is used."""
_NOISE: Final = 1e-2
"""Fraction of the variance of costs that points do not explain, because of contacts and seeds."""


class Descents:
    """Optimiser of one search: it proposes points of the unit cube in rounds, and receives their costs.

    The seed and the costs determine all points, independently of the global random state.
    """

    def __init__(self, size: int, seed: int) -> None:
        """Prepare the first round, whose points are spread over the whole space.

        Raises:
            UsageError: `cma` is not installed.
        """
        try:
            import cma
        except ImportError:
            remedy = "pip install 'spatial-replay[falsify]'"
            raise UsageError(f"searching for failures needs cma, which is not installed: {remedy}") from None
        self._cma: Any = cma
        # pycma does not support one dimension (https://github.com/CMA-ES/pycma/issues/86), so a second
        # dimension without effect is added
        self._size, self._search_size = size, max(size, 2)
        self._random = np.random.default_rng([seed, 0])
        self._strategy: Any = None
        self._least_cost, self._stalled_generations = np.inf, 0
        self._round_points: list[NDArray[np.float64]] = []
        # the current generation: remaining proposals, and points with their costs so far
        self._proposals: list[NDArray[np.float64]] = []
        self._generation: list[tuple[NDArray[np.float64], float]] = []
        self._points: list[NDArray[np.float64]] = []
        self._costs: list[float] = []

    def ask(self) -> list[NDArray[np.float64]]:
        """Return the points of the next round, each (size,) with numbers from 0 to 1."""
        self._round_points = self._look() if self._strategy is None else self._promising()
        return [point[: self._size] for point in self._round_points]

    def take(self, costs: Sequence[float], *, is_found: bool) -> None:
        """Receive the cost of each point of the last round.

        Args:
            is_found: whether a point is a failure; then the next descent begins elsewhere.
        """
        self._remember(costs)
        self._generation += zip(self._round_points, costs, strict=True)
        if is_found:
            self._strategy = None
        elif self._strategy is None:
            self._strategy = self._descent(self._round_points[int(np.argmin(costs))])
            self._least_cost, self._stalled_generations = min(costs), 0
        elif len(self._generation) < self._strategy.popsize:
            return
        else:
            self._end_generation()
        self._generation, self._proposals = [], []

    def _look(self) -> list[NDArray[np.float64]]:
        """Return a Latin hypercube: each tenth of each dimension has one point."""
        columns = [
            (self._random.permutation(_LOOK) + self._random.random(_LOOK)) / _LOOK
            for _ in range(self._search_size)
        ]
        return list(np.array(columns).T)

    def _end_generation(self) -> None:
        points, costs = map(list, zip(*self._generation, strict=True))
        self._strategy.tell(points, costs)
        least_cost = min(costs)
        is_lower = least_cost < self._least_cost - _FALLS * abs(self._least_cost)
        self._stalled_generations = 0 if is_lower else self._stalled_generations + 1
        self._least_cost = min(self._least_cost, least_cost)
        if self._strategy.stop() or self._stalled_generations == _STALLED:
            self._strategy = None

    def _promising(self) -> list[NDArray[np.float64]]:
        """Return the proposals with the least expected costs, for one round of a generation."""
        population_size = self._strategy.popsize
        if not self._proposals:
            self._proposals = self._strategy.ask(_PROPOSED * population_size)
        proposal_costs = expected_costs(
            np.array(self._points),
            np.array(self._costs),
            np.array([point[: self._size] for point in self._proposals]),
        )
        point_count = min(-(-population_size // _PARTS), population_size - len(self._generation))
        cost_order = np.argsort(proposal_costs, kind="stable").tolist()
        points = [self._proposals[index] for index in cost_order[:point_count]]
        self._proposals = [self._proposals[index] for index in sorted(cost_order[point_count:])]
        return points

    def _remember(self, costs: Sequence[float]) -> None:
        """Store the newest points, and the best older points."""
        self._points += [point[: self._size] for point in self._round_points]
        self._costs += costs
        older_count = len(self._costs) - _KNOWN // 2
        best_indices = sorted(
            sorted(range(max(older_count, 0)), key=lambda index: self._costs[index])[: _KNOWN // 2]
        )
        indices = [*best_indices, *range(max(older_count, 0), len(self._costs))]
        self._points = [self._points[index] for index in indices]
        self._costs = [self._costs[index] for index in indices]

    def _descent(self, start: NDArray[np.float64]) -> Any:
        options = {
            "bounds": [0.0, 1.0],
            # the default is the global random state of NumPy; the seed NaN leaves that state unchanged
            "randn": lambda *shape: self._random.standard_normal(shape),
            "seed": np.nan,
            "tolx": _NARROWEST,
            "tolflatfitness": _FLAT,
            "verbose": -9,
        }
        return self._cma.CMAEvolutionStrategy(start, _STEP, options)


def expected_costs(
    points: NDArray[np.float64], costs: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the costs that a Gaussian process predicts at other points, (M,), relative to the mean cost.

    The method is algorithm 2.1 of Rasmussen and Williams, Gaussian Processes for Machine Learning
    (https://gaussianprocess.org/gpml), with a squared exponential kernel. The length of the kernel is the
    candidate with the greatest likelihood.

    Args:
        points: (N, D), points with numbers from 0 to 1.
        costs: (N,), costs of the points.
        others: (M, D), points of the prediction.
    """
    # impossible cases and infinite costs count as the worst finite cost
    finite_costs = costs[costs < LARGEST_COST]
    centred_costs = np.minimum(costs, finite_costs.max()) if finite_costs.size else np.zeros_like(costs)
    centred_costs = centred_costs - centred_costs.mean()
    point_squares, cross_squares = _squares(points, points), _squares(others, points)
    best_likelihood, predicted_costs = -np.inf, np.zeros(len(others))
    for length in _LENGTHS:
        exponent_factor = -0.5 / (length * length * points.shape[1])
        cholesky_factor = np.linalg.cholesky(
            np.exp(exponent_factor * point_squares) + _NOISE * np.eye(len(points))
        )
        weights = np.linalg.solve(cholesky_factor.T, np.linalg.solve(cholesky_factor, centred_costs))
        # the maximum-likelihood variance of the costs
        variance = max(float(centred_costs @ weights) / len(points), np.finfo(float).tiny)
        likelihood = -0.5 * len(points) * np.log(variance) - np.log(np.diag(cholesky_factor)).sum()
        if likelihood > best_likelihood:
            best_likelihood, predicted_costs = likelihood, np.exp(exponent_factor * cross_squares) @ weights
    return predicted_costs


def _squares(points: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared distances between points (N, D) and other points (M, D), as (N, M)."""
    return np.asarray(((points[:, None] - others[None]) ** 2).sum(axis=-1))


# --------------------------------------------------------------------------------------------- runs in a file


class RunFile:
    """File of runs by case; only one search may use the file at a time.

    Each finished run is appended as a line. Opening the file removes an incomplete last line.
    """

    def __init__(self, path: Path) -> None:
        """Read the runs of earlier searches.

        Raises:
            LogError: a line cannot be read.
            OutputError: the file cannot be written.
        """
        self._path = path
        self._runs_by_case: dict[str, SearchedRun] = {}
        content = path.read_bytes() if path.exists() else b""
        whole_lines = content[: content.rfind(b"\n") + 1]
        for line_number, line in enumerate(whole_lines.splitlines(), start=1):
            try:
                run = SearchedRun.from_document(json.loads(line))
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise LogError(
                    f"{path}:{line_number}: this line is not a run ({error}); delete the file, "
                    "and search again"
                ) from None
            self._runs_by_case[key_of(run.case)] = run
        try:
            self._stream = path.open("ab")
            # remove the incomplete last line of a killed search
            self._stream.truncate(len(whole_lines))
        except OSError as error:
            raise output_error(path, error) from error

    def __getitem__(self, case: Case) -> SearchedRun:
        return self._runs_by_case[key_of(case)]

    def __contains__(self, case: Case) -> bool:
        return key_of(case) in self._runs_by_case

    def add(self, run: SearchedRun) -> None:
        """Append a run.

        Raises:
            OutputError: the run cannot be written.
        """
        line = json.dumps(run.document, allow_nan=False).encode() + b"\n"
        try:
            self._stream.write(line)
            self._stream.flush()
        except OSError as error:
            raise output_error(self._path, error) from error
        self._runs_by_case[key_of(run.case)] = run

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


# ----------------------------------------------------------------------------------------------------- rounds

_Result = TypeVar("_Result")

Rounds: TypeAlias = Generator[Sequence[Case], Sequence[SearchedRun], _Result]
"""Generator that yields the cases of a round and receives their runs."""


@dataclass(frozen=True, slots=True)
class _Task:
    """Case to simulate; its log is written if its run violates a specification."""

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
    """Simulate the new cases of each round, and return the result of the generator of rounds.

    Args:
        file: file of runs, which are not simulated again. New lines have the order of the cases.
        advance: function that is called with the number of runs finished since its last call.
        logs: folder for the logs of violating runs; None writes no logs.

    Raises:
        LogError: the file is damaged.
        OutputError: a file cannot be written, or a worker died.
    """
    with closing(RunFile(file)) as earlier_runs:
        queue = _Queue(rounds, earlier_runs, advance, logs)
        for task, run in workers.results(partial(_simulate, simulation), queue):
            if isinstance(run, WorkerLost):
                raise lost_worker_error(run)
            queue.take(task, run)
        return queue.result


class _Queue(Generic[_Result]):
    """Tasks of successive rounds; the next round starts when all runs of a round are finished.

    Unlike other iterators, a queue can continue after its end: workers ask again after each result.

    Attributes:
        result: result of the generator of rounds, set after the last round.
    """

    result: _Result

    def __init__(
        self, rounds: Rounds[_Result], run_file: RunFile, advance: Callable[[int], None], logs: Path | None
    ) -> None:
        self._rounds, self._run_file, self._advance, self._logs = rounds, run_file, advance, logs
        self._round_cases: Sequence[Case] | None = None
        self._first_number = 1
        self._waiting_tasks: deque[_Task] = deque()
        self._unwritten_tasks: deque[_Task] = deque()
        self._arrived_runs: dict[int, SearchedRun] = {}
        self._begin()

    def __iter__(self) -> Iterator[_Task]:
        return self

    def __next__(self) -> _Task:
        if not self._waiting_tasks:
            raise StopIteration
        return self._waiting_tasks.popleft()

    def take(self, task: _Task, run: SearchedRun) -> None:
        """Receive the run of a task, and write finished runs in the order of their tasks."""
        self._arrived_runs[task.number] = run
        while self._unwritten_tasks and self._unwritten_tasks[0].number in self._arrived_runs:
            self._run_file.add(self._arrived_runs.pop(self._unwritten_tasks.popleft().number))
            self._advance(1)
        self._begin()

    def _begin(self) -> None:
        """Start the next rounds, up to a round with a case that is not in the file."""
        while not self._unwritten_tasks:
            try:
                if self._round_cases is None:
                    cases = next(self._rounds)
                else:
                    self._first_number += len(self._round_cases)
                    cases = self._rounds.send([self._run_file[case] for case in self._round_cases])
            except StopIteration as end:
                self.result = end.value
                return
            self._round_cases = cases
            for run_number, case in enumerate(cases, start=self._first_number):
                if case not in self._run_file:
                    log = None if self._logs is None else self._logs / f"run-{run_number:04d}.mcap"
                    self._waiting_tasks.append(_Task(run_number, case, log))
            self._unwritten_tasks.extend(self._waiting_tasks)
            self._advance(len(cases) - len(self._waiting_tasks))


def _simulate(simulation: Simulation, task: _Task) -> SearchedRun:
    """Simulate and evaluate a case; write its log if its run violates a specification."""
    try:
        simulated_case = simulation.run(task.case)
    except Exception as error:
        error.add_note(f"in the case {key_of(task.case)}")
        raise
    results = [result for file in simulation.files for result in evaluate(file, simulated_case.trace)]
    worst_result = min(results, key=lambda result: result.upper)
    verdict = worst_verdict(result.verdict for result in results)
    times_ns = simulated_case.trace.times_ns
    run = SearchedRun(
        task.number,
        task.case,
        verdict,
        worst_result.upper,
        worst_result.title,
        declared_unit(worst_result.formula, {"": simulated_case.unit}),
        int(times_ns[-1] - times_ns[0]) / 1e9,
    )
    if run.is_violated and task.log is not None:
        write_whole(simulated_case.write, task.log)
    return run


def write_whole(write: Callable[[Path], None], log: Path) -> None:
    """Write a log under another name and rename it, so that `log` is never an incomplete file."""
    partial_log = log.with_name(f".{log.name}.partial")
    write(partial_log)
    partial_log.replace(log)


def lost_worker_error(worker: WorkerLost) -> OutputError:
    """Return the error for a worker that died."""
    return OutputError(f"a run could not be simulated: {worker}; the same command goes on from there")


# ------------------------------------------------------------------------------------------------- the search

FORMAT: Final = 2
MOST_RUNS: Final = 1_000_000
_SEARCH: Final = "search.json"
_HALVINGS: Final = 3
"""Maximum number of times that a group moves half way to rest, if the run at rest does not fail."""
_BARREN: Final = 50
"""Number of rounds without a new case after which the search ends."""
_DRAWN: Final = 10
"""Number of runs in a round if only seeds are varied."""


@named_arguments
def falsify(
    simulation: str | Callable[[Mapping[str, float]], Iterable[Sample]],
    specifications: Specification | str | PathLike[str] | Sequence[Specification | str | PathLike[str]] = (),
    *,
    output: str | PathLike[str],
    vary: Mapping[str, tuple[float, float]] | Sequence[str] = (),
    budget: int = 200,
    seed: int = 0,
    planned: bool = False,
    jobs: int = 1,
) -> Falsification:
    """Search for simulated runs that violate a specification, and reduce their variations.

    An optimiser chooses the runs, with their robustness as cost. A call with the same arguments continues an
    earlier search, also with a larger budget.

    Args:
        simulation: scenario ("push", "pick-place", "table-setting"), or function from the values of the
            parameters by name to the samples of a run. Equal values must give equal samples.
        specifications: specifications or their files; by default the specification of the scenario.
        output: folder for runs, logs and clips.
        vary: parameters to vary. For a scenario they are texts as on the command line,
            `["noise=0:0.01", "slip@T"]`, by default `["start"]`; for a function ranges by name,
            `{"wind": (-2, 2)}`.
        budget: maximum number of runs, without the runs that reduce failures.
        seed: seed of the search.
        planned: whether the planner acts in the scenario instead of the script.
        jobs: number of processes that simulate; the result does not depend on it.

    Raises:
        UsageError: a parameter that cannot be varied, a folder of another search, or a missing extra.
        SpecificationError: a specification has errors, has a result that no run can violate or satisfy, or
            mentions objects that the world does not have.
        LogError: a file of an earlier search is damaged.
        OutputError: a file cannot be written.
    """
    if isinstance(specifications, Specification | str | PathLike):
        specifications = [specifications]
    parsed_specifications = [
        specification
        if isinstance(specification, Specification)
        else load_specifications([local_copy(specification)])[0]
        for specification in specifications
    ]
    if isinstance(simulation, str):
        if isinstance(vary, Mapping):
            raise UsageError('what is varied in a scenario is a list of texts, such as ["noise=0:0.01"]')
        searched_simulation, parameters = scenario_simulation(
            simulation, parsed_specifications, vary, is_planned=planned
        )
    elif planned:
        raise UsageError("planned is for scenarios; let the planner act within the simulation")
    else:
        searched_simulation, parameters = own_simulation(simulation, parsed_specifications, vary, jobs)
    return search_failures(
        searched_simulation, parameters, output, workers_of(jobs), budget=budget, seed=seed
    )


def search_failures(
    simulation: Simulation,
    parameters: Sequence[Parameter],
    folder: str | PathLike[str],
    workers: Workers,
    *,
    budget: int = 200,
    seed: int = 0,
    progress: Progress = no_progress,
) -> Falsification:
    """Search for runs that violate a specification; continue an earlier search in the folder.

    Args:
        folder: folder for runs, logs and clips; it is created if it is missing.
        budget: maximum number of runs, without the runs that reduce failures.
        seed: seed of the search; equal arguments give equal files with any number of workers.
        progress: display of the number of runs.

    Raises:
        UsageError: nothing to vary, an invalid budget or seed, or a folder of another search.
        SpecificationError: a specification has a result that no run can violate or satisfy.
        LogError: a file of an earlier search is damaged.
        OutputError: a file cannot be written; the same call continues the search.
    """
    if not 1 <= budget <= MOST_RUNS:
        raise UsageError(f"the budget is {budget:,} runs; give 1 to {MOST_RUNS:,}")
    if seed < 0:
        raise UsageError(f"the seed is {seed}; give 0 or more")
    space = Space(_distinct(parameters))
    for file in simulation.files:
        refuse_constant_results(file)
    refuse_addresses(Path(folder))
    files = LocalFolder(Path(folder))
    _claim(files, _identity(simulation, space, seed))
    with files.lock(_SEARCH):
        try:
            return _Search(simulation, space, files, workers, progress).run(budget, seed)
        except KeyboardInterrupt as interruption:
            # existing notes concern the unfinished log and would mislead
            interruption.__notes__ = [f"{files} keeps all runs so far; the same command goes on from there"]
            raise


def _distinct(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    parameter_names = [parameter.name for parameter in parameters]
    if not parameter_names:
        raise UsageError("nothing is varied; name at least one parameter with its range")
    for name in parameter_names:
        if parameter_names.count(name) > 1:
            raise UsageError(f"--vary: {name!r} is given twice; give one range")
    return tuple(parameters)


def _identity(simulation: Simulation, space: Space, seed: int) -> dict[str, Any]:
    """Return the inputs that decide the results of a search, without its budget."""
    return {
        "format": FORMAT,
        "version": __version__,
        "simulation": simulation.name,
        "specifications": list(map(meaning_hash, simulation.files)),
        "varied": {
            parameter.name: [parameter.low, json_number(parameter.high)] for parameter in space.parameters
        },
        "seed": seed,
        **simulation.identity,
    }


def _claim(files: LocalFolder, identity: Mapping[str, Any]) -> None:
    """Mark an empty folder as the folder of a search, or check that it is marked for the same search.

    Raises:
        UsageError: the folder has another search, or other files.
        LogError: the mark is damaged.
    """
    file_names = files.names()
    if _SEARCH not in file_names:
        if file_names:
            raise UsageError(f"{files} holds files, but no search; give an empty folder, or a new one")
        files.write(_SEARCH, json.dumps(identity, indent=1).encode() + b"\n")
        return
    try:
        (content,) = files.read([_SEARCH])
        stored_identity = json.loads(content)
        key = next((key for key in identity if stored_identity.get(key) != identity[key]), None)
        varied_texts = [
            _varied_text(search_identity["varied"])
            for search_identity in (stored_identity, identity)
            if key == "varied"
        ]
    except (AttributeError, LookupError, TypeError, ValueError):
        raise LogError(f"{files.path / _SEARCH} is damaged; delete {files}, or give another folder") from None
    if key is not None:
        difference = {
            "seed": f"its seed is {stored_identity.get('seed')}",
            "simulation": f"it is of {stored_identity.get('simulation')}",
            "varied": f"it varies {', and this one '.join(varied_texts)}",
            "specifications": "it has other specifications",
            "version": f"it is of version {stored_identity.get('version')}",
        }.get(key, f"its {key} is {stored_identity.get(key)}")
        raise UsageError(f"{files} holds another search: {difference}; give another folder, or delete it")


def _varied_text(varied: Mapping[str, Sequence[Any]]) -> str:
    """Return the varied ranges in words: "speed from 0.6 to 1.4, slip from 0.0 to the end of the run"."""
    ranges = (f"{name} from {low} to {high}" for name, (low, high) in varied.items())
    return ", ".join(range_text.replace("to inf", "to the end of the run") for range_text in ranges)


class _Search:
    """One search in a locked folder."""

    def __init__(
        self, simulation: Simulation, space: Space, files: LocalFolder, workers: Workers, progress: Progress
    ) -> None:
        self._simulation, self._space, self._folder = simulation, space, files.path
        self._files, self._workers, self._progress = files, workers, progress
        self._impossible: set[str] = set()
        self._is_exhausted = False
        for name in ("runs", "smaller", "clips"):
            (self._folder / name).mkdir(exist_ok=True)

    def run(self, budget: int, seed: int) -> Falsification:
        """Search, reduce the failures, and cut their clips."""
        with self._progress("runs", budget) as advance:
            runs = self._simulate_rounds(self._descend(budget, seed), "runs", advance, self._folder / "runs")
        failing_runs = sorted(
            (run for run in runs if run.is_violated), key=lambda run: (run.robustness, run.number)
        )
        runs_by_case = {key_of(run.case): run for run in runs}
        with self._progress("smaller runs", None) as advance:
            smaller_runs, simulations = self._simulate_rounds(
                self._shrink(failing_runs, runs_by_case), "smaller", advance
            )
        failures = tuple(
            self._failure(run, smaller_run)
            for run, smaller_run in zip(failing_runs, smaller_runs, strict=True)
        )
        with self._progress("clips", len(failures)) as advance:
            for _, outcome in self._workers.results(partial(_finish, self._simulation), failures):
                if isinstance(outcome, WorkerLost):
                    raise lost_worker_error(outcome)
                advance(1)
        result = Falsification(
            self._simulation.name,
            self._space.parameters,
            tuple(runs),
            failures,
            len(self._impossible),
            simulations,
            self._is_exhausted,
        )
        self._files.write("failures.json", json.dumps(result.document, indent=1).encode() + b"\n")
        return result

    def _simulate_rounds(
        self, rounds: Rounds[_Result], name: str, advance: Callable[[int], None], logs: Path | None = None
    ) -> _Result:
        file = self._folder / f"{name}.jsonl"
        return simulate_rounds(rounds, self._simulation, self._workers, file, advance, logs)

    def _descend(self, budget: int, seed: int) -> Rounds[list[SearchedRun]]:
        """Yield cases from an optimiser, whose cost is the robustness; return all runs."""
        (first_run,) = yield [self._space.at_rest()]
        runs = [replace(first_run, number=1)]
        self._space = space = self._space.ending_at(first_run.seconds)
        late_parameter = next(
            (
                parameter
                for parameter in space.parameters
                if parameter.unit == "s" and parameter.low >= first_run.seconds
            ),
            None,
        )
        if late_parameter is not None and not first_run.is_violated:
            raise UsageError(
                f"--vary {late_parameter.name}@{late_parameter.low:g}s:{late_parameter.high:g}s: "
                f"with nothing varied the run ends after {first_run.seconds:g} s; "
                "begin before that, in another folder"
            )
        descents = Descents(len(space.ordered), seed) if space.ordered else None
        # a random stream different from the descents' stream
        generator, barren_rounds = np.random.default_rng([seed, 1]), 0
        cost_by_key = {key_of(first_run.case): _cost(first_run)}
        best_draw: tuple[float, list[float]] | None = None
        while len(runs) < budget and barren_rounds < _BARREN and not first_run.is_violated:
            points: Sequence[Any] = descents.ask() if descents is not None else [()] * _DRAWN
            draws = [
                # a case gets the seeds with the least cost so far, or new seeds, with equal probability
                best_draw[1] if best_draw is not None and generator.random() < 0.5 else space.draw(generator)
                for _ in points
            ]
            cases = [space.case_at(point, draw) for point, draw in zip(points, draws, strict=True)]
            new_cases: dict[str, Case] = {}
            for case in cases:
                case_key = key_of(case)
                if case_key not in cost_by_key and not self._simulation.is_possible(case):
                    self._impossible.add(case_key)
                    cost_by_key[case_key] = 2 * LARGEST_COST
                elif case_key not in cost_by_key:
                    new_cases[case_key] = case
            round_cases = [*new_cases.values()][: budget - len(runs)]
            barren_rounds = 0 if round_cases else barren_rounds + 1
            for run in (yield round_cases) if round_cases else ():
                runs.append(replace(run, number=len(runs) + 1))
                cost_by_key[key_of(run.case)] = _cost(run)
            # the budget ends within this round, so some cases have no costs
            if len(round_cases) < len(new_cases):
                break
            point_costs = [cost_by_key[key_of(case)] for case in cases]
            # a failure that is already known does not end a descent
            is_found = any(key_of(case) in new_cases and cost_by_key[key_of(case)] < 0 for case in cases)
            least_index = int(np.argmin(point_costs))
            if is_found:
                best_draw = None
            elif best_draw is None or point_costs[least_index] < best_draw[0]:
                best_draw = point_costs[least_index], draws[least_index]
            if descents is not None:
                descents.take(point_costs, is_found=is_found)
        self._is_exhausted = barren_rounds == _BARREN
        return runs

    def _shrink(
        self, failing_runs: Sequence[SearchedRun], runs_by_case: Mapping[str, SearchedRun]
    ) -> Rounds[tuple[list[SearchedRun], int]]:
        """Reduce all failures, by one run per failure and round.

        Return the reduced failures and the number of further runs.
        """
        tried_runs: dict[str, SearchedRun] = {}
        smaller_runs = list(failing_runs)
        reductions = [self._smaller(run) for run in failing_runs]
        case_by_index = {
            index: case
            for index, reduction in enumerate(reductions)
            if (case := next(reduction, None)) is not None
        }
        while case_by_index:
            round_cases = {key_of(case): case for case in case_by_index.values()}
            unknown_cases = [
                case
                for case_key, case in round_cases.items()
                if case_key not in runs_by_case and case_key not in tried_runs
            ]
            for run in (yield unknown_cases) if unknown_cases else ():
                tried_runs[key_of(run.case)] = run
            for index, case in list(case_by_index.items()):
                case_key = key_of(case)
                run = runs_by_case[case_key] if case_key in runs_by_case else tried_runs[case_key]
                if run.is_violated:
                    smaller_runs[index] = replace(run, number=failing_runs[index].number)
                try:
                    case_by_index[index] = reductions[index].send(run)
                except StopIteration:
                    del case_by_index[index]
        return smaller_runs, len(tried_runs)

    def _smaller(self, failure: SearchedRun) -> Generator[Case, SearchedRun, None]:
        """Yield cases with fewer or smaller variations, until no group can return to rest on its own."""
        case, halvings_left = failure.case, dict.fromkeys(self._space.groups, _HALVINGS)
        is_changed = True
        while is_changed:
            is_changed = False
            for group in self._space.groups:
                smaller_case = self._space.at_rest(case, group)
                if (
                    smaller_case != case
                    and self._simulation.is_possible(smaller_case)
                    and (yield smaller_case).is_violated
                ):
                    case, is_changed = smaller_case, True
            for group in self._space.groups if not is_changed else ():
                nearer_case = self._space.nearer(case, group)
                if nearer_case is not None and halvings_left[group]:
                    halvings_left[group] -= 1
                    if (yield nearer_case).is_violated:
                        case, is_changed = nearer_case, True

    def _failure(self, run: SearchedRun, smaller: SearchedRun) -> Failure:
        name = f"run-{run.number:04d}.mcap"
        log = self._folder / "runs" / name
        return Failure(
            run,
            smaller,
            log,
            log if smaller.case == run.case else self._folder / "smaller" / name,
            self._folder / "clips" / name,
            self._simulation.command(smaller.case),
        )


def _finish(simulation: Simulation, failure: Failure) -> None:
    """Write the missing files of a failure: its log, the reduced log, and the clip of the reduced log."""
    if not failure.log.exists():
        write_whole(simulation.run(failure.run.case).write, failure.log)
    if not failure.smaller_log.exists():
        write_whole(simulation.run(failure.smaller.case).write, failure.smaller_log)
    if not failure.clip.exists():
        spec = failure.smaller.spec
        cut_clip(open_source(failure.smaller_log), simulation.files, failure.clip, DEFAULT_OPTIONS, of=[spec])


def _cost(run: SearchedRun) -> float:
    return min(max(run.robustness, -LARGEST_COST), LARGEST_COST)

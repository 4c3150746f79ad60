"""A search for failures: runs are simulated in rounds, those that violate are made smaller and cut."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from spatial_replay import __version__
from spatial_replay.batch.result_files import LocalFolder
from spatial_replay.batch.run import workers_of
from spatial_replay.batch.workers import Progress, WorkerLost, Workers, no_progress
from spatial_replay.compare.clips import cut_clip
from spatial_replay.errors import LogError, UsageError
from spatial_replay.falsification.failures import Failure, Falsification, SearchedRun
from spatial_replay.falsification.optimiser import LARGEST_COST, Descents
from spatial_replay.falsification.parameters import Case, Parameter, Space, key_of
from spatial_replay.falsification.rounds import Rounds, lost, simulate_rounds, write_whole
from spatial_replay.falsification.simulations import Simulation, own_simulation, scenario_simulation
from spatial_replay.logs.downloads import local_copy
from spatial_replay.logs.output_file import refuse_addresses
from spatial_replay.replay.selection import DEFAULT_OPTIONS
from spatial_replay.sanity import refuse_decided
from spatial_replay.sources.open_log import open_source
from spatial_replay.spec.format import format_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.overrides import load_specifications
from spatial_replay.text import json_number
from spatial_replay.trace.sample import Sample

FORMAT: Final = 2
MOST_RUNS: Final = 1_000_000
_SEARCH: Final = "search.json"
_HALVINGS: Final = 3
"""How often a value that cannot be at rest is brought half way there."""
_BARREN: Final = 50
"""Rounds without a new case after which there is nothing else to try."""
_DRAWN: Final = 10
"""Runs of a round where nothing but seeds is varied."""

_Result = TypeVar("_Result")


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
    """Search for simulated runs that violate a specification, and make those found smaller.

    An optimiser chooses the runs, with their robustness as cost. A call with the same arguments goes on where
    an earlier one ended, also with a larger budget.

    Args:
        simulation: a scenario ("push", "pick-place", "table-setting"), or a function from the values of what
            is varied, by name, to the samples of a run; equal values must give equal samples.
        specifications: what has to hold, parsed or as files; without any, the scenario's own.
        output: the folder for runs, logs and clips.
        vary: of a scenario as on the command line, `["noise=0:0.01", "slip@T"]`, by default `["start"]`; of a
            function ranges by name, `{"wind": (-2, 2)}`.
        budget: the most runs, but for those that make failures smaller.
        seed: of the search.
        planned: let the planner act in the scenario, not the script.
        jobs: how many processes simulate; the result does not depend on it.

    Raises:
        UsageError: what cannot be varied, a folder of another search, an extra that is not installed.
        SpecificationError: a specification with errors, one that no run violates or none satisfies,
            or names that the world does not have.
        LogError: what an earlier search has left is damaged.
        OutputError: a file cannot be written.
    """
    if isinstance(specifications, Specification | str | PathLike):
        specifications = [specifications]
    files = [
        each if isinstance(each, Specification) else load_specifications([local_copy(each)])[0]
        for each in specifications
    ]
    if isinstance(simulation, str):
        if isinstance(vary, Mapping):
            raise UsageError('what is varied in a scenario is a list of texts, such as ["noise=0:0.01"]')
        chosen, parameters = scenario_simulation(simulation, files, vary, is_planned=planned)
    elif planned:
        raise UsageError("planned is for scenarios; let the planner act within the simulation")
    else:
        chosen, parameters = own_simulation(simulation, files, vary, jobs)
    return search_failures(chosen, parameters, output, workers_of(jobs), budget=budget, seed=seed)


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
    """Look for runs that violate a specification; what an earlier search has simulated counts.

    Args:
        folder: where runs, logs and clips go; made if need be.
        budget: the most runs to simulate, but for those that make failures smaller.
        seed: of the search; equal arguments give equal files, with any number of workers.
        progress: shows how many runs there are.

    Raises:
        UsageError: nothing to vary, no budget, the folder is not one of this search.
        SpecificationError: a specification that no run violates, or none satisfies.
        LogError: what an earlier search has left is damaged.
        OutputError: a file cannot be written; the same call goes on from there.
    """
    if not 1 <= budget <= MOST_RUNS:
        raise UsageError(f"the budget is {budget:,} runs; give 1 to {MOST_RUNS:,}")
    if seed < 0:
        raise UsageError(f"the seed is {seed}; give 0 or more")
    space = Space(_distinct(parameters))
    for file in simulation.files:
        refuse_decided(file)
    refuse_addresses(Path(folder))
    files = LocalFolder(Path(folder))
    _claim(files, _identity(simulation, space, seed))
    with files.locked(_SEARCH):
        try:
            return _Search(simulation, space, files, workers, progress).run(budget, seed)
        except KeyboardInterrupt as interruption:
            # notes about the log that was being written would mislead
            interruption.__notes__ = [f"{files} keeps all runs so far; the same command goes on from there"]
            raise


def _distinct(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    names = [each.name for each in parameters]
    if not names:
        raise UsageError("nothing is varied; name at least one parameter with its range")
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"--vary: {name!r} is given twice; give one range")
    return tuple(parameters)


def _identity(simulation: Simulation, space: Space, seed: int) -> dict[str, Any]:
    """Return what all results of a search depend on, but for its budget."""
    return {
        "format": FORMAT,
        "version": __version__,
        "simulation": simulation.name,
        "specifications": [
            _digest(f"{each.profile}\n{format_specification(each)}") for each in simulation.files
        ],
        "varied": {each.name: [each.low, json_number(each.high)] for each in space.parameters},
        "seed": seed,
        **simulation.identity,
    }


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:32]


def _claim(files: LocalFolder, identity: Mapping[str, Any]) -> None:
    """Make a folder that of a search, or check that it is.

    Raises:
        UsageError: it is that of another search, or holds something else.
    """
    names = files.names()
    if _SEARCH not in names:
        if names:
            raise UsageError(f"{files} holds files, but no search; give an empty folder, or a new one")
        files.write(_SEARCH, json.dumps(identity, indent=1).encode() + b"\n")
        return
    try:
        (content,) = files.read([_SEARCH])
        other = json.loads(content)
        differing = [key for key in identity if other.get(key) != identity[key]]
    except (AttributeError, ValueError):
        raise LogError(f"{files.path / _SEARCH} is damaged; delete {files}, or give another folder") from None
    if differing:
        key = differing[0]
        what = {
            "seed": f"its seed is {other.get('seed')}",
            "simulation": f"it is of {other.get('simulation')}",
            "varied": _difference(other.get("varied"), identity["varied"]),
            "specifications": "it has other specifications",
            "version": f"it is of version {other.get('version')}",
        }.get(key, f"its {key} is {other.get(key)}")
        raise UsageError(f"{files} holds another search: {what}; give another folder, or delete it")


def _difference(other: object, varied: Mapping[str, list[Any]]) -> str:
    """Return how what another search varies differs, by the first range that does."""
    others = other if isinstance(other, dict) else {}
    for name, ends in varied.items():
        if name not in others:
            return f"it does not vary {name}"
        if others[name] != ends:
            one, this = (" to ".join(map(_end_text, each)) for each in (others[name], ends))
            return f"it varies {name} from {one}, not from {this}"
    return f"it varies {next((name for name in others if name not in varied), 'nothing')}, too"


def _end_text(end: object) -> str:
    return "the end of the run" if end == "inf" else str(end)


class _Search:
    """One search in a folder that is locked."""

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
        """Search, make what fails smaller, and cut clips of that."""
        with self._progress("runs", budget) as advance:
            runs = self._simulated(self._descend(budget, seed), "runs", advance, self._folder / "runs")
        failing = sorted(
            (run for run in runs if run.is_violated), key=lambda run: (run.robustness, run.number)
        )
        known = {key_of(run.case): run for run in runs}
        with self._progress("smaller runs", None) as advance:
            smaller = self._simulated(self._shrink(failing, known), "smaller", advance)
        failures = tuple(self._failure(run, least) for run, least in zip(failing, smaller.runs, strict=True))
        with self._progress("clips", len(failures)) as advance:
            for _, done in self._workers.results(partial(_finish, self._simulation), failures):
                if isinstance(done, WorkerLost):
                    raise lost(done)
                advance(1)
        result = Falsification(
            self._simulation.name,
            self._space.parameters,
            tuple(runs),
            failures,
            len(self._impossible),
            smaller.simulations,
            self._is_exhausted,
        )
        self._files.write("failures.json", json.dumps(result.document, indent=1).encode() + b"\n")
        return result

    def _simulated(
        self, rounds: Rounds[_Result], name: str, advance: Callable[[int], None], logs: Path | None = None
    ) -> _Result:
        file = self._folder / f"{name}.jsonl"
        return simulate_rounds(rounds, self._simulation, self._workers, file, advance, logs)

    def _descend(self, budget: int, seed: int) -> Rounds[list[SearchedRun]]:
        """Let an optimiser choose the cases, with the least robustness as cost."""
        (first,) = yield [self._space.at_rest()]
        runs = [first.numbered(1)]
        self._space = space = self._space.ending_at(first.seconds)
        late = next(
            (each for each in space.parameters if each.unit == "s" and each.low >= first.seconds), None
        )
        if late is not None and not first.is_violated:
            raise UsageError(
                f"--vary {late.name}@{late.low:g}s:{late.high:g}s: with nothing varied the run ends after"
                f" {first.seconds:g} s; begin before that, in another folder"
            )
        descents = Descents(len(space.ordered), seed) if space.ordered else None
        random, barren = np.random.default_rng([seed, 1]), 0
        costs = {key_of(first.case): _cost(first)}
        best: tuple[float, list[float]] | None = None
        while len(runs) < budget and barren < _BARREN and not first.is_violated:
            points: Sequence[Any] = descents.ask() if descents is not None else [()] * _DRAWN
            drawn = [
                # the seed that came nearest so far, or another one
                best[1] if best is not None and random.random() < 0.5 else space.draw(random)
                for _ in points
            ]
            cases = [space.case_at(point, each) for point, each in zip(points, drawn, strict=True)]
            new: dict[str, Case] = {}
            for case in cases:
                key = key_of(case)
                if key not in costs and not self._simulation.is_possible(case):
                    self._impossible.add(key)
                    costs[key] = 2 * LARGEST_COST
                elif key not in costs:
                    new[key] = case
            asked = [*new.values()][: budget - len(runs)]
            barren = 0 if asked else barren + 1
            for run in (yield asked) if asked else ():
                runs.append(run.numbered(len(runs) + 1))
                costs[key_of(run.case)] = _cost(run)
            if len(asked) < len(new):
                break
            reported = [costs[key_of(case)] for case in cases]
            # what was found before draws no descent to itself
            is_found = any(key_of(case) in new and costs[key_of(case)] < 0 for case in cases)
            least = int(np.argmin(reported))
            if is_found:
                best = None
            elif best is None or reported[least] < best[0]:
                best = reported[least], drawn[least]
            if descents is not None:
                descents.take(reported, is_found=is_found)
        self._is_exhausted = barren == _BARREN
        return runs

    def _shrink(self, failing: Sequence[SearchedRun], known: Mapping[str, SearchedRun]) -> Rounds[_Smaller]:
        """Make failures smaller, side by side: each asks for one run in a round."""
        tried: dict[str, SearchedRun] = {}
        least = list(failing)
        trials = [self._smaller(run) for run in failing]
        asked = {place: case for place, trial in enumerate(trials) if (case := next(trial, None)) is not None}
        while asked:
            new = {key_of(case): case for case in asked.values()}
            unknown = [case for key, case in new.items() if key not in known and key not in tried]
            for run in (yield unknown) if unknown else ():
                tried[key_of(run.case)] = run
            for place, case in list(asked.items()):
                key = key_of(case)
                run = known[key] if key in known else tried[key]
                if run.is_violated:
                    least[place] = run.numbered(failing[place].number)
                try:
                    asked[place] = trials[place].send(run)
                except StopIteration:
                    del asked[place]
        return _Smaller(tuple(least), len(tried))

    def _smaller(self, failure: SearchedRun) -> Generator[Case, SearchedRun, None]:
        """Yield cases with less of what is varied, until no group can be brought to rest by itself."""
        case, halvings = failure.case, dict.fromkeys(self._space.groups, _HALVINGS)
        is_changed = True
        while is_changed:
            is_changed = False
            for group in self._space.groups:
                trial = self._space.at_rest(case, group)
                if trial != case and self._simulation.is_possible(trial) and (yield trial).is_violated:
                    case, is_changed = trial, True
            for group in self._space.groups if not is_changed else ():
                nearer = self._space.nearer(case, group)
                if nearer is not None and halvings[group]:
                    halvings[group] -= 1
                    if (yield nearer).is_violated:
                        case, is_changed = nearer, True

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


@dataclass(frozen=True, slots=True)
class _Smaller:
    """Failures made smaller, in the order in which they were given, and how many runs that took."""

    runs: tuple[SearchedRun, ...]
    simulations: int


def _finish(simulation: Simulation, failure: Failure) -> None:
    """Write what is not there yet of a failure: its log, the smaller one, and the clip of that."""
    if not failure.log.exists():
        write_whole(simulation.run(failure.run.case).write, failure.log)
    if not failure.smaller_log.exists():
        write_whole(simulation.run(failure.smaller.case).write, failure.smaller_log)
    if not failure.clip.exists():
        spec = failure.smaller.spec
        cut_clip(open_source(failure.smaller_log), simulation.files, failure.clip, DEFAULT_OPTIONS, of=[spec])


def _cost(run: SearchedRun) -> float:
    return min(max(run.robustness, -LARGEST_COST), LARGEST_COST)

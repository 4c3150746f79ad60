"""A simulated world whose robot does what a planner decides, recorded with every decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from spatial_replay.automata.automaton import Automaton
from spatial_replay.errors import UsageError
from spatial_replay.inspection.annotation import kept_files
from spatial_replay.inspection.automata import KeptAutomaton
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.planning.black_box import PLAN_METADATA, BlackBox
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings_text import text_from_settings
from spatial_replay.planning.step import Kind, Step
from spatial_replay.planning.warm_up import warm_up
from spatial_replay.runs.care import settings_for
from spatial_replay.runs.executor import WorldExecutor
from spatial_replay.runs.names import refuse_unknown_names
from spatial_replay.runs.plan_loop import PlanLoop
from spatial_replay.runs.run_log import RunLog, run_log
from spatial_replay.runs.scripted import about_run
from spatial_replay.simulation.injection import Injection
from spatial_replay.simulation.world import World
from spatial_replay.simulation.worlds import default_specification, make_world
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """What was planned and recorded.

    Attributes:
        samples: how many samples.
        seconds: from the first to the last.
        ended: the kind of the last decision: "hold" where the specification is satisfied, as far as the
            planner can tell.
        name: of the spec that was planned for.
        verdict: what the log says of that, uncertainty of positions included.
        reason: the last decision in words.
        steps: how many motions were executed.
        pruned: how many edges of the automaton were given up.
        planning_s: how long the planner thought, in seconds of real time.
    """

    samples: int
    seconds: float
    ended: Kind
    name: str
    verdict: Verdict
    reason: str
    steps: int
    pruned: int
    planning_s: float

    @property
    def satisfied(self) -> bool:
        """Whether the run ended with the specification satisfied, for the planner and for the log."""
        return self.ended == "hold" and self.verdict == Verdict.SATISFIED


def record_plan(
    scenario: str,
    output: Path,
    file: Specification | None = None,
    *,
    name: str | None = None,
    seed: int = 0,
    noise_m: float = 0.0,
    injections: Sequence[Injection] = (),
    gui: bool = False,
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> PlannedRun:
    """Let a planner satisfy a specification in a scenario's world; equal arguments give equal bytes.

    Args:
        file: what to plan for; None takes the scenario's own.
        name: which of its results to plan for; without it, the only one. All are evaluated.
        inputs: files that the output must not be.
        advance: told how many more samples are done.

    Raises:
        NoAutomatonError: a specification without an automaton.
        SpecificationError: names that the world does not have.
        UsageError: no such scenario, no simulator, no such result, several to choose from, one that cannot be
            planned for.
        OutputError: the output cannot be written.
    """
    (kept,) = kept_files([default_specification(scenario) if file is None else file])
    _refuse_missing(kept, name)
    made = about_run(scenario, seed=seed, noise_m=noise_m, injections=injections)
    about = {**made, "planned": "true"}
    # a world or a planner that cannot be made leaves the output alone
    with closing(make_world(scenario, seed=seed, noise_m=noise_m, injections=injections, gui=gui)) as world:
        refuse_unknown_names([kept], world.sample())
        planner = Planner(kept, settings_for(world), name=name)
        warm_up()
        with run_log(output, [kept], about, inputs, _known(kept, planner.automaton)) as log:
            log.add_metadata(PLAN_METADATA, _plan(planner, kept))
            loop = PlanLoop(BlackBox(planner), log, WorldExecutor(world, world.skill), world.step)
            last = _satisfied(world, loop, advance)
        return _told(log, loop, planner.automaton.name, last)


def _satisfied(world: World, loop: PlanLoop, advance: Callable[[int], None]) -> Step:
    """The last decision of a loop that hears every sample of a world."""

    def hear(sample: Sample) -> None:
        loop.observe(sample)
        advance(1)

    world.attach(hear)
    return loop.run()


def _told(log: RunLog, loop: PlanLoop, name: str, last: Step) -> PlannedRun:
    """What came of a run that has ended."""
    return PlannedRun(
        samples=log.samples,
        seconds=log.seconds,
        ended=last.kind,
        name=name,
        verdict=log.verdicts[name],
        reason=last.reason,
        steps=loop.executed,
        pruned=len(last.pruned),
        planning_s=loop.planning_s,
    )


def _plan(planner: Planner, file: Specification) -> dict[str, str]:
    """What a log's metadata keeps to make the decisions again."""
    return {
        "settings": text_from_settings(planner.settings),
        "file": file.filename,
        "specification": planner.automaton.name,
    }


def _refuse_missing(file: Specification, name: str | None) -> None:
    """That a file has a result.

    Raises:
        UsageError: it has none of that name.
    """
    results = [spec.name for spec in file.results]
    if name is not None and name not in results:
        raise UsageError(f"{file.filename} has no result {name!r}; its results are: {', '.join(results)}")


def _known(file: Specification, automaton: Automaton) -> list[KeptAutomaton]:
    """The automaton that is planned with, as a log keeps it."""
    return [
        KeptAutomaton(spec.name, file, spec, automaton)
        for spec in file.results
        if spec.name == automaton.name
    ]

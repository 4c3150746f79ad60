"""A simulated world whose robot does what a planner decides, recorded with every decision.

A planner, what executes its steps and the log of both, from the first sample to the end.

The robot of a simulated world as what executes a planner's steps.

How finely and how carefully is planned in a simulated world.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.annotate.specification import logged_specifications
from spatial_replay.automata.automaton import Automaton
from spatial_replay.errors import UsageError
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.planning.decision_log import PLAN_METADATA, BlackBox
from spatial_replay.planning.decisions import Executor, Kind, Outcome, Step
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings import Settings, Skill, text_from_settings
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.recording.recorder import warm_up_planner
from spatial_replay.runs.run_log import RunLog, run_log
from spatial_replay.runs.scripted import about_run, refuse_unknown_names
from spatial_replay.simulation.injection import Injection
from spatial_replay.simulation.world import World
from spatial_replay.simulation.worlds import default_specification, make_world
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample


@dataclass(frozen=True, slots=True)
class _Care:
    """How finely and carefully is planned for a skill, in metres."""

    cell_size: float
    margin: float
    constraint_margin: float
    clearance: float
    room: float


_CARE: MappingProxyType[Skill, _Care] = MappingProxyType(
    {
        # a block that is pushed ends up within a centimetre of where it should
        "push": _Care(cell_size=0.005, margin=0.012, constraint_margin=0.008, clearance=0.0, room=0.0),
        # fingers need room beside what they hold, and the hand above that beside taller things
        "place": _Care(cell_size=0.02, margin=0.01, constraint_margin=0.01, clearance=0.02, room=0.09),
    }
)


def settings_for(world: World) -> Settings:
    """How to plan in a world."""
    bodies, space = world.bodies, world.workspace
    skill: Skill = world.skill
    care = _CARE[skill]
    workspace = Workspace(
        Grid.over(space.xmin, space.ymin, space.xmax, space.ymax, care.cell_size),
        yaws=space.yaws,
        nearest=space.nearest,
        farthest=space.farthest,
        obstacles=tuple(world.obstacles),
        supports=frozenset(body.name for body in bodies if body.support),
        clearance=care.clearance,
    )
    return Settings(
        workspace,
        skill,
        movable=tuple(body.name for body in bodies if body.movable),
        margin=care.margin,
        constraint_margin=care.constraint_margin,
        room=care.room,
    )


class WorldExecutor:
    """The robot of a simulated world as an `Executor`."""

    def __init__(self, world: World, skill: Skill) -> None:
        self._world = world
        self._skill = skill

    def execute(self, step: Step) -> Outcome:
        """See `Executor`.

        Raises:
            UsageError: the step moves nothing.
        """
        target = step.target
        if target is None:
            raise UsageError(f"step {step.number} ({step.kind}) moves nothing")
        if self._skill == "push":
            done = self._world.push(target.name, target.waypoints[1:] or target.waypoints)
        else:
            done = self._world.place(target.name, target.x, target.y, target.yaw)
        return Outcome(done.succeeded, done.reason)


HOLDING_SAMPLES = 30
"""How long it has to stay satisfied before a run ends."""
MOST_WAITING_SAMPLES = 150
"""How long it waits between two motions for what it does not see, or while nothing comes of it."""


class PlanLoop:
    """Lets a planner decide and an executor act until there is nothing more to do.

    Every sample goes to `observe`, during an execution too. The loop comes to an end: motions are bounded by
    the attempts of the automaton's edges, waiting by a number of samples in which the automaton does not get
    into another state.

    Attributes:
        executed: how many motions there were.
        planning_s: how long the planner thought, in seconds of real time.
    """

    def __init__(self, box: BlackBox, log: RunLog, executor: Executor, look: Callable[[], None]) -> None:
        """Begin before the first sample.

        Args:
            executor: its samples have to come to `observe`.
            look: lets one more sample come to `observe`, while nothing is moved.
        """
        self._box, self._log, self._executor, self._look = box, log, executor, look
        self.executed = 0
        self.planning_s = 0.0

    def observe(self, sample: Sample) -> None:
        """Take in the next sample.

        Raises:
            TraceError: it does not come after the one before.
            OutputError: the log cannot be written.
        """
        self._log.write(sample)
        began = time.perf_counter()
        self._box.observe(sample)
        self.planning_s += time.perf_counter() - began

    def run(self) -> Step:
        """Look, decide and act; the last decision."""
        self._look()
        waited, reached = 0, {self._box.planner.states}
        while True:
            step = self._decide()
            if step.kind == "execute":
                outcome = self._executor.execute(step)
                self._log.write_messages(self._box.conclude(outcome))
                self.executed, waited, reached = self.executed + 1, 0, {self._box.planner.states}
            elif step.kind == "wait" and waited < MOST_WAITING_SAMPLES:
                self._look()
                waited += not step.ahead or self._box.planner.states in reached
                reached.add(self._box.planner.states)
            elif step.kind != "hold" or self._holds():
                return step

    def _decide(self) -> Step:
        began = time.perf_counter()
        step, messages = self._box.decide()
        self.planning_s += time.perf_counter() - began
        self._log.write_messages(messages)
        return step

    def _holds(self) -> bool:
        """Whether it stays as satisfied as it can be while nothing is moved."""
        for _ in range(HOLDING_SAMPLES):
            self._look()
        planner = self._box.planner
        # doubt about the past stays, whatever is done
        return planner.is_accepting or planner.is_doubtful


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
    (kept,) = logged_specifications([default_specification(scenario) if file is None else file])
    _refuse_missing(kept, name)
    made = about_run(scenario, seed=seed, noise_m=noise_m, injections=injections)
    about = {**made, "planned": "true"}
    # a world or a planner that cannot be made leaves the output alone
    with closing(make_world(scenario, seed=seed, noise_m=noise_m, injections=injections, gui=gui)) as world:
        refuse_unknown_names([kept], world.sample())
        planner = Planner(kept, settings_for(world), name=name)
        warm_up_planner()
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


def _known(file: Specification, automaton: Automaton) -> list[SpecAutomaton]:
    """The automaton that is planned with, as a log keeps it."""
    return [
        SpecAutomaton(spec.name, file, spec, automaton)
        for spec in file.results
        if spec.name == automaton.name
    ]

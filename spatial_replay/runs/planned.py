"""Recordings of a planner that moves objects in a simulated world, with every decision.

`record_plan` sets up the world, the planner and the log. `recording.plan_loop` runs the planner.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Unpack

from spatial_replay import compiled
from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.annotate.specification import logged_specifications
from spatial_replay.automata.compile import chosen_spec
from spatial_replay.errors import UsageError
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.logs.behaviour_tree import TREE_CHANNEL, TreeTick
from spatial_replay.logs.output_file import Durability
from spatial_replay.logs.topics import PLAN_METADATA
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.planning.decision_log import BlackBox, plan_metadata
from spatial_replay.planning.decisions import Kind, Outcome, Step, sentence_of
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings import Grid, Settings, Skill, Workspace, changed_settings
from spatial_replay.recording.plan_loop import run_plan
from spatial_replay.runs.scripted import RunLog, about_run, refuse_unknown_names, run_log
from spatial_replay.runs.virtual_camera import open_film
from spatial_replay.sanity import refuse_unsatisfiable
from spatial_replay.simulation.tabletop import SAMPLES_PER_S, Tabletop, default_specification, make_world
from spatial_replay.simulation.world import Conditions
from spatial_replay.spec import parse_specification
from spatial_replay.spec.formula import Atom, Formula, Measurement, Specification
from spatial_replay.spec.walks import base_of, iter_expressions, iter_formulas
from spatial_replay.trace.trace import Sample

_PRESETS: Final[Mapping[Skill, Mapping[str, float]]] = MappingProxyType(
    {
        # a pushed block stops within a centimetre of its target; fingers need room behind it
        "push": {"cell_size": 0.005, "margin": 0.012, "constraint_margin": 0.008, "room": 0.04},
        # the fingers need room next to a held object, and the hand needs room next to taller objects
        "place": {
            "cell_size": 0.02,
            "margin": 0.01,
            "constraint_margin": 0.01,
            "clearance": 0.02,
            "room": 0.09,
            "lift": 0.15,
        },
    }
)
"""Planner settings of each skill: resolution and distances, metres, by the keys of settings files."""


def _yaws_text(yaws: Sequence[float]) -> str:
    degrees = ", ".join(f"{math.degrees(yaw):.0f}" for yaw in yaws)
    return f"objects may be turned to {degrees} degrees, since orientations are compared" if yaws else ""


_SAME_YAW: Final = math.radians(1.0)
"""Difference below which two yaws count as equal, radians."""


def settings_for(world: Tabletop) -> Settings:
    """Return the planner settings for a world."""
    body_names = {
        "supports": [body.name for body in world.bodies if body.support],
        "movable": [body.name for body in world.bodies if body.movable],
    }
    setting_values = {"skill": world.skill, **world.workspace, **body_names, **_PRESETS[world.skill]}
    return changed_settings(None, setting_values)


def _settings(world: Tabletop, formula: Formula, changes: Mapping[str, Any]) -> Settings:
    preset = settings_for(world)
    if not preset.workspace.yaws:
        yaws = yaws_for(formula, world.sample())
        preset = replace(preset, workspace=replace(preset.workspace, yaws=yaws))
    settings = changed_settings(preset, changes)
    if settings.skill != world.skill:
        raise UsageError(f"the robot of {world.name} can only {world.skill} objects; leave `skill` out")
    return settings


def yaws_for(formula: Formula, sample: Sample) -> tuple[float, ...]:
    """Return the yaws, in radians, that objects may need for a formula; none if the formula compares no yaws.

    These are the yaws of the compared objects, as in `a oriented[k] b`. The first of these yaws is also
    returned with quarter turns.
    """
    atoms = [part for part in iter_formulas(formula) if isinstance(part, Atom)]
    expressions = [part for atom in atoms for part in iter_expressions(atom.expression)]
    measurements = [part for part in expressions if isinstance(part, Measurement) and part.needs_orientation]
    compared_terms = [term for measurement in measurements for term in measurement.terms]
    tracked_objects = [sample.objects.get(getattr(base_of(term), "name", "")) for term in compared_terms]
    present_yaws = [
        tracked_object.yaw
        for tracked_object in tracked_objects
        if tracked_object is not None and tracked_object.yaw is not None
    ]
    yaws: list[float] = []
    for yaw in (
        *present_yaws,
        *(quarters * math.pi / 2 + yaw for yaw in present_yaws[:1] for quarters in (1, 2, 3)),
    ):
        if all(abs(math.remainder(yaw - earlier_yaw, math.tau)) > _SAME_YAW for earlier_yaw in yaws):
            yaws.append(math.remainder(yaw, math.tau))
    return tuple(sorted(yaws))


def execute_in(world: Tabletop, settings: Settings, step: Step) -> Outcome:
    """Execute a step with the robot of a simulated world.

    Raises:
        UsageError: the step has no motion.
    """
    target = step.target
    if target is None:
        raise UsageError(f"step {step.number} ({step.kind}) moves nothing")
    if settings.skill == "push":
        # strokes turn objects, which matters only if the planner plans orientations
        yaw = target.yaw if settings.workspace.yaws else None
        # the first waypoint is the place of the object itself
        return world.push(target.name, target.waypoints[1:] or target.waypoints, yaw)
    return world.place(target.name, target.x, target.y, target.yaw, target.waypoints[1:-1])


def _log_tick(log: RunLog, tick: TreeTick, time_ns: int) -> None:
    """Log a tick of the robot's behaviour tree at the time of the newest sample."""
    log.write_payload(TREE_CHANNEL, log.newest_ns, tick.payload(time_ns))


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """The result of a planned run.

    Attributes:
        samples: number of samples.
        seconds: time from the first to the last sample.
        ended: kind of the last decision; "hold" if the planner observed that the spec is satisfied.
        name: name of the planned spec.
        verdict: verdict of the planned spec in the log, which includes the uncertainty of positions.
        reason: sentence on the last decision.
        steps: number of executed motions.
        pruned: number of pruned edges of the automaton.
        planning_s: wall time of the planning, s.
        bounds: sentence on bounds in seconds and their numbers of samples; empty without such bounds.
        yaws: sentence on the yaws to which objects may be turned; empty if the spec compares no yaws.
        others: verdicts, by name, of the specifications that were not given to the planner.
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
    bounds: str = ""
    yaws: str = ""
    others: Mapping[str, Verdict] = field(default_factory=dict)


def record_plan(
    scenario: str,
    output: Path,
    file: Specification | None = None,
    *,
    name: str | None = None,
    cameras: Sequence[Path] = (),
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
    durability: Durability = "process",
    changes: Mapping[str, Any] = MappingProxyType({}),
    timings: bool = False,
    also: Sequence[Specification] = (),
    **conditions: Unpack[Conditions],
) -> PlannedRun:
    """Record a run in which a planner works towards a specification in a scenario's world.

    Equal arguments give equal bytes.

    Args:
        file: specification to plan for; None for the scenario's specification.
        also: further specifications to evaluate, which the planner does not receive.
        name: result to plan for, required if the file has several results. All results are evaluated.
        cameras: paths of one or two videos of the run. Their tags file is written next to the first video.
        inputs: input files, which the output must not overwrite.
        advance: called with the number of new samples.
        durability: "disk" to force each written chunk to the disk at once.
        changes: changes of the planner's settings for the world, by the keys of settings files.
        timings: also log the duration of each decision; logs of equal arguments then differ.

    Raises:
        NoAutomatonError: a specification without an automaton.
        SpecificationError: no run satisfies the result, or the specification names missing objects.
        UsageError: no such scenario, no simulator, no such result, several results without `name`, or a
            result that cannot be planned for.
        OutputError: the output cannot be written.
    """
    files = [default_specification(scenario) if file is None else file, *also]
    main_file, *further_files = logged_specifications(files, {})
    result_names = [spec.name for spec in main_file.results]
    if name is not None and name not in result_names:
        raise UsageError(
            f"{main_file.filename} has no result {name!r}; its results are: {', '.join(result_names)}"
        )
    spec = chosen_spec(main_file, name)
    refuse_unsatisfiable(main_file, spec.name)
    metadata = {**about_run(scenario, **conditions), "planned": "true"}
    # an error in the world or the planner leaves the output untouched
    with closing(make_world(scenario, **conditions)) as world:
        refuse_unknown_names([main_file, *further_files], world.sample())
        settings = _settings(world, spec.formula, changes)
        planner = Planner(main_file, settings, name=name, rate_hz=SAMPLES_PER_S)
        warm_up_planner()
        # a replay does not know the rate, so the log stores no automaton for bounds in seconds
        automata = (
            [SpecAutomaton(spec.name, main_file, spec, planner.automaton)] if planner.rate_hz is None else []
        )
        with (
            open_film(world, cameras, seed=conditions.get("seed", 0)) as film,
            run_log(output, [main_file, *further_files], metadata, inputs, automata, durability) as log,
        ):
            log.add_metadata(PLAN_METADATA, plan_metadata(planner, main_file.filename))
            black_box = BlackBox(planner, log.write_messages, timings=timings)

            def observe(sample: Sample) -> str:
                log.write(sample)
                black_box.observe(sample)
                if film is not None:
                    film.take(sample)
                advance(1)
                return planner.stop_reason

            world.attach(observe, lambda tick: _log_tick(log, tick, world.time_ns))
            last_step = run_plan(black_box, partial(execute_in, world, planner.settings), world.step)
        return PlannedRun(
            samples=log.samples,
            seconds=log.seconds,
            ended=last_step.kind,
            name=planner.automaton.name,
            verdict=log.verdicts[planner.automaton.name],
            reason=sentence_of(last_step),
            steps=planner.motions,
            pruned=len(last_step.pruned),
            planning_s=black_box.planning_s,
            bounds=planner.bounds,
            yaws="" if "yaws" in {*world.workspace, *changes} else _yaws_text(settings.workspace.yaws),
            others={name: verdict for name, verdict in log.verdicts.items() if name not in result_names},
        )


def warm_up_planner() -> None:
    """Plan a push without executing it, so that the code of the planner is loaded before the first decision.

    With an empty compiler cache, code is interpreted until a child process has compiled it.
    """
    compiled.start("plan", _plan_trial)


def _plan_trial() -> None:
    task = parse_specification("F (cup leftof jug and cup dist jug >= 1)")
    workspace = Workspace(Grid(0.0, 0.0, 1.0, 8, 8), obstacles=(Footprint.box(0, 0, 1, 1),))
    black_box = BlackBox(Planner(task, Settings(workspace, "push")))
    objects = {
        "cup": TrackedObject(Footprint.box(6, 6, 7, 7), yaw=0.0, height=(0.0, 1.0)),
        "jug": TrackedObject(Footprint.disc(4, 4, 1), height=(0.0, 1.0)),
    }
    black_box.observe(Sample(0, objects))
    black_box.next_step()

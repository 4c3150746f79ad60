"""A simulated world whose robot follows a script, recorded."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.logs.output_file import Durability
from spatial_replay.runs.run_log import RunLog, run_log
from spatial_replay.runs.virtual_camera import Film, open_film
from spatial_replay.simulation.tabletop import Tabletop
from spatial_replay.simulation.world import Execution, Injection, Start
from spatial_replay.simulation.worlds import default_specification, make_world
from spatial_replay.spec import check_names
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.units import Axes


def refuse_unknown_names(files: Iterable[Specification], sample: Sample) -> None:
    """Check that a world has the objects and signals that specifications name.

    Args:
        sample: a sample of the world, which always shows all objects.

    Raises:
        SpecificationError: with every missing name.
    """
    objects, signals = sorted(sample.objects), sorted(sample.signals)
    remarks = [remark for file in files for remark in check_names(file, objects, signals, where="world")]
    missing = [remark for remark in remarks if remark.severity == "error"]
    if missing:
        raise SpecificationError(missing)


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """The result of a simulated run.

    Attributes:
        samples: number of samples.
        seconds: from the first to the last.
        objects: their names.
        outcome: how the robot's motion ended, in words.
    """

    samples: int
    seconds: float
    objects: tuple[str, ...]
    outcome: str


def record_script(
    scenario: str,
    output: Path,
    files: Sequence[Specification] | None = None,
    *,
    seed: int = 0,
    duration_ns: int | None = None,
    noise_m: float = 0.0,
    injections: Sequence[Injection] = (),
    starts: Sequence[Start] = (),
    gui: bool = False,
    cameras: Sequence[Path] = (),
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
    durability: Durability = "process",
) -> SimulatedRun:
    """Record a scenario's world while its robot follows the script; equal arguments give equal bytes.

    Args:
        files: specifications to evaluate during the run; None takes that of the scenario.
        starts: where bodies are at the beginning, in place of where the seed puts them.
        cameras: one or two videos to make of the run; beside the first, their tags file is written.
        duration_ns: duration in simulated time; None ends with the script.
        inputs: files that the output must not be.
        advance: called with the number of new samples.
        durability: "disk" for a log of which the disk has each chunk as soon as it is written.

    Raises:
        SpecificationError: names that the world does not have.
        UsageError: no such scenario, no simulator, a duration of 0, a specification that cannot be recorded.
        OutputError: the output cannot be written.
    """
    if duration_ns is not None and duration_ns <= 0:
        raise UsageError("a run of 0 s has no sample; give a longer duration")
    files = [default_specification(scenario)] if files is None else list(files)
    about = about_run(scenario, seed=seed, noise_m=noise_m, injections=injections, starts=starts)
    # an error in the world or a missing name leaves the output untouched
    made = make_world(scenario, seed=seed, noise_m=noise_m, injections=injections, starts=starts, gui=gui)
    with closing(made) as world:
        refuse_unknown_names(files, world.sample())
        with (
            open_film(world, cameras, seed=seed) as film,
            run_log(output, files, about, inputs, durability=durability) as log,
        ):
            result = _follow_script(world, log, film, duration_ns, advance)
        outcome = "stopped in the middle of its motion" if result is None else result.reason
        return SimulatedRun(log.samples, log.seconds, tuple(world.scene.bodies), outcome)


def simulate_script(
    scenario: str,
    *,
    seed: int = 0,
    noise_m: float = 0.0,
    injections: Sequence[Injection] = (),
    starts: Sequence[Start] = (),
) -> list[Sample]:
    """Return the samples of a scripted run without a log; those that `record_script` records.

    Raises:
        UsageError: no such scenario, no simulator.
    """
    samples: list[Sample] = []
    made = make_world(scenario, seed=seed, noise_m=noise_m, injections=injections, starts=starts)
    with closing(made) as world:
        world.attach(samples.append)
        world.follow(world.script(), None)
    return samples


def about_run(
    scenario: str, *, seed: int, noise_m: float, injections: Sequence[Injection], starts: Sequence[Start]
) -> dict[str, str]:
    """Return the metadata about how a run was made."""
    options = {"seed": seed, "noise_m": noise_m, "inject": [str(each) for each in injections]}
    if starts:
        options["start"] = [str(each) for each in starts]
    # worlds are simulated in metres
    axes = Axes(unit="m").metadata()
    return {"source": scenario, "seed": str(seed), "options": json.dumps(options), **axes}


def _follow_script(
    world: Tabletop, log: RunLog, film: Film | None, duration_ns: int | None, advance: Callable[[int], None]
) -> Execution | None:
    """Follow the script and log every sample; return its result, None if the duration ended before it."""

    def observe(sample: Sample) -> None:
        log.write(sample)
        if film is not None:
            film.take(sample)
        advance(1)

    world.attach(observe)
    result = world.follow(world.script(), duration_ns)
    if not log.samples:
        # without a motion there is no sample: take the one of the world at rest
        world.step()
    return result

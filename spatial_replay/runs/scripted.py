"""A simulated world whose robot follows a script, recorded.

Names in specifications, compared with what a simulated world has.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.runs.run_log import RunLog, run_log
from spatial_replay.simulation.injection import Injection
from spatial_replay.simulation.tabletop import Tabletop
from spatial_replay.simulation.world import Execution
from spatial_replay.simulation.worlds import default_specification, make_world
from spatial_replay.spec import check_names
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample


def refuse_unknown_names(files: Iterable[Specification], sample: Sample) -> None:
    """That a world has what specifications name.

    Args:
        sample: of the world, which always shows everything that it has.

    Raises:
        SpecificationError: with every name that it does not have.
    """
    objects, signals = sorted(sample.objects), sorted(sample.signals)
    remarks = [remark for file in files for remark in check_names(file, objects, signals, where="world")]
    missing = [remark for remark in remarks if remark.severity == "error"]
    if missing:
        raise SpecificationError(missing)


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """What was recorded.

    Attributes:
        samples: how many samples.
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
    gui: bool = False,
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> SimulatedRun:
    """Record a scenario's world while its robot follows the script; equal arguments give equal bytes.

    Args:
        files: specifications to evaluate meanwhile; None takes the scenario's own.
        duration_ns: how long, in simulated time; None ends with the script.
        inputs: files that the output must not be.
        advance: told how many more samples are done.

    Raises:
        SpecificationError: names that the world does not have.
        UsageError: no such scenario, no simulator, a duration of 0, a specification that cannot be recorded.
        OutputError: the output cannot be written.
    """
    if duration_ns is not None and duration_ns <= 0:
        raise UsageError("a run of 0 s has no sample; give a longer duration")
    files = [default_specification(scenario)] if files is None else list(files)
    about = about_run(scenario, seed=seed, noise_m=noise_m, injections=injections)
    # a world that cannot be made, or has not what is named, leaves the output alone
    with closing(make_world(scenario, seed=seed, noise_m=noise_m, injections=injections, gui=gui)) as world:
        refuse_unknown_names(files, world.sample())
        with run_log(output, files, about, inputs) as log:
            result = _followed(world, log, duration_ns, advance)
        outcome = "stopped in the middle of its motion" if result is None else result.reason
        return SimulatedRun(log.samples, log.seconds, tuple(world.scene.bodies), outcome)


def about_run(scenario: str, *, seed: int, noise_m: float, injections: Sequence[Injection]) -> dict[str, str]:
    """What a log's metadata keeps of how a run was made."""
    options = {"seed": seed, "noise_m": noise_m, "inject": [str(each) for each in injections]}
    return {"source": scenario, "seed": str(seed), "options": json.dumps(options)}


def _followed(
    world: Tabletop, log: RunLog, duration_ns: int | None, advance: Callable[[int], None]
) -> Execution | None:
    """How the script went, every sample of it in the log; None if it was not done within the duration."""

    def hear(sample: Sample) -> None:
        log.write(sample)
        advance(1)

    world.attach(hear)
    result = world.follow(world.script(), duration_ns)
    if not log.samples:
        # the robot had nothing to do, or could do nothing
        world.step()
    return result

"""`spatial-replay warmup`: compile every kernel ahead of time, for images and machines that start often.

Kernels are compiled for the types of their arguments. Warming up therefore does a little of everything:
record, replay, explain, plan, compare, read a bag. The tasks are shared among the processor's cores.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from types import MappingProxyType

import click

from spatial_replay.bags.ros1 import record_table
from spatial_replay.cli.terminal import progress, show
from spatial_replay.compare.runs import diff_sources
from spatial_replay.compiled import cache_folder, compilations, only, write_note
from spatial_replay.errors import OutputError
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.logs.source import MemorySource
from spatial_replay.monitor.monitor import Monitor
from spatial_replay.monitor.result import evaluate
from spatial_replay.recording.recorder import Recorder
from spatial_replay.replay.engine import run_replay
from spatial_replay.runs.planned import warm_up_planner
from spatial_replay.sources.open_log import open_source
from spatial_replay.spec import parse_specification
from spatial_replay.trace.trace import Sample, Trace

_SPECIFICATION = """\
region goal = box(0, 0, 4, 4)
group things = class "thing"
spec reach = F (cup enclosedin goal)
spec apart = G (cup dist jug >= 0 -> F[0, 2] cup leftof jug)
spec timed = G[0s, 2s] (cup oriented[1] jug) and H[0, 2] (cup farfrom[0.1] jug[-1])
spec open = G (forall x in things: x dist goal >= 0) and (load >= 1) U[0, 3] (cup touch[1] jug)
spec nested = G (F[0, 2] G[0, 1] (cup ovlp jug))
spec crowd = G (forall x, y in things: x dist y >= 0)
spec calm = G (speed(cup) <= 9 and speed(cup, jug) <= 9)
"""
_PAPER = "region goal = box(0, 0, 4, 4)\nspec reach = (F (cup enclosedin goal)) and G[0, 2] (cup ovlp jug)"


def warm_up_kernels(workers: int, advance: Callable[[int], None] = lambda steps: None) -> Path | None:
    """Compile every kernel into the cache, and return the cache's folder; None if no folder is writable.

    Args:
        workers: number of processes.
        advance: called with 1 after each of the `len(TASKS)` tasks.
    """
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for task in as_completed([pool.submit(_run, name) for name in TASKS]):
            task.result()
            advance(1)
    return cache_folder()


def _run(name: str) -> None:
    with compilations(lambda: None), only("compiled"):
        TASKS[name]()
    write_note(name)


def compile_task(name: str) -> None:
    """Compile the kernels of a task at low priority, for another program that runs at the same time."""
    os.nice(10)
    _run(name)


def _samples() -> list[Sample]:
    box, disc = Footprint.box(0, 0, 1, 1), Footprint.disc(3, 0, 0.5)
    shapes = (box, disc, Footprint((*box.parts, *disc.parts)))
    return [
        Sample(
            second * 10**9,
            {
                name: TrackedObject(shapes[(second + index) % 3], "thing", 0.1 * second, (0.0, 1.0), 0.01)
                for index, name in enumerate(("cup", "jug"))
            },
            {"load": float(second)},
        )
        for second in range(6)
    ]


def _record_and_replay() -> None:
    specification = parse_specification(_SPECIFICATION)
    with tempfile.TemporaryDirectory() as folder:
        log, annotated = Path(folder, "log.mcap"), Path(folder, "annotated.mcap")
        with Recorder(log, specifications=[specification]) as recorder:
            for sample in _samples():
                recorder.write(sample)
        run_replay(open_source(log), [specification], output=annotated)


def _evaluate() -> None:
    for result in evaluate(parse_specification(_SPECIFICATION), Trace.from_samples(_samples())):
        result.full_signal()
        result.window_signal(2 * 10**9)
        result.witness()


def _monitor() -> None:
    monitor = Monitor(parse_specification(_SPECIFICATION))
    for sample in _samples():
        monitor.update(sample)


def _evaluate_as_the_paper() -> None:
    specification = parse_specification(_PAPER)
    evaluate(specification, Trace.from_samples(_samples()), semantics="paper")
    monitor = Monitor(specification, semantics="paper")
    for sample in _samples():
        monitor.update(sample)


def _compare() -> None:
    samples = _samples()
    sources = [MemorySource(Trace.from_samples(run_samples)) for run_samples in (samples, samples[1:])]
    diff_sources((sources[0], sources[1]))


def _read_bag() -> None:
    record_table(b"\0" * 8)


TASKS: Mapping[str, Callable[[], None]] = MappingProxyType(
    {
        "record and replay": _record_and_replay,
        "evaluate": _evaluate,
        "monitor": _monitor,
        "plan": warm_up_planner,
        "paper": _evaluate_as_the_paper,
        "compare": _compare,
        "bag": _read_bag,
    }
)
"""Tasks by name, the longest first: a long last task would leave cores idle."""


@click.command()
@click.option(
    "--jobs", type=click.IntRange(1), default=None, help="Number of processes.  [default: one per core]"
)
def warmup(jobs: int | None) -> None:
    """Compile every kernel once, for all later runs on this machine.

    Use the command in container images, and before a control loop. Short logs are evaluated without compiled
    code. The code is stored next to the installed package or, if that is read-only, in the user's cache
    folder. SPATIAL_REPLAY_CACHE names another folder.

    \b
    Examples, the second in a Dockerfile:
      spatial-replay warmup
      RUN pip install . && spatial-replay warmup
    """
    with progress("compiling", len(TASKS)) as advance:
        folder = warm_up_kernels(jobs or len(os.sched_getaffinity(0)), advance)
    if folder is None:
        raise OutputError(
            "no folder for compiled code can be written; name one with SPATIAL_REPLAY_CACHE=FOLDER"
        )
    show(f"compiled into {folder}")

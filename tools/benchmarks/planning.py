"""Maps and paths of the pushing task, and whole planned runs in simulated worlds."""

from __future__ import annotations

import importlib.util
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import spatial_replay as sr
from spatial_replay.automata.compile import automaton
from spatial_replay.compiled import only
from spatial_replay.planning import Grid, Workspace, map_layers, moved_object, redo_decisions
from spatial_replay.planning.maps import distance_between, gradient_map, proposition_maps
from spatial_replay.planning.paths import shortest_path
from spatial_replay.sources import open_source

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"

PUSHING = """
use spatial_spec
spec push = (F (green rightof red and green rightof blue))
    and ((not (green rightof red and green rightof blue)) U (red above blue))
    and (G (green dist red >= 0.03 and green dist blue >= 0.03 and red dist blue >= 0.03))
"""
RUNS = {"push": 60.0, "pick-place": 300.0, "table-setting": 300.0}
"""Limit of a whole run by world, seconds of real time."""
SEEDS = 10


def _blocks() -> sr.Sample:
    def block(x: float, y: float, yaw: float) -> sr.TrackedObject:
        shape = sr.TrackedObject(sr.Footprint.box(-0.016, -0.016, 0.016, 0.016), yaw=0.0, height=(0.0, 0.032))
        return moved_object(shape, x, y, yaw)

    places = {
        "green": (0.4, 0.0, 0.0),
        "red": (0.5, -0.05, math.pi / 4),
        "blue": (0.6, 0.15, math.pi / 4),
    }
    return sr.Sample(0, {name: block(*place) for name, place in places.items()})


def bench_gradient_map(bench: Any) -> None:
    """The progress and constraint sets of one step for each block, 90 x 90 and 360 x 360 cells.

    The published code takes 2.1 s for 90 x 90.
    """
    specification = sr.parse_specification(PUSHING)
    machine, sample = automaton(specification), _blocks()
    formulas = [each.formula for each in machine.propositions]
    (first, *_) = next(machine.paths(0, {(0, 3)}))
    progress = first.guard
    constraints = tuple(
        cube
        for each in machine.transitions
        if each.source == 0 and each.target not in (0, first.target)
        for cube in each.guard
    )
    for side, resolution, limit_s in ((90, 0.005, 0.005), (360, 0.00125, 0.040)):
        workspace = Workspace(Grid.over(0.3, -0.225, 0.75, 0.225, resolution))
        for name in sample.objects:

            def run(_: object, name: str = name, workspace: Workspace = workspace) -> object:
                maps = proposition_maps(formulas, specification.regions, sample, name, workspace)
                return gradient_map(maps, progress, constraints, workspace)

            bench.measure(
                f"{side} x {side}, moving {name}",
                run,
                unit="object",
                runs=21,
                limit_s=limit_s,
                reference_s=2.1 * (side / 90) ** 2,
            )


def bench_map_distances(bench: Any) -> None:
    """Distances from a box at 90 x 90 cells to 10 boxes, against vectorised shapely."""
    import shapely

    random, names = np.random.default_rng(3), [f"o{number}" for number in range(11)]
    shape = sr.TrackedObject(sr.Footprint.box(-0.03, -0.02, 0.03, 0.02), yaw=0.0)
    poses = random.uniform((0.05, 0.05, 0.0), (0.85, 0.85, 3.0), (len(names), 3)).tolist()
    objects = {name: moved_object(shape, *pose) for name, pose in zip(names, poses, strict=True)}
    sample, workspace = sr.Sample(0, objects), Workspace(Grid.over(0.0, 0.0, 0.9, 0.9, 0.01))
    atoms = [distance_between("o0", name) for name in names[1:]]
    corners = [tracked.footprint.parts[0].vertices for tracked in objects.values()]
    others = shapely.polygons(corners[1:])
    shifts = workspace.grid.centres() - np.array(poses[0][:2])

    def by_shapely(_: object) -> object:
        moved = shapely.polygons(corners[0] + shifts[:, None])
        return shapely.distance(moved[:, None], others)

    peer = bench.measure("shapely, vectorised", by_shapely, unit="map", runs=7)
    with only("compiled"):
        maps = bench.measure(
            "one moved box, 10 others",
            lambda _: proposition_maps(atoms, {}, sample, "o0", workspace),
            unit="map",
            runs=7,
        )
    bench.ratio("a map to shapely", maps.median_s / peer.median_s, 1 / 3)


def bench_map_layers(bench: Any) -> None:
    """Data of a logged map besides robustness: layers, limits and blocks of each cell."""
    specification, sample = sr.parse_specification(PUSHING), _blocks()
    machine = automaton(specification)
    formulas = [each.formula for each in machine.propositions]
    (first, *_) = next(machine.paths(0, {(0, 3)}))
    workspace = Workspace(Grid.over(0.3, -0.225, 0.75, 0.225, 0.005))
    settings = sr.Settings(workspace, "push")

    def one_map(_: object = None) -> Any:
        maps = proposition_maps(formulas, specification.regions, sample, "green", workspace)
        return gradient_map(maps, first.guard, (), workspace)

    made = one_map()
    plain = bench.measure("a map", one_map, unit="map", runs=21)
    layers = bench.measure(
        "its layers", lambda _: map_layers(made, settings), unit="map", runs=21, limit_s=0.05
    )
    bench.ratio("layers, in maps", layers.median_s / plain.median_s, 4.0)


def bench_redo(bench: Any) -> None:
    """Repeated decisions on the samples of a recorded push, and the time for reading these samples."""
    source = open_source(RECORDINGS / "push.mcap")

    def read(_: object) -> object:
        return sum(len(block.trace) for block in source.iter_blocks())

    bench.measure("reading the samples", read, unit="run", runs=5)
    bench.measure("nothing changed", lambda _: redo_decisions(source), unit="run", runs=5, limit_s=3.0)
    changes = {"margin": 0.02}
    bench.measure(
        "a larger margin", lambda _: redo_decisions(source, changes=changes), unit="run", runs=5, limit_s=3.0
    )


def bench_decision(bench: Any) -> None:
    """A decision on six objects for one region: the first of six motions, planned to the end."""
    names = [f"o{number}" for number in range(6)]
    shape = sr.TrackedObject(sr.Footprint.box(-0.04, -0.04, 0.04, 0.04), yaw=0.0)
    places = [(0.1 + 0.16 * (number % 3), 0.15 + 0.3 * (number // 3)) for number in range(6)]
    objects = {name: moved_object(shape, *place) for name, place in zip(names, places, strict=True)}
    text = f"group things = {', '.join(names)}\nregion goal = box(0.6, 0.1, 0.95, 0.5)\n"
    specification = sr.parse_specification(f"{text}spec s = F (forall o in things: o enclosedin goal)")
    workspace = Workspace(Grid.over(0.0, 0.0, 1.0, 1.0, 0.02), clearance=0.01)
    sample, formulas = sr.Sample(0, objects), [each.formula for each in automaton(specification).propositions]

    def planner(_: object = None) -> sr.Planner:
        made = sr.Planner(specification, sr.Settings(workspace, margin=0.005))
        made.observe(sample)
        return made

    def one_map(_: object) -> object:
        return proposition_maps(formulas, specification.regions, sample, "o0", workspace)

    one = bench.measure("a map of one object", one_map, unit="map", runs=21)
    decided = bench.measure(
        "six objects together",
        lambda made: made.next_step(),
        prepare=planner,
        unit="decision",
        runs=5,
        limit_s=1.0,
    )
    bench.ratio("a decision, in maps", decided.median_s / one.median_s, 150.0)


def bench_path(bench: Any) -> None:
    """Jump-point search over 90 x 90 cells, a fifth of them blocked."""
    free = np.random.default_rng(1).random((90, 90)) >= 0.2
    goals = np.zeros((90, 90), np.bool_)
    goals[85:, 85:] = True
    bench.measure("over 90 x 90 cells", lambda _: shortest_path(free, (0, 0), goals), unit="path", runs=51)


def bench_planned_runs(bench: Any) -> None:
    """Whole planned runs, recorded; ten seeds with --full."""
    if importlib.util.find_spec("pybullet") is None:
        bench.remark("the simulator is not installed: pip install '.[sim]'")
        return
    from spatial_replay.runs.planned import record_plan
    from spatial_replay.simulation.tabletop import SCENARIOS

    with tempfile.TemporaryDirectory() as folder:
        for scenario in SCENARIOS:
            runs = []

            def run(seed: int, scenario: str = scenario, runs: list[Any] = runs) -> object:
                runs.append(record_plan(scenario, Path(folder, "run.mcap"), seed=seed))
                return runs[-1]

            seeds = iter(range(1000))
            count = SEEDS if bench.full else 1
            bench.measure(
                scenario,
                run,
                prepare=lambda seeds=seeds: next(seeds),
                unit="run",
                runs=count,
                limit_s=RUNS[scenario],
            )
            thought = [each.planning_s for each in runs]
            bench.quantile(f"{scenario}: planning", thought, 0.5, unit="run", limit_s=1.0)
            failed = [each.reason for each in runs if each.verdict != "satisfied"]
            bench.remark(f"{scenario}: {len(runs) - len(failed)} of {len(runs)} runs end satisfied")
            for reason in failed:
                bench.remark(f"{scenario}: {reason}")

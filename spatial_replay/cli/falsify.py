"""`spatial-replay falsify`: search for simulated runs that violate a specification."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

from spatial_replay.cli.application import ExitCode, exit_code_from_verdicts
from spatial_replay.cli.options import (
    JsonCommand,
    constants_option,
    load_spec_options,
    specs_option,
)
from spatial_replay.cli.record import SCENARIOS
from spatial_replay.cli.terminal import progress, show, show_json
from spatial_replay.logs.remote import LogFile


@click.command(cls=JsonCommand)
@click.argument("scenario", type=click.Choice(list(SCENARIOS)))
@specs_option("Specification that has to hold; repeat for several.  [default: the scenario's own]")
@click.option(
    "-o",
    "--output",
    "folder",
    metavar="DIR",
    type=click.Path(path_type=Path),
    required=True,
    help="Folder for the runs, logs and clips; an interrupted search continues there.",
)
@click.option(
    "--vary",
    metavar="WHAT",
    multiple=True,
    help="A parameter to vary: noise=0:0.01, seed=0:999, start, start=0.02, start.OBJECT=0.02, drop@T,"
    " slip@T, slip@2s:9s; repeat for several.  [default: start]",
)
@click.option(
    "--budget",
    metavar="N",
    type=click.IntRange(1),
    default=200,
    show_default=True,
    help="Maximum number of runs of the search; reducing failures takes further runs.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the search.")
@click.option(
    "--planned", is_flag=True, help="Let the planner act for the scenario's task, instead of the script."
)
@click.option(
    "--jobs",
    metavar="N",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Processes that simulate.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
@constants_option
def falsify(
    scenario: str,
    specs: tuple[LogFile, ...],
    folder: Path,
    vary: tuple[str, ...],
    budget: int,
    seed: int,
    planned: bool,
    jobs: int,
    as_json: bool,
    constants: Mapping[str, float | str],
) -> ExitCode:
    """Search for runs of a simulated world that violate a specification.

    An optimiser varies noise, mishaps and starts, with the robustness of each run as its cost. Each violating
    run is a log in DIR/runs. DIR/smaller has the violating runs with as few changes as possible, and
    DIR/clips the shortest parts that show the violations. Equal options give equal files, with any number of
    jobs. Needs the extras `sim` and `falsify`.

    Exits with 1 if a run violates, 4 if none does and any is unknown, 0 if none was found.

    \b
    Examples:
      spatial-replay falsify push --spec safety.spatial -o found/
      spatial-replay falsify push --spec safety.spatial --vary start=0.02 --vary slip@T -o found/
      spatial-replay falsify pick-place --vary drop@T --vary start.mug=0.03 --jobs 4 -o found/
    """
    # imported here so that --help stays fast
    from spatial_replay.batch.run import workers_of
    from spatial_replay.falsification.failure_search import search_failures
    from spatial_replay.falsification.simulations import scenario_simulation
    from spatial_replay.simulation.tabletop import default_specification

    files = load_spec_options(specs, constants, lambda: default_specification(scenario))
    options = [word for spec in specs for word in ("--spec", str(spec))]
    options += [word for name, value in constants.items() for word in ("--const", f"{name}={value}")]
    simulation, parameters = scenario_simulation(scenario, files, vary, options, is_planned=planned)
    failures = search_failures(
        simulation, parameters, folder, workers_of(jobs), budget=budget, seed=seed, progress=progress
    )
    if as_json:
        show_json(failures.document)
    else:
        show(*failures.lines())
    return exit_code_from_verdicts([str(failures.verdict)])

"""`spatial-replay falsify`: search for simulated runs that violate a specification."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode, exit_code_from_verdicts
from spatial_replay.cli.options import (
    JsonCommand,
    constants_option,
    load_spec_options,
    profile_option,
    specs_option,
)
from spatial_replay.cli.record import SCENARIOS
from spatial_replay.cli.terminal import progress, show, show_json
from spatial_replay.logs.remote import LogFile
from spatial_replay.text import counted, with_unit

if TYPE_CHECKING:
    from spatial_replay.falsification.failures import Coverage, Failure, Falsification, SearchedRun

_MOST_LISTED = 20
"""The most failures that are listed; JSON and `failures.json` have all."""


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
    help="Folder for the runs, logs and clips; a search that ended early goes on there.",
)
@click.option(
    "--vary",
    metavar="WHAT",
    multiple=True,
    help="What to vary: noise=0:0.01, seed=0:999, start, start=0.02, start.OBJECT=0.02, drop@T, slip@T,"
    " slip@2s:9s; repeat for several.  [default: start]",
)
@click.option(
    "--budget",
    metavar="N",
    type=click.IntRange(1),
    default=200,
    show_default=True,
    help="Most runs of the search; to make the failures found smaller takes more.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the search.")
@click.option("--planned", is_flag=True, help="Let the planner act for the scenario's task, not the script.")
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
@profile_option
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
    profile: str | None,
) -> ExitCode:
    """Search for runs of a simulated world that violate a specification.

    An optimiser varies noise, mishaps and starts, with the robustness of each run as its cost. Each run that
    violates is a log in DIR/runs; the same with as little varied as possible is in DIR/smaller, and the
    shortest part that shows it in DIR/clips. Equal options give equal files, with any number of jobs. Needs
    the extras `sim` and `falsify`.

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
    from spatial_replay.simulation.worlds import default_specification

    files = load_spec_options(specs, profile, constants, lambda: default_specification(scenario))
    options = [word for spec in specs for word in ("--spec", str(spec))]
    options += [word for name, value in constants.items() for word in ("--const", f"{name}={value}")]
    options += [] if profile is None else ["--profile", profile]
    simulation, parameters = scenario_simulation(scenario, files, vary, options, is_planned=planned)
    found = search_failures(
        simulation,
        parameters,
        folder,
        workers_of(jobs),
        budget=budget,
        seed=seed,
        progress=progress,
    )
    if as_json:
        show_json(found.document)
    else:
        show(*_lines(found))
    return exit_code_from_verdicts([str(found.verdict)])


def _lines(found: Falsification) -> Iterator[str]:
    yield f"run 1, with nothing varied: {_judged(found.first)}"
    for each in found.parameters:
        if each.unit == "s" and found.first.seconds < each.high < math.inf:
            yield (
                f"{each.name}@{each.low:g}s:{each.high:g}s goes on after the end of that run, at"
                f" {found.first.seconds:g} s: from there on nothing happens"
            )
    if found.first.is_violated:
        yield "  the search ended with it: what fails without any variation needs no search"
    unknown = sum(run.verdict == "unknown" for run in found.runs)
    doubt = f", {unknown:,} unknown" if unknown else ""
    runs = counted(len(found.runs), "run")
    if found.failures:
        yield f"{runs} of {found.name}: {len(found.failures):,} violated{doubt}; the worst first:"
        for failure in found.failures[:_MOST_LISTED]:
            yield from _shown(found, failure)
        if len(found.failures) > _MOST_LISTED:
            yield f"  … and {len(found.failures) - _MOST_LISTED:,} more in failures.json"
    else:
        lowest = found.lowest
        yield f"{runs} of {found.name}: none violated{doubt}"
        yield f"  the lowest: run {lowest.number}, {_judged(lowest)}, with {found.text_of(lowest.case)}"
        if len({run.robustness for run in found.runs}) == 1 < len(found.runs):
            yield "  it is the same in every run: what is varied does not change it"
        elif not found.is_exhausted:
            yield "  that is no proof: the same command with a larger --budget goes on from there"
    if found.is_exhausted:
        yield "  the search ended early: there was nothing else to try"
    if len(found.runs) > 1:
        yield "covered, with the runs in each tenth of a range:"
        yield from _table(found.coverage)
    if found.impossible:
        yield f"  {counted(found.impossible, 'case')} left out, in which objects would lie in each other"
    if found.simulations:
        yield f"{counted(found.simulations, 'more run')} made the failures smaller"
    worst = min(found.failures, key=lambda each: each.smaller.robustness, default=None)
    if worst is not None and worst.command is not None:
        less = " with less" if worst.is_smaller else ""
        yield f"the worst again, run {worst.run.number}{less}: {worst.command}"


def _judged(run: SearchedRun) -> str:
    return f"{run.verdict}, {run.spec} {with_unit(run.robustness, run.unit)}"


def _shown(found: Falsification, failure: Failure) -> Iterator[str]:
    run = failure.run
    yield f"  {failure.log}  {run.spec} {with_unit(run.robustness, run.unit)}  {found.text_of(run.case)}"
    if failure.is_smaller:
        smaller = failure.smaller
        number = with_unit(smaller.robustness, smaller.unit)
        yield f"    with less: {failure.smaller_log}  {smaller.spec} {number}  {found.text_of(smaller.case)}"
    yield f"    clip: {failure.clip}"


def _table(covered: tuple[Coverage, ...]) -> Iterator[str]:
    names = max(len(each.parameter) for each in covered)
    spans = [f"{each.low:g} to {each.high:g}{f' {each.unit}' if each.unit else ''}" for each in covered]
    width = max(map(len, spans))
    for each, span in zip(covered, spans, strict=True):
        counts = " ".join(f"{count:3}" for count in each.tenths)
        yield f"  {each.parameter:<{names}}  {span:<{width}}  {counts}"

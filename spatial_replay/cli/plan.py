"""`spatial-replay plan`: let a planner satisfy a specification in a simulated world."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import exit_code_from_verdicts
from spatial_replay.cli.options import (
    LogPath,
    constants_option,
    durability_option,
    load_spec_options,
    log_output_option,
    profile_option,
    require_choice,
)
from spatial_replay.cli.progress import progress
from spatial_replay.cli.record import (
    SCENARIOS,
    SimulationArguments,
    parse_injections,
    show_film,
    simulation_options,
)
from spatial_replay.cli.terminal import show
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import counted

if TYPE_CHECKING:
    from spatial_replay.logs.output_file import Durability


@click.group()
def plan() -> None:
    """Plan a run in a simulated world, and record it with every decision.

    \b
    Example:
      spatial-replay plan push -o push.mcap --seed 3
    """


def planning_command(scenario: str) -> click.Command:
    """Return the command `plan SCENARIO`."""
    help_text = f"""Plan in a simulated world: {SCENARIOS[scenario]}.

    The planner decides what the robot moves, step by step, until the specification is satisfied or no path to
    acceptance is left. The log records every decision. Equal options give an equal log, byte for byte. Needs
    the extra `sim`. Exits with 0 if the planned specification is satisfied, 1 if it is violated, 4 if it is
    unknown or if the planner timed out.

    \b
    Examples:
      spatial-replay plan {scenario} -o run.mcap --seed 3
      spatial-replay plan {scenario} -o run.mcap --spec edited.spatial
      spatial-replay plan {scenario} -o run.mcap --spec several.spatial --of one
      spatial-replay info run.mcap --decisions
    """

    @click.command(scenario, help=help_text)
    @log_output_option("Log to write (MCAP).")
    @durability_option
    @click.option(
        "--spec",
        metavar="SPEC",
        type=LogPath(),
        help="Specification to plan for.  [default: the scenario's own]",
    )
    @click.option("--of", metavar="NAME", help="Result to plan for, if SPEC has several.")
    @constants_option
    @profile_option
    @simulation_options
    def command(
        output: Path,
        durability: Durability,
        spec: LogFile | None,
        of: str | None,
        constants: Mapping[str, float | str],
        profile: str | None,
        simulation: SimulationArguments,
    ) -> int:
        # imported here so that --help stays fast
        from spatial_replay.runs.planned import record_plan
        from spatial_replay.simulation.worlds import default_specification

        named = [] if spec is None else [spec]
        files = load_spec_options(named, profile, constants, lambda: default_specification(scenario))
        file = next(iter(files), None)
        if file is not None:
            require_choice(file, of)
        with progress("samples") as advance:
            planned = record_plan(
                scenario,
                output,
                file,
                name=of,
                seed=simulation["seed"],
                noise_m=simulation["noise"],
                injections=parse_injections(simulation["inject"]),
                gui=simulation["gui"],
                camera=simulation["camera"],
                inputs=local_files(named),
                advance=advance,
                durability=durability,
            )
        show(
            f"wrote {output}: {counted(planned.samples, 'sample')} over {planned.seconds:.3f} s; "
            f"{counted(planned.steps, 'motion')}, {counted(planned.pruned, 'edge')} given up"
        )
        show_film(simulation)
        show(f"planning took {planned.planning_s:.2f} s", err=True)
        show(f"the planner: {planned.reason}")
        if planned.ended == "no path":
            command_line = shlex.join(["spatial-replay", "info", str(output), "--decisions"])
            show(f"  {command_line} shows what was tried, and why it was given up")
        show(f"the log: {planned.name} is {planned.verdict}")
        # a planner that timed out ended the run: an unreached goal is then no violation
        return exit_code_from_verdicts(["unknown" if planned.ended == "wait" else planned.verdict])

    return command


for _scenario in SCENARIOS:
    plan.add_command(planning_command(_scenario))

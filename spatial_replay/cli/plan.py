"""`spatial-replay plan`: let a planner satisfy a specification in a simulated world."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from spatial_replay.cli.application import exit_code_from_verdicts
from spatial_replay.cli.options import output_option, profile_option, refuse_several
from spatial_replay.cli.progress import progress
from spatial_replay.cli.record import SCENARIOS, Simulating, injections_from, simulation_options
from spatial_replay.text import counted


@click.group()
def plan() -> None:
    """Plan a run in a simulated world, and record it with every decision.

    \b
    Example:
      spatial-replay plan push -o push.mcap --seed 3
    """


def planning_command(scenario: str) -> click.Command:
    """`plan SCENARIO`."""
    help_text = f"""Plan in a simulated world: {SCENARIOS[scenario]}.

    The planner decides what the robot moves, step by step, until the specification is satisfied or no path to
    that is left. The log tells what it decided and why. Equal options give an equal log, byte for byte. Needs
    the extra `sim`. Exits with 0 if the log says that what was planned for is satisfied, 1 if it is
    violated, 4 if that is unknown or the planner waited in vain.

    \b
    Examples:
      spatial-replay plan {scenario} -o run.mcap --seed 3
      spatial-replay plan {scenario} -o run.mcap --spec edited.spatial
      spatial-replay plan {scenario} -o run.mcap --spec several.spatial --of one
      spatial-replay info run.mcap --decisions
    """

    @click.command(scenario, help=help_text)
    @output_option("Write the log here.", required=True)
    @click.option(
        "--spec",
        metavar="SPEC",
        type=click.Path(path_type=Path),
        help="Plan for this specification instead of the scenario's own.",
    )
    @click.option("--of", metavar="NAME", help="What to plan for, where SPEC has several results.")
    @profile_option
    @simulation_options
    def command(
        output: Path, spec: Path | None, of: str | None, profile: str | None, simulating: Simulating
    ) -> int:
        # the simulator and the numerical libraries load when there is work for them
        from spatial_replay.runs.planned import record_plan
        from spatial_replay.spec import load_specification

        file = None if spec is None else load_specification(spec, profile=profile)
        if file is not None:
            refuse_several(file, of)
        with progress("samples") as advance:
            planned = record_plan(
                scenario,
                output,
                file,
                name=of,
                seed=simulating["seed"],
                noise_m=simulating["noise"],
                injections=injections_from(simulating["inject"]),
                gui=simulating["gui"],
                inputs=() if spec is None else (spec,),
                advance=advance,
            )
        click.echo(
            f"wrote {output}: {counted(planned.samples, 'sample')} over {planned.seconds:.3f} s; "
            f"{counted(planned.steps, 'motion')}, {counted(planned.pruned, 'edge')} given up"
        )
        click.echo(f"planning took {planned.planning_s:.2f} s", err=True)
        click.echo(f"the planner: {planned.reason}")
        if planned.ended == "no path":
            told = shlex.join(["spatial-replay", "info", str(output), "--decisions"])
            click.echo(f"  {told} tells what was tried, and why it was given up")
        click.echo(f"the log: {planned.name} is {planned.verdict}")
        # a run that waited in vain was cut short: that its goal was not reached is no violation
        return exit_code_from_verdicts(["unknown" if planned.ended == "wait" else planned.verdict])

    return command


for _scenario in SCENARIOS:
    plan.add_command(planning_command(_scenario))

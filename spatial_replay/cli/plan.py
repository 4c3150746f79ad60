"""`spatial-replay plan`: let a planner satisfy a specification in a simulated world."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spatial_replay.cli.application import exit_code_from_verdicts
from spatial_replay.cli.options import (
    LogOutput,
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
    parse_starts,
    show_film,
    simulation_options,
)
from spatial_replay.cli.setting_options import setting_options
from spatial_replay.cli.terminal import show
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import counted

if TYPE_CHECKING:
    from spatial_replay.logs.output_file import Durability


@click.group(invoke_without_command=True)
@click.option(
    "--redo",
    "log",
    metavar="LOG",
    type=LogPath(),
    help="Decide again on the samples of a planned run, with what the options below change.",
)
@click.option(
    "-o", "--output", type=LogOutput(path_type=Path), help="Log to write with both decisions (MCAP)."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
@click.option("--spec", metavar="SPEC", type=LogPath(), help="Specification to plan for instead.")
@click.option("--of", metavar="NAME", help="Result to plan for, if SPEC has several.")
@constants_option
@profile_option
@setting_options
@click.pass_context
def plan(
    context: click.Context,
    /,
    log: LogFile | None,
    changes: Mapping[str, Any],
    **options: Any,
) -> int | None:
    """Plan a run in a simulated world, and record it with every decision.

    With --redo, show what the planner of a log would have decided, on the recorded samples, with another
    specification or other settings: which decisions are the same, and the first one that differs, with both
    maps. Exits with 0 if every decision does the same, otherwise with 1.

    \b
    Examples:
      spatial-replay plan push -o push.mcap --seed 3
      spatial-replay plan push -o push.mcap --settings careful.yaml --attempts 5
      spatial-replay plan --redo push.mcap
      spatial-replay plan --redo table.mcap --room 0.02
      spatial-replay plan --redo push.mcap --spec edited.spatial -o both.mcap
    """
    if log is not None and context.invoked_subcommand is None:
        # imported here so that --help stays fast
        from spatial_replay.cli.redo import redo

        return redo(log, changes=changes, **options)
    if log is not None:
        raise UsageError(f"--redo takes no scenario; leave out {context.invoked_subcommand}")
    if changes or any(options.values()):
        if context.invoked_subcommand is not None:
            raise UsageError(f"options of a run come after its scenario: plan {context.invoked_subcommand} …")
        raise UsageError("there is nothing to plan; give a scenario, or --redo LOG")
    if context.invoked_subcommand is None:
        context.fail(f"Missing a scenario ({', '.join(SCENARIOS)}), or --redo LOG.")
    return None


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
      spatial-replay plan {scenario} -o run.mcap --settings careful.yaml --attempts 5
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
    @click.option(
        "--also",
        metavar="SPEC",
        multiple=True,
        type=LogPath(),
        help="Specification to evaluate, of which the planner knows nothing; repeat for several.",
    )
    @constants_option
    @profile_option
    @simulation_options
    @click.option(
        "--timings",
        is_flag=True,
        help="Log how long each decision took, on /spatial/log; logs of equal options then differ.",
    )
    @setting_options
    def command(
        output: Path,
        durability: Durability,
        spec: LogFile | None,
        of: str | None,
        also: tuple[LogFile, ...],
        constants: Mapping[str, float | str],
        profile: str | None,
        simulation: SimulationArguments,
        timings: bool,
        changes: Mapping[str, Any],
    ) -> int:
        # imported here so that --help stays fast
        from spatial_replay.runs.planned import record_plan
        from spatial_replay.simulation.worlds import default_specification

        named = [*([] if spec is None else [spec]), *also]
        files = load_spec_options(named, profile, constants, lambda: default_specification(scenario))
        # constants alone are values of the scenario's own specification
        file = files.pop(0) if files and (spec is not None or not also) else None
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
                starts=parse_starts(simulation["start"]),
                gui=simulation["gui"],
                cameras=simulation["cameras"],
                inputs=local_files(named),
                advance=advance,
                durability=durability,
                changes=changes,
                timings=timings,
                also=files,
            )
        show(
            f"wrote {output}: {counted(planned.samples, 'sample')} over {planned.seconds:.3f} s; "
            f"{counted(planned.steps, 'motion')}, {counted(planned.pruned, 'edge')} given up"
        )
        for note in filter(None, (planned.bounds, planned.yaws)):
            show(note)
        show_film(simulation)
        show(f"planning took {planned.planning_s:.2f} s", err=True)
        show(f"the planner: {planned.reason}")
        if planned.ended == "no path":
            command_line = shlex.join(["spatial-replay", "info", str(output), "--decisions"])
            show(f"  {command_line} shows what was tried, and why it was given up")
        show(f"the log: {planned.name} is {planned.verdict}")
        for name, verdict in planned.others.items():
            show(f"  {name}, of which the planner knew nothing, is {verdict}")
        # a planner that timed out ended the run: an unreached goal is then no violation
        return exit_code_from_verdicts(["unknown" if planned.ended == "wait" else planned.verdict])

    return command


for _scenario in SCENARIOS:
    plan.add_command(planning_command(_scenario))

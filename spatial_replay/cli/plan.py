"""`spatial-replay plan`: let a planner satisfy a specification in a simulated world."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spatial_replay.cli.application import ExitCode, exit_code_from_verdicts, most_severe
from spatial_replay.cli.options import (
    LogPath,
    add_options,
    constants_option,
    durability_option,
    load_spec_options,
    log_output_option,
    refuse_options,
    refuse_values,
    require_choice,
)
from spatial_replay.cli.record import (
    SCENARIOS,
    SimulationArguments,
    scenario_argument,
    show_film,
    simulation_options,
)
from spatial_replay.cli.terminal import progress, show, show_json, terminal_width, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.mapping.yaml_document import schema_of
from spatial_replay.text import counted_from, plural

if TYPE_CHECKING:
    from spatial_replay.logs.output_file import Durability


_SETTINGS = (
    click.option(
        "--settings",
        metavar="FILE",
        type=LogPath(),
        help="Settings of the planner (YAML); --set has precedence.",
    ),
    click.option(
        "--set",
        "texts",
        metavar="KEY=VALUE",
        multiple=True,
        help="Setting of the planner, such as room=0.05 or yaws=0,90deg; repeat for several. Keys: "
        f"{', '.join(schema_of('planning', 'settings')['properties'])}.",
    ),
)


def setting_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a planner's settings. The command receives the changed settings as `changes`."""

    @wraps(command)
    def changing(*, settings: LogFile | None, texts: tuple[str, ...], **arguments: Any) -> Any:
        return command(changes=_setting_changes(settings, texts), **arguments)

    return add_options(_SETTINGS, changing)


def _setting_changes(file: LogFile | None, texts: tuple[str, ...]) -> dict[str, Any]:
    """Return the settings that a file and options change.

    Raises:
        MissingFileError: there is no such file.
        UsageError: a value is invalid.
    """
    if file is None and not texts:
        return {}
    # imported here so that --help stays fast
    from spatial_replay.logs.remote import log_file
    from spatial_replay.mapping.yaml_document import read_yaml_text
    from spatial_replay.planning.settings import parse_setting, parse_settings

    changes: dict[str, Any] = {}
    if file is not None:
        changes |= parse_settings(read_yaml_text(file), log_file(file).name)
    for text in texts:
        changes |= parse_setting(text)
    return changes


def _redo(
    log: LogFile,
    output: Path | None,
    spec: LogFile | None,
    result_name: str | None,
    constants: Mapping[str, float | str],
    changes: Mapping[str, Any],
    as_json: bool,
) -> int:
    """Decide again on the samples of a log, and show the first decision that differs."""
    # imported here so that --help stays fast
    from spatial_replay.planning.read import ReplannedSource, planner_of, redo_decisions
    from spatial_replay.replay.engine import load_files, run_replay
    from spatial_replay.replay.selection import ReplayOptions, known_zero_ns
    from spatial_replay.sources.open_log import open_source

    source = open_source(log)
    specs = [] if spec is None else [spec]
    files = load_spec_options(specs, constants, lambda: planner_of(source).specification)
    specification = next(iter(files), None)
    if specification is not None:
        require_choice(specification, result_name)
    with progress("samples") as advance:
        replanning = redo_decisions(source, specification, changes, name=result_name, advance=advance)
    warn(*counted_from(replanning.faults, known_zero_ns(source) if replanning.faults else 0))
    if output is not None:
        files = load_files((), source) if specification is None else [specification]
        replanned_source = ReplannedSource(source, replanning.messages)
        run_replay(replanned_source, files, ReplayOptions(), output=output, inputs=local_files([log, *specs]))
    if as_json:
        show_json(replanning.document)
    else:
        show(*replanning.lines(terminal_width()))
        if output is not None:
            show(f"wrote {output}: {shlex.join(['spatial-replay', 'report', str(output)])} shows both")
    exit_code = ExitCode.VIOLATED if replanning.is_different else ExitCode.SATISFIED
    return most_severe([exit_code, ExitCode.DAMAGED]) if replanning.faults else exit_code


def _why(log: LogFile, decision_number: int | None, object_name: str | None, place: str | None) -> int:
    """Print the reasons why a decision did not bring an object to a place."""
    # imported here so that --help stays fast
    from spatial_replay.planning.read import why_not_there

    if decision_number is None or object_name is None or place is None:
        raise UsageError("--why LOG asks about one place; give --step N, --object NAME and --at X,Y")
    try:
        x, y = map(float, place.split(","))
    except ValueError:
        raise UsageError(f"--at {place!r} is no place; give two numbers, as in --at 0.5,0.1") from None
    show(*why_not_there(log, decision_number, object_name, (x, y)))
    return ExitCode.SATISFIED


_OF_RUNS = ("durability", "also", "timings", *SimulationArguments.__annotations__)
"""Parameters of a simulated run."""
_NOT_WHY = (*_OF_RUNS, "scenario", "log", "as_json", "output", "spec", "of", "constants", "settings", "texts")


@click.command()
@scenario_argument(required=False)
@click.option(
    "--redo",
    "log",
    metavar="LOG",
    type=LogPath(),
    help="Decide again on the samples of a planned run, with these options.",
)
@click.option(
    "--why",
    "why_log",
    metavar="LOG",
    type=LogPath(),
    help="Show the demands on a place with their robustness, and obstacles.",
)
@click.option("--step", "number", metavar="N", type=int, help="With --why: number of the decision.")
@click.option("--object", "name", metavar="NAME", help="With --why: the object.")
@click.option("--at", "place", metavar="X,Y", help="With --why: the place, in the unit of the log.")
@click.option("--json", "as_json", is_flag=True, help="With --redo: print JSON instead of text.")
@log_output_option("Log to write (MCAP); with --redo, a copy with both decisions.", required=False)
@durability_option
@click.option(
    "--spec", metavar="SPEC", type=LogPath(), help="Specification to plan for.  [default: the scenario's own]"
)
@click.option("--result", "of", metavar="NAME", help="Result to plan for, if SPEC has several.")
@click.option(
    "--also",
    metavar="SPEC",
    multiple=True,
    type=LogPath(),
    help="Specification that is evaluated only; repeat for several.",
)
@constants_option
@setting_options
@simulation_options
@click.option(
    "--timings",
    is_flag=True,
    help="Log the planning time of decisions; logs of equal options then differ.",
)
@click.pass_context
def plan(
    context: click.Context,
    /,
    scenario: str | None,
    log: LogFile | None,
    why_log: LogFile | None,
    number: int | None,
    name: str | None,
    place: str | None,
    as_json: bool,
    output: Path | None,
    spec: LogFile | None,
    of: str | None,
    constants: Mapping[str, float | str],
    changes: Mapping[str, Any],
    **options: Any,
) -> int:
    """Plan a run in a simulated world, and record it with every decision.

    The planner chooses motions of the robot until the specification is satisfied or no path to acceptance is
    left. Equal options give an equal log, byte for byte. Needs the extra `sim`. Exits with 0 if
    the planned specification is satisfied, 1 if it is violated, 4 if it is unknown or if the planner timed
    out.

    With --redo, the planner decides on recorded samples with another specification or other settings. The
    command shows the number of equal decisions, and the first different one. Exits with 0 if all are equal,
    otherwise with 1.

    \b
    Examples:
      spatial-replay plan push -o push.mcap --seed 3
      spatial-replay plan table-setting -o set.mcap --settings careful.yaml --set attempts=5
      spatial-replay plan --redo push.mcap --set room=0.02
      spatial-replay plan --why push.mcap --step 0 --object red --at 0.5,0.1
    """
    if why_log is not None:
        refuse_options(context, _NOT_WHY, "is not for --why; leave it out")
        return _why(why_log, number, name, place)
    refuse_values({"--step": number, "--object": name, "--at": place}, "is for --why LOG")
    if log is not None:
        if scenario is not None:
            raise UsageError(f"--redo takes no scenario; leave out {scenario}")
        refuse_options(context, _OF_RUNS, "is for a run; leave it out with --redo")
        return _redo(log, output, spec, of, constants, changes, as_json)
    if scenario is None:
        context.fail(f"Missing a scenario ({', '.join(SCENARIOS)}), or --redo LOG.")
    if output is None:
        raise UsageError("there is no log to write; give -o FILE")
    refuse_values({"--json": as_json}, "is for --redo LOG; a run has `info LOG --decisions --json`")
    return _plan(scenario, output, spec, of, constants, changes, **options)


def _plan(
    scenario: str,
    output: Path,
    spec: LogFile | None,
    result_name: str | None,
    constants: Mapping[str, float | str],
    changes: Mapping[str, Any],
    *,
    also: tuple[LogFile, ...],
    durability: Durability,
    timings: bool,
    simulation: SimulationArguments,
) -> int:
    # imported here so that --help stays fast
    from spatial_replay.runs.planned import record_plan
    from spatial_replay.simulation.tabletop import default_specification

    inputs = [*([] if spec is None else [spec]), *also]
    files = load_spec_options(inputs, constants, lambda: default_specification(scenario))
    # without --spec, the constants apply to the scenario's own specification
    specification = files.pop(0) if files and (spec is not None or not also) else None
    if specification is not None:
        require_choice(specification, result_name)
    with progress("samples") as advance:
        planned_run = record_plan(
            scenario,
            output,
            specification,
            name=result_name,
            inputs=local_files(inputs),
            advance=advance,
            durability=durability,
            changes=changes,
            timings=timings,
            also=files,
            **simulation,
        )
    show(
        f"wrote {output}: {plural(planned_run.samples, 'sample')} over {planned_run.seconds:.3f} s; "
        f"{plural(planned_run.steps, 'motion')}"
    )
    for note in filter(None, (planned_run.bounds, planned_run.yaws)):
        show(note)
    show_film(simulation["cameras"])
    show(f"planning took {planned_run.planning_s:.2f} s", err=True)
    show(f"the planner: {planned_run.reason}")
    if planned_run.ended == "no path":
        command_line = shlex.join(["spatial-replay", "info", str(output), "--decisions"])
        show(f"  {command_line} shows what was tried, and why it was given up")
    show(f"the log: {planned_run.name} is {planned_run.verdict}")
    for name, verdict in planned_run.others.items():
        show(f"  {name}, of which the planner knew nothing, is {verdict}")
    # after a timeout of the planner, an unreached goal is no violation
    return exit_code_from_verdicts(["unknown" if planned_run.ended == "wait" else planned_run.verdict])

"""`spatial-replay verify`: is a log what it says it is?"""

from __future__ import annotations

from pathlib import Path

import click

from spatial_replay.cli.application import ExitCode, say
from spatial_replay.cli.options import Reading, reading_options
from spatial_replay.cli.progress import progress
from spatial_replay.errors import UsageError
from spatial_replay.text import counted


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--source",
    metavar="SOURCE",
    type=click.Path(path_type=Path),
    help="Evaluate what the log was made of instead of the log itself.",
)
@click.option("--decisions", is_flag=True, help="Recompute the decisions of a planned run, too.")
@reading_options
def verify(log: Path, source: Path | None, decisions: bool, reading: Reading) -> int:
    """Compute a log's certificate again, and compare it with the one in the log.

    The log is evaluated with its own specifications and options. With --decisions, every decision of a
    planner is recomputed from the recorded samples, with all its maps, and compared bit for bit; with
    --source, those in the source. Exits with 0 if all is equal, else with 1.

    \b
    Examples:
      spatial-replay verify annotated.mcap
      spatial-replay verify annotated.mcap --source run.mcap
      spatial-replay verify push.mcap --decisions
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.planning.recompute import recompute_decisions
    from spatial_replay.replay.verification import verify_certificate
    from spatial_replay.sources.open_log import open_source

    if source is None and reading["mapping"] is not None:
        raise UsageError("--mapping is about the log's source; add --source SOURCE")
    own = open_source(log)
    made_of = None if source is None else open_source(source, **reading)
    with progress("samples") as advance:
        verified = verify_certificate(own, made_of, advance)
    faults = list(verified.faults)
    differences = [f"{log.name}: {each}" for each in verified.differences]
    if verified.recorded and not differences:
        click.echo(f"{log.name}: samples, messages, specifications and results are as recorded")
    if decisions:
        planned = own if made_of is None else made_of
        with progress("samples") as advance:
            recomputed = recompute_decisions(planned, advance)
        faults += recomputed.faults
        differences += [f"{planned.name}: {each}" for each in recomputed.differences]
        if not recomputed.differences:
            click.echo(
                f"{planned.name}: {counted(recomputed.decisions, 'decision')} recomputed on "
                f"{counted(recomputed.maps, 'map')}, all as recorded"
            )
    for fault in dict.fromkeys(faults):
        say("warning", fault, colour="yellow")
    for difference in differences:
        click.echo(difference)
    return ExitCode.VIOLATED if differences else ExitCode.SATISFIED

"""`spatial-replay record`: turn a run into a log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from spatial_replay.cli.evaluating import report_reading
from spatial_replay.cli.exit_codes import ExitCode
from spatial_replay.cli.options import Reading, output_option, profile_option, reading_options
from spatial_replay.cli.progress import progress
from spatial_replay.cli.simulated import SCENARIOS, recording_command
from spatial_replay.wording import counted


@click.group()
def record() -> None:
    """Record a run as an MCAP log.

    \b
    Examples:
      spatial-replay record tracks blocks.jsonl.gz -o run.mcap
      spatial-replay record push -o run.mcap
    """


for _scenario in SCENARIOS:
    record.add_command(recording_command(_scenario))


@record.command()
@click.argument("file", type=click.Path(path_type=Path))
@output_option("Write the log here.", required=True)
@click.option(
    "--spec",
    "specs",
    metavar="SPEC",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Evaluate this specification meanwhile; repeat it for several.",
)
@profile_option
@reading_options
def tracks(file: Path, output: Path, specs: tuple[Path, ...], profile: str | None, reading: Reading) -> int:
    """Record the objects of any log that can be read: tracks, annotations, scenarios, bags with a mapping.

    What cannot be read of the file is reported and left out, and the exit code is then 3.

    \b
    Examples:
      spatial-replay record tracks blocks.jsonl.gz -o run.mcap
      spatial-replay record tracks people.csv -o run.mcap --spec social.spatial
      spatial-replay record tracks annotations.txt -o run.mcap --lost keep
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.logs.source import open_source
    from spatial_replay.recording import record_source
    from spatial_replay.spec import load_specification

    mapping = reading["mapping"]
    inputs = (file, *specs, *([] if mapping is None else [mapping]))
    source = open_source(file, **reading)
    files = [load_specification(spec, profile=profile) for spec in specs]
    with progress("samples") as advance:
        recorded = record_source(source, output, files, inputs=inputs, advance=advance)
    report_reading(recorded)
    for name in recorded.missing:
        click.echo(replace(name, severity="warning"), err=True)
    seconds = (recorded.end_ns - recorded.start_ns) / 1e9
    click.echo(
        f"wrote {output}: {counted(recorded.samples, 'sample')} over {seconds:.3f} s of "
        f"{counted(len(recorded.objects), 'object')}: {_listed(recorded.objects)}"
    )
    return ExitCode.DAMAGED if recorded.faults else ExitCode.SATISFIED


def _listed(names: tuple[str, ...]) -> str:
    shown = ", ".join(names[:8])
    return shown if len(names) <= 8 else f"{shown}, …"

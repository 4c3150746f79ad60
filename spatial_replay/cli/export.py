"""`spatial-replay export`: the robustness in an annotated log as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import LogPath, output_option
from spatial_replay.cli.progress import progress
from spatial_replay.cli.terminal import show, warn
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import counted

if TYPE_CHECKING:
    from spatial_replay.replay.table import Quantity


@click.command()
@click.argument("annotated", type=LogPath())
@output_option("Output: FILE.csv or FILE.parquet.", required=True)
@click.option(
    "--quantity",
    type=click.Choice(["value", "now", "lower", "upper"]),
    default="value",
    show_default=True,
    help="Which number of each node to export.",
)
def export(annotated: LogFile, output: Path, quantity: Quantity) -> int:
    """Export the robustness in an annotated log as a table: one row per sample, one column per node.

    A column is named after the named specs on the way to its node, task/deliver, and the text of an unnamed
    node. Others hold the seconds since the first row and the states of the automata. Empty cells are numbers
    that are not determined.

    \b
    Example:
      spatial-replay export annotated.mcap -o run.csv
    """
    # imported here so that --help stays fast
    from spatial_replay.replay.table import export_table
    from spatial_replay.sources.open_log import open_source

    source = open_source(annotated)
    with progress("rows") as advance:
        rows, columns, faults = export_table(
            source,
            output,
            quantity=quantity,
            inputs=local_files([annotated]),
            advance=advance,
        )
    warn(*faults)
    show(f"wrote {output}: {counted(rows, 'row')}, {counted(columns, 'node')}")
    return ExitCode.DAMAGED if faults else ExitCode.SATISFIED

"""`spatial-replay export`: the robustness in an annotated log as a table."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    EvaluationArguments,
    evaluation_options,
    open_inputs,
    output_option,
    warn_of_input,
)
from spatial_replay.cli.terminal import progress, show, warn
from spatial_replay.text import counted

if TYPE_CHECKING:
    from spatial_replay.replay.table import Quantity


@click.command()
@evaluation_options
@output_option("Output: FILE.csv or FILE.parquet.", required=True)
@click.option(
    "--quantity",
    type=click.Choice(["value", "now", "lower", "upper"]),
    default="value",
    show_default=True,
    help="Which number of each node to export.",
)
def export(request: EvaluationArguments, output: Path, quantity: Quantity) -> int:
    """Export the robustness in an annotated log as a table: one row per sample, one column per node.

    With --spec, or any option about the evaluation, LOG is evaluated first, and may be of any format.

    A column is named after the named specs on the way to its node, task/deliver, and the text of an unnamed
    node. Others hold the seconds since the first row and the states of the automata. Empty cells are numbers
    that are not determined.

    \b
    Examples:
      spatial-replay export annotated.mcap -o run.csv
      spatial-replay export drive.bag --mapping drive.yaml --spec drive.spatial -o run.csv
    """
    # imported here so that --help stays fast
    from spatial_replay.replay.table import check_table_name, export_table
    from spatial_replay.sources.open_log import open_source

    check_table_name(output)
    faults: tuple[str, ...] = ()
    with TemporaryDirectory(prefix="spatial-replay-") as folder:
        log = request.log
        if _is_evaluated(request):
            log = Path(folder, "annotated.mcap")
            faults = _evaluate(request, log)
        with progress("rows") as advance:
            rows, columns, lost = export_table(
                open_source(log), output, quantity=quantity, inputs=request.inputs, advance=advance
            )
    warn(*lost)
    show(f"wrote {output}: {counted(rows, 'row')}, {counted(columns, 'node')}")
    return ExitCode.DAMAGED if faults or lost else ExitCode.SATISFIED


def _is_evaluated(request: EvaluationArguments) -> bool:
    """Return whether a log is evaluated first; an annotated one has its numbers already."""
    options = (request.specs, request.constants, request.choices, request.start, request.end, request.profile)
    return any(options) or request.every > 1 or request.reading.get("mapping") is not None


def _evaluate(request: EvaluationArguments, output: Path) -> tuple[str, ...]:
    """Evaluate specifications over a log, write what comes out, and return what was lost."""
    from spatial_replay.replay.engine import run_replay

    inputs = open_inputs(request)
    with progress("samples") as advance:
        replayed = run_replay(
            inputs.source, inputs.files, inputs.options(), output=output, layer=True, advance=advance
        )
    warn_of_input(replayed)
    return replayed.faults

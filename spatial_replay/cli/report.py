"""`spatial-replay report`: one HTML page about a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import exit_code_from_verdicts
from spatial_replay.cli.options import (
    EvaluationArguments,
    evaluation_options,
    open_inputs,
    output_option,
    semantics_option,
    warn_of_input,
)
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.terminal import progress

if TYPE_CHECKING:
    from spatial_replay.monitor.semantics import Semantics


@click.command()
@evaluation_options
@output_option("Report to write (HTML).  [default: the log's name with .html, in this folder]")
@semantics_option
def report(request: EvaluationArguments, output: Path | None, semantics: Semantics) -> int:
    """Write an HTML report of a recorded run, for any browser.

    It shows verdicts and explanations, the specification's tree, curves, the scene from above, the automaton,
    events and planner decisions, with one time cursor for all. It needs no network and no other file.

    Exits with 0 if all results are satisfied, 1 if any is violated, 4 if none is violated and any is unknown,
    3 if the log is damaged.

    \b
    Examples:
      spatial-replay report run.mcap
      spatial-replay report run.mcap --spec blocks.spatial -o run.html
      spatial-replay report run.mcap --spec edited.spatial --semantics paper -o run.html
    """
    # imported here so that --help stays fast
    from spatial_replay.report.write import refuse_output, write_report

    output = Path(f"{Path(request.log.name.removesuffix('.gz')).stem}.html") if output is None else output
    refuse_output(output, request.inputs)
    inputs = open_inputs(request)
    with progress("samples") as advance:
        replayed = write_report(
            inputs.source,
            inputs.files,
            output,
            inputs.options(semantics),
            inputs=request.inputs,
            advance=advance,
        )
    warn_of_input(replayed)
    print_verdicts(replayed, output)
    return exit_code_from_verdicts((result.verdict for result in replayed.results), bool(replayed.faults))

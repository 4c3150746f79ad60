"""`spatial-replay report`: what a run did, and why, as one page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import exit_code_from_verdicts
from spatial_replay.cli.options import (
    Request,
    evaluation_options,
    output_option,
    prepared,
    report_reading,
    semantics_option,
)
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.progress import progress

if TYPE_CHECKING:
    from spatial_replay.monitor.semantics import Semantics


@click.command()
@evaluation_options
@output_option("Write the page (HTML) here.", required=True)
@semantics_option
def report(request: Request, output: Path, semantics: Semantics) -> int:
    """Write what a recorded run did as one page that any browser opens.

    Verdicts and explanations, the specification's tree, curves, the scene from above, the automaton, events
    and a planner's decisions, with one time cursor through all. The page needs no network and no other file.

    Exits with the code of the verdicts, as `replay` does.

    \b
    Examples:
      spatial-replay report run.mcap --spec blocks.spatial -o run.html
      spatial-replay report people.jsonl --spec social.spatial --each ego=class:pedestrian -o people.html
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.logs.output_file import refuse_inputs
    from spatial_replay.replay import ReplayOptions
    from spatial_replay.report.write import write_report

    refuse_inputs(output, request.inputs)
    task = prepared(request)
    with progress("samples") as advance:
        replayed = write_report(
            task.source,
            task.files,
            output,
            ReplayOptions(task.window, task.each, semantics),
            inputs=request.inputs,
            advance=advance,
        )
    report_reading(replayed)
    print_verdicts(replayed, output)
    return exit_code_from_verdicts((result.verdict for result in replayed.results), bool(replayed.faults))

"""`spatial-replay replay`: evaluate a recorded run, and write what was found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import exit_code_from_verdicts
from spatial_replay.cli.options import (
    Request,
    duration_ns_from_text,
    evaluation_options,
    output_option,
    prepared,
    read_for,
    report_reading,
    semantics_option,
)
from spatial_replay.cli.output import print_verdicts, write_document
from spatial_replay.cli.progress import progress
from spatial_replay.errors import UsageError

if TYPE_CHECKING:
    from spatial_replay.monitor.semantics import Semantics


@click.command()
@evaluation_options
@output_option("Write the annotated log (MCAP) here.")
@click.option("--layer", is_flag=True, help="Leave the log's own messages out of the annotated one.")
@click.option("--json", "json_file", metavar="FILE|-", help="Write what was found as one JSON object.")
@click.option("--series", is_flag=True, help="With --json: also the numbers of every node at every sample.")
@click.option(
    "--signal",
    is_flag=True,
    help="With --json: the series, and each node's robustness from each sample to the end.",
)
@click.option(
    "--window",
    "width",
    metavar="DURATION",
    help="Also evaluate the samples of the last so many seconds, at every sample: 10s.",
)
@semantics_option
def replay(
    request: Request,
    output: Path | None,
    layer: bool,
    json_file: str | None,
    series: bool,
    signal: bool,
    width: str | None,
    semantics: Semantics,
) -> int:
    """Evaluate specifications over a recorded log.

    T is 12.5s or 1500ms after the first sample, integer nanoseconds, or 2026-01-31T12:00:00Z.

    Exits with 0 if everything is satisfied, 1 if anything is violated, 4 if nothing is but something is
    unknown, 3 if the log is damaged: the verdict is then that of what could be read.

    \b
    Examples:
      spatial-replay replay run.mcap --spec blocks.spatial -o annotated.mcap
      spatial-replay replay run.mcap --spec edited.spatial --json -
      spatial-replay replay run.mcap --spec blocks.spatial --window 10s
      spatial-replay replay people.jsonl --spec social.spatial --each ego=class:pedestrian --from 10s
      spatial-replay replay drive.bag --mapping drive.yaml --spec social.spatial -o annotated.mcap
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.replay import ReplayOptions, run_replay

    if (series or signal) and json_file is None:
        option = "--series" if series else "--signal"
        raise UsageError(f"{option} goes into the JSON object; add --json FILE or --json -")
    if layer and output is None:
        raise UsageError("--layer is about the annotated log; add -o FILE")
    window_ns = None if width is None else _width_ns(width)
    if semantics != "ltlf" and (signal or window_ns is not None):
        option = "--signal" if signal else "--window"
        raise UsageError(f"{option} is not defined under --semantics {semantics}; leave one of them out")
    _check_outputs(output, json_file, request.inputs)
    task = prepared(request)
    with progress("samples") as advance:
        replayed = run_replay(
            task.source,
            task.files,
            ReplayOptions(task.window, task.each, semantics),
            keep_series=json_file is not None and (series or signal or window_ns is not None),
            keep_leaves=True,
            output=output,
            inputs=request.inputs,
            layer=layer,
            advance=advance,
        )
    report_reading(replayed)
    if json_file is not None:
        write_document(replayed, json_file, request.inputs, signal=signal, window_ns=window_ns)
    if json_file != "-":
        print_verdicts(replayed, output, window_ns)
    return exit_code_from_verdicts((result.verdict for result in replayed.results), bool(replayed.faults))


def _width_ns(text: str) -> int:
    with read_for("--window"):
        width_ns = duration_ns_from_text(text)
    if width_ns == 0:
        raise UsageError(f"--window {text} holds no sample; give it a width, as in --window 10s")
    return width_ns


def _check_outputs(output: Path | None, json_file: str | None, inputs: tuple[Path, ...]) -> None:
    """Refuse before the work what would fail after it."""
    from spatial_replay.logs.output_file import refuse_inputs

    if output is not None:
        refuse_inputs(output, inputs)
    if json_file is not None and json_file != "-":
        refuse_inputs(Path(json_file), inputs)
        if output is not None and output.resolve() == Path(json_file).resolve():
            raise UsageError(f"-o and --json both name {json_file}; give them two names")

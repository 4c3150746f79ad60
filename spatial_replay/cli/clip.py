"""`spatial-replay clip`: the smallest part of a log that shows a verdict."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    EvaluationArguments,
    evaluation_options,
    log_output_option,
    naming_option,
    open_inputs,
    warn_of_input,
)
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.terminal import progress, show, warn
from spatial_replay.text import counted, time_text
from spatial_replay.trace.trace import duration_ns_from_text

if TYPE_CHECKING:
    from spatial_replay.compare.clips import Clip


@click.command()
@evaluation_options
@log_output_option("Clip to write (MCAP).")
@click.option(
    "--result",
    "of",
    metavar="NAME",
    multiple=True,
    help="Spec to keep the verdict of; repeat for several.  [default: the violated ones, or all]",
)
@click.option(
    "--around", metavar="T", default="0s", help="Keep at least T before and after the samples that decide."
)
@click.option(
    "--topics",
    metavar="PATTERN",
    multiple=True,
    help="Topics to keep, such as '/camera/*'; repeat for several.  [default: all]",
)
def clip(
    request: EvaluationArguments, output: Path, of: tuple[str, ...], around: str, topics: tuple[str, ...]
) -> int:
    """Copy the smallest part of a log that shows a verdict, for a bug report.

    The clip has the same verdicts, robustness and witnesses as the log, of the results that are violated or,
    where none is, of all. It is an annotated log: every
    viewer plays it, and `replay` evaluates it without other files. Messages of all topics are cut to its
    time; before it come the last message of each topic and the last transform of each frame, with their own
    times.

    T is 5s or 500ms. Exits with 0 if the clip was written, 3 if the log is damaged.

    \b
    Examples:
      spatial-replay clip run.mcap --spec blocks.spatial -o bug.mcap
      spatial-replay clip run.mcap --spec blocks.spatial --result passage --around 5s -o bug.mcap
    """
    # imported here so that --help stays fast
    from spatial_replay.compare.clips import cut_clip
    from spatial_replay.logs.output_file import refuse_inputs

    refuse_inputs(output, request.inputs)
    with naming_option("--around"):
        around_ns = duration_ns_from_text(around)
    inputs = open_inputs(request)
    with progress("samples") as advance:
        found = cut_clip(
            inputs.source,
            inputs.files,
            output,
            inputs.options(keep=topics),
            around_ns=around_ns,
            of=of,
            inputs=request.inputs,
            advance=advance,
        )
    warn_of_input(found.whole)
    print_verdicts(found.replayed, output)
    show(_summary(found))
    if found.left_out and not of:
        show(f"  not kept, since nothing failed there: {', '.join(found.left_out)}; --result NAME keeps one")
    for title in (each for each in found.changed if of or each not in found.left_out):
        warn(f"{title} has another verdict in the clip than in the log; only {', '.join(found.kept)} is kept")
    if found.added:
        warn(f"{', '.join(found.added)}: fails in the clip alone, which has not all samples of the log")
    return ExitCode.DAMAGED if found.whole.faults else ExitCode.SATISFIED


def _summary(found: Clip) -> str:
    first_ns = found.whole.first_ns
    if found.is_whole:
        return "  nothing smaller has these verdicts and witnesses: the clip holds every sample of the log"
    window = " to ".join(time_text(at, first_ns) for at in (found.start_ns, found.end_ns))
    size = f"{found.clip_bytes:,} bytes"
    if found.source_bytes and found.clip_bytes >= found.source_bytes:
        size += f"; the log itself, {found.source_bytes:,} bytes, is smaller than its schemas and annotations"
    elif found.source_bytes:
        size += f", {found.clip_bytes / found.source_bytes:.2%} of the log's {found.source_bytes:,}"
    samples = f"{found.replayed.samples:,} of {counted(found.whole.samples, 'sample')}"
    return f"  {', '.join(found.kept)}: {samples}, {window} of the log; {size}"

"""`spatial-replay diff`: two versions of a specification over a log, or two logs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode, most_severe
from spatial_replay.cli.options import (
    EvaluationArguments,
    JsonCommand,
    LogPath,
    evaluation_options,
    open_inputs,
    output_option,
    semantics_option,
)
from spatial_replay.cli.terminal import progress, show, show_diagnostics, show_json, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, local_files

if TYPE_CHECKING:
    from spatial_replay.compare.runs import LogDiff
    from spatial_replay.compare.specifications import SpecificationDiff
    from spatial_replay.monitor.verdict import Semantics


@click.command(cls=JsonCommand)
@evaluation_options
@click.argument("other", required=False, type=LogPath())
@click.option(
    "--align",
    metavar="time|progress[:NAME]|NAME",
    default="time",
    show_default=True,
    help="How to align two logs. time: by time since the first sample. progress:NAME: by states of the"
    " automaton of NAME. progress: the same, with the spec that has most states in common. NAME: by the"
    " moment when that spec's robustness first changes its sign.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
@output_option("HTML page to write: both sides under one time cursor.")
@semantics_option
def diff(
    request: EvaluationArguments,
    other: LogFile | None,
    align: str,
    as_json: bool,
    output: Path | None,
    semantics: Semantics,
) -> int:
    """Compare two versions of a specification over a log, or two logs.

    With two specifications (--spec OLD --spec NEW), it shows which verdicts and numbers changed, which sample
    differs first, and which edit is the cause. With one --spec, OLD is the specification in the log. The
    cause is checked: OLD with this edit alone, and NEW without it, are evaluated.

    With two logs, it shows which objects moved differently and since when, the effect on each spec, and the
    planner's first different decision.

    Exits with 0 if nothing differs, or only names of specs, and otherwise with 1. If a log is damaged, it
    exits with 3.

    \b
    Examples:
      spatial-replay diff run.mcap --spec old.spatial --spec new.spatial
      spatial-replay diff before.mcap after.mcap --spec blocks.spatial -o diff.html
      spatial-replay diff before.mcap after.mcap --spec blocks.spatial --align progress
    """
    # imported here so that --help stays fast
    from spatial_replay.report.write import refuse_output

    if output is not None:
        refuse_output(output, _inputs(request, other))
    if other is None and align != "time":
        raise UsageError("--align applies to two logs; give the second one")
    if other is None:
        difference: SpecificationDiff | LogDiff = _of_specifications(request, output, semantics)
    else:
        difference = _of_logs(request, other, align, output, semantics)
    if as_json:
        show_json(difference.document)
    else:
        show(*difference.lines())
        if output is not None:
            show(f"wrote {output}")
    warn(*difference.faults)
    show_diagnostics(difference.missing)
    code = ExitCode.SATISFIED if difference.is_empty else ExitCode.VIOLATED
    return most_severe([code, ExitCode.DAMAGED]) if difference.faults else code


def _of_specifications(
    request: EvaluationArguments, output: Path | None, semantics: Semantics
) -> SpecificationDiff:
    from spatial_replay.compare.specifications import diff_over_source
    from spatial_replay.replay.engine import recorded_texts
    from spatial_replay.report.write import write_comparison

    if len(request.specs) > 2:
        raise UsageError(f"{len(request.specs)} specifications; give two: --spec OLD --spec NEW")
    if not request.specs:
        raise UsageError("nothing to compare: give a second log, or --spec OLD --spec NEW")
    inputs = open_inputs(request)
    files = list(inputs.files)
    if len(request.specs) == 1:
        if not recorded_texts(inputs.source):
            raise UsageError(f"{inputs.source.name} holds no specification of its own; give --spec OLD, too")
        recorded = open_inputs(replace(request, specs=()))
        if len(recorded.files) != 1:
            names = ", ".join(file.filename for file in recorded.files)
            raise UsageError(f"{inputs.source.name} has several specifications: {names}; give OLD, too")
        files.insert(0, recorded.files[0])
    options = inputs.options(semantics)
    with progress("samples") as advance:
        difference = diff_over_source(inputs.source, files[0], files[-1], options, advance=advance)
        if output is not None:
            sides = (inputs.source, files[:1], options), (inputs.source, files[-1:], options)
            write_comparison(difference, sides, output, inputs=request.inputs, advance=advance)
    return difference


def _of_logs(
    request: EvaluationArguments, other: LogFile, align: str, output: Path | None, semantics: Semantics
) -> LogDiff:
    from spatial_replay.compare.runs import diff_sources
    from spatial_replay.report.write import write_comparison

    first = open_inputs(request, can_do_without=True)
    second = open_inputs(replace(request, log=other), known=first.files, can_do_without=True)
    sources, files = (first.source, second.source), first.files or second.files
    options = first.options(semantics), second.options(semantics)
    with progress("samples") as advance:
        difference = diff_sources(sources, files, options, align=align, advance=advance)
        if output is not None:
            sides = (sources[0], files, options[0]), (sources[1], files, options[1])
            write_comparison(difference, sides, output, inputs=_inputs(request, other), advance=advance)
    return difference


def _inputs(request: EvaluationArguments, other: LogFile | None) -> Sequence[Path]:
    """Return the files that are read."""
    return request.inputs if other is None else (*request.inputs, *local_files([other]))

"""`spatial-replay replay`: evaluate specifications over a recorded run."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import exit_code_from_verdicts
from spatial_replay.cli.options import (
    EvaluationArguments,
    allow_option,
    evaluation_options,
    fail_on_option,
    keep_option,
    log_output_option,
    naming_option,
    open_inputs,
    semantics_option,
    warn_of_input,
)
from spatial_replay.cli.output import print_verdicts, write_document
from spatial_replay.cli.terminal import progress, show_message
from spatial_replay.cli.watching import watch_log, watch_option
from spatial_replay.errors import UsageError
from spatial_replay.trace.trace import duration_ns_from_text

if TYPE_CHECKING:
    from spatial_replay.monitor.semantics import Semantics
    from spatial_replay.replay.engine import Replayed


@click.command()
@evaluation_options
@log_output_option("Annotated log to write (MCAP).", required=False)
@click.option("--layer", is_flag=True, help="Write the derived messages only, without the log's own.")
@keep_option("Messages of the log to copy with -o", "all; none of a ROS 2 bag")
@click.option(
    "--arrow",
    metavar="RESULT",
    default="",
    help="With -o: the violated result that the scene's arrow points at.  [default: the first violated one]",
)
@click.option("--json", "json_file", metavar="FILE|-", help="Results to write, as one JSON object.")
@click.option("--series", is_flag=True, help="With --json: add four numbers of every node at every sample.")
@click.option(
    "--to-end",
    "signal",
    is_flag=True,
    help="With --json: as --series, plus, for each node and sample, the robustness from there to the end.",
)
@click.option(
    "--window",
    "width",
    metavar="DURATION",
    help="Also evaluate a sliding window, such as 10s, at every sample.",
)
@fail_on_option
@allow_option
@watch_option
@semantics_option
def replay(
    request: EvaluationArguments,
    output: Path | None,
    layer: bool,
    keep: tuple[str, ...],
    arrow: str,
    json_file: str | None,
    series: bool,
    signal: bool,
    width: str | None,
    fail_on: frozenset[str],
    allow: frozenset[str],
    watch: bool,
    semantics: Semantics,
) -> int:
    """Evaluate specifications over a recorded log.

    Write a time T as 12.5s or 1500ms after the first sample, 5250000000ns on the log's clock, or
    2026-01-31T12:00:00Z.

    Exits with 0 if all results are satisfied, 1 if any is violated, 4 if none is violated and any is unknown.
    It exits with 3 if the log is damaged; the verdicts cover only the readable part. The code is also 4 if
    nothing in the log tested a result, or if the recorder dropped samples; --allow lets these pass. With
    --fail-on vacuous it is 1 if a part of a specification decided nothing: an empty window, an antecedent
    that never held, a group without members, a template without objects. With --fail-on cut it is 1 if a
    deciding window was cut short by the end of the log.

    With --watch the log stays in memory, and is evaluated again whenever a specification file is saved. The
    key w writes the values of --const into the files. Ctrl-C ends it with exit code 130.

    \b
    Examples:
      spatial-replay replay run.mcap --spec blocks.spatial -o annotated.mcap
      spatial-replay replay run.mcap --spec edited.spatial --json -
      spatial-replay replay run.mcap --spec blocks.spatial --const near=80 --fail-on vacuous,unknown
      spatial-replay replay run.mcap --spec blocks.spatial --window 10s
      spatial-replay replay run.mcap --spec blocks.spatial --watch
      spatial-replay replay walk.jsonl --spec walk.spatial --each ego=class:person
      spatial-replay replay drive.bag --mapping drive.yaml --spec drive.spatial
      spatial-replay replay drive.bag --mapping drive.yaml -o annotated.mcap --topics '/camera/*'
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.messages import MAPPED
    from spatial_replay.replay.engine import run_replay
    from spatial_replay.replay.selection import default_keep

    if (series or signal) and json_file is None:
        option = "--series" if series else "--to-end"
        raise UsageError(f"{option} adds to the JSON object; add --json FILE or --json -")
    for option, value in {"--layer": layer, "--topics": keep, "--arrow": arrow}.items():
        if value and output is None:
            raise UsageError(f"{option} applies to the annotated log; add -o FILE")
    if keep and layer:
        raise UsageError("--layer copies no messages; remove --topics or --layer")
    window_ns = None if width is None else _width_ns(width)
    if semantics != "ltlf" and (signal or window_ns is not None):
        option = "--to-end" if signal else "--window"
        raise UsageError(f"{option} is not defined under --semantics {semantics}; remove one of them")
    if watch:
        others = {
            "-o": output,
            "--json": json_file,
            "--window": width,
            "--fail-on": fail_on,
            "--allow": allow,
        }
        for option, value in others.items():
            if value:
                raise UsageError(f"--watch prints verdicts only; remove {option}")
        return watch_log(request, semantics)
    _check_outputs(output, json_file, request.inputs)
    inputs = open_inputs(request)
    with progress("samples") as advance:
        replayed = run_replay(
            inputs.source,
            inputs.files,
            replace(inputs.options(semantics, keep or (() if output else (MAPPED,))), arrow=arrow),
            keep_series=json_file is not None and (series or signal or window_ns is not None),
            keep_leaves=True,
            output=output,
            inputs=request.inputs,
            layer=layer,
            certify=json_file is not None,
            advance=advance,
        )
    warn_of_input(replayed)
    if json_file is not None:
        write_document(replayed, json_file, request.inputs, signal=signal, window_ns=window_ns)
    if json_file != "-":
        print_verdicts(replayed, output, window_ns)
    if output is not None and not layer and not keep and not default_keep(inputs.source):
        hint = f"{output} is opened next to it; with --topics all it holds its messages, too"
        show_message(
            "note", f"{inputs.source.name} stays as it is, for rosbags and `ros2 bag`: {hint}", "cyan"
        )
    verdicts = [str(result.verdict) for result in replayed.results]
    if "violated" in verdicts and json_file != "-" and semantics == "ltlf" and sys.stderr.isatty():
        hint = "`spatial-replay explain` with the same log and specifications says what would have helped"
        show_message("note", hint, "cyan")
    if output is not None and json_file != "-" and sys.stderr.isatty():
        files = f"`spatial-replay info {output} --layout` and `spatial-replay info --panel`"
        show_message("note", f"for a viewer: {files}", "cyan")
    failures = _failures(replayed, fail_on, allow)
    return exit_code_from_verdicts([*verdicts, *failures], damaged=bool(replayed.faults))


def _failures(replayed: Replayed, kinds: frozenset[str], allow: frozenset[str]) -> Iterator[str]:
    """Yield "violated" for what the user counts as a failure, "unknown" for what shows nothing."""
    results = replayed.results
    if "unknown" in kinds and any(result.verdict == "unknown" for result in results):
        yield "violated"
    if "vacuous" in kinds and (replayed.vacuous or any(result.vacuous for result in results)):
        yield "violated"
    if "cut" in kinds and any(result.tested == "cut" for result in results):
        yield "violated"
    if "vacuous" not in allow and (replayed.vacuous or any(each.tested == "nothing" for each in results)):
        yield "unknown"
    if "dropped" not in allow and replayed.dropped.count:
        yield "unknown"


def _width_ns(text: str) -> int:
    with naming_option("--window"):
        width_ns = duration_ns_from_text(text)
    if width_ns == 0:
        raise UsageError(f"--window {text} contains no sample; give it a width, as in --window 10s")
    return width_ns


def _check_outputs(output: Path | None, json_file: str | None, inputs: tuple[Path, ...]) -> None:
    """Refuse outputs that could not be written, before the work is done."""
    from spatial_replay.logs.output_file import refuse_inputs

    if output is not None:
        refuse_inputs(output, inputs)
    if json_file is not None and json_file != "-":
        refuse_inputs(Path(json_file), inputs)
        if output is not None and output.resolve() == Path(json_file).resolve():
            raise UsageError(f"-o and --json both name {json_file}; give them different names")

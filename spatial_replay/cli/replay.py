"""`spatial-replay replay`: evaluate a recorded run, and write what was found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.exit_codes import exit_code_from_verdicts
from spatial_replay.cli.failures import say
from spatial_replay.cli.options import Reading, output_option, profile_option, reading_options
from spatial_replay.cli.progress import progress
from spatial_replay.cli.times import time_point_from_text
from spatial_replay.cli.verdicts import print_verdicts, write_document
from spatial_replay.errors import UsageError

if TYPE_CHECKING:
    from spatial_replay.logs.source import Source
    from spatial_replay.monitor.semantics import Semantics
    from spatial_replay.replay import Window


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--spec",
    "specs",
    metavar="SPEC",
    multiple=True,
    type=click.Path(path_type=Path),
    help="A specification file; repeat it for several.  [default: those in the log]",
)
@output_option("Write the annotated log (MCAP) here.")
@click.option("--layer", is_flag=True, help="Leave the log's own messages out of the annotated one.")
@click.option("--json", "json_file", metavar="FILE|-", help="Write what was found as one JSON object.")
@click.option("--series", is_flag=True, help="With --json: also the numbers of every node at every sample.")
@click.option("--from", "start", metavar="T", help="From the first sample at or after this time …")
@click.option("--to", "end", metavar="T", help="… to the last one before this time.")
@click.option(
    "--every",
    metavar="N",
    type=click.IntRange(min=1),
    default=1,
    help="Keep every Nth sample, counted from the log's first; bounds in samples count those kept.",
)
@click.option(
    "--each",
    "choices",
    multiple=True,
    metavar="VAR=class:C",
    help="The objects that a template's parameter stands for; VAR=all for every one.",
)
@click.option(
    "--semantics",
    type=click.Choice(["ltlf", "paper"]),
    default="ltlf",
    show_default=True,
    help="What a formula means: robustness over finite traces, or the paper's Def. 16 to the letter.",
)
@profile_option
@reading_options
def replay(
    log: Path,
    specs: tuple[Path, ...],
    output: Path | None,
    layer: bool,
    json_file: str | None,
    series: bool,
    start: str | None,
    end: str | None,
    every: int,
    choices: tuple[str, ...],
    semantics: Semantics,
    profile: str | None,
    reading: Reading,
) -> int:
    """Evaluate specifications over a recorded log.

    T is 12.5s or 1500ms after the first sample, integer nanoseconds, or 2026-01-31T12:00:00Z.

    Exits with 0 if everything is satisfied, 1 if anything is violated, 4 if nothing is but something is
    unknown, 3 if the log is damaged: the verdict is then that of what could be read.

    \b
    Examples:
      spatial-replay replay run.mcap --spec blocks.spatial -o annotated.mcap
      spatial-replay replay run.mcap --spec edited.spatial --json -
      spatial-replay replay people.jsonl --spec social.spatial --each ego=class:pedestrian --from 10s
      spatial-replay replay drive.bag --mapping drive.yaml --spec social.spatial -o annotated.mcap
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.logs.source import open_source
    from spatial_replay.replay import load_files, run_replay

    if series and json_file is None:
        raise UsageError("--series goes into the JSON object; add --json FILE or --json -")
    if layer and output is None:
        raise UsageError("--layer is about the annotated log; add -o FILE")
    mapping = reading["mapping"]
    inputs = (log, *specs, *([] if mapping is None else [mapping]))
    _check_outputs(output, json_file, inputs)
    source = open_source(log, **reading)
    files = load_files(specs, source, profile=profile)
    for warning in (warning for file in files for warning in file.warnings):
        click.echo(warning, err=True)
    with progress("samples") as advance:
        replayed = run_replay(
            source,
            files,
            window=_window(source, start, end, every),
            each=_each(choices),
            semantics=semantics,
            keep_series=series,
            output=output,
            inputs=inputs,
            layer=layer,
            advance=advance,
        )
    for fault in replayed.faults:
        say("warning", fault, colour="yellow")
    if replayed.unreadable:
        remark = f"{replayed.unreadable} observations hold a number that is not finite: unknown there"
        say("warning", remark, colour="yellow")
    if json_file is not None:
        write_document(replayed, json_file, inputs)
    if json_file != "-":
        print_verdicts(replayed, output)
    return exit_code_from_verdicts((result.verdict for result in replayed.results), bool(replayed.faults))


def _check_outputs(output: Path | None, json_file: str | None, inputs: tuple[Path, ...]) -> None:
    """Refuse before the work what would fail after it."""
    from spatial_replay.logs.output import refuse_inputs

    if output is not None:
        refuse_inputs(output, inputs)
    if json_file is not None and json_file != "-":
        refuse_inputs(Path(json_file), inputs)
        if output is not None and output.resolve() == Path(json_file).resolve():
            raise UsageError(f"-o and --json both name {json_file}; give them two names")


def _each(choices: tuple[str, ...]) -> dict[str, str]:
    each: dict[str, str] = {}
    for choice in choices:
        parameter, equals, objects = choice.partition("=")
        if not equals or not parameter:
            raise UsageError(
                f"--each {choice!r} chooses nothing; write --each VAR=class:NAME or --each VAR=all"
            )
        if parameter in each:
            raise UsageError(f"--each gives {parameter!r} twice: {each[parameter]!r} and {objects!r}")
        each[parameter] = objects
    return each


def _window(source: Source, start: str | None, end: str | None, every: int) -> Window:
    from spatial_replay.replay import Window, first_sample_ns

    if start is None and end is None:
        return Window(every=every)
    start_point = None if start is None else time_point_from_text(start)
    end_point = None if end is None else time_point_from_text(end)
    first_ns = first_sample_ns(source)
    whole = Window()
    start_ns = whole.start_ns if start_point is None else start_point.absolute_ns(first_ns)
    end_ns = whole.end_ns if end_point is None else end_point.absolute_ns(first_ns)
    if end_ns <= start_ns:
        window = " ".join(f"{name} {text}" for name, text in (("--from", start), ("--to", end)) if text)
        raise UsageError(f"the window {window} is empty; --to is the time after its last sample")
    return Window(start_ns, end_ns, every)

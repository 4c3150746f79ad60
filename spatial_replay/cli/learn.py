"""`spatial-replay learn`: find a specification that distinguishes good runs from bad ones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    LogPath,
    input_files,
    output_option,
    profile_option,
    reading_options,
)
from spatial_replay.cli.terminal import progress, show, show_file, show_json
from spatial_replay.cli.tune import ManyLogs
from spatial_replay.logs.remote import LogFile

if TYPE_CHECKING:
    from spatial_replay.logs.read_options import Reading


@click.command(cls=ManyLogs)
@click.argument("good", metavar="GOOD...", nargs=-1, required=True, type=LogPath())
@click.option(
    "--bad", metavar="LOG...", multiple=True, type=LogPath(), help="Runs to distinguish from good ones."
)
@output_option("Specification to write.  [default: printed]")
@click.option("--lines", type=click.IntRange(min=1), help="Write at most so many specs.  [default: 20]")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
@profile_option
@reading_options
def learn(
    good: tuple[LogFile, ...],
    bad: tuple[LogFile, ...],
    output: Path | None,
    lines: int | None,
    as_json: bool,
    profile: str | None,
    reading: Reading,
) -> ExitCode:
    """Find a short specification that all GOOD runs satisfy and that bad ones violate.

    It says what always holds, how runs end, what holds at some time, and what comes before what, of objects
    by their names or of all of a class. With bad runs each of its lines is violated by some of them, the most
    distinctive one first; without, it says what good runs have in common. Its comments have the evidence.

    Exits with 0 if there is one that all bad runs violate, and with 1 if not.

    \b
    Examples:
      spatial-replay learn good/*.mcap
      spatial-replay learn good/*.mcap --bad bad/*.mcap -o learned.spatial
    """
    # imported here so that --help stays fast
    from spatial_replay.learning.learned import DEFAULT_LINES, learn_runs
    from spatial_replay.logs.output_file import refuse_inputs, replacing
    from spatial_replay.sources.open_log import read_trace
    from spatial_replay.spec.relations import DEFAULT_PROFILE
    from spatial_replay.tuning import load_runs

    inputs = input_files(*good, *bad, reading=reading)
    if output is not None:
        refuse_inputs(output, inputs)
    with progress("logs", 2 * len(good + bad)) as advance:
        runs = load_runs(good, bad, lambda path: read_trace(path, **reading), advance)
        learned = learn_runs(
            runs, lines=lines or DEFAULT_LINES, profile=profile or DEFAULT_PROFILE, advance=advance
        )
    if output is not None and learned.text:
        with replacing(output, inputs) as stream:
            stream.write(learned.text.encode())
    if as_json:
        show_json(learned.document)
    elif output is not None or not learned.text:
        show(*learned.lines())
        if learned.text:
            show(f"wrote {output}")
    else:
        show_file(learned.text)
    return ExitCode.SATISFIED if learned.is_found else ExitCode.VIOLATED

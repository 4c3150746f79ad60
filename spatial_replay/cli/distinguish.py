"""`spatial-replay distinguish`: the shortest runs that only one of two specifications accepts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import JsonCommand, LogPath, load_spec_options
from spatial_replay.cli.terminal import show_result

if TYPE_CHECKING:
    from spatial_replay.logs.remote import LogFile


@click.command(cls=JsonCommand)
@click.argument("first", metavar="FIRST", type=LogPath())
@click.argument("second", metavar="SECOND", type=LogPath())
@click.option(
    "--hz",
    metavar="N",
    type=float,
    help="Samples per second, to count bounds in seconds.  [default: 1, then 10]",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
def distinguish(first: LogFile, second: LogFile, hz: float | None, as_json: bool) -> int:
    """Find the shortest run that one of two specifications accepts and the other rejects.

    Both directions are searched. A specification accepts a run if the run satisfies all its results. Exits
    with 0 if both accept the same runs, with 1 if they differ, and with 4 if the search is undecided.

    \b
    Examples:
      spatial-replay distinguish old.spatial new.spatial
      spatial-replay distinguish samples.spatial seconds.spatial --hz 30
    """
    # imported here so that --help stays fast
    from spatial_replay.sanity import distinguish as compare

    specifications = [load_spec_options([file], {})[0] for file in (first, second)]
    distinction = compare(*specifications, rate_hz=hz)
    show_result(lambda: distinction.document, distinction.lines, as_json)
    codes = {"same": ExitCode.SATISFIED, "unknown": ExitCode.UNKNOWN}
    return codes.get(distinction.relation, ExitCode.VIOLATED)

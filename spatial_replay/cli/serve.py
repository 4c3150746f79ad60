"""`spatial-replay serve`: look at a replay in a viewer, and change the specification's constants there."""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode, say
from spatial_replay.cli.options import Request, evaluation_options, prepared, report_reading, semantics_option
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.progress import progress

if TYPE_CHECKING:
    from spatial_replay.monitor.semantics import Semantics
    from spatial_replay.replay.tuning import Tuned


@click.command()
@evaluation_options
@click.option(
    "--port",
    metavar="P",
    type=click.IntRange(0, 65535),
    default=8765,
    show_default=True,
    help="Where to listen; 0 for any that is free.",
)
@click.option(
    "--host",
    metavar="ADDRESS",
    default="127.0.0.1",
    show_default=True,
    help="The address to listen at; anyone who reaches it can read the log.",
)
@click.option(
    "--play", is_flag=True, help="Play at once, rather than wait at the start for a viewer to do so."
)
@click.option("--layout", is_flag=True, help="Print the layout to import in the viewer, and serve nothing.")
@semantics_option
def serve(
    request: Request, port: int, host: str, play: bool, layout: bool, semantics: Semantics
) -> ExitCode | None:
    """Replay a log to Foxglove or Lichtblick, over WebSocket.

    In the viewer, open a connection to the address that is printed. There, play, pause, seek and change the
    speed; every constant of the specifications is a parameter: change one, and the curves, colours, events
    and the verdict of the whole log follow.

    T is 12.5s or 1500ms after the first sample, integer nanoseconds, or 2026-01-31T12:00:00Z. Ctrl-C ends it,
    with code 130.

    \b
    Examples:
      spatial-replay serve run.mcap --spec blocks.spatial
      spatial-replay serve run.mcap --spec blocks.spatial --layout > live.json
    """
    tuned = _tuned(request, semantics)
    if layout:
        click.echo(tuned.layout.data)
        return None
    report_reading(tuned.replayed)
    try:
        _serve(tuned, host, port, play)
    except KeyboardInterrupt:
        # this is how it ends
        return ExitCode.INTERRUPTED
    return None


def _serve(tuned: Tuned, host: str, port: int, play: bool) -> None:
    # the numerical libraries load when there is work for them
    from spatial_replay.serve import open_server

    with open_server(tuned, host=host, port=port, play=play) as server:
        print_verdicts(tuned.replayed, None)
        if not _is_loopback(host):
            say("warning", f"anyone who reaches {server.address} can read this log", colour="yellow")
        click.echo(f"serving at {server.address}; Ctrl-C ends it")
        click.echo(f"  in Foxglove or Lichtblick: Open connection, Foxglove WebSocket, {server.address}")
        click.echo("  its layout: the same command with --layout > live.json, to import there")
        server.wait()


def _tuned(request: Request, semantics: Semantics) -> Tuned:
    from spatial_replay.replay import ReplayOptions, Tuning

    task = prepared(request)
    with progress("samples") as advance:
        tuning = Tuning(
            task.source, task.files, ReplayOptions(task.window, task.each, semantics), advance=advance
        )
    return tuning.evaluate()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"

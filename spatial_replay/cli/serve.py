"""`spatial-replay serve`: replay live to a viewer, with the specification's constants as parameters."""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    EvaluationArguments,
    evaluation_options,
    keep_option,
    open_inputs,
    semantics_option,
    warn_of_input,
)
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.progress import progress
from spatial_replay.cli.terminal import show, show_file, warn

if TYPE_CHECKING:
    from spatial_replay.monitor.semantics import Semantics
    from spatial_replay.replay.loaded_log import Evaluated


@click.command()
@evaluation_options
@click.option(
    "--port",
    metavar="P",
    type=click.IntRange(0, 65535),
    default=8765,
    show_default=True,
    help="Port to listen on; 0 for any free port.",
)
@click.option(
    "--host",
    metavar="ADDRESS",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen on; anyone who can reach it can read the log.",
)
@click.option("--play", is_flag=True, help="Start playing at once instead of waiting for a viewer.")
@click.option("--layout", is_flag=True, help="Print the layout to import in the viewer, and exit.")
@keep_option("Messages of the log to send")
@semantics_option
def serve(
    request: EvaluationArguments,
    port: int,
    host: str,
    play: bool,
    layout: bool,
    keep: tuple[str, ...],
    semantics: Semantics,
) -> ExitCode | None:
    """Replay a log live to Foxglove or Lichtblick over WebSocket.

    Connect the viewer to the printed address, then play, pause, seek and change the speed. Every constant of
    the specifications is a parameter: change one, and the curves, colours, events and verdicts of the whole
    log are updated.

    T is 12.5s or 1500ms after the first sample, 5250000000ns on the log's clock, or 2026-01-31T12:00:00Z.
    Ctrl-C stops the server, with exit code 130.

    \b
    Examples:
      spatial-replay serve run.mcap --spec blocks.spatial
      spatial-replay serve run.mcap --spec blocks.spatial --layout > live.json
    """
    evaluated = _evaluated(request, keep, semantics)
    if layout:
        show_file(evaluated.layout.data.decode())
        return None
    warn_of_input(evaluated.replayed)
    try:
        _serve(evaluated, host, port, play)
    except KeyboardInterrupt:
        # the regular way to stop the server
        return ExitCode.INTERRUPTED
    return None


def _serve(evaluated: Evaluated, host: str, port: int, play: bool) -> None:
    # imported here so that --help stays fast
    from spatial_replay.serve import open_server

    with open_server(evaluated, host=host, port=port, play=play) as server:
        print_verdicts(evaluated.replayed, None)
        if not _is_loopback(host):
            warn(f"anyone who can reach {server.address} can read this log")
        show(f"serving at {server.address}; stop with Ctrl-C")
        show(f"  in Foxglove or Lichtblick: Open connection, Foxglove WebSocket, {server.address}")
        show("  layout to import there: run the same command with --layout > live.json")
        server.wait()


def _evaluated(request: EvaluationArguments, keep: tuple[str, ...], semantics: Semantics) -> Evaluated:
    from spatial_replay.replay import LoadedLog

    inputs = open_inputs(request)
    with progress("samples") as advance:
        loaded = LoadedLog(
            inputs.source,
            inputs.files,
            inputs.options(semantics, keep),
            advance=advance,
        )
    return loaded.evaluate()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"

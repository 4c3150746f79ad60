"""`spatial-replay serve`: replay live to a viewer, with the specification's constants as parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    EvaluationArguments,
    ServingArguments,
    evaluation_options,
    keep_option,
    open_inputs,
    semantics_option,
    serving_options,
    warn_of_input,
)
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.terminal import show, show_file
from spatial_replay.cli.watching import files_to_watch, follow_saves, load_log, watch_option
from spatial_replay.errors import importing

if TYPE_CHECKING:
    from collections.abc import Mapping

    from spatial_replay.monitor.verdict import Semantics
    from spatial_replay.replay.loaded_log import Evaluated
    from spatial_replay.replay.specification_files import SpecificationFiles


@click.command()
@evaluation_options
@serving_options(8765)
@click.option("--play", is_flag=True, help="Start playing at once instead of pausing at the first sample.")
@click.option("--layout", is_flag=True, help="Print the layout to import in the viewer, and exit.")
@watch_option
@keep_option("Messages of the log to send")
@semantics_option
def serve(
    request: EvaluationArguments,
    serving: ServingArguments,
    play: bool,
    layout: bool,
    watch: bool,
    keep: tuple[str, ...],
    semantics: Semantics,
) -> ExitCode | None:
    """Replay a log live to Foxglove or Lichtblick over WebSocket.

    Connect the viewer to the printed address, then play, pause, seek and change the speed. Every constant of
    the specifications is a parameter: change one, and the curves, colours, events and verdicts of the whole
    log are updated. With --watch, saving a specification file updates them, too. Viewers can
    change constants; with --watch, the key w in this terminal saves their new values to the specification
    files. So does the service write_constants.

    Write a time T as 12.5s or 1500ms after the first sample, 5250000000ns on the log's clock, or
    2026-01-31T12:00:00Z. Ctrl-C stops the server, with exit code 130.

    \b
    Examples:
      spatial-replay serve run.mcap --spec blocks.spatial
      spatial-replay serve run.mcap --spec blocks.spatial --watch
      spatial-replay serve run.mcap --spec blocks.spatial --layout > live.json
    """
    files = files_to_watch(request) if watch else None
    inputs = open_inputs(request)
    evaluated = load_log(inputs, inputs.options(semantics, keep), files).evaluate()
    if layout:
        show_file(evaluated.layout.data.decode())
        return None
    warn_of_input(evaluated.replayed)
    try:
        return _serve(evaluated, files, serving, play)
    except KeyboardInterrupt:
        # the regular way to stop the server
        return ExitCode.INTERRUPTED


def _serve(
    evaluated: Evaluated, files: SpecificationFiles | None, serving: ServingArguments, play: bool
) -> ExitCode | None:
    # imported here so that --help stays fast
    with importing("serving takes foxglove-sdk", extra="live"):
        from spatial_replay.serve.server import open_server

    host, port, origins = serving.host, serving.port, serving.origins
    with open_server(evaluated, host=host, port=port, play=play, origins=origins) as server:
        print_verdicts(evaluated.replayed, None)
        serving.warn_of_access("read this log and change its constants")
        show(f"serving at {server.address}; stop with Ctrl-C")
        show(f"  in Foxglove or Lichtblick: Open connection, Foxglove WebSocket, {server.address}")
        show("  layout to import there: run the same command with --layout > live.json")
        if files is None:
            server.wait()
            return None

        def write() -> Mapping[str, float | str]:
            edited = server.edited
            return edited.loaded.write_constants(edited.given)

        return follow_saves(files, server.show_saved, write, refuse=server.show_error, check=server.check)

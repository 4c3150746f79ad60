"""`spatial-replay serve` and `--watch`: evaluate again when a file is saved or a viewer changes it."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import click

from spatial_replay.cli.application import ExitCode, report_error
from spatial_replay.cli.options import (
    EvaluationArguments,
    EvaluationInputs,
    ServingArguments,
    evaluation_options,
    keep_option,
    open_inputs,
    semantics_option,
    serving_options,
    warn_of_input,
)
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.terminal import progress, show, show_diagnostics, show_file
from spatial_replay.errors import MissingFileError, SpatialReplayError, SpecificationError, importing
from spatial_replay.logs.remote import local_copy

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from spatial_replay.monitor.verdict import Semantics
    from spatial_replay.replay.loaded_log import Evaluated, LoadedLog
    from spatial_replay.replay.selection import ReplayOptions
    from spatial_replay.replay.specification_files import SpecificationFiles
    from spatial_replay.spec.formula import Specification


_MOST_KEYS: Final = 64

watch_option = click.option(
    "--watch", is_flag=True, help="Evaluate again whenever a specification file is saved."
)


def files_to_watch(request: EvaluationArguments) -> SpecificationFiles:
    """Return the files to watch, from their first state on that can be read: errors are shown until then.

    Raises:
        UsageError: no file, values of constants that none has, a folder that does not exist.
        LogError: the log cannot be read.
    """
    # imported here so that --help stays fast
    from spatial_replay.replay.specification_files import SpecificationFiles

    specs = [local_copy(each) for each in request.specs]
    files = SpecificationFiles(specs, profile=request.profile, constants=request.constants)
    try:
        files.load()
    except (SpecificationError, MissingFileError) as error:
        if not all(path.parent.is_dir() and not path.is_dir() for path in files.paths):
            raise
        # with a log that cannot be read, no save would help
        open_inputs(replace(request, specs=(), constants={}), can_do_without=True)
        _wait_for_files(files, error)
    return files


def _wait_for_files(files: SpecificationFiles, error: SpatialReplayError) -> None:
    """Wait until files that have errors, or are not there, are saved without."""
    saved: Sequence[Specification] | SpatialReplayError | None = error
    saves = files.iter_saves()
    while saved is None or isinstance(saved, SpatialReplayError):
        if saved is not None:
            report_error(saved)
            show(f"waiting for {_names(files)} to be saved; stop with Ctrl-C", err=True)
        saved = next(saves)


def _names(files: SpecificationFiles) -> str:
    return ", ".join(path.name for path in files.paths)


def load_log(
    inputs: EvaluationInputs, options: ReplayOptions, files: SpecificationFiles | None = None
) -> LoadedLog:
    """Read a log into memory.

    Args:
        files: what is watched, or None.
    """
    from spatial_replay.replay.loaded_log import LoadedLog

    with progress("samples") as advance:
        return LoadedLog(inputs.source, inputs.files, options, saved=files, advance=advance)


def watch_log(request: EvaluationArguments, semantics: Semantics) -> ExitCode:
    """Evaluate a log, and again whenever a specification file is saved, until Ctrl-C."""
    try:
        files = files_to_watch(request)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    inputs = open_inputs(request)
    # no messages of the log are needed
    loaded = load_log(inputs, replace(inputs.options(semantics), keep=()), files)
    evaluated = loaded.evaluate()
    warn_of_input(evaluated.replayed)
    print_verdicts(evaluated.replayed, None)

    def evaluate(saved: Sequence[Specification]) -> Evaluated:
        nonlocal loaded
        other = loaded.with_files(saved)
        evaluated = other.evaluate()
        loaded = other
        return evaluated

    return follow_saves(files, evaluate, files.write)


def follow_saves(
    files: SpecificationFiles,
    evaluate: Callable[[Sequence[Specification]], Evaluated],
    write: Callable[[], Mapping[str, Any]],
    *,
    refuse: Callable[[SpatialReplayError], None] = lambda error: None,
    check: Callable[[], None] = lambda: None,
) -> ExitCode:
    """Print what each save of the files gives, until Ctrl-C; after an error, what was shown before stays.

    Args:
        evaluate: evaluates the files as saved.
        write: writes constants into the files, and returns those that changed; for the key w.
        refuse: takes the error of a file that cannot be read.
        check: called about ten times a second; raises an error that ends it.
    """
    names = _names(files)
    try:
        with pressed_keys() as keys:
            hint = "; w writes constants into it" if sys.stdin.isatty() else ""
            show(f"watching {names}{hint}; stop with Ctrl-C")
            sys.stdout.flush()
            for saved in files.iter_saves():
                check()
                try:
                    if "w" in keys():
                        _show_written(write(), names)
                    if isinstance(saved, SpatialReplayError):
                        refuse(saved)
                        raise saved
                    if saved is not None:
                        _print_saved(saved, evaluate(saved), names)
                except SpatialReplayError as error:
                    report_error(error)
                    show("the evaluation before stays", err=True)
    except KeyboardInterrupt:
        # the regular way to stop watching
        return ExitCode.INTERRUPTED
    return ExitCode.SATISFIED


def _print_saved(saved: Sequence[Specification], evaluated: Evaluated, names: str) -> None:
    if sys.stdout.isatty():
        click.clear()
    show_diagnostics(warning for file in saved for warning in file.warnings)
    show_diagnostics(evaluated.replayed.missing)
    show(f"{names} saved")
    print_verdicts(evaluated.replayed, None)
    sys.stdout.flush()


def _show_written(written: Mapping[str, Any], names: str) -> None:
    values = ", ".join(
        f"{name} = {value:.12g}" if isinstance(value, float) else f"{name} = {value}"
        for name, value in written.items()
    )
    show(f"{values} written into {names}" if written else f"{names} has all values already")


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Give a function that returns the keys pressed since its last call; "" if there is no terminal."""
    if not sys.stdin.isatty():
        yield lambda: ""
        return
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def keys() -> str:
        # what is left in the terminal's own buffer, past that of Python
        waiting = select.select([terminal], [], [], 0.0)[0]
        return os.read(terminal, _MOST_KEYS).decode(errors="replace") if waiting else ""

    try:
        tty.setcbreak(terminal)
        yield keys
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


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

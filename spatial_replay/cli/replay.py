"""A recorded run: `spatial-replay replay`, `report`, `export`, `explain` and `serve`."""

from __future__ import annotations

import os
import re
import select
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

import click

from spatial_replay.cli.application import ExitCode, exit_code_from_verdicts, report_error
from spatial_replay.cli.options import (
    EvaluationArguments,
    EvaluationInputs,
    JsonCommand,
    ServingArguments,
    allow_option,
    check_outputs,
    evaluation_options,
    fail_on_option,
    keep_option,
    log_output_option,
    naming_option,
    open_inputs,
    output_option,
    plugin_option,
    refuse_values,
    semantics_option,
    serving_options,
    warn_of_input,
)
from spatial_replay.cli.output import (
    MANY,
    VERDICT_COLOURS,
    others_text,
    print_verdicts,
    worst_of,
    write_document,
)
from spatial_replay.cli.terminal import (
    Coloured,
    Line,
    progress,
    show,
    show_diagnostics,
    show_file,
    show_message,
    show_result,
    warn,
)
from spatial_replay.errors import (
    MissingFileError,
    SpatialReplayError,
    SpecificationError,
    UsageError,
    importing,
)
from spatial_replay.logs.remote import local_copy
from spatial_replay.monitor.verdict import counts_text
from spatial_replay.text import plural, requirement_text, time_text
from spatial_replay.trace.trace import duration_ns_from_text, time_point_from_text

if TYPE_CHECKING:
    from spatial_replay.monitor.result import SpecResult
    from spatial_replay.monitor.verdict import Semantics
    from spatial_replay.replay.document import Explanation
    from spatial_replay.replay.engine import Replayed
    from spatial_replay.replay.loaded_log import Evaluated, LoadedLog
    from spatial_replay.replay.selection import ReplayOptions
    from spatial_replay.replay.specification_files import SpecificationFiles
    from spatial_replay.replay.table import Quantity
    from spatial_replay.spec.formula import Specification

_MOST_KEYS: Final = 64

watch_option = click.option(
    "--watch", is_flag=True, help="Evaluate again whenever a specification file is saved."
)


def files_to_watch(request: EvaluationArguments) -> SpecificationFiles:
    """Wait until all files can be read, and return them. Errors are shown until then.

    Raises:
        UsageError: there is no file, a constant is unknown, or a folder does not exist.
        LogError: the log cannot be read.
    """
    # imported here so that --help stays fast
    from spatial_replay.replay.specification_files import SpecificationFiles

    spec_paths = [local_copy(spec) for spec in request.specs]
    files = SpecificationFiles(spec_paths, constants=request.constants)
    try:
        files.load()
    except (SpecificationError, MissingFileError) as error:
        if not all(path.parent.is_dir() and not path.is_dir() for path in files.paths):
            raise
        # raises the error of an unreadable log, because a saved specification would not help
        open_inputs(replace(request, specs=(), constants={}), can_do_without=True)
        _wait_for_files(files, error)
    return files


def _wait_for_files(files: SpecificationFiles, error: SpatialReplayError) -> None:
    """Wait until faulty or missing files are saved without errors."""
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
        files: the watched files, or None.
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
    evaluation = loaded.evaluate()
    warn_of_input(evaluation.replayed)
    print_verdicts(evaluation.replayed, None)

    def evaluate(saved: Sequence[Specification]) -> Evaluated:
        nonlocal loaded
        next_log = loaded.with_files(saved)
        evaluation = next_log.evaluate()
        loaded = next_log
        return evaluation

    return follow_saves(files, evaluate, files.write)


def follow_saves(
    files: SpecificationFiles,
    evaluate: Callable[[Sequence[Specification]], Evaluated],
    write: Callable[[], Mapping[str, Any]],
    *,
    refuse: Callable[[SpatialReplayError], None] = lambda error: None,
    check: Callable[[], None] = lambda: None,
) -> ExitCode:
    """Print the results of each save of the files, until Ctrl-C. After an error, the previous results stay.

    Args:
        evaluate: evaluates the saved files.
        write: function of the key w; writes constants into the files, and returns the changed constants.
        refuse: receives the error of an unreadable file.
        check: called about ten times a second; its errors end the loop.
    """
    file_names = _names(files)
    try:
        with pressed_keys() as keys:
            hint = "; w writes constants into it" if sys.stdin.isatty() else ""
            show(f"watching {file_names}{hint}; stop with Ctrl-C")
            sys.stdout.flush()
            for saved in files.iter_saves():
                check()
                try:
                    if "w" in keys():
                        _show_constants(write(), file_names)
                    if isinstance(saved, SpatialReplayError):
                        refuse(saved)
                        raise saved
                    if saved is not None:
                        _print_evaluation(saved, evaluate(saved), file_names)
                except SpatialReplayError as error:
                    report_error(error)
                    show("the evaluation before stays", err=True)
    except KeyboardInterrupt:
        # an interruption is the regular way to stop watching
        return ExitCode.INTERRUPTED
    return ExitCode.SATISFIED


def _print_evaluation(saved: Sequence[Specification], evaluation: Evaluated, file_names: str) -> None:
    if sys.stdout.isatty():
        click.clear()
    show_diagnostics(warning for file in saved for warning in file.warnings)
    show_diagnostics(evaluation.replayed.missing)
    show(f"{file_names} saved")
    print_verdicts(evaluation.replayed, None)
    sys.stdout.flush()


def _show_constants(changes: Mapping[str, Any], file_names: str) -> None:
    values_text = ", ".join(
        f"{name} = {value:.12g}" if isinstance(value, float) else f"{name} = {value}"
        for name, value in changes.items()
    )
    show(f"{values_text} written into {file_names}" if changes else f"{file_names} has all values already")


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the keys pressed since its last call; "" without a terminal."""
    if not sys.stdin.isatty():
        yield lambda: ""
        return
    import termios
    import tty

    terminal = sys.stdin.fileno()
    terminal_settings = termios.tcgetattr(terminal)

    def keys() -> str:
        # `os.read` bypasses Python's buffer, which `select` does not see
        readable_files = select.select([terminal], [], [], 0.0)[0]
        return os.read(terminal, _MOST_KEYS).decode(errors="replace") if readable_files else ""

    try:
        tty.setcbreak(terminal)
        yield keys
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, terminal_settings)


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
    files. The service write_constants saves them, too.

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
    evaluation = load_log(inputs, inputs.options(semantics, keep), files).evaluate()
    if layout:
        show_file(evaluation.layout.data.decode())
        return None
    warn_of_input(evaluation.replayed)
    try:
        return _serve(evaluation, files, serving, play)
    except KeyboardInterrupt:
        # an interruption is the regular way to stop the server
        return ExitCode.INTERRUPTED


def _serve(
    evaluation: Evaluated, files: SpecificationFiles | None, serving: ServingArguments, play: bool
) -> ExitCode | None:
    # imported here so that --help stays fast
    with importing("serving takes foxglove-sdk", extra="live"):
        from spatial_replay.serve.server import open_server

    host, port, origins = serving.host, serving.port, serving.origins
    with open_server(evaluation, host=host, port=port, play=play, origins=origins) as server:
        print_verdicts(evaluation.replayed, None)
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

        return follow_saves(
            files, server.show_specifications, write, refuse=server.show_error, check=server.check
        )


@click.command()
@evaluation_options
@plugin_option
@log_output_option("Annotated log to write (MCAP).", required=False)
@click.option("--layer", is_flag=True, help="Write only derived messages, without the messages of the log.")
@keep_option("Messages of the log to copy with -o", "all; none of a ROS 2 bag")
@click.option(
    "--arrow",
    metavar="RESULT",
    default="",
    help="With -o: violated result for the scene's arrow.  [default: the first]",
)
@click.option("--json", "json_file", metavar="FILE|-", help="Results to write, as one JSON object.")
@click.option("--series", is_flag=True, help="With --json: add four numbers of every node at every sample.")
@click.option(
    "--to-end",
    "signal",
    is_flag=True,
    help="With --json: like --series, with the robustness to the end of the log, too.",
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

    A time T is 12.5s or 1500ms after the first sample, 5250000000ns on the log's clock, or
    2026-01-31T12:00:00Z.

    Exits with 0 if all results are satisfied, 1 if any is violated, 3 if the log is damaged. The code is 4 if
    a result is unknown, doubtful or tested by nothing, or if the recorder dropped samples. A doubtful result
    rests on an assumption that the log contradicts. With --watch, the key w writes the values of --const into
    the files.

    \b
    Examples:
      spatial-replay replay run.mcap --spec blocks.spatial -o annotated.mcap
      spatial-replay replay run.mcap --spec edited.spatial --json -
      spatial-replay replay run.mcap --spec blocks.spatial --const near=80 --fail-on vacuous,unknown
      spatial-replay replay walk.jsonl --spec walk.spatial --each ego=class:person
      spatial-replay replay drive.bag --mapping drive.yaml --spec drive.spatial --watch
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.topics import MAPPED
    from spatial_replay.replay.engine import run_replay
    from spatial_replay.replay.selection import default_keep

    if json_file is None:
        why = "adds to the JSON object; add --json FILE or --json -"
        refuse_values({"--series": series, "--to-end": signal}, why)
    if output is None:
        why = "applies to the annotated log; add -o FILE"
        refuse_values({"--layer": layer, "--topics": keep, "--arrow": arrow}, why)
    if keep and layer:
        raise UsageError("--layer copies no messages; remove --topics or --layer")
    window_ns = None if width is None else _width_ns(width)
    if semantics != "ltlf":
        why = f"is not defined under --semantics {semantics}; remove one of them"
        refuse_values({"--to-end": signal, "--window": width}, why)
    outputs = {"-o": output, "--json": json_file}
    if watch:
        refused_options = {**outputs, "--window": width, "--fail-on": fail_on, "--allow": allow}
        refuse_values(refused_options, "is not for --watch, which prints verdicts only; remove it")
        return watch_log(request, semantics)
    check_outputs(outputs, request.inputs)
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
        show_message("note", f"{inputs.source.name} is unchanged, for rosbags and `ros2 bag`: {hint}", "cyan")
    verdicts = [str(result.verdict) for result in replayed.results]
    if "violated" in verdicts and json_file != "-" and semantics == "ltlf" and sys.stderr.isatty():
        hint = "`spatial-replay explain` with the same log and specifications says what would have helped"
        show_message("note", hint, "cyan")
    if output is not None and json_file != "-" and sys.stderr.isatty():
        viewer_commands = f"`spatial-replay info {output} --layout` and `spatial-replay info --panel`"
        show_message("note", f"for a viewer: {viewer_commands}", "cyan")
    failure_verdicts = _failures(replayed, fail_on, allow)
    return exit_code_from_verdicts([*verdicts, *failure_verdicts], damaged=bool(replayed.faults))


def _failures(replayed: Replayed, kinds: frozenset[str], allow: frozenset[str]) -> Iterator[str]:
    """Yield "violated" for each kind of failure in `kinds`, and "unknown" for inconclusive results."""
    results = replayed.results
    if "unknown" in kinds and any(result.verdict == "unknown" for result in results):
        yield "violated"
    if "vacuous" in kinds and (replayed.vacuous or any(result.vacuous for result in results)):
        yield "violated"
    if "cut" in kinds and any(result.tested == "cut" for result in results):
        yield "violated"
    if "left" in kinds and replayed.left:
        yield "violated"
    if "doubtful" in kinds and any(result.doubts for result in results):
        yield "violated"
    if "doubtful" not in allow:
        yield from _doubtful(results)
    if "vacuous" not in allow and (replayed.vacuous or any(result.tested == "nothing" for result in results)):
        yield "unknown"
    if "dropped" not in allow and replayed.dropped.count:
        yield "unknown"


def _doubtful(results: Iterable[SpecResult]) -> Iterator[str]:
    """Yield "unknown" for each result that rests on an assumption which the log contradicts."""
    return ("unknown" for result in results if result.doubts)


def _width_ns(text: str) -> int:
    with naming_option("--window"):
        width_ns = duration_ns_from_text(text)
    if width_ns == 0:
        raise UsageError(f"--window {text} contains no sample; give it a width, as in --window 10s")
    return width_ns


@click.command()
@evaluation_options
@output_option("Report to write (HTML).  [default: the log's name with .html, in this folder]")
@semantics_option
def report(request: EvaluationArguments, output: Path | None, semantics: Semantics) -> int:
    """Write an HTML report of a recorded run, for any browser.

    It shows verdicts and explanations, the specification's tree, curves, the scene from above, the automaton,
    events and planner decisions, with one time cursor for all. It needs no network and no other file.

    Exits with 0 if all results are satisfied, 1 if any is violated, 4 if none is violated and any is unknown
    or doubtful, 3 if the log is damaged.

    \b
    Examples:
      spatial-replay report run.mcap
      spatial-replay report run.mcap --spec blocks.spatial -o run.html
      spatial-replay report run.mcap --spec edited.spatial --semantics paper -o run.html
    """
    # imported here so that --help stays fast
    from spatial_replay.report.write import refuse_output, write_report

    output = Path(f"{Path(request.log.name.removesuffix('.gz')).stem}.html") if output is None else output
    refuse_output(output, request.inputs)
    inputs = open_inputs(request)
    with progress("samples") as advance:
        replayed = write_report(
            inputs.source,
            inputs.files,
            output,
            inputs.options(semantics),
            inputs=request.inputs,
            advance=advance,
        )
    warn_of_input(replayed)
    print_verdicts(replayed, output)
    verdicts = [str(result.verdict) for result in replayed.results]
    return exit_code_from_verdicts([*verdicts, *_doubtful(replayed.results)], bool(replayed.faults))


@click.command()
@evaluation_options
@output_option("Output: FILE.csv or FILE.parquet.", required=True)
@click.option(
    "--quantity",
    type=click.Choice(["value", "now", "lower", "upper"]),
    default="value",
    show_default=True,
    help="Number of each node to export.",
)
def export(request: EvaluationArguments, output: Path, quantity: Quantity) -> int:
    """Export the robustness in an annotated log as a table: one row per sample, one column per node.

    With --spec or another option of the evaluation, LOG is evaluated first. It may then have any format.

    A column title lists the named specs on the path to its node, such as task/deliver, and the text of an
    unnamed node. Other columns hold the seconds since the first row and the states of the automata. Empty
    cells are undetermined numbers.

    \b
    Examples:
      spatial-replay export annotated.mcap -o run.csv
      spatial-replay export drive.bag --mapping drive.yaml --spec drive.spatial -o run.csv
    """
    # imported here so that --help stays fast
    from spatial_replay.replay.table import check_table_name, export_table
    from spatial_replay.sources.open_log import open_source

    check_table_name(output)
    faults: tuple[str, ...] = ()
    with TemporaryDirectory(prefix="spatial-replay-") as folder:
        log = request.log
        if _is_evaluated(request):
            log = Path(folder, "annotated.mcap")
            faults = _evaluate(request, log)
        with progress("rows") as advance:
            row_count, column_count, losses = export_table(
                open_source(log), output, quantity=quantity, inputs=request.inputs, advance=advance
            )
    warn(*losses)
    show(f"wrote {output}: {plural(row_count, 'row')}, {plural(column_count, 'node')}")
    return ExitCode.DAMAGED if faults or losses else ExitCode.SATISFIED


def _is_evaluated(request: EvaluationArguments) -> bool:
    """Return whether the log is evaluated first. An annotated log has its numbers already."""
    options = (request.specs, request.constants, request.choices, request.start, request.end)
    return any(options) or request.every > 1 or request.reading.get("mapping") is not None


def _evaluate(request: EvaluationArguments, output: Path) -> tuple[str, ...]:
    """Write an annotated log, and return the faults of its input."""
    from spatial_replay.replay.engine import run_replay

    inputs = open_inputs(request)
    with progress("samples") as advance:
        replayed = run_replay(
            inputs.source, inputs.files, inputs.options(), output=output, layer=True, advance=advance
        )
    warn_of_input(replayed)
    return replayed.faults


@click.command(cls=JsonCommand)
@evaluation_options
@click.option(
    "--result",
    metavar="NAME[@OBJECT]",
    default="",
    help="Spec to explain; NAME@OBJECT for one object of a template.  [default: all results]",
)
@click.option("--at", metavar="T", help="Explain the verdict at time T, from the samples up to T.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def explain(request: EvaluationArguments, result: str, at: str | None, as_json: bool) -> int:
    """Explain a verdict in plain sentences.

    Each explanation names the deciding sample, objects and relation, the robustness, the time of the verdict,
    and a change of a constant that flips the verdict. For an unknown verdict, it names the missing parts.

    A time T is 12.5s or 1500ms after the first sample, 5250000000ns on the log's clock, or
    2026-01-31T12:00:00Z. The exit codes have the meanings of `replay`. A verdict that is still pending at the
    time --at counts as unknown (4).

    \b
    Examples:
      spatial-replay explain run.mcap --spec blocks.spatial
      spatial-replay explain run.mcap --spec blocks.spatial --result reach --at 12.3s
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.topics import MAPPED
    from spatial_replay.replay.document import explain_results, idle_document, verdict_of
    from spatial_replay.replay.engine import run_replay
    from spatial_replay.replay.selection import has_samples_from

    spec_name, _, object_text = result.partition("@")
    node_name, object_name = spec_name or None, object_text or None
    if at is not None and request.end is not None:
        raise UsageError("--at and --to both set the last sample; give only one")
    inputs = _until(open_inputs(request), at)
    with progress("samples") as advance:
        replayed = run_replay(
            inputs.source,
            inputs.files,
            inputs.options(keep=(MAPPED,)),
            keep_series=True,
            keep_leaves=True,
            certify=False,
            advance=advance,
        )
    warn_of_input(replayed)
    continues = at is not None and has_samples_from(inputs.source, inputs.window.end_ns)
    if at is not None and not continues and replayed.end_ns < inputs.window.end_ns - 1:
        warn(f"--at {at} is after the last sample, at {time_text(replayed.end_ns, replayed.first_ns)}")
    other_results: Sequence[SpecResult] = ()
    count_line = ""
    if not as_json and object_name is None:
        matches = [
            result
            for result in replayed.results
            if verdict_of(result, node_name, goes_on=continues) is not None
        ]
        # without a match, all results stay, and the error suggests the nearest name
        worst, other_results = worst_of(matches) if matches else (replayed.results, ())
        if len(matches) > MANY:
            all_verdicts = [verdict_of(result, node_name, goes_on=continues) for result in matches]
            count_line = f"{len(matches):,} results: {counts_text(map(str, all_verdicts))}"
        replayed = replace(replayed, results=tuple(worst))
    other_verdicts = [str(verdict_of(result, node_name, goes_on=continues)) for result in other_results]
    explanations = explain_results(replayed, node=node_name, object=object_name, goes_on=continues)
    vacuous_parts = replayed.vacuous if node_name is None and object_name is None else ()

    def documents() -> list[Any]:
        return [*(explanation.document for explanation in explanations), *map(idle_document, vacuous_parts)]

    def lines() -> Iterator[Line]:
        paragraphs = [*([[count_line]] if count_line else []), *_texts(explanations)]
        if vacuous_parts:
            paragraphs.append([part.message for part in vacuous_parts])
        if other_results:
            paragraphs.append([others_text(other_results, other_verdicts)])
        for index, sentences in enumerate(paragraphs):
            yield from ([""] if index else [])
            yield from map(_colour_verdicts, sentences)

    show_result(documents, lines, as_json)
    verdicts = [*(explanation.verdict for explanation in explanations), *other_verdicts]
    verdicts += _doubtful((*replayed.results, *other_results))
    return exit_code_from_verdicts(verdicts, bool(replayed.faults))


def _colour_verdicts(line: str) -> Line:
    pieces = enumerate(re.split(_VERDICT, line))
    return tuple(Coloured(piece, VERDICT_COLOURS[piece]) if number % 2 else piece for number, piece in pieces)


_VERDICT: Final = re.compile(r"(?<=is )(satisfied|violated|unknown)\b")


def _texts(explanations: Sequence[Explanation]) -> Iterator[list[str]]:
    """Yield the sentences of each explanation. Consecutive explanations of a node share the requirement."""
    previous_spec = None
    for explanation in explanations:
        spec_and_node = explanation.document["specification"], explanation.document["node"]
        requirement = requirement_text(explanation.document["requirement"], explanation.document["title"])
        heading = [requirement] if requirement and spec_and_node != previous_spec else []
        yield [*heading, *explanation.sentences]
        previous_spec = spec_and_node


def _until(inputs: EvaluationInputs, at: str | None) -> EvaluationInputs:
    """Return the inputs with a window that ends after the time `at`."""
    from spatial_replay.replay.selection import absolute_ns

    if at is None:
        return inputs
    with naming_option("--at"):
        at_ns = absolute_ns(time_point_from_text(at), inputs.source)
    if at_ns < inputs.window.start_ns:
        raise UsageError(f"--at {at} is before --from; no sample is left")
    return replace(inputs, window=replace(inputs.window, end_ns=at_ns + 1))

"""`spatial-replay tune` and `learn`: constants that fit recorded runs, and whole specifications."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    JsonCommand,
    LogPath,
    choices_option,
    constants_option,
    input_files,
    load_spec_options,
    objects_by_parameter,
    output_option,
    reading_options,
)
from spatial_replay.cli.terminal import (
    progress,
    show,
    show_diagnostics,
    show_file,
    show_json,
    show_result,
    warn,
)
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, is_address, local_copy
from spatial_replay.text import plural

if TYPE_CHECKING:
    from spatial_replay.logs.read_options import Reading
    from spatial_replay.tuning.margins import LabelledRun, Value
    from spatial_replay.tuning.tuned import TunedConstant, Tuning


_PICTURES = (".png", ".svg", ".html")
_MANY = frozenset({"--good", "--bad"})
_MOST_LISTED = 20
"""Maximum number of listed runs; JSON lists all runs."""


class ManyLogs(JsonCommand):
    """A command whose options --good and --bad take several values, because shells expand `good/*.mcap`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        return super().parse_args(ctx, list(_one_by_one(args)))


def _one_by_one(arguments: list[str]) -> Iterator[str]:
    repeated_option: str | None = None
    is_first_value = False
    for argument in arguments:
        if argument in _MANY:
            repeated_option, is_first_value = argument, True
            yield argument
        elif argument.startswith("-") and argument != "-":
            repeated_option = None
            yield argument
        else:
            # an option of click takes one value, so its name is repeated before each further value
            if repeated_option is not None and not is_first_value:
                yield repeated_option
            is_first_value = False
            yield argument


def _read_ranges(
    context: click.Context, parameter: click.Parameter, texts: tuple[str, ...]
) -> dict[str, tuple[Value, Value] | None]:
    ranges: dict[str, tuple[Value, Value] | None] = {}
    for text in texts:
        name, equals, span = (part.strip() for part in text.partition("="))
        low, colon, high = (part.strip() for part in span.partition(":"))
        if not name or (equals and not (colon and low and high)):
            raise UsageError(
                f"--vary: {text!r} is incomplete; write NAME=LOW:HIGH, such as near=40:100 or hold=1s:4s"
            )
        if name in ranges:
            raise UsageError(f"--vary: {name!r} is given twice; give one range")
        ranges[name] = (low, high) if equals else None
    return ranges


@click.command(cls=ManyLogs)
@click.option("--spec", "spec", metavar="SPEC", type=LogPath(), required=True, help="Specification file.")
@click.option("--good", metavar="LOG...", multiple=True, type=LogPath(), help="Runs that have to satisfy it.")
@click.option("--bad", metavar="LOG...", multiple=True, type=LogPath(), help="Runs that have to violate it.")
@click.option(
    "--vary",
    "ranges",
    metavar="NAME[=LOW:HIGH]",
    multiple=True,
    callback=_read_ranges,
    help="Constant to tune, and the values to try; repeat for several."
    "  [default: those with a range in the text]",
)
@click.option("--write", is_flag=True, help="Write the values found into SPEC; only the numbers change.")
@output_option("Picture of the margins over the first two constants to write (.png, .svg, .html).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Seed of the search over several constants.",
)
@choices_option
@constants_option
@reading_options
def tune(
    spec: LogFile,
    good: tuple[LogFile, ...],
    bad: tuple[LogFile, ...],
    ranges: dict[str, tuple[Value, Value] | None],
    write: bool,
    output: Path | None,
    as_json: bool,
    seed: int,
    choices: tuple[str, ...],
    constants: Mapping[str, float | str],
    reading: Reading,
) -> ExitCode:
    """Find constants for which good runs satisfy a specification, and bad runs violate it.

    With good and bad runs, the values have the widest margin between good and bad. With good runs only, the
    values are the tightest. Constants to tune have a range in the text, such as const near = 70 in [40, 100],
    or are named by --vary. Bounds of windows, such as F[0s, hold], are tuned like thresholds.

    Exits with 0 if there are such values. Otherwise it lists the runs that contradict each other, and exits
    with 1.

    \b
    Examples:
      spatial-replay tune --spec blocks.spatial --good good/*.mcap --bad bad/*.mcap
      spatial-replay tune --spec blocks.spatial --good good/*.mcap --vary near=40:100 --write
      spatial-replay tune --spec blocks.spatial --good a.mcap --vary near --vary hold -o surface.png
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.output_file import refuse_inputs
    from spatial_replay.replay.specification_files import plain_values, write_constants
    from spatial_replay.sources.open_log import read_trace
    from spatial_replay.tuning.margins import load_runs
    from spatial_replay.tuning.tuned import tune_runs

    if not good:
        raise UsageError("there is no good run to satisfy; give at least one: --good LOG")
    if write and is_address(spec):
        raise UsageError(
            f"--write changes {spec}, which is an address; copy it to this machine, and give that"
        )
    (file,) = load_spec_options([spec], constants)
    show_diagnostics(file.warnings)
    if output is not None:
        if output.suffix.lower() not in _PICTURES:
            raise UsageError(f"-o {output}: the picture is {', '.join(_PICTURES)}; name it {output.stem}.png")
        refuse_inputs(output, input_files(spec, *good, *bad, reading=reading))
    with progress("logs", 2 * len(good + bad)) as advance:
        runs = load_runs(good, bad, lambda path: read_trace(path, **reading), advance)
        tuning = tune_runs(file, runs, ranges, each=objects_by_parameter(choices), seed=seed, advance=advance)
    _warn_of_doubts(runs)
    changes: tuple[str, ...] = ()
    if write and tuning.is_found:
        changes = write_constants(local_copy(spec), plain_values(tuning.specification))
    if output is not None:
        from spatial_replay.notebook.study_view import write_surface

        write_surface(tuning, output)
    show_result(lambda: tuning.document, lambda: _lines(tuning), as_json)
    if not as_json:
        if write and tuning.is_found:
            show(f"{spec}: {', '.join(changes)} written" if changes else f"{spec} has these values already")
        if output is not None:
            show(f"wrote {output}")
    return ExitCode.SATISFIED if tuning.is_found else ExitCode.VIOLATED


def _warn_of_doubts(runs: Sequence[LabelledRun]) -> None:
    """Warn of assumptions that logs contradict, because limits are fitted to these logs."""
    warn(*(doubt.remark(run.name) for run in runs for doubt in run.trace.doubts))


def _lines(tuning: Tuning) -> Iterator[str]:
    counts = {is_good: sum(run.is_good == is_good for run in tuning.runs) for is_good in (True, False)}
    runs_text = plural(counts[True], "good run") + (
        f" and {plural(counts[False], 'bad run')}" if counts[False] else ""
    )
    if tuning.conflict is not None:
        names = ", ".join(constant.name for constant in tuning.constants)
        beginning = (
            f"no values of {names} exist" if tuning.conflict.is_proven else f"found no values of {names}"
        )
        for index, (heading, lines) in enumerate(tuning.conflict.sections):
            yield f"and {heading}:" if index else f"{beginning} that fit {runs_text}; {heading}:"
            yield from (f"  {line}" for line in lines)
        return
    label = ("widest margin" if tuning.is_widest else "margin") if counts[False] else "tightest values"
    yield (
        f"{label} for {runs_text}: {tuning.margin + 0.0:.6g}" if counts[False] else f"{label} for {runs_text}"
    )
    undecided = [constant.name for constant in tuning.constants if not constant.is_decided]
    if undecided:
        names = ", ".join(undecided)
        yield f"  no run decides {names}: no bad run fails by it, so it stays as written, or as near as fits"
    elif not tuning.is_widest:
        yield "  as far as was searched: a narrower range may hold a wider margin"
    rows = [_row(constant) for constant in tuning.constants]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
    closest_runs = sorted(tuning.runs, key=lambda run: run.margin)
    yield "closest runs:" if len(closest_runs) > _MOST_LISTED else "runs, the closest first:"
    width = max(len(run.name) for run in closest_runs[:_MOST_LISTED])
    for run in closest_runs[:_MOST_LISTED]:
        label = "good" if run.is_good else "bad "
        yield f"  {run.name:<{width}}  {label}  {run.verdict:<9}  robustness {run.robustness + 0.0:.6g}"
    if len(closest_runs) > _MOST_LISTED:
        yield f"  … and {plural(len(closest_runs) - _MOST_LISTED, 'more run')}"


def _row(constant: TunedConstant) -> tuple[str, str, str, str]:
    def text(value: Any) -> str:
        return value if isinstance(value, str) else f"{value:.12g}"

    range_text = f"every value from {text(constant.low)} to {text(constant.high)} fits"
    return constant.name, text(constant.value), f"({text(constant.written)} as written)", range_text


@click.command(cls=ManyLogs)
@click.argument("good", metavar="GOOD...", nargs=-1, required=True, type=LogPath())
@click.option(
    "--bad", metavar="LOG...", multiple=True, type=LogPath(), help="Runs to distinguish from good ones."
)
@output_option("Specification to write.  [default: printed]")
@click.option("--lines", type=click.IntRange(min=1), help="Write at most so many specs.  [default: 20]")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
@reading_options
def learn(
    good: tuple[LogFile, ...],
    bad: tuple[LogFile, ...],
    output: Path | None,
    lines: int | None,
    as_json: bool,
    reading: Reading,
) -> ExitCode:
    """Find a short specification that all GOOD runs satisfy, and bad runs violate.

    Its lines are invariants, ends of runs, goals and orders of events, for objects by name or for a class.
    With bad runs, some bad run violates each line, and the most distinctive line comes first. Without bad
    runs, the lines are common properties of the good runs. Comments have the evidence.

    Exits with 0 if all bad runs violate the specification, otherwise with 1.

    \b
    Examples:
      spatial-replay learn good/*.mcap
      spatial-replay learn good/*.mcap --bad bad/*.mcap -o learned.spatial
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.output_file import refuse_inputs, replacing
    from spatial_replay.sources.open_log import read_trace
    from spatial_replay.tuning.learned import DEFAULT_LINES, learn_runs
    from spatial_replay.tuning.margins import load_runs

    inputs = input_files(*good, *bad, reading=reading)
    if output is not None:
        refuse_inputs(output, inputs)
    with progress("logs", 2 * len(good + bad)) as advance:
        runs = load_runs(good, bad, lambda path: read_trace(path, **reading), advance)
        learning = learn_runs(runs, lines=lines or DEFAULT_LINES, advance=advance)
    _warn_of_doubts(runs)
    if output is not None and learning.text:
        with replacing(output, inputs) as stream:
            stream.write(learning.text.encode())
    if as_json:
        show_json(learning.document)
    elif output is not None or not learning.text:
        show(*learning.lines())
        if learning.text:
            show(f"wrote {output}")
    else:
        show_file(learning.text)
    return ExitCode.SATISFIED if learning.is_found else ExitCode.VIOLATED

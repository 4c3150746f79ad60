"""`spatial-replay diff`: two versions of a specification over logs, or two logs side by side."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from glob import has_magic
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode, most_severe
from spatial_replay.cli.options import (
    ConditionArguments,
    EvaluationArguments,
    JsonCommand,
    condition_options,
    objects_by_parameter,
    open_inputs,
    output_option,
    refuse_values,
    semantics_option,
)
from spatial_replay.cli.terminal import progress, show, show_diagnostics, show_json, show_result, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import BAG_METADATA, LogFile, is_address, local_files, log_file, sendable

if TYPE_CHECKING:
    from spatial_replay.batch.flips import RunDiff
    from spatial_replay.batch.run_table import Difference
    from spatial_replay.compare.runs import LogDiff
    from spatial_replay.compare.specifications import SpecDiff, SpecificationDiff
    from spatial_replay.monitor.verdict import Semantics
    from spatial_replay.spec.formula import Specification


_MOST_CAUSES = 3
"""Maximum number of specs whose flipped verdict is traced to an edit."""


@click.command(cls=JsonCommand)
@click.argument("logs", metavar="LOG...", nargs=-1, required=True)
@condition_options
@click.option(
    "--align",
    metavar="time|progress[:NAME]|NAME",
    default="time",
    show_default=True,
    help="Alignment of two logs. time: the time since the first sample. progress:NAME: states of NAME's"
    " automaton. progress: states of the automaton with most common states. NAME: the first change of sign"
    " of NAME's robustness.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
@output_option("HTML page to write: both sides under one time cursor.")
@semantics_option
def diff(
    logs: tuple[str, ...],
    conditions: ConditionArguments,
    align: str,
    as_json: bool,
    output: Path | None,
    semantics: Semantics,
) -> int:
    """Compare two versions of a specification over one log or many, or two logs.

    With two specifications (--spec OLD --spec NEW), it shows the changed verdicts and numbers, the first
    different sample, and the edit that is the cause. With one --spec, OLD is the specification in the log.
    The edit is tested: OLD with only this edit, and NEW without this edit, are evaluated.

    Over several logs, a folder or a pattern, it lists flipped verdicts and lower robustness.

    With two logs and one specification, it shows the objects with different motions, the start of each
    difference, the effects on specs, and the planner's first different decision.

    Exits with 0 if nothing differs except names of specs, and otherwise with 1. Over several logs, it exits
    with 1 if a verdict flipped. If a log is damaged, it exits with 3.

    \b
    Examples:
      spatial-replay diff run.mcap --spec old.spatial --spec new.spatial
      spatial-replay diff 'nightly/**/*.mcap' --spec old.spatial --spec new.spatial
      spatial-replay diff before.mcap after.mcap --spec blocks.spatial -o diff.html
      spatial-replay diff before.mcap after.mcap --spec blocks.spatial --align progress
    """
    # imported here so that --help stays fast
    from spatial_replay.report.write import refuse_output

    if _are_many(logs, conditions.specs):
        why = "applies to one log; give one that flipped"
        refuse_values({"-o": output, "--align": "" if align == "time" else align}, why)
        return _over_logs(logs, conditions, as_json, semantics)
    if len(logs) > 2:
        raise UsageError(f"{len(logs)} logs; give two, or two specifications: --spec OLD --spec NEW")
    request = _for_log(conditions, logs[0])
    second_log = _log(logs[1]) if len(logs) > 1 else None
    if output is not None:
        refuse_output(output, _inputs(request, second_log))
    if second_log is None and align != "time":
        raise UsageError("--align applies to two logs; give the second one")
    if second_log is None:
        difference: SpecificationDiff | LogDiff = _of_specifications(request, output, semantics)
    else:
        difference = _of_logs(request, second_log, align, output, semantics)
    show_result(lambda: difference.document, difference.lines, as_json)
    if output is not None and not as_json:
        show(f"wrote {output}")
    warn(*difference.faults, *difference.doubts)
    show_diagnostics(difference.missing)
    code = ExitCode.SATISFIED if difference.is_empty else ExitCode.VIOLATED
    return most_severe([code, ExitCode.DAMAGED]) if difference.faults else code


def _log(text: str) -> LogFile:
    return log_file(text) if is_address(text) else Path(text)


def _for_log(conditions: ConditionArguments, log: str) -> EvaluationArguments:
    condition_values = {field.name: getattr(conditions, field.name) for field in fields(ConditionArguments)}
    return EvaluationArguments(**condition_values, log=_log(log))


def _are_many(logs: Sequence[str], specs: Sequence[LogFile]) -> bool:
    """Return whether two specifications are compared over several logs, a folder, or a pattern."""
    if len(specs) != 2:
        return False
    (log, *other_logs), path = logs, Path(logs[0])
    is_folder = (
        log.endswith("/") if is_address(log) else path.is_dir() and not (path / BAG_METADATA).is_file()
    )
    return bool(other_logs) or is_folder or (has_magic(log) and not path.exists())


def _over_logs(
    logs: Sequence[str], arguments: ConditionArguments, as_json: bool, semantics: Semantics
) -> ExitCode:
    """Show the verdicts that an edit flips over many logs."""
    from tempfile import TemporaryDirectory

    import pyarrow.compute as pc

    from spatial_replay.batch.flips import diff_runs
    from spatial_replay.batch.rows import parsed_specifications
    from spatial_replay.batch.run import prepare, run_batch, workers_of
    from spatial_replay.batch.suite import Conditions, Suite
    from spatial_replay.cli.batch import code_of_errors, explain_table_rows, warn_of_damage, warn_of_names

    condition_values = {name: getattr(arguments, name) for name in ("start", "end", "every", "strict_names")}
    objects = objects_by_parameter(arguments.choices)
    conditions = Conditions.from_tables(
        arguments.reading, objects, arguments.constants, semantics=semantics, **condition_values
    )
    cases = prepare(Suite.of_logs(logs, [sendable(spec) for spec in arguments.specs], conditions), progress)
    old, new = cases[0].files
    show_diagnostics({str(warning): warning for file in (old, new) for warning in file.warnings}.values())
    workers = workers_of(min(os.cpu_count() or 1, len(cases[0].logs)))
    with TemporaryDirectory() as folder:
        table = run_batch(cases, folder, workers, progress=progress).table
    old_rows, new_rows = (table.filter(pc.equal(table["file"], file.name)) for file in (old, new))
    flips = diff_runs(old_rows, new_rows, names=(old.name, new.name), explain=explain_table_rows)
    paths_by_log = {log.name: log.path for log in cases[0].logs}
    specifications = parsed_specifications((old.text, new.text), conditions)
    causes = list(_causes(flips, paths_by_log, arguments, specifications, semantics))
    if as_json:
        documents = [{"log": log, **spec.document} for log, _, spec in causes]
        show_json({"old": old.name, "new": new.name, **flips.document, "causes": documents})
    else:
        show(f"{old.name} → {new.name}", *flips.table(), *flips.lines("flipped"))
        for log, first_ns, spec in causes:
            sentence, *sentences = spec.sentences(first_ns)
            show(
                f"the edit, by {log}:", f"  {spec.title}: {sentence}", *(f"    {text}" for text in sentences)
            )
        show(*flips.lines("less", "gone", "new"))
    warn_of_names(table)
    warn_of_damage(table)
    code = ExitCode.VIOLATED if flips.flipped else ExitCode.SATISFIED
    return most_severe([code, code_of_errors(table)])


def _causes(
    flips: RunDiff,
    paths: Mapping[str, str],
    arguments: ConditionArguments,
    specifications: Sequence[Specification],
    semantics: Semantics,
) -> Iterator[tuple[str, int, SpecDiff]]:
    """Yield the first flipped result of each spec, for at most `_MOST_CAUSES` specs.

    Yields:
        The log, its first time in nanoseconds, and the difference of the result.

    Args:
        paths: paths of logs, by name.
        specifications: the old and the new specification.
    """
    from spatial_replay.compare.specifications import diff_over_source

    old, new = specifications
    first_flips: dict[str, Difference] = {}
    for change in flips.flipped:
        if None not in (change.difference.before, change.difference.now):
            first_flips.setdefault(change.difference.spec, change.difference)
    for result in list(first_flips.values())[:_MOST_CAUSES]:
        inputs = open_inputs(_for_log(arguments, paths[result.log]), known=specifications)
        difference = diff_over_source(inputs.source, old, new, inputs.options(semantics))
        for spec in difference.specs:
            if (spec.name, spec.new.object) == (result.spec, result.object):
                yield result.log, difference.first_ns, spec


def _of_specifications(
    request: EvaluationArguments, output: Path | None, semantics: Semantics
) -> SpecificationDiff:
    from spatial_replay.compare.specifications import diff_over_source
    from spatial_replay.replay.engine import recorded_texts
    from spatial_replay.report.write import write_comparison

    if len(request.specs) > 2:
        raise UsageError(f"{len(request.specs)} specifications; give two: --spec OLD --spec NEW")
    if not request.specs:
        raise UsageError("nothing to compare: give a second log, or --spec OLD --spec NEW")
    inputs = open_inputs(request)
    files = list(inputs.files)
    if len(request.specs) == 1:
        if not recorded_texts(inputs.source):
            raise UsageError(f"{inputs.source.name} holds no specification of its own; give --spec OLD, too")
        recorded_inputs = open_inputs(replace(request, specs=()))
        if len(recorded_inputs.files) != 1:
            filenames = ", ".join(file.filename for file in recorded_inputs.files)
            raise UsageError(f"{inputs.source.name} has several specifications: {filenames}; give OLD, too")
        files.insert(0, recorded_inputs.files[0])
    options = inputs.options(semantics)
    with progress("samples") as advance:
        difference = diff_over_source(inputs.source, files[0], files[-1], options, advance=advance)
        if output is not None:
            sides = (inputs.source, files[:1], options), (inputs.source, files[-1:], options)
            write_comparison(difference, sides, output, inputs=request.inputs, advance=advance)
    return difference


def _of_logs(
    request: EvaluationArguments, second_log: LogFile, align: str, output: Path | None, semantics: Semantics
) -> LogDiff:
    from spatial_replay.compare.runs import diff_sources
    from spatial_replay.report.write import write_comparison

    first_inputs = open_inputs(request, can_do_without=True)
    second_inputs = open_inputs(
        replace(request, log=second_log), known=first_inputs.files, can_do_without=True
    )
    sources, files = (first_inputs.source, second_inputs.source), first_inputs.files or second_inputs.files
    options = first_inputs.options(semantics), second_inputs.options(semantics)
    with progress("samples") as advance:
        difference = diff_sources(sources, files, options, align=align, advance=advance)
        if output is not None:
            sides = (sources[0], files, options[0]), (sources[1], files, options[1])
            write_comparison(difference, sides, output, inputs=_inputs(request, second_log), advance=advance)
    return difference


def _inputs(request: EvaluationArguments, second_log: LogFile | None) -> Sequence[Path]:
    return request.inputs if second_log is None else (*request.inputs, *local_files([second_log]))

"""`spatial-replay batch` and `results`: evaluate many logs, and show the results of a batch."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import click

from spatial_replay.batch.suite import DAMAGED, DOUBTFUL, DROPPED, UNTESTED, VACUOUS
from spatial_replay.cli.application import ExitCode, most_severe
from spatial_replay.cli.options import (
    ConditionArguments,
    add_options,
    allow_option,
    check_outputs,
    condition_options,
    fail_on_option,
    gather,
    naming_option,
    objects_by_parameter,
    plugin_option,
    refuse_options,
    refuse_values,
    semantics_option,
)
from spatial_replay.cli.output import VERDICT_COLOURS
from spatial_replay.cli.terminal import Coloured, progress, show, show_diagnostics, show_file, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import local_files, sendable
from spatial_replay.text import first_lines, json_value, plural, with_unit, without_numbers
from spatial_replay.trace.trace import time_point_from_text

if TYPE_CHECKING:
    import pyarrow as pa

    from spatial_replay.batch.run import BatchResult, PreparedCase
    from spatial_replay.batch.run_table import By, Difference, Tolerance, Total
    from spatial_replay.batch.suite import Conditions, Suite
    from spatial_replay.batch.workers import Workers
    from spatial_replay.monitor.verdict import Semantics


_COLOURS: Final = MappingProxyType(
    {
        **VERDICT_COLOURS,
        **dict.fromkeys(("untested", "doubtful", "edited"), "yellow"),
        **dict.fromkeys(("error", "errors", "failed", "worse", "gone"), "red"),
    }
)
_KIND_CODES: Final = {
    "usage": ExitCode.USAGE,
    "log": ExitCode.DAMAGED,
    "unfit": ExitCode.DAMAGED,
    "machine": ExitCode.INTERNAL,
}
_BATCH: Final = 10_000
"""Rows per batch of JSON lines."""


def print_totals(table: pa.Table, by: By) -> None:
    """Print the number of results with each verdict, by spec or by log.

    After a comparison with a baseline, the table also has the numbers of worse and missing results.
    """
    # imported here so that --help stays fast
    from spatial_replay.batch.run_table import EDITED_SINCE, counts_of, totals

    group_totals = totals(table, by)
    has_cases = len({total.group["case"] for total in group_totals}) > 1
    titles = [_title(total, by, has_cases) for total in group_totals]
    counts_by_heading = counts_of(group_totals)
    width = max([len(by), *map(len, titles)])
    show(f"  {by:<{width}}  {'  '.join(f'{heading:>9}' for heading in counts_by_heading)}  least robustness")
    for index, (title, total) in enumerate(zip(titles, group_totals, strict=True)):
        line: list[str | Coloured] = [f"  {title:<{width}}"]
        for name, counts in counts_by_heading.items():
            count = counts[index]
            # without failures, the violated and unknown results were expected, and get no colour
            colour = _COLOURS.get(name) if total.failures or name == "satisfied" else None
            cell = f"{count:>9,}" if count else f"{'-':>9}"
            line += ["  ", Coloured(cell, colour) if count and colour else cell]
        least_text = "not determined" if total.least is None else with_unit(total.least, total.unit or "")
        show((*line, f"  {least_text:>16}"))
        for text in filter(None, (total.title, EDITED_SINCE if total.is_edited else None)):
            show(f"    {text}")


def print_worst(table: pa.Table, count: int, *, failing: bool) -> None:
    """Print the worst rows with their reasons.

    Args:
        failing: whether only failing rows are printed.
    """
    from spatial_replay.batch.run_table import (
        damage_word,
        requirement_of,
        result_name,
        robustness_of,
        verdict_word,
        worst_rows,
    )

    for row in worst_rows(table, count):
        if failing and row["failure"] is None:
            return
        result = row["spec"] or row["file"]
        result = result_name(result, row["object"])
        verdict = Coloured(f"{verdict_word(row)}{damage_word(row)}", _COLOURS[verdict_word(row)])
        robustness = robustness_of(row)
        show((f"  {row['log']}: {result}: ", verdict, f", robustness {robustness}" if robustness else ""))
        usual_failure = f"{row['verdict']}, expected satisfied"
        failure = None if row["failure"] == usual_failure else row["failure"]
        for line in (requirement_of(row), failure, row["reason"]):
            if line:
                show(*(f"      {part}" for part in line.split("\n")))


def write_json_lines(
    table: pa.Table | Sequence[Mapping[str, Any]], file: str, inputs: Sequence[Path]
) -> None:
    """Write each row as one line of JSON to a file; "-" is standard output."""
    from spatial_replay.logs.output_file import replacing

    if isinstance(table, Sequence):
        batches: Iterable[Sequence[Mapping[str, Any]]] = [table]
    else:
        slice_starts = range(0, len(table), _BATCH)
        batches = (table.slice(start, _BATCH).to_pylist() for start in slice_starts)
    texts = (
        "".join(f"{json.dumps(json_value(row), ensure_ascii=False)}\n" for row in rows) for rows in batches
    )
    if file == "-":
        for text in texts:
            show_file(text)
        return
    with replacing(Path(file), inputs) as stream:
        for text in texts:
            stream.write(text.encode())


def exit_code_from_table(table: pa.Table, fail_on: frozenset[str]) -> ExitCode:
    """Return the exit code of a batch, with the meanings of a replay's codes.

    Expected results count as satisfied.
    """
    columns = ("failure", "error_kind", "verdict", "faults")
    codes = set()
    for failure, error_kind, verdict, faults in zip(
        *(table.column(n).to_pylist() for n in columns), strict=True
    ):
        if faults:
            codes.add(ExitCode.DAMAGED)
        if failure is None or (faults and failure.startswith(DAMAGED)):
            continue
        if error_kind is not None:
            codes.add(_KIND_CODES[error_kind])
        elif failure.startswith(VACUOUS) or (verdict == "unknown" and "unknown" in fail_on):
            codes.add(ExitCode.VIOLATED)
        elif failure.startswith(DOUBTFUL):
            codes.add(ExitCode.VIOLATED if "doubtful" in fail_on else ExitCode.UNKNOWN)
        elif verdict == "unknown" or failure.startswith((UNTESTED, DROPPED)):
            codes.add(ExitCode.UNKNOWN)
        else:
            codes.add(ExitCode.VIOLATED)
    return most_severe(codes)


def code_of_errors(table: pa.Table) -> ExitCode:
    """Return the exit code for damaged logs and errors."""
    error_rows = _columns(table, "faults", "error_kind")
    codes = [_KIND_CODES[kind] for _, kind in error_rows if kind is not None]
    return most_severe([*codes, *(ExitCode.DAMAGED for faults, _ in error_rows if faults)])


def _title(total: Total, by: By, with_case: bool) -> str:
    group = total.group
    title = group["log"] if by == "log" else group["spec"] or group["file"]
    if total.requirement:
        title = f"{title} [{total.requirement}]"
    return f"{group['case']}: {title}" if with_case else title


_WORST = 10
_MOST_WARNINGS = 5
_MOST_NAMED = 5
_MOST_DIFFERENCES = 20


@dataclass(frozen=True, slots=True)
class BatchOutputs:
    """Outputs of a batch, and the baseline of its comparison."""

    output: str | None
    junit: Path | None
    html: Path | None
    json_file: str | None
    baseline: str | None
    tolerance: str | None
    update_baseline: bool


_OUTPUTS = (
    click.option(
        "-o",
        "--output",
        metavar="RESULTS",
        help="Folder for results, or address of one.  [default: results, or SUITE.results]",
    ),
    click.option("--junit", metavar="FILE", type=click.Path(path_type=Path), help="JUnit report to write."),
    click.option(
        "--html",
        metavar="DIR",
        type=click.Path(path_type=Path),
        help="Folder for a page over all logs, and a report of each failing log.",
    ),
    click.option(
        "--json", "json_file", metavar="FILE|-", help="Results to write as JSON, one object a line."
    ),
    click.option(
        "--baseline",
        metavar="RESULTS",
        help="Earlier results; a result that is worse now, or missing, fails.",
    ),
    click.option(
        "--tolerance",
        metavar="T",
        help="With --baseline: tolerated loss of robustness: 0.02m, or '5%, at least 0.002m'.",
    ),
    click.option("--update-baseline", is_flag=True, help="Write this run's results to --baseline."),
)


@click.command()
@click.argument("logs", metavar="SUITE.yaml|LOG...", nargs=-1, required=True)
@condition_options
@plugin_option
@semantics_option
@lambda command: add_options(_OUTPUTS, gather("outputs", BatchOutputs, command))
@click.option(
    "--jobs", metavar="N", type=click.IntRange(min=1), help="Processes.  [default: one for each core]"
)
@click.option("--dask", metavar="ADDRESS", help="Scheduler of a Dask cluster that evaluates the logs.")
@fail_on_option
@allow_option
def batch(
    logs: tuple[str, ...],
    conditions: ConditionArguments,
    semantics: Semantics,
    outputs: BatchOutputs,
    jobs: int | None,
    dask: str | None,
    fail_on: frozenset[str],
    allow: frozenset[str],
) -> int:
    """Evaluate many logs (a suite file, or logs with specifications), and show the failures.

    LOG is a file, a folder, a pattern such as 'nightly/**/*.mcap', or an address. Results are stored in a
    folder, and a later run evaluates only missing results. An unreadable log has a row with its error.

    One exit code covers all logs, with the meanings of replay. The code is 0 if everything is as expected, 1
    if anything fails, 3 if logs are damaged or unfit, 4 if results are unknown, doubtful or tested by
    nothing.

    \b
    Examples:
      spatial-replay batch 'nightly/**/*.mcap' --spec safety.spatial -o results
      spatial-replay batch suite.yaml --junit report.xml --html pages
      spatial-replay batch suite.yaml --baseline main.results --tolerance 0.02m
      spatial-replay batch logs --spec safety.spatial --dask tcp://scheduler:8786
    """
    # imported here so that --help stays fast
    from spatial_replay.batch.explanations import explain_batch, failing_places
    from spatial_replay.batch.github import is_github, worst_annotations, write_summary
    from spatial_replay.batch.run import prepare, run_batch, workers_of
    from spatial_replay.batch.run_table import compare, with_baseline

    if dask is not None and jobs is not None:
        raise UsageError("--jobs applies to this machine, not to a cluster; remove --jobs or --dask")
    suite = _suite(logs, conditions, semantics).allowing(allow)
    cases = prepare(suite, progress)
    warnings = [warning for case in cases for file in case.files for warning in file.warnings]
    show_diagnostics({str(warning): warning for warning in warnings}.values())
    results_folder = outputs.output
    if results_folder is None:
        results_folder = "results" if suite.path is None else str(suite.folder / f"{suite.name}.results")
    tolerance, baseline_table = _baseline(outputs)
    check_outputs({"--junit": outputs.junit, "--json": outputs.json_file}, inputs_of(suite))
    workers = workers_of(jobs or os.cpu_count() or 1, dask, warn)
    with resumable(results_folder):
        evaluated = run_batch(cases, results_folder, workers, fail_on=fail_on, progress=progress)
        differences = None if baseline_table is None else compare(evaluated.table, baseline_table, tolerance)

        def with_comparison(evaluated: BatchResult) -> BatchResult:
            # results that are worse than the baseline fail in all outputs
            if baseline_table is None:
                return evaluated
            return replace(evaluated, table=with_baseline(evaluated.table, baseline_table, differences or ()))

        is_exported = any((outputs.junit, outputs.html, outputs.json_file, is_github()))
        failing_rows = failing_places(with_comparison(evaluated).table, None if is_exported else _WORST)
        # rows of gone results come last, and have no log to explain
        failing_rows = [place for place in failing_rows if place < len(evaluated.table)]
        # the stored table gets the explanations, but not the comparison
        evaluated = explain_batch(evaluated, failing_rows, workers, results=results_folder, progress=progress)
        compared_result = with_comparison(evaluated)
        _write_outputs(outputs, suite, evaluated, compared_result, workers)
        if outputs.json_file != "-":
            _print(compared_result, evaluated, results_folder)
        warn(*first_lines(evaluated.remarks, _MOST_WARNINGS))
        warn_of_names(evaluated.table)
        warn_of_damage(evaluated.table)
        if is_github():
            for line in worst_annotations(compared_result.table, suite.folder):
                show(line, err=True)
            write_summary(compared_result.table)
        exit_code = exit_code_from_table(evaluated.table, fail_on)
        if differences is not None and _print_differences(differences, outputs.json_file == "-"):
            exit_code = most_severe([exit_code, ExitCode.VIOLATED])
    return exit_code


@contextmanager
def resumable(folder: str) -> Iterator[None]:
    """Add a note to an interruption: the folder of the results so far."""
    try:
        yield
    except KeyboardInterrupt as error:
        error.add_note(f"the results so far are in {folder}; the same command continues from them")
        raise


def _write_outputs(
    outputs: BatchOutputs, suite: Suite, evaluated: BatchResult, result: BatchResult, workers: Workers
) -> None:
    """Write the requested files.

    Args:
        result: the evaluated batch, compared with a baseline if there is one.
    """
    from spatial_replay.batch.junit import write_junit
    from spatial_replay.batch.pages import write_pages
    from spatial_replay.batch.store import ResultsFolder

    inputs, pages = inputs_of(suite), {}
    if outputs.html is not None:
        pages = write_pages(result, outputs.html, suite.name, workers, progress=progress)
    if outputs.junit is not None:
        report_paths = {key: path.as_posix() for key, path in pages.items()}
        write_junit(outputs.junit, result.table, suite.name, report_paths, inputs=inputs)
    if outputs.update_baseline and outputs.baseline is not None:
        ResultsFolder.create(outputs.baseline).write_run(evaluated.table)
        show(f"wrote {outputs.baseline}", err=outputs.json_file == "-")
    if outputs.json_file is not None:
        write_json_lines(result.table, outputs.json_file, inputs)


def _suite(logs: tuple[str, ...], arguments: ConditionArguments, semantics: Semantics) -> Suite:
    """Return the suite of a suite file, or of logs with options.

    Raises:
        UsageError: a suite file has logs or options next to it, there is no specification, or the suite is
            invalid.
    """
    from spatial_replay.batch.suite import Conditions, load_suite

    # metadata.yaml belongs to a ROS 2 bag
    suites = [log for log in logs if log.endswith((".yaml", ".yml")) and Path(log).name != "metadata.yaml"]
    if not suites:
        return suite_of_logs(logs, arguments, semantics)
    if len(logs) > 1:
        raise UsageError(f"{suites[0]} is a suite, which names its logs; give it alone")
    if arguments.specs or _conditions(arguments, semantics) != Conditions():
        raise UsageError(
            f"{suites[0]} says how its logs are evaluated; change it there, or give logs and options"
        )
    return load_suite(suites[0])


def suite_of_logs(logs: tuple[str, ...], given: ConditionArguments, semantics: Semantics) -> Suite:
    """Return the suite of logs with options.

    Raises:
        UsageError: there is no specification, or a time is invalid.
    """
    from spatial_replay.batch.suite import Suite

    if not given.specs:
        raise UsageError("there is nothing to evaluate; give a specification with --spec FILE, or a suite")
    for option, text in (("--from", given.start), ("--to", given.end)):
        if text is not None:
            with naming_option(option):
                time_point_from_text(text)
    specs = dict.fromkeys(map(sendable, given.specs))
    return Suite.of_logs(logs, tuple(specs), _conditions(given, semantics))


def _conditions(options: ConditionArguments, semantics: Semantics) -> Conditions:
    from spatial_replay.batch.suite import Conditions

    fields = {name: getattr(options, name) for name in ("start", "end", "every", "strict_names")}
    objects = objects_by_parameter(options.choices)
    return Conditions.from_tables(options.reading, objects, options.constants, semantics=semantics, **fields)


def inputs_of(suite: Suite) -> list[Path]:
    """Return the input files of a suite without its logs. A suite may have very many logs."""
    mappings = [case.conditions.mapping for case in suite.cases if case.conditions.mapping is not None]
    specs = [spec for case in suite.cases for spec in case.specs]
    suites = [] if suite.path is None else [suite.path]
    return local_files([*suites, *dict.fromkeys([*specs, *mappings])])


def _baseline(outputs: BatchOutputs) -> tuple[Tolerance, pa.Table | None]:
    """Return the tolerance, and the table of the baseline if there is one."""
    from spatial_replay.batch.run_table import Tolerance
    from spatial_replay.batch.store import ResultsFolder, result_files

    if outputs.baseline is None:
        options = {"--update-baseline": outputs.update_baseline, "--tolerance": outputs.tolerance}
        refuse_values(options, "applies to a baseline; add --baseline RESULTS")
        return Tolerance(), None
    with naming_option("--tolerance"):
        tolerance = Tolerance.parse(outputs.tolerance or "0")
    if not result_files(outputs.baseline).exists():
        if outputs.update_baseline:
            return tolerance, None
        raise UsageError(
            f"--baseline {outputs.baseline}: no such folder, or an empty one; add --update-baseline once, "
            "which writes the results of this run there"
        )
    return tolerance, ResultsFolder.open(outputs.baseline).read_run()


def evaluated_batch(cases: Sequence[PreparedCase], folder: str, workers: Workers) -> BatchResult:
    """Evaluate the logs without stored rows. An interruption names the folder of the results so far."""
    from spatial_replay.batch.run import run_batch

    with resumable(folder):
        return run_batch(cases, folder, workers, progress=progress)


def _print(result: BatchResult, evaluated: BatchResult, folder: str) -> None:
    """Print the results of a run, compared with the baseline if there is one.

    Args:
        evaluated: the results without the comparison.
    """
    import pyarrow.compute as pc

    from spatial_replay.batch.run_table import WORSE, flaky_results, summary_text, totals

    reused = result.logs - result.evaluated
    counts = f"{result.evaluated:,} evaluated now, {reused:,} known" if reused else "all evaluated now"
    # gone logs count here as on the page and in the summary
    gone_count = len(set(result.table["log"].to_pylist()) - set(evaluated.table["log"].to_pylist()))
    counts = f"{counts}, {gone_count:,} gone" if gone_count else counts
    show(f"{plural(result.logs + gone_count, 'log')}, {summary_text(result.table)} ({counts})")
    print_totals(result.table, "spec")
    cut_count = pc.sum(pc.equal(result.table["tested"], "cut")).as_py()
    if cut_count:
        show(
            f"{plural(cut_count, 'result')} decided by a window that the end of the log cut: "
            "see --fail-on cut"
        )
    failure_count = len(result.failures)
    if failure_count:
        summary = f"{failure_count:,} failed"
        if WORSE in result.table.column_names:
            spec_totals = totals(result.table)
            summary += (
                f", {sum(spec.worse or 0 for spec in spec_totals):,} of them worse than the baseline, or gone"
            )
            if edited_count := sum(spec.worse_edited or 0 for spec in spec_totals):
                summary += f", {edited_count:,} of specs edited since"
        show(f"{summary}, the worst {_WORST}:" if failure_count > _WORST else f"{summary}:")
        print_worst(result.table, _WORST, failing=True)
    flaky_texts = [result.text for result in flaky_results(result.table)]
    show(*(f"  {line}" for line in first_lines(flaky_texts, _MOST_DIFFERENCES)))
    show(f"wrote {folder}")


def warn_of_names(table: pa.Table) -> None:
    """Warn of missing names, and show remarks on logs. Equal messages are reported once."""
    findings: dict[str, tuple[str, dict[str, None]]] = {}
    for column_name in ("missing", "remarks"):
        for log, messages in _columns(table, "log", column_name):
            for message in messages:
                text = message.removeprefix(f"{Path(log).name}: ")
                findings.setdefault(without_numbers(text), (text, {}))[1][log] = None
    messages_with_logs = [f"{text} (in {_join_names(list(logs))})" for text, logs in findings.values()]
    warn(*first_lines(messages_with_logs, _MOST_WARNINGS))


def warn_of_damage(table: pa.Table) -> None:
    """Warn of damaged, unreadable and unfit logs, which give the exit code 3."""
    log_rows = _columns(table, "log", "faults", "error_kind")
    for damage, kind in (("damaged, or not to be read", "log"), ("unfit to be judged", "unfit")):
        log_names = dict.fromkeys(
            log for log, faults, error_kind in log_rows if error_kind == kind or (faults and kind == "log")
        )
        if log_names:
            warn(f"{damage}: {_join_names(list(log_names))}")


def _join_names(names: Sequence[str]) -> str:
    """Return the first few names, and the number of further names."""
    other_text = [f"{len(names) - _MOST_NAMED:,} more"] if len(names) > _MOST_NAMED else []
    listed_names = [*names[:_MOST_NAMED], *other_text]
    return " and ".join(filter(None, [", ".join(listed_names[:-1]), listed_names[-1]]))


def _columns(table: pa.Table, *names: str) -> list[tuple[Any, ...]]:
    return list(zip(*(table.column(name).to_pylist() for name in names), strict=True))


def _print_differences(differences: Sequence[Difference], to_errors: bool) -> bool:
    """Print the differences from the baseline, and return whether any of them fails."""
    failing = [difference for difference in differences if difference.fails]
    worse = [difference for difference in failing if not difference.is_edited]
    edited = [difference for difference in failing if difference.is_edited]
    better_count = len(differences) - len(failing)
    summary = ["worse than the baseline, or gone" if worse else "nothing is worse than the baseline"]
    summary += [f"{better_count:,} better: --update-baseline keeps that"] if better_count else []
    show("; ".join(summary) + (":" if worse else ""), err=to_errors)
    for line in first_lines([difference.text for difference in worse], _MOST_DIFFERENCES):
        show(f"  {line}", err=to_errors)
    if edited:
        spec_names = _join_names(list(dict.fromkeys(f"{result.spec} ({result.file})" for result in edited)))
        show(f"worse, and the spec was edited since the baseline: {spec_names}:", err=to_errors)
        for line in first_lines([difference.text for difference in edited], _MOST_DIFFERENCES):
            show(f"  {line}", err=to_errors)
    return bool(failing)


@click.command()
@click.argument("folder", metavar="RESULTS")
@click.argument("other", metavar="[LATER]", required=False)
@click.option(
    "--worst", metavar="N", type=click.IntRange(min=0), default=10, help="Rows to show.  [default: 10]"
)
@click.option("--where", metavar="EXPR", help="Only rows that fit a condition on columns.")
@click.option(
    "--by",
    type=click.Choice(["spec", "log"]),
    default="spec",
    show_default=True,
    help="Grouping of the summary.",
)
@click.option("--json", "json_file", metavar="FILE|-", help="Rows to write, as JSON objects, one a line.")
@click.option(
    "--tolerance",
    metavar="T",
    help="With LATER: loss of robustness that is no change: 0.02m, or '5%, at least 0.002m'.",
)
@click.pass_context
def results(
    context: click.Context,
    folder: str,
    other: str | None,
    worst: int,
    where: str | None,
    by: By,
    json_file: str | None,
    tolerance: str | None,
) -> ExitCode:
    """Show the last run of a batch: totals, and the worst results with their reasons.

    With the results of a LATER run over the same logs, the command lists flipped verdicts and lower
    robustness, and exits with 1 if a verdict flipped.

    EXPR compares columns with texts and numbers: == != < <= > >=, "text" in COLUMN, and, or, not, none.

    \b
    Examples:
      spatial-replay results results --worst 3
      spatial-replay results results --by log --where 'verdict == "violated" and robustness < -0.1'
      spatial-replay results results --where '"door" in log' --json -
      spatial-replay results main.results branch.results --tolerance 0.02m
    """
    # imported here so that --help stays fast
    from spatial_replay.batch.explanations import worst_places
    from spatial_replay.batch.run_table import absent_values, rows_where, summary_text
    from spatial_replay.batch.store import ResultsFolder

    if other is not None:
        refuse_options(context, ("worst", "where", "by"), "applies to the results of one run")
        return _compare_results(folder, other, json_file, tolerance)
    refuse_values({"--tolerance": tolerance}, "applies to two runs; give the results of the later one, too")
    table = ResultsFolder.open(folder).read_run()
    if where is not None:
        matching_rows = rows_where(table, where)
        if not len(matching_rows):
            warn(*absent_values(table, where))
        table = matching_rows
    table = explain_table_rows(table, range(len(table)) if json_file else worst_places(table, worst))
    if json_file is not None:
        write_json_lines(table, json_file, ())
    if json_file == "-":
        return ExitCode.SATISFIED
    show(summary_text(table))
    if len(table):
        print_totals(table, by)
        if worst:
            show("the worst:")
            print_worst(table, worst, failing=False)
    return ExitCode.SATISFIED


_MOST_HERE = 64
"""Largest number of results that are explained without further processes."""


def explain_table_rows(table: pa.Table, places: Collection[int]) -> pa.Table:
    """Explain the rows `places` of a run's table from their logs, and return the table."""
    from spatial_replay.batch.explanations import explain_rows
    from spatial_replay.batch.run import workers_of

    workers = workers_of(1 if len(places) <= _MOST_HERE else os.cpu_count() or 1)
    table, remarks = explain_rows(table, places, workers, progress)
    warn(*first_lines(remarks, _MOST_WARNINGS))
    return table


def _compare_results(
    folder: str, later_folder: str, json_file: str | None, tolerance: str | None
) -> ExitCode:
    """Show the differences between two runs."""
    from spatial_replay.batch.flips import diff_runs
    from spatial_replay.batch.run_table import Tolerance
    from spatial_replay.batch.store import ResultsFolder

    with naming_option("--tolerance"):
        allowed_loss = Tolerance.parse(tolerance or "0")
    before, now = (ResultsFolder.open(place).read_run() for place in (folder, later_folder))
    flips = diff_runs(before, now, allowed_loss, (folder, later_folder), explain=explain_table_rows)
    if json_file is not None:
        write_json_lines([change.document for change in flips.changes], json_file, ())
    if json_file != "-":
        show(*flips.table(), *flips.lines("flipped", "less", "gone", "new"))
    return ExitCode.VIOLATED if flips.flipped else ExitCode.SATISFIED

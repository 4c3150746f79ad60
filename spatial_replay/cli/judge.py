"""`spatial-replay judge`: success rates of episodes by a specification, next to their labels."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.batch import (
    code_of_errors,
    evaluated_batch,
    inputs_of,
    suite_of_logs,
    warn_of_damage,
    warn_of_names,
    write_json_lines,
)
from spatial_replay.cli.options import (
    ConditionArguments,
    add_options,
    allow_option,
    check_outputs,
    condition_options,
    gather,
    plugin_option,
    semantics_option,
)
from spatial_replay.cli.terminal import progress, show, show_diagnostics, warn
from spatial_replay.errors import UsageError
from spatial_replay.monitor.verdict import Semantics
from spatial_replay.text import plural

if TYPE_CHECKING:
    from spatial_replay.annotate.stages import Stages
    from spatial_replay.batch.workers import Workers
    from spatial_replay.judging.judgement import Judgement


@dataclass(frozen=True, slots=True)
class JudgeOutputs:
    """Outputs: results, page, JSON, and verdicts as labels."""

    output: str | None
    html: Path | None
    json_file: str | None
    write_labels: Path | None
    annotate: Path | None

    @property
    def need_reasons(self) -> bool:
        """Whether the reasons of all violated episodes are written."""
        return any((self.html, self.json_file, self.write_labels, self.annotate))


_OUTPUTS = (
    click.option(
        "-o",
        "--output",
        metavar="RESULTS",
        help="Folder for results, or address of one.  [default: NAME.results]",
    ),
    click.option(
        "--html",
        metavar="DIR",
        type=click.Path(path_type=Path),
        help="Folder for a page over all episodes, and a report of each disagreement.",
    ),
    click.option("--json", "json_file", metavar="FILE|-", help="Judgement to write, as one JSON object."),
    click.option(
        "--write-labels",
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="Table of the verdicts as labels: .parquet or .csv.",
    ),
    click.option(
        "--annotate",
        metavar="NEW",
        type=click.Path(path_type=Path),
        help="Copy of a LeRobot data set with verdicts; --stages adds the stages.",
    ),
)


@click.command()
@click.argument("logs", metavar="LOG...", nargs=-1, required=True)
@condition_options
@click.option(
    "--labels",
    metavar="FILE|FIELD",
    help="Success labels: JSON, CSV, or a field of the data set.  [default: labels next to the logs]",
)
@click.option(
    "--result", metavar="NAME", help="Spec that judges.  [default: the last spec that no other spec uses]"
)
@plugin_option
@semantics_option
@lambda command: add_options(_OUTPUTS, gather("outputs", JudgeOutputs, command))
@click.option(
    "--against",
    metavar="LOG",
    multiple=True,
    help="Earlier episodes to compare with: a log, folder, pattern or data set.",
)
@click.option(
    "--same-start",
    metavar="DISTANCE",
    type=click.FloatRange(min=0.0),
    help="With --against: largest distance between an object's starts in a pair.  [default: 0.001]",
)
@click.option(
    "--failures",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Specification of failures, to name the first failure of each failed episode.",
)
@click.option("--stages", is_flag=True, help="Count the stages at the end of the episodes.")
@click.option(
    "--at-least",
    metavar="RATE",
    type=click.FloatRange(0.0, 1.0),
    help="Least success rate: exit with 1 if the lower end of the interval is below, such as 0.8.",
)
@click.option(
    "--jobs", metavar="N", type=click.IntRange(min=1), help="Processes.  [default: one for each core]"
)
@allow_option
def judge(
    logs: tuple[str, ...],
    conditions: ConditionArguments,
    labels: str | None,
    result: str | None,
    semantics: Semantics,
    outputs: JudgeOutputs,
    against: tuple[str, ...],
    same_start: float | None,
    failures: Path | None,
    stages: bool,
    at_least: float | None,
    jobs: int | None,
    allow: frozenset[str],
) -> int:
    """Judge episodes by a specification, and compare the verdicts with their success labels.

    LOG is an episode, a folder of them, or a pattern, as for batch. Labels come from labels.json or
    labels.csv next to the logs, or from the data set. An entry has `log` or `episode`, and `success`.

    The exit code is 0 for every rate. With --at-least, it is 1 if the rate is too low, and 4 if the answer
    depends on undecided episodes. It is also 4 if no episode can be judged.

    \b
    Examples:
      spatial-replay judge episodes/push --spec push.spatial
      spatial-replay judge runs --spec push.spatial --labels labels.csv --html pages
      spatial-replay judge runs --spec push.spatial --result placed --at-least 0.8
    """
    # imported here so that --help stays fast
    from spatial_replay.batch.run import workers_of
    from spatial_replay.judging.judgement import prepare_judgement
    from spatial_replay.judging.pairs import judge_batch
    from spatial_replay.judging.stages import episode_stages, with_stages

    if same_start is not None and not against:
        raise UsageError("--same-start applies to pairs; add --against LOG")
    if failures is not None and (not conditions.specs or failures in conditions.specs):
        raise UsageError("--failures has no spec that judges; give that with --spec")
    specs = conditions.specs if failures is None else (failures, *conditions.specs)
    suites = [
        suite_of_logs(episodes, replace(conditions, specs=specs), semantics).allowing(allow)
        for episodes in (logs, against)
        if episodes
    ]
    preparations = [
        prepare_judgement(suite, file, result, progress, has_failures=failures is not None)
        for suite, file in zip(suites, (labels, None), strict=False)
    ]
    cases = [preparation.case for preparation in preparations]
    warnings = [warning for file in cases[0].files for warning in file.warnings]
    show_diagnostics({str(warning): warning for warning in warnings}.values())
    inputs = [*inputs_of(suites[0]), *preparations[0].labels.files]
    data_set = _check_outputs(outputs, inputs, [log.path for log in cases[0].logs])
    folder = outputs.output or f"{preparations[0].name}.results"
    workers = workers_of(jobs or os.cpu_count() or 1)
    batch = evaluated_batch(cases, folder, workers)
    for preparation in preparations:
        batch = preparation.explain(
            batch, workers, allow, is_exported=outputs.need_reasons, progress=progress
        )
    judgement = judge_batch(preparations, batch, allow, same_start)
    stages_by_log = episode_stages(judgement, cases[0], progress) if stages else {}
    if stages:
        judgement = with_stages(judgement, stages_by_log)
    _write(judgement, outputs, inputs, workers, data_set, stages_by_log)
    if outputs.json_file != "-":
        written_files = [str(file) for file in (outputs.write_labels, outputs.annotate) if file is not None]
        _print(judgement, [folder, *written_files], conditions)
    warn(*judgement.remarks, *judgement.batch.remarks)
    warn_of_names(judgement.batch.table)
    warn_of_damage(judgement.batch.table)
    return _exit_code(judgement, at_least)


def _check_outputs(outputs: JudgeOutputs, inputs: Sequence[Path], logs: Sequence[str]) -> Path | None:
    """Refuse outputs that cannot be written. Return the data set to copy, if there is one."""
    from spatial_replay.judging.writers import check_annotation, ending_of_labels

    json_file = None if outputs.json_file == "-" else outputs.json_file
    check_outputs({"--json": json_file, "--write-labels": outputs.write_labels}, inputs)
    if outputs.write_labels is not None:
        ending_of_labels(outputs.write_labels)
    return None if outputs.annotate is None else check_annotation(logs, outputs.annotate)


def _write(
    judgement: Judgement,
    outputs: JudgeOutputs,
    inputs: Sequence[Path],
    workers: Workers,
    data_set: Path | None,
    stages_by_log: Mapping[str, Stages],
) -> None:
    from spatial_replay.batch.pages import write_pages
    from spatial_replay.judging.writers import annotate_data_set, labelled_batch, write_labels

    if outputs.write_labels is not None:
        write_labels(judgement, outputs.write_labels, inputs)
    if outputs.annotate is not None and data_set is not None:
        annotate_data_set(judgement, data_set, outputs.annotate, stages_by_log)
    if outputs.html is not None:
        write_pages(labelled_batch(judgement), outputs.html, judgement.name, workers, progress=progress)
    if outputs.json_file is not None:
        write_json_lines([judgement.document], outputs.json_file, inputs)


def _print(judgement: Judgement, written_files: Sequence[str], conditions: ConditionArguments) -> None:
    from spatial_replay.judging.pairs import comparison_lines
    from spatial_replay.judging.sentences import (
        difference_lines,
        failure_lines,
        stage_lines,
        summary_lines,
    )

    show(*summary_lines(judgement), *difference_lines(judgement), "")
    if judgement.failure_file:
        show(*failure_lines(judgement), "")
    if judgement.stages:
        show(*stage_lines(judgement), "")
    if judgement.comparison is not None:
        show(*comparison_lines(judgement.comparison), "")
    disagreements = [
        [row for row in judgement.rows if row.kind == kind] for kind in ("only_theirs", "only_ours")
    ]
    failed_rows = [row for row in judgement.rows if not row.is_success]
    example_row = [*disagreements[0], *disagreements[1], *failed_rows, *judgement.rows][0]
    spec_options = "".join(f" --spec {spec}" for spec in conditions.specs)
    mapping = conditions.reading.get("mapping")
    options_text = f"{spec_options} --mapping {mapping}" if mapping else spec_options
    show(f"wrote {', '.join(written_files)}; spatial-replay explain {example_row.log}{options_text}")


def _exit_code(judgement: Judgement, at_least: float | None) -> ExitCode:
    if not judgement.rate.episodes:
        error_code = code_of_errors(judgement.batch.table)
        return ExitCode.UNKNOWN if error_code is ExitCode.SATISFIED else error_code
    if at_least is None:
        return ExitCode.SATISFIED
    is_enough = judgement.reaches(at_least)
    if is_enough is None:
        open_count = judgement.agreement.undecided + judgement.agreement.unstored
        warn(f"--at-least {at_least:g} depends on {plural(open_count, 'undecided or unstored episode')}")
        return ExitCode.UNKNOWN
    return ExitCode.SATISFIED if is_enough else ExitCode.VIOLATED

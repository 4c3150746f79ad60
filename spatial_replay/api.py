"""Commands as functions: replay, report, diff, clip, tune, learn, batch, judge, verify, info."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike, fspath
from pathlib import Path
from reprlib import repr as shortened
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypeAlias, Unpack

from spatial_replay.compare.clips import Clip, cut_clip
from spatial_replay.compare.runs import LogDiff, diff_sources
from spatial_replay.compare.specifications import SpecificationDiff, diff_over_source
from spatial_replay.errors import UsageError
from spatial_replay.logs.read_options import Reading
from spatial_replay.logs.remote import LogFile, local_copy, local_files, log_file, sendable
from spatial_replay.logs.source import MemorySource, Source
from spatial_replay.logs.topics import MAPPED
from spatial_replay.monitor.verdict import ALLOWED_KINDS, FAILING_KINDS, Semantics, checked_kinds
from spatial_replay.replay.engine import Replayed, load_files, recorded_texts, run_replay
from spatial_replay.replay.selection import ReplayOptions, Window
from spatial_replay.replay.verification import Verified, verify_certificate
from spatial_replay.report.write import refuse_output, write_comparison
from spatial_replay.report.write import write_report as write_page
from spatial_replay.sources.open_log import open_source, read_trace
from spatial_replay.sources.overview import Overview, overview_of
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import load_specifications
from spatial_replay.spec.relations import DEFAULT_PROFILE
from spatial_replay.text import refuse_unknown
from spatial_replay.trace.trace import FOREVER, Trace
from spatial_replay.tuning.learned import DEFAULT_LINES, Learned, learn_runs
from spatial_replay.tuning.margins import load_runs
from spatial_replay.tuning.tuned import Tuning, tune_runs

if TYPE_CHECKING:
    import pyarrow as pa

    from spatial_replay.batch.run import BatchResult
    from spatial_replay.batch.suite import Conditions, Suite
    from spatial_replay.judging.judgement import Judgement

PathName: TypeAlias = str | PathLike[str]
Log: TypeAlias = PathName | Trace
Specifications: TypeAlias = Specification | PathName | Sequence[Specification | PathName]


class Evaluating(Reading, total=False):
    """Options of evaluating and reading a log, for `replay_log` and `write_report`.

    Attributes:
        constants: values of constants, instead of the values in files and in the log's own specifications.
        each: objects for each parameter of a template: "all", "class:NAME" or a name.
        semantics: "ltlf" (default), or "paper" for Def. 16 of the paper to the letter.
        start_ns, end_ns: window of evaluation, from `start_ns` to before `end_ns`.
        every: step between evaluated samples: 1 for all samples.
        strict_names: whether missing objects and signals are errors; otherwise they are unknown.
    """

    constants: Mapping[str, float | str] | None
    each: Mapping[str, str] | None
    semantics: Semantics
    start_ns: int
    end_ns: int
    every: int
    strict_names: bool


def replay_log(
    log: Log,
    specifications: Specifications | None = None,
    *,
    output: PathName | None = None,
    layer: bool = False,
    keep: Sequence[str] | None = None,
    arrow: str = "",
    **options: Unpack[Evaluating],
) -> Replayed:
    """Evaluate specifications over a log, and write an annotated log if `output` is given.

    Args:
        log: a file in any format, its address (s3://, gs://, az://, https://), or a trace.
        specifications: one or several, parsed or as files; None for the specifications in the log.
        output: path of the annotated log (MCAP).
        layer: whether only derived messages are written, without the log's own messages.
        keep: the log's own messages in the output: "all", "mapped" for mapped topics, or patterns of topics
            such as "/camera/*"; several are combined. The default is all messages, but none of a ROS 2 bag.
        arrow: title of the violated result for the arrow in the output's scene; "" for the first violated
            result.
        options: options of evaluation (`constants`, `each`, `semantics`, `start_ns`, `end_ns`, `every`,
            `strict_names`; see `Evaluating`) and of reading, as for `read_trace`.

    Raises:
        UsageError: an option is invalid, a file is missing, or the output is an input.
        SpecificationError: a specification has errors.
        LogError: the log cannot be read.
        OutputError: the output cannot be written.
    """
    if isinstance(keep, str):
        keep = (keep,)
    if keep is not None and (output is None or layer):
        raise UsageError("keep chooses the log's own messages in an annotated log; give output, and no layer")
    if keep is None and output is None:
        # without an output, only mapped messages are read
        keep = (MAPPED,)
    constants, settings = _evaluation(options)
    source = _source(log, options)
    return run_replay(
        source,
        _files(specifications, source, constants),
        replace(settings, keep=None if keep is None else tuple(keep), arrow=arrow),
        keep_series=True,
        keep_leaves=True,
        output=None if output is None else Path(output),
        inputs=_inputs(log, specifications, options),
        layer=layer,
    )


def write_report(
    log: Log,
    specifications: Specifications | None = None,
    *,
    output: PathName,
    **options: Unpack[Evaluating],
) -> Replayed:
    """Evaluate specifications over a log, and write a report as one HTML page.

    Args:
        output: path of the page; its name ends in .html.

    The other arguments and errors are the same as for `replay_log`.
    """
    constants, settings = _evaluation(options)
    inputs = _inputs(log, specifications, options)
    refuse_output(Path(output), inputs)
    source = _source(log, options)
    return write_page(
        source, _files(specifications, source, constants), Path(output), settings, inputs=inputs
    )


def diff_specifications(
    log: Log,
    old: Specification | PathName,
    new: Specification | PathName,
    *,
    output: PathName | None = None,
    **options: Unpack[Evaluating],
) -> SpecificationDiff:
    """Compare two versions of a specification over a log: changes, their times and their causes.

    The cause of a changed verdict is a set of edits. The old specification with only these edits has the new
    verdict, and the new specification without these edits has the old verdict.

    Args:
        log: a file in any format, or a trace.
        old, new: specifications, parsed or as files.
        output: path of a page with both sides under one time cursor; its name ends in .html.
        options: options of evaluation and reading, as for `replay_log`.

    Raises:
        UsageError: the versions have no common spec, an option is invalid, or the window has no sample.
        SpecificationError: a specification has errors.
        LogError: the log cannot be read.
    """
    constants, settings = _evaluation(options)
    source = _source(log, options)
    old_file, new_file = (_files(file, source, constants)[0] for file in (old, new))
    diff = diff_over_source(source, old_file, new_file, settings)
    if output is not None:
        sides = (source, [old_file], settings), (source, [new_file], settings)
        write_comparison(diff, sides, Path(output), inputs=_inputs(log, [old, new], options))
    return diff


def diff_logs(
    a: Log,
    b: Log,
    specifications: Specifications | None = None,
    *,
    align: str = "time",
    output: PathName | None = None,
    **options: Unpack[Evaluating],
) -> LogDiff:
    """Compare two runs: objects with different motions, and the effects on each spec and decision.

    Args:
        specifications: one or several, parsed or as files; None for the specifications in a log.
        align: "time" since the zero of each log, "progress" of an automaton, or the name of a spec. A spec
            aligns the runs at the first change of its robustness' sign.
        output: path of a page with both sides under one time cursor; its name ends in .html.
        options: options of evaluation and reading for both logs, as for `replay_log`.

    Raises:
        UsageError: the runs have no common object, different units, or no common event for `align`; or an
            option is invalid.
        SpecificationError: a specification has errors.
        LogError: a log cannot be read.
    """
    constants, settings = _evaluation(options)
    sources = _source(a, options), _source(b, options)
    sources_with_texts = [source for source in sources if recorded_texts(source)]
    files: list[Specification] = []
    if specifications is not None or sources_with_texts:
        files = _files(specifications, (sources_with_texts or [sources[0]])[0], constants)
    diff = diff_sources(sources, files, (settings, settings), align=align)
    if output is not None:
        sides = (sources[0], files, settings), (sources[1], files, settings)
        inputs = [path for log in (a, b) for path in _inputs(log, specifications, options)]
        write_comparison(diff, sides, Path(output), inputs=inputs)
    return diff


def clip_log(
    log: Log,
    specifications: Specifications | None = None,
    *,
    output: PathName,
    around_ns: int = 0,
    of: Sequence[str] = (),
    topics: Sequence[str] | None = None,
    **options: Unpack[Evaluating],
) -> Clip:
    """Write the smallest part of a log with the same verdicts, robustness and witnesses.

    Args:
        output: path of the clip (MCAP), an annotated log.
        around_ns: least time in the clip before and after the deciding samples.
        of: names of the specs whose verdicts are kept; empty for the violated specs, or all.
        topics: patterns of the clip's topics, such as "/camera/*"; None for all topics.

    The other arguments are the same as for `replay_log`.

    Raises:
        UsageError: a spec is missing, an option is invalid, or the output is an input.
        SpecificationError: a specification has errors.
        LogError: the log cannot be read.
        OutputError: the clip cannot be written.
    """
    constants, settings = _evaluation(options)
    source = _source(log, options)
    keep = None if topics is None else tuple([topics] if isinstance(topics, str) else topics)
    return cut_clip(
        source,
        _files(specifications, source, constants),
        Path(output),
        replace(settings, keep=keep),
        around_ns=around_ns,
        of=[of] if isinstance(of, str) else of,
        inputs=_inputs(log, specifications, options),
    )


def _evaluation(options: Evaluating) -> tuple[Mapping[str, float | str] | None, ReplayOptions]:
    """Remove the options of evaluation from `options`, and return the constants and the other options."""
    refuse_unknown(options, (*Evaluating.__annotations__, "specifications", "output"))
    window = Window(options.pop("start_ns", 0), options.pop("end_ns", FOREVER), options.pop("every", 1))
    objects, constants = options.pop("each", None), options.pop("constants", None)
    semantics, strict_names = options.pop("semantics", "ltlf"), options.pop("strict_names", False)
    return constants, ReplayOptions(window, dict(objects or {}), semantics, strict_names)


def tune(
    specification: Specification | PathName,
    good: Log | Sequence[Log],
    bad: Log | Sequence[Log] = (),
    *,
    vary: Mapping[str, tuple[float | str, float | str] | None] | None = None,
    constants: Mapping[str, float | str] | None = None,
    each: Mapping[str, str] | None = None,
    seed: int = 0,
    **reading: Unpack[Reading],
) -> Tuning:
    """Find constants for which all good runs satisfy a specification, and all bad runs violate it.

    With bad runs, the constants have the widest margin. The margin is the least of the good runs' robustness
    and the bad runs' negated robustness. With good runs only, the constants are the tightest constants that
    all runs satisfy.

    Args:
        specification: a specification, parsed or as a file.
        good, bad: logs in any format, or traces.
        vary: ranges by name: `{"near": (40, 100), "hold": ("1s", "4s")}`; the range None is the range in the
            text. Without `vary`, all constants with a range in the text are tuned.
        constants: values of other constants, instead of the values in the file.
        each: objects for each parameter of a template: "all", "class:NAME" or a name.
        seed: seed of the search over several constants. Equal seeds give equal values.
        reading: options of reading, as for `read_trace`.

    Raises:
        UsageError: there is no good run, a constant cannot be tuned, or a run does not fit the specification.
        SpecificationError: a specification has errors.
        LogError: a log cannot be read.
    """
    if isinstance(specification, Specification):
        if constants:
            raise UsageError("constants are for files; give parse_specification(text, constants=…) its own")
        file = specification
    else:
        (file,) = load_specifications([local_copy(specification)], constants=constants)
    refuse_unknown(reading, Reading.__annotations__)
    ranges = vary.values() if isinstance(vary, Mapping) else [vary]
    if any(
        bounds is not None and not (isinstance(bounds, tuple | list) and len(bounds) == 2)
        for bounds in ranges
    ):
        raise UsageError(f"vary is {shortened(vary)}; give ranges by name, as in {{'near': (40, 100)}}")
    runs = load_runs(_logs(good), _logs(bad), lambda path: read_trace(path, **reading))
    return tune_runs(file, runs, dict(vary or {}), each=each, seed=seed)


def learn(
    good: Log | Sequence[Log],
    bad: Log | Sequence[Log] = (),
    *,
    lines: int = DEFAULT_LINES,
    profile: str = DEFAULT_PROFILE,
    **reading: Unpack[Reading],
) -> Learned:
    """Find a short specification that all good runs satisfy. Each line is violated by at least one bad run.

    Without bad runs, the lines are common properties of the good runs: ends, invariants and orders of events.
    Limits have a margin to the good runs (see `docs/learning.md`).

    Args:
        good, bad: logs in any format, or traces; at least two good runs.
        lines: maximum number of specs. The most distinctive specs are written.
        profile: profile of the relations, "paper" or "spatial_spec".
        reading: options of reading, as for `read_trace`.

    Raises:
        UsageError: a run is too short, runs are equal or in different units, or the good runs are fewer than
            two or without a common property.
        LogError: a log cannot be read.
    """
    refuse_unknown(reading, Reading.__annotations__)
    runs = load_runs(_logs(good), _logs(bad), lambda path: read_trace(path, **reading))
    return learn_runs(runs, lines=lines, profile=profile)


def _logs(logs: Log | Sequence[Log]) -> list[LogFile | Trace]:
    paths = [logs] if isinstance(logs, Trace | str | PathLike) else list(logs)
    return [path if isinstance(path, Trace) else log_file(path) for path in paths]


def evaluate_logs(
    logs: PathName | Sequence[PathName],
    specifications: PathName | Sequence[PathName] | None = None,
    *,
    output: PathName,
    jobs: int = 1,
    dask: str | None = None,
    fail_on: Sequence[str] = (),
    allow: Sequence[str] = (),
    constants: Mapping[str, float | str] | None = None,
    each: Mapping[str, str] | None = None,
    semantics: Semantics = "ltlf",
    strict_names: bool = False,
    **reading: Unpack[Reading],
) -> BatchResult:
    """Evaluate many logs, and store their results. Results of an earlier batch are reused.

    Args:
        logs: a suite file (.yaml) with all other settings; or files, folders, addresses, and patterns such as
            "nightly/**/*.mcap".
        specifications: specification files or their addresses; None for a suite.
        output: folder of results, created if needed, or its address, such as "s3://bucket/results".
        jobs: number of processes. A program with more than 1 needs the guard `if __name__ == "__main__":`, as
            for every process pool.
        dask: address of a Dask scheduler, whose workers evaluate the logs.
        fail_on: "vacuous", "cut", "unknown", "left", "doubtful": further kinds of results that fail.
        allow: "vacuous", "dropped", "doubtful": kinds of results that pass although nothing tested them, the
            recorder dropped samples, or the log contradicts an assumption.
        constants, each, semantics, strict_names, reading: as for `replay_log`.

    Returns:
        `table`, a `pyarrow.Table` with one row for each log, spec and object of a template, and `failures`,
        the failing rows. The row of an unreadable log has an `error`. Passing rows have no explanation.

    Raises:
        UsageError: a pattern has no log, an option is invalid, or pyarrow is not installed.
        SpecificationError: specifications have errors.
        OutputError: results cannot be written; earlier results are stored.
        ClusterError: the scheduler is lost; the results so far are stored.
    """
    from spatial_replay.batch.explanations import explain_batch, failing_places
    from spatial_replay.batch.run import prepare, run_batch, workers_of
    from spatial_replay.batch.suite import Conditions, load_suite

    refuse_unknown(reading, Reading.__annotations__)
    failing_kinds = checked_kinds("fail_on", fail_on, FAILING_KINDS)
    allowed_kinds = checked_kinds("allow", allow, ALLOWED_KINDS)
    conditions = Conditions.from_tables(
        reading, each, constants, semantics=semantics, strict_names=strict_names
    )
    if specifications is None:
        suite_paths = _paths(logs)
        if len(suite_paths) != 1 or conditions != Conditions():
            raise UsageError("give specifications, or one suite file without other options")
        suite = load_suite(suite_paths[0])
    else:
        suite = _suite(logs, specifications, conditions)
    workers = workers_of(jobs, dask)
    result = run_batch(prepare(suite.allowing(allowed_kinds)), output, workers, fail_on=failing_kinds)
    return explain_batch(result, failing_places(result.table), workers, results=output)


def judge(
    logs: PathName | Sequence[PathName],
    specifications: PathName | Sequence[PathName],
    *,
    labels: PathName | None = None,
    result: str | None = None,
    against: PathName | Sequence[PathName] | None = None,
    same_start: float | None = None,
    failures: PathName | None = None,
    stages: bool = False,
    output: PathName | None = None,
    jobs: int = 1,
    allow: Sequence[str] = (),
    constants: Mapping[str, float | str] | None = None,
    each: Mapping[str, str] | None = None,
    semantics: Semantics = "ltlf",
    strict_names: bool = False,
    **reading: Unpack[Reading],
) -> Judgement:
    """Judge episodes by a specification, and compare the verdicts with their success labels.

    Args:
        logs: episodes: files, folders, patterns, data sets.
        labels: a JSON or CSV file, or a field of the data set. By default, labels are in labels.json or
            labels.csv next to the logs, or in the data set.
        result: name of the spec that judges; by default the last spec that no other spec uses.
        against: earlier episodes for a comparison.
        same_start: largest distance between an object's two first places in a pair; by default 0.001.
        failures: specification file whose specs describe failures. Each failed episode then has its first
            failure.
        stages: whether each row has the stage of the task in which its episode ends.
        output: folder of results; None stores no results.

    The other arguments and errors are the same as for `evaluate_logs`.

    Returns:
        `rows`, one row for each episode, `rate`, `label_rate`, `agreement`, `comparison`. `to_pandas()`
        returns the rows as a data frame.
    """
    from spatial_replay.batch.run import run_batch, workers_of
    from spatial_replay.batch.suite import Conditions
    from spatial_replay.judging.judgement import prepare_judgement
    from spatial_replay.judging.pairs import judge_batch
    from spatial_replay.judging.stages import episode_stages, with_stages

    refuse_unknown(reading, Reading.__annotations__)
    if same_start is not None and not against:
        raise UsageError("same_start is about pairs; give the earlier episodes: against=")
    allowed_kinds = checked_kinds("allow", allow, ALLOWED_KINDS)
    conditions = Conditions.from_tables(
        reading, each, constants, semantics=semantics, strict_names=strict_names
    )
    files = [specifications] if isinstance(specifications, str | PathLike) else list(specifications)
    specifications = files if failures is None else [failures, *files]
    suites = [_suite(episodes, specifications, conditions) for episodes in (logs, against) if episodes]
    label_files = (None if labels is None else fspath(labels), None)
    preparations = [
        prepare_judgement(suite.allowing(allowed_kinds), file, result, has_failures=failures is not None)
        for suite, file in zip(suites, label_files, strict=False)
    ]
    with TemporaryDirectory() as folder:
        cases = [preparation.case for preparation in preparations]
        workers = workers_of(jobs)
        batch = run_batch(cases, folder if output is None else output, workers)
        for preparation in preparations:
            batch = preparation.explain(batch, workers, allowed_kinds)
    judgement = judge_batch(preparations, batch, allowed_kinds, same_start)
    return with_stages(judgement, episode_stages(judgement, cases[0])) if stages else judgement


def _suite(
    logs: PathName | Sequence[PathName],
    specifications: PathName | Sequence[PathName],
    conditions: Conditions,
) -> Suite:
    from spatial_replay.batch.suite import Suite

    files = [specifications] if isinstance(specifications, str | PathLike) else specifications
    return Suite.of_logs(_paths(logs), [sendable(file) for file in files], conditions)


def _paths(logs: PathName | Sequence[PathName]) -> list[str]:
    paths = [logs] if isinstance(logs, str | PathLike) else list(logs)
    for log in paths:
        if not isinstance(log, str | PathLike):
            raise UsageError(f"logs holds {shortened(log)}; give paths; evaluate takes a trace")
    return [fspath(path) for path in paths]


def read_results(folder: PathName) -> pa.Table:
    """Return the table of the last run of a batch, a `pyarrow.Table`.

    Raises:
        UsageError: the folder is missing, has no results or results of another version, or pyarrow is not
            installed.
        LogError: the table is damaged.
    """
    from spatial_replay.batch.store import ResultsFolder

    return ResultsFolder.open(folder).read_run()


def verify(
    log: PathName, source: PathName | None = None, *, explain: bool = False, **reading: Unpack[Reading]
) -> Verified:
    """Recompute a log's certificate with the log's own specifications and options, and compare it.

    Args:
        source: log from which `log` was made. The source is evaluated instead of `log`.
        explain: whether `explanation` has the first differences. This takes another evaluation.
        reading: options of reading `source`, as for `read_trace`.

    Returns:
        Both certificates. `differences` is empty if the certificates are equal.

    Raises:
        UsageError, LogError, SpecificationError: the log cannot be evaluated.
    """
    refuse_unknown(reading, Reading.__annotations__)
    if source is None and reading:
        raise UsageError(f"{', '.join(reading)} applies to the source of the log; give source=…")
    original = None if source is None else open_source(source, **reading)
    return verify_certificate(open_source(log), original, explain=explain)


def info(log: PathName, **reading: Unpack[Reading]) -> Overview:
    """Read a log once, and return its contents: samples, objects, signals, topics, attachments.

    Args:
        reading: options of reading, as for `read_trace`.

    Raises:
        UsageError: the file is missing, or an external log has no mapping.
        LogError: the whole log is unreadable.
    """
    return overview_of(open_source(log, **reading))


def _source(log: Log, reading: Reading) -> Source:
    if not isinstance(log, Trace):
        return open_source(log, **reading)
    if reading:
        raise UsageError(f"{', '.join(reading)} says how to read a file, and the log is a trace already")
    return MemorySource(log)


def _specification_list(specifications: Specifications | None) -> list[Specification | PathName]:
    if specifications is None:
        return []
    if isinstance(specifications, Specification | str | PathLike):
        return [specifications]
    for specification in specifications:
        if not isinstance(specification, Specification | str | PathLike):
            raise UsageError(
                f"specifications has {shortened(specification)}; give specifications or their files"
            )
    return list(specifications)


def _files(
    specifications: Specifications | None, source: Source, constants: Mapping[str, float | str] | None
) -> list[Specification]:
    """Return the parsed specifications, in the order of the argument."""
    choices: list[Specification | Path] = []
    for specification in _specification_list(specifications):
        choice = specification if isinstance(specification, Specification) else local_copy(specification)
        # a repeated path counts once
        if isinstance(choice, Specification) or choice not in choices:
            choices.append(choice)
    paths = [choice for choice in choices if isinstance(choice, Path)]
    if constants and choices and not paths:
        raise UsageError("constants are for files; give parse_specification(text, constants=…) its own")
    loaded_files = load_files(paths, source, constants=constants) if paths or not choices else []
    if not choices:
        return loaded_files
    remaining_files = iter(loaded_files)
    return [choice if isinstance(choice, Specification) else next(remaining_files) for choice in choices]


def _inputs(log: Log, specifications: Specifications | None, reading: Reading) -> list[Path]:
    files = [
        specification
        for specification in _specification_list(specifications)
        if not isinstance(specification, Specification)
    ]
    mapping = reading.get("mapping")
    logs = [] if isinstance(log, Trace) else [log]
    return local_files([*logs, *files, *([] if mapping is None else [mapping])])

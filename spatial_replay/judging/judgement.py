"""Episodes judged by a specification: verdicts next to labels, and the rates of both."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import isfinite
from pathlib import Path, PurePosixPath
from statistics import fmean
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from spatial_replay.batch.explanations import explain_batch
from spatial_replay.batch.rows import parsed_specifications
from spatial_replay.batch.run import BatchResult, PreparedCase, prepare
from spatial_replay.batch.run_table import RUN, Values, worst_rows
from spatial_replay.batch.suite import Suite
from spatial_replay.batch.workers import Progress, Workers, no_progress
from spatial_replay.errors import UsageError
from spatial_replay.judging.labels import Labels, SuccessLabel, read_labels
from spatial_replay.judging.statistics import (
    SIGNIFICANCE,
    Rate,
    SignedRank,
    e_value,
    mcnemar_p,
    more_pairs,
    pass_hat_k,
    wilcoxon,
)
from spatial_replay.logs.formats.datasets import data_set_address
from spatial_replay.logs.formats.episodes import AS_STORED
from spatial_replay.logs.remote import is_address
from spatial_replay.mapping.mapping_file import load_mapping
from spatial_replay.sources.open_log import LOG_ENDINGS
from spatial_replay.spec.format import format_formula
from spatial_replay.text import json_value, listing, nearest_hint, printable, with_unit

if TYPE_CHECKING:
    import pandas
    import pyarrow as pa


Kind: TypeAlias = Literal[
    "both", "only_theirs", "only_ours", "neither", "unstored", "undecided", "unlabelled"
]
_AGREEMENTS: Final[Mapping[tuple[bool, bool], Kind]] = {
    (True, True): "both",
    (True, False): "only_theirs",
    (False, True): "only_ours",
    (False, False): "neither",
}
_MOST_RUNS: Final = 8
"""The greatest k of `pass_k`."""
_SMALL_M: Final = 0.1
"""Upper limit of lengths that are reported in millimetres, metres."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Numbers of episodes by label and verdict.

    Attributes:
        both, neither: episodes with a success by label and verdict, or with a failure by label and verdict.
        only_theirs, only_ours: episodes with a success only by the label, or only by the verdict.
        unstored: episodes whose label is a success in a state that is not stored, and whose verdict on the
            stored states is a failure.
        undecided: episodes whose verdict is unknown, untested, doubtful or an error.
        unlabelled: decided episodes without a label.
    """

    both: int = 0
    only_theirs: int = 0
    only_ours: int = 0
    neither: int = 0
    unstored: int = 0
    undecided: int = 0
    unlabelled: int = 0

    @property
    def compared(self) -> int:
        """Number of episodes whose label and verdict describe the same states."""
        return self.both + self.only_theirs + self.only_ours + self.neither


@dataclass(frozen=True, slots=True)
class JudgedEpisode:
    """A row of a judgement.

    Attributes:
        episode: name of the log without folder and ending, or its address in a data set: `push_v3#17`.
        label: whether the label is a success; None without a label.
        verdict: "satisfied", "violated", "unknown", or None for an error.
        kind: agreement of label and verdict, see `Agreement`.
        margin: robustness; None if not determined.
        success_at: time of the first success, seconds from the begin of the episode; None without a success.
        tested: see `SpecResult.tested`.
        reason: sentence with the reason of the verdict.
        task, seed: values in the data set, or None.
        log: path or address of the log.
        failure, failure_at: name and time (seconds) of a failed episode's first failure; None without a file
            of failures.
        stage, progress: stage and progress at the end, see `annotate.stages`; None unless requested.
    """

    episode: str
    label: bool | None
    verdict: str | None
    kind: Kind
    margin: float | None
    success_at: float | None
    tested: str | None
    reason: str
    task: str | None
    seed: int | None
    log: str
    failure: str | None = None
    failure_at: float | None = None
    stage: str | None = None
    progress: float | None = None

    @property
    def is_success(self) -> bool | None:
        """Whether the verdict is a success; None if it is undecided."""
        return None if self.kind == "undecided" else self.verdict == "satisfied"

    @property
    def stored_success(self) -> bool | None:
        """Whether the episode is a success; None for an undecided episode or an unstored success."""
        return None if self.kind == "unstored" else self.is_success


_COLUMNS: Final = ("episode", "label", "verdict", "margin", "success_at", "tested", "reason", "task", "seed")


@dataclass(frozen=True, eq=False)
class Judgement:
    """Episodes judged by one result of a specification.

    Attributes:
        name: name of the folder or data set.
        file, result, formula: specification file, name of the spec, and its text.
        rows: one row for each episode, in the order of the logs.
        batch: results of all specs.
        comparison: comparison with earlier episodes, or None.
        failure_file: name of the file of failures, or "".
        stages: names of the task's stages, the farthest from success first; empty unless requested.
        data_set_remarks: messages about data sets.
    """

    name: str
    file: str
    result: str
    formula: str
    rows: tuple[JudgedEpisode, ...]
    batch: BatchResult
    comparison: Comparison | None = None
    failure_file: str = ""
    stages: tuple[str, ...] = ()
    data_set_remarks: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns of `rows`."""
        failures = ("failure", "failure_at") if self.failure_file else ()
        return (*_COLUMNS, *failures, *(("stage", "progress") if self.stages else ()))

    @cached_property
    def failures(self) -> dict[str | None, tuple[JudgedEpisode, ...]]:
        """Failed episodes by the name of their first failure, the most frequent first.

        The key None has the failed episodes without a first failure.
        """
        failed_rows = [row for row in self.rows if row.is_success is False]
        failure_counts = Counter(row.failure for row in failed_rows)
        failure_names = sorted(failure_counts, key=lambda name: (name is None, -failure_counts[name]))
        return {name: tuple(row for row in failed_rows if row.failure == name) for name in failure_names}

    @cached_property
    def agreement(self) -> Agreement:
        """Numbers of episodes by label and verdict."""
        return Agreement(**Counter[str](row.kind for row in self.rows))

    @property
    def rate(self) -> Rate:
        """The success rate of decided episodes. Unstored successes do not count."""
        outcomes = [row.is_success for row in self.rows if row.is_success is not None]
        return Rate(sum(outcomes), len(outcomes))

    @property
    def rate_with_unstored(self) -> Rate:
        """The success rate if unstored successes count."""
        return Rate(self.rate.successes + self.agreement.unstored, self.rate.episodes)

    @property
    def label_rate(self) -> Rate:
        """The success rate of the labels."""
        labels = [row.label for row in self.rows if row.label is not None]
        return Rate(sum(labels), len(labels))

    def reaches(self, least: float) -> bool | None:
        """Return whether the lower end of the rate's interval is at least `least`.

        None if the answer depends on undecided episodes or unstored successes.
        """
        episode_count, open_count = len(self.rows), self.agreement.undecided + self.agreement.unstored
        intervals = [Rate(self.rate.successes + extra, episode_count).interval for extra in (0, open_count)]
        is_certain, is_possible = (interval is not None and interval.low >= least for interval in intervals)
        return is_certain if is_certain == is_possible else None

    @property
    def pass_k(self) -> dict[int, float]:
        """Mean probability that k runs of one start all succeed, by k from 2. Empty without repeated starts.

        Runs of one start have the same task and seed. Without seeds, their names differ only in the number of
        the run: `cross#2`.
        """
        outcomes_by_start = defaultdict[object, list[bool]](list)
        for row in self.rows:
            start_name = row.log if data_set_address(row.log) else RUN.sub("", row.log)
            is_repeated = row.seed is not None or start_name != row.log
            if row.is_success is not None and is_repeated:
                outcomes_by_start[start_name if row.seed is None else (row.task, row.seed)].append(
                    row.is_success
                )
        fewest_runs = min(map(len, outcomes_by_start.values()), default=0)
        return {
            k: fmean(pass_hat_k(sum(outcomes), len(outcomes), k) for outcomes in outcomes_by_start.values())
            for k in range(2, min(fewest_runs, _MOST_RUNS) + 1)
        }

    @property
    def remarks(self) -> tuple[str, ...]:
        """Messages about the data sets and the labels."""
        rate = self.label_rate
        if 1 < rate.episodes == rate.successes:
            remark = f"all {rate.episodes:,} labels are successes: the data set may leave failures out"
            return (*self.data_set_remarks, remark)
        return self.data_set_remarks

    @property
    def document(self) -> dict[str, Any]:
        """The judgement for JSON."""
        rates = {
            "": self.rate,
            "with_unstored_": self.rate_with_unstored,
            "label_": self.label_rate,
        }
        rate_values: dict[str, Any] = {}
        for name, rate in rates.items():
            rate_values[f"{name}rate"] = rate.value
            rate_values[f"{name}interval"] = None if rate.interval is None else list(rate.interval)
        rows = [
            {**{name: getattr(row, name) for name in self.columns}, "agreement": row.kind}
            for row in self.rows
        ]
        document = {"name": self.name, "episodes": len(self.rows), "decided": self.rate.episodes}
        document |= {"file": self.file, "result": self.result, "formula": self.formula}
        document |= {"agreement": asdict(self.agreement), **rate_values, "pass_k": self.pass_k}
        if self.comparison is not None:
            document["comparison"] = self.comparison.document
        if self.failure_file:
            document["failures"] = {name or "other": len(failed) for name, failed in self.failures.items()}
        if self.stages:
            stage_counts = Counter(row.stage for row in self.rows)
            document["stages"] = {name: stage_counts[name] for name in self.stages}
        document |= {"remarks": self.remarks, "rows": rows}
        return {name: json_value(value) for name, value in document.items()}

    @property
    def table(self) -> pa.Table:
        """The rows as a table, with the columns of `document`. Missing values are null."""
        import pyarrow as pa

        column_types = {"label": pa.bool_(), "seed": pa.int64()}
        column_types |= dict.fromkeys(("margin", "success_at", "failure_at", "progress"), pa.float64())
        schema = pa.schema([(name, column_types.get(name, pa.string())) for name in (*self.columns, "kind")])
        columns = [[getattr(row, name) for row in self.rows] for name in schema.names]
        return pa.table(columns, schema=schema).rename_columns([*self.columns, "agreement"])

    def to_pandas(self) -> pandas.DataFrame:
        """Return the rows as a data frame, see `table`."""
        return self.table.to_pandas()


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of new episodes with old episodes.

    Attributes:
        new: name of the new episodes.
        old: judgement of the old episodes.
        pairs: pairs of a new and an old decided episode with the same key and the same first places.
        elsewhere: number of pairs with the same key, but with other objects or first places.
        undecided: number of pairs with an undecided episode or an unstored success.
        alone: number of episodes without a partner.
    """

    new: str
    old: Judgement
    pairs: tuple[tuple[JudgedEpisode, JudgedEpisode], ...]
    elsewhere: int
    undecided: int
    alone: int

    @property
    def won(self) -> int:
        """Number of pairs in which only the new episode succeeds."""
        return sum(bool(new.is_success and not old.is_success) for new, old in self.pairs)

    @property
    def lost(self) -> int:
        """Number of pairs in which only the old episode succeeds."""
        return sum(bool(old.is_success and not new.is_success) for new, old in self.pairs)

    @property
    def p(self) -> float:
        """McNemar's exact p-value."""
        return mcnemar_p(self.won, self.lost)

    @property
    def evidence(self) -> float:
        """The e-value, see `e_value`. An e-value of 20 or more decides."""
        return e_value(self.won, self.lost)

    @property
    def more_pairs(self) -> int | None:
        """Estimated number of further pairs until a decision, see `statistics.more_pairs`."""
        return more_pairs(self.won, self.lost, len(self.pairs))

    @property
    def margins(self) -> SignedRank | None:
        """Wilcoxon's signed-rank test of the finite margins; None if no pair differs."""
        margins = [
            (new.margin, old.margin)
            for new, old in self.pairs
            if new.margin is not None and old.margin is not None and isfinite(new.margin - old.margin)
        ]
        return wilcoxon([new for new, _ in margins], [old for _, old in margins])

    @property
    def decision(self) -> str:
        """The word "better", "worse" or "undecided"."""
        if self.p > SIGNIFICANCE:
            return "undecided"
        return "better" if self.won > self.lost else "worse"

    @property
    def document(self) -> dict[str, Any]:
        """The comparison for JSON."""
        keys = ["decision", "won", "lost", "elsewhere", "undecided", "alone"]
        keys += ["p", "evidence", "more_pairs", "margins"]
        numbers = {name: getattr(self, name) for name in keys}
        return {
            "old": self.old.name,
            "pairs": len(self.pairs),
            "old_rate": self.old.rate.value,
            "old_with_unstored_rate": self.old.rate_with_unstored.value,
            **{name: json_value(value) for name, value in numbers.items()},
        }


class _Spec(NamedTuple):
    """The spec that judges."""

    file: str
    name: str
    formula: str


@dataclass(frozen=True, slots=True)
class PreparedJudgement:
    """Episodes with their labels, and the spec that judges them.

    Attributes:
        name: name of the folder or data set.
        case: the case for `run_batch`.
        spec: the spec that judges.
        labels: labels of the episodes.
        failure_file: name of the file of failures in `case.files`, or "".
    """

    name: str
    case: PreparedCase
    spec: _Spec
    labels: Labels
    failure_file: str = ""

    def judgement(self, batch: BatchResult, allow: AbstractSet[str] = frozenset()) -> Judgement:
        """Return the judgement of the episodes.

        Args:
            batch: results of a batch with the case.
            allow: kinds of inconclusive verdicts that count: "vacuous", "dropped" and "doubtful".
        """
        paths_by_name = {log.name: log.path for log in self.case.logs}
        batch = _part_of_batch(batch, set(paths_by_name))
        row_by_log: dict[str, Values] = {}
        for row in worst_rows(_rows_of(batch.table, self.spec), len(batch.table)):
            # rows are sorted: the first row of a template has the worst object
            row_by_log.setdefault(row["log"], row)
        episode_by_log = _episode_names(list(paths_by_name))
        rows = tuple(
            _judged_episode(
                episode_by_log[log],
                path,
                row_by_log[log],
                self.labels.by_path.get(path, SuccessLabel(None)),
                allow,
            )
            for log, path in paths_by_name.items()
        )
        if self.failure_file:
            failures_by_log = _first_failures(batch.table, self.failure_file)
            rows = tuple(
                _with_failure(row, failures_by_log.get(log))
                for row, log in zip(rows, paths_by_name, strict=True)
            )
        return Judgement(
            self.name,
            *self.spec,
            rows,
            batch,
            failure_file=self.failure_file,
            data_set_remarks=self.labels.remarks,
        )

    def explain(
        self,
        batch: BatchResult,
        workers: Workers,
        allow: AbstractSet[str] = frozenset(),
        *,
        is_exported: bool = True,
        progress: Progress = no_progress,
    ) -> BatchResult:
        """Return the batch with explanations of undecided episodes and of disagreements with labels.

        Args:
            is_exported: whether all other violated episodes are explained, too.
        """
        explained_kinds: set[Kind] = {"only_theirs", "only_ours", "undecided"}
        rows = self.judgement(batch, allow).rows
        log_paths = {
            row.log for row in rows if row.kind in explained_kinds or (is_exported and not row.is_success)
        }
        log_names = {log.name for log in self.case.logs if log.path in log_paths}
        row_keys = zip(
            *(batch.table.column(name).to_pylist() for name in ("log", "file", "spec")), strict=True
        )
        row_indices = [
            index
            for index, (log, file, spec) in enumerate(row_keys)
            if log in log_names and (file, spec) == (self.spec.file, self.spec.name)
        ]
        return explain_batch(batch, row_indices, workers, progress=progress)


def prepare_judgement(
    suite: Suite,
    labels: str | None = None,
    result: str | None = None,
    progress: Progress = no_progress,
    *,
    has_failures: bool = False,
) -> PreparedJudgement:
    """Find the episodes of a suite with one case, their labels, and the spec that judges them.

    Args:
        labels: see `read_labels`.
        result: name of the spec that judges; by default the last spec that no other spec uses.
        has_failures: whether the first file of the suite is a file of failures, see `_first_failures`.

    Raises:
        UsageError, SpecificationError: see `batch.run.prepare` and `read_labels`.
    """
    (case,) = prepare(suite, progress)
    mapping = case.case.conditions.mapping
    episode_reading = AS_STORED if mapping is None else load_mapping(mapping).episodes
    return PreparedJudgement(
        _name_of(case),
        case,
        _judging_spec(case, result, int(has_failures)),
        read_labels(case.logs, labels, episode_reading),
        case.files[0].name if has_failures else "",
    )


def _judging_spec(case: PreparedCase, result: str | None, first_index: int) -> _Spec:
    """Return the spec that judges. Files before the index `first_index` are not considered."""
    texts = tuple(file.text for file in case.files)
    files = parsed_specifications(texts, case.case.conditions)
    specs = [
        _Spec(spec_file.name, spec.name, printable(format_formula(spec.formula), 200))
        for spec_file, file in zip(case.files[first_index:], files[first_index:], strict=True)
        for spec in file.results
    ]
    if result is None:
        return specs[-1]
    matches = [spec for spec in specs if spec.name == result]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise UsageError(
            f"--result {result}: {listing([spec.file for spec in matches])} have it; give one --spec"
        )
    spec_names = [spec.name for spec in specs]
    hint = nearest_hint(result, spec_names) or f"results are {listing(spec_names)}"
    if any(result == spec.name for file in files[first_index:] for spec in file.specs):
        hint = f"other specs use it, so it has no result; add `spec judged = {result}`"
    raise UsageError(f"--result {result}: no result has this name; {hint}")


def _name_of(case: PreparedCase) -> str:
    """Return the name of the episodes' folder or data set, or "episodes"."""
    patterns = [pattern.text for pattern in case.case.logs]
    if len(patterns) == 1 and Path(patterns[0]).is_dir():
        return Path(patterns[0]).resolve().name or "episodes"
    folders = {log.path.rpartition("#")[0] or log.path.rpartition("/")[0] or "." for log in case.logs}
    folder = folders.pop() if len(folders) == 1 else ""
    folder_path = PurePosixPath(folder) if is_address(folder) or not folder else Path(folder).resolve()
    return folder_path.name or "episodes"


def _episode_names(logs: Sequence[str]) -> dict[str, str]:
    """Return the names of logs, by path, without a common folder and a common ending."""
    folders = {log.rpartition("/")[0] for log in logs}
    folder = f"{folders.pop()}/" if len(folders) == 1 else ""
    endings = {max((end for end in LOG_ENDINGS if log.endswith(end)), key=len, default="") for log in logs}
    ending = endings.pop() if len(endings) == 1 else ""
    return {log: log.removeprefix(folder).removesuffix(ending) for log in logs}


def _part_of_batch(batch: BatchResult, logs: AbstractSet[str]) -> BatchResult:
    """Return the part of a batch with the results of these logs."""
    import pyarrow as pa
    import pyarrow.compute as pc

    requests = tuple(request for request in batch.requests if request.log.name in logs)
    is_of_logs = pc.is_in(batch.table["log"], pa.array(sorted(logs), pa.string()))
    return replace(batch, table=batch.table.filter(is_of_logs), requests=requests)


def _rows_of(table: pa.Table, spec: _Spec) -> pa.Table:
    """Return the rows of a spec. The rows of an unparsable file have no name of a spec."""
    import pyarrow.compute as pc

    is_named = pc.or_(pc.equal(table["spec"], spec.name), pc.equal(table["spec"], ""))
    return table.select(list(_READ)).filter(pc.and_(pc.equal(table["file"], spec.file), is_named))


_READ: Final = (
    *("log", "file", "spec", "failure", "verdict", "unit", "robustness", "zero_ns", "reason"),
    *(
        "satisfied_at_ns",
        "first_satisfied_ns",
        "tested",
        "untested",
        "doubtful",
        "dropped",
        "faults",
        "error",
    ),
)
"""Columns of a run that a judgement reads. Columns of long texts are not among them."""


def _judged_episode(
    episode: str, path: str, row: Values, label: SuccessLabel, allow: AbstractSet[str]
) -> JudgedEpisode:
    reason = _undecided_reason(row, allow)
    is_satisfied, margin = row["verdict"] == "satisfied", row["robustness"]
    kind: Kind = "undecided" if reason else "unlabelled"
    if not reason and label.success is not None:
        kind = _AGREEMENTS[label.success, is_satisfied]
    if kind == "only_theirs" and label.is_unstored:
        kind, reason = "unstored", _unstored_reason(margin, row["unit"] or "")
    times_ns = [row[name] for name in ("satisfied_at_ns", "first_satisfied_ns") if row[name] is not None]
    return JudgedEpisode(
        episode,
        label.success,
        row["verdict"],
        kind,
        margin,
        success_at=(times_ns[0] - row["zero_ns"]) / 1e9 if times_ns and is_satisfied else None,
        tested=row["tested"],
        reason=reason or row["reason"] or "",
        task=label.task,
        seed=label.seed,
        log=path,
    )


def _with_failure(row: JudgedEpisode, failure: _Failure | None) -> JudgedEpisode:
    if failure is None or row.is_success is not False:
        return row
    return replace(row, failure=failure.name, failure_at=failure.at)


class _Failure(NamedTuple):
    """A failure of an episode.

    Attributes:
        name: title of the spec that describes the failure, or the spec's name without a title.
        at: time of the failure, seconds from the begin of the episode; None if the end of the log decides.
    """

    name: str
    at: float | None


def _first_failures(table: pa.Table, file: str) -> dict[str, _Failure]:
    """Return the first failure in each log of a batch's table, by the log's name.

    Failures that only the end of the log decides come last. At equal times, the first spec in the file wins.
    """
    import pyarrow.compute as pc

    is_failure = pc.and_(pc.equal(table["file"], file), pc.equal(table["verdict"], "satisfied"))
    columns = ["log", "spec", "title", "satisfied_at_ns", "zero_ns", "line"]
    rows = table.filter(is_failure).select(columns).to_pylist()
    rows.sort(key=lambda row: (row["satisfied_at_ns"] is None, row["satisfied_at_ns"] or 0, row["line"]))
    failures: dict[str, _Failure] = {}
    for row in rows:
        time_ns = row["satisfied_at_ns"]
        time_s = None if time_ns is None else (time_ns - row["zero_ns"]) / 1e9
        failures.setdefault(row["log"], _Failure(row["title"] or row["spec"], time_s))
    return failures


def _undecided_reason(row: Values, allow: AbstractSet[str]) -> str:
    """Return the reason why a verdict does not count; "" for a verdict that counts."""
    if row["verdict"] is None:
        return row["error"] or "no result"
    if row["faults"]:
        return f"the log is damaged: {row['faults'][0]}"
    if row["verdict"] == "unknown":
        return row["reason"] or "unknown"
    if row["tested"] == "nothing" and "vacuous" not in allow:
        return f"tested by nothing: {row['untested'][0]}"
    if row["doubtful"] and "doubtful" not in allow:
        return f"doubtful: {row['doubtful'][0]}"
    return row["dropped"] if row["dropped"] and "dropped" not in allow else ""


def _unstored_reason(margin: float | None, unit: str) -> str:
    sentence = "the label is about the state after the last frame, which is not in the data"
    if margin is None or margin == -float("inf"):
        return sentence
    is_small = unit == "m" and -margin < _SMALL_M
    missing_text = f"{-margin * 1000.0:.2g} mm" if is_small else with_unit(-margin, unit)
    return f"{sentence}; {missing_text} were missing"

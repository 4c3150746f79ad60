"""Totals of the table of a run, and its comparison with the table of an earlier run."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, cast

from spatial_replay.batch.suite import DOUBTFUL, UNTESTED
from spatial_replay.errors import UsageError
from spatial_replay.text import interval_text, listing, nearest_hint, plural, requirement_text, with_unit

if TYPE_CHECKING:
    import pyarrow as pa


By: TypeAlias = Literal["spec", "log"]
Values: TypeAlias = dict[str, Any]
"""A row of a table: values by column."""

VERDICTS: Final = ("satisfied", "violated", "unknown", "doubtful", "untested")
"""Verdicts, and the two words that replace the verdict of doubtful and of untested results."""
_WORDS: Final = MappingProxyType({"doubtful": DOUBTFUL, "untested": UNTESTED})
"""Beginnings of failures, by the word that replaces the verdict."""
WORSE: Final = "worse_than_baseline"
"""Column of a table with a baseline: whether the result is worse than in the baseline, or gone."""
EDITED: Final = "edited_since_baseline"
"""Column of a table with a baseline: whether the spec's meaning has changed since the baseline."""
_GROUPS: Final[Mapping[By, tuple[str, ...]]] = MappingProxyType(
    {"spec": ("case", "file", "spec"), "log": ("case", "log")}
)
RANKS: Final[Mapping[str | None, int]] = MappingProxyType(
    {"violated": 0, None: 1, "unknown": 2, "untested": 2, "satisfied": 3}
)
"""Ranks of verdicts, the worst first. None stands for an error or a gone result."""
_LONGEST_CONDITION: Final = 1_000
"""Length limit, characters: https://docs.python.org/3/library/ast.html#ast.parse may crash on long texts."""


@dataclass(frozen=True, slots=True)
class Total:
    """The results of one spec over its logs, or of one log under its specs.

    Attributes:
        group: common values of the results, by column.
        satisfied, violated, unknown, doubtful, untested: numbers of results, see `VERDICTS`.
        errors: number of results with an error instead of a verdict.
        failures: number of failing results.
        least: least robustness; None if no robustness is determined.
        worse: number of worse or gone results of unedited specs; None without a baseline.
        worse_edited: number of worse or gone results of edited specs; None without a baseline.
        is_edited: whether the spec was edited since the baseline.
        requirement, title, unit: values of the spec, or None. The totals of a log have None.
    """

    group: Values
    satisfied: int
    violated: int
    unknown: int
    doubtful: int
    untested: int
    errors: int
    failures: int
    least: float | None
    worse: int | None = None
    worse_edited: int | None = None
    is_edited: bool = False
    requirement: str | None = None
    title: str | None = None
    unit: str | None = None

    @property
    def about(self) -> str:
        """The requirement of the spec, see `requirement_text`."""
        return requirement_text(self.requirement, self.title)


def result_name(spec: str, object_name: str | None) -> str:
    """Return the name of a result: the spec, and the object of a template."""
    return spec if object_name is None else f"{spec}({object_name})"


def requirement_of(row: Values) -> str:
    """Return the requirement of a row, see `requirement_text`."""
    return requirement_text(row["requirement"], row["title"])


def robustness_of(row: Values) -> str:
    """Return the robustness of a row and its interval as text; "" for an error."""
    if row["verdict"] is None:
        return ""
    columns = "robustness", "lower", "upper"
    robustness, lower, upper = (math.nan if row[name] is None else row[name] for name in columns)
    return interval_text(robustness, lower, upper, row["unit"] or "")


def verdict_word(row: Values) -> str:
    """Return the verdict of a row, see `VERDICTS`. A row without a verdict has "error" or "gone"."""
    for word, beginning in _WORDS.items():
        if (row["failure"] or "").startswith(beginning):
            return word
    return row["verdict"] or ("gone" if row["error"] is None else "error")


def damage_word(row: Values) -> str:
    """Return the suffix for a verdict over a damaged log; "" for other logs."""
    return " (damaged log)" if row["faults"] and row["verdict"] else ""


def summary_text(table: pa.Table) -> str:
    """Return the numbers of results with each verdict, and the numbers of expected results, in one line."""
    passes, counts, damaged_count = Counter[str](), Counter[str](), 0
    columns = ("verdict", "error", "failure", "faults")
    for values in zip(*(table.column(name).to_pylist() for name in columns), strict=True):
        row = dict(zip(columns, values, strict=True))
        verdict = verdict_word(row)
        counts[verdict] += 1
        passes[verdict] += row["failure"] is None
        damaged_count += bool(damage_word(row))
    count_texts = [
        _count_text(f"{counts[name]:,} {name}", counts[name], passes[name])
        if name not in ("satisfied", *_WORDS)
        else f"{counts[name]:,} {_WORDS.get(name, name)}"
        + (f" ({failed:,} failed)" if name == "satisfied" and (failed := counts[name] - passes[name]) else "")
        for name in VERDICTS
        if counts[name]
    ]
    count_texts += [plural(counts["error"], "error")] if counts["error"] else []
    count_texts += [f"{counts['gone']:,} gone"] if counts["gone"] else []
    count_texts += [f"{damaged_count:,} of damaged logs"] if damaged_count else []
    return f"{plural(len(table), 'result')}: {', '.join(count_texts) or 'none'}"


def _count_text(text: str, total: int, passed: int) -> str:
    """Return a count of results with the number of passing results."""
    if not passed:
        return text
    return f"{text} as expected" if passed == total else f"{text} ({passed:,} as expected)"


def totals(table: pa.Table, by: By = "spec") -> list[Total]:
    """Return the totals of specs or logs, in the order of the table."""
    import pyarrow as pa
    import pyarrow.compute as pc

    verdicts, robustness = table.column("verdict"), table.column("robustness")
    columns = {name: table.column(name) for name in _GROUPS[by]}
    for word, beginning in _WORDS.items():
        has_word = pc.fill_null(pc.starts_with(table.column("failure"), beginning), False)
        verdicts = pc.if_else(has_word, word, verdicts)
    flags = {name: pc.equal(verdicts, name) for name in VERDICTS}
    flags |= {
        "errors": pc.is_valid(table.column("error")),
        "failures": pc.is_valid(table.column("failure")),
    }
    if WORSE in table.column_names:
        worse, edited = table.column(WORSE), table.column(EDITED)
        flags["worse"] = pc.and_not(worse, edited)
        flags["worse_edited"] = pc.and_(worse, edited)
        columns["edited"] = edited
    columns |= {f"n_{name}": pc.cast(pc.fill_null(flag, False), pa.int64()) for name, flag in flags.items()}
    columns["least"] = robustness
    aggregations = [(f"n_{name}", "sum") for name in flags]
    spec_columns = ("requirement", "title", "unit") if by == "spec" else ()
    columns |= {name: table.column(name) for name in spec_columns}
    # the first value belongs to the run, because rows of the baseline (gone results) come last
    aggregations += [(name, "first") for name in spec_columns]
    aggregations += [("edited", "max")] if "edited" in columns else []
    # with several threads, pyarrow's TableGroupBy does not keep the order of the rows
    groups = pa.table(columns).group_by(list(_GROUPS[by]), use_threads=False)
    return [
        Total(
            {name: row[name] for name in _GROUPS[by]},
            **{name: row[f"n_{name}_sum"] for name in flags},
            least=row["least_min"],
            is_edited=bool(row.get("edited_max")),
            **{name: row[f"{name}_first"] for name in spec_columns},
        )
        for row in groups.aggregate([*aggregations, ("least", "min")]).to_pylist()
    ]


@dataclass(frozen=True, slots=True)
class FlakyResult:
    """A result that passes in some runs of one log, and fails in others.

    Attributes:
        log: name of the log without the number of the run.
        failed: number of runs in which the result fails.
        runs: number of all runs.
    """

    case: str
    log: str
    file: str
    spec: str
    object: str | None
    failed: int
    runs: int

    @property
    def text(self) -> str:
        """The result with the numbers of failed runs and of all runs, in one line."""
        name = result_name(self.spec or self.file, self.object)
        return f"{self.log}: {name} is flaky: {self.failed:,} of {self.runs:,} runs failed"


RUN: Final = re.compile(r"#\d+(?=[./])")
"""The number of a run in the name of a log: "cross#2.mcap". A number at the end of a name is an episode."""


def flaky_results(table: pa.Table) -> list[FlakyResult]:
    """Return the flaky results of repeated runs. The logs' names differ only in a number after "#"."""
    failures_by_result: dict[Key, list[bool]] = defaultdict(list)
    for key, failure in zip(keys_of(table), table.column("failure").to_pylist(), strict=True):
        case, log, file, spec, object_name = key
        log_name = RUN.sub("", log)
        if log_name != log:
            failures_by_result[case, log_name, file, spec, object_name].append(failure is not None)
    return [
        FlakyResult(*key, sum(failed), len(failed))
        for key, failed in failures_by_result.items()
        if 0 < sum(failed) < len(failed)
    ]


def counts_of(rows: Sequence[Total]) -> dict[str, list[int]]:
    """Return the counts of all totals, by heading. Columns of rare words are left out if all counts are 0."""
    attributes = {**{name: name for name in VERDICTS}, "errors": "errors", "failed": "failures"}
    if any(row.worse is not None for row in rows):
        attributes |= {"worse": "worse", "edited": "worse_edited"}
    columns = {heading: [getattr(row, name) or 0 for row in rows] for heading, name in attributes.items()}
    return {
        heading: counts
        for heading, counts in columns.items()
        if heading not in (*_WORDS, "edited") or any(counts)
    }


def worst_rows(table: pa.Table, count: int) -> list[Values]:
    """Return the worst rows: failures first, then by verdict and robustness.

    Numbers in different units are not compared: the worst row of each unit comes first, then the second row
    of each unit.
    """
    import pyarrow.compute as pc

    units = pc.fill_null(table.column("unit"), "")
    ranked_rows: list[tuple[tuple[bool, int, int], Values]] = []
    for unit in units.unique():
        row_counts = Counter[tuple[bool, int]]()
        for row in _worst_of_unit(table.filter(pc.equal(units, unit)), count):
            rank = (row["failure"] is None, RANKS[row["verdict"]])
            ranked_rows.append(((*rank, row_counts[rank]), row))
            row_counts[rank] += 1
    return [row for _, row in sorted(ranked_rows, key=itemgetter(0))[:count]]


def _worst_of_unit(table: pa.Table, count: int) -> list[Values]:
    import pyarrow as pa
    import pyarrow.compute as pc

    verdicts = table.column("verdict")
    ranks = pc.index_in(verdicts, pa.array(list(RANKS), pa.string()))
    passes = pc.cast(pc.is_null(table.column("failure")), pa.int8())
    # rows of equal robustness keep their order
    sort_table = pa.table(
        {"passes": passes, "rank": ranks, "number": table.column("robustness"), "place": range(len(table))}
    )
    sort_columns = [(name, "ascending") for name in sort_table.column_names]
    worst_table = table.take(pc.sort_indices(sort_table, sort_keys=sort_columns).slice(0, count))
    return cast("list[Values]", worst_table.to_pylist())


def rows_where(table: pa.Table, condition: str) -> pa.Table:
    """Return the rows that fit a condition such as `verdict == "violated" and robustness < -0.1`.

    A condition compares columns with texts and numbers (`==`, `!=`, `<`, `<=`, `>`, `>=`) or searches for a
    text (`"door" in log`). `and`, `or`, `not` and parentheses join conditions. `none` is an absent value.

    Raises:
        UsageError: the text is no condition, or names a missing column.
    """
    import pyarrow as pa
    import pyarrow.dataset as ds

    if len(condition) > _LONGEST_CONDITION:
        raise UsageError(f"--where is longer than {_LONGEST_CONDITION:,} characters")
    try:
        syntax_tree = ast.parse(condition.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        if _SINGLE_EQUALS.search(condition):
            corrected = _SINGLE_EQUALS.sub("==", condition)[:200]
            raise UsageError(f"--where compares with ==; write {corrected!r}") from None
        raise UsageError(_no_condition(condition)) from None
    try:
        return table.filter(_Condition(table.column_names, condition, ds.field).of(syntax_tree))
    except pa.ArrowException as error:
        reason = str(error).splitlines()[0]
        raise UsageError(f"--where {condition!r} compares different kinds of values: {reason}") from None


_SINGLE_EQUALS: Final = re.compile(r"(?<![=!<>])=(?!=)")
_MOST_VALUES: Final = 5
"""Maximum number of a column's values in a message."""


def absent_values(table: pa.Table, condition: str) -> Iterator[str]:
    """Yield a sentence for each text in a condition that is not a value of its column.

    Args:
        condition: as for `rows_where`.
    """
    import pyarrow.compute as pc

    for node in ast.walk(ast.parse(condition.strip(), mode="eval")):
        match node:
            case ast.Compare(
                left=ast.Name(id=name), ops=[ast.Eq()], comparators=[ast.Constant(value=str(text))]
            ):
                pass
            case ast.Compare(left=ast.Name(id=name), ops=[ast.Eq()], comparators=[ast.Name(id=text)]) if (
                text != "none" and text not in table.column_names
            ):
                pass
            case _:
                continue
        values = pc.drop_null(pc.unique(table.column(name))).to_pylist()
        if text in values:
            continue
        if any(text in str(value) for value in values):
            remedy = f"write '\"{text}\" in {name}' for a part of it"
        else:
            remedy = nearest_hint(text, map(str, values)) or f"there are {listing(values, _MOST_VALUES)}"
        yield f"--where: no {name} is {text!r}; {remedy}"


_COMPARISONS: Final[Mapping[type[ast.cmpop], Callable[[Any, Any], Any]]] = MappingProxyType(
    {
        ast.Eq: operator.eq,
        ast.NotEq: operator.ne,
        ast.Lt: operator.lt,
        ast.LtE: operator.le,
        ast.Gt: operator.gt,
        ast.GtE: operator.ge,
    }
)


@dataclass(frozen=True, slots=True)
class _Condition:
    """Converts the syntax tree of a condition to an Arrow expression. Python executes no part of it."""

    names: list[str]
    text: str
    field: Callable[[str], Any]

    def of(self, node: ast.expr) -> Any:
        """Return the Arrow expression of a condition."""
        match node:
            case ast.BoolOp(op=op, values=[first_operand, *other_operands]):
                joined = self.of(first_operand)
                for operand in other_operands:
                    joined = (
                        joined & self.of(operand) if isinstance(op, ast.And) else joined | self.of(operand)
                    )
                return joined
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return ~self.of(operand)
            case ast.Compare(
                left=ast.Constant(value=str(substring)), ops=[ast.In()], comparators=[ast.Name() as name]
            ):
                import pyarrow.compute as pc

                return pc.match_substring(self._column(name), substring)
            case ast.Compare(left=ast.Name() as name, ops=[op], comparators=[value]) if (
                type(op) in _COMPARISONS
            ):
                return self._compare(self._column(name), op, self._value(value))
        raise UsageError(_no_condition(self.text))

    def _compare(self, column: Any, op: ast.cmpop, value: Any) -> Any:
        if value is None:
            if isinstance(op, ast.Eq | ast.NotEq):
                return column.is_null() if isinstance(op, ast.Eq) else ~column.is_null()
            raise UsageError(_no_condition(self.text))
        return _COMPARISONS[type(op)](column, value)

    def _column(self, name: ast.Name) -> Any:
        if name.id not in self.names:
            hint = nearest_hint(name.id, self.names) or f"columns are {', '.join(self.names)}"
            raise UsageError(f"--where: there is no column {name.id!r}; {hint}")
        return self.field(name.id)

    def _value(self, node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=str() | int() | float() as value):
                return value
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return -value
            case ast.Name(id="none"):
                return None
            case ast.Name(id=word) if word not in self.names:
                # a shell removes the quotes of `verdict == "violated"`
                return word
        raise UsageError(_no_condition(self.text))


def _no_condition(text: str) -> str:
    return (
        f"--where {text[:200]!r} is not a condition; compare columns, as in "
        "'verdict == \"violated\" and robustness < -0.1' or '\"door\" in log'"
    )


Key: TypeAlias = tuple[str, str, str, str, str | None]
"""Case, log, specification file, spec and object of a result."""
Change: TypeAlias = Literal["worse", "verdict", "gone", "better", "more", "new"]

WORSE_THAN: Final = "worse than the baseline"
"""Beginning of the failure of a worse result, if its spec was not edited."""
EDITED_SINCE: Final = "edited since the baseline"
"""Beginning of the failure of a worse result, if its spec was edited."""
BASELINE_VERDICT: Final = "baseline_verdict"
BASELINE_ROBUSTNESS: Final = "baseline_robustness"
_NUMBER: Final = r"((?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d{1,3})?)"
_UNIT: Final = r"([^\W\d]\S{0,20})?"
_TOLERANCE: Final = re.compile(rf"{_NUMBER} ?%(?:, *at least {_NUMBER} ?{_UNIT})?|{_NUMBER} ?{_UNIT}")
_KEY: Final = ("case", "log", "file", "spec", "object")
_ORDER: Final = {"satisfied": 0, "untested": 1, "unknown": 1, "violated": 2, None: 3}
"""Ranks of verdicts from good to bad; None is an error."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Accepted loss of robustness: a share or an amount, whichever is greater.

    Attributes:
        share: share of the baseline's robustness, from 0.
        amount: loss in units of robustness.
        unit: unit of the amount; "" for results without a unit.
    """

    share: float = 0.0
    amount: float = 0.0
    unit: str = ""

    @classmethod
    def parse(cls, text: str) -> Tolerance:
        """Read an amount such as `0.02m`, a share such as `5%`, or both: `5%, at least 0.002m`.

        Raises:
            UsageError: the text is no tolerance.
        """
        match = _TOLERANCE.fullmatch(text.strip())
        if match is None:
            raise UsageError(
                f"{text!r} is not a tolerance; write an amount in units of robustness, such as 0.02m, "
                "or '5%, at least 0.002m'"
            )
        percent, floor, floor_unit, amount, unit = match.groups()
        return cls(float(percent or 0.0) / 100.0, float(amount or floor or 0.0), unit or floor_unit or "")

    def check(self, units: Iterable[str | None]) -> None:
        """Check that some result has the unit of the amount.

        Raises:
            UsageError: the amount has no unit although results have units, or no result has its unit.
        """
        units_of_results = sorted({unit for unit in units if unit and unit != "1"})
        if not self.amount or self.unit in units_of_results or not (units_of_results or self.unit):
            return
        unit_text = f"is in {', '.join(units_of_results)}" if units_of_results else "has no unit"
        amount = f"{self.amount:g}{units_of_results[0] if units_of_results else ''}"
        remedy = (
            f"write at least {amount}"
            if self.share
            else f"write {amount}, or {self.amount:g}% for a part of it"
        )
        raise UsageError(f"--tolerance {self.amount:g}{self.unit}: robustness {unit_text}; {remedy}")

    def allows(self, before: float | None, now: float | None, unit: str = "") -> bool:
        """Return whether the loss of robustness since the baseline is within the tolerance.

        Args:
            unit: unit of both numbers. An amount in another unit allows no loss.
        """
        if before is None or now is None:
            return before is None
        if math.isinf(before) or math.isinf(now):
            return now >= before
        amount = self.amount if self.unit in ("", unit) else 0.0
        return now >= before - max(self.share * abs(before), amount)


@dataclass(frozen=True, slots=True)
class Difference:
    """One result that differs from the baseline.

    Attributes:
        change: "worse" or "more" for a change of robustness beyond the tolerance. "verdict" or "better" for a
            worse or better verdict. "gone" or "new" for a result of only one table.
        case, log, file, spec, object: key of the result.
        before, now: verdicts; None for an error or a missing result.
        before_robustness, robustness: robustness of the two results; None if not determined.
        is_edited: whether the spec was edited since the baseline.
    """

    change: Change
    case: str
    log: str
    file: str
    spec: str
    object: str | None
    before: str | None
    now: str | None
    before_robustness: float | None
    robustness: float | None
    is_edited: bool = False

    @property
    def fails(self) -> bool:
        return self.change in ("worse", "verdict", "gone")

    @property
    def key(self) -> Key:
        """The key of the result."""
        return self.case, self.log, self.file, self.spec, self.object

    @property
    def text(self) -> str:
        """The verdict and robustness of the run and of the baseline, in one line."""
        return f"{self.log}: {result_name(self.spec, self.object)} is {self.failure} in the baseline"

    @property
    def failure(self) -> str:
        """The verdict and robustness of the run and of the baseline, without the name of the result."""
        now = "gone" if self.change == "gone" else _describe_verdict(self.now, self.robustness)
        return f"{now}; it was {_describe_verdict(self.before, self.before_robustness)}"


def compare(
    table: pa.Table, baseline: pa.Table, tolerance: Tolerance, *, with_all: bool = False
) -> list[Difference]:
    """Return the differences between a run and a baseline, the worst first.

    Results are matched by case, log, specification file, spec and object.

    Args:
        with_all: whether new results and results with more robustness are included.

    Raises:
        UsageError: the tolerance lacks the unit of the results.
    """
    units = dict(zip(keys_of(table), table.column("unit").to_pylist(), strict=True))
    tolerance.check(units.values())
    edited_names = set(edited_specs(table, baseline))
    differences = [
        replace(difference, is_edited=(difference.case, difference.file, difference.spec) in edited_names)
        for difference in _differences(_by_key(table), _by_key(baseline), tolerance, units)
        if with_all or difference.change not in ("more", "new")
    ]
    return sorted(
        differences, key=lambda difference: (RANKS[difference.now], _least_first(difference.robustness))
    )


def edited_specs(table: pa.Table, baseline: pa.Table) -> list[tuple[str, str, str]]:
    """Return the case, file and name of each spec whose meaning has changed since the baseline."""

    def meanings(rows: pa.Table) -> dict[tuple[str, str, str], str | None]:
        columns, hashes = ("case", "file", "spec"), rows.column("meaning").to_pylist()
        keys = zip(*(rows.column(name).to_pylist() for name in columns), strict=True)
        return dict(zip(keys, hashes, strict=True))

    old_hashes = meanings(baseline)
    return [spec for spec, meaning in meanings(table).items() if old_hashes.get(spec, meaning) != meaning]


def with_baseline(table: pa.Table, baseline: pa.Table, differences: Sequence[Difference]) -> pa.Table:
    """Return the table of a run with a baseline: worse results fail, and gone results have rows.

    The columns `baseline_verdict` and `baseline_robustness` hold the earlier results. `worse_than_baseline`
    marks worse and gone results. `edited_since_baseline` marks specs whose meaning has changed.

    Args:
        differences: see `compare`.
    """
    import pyarrow as pa

    baseline_results, keys = _by_key(baseline), keys_of(table)
    worse_texts: dict[Key, list[str]] = defaultdict(list)
    edited_names = set(edited_specs(table, baseline))
    present_keys, gone_results = set(keys), []
    for difference in differences:
        if difference.change == "gone":
            gone_results.append(difference)
        elif difference.fails:
            # an error gives one row for all objects of a template
            key = difference.key if difference.key in present_keys else (*difference.key[:-1], None)
            beginning = EDITED_SINCE if difference.is_edited else WORSE_THAN
            worse_texts[key].append(f"{beginning}: {difference.failure}")
    failures = [
        "; ".join(filter(None, [failure, *worse_texts.get(key, ())])) or None
        for key, failure in zip(keys, table.column("failure").to_pylist(), strict=True)
    ]
    index = table.schema.get_field_index("failure")
    table = table.set_column(index, table.schema.field(index), pa.array(failures, pa.string()))
    earlier_results = [baseline_results.get(key, (None, None)) for key in keys]
    for column_name, column_type, values in (
        (BASELINE_VERDICT, pa.string(), [verdict for verdict, _ in earlier_results]),
        (BASELINE_ROBUSTNESS, pa.float64(), [number for _, number in earlier_results]),
        (WORSE, pa.bool_(), [key in worse_texts for key in keys]),
        (EDITED, pa.bool_(), [(case, file, spec) in edited_names for case, _, file, spec, _ in keys]),
    ):
        table = table.append_column(column_name, pa.array(values, column_type))
    indices = {key: index for index, key in enumerate(keys_of(baseline))} if gone_results else {}
    baseline_rows = baseline.take(
        pa.array([indices[result.key] for result in gone_results], pa.int64())
    ).to_pylist()
    gone_rows = [_gone_row(row, result) for row, result in zip(baseline_rows, gone_results, strict=True)]
    return pa.concat_tables([table, pa.Table.from_pylist(gone_rows, table.schema)])


_LISTS: Final = (
    "explanation",
    "untested",
    "vacuous",
    "left",
    "doubts",
    "doubtful",
    "faults",
    "remarks",
    "missing",
)
"""Columns with lists of texts."""


def _gone_row(row: dict[str, Any], difference: Difference) -> dict[str, Any]:
    """Return the row of a gone result, from its row in the baseline."""
    copied_columns = ("key", *_KEY, "meaning", "requirement", "title", "line", "expected")
    empty_lists: dict[str, Any] = {name: [] for name in _LISTS}
    return {
        **empty_lists,
        **{name: row.get(name) for name in copied_columns},
        "failure": f"{difference.failure} in the baseline",
        "reason": "",
        "seconds": 0.0,
        BASELINE_VERDICT: difference.before,
        BASELINE_ROBUSTNESS: difference.before_robustness,
        WORSE: True,
        EDITED: difference.is_edited,
    }


def keys_of(table: pa.Table) -> list[Key]:
    """Return the key of each row."""
    return list(zip(*(table.column(name).to_pylist() for name in _KEY), strict=True))


def _by_key(table: pa.Table) -> dict[Key, tuple[str | None, float | None]]:
    results = zip(table.column("verdict").to_pylist(), table.column("robustness").to_pylist(), strict=True)
    return dict(zip(keys_of(table), results, strict=True))


def _differences(
    current_results: dict[Key, tuple[str | None, float | None]],
    earlier_results: dict[Key, tuple[str | None, float | None]],
    tolerance: Tolerance,
    units: Mapping[Key, str | None],
) -> Iterator[Difference]:
    spec_keys = {key[:-1] for key in current_results}
    for key, (old_verdict, old_number) in earlier_results.items():
        # an error gives one row for all objects of a template
        current_result = current_results.get(key) or current_results.get((*key[:-1], None))
        if current_result is None and old_verdict is None and key[:-1] in spec_keys:
            # the baseline has one error row for all objects, which have results of their own now
            continue
        if current_result is None:
            yield Difference(
                "gone", *key, before=old_verdict, now=None, before_robustness=old_number, robustness=None
            )
            continue
        new_verdict, new_number = current_result
        change: Change | None = None
        if new_verdict != old_verdict:
            change = "verdict" if _ORDER[new_verdict] > _ORDER[old_verdict] else "better"
        elif not tolerance.allows(old_number, new_number, units.get(key) or ""):
            change = "worse"
        elif not tolerance.allows(new_number, old_number, units.get(key) or ""):
            change = "more"
        if change is not None:
            yield Difference(
                change,
                *key,
                before=old_verdict,
                now=new_verdict,
                before_robustness=old_number,
                robustness=new_number,
            )
    for key, (new_verdict, new_number) in current_results.items():
        # an error row for all objects of a template is no new result
        if key not in earlier_results and not (new_verdict is None and key[-1] is None):
            yield Difference(
                "new", *key, before=None, now=new_verdict, before_robustness=None, robustness=new_number
            )


def _least_first(number: float | None) -> float:
    return math.inf if number is None else number


def _describe_verdict(verdict: str | None, number: float | None) -> str:
    if verdict is None:
        return "an error"
    return f"{verdict} with robustness {'not determined' if number is None else f'{number:.6g}'}"


MOST_WORST: Final = 10
"""Maximum number of worst rows in a report."""
MOST_FLAKY: Final = 20
"""Maximum number of flaky results in a report."""


def total_cells(rows: Sequence[Total]) -> tuple[list[str], list[list[str]]]:
    """Return the headings of the number columns, and a row for each total.

    A row has the case, the spec, the requirement and the numbers.
    """
    counts_by_heading = counts_of(rows)
    cell_rows = []
    for index, total in enumerate(rows):
        spec = total.group["spec"] or total.group["file"]
        names = [total.group["case"], f"{spec} ({EDITED_SINCE})" if total.is_edited else spec, total.about]
        counts = [f"{numbers_of_totals[index]:,}" for numbers_of_totals in counts_by_heading.values()]
        cell_rows.append(
            [*names, *counts, "" if total.least is None else with_unit(total.least, total.unit or "")]
        )
    return [*counts_by_heading, "least robustness"], cell_rows

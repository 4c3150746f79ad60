"""Comparison of two batch runs over the same logs: flipped verdicts and lower robustness."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from spatial_replay.batch.run_table import Difference, Key, Tolerance, compare, keys_of, result_name
from spatial_replay.errors import UsageError
from spatial_replay.text import first_lines, json_fields, plural, with_unit

if TYPE_CHECKING:
    import pyarrow as pa

Kind: TypeAlias = Literal["flipped", "less", "more", "gone", "new"]
KINDS: Final[tuple[Kind, ...]] = ("flipped", "less", "more", "gone", "new")
_LISTED: Final[Mapping[Kind, int]] = MappingProxyType(
    {"flipped": 20, "less": 10, "more": 5, "gone": 5, "new": 5}
)
"""Maximum number of results in the text output, by kind of change. JSON has all results."""


@dataclass(frozen=True, slots=True)
class ResultChange:
    """One result that differs between two runs.

    Attributes:
        difference: verdicts and robustness of both runs; the verdict of an untested result is "untested".
        unit: unit of the robustness, or "".
        reason: sentence on the deciding atom of the worse verdict, or its error.
    """

    difference: Difference
    unit: str
    reason: str

    @property
    def kind(self) -> Kind:
        """The kind of change between the two runs."""
        change = self.difference.change
        if change in ("verdict", "better"):
            return "flipped"
        return "less" if change == "worse" else change  # type: ignore[return-value]

    @property
    def text(self) -> str:
        """The verdicts with their robustness. A gone or new result has the verdict of one run."""
        result = self.difference
        before_text, now_text = (
            "error" if verdict is None else f"{verdict} ({self._number(number)})"
            for verdict, number in (
                (result.before, result.before_robustness),
                (result.now, result.robustness),
            )
        )
        return {"gone": before_text, "new": now_text}.get(self.kind, f"{before_text} → {now_text}")

    @property
    def document(self) -> dict[str, Any]:
        """The change as values for JSON."""
        names = ("case", "log", "file", "spec", "object", "before", "now", "before_robustness", "robustness")
        return {
            "change": self.kind,
            **json_fields(self.difference, *names),
            "edited": self.difference.is_edited,
            **json_fields(self, "unit", "reason"),
        }

    def _number(self, number: float | None) -> str:
        return "not determined" if number is None else with_unit(number, self.unit)


@dataclass(frozen=True, eq=False)
class RunDiff:
    """Two runs side by side.

    Attributes:
        logs, results: numbers of logs and results in both runs together.
        changes: different results: first the flipped results, and within each kind the worst first.
        specs: number of results by case, file and spec.
    """

    logs: int
    results: int
    changes: tuple[ResultChange, ...]
    specs: Mapping[tuple[str, str, str], int]

    @property
    def flipped(self) -> tuple[ResultChange, ...]:
        """The results with another verdict."""
        return tuple(change for change in self.changes if change.kind == "flipped")

    def lines(self, *kinds: Kind) -> Iterator[str]:
        """Yield lines on the worst results of each requested kind, with reasons."""
        for kind in kinds:
            changes = [change for change in self.changes if change.kind == kind]
            if changes:
                yield f"{kind}:"
            for change in changes[: _LISTED[kind]]:
                difference = change.difference
                yield f"  {difference.log}: {result_name(difference.spec, difference.object)}: {change.text}"
                if change.reason and kind in ("flipped", "less"):
                    yield f"      {change.reason}"
            if len(changes) > _LISTED[kind]:
                yield f"  … and {len(changes) - _LISTED[kind]:,} more"

    def table(self) -> Iterator[str]:
        """Yield the lines of a table with each spec's numbers of changes."""
        yield f"{plural(self.logs, 'log')}, {plural(self.results, 'result')}"
        counts: dict[tuple[str, str, str], Counter[str]] = {spec: Counter() for spec in self.specs}
        edited_specs = set()
        for change in self.changes:
            spec = change.difference.case, change.difference.file, change.difference.spec
            counts[spec][change.kind] += 1
            edited_specs |= {spec} if change.difference.is_edited else set()
        cases = {case for case, _, _ in counts}
        titles = {
            spec: f"{spec[0]}: {spec[2] or spec[1]}" if len(cases) > 1 else spec[2] or spec[1]
            for spec in counts
        }
        always = ("flipped", "less")
        columns = [kind for kind in KINDS if kind in always or any(count[kind] for count in counts.values())]
        width = max([4, *map(len, titles.values())])
        yield f"  {'spec':<{width}}  {'  '.join(f'{heading:>7}' for heading in [*columns, 'same'])}"
        for spec, count in counts.items():
            spec_counts = [*(count[kind] for kind in columns), self.specs[spec] - count.total()]
            cells = "  ".join(f"{number or '-':>7}" for number in spec_counts)
            yield f"  {titles[spec]:<{width}}  {cells}{'  edited' if spec in edited_specs else ''}"

    @property
    def document(self) -> dict[str, Any]:
        """The comparison as values for JSON."""
        return {
            "logs": self.logs,
            "results": self.results,
            "flipped": len(self.flipped),
            "changes": [change.document for change in self.changes],
        }


def diff_runs(
    before: pa.Table,
    now: pa.Table,
    tolerance: Tolerance = Tolerance(),  # noqa: B008 - a frozen value
    names: tuple[str | PathLike[str], str | PathLike[str]] = ("the first", "the second"),
    *,
    explain: Callable[[pa.Table, list[int]], pa.Table] = lambda table, places: table,
) -> RunDiff:
    """Compare the tables of two runs, result by result.

    Results are matched by case, log, specification file, spec and object. If exactly one file of each run is
    missing in the other run, these two files are matched.

    Args:
        tolerance: accepted loss of robustness.
        names: names of the two runs, for errors.
        explain: function that explains rows of a table, given the table and the rows' indices.

    Raises:
        UsageError: the runs have no common result, or the tolerance lacks the unit of the results.
    """
    unexplained = before, now
    before, now = _replace_untested_verdicts(_match_file_name(before, now)), _replace_untested_verdicts(now)
    if not set(keys_of(before)) & set(keys_of(now)):
        examples = [f"{name} has {_example(table)}" for name, table in zip(names, (before, now), strict=True)]
        raise UsageError(f"no result is in both: {', and '.join(examples)}; give runs over the same logs")
    differences = compare(now, before, tolerance, with_all=True)
    changed_keys = {difference.key for difference in differences if difference.change not in ("new", "more")}
    before, now = (
        _with_reasons(
            table, explain(rows, [place for place, key in enumerate(keys_of(table)) if key in changed_keys])
        )
        for table, rows in zip((before, now), unexplained, strict=True)
    )
    rows = {key: row for table in (before, now) for key, row in _rows(table)}
    earlier_rows = dict(_rows(before))
    changes = []
    for difference in differences:
        row = rows.get(difference.key) or rows[*difference.key[:-1], None]
        is_fixed = difference.change == "better" and difference.key in earlier_rows
        reason = (earlier_rows[difference.key] if is_fixed else row)["reason"] or row["error"] or ""
        changes.append(
            ResultChange(difference, row["unit"] or "", f"before: {reason}" if is_fixed else reason)
        )
    # the sort is stable, so the worst stay first within each kind
    changes.sort(key=lambda change: KINDS.index(change.kind))
    result_counts = Counter((case, file, spec) for case, _, file, spec, _ in rows)
    return RunDiff(len({log for _, log, *_ in rows}), len(rows), tuple(changes), result_counts)


def _with_reasons(table: pa.Table, explained: pa.Table) -> pa.Table:
    """Return a table with the reasons in `explained`, a table with the same rows."""
    index = table.schema.get_field_index("reason")
    return table.set_column(index, table.schema.field(index), explained.column("reason"))


def _rows(table: pa.Table) -> Iterator[tuple[Key, dict[str, Any]]]:
    return zip(keys_of(table), table.select(["reason", "error", "unit"]).to_pylist(), strict=True)


def _example(table: pa.Table) -> str:
    results = [f"{log}: {result_name(spec or file, name)}" for _, log, file, spec, name in keys_of(table)]
    return first_lines(results, 1)[0] if results else "none"


def _match_file_name(table: pa.Table, other: pa.Table) -> pa.Table:
    """Rename the only file that is missing in `other` to the only file that is missing in `table`."""
    import pyarrow as pa

    files, other_files = (set(rows.column("file").to_pylist()) for rows in (table, other))
    if len(files - other_files) != 1 or len(other_files - files) != 1:
        return table
    (old_name,), (new_name,) = files - other_files, other_files - files
    file_names = [new_name if file == old_name else file for file in table.column("file").to_pylist()]
    column_index = table.schema.get_field_index("file")
    return table.set_column(column_index, table.schema.field(column_index), pa.array(file_names, pa.string()))


def _replace_untested_verdicts(table: pa.Table) -> pa.Table:
    """Return a table whose untested results have the verdict "untested"."""
    import pyarrow.compute as pc

    is_untested = pc.fill_null(pc.equal(table.column("tested"), "nothing"), False)
    verdicts = pc.if_else(is_untested, "untested", table.column("verdict"))
    column_index = table.schema.get_field_index("verdict")
    return table.set_column(column_index, table.schema.field(column_index), verdicts)

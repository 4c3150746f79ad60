"""Tables of batches as text and as JSON lines."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from spatial_replay.batch.suite import DAMAGED, DROPPED, UNTESTED
from spatial_replay.cli.application import ExitCode, most_severe
from spatial_replay.cli.output import VERDICT_COLOURS
from spatial_replay.cli.terminal import Coloured, show, show_file
from spatial_replay.text import json_number

if TYPE_CHECKING:
    import pyarrow as pa

    from spatial_replay.batch.run_table import By, Total

_COLOURS: Final = MappingProxyType(
    {
        **VERDICT_COLOURS,
        "untested": "yellow",
        **dict.fromkeys(("error", "errors", "failed", "worse", "gone"), "red"),
    }
)
_KIND_CODES: Final = {"usage": ExitCode.USAGE, "log": ExitCode.DAMAGED, "machine": ExitCode.INTERNAL}
_BATCH: Final = 10_000
"""Rows that are turned into JSON at once."""


def print_totals(table: pa.Table, by: By) -> None:
    """Print how many results there are of each verdict, for each spec or for each log.

    Of a table that was compared with a baseline, also how many are worse than there, or gone.
    """
    # imported here so that --help stays fast
    from spatial_replay.batch.run_table import WORSE, counts_of, totals

    rows = totals(table, by)
    titles = [_title(each, by, len({each.group["case"] for each in rows}) > 1) for each in rows]
    columns = counts_of(rows)
    if WORSE in table.column_names:
        columns["worse"] = [each.worse or 0 for each in rows]
    width = max([len(by), *map(len, titles)])
    show(f"  {by:<{width}}  {'  '.join(f'{head:>9}' for head in columns)}  least robustness")
    for place, (title, each) in enumerate(zip(titles, rows, strict=True)):
        line: list[str | Coloured] = [f"  {title:<{width}}"]
        for name, counts in columns.items():
            count = counts[place]
            # of verdicts that all were expected, none is bad
            colour = _COLOURS.get(name) if each.failures or name == "satisfied" else None
            shown = f"{count:>9,}" if count else f"{'-':>9}"
            line += ["  ", Coloured(shown, colour) if count and colour else shown]
        least = "not determined" if each.least is None else f"{each.least:.6g}"
        show((*line, f"  {least:>16}"))
        if each.title:
            show(f"    {each.title}")


def print_worst(table: pa.Table, count: int, *, failing: bool) -> None:
    """Print the worst rows, each with the sentence that explains it.

    Args:
        failing: only those that fail.
    """
    from spatial_replay.batch.run_table import (
        damage_word,
        requirement_of,
        result_name,
        verdict_word,
        worst_rows,
    )

    for row in worst_rows(table, count):
        if failing and row["failure"] is None:
            return
        name = row["spec"] or row["file"]
        name = result_name(name, row["object"])
        verdict = Coloured(f"{verdict_word(row)}{damage_word(row)}", _COLOURS[verdict_word(row)])
        number = "" if math.isnan(row["robustness"]) else f", robustness {row['robustness']:.6g}"
        show((f"  {row['log']}: {name}: ", verdict, number))
        usual = f"{row['verdict']}, expected satisfied"
        failure = None if row["failure"] == usual else row["failure"]
        for line in (requirement_of(row), failure, row["reason"]):
            if line:
                show(*(f"      {each}" for each in line.split("\n")))


def write_json_lines(table: pa.Table, file: str, inputs: Sequence[Path]) -> None:
    """Write each row as a JSON object on a line, to a file, or to standard output for "-"."""
    from spatial_replay.logs.output_file import replacing

    def lines(rows: pa.Table) -> str:
        return "".join(f"{json.dumps(_json_row(row), ensure_ascii=False)}\n" for row in rows.to_pylist())

    batches = (table.slice(begin, _BATCH) for begin in range(0, len(table), _BATCH))
    if file == "-":
        for rows in batches:
            show_file(lines(rows))
        return
    with replacing(Path(file), inputs) as stream:
        for rows in batches:
            stream.write(lines(rows).encode())


def exit_code_from_table(table: pa.Table, fail_on: frozenset[str]) -> ExitCode:
    """Return the exit code of a run: that of a replay of all its logs, but for what was expected."""
    names = ("failure", "error_kind", "verdict", "faults")
    codes = set()
    for failure, kind, verdict, faults in zip(*(table.column(n).to_pylist() for n in names), strict=True):
        if faults:
            codes.add(ExitCode.DAMAGED)
        if failure is None or (faults and failure.startswith(DAMAGED)):
            continue
        if kind is not None:
            codes.add(_KIND_CODES[kind])
        elif (verdict == "unknown" and "unknown" not in fail_on) or failure.startswith((UNTESTED, DROPPED)):
            codes.add(ExitCode.UNKNOWN)
        else:
            codes.add(ExitCode.VIOLATED)
    return most_severe(codes)


def _title(total: Total, by: By, with_case: bool) -> str:
    group = total.group
    title = group["log"] if by == "log" else group["spec"] or group["file"]
    if total.requirement:
        title = f"{title} [{total.requirement}]"
    return f"{group['case']}: {title}" if with_case else title


def _json_row(row: dict[str, Any]) -> dict[str, Any]:
    return {name: json_number(value) if isinstance(value, float) else value for name, value in row.items()}

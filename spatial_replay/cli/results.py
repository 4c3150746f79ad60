"""`spatial-replay results`: what a batch found."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from spatial_replay.cli.batch import print_totals, print_worst, write_json_lines
from spatial_replay.cli.terminal import show

if TYPE_CHECKING:
    from spatial_replay.batch.run_table import By


@click.command()
@click.argument("folder", metavar="RESULTS")
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
def results(folder: str, worst: int, where: str | None, by: By, json_file: str | None) -> None:
    """Show what the last run of a batch found: totals, and the worst results with their reasons.

    EXPR compares columns with texts and numbers: == != < <= > >=, "text" in COLUMN, and, or, not, none.

    \b
    Examples:
      spatial-replay results results --worst 3
      spatial-replay results results --by log --where 'verdict == "violated" and robustness < -0.1'
      spatial-replay results results --where '"door" in log' --json -
    """
    # imported here so that --help stays fast
    from spatial_replay.batch.run_table import rows_where, summary_text
    from spatial_replay.batch.store import ResultsFolder

    table = ResultsFolder.open(folder).read_run()
    if where is not None:
        table = rows_where(table, where)
    if json_file is not None:
        write_json_lines(table, json_file, ())
    if json_file == "-":
        return
    show(summary_text(table))
    if len(table):
        print_totals(table, by)
        if worst:
            show("the worst:")
            print_worst(table, worst, failing=False)

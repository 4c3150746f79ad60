"""The numbers of an annotated log as a table: a row for each sample, a column for each node."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from spatial_replay.annotate.robustness import RobustnessSeries, decode_robustness
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.mcap.reader import McapSource
from spatial_replay.logs.output_file import replacing
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import ROBUSTNESS

Quantity: TypeAlias = Literal["value", "now", "lower", "upper"]
TIME = "time_ns"
"""The title of the column of times."""
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)

_Result: TypeAlias = tuple[str, str | None]
"""Name and object of a result."""


@dataclass(frozen=True, eq=False)
class TableRows:
    """Consecutive rows of a table.

    Attributes:
        times_ns: (T,) int64.
        numbers: (T, columns); NaN where a node has no number, or no sample.
    """

    times_ns: Integers
    numbers: Floats


def export_table(
    source: Source,
    output: Path,
    *,
    quantity: Quantity = "value",
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda rows: None,
) -> tuple[int, int, tuple[str, ...]]:
    """Write the robustness in an annotated log as CSV or Parquet, by the output's ending.

    Returns:
        The numbers of rows and columns, and what was lost while reading, each with its place.

    Raises:
        UsageError: another ending, Parquet without its library, or a log without robustness.
        LogError: a damaged log of which no robustness is left.
        OutputError: the output cannot be written.
    """
    writer = _WRITERS.get(output.suffix.lower())
    if writer is None:
        raise UsageError(
            f"{output.name} ends in neither {' nor '.join(_WRITERS)}; the ending gives the format"
        )
    titles = _columns(source)
    faults: list[str] = []
    rows = 0
    with replacing(output, inputs) as stream:
        write = writer(stream, [TIME, *titles.values()])
        for table in _iter_tables(source, titles, QUANTITIES.index(quantity), faults):
            write(table)
            rows += len(table.times_ns)
            advance(len(table.times_ns))
        write(None)
    return rows, len(titles), tuple(faults)


def _iter_series(source: Source) -> Iterator[tuple[list[RobustnessSeries], tuple[str, ...]]]:
    """Read the robustness of a log, block by block, with what was lost.

    Raises:
        UsageError: a log of a format that cannot have any.
        LogError: a message that cannot be read.
    """
    if not isinstance(source, McapSource):
        raise UsageError(
            f"{source.name} is not an annotated log; write one with spatial-replay replay … -o FILE.mcap"
        )
    for payloads, faults in source.iter_payloads(ROBUSTNESS):
        try:
            yield decode_robustness(payloads), faults
        except ValueError as error:
            raise LogError(f"{source.name}: a message of {ROBUSTNESS} cannot be read: {error}") from error


def _columns(source: Source) -> Mapping[tuple[_Result, int], str]:
    """Return the title of each node's column: its name, or its result's and its number; all differ."""
    nodes: dict[tuple[_Result, int], str | None] = {}
    faults: list[str] = []
    for series, lost in _iter_series(source):
        faults += lost
        for each in series:
            result = (each.specification, each.object or None)
            for identifier, name in zip(each.ids, each.names, strict=True):
                nodes.setdefault((result, int(identifier)), name or None)
    if not nodes:
        if faults:
            raise LogError(f"{source.name} holds no {ROBUSTNESS} that can be read: {faults[0]}")
        raise UsageError(
            f"{source.name} holds no {ROBUSTNESS}; write it with spatial-replay replay … -o FILE.mcap"
        )
    names = list(nodes.values())
    titles: dict[tuple[_Result, int], str] = {}
    taken = {TIME}
    for (result, identifier), name in nodes.items():
        owner = result[0] if result[1] is None else f"{result[0]}({result[1]})"
        numbered = f"{owner}#{identifier}"
        if name is None:
            title = numbered
        elif names.count(name) > 1:
            title = owner if identifier == 0 else f"{owner}.{name}"
        else:
            title = name
        choices = chain([title, numbered], (f"{numbered} ({number})" for number in count(2)))
        titles[result, identifier] = next(choice for choice in choices if choice not in taken)
        taken.add(titles[result, identifier])
    return titles


def _iter_tables(
    source: Source, titles: Mapping[tuple[_Result, int], str], quantity: int, faults: list[str]
) -> Iterator[TableRows]:
    column = {node: index for index, node in enumerate(titles)}
    for series, lost in _iter_series(source):
        faults += lost
        if not series:
            continue
        times_ns = np.unique(np.concatenate([each.times_ns for each in series]))
        numbers = np.full((len(times_ns), len(column)), np.nan)
        for each in series:
            result = (each.specification, each.object or None)
            rows = np.searchsorted(times_ns, each.times_ns)
            columns = [column[result, int(identifier)] for identifier in each.ids]
            numbers[rows[:, None], columns] = each.series[:, quantity].T
        yield TableRows(times_ns, numbers)


Write: TypeAlias = Callable[[TableRows | None], None]
"""Writes the next rows; None after the last."""


def _csv_writer(stream: Any, titles: Sequence[str]) -> Write:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    rows = csv.writer(text)
    rows.writerow(titles)

    def write(table: TableRows | None) -> None:
        if table is None:
            text.detach()
            return
        for time_ns, numbers in zip(table.times_ns.tolist(), table.numbers.tolist(), strict=True):
            rows.writerow([time_ns, *("" if math.isnan(number) else number for number in numbers)])

    return write


def _parquet_writer(stream: Any, titles: Sequence[str]) -> Write:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise UsageError(
            "Parquet needs pyarrow; pip install 'spatial-replay[parquet]', or write a .csv"
        ) from error
    schema = pa.schema([(titles[0], pa.int64()), *((title, pa.float64()) for title in titles[1:])])
    writer = parquet.ParquetWriter(stream, schema)

    def write(table: TableRows | None) -> None:
        if table is None:
            writer.close()
            return
        columns = [
            pa.array(table.times_ns),
            *(pa.array(column, from_pandas=True) for column in table.numbers.T),
        ]
        writer.write_table(pa.table(columns, schema=schema))

    return write


_WRITERS: dict[str, Callable[[Any, Sequence[str]], Write]] = {
    ".csv": _csv_writer,
    ".parquet": _parquet_writer,
}

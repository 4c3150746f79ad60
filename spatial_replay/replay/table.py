"""The numbers of an annotated log as a table: one row per sample, one column per node and automaton."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias, get_args

import numpy as np
from google.protobuf.message import DecodeError

from spatial_replay.annotate.robustness import RobustnessSeries, decode_robustness
from spatial_replay.errors import LogError, UsageError, importing
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.mcap.read import McapSource
from spatial_replay.logs.output_file import replacing
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.schemas.Specification_pb2 import Specification, SpecificationResult
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import AUTOMATON, ROBUSTNESS, SPECIFICATION
from spatial_replay.replay.selection import named_zero_ns
from spatial_replay.text import counted_from, cut

Quantity: TypeAlias = Literal["value", "now", "lower", "upper"]
TIME = "time_ns"
"""The title of the column of times."""
SECONDS = "seconds"
"""The title of the column with the seconds since the log's zero."""
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)

_LONGEST_TEXT: Final = 60
"""Maximum length of a node's text in a title, characters."""
_FORMULAS: Final = ("=", "+", "-", "@", "\t", "\r")
"""Beginnings of cells that spreadsheets evaluate: https://owasp.org/www-community/attacks/CSV_Injection."""
_Result: TypeAlias = tuple[str, str | None]
"""Name and object of a result."""
_Node: TypeAlias = tuple[_Result, int]
"""A node of a result, by its number."""


@dataclass(frozen=True, eq=False)
class TableRows:
    """Consecutive rows of a table.

    Attributes:
        times_ns: (T,) int64.
        seconds: (T,), since the zero in the log's metadata, or else since the first row.
        numbers: (T, nodes); NaN where a node has no number or no sample.
        states: for each automaton, its possible states after each sample: "2", "1|2", or "" if not reported.
    """

    times_ns: Integers
    seconds: Floats
    numbers: Floats
    states: Sequence[Sequence[str]]


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
        The numbers of rows and of nodes, and the losses while reading, each with its place.

    Raises:
        UsageError: the ending is neither .parquet nor .csv, the library for Parquet is missing, or the log
            has no robustness.
        LogError: the log is damaged, and no robustness is left.
        OutputError: the output cannot be written.
    """
    check_table_name(output)
    writer = _WRITERS[output.suffix.lower()]
    titles, automaton_titles = _titles(source)
    faults: list[str] = []
    rows, first_ns = 0, named_zero_ns(source)
    column_titles = [TIME, SECONDS, *titles.values()], list(automaton_titles.values())
    with replacing(output, inputs) as stream, writer(stream, *column_titles) as write_rows:
        for table_rows in _iter_tables(source, titles, automaton_titles, QUANTITIES.index(quantity), faults):
            write_rows(table_rows)
            first_ns = int(table_rows.times_ns[0]) if first_ns is None else first_ns
            rows += len(table_rows.times_ns)
            advance(len(table_rows.times_ns))
    return rows, len(titles), counted_from(faults, first_ns or 0)


def check_table_name(output: Path) -> None:
    """Raise UsageError if a file's name ends in neither .csv nor .parquet."""
    if output.suffix.lower() not in _WRITERS:
        raise UsageError(
            f"{output.name} ends in neither {' nor '.join(_WRITERS)}; the ending gives the format"
        )


def _iter_series(source: Source) -> Iterator[tuple[list[RobustnessSeries], tuple[str, ...]]]:
    """Read the robustness of a log block by block, with the losses of each block.

    Raises:
        UsageError: the format of the log has no robustness.
        LogError: a message cannot be read.
    """
    if not isinstance(source, McapSource):
        raise UsageError(
            f"{source.name} is not an annotated log; give --spec SPEC, or write one with spatial-replay"
            " replay … -o FILE.mcap"
        )
    for payloads, block_faults in source.iter_payloads(ROBUSTNESS):
        try:
            yield decode_robustness(payloads), block_faults
        except ValueError as error:
            raise LogError(f"{source.name}: a message of {ROBUSTNESS} cannot be read: {error}") from error


def _titles(source: Source) -> tuple[Mapping[_Node, str], Mapping[_Result, str]]:
    """Return a distinct column title for each node, and for each automaton.

    A node's title lists the named specs on the path to the node: `task/deliver`. A node without a name has
    the title of the nearest named spec, followed by the node's text.
    """
    node_names: dict[_Node, str | None] = {}
    faults: list[str] = []
    # the whole log is read first, because a node may appear in a later block
    for series, block_faults in _iter_series(source):
        faults += block_faults
        for result_series in series:
            result = (result_series.specification, result_series.object or None)
            for node_id, name in zip(result_series.ids, result_series.names, strict=True):
                node_names.setdefault((result, int(node_id)), name or None)
    if not node_names:
        if faults:
            raise LogError(f"{source.name} holds no {ROBUSTNESS} that can be read: {faults[0]}")
        raise UsageError(
            f"{source.name} holds no {ROBUSTNESS}; write it with spatial-replay replay … -o FILE.mcap"
        )
    used_titles = {TIME, SECONDS}
    path_titles = {result: _paths(result, tree) for result, tree in _trees(source).items()}
    titles: dict[_Node, str] = {}
    for (result, node_id), name in node_names.items():
        numbered_title = f"{_result_title(result)}#{node_id}"
        name_title = f"{_result_title(result)}/{name}" if name and node_id else _result_title(result)
        fallback = name_title if name or not node_id else numbered_title
        title = path_titles.get(result, {}).get(node_id, fallback)
        titles[result, node_id] = _claim_title(title, numbered_title, used_titles)
    automaton_titles = {
        result: _claim_title(
            f"{_result_title(result)}/automaton", f"{_result_title(result)}#automaton", used_titles
        )
        for result in dict.fromkeys(result for _, result, _ in _iter_states(source))
    }
    return titles, automaton_titles


def _result_title(result: _Result) -> str:
    return result[0] if result[1] is None else f"{result[0]}({result[1]})"


def _claim_title(title: str, fallback: str, used_titles: set[str]) -> str:
    """Mark a title as used, and return it. If a column already has the title, an alternative is used."""
    candidates = chain(
        [title, f"{title} #{fallback.rpartition('#')[2]}", fallback],
        (f"{fallback} ({number})" for number in count(2)),
    )
    free_title = next(candidate for candidate in candidates if candidate not in used_titles)
    used_titles.add(free_title)
    return free_title


def _trees(source: Source) -> Mapping[_Result, SpecificationResult]:
    """Return the trees of the results in the readable specifications of the log."""
    trees: dict[_Result, SpecificationResult] = {}
    for payload in _payloads(source, SPECIFICATION):
        try:
            specification = Specification.FromString(payload)
        except DecodeError:
            continue
        trees |= {(tree.name, tree.object or None): tree for tree in specification.results}
    return trees


def _paths(result: _Result, tree: SpecificationResult) -> Mapping[int, str]:
    """Return the title of each node by id. A tree lists its nodes by id, parents before their operands."""
    owners: dict[int, str] = {}
    titles: dict[int, str] = {}
    for node in tree.nodes:
        owner = owners.get(node.parent) if node.HasField("parent") else None
        if owner is None:
            title = owners[node.id] = _result_title(result)
        elif node.name:
            title = owners[node.id] = f"{owner}/{node.name}"
        else:
            title, owners[node.id] = f"{owner}: {cut(node.text, _LONGEST_TEXT)}", owner
        titles[node.id] = title
    return titles


def _payloads(source: Source, topic: str) -> Iterator[bytes]:
    """Yield the payloads of a topic. Losses are left out, because `_iter_series` reports them."""
    if isinstance(source, McapSource):
        for payloads, _ in source.iter_payloads(topic):
            yield from payloads


def _iter_states(source: Source) -> Iterator[tuple[int, _Result, str]]:
    """Yield the time, the result and the states of each readable message about an automaton."""
    for payload in _payloads(source, AUTOMATON):
        try:
            state = AutomatonState.FromString(payload)
        except DecodeError:
            continue
        state_text = "|".join(map(str, state.states))
        yield state.time_ns, (state.specification, state.object or None), state_text


def _iter_tables(
    source: Source,
    titles: Mapping[_Node, str],
    automata: Mapping[_Result, str],
    quantity: int,
    faults: list[str],
) -> Iterator[TableRows]:
    column_by_node = {node: index for index, node in enumerate(titles)}
    states_by_result: dict[_Result, dict[int, str]] = {result: {} for result in automata}
    for time_ns, result, state_text in _iter_states(source) if automata else ():
        states_by_result[result][time_ns] = state_text
    first_ns = named_zero_ns(source)
    for series, block_faults in _iter_series(source):
        faults += block_faults
        if not series:
            continue
        times_ns = np.unique(np.concatenate([result_series.times_ns for result_series in series]))
        first_ns = int(times_ns[0]) if first_ns is None else first_ns
        numbers = np.full((len(times_ns), len(column_by_node)), np.nan)
        for result_series in series:
            result = (result_series.specification, result_series.object or None)
            time_rows = np.searchsorted(times_ns, result_series.times_ns)
            node_columns = [column_by_node[result, int(node_id)] for node_id in result_series.ids]
            numbers[time_rows[:, None], node_columns] = result_series.series[:, quantity].T
        state_cells = [
            [state_by_time.get(time_ns, "") for time_ns in times_ns.tolist()]
            for state_by_time in states_by_result.values()
        ]
        yield TableRows(times_ns, (times_ns - first_ns) / 1e9, numbers, state_cells)


def _text_cell(text: str) -> str:
    """Return the text of a cell, with an apostrophe first if a spreadsheet would evaluate the text."""
    return f"'{text}" if text.startswith(_FORMULAS) else text


@contextmanager
def _csv_writer(
    stream: Any, titles: Sequence[str], automata: Sequence[str]
) -> Iterator[Callable[[TableRows], None]]:
    text_stream = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    row_writer = csv.writer(text_stream)
    row_writer.writerow(map(_text_cell, [*titles, *automata]))

    def write(table: TableRows) -> None:
        columns = [table.times_ns.tolist(), table.seconds.tolist(), table.numbers.tolist()]
        for row, (time_ns, seconds, numbers) in enumerate(zip(*columns, strict=True)):
            number_cells = ("" if math.isnan(number) else number for number in numbers)
            row_writer.writerow([time_ns, seconds, *number_cells, *(states[row] for states in table.states)])

    try:
        yield write
    finally:
        # otherwise the wrapper would close the stream when it is garbage-collected
        text_stream.detach()


@contextmanager
def _parquet_writer(
    stream: Any, titles: Sequence[str], automata: Sequence[str]
) -> Iterator[Callable[[TableRows], None]]:
    with importing("Parquet, unlike .csv, needs pyarrow", extra="parquet"):
        import pyarrow as pa
        from pyarrow import parquet
    time_title, *number_titles = titles
    schema = pa.schema(
        [
            (time_title, pa.int64()),
            *((title, pa.float64()) for title in number_titles),
            *((title, pa.string()) for title in automata),
        ]
    )
    writer = parquet.ParquetWriter(stream, schema)

    def write(table: TableRows) -> None:
        columns = [
            pa.array(table.times_ns),
            pa.array(table.seconds),
            *(pa.array(number_column, from_pandas=True) for number_column in table.numbers.T),
            *(pa.array([state or None for state in states], pa.string()) for states in table.states),
        ]
        writer.write_table(pa.table(columns, schema=schema))

    try:
        yield write
    finally:
        # an open writer would write to the closed file when it is garbage-collected
        try:
            writer.close()
        finally:
            writer.is_open = False


_WRITERS = {".csv": _csv_writer, ".parquet": _parquet_writer}

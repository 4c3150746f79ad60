"""Results of batches as Parquet files: rows by specification, and the table of the last run.

    RESULTS/format.json             the version of this layout
    RESULTS/rows/spec_hash=HASH/*   the rows of everything that was evaluated, by specification
    RESULTS/last_run.parquet        the table of the last run: its cases, logs and what they failed by
    RESULTS/identities.jsonl        what unchanged logs hold, so that they need not be hashed again

The rows of one log under one specification have a key, which is a hash of all they depend on. A worker
writes them as one file named after the key, which is whole or not there. While a run goes on, small files are
joined into larger ones. A run that is killed between writing and removing leaves rows of one key in two
files; they are equal, and readers take the first.

RESULTS is a folder on this machine, or in a bucket. There, identities are not kept, and there is no lock,
which a killed batch would leave behind: two batches at once lose no rows, because a file is removed only
after another one holds its rows.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, cast

from spatial_replay.batch.result_files import ResultFiles, result_files
from spatial_replay.batch.rows import ResultRow
from spatial_replay.errors import LogError, MissingFileError, UsageError, importing

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT: Final = 2
"""The version of the layout; rows of another version are never read."""
LAST_RUN: Final = "last_run.parquet"
IDENTITIES: Final = "identities.jsonl"
SOURCE: Final = "source"
"""The column of the file that was read: logs that hold the same share their rows."""
_FORMAT_FILE: Final = "format.json"
_ROWS: Final = "rows"
_PARTITION: Final = "spec_hash="
"""Beginning of the name of a folder, of which readers make a column: another than those in the files."""
_JOINED: Final = "joined-"
"""Beginning of the name of a file that holds the rows of several keys."""
_MOST_JOINED: Final = 500
"""Keys in one file, at most: joining holds that many in memory."""


def columns() -> pa.Schema:
    """Return the columns of stored rows."""
    pa = _pyarrow()
    text, time, texts = pa.string(), pa.int64(), pa.list_(pa.string())
    return pa.schema(
        [
            pa.field("key", text, nullable=False),
            ("spec", text),
            ("object", text),
            ("requirement", text),
            ("title", text),
            ("line", pa.int32()),
            ("verdict", text),
            *((name, pa.float64()) for name in ("robustness", "lower", "upper")),
            *((name, time) for name in ("first_satisfied_ns", "violated_at_ns", "satisfied_at_ns")),
            ("atom", text),
            ("atom_time_ns", time),
            ("atom_objects", texts),
            ("reason", text),
            ("explanation", texts),
            ("tested", text),
            ("untested", texts),
            ("vacuous", texts),
            ("dropped", text),
            ("samples", pa.int64()),
            ("start_ns", time),
            ("duration_ns", time),
            *((name, texts) for name in ("faults", "remarks", "missing")),
            ("seconds", pa.float64()),
            ("error", text),
            ("error_kind", text),
            (SOURCE, text),
        ]
    )


def run_columns() -> pa.Schema:
    """Return the columns of the table of a run: those of rows, and what the run asked for."""
    pa = _pyarrow()
    text = pa.string()
    asked = [(name, text) for name in ("case", "log", "file", "expected", "failure")]
    return pa.schema([*asked, *(each for each in columns() if each.name != SOURCE)])


def table_of(rows: Mapping[str, Sequence[ResultRow]]) -> pa.Table:
    """Return rows, by their keys, as a table."""
    pa, schema = _pyarrow(), columns()
    listed = [row for several in rows.values() for row in several]
    arrays = [pa.array([key for key, several in rows.items() for _ in several], schema.field("key").type)]
    # column by column: three times as fast as row by row
    arrays += [pa.array([getattr(row, each.name) for row in listed], each.type) for each in list(schema)[1:]]
    return pa.Table.from_arrays(arrays, schema=schema)


def write_rows(files: ResultFiles, spec_hash: str, key: str, rows: Sequence[ResultRow]) -> bytes:
    """Write the rows of one key as one file, which appears when it is whole.

    Returns:
        The same rows, as `JoinedRows.add` takes them from another process.

    Raises:
        OutputError: it cannot be written.
    """
    table = table_of({key: rows})
    # it is joined with others soon: what makes files small and searching fast would take longer than the rest
    options = {"compression": "none", "use_dictionary": False, "write_statistics": False}
    files.write(_row_file(spec_hash, key), _encoded(table, **options))
    sink = _pyarrow().BufferOutputStream()
    with _pyarrow().ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    return cast(bytes, sink.getvalue().to_pybytes())


def _row_file(spec_hash: str, key: str) -> str:
    return f"{_ROWS}/{_PARTITION}{spec_hash}/{key}.parquet"


def _encoded(table: pa.Table, **options: Any) -> bytes:
    from pyarrow import parquet

    stream = io.BytesIO()
    # written in one piece, a table of many small ones takes a quarter of the time
    parquet.write_table(table.combine_chunks(), stream, **{"compression": "zstd", **options})
    return stream.getvalue()


class JoinedRows:
    """Joins the small files of a run into larger ones, while the run goes on.

    It has the rows from the workers, and need not read them. Holds up to `_MOST_JOINED` keys of each
    specification in memory; what it has not joined when a run ends early, the next run joins.
    """

    def __init__(self, files: ResultFiles) -> None:
        self._files = files
        self._tables: dict[str, dict[str, pa.Table]] = defaultdict(dict)

    def add(self, spec_hash: str, key: str, data: bytes) -> None:
        """Take in what `write_rows` has returned.

        Raises:
            UsageError: the workers' files are not here.
            OutputError: a joined file cannot be written.
        """
        waiting = self._tables[spec_hash]
        waiting[key] = _pyarrow().ipc.open_stream(data).read_all()
        if len(waiting) >= _MOST_JOINED:
            self._join(spec_hash)

    def finish(self) -> None:
        """Join what is left; for what is raised, see `add`."""
        for spec_hash in list(self._tables):
            self._join(spec_hash)

    def _join(self, spec_hash: str) -> None:
        tables = dict(sorted(self._tables.pop(spec_hash).items()))
        names = {_row_file(spec_hash, key) for key in tables}
        partition = str(PurePosixPath(next(iter(names))).parent)
        if not names <= set(self._files.names(partition)):
            raise UsageError(
                f"the workers' rows are not in {self._files.location}: they see another disk; "
                "give a folder that all share"
            )
        if len(tables) > 1:
            _write_joined(self._files, partition, tables)
            self._files.remove(sorted(names))


def _write_joined(files: ResultFiles, partition: str, tables: Mapping[str, pa.Table]) -> None:
    """Write the rows of several keys as one file."""
    # named after what it holds, so that joining the same files twice gives one file
    digest = hashlib.sha256("".join(tables).encode()).hexdigest()[:32]
    joined = _pyarrow().concat_tables(tables.values(), promote_options="default")
    files.write(f"{partition}/{_JOINED}{digest}.parquet", _encoded(joined))


class ResultsFolder:
    """A folder of results, opened.

    Only the process that has it `locked` writes to it, and its workers, which `write_rows`.
    """

    def __init__(self, files: ResultFiles) -> None:
        self._files = files
        self.location: str = files.location

    @classmethod
    def create(cls, path: str | PathLike[str]) -> ResultsFolder:
        """Open a folder for a batch; one that does not exist is made.

        Raises:
            UsageError: it holds something else, or results of another version.
            OutputError: it cannot be written.
            MissingFileError, RemoteError: a bucket cannot be read.
        """
        _pyarrow()
        files = result_files(path)
        if not files.exists():
            files.write(_FORMAT_FILE, json.dumps({"spatial_replay_results": FORMAT}).encode() + b"\n")
        return cls.open(path)

    @classmethod
    def open(cls, path: str | PathLike[str]) -> ResultsFolder:
        """Open the results of an earlier run.

        Raises:
            MissingFileError: there is no such folder.
            UsageError: it does not hold results, or those of another version.
            RemoteError: a bucket cannot be read.
        """
        _pyarrow()
        files = result_files(path)
        if not files.exists():
            raise MissingFileError(f"{path}: no such folder, or an empty one; give the results of a batch")
        try:
            (data,) = files.read([_FORMAT_FILE])
            version = json.loads(data)["spatial_replay_results"]
        except (MissingFileError, ValueError, LookupError, TypeError):
            raise UsageError(
                f"{path} does not hold the results of a batch; give those, or an empty or new folder"
            ) from None
        if version != FORMAT:
            raise UsageError(
                f"{path} holds results of format {version!s:.20}, and this version writes format {FORMAT}; "
                "give another folder, and the batch evaluates all logs into it"
            )
        return cls(files)

    def locked(self) -> AbstractContextManager[None]:
        """Keep other batches from writing here, unless it is in a bucket.

        Raises:
            UsageError: another batch is running.
        """
        return self._files.locked(_FORMAT_FILE)

    @property
    def identities(self) -> Path | None:
        """The file of identities; None in a bucket, where other machines have other files of one path."""
        return self._files.own_file(IDENTITIES)

    def joined_rows(self) -> JoinedRows:
        """Return what joins the files of a run; call it while `locked`."""
        return JoinedRows(self._files)

    def keys(self) -> set[str]:
        """Return the keys whose rows are stored."""
        joined, single = self._row_files()
        found = {_key_of(name) for name in single}
        for table in self._tables(joined, ["key"]):
            found.update(table.column("key").to_pylist())
        return found

    def rows(self, wanted: set[str] | None = None) -> pa.Table:
        """Return the stored rows, those of each key once and together.

        Args:
            wanted: keys; None for all.
        """
        tables, taken = [], set[str]()
        joined, single = self._row_files()
        for table in self._tables(joined):
            keys = table.column("key").to_pylist()
            own = {key for key in keys if key not in taken and (wanted is None or key in wanted)}
            taken |= own
            tables.append(table if len(own) == len(set(keys)) else table.filter([key in own for key in keys]))
        fresh = {_key_of(name): name for name in single}
        tables += self._tables(
            [name for key, name in fresh.items() if key not in taken and (wanted is None or key in wanted)]
        )
        # what was stored before a column was there lacks it
        return _pyarrow().concat_tables([columns().empty_table(), *tables], promote_options="default")

    def join_files(self) -> None:
        """Join small files that runs have left into larger ones; call it while `locked`.

        Raises:
            OutputError: they cannot be written.
        """
        partitions: dict[str, tuple[list[str], list[str]]] = defaultdict(lambda: ([], []))
        for kind, names in enumerate(self._row_files()):
            for name in names:
                partitions[str(PurePosixPath(name).parent)][kind].append(name)
        for partition, (joined, single) in sorted(partitions.items()):
            if not single:
                continue
            stored = {
                key for table in self._tables(joined, ["key"]) for key in table.column("key").to_pylist()
            }
            fresh = [name for name in single if _key_of(name) not in stored]
            if len(fresh) > 1:
                for begin in range(0, len(fresh), _MOST_JOINED):
                    some = fresh[begin : begin + _MOST_JOINED]
                    tables = dict(zip(map(_key_of, some), self._tables(some), strict=True))
                    _write_joined(self._files, partition, tables)
            self._files.remove(single if len(fresh) > 1 else sorted(set(single) - set(fresh)))

    def write_run(self, table: pa.Table) -> None:
        """Write the table of a run, whole or not at all.

        Raises:
            OutputError: it cannot be written.
        """
        self._files.write(LAST_RUN, _encoded(table))

    def read_run(self) -> pa.Table:
        """Return the table of the last run that ended.

        Raises:
            UsageError: none has.
            LogError: its file is damaged.
        """
        try:
            (table,) = self._tables([LAST_RUN])
        except MissingFileError:
            raise UsageError(
                f"no run has ended in {self._files} so far; run the batch again, and it goes on"
            ) from None
        return table

    def _row_files(self) -> tuple[list[str], list[str]]:
        """Return the names of the files with the rows of several keys, and of those with one."""
        names = [
            name
            for name in self._files.names(_ROWS)
            if name.startswith(f"{_ROWS}/{_PARTITION}") and name.endswith(".parquet")
        ]
        joined = [name for name in names if _key_of(name).startswith(_JOINED)]
        return joined, [name for name in names if not _key_of(name).startswith(_JOINED)]

    def _tables(self, names: Sequence[str], columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """Read tables; they were written by us, since nothing else belongs in the folder.

        Raises:
            LogError: one is damaged.
        """
        pa = _pyarrow()
        from pyarrow import parquet

        for name, data in zip(names, self._files.read(names), strict=True):
            try:
                # not `read_table`, which takes twice as long
                with parquet.ParquetFile(pa.BufferReader(data)) as opened:
                    table = opened.read(columns, use_threads=False)
            except (OSError, pa.ArrowException) as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise LogError(
                    f"{self._files}/{name} cannot be read: {reason}; "
                    "delete it, and the batch evaluates it again"
                ) from None
            yield table


def _key_of(name: str) -> str:
    """Return the key whose rows a file holds."""
    return PurePosixPath(name).stem


def _pyarrow() -> Any:
    with importing("results are Parquet files, which need pyarrow", extra="parquet"):
        import pyarrow
    return pyarrow

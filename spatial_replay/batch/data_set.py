"""Results of batches as Parquet files: rows by specification, and the table of the last run.

    RESULTS/format.json             the version of this layout
    RESULTS/rows/spec_hash=HASH/*   the rows of everything that was evaluated, by specification
    RESULTS/last_run.parquet        the table of the last run: its cases, logs and what they failed by
    RESULTS/identities.jsonl        what unchanged logs hold, so that they need not be hashed again

The rows of one log under one specification have a key, which is a hash of all they depend on. A worker
writes them as one file named after the key, which is whole or not there. When a run ends, small files are
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
from contextlib import contextmanager
from dataclasses import asdict
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final

from spatial_replay.batch.result_files import LocalFolder, ResultFiles, result_files
from spatial_replay.batch.rows import ResultRow
from spatial_replay.errors import LogError, MissingFileError, UsageError

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT: Final = 1
"""The version of the layout; rows of another version are never read."""
LAST_RUN: Final = "last_run.parquet"
IDENTITIES: Final = "identities.jsonl"
_FORMAT_FILE: Final = "format.json"
_ROWS: Final = "rows"
_PARTITION: Final = "spec_hash="
"""Beginning of the name of a folder, of which readers make a column: another than those in the files."""
_JOINED: Final = "joined-"
"""Beginning of the name of a file that holds the rows of several keys."""
_MOST_JOINED: Final = 20_000
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
            ("vacuous", texts),
            ("samples", pa.int64()),
            ("start_ns", time),
            ("duration_ns", time),
            *((name, texts) for name in ("faults", "remarks", "missing")),
            ("seconds", pa.float64()),
            ("error", text),
            ("error_kind", text),
        ]
    )


def run_columns() -> pa.Schema:
    """Return the columns of the table of a run: those of rows, and what the run asked for."""
    pa = _pyarrow()
    text = pa.string()
    asked = [(name, text) for name in ("case", "log", "file", "expected", "failure")]
    return pa.schema([*asked, *columns()])


def table_of(rows: Mapping[str, Sequence[ResultRow]]) -> pa.Table:
    """Return rows, by their keys, as a table."""
    values = [{"key": key, **asdict(row)} for key, several in rows.items() for row in several]
    return _pyarrow().Table.from_pylist(values, schema=columns())


def write_rows(files: ResultFiles, spec_hash: str, key: str, rows: Sequence[ResultRow]) -> None:
    """Write the rows of one key as one file, which appears when it is whole.

    Raises:
        OutputError: it cannot be written.
    """
    # it is joined with others soon: what makes searching fast would take longer than the rest
    data = _encoded(table_of({key: rows}), use_dictionary=False, write_statistics=False)
    files.write(f"{_ROWS}/{_PARTITION}{spec_hash}/{key}.parquet", data)


def _encoded(table: pa.Table, **options: Any) -> bytes:
    from pyarrow import parquet

    stream = io.BytesIO()
    parquet.write_table(table, stream, compression="zstd", **options)
    return stream.getvalue()


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

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other batches from writing here, unless it is in a bucket.

        Raises:
            UsageError: another batch is running.
        """
        if isinstance(self._files, LocalFolder):
            with self._files.locked(_FORMAT_FILE):
                yield
        else:
            yield

    @property
    def identities(self) -> Path | None:
        """The file of identities; None in a bucket, where other machines have other files of one path."""
        return self._files.path / IDENTITIES if isinstance(self._files, LocalFolder) else None

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
        return _pyarrow().concat_tables(tables) if tables else columns().empty_table()

    def join_files(self) -> None:
        """Join small files into larger ones; call it while `locked`.

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
                    self._join(fresh[begin : begin + _MOST_JOINED], partition)
            self._files.remove(single if len(fresh) > 1 else sorted(set(single) - set(fresh)))

    def _join(self, names: Sequence[str], partition: str) -> None:
        table = _pyarrow().concat_tables(list(self._tables(names)))
        # named after what it holds, so that joining the same files twice gives one file
        digest = hashlib.sha256("".join(map(_key_of, names)).encode()).hexdigest()[:32]
        self._files.write(f"{partition}/{_JOINED}{digest}.parquet", _encoded(table))

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
    try:
        import pyarrow
    except ImportError:
        raise UsageError(
            "results are Parquet files, which need pyarrow; install it with: "
            "pip install 'spatial-replay[parquet]'"
        ) from None
    return pyarrow

"""Results of a batch: a folder of rows as Parquet, on a disk or in a bucket."""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import fields
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from spatial_replay.batch.rows import ResultRow
from spatial_replay.errors import LogError, MissingFileError, OutputError, UsageError, importing
from spatial_replay.logs.output_file import output_error, refuse_addresses, replacing
from spatial_replay.logs.remote import RemoteFolder, is_address

if TYPE_CHECKING:
    import pyarrow as pa


_PARTIAL: Final = ".partial"


class LocalFolder:
    """A folder on this machine. Each file has a temporary name until it is complete."""

    is_on_this_machine: Final = True

    def __init__(self, path: Path) -> None:
        """Check a path without reading the folder.

        Raises:
            UsageError: the path is a file.
        """
        refuse_addresses(path, "give it as a text: a path joins its slashes")
        if path.exists() and not path.is_dir():
            raise UsageError(f"{path} is a file; give a folder for results")
        self.path: Final = path
        self.location: Final = str(path.resolve())

    def __str__(self) -> str:
        return str(self.path)

    def exists(self) -> bool:
        """Return whether the folder contains a file."""
        return next(self._files(self.path), None) is not None

    def names(self, below: str = "") -> list[str]:
        """Return the sorted names of all files in the folder, or in its subfolder `below`."""
        return sorted(file.removeprefix(f"{self.path}/") for file in self._files(self.path / below))

    def read(self, names: Sequence[str]) -> Iterator[bytes]:
        """Read files, and yield their contents in the same order.

        Raises:
            MissingFileError, LogError: a file is missing or unreadable.
        """
        for name in names:
            try:
                data = (self.path / name).read_bytes()
            except FileNotFoundError as error:
                raise MissingFileError(f"{self.path / name}: there is no such file") from error
            except OSError as error:
                raise LogError(f"{self.path / name} cannot be read: {error.strerror}") from error
            yield data

    def write(self, name: str, data: bytes) -> None:
        """Write a file, and create its folders if needed.

        Raises:
            OutputError: the file cannot be written.
        """
        file = self.path / name
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise output_error(file.parent, error) from error
        with replacing(file) as stream:
            stream.write(data)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files.

        Raises:
            OutputError: a file cannot be removed.
        """
        for name in names:
            try:
                (self.path / name).unlink()
            except OSError as error:
                raise OutputError(f"{self.path / name} could not be removed: {error.strerror}") from error

    @staticmethod
    def _files(folder: Path) -> Iterator[str]:
        """Yield the paths of all files in a folder and its subfolders, without partial files."""
        for parent, _, names in os.walk(folder):
            yield from (f"{parent}/{name}" for name in names if not name.endswith(_PARTIAL))

    @contextmanager
    def lock(self, name: str) -> Iterator[None]:
        """Lock the folder against other commands, and remove partial files of killed commands.

        Raises:
            UsageError: another command is writing to the folder.
        """
        with (self.path / name).open("rb") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(
                    f"another command is writing to {self.path}; wait for it, or give another folder"
                ) from None
            for partial in self.path.rglob(f".*{_PARTIAL}"):
                partial.unlink(missing_ok=True)
            yield


class BucketFolder(RemoteFolder):
    """A folder in a bucket. Many machines may write to it: it has no lock and no states of local files."""

    is_on_this_machine: Final = False

    @contextmanager
    def lock(self, name: str) -> Iterator[None]:
        """Do nothing. A killed batch could not release a lock in a bucket."""
        yield


ResultFiles: TypeAlias = LocalFolder | BucketFolder


def result_files(folder: str | PathLike[str]) -> ResultFiles:
    """Return the local folder of a path, or the bucket's folder of an address.

    Raises:
        UsageError: the path is a file, the address is no folder, or obstore is not installed.
    """
    return BucketFolder(fspath(folder)) if is_address(folder) else LocalFolder(Path(folder))


FORMAT: Final = 4
"""Version of the layout. Rows of another version are never read."""
LAST_RUN: Final = "last_run.parquet"
SOURCE: Final = "source"
"""Column with the name of the evaluated file. Logs of equal content share their rows."""
EXPLANATION: Final = ("atom", "atom_time_ns", "atom_objects", "reason", "explanation")
"""Columns of the explanation. The columns of an unexplained result are null."""
_FORMAT_FILE: Final = "format.json"
_IDENTITIES: Final = "identities.parquet"
_ROWS: Final = "rows"
_MOST_TOGETHER: Final = 500
"""Maximum number of keys per file of rows. The rows of a file stay in memory until it is written."""
_LONGEST_WAIT_S: Final = 0.5
"""Longest time between two files of rows, seconds. A killed batch loses the results of this time."""
_MOST_SMALL: Final = 50
"""Maximum number of small files of rows. More files are joined."""
_DIGEST_BYTES: Final = 32


def columns() -> pa.Schema:
    """Return the columns of stored rows: a key, and the fields of `ResultRow`."""
    pa = _pyarrow()
    arrow_types = {"int": pa.int64(), "float": pa.float64(), "tuple[str, ...]": pa.list_(pa.string())}
    types = {
        column.name: arrow_types.get(str(column.type).removesuffix(" | None"), pa.string())
        for column in fields(ResultRow)
    }
    return _schema([pa.field("key", pa.string(), nullable=False), *{**types, "line": pa.int32()}.items()])


def run_columns() -> pa.Schema:
    """Return the columns of a run's table: the columns of stored rows and of their requests."""
    pa = _pyarrow()
    text_type = pa.string()
    run_columns = [(name, text_type) for name in ("case", "log", "file", "meaning", "expected", "failure")]
    return _schema([*run_columns, *(column for column in columns() if column.name != SOURCE)])


def _schema(columns: Sequence[Any]) -> pa.Schema:
    """Return a schema with integers that stay integers in pandas, even in columns with nulls."""
    schema = _pyarrow().schema(columns)
    integer_columns = [
        {"name": column.name, "field_name": column.name, "numpy_type": "Int64", "metadata": None}
        | {"pandas_type": "int64"}
        for column in schema
        if str(column.type) == "int64"
    ]
    pandas_metadata = {"index_columns": [], "column_indexes": [], "columns": integer_columns}
    return schema.with_metadata({"pandas": json.dumps(pandas_metadata)})


def table_of(rows: Mapping[str, Sequence[ResultRow]]) -> pa.Table:
    """Return the rows of keys as a table. Unknown numbers are null."""
    pa, schema = _pyarrow(), columns()
    key, *value_columns = schema
    all_rows = [row for rows_of_key in rows.values() for row in rows_of_key]
    arrays = [pa.array([key for key, rows_of_key in rows.items() for _ in rows_of_key], key.type)]
    # column by column: three times as fast as row by row
    arrays += [
        # null instead of NaN, which DuckDB and polars sort above every number
        pa.array([getattr(row, column.name) for row in all_rows], column.type, from_pandas=True)
        for column in value_columns
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _encode_table(table: pa.Table) -> bytes:
    """Return a table as a Parquet file with a SHA-256 digest of all other bytes before the footer.

    Parquet readers skip the digest, because no column refers to it.
    """
    from pyarrow import parquet

    stream = io.BytesIO()
    # writing one combined chunk takes a quarter of the time of many small chunks
    parquet.write_table(table.combine_chunks(), stream, compression="zstd")
    data = stream.getvalue()
    footer_start = _footer(data)
    return data[:footer_start] + hashlib.sha256(data).digest() + data[footer_start:]


def _decode_table(data: bytes) -> pa.Table:
    """Return the table of `_encode_table`.

    Raises:
        ValueError: the digest does not match.
    """
    from pyarrow import parquet

    footer_start = _footer(data)
    digest_start = max(0, footer_start - _DIGEST_BYTES)
    digest, content = data[digest_start:footer_start], data[:digest_start] + data[footer_start:]
    if hashlib.sha256(content).digest() != digest:
        raise ValueError("it is damaged: its digest does not fit")
    # not `read_table`, which takes twice as long
    with parquet.ParquetFile(_pyarrow().BufferReader(content)) as parquet_file:
        return parquet_file.read(use_threads=False)


def _footer(data: bytes) -> int:
    """Return the offset of a Parquet footer. Its length and `PAR1`, 4 bytes each, are the end of the file."""
    return max(0, len(data) - 8 - int.from_bytes(data[-8:-4], "little"))


class NewRows:
    """Writes the rows of many keys into one file, see `ResultsFolder.new_rows`."""

    def __init__(self, files: ResultFiles) -> None:
        self._files = files
        self.tables: list[pa.Table] = []
        """Written rows."""
        self._waiting_rows: dict[str, Sequence[ResultRow]] = {}
        self._written_s = 0.0

    def add(self, key: str, rows: Sequence[ResultRow]) -> None:
        """Store the rows of a key.

        Raises:
            OutputError: rows cannot be written.
        """
        self._waiting_rows[key] = rows
        if len(self._waiting_rows) >= _MOST_TOGETHER or time.monotonic() - self._written_s >= _LONGEST_WAIT_S:
            self.write()

    def write(self) -> None:
        """Write the rows in memory, with the errors of `add`."""
        if self._waiting_rows:
            table = table_of(self._waiting_rows)
            _write_rows(self._files, table)
            self.tables.append(table)
        self._waiting_rows.clear()
        self._written_s = time.monotonic()


def _write_rows(files: ResultFiles, table: pa.Table) -> str:
    """Write rows as one file, named after their keys, and return its name."""
    keys = "".join(table.column("key").to_pylist())
    name = f"{_ROWS}/{hashlib.sha256(keys.encode()).hexdigest()[:32]}.parquet"
    files.write(name, _encode_table(table))
    return name


class ResultsFolder:
    """A folder of results; only the process that holds its `lock` writes to it."""

    def __init__(self, files: ResultFiles) -> None:
        self._files = files
        self.location: str = files.location

    @classmethod
    def create(cls, path: str | PathLike[str]) -> ResultsFolder:
        """Open a folder of results for a batch, and create it if needed.

        Raises:
            UsageError: the folder has other contents, or results of another version.
            OutputError: the folder cannot be written.
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
            UsageError: the folder does not hold results, or holds results of another version.
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
                f"{path} does not hold the results of a batch; give its folder, or an empty or new one"
            ) from None
        if version != FORMAT:
            raise UsageError(
                f"{path} holds results of format {version!s:.20}, and this version writes format {FORMAT}; "
                "give another folder, and the batch evaluates all logs into it"
            )
        return cls(files)

    def lock(self) -> AbstractContextManager[None]:
        """Lock the folder against other batches. A bucket has no lock.

        Raises:
            UsageError: another batch is running.
        """
        return self._files.lock(_FORMAT_FILE)

    def rows(self, lasting: set[str]) -> tuple[pa.Table, list[str]]:
        """Return the stored rows with keys in `lasting`, grouped by key, and a remark on each damaged file.

        Damaged files are removed, and small files are joined. The caller holds the `lock`.

        Raises:
            OutputError: a file cannot be removed or written.
        """
        tables, remarks, known_keys, small_tables = [columns().empty_table()], [], set[str](), {}
        file_names = self._files.names(_ROWS)
        for name, data in zip(file_names, self._files.read(file_names), strict=True):
            try:
                table = self._table(name, data)
            except LogError as error:
                remarks.append(f"{error}; its rows are evaluated again")
                self._files.remove([name])
                continue
            keys = table.column("key").to_pylist()
            # two batches may have written the same rows into a bucket, which has no lock
            new_keys = set(keys) - known_keys
            known_keys |= new_keys
            if len(new_keys) < _MOST_TOGETHER:
                small_tables[name] = table.filter([key in new_keys for key in keys])
            tables.append(table.filter([key in new_keys and key in lasting for key in keys]))
        if len(small_tables) > _MOST_SMALL:
            self._join(small_tables)
        return _pyarrow().concat_tables(tables), remarks

    def _join(self, tables: Mapping[str, pa.Table]) -> None:
        """Replace several files of rows by one file.

        Args:
            tables: tables of the files, by name.
        """
        name = _write_rows(self._files, _pyarrow().concat_tables(tables.values()))
        self._files.remove(sorted(set(tables) - {name}))

    @contextmanager
    def new_rows(self) -> Iterator[NewRows]:
        """Return a writer of rows. At the end of the block, even after an interruption, it writes all rows.

        Raises:
            OutputError: rows cannot be written.
        """
        rows = NewRows(self._files)
        try:
            yield rows
        finally:
            rows.write()

    def identities(self) -> tuple[dict[str, str], list[str]]:
        """Return the stored identities of logs by state, and a remark on a damaged file of identities.

        A bucket has no identities, because a path means different files on different machines.
        """
        if not self._files.is_on_this_machine:
            return {}, []
        try:
            table = self._read(_IDENTITIES)
        except MissingFileError:
            return {}, []
        except LogError as error:
            return {}, [f"{error}; all logs are hashed again"]
        return dict(zip(*(column.to_pylist() for column in table.columns), strict=True)), []

    def write_identities(self, identities: Mapping[str, str]) -> None:
        """Write identities of logs by state.

        Raises:
            OutputError: identities cannot be written.
        """
        if self._files.is_on_this_machine:
            pa = _pyarrow()
            pairs = sorted(identities.items())
            names = ("state", "identity")
            columns = {
                name: pa.array([pair[index] for pair in pairs], pa.string())
                for index, name in enumerate(names)
            }
            self._files.write(_IDENTITIES, _encode_table(pa.table(columns)))

    def write_run(self, table: pa.Table) -> None:
        """Write the table of a run. After an error, the earlier table is unchanged.

        Raises:
            OutputError: the table cannot be written.
        """
        self._files.write(LAST_RUN, _encode_table(table))

    def read_run(self) -> pa.Table:
        """Return the table of the last run that ended.

        Raises:
            UsageError: no run has ended.
            LogError: the file of the run is damaged.
        """
        try:
            return self._read(LAST_RUN)
        except MissingFileError:
            raise UsageError(
                f"no run has ended in {self._files} so far; run the batch again; it continues"
            ) from None
        except LogError as error:
            raise LogError(f"{error}; run the batch again to replace it") from None

    def read_explanations(self) -> dict[tuple[str, str, str | None], tuple[Any, ...]]:
        """Return the last run's explanations by key, spec and object, see `EXPLANATION`."""
        import pyarrow.compute as pc

        try:
            table = self._read(LAST_RUN)
        except (MissingFileError, LogError):
            return {}
        has_explanation = pc.and_(pc.is_valid(table["explanation"]), pc.is_valid(table["verdict"]))
        rows = table.filter(has_explanation).select(["key", "spec", "object", *EXPLANATION]).to_pylist()
        return {
            (row["key"], row["spec"], row["object"]): tuple(row[name] for name in EXPLANATION) for row in rows
        }

    def _read(self, name: str) -> pa.Table:
        (data,) = self._files.read([name])
        return self._table(name, data)

    def _table(self, name: str, data: bytes) -> pa.Table:
        """Return the table of a file.

        Raises:
            LogError: the file is damaged.
        """
        try:
            return _decode_table(data)
        except (OSError, ValueError, _pyarrow().ArrowException) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise LogError(f"{self._files}/{name} cannot be used: {reason}") from None


def _pyarrow() -> Any:
    with importing("results are Parquet files, which need pyarrow", extra="parquet"):
        import pyarrow
    return pyarrow

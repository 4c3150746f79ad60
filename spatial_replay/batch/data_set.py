"""Results of batches as a folder of Parquet files: rows by specification, and the table of the last run.

    RESULTS/format.json             the version of this layout
    RESULTS/rows/spec_hash=HASH/*   the rows of everything that was evaluated, by specification
    RESULTS/last_run.parquet        the table of the last run: its cases, logs and what they failed by
    RESULTS/identities.jsonl        what unchanged logs hold, so that they need not be hashed again

The rows of one log under one specification have a key, which is a hash of all they depend on. A worker
writes them as one file named after the key, under another name first, so a file is whole or not there. When a
run ends, small files are joined into larger ones. A run that is killed between writing and removing leaves
rows of one key in two files; they are equal, and readers take the first.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from spatial_replay.batch.rows import ResultRow
from spatial_replay.errors import LogError, MissingFileError, OutputError, UsageError
from spatial_replay.logs.output_file import output_error, refuse_addresses, replacing

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


def write_rows(folder: Path, spec_hash: str, key: str, rows: Sequence[ResultRow]) -> None:
    """Write the rows of one key as one file, which appears when it is whole.

    Raises:
        OutputError: the machine cannot write it.
    """
    partition = folder / _ROWS / f"{_PARTITION}{spec_hash}"
    try:
        partition.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(partition, error) from error
    # it is joined with others soon: what makes searching fast would take longer than the rest
    _write(partition / f"{key}.parquet", table_of({key: rows}), use_dictionary=False, write_statistics=False)


def _write(path: Path, table: pa.Table, **options: Any) -> None:
    from pyarrow import parquet

    with replacing(path) as stream:
        parquet.write_table(table, stream, compression="zstd", **options)


class ResultsFolder:
    """A folder of results, opened.

    Only the process that has it `locked` writes to it, and its workers, which `write_rows`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, path: Path) -> ResultsFolder:
        """Open a folder for a batch; one that does not exist is made.

        Raises:
            UsageError: an address; it holds something else, or results of another version.
            OutputError: it cannot be written.
        """
        _pyarrow()
        refuse_addresses(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            # a batch that was killed at its very beginning leaves a partial file
            is_new = all(each.name.endswith(".partial") for each in path.iterdir())
        except FileExistsError:
            raise UsageError(f"{path} is a file; results are a folder, give it another name") from None
        except OSError as error:
            raise output_error(path, error) from error
        if is_new:
            with replacing(path / _FORMAT_FILE) as stream:
                stream.write(json.dumps({"spatial_replay_results": FORMAT}).encode() + b"\n")
        return cls.open(path)

    @classmethod
    def open(cls, path: Path) -> ResultsFolder:
        """Open the results of an earlier run.

        Raises:
            MissingFileError: there is no such folder.
            UsageError: it does not hold results, or those of another version.
        """
        _pyarrow()
        if not path.is_dir():
            raise MissingFileError(f"{path}: no such folder; give the results of a batch")
        try:
            version = json.loads((path / _FORMAT_FILE).read_text("utf-8"))["spatial_replay_results"]
        except (OSError, ValueError, LookupError, TypeError):
            raise UsageError(
                f"{path} does not hold the results of a batch; give those, or an empty or new folder"
            ) from None
        if version != FORMAT:
            raise UsageError(
                f"{path} holds results of format {version!s:.20}, and this version writes format {FORMAT}; "
                "give another folder, and the batch evaluates all logs into it"
            )
        return cls(path)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other batches from writing here, and remove what killed ones have left.

        Raises:
            UsageError: another batch is running.
        """
        with (self.path / _FORMAT_FILE).open("rb") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(
                    f"another batch is writing to {self.path}; wait for it, or give another folder"
                ) from None
            for partial in [*self.path.glob(".*.partial"), *self.path.glob(f"{_ROWS}/*/.*.partial")]:
                partial.unlink(missing_ok=True)
            yield

    def keys(self) -> set[str]:
        """Return the keys whose rows are stored."""
        found = set[str]()
        for file in self._files():
            if file.name.startswith(_JOINED):
                found.update(_read(file, ["key"]).column("key").to_pylist())
            else:
                found.add(file.stem)
        return found

    def rows(self, wanted: set[str] | None = None) -> pa.Table:
        """Return the stored rows, those of each key once and together.

        Args:
            wanted: keys; None for all.
        """
        pa = _pyarrow()
        tables, taken = [], set[str]()
        for file in self._files():
            if not file.name.startswith(_JOINED) and (
                file.stem in taken or (wanted is not None and file.stem not in wanted)
            ):
                continue
            table = _read(file)
            keys = table.column("key").to_pylist()
            own = {key for key in keys if key not in taken and (wanted is None or key in wanted)}
            taken |= own
            tables.append(table if len(own) == len(set(keys)) else table.filter([key in own for key in keys]))
        return pa.concat_tables(tables) if tables else columns().empty_table()

    def join_files(self) -> None:
        """Join small files into larger ones; call it while `locked`.

        Raises:
            OutputError: the machine cannot write them.
        """
        for partition in sorted((self.path / _ROWS).glob(f"{_PARTITION}*")):
            files = sorted(partition.glob("*.parquet"))
            joined = [file for file in files if file.name.startswith(_JOINED)]
            stored = {key for file in joined for key in _read(file, ["key"]).column("key").to_pylist()}
            single = [file for file in files if not file.name.startswith(_JOINED)]
            fresh = [file for file in single if file.stem not in stored]
            if len(fresh) > 1:
                for begin in range(0, len(fresh), _MOST_JOINED):
                    _join(fresh[begin : begin + _MOST_JOINED], partition)
            with _removing(partition):
                for file in single if len(fresh) > 1 else set(single) - set(fresh):
                    file.unlink()

    def write_run(self, table: pa.Table) -> None:
        """Write the table of a run, whole or not at all.

        Raises:
            OutputError: the machine cannot write it.
        """
        _write(self.path / LAST_RUN, table)

    def read_run(self) -> pa.Table:
        """Return the table of the last run that ended.

        Raises:
            UsageError: none has.
            LogError: its file is damaged.
        """
        file = self.path / LAST_RUN
        if not file.exists():
            raise UsageError(f"no run has ended in {self.path} so far; run the batch again, and it goes on")
        return _read(file)

    def _files(self) -> list[Path]:
        """Return the files with rows, joined ones first."""
        files = (self.path / _ROWS).glob(f"{_PARTITION}*/*.parquet")
        return sorted(files, key=lambda file: (not file.name.startswith(_JOINED), file))


def _join(files: Sequence[Path], partition: Path) -> None:
    table = _pyarrow().concat_tables([_read(file) for file in files])
    # named after what it holds, so that joining the same files twice gives one file
    name = hashlib.sha256("".join(file.stem for file in files).encode()).hexdigest()[:32]
    _write(partition / f"{_JOINED}{name}.parquet", table)


@contextmanager
def _removing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{folder}: a file could not be removed: {error.strerror}") from error


def _read(file: Path, names: Sequence[str] | None = None) -> pa.Table:
    """Read a table; one written by us, since nothing else belongs in the folder.

    Raises:
        LogError: it is damaged.
    """
    pa = _pyarrow()
    from pyarrow import parquet

    try:
        # not `read_table`, to which the name of its folder is a column, and which takes twice as long
        with parquet.ParquetFile(file) as opened:
            return opened.read(names, use_threads=False)
    except (OSError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise LogError(
            f"{file} cannot be read: {reason}; delete it, and the batch evaluates it again"
        ) from None


def _pyarrow() -> Any:
    try:
        import pyarrow
    except ImportError:
        raise UsageError(
            "results are Parquet files, which need pyarrow; install it with: "
            "pip install 'spatial-replay[parquet]'"
        ) from None
    return pyarrow

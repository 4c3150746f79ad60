"""Samples of large logs as columns on this machine, so that a second read decodes nothing.

An entry belongs to one state of one file, and to the code that read it: a log that changes, or another
version of the package, never meets an old entry. What an entry holds is checked before it is used.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.code_cache import source_digest
from spatial_replay.errors import SpatialReplayError
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.logs.checksums import crc32
from spatial_replay.logs.downloads import gigabytes, user_cache_folder
from spatial_replay.logs.read_options import SAMPLES_LIMIT
from spatial_replay.trace.trace import Trace

_DEFAULT_GIGABYTES: Final = 4
_LEAST_BYTES: Final = 2**23
"""A smaller log is read within a tenth of a second, and gets no entry."""
_MOST_TIMES_LARGER: Final = 4
"""An entry that outgrows its log by more would be read as slowly: objects that stand still shrink well."""
_SPARE_BYTES: Final = 2**30
"""What stays free on the disk."""
_LATELY_S: Final = 3600.0
_ENDS_BYTES: Final = 2**16
"""At its beginning and its end, a log's own index and checksums among them."""
_ENDING: Final = ".samples"
_HEAD_BYTES: Final = 2**20
"""More than the line before the columns of a block has."""

_END: Final = b"{}\n"
"""Where the line of a next block would be."""

_Column: TypeAlias = NDArray[np.int64] | NDArray[np.float64]
_FOOTPRINTS: Final = ("part_start", "vertex_start", "vertices", "radius", "bottom", "top")
_OBSERVATIONS: Final = ("yaw", "uncertainty", "class_code")
_INTEGERS: Final = ("times_ns", "rows", "part_start", "vertex_start", "class_code")


def cached_samples(log: Path, concave: str) -> CachedSamples | None:
    """Return the place for the samples of a log; None if it is too small, or there is to be no cache.

    Args:
        concave: how polygons that are not convex are handled.

    Raises:
        UsageError: the limit is not a number.
    """
    limit = gigabytes(SAMPLES_LIMIT, _DEFAULT_GIGABYTES)
    # a user without a home folder, a log that is gone: the reader says what is wrong, if anything is
    with suppress(OSError, RuntimeError):
        if limit and log.stat().st_size >= _LEAST_BYTES:
            return CachedSamples(log, concave, _key(log, concave), limit)
    return None


@dataclass(frozen=True, slots=True)
class CachedSamples:
    """The place for the samples of one state of a log.

    Attributes:
        key: identifies the log's content, how it is read, and the code that reads it.
        limit: bytes of all entries.
    """

    log: Path
    concave: str
    key: str
    limit: int

    @property
    def _file(self) -> Path:
        return user_cache_folder("samples") / f"{self.key}{_ENDING}"

    def open(self) -> BinaryIO | None:
        """Open the entry; None if there is none."""
        with suppress(OSError):
            stream = self._file.open("rb")
            # those that were not used for longest go first
            with suppress(OSError):
                os.utime(self._file)
            return stream
        return None

    def iter_traces(self, stream: BinaryIO) -> Iterator[Trace]:
        """Yield the samples of an entry, block by block, up to its end or the first damage.

        Raises:
            DamagedEntryError: what follows cannot be used. The entry is removed.
        """
        columns = _SharedColumns()
        try:
            while (head := _head(stream)) is not None:
                yield _trace(head, stream, columns)
        except (OSError, ValueError, LookupError, TypeError, MemoryError, SpatialReplayError) as error:
            with suppress(OSError):
                self._file.unlink(missing_ok=True)
            raise DamagedEntryError(str(error)) from None

    def writer(self) -> EntryWriter | None:
        """Return what writes the entry; None where the disk has no room for it."""
        most = min(_MOST_TIMES_LARGER * self.log.stat().st_size, self.limit // 2)
        with suppress(OSError):
            folder = self._file.parent
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if shutil.disk_usage(folder).free >= most + _SPARE_BYTES and _has_room(folder, self.limit - most):
                return EntryWriter(self._file, most, lambda: _key(self.log, self.concave) == self.key)
        return None


class DamagedEntryError(Exception):
    """An entry that cannot be used from here on."""


class EntryWriter:
    """Writes an entry block by block, and gives it its name at the end; for one reading of a log."""

    def __init__(self, file: Path, most_bytes: int, is_same: Callable[[], bool]) -> None:
        """Begin.

        Args:
            most_bytes: an entry that grows larger is given up.
            is_same: says whether the log is still what it was.

        Raises:
            OSError: the machine cannot write it.
        """
        self._file, self._left, self._is_same = file, most_bytes, is_same
        # readable for its owner alone, as the log may be
        descriptor, partial = tempfile.mkstemp(".partial", "", file.parent)
        self._partial: Path | None = Path(partial)
        self._stream = os.fdopen(descriptor, "wb", buffering=0)

    def add(self, trace: Trace) -> None:
        """Take in the next samples; with a fault or remark there will be no entry."""
        if trace.faults or trace.remarks:
            self.give_up()
        if self._partial is None or not len(trace):
            return
        parts = _encoded(trace)
        self._left -= sum(map(len, parts))
        if self._left < 0 or len(parts[1]) >= _HEAD_BYTES:
            self.give_up()
        self._write(parts)

    def finish(self) -> None:
        """Give the entry its name, unless the log has changed in the meantime."""
        self._write([_END])
        with suppress(OSError):
            if self._partial is not None and self._is_same():
                self._stream.close()
                self._partial.replace(self._file)
                self._partial = None
        self.give_up()

    def give_up(self) -> None:
        """Leave nothing behind of an entry without a name."""
        if self._partial is not None:
            self._stream.close()
            with suppress(OSError):
                self._partial.unlink()
            self._partial = None

    def _write(self, parts: Sequence[bytes | memoryview]) -> None:
        try:
            for part in parts:
                # the disk may take less than it is given
                rest = memoryview(part)
                while rest and self._partial is not None:
                    rest = rest[self._stream.write(rest) :]
        except OSError:
            self.give_up()


def _key(log: Path, concave: str) -> str:
    """Identify a log's content by what the file system says of it and by its two ends."""
    state = log.stat()
    digest = hashlib.sha256(
        json.dumps(
            [
                source_digest(),
                # splits polygons that are not convex
                version("shapely"),
                concave,
                *(state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns),
            ]
        ).encode()
    )
    with log.open("rb") as stream:
        digest.update(stream.read(_ENDS_BYTES))
        stream.seek(max(0, state.st_size - _ENDS_BYTES))
        digest.update(stream.read(_ENDS_BYTES))
    return digest.hexdigest()[:32]


def _encoded(trace: Trace) -> list[bytes | memoryview]:
    """Encode samples: a line of JSON, and the columns that are not in it."""
    shapes = trace.footprints
    columns: dict[str, _Column] = {"times_ns": trace.times_ns, "rows": trace.rows}
    columns |= {name: getattr(trace, name) for name in _OBSERVATIONS}
    columns |= {name: getattr(shapes, name) for name in _FOOTPRINTS}
    columns |= {f"signal {name}": values for name, values in trace.signals.items()}
    described: dict[str, list[int]] = {}
    parts: list[memoryview] = []
    checksum = 0
    for name, column in columns.items():
        words = column.reshape(-1).view(np.int64)
        progression = _progression(words)
        described[name] = [len(words), *progression]
        if len(words) and not progression:
            parts.append(words.data.cast("B"))
            checksum = crc32(words.data, checksum)
    head = {
        "names": trace.names,
        "classes": trace.classes,
        "signals": list(trace.signals),
        "columns": described,
        "checksum": checksum,
    }
    line = json.dumps(head).encode()
    return [b"%08x" % crc32(line), line, b"\n", *parts]


def _progression(words: NDArray[np.int64]) -> list[int]:
    """Return the first of some words and the step from each to the next, if they all have the same."""
    if len(words) < 2:
        return []
    first, step = int(words[0]), int(words[1]) - int(words[0])
    # a look at a few settles it for most columns; steps beyond int64 are none
    for stop in (min(len(words), 16), len(words)):
        if abs(step) >= 2**62 or (np.diff(words[:stop]) != step).any():
            return []
    return [first, step]


class _SharedColumns:
    """Columns that are arithmetic progressions, such as constant ones: many blocks have the same."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, int, int], NDArray[np.int64]] = {}

    def of(self, count: int, first: int, step: int) -> NDArray[np.int64]:
        """Return a progression, read-only."""
        words = self._known.get((count, first, step))
        if words is None:
            words = np.full(count, first) if step == 0 else first + step * np.arange(count, dtype=np.int64)
            words.flags.writeable = False
            if len(self._known) > 64:
                self._known.clear()
            self._known[count, first, step] = words
        return words


def _head(stream: BinaryIO) -> Mapping[str, Any] | None:
    """Read the line before the columns of a block; None at the end of the entry."""
    line = stream.readline(_HEAD_BYTES)
    if line == _END:
        return None
    if not line.endswith(b"\n") or int(line[:8], 16) != crc32(line[8:-1]):
        raise ValueError("a line breaks off")
    head: Mapping[str, Any] = json.loads(line[8:])
    return head


def _trace(head: Mapping[str, Any], stream: BinaryIO, shared: _SharedColumns) -> Trace:
    columns: dict[str, NDArray[np.int64]] = {}
    checksum = 0
    for name, (count, *progression) in head["columns"].items():
        if progression:
            columns[name] = shared.of(count, *progression)
            continue
        words = np.empty(count, np.int64)
        if count and stream.readinto(words.data.cast("B")) != words.nbytes:  # type: ignore[attr-defined]
            raise ValueError("a column breaks off")
        checksum = crc32(words.data, checksum)
        columns[name] = words
    if checksum != head["checksum"]:
        raise ValueError("the checksum does not fit")
    typed = {name: w if name in _INTEGERS else w.view(np.float64) for name, w in columns.items()}
    typed["vertices"] = typed["vertices"].reshape(-1, 2)
    return Trace(
        times_ns=columns["times_ns"],
        names=tuple(head["names"]),
        rows=columns["rows"].reshape(len(columns["times_ns"]), -1),
        footprints=FootprintBatch(**{name: typed[name] for name in _FOOTPRINTS}),  # type: ignore[arg-type]
        **{name: typed[name] for name in _OBSERVATIONS},  # type: ignore[arg-type]
        classes=tuple(head["classes"]),
        signals={name: typed[f"signal {name}"] for name in head["signals"]},  # type: ignore[misc]
    )


def _has_room(folder: Path, room: int) -> bool:
    """Remove the entries, and what writers left, that were not used for longest, until the others fit.

    Returns:
        whether they do. What was used lately stays: many logs that are read in turn would only push out each
        other, each written for nothing.
    """
    entries = []
    for file in folder.iterdir():
        with suppress(OSError):
            state = file.stat()
            entries.append((state.st_mtime, file, state.st_size))
    total = sum(size for *_, size in entries)
    latest = time.time() - _LATELY_S
    for used_s, file, size in sorted(entries):
        if total <= room or used_s > latest:
            break
        with suppress(OSError):
            file.unlink()
        total -= size
    return total <= room

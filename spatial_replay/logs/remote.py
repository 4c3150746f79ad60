"""Logs at addresses: byte ranges, downloads, and folders in buckets."""

from __future__ import annotations

import hashlib
import io
import logging
import os
import shutil
import tempfile
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import timedelta
from fnmatch import fnmatchcase
from functools import lru_cache
from itertools import pairwise
from os import PathLike, fspath
from pathlib import Path
from threading import Lock
from types import MappingProxyType
from typing import Any, BinaryIO, Final, TypeAlias, TypeVar, cast
from urllib.parse import unquote, urlsplit

from spatial_replay.errors import (
    LogError,
    MissingFileError,
    OutputError,
    RemoteError,
    SpatialReplayError,
    UsageError,
    importing,
)
from spatial_replay.logs.output_file import output_error

Range: TypeAlias = tuple[int, int]
"""Byte range [begin, end)."""

_BATCH_BYTES: Final = 2**26
"""Largest total size of planned ranges that are fetched as one batch, bytes. A larger total is split into
batches, which grow from a 32nd to half of this size."""
MOST_HELD_BYTES: Final = 2**28
"""Size of the cache of a remote file, bytes."""
_WASTE: Final = 0.08
"""Largest share of unused bytes, which are read between ranges to save requests."""


class RangeStream(io.RawIOBase):
    """A stream of a remote file, which fetches planned ranges in batches."""

    def __init__(self, file: RemoteFile) -> None:
        super().__init__()
        self._file = file
        self._position = 0
        self._batches: list[list[Range]] = []
        self._batch_of: dict[int, int] = {}
        self._fetching: dict[int, Future[None]] = {}
        self._thread: ThreadPoolExecutor | None = None

    def plan(self, ranges: Iterable[Range]) -> None:
        """Announce the next ranges to be read, in their order.

        A batch is fetched when one of its ranges is read. From the second batch on, the next batch is fetched
        in advance.
        """
        batch, batch_bytes, batch_limit = list[Range](), 0, _BATCH_BYTES
        planned_ranges = list(ranges)
        if sum(end - begin for begin, end in planned_ranges) > _BATCH_BYTES:
            # a small first batch, because the reader may stop after the first messages
            batch_limit = _BATCH_BYTES // 32
        for begin, end in planned_ranges:
            batch.append((begin, end))
            self._batch_of.setdefault(begin, len(self._batches))
            batch_bytes += end - begin
            if batch_bytes >= batch_limit:
                self._batches.append(batch)
                batch, batch_bytes, batch_limit = [], 0, min(4 * batch_limit, _BATCH_BYTES // 2)
        if batch:
            self._batches.append(batch)

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base_offset = {os.SEEK_SET: 0, os.SEEK_CUR: self._position}.get(whence)
        self._position = (self._file.size if base_offset is None else base_offset) + offset
        return self._position

    def read(self, size: int = -1) -> bytes:
        end = self._file.size if size < 0 else self._position + size
        if (batch_number := self._batch_of.get(self._position)) is not None:
            self._fetch(batch_number)
        data = self._file.read(self._position, end)
        self._position += len(data)
        return data

    def close(self) -> None:
        if self._thread is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)
        super().close()

    def _fetch(self, index: int) -> None:
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "remote-batches")
        # the first batch is fetched alone, because a search for the first sample needs no other
        for batch_index in range(index, min(index + 1 + bool(index), len(self._batches))):
            if batch_index not in self._fetching:
                self._fetching[batch_index] = self._thread.submit(
                    self._file.fetch, self._batches[batch_index]
                )
        self._fetching[index].result()


_Item = TypeVar("_Item")
_Read = TypeVar("_Read")


def each_ahead(
    read: Callable[[_Item], _Read],
    items: Iterable[_Item],
    at_once: int = 1,
    most: int = 0,
    size: Callable[[_Item], int] = lambda _: 1,
) -> Iterator[_Read]:
    """Yield `read(item)` of each item, in order, while threads read the next items.

    One item per thread is always read ahead. Further items are read ahead up to the total size `most`, but
    at most twice the size of the items yielded so far. So a caller that takes only the first item reads few
    items.
    """
    threads = ThreadPoolExecutor(at_once, "reading-ahead")
    pending_reads: deque[tuple[int, Future[_Read]]] = deque()
    ahead_size = yielded_size = 0
    try:
        for item in items:
            pending_reads.append((size(item), threads.submit(read, item)))
            ahead_size += size(item)
            # with `most` as the only limit, up to 39 % of a log were read for a window of one second
            while ahead_size > min(most, 2 * yielded_size) and len(pending_reads) > at_once:
                first_size, future = pending_reads.popleft()
                ahead_size -= first_size
                yielded_size += first_size
                yield future.result()
        while pending_reads:
            yield pending_reads.popleft()[1].result()
    finally:
        # garbage collection may close this generator while a thread starts; a wait would block that thread
        threads.shutdown(wait=False, cancel_futures=True)


def plan_reads(stream: BinaryIO, ranges: Iterable[Range]) -> None:
    """Announce the next ranges to be read from a stream of a remote file; do nothing for other streams."""
    if isinstance(stream, RangeStream):
        stream.plan(ranges)


def joined_ranges(ranges: Sequence[Range]) -> list[Range]:
    """Return sorted ranges, joined over the smallest gaps; joining adds at most `_WASTE` of their bytes."""
    sorted_ranges = sorted(span for span in ranges if span[1] > span[0])
    needed_bytes = sum(end - begin for begin, end in sorted_ranges)
    gaps = sorted((after[0] - before[1], i) for i, (before, after) in enumerate(pairwise(sorted_ranges)))
    bridged_gaps, wasted_bytes = set[int](), 0
    for gap, index in gaps:
        wasted_bytes += max(gap, 0)
        if wasted_bytes > _WASTE * needed_bytes:
            break
        bridged_gaps.add(index)
    merged_ranges: list[Range] = []
    for index, (begin, end) in enumerate(sorted_ranges):
        if index - 1 in bridged_gaps:
            merged_ranges[-1] = (merged_ranges[-1][0], max(merged_ranges[-1][1], end))
        else:
            merged_ranges.append((begin, end))
    return merged_ranges


class HeldBytes:
    """Cached parts of a file, without overlap; the oldest are evicted above `MOST_HELD_BYTES`."""

    def __init__(self) -> None:
        self._begins: list[int] = []
        self._parts: dict[int, bytes] = {}
        self._size = 0

    def missing(self, begin: int, end: int) -> list[Range]:
        """Return the parts of a range that are not held."""
        missing_ranges = []
        for start, data in self._overlapping(begin, end):
            if start > begin:
                missing_ranges.append((begin, start))
            begin = max(begin, start + len(data))
        return [*missing_ranges, (begin, end)] if begin < end else missing_ranges

    def read(self, begin: int, end: int) -> bytes:
        """Return the bytes of a range that is held."""
        return b"".join(
            data[max(begin - start, 0) : end - start] for start, data in self._overlapping(begin, end)
        )

    def add(self, begin: int, data: bytes) -> None:
        """Store the bytes of a part that are not held yet."""
        for start, end in self.missing(begin, begin + len(data)):
            self._begins.insert(bisect_right(self._begins, start), start)
            self._parts[start] = data[start - begin : end - begin]
            self._size += end - start
        while len(self._parts) > 1 and self._size > MOST_HELD_BYTES:
            # dicts keep the order of insertion
            oldest_start = next(iter(self._parts))
            self._size -= len(self._parts.pop(oldest_start))
            self._begins.remove(oldest_start)

    def _overlapping(self, begin: int, end: int) -> list[tuple[int, bytes]]:
        """Return the parts that overlap a range, in order, each with its offset in the file."""
        first_index = max(bisect_right(self._begins, begin) - 1, 0)
        cached_parts = (
            (start, self._parts[start])
            for start in self._begins[first_index : bisect_left(self._begins, end)]
        )
        return [(start, data) for start, data in cached_parts if start + len(data) > begin]


_CREDENTIALS: Final = {
    "s3": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket",
    "gs": "set GOOGLE_SERVICE_ACCOUNT, or GOOGLE_SKIP_SIGNATURE=true for a public bucket",
    "az": "set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
    "https": "give an address that may be read without a password",
    "http": "give an address that may be read without a password",
}
"""Remedies for denied access, by the scheme of an address."""

_SETTINGS: Final = ("AWS_", "GOOGLE_", "AZURE_")
"""Prefixes of the environment variables that configure access to buckets."""

BAG_METADATA: Final = "metadata.yaml"
"""Metadata file in the folder of a ROS 2 bag, which lists the other files."""
_REASONS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "request or response body error": "the connection breaks off",
        "error sending request": "the server does not answer",
    }
)
"""Plain words for messages of obstore."""
WEB_SCHEMES: Final = ("http", "https")

_TAIL_BYTES: Final = 2**19
"""First read at the end of a file, bytes; it usually holds the whole index of a log of a gigabyte."""
_HEAD_BYTES: Final = 2**16
"""First read at the beginning of a file, bytes: its format and first records."""
_LEAST_BYTES: Final = 2**16
"""Least number of bytes in a read, except at the end of the file."""
_PIECE_BYTES: Final = 2**23
"""Largest request, bytes."""
_AT_ONCE: Final = 32
_ATTEMPTS: Final = 3
_RETRIES: Final[Any] = {
    "max_retries": 6,
    "retry_timeout": timedelta(seconds=60),
    "backoff": {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=5), "base": 2},
}
_CLIENT: Final[Any] = {"allow_http": True, "connect_timeout": "10s", "timeout": "120s"}


def is_address(path: object) -> bool:
    """Return whether a path is an address, such as s3://bucket/run.mcap."""
    return isinstance(path, RemoteFile) or (
        isinstance(path, str) and path.partition("://")[0] in _CREDENTIALS
    )


def is_web(file: PathLike[str]) -> bool:
    """Return whether a file is at the address of a web server."""
    return fspath(file).startswith(("http://", "https://"))


def log_file(path: str | PathLike[str]) -> LogFile:
    """Return the file of a path or an address; an address that ends with "/" is the folder of a ROS 2 bag.

    Raises:
        UsageError: an address without a name, or obstore is not installed.
    """
    if isinstance(path, RemoteFile):
        return path
    if not is_address(path):
        return Path(path)
    address = fspath(path)
    return RemoteFile(f"{address}{BAG_METADATA}" if address.endswith("/") else address)


def sendable(path: str | PathLike[str]) -> Path | str:
    """Return a file in a form for other processes: an address is sent as text, without a connection."""
    return fspath(path) if is_address(path) else Path(path)


def local_files(paths: Iterable[str | PathLike[str]]) -> list[Path]:
    """Return the paths that are on this machine, without addresses."""
    return [Path(path) for path in paths if not is_address(path)]


@dataclass(frozen=True, slots=True)
class FileVersion:
    """Identity of the content of a remote file.

    Attributes:
        size: size in bytes.
        tag: entity tag or date of the content; None if the server gives neither.
        has_ranges: whether the server answers range requests.
    """

    size: int
    tag: str | None
    has_ranges: bool = True

    @property
    def is_exact(self) -> bool:
        """Whether equal versions have equal bytes, which only a strong entity tag guarantees."""
        # a weak tag begins with W/: https://www.rfc-editor.org/rfc/rfc9110#section-8.8.3
        return self.tag is not None and self.tag.startswith('"')


class RemoteFile(PathLike[str]):
    """A file at an address, with its version and a cache of at most 256 MiB.

    A change of the file after the first read is an error; two versions are never mixed. All methods are
    thread-safe.
    """

    def __init__(self, address: str) -> None:
        """Store an address; nothing is read yet.

        Raises:
            UsageError: the address names no file, or obstore is not installed.
        """
        url = urlsplit(address)
        self._scheme = url.scheme
        self._address = address
        if self._scheme in WEB_SCHEMES:
            # the query after the path may be a signature, which is a secret
            self._public_address = f"{url.scheme}://{url.netloc.rpartition('@')[2]}{url.path}"
            self._key, bucket, name = "", address, unquote(url.path).rpartition("/")[2]
        else:
            self._public_address = address
            bucket, _, self._key = address.partition("://")[2].partition("/")
            name = self._key.rpartition("/")[2]
        if not name or not url.netloc:
            raise UsageError(
                f"{self._public_address} names no file; give the address of one log, such as s3://bucket/run.mcap"
            )
        _refuse_empty_parts(self._public_address, self._key)
        self.name = name
        self._obstore = obstore_library()
        self._store = open_store(self._scheme, bucket)
        self._held_bytes = HeldBytes()
        # two locks, because the first read holds `_opening` and may take `_lock` in `fetch`
        self._lock, self._opening = Lock(), Lock()
        self._version: FileVersion | None = None

    def __fspath__(self) -> str:
        return self._address

    def __str__(self) -> str:
        return self._public_address

    def __repr__(self) -> str:
        return f"RemoteFile({self._public_address!r})"

    @property
    def version(self) -> FileVersion:
        """Version at the first read, which reads the end and the beginning of the file in parallel.

        Raises:
            MissingFileError: there is no such file, or access is denied.
            RemoteError: the file cannot be read.
        """
        with self._opening:
            if self._version is None:
                self._version = self._read_ends()
            return self._version

    @property
    def size(self) -> int:
        """Size in bytes; raises the errors of `version`."""
        return self.version.size

    def current_version(self) -> FileVersion:
        """Request the version without the content; return `version` if the server refuses the request.

        Raises:
            MissingFileError, RemoteError: the file cannot be read.
        """
        try:
            return self._version_of(self._get({"head": True}).meta)
        except SpatialReplayError:
            # a signed address may allow GET only, not HEAD
            return self.version

    def open(self) -> BinaryIO:
        """Open a new stream for reading."""
        return cast(BinaryIO, RangeStream(self))

    def read(self, begin: int, end: int) -> bytes:
        """Return the bytes of a range; fewer at the end of the file.

        Raises:
            MissingFileError, RemoteError: the file cannot be read, or has changed.
        """
        end = min(end, self.version.size)
        # a read of more than half of the cache is not cached, because it would evict its own beginning
        if end - begin > MOST_HELD_BYTES // 2:
            starts = range(begin, end, _PIECE_BYTES)
            return b"".join(self.iter_pieces([(start, min(start + _PIECE_BYTES, end)) for start in starts]))
        while True:
            with self._lock:
                missing_ranges = self._held_bytes.missing(begin, end)
                if not missing_ranges:
                    return self._held_bytes.read(begin, end)
            first_byte, end_byte = missing_ranges[0][0], missing_ranges[-1][1]
            self.fetch([(first_byte, min(max(end_byte, first_byte + _LEAST_BYTES), self.version.size))])

    def fetch(self, ranges: Iterable[Range]) -> None:
        """Read the missing parts of ranges in parallel; nearby parts are joined."""
        with self._lock:
            missing_ranges = [gap for begin, end in ranges for gap in self._held_bytes.missing(begin, end)]
        pieces = [
            (begin, min(begin + _PIECE_BYTES, end))
            for range_begin, end in joined_ranges(missing_ranges)
            for begin in range(range_begin, end, _PIECE_BYTES)
        ]
        for (begin, _), data in zip(pieces, self.iter_pieces(pieces), strict=True):
            with self._lock:
                self._held_bytes.add(begin, data)

    def iter_pieces(self, pieces: Sequence[Range], at_once: int = _AT_ONCE) -> Iterator[bytes]:
        """Read ranges in parallel, and yield their bytes in order, without caching them."""
        return each_ahead(self._range, pieces, at_once)

    def iter_whole(self) -> Iterator[bytes]:
        """Read the whole file in parts, in order."""
        version = self.version
        if version.has_ranges:
            starts = range(0, version.size, _PIECE_BYTES)
            pieces = [(begin, min(begin + _PIECE_BYTES, version.size)) for begin in starts]
            yield from self.iter_pieces(pieces, at_once=8)
            return
        try:
            yield from map(bytes, self._get({}).stream(min_chunk_size=2**20))
        except self._obstore.exceptions.BaseError as error:
            raise store_failure(self._public_address, self._scheme, error) from None

    def _read_ends(self) -> FileVersion:
        """Read the end and the beginning in parallel; return the version."""
        with ThreadPoolExecutor(1, "remote-reading") as thread:
            head_read = thread.submit(self._part, {"range": (0, _HEAD_BYTES)})
            try:
                version, begin, tail = self._part({"range": {"suffix": _TAIL_BYTES}})
                head_version, _, beginning = head_read.result()
            except self._obstore.exceptions.NotSupportedError:
                return self._without_suffix(head_read)
        if head_version != version:
            raise self._replacement_error()
        self._held_bytes.add(begin, tail)
        self._held_bytes.add(0, beginning)
        return version

    def _without_suffix(self, head_read: Future[tuple[FileVersion, int, bytes]]) -> FileVersion:
        """Return the version from a server that refuses suffix ranges (Azure), or all ranges."""
        try:
            version, _, beginning = head_read.result()
        except self._obstore.exceptions.NotSupportedError:
            return self._version_of(self._get({"head": True}).meta, has_ranges=False)
        self._held_bytes.add(0, beginning)
        self._version = version
        self.fetch([(max(0, version.size - _TAIL_BYTES), version.size)])
        return version

    def _range(self, requested: Range) -> bytes:
        """Read a range; a change of the file since the first read is an error."""
        version_before = self._version
        # If-Match refuses weak tags, so the tag of the answer is compared too:
        # https://www.rfc-editor.org/rfc/rfc9110#section-13.1.1
        condition = {"if_match": version_before.tag} if version_before and version_before.is_exact else {}
        version, _, data = self._part({"range": requested, **condition})
        if version != version_before or len(data) != requested[1] - requested[0]:
            raise self._replacement_error()
        return data

    def _part(self, options: dict[str, Any]) -> tuple[FileVersion, int, bytes]:
        """Request a part; return the version, the offset of its bytes, and the bytes."""
        for attempt in range(1, _ATTEMPTS + 1):
            answer = self._get(options)
            try:
                data = bytes(answer.bytes())
                if len(data) == answer.range[1] - answer.range[0]:
                    return self._version_of(answer.meta), answer.range[0], data
                error: Exception = EOFError("the connection breaks off")
            except self._obstore.exceptions.BaseError as failure:
                error = failure
            # obstore repeats failed requests, but not answers that break off
            if attempt == _ATTEMPTS:
                raise store_failure(self._public_address, self._scheme, error) from None
        raise AssertionError

    def _get(self, options: dict[str, Any]) -> Any:
        exceptions = self._obstore.exceptions
        try:
            return self._obstore.get(self._store, self._key, options=cast(Any, options))
        except exceptions.NotSupportedError:
            raise
        except exceptions.PreconditionError:
            raise self._replacement_error() from None
        except (OSError, ValueError, exceptions.BaseError) as error:
            raise store_failure(self._public_address, self._scheme, error) from None

    @staticmethod
    def _version_of(meta: Any, *, has_ranges: bool = True) -> FileVersion:
        modified_at = meta["last_modified"]
        # obstore gives the epoch for an answer without a date
        date = modified_at.isoformat() if modified_at and modified_at.timestamp() > 0 else None
        return FileVersion(meta["size"], meta["e_tag"] or date, has_ranges)

    def _replacement_error(self) -> RemoteError:
        return RemoteError(f"{self._public_address} was replaced while it was read; run the command again")


LogFile: TypeAlias = Path | RemoteFile
"""The file of a log, on this machine or at an address."""


def open_file(file: LogFile) -> BinaryIO:
    """Open the file of a log for reading."""
    return file.open() if isinstance(file, RemoteFile) else file.open("rb")


def file_size(file: LogFile) -> int:
    """Return the size of a log's file in bytes."""
    return file.size if isinstance(file, RemoteFile) else file.stat().st_size


def obstore_library() -> Any:
    """Return obstore.

    Raises:
        UsageError: obstore is not installed.
    """
    with importing("addresses need obstore", extra="remote"):
        import obstore
        import obstore.exceptions
        import obstore.store
    return obstore


def open_store(scheme: str, bucket: str) -> Any:
    """Return the store of a bucket, a container or a web address; nothing is read yet.

    A process has one store for each bucket, to reuse its connections.

    Raises:
        RemoteError: obstore refuses the name or the settings.
    """
    settings = tuple(sorted(setting for setting in os.environ.items() if setting[0].startswith(_SETTINGS)))
    return _store(scheme, bucket, settings)


@lru_cache(maxsize=32)
def _store(scheme: str, bucket: str, settings: tuple[tuple[str, str], ...]) -> Any:
    """Return the store of a bucket; obstore reads the environment, so `settings` are only a cache key."""
    stores = obstore_library().store
    options: dict[str, Any] = {"client_options": _CLIENT, "retry_config": _RETRIES}
    open_bucket = {"s3": stores.S3Store, "gs": stores.GCSStore, "az": stores.AzureStore}.get(scheme)
    try:
        return open_bucket(bucket, **options) if open_bucket else stores.HTTPStore.from_url(bucket, **options)
    except (ValueError, obstore_library().exceptions.BaseError) as error:
        raise store_failure(
            f"{scheme}://{bucket.partition('?')[0].rpartition('/')[2]}", scheme, error
        ) from None


_EMPTY_PART: Final = "cannot be read: // or a leading / in its key; copy it to a key without an empty part"


def _refuse_empty_parts(address: str, key: str) -> None:
    """Refuse a key that obstore cannot read or reads as another key.

    Raises:
        UsageError: the key has an empty part.
    """
    if key.startswith("/") or "//" in key:
        raise UsageError(f"{address} {_EMPTY_PART}")


def store_failure(address: str, scheme: str, error: Exception, action: str = "read") -> SpatialReplayError:
    """Return the error for a failed read or write at an address, with a remedy."""
    exceptions = obstore_library().exceptions
    if isinstance(error, FileNotFoundError):
        return MissingFileError(f"{address}: there is no such file; check the address")
    if isinstance(error, (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError)):
        return MissingFileError(f"{address}: access denied; {_CREDENTIALS[scheme]}")
    message = str(error).partition("\n")[0].strip()
    if "empty path segment" in message:
        key = message.partition('"')[2].rpartition('"')[0]
        return RemoteError(f"{address}: the object {key!r} {_EMPTY_PART}, or name a folder without it")
    if "404 " in message:
        return MissingFileError(f"{address}: there is no such bucket; check the address")
    if "416 " in message:
        return RemoteError(f"{address} is empty; give a log with at least one sample")
    reason = fspath(message).rpartition(" - ")[2].partition(": <")[0].rstrip(":")
    reason = _REASONS.get(reason.rpartition("HTTP error: ")[2], reason)
    remedy = "the address" if scheme in WEB_SCHEMES else f"the credentials: {_CREDENTIALS[scheme]}"
    return RemoteError(f"{address} cannot be {action}: {reason}; check the network and {remedy}")


_LOG: Final = logging.getLogger("spatial_replay")
_LIMIT: Final = "SPATIAL_REPLAY_DOWNLOADS"
_GIGABYTE: Final = 10**9
_DEFAULT_GIGABYTES: Final = 20.0


Show: TypeAlias = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Progress factory: (label, total) → context manager that yields `advance(steps)`."""
_shows: Final[ContextVar[Show | None]] = ContextVar("shows", default=None)


@contextmanager
def showing_downloads(show: Show) -> Iterator[None]:
    """Show the progress of downloads of this thread, as a context."""
    token = _shows.set(show)
    try:
        yield
    finally:
        _shows.reset(token)


def local_copy(path: str | PathLike[str]) -> Path:
    """Return a local path unchanged, or a local copy of a small file at an address, such as a specification.

    Raises:
        UsageError: an address that names no file, or obstore is not installed.
        LogError: the file exceeds the limit of all copies.
        MissingFileError, RemoteError: the file cannot be read.
        OutputError: the copy cannot be written.
    """
    file = log_file(path)
    return download(file) if isinstance(file, RemoteFile) else file


def download(file: RemoteFile, reason: str = "") -> Path:
    """Return a local copy of a remote file; each version is downloaded once.

    The least recently used copies are removed above 20 GB, or SPATIAL_REPLAY_DOWNLOADS gigabytes.

    Args:
        reason: reason for the download, for a warning; "" for no warning.

    Raises:
        LogError: the file exceeds the limit of all copies.
        MissingFileError, RemoteError: the file cannot be read.
        OutputError: the copy cannot be written.
    """
    return download_files([file], str(file), reason) / _name(file)


def download_files(files: Sequence[RemoteFile], address: str, reason: str, below: str = "") -> Path:
    """Return a local folder with copies of remote files; see `download`.

    Args:
        address: address of the remote folder, for messages.
        below: name of the local folder; "" for any name.
    """
    versions, limit_bytes = [file.version for file in files], gigabytes(_LIMIT, _DEFAULT_GIGABYTES)
    size = sum(version.size for version in versions)
    downloads_folder = user_cache_folder("downloads")
    # the folder's name depends on the version, so that each version has its own copy
    version_texts = [f"{os.fspath(file)}\n{file.version.tag}\n{file.version.size}" for file in files]
    folder = downloads_folder / hashlib.sha256("\n".join(version_texts).encode()).hexdigest()[:32]
    # without a strong tag, a copy may be outdated, so the file is downloaded again
    if all(version.is_exact for version in versions) and all(
        _has(folder / below / _name(file), file.version.size) for file in files
    ):
        with suppress(OSError):
            # a folder's time is the time of its last use, see `_make_room`
            os.utime(folder)
        return folder / below
    if size > limit_bytes:
        raise LogError(
            f"{address} has {size / _GIGABYTE:.2f} GB, but downloads are limited to"
            f" {limit_bytes / _GIGABYTE:g} GB; set {_LIMIT} to more gigabytes, or copy the log to this"
            " machine"
        )
    if reason:
        _LOG.warning("%s: downloading %.1f MB once, to %s: %s", address, size / 1e6, downloads_folder, reason)
    show = _shows.get()
    try:
        downloads_folder.mkdir(parents=True, exist_ok=True)
        _make_room(downloads_folder, limit_bytes - size)
        # renamed when it is complete, so that no process reads a partial copy
        partial_folder = Path(tempfile.mkdtemp(".partial", "", downloads_folder))
        try:
            (partial_folder / below).mkdir(exist_ok=True)
            with nullcontext(lambda size: None) if show is None else show("downloading", size) as advance:
                for file in files:
                    _write(file, partial_folder / below / _name(file), advance)
            shutil.rmtree(folder, ignore_errors=True)
            # another process has made the same copy
            with suppress(FileExistsError):
                partial_folder.rename(folder)
        finally:
            shutil.rmtree(partial_folder, ignore_errors=True)
    except OSError as error:
        raise output_error(folder, error) from error
    return folder / below


def _name(file: RemoteFile) -> str:
    return file.name.replace("/", "_") or "log"


def _has(copy: Path, size: int) -> bool:
    return copy.is_file() and copy.stat().st_size == size


def _write(file: RemoteFile, copy: Path, advance: Callable[[int], None]) -> None:
    received_bytes = 0
    with copy.open("wb") as stream:
        for part in file.iter_whole():
            received_bytes += len(part)
            if received_bytes > file.version.size:
                break
            stream.write(part)
            advance(len(part))
    if received_bytes != file.version.size:
        raise LogError(
            f"{file}: {received_bytes} bytes came instead of {file.version.size}; run the command again"
        )


def _make_room(downloads_folder: Path, room_bytes: int) -> None:
    """Remove the least recently used copies until the other copies fit into `room_bytes`."""
    copies = []
    for folder in downloads_folder.iterdir():
        with suppress(OSError):
            copy_bytes = sum(path.stat().st_size for path in folder.rglob("*"))
            copies.append((folder.stat().st_mtime, folder.name, copy_bytes))
    total_bytes = sum(copy_bytes for *_, copy_bytes in copies)
    for _, name, copy_bytes in sorted(copies):
        if total_bytes <= room_bytes:
            return
        shutil.rmtree(downloads_folder / name, ignore_errors=True)
        total_bytes -= copy_bytes


def user_cache_folder(name: str) -> Path:
    """Return a folder in the cache of the user.

    Raises:
        RuntimeError: the user has no home folder.
    """
    if folder := os.environ.get("SPATIAL_REPLAY_CACHE"):
        return Path(folder).absolute() / name
    # relative paths are ignored: https://specifications.freedesktop.org/basedir-spec/latest/
    parent = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (parent if parent.is_absolute() else Path.home() / ".cache") / "spatial-replay" / name


def gigabytes(variable: str, otherwise: float) -> int:
    """Convert the gigabytes in an environment variable to bytes.

    Raises:
        UsageError: the variable is not a number of at least 0.
    """
    text = os.environ.get(variable, str(otherwise))
    try:
        byte_count = int(float(text) * _GIGABYTE)
    except (ValueError, OverflowError):
        byte_count = -1
    if byte_count < 0:
        raise UsageError(f"{variable} is {text!r}; give a number of gigabytes")
    return byte_count


_FILES_AT_ONCE: Final = 32


class RemoteFolder:
    """A folder in a bucket. One request writes a whole file, so there are no partial files.

    Names of files are relative to the folder. All methods are thread-safe.
    """

    def __init__(self, address: str) -> None:
        """Store an address such as "s3://bucket/folder/"; nothing is read yet.

        Raises:
            UsageError: a web address, an address without a bucket, or obstore is not installed.
        """
        self._scheme, _, path = address.partition("://")
        if self._scheme in WEB_SCHEMES:
            raise UsageError(
                "a web server neither lists nor takes files; give a folder of a bucket, such as "
                "s3://bucket/results, or one on this machine"
            )
        bucket, _, key = path.partition("/")
        if not bucket:
            raise UsageError(f"{address} names no bucket; give one, such as s3://bucket/results")
        folder = key.strip("/")
        self.location: Final = f"{self._scheme}://{bucket}/{folder}".rstrip("/")
        self._prefix = f"{folder}/" if folder else ""
        self._library = obstore_library()
        self._store = open_store(self._scheme, bucket)
        self._failures = (OSError, ValueError, self._library.exceptions.BaseError)

    def __str__(self) -> str:
        return self.location

    def exists(self) -> bool:
        """Return whether the folder holds a file."""
        return next(self._keys(""), None) is not None

    def names(self, below: str = "") -> list[str]:
        """Return the sorted names of all files in the folder, or in its subfolder `below`.

        Raises:
            MissingFileError, RemoteError: the folder cannot be listed.
        """
        return sorted(key.removeprefix(self._prefix) for key in self._keys(below))

    def read(self, names: Sequence[str]) -> Iterator[bytes]:
        """Read files in parallel, and yield their contents in order.

        Raises:
            MissingFileError: a file is missing; another `batch` may have merged it into another file.
            UsageError: access is denied, or there is no such bucket.
            RemoteError: a file cannot be read.
        """
        return each_ahead(self._read, names, _FILES_AT_ONCE)

    def write(self, name: str, data: bytes) -> None:
        """Write a file; after a failure, its previous content is unchanged.

        Raises:
            OutputError: the file cannot be written.
        """
        try:
            self._library.put(self._store, self._prefix + name, data)
        except self._failures as error:
            address = f"{self.location}/{name}"
            raise OutputError(str(store_failure(address, self._scheme, error, "written"))) from None

    def remove(self, names: Iterable[str]) -> None:
        """Remove files; a missing file is no error.

        Raises:
            OutputError: a file cannot be removed.
        """
        keys = [self._prefix + name for name in names]
        try:
            if keys:
                self._library.delete(self._store, keys)
        except FileNotFoundError:
            return
        except self._failures as error:
            raise OutputError(str(store_failure(self.location, self._scheme, error, "written"))) from None

    def _keys(self, below: str) -> Iterator[str]:
        try:
            for page in self._library.list(self._store, self._prefix + below or None):
                yield from (entry["path"] for entry in page)
        except self._failures as error:
            raise store_failure(self.location, self._scheme, error) from None

    def _read(self, name: str) -> bytes:
        try:
            return bytes(self._library.get(self._store, self._prefix + name).bytes())
        except self._failures as error:
            failure = store_failure(f"{self.location}/{name}", self._scheme, error)
            is_denied = isinstance(failure, MissingFileError) and not isinstance(error, FileNotFoundError)
            raise UsageError(str(failure)) if is_denied else failure from None


def matching_addresses(pattern: str) -> list[str]:
    """Return the sorted addresses of files in a bucket or container that match a pattern.

    Args:
        pattern: such as "s3://fleet/2026-11/*.mcap"; a pattern that ends with "/" matches all files below.

    Raises:
        UsageError: a web server cannot list its files.
        MissingFileError, RemoteError: the bucket cannot be read.
    """
    scheme, _, path = pattern.partition("://")
    if scheme in WEB_SCHEMES:
        raise UsageError(f"{pattern}: web servers do not list their files; give each address")
    bucket, _, key = path.partition("/")
    _refuse_empty_parts(pattern, key)
    wildcard = min((key.find(sign) for sign in "*?[" if sign in key), default=len(key))
    folder, key_pattern = (
        key[:wildcard].rpartition("/")[0],
        key + "*" if key.endswith("/") or not key else key,
    )
    object_names = RemoteFolder(f"{scheme}://{bucket}").names(folder)
    return [f"{scheme}://{bucket}/{name}" for name in object_names if fnmatchcase(name, key_pattern)]

"""Files at addresses: s3://, gs://, az://, https://. Only the ranges of bytes that are needed are moved.

The only importer of obstore, which knows the services, and takes credentials from the environment as their
own tools do (AWS_ACCESS_KEY_ID, GOOGLE_SERVICE_ACCOUNT, AZURE_STORAGE_ACCOUNT_NAME and so on).
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache
from os import PathLike, fspath
from pathlib import Path
from threading import Lock
from types import MappingProxyType
from typing import Any, BinaryIO, Final, TypeAlias, cast
from urllib.parse import unquote, urlsplit

from spatial_replay.errors import MissingFileError, RemoteError, SpatialReplayError, UsageError, importing
from spatial_replay.logs.byte_ranges import MOST_HELD_BYTES, HeldBytes, Range, RangeStream, joined_ranges

_CREDENTIALS: Final = {
    "s3": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket",
    "gs": "set GOOGLE_SERVICE_ACCOUNT, or GOOGLE_SKIP_SIGNATURE=true for a public bucket",
    "az": "set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
    "https": "give an address that may be read without a password",
    "http": "give an address that may be read without a password",
}
"""What helps where access is denied, by the scheme of an address."""

_SETTINGS: Final = ("AWS_", "GOOGLE_", "AZURE_")
"""How the names of the environment variables begin that the services' libraries read."""

BAG_METADATA: Final = "metadata.yaml"
"""The file that makes a folder a ROS 2 bag, and lists its other files."""
_REASONS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "request or response body error": "the connection breaks off",
        "error sending request": "the server does not answer",
    }
)
"""What the library says, in other words."""
WEB_SCHEMES: Final = ("http", "https")

_TAIL_BYTES: Final = 2**19
"""Bytes at the end of a file that are read first: the index of a log of a gigabyte mostly fits."""
_HEAD_BYTES: Final = 2**16
"""Bytes at its beginning that are read at the same time: the format, and what was written first."""
_LEAST_BYTES: Final = 2**16
_PIECE_BYTES: Final = 2**23
_AT_ONCE: Final = 32
_ATTEMPTS: Final = 3
_RETRIES: Final[Any] = {
    "max_retries": 6,
    "retry_timeout": timedelta(seconds=60),
    "backoff": {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=5), "base": 2},
}
_CLIENT: Final[Any] = {"allow_http": True, "connect_timeout": "10s", "timeout": "120s"}


def is_address(path: object) -> bool:
    """Return whether a path is an address of another machine."""
    return isinstance(path, RemoteFile) or (
        isinstance(path, str) and path.partition("://")[0] in _CREDENTIALS
    )


def is_web(file: PathLike[str]) -> bool:
    """Return whether a file is at the address of a web server."""
    return fspath(file).startswith(("http://", "https://"))


def log_file(path: str | PathLike[str]) -> LogFile:
    """Return the file of a path or an address; a folder at an address is a ROS 2 bag, known by its metadata.

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
    """Return a file as other processes take it: the text of an address opens nothing."""
    return fspath(path) if is_address(path) else Path(path)


def local_files(paths: Iterable[str | PathLike[str]]) -> list[Path]:
    """Return the paths among some that are on this machine."""
    return [Path(each) for each in paths if not is_address(each)]


@dataclass(frozen=True, slots=True)
class FileVersion:
    """What identifies the content of a remote file.

    Attributes:
        size: in bytes.
        tag: changes with the content; None if the server gives none.
        has_ranges: whether the server gives parts of it.
    """

    size: int
    tag: str | None
    has_ranges: bool = True


class RemoteFile(PathLike[str]):
    """A file at an address. Holds its version and, up to 256 MiB, what was read of it lately.

    A change after the first read is an error, never a mixture of two versions. Several threads may use it.
    """

    def __init__(self, address: str) -> None:
        """Take an address; nothing is read yet.

        Raises:
            UsageError: it has no name, or obstore is not installed.
        """
        parts = urlsplit(address)
        self._scheme = parts.scheme
        self._address = address
        if self._scheme in WEB_SCHEMES:
            # what follows the path may be a signature, which is a secret
            self._shown = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
            self._key, bucket, name = "", address, unquote(parts.path).rpartition("/")[2]
        else:
            self._shown = address
            bucket, _, self._key = address.partition("://")[2].partition("/")
            name = self._key.rpartition("/")[2]
        if not name or not parts.netloc:
            raise UsageError(
                f"{self._shown} names no file; give the address of one log, such as s3://bucket/run.mcap"
            )
        self.name = name
        self._obstore = obstore_library()
        self._store = open_store(self._scheme, bucket)
        self._held = HeldBytes()
        self._lock, self._opening = Lock(), Lock()
        self._version: FileVersion | None = None

    def __fspath__(self) -> str:
        return self._address

    def __str__(self) -> str:
        return self._shown

    def __repr__(self) -> str:
        return f"RemoteFile({self._shown!r})"

    @property
    def version(self) -> FileVersion:
        """Its version, known from the first read on: one of its end, and of its beginning at the same time.

        Raises:
            MissingFileError: there is no such file, or access is denied.
            RemoteError: it cannot be read.
        """
        with self._opening:
            if self._version is None:
                self._version = self._opened()
            return self._version

    @property
    def size(self) -> int:
        """In bytes; see `version` for what is raised."""
        return self.version.size

    def current_version(self) -> FileVersion:
        """Return the version, without a look at the content where the server can.

        Raises:
            MissingFileError, RemoteError: it cannot be read.
        """
        try:
            return self._versioned(self._get({"head": True}).meta)
        except SpatialReplayError:
            # a signed address is for reading alone
            return self.version

    def open(self) -> BinaryIO:
        """Open it for reading, from any number of streams."""
        return cast(BinaryIO, RangeStream(self))

    def read(self, begin: int, end: int) -> bytes:
        """Return a range of its bytes, less where it ends before that.

        Raises:
            MissingFileError, RemoteError: it cannot be read, or has changed.
        """
        end = min(end, self.version.size)
        if end - begin > MOST_HELD_BYTES // 2:
            bounds = range(begin, end, _PIECE_BYTES)
            return b"".join(self.iter_pieces([(each, min(each + _PIECE_BYTES, end)) for each in bounds]))
        while True:
            with self._lock:
                missing = self._held.missing(begin, end)
                if not missing:
                    return self._held.read(begin, end)
            first, last = missing[0][0], missing[-1][1]
            self.fetch([(first, min(max(last, first + _LEAST_BYTES), self.version.size))])

    def fetch(self, ranges: Iterable[Range]) -> None:
        """Read ranges that are not held yet: joined where they are near, all at the same time."""
        with self._lock:
            missing = [gap for begin, end in ranges for gap in self._held.missing(begin, end)]
        pieces = [
            (begin, min(begin + _PIECE_BYTES, end))
            for first, end in joined_ranges(missing)
            for begin in range(first, end, _PIECE_BYTES)
        ]
        for (begin, _), data in zip(pieces, self.iter_pieces(pieces), strict=True):
            with self._lock:
                self._held.add(begin, data)

    def iter_pieces(self, pieces: Sequence[Range], at_once: int = _AT_ONCE) -> Iterator[bytes]:
        """Read ranges at the same time, and yield the bytes of each in their order; none of them is held."""
        with ThreadPoolExecutor(max(1, min(at_once, len(pieces))), "remote-reading") as threads:
            waiting: deque[Future[bytes]] = deque()
            try:
                for piece in pieces:
                    waiting.append(threads.submit(self._range, piece))
                    if len(waiting) >= at_once:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                threads.shutdown(wait=False, cancel_futures=True)

    def iter_whole(self) -> Iterator[bytes]:
        """Read the file from its beginning to its end, in parts."""
        version = self.version
        if version.has_ranges:
            bounds = range(0, version.size, _PIECE_BYTES)
            pieces = [(begin, min(begin + _PIECE_BYTES, version.size)) for begin in bounds]
            yield from self.iter_pieces(pieces, at_once=8)
            return
        try:
            yield from map(bytes, self._get({}).stream(min_chunk_size=2**20))
        except self._obstore.exceptions.BaseError as error:
            raise store_failure(self._shown, self._scheme, error) from None

    def _opened(self) -> FileVersion:
        """Read the end and the beginning."""
        with ThreadPoolExecutor(1, "remote-reading") as thread:
            head = thread.submit(self._part, {"range": (0, _HEAD_BYTES)})
            try:
                version, begin, tail = self._part({"range": {"suffix": _TAIL_BYTES}})
                first, _, beginning = head.result()
            except self._obstore.exceptions.NotSupportedError:
                return self._without_suffix(head)
        if first != version:
            raise self._changed()
        for place, data in ((begin, tail), (0, beginning)):
            for gap_begin, gap_end in self._held.missing(place, place + len(data)):
                self._held.add(gap_begin, data[gap_begin - place : gap_end - place])
        return version

    def _without_suffix(self, head: Future[tuple[FileVersion, int, bytes]]) -> FileVersion:
        """Return the version where the end cannot be asked for (Azure), or no range at all."""
        try:
            version, _, beginning = head.result()
        except self._obstore.exceptions.NotSupportedError:
            return self._versioned(self._get({"head": True}).meta, has_ranges=False)
        self._held.add(0, beginning)
        self._version = version
        self.fetch([(max(0, version.size - _TAIL_BYTES), version.size)])
        return version

    def _range(self, wanted: Range) -> bytes:
        """Read a range of the version that is known."""
        known = self._version
        # a weak tag never fits; then the answer's own tag is compared
        strong = {"if_match": known.tag} if known and known.tag and known.tag.startswith('"') else {}
        version, _, data = self._part({"range": wanted, **strong})
        if version != known or len(data) != wanted[1] - wanted[0]:
            raise self._changed()
        return data

    def _part(self, options: dict[str, Any]) -> tuple[FileVersion, int, bytes]:
        """Return the version of an answer, where its bytes begin, and these."""
        for attempt in range(1, _ATTEMPTS + 1):
            answer = self._get(options)
            try:
                data = bytes(answer.bytes())
                if len(data) == answer.range[1] - answer.range[0]:
                    return self._versioned(answer.meta), answer.range[0], data
                error: Exception = EOFError("the connection breaks off")
            except self._obstore.exceptions.BaseError as failure:
                error = failure
            # requests are repeated by the library, answers that break off here
            if attempt == _ATTEMPTS:
                raise store_failure(self._shown, self._scheme, error) from None
        raise AssertionError

    def _get(self, options: dict[str, Any]) -> Any:
        exceptions = self._obstore.exceptions
        try:
            return self._obstore.get(self._store, self._key, options=cast(Any, options))
        except exceptions.NotSupportedError:
            raise
        except exceptions.PreconditionError:
            raise self._changed() from None
        except (OSError, ValueError, exceptions.BaseError) as error:
            raise store_failure(self._shown, self._scheme, error) from None

    @staticmethod
    def _versioned(meta: Any, *, has_ranges: bool = True) -> FileVersion:
        modified = meta["last_modified"]
        # without a date, the library gives the epoch
        dated = modified.isoformat() if modified and modified.timestamp() > 0 else None
        return FileVersion(meta["size"], meta["e_tag"] or dated, has_ranges)

    def _changed(self) -> RemoteError:
        return RemoteError(f"{self._shown} was replaced while it was read; run the command again")


LogFile: TypeAlias = Path | RemoteFile
"""The file of a log, on this machine or at an address."""


def open_file(file: LogFile) -> BinaryIO:
    """Open the file of a log for reading."""
    return file.open() if isinstance(file, RemoteFile) else file.open("rb")


def file_size(file: LogFile) -> int:
    """Return its size in bytes."""
    return file.size if isinstance(file, RemoteFile) else file.stat().st_size


def obstore_library() -> Any:
    """Return obstore.

    Raises:
        UsageError: it is not installed.
    """
    with importing("addresses need obstore", extra="remote"):
        import obstore
        import obstore.exceptions
        import obstore.store
    return obstore


def open_store(scheme: str, bucket: str) -> Any:
    """Return the store of a bucket or container, or of the address of a web server; nothing is read yet.

    A process has one store for each bucket, whose connections are used again.

    Raises:
        RemoteError: it cannot be one.
    """
    settings = tuple(sorted(each for each in os.environ.items() if each[0].startswith(_SETTINGS)))
    return _store(scheme, bucket, settings)


@lru_cache(maxsize=32)
def _store(scheme: str, bucket: str, settings: tuple[tuple[str, str], ...]) -> Any:
    """Return the store of a bucket, which reads these settings from the environment."""
    stores = obstore_library().store
    options: dict[str, Any] = {"client_options": _CLIENT, "retry_config": _RETRIES}
    made = {"s3": stores.S3Store, "gs": stores.GCSStore, "az": stores.AzureStore}.get(scheme)
    try:
        return made(bucket, **options) if made else stores.HTTPStore.from_url(bucket, **options)
    except (ValueError, obstore_library().exceptions.BaseError) as error:
        raise store_failure(
            f"{scheme}://{bucket.partition('?')[0].rpartition('/')[2]}", scheme, error
        ) from None


def store_failure(shown: str, scheme: str, error: Exception, done: str = "read") -> SpatialReplayError:
    """Return the error for an address that cannot be read or written, with what helps."""
    exceptions = obstore_library().exceptions
    if isinstance(error, FileNotFoundError):
        return MissingFileError(f"{shown}: there is no such file; check the address")
    if isinstance(error, (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError)):
        return MissingFileError(f"{shown}: access denied; {_CREDENTIALS[scheme]}")
    text = str(error).partition("\n")[0].strip()
    if "404 " in text:
        return MissingFileError(f"{shown}: there is no such bucket; check the address")
    if "416 " in text:
        return RemoteError(f"{shown} is empty; give a log with at least one sample")
    reason = fspath(text).rpartition(" - ")[2].partition(": <")[0].rstrip(":")
    reason = _REASONS.get(reason.rpartition("HTTP error: ")[2], reason)
    remedy = "the address" if scheme in WEB_SCHEMES else f"the credentials: {_CREDENTIALS[scheme]}"
    return RemoteError(f"{shown} cannot be {done}: {reason}; check the network and {remedy}")

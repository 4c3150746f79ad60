"""Folders at addresses of buckets and containers: listed, and their files read and written whole."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatchcase
from typing import Final

from spatial_replay.errors import MissingFileError, OutputError, UsageError
from spatial_replay.logs.remote import WEB_SCHEMES, obstore_library, open_store, store_failure

_AT_ONCE: Final = 32


class RemoteFolder:
    """A folder in a bucket. A file is written by one put, so it is whole or not there.

    Names of files are relative to the folder. Several threads may use it.
    """

    def __init__(self, address: str) -> None:
        """Take an address such as "s3://bucket/folder/"; nothing is read yet.

        Raises:
            UsageError: a web server, no bucket, or obstore is not installed.
        """
        self._scheme, _, rest = address.partition("://")
        if self._scheme in WEB_SCHEMES:
            raise UsageError(
                "a web server neither lists nor takes files; give a folder of a bucket, such as "
                "s3://bucket/results, or one on this machine"
            )
        bucket, _, key = rest.partition("/")
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
        """Return whether there is a file in it."""
        return next(self._keys(""), None) is not None

    def names(self, below: str = "") -> list[str]:
        """Return the names of all files in it, or in a folder below, in order.

        Raises:
            MissingFileError, RemoteError: it cannot be listed.
        """
        return sorted(key.removeprefix(self._prefix) for key in self._keys(below))

    def read(self, names: Sequence[str]) -> Iterator[bytes]:
        """Read files, several at the same time, and yield the content of each in their order.

        Raises:
            MissingFileError: one is not there; it may have been joined with others by another batch.
            UsageError, RemoteError: one cannot be read.
        """
        with ThreadPoolExecutor(_AT_ONCE, "remote-reading") as threads:
            yield from threads.map(self._read, names)

    def write(self, name: str, data: bytes) -> None:
        """Write a file, which is whole or, where that fails, as before.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            self._library.put(self._store, self._prefix + name, data)
        except self._failures as error:
            shown = f"{self.location}/{name}"
            raise OutputError(str(store_failure(shown, self._scheme, error, "written"))) from None

    def remove(self, names: Iterable[str]) -> None:
        """Remove files; one that is gone already is no error.

        Raises:
            OutputError: one cannot be removed.
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
            for some in self._library.list(self._store, self._prefix + below or None):
                yield from (each["path"] for each in some)
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
    """Return the addresses of a bucket or container that fit a pattern, in order.

    Args:
        pattern: such as "s3://fleet/2026-11/*.mcap"; an end in "/" stands for everything below.

    Raises:
        UsageError: a web server cannot list its files.
        MissingFileError, RemoteError: the bucket cannot be read.
    """
    scheme, _, rest = pattern.partition("://")
    if scheme in WEB_SCHEMES:
        raise UsageError(f"{pattern}: web servers do not list their files; give each address")
    bucket, _, key = rest.partition("/")
    begin = min((key.find(sign) for sign in "*?[" if sign in key), default=len(key))
    fixed, wanted = key[:begin].rpartition("/")[0], key + "*" if key.endswith("/") or not key else key
    keys = RemoteFolder(f"{scheme}://{bucket}").names(fixed)
    return [f"{scheme}://{bucket}/{each}" for each in keys if fnmatchcase(each, wanted)]

"""Where results of batches lie: in a folder on this machine, or in a bucket."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike, fspath
from pathlib import Path
from typing import Final, TypeAlias

from spatial_replay.errors import LogError, MissingFileError, OutputError, UsageError
from spatial_replay.logs.output_file import output_error, refuse_addresses, replacing
from spatial_replay.logs.remote import is_address
from spatial_replay.logs.remote_folder import RemoteFolder

_PARTIAL: Final = ".partial"


class LocalFolder:
    """A folder on this machine. A file is written under another name first, so it is whole or not there."""

    is_on_this_machine: Final = True

    def __init__(self, path: Path) -> None:
        """Take a path; nothing is read yet.

        Raises:
            UsageError: it is a file.
        """
        refuse_addresses(path, "give it as a text: a path joins its slashes")
        if path.exists() and not path.is_dir():
            raise UsageError(f"{path} is a file; results are a folder, give that")
        self.path: Final = path
        self.location: Final = str(path.resolve())

    def __str__(self) -> str:
        return str(self.path)

    def exists(self) -> bool:
        """Return whether there is a file in it."""
        return next(self._files(self.path), None) is not None

    def names(self, below: str = "") -> list[str]:
        """Return the names of all files in it, or in a folder below, in order."""
        return sorted(file.removeprefix(f"{self.path}/") for file in self._files(self.path / below))

    def read(self, names: Sequence[str]) -> Iterator[bytes]:
        """Read files, and yield the content of each in their order.

        Raises:
            MissingFileError, LogError: one is not there, or cannot be read.
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
        """Write a file, and the folders that it lies in.

        Raises:
            OutputError: the machine cannot write it.
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
            OutputError: one cannot be removed.
        """
        for name in names:
            try:
                (self.path / name).unlink()
            except OSError as error:
                raise OutputError(f"{self.path / name} could not be removed: {error.strerror}") from error

    @staticmethod
    def _files(folder: Path) -> Iterator[str]:
        """Yield the paths of all whole files in a folder and below."""
        for parent, _, names in os.walk(folder):
            yield from (f"{parent}/{name}" for name in names if not name.endswith(_PARTIAL))

    @contextmanager
    def locked(self, name: str) -> Iterator[None]:
        """Keep other commands from writing here, by a lock on a file, and remove what killed ones have left.

        Raises:
            UsageError: another command is writing here.
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
    """A folder in a bucket. Many machines write to it, so it has no lock, and nothing about files of one."""

    is_on_this_machine: Final = False

    @contextmanager
    def locked(self, name: str) -> Iterator[None]:
        """Let others write, too: a batch that is killed could not take a lock back."""
        yield


ResultFiles: TypeAlias = LocalFolder | BucketFolder


def result_files(folder: str | PathLike[str]) -> ResultFiles:
    """Return the folder of a path or an address.

    Raises:
        UsageError: neither a folder nor the address of one, or obstore is not installed.
    """
    return BucketFolder(fspath(folder)) if is_address(folder) else LocalFolder(Path(folder))

"""Copies of remote files on this machine, in a folder of bounded size, for logs not read in parts."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from os import PathLike
from pathlib import Path
from typing import Final, TypeAlias

from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.output_file import output_error
from spatial_replay.logs.remote import RemoteFile, log_file

_LOG: Final = logging.getLogger("spatial_replay")
_LIMIT: Final = "SPATIAL_REPLAY_DOWNLOADS"
_GIGABYTE: Final = 10**9
_DEFAULT_GIGABYTES: Final = 20.0


Show: TypeAlias = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Shows some work, given what it is called and how many steps it has; what comes out counts them."""
_shows: Final[ContextVar[Show | None]] = ContextVar("shows", default=None)


@contextmanager
def showing_downloads(show: Show) -> Iterator[None]:
    """Show the bytes of downloads, while this lasts, in the thread that asks for it."""
    before = _shows.set(show)
    try:
        yield
    finally:
        _shows.reset(before)


def local_copy(path: str | PathLike[str]) -> Path:
    """Return a path as it is, and of a small file at an address, such as a specification, a copy.

    Raises:
        UsageError: an address that names no file, or obstore is not installed.
        LogError: it is larger than all copies may be.
        MissingFileError, RemoteError: it cannot be read.
        OutputError: the disk cannot take it.
    """
    file = log_file(path)
    return downloaded(file) if isinstance(file, RemoteFile) else file


def downloaded(file: RemoteFile, reason: str = "") -> Path:
    """Return a copy of a remote file on this machine, which is made once for each version of it.

    The oldest copies are removed when all together exceed 20 GB, or SPATIAL_REPLAY_DOWNLOADS gigabytes.

    Args:
        reason: why it is not read in parts, for the message that says that it is downloaded; without one,
            there is none.

    Raises:
        LogError: it is larger than all copies may be.
        MissingFileError, RemoteError: it cannot be read.
        OutputError: the disk cannot take it.
    """
    return _copied([file], str(file), reason) / _name(file)


def downloaded_folder(files: Sequence[RemoteFile], name: str, shown: str, reason: str) -> Path:
    """Return a folder of this name with copies of remote files; see `downloaded`.

    Args:
        shown: the address of the folder, for messages.
    """
    return _copied(files, shown, reason, name)


def _copied(files: Sequence[RemoteFile], shown: str, reason: str, below: str = "") -> Path:
    """Return the folder that holds copies of files."""
    versions, limit = [file.version for file in files], gigabytes(_LIMIT, _DEFAULT_GIGABYTES)
    size = sum(version.size for version in versions)
    parent = user_cache_folder("downloads")
    known = [f"{os.fspath(file)}\n{file.version.tag}\n{file.version.size}" for file in files]
    folder = parent / hashlib.sha256("\n".join(known).encode()).hexdigest()[:32]
    # what has no tag may have changed
    if all(version.tag is not None for version in versions) and all(
        _has(folder / below / _name(file), file.version.size) for file in files
    ):
        with suppress(OSError):
            os.utime(folder)
        return folder / below
    if size > limit:
        raise LogError(
            f"{shown} has {size / _GIGABYTE:.2f} GB, and downloads may have {limit / _GIGABYTE:g} GB;"
            f" set {_LIMIT} to more gigabytes, or copy the log to this machine"
        )
    if reason:
        _LOG.warning("%s: downloading %.1f MB once, to %s: %s", shown, size / 1e6, parent, reason)
    show = _shows.get()
    try:
        parent.mkdir(parents=True, exist_ok=True)
        _make_room(parent, limit - size)
        partial = Path(tempfile.mkdtemp(".partial", "", parent))
        try:
            (partial / below).mkdir(exist_ok=True)
            with nullcontext(lambda size: None) if show is None else show("downloading", size) as advance:
                for file in files:
                    _write(file, partial / below / _name(file), advance)
            shutil.rmtree(folder, ignore_errors=True)
            with suppress(FileExistsError):
                partial.rename(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise output_error(folder, error) from error
    return folder / below


def _name(file: RemoteFile) -> str:
    return file.name.replace("/", "_") or "log"


def _has(copy: Path, size: int) -> bool:
    return copy.is_file() and copy.stat().st_size == size


def _write(file: RemoteFile, copy: Path, advance: Callable[[int], None]) -> None:
    size = 0
    with copy.open("wb") as stream:
        for part in file.iter_whole():
            size += len(part)
            if size > file.version.size:
                break
            stream.write(part)
            advance(len(part))
    if size != file.version.size:
        raise LogError(f"{file}: {size} bytes came instead of {file.version.size}; run the command again")


def _make_room(parent: Path, room: int) -> None:
    """Remove the copies that were not used for longest, until the others fit."""
    copies = []
    for folder in parent.iterdir():
        with suppress(OSError):
            size = sum(each.stat().st_size for each in folder.rglob("*"))
            copies.append((folder.stat().st_mtime, folder.name, size))
    total = sum(size for *_, size in copies)
    for _, name, size in sorted(copies):
        if total <= room:
            return
        shutil.rmtree(parent / name, ignore_errors=True)
        total -= size


def user_cache_folder(name: str) -> Path:
    """Return the folder of this name among what the user's programs may keep.

    Raises:
        RuntimeError: the user has no home folder.
    """
    if chosen := os.environ.get("SPATIAL_REPLAY_CACHE"):
        return Path(chosen) / name
    # the XDG specification has a relative path ignored
    parent = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (parent if parent.is_absolute() else Path.home() / ".cache") / "spatial-replay" / name


def gigabytes(variable: str, otherwise: float) -> int:
    """Return the bytes that a variable of the environment names in gigabytes.

    Raises:
        UsageError: it is not a number from 0 on.
    """
    text = os.environ.get(variable, str(otherwise))
    try:
        size = int(float(text) * _GIGABYTE)
    except (ValueError, OverflowError):
        size = -1
    if size < 0:
        raise UsageError(f"{variable} is {text!r}; give a number of gigabytes")
    return size

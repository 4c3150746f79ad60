"""Copies of remote files on this machine, in a folder of bounded size, for logs not read in parts."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.output_file import output_error
from spatial_replay.logs.remote import RemoteFile

_LOG: Final = logging.getLogger("spatial_replay")
_LIMIT: Final = "SPATIAL_REPLAY_DOWNLOADS"
_GIGABYTE: Final = 10**9
_DEFAULT_GIGABYTES: Final = 20.0


def downloaded(file: RemoteFile, reason: str) -> Path:
    """Return a copy of a remote file on this machine, which is made once for each version of it.

    The oldest copies are removed when all together exceed 20 GB, or SPATIAL_REPLAY_DOWNLOADS gigabytes.

    Args:
        reason: why it is not read in parts, for the message that says that it is downloaded.

    Raises:
        LogError: it is larger than all copies may be.
        MissingFileError, RemoteError: it cannot be read.
        OutputError: the disk cannot take it.
    """
    version, limit = file.version, _limit()
    parent = _folder()
    identity = f"{os.fspath(file)}\n{version.tag}\n{version.size}"
    folder = parent / hashlib.sha256(identity.encode()).hexdigest()[:32]
    copy = folder / (file.name.replace("/", "_") or "log")
    # what has no tag may have changed
    if version.tag is not None and copy.is_file() and copy.stat().st_size == version.size:
        with suppress(OSError):
            os.utime(folder)
        return copy
    if version.size > limit:
        raise LogError(
            f"{file} has {version.size / _GIGABYTE:.2f} GB, and downloads may have {limit / _GIGABYTE:g} GB;"
            f" set {_LIMIT} to more gigabytes, or copy the log to this machine"
        )
    _LOG.warning("%s: downloading %.1f MB once, to %s: %s", file, version.size / 1e6, parent, reason)
    try:
        parent.mkdir(parents=True, exist_ok=True)
        _make_room(parent, limit - version.size)
        partial = Path(tempfile.mkdtemp(".partial", "", parent))
        try:
            _write(file, partial / copy.name, limit)
            shutil.rmtree(folder, ignore_errors=True)
            with suppress(FileExistsError):
                partial.rename(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise output_error(copy, error) from error
    return copy


def _write(file: RemoteFile, copy: Path, limit: int) -> None:
    size = 0
    with copy.open("wb") as stream:
        for part in file.iter_whole():
            size += len(part)
            if size > limit:
                break
            stream.write(part)
    if size != file.version.size:
        raise LogError(f"{file}: {size} bytes came instead of {file.version.size}; run the command again")


def _make_room(parent: Path, room: int) -> None:
    """Remove the copies that were not used for longest, until the others fit."""
    copies = []
    for folder in parent.iterdir():
        with suppress(OSError):
            size = sum(each.stat().st_size for each in folder.iterdir())
            copies.append((folder.stat().st_mtime, folder.name, size))
    total = sum(size for *_, size in copies)
    for _, name, size in sorted(copies):
        if total <= room:
            return
        shutil.rmtree(parent / name, ignore_errors=True)
        total -= size


def _folder() -> Path:
    chosen = os.environ.get("SPATIAL_REPLAY_CACHE")
    if chosen:
        return Path(chosen) / "downloads"
    parent = os.environ.get("XDG_CACHE_HOME")
    return (Path(parent) if parent else Path.home() / ".cache") / "spatial-replay" / "downloads"


def _limit() -> int:
    text = os.environ.get(_LIMIT, str(_DEFAULT_GIGABYTES))
    try:
        return int(float(text) * _GIGABYTE)
    except (ValueError, OverflowError):
        raise UsageError(f"{_LIMIT} is {text!r}; give a number of gigabytes") from None

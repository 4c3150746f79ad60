"""Where machine code is kept on disk: in a folder named after a digest of all sources of the package.

So a changed kernel is never mistaken for the one before. A digest lies beside each file: damaged code would
end the process by a signal, and is compiled again. `SPATIAL_REPLAY_CACHE` names another place.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Final

_STALE_S: Final = 7 * 24 * 3600.0
_ROOM_BYTES: Final = 2**25
"""A disk with less space keeps no code: a kernel that cannot be written ends the process."""
_PACKAGE: Final = Path(__file__).parent


def cache_folder() -> Path | None:
    """Return the folder for machine code of these sources, made if need be; None if none can be written.

    Code in it is loaded as it is, so it lies where only the user, or who installed the package, writes.
    """
    name = f"kernels-{source_digest()}"
    shipped: Path | None = None
    for parent in _cache_parents():
        folder = parent / name
        try:
            is_new = not folder.exists()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # that of another user, where several may write, cannot be opened
            os.close(_opened_lock(folder))
            with tempfile.TemporaryFile(dir=folder):
                if shutil.disk_usage(folder).free < _ROOM_BYTES:
                    raise OSError(errno.ENOSPC, "no space left")
        except OSError:
            # code that was compiled when an image was built, and is read-only now, or on a full disk
            shipped = shipped or (folder if any(folder.rglob("*.nbi")) else None)
            continue
        if is_new:
            _remove_stale(parent, keep=name)
            if shipped is not None:
                with suppress(OSError):
                    shutil.copytree(shipped, folder, dirs_exist_ok=True)
        return folder
    return None


def remove_damaged(folder: Path) -> None:
    """Remove machine code that is not what was written.

    Code newer than its digest may be in the making while other processes run that use the folder. It stays.
    """
    descriptor = _opened_lock(folder)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_alone = True
    except OSError:
        is_alone = False
    for path in folder.rglob("*.nb[ic]"):
        with suppress(OSError):
            is_damaged = not _is_sealed(path) or _seal_of(path).read_bytes() != _digest_of(path)
            if is_damaged and (is_alone or _is_sealed(path)):
                path.unlink()
    # until this process ends
    fcntl.flock(descriptor, fcntl.LOCK_SH)


@contextmanager
def turn(folder: Path | None, kernel: str) -> Iterator[None]:
    """Wait for other processes that compile the same kernel: what they wrote is then loaded."""
    if folder is None:
        yield
        return
    descriptor = _opened_lock(folder, f"{kernel}.lock")
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _opened_lock(folder: Path, name: str = "lock") -> int:
    return os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o600)


def seal(folder: Path) -> None:
    """Note what was written since the last time."""
    for path in folder.rglob("*.nb[ic]"):
        with suppress(OSError):
            if not _is_sealed(path):
                _seal_of(path).write_bytes(_digest_of(path))


def _is_sealed(path: Path) -> bool:
    """Return whether a digest was noted after a file was written."""
    sealed = _seal_of(path)
    return sealed.exists() and sealed.stat().st_mtime_ns >= path.stat().st_mtime_ns


def _seal_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


def _digest_of(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).hexdigest().encode()


def _cache_parents() -> Iterator[Path]:
    for name in ("SPATIAL_REPLAY_CACHE", "NUMBA_CACHE_DIR"):
        if value := os.environ.get(name):
            yield Path(value).absolute()
    yield _PACKAGE / "__pycache__"
    if Path(value := os.environ.get("XDG_CACHE_HOME", "")).is_absolute():
        yield Path(value) / "spatial-replay"
    # a user without a home folder
    with suppress(RuntimeError):
        yield Path.home() / ".cache" / "spatial-replay"


def _remove_stale(parent: Path, keep: str) -> None:
    """Remove machine code of other sources that no process has added to for a while."""
    oldest = time.time() - _STALE_S
    for folder in parent.glob("kernels-*"):
        with suppress(OSError):
            if folder.name != keep and folder.stat().st_mtime < oldest:
                shutil.rmtree(folder, ignore_errors=True)


@cache
def source_digest() -> str:
    """Return a digest of the sources of the package: kernels take constants from anywhere in it."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]

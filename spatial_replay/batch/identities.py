"""Hashes of logs. Logs with equal bytes share their results. Unchanged logs are not hashed again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final

from spatial_replay.batch.workers import Progress, ThisProcess, WorkerLost, Workers
from spatial_replay.errors import SpatialReplayError
from spatial_replay.logs.formats.datasets import data_set_address, open_data_set
from spatial_replay.logs.formats.episodes import DataSet
from spatial_replay.logs.remote import BAG_METADATA, RemoteFile, each_ahead, is_address, log_file
from spatial_replay.sources.open_log import bag_files_at

_TOGETHER: Final = 16
"""Logs per hashing task."""


def identify(
    paths: Sequence[str], known: Mapping[str, str], workers: Workers, progress: Progress
) -> tuple[dict[str, str | None], dict[str, str | None]]:
    """Return the identity and the state of each log, by path.

    An identity is a hash of the log's bytes, or the version of a remote log. An unreadable log has None. A
    log is hashed again only if its state changes: the path, device, inode, size or times of a file.

    Args:
        known: identities by state.
        workers: executor that reads the logs with unknown states.
        progress: shows the number of logs read.
    """
    states = states_of(paths)
    unknown_paths = [path for path, state in states.items() if state is None or state not in known]
    groups = [
        tuple(unknown_paths[start : start + _TOGETHER]) for start in range(0, len(unknown_paths), _TOGETHER)
    ]
    # reading one group takes less time than the start of a process
    executor = ThisProcess() if len(groups) == 1 else workers
    identity_by_path: dict[str, str | None] = {}
    with progress("logs read", len(unknown_paths)) as advance:
        for group, identities in executor.results(identities_of, groups) if groups else ():
            identity_by_path |= dict.fromkeys(group) if isinstance(identities, WorkerLost) else identities
            advance(len(group))
    return {
        path: identity_by_path[path] if path in identity_by_path else known[states[path] or ""]
        for path in paths
    }, states


def identities_of(paths: tuple[str, ...]) -> dict[str, str | None]:
    """Return the identity of each log; None for an unreadable log."""
    if not any(map(is_address, paths)):
        # this thread reads local files, because a signal does not interrupt reads in other threads
        files = _LogFiles()
        return {path: _identity(path, files) for path in paths}
    return dict(zip(paths, each_ahead(_identity, paths, _TOGETHER), strict=True))


def _identity(path: str, files: _LogFiles | None = None) -> str | None:
    try:
        return _version_at(path) if is_address(path) else _hash_of_log(path, files or _LogFiles())
    except (OSError, ValueError, SpatialReplayError):
        return None


class _LogFiles:
    """Files of logs. Each data set is opened once, and the state of each file is read once."""

    def __init__(self) -> None:
        self._data_sets: dict[str, tuple[DataSet | None, list[str]]] = {}
        self._states: dict[str, tuple[str, os.stat_result]] = {}

    def of(self, path: str) -> tuple[list[str], int | None]:
        """Return the files of a log, and its episode number; None if the log is no episode.

        The files of an episode are its data and the metadata of the data set.
        """
        address = data_set_address(path)
        if address is not None:
            data_set, shared_files = self._data_set(address[0])
            if data_set is not None:
                return [*shared_files, *map(str, data_set.files_of(address[1]))], address[1]
        # `os.path`, because creating `Path` objects takes longer than the system call
        if not os.path.isdir(path):  # noqa: PTH112
            return [path], None
        return sorted(str(file) for file in Path(path).iterdir() if file.is_file()), None

    def state(self, file: str) -> tuple[str, os.stat_result]:
        """Return the real path of a file and its result of `os.stat`."""
        if file not in self._states:
            self._states[file] = os.path.realpath(file), os.stat(file)  # noqa: PTH116
        return self._states[file]

    def _data_set(self, path: str) -> tuple[DataSet | None, list[str]]:
        if path not in self._data_sets:
            data_set = open_data_set(path)
            shared_files = [] if data_set is None else [str(file) for file in data_set.shared_files()]
            self._data_sets[path] = data_set, shared_files
        return self._data_sets[path]


def states_of(paths: Sequence[str]) -> dict[str, str | None]:
    """Return a hash of the file states of each log: path, device, inode, size and times.

    Unchanged files have an unchanged hash. Addresses and unreadable files have None.
    """
    files = _LogFiles()
    return {path: None if is_address(path) else _state(path, files) for path in paths}


def _state(path: str, files: _LogFiles) -> str | None:
    try:
        file_names, episode_number = files.of(path)
        states = [files.state(name) for name in file_names]
    except (OSError, ValueError, SpatialReplayError):
        return None
    # the time of change (ctime) is included, because tools such as rsync restore the modification time
    state_json = json.dumps(
        [
            *([] if episode_number is None else [episode_number]),
            *(
                (name, state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
                for name, state in states
            ),
        ]
    )
    return hashlib.sha256(state_json.encode("utf-8", "surrogatepass")).hexdigest()


def _hash_of_log(path: str, files: _LogFiles) -> str:
    file_names, episode = files.of(path)
    if Path(path).is_file():
        return _hash_of(Path(path))
    if episode is None and not Path(path).is_dir():
        raise OSError(f"{path} is no regular file")
    log_hash = hashlib.sha256()
    for name in file_names:
        digest = (
            _hash_of(Path(name)) if episode is None else _cached_hash(name, files.state(name)[1].st_mtime_ns)
        )
        # names that are not UTF-8 contain surrogates (PEP 383)
        log_hash.update(f"{Path(name).name}\0{digest}\0".encode("utf-8", "surrogatepass"))
    return f"files:{log_hash.hexdigest()}" + ("" if episode is None else f"#{episode}")


@lru_cache(maxsize=64)
def _cached_hash(file: str, state_ns: int) -> str:
    """Return the hash of a file that many episodes share.

    Args:
        state_ns: modification time of the file: a changed file has another cache entry.
    """
    return _hash_of(Path(file))


def _version_at(address: str) -> str:
    """Return the identity of a log at an address.

    Raises:
        UsageError, RemoteError: the log cannot be read.
    """
    file = log_file(address)
    assert isinstance(file, RemoteFile)
    files = bag_files_at(file) if file.name == BAG_METADATA else [file]
    versions = [(str(file), *_version_of(file)) for file in files]
    return f"version:{hashlib.sha256(json.dumps(versions).encode()).hexdigest()}"


def _version_of(file: RemoteFile) -> tuple[int, str]:
    """Return the size of a remote file, and its strong ETag; without an ETag, the digest of its bytes."""
    version = file.current_version()
    if version.is_exact:
        return version.size, str(version.tag)
    digest = hashlib.sha256()
    for chunk in file.iter_whole():
        digest.update(chunk)
    return version.size, digest.hexdigest()


def _hash_of(path: Path) -> str:
    with path.open("rb") as stream:
        return f"sha256:{hashlib.file_digest(stream, 'sha256').hexdigest()}"

"""Logs and specifications of a batch: how they are found, and known again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from glob import glob, has_magic
from pathlib import Path
from typing import Final, NamedTuple

from spatial_replay.batch.rows import spec_lines
from spatial_replay.batch.suite import Case, LogPattern
from spatial_replay.batch.workers import Progress, ThisProcess, WorkerLost, Workers
from spatial_replay.errors import SpatialReplayError, UsageError
from spatial_replay.logs.remote import (
    BAG_METADATA,
    RemoteFile,
    is_address,
    local_copy,
    log_file,
    matching_addresses,
)
from spatial_replay.monitor.instances import Choice
from spatial_replay.sources.open_log import bag_files_at
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.format import format_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import SpecificationText
from spatial_replay.text import counted, encodable

HASH_DIGITS: Final = 32
"""Digits of a hash in a name."""


@dataclass(frozen=True, slots=True)
class SpecFile:
    """A specification file of a case, parsed with the case's constants.

    Attributes:
        name: as it is written: relative to the suite's folder.
        hash: of its meaning, with ids and titles: layout and comments do not count.
        lines: the line of each spec.
        warnings: what `check` warns of.
    """

    name: str
    text: SpecificationText
    hash: str
    lines: tuple[tuple[str, int], ...]
    warnings: tuple[Diagnostic, ...] = ()


def read_specification_text(path: Path | str) -> SpecificationText:
    """Read the text of a specification at a path or an address, with its errors.

    Raises:
        MissingFileError, UsageError, SpecificationError: see `load_specification`.
    """
    from spatial_replay.spec.load import load_specification

    return SpecificationText(load_specification(local_copy(path)).source, encodable(log_file(path).name))


def spec_file(path: Path | str, text: SpecificationText, parsed: Specification, folder: Path) -> SpecFile:
    """Return a specification file that was read and parsed; paths are shown relative to a folder."""
    meaning = f"{parsed.profile}\n{format_specification(parsed)}"
    digest = hashlib.sha256(meaning.encode("utf-8", "surrogatepass")).hexdigest()[:HASH_DIGITS]
    return SpecFile(_shown(path, folder), text, digest, tuple(spec_lines(parsed).items()), parsed.warnings)


def _shown(file: Path | str, folder: Path) -> str:
    path = log_file(file)
    if isinstance(path, RemoteFile):
        return str(path)
    return encodable((path.relative_to(folder) if path.is_relative_to(folder) else path).as_posix())


def choice_faults(case: Case, files: Sequence[Specification]) -> Iterator[str]:
    """Yield what is wrong with the objects that a case chooses for the parameters of its templates."""
    templates = [spec for file in files for spec in file.results if spec.parameter is not None]
    parameters = {spec.parameter for spec in templates}
    chosen = dict(case.conditions.each)
    for parameter, objects in chosen.items():
        try:
            Choice.parse(parameter, objects)
        except UsageError as error:
            yield str(error)
        if parameter not in parameters:
            known = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates) or "none"
            yield f"no template has a parameter {parameter!r}; templates here: {known}"
    for spec in templates:
        if spec.parameter not in chosen:
            yield (
                f"{spec.name} is a template; say which objects {spec.parameter} stands for: "
                f"--each {spec.parameter}=class:NAME or each: {{{spec.parameter}: all}}"
            )


_ENDINGS: Final = (".mcap", ".bag", ".db3", ".jsonl", ".jsonl.gz", ".csv", ".xml")
"""Name endings of logs in a folder; any other file has to be named."""
_MOST_LOGS: Final = 2_000_000
_MOST_FAULTS: Final = 100
_TOGETHER: Final = 16
"""Logs that are hashed as one task."""


class FoundLog(NamedTuple):
    """A log of a batch.

    Attributes:
        name: as people know it: its path relative to the suite's folder, or its address.
        path: what opens it.
    """

    name: str
    path: str


def find_logs(patterns: Sequence[LogPattern], folder: Path) -> list[FoundLog]:
    """Return the logs that patterns stand for, in their order, sorted within each; each log once.

    A folder stands for all logs in it and below, a ROS 2 bag for itself; `s3://bucket/folder/` and patterns
    of addresses for what the bucket lists.

    Args:
        folder: what relative paths are relative to.

    Raises:
        UsageError: patterns without a log; all are listed, with their places.
        RemoteError: a bucket cannot be listed.
    """
    found: dict[str, FoundLog] = {}
    faults = []
    for pattern in patterns:
        place = f"{pattern.place}: " if pattern.place else ""
        try:
            logs = list(_logs_of(pattern.text, folder))
        except UsageError as error:
            faults.append(f"{place}{error}")
            continue
        if not logs:
            faults.append(f"{place}{_nothing(pattern.text, folder)}")
        found.update((log.path, log) for log in logs if log.path not in found)
        if len(found) > _MOST_LOGS:
            raise UsageError(f"{pattern.text}: more than {counted(_MOST_LOGS, 'log')}; split the batch")
    if faults:
        more = [f"… and {len(faults) - _MOST_FAULTS} more"] if len(faults) > _MOST_FAULTS else []
        raise UsageError("\n".join(faults[:_MOST_FAULTS] + more))
    return list(found.values())


def _logs_of(text: str, folder: Path) -> Iterator[FoundLog]:
    if is_address(text):
        yield from _logs_at(text)
        return
    try:
        path = folder / text
        if path.is_dir():
            yield from _logs_in(path, folder)
        elif path.is_file():
            yield _found(path, folder)
        elif has_magic(text):
            for name in sorted(glob(text, root_dir=folder, recursive=True)):  # noqa: PTH207 - absolute ones, too
                if (folder / name).is_file() or (folder / name / BAG_METADATA).is_file():
                    yield _found(folder / name, folder)
    except (OSError, ValueError):
        # a name that cannot be one, such as one with a null character
        return


def _logs_at(address: str) -> Iterator[FoundLog]:
    """Yield the log at an address, or those of a bucket that a pattern or a folder stands for."""
    is_folder = address.endswith("/")
    # in the address of a web server, "?" begins a query
    if address.startswith(("http://", "https://")) or not (is_folder or has_magic(address)):
        yield FoundLog(str(log_file(address)), address)
        return
    found = matching_addresses(address)
    bags = {each.removesuffix(BAG_METADATA) for each in found if each.endswith(f"/{BAG_METADATA}")}
    for each in found:
        folder = each[: each.rfind("/") + 1]
        if folder in bags:
            # a ROS 2 bag is one log, where its metadata is in the order
            if each == folder + BAG_METADATA:
                yield FoundLog(folder, folder)
        elif not is_folder or each.lower().endswith(_ENDINGS):
            yield FoundLog(each, each)


def _logs_in(path: Path, folder: Path) -> Iterator[FoundLog]:
    """Yield the logs in a folder: bags, and files with the ending of a log."""
    if (path / BAG_METADATA).is_file():
        yield _found(path, folder)
        return
    for parent, folders, names in os.walk(path):
        if BAG_METADATA in names:
            yield _found(Path(parent), folder)
            folders.clear()
            continue
        # in the order of their names, and without hidden folders
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        here = _found(Path(parent), folder)
        for name in sorted(names):
            if name.lower().endswith(_ENDINGS) and not name.startswith("."):
                # as texts: paths would take most of the time
                shown = name if here.name == "." else f"{here.name}/{name}"
                yield FoundLog(encodable(shown), f"{here.path}/{name}")


def _found(path: Path, folder: Path) -> FoundLog:
    name = path.relative_to(folder) if path.is_relative_to(folder) else path
    return FoundLog(encodable(name.as_posix()), str(path))


def _nothing(text: str, folder: Path) -> str:
    if is_address(text):
        return f"{text}: no log there; check the pattern"
    if has_magic(text):
        return f"{text}: no log matches this pattern; check it, and the folder it starts from"
    # unlike a path's own, this test takes names that no file can have
    if os.path.isdir(folder / text):  # noqa: PTH112
        return f"{text}: no log in this folder; logs end in {', '.join(_ENDINGS)}"
    return f"{text}: no such file; check the path"


class Identities:
    """The identities of logs: hashes of their bytes, or what a server says of a version.

    The path, size, times and inode of a file only decide whether it is hashed again.
    """

    def __init__(self, known: Mapping[str, str]) -> None:
        """Take the identities of an earlier batch by the states of files."""
        self._known = known
        self._states: dict[str, str | None] = {}

    def of(self, paths: Sequence[str], workers: Workers, progress: Progress) -> dict[str, str | None]:
        """Return the identity of each log; None if it cannot be read.

        Args:
            workers: they read the logs that are not known.
            progress: shows how many have been read.
        """
        states = {path: None if is_address(path) else _state(path) for path in paths}
        unknown = [path for path, state in states.items() if state is None or state not in self._known]
        groups = [tuple(unknown[begin : begin + _TOGETHER]) for begin in range(0, len(unknown), _TOGETHER)]
        # few are read sooner than a process begins
        at_work = ThisProcess() if len(groups) == 1 else workers
        found: dict[str, str | None] = {}
        with progress("logs read", len(unknown)) as advance:
            for group, identities in at_work.results(identities_of, groups) if groups else ():
                found |= dict.fromkeys(group) if isinstance(identities, WorkerLost) else identities
                advance(len(group))
        self._states = states
        known = {path: found[path] if path in found else self._known[states[path] or ""] for path in paths}
        self._known = {
            state: identity
            for path, identity in known.items()
            if identity is not None and (state := states[path]) is not None
        }
        return known

    @property
    def by_state(self) -> Mapping[str, str]:
        """The identities that were asked for, for the next batch."""
        return self._known

    def is_unchanged(self, path: str) -> bool:
        """Return whether a file is still what was identified; at an address, readers see to that."""
        return is_address(path) or _state(path) == self._states[path]


def identities_of(paths: tuple[str, ...]) -> dict[str, str | None]:
    """Return the identity of each log; None if it cannot be read."""
    at_once = _TOGETHER if any(map(is_address, paths)) else 1
    with ThreadPoolExecutor(at_once, "identities") as pool:
        return dict(zip(paths, pool.map(_identity, paths), strict=True))


def _identity(path: str) -> str | None:
    try:
        return _version_at(path) if is_address(path) else _hash_of_log(path)
    except (OSError, ValueError, SpatialReplayError):
        return None


def _files_of(path: str) -> list[Path]:
    """Return the files that a log consists of."""
    whole = Path(path)
    return sorted(each for each in whole.iterdir() if each.is_file()) if whole.is_dir() else [whole]


def _state(path: str) -> str | None:
    """Return a hash of what the file system says of a log's files: equal while they are unchanged.

    Returns:
        None if they cannot be read.
    """
    try:
        # not as paths, which take longer than asking the disk
        files = map(str, _files_of(path)) if os.path.isdir(path) else [path]  # noqa: PTH112
        states = [(os.path.realpath(each), os.stat(each)) for each in files]  # noqa: PTH116
    except (OSError, ValueError):
        return None
    text = json.dumps(
        [
            (name, state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
            for name, state in states
        ]
    )
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def _hash_of_log(path: str) -> str:
    files = _files_of(path)
    if len(files) == 1 and Path(path).is_file():
        return _hash_of(files[0])
    total = hashlib.sha256()
    for each in files:
        total.update(f"{each.name}\0{_hash_of(each)}\0".encode("utf-8", "surrogatepass"))
    return f"files:{total.hexdigest()}"


def _version_at(address: str) -> str:
    """Return the identity of a log at an address.

    Raises:
        UsageError, RemoteError: it cannot be read.
    """
    file = log_file(address)
    assert isinstance(file, RemoteFile)
    files = bag_files_at(file) if file.name == BAG_METADATA else [file]
    versions = [(str(each), *_version_of(each)) for each in files]
    return f"version:{hashlib.sha256(json.dumps(versions).encode()).hexdigest()}"


def _version_of(file: RemoteFile) -> tuple[int, str]:
    """Return the size of a remote file, and its strong tag or, without one, the digest of its bytes."""
    version = file.current_version()
    if version.tag is not None and version.tag.startswith('"'):
        return version.size, version.tag
    digest = hashlib.sha256()
    for piece in file.iter_whole():
        digest.update(piece)
    return version.size, digest.hexdigest()


def _hash_of(path: Path) -> str:
    with path.open("rb") as stream:
        return f"sha256:{hashlib.file_digest(stream, 'sha256').hexdigest()}"

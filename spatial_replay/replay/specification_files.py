"""Specification files of a running command, which reads them after saves and writes their constants."""

from __future__ import annotations

import stat
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import Final, TypeAlias

from spatial_replay.errors import MissingFileError, SpatialReplayError, UsageError, importing
from spatial_replay.logs.output_file import replacing
from spatial_replay.spec import parse_specification
from spatial_replay.spec.format import format_duration
from spatial_replay.spec.formula import Constant, Specification
from spatial_replay.spec.load import load_specification, load_specifications

_MARK: Final = b"\xef\xbb\xbf"
"""Byte order mark of UTF-8, which some editors write."""
_SETTLE_S: Final = 0.04
"""Time without a change of size or times after which a file is treated as saved, seconds."""
_ERROR_SETTLE_S: Final = 0.1
"""Further wait for a file that has errors or is missing, because an editor may be writing it, seconds."""
_PATIENCE_S: Final = 1.0
"""Longest wait for a file that keeps changing, seconds."""
_IDLE_MS: Final = 100
"""Timeout of a wait for changes, milliseconds."""
_STEP_MS: Final = 10
"""Wait for further changes after a change, milliseconds."""


_State: TypeAlias = tuple[int, int, int, int]
"""Inode, size (bytes), and times of modification and of status change (ns). A save changes some of these."""


class SpecificationFiles:
    """Specification files that are read again when they are saved.

    The object holds the last read state of the files, and the constants that it wrote into the files. One
    thread watches the files, and other threads may write constants.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        *,
        constants: Mapping[str, float | str] | None = None,
    ) -> None:
        """Set the files without reading them.

        Args:
            constants: values that replace those in the files.

        Raises:
            UsageError: no file is given.
        """
        if not paths:
            raise UsageError("watching needs a specification file to watch; give --spec FILE")
        self.paths = tuple(dict.fromkeys(paths))
        self._constants = dict(constants or {})
        self._read_states: list[_State | None] = []
        self._sources: list[str] = []
        self._written_constants: dict[tuple[int, str], Constant] = {}
        self._lock = Lock()

    def load(self) -> list[Specification]:
        """Parse the files.

        Raises:
            MissingFileError, SpecificationError, UsageError: as `load_specifications`.
        """
        with self._lock:
            # states are read before the files, so that a save during the reading counts as a change
            self._read_states, self._sources = self._state(), []
            files = load_specifications(self.paths, constants=self._constants)
            self._sources = [file.source for file in files]
            self._written_constants = {
                (file_index, name): constant
                for (file_index, name), constant in self._written_constants.items()
                if files[file_index].constants.get(name) == constant
            }
            return files

    def was_written(self, index: int, name: str) -> bool:
        """Return whether a constant of the file at an index still has the value that `write` wrote."""
        return (index, name) in self._written_constants

    def iter_saves(self) -> Iterator[list[Specification] | SpatialReplayError | None]:
        """Yield the files after each save that changes their text, or the error if they cannot be read.

        Between saves it yields None, about ten times a second. A file is treated as saved after 0.04 s
        without a change of size and times. After a further 0.1 s, an invalid or missing file is an error.

        Raises:
            UsageError: the library that watches files is not installed.
        """
        with importing("--watch needs watchfiles", extra="live"):
            from watchfiles import watch
        # a link and its target may be in different folders, and an editor may save either
        watched_paths = {path.absolute() for path in self.paths} | {path.resolve() for path in self.paths}
        file_names = {path.name for path in watched_paths}
        # folders are watched, because many editors replace a file instead of writing into it
        for _ in watch(
            *{path.parent for path in watched_paths},
            watch_filter=lambda change, path: Path(path).name in file_names,
            step=_STEP_MS,
            debounce=_IDLE_MS,
            rust_timeout=_IDLE_MS,
            yield_on_timeout=True,
            recursive=False,
        ):
            yield self._wait_for_save() if self._state() != self._read_states else None

    def write(
        self, values: Sequence[Mapping[str, float | str]] = (), loaded: Sequence[Specification] = ()
    ) -> dict[str, float | str]:
        """Write values of constants into the files, together with the values given to the constructor.

        Args:
            values: new values by name, one mapping per file.
            loaded: files for which the new values were chosen. Constants that another program saved since
                then are refused.

        Returns:
            The changed values by name.
        """
        with self._lock:
            files_with_given = load_specifications(self.paths, constants=self._constants)
            files_as_written = load_specifications(self.paths)
            changed_values: dict[str, float | str] = {}
            for file_index, (path, new_values, file_with_given, file_as_written) in enumerate(
                zip(
                    self.paths,
                    values or [{}] * len(self.paths),
                    files_with_given,
                    files_as_written,
                    strict=True,
                )
            ):
                given_values = {
                    name: value
                    for name, value in plain_values(file_with_given).items()
                    if file_with_given.constants[name] != file_as_written.constants[name]
                }
                if loaded:
                    self._check_saves(
                        file_index, new_values, loaded[file_index].constants, file_with_given.constants
                    )
                values_to_write = {**given_values, **new_values}
                changed_names = write_constants(path, values_to_write)
                changed_values |= {name: values_to_write[name] for name in changed_names}
                saved_file = load_specification(path) if changed_names else file_as_written
                self._written_constants |= {
                    (file_index, name): saved_file.constants[name] for name in changed_names
                }
            self._constants = {}
            return changed_values

    def _check_saves(
        self,
        file_index: int,
        new_names: Iterable[str],
        loaded_constants: Mapping[str, Constant],
        saved_constants: Mapping[str, Constant],
    ) -> None:
        """Refuse to overwrite a value that another program saved after the file was loaded."""
        for name in new_names:
            constant = saved_constants.get(name)
            if constant not in (
                None,
                loaded_constants[name],
                self._written_constants.get((file_index, name)),
            ):
                saved_text = str(constant_value(constant)).removesuffix(".0")
                raise UsageError(
                    f"{name} was just saved as {saved_text}; write it again once the saved file is evaluated"
                )

    def _wait_for_save(self) -> list[Specification] | SpatialReplayError | None:
        """Return the files once they are saved, or their error.

        The result is None if the texts are unchanged, or if the files keep changing.
        """
        previous_sources, deadline_s = self._sources, time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline_s:
            states = self._state()
            time.sleep(_SETTLE_S)
            if self._state() != states:
                continue
            try:
                files = self.load()
            except SpatialReplayError as error:
                time.sleep(_ERROR_SETTLE_S)
                if self._state() == self._read_states:
                    return error
                continue
            if self._state() == self._read_states:
                return files if self._sources != previous_sources else None
        # the last read may have been incomplete, so the next call reads the files again
        self._read_states, self._sources = [], previous_sources
        return None

    def _state(self) -> list[_State | None]:
        """Return the state of each file; None for a missing file."""
        states: list[_State | None] = []
        for path in self.paths:
            try:
                status = path.stat()
            except (OSError, ValueError):
                states.append(None)
            else:
                states.append((status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns))
        return states


def write_constants(path: Path, values: Mapping[str, float | str]) -> tuple[str, ...]:
    """Write values of constants into a specification file, and change only these numbers.

    Args:
        values: numbers, or durations as texts, by name of a constant. Equal values are not written again.

    Returns:
        The names of the constants that changed.

    Raises:
        MissingFileError: the file cannot be read.
        SpecificationError: the file has errors, before or after the change.
        UsageError: a constant is missing, or is computed from other constants.
        OutputError: the file cannot be written.
    """
    try:
        content = path.read_bytes()
        mode = stat.S_IMODE(path.stat().st_mode)
        text = content.removeprefix(_MARK).decode("utf-8")
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from error
    old_file = parse_specification(text, filename=path.name)
    new_file = parse_specification(text, filename=path.name, constants=values)
    changed_values = {
        name: value for name, value in values.items() if old_file.constants[name] != new_file.constants[name]
    }
    if not changed_values:
        return ()
    computed_names = [name for name in changed_values if old_file.constants[name].is_computed]
    if computed_names:
        raise UsageError(
            f"{path.name} computes {', '.join(computed_names)} from other constants; "
            "change those, or write a number there"
        )
    changed_file = parse_specification(text, filename=path.name, constants=changed_values)
    byte_order_mark = _MARK if content.startswith(_MARK) else b""
    with replacing(path) as stream:
        stream.write(byte_order_mark + changed_file.source.encode("utf-8"))
    # `replacing` makes a new file, which gets the mode of the old file
    path.chmod(mode)
    return tuple(changed_values)


def plain_values(file: Specification) -> dict[str, float | str]:
    """Return the values of the constants that are not computed from other constants."""
    return {
        name: constant_value(constant)
        for name, constant in file.constants.items()
        if not constant.is_computed
    }


def constant_value(constant: Constant) -> float | str:
    """Return the value of a constant: a number, or a duration as a text."""
    return constant.value if constant.duration_ns is None else format_duration(constant.duration_ns)

"""Specification files of a running command: read again after saves, with constants that can be written."""

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
"""Time without a change of size and times after which a file counts as saved, seconds."""
_ERROR_SETTLE_S: Final = 0.1
"""Further wait for a file that has errors or is missing, because an editor may be writing it, seconds."""
_PATIENCE_S: Final = 1.0
"""Longest wait for a file that keeps changing, seconds."""
_IDLE_MS: Final = 100
_STEP_MS: Final = 10
"""Timeout for a change, and wait for further changes after one, milliseconds."""


_State: TypeAlias = tuple[int, int, int, int]
"""Inode, size and times of a file; one of them differs after a save."""


class SpecificationFiles:
    """Specification files that are read again when they are saved.

    The object holds the last read state of the files, and the constants that were written into them. One
    thread watches, and others may write.
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
        self._read: list[_State | None] = []
        self._sources: list[str] = []
        self._written: dict[tuple[int, str], Constant] = {}
        self._turn = Lock()

    def load(self) -> list[Specification]:
        """Parse the files.

        Raises:
            MissingFileError, SpecificationError, UsageError: as `load_specifications`.
        """
        with self._turn:
            # before the files are read, so that a save during the reading counts as a change
            self._read, self._sources = self._state(), []
            files = load_specifications(self.paths, constants=self._constants)
            self._sources = [file.source for file in files]
            self._written = {
                (index, name): value
                for (index, name), value in self._written.items()
                if files[index].constants.get(name) == value
            }
            return files

    def was_written(self, index: int, name: str) -> bool:
        """Return whether a constant has the value that `write` wrote, given the number of its file."""
        return (index, name) in self._written

    def iter_saves(self) -> Iterator[list[Specification] | SpatialReplayError | None]:
        """Yield the files after each save of another text, or the error if they cannot be read.

        Between saves it yields None, about ten times a second. A file counts as saved after 0.04 s without a
        change of size and times. A file with errors, or a missing one, gets 0.1 s more.

        Raises:
            UsageError: the library that watches files is not installed.
        """
        with importing("--watch needs watchfiles", extra="live"):
            from watchfiles import watch
        # a link and its target lie in different folders, and either may be saved
        places = {path.absolute() for path in self.paths} | {path.resolve() for path in self.paths}
        names = {path.name for path in places}
        # folders are watched, because many editors replace a file instead of writing into it
        for _ in watch(
            *{path.parent for path in places},
            watch_filter=lambda change, path: Path(path).name in names,
            step=_STEP_MS,
            debounce=_IDLE_MS,
            rust_timeout=_IDLE_MS,
            yield_on_timeout=True,
            recursive=False,
        ):
            yield self._wait_for_save() if self._state() != self._read else None

    def write(
        self, values: Sequence[Mapping[str, float | str]] = (), loaded: Sequence[Specification] = ()
    ) -> dict[str, float | str]:
        """Write values of constants into the files, together with the values given at the start.

        Args:
            values: values by name for each of the files, in addition to those given at the start.
            loaded: the files as they were loaded when the values were chosen.

        Returns:
            The changed values by name.
        """
        with self._turn:
            files = load_specifications(self.paths, constants=self._constants)
            plain = load_specifications(self.paths)
            changed: dict[str, float | str] = {}
            for index, (path, new_values, with_given, file_as_written) in enumerate(
                zip(self.paths, values or [{}] * len(self.paths), files, plain, strict=True)
            ):
                given_values = {
                    name: value
                    for name, value in plain_values(with_given).items()
                    if with_given.constants[name] != file_as_written.constants[name]
                }
                if loaded:
                    self._check_saves(index, new_values, loaded[index].constants, with_given.constants)
                new = {**given_values, **new_values}
                names = write_constants(path, new)
                changed |= {name: new[name] for name in names}
                after = load_specification(path) if names else file_as_written
                self._written |= {(index, name): after.constants[name] for name in names}
            self._constants = {}
            return changed

    def _check_saves(
        self,
        index: int,
        names: Iterable[str],
        loaded: Mapping[str, Constant],
        present: Mapping[str, Constant],
    ) -> None:
        """Refuse to overwrite a number that was saved by somebody else after the file was loaded."""
        for name in names:
            constant = present.get(name)
            if constant not in (None, loaded[name], self._written.get((index, name))):
                saved = str(constant_value(constant)).removesuffix(".0")
                raise UsageError(
                    f"{name} was just saved as {saved}; write it again once the saved file is evaluated"
                )

    def _wait_for_save(self) -> list[Specification] | SpatialReplayError | None:
        """Return the saved files; None if their texts are unchanged, or if they keep changing."""
        before, give_up = self._sources, time.monotonic() + _PATIENCE_S
        while time.monotonic() < give_up:
            state = self._state()
            time.sleep(_SETTLE_S)
            if self._state() != state:
                continue
            try:
                files = self.load()
            except SpatialReplayError as error:
                time.sleep(_ERROR_SETTLE_S)
                if self._state() == self._read:
                    return error
                continue
            if self._state() == self._read:
                return files if self._sources != before else None
        # the last read may have been incomplete, so the next call reads the files again
        self._read, self._sources = [], before
        return None

    def _state(self) -> list[_State | None]:
        """Return the states of the files; None for a missing file."""
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
        values: numbers, and durations as texts, by name; a value that the file already has is not rewritten.

    Returns:
        The names of the constants that changed.

    Raises:
        MissingFileError: the file cannot be read.
        SpecificationError: the file has errors, now or with these values.
        UsageError: a constant is missing, or is computed from others.
        OutputError: the file cannot be written.
    """
    try:
        content = path.read_bytes()
        mode = stat.S_IMODE(path.stat().st_mode)
        text = content.removeprefix(_MARK).decode("utf-8")
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from error
    before = parse_specification(text, filename=path.name)
    after = parse_specification(text, filename=path.name, constants=values)
    changed = {
        name: value for name, value in values.items() if before.constants[name] != after.constants[name]
    }
    if not changed:
        return ()
    computed = [name for name in changed if before.constants[name].is_computed]
    if computed:
        raise UsageError(
            f"{path.name} computes {', '.join(computed)} from other constants; "
            "change those, or write a number there"
        )
    changed_file = parse_specification(text, filename=path.name, constants=changed)
    mark = _MARK if content.startswith(_MARK) else b""
    with replacing(path) as stream:
        stream.write(mark + changed_file.source.encode("utf-8"))
    # `replacing` makes a new file, which gets the mode of the old one
    path.chmod(mode)
    return tuple(changed)


def plain_values(file: Specification) -> dict[str, float | str]:
    """Return the values of the constants that are not computed from others."""
    return {
        name: constant_value(constant)
        for name, constant in file.constants.items()
        if not constant.is_computed
    }


def constant_value(constant: Constant) -> float | str:
    """Return the value of a constant: a number, or a duration as a text."""
    return constant.value if constant.duration_ns is None else format_duration(constant.duration_ns)

"""Output files, which appear under their name only when they are complete."""

from __future__ import annotations

import errno
import io
import os
import secrets
import stat
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeAlias, get_args

from spatial_replay.errors import OutputError, UsageError, system_reason

_SCHEMES = ("s3:", "gs:", "az:", "http:", "https:")
_CREATE = os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0)


@contextmanager
def replacing(output: Path, inputs: Iterable[Path] = ()) -> Iterator[BinaryIO]:
    """Open a stream to a temporary file, which replaces `output` when the block ends without an error.

    After an error or an interruption, `output` is unchanged and no partial file is left. Errors of the block
    itself pass through unchanged.

    Raises:
        UsageError: the output is an input or a folder, or its folder does not exist.
        OutputError: the file cannot be written.
    """
    refuse_inputs(output, inputs)
    if output.exists() and not output.is_file():
        # a device or a pipe is written in place, and must never be replaced by a file
        with open_output(output) as stream:
            yield stream
        return
    # a symbolic link stays, and its target is replaced
    output = output.resolve()
    # named before the file is created, so that `finally` removes it after an interruption at any step
    partial_path = output.with_name(f".{output.name}.{secrets.token_hex(8)}.partial")
    try:
        with _writing(output):
            # O_EXCL keeps two writers from sharing a partial file; 0o666 leaves the mode to the umask
            descriptor = os.open(partial_path, _CREATE | os.O_EXCL, 0o666)
        with _stream(descriptor, output) as stream:
            yield stream
        with _writing(output):
            partial_path.replace(output)
    finally:
        # a partial file that was not created, or was renamed, is missing
        with suppress(OSError):
            partial_path.unlink()


Durability: TypeAlias = Literal["process", "disk"]
"""Failure that a flushed file survives: a crash of the process, or also a crash of the machine ("disk")."""


def open_output(output: Path, durability: Durability = "process", *, overwrite: bool = True) -> BinaryIO:
    """Open a file to write in place. Failures to open, write or close the file are OutputErrors.

    Args:
        durability: "disk" makes every flush wait until the disk has the data.
        overwrite: whether a file with content may be replaced.

    Raises:
        UsageError: an unknown durability, or a file that must not be overwritten.
        OutputError: the file cannot be written, or is open for writing in this or another program.
    """
    if durability not in get_args(Durability):
        raise UsageError(f"durability is {durability!r}; give 'process' or 'disk'")
    with _writing(output):
        descriptor = os.open(output, _CREATE, 0o666)
    try:
        with _writing(output):
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                # only the owner of the lock may empty the file
                _lock(descriptor, output)
                if not overwrite:
                    refuse_existing(output)
                os.ftruncate(descriptor, 0)
        return _stream(descriptor, output, durability)
    except BaseException:
        os.close(descriptor)
        raise


def _lock(descriptor: int, output: Path) -> None:
    """Lock a file until it is closed; the lock ends with its process."""
    if sys.platform == "win32":
        return
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(
            f"{output} is being written by another recorder or program; give this log another name"
        ) from None
    except OSError:
        # some network file systems have no locks
        return


def _stream(file: int, output: Path, durability: Durability = "process") -> BinaryIO:
    with _writing(output):
        stream_type = io.BufferedWriter if durability == "process" else _DurableWriter
        return stream_type(_OutputFile(file, output), 1 << 20)


class _DurableWriter(io.BufferedWriter):
    """A stream that waits for the disk at every flush, also when it is closed."""

    def flush(self) -> None:
        super().flush()
        # pipes and devices have no disk
        if stat.S_ISREG(os.fstat(self.fileno()).st_mode):
            with _writing(Path(str(self.name))):
                os.fsync(self.fileno())


class _OutputFile(io.FileIO):
    """An unbuffered file whose failures are OutputErrors, also if a library writes to it.

    A forked process writes nothing to the file, because bytes in the shared buffer would be written twice.
    """

    def __init__(self, file: int, output: Path) -> None:
        super().__init__(file, "wb")
        self._output = output
        self._process = os.getpid()

    # collections.abc.Buffer exists from Python 3.12 on
    def write(self, data: Any, /) -> int:
        if os.getpid() != self._process:
            return memoryview(data).nbytes
        with _writing(self._output):
            return super().write(data)

    def close(self) -> None:
        with _writing(self._output):
            super().close()


@contextmanager
def _writing(output: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise output_error(output, error) from error


def refuse_inputs(output: Path, inputs: Iterable[Path]) -> None:
    """Check that an output may be written.

    Raises:
        UsageError: the output is an input or a folder, is in an input folder, or its folder does not exist.
    """
    refuse_addresses(output)
    try:
        output.lstat()
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        # these errors are reported below, or when the file is opened
        pass
    except (OSError, ValueError) as error:
        raise UsageError(
            f"{output} cannot be written: {system_reason(error)}; give the output another name"
        ) from None
    if output.is_dir():
        raise UsageError(f"{output} is a folder; give the name of a file in it")
    if not output.parent.is_dir():
        raise UsageError(f"{output} cannot be written: there is no folder {output.parent}; create it first")
    for path in inputs:
        if output.exists() and path.exists() and output.samefile(path):
            raise UsageError(f"{output} is an input too and would be lost; give the output another name")
        if path.is_dir() and output.resolve().is_relative_to(path.resolve()):
            raise UsageError(f"{output} lies in the folder {path}, which is an input; write it elsewhere")


def refuse_ending(output: Path) -> None:
    """Check that the name of a log does not end like a file of another kind, such as .csv.

    Raises:
        UsageError: the name has such an ending.
    """
    commands = {".csv": "export", ".parquet": "export", ".html": "report", ".json": "", ".jsonl": ""}
    command = commands.get(output.suffix.lower())
    if command is not None:
        remedy = f"; {output} is written by spatial-replay {command}" if command else ""
        raise UsageError(f"{output}: the output is a log (MCAP); name it {output.stem}.mcap{remedy}")


def refuse_existing(output: Path) -> None:
    """Check that an output overwrites no recording, because a recording cannot be repeated.

    Raises:
        UsageError: the file exists and has content.
    """
    if output.is_file() and output.stat().st_size:
        remedy = "give another name, or --overwrite (`overwrite=True`) to replace it"
        raise UsageError(f"{output} exists already; {remedy}")


def refuse_addresses(output: Path, remedy: str = "write to this machine, and copy that") -> None:
    """Check that an output is on this machine.

    Raises:
        UsageError: the output is an address.
    """
    if output.parts and output.parts[0] in _SCHEMES:
        address = str(output).replace(":/", "://", 1)
        raise UsageError(f"{address} is an address; {remedy}")


def output_error(output: Path, error: OSError) -> OutputError:
    """Return the OutputError of a failed write, with its reason."""
    reason = "no space left on the device" if error.errno == errno.ENOSPC else error.strerror or str(error)
    return OutputError(f"{output} could not be written: {reason}")

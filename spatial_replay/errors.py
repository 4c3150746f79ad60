"""The errors that spatial-replay raises, in one tree.

    SpatialReplayError
    ├── UsageError              an invalid call or combination of options
    │   ├── MissingFileError    a file does not exist or cannot be opened
    │   └── NoAutomatonError    a formula without an automaton, or with too large an automaton
    ├── SpecificationError      an invalid specification, with all its errors
    ├── GeometryError           invalid footprint coordinates
    ├── TraceError              samples that do not form a trace
    ├── LogError                a log that is damaged or breaks its format
    │   ├── RemoteError         an address that does not answer, or whose file changes
    │   └── UnfitLogError       a log that does not meet a requirement of a suite
    ├── OutputError             an output could not be written
    └── ClusterError            a cluster of computers is lost

Every message names the wrong value, its place and the remedy.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike, fspath, strerror
from typing import Final, Protocol, Self

_ERROR_NUMBER: Final = re.compile(r"\[Errno (\d+)\]")


def system_reason(error: Exception) -> str:
    """Return the system's message for an error, in lower case: "permission denied"."""
    number = getattr(error, "errno", None)
    if number is None and (match := _ERROR_NUMBER.search(str(error))) is not None:
        # several attempts to connect failed, each with its own error
        number = int(match[1])
    # `strerror` has no message for the negative numbers of getaddrinfo's errors
    reason = strerror(number) if number is not None and number > 0 else getattr(error, "strerror", None)
    return (reason or str(error) or type(error).__name__).lower()


@contextmanager
def importing(what: str, *, extra: str) -> Iterator[None]:
    """Raise UsageError with a remedy if an optional library cannot be imported in this context.

    Args:
        what: the feature with its library: "videos need PyAV".
        extra: extra of this package that installs the library.

    Raises:
        UsageError: the library is not installed.
    """
    try:
        yield
    except ImportError:
        remedy = f"pip install 'spatial-replay[{extra}]'"
        raise UsageError(f"{what}, which is not installed: {remedy}") from None


class SpatialReplayError(Exception):
    """The base class of all errors of this package."""


class UsageError(SpatialReplayError):
    """An invalid call, option or combination of options."""


class MissingFileError(UsageError):
    """A file that does not exist or cannot be opened."""

    @classmethod
    def of(cls, path: str | PathLike[str], error: OSError | ValueError) -> Self:
        """Return the error for a file that could not be opened or read."""
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            reason = "no such file"
        else:
            reason = system_reason(error)
        return cls(f"{fspath(path)}: {reason}; check the path")


class NoAutomatonError(UsageError):
    """A formula without an automaton, or with too large an automaton.

    Attributes:
        reason: the cause, without place and remedy.
    """

    def __init__(self, message: str, reason: str | None = None) -> None:
        super().__init__(message)
        self.reason = message if reason is None else reason


class Diagnosis(Protocol):
    """One error in a specification. `str()` returns its text with line, column and caret."""

    @property
    def message(self) -> str: ...

    @property
    def line(self) -> int: ...

    @property
    def column(self) -> int: ...


class SpecificationError(SpatialReplayError):
    """An invalid specification.

    Attributes:
        diagnoses: all errors, in the order of the text.
    """

    def __init__(self, diagnoses: Sequence[Diagnosis]) -> None:
        self.diagnoses = tuple(diagnoses)
        super().__init__("\n".join(str(diagnosis) for diagnosis in self.diagnoses))


class GeometryError(SpatialReplayError, ValueError):
    """Coordinates, radii or heights that do not form a footprint."""


class TraceError(SpatialReplayError, ValueError):
    """Samples that do not form a trace: times that do not increase, a name that appears twice."""


class LogError(SpatialReplayError):
    """A log that is damaged or breaks its format."""


class RemoteError(LogError):
    """A log at an address that does not answer, breaks off, or is replaced while it is read."""


class UnfitLogError(LogError):
    """A log that does not meet a requirement of a suite: topics, rates, objects."""


class OutputError(SpatialReplayError):
    """An output that could not be written: no space, no permission."""


class ClusterError(SpatialReplayError):
    """A cluster whose scheduler has stopped answering."""

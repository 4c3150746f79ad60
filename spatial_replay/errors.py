"""The errors that spatial-replay raises, in one tree.

    SpatialReplayError
    ├── UsageError              a call or an option that cannot work
    │   ├── MissingFileError    a named file is not there
    │   └── NoAutomatonError    a formula that has no automaton, or too large a one
    ├── SpecificationError      a specification with faults, all of them listed
    ├── GeometryError           coordinates that make no footprint
    ├── TraceError              samples that make no trace
    ├── LogError                a log that is damaged or breaks its format
    └── OutputError             the machine could not write what was asked for

Every message names the value that is wrong, the place where it stands and what to do about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike, fspath
from typing import Protocol, Self


class SpatialReplayError(Exception):
    """Any error of this package; catch it to catch them all."""


class UsageError(SpatialReplayError):
    """A call, an option or a combination of them that cannot work."""


class MissingFileError(UsageError):
    """A file that was named does not exist or cannot be opened."""

    @classmethod
    def of(cls, path: str | PathLike[str], error: OSError | ValueError) -> Self:
        """The error for a file that could not be opened or read."""
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            reason = "no such file"
        else:
            reason = (getattr(error, "strerror", None) or str(error) or "cannot be read").lower()
        return cls(f"{fspath(path)}: {reason}; check the path")


class NoAutomatonError(UsageError):
    """A formula that has no automaton, or one that is too large.

    Attributes:
        reason: why not, without place and remedy.
    """

    def __init__(self, message: str, reason: str | None = None) -> None:
        super().__init__(message)
        self.reason = message if reason is None else reason


class Diagnosis(Protocol):
    """One fault in a specification; str() gives its text with line, column and caret."""

    @property
    def message(self) -> str: ...

    @property
    def line(self) -> int: ...

    @property
    def column(self) -> int: ...


class SpecificationError(SpatialReplayError):
    """A specification with faults.

    Attributes:
        diagnoses: every fault found, in the order of the text.
    """

    def __init__(self, diagnoses: Sequence[Diagnosis]) -> None:
        self.diagnoses = tuple(diagnoses)
        super().__init__("\n".join(str(diagnosis) for diagnosis in self.diagnoses))


class GeometryError(SpatialReplayError, ValueError):
    """Coordinates, radii or heights that make no footprint."""


class TraceError(SpatialReplayError, ValueError):
    """Samples that make no trace: times that do not increase, a name that appears twice."""


class LogError(SpatialReplayError):
    """A log that is damaged or breaks its format."""


class OutputError(SpatialReplayError):
    """An output could not be written: no space, no permission."""

"""Mapping files: from text to values, with all faults at once."""

from __future__ import annotations

from os import PathLike

from spatial_replay.logs.mapping.model import Mapping


def load_mapping(path: str | PathLike[str]) -> Mapping:
    """The mapping in a file.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is no mapping; all its faults are listed.
    """
    raise NotImplementedError


def parse_mapping(text: str, name: str = "mapping") -> Mapping:
    """The mapping that a text holds.

    Raises:
        UsageError: it is no mapping; all its faults are listed.
    """
    raise NotImplementedError

"""How much of a planned run a log has: all of it, or a part."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import NamedTuple

from spatial_replay.errors import LogError
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import ENDING, METADATA


class Extent(NamedTuple):
    """What a log's metadata says of the run.

    Attributes:
        samples: of the run; None where it did not come to an end.
        was_interrupted: whether it was ended from outside.
        is_copy: whether a replay wrote the log.
        is_cut: whether that replay began after the source's first sample, as far as it was told to.
    """

    samples: int | None
    was_interrupted: bool
    is_copy: bool
    is_cut: bool

    def is_whole(self, samples: int) -> bool:
        """Whether a log of so many samples has the run to its proper end."""
        return samples == self.samples and not self.was_interrupted

    def is_part(self, samples: int) -> bool:
        """Whether a log of so many samples may lack some of the run."""
        return self.is_copy if self.samples is None else samples < self.samples


def extent_of(source: Source) -> Extent:
    """What a log's metadata says.

    Raises:
        LogError: it cannot be read.
    """
    metadata = dict(source.metadata())
    ending, about = metadata.get(ENDING, {}), metadata.get(METADATA, {})
    is_copy = about.get("written_by") == "replay"
    options = _value(about, "options", {}) if is_copy else {}
    samples = _value(ending, "samples", None)
    if not isinstance(options, dict) or not isinstance(samples, int | None):
        raise LogError(f"the metadata of {source.name} tells of {samples!r} samples and options {options!r}")
    return Extent(samples, _value(ending, "interrupted", False) is not False, is_copy, "start_ns" in options)


def _value(texts: Mapping[str, str], key: str, otherwise: object) -> object:
    try:
        return json.loads(texts[key]) if key in texts else otherwise
    except ValueError as error:
        raise LogError(f"{key!r} in the log's metadata cannot be read: {error}") from error

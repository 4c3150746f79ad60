"""The specification files of a batch: read, checked, and known by what they mean."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from spatial_replay.batch.rows import spec_lines
from spatial_replay.batch.suite import Case
from spatial_replay.errors import UsageError
from spatial_replay.logs.downloads import local_copy
from spatial_replay.logs.remote import RemoteFile, log_file
from spatial_replay.monitor.instances import Choice
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.format import format_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.overrides import SpecificationText
from spatial_replay.text import encodable

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

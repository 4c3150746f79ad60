"""The specification files of a batch: parsed, checked all together, and known by what they mean."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from spatial_replay.batch.rows import parsed_specifications, spec_lines
from spatial_replay.batch.suite import Case, Suite
from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.logs.downloads import local_copy
from spatial_replay.logs.remote import RemoteFile, log_file
from spatial_replay.mapping.mapping_file import load_mapping
from spatial_replay.monitor.instances import Choice
from spatial_replay.spec.format import format_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.overrides import SpecificationText

HASH_DIGITS: Final = 32
"""Digits of a hash in a name."""


@dataclass(frozen=True, slots=True)
class SpecFile:
    """A specification file of a case, parsed with the case's constants.

    Attributes:
        name: as it is written: relative to the suite's folder.
        hash: of its meaning, with ids and titles: layout and comments do not count.
        lines: the line of each spec.
    """

    name: str
    text: SpecificationText
    hash: str
    lines: tuple[tuple[str, int], ...]


def checked_spec_files(suite: Suite) -> list[tuple[SpecFile, ...]]:
    """Return the specification files of each case, checked; all errors are reported together.

    Raises:
        SpecificationError: specifications with errors.
        UsageError: files that cannot be used, templates without objects.
    """
    texts: dict[Path | str, SpecificationText] = {}
    files: list[tuple[SpecFile, ...]] = []
    diagnoses: dict[str, Any] = {}
    faults: dict[str, None] = {}
    for case in suite.cases:
        try:
            for path in case.specs:
                if path not in texts:
                    texts[path] = read_specification_text(path)
            own = tuple(texts[path] for path in case.specs)
            parsed = parsed_specifications(own, case.conditions)
            _check_each(case, parsed)
            if case.conditions.mapping is not None:
                load_mapping(case.conditions.mapping)
        except SpecificationError as error:
            diagnoses.update((str(each), each) for each in error.diagnoses)
            continue
        except UsageError as error:
            faults[f"case {case.name!r}: {error}"] = None
            continue
        names = [_shown(path, suite.folder) for path in case.specs]
        files.append(tuple(map(_spec_file, names, own, parsed)))
    if diagnoses:
        raise SpecificationError(list(diagnoses.values()))
    if faults:
        raise UsageError("\n".join(faults))
    return files


def read_specification_text(path: Path | str) -> SpecificationText:
    """Read the text of a specification at a path or an address, with its errors.

    Raises:
        MissingFileError, UsageError, SpecificationError: see `load_specification`.
    """
    from spatial_replay.spec.load import load_specification

    return SpecificationText(load_specification(local_copy(path)).source, log_file(path).name)


def _spec_file(name: str, text: SpecificationText, parsed: Specification) -> SpecFile:
    meaning = f"{parsed.profile}\n{format_specification(parsed)}"
    digest = hashlib.sha256(meaning.encode("utf-8", "surrogatepass")).hexdigest()[:HASH_DIGITS]
    return SpecFile(name, text, digest, tuple(spec_lines(parsed).items()))


def _shown(file: Path | str, folder: Path) -> str:
    path = log_file(file)
    if isinstance(path, RemoteFile):
        return str(path)
    return (path.relative_to(folder) if path.is_relative_to(folder) else path).as_posix()


def _check_each(case: Case, files: Sequence[Specification]) -> None:
    """Check the objects that a case chooses for the parameters of its templates."""
    templates = [spec for file in files for spec in file.results if spec.parameter is not None]
    parameters = {spec.parameter for spec in templates}
    chosen = dict(case.conditions.each)
    for parameter, objects in chosen.items():
        Choice.parse(parameter, objects)
        if parameter not in parameters:
            known = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates) or "none"
            raise UsageError(f"no template has a parameter {parameter!r}; templates here: {known}")
    for spec in templates:
        if spec.parameter not in chosen:
            raise UsageError(
                f"{spec.name} is a template; say which objects {spec.parameter} stands for: "
                f"--each {spec.parameter}=class:NAME or each: {{{spec.parameter}: all}}"
            )

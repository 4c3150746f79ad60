"""Constants given from outside, for the specifications of several files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from spatial_replay.errors import UsageError
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import load_specification, parse_specification

_FORMULA = re.compile(r"[(<>=]")
"""What a formula has, and the name of a file hardly ever."""
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?", re.ASCII)


def constants_from_texts(texts: Iterable[str]) -> dict[str, float | str]:
    """Read values of constants as they are written on a command line: `near=80`, `hold=2s`.

    Returns:
        A number or, as a text, a duration for each name.

    Raises:
        UsageError: no `NAME=VALUE`, or a name that is given twice.
    """
    constants: dict[str, float | str] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (equals and name and value):
            raise UsageError(f"{text!r} is incomplete; write NAME=VALUE, such as near=80 or hold=2s")
        if name in constants:
            raise UsageError(f"{name!r} is given twice; give one value")
        constants[name] = float(value) if _NUMBER.fullmatch(value) else value
    return constants


@dataclass(frozen=True, slots=True)
class SpecificationText:
    """The text of a specification, and the name of the file that it is from."""

    text: str
    filename: str


def load_specifications(
    sources: Sequence[Path | SpecificationText],
    *,
    profile: str | None = None,
    constants: Mapping[str, float | str] | None = None,
) -> list[Specification]:
    """Parse several files or texts, with values in place of those of their constants.

    Args:
        constants: a value for every file that has a constant of the name; `STEM.NAME` is the one of the file
            of that stem.

    Raises:
        MissingFileError: a file that cannot be read.
        SpecificationError: a specification with errors.
        UsageError: a constant that no file has, or a value of another kind.
    """
    files = [_parsed(source, profile, {}) for source in sources]
    if not constants:
        return files
    _check_names(files, constants)
    own = [_own_constants(file, constants) for file in files]
    return [
        _parsed(source, profile, values) if values else file
        for source, file, values in zip(sources, files, own, strict=True)
    ]


def _parsed(
    source: Path | SpecificationText, profile: str | None, constants: Mapping[str, float | str]
) -> Specification:
    if isinstance(source, SpecificationText):
        return parse_specification(
            source.text, filename=source.filename, profile=profile, constants=constants
        )
    written = str(source)
    if _FORMULA.search(written) and not written.endswith(".spatial") and not source.exists():
        return parse_specification(written, filename="<formula>", profile=profile, constants=constants)
    if source.suffix in (".yaml", ".yml"):
        raise UsageError(f"{source.name} is a mapping, not a specification; give it by --mapping")
    return load_specification(source, profile=profile, constants=constants)


def _qualified(file: Specification, constant: str) -> str:
    return f"{PurePath(file.filename).stem}.{constant}"


def _own_constants(file: Specification, constants: Mapping[str, float | str]) -> dict[str, float | str]:
    """Return the values that are for constants of this file, by their names in it."""
    return {
        own: constants[given]
        for own in file.constants
        for given in (own, _qualified(file, own))
        if given in constants
    }


def _check_names(files: Sequence[Specification], constants: Mapping[str, float | str]) -> None:
    """Check that some file has each of the constants."""
    own = dict.fromkeys(name for file in files for name in file.constants)
    known = {*own, *(_qualified(file, name) for file in files for name in file.constants)}
    for name in constants:
        if name not in known:
            hint = nearest_hint(name, known) or f"the constants are: {', '.join(own) or 'none'}"
            raise UsageError(f"there is no constant {name!r}; {hint}")

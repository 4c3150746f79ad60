"""Constants given from outside: for the specifications of several files, and written into their texts."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from lark import Token

from spatial_replay.errors import UsageError
from spatial_replay.spec.diagnostics import Faults, SourceText, nearest_hint
from spatial_replay.spec.format import format_duration, format_number
from spatial_replay.spec.formula import Constant, Specification
from spatial_replay.spec.load import load_specification, parse_specification
from spatial_replay.spec.parser import split_statements
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.tokens import tokenize

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


def text_with_constants(file: Specification) -> str:
    """Return the text of a specification with its constants' values, comments and everything else kept.

    A constant that repeats another one follows it and stays as it is written.
    """
    text = file.source
    for _ in file.constants:
        written = parse_specification(text, filename=file.filename, profile=file.profile).constants
        changed = [name for name, value in file.constants.items() if written.get(name) != value]
        if not changed:
            break
        values = _values_by_name(text)
        # one that is a plain number first: others may follow from it
        name = min(changed, key=lambda each: any(token.type == "NAME" for token in values.get(each, ())))
        if name not in values:
            break
        tokens = values[name]
        start, end = tokens[0].start_pos or 0, tokens[-1].end_pos or 0
        text = f"{text[:start]}{_written(file.constants[name])}{text[end:]}"
    return text


def _parsed(
    source: Path | SpecificationText, profile: str | None, constants: Mapping[str, float | str]
) -> Specification:
    if isinstance(source, SpecificationText):
        return parse_specification(
            source.text, filename=source.filename, profile=profile, constants=constants
        )
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


def _values_by_name(text: str) -> dict[str, Sequence[Token]]:
    """Return the tokens of the value of each constant that a text defines."""
    faults = Faults(SourceText.of(text, "<text>"))
    values: dict[str, Sequence[Token]] = {}
    for group in split_statements(tokenize(text, RELATION_NAMES, faults), faults):
        match group.tokens:
            case [Token(type="CONST"), Token() as name, Token(type="EQUAL"), *value] if value:
                ends = (index for index, token in enumerate(value) if token.type == "IN")
                values.setdefault(str(name), value[: next(ends, len(value))])
    return values


def _written(constant: Constant) -> str:
    if constant.duration_ns is not None:
        return format_duration(constant.duration_ns)
    return format_number(constant.value)

"""Specifications from texts and files, and constants given from outside."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from os import PathLike
from pathlib import Path, PurePath
from reprlib import repr as shortened
from typing import Any

from lark import Token

from spatial_replay.errors import MissingFileError, SpecificationError, UsageError
from spatial_replay.spec.checks import (
    equality_warnings,
    past_warnings,
    reach_warnings,
    scale_warnings,
    unused_warnings,
)
from spatial_replay.spec.constants import replaced
from spatial_replay.spec.diagnostics import Diagnostic, Faults, SourceText, nearest_hint
from spatial_replay.spec.elaborate import Elaborator, TooLargeError, parameters_of
from spatial_replay.spec.formula import Expression, Span, Specification
from spatial_replay.spec.parser import parse_statements
from spatial_replay.spec.relations import DEFAULT_PROFILE, PROFILES, RELATION_NAMES, Relation
from spatial_replay.spec.resolve import Namespace
from spatial_replay.spec.syntax import BrokenStatement, ConstStatement, SpecStatement, Statement, UseStatement
from spatial_replay.spec.tokens import MAX_TOKENS, is_reserved, tokenize
from spatial_replay.text import encodable

MAX_LENGTH = 256 * 1024
"""Characters of a text."""

_MAX_WARNINGS = 100
_RELATION_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


def parse_specification(
    text: str,
    *,
    filename: str = "<text>",
    profile: str | None = None,
    relations: Mapping[str, Callable[..., Expression]] | None = None,
    constants: Mapping[str, float | str] | None = None,
) -> Specification:
    """Parse a specification, or a formula by itself.

    Args:
        text: statements, or one formula, which becomes a spec named "spec".
        filename: named in messages.
        profile: relation profile of a text without a `use` line: "paper" (the default) or "spatial_spec".
        relations: further relations by name, as functions; see `relations`.
        constants: values to put into the text's `const` lines: numbers and, as texts, durations such as
            "2s"; `Specification.source` has them, with the comments and all else as it was.

    Raises:
        SpecificationError: with every fault of the text.
        UsageError: no text, an unknown profile, a relation that does not take terms and numbers, a
            constant that the text does not have, a number for a duration or the reverse.
    """
    _require_text(text)
    given = dict(relations or {})
    _check_relations(given)
    if profile is not None and profile not in PROFILES:
        raise UsageError(f"unknown profile {profile!r}; the profiles are {', '.join(PROFILES)}")
    text = text.removeprefix("\ufeff")
    names = RELATION_NAMES.union(given)
    if constants:
        text = _constant_writer(text, filename, names)(constants)
    faults = Faults(SourceText.of(text, filename))
    tokens = _tokens(text, names, faults)
    statements = parse_statements(tokens, names, faults)
    used_profile = _profile(statements, faults) or profile or DEFAULT_PROFILE
    namespace = Namespace(faults)
    namespace.declare(statements)
    listed = namespace.constant_ranges()
    elaborator = Elaborator(
        namespace, {**PROFILES[used_profile], **given}, frozenset(token.value for token in tokens), faults
    )
    specs = [statement for statement in statements if isinstance(statement, SpecStatement)]
    if not specs and not any(isinstance(statement, BrokenStatement) for statement in statements):
        end = Span(len(text), len(text))
        if not faults.found:
            faults.add(end, "this text holds no spec", "write a formula, or: spec name = formula")
    try:
        done = elaborator.specs(specs)
    except TooLargeError:
        done = ()
    faults.raise_if_any()
    warnings: list[Diagnostic] = [
        *reach_warnings(tokens, faults.source, used_profile == "spatial_spec"),
        *past_warnings(done, faults.source),
        *equality_warnings(done, faults.source),
        *unused_warnings(namespace, faults.source),
        *scale_warnings(statements, done, faults.source),
    ]
    warnings.sort(key=lambda warning: (warning.line, warning.column))
    return Specification(
        done,
        used_profile,
        namespace.regions,
        namespace.groups,
        frozenset(given),
        listed,
        scales=tuple(namespace.scales),
        source=text,
        filename=encodable(filename),
        warnings=tuple(warnings[:_MAX_WARNINGS]),
    )


def load_specification(
    path: str | Path,
    *,
    profile: str | None = None,
    relations: Mapping[str, Callable[..., Expression]] | None = None,
    constants: Mapping[str, float | str] | None = None,
) -> Specification:
    """Parse a specification file (UTF-8); see `parse_specification`.

    Raises:
        MissingFileError: no such file, or one that cannot be read.
        SpecificationError: with every fault of the text.
        UsageError: no path, and what `parse_specification` raises.
    """
    _require_path(path)
    path = Path(path)
    try:
        with path.open("rb") as file:
            content = file.read(4 * MAX_LENGTH + 4)
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from error
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        before = content[: error.start].decode("utf-8")
        source = SourceText.of(before + "\ufffd", path.name)
        message = f"byte 0x{content[error.start]:02x} is not UTF-8 text"
        hint = "save the file as UTF-8"
        place = Span(len(before), len(before) + 1)
        raise SpecificationError([source.diagnostic("error", place, message, hint)]) from error
    return parse_specification(
        text, filename=path.name, profile=profile, relations=relations, constants=constants
    )


def require_specification(value: object) -> None:
    """Refuse anything but a specification.

    Raises:
        UsageError: it is something else.
    """
    if not isinstance(value, Specification):
        remedy = "give a Specification, from parse_specification(text) or load_specification(path)"
        raise UsageError(f"specification is {shortened(value)}; {remedy}")


def listed_specifications(value: object) -> list[Specification]:
    """Return one or several specifications as a list.

    Raises:
        UsageError: anything else, such as the path of a file.
    """
    is_several = isinstance(value, Iterable) and not isinstance(value, (str, bytes))
    listed: list[Any] = list(value) if is_several else [value]  # type: ignore[call-overload]
    for each in listed:
        require_specification(each)
    return listed


def _require_text(value: object) -> None:
    if not isinstance(value, str):
        remedy = "give the text as a str; load_specification(path) reads a file"
        raise UsageError(f"text is {shortened(value)}; {remedy}")


def _require_path(value: object) -> None:
    if not isinstance(value, (str, PathLike)):
        remedy = "give the path of a file; parse_specification(text) takes a text"
        raise UsageError(f"path is {shortened(value)}; {remedy}")


def _check_relations(relations: Mapping[str, Relation]) -> None:
    for name, relation in relations.items():
        if not isinstance(name, str) or not _RELATION_NAME.match(name):
            raise UsageError(f"relations: {name!r} is not a name; use letters, digits and _")
        if is_reserved(name, RELATION_NAMES):
            raise UsageError(f"relations: {name!r} is already part of the language; choose another name")
        if not callable(relation):
            raise UsageError(f"relations: {name!r} is {relation!r}; give a function")
        parameters_of(name, relation)


def constant_writer(specification: Specification) -> Callable[[Mapping[str, float | str]], str]:
    """Return a function that returns a specification's text with other values in its `const` lines.

    For many values in turn: `parse_specification` with `constants` parses the text that comes of it, too.
    """
    names = RELATION_NAMES | specification.relations
    return _constant_writer(specification.source, specification.filename, names)


# a viewer changes the constants of one text again and again
@lru_cache(maxsize=16)
def _constant_writer(
    text: str, filename: str, names: frozenset[str]
) -> Callable[[Mapping[str, float | str]], str]:
    faults = Faults(SourceText.of(text, filename))
    namespace = Namespace(faults)
    namespace.declare(parse_statements(_tokens(text, names, faults), names, faults))
    faults.raise_if_any()
    lines = {name: each for name, each in namespace.definitions.items() if isinstance(each, ConstStatement)}
    return partial(replaced, text, lines, namespace.constants)


def _tokens(text: str, names: frozenset[str], faults: Faults) -> list[Token]:
    if len(text) > MAX_LENGTH:
        message = f"the text has {len(text)} characters, more than {MAX_LENGTH}"
        faults.add(Span(0, 1), message, "split it into several files")
        faults.raise_if_any()
    tokens = tokenize(text, names, faults)
    if len(tokens) == MAX_TOKENS:
        faults.raise_if_any()
    return tokens


def _profile(statements: Sequence[Statement], faults: Faults) -> str | None:
    uses = [statement for statement in statements if isinstance(statement, UseStatement)]
    for statement in uses[1:]:
        faults.add(statement.name.span, "a second use line", "a text has one relation profile")
    if not uses:
        return None
    name = uses[0].name
    if name.text in PROFILES:
        return name.text
    hint = nearest_hint(name.text, PROFILES) or f"the profiles are {', '.join(PROFILES)}"
    faults.add(name.span, f"unknown profile {name.text!r}", hint)
    return None


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

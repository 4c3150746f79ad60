"""Read YAML files that people write: text in; plain values with line numbers, or all errors, out.

Size and depth are limited. Tags, aliases and repeated keys are errors. Plain scalars follow YAML 1.2
(https://yaml.org/spec/1.2.2/#103-core-schema), so that `no` and `12:30` are texts. In YAML 1.1, a topic or a
name could become a truth value or a number of minutes. Infinity and NaN are errors, because comparisons with
them always give the same result.

A document is checked against a JSON Schema, whose descriptions appear in error messages. The caller adds
checks that a schema cannot express.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from math import isfinite
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from spatial_replay.errors import MissingFileError, UsageError
from spatial_replay.logs.remote import local_copy, log_file
from spatial_replay.text import cut, first_lines, nearest_hint

if TYPE_CHECKING:
    import yaml

Value: TypeAlias = "dict[str, Value] | list[Value] | str | int | float | bool | None"
Place: TypeAlias = tuple[str | int, ...]
"""Place of a value in a document: keys and indices from the top."""

LARGEST_TEXT = 256 * 1024
"""Size limit of a mapping, bytes; mappings are written by hand."""

_DEEPEST = 20
"""Nesting limit of lists and mappings."""
# at most 300 digits, so that conversion to float does not overflow
_INTEGER = re.compile(r"[-+]?[0-9]{1,300}", re.ASCII)
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", re.ASCII)
_WORDS = {"": None, "~": None, "null": None, "Null": None, "NULL": None}
_TRUTHS = {word: word[0] in "tT" for word in ("true", "True", "TRUE", "false", "False", "FALSE")}
_SPECIAL = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")


@dataclass(slots=True)
class Document:
    """The content of a YAML text.

    Attributes:
        value: mappings, lists, texts, numbers, truth values, None.
        lines: line of each value, from 1; for a value with a key, the line of the key.
        faults: (line, text) of each error.
    """

    value: Value = None
    lines: dict[Place, int] = field(default_factory=dict)
    faults: list[tuple[int, str]] = field(default_factory=list)

    def line_of(self, place: Place) -> int:
        """Return the line of a value, or of the innermost known value around it."""
        while place and place not in self.lines:
            place = place[:-1]
        return self.lines.get(place, 1)


def document_from_text(text: str, what: str = "a mapping", largest: int = LARGEST_TEXT) -> Document:
    """Read a YAML text; errors are in `faults` of the document.

    Args:
        what: noun for the text, for errors.
        largest: size limit, bytes.
    """
    import yaml

    document = Document()
    if len(text.encode("utf-8", "surrogatepass")) > largest:
        document.faults.append((1, f"the file is larger than {largest // 1024} KiB; {what} is not"))
        return document
    try:
        if fault := _find_unsupported_feature(yaml.parse(text, Loader=yaml.SafeLoader), what):
            document.faults.append(fault)
            return document
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = error.problem or error.context or "it cannot be read"
        hint = _pattern_hint(text, error)
        document.faults.append((mark.line + 1 if mark else 1, f"this is not YAML: {what}{hint}"))
        return document
    except yaml.YAMLError as error:
        document.faults.append((1, f"this is not YAML: {str(error).splitlines()[0]}"))
        return document
    if node is not None:
        document.value = _value(node, (), document)
    return document


def _pattern_hint(text: str, error: yaml.MarkedYAMLError) -> str:
    """Return the remedy for an unquoted file pattern with `*` or `[`, which are YAML syntax; otherwise ""."""
    mark = error.problem_mark
    is_list = mark is not None and re.fullmatch(r"\S\[", text[max(0, mark.index - 1) : mark.index + 1])
    if not is_list and error.context != "while scanning an alias":
        return ""
    return "; put patterns in quotes: 'logs/run-[0-3]*.mcap'"


def _find_unsupported_feature(events: Iterable[yaml.Event], noun: str) -> tuple[int, str] | None:
    """Return line and text of the first tag, alias, lone surrogate or deep nesting; None without a fault.

    Aliases and deep nesting could expand a short text beyond memory.
    """
    import yaml

    depth = 0
    for event in events:
        line = event.start_mark.line + 1 if event.start_mark else 1
        if isinstance(event, yaml.AliasEvent):
            return line, f"*{event.anchor} repeats another part; write it out, or in quotes if it is a text"
        if (tag := getattr(event, "tag", None)) is not None:
            return line, f"the tag {tag} means nothing here; leave it out"
        if isinstance(event, yaml.ScalarEvent) and any("\ud800" <= sign <= "\udfff" for sign in event.value):
            return line, f"{event.value[:40]!r} holds half a character; write it whole"
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            return line, f"it is nested more than {_DEEPEST} deep; {noun} is not"
    return None


def _value(node: yaml.Node, place: Place, document: Document) -> Value:
    import yaml

    document.lines.setdefault(place, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        return [_value(element, (*place, index), document) for index, element in enumerate(node.value)]
    if isinstance(node, yaml.MappingNode):
        return _table(node, place, document)
    # a scalar with a style is quoted or a block, so it is a text
    if not isinstance(node, yaml.ScalarNode) or node.style is not None:
        return cast("Value", node.value)
    value = _scalar(node.value)
    if isinstance(value, float) and not isfinite(value):
        fault = f"{_text_from_place(place)}{cut(node.value, 60)} is no finite number; give one, such as 0.5"
        document.faults.append((node.start_mark.line + 1, fault))
    return value


def _table(node: yaml.MappingNode, place: Place, document: Document) -> dict[str, Value]:
    import yaml

    table: dict[str, Value] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            document.faults.append((line, "a key is a list or a mapping; give a text"))
            continue
        key = key_node.value
        if key in table:
            fault = (
                f"the key {key[:60]!r} appears twice; the first is in line {document.lines[(*place, key)]}"
            )
            document.faults.append((line, fault))
            continue
        document.lines[(*place, key)] = line
        table[key] = _value(value_node, (*place, key), document)
    return table


def _scalar(text: str) -> Value:
    if text in _WORDS:
        return None
    if text in _TRUTHS:
        return _TRUTHS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _SPECIAL.fullmatch(text):
        return float(text.lower().replace(".", ""))
    return text


MOST_FAULTS = 100
"""Limit of listed errors of a document."""


def read_yaml_text(path: str | PathLike[str], largest: int = LARGEST_TEXT) -> str:
    """Read a text file from a path or an address; only the beginning of a file that is too large.

    Args:
        largest: size limit, bytes; at most one byte more is read.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is not UTF-8.
    """
    try:
        with local_copy(path).open("rb") as stream:
            data = stream.read(largest + 1)
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None
    try:
        # utf-8-sig drops the byte order mark that some editors write
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UsageError(f"{log_file(path).name}:{line}: a byte is not UTF-8; give a text file") from None


@cache
def schema_of(room: str, kind: str) -> Mapping[str, Any]:
    """Return the JSON Schema of a kind of file from the subpackage `room`."""
    text = files(f"spatial_replay.{room}").joinpath(f"{kind}.schema.json").read_text(encoding="utf-8")
    return cast("Mapping[str, Any]", json.loads(text))


def checked_document(
    text: str,
    name: str,
    schema: Mapping[str, Any],
    contradictions: Callable[[Document], list[tuple[Place, str]]],
    what: str,
) -> Document:
    """Read a YAML text and check it.

    Args:
        name: name of the file, for errors.
        schema: JSON Schema, draft 2020-12.
        contradictions: function that returns faults that a schema cannot express, also for a document that
            violates the schema.
        what: noun for the file, such as "a mapping".

    Raises:
        UsageError: the text is not valid; all errors are listed, with their lines.
    """
    document = document_from_text(text, what, LARGEST_TEXT)
    by_place = faults_by_place(document, schema, contradictions)
    faults = [f"{name}:{line}: {fault}" for line, fault in numbered_faults(document, by_place)]
    if faults:
        raise UsageError("\n".join(first_lines(faults, MOST_FAULTS)))
    return document


def faults_by_place(
    document: Document,
    schema: Mapping[str, Any],
    contradictions: Callable[[Document], list[tuple[Place, str]]],
) -> dict[Place, str]:
    """Return a document's faults by place; see `checked_document` for the arguments."""
    if document.faults and document.value is None:
        return {}
    from jsonschema import Draft202012Validator

    # one fault per place: a contradiction replaces a violation, because its text is more specific
    errors = Draft202012Validator(schema).iter_errors(document.value)
    violations = [fault for error in errors for fault in _faults_in_words(error)]
    return dict(violations + contradictions(document))


def numbered_faults(document: Document, by_place: Mapping[Place, str]) -> list[tuple[int, str]]:
    """Return all faults of a document as (line, text), in order of lines."""
    placed_faults = [
        (document.line_of(place), f"{_text_from_place(place)}{fault}") for place, fault in by_place.items()
    ]
    return sorted(document.faults + placed_faults)


def _text_from_place(place: Place) -> str:
    text = ""
    for step in place:
        text += f"[{step}]" if isinstance(step, int) else f"{'.' if text else ''}{step[:80]}"
    return f"{text}: " if text else ""


def _faults_in_words(error: Any) -> Iterator[tuple[Place, str]]:
    """Yield the place and text of each fault in a violation of the schema."""
    place: Place = tuple(error.absolute_path)
    keyword = error.validator
    if keyword == "anyOf" and isinstance(error.instance, dict | list):
        violations_by_branch: dict[int, list[Any]] = {}
        for violation in error.context:
            violations_by_branch.setdefault(violation.schema_path[0], []).append(violation)
        for violations in violations_by_branch.values():
            # violations of an alternative for another type are skipped, because they would not help
            if not any(
                violation.validator == "type" and len(violation.absolute_path) == len(place)
                for violation in violations
            ):
                for violation in violations:
                    yield from _faults_in_words(violation)
                return
    if keyword == "additionalProperties" and isinstance(error.instance, dict):
        known_keys = list(error.schema.get("properties", {}))
        for key in error.instance:
            if key not in known_keys:
                hint = nearest_hint(key, known_keys) or f"known are {', '.join(known_keys)}"
                yield (*place, key), f"unknown key; {hint}"
    elif keyword == "required":
        missing_keys = [key for key in error.validator_value if key not in error.instance]
        yield place, f"the key {missing_keys[0]!r} is missing"
    elif "propertyNames" in error.absolute_schema_path:
        yield place, "a name is empty; give it a name"
    else:
        description = error.schema.get("description", _around(error))
        is_word = keyword == "enum" and isinstance(error.instance, str)
        hint = nearest_hint(error.instance, map(str, error.validator_value)) if is_word else ""
        yield (
            place,
            "; ".join(filter(None, (f"expected {description}", f"got {_in_words(error.instance)}", hint))),
        )


def _around(error: Any) -> str:
    """Return the description of the nearest rule around a violated rule that has no description itself."""
    parent = error.parent
    while parent is not None and "description" not in parent.schema:
        parent = parent.parent
    fallback = f"something that fits {error.validator} {error.validator_value}"
    return fallback if parent is None else str(parent.schema["description"])


def _in_words(value: object) -> str:
    if isinstance(value, dict):
        return f"keys {', '.join(map(str, value))[:60]}" if value else "{}"
    return cut(json.dumps(value, ensure_ascii=False, default=str), 60)

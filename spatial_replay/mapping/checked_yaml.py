"""YAML files that people write, checked against a JSON Schema: all errors at once, in plain words.

The schema's descriptions say what belongs where; what a schema cannot express, the caller adds.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from os import PathLike
from typing import Any

from spatial_replay.errors import MissingFileError, UsageError
from spatial_replay.logs.downloads import local_copy
from spatial_replay.logs.remote import log_file
from spatial_replay.mapping.yaml_document import LARGEST_TEXT, Document, Place, document_from_text
from spatial_replay.text import nearest_hint

_MOST_FAULTS = 100


def read_yaml_text(path: str | PathLike[str], largest: int = LARGEST_TEXT) -> str:
    """Read a text file, also at an address, and of one that is too large only its beginning.

    Args:
        largest: size in bytes; no more than one byte beyond it is read.

    Raises:
        MissingFileError: there is no such file.
        UsageError: it is not UTF-8.
    """
    try:
        with local_copy(path).open("rb") as stream:
            data = stream.read(largest + 1)
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UsageError(f"{log_file(path).name}:{line}: a byte is not UTF-8; give a text file") from None


def checked_document(
    text: str,
    name: str,
    schema: Mapping[str, Any],
    contradictions: Callable[[Document], list[tuple[Place, str]]],
    what: str,
    largest: int = LARGEST_TEXT,
) -> Document:
    """Read a YAML text and check it.

    Args:
        name: of the file, for errors.
        schema: JSON Schema, draft 2020-12.
        contradictions: finds what a schema cannot express; it may get any value, valid or not.
        what: what the file is, such as "a mapping".
        largest: size in bytes.

    Raises:
        UsageError: the text is not valid; all errors are listed, with their lines.
    """
    from jsonschema import Draft202012Validator

    document = document_from_text(text, what, largest)
    faults = list(document.faults)
    if not faults:
        # one error for each place; a contradiction says more than the schema
        errors = Draft202012Validator(schema).iter_errors(document.value)
        violations = [fault for error in errors for fault in _described(error)]
        by_place = dict(violations + contradictions(document))
        faults = [
            (document.line_of(place), f"{_text_from_place(place)}{fault}")
            for place, fault in by_place.items()
        ]
    if faults:
        lines = [f"{name}:{line}: {fault}" for line, fault in sorted(faults)]
        more = [f"… and {len(lines) - _MOST_FAULTS} more"] if len(lines) > _MOST_FAULTS else []
        raise UsageError("\n".join(lines[:_MOST_FAULTS] + more))
    return document


def _text_from_place(place: Place) -> str:
    text = ""
    for step in place:
        text += f"[{step}]" if isinstance(step, int) else f"{'.' if text else ''}{step[:80]}"
    return f"{text}: " if text else ""


def _described(error: Any) -> Iterator[tuple[Place, str]]:
    """Iterate over the places of a violation of the schema, with what belongs there."""
    place: Place = tuple(error.absolute_path)
    keyword = error.validator
    if keyword == "anyOf" and isinstance(error.instance, dict | list):
        branches: dict[int, list[Any]] = {}
        for each in error.context:
            branches.setdefault(each.schema_path[0], []).append(each)
        for branch in branches.values():
            # not an alternative that failed because the whole value has another type
            if not any(each.validator == "type" and len(each.absolute_path) == len(place) for each in branch):
                for each in branch:
                    yield from _described(each)
                return
    if keyword == "additionalProperties" and isinstance(error.instance, dict):
        known = list(error.schema.get("properties", {}))
        for key in error.instance:
            if key not in known:
                hint = nearest_hint(key, known) or f"known are {', '.join(known)}"
                yield (*place, key), f"unknown key; {hint}"
    elif keyword == "required":
        missing = [key for key in error.validator_value if key not in error.instance]
        yield place, f"the key {missing[0]!r} is missing"
    elif "propertyNames" in error.absolute_schema_path:
        yield place, "a name is empty; give it a name"
    else:
        wanted = error.schema.get("description", _around(error))
        yield place, f"expected {wanted}; got {_shown(error.instance)}"


def _around(error: Any) -> str:
    """Return what belongs where a rule without a description was violated: that of the rule around it."""
    parent = error.parent
    while parent is not None and "description" not in parent.schema:
        parent = parent.parent
    fallback = f"something that fits {error.validator} {error.validator_value}"
    return fallback if parent is None else str(parent.schema["description"])


def _shown(value: object) -> str:
    """Return a short text for a value."""
    if isinstance(value, dict):
        return f"keys {', '.join(map(str, value))[:60]}" if value else "{}"
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:59] + "…"

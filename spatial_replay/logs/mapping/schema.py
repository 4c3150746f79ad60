"""The published JSON Schema of mapping files, and its faults in words."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from spatial_replay.logs.mapping.document import Place, Value
from spatial_replay.logs.mapping.hints import nearest_hint

if TYPE_CHECKING:
    from jsonschema.protocols import Validator

SCHEMA_FILE = "mapping.schema.json"


def schema_faults(value: Value) -> Iterator[tuple[Place, str]]:
    """Where a value does not follow the schema, and what belongs there, in the order of the schema."""
    for error in _validator().iter_errors(value):
        yield from _told(error)


@cache
def _validator() -> Validator:
    from jsonschema import Draft202012Validator

    text = files(__package__).joinpath(SCHEMA_FILE).read_text(encoding="utf-8")
    return Draft202012Validator(json.loads(text))


def _told(error: Any) -> Iterator[tuple[Place, str]]:
    place: Place = tuple(error.absolute_path)
    keyword = error.validator
    if keyword == "anyOf" and isinstance(error.instance, dict | list):
        for branch in _branches(error):
            if not any(_is_of_another_kind(each, len(place)) for each in branch):
                for each in branch:
                    yield from _told(each)
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
        yield place, f"{shown(error.instance)} where this belongs: {wanted}"


def _around(error: Any) -> str:
    """What belongs where a rule without a description of its own was broken: that of the rule around it."""
    parent = error.parent
    while parent is not None and "description" not in parent.schema:
        parent = parent.parent
    fallback = f"something that fits {error.validator} {error.validator_value}"
    return fallback if parent is None else str(parent.schema["description"])


def _branches(error: Any) -> Iterable[list[Any]]:
    branches: dict[int, list[Any]] = {}
    for each in error.context:
        branches.setdefault(each.schema_path[0], []).append(each)
    return branches.values()


def _is_of_another_kind(error: Any, depth: int) -> bool:
    """Whether an alternative failed because the value as a whole is of another kind."""
    return error.validator == "type" and len(error.absolute_path) == depth


def shown(value: object) -> str:
    """A value in a few words."""
    if isinstance(value, dict):
        return f"keys {', '.join(map(str, value))[:60]}" if value else "{}"
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:59] + "…"

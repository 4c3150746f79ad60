"""Questions about a log, asked and answered in JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from spatial_replay.errors import UsageError
from spatial_replay.replay.document import document
from spatial_replay.replay.explanation import explanations
from spatial_replay.replay.tuning import Tuned, values_of

_MOST_BYTES: Final = 1 << 16


class Service(NamedTuple):
    """A question.

    Attributes:
        request, response: JSON schemas.
        answer: of an evaluation and a request.
    """

    request: Mapping[str, Any]
    response: Mapping[str, Any]
    answer: Callable[[Tuned, Mapping[str, Any]], Mapping[str, Any]]


def answer(name: str, tuned: Tuned, payload: bytes) -> bytes:
    """The answer to a question.

    Args:
        name: one of `SERVICES`.
        payload: the request, a JSON object; nothing for one without members.

    Raises:
        UsageError: a request that makes no sense.
        SpecificationError: constants that make a specification meaningless.
    """
    service = SERVICES[name]
    request = _request(name, payload, service.request)
    return json.dumps(service.answer(tuned, request), ensure_ascii=False, allow_nan=False).encode()


def _request(name: str, payload: bytes, schema: Mapping[str, Any]) -> Mapping[str, Any]:
    if len(payload) > _MOST_BYTES:
        raise UsageError(f"a request of {len(payload)} bytes; {name} takes at most {_MOST_BYTES}")
    try:
        request = json.loads(payload or b"{}")
    except (ValueError, RecursionError):
        raise UsageError(f"the request is no JSON; {name} takes an object, such as {{}}") from None
    fault = best_match(Draft202012Validator(schema).iter_errors(request))
    if fault is not None:
        place = "/".join(map(str, fault.absolute_path))
        raise UsageError(f"the request{f' at {place}' if place else ''}: {fault.message}")
    members: Mapping[str, Any] = request
    return members


def _evaluate(tuned: Tuned, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a replay with other constants says; what is shown stays as it is."""
    changed = request.get("constants", {})
    if changed:
        tuned = tuned.tuning.evaluate({**values_of(tuned.constants), **changed})
    results = tuple(replace(result, times_ns=None, series=None) for result in tuned.replayed.results)
    return document(replace(tuned.replayed, results=results))


def _explain(tuned: Tuned, request: Mapping[str, Any]) -> Mapping[str, Any]:
    found = explanations(tuned.replayed, node=request.get("node"), object=request.get("object"))
    return {"explanations": [each.document for each in found]}


def _object(title: str, **properties: Mapping[str, Any]) -> Mapping[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "additionalProperties": False}


_CONSTANTS = {
    "description": "Numbers and, as texts, durations, by name; the others stay as they are shown.",
    "type": "object",
    "additionalProperties": {"type": ["number", "string"]},
}

SERVICES: Final[Mapping[str, Service]] = MappingProxyType(
    {
        "evaluate": Service(
            _object("spatial_replay.EvaluateRequest", constants=_CONSTANTS),
            {"title": "spatial_replay.EvaluateResponse", "type": "object"},
            _evaluate,
        ),
        "explain": Service(
            _object(
                "spatial_replay.ExplainRequest",
                node={"description": "Name of a spec, wherever it stands.", "type": "string"},
                object={"description": "Of a template, the object that it is about.", "type": "string"},
            ),
            {
                "title": "spatial_replay.ExplainResponse",
                "type": "object",
                "properties": {"explanations": {"type": "array", "items": {"type": "object"}}},
            },
            _explain,
        ),
    }
)

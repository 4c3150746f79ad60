"""Services for viewers, which answer in JSON, and assets such as the layout."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from spatial_replay.errors import UsageError
from spatial_replay.logs.topics import LAYOUT
from spatial_replay.replay.document import document_from_replay, explain_results
from spatial_replay.replay.loaded_log import Evaluated
from spatial_replay.serve.player import FASTEST, PLAYBACK, SLOWEST

_MOST_BYTES: Final = 1 << 16


class Service(NamedTuple):
    """A service that computes something from what is shown.

    Attributes:
        request, response: JSON schemas.
        answer: computes the response from an evaluation and a request.
    """

    request: Mapping[str, Any]
    response: Mapping[str, Any]
    answer: Callable[[Evaluated, Mapping[str, Any]], Mapping[str, Any]]


class Steering(NamedTuple):
    """A service that steers the playback.

    Attributes:
        request: a JSON schema.
        values: returns the parameters of the playback that a request sets (see `PLAYBACK`).
    """

    request: Mapping[str, Any]
    values: Callable[[Mapping[str, Any]], Mapping[str, float | bool]]


def steered(name: str, payload: bytes) -> Mapping[str, float | bool]:
    """Return the parameters of the playback that a request sets.

    Args:
        name: one of `STEERING`.
        payload: the request, a JSON object; may be empty for an object without members.

    Raises:
        UsageError: an invalid request.
    """
    service = STEERING[name]
    return service.values(_request(name, payload, service.request))


def answer(name: str, evaluated: Evaluated, payload: bytes) -> bytes:
    """Answer a request.

    Args:
        name: one of `SERVICES`.
        payload: the request, a JSON object; may be empty for an object without members.

    Raises:
        UsageError: an invalid request.
        SpecificationError: constants that make a specification invalid.
    """
    service = SERVICES[name]
    request = _request(name, payload, service.request)
    return json.dumps(service.answer(evaluated, request), ensure_ascii=False, allow_nan=False).encode()


def _request(name: str, payload: bytes, schema: Mapping[str, Any]) -> Mapping[str, Any]:
    if len(payload) > _MOST_BYTES:
        raise UsageError(f"a request of {len(payload)} bytes; {name} takes at most {_MOST_BYTES}")
    try:
        request = json.loads(payload or b"{}")
    except (ValueError, RecursionError):
        raise UsageError(f"the request is not JSON; {name} takes an object, such as {{}}") from None
    fault = best_match(Draft202012Validator(schema).iter_errors(request))
    if fault is not None:
        place = "/".join(map(str, fault.absolute_path))
        raise UsageError(f"the request{f' at {place}' if place else ''}: {fault.message}")
    members: Mapping[str, Any] = request
    return members


def _evaluate(evaluated: Evaluated, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """Replay with other constants; what is shown stays as it is."""
    changed = request.get("constants", {})
    if changed:
        evaluated = evaluated.loaded.evaluate({**evaluated.edited.given, **changed})
    results = tuple(replace(result, has_series=False) for result in evaluated.replayed.results)
    return document_from_replay(replace(evaluated.replayed, results=results))


def _explain(evaluated: Evaluated, request: Mapping[str, Any]) -> Mapping[str, Any]:
    explanations = explain_results(evaluated.replayed, node=request.get("node"), object=request.get("object"))
    return {"explanations": [each.document for each in explanations]}


def _write_constants(evaluated: Evaluated, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """Write what viewers changed, and what the request gives, into the files of the specifications."""
    values = {**evaluated.edited.given, **request.get("constants", {})}
    return {"written": dict(evaluated.loaded.write_constants(values))}


def _object(title: str, **properties: Mapping[str, Any]) -> Mapping[str, Any]:
    # some viewers fail at an object that does not list its properties
    return {"title": title, "type": "object", "properties": properties, "additionalProperties": False}


_CONSTANTS = {
    "description": "Numbers and, as texts, durations, by name; the others stay as they are shown.",
    "type": "object",
    "properties": {},
    "additionalProperties": {"type": ["number", "string"]},
}

SERVICES: Final[Mapping[str, Service]] = MappingProxyType(
    {
        "evaluate": Service(
            _object("spatial_replay.EvaluateRequest", constants=_CONSTANTS),
            {"title": "spatial_replay.EvaluateResponse", "type": "object", "properties": {}},
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
                "properties": {
                    "explanations": {"type": "array", "items": {"type": "object", "properties": {}}}
                },
            },
            _explain,
        ),
        "write_constants": Service(
            _object("spatial_replay.WriteConstantsRequest", constants=_CONSTANTS),
            {
                "title": "spatial_replay.WriteConstantsResponse",
                "type": "object",
                "properties": {"written": _CONSTANTS},
            },
            _write_constants,
        ),
    }
)


_TIME, _PLAY, _SPEED, _ = PLAYBACK
_SECONDS = {"description": "Seconds after the first sample.", "type": "number", "minimum": 0}
_TIMES = {
    "description": "Seconds of the log in a second.",
    "type": "number",
    "minimum": SLOWEST,
    "maximum": FASTEST,
}

STEERING: Final[Mapping[str, Steering]] = MappingProxyType(
    {
        "play": Steering(_object("spatial_replay.PlayRequest"), lambda _: {_PLAY: True}),
        "pause": Steering(_object("spatial_replay.PauseRequest"), lambda _: {_PLAY: False}),
        "seek": Steering(
            {**_object("spatial_replay.SeekRequest", time=_SECONDS), "required": ["time"]},
            lambda request: {_TIME: request["time"]},
        ),
        "speed": Steering(
            {**_object("spatial_replay.SpeedRequest", speed=_TIMES), "required": ["speed"]},
            lambda request: {_SPEED: request["speed"]},
        ),
    }
)
"""Services for viewers without controls of their own; each answers with the playback as it is then."""

PLAYBACK_STATE: Final[Mapping[str, Any]] = _object(
    "spatial_replay.PlaybackState",
    time=_SECONDS,
    play={"type": "boolean"},
    speed=_TIMES,
    loop={"type": "boolean"},
)
"""The JSON schema of their answer."""

_PREFIX = "spatial-replay://"


def asset(evaluated: Evaluated, uri: str) -> bytes | None:
    """Return a file: the layout, a specification with its present constants, or an automaton for Graphviz.

    Returns:
        None if there is no such file.
    """
    kind, _, name = uri.removeprefix(_PREFIX).partition("/")
    if not uri.startswith(_PREFIX):
        return None
    if (kind, name) == (LAYOUT, ""):
        return evaluated.layout.data
    if kind == "specification":
        return {file.filename: file.source.encode() for file in evaluated.edited.files}.get(name)
    if kind == "automaton" and name.endswith(".dot"):
        automata = evaluated.evaluation.automata_attachments("")
        return {each.name.rpartition("/")[2]: each.data for each in automata}.get(name)
    return None

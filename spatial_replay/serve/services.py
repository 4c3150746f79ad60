"""Questions about a log, asked and answered in JSON.

Questions that take long, answered apart from what is shown.

The files that viewers can fetch from a session, by names that lead nowhere else.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from queue import SimpleQueue
from threading import Lock
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeVar

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from spatial_replay.annotate.foxglove_layout import LAYOUT
from spatial_replay.errors import UsageError
from spatial_replay.replay.document import document_from_replay, explain_results
from spatial_replay.replay.tuning import Tuned, constant_values
from spatial_replay.serve.session import OVER, Question, Session

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
        tuned = tuned.tuning.evaluate({**constant_values(tuned.edited.constants), **changed})
    results = tuple(replace(result, times_ns=None, series=None) for result in tuned.replayed.results)
    return document_from_replay(replace(tuned.replayed, results=results))


def _explain(tuned: Tuned, request: Mapping[str, Any]) -> Mapping[str, Any]:
    found = explain_results(tuned.replayed, node=request.get("node"), object=request.get("object"))
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


MOST_OPEN: Final = 8

_Answer = TypeVar("_Answer")


class Questions:
    """Answers one question after the other, on a thread of its own, so that nobody who looks waits for it."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._waiting: SimpleQueue[tuple[Question, Tuned] | None] = SimpleQueue()
        self._open: list[Question] = []
        self._changing = Lock()
        self._is_over = False

    def ask(self, work: Callable[[Tuned], _Answer]) -> _Answer:
        """Work something out from what is shown now, in turn; what `work` raises is raised here.

        Raises:
            UsageError: too many questions are open, or the session is over.
        """
        question = Question(work)
        tuned = self._session.ask(lambda tuned: tuned)
        with self._changing:
            if self._is_over:
                raise UsageError(OVER)
            if len(self._open) >= MOST_OPEN:
                raise UsageError(f"{MOST_OPEN} questions are open already; ask again when they are answered")
            self._open.append(question)
            self._waiting.put((question, tuned))
        answer: _Answer = question.answer.result()
        return answer

    def run(self) -> None:
        """Answer what is asked until `stop`."""
        while (next_one := self._waiting.get()) is not None:
            question, tuned = next_one
            question.settle(tuned)
            with self._changing:
                self._open.remove(question)

    def stop(self) -> None:
        """Leave no question open, and take no more."""
        with self._changing:
            self._is_over = True
            for question in self._open:
                question.refuse()
            self._waiting.put(None)


_PREFIX = "spatial-replay://"


def asset(tuned: Tuned, uri: str) -> bytes | None:
    """The file of a name: the layout, a specification with its present constants, an automaton for Graphviz.

    Returns:
        None if there is no such file.
    """
    kind, _, name = uri.removeprefix(_PREFIX).partition("/")
    if not uri.startswith(_PREFIX):
        return None
    if (kind, name) == (LAYOUT, ""):
        return tuned.layout.data
    if kind == "specification":
        return {file.filename: file.source.encode() for file in tuned.edited.files}.get(name)
    if kind == "automaton" and name.endswith(".dot"):
        kept = tuned.evaluation.automata_attachments("")
        return {each.name.rpartition("/")[2]: each.data for each in kept}.get(name)
    return None

"""Automata out of files: only sound ones, of the formula at hand."""

from __future__ import annotations

import json

import pytest

from automata.golden import FORMULAS
from spatial_replay import automaton, parse_specification
from spatial_replay.automata import automaton_from, stored_text
from spatial_replay.automata.compile import MAX_ROWS

SPECIFICATION = parse_specification("G ((p >= 0) -> F q >= 0)")
SPEC = SPECIFICATION.specs[0]
STORED = json.loads(stored_text(automaton(SPECIFICATION), SPECIFICATION, SPEC))


def read(content: object) -> object:
    return automaton_from(json.dumps(content).encode(), SPECIFICATION, SPEC)


def test_a_file_of_the_same_formula_is_read() -> None:
    assert read(STORED) == automaton(SPECIFICATION)


def test_a_file_of_another_formula_is_not() -> None:
    other = parse_specification("G ((p >= 0) -> F q >= 0.5)")
    assert automaton_from(json.dumps(STORED).encode(), other, other.specs[0]) is None
    profile = parse_specification("use spatial_spec\nG ((p >= 0) -> F q >= 0)")
    assert automaton_from(json.dumps(STORED).encode(), profile, profile.specs[0]) is None


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"null", b"\xff", b"[" * 100_000, b'{"version": 1}'])
def test_a_file_of_another_kind_is_not_read(data: bytes) -> None:
    assert automaton_from(data, SPECIFICATION, SPEC) is None


@pytest.mark.parametrize(
    "changed",
    [
        {"version": 2},
        {"entries": []},
        {"entries": [-9, 0]},
        {"entries": [99, 0]},
        {"entries": [0.5, 0]},
        {"entries": "01"},
        {"entries": [True, 0]},
        {"accepting": [2]},
        {"accepting": [-1]},
        {"accepting": None},
        {"decisions": [[0, 0, 0]]},
        {"decisions": [[7, -1, -1]]},
        {"decisions": [[0, -1, -9]]},
        {"decisions": [[0, -1]]},
        {"decisions": [[0, -1, "x"]]},
        {"decisions": {}},
        {"entries": [1, 1], "decisions": [[1, -1, -2], [1, 0, -1]]},
        {"propositions": ["p >= 0"]},
    ],
)
def test_a_file_that_was_tampered_with_is_not_read(changed: dict[str, object]) -> None:
    assert read({**STORED, **changed}) is None


@pytest.mark.parametrize("text", FORMULAS)
def test_a_stored_automaton_is_read_back(text: str) -> None:
    specification = parse_specification(text)
    result = automaton(specification)
    data = stored_text(result, specification, specification.specs[0]).encode()
    assert automaton_from(data, specification, specification.specs[0]) == result


def test_a_file_of_more_states_than_a_compiler_gives_is_not_read() -> None:
    assert read({**STORED, "entries": [0] * (MAX_ROWS + 1)}) is None

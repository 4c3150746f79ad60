"""Automata as files, so that one compiled before need not be compiled again."""

from __future__ import annotations

import json
from collections.abc import Sequence

from spatial_replay.automata.automaton import MAX_PROPOSITIONS, MAX_ROWS, Automaton
from spatial_replay.automata.propositions import Propositions
from spatial_replay.errors import NoAutomatonError
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import NamedSpec, Specification

_VERSION = 1
_LONGEST = 16 * 2**20
"""Bytes of a file that is read."""


def stored_text(automaton: Automaton, specification: Specification, spec: NamedSpec) -> str:
    """An automaton as a file (JSON), with the formula that it is of."""
    return json.dumps(
        {
            "version": _VERSION,
            "specification": _canonical(specification, spec),
            "propositions": [each.text for each in automaton.propositions],
            "accepting": sorted(automaton.accepting),
            "entries": automaton.entries,
            "decisions": automaton.decisions,
        },
        ensure_ascii=False,
        separators=(",", ":"),
    )


def automaton_from(data: bytes, specification: Specification, spec: NamedSpec) -> Automaton | None:
    """The automaton of a spec out of a file; None if the file is of another formula, or is no such file."""
    if len(data) > _LONGEST:
        return None
    try:
        stored = json.loads(data)
    except (ValueError, RecursionError):
        return None
    if not isinstance(stored, dict) or stored.get("version") != _VERSION:
        return None
    propositions = Propositions(spec.formula).all
    expected = (_canonical(specification, spec), [each.text for each in propositions])
    if (stored.get("specification"), stored.get("propositions")) != expected:
        return None
    entries, accepting = _numbers(stored.get("entries")), _numbers(stored.get("accepting"))
    decisions = _decisions(stored.get("decisions"))
    if entries is None or accepting is None or decisions is None or len(propositions) > MAX_PROPOSITIONS:
        return None
    automaton = Automaton(spec.name, tuple(propositions), frozenset(accepting), tuple(entries), decisions)
    return automaton if _is_sound(automaton) and _has_guards(automaton) else None


def _canonical(specification: Specification, spec: NamedSpec) -> str:
    return f"use {specification.profile}\n{format_formula(spec.formula)}"


def _numbers(value: object) -> list[int] | None:
    if not isinstance(value, list) or len(value) > MAX_ROWS or any(type(each) is not int for each in value):
        return None
    return value


def _decisions(value: object) -> tuple[tuple[int, int, int], ...] | None:
    if not isinstance(value, list) or len(value) > MAX_ROWS:
        return None
    rows = [_numbers(row) for row in value]
    return tuple((row[0], row[1], row[2]) for row in rows if row is not None and len(row) == 3)


def _is_sound(automaton: Automaton) -> bool:
    """Whether every decision leads on to later ones and, in the end, to states that there are."""
    states, propositions = len(automaton.entries), len(automaton.propositions)

    def leads(place: int, rows: Sequence[tuple[int, int, int]], row: int, after: int) -> bool:
        if place < 0:
            return ~place < states
        return place < row and rows[place][0] > after

    rows = automaton.decisions
    return (
        states > 0
        and all(0 <= state < states for state in automaton.accepting)
        and all(leads(place, rows, len(rows), -1) for place in automaton.entries)
        and all(
            0 <= proposition < propositions
            and leads(low, rows, row, proposition)
            and leads(high, rows, row, proposition)
            for row, (proposition, low, high) in enumerate(rows)
        )
    )


def _has_guards(automaton: Automaton) -> bool:
    try:
        return bool(automaton.transitions)
    except NoAutomatonError:
        return False

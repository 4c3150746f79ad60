"""Compile a spec to its automaton, by this package or by MONA; read and write compiled automata.

MONA is slow and may not be installed where a log is replayed, so a compiled automaton can be stored.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Literal, TypeAlias, get_args

from spatial_replay.automata.automaton import MAX_PROPOSITIONS, MAX_ROWS, Automaton, automaton_of
from spatial_replay.automata.ltlf import Node, Skeleton, counts_seconds, no_automaton
from spatial_replay.automata.minimise import Machine, least
from spatial_replay.automata.mona import compiled_by_mona
from spatial_replay.automata.products import composed
from spatial_replay.automata.propositions import Propositions
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.spec.diagnostics import SourceText, nearest_hint
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import NamedSpec, Specification
from spatial_replay.spec.load import require_specification

_VERSION = 1
_LONGEST = 16 * 2**20
"""Bytes of a stored automaton that are read at most."""


def stored_text(automaton: Automaton, specification: Specification, spec: NamedSpec) -> str:
    """Return an automaton as JSON, with the formula that it was compiled from."""
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
    """Return the automaton of a spec from its JSON; None if that is of another formula, or is not one."""
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
    return automaton if _is_sound(automaton) else None


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
    """Return whether every decision leads on to later ones and, in the end, to states that there are."""
    rows, states, propositions = automaton.decisions, len(automaton.entries), len(automaton.propositions)

    def leads(place: int, row: int, after: int) -> bool:
        return ~place < states if place < 0 else place < row and rows[place][0] > after

    return (
        states > 0
        and all(0 <= state < states for state in automaton.accepting)
        and all(leads(place, len(rows), -1) for place in automaton.entries)
        and all(
            0 <= proposition < propositions and leads(low, row, proposition) and leads(high, row, proposition)
            for row, (proposition, low, high) in enumerate(rows)
        )
    )


Compiler: TypeAlias = Literal["own", "mona"]
"""This package, or MONA."""

_NAMES: MappingProxyType[Compiler, str] = MappingProxyType({"own": "this package", "mona": "MONA"})


def automaton(
    specification: Specification,
    name: str | None = None,
    *,
    rate_hz: float | None = None,
    compiler: Compiler | None = None,
    stored: Iterable[bytes] = (),
) -> Automaton:
    """Return the automaton of a spec: which runs satisfy it, sample by sample.

    It accepts a run that is fully observed and has a robustness above 0, and none with one below 0.

    Args:
        name: which spec of the file; without it, its only result.
        rate_hz: how many samples a second has. Bounds in seconds become bounds in samples with it, which mean
            the same only in runs of that rate.
        compiler: "own" or "mona"; both give equal automata. Without it, that of this package, and where that
            reaches its limits, MONA.
        stored: automata as files; one of this spec is taken rather than asking MONA, unless it has bounds in
            seconds.

    Raises:
        NoAutomatonError: past operators, bounds in seconds without a rate, or too large.
        UsageError: no specification, no such spec, several to choose from, no such compiler, a rate that is
            not above 0.
    """
    require_specification(specification)
    if compiler is not None and compiler not in get_args(Compiler):
        raise UsageError(f"no compiler {compiler!r}; there are 'own' and 'mona'")
    if rate_hz is not None and not (isinstance(rate_hz, (int, float)) and 0.0 < rate_hz < math.inf):
        raise UsageError(f"a rate of {rate_hz!r} Hz; give samples a second, above 0")
    spec = chosen_spec(specification, name)
    if counts_seconds(spec.formula):
        # a file does not say at which rate it was compiled
        stored = ()
    source = SourceText.of(specification.source, specification.filename) if specification.source else None
    propositions = Propositions(spec.formula)
    skeleton = Skeleton(spec.formula, propositions, source, rate_hz)
    compilers = get_args(Compiler) if compiler is None else (compiler,)
    try:
        return _compiled(spec, skeleton, propositions, compilers, _read(stored, specification, spec))
    except NoAutomatonError as error:
        raise no_automaton(spec, source, str(error)) from error


def _compiled(
    spec: NamedSpec,
    skeleton: Skeleton,
    propositions: Propositions,
    compilers: Sequence[Compiler],
    stored: Iterator[Automaton],
) -> Automaton:
    """Return the automaton of the first compiler that succeeds; a stored one rather than calling MONA.

    Raises:
        NoAutomatonError: why none does.
    """
    count = len(propositions.all)
    if count > MAX_PROPOSITIONS:
        raise NoAutomatonError(f"it has {count} propositions, an automaton at most {MAX_PROPOSITIONS}")
    reasons = []
    for each in compilers:
        if each == "mona" and (before := next(stored, None)) is not None:
            return before
        try:
            if each == "own":
                machine = _composed(_Shape.of(skeleton, count))
            else:
                machine = least(compiled_by_mona(skeleton, count))
        except NoAutomatonError as error:
            reasons.append(f"{_NAMES[each]}: {error}")
        else:
            return _checked(automaton_of(machine, spec.name, propositions.all))
    raise NoAutomatonError("; ".join(reasons))


@dataclass(frozen=True, slots=True)
class _Shape:
    """All that a machine follows from: a skeleton, without what its propositions say."""

    nodes: tuple[Node, ...]
    root: int
    chains: frozenset[tuple[tuple[int, bool], int]]
    propositions: int
    skeleton: Skeleton = field(compare=False, repr=False)

    @classmethod
    def of(cls, skeleton: Skeleton, propositions: int) -> _Shape:
        chains = frozenset(skeleton.chains.items())
        return cls(tuple(skeleton.nodes), skeleton.root, chains, propositions, skeleton)


# a formula with another threshold has the same machine
@lru_cache(maxsize=16)
def _composed(shape: _Shape) -> Machine:
    """Return the least machine of a shape, by this package.

    Raises:
        NoAutomatonError: it would take more states or decisions than are explored.
    """
    return least(composed(shape.skeleton, shape.propositions))


def _read(stored: Iterable[bytes], specification: Specification, spec: NamedSpec) -> Iterator[Automaton]:
    """Yield those of files that are of a spec, read when they are asked for."""
    for data in stored:
        found = automaton_from(data, specification, spec)
        if found is not None:
            yield found


def _checked(automaton: Automaton) -> Automaton:
    """Return an automaton that is small enough.

    Raises:
        NoAutomatonError: it is too large.
    """
    rows = max(len(automaton.entries), len(automaton.decisions))
    if rows > MAX_ROWS:
        raise NoAutomatonError(f"it takes {rows} states or decisions, at most {MAX_ROWS} are kept")
    return automaton


def chosen_spec(specification: Specification, name: str | None) -> NamedSpec:
    """Return the spec of a file that has a name; without one, its only result.

    Raises:
        UsageError: no such spec, several to choose from.
    """
    known = {spec.name: spec for spec in specification.specs}
    if name is None:
        if len(specification.results) != 1:
            names = ", ".join(spec.name for spec in specification.results)
            raise UsageError(f"{specification.filename} has several results; choose one with name=: {names}")
        return specification.results[0]
    if name not in known:
        hint = nearest_hint(name, known)
        others = f"{f'{hint} ' if hint else ''}there are {', '.join(known)}"
        raise UsageError(f"no spec {name!r} in {specification.filename}; {others}")
    return known[name]

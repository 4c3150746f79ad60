"""From a specification to its automaton."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from types import MappingProxyType
from typing import Literal, TypeAlias, get_args

from spatial_replay.automata.automaton import MAX_PROPOSITIONS, MAX_ROWS, Automaton, automaton_of
from spatial_replay.automata.machine import least
from spatial_replay.automata.mona import compiled_by_mona
from spatial_replay.automata.obstacles import no_automaton
from spatial_replay.automata.progression import progressed
from spatial_replay.automata.propositions import Propositions
from spatial_replay.automata.skeleton import Skeleton
from spatial_replay.automata.stored import automaton_from
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.spec.faults import Source, nearest_hint
from spatial_replay.spec.formula import NamedSpec, Specification
from spatial_replay.spec.specification import require_specification

Compiler: TypeAlias = Literal["own", "mona"]
"""Who compiles: this package, or MONA."""

_NAMES: MappingProxyType[Compiler, str] = MappingProxyType({"own": "this package", "mona": "MONA"})


def automaton(
    specification: Specification,
    name: str | None = None,
    *,
    compiler: Compiler | None = None,
    stored: Iterable[bytes] = (),
) -> Automaton:
    """The automaton of a spec: which runs satisfy it, sample by sample.

    It accepts a run that is fully observed and has a robustness above 0, and none with one below 0.

    Args:
        name: which spec of the file; without it, its only result.
        compiler: "own" or "mona"; both give equal automata. Without it, that of this package, and where that
            reaches its limits, MONA.
        stored: automata as files; one of this spec is taken rather than asking MONA.

    Raises:
        NoAutomatonError: past operators, bounds in seconds, or too large.
        UsageError: no specification, no such spec, several to choose from, no such compiler.
    """
    require_specification(specification)
    if compiler is not None and compiler not in get_args(Compiler):
        raise UsageError(f"no compiler {compiler!r}; there are 'own' and 'mona'")
    spec = chosen_spec(specification, name)
    source = Source.of(specification.source, specification.filename) if specification.source else None
    propositions = Propositions(spec.formula)
    skeleton = Skeleton(spec.formula, propositions, source)
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
    """The automaton of the first compiler that gives one; the first that is stored, rather than ask MONA.

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
            compiled = progressed if each == "own" else compiled_by_mona
            machine = compiled(skeleton, count)
        except NoAutomatonError as error:
            reasons.append(f"{_NAMES[each]}: {error}")
        else:
            return _kept(automaton_of(least(machine), spec.name, propositions.all))
    raise NoAutomatonError("; ".join(reasons))


def _read(stored: Iterable[bytes], specification: Specification, spec: NamedSpec) -> Iterator[Automaton]:
    """Those of files that are of a spec, read when they are asked for."""
    for data in stored:
        found = automaton_from(data, specification, spec)
        if found is not None:
            yield found


def _kept(automaton: Automaton) -> Automaton:
    """An automaton that is small enough, and knows its guards.

    Raises:
        NoAutomatonError: it is too large.
    """
    rows = max(len(automaton.entries), len(automaton.decisions))
    if rows > MAX_ROWS:
        raise NoAutomatonError(f"it takes {rows} states or decisions, at most {MAX_ROWS} are kept")
    return automaton.with_transitions()


def chosen_spec(specification: Specification, name: str | None) -> NamedSpec:
    """The spec of a file that has a name; without one, its only result.

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
        names = ", ".join(known)
        raise UsageError(
            f"no spec {name!r} in {specification.filename}; {f'{hint} ' if hint else ''}there are {names}"
        )
    return known[name]

"""From a specification to its automaton."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

from spatial_replay.automata import mona
from spatial_replay.automata.automaton import Automaton, automaton_of
from spatial_replay.automata.machine import Machine, least
from spatial_replay.automata.progression import progressed
from spatial_replay.automata.propositions import Propositions
from spatial_replay.automata.skeleton import Skeleton
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.spec.faults import Source, nearest_hint
from spatial_replay.spec.formula import NamedSpec, Specification

Compiler: TypeAlias = Literal["own", "mona"]
"""Who compiles: this package, or MONA."""

MAX_PROPOSITIONS = 64
"""How many propositions an automaton reads at most."""

MAX_ROWS = 200_000
"""How many states an automaton has at most, and how many decisions."""


def automaton(
    specification: Specification, name: str | None = None, *, compiler: Compiler | None = None
) -> Automaton:
    """The automaton of a spec: which runs satisfy it, sample by sample.

    It accepts a run that is fully observed and has a robustness above 0, and none with one below 0.

    Args:
        name: which spec of the file; without it, its only result.
        compiler: "own" or "mona"; both give equal automata. Without it, that of this package, and where that
            reaches its limits, MONA.

    Raises:
        NoAutomatonError: past operators, bounds in seconds, or too large.
        UsageError: no such spec, several to choose from, no such compiler.
    """
    if compiler is not None and compiler not in get_args(Compiler):
        raise UsageError(f"no compiler {compiler!r}; there are 'own' and 'mona'")
    spec = _chosen(specification, name)
    source = Source.of(specification.source, specification.filename) if specification.source else None
    propositions = Propositions(spec.formula)
    skeleton = Skeleton(spec.formula, propositions, source)
    count = len(propositions.all)
    if count > MAX_PROPOSITIONS:
        raise NoAutomatonError(
            f"{spec.name} has {count} propositions, an automaton at most {MAX_PROPOSITIONS}; "
            "it is evaluated all the same; for automata, split it into several specs"
        )
    machine = _compiled(spec.name, skeleton, count, compiler)
    try:
        result = automaton_of(least(machine), spec.name, propositions.all)
        rows = max(len(result.entries), len(result.decisions))
        if rows > MAX_ROWS:
            raise NoAutomatonError(
                f"the automaton takes {rows} states or decisions, at most {MAX_ROWS} are kept"
            )
        # once here, so that what is handed out has guards
        result.transitions  # noqa: B018
    except RecursionError:
        raise NoAutomatonError(f"{spec.name}: the automaton's decisions are nested too deeply") from None
    except NoAutomatonError as error:
        raise NoAutomatonError(f"{spec.name}: {error}; split it into several specs") from error
    return result


def _compiled(name: str, skeleton: Skeleton, propositions: int, compiler: Compiler | None) -> Machine:
    if compiler != "mona":
        try:
            return progressed(skeleton, propositions)
        except NoAutomatonError as error:
            if compiler == "own":
                raise NoAutomatonError(f"{name}: {error}; split it into several specs") from error
            if not mona.is_installed():
                raise NoAutomatonError(
                    f"{name}: {error}; MONA may still compile it: {mona.INSTALL}"
                ) from error
    elif not mona.is_installed():
        raise NoAutomatonError(
            f"{name}: MONA is not installed; {mona.INSTALL}, or let this package compile it"
        )
    try:
        return mona.compiled_by_mona(skeleton, propositions)
    except NoAutomatonError as error:
        raise NoAutomatonError(f"{name}: {error}; split it into several specs") from error


def _chosen(specification: Specification, name: str | None) -> NamedSpec:
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

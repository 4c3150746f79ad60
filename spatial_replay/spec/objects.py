"""Names a specification takes from a log: objects and signals, and templates put in place."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

from spatial_replay.errors import UsageError
from spatial_replay.spec.faults import Faults, Source, nearest_hint
from spatial_replay.spec.formula import (
    Atom,
    Diagnostic,
    Formula,
    Group,
    NamedSpec,
    Signal,
    Span,
    Specification,
    TrackedName,
)
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.terms import base_of, iter_expressions, iter_formulas, substitute, terms_of
from spatial_replay.spec.tokens import span_of, tokenize


def object_names(specification: Specification) -> tuple[str, ...]:
    """Tracked objects that the specs are about, members of groups included, in the order of the text."""
    found: dict[str, None] = {}
    for atom in _atoms(specification):
        for term in terms_of(atom.expression):
            base = base_of(term)
            if isinstance(base, TrackedName):
                found[base.name] = None
            elif isinstance(base, Group):
                left_out = {excluded.name for excluded in base.excluded if isinstance(excluded, TrackedName)}
                found.update((name, None) for name in base.members or () if name not in left_out)
    return tuple(found)


def signal_names(specification: Specification) -> tuple[str, ...]:
    """Numeric signals that the specs compare, in the order of the text."""
    found: dict[str, None] = {}
    for atom in _atoms(specification):
        for part in iter_expressions(atom.expression):
            if isinstance(part, Signal):
                found[part.name] = None
    return tuple(found)


def _atoms(specification: Specification) -> Iterable[Atom]:
    seen: set[int] = set()
    for spec in specification.results:
        for formula in iter_formulas(spec.formula):
            if isinstance(formula, Atom) and id(formula) not in seen:
                seen.add(id(formula))
                yield formula


def check_names(
    specification: Specification, known: Iterable[str], signals: Iterable[str], *, where: str = "log"
) -> tuple[Diagnostic, ...]:
    """Compare the names of a specification with those of a log.

    Args:
        known: names of the log's objects.
        signals: names of its numeric signals.
        where: what has them, if it is no log.

    Returns:
        An error for each object and signal that the log never has, with the nearest that it has; a
        warning for each object of the log that a definition of the same name hides.
    """
    objects, numeric = tuple(known), tuple(signals)
    source = Source.of(specification.source, specification.filename)
    places, defined = _places(specification, source)
    missing = [("object", name, objects) for name in object_names(specification) if name not in objects]
    missing += [("signal", name, numeric) for name in signal_names(specification) if name not in numeric]
    found = [
        source.diagnostic(
            "error",
            places.get(name, Span(0, 0)),
            f"the {where} never has the {kind} {name!r}",
            " ".join(filter(None, (nearest_hint(name, candidates), _listing(kind, candidates)))),
        )
        for kind, name, candidates in missing
    ]
    for name, span in defined.items():
        if name in objects:
            message = f"the {where} has an object {name!r}, which this definition hides"
            found.append(source.diagnostic("warning", span, message, "give the definition another name"))
    return tuple(sorted(found, key=lambda each: (each.line, each.column)))


_LISTED = 12


def _listing(kind: str, names: tuple[str, ...]) -> str:
    if not names:
        return f"it has no {kind}s"
    listed = ", ".join(names[:_LISTED])
    return f"its {kind}s are {listed}" + (", ..." if len(names) > _LISTED else "")


def _places(specification: Specification, source: Source) -> tuple[dict[str, Span], dict[str, Span]]:
    """Where each name first occurs in the source, and where each definition stands."""
    relations = RELATION_NAMES | specification.relations
    tokens = tokenize(specification.source, relations, Faults(source))
    places: dict[str, Span] = {}
    defined: dict[str, Span] = {}
    for token in tokens:
        if token.type == "NAME":
            places.setdefault(token.value, span_of(token))
    for first, second in pairwise(tokens):
        if first.type in ("CONST", "REGION", "GROUP", "DEF", "SPEC") and second.type == "NAME":
            defined.setdefault(second.value, span_of(second))
    return places, defined


def instantiate(spec: NamedSpec, parameter_value: str) -> Formula:
    """The formula of a template about one object.

    Args:
        spec: a spec with an object parameter.
        parameter_value: the name of the object.

    Raises:
        UsageError: for a spec that is no template.
    """
    if spec.parameter is None:
        raise UsageError(f"spec {spec.name!r} is no template; evaluate it as it is")
    return substitute(spec.formula, {spec.parameter: TrackedName(parameter_value)})

"""What propositions are about: which objects, and whether the present alone."""

from __future__ import annotations

from collections.abc import Sequence

from spatial_replay.errors import UsageError
from spatial_replay.planning.checks import refuse_faults
from spatial_replay.spec.faults import nearest_hint
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Atom, Earlier, Enlarged, Formula, Group, Quantified, Term, TrackedName
from spatial_replay.spec.terms import base_of, iter_formulas, terms_of
from spatial_replay.trace.sample import Sample


def concerns(formula: Formula, name: str) -> bool:
    """Whether what a formula says depends on where an object is."""
    for each in iter_formulas(formula):
        if isinstance(each, Quantified):
            return True
        if isinstance(each, Atom) and any(_is_about(term, name) for term in terms_of(each.expression)):
            return True
    return False


def _is_about(term: Term, name: str) -> bool:
    base = base_of(term)
    if isinstance(base, Group):
        return base.members is None or name in base.members
    return isinstance(base, TrackedName) and base.name == name


def refuse_delays(propositions: Sequence[Formula]) -> None:
    """That propositions are about one sample each.

    Raises:
        UsageError: one looks at earlier samples, which moving an object now does not change.
    """
    for proposition in propositions:
        for each in iter_formulas(proposition):
            terms = list(terms_of(each.expression)) if isinstance(each, Atom) else []
            terms += [each.group] if isinstance(each, Quantified) else []
            if any(map(_looks_back, terms)):
                raise UsageError(
                    f"{format_formula(each)} looks at earlier samples, so there is no map of it; plan "
                    "without it, and evaluate it with replay"
                )


def _looks_back(term: Term) -> bool:
    while isinstance(term, Enlarged):
        term = term.term
    return isinstance(term, Earlier)


def refuse_unknown(names: Sequence[str], sample: Sample, propositions: Sequence[Formula]) -> None:
    """That objects are in a sample, or may come later: what propositions are about may.

    Raises:
        UsageError: with every name that is neither.
    """
    faults = []
    for name in names:
        if name not in sample.objects and not any(concerns(each, name) for each in propositions):
            hint = nearest_hint(name, sample.objects)
            faults.append(
                f"{name!r} is movable, but neither the specification nor the first sample has it; "
                f"{hint or 'the sample has: ' + (', '.join(sample.objects) or 'none')}"
            )
    refuse_faults(faults)

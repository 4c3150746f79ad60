"""One name for what is equal in two specifications: regions of one shape, groups of the same members."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from spatial_replay.spec.expressions import Expression
from spatial_replay.spec.formula import (
    Atom,
    Earlier,
    Enlarged,
    Formula,
    Group,
    Measurement,
    Outline,
    Quantified,
    RegionName,
    Term,
    Truth,
    Variable,
)
from spatial_replay.spec.walks import iter_formulas, map_leaves, map_terms, substitute


def unify_regions(
    formulas: Sequence[Formula], regions: Mapping[str, Outline], others: Mapping[str, Outline]
) -> tuple[list[Formula], dict[str, Outline]]:
    """Rename the regions of some formulas that others have with another shape; texts stay.

    Returns:
        The formulas, and the regions of both.
    """
    renamed: dict[str, str] = {}
    joined = dict(others)
    for name, outline in regions.items():
        if others.get(name, outline) != outline:
            own = f"{name} (before)"
            while own in others or own in regions:
                own += "'"
            renamed[name] = own
        joined[renamed.get(name, name)] = outline
    if not renamed:
        return list(formulas), joined
    return [_with_terms(formula, partial(_with_region, renamed=renamed)) for formula in formulas], joined


@dataclass(frozen=True, slots=True)
class SharedNames:
    """Puts one name in place of all that stand for the same.

    Attributes:
        regions: for each region, the first one of its shape.
    """

    regions: Mapping[str, str]

    @classmethod
    def of(cls, regions: Mapping[str, Outline]) -> SharedNames:
        """Find the regions of one shape."""
        first: dict[Outline, str] = {}
        return cls({name: first.setdefault(outline, name) for name, outline in regions.items()})

    def expression(self, expression: Expression) -> Expression:
        """Return an expression whose groups are known by their members, and regions by their shapes."""
        return map_leaves(expression, partial(_changed_leaf, change=self.term))

    def term(self, term: Any) -> Any:
        """Return a term of the same kind."""
        if isinstance(term, Group):
            return replace(term, name="")
        if isinstance(term, RegionName):
            return RegionName(self.regions.get(term.name, term.name))
        if not isinstance(term, (Earlier, Enlarged)):
            return term
        return replace(term, term=self.term(term.term))


def without_variables(formula: Quantified) -> Formula:
    """Return the body of a quantifier with variables that are known by their place alone."""
    inner = sum(isinstance(each, Quantified) for each in iter_formulas(formula.body))
    # no name of a text begins with a blank and a number
    return substitute(
        formula.body,
        {name: Variable(f" {inner}.{index}") for index, name in enumerate(formula.variables)},
    )


def _with_terms(formula: Formula, change: Callable[[Term], Term]) -> Formula:
    match formula:
        case Truth():
            return formula
        case Atom():
            expression = map_leaves(formula.expression, partial(_changed_leaf, change=change))
            return replace(formula, expression=expression, terms=tuple(map(change, formula.terms)))
        case Quantified():
            return replace(formula, body=_with_terms(formula.body, change))
        case _:
            return replace(formula, operands=tuple([_with_terms(each, change) for each in formula.operands]))


def _changed_leaf(leaf: Any, change: Callable[[Term], Term]) -> Any:
    return map_terms(leaf, change) if isinstance(leaf, Measurement) else leaf


def _with_region(term: Term, renamed: Mapping[str, str]) -> Term:
    if isinstance(term, RegionName):
        return RegionName(renamed.get(term.name, term.name))
    if not isinstance(term, (Earlier, Enlarged)):
        return term
    inner: Any = _with_region(term.term, renamed)
    return replace(term, term=inner)

"""Walks over terms and expressions: which names they hold, and others put in their place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from spatial_replay.spec.format import format_relation
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    CentroidProjection,
    Earlier,
    Enlarged,
    Expression,
    Formula,
    Group,
    Maximum,
    Minimum,
    Misalignment,
    Negative,
    Number,
    Projection,
    Protrusion,
    Quantified,
    RegionName,
    Signal,
    SignedDistance,
    Sum,
    Temporal,
    Term,
    TrackedName,
    Truth,
    Variable,
)
from spatial_replay.spec.relations import RELATION_NAMES


def base_of(term: Term) -> TrackedName | Variable | RegionName | Group:
    """What a term names, without delays and enlargements."""
    while isinstance(term, (Earlier, Enlarged)):
        term = term.term
    return term


def iter_expressions(expression: Expression) -> Iterator[Expression]:
    """An expression and all within it."""
    stack = [expression]
    while stack:
        current = stack.pop()
        yield current
        match current:
            case Sum():
                stack += (current.second, current.first)
            case Negative():
                stack.append(current.operand)
            case Minimum() | Maximum():
                stack += reversed(current.operands)


def terms_of(expression: Expression) -> Iterator[Term]:
    """The terms that an expression measures."""
    for current in iter_expressions(expression):
        match current:
            case SignedDistance() | Misalignment():
                yield current.first
                yield current.second
            case Protrusion():
                yield current.inner
                yield current.outer
            case Projection() | CentroidProjection():
                yield current.term


def iter_formulas(formula: Formula) -> Iterator[Formula]:
    """A formula and all within it, the bodies of quantifiers included, in the order of the text."""
    stack = [formula]
    while stack:
        current = stack.pop()
        yield current
        match current:
            case Boolean() | Temporal():
                stack += reversed(current.operands)
            case Quantified():
                stack.append(current.body)


def other_names(formula: Formula) -> frozenset[str]:
    """Names in a formula of objects, regions, groups and specs: all but variables."""
    found: set[str] = set()
    for each in iter_formulas(formula):
        if each.name is not None:
            found.add(each.name)
        terms: list[Term] = list(terms_of(each.expression)) if isinstance(each, Atom) else []
        if isinstance(each, Quantified):
            terms.append(each.group)
        for base in map(base_of, terms):
            if isinstance(base, (TrackedName, RegionName)):
                found.add(base.name)
            elif isinstance(base, Group):
                found.add(base.name)
                found.update(member.name for member in base.excluded if isinstance(member, TrackedName))
    return frozenset(found)


# -------------------------------------------------------------------------------------- substitution

Names = Mapping[str, TrackedName | Variable]


def substitute(formula: Formula, names: Names, relations: frozenset[str] = RELATION_NAMES) -> Formula:
    """A formula with other objects in place of some of its variables."""
    if not names:
        return formula
    match formula:
        case Truth():
            return formula
        case Atom():
            terms = tuple(substitute_term(term, names) for term in formula.terms)
            text = formula.text
            if terms:
                text = format_relation(formula.relation, terms, formula.parameters, relations)
            return replace(formula, text=text, terms=terms, expression=_expression(formula.expression, names))
        case Quantified():
            group: Any = substitute_term(formula.group, names)
            inner = {old: new for old, new in names.items() if old not in formula.variables}
            return replace(formula, group=group, body=substitute(formula.body, inner, relations))
        case _:
            operands = tuple([substitute(each, names, relations) for each in formula.operands])
            return replace(formula, operands=operands)


def substitute_term(term: Term, names: Names) -> Term:
    match term:
        case Variable():
            return names.get(term.name, term)
        case Group():
            excluded = tuple(_object(each, names) for each in term.excluded)
            return replace(term, excluded=excluded)
        case Earlier():
            then: Any = substitute_term(term.term, names)
            return replace(term, term=then)
        case Enlarged():
            return Enlarged(substitute_term(term.term, names), term.radius)
        case _:
            return term


def _object(term: TrackedName | Variable, names: Names) -> TrackedName | Variable:
    return names.get(term.name, term) if isinstance(term, Variable) else term


def _expression(expression: Expression, names: Names) -> Expression:
    match expression:
        case Number() | Signal():
            return expression
        case SignedDistance() | Misalignment():
            first, second = (substitute_term(term, names) for term in (expression.first, expression.second))
            return replace(expression, first=first, second=second)
        case Protrusion():
            inner, outer = (substitute_term(term, names) for term in (expression.inner, expression.outer))
            return Protrusion(inner, outer)
        case Projection() | CentroidProjection():
            return replace(expression, term=substitute_term(expression.term, names))
        case Sum():
            return Sum(_expression(expression.first, names), _expression(expression.second, names))
        case Negative():
            return Negative(_expression(expression.operand, names))
        case Minimum():
            return Minimum(tuple([_expression(operand, names) for operand in expression.operands]))
        case Maximum():
            return Maximum(tuple([_expression(operand, names) for operand in expression.operands]))

"""Atoms from relations and comparisons as written: their expression and their canonical text."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import get_args

from spatial_replay.errors import UsageError
from spatial_replay.spec.builder import MIRRORED
from spatial_replay.spec.diagnostics import Faults
from spatial_replay.spec.format import format_number, format_relation
from spatial_replay.spec.formula import (
    Atom,
    Axis,
    Enlarged,
    Equality,
    Expression,
    Group,
    Misalignment,
    RegionName,
    Signal,
    SignedDistance,
    Term,
    as_expression,
    minimum,
)
from spatial_replay.spec.relations import THREE_TERM_RELATIONS, Relation, compare
from spatial_replay.spec.resolve import Resolver, Scope, kind_of
from spatial_replay.spec.syntax import (
    BrokenStatement,
    ComparisonSyntax,
    DistanceSyntax,
    Name,
    Quantity,
    RelationSyntax,
)
from spatial_replay.spec.tokens import quoted
from spatial_replay.spec.units import scaled
from spatial_replay.spec.walks import base_of, iter_expressions, terms_of
from spatial_replay.text import text_number

_MIRRORED = MappingProxyType({">=": "<=", ">": "<"})
_AXES: tuple[str, ...] = get_args(Axis)


def parameters_of(name: str, relation: Relation) -> tuple[inspect.Parameter, ...]:
    """Return the parameters that are written in brackets behind a relation's name.

    Raises:
        UsageError: for a function that cannot be written as a relation.
    """
    taken = tuple(inspect.signature(relation).parameters.values())
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    terms = 3 if name in THREE_TERM_RELATIONS else 2
    if len(taken) < terms or any(parameter.kind not in kinds for parameter in taken):
        hint = "give a function of two terms and, after them, numbers, all positional"
        raise UsageError(f"relations: {name!r} cannot be written between two objects; {hint}")
    return taken[terms:]


@dataclass(frozen=True, slots=True)
class AtomBuilder:
    """Builds the atoms of one text in one profile."""

    relations: Mapping[str, Relation]
    names: frozenset[str]
    resolver: Resolver
    faults: Faults

    def relation(self, written: RelationSyntax, scope: Scope) -> Atom | None:
        """Return an atom of a relation; None, and a fault, where its parameters do not fit."""
        terms = tuple([self.resolver.term(term, scope) for term in written.terms])
        parameters = self._parameters(written, scope)
        if parameters is None:
            return None
        try:
            expression = as_expression(self.relations[written.relation](*terms, *parameters))
        except TypeError as error:
            raise UsageError(
                f"relations: {written.relation!r} does not return an expression: {error}"
            ) from error
        self._check(expression, written, scope)
        return self._atom(written.relation, expression, terms, parameters, written, scope)

    def distance(self, written: DistanceSyntax, scope: Scope) -> Atom:
        """Return the atom of `a dist b <= c`, c - sd(a, b); of a chain, the lesser of both comparisons."""
        terms = (self.resolver.term(written.first, scope), self.resolver.term(written.second, scope))
        limits = [(sign, self.resolver.number(limit, scope)) for sign, limit in written.comparisons]
        quantity = SignedDistance(*terms)
        comparisons = [compare(quantity, sign, limit) for sign, limit in limits]
        (sign, limit), *upper = limits
        if not upper:
            return self._atom("dist", comparisons[0], terms, (sign, limit), written, scope)
        parameters = (limit, _MIRRORED[sign], *upper[0])
        return self._atom("dist", minimum(*comparisons), terms, parameters, written, scope)

    def comparison(self, written: ComparisonSyntax, scope: Scope) -> Atom:
        """Return the atom of `signal >= c`, signal - c; `==` and `!=` are exact."""
        limit_name = written.limit if isinstance(written.limit, Name) else None
        if limit_name is not None and self.resolver.is_number(limit_name, scope):
            limit_name = None
        name, shown = written.signal, None
        if limit_name is not None and (
            self.resolver.is_number(name, scope) or (name.is_quoted and not limit_name.is_quoted)
        ):
            turned = ComparisonSyntax(limit_name, MIRRORED[written.operator], name, written.span)
            return self.comparison(turned, scope)
        if limit_name is not None and limit_name.is_quoted:
            shown, limit = quoted(limit_name.text), text_number(limit_name.text)
            if written.operator not in ("==", "!="):
                self.resolver.fault(written.span, scope, "a text has no order", "compare it by == or !=")
        else:
            limit = self.resolver.number(written.limit, scope)
        defined = self.resolver.names.definitions.get(name.text)
        if name.text in scope.values:
            message = f"{name.text!r} is a parameter or variable here; a signal of the log is expected"
            self.resolver.fault(name.span, scope, message)
        elif defined is not None and not isinstance(defined, BrokenStatement):
            message = f"{name.text!r} is {kind_of(defined)}; a signal of the log is expected"
            self.resolver.fault(name.span, scope, message)
        signal, is_equal = Signal(name.text), Equality(Signal(name.text), limit)
        exact: Mapping[str, Expression] = {"==": is_equal, "!=": -is_equal}
        expression = exact.get(written.operator) or compare(signal, written.operator, limit)
        parameters = (name.text, written.operator, limit if shown is None else shown)
        return self._atom("signal", expression, (), parameters, written, scope)

    def _atom(
        self,
        relation: str,
        expression: Expression,
        terms: tuple[Term, ...],
        parameters: tuple[float | str, ...],
        written: RelationSyntax | DistanceSyntax | ComparisonSyntax,
        scope: Scope,
    ) -> Atom:
        text = format_relation(relation, terms, parameters, self.names)
        expression = scaled(expression, self.resolver.names.scales)
        span = scope.call or written.span
        return Atom(text, relation, expression, span=span, terms=terms, parameters=parameters)

    # ------------------------------------------------------------------------------------ parameters

    def _parameters(self, written: RelationSyntax, scope: Scope) -> tuple[float | str, ...] | None:
        expected = parameters_of(written.relation, self.relations[written.relation])
        given = written.parameters
        missing = expected[len(given) :]
        if len(given) > len(expected) or any(each.default is each.empty for each in missing):
            self._report_parameters(written, expected, scope)
            return None
        values = [
            self._axis(quantity, scope) if parameter.name == "axis" else self.resolver.number(quantity, scope)
            for parameter, quantity in zip(expected, given, strict=False)
        ]
        values += [each.default if each.name == "axis" else float(each.default) for each in missing]
        return tuple(values)

    def _report_parameters(
        self, written: RelationSyntax, expected: tuple[inspect.Parameter, ...], scope: Scope
    ) -> None:
        name = written.relation
        bracket = ", ".join("x" if each.name == "axis" else each.name for each in expected)
        if not expected:
            self.resolver.fault(written.operator, scope, f"{name!r} takes no parameter", f"write a {name} b")
            return
        right = "(b, c)" if name == "between" else "b"
        what = "an axis, x, y or z" if expected[0].name == "axis" else "a number"
        hint = f"write a {name}[{bracket}] {right}, where {expected[0].name} is {what}"
        if len(expected) == 1 and len(written.parameters) == 2:
            hint += "; decimals have a point: 0.1"
        count = f"{len(expected)} parameter{'s' if len(expected) > 1 else ''}, not {len(written.parameters)}"
        self.resolver.fault(written.operator, scope, f"{name!r} takes {count}", hint)

    def _axis(self, quantity: Quantity, scope: Scope) -> str:
        if isinstance(quantity, Name) and quantity.text in _AXES:
            return quantity.text
        self.resolver.fault(quantity.span, scope, "an axis is expected here", "write x, y or z")
        return "x"

    # ---------------------------------------------------------------------------------------- checks

    def _check(self, expression: Expression, written: RelationSyntax, scope: Scope) -> None:
        """Refuse orientations of what has none, and discs of negative radius."""
        for part in iter_expressions(expression):
            if isinstance(part, Misalignment):
                for term in (part.first, part.second):
                    self._check_orientation(term, written, scope)
        for term in terms_of(expression):
            if isinstance(term, Enlarged) and term.radius < 0.0:
                message = f"{written.relation!r} with the negative radius {format_number(term.radius)}"
                self.resolver.fault(written.operator, scope, message, "write a number of at least 0")

    def _check_orientation(self, term: Term, written: RelationSyntax, scope: Scope) -> None:
        base = base_of(term)
        if isinstance(base, (RegionName, Group)):
            kind = "region" if isinstance(base, RegionName) else "group"
            message = f"{written.relation!r} needs an orientation, and a {kind} has none"
            self.resolver.fault(written.operator, scope, message, "compare single objects of the log")

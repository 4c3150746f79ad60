"""Quantifiers to formulas: written out for the members of a named group, one node over an open group."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, permutations

from spatial_replay.spec.formula import (
    Boolean,
    Earlier,
    Formula,
    Group,
    Quantified,
    Span,
    Temporal,
    TrackedName,
    Truth,
    Variable,
)
from spatial_replay.spec.namespace import Namespace
from spatial_replay.spec.relations import Relation
from spatial_replay.spec.resolve import MAX_SIZE, Anything, Resolver, Scope, Value
from spatial_replay.spec.syntax import BrokenStatement, FormulaSyntax, Name, QuantifierSyntax, TermSyntax
from spatial_replay.spec.terms import base_of, iter_formulas, other_names, substitute


@dataclass(frozen=True, slots=True)
class QuantifierBuilder:
    """Builds the formulas of the quantifiers of one text.

    Attributes:
        words: every name that occurs in the text; variables that must be renamed avoid them.
        elaborate: what a formula means in a scope, for bodies.
    """

    names: Namespace
    relations: Mapping[str, Relation]
    words: Collection[str]
    resolver: Resolver
    elaborate: Callable[[FormulaSyntax, Scope], Formula]

    def formula(self, written: QuantifierSyntax, scope: Scope, span: Span) -> Formula:
        """What a quantifier means; `true` in the place of one with faults."""
        doubled = first_repeated(written.variables)
        if doubled is not None:
            self.resolver.fault(doubled.span, scope, f"the variable {doubled.text!r} is given twice")
        group = self.resolver.term(written.group, scope)
        base = base_of(group)
        if isinstance(base, Group) and base.is_open and isinstance(group, (Group, Earlier)):
            return self._open_quantifier(written, group, scope, span)
        if isinstance(group, Group):
            return self._named_quantifier(written, group, scope, span)
        if isinstance(base, Group):
            hint = "quantify over the group, and write the delay or enlarge in the body"
            message = f"{written.quantifier} runs over the members of a group, whose names never change"
            self.resolver.fault(written.group.span, scope, message, hint)
        elif not self._is_unknown(written.group, scope):
            hint = 'define it: group NAME = a, b, or group NAME = class "name"'
            message = f"{written.quantifier} runs over a group, and this is none"
            self.resolver.fault(written.group.span, scope, message, hint)
        self._body_of_any(written, scope)
        return Truth(True)

    def _is_unknown(self, group: TermSyntax, scope: Scope) -> bool:
        if not isinstance(group, Name):
            return False
        local = scope.values.get(group.text)
        broken = isinstance(self.names.definitions.get(group.text), BrokenStatement)
        return isinstance(local, Anything) or (local is None and broken)

    def _body_of_any(self, written: QuantifierSyntax, scope: Scope) -> None:
        """Look for faults in a body that no member is put into."""
        values = dict(scope.values) | {name.text: TrackedName(name.text) for name in written.variables}
        self.elaborate(written.body, replace(scope.deeper(), values=values))

    def _named_quantifier(self, written: QuantifierSyntax, group: Group, scope: Scope, span: Span) -> Formula:
        if any(isinstance(each, Variable) for each in group.excluded):
            message = "which members are left out is known only once the variable has a value"
            hint = "quantify over a class or all, or define the group without that member"
            self.resolver.fault(written.group.span, scope, message, hint)
        excluded = {each.name for each in group.excluded}
        members = [TrackedName(name) for name in group.members or () if name not in excluded]
        choices = list(islice(permutations(members, len(written.variables)), MAX_SIZE))
        if not choices:
            self._body_of_any(written, scope)
            return Truth(written.quantifier == "forall", span=span)
        inner = scope.deeper()
        instances: list[Formula] = []
        for choice in choices:
            bound = dict(zip((name.text for name in written.variables), choice, strict=True))
            instances.append(self.elaborate(written.body, replace(inner, values={**scope.values, **bound})))
        if len(instances) == 1:
            return instances[0]
        return Boolean("and" if written.quantifier == "forall" else "or", tuple(instances), span=span)

    def _open_quantifier(
        self, written: QuantifierSyntax, group: Group | Earlier, scope: Scope, span: Span
    ) -> Formula:
        variables: list[str] = []
        for name in written.variables:
            taken = scope.bound.union(variables)
            variables.append(self._fresh(name.text, taken) if name.text in taken else name.text)
        bound: dict[str, Value] = {
            name.text: Variable(variable) for name, variable in zip(written.variables, variables, strict=True)
        }
        inner = replace(scope.deeper(), values={**scope.values, **bound}, bound=scope.bound.union(variables))
        body = self.elaborate(written.body, inner)
        temporal = next((each for each in iter_formulas(body) if isinstance(each, Temporal)), None)
        if temporal is not None:
            message = f"{temporal.operator!r} inside {written.quantifier} over an open group"
            hint = "who belongs to it changes from sample to sample; use a template: spec name(object) = ..."
            self.resolver.fault(temporal.span, scope, message, hint)
        quantified = Quantified(written.quantifier, tuple(variables), group, body, span=span)
        return self._without_clash(quantified, scope)

    def _without_clash(self, quantified: Quantified, scope: Scope) -> Quantified:
        """Rename variables that are written like something else in the body."""
        others = other_names(quantified.body)
        renamed = {
            variable: self._fresh(variable, scope.bound | others)
            for variable in quantified.variables
            if variable in others or variable in self.names.definitions
        }
        if not renamed:
            return quantified
        names = {old: Variable(new) for old, new in renamed.items()}
        body = substitute(quantified.body, names, frozenset(self.relations))
        variables = tuple(renamed.get(variable, variable) for variable in quantified.variables)
        return replace(quantified, variables=variables, body=body)

    def _fresh(self, name: str, taken: Collection[str]) -> str:
        number = 2
        while f"{name}_{number}" in taken or f"{name}_{number}" in self.words:
            number += 1
        return f"{name}_{number}"


def first_repeated(names: Sequence[Name]) -> Name | None:
    """The first of some names that an earlier one is equal to."""
    seen: set[str] = set()
    for name in names:
        if name.text in seen:
            return name
        seen.add(name.text)
    return None

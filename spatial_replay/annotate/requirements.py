"""The requirements of a formula: what it demands of objects and regions in a single sample.

A formula without temporal operators is about the present sample alone. The largest such subformulas of a
specification are its *requirements*. Each has the sign in which the specification needs it: under a negation,
or left of an implication, low robustness is what is wanted. A requirement counts until its *obligation*, the
largest temporal subformula around it, is fulfilled: no later sample can undo that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Earlier,
    Formula,
    Group,
    Quantified,
    RegionName,
    Temporal,
    Term,
    TrackedName,
    Variable,
    iter_nodes,
    operands_of,
)
from spatial_replay.spec.walks import base_of, operand_signs


class ClassMembers(NamedTuple):
    """An open group: all objects of a class in a sample, with exceptions.

    Attributes:
        class_name: casefolded, or `ANY_CLASS`.
        excluded: names of the exceptions.
    """

    class_name: str
    excluded: frozenset[str]


class Obligation(NamedTuple):
    """A temporal subformula that is in no larger one.

    Attributes:
        node: its id in the formula's tree.
        sign: 1 where the formula needs it to hold, -1 where it needs it not to.
    """

    node: int
    sign: float

    def is_fulfilled(self, series: Floats, at: Integers) -> NDArray[np.bool_]:
        """Return (S,) whether it is decided as it should be, whatever samples follow.

        Args:
            series: (N, 4, T): value, now, lower, upper of each node.
            at: (S,) indices of samples.
        """
        if self.sign > 0.0:
            return np.asarray(series[self.node, 2, at] >= 0.0)
        return np.asarray(series[self.node, 3, at] < 0.0)


class Requirement(NamedTuple):
    """A subformula without temporal operators that is in no larger one.

    Attributes:
        node: its id in the formula's tree.
        sign: 1 where the formula needs it to hold, -1 where it needs it not to.
        obligation: the temporal subformula that needs it; None if there is none.
        objects, regions: names.
        groups: open groups, whose members are objects too.
    """

    node: int
    sign: float
    obligation: Obligation | None
    objects: frozenset[str]
    regions: frozenset[str]
    groups: frozenset[ClassMembers]

    def robustness(self, series: Floats, at: Integers) -> Floats:
        """Return (S,) its robustness now, in the sign that counts; NaN once its obligation is fulfilled.

        Args:
            series: (N, 4, T): value, now, lower, upper of each node.
            at: (S,) indices of samples.
        """
        now: Floats = self.sign * series[self.node, 1, at]
        return (
            now
            if self.obligation is None
            else np.where(self.obligation.is_fulfilled(series, at), np.nan, now)
        )


_Bindings: TypeAlias = Mapping[str, Group]


def requirements_of(formula: Formula, object: str | None = None) -> tuple[Requirement, ...]:
    """Return the requirements of a formula, by node, but for those needed in both signs (`xor`, `<->`).

    Args:
        object: what the parameter of a template stands for.
    """
    nodes = list(iter_nodes(formula))
    temporal = [isinstance(node, Temporal) for _, _, node in nodes]
    for identifier, parent, _ in reversed(nodes):
        if parent is not None:
            temporal[parent] |= temporal[identifier]
    signs: list[float] = []
    obligations: list[Obligation | None] = []
    operands_passed = [0] * len(nodes)
    requirements = []
    for identifier, parent, node in nodes:
        if parent is None:
            signs.append(1.0)
        else:
            signs.append(signs[parent] * _sign(nodes[parent][2], operands_passed[parent]))
            operands_passed[parent] += 1
        above = None if parent is None else obligations[parent]
        starts = above is None and isinstance(node, Temporal)
        obligations.append(Obligation(identifier, signs[identifier]) if starts else above)
        if signs[identifier] and not temporal[identifier] and (parent is None or temporal[parent]):
            requirements.append(
                _requirement(identifier, signs[identifier], obligations[identifier], node, object)
            )
    return tuple(requirements)


def iter_subformulas(formula: Formula) -> Iterator[Formula]:
    """Yield a formula and all below it, including the bodies of open quantifiers."""
    for node, _ in _with_bindings(formula):
        yield node


def _sign(parent: Formula, operand: int) -> float:
    """Return the sign that an operand has in its parent; 0 where it counts in both."""
    signs = operand_signs(parent, operand)
    return float(signs[0]) if len(signs) == 1 else 0.0


def _requirement(
    identifier: int, sign: float, obligation: Obligation | None, formula: Formula, object: str | None
) -> Requirement:
    objects: set[str] = set()
    regions: set[str] = set()
    groups: set[ClassMembers] = set()
    for node, bindings in _with_bindings(formula):
        terms: tuple[Term, ...] = node.terms if isinstance(node, Atom) else ()
        if isinstance(node, Quantified):
            terms = (node.group,)
        for term in terms:
            match _referred(term, bindings):
                case TrackedName(name):
                    objects.add(name)
                case RegionName(name):
                    regions.add(name)
                case Variable() if object is not None:
                    objects.add(object)
                case Group() as group:
                    excluded = _excluded(group, object)
                    if group.members is None:
                        groups.add(ClassMembers((group.class_name or ANY_CLASS).casefold(), excluded))
                    else:
                        objects.update(set(group.members) - excluded)
                case _:
                    pass
    return Requirement(
        identifier, sign, obligation, frozenset(objects), frozenset(regions), frozenset(groups)
    )


def _with_bindings(formula: Formula) -> Iterator[tuple[Formula, _Bindings]]:
    """Yield a formula and all below it, each with what the quantifiers above it bind."""
    stack: list[tuple[Formula, _Bindings]] = [(formula, {})]
    while stack:
        node, bindings = stack.pop()
        yield node, bindings
        if isinstance(node, Quantified):
            group = node.group.term if isinstance(node.group, Earlier) else node.group
            if isinstance(group, Group):
                bindings = {**bindings, **dict.fromkeys(node.variables, group)}
            stack.append((node.body, bindings))
        stack.extend((operand, bindings) for operand in operands_of(node))


def _referred(term: Term, bindings: _Bindings) -> TrackedName | RegionName | Variable | Group:
    """Return what a term is about, without its delay and enlargement."""
    base = base_of(term)
    return bindings.get(base.name, base) if isinstance(base, Variable) else base


def _excluded(group: Group, object: str | None) -> frozenset[str]:
    names = [object if isinstance(each, Variable) else each.name for each in group.excluded]
    return frozenset(name for name in names if name is not None)

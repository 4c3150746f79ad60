"""Which objects and regions a formula is about, and the worst that it says of each now.

A formula without temporal operators inside speaks of its objects in the present sample. The largest such
subformulas of a specification are its *concerns*; each counts with the sign in which the specification
needs it: under a negation, or left of an implication, low robustness is what is wanted. A concern counts
until the largest temporal subformula that it is in, its *duty*, is done: no later sample can undo it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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


class OpenGroup(NamedTuple):
    """The objects of a class in a sample, but for some.

    Attributes:
        class_name: without upper case, or `ANY_CLASS`.
    """

    class_name: str
    excluded: frozenset[str]


class Duty(NamedTuple):
    """A largest temporal subformula.

    Attributes:
        node: its id in the formula's tree.
        sign: 1 where the formula needs it to hold, -1 where it needs it not to.
    """

    node: int
    sign: float

    def is_done(self, series: Floats, at: Integers) -> NDArray[np.bool_]:
        """(S,) whether it holds, or does not where it must not, whatever comes; see `Evaluated`."""
        if self.sign > 0.0:
            return np.asarray(series[self.node, 2, at] >= 0.0)
        return np.asarray(series[self.node, 3, at] < 0.0)


class Concern(NamedTuple):
    """One largest subformula without temporal operators.

    Attributes:
        node: its id in the formula's tree.
        sign: 1 where the formula needs it to hold, -1 where it needs it not to.
        duty: what it is asked for; None where nothing temporal is about it.
        objects, regions: names.
        groups: open groups, whose members are objects too.
    """

    node: int
    sign: float
    duty: Duty | None
    objects: frozenset[str]
    regions: frozenset[str]
    groups: frozenset[OpenGroup]

    def robustness(self, series: Floats, at: Integers) -> Floats:
        """(S,) how well it holds now, in the sign that counts; NaN once its duty is done.

        Args:
            series: (N, 4, T), see `Evaluated`.
            at: (S,) indices of samples.
        """
        now: Floats = self.sign * series[self.node, 1, at]
        return now if self.duty is None else np.where(self.duty.is_done(series, at), np.nan, now)


class Evaluated(NamedTuple):
    """What is known of a formula over some samples.

    Attributes:
        concerns: the formula's.
        times_ns: (T,) int64.
        series: (N, 4, T): value, now, lower, upper of each node.
    """

    concerns: tuple[Concern, ...]
    times_ns: Integers
    series: Floats


class Seen(NamedTuple):
    """Who is in S samples.

    Attributes:
        times_ns: (S,) int64.
        names: the objects' names.
        class_code: (S, len(names)) int64, index into `classes`; -1 where the object is not seen.
        classes: class names, or None.
    """

    times_ns: Integers
    names: Sequence[str]
    class_code: Integers
    classes: Sequence[str | None]


_Bindings: TypeAlias = Mapping[str, Group]


def concerns_of(formula: Formula, object: str | None = None) -> tuple[Concern, ...]:
    """The concerns of a formula, by node; those that count in both signs (under `xor`, `<->`) are left out.

    Args:
        object: what the parameter of a template stands for.
    """
    nodes = list(iter_nodes(formula))
    temporal = [isinstance(node, Temporal) for _, _, node in nodes]
    for identifier, parent, _ in reversed(nodes):
        if parent is not None:
            temporal[parent] |= temporal[identifier]
    signs: list[float] = []
    duties: list[Duty | None] = []
    operands_passed = [0] * len(nodes)
    found = []
    for identifier, parent, node in nodes:
        if parent is None:
            signs.append(1.0)
        else:
            signs.append(signs[parent] * _sign(nodes[parent][2], operands_passed[parent]))
            operands_passed[parent] += 1
        above = None if parent is None else duties[parent]
        starts = above is None and isinstance(node, Temporal)
        duties.append(Duty(identifier, signs[identifier]) if starts else above)
        if signs[identifier] and not temporal[identifier] and (parent is None or temporal[parent]):
            found.append(_concern(identifier, signs[identifier], duties[identifier], node, object))
    return tuple(found)


def iter_subformulas(formula: Formula) -> Iterator[Formula]:
    """A formula and all below it, what open quantifiers say of their members included."""
    for node, _ in _with_bindings(formula):
        yield node


def worst_robustness(
    evaluated: Sequence[Evaluated], seen: Seen, regions: Sequence[str]
) -> tuple[Floats, Floats]:
    """The least robustness now, in the sign that counts, that each object and region still takes part in.

    Returns:
        (S, objects) and (S, regions); NaN for what takes part in nothing that is known.
    """
    objects = np.full(seen.class_code.shape, np.nan)
    places = np.full((len(seen.times_ns), len(regions)), np.nan)
    for concerns, times_ns, series in evaluated:
        if not len(times_ns):
            continue
        at = np.minimum(np.searchsorted(times_ns, seen.times_ns), len(times_ns) - 1)
        is_evaluated = times_ns[at] == seen.times_ns
        for concern in concerns:
            now = np.where(is_evaluated, concern.robustness(series, at), np.nan)
            for column in _columns(concern.objects, seen.names):
                objects[:, column] = np.fmin(objects[:, column], now)
            for column in _columns(concern.regions, regions):
                places[:, column] = np.fmin(places[:, column], now)
            for group in concern.groups:
                objects = np.where(_members(group, seen), np.fmin(objects, now[:, None]), objects)
    return objects, places


def _sign(parent: Formula, operand: int) -> float:
    """Return how an operand's sign follows from that of the formula it stands in; 0 where neither does."""
    signs = operand_signs(parent, operand)
    return float(signs[0]) if len(signs) == 1 else 0.0


def _concern(
    identifier: int, sign: float, duty: Duty | None, formula: Formula, object: str | None
) -> Concern:
    objects: set[str] = set()
    regions: set[str] = set()
    groups: set[OpenGroup] = set()
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
                        groups.add(OpenGroup((group.class_name or ANY_CLASS).casefold(), excluded))
                    else:
                        objects.update(set(group.members) - excluded)
                case _:
                    pass
    return Concern(identifier, sign, duty, frozenset(objects), frozenset(regions), frozenset(groups))


def _with_bindings(formula: Formula) -> Iterator[tuple[Formula, _Bindings]]:
    """A formula and all below it, each with what the quantifiers above it bind."""
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
    """What a term is about, whenever and however far around."""
    base = base_of(term)
    return bindings.get(base.name, base) if isinstance(base, Variable) else base


def _excluded(group: Group, object: str | None) -> frozenset[str]:
    names = [object if isinstance(who, Variable) else who.name for who in group.excluded]
    return frozenset(name for name in names if name is not None)


def _columns(chosen: frozenset[str], names: Sequence[str]) -> list[int]:
    return [column for column, name in enumerate(names) if name in chosen]


def _members(group: OpenGroup, seen: Seen) -> NDArray[np.bool_]:
    """(S, objects), who belongs to an open group in each sample."""
    fits = [group.class_name in (ANY_CLASS, (name or "").casefold()) for name in seen.classes]
    included = np.array([name not in group.excluded for name in seen.names], np.bool_)
    # the last entry is that of an object not seen, which has the code -1
    return np.array([*fits, False], np.bool_)[seen.class_code] & included

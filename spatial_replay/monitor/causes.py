"""Why a result is not satisfied: one cause for each named spec that fails in it, what settled it first."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.stream import NEVER
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.monitor.witness.witness import Witness
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Formula, NamedSpec, iter_nodes, operator_of
from spatial_replay.text import shortened_formula


@dataclass(frozen=True, slots=True)
class Cause:
    """One reason why a result is violated or unknown.

    Attributes:
        spec: the innermost named spec that the conjunct belongs to.
        node: id of the conjunct.
        text: its canonical text.
        verdict: violated, or unknown.
        robustness: of the conjunct on the whole log; NaN if not determined.
        settled_ns: when its violation became certain; None if only the end of the log
            decided.
        witness: the atom that decides it: at `settled_ns`, on the samples up to there, or else on the
            whole log. None if the leaves were not stored, and under the paper's semantics.
        least: the atom that gives it the robustness of the whole log, where that is less than at
            `settled_ns`; else None.
        requirement, title: of the spec ("REQ-12" and its words), or None.
    """

    spec: str
    node: int
    text: str
    verdict: Verdict
    robustness: float
    settled_ns: int | None
    witness: Witness | None
    requirement: str | None = None
    title: str | None = None
    least: Witness | None = None

    @property
    def shown(self) -> Witness | None:
        """The atom that its robustness is of."""
        return self.least or self.witness


@dataclass(frozen=True, slots=True)
class LeastPart:
    """The conjunct of a result that has the least robustness.

    Attributes:
        spec: the innermost named spec that it belongs to.
        name: what to call it: the spec's name or, if that is the first cause's too, its own text, shortened.
        node: its id.
    """

    spec: str
    name: str
    node: int
    robustness: float


@dataclass(frozen=True, slots=True)
class Conjunct:
    """A part of a formula that has to hold for the formula to hold.

    Attributes:
        node: its id.
        spec: the innermost named spec that it belongs to.
    """

    node: int
    spec: str
    formula: Formula


def conjuncts_of(formula: Formula, name: str, node: int = 0) -> tuple[Conjunct, ...]:
    """Split a formula at its conjunctions, through named specs, in the order of the text.

    Args:
        name: what the formula itself is called.
        node: its id.
    """
    specs: dict[int, str] = {}
    found = []
    for identifier, parent, part in iter_nodes(formula):
        if parent is None:
            specs[identifier] = name
        elif parent in specs:
            specs[identifier] = part.name or specs[parent]
        else:
            continue
        if operator_of(part) not in ("and", "spec"):
            found.append(Conjunct(node + identifier, specs.pop(identifier), part))
    return tuple(found)


def find_causes(
    conjuncts: Sequence[Conjunct],
    values: Floats,
    final: Floats,
    settled_ns: Integers,
    witnesses: Callable[[int, int | None], tuple[Witness | None, Witness | None]] = lambda *_: (None, None),
    named: Mapping[str, NamedSpec] = MappingProxyType({}),
) -> tuple[Cause, ...]:
    """Return one cause for each named spec with a conjunct that is not satisfied.

    First come those that were violated for certain before the log ended, by that time; then those that only
    its end decided, the least robustness first; then unknown ones.

    Args:
        values: (N,), each node's value on the whole log.
        final: (N, 2), the ends of each node's interval for the finished log.
        settled_ns: (N, 2), see `InstanceStream`.
        witnesses: returns those of a node: what settled it at a time, or decides it on the whole log, and
            what gave it its robustness later.
        named: specs by name.
    """
    failing = [each for each in conjuncts if _verdict(final, each.node) is not Verdict.SATISFIED]
    first: dict[str, Conjunct] = {}
    for each in sorted(failing, key=lambda each: _order(each.node, values, final, settled_ns)):
        first.setdefault(each.spec, each)
    causes = []
    for each in first.values():
        at = settled_time(settled_ns, each.node)
        about = named.get(each.spec)
        witness, least = witnesses(each.node, at)
        causes.append(
            Cause(
                each.spec,
                each.node,
                format_formula(each.formula),
                _verdict(final, each.node),
                float(values[each.node]),
                at,
                witness,
                None if about is None else about.id,
                None if about is None else about.title,
                least,
            )
        )
    return tuple(causes)


def find_least(
    conjuncts: Sequence[Conjunct], values: Floats, final: Floats, first: Cause, whole: str
) -> LeastPart | None:
    """Return the conjunct that has the least robustness; None if that is the first cause.

    Args:
        whole: what the formula itself is called.
    """
    least = min(conjuncts, key=lambda each: _number(each.node, values, final))
    robustness = _number(least.node, values, final)
    if least.node == first.node or not robustness < _number(first.node, values, final):
        return None
    has_own_name = least.spec not in (first.spec, whole)
    name = least.spec if has_own_name else shortened_formula(format_formula(least.formula))
    return LeastPart(least.spec, name, least.node, robustness)


def settled_time(settled_ns: Integers, node: int) -> int | None:
    """Return when the violation of a node became certain, or None."""
    at = int(settled_ns[node, 1])
    return None if at == NEVER else at


def _verdict(final: Floats, node: int) -> Verdict:
    return final_verdict(*final[node].tolist())


def _number(node: int, values: Floats, final: Floats) -> float:
    value = float(values[node])
    return float(final[node, 1]) if math.isnan(value) else value


def _order(node: int, values: Floats, final: Floats, settled_ns: Integers) -> tuple[int, float, int]:
    if _verdict(final, node) is not Verdict.VIOLATED:
        return 2, 0.0, node
    at = settled_time(settled_ns, node)
    return (1, _number(node, values, final), node) if at is None else (0, at, node)

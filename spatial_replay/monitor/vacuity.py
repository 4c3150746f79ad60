"""The parts of a result that decided nothing: empty windows, antecedents that never held, empty groups."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.offline import evaluate_offline
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.path import End, deciding_path
from spatial_replay.spec.format import format_formula, format_term
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Bound,
    Earlier,
    Formula,
    Group,
    Quantified,
    Temporal,
    TrackedName,
    iter_nodes,
    operands_of,
)
from spatial_replay.spec.walks import iter_terms, without_enlargement
from spatial_replay.text import Instant, Sentence

Reason: TypeAlias = Literal[
    "empty window", "antecedent never held", "no members", "past the end", "no instances"
]
_Samples: TypeAlias = NDArray[np.bool_]
_NEXT = {"X": "next sample", "WX": "next sample", "Y": "sample before"}


@dataclass(frozen=True, slots=True)
class Vacuous:
    """A part of a formula that decided nothing, since what it is about never was.

    Attributes:
        node: its id; None for a template without instances.
        text: its canonical text.
        reason: "empty window": no sample ever lies in the window of an operator; "antecedent never held": of
            an implication; "no members": an open group is empty; "past the end": the result is infinite, for
            what decides looks past an end of the log; "no instances": a template that no object fits.
        message: a sentence.
    """

    node: int | None
    text: str
    reason: Reason
    message: Sentence


def no_instances(name: str, parameter: str) -> Vacuous:
    """Return the entry of a template that no object fits."""
    text = f"{name}({parameter})"
    message = f"`{text}` was never evaluated: no object stands for {parameter}."
    return Vacuous(None, text, "no instances", Sentence(message))


def find_vacuous(
    evidence: Evidence, leaves: Floats, times_ns: Integers, *, is_infinite: bool
) -> tuple[Vacuous, ...]:
    """Return the parts of an instance's formula that decided nothing, in the order of the text.

    Args:
        evidence: the samples that it was evaluated over.
        leaves: (C, A, T), its leaves in them.
        times_ns: (T,), T at least 1.
        is_infinite: whether the formula's robustness is infinite at least, at the first sample.
    """
    instance = evidence.instance
    nodes = [node for _, _, node in iter_nodes(instance.formula)]
    scopes = _scopes(instance.formula, times_ns)
    found = [
        *_empty_windows(nodes, scopes, times_ns),
        *_idle_implications(nodes, scopes, leaves, times_ns, evidence),
        *_idle_bodies(nodes, scopes, evidence),
        *_empty_groups(nodes, scopes, evidence),
    ]
    if is_infinite:
        done = evaluate_offline(instance.formula, instance.program.leaves, leaves, times_ns)
        path = deciding_path(instance.formula, done, times_ns, 0, End.LOW)
        node, sample = path.steps[-1].node, path.steps[-1].sample
        if node not in {each.node for each in found}:
            found += _infinite(node, nodes[node], Instant(int(times_ns[sample]), evidence.first_ns()))
    return tuple(
        Vacuous(each.node, text, each.reason, Sentence(f"`{text}` ", *each.what))
        for each in sorted(found, key=lambda each: each.node)
        for text in (format_formula(evidence.bound(nodes[each.node])),)
    )


class _Idle(NamedTuple):
    """A part that decided nothing, and the rest of the sentence that begins with its text."""

    node: int
    reason: Reason
    what: tuple[str | Instant, ...]


# ---------------------------------------------------------------------------------------------- scopes


def _scopes(formula: Formula, times_ns: Integers) -> list[_Samples]:
    """Return for each node the samples (T,) at which the number of the formula depends on it."""
    count = len(times_ns)
    scopes: list[_Samples] = []
    operands_passed: list[int] = []
    nodes: list[Formula] = []
    for _, parent, node in iter_nodes(formula):
        nodes.append(node)
        operands_passed.append(0)
        if parent is None:
            scopes.append(np.arange(count) == 0)
            continue
        place = operands_passed[parent]
        operands_passed[parent] += 1
        above = nodes[parent]
        within = scopes[parent]
        scopes.append(_below(above, place, within, times_ns) if isinstance(above, Temporal) else within)
    return scopes


def _below(formula: Temporal, place: int, scope: _Samples, times_ns: Integers) -> _Samples:
    """Return the samples at which an operand counts, if its operator does so in the samples of `scope`."""
    begin, end = windows_of(formula, times_ns)
    here = np.flatnonzero(scope & (begin < end))
    begin, end = begin[here], end[here]
    if place < len(formula.operands) - 1:
        # the left operand holds from each sample to the one before the right one's
        if formula.operator == "S":
            begin, end = begin + 1, here + 1
        else:
            begin = here
            end = end - (formula.operator != "W")
    edges = np.zeros(len(scope) + 1, np.int64)
    there = begin < end
    np.add.at(edges, begin[there], 1)
    np.add.at(edges, end[there], -1)
    covered: _Samples = np.cumsum(edges[:-1]) > 0
    return covered


def windows_of(formula: Temporal, times_ns: Integers) -> tuple[Integers, Integers]:
    """Return the first sample (T,) in an operator's window at each sample, and the one after the last."""
    count = len(times_ns)
    here = np.arange(count, dtype=np.int64)
    is_ahead = formula.operator in FUTURE_OPERATORS
    bound = formula.bound or Bound(0, None, "samples")
    if formula.operator in _NEXT:
        bound = Bound(1, 1, "samples")
    # as distances from the first sample, and no further than the last: sums stay below 64 bits
    places = here if bound.unit == "samples" else times_ns - times_ns[0]
    furthest = int(places[-1]) + 1
    near = min(bound.lower, furthest)
    far = furthest if bound.upper is None else min(bound.upper, furthest)
    low, high = (places + near, places + far) if is_ahead else (places - far, places - near)
    if bound.unit == "samples":
        return np.clip(low, 0, count), np.clip(high + 1, 0, count)
    begin = np.searchsorted(places, low, side="left").astype(np.int64)
    return begin, np.searchsorted(places, high, side="right").astype(np.int64)


# --------------------------------------------------------------------------------------------- reasons


def _empty_windows(
    nodes: Sequence[Formula], scopes: Sequence[_Samples], times_ns: Integers
) -> Iterator[_Idle]:
    for identifier, (node, scope) in enumerate(zip(nodes, scopes, strict=True)):
        if not isinstance(node, Temporal) or not scope.any():
            continue
        begin, end = windows_of(node, times_ns)
        if not (begin < end)[scope].any():
            what = "no sample of the log lies in its window"
            if node.operator in _NEXT:
                what = f"the log has no {_NEXT[node.operator]}"
            yield _Idle(identifier, "empty window", (f"was never tested: {what}.",))


def _idle_implications(
    nodes: Sequence[Formula],
    scopes: Sequence[_Samples],
    leaves: Floats,
    times_ns: Integers,
    evidence: Evidence,
) -> Iterator[_Idle]:
    order = evidence.instance.program.leaves
    for identifier, (node, scope) in enumerate(zip(nodes, scopes, strict=True)):
        if isinstance(node, Boolean) and node.operator == "->" and scope.any():
            high = evaluate_offline(node.operands[0], order, leaves, times_ns).ends(0)[1]
            if not (high[scope] >= 0.0).any():
                yield _untested(identifier, node, evidence)


def _untested(identifier: int, implication: Boolean, evidence: Evidence) -> _Idle:
    antecedent = format_formula(evidence.bound(implication.operands[0]))
    what = f"was never tested: `{antecedent}` never held."
    return _Idle(identifier, "antecedent never held", (what,))


def _idle_bodies(nodes: Sequence[Formula], scopes: Sequence[_Samples], evidence: Evidence) -> Iterator[_Idle]:
    """Find implications in the bodies of quantifiers, whose antecedent held for none of the members."""
    for identifier, (node, scope) in enumerate(zip(nodes, scopes, strict=True)):
        if not isinstance(node, Quantified) or not scope.any():
            continue
        inner = list(_implications(node))
        if not inner:
            continue
        columns = evidence.columns([evidence.bound(held) for _, held in inner])
        high = columns[low_and_high(len(columns), wide=True)[1]]
        for (implication, _), ends in zip(inner, high, strict=True):
            if not (ends[scope] >= 0.0).any():
                yield _untested(identifier, implication, evidence)


def _implications(node: Quantified) -> Iterator[tuple[Boolean, Formula]]:
    """Yield each implication in a quantifier's body, with the formula that its antecedent ever holds."""
    stack: list[Formula] = [node.body]
    while stack:
        current = stack.pop()
        if isinstance(current, Quantified):
            for implication, held in _implications(current):
                yield implication, replace(node, quantifier="exists", body=held)
            continue
        if isinstance(current, Boolean) and current.operator == "->":
            yield current, replace(node, quantifier="exists", body=current.operands[0])
        stack.extend(reversed(operands_of(current)))


def _empty_groups(
    nodes: Sequence[Formula], scopes: Sequence[_Samples], evidence: Evidence
) -> Iterator[_Idle]:
    groups: dict[Group | Earlier, bool] = {}
    open_groups = {
        identifier: list(_open_groups(evidence.bound(node)))
        for identifier, (node, scope) in enumerate(zip(nodes, scopes, strict=True))
        if isinstance(node, Atom | Quantified) and scope.any()
    }
    wanted = list(dict.fromkeys(group for each in open_groups.values() for group in each))
    groups = dict(zip(wanted, evidence.have_members(wanted), strict=True))
    for identifier, own in open_groups.items():
        empty = [group for group in own if not groups[group]]
        if empty:
            names = " or ".join(f"`{format_term(group)}`" for group in dict.fromkeys(empty))
            what = f"decided nothing: no object was ever in {names}."
            yield _Idle(identifier, "no members", (what,))


def _open_groups(formula: Formula) -> Iterator[Group | Earlier]:
    """Yield the open groups that a leaf is about, as they are for any binding of its variables."""
    for term in map(without_enlargement, iter_terms([formula])):
        group = term.term if isinstance(term, Earlier) else term
        if isinstance(group, Group) and group.members is None:
            excluded = tuple(each for each in group.excluded if isinstance(each, TrackedName))
            whole = replace(group, excluded=excluded)
            yield replace(term, term=whole) if isinstance(term, Earlier) else whole


def _infinite(identifier: int, node: Formula, when: Instant) -> Iterator[_Idle]:
    """Yield why a result is infinite, from the node that its number is of."""
    if isinstance(node, Temporal):
        side = "past the end" if node.operator in FUTURE_OPERATORS else "before the start"
        yield _Idle(identifier, "past the end", ("decides at ", when, f", where it looks {side} of the log."))
    elif isinstance(node, Atom | Quantified):
        yield _Idle(identifier, "no members", ("decides at ", when, ", where no object is in its group."))

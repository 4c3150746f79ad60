"""One spec in two runs: since when its values differ, which part brought that about, and who moved for it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spatial_replay.compare.alignment import Alignment, Parting, parting_of
from spatial_replay.compare.movement import ObjectDiff
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.sentences import reason_sentence
from spatial_replay.spec.formula import Atom, Specification, iter_nodes
from spatial_replay.spec.walks import other_names
from spatial_replay.text import Instant, Sentence, json_number, with_unit
from spatial_replay.trace.trace import Trace


@dataclass(frozen=True, eq=False)
class RunSpecDiff:
    """One result in two runs.

    Attributes:
        a, b: the results.
        first_ns: the first sample of A with a value of another sign than the one beside it in B, or None.
        nodes: ids of the deepest nodes whose verdicts differ.
        parting: where the runs part in its automaton; None if the verdict is the same, or it has none.
        moved: the objects that the deciding atoms are about, as far as they moved differently.
    """

    a: SpecResult
    b: SpecResult
    first_ns: int | None
    nodes: tuple[int, ...]
    parting: Parting | None
    moved: tuple[ObjectDiff, ...]

    @property
    def is_flipped(self) -> bool:
        """Whether the verdict differs."""
        return self.a.verdict is not self.b.verdict

    @property
    def is_different(self) -> bool:
        """Whether the verdict or a final number differs."""
        one, other = ((each.robustness, each.lower, each.upper) for each in (self.a, self.b))
        return self.is_flipped or not np.array_equal(one, other, equal_nan=True)

    def sentences(self, starts_ns: tuple[int, int]) -> Iterator[Sentence]:
        """Yield what differs; times of each run count from its own start."""
        texts = [f"{each.verdict} ({with_unit(each.robustness, each.unit)})" for each in (self.a, self.b)]
        yield Sentence(" | ".join(texts) + ("" if self.is_different else ", the same"))
        if self.first_ns is not None:
            yield Sentence("the sign of its value differs since ", Instant(self.first_ns, starts_ns[0]))
        if self.parting is not None:
            where = self.parting
            yield Sentence(
                "they part in the automaton: ",
                *_entered(where.a_ns, where.a_states, starts_ns[0]),
                " | ",
                *_entered(where.b_ns, where.b_states, starts_ns[1]),
            )
        for node in self.nodes:
            yield Sentence(f"brought about by `{self.a.nodes[node].text}`")
        for which, result, start_ns in zip("AB", (self.a, self.b), starts_ns, strict=True):
            if self.is_flipped and result.causes and result.causes[0].witness is not None:
                reason = reason_sentence(result.causes[0].witness, first_ns=start_ns)
                yield Sentence(f"{which}: ", *reason.parts)
        if self.moved:
            names = ", ".join(each.name for each in self.moved)
            yield Sentence(f"of what it is about, these moved differently: {names}")

    @property
    def document(self) -> dict[str, Any]:
        """The same as values for JSON."""
        parting = self.parting
        return {
            "name": self.a.name,
            "object": self.a.object,
            "flipped": self.is_flipped,
            "a": _result_value(self.a),
            "b": _result_value(self.b),
            "first_ns": self.first_ns,
            "nodes": [{"id": node, "text": self.a.nodes[node].text} for node in self.nodes],
            "parting": None
            if parting is None
            else {
                "a_ns": parting.a_ns,
                "b_ns": parting.b_ns,
                "a_states": list(parting.a_states),
                "b_states": list(parting.b_states),
            },
            "moved": [each.name for each in self.moved],
        }


def compare_results(
    one: SpecResult,
    other: SpecResult,
    alignment: Alignment,
    traces: tuple[Trace, Trace],
    objects: Sequence[ObjectDiff],
    files: Sequence[Specification],
) -> RunSpecDiff:
    """Compare the results of one spec in two aligned runs.

    Args:
        objects: those that moved differently.
    """
    moved = {each.name: each for each in objects}
    nodes = _deepest_flipped(one, other)
    if not nodes and one.can_explain and one.robustness != other.robustness:
        nodes = (one.deciding_node(),)
    names = [name for node in nodes for name in sorted(_objects_of(one, node)) if name in moved]
    return RunSpecDiff(
        one,
        other,
        _first_sign(one, other, alignment, traces),
        nodes,
        parting_of(one, other, files) if one.verdict is not other.verdict else None,
        tuple(moved[name] for name in dict.fromkeys(names)),
    )


def _deepest_flipped(one: SpecResult, other: SpecResult) -> tuple[int, ...]:
    """Return the nodes with other verdicts that have no such node below."""
    flipped = {
        node.id
        for node, beside in zip(one.nodes, other.nodes, strict=True)
        if node.verdict is not beside.verdict
    }
    if 0 not in flipped:
        return ()
    below = {one.nodes[node].parent for node in flipped}
    # of a conjunction only what brought it about: the way down from the root is flipped, too
    reached = {0}
    for node in sorted(flipped):
        if one.nodes[node].parent in reached:
            reached.add(node)
    return tuple(sorted(reached - below))


def _objects_of(result: SpecResult, node: int) -> frozenset[str]:
    formula = next(each for identifier, _, each in iter_nodes(result.formula) if identifier == node)
    bound = result.evidence.bound(formula)
    names: set[str] = set(other_names(bound))
    for _, _, leaf in iter_nodes(bound):
        if isinstance(leaf, Atom):
            names |= {getattr(term, "name", "") for term in leaf.terms}
    return frozenset(names)


def _first_sign(
    one: SpecResult, other: SpecResult, alignment: Alignment, traces: tuple[Trace, Trace]
) -> int | None:
    """Return the first sample with a value of another sign than the one beside it."""
    signs = []
    for result, trace, chosen in zip((one, other), traces, (alignment.a, alignment.b), strict=True):
        value = np.full(len(trace), np.nan)
        value[np.searchsorted(trace.times_ns, result.times_ns)] = result.series[0, 0]
        signs.append(np.where(np.isnan(value), 0, np.where(value >= 0.0, 1, -1))[chosen])
    differs = signs[0] != signs[1]
    return int(traces[0].times_ns[alignment.a[differs.argmax()]]) if differs.any() else None


def _entered(time_ns: int | None, states: Sequence[int], start_ns: int) -> tuple[str | Instant, ...]:
    if time_ns is None:
        return ("the end of the run",)
    return f"state {', '.join(map(str, states))} at ", Instant(time_ns, start_ns)


def _result_value(result: SpecResult) -> dict[str, Any]:
    return {
        "verdict": str(result.verdict),
        "robustness": json_number(result.robustness),
        "lower": json_number(result.lower),
        "upper": json_number(result.upper),
    }

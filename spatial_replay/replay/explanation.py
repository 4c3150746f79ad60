"""Why results of a replay are what they are, for people and for machines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.inspection.words import sentences_of
from spatial_replay.monitor.evaluation import no_such_node
from spatial_replay.monitor.verdict import Verdict, online_verdict
from spatial_replay.replay.document import witness_document
from spatial_replay.replay.found import Replayed, ReplayedSpec
from spatial_replay.spec.formula import iter_nodes


@dataclass(frozen=True, slots=True)
class Explanation:
    """Why one node has its verdict.

    Attributes:
        time_ns: of the sample that decides.
        sentences: in words.
        document: as a value that JSON can hold.
    """

    verdict: Verdict
    time_ns: int
    sentences: tuple[str, ...]
    document: Mapping[str, Any]


def explanations(
    replayed: Replayed, *, node: str | None = None, object: str | None = None, goes_on: bool = False
) -> list[Explanation]:
    """Why results, or the nodes of a name in them, have their verdicts.

    Args:
        replayed: with series and leaves kept.
        object: only what is about this object of a template.
        goes_on: whether there may be samples after those evaluated, which could change a verdict.

    Raises:
        UsageError: no such node or object, or nothing was evaluated.
    """
    results = [result for result in replayed.results if object in (None, result.object)]
    if not results:
        known = ", ".join(sorted({result.object for result in replayed.results if result.object})) or "none"
        asked = "" if object is None else f" about object {object!r}"
        raise UsageError(f"no result is{asked or ' there'}; objects with a result of their own: {known}")
    found = [
        explanation_of(result, identifier, first_ns=replayed.first_ns, goes_on=goes_on)
        for result in results
        for identifier in _nodes_named(result, node)
    ]
    if not found:
        names = sorted(
            {each.name for result in results for _, _, each in iter_nodes(result.formula) if each.name}
        )
        raise UsageError(no_such_node(node or "", names))
    return found


def _nodes_named(result: ReplayedSpec, name: str | None) -> Iterator[int]:
    if name is None or name == result.name:
        yield 0
        return
    for identifier, _, each in iter_nodes(result.formula):
        if each.name == name:
            yield identifier
            return


def explanation_of(
    result: ReplayedSpec, node: int = 0, *, first_ns: int, goes_on: bool = False
) -> Explanation:
    """Why a node of a result has its verdict; see `explanations`."""
    if result.inquiry is None or result.series is None or result.times_ns is None:
        raise ValueError("series and leaves of the replay were not kept")
    witness = result.inquiry.witness(node)
    value, _, lower, upper = result.series[node]
    since = _since(value, lower, upper) if witness.verdict is not Verdict.UNKNOWN else None
    since_ns = None if since is None else int(result.times_ns[since])
    is_open = goes_on and online_verdict(float(lower[-1]), float(upper[-1])) is Verdict.PENDING
    sentences = sentences_of(witness, first_ns=first_ns, since_ns=since_ns, is_open=is_open)
    document = {
        **witness_document(witness, first_ns),
        "specification": result.name,
        "object": result.object,
        "since_ns": since_ns,
        "may_change": is_open,
        "explanation": list(sentences),
    }
    return Explanation(witness.verdict, witness.time_ns, sentences, document)


def _since(value: Floats, lower: Floats, upper: Floats) -> int | None:
    """The first sample from which on it has been as it is at the last; None where it is not known when.

    Args:
        value, lower, upper: (T,), the node's, of which the last settle its verdict.
    """
    holds = (value >= 0.0) | (lower >= 0.0)
    fails = (value < 0.0) | (upper < 0.0)
    same = holds if holds[-1] else fails
    others = np.flatnonzero(~same)
    if not len(others):
        return 0
    last = int(others[-1])
    is_known = holds[last] or fails[last]
    return last + 1 if is_known and last + 1 < len(value) else None

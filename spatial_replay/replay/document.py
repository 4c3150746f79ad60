"""The results of a replay as JSON, and the explanations of their verdicts, as sentences and as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.result import SpecResult, no_such_node
from spatial_replay.monitor.sentences import sentences_of
from spatial_replay.monitor.verdict import Verdict, online_verdict
from spatial_replay.monitor.witness.atom import Measured
from spatial_replay.monitor.witness.witness import Witness
from spatial_replay.replay.engine import Replayed
from spatial_replay.spec.formula import iter_nodes
from spatial_replay.text import json_number


def document_from_replay(
    replayed: Replayed, *, signal: bool = False, window_ns: int | None = None
) -> Mapping[str, Any]:
    """Return one JSON object; infinite numbers are the strings "inf" and "-inf", undetermined ones null.

    Args:
        signal: add to the series each node's robustness from each sample to the end.
        window_ns: add to the series each node's robustness over a sliding window of that width.

    Raises:
        UsageError: a signal or a window under semantics that lack them.
    """
    return {
        "log": {
            "name": replayed.log,
            "samples": replayed.samples,
            "start_ns": replayed.start_ns,
            "end_ns": replayed.end_ns,
            "damaged": bool(replayed.faults),
            "faults": list(replayed.faults),
            "remarks": list(replayed.remarks),
            "unreadable_observations": replayed.unreadable,
        },
        "semantics": replayed.semantics,
        "certificate": dict(replayed.certificate),
        "specifications": [
            _result(result, replayed.start_ns, signal, window_ns) for result in replayed.results
        ],
    }


def _result(result: SpecResult, first_ns: int, signal: bool, window_ns: int | None) -> dict[str, Any]:
    value: dict[str, Any] = {
        "name": result.name,
        "object": result.object,
        "verdict": str(result.verdict),
        "robustness": json_number(result.robustness),
        "lower": json_number(result.lower),
        "upper": json_number(result.upper),
        "first_satisfied_ns": result.first_satisfied_ns,
        "worst": None,
        "nodes": [
            {
                "id": node.id,
                "parent": node.parent,
                "operator": node.operator,
                "name": node.name,
                "text": node.text,
                "verdict": str(node.verdict),
                "robustness": json_number(node.robustness),
                "lower": json_number(node.final_lower),
                "upper": json_number(node.final_upper),
            }
            for node in result.nodes
        ],
    }
    if result.can_explain:
        value["worst"] = witness_document(result.witness(), first_ns)
    if result.has_series:
        value["series"] = {
            "time_ns": result.times_ns.tolist(),
            **{
                key: _numbers(result.series[:, k]) for k, key in enumerate(("value", "now", "lower", "upper"))
            },
        }
        if result.leaves is not None and signal:
            value["series"]["signal"] = _numbers(result.full_signal())
        if result.leaves is not None and window_ns is not None:
            value["series"]["window"] = _numbers(result.window_signal(window_ns))
    return value


def witness_document(witness: Witness, first_ns: int) -> dict[str, Any]:
    """Return what decides a node's verdict, with sentences that count time from `first_ns`."""
    deciding, threshold = witness.deciding, witness.threshold
    value: dict[str, Any] = {
        "node": witness.node,
        "name": witness.path[0].name,
        "verdict": str(witness.verdict),
        "lower": json_number(witness.lower),
        "upper": json_number(witness.upper),
        "time_ns": witness.time_ns,
        "path": [{"node": step.node, "time_ns": step.time_ns} for step in witness.path],
        "atom": None,
        "threshold": None,
        "obstacle": witness.obstacle,
        "explanation": list(sentences_of(witness, first_ns=first_ns)),
    }
    if deciding is not None:
        value["atom"] = {
            "text": deciding.text,
            "relation": deciding.atom.relation,
            "objects": list(deciding.objects),
            "value": json_number(deciding.value),
            "lower": json_number(deciding.lower),
            "upper": json_number(deciding.upper),
            "measured": [_measured(each) for each in deciding.measured],
            "unknown": list(deciding.unknown),
        }
    if threshold is not None:
        value["threshold"] = {
            "value": threshold.value,
            "flips_at": threshold.flips_at,
            "written": threshold.is_written,
            "exact": threshold.is_exact,
            "verdict": str(threshold.verdict),
        }
    return value


def _measured(measured: Measured) -> dict[str, Any]:
    contact = measured.contact
    return {
        "quantity": measured.quantity,
        "names": list(measured.names),
        "value": json_number(measured.value),
        "spread": measured.spread,
        "points": None if contact is None else [list(contact.first), list(contact.second)],
    }


def _numbers(rows: Floats) -> list[list[float | str | None]]:
    """Return one list for each node."""
    return [[json_number(number) for number in row] for row in rows.tolist()]


@dataclass(frozen=True, slots=True)
class Explanation:
    """The reason for the verdict of one node.

    Attributes:
        time_ns: time of the sample that decides.
        sentences: the reason in words.
        document: the reason as JSON.
    """

    verdict: Verdict
    time_ns: int
    sentences: tuple[str, ...]
    document: Mapping[str, Any]


def explain_results(
    replayed: Replayed, *, node: str | None = None, object: str | None = None, goes_on: bool = False
) -> list[Explanation]:
    """Explain the verdicts of results, or of the nodes of a name in them.

    Args:
        replayed: a replay that kept series and leaves.
        object: explain only results about this object of a template.
        goes_on: whether the log has samples after those evaluated, which could change a verdict.

    Raises:
        UsageError: no such node or object, or nothing was evaluated.
    """
    results = [result for result in replayed.results if object in (None, result.object)]
    if not results:
        known = ", ".join(sorted({result.object for result in replayed.results if result.object})) or "none"
        if object is None:
            raise UsageError(f"there is no result; objects with a result of their own: {known}")
        raise UsageError(f"no result is about object {object!r}; objects with a result of their own: {known}")
    explanations = [
        explain_node(result, identifier, first_ns=replayed.first_ns, goes_on=goes_on)
        for result in results
        for identifier in _nodes_named(result, node)
    ]
    if not explanations:
        names = sorted(
            {each.name for result in results for _, _, each in iter_nodes(result.formula) if each.name}
        )
        raise UsageError(no_such_node(node or "", names))
    return explanations


def _nodes_named(result: SpecResult, name: str | None) -> Iterator[int]:
    if name is None or name == result.name:
        yield 0
        return
    for identifier, _, each in iter_nodes(result.formula):
        if each.name == name:
            yield identifier
            return


def explain_node(result: SpecResult, node: int = 0, *, first_ns: int, goes_on: bool = False) -> Explanation:
    """Explain the verdict of one node of a result; see `explain_results`."""
    if not result.has_series:
        raise ValueError("the replay did not keep series and leaves")
    witness = result.witness(node)
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
    """Return the first sample since which the verdict is that of the last one; None if that is unknown.

    Args:
        value, lower, upper: (T,), those of the node; the last ones settle its verdict.
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

"""Results of a replay as JSON, and explanations of verdicts as sentences and JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.invariants import ViolatedInvariant
from spatial_replay.monitor.result import RESULT_COLUMNS, NodeResult, SpecResult, no_such_node
from spatial_replay.monitor.sentences import Cause, sentences_of
from spatial_replay.monitor.vacuity import UntestedPart
from spatial_replay.monitor.verdict import Verdict, online_verdict
from spatial_replay.monitor.witness.path import DecidingAtom, Measured, MissedResponse
from spatial_replay.monitor.witness.threshold import Threshold
from spatial_replay.monitor.witness.witness import Witness
from spatial_replay.replay.engine import Replayed
from spatial_replay.spec.formula import iter_nodes
from spatial_replay.spec.walks import nodes_of, units_of, units_text
from spatial_replay.text import Sentence, counted_from, json_fields, json_number, names_of
from spatial_replay.trace.doubts import json_doubt


def document_from_replay(
    replayed: Replayed, *, signal: bool = False, window_ns: int | None = None
) -> Mapping[str, Any]:
    """Return the results as one JSON object.

    Infinite numbers are the strings "inf" and "-inf". Undetermined numbers are null.

    Args:
        signal: whether the series contain each node's robustness from each sample to the end of the log.
        window_ns: width of a sliding window, ns; the series contain each node's robustness over the window.

    Raises:
        UsageError: the semantics have no signal or no window.
    """
    return {
        "log": {
            "name": replayed.log,
            "zero_ns": replayed.first_ns,
            **json_fields(replayed, "samples", "start_ns", "end_ns", "faults", "remarks"),
            "damaged": bool(replayed.faults),
            "doubts": [json_doubt(doubt) for doubt in replayed.doubts],
            "missing": [name.message for name in replayed.missing],
            "left": [
                json_fields(departure, "name", "start_ns", "end_ns", "distance", "message")
                for departure in replayed.left
            ],
            "dropped_samples": replayed.dropped.count,
            "unreadable_observations": replayed.unreadable,
        },
        "semantics": replayed.semantics,
        "certificate": dict(replayed.certificate),
        "specifications": [
            _result(result, replayed.first_ns, signal, window_ns) for result in replayed.results
        ],
        "vacuous": [_untested_part(part, replayed.first_ns) for part in replayed.vacuous],
    }


def _result(result: SpecResult, first_ns: int, signal: bool, window_ns: int | None) -> dict[str, Any]:
    document: dict[str, Any] = {
        **json_fields(result, *RESULT_COLUMNS),
        "requirement": result.spec.id,
        "title": result.spec.title,
        # headline, arrow and event show this witness
        "worst": None if result.worst is None else witness_document(result.worst, first_ns),
        "causes": [_cause(cause, first_ns) for cause in result.causes],
        "violations": [_invariant(invariant) for invariant in result.violated_invariants],
        "tested": result.tested,
        "untested": [_untested_part(part, first_ns) for part in result.untested],
        "vacuous": [_untested_part(part, first_ns) for part in result.vacuous],
        "doubts": [doubt.assumption for doubt in result.doubts],
        "remarks": list(counted_from(result.remarks, first_ns)),
        "nodes": [
            {**json_fields(node, "id", "parent", "operator", "text"), **_of_node(node)}
            for node in result.nodes
        ],
    }
    if result.has_series:
        document["series"] = {
            "time_ns": result.times_ns.tolist(),
            **{
                quantity: _numbers(result.series[:, row])
                for row, quantity in enumerate(("value", "now", "lower", "upper"))
            },
        }
        if result.leaves is not None and signal:
            document["series"]["signal"] = _numbers(result.full_signal())
        if result.leaves is not None and window_ns is not None:
            document["series"]["window"] = _numbers(result.window_signal(window_ns))
    return document


def _of_node(node: NodeResult) -> dict[str, Any]:
    """Return the JSON fields that nodes and explanations of nodes share."""
    return {
        **json_fields(node, "name", "requirement", "title", "verdict", "robustness"),
        "lower": json_number(node.final_lower),
        "upper": json_number(node.final_upper),
    }


def _cause(cause: Cause, first_ns: int) -> dict[str, Any]:
    return {
        **json_fields(cause, "spec", "requirement", "title", "node", "verdict", "robustness", "settled_ns"),
        "witness": None if cause.witness is None else witness_document(cause.witness, first_ns),
    }


def _untested_part(part: UntestedPart, first_ns: int) -> dict[str, Any]:
    (message,) = counted_from([part.message], first_ns)
    return {**json_fields(part), "message": message}


def witness_document(witness: Witness, first_ns: int) -> dict[str, Any]:
    """Return the witness of a node's verdict as JSON. Times in its sentences are relative to `first_ns`."""
    deciding, threshold = witness.deciding, witness.threshold
    document: dict[str, Any] = {
        **json_fields(witness, "node", "verdict", "lower", "upper", "time_ns", "obstacle"),
        "name": witness.path[0].name,
        "path": [json_fields(path_step, "node", "time_ns") for path_step in witness.path],
        "atom": None,
        "threshold": None,
        "missed": None,
        "missing": [
            {
                "name": gap.name,
                "samples": gap.missing,
                "of": gap.samples,
                **json_fields(gap, "first_ns", "last_ns", "longest_ns"),
            }
            for gap in witness.gaps
        ],
        "explanation": list(sentences_of(witness, first_ns=first_ns)),
    }
    if witness.missed is not None:
        document["missed"] = _missed_response(witness, witness.missed)
    if deciding is not None:
        document["atom"] = _atom(deciding)
    if threshold is not None:
        document["threshold"] = _threshold(threshold)
    return document


def _missed_response(witness: Witness, missed: MissedResponse) -> dict[str, Any]:
    """Return a missed response as JSON. "closest" is null if the closest atom also decides the verdict."""
    closest_atom, closest_ns = witness.closest or (None, None)
    threshold = witness.closest_threshold
    return {
        **json_fields(missed, "condition", "response", "time_ns"),
        "closest": None if closest_atom is None else {"time_ns": closest_ns, "atom": _atom(closest_atom)},
        "threshold": None if threshold is None else _threshold(threshold),
    }


def _threshold(threshold: Threshold) -> dict[str, Any]:
    constants = {"constant": threshold.constant or None, "replacement": threshold.replacement or None}
    return {**json_fields(threshold), **constants}


def _atom(deciding: DecidingAtom) -> dict[str, Any]:
    return {
        **json_fields(deciding, "text", "objects", "value", "lower", "upper", "unknown"),
        "relation": deciding.atom.relation,
        "measured": [_measurement(measurement) for measurement in deciding.measured],
    }


def _invariant(invariant: ViolatedInvariant) -> dict[str, Any]:
    entries, violated = invariant.entries
    has_entries = invariant.condition is not None
    return {
        **json_fields(invariant, "spec", "node", "condition"),
        "entries": entries if has_entries else None,
        "violated_entries": violated if has_entries else None,
        "intervals": [
            {
                **json_fields(
                    interval, "start_ns", "end_ns", "samples", "worst_ns", "robustness", "deciding_ns"
                ),
                "place": None if interval.place is None else list(interval.place),
                "atom": None if interval.deciding is None else _atom(interval.deciding),
            }
            for interval in invariant.intervals
        ],
    }


def _measurement(measured: Measured) -> dict[str, Any]:
    contact = measured.contact
    return {
        **json_fields(measured, "quantity", "names", "value", "spread"),
        "points": None if contact is None else [list(contact.first), list(contact.second)],
    }


def _numbers(node_rows: Floats) -> list[list[float | str | None]]:
    """Return one list of JSON numbers for each row of an array, (N, T)."""
    return [[json_number(number) for number in row] for row in node_rows.tolist()]


def idle_document(template: UntestedPart) -> dict[str, Any]:
    """Explain a template without instances as JSON. The explanation has a reason, but no verdict."""
    return {
        "specification": template.text.partition("(")[0],
        "object": None,
        "node": None,
        "verdict": None,
        "tested": "nothing",
        "untested": [_untested_part(template, 0)],
        "vacuous": [_untested_part(template, 0)],
        "explanation": [template.message],
    }


@dataclass(frozen=True, slots=True)
class Explanation:
    """The reason for the verdict of one node.

    Attributes:
        time_ns: time of the deciding sample.
        sentences: the reason in words.
        document: the reason as JSON.
    """

    verdict: Verdict
    time_ns: int
    sentences: tuple[Sentence, ...]
    document: Mapping[str, Any]


def explain_results(
    replayed: Replayed, *, node: str | None = None, object: str | None = None, goes_on: bool = False
) -> list[Explanation]:
    """Explain the verdict of each result, or of each result's node with a given name.

    Args:
        replayed: a replay that kept series and leaves.
        object: name of an object; only results of templates for this object are explained.
        goes_on: whether the log has later samples, which could change a verdict.

    Returns:
        One explanation for each result. The list is empty if all specs are templates without objects.

    Raises:
        UsageError: no result has the node, or the object.
    """
    results = [result for result in replayed.results if object in (None, result.object)]
    if not results and node is None and object is None:
        return []
    if not results:
        objects_text = (
            ", ".join(sorted({result.object for result in replayed.results if result.object})) or "none"
        )
        if object is None:
            raise UsageError(f"there is no result; objects with a result of their own: {objects_text}")
        raise UsageError(
            f"no result is about object {object!r}; objects with a result of their own: {objects_text}"
        )
    explanations = [
        explain_node(result, node_id, first_ns=replayed.first_ns, goes_on=goes_on)
        for result in results
        for node_id in _find_nodes(result, node)
    ]
    if not explanations:
        node_names = {
            named_node.name for result in results for _, _, named_node in iter_nodes(result.formula)
        }
        node_names.update(result.spec.id for result in results)
        raise UsageError(no_such_node(node or "", sorted(name for name in node_names if name)))
    return explanations


def _find_nodes(result: SpecResult, name: str | None) -> Iterator[int]:
    spec_id = result.spec.id
    if name is None or name in (*names_of(result.name, spec_id), *names_of(result.title, spec_id)):
        yield 0
        return
    for node_id, _, node in iter_nodes(result.formula):
        named_spec = result.evidence.instance.named.get(node.name or "")
        if node.name and name in names_of(node.name, None if named_spec is None else named_spec.id):
            yield node_id
            return


def verdict_of(result: SpecResult, node: str | None, *, goes_on: bool) -> Verdict | None:
    """Return the verdict that `explain_results` explains for a result; None if the node is missing."""
    for node_id in _find_nodes(result, node):
        is_pending = _is_pending(result, node_id, goes_on=goes_on)
        return Verdict.PENDING if is_pending else result.nodes[node_id].verdict
    return None


def _is_pending(result: SpecResult, node: int, *, goes_on: bool) -> bool:
    """Return whether later samples can still decide the verdict of a node."""
    _, _, lower, upper = result.series[node]
    return goes_on and online_verdict(float(lower[-1]), float(upper[-1])) is Verdict.PENDING


def explain_node(result: SpecResult, node: int = 0, *, first_ns: int, goes_on: bool = False) -> Explanation:
    """Explain the verdict of one node of a result (see `explain_results`)."""
    if not result.has_series:
        raise ValueError("the replay did not keep series and leaves")
    node_result = result.nodes[node]
    is_pending = _is_pending(result, node, goes_on=goes_on)
    # a goal is no cause while later samples may reach it
    causes = [cause for cause in result.causes_of(node) if not goes_on or cause.settled_ns is not None]
    if is_pending:
        witness = result.witness(node)
        sentences = sentences_of(witness, first_ns=first_ns, is_open=True)
    else:
        worst_witness = result.worst_of(node, causes)
        witness = result.witness(node) if worst_witness is None else worst_witness
        sentences = result.sentences_about(node, causes, first_ns, goes_on=goes_on)
    is_result = node == 0 and not is_pending
    sentences += counted_from(result.remarks, first_ns) if is_result else ()
    if units_sentence := units_text(units_of(nodes_of(result.formula)[node])):
        sentences += (Sentence(units_sentence),)
    verdict = Verdict.PENDING if is_pending else node_result.verdict
    witness_fields = witness_document(witness, first_ns)
    document = {
        "specification": result.name,
        "object": result.object,
        "zero_ns": first_ns,
        "node": node,
        **_of_node(node_result),
        "verdict": str(verdict),
        "since_ns": None if is_pending else result.certain_ns(node),
        "may_change": is_pending,
        **{
            field: witness_fields[field]
            for field in ("time_ns", "atom", "threshold", "obstacle", "missed", "missing")
        },
        "worst": witness_fields,
        "causes": [] if is_pending else [_cause(cause, first_ns) for cause in causes],
        "violations": [
            _invariant(invariant)
            for invariant in (() if is_pending else result.violated_invariants_of(node, goes_on=goes_on))
        ],
        "tested": result.tested if is_result else None,
        "untested": [_untested_part(part, first_ns) for part in result.untested] if is_result else [],
        "vacuous": [_untested_part(part, first_ns) for part in result.vacuous] if is_result else [],
        "explanation": list(sentences),
    }
    return Explanation(verdict, witness.time_ns, sentences, document)

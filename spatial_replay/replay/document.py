"""What a replay found, as a value that JSON can hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spatial_replay.geometry.arrays import Floats
from spatial_replay.inspection.words import sentences_of
from spatial_replay.monitor.verdict import final_verdict
from spatial_replay.monitor.witness.atom import Measured
from spatial_replay.monitor.witness.witness import Witness
from spatial_replay.replay.found import Replayed, ReplayedSpec
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import iter_nodes, operator_of
from spatial_replay.wording import json_number


def document(replayed: Replayed, *, signal: bool = False, window_ns: int | None = None) -> Mapping[str, Any]:
    """One object; infinite numbers are the strings "inf" and "-inf", undetermined ones null.

    Args:
        signal: add to the series each node's robustness from each sample to the end.
        window_ns: add to the series each node's robustness over a window of that width that slides.

    Raises:
        UsageError: a signal or a window under semantics that do not have them.
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


def _result(result: ReplayedSpec, first_ns: int, signal: bool, window_ns: int | None) -> dict[str, Any]:
    lower, upper = result.final[0].tolist()
    value: dict[str, Any] = {
        "name": result.name,
        "object": result.object,
        "verdict": str(result.verdict),
        "robustness": json_number(float(result.robustness[0])),
        "lower": json_number(lower),
        "upper": json_number(upper),
        "first_satisfied_ns": result.first_satisfied_ns,
        "worst": None,
        "nodes": [
            {
                "id": identifier,
                "parent": parent,
                "operator": operator_of(node),
                "name": node.name,
                "text": format_formula(node),
                "verdict": str(final_verdict(*result.final[identifier].tolist())),
                "robustness": json_number(float(result.robustness[identifier])),
                "lower": json_number(float(result.final[identifier, 0])),
                "upper": json_number(float(result.final[identifier, 1])),
            }
            for identifier, parent, node in iter_nodes(result.formula)
        ],
    }
    if result.inquiry is not None and result.inquiry.semantics == "ltlf":
        value["worst"] = witness_document(result.inquiry.witness(), first_ns)
    if result.series is not None and result.times_ns is not None:
        value["series"] = {
            "time_ns": result.times_ns.tolist(),
            **{
                key: _numbers(result.series[:, k]) for k, key in enumerate(("value", "now", "lower", "upper"))
            },
        }
        if result.inquiry is not None and signal:
            value["series"]["signal"] = _numbers(result.inquiry.full_signal())
        if result.inquiry is not None and window_ns is not None:
            value["series"]["window"] = _numbers(result.inquiry.window_signal(window_ns))
    return value


def witness_document(witness: Witness, first_ns: int) -> dict[str, Any]:
    """What decides a node's verdict, and the same in sentences that count time from `first_ns`."""
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
    """One list for each node."""
    return [[json_number(number) for number in row] for row in rows.tolist()]

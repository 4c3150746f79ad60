"""What a replay found, as a value that JSON can hold."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.verdict import final_verdict
from spatial_replay.replay.replay import Replayed, ReplayedSpec
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import iter_nodes, operator_of


def document(replayed: Replayed) -> Mapping[str, Any]:
    """One object; infinite numbers are the strings "inf" and "-inf", undetermined ones null."""
    return {
        "log": {
            "name": replayed.log,
            "samples": replayed.samples,
            "start_ns": replayed.start_ns,
            "end_ns": replayed.end_ns,
            "damaged": bool(replayed.faults),
            "faults": list(replayed.faults),
            "unreadable_observations": replayed.unreadable,
        },
        "semantics": replayed.semantics,
        "certificate": dict(replayed.certificate),
        "specifications": [_result(result) for result in replayed.results],
    }


def _result(result: ReplayedSpec) -> dict[str, Any]:
    lower, upper = result.final[0].tolist()
    value: dict[str, Any] = {
        "name": result.name,
        "object": result.object,
        "verdict": str(result.verdict),
        "robustness": _number(float(result.robustness[0])),
        "lower": _number(lower),
        "upper": _number(upper),
        "first_satisfied_ns": result.first_satisfied_ns,
        "nodes": [
            {
                "id": identifier,
                "parent": parent,
                "operator": operator_of(node),
                "name": node.name,
                "text": format_formula(node),
                "verdict": str(final_verdict(*result.final[identifier].tolist())),
                "robustness": _number(float(result.robustness[identifier])),
                "lower": _number(float(result.final[identifier, 0])),
                "upper": _number(float(result.final[identifier, 1])),
            }
            for identifier, parent, node in iter_nodes(result.formula)
        ],
    }
    if result.series is not None and result.times_ns is not None:
        value["series"] = {
            "time_ns": result.times_ns.tolist(),
            **{
                key: _numbers(result.series[:, k]) for k, key in enumerate(("value", "now", "lower", "upper"))
            },
        }
    return value


def _number(number: float) -> float | str | None:
    if math.isnan(number):
        return None
    if math.isinf(number):
        return "inf" if number > 0 else "-inf"
    return number


def _numbers(rows: Floats) -> list[list[float | str | None]]:
    """One list for each node."""
    return [[_number(number) for number in row] for row in rows.tolist()]

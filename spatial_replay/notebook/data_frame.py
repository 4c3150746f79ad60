"""Results as DataFrames; the only importer of pandas, which loads when one is asked for."""

from __future__ import annotations

from functools import singledispatch
from typing import Any, Final

import numpy as np

from spatial_replay.errors import UsageError, importing
from spatial_replay.monitor.evaluate import Evaluation
from spatial_replay.monitor.result import SpecResult

_TIMES: Final = ("first_satisfied_ns", "violated_at_ns", "satisfied_at_ns")
_COLUMNS: Final = ("name", "object", "verdict", "robustness", "lower", "upper", *_TIMES)


@singledispatch
def data_frame(value: Any) -> Any:
    """Return a value as a DataFrame.

    Raises:
        UsageError: pandas is not installed, or what it would hold was not kept.
    """
    raise UsageError(f"there is no DataFrame of a {type(value).__name__}")


@data_frame.register
def _of_evaluation(evaluation: Evaluation) -> Any:
    """Return a row for each result."""
    pandas = _pandas()
    rows = [[getattr(each, name) for name in _COLUMNS] for each in evaluation.results]
    frame = pandas.DataFrame(rows, columns=list(_COLUMNS))
    # times are whole numbers, or missing
    return frame.astype({"verdict": str} | dict.fromkeys(_TIMES, "Int64"))


@data_frame.register
def _of_result(result: SpecResult) -> Any:
    """Return a row for each sample, and four columns for each node."""
    pandas = _pandas()
    if not result.has_series:
        raise UsageError(
            f"the numbers of each sample of {result.title!r} were not kept; evaluate() keeps them"
        )
    columns = {"seconds": (result.times_ns - result.times_ns[:1]) / 1e9}
    names = [node.name or f"{node.id}: {node.text}" for node in result.nodes]
    for name, node in zip(names, result.nodes, strict=True):
        title = name if names.count(name) == 1 else f"{node.id}: {name}"
        for quantity in ("value", "now", "lower", "upper"):
            columns[f"{title} {quantity}"] = np.array(getattr(node, quantity))
    return pandas.DataFrame(columns, index=pandas.Index(np.array(result.times_ns), name="time_ns"))


def _pandas() -> Any:
    with importing("a DataFrame needs pandas", extra="notebook"):
        import pandas
    return pandas

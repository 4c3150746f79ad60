"""Failures of episodes: the first one that happened in each, of the specs of a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Failure:
    """A failure of an episode.

    Attributes:
        name: the title of the spec that it satisfies or, without one, its name.
        at: seconds from the begin of the episode; None if only its end decides.
    """

    name: str
    at: float | None


def first_failures(table: pa.Table, file: str) -> dict[str, Failure]:
    """Return the first failure in each log, by the log's name, from the results of a batch.

    Failures that only the end of the log decides come last. At equal times, the first in the file counts.
    """
    import pyarrow.compute as pc

    is_failure = pc.and_(pc.equal(table["file"], file), pc.equal(table["verdict"], "satisfied"))
    columns = ["log", "spec", "title", "satisfied_at_ns", "zero_ns", "line"]
    rows = table.filter(is_failure).select(columns).to_pylist()
    rows.sort(key=lambda row: (row["satisfied_at_ns"] is None, row["satisfied_at_ns"] or 0, row["line"]))
    failures: dict[str, Failure] = {}
    for row in rows:
        time_ns = row["satisfied_at_ns"]
        at = None if time_ns is None else (time_ns - row["zero_ns"]) / 1e9
        failures.setdefault(row["log"], Failure(row["title"] or row["spec"], at))
    return failures

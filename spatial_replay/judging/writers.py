"""Judgements as pages and tables."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from spatial_replay.batch.outputs import AGREEMENT, LABEL
from spatial_replay.batch.run import BatchResult
from spatial_replay.judging.judgement import JudgedEpisode, Judgement

_DIFFERENCES: Final = {
    "only_theirs": "only the label counts a success",
    "only_ours": "only the verdict counts a success",
}
_WORDS: Final = {True: "success", False: "failure", None: None}


def labelled_batch(judgement: Judgement) -> BatchResult:
    """Return the batch of a judgement with its labels, of which disagreements are the failures."""
    import pyarrow as pa

    table = judgement.batch.table
    paths = {request.log.name: request.log.path for request in judgement.batch.wanted}
    episodes = {row.log: row for row in judgement.rows}
    rows = [episodes[paths[log]] for log in table["log"].to_pylist()]
    table = table.append_column(LABEL, pa.array([_WORDS[row.label] for row in rows], pa.string()))
    table = table.append_column(AGREEMENT, pa.array([row.kind for row in rows], pa.string()))
    if judgement.label_rate.episodes:
        results = zip(*(table[name].to_pylist() for name in ("file", "spec", "failure")), strict=True)
        failures = [
            _failure(row, failure) if spec in (judgement.result, "") and file == judgement.file else None
            for row, (file, spec, failure) in zip(rows, results, strict=True)
        ]
        place = table.schema.get_field_index("failure")
        table = table.set_column(place, table.schema.field(place), pa.array(failures, pa.string()))
    return replace(judgement.batch, table=table)


def _failure(row: JudgedEpisode, failure: str | None) -> str | None:
    return failure if row.kind == "undecided" else _DIFFERENCES.get(row.kind)

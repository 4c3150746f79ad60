"""Comparison of two judgements by pairs of episodes with the same start."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from math import dist
from typing import Final, TypeAlias

from spatial_replay.batch.rows import Task, opened_task
from spatial_replay.batch.run import BatchResult
from spatial_replay.batch.suite import Conditions
from spatial_replay.errors import SpatialReplayError
from spatial_replay.geometry.footprint import centres_of
from spatial_replay.judging.judgement import Comparison, JudgedEpisode, Judgement, PreparedJudgement
from spatial_replay.judging.statistics import (
    EVIDENCE,
)
from spatial_replay.text import plural

SAME_START: Final = 0.001
"""Largest distance at which two first places count as equal, in units of length."""
_Place: TypeAlias = tuple[float, float, float]


def judge_batch(
    prepared: Sequence[PreparedJudgement],
    batch: BatchResult,
    allow: AbstractSet[str] = frozenset(),
    same_start: float | None = None,
) -> Judgement:
    """Return the judgement of new episodes, and compare them with earlier episodes if there are any.

    Args:
        prepared: the new episodes, and optionally the earlier episodes.
        batch: results of all these episodes.
        allow: see `PreparedJudgement.judgement`.
        same_start: see `compare_judgements`; by default 0.001.
    """
    judgement, *earlier = (preparation.judgement(batch, allow) for preparation in prepared)
    if not earlier:
        return judgement
    distance = SAME_START if same_start is None else same_start
    conditions = prepared[0].case.case.conditions
    return replace(judgement, comparison=compare_judgements(judgement, earlier[0], conditions, distance))


def compare_judgements(
    new: Judgement, old: Judgement, conditions: Conditions, same_start: float = SAME_START
) -> Comparison:
    """Pair episodes by seed, or by name or number, and by the first places of their objects.

    Args:
        conditions: options of reading the logs.
        same_start: largest distance between an object's two first places, in units of length.
    """
    has_seeds = all(row.seed is not None for row in (*new.rows, *old.rows))
    old_rows = dict(_rows_by_key(old.rows, has_seeds))
    pairs, counts = [], Counter[str]()
    for key, row in _rows_by_key(new.rows, has_seeds):
        partner = old_rows.pop(key, None)
        if partner is None:
            counts["alone"] += 1
        elif None in (row.stored_success, partner.stored_success):
            counts["undecided"] += 1
        elif not _start_alike(row, partner, conditions, same_start):
            counts["elsewhere"] += 1
        else:
            pairs.append((row, partner))
    counts["alone"] += len(old_rows)
    other_counts = counts["elsewhere"], counts["undecided"], counts["alone"]
    return Comparison(new.name, old, tuple(pairs), *other_counts)


def _rows_by_key(
    rows: Sequence[JudgedEpisode], has_seeds: bool
) -> Iterator[tuple[tuple[object, ...], JudgedEpisode]]:
    """Yield each row with its key. Equal keys are numbered: the nth rows of both sides are a pair."""
    key_counts = Counter[tuple[object, ...]]()
    for row in rows:
        key = (row.task, row.seed) if has_seeds else (row.episode.rpartition("#")[2],)
        key_counts[key] += 1
        yield (*key, key_counts[key]), row


def _start_alike(new: JudgedEpisode, old: JudgedEpisode, conditions: Conditions, same_start: float) -> bool:
    new_places, old_places = _first_places(new.log, conditions), _first_places(old.log, conditions)
    if not new_places or new_places.keys() != old_places.keys():
        return False
    return all(dist(place, old_places[name]) <= same_start for name, place in new_places.items())


def _first_places(log: str, conditions: Conditions) -> Mapping[str, _Place]:
    """Return the centre of each object in the first sample of a log. An unreadable log has no objects."""
    try:
        source, options = opened_task(Task(log, (), conditions), ())
        window = options.window
        traces = (block.trace for block in source.iter_blocks(window.start_ns or None, window.end_ns))
        trace = next((trace for trace in traces if len(trace)), None)
    except SpatialReplayError:
        return {}
    if trace is None:
        return {}
    centres = centres_of(trace.footprints)
    rows_by_name = {
        name: row for name, row in zip(trace.names, trace.rows[0].tolist(), strict=True) if row >= 0
    }
    places = {}
    for name, row in rows_by_name.items():
        bottom, top = trace.footprints.height(row) or (0.0, 0.0)
        x, y = centres.vertices[row].tolist()
        places[name] = (x, y, (bottom + top) / 2.0)
    return places


def comparison_lines(comparison: Comparison) -> Iterator[str]:
    """Yield lines with the number of pairs, the better side and the significance."""
    pair_count, won, lost = len(comparison.pairs), comparison.won, comparison.lost
    count_texts = [f"{plural(pair_count, 'pair')} with the same start"]
    count_texts += [f"{comparison.elsewhere:,} with another start"] if comparison.elsewhere else []
    count_texts += [f"{comparison.undecided:,} undecided"] if comparison.undecided else []
    count_texts += [f"{plural(comparison.alone, 'episode')} without a partner"] if comparison.alone else []
    yield f"against {comparison.old.name}: {', '.join(count_texts)}"
    if not pair_count:
        return
    if not won and not lost:
        yield "undecided: both episodes of each pair succeed, or both fail"
        return
    more_pairs = comparison.more_pairs
    if comparison.decision == "undecided":
        estimate = "" if more_pairs is None else f"; about {more_pairs:,} more pairs would decide"
        yield f"undecided: {won:,} won, {lost:,} lost of {pair_count:,}, p = {comparison.p:.2g}{estimate}"
    else:
        counts_text = f"{won:,} won, {lost:,} lost of {pair_count:,} pairs"
        yield f"{comparison.new} is {comparison.decision}: {counts_text}, p = {comparison.p:.2g}"
    yield f"evidence {comparison.evidence:.2g} of the {EVIDENCE:.0f} needed"
    if comparison.margins is not None:
        yield f"margins: p = {comparison.margins.p:.2g} by Wilcoxon's signed ranks"

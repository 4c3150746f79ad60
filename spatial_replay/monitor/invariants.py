"""Violated intervals of an invariant (`G p`), each with its worst sample."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.measure import Point
from spatial_replay.monitor.offline import (
    OfflineNodes,
    evaluate_offline,
    evaluate_prefix,
    windows_of,
)
from spatial_replay.monitor.sentences import Conjunct, measurement_clause
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.path import (
    DecidingAtom,
    End,
    deciding_path,
    missed_response,
    short_title,
)
from spatial_replay.monitor.witness.witness import atom_of_path, find_missed_response
from spatial_replay.spec.formula import Temporal, operands_of, operator_of
from spatial_replay.text import Instant, Sentence, number_text, plural

LISTED: Final = 5
"""Number of intervals that an explanation lists."""
MOST_EXPLAINED: Final = 256
"""Limit on an invariant's intervals with a deciding atom, because each atom needs a sample to be read."""


@dataclass(frozen=True, slots=True)
class ViolatedInterval:
    """Consecutive samples at which the operand of a `G` is violated.

    Attributes:
        start_ns, end_ns: times of the first and the last sample.
        samples: number of samples.
        worst_ns: time of the first sample with the least robustness.
        robustness: robustness of the operand at `worst_ns`.
        deciding: deciding atom at `worst_ns`. For a missed response, it is the atom that came closest to
            fulfilling the response. It is None after `MOST_EXPLAINED` intervals, and if no atom decides.
        deciding_ns: time of the sample in which the deciding atom was measured.
        place: contact point of the deciding atom, else of the condition's atom, else None.
    """

    start_ns: int
    end_ns: int
    samples: int
    worst_ns: int
    robustness: float
    deciding: DecidingAtom | None = None
    deciding_ns: int | None = None
    place: Point | None = None


@dataclass(frozen=True, slots=True)
class ViolatedInvariant:
    """A violated part `G p` of a result.

    Attributes:
        spec: innermost named spec that contains the part.
        node: node id of the part.
        intervals: violated intervals of `p`, by time.
        condition: text of the condition in `G (condition -> response)`; else None.
        entries: number of intervals in which the condition held, and number of such intervals with a missed
            response.
    """

    spec: str
    node: int
    intervals: tuple[ViolatedInterval, ...]
    condition: str | None = None
    entries: tuple[int, int] = (0, 0)


class _Runs(NamedTuple):
    """K runs of consecutive samples: first samples (K,), and last samples plus one (K,)."""

    starts: Integers
    ends: Integers

    @classmethod
    def of(cls, is_in_run: NDArray[np.bool_]) -> _Runs:
        boundaries = np.flatnonzero(np.diff(is_in_run, prepend=False, append=False))
        return cls(boundaries[::2], boundaries[1::2])


def find_violated_invariants(
    evidence: Evidence,
    leaves: Floats,
    times_ns: Integers,
    conjuncts: Sequence[Conjunct],
    *,
    goes_on: bool = False,
    most: int = MOST_EXPLAINED,
) -> Iterator[ViolatedInvariant]:
    """Yield the violated conjuncts `G p` and `not F p`, in order.

    Args:
        leaves: (C, A, T), the instance's leaves.
        times_ns: (T,), T at least 1.
        goes_on: whether samples may follow; then only permanent violations are yielded.
        most: limit on intervals per invariant with a deciding atom, which are the first intervals.
    """
    invariants = [invariant for conjunct in conjuncts if (invariant := _Invariant.of(conjunct)) is not None]
    if not invariants:
        return
    evaluate = evaluate_prefix if goes_on else evaluate_offline
    nodes = evaluate(evidence.instance.formula, evidence.instance.program.leaves, leaves, times_ns)
    for invariant in invariants:
        violated_invariant = _intervals_of(evidence, nodes, invariant, most)
        if violated_invariant.intervals:
            yield violated_invariant


class _Invariant(NamedTuple):
    """An operator that requires its operand at all samples of its window.

    Attributes:
        operator: `G`, or a negated `F`.
        operand: node id of the operand.
        condition: node id of the condition if the operand is an implication; else None.
    """

    conjunct: Conjunct
    operator: Temporal
    operand: int
    condition: int | None

    @property
    def end(self) -> End:
        """The low or high end of the operand's robustness interval, whichever decides a violation."""
        return End.HIGH if self.operator.operator == "G" else End.LOW

    @classmethod
    def of(cls, conjunct: Conjunct) -> _Invariant | None:
        formula, node, sign = conjunct.formula, conjunct.node, 1
        while operator_of(formula) in ("not", "spec"):
            sign = -sign if operator_of(formula) == "not" else sign
            (formula,), node = operands_of(formula), node + 1
        if not isinstance(formula, Temporal) or formula.operator != ("G" if sign > 0 else "F"):
            return None
        (body,), body_node = operands_of(formula), node + 1
        while operator_of(body) == "spec":
            (body,), body_node = operands_of(body), body_node + 1
        # ids are in the order of the text: the first operand follows its node
        condition_node = body_node + 1 if sign > 0 and operator_of(body) == "->" else None
        return cls(conjunct, formula, node + 1, condition_node)


def _intervals_of(
    evidence: Evidence, nodes: OfflineNodes, invariant: _Invariant, most_explained: int
) -> ViolatedInvariant:
    window_starts, window_ends = windows_of(invariant.operator, nodes.times_ns, np.array([0]))
    is_in_window = np.zeros(len(nodes.times_ns), np.bool_)
    is_in_window[window_starts[0] : window_ends[0]] = True
    low_ends, high_ends = nodes.judged_ends(invariant.operand)
    # `not F p` is `G not p`, so the robustness of p is negated
    operand_robustness = high_ends if invariant.end is End.HIGH else -low_ends
    violated_runs = _Runs.of(is_in_window & (operand_robustness < 0.0))
    intervals, worst_samples = [], []
    for start, end in zip(violated_runs.starts.tolist(), violated_runs.ends.tolist(), strict=True):
        worst_samples.append(start + int(np.argmin(operand_robustness[start:end])))
        first_ns, last_ns, worst_ns = nodes.times_ns[[start, end - 1, worst_samples[-1]]].tolist()
        least_robustness = float(operand_robustness[worst_samples[-1]])
        intervals.append(ViolatedInterval(first_ns, last_ns, end - start, worst_ns, least_robustness))
    intervals[:most_explained] = _with_atoms(
        evidence, nodes, invariant, intervals[:most_explained], worst_samples[:most_explained]
    )
    conjunct = invariant.conjunct
    if invariant.condition is None:
        return ViolatedInvariant(conjunct.spec, conjunct.node, tuple(intervals))
    condition_runs = _Runs.of(is_in_window & (nodes.ends(invariant.condition)[0] >= 0.0))
    # the number of condition intervals that begin up to a violation identifies the violation's own interval
    missed_entries = np.unique(np.searchsorted(condition_runs.starts, violated_runs.starts, side="right"))
    condition_text = short_title(evidence.bound(nodes.tree[invariant.condition][0]))
    entry_counts = len(condition_runs.starts), len(missed_entries)
    return ViolatedInvariant(conjunct.spec, conjunct.node, tuple(intervals), condition_text, entry_counts)


def _with_atoms(
    evidence: Evidence,
    nodes: OfflineNodes,
    invariant: _Invariant,
    intervals: Sequence[ViolatedInterval],
    worst_samples: Sequence[int],
) -> Iterator[ViolatedInterval]:
    """Yield the intervals, each with the atom that decides its worst sample."""
    bindings, condition = evidence.instance.bindings, invariant.condition
    paths = [
        deciding_path(nodes, invariant.operand, invariant.end, sample=sample) for sample in worst_samples
    ]
    response_paths = [missed_response(path, nodes, bindings)[1] for path in paths]
    condition_paths = [
        path if condition is None else deciding_path(nodes, condition, End.LOW, sample=sample)
        for path, sample in zip(paths, worst_samples, strict=True)
    ]
    deciding_samples = [
        path.steps[-1].sample for path in (*paths, *response_paths, *condition_paths) if path is not None
    ]
    # one pass over the log for all samples
    scene_at = evidence.scenes(set(nodes.times_ns[deciding_samples].tolist())).__getitem__
    for interval, path, condition_path in zip(intervals, paths, condition_paths, strict=True):
        deciding_atom = atom_of_path(evidence, nodes, path, scene_at)
        deciding_ns = int(nodes.times_ns[path.steps[-1].sample])
        closest_atom = find_missed_response(evidence, nodes, path, scene_at).closest
        if closest_atom is not None:
            deciding_atom, deciding_ns = closest_atom
        if deciding_atom is None:
            yield interval
            continue
        place = _place_of(deciding_atom) or _place_of(atom_of_path(evidence, nodes, condition_path, scene_at))
        yield replace(interval, deciding=deciding_atom, deciding_ns=deciding_ns, place=place)


def _place_of(deciding: DecidingAtom | None) -> Point | None:
    measurements = () if deciding is None else deciding.measured
    return next(
        (measurement.contact.first for measurement in measurements if measurement.contact is not None), None
    )


def invariant_sentences(
    invariant: ViolatedInvariant, first_ns: int, units: Mapping[str, str]
) -> Iterator[Sentence]:
    """Yield a sentence on the number of violated intervals, and a sentence on each of the first `LISTED`.

    Args:
        first_ns: reference time of the sentences.
        units: declared units of the log.
    """
    intervals = invariant.intervals
    entry_count, missed_count = invariant.entries
    if len(intervals) == 1 and entry_count < 2:
        (interval,) = intervals
        if interval.samples > 1:
            yield Sentence("It is violated ", *_span(interval, first_ns), ".")
        return
    count_text = plural(len(intervals), "interval")
    if invariant.condition is not None:
        entries_text = f"{missed_count:,} of {entry_count:,} entries of `{invariant.condition}`"
        count_text = entries_text if missed_count == len(intervals) else f"{count_text}, in {entries_text}"
    list_note = f"; the first {LISTED} are" if len(intervals) > LISTED else ""
    yield Sentence(f"It is violated in {count_text}{list_note}:")
    for interval in intervals[:LISTED]:
        yield _interval_sentence(interval, first_ns, units)


def _span(interval: ViolatedInterval, first_ns: int) -> tuple[str | Instant, ...]:
    start, end = Instant(interval.start_ns, first_ns), Instant(interval.end_ns, first_ns)
    return ("at ", start) if interval.samples == 1 else ("from ", start, " to ", end)


def _interval_sentence(interval: ViolatedInterval, first_ns: int, units: Mapping[str, str]) -> Sentence:
    (first_word, *span_parts), deciding_atom = _span(interval, first_ns), interval.deciding
    sentence_parts: list[str | Instant] = [str(first_word).capitalize(), *span_parts]
    if interval.samples > 1:
        sentence_parts += [", worst at ", Instant(interval.worst_ns, first_ns)]
    if interval.place is not None:
        sentence_parts.append(f", near ({', '.join(map(number_text, interval.place))})")
    if deciding_atom is not None:
        clause = " and ".join(deciding_atom.unknown) or measurement_clause(deciding_atom, units, first_ns)
        sentence_parts += [": ", clause]
        if interval.deciding_ns not in (None, interval.worst_ns):
            sentence_parts += [" at ", Instant(interval.deciding_ns, first_ns)]
    return Sentence(*sentence_parts, ".")

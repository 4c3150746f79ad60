"""What a replay found: numbers, verdicts, and what can still be asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.inspection.specification import ReportedTree
from spatial_replay.monitor.inquiry import Inquiry
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.monitor.stream import InstanceEvaluation, Stretch
from spatial_replay.monitor.verdict import Verdict, final_verdict, worst_verdict
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.spec.formula import Formula


@dataclass(frozen=True, eq=False)
class ReplayedSpec:
    """What a replay found for one spec, or one object's instance of a template.

    Attributes:
        name: the spec's name; with its file's stem before it where two files have a spec of that name.
        object: the object that a template's parameter stands for, or None.
        robustness: (N,), each node's value on the whole log.
        final: (N, 2), lower and upper end of each node for the finished log.
        first_satisfied_ns: the first sample with a value of at least 0, or None.
        times_ns, series: every sample's numbers, (T,) and (N, 4, T), if they were asked for.
        inquiry: answers what the numbers leave open, if that was asked for.
    """

    name: str
    object: str | None
    formula: Formula
    robustness: Floats
    final: Floats
    first_satisfied_ns: int | None
    times_ns: Integers | None = None
    series: Floats | None = None
    inquiry: Inquiry | None = None

    @property
    def verdict(self) -> Verdict:
        return final_verdict(*self.final[0].tolist())


@dataclass(frozen=True, eq=False)
class Replayed:
    """What a replay found.

    Attributes:
        log: base name of the log.
        samples: how many samples were evaluated.
        first_ns: time of the log's first sample, evaluated or not.
        start_ns, end_ns: times of the first and the last of those evaluated.
        faults: what was lost while reading, each with its place.
        remarks: what else the source says of its samples, where nothing was lost.
        unreadable: how many observations are there and say nothing: a number is not finite, or too old.
        results: one per spec and object.
        certificate: hashes of what went in and came out.
        semantics: what the formulas meant.
    """

    log: str
    samples: int
    first_ns: int
    start_ns: int
    end_ns: int
    faults: tuple[str, ...]
    remarks: tuple[str, ...]
    unreadable: int
    results: tuple[ReplayedSpec, ...]
    certificate: Mapping[str, str]
    semantics: Semantics = "ltlf"

    @property
    def verdict(self) -> Verdict:
        return worst_verdict(result.verdict for result in self.results)


def replayed_spec(
    tree: ReportedTree,
    stream: InstanceEvaluation,
    evidence: Evidence,
    kept: Stretch | None,
    semantics: Semantics,
    *,
    has_series: bool,
    has_leaves: bool,
) -> ReplayedSpec:
    """What was found for a result, once its stream has taken in all samples.

    Args:
        kept: what was kept of every sample, if anything.
        has_series, has_leaves: whether its numbers, and its atoms, are among that.
    """
    inquiry = None
    if has_leaves and kept is not None:
        inquiry = Inquiry(evidence, kept.times_ns, kept.leaves, semantics)
    return ReplayedSpec(
        tree.name,
        tree.object,
        tree.formula,
        stream.robustness,
        stream.final,
        stream.first_satisfied_ns,
        None if kept is None else kept.times_ns,
        kept.series if kept is not None and has_series else None,
        inquiry,
    )

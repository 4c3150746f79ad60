"""Witnesses of verdicts: the deciding atom at one sample, and the change that flips the verdict."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.offline import (
    OfflineNodes,
    evaluate_offline,
    evaluate_prefix,
    windows_of,
)
from spatial_replay.monitor.online.codes import joined_channels
from spatial_replay.monitor.stream import Instance
from spatial_replay.monitor.verdict import Verdict, final_verdict, online_verdict
from spatial_replay.monitor.witness.evidence import Evidence, Gap
from spatial_replay.monitor.witness.path import (
    DecidingAtom,
    DecidingPath,
    End,
    MissedResponse,
    PathNode,
    deciding_atom,
    deciding_path,
    failed_implication,
    missed_response,
    short_title,
)
from spatial_replay.monitor.witness.threshold import Obstacle, Threshold, threshold_of
from spatial_replay.spec.format import format_formula, title_of
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    BooleanOperator,
    Formula,
    Quantified,
    Temporal,
    TrackedName,
    Variable,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import (
    base_of,
    declared_unit,
    iter_terms,
    leaves_out,
    nodes_of,
    presence_of,
    with_operands,
)


@dataclass(frozen=True, slots=True)
class WitnessStep:
    """A node on the deciding path, at its deciding sample.

    Attributes:
        node: node id.
        operator: "and", "F", a relation's name, …
        name: name of the spec whose root is the node, or None.
        text: canonical text of the node.
        time_ns: time of the sample.
        leaves_out: whether the operator leaves out samples, or members, because a rate has no value.
    """

    node: int
    operator: str
    name: str | None
    text: str
    time_ns: int
    leaves_out: bool = False


@dataclass(frozen=True, slots=True)
class WhilePresent:
    """The verdict of an unknown formula after it is restricted to samples with its objects.

    Attributes:
        names: names of the objects.
        text: text of the restricted formula.
    """

    names: tuple[str, ...]
    text: str
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class Witness:
    """The atom that decides a node's verdict over a finished log, or settled it before the end of the log.

    Robustness consists of minima and maxima, so one atom at one sample determines it. The atom determines the
    upper end of a violated formula, the lower end of a satisfied formula, and the open ends of an unknown
    formula.

    Attributes:
        name: name of the spec.
        object: object of a template's instance; else None.
        verdict, lower, upper: verdict of the node, and ends of its interval.
        path: path from the node to the deciding leaf, at least one step.
        deciding: deciding atom. None if the path ends at `true` or `false`, at a window or a next sample
            beyond the log, or at a quantifier over an empty group.
        threshold: change of the atom's number that flips the verdict, or None.
        obstacle: reason why a deciding atom has no threshold; else None.
        open_end: atom that leaves the non-deciding end of a known verdict's interval open, and the time of
            its sample; else None.
        settled_ns: time of the sample that made the verdict certain. The interval then belongs to that
            sample. None for a witness over the whole log.
        missed: outermost failed implication on the path, or None.
        gaps: missing samples of the objects and signals in an unknown atom.
        closest: atom that came closest to fulfilling a missed response, and the time of its sample. None
            without a missed response, and if the condition does not decide.
        closest_path: path from the response to the atom in `closest`.
        units: declared units of signals by name; the unit of lengths under "".
        unit: declared unit of `lower` and `upper`, or "".
        while_present: verdict of the formula restricted by `present`, if `verdict` is unknown only because
            samples lack objects; else None.
        closest_threshold: change of the number of `closest` that flips the verdict, or None.
    """

    name: str
    object: str | None
    verdict: Verdict
    lower: float
    upper: float
    path: tuple[WitnessStep, ...]
    deciding: DecidingAtom | None
    threshold: Threshold | None
    obstacle: Obstacle | None
    open_end: tuple[DecidingAtom, int] | None
    settled_ns: int | None = None
    missed: MissedResponse | None = None
    gaps: tuple[Gap, ...] = ()
    closest: tuple[DecidingAtom, int] | None = None
    closest_path: tuple[WitnessStep, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict, repr=False, hash=False)
    unit: str = ""
    while_present: WhilePresent | None = None
    closest_threshold: Threshold | None = None

    @property
    def node(self) -> int:
        """Id of the node whose verdict is explained."""
        return self.path[0].node

    @property
    def is_settled(self) -> bool:
        """Whether a sample made the verdict certain before the log ended."""
        return self.settled_ns is not None

    @property
    def time_ns(self) -> int:
        """The time of the deciding sample."""
        return self.path[-1].time_ns


def find_witness(
    evidence: Evidence,
    leaves: Floats,
    times_ns: Integers,
    node: int = 0,
    *,
    goes_on: bool = False,
    whole: tuple[Floats, Integers] | None = None,
    flips: bool = True,
) -> Witness:
    """Return the witness of a node.

    Ties go to the earliest sample, then to the first operand.

    Args:
        evidence: evidence of the instance.
        leaves: (C, A, T), leaves of the instance.
        times_ns: (T,), T at least 1.
        node: id of the node.
        goes_on: whether samples may follow. The verdict then holds over every continuation.
        whole: leaves and times of the whole log, over which a threshold has to flip the verdict. None for
            `leaves` and `times_ns`.
        flips: whether to search for the number that flips the verdict.
    """
    instance = evidence.instance
    evaluate, verdict_of = (evaluate_prefix, online_verdict) if goes_on else (evaluate_offline, final_verdict)
    nodes = evaluate(instance.formula, instance.program.leaves, leaves, times_ns)
    lower, upper = nodes.interval(node)
    verdict = verdict_of(lower, upper)
    end = End.of(verdict)
    path = deciding_path(nodes, node, end)
    steps, decisive_atom = _steps(evidence, nodes, path), atom_of_path(evidence, nodes, path, evidence.scene)
    at_ns = steps[-1].time_ns
    gaps: tuple[Gap, ...] = ()
    if decisive_atom is not None and decisive_atom.unknown:
        gaps = evidence.gaps(decisive_atom.atom, at_ns)
        # all objects and signals are missing in a pause, so the pause is the reason
        if any(gap.name is None and gap.longest_ns[0] <= at_ns < gap.longest_ns[1] for gap in gaps):
            decisive_atom = replace(decisive_atom, unknown=("the samples pause there",))
    while_present = None
    if verdict is Verdict.UNKNOWN and decisive_atom is not None and decisive_atom.unknown and not goes_on:
        while_present = _while_present(evidence, leaves, times_ns, node, path)

    def flip(atom: DecidingAtom) -> Threshold | Obstacle | None:
        # no samples follow a whole log
        leaves_and_times, may_continue = (
            (whole, False) if whole is not None else ((leaves, times_ns), goes_on)
        )
        return threshold_of(evidence, *leaves_and_times, node, verdict, atom, goes_on=may_continue)

    threshold = flip(decisive_atom) if decisive_atom is not None and flips else None
    has_open_end = end is not End.OPEN and lower < upper and not goes_on
    missed, closest_atom, closest_path = _NOTHING_MISSED
    if verdict is Verdict.VIOLATED:
        missed, closest_atom, closest_path = find_missed_response(evidence, nodes, path, evidence.scene)
    response_threshold = flip(closest_atom[0]) if closest_atom is not None and flips else None
    return Witness(
        instance.name,
        instance.object,
        verdict,
        lower,
        upper,
        steps,
        decisive_atom,
        threshold if isinstance(threshold, Threshold) else None,
        None if isinstance(threshold, Threshold) else threshold,
        _open_end(evidence, nodes, node, end.turned) if has_open_end else None,
        int(times_ns[-1]) if goes_on else None,
        missed,
        gaps,
        closest_atom,
        () if closest_path is None else _steps(evidence, nodes, closest_path),
        evidence.units,
        declared_unit(evidence.bound(nodes.tree[node][0]), evidence.units),
        while_present,
        response_threshold if isinstance(response_threshold, Threshold) else None,
    )


def _open_end(
    evidence: Evidence, nodes: OfflineNodes, node: int, end: End
) -> tuple[DecidingAtom, int] | None:
    """Return the atom that leaves an end of a node's interval open, and its time, or None."""
    path = deciding_path(nodes, node, end)
    decisive_atom = atom_of_path(evidence, nodes, path, evidence.scene)
    if decisive_atom is None or decisive_atom.lower == decisive_atom.upper:
        return None
    return decisive_atom, int(nodes.times_ns[path.steps[-1].sample])


SceneAt: TypeAlias = Callable[[int], TraceScene]
"""Function of a time that returns the scene of its sample (see `Evidence.scene`)."""


class MissedWitness(NamedTuple):
    """A missed response on a deciding path.

    Attributes:
        missed: outermost failed implication, or None.
        closest: atom that came closest to fulfilling the response, and the time of its sample. None if the
            condition does not decide.
        path: path from the response to the atom in `closest`. None for an implication within a quantifier.
    """

    missed: MissedResponse | None = None
    closest: tuple[DecidingAtom, int] | None = None
    path: DecidingPath | None = None


_NOTHING_MISSED: Final = MissedWitness()


def atom_of_path(
    evidence: Evidence, nodes: OfflineNodes, path: DecidingPath, scene_at: SceneAt
) -> DecidingAtom | None:
    """Return the deciding atom of the leaf at the end of a path; None if the path ends at no leaf."""
    step = path.steps[-1]
    leaf = evidence.bound(nodes.tree[step.node][0])
    if not isinstance(leaf, Atom | Quantified):
        return None
    return deciding_atom(scene_at(int(nodes.times_ns[step.sample])), leaf, path.end)


def find_missed_response(
    evidence: Evidence, nodes: OfflineNodes, path: DecidingPath, scene_at: SceneAt
) -> MissedWitness:
    """Return the missed response on the path of a violated formula."""
    missed, closest_path = missed_response(path, nodes, evidence.instance.bindings)
    if missed is not None:
        closest_atom = None if closest_path is None else atom_of_path(evidence, nodes, closest_path, scene_at)
        if closest_path is None or closest_atom is None or closest_atom.unknown:
            return MissedWitness(missed)
        return MissedWitness(
            missed, (closest_atom, int(nodes.times_ns[closest_path.steps[-1].sample])), closest_path
        )
    step = path.steps[-1]
    leaf, at_ns = evidence.bound(nodes.tree[step.node][0]), int(nodes.times_ns[step.sample])
    if not isinstance(leaf, Quantified):
        return _NOTHING_MISSED
    # an implication within a quantifier, which is a single node
    scene = scene_at(at_ns)
    implication = failed_implication(scene, leaf, path.end)
    if implication is None:
        return _NOTHING_MISSED
    condition, response, is_condition = implication
    missed = MissedResponse(short_title(condition), short_title(response), at_ns, is_condition)
    closest_atom = deciding_atom(scene, response, End.HIGH) if is_condition else None
    return MissedWitness(
        missed, None if closest_atom is None or closest_atom.unknown else (closest_atom, at_ns)
    )


def _steps(evidence: Evidence, nodes: OfflineNodes, path: DecidingPath) -> tuple[WitnessStep, ...]:
    return tuple(_step(step, evidence.bound(nodes.tree[step.node][0]), nodes.times_ns) for step in path.steps)


def _while_present(
    evidence: Evidence, leaves: Floats, times_ns: Integers, node: int, path: DecidingPath
) -> WhilePresent | None:
    """Return the verdict of a node with its path's innermost operator restricted to samples with the objects.

    The result is None if this verdict is unknown, or if each object of the leaf is in all samples. It is also
    None if an object is in no sample.
    """
    instance, bindings = evidence.instance, evidence.instance.bindings
    formula, leaf_order = instance.formula, instance.program.leaves
    nodes = nodes_of(formula)
    operator_nodes = [
        step.node for step in path.steps if operator_of(nodes[step.node]) in ("G", "H", "F", "O")
    ]
    base_terms = dict.fromkeys(map(base_of, iter_terms([nodes[path.steps[-1].node]])))
    terms = [
        term
        for term in base_terms
        if isinstance(term, TrackedName) or (isinstance(term, Variable) and term.name in bindings)
    ]
    if not operator_nodes or not terms:
        return None
    conditions = [Atom(presence.signal.name, "present", presence) for presence in map(presence_of, terms)]
    presence_columns = evidence.columns(conditions)[:, :, : len(times_ns)]
    absent_indices = [index for index in range(len(terms)) if (presence_columns[0, index] < 0.0).any()]
    if not absent_indices or any((presence_columns[0, index] < 0.0).all() for index in absent_indices):
        return None
    condition = Boolean("and", tuple(conditions[index] for index in absent_indices))
    operator = nodes[operator_nodes[-1]]
    connective: BooleanOperator = "->" if operator_of(operator) in ("G", "H") else "and"

    body = Boolean(connective, (condition, *operands_of(operator)))
    guarded_formula = with_operands(formula, operator_nodes[-1], (body,))
    all_leaves = joined_channels([leaves, presence_columns], axis=1)
    guarded_nodes = evaluate_offline(guarded_formula, (*leaf_order, *conditions), all_leaves, times_ns)
    # the ids of nodes before and around the operator are unchanged
    verdict = final_verdict(*guarded_nodes.interval(node))
    if verdict is Verdict.UNKNOWN:
        return None
    condition_text = " and ".join(conditions[index].text for index in absent_indices)
    names = tuple(bindings.get(terms[index].name, terms[index]).name for index in absent_indices)
    return WhilePresent(names, f"{title_of(operator)} ({condition_text} {connective} …)", verdict)


def time_of_least(
    instance: Instance, leaves: Floats, times_ns: Integers, node: int, settled_ns: int, least: float
) -> int:
    """Return the time at which a violated node's robustness on the whole log became certain.

    Args:
        settled_ns: time at which the violation became certain.
        least: upper end of the node's interval on the finished log.
    """
    leaf_order = instance.program.leaves
    nodes = evaluate_offline(instance.formula, leaf_order, leaves, times_ns)
    path = deciding_path(nodes, node, End.HIGH)
    # the robustness depends on all samples of its path
    earliest_sample = max(bisect_left(times_ns, settled_ns), *(step.sample for step in path.steps))

    def is_reached(sample: int) -> bool:
        prefix_slice = slice(sample + 1)
        prefix_nodes = evaluate_prefix(
            instance.formula, leaf_order, leaves[..., prefix_slice], times_ns[prefix_slice]
        )
        return bool(prefix_nodes.ends(node)[1][0] <= least)

    # the samples up to the deciding sample mostly suffice, which needs one evaluation instead of a search
    later_samples = range(
        earliest_sample, earliest_sample if is_reached(earliest_sample) else len(times_ns) - 1
    )
    return int(times_ns[earliest_sample + bisect_left(later_samples, True, key=is_reached)])


def _step(step: PathNode, formula: Formula, times_ns: Integers) -> WitnessStep:
    text, time_ns = format_formula(formula), int(times_ns[step.sample])
    is_empty = False
    if isinstance(formula, Temporal):
        begin, end = windows_of(formula, times_ns, np.array([step.sample]))
        is_empty = bool(begin[0] >= end[0])
    are_left_out = leaves_out(formula) and not is_empty
    return WitnessStep(step.node, operator_of(formula), formula.name, text, time_ns, are_left_out)

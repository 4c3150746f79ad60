"""Why a formula has its verdict: the one atom at one sample that decides it, and how to flip it."""

from __future__ import annotations

from dataclasses import dataclass

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.offline import finished
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.monitor.witness.atom import DecidingAtom, deciding_atom
from spatial_replay.monitor.witness.path import End, Evidence, deciding_path
from spatial_replay.monitor.witness.threshold import Obstacle, Threshold, threshold_of
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Atom, Formula, Quantified, iter_nodes, operator_of


@dataclass(frozen=True, slots=True)
class WitnessStep:
    """A node on the way to what decides, at the sample where it counts.

    Attributes:
        node: its id.
        operator: "and", "F", a relation's name, …
        name: the name of the spec that it is the root of, or None.
        text: its canonical text.
        time_ns: of the sample.
    """

    node: int
    operator: str
    name: str | None
    text: str
    time_ns: int


@dataclass(frozen=True, slots=True)
class Witness:
    """What decides a node's verdict over a finished log.

    Robustness is made of minima and maxima, so that one atom at one sample gives it its number: of a violated
    formula the upper end, of a satisfied one the lower, of an unknown one the ends that leave it open.

    Attributes:
        name: of the spec.
        object: what a template's parameter stands for, or None.
        verdict, lower, upper: of the node.
        path: from the node to what decides, at least one step.
        deciding: the atom; None where the path ends at `true` or `false`, at a window or a next sample
            that the log does not have, or at a quantifier over an empty group.
        threshold: which change of the atom's number flips the verdict; None where none does.
        obstacle: why none does, where there is such an atom.
        open_end: of a verdict that is settled though one end of its interval is open, the atom that leaves it
            open, and the time of its sample.
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

    @property
    def node(self) -> int:
        """The id of the node that it is about."""
        return self.path[0].node

    @property
    def time_ns(self) -> int:
        """The time of the sample that decides."""
        return self.path[-1].time_ns


def find_witness(evidence: Evidence, leaves: Floats, times_ns: Integers, node: int = 0) -> Witness:
    """Return the witness of a node.

    Ties go to the earliest sample, then to the first operand.

    Args:
        evidence: the samples that the instance was evaluated over.
        leaves: (C, A, T), the instance's leaves in them.
        times_ns: (T,), T at least 1.
        node: its id.
    """
    instance = evidence.instance
    done = finished(instance.formula, instance.program.leaves, leaves, times_ns)
    lower, upper = (float(end[0]) + 0.0 for end in done.ends(node))
    verdict = final_verdict(lower, upper)
    end = {Verdict.SATISFIED: End.LOW, Verdict.VIOLATED: End.HIGH}.get(verdict, End.OPEN)
    nodes = [evidence.bound(formula) for _, _, formula in iter_nodes(instance.formula)]

    def follow(end: End) -> tuple[tuple[WitnessStep, ...], DecidingAtom | None]:
        found = deciding_path(instance.formula, done, times_ns, node, end)
        path = tuple(_step(step.node, nodes[step.node], int(times_ns[step.sample])) for step in found.steps)
        leaf = nodes[path[-1].node]
        if not isinstance(leaf, Atom | Quantified):
            return path, None
        return path, deciding_atom(evidence.scene(path[-1].time_ns), leaf, found.end)

    path, deciding = follow(end)
    told = None
    if deciding is not None:
        told = threshold_of(evidence, leaves, times_ns, node, verdict, deciding)
    open_end = None
    if end is not End.OPEN and lower < upper:
        other_path, other = follow(end.turned)
        if other is not None and other.lower < other.upper:
            open_end = other, other_path[-1].time_ns
    return Witness(
        instance.name,
        instance.object,
        verdict,
        lower,
        upper,
        path,
        deciding,
        told if isinstance(told, Threshold) else None,
        None if isinstance(told, Threshold) else told,
        open_end,
    )


def _step(node: int, formula: Formula, time_ns: int) -> WitnessStep:
    return WitnessStep(node, operator_of(formula), formula.name, format_formula(formula), time_ns)

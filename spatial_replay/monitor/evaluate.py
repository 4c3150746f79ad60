"""A specification evaluated over a trace: every node on every prefix, and the verdict at the end.

One result over a finished log, to be asked for more than its numbers: signals, windows, reasons.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from reprlib import repr as shortened

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers, read_only_floats, read_only_integers
from spatial_replay.lazy import Displayed
from spatial_replay.monitor.instances import find_instances
from spatial_replay.monitor.offline import full_signal, window_signal
from spatial_replay.monitor.semantics import Semantics, checked_semantics, instance_evaluation
from spatial_replay.monitor.stream import EvaluationStream, InstanceEvaluation, SeriesBlock
from spatial_replay.monitor.verdict import Verdict, final_verdict, worst_verdict
from spatial_replay.monitor.witness.path import Evidence
from spatial_replay.monitor.witness.witness import Witness, find_witness
from spatial_replay.spec.checks import check_names
from spatial_replay.spec.diagnostics import Diagnostic, nearest_hint
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Formula, Specification, iter_nodes, operator_of
from spatial_replay.spec.load import require_specification
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace, window_of


@dataclass(frozen=True, eq=False)
class Inquiry:
    """What an instance was evaluated from; each question is worked out when it is asked.

    Attributes:
        evidence: the samples, to be looked at again.
        times_ns: (T,) int64, their times.
        leaves: (C, A, T), the instance's leaves in them.
        semantics: what the formula meant; only "ltlf" has answers.

    Raises:
        UsageError: by every question, under other semantics.
    """

    evidence: Evidence
    times_ns: Integers
    leaves: Floats
    semantics: Semantics

    def full_signal(self) -> Floats:
        """(N, T): each node's robustness at each sample, from there to the end; NaN where not determined."""
        self._require_ltlf("the signal of a whole log")
        instance = self.evidence.instance
        return full_signal(instance.formula, instance.program.leaves, self.leaves, self.times_ns)

    def window_signal(self, width_ns: int) -> Floats:
        """(N, T): each node's robustness over the samples in (t - width, t], for the sample at each t.

        Past operators start where the window does; `a[-3]` may look before it. NaN where not determined.

        Raises:
            UsageError: a width below 1 ns.
        """
        self._require_ltlf("a sliding window")
        instance = self.evidence.instance
        return window_signal(instance.formula, instance.program.leaves, self.leaves, self.times_ns, width_ns)

    def witness(self, node: int = 0) -> Witness:
        """What decides a node's verdict over the whole log.

        Raises:
            UsageError: no node has that id.
        """
        self._require_ltlf("a witness")
        nodes = len(self.evidence.instance.program.reports)
        if not 0 <= node < nodes:
            raise UsageError(f"no node has the id {node}; they go from 0 to {nodes - 1}")
        return find_witness(self.evidence, self.leaves, self.times_ns, node)

    def _require_ltlf(self, what: str) -> None:
        if self.semantics != "ltlf":
            raise UsageError(
                f"{what} is not defined under the semantics {self.semantics!r}; evaluate with 'ltlf'"
            )


@dataclass(frozen=True, eq=False)
class NodeResult:
    """One node of a specification's tree over the evaluated samples.

    Attributes:
        id: its number, counted from the root, 0, in the order of the text.
        parent: its parent's id; None for the root.
        operator: "and", "F", a relation's name, …
        name: the name of the spec that it is the root of, or None.
        text: its canonical text.
        value: (T,), its robustness at the first sample, on the samples up to each (`NaN`: not determined).
        now: (T,), its robustness at each sample, on the samples up to that.
        lower, upper: (T,), the ends of `value` over every continuation and everything unknown.
        final_lower, final_upper: the same ends for the finished log.
    """

    id: int
    parent: int | None
    operator: str
    name: str | None
    text: str
    value: Floats
    now: Floats
    lower: Floats
    upper: Floats
    final_lower: float
    final_upper: float

    @property
    def robustness(self) -> float:
        """`value` on the whole log; NaN where it is not determined."""
        return float(self.value[-1])

    @property
    def verdict(self) -> Verdict:
        return final_verdict(self.final_lower, self.final_upper)


@dataclass(frozen=True, eq=False)
class SpecResult(Displayed):
    """One spec over a trace, or one object's instance of a template.

    Attributes:
        name: the spec's name.
        object: the object that a template's parameter stands for, or None.
        formula: the spec's formula.
        times_ns: (T,) int64, the samples evaluated.
        series: (N, 4, T): value, now, lower, upper of each node (see `NodeResult`).
        final: (N, 2): lower and upper end of each node for the finished log.
        inquiry: answers what the numbers leave open.
    """

    name: str
    object: str | None
    formula: Formula
    times_ns: Integers
    series: Floats
    final: Floats
    inquiry: Inquiry

    @cached_property
    def nodes(self) -> tuple[NodeResult, ...]:
        """Every node, by id."""
        return tuple(
            NodeResult(
                identifier,
                parent,
                operator_of(node),
                node.name,
                format_formula(node),
                *self.series[identifier],
                *(float(end) for end in self.final[identifier]),
            )
            for identifier, parent, node in iter_nodes(self.formula)
        )

    def node(self, name: str) -> NodeResult:
        """The node of the spec with the given name, within this result's tree.

        Raises:
            UsageError: no such node.
        """
        for node in self.nodes:
            if node.name == name:
                return node
        names = [node.name for node in self.nodes if node.name]
        raise UsageError(no_such_node(name, names, f" in {self.name!r}"))

    @property
    def robustness(self) -> float:
        """The root's value on the whole log; NaN where it is not determined."""
        return float(self.series[0, 0, -1])

    @property
    def lower(self) -> float:
        """The least that the root's value can be, with everything unknown."""
        return float(self.final[0, 0])

    @property
    def upper(self) -> float:
        """The greatest that the root's value can be, with everything unknown."""
        return float(self.final[0, 1])

    @property
    def verdict(self) -> Verdict:
        return final_verdict(self.lower, self.upper)

    @property
    def first_satisfied_ns(self) -> int | None:
        """The time of the first sample with a value of at least 0, even if that is lost later."""
        satisfied = np.flatnonzero(self.series[0, 0] >= 0.0)
        return int(self.times_ns[satisfied[0]]) if len(satisfied) else None

    def full_signal(self) -> Floats:
        """(N, T): each node's robustness at each sample, from there to the end; see `Inquiry.full_signal`."""
        return self.inquiry.full_signal()

    def window_signal(self, width_ns: int) -> Floats:
        """(N, T): each node's robustness over a sliding window; see `Inquiry.window_signal`."""
        return self.inquiry.window_signal(width_ns)

    def witness(self, node: str | None = None) -> Witness:
        """What decides the verdict of a named node or, by default, of the root.

        Raises:
            UsageError: no such node, or under the paper's semantics.
        """
        return self.inquiry.witness(0 if node is None else self.node(node).id)

    def __repr__(self) -> str:
        instance = f" for {self.object}" if self.object is not None else ""
        return f"<{self.name}{instance}: {self.verdict}, robustness {self.robustness:.6g}>"


@dataclass(frozen=True, eq=False)
class Evaluation(Displayed):
    """What `evaluate` found: one result per spec, and per object for a template.

    Attributes:
        specification: what was evaluated.
        objects, signals: the names that the trace has.
    """

    results: tuple[SpecResult, ...]
    semantics: Semantics
    specification: Specification
    objects: tuple[str, ...]
    signals: tuple[str, ...]

    @cached_property
    def remarks(self) -> tuple[Diagnostic, ...]:
        """What is odd about the names of the specification in this trace (see `check_names`).

        An error for each object and signal that the trace never has, which is unknown in every sample; a
        warning for each object that a definition of the same name hides.
        """
        # not worked out by `evaluate`, which would take as long for this as for the numbers
        return check_names(self.specification, self.objects, self.signals)

    @property
    def verdict(self) -> Verdict:
        """The worst of the results': violated before unknown before satisfied."""
        return worst_verdict(result.verdict for result in self.results)

    def __iter__(self) -> Iterator[SpecResult]:
        return iter(self.results)

    def result(self, name: str | None = None, object: str | None = None) -> SpecResult:
        """The result of a spec by its name and, for a template, of one object; with neither, the only one.

        Raises:
            UsageError: none or several fit.
        """
        fitting = [
            result
            for result in self.results
            if name in (None, result.name) and (object is None or object == result.object)
        ]
        if len(fitting) == 1:
            return fitting[0]
        known = ", ".join(r.name if r.object is None else f"{r.name} for {r.object}" for r in self.results)
        raise UsageError(f"{len(fitting)} results fit name={name!r}, object={object!r}; there are {known}")

    def node(self, name: str, object: str | None = None) -> NodeResult:
        """The node of a named spec, wherever it stands.

        Raises:
            UsageError: no node, or nodes of several objects, have the name.
        """
        found = [
            node
            for result in self.results
            if object is None or object == result.object
            for node in result.nodes
            if node.name == name
        ]
        if not found:
            names = {node.name for result in self.results for node in result.nodes if node.name}
            for_object = "" if object is None else f" for object {object!r}"
            raise UsageError(no_such_node(name, sorted(names), for_object))
        objects = {result.object for result in self.results if object in (None, result.object)}
        if len(objects) > 1 and object is None and len(found) > 1:
            raise UsageError(f"{len(found)} nodes are named {name!r}; say of which object: object=…")
        return found[0]

    def witness(self, node: str | None = None, object: str | None = None) -> Witness:
        """What decides the verdict: of a named node or, by default, of the worst result.

        Args:
            object: whose instance of a template it is about.

        Raises:
            UsageError: no such node or object, nothing was evaluated, or under the paper's semantics.
        """
        results = [result for result in self.results if object in (None, result.object)]
        if node is not None:
            self.node(node, object)
            results = [result for result in results if node in {each.name for each in result.nodes}]
        if not results:
            for_object = "" if object is None else f" for {object!r}"
            raise UsageError(f"there is no result{for_object} to explain")
        worst = worst_verdict(result.verdict for result in results)
        return next(result for result in results if result.verdict is worst).witness(node)

    def __repr__(self) -> str:
        return f"<Evaluation: {self.verdict}; {', '.join(map(repr, self.results))}>"


def no_such_node(name: str, names: Iterable[str], place: str = "") -> str:
    """What to say of a node's name that is none: the nearest that is one, and all of them."""
    known = tuple(names)
    listed = f"there are {', '.join(known)}" if known else "there are none yet"
    hint = nearest_hint(name, known) if isinstance(name, str) else ""
    return f"no node is named {name!r}{place}; {f'{hint} ' if hint else ''}{listed}"


def evaluate(
    specification: Specification,
    trace: Trace,
    *,
    semantics: Semantics = "ltlf",
    start_ns: int | None = None,
    end_ns: int | None = None,
    each: Mapping[str, str] | None = None,
) -> Evaluation:
    """Evaluate every result spec of a specification on every prefix of a trace.

    What is measured between footprints is kept with the trace: evaluating an edited specification over the
    same trace measures only what the edit brought in.

    Args:
        semantics: "ltlf", finite-trace robustness, or "paper", Def. 16 of the paper to the letter.
        start_ns, end_ns: from the first sample at or after the one to the last before the other; what
            looks back (`a[-3]`) may look before the start.
        each: for each parameter of a template, the objects that it stands for: "all", "class:NAME".

    Raises:
        UsageError: no sample in the window, a template without its objects, unknown semantics, an
            operator that the semantics lacks, something else than a specification, a trace or a time.
    """
    require_specification(specification)
    _require_trace(trace)
    checked_semantics(semantics, [specification])
    require_time(start_ns, "start_ns")
    require_time(end_ns, "end_ns")
    window = (0 if start_ns is None else start_ns, FOREVER if end_ns is None else end_ns)
    begin, end = window_of(trace.times_ns, *window)
    if begin >= end:
        raise UsageError(_nothing_in_window(trace, start_ns, end_ns))
    stream = EvaluationStream(
        find_instances(specification, each or {}, [trace], *window),
        specification.regions,
        partial(instance_evaluation, semantics=semantics),
    )
    stretches = stream.extend(trace)
    results = []
    for own, stretch in zip(stream.streams, stretches, strict=True):
        evidence = Evidence(own.instance, specification.regions, lambda: [trace])
        results.append(_result(own, stretch, Inquiry(evidence, stretch.times_ns, stretch.leaves, semantics)))
    return Evaluation(tuple(results), semantics, specification, trace.names, tuple(trace.signals))


def require_time(value: object, name: str) -> None:
    """
    Raises:
        UsageError: for anything else than None or an integer of at least 0.
    """
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise UsageError(f"{name} is {shortened(value)}; give integer nanoseconds, 0 or more")


def _require_trace(value: object) -> None:
    if not isinstance(value, Trace):
        remedy = "give a Trace, from read_trace(path) or Trace.from_samples(samples)"
        raise UsageError(f"trace is {shortened(value)}; {remedy}")


def _result(stream: InstanceEvaluation, stretch: SeriesBlock, inquiry: Inquiry) -> SpecResult:
    return SpecResult(
        stream.instance.name,
        stream.instance.object,
        stream.instance.formula,
        read_only_integers(stretch.times_ns),
        read_only_floats(stretch.series),
        read_only_floats(stream.final),
        inquiry,
    )


def _nothing_in_window(trace: Trace, start_ns: int | None, end_ns: int | None) -> str:
    if not len(trace):
        return "the trace has no sample; there is nothing to evaluate"
    first, last = trace.times_ns[[0, -1]].tolist()
    end = "the end" if end_ns is None else f"{end_ns} ns"
    return (
        f"no sample lies from {first if start_ns is None else start_ns} ns to before {end}; "
        f"the trace runs from {first} to {last} ns"
    )

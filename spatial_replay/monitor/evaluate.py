"""Evaluate a specification over a trace: every node on every prefix, and the verdict at the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from reprlib import repr as shortened
from typing import Any

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.lazy import Displayed, data_frame
from spatial_replay.monitor.instances import find_instances
from spatial_replay.monitor.result import NodeResult, SpecResult, no_such_node
from spatial_replay.monitor.semantics import Semantics, checked_semantics
from spatial_replay.monitor.stream import EvaluationStream
from spatial_replay.monitor.vacuity import UntestedPart, idle_templates
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.witness import Witness
from spatial_replay.spec.checks import check_names, with_numbers
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import require_specification
from spatial_replay.text import named_arguments
from spatial_replay.trace.trace import FOREVER, Trace, require_time, window_of


@dataclass(frozen=True, eq=False)
class Evaluation(Displayed):
    """One result per spec, and per object for a template.

    Attributes:
        specification: what was evaluated.
        objects, signals, classes: the names in the trace.
        each: the objects that templates were evaluated for, by parameter.
    """

    results: tuple[SpecResult, ...]
    semantics: Semantics
    specification: Specification
    objects: tuple[str, ...]
    signals: tuple[str, ...]
    classes: tuple[str, ...]
    each: Mapping[str, str]

    @cached_property
    def remarks(self) -> tuple[Diagnostic, ...]:
        """Diagnostics about the specification's names in this trace (see `check_names`).

        A warning for each object and signal that the trace never has, which is therefore unknown in every
        sample. Also for each class of a template without an object, and for each object hidden by a
        definition of the same name.
        """
        # computed on demand: it takes as long as the evaluation itself
        found = check_names(
            self.specification, self.objects, self.signals, classes=self.classes, each=self.each
        )
        return tuple(replace(remark, severity="warning") for remark in found)

    @cached_property
    def vacuous(self) -> tuple[UntestedPart, ...]:
        """The templates without instances: no object fits them, so they decided nothing.

        Parts of a result that decided nothing are in its own `vacuous`.
        """
        evaluated = (result.formula for result in self.results)
        return idle_templates(self.specification.results, evaluated, self.each, self.classes)

    @property
    def verdict(self) -> Verdict:
        """The worst of the results': violated before unknown before satisfied."""
        return worst_verdict(result.verdict for result in self.results)

    def __iter__(self) -> Iterator[SpecResult]:
        return iter(self.results)

    def result(self, name: str | None = None, object: str | None = None) -> SpecResult:
        """Return the result of a spec by name and, for a template, by object; with neither, the only one.

        Raises:
            UsageError: no result fits, or several.
        """
        fitting = [
            result
            for result in self.results
            if name in (None, result.name) and (object is None or object == result.object)
        ]
        if len(fitting) == 1:
            return fitting[0]
        known = ", ".join(r.name if r.object is None else f"{r.name} for {r.object}" for r in self.results)
        is_part = any(node.name == name for result in self.results for node in result.nodes if node.name)
        hint = f"; {name!r} is part of a result: node({name!r})" if is_part and not fitting else ""
        raise UsageError(
            f"{len(fitting)} results fit name={name!r}, object={object!r}; there are {known}{hint}"
        )

    def to_pandas(self) -> Any:
        """Return the results as a pandas DataFrame: a row for each, with its verdict, numbers and times.

        Raises:
            UsageError: pandas is not installed.
        """
        return data_frame(self)

    def node(self, name: str, object: str | None = None) -> NodeResult:
        """Return the root node of a named spec, wherever it occurs.

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
        """Return what decides the verdict: of a named node or, by default, of the worst result.

        Args:
            object: selects one instance of a template.

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

    def explain(self) -> str:
        """Explain every verdict in sentences, as the command `explain` does (see `SpecResult.explain`)."""
        texts = [result.explain() for result in self.results]
        return "\n\n".join([*texts, *(each.message for each in self.vacuous)])

    def __repr__(self) -> str:
        return f"<Evaluation: {self.verdict}; {', '.join(map(repr, self.results))}>"


@named_arguments
def evaluate(
    specification: Specification,
    trace: Trace,
    *,
    semantics: Semantics = "ltlf",
    start_ns: int | None = None,
    end_ns: int | None = None,
    each: Mapping[str, str] | None = None,
    strict_names: bool = False,
) -> Evaluation:
    """Evaluate every result spec of a specification on every prefix of a trace.

    The trace caches measurements between footprints: evaluating an edited specification over the same trace
    reuses them.

    Args:
        semantics: "ltlf", finite-trace robustness, or "paper", Def. 16 of the paper to the letter.
        start_ns, end_ns: evaluate the samples from start to before end; terms that look back (`a[-3]`) may
            look before the start.
        each: for each parameter of a template, the objects that it stands for: "all", "class:NAME" or a name.
        strict_names: names that the trace never has are errors; otherwise objects and signals are unknown, a
            template has no result for a class, and `Evaluation.remarks` warns of them.

    Raises:
        SpecificationError: with `strict_names`, names that the trace never has; a name that no number of a
            signal has, if the trace declares such names.
        UsageError: no sample in the window, a template without its objects, unknown semantics, an
            operator without a meaning, an argument of another type.
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
    specification = with_numbers(specification, trace.units)
    if strict_names:
        _require_names(specification, trace, each or {})
    stream = EvaluationStream(
        find_instances(specification, each or {}, [trace], *window), specification.regions, semantics
    )
    results = tuple(
        SpecResult.from_stream(
            own, Evidence(own.instance, specification.regions, lambda: [trace], trace.units), block
        )
        for own, block in zip(stream.streams, stream.extend(trace), strict=True)
    )
    return Evaluation(
        results,
        semantics,
        specification,
        trace.names,
        tuple(trace.signals),
        _classes(trace),
        dict(each or {}),
    )


def _require_trace(value: object) -> None:
    if not isinstance(value, Trace):
        remedy = "give a Trace, from read_trace(path) or Trace.from_samples(samples)"
        raise UsageError(f"trace is {shortened(value)}; {remedy}")


def _classes(trace: Trace) -> tuple[str, ...]:
    return tuple(name for name in trace.classes if name)


def _require_names(specification: Specification, trace: Trace, each: Mapping[str, str]) -> None:
    remarks = check_names(
        specification, trace.names, tuple(trace.signals), where="trace", classes=_classes(trace), each=each
    )
    missing = [remark for remark in remarks if remark.severity == "error"]
    if missing:
        raise SpecificationError(missing)


def _nothing_in_window(trace: Trace, start_ns: int | None, end_ns: int | None) -> str:
    if not len(trace):
        return "the trace has no sample; there is nothing to evaluate"
    first, last = trace.times_ns[[0, -1]].tolist()
    end = "the end" if end_ns is None else f"{end_ns} ns"
    return (
        f"no sample lies from {first if start_ns is None else start_ns} ns to before {end}; "
        f"the trace runs from {first} to {last} ns"
    )

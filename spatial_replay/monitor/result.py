"""Evaluate a specification over a trace: results of its specs, with signals and witnesses on request."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from reprlib import repr as shortened
from typing import Any, Final

import numpy as np

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers, read_only_floats, read_only_integers
from spatial_replay.lazy import Displayed, data_frame
from spatial_replay.monitor.atoms.terms import TraceScene, look_back
from spatial_replay.monitor.doubtful import doubts_of_instances
from spatial_replay.monitor.ends import Needs, trim_trace
from spatial_replay.monitor.invariants import (
    LISTED,
    MOST_EXPLAINED,
    ViolatedInvariant,
    find_violated_invariants,
    invariant_sentences,
)
from spatial_replay.monitor.offline import evaluate_offline, full_signal, window_signal
from spatial_replay.monitor.semantics import checked_semantics
from spatial_replay.monitor.sentences import (
    Cause,
    Conjunct,
    LeastPart,
    cause_reason,
    cause_sentences,
    conjuncts_of,
    find_causes,
    find_least,
    reason_sentence,
    sentences_of,
    verdict_sentence,
)
from spatial_replay.monitor.stream import (
    NEVER,
    EvaluationStream,
    InstanceStream,
    SeriesBlock,
    find_instances,
    one_after_another,
    run_together,
)
from spatial_replay.monitor.vacuity import (
    Tested,
    UntestedPart,
    find_cut_window,
    find_vacuous,
    goals_at_the_start,
    idle_templates,
    is_tested_by_nothing,
)
from spatial_replay.monitor.verdict import Semantics, Verdict, final_verdict, require_ltlf, worst_verdict
from spatial_replay.monitor.witness.evidence import Evidence, Gap
from spatial_replay.monitor.witness.path import End, deciding_path
from spatial_replay.monitor.witness.witness import Witness, find_witness, time_of_least
from spatial_replay.spec.checks import check_names, with_numbers
from spatial_replay.spec.diagnostics import Diagnostic, nearest_hint
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Formula, NamedSpec, Specification, iter_nodes, operator_of
from spatial_replay.spec.load import require_specification
from spatial_replay.spec.walks import declared_unit, nodes_of
from spatial_replay.text import (
    Instant,
    Sentence,
    counted_from,
    interval_text,
    named_arguments,
    shortened_formula,
)
from spatial_replay.trace.doubts import Doubt, distinct_doubts
from spatial_replay.trace.trace import FOREVER, LATEST_NS, Trace, require_time, window_of

_UNTESTED: Final = Sentence("Nothing tested the verdict.")
RESULT_TIMES: Final = ("first_satisfied_ns", "violated_at_ns", "satisfied_at_ns")
RESULT_COLUMNS: Final = ("name", "object", "verdict", "robustness", "lower", "upper", *RESULT_TIMES)
"""Attributes of `SpecResult` that every table and document of results has."""


@dataclass(frozen=True, eq=False)
class NodeResult:
    """One node of a specification's tree over the evaluated samples.

    Attributes:
        id: number of the node in the order of the text; 0 for the root.
        parent: id of the parent; None for the root.
        operator: "and", "F", a relation's name, …
        name: name of the spec whose root is the node, or None.
        text: canonical text of the node.
        requirement, title: id ("REQ-12") and title of the requirement of that spec, or None.
        value: (T,), for each sample the robustness at the first sample, given the samples so far; NaN if
            undetermined.
        now: (T,), robustness at each sample, given the samples so far.
        lower, upper: (T,), bounds of `value` over all continuations and unknown values.
        robustness: `value` on the whole log; NaN if undetermined.
        final_lower, final_upper: bounds of the robustness on the finished log.
    """

    id: int
    parent: int | None
    operator: str
    name: str | None
    text: str
    requirement: str | None
    title: str | None
    value: Floats = field(repr=False)
    now: Floats = field(repr=False)
    lower: Floats = field(repr=False)
    upper: Floats = field(repr=False)
    robustness: float
    final_lower: float
    final_upper: float

    @property
    def verdict(self) -> Verdict:
        return final_verdict(self.final_lower, self.final_upper)


@dataclass(frozen=True, eq=False)
class SpecResult(Displayed):
    """One spec evaluated over a log, or one object's instance of a template.

    Attributes:
        name: name of the spec. If two files have a spec of that name, the name begins with the file's stem.
        object: object for which a template was evaluated; else None.
        values: (N,), value of each node on the whole log.
        final: (N, 2), lower and upper end of each node's value on the finished log.
        first_satisfied_ns: time of the first sample at which the root's value is at least 0, or None. Later
            values may be below 0.
        settled_ns: (N, 2), see `InstanceStream`.
        times_ns: (T,) int64, times of the evaluated samples; empty if the numbers of each sample were not
            stored.
        series: (N, 4, T), value, now, lower, upper of each node (see `NodeResult`); T = 0 if not stored.
        leaves: (C, A, T), leaves of the instance, which witnesses and signals need; None if not stored.
        evidence: access to the samples of the log.
        doubts: assumptions that the verdict depends on, and that the log contradicts.
    """

    name: str
    object: str | None
    formula: Formula
    semantics: Semantics
    values: Floats
    final: Floats
    first_satisfied_ns: int | None
    settled_ns: Integers
    times_ns: Integers
    series: Floats
    has_series: bool
    leaves: Floats | None
    evidence: Evidence
    doubts: tuple[Doubt, ...] = ()

    @classmethod
    def from_stream(
        cls,
        stream: InstanceStream,
        evidence: Evidence,
        block: SeriesBlock | None,
        *,
        name: str | None = None,
        has_series: bool = True,
        has_leaves: bool = True,
        doubts: tuple[Doubt, ...] = (),
    ) -> SpecResult:
        """Collect the result of a stream that has seen all samples.

        Args:
            block: stored numbers of every sample, or None.
            name: name of the result; by default the name of the instance.
            has_series, has_leaves: whether the block holds the series, and whether it holds the leaves.
            doubts: doubts that affect the verdict.
        """
        instance = stream.instance
        has_series = has_series and block is not None
        no_series = np.empty((len(stream.robustness), 4, 0))
        return cls(
            instance.name if name is None else name,
            instance.object,
            instance.formula,
            stream.semantics,
            read_only_floats(stream.robustness),
            read_only_floats(stream.final),
            stream.first_satisfied_ns,
            read_only_integers(stream.settled_ns),
            read_only_integers(block.times_ns if block is not None else []),
            read_only_floats(block.series if block is not None and has_series else no_series),
            has_series,
            block.leaves if block is not None and has_leaves else None,
            evidence,
            doubts,
        )

    @property
    def spec(self) -> NamedSpec:
        """The `spec` statement of the result, with its requirement's id and title."""
        return self.evidence.instance.spec

    @property
    def title(self) -> str:
        """The name of the result, with the object of a template's instance."""
        return self.name if self.object is None else f"{self.name}({self.object})"

    @cached_property
    def nodes(self) -> tuple[NodeResult, ...]:
        """All nodes, by id."""
        series = self.series if self.has_series else np.empty((len(self.final), 4, 0))
        nodes = []
        for identifier, parent, node in iter_nodes(self.formula):
            spec = self.spec if parent is None else self.evidence.instance.named.get(node.name or "")
            nodes.append(
                NodeResult(
                    identifier,
                    parent,
                    operator_of(node),
                    node.name,
                    format_formula(node),
                    None if spec is None else spec.id,
                    None if spec is None else spec.title,
                    *series[identifier],
                    *map(float, (self.values[identifier], *self.final[identifier])),
                )
            )
        return tuple(nodes)

    def node(self, name: str) -> NodeResult:
        """Return the node of the spec with the given name, within this result's tree.

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
        """The root's value on the whole log; NaN if undetermined."""
        return float(self.values[0])

    @property
    def lower(self) -> float:
        """The least possible value of the root over all unknown values."""
        return float(self.final[0, 0])

    @property
    def upper(self) -> float:
        """The greatest possible value of the root over all unknown values."""
        return float(self.final[0, 1])

    @property
    def verdict(self) -> Verdict:
        return final_verdict(self.lower, self.upper)

    @property
    def unit(self) -> str:
        """The declared unit of the robustness; "" if the atoms have several units or no declared unit."""
        return declared_unit(self.formula, self.evidence.units)

    @property
    def satisfied_at_ns(self) -> int | None:
        """Time at which satisfaction became certain; None if only the end decided, or if not satisfied."""
        return self.certain_ns() if self.verdict is Verdict.SATISFIED else None

    @property
    def violated_at_ns(self) -> int | None:
        """Time at which violation became certain; None if only the end decided, or if not violated."""
        return self.certain_ns() if self.verdict is Verdict.VIOLATED else None

    def certain_ns(self, node: int = 0) -> int | None:
        """Return the time at which a node's verdict became certain.

        The result is None for an unknown verdict, and if only the end of the log decided.
        """
        verdict = final_verdict(*self.final[node].tolist())
        settled_ns = (
            NEVER if verdict is Verdict.UNKNOWN else self.settled_ns[node, int(verdict is Verdict.VIOLATED)]
        )
        return None if settled_ns == NEVER else int(settled_ns)

    @cached_property
    def causes(self) -> tuple[Cause, ...]:
        """The causes of a violated or unknown verdict, one for each named spec that is not satisfied.

        Causes that settled before the end come first, by time. Causes that only the end of the log decided
        follow, the least robustness first. Unknown causes come last.
        """
        return self.causes_of(0)

    def causes_of(self, node: int) -> tuple[Cause, ...]:
        """Return the causes of a node's verdict (see `causes`)."""
        return self._causes(node, self._witnesses)

    @cached_property
    def violated_invariants(self) -> tuple[ViolatedInvariant, ...]:
        """The violated intervals of each violated part `G p`; empty under the paper's semantics."""
        return self.violated_invariants_of(0)

    def violated_invariants_of(self, node: int, *, goes_on: bool = False) -> tuple[ViolatedInvariant, ...]:
        """Return the violated parts `G p` of a node (see `violated_invariants`).

        Args:
            goes_on: whether further samples may follow.
        """
        return tuple(self._violated_invariants(self._conjuncts_of(node), goes_on=goes_on))

    def _violated_invariants(
        self, conjuncts: Sequence[Conjunct], *, goes_on: bool = False, most: int = MOST_EXPLAINED
    ) -> Iterator[ViolatedInvariant]:
        violated_conjuncts = [conjunct for conjunct in conjuncts if self.final[conjunct.node, 1] < 0.0]
        if self.leaves is None or not self.can_explain or not violated_conjuncts:
            return iter(())
        return find_violated_invariants(
            self.evidence, self.leaves, self.times_ns, violated_conjuncts, goes_on=goes_on, most=most
        )

    def _conjuncts_of(self, node: int) -> Sequence[Conjunct]:
        return conjuncts_of(nodes_of(self.formula)[node], self._name_of(node), node)

    def first_cause(self, node: int) -> Cause | None:
        """Return the first cause of a node without its witness, so that no sample is read."""
        return next(iter(self._causes(node, lambda *_: (None, None))), None)

    def _causes(
        self, node: int, witnesses: Callable[[int, int | None], tuple[Witness | None, Witness | None]]
    ) -> tuple[Cause, ...]:
        if final_verdict(*self.final[node].tolist()) is Verdict.SATISFIED:
            return ()
        # the name of a result may begin with the stem of its file
        spec_by_name = {**self.evidence.instance.named, self.name: self.spec}
        return find_causes(
            self._conjuncts_of(node), self.values, self.final, self.settled_ns, witnesses, spec_by_name
        )

    def to_pandas(self) -> Any:
        """Return the numbers of each sample as a pandas DataFrame, indexed by `time_ns`.

        The column `seconds` has the time since the log's first sample, s. Each node has the columns
        `NAME value`, `NAME now`, `NAME lower` and `NAME upper`. NAME is the spec's name, or else the node's
        id and text.

        Raises:
            UsageError: pandas is not installed, or the numbers of each sample were not stored.
        """
        return data_frame(self)

    def gaps(self) -> tuple[Gap, ...]:
        """Return the gaps of all objects and signals in the formula that are ever missing."""
        return self.evidence.gaps(self.formula)

    @property
    def least(self) -> LeastPart | None:
        """The conjunct with the least robustness; None if the first cause has the same conjunct."""
        return self._least(0, self.causes)

    @property
    def least_at_ns(self) -> int | None:
        """Time of the first cause's least robustness; None if it did not fall after the cause settled."""
        return self._least_at_ns(self.causes)

    @cached_property
    def worst(self) -> Witness | None:
        """The witness of the first cause, or of a satisfied result.

        The witness is None under the paper's semantics, and if the leaves were not stored.
        """
        return self.worst_of(0, self.causes)

    def worst_of(self, node: int, causes: Sequence[Cause]) -> Witness | None:
        """Return the witness of a node's verdict, given its causes (see `worst`)."""
        return causes[0].witness if causes else self._settled_witness(node, self.certain_ns(node))

    @cached_property
    def vacuous(self) -> tuple[UntestedPart, ...]:
        """The parts that decided nothing, in the order of the text.

        The log is read again if the leaves were not stored.
        """
        leaves, times_ns = self._stored
        lower, upper = self.final[0].tolist()
        infinite_end = End.LOW if lower == np.inf else End.HIGH if upper == -np.inf else None
        # NaN marks leaves that the paper's semantics excludes, which have no deciding path
        infinite_end = None if np.isnan(leaves).any() else infinite_end
        return find_vacuous(self.evidence, leaves, times_ns, infinite=infinite_end)

    @property
    def tested(self) -> Tested:
        """Whether the log tested the verdict: "full", "cut" or "nothing".

        "nothing": the verdict is the same for all values of the atoms. (In a satisfied formula, antecedents
        keep their values.) "cut": the verdict may change if the log continues to the ends of the formula's
        windows. "full": all other verdicts, unknown verdicts included.
        """
        if self._is_untested:
            return "nothing"
        return "full" if self._cut_window is None else "cut"

    @property
    def untested(self) -> tuple[UntestedPart, ...]:
        """The parts for which `tested` is not "full"."""
        if self._is_untested:
            return self.vacuous
        return () if self._cut_window is None else (self._cut_window,)

    @property
    def remarks(self) -> tuple[Sentence, ...]:
        """Sentences on doubts, untested parts, a cut window, and goals that hold at the first sample."""
        doubt_remarks = [Sentence("The verdict is doubtful: ", doubt.text, ".") for doubt in self.doubts]
        untested_parts = [*self.vacuous, *(() if self._is_untested else self.untested)]
        untested_remarks = [_UNTESTED] if self._is_untested else []
        return (
            *doubt_remarks,
            *untested_remarks,
            *(part.message for part in untested_parts),
            *self.goals_at_the_start,
        )

    @cached_property
    def goals_at_the_start(self) -> tuple[Sentence, ...]:
        """Sentences on the goals (`F`) that already hold at the first sample."""
        return goals_at_the_start(self.evidence, *self._stored)

    @cached_property
    def _is_untested(self) -> bool:
        if self.verdict is Verdict.UNKNOWN or not self.vacuous:
            return False
        return is_tested_by_nothing(self.evidence, *self._stored, self.verdict)

    @cached_property
    def _cut_window(self) -> UntestedPart | None:
        if self.certain_ns() is not None:
            # the verdict was certain before the end, so no later sample could have changed it
            return None
        return find_cut_window(self.evidence, *self._stored, self.verdict)

    @property
    def _stored(self) -> tuple[Floats, Integers]:
        """The leaves and times of the samples, read again if they were not stored."""
        if self.leaves is not None:
            return self.leaves, self.times_ns
        return self.evidence.columns(self.evidence.instance.program.leaves), self.evidence.times_ns()

    @property
    def can_explain(self) -> bool:
        """Whether the result can have a witness: leaves are stored, and the semantics is "ltlf"."""
        return self.leaves is not None and self.semantics == "ltlf"

    def full_signal(self) -> Floats:
        """Return each node's robustness (N, T) from each sample to the end of the log; NaN if undetermined.

        Raises:
            UsageError: the semantics is the paper's, or the leaves were not stored.
        """
        leaves = self._leaves("the signal of a whole log")
        return full_signal(self.formula, self.evidence.instance.program.leaves, leaves, self.times_ns)

    def window_signal(self, width_ns: int) -> Floats:
        """Return each node's robustness (N, T) over the window (t - width, t] of each sample t.

        Past operators start with the window; `a[-3]` may look before it. Undetermined values are NaN.

        Raises:
            UsageError: the width is below 1 ns, the semantics is the paper's, or the leaves were not stored.
        """
        leaves = self._leaves("a sliding window")
        leaf_order = self.evidence.instance.program.leaves
        return window_signal(self.formula, leaf_order, leaves, self.times_ns, width_ns)

    def witness(self, node: str | int | None = None) -> Witness:
        """Return the witness of the verdict of a node, given by name or id. The default is the root.

        Raises:
            UsageError: no such node, the semantics is the paper's, or the leaves were not stored.
        """
        identifier = self.node(node).id if isinstance(node, str) else node or 0
        leaves = self._leaves("a witness")
        if not 0 <= identifier < len(self.final):
            raise UsageError(f"no node has the id {identifier}; they go from 0 to {len(self.final) - 1}")
        return find_witness(self.evidence, leaves, self.times_ns, identifier)

    def deciding_node(self) -> int:
        """Return the id of the node that decides the verdict. This is cheaper than `witness`.

        Raises:
            UsageError: the semantics is the paper's, or the leaves were not stored.
        """
        leaves = self._leaves("the deciding node")
        nodes = evaluate_offline(self.formula, self.evidence.instance.program.leaves, leaves, self.times_ns)
        return deciding_path(nodes, 0, End.of(final_verdict(*nodes.interval(0)))).steps[-1].node

    def reason(self, first_ns: int) -> Sentence:
        """Return sentences on the robustness and, if it fell after settling, on the first violation.

        The text is "" without a witness (see `worst`).
        """
        if self.causes:
            return cause_reason(self.causes[0], first_ns)
        if self.worst is None or self.leaves is None:
            return Sentence("")
        # a settled witness explains the robustness at its settling time, not on the whole log
        is_settled = self.worst.is_settled
        whole_witness = (
            find_witness(self.evidence, self.leaves, self.times_ns, flips=False) if is_settled else self.worst
        )
        return reason_sentence(whole_witness, first_ns=first_ns)

    def explain(self, *, first_ns: int | None = None) -> str:
        """Explain the verdict in sentences, one per line, as the command `explain` prints them.

        A result that is not satisfied lists each cause, its deciding atom, and the change that would flip
        the verdict. A satisfied result names its deciding atom. Remarks follow (see `remarks`).

        Args:
            first_ns: reference time of the sentences; by default the time of the log's first sample.
        """
        first_ns = self.evidence.first_ns() if first_ns is None else first_ns
        return "\n".join(self.sentences(first_ns))

    def sentences(self, first_ns: int) -> tuple[Sentence, ...]:
        """Return the sentences of `explain`, with times relative to `first_ns`."""
        sentences = self.sentences_about(0, self.causes, first_ns)
        return (*sentences, *counted_from(self.remarks, first_ns))

    def sentences_about(
        self, node: int, causes: Sequence[Cause], first_ns: int, *, goes_on: bool = False
    ) -> tuple[Sentence, ...]:
        """Return the sentences on the verdict of a node, given its causes.

        Args:
            goes_on: whether further samples may follow.
        """
        conjunct_of_node = {conjunct.node: conjunct for conjunct in self._conjuncts_of(node)}
        sentences = [self._headline(node, causes, first_ns)]
        for cause in causes:
            cause_lines = cause_sentences(cause, first_ns=first_ns, object=self.object)
            # the headline replaces the first sentence of a cause that is the node itself
            sentences += cause_lines if cause.node != node else cause_lines[1:]
            cause_conjuncts = [conjunct_of_node[cause.node]]
            for invariant in self._violated_invariants(cause_conjuncts, goes_on=goes_on, most=LISTED):
                sentences += invariant_sentences(invariant, first_ns, self.evidence.units)
        if not causes and self.can_explain:
            witness = self.worst if node == 0 and not self.causes else self.worst_of(node, causes)
            sentences += () if witness is None else sentences_of(witness, first_ns=first_ns)[1:]
        return tuple(sentences)

    def _headline(self, node: int, causes: Sequence[Cause], first_ns: int) -> Sentence:
        object_text = f" for {self.object}" if self.object is not None else ""
        lower, upper = self.final[node].tolist()
        settled_ns = self.certain_ns(node)
        verdict = final_verdict(lower, upper)
        least_part = self._least(node, causes)
        least_at_ns = self._least_at_ns(causes) if least_part is None else None
        return verdict_sentence(
            f"`{self._name_of(node)}`{object_text}",
            verdict,
            (lower, upper),
            unit=self.unit if node == 0 else "",
            has_ended=settled_ns is None and verdict is Verdict.VIOLATED and self.can_explain,
            certain_since=None if settled_ns is None else Instant(settled_ns, first_ns),
            least=least_part,
            least_at=None if least_at_ns is None else Instant(least_at_ns, first_ns),
        )

    def _least(self, node: int, causes: Sequence[Cause]) -> LeastPart | None:
        if not causes:
            return None
        name = self._name_of(node)
        return find_least(self._conjuncts_of(node), self.values, self.final, causes[0], name)

    def _least_at_ns(self, causes: Sequence[Cause]) -> int | None:
        first_cause = causes[0] if causes else None
        if (
            self.leaves is None
            or first_cause is None
            or first_cause.witness is None
            or first_cause.settled_ns is None
        ):
            return None
        least_robustness = float(self.final[first_cause.node, 1])
        if not least_robustness < first_cause.witness.upper:
            return None
        instance = self.evidence.instance
        return time_of_least(
            instance, self.leaves, self.times_ns, first_cause.node, first_cause.settled_ns, least_robustness
        )

    def _name_of(self, node: int) -> str:
        return self.name if node == 0 else self.nodes[node].name or shortened_formula(self.nodes[node].text)

    def _settled_witness(self, node: int, settled_ns: int | None) -> Witness | None:
        """Return the witness of a node's verdict at `settled_ns`; for None, on the whole log."""
        if self.leaves is None or not self.can_explain:
            return None
        if settled_ns is None:
            return self.witness(node)
        sample_count = int(np.searchsorted(self.times_ns, settled_ns, side="right"))
        leaves, times_ns = self.leaves[:, :, :sample_count], self.times_ns[:sample_count]
        whole_log = (self.leaves, self.times_ns)
        return find_witness(self.evidence, leaves, times_ns, node, goes_on=True, whole=whole_log)

    def _witnesses(self, node: int, settled_ns: int | None) -> tuple[Witness | None, Witness | None]:
        """Return the settling witness of a node and, if its violation grew later, the final witness."""
        settling_witness = self._settled_witness(node, settled_ns)
        if (
            self.leaves is None
            or settling_witness is None
            or settled_ns is None
            or not self.final[node, 1] < settling_witness.upper
        ):
            return settling_witness, None
        least_witness = find_witness(self.evidence, self.leaves, self.times_ns, node, flips=False)
        # the first missed response explains more than a later missed response
        is_atom = least_witness.deciding is not None and not least_witness.deciding.unknown
        return (
            settling_witness,
            least_witness
            if is_atom and settling_witness.missed is None and least_witness.missed is None
            else None,
        )

    def _leaves(self, purpose: str) -> Floats:
        require_ltlf(self.semantics, purpose)
        if self.leaves is None:
            raise UsageError(f"{purpose} needs the leaves of every sample, which were not stored")
        return self.leaves

    def __repr__(self) -> str:
        object_text = f" for {self.object}" if self.object is not None else ""
        robustness_text = interval_text(self.robustness, self.lower, self.upper)
        return f"<{self.name}{object_text}: {self.verdict}, robustness {robustness_text}>"


def no_such_node(name: str, names: Iterable[str], place: str = "") -> str:
    """Return the message for an unknown node, with the nearest existing name and all names."""
    existing_names = tuple(names)
    listing = f"there are {', '.join(existing_names)}" if existing_names else "there are none yet"
    hint = nearest_hint(name, existing_names) if isinstance(name, str) else ""
    return f"no node is named {name!r}{place}; {f'{hint} ' if hint else ''}{listing}"


def worst_first(results: Sequence[SpecResult]) -> list[int]:
    """Return the indices of results, worst first: violated, then unknown, then others.

    Violated results are sorted by settling time. Violations that only the end of the log decided follow.
    Otherwise results keep the order of the files. Robustness is not compared, because units may differ.
    """
    severity = {Verdict.VIOLATED: 0, Verdict.UNKNOWN: 1}

    def key(index: int) -> tuple[int, int]:
        violated_ns = results[index].violated_at_ns
        return severity.get(results[index].verdict, 2), LATEST_NS if violated_ns is None else violated_ns

    return sorted(range(len(results)), key=key)


@dataclass(frozen=True, eq=False)
class Evaluation(Displayed):
    """The results of a specification: one per spec, or one per object of a template.

    Attributes:
        specification: the evaluated specification.
        objects, signals, classes: names in the trace.
        each: choice of objects by template parameter.
        left_out: sentences on samples that were left out at the ends.
        doubts: assumptions that the log contradicts. A result has the doubts that affect its verdict.
    """

    results: tuple[SpecResult, ...]
    semantics: Semantics
    specification: Specification
    objects: tuple[str, ...]
    signals: tuple[str, ...]
    classes: tuple[str, ...]
    each: Mapping[str, str]
    left_out: tuple[Sentence, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    @cached_property
    def remarks(self) -> tuple[Diagnostic, ...]:
        """Warnings about the specification's text (see `Specification.warnings`) and its names in this trace.

        An object or signal that the trace never has gets a warning, because it is unknown in every sample.
        Warnings also name classes of templates without an object, and objects hidden by a definition of the
        same name.
        """
        # names are checked on demand, because the check takes as long as the evaluation
        diagnostics = check_names(
            self.specification, self.objects, self.signals, classes=self.classes, each=self.each
        )
        name_warnings = (replace(remark, severity="warning") for remark in diagnostics)
        return (*self.specification.warnings, *name_warnings)

    @cached_property
    def vacuous(self) -> tuple[UntestedPart, ...]:
        """The templates that decided nothing, because they have no instances.

        `SpecResult.vacuous` has the parts of a result that decided nothing.
        """
        evaluated = (result.formula for result in self.results)
        return idle_templates(self.specification.results, evaluated, self.each, self.classes)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the results, in the order violated, unknown, satisfied."""
        return worst_verdict(result.verdict for result in self.results)

    def __iter__(self) -> Iterator[SpecResult]:
        return iter(self.results)

    def result(self, name: str | None = None, object: str | None = None) -> SpecResult:
        """Return one result, by spec name and, for a template, by object.

        Raises:
            UsageError: no result fits, or several results fit.
        """
        fitting_results = [
            result
            for result in self.results
            if name in (None, result.name) and (object is None or object == result.object)
        ]
        if len(fitting_results) == 1:
            return fitting_results[0]
        titles = ", ".join(
            result.name if result.object is None else f"{result.name} for {result.object}"
            for result in self.results
        )
        is_part = any(node.name == name for result in self.results for node in result.nodes if node.name)
        hint = f"; {name!r} is part of a result: node({name!r})" if is_part and not fitting_results else ""
        raise UsageError(
            f"{len(fitting_results)} results fit name={name!r}, object={object!r}; there are {titles}{hint}"
        )

    def to_pandas(self) -> Any:
        """Return the results as a pandas DataFrame: one row per result, with verdict, numbers and times.

        Raises:
            UsageError: pandas is not installed.
        """
        return data_frame(self)

    def node(self, name: str, object: str | None = None) -> NodeResult:
        """Return the root node of a named spec, wherever it occurs.

        Raises:
            UsageError: no node has the name, or nodes of several objects have it.
        """
        nodes = [
            node
            for result in self.results
            if object is None or object == result.object
            for node in result.nodes
            if node.name == name
        ]
        if not nodes:
            node_names = {node.name for result in self.results for node in result.nodes if node.name}
            for_object = "" if object is None else f" for object {object!r}"
            raise UsageError(no_such_node(name, sorted(node_names), for_object))
        objects = {result.object for result in self.results if object in (None, result.object)}
        if len(objects) > 1 and object is None and len(nodes) > 1:
            raise UsageError(f"{len(nodes)} nodes are named {name!r}; say of which object: object=…")
        return nodes[0]

    def witness(self, node: str | None = None, object: str | None = None) -> Witness:
        """Return the witness of a node's verdict. The default is the witness of the worst result.

        Args:
            object: object of one instance of a template.

        Raises:
            UsageError: no such node or object, nothing was evaluated, or the semantics is the paper's.
        """
        results = [result for result in self.results if object in (None, result.object)]
        if node is not None:
            self.node(node, object)
            results = [
                result for result in results if node in {node_result.name for node_result in result.nodes}
            ]
        if not results:
            for_object = "" if object is None else f" for {object!r}"
            raise UsageError(f"there is no result{for_object} to explain")
        verdict = worst_verdict(result.verdict for result in results)
        return next(result for result in results if result.verdict is verdict).witness(node)

    def explain(self) -> str:
        """Explain every verdict in sentences, as the command `explain` does (see `SpecResult.explain`)."""
        texts = [result.explain() for result in self.results]
        return "\n\n".join([*texts, *(part.message for part in self.vacuous)])

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

    The trace caches measurements between footprints, so an edited specification over the same trace reuses
    them.

    Args:
        semantics: "ltlf" for finite-trace robustness, or "paper" for Definition 16 of the paper.
        start_ns, end_ns: samples from `start_ns` to before `end_ns` are evaluated. Terms (`a[-3]`) may look
            before the start. By default, a mapped log is trimmed where a needed topic has not begun or has
            ended (`ends: trim` of the mapping). `Evaluation.left_out` names the trimmed samples.
        each: choice of objects by template parameter: "all", "class:NAME" or an object's name.
        strict_names: whether names that the trace never has are errors. By default, `Evaluation.remarks` has
            a warning. Missing objects and signals are unknown, and a template has no result for a missing
            class.

    Raises:
        SpecificationError: a text that is not among the names that the trace declares for numbers of its
            signal. With `strict_names`, also a name that the trace never has.
        UsageError: no sample in the window, a template without its objects, unknown semantics, an operator
            that the semantics does not define, or an argument of the wrong type.
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
    # the first time is read before trimming, because sentences count time from the log's first sample
    first_ns, needs = int(trace.times_ns[0]), Needs.of([specification], each or {})
    trace, left_out = trim_trace(trace, needs, start=not window[0], end=window[1] >= FOREVER)
    specification = with_numbers(specification, trace.units)
    if strict_names:
        _require_names(specification, trace, each or {})
    stream = EvaluationStream(
        find_instances(specification, each or {}, [trace], *window),
        specification.regions,
        semantics,
        len(trace),
    )
    blocks = stream.extend(trace)
    evaluation = _evaluation_of(specification, semantics, trace, first_ns, stream.streams, blocks)
    return replace(evaluation, each=dict(each or {}), left_out=counted_from(left_out, first_ns))


def _evaluation_of(
    specification: Specification,
    semantics: Semantics,
    trace: Trace,
    first_ns: int,
    streams: Sequence[InstanceStream],
    blocks: Sequence[SeriesBlock],
) -> Evaluation:
    """Return the results of streams that have seen all samples of a trace.

    Args:
        first_ns: reference time of the sentences.
        blocks: numbers of each stream.
    """
    doubts = distinct_doubts(trace.doubts, first_ns)
    instances = [stream.instance for stream in streams]
    doubts_by_result = doubts_of_instances(instances, doubts, lambda: [trace])
    results = tuple(
        SpecResult.from_stream(
            stream,
            Evidence(stream.instance, specification.regions, lambda: [trace], trace.units, first_ns),
            block,
            doubts=doubts_of_result,
        )
        for stream, block, doubts_of_result in zip(streams, blocks, doubts_by_result, strict=True)
    )
    return Evaluation(
        results,
        semantics,
        specification,
        trace.names,
        tuple(trace.signals),
        _classes(trace),
        {},
        doubts=doubts,
    )


# 64 traces of 200 samples take 0.4 of the time of single evaluations
_MOST_TOGETHER: Final = 2**14
"""Limit on samples that `evaluate_many` measures together, which bounds its memory."""


def evaluate_many(
    specification: Specification, traces: Iterable[Trace], *, semantics: Semantics = "ltlf"
) -> Iterator[Evaluation]:
    """Evaluate a specification on each of many traces, with the results of `evaluate`.

    Short traces are measured together. A specification with a template, or with a term that looks back, is
    evaluated trace by trace.

    Raises:
        UsageError: as for `evaluate`, and for a trace without samples.
    """
    require_specification(specification)
    is_separate = any(spec.parameter is not None for spec in specification.results) or bool(
        look_back([spec.formula for spec in specification.results])
    )
    group: list[Trace] = []
    for trace in traces:
        _require_trace(trace)
        if is_separate or not len(trace) or len(trace) >= _MOST_TOGETHER:
            # evaluations come in the order of the traces, so the group is first
            yield from _evaluate_group(specification, group, semantics)
            group = []
            yield evaluate(specification, trace, semantics=semantics)
            continue
        sample_count = sum(map(len, group)) + len(trace)
        if group and (sample_count > _MOST_TOGETHER or trace.units != group[0].units):
            yield from _evaluate_group(specification, group, semantics)
            group = []
        group.append(trace)
    yield from _evaluate_group(specification, group, semantics)


def _evaluate_group(
    specification: Specification, traces: Sequence[Trace], semantics: Semantics
) -> Iterator[Evaluation]:
    """Evaluate traces with equal units, if no term looks back at other samples."""
    if not traces:
        return
    checked_semantics(semantics, [specification])
    needs = Needs.of([specification], {})
    trimmed_traces = [trim_trace(trace, needs, start=True, end=True) for trace in traces]
    specification = with_numbers(specification, traces[0].units)
    instances = find_instances(specification, {}, (), 0, FOREVER)
    evaluated_traces = [trace for trace, _ in trimmed_traces]
    scene = TraceScene(one_after_another(evaluated_traces), specification.regions)
    for full_trace, (trace, left_out), (streams, blocks) in zip(
        traces, trimmed_traces, run_together(instances, scene, evaluated_traces, semantics), strict=True
    ):
        first_ns = int(full_trace.times_ns[0])
        evaluation = _evaluation_of(specification, semantics, trace, first_ns, streams, blocks)
        yield replace(evaluation, left_out=counted_from(left_out, first_ns))


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
    name_errors = [remark for remark in remarks if remark.severity == "error"]
    if name_errors:
        raise SpecificationError(name_errors)


def _nothing_in_window(trace: Trace, start_ns: int | None, end_ns: int | None) -> str:
    if not len(trace):
        return "the trace has no sample; there is nothing to evaluate"
    first_ns, last_ns = trace.times_ns[[0, -1]].tolist()
    end_text = "the end" if end_ns is None else f"{end_ns} ns"
    return (
        f"no sample lies from {first_ns if start_ns is None else start_ns} ns to before {end_text}; "
        f"the trace runs from {first_ns} to {last_ns} ns"
    )

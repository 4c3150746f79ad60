"""Events: changes of verdicts during a run, as sentences with the deciding leaves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.timestamp_pb2 import Timestamp

from spatial_replay.annotate.deciding_leaf import (
    DecidingLeaf,
    LeafHistory,
    LeavesBelow,
    NewestSamples,
    SettledViolation,
    find_leaf,
    leaves_below,
)
from spatial_replay.annotate.specification import ReportedTree
from spatial_replay.compiled import kernel
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.schemas.Robustness_pb2 import EventFacts
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.sentences import amount_text, how_text, uncertain_text
from spatial_replay.monitor.stream import Instance, SeriesBlock
from spatial_replay.monitor.verdict import Semantics, Verdict, final_verdict
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Formula, Quantified, Specification, iter_nodes, operator_of
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.walks import declared_unit, looks_ahead, substitute
from spatial_replay.text import requirement_text, time_text, with_unit

LASTING: Final = 3
"""Debounce of a change of sign, samples in a row."""

START, HOLDING, FAILING, UNKNOWN, SATISFIED, VIOLATED = 0, 1, 2, 3, 4, 5
"""States of a node, in the order of the names.

Nothing is known yet; pending with a value of at least 0; pending with a value below 0; unknown after a known
state; permanently satisfied; permanently violated."""

OF_CURRENT, OF_CANDIDATE = -1, -2
"""Values of `Period.place` if the worst sample is in an earlier block.

`OF_CURRENT` is for the node's current state, `OF_CANDIDATE` for the candidate for its next state."""

_CODE, _SINCE, _UNTIL, _NEXT, _COUNT, _NEXT_SINCE = range(6)


class Period(NamedTuple):
    """A time during which a node was in one state.

    Attributes:
        code: the state.
        start_ns, end_ns: times of the first and the last sample.
        worst: least value in the period; for a final verdict, the deciding end of the interval.
        place: index in the block of the first sample with `worst`; `OF_CURRENT` or `OF_CANDIDATE` if this
            sample is in an earlier block.
    """

    code: int
    start_ns: int
    end_ns: int
    worst: float
    place: int


class Change(NamedTuple):
    """A change of the state of a node.

    Attributes:
        node: index among the tracked nodes.
        sample: index in the block of the sample that confirms the change.
        before: the former period; None if the node had no known state before.
        after: the new period, up to the sample that confirms the change.
    """

    node: int
    sample: int
    before: Period | None
    after: Period


@dataclass(frozen=True, eq=False)
class NodeStates:
    """The states of some nodes, each with a candidate for the next state.

    Attributes:
        integers: (K, 6) int64. Columns of the state: code, first time, last time. Columns of the candidate:
            code, number of samples in a row, first time.
        worst: (K, 2), least number of the state and of the candidate.
    """

    integers: Integers
    worst: Floats

    @classmethod
    def begin(cls, nodes: int) -> NodeStates:
        """Return the states before the first sample."""
        return cls(np.zeros((nodes, 6), np.int64), np.full((nodes, 2), np.inf))

    @property
    def are_final(self) -> bool:
        """Whether all nodes have final states."""
        return bool((self.integers[:, _CODE] >= SATISFIED).all())

    @property
    def pending(self) -> list[int]:
        """The indices of the nodes whose state is not final."""
        return np.flatnonzero(self.integers[:, _CODE] < SATISFIED).tolist()

    def period(self, node: int) -> Period:
        """Return the current period of a node, up to the last sample in that state."""
        code, since, until = self.integers[node, [_CODE, _SINCE, _UNTIL]].tolist()
        return Period(code, since, until, float(self.worst[node, 0]), OF_CURRENT)


class TrackedChanges(NamedTuple):
    """The states of some nodes after a block, and the changes in the block.

    Attributes:
        changes: changes by node, then by time.
        places: (K, 2) int64, index in the block of the sample with each number of `states.worst`, or
            `OF_CURRENT`, `OF_CANDIDATE`.
    """

    states: NodeStates
    changes: list[Change]
    places: Integers


def track(
    before: NodeStates, times_ns: Integers, series: Floats, nodes: Integers, *, settles: bool = True
) -> TrackedChanges:
    """Update the states of some nodes with the next samples.

    Args:
        times_ns: (T,), times of the samples.
        series: (N, 4, T): value, now, lower, upper.
        nodes: (K,) int64, ids of the tracked nodes.
        settles: whether an interval on one side of 0 is a final verdict.
    """
    integers, worst = before.integers.copy(), before.worst.copy()
    worst_places = np.tile(np.array([OF_CURRENT, OF_CANDIDATE], np.int64), (len(nodes), 1))
    # a change takes `LASTING` samples, the first change may have begun earlier, and a verdict takes one
    # sample
    capacity = len(nodes) * (len(times_ns) // LASTING + 2)
    change_rows, worst_numbers = np.empty((capacity, 10), np.int64), np.empty((capacity, 2))
    change_count = _track(
        times_ns, series, nodes, settles, integers, worst, worst_places, change_rows, worst_numbers
    )
    changes = []
    for row, (worst_before, worst_after) in zip(
        change_rows[:change_count].tolist(), worst_numbers[:change_count].tolist(), strict=True
    ):
        node, sample, code, start, end, worst_place, next_code, next_start, next_end, next_place = row
        former_period = Period(code, start, end, worst_before, worst_place) if code != START else None
        new_period = Period(next_code, next_start, next_end, worst_after, next_place)
        changes.append(Change(node, sample, former_period, new_period))
    return TrackedChanges(NodeStates(integers, worst), changes, worst_places)


@kernel
def _track(
    times_ns: Integers,
    series: Floats,
    nodes: Integers,
    settles: bool,
    integers: Integers,
    worst: Floats,
    places: Integers,
    change_rows: Integers,
    worst_numbers: Floats,
) -> int:
    """Update the state in place (see `NodeStates`) and return the number of filled `change_rows`."""
    change_count = 0
    for node in range(nodes.shape[0]):
        value, lower, upper = series[nodes[node], 0], series[nodes[node], 2], series[nodes[node], 3]
        state = integers[node]
        for sample in range(times_ns.shape[0]):
            if state[_CODE] >= SATISFIED:
                break
            code, number = START if state[_CODE] == START else UNKNOWN, np.inf
            if settles and lower[sample] >= 0.0:
                code, number = SATISFIED, lower[sample]
            elif settles and upper[sample] < 0.0:
                code, number = VIOLATED, upper[sample]
            elif value[sample] >= 0.0:
                code, number = HOLDING, value[sample]
            elif value[sample] < 0.0:
                code, number = FAILING, value[sample]
            if code == state[_CODE]:
                state[_COUNT], state[_UNTIL] = 0, times_ns[sample]
                if number < worst[node, 0]:
                    worst[node, 0], places[node, 0] = number, sample
                continue
            if state[_COUNT] == 0 or state[_NEXT] != code:
                state[_NEXT], state[_COUNT], state[_NEXT_SINCE] = code, 0, times_ns[sample]
                worst[node, 1], places[node, 1] = number, sample
            elif number < worst[node, 1]:
                worst[node, 1], places[node, 1] = number, sample
            state[_COUNT] += 1
            is_first = state[_CODE] == START and code < SATISFIED
            if not is_first and code < SATISFIED and state[_COUNT] < LASTING:
                continue
            if not is_first:
                row = change_rows[change_count]
                row[0], row[1] = node, sample
                row[2], row[3], row[4], row[5] = state[_CODE], state[_SINCE], state[_UNTIL], places[node, 0]
                row[6], row[7], row[8], row[9] = code, state[_NEXT_SINCE], times_ns[sample], places[node, 1]
                worst_numbers[change_count, 0], worst_numbers[change_count, 1] = (
                    worst[node, 0],
                    worst[node, 1],
                )
                change_count += 1
            state[_CODE], state[_SINCE], state[_UNTIL] = code, state[_NEXT_SINCE], times_ns[sample]
            worst[node, 0], places[node, 0] = worst[node, 1], places[node, 1]
            state[_COUNT] = 0
    return change_count


_NOW: Final[Mapping[int, str]] = {
    HOLDING: "holds so far",
    FAILING: "is pending",
    UNKNOWN: "is unknown",
    SATISFIED: "is permanently satisfied",
    VIOLATED: "is permanently violated",
}


def change_sentence(title: str, after: Period, witness: str, unit: str = "") -> str:
    """Return a sentence on the new state of a node.

    Args:
        title: name of the node in sentences.
        witness: deciding leaf in words; "" for none.
        unit: declared unit of the number, or "".
    """
    is_short = after.code == FAILING
    reason = ""
    if math.isfinite(after.worst):
        number = with_unit(abs(after.worst), unit)
        reason = f", {number} short of holding" if is_short else f", by {number}"
    if witness:
        reason = f": {witness}"
    return f"{title} {_NOW[after.code]}{reason}."


def end_sentence(title: str, verdict: Verdict, ends: tuple[float, float], witness: str, unit: str) -> str:
    """Return a sentence on the verdict over the finished log.

    Args:
        ends: ends of the interval of the value; NaN if not determined.
        unit: declared unit of the ends, or "".
    """
    amount, reason = "", f": {witness}" if witness else ""
    deciding_end = ends[verdict is Verdict.VIOLATED]
    if verdict is Verdict.UNKNOWN:
        low_text, high_text = (with_unit(end, unit) for end in ends)
        range_text = f"between {low_text} and {high_text}"
        reason = f": robustness {'not determined' if math.isnan(deciding_end) else range_text}"
    elif not witness and math.isfinite(deciding_end):
        amount = f" by {with_unit(abs(deciding_end), unit)}"
    return f"{title} is {verdict}{amount}, for the log has ended{reason}."


def past_sentence(before: Period, until_ns: int, witness: str, unit: str) -> str:
    """Return a sentence on the former period, which lasted until `until_ns`."""
    duration = time_text(until_ns, before.start_ns)
    if before.code in (FAILING, UNKNOWN):
        return f"Before, it was {'pending' if before.code == FAILING else 'unknown'} for {duration}."
    worst_text = ""
    if witness:
        worst_text = f"; its worst was that {witness}"
    elif math.isfinite(before.worst):
        worst_text = f", by {with_unit(abs(before.worst), unit)} or more"
    return f"Before, it held for {duration}{worst_text}."


class ReportedNode(NamedTuple):
    """A node whose changes are reported.

    Attributes:
        node: id of the node.
        title: name of the node in sentences.
        name: name of the spec.
        line: line of the spec in the file, from 1; 0 for a spec that is not in the file.
        below: leaves below the node.
        requirement, sentence: id and title of the spec's requirement, or None.
        is_needed: whether the root needs the node to hold, because only conjunctions are above the node.
        unit: declared unit of the node's number, or "".
    """

    node: int
    title: str
    name: str
    line: int
    below: LeavesBelow
    requirement: str | None = None
    sentence: str | None = None
    is_needed: bool = True
    unit: str = ""


class PeriodText(NamedTuple):
    """A period in words.

    Attributes:
        witness: the deciding leaf in words; "" for none.
        sentence: the sentence on the period.
        decided: the deciding leaf with its node; None if only the leaf's number was compared.
    """

    period: Period
    witness: str
    sentence: str
    decided: DecidingLeaf | None = None


class EncodedEvent(NamedTuple):
    """One event as messages.

    Attributes:
        time_ns: time of the sample that confirms the change.
        event: the serialized `foxglove.Event`.
        log: the message for a list of events.
    """

    time_ns: int
    event: bytes
    log: Log

    @property
    def facts(self) -> EventFacts:
        """The event's facts for a list of events."""
        event = Event.FromString(self.event)
        facts = EventFacts(start_time=event.start_time, end_time=event.end_time)
        for entry in event.metadata:
            if entry.key in _LISTED:
                facts.metadata.add(key=entry.key, value=entry.value)
        return facts


_LISTED: Final = frozenset({"specification", "object", "node", "verdict", "sign", "witness_node", "vacuous"})
"""Keys of an event's facts for a list of events."""


def encoded_occurrence(time_ns: int, what: str, sentence: str) -> EncodedEvent:
    """Encode an external event, such as a lost connection."""
    # the event has no verdict of its own; the next samples report the verdicts that it changes
    facts = {"occurrence": what, "verdict": str(Verdict.UNKNOWN), "message": sentence}
    stamp = _stamp(time_ns)
    event = Event(start_time=stamp, end_time=stamp)
    for key, value in facts.items():
        event.metadata.add(key=key, value=value)
    log = Log(timestamp=stamp, level=Log.WARNING, message=sentence, name=what)
    return EncodedEvent(time_ns, event.SerializeToString(deterministic=True), log)


class EventReporter:
    """Reports the changes of a result's root and of its named specs, up to the end of the log.

    Between blocks the reporter stores a few numbers and two deciding leaves per node. Up to a limit it stores
    the leaves of all samples (see `LeafHistory`).

    Attributes:
        settled: the violation of the root that was certain before the end of the log, or None.
        over: the deciding atom or the missed response of the root's verdict; "" before the verdict, or if
            unknown.
    """

    def __init__(
        self,
        tree: ReportedTree,
        instance: Instance,
        file: Specification,
        semantics: Semantics = "ltlf",
        units: Mapping[str, str] = MappingProxyType({}),
        samples: NewestSamples | None = None,
    ) -> None:
        """Start before the first sample.

        Args:
            units: declared units, see `unit_of`.
            samples: the newest samples, which the caller extends before this object. Without samples,
                sentences name quantifiers without deciding objects.
        """
        self._units, self._regions = units, file.regions
        self._samples = samples or NewestSamples()
        self._has_final_verdicts = (
            semantics == "ltlf"
        )  # the paper's semantics has no verdict over all continuations
        self._tree, self._filename = tree, "" if file.filename == "<text>" else file.filename
        self._leaves = instance.program.leaves
        leaves_by_node = leaves_below(tree.formula, self._leaves)
        self._reported_nodes = _reported_nodes(tree, leaves_by_node, file, units)
        self._node_ids = np.array([reported.node for reported in self._reported_nodes], np.int64)
        self._history = (
            LeafHistory(tree.formula, self._leaves, instance.bindings) if self._has_final_verdicts else None
        )
        self._last_values = np.empty(0)
        self._bindings = instance.bindings
        self._relations = RELATION_NAMES | file.relations
        self._states = NodeStates.begin(len(self._reported_nodes))
        self._last_deciding_leaves: dict[tuple[int, int], DecidingLeaf | None] = {}
        self._last_ns: int | None = None
        self.settled: SettledViolation | None = None
        self.over = ""

    def extend(self, block: SeriesBlock) -> list[EncodedEvent]:
        """Add the next samples, and return the changes that they confirm, sorted by node, then by time."""
        if self._states.are_final:
            self._history = None
        if not len(block.times_ns) or self._states.are_final:
            return []
        self._last_values = block.series[:, 0, -1].copy()
        if self._history is not None:
            self._history.extend(block)
        tracked = track(
            self._states, block.times_ns, block.series, self._node_ids, settles=self._has_final_verdicts
        )
        self._states = tracked.states
        events = [self._event(change, block) for change in tracked.changes]
        deciding_leaves = {}
        for node, worst_places in enumerate(tracked.places.tolist()):
            state_codes = tracked.states.integers[node, [0, 3]].tolist()
            for slot, (code, worst_place) in enumerate(zip(state_codes, worst_places, strict=True)):
                period = Period(code, 0, 0, float(tracked.states.worst[node, slot]), worst_place)
                deciding_leaves[node, (OF_CURRENT, OF_CANDIDATE)[slot]] = self._deciding_leaf(
                    node, period, block
                )
        self._last_deciding_leaves = deciding_leaves
        self._last_ns = int(block.times_ns[-1])
        return events

    def end(self, time_ns: int, final: Floats) -> list[EncodedEvent]:
        """Return the final verdicts of the nodes that were still pending.

        Args:
            time_ns: time of these events, not before the last sample.
            final: (N, 2), lower and upper end of each node's value over the finished log.
        """
        if self._last_ns is None:
            return []
        return [self._final_event(node, time_ns, self._last_ns, final) for node in self._states.pending]

    def untested_warnings(self, time_ns: int, result: SpecResult) -> list[EncodedEvent]:
        """Return a warning for each part of the result that was not tested, or was tested only partly.

        Args:
            time_ns: time of the end of the log.
        """
        root = self._reported_nodes[0]
        facts = self._facts(root) | {"verdict": str(result.verdict), "tested": result.tested}
        return [
            self._message(
                root,
                time_ns,
                (time_ns, time_ns),
                Log.WARNING,
                facts | {"node": str(reason.node or 0), "vacuous": reason.reason, "part": reason.text},
                reason.message,
            )
            for reason in dict.fromkeys((*result.vacuous, *result.untested))
        ]

    def _deciding_leaf(self, node: int, period: Period, block: SeriesBlock) -> DecidingLeaf | None:
        """Return the leaf with the worst number of a period; None if no leaf has that number."""
        if period.place < 0:
            return self._last_deciding_leaves.get((node, period.place))
        leaves = block.leaves[:, :, period.place]
        low_channel, high_channel = low_and_high(len(leaves), wide=period.code in (SATISFIED, VIOLATED))
        leaf_ends = leaves[low_channel], leaves[high_channel]
        number = math.nan if period.code == UNKNOWN else period.worst
        leaves_of_node, time_ns = self._reported_nodes[node].below, int(block.times_ns[period.place])
        return find_leaf(leaves_of_node, leaf_ends, number, time_ns, low=period.code != VIOLATED)

    def _event(self, change: Change, block: SeriesBlock) -> EncodedEvent:
        reported, new_period, former_period = self._reported_nodes[change.node], change.after, change.before
        time_ns, settling_leaf = int(block.times_ns[change.sample]), None
        if self._history is not None and self._history.is_complete and new_period.code in _VERDICTS:
            series, verdict = block.series[:, :, change.sample], _VERDICTS[new_period.code]
            settling_leaf = self._history.settling_leaf(reported.node, series, time_ns, verdict)
            witness, reason = self._settling_words(settling_leaf, verdict, time_ns, time_ns)
            if change.node == 0 and verdict is Verdict.VIOLATED:
                self.settled = self._violation(settling_leaf, time_ns)
            self._remember(change.node, settling_leaf, time_ns)
        else:
            deciding_leaf = self._deciding_leaf(change.node, new_period, block)
            witness = reason = self._words(deciding_leaf, time_ns)
            if new_period.code in _VERDICTS:
                self._remember(change.node, deciding_leaf, time_ns)
        new_text = PeriodText(
            new_period,
            witness,
            change_sentence(reported.title, new_period, reason, reported.unit),
            settling_leaf,
        )
        former_text = None
        if former_period is not None:
            worst_words = self._words(
                self._deciding_leaf(change.node, former_period, block), time_ns, is_past=True
            )
            former_sentence = past_sentence(former_period, new_period.start_ns, worst_words, reported.unit)
            former_text = PeriodText(former_period, worst_words, former_sentence)
        return self._encode(reported, time_ns, new_text, former_text)

    def _final_event(self, node: int, time_ns: int, last_ns: int, final: Floats) -> EncodedEvent:
        reported, former_period = self._reported_nodes[node], self._states.period(node)
        lower, upper = final[reported.node].tolist()
        verdict = final_verdict(lower, upper)
        is_satisfied, witness, reason, deciding_leaf = verdict is not Verdict.VIOLATED, "", "", None
        if self._history is not None and self._history.is_complete:
            deciding_leaf = self._history.final_leaf(reported.node, self._last_values, final)
            witness, reason = self._settling_words(deciding_leaf, verdict, last_ns, time_ns)
            self._remember(node, deciding_leaf, time_ns)
        final_period = Period(_ENDED[verdict], last_ns, last_ns, lower if is_satisfied else upper, OF_CURRENT)
        sentence = end_sentence(reported.title, verdict, (lower, upper), reason, reported.unit)
        new_text = PeriodText(final_period, witness, sentence, deciding_leaf)
        former_text = None
        if former_period.code not in (START, final_period.code) and former_period.start_ns < last_ns:
            worst_words = self._words(self._last_deciding_leaves[node, OF_CURRENT], time_ns, is_past=True)
            former_sentence = past_sentence(former_period, last_ns, worst_words, reported.unit)
            former_text = PeriodText(former_period, worst_words, former_sentence)
        return self._encode(reported, time_ns, new_text, former_text)

    def _encode(
        self, reported: ReportedNode, time_ns: int, new_text: PeriodText, former_text: PeriodText | None
    ) -> EncodedEvent:
        period, witness, sentence, deciding_leaf = new_text
        facts = self._facts(reported) | self._facts_of(period, witness, "")
        if deciding_leaf is not None:
            leaf = deciding_leaf.shown
            facts |= {"witness_node": str(leaf.node), "witness_ns": str(leaf.time_ns)}
        if former_text is not None:
            former_period, sentence = former_text.period, f"{sentence} {former_text.sentence}"
            facts |= self._facts_of(former_period, former_text.witness, "_before")
            facts |= {
                "start_ns_before": str(former_period.start_ns),
                "end_ns_before": str(former_period.end_ns),
            }
        span_ns = period.start_ns, period.end_ns
        level = _LEVELS[period.code] if reported.is_needed else Log.INFO
        return self._message(reported, time_ns, span_ns, level, facts, sentence)

    def _message(
        self,
        reported: ReportedNode,
        time_ns: int,
        span_ns: tuple[int, int],
        level: Log.Level.ValueType,
        facts: Mapping[str, str],
        sentence: str,
    ) -> EncodedEvent:
        event = Event(start_time=_stamp(span_ns[0]), end_time=_stamp(span_ns[1]))
        for key, value in {**facts, "message": sentence}.items():
            event.metadata.add(key=key, value=value)
        log = Log(
            timestamp=_stamp(time_ns),
            level=level,
            message=sentence,
            name=reported.name,
            file=self._filename,
            line=reported.line,
        )
        return EncodedEvent(time_ns, event.SerializeToString(deterministic=True), log)

    def _remember(self, node: int, deciding_leaf: DecidingLeaf | None, now_ns: int) -> None:
        """Store the deciding atom or missed response of the root's verdict, under LTLf semantics."""
        if self._reported_nodes[node].node or deciding_leaf is None or not self._has_final_verdicts:
            return
        leaf, _ = self._leaf(deciding_leaf.shown, now_ns)
        self.over = self._leaf_text(leaf)
        if deciding_leaf.missed and deciding_leaf.missed.is_condition:
            self.over = f"missed {deciding_leaf.missed.response}"

    def _violation(self, deciding_leaf: DecidingLeaf | None, time_ns: int) -> SettledViolation:
        if deciding_leaf is None:
            return SettledViolation(time_ns, deciding_leaf)
        atom, _ = self._leaf(deciding_leaf.shown, time_ns)
        return SettledViolation(
            time_ns, deciding_leaf, atom, self._samples.sample(deciding_leaf.shown.time_ns, time_ns)
        )

    def _leaf(self, deciding_leaf: DecidingLeaf, now_ns: int) -> tuple[Formula, float]:
        """Return a leaf and its number; for a quantifier, the deciding atom and its number."""
        leaf = substitute(self._leaves[deciding_leaf.leaf], self._bindings)
        atom_and_number = None
        if isinstance(leaf, Quantified):
            atom_and_number = self._samples.deciding_atom(leaf, deciding_leaf, now_ns, self._regions)
        return atom_and_number or (leaf, deciding_leaf.number)

    def _leaf_text(self, leaf: Formula) -> str:
        return format_formula(leaf, relations=self._relations)

    def _settling_words(
        self, settling_leaf: DecidingLeaf | None, verdict: Verdict, since_ns: int, now_ns: int
    ) -> tuple[str, str]:
        """Return the deciding leaf in words, and a longer text with a missed response and the leaf's time.

        Both texts are "" if `settling_leaf` is None.
        """
        if settling_leaf is None:
            return "", ""
        missed, deciding_leaf = settling_leaf.missed, settling_leaf.shown
        elapsed_ns = since_ns - deciding_leaf.time_ns
        is_violated = verdict is Verdict.VIOLATED and (missed is None or not missed.is_condition)
        leaf_words = self._words(deciding_leaf, now_ns, is_past=elapsed_ns > 0, is_violated=is_violated)
        if abs(deciding_leaf.bound) < abs(deciding_leaf.number):
            leaf, _ = self._leaf(deciding_leaf, now_ns)
            leaf_words += uncertain_text(amount_text(abs(deciding_leaf.bound), leaf, self._units))
        ago_text = f" ({time_text(elapsed_ns)} earlier)" if elapsed_ns else ""
        response_text = ""
        if missed is not None:
            response_text = f"`{missed.response}` did not hold when its condition `{missed.condition}` held: "
        return leaf_words, f"{response_text}{leaf_words}{ago_text}"

    def _words(
        self,
        deciding_leaf: DecidingLeaf | None,
        now_ns: int,
        *,
        is_past: bool = False,
        is_violated: bool = False,
    ) -> str:
        """Return a leaf with its number in words (see `how_text`); "" for None."""
        if deciding_leaf is None:
            return ""
        leaf, number = self._leaf(deciding_leaf, now_ns)
        how_words = f"{'was' if is_past else 'is'} unknown"
        if not math.isnan(number):
            how_words = how_text(number, leaf, self._units, past=is_past, is_violated=is_violated)
        return f"`{self._leaf_text(leaf)}` {how_words}"

    def _facts(self, reported: ReportedNode) -> dict[str, str]:
        object_fact = {} if self._tree.object is None else {"object": self._tree.object}
        requirement_facts = {"requirement": reported.requirement, "title": reported.sentence}
        return {
            "specification": self._tree.name,
            **object_fact,
            "node": str(reported.node),
            "name": reported.name,
            **{key: value for key, value in requirement_facts.items() if value is not None},
        }

    def _facts_of(self, period: Period, witness: str, suffix: str) -> dict[str, str]:
        if period.code in (START, UNKNOWN):
            return {f"verdict{suffix}": "unknown"}
        sign = "positive" if period.code in (HOLDING, SATISFIED) else "negative"
        verdict = "pending"
        if not self._has_final_verdicts or period.code in (SATISFIED, VIOLATED):
            verdict = "satisfied" if sign == "positive" else "violated"
        facts = {"verdict": verdict, "sign": sign, "robustness": repr(period.worst)}
        if witness:
            facts["witness"] = witness
        return {f"{key}{suffix}": value for key, value in facts.items()}


def _reported_nodes(
    tree: ReportedTree, leaves_by_node: Sequence[LeavesBelow], file: Specification, units: Mapping[str, str]
) -> list[ReportedNode]:
    """Return the root, and the first node of each named spec that depends on later samples.

    Args:
        leaves_by_node: leaves below each node of the tree.
    """
    specs = {spec.name: spec for spec in file.specs}
    reported_nodes: list[ReportedNode] = []
    root_title = f"`{tree.name}`" + (f" for {tree.object}" if tree.object is not None else "")
    reported_names: set[str] = set()
    needed_ids = {0}
    operators = {identifier: operator_of(node) for identifier, _, node in iter_nodes(tree.formula)}
    for identifier, parent, node in iter_nodes(tree.formula):
        if parent in needed_ids and operators[parent] in ("and", "spec"):
            needed_ids.add(identifier)
        if parent is None:
            title = root_title
        elif node.name and node.name not in reported_names and looks_ahead(node):
            title = f"`{node.name}` in {root_title}"
        else:
            continue
        name = tree.name if parent is None else node.name or ""
        reported_names.add(node.name or name)
        spec = specs.get(node.name or name)
        line = 0 if spec is None else _line(file.source, spec.span.start, spec.span.end)
        requirement = (None, None) if spec is None else (spec.id, spec.title)
        if any(requirement):
            title = f"{title} ({requirement_text(*requirement)})"
        is_needed, unit = identifier in needed_ids, declared_unit(node, units)
        reported_nodes.append(
            ReportedNode(
                identifier, title, name, line, leaves_by_node[identifier], *requirement, is_needed, unit
            )
        )
    return reported_nodes


def _line(source: str, start: int, end: int) -> int:
    return source.count("\n", 0, start) + 1 if end > start else 0


def _stamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9)


_ENDED: Final[Mapping[Verdict, int]] = {
    Verdict.SATISFIED: SATISFIED,
    Verdict.VIOLATED: VIOLATED,
    Verdict.UNKNOWN: UNKNOWN,
}
"""State of a node after the end of the log, by verdict."""

_VERDICTS: Final = {SATISFIED: Verdict.SATISFIED, VIOLATED: Verdict.VIOLATED}

_LEVELS: Final[Mapping[int, Log.Level.ValueType]] = {
    START: Log.WARNING,
    HOLDING: Log.INFO,
    FAILING: Log.INFO,
    UNKNOWN: Log.WARNING,
    SATISFIED: Log.INFO,
    VIOLATED: Log.ERROR,
}

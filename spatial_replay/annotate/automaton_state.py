"""Automata of results: their states after each sample as messages, and the automata as attachments."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spatial_replay.annotate.specification import ReportedTree
from spatial_replay.automata.automaton import FALSE, TRUE, UNKNOWN, Automaton, TransitionTable, size_words
from spatial_replay.automata.compile import automaton, stored_text
from spatial_replay.automata.guards import Transition
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.geometry.arrays import Flags, Floats, Integers, combined_code, equal_places
from spatial_replay.logs.messages import Attachment
from spatial_replay.logs.schemas import AutomatonState_pb2
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.topics import AUTOMATA_PREFIX
from spatial_replay.logs.wire import WireTemplate, join_in_order
from spatial_replay.monitor.offline import evaluate_offline
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.monitor.verdict import Semantics, require_ltlf
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    NamedSpec,
    Quantified,
    Specification,
    iter_nodes,
)
from spatial_replay.spec.walks import nodes_of, rates_of
from spatial_replay.text import listing

_NOW = 1
"""Index of `now` among the numbers of a node."""

_MOST_TEMPLATES = 512
"""Limit of cached steps, with their messages and words; a step has up to `MAX_STATES` states."""

# values of propositions in messages by FALSE, TRUE and UNKNOWN, which is the index -1
_TRUTHS = np.array(
    [AutomatonState_pb2.TRUTH_FALSE, AutomatonState_pb2.TRUTH_TRUE, AutomatonState_pb2.TRUTH_UNKNOWN],
    np.uint8,
)


class AutomatonRun:
    """The run of one automaton over the samples, and its messages.

    The messages do not depend on the cut of samples into blocks.

    Attributes:
        propositions: the node of each proposition: the proposition itself, or the atom of a rate that the
            proposition tests.
    """

    def __init__(
        self,
        name: str,
        object: str | None,
        automaton: Automaton,
        formula: Formula,
        order: Sequence[Atom | Quantified],
        named: Callable[[str], str] = str,
    ) -> None:
        """Start before the first sample.

        Args:
            name: name of the specification.
            object: object of a template's instance, or None.
            formula: formula of the automaton.
            order: leaves in the order of `SeriesBlock.leaves`.
            named: replaces a template's parameter by the object in a text.
        """
        self._name, self._object, self._named = name, object, named
        self._automaton = automaton
        self._order = order
        self._table = TransitionTable.of(automaton)
        numbers = {id(node): number for number, _, node in iter_nodes(formula)}
        self.propositions = tuple(
            _node_of(proposition.formula, formula, numbers) for proposition in automaton.propositions
        )
        self._is_node = [id(proposition.formula) in numbers for proposition in automaton.propositions]
        self._possible = np.zeros(len(automaton.states), np.bool_)
        self._possible[automaton.initial] = True
        self._are_nodes = all(self._is_node)
        self._state: int | None = automaton.initial
        # whether `_state` is newer than `_possible`, because `step` updates only `_state`
        self._is_behind = False
        self._template = lru_cache(_MOST_TEMPLATES)(self._made_template)
        about = (automaton.accepting, automaton.can_accept, automaton.can_reject)
        self._about = np.array(
            [[state in members for members in about] for state in automaton.states], np.bool_
        )
        self._after: NDArray[np.bool_] | Integers = np.empty(0, np.int64)
        self._text = lru_cache(_MOST_TEMPLATES)(self._description)

    def encode(self, block: SeriesBlock) -> Sequence[bytes]:
        """Add the next samples, and return one message per sample."""
        if not len(block.times_ns):
            return []
        values = self._values(block)
        before, after = self._steps(values)
        encoded = []
        for members in _alike(before, after):
            sources, targets = (tuple(_members(steps[members[0]]).tolist()) for steps in (before, after))
            template = self._template(sources, targets)
            marks = np.empty((len(members), len(self.propositions) + 3), np.uint8)
            marks[:, :-3] = _TRUTHS[values[:, members]].T
            marks[:, -3:] = self._summary(after[members[0]])
            words = block.times_ns[members].astype(np.uint64)[:, None]
            encoded.append((members, template.encode(words, marks)))
        return join_in_order(encoded)

    def pass_over(self, block: SeriesBlock) -> None:
        """Add the next samples, and write no messages for them."""
        if len(block.times_ns):
            self._steps(self._values(block))

    def states(self, block: SeriesBlock) -> NDArray[np.bool_] | Integers:
        """Add at least one sample, and return the states after each sample, (T,) or as sets (T, S)."""
        return self._steps(self._values(block))[1]

    def step(self, time_ns: int, numbers: Floats, leaves: Callable[[], Floats]) -> tuple[int, ...]:
        """Add one sample, and return the states after it.

        If all propositions are known, this takes a hundredth of the time of `states` with one sample.

        Args:
            numbers: (N, 4), numbers of the formula's nodes after the sample.
            leaves: returns (C, A, 1), the leaves of the sample; called only for the slow way.
        """
        now = [numbers.item(node, _NOW) for node in self.propositions]
        if self._state is None or not self._are_nodes or any(map(math.isnan, now)):
            block = SeriesBlock(np.array([time_ns]), numbers[:, :, None], leaves())
            return tuple(_members(self.states(block)[-1]).tolist())
        self._state = self._automaton.step(self._state, [number >= 0.0 for number in now])
        self._is_behind = True
        return (self._state,)

    def words(self) -> tuple[list[str], Integers]:
        """Return the distinct states of the last block in words, and (T,) the index of words per sample."""
        texts, which = list[str](), np.empty(len(self._after), np.int64)
        for members in _alike(self._after, self._after):
            which[members] = len(texts)
            texts.append(self._text(self._after_states(int(members[0]))))
        return texts, which

    @property
    def latest_words(self) -> str:
        """The states after the last sample, in words."""
        return self._text(self._after_states(-1))

    def _after_states(self, sample: int) -> tuple[int, ...]:
        return tuple(_members(self._after[sample]).tolist())

    def _description(self, states: tuple[int, ...]) -> str:
        """Return states in words: their verdicts, or the guard of the next step to acceptance."""
        numbers = listing([*map(str, states)], _MOST_NAMED)
        title = f"state {numbers}" if len(states) == 1 else f"one of the states {numbers}"
        accepting, can_accept, can_reject = self._about[list(states)].T
        possible = {
            "permanently satisfied": ~can_reject,
            "satisfied if nothing more came": accepting & can_reject,
            "not satisfied yet": ~accepting & can_accept & can_reject,
            "permanently violated": ~can_accept,
        }
        *others, last = [meaning for meaning, holds in possible.items() if holds.any()]
        if others:
            return f"{title}: either {'; or '.join([*others, last])}"
        is_searched = len(states) == 1 and len(self._automaton.states) <= _MOST_SEARCHED
        if last == "not satisfied yet" and is_searched:
            [first, *_] = next(self._automaton.paths(states[0]))
            last = f"still to come: {_shorten(self._guard(first), _LONGEST_STEP)}"
        return f"{title}: {last}"

    def _guard(self, move: Transition) -> str:
        return self._named(self._automaton.guard_words(move))

    def _values(self, block: SeriesBlock) -> Flags:
        """Return (P, T), each proposition in each sample as TRUE, FALSE or UNKNOWN."""
        now = block.series[list(self.propositions), _NOW]
        values = np.where(now >= 0.0, TRUE, FALSE).astype(np.int8)
        unclear = np.isnan(now) | ~np.array(self._is_node, dtype=np.bool_)[:, None]
        for number in np.flatnonzero(unclear.any(axis=1)).tolist():
            # a number that is not determined can still have a determined sign
            formula = self._automaton.propositions[number].formula
            evaluation = evaluate_offline(formula, self._order, block.leaves, block.times_ns)
            low, high = evaluation.ends(0, wide=False)
            values[number, unclear[number]] = UNKNOWN
            values[number, unclear[number] & (low >= 0.0)] = TRUE
            values[number, unclear[number] & (high < 0.0)] = FALSE
        return values

    def _steps(self, values: Flags) -> tuple[NDArray[np.bool_] | Integers, NDArray[np.bool_] | Integers]:
        """Return the states before and after each sample: (T,), or as sets of states (T, S)."""
        if self._is_behind:
            self._possible = np.arange(len(self._possible)) == self._state
            self._is_behind = False
        states = np.flatnonzero(self._possible)
        if len(states) == 1 and not (values == UNKNOWN).any():
            first = int(states[0])
            self._after = after = self._table.states(first, values)
            self._state = int(after[-1])
            self._possible = np.arange(len(self._possible)) == self._state
            return np.concatenate([[first], after[:-1]]), after
        self._after = sets = self._table.state_sets(self._possible, values)
        before = np.concatenate([self._possible[None], sets[:-1]])
        self._possible = sets[-1].copy()
        members = np.flatnonzero(self._possible)
        self._state = int(members[0]) if len(members) == 1 else None
        return before, sets

    def _summary(self, after: NDArray[np.bool_] | Integers) -> NDArray[np.uint8]:
        """Return (3,): whether a state or set of states is accepting, can accept and can reject."""
        about = self._about[_members(after)]
        values = np.where(about.all(axis=0), TRUE, np.where(about.any(axis=0), UNKNOWN, FALSE))
        return _TRUTHS[values]

    def _made_template(self, sources: tuple[int, ...], targets: tuple[int, ...]) -> WireTemplate:
        """Return the template of one step, with a value in every field that differs between samples."""
        message = AutomatonState(
            time_ns=1, specification=self._name, object=self._object or "", states=targets
        )
        message.propositions.extend([AutomatonState_pb2.TRUTH_TRUE] * len(self.propositions))
        if len(sources) == 1:
            message.source = sources[0]
        if len(sources) == len(targets) == 1 and sources != targets:
            transition = self._automaton.transition(sources[0], targets[0])
            message.guard = "" if transition is None else _shorten(self._guard(transition))
        message.accepting = message.can_accept = message.can_reject = AutomatonState_pb2.TRUTH_TRUE
        return WireTemplate.of(message)


def states_of_result(
    result: SpecResult, specification: Specification, *, rate_hz: float | None = None
) -> tuple[Automaton, NDArray[np.bool_] | Integers]:
    """Return the automaton of a result and its states after each sample, (T,) or as sets (T, S).

    Raises:
        NoAutomatonError: the spec has no automaton.
        UsageError: the semantics is the paper's, or the leaves of the samples were not stored.
    """
    require_ltlf(result.semantics, "an automaton")
    if result.leaves is None:
        raise UsageError("the states of an automaton need the leaves of every sample, which were not stored")
    # the evaluated formula itself is compiled, because nodes are found by identity
    machine = automaton(replace(specification, specs=(result.spec,)), result.spec.name, rate_hz=rate_hz)
    leaves = result.evidence.instance.program.leaves
    run = AutomatonRun(result.name, result.object, machine, result.formula, leaves)
    return machine, run.states(SeriesBlock(result.times_ns, result.series, result.leaves))


def _node_of(proposition: Formula, formula: Formula, numbers: Mapping[int, int]) -> int:
    """Return the id of a proposition's node, or of the atom of a rate that the proposition tests."""
    if id(proposition) in numbers:
        return numbers[id(proposition)]
    if isinstance(proposition, Boolean):
        return numbers[id(proposition.operands[-1])]
    (rate,) = rates_of(proposition)
    atoms = (node for node in nodes_of(formula) if isinstance(node, Atom | Quantified))
    return next(numbers[id(atom)] for atom in atoms if rate in rates_of(atom))


_LONGEST_GUARD = 500
_LONGEST_STEP = 120
_MOST_NAMED = 5
"""Limit of listed states if a run may be in one of several."""
_MOST_SEARCHED = 2_000
"""Limit of states of an automaton whose messages name the next step to acceptance."""


def _shorten(text: str, most: int = _LONGEST_GUARD) -> str:
    return text if len(text) <= most else f"{text[: most - 1].rstrip()}…"


def _members(states: NDArray[np.bool_] | Integers) -> Integers:
    """Return the numbers of the states in a set (S,), or of a single state."""
    return np.atleast_1d(np.flatnonzero(states) if states.ndim else states.astype(np.int64))


def _alike(before: NDArray[np.bool_] | Integers, after: NDArray[np.bool_] | Integers) -> Iterator[Integers]:
    """Yield the samples of each distinct pair of states before and after."""
    if before.ndim == 1:
        return equal_places(combined_code([before, after], len(before)))
    # each row becomes one opaque value, so that np.unique compares values instead of columns
    rows = np.packbits(np.concatenate([before, after], axis=1), axis=1)
    _, groups = np.unique(rows.view(f"V{rows.shape[1]}").ravel(), return_inverse=True)
    return equal_places(groups.ravel())


_STORED = ".json"
_MOST_LITERALS = 50_000
"""Limit of literals in all guards of an automaton that is stored as DOT and HOA, too."""


@dataclass(frozen=True)
class SpecAutomaton:
    """The automaton of a spec, which all instances of a template share.

    Attributes:
        name: reported name of the spec.
        automaton: the automaton; None if the spec has none.
        reason: reason why the spec has none.
    """

    name: str
    specification: Specification
    spec: NamedSpec
    automaton: Automaton | None
    reason: str = ""

    @property
    def summary(self) -> str:
        """The size of the automaton, or the reason why there is none."""
        if self.automaton is None:
            return f"none: {self.reason}"
        return size_words(self.automaton)


def automata_of(
    files: Sequence[Specification],
    trees: Sequence[ReportedTree],
    semantics: Semantics,
    compiled_before: Sequence[Attachment] = (),
    known: Sequence[SpecAutomaton] = (),
) -> list[SpecAutomaton]:
    """Return the automaton of each tree's spec. Instances of a template share one automaton.

    Args:
        compiled_before: attachments of a log, whose automata replace compilations with MONA.
        known: compiled automata of specs in these files.
    """
    stored = [attachment.data for attachment in compiled_before if _is_stored(attachment)]
    by_formula = {id(spec_automaton.spec.formula): spec_automaton for spec_automaton in known}
    for tree in trees:
        if id(tree.formula) not in by_formula:
            file = files[tree.file]
            spec = next(named_spec for named_spec in file.results if named_spec.formula is tree.formula)
            by_formula[id(tree.formula)] = _spec_automaton(tree.name, file, spec, semantics, stored)
    return [by_formula[id(tree.formula)] for tree in trees]


def automata_attachments(automata: Sequence[SpecAutomaton], prefix: str) -> list[Attachment]:
    """Return the automata as files: JSON for a replay, DOT for Graphviz, HOA for other tools.

    Args:
        prefix: prefix of the names of the specification's attachments.
    """
    attachments = []
    for spec_automaton in {spec_automaton.name: spec_automaton for spec_automaton in automata}.values():
        if spec_automaton.automaton is None:
            continue
        texts = {
            _STORED: (
                "application/json",
                stored_text(spec_automaton.automaton, spec_automaton.specification, spec_automaton.spec),
            )
        }
        if _has_few_literals(spec_automaton.automaton):
            texts[".dot"] = ("text/vnd.graphviz", spec_automaton.automaton.to_dot())
            texts[".hoa"] = ("text/plain", spec_automaton.automaton.to_hoa())
        for suffix, (kind, text) in texts.items():
            attachments.append(
                Attachment(f"{AUTOMATA_PREFIX}{prefix}{spec_automaton.name}{suffix}", kind, text.encode())
            )
    return attachments


def _has_few_literals(automaton: Automaton) -> bool:
    literals = 0
    for move in automaton.iter_transitions():
        literals += sum(map(len, move.guard))
        if move.is_cut or literals > _MOST_LITERALS:
            return False
    return True


def _is_stored(attachment: Attachment) -> bool:
    return attachment.name.startswith(AUTOMATA_PREFIX) and attachment.name.endswith(_STORED)


def _spec_automaton(
    name: str, file: Specification, spec: NamedSpec, semantics: Semantics, stored: Sequence[bytes]
) -> SpecAutomaton:
    if semantics != "ltlf":
        return SpecAutomaton(name, file, spec, None, "an automaton is of the semantics ltlf")
    try:
        return SpecAutomaton(name, file, spec, automaton(file, spec.name, stored=stored))
    except NoAutomatonError as error:
        return SpecAutomaton(name, file, spec, None, error.reason)

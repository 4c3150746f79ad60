"""Automata of results as attachments, and the states of automata after each sample as messages."""

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
"""Index of `now` in a node's numbers: value, now, lower, upper."""

_MOST_TEMPLATES = 512
"""Limit of cached steps; a step has a message and words for up to `MAX_STATES` states."""

# truth values in messages, indexed by FALSE, TRUE and UNKNOWN (-1)
_TRUTHS = np.array(
    [AutomatonState_pb2.TRUTH_FALSE, AutomatonState_pb2.TRUTH_TRUE, AutomatonState_pb2.TRUTH_UNKNOWN],
    np.uint8,
)


class AutomatonRun:
    """The run of one automaton over the samples, and its messages.

    The messages do not depend on the cut of samples into blocks.

    Attributes:
        propositions: node id of each proposition. A proposition that tests a rate has the id of the rate's
            atom.
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
            named: function that replaces a template's parameter in a text by the object.
        """
        self._name, self._object, self._with_object_name = name, object, named
        self._automaton = automaton
        self._leaf_order = order
        self._table = TransitionTable.of(automaton)
        node_ids = {id(node): node_id for node_id, _, node in iter_nodes(formula)}
        self.propositions = tuple(
            _node_of(proposition.formula, formula, node_ids) for proposition in automaton.propositions
        )
        self._is_proposition_node = [
            id(proposition.formula) in node_ids for proposition in automaton.propositions
        ]
        self._is_possible = np.zeros(len(automaton.states), np.bool_)
        self._is_possible[automaton.initial] = True
        self._are_all_nodes = all(self._is_proposition_node)
        self._state: int | None = automaton.initial
        # whether `_state` is newer than `_is_possible`; `step` updates only `_state`
        self._is_behind = False
        self._cached_template = lru_cache(_MOST_TEMPLATES)(self._made_template)
        state_sets = (automaton.accepting, automaton.can_accept, automaton.can_reject)
        self._state_flags = np.array(
            [[state in state_set for state_set in state_sets] for state in automaton.states], np.bool_
        )
        self._states_after: NDArray[np.bool_] | Integers = np.empty(0, np.int64)
        self._cached_description = lru_cache(_MOST_TEMPLATES)(self._description)

    def encode(self, block: SeriesBlock) -> Sequence[bytes]:
        """Add the next samples, and return one message per sample."""
        if not len(block.times_ns):
            return []
        truth_values = self._values(block)
        states_before, states_after = self._steps(truth_values)
        indices_and_payloads = []
        for sample_indices in _alike(states_before, states_after):
            sources, targets = (
                tuple(_members(states[sample_indices[0]]).tolist())
                for states in (states_before, states_after)
            )
            template = self._cached_template(sources, targets)
            marks = np.empty((len(sample_indices), len(self.propositions) + 3), np.uint8)
            marks[:, :-3] = _TRUTHS[truth_values[:, sample_indices]].T
            marks[:, -3:] = self._summary(states_after[sample_indices[0]])
            words = block.times_ns[sample_indices].astype(np.uint64)[:, None]
            indices_and_payloads.append((sample_indices, template.encode(words, marks)))
        return join_in_order(indices_and_payloads)

    def pass_over(self, block: SeriesBlock) -> None:
        """Add the next samples without writing messages."""
        if len(block.times_ns):
            self._steps(self._values(block))

    def states(self, block: SeriesBlock) -> NDArray[np.bool_] | Integers:
        """Add at least one sample, and return the states after each sample, (T,) or as sets (T, S)."""
        return self._steps(self._values(block))[1]

    def step(self, time_ns: int, numbers: Floats, leaves: Callable[[], Floats]) -> tuple[int, ...]:
        """Add one sample, and return the states after the sample.

        If all propositions are known, `step` takes a hundredth of the time of `states` with one sample.

        Args:
            numbers: (N, 4), numbers of the formula's nodes after the sample.
            leaves: function that returns (C, A, 1), the leaves of the sample; called only for unknown
                propositions.
        """
        current_numbers = [numbers.item(node, _NOW) for node in self.propositions]
        if self._state is None or not self._are_all_nodes or any(map(math.isnan, current_numbers)):
            block = SeriesBlock(np.array([time_ns]), numbers[:, :, None], leaves())
            return tuple(_members(self.states(block)[-1]).tolist())
        self._state = self._automaton.step(self._state, [number >= 0.0 for number in current_numbers])
        self._is_behind = True
        return (self._state,)

    def words(self) -> tuple[list[str], Integers]:
        """Return the distinct states of the last block in words, and (T,) the index of words by sample."""
        texts, text_indices = list[str](), np.empty(len(self._states_after), np.int64)
        for sample_indices in _alike(self._states_after, self._states_after):
            text_indices[sample_indices] = len(texts)
            texts.append(self._cached_description(self._after_states(int(sample_indices[0]))))
        return texts, text_indices

    @property
    def latest_words(self) -> str:
        """The states after the last sample, in words."""
        return self._cached_description(self._after_states(-1))

    def _after_states(self, sample: int) -> tuple[int, ...]:
        return tuple(_members(self._states_after[sample]).tolist())

    def _description(self, states: tuple[int, ...]) -> str:
        """Return states in words: their verdicts, or the guard of the next step to acceptance."""
        state_list = listing([*map(str, states)], _MOST_NAMED)
        title = f"state {state_list}" if len(states) == 1 else f"one of the states {state_list}"
        accepting, can_accept, can_reject = self._state_flags[list(states)].T
        possible_meanings = {
            "permanently satisfied": ~can_reject,
            "satisfied if nothing more came": accepting & can_reject,
            "not satisfied yet": ~accepting & can_accept & can_reject,
            "permanently violated": ~can_accept,
        }
        *other_meanings, last_meaning = [
            meaning for meaning, is_possible in possible_meanings.items() if is_possible.any()
        ]
        if other_meanings:
            return f"{title}: either {'; or '.join([*other_meanings, last_meaning])}"
        is_searched = len(states) == 1 and len(self._automaton.states) <= _MOST_SEARCHED
        if last_meaning == "not satisfied yet" and is_searched:
            [first_move, *_] = next(self._automaton.paths(states[0]))
            last_meaning = f"still to come: {_shorten(self._guard(first_move), _LONGEST_STEP)}"
        return f"{title}: {last_meaning}"

    def _guard(self, move: Transition) -> str:
        return self._with_object_name(self._automaton.guard_words(move))

    def _values(self, block: SeriesBlock) -> Flags:
        """Return (P, T), each proposition in each sample as TRUE, FALSE or UNKNOWN."""
        current_values = block.series[list(self.propositions), _NOW]
        truth_values = np.where(current_values >= 0.0, TRUE, FALSE).astype(np.int8)
        is_unclear = np.isnan(current_values) | ~np.array(self._is_proposition_node, dtype=np.bool_)[:, None]
        for proposition_index in np.flatnonzero(is_unclear.any(axis=1)).tolist():
            # a number that is not determined can still have a determined sign
            formula = self._automaton.propositions[proposition_index].formula
            evaluation = evaluate_offline(formula, self._leaf_order, block.leaves, block.times_ns)
            lows, highs = evaluation.ends(0, wide=False)
            truth_values[proposition_index, is_unclear[proposition_index]] = UNKNOWN
            truth_values[proposition_index, is_unclear[proposition_index] & (lows >= 0.0)] = TRUE
            truth_values[proposition_index, is_unclear[proposition_index] & (highs < 0.0)] = FALSE
        return truth_values

    def _steps(
        self, truth_values: Flags
    ) -> tuple[NDArray[np.bool_] | Integers, NDArray[np.bool_] | Integers]:
        """Return the states before and after each sample: (T,), or as sets of states (T, S)."""
        if self._is_behind:
            self._is_possible = np.arange(len(self._is_possible)) == self._state
            self._is_behind = False
        possible_states = np.flatnonzero(self._is_possible)
        if len(possible_states) == 1 and not (truth_values == UNKNOWN).any():
            first_state = int(possible_states[0])
            self._states_after = states_after = self._table.states(first_state, truth_values)
            self._state = int(states_after[-1])
            self._is_possible = np.arange(len(self._is_possible)) == self._state
            return np.concatenate([[first_state], states_after[:-1]]), states_after
        self._states_after = state_sets = self._table.state_sets(self._is_possible, truth_values)
        sets_before = np.concatenate([self._is_possible[None], state_sets[:-1]])
        self._is_possible = state_sets[-1].copy()
        last_states = np.flatnonzero(self._is_possible)
        self._state = int(last_states[0]) if len(last_states) == 1 else None
        return sets_before, state_sets

    def _summary(self, states: NDArray[np.bool_] | Integers) -> NDArray[np.uint8]:
        """Return (3,): whether a state or set of states is accepting, can accept and can reject."""
        flags = self._state_flags[_members(states)]
        truth_values = np.where(flags.all(axis=0), TRUE, np.where(flags.any(axis=0), UNKNOWN, FALSE))
        return _TRUTHS[truth_values]

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


def _node_of(proposition: Formula, formula: Formula, node_ids: Mapping[int, int]) -> int:
    """Return the node id of a proposition, or the id of the rate's atom if the proposition tests a rate."""
    if id(proposition) in node_ids:
        return node_ids[id(proposition)]
    if isinstance(proposition, Boolean):
        return node_ids[id(proposition.operands[-1])]
    (rate,) = rates_of(proposition)
    atoms = (node for node in nodes_of(formula) if isinstance(node, Atom | Quantified))
    return next(node_ids[id(atom)] for atom in atoms if rate in rates_of(atom))


_LONGEST_GUARD = 500
_LONGEST_STEP = 120
_MOST_NAMED = 5
"""Limit of listed states if several states are possible."""
_MOST_SEARCHED = 2_000
"""Limit of states of an automaton whose messages name the next step to acceptance."""


def _shorten(text: str, most: int = _LONGEST_GUARD) -> str:
    return text if len(text) <= most else f"{text[: most - 1].rstrip()}…"


def _members(states: NDArray[np.bool_] | Integers) -> Integers:
    """Return the numbers of the states in a set (S,), or of a single state."""
    return np.atleast_1d(np.flatnonzero(states) if states.ndim else states.astype(np.int64))


def _alike(
    states_before: NDArray[np.bool_] | Integers, states_after: NDArray[np.bool_] | Integers
) -> Iterator[Integers]:
    """Group the samples by their states before and after; yield the indices of each group."""
    if states_before.ndim == 1:
        return equal_places(combined_code([states_before, states_after], len(states_before)))
    # each row becomes one opaque value, so that np.unique compares values instead of columns
    packed_rows = np.packbits(np.concatenate([states_before, states_after], axis=1), axis=1)
    _, group_indices = np.unique(packed_rows.view(f"V{packed_rows.shape[1]}").ravel(), return_inverse=True)
    return equal_places(group_indices.ravel())


_STORED = ".json"
_MOST_LITERALS = 50_000
"""Limit of literals in the guards of an automaton that is also stored as DOT and HOA."""


@dataclass(frozen=True)
class SpecAutomaton:
    """The automaton of a spec, which all instances of a template share.

    Attributes:
        name: reported name of the spec.
        automaton: the automaton; None if the spec has none.
        reason: reason why the spec has no automaton.
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
        compiled_before: attachments of a log; automata in the attachments replace compilations with MONA.
        known: compiled automata of specs in these files.
    """
    stored_payloads = [attachment.data for attachment in compiled_before if _is_stored(attachment)]
    automata_by_formula = {id(spec_automaton.spec.formula): spec_automaton for spec_automaton in known}
    for tree in trees:
        if id(tree.formula) not in automata_by_formula:
            file = files[tree.file]
            spec = next(named_spec for named_spec in file.results if named_spec.formula is tree.formula)
            automata_by_formula[id(tree.formula)] = _spec_automaton(
                tree.name, file, spec, semantics, stored_payloads
            )
    return [automata_by_formula[id(tree.formula)] for tree in trees]


def automata_attachments(automata: Sequence[SpecAutomaton], prefix: str) -> list[Attachment]:
    """Return the automata as files: JSON for a replay, DOT for Graphviz, HOA for other tools.

    Args:
        prefix: prefix of the names of the specification's attachments.
    """
    attachments = []
    for spec_automaton in {spec_automaton.name: spec_automaton for spec_automaton in automata}.values():
        if spec_automaton.automaton is None:
            continue
        files_by_suffix = {
            _STORED: (
                "application/json",
                stored_text(spec_automaton.automaton, spec_automaton.specification, spec_automaton.spec),
            )
        }
        if _has_few_literals(spec_automaton.automaton):
            files_by_suffix[".dot"] = ("text/vnd.graphviz", spec_automaton.automaton.to_dot())
            files_by_suffix[".hoa"] = ("text/plain", spec_automaton.automaton.to_hoa())
        for suffix, (media_type, text) in files_by_suffix.items():
            attachments.append(
                Attachment(
                    f"{AUTOMATA_PREFIX}{prefix}{spec_automaton.name}{suffix}", media_type, text.encode()
                )
            )
    return attachments


def _has_few_literals(automaton: Automaton) -> bool:
    literal_count = 0
    for move in automaton.iter_transitions():
        literal_count += sum(map(len, move.guard))
        if move.is_cut or literal_count > _MOST_LITERALS:
            return False
    return True


def _is_stored(attachment: Attachment) -> bool:
    return attachment.name.startswith(AUTOMATA_PREFIX) and attachment.name.endswith(_STORED)


def _spec_automaton(
    name: str, file: Specification, spec: NamedSpec, semantics: Semantics, stored_payloads: Sequence[bytes]
) -> SpecAutomaton:
    if semantics != "ltlf":
        return SpecAutomaton(name, file, spec, None, "an automaton is of the semantics ltlf")
    try:
        return SpecAutomaton(name, file, spec, automaton(file, spec.name, stored=stored_payloads))
    except NoAutomatonError as error:
        return SpecAutomaton(name, file, spec, None, error.reason)

"""Stages of a task: the progress of a run in the automaton of a spec, and the proposition owed next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from heapq import heappop, heappush
from typing import Final

import numpy as np

from spatial_replay.annotate.automaton_state import AutomatonRun, states_of_result
from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compile import automaton
from spatial_replay.automata.ltlf import counts_seconds
from spatial_replay.errors import NoAutomatonError
from spatial_replay.geometry.arrays import Floats, Integers, read_only_floats, read_only_integers
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.monitor.result import Evaluation, SpecResult
from spatial_replay.spec.formula import NamedSpec, Specification
from spatial_replay.text import shortened_formula

LOST: Final = "lost"
"""Name of the stage in which acceptance is lost."""
UNKNOWN: Final = "unknown"
"""Name of the stage if several stages are possible after a sample."""

_MOST_WAYS: Final = 1_000_000
"""Limit of pairs of a decision and a following state in an automaton with stages."""

_MOST_HELD: Final = 1024
"""Limit of cached sets of states with their stages."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A stage of a task.

    Attributes:
        name: name, such as "never reached" or "reached, not lifted".
        owed: proposition that must become true next; "" if nothing is owed, or acceptance is lost.
    """

    name: str
    owed: str = ""


@dataclass(frozen=True)
class StagesOfStates:
    """The stages of an automaton.

    Attributes:
        stages: stages, the farthest from acceptance first, with "lost" and "unknown" last.
        numbers: index in `stages` of each state's stage.
        left: number of propositions that each state owes; a trap owes as many as the initial state.
        progress: from 0 to 1, share of the initial state's propositions that each state no longer owes.
    """

    stages: tuple[Stage, ...]
    numbers: tuple[int, ...]
    left: tuple[int, ...]
    progress: tuple[float, ...]

    def stage_of(self, states: Sequence[int]) -> tuple[int, float]:
        """Return the index of the stage and the certain progress of a run that is in one of `states`."""
        stage_numbers = {self.numbers[state] for state in states}
        stage_number = stage_numbers.pop() if len(stage_numbers) == 1 else len(self.stages) - 1
        return stage_number, min(self.progress[state] for state in states)


@dataclass(frozen=True, eq=False)
class Stages:
    """The stages of one result, sample by sample.

    Attributes:
        result: title of the result.
        stages: all stages, the farthest from acceptance first, with "lost" and "unknown" last.
        times_ns: (T,), times of the samples.
        numbers: (T,), index in `stages` of the stage after each sample.
        progress: (T,), from 0 to 1; 1 if the result is satisfied by a log that ends with the sample.
    """

    result: str
    stages: tuple[Stage, ...]
    times_ns: Integers = field(repr=False)
    numbers: Integers = field(repr=False)
    progress: Floats = field(repr=False)

    def __getitem__(self, sample: int) -> Stage:
        """Return the stage after a sample, by index; -1 is the last sample."""
        return self.stages[int(self.numbers[sample])]


class LiveStages:
    """The stages of a spec, sample by sample. A log with the same samples gives the same stages."""

    def __init__(self, specification: Specification, spec: NamedSpec, *, rate_hz: float | None) -> None:
        """Start before the first sample.

        Raises:
            NoAutomatonError: the spec has no automaton, or its automaton is too large for stages.
        """
        self._spec = spec
        self._automaton = automaton(replace(specification, specs=(spec,)), spec.name, rate_hz=rate_hz)
        self._stages = stages_of_automaton(self._automaton)
        self._stage_of = lru_cache(_MOST_HELD)(self._stages.stage_of)
        self._leaves = compile_formula(spec.formula).leaves
        self.reset()

    def reset(self) -> None:
        """Begin another run."""
        self._run = AutomatonRun(self._spec.name, None, self._automaton, self._spec.formula, self._leaves)

    def extend(self, time_ns: int, numbers: Floats, leaves: Callable[[], Floats]) -> tuple[Stage, float]:
        """Add a sample, and return the stage and the progress after it.

        Args:
            numbers, leaves: see `AutomatonRun.step`.
        """
        stage_number, progress = self._stage_of(self._run.step(time_ns, numbers, leaves))
        return self._stages.stages[stage_number], progress


def stages(
    evaluation: Evaluation,
    name: str | None = None,
    object: str | None = None,
    *,
    rate_hz: float | None = None,
) -> Stages:
    """Return the stages of a result, by the automaton of its spec.

    Args:
        name, object: name and object of the result, as in `Evaluation.result`.
        rate_hz: samples per second, for bounds in seconds; None for the rate of evenly spaced samples.

    Raises:
        NoAutomatonError: the spec has no automaton, or its automaton is too large for stages.
        UsageError: no result or several results match, or the semantics is the paper's.
    """
    return stages_of_result(evaluation.result(name, object), evaluation.specification, rate_hz=rate_hz)


def stages_of_result(
    result: SpecResult, specification: Specification, *, rate_hz: float | None = None
) -> Stages:
    """Return the stages of a result of a specification (see `stages`)."""
    if rate_hz is None and counts_seconds(result.formula):
        rate_hz = _even_rate(result.times_ns)
    machine, states_after = states_of_result(result, specification, rate_hz=rate_hz)
    automaton_stages = stages_of_automaton(machine)
    if states_after.ndim == 1:
        stage_numbers = np.array(automaton_stages.numbers, np.int64)[states_after]
        progress = np.array(automaton_stages.progress)[states_after]
    else:
        state_sets, set_indices = np.unique(states_after, axis=0, return_inverse=True)
        stages_and_progress = [
            automaton_stages.stage_of(np.flatnonzero(state_set).tolist()) for state_set in state_sets
        ]
        numbers_of_sets, progress_of_sets = zip(*stages_and_progress, strict=True)
        stage_numbers = np.array(numbers_of_sets, np.int64)[set_indices.ravel()]
        progress = np.array(progress_of_sets)[set_indices.ravel()]
    return Stages(
        result.title,
        automaton_stages.stages,
        result.times_ns,
        read_only_integers(stage_numbers),
        read_only_floats(progress),
    )


def _even_rate(times_ns: Integers) -> float | None:
    """Return the rate of evenly spaced samples in Hz; None for uneven samples.

    Gaps may differ by 1 ns, because times are rounded to nanoseconds.
    """
    gaps_ns = np.diff(times_ns)
    if not len(gaps_ns) or np.ptp(gaps_ns) > 1:
        return None
    return round(len(gaps_ns) * 1e9 / float(times_ns[-1] - times_ns[0]), 6)


@lru_cache(maxsize=64)
def stages_of_automaton(automaton: Automaton) -> StagesOfStates:
    """Return the stages of an automaton's states.

    A state owes the least number of propositions that must become true on a path to acceptance. Propositions
    that must only stay true, as in `G safe`, are not counted.

    Raises:
        NoAutomatonError: the automaton is too large.
    """
    moves = _cheapest_moves(automaton)
    owed_counts, owed_propositions = _ways(automaton, moves)
    initial_propositions = owed_propositions[automaton.initial]
    unmet_by_state = _unmet_propositions(automaton)
    stage_of_state = {
        state: _stage(automaton, state, initial_propositions, propositions, unmet_by_state[state])
        for state, propositions in owed_propositions.items()
    }
    # a state that does not accept owes at least one change, for example a proposition that must become false
    owed_counts = {
        state: owed_count or int(automaton.distances[state] > 0) for state, owed_count in owed_counts.items()
    }
    most_owed = owed_counts[automaton.initial] or max(owed_counts.values()) or 1
    # among states of one stage, the state that owes most gives the stage its place
    states_by_owed = sorted(stage_of_state, key=lambda state: (-owed_counts[state], state))
    ordered_stages = [
        *dict.fromkeys(stage_of_state[state] for state in states_by_owed),
        Stage(LOST),
        Stage(UNKNOWN),
    ]
    return StagesOfStates(
        tuple(ordered_stages),
        tuple(ordered_stages.index(stage_of_state.get(state, Stage(LOST))) for state in automaton.states),
        tuple(owed_counts.get(state, most_owed) for state in automaton.states),
        tuple(max(0.0, 1.0 - owed_counts.get(state, most_owed) / most_owed) for state in automaton.states),
    )


def _cheapest_moves(automaton: Automaton) -> list[dict[int, tuple[int, ...]]]:
    """Return each state's successors, each with the fewest propositions that must become true for the move.

    Propositions are in the order of the text.
    """
    live_states = automaton.can_accept
    tables: list[dict[int, tuple[int, ...]]] = []
    required_sets: list[frozenset[int] | None] = []

    def table(entry: int) -> dict[int, tuple[int, ...]]:
        return tables[entry] if entry >= 0 else {~entry: ()} if ~entry in live_states else {}

    def requires(entry: int) -> frozenset[int] | None:
        """Return the propositions without which a move loses acceptance; None if all moves lose it."""
        return required_sets[entry] if entry >= 0 else frozenset() if ~entry in live_states else None

    entry_count = 0
    for proposition, low, high in automaton.decisions:
        targets = dict(table(low))
        for target, propositions in table(high).items():
            if target not in targets or len(propositions) + 1 < len(targets[target]):
                targets[target] = (proposition, *propositions)
        entry_count += len(targets)
        if entry_count > _MOST_WAYS:
            raise NoAutomatonError(f"the automaton of {automaton.name} is too large for stages")
        tables.append(targets)
        if_false, if_true = requires(low), requires(high)
        if if_true is not None:
            if_true |= {proposition}
        required_sets.append(
            if_true if if_false is None else if_false if if_true is None else if_false & if_true
        )
    moves: list[dict[int, tuple[int, ...]]] = []
    for state, entry in enumerate(automaton.entries):
        targets = table(entry)
        # propositions that keep the run in its state do not have to change
        constant_propositions = (requires(entry) or frozenset()) if state in targets else frozenset()
        moves.append(
            {
                target: tuple(p for p in move_propositions if p not in constant_propositions)
                for target, move_propositions in targets.items()
            }
        )
    return moves


def _ways(
    automaton: Automaton, moves: Sequence[Mapping[int, Sequence[int]]]
) -> tuple[dict[int, int], dict[int, tuple[int, ...]]]:
    """For each state that can accept, return the number of owed propositions, and the propositions in order.

    Dijkstra's algorithm runs backwards from the accepting states.
    """
    sources: dict[int, list[int]] = {}
    for state, targets in enumerate(moves):
        for target in targets:
            sources.setdefault(target, []).append(state)
    owed_counts: dict[int, int] = {}
    owed_propositions: dict[int, tuple[int, ...]] = {}
    heap = [(0, state) for state, distance in automaton.distances.items() if distance == 0]
    while heap:
        owed_count, state = heappop(heap)
        if state in owed_counts:
            continue
        owed_counts[state] = owed_count
        owed_propositions[state] = (
            ()
            if automaton.distances[state] == 0
            else _way(moves[state], owed_counts, owed_propositions, state)
        )
        for source in sources.get(state, ()):
            if source not in owed_counts:
                heappush(heap, (owed_count + len(moves[source][state]), source))
    return owed_counts, owed_propositions


def _way(
    targets: Mapping[int, Sequence[int]],
    owed_counts: Mapping[int, int],
    owed_propositions: Mapping[int, tuple[int, ...]],
    state: int,
) -> tuple[int, ...]:
    """Return the propositions that a state owes, ordered by a path with few propositions per sample."""
    nearest = [
        target
        for target, propositions in targets.items()
        if target != state
        and target in owed_propositions
        and len(propositions) + owed_counts[target] == owed_counts[state]
    ]
    # a path with one proposition per sample shows the order of the formula; a single step hides this order
    target = min(nearest, key=lambda target: (len(targets[target]) or len(targets), target))
    return (*targets[target], *owed_propositions[target])


def _unmet_propositions(automaton: Automaton) -> list[frozenset[int]]:
    """Return, for each state, the propositions that were never true on any path to the state."""
    proposition_count = len(automaton.propositions)
    unmet: list[set[int]] = [set(range(proposition_count)) for _ in automaton.states]
    for proposition in range(proposition_count):
        symbol: list[bool | None] = [None] * proposition_count
        symbol[proposition] = True
        states_after = automaton.step_set(automaton.states, symbol)
        pending = set(states_after)
        while pending:
            state = pending.pop()
            unmet[state].discard(proposition)
            pending |= {target for target in automaton.successors[state] if proposition in unmet[target]}
    return [frozenset(propositions) for propositions in unmet]


def _stage(
    automaton: Automaton,
    state: int,
    initial_propositions: Sequence[int],
    owed_propositions: Sequence[int],
    unmet_propositions: frozenset[int],
) -> Stage:
    """Return the stage of a state that can accept.

    Args:
        initial_propositions, owed_propositions: propositions that the initial state and this state owe.
        unmet_propositions: propositions that were never true on any path to the state.
    """
    proposition_texts = [
        proposition.name or shortened_formula(proposition.text) for proposition in automaton.propositions
    ]
    if not owed_propositions and automaton.distances[state]:
        # the state owes only propositions that must become false
        (move, *_) = next(automaton.paths(state))
        return Stage(
            f"{proposition_texts[initial_propositions[-1]]}, not finished"
            if initial_propositions
            else "not finished",
            automaton.guard_words(move, 80),
        )
    if not owed_propositions:
        return Stage(proposition_texts[initial_propositions[-1]] if initial_propositions else "nothing owed")
    owed_text = proposition_texts[owed_propositions[0]]
    if tuple(initial_propositions[-len(owed_propositions) :]) == tuple(owed_propositions):
        met_propositions = initial_propositions[: -len(owed_propositions)]
    else:
        met_propositions = list((Counter(initial_propositions) - Counter(owed_propositions)).elements())
    if not met_propositions:
        return Stage(
            f"{'never' if owed_propositions[0] in unmet_propositions else 'not'} {owed_text}", owed_text
        )
    if met_propositions[-1] == owed_propositions[0]:
        return Stage(f"{owed_text}, not long enough", owed_text)
    return Stage(f"{proposition_texts[met_propositions[-1]]}, not {owed_text}", owed_text)

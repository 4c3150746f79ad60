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
"""Name of the stage after samples for which several stages are possible."""

_MOST_WAYS: Final = 1_000_000
"""Limit of an automaton with stages: pairs of a decision and a following state."""

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
        """Return the index of the stage of a run in one of some states, and the progress that is certain."""
        numbers = {self.numbers[state] for state in states}
        number = numbers.pop() if len(numbers) == 1 else len(self.stages) - 1
        return number, min(self.progress[state] for state in states)


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
        number, progress = self._stage_of(self._run.step(time_ns, numbers, leaves))
        return self._stages.stages[number], progress


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
    machine, after = states_of_result(result, specification, rate_hz=rate_hz)
    of_states = stages_of_automaton(machine)
    if after.ndim == 1:
        numbers = np.array(of_states.numbers, np.int64)[after]
        progress = np.array(of_states.progress)[after]
    else:
        rows, places = np.unique(after, axis=0, return_inverse=True)
        pairs = [of_states.stage_of(np.flatnonzero(row).tolist()) for row in rows]
        numbers = np.array([number for number, _ in pairs], np.int64)[places.ravel()]
        progress = np.array([share for _, share in pairs])[places.ravel()]
    return Stages(
        result.title,
        of_states.stages,
        result.times_ns,
        read_only_integers(numbers),
        read_only_floats(progress),
    )


def _even_rate(times_ns: Integers) -> float | None:
    """Return the rate of evenly spaced samples in Hz; None for uneven samples.

    Gaps may differ by 1 ns, because times are rounded to nanoseconds.
    """
    gaps = np.diff(times_ns)
    if not len(gaps) or np.ptp(gaps) > 1:
        return None
    return round(len(gaps) * 1e9 / float(times_ns[-1] - times_ns[0]), 6)


@lru_cache(maxsize=64)
def stages_of_automaton(automaton: Automaton) -> StagesOfStates:
    """Return the stages of an automaton's states.

    A state owes the least number of propositions that must become true on a path to acceptance. Propositions
    that must only stay true, as in `G safe`, are not counted.

    Raises:
        NoAutomatonError: the automaton is too large.
    """
    moves = _cheapest_moves(automaton)
    left, ways = _ways(automaton, moves)
    start = ways[automaton.initial]
    unmet = _unmet_propositions(automaton)
    stage_of_state = {
        state: _stage(automaton, state, start, way, unmet[state]) for state, way in ways.items()
    }
    # a state that does not accept owes at least one change, for example a proposition that must become false
    left = {state: count or int(automaton.distances[state] > 0) for state, count in left.items()}
    most = left[automaton.initial] or max(left.values()) or 1
    # among states of one stage, the state that owes most gives the stage its place
    order = sorted(stage_of_state, key=lambda state: (-left[state], state))
    ordered = [*dict.fromkeys(stage_of_state[state] for state in order), Stage(LOST), Stage(UNKNOWN)]
    return StagesOfStates(
        tuple(ordered),
        tuple(ordered.index(stage_of_state.get(state, Stage(LOST))) for state in automaton.states),
        tuple(left.get(state, most) for state in automaton.states),
        tuple(max(0.0, 1.0 - left.get(state, most) / most) for state in automaton.states),
    )


def _cheapest_moves(automaton: Automaton) -> list[dict[int, tuple[int, ...]]]:
    """Return the successors of each state, each with the fewest propositions that must become true for it.

    Propositions are in the order of the text.
    """
    alive = automaton.can_accept
    tables: list[dict[int, tuple[int, ...]]] = []
    required: list[frozenset[int] | None] = []

    def table(place: int) -> dict[int, tuple[int, ...]]:
        return tables[place] if place >= 0 else {~place: ()} if ~place in alive else {}

    def requires(place: int) -> frozenset[int] | None:
        """Return the propositions without which a move loses acceptance; None if every move loses it."""
        return required[place] if place >= 0 else frozenset() if ~place in alive else None

    size = 0
    for proposition, low, high in automaton.decisions:
        targets = dict(table(low))
        for target, rest in table(high).items():
            if target not in targets or len(rest) + 1 < len(targets[target]):
                targets[target] = (proposition, *rest)
        size += len(targets)
        if size > _MOST_WAYS:
            raise NoAutomatonError(f"the automaton of {automaton.name} is too large for stages")
        tables.append(targets)
        false, true = requires(low), requires(high)
        if true is not None:
            true |= {proposition}
        required.append(true if false is None else false if true is None else false & true)
    moves: list[dict[int, tuple[int, ...]]] = []
    for state, entry in enumerate(automaton.entries):
        targets = table(entry)
        # propositions that the run needs to stay in the state must only stay true
        constant = (requires(entry) or frozenset()) if state in targets else frozenset()
        moves.append({target: tuple(p for p in way if p not in constant) for target, way in targets.items()})
    return moves


def _ways(
    automaton: Automaton, moves: Sequence[Mapping[int, Sequence[int]]]
) -> tuple[dict[int, int], dict[int, tuple[int, ...]]]:
    """Return, by state that can accept, the number of owed propositions, and these in their order.

    It is Dijkstra's algorithm from the accepting states backwards.
    """
    sources: dict[int, list[int]] = {}
    for state, targets in enumerate(moves):
        for target in targets:
            sources.setdefault(target, []).append(state)
    left: dict[int, int] = {}
    ways: dict[int, tuple[int, ...]] = {}
    waiting = [(0, state) for state, steps in automaton.distances.items() if steps == 0]
    while waiting:
        count, state = heappop(waiting)
        if state in left:
            continue
        left[state] = count
        ways[state] = () if automaton.distances[state] == 0 else _way(moves[state], left, ways, state)
        for source in sources.get(state, ()):
            if source not in left:
                heappush(waiting, (count + len(moves[source][state]), source))
    return left, ways


def _way(
    targets: Mapping[int, Sequence[int]],
    left: Mapping[int, int],
    ways: Mapping[int, tuple[int, ...]],
    state: int,
) -> tuple[int, ...]:
    """Return the propositions that a state owes, in the order of a path with few propositions per sample."""
    nearest = [
        target
        for target, way in targets.items()
        if target != state and target in ways and len(way) + left[target] == left[state]
    ]
    # a path with one proposition per sample shows the order of the formula; a single step hides it
    target = min(nearest, key=lambda target: (len(targets[target]) or len(targets), target))
    return (*targets[target], *ways[target])


def _unmet_propositions(automaton: Automaton) -> list[frozenset[int]]:
    """Return, for each state, the propositions that were never true on any path to the state."""
    count = len(automaton.propositions)
    unmet: list[set[int]] = [set(range(count)) for _ in automaton.states]
    for proposition in range(count):
        symbol: list[bool | None] = [None] * count
        symbol[proposition] = True
        after = automaton.step_set(automaton.states, symbol)
        pending = set(after)
        while pending:
            state = pending.pop()
            unmet[state].discard(proposition)
            pending |= {target for target in automaton.successors[state] if proposition in unmet[target]}
    return [frozenset(propositions) for propositions in unmet]


def _stage(
    automaton: Automaton, state: int, start: Sequence[int], way: Sequence[int], unmet: frozenset[int]
) -> Stage:
    """Return the stage of a state that can accept.

    Args:
        start, way: propositions that the initial state and this state owe.
        unmet: propositions that were never true on any path to the state.
    """
    words = [p.name or shortened_formula(p.text) for p in automaton.propositions]
    if not way and automaton.distances[state]:
        # the state owes only propositions that must become false
        (move, *_) = next(automaton.paths(state))
        return Stage(
            f"{words[start[-1]]}, not finished" if start else "not finished", automaton.guard_words(move, 80)
        )
    if not way:
        return Stage(words[start[-1]] if start else "nothing owed")
    owed = words[way[0]]
    if tuple(start[-len(way) :]) == tuple(way):
        past = start[: -len(way)]
    else:
        past = list((Counter(start) - Counter(way)).elements())
    if not past:
        return Stage(f"{'never' if way[0] in unmet else 'not'} {owed}", owed)
    if past[-1] == way[0]:
        return Stage(f"{owed}, not long enough", owed)
    return Stage(f"{words[past[-1]]}, not {owed}", owed)

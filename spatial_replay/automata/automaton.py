"""The automaton of a specification: the least of the machines that compilers produce, and its runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.automata.guards import (
    LEAF,
    Diagrams,
    Moves,
    Proposition,
    Successors,
    Transition,
    guard_words,
)
from spatial_replay.compiled import elementwise, kernel
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.geometry.arrays import Flags, Integers
from spatial_replay.lazy import Displayed, drawn_as_svg


@dataclass(frozen=True, eq=False)
class Machine:
    """A deterministic automaton with a move from every state for every symbol.

    A *place* is a row of `decisions`, or ~q for state q.

    Attributes:
        moves: (S,), the place with which the moves of each state begin.
        decisions: (D, 3), a proposition and the places where it is false, and true. These decide on later
            propositions and stand in earlier rows.
        accepting: (S,), whether a run may end in each state.
        start: the place with which the first sample of a run begins.
    """

    moves: Integers
    decisions: Integers
    accepting: Flags
    start: int

    @property
    def size(self) -> int:
        """How many states and decisions it has."""
        return len(self.moves) + len(self.decisions)


def machine_of(diagrams: Diagrams, moves: Sequence[int], accepting: Sequence[bool], start: int) -> Machine:
    """Return the machine whose moves are nodes of diagrams with states as leaves."""
    places: list[int] = []
    rows: list[tuple[int, int, int]] = []
    for node in range(len(diagrams)):
        variable, low, high = diagrams[node]
        if variable == LEAF:
            places.append(~low)
        else:
            places.append(len(rows))
            rows.append((variable, places[low], places[high]))
    return _machine([places[node] for node in moves], rows, accepting, places[start])


def _machine(
    moves: Sequence[int], rows: Sequence[tuple[int, int, int]], accepting: Sequence[bool], start: int
) -> Machine:
    decisions = np.array(rows, np.int64).reshape(-1, 3)
    return Machine(np.array(moves, np.int64), decisions, np.array(accepting, np.bool_), start)


def merged(machine: Machine) -> Machine:
    """Return a machine that accepts the same runs, without equivalent states."""
    _, firsts, classes = np.unique(_split_classes(machine), return_index=True, return_inverse=True)
    places, decisions = _relabel(machine, classes)
    moves = places[machine.moves[firsts]]
    return Machine(moves, decisions, machine.accepting[firsts], int(places[machine.start]))


def least(machine: Machine) -> Machine:
    """Return the automaton with the fewest states, one of them, 0, for a run that has not begun.

    Two machines that accept the same runs of at least one sample give equal ones: states are numbered by
    their distance from the first one. No run is empty, so that may be any state with the same moves, and one
    that does not accept if there is a choice.
    """
    machine = merged(machine)
    reachable = _reachable(machine)
    # compilers differ in states that no run is in
    same = np.array([state for state in reachable if machine.moves[state] == machine.start], np.int64)
    if len(same):
        first = int(same[np.argmin(machine.accepting[same])])
    else:
        first = len(machine.moves)
        moves, accepting = np.append(machine.moves, machine.start), np.append(machine.accepting, False)
        machine = Machine(moves, machine.decisions, accepting, machine.start)
    return _select_states(machine, [first, *(state for state in reachable if state != first)])


def _reachable(machine: Machine) -> list[int]:
    """Return the states that can be reached: nearer ones first, then false before true."""
    moves, rows = machine.moves.tolist(), machine.decisions.tolist()
    order: dict[int, None] = {}
    waiting: list[int] = []
    # a decision visited before leads to no new state
    visited = [False] * len(rows)
    stack = [machine.start]
    expanded = 0
    while stack:
        place = stack.pop()
        if place < 0:
            if ~place not in order:
                order[~place] = None
                waiting.append(~place)
        elif not visited[place]:
            visited[place] = True
            _, low, high = rows[place]
            stack += (high, low)
        if not stack and expanded < len(waiting):
            stack.append(moves[waiting[expanded]])
            expanded += 1
    return waiting


def _select_states(machine: Machine, states: Sequence[int]) -> Machine:
    """Return only some states, in the order given, and decisions in theirs; no move leads to another."""
    numbers = {state: number for number, state in enumerate(states)}
    rows = machine.decisions.tolist()
    places: dict[int, int] = {}
    decisions: list[tuple[int, int, int]] = []

    def place(before: int) -> int:
        if before < 0:
            return ~numbers[~before]
        after = places.get(before)
        if after is None:
            variable, low, high = rows[before]
            row = (variable, place(low), place(high))
            after = places[before] = len(decisions)
            decisions.append(row)
        return after

    moves = [place(before) for before in machine.moves[np.array(states, np.int64)].tolist()]
    start = place(machine.start)
    return _machine(moves, decisions, machine.accepting[np.array(states, np.int64)].tolist(), start)


def _relabel(machine: Machine, numbers: Integers) -> tuple[Integers, Integers]:
    """Give the states other numbers, and merge decisions that have become equal.

    Returns:
        For each place its new place, (D + S,), to be indexed by place: ~q is index D + S - 1 - q. And the new
        decisions.
    """
    decisions = machine.decisions
    places = np.concatenate([np.empty(len(decisions), np.int64), ~numbers[::-1]])
    span = len(places) + 1
    levels: list[Integers] = []
    count = 0
    for rows in _levels(decisions):
        variable = decisions[rows[0], 0]
        low, high = places[decisions[rows, 1]], places[decisions[rows, 2]]
        places[rows] = low
        differ = low != high
        keys = (low[differ] + span) * (2 * span) + high[differ] + span
        kinds, firsts, inverse = np.unique(keys, return_index=True, return_inverse=True)
        places[rows[differ]] = count + inverse.ravel()
        level = np.empty((len(kinds), 3), np.int64)
        level[:, 0], level[:, 1], level[:, 2] = variable, low[differ][firsts], high[differ][firsts]
        levels.append(level)
        count += len(kinds)
    return places, np.concatenate(levels) if levels else np.empty((0, 3), np.int64)


def _levels(decisions: Integers) -> Iterator[Integers]:
    """Yield the rows that decide on each proposition, the last proposition first."""
    if not len(decisions):
        return
    order = np.argsort(-decisions[:, 0], kind="stable")
    bounds = np.flatnonzero(np.diff(decisions[order, 0])) + 1
    yield from np.split(order, bounds)


def _split_classes(machine: Machine) -> list[int]:
    """Return the class of each state: states of one class accept the same runs, the empty one included.

    Classes are split until the moves of all members of one lead to the same ones.
    The largest part of a class keeps its number, so that few states are checked again (Hopcroft, 1971).
    """
    moves, rows = machine.moves.tolist(), machine.decisions.tolist()
    classes: list[int] = machine.accepting.astype(np.int64).tolist()
    parts: list[dict[int, set[int]]] = [{}, {}]
    leading: dict[int, int] = {}
    above = above_of(moves, rows)
    diagrams = Diagrams()
    pending: Collection[int] = range(len(classes))
    while pending:
        copies: dict[int, int] = {}

        def copy(place: int, copies: dict[int, int] = copies) -> int:
            if place < 0:
                return diagrams.leaf(classes[~place])
            if place not in copies:
                variable, low, high = rows[place]
                copies[place] = diagrams.decide(variable, copy(low), copy(high))
            return copies[place]

        for state in pending:
            parts_of_class = parts[classes[state]]
            if state in leading:
                parts_of_class[leading[state]].remove(state)
                if not parts_of_class[leading[state]]:
                    del parts_of_class[leading[state]]
            leading[state] = copy(moves[state])
            parts_of_class.setdefault(leading[state], set()).add(state)
        moved = _split(parts, classes, dict.fromkeys(classes[state] for state in pending))
        pending = sources_of(above, moved)
    return classes


def _split(parts: list[dict[int, set[int]]], classes: list[int], touched: Iterable[int]) -> list[int]:
    """Make all parts of some classes but the largest classes of their own; gives the states in these."""
    moved: list[int] = []
    for number in touched:
        parts_of_class = parts[number]
        largest = max(parts_of_class, key=lambda node: len(parts_of_class[node]))
        for node in [part for part in parts_of_class if part != largest]:
            members = parts_of_class.pop(node)
            for state in members:
                classes[state] = len(parts)
            parts.append({node: members})
            moved += sorted(members)
    return moved


def above_of(moves: Sequence[int], rows: Iterable[Sequence[int]]) -> dict[int, list[int]]:
    """Return for each place the rows that lead to it at once, and ~q if the moves of state q begin there."""
    above: dict[int, list[int]] = {}
    for number, (_, low, high) in enumerate(rows):
        above.setdefault(low, []).append(number)
        above.setdefault(high, []).append(number)
    for state, place in enumerate(moves):
        above.setdefault(place, []).append(~state)
    return above


def sources_of(
    above: dict[int, list[int]], targets: Iterable[int], visited: set[int] | None = None
) -> dict[int, None]:
    """Return the states from which one sample can lead to some states.

    Args:
        above: as from `above_of`.
        visited: rows that are not followed again; those that are followed are added.
    """
    sources: dict[int, None] = {}
    seen = set() if visited is None else visited
    stack = [~target for target in targets]
    while stack:
        for parent_row in above.get(stack.pop(), ()):
            if parent_row < 0:
                sources[~parent_row] = None
            elif parent_row not in seen:
                seen.add(parent_row)
                stack.append(parent_row)
    return sources


MAX_PROPOSITIONS = 64
"""How many propositions an automaton reads at most."""

MAX_ROWS = 300_000
"""How many states an automaton has at most, and how many decisions."""

_OF_MOVES = {"_moves", "_above", "distances", "can_accept", "can_reject", "transitions", "is_listable"}
"""Properties of an automaton that depend on its moves alone."""

MAX_LISTED = 100_000
"""How many transitions are listed at most, and how many cubes their guards have together."""


@dataclass(frozen=True)
class Automaton(Displayed):
    """The least deterministic automaton of a formula over finite runs; equal ones accept the same runs.

    It has a move from every state for every symbol. State 0 stands before the first sample, and may be one
    that later samples lead to, too; the others are numbered by their distance from it.

    Attributes:
        name: what the specification calls it.
        propositions: what it reads of a sample; a *symbol* says of each whether it is true.
        accepting: the states in which a run that ends there satisfies the formula. No run ends before its
            first sample, so of state 0 it says something only if samples lead there.
        entries: for each state, the decision with which its moves begin; ~q leads to state q at once.
        decisions: (proposition, next where it is false, next where it is true); the next are as `entries`,
            and decide on later propositions.
    """

    name: str
    propositions: tuple[Proposition, ...]
    accepting: frozenset[int]
    entries: tuple[int, ...]
    decisions: tuple[tuple[int, int, int], ...]
    initial: int = 0

    @property
    def states(self) -> range:
        """The states' numbers."""
        return range(len(self.entries))

    @cached_property
    def transitions(self) -> tuple[Transition, ...]:
        """All moves, by source and target; the guards of one source exclude each other.

        Raises:
            NoAutomatonError: more than 100 000 transitions, or cubes of their guards; `iter_transitions`,
                `successors` and `transition` have them one by one.
        """
        transitions, cubes = [], 0
        for transition in self.iter_transitions():
            transitions.append(transition)
            cubes += len(transition.guard)
            if transition.is_cut or max(len(transitions), cubes) > MAX_LISTED:
                what = (
                    "transitions"
                    if len(transitions) > MAX_LISTED
                    else "cubes in the guards of its transitions"
                )
                raise NoAutomatonError(f"{self.name} has more than {MAX_LISTED} {what}")
        return tuple(transitions)

    @cached_property
    def is_listable(self) -> bool:
        """Whether `transitions` has them all, and raises no error."""
        # counted before the guards are worked out, which takes longer
        count = 0
        for state in self.states:
            count += len(self.successors[state])
            if count > MAX_LISTED:
                return False
        try:
            return bool(self.transitions)
        except NoAutomatonError:
            return False

    def iter_transitions(self) -> Iterator[Transition]:
        """Iterate over all moves, by source and target; each is worked out when it is consumed."""
        moves = self._moves
        return (
            moves.transition(state, target) for state in self.states for target in moves.successors(state)
        )

    @cached_property
    def successors(self) -> Sequence[tuple[int, ...]]:
        """For each state, those that one sample can lead to, in order; worked out when they are asked for."""
        return Successors(self._moves)

    @cached_property
    def has_returns(self) -> bool:
        """Whether samples lead to the initial state, so that runs end there."""
        before = ~self.initial
        return before in self.entries or any(before in (low, high) for _, low, high in self.decisions)

    @cached_property
    def can_accept(self) -> frozenset[int]:
        """The states from which acceptance has not been lost; the others are traps."""
        return frozenset(self.distances)

    @cached_property
    def distances(self) -> Mapping[int, int]:
        """For each state from which acceptance has not been lost, how many samples it takes at least."""
        return self._distances(self._ends(self.accepting))

    @cached_property
    def can_reject(self) -> frozenset[int]:
        """The states from which a run can still end in violation; the others accept permanently."""
        return frozenset(self._distances(self._ends(frozenset(self.states) - self.accepting)))

    def step(self, state: int, symbol: Sequence[bool]) -> int:
        """Return the state after a sample.

        Args:
            symbol: for each proposition, whether it is true.

        Raises:
            UsageError: no such state, or a symbol of another length.
        """
        self._check(state, symbol)
        place = self.entries[state]
        while place >= 0:
            proposition, low, high = self.decisions[place]
            place = high if symbol[proposition] else low
        return ~place

    def step_set(self, states: Collection[int], symbol: Sequence[bool | None]) -> frozenset[int]:
        """Return the states that may be reached after a sample from any of some states.

        Args:
            symbol: for each proposition, whether it is true; None where that is not known.

        Raises:
            UsageError: no such state, or a symbol of another length.
        """
        places = []
        for state in states:
            self._check(state, symbol)
            places.append(self.entries[state])
        visited = set(places)
        reached = set()
        while places:
            place = places.pop()
            if place < 0:
                reached.add(~place)
                continue
            proposition, low, high = self.decisions[place]
            value = symbol[proposition]
            for after in (low, high) if value is None else (high,) if value else (low,):
                if after not in visited:
                    visited.add(after)
                    places.append(after)
        return frozenset(reached)

    def accepts(self, symbols: Sequence[Sequence[bool]]) -> bool:
        """Return whether a run of at least one sample satisfies the formula.

        Raises:
            UsageError: no symbol, or one of another length.
        """
        if not symbols:
            raise UsageError("a run has at least one sample; give one symbol for each")
        state = self.initial
        for symbol in symbols:
            state = self.step(state, symbol)
        return state in self.accepting

    def transition(self, source: int, target: int) -> Transition | None:
        """Return the move from one state to another, if one sample can lead there."""
        is_move = source in self.states and target in self.successors[source]
        return self._moves.transition(source, target) if is_move else None

    def paths(
        self, state: int, without: Collection[tuple[int, int]] = ()
    ) -> Iterator[tuple[Transition, ...]]:
        """Yield the shortest paths from a state to an accepting one, each worked out when it is consumed.

        From an accepting state that is the empty path; there is none from a trap.

        Args:
            without: moves (source, target) that cannot be taken.

        Raises:
            UsageError: no such state.
        """
        self._check_state(state)
        left_out = set(without)
        distances = self._distances(self.accepting, left_out)
        if state not in distances:
            return
        paths: list[tuple[Transition, ...]] = [()]
        while paths:
            path = paths.pop()
            end = path[-1].target if path else state
            if distances[end] == 0:
                yield path
                continue
            nearer = [
                target
                for target in self.successors[end]
                if (end, target) not in left_out and distances.get(target) == distances[end] - 1
            ]
            paths.extend((*path, self._moves.transition(end, target)) for target in reversed(nearer))

    def guard_words(self, transition: Transition, longest: int | None = None) -> str:
        """Return a transition's guard as a sentence of the specification language.

        Args:
            longest: characters after which it is cut.
        """
        return guard_words(transition, self.propositions, longest)

    def renamed(self, propositions: Sequence[Proposition]) -> Automaton:
        """Return the automaton with other names for its propositions."""
        result = replace(self, propositions=tuple(propositions))
        # names change no move: what was worked out is kept
        result.__dict__.update({name: self.__dict__[name] for name in _OF_MOVES & self.__dict__.keys()})
        return result

    def _repr_svg_(self) -> str | None:
        return drawn_as_svg(self)

    def to_dot(self) -> str:
        """Return the automaton in the language of Graphviz; see `dot_hoa.dot_text`."""
        from spatial_replay.automata.text import dot_text

        return dot_text(self)

    def to_hoa(self) -> str:
        """Return the automaton in the Hanoi format for tools of automata theory; see `dot_hoa.hoa_text`."""
        from spatial_replay.automata.text import hoa_text

        return hoa_text(self)

    @cached_property
    def _moves(self) -> Moves:
        return Moves(self.entries, self.decisions)

    @cached_property
    def _above(self) -> dict[int, list[int]]:
        return above_of(self.entries, self.decisions)

    def _distances(self, goal: Collection[int], without: Collection[tuple[int, int]] = ()) -> dict[int, int]:
        """Return for each state that can reach a goal, how many samples that takes."""
        # moves that cannot be taken are few: where one begins, those that are left are looked up one by one
        left_out: dict[int, set[int]] = {}
        for source, target in without:
            if source in self.states:
                left_out.setdefault(source, set()).add(target)
        before: dict[int, list[int]] = {}
        for source, targets in left_out.items():
            for target in self.successors[source]:
                if target not in targets:
                    before.setdefault(target, []).append(source)
        distances = dict.fromkeys(sorted(goal), 0)
        waiting = list(distances)
        visited: set[int] = set()
        for state in waiting:
            direct = sources_of(self._above, (state,), visited)
            for source in (
                *(predecessor for predecessor in direct if predecessor not in left_out),
                *before.get(state, ()),
            ):
                if source not in distances:
                    distances[source] = distances[state] + 1
                    waiting.append(source)
        return distances

    def _ends(self, states: frozenset[int]) -> frozenset[int]:
        """Return those of some states in which a run can end."""
        return states if self.has_returns else states - {self.initial}

    def _check(self, state: int, symbol: Sequence[object]) -> None:
        self._check_state(state)
        if len(symbol) != len(self.propositions):
            count = len(self.propositions)
            raise UsageError(f"a symbol of {len(symbol)} values; there are {count} propositions")

    def _check_state(self, state: int) -> None:
        if state not in self.states:
            raise UsageError(f"no state {state!r}; there are 0 to {len(self.states) - 1}")


def automaton_of(machine: Machine, name: str, propositions: Sequence[Proposition]) -> Automaton:
    """Return a machine that is `least` as a value."""
    accepting = frozenset(np.flatnonzero(machine.accepting).tolist())
    decisions = tuple(map(tuple, machine.decisions.tolist()))
    return Automaton(name, tuple(propositions), accepting, tuple(machine.moves.tolist()), decisions)


FALSE, TRUE, UNKNOWN = 0, 1, -1
"""Values of propositions."""

StateSet: TypeAlias = NDArray[np.bool_]
"""(S,), which states a run may be in."""


@dataclass(frozen=True, eq=False)
class TransitionTable:
    """The moves of an automaton for the kernels.

    Attributes:
        entries: (S,), as in `Automaton`.
        decisions: (D, 3), as in `Automaton`.
    """

    entries: Integers
    decisions: Integers

    @classmethod
    def of(cls, automaton: Automaton) -> TransitionTable:
        """Return the table of an automaton."""
        decisions = np.array(automaton.decisions, np.int64).reshape(-1, 3)
        return cls(np.array(automaton.entries, np.int64), decisions)

    def states(self, state: int, values: Flags) -> Integers:
        """Return the state (T,) after each sample, where every proposition is known.

        Args:
            state: that before the first sample.
            values: (P, T), 0 or 1.
        """
        result = np.empty(values.shape[1], np.int64)
        _walk(self.entries, self.decisions, state, values, result)
        return result

    def state_sets(self, states: StateSet, values: Flags) -> NDArray[np.bool_]:
        """Return the states (T, S) that are possible after each sample.

        Args:
            states: (S,), those before the first sample.
            values: (P, T), 0, 1 or -1 where it is not known.
        """
        result = np.zeros((values.shape[1], len(self.entries)), np.bool_)
        _spread(self.entries, self.decisions, states, values, result)
        return result


@elementwise
@kernel
def _walk(entries: Integers, decisions: Integers, state: int, values: Flags, result: Integers) -> None:
    for t in range(values.shape[1]):
        place = entries[state]
        while place >= 0:
            place = decisions[place, 1 + values[decisions[place, 0], t]]
        state = ~place
        result[t] = state


@kernel
def _spread(
    entries: Integers, decisions: Integers, states: StateSet, values: Flags, result: NDArray[np.bool_]
) -> None:
    # the sample at which each decision was last visited: states share decisions, each is followed once
    visited = np.full(decisions.shape[0], -1, np.int64)
    stack = np.empty(decisions.shape[0] + 2, np.int64)
    before = states
    for t in range(values.shape[1]):
        after = result[t]
        for state in range(before.shape[0]):
            if not before[state]:
                continue
            stack[0] = entries[state]
            height = 1
            while height > 0:
                height -= 1
                place = stack[height]
                if place < 0:
                    after[~place] = True
                    continue
                if visited[place] == t:
                    continue
                visited[place] = t
                value = values[decisions[place, 0], t]
                if value != 1:
                    stack[height] = decisions[place, 1]
                    height += 1
                if value != 0:
                    stack[height] = decisions[place, 2]
                    height += 1
        before = after

"""Machines that the compilers produce, and their minimization."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.automata.guards import (
    LEAF,
    Diagrams,
)
from spatial_replay.geometry.arrays import Flags, Integers


@dataclass(frozen=True, eq=False)
class Machine:
    """A deterministic automaton with a move from every state for every symbol.

    A *place* is the index of a row of `decisions`, or ~q for state q.

    Attributes:
        moves: (S,), place of each state's first decision.
        decisions: (D, 3), rows (proposition, place if it is false, place if it is true). Rows at these places
            decide on later propositions and have smaller indices.
        accepting: (S,), whether each state accepts.
        start: place of the first decision of a run.
    """

    moves: Integers
    decisions: Integers
    accepting: Flags
    start: int

    @property
    def size(self) -> int:
        """Number of states plus number of decisions."""
        return len(self.moves) + len(self.decisions)


def machine_of(diagrams: Diagrams, moves: Sequence[int], accepting: Sequence[bool], start: int) -> Machine:
    """Convert moves, which are nodes of diagrams with states as leaves, into a machine."""
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


def merge_equivalent_states(machine: Machine) -> Machine:
    """Return a machine that accepts the same runs and has no equivalent states."""
    _, firsts, classes = np.unique(_split_classes(machine), return_index=True, return_inverse=True)
    places, decisions = _relabel(machine, classes)
    moves = places[machine.moves[firsts]]
    return Machine(moves, decisions, machine.accepting[firsts], int(places[machine.start]))


def least(machine: Machine) -> Machine:
    """Return the minimal automaton, whose state 0 is the state before the first sample.

    Machines that accept the same non-empty runs give equal automata, because states are numbered by their
    distance from state 0. Whether state 0 accepts is irrelevant, since no run is empty. So any state with
    the start's moves serves as state 0, preferably one that does not accept.
    """
    machine = merge_equivalent_states(machine)
    reachable = _reachable(machine)
    # compilers differ in their unreachable states, so these are dropped
    same = np.array([state for state in reachable if machine.moves[state] == machine.start], np.int64)
    if len(same):
        # argmin prefers False: a state that does not accept
        first = int(same[np.argmin(machine.accepting[same])])
    else:
        first = len(machine.moves)
        moves, accepting = np.append(machine.moves, machine.start), np.append(machine.accepting, False)
        machine = Machine(moves, machine.decisions, accepting, machine.start)
    return _select_states(machine, [first, *(state for state in reachable if state != first)])


def _reachable(machine: Machine) -> list[int]:
    """Return the reachable states by distance; at equal distance, false branches come before true ones."""
    moves, rows = machine.moves.tolist(), machine.decisions.tolist()
    order: dict[int, None] = {}
    waiting: list[int] = []
    # a decision that was visited leads to no new state
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
    """Return the machine of only these states, in this order.

    No move of these states may lead to any other state.
    """
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
    """Renumber the states, and merge decisions that become equal.

    Returns:
        The new place of each old place, (D + S,), and the new decisions. A negative place ~q indexes the
        array from its end.
    """
    decisions = machine.decisions
    places = np.concatenate([np.empty(len(decisions), np.int64), ~numbers[::-1]])
    span = len(places) + 1
    levels: list[Integers] = []
    count = 0
    # rows of later propositions first, because rows of earlier propositions refer to them
    for rows in _levels(decisions):
        variable = decisions[rows[0], 0]
        low, high = places[decisions[rows, 1]], places[decisions[rows, 2]]
        places[rows] = low
        differ = low != high
        # each pair of places as one integer; places of states are negative, hence the span
        keys = (low[differ] + span) * (2 * span) + high[differ] + span
        kinds, firsts, inverse = np.unique(keys, return_index=True, return_inverse=True)
        places[rows[differ]] = count + inverse.ravel()
        level = np.empty((len(kinds), 3), np.int64)
        level[:, 0], level[:, 1], level[:, 2] = variable, low[differ][firsts], high[differ][firsts]
        levels.append(level)
        count += len(kinds)
    return places, np.concatenate(levels) if levels else np.empty((0, 3), np.int64)


def _levels(decisions: Integers) -> Iterator[Integers]:
    """Yield the rows of each proposition, from the last proposition to the first."""
    if not len(decisions):
        return
    order = np.argsort(-decisions[:, 0], kind="stable")
    bounds = np.flatnonzero(np.diff(decisions[order, 0])) + 1
    yield from np.split(order, bounds)


def _split_classes(machine: Machine) -> list[int]:
    """Return the equivalence class of each state.

    States of one class accept the same runs, including the empty run. Classes are split until the moves of
    all members of a class lead to the same classes. The largest part of a class keeps its number, so that
    few states are checked again (Hopcroft, 1971).
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

        # the default binds the dictionary of this round
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
    """Split classes into their parts, and return the states with a new class.

    The largest part of a class keeps the number of the class.
    """
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
    """Return the parents of each place: indices of rows, and ~q for a state q whose moves begin there."""
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
    """Return the predecessors of the targets: the states from which one sample can lead to a target.

    Args:
        above: result of `above_of`.
        visited: rows to skip; rows that are followed are added to this set.
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

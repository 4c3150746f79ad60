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
        decisions: (D, 3), rows (proposition, next place if the proposition is false, next place if it is
            true). The next row decides on a later proposition and has a smaller index.
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
    places_by_node: list[int] = []
    decision_rows: list[tuple[int, int, int]] = []
    for node in range(len(diagrams)):
        variable, if_false, if_true = diagrams[node]
        if variable == LEAF:
            places_by_node.append(~if_false)
        else:
            places_by_node.append(len(decision_rows))
            decision_rows.append((variable, places_by_node[if_false], places_by_node[if_true]))
    return _machine([places_by_node[node] for node in moves], decision_rows, accepting, places_by_node[start])


def _machine(
    moves: Sequence[int], decision_rows: Sequence[tuple[int, int, int]], accepting: Sequence[bool], start: int
) -> Machine:
    decisions = np.array(decision_rows, np.int64).reshape(-1, 3)
    return Machine(np.array(moves, np.int64), decisions, np.array(accepting, np.bool_), start)


def merge_equivalent_states(machine: Machine) -> Machine:
    """Return a machine that accepts the same runs and has no equivalent states."""
    _, class_members, classes = np.unique(_split_classes(machine), return_index=True, return_inverse=True)
    new_places, decisions = _relabel(machine, classes)
    moves = new_places[machine.moves[class_members]]
    return Machine(moves, decisions, machine.accepting[class_members], int(new_places[machine.start]))


def least(machine: Machine) -> Machine:
    """Return the minimal automaton, whose state 0 is the state before the first sample.

    Machines that accept the same non-empty runs give equal automata, because states are numbered by their
    distance from state 0. Acceptance of state 0 is irrelevant, since no run is empty. Any state with the
    start's moves can serve as state 0; a state that does not accept is preferred.
    """
    machine = merge_equivalent_states(machine)
    reachable = _reachable(machine)
    # compilers differ in their unreachable states, so these are dropped
    start_states = np.array([state for state in reachable if machine.moves[state] == machine.start], np.int64)
    if len(start_states):
        # argmin finds a state that does not accept, if there is one
        start_state = int(start_states[np.argmin(machine.accepting[start_states])])
    else:
        start_state = len(machine.moves)
        moves, accepting = np.append(machine.moves, machine.start), np.append(machine.accepting, False)
        machine = Machine(moves, machine.decisions, accepting, machine.start)
    return _select_states(machine, [start_state, *(state for state in reachable if state != start_state)])


def _reachable(machine: Machine) -> list[int]:
    """Return the reachable states, sorted by distance, then false branches before true branches."""
    moves, decision_rows = machine.moves.tolist(), machine.decisions.tolist()
    visited_states: dict[int, None] = {}
    states: list[int] = []
    # a decision that was visited leads to no new state
    visited_rows = [False] * len(decision_rows)
    stack = [machine.start]
    expanded_count = 0
    while stack:
        place = stack.pop()
        if place < 0:
            if ~place not in visited_states:
                visited_states[~place] = None
                states.append(~place)
        elif not visited_rows[place]:
            visited_rows[place] = True
            _, if_false, if_true = decision_rows[place]
            stack += (if_true, if_false)
        if not stack and expanded_count < len(states):
            stack.append(moves[states[expanded_count]])
            expanded_count += 1
    return states


def _select_states(machine: Machine, states: Sequence[int]) -> Machine:
    """Restrict a machine to `states`, and number them in this order.

    The moves of `states` may only lead to `states`.
    """
    new_numbers = {state: number for number, state in enumerate(states)}
    decision_rows = machine.decisions.tolist()
    new_places: dict[int, int] = {}
    decisions: list[tuple[int, int, int]] = []

    def place(old_place: int) -> int:
        if old_place < 0:
            return ~new_numbers[~old_place]
        new_place = new_places.get(old_place)
        if new_place is None:
            variable, if_false, if_true = decision_rows[old_place]
            row = (variable, place(if_false), place(if_true))
            new_place = new_places[old_place] = len(decisions)
            decisions.append(row)
        return new_place

    moves = [place(old_place) for old_place in machine.moves[np.array(states, np.int64)].tolist()]
    start = place(machine.start)
    return _machine(moves, decisions, machine.accepting[np.array(states, np.int64)].tolist(), start)


def _relabel(machine: Machine, new_numbers: Integers) -> tuple[Integers, Integers]:
    """Renumber the states, and merge decisions that become equal.

    Returns:
        The new place of each old place, (D + S,), and the new decisions. A negative place ~q indexes the
        array from its end.
    """
    decisions = machine.decisions
    places = np.concatenate([np.empty(len(decisions), np.int64), ~new_numbers[::-1]])
    place_span = len(places) + 1
    levels: list[Integers] = []
    decision_count = 0
    # rows of later propositions first, because rows of earlier propositions refer to them
    for level_rows in _levels(decisions):
        variable = decisions[level_rows[0], 0]
        if_false, if_true = places[decisions[level_rows, 1]], places[decisions[level_rows, 2]]
        places[level_rows] = if_false
        is_needed = if_false != if_true
        # each pair of places becomes one integer; the span shifts the negative places of states
        pair_keys = (if_false[is_needed] + place_span) * (2 * place_span) + if_true[is_needed] + place_span
        distinct_keys, first_rows, key_ranks = np.unique(pair_keys, return_index=True, return_inverse=True)
        places[level_rows[is_needed]] = decision_count + key_ranks.ravel()
        level = np.empty((len(distinct_keys), 3), np.int64)
        level[:, 0], level[:, 1], level[:, 2] = (
            variable,
            if_false[is_needed][first_rows],
            if_true[is_needed][first_rows],
        )
        levels.append(level)
        decision_count += len(distinct_keys)
    return places, np.concatenate(levels) if levels else np.empty((0, 3), np.int64)


def _levels(decisions: Integers) -> Iterator[Integers]:
    """Yield the rows of each proposition, from the last proposition to the first."""
    if not len(decisions):
        return
    row_order = np.argsort(-decisions[:, 0], kind="stable")
    level_starts = np.flatnonzero(np.diff(decisions[row_order, 0])) + 1
    yield from np.split(row_order, level_starts)


def _split_classes(machine: Machine) -> list[int]:
    """Return the equivalence class of each state.

    States of one class accept the same runs, including the empty run. Classes are split until the moves of
    all members of a class lead to the same classes. The largest part of a class keeps the class's number, so
    that few states are checked again (Hopcroft, 1971).
    """
    moves, decision_rows = machine.moves.tolist(), machine.decisions.tolist()
    classes: list[int] = machine.accepting.astype(np.int64).tolist()
    class_parts: list[dict[int, set[int]]] = [{}, {}]
    node_by_state: dict[int, int] = {}
    parents = above_of(moves, decision_rows)
    diagrams = Diagrams()
    pending_states: Collection[int] = range(len(classes))
    while pending_states:
        copies: dict[int, int] = {}

        # the default binds the dictionary of this round
        def copy(place: int, copies: dict[int, int] = copies) -> int:
            if place < 0:
                return diagrams.leaf(classes[~place])
            if place not in copies:
                variable, if_false, if_true = decision_rows[place]
                copies[place] = diagrams.decide(variable, copy(if_false), copy(if_true))
            return copies[place]

        for state in pending_states:
            parts_of_class = class_parts[classes[state]]
            if state in node_by_state:
                parts_of_class[node_by_state[state]].remove(state)
                if not parts_of_class[node_by_state[state]]:
                    del parts_of_class[node_by_state[state]]
            node_by_state[state] = copy(moves[state])
            parts_of_class.setdefault(node_by_state[state], set()).add(state)
        changed_states = _split(
            class_parts, classes, dict.fromkeys(classes[state] for state in pending_states)
        )
        pending_states = sources_of(parents, changed_states)
    return classes


def _split(
    class_parts: list[dict[int, set[int]]], classes: list[int], candidates: Iterable[int]
) -> list[int]:
    """Split classes into their parts, and return the states with a new class.

    The largest part of a class keeps the number of the class.
    """
    changed_states: list[int] = []
    for class_number in candidates:
        parts_of_class = class_parts[class_number]
        largest = max(parts_of_class, key=lambda node: len(parts_of_class[node]))
        for node in [part for part in parts_of_class if part != largest]:
            members = parts_of_class.pop(node)
            for state in members:
                classes[state] = len(class_parts)
            class_parts.append({node: members})
            changed_states += sorted(members)
    return changed_states


def above_of(moves: Sequence[int], rows: Iterable[Sequence[int]]) -> dict[int, list[int]]:
    """Return the parents of each place: decisions by index, and ~q for a state q whose moves begin there."""
    parents: dict[int, list[int]] = {}
    for row_number, (_, if_false, if_true) in enumerate(rows):
        parents.setdefault(if_false, []).append(row_number)
        parents.setdefault(if_true, []).append(row_number)
    for state, place in enumerate(moves):
        parents.setdefault(place, []).append(~state)
    return parents


def sources_of(
    above: dict[int, list[int]], targets: Iterable[int], visited: set[int] | None = None
) -> dict[int, None]:
    """Return the predecessors of the targets: the states from which one sample can lead to a target.

    Args:
        above: result of `above_of`.
        visited: decisions to skip; the function adds the decisions that it follows.
    """
    sources: dict[int, None] = {}
    visited_rows = set() if visited is None else visited
    pending_places = [~target for target in targets]
    while pending_places:
        for parent_row in above.get(pending_places.pop(), ()):
            if parent_row < 0:
                sources[~parent_row] = None
            elif parent_row not in visited_rows:
                visited_rows.add(parent_row)
                pending_places.append(parent_row)
    return sources

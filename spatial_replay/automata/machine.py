"""Automata as compilers give them, and the least one that accepts the same runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from spatial_replay.automata.diagrams import LEAF, Diagrams, copied


@dataclass(frozen=True, eq=False)
class Machine:
    """A deterministic automaton with a move from every state for every symbol.

    Attributes:
        moves: for each state, the node of the diagram with the states that its moves lead to.
        accepting: for each state.
        start: the node with the states that the first sample of a run leads to.
    """

    diagrams: Diagrams
    moves: tuple[int, ...]
    accepting: tuple[bool, ...]
    start: int


def least(machine: Machine) -> Machine:
    """The automaton with the fewest states, one of them, 0, for a run that has not begun.

    Two machines that accept the same runs of at least one sample give equal ones: states are numbered by
    their distance from the first one. No run is empty, so that may be any state with the same moves, and one
    that does not accept if there is a choice.
    """
    machine = _renumbered(machine, _reachable(machine, machine.start))
    classes = _classes(machine)
    diagrams = Diagrams()
    copy = _relabelled(machine, diagrams, classes)
    moves = [0] * len(set(classes))
    accepting = [False] * len(moves)
    for state, number in enumerate(classes):
        moves[number] = copy(machine.moves[state])
        accepting[number] = machine.accepting[state]
    start = copy(machine.start)
    first = _first(moves, accepting, start)
    joined = Machine(diagrams, tuple(moves), tuple(accepting), start)
    others = [state for state in _reachable(joined, start) if state != first]
    return _renumbered(joined, [first, *others])


def _classes(machine: Machine) -> list[int]:
    """For each state the number of its class: which runs from it on are accepted, the empty one included."""
    classes = _told_apart(machine)
    count = len(set(classes))
    while True:
        copy = _relabelled(machine, Diagrams(), classes)
        numbers: dict[tuple[int, int], int] = {}
        signatures = list(zip(classes, map(copy, machine.moves), strict=True))
        classes = [numbers.setdefault(signature, len(numbers)) for signature in signatures]
        if len(numbers) == count:
            return classes
        count = len(numbers)


def _told_apart(machine: Machine) -> list[int]:
    """For each state a number, equal for all states of a class, and other ones where that is soon seen.

    That is how far it is to acceptance and rejection, and to where either is for good. Along a chain of
    states, refining classes step by step would take as many steps as the chain is long.
    """
    before: list[list[int]] = [[] for _ in machine.moves]
    for state, node in enumerate(machine.moves):
        for target in leaves_of(machine.diagrams, node):
            before[target].append(state)
    columns = []
    for accepts in (False, True):
        goal = [state for state, accepting in enumerate(machine.accepting) if accepting == accepts]
        distances = _distances(before, goal)
        out_of_reach = [state for state, distance in enumerate(distances) if distance < 0]
        columns += [distances, _distances(before, out_of_reach)]
    numbers: dict[tuple[int, ...], int] = {}
    return [numbers.setdefault(row, len(numbers)) for row in zip(*columns, strict=True)]


def _distances(before: list[list[int]], goal: list[int]) -> list[int]:
    """For each state how many samples it takes at least to a goal; -1 where none leads there."""
    distances = [-1] * len(before)
    for state in goal:
        distances[state] = 0
    waiting = list(goal)
    for state in waiting:
        for source in before[state]:
            if distances[source] < 0:
                distances[source] = distances[state] + 1
                waiting.append(source)
    return distances


def _first(moves: list[int], accepting: list[bool], start: int) -> int:
    """A state that moves as a run begins, one more if there is none."""
    same = [state for state, node in enumerate(moves) if node == start]
    if not same:
        moves.append(start)
        accepting.append(False)
        return len(moves) - 1
    return min(same, key=lambda state: accepting[state])


def _reachable(machine: Machine, start: int) -> list[int]:
    """The states that a node leads to in the end: the nearer ones first, then as false comes before true."""
    order = dict.fromkeys(leaves_of(machine.diagrams, start))
    waiting = list(order)
    for state in waiting:
        for target in leaves_of(machine.diagrams, machine.moves[state]):
            if target not in order:
                order[target] = None
                waiting.append(target)
    return waiting


def _renumbered(machine: Machine, states: Sequence[int]) -> Machine:
    """Only some states, in the order given; no move leads to another."""
    numbers = {state: number for number, state in enumerate(states)}
    diagrams = Diagrams()
    copy = _relabelled(machine, diagrams, numbers)
    return Machine(
        diagrams,
        tuple(copy(machine.moves[state]) for state in states),
        tuple(machine.accepting[state] for state in states),
        copy(machine.start),
    )


def _relabelled(
    machine: Machine, diagrams: Diagrams, numbers: Mapping[int, int] | Sequence[int]
) -> Callable[[int], int]:
    """A function that copies nodes into other diagrams, with other numbers for the states."""
    return copied(machine.diagrams, diagrams, LEAF, lambda node: numbers[machine.diagrams[node].low])


def leaves_of(diagrams: Diagrams, node: int) -> list[int]:
    """The leaves below a node, in the order of the decisions, false before true."""
    return [diagrams[each].low for each in nodes_of(diagrams, node) if diagrams[each].variable == LEAF]


def nodes_of(diagrams: Diagrams, node: int) -> list[int]:
    """A node and those below it, in the order of the decisions, false before true."""
    seen: dict[int, None] = {}
    stack = [node]
    while stack:
        each = stack.pop()
        if each in seen:
            continue
        seen[each] = None
        variable, low, high = diagrams[each]
        if variable != LEAF:
            stack += [high, low]
    return list(seen)

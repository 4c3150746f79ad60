"""Minimisation: automata as compilers produce them, and the smallest one that accepts the same runs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
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
    """Return the automaton with the fewest states, one of them, 0, for a run that has not begun.

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
    """Return the class of each state: states of one class accept the same runs, the empty one included.

    Classes are split until the moves of all members lead to the same ones. The largest part of a class keeps
    its number, so that few states have to be checked again (Hopcroft, 1971).
    """
    classes = [int(accepts) for accepts in machine.accepting]
    # the members of each class, by where their moves lead to
    parts: list[dict[int, set[int]]] = [{}, {}]
    leading: dict[int, int] = {}
    before = _before(machine)
    diagrams = Diagrams()
    pending: Collection[int] = range(len(classes))
    while pending:
        copy = _relabelled(machine, diagrams, classes)
        for state in pending:
            own = parts[classes[state]]
            if state in leading:
                own[leading[state]].remove(state)
                if not own[leading[state]]:
                    del own[leading[state]]
            leading[state] = copy(machine.moves[state])
            own.setdefault(leading[state], set()).add(state)
        moved = _split(parts, classes, dict.fromkeys(classes[state] for state in pending))
        pending = dict.fromkeys(source for state in moved for source in before[state])
    numbers: dict[int, int] = {}
    return [numbers.setdefault(each, len(numbers)) for each in classes]


def _split(parts: list[dict[int, set[int]]], classes: list[int], touched: Iterable[int]) -> list[int]:
    """Make all parts of some classes but the largest classes of their own; gives the states in these."""
    moved: list[int] = []
    for number in touched:
        own = parts[number]
        largest = max(own, key=lambda node: len(own[node]))
        for node in [each for each in own if each != largest]:
            members = own.pop(node)
            for state in members:
                classes[state] = len(parts)
            parts.append({node: members})
            moved += sorted(members)
    return moved


def _before(machine: Machine) -> list[list[int]]:
    """Return for each state those from which a sample can lead to it."""
    before: list[list[int]] = [[] for _ in machine.moves]
    for state, node in enumerate(machine.moves):
        for target in leaves_of(machine.diagrams, node):
            before[target].append(state)
    return before


def _first(moves: list[int], accepting: list[bool], start: int) -> int:
    """Return a state that moves as a run begins, one more if there is none."""
    same = [state for state, node in enumerate(moves) if node == start]
    if not same:
        moves.append(start)
        accepting.append(False)
        return len(moves) - 1
    return min(same, key=lambda state: accepting[state])


def _reachable(machine: Machine, start: int) -> list[int]:
    """Return the states that can be reached from a node: nearer ones first, then false before true."""
    order = dict.fromkeys(leaves_of(machine.diagrams, start))
    waiting = list(order)
    for state in waiting:
        for target in leaves_of(machine.diagrams, machine.moves[state]):
            if target not in order:
                order[target] = None
                waiting.append(target)
    return waiting


def _renumbered(machine: Machine, states: Sequence[int]) -> Machine:
    """Return only some states, in the order given; no move leads to another."""
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
    """Return a function that copies nodes into other diagrams, with other numbers for the states."""
    return copied(machine.diagrams, diagrams, LEAF, lambda node: numbers[machine.diagrams[node].low])


def leaves_of(diagrams: Diagrams, node: int) -> list[int]:
    """Return the leaves below a node, in the order of the decisions, false before true."""
    return [diagrams[each].low for each in nodes_of(diagrams, node) if diagrams[each].variable == LEAF]


def nodes_of(diagrams: Diagrams, node: int) -> list[int]:
    """Return a node and those below it, in the order of the decisions, false before true."""
    visited: dict[int, None] = {}
    stack = [node]
    while stack:
        each = stack.pop()
        if each in visited:
            continue
        visited[each] = None
        variable, low, high = diagrams[each]
        if variable != LEAF:
            stack += [high, low]
    return list(visited)

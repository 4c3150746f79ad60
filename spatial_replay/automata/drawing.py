"""Places for the states of an automaton in a drawing: the same for equal automata, whatever a run does."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.dot_hoa import LONGEST_GUARD, MOST_MOVES, MOST_STATES, size_words, state_words

_SWEEPS: Final = 4


class DrawnState(NamedTuple):
    """A state in a drawing.

    Attributes:
        about: the verdict of a run that ends there, in words.
        is_lost: whether acceptance is out of reach from there.
        is_won: whether rejection is.
        distance: samples that it takes at least to reach acceptance; None if that is lost.
    """

    number: int
    column: int
    row: float
    about: str
    is_accepting: bool
    is_lost: bool
    is_won: bool
    distance: int | None


class DrawnMove(NamedTuple):
    """A transition in a drawing, with its guard in words."""

    source: int
    target: int
    guard: str


class AutomatonDrawing(NamedTuple):
    """An automaton as it is drawn.

    Attributes:
        summary: its size in words.
        left_out: how many states are not drawn.
    """

    summary: str
    states: tuple[DrawnState, ...]
    moves: tuple[DrawnMove, ...]
    left_out: int


def draw_automaton(automaton: Automaton, visited: Collection[int] = ()) -> AutomatonDrawing:
    """Place the states of an automaton; of a large one the visited ones, then those nearest to the start.

    Args:
        visited: states whose moves come first, where there are too many.
    """
    first = {automaton.initial, *visited}
    others = [state for state in automaton.states if state not in first]
    shown = sorted([*sorted(first), *others][:MOST_STATES])
    places = _places(automaton, shown)
    distances = automaton.distances
    ends = [(each, to) for each in shown for to in automaton.successors[each] if to in places]
    ends.sort(key=lambda move: move[0] not in first)
    moves = [move for each in ends[:MOST_MOVES] if (move := automaton.transition(*each)) is not None]
    return AutomatonDrawing(
        size_words(automaton),
        tuple(
            DrawnState(
                state,
                *places[state],
                state_words(automaton, state),
                state in automaton.accepting,
                state not in automaton.can_accept,
                state not in automaton.can_reject,
                distances.get(state),
            )
            for state in shown
        ),
        tuple(
            DrawnMove(move.source, move.target, automaton.guard_words(move, LONGEST_GUARD)) for move in moves
        ),
        len(automaton.states) - len(shown),
    )


def guard_of(automaton: Automaton, move: DrawnMove) -> str:
    """Return the guard of a move in words, as this automaton names its propositions; it has the move."""
    found = automaton.transition(move.source, move.target)
    return "" if found is None else automaton.guard_words(found, LONGEST_GUARD)


def _places(automaton: Automaton, shown: Sequence[int]) -> Mapping[int, tuple[int, float]]:
    """Return column and row of each state: columns follow the transitions, rows make few of them cross."""
    kept = set(shown)
    successors = {state: [each for each in automaton.successors[state] if each in kept] for state in shown}
    column = _columns(successors, automaton.initial)
    layers = [[state for state in shown if column[state] == each] for each in range(max(column.values()) + 1)]
    row = {state: height for layer in layers for state, height in _heights(layer)}
    for _ in range(_SWEEPS):
        for layer in layers[1:]:
            aims = {state: _middle(row, successors, state) for state in layer}
            layer.sort(key=lambda state: (aims[state], state))
            row |= dict(_heights(layer))
    return {state: (column[state], row[state]) for state in shown}


def _columns(successors: Mapping[int, Sequence[int]], initial: int) -> Mapping[int, int]:
    """Return for each state the longest way there, in transitions that do not lead back."""
    ended: list[int] = []
    on_way: set[int] = set()
    back: set[tuple[int, int]] = set()
    for root in [initial, *successors]:
        stack = [] if root in ended else [(root, iter(successors[root]))]
        on_way.update(state for state, _ in stack)
        while stack:
            state, targets = stack[-1]
            target = next(targets, None)
            if target is None:
                stack.pop()
                on_way.discard(state)
                ended.append(state)
            elif target in on_way:
                back.add((state, target))
            elif target not in ended:
                on_way.add(target)
                stack.append((target, iter(successors[target])))
    column = dict.fromkeys(successors, 0)
    for state in reversed(ended):
        for target in successors[state]:
            if (state, target) not in back:
                column[target] = max(column[target], column[state] + 1)
    return column


def _heights(layer: Sequence[int]) -> Iterator[tuple[int, float]]:
    """Yield the states of a column with their rows, around the middle."""
    for place, state in enumerate(layer):
        yield state, place - (len(layer) - 1) / 2.0


def _middle(row: Mapping[int, float], successors: Mapping[int, Sequence[int]], state: int) -> float:
    """Return the mean row of the states that lead to one, or its own."""
    found = [row[each] for each, targets in successors.items() if each != state and state in targets]
    return sum(found) / len(found) if found else row[state]

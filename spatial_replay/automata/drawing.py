"""Drawings of automata: by Graphviz, and as positions of states and transitions."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from spatial_replay.automata.automaton import (
    LONGEST_GUARD,
    MOST_MOVES,
    MOST_STATES,
    Automaton,
    digraph_text,
    size_words,
    state_words,
)
from spatial_replay.errors import OutputError, UsageError

_DRAWING_S = 120.0
"""Time limit of Graphviz, s."""


def svg_text(automaton: Automaton) -> str:
    """Return the automaton drawn by Graphviz.

    Raises:
        UsageError: Graphviz is not installed.
        OutputError: Graphviz fails, or takes too long.
    """
    return _graphviz(automaton, automaton.to_dot(), "svg")


def layout_text(automaton: Automaton) -> str:
    """Return Graphviz's positions of states and arrows as JSON, without a legend.

    Raises:
        UsageError, OutputError: as `svg_text`.
    """
    # json0 leaves out the drawing operations of json (https://graphviz.org/docs/outputs/json/)
    return _graphviz(automaton, digraph_text(automaton), "json0")


def _graphviz(automaton: Automaton, dot_text: str, output_format: str) -> str:
    executable = shutil.which("dot")
    if executable is None:
        raise UsageError(
            "drawing an automaton takes Graphviz, which is not installed: apt-get install graphviz; "
            "or write it as text to a file that ends in .dot"
        )
    try:
        command = [executable, f"-T{output_format}"]
        process = subprocess.run(
            command, input=dot_text.encode(), capture_output=True, timeout=_DRAWING_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise OutputError(
            f"Graphviz did not draw {len(automaton.states)} states and {len(automaton.transitions)} "
            f"transitions within {_DRAWING_S:g} s; write them as text to a file that ends in .dot"
        ) from None
    if process.returncode != 0:
        reason = process.stderr.decode(errors="replace").strip()[:200]
        raise OutputError(f"Graphviz ended with code {process.returncode}: {reason}")
    return process.stdout.decode()


_SWEEPS: Final = 4
"""Number of passes that reorder the rows of all columns."""


class DrawnState(NamedTuple):
    """A state in a drawing.

    Attributes:
        about: verdict of a run that ends in the state, in words.
        is_lost: whether acceptance is unreachable.
        is_won: whether rejection is unreachable.
        distance: least number of samples to acceptance; None if acceptance is unreachable.
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
    """A drawing of an automaton.

    Attributes:
        summary: size of the automaton, in words.
        left_out: number of states that are not drawn.
    """

    summary: str
    states: tuple[DrawnState, ...]
    moves: tuple[DrawnMove, ...]
    left_out: int


def draw_automaton(automaton: Automaton, visited: Collection[int] = ()) -> AutomatonDrawing:
    """Place the states of an automaton.

    A large automaton is cut to `MOST_STATES` states: first the visited states, then the states nearest to
    the start.

    Args:
        visited: states that a cut drawing includes first, with their transitions.
    """
    first_states = {automaton.initial, *visited}
    other_states = [state for state in automaton.states if state not in first_states]
    drawn_states = sorted([*sorted(first_states), *other_states][:MOST_STATES])
    positions = _places(automaton, drawn_states)
    distances = automaton.distances
    state_pairs = [
        (source, target)
        for source in drawn_states
        for target in automaton.successors[source]
        if target in positions
    ]
    state_pairs.sort(key=lambda pair: pair[0] not in first_states)
    moves = [
        move
        for state_pair in state_pairs[:MOST_MOVES]
        if (move := automaton.transition(*state_pair)) is not None
    ]
    return AutomatonDrawing(
        size_words(automaton),
        tuple(
            DrawnState(
                state,
                *positions[state],
                state_words(automaton, state),
                state in automaton.accepting,
                state not in automaton.can_accept,
                state not in automaton.can_reject,
                distances.get(state),
            )
            for state in drawn_states
        ),
        tuple(
            DrawnMove(move.source, move.target, automaton.guard_words(move, LONGEST_GUARD)) for move in moves
        ),
        len(automaton.states) - len(drawn_states),
    )


def guard_of(automaton: Automaton, move: DrawnMove) -> str:
    """Return the guard of a drawn transition, with this automaton's names of the propositions."""
    transition = automaton.transition(move.source, move.target)
    return "" if transition is None else automaton.guard_words(transition, LONGEST_GUARD)


def _places(automaton: Automaton, drawn_states: Sequence[int]) -> Mapping[int, tuple[int, float]]:
    """Return the column and row of each state.

    Columns follow the transitions. The barycentre heuristic orders the rows, so that few transitions cross
    (Sugiyama, Tagawa and Toda, 1981).
    """
    state_set = set(drawn_states)
    successors = {
        state: [successor for successor in automaton.successors[state] if successor in state_set]
        for state in drawn_states
    }
    column_by_state = _columns(successors, automaton.initial)
    layers = [
        [state for state in drawn_states if column_by_state[state] == column_number]
        for column_number in range(max(column_by_state.values()) + 1)
    ]
    row_by_state = {state: layer_row for layer in layers for state, layer_row in _heights(layer)}
    for _ in range(_SWEEPS):
        for layer in layers[1:]:
            mean_rows = {state: _middle(row_by_state, successors, state) for state in layer}
            layer.sort(key=lambda state: (mean_rows[state], state))
            row_by_state |= dict(_heights(layer))
    return {state: (column_by_state[state], row_by_state[state]) for state in drawn_states}


def _columns(successors: Mapping[int, Sequence[int]], initial: int) -> Mapping[int, int]:
    """Return the length of the longest path to each state, without back edges."""
    # lists suffice, because a drawing has at most `MOST_STATES` states
    finished_states: list[int] = []
    path_states: set[int] = set()
    back_edges: set[tuple[int, int]] = set()
    for root in [initial, *successors]:
        stack = [] if root in finished_states else [(root, iter(successors[root]))]
        path_states.update(state for state, _ in stack)
        while stack:
            state, targets = stack[-1]
            target = next(targets, None)
            if target is None:
                stack.pop()
                path_states.discard(state)
                finished_states.append(state)
            elif target in path_states:
                back_edges.add((state, target))
            elif target not in finished_states:
                path_states.add(target)
                stack.append((target, iter(successors[target])))
    column_by_state = dict.fromkeys(successors, 0)
    for state in reversed(finished_states):
        for target in successors[state]:
            if (state, target) not in back_edges:
                column_by_state[target] = max(column_by_state[target], column_by_state[state] + 1)
    return column_by_state


def _heights(layer: Sequence[int]) -> Iterator[tuple[int, float]]:
    """Yield the states of a column with rows centred on 0."""
    for position, state in enumerate(layer):
        yield state, position - (len(layer) - 1) / 2.0


def _middle(row_by_state: Mapping[int, float], successors: Mapping[int, Sequence[int]], state: int) -> float:
    """Return the mean row of a state's predecessors; the state's own row if it has no predecessor."""
    rows_before = [
        row_by_state[source] for source, targets in successors.items() if source != state and state in targets
    ]
    return sum(rows_before) / len(rows_before) if rows_before else row_by_state[state]

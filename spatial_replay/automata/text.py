"""Automata as text: words, DOT and the Hanoi format, and where drawings put the states."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from textwrap import wrap
from typing import TYPE_CHECKING, Final, NamedTuple

from spatial_replay.automata.guards import Transition
from spatial_replay.errors import OutputError, UsageError
from spatial_replay.palette import NEGATIVE, POSITIVE, hexadecimal, light
from spatial_replay.text import counted

if TYPE_CHECKING:
    from spatial_replay.automata.automaton import Automaton


MOST_STATES = 60
"""States that a drawing shows at most, and a text of an automaton whose transitions cannot all be listed."""
MOST_MOVES = 300
LONGEST_GUARD = 300
"""The most moves there, and characters of a guard."""
_DRAWING_S = 120.0
"""Seconds that Graphviz may take."""
_LONGEST_LABEL = 12
"""Characters of a proposition that stands on an arrow as it is."""
_WIDTH = 20
"""Characters after which a label of an arrow goes on in a new line."""
_LEGEND_WIDTH = 100
"""Characters of a line below a drawing."""


def words_text(automaton: Automaton) -> str:
    """Describe states, what they mean, and their moves in words.

    If not all transitions can be listed, it has the states nearest to the start.
    """
    lines = [f"automaton of {automaton.name}: {size_words(automaton)}"]
    lines += [
        f"  {proposition.name} means {proposition.text}"
        for proposition in automaton.propositions
        if proposition.name is not None
    ]
    for state, transitions in _by_source(automaton).items():
        lines.append(f"  state {state}: {state_words(automaton, state)}")
        for transition in transitions:
            to = "stays" if transition.target == state else f"to {transition.target}"
            lines.append(f"    {to} if {_guard_text(automaton, transition)}")
    if not automaton.is_listable:
        lines.append(f"  … {_left_out(automaton)}")
    return "\n".join(lines)


def size_words(automaton: Automaton) -> str:
    """Return its size: "33 states, 6 propositions"."""
    return f"{counted(len(automaton.states), 'state')}, {counted(len(automaton.propositions), 'proposition')}"


def state_words(automaton: Automaton, state: int) -> str:
    """Return the verdict of a run that ends in a state, and whether it can change."""
    begins = "start, " if state == automaton.initial else ""
    if state == automaton.initial and not automaton.has_returns:
        return f"{begins}before the first sample"
    now = "accepting" if state in automaton.accepting else "not accepting"
    if state not in automaton.can_reject:
        now = "accepting permanently"
    elif state not in automaton.can_accept:
        now = "a trap: acceptance is lost"
    return begins + now


def state_colour(automaton: Automaton, state: int) -> str:
    """Return a state's fill: light blue if it accepts permanently, light vermillion if it is a trap."""
    if state not in automaton.can_reject:
        return hexadecimal(light(POSITIVE))
    return "#ffffff" if state in automaton.can_accept else hexadecimal(light(NEGATIVE))


def abbreviated(automaton: Automaton) -> Automaton:
    """Return the automaton with short names for long propositions, as fit on arrows."""
    labels = {proposition.label for proposition in automaton.propositions}
    names = (name for number in range(2 * len(labels) + 1) if (name := f"p{number}") not in labels)
    short = (
        proposition if len(proposition.label) <= _LONGEST_LABEL else replace(proposition, name=next(names))
        for proposition in automaton.propositions
    )
    return automaton.renamed(tuple(short))


def meanings(automaton: Automaton) -> list[str]:
    """Return the text of each named proposition: "p0: cup leftof plate"."""
    return [
        f"{proposition.name}: {proposition.text}"
        for proposition in automaton.propositions
        if proposition.name is not None
    ]


def dot_text(automaton: Automaton) -> str:
    """Return the automaton for Graphviz, with guards in words and long propositions in a legend.

    Accepting states have a double outline; those that accept permanently are blue, traps are vermillion. If
    not all transitions can be listed, it has the states nearest to the start.
    """
    short = abbreviated(automaton)
    cut = () if automaton.is_listable else (_left_out(automaton),)
    return _digraph(short, [*meanings(short), *cut])


def _digraph(automaton: Automaton, legend: Sequence[str] = ()) -> str:
    lines = [
        f"digraph {_quote(automaton.name)} {{",
        "  rankdir=LR;",
        '  node [shape=circle, style=filled, fillcolor=white, fontname="Helvetica"];',
        '  edge [fontname="Helvetica", fontsize=10];',
        "  start [shape=point];",
        f"  start -> {automaton.initial};",
    ]
    if legend:
        text = "".join(f"{_escape(line)}\\l" for meaning in legend for line in _legend_lines(meaning))
        lines.append(f'  graph [fontname="Helvetica", fontsize=11, labelloc=b, labeljust=l, label="{text}"];')
    moves = _by_source(automaton)
    for state in moves:
        shape = "doublecircle" if state in automaton.accepting else "circle"
        colour, about = state_colour(automaton, state), _quote(state_words(automaton, state))
        lines.append(f'  {state} [shape={shape}, fillcolor="{colour}", tooltip={about}];')
    for transition in (move for state in moves.values() for move in state):
        label = "\\n".join(map(_escape, _broken(_guard_text(automaton, transition))))
        lines.append(f'  {transition.source} -> {transition.target} [label="{label}"];')
    return "\n".join([*lines, "}", ""])


def hoa_text(automaton: Automaton) -> str:
    """Return the automaton in the Hanoi omega-automata format, version 1.

    That format is about infinite runs and has no acceptance for finite ones. So the accepting states are
    written as the acceptance set 0 of a Büchi automaton: a finite run is accepted iff it ends in a state of
    that set. The header `finite-runs`, which readers may ignore, says so.

    Raises:
        UsageError: its transitions are too many to be listed.
    """
    if not automaton.is_listable:
        raise UsageError(
            f"the Hanoi format has every transition of {automaton.name}, of which there are too many "
            f"({size_words(automaton)}); text and .dot files show the states nearest to the start"
        )
    numbers = range(len(automaton.propositions))
    names = [_quote(proposition.label) for proposition in automaton.propositions]
    lines = [
        "HOA: v1",
        f"name: {_quote(automaton.name)}",
        f"States: {len(automaton.states)}",
        f"Start: {automaton.initial}",
        " ".join(["AP:", str(len(numbers)), *names]),
        "acc-name: Buchi",
        "Acceptance: 1 Inf(0)",
        "properties: trans-labels explicit-labels state-acc complete deterministic",
        'finite-runs: "accepted iff they end in a state of set 0"',
        "--BODY--",
    ]
    for state, transitions in _by_source(automaton).items():
        lines.append(f"State: {state} {{0}}" if state in automaton.accepting else f"State: {state}")
        lines += [f"  [{_hoa_guard(transition)}] {transition.target}" for transition in transitions]
    return "\n".join([*lines, "--END--", ""])


def svg_text(automaton: Automaton) -> str:
    """Return the automaton drawn by Graphviz.

    Raises:
        UsageError: Graphviz is not installed.
        OutputError: Graphviz fails, or takes too long.
    """
    return _graphviz(automaton, dot_text(automaton), "svg")


def layout_text(automaton: Automaton) -> str:
    """Return the places of states and arrows, without a legend, as JSON.

    Raises:
        UsageError, OutputError: as `svg_text`.
    """
    return _graphviz(automaton, _digraph(automaton), "json0")


def _graphviz(automaton: Automaton, text: str, form: str) -> str:
    executable = shutil.which("dot")
    if executable is None:
        raise UsageError(
            "drawing an automaton takes Graphviz, which is not installed: apt-get install graphviz; "
            "or write it as text to a file that ends in .dot"
        )
    try:
        command = [executable, f"-T{form}"]
        process = subprocess.run(
            command, input=text.encode(), capture_output=True, timeout=_DRAWING_S, check=False
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


def _by_source(automaton: Automaton) -> dict[int, list[Transition]]:
    """Return for each state that is shown, the moves from it to others that are."""
    shown_states = automaton.states if automaton.is_listable else automaton.states[:MOST_STATES]
    ends = [
        (state, target)
        for state in shown_states
        for target in automaton.successors[state]
        if target in shown_states
    ]
    moves: dict[int, list[Transition]] = {state: [] for state in shown_states}
    for source, target in ends if automaton.is_listable else ends[:MOST_MOVES]:
        move = automaton.transition(source, target)
        if move is not None:
            moves[source].append(move)
    return moves


def _left_out(automaton: Automaton) -> str:
    most = len(automaton.states[:MOST_STATES])
    rest = f"{counted(len(automaton.states) - most, 'more state')}, " if len(automaton.states) > most else ""
    return f"{rest}more transitions and the rest of long guards are left out: there are too many"


def _guard_text(automaton: Automaton, move: Transition) -> str:
    return automaton.guard_words(move, None if automaton.is_listable else LONGEST_GUARD)


def _hoa_guard(transition: Transition) -> str:
    literals = (
        [str(number) if value else f"!{number}" for number, value in cube] for cube in transition.guard
    )
    return " | ".join("&".join(cube) or "t" for cube in literals)


def _broken(text: str) -> list[str]:
    """Return a sentence in lines, broken before `and` and `or`."""
    lines = [""]
    for word in text.split(" "):
        if word in ("and", "or") and len(lines[-1]) > _WIDTH:
            lines.append("")
        lines[-1] += f" {word}" if lines[-1] else word
    return lines


def _legend_lines(text: str) -> list[str]:
    return wrap(text, _LEGEND_WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)


def _escape(text: str) -> str:
    printable = "".join(character if character.isprintable() else " " for character in text)
    return printable.replace("\\", "\\\\").replace('"', '\\"')


def _quote(text: str) -> str:
    return f'"{_escape(text)}"'


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
    drawn_states = sorted([*sorted(first), *others][:MOST_STATES])
    places = _places(automaton, drawn_states)
    distances = automaton.distances
    ends = [(source, to) for source in drawn_states for to in automaton.successors[source] if to in places]
    ends.sort(key=lambda move: move[0] not in first)
    moves = [
        move for move_ends in ends[:MOST_MOVES] if (move := automaton.transition(*move_ends)) is not None
    ]
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
            for state in drawn_states
        ),
        tuple(
            DrawnMove(move.source, move.target, automaton.guard_words(move, LONGEST_GUARD)) for move in moves
        ),
        len(automaton.states) - len(drawn_states),
    )


def guard_of(automaton: Automaton, move: DrawnMove) -> str:
    """Return the guard of a move in words, as this automaton names its propositions; it has the move."""
    transition = automaton.transition(move.source, move.target)
    return "" if transition is None else automaton.guard_words(transition, LONGEST_GUARD)


def _places(automaton: Automaton, shown: Sequence[int]) -> Mapping[int, tuple[int, float]]:
    """Return column and row of each state: columns follow the transitions, rows make few of them cross."""
    state_set = set(shown)
    successors = {
        state: [successor for successor in automaton.successors[state] if successor in state_set]
        for state in shown
    }
    column = _columns(successors, automaton.initial)
    layers = [
        [state for state in shown if column[state] == number] for number in range(max(column.values()) + 1)
    ]
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
    rows_before = [
        row[source] for source, targets in successors.items() if source != state and state in targets
    ]
    return sum(rows_before) / len(rows_before) if rows_before else row[state]

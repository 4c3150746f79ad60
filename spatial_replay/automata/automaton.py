"""The automaton of a specification: its runs, its description, and its texts for other tools."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from textwrap import wrap
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.automata.guards import (
    Moves,
    Proposition,
    Successors,
    Transition,
    guard_words,
)
from spatial_replay.automata.machine import Machine, above_of, sources_of
from spatial_replay.compiled import elementwise, kernel
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.geometry.arrays import Flags, Integers
from spatial_replay.lazy import Displayed, drawn_as_svg
from spatial_replay.palette import NEGATIVE, POSITIVE, hexadecimal, light
from spatial_replay.text import plural

MAX_PROPOSITIONS = 64
"""Maximum number of propositions of an automaton."""

MAX_ROWS = 300_000
"""Maximum number of states of an automaton, and maximum number of decisions."""

_OF_MOVES = {"_moves", "_above", "distances", "can_accept", "can_reject", "transitions", "is_listable"}
"""Cached properties of an automaton that depend only on its moves."""

MAX_LISTED = 100_000
"""Maximum number of listed transitions, and maximum total number of cubes in their guards."""

MOST_STATES = 60
"""Maximum number of states in a drawing, and in a text that cannot list all transitions."""
MOST_MOVES = 300
"""Maximum number of transitions in a drawing, and in a text that cannot list all transitions."""
LONGEST_GUARD = 300
"""Maximum length of a guard in a drawing, and in a text that cannot list all transitions, characters."""
_LONGEST_LABEL = 12
"""Maximum length of a proposition's label on an arrow, characters."""
_WIDTH = 20
"""Line length from which an arrow's label is wrapped, characters."""
_LEGEND_WIDTH = 100
"""Line length of the legend below a drawing, characters."""


@dataclass(frozen=True)
class Automaton(Displayed):
    """The minimal deterministic automaton of a formula over finite runs.

    Equal automata accept the same runs. Every state has a move for every symbol. State 0 is the state before
    the first sample. Later samples may lead back to state 0. The other states are numbered by their distance
    from state 0.

    Attributes:
        name: name of the spec.
        propositions: propositions that the automaton reads; a *symbol* has the value of each in a sample.
        accepting: states in which a run must end to satisfy the formula. Acceptance of state 0 matters only
            if samples lead back to state 0, because no run is empty.
        entries: for each state, the index of its first decision; ~q if every symbol leads to state q.
        decisions: rows (proposition, next place if the proposition is false, next place if it is true). A
            place is the index of a row, or ~q for state q. The next row decides on a later proposition.
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
        """All transitions, sorted by source and target; the guards of one source are disjoint.

        Raises:
            NoAutomatonError: more than 100 000 transitions, or more than 100 000 cubes in their guards.
                `iter_transitions`, `successors` and `transition` have no such limit.
        """
        transitions, cube_count = [], 0
        for transition in self.iter_transitions():
            transitions.append(transition)
            cube_count += len(transition.guard)
            if transition.is_cut or max(len(transitions), cube_count) > MAX_LISTED:
                noun = (
                    "transitions"
                    if len(transitions) > MAX_LISTED
                    else "cubes in the guards of its transitions"
                )
                raise NoAutomatonError(f"{self.name} has more than {MAX_LISTED} {noun}")
        return tuple(transitions)

    @cached_property
    def is_listable(self) -> bool:
        """Whether `transitions` can list all transitions without an error."""
        # the count of transitions needs no guards, which take longer to compute
        transition_count = 0
        for state in self.states:
            transition_count += len(self.successors[state])
            if transition_count > MAX_LISTED:
                return False
        try:
            return bool(self.transitions)
        except NoAutomatonError:
            return False

    def iter_transitions(self) -> Iterator[Transition]:
        """Iterate over all transitions, sorted by source and target; a transition is computed on demand."""
        moves = self._moves
        return (
            moves.transition(state, target) for state in self.states for target in moves.successors(state)
        )

    @cached_property
    def successors(self) -> Sequence[tuple[int, ...]]:
        """The successors of each state in ascending order, computed on demand."""
        return Successors(self._moves)

    @cached_property
    def has_returns(self) -> bool:
        """Whether samples lead back to the initial state, so that runs can end in it."""
        initial_place = ~self.initial
        return initial_place in self.entries or any(
            initial_place in (if_false, if_true) for _, if_false, if_true in self.decisions
        )

    @cached_property
    def can_accept(self) -> frozenset[int]:
        """The states that can reach an accepting state; all other states are traps."""
        return frozenset(self.distances)

    @cached_property
    def distances(self) -> Mapping[int, int]:
        """The least number of samples from each state to an accepting state; traps are missing."""
        return self._distances(self._ends(self.accepting))

    @cached_property
    def can_reject(self) -> frozenset[int]:
        """The states from which a run can still end in violation; all other states accept permanently."""
        return frozenset(self._distances(self._ends(frozenset(self.states) - self.accepting)))

    def step(self, state: int, symbol: Sequence[bool]) -> int:
        """Return the state after a sample.

        Args:
            symbol: value of each proposition.

        Raises:
            UsageError: no such state, or a symbol without exactly one value per proposition.
        """
        self._check(state, symbol)
        place = self.entries[state]
        while place >= 0:
            proposition, if_false, if_true = self.decisions[place]
            place = if_true if symbol[proposition] else if_false
        return ~place

    def step_set(self, states: Collection[int], symbol: Sequence[bool | None]) -> frozenset[int]:
        """Return the possible states after one sample, for a run that is in any of `states`.

        Args:
            symbol: value of each proposition, None if it is unknown.

        Raises:
            UsageError: no such state, or a symbol without exactly one value per proposition.
        """
        pending_places = []
        for state in states:
            self._check(state, symbol)
            pending_places.append(self.entries[state])
        visited_places = set(pending_places)
        next_states = set()
        while pending_places:
            place = pending_places.pop()
            if place < 0:
                next_states.add(~place)
                continue
            proposition, if_false, if_true = self.decisions[place]
            value = symbol[proposition]
            for next_place in (if_false, if_true) if value is None else (if_true,) if value else (if_false,):
                if next_place not in visited_places:
                    visited_places.add(next_place)
                    pending_places.append(next_place)
        return frozenset(next_states)

    def accepts(self, symbols: Sequence[Sequence[bool]]) -> bool:
        """Return whether a run of at least one sample satisfies the formula.

        Raises:
            UsageError: no symbol, or a symbol without exactly one value per proposition.
        """
        if not symbols:
            raise UsageError("a run has at least one sample; give one symbol for each")
        state = self.initial
        for symbol in symbols:
            state = self.step(state, symbol)
        return state in self.accepting

    def transition(self, source: int, target: int) -> Transition | None:
        """Return the transition between two states; None if no sample leads from `source` to `target`."""
        is_move = source in self.states and target in self.successors[source]
        return self._moves.transition(source, target) if is_move else None

    def paths(
        self, state: int, without: Collection[tuple[int, int]] = ()
    ) -> Iterator[tuple[Transition, ...]]:
        """Yield the shortest paths from a state to an accepting state; a path is computed on demand.

        The path from an accepting state is empty. A trap has no path.

        Args:
            without: transitions (source, target) to avoid.

        Raises:
            UsageError: no such state.
        """
        self._check_state(state)
        avoided_moves = set(without)
        distances = self._distances(self.accepting, avoided_moves)
        if state not in distances:
            return
        paths: list[tuple[Transition, ...]] = [()]
        while paths:
            path = paths.pop()
            end_state = path[-1].target if path else state
            if distances[end_state] == 0:
                yield path
                continue
            nearer_targets = [
                target
                for target in self.successors[end_state]
                if (end_state, target) not in avoided_moves
                and distances.get(target) == distances[end_state] - 1
            ]
            # the list is a stack, so the path over the state with the lowest number is popped first
            paths.extend(
                (*path, self._moves.transition(end_state, target)) for target in reversed(nearer_targets)
            )

    def guard_words(self, transition: Transition, longest: int | None = None) -> str:
        """Return a transition's guard as a sentence of the specification language.

        Args:
            longest: maximum number of characters; None for no limit.
        """
        return guard_words(transition, self.propositions, longest)

    def with_propositions(self, propositions: Sequence[Proposition]) -> Automaton:
        """Return the automaton with other names for its propositions."""
        result = replace(self, propositions=tuple(propositions))
        # names change no move, so cached properties of the moves stay valid
        # functools.cached_property stores its values in __dict__
        result.__dict__.update({name: self.__dict__[name] for name in _OF_MOVES & self.__dict__.keys()})
        return result

    def _repr_svg_(self) -> str | None:
        return drawn_as_svg(self)

    def to_dot(self) -> str:
        """Return the automaton as text for Graphviz, with guards in words and long propositions in a legend.

        Accepting states have a double outline. States that accept permanently are blue, traps are vermillion.
        If there are too many transitions to list, the text has only the states nearest to the start.
        """
        automaton = abbreviate(self)
        cut_remarks = () if self.is_listable else (_left_out(self),)
        return digraph_text(automaton, [*meanings(automaton), *cut_remarks])

    def to_hoa(self) -> str:
        """Return the automaton in the Hanoi omega-automata format, version 1.

        The format describes infinite runs and has no acceptance condition for finite runs. The accepting
        states are therefore acceptance set 0 of a Büchi automaton: a finite run is accepted iff it ends in a
        state of that set. The header `finite-runs` states this condition. Readers may ignore the header.

        Raises:
            UsageError: there are too many transitions to list.
        """
        if not self.is_listable:
            raise UsageError(
                f"the Hanoi format needs every transition of {self.name}, and there are too many "
                f"({size_words(self)}); text and .dot files show the states nearest to the start"
            )
        proposition_numbers = range(len(self.propositions))
        quoted_labels = [_quote(proposition.label) for proposition in self.propositions]
        lines = [
            "HOA: v1",
            f"name: {_quote(self.name)}",
            f"States: {len(self.states)}",
            f"Start: {self.initial}",
            " ".join(["AP:", str(len(proposition_numbers)), *quoted_labels]),
            "acc-name: Buchi",
            "Acceptance: 1 Inf(0)",
            "properties: trans-labels explicit-labels state-acc complete deterministic",
            # readers skip unknown headers that begin with a small letter (https://adl.github.io/hoaf/)
            'finite-runs: "accepted iff they end in a state of set 0"',
            "--BODY--",
        ]
        for state, transitions in _by_source(self).items():
            lines.append(f"State: {state} {{0}}" if state in self.accepting else f"State: {state}")
            lines += [f"  [{_hoa_guard(transition)}] {transition.target}" for transition in transitions]
        return "\n".join([*lines, "--END--", ""])

    @cached_property
    def _moves(self) -> Moves:
        return Moves(self.entries, self.decisions)

    @cached_property
    def _above(self) -> dict[int, list[int]]:
        return above_of(self.entries, self.decisions)

    def _distances(
        self, goal_states: Collection[int], without: Collection[tuple[int, int]] = ()
    ) -> dict[int, int]:
        """Map each state with a path to a goal state to the least number of samples to a goal state."""
        # transitions to avoid are few; the other transitions of their sources are followed one by one
        avoided_targets: dict[int, set[int]] = {}
        for source, target in without:
            if source in self.states:
                avoided_targets.setdefault(source, set()).add(target)
        remaining_sources: dict[int, list[int]] = {}
        for source, targets in avoided_targets.items():
            for target in self.successors[source]:
                if target not in targets:
                    remaining_sources.setdefault(target, []).append(source)
        distances = dict.fromkeys(sorted(goal_states), 0)
        waiting_states = list(distances)
        visited_rows: set[int] = set()
        for state in waiting_states:
            predecessors = sources_of(self._above, (state,), visited_rows)
            for source in (
                *(predecessor for predecessor in predecessors if predecessor not in avoided_targets),
                *remaining_sources.get(state, ()),
            ):
                if source not in distances:
                    distances[source] = distances[state] + 1
                    waiting_states.append(source)
        return distances

    def _ends(self, states: frozenset[int]) -> frozenset[int]:
        """Drop the initial state from `states` if no run can end in it."""
        return states if self.has_returns else states - {self.initial}

    def _check(self, state: int, symbol: Sequence[object]) -> None:
        self._check_state(state)
        if len(symbol) != len(self.propositions):
            proposition_count = len(self.propositions)
            raise UsageError(f"a symbol of {len(symbol)} values; there are {proposition_count} propositions")

    def _check_state(self, state: int) -> None:
        if state not in self.states:
            raise UsageError(f"no state {state!r}; there are 0 to {len(self.states) - 1}")


def automaton_of(machine: Machine, name: str, propositions: Sequence[Proposition]) -> Automaton:
    """Convert a minimal machine, a result of `least`, into an automaton."""
    accepting = frozenset(np.flatnonzero(machine.accepting).tolist())
    decisions = tuple(map(tuple, machine.decisions.tolist()))
    return Automaton(name, tuple(propositions), accepting, tuple(machine.moves.tolist()), decisions)


FALSE, TRUE, UNKNOWN = 0, 1, -1
"""Values of propositions."""

StateSet: TypeAlias = NDArray[np.bool_]
"""(S,), whether a run may be in each state."""


@dataclass(frozen=True, eq=False)
class TransitionTable:
    """The moves of an automaton as arrays, for the kernels.

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
        """Return the state after each sample, (T,), if every proposition is known.

        Args:
            state: state before the first sample.
            values: (P, T), 0 or 1.
        """
        result = np.empty(values.shape[1], np.int64)
        _walk(self.entries, self.decisions, state, values, result)
        return result

    def state_sets(self, states: StateSet, values: Flags) -> NDArray[np.bool_]:
        """Return the possible states after each sample, (T, S).

        Args:
            states: (S,), possible states before the first sample.
            values: (P, T), 0, 1, or -1 if unknown.
        """
        result = np.zeros((values.shape[1], len(self.entries)), np.bool_)
        _spread(self.entries, self.decisions, states, values, result)
        return result


@elementwise
@kernel
def _walk(
    entries: Integers, decisions: Integers, state: int, proposition_values: Flags, result: Integers
) -> None:
    for sample in range(proposition_values.shape[1]):
        place = entries[state]
        while place >= 0:
            # column 1 is for a false proposition, column 2 for a true one
            place = decisions[place, 1 + proposition_values[decisions[place, 0], sample]]
        state = ~place
        result[sample] = state


@kernel
def _spread(
    entries: Integers,
    decisions: Integers,
    states: StateSet,
    proposition_values: Flags,
    result: NDArray[np.bool_],
) -> None:
    # sample in which each decision was last visited: a decision that states share is followed once per sample
    last_visits = np.full(decisions.shape[0], -1, np.int64)
    # each visited decision adds at most one entry to the stack
    stack = np.empty(decisions.shape[0] + 2, np.int64)
    states_before = states
    for sample in range(proposition_values.shape[1]):
        states_after = result[sample]
        for state in range(states_before.shape[0]):
            if not states_before[state]:
                continue
            stack[0] = entries[state]
            stack_height = 1
            while stack_height > 0:
                stack_height -= 1
                place = stack[stack_height]
                if place < 0:
                    states_after[~place] = True
                    continue
                if last_visits[place] == sample:
                    continue
                last_visits[place] = sample
                # an unknown value, -1, follows both branches
                value = proposition_values[decisions[place, 0], sample]
                if value != 1:
                    stack[stack_height] = decisions[place, 1]
                    stack_height += 1
                if value != 0:
                    stack[stack_height] = decisions[place, 2]
                    stack_height += 1
        states_before = states_after


def words_text(automaton: Automaton) -> str:
    """Describe the states, their meaning and their transitions in words.

    If there are too many transitions to list, the text has only the states nearest to the start.
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
            direction = "stays" if transition.target == state else f"to {transition.target}"
            lines.append(f"    {direction} if {_guard_text(automaton, transition)}")
    if not automaton.is_listable:
        lines.append(f"  … {_left_out(automaton)}")
    return "\n".join(lines)


def size_words(automaton: Automaton) -> str:
    """Return the size of an automaton: "33 states, 6 propositions"."""
    return f"{plural(len(automaton.states), 'state')}, {plural(len(automaton.propositions), 'proposition')}"


def state_words(automaton: Automaton, state: int) -> str:
    """Return the verdict of a run that ends in a state, and whether the verdict can change."""
    prefix = "start, " if state == automaton.initial else ""
    if state == automaton.initial and not automaton.has_returns:
        return f"{prefix}before the first sample"
    verdict = "accepting" if state in automaton.accepting else "not accepting"
    if state not in automaton.can_reject:
        verdict = "accepting permanently"
    elif state not in automaton.can_accept:
        verdict = "a trap: acceptance is lost"
    return prefix + verdict


def state_colour(automaton: Automaton, state: int) -> str:
    """Return a state's fill: light blue if it accepts permanently, light vermillion for a trap, or white."""
    if state not in automaton.can_reject:
        return hexadecimal(light(POSITIVE))
    return "#ffffff" if state in automaton.can_accept else hexadecimal(light(NEGATIVE))


def abbreviate(automaton: Automaton) -> Automaton:
    """Return the automaton with short names for propositions that are too long for arrows."""
    labels = {proposition.label for proposition in automaton.propositions}
    # twice as many names suffice, because labels take at most half of them
    free_names = (name for number in range(2 * len(labels) + 1) if (name := f"p{number}") not in labels)
    short_propositions = (
        proposition
        if len(proposition.label) <= _LONGEST_LABEL
        else replace(proposition, name=next(free_names))
        for proposition in automaton.propositions
    )
    return automaton.with_propositions(tuple(short_propositions))


def meanings(automaton: Automaton) -> list[str]:
    """Return the text of each named proposition: "p0: cup leftof plate"."""
    return [
        f"{proposition.name}: {proposition.text}"
        for proposition in automaton.propositions
        if proposition.name is not None
    ]


def digraph_text(automaton: Automaton, legend: Sequence[str] = ()) -> str:
    lines = [
        f"digraph {_quote(automaton.name)} {{",
        "  rankdir=LR;",
        '  node [shape=circle, style=filled, fillcolor=white, fontname="Helvetica"];',
        '  edge [fontname="Helvetica", fontsize=10];',
        "  start [shape=point];",
        f"  start -> {automaton.initial};",
    ]
    if legend:
        legend_text = "".join(f"{_escape(line)}\\l" for meaning in legend for line in _legend_lines(meaning))
        lines.append(
            f'  graph [fontname="Helvetica", fontsize=11, labelloc=b, labeljust=l, label="{legend_text}"];'
        )
    moves_by_state = _by_source(automaton)
    for state in moves_by_state:
        shape = "doublecircle" if state in automaton.accepting else "circle"
        colour, tooltip = state_colour(automaton, state), _quote(state_words(automaton, state))
        lines.append(f'  {state} [shape={shape}, fillcolor="{colour}", tooltip={tooltip}];')
    for transition in (move for moves in moves_by_state.values() for move in moves):
        label = "\\n".join(map(_escape, _wrap_guard(_guard_text(automaton, transition))))
        lines.append(f'  {transition.source} -> {transition.target} [label="{label}"];')
    return "\n".join([*lines, "}", ""])


def _by_source(automaton: Automaton) -> dict[int, list[Transition]]:
    """Return the transitions between drawn states, by source."""
    shown_states = automaton.states if automaton.is_listable else automaton.states[:MOST_STATES]
    state_pairs = [
        (state, target)
        for state in shown_states
        for target in automaton.successors[state]
        if target in shown_states
    ]
    moves_by_state: dict[int, list[Transition]] = {state: [] for state in shown_states}
    for source, target in state_pairs if automaton.is_listable else state_pairs[:MOST_MOVES]:
        move = automaton.transition(source, target)
        if move is not None:
            moves_by_state[source].append(move)
    return moves_by_state


def _left_out(automaton: Automaton) -> str:
    drawn_count = len(automaton.states[:MOST_STATES])
    states_text = (
        f"{plural(len(automaton.states) - drawn_count, 'more state')}, "
        if len(automaton.states) > drawn_count
        else ""
    )
    return f"{states_text}more transitions and the rest of long guards are left out: there are too many"


def _guard_text(automaton: Automaton, move: Transition) -> str:
    return automaton.guard_words(move, None if automaton.is_listable else LONGEST_GUARD)


def _hoa_guard(transition: Transition) -> str:
    cube_literals = (
        [str(number) if value else f"!{number}" for number, value in cube] for cube in transition.guard
    )
    return " | ".join("&".join(cube) or "t" for cube in cube_literals)


def _wrap_guard(text: str) -> list[str]:
    """Wrap a sentence before `and` and `or`."""
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

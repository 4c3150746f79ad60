"""The automaton of a specification: its runs, its words, and its texts for other tools."""

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
"""How many propositions an automaton reads at most."""

MAX_ROWS = 300_000
"""How many states an automaton has at most, and how many decisions."""

_OF_MOVES = {"_moves", "_above", "distances", "can_accept", "can_reject", "transitions", "is_listable"}
"""Properties of an automaton that depend on its moves alone."""

MAX_LISTED = 100_000
"""How many transitions are listed at most, and how many cubes their guards have together."""

MOST_STATES = 60
"""States that a drawing shows at most, and a text of an automaton whose transitions cannot all be listed."""
MOST_MOVES = 300
LONGEST_GUARD = 300
"""The most moves there, and characters of a guard."""
_LONGEST_LABEL = 12
"""Characters of a proposition that stands on an arrow as it is."""
_WIDTH = 20
"""Characters after which a label of an arrow goes on in a new line."""
_LEGEND_WIDTH = 100
"""Characters of a line below a drawing."""


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

    def with_propositions(self, propositions: Sequence[Proposition]) -> Automaton:
        """Return the automaton with other names for its propositions."""
        result = replace(self, propositions=tuple(propositions))
        # names change no move: what was worked out is kept
        result.__dict__.update({name: self.__dict__[name] for name in _OF_MOVES & self.__dict__.keys()})
        return result

    def _repr_svg_(self) -> str | None:
        return drawn_as_svg(self)

    def to_dot(self) -> str:
        """Return the automaton for Graphviz, with guards in words and long propositions in a legend.

        Accepting states have a double outline. States that accept permanently are blue, traps are vermillion.
        If not all transitions can be listed, it has the states nearest to the start.
        """
        short = abbreviate(self)
        cut = () if self.is_listable else (_left_out(self),)
        return digraph_text(short, [*meanings(short), *cut])

    def to_hoa(self) -> str:
        """Return the automaton in the Hanoi omega-automata format, version 1.

        That format is about infinite runs and has no acceptance for finite ones. So the accepting states are
        written as the acceptance set 0 of a Büchi automaton: a finite run is accepted iff it ends in a state
        of that set. The header `finite-runs`, which readers may ignore, says so.

        Raises:
            UsageError: its transitions are too many to be listed.
        """
        if not self.is_listable:
            raise UsageError(
                f"the Hanoi format has every transition of {self.name}, of which there are too many "
                f"({size_words(self)}); text and .dot files show the states nearest to the start"
            )
        numbers = range(len(self.propositions))
        names = [_quote(proposition.label) for proposition in self.propositions]
        lines = [
            "HOA: v1",
            f"name: {_quote(self.name)}",
            f"States: {len(self.states)}",
            f"Start: {self.initial}",
            " ".join(["AP:", str(len(numbers)), *names]),
            "acc-name: Buchi",
            "Acceptance: 1 Inf(0)",
            "properties: trans-labels explicit-labels state-acc complete deterministic",
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
    return f"{plural(len(automaton.states), 'state')}, {plural(len(automaton.propositions), 'proposition')}"


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


def abbreviate(automaton: Automaton) -> Automaton:
    """Return the automaton with short names for long propositions, as fit on arrows."""
    labels = {proposition.label for proposition in automaton.propositions}
    names = (name for number in range(2 * len(labels) + 1) if (name := f"p{number}") not in labels)
    short = (
        proposition if len(proposition.label) <= _LONGEST_LABEL else replace(proposition, name=next(names))
        for proposition in automaton.propositions
    )
    return automaton.with_propositions(tuple(short))


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


def _by_source(automaton: Automaton) -> dict[int, list[Transition]]:
    """Return the transitions from each drawn state to other drawn states."""
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
    rest = f"{plural(len(automaton.states) - most, 'more state')}, " if len(automaton.states) > most else ""
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

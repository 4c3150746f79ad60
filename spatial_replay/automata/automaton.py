"""The automaton of a specification, as a value."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Self

from spatial_replay.automata.diagrams import LEAF
from spatial_replay.automata.guards import guard_words
from spatial_replay.automata.machine import Machine
from spatial_replay.automata.moves import Moves, Transition, moves_of, successors_of, transitions_of
from spatial_replay.automata.propositions import Proposition
from spatial_replay.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_PROPOSITIONS = 64
"""How many propositions an automaton reads at most."""

MAX_ROWS = 200_000
"""How many states an automaton has at most, and how many decisions."""


@dataclass(frozen=True)
class Automaton:
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
            NoAutomatonError: finding them takes more than `MAX_VISITS`, or their guards too many cubes; never
                of what `automaton` gives.
        """
        return transitions_of(self._moves, self.successors)

    def with_transitions(self) -> Self:
        """This automaton, with transitions that are found.

        Raises:
            NoAutomatonError: as `transitions`.
        """
        # what finds them keeps them
        _ = self.transitions
        return self

    @cached_property
    def successors(self) -> tuple[tuple[int, ...], ...]:
        """For each state, those that one sample can lead to.

        Raises:
            NoAutomatonError: as `transitions`.
        """
        return successors_of(self._moves)

    @property
    def has_returns(self) -> bool:
        """Whether samples lead to the initial state, so that runs end there."""
        return any(self.initial in targets for targets in self.successors)

    @cached_property
    def can_accept(self) -> frozenset[int]:
        """The states from which acceptance has not been lost; the others are traps."""
        return self._leading_to(self.accepting)

    @cached_property
    def can_reject(self) -> frozenset[int]:
        """The states from which a run can still end in violation; the others accept for good."""
        return self._leading_to(frozenset(self.states) - self.accepting)

    def step(self, state: int, symbol: Sequence[bool]) -> int:
        """The state after a sample.

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
        """The states that may be reached after a sample from any of some states.

        Args:
            symbol: for each proposition, whether it is true; None where that is not known.

        Raises:
            UsageError: no such state, or a symbol of another length.
        """
        places = []
        for state in states:
            self._check(state, symbol)
            places.append(self.entries[state])
        seen = set(places)
        reached = set()
        while places:
            place = places.pop()
            if place < 0:
                reached.add(~place)
                continue
            proposition, low, high = self.decisions[place]
            value = symbol[proposition]
            for after in (low, high) if value is None else (high,) if value else (low,):
                if after not in seen:
                    seen.add(after)
                    places.append(after)
        return frozenset(reached)

    def accepts(self, symbols: Sequence[Sequence[bool]]) -> bool:
        """Whether a run of at least one sample satisfies the formula.

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
        """The move from one state to another, if one sample can lead there."""
        return self._transitions_by_ends.get((source, target))

    def paths(
        self, state: int, without: Collection[tuple[int, int]] = ()
    ) -> Iterator[tuple[Transition, ...]]:
        """The shortest ways from a state to an accepting one, one after the other as they are asked for.

        From an accepting state that is the empty way; there is none from a trap.

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
        ways: list[tuple[Transition, ...]] = [()]
        while ways:
            way = ways.pop()
            here = way[-1].target if way else state
            if distances[here] == 0:
                yield way
                continue
            nearer = [
                target
                for target in self.successors[here]
                if (here, target) not in left_out and distances.get(target) == distances[here] - 1
            ]
            ways.extend((*way, self._transitions_by_ends[here, target]) for target in reversed(nearer))

    def guard_words(self, transition: Transition) -> str:
        """What lets a transition be taken, as a sentence of the specification language."""
        return guard_words(transition.guard, self.propositions)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw it with matplotlib; see `picture.draw_automaton`."""
        from spatial_replay.automata.picture import draw_automaton

        return draw_automaton(self, ax)

    def _repr_html_(self) -> str:
        from spatial_replay.automata.picture import automaton_html

        return automaton_html(self)

    def _repr_svg_(self) -> str | None:
        from spatial_replay.automata.picture import automaton_svg

        return automaton_svg(self)

    def to_dot(self) -> str:
        """The automaton in the language of Graphviz; see `drawing.dot_text`."""
        from spatial_replay.automata.drawing import dot_text

        return dot_text(self)

    def to_hoa(self) -> str:
        """The automaton in the Hanoi format for tools of automata theory; see `drawing.hoa_text`."""
        from spatial_replay.automata.drawing import hoa_text

        return hoa_text(self)

    @cached_property
    def _transitions_by_ends(self) -> dict[tuple[int, int], Transition]:
        return {(each.source, each.target): each for each in self.transitions}

    @property
    def _moves(self) -> Moves:
        return moves_of(self.entries, self.decisions)

    def _distances(self, goal: Collection[int], without: Collection[tuple[int, int]] = ()) -> dict[int, int]:
        """For each state that can reach a goal, how many samples that takes."""
        before: dict[int, list[int]] = {}
        for source, targets in enumerate(self.successors):
            for target in targets:
                if (source, target) not in without:
                    before.setdefault(target, []).append(source)
        distances = dict.fromkeys(sorted(goal), 0)
        waiting = list(distances)
        for state in waiting:
            for source in before.get(state, ()):
                if source not in distances:
                    distances[source] = distances[state] + 1
                    waiting.append(source)
        return distances

    def _leading_to(self, goal: frozenset[int]) -> frozenset[int]:
        """The states from which the end of a run can be in the goal."""
        if not self.has_returns:
            goal -= {self.initial}
        return frozenset(self._distances(goal))

    def _check(self, state: int, symbol: Sequence[object]) -> None:
        self._check_state(state)
        if len(symbol) != len(self.propositions):
            raise UsageError(
                f"a symbol of {len(symbol)} values; there are {len(self.propositions)} propositions"
            )

    def _check_state(self, state: int) -> None:
        if state not in self.states:
            raise UsageError(f"no state {state!r}; there are 0 to {len(self.states) - 1}")


def automaton_of(machine: Machine, name: str, propositions: Sequence[Proposition]) -> Automaton:
    """The value of a machine that is `least`."""
    decisions: list[tuple[int, int, int]] = []
    places: dict[int, int] = {}

    def place(node: int) -> int:
        if node not in places:
            variable, low, high = machine.diagrams[node]
            if variable == LEAF:
                places[node] = ~low
            else:
                row = (variable, place(low), place(high))
                places[node] = len(decisions)
                decisions.append(row)
        return places[node]

    entries = tuple(place(node) for node in machine.moves)
    accepting = frozenset(state for state, accepts in enumerate(machine.accepting) if accepts)
    return Automaton(name, tuple(propositions), accepting, entries, tuple(decisions))

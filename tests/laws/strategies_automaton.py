"""Formulas that have an automaton, without past operators and seconds, and runs of their propositions."""

from __future__ import annotations

from hypothesis import strategies as st

from laws.strategies_monitor import LEAVES
from spatial_replay import Specification, automaton
from spatial_replay.automata import Compiler
from spatial_replay.automata.automaton import Automaton
from spatial_replay.spec.formula import Boolean, Bound, Formula, NamedSpec, Temporal, Truth

_leaves = st.one_of(st.sampled_from(LEAVES), st.sampled_from(LEAVES), st.builds(Truth, st.booleans()))


@st.composite
def _bounds(draw: st.DrawFn) -> Bound:
    lower = draw(st.integers(0, 2))
    return Bound(lower, draw(st.one_of(st.none(), st.integers(lower, lower + 3))), "samples")


def _over(operands: st.SearchStrategy[Formula]) -> st.SearchStrategy[Formula]:
    single = operands.map(lambda operand: (operand,))
    pairs = st.tuples(operands, operands)
    several = st.lists(operands, min_size=2, max_size=3).map(tuple)
    bounds = st.one_of(st.none(), st.none(), _bounds())
    return st.one_of(
        st.builds(Boolean, st.just("not"), single),
        st.builds(Boolean, st.sampled_from(["and", "or"]), several),
        st.builds(Boolean, st.sampled_from(["xor", "->", "<->"]), pairs),
        st.builds(Temporal, st.sampled_from(["X", "WX"]), single),
        st.builds(Temporal, st.sampled_from(["F", "G"]), single, bounds),
        st.builds(Temporal, st.sampled_from(["U", "R", "W"]), pairs, bounds),
    )


def _nested(depth: int) -> st.SearchStrategy[Formula]:
    if depth == 0:
        return _leaves
    deeper = _over(_nested(depth - 1))
    return st.one_of(_leaves, deeper, deeper, deeper)


formulas_with_automata = st.one_of(_nested(2), _nested(3), _nested(4))


def compiled(formula: Formula, compiler: Compiler | None = "own") -> Automaton:
    """The automaton of a formula by itself."""
    return automaton(Specification((NamedSpec("s", formula),), "paper"), compiler=compiler)


@st.composite
def formulas_and_symbols(
    draw: st.DrawFn, values: st.SearchStrategy[bool | None], max_size: int = 6
) -> tuple[Automaton, list[list[bool | None]]]:
    """An automaton, and what its propositions are in the samples of a run."""
    machine = compiled(draw(formulas_with_automata))
    symbol = st.lists(values, min_size=len(machine.propositions), max_size=len(machine.propositions))
    return machine, draw(st.lists(symbol, min_size=1, max_size=max_size))

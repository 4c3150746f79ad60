"""Laws of automata: they accept what is satisfied, and each of their parts says the same."""

from __future__ import annotations

import shutil
from functools import reduce
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from laws.reference import Prefix
from laws.strategies_automaton import compiled, formulas_and_symbols, formulas_with_automata
from laws.strategies_monitor import leaf_runs
from spatial_replay import Specification, automaton
from spatial_replay.automata import TransitionTable, automaton_from, stored_text
from spatial_replay.automata.automaton import Automaton, automaton_of
from spatial_replay.automata.compile import join_machines, machine_by_progression
from spatial_replay.automata.guards import Propositions
from spatial_replay.automata.ltlf import Skeleton
from spatial_replay.automata.machine import least, merge_equivalent_states
from spatial_replay.spec.formula import Boolean, NamedSpec

known = st.booleans()
perhaps_unknown = st.sampled_from([False, True, None])
compilers = ["own", "mona"] if shutil.which("mona") else ["own"]


@pytest.mark.parametrize("compiler", compilers)
@given(formulas_with_automata, leaf_runs(max_size=8))
def test_the_sign_of_robustness_and_acceptance_agree(compiler, formula, run):
    # only the first of its channels is looked at: everything is known
    run = type(run)(run.times_ns, {name: _known(cells) for name, cells in run.nominal.items()}, run.wide, 1)
    machine = compiled(formula, compiler)
    samples = Prefix(run.times_ns, run.nominal_leaf, goes_on=False)
    rho = samples.rho(formula, 0).low
    symbols = [
        [samples.rho(each.formula, t).low >= 0.0 for each in machine.propositions] for t in range(len(run))
    ]
    if rho != 0.0:
        assert machine.accepts(symbols) == (rho > 0.0)


def _known(cells):
    """What is not known is 1."""
    return tuple(cell if cell.low == cell.high else type(cell)(1.0, 1.0) for cell in cells)


@given(formulas_and_symbols(perhaps_unknown, max_size=3))
def test_unknown_propositions_leave_the_states_of_all_their_values(given_symbols):
    machine, symbols = given_symbols
    possible = frozenset({machine.initial})
    for symbol in symbols:
        reached = {
            machine.step(state, completed)
            for state in possible
            for completed in product(*([value] if value is not None else [False, True] for value in symbol))
        }
        possible = machine.step_set(possible, symbol)
        assert possible == reached


@given(formulas_and_symbols(perhaps_unknown))
def test_the_table_steps_many_samples_as_the_automaton_steps_one(given_symbols):
    machine, symbols = given_symbols
    values = np.array([[-1 if each is None else int(each) for each in symbol] for symbol in symbols], np.int8)
    values = values.reshape(len(symbols), len(machine.propositions)).T.copy()
    begin = np.zeros(len(machine.states), np.bool_)
    begin[machine.initial] = True
    sets = TransitionTable.of(machine).state_sets(begin, values)
    possible = frozenset({machine.initial})
    for t, symbol in enumerate(symbols):
        possible = machine.step_set(possible, symbol)
        assert set(np.flatnonzero(sets[t]).tolist()) == possible
    if not (values < 0).any():
        states = TransitionTable.of(machine).states(machine.initial, values)
        assert [{state} for state in states.tolist()] == [set(np.flatnonzero(row)) for row in sets]


@given(formulas_and_symbols(known))
def test_exactly_one_guard_of_a_state_holds_and_leads_where_the_step_does(given_symbols):
    machine, symbols = given_symbols
    state = machine.initial
    for symbol in symbols:
        taken = [
            each.target
            for each in machine.transitions
            if each.source == state
            and any(all(symbol[number] == value for number, value in cube) for cube in each.guard)
        ]
        state = machine.step(state, symbol)
        assert taken == [state]


@given(formulas_with_automata)
def test_no_literal_of_a_guard_can_be_left_out(formula):
    machine = compiled(formula)
    for each in machine.transitions:
        for cube in each.guard:
            for literal in cube:
                wider = {number: value for number, value in cube if (number, value) != literal}
                symbol = [wider.get(number) for number in range(len(machine.propositions))]
                assert machine.step_set([each.source], symbol) != {each.target}


@given(formulas_with_automata)
def test_no_two_states_are_equivalent(formula):
    machine = compiled(formula)
    assert len(_classes(machine)) == len(machine.states)


def _classes(machine: Automaton) -> set[tuple[object, ...]]:
    """States by what runs from them on lead to; the initial one, in which none ends, by its moves."""
    symbols = list(product([False, True], repeat=len(machine.propositions)))
    names: dict[int, object] = {state: state in machine.accepting for state in machine.states}
    for _ in machine.states:
        signatures = {
            state: (names[state], *(names[machine.step(state, symbol)] for symbol in symbols))
            for state in machine.states
        }
        numbers = {signature: number for number, signature in enumerate(dict.fromkeys(signatures.values()))}
        names = {state: numbers[signature] for state, signature in signatures.items()}
    return {(name,) for name in names.values()}


@given(formulas_with_automata)
def test_paths_are_as_short_as_can_be_and_lead_to_acceptance(formula):
    machine = compiled(formula)
    for state in machine.states:
        ways = [way for way, _ in zip(machine.paths(state), range(20), strict=False)]
        reachable = {state} & machine.accepting or {
            end for end in _reached(machine, state) if end in machine.accepting
        }
        assert bool(ways) == bool(reachable)
        assert len({len(way) for way in ways}) <= 1
        for way in ways:
            ends = [state, *(each.target for each in way)]
            assert [each.source for each in way] == ends[:-1]
            assert ends[-1] in machine.accepting
            assert not set(ends[:-1]) & machine.accepting


def _reached(machine: Automaton, state: int) -> set[int]:
    found: set[int] = set()
    waiting = [state]
    while waiting:
        more = set(machine.successors[waiting.pop()]) - found
        found |= more
        waiting += more
    return found


@given(formulas_with_automata)
def test_traps_and_permanent_acceptance_are_where_nothing_can_change(formula):
    machine = compiled(formula)
    for state in machine.states:
        ends = _reached(machine, state) | ({state} if state != machine.initial else set())
        assert (state in machine.can_accept) == bool(ends & machine.accepting)
        assert (state in machine.can_reject) == bool(ends - machine.accepting)


@given(formulas_with_automata)
def test_reading_an_automaton_gives_back_what_was_stored(formula):
    spec = NamedSpec("s", formula)
    specification = Specification((spec,), "paper")
    machine = automaton(specification)
    text = stored_text(machine, specification, spec)
    assert automaton_from(text.encode(), specification, spec) == machine


@examples(60)
@given(formulas_with_automata, formulas_with_automata, st.sampled_from(["and", "or"]))
def test_joining_the_automata_of_operands_gives_that_of_the_whole(first, second, operator) -> None:
    formula = Boolean(operator, (first, second))
    propositions = Propositions(formula)
    skeleton, count = Skeleton(formula, propositions), len(propositions.all)
    kind, operands = skeleton.split(skeleton.root)
    machines = [merge_equivalent_states(machine_by_progression(skeleton, count, each)) for each in operands]
    whole = least(reduce(lambda one, other: join_machines(one, other, kind == "and"), machines))
    assert automaton_of(whole, "s", propositions.all) == compiled(formula)

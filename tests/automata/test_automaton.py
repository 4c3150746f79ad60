"""An automaton as a value: steps, ways, what can still come."""

from __future__ import annotations

import pytest

from spatial_replay import UsageError, automaton, parse_specification
from spatial_replay.automata import Transition, words_text
from spatial_replay.automata.automaton import Automaton

TASK = """\
spec safe = not (robot ovlp hand)
spec first = cube enclosedin tray
spec second = cup enclosedin tray
spec done = (G safe) and (F first) and (F second) and ((not second) U first)
"""


@pytest.fixture
def done() -> Automaton:
    return automaton(parse_specification(TASK))


def test_a_run_steps_from_state_to_state(done: Automaton) -> None:
    state = done.initial
    assert [each.label for each in done.propositions] == ["safe", "first", "second"]
    for symbol, accepted in [
        ((True, False, False), False),
        ((True, True, False), False),
        ((True, False, True), True),
        ((True, False, False), True),
        ((False, False, False), False),
    ]:
        state = done.step(state, symbol)
        assert (state in done.accepting) == accepted
    assert state not in done.can_accept


def test_an_unknown_proposition_leaves_several_states_possible(done: Automaton) -> None:
    after = done.step_set({done.initial}, (True, None, False))
    assert after == {
        done.step(done.initial, (True, False, False)),
        done.step(done.initial, (True, True, False)),
    }
    assert done.step_set(after, (False, None, None)) == {done.step(done.initial, (False, True, True))}


def test_paths_yields_the_shortest_path_and_another_if_it_is_excluded(done: Automaton) -> None:
    (way,) = done.paths(done.initial)
    assert [done.guard_words(each) for each in way] == ["safe and first and second"]
    barred = {(each.source, each.target) for each in way}
    (longer,) = done.paths(done.initial, without=barred)
    assert [done.guard_words(each) for each in longer] == [
        "safe and first and not second",
        "safe and second",
    ]
    barred |= {(longer[1].source, longer[1].target)}
    assert list(done.paths(done.initial, without=barred)) == []
    assert list(done.paths(way[-1].target)) == [()]


def test_a_transition_is_found_by_its_ends(done: Automaton) -> None:
    assert done.transition(done.initial, done.initial) == Transition(
        done.initial, (((0, True), (1, False), (2, False)),), done.initial
    )
    (trap,) = set(done.states) - done.can_accept
    assert done.transition(trap, done.initial) is None


@pytest.mark.parametrize("call", ["step", "step_set", "paths"])
def test_an_unknown_state_is_a_usage_error(done: Automaton, call: str) -> None:
    with pytest.raises(UsageError, match="no state 99; there are 0 to"):
        match call:
            case "step":
                done.step(99, (True, True, True))
            case "step_set":
                done.step_set([99], (True, True, True))
            case _:
                list(done.paths(99))


def test_a_symbol_of_the_wrong_length_is_a_usage_error(done: Automaton) -> None:
    with pytest.raises(UsageError, match="2 values; there are 3 propositions"):
        done.step(0, (True, True))
    with pytest.raises(UsageError, match="at least one sample"):
        done.accepts([])


def test_an_automaton_is_described_in_words() -> None:
    machine = automaton(parse_specification("G ((p >= 0) -> F q >= 0)"))
    assert words_text(machine).splitlines() == [
        "automaton of spec: 2 states, 2 propositions",
        "  state 0: start, accepting",
        "    stays if not (p >= 0) or q >= 0",
        "    to 1 if p >= 0 and not (q >= 0)",
        "  state 1: not accepting",
        "    to 0 if q >= 0",
        "    stays if not (q >= 0)",
    ]


def test_the_description_explains_names_and_final_states(done: Automaton) -> None:
    text = words_text(done)
    assert "  safe means not (robot ovlp hand)\n" in text
    assert "a trap: acceptance is lost" in text
    later = words_text(automaton(parse_specification("X p >= 0")))
    assert "state 0: start, before the first sample" in later
    assert "accepting permanently" in later


def test_the_graphviz_text_lists_states_and_transitions() -> None:
    text = automaton(parse_specification('spec "a \\"b\\"" = F p >= 0')).to_dot()
    assert text.splitlines()[0] == 'digraph "a \\"b\\"" {'
    assert '  1 [shape=doublecircle, fillcolor="#b2d5e8", tooltip="accepting permanently"];' in text
    assert '  0 -> 1 [label="p >= 0"];' in text


def test_the_graphviz_text_explains_long_propositions_in_a_legend() -> None:
    near = "(cup dist plate <= 0.25) and (cup dist fork <= 0.25) and (fork dist plate <= 0.25)"
    text = automaton(parse_specification(f"spec p0 = q >= 0\nspec t = (F ({near})) and G p0")).to_dot()
    assert '[label="p1 and p0"]' in text
    below = next(line for line in text.splitlines() if "label=" in line and "p1: " in line)
    assert "p0: q >= 0\\l" in below
    assert "(cup dist plate <= 0.25)" in below
    assert "(cup dist plate" not in text.replace(below, "")


def test_the_hanoi_text_lists_states_and_transitions(done: Automaton) -> None:
    lines = automaton(parse_specification("G ((p >= 0) -> F q >= 0)")).to_hoa().splitlines()
    assert lines == [
        "HOA: v1",
        'name: "spec"',
        "States: 2",
        "Start: 0",
        'AP: 2 "p >= 0" "q >= 0"',
        "acc-name: Buchi",
        "Acceptance: 1 Inf(0)",
        "properties: trans-labels explicit-labels state-acc complete deterministic",
        'finite-runs: "accepted iff they end in a state of set 0"',
        "--BODY--",
        "State: 0 {0}",
        "  [!0 | 1] 0",
        "  [0&!1] 1",
        "State: 1",
        "  [1] 0",
        "  [!1] 1",
        "--END--",
    ]
    assert "[t]" in done.to_hoa()

"""From texts to automata: what is a proposition, what has no automaton, and what they come out as."""

from __future__ import annotations

import json

import pytest

import spatial_replay as sr
from automata.golden import FILE, FORMULAS, as_values
from spatial_replay import NoAutomatonError, UsageError, automaton, parse_specification
from spatial_replay.automata import stored_text, words_text
from spatial_replay.automata.automaton import Automaton
from spatial_replay.simulation.tabletop import default_specification

GOLDEN = json.loads(FILE.read_text())


def machine_of(text: str) -> Automaton:
    return automaton(parse_specification(text, filename="task.spatial"))


@pytest.mark.parametrize("text", FORMULAS)
def test_automata_are_those_that_mona_gives(text: str) -> None:
    assert as_values(automaton(parse_specification(text), compiler="own")) == GOLDEN[text]


def test_automata_are_available_from_the_package_root() -> None:
    machine = sr.automaton(sr.parse_specification("F p >= 0"))
    assert isinstance(machine, Automaton)
    assert machine.accepts([[False], [True]]) and not machine.accepts([[False], [False]])


def test_the_papers_pick_and_place_is_as_large_as_the_paper_says() -> None:
    machine = automaton(default_specification("pick-place"))
    # it has a state of its own before the first sample, though here that moves as one where nothing is done
    begins = machine.successors[machine.initial]
    assert (len(machine.states) + 1, len(machine.transitions) + len(begins)) == (33, 275)


# ------------------------------------------------------------------------------------------- propositions


def test_propositions_are_the_largest_parts_about_one_sample() -> None:
    machine = machine_of("G ((a ovlp b and c ovlp d) -> F exists x in all: x ovlp a)")
    assert [each.text for each in machine.propositions] == [
        "(a ovlp b) and (c ovlp d)",
        "exists x in all: (x ovlp a)",
    ]


def test_a_named_proposition_is_labelled_by_its_name() -> None:
    machine = automaton(parse_specification("spec near = a closeto[1] b\nspec done = F near"), "done")
    assert [(each.label, each.text) for each in machine.propositions] == [("near", "a closeto[1] b")]
    assert machine.guard_words(machine.transitions[0]) == "not near"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("a ovlp b and c ovlp d", "c ovlp d and a ovlp b"),
        ("a ovlp b and (c ovlp d and e ovlp f)", "(e ovlp f and a ovlp b) and c ovlp d"),
        ("a ovlp b -> c ovlp d", "not (a ovlp b) or c ovlp d"),
        ("not (a ovlp b and c ovlp d)", "not (a ovlp b) or not (c ovlp d)"),
        ("a ovlp b xor c ovlp d", "not (a ovlp b <-> c ovlp d)"),
        ("a ovlp b", "not not (a ovlp b)"),
        ("forall x in all: x ovlp a", "not (exists x in all: not (x ovlp a))"),
        ("forall x in all: x ovlp a", "forall y in all: y ovlp a"),
        ("a ovlp b and (c ovlp d or e ovlp f)", "(a ovlp b and c ovlp d) or (a ovlp b and e ovlp f)"),
        ("a leftof b", "not (a rightof b)"),
        ("a closer b than c", "not (a closer c than b)"),
    ],
)
def test_equivalent_texts_are_one_proposition(first: str, second: str) -> None:
    machine = machine_of(f"(F ({first})) and (G ({second}))")
    assert [each.formula for each in machine.propositions] == [
        parse_specification(f"F ({first})").specs[0].formula.operands[0]
    ]


def test_a_proposition_and_its_negation_are_one() -> None:
    machine = machine_of("(not (a ovlp b)) U (a ovlp b)")
    assert [each.text for each in machine.propositions] == ["not (a ovlp b)"]
    assert {machine.guard_words(each) for each in machine.transitions} == {
        "not (a ovlp b)",
        "a ovlp b",
        "true",
    }
    assert machine.accepts([[True], [False]])
    assert not machine.accepts([[True], [True]])


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("a leftof b", "a rightof b"),
        ("a dist b <= 1", "a dist b > 1"),
        ("exists x in all: x ovlp a", "forall y in all: not (y ovlp a)"),
        ("a ovlp b and (c ovlp d or e ovlp f)", "not (a ovlp b) or (not (c ovlp d) and not (e ovlp f))"),
    ],
)
def test_relations_that_are_opposites_are_one_proposition(first: str, second: str) -> None:
    machine = machine_of(f"(F ({first})) and (F ({second}))")
    (proposition,) = machine.propositions
    assert proposition == machine_of(f"F ({first})").propositions[0]
    assert machine.accepts([[True], [False]]) and not machine.accepts([[True], [True]])


def test_signals_may_be_at_most_and_at_least_a_limit_at_once() -> None:
    machine = machine_of("(G mode <= 2) and (F mode >= 2)")
    assert [each.text for each in machine.propositions] == ["mode <= 2", "mode >= 2"]
    assert machine.accepts([[True, True]])


def test_a_template_has_one_automaton_for_all_objects() -> None:
    machine = machine_of(
        'group people = class "person"\nspec apart(ego) = G (ego dist (people except ego) >= 1)'
    )
    assert len(machine.states) == 2


# ------------------------------------------------------------------------------------------ what has none


def test_every_operator_without_an_automaton_is_reported_with_its_place() -> None:
    with pytest.raises(NoAutomatonError) as raised:
        machine_of("spec done = (F[0, 2s] a ovlp b) and\n  (G (O a ovlp b))")
    message = str(raised.value)
    assert "task.spatial:1:13: error: `F[0s, 2s]` counts seconds" in message
    assert "task.spatial:2:6: error: `O` looks back" in message


def test_bounds_in_seconds_that_bound_nothing_are_accepted() -> None:
    assert machine_of("F[0s, inf] a ovlp b") == machine_of("F a ovlp b")
    assert machine_of("G[0s, 0s] a ovlp b").accepting == machine_of("G[0, 0] a ovlp b").accepting


@pytest.mark.parametrize("bound", ["[0, 9999]", "[10000, inf]", "[999999999, 9999999999]"])
def test_a_bound_of_too_many_samples_is_reported(bound: str) -> None:
    with pytest.raises(NoAutomatonError, match="unrolled into steps, there are more than 10000") as raised:
        machine_of(f"G{bound} a ovlp b")
    assert "task.spatial:1:1" in str(raised.value)


def test_a_bound_of_many_samples_is_unrolled() -> None:
    assert len(machine_of("F[0, 4000] a ovlp b").states) == 4003
    assert len(machine_of("(a ovlp b) U[0, 1000] (c ovlp d)").states) == 1003


@pytest.mark.parametrize("samples", [100, 249, 1000])
def test_deadlines_of_many_samples_take_a_state_for_each(samples: int) -> None:
    # not one for each set of deadlines that are still to be met
    assert len(machine_of(f"G (a ovlp b -> F[0, {samples}] c ovlp d)").states) == samples + 2


def test_deeply_nested_next_operators_compile() -> None:
    assert len(machine_of(f"{'X ' * 90} a ovlp b").states) == 93


def test_a_formula_that_is_too_large_is_reported_with_its_widest_window_and_every_reason() -> None:
    text = "spec done = F (a ovlp b and F[0, 9] c ovlp d)\nspec slow = G (a ovlp b -> F[20, 20] c ovlp d)"
    with pytest.raises(NoAutomatonError) as raised:
        automaton(parse_specification(text, filename="task.spatial"), "slow", compiler="own")
    assert str(raised.value).splitlines() == [
        "task.spatial:2:28: error: `F[20, 20]` leaves slow without an automaton: this package: the "
        "automaton takes more than 5000 states",
        "  spec slow = G (a ovlp b -> F[20, 20] c ovlp d)",
        "                             ^^^^^^^^^^^^^^^^^^",
        "  it is evaluated all the same; for an automaton, write smaller bounds, or split it into several "
        "specs",
    ]


@pytest.mark.parametrize(
    ("text", "operator", "reason"),
    [
        ("F[0, 111] a ovlp b", "F[0, 111]", "the formula nests 222 deep, at most 220 can be translated"),
        ("F[221, 221] a ovlp b", "F[221, 221]", "the formula nests 221 deep, at most 220 can be translated"),
        # each stands twice in what encloses it
        ("G X " * 16 + "a ovlp b", "G", "the formula has more than 20000 subformulas to translate"),
    ],
)
def test_a_formula_too_large_to_translate_for_mona_is_reported(text: str, operator: str, reason: str) -> None:
    with pytest.raises(NoAutomatonError) as raised:
        automaton(parse_specification(text, filename="task.spatial"), compiler="mona")
    message = str(raised.value)
    assert f"task.spatial:1:1: error: `{operator}` leaves " in message
    assert f"MONA: with its bounds unrolled {reason}" in message
    assert "for an automaton, write smaller bounds" in message


@pytest.mark.parametrize("value", ["F a ovlp b", None, b"F a ovlp b"])
def test_anything_but_a_specification_is_a_usage_error(value: object) -> None:
    with pytest.raises(
        UsageError, match=r"specification is .*; give a Specification, from parse_specification"
    ):
        automaton(value)  # type: ignore[arg-type]


def test_too_many_propositions_are_reported() -> None:
    text = " and ".join(f"(F p{number} >= 0)" for number in range(65))
    with pytest.raises(NoAutomatonError, match=r"`and` leaves .* 65 propositions, an automaton at most 64"):
        machine_of(text)


def responses(count: int) -> Automaton:
    return machine_of(" and ".join(f"(G ((a{n} >= 0) -> F b{n} >= 0))" for n in range(count)))


def test_twelve_responses_take_a_state_for_each_set_of_open_requests() -> None:
    machine = responses(12)
    assert (len(machine.states), len(machine.distances)) == (2**12, 2**12)
    # from any set of open requests, one sample may leave any other
    assert machine.successors[100] == tuple(machine.states)
    assert [each.target for each in next(machine.paths(100))] == [0]
    requests = [True, False] * 12
    assert not machine.accepts([requests]) and machine.accepts([requests, [False, True] * 12])


def test_of_an_automaton_with_too_many_transitions_the_states_nearest_to_the_start_are_shown() -> None:
    machine = responses(8)
    assert not machine.is_listable
    with pytest.raises(NoAutomatonError, match="more than 100000 cubes in the guards of its transitions"):
        _ = machine.transitions
    words = words_text(machine)
    assert words.splitlines()[-1].strip() == (
        "… 196 more states, more transitions and the rest of long guards are left out: there are too many"
    )
    assert "state 59:" in words and "state 60:" not in words
    assert "196 more states" in machine.to_dot()
    with pytest.raises(UsageError, match=r"Hanoi format needs every transition .*256 states"):
        machine.to_hoa()


def test_a_guard_of_too_many_cubes_is_cut_and_says_so() -> None:
    machine = machine_of(" xor ".join(f"(X p{number} >= 0)" for number in range(24)))
    assert (len(machine.states), len(machine.decisions)) == (4, 47)
    move = machine.transition(1, 3)
    assert move is not None and move.is_cut
    assert machine.guard_words(move).endswith(" or …")
    for cube in move.guard[:20]:
        assert machine.step(1, [dict(cube)[number] for number in range(24)]) == 3


def test_operands_are_compiled_by_themselves_where_that_is_smaller() -> None:
    # six deadlines: 2**6 sets of what is done, for each of 100 samples
    machine = machine_of(" and ".join(f"(F[0, 100] p{n} >= 0)" for n in range(6)))
    assert len(machine.states) == 100 * (2**6 - 1) + 3
    nested = machine_of("G (" + " and ".join(f"((a{n} >= 0) -> F b{n} >= 0)" for n in range(10)) + ")")
    assert nested.accepting == responses(10).accepting and nested.decisions == responses(10).decisions


def test_an_ambiguous_choice_of_spec_is_a_usage_error() -> None:
    specification = parse_specification("spec reach = F p >= 0\nspec stay = G p >= 0")
    with pytest.raises(UsageError, match="several results; choose one with name=: reach, stay"):
        automaton(specification)
    with pytest.raises(UsageError, match="did you mean 'reach'"):
        automaton(specification, "raech")
    with pytest.raises(UsageError, match="'own' and 'mona'"):
        automaton(specification, "reach", compiler="spot")  # type: ignore[arg-type]
    assert automaton(specification, "stay").name == "stay"


# ------------------------------------------------------------------------------------ bounds in seconds


def test_bounds_in_seconds_count_samples_at_a_stated_rate() -> None:
    text = "(F[0s, 0.3s] p >= 0) and G ((p >= 0) -> (q >= 0) U[100ms, 0.2s] (r >= 0))"
    specification = parse_specification(text)
    samples = machine_of("(F[0, 3] p >= 0) and G ((p >= 0) -> (q >= 0) U[1, 2] (r >= 0))")
    assert automaton(specification, rate_hz=10) == samples
    # between two samples, a window has those that are in it
    assert automaton(parse_specification("F[0.05s, 0.39s] p >= 0"), rate_hz=10) == machine_of(
        "F[1, 3] p >= 0"
    )
    assert automaton(parse_specification("F[2s, inf] p >= 0"), rate_hz=1.5) == machine_of("F[3, inf] p >= 0")


def test_bounds_in_seconds_without_a_sample_or_a_rate_are_reported() -> None:
    specification = parse_specification("F[1ms, 2ms] a ovlp b", filename="task.spatial")
    with pytest.raises(NoAutomatonError, match=r"task.spatial:1:1: error: no sample is in the window of `F"):
        automaton(specification, rate_hz=30)
    with pytest.raises(NoAutomatonError, match=r"state the samples a second \(--hz, rate_hz\)"):
        automaton(specification)
    for rate in (0, -30.0, float("inf"), float("nan"), "30"):
        with pytest.raises(UsageError, match="give samples a second, above 0"):
            automaton(specification, rate_hz=rate)  # type: ignore[arg-type]


def test_an_automaton_of_a_log_is_not_taken_for_one_of_another_rate() -> None:
    specification = parse_specification("F[0s, 1s] p >= 0")
    made = automaton(specification, rate_hz=2)
    stored = [stored_text(made, specification, specification.specs[0]).encode()]
    assert automaton(specification, rate_hz=3, stored=stored) == machine_of("F[0, 3] p >= 0")


def test_another_threshold_changes_what_propositions_say_and_no_move() -> None:
    text = "const near = {}\nspec met = G (a closeto[near] b -> F[0,3] a closeto[5] b)"
    first, second, same = (automaton(parse_specification(text.format(near))) for near in (1, 2, 5))
    assert [each.text for each in second.propositions] == ["a closeto[2] b", "a closeto[5] b"]
    assert [each.text for each in first.propositions] == ["a closeto[1] b", "a closeto[5] b"]
    assert first.with_propositions(second.propositions) == second
    # with one threshold for both, the two propositions are one, and the automaton another
    assert len(same.propositions) == 1
    assert len(same.states) < len(second.states)


def test_conditions_that_logic_alone_excludes_stay_different_propositions():
    never = [f"F (cup leftof {one} and cup rightof {one})" for one in ("fork", "plate")]
    automaton = sr.automaton(sr.parse_specification(" and ".join(f"({each})" for each in never)))
    assert len(automaton.propositions) == 2

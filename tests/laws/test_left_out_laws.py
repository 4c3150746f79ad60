"""Laws of samples and members that are left out, because a rate has no value there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import CLASSES, HEADER, NAMES, WORDS, recordings
from laws.strategies_spec import formula_texts
from spatial_replay import NoAutomatonError, automaton, evaluate, parse_specification
from spatial_replay.monitor.offline import evaluate_offline

without_rates = formula_texts(replace(WORDS, rates=False))
with_rates = formula_texts(replace(WORDS, max_depth=2))


@examples(80)
@given(text=without_rates, other=with_rates, recording=recordings())
def test_a_conjunct_without_rates_is_untouched_by_one_with(text, other, recording):
    specification = parse_specification(
        f"{HEADER}spec own = {text}\nspec alone = own\nspec task = own and ({other})\n"
    )
    evaluation = evaluate(specification, recording.trace())
    alone, task = (evaluation.result(name) for name in ("alone", "task"))
    nodes = {node.name: node for node in (*alone.nodes, *task.nodes)}
    (alone_id,) = (node.id for node in alone.nodes if node.name == "own")
    count = len(alone.nodes) - alone_id
    task_id = nodes["own"].id
    assert task.series[task_id : task_id + count].tobytes() == alone.series[alone_id:].tobytes()
    assert task.final[task_id : task_id + count].tobytes() == alone.final[alone_id:].tobytes()


_bodies = st.sampled_from(
    ["speed(p) <= 4", "(speed(p) <= 4) and (a dist p <= 3)", "(speed(p) >= 1) -> (speed(p, a) <= 2)"]
)


@examples(80)
@given(body=_bodies, recording=recordings(max_size=7))
def test_members_are_judged_as_instances_of_a_template_are_while_they_are_present(body, recording):
    """New members are left out at their first sample."""
    specification = parse_specification(
        f"spec every = G (forall p in all: {body})\nspec own(p) = G (present(p) -> ({body}))\n"
    )
    evaluation = evaluate(specification, recording.trace(), each={"p": "all"})
    every, *own = [result.final[0] for result in evaluation]
    np.testing.assert_array_equal(every, np.min([*own, [np.inf, np.inf]], axis=0))


@examples(60)
@given(data=st.data(), class_name=st.sampled_from(CLASSES), recording=recordings(max_size=6))
def test_the_order_of_members_changes_no_bit(data, class_name, recording):
    specification = parse_specification(
        f'spec calm = G (forall p in class "{class_name}": speed(p) <= 3)\n'
        f'spec runs = F (exists p, q in class "{class_name}": speed(p, q) >= 1)\n'
    )
    names = dict(zip(NAMES, data.draw(st.permutations(NAMES)), strict=True))
    swapped = [
        replace(
            sample,
            objects={names[name]: tracked for name, tracked in reversed(sample.objects.items())},
            reported_ns={names.get(name, name): at_ns for name, at_ns in sample.reported_ns.items()},
            lasting=frozenset(names[name] for name in sample.lasting),
        )
        for sample in recording.samples
    ]
    unreadable = frozenset((t, names[name]) for t, name in recording.unreadable)
    results = evaluate(specification, recording.trace())
    others = evaluate(
        specification, replace(recording, samples=tuple(swapped), unreadable=unreadable).trace()
    )
    for result, other in zip(results, others, strict=True):
        np.testing.assert_array_equal(result.series, other.series)


_ahead = replace(WORDS, past=False, times=False, max_depth=3)


@examples(100)
@given(text=formula_texts(_ahead), recording=recordings(max_size=6))
def test_automata_accept_what_is_satisfied_with_samples_left_out(text, recording):
    specification = parse_specification(f"{HEADER}spec s = {text}\n")
    try:
        machine = automaton(specification)
    except NoAutomatonError:
        assume(False)
    (result,) = evaluate(specification, recording.trace())
    order = result.evidence.instance.program.leaves
    symbols = []
    for proposition in machine.propositions:
        done = evaluate_offline(proposition.formula, order, result.leaves, result.times_ns)
        low, high = done.ends(0)
        symbols.append(
            [True if a >= 0.0 else False if b < 0.0 else None for a, b in zip(low, high, strict=True)]
        )
    possible = frozenset({machine.initial})
    for symbol in zip(*symbols, strict=True):
        possible = machine.step_set(possible, list(symbol))
    if symbols and result.lower > 0.0:
        assert possible & machine.accepting
    if symbols and result.upper < 0.0:
        assert possible - machine.accepting
    if symbols and result.lower == result.upper != 0.0 and len(possible) == 1:
        assert bool(possible & machine.accepting) == (result.lower > 0.0)

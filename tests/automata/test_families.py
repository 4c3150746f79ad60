"""Families of formulas from the literature: which have an automaton, and whether it is right."""

from __future__ import annotations

import random

import pytest

from automata.families import FAMILIES, holds, random_conjunction
from spatial_replay import NoAutomatonError, automaton, parse_specification

WORDS = 40
LONGEST = 14


def check(text: str) -> bool:
    """Compile a formula, and compare what its automaton says of random words with the definition of LTLf."""
    specification = parse_specification(text)
    try:
        machine = automaton(specification, compiler="own")
    except NoAutomatonError:
        return False
    formula = specification.specs[0].formula
    numbers = {each.text: number for number, each in enumerate(machine.propositions)}
    rng = random.Random(text)

    for _ in range(WORDS):
        often = rng.choice((0.1, 0.5, 0.9))
        word = [[rng.random() < often for _ in numbers] for _ in range(rng.randint(1, LONGEST))]
        assert machine.accepts(word) == holds(formula, word, numbers), (text, word)
    return True


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_is_compiled_at_size_eight_and_right(name: str) -> None:
    # a counter of eight bits would be in 2**16 states
    sizes = (1, 2, 3, 5, 8) if name != "counter" else (1, 2, 3, 5)
    assert [size for size in sizes if not check(FAMILIES[name](size))] == []


def test_of_random_conjunctions_those_are_compiled_that_fit_and_all_are_right() -> None:
    drawn = [(length, seed) for length in (2, 4, 7) for seed in range(2)]
    refused = [each for each in drawn if not check(random_conjunction(*each))]
    assert refused == []
    assert not check(random_conjunction(12, 0))

"""Which objects a formula is about, and in which sign."""

from __future__ import annotations

import numpy as np

from spatial_replay.annotate.requirements import ClassMembers, Requirement, requirements_of
from spatial_replay.annotate.violations import EvaluatedResult, Presence, worst_robustness
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Earlier,
    Enlarged,
    Group,
    Number,
    Quantified,
    RegionName,
    Temporal,
    TrackedName,
    Variable,
    iter_nodes,
)


def atom(*terms) -> Atom:
    return Atom("…", "closeto", Number(0.0), terms=terms)


A, B, GOAL = TrackedName("a"), TrackedName("b"), RegionName("goal")
NOTHING: frozenset[str] = frozenset()


def signs(formula) -> list[tuple[int, float]]:
    return [(requirement.node, requirement.sign) for requirement in requirements_of(formula)]


def test_a_formula_without_temporal_operators_is_one_requirement():
    formula = Boolean("not", (Boolean("->", (atom(A, B), atom(A, GOAL))),))
    assert requirements_of(formula) == (
        Requirement(0, 1.0, None, frozenset("ab"), frozenset({"goal"}), frozenset()),
    )


def test_requirements_are_the_largest_subformulas_below_temporal_operators():
    both = Boolean("and", (atom(A, B), atom(A, GOAL)))
    formula = Boolean("and", (Temporal("F", (both,)), Temporal("U", (atom(A), Temporal("G", (atom(B),))))))
    assert signs(formula) == [(2, 1.0), (6, 1.0), (8, 1.0)]


def test_negations_and_the_left_of_an_implication_turn_the_sign():
    later = Temporal("F", (atom(B),))
    assert signs(Boolean("not", (later,))) == [(2, -1.0)]
    assert signs(Boolean("->", (atom(A), later))) == [(1, -1.0), (3, 1.0)]
    assert signs(Boolean("->", (Boolean("not", (later,)), later))) == [(3, 1.0), (5, 1.0)]
    assert signs(Boolean("<->", (atom(A), later))) == []
    assert signs(Boolean("xor", (atom(A), later))) == []


def test_delays_and_enlargements_of_terms_do_not_matter():
    named = Group("reds", members=("red1", "red2"), excluded=(TrackedName("red2"),))
    [requirement] = requirements_of(atom(Enlarged(Earlier(A, samples=2), 1.0), Earlier(named, samples=1)))
    assert requirement.objects == {"a", "red1"}


def test_a_parameter_is_replaced_by_its_object():
    others = Group("people", class_name="Pedestrian", excluded=(Variable("ego"),))
    [requirement] = requirements_of(atom(Variable("ego"), others), "7")
    assert requirement.objects == {"7"}
    assert requirement.groups == {ClassMembers("pedestrian", frozenset({"7"}))}


def test_a_quantifier_is_about_the_members_of_its_group():
    everyone = Group("everyone", class_name="*")
    formula = Quantified("forall", ("x",), Earlier(everyone, samples=1), atom(Variable("x"), A))
    [requirement] = requirements_of(formula)
    assert (requirement.objects, requirement.groups) == ({"a"}, {ClassMembers("*", NOTHING)})


def test_open_groups_have_the_members_of_each_sample():
    cups = Group("cups", class_name="cup", excluded=(B,))
    formula = atom(cups)
    times = np.array([0, 1, 2])
    codes = np.array([[0, 0, 1], [0, -1, 0], [-1, 0, 1]])
    presence = Presence(times, ["a", "b", "c"], codes, ["Cup", None])
    series = np.array([[[-1.0] * 3, [-1.0, 2.0, 3.0], [-1.0] * 3, [-1.0] * 3]])
    assert len(list(iter_nodes(formula))) == len(series)
    objects, regions = worst_robustness(
        [EvaluatedResult(requirements_of(formula), SeriesBlock(times, series, np.empty((1, 0, 3))))],
        presence,
        ["goal"],
    )
    nan = np.nan
    assert np.array_equal(objects, [[-1.0, nan, nan], [2.0, nan, 2.0], [nan] * 3], equal_nan=True)
    assert np.isnan(regions).all()

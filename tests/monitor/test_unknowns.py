"""Unknown, unreadable and uncertain data never read as satisfied or violated."""

from __future__ import annotations

from math import inf, isnan, nan

import numpy as np
import pytest

from monitor.scenes import numbers, points, root, with_unreadable
from spatial_replay import Footprint, Sample, Trace, TrackedObject


def test_an_absent_object_is_unknown():
    node = root("G a dist b <= 5", points(a=[0, 0, 0], b=[1, None, 2]))
    np.testing.assert_array_equal(node.now, [4, nan, 3])
    assert node.verdict == "unknown"
    assert (node.final_lower, node.final_upper) == (-inf, 3)


def test_an_object_or_signal_missing_from_the_log_is_unknown():
    assert root("a ovlp ghost", points(a=[0])).verdict == "unknown"
    assert root("F charge >= 0", numbers(p=[1])).verdict == "unknown"


def test_an_unreadable_observation_is_not_an_absent_one():
    trace = points(a=[0, 0], b=[1, 9])
    assert root("G forall x in (all except a): a dist x <= 2", trace).verdict == "violated"
    lost = with_unreadable(trace, 1, "b")
    assert root("G forall x in (all except a): a dist x <= 2", lost).verdict == "unknown"
    left = points(a=[0, 0], b=[1, None])
    assert root("G forall x in (all except a): a dist x <= 2", left).verdict == "satisfied"


def test_an_unreadable_observation_keeps_its_class():
    trace = with_unreadable(points(a=[0], b=[9], classes={"b": "Person"}), 0, "b")
    assert root('exists x in class "person": a dist x >= 0', trace).verdict == "unknown"
    assert root('exists x in class "cart": a dist x >= 0', trace).verdict == "violated"
    assert root('(class "person") dist a >= 0', trace).verdict == "unknown"


def test_a_named_group_needs_all_members_and_an_open_one_those_present():
    trace = points(a=[0], b=[3], c=[None], classes={"b": "cup", "c": "cup"})
    named = "group g = b, c\nspec s = a dist g <= 4"
    opened = 'group g = class "cup"\nspec s = a dist g <= 4'
    assert root(named, trace).verdict == "unknown"
    assert root(opened, trace).robustness == 1
    assert root("group g = b, c\nspec s = a dist (g except c) <= 4", trace).robustness == 1


def test_an_empty_group_is_infinitely_far():
    trace = points(a=[0])
    assert root('a dist (class "cup") <= 4', trace).robustness == -inf
    assert root('a dist (class "cup") >= 4', trace).robustness == inf
    assert root('(class "cup") leftof a', trace).robustness == inf
    assert root('forall x in class "cup": x ovlp a', trace).robustness == inf
    assert root('exists x in class "cup": x ovlp a', trace).robustness == -inf
    assert root("forall x, y in all: x dist y >= 5", trace).robustness == inf
    assert root('a closer (class "cup") than (class "mug")', trace).verdict == "unknown"
    assert root("group g = a\nspec s = (g except a) dist a >= 4", trace).robustness == inf


def test_uncertainty_widens_the_interval_and_leaves_the_value():
    node = root("G a dist b >= 2", points(a=[0, 0], b=[5, 3], uncertainty=0.75))
    assert node.value.tolist() == [3, 1]
    assert (node.final_lower, node.final_upper) == (-0.5, 2.5)
    assert node.verdict == "unknown"
    assert root("G a dist b >= 1", points(a=[0, 0], b=[5, 3], uncertainty=0.75)).verdict == "satisfied"


def test_each_term_of_a_relation_is_uncertain_and_a_group_as_its_least_certain_member():
    def seen(x, uncertainty):
        return TrackedObject(Footprint.disc(x, 0, 0), uncertainty=uncertainty)

    trace = Trace.from_samples([Sample(0, {"a": seen(0, 0.1), "b": seen(4, 0.5), "c": seen(9, 0.0)})])
    closer = root("a closer b than c", trace)
    assert (closer.final_lower, closer.final_upper) == pytest.approx((5 - 0.7, 5 + 0.7))
    grouped = root("group g = b, c\nspec s = a dist g >= 0", trace)
    assert (grouped.final_lower, grouped.final_upper) == pytest.approx((4 - 0.6, 4 + 0.6))
    left = root("a leftof b", trace)
    assert (left.final_lower, left.final_upper) == pytest.approx((4 - 0.6, 4 + 0.6))


def test_a_missing_orientation_is_unknown_and_has_no_uncertainty():
    def turned(yaw):
        return TrackedObject(Footprint.disc(0, 0, 1), yaw=yaw, uncertainty=3.0)

    sample = Sample(0, {"a": turned(0.0), "b": turned(np.pi / 2), "c": turned(None)})
    trace = Trace.from_samples([sample])
    node = root("a oriented[0.5] b", trace)
    assert (node.final_lower, node.final_upper) == pytest.approx((-0.5, -0.5))
    assert isnan(root("a oriented[0.5] c", trace).robustness)


def test_relations_along_z_need_heights():
    def tall(height):
        return TrackedObject(Footprint.disc(0, 0, 1), height=height)

    sample = Sample(0, {"a": tall((0, 1)), "b": tall((3, 4)), "c": tall(None)})
    trace = Trace.from_samples([sample])
    assert root("a prec[z] b", trace).robustness == 2
    assert root("a dist b >= 0", trace).robustness == 2
    assert root("a prec[z] c", trace).verdict == "unknown"
    assert root("a dist c <= 0", trace).robustness == 2


def test_a_verdict_needs_no_more_than_what_decides_it():
    trace = points(a=[0], b=[1])
    assert root("a dist b <= 5 or ghost ovlp a", trace).verdict == "satisfied"
    assert root("a dist b >= 5 and ghost ovlp a", trace).verdict == "violated"
    assert isnan(root("a dist b <= 5 or ghost ovlp a", trace).robustness)
    assert root("ghost ovlp a or not ghost ovlp a", trace).verdict == "unknown"


def test_a_region_looked_back_at_from_the_first_sample_is_unknown():
    node = root("region goal = box(0, -1, 9, 1)\nspec s = a enclosedin goal[-1]", points(a=[5, 5]))
    np.testing.assert_array_equal(node.now, [nan, 1])

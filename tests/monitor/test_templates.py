"""Templates: one result for each object that a parameter stands for."""

from __future__ import annotations

import pytest

from monitor.scenes import SECOND, judged, points
from spatial_replay import UsageError

ALONE = "group g = all\nspec alone(ego) = G (ego dist (g except ego) >= 2)"
CLASSES = {"a": "Person", "b": "person", "c": "cart"}


@pytest.fixture
def trace():
    return points(a=[0, 0, 0, None], b=[None, 3, 1, 2], c=[9, 9, None, None], classes=CLASSES)


def test_a_template_has_one_result_per_object_over_its_samples(trace):
    evaluation = judged(ALONE, trace, each={"ego": "all"})
    assert [(r.name, r.object, (r.times_ns // SECOND).tolist(), r.robustness) for r in evaluation] == [
        ("alone", "a", [0, 1, 2], -1),
        ("alone", "b", [1, 2, 3], -1),
        ("alone", "c", [0, 1], 4),
    ]
    assert repr(evaluation.result("alone", "c")) == "<alone for c: satisfied, robustness 4>"


def test_a_class_is_matched_without_regard_to_case(trace):
    assert [r.object for r in judged(ALONE, trace, each={"ego": "class:PERSON"})] == ["a", "b"]
    assert [r.object for r in judged(ALONE, trace, each={"ego": "class:dog"})] == []


def test_a_window_limits_the_objects_and_their_times(trace):
    evaluation = judged(ALONE, trace, each={"ego": "all"}, start_ns=2 * SECOND)
    spans = {r.object: (r.times_ns // SECOND).tolist() for r in evaluation}
    assert spans == {"a": [2], "b": [2, 3]}


def test_an_object_is_unknown_while_it_is_absent():
    trace = points(ego=[None, 0, None, 0], b=[5, 5, 5, 5])
    text = "spec near(ego) = G ego dist b <= 6"
    result = judged(text, trace, each={"ego": "all"}).result("near", "ego")
    assert len(result.times_ns) == 3
    assert result.verdict == "unknown"


def test_terms_look_before_an_object_appears():
    trace = points(a=[None, 0, 0], b=[4, 5, 6])
    text = "spec s(ego) = ego dist b[-1] >= 0"
    result = judged(text, trace, each={"ego": "all"}).result("s", "a")
    assert result.nodes[0].now.tolist() == [4, 5]


def test_a_template_and_a_spec_are_evaluated_together(trace):
    evaluation = judged(f"{ALONE}\nspec seen = F a ovlp a", trace, each={"ego": "class:cart"})
    assert [(r.name, r.object) for r in evaluation] == [("alone", "c"), ("seen", None)]
    assert evaluation.result("seen").object is None


def test_a_node_of_several_objects_needs_the_object(trace):
    evaluation = judged(ALONE, trace, each={"ego": "all"})
    assert evaluation.node("alone", "c").robustness == 4
    with pytest.raises(UsageError, match=r"3 nodes are named 'alone'; say of which object: object="):
        evaluation.node("alone")
    with pytest.raises(UsageError, match=r"3 results fit .*there are alone for a, alone for b, alone for c"):
        evaluation.result("alone")


def test_a_template_needs_its_objects(trace):
    with pytest.raises(UsageError, match=r"alone\(ego\) is a template: say what ego stands for, --each ego="):
        judged(ALONE, trace)


def test_an_unknown_parameter_is_refused(trace):
    with pytest.raises(UsageError, match=r"no template has a parameter 'car'; templates here: alone\(ego\)"):
        judged(ALONE, trace, each={"ego": "all", "car": "all"})
    with pytest.raises(UsageError, match="templates here: none"):
        judged("a ovlp b", trace, each={"ego": "all"})


@pytest.mark.parametrize("choice", ["", "class:"])
def test_an_invalid_choice_of_objects_is_refused(trace, choice):
    with pytest.raises(UsageError, match=r"chooses no objects; write ego=all, ego=class:NAME or ego=OBJECT"):
        judged(ALONE, trace, each={"ego": choice})

from __future__ import annotations

import pytest

import spatial_replay as sr
from pages import shown

TASK = """
const near = 0.1
region goal = box(0, 0, 1, 1)
group reds = red1, red2
spec reach = F (forall r in reds: r enclosedin goal)
spec task = reach and G (red1 dist red2 >= near)
"""


def test_a_page_shows_the_parts_of_a_specification():
    text = shown(sr.parse_specification(TASK))
    for word in ("task = and", "reach = F", "red1 dist red2 >= 0.1", "constants: near", "regions: goal"):
        assert word in text


def test_texts_of_a_specification_are_escaped():
    text = shown(
        sr.parse_specification("""F ("<script>alert(1)</script>" ovlp "<img src=x onerror=alert(1)>")""")
    )
    assert "<script>alert(1)</script>" in text


def wide(count):
    """A tree of two nodes for each of so many objects, and one more."""
    names = ", ".join(f"a{number}" for number in range(count))
    return sr.parse_specification(
        f"group all_of_them = {names}\nspec met = exists a in all_of_them: F a ovlp b"
    )


def test_a_page_of_a_large_tree_stays_small_and_says_what_it_leaves_out():
    specification = wide(4000)
    assert "… and 7,801 nodes more" in shown(specification)
    assert len(specification._repr_html_()) < 100_000


def test_a_page_of_a_deep_tree_stays_small():
    specification = sr.parse_specification("X " * 90 + "a ovlp b")
    assert "a ovlp b" in shown(specification)
    assert len(specification._repr_html_()) < 50_000


@pytest.mark.usefixtures("figures")
def test_a_drawing_has_a_label_for_each_node():
    ax = sr.parse_specification(TASK).plot()
    labels = [text.get_text() for text in ax.texts]
    assert {"task", "reach", "F", "G", "red1 dist red2 >= 0.1"} <= set(labels)
    assert ax.get_title(loc="left") == "<text>"


@pytest.mark.usefixtures("figures")
def test_a_drawing_of_a_large_tree_says_how_many_nodes_it_shows():
    ax = wide(500).plot()
    assert ax.get_title(loc="left") == "<text>, the first 60 of 1,001 nodes"


@pytest.mark.usefixtures("figures")
def test_dollars_are_not_read_as_mathematics():
    ax = sr.parse_specification('F ("$x^" ovlp "$y_")').plot()
    ax.figure.canvas.draw()


@pytest.mark.usefixtures("figures")
def test_a_drawing_goes_into_given_axes():
    specification = sr.parse_specification(TASK)
    ax = specification.plot()
    assert sr.parse_specification("F a ovlp b").plot(ax) is ax

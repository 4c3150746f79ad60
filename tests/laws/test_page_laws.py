"""What holds for the pages of notebooks, whatever they show."""

from __future__ import annotations

from xml.etree import ElementTree

from hypothesis import example, given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from laws.strategies_spec import specification_texts
from pages import shown
from spatial_replay.html import element
from spatial_replay.spec.format import iter_branches, label_of
from spatial_replay.text import LARGEST_PLAIN, number_text, printable


@given(st.text())
def test_any_text_is_shown_as_text(text):
    page = ElementTree.fromstring(element("p", text))
    assert page.text in (None, printable(text))
    assert len(page) == 0


@example(9999.6)
@given(st.floats(1e-4, LARGEST_PLAIN, exclude_max=True))
def test_numbers_of_usual_size_have_no_exponent(number):
    for signed in (number, -number):
        text = number_text(signed)
        assert "e" not in text
        assert abs(float(text) - signed) <= 5e-4 * number


@examples(50)
@given(specification_texts())
def test_a_page_shows_every_node_of_a_small_specification(text):
    specification = sr.parse_specification(text)
    page = shown(specification)
    for spec in specification.results:
        for _, _, node in iter_branches(spec.formula):
            assert label_of(node) in page

from __future__ import annotations

import spatial_replay as sr
from pages import shown

TASK = """
spec hit = cup ovlp fork
spec task = (G not hit) and (F (cup closeto[0.1] plate and not hit))
"""


def automaton(text=TASK):
    return sr.automaton(sr.parse_specification(text))


def test_a_page_lists_states_and_transitions():
    text = shown(automaton())
    for word in ("task 3 states", "a trap: acceptance is lost", "cup closeto[0.1] plate"):
        assert word in text


def test_a_page_of_a_large_automaton_shows_its_size():
    text = shown(automaton("F[0, 60] (a ovlp b)"))
    assert "too large to be drawn here" in text
    assert automaton("F[0, 60] (a ovlp b)")._repr_svg_() is None


def test_texts_of_an_automaton_are_escaped():
    text = shown(automaton('F ("<script>alert(1)</script>" ovlp "<img src=x onerror=alert(1)>")'))
    assert "<script>alert(1)</script>" in text


def test_a_page_without_graphviz_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "install Graphviz to see it drawn" in shown(automaton())
    assert automaton()._repr_svg_() is None

"""Automata drawn by Graphviz, in figures."""

from __future__ import annotations

import shutil

import pytest

from notebook.test_automaton_view import automaton

pytestmark = [
    pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed"),
    pytest.mark.usefixtures("figures"),
]


def test_a_drawing_has_every_state_and_names_long_propositions():
    ax = automaton().plot()
    labels = [text.get_text() for text in ax.texts]
    assert {"0", "1", "2"} <= set(labels)
    assert any("p0: " in label for label in labels)
    assert len(ax.patches) > 3
    ax.figure.canvas.draw()


def test_short_names_differ_from_names_of_the_specification():
    text = "spec p0 = cup ovlp fork\nspec task = F (p0) and F (cup closeto[0.1] plate)"
    labels = [text.get_text() for text in automaton(text).plot().texts]
    assert "p0: cup ovlp fork\np1: cup closeto[0.1] plate" in labels

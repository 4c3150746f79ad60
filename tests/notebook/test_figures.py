"""Figures where their library is, and where it is not."""

from __future__ import annotations

import subprocess
import sys
from html import unescape

import pytest

import spatial_replay as sr

WITHOUT = "import sys; sys.modules['matplotlib'] = None\n"


def outcome(program):
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False, text=True)
    return done.returncode, done.stderr


def test_without_matplotlib_an_error_says_what_to_install():
    program = "import spatial_replay as sr\nsr.parse_specification('F a ovlp b').plot()"
    code, said = outcome(WITHOUT + program)
    assert code != 0
    assert "UsageError" in said
    assert "pip install 'spatial-replay[notebook]'" in said


def test_without_matplotlib_pages_are_shown():
    program = "import spatial_replay as sr\nsr.parse_specification('F a ovlp b')._repr_html_()"
    assert outcome(WITHOUT + program) == (0, "")


@pytest.mark.parametrize(
    "used",
    [
        "spatial_replay.automata.automaton",
        "spatial_replay.monitor.result",
        "spatial_replay.planning.planner",
        "spatial_replay.spec.load",
    ],
)
def test_matplotlib_loads_when_something_is_drawn(used):
    program = f"import sys, {used}\nsys.exit('matplotlib' in sys.modules)"
    assert outcome(program) == (0, "")


def test_a_notebook_shows_the_text_of_a_result():
    found = sr.doctor(sr.parse_specification("spec late = G (cup dist jug < 0.5)"))
    shown = found._repr_html_()
    lines = chr(10).join(found.lines())
    assert unescape(shown) == f'<pre style="white-space:pre-wrap">{lines}</pre>'

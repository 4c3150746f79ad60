"""Learned specifications in notebooks: their specs with the evidence, and the check on runs left out."""

from __future__ import annotations

from spatial_replay.learning.learned import Learned, checked_text
from spatial_replay.notebook import html
from spatial_replay.notebook.figures import Html, element, quiet, table
from spatial_replay.text import counted, number_text


@html.register(Learned)
def learned_html(learned: Learned) -> Html:
    """Return the specs in words and as text, with their evidence."""
    bad = sum(not is_good for _, is_good in learned.runs)
    rows = [
        (line.title, line.text, number_text(line.lowest), f"{len(line.violated_by)} of {bad}")
        for line in learned.lines
    ]
    notes = [f"Not distinguished: {', '.join(learned.missed)}."] if learned.missed else []
    notes += [checked_text(learned.checked)] if learned.checked else []
    notes += [f"Not compared: {each}." for each in learned.left_out]
    return element(
        "div",
        element("div", f"learned {counted(len(rows), 'spec')} from {counted(len(learned.runs), 'run')}"),
        table(
            ["what it says", "formula", "lowest robustness of good runs", "bad runs that violate it"], rows
        ),
        *(element("div", quiet(each)) for each in notes),
    )

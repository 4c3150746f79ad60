"""What a search for failures has found, in notebooks."""

from __future__ import annotations

from typing import Final

from spatial_replay.falsification.failures import Failure, Falsification
from spatial_replay.notebook import html
from spatial_replay.notebook.figures import Html, element, folded, quiet, table, verdict_mark
from spatial_replay.text import counted, number_text

_MOST_ROWS: Final = 20
"""The most failures that are shown."""


@html.register(Falsification)
def falsification_html(found: Falsification) -> Html:
    """Return the failures, the worst first, or the lowest run; and what of each parameter was tried."""
    runs, failures = counted(len(found.runs), "run"), counted(len(found.failures), "failure")
    title = element("div", verdict_mark(found.verdict), f" {found.name}: {failures} in {runs}")
    lowest = found.lowest
    text = f"lowest: {number_text(lowest.robustness)} of {lowest.spec} with {found.text_of(lowest.case)}"
    notes = [f"{len(found.failures) - _MOST_ROWS} more failures"] if len(found.failures) > _MOST_ROWS else []
    notes += ["the search ended early: there was nothing else to try"] if found.is_exhausted else []
    rows = [_row(found, each) for each in found.failures[:_MOST_ROWS]]
    headings = ["robustness", "spec", "with", "made smaller", "clip"]
    covered = [
        (
            each.parameter,
            f"{each.low:g} to {each.high:g} {each.unit}".strip(),
            " ".join(map(str, each.tenths)),
        )
        for each in found.coverage
    ]
    return element(
        "div",
        title,
        table(headings, rows) if rows else element("div", text),
        *(element("div", quiet(note)) for note in notes),
        folded("what was tried", table(["parameter", "range", "runs in each tenth"], covered)),
    )


def _row(found: Falsification, failure: Failure) -> tuple[str, ...]:
    run, smaller = failure.run, failure.smaller
    least = found.text_of(smaller.case) if failure.is_smaller else "as it is"
    return number_text(run.robustness), run.spec, found.text_of(run.case), least, failure.clip.name

"""What the doctor finds in a specification, in notebooks: findings, and the shortest runs of each spec."""

from __future__ import annotations

from spatial_replay.notebook import html
from spatial_replay.notebook.figures import Html, element, folded, quiet, table
from spatial_replay.sanity.examine import Examination, SpecExamination
from spatial_replay.sanity.examples import Example
from spatial_replay.text import counted, number_text


@html.register(Examination)
def examination_html(found: Examination) -> Html:
    """Return the findings, and for each spec its shortest runs and what was left undecided."""
    rows = [
        (element("b", each.kind), ", ".join(each.specs), each.diagnostic.message) for each in found.findings
    ]
    title = f"{counted(len(rows), 'finding')} in {counted(len(found.specs), 'result')}"
    return element(
        "div",
        element("div", title),
        *([table(["what", "about", "why"], rows)] if rows else []),
        table(["spec", "satisfied by", "violated by"], map(_spec_row, found.specs)),
        *(element("div", quiet(note)) for note in found.notes),
    )


def _spec_row(spec: SpecExamination) -> tuple[str, str, str]:
    left = [f"no automaton: {spec.reason}"] if spec.reason else []
    left += [f"not decided: {question}" for question in spec.undecided]
    left += [f"geometry says nothing about: {text}" for text in spec.unrelated]
    name = element("div", element("b", spec.name), *(element("div", quiet(each)) for each in left))
    return name, _example(spec.satisfied), _example(spec.violated)


def _example(example: Example | None) -> str:
    if example is None:
        return quiet("none shown")
    lines = [element("div", f"{number}  {sentence}") for number, sentence in enumerate(example.sentences)]
    of = "in words only" if example.robustness is None else f"robustness {number_text(example.robustness)}"
    return folded(f"{counted(len(lines), 'sample')}, {of}", *lines)

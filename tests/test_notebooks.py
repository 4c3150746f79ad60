"""The tutorials in notebooks/, run from the first cell to the last in a kernel."""

from __future__ import annotations

import re
from base64 import b64decode
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import nbformat
import pytest
from matplotlib import font_manager
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"


class Expected(NamedTuple):
    """What a notebook shows.

    Attributes:
        folder: where it is started.
        figures: how many there are.
        words: what is to be read in its outputs.
    """

    folder: Path
    figures: int
    words: tuple[str, ...]


EXPECTED = {
    "record-and-replay": Expected(
        NOTEBOOKS,
        2,
        ("■ satisfied", "pending", "(True, True)", "first satisfied at 8.100 s", "annotated.mcap"),
    ),
    "edit-a-specification": Expected(
        ROOT,
        4,
        (
            "■ violated",
            "table_set is violated: spoon dist plate <= 0.08 at 4.000 s",
            "with 0.2353 instead of 0.08",
            "satisfied from a deadline of 5 s on",
            "patient: satisfied",
        ),
    ),
    "from-a-bag-to-a-verdict": Expected(
        NOTEBOOKS,
        2,
        (
            "301 samples",
            "It was violated first at 13.800 s, by 0.03135",
            "too close from 13.8 s on, by up to 0.103 m",
            "violated annotated.mcap drive.bag drive.html drive.yaml",
        ),
    ),
    "from-a-video-to-a-verdict": Expected(
        NOTEBOOKS,
        2,
        (
            "8 tags in (600, 800, 3)",
            "red    within 0.4 mm",
            "reference tags fit within 0.",
            "apart: satisfied, truly satisfied; within its bounds: True",
            "far: violated, truly violated; within its bounds: True",
            "samples, messages, specifications and results match",
        ),
    ),
    "look-into-a-planner-run": Expected(
        NOTEBOOKS,
        5,
        (
            "0 -> 2 -> 3",
            "given up: no object can do it",
            "state 0  execute red: pushed red straight to its place",
            "state 3  hold",
            "push: satisfied",
            "violated: red dist blue >= 0.08 fails by 0.0148 m",
        ),
    ),
}


@pytest.fixture(scope="module")
def outputs():
    """The outputs of each notebook; all run in one kernel, which forgets its names in between."""
    # the first to draw on a machine looks for fonts, and remarks on it
    assert font_manager.findfont("DejaVu Sans")
    read = {name: nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4) for name in EXPECTED}
    whole = nbformat.v4.new_notebook()
    for name, notebook in read.items():
        begin = nbformat.v4.new_code_cell(f"%reset -f\n%cd -q {EXPECTED[name].folder}")
        whole.cells += [begin, *notebook.cells]
    NotebookClient(whole, timeout=300, kernel_name="python3", allow_errors=True).execute()
    return {
        name: [output for cell in notebook.cells for output in cell.get("outputs", ())]
        for name, notebook in read.items()
    }


def text_of(output):
    """What an output says, in a page without the marks of HTML."""
    data = output.get("data", {})
    page = ElementTree.fromstring(data["text/html"]).itertext() if "text/html" in data else ()
    return output.get("text", "") + "".join(page) + data.get("text/plain", "")


@pytest.mark.parametrize("name", EXPECTED)
def test_a_tutorial_runs_and_shows_what_its_text_says(outputs, name):
    shown = outputs[name]
    assert not [each for each in shown if each.output_type == "error" or each.get("name") == "stderr"]
    said = "\n".join(map(text_of, shown))
    for words in EXPECTED[name].words:
        assert words in said
    figures = [
        b64decode(output.data["image/png"]) for output in shown if "image/png" in output.get("data", {})
    ]
    assert len(figures) == EXPECTED[name].figures
    assert all(figure.startswith(b"\x89PNG") and len(figure) > 5_000 for figure in figures)


def test_every_tutorial_is_run():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_a_tutorial_is_committed_without_outputs(name):
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}


@pytest.mark.parametrize("name", EXPECTED)
def test_links_of_a_tutorial_point_to_existing_files(name):
    text = (NOTEBOOKS / f"{name}.ipynb").read_text("utf-8")
    for target in re.findall(r"\]\(([^):]+)\)", text):
        assert (NOTEBOOKS / target).exists()

"""The page of the paper's experiments: its quick sections run, and its specifications are as published."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import spatial_replay as sr

ROOT = Path(__file__).resolve().parent.parent


def page(folder: Path, *sections: str, data: Path | None = None) -> str:
    """The text of a page with some sections."""
    settings = {key: value for key, value in os.environ.items() if key != "SPATIAL_REPLAY_DATA"}
    settings |= {} if data is None else {"SPATIAL_REPLAY_DATA": str(data)}
    command = [
        sys.executable,
        str(ROOT / "tools" / "paper"),
        "--fast",
        "-o",
        str(folder),
        "--only",
        *sections,
    ]
    subprocess.run(command, check=True, capture_output=True, env=settings, cwd=ROOT)
    return re.sub(r"<img[^>]*>", "", (folder / "index.html").read_text("utf-8"))


def test_without_the_papers_recordings_the_page_says_so(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed; it comes with the extra notebook")
    text = page(tmp_path, "examples", "table", "social")
    assert text.count("not at hand") == 2
    assert text.count("<h2") == 3
    assert "46 transitions" in text


def test_the_papers_runs_have_its_numbers(tmp_path: Path, data_folder: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed; it comes with the extra notebook")
    text = page(tmp_path, "table", data=data_folder)
    assert re.search(r"table, in the end</td><td[^>]*>17\.15</td><td[^>]*>17\.15<", text)
    assert len(re.findall(r"at most \de-1\d apart in 982 samples", text)) == 2


@pytest.mark.parametrize(
    "file", sorted((ROOT / "recordings" / "paper").glob("*.spatial")), ids=lambda path: path.stem
)
def test_its_specifications_are_read_without_errors(file: Path) -> None:
    assert sr.load_specification(file).results

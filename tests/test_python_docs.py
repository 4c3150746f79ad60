"""The Python interface as documented: its examples are a program that runs."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "python.md").read_text("utf-8"), re.M | re.S)


@pytest.mark.usefixtures("figures")
def test_the_examples_run_and_print_what_the_text_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("table.jsonl", "table.spatial"):
        shutil.copy(ROOT / "recordings" / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    said = []
    for number, example in enumerate(EXAMPLES):
        exec(compile(example, f"docs/python.md, example {number}", "exec"), names)  # noqa: S102
        said.append(capsys.readouterr().out.splitlines())
    printed = dict(enumerate(lines for lines in said if lines))
    assert printed[0][0] == "satisfied"
    assert [line.split()[:2] for line in printed[0][1:]] == [
        ["table_set", "satisfied"],
        ["parallel", "satisfied"],
        ["poured", "satisfied"],
    ]
    assert printed[1] == ["satisfied"]
    assert printed[3][0].startswith("satisfied 8500000000 spoon dist plate <= 0.08 0.032")
    assert "'spoon', 'plate'" in printed[3][1]
    assert "value=0.08, flips_at=0.047" in printed[3][2]
    assert printed[4][0].startswith("(34, 300) 0.0248")
    assert "'cup'" in printed[5][0]
    assert "'plate'" in printed[5][0]
    assert printed[6] == ["satisfied"]
    assert printed[7] == ["()"]
    assert [line.split()[0] for line in printed[8]] == ["cup", "hold"]
    assert printed[9][1:3] == ["False True True", "frozenset({0, 2})"]
    assert printed[9][3].startswith("0 2 ")
    assert printed[10] == ["unsatisfiable (('cup leftof plate', 'plate leftof cup'),)", "satisfied"]
    assert [line.split()[0] for line in printed[11]] == ["1", "2"]

"""The documented example prints the documented output."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "semantics.md"


def test_the_worked_example_prints_the_documented_output():
    found = re.search(r"```python\n(.*?)```\s+```text\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert found is not None
    printed = subprocess.run(
        [sys.executable, "-c", found[1]],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert printed == found[2]

"""Long logs: numbers of an explanation lie in a temporary file, or in memory where that has no room."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cli.program import environment, run_program

SAMPLES = 20_000
PARTS = 120
"""An explanation has a number for each part and sample: 19 MB."""
LIMITED = (
    "import resource, sys\n"
    "resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))\n"
    "from spatial_replay.cli import run\n"
    "sys.exit(run(sys.argv[1:]))"
)


@pytest.fixture
def long_log(tmp_path: Path) -> Path:
    lines = [
        f'{{"time_ns": {number * 10**9}, "objects": [], "signals": {{"x": {number % 977}}}}}\n'
        for number in range(SAMPLES)
    ]
    (tmp_path / "long.jsonl").write_text("".join(lines))
    parts = [f"x <= {976 - part}" for part in range(PARTS)]
    (tmp_path / "long.spatial").write_text(f"G ({' and '.join(parts)})")
    return tmp_path


def test_a_long_log_is_explained_alike_where_temporary_files_have_no_room(long_log: Path) -> None:
    words = ["explain", "long.jsonl", "--spec", "long.spatial"]
    limited = subprocess.run(
        [sys.executable, "-c", LIMITED, *words],
        cwd=long_log,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    free = run_program(*words, cwd=long_log)
    assert (limited.returncode, limited.stdout) == (free.returncode, free.stdout)
    assert free.returncode == 1
    assert "fails by" in free.stdout

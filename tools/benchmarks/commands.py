"""Whole commands, as a person types them, with warm kernel caches."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any


def _run(*arguments: str) -> None:
    command = [sys.executable, "-m", "spatial_replay", *arguments]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode not in (0, 1, 4):
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr.decode()}")


def bench_help(measure: Any) -> None:
    """`spatial-replay --help`."""
    measure("--help", lambda _: _run("--help"), limit_s=0.3)


def bench_replay_command(measure: Any) -> None:
    """`spatial-replay replay` of the blocks recording, 1579 samples."""
    import json

    data = Path(os.environ.get("SPATIAL_REPLAY_DATA", "")) / "paper"
    if not data.is_dir():
        return
    with tempfile.TemporaryDirectory() as folder:
        log, spec = f"{folder}/run.mcap", Path(folder) / "blocks.spatial"
        spec.write_text(json.loads((data / "expected.json").read_text())["blocks_moving_passage"]["spec"])
        _run("record", "tracks", str(data / "blocks_moving_passage.jsonl.gz"), "-o", log)
        measure("verdict only", lambda _: _run("replay", log, "--spec", str(spec)), limit_s=1.5)
        annotated = f"{folder}/annotated.mcap"
        measure("with -o", lambda _: _run("replay", log, "--spec", str(spec), "-o", annotated), limit_s=1.5)

"""Signals that meet the program at work."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from cli.program import environment

MANY = 120_000
"""Samples that take the program several seconds."""


def write_many(path: Path) -> None:
    """A track file of so many samples."""
    cube = '"objects": [{"name": "cube", "polygon": [[0, 0], [1, 0], [1, 1]]}]'
    with path.open("w") as stream:
        stream.writelines(f'{{"time_ns": {index * 10**7}, {cube}}}\n' for index in range(MANY))


def interrupted(
    command: list[str], number: signal.Signals, folder: Path, is_at_work: Callable[[], bool]
) -> tuple[int, str]:
    """Exit code and standard error of a program that is sent a signal once it is at work."""
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        while not is_at_work() and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(number)
        _, said = process.communicate(timeout=300)
    return process.returncode, said.strip()

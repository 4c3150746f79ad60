"""`spatial-replay warmup`: compile everything once, for images."""

from __future__ import annotations

import os

import click

from spatial_replay.cli.terminal import progress, show
from spatial_replay.errors import OutputError


@click.command()
@click.option(
    "--jobs", type=click.IntRange(1), default=None, help="Number of processes.  [default: one per core]"
)
def warmup(jobs: int | None) -> None:
    """Compile every kernel once, so that no later run on this machine has to.

    Short logs are evaluated without compiled code; this is for container images, and before a control loop.
    The code is kept beside the installed package or, if that is read-only, in the user's cache folder.
    SPATIAL_REPLAY_CACHE names another place.

    \b
    Examples, the second in a Dockerfile:
      spatial-replay warmup
      RUN pip install . && spatial-replay warmup
    """
    # imported here so that --help stays fast
    from spatial_replay.runs.warmup import TASKS, warm_up_kernels

    with progress("compiling", len(TASKS)) as advance:
        folder = warm_up_kernels(jobs or len(os.sched_getaffinity(0)), advance)
    if folder is None:
        raise OutputError(
            "no folder for compiled code can be written; name one with SPATIAL_REPLAY_CACHE=FOLDER"
        )
    show(f"compiled into {folder}")

"""The first monitor of a machine begins at once, and goes over to machine code without a change of a bit."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from spatial_replay.compiled import cache_folder

_LOOP = """
import hashlib, os, select, sys
import spatial_replay as sr

executable, count, wait, *_ = sys.argv[1:]
sys.executable = executable or sys.executable
monitor = sr.Monitor(sr.parse_specification("G (a dist b >= 1 -> F[0, 20] load >= 0)"), wait=wait == "wait")
if count == "fork":
    os.fork()
digest, steps = hashlib.sha256(), 0
# until the parent process closes the pipe
while steps != int(count) if count.isdigit() else not select.select([sys.stdin], [], [], 0.01)[0]:
    box = sr.Footprint.box(steps % 7, 0, steps % 7 + 1, 1)
    sample = sr.Sample(steps, {"a": box, "b": sr.Footprint.disc(0, 2.5, 1)}, {"load": steps % 29 - 20.0})
    digest.update(monitor.update(sample).specs[0].numbers.tobytes())
    steps += 1
print(f"{steps} {digest.hexdigest()}\\n", end="", flush=True)
"""
_BEGINS = (
    "spatial-replay: code is interpreted while a child process compiles it, once on this machine;"
    " `spatial-replay warmup` does it beforehand\n"
)
_LOADED = "spatial-replay: compiled code is loaded\n"


def _loop(
    cache: Path, count: str, *, executable: str = "", kernels: str = "", wait: str = ""
) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", _LOOP, executable, count, wait],
        env=os.environ | {"SPATIAL_REPLAY_CACHE": str(cache), "SPATIAL_REPLAY_KERNELS": kernels},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def _copy_cache(cache: Path) -> None:
    """Copy the machine code of these tests, but for the kernel of samples and the notes that all is there."""
    # all of it takes two minutes of processor time
    folder = cache_folder()
    if folder is not None:
        missing = shutil.ignore_patterns("*.compiled", "*.lock", "step.run_sample-*")
        shutil.copytree(folder, cache / folder.name, ignore=missing)


def test_a_first_monitor_loads_the_code_of_a_child_process_also_after_a_fork(tmp_path: Path) -> None:
    _copy_cache(tmp_path)
    with _loop(tmp_path, "fork") as loop:
        assert loop.stdin is not None
        assert loop.stdout is not None
        assert loop.stderr is not None
        assert [loop.stderr.readline() for _ in range(3)] == [_BEGINS, _LOADED, _LOADED]
        loop.stdin.close()
        digests = loop.stdout.read().splitlines()
    assert len(digests) == 2
    for digest in digests:
        with _loop(tmp_path, digest.split()[0], kernels="interpreted") as interpreted:
            assert interpreted.communicate() == (digest + "\n", "")
    # later ones begin with it; without the note that all is there, only those that wait do
    with _loop(tmp_path, "1") as later:
        assert later.communicate()[1] == ""
    assert [*tmp_path.rglob("step.run_sample-*.nbi")]
    for note in tmp_path.rglob("*.compiled"):
        note.unlink()
    with _loop(tmp_path, "1", wait="wait") as waiting:
        assert waiting.communicate()[1] == ""
    with _loop(tmp_path, "1") as unwaiting:
        assert unwaiting.communicate()[1].startswith(_BEGINS)


def test_a_monitor_stays_interpreted_if_its_child_process_fails(tmp_path: Path) -> None:
    with _loop(tmp_path, "until closed", executable="/bin/false") as loop:
        assert loop.stderr is not None
        assert loop.stderr.readline() == _BEGINS
        assert loop.stderr.readline() == (
            "spatial-replay: code stays interpreted: the child process that compiles it has ended with status"
            " 1; `spatial-replay warmup` does it beforehand\n"
        )
        digest = loop.communicate()[0]
    with _loop(tmp_path, digest.split()[0], kernels="interpreted") as interpreted:
        assert interpreted.communicate() == (digest, "")

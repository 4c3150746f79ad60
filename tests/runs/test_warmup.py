"""After a warm-up, nothing is compiled any more."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from spatial_replay.cli import run
from spatial_replay.compiled import cache_folder
from spatial_replay.logs.remote import user_cache_folder
from users import plain_user

_EVERY_KERNEL = """
import importlib, pkgutil
import spatial_replay
from spatial_replay.compiled import kernels
from spatial_replay.cli.warmup import TASKS

for task in TASKS.values():
    task()
for module in pkgutil.walk_packages(spatial_replay.__path__, "spatial_replay."):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as missing:  # an optional package: its room has no kernels then
            if missing.name.startswith("spatial_replay"):
                raise
print(*sorted(f"{each.__module__}.{each.__name__}" for each in kernels() if not each.is_compiled))
"""


def test_a_warm_up_compiles_every_kernel_and_says_where_the_code_is(capsys):
    # into the folder that the other tests use, where the code may be already
    assert run(["warmup", "--jobs", "1"]) == 0
    assert capsys.readouterr() == (f"compiled into {cache_folder()}\n", "")
    environment = os.environ | {"SPATIAL_REPLAY_KERNELS": "compiled"}
    done = subprocess.run(
        [sys.executable, "-c", _EVERY_KERNEL], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


def test_an_unknown_form_of_kernels_is_refused_with_those_that_are_known():
    code = "import spatial_replay.compiled"
    environment = os.environ | {"SPATIAL_REPLAY_KERNELS": "fast"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert "SPATIAL_REPLAY_KERNELS is 'fast'; give 'compiled' or 'interpreted'" in done.stderr


def test_a_relative_cache_folder_of_all_programs_is_ignored_and_an_own_one_stays_where_it_was_named(
    monkeypatch,
):
    # where every user may look
    with TemporaryDirectory(dir="/tmp") as name, monkeypatch.context() as patched:
        home = Path(name)
        home.chmod(0o777)
        patched.chdir(home)
        patched.setenv("XDG_CACHE_HOME", "here")
        patched.setenv("HOME", name)
        patched.delenv("NUMBA_CACHE_DIR", raising=False)
        patched.delenv("SPATIAL_REPLAY_CACHE", raising=False)
        own = home / ".cache/spatial-replay"
        assert user_cache_folder("downloads") == own / "downloads"
        # who cannot write beside the sources
        with plain_user():
            assert cache_folder().parent == own
        patched.setenv("SPATIAL_REPLAY_CACHE", "own")
        assert cache_folder().parent == home / "own"
        assert user_cache_folder("downloads") == home / "own/downloads"
        assert {each.name for each in home.iterdir()} == {".cache", "own"}


def test_machine_code_is_kept_on_no_disk_that_is_full(monkeypatch, tmp_path):
    full, roomy = tmp_path / "full", tmp_path / "roomy"
    free = {full: 2**20, roomy: 2**30}
    monkeypatch.setenv("SPATIAL_REPLAY_CACHE", str(full))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(roomy))
    usage = shutil.disk_usage(tmp_path)
    # no user can fill a disk for a test
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage._replace(free=free[folder.parent]))
    assert cache_folder().parent == roomy
    free[full] = 2**30
    assert cache_folder().parent == full


def test_machine_code_of_another_user_is_left_alone(monkeypatch):
    # where every user may look
    with TemporaryDirectory(dir="/tmp") as name:
        Path(name).chmod(0o755)
        theirs, own = Path(name) / "theirs", Path(name) / "own"
        monkeypatch.setenv("SPATIAL_REPLAY_CACHE", str(theirs))
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(own))
        folder = cache_folder()
        assert folder.parent == theirs
        folder.chmod(0o777)
        (folder / "lock").chmod(0o400)
        own.mkdir()
        own.chmod(0o777)
        with plain_user():
            assert cache_folder().parent == own

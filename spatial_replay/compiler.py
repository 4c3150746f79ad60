"""The compiler of kernels, and what a process knows of its kernels (see `compiled`).

The one module that knows which compiler it is.
"""

from __future__ import annotations

import atexit
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from spatial_replay.code_cache import cache_folder, remove_damaged, seal, turn
from spatial_replay.errors import UsageError

_PATIENCE_S: Final = 1.0
"""Compiling that takes less is not announced."""


class Compiler:
    """State of the kernels in this process: their form, the compiler, the cache, the listeners."""

    def __init__(self) -> None:
        self.only = os.environ.get("SPATIAL_REPLAY_KERNELS") or None
        if self.only not in (None, "compiled", "interpreted"):
            raise UsageError(
                f"SPATIAL_REPLAY_KERNELS is {self.only!r:.100}; give 'compiled' or 'interpreted', or unset it"
            )
        self.interprets = True
        self.spent_s = 0.0
        self.listeners: list[Callable[[], None]] = []
        self._is_announced = False
        # a module that another thread is still importing is in `sys.modules`, too
        self._compiler: Any = None
        self._lock = threading.RLock()

    @cached_property
    def _folder(self) -> Path | None:
        return cache_folder()

    @cached_property
    def _cached(self) -> frozenset[str]:
        """The kernels whose machine code earlier processes have left in the cache."""
        # a file is named after module, function and line: kernels.measure_rows-335.py311.nbi
        files = () if self._folder is None else self._folder.rglob("*.nbi")
        return frozenset(path.name.partition("-")[0] for path in files)

    def holds(self, function: Any) -> bool:
        """Say whether the cache has machine code of a function."""
        return _name(function) in self._cached

    def compile(self, function: Callable[..., Any], options: dict[str, Any]) -> Any:
        """Return a function that is compiled for the types of its arguments when it is called."""
        with self._lock:
            if self._compiler is None:
                import numba

                if self._folder is not None:
                    remove_damaged(self._folder)
                    # and of what kernels that the cache holds are compiled for later
                    atexit.register(seal, self._folder)
                self._compiler = numba
            compiler, is_cached = self._compiler, self._folder is not None
            # the folder is read from the compiler's settings when a function is decorated; they belong to
            # the user's own functions, too, and are put back
            before = compiler.config.CACHE_DIR
            if is_cached:
                compiler.config.CACHE_DIR = str(self._folder)
            try:
                return compiler.njit(cache=is_cached, error_model="numpy", **options)(function)
            finally:
                compiler.config.CACHE_DIR = before

    @contextmanager
    def compiling(self, function: Any) -> Iterator[None]:
        """Let listeners know of a call that compiles what no cache holds; else say so if it takes long."""
        if self.holds(function):
            yield
            return
        for hear in tuple(self.listeners):
            hear()
        timer = threading.Timer(_PATIENCE_S, self._announce)
        timer.daemon = True
        timer.start()
        try:
            with turn(self._folder, _name(function)):
                yield
                if self._folder is not None:
                    seal(self._folder)
        finally:
            timer.cancel()

    def _announce(self) -> None:
        if not self.listeners and not self._is_announced:
            self._is_announced = True
            remedy = "`spatial-replay warmup` does it beforehand"
            sys.stderr.write(f"spatial-replay: compiling, once on this machine; {remedy}\n")


def _name(function: Any) -> str:
    """Return how the compiler names the files of a function."""
    return f"{Path(function.__code__.co_filename).stem}.{function.__qualname__}"

"""The one place that knows the compiler behind the numeric kernels.

Kernels are plain functions over arrays and numbers, compiled on first use and kept in a cache on
disk, so that a second process starts warm. Modules that hold kernels are imported only when numbers
are needed: the command line answers `--help` without loading the compiler.

Arithmetic keeps IEEE semantics (no fast-math, no fused contraction that would depend on the machine), so
equal inputs give equal bits in a monitor and in a replay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core import event

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


# Some of the options used here are missing from the compiler's published types.
_compile: Callable[..., Any] = partial(numba.njit, cache=True, error_model="numpy")


def kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compile a function of arrays and numbers to machine code."""
    return cast(Callable[_Arguments, _Result], _compile(function))


def long_kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compile as `kernel`, for calls that may take milliseconds: other threads run meanwhile.

    Not for short calls: the interpreter may be lost to a busy thread at each of them, for milliseconds.
    """
    return cast(Callable[_Arguments, _Result], _compile(nogil=True)(function))


def piece(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compile a function that only kernels call: as `kernel`, without the entry from Python."""
    compiled = _compile(no_cpython_wrapper=True, no_cfunc_wrapper=True)
    return cast(Callable[_Arguments, _Result], compiled(function))


def inlined(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compile a small helper into every kernel that calls it, where a call would outweigh its work.

    Such a helper allocates no array, and so takes no part in the compiler's counting of references,
    which would dominate a function of a few floating-point operations.
    """
    compiled = _compile(forceinline=True, _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True)
    return cast(Callable[_Arguments, _Result], compiled(function))


class _Listener(event.Listener):
    """Hears when the compiler begins."""

    def __init__(self, hear: Callable[[], None]) -> None:
        self._hear = hear

    def on_start(self, event: object) -> None:
        self._hear()

    def on_end(self, event: object) -> None:
        pass


@contextmanager
def compilations(hear: Callable[[], None]) -> Iterator[None]:
    """Call `hear` for a while whenever a function is about to be compiled that no cache holds."""
    with event.install_listener("numba:compile", _Listener(hear)):
        yield

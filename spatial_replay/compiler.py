"""The compiler of kernels, and what a process knows of its kernels (see `compiled`).

The one module that knows which compiler it is.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from types import FunctionType
from typing import Any, Final, cast

import numpy as np

from spatial_replay.code_cache import cache_folder
from spatial_replay.errors import UsageError

_PATIENCE_S: Final = 1.0
"""Compiling that takes less is not announced."""


class _Announcement:
    """Says once, on standard error, that compiling takes longer than a second."""

    def __init__(self) -> None:
        self._open, self._since_s, self._spent_s, self._is_said = 0, 0.0, 0.0, False

    def begin(self) -> None:
        now_s = time.monotonic()
        # what a kernel calls is compiled while it is
        self._since_s = self._since_s if self._open else now_s
        self._open += 1
        if not self._is_said and self._spent_s + now_s - self._since_s > _PATIENCE_S:
            self._is_said = True
            remedy = "`spatial-replay warmup` does it beforehand"
            sys.stderr.write(f"spatial-replay: compiling, once on this machine; {remedy}\n")

    def end(self) -> None:
        if self._open:
            self._open -= 1
            self._spent_s += 0.0 if self._open else time.monotonic() - self._since_s


class Compiler:
    """What this process knows of its kernels: which form they take, the compiler, the cache, who listens."""

    def __init__(self) -> None:
        self.only = os.environ.get("SPATIAL_REPLAY_KERNELS") or None
        if self.only not in (None, "compiled", "interpreted"):
            raise UsageError(
                f"SPATIAL_REPLAY_KERNELS is {self.only!r:.100}; give 'compiled' or 'interpreted', or unset it"
            )
        self.interprets = True
        self.spent_s = 0.0
        self.listeners: list[Callable[[], None]] = []
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

    def holds(self, module: str, name: str) -> bool:
        """Say whether the cache has machine code of a function."""
        return f"{module.rpartition('.')[2]}.{name}" in self._cached

    def compile(self, function: Callable[..., Any], options: dict[str, Any]) -> Any:
        """Return a function that is compiled for the types of its arguments when it is called.

        What only kernels call is optimised with these, and not before, which takes a third of the time.
        """
        return self._compile(lambda numba: numba.njit, function, options)

    def compile_entry(self, function: FunctionType, options: dict[str, Any]) -> Any:
        """Compile a function of integers; return it as what takes bytes, too, for the address of these."""
        count = function.__code__.co_argcount
        made = self._compile(
            lambda numba: partial(numba.cfunc, numba.int64(*[numba.int64] * count)),
            function,
            options,
        )
        call = ctypes.PYFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * count)(made.address)
        call.machine_code = made  # type: ignore[attr-defined]  # lives as long as the function
        return call

    def call_of(self, symbol: str, function: Any) -> Any:
        """Return what machine code calls to reach a function of integers that is compiled apart."""
        from numba.core import codegen, types

        # by its name, since it lies elsewhere in the next process, which finds its callers in the cache
        cast(Any, codegen).ll.add_symbol(symbol, function.machine_code.address)
        return types.ExternalFunction(symbol, function.machine_code._sig)

    def array_at(self, kind: type) -> Any:
        """Return what machine code calls to see numbers at an address as an array."""
        self._loaded()
        from numba.core import cgutils, types
        from numba.extending import intrinsic
        from numba.np import arrayobj

        tools, arrays, number = cast(Any, cgutils), cast(Any, arrayobj), getattr(types, kind.__name__)

        @intrinsic
        def array_at(_context, address, shape):  # type: ignore[no-untyped-def]
            dimensions = len(shape) if isinstance(shape, types.BaseTuple) else 1
            made = types.Array(number, dimensions, "C")

            def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
                at, extent = arguments
                lengths = [extent] if dimensions == 1 else tools.unpack_tuple(builder, extent)
                kinds = signature.args[1:] if dimensions == 1 else signature.args[1]
                sizes = zip(lengths, kinds, strict=True)
                lengths = [context.cast(builder, *each, types.intp) for each in sizes]
                strides = [context.get_constant(types.intp, np.dtype(kind).itemsize)]
                for length in lengths[:0:-1]:
                    strides.insert(0, builder.mul(strides[0], length))
                array = arrays.make_array(made)(context, builder)
                data = builder.inttoptr(at, array.data.type)
                arrays.populate_array(array, data, lengths, strides, strides[-1], meminfo=None)
                return array._getvalue()

            return made(address, shape), generate

        return array_at

    def _compile(
        self,
        form: Callable[[Any], Callable[..., Any]],
        function: Callable[..., Any],
        options: dict[str, Any],
    ) -> Any:
        with self._lock:
            numba = self._loaded()
            if self._folder is None:
                return form(numba)(error_model="numpy", **options)(function)
            # the folder is read from the compiler's settings when a function is decorated; they belong to
            # the user's own functions, too, and are put back
            before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(self._folder)
            try:
                return form(numba)(cache=True, error_model="numpy", **options)(function)
            finally:
                numba.config.CACHE_DIR = before

    def _loaded(self) -> Any:
        """Return the compiler, which the first thread that needs it imports, while others wait."""
        with self._lock:
            if self._compiler is None:
                import numba
                from numba.core import event

                listeners, announcement = self.listeners, _Announcement()

                class Listener(event.Listener):  # type: ignore[misc, unused-ignore]
                    def on_start(self, event: object) -> None:
                        for hear in tuple(listeners) or (announcement.begin,):
                            hear()

                    def on_end(self, event: object) -> None:
                        announcement.end()

                cast(Any, event).register("numba:compile", Listener())
                self._compiler = numba
            return self._compiler

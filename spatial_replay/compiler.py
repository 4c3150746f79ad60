"""The compiler of kernels, and what a process knows of its kernels (see `compiled`).

The one module that knows which compiler it is.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path
from types import FunctionType
from typing import Any, Final, Protocol, cast

import numpy as np

from spatial_replay.code_cache import cache_folder
from spatial_replay.errors import UsageError

ROW: Final = 32
"""So many neighbouring numbers are a row (see `row_code` in `compiled`)."""

_PATIENCE_S: Final = 1.0
"""Compiling that takes less is not announced."""


class Lanes(Protocol):
    """What formulas of rows consist of. Each number is made of those in its place."""

    def greater(self, first: Any, second: Any) -> Any:
        """Return the greater of each two numbers."""

    def lesser(self, first: Any, second: Any) -> Any:
        """Return the lesser of each two numbers."""

    def parted(self, at: Any, before: Any, after: Any) -> Any:
        """Return one row up to a place, and another one from there on."""

    def later(self, at: Any) -> Any:
        """Return a place so much later as a loop's row is from the first one of its array."""

    def moved(self, row: Any, by: int) -> Any:
        """Return the numbers so many places on, or back where it is negative; beyond the row, its own."""

    def spread(self, row: Any, at: int) -> Any:
        """Return a row of nothing but the number at a place."""


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

    @property
    def has_compiler(self) -> bool:
        """Whether the compiler is loaded already."""
        return "numba" in sys.modules

    def compile(self, function: Callable[..., Any], options: dict[str, Any]) -> Any:
        """Return a function that is compiled for the types of its arguments when it is called.

        What only kernels call is optimised with these, and not before, which takes a third of the time.
        """
        made = self._compile(lambda numba: numba.njit, function, options)
        # parts of it once all of it is there: threads that import both at the same time block each other
        from numba.core.compiler_lock import global_compiler_lock

        settings, compile_it = self._compiler.config, made.compile
        level = type(settings.OPT)(1) if "no_cpython_wrapper" in options else settings.OPT

        def compile_at_level(signature: object) -> object:
            with cast(Any, global_compiler_lock):
                before, settings.OPT = settings.OPT, level
                try:
                    return compile_it(signature)
                finally:
                    settings.OPT = before

        made.compile = compile_at_level
        return made

    def compile_entry(self, function: FunctionType, options: dict[str, Any]) -> Any:
        """Compile a function of integers; return it as what takes bytes, too, for the address of these."""
        count = function.__code__.co_argcount
        made = self._compile(
            lambda numba: partial(numba.cfunc, numba.int64(*[numba.int64] * count)), function, options
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

    def row_code(self, formula: Callable[..., Any], count: int) -> Any:
        """Return what machine code calls to fill a row with a formula of `count` arguments (see `Lanes`)."""

        def generate(code: _RowEmitter, kinds: Sequence[Any], values: list[Any]) -> None:
            rows = [code.taken(*each) for each in zip(kinds[:-1], values[:-1], strict=True)]
            code.store(formula(code, *rows), values[-1])

        return self._emitting(generate, count + 1)

    def row_loop(
        self, formula: Callable[..., Any], count: int, *, backwards: bool, is_last_only: bool
    ) -> Any:
        """Return what machine code calls to run a formula of `count` arguments over many rows."""

        def generate(code: _RowEmitter, kinds: Sequence[Any], values: list[Any]) -> None:
            code.loop(formula, kinds, values, backwards=backwards, is_last_only=is_last_only)

        return self._emitting(generate, count if is_last_only else count + 1)

    def row_fold(self, formula: Callable[..., Any]) -> Any:
        """Return what machine code calls to join many rows, and a number, into one number."""
        self._loaded()
        from numba.core import types
        from numba.extending import intrinsic

        @intrinsic
        def fold(_context, rows, start):  # type: ignore[no-untyped-def]
            def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
                code = _RowEmitter(context, builder)
                rows, start = map(code.opened, signature.args, arguments)
                return code.fold(formula, signature.args[0], rows, start)

            return types.float64(rows, start), emit

        return fold

    def _emitting(self, generate: Callable[[_RowEmitter, Sequence[Any], list[Any]], None], count: int) -> Any:
        """Return what makes instructions of a call with `count` arguments."""
        self._loaded()
        from numba.core import types
        from numba.extending import intrinsic

        def typed(*kinds: Any) -> Any:
            def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                code = _RowEmitter(context, builder)
                generate(code, signature.args, list(map(code.opened, signature.args, arguments)))
                return context.get_dummy_value()

            return types.void(*kinds), emit

        # the compiler looks at how many arguments a function has
        forms = {
            2: lambda _, a, b: typed(a, b),
            3: lambda _, a, b, c: typed(a, b, c),
            4: lambda _, a, b, c, d: typed(a, b, c, d),
            5: lambda _, a, b, c, d, e: typed(a, b, c, d, e),
            6: lambda _, a, b, c, d, e, f: typed(a, b, c, d, e, f),
            7: lambda _, a, b, c, d, e, f, g: typed(a, b, c, d, e, f, g),
        }
        return intrinsic(forms[count])

    def _compile(
        self, form: Callable[[Any], Callable[..., Any]], function: Callable[..., Any], options: dict[str, Any]
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


class _RowEmitter(Lanes):
    """Emits the instructions of formulas of rows."""

    def __init__(self, context: Any, builder: Any) -> None:
        from llvmlite import ir
        from numba.core import types
        from numba.np import arrayobj

        self._context, self._builder = context, builder
        self._code, self._types, self._arrays = cast(Any, ir), types, cast(Any, arrayobj)
        self._row = self._code.VectorType(self._code.DoubleType(), ROW)
        self._index = self._code.IntType(64)
        self.place: Any = self._index(0)

    def greater(self, first: Any, second: Any) -> Any:
        return self._builder.select(self._builder.fcmp_ordered(">", second, first), second, first)

    def lesser(self, first: Any, second: Any) -> Any:
        return self._builder.select(self._builder.fcmp_ordered("<", second, first), second, first)

    def parted(self, at: Any, before: Any, after: Any) -> Any:
        places = self._code.Constant(at.type, list(range(ROW)))
        return self._builder.select(self._builder.icmp_signed("<", places, at), before, after)

    def later(self, at: Any) -> Any:
        return self._builder.add(at, self._spread(self.place))

    def moved(self, row: Any, by: int) -> Any:
        places = [place + by if 0 <= place + by < ROW else place for place in range(ROW)]
        return self._shuffled(row, places)

    def spread(self, row: Any, at: int) -> Any:
        return self._shuffled(row, [at] * ROW)

    def opened(self, kind: Any, value: Any) -> Any:
        """Return an array with its address and shape by name; any other value as it is."""
        if not isinstance(kind, self._types.Array):
            return value
        return self._arrays.make_array(kind)(self._context, self._builder, value)

    def taken(self, kind: Any, value: Any) -> Any:
        """Return an argument as a row: that of an array, or one of the same number throughout."""
        is_array = isinstance(kind, self._types.Array)
        return self._load(value.data) if is_array else self._spread(value)

    def store(self, row: Any, array: Any) -> None:
        """Store a row in an array of one row."""
        self._store(row, array.data)

    def loop(
        self, formula: Callable[..., Any], kinds: Sequence[Any], values: list[Any], *, backwards: bool,
        is_last_only: bool,
    ) -> None:  # fmt: skip
        """Run a formula over many rows (see `row_loop` in `compiled`)."""
        builder, carried = self._builder, values[0].data
        over = range(1, len(values) if is_last_only else len(values) - 1)
        arrays = [k for k in range(1, len(values)) if isinstance(kinds[k], self._types.Array)]
        count = builder.extract_value(values[arrays[-1]].shape, 0)
        constants = {k: self._spread(values[k]) for k in over if k not in arrays}
        start = self._load(carried)

        def run(row: Any) -> Any:
            inputs = [constants[k] if k in constants else self._element(kinds[k], values[k]) for k in over]
            outcome = formula(self, row, *inputs)
            result, stored = outcome if isinstance(outcome, tuple) else (outcome, outcome)
            if not is_last_only:
                self._store(stored, self._address(kinds[-1], values[-1]))
            return result

        self._store(self._run_over(count, start, run, backwards=backwards), carried)

    def fold(self, formula: Callable[..., Any], kind: Any, rows: Any, start: Any) -> Any:
        """Join many rows with a number, and then all numbers of the row that this gives."""
        builder = self._builder
        count = builder.extract_value(rows.shape, 0)
        row = self._run_over(
            count, self._spread(start), lambda row: formula(self, row, self._element(kind, rows)),
            backwards=False,
        )  # fmt: skip
        width = ROW // 2
        while width:
            row, width = formula(self, row, self.moved(row, width)), width // 2
        return builder.extract_element(row, self._code.IntType(32)(0))

    def _run_over(self, count: Any, start: Any, run: Callable[[Any], Any], *, backwards: bool) -> Any:
        """Emit a loop over so many rows, in which each row follows from the one before; return the last."""
        builder = self._builder
        begin, body, end = builder.block, *(builder.append_basic_block() for _ in range(2))
        builder.cbranch(builder.icmp_signed(">", count, self._index(0)), body, end)
        builder.position_at_end(body)
        done, row = builder.phi(self._index), builder.phi(self._row)
        done.add_incoming(self._index(0), begin)
        row.add_incoming(start, begin)
        after = builder.add(done, self._index(1))
        self.place = builder.sub(count, after) if backwards else done
        result = run(row)
        done.add_incoming(after, builder.block)
        row.add_incoming(result, builder.block)
        builder.cbranch(builder.icmp_signed("<", after, count), body, end)
        last = builder.block
        builder.position_at_end(end)
        final = builder.phi(self._row)
        final.add_incoming(start, begin)
        final.add_incoming(result, last)
        return final

    def _address(self, kind: Any, array: Any) -> Any:
        """Return where the row, or the number, at the loop's place is."""
        width = ROW if kind.ndim > 1 else 1
        at = self._builder.mul(self.place, self._index(width))
        return self._builder.gep(array.data, [at])

    def _element(self, kind: Any, array: Any) -> Any:
        address = self._address(kind, array)
        return self._load(address) if kind.ndim > 1 else self._spread(self._builder.load(address))

    def _load(self, address: Any) -> Any:
        return self._builder.load(self._builder.bitcast(address, self._row.as_pointer()), align=8)

    def _store(self, row: Any, address: Any) -> None:
        self._builder.store(row, self._builder.bitcast(address, self._row.as_pointer()), align=8)

    def _spread(self, number: Any) -> Any:
        """Return a row of one number."""
        nothing = self._code.Constant(self._code.VectorType(number.type, ROW), self._code.Undefined)
        first = self._builder.insert_element(nothing, number, self._code.IntType(32)(0))
        return self._shuffled(first, [0] * ROW)

    def _shuffled(self, row: Any, places: list[int]) -> Any:
        """Return the numbers of a row that stand at these places."""
        wanted = self._code.Constant(self._code.VectorType(self._code.IntType(32), ROW), places)
        nothing = self._code.Constant(row.type, self._code.Undefined)
        return self._builder.shuffle_vector(row, nothing, wanted)

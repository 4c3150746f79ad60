"""Numeric kernels: plain functions over arrays and numbers, run by the interpreter or as machine code.

The one module that knows the compiler. Compiling every kernel takes longer than reading a short log, and
loading the compiled ones from disk takes its time, too. So a kernel is interpreted while its arrays are
small, and compiled once that has cost about as much time as compiling it would.

Both ways give the same bits: kernels use sums, products, quotients, square roots, sines and cosines of IEEE
doubles (no fast-math, no fused contraction), and nothing else whose result depends on who computes it.

Machine code is kept on disk, in a folder named after a digest of all sources of the package, so a changed
kernel is never mistaken for the one before. `SPATIAL_REPLAY_CACHE` names another place for it;
`SPATIAL_REPLAY_KERNELS` is `compiled` or `interpreted` to have only one of the two ways.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, cached_property, partial
from operator import methodcaller
from pathlib import Path
from types import FunctionType
from typing import Any, Final, Generic, Literal, ParamSpec, TypeVar, cast

import numpy as np

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_COLD_S: Final = 2.0
_WARM_S: Final = 0.15
"""How long a kernel may be interpreted before it is compiled, or loaded from the cache."""
_COMPILER_S: Final = 0.25
"""What loading the compiler costs besides, once in a process."""
_GUESS_S: Final = 2e-6
"""For each element of its arrays, the time a kernel is expected to take when it was never run."""
_LONG: Final = 3.0
"""How many times that a kernel takes whose calls are long: it works on pairs of elements."""
_COPYING: Final = 0.01
"""The same of a kernel that copies bytes: it takes many at once."""
_CALL: Final = 32
"""As many elements take as long as what a call costs anyway."""
_STALE_S: Final = 7 * 24 * 3600.0
_PACKAGE: Final = Path(__file__).parent


def kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a function of arrays and numbers that may run as machine code."""
    return _Kernel(function, {})


def long_kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a kernel whose calls may take milliseconds: other threads run while it does.

    Not for short calls: each would hand the interpreter to a busy thread, which keeps it for milliseconds.
    """
    return _Kernel(function, {"nogil": True}, times=_LONG)


def copying_kernel(
    interpreted: Callable[_Arguments, _Result],
) -> Callable[[Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]:
    """Return what makes a long kernel that copies bytes; interpreted, it is another function."""
    return lambda function: _Kernel(function, {"nogil": True}, times=_COPYING, interpreted_as=interpreted)


def elementwise(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a kernel of which the interpreter takes two to five times as little time.

    It gets its arrays as memoryviews, whose elements are plain numbers; of the arrays in a named tuple, those
    of one dimension. So it must take and set single elements, with no slices but of one dimension, and never
    divide by zero.
    """
    kernel = cast("_Kernel[_Arguments, _Result]", function)
    return _Kernel(kernel.__wrapped__, kernel.options, is_elementwise=True, times=kernel.times)


def piece(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a function that only kernels call: as `kernel`, without the entry from Python."""
    return _Kernel(function, {"no_cpython_wrapper": True, "no_cfunc_wrapper": True})


def uncounted(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a piece that allocates no array, and so takes no part in the counting of references.

    Its slices cost next to nothing, and a loop over one from its beginning becomes vector instructions.
    """
    return _Kernel(function, {"_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True})


def merged(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a piece that becomes part of its callers.

    A call of a piece counts references to all arrays that it is given, which takes longer than many a piece;
    within one function, nearly all of that counting cancels out.
    """
    return _Kernel(function, {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True})


def inlined(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a small helper that is compiled into every kernel that calls it.

    It allocates no array, and so takes no part in the compiler's counting of references, which would
    dominate a function of a few floating-point operations.
    """
    options = {"forceinline": True, "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return _Kernel(function, options)


def by_address(function: Callable[[int, int, int, int], int]) -> Callable[[int, bytes, int, int], int]:
    """Return a kernel of an address, of bytes, and of two more integers, that a call reaches directly.

    Looking at what a call is given takes as long as many a kernel: a quarter of a microsecond for each array.
    What it is given here is not looked at, and has to stay where it is as long as the call lasts.
    """
    if _process.only == "interpreted":
        return lambda frame, given, *rest: function(frame, np.frombuffer(given, np.uint8).ctypes.data, *rest)
    kernel = cast("_Kernel[[int, int, int, int], int]", function)
    return kernel.entry()


def compile_ahead() -> None:
    """Interpret no kernel in this process from now on.

    For control loops and servers: a call that is compiled late would keep them waiting in the middle.
    """
    _process.interprets = False


def kernels() -> Iterator[_Kernel[..., Any]]:
    """Yield the kernels of all modules that are loaded, without the pieces that only kernels call."""
    for module in tuple(sys.modules.values()):
        for value in tuple(vars(module).values()) if module.__name__.startswith(__package__) else ():
            if isinstance(value, _Kernel) and value.__module__ == module.__name__ and value.is_entry:
                yield value


@contextmanager
def only(form: Literal["compiled", "interpreted"]) -> Iterator[None]:
    """Run kernels in one form only, while this lasts."""
    before, _process.only = _process.only, form
    try:
        yield
    finally:
        _process.only = before


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def over_cores(
    used: Callable[..., object], run: Callable[[int, int], object], count: int, least: int
) -> None:
    """Call `run(begin, end)` for shares that make up range(count), each share on a core of its own.

    Args:
        used: the long kernel that `run` calls; all is one share until it is compiled.
        least: the least length of a share, which takes at least about a millisecond.
    """
    shares = min(cores(), count // max(least, 1)) if getattr(used, "is_compiled", False) else 1
    if shares < 2:
        run(0, count)
        return
    ends = [count * share // shares for share in range(shares + 1)]
    with ThreadPoolExecutor(shares - 1, "sharing") as threads:
        others = [threads.submit(run, *ends[share : share + 2]) for share in range(1, shares)]
        run(0, ends[1])
        for each in others:
            each.result()


@contextmanager
def compilations(hear: Callable[[], None]) -> Iterator[None]:
    """Call `hear`, while this lasts, whenever a function is about to be compiled that no cache holds."""
    _process.listeners.append(hear)
    try:
        yield
    finally:
        _process.listeners.remove(hear)


class _Kernel(Generic[_Arguments, _Result]):
    """A function in its two forms, each made when it is first needed."""

    def __init__(
        self,
        function: Callable[_Arguments, _Result],
        options: dict[str, Any],
        *,
        is_elementwise: bool = False,
        times: float = 1.0,
        interpreted_as: Callable[_Arguments, _Result] | None = None,
    ) -> None:
        self.__wrapped__ = function
        self.__name__ = function.__name__
        self.__doc__ = function.__doc__
        self.__module__ = function.__module__
        self.options, self.times = options, times
        self._interpreted_as = interpreted_as or function
        self._is_elementwise = is_elementwise
        self._compiled: Callable[_Arguments, _Result] | None = None
        self._interpreted: Callable[_Arguments, _Result] | None = None
        self._entry: Callable[..., Any] | None = None
        self._spent_s = 0.0
        self._element_s: float | None = None

    def __call__(self, *arguments: _Arguments.args, **named: _Arguments.kwargs) -> _Result:
        if self._compiled is not None and _process.only != "interpreted":
            return self._compiled(*arguments, **named)
        elements = _CALL + _elements(arguments)
        if not self._may_interpret(elements):
            return self.compiled()(*arguments, **named)
        run = cast(Callable[..., _Result], self.interpreted())
        begin = time.thread_time()
        taken = tuple(map(_view, arguments)) if self._is_elementwise else arguments
        # as in machine code: a quotient by zero or a product out of range is no error and no warning
        with np.errstate(all="ignore"):
            result = run(*taken, **named)
        took = time.thread_time() - begin
        self._spent_s += took
        self._element_s = max(took / elements, self._element_s or 0.0)
        return result

    @property
    def is_entry(self) -> bool:
        """Whether Python code may call it, too."""
        return "no_cpython_wrapper" not in self.options

    @property
    def is_compiled(self) -> bool:
        """Whether there is machine code for the arguments of at least one call."""
        return self._entry is not None or bool(getattr(self._compiled, "signatures", ()))

    def _may_interpret(self, elements: int) -> bool:
        if _process.only is not None:
            return _process.only == "interpreted"
        if not _process.interprets:
            return False
        guess = _GUESS_S * self.times if self._element_s is None else self._element_s
        cost = self._spent_s + elements * guess
        if not _process.has_compiler:
            cost -= _COMPILER_S
        # asked last, since looking for the cache takes its time, too
        return cost <= _WARM_S or (cost <= _COLD_S and not _process.holds(self))

    def interpreted(self) -> Callable[_Arguments, _Result]:
        """Return the function as it stands, calling others as they stand."""
        if self._interpreted is None:
            self._interpreted = _linked(self._interpreted_as, methodcaller("interpreted"))
        return self._interpreted

    def entry(self) -> Callable[..., Any]:
        """Return the machine code of a function of four integers, to be called without looking at these."""
        if self._entry is None:
            self._entry = _process.compile_entry(_linked(self.__wrapped__, methodcaller("compiled")))
        return self._entry

    def compiled(self) -> Callable[_Arguments, _Result]:
        """Return the function as machine code, calling machine code."""
        if self._compiled is None:
            self._compiled = _process.compile(
                _linked(self.__wrapped__, methodcaller("compiled")), self.options
            )
        return self._compiled


def _linked(
    function: Callable[_Arguments, _Result], form: Callable[[Any], Any]
) -> Callable[_Arguments, _Result]:
    """Return a copy of a function that calls the given form of every kernel that it names."""
    original = cast(FunctionType, function)
    names = {name: original.__globals__[name] for name in _names(original) if name in original.__globals__}
    linked = {name: form(value) if isinstance(value, _Kernel) else value for name, value in names.items()}
    linked |= {"__builtins__": original.__globals__["__builtins__"], "__name__": original.__module__}
    copy = FunctionType(original.__code__, linked, original.__name__, original.__defaults__)
    copy.__qualname__, copy.__doc__ = original.__qualname__, original.__doc__
    copy.__kwdefaults__ = original.__kwdefaults__
    return cast(Callable[_Arguments, _Result], copy)


def _names(function: FunctionType) -> set[str]:
    """Return the names that a function, or a comprehension within it, may look up globally."""
    names, codes = set[str](), [function.__code__]
    while codes:
        code = codes.pop()
        names.update(code.co_names)
        codes += [constant for constant in code.co_consts if isinstance(constant, type(code))]
    return names


def _elements(values: object) -> int:
    """Return how many doubles there is room for in arrays, also within tuples.

    Kernels pass over bytes quickly: they compare or copy them, or jump from record to record.
    """
    if isinstance(values, np.ndarray):
        return values.nbytes // 8
    if isinstance(values, tuple):
        return sum(map(_elements, values))
    return 0


def _view(value: Any) -> object:
    if isinstance(value, tuple):
        # kernels take rows of the arrays in named tuples, and a memoryview of several dimensions has none
        make: Any = type(value)
        return cast(object, make(*(_view(each) if each.ndim == 1 else each for each in value)))
    # an array is a buffer, though its type does not say so
    return memoryview(cast(bytes, value)) if isinstance(value, np.ndarray) else value


class _ArrayAt(_Kernel[[int, int], Any]):
    """An array of so many numbers that begins at an address."""

    def __init__(self, name: str, kind: type) -> None:
        super().__init__(lambda address, count: None, {"no_cpython_wrapper": True})
        self.__name__ = name
        self._kind = kind

    def interpreted(self) -> Callable[[int, int], Any]:
        kind: Any = _C_TYPES[self._kind]
        return lambda address, count: np.frombuffer(
            (kind * int(count)).from_address(int(address)), self._kind
        )

    def compiled(self) -> Callable[[int, int], Any]:
        if self._compiled is None:
            self._compiled = _process.array_at(self._kind)
        return self._compiled


_C_TYPES: Final[dict[type, Any]] = {
    np.float64: ctypes.c_double,
    np.int64: ctypes.c_int64,
    np.uint8: ctypes.c_uint8,
}

floats_at: Final = _ArrayAt("floats_at", np.float64)
integers_at: Final = _ArrayAt("integers_at", np.int64)
bytes_at: Final = _ArrayAt("bytes_at", np.uint8)
"""Within kernels that are given addresses; numbers need not be aligned."""


class _Process:
    """What this process knows about its kernels: the compiler, the cache, who listens."""

    def __init__(self) -> None:
        self.only = _required_form()
        self.interprets = True
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

    def holds(self, kernel: _Kernel[..., Any]) -> bool:
        """Say whether the cache has machine code of a kernel."""
        return f"{kernel.__module__.rpartition('.')[2]}.{kernel.__name__}" in self._cached

    @property
    def has_compiler(self) -> bool:
        """Whether the compiler is loaded already."""
        return "numba" in sys.modules

    def compile(self, function: Callable[..., Any], options: dict[str, Any]) -> Any:
        """Return a function that is compiled for the types of its arguments when it is called."""
        return self._compile(lambda numba: numba.njit, function, options)

    def compile_entry(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Compile a function of four integers; return it as what takes bytes for the second of them."""
        made = self._compile(
            lambda numba: partial(numba.cfunc, "int64(int64, int64, int64, int64)"), function, {}
        )
        integer = ctypes.c_int64
        call = ctypes.PYFUNCTYPE(integer, integer, ctypes.c_char_p, integer, integer)(made.address)
        call.code = made  # type: ignore[attr-defined]  # lives as long as the function
        return cast(Callable[..., Any], call)

    def array_at(self, kind: type) -> Any:
        """Return a function of an address and a count, compiled into every kernel that calls it."""
        import numba
        from numba.core import cgutils, types
        from numba.extending import intrinsic

        @intrinsic
        def pointer_to(_context, address):  # type: ignore[no-untyped-def]
            def generate(_context, builder, _signature, arguments):  # type: ignore[no-untyped-def]
                return builder.inttoptr(arguments[0], cgutils.voidptr_t)

            return types.voidptr(address), generate

        carray, pointer_at = cast(Any, numba).carray, cast(Any, pointer_to)

        def array_at(address, count):  # type: ignore[no-untyped-def]
            return carray(pointer_at(address), (count,), dtype=kind)

        return self._compile(lambda numba: numba.njit, array_at, {"forceinline": True})

    def _compile(
        self, form: Callable[[Any], Callable[..., Any]], function: Callable[..., Any], options: dict[str, Any]
    ) -> Any:
        with self._lock:
            if self._compiler is None:
                self._compiler = self._load()
            numba = self._compiler
            if self._folder is None:
                return form(numba)(error_model="numpy", **options)(function)
            # the folder is read from the compiler's settings when a function is decorated; they belong to
            # the user's own functions, too, and are put back
            before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(self._folder)
            try:
                return form(numba)(cache=True, error_model="numpy", **options)(function)
            finally:
                numba.config.CACHE_DIR = before

    def _load(self) -> Any:
        import numba
        from numba.core import event

        class Listener(event.Listener):  # type: ignore[misc, unused-ignore]
            def on_start(self, event: object) -> None:
                for hear in tuple(_process.listeners):
                    hear()

            def on_end(self, event: object) -> None:
                pass

        cast(Any, event).register("numba:compile", Listener())
        return numba


def _required_form() -> str | None:
    value = os.environ.get("SPATIAL_REPLAY_KERNELS")
    return value if value in ("compiled", "interpreted") else None


def cache_folder() -> Path | None:
    """Return the folder for machine code of these sources, made if need be; None if none can be written.

    Code in it is loaded as it is, so it lies where only the user, or who installed the package, writes.
    """
    name = f"kernels-{source_digest()}"
    shipped: Path | None = None
    for parent in _cache_parents():
        folder = parent / name
        try:
            is_new = not folder.exists()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError:
            # code that was compiled when an image was built, and is read-only now
            shipped = shipped or (folder if _holds_code(folder) else None)
            continue
        if is_new:
            _remove_stale(parent, keep=name)
            if shipped is not None:
                with suppress(OSError):
                    shutil.copytree(shipped, folder, dirs_exist_ok=True)
        return folder
    return None


def _cache_parents() -> Iterator[Path]:
    for name in ("SPATIAL_REPLAY_CACHE", "NUMBA_CACHE_DIR"):
        if value := os.environ.get(name):
            yield Path(value)
    yield _PACKAGE / "__pycache__"
    if value := os.environ.get("XDG_CACHE_HOME"):
        yield Path(value) / "spatial-replay"
    # a user without a home folder
    with suppress(RuntimeError):
        yield Path.home() / ".cache" / "spatial-replay"


def _holds_code(folder: Path) -> bool:
    return any(folder.rglob("*.nbi"))


def _remove_stale(parent: Path, keep: str) -> None:
    """Remove machine code of other sources that no process has added to for a while."""
    oldest = time.time() - _STALE_S
    for folder in parent.glob("kernels-*"):
        with suppress(OSError):
            if folder.name != keep and folder.stat().st_mtime < oldest:
                shutil.rmtree(folder, ignore_errors=True)


@cache
def source_digest() -> str:
    """Return a digest of the sources of the package: kernels take constants from anywhere in it."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


_process: Final = _Process()

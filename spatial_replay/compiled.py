"""Numeric kernels: plain functions over arrays and numbers, run by the interpreter or as machine code.

Compiling every kernel takes longer than reading a short log, and loading the compiled ones from disk takes
its time, too. So a kernel is interpreted while its arrays are small, and compiled once that has cost about as
much time as compiling it would.

Both ways give the same bits: kernels use sums, products, quotients, square roots, sines and cosines of IEEE
doubles (no fast-math, no fused contraction), and nothing else whose result depends on who computes it.

Machine code is kept on disk (see `code_cache`). `SPATIAL_REPLAY_KERNELS` is `compiled` or `interpreted` to
have only one of the two ways.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from operator import methodcaller
from types import FunctionType
from typing import Any, Final, Generic, Literal, ParamSpec, TypeAlias, TypeVar, cast

import numpy as np

from spatial_replay.compiler import Compiler

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_Making: TypeAlias = Callable[[Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]

_PATIENCE_S: Final = 0.8
"""How long a process interprets kernels in any case: loading the compiler and machine code takes as long."""
_COLD_S: Final = 2.0
_WARM_S: Final = 0.03
"""How long each kernel may be interpreted after that before it is compiled, or loaded from the cache."""
_GUESS_S: Final = 2e-6
"""For each element of its arrays, the time a kernel is expected to take when it was never run."""
_LONG: Final = 3.0
"""How many times that a kernel takes whose calls are long: it works on pairs of elements."""
_COPYING: Final = 0.01
"""The same of a kernel that copies bytes, many at once. With 1, a long log has it compiled at once."""
_CALL: Final = 32
"""As many elements take as long as what a call costs anyway."""


def kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a function of arrays and numbers that may run as machine code."""
    return _Kernel(function, {})


def long_kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a kernel whose calls may take milliseconds: other threads run while it does.

    Not for short calls: each would hand the interpreter to a busy thread, which keeps it for milliseconds.
    """
    return _Kernel(function, {"nogil": True}, times=_LONG)


def copying_kernel(
    interpreted: Callable[_Arguments, _Result], times: float = _COPYING
) -> _Making[_Arguments, _Result]:
    """Return what makes a long kernel that copies bytes; interpreted, it is another function."""
    return lambda function: _Kernel(function, {"nogil": True}, times=times, interpreted_as=interpreted)


def elementwise(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a kernel of which the interpreter takes two to five times as little time.

    It gets its arrays as memoryviews of plain numbers; of a named tuple, those of one dimension. So it must
    take and set single elements, with no slices but of one dimension, and never divide by zero.
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

    A call of a piece counts references to all arrays; within one function, nearly all of that cancels out.
    """
    return _Kernel(function, {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True})


def inlined(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a small helper that is compiled into every kernel that calls it, and allocates no array."""
    return inlined_as(function)(function)


def inlined_as(interpreted: Callable[_Arguments, _Result]) -> _Making[_Arguments, _Result]:
    """Return what makes an inlined helper; interpreted, it is another function."""
    options = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return lambda function: _Kernel(function, options, interpreted_as=interpreted)


def apart(function: Callable[..., int]) -> Callable[..., int]:
    """Return a kernel of integers whose machine code never becomes part of that of its callers.

    What a kernel calls is otherwise optimised again with it, and again with what calls that. It gets arrays
    by their addresses (`floats_at`), and allocates none. Python code gives it arrays for addresses.
    """
    return _Apart(function, {"_nrt": False})


def allocating_apart(function: Callable[..., int]) -> Callable[..., int]:
    """Return a kernel as `apart` does, which may allocate arrays."""
    return _Apart(function, {})


def by_address(function: Callable[..., int]) -> Callable[[int, bytes, int], int]:
    """Return a kernel compiled apart as a function of an address, of bytes, and of one more integer.

    Looking at what a call is given takes as long as many a kernel: a quarter of a microsecond for each array.
    What it is given here is not looked at, and has to stay where it is as long as the call lasts.
    """
    if _process.only == "interpreted":
        return lambda places, given, number: function(
            places, np.frombuffer(given, np.uint8).ctypes.data, number
        )
    return cast(Callable[[int, bytes, int], int], cast("_Apart", function).entry())


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
        # as in machine code: a quotient by zero or a product out of range is no error and no warning
        with np.errstate(all="ignore"):
            result = run(*self._taken(arguments), **named)
        took = time.thread_time() - begin
        self._spent_s += took
        _process.spent_s += took
        self._element_s = max(took / elements, self._element_s or 0.0)
        return result

    @property
    def is_entry(self) -> bool:
        """Whether Python code may call it, too."""
        return "no_cpython_wrapper" not in self.options

    @property
    def is_compiled(self) -> bool:
        """Whether there is machine code for the arguments of at least one call."""
        return bool(getattr(self._compiled, "signatures", ()))

    def _may_interpret(self, elements: int) -> bool:
        if _process.only is not None:
            return _process.only == "interpreted"
        if not _process.interprets:
            return False
        guess = _GUESS_S * self.times if self._element_s is None else self._element_s
        cost = elements * guess
        if _process.spent_s + cost <= _PATIENCE_S or self._spent_s + cost <= _WARM_S:
            return True
        # asked last, since looking for the cache takes its time, too
        return self._spent_s + cost <= _COLD_S and not _process.holds(self.__module__, self.__name__)

    def _taken(self, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return what the interpreter runs the function with."""
        return tuple(map(_view, arguments)) if self._is_elementwise else arguments

    def interpreted(self) -> Callable[_Arguments, _Result]:
        """Return the function as it stands, calling others as they stand."""
        if self._interpreted is None:
            self._interpreted = _linked(self._interpreted_as, methodcaller("interpreted"))
        return self._interpreted

    def compiled(self) -> Callable[_Arguments, _Result]:
        """Return the function as machine code, calling machine code."""
        if self._compiled is None:
            self._compiled = _process.compile(_linked(self.__wrapped__, methodcaller("linked")), self.options)
        return self._compiled

    def linked(self) -> Callable[_Arguments, _Result]:
        """Return what the machine code of other kernels calls."""
        return self.compiled()


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
    """Return how many numbers arrays have, also within tuples.

    Of bytes, which kernels copy at once or jump over from record to record, 64 take as long as a number.
    """
    if isinstance(values, np.ndarray):
        return values.size // (64 if values.itemsize == 1 else 1)
    if isinstance(values, tuple):
        return sum(map(_elements, values))
    return 0


def _view(value: Any) -> object:
    if isinstance(value, tuple):
        # kernels take rows of the arrays in named tuples, and a memoryview of several dimensions has none
        make: Any = type(value)
        return cast(object, make(*(_view(each) if each.ndim == 1 else each for each in value)))
    return value.data if isinstance(value, np.ndarray) else value


class _Apart(_Kernel[..., int]):
    """A function of integers that is compiled once, for Python and for other kernels."""

    _entry: Any = None
    _called: Any = None

    @property
    def is_compiled(self) -> bool:
        return self._entry is not None

    def _taken(self, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple([each.ctypes.data if isinstance(each, np.ndarray) else each for each in arguments])

    def entry(self) -> Any:
        """Return the machine code, as a function of integers alone, or of bytes for their address."""
        if self._entry is None:
            function = cast(FunctionType, _linked(self.__wrapped__, methodcaller("linked")))
            self._entry = _process.compile_entry(function, self.options)
        return self._entry

    def compiled(self) -> Callable[..., int]:
        if self._compiled is None:
            entry = self.entry()
            self._compiled = lambda *arguments: cast(int, entry(*self._taken(arguments)))
        return self._compiled

    def linked(self) -> Callable[..., int]:
        if self._called is None:
            self._called = _process.call_of(f"{self.__module__}.{self.__name__}", self.entry())
        return cast(Callable[..., int], self._called)


class _ArrayAt(_Kernel[[int, Any], Any]):
    """An array of numbers that begins at an address, given its length or shape."""

    def __init__(self, name: str, kind: type) -> None:
        super().__init__(lambda address, shape: None, {"no_cpython_wrapper": True})
        self.__name__ = name
        self._kind = kind

    def interpreted(self) -> Callable[[int, Any], Any]:
        kind: Any = np.ctypeslib.as_ctypes_type(self._kind)

        def array_at(address: int, shape: Any) -> Any:
            count = math.prod(shape) if isinstance(shape, tuple) else shape
            numbers: Any = np.frombuffer((kind * int(count)).from_address(int(address)), self._kind)
            return numbers.reshape(shape)

        return array_at

    def compiled(self) -> Callable[[int, Any], Any]:
        if self._compiled is None:
            self._compiled = _process.array_at(self._kind)
        return self._compiled


floats_at: Final = _ArrayAt("floats_at", np.float64)
integers_at: Final = _ArrayAt("integers_at", np.int64)
bytes_at: Final = _ArrayAt("bytes_at", np.uint8)
flags_at: Final = _ArrayAt("flags_at", np.int8)
"""Within kernels that are given addresses; numbers need not be aligned."""


_process: Final = Compiler()

"""Numeric kernels: plain functions over arrays and numbers, run by the interpreter or as machine code.

Compiling every kernel takes longer than reading a short log, and loading the compiled ones from disk takes
its time, too. So a kernel is interpreted while little work is due (see `_may_interpret`). Long ones are
shared among the processor's cores.

Both ways give the same bits. Kernels use only sums, products, quotients, square roots, sines and cosines of
IEEE doubles, without fast-math and fused contraction.

Machine code is kept on disk, in a folder named after a digest of all sources of the package. So a changed
kernel is never mistaken for the one before. A digest lies beside each file: damaged code would end the
process by a signal, and is compiled again. `SPATIAL_REPLAY_CACHE` names another place.
`SPATIAL_REPLAY_KERNELS` is `compiled` or `interpreted` to have only one of the two ways.
"""

from __future__ import annotations

import atexit
import errno
import fcntl
import gc
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from functools import cache, cached_property
from itertools import pairwise
from operator import methodcaller
from pathlib import Path
from types import FunctionType
from typing import Any, Final, Generic, Literal, ParamSpec, TypeVar, cast

import numpy as np

from spatial_replay.errors import UsageError

_WAIT_S: Final = 1.0
"""Compiling that takes less is not announced."""
_SLICE_S: Final = 2e-4
"""How long the thread that loads code may keep the interpreter from a control loop."""
_REMEDY: Final = "`spatial-replay warmup` does it beforehand"


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
        # tasks that a child process compiles, with the runs that load their code afterwards
        self.trials: list[tuple[str, Callable[[], object]]] = []
        self.loader: threading.Thread | None = None
        self._loading = set[int]()
        self.listeners: list[Callable[[], None]] = []
        self._is_announced = False
        # a module that another thread is still importing is in `sys.modules`, too
        self._compiler: Any = None
        self.lock = threading.RLock()
        # held while files are opened that a forked process must not keep
        self.fork_lock = threading.Lock()
        self.turns = set[int]()

    @cached_property
    def folder(self) -> Path | None:
        return cache_folder()

    @property
    def is_awaiting(self) -> bool:
        """Whether this thread interprets what a child process compiles."""
        return bool(self.trials) and threading.get_ident() not in self._loading

    @property
    def has_compiler(self) -> bool:
        """Whether the compiler is loaded."""
        return self._compiler is not None

    @cached_property
    def _cached(self) -> frozenset[str]:
        """The kernels whose machine code earlier processes have left in the cache."""
        # a file is named after module, function and line: kernels.measure_rows-335.py311.nbi
        files = () if self.folder is None else self.folder.rglob("*.nbi")
        return frozenset(path.name.partition("-")[0] for path in files)

    def holds(self, function: Any) -> bool:
        """Say whether the cache has machine code of a function."""
        return _name(function) in self._cached

    def compile(self, function: Callable[..., Any], options: dict[str, Any]) -> Any:
        """Return a function that is compiled for the types of its arguments when it is called."""
        with self.lock:
            if self._compiler is None:
                import numba

                if self.folder is not None:
                    remove_damaged_files(self.folder)
                    # and of what kernels that the cache holds are compiled for later
                    atexit.register(seal, self.folder)
                self._compiler = numba
            compiler, is_cached = self._compiler, self.folder is not None
            # the folder is read from the compiler's settings when a function is decorated; they belong to
            # the user's own functions, too, and are put back
            before = compiler.config.CACHE_DIR
            if is_cached:
                compiler.config.CACHE_DIR = str(self.folder)
            try:
                available = compiler.njit(function).targetdescr.options
                # an option that another version of the compiler does not have changes speed only
                options = {name: value for name, value in options.items() if hasattr(available, name)}
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
        timer = threading.Timer(_WAIT_S, self._announce)
        timer.daemon = True
        timer.start()
        try:
            with turn(self.folder, _name(function)):
                yield
                if self.folder is not None:
                    seal(self.folder)
        finally:
            timer.cancel()

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Load machine code in this thread, while others interpret."""
        # of the files that a child has written
        self.__dict__.pop("_cached", None)
        before, thread = sys.getswitchinterval(), threading.get_ident()
        sys.setswitchinterval(_SLICE_S)
        self._loading.add(thread)
        try:
            yield
        finally:
            self._loading.discard(thread)
            sys.setswitchinterval(before)

    def await_code(self) -> bool:
        """Begin a thread that loads the code of all trials, unless one runs; say whether it was begun."""
        with self.lock:
            if self.loader is not None or self.folder is None:
                return False
            self.loader = threading.Thread(target=_load_code, args=(self.folder,), daemon=True)
            self.loader.start()
            return True

    def finish(self, count: int) -> bool:
        """End the thread that loads code, unless more than so many trials wait; say whether it ends."""
        with self.lock:
            if len(self.trials) > count:
                return False
            self.trials.clear()
            self.loader = None
            return True

    def renew(self) -> None:
        """Begin the thread again in a forked process, which has none of its parent's."""
        self.lock = threading.RLock()
        self.fork_lock.release()
        self._loading.clear()
        # the lock would last as long as the last process that has it open
        for descriptor in self.turns:
            os.close(descriptor)
        self.turns.clear()
        if self.loader is not None:
            self.loader = None
            self.await_code()

    def say(self, text: str) -> None:
        """Write a line on standard error, unless a listener shows that kernels are compiled."""
        if not self.listeners:
            sys.stderr.write(f"spatial-replay: {text}\n")

    def _announce(self) -> None:
        if not self.listeners and not self._is_announced:
            self._is_announced = True
            self.say(f"compiling, once on this machine; {_REMEDY}")


def _name(function: Any) -> str:
    """Return how the compiler names the files of a function."""
    return f"{Path(function.__code__.co_filename).stem}.{function.__qualname__}"


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_PATIENCE_S: Final = 0.8
"""How long a process interprets kernels in any case: loading the compiler and machine code takes as long."""
_FIRST_S: Final = 1.5
"""The same for a kernel that was never run, before any code is loaded: most take a tenth of the guess."""
_COLD_S: Final = 2.0
_WARM_S: Final = 0.03
"""How long each kernel may be interpreted after that before it is compiled, or loaded from the cache."""
_GUESS_S: Final = 2e-6
"""For each element of its arrays, the time a kernel is expected to take when it was never run."""
_LONG: Final = 3.0
"""How many times that a kernel takes whose calls are long: it works on pairs of elements."""
_CALL: Final = 32
"""As many elements take as long as what a call costs anyway."""


def kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a function of arrays and numbers that may run as machine code."""
    return _Kernel(function, {"no_cfunc_wrapper": True})


def long_kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a kernel whose calls may take milliseconds: other threads run while it does.

    Not for short calls: each would hand the interpreter to a busy thread, which keeps it for milliseconds.
    """
    return _Kernel(function, {"nogil": True, "no_cfunc_wrapper": True}, times=_LONG)


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


def inlined(function: Callable[_Arguments, _Result], **options: bool) -> Callable[_Arguments, _Result]:
    """Return a piece that becomes part of every kernel that calls it.

    A call counts references to the arrays that it is given; within one function, that cancels out.

    Args:
        options: further ones of the compiler, ignored by versions that do not have them.
    """
    options |= {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return _Kernel(function, options)


def compile_ahead() -> None:
    """Interpret no kernel in this process from now on."""
    _process.interprets = False


def start(task: str, trial: Callable[[], object], *, wait: bool = False) -> None:
    """Make kernels ready for a control loop, which a call that is compiled late would keep waiting.

    A trial run loads machine code that the cache holds. Otherwise a child process compiles it, and all
    kernels that are not loaded are interpreted until a thread has loaded it.

    Args:
        task: the name of the task of `spatial-replay warmup` that compiles all kernels of the trial.
        wait: whether to compile in this process, and return when all kernels are compiled.
    """
    # once: garbage of a program that starts many monitors is still collected
    collections = _no_collection() if _process.interprets else nullcontext()
    compile_ahead()
    if _process.only is not None or wait or _is_compiled(task):
        with collections, _process.loading():
            trial()
        return
    if _process.folder is None:
        _process.folder = _passing_folder()
    _process.trials.append((task, trial))
    try:
        # interpreted: it imports and keeps all that the first sample would wait for
        with collections:
            trial()
    except BaseException:
        _process.trials.remove((task, trial))
        raise
    if _process.await_code():
        _process.say(
            f"code is interpreted while a child process compiles it, once on this machine; {_REMEDY}"
        )


def _passing_folder() -> Path | None:
    """Return a folder for machine code of this process alone; None if none can be written."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="spatial-replay-"), f"kernels-{source_digest()}")
        folder.mkdir()
    except OSError:
        _process.say("code is interpreted: no folder can be written; name one with SPATIAL_REPLAY_CACHE")
        return None
    atexit.register(shutil.rmtree, folder.parent, ignore_errors=True)
    return folder


def write_note(task: str) -> None:
    """Note that the cache holds all kernels of a task of `spatial-replay warmup`."""
    if _process.folder is not None:
        seal(_process.folder)
        _note_of(task, _process.folder).touch()


def _is_compiled(task: str) -> bool:
    return _process.folder is not None and _note_of(task, _process.folder).exists()


def _note_of(task: str, folder: Path) -> Path:
    """Return the file that says that the code of a task is there."""
    return folder / f"{task}-{_target()}.compiled"


@cache
def _target() -> str:
    """Return a digest of what machine code depends on besides the sources: Python, compiler, processor."""
    # imported now: while a loop runs, that would keep it waiting
    import numba

    target = [sys.version, numba.__version__, platform.machine(), platform.processor()]
    with suppress(OSError):  # not Linux
        # of the first core
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        target += [line for line in lines if line.startswith(("model name", "flags", "Features"))]
    return hashlib.sha256("\n".join(target).encode()).hexdigest()[:16]


def _load_code(folder: Path) -> None:
    """Load the code of all trials, each compiled by a child process: one at a time on a machine."""
    count = 0
    try:
        while not _process.finish(count):
            task, trial = _process.trials[count]
            note = _note_of(task, folder)
            # waits for the child of another process; the lock is also the child's, and ends with both
            with turn(folder, "warmup") as lock:
                status = 0 if note.exists() else _compile_in_child(task, folder, lock)
            if not note.exists():
                raise OSError(f"the child process that compiles it has ended with status {status}")
            with _process.loading(), _no_collection():
                trial()
            count += 1
    except Exception as error:
        # interpreted from now on: a loop must not wait for the compiler
        _process.loader = None
        _process.say(f"code stays interpreted: {error!s:.200}; {_REMEDY}")
    else:
        _process.say("compiled code is loaded")


@contextmanager
def _no_collection() -> Iterator[None]:
    """Keep new objects out of garbage collections: each keeps all threads waiting for 50 ms."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


_CHILD: Final = """
import sys
sys.path[:] = sys.argv[2:]
from spatial_replay.cli.warmup import compile_task
compile_task(sys.argv[1])
"""


def _compile_in_child(task: str, folder: Path, lock: int) -> int:
    """Compile a task in a child, which goes on if this process ends; return its status."""
    if not sys.executable or getattr(sys, "frozen", False):
        raise OSError("this program has no interpreter of its own to begin a child process with")
    # a child that compiles starts none itself
    environment = {
        **os.environ,
        "SPATIAL_REPLAY_KERNELS": "compiled",
        "SPATIAL_REPLAY_CACHE": str(folder.parent),
    }
    # a process forked now would keep the pipe open whose end says that the child has begun
    with _process.fork_lock:
        child = subprocess.Popen(
            [sys.executable, "-P", "-c", _CHILD, task, *sys.path],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            pass_fds=(lock,),
        )
    return child.wait()


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
    """Call `hear`, while this lasts, whenever a kernel is about to be compiled that no cache holds."""
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
    ) -> None:
        self.__wrapped__ = function
        self.__name__ = function.__name__
        self.__doc__ = function.__doc__
        self.__module__ = function.__module__
        self.options, self.times = options, times
        self._is_elementwise = is_elementwise
        self._compiled: Callable[_Arguments, _Result] | None = None
        self._interpreted: Callable[_Arguments, _Result] | None = None
        self._ready: Callable[_Arguments, _Result] | None = None
        self._spent_s = 0.0
        self._element_s: float | None = None

    def __call__(self, *arguments: _Arguments.args, **named: _Arguments.kwargs) -> _Result:
        if (ready := self._ready) is not None and _process.only != "interpreted":
            return ready(*arguments, **named)
        elements = _CALL + _elements(arguments)
        if not self._may_interpret(elements):
            compiled = self.compiled_form()
            with _process.compiling(self.__wrapped__):
                result = compiled(*arguments, **named)
            self._ready = compiled
            return result
        run = cast(Callable[..., _Result], self.interpreted_form())
        begin = time.thread_time()
        # as in machine code: a quotient by zero or a product out of range is no error and no warning
        with np.errstate(all="ignore"):
            result = run(*(map(_view, arguments) if self._is_elementwise else arguments), **named)
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
        """Return whether a call is interpreted: while little work is due, in this process or this kernel."""
        if _process.only is not None:
            return _process.only == "interpreted"
        if not _process.interprets:
            return _process.is_awaiting
        guess = _GUESS_S * self.times if self._element_s is None else self._element_s
        cost = elements * guess
        is_guess = self._element_s is None and not _process.has_compiler
        patience_s = _FIRST_S if is_guess else _PATIENCE_S
        if _process.spent_s + cost <= patience_s or self._spent_s + cost <= _WARM_S:
            return True
        # asked last, since looking for the cache takes its time, too
        return self._spent_s + cost <= _COLD_S and not _process.holds(self.__wrapped__)

    def interpreted_form(self) -> Callable[_Arguments, _Result]:
        """Return the function as it stands, calling others as they stand."""
        if self._interpreted is None:
            self._interpreted = _link(self.__wrapped__, methodcaller("interpreted_form"))
        return self._interpreted

    def compiled_form(self) -> Callable[_Arguments, _Result]:
        """Return the function as machine code, calling machine code."""
        if self._compiled is None:
            linked = _link(self.__wrapped__, methodcaller("compiled_form"))
            self._compiled = _process.compile(linked, self.options)
        return self._compiled


def _link(
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

    64 bytes count as a number, because kernels copy bytes at once or skip records.
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
        return cast(object, make(*(_view(array) if array.ndim == 1 else array for array in value)))
    return value.data if isinstance(value, np.ndarray) else value


_process: Final = Compiler()
os.register_at_fork(
    before=_process.fork_lock.acquire,
    after_in_parent=_process.fork_lock.release,
    after_in_child=_process.renew,
)


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
    with ThreadPoolExecutor(shares - 1) as threads:
        tasks = [threads.submit(run, begin, end) for begin, end in pairwise(ends[1:])]
        run(0, ends[1])
        for task in tasks:
            task.result()


_STALE_S: Final = 7 * 24 * 3600.0
_ROOM_BYTES: Final = 2**25
"""A disk with less space keeps no code: a kernel that cannot be written ends the process."""
_PACKAGE: Final = Path(__file__).parent


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
            # that of another user, where several may write, cannot be opened
            os.close(_opened_lock(folder))
            with tempfile.TemporaryFile(dir=folder):
                if shutil.disk_usage(folder).free < _ROOM_BYTES:
                    raise OSError(errno.ENOSPC, "no space left")
        except OSError:
            # code that was compiled when an image was built, and is read-only now, or on a full disk
            shipped = shipped or (folder if any(folder.rglob("*.nbi")) else None)
            continue
        if is_new:
            _remove_stale(parent, keep=name)
            if shipped is not None:
                with suppress(OSError):
                    shutil.copytree(shipped, folder, dirs_exist_ok=True)
        return folder
    return None


def remove_damaged_files(folder: Path) -> None:
    """Remove machine code that is not what was written.

    Code newer than its digest may be in the making while other processes run that use the folder. It stays.
    """
    descriptor = _opened_lock(folder)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_alone = True
    except OSError:
        is_alone = False
    for path in folder.rglob("*.nb[ic]"):
        with suppress(OSError):
            is_damaged = not _is_sealed(path) or _seal_of(path).read_bytes() != _digest_of(path)
            if is_damaged and (is_alone or _is_sealed(path)):
                path.unlink()
    # until this process ends
    fcntl.flock(descriptor, fcntl.LOCK_SH)


@contextmanager
def turn(folder: Path | None, kernel: str) -> Iterator[int]:
    """Wait for other processes that compile the same kernel: what they wrote is then loaded.

    Yields:
        The descriptor of the lock, which a child process may inherit; -1 without a folder.
    """
    if folder is None:
        yield -1
        return
    with _process.fork_lock:
        descriptor = _opened_lock(folder, f"{kernel}.lock")
        _process.turns.add(descriptor)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        with _process.fork_lock:
            # a process forked by this thread has closed it
            if descriptor in _process.turns:
                _process.turns.remove(descriptor)
                os.close(descriptor)


def _opened_lock(folder: Path, name: str = "lock") -> int:
    return os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o600)


def seal(folder: Path) -> None:
    """Note what was written since the last time."""
    for path in folder.rglob("*.nb[ic]"):
        with suppress(OSError):
            if not _is_sealed(path):
                _seal_of(path).write_bytes(_digest_of(path))


def _is_sealed(path: Path) -> bool:
    """Return whether a digest was noted after a file was written."""
    sealed = _seal_of(path)
    return sealed.exists() and sealed.stat().st_mtime_ns >= path.stat().st_mtime_ns


def _seal_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


def _digest_of(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).hexdigest().encode()


def _cache_parents() -> Iterator[Path]:
    for name in ("SPATIAL_REPLAY_CACHE", "NUMBA_CACHE_DIR"):
        if value := os.environ.get(name):
            yield Path(value).absolute()
    yield _PACKAGE / "__pycache__"
    if Path(value := os.environ.get("XDG_CACHE_HOME", "")).is_absolute():
        yield Path(value) / "spatial-replay"
    # a user without a home folder
    with suppress(RuntimeError):
        yield Path.home() / ".cache" / "spatial-replay"


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

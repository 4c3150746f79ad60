"""Numeric kernels: plain functions over arrays and numbers, run by the interpreter or as machine code.

Compiling all kernels takes longer than reading a short log, and loading machine code from disk takes time,
too. Therefore a kernel is interpreted as long as there is little work (see `_may_interpret`). The work of
long kernels is shared among the processor's cores.

Both forms give the same bits. Kernels use only sums, products, quotients, square roots, sines and cosines of
IEEE doubles, without fast-math and fused contraction.

Machine code is cached in a folder named after a digest of all sources of the package: stale code is never
loaded. Each file has a digest next to it. Damaged code would end the process by a signal, and is therefore
removed and compiled again. `SPATIAL_REPLAY_CACHE` names another folder. `SPATIAL_REPLAY_KERNELS` is
`compiled` or `interpreted` to allow only one form.
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
"""Delay of the announcement of a compilation, seconds."""
_SLICE_S: Final = 2e-4
"""Switch interval of threads while code is loaded, seconds: the longest wait of a control loop."""
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
        # pairs of a task, which a child process compiles, and a trial run, which loads the compiled code
        self.trials: list[tuple[str, Callable[[], object]]] = []
        self.loader: threading.Thread | None = None
        self._loading = set[int]()
        self.listeners: list[Callable[[], None]] = []
        self._is_announced = False
        # not read from `sys.modules`: another thread may still be importing the module
        self._compiler: Any = None
        self.lock = threading.RLock()
        # a thread holds this lock while it uses files that a forked process must not inherit
        self.fork_lock = threading.Lock()
        self.turns = set[int]()

    @cached_property
    def folder(self) -> Path | None:
        return cache_folder()

    @property
    def is_awaiting(self) -> bool:
        """Whether this thread interprets kernels that a child process compiles."""
        return bool(self.trials) and threading.get_ident() not in self._loading

    @property
    def has_compiler(self) -> bool:
        """Whether the compiler is loaded."""
        return self._compiler is not None

    @cached_property
    def _cached(self) -> frozenset[str]:
        """The names of kernels with machine code in the cache."""
        # numba names a file after module, function and line: kernels.measure_rows-335.py311.nbi
        files = () if self.folder is None else self.folder.rglob("*.nbi")
        return frozenset(path.name.partition("-")[0] for path in files)

    def holds(self, function: Any) -> bool:
        """Return whether the cache has machine code of a function."""
        return _name(function) in self._cached

    def compile(self, function: Callable[..., Any], options: dict[str, Any]) -> Any:
        """Return a function that numba compiles at its first call, for the types of the arguments."""
        with self.lock:
            if self._compiler is None:
                import numba

                if self.folder is not None:
                    remove_damaged_files(self.folder)
                    # cached kernels may be compiled later for further types
                    atexit.register(seal, self.folder)
                self._compiler = numba
            compiler, is_cached = self._compiler, self.folder is not None
            # numba reads the folder from its settings when a function is decorated; the settings are
            # restored, because they also apply to the user's own functions
            previous_folder = compiler.config.CACHE_DIR
            if is_cached:
                compiler.config.CACHE_DIR = str(self.folder)
            try:
                available_options = compiler.njit(function).targetdescr.options
                # options that this version of numba lacks only affect speed
                options = {name: value for name, value in options.items() if hasattr(available_options, name)}
                # with numba's default error model, a division by zero would raise
                return compiler.njit(cache=is_cached, error_model="numpy", **options)(function)
            finally:
                compiler.config.CACHE_DIR = previous_folder

    @contextmanager
    def compiling(self, function: Any) -> Iterator[None]:
        """Notify listeners before an uncached kernel is compiled. Announce a long compilation."""
        if self.holds(function):
            yield
            return
        for listener in tuple(self.listeners):
            listener()
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
        """Let this thread load machine code, while other threads interpret."""
        # the cached list of files is dropped, because a child process may have written files
        self.__dict__.pop("_cached", None)
        previous_interval, thread_id = sys.getswitchinterval(), threading.get_ident()
        sys.setswitchinterval(_SLICE_S)
        self._loading.add(thread_id)
        try:
            yield
        finally:
            self._loading.discard(thread_id)
            sys.setswitchinterval(previous_interval)

    def await_code(self) -> bool:
        """Start a thread that loads the code of all trials. Return False if a thread or no folder exists."""
        with self.lock:
            if self.loader is not None or self.folder is None:
                return False
            self.loader = threading.Thread(target=_load_code, args=(self.folder,), daemon=True)
            self.loader.start()
            return True

    def finish(self, count: int) -> bool:
        """Clear the trials if there are at most `count`; the loading thread may then end.

        Return whether the trials were cleared.
        """
        with self.lock:
            if len(self.trials) > count:
                return False
            self.trials.clear()
            self.loader = None
            return True

    def renew(self) -> None:
        """Prepare a forked process: release inherited locks, and start the loading thread again."""
        self.lock = threading.RLock()
        self.fork_lock.release()
        self._loading.clear()
        # a lock of `flock` lasts until all processes have closed it
        for descriptor in self.turns:
            os.close(descriptor)
        self.turns.clear()
        if self.loader is not None:
            self.loader = None
            self.await_code()

    def say(self, text: str) -> None:
        """Write a line to standard error. With listeners, nothing is written: they show the compilation."""
        if not self.listeners:
            sys.stderr.write(f"spatial-replay: {text}\n")

    def _announce(self) -> None:
        if not self.listeners and not self._is_announced:
            self._is_announced = True
            self.say(f"compiling, once on this machine; {_REMEDY}")


def _name(function: Any) -> str:
    """Return the beginning of the file names of a function's machine code."""
    return f"{Path(function.__code__.co_filename).stem}.{function.__qualname__}"


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_PATIENCE_S: Final = 0.8
"""Time for which a process always interprets kernels, seconds: the time for loading numba and code."""
_FIRST_S: Final = 1.5
"""`_PATIENCE_S` for a kernel whose time is a guess, seconds. Most such kernels take a tenth of it."""
_COLD_S: Final = 2.0
"""Limit of a kernel's interpreted time, seconds, if its machine code is not cached."""
_WARM_S: Final = 0.03
"""Limit of a kernel's interpreted time, seconds, if its machine code is cached."""
_GUESS_S: Final = 2e-6
"""Guessed time of a new kernel, seconds per array element."""
_LONG: Final = 3.0
"""Factor of the guess for long kernels, which work on pairs of elements."""
_CALL: Final = 32
"""Fixed cost of a call, in array elements."""


def kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a function of arrays and numbers that may run as machine code."""
    # no kernel needs the wrapper for calls from C, and compiling it takes time
    return _Kernel(function, {"no_cfunc_wrapper": True})


def long_kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a kernel whose calls may take milliseconds. Other threads run during a call.

    Use it only for long calls: after a call, another busy thread may keep the interpreter for milliseconds.
    """
    return _Kernel(function, {"nogil": True, "no_cfunc_wrapper": True}, times=_LONG)


def elementwise(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return an equal kernel that is interpreted two to five times as fast.

    The interpreted kernel gets memoryviews of plain numbers instead of arrays. Named tuples have memoryviews
    only for arrays of one dimension. Such a kernel may read and set single elements, and slice one dimension.
    It must not divide by zero.
    """
    kernel = cast("_Kernel[_Arguments, _Result]", function)
    return _Kernel(kernel.__wrapped__, kernel.options, is_elementwise=True, times=kernel.times)


def piece(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a kernel for calls from other kernels only."""
    return _Kernel(function, {"no_cpython_wrapper": True, "no_cfunc_wrapper": True})


def inlined(function: Callable[_Arguments, _Result], **options: bool) -> Callable[_Arguments, _Result]:
    """Return a piece that is inlined into its calling kernels.

    A call updates the reference counts of its arrays. Inlining avoids these updates.

    Args:
        options: further options of numba. Versions without these options ignore them.
    """
    options |= {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return _Kernel(function, options)


def compile_ahead() -> None:
    """End the interpretation of kernels in this process."""
    _process.interprets = False


def start(task: str, trial: Callable[[], object], *, wait: bool = False) -> None:
    """Prepare kernels for a control loop, so that no call waits for the compiler.

    A trial run loads cached machine code. Without cached code, a child process compiles the kernels. They are
    interpreted until a thread has loaded the code.

    Args:
        task: name of the `spatial-replay warmup` task that compiles all kernels of the trial.
        wait: whether to compile in this process, and return when all kernels are compiled.
    """
    # garbage collection is off only at the first start, because later starts collect earlier monitors
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
        # the interpreted trial has all imports and caches that would delay the first sample
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
    """Return a temporary folder for machine code of this process; None if no folder is writable."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="spatial-replay-"), f"kernels-{source_digest()}")
        folder.mkdir()
    except OSError:
        _process.say("code is interpreted: no folder can be written; name one with SPATIAL_REPLAY_CACHE")
        return None
    atexit.register(shutil.rmtree, folder.parent, ignore_errors=True)
    return folder


def write_note(task: str) -> None:
    """Mark a task of `spatial-replay warmup` as compiled: the cache has all kernels of the task."""
    if _process.folder is not None:
        seal(_process.folder)
        _note_of(task, _process.folder).touch()


def _is_compiled(task: str) -> bool:
    return _process.folder is not None and _note_of(task, _process.folder).exists()


def _note_of(task: str, folder: Path) -> Path:
    """Return the path of the file that marks a task as compiled."""
    return folder / f"{task}-{_target()}.compiled"


@cache
def _target() -> str:
    """Return a digest of Python, numba and the processor, the target of machine code."""
    # imported before a control loop runs, because the import would delay the loop
    import numba

    target_parts = [sys.version, numba.__version__, platform.machine(), platform.processor()]
    with suppress(OSError):  # not Linux
        # lines of the first core
        cpu_lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        target_parts += [line for line in cpu_lines if line.startswith(("model name", "flags", "Features"))]
    return hashlib.sha256("\n".join(target_parts).encode()).hexdigest()[:16]


def _load_code(folder: Path) -> None:
    """Load the code of all trials. Child processes compile the trials, one at a time on a machine."""
    trial_index = 0
    try:
        while not _process.finish(trial_index):
            task, trial = _process.trials[trial_index]
            note_file = _note_of(task, folder)
            # `turn` waits for children of other processes; the child keeps the inherited lock until its end
            with turn(folder, "warmup") as lock:
                status = 0 if note_file.exists() else _compile_in_child(task, folder, lock)
            if not note_file.exists():
                raise OSError(f"the child process that compiles it has ended with status {status}")
            with _process.loading(), _no_collection():
                trial()
            trial_index += 1
    except Exception as error:
        # kernels stay interpreted, because a control loop must not wait for the compiler
        _process.loader = None
        _process.say(f"code stays interpreted: {error!s:.200}; {_REMEDY}")
    else:
        _process.say("compiled code is loaded")


@contextmanager
def _no_collection() -> Iterator[None]:
    """Keep new objects out of garbage collections. A collection stops all threads for 50 ms."""
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
    """Compile a task in a child process, and return its status. The child continues if this process ends."""
    if not sys.executable or getattr(sys, "frozen", False):
        raise OSError("this program has no Python interpreter for a child process")
    # with this setting, the child starts no further child
    environment = {
        **os.environ,
        "SPATIAL_REPLAY_KERNELS": "compiled",
        "SPATIAL_REPLAY_CACHE": str(folder.parent),
    }
    # a process forked during the start would keep the pipe open through which Popen notices the start
    with _process.fork_lock:
        # -P keeps the current folder out of sys.path; in its own session, the child gets no Ctrl-C
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
    """Yield the kernels of all loaded modules, without pieces."""
    for module in tuple(sys.modules.values()):
        for value in tuple(vars(module).values()) if module.__name__.startswith(__package__) else ():
            if isinstance(value, _Kernel) and value.__module__ == module.__name__ and value.is_entry:
                yield value


@contextmanager
def only(form: Literal["compiled", "interpreted"]) -> Iterator[None]:
    """Run kernels in one form only within this context."""
    previous_form, _process.only = _process.only, form
    try:
        yield
    finally:
        _process.only = previous_form


@contextmanager
def compilations(hear: Callable[[], None]) -> Iterator[None]:
    """Call `hear` before an uncached kernel is compiled within this context."""
    _process.listeners.append(hear)
    try:
        yield
    finally:
        _process.listeners.remove(hear)


class _Kernel(Generic[_Arguments, _Result]):
    """A function in two forms, interpreted and compiled. Each form is created at its first use."""

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
        element_count = _CALL + _elements(arguments)
        if not self._may_interpret(element_count):
            compiled = self.compiled_form()
            with _process.compiling(self.__wrapped__):
                result = compiled(*arguments, **named)
            self._ready = compiled
            return result
        run = cast(Callable[..., _Result], self.interpreted_form())
        # the processor time of this thread excludes its waits for other threads
        begin_s = time.thread_time()
        # machine code reports no division by zero and no overflow, so interpreted code must not either
        with np.errstate(all="ignore"):
            result = run(*(map(_view, arguments) if self._is_elementwise else arguments), **named)
        took_s = time.thread_time() - begin_s
        self._spent_s += took_s
        _process.spent_s += took_s
        self._element_s = max(took_s / element_count, self._element_s or 0.0)
        return result

    @property
    def is_entry(self) -> bool:
        """Whether Python code may call the kernel, too."""
        return "no_cpython_wrapper" not in self.options

    @property
    def is_compiled(self) -> bool:
        """Whether machine code exists for the argument types of at least one call."""
        return bool(getattr(self._compiled, "signatures", ()))

    def _may_interpret(self, element_count: int) -> bool:
        """Return whether a call is interpreted: this process or this kernel has little work."""
        if _process.only is not None:
            return _process.only == "interpreted"
        if not _process.interprets:
            return _process.is_awaiting
        element_guess_s = _GUESS_S * self.times if self._element_s is None else self._element_s
        cost_s = element_count * element_guess_s
        is_guess = self._element_s is None and not _process.has_compiler
        patience_s = _FIRST_S if is_guess else _PATIENCE_S
        if _process.spent_s + cost_s <= patience_s or self._spent_s + cost_s <= _WARM_S:
            return True
        # tested last, because searching the cache takes time, too
        return self._spent_s + cost_s <= _COLD_S and not _process.holds(self.__wrapped__)

    def interpreted_form(self) -> Callable[_Arguments, _Result]:
        """Return the plain function, which calls the plain forms of other kernels."""
        if self._interpreted is None:
            self._interpreted = _link(self.__wrapped__, methodcaller("interpreted_form"))
        return self._interpreted

    def compiled_form(self) -> Callable[_Arguments, _Result]:
        """Return the compiled function, which calls the compiled forms of other kernels."""
        if self._compiled is None:
            linked = _link(self.__wrapped__, methodcaller("compiled_form"))
            self._compiled = _process.compile(linked, self.options)
        return self._compiled


def _link(
    function: Callable[_Arguments, _Result], form: Callable[[Any], Any]
) -> Callable[_Arguments, _Result]:
    """Return a copy of a function that calls `form(kernel)` instead of each kernel."""
    original = cast(FunctionType, function)
    globals_by_name = {
        name: original.__globals__[name] for name in _names(original) if name in original.__globals__
    }
    linked_globals = {
        name: form(value) if isinstance(value, _Kernel) else value for name, value in globals_by_name.items()
    }
    linked_globals |= {"__builtins__": original.__globals__["__builtins__"], "__name__": original.__module__}
    copy = FunctionType(original.__code__, linked_globals, original.__name__, original.__defaults__)
    copy.__qualname__, copy.__doc__ = original.__qualname__, original.__doc__
    copy.__kwdefaults__ = original.__kwdefaults__
    return cast(Callable[_Arguments, _Result], copy)


def _names(function: FunctionType) -> set[str]:
    """Return the names of possible globals in a function and in its comprehensions."""
    names, codes = set[str](), [function.__code__]
    while codes:
        code = codes.pop()
        names.update(code.co_names)
        codes += [constant for constant in code.co_consts if isinstance(constant, type(code))]
    return names


def _elements(values: object) -> int:
    """Return the number of elements of arrays, also of arrays within tuples.

    64 bytes of a byte array count as an element, because kernels copy bytes at once or skip records.
    """
    if isinstance(values, np.ndarray):
        return values.size // (64 if values.itemsize == 1 else 1)
    if isinstance(values, tuple):
        return sum(map(_elements, values))
    return 0


def _view(value: Any) -> object:
    if isinstance(value, tuple):
        # kernels read rows of arrays in named tuples, and memoryviews of several dimensions have no rows
        tuple_type: Any = type(value)
        return cast(object, tuple_type(*(_view(array) if array.ndim == 1 else array for array in value)))
    return value.data if isinstance(value, np.ndarray) else value


_process: Final = Compiler()
os.register_at_fork(
    before=_process.fork_lock.acquire,
    after_in_parent=_process.fork_lock.release,
    after_in_child=_process.renew,
)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def over_cores(
    used: Callable[..., object], run: Callable[[int, int], object], count: int, least: int
) -> None:
    """Split range(count) into shares, and call `run(begin, end)` for each share on its own core.

    Args:
        used: long kernel that `run` calls. Until it is compiled, there is one share.
        count: length of the range.
        least: least length of a share, with about a millisecond of work.
    """
    share_count = min(cores(), count // max(least, 1)) if getattr(used, "is_compiled", False) else 1
    if share_count < 2:
        run(0, count)
        return
    share_ends = [count * share // share_count for share in range(share_count + 1)]
    with ThreadPoolExecutor(share_count - 1) as threads:
        tasks = [threads.submit(run, begin, end) for begin, end in pairwise(share_ends[1:])]
        run(0, share_ends[1])
        for task in tasks:
            task.result()


_STALE_S: Final = 7 * 24 * 3600.0
_ROOM_BYTES: Final = 2**25
"""Least free disk space for the cache, bytes. The process ends if numba cannot write a kernel."""
_PACKAGE: Final = Path(__file__).parent


def cache_folder() -> Path | None:
    """Return the folder for machine code of these sources, created if needed; None if no folder is writable.

    Code is loaded without checks of its origin: only the user, or the installer of the package, may write to
    the folder.
    """
    folder_name = f"kernels-{source_digest()}"
    packaged_folder: Path | None = None
    for parent in _cache_parents():
        folder = parent / folder_name
        try:
            is_new = not folder.exists()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # this test fails if the folder belongs to another user, whose lock cannot be opened
            os.close(_opened_lock(folder))
            with tempfile.TemporaryFile(dir=folder):
                if shutil.disk_usage(folder).free < _ROOM_BYTES:
                    raise OSError(errno.ENOSPC, "no space left")
        except OSError:
            # a folder on a read-only or full disk may still hold the code of a container image
            packaged_folder = packaged_folder or (folder if any(folder.rglob("*.nbi")) else None)
            continue
        if is_new:
            _remove_stale(parent, keep=folder_name)
            if packaged_folder is not None:
                # code of a read-only image is copied instead of compiled again
                with suppress(OSError):
                    shutil.copytree(packaged_folder, folder, dirs_exist_ok=True)
        return folder
    return None


def remove_damaged_files(folder: Path) -> None:
    """Remove machine code that does not match its digest.

    Code newer than its digest may be unfinished. It stays while other processes use the folder.
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
    # the shared lock shows other processes that this process uses the folder until it ends
    fcntl.flock(descriptor, fcntl.LOCK_SH)


@contextmanager
def turn(folder: Path | None, kernel: str) -> Iterator[int]:
    """Wait for other processes that compile the same kernel. Their code can then be loaded.

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
            # in a forked process, `renew` has closed the descriptor
            if descriptor in _process.turns:
                _process.turns.remove(descriptor)
                os.close(descriptor)


def _opened_lock(folder: Path, name: str = "lock") -> int:
    return os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o600)


def seal(folder: Path) -> None:
    """Write the digests of all files without a current digest."""
    for path in folder.rglob("*.nb[ic]"):
        with suppress(OSError):
            if not _is_sealed(path):
                _seal_of(path).write_bytes(_digest_of(path))


def _is_sealed(path: Path) -> bool:
    """Return whether the digest of a file was written after the file."""
    seal_file = _seal_of(path)
    return seal_file.exists() and seal_file.stat().st_mtime_ns >= path.stat().st_mtime_ns


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
    # `Path.home` fails for a user without a home folder
    with suppress(RuntimeError):
        yield Path.home() / ".cache" / "spatial-replay"


def _remove_stale(parent: Path, keep: str) -> None:
    """Remove machine code of other sources that has not grown for a week."""
    oldest_s = time.time() - _STALE_S
    for folder in parent.glob("kernels-*"):
        with suppress(OSError):
            if folder.name != keep and folder.stat().st_mtime < oldest_s:
                shutil.rmtree(folder, ignore_errors=True)


@cache
def source_digest() -> str:
    """Return a digest of all sources of the package, because any module may have constants of kernels."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]

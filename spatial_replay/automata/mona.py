"""The compiler by others: MONA, which runs as a process of its own."""

from __future__ import annotations

import re
import resource
import shutil
import subprocess
from contextlib import suppress
from threading import Timer
from typing import NamedTuple

from spatial_replay.automata.diagrams import Diagrams
from spatial_replay.automata.machine import Machine
from spatial_replay.automata.mona_program import mona_program, require_translatable
from spatial_replay.automata.skeleton import Skeleton
from spatial_replay.errors import NoAutomatonError

_TIMEOUT_S = 10.0
_MAX_MEMORY = 4 * 2**30
"""Bytes that MONA may use."""
_MAX_OUTPUT = 32 * 2**20
"""Bytes that are read of what MONA prints."""
_MAX_MOVES = 100_000
"""Moves that are taken of an automaton."""
_MAX_PROGRAM = 1_000_000
"""Characters of a program that are given to MONA."""

_HEADER = re.compile(r"DFA for formula with free variables:(.*)")
_ACCEPTING = re.compile(r"Accepting states:([ \d]*)")
_COUNT = re.compile(r"Automaton has (\d+) states?")
_MOVE = re.compile(r"State (\d+): ([01X]*) -> state (\d+)")


def compiled_by_mona(skeleton: Skeleton, propositions: int) -> Machine:
    """The automaton of a skeleton over so many propositions.

    Raises:
        NoAutomatonError: MONA is not installed, fails or takes too long; a formula too large for it.
    """
    require_translatable(skeleton)
    executable = _executable()
    program = mona_program(skeleton)
    if len(program) > _MAX_PROGRAM:
        raise NoAutomatonError(
            f"its program has {len(program)} characters, at most {_MAX_PROGRAM} are given to it"
        )
    return _machine(_output(executable, program), propositions)


def _executable() -> str:
    """Where MONA is, looked for before anything is loaded to write a program for it."""
    executable = shutil.which("mona")
    if executable is None:
        raise NoAutomatonError("it is not installed, and may still compile it: apt-get install mona")
    return executable


def _output(executable: str, program: str) -> str:
    """What MONA prints of a program.

    The program goes through a pipe and nothing through a shell or a file, so any number may run at once.
    """
    command = [executable, "-q", "-u", "-w", "/dev/stdin"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        with suppress(OSError):
            # it may have ended already, or the machine forbid to limit it
            resource.prlimit(process.pid, resource.RLIMIT_AS, (_MAX_MEMORY, _MAX_MEMORY))
        timer = Timer(_TIMEOUT_S, process.kill)
        timer.start()
        try:
            printed = _exchanged(process, program.encode("ascii"))
        finally:
            timer.cancel()
            process.kill()
    if len(printed) > _MAX_OUTPUT:
        raise NoAutomatonError(f"it printed more than {_MAX_OUTPUT} bytes")
    if process.returncode == -9:
        raise NoAutomatonError(f"it was ended after {_TIMEOUT_S:g} s or for lack of memory")
    if process.returncode != 0:
        last = printed.decode("ascii", "replace").strip().splitlines()[-1:]
        raise NoAutomatonError(f"it ended with code {process.returncode}: {''.join(last)[:200]}")
    return printed.decode("ascii", "replace")


def _exchanged(process: subprocess.Popen[bytes], program: bytes) -> bytes:
    """Hand over the program, which MONA reads to its end first, and take what it prints."""
    if process.stdin is None or process.stdout is None:
        return b""
    try:
        process.stdin.write(program)
        process.stdin.close()
    except BrokenPipeError:
        # it ended before; its code and what it printed say why
        pass
    printed = process.stdout.read(_MAX_OUTPUT + 1)
    if len(printed) <= _MAX_OUTPUT:
        process.wait()
    return printed


class _Cube(NamedTuple):
    """Moves of a state: by proposition, whether it must be false ("0") or true ("1") or is free ("X")."""

    symbol: str
    target: int


def _machine(printed: str, propositions: int) -> Machine:
    """The automaton that MONA printed; its state 0 only leads to the one in which a run begins."""
    header, accepting, count = (pattern.search(printed) for pattern in (_HEADER, _ACCEPTING, _COUNT))
    if header is None or accepting is None or count is None:
        raise NoAutomatonError(f"it printed no automaton: {printed.strip()[:200]!r}")
    order = [int(name.removeprefix("P")) for name in header[1].split()]
    states = int(count[1])
    found = _MOVE.findall(printed)
    if len(found) > _MAX_MOVES:
        raise NoAutomatonError(f"the automaton has {states} states and more than {_MAX_MOVES} moves")
    cubes: list[list[_Cube]] = [[] for _ in range(states)]
    for state, symbol, target in found:
        letters = ["X"] * propositions
        for number, letter in zip(order, symbol, strict=True):
            letters[number] = letter
        cubes[int(state)].append(_Cube("".join(letters), int(target)))
    if not all(cubes):
        raise NoAutomatonError("it printed an automaton without moves from some state")
    diagrams = Diagrams()
    moves = tuple(_node(diagrams, each, 0) for each in cubes)
    first = cubes[0][0].target
    accepts = {int(number) for number in accepting[1].split()}
    return Machine(diagrams, moves, tuple(state in accepts for state in range(states)), moves[first])


def _node(diagrams: Diagrams, cubes: list[_Cube], variable: int) -> int:
    """The diagram of disjoint cubes that together cover everything, from a variable on."""
    symbol, target = cubes[0]
    if len(cubes) == 1:
        return diagrams.leaf(target)
    low, high = ([cube for cube in cubes if cube.symbol[variable] != other] for other in ("1", "0"))
    if not low or not high:
        raise NoAutomatonError(f"it printed moves that leave {symbol!r} open")
    when_false = _node(diagrams, low, variable + 1)
    # a variable that is free in every cube is not to double the work
    when_true = when_false if low == high else _node(diagrams, high, variable + 1)
    return diagrams.decide(variable, when_false, when_true)

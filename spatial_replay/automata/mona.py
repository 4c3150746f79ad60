"""The compiler by others: formulas as programs for MONA, which runs as a process of its own."""

from __future__ import annotations

import re
import resource
import shutil
import subprocess
from contextlib import suppress
from functools import cache
from threading import Timer
from typing import NamedTuple, Protocol

from spatial_replay.automata.diagrams import Diagrams
from spatial_replay.automata.machine import Machine
from spatial_replay.automata.skeleton import Skeleton
from spatial_replay.errors import NoAutomatonError

INSTALL = "apt-get install mona"

_TIMEOUT_S = 10.0
_MAX_MEMORY = 4 * 2**30
"""Bytes that MONA may use."""
_MAX_OUTPUT = 32 * 2**20
"""Bytes that are read of what MONA prints."""
_MAX_MOVES = 100_000
"""Moves that are taken of an automaton."""
_MAX_TEXT = 200_000
"""Characters of a formula as a text."""
_MAX_DEPTH = 60
"""How deep a formula may nest: the translation into MONA's language recurses."""

_HEADER = re.compile(r"DFA for formula with free variables:(.*)")
_ACCEPTING = re.compile(r"Accepting states:([ \d]*)")
_COUNT = re.compile(r"Automaton has (\d+) states?")
_MOVE = re.compile(r"State (\d+): ([01X]*) -> state (\d+)")


def is_installed() -> bool:
    """Whether there is a MONA to run."""
    return shutil.which("mona") is not None


def compiled_by_mona(skeleton: Skeleton, propositions: int) -> Machine:
    """The automaton of a skeleton over so many propositions.

    Raises:
        NoAutomatonError: MONA is not installed, fails or takes too long; a formula too large for it.
    """
    return _machine(_output(_program(_text(skeleton))), propositions)


def _text(skeleton: Skeleton) -> str:
    """The formula as others write LTLf, every operand in brackets."""
    texts: list[str] = []
    depths: list[int] = []
    for kind, first, second in skeleton.nodes:
        if kind == "literal":
            texts.append(f"p{first}" if second else f"!(p{first})")
            depths.append(1)
            continue
        if kind in ("true", "false"):
            texts.append(kind)
            depths.append(1)
            continue
        operands = [first] if kind in ("X", "WX") else [first, second]
        depths.append(1 + max(depths[each] for each in operands))
        written = [texts[each] for each in operands]
        if depths[-1] > _MAX_DEPTH or sum(map(len, written)) > _MAX_TEXT:
            raise NoAutomatonError("the formula is too large for MONA, with its bounds unrolled into steps")
        texts.append(_written(kind, written))
    return texts[skeleton.root]


def _written(kind: str, operands: list[str]) -> str:
    match kind, operands:
        case "U", ["true", operand]:
            return f"F({operand})"
        case "R", ["false", operand]:
            return f"G({operand})"
        case _, [operand]:
            return f"{kind}({operand})"
    operator = {"and": "&", "or": "|"}.get(kind, kind)
    return f"({operands[0]}) {operator} ({operands[1]})"


class _Parser(Protocol):
    def __call__(self, text: str) -> object: ...


@cache
def _parser() -> _Parser:
    from ltlf2dfa.parser.ltlf import LTLfParser

    parser: _Parser = LTLfParser()
    return parser


def _program(text: str) -> str:
    """The formula in MONA's language."""
    from ltlf2dfa.base import MonaProgram

    program: str = MonaProgram(_parser()(text)).mona_program()
    # its first line repeats the formula in a comment
    return program.partition("\n")[2]


def _output(program: str) -> str:
    """What MONA prints of a program.

    The program goes through a pipe and nothing through a shell or a file, so any number may run at once.
    """
    executable = shutil.which("mona")
    if executable is None:
        raise NoAutomatonError(f"MONA is not installed; {INSTALL}")
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
        raise NoAutomatonError("the automaton is larger than what is read of MONA's output")
    if process.returncode == -9:
        raise NoAutomatonError(f"MONA was ended after {_TIMEOUT_S:g} s or for lack of memory")
    if process.returncode != 0:
        last = printed.decode("ascii", "replace").strip().splitlines()[-1:]
        raise NoAutomatonError(f"MONA ended with code {process.returncode}: {''.join(last)[:200]}")
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
        raise NoAutomatonError(f"MONA printed no automaton: {printed.strip()[:200]!r}")
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
        raise NoAutomatonError("MONA printed an automaton without moves from some state")
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
        raise NoAutomatonError(f"MONA printed moves that leave {symbol!r} open")
    return diagrams.decide(variable, _node(diagrams, low, variable + 1), _node(diagrams, high, variable + 1))

"""The external compiler: MONA, as a separate process, on programs that ltlf2dfa writes.

This is the only module that imports ltlf2dfa.
"""

from __future__ import annotations

import re
import resource
import shutil
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from threading import Timer
from types import MappingProxyType
from typing import NamedTuple

from spatial_replay.automata.guards import Diagrams
from spatial_replay.automata.ltlf import Kind, Node, Skeleton
from spatial_replay.automata.minimise import Machine, machine_of
from spatial_replay.errors import NoAutomatonError

_MAX_DEPTH = 220
"""Nested operators at most: ltlf2dfa recurses, and fails beyond 243."""
_MAX_SIZE = 20_000
"""Subformulas translated at most, each as often as it is written: about two seconds of work."""

_SIGNS: MappingProxyType[Kind, str] = MappingProxyType({"and": "&", "or": "|", "U": "U", "R": "R"})


def require_translatable(skeleton: Skeleton) -> None:
    """Refuse a formula that is too large for ltlf2dfa.

    Raises:
        NoAutomatonError: it is not.
    """
    depth, size = _depth_and_size(skeleton)
    formula = "with its bounds unrolled the formula"
    if depth > _MAX_DEPTH:
        raise NoAutomatonError(f"{formula} nests {depth} deep, at most {_MAX_DEPTH} can be translated")
    if size > _MAX_SIZE:
        raise NoAutomatonError(f"{formula} has more than {_MAX_SIZE} subformulas to translate")


def mona_program(skeleton: Skeleton) -> str:
    """Return the program whose automaton accepts the runs that satisfy a formula that is small enough.

    Proposition 3 is the set `P3`; one that the formula does not depend on is left out.
    """
    # a thread of its own has the whole depth of recursion left, however deep its caller is
    with ThreadPoolExecutor(max_workers=1) as thread:
        return thread.submit(_translated, skeleton).result()


def _depth_and_size(skeleton: Skeleton) -> tuple[int, int]:
    """Return the depth of a formula, and the number of subformulas that its program is made of."""
    depths: list[int] = []
    sizes: list[int] = []
    for node in skeleton.nodes:
        operands = _operands(node)
        depths.append(1 + max((depths[each] for each in operands), default=-1))
        sizes.append(1 + sum(sizes[each] for each in operands))
    return depths[skeleton.root], sizes[skeleton.root]


def _operands(node: Node) -> tuple[int, ...]:
    """Return the numbers of a node's operands, each as often as it occurs in a program."""
    match node.kind:
        case "false" | "true" | "literal":
            return ()
        case "X" | "WX":
            return (node.first,)
        case "R":
            return node.first, node.second, node.second
    return node.first, node.second


def _translated(skeleton: Skeleton) -> str:
    from ltlf2dfa.base import MonaProgram

    formula = _parser()(_text(skeleton.nodes, skeleton.root))
    program: str = MonaProgram(formula).mona_program()
    # its first line repeats the formula in a comment
    return program.partition("\n")[2]


def _text(nodes: Sequence[Node], number: int) -> str:
    """Return a subformula as ltlf2dfa reads LTLf: propositions are `p0`, `p1` …, operands in brackets."""
    kind, first, second = nodes[number]
    match kind:
        case "false" | "true":
            return kind
        case "literal":
            return f"p{first}" if second else f"!(p{first})"
        case "X" | "WX":
            return f"{kind}({_text(nodes, first)})"
    return f"({_text(nodes, first)}) {_SIGNS[kind]} ({_text(nodes, second)})"


@cache
def _parser() -> Callable[[str], object]:
    """Return the parser of LTLf, which takes longer to make than to use."""
    from ltlf2dfa.parser.ltlf import LTLfParser

    parser: Callable[[str], object] = LTLfParser()
    return parser


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
    """Return the automaton of a skeleton over so many propositions.

    Raises:
        NoAutomatonError: MONA is not installed, fails or takes too long; a formula too large for it.
    """
    require_translatable(skeleton)
    # looked for before ltlf2dfa is imported, which takes longer than all else here
    executable = shutil.which("mona")
    if executable is None:
        raise NoAutomatonError("it is not installed, and may still compile it: apt-get install mona")
    if find_spec("ltlf2dfa") is None:
        raise NoAutomatonError(
            "what writes its programs is not installed: pip install 'spatial-replay[mona]'"
        )
    program = mona_program(skeleton)
    if (length := len(program)) > _MAX_PROGRAM:
        raise NoAutomatonError(f"its program has {length} characters, at most {_MAX_PROGRAM} are given to it")
    return _machine(_output(executable, program), propositions)


def _output(executable: str, program: str) -> str:
    """Run MONA on a program and return what it prints.

    The program goes through a pipe, not through a shell or a file, so any number may run at once.
    """
    command = [executable, "-q", "-u", "-w", "/dev/stdin"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        with suppress(OSError):
            # it may have ended already, or limits may not be allowed here
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
    """Send the program, which MONA reads to its end first, and read what it prints."""
    if process.stdin is None or process.stdout is None:
        return b""
    try:
        process.stdin.write(program)
        process.stdin.close()
    except BrokenPipeError:
        # it has ended; its exit code and output say why
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
    """Return the automaton that MONA printed; its state 0 only leads to the one in which a run begins."""
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
    return machine_of(diagrams, moves, [state in accepts for state in range(states)], moves[first])


def _node(diagrams: Diagrams, cubes: list[_Cube], variable: int) -> int:
    """Return the diagram of disjoint cubes that together cover everything, from a variable on."""
    symbol, target = cubes[0]
    if len(cubes) == 1:
        return diagrams.leaf(target)
    low, high = ([cube for cube in cubes if cube.symbol[variable] != other] for other in ("1", "0"))
    if not low or not high:
        raise NoAutomatonError(f"it printed moves that leave {symbol!r} open")
    when_false = _node(diagrams, low, variable + 1)
    # without this, a variable that is free in every cube would double the work
    when_true = when_false if low == high else _node(diagrams, high, variable + 1)
    return diagrams.decide(variable, when_false, when_true)

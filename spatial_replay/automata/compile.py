"""Compilers from formulas to automata: by progression, by products of operands, or by MONA."""

from __future__ import annotations

import json
import math
import re
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache
from heapq import heapify, heappop, heappush
from importlib.util import find_spec
from threading import Timer
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from spatial_replay.automata.automaton import MAX_PROPOSITIONS, MAX_ROWS, Automaton, automaton_of
from spatial_replay.automata.guards import LEAF, NO, YES, Diagrams, Propositions, node_copier
from spatial_replay.automata.ltlf import FALSE, TRUE, Kind, Node, Skeleton, counts_seconds, no_automaton
from spatial_replay.automata.machine import Machine, least, machine_of, merge_equivalent_states
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.spec.diagnostics import SourceText, nearest_hint
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import NamedSpec, Specification
from spatial_replay.spec.load import require_specification
from spatial_replay.text import named_arguments

_MAX_DEPTH = 220
"""Maximum depth of nested operators: ltlf2dfa recurses, and fails beyond 243."""
_MAX_SIZE = 20_000
"""Maximum number of subformulas to translate, with repetitions; their translation takes about 2 s."""

_SIGNS: MappingProxyType[Kind, str] = MappingProxyType({"and": "&", "or": "|", "U": "U", "R": "R"})


def require_translatable(skeleton: Skeleton) -> None:
    """Refuse a formula that is too large for ltlf2dfa.

    Raises:
        NoAutomatonError: the formula is too deep or has too many subformulas.
    """
    depth, size = _depth_and_size(skeleton)
    subject = "with its bounds unrolled the formula"
    if depth > _MAX_DEPTH:
        raise NoAutomatonError(f"{subject} nests {depth} deep, at most {_MAX_DEPTH} can be translated")
    if size > _MAX_SIZE:
        raise NoAutomatonError(f"{subject} has more than {_MAX_SIZE} subformulas to translate")


def mona_program(skeleton: Skeleton) -> str:
    """Translate a formula that `require_translatable` accepts into a MONA program.

    Proposition 3 becomes the set `P3`. Propositions that the formula does not depend on are left out.
    """
    # ltlf2dfa recurses: a new thread has the whole recursion depth left, however deep its caller is
    with ThreadPoolExecutor(max_workers=1) as thread:
        return thread.submit(_translate, skeleton).result()


def _depth_and_size(skeleton: Skeleton) -> tuple[int, int]:
    """Return the depth of a formula, and the number of subformulas in its program."""
    depths: list[int] = []
    sizes: list[int] = []
    for node in skeleton.nodes:
        operands = _operands(node)
        depths.append(1 + max((depths[operand] for operand in operands), default=-1))
        sizes.append(1 + sum(sizes[operand] for operand in operands))
    return depths[skeleton.root], sizes[skeleton.root]


def _operands(node: Node) -> tuple[int, ...]:
    """Return the numbers of a node's operands, each as often as it occurs in the program."""
    match node.kind:
        case "false" | "true" | "literal":
            return ()
        case "X" | "WX":
            return (node.first,)
        case "R":
            # ltlf2dfa writes the right operand of a release twice
            return node.first, node.second, node.second
    return node.first, node.second


def _translate(skeleton: Skeleton) -> str:
    from ltlf2dfa.base import MonaProgram

    formula = _parser()(_text(skeleton.nodes, skeleton.root))
    program: str = MonaProgram(formula).mona_program()
    # the first line is a comment that repeats the formula
    return program.partition("\n")[2]


def _text(nodes: Sequence[Node], number: int) -> str:
    """Return a subformula in ltlf2dfa's syntax: propositions are `p0`, `p1` …, operands are in brackets."""
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
    """Return the parser of LTLf, cached because its construction takes longer than a parse."""
    from ltlf2dfa.parser.ltlf import LTLfParser

    parser: Callable[[str], object] = LTLfParser()
    return parser


_TIMEOUT_S = 10.0
"""Time limit of MONA, s."""
_MAX_MEMORY = 4 * 2**30
"""Memory limit of MONA, bytes."""
_MAX_OUTPUT = 32 * 2**20
"""Limit of MONA's output, bytes."""
_MAX_MOVES = 100_000
"""Maximum number of moves in MONA's output."""
_MAX_PROGRAM = 1_000_000
"""Maximum length of a MONA program, characters."""

# lines of the output of `mona -w`
_HEADER = re.compile(r"DFA for formula with free variables:(.*)")
_ACCEPTING = re.compile(r"Accepting states:([ \d]*)")
_COUNT = re.compile(r"Automaton has (\d+) states?")
_MOVE = re.compile(r"State (\d+): ([01X]*) -> state (\d+)")


def compiled_by_mona(skeleton: Skeleton, propositions: int) -> Machine:
    """Compile a skeleton with MONA.

    Args:
        propositions: number of propositions.

    Raises:
        NoAutomatonError: MONA or ltlf2dfa is not installed, MONA fails or takes too long, or the formula is
            too large for them.
    """
    require_translatable(skeleton)
    # checked before ltlf2dfa is imported, which takes about a second
    executable = shutil.which("mona")
    if executable is None:
        raise NoAutomatonError("it is not installed, and may compile the formula: apt-get install mona")
    if find_spec("ltlf2dfa") is None:
        raise NoAutomatonError(
            "ltlf2dfa, which writes its programs, is not installed: pip install 'spatial-replay[mona]'"
        )
    program = mona_program(skeleton)
    if (length := len(program)) > _MAX_PROGRAM:
        raise NoAutomatonError(f"its program has {length} characters, at most {_MAX_PROGRAM} are given to it")
    return _machine(_output(executable, program), propositions)


def _output(executable: str, program: str) -> str:
    """Run MONA on a program and return its output.

    The program goes through a pipe instead of a file, so any number of processes may run at once.
    """
    # -q: quiet, -u: a conventional automaton, -w: printed as a whole (`mona` without arguments explains them)
    command = [executable, "-q", "-u", "-w", "/dev/stdin"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        with suppress(OSError):
            # MONA may have ended already, or the system may not allow limits
            resource.prlimit(process.pid, resource.RLIMIT_AS, (_MAX_MEMORY, _MAX_MEMORY))
        timer = Timer(_TIMEOUT_S, process.kill)
        timer.start()
        try:
            output = _exchange(process, program.encode("ascii"))
        finally:
            timer.cancel()
            process.kill()
    if len(output) > _MAX_OUTPUT:
        raise NoAutomatonError(f"it printed more than {_MAX_OUTPUT} bytes")
    if process.returncode == -9:
        raise NoAutomatonError(f"it was ended after {_TIMEOUT_S:g} s or for lack of memory")
    if process.returncode != 0:
        last_line = output.decode("ascii", "replace").strip().splitlines()[-1:]
        raise NoAutomatonError(f"it ended with code {process.returncode}: {''.join(last_line)[:200]}")
    return output.decode("ascii", "replace")


def _exchange(process: subprocess.Popen[bytes], program: bytes) -> bytes:
    """Send the program and read the output; MONA prints nothing before it has read the whole program."""
    if process.stdin is None or process.stdout is None:
        return b""
    try:
        process.stdin.write(program)
        process.stdin.close()
    except BrokenPipeError:
        # MONA has ended; its exit code and output give the reason
        pass
    # one more byte shows that the output is too long
    output = process.stdout.read(_MAX_OUTPUT + 1)
    # a process with more output would wait for the full pipe forever; the caller kills it
    if len(output) <= _MAX_OUTPUT:
        process.wait()
    return output


class _Cube(NamedTuple):
    """Moves of a state; `symbol` has a letter for each proposition: "0" false, "1" true, "X" any value."""

    symbol: str
    target: int


def _machine(output: str, proposition_count: int) -> Machine:
    """Parse the automaton that MONA printed; MONA's state 0 only leads to the state in which a run begins."""
    header, accepting, state_count_match = (
        pattern.search(output) for pattern in (_HEADER, _ACCEPTING, _COUNT)
    )
    if header is None or accepting is None or state_count_match is None:
        raise NoAutomatonError(f"it printed no automaton: {output.strip()[:200]!r}")
    proposition_numbers = [int(name.removeprefix("P")) for name in header[1].split()]
    state_count = int(state_count_match[1])
    printed_moves = _MOVE.findall(output)
    if len(printed_moves) > _MAX_MOVES:
        raise NoAutomatonError(f"the automaton has {state_count} states and more than {_MAX_MOVES} moves")
    cubes_by_state: list[list[_Cube]] = [[] for _ in range(state_count)]
    for state, symbol, target in printed_moves:
        letters = ["X"] * proposition_count
        for number, letter in zip(proposition_numbers, symbol, strict=True):
            letters[number] = letter
        cubes_by_state[int(state)].append(_Cube("".join(letters), int(target)))
    if not all(cubes_by_state):
        raise NoAutomatonError("it printed an automaton without moves from some state")
    diagrams = Diagrams()
    moves = tuple(_node(diagrams, cubes_of_state, 0) for cubes_of_state in cubes_by_state)
    initial = cubes_by_state[0][0].target
    accepting_states = {int(number) for number in accepting[1].split()}
    return machine_of(
        diagrams, moves, [state in accepting_states for state in range(state_count)], moves[initial]
    )


def _node(diagrams: Diagrams, cubes: list[_Cube], variable: int) -> int:
    """Return the diagram of disjoint cubes that cover all symbols and agree before `variable`."""
    symbol, target = cubes[0]
    if len(cubes) == 1:
        return diagrams.leaf(target)
    false_cubes, true_cubes = (
        [cube for cube in cubes if cube.symbol[variable] != letter] for letter in ("1", "0")
    )
    if not false_cubes or not true_cubes:
        raise NoAutomatonError(f"it printed moves that leave {symbol!r} open")
    when_false = _node(diagrams, false_cubes, variable + 1)
    # equal lists of cubes share a node; otherwise each free variable would double the work
    when_true = when_false if false_cubes == true_cubes else _node(diagrams, true_cubes, variable + 1)
    return diagrams.decide(variable, when_false, when_true)


Obligation: TypeAlias = tuple[int, bool]
"""Number of a subformula that must hold at the next sample, and whether there must be a next sample."""


class Chain(NamedTuple):
    """Obligations in an order in which each obligation implies the next.

    The variables of a chain encode the number of failing members in binary, most significant bit first.

    Attributes:
        members: numbers of the obligations' subformulas.
        strong: whether there must be a next sample.
        first: first variable.
        bits: number of variables.
    """

    members: tuple[int, ...]
    strong: bool
    first: int
    bits: int


class Obligations:
    """The variables of obligations; a chain receives its variables when a member is first needed."""

    def __init__(self, diagrams: Diagrams, first: int, longer: Mapping[Obligation, int]) -> None:
        """Begin without obligations.

        Args:
            first: the first variable to allot.
            longer: `chains` of a skeleton.
        """
        self._diagrams = diagrams
        self._first_variable = first
        self._chains: list[Chain] = []
        self._members = _members(longer)
        self._chain_places: dict[Obligation, tuple[Chain, int]] = {}

    def diagram(self, obligation: Obligation) -> int:
        """Return the diagram of an obligation: true iff the obligation is met."""
        if obligation not in self._chain_places:
            self._begin(obligation)
        chain, member_index = self._chain_places[obligation]
        node = YES
        for bit in range(chain.bits):
            # failing members come first in a chain, so a member holds iff at most `member_index` members fail
            branches = (YES, node) if member_index >> bit & 1 else (node, NO)
            node = self._diagrams.decide(chain.first + chain.bits - 1 - bit, *branches)
        return node

    def chain(self, variable: int) -> Chain:
        """Return the chain that a variable belongs to."""
        return self._chains[variable - self._first_variable]

    def cases(self, chain: Chain, node: int) -> list[tuple[int, int]]:
        """Split a function into cases by the number of failing members of its first chain.

        Returns:
            Pairs (count, function) with ascending counts. A function applies if the number of failing
            members is at least the previous count and below its own count.
        """
        cases: list[tuple[int, int]] = []
        count_limit = 0
        for span, function in self._rests(chain, node, 0):
            count_limit += span
            if cases and cases[-1][1] == function:
                cases.pop()
            cases.append((count_limit, function))
        return cases

    def _rests(self, chain: Chain, node: int, bit: int) -> Iterator[tuple[int, int]]:
        """Yield pairs: the length of a range of counts, and the function that applies in this range."""
        if self._diagrams[node].variable >= chain.first + chain.bits:
            yield 1 << (chain.bits - bit), node
            return
        for branch in self._diagrams.branches(node, chain.first + bit):
            yield from self._rests(chain, branch, bit + 1)

    def _begin(self, obligation: Obligation) -> None:
        number, is_strong = obligation
        members = self._members.get(obligation, (number,))
        # the number of failing members is from 0 to len(members)
        bit_count = len(members).bit_length()
        chain = Chain(members, is_strong, self._first_variable + len(self._chains), bit_count)
        self._chains += [chain] * bit_count
        self._chain_places.update(
            {(member, is_strong): (chain, index) for index, member in enumerate(members)}
        )


def _members(longer: Mapping[Obligation, int]) -> dict[Obligation, tuple[int, ...]]:
    """Map each obligation of a chain to the members of its chain."""
    later_members = {(number, is_strong) for (_, is_strong), number in longer.items()}
    chains: dict[Obligation, tuple[int, ...]] = {}
    for first_member, is_strong in longer:
        if (first_member, is_strong) in later_members:
            continue
        members = [first_member]
        while (next_member := longer.get((members[-1], is_strong))) is not None and (
            next_member,
            is_strong,
        ) not in chains:
            members.append(next_member)
        # an until implies the until with a later deadline; a release implies the shorter release
        ordered_members = tuple(members if is_strong else reversed(members))
        chains.update({(member, is_strong): ordered_members for member in members})
    return chains


MAX_STATES = 5000
"""Maximum number of explored states, before equivalent states are merged."""

MAX_DECISIONS = 150_000
"""Maximum number of nodes in the decision diagrams."""


def machine_by_progression(
    skeleton: Skeleton,
    propositions: int,
    number: int | None = None,
    *,
    states: int = MAX_STATES,
    decisions: int = MAX_DECISIONS,
) -> Machine:
    """Compile a skeleton by progression.

    Args:
        propositions: number of propositions.
        number: number of the subformula to compile; None for the whole formula.
        states, decisions: maximum numbers of states and of decisions.

    Raises:
        NoAutomatonError: a maximum is exceeded, or decisions are nested too deeply.
    """
    root = skeleton.root if number is None else number
    try:
        return _Progression(skeleton, propositions, states, decisions).machine(root)
    except RecursionError:
        # diagrams are built recursively, once for each nested decision
        raise NoAutomatonError("the automaton takes decisions that are nested too deeply") from None


class _Progression:
    """The states of a skeleton, explored from its initial state."""

    def __init__(self, skeleton: Skeleton, propositions: int, max_states: int, max_decisions: int) -> None:
        self._skeleton = skeleton
        self._propositions = propositions
        self._max_states = max_states
        self._diagrams = Diagrams(max_decisions)
        self._obligations = Obligations(self._diagrams, propositions, skeleton.chains)
        self._conditions: dict[int, int] = {FALSE: NO, TRUE: YES}
        self._moves: dict[int, int] = {NO: NO, YES: YES}

    def machine(self, root: int) -> Machine:
        state_numbers: dict[int, int] = {}
        state_nodes: list[int] = []

        def number(node: int) -> int:
            if node not in state_numbers:
                if len(state_nodes) == self._max_states:
                    raise NoAutomatonError(f"the automaton takes more than {self._max_states} states")
                state_numbers[node] = len(state_nodes)
                state_nodes.append(node)
            return state_numbers[node]

        result_diagrams = Diagrams()
        copy = node_copier(self._diagrams, result_diagrams, self._propositions, number)
        start = copy(self._read(root))
        # the list grows while it is iterated: moves lead to new states
        moves = [copy(self._after(node)) for node in state_nodes]
        return machine_of(result_diagrams, moves, [self._accepts(node) for node in state_nodes], start)

    def _read(self, number: int) -> int:
        """Return a subformula's condition on the current sample, with obligations for the next sample."""
        if number not in self._conditions:
            self._conditions[number] = self._reading(number)
        return self._conditions[number]

    def _reading(self, number: int) -> int:
        diagrams = self._diagrams
        kind, first, second = self._skeleton.nodes[number]
        match kind:
            case "literal":
                variable = diagrams.variable(first)
                return variable if second else diagrams.complement(variable)
            case "and":
                return diagrams.both(self._read(first), self._read(second))
            case "or":
                return diagrams.either(self._read(first), self._read(second))
            case "X" | "WX":
                return self._obligations.diagram((first, kind == "X"))
            case "U":
                later_case = diagrams.both(self._read(first), self._obligations.diagram((number, True)))
                return diagrams.either(self._read(second), later_case)
            case "R":
                later_case = diagrams.either(self._read(first), self._obligations.diagram((number, False)))
                return diagrams.both(self._read(second), later_case)
        raise ValueError(kind)

    def _after(self, node: int) -> int:
        """Return the diagram that maps propositions to the next state after the state `node`."""
        if node not in self._moves:
            chain = self._obligations.chain(self._diagrams[node].variable)
            *cases, (_, function) = self._obligations.cases(chain, node)
            result = self._after(function)
            for count_limit, function in reversed(cases):
                condition = self._read(chain.members[count_limit - 1])
                result = self._diagrams.choose(condition, self._after(function), result)
            self._moves[node] = result
        return self._moves[node]

    def _accepts(self, node: int) -> bool:
        """Return whether a run that ends in a state satisfies the formula."""
        while node not in (NO, YES):
            variable, if_false, if_true = self._diagrams[node]
            # at the end of a run, strong obligations fail and weak obligations hold
            node = if_true if self._obligations.chain(variable).strong else if_false
        return node == YES


MAX_PAIRS = 400_000
"""Maximum number of visited pairs of decisions in a product of two automata."""

MAX_PRODUCT = 50_000
"""Maximum number of states of a product, before equivalent states are merged."""

_FEW_STATES, _FEW_DECISIONS = 1_000, 20_000
"""Limits of an automaton that is compiled as a whole; larger automata are compiled operand by operand."""


def machine_by_composition(skeleton: Skeleton, propositions: int) -> Machine:
    """Compile a skeleton as a whole if it is small, and else operand by operand.

    Args:
        propositions: number of propositions.

    Raises:
        NoAutomatonError: the machine exceeds the limit of explored states or decisions.
    """
    return _Composition(skeleton, propositions).machine(skeleton.root)


class _Composition:
    """The automata of subformulas of a skeleton."""

    def __init__(self, skeleton: Skeleton, propositions: int) -> None:
        self._skeleton = skeleton
        self._propositions = propositions
        self._machines: dict[int, Machine] = {}

    def machine(self, number: int) -> Machine:
        """Return the automaton of a subformula."""
        if number not in self._machines:
            self._machines[number] = self._compile(number)
        return self._machines[number]

    def _compile(self, number: int) -> Machine:
        try:
            return self._progress(number, _FEW_STATES, _FEW_DECISIONS)
        except NoAutomatonError:
            kind, operands = self._skeleton.split(number)
        if len(operands) > 1:
            try:
                return self._join(operands, kind == "and")
            except NoAutomatonError:
                # an operand or a product was too large; the whole formula may still be small enough
                pass
        return self._progress(number, MAX_STATES, MAX_DECISIONS)

    def _progress(self, number: int, max_states: int, max_decisions: int) -> Machine:
        return machine_by_progression(
            self._skeleton, self._propositions, number, states=max_states, decisions=max_decisions
        )

    def _join(self, operands: tuple[int, ...], is_conjunction: bool) -> Machine:
        machines = [merge_equivalent_states(self.machine(operand)) for operand in operands]
        size_heap = [(machine.size, number) for number, machine in enumerate(machines)]
        heapify(size_heap)
        # the two smallest machines first: a product may be as large as the product of both sizes
        while len(size_heap) > 1:
            smallest, next_smallest = (machines[heappop(size_heap)[1]] for _ in range(2))
            machines.append(merge_equivalent_states(join_machines(smallest, next_smallest, is_conjunction)))
            heappush(size_heap, (machines[-1].size, len(machines) - 1))
        return machines[-1]


def join_machines(first: Machine, second: Machine, both: bool) -> Machine:
    """Return the product of two machines.

    The product accepts the intersection of their runs if `both`, else the union.

    Args:
        first, second: machines without equivalent states.

    Raises:
        NoAutomatonError: the product exceeds `MAX_PAIRS` or `MAX_PRODUCT`.
    """
    return _Joining(first, second, both).machine()


class _Joining:
    """The visited pairs of places of two machines."""

    def __init__(self, first: Machine, second: Machine, is_conjunction: bool) -> None:
        self._machines = first, second
        self._is_conjunction = is_conjunction
        self._left_rows, self._right_rows = first.decisions.tolist(), second.decisions.tolist()
        # a trap decides a conjunction, and a permanently accepting state decides a disjunction
        self._deciding_places = (
            _permanent_states(first, not is_conjunction),
            _permanent_states(second, not is_conjunction),
        )
        self._decision_rows: list[tuple[int, int, int]] = []
        self._places: dict[tuple[int, int], int] = {}
        self._state_numbers: dict[tuple[int, int], int] = {}
        self._pairs: list[tuple[int, int]] = []

    def machine(self) -> Machine:
        first, second = self._machines
        left_moves, right_moves = first.moves.tolist(), second.moves.tolist()
        start = self._place(first.start, second.start)
        # the list grows while it is iterated: moves lead to new pairs
        moves = [
            ~state if left_state < 0 else self._place(left_moves[left_state], right_moves[right_state])
            for state, (left_state, right_state) in enumerate(self._pairs)
        ]
        join = np.logical_and if self._is_conjunction else np.logical_or
        state_pairs = np.array(self._pairs, np.int64)
        accepting = join(first.accepting[state_pairs[:, 0]], second.accepting[state_pairs[:, 1]])
        # a decided pair is rejected by an intersection, and accepted by a union
        accepting[state_pairs[:, 0] < 0] = not self._is_conjunction
        decision_rows = np.array(self._decision_rows, np.int64).reshape(-1, 3)
        return Machine(np.array(moves, np.int64), decision_rows, accepting, start)

    def _place(self, left_place: int, right_place: int) -> int:
        if left_place in self._deciding_places[0] or right_place in self._deciding_places[1]:
            return self._state(-1, -1)
        if left_place < 0 and right_place < 0:
            return self._state(~left_place, ~right_place)
        place = self._places.get((left_place, right_place))
        if place is None:
            place = self._places[left_place, right_place] = self._decision(left_place, right_place)
            if len(self._places) > MAX_PAIRS:
                raise NoAutomatonError(f"joining its operands takes more than {MAX_PAIRS} steps")
        return place

    def _decision(self, left_place: int, right_place: int) -> int:
        left_variable, left_low, left_high = (
            self._left_rows[left_place] if left_place >= 0 else (LEAF, left_place, left_place)
        )
        right_variable, right_low, right_high = (
            self._right_rows[right_place] if right_place >= 0 else (LEAF, right_place, right_place)
        )
        if left_variable < right_variable:
            right_low = right_high = right_place
        elif right_variable < left_variable:
            left_low = left_high = left_place
        when_false, when_true = self._place(left_low, right_low), self._place(left_high, right_high)
        if when_false == when_true:
            return when_false
        self._decision_rows.append((min(left_variable, right_variable), when_false, when_true))
        return len(self._decision_rows) - 1

    def _state(self, left_state: int, right_state: int) -> int:
        """Return the place of a pair of states; (-1, -1) stands for all pairs with a deciding state."""
        state = self._state_numbers.get((left_state, right_state))
        if state is None:
            state = self._state_numbers[left_state, right_state] = len(self._pairs)
            if state >= MAX_PRODUCT:
                raise NoAutomatonError(f"joining its operands takes more than {MAX_PRODUCT} states")
            self._pairs.append((left_state, right_state))
        return ~state


def _permanent_states(machine: Machine, accepts: bool) -> frozenset[int]:
    """Return the places of states that accept permanently if `accepts`, else that reject permanently."""
    is_permanent = machine.moves == ~np.arange(len(machine.moves))
    return frozenset((~np.flatnonzero(is_permanent & (machine.accepting == accepts))).tolist())


_VERSION = 1
"""Version of the format of stored automata."""
_LONGEST = 16 * 2**20
"""Maximum size of a stored automaton, bytes."""


def stored_text(automaton: Automaton, specification: Specification, spec: NamedSpec) -> str:
    """Return an automaton as JSON, with the formula from which it was compiled."""
    return json.dumps(
        {
            "version": _VERSION,
            "specification": _canonical(specification, spec),
            "propositions": [proposition.text for proposition in automaton.propositions],
            "accepting": sorted(automaton.accepting),
            "entries": automaton.entries,
            "decisions": automaton.decisions,
        },
        ensure_ascii=False,
        separators=(",", ":"),
    )


def automaton_from(data: bytes, specification: Specification, spec: NamedSpec) -> Automaton | None:
    """Read the automaton of a spec from JSON; None if the JSON is invalid or is for another formula."""
    if len(data) > _LONGEST:
        return None
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or content.get("version") != _VERSION:
        return None
    propositions = Propositions(spec.formula).all
    expected_texts = (_canonical(specification, spec), [proposition.text for proposition in propositions])
    if (content.get("specification"), content.get("propositions")) != expected_texts:
        return None
    entries, accepting = _numbers(content.get("entries")), _numbers(content.get("accepting"))
    decisions = _decisions(content.get("decisions"))
    if entries is None or accepting is None or decisions is None or len(propositions) > MAX_PROPOSITIONS:
        return None
    automaton = Automaton(spec.name, tuple(propositions), frozenset(accepting), tuple(entries), decisions)
    # kernels follow places without checks, so a damaged file must not reach them
    return automaton if _is_sound(automaton) else None


def _canonical(specification: Specification, spec: NamedSpec) -> str:
    return f"use {specification.profile}\n{format_formula(spec.formula)}"


def _numbers(value: object) -> list[int] | None:
    if (
        not isinstance(value, list)
        or len(value) > MAX_ROWS
        # bool is a subclass of int, and is refused
        or any(type(number) is not int for number in value)
    ):
        return None
    return value


def _decisions(value: object) -> tuple[tuple[int, int, int], ...] | None:
    if not isinstance(value, list) or len(value) > MAX_ROWS:
        return None
    rows = [_numbers(row) for row in value]
    return tuple((row[0], row[1], row[2]) for row in rows if row is not None and len(row) == 3)


def _is_sound(automaton: Automaton) -> bool:
    """Return whether every decision leads to decisions on later propositions, and finally to valid states."""
    decision_rows, state_count, proposition_count = (
        automaton.decisions,
        len(automaton.entries),
        len(automaton.propositions),
    )

    def leads(place: int, row_index: int, last_proposition: int) -> bool:
        return (
            ~place < state_count
            if place < 0
            else place < row_index and decision_rows[place][0] > last_proposition
        )

    return (
        state_count > 0
        and all(0 <= state < state_count for state in automaton.accepting)
        and all(leads(place, len(decision_rows), -1) for place in automaton.entries)
        and all(
            0 <= proposition < proposition_count
            and leads(low, row_index, proposition)
            and leads(high, row_index, proposition)
            for row_index, (proposition, low, high) in enumerate(decision_rows)
        )
    )


Compiler: TypeAlias = Literal["own", "mona"]
"""This package, or MONA."""

_NAMES: MappingProxyType[Compiler, str] = MappingProxyType({"own": "this package", "mona": "MONA"})


@named_arguments
def automaton(
    specification: Specification,
    name: str | None = None,
    *,
    rate_hz: float | None = None,
    compiler: Compiler | None = None,
    stored: Iterable[bytes] = (),
) -> Automaton:
    """Return the automaton of a spec, which decides sample by sample whether a run satisfies the spec.

    The automaton accepts every fully observed run with a robustness above 0. It accepts no run with a
    robustness below 0.

    Args:
        name: name of the spec; None for the only result of the file.
        rate_hz: sampling rate, which converts bounds in seconds into bounds in samples. The result is valid
            only for runs of this rate.
        compiler: "own" for this package, or "mona"; both compilers give equal automata. With None, MONA is
            tried only if the formula exceeds this package's limits.
        stored: contents of automaton files. A stored automaton of this spec replaces a call of MONA, unless
            the spec has bounds in seconds.

    Raises:
        NoAutomatonError: the formula has past operators, has bounds in seconds without a rate, or is too
            large.
        UsageError: no specification, no such spec, several results without `name`, no such compiler, or a
            rate that is not above 0.
    """
    require_specification(specification)
    if compiler is not None and compiler not in get_args(Compiler):
        raise UsageError(f"no compiler {compiler!r}; there are 'own' and 'mona'")
    if rate_hz is not None and not (isinstance(rate_hz, (int, float)) and 0.0 < rate_hz < math.inf):
        raise UsageError(f"a rate of {rate_hz!r} Hz; give samples a second, above 0")
    spec = chosen_spec(specification, name)
    if counts_seconds(spec.formula):
        # a stored automaton does not name the rate that turned its seconds into samples, so it is not used
        stored = ()
    source = SourceText.of(specification.source, specification.filename) if specification.source else None
    propositions = Propositions(spec.formula)
    skeleton = Skeleton(spec.formula, propositions, source, rate_hz)
    compilers = get_args(Compiler) if compiler is None else (compiler,)
    try:
        return _compile_spec(spec, skeleton, propositions, compilers, _read(stored, specification, spec))
    except NoAutomatonError as error:
        raise no_automaton(spec, source, str(error)) from error


def _compile_spec(
    spec: NamedSpec,
    skeleton: Skeleton,
    propositions: Propositions,
    compilers: Sequence[Compiler],
    stored: Iterator[Automaton],
) -> Automaton:
    """Return the automaton of the first compiler that succeeds; a stored automaton replaces a call of MONA.

    Raises:
        NoAutomatonError: no compiler succeeds; the message has the reason of each compiler.
    """
    proposition_count = len(propositions.all)
    if proposition_count > MAX_PROPOSITIONS:
        raise NoAutomatonError(
            f"it has {proposition_count} propositions, an automaton at most {MAX_PROPOSITIONS}"
        )
    reasons = []
    for compiler in compilers:
        if compiler == "mona" and (stored_automaton := next(stored, None)) is not None:
            return stored_automaton
        try:
            if compiler == "own":
                machine = _compose_least(_Shape.of(skeleton, proposition_count))
            else:
                machine = least(compiled_by_mona(skeleton, proposition_count))
        except NoAutomatonError as error:
            reasons.append(f"{_NAMES[compiler]}: {error}")
        else:
            return _check_size(automaton_of(machine, spec.name, propositions.all))
    raise NoAutomatonError("; ".join(reasons))


@dataclass(frozen=True, slots=True)
class _Shape:
    """The key of a cached machine: a skeleton without the meaning of its propositions."""

    nodes: tuple[Node, ...]
    root: int
    chains: frozenset[tuple[tuple[int, bool], int]]
    propositions: int
    # comparisons leave out the skeleton, because the other fields determine it
    skeleton: Skeleton = field(compare=False, repr=False)

    @classmethod
    def of(cls, skeleton: Skeleton, propositions: int) -> _Shape:
        chains = frozenset(skeleton.chains.items())
        return cls(tuple(skeleton.nodes), skeleton.root, chains, propositions, skeleton)


# cached, because a formula that differs only in a threshold has the same machine
@lru_cache(maxsize=16)
def _compose_least(shape: _Shape) -> Machine:
    """Return the least machine of a shape, by this package.

    Raises:
        NoAutomatonError: the machine exceeds the limit of explored states or decisions.
    """
    return least(machine_by_composition(shape.skeleton, shape.propositions))


def _read(stored: Iterable[bytes], specification: Specification, spec: NamedSpec) -> Iterator[Automaton]:
    """Yield the stored automata of a spec, read on demand."""
    for data in stored:
        automaton = automaton_from(data, specification, spec)
        if automaton is not None:
            yield automaton


def _check_size(automaton: Automaton) -> Automaton:
    """Refuse an automaton with too many states or decisions.

    Raises:
        NoAutomatonError: the automaton has more than `MAX_ROWS` states or decisions.
    """
    row_count = max(len(automaton.entries), len(automaton.decisions))
    if row_count > MAX_ROWS:
        raise NoAutomatonError(f"it takes {row_count} states or decisions, at most {MAX_ROWS} are kept")
    return automaton


def chosen_spec(specification: Specification, name: str | None) -> NamedSpec:
    """Return the spec with a name; without a name, the only result of the specification.

    Raises:
        UsageError: no such spec, or several results without a name.
    """
    specs_by_name = {spec.name: spec for spec in specification.specs}
    if name is None:
        if len(specification.results) != 1:
            result_names = ", ".join(spec.name for spec in specification.results)
            raise UsageError(
                f"{specification.filename} has several results; choose one with name=: {result_names}"
            )
        return specification.results[0]
    if name not in specs_by_name:
        hint = nearest_hint(name, specs_by_name)
        remedy = f"{f'{hint} ' if hint else ''}there are {', '.join(specs_by_name)}"
        raise UsageError(f"no spec {name!r} in {specification.filename}; {remedy}")
    return specs_by_name[name]

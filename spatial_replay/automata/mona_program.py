"""Formulas in the language of MONA, into which ltlf2dfa translates LTLf; the only importer of ltlf2dfa."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from types import MappingProxyType
from typing import Protocol

from spatial_replay.automata.skeleton import Kind, Node, Skeleton
from spatial_replay.errors import NoAutomatonError

_MAX_DEPTH = 220
"""How many operators may stand within one another: ltlf2dfa recurses, and fails beyond 243."""
_MAX_SIZE = 20_000
"""How many subformulas are translated, each as often as it is written: about two seconds of work."""

_SIGNS: MappingProxyType[Kind, str] = MappingProxyType({"and": "&", "or": "|", "U": "U", "R": "R"})


def require_translatable(skeleton: Skeleton) -> None:
    """That a formula is small enough for ltlf2dfa.

    Raises:
        NoAutomatonError: it is not.
    """
    depth, size = _depth_and_size(skeleton)
    if depth > _MAX_DEPTH:
        raise NoAutomatonError(
            f"with its bounds unrolled the formula nests {depth} deep, at most {_MAX_DEPTH} can be translated"
        )
    if size > _MAX_SIZE:
        raise NoAutomatonError(
            f"with its bounds unrolled the formula has more than {_MAX_SIZE} subformulas to translate"
        )


def mona_program(skeleton: Skeleton) -> str:
    """The program whose automaton accepts the runs that satisfy a formula that is small enough.

    Proposition 3 is the set `P3`; one that the formula does not depend on is left out.
    """
    # a thread of its own has the whole depth of recursion left, however deep its caller is
    with ThreadPoolExecutor(max_workers=1) as thread:
        return thread.submit(_translated, skeleton).result()


def _depth_and_size(skeleton: Skeleton) -> tuple[int, int]:
    """How many operators stand within one another, and how many subformulas its program is made of."""
    depths: list[int] = []
    sizes: list[int] = []
    for node in skeleton.nodes:
        operands = _operands(node)
        depths.append(1 + max((depths[each] for each in operands), default=-1))
        sizes.append(1 + sum(sizes[each] for each in operands))
    return depths[skeleton.root], sizes[skeleton.root]


def _operands(node: Node) -> tuple[int, ...]:
    """Their numbers, each as often as it stands in a program."""
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
    """A subformula as ltlf2dfa reads LTLf: propositions are `p0`, `p1` …, operands in brackets."""
    kind, first, second = nodes[number]
    match kind:
        case "false" | "true":
            return kind
        case "literal":
            return f"p{first}" if second else f"!(p{first})"
        case "X" | "WX":
            return f"{kind}({_text(nodes, first)})"
    return f"({_text(nodes, first)}) {_SIGNS[kind]} ({_text(nodes, second)})"


class _Parser(Protocol):
    def __call__(self, text: str) -> object: ...


@cache
def _parser() -> _Parser:
    """The parser of LTLf, which takes longer to make than to use."""
    from ltlf2dfa.parser.ltlf import LTLfParser

    parser: _Parser = LTLfParser()
    return parser

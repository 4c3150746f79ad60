"""The way to MONA of another library: formulas as LTLf, which has no windows, translated by ltlf2dfa."""

from __future__ import annotations

from ltlf2dfa.base import MonaProgram
from ltlf2dfa.parser.ltlf import LTLfParser

from spatial_replay.automata.automaton import Automaton, automaton_of
from spatial_replay.automata.machine import least
from spatial_replay.automata.mona import machine_of
from spatial_replay.automata.propositions import Propositions
from spatial_replay.automata.skeleton import Skeleton
from spatial_replay.spec.formula import NamedSpec

_SIGNS = {"and": "&", "or": "|", "U": "U", "R": "R"}
_parse = LTLfParser()


def automaton_by_ltlf2dfa(spec: NamedSpec) -> Automaton:
    """The automaton of MONA's answer to the program that ltlf2dfa writes."""
    propositions = Propositions(spec.formula)
    program = MonaProgram(_parse(_text(Skeleton(spec.formula, propositions)))).mona_program()
    machine = machine_of(program, len(propositions.all))
    return automaton_of(least(machine), spec.name, propositions.all)


def _text(skeleton: Skeleton) -> str:
    """The whole formula, bounds unrolled, every operand in brackets."""
    texts: list[str] = []
    for kind, first, second in skeleton.nodes:
        match kind:
            case "true" | "false":
                texts.append(kind)
            case "literal":
                texts.append(f"p{first}" if second else f"!(p{first})")
            case "X" | "WX":
                texts.append(f"{kind}({texts[first]})")
            case _:
                texts.append(f"({texts[first]}) {_SIGNS[kind]} ({texts[second]})")
    return texts[skeleton.root]

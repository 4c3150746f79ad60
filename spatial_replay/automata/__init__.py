"""Specifications as automata: which runs satisfy them, and what must still happen or be avoided.

`spatial_replay.automaton` compiles an automaton; this package has its types, texts and drawings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import lazy_attributes

if TYPE_CHECKING:
    from spatial_replay.automata.automaton import TransitionTable, words_text
    from spatial_replay.automata.compile import Compiler, automaton_from, chosen_spec, stored_text
    from spatial_replay.automata.drawing import svg_text
    from spatial_replay.automata.guards import Transition

__all__ = [
    "Compiler",
    "Transition",
    "TransitionTable",
    "automaton_from",
    "chosen_spec",
    "stored_text",
    "svg_text",
    "words_text",
]

__getattr__, __dir__ = lazy_attributes(globals())

"""Formulas in the language of MONA: monadic second-order logic over the positions of a string.

The positions are the samples of a run, and each proposition is the set of those in which it is true. Windows
of samples are compared as numbers, so that a bound adds a constant to the text, however large it is.
"""

from __future__ import annotations

from typing import NamedTuple

from spatial_replay.automata.propositions import Propositions, is_spatial
from spatial_replay.spec.formula import Boolean, Bound, Formula, Temporal, Truth

_ALWAYS = Bound(0, None, "samples")


def mona_program(formula: Formula, propositions: Propositions) -> str:
    """The program whose automaton accepts the runs that satisfy a formula without past operators.

    Proposition 3 is the set `P3`. Positions are those of a string (`m2l-str`), so quantifiers range over
    samples.
    """
    sets = ", ".join(f"P{number}" for number in range(len(propositions.all)))
    declared = f"var2 {sets};\n" if sets else ""
    return f"m2l-str;\n{declared}{_Writer(propositions).text(formula, _Position('', 0))};\n"


class _Position(NamedTuple):
    """A sample, so many after the one that a variable stands for or, without a variable, after the first."""

    variable: str
    after: int

    def __str__(self) -> str:
        if not self.variable:
            return str(self.after)
        return f"{self.variable}+{self.after}" if self.after else self.variable

    def later(self, samples: int) -> _Position:
        return _Position(self.variable, self.after + samples)


class _Writer:
    """Writes formulas with variables of their own."""

    def __init__(self, propositions: Propositions) -> None:
        self._propositions = propositions
        self._variables = 0

    def text(self, formula: Formula, at: _Position) -> str:
        """That a formula holds at a position, in brackets."""
        if isinstance(formula, Truth):
            return "true" if formula.value else "false"
        if is_spatial(formula):
            number, value = self._propositions.literal(formula)
            return f"({at} in P{number})" if value else f"({at} notin P{number})"
        if isinstance(formula, Boolean):
            return self._boolean(formula, at)
        if isinstance(formula, Temporal):
            return self._temporal(formula, at)
        raise ValueError(f"{formula!r} is no formula")

    def _boolean(self, formula: Boolean, at: _Position) -> str:
        operands = [self.text(operand, at) for operand in formula.operands]
        match formula.operator:
            case "not":
                return f"~{operands[0]}"
            case "spec":
                return operands[0]
            case "xor":
                return f"~({' <=> '.join(operands)})"
        written = {"and": " & ", "or": " | ", "->": " => ", "<->": " <=> "}[formula.operator]
        return f"({written.join(operands)})"

    def _temporal(self, formula: Temporal, at: _Position) -> str:
        first, last = formula.operands[0], formula.operands[-1]
        bound = formula.bound or _ALWAYS
        match formula.operator:
            case "X":
                return f"({at.later(1)} in $ & {self.text(first, at.later(1))})"
            case "WX":
                return f"({at.later(1)} in $ => {self.text(first, at.later(1))})"
            case "F":
                return self._eventually(last, at, bound)
            case "G":
                return self._always(last, at, bound)
            case "U":
                return self._eventually(last, at, bound, until=first)
            case "R":
                return self._always(last, at, bound, unless=first)
            case "W":
                until = self._eventually(last, at, bound, until=first)
                return f"({until} | {self._always(first, at, bound)})"
        raise ValueError(f"{formula.operator} looks back")

    def _eventually(self, formula: Formula, at: _Position, bound: Bound, until: Formula | None = None) -> str:
        """That a formula holds somewhere in a window, and up to there another."""
        here = self._variable()
        text = f"{_within(here, at, bound)} & {self.text(formula, here)}"
        if until is not None:
            before = self._variable()
            text += f" & (all1 {before}: {at}<={before} & {before}<{here} => {self.text(until, before)})"
        return f"(ex1 {here}: {text})"

    def _always(self, formula: Formula, at: _Position, bound: Bound, unless: Formula | None = None) -> str:
        """That a formula holds everywhere in a window, or up to where another does."""
        here = self._variable()
        text = self.text(formula, here)
        if unless is not None:
            before = self._variable()
            text += f" | (ex1 {before}: {at}<={before} & {before}<{here} & {self.text(unless, before)})"
        return f"(all1 {here}: {_within(here, at, bound)} => {text})"

    def _variable(self) -> _Position:
        self._variables += 1
        return _Position(f"t{self._variables}", 0)


def _within(here: _Position, at: _Position, bound: Bound) -> str:
    """That a position lies in the window that begins at another."""
    text = f"{at.later(bound.lower)}<={here}"
    return text if bound.upper is None else f"{text} & {here}<={at.later(bound.upper)}"

"""A spec as automata: its own, or those of looser readings that still decide a part of the questions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compile import automaton
from spatial_replay.errors import NoAutomatonError
from spatial_replay.sanity.shortest_words import Runs, Side
from spatial_replay.spec.formula import (
    PAST_OPERATORS,
    Boolean,
    Formula,
    NamedSpec,
    Specification,
    Temporal,
    Truth,
    expand,
)
from spatial_replay.spec.walks import iter_formulas


@dataclass(frozen=True)
class SpecReading:
    """The runs that satisfy a formula, and those that violate it, or more runs where it has no automaton.

    Attributes:
        satisfying, violating: None where not even a looser reading has an automaton.
        reason: why a part of the formula has none; "" if all have.
    """

    satisfying: Runs | None
    violating: Runs | None
    reason: str = ""


def reading_of(specification: Specification, name: str, formula: Formula) -> SpecReading:
    """Return the automata that decide on a formula: one for each of the parts that have to hold together.

    Operators without an automaton are relaxed: a bounded `F` loses its bound, a past operator may hold or
    not. Runs are only ever added, so that what the looser reading excludes is excluded.
    """
    reasons: list[str] = []
    satisfying: list[Side] = []
    violating: list[Side | None] = []
    for part in conjuncts(formula):
        try:
            own = automaton_of(specification, name, part)
        except NoAutomatonError as error:
            reasons.append(error.reason)
            looser = _loosely(specification, name, part, positive=True)
            satisfying += [] if looser is None else [looser]
            violating.append(_loosely(specification, name, part, positive=False))
        else:
            satisfying.append(Side(own))
            violating.append(Side(own, False))

    options = tuple((side,) for side in violating if side is not None)
    return SpecReading(
        (tuple(satisfying),) if satisfying else None,
        options if len(options) == len(violating) else None,
        reasons[0] if reasons else "",
    )


def conjuncts(formula: Formula) -> tuple[Formula, ...]:
    """Return formulas that hold together exactly where a formula does: `G (a and b)` is `(G a) and (G b)`."""
    match formula:
        case Boolean(operator="and" | "spec"):
            return tuple(part for each in formula.operands for part in conjuncts(each))
        case Temporal(operator="G"):
            parts = conjuncts(formula.operands[0])
            return tuple(
                # what holds from each sample on holds from each later one on
                part
                if formula.bound is None and isinstance(part, Temporal) and _is_always(part)
                else replace(formula, operands=(part,))
                for part in parts
            )
    return (formula,)


def _is_always(formula: Temporal) -> bool:
    return formula.operator == "G" and formula.bound is None


def automaton_of(specification: Specification, name: str, formula: Formula) -> Automaton:
    """Return the automaton of a formula in the words of a specification.

    Raises:
        NoAutomatonError: as `automaton`.
    """
    alone = replace(specification, specs=(NamedSpec(name, formula),), source="")
    return automaton(alone, name, compiler="own")


def _loosely(specification: Specification, name: str, formula: Formula, *, positive: bool) -> Side | None:
    wanted = formula if positive else Boolean("not", (formula,))
    for bounds in ("seconds", "all"):
        looser = loosened(wanted, bounds)
        if looser is wanted:
            # it has no automaton as it is
            continue
        try:
            return Side(automaton_of(specification, name, looser))
        except NoAutomatonError:
            continue
    return None


def loosened(
    formula: Formula, bounds: Literal["seconds", "all"] = "seconds", *, loose: bool = True
) -> Formula:
    """Return a formula without past operators and bounds that holds wherever the formula does.

    Args:
        bounds: drop those in seconds, or all.
        loose: otherwise, return one that holds at most where the formula does.
    """
    if not any(_is_obstacle(each, bounds) for each in iter_formulas(formula)):
        return formula
    formula = expand(formula)
    match formula:
        case Boolean(operator="not"):
            return replace(formula, operands=(loosened(formula.operands[0], bounds, loose=not loose),))
        case Boolean() | Temporal():
            if formula.operator in PAST_OPERATORS:
                return Truth(loose)
            operands = tuple(loosened(each, bounds, loose=loose) for each in formula.operands)
            if isinstance(formula, Boolean) or not _is_obstacle(formula, bounds):
                return replace(formula, operands=operands)
            # every window from here on holds this sample; others may be empty
            is_now = formula.bound is not None and formula.bound.lower == 0
            if (formula.operator == "G") == loose:
                return operands[-1] if is_now else Truth(loose)
            return replace(formula, operands=operands, bound=None)
    return formula


def _is_obstacle(formula: Formula, bounds: Literal["seconds", "all"]) -> bool:
    if not isinstance(formula, Temporal):
        return False
    bound = formula.bound
    is_bounded = bound is not None and (bounds == "all" or bound.unit == "ns")
    return formula.operator in PAST_OPERATORS or is_bounded

"""The units of a formula's numbers, and `scale`, which makes those of different units comparable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from spatial_replay.spec.format import format_number
from spatial_replay.spec.formula import (
    Atom,
    Equality,
    Expression,
    Formula,
    Measurement,
    Misalignment,
    Scale,
    Scaled,
    Signal,
)
from spatial_replay.spec.walks import iter_expressions, iter_formulas

LENGTHS = "lengths"
"""What `scale` calls the units of the footprints."""


@dataclass(frozen=True, slots=True)
class Unit:
    """The unit of an atom's number.

    Attributes:
        kind: a length, in the units of the footprints; a signal's; or none, of orientations.
        signal: the name of the signal, or None.
        divisor: what `scale` divides the number by, or None.
    """

    kind: Literal["length", "signal", "orientation"]
    signal: str | None = None
    divisor: float | None = None

    def __str__(self) -> str:
        name = {"length": LENGTHS, "orientation": "orientations"}.get(self.kind) or str(self.signal)
        return name if self.divisor is None else f"{name} / {format_number(self.divisor)}"


def units_of(formula: Formula) -> tuple[Unit, ...]:
    """Return the units of the atoms of a formula, each once, in the order of the text.

    `mode == 2` has none: it is infinite, and so never a number that a minimum returns.

    A minimum over atoms of one unit is a number of that unit. Over several it compares what may not be
    comparable, unless each of them is scaled: see `is_mixed`.
    """
    found: dict[Unit, None] = {}
    for each in iter_formulas(formula):
        if isinstance(each, Atom):
            found.update(dict.fromkeys(_units(each.expression)))
    return tuple(found)


def declared_unit(formula: Formula, declared: Mapping[str, str], *, is_scaled: bool = True) -> str:
    """Return the declared unit of a formula's number; "" where it has none, several, or none is declared.

    Args:
        declared: the units of signals by their names, that of lengths by "".
        is_scaled: whether the number is what `scale` made of it, which has no unit.
    """
    found = {
        ""
        if each.kind == "orientation" or (is_scaled and each.divisor is not None)
        else declared.get(each.signal or "", "")
        for each in units_of(formula)
    }
    return found.pop() if len(found) == 1 else ""


def is_mixed(units: Sequence[Unit]) -> bool:
    """Return whether numbers of these units should not be compared: several, and not all of them scaled."""
    return len(units) > 1 and any(unit.divisor is None and unit.kind != "orientation" for unit in units)


def units_text(units: Sequence[Unit]) -> str:
    """Return a sentence on the units of what a robustness is the least of; "" if it is one."""
    if len(units) < 2:
        return ""
    *others, last = map(str, units)
    what = "different units" if is_mixed(units) else "units made comparable"
    return f"Its robustness is the least of numbers in {what}: {', '.join(others)} and {last}."


def scaled(expression: Expression, scales: Sequence[Scale]) -> Expression:
    """Return what an atom computes, divided if there is a scale for the one unit of what it measures."""
    units = _units(expression)
    for scale in scales:
        kind: Literal["length", "signal"] = "length" if scale.signal is None else "signal"
        if units == [Unit(kind, scale.signal)]:
            return Scaled(expression, scale.divisor)
    return expression


def _units(expression: Expression) -> list[Unit]:
    divisor = expression.divisor if isinstance(expression, Scaled) else None
    found: dict[Unit, None] = {}
    parts = list(iter_expressions(expression))
    if any(isinstance(part, Equality) for part in parts):
        return []
    for part in parts:
        if isinstance(part, Signal):
            found[Unit("signal", part.name, divisor)] = None
        elif isinstance(part, Misalignment):
            found[Unit("orientation")] = None
        elif isinstance(part, Measurement):
            found[Unit("length", None, divisor)] = None
    return list(found)

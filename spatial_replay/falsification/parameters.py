"""What a search varies: parameters with ranges, and cases, which give each of them a value."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np

from spatial_replay.errors import UsageError

Case: TypeAlias = Mapping[str, float | None]
"""The value of each parameter by name; None where it is left out."""

Range: TypeAlias = tuple[float, float]

TENTHS: Final = 10
"""Parts of a range in which runs are counted."""
_DIGITS: Final = 6
"""Digits by which values of a range without a resolution of its own differ."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that is varied.

    Attributes:
        low, high: its range; `high` is infinite until the first run has ended, of times in a run.
        digits: decimals of its values, so that a value that is written is the same when it is read.
        rest: its value in a run in which nothing is varied; None if it is left out there.
        group: those of one group are brought to rest together.
        unit: "m", "rad", "s", or "".
        is_drawn: whether its values have no order, as seeds: they are drawn, not optimised.
    """

    name: str
    low: float
    high: float
    digits: int
    rest: float | None
    group: str
    unit: str = ""
    is_drawn: bool = False

    @classmethod
    def of_range(cls, name: str, low: float, high: float) -> Parameter:
        """Return the parameter of a simulation of one's own; at rest it is as near to 0 as its range allows.

        Raises:
            UsageError: the range is empty or not finite.
        """
        low, high = float(low), float(high)
        refuse_range(name, low, high)
        digits = max(0, _DIGITS - math.floor(math.log10(high - low)))
        return cls(name, low, high, digits, min(max(low, 0.0), high), name)

    def value_at(self, share: float) -> float:
        """Return the value at a share of the range, from 0 to 1."""
        value = round(self.low + share * (self.high - self.low), self.digits)
        # rounding may leave the range
        return min(max(value, self.low), self.high) + 0.0

    def tenth_of(self, value: float) -> int:
        """Return the tenth of the range that a value is in, from 0."""
        return min(TENTHS - 1, int(TENTHS * (value - self.low) / (self.high - self.low)))

    def text_of(self, value: float) -> str:
        """Return a value with its name and unit, with all digits that it has: fewer would be another case."""
        number = f"{value:.12g}"
        if self.unit == "s":
            return f"{self.name}@{number}s"
        return f"{self.name} {number} {self.unit}".rstrip()


def refuse_range(name: str, low: float, high: float) -> None:
    """Check a range.

    Raises:
        UsageError: it is empty or not finite.
    """
    for end in (low, high):
        if not math.isfinite(end):
            raise UsageError(f"--vary {name}: {end:g} is no end of a range; write a finite number")
    if low >= high:
        raise UsageError(f"--vary {name}: {low:g} to {high:g} is no range; write the lower end first")


@dataclass(frozen=True, slots=True)
class Space:
    """All that is varied."""

    parameters: tuple[Parameter, ...]

    @property
    def ordered(self) -> tuple[Parameter, ...]:
        """The parameters that an optimiser can descend along."""
        return tuple(each for each in self.parameters if not each.is_drawn)

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups: mishaps first, then numbers, then starts; not seeds, of which none is smaller."""
        places = sorted(self.ordered, key=lambda each: (each.unit != "s", each.rest is None))
        return tuple(dict.fromkeys(each.group for each in places))

    def at_rest(self, case: Case | None = None, group: str | None = None) -> dict[str, float | None]:
        """Return a case with one group at rest, or all of it."""
        return {
            each.name: each.rest if case is None or each.group == group else case[each.name]
            for each in self.parameters
        }

    def nearer(self, case: Case, group: str) -> dict[str, float | None] | None:
        """Return a case with a group half way to rest; None for one that is left out there, or is there."""
        values = dict(case)
        for each in self.parameters:
            value = case[each.name]
            if each.group == group:
                if each.rest is None or value is None:
                    return None
                values[each.name] = round((value + each.rest) / 2, each.digits)
        return None if values == dict(case) else values

    def case_at(self, shares: Iterable[float], drawn: Sequence[float]) -> dict[str, float | None]:
        """Return the case at shares of the ordered parameters' ranges, with values for the others."""
        coming, others = iter(shares), iter(drawn)
        return {
            each.name: next(others) if each.is_drawn else each.value_at(float(next(coming)))
            for each in self.parameters
        }

    def draw(self, random: np.random.Generator) -> list[float]:
        """Return values of the parameters that are drawn."""
        return [
            float(random.integers(int(each.low), int(each.high), endpoint=True))
            for each in self.parameters
            if each.is_drawn
        ]

    def ending_at(self, seconds: float) -> Space:
        """Return this space once it is known how long a run takes."""
        return Space(
            tuple(
                replace(each, high=round(seconds, each.digits)) if math.isinf(each.high) else each
                for each in self.parameters
            )
        )


def key_of(case: Case) -> str:
    """Return a text that is equal for equal cases."""
    return json.dumps(case, sort_keys=True)


def parse_range(text: str) -> tuple[str, str, str]:
    """Split `NAME=LOW:HIGH`.

    Raises:
        UsageError: it is not of this form.
    """
    name, _, span = (part.strip() for part in text.partition("="))
    low, _, high = (part.strip() for part in span.partition(":"))
    if not (name and low and high):
        raise UsageError(f"--vary: {text!r} is incomplete; write NAME=LOW:HIGH, such as noise=0:0.01")
    return name, low, high


def number_from(text: str, of: str) -> float:
    """Read a number.

    Raises:
        UsageError: it is none.
    """
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--vary {of}: {text!r} is not a number") from None

"""A run compared with an earlier one: what got worse, changed its verdict, or is gone."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from spatial_replay.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa

Key: TypeAlias = tuple[str, str, str, str, str | None]
"""Case, log, specification file, spec and object of a result."""
Change: TypeAlias = Literal["worse", "verdict", "gone", "better"]

_NUMBER: Final = re.compile(r"(?P<number>\d+(?:\.\d*)?|\.\d+)(?P<percent>%?)", re.ASCII)
_KEY: Final = ("case", "log", "file", "spec", "object")
_ORDER: Final = {"satisfied": 0, "unknown": 1, "violated": 2, None: 3}
"""Verdicts from good to bad; None is an error."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How much less robustness passes.

    Attributes:
        amount: a part of the baseline's number if it `is_relative`, else in units of robustness.
    """

    amount: float = 0.0
    is_relative: bool = False

    @classmethod
    def parse(cls, text: str) -> Tolerance:
        """Read `5%`, or an absolute number such as `0.02`.

        Raises:
            UsageError: anything else.
        """
        match = _NUMBER.fullmatch(text.strip())
        if match is None:
            raise UsageError(f"{text!r} is not a tolerance; write 5% or, in units of robustness, 0.02")
        number = float(match["number"])
        return cls(number / 100.0, True) if match["percent"] else cls(number)

    def allows(self, before: float, now: float) -> bool:
        """Return whether a number is not worse than before by more than this."""
        if math.isnan(before) or math.isnan(now):
            return math.isnan(before)
        if math.isinf(before) or math.isinf(now):
            return now >= before
        return now >= before - self.amount * (abs(before) if self.is_relative else 1.0)


@dataclass(frozen=True, slots=True)
class Difference:
    """One result that differs from the baseline.

    Attributes:
        change: "worse" by more than the tolerance, another "verdict" that is worse, "gone", or "better".
        case, log, file, spec, object: which result.
        before, now: its verdicts; None for an error, and for what is gone now.
        before_robustness, robustness: NaN where not determined.
    """

    change: Change
    case: str
    log: str
    file: str
    spec: str
    object: str | None
    before: str | None
    now: str | None
    before_robustness: float
    robustness: float

    @property
    def fails(self) -> bool:
        return self.change != "better"

    @property
    def text(self) -> str:
        """What changed, with both numbers, in one line."""
        name = self.spec if self.object is None else f"{self.spec}({self.object})"
        was = f"{self.before or 'an error'} with robustness {_shown(self.before_robustness)} in the baseline"
        if self.change == "gone":
            return f"{self.log}: {name} is gone; it was {was}"
        now = f"{self.now or 'an error'} with robustness {_shown(self.robustness)}"
        return f"{self.log}: {name} is {now}; it was {was}"


def compare(table: pa.Table, baseline: pa.Table, tolerance: Tolerance) -> list[Difference]:
    """Return the differences of a run from a baseline, in the baseline's order; new results are none.

    Results are the same if case, log, specification file, spec and object are.
    """
    return list(_differences(_by_key(table), _by_key(baseline), tolerance))


def _by_key(table: pa.Table) -> dict[Key, tuple[str | None, float]]:
    columns = [table.column(name).to_pylist() for name in _KEY]
    values = zip(table.column("verdict").to_pylist(), table.column("robustness").to_pylist(), strict=True)
    keys = zip(*columns, strict=True)
    return dict(zip(keys, values, strict=True))


def _differences(
    now: dict[Key, tuple[str | None, float]],
    before: dict[Key, tuple[str | None, float]],
    tolerance: Tolerance,
) -> Iterator[Difference]:
    for key, (old, old_number) in before.items():
        # an error in place of all objects of a template stands for each
        found = now.get(key) or now.get((*key[:-1], None))
        if found is None:
            yield Difference(
                "gone", *key, before=old, now=None, before_robustness=old_number, robustness=math.nan
            )
            continue
        new, number = found
        change: Change | None = None
        if new != old:
            change = "verdict" if _ORDER[new] > _ORDER[old] else "better"
        elif not tolerance.allows(old_number, number):
            change = "worse"
        if change is not None:
            yield Difference(
                change, *key, before=old, now=new, before_robustness=old_number, robustness=number
            )


def _shown(number: float) -> str:
    return "not determined" if math.isnan(number) else f"{number:.6g}"

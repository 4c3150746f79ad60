"""A run compared with an earlier one: what got worse, changed its verdict, or is gone."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from spatial_replay.batch.run_table import RANKS, WORSE, result_name
from spatial_replay.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa

Key: TypeAlias = tuple[str, str, str, str, str | None]
"""Case, log, specification file, spec and object of a result."""
Change: TypeAlias = Literal["worse", "verdict", "gone", "better"]

BASELINE_VERDICT: Final = "baseline_verdict"
BASELINE_ROBUSTNESS: Final = "baseline_robustness"
_NUMBER: Final = re.compile(
    r"(?P<number>(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d{1,3})?) ?(?P<unit>%|[^\W\d]\S{0,20})?"
)
_KEY: Final = ("case", "log", "file", "spec", "object")
_ORDER: Final = {"satisfied": 0, "unknown": 1, "violated": 2, None: 3}
"""Verdicts from good to bad; None is an error."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How much less robustness passes.

    Attributes:
        amount: a part of the baseline's number if it `is_relative`, else in units of robustness.
        unit: of the amount; "" for results without one.
    """

    amount: float = 0.0
    is_relative: bool = False
    unit: str = ""

    @classmethod
    def parse(cls, text: str) -> Tolerance:
        """Read `5%`, or an absolute number with the unit of the robustness, such as `0.02m`, if it has one.

        Raises:
            UsageError: anything else.
        """
        match = _NUMBER.fullmatch(text.strip())
        if match is None:
            raise UsageError(f"{text!r} is not a tolerance; write 5% or, in units of robustness, 0.02m")
        number = float(match["number"])
        unit = match["unit"] or ""
        return cls(number / 100.0, True) if unit == "%" else cls(number, unit=unit)

    def check(self, units: Iterable[str | None]) -> None:
        """Check that an absolute amount says which unit of the results it is in.

        Raises:
            UsageError: it has none, and results have one; or no result has its unit.
        """
        known = sorted({each for each in units if each and each != "1"})
        if self.is_relative or not self.amount or self.unit in known or not (known or self.unit):
            return
        found = f"is in {', '.join(known)}" if known else "has no unit"
        absolute = f"{self.amount:g}{known[0] if known else ''}"
        raise UsageError(
            f"--tolerance {self.amount:g}{self.unit}: robustness {found}; write {absolute}, or "
            f"{self.amount:g}% for a part of it"
        )

    def allows(self, before: float, now: float, unit: str = "") -> bool:
        """Return whether a number is not worse than before by more than this.

        Args:
            unit: of both; an amount in another unit allows nothing.
        """
        if math.isnan(before) or math.isnan(now):
            return math.isnan(before)
        if math.isinf(before) or math.isinf(now):
            return now >= before
        if self.is_relative:
            return now >= before - self.amount * abs(before)
        return now >= before - (self.amount if self.unit in ("", unit) else 0.0)


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
    def key(self) -> Key:
        """Which result it is."""
        return self.case, self.log, self.file, self.spec, self.object

    @property
    def text(self) -> str:
        """The change with both numbers, in one line."""
        return f"{self.log}: {result_name(self.spec, self.object)} is {self.failure} in the baseline"

    @property
    def failure(self) -> str:
        """The change with both numbers, in a few words."""
        now = "gone" if self.change == "gone" else _described(self.now, self.robustness)
        return f"{now}; it was {_described(self.before, self.before_robustness)}"


def compare(table: pa.Table, baseline: pa.Table, tolerance: Tolerance) -> list[Difference]:
    """Return the differences of a run from a baseline, the worst first; new results are none.

    Results are the same if case, log, specification file, spec and object are.

    Raises:
        UsageError: a tolerance without the unit that results have.
    """
    units = dict(zip(_keys(table), table.column("unit").to_pylist(), strict=True))
    tolerance.check(units.values())
    found = _differences(_by_key(table), _by_key(baseline), tolerance, units)
    return sorted(found, key=lambda each: (RANKS[each.now], _least_first(each.robustness)))


def edited_files(table: pa.Table, baseline: pa.Table) -> list[str]:
    """Return the specification files that mean something else than when the baseline was made."""
    before = set(zip(*(baseline.column(name).to_pylist() for name in ("file", "meaning")), strict=True))
    names = {file for file, _ in before}
    now = zip(*(table.column(name).to_pylist() for name in ("file", "meaning")), strict=True)
    return [file for file, meaning in dict.fromkeys(now) if file in names and (file, meaning) not in before]


def with_baseline(table: pa.Table, baseline: pa.Table, differences: Sequence[Difference]) -> pa.Table:
    """Return the table of a run in which what is worse than the baseline fails, and what is gone has a row.

    The columns `baseline_verdict` and `baseline_robustness` say what each result was, and
    `worse_than_baseline` whether it is worse now, or gone.

    Args:
        differences: see `compare`.
    """
    import pyarrow as pa

    before, keys = _by_key(baseline), _keys(table)
    worse: dict[Key, list[str]] = defaultdict(list)
    own, gone = set(keys), []
    for each in differences:
        if each.change == "gone":
            gone.append(each)
        elif each.fails:
            # an error in place of all objects of a template
            key = each.key if each.key in own else (*each.key[:-1], None)
            worse[key].append(f"worse than the baseline: {each.failure}")
    failures = [
        "; ".join(filter(None, [failure, *worse.get(key, ())])) or None
        for key, failure in zip(keys, table.column("failure").to_pylist(), strict=True)
    ]
    place = table.schema.get_field_index("failure")
    table = table.set_column(place, table.schema.field(place), pa.array(failures, pa.string()))
    was = [before.get(key, (None, None)) for key in keys]
    for name, kind, values in (
        (BASELINE_VERDICT, pa.string(), [verdict for verdict, _ in was]),
        (BASELINE_ROBUSTNESS, pa.float64(), [number for _, number in was]),
        (WORSE, pa.bool_(), [key in worse for key in keys]),
    ):
        table = table.append_column(name, pa.array(values, kind))
    places = {key: place for place, key in enumerate(_keys(baseline))} if gone else {}
    rows = baseline.take(pa.array([places[each.key] for each in gone], pa.int64())).to_pylist()
    missing = [_gone_row(row, each) for row, each in zip(rows, gone, strict=True)]
    return pa.concat_tables([table, pa.Table.from_pylist(missing, table.schema)])


def _gone_row(row: dict[str, Any], difference: Difference) -> dict[str, Any]:
    """Return the row of a result that only the baseline has, given its row there."""
    kept = ("key", *_KEY, "meaning", "requirement", "title", "line", "expected")
    nothing: dict[str, Any] = {
        name: [] for name in ("explanation", "untested", "vacuous", "faults", "remarks", "missing")
    }
    nothing |= dict.fromkeys(("robustness", "lower", "upper"), math.nan)
    return {
        **nothing,
        **{name: row.get(name) for name in kept},
        "failure": f"{difference.failure} in the baseline",
        "reason": "",
        "seconds": 0.0,
        BASELINE_VERDICT: difference.before,
        BASELINE_ROBUSTNESS: difference.before_robustness,
        WORSE: True,
    }


def _keys(table: pa.Table) -> list[Key]:
    return list(zip(*(table.column(name).to_pylist() for name in _KEY), strict=True))


def _by_key(table: pa.Table) -> dict[Key, tuple[str | None, float]]:
    values = zip(table.column("verdict").to_pylist(), table.column("robustness").to_pylist(), strict=True)
    return dict(zip(_keys(table), values, strict=True))


def _differences(
    now: dict[Key, tuple[str | None, float]],
    before: dict[Key, tuple[str | None, float]],
    tolerance: Tolerance,
    units: Mapping[Key, str | None],
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
        elif not tolerance.allows(old_number, number, units.get(key) or ""):
            change = "worse"
        if change is not None:
            yield Difference(
                change, *key, before=old, now=new, before_robustness=old_number, robustness=number
            )


def _least_first(number: float) -> float:
    return math.inf if math.isnan(number) else number


def _described(verdict: str | None, number: float) -> str:
    if verdict is None:
        return "an error"
    return f"{verdict} with robustness {'not determined' if math.isnan(number) else f'{number:.6g}'}"

"""Result of tuning: values with their ranges, the margin of every run, runs that conflict, and surfaces."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.lazy import Displayed
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec import parse_specification
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import constant_writer
from spatial_replay.text import counted, json_number
from spatial_replay.trace.units import require_same_units
from spatial_replay.tuning.margins import (
    Direction,
    LabelledRun,
    Margins,
    Point,
    Value,
    text_of_constant,
    varied_constants,
)
from spatial_replay.tuning.search import Found, Search

MOST_RUNS: Final = 10_000
MOST_SAMPLES: Final = 1 << 25
"""Bounds of what is held in memory: runs, and samples of all of them together."""
MOST_CONSTANTS: Final = 10
_MOST_NAMED: Final = 5
"""The most conflicting runs that a sentence names."""


@dataclass(frozen=True, slots=True)
class TunedConstant:
    """A constant with the value found for it.

    Attributes:
        value, written: the value found and the one in the text: a number, or a duration as a text.
        low, high: ends of the interval around it that fits every run, with the other constants as found. One
            step beyond either end, unless it ends the tried range, some run does not fit.
        tried: the range that was tried.
        step: the least difference of two values, or the seconds of it.
        direction: 1 if greater values are looser, -1 if they are tighter, None if neither is certain.
        is_decided: whether runs decide it; else no bad run keeps it from being looser, and it keeps the
            written value, or the nearest that fits.
    """

    name: str
    value: Value
    written: Value
    low: Value
    high: Value
    tried: tuple[Value, Value]
    step: float
    direction: Direction | None
    is_decided: bool = True


@dataclass(frozen=True, slots=True)
class RunMargin:
    """A run with the values found.

    Attributes:
        robustness: the least of all results, at its lower end if the run is good and its upper end if bad.
        margin: how far that is from the wrong verdict: negated for a bad run, negative if it is wrong.
    """

    name: str
    is_good: bool
    verdict: Verdict
    robustness: float
    margin: float


@dataclass(frozen=True, slots=True)
class Conflict:
    """Why no values were found.

    Attributes:
        runs: names of the runs that cannot all have the right verdict.
        message: what each of them needs, as far as that is known.
        is_proven: whether no values exist, rather than that none were found.
        alone: those of them that fit no values by themselves, whatever the others need.
    """

    runs: tuple[str, ...]
    message: str
    is_proven: bool
    alone: tuple[str, ...] = ()

    @property
    def sections(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Common and individual needs of the runs, runs without fitting values first."""
        needs = self.message.split("; ")
        count = min(len(self.alone), _MOST_NAMED) + (len(self.alone) > _MOST_NAMED)
        alone = "this one fits none by itself" if len(self.alone) == 1 else "these fit none by themselves"
        together = "these contradict each other" if len(self.runs) > 1 else "this one never fits"
        parts = ((alone, tuple(needs[:count])), (together, tuple(needs[count:])))
        return tuple(part for part in parts if part[1])


@dataclass(frozen=True, eq=False)
class Surface(Displayed):
    """The margin of every run over the values of one or two constants, the others as found.

    Attributes:
        names: of the constants, that along x first.
        x, y: (X,) and (Y,), their values, durations in seconds; y is (1,) of NaN for one constant.
        margins: (R, Y, X); -inf where the specification is invalid.
        runs: (R,) names of the runs, and whether each is good.
        found: the values found, or None.
        durations: for each constant, whether it is a duration.
    """

    names: tuple[str, ...]
    x: Floats
    y: Floats
    margins: Floats
    runs: tuple[tuple[str, bool], ...]
    found: tuple[float, ...] | None
    durations: tuple[bool, ...]

    @property
    def least(self) -> Floats:
        """(Y, X), the least margin of all runs."""
        least: Floats = self.margins.min(axis=0)
        return least


@dataclass(frozen=True, eq=False)
class Tuning(Displayed):
    """The values found for constants, or why there are none.

    Attributes:
        is_found: whether every run has the right verdict with these values.
        constants: the constants that were varied; if nothing was found, as far as the search came.
        margin: the least margin of all runs.
        runs: every run, in the order given.
        conflict: why nothing was found, or None.
        is_widest: whether other values are known to have no wider margin, or to be no tighter. False if the
            search ran out of evaluations, tried values of a constant without a direction, or kept a constant
            that no bad run decides.
        specification: the specification with the values, its comments and layout kept.
    """

    is_found: bool
    constants: tuple[TunedConstant, ...]
    margin: float
    runs: tuple[RunMargin, ...]
    conflict: Conflict | None
    is_widest: bool
    specification: Specification
    _margins: Margins = field(repr=False)
    _point: Point = field(repr=False)

    @property
    def values(self) -> dict[str, Value]:
        """The values by name, as `parse_specification` takes them."""
        return {constant.name: constant.value for constant in self.constants}

    def __repr__(self) -> str:
        if self.conflict is not None:
            return f"<Tuning: {self.conflict.message}>"
        values = ", ".join(f"{name} = {value}" for name, value in self.values.items())
        return f"<Tuning of {counted(len(self.runs), 'run')}: {values}; margin {self.margin:.6g}>"

    def surface(self, *names: str, points: int = 25) -> Surface:
        """Compute the margins over one or two constants; without names over the first two.

        Args:
            points: how many values of each constant.

        Raises:
            UsageError: a constant that was not varied, more than two, fewer than 2 points or more than 200.
        """
        known = [constant.name for constant in self.constants]
        chosen = names or tuple(known[:2])
        for name in chosen:
            if name not in known:
                hint = nearest_hint(name, known) or f"varied were: {', '.join(known)}"
                raise UsageError(f"{name!r} was not varied; {hint}")
        if len({*chosen}) != len(chosen) or len(chosen) > 2:
            raise UsageError(f"a surface is over one or two constants, not over {', '.join(chosen)}")
        if not 2 <= points <= 200:
            raise UsageError(f"points is {points}; give 2 to 200")
        axes = [known.index(name) for name in chosen]
        varied = [self._margins.varied[axis] for axis in axes]
        grids = [np.unique(np.linspace(0, each.steps, points).round().astype(np.int64)) for each in varied]
        rows = grids[1] if len(grids) > 1 else np.array([self._point[axes[0]]])
        margins = np.empty((len(self.runs), len(rows), len(grids[0])))
        for row, y in enumerate(rows.tolist()):
            for column, x in enumerate(grids[0].tolist()):
                moved = list(self._point)
                moved[axes[-1]] = y
                moved[axes[0]] = x
                margins[:, row, column] = [
                    self._margins.margin(run, tuple(moved)) for run in range(len(self.runs))
                ]
        values = [
            np.array([_number(each.decimal(number), each.written.duration_ns) for number in grid.tolist()])
            for each, grid in zip(varied, grids, strict=True)
        ]
        found = tuple(
            _number(each.decimal(self._point[axis]), each.written.duration_ns)
            for each, axis in zip(varied, axes, strict=True)
        )
        return Surface(
            chosen,
            values[0],
            values[1] if len(values) > 1 else np.full(1, np.nan),
            margins,
            tuple((run.name, run.is_good) for run in self.runs),
            found if self.is_found else None,
            tuple(each.written.duration_ns is not None for each in varied),
        )

    @property
    def document(self) -> dict[str, Any]:
        """This as values for JSON."""
        return {
            "found": self.is_found,
            "margin": json_number(self.margin),
            "widest": self.is_widest,
            "constants": [
                {
                    "name": each.name,
                    "value": each.value,
                    "written": each.written,
                    "low": each.low if self.is_found else None,
                    "high": each.high if self.is_found else None,
                    "tried": list(each.tried),
                    "step": each.step,
                    "direction": each.direction,
                    "decided": each.is_decided,
                }
                for each in self.constants
            ],
            "runs": [
                {
                    "name": run.name,
                    "good": run.is_good,
                    "verdict": run.verdict,
                    "robustness": json_number(run.robustness),
                    "margin": json_number(run.margin),
                }
                for run in self.runs
            ],
            "conflict": None
            if self.conflict is None
            else {
                "runs": list(self.conflict.runs),
                "message": self.conflict.message,
                "proven": self.conflict.is_proven,
                "alone": list(self.conflict.alone),
            },
        }


def tune_runs(
    specification: Specification,
    runs: Sequence[LabelledRun],
    ranges: Mapping[str, tuple[Value, Value] | None],
    *,
    each: Mapping[str, str] | None = None,
    seed: int = 0,
    advance: Callable[[int], None] = lambda runs: None,
) -> Tuning:
    """Find the constants with which all good runs are satisfied and all bad ones are violated.

    With bad runs those of the widest margin: the least of the good runs' robustness and the bad runs' negated
    one is the greatest. With good runs only the tightest ones: all are tightened together, in proportion to
    their ranges, and then one after the other. With bad runs, a constant that none of them keeps
    from being looser stays as written as far as that fits.

    Args:
        ranges: the values to try for each constant, by name; None takes the range in the text, and no ranges
            all constants that have one there.
        each: for each parameter of a template, the objects that it stands for.
        seed: of the search over several constants; the same seed finds the same values.
        advance: called with the number of runs that are prepared.

    Raises:
        UsageError: no good run, too many runs, a constant that cannot be tuned, a run that does not fit the
            specification, runs in other units.
    """
    _check(specification, runs)
    varied = varied_constants(specification, ranges)
    if len(varied) > MOST_CONSTANTS:
        raise UsageError(
            f"{len(varied)} constants are more than the {MOST_CONSTANTS} that are tuned together"
        )
    parse = partial(_with_values, specification, constant_writer(specification))
    margins = Margins(runs, parse, varied, each or {}, advance=advance)
    search = Search(margins, seed)
    found = search.best()
    kept = _kept(margins, search, found) if found.is_held else {}
    point = tuple(kept.get(axis, number) for axis, number in enumerate(found.point))
    is_widest = found.is_proven and point == found.point
    found = replace(found, point=point, is_proven=is_widest if found.is_held else found.is_proven)
    return _tuning(specification, margins, search, found, kept)


def _kept(margins: Margins, search: Search, found: Found) -> dict[int, int]:
    """Return the constants that no bad run decides, with the numbers of the values that they keep.

    The widest margin would loosen them as far as can be. Good runs alone find the tightest values.
    """
    kept: dict[int, int] = {}
    if all(run.is_good for run in margins.runs):
        return kept
    for axis, one in enumerate(margins.varied):
        point = tuple(kept.get(place, number) for place, number in enumerate(found.point))
        low, high = search.interval(point, axis)
        is_free = {1: high == one.steps, -1: low == 0}.get(margins.directions[axis] or 0, False)
        if (low, high) == (0, one.steps) or is_free:
            kept[axis] = min(max(one.start, low), high)
    return kept


def _check(specification: Specification, runs: Sequence[LabelledRun]) -> None:
    if specification.relations:
        names = ", ".join(sorted(specification.relations))
        raise UsageError(f"relations given in Python cannot be tuned ({names}); write them as def")
    if not any(run.is_good for run in runs):
        raise UsageError("there is no good run to satisfy; give at least one that did what it should")
    if len(runs) > MOST_RUNS:
        raise UsageError(f"{len(runs)} runs are more than {MOST_RUNS}; tune on some of them")
    samples = sum(len(run.trace) for run in runs)
    if samples > MOST_SAMPLES:
        raise UsageError(f"the runs have {samples} samples, more than {MOST_SAMPLES}; tune on some of them")
    for run in runs[1:]:
        require_same_units(runs[0].trace, run.trace, (runs[0].name, run.name))


def _with_values(
    specification: Specification, write: Callable[[Mapping[str, Value]], str], values: Mapping[str, Value]
) -> Specification:
    return parse_specification(write(values), filename=specification.filename, profile=specification.profile)


def _tuning(
    specification: Specification, margins: Margins, search: Search, found: Found, kept: Collection[int]
) -> Tuning:
    constants = []
    for axis, one in enumerate(margins.varied):
        number = found.point[axis]
        low, high = search.interval(found.point, axis) if found.is_held else (number, number)
        duration_ns = one.written.duration_ns
        constants.append(
            TunedConstant(
                one.name,
                one.value(number),
                one.written.value if duration_ns is None else text_of_constant(one.written),
                one.value(low),
                one.value(high),
                (one.value(0), one.value(one.steps)),
                _number(one.step, duration_ns),
                margins.directions[axis],
                axis not in kept,
            )
        )
    listed = []
    for number, run in enumerate(margins.runs):
        robustness = margins.robustness(number, found.point)
        lower, upper = (-np.inf, np.inf) if robustness is None else robustness
        listed.append(
            RunMargin(
                run.name,
                run.is_good,
                final_verdict(lower, upper),
                lower if run.is_good else upper,
                margins.margin(number, found.point),
            )
        )
    return Tuning(
        found.is_held,
        tuple(constants),
        min(run.margin for run in listed),
        tuple(listed),
        None if found.is_held else _conflict(margins, search, found),
        found.is_held and found.is_proven,
        margins.specification(found.point) or specification,
        margins,
        found.point,
    )


def _conflict(margins: Margins, search: Search, found: Found) -> Conflict:
    conflict = sorted(found.conflict, key=lambda run: (margins.margin(run, found.point), run))
    alone = [run for run in conflict if run in found.alone]
    others = [run for run in conflict if run not in found.alone]
    is_exact = len(margins.varied) == 1 and margins.directions[0] is not None
    parts: list[str] = []
    for runs in (alone, others):
        parts += [
            _needs(margins, search, run, is_exact=is_exact, is_alone=runs is alone)
            for run in runs[:_MOST_NAMED]
        ]
        if len(runs) > _MOST_NAMED:
            parts.append(f"and {counted(len(runs) - _MOST_NAMED, 'other run')} likewise")
    names = tuple(margins.runs[run].name for run in (*alone, *others))
    return Conflict(names, "; ".join(parts), found.is_proven, names[: len(alone)])


def _needs(margins: Margins, search: Search, run: int, *, is_exact: bool, is_alone: bool) -> str:
    """Say which values a run needs, in a part of a sentence."""
    one = margins.runs[run]
    what = "satisfied" if one.is_good else "violated"
    if not is_exact:
        if is_alone:
            return f"{one.name} is not {what} with any values tried"
        return f"{one.name} has to be {what}"
    constant, limit = margins.varied[0], search.limit(run)
    if limit is None:
        span = f"from {constant.text(0)} to {constant.text(constant.steps)}"
        return f"{one.name} is not {what} with any {constant.name} {span}"
    rises = (margins.directions[0] == 1) == one.is_good
    return f"{one.name} is {what} only with {constant.name} {'>=' if rises else '<='} {constant.text(limit)}"


def _number(value: Any, duration_ns: int | None) -> float:
    return float(value) if duration_ns is None else float(value) / 1e9

"""Results of a search: runs, failures with the worst first, and the coverage of parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from spatial_replay.falsification.simulations import TENTHS, Case, Parameter
from spatial_replay.lazy import Printed
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.text import counted, json_number, with_unit

_MOST_FAILURES: Final = 20
"""The most failures in the text; JSON has all."""


@dataclass(frozen=True, slots=True)
class SearchedRun:
    """A run that was simulated.

    Attributes:
        number: in the order of the search, from 1.
        case: the value of each parameter; None where it was left out.
        verdict: the worst of all specifications'.
        robustness: the least upper end of their intervals: below 0 if and only if one is violated.
        spec: whose that is.
        unit: of the robustness; "" if none is declared.
        seconds: how long the run took, in its own time.
    """

    number: int
    case: Case
    verdict: Verdict
    robustness: float
    spec: str
    unit: str
    seconds: float

    @property
    def is_violated(self) -> bool:
        """Whether a specification is violated."""
        return self.verdict is Verdict.VIOLATED

    def numbered(self, number: int) -> SearchedRun:
        """Return this run under another number."""
        return replace(self, number=number)

    @property
    def document(self) -> dict[str, Any]:
        """It as JSON."""
        return {
            "run": self.number,
            "case": dict(self.case),
            "verdict": str(self.verdict),
            "robustness": json_number(self.robustness),
            "spec": self.spec,
            "unit": self.unit,
            "seconds": self.seconds,
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> SearchedRun:
        """Return a run from JSON.

        Raises:
            KeyError, TypeError, ValueError: it is not of this form.
        """
        case = {
            str(name): None if value is None else float(value) for name, value in document["case"].items()
        }
        return cls(
            int(document["run"]),
            case,
            Verdict(document["verdict"]),
            float(document["robustness"]),
            str(document["spec"]),
            str(document["unit"]),
            float(document["seconds"]),
        )


@dataclass(frozen=True, slots=True)
class Failure:
    """A run that violates.

    Attributes:
        run: as it was found.
        smaller: the same with less of what was varied; `run` itself if nothing could be left out.
        log, smaller_log: their logs; one and the same if there is nothing smaller.
        clip: the shortest part of `smaller_log` that shows the violation.
        command: what repeats `smaller` as a log; None for a simulation of one's own.
    """

    run: SearchedRun
    smaller: SearchedRun
    log: Path
    smaller_log: Path
    clip: Path
    command: str | None

    @property
    def is_smaller(self) -> bool:
        """Whether something could be left out."""
        return self.smaller.case != self.run.case


@dataclass(frozen=True, slots=True)
class Coverage:
    """The tried values of one parameter.

    Attributes:
        low, high: its range; of times in a run, `high` is the end of the first run.
        tenths: how many runs had a value in each tenth of the range.
        least: the least robustness of those; None where there were none.
    """

    parameter: str
    low: float
    high: float
    unit: str
    tenths: tuple[int, ...]
    least: tuple[float | None, ...]


@dataclass(frozen=True, eq=False)
class Falsification(Printed):
    """Result of a search for failures.

    Attributes:
        name: of the scenario or the simulation.
        parameters: what was varied.
        runs: all runs, in the order of the search; the first one with nothing varied.
        failures: those that violate, the worst first.
        impossible: how many cases were left out, since objects would have lain in each other.
        simulations: how many further runs made failures smaller.
        is_exhausted: whether the search ended early, as there was nothing else to try.
    """

    name: str
    parameters: tuple[Parameter, ...]
    runs: tuple[SearchedRun, ...]
    failures: tuple[Failure, ...]
    impossible: int
    simulations: int
    is_exhausted: bool

    @property
    def first(self) -> SearchedRun:
        """The run with nothing varied."""
        return self.runs[0]

    @property
    def lowest(self) -> SearchedRun:
        """The run of the least robustness."""
        return min(self.runs, key=lambda run: run.robustness)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all runs."""
        verdicts = {run.verdict for run in self.runs}
        return next(
            each for each in (Verdict.VIOLATED, Verdict.UNKNOWN, Verdict.SATISFIED) if each in verdicts
        )

    @cached_property
    def coverage(self) -> tuple[Coverage, ...]:
        """The tried values of each parameter."""
        return tuple(map(self._covered, self.parameters))

    def text_of(self, case: Case) -> str:
        """Return what is varied in a case: "noise 0.004 m, slip@3.2s, start.red 0.47,-0.09,0.4"."""
        shown: dict[str, str] = {}
        for each in self.parameters:
            value = case[each.name]
            if value is None or (value == each.rest and not each.is_drawn):
                continue
            # those of one group are written as one
            known = shown.get(each.group)
            if each.group == each.name:
                shown[each.group] = each.text_of(value)
            else:
                shown[each.group] = f"{each.group} {value:.12g}" if known is None else f"{known},{value:.12g}"
        return ", ".join(shown.values()) or "nothing varied"

    def lines(self) -> Iterator[str]:
        """Yield the failures, the worst first, or the lowest run; and the coverage."""
        yield f"run 1, with nothing varied: {_judged(self.first)}"
        for each in self.parameters:
            if each.unit == "s" and self.first.seconds < each.high < math.inf:
                yield (
                    f"{each.name}@{each.low:g}s:{each.high:g}s goes on after the end of that run, at"
                    f" {self.first.seconds:g} s: from there on nothing happens"
                )
        if self.first.is_violated:
            yield "  the search ended with it: what fails without any variation needs no search"
        unknown = sum(run.verdict == "unknown" for run in self.runs)
        doubt = f", {unknown:,} unknown" if unknown else ""
        runs = counted(len(self.runs), "run")
        if self.failures:
            yield f"{runs} of {self.name}: {len(self.failures):,} violated{doubt}; the worst first:"
            for failure in self.failures[:_MOST_FAILURES]:
                yield from self._lines_of(failure)
            if len(self.failures) > _MOST_FAILURES:
                yield f"  … and {len(self.failures) - _MOST_FAILURES:,} more in failures.json"
        else:
            lowest = self.lowest
            yield f"{runs} of {self.name}: none violated{doubt}"
            yield f"  the lowest: run {lowest.number}, {_judged(lowest)}, with {self.text_of(lowest.case)}"
            if len({run.robustness for run in self.runs}) == 1 < len(self.runs):
                yield "  it is the same in every run: what is varied does not change it"
            elif not self.is_exhausted:
                yield "  that is no proof: the same command with a larger --budget goes on from there"
        if self.is_exhausted:
            yield "  the search ended early: there was nothing else to try"
        if len(self.runs) > 1:
            yield "covered, with the runs in each tenth of a range:"
            yield from _table(self.coverage)
        if self.impossible:
            yield f"  {counted(self.impossible, 'case')} left out, in which objects would lie in each other"
        if self.simulations:
            yield f"{counted(self.simulations, 'more run')} made the failures smaller"
        worst = min(self.failures, key=lambda each: each.smaller.robustness, default=None)
        if worst is not None and worst.command is not None:
            less = " with less" if worst.is_smaller else ""
            yield f"the worst again, run {worst.run.number}{less}: {worst.command}"

    def _lines_of(self, failure: Failure) -> Iterator[str]:
        run = failure.run
        yield f"  {failure.log}  {run.spec} {with_unit(run.robustness, run.unit)}  {self.text_of(run.case)}"
        if failure.is_smaller:
            smaller = failure.smaller
            number = with_unit(smaller.robustness, smaller.unit)
            case = self.text_of(smaller.case)
            yield f"    with less: {failure.smaller_log}  {smaller.spec} {number}  {case}"
        yield f"    clip: {failure.clip}"

    @property
    def document(self) -> dict[str, Any]:
        """All of it as JSON, but for the runs that do not violate; files are relative to the folder."""
        return {
            "simulation": self.name,
            "runs": len(self.runs),
            "verdict": str(self.verdict),
            "unknown": sum(run.verdict is Verdict.UNKNOWN for run in self.runs),
            "impossible": self.impossible,
            "exhausted": self.is_exhausted,
            "smaller_runs": self.simulations,
            "first": self.first.document,
            "lowest": self.lowest.document,
            "failures": [
                {
                    **failure.run.document,
                    "log": _relative(failure.log),
                    "smaller": failure.smaller.document["case"],
                    "smaller_robustness": json_number(failure.smaller.robustness),
                    "smaller_log": _relative(failure.smaller_log),
                    "clip": _relative(failure.clip),
                    "command": failure.command,
                }
                for failure in self.failures
            ],
            "covered": [
                {
                    "parameter": each.parameter,
                    "low": each.low,
                    "high": json_number(each.high),
                    "unit": each.unit,
                    "runs": list(each.tenths),
                    "least_robustness": [
                        None if least is None else json_number(least) for least in each.least
                    ],
                }
                for each in self.coverage
            ],
        }

    def _covered(self, parameter: Parameter) -> Coverage:
        # the first run varies nothing, and what is left out has no place in a range
        values = [
            (value, run.robustness)
            for run in self.runs[1:]
            if (value := run.case[parameter.name]) is not None
        ]
        tenths: list[list[float]] = [[] for _ in range(TENTHS)]
        for value, robustness in values:
            tenths[parameter.tenth_of(value)].append(robustness)
        return Coverage(
            parameter.name,
            parameter.low,
            parameter.high,
            parameter.unit,
            tuple(map(len, tenths)),
            tuple(min(each, default=None) for each in tenths),
        )


def _relative(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


def _judged(run: SearchedRun) -> str:
    return f"{run.verdict}, {run.spec} {with_unit(run.robustness, run.unit)}"


def _table(covered: tuple[Coverage, ...]) -> Iterator[str]:
    names = max(len(each.parameter) for each in covered)
    spans = [f"{each.low:g} to {each.high:g}{f' {each.unit}' if each.unit else ''}" for each in covered]
    width = max(map(len, spans))
    for each, span in zip(covered, spans, strict=True):
        counts = " ".join(f"{count:3}" for count in each.tenths)
        yield f"  {each.parameter:<{names}}  {span:<{width}}  {counts}"

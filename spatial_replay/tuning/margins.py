"""How far each run is from the verdict that it should not have, with some values for the constants."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.remote import LogFile
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.instances import Instance, find_instances
from spatial_replay.monitor.offline import OfflineFormula, new_leaves
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.spec import check_names
from spatial_replay.spec.expressions import Measurement
from spatial_replay.spec.formula import Atom, Formula, Outline, Quantified, Specification
from spatial_replay.spec.walks import iter_expressions, iter_formulas
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace, window_of
from spatial_replay.tuning.direction import Direction, direction
from spatial_replay.tuning.substitution import Numbers, Probe, formula_with
from spatial_replay.tuning.varied import Value, VariedConstant

Point: TypeAlias = tuple[int, ...]
"""The number of a value on the grid of each constant."""
Parse: TypeAlias = Callable[[Mapping[str, Value]], Specification]

_REMEMBERED: Final = 64
"""Specifications kept compiled; a search goes back to recent ones."""


@dataclass(frozen=True, eq=False)
class LabelledRun:
    """A recorded run, and whether it did what it should."""

    name: str
    is_good: bool
    trace: Trace


def load_runs(
    good: Sequence[LogFile | Trace],
    bad: Sequence[LogFile | Trace],
    read: Callable[[LogFile], Trace],
    advance: Callable[[int], None] = lambda runs: None,
) -> list[LabelledRun]:
    """Read runs; a file gives its name; if two files have the same, all are named with their folders.

    Args:
        read: returns the samples of a log.
        advance: called with the number of logs that are read.

    Raises:
        UsageError: a log that is good and bad.
    """
    files = [each for each in (*good, *bad) if not isinstance(each, Trace)]
    names_of_good, names_of_bad = _names(good), _names(bad)
    both = names_of_good.keys() & names_of_bad.keys()
    if both:
        names = ", ".join(sorted(names_of_good[each] for each in both))
        raise UsageError(f"{names} cannot be good and bad at once; leave it out of one of them")
    has_own_names = len({each.name for each in files}) == len(files)
    runs = []
    for is_good, logs in ((True, good), (False, bad)):
        for number, log in enumerate(logs, 1):
            if isinstance(log, Trace):
                name, trace = f"{'good' if is_good else 'bad'} run {number}", log
            else:
                name = log.name if has_own_names else _place(log)
                trace = read(log)
                advance(1)
            runs.append(LabelledRun(name, is_good, trace))
    return runs


def _names(logs: Sequence[LogFile | Trace]) -> dict[Path | str, str]:
    """Return the names of files by their places."""
    files = [each for each in logs if not isinstance(each, Trace)]
    return {each.resolve() if isinstance(each, Path) else _place(each): each.name for each in files}


def _place(file: LogFile) -> str:
    return file.as_posix() if isinstance(file, Path) else str(file)


class Robustness(NamedTuple):
    """The ends of the least robustness of all results of a specification, over one run."""

    lower: float
    upper: float


class _Result(NamedTuple):
    """A result of a specification with some values, compiled.

    Attributes:
        changed: which of its leaves differ from the first one's; None: not the same leaves.
        regions: those of the specification, if they are not the first one's.
        same_measurements: whether it needs no other measurements than the first one.
    """

    order: Sequence[Atom | Quantified]
    formula: OfflineFormula
    changed: tuple[int, ...] | None
    regions: Mapping[str, Outline] | None
    same_measurements: bool


class _Prepared(NamedTuple):
    """A run with what it needs to be evaluated again: instances of each result, their leaves (C, A, T)."""

    scene: TraceScene
    instances: Mapping[str, Sequence[tuple[Instance, slice, Floats]]]


class Margins:
    """The margins of runs at points of the constants' grids; of each run, all that stays equal is kept.

    Attributes:
        runs: those evaluated, by their numbers.
        varied: the constants, in the order of a point; sample counts have whole numbers.
        directions: for each, whether a greater value is looser (1), tighter (-1), or neither for sure (None).
        axes: for each result of the specification, by name, the constants that it depends on.
        evaluations: how many times a result was evaluated on a run.
    """

    def __init__(
        self,
        runs: Sequence[LabelledRun],
        parse: Parse,
        varied: Sequence[VariedConstant],
        each: Mapping[str, str],
        *,
        advance: Callable[[int], None] = lambda runs: None,
    ) -> None:
        """Prepare the runs.

        Args:
            parse: returns the specification with values for some constants.
            each: for each parameter of a template, the objects that it stands for.
            advance: called with the number of runs that are prepared.

        Raises:
            SpecificationError: a specification that is invalid at an end of a range.
            UsageError: a constant that no result depends on; a run that does not fit the specification.
        """
        self.runs, self._parse, self._each = tuple(runs), parse, each
        self.varied = tuple(self._fitting(constant) for constant in varied)
        self.evaluations = 0
        self._parsed: OrderedDict[Point, Specification | None] = OrderedDict()
        self._compiled: OrderedDict[tuple[str, Point], _Result] = OrderedDict()
        self._robustness: dict[tuple[int, str, Point], Robustness] = {}
        self._base = parse({})
        self._first = {spec.name: new_leaves(spec.formula, ()) for spec in self._base.results}
        self.start: Point = tuple(constant.start for constant in self.varied)
        tried = [self._tried(constant) for constant in self.varied]
        self.directions = tuple(map(self._direction, self.varied, tried))
        self.axes = {name: self._axes(name, tried) for name in self._first}
        self._formulas = {name: self._formula(name, tried) for name in self._first}
        self._prepared: list[_Prepared] = []
        for run in self.runs:
            self._prepared.append(self._prepare(run))
            advance(1)

    def specification(self, point: Point) -> Specification | None:
        """Return the specification with the values of a point, or None if it is invalid with them."""
        if point not in self._parsed:
            values = {one.name: one.value(number) for one, number in zip(self.varied, point, strict=True)}
            try:
                self._parsed[point] = self._parse(values)
            except SpecificationError:
                # such as a window whose ends are reversed, between two constants
                self._parsed[point] = None
            if len(self._parsed) > _REMEMBERED:
                self._parsed.popitem(last=False)
        self._parsed.move_to_end(point)
        return self._parsed[point]

    def robustness(self, run: int, point: Point, results: Iterable[str] | None = None) -> Robustness | None:
        """Return that of a run, of all results or some of them; None where the specification is invalid."""
        lower = upper = np.inf
        for name in self.axes if results is None else results:
            found = self._of_result(run, name, point)
            if found is None:
                return None
            lower, upper = min(lower, found.lower), min(upper, found.upper)
        return Robustness(lower, upper)

    def _of_result(self, run: int, name: str, point: Point) -> Robustness | None:
        key = run, name, tuple([point[axis] for axis in self.axes[name]])
        if key not in self._robustness:
            result = self._compile(name, point)
            if result is None:
                return None
            self.evaluations += 1
            self._robustness[key] = self._evaluate(self._prepared[run], name, result)
        return self._robustness[key]

    def margin(self, run: int, point: Point, results: Iterable[str] | None = None) -> float:
        """Return how far a run is from the verdict it should not have: its robustness, negated if it is bad.

        Negative where it has that verdict; -inf where the specification is invalid.

        Args:
            results: names; all of them if None.
        """
        found = self.robustness(run, point, results)
        if found is None:
            return -np.inf
        return found.lower if self.runs[run].is_good else -found.upper

    def holds(self, run: int, point: Point, least: float = 0.0, results: Iterable[str] | None = None) -> bool:
        """Return whether a margin is at least so large, and the verdict right: robustness 0 satisfies."""
        margin = self.margin(run, point, results)
        return margin >= least and (margin > 0.0 or self.runs[run].is_good or least < 0.0)

    def _fitting(self, constant: VariedConstant) -> VariedConstant:
        """Return a constant with a grid of values that the specification takes."""
        ends = {constant.value(0): "least", constant.value(constant.steps): "greatest"}
        for value, which in ends.items():
            try:
                self._parse({constant.name: value})
            except SpecificationError as error:
                first = error.diagnoses[0]
                raise UsageError(
                    f"{constant.name}={value}, the {which} value to try, makes the specification invalid: "
                    f"line {first.line}: {first.message}; narrow its range"
                ) from error
        if not constant.is_whole:
            return constant
        try:
            self._parse({constant.name: float(constant.low + constant.step)})
        except SpecificationError:
            return constant.in_whole_numbers()
        return constant

    def _tried(self, constant: VariedConstant) -> dict[int, Specification]:
        """Return the specification with some values of a constant, the others as written."""
        numbers = sorted({constant.steps * part // 4 for part in range(5)})
        return {number: self._parse({constant.name: constant.value(number)}) for number in numbers}

    def _direction(self, constant: VariedConstant, tried: Mapping[int, Specification]) -> Direction | None:
        found = {direction(one, other) for one, other in pairwise(tried.values())}
        if found == {0} and len({str(each.regions) for each in tried.values()}) == 1:
            raise UsageError(f"no result of {self._base.filename} depends on {constant.name}; vary another")
        found -= {0}
        return found.pop() if len(found) == 1 else None

    def _axes(self, name: str, tried: Sequence[Mapping[int, Specification]]) -> tuple[int, ...]:
        """Return the constants that change a result; any may that changes a region."""

        def changes(specification: Specification) -> bool:
            return specification.regions != self._base.regions or _result_of(
                specification, name
            ) != _result_of(self._base, name)

        return tuple(axis for axis, each in enumerate(tried) if any(map(changes, each.values())))

    def _formula(
        self, name: str, tried: Sequence[Mapping[int, Specification]]
    ) -> Callable[[Numbers], Formula] | None:
        """Return what gives the formula of a result with other values, if that can be had without parsing."""
        written = {one.name: one.written_number for one in self.varied}
        probes = [Probe(_result_of(self._base, name), written)]
        for one, specifications in zip(self.varied, tried, strict=True):
            for number, specification in specifications.items():
                if specification.regions != self._base.regions:
                    return None
                numbers = {**written, one.name: one.number(number)}
                probes.append(Probe(_result_of(specification, name), numbers))
        return formula_with(probes)

    def _compile(self, name: str, point: Point) -> _Result | None:
        key = name, tuple([point[axis] for axis in self.axes[name]])
        if key in self._compiled:
            self._compiled.move_to_end(key)
            return self._compiled[key]
        if (formula_of := self._formulas[name]) is not None:
            numbers = {one.name: one.number(each) for one, each in zip(self.varied, point, strict=True)}
            formula, regions = formula_of(numbers), self._base.regions
        else:
            specification = self.specification(point)
            if specification is None:
                return None
            formula, regions = _result_of(specification, name), specification.regions
        self._compiled[key] = compiled = self._compiled_from(name, formula, regions)
        if len(self._compiled) > _REMEMBERED * len(self.axes):
            self._compiled.popitem(last=False)
        return compiled

    def _compiled_from(self, name: str, formula: Formula, regions: Mapping[str, Outline]) -> _Result:
        order, first = new_leaves(formula, ()), self._first[name]
        changed = None
        if len(order) == len(first):
            changed = tuple(
                i for i, (one, other) in enumerate(zip(order, first, strict=True)) if one != other
            )
        same_regions = regions == self._base.regions
        return _Result(
            order,
            OfflineFormula.of(formula, order),
            changed,
            None if same_regions else regions,
            same_regions and _measurements(order) <= _measurements(first),
        )

    def _prepare(self, run: LabelledRun) -> _Prepared:
        scene = TraceScene(run.trace, self._base.regions)
        times_ns = run.trace.times_ns
        if not len(times_ns):
            raise UsageError(f"{run.name} has no sample; leave it out")
        remarks = check_names(self._base, run.trace.names, tuple(run.trace.signals))
        missing = [each.message for each in remarks if each.severity == "error"]
        if missing:
            raise UsageError(
                f"{run.name} does not fit {self._base.filename}: {'; '.join(missing)}; leave it out, or "
                "give names that it has"
            )
        found: dict[str, list[tuple[Instance, slice, Floats]]] = {}
        for instance in find_instances(self._base, self._each, [run.trace], 0, FOREVER):
            inside = slice(*window_of(times_ns, instance.start_ns, instance.end_ns))
            leaves = leaf_values(scene, self._first[instance.name], instance.bindings)
            found.setdefault(instance.name, []).append((instance, inside, leaves))
        if not found:
            raise UsageError(f"{run.name} has no object for the template to stand for; leave it out")
        return _Prepared(scene, found)

    def _evaluate(self, prepared: _Prepared, name: str, result: _Result) -> Robustness:
        scene = prepared.scene
        if not result.same_measurements:
            # measurements of values that are only tried do not stay in the run's cache
            regions = scene.regions if result.regions is None else result.regions
            scene = TraceScene(replace(scene.trace), regions, scene.skip)
        lower = upper = np.inf
        for instance, inside, first in prepared.instances.get(name, ()):
            leaves = self._leaves(scene, instance, result, first)
            times_ns = scene.trace.times_ns[inside]
            low, high = result.formula.evaluate(leaves[:, :, inside], times_ns).ends(0)
            lower, upper = min(lower, float(low[0])), min(upper, float(high[0]))
        return Robustness(lower, upper)

    def _leaves(self, scene: TraceScene, instance: Instance, result: _Result, first: Floats) -> Floats:
        """Return the leaves of a result (C, A, T); those that did not change are those of the first one."""
        if result.changed is None or result.regions is not None:
            return leaf_values(scene, result.order, instance.bindings)
        if not result.changed:
            return first
        own = leaf_values(scene, [result.order[index] for index in result.changed], instance.bindings)
        channels = max(len(own), len(first))
        leaves = in_channels(first, channels).copy()
        leaves[:, list(result.changed)] = in_channels(own, channels)
        return leaves


def _result_of(specification: Specification, name: str) -> Formula:
    return next(spec.formula for spec in specification.results if spec.name == name)


def _measurements(leaves: Sequence[Atom | Quantified]) -> set[Measurement]:
    return {
        part
        for leaf in leaves
        for formula in iter_formulas(leaf)
        if isinstance(formula, Atom)
        for part in iter_expressions(formula.expression)
        if isinstance(part, Measurement)
    }

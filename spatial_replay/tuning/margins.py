"""How far each run is from the verdict that it should not have, with some values for the constants."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.instances import Instance, find_instances
from spatial_replay.monitor.offline import OfflineFormula
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.spec import check_names
from spatial_replay.spec.expressions import Measurement
from spatial_replay.spec.formula import Atom, Quantified, Specification
from spatial_replay.spec.walks import iter_expressions, iter_formulas
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace, window_of
from spatial_replay.tuning.direction import Direction, direction
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
    good: Sequence[Path | Trace],
    bad: Sequence[Path | Trace],
    read: Callable[[Path], Trace],
    advance: Callable[[int], None] = lambda runs: None,
) -> list[LabelledRun]:
    """Read runs; a file gives its name; if two files have the same, all are named with their folders.

    Args:
        read: returns the samples of a log.
        advance: called with the number of logs that are read.

    Raises:
        UsageError: a log that is good and bad.
    """
    paths = [each for each in (*good, *bad) if isinstance(each, Path)]
    both = {each.resolve() for each in good if isinstance(each, Path)} & {
        each.resolve() for each in bad if isinstance(each, Path)
    }
    if both:
        names = ", ".join(sorted(each.name for each in both))
        raise UsageError(f"{names} cannot be good and bad at once; leave it out of one of them")
    has_own_names = len({each.name for each in paths}) == len(paths)
    runs = []
    for is_good, logs in ((True, good), (False, bad)):
        for number, log in enumerate(logs, 1):
            if isinstance(log, Trace):
                name, trace = f"{'good' if is_good else 'bad'} run {number}", log
            else:
                name = log.name if has_own_names else log.as_posix()
                trace = read(log)
                advance(1)
            runs.append(LabelledRun(name, is_good, trace))
    return runs


class Robustness(NamedTuple):
    """The ends of the least robustness of all results of a specification, over one run."""

    lower: float
    upper: float


class _Result(NamedTuple):
    """A result of a specification, compiled, and which of its leaves differ from the first one's."""

    order: Sequence[Atom | Quantified]
    formula: OfflineFormula
    changed: tuple[int, ...] | None


class _Compiled(NamedTuple):
    """A specification with some values: its results by name."""

    specification: Specification
    results: Mapping[str, _Result]
    same_regions: bool
    same_measurements: bool


class _Prepared(NamedTuple):
    """A run with what it needs to be evaluated again: its instances, and their leaves (C, A, T)."""

    scene: TraceScene
    instances: Sequence[tuple[Instance, slice, Floats]]


class Margins:
    """The margins of runs at points of the constants' grids; of each run, all that stays equal is kept.

    Attributes:
        runs: those evaluated, by their numbers.
        varied: the constants, in the order of a point; sample counts have whole numbers.
        directions: for each, whether a greater value is looser (1), tighter (-1), or neither for sure (None).
        evaluations: how many times a run was evaluated.
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
        self._compiled: OrderedDict[Point, _Compiled | None] = OrderedDict()
        self._robustness: dict[tuple[int, Point], Robustness] = {}
        self._base = parse({})
        self._programs = {spec.name: compile_formula(spec.formula) for spec in self._base.results}
        self.start: Point = tuple(constant.start for constant in self.varied)
        self.directions = tuple(self._direction(axis) for axis in range(len(self.varied)))
        self._prepared: list[_Prepared] = []
        for run in self.runs:
            self._prepared.append(self._prepare(run))
            advance(1)

    def specification(self, point: Point) -> Specification | None:
        """Return the specification with the values of a point, or None if it is invalid with them."""
        compiled = self._compile(point)
        return None if compiled is None else compiled.specification

    def robustness(self, run: int, point: Point) -> Robustness | None:
        """Return that of a run, or None where the specification is invalid."""
        key = run, point
        if key not in self._robustness:
            compiled = self._compile(point)
            if compiled is None:
                return None
            self.evaluations += 1
            self._robustness[key] = self._evaluate(self._prepared[run], compiled)
        return self._robustness[key]

    def margin(self, run: int, point: Point) -> float:
        """Return how far a run is from the verdict it should not have: its robustness, negated if it is bad.

        Negative where it has that verdict; -inf where the specification is invalid.
        """
        found = self.robustness(run, point)
        if found is None:
            return -np.inf
        return found.lower if self.runs[run].is_good else -found.upper

    def holds(self, run: int, point: Point, least: float = 0.0) -> bool:
        """Return whether a margin is at least so large, and the verdict right: robustness 0 satisfies."""
        margin = self.margin(run, point)
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

    def _direction(self, axis: int) -> Direction | None:
        constant = self.varied[axis]
        numbers = sorted({constant.steps * part // 4 for part in range(5)})
        tried = [self._parse({constant.name: constant.value(number)}) for number in numbers]
        found = {direction(one, other) for one, other in pairwise(tried)}
        if found == {0} and len({str(each.regions) for each in tried}) == 1:
            raise UsageError(f"no result of {self._base.filename} depends on {constant.name}; vary another")
        found -= {0}
        return found.pop() if len(found) == 1 else None

    def _compile(self, point: Point) -> _Compiled | None:
        if point in self._compiled:
            self._compiled.move_to_end(point)
            return self._compiled[point]
        values = {one.name: one.value(number) for one, number in zip(self.varied, point, strict=True)}
        try:
            compiled = self._compiled_from(self._parse(values))
        except SpecificationError:
            # such as a window whose ends are reversed, between two constants
            compiled = None
        self._compiled[point] = compiled
        if len(self._compiled) > _REMEMBERED:
            self._compiled.popitem(last=False)
        return compiled

    def _compiled_from(self, specification: Specification) -> _Compiled:
        results: dict[str, _Result] = {}
        known, needed = set[Measurement](), set[Measurement]()
        for spec in specification.results:
            order, first = compile_formula(spec.formula).leaves, self._programs[spec.name].leaves
            changed = None
            if len(order) == len(first):
                changed = tuple(
                    i for i, (one, other) in enumerate(zip(order, first, strict=True)) if one != other
                )
            results[spec.name] = _Result(order, OfflineFormula.of(spec.formula, order), changed)
            known |= _measurements(first)
            needed |= _measurements(order)
        same_regions = specification.regions == self._base.regions
        return _Compiled(specification, results, same_regions, same_regions and needed <= known)

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
        found = []
        for instance in find_instances(self._base, self._each, [run.trace], 0, FOREVER):
            inside = slice(*window_of(times_ns, instance.start_ns, instance.end_ns))
            leaves = leaf_values(scene, instance.program.leaves, instance.bindings)
            found.append((instance, inside, leaves))
        if not found:
            raise UsageError(f"{run.name} has no object for the template to stand for; leave it out")
        return _Prepared(scene, found)

    def _evaluate(self, prepared: _Prepared, compiled: _Compiled) -> Robustness:
        scene = prepared.scene
        if not compiled.same_measurements:
            # measurements of values that are only tried do not stay in the run's cache
            regions = compiled.specification.regions
            scene = TraceScene(replace(scene.trace), regions, scene.skip)
        lower = upper = np.inf
        for instance, inside, first in prepared.instances:
            result = compiled.results[instance.name]
            leaves = self._leaves(scene, instance, result, first, same_regions=compiled.same_regions)
            times_ns = scene.trace.times_ns[inside]
            low, high = result.formula.evaluate(leaves[:, :, inside], times_ns).ends(0)
            lower, upper = min(lower, float(low[0])), min(upper, float(high[0]))
        return Robustness(lower, upper)

    def _leaves(
        self, scene: TraceScene, instance: Instance, result: _Result, first: Floats, *, same_regions: bool
    ) -> Floats:
        """Return the leaves of a result (C, A, T); those that did not change are those of the first one."""
        if result.changed is None or not same_regions:
            return leaf_values(scene, result.order, instance.bindings)
        if not result.changed:
            return first
        own = leaf_values(scene, [result.order[index] for index in result.changed], instance.bindings)
        channels = max(len(own), len(first))
        leaves = in_channels(first, channels).copy()
        leaves[:, list(result.changed)] = in_channels(own, channels)
        return leaves


def _measurements(leaves: Sequence[Atom | Quantified]) -> set[Measurement]:
    return {
        part
        for leaf in leaves
        for formula in iter_formulas(leaf)
        if isinstance(formula, Atom)
        for part in iter_expressions(formula.expression)
        if isinstance(part, Measurement)
    }

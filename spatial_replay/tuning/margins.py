"""Tuned constants: what varies, in which direction, and the margins of labelled runs."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from decimal import Decimal
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.logs.remote import LogFile
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.offline import OfflineFormula, new_leaves
from spatial_replay.monitor.stream import Instance, find_instances
from spatial_replay.spec import check_names
from spatial_replay.spec.constants import text_of, value_from_outside
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Bound,
    Constant,
    Enlarged,
    Expression,
    Formula,
    Maximum,
    Measurement,
    Minimum,
    Negative,
    Number,
    Outline,
    Product,
    Quantified,
    Scaled,
    Specification,
    Sum,
    Temporal,
    Term,
    expand,
)
from spatial_replay.spec.syntax import Duration
from spatial_replay.spec.walks import iter_expressions, iter_formulas
from spatial_replay.trace.trace import FOREVER, Trace, window_of

Numbers: TypeAlias = Mapping[str, float]
"""Values of constants, durations in nanoseconds."""
_Fill: TypeAlias = Callable[[Numbers], Any]


class Probe(NamedTuple):
    """A formula as it was parsed with some values."""

    formula: Formula
    numbers: Numbers


class _NeedsParsingError(Exception):
    """A part of a formula depends on a constant in another way than by being it."""


def formula_with(probes: Sequence[Probe]) -> Callable[[Numbers], Formula] | None:
    """Return a function that returns the formula with other values, or None where only parsing gives it.

    A number that is a constant, or one negated, in all probes is taken to be it; texts of atoms stay as in
    the first probe. Windows whose two ends may cross are left to the parser, which checks them.
    """
    try:
        return _fill([probe.formula for probe in probes], [probe.numbers for probe in probes])
    except _NeedsParsingError:
        return None


def _fill(parts: Sequence[Any], values: Sequence[Numbers]) -> _Fill:
    first = parts[0]
    if all(type(part) is type(first) for part in parts) and all(part == first for part in parts):
        return lambda _: first
    if isinstance(first, float | int):
        return _number(parts, values)
    if any(type(part) is not type(first) for part in parts):
        raise _NeedsParsingError
    if isinstance(first, tuple):
        if any(len(part) != len(first) for part in parts):
            raise _NeedsParsingError
        fills = [_fill(elements, values) for elements in zip(*parts, strict=True)]
        return lambda numbers: tuple(fill(numbers) for fill in fills)
    if not is_dataclass(first) or isinstance(first, type):
        raise _NeedsParsingError
    changing = {}
    for name in (field.name for field in fields(first) if field.init and field.compare):
        field_values = [getattr(part, name) for part in parts]
        if any(value != field_values[0] for value in field_values) and not (
            isinstance(first, Atom) and name == "text"
        ):
            changing[name] = _fill(field_values, values)
    if isinstance(first, Bound) and "lower" in changing and first.upper is not None:
        raise _NeedsParsingError
    return lambda numbers: replace(first, **{name: fill(numbers) for name, fill in changing.items()})


def _number(parts: Sequence[Any], values: Sequence[Numbers]) -> _Fill:
    kind = type(parts[0])
    if kind is bool or any(type(part) is not kind for part in parts):
        raise _NeedsParsingError
    for name in values[0]:
        for sign in (1, -1):
            if all(part == sign * numbers[name] for part, numbers in zip(parts, values, strict=True)):
                return lambda numbers, name=name, sign=sign: kind(sign * numbers[name])  # type: ignore[misc]
    raise _NeedsParsingError


Value: TypeAlias = float | str
"""A number or, as a text, a duration, as `parse_specification` takes it."""

_PARTS: Final = 1_000_000
"""At least as many values are tried for a number, so that steps of the grid are short decimals."""


@dataclass(frozen=True)
class VariedConstant:
    """A constant, and the values from `low` to `high` that are tried: both of them, and multiples of `step`.

    Attributes:
        written: its value in the text.
        low, high, step: numbers, or nanoseconds of a duration.
    """

    name: str
    written: Constant
    low: Decimal
    high: Decimal
    step: Decimal

    @classmethod
    def of(cls, name: str, written: Constant, low: Value, high: Value) -> VariedConstant:
        """Return a constant with a fine grid.

        Raises:
            UsageError: an end that is none, or of another kind than the constant; an empty range.
        """
        ends = [_decimal(name, end, written) for end in (low, high)]
        width = ends[1] - ends[0]
        range_text = f"[{_text(ends[0], written)}, {_text(ends[1], written)}]"
        if width <= 0:
            raise UsageError(f"{name}: the range {range_text} is empty; give a lower and a greater end")
        if written.range is not None:
            # a range in the text is the widest that may be tried
            inner = [Decimal(repr(end)) for end in written.range]
            if written.duration_ns is not None:
                inner = [end * 10**9 for end in inner]
            if not inner[0] <= ends[0] < ends[1] <= inner[1]:
                allowed = f"[{_text(inner[0], written)}, {_text(inner[1], written)}]"
                raise UsageError(
                    f"{name}: {range_text} is outside of {allowed}, the range in the text; "
                    "choose within it, or widen it there"
                )
        step = Decimal(1).scaleb((width / _PARTS).adjusted())
        return cls(
            name, written, ends[0], ends[1], step if written.duration_ns is None else max(step, Decimal(1))
        )

    @property
    def is_whole(self) -> bool:
        """Whether both ends are whole numbers, so that it may count samples."""
        return self.written.duration_ns is None and all(end % 1 == 0 for end in (self.low, self.high))

    @cached_property
    def steps(self) -> int:
        """The number of the last value; that of the first is 0."""
        return max(1, int(-(-self.high // self.step)) - self._before)

    @cached_property
    def _before(self) -> int:
        """The greatest multiple of the step that is at most `low`."""
        return int((self.low / self.step).to_integral_value(rounding="ROUND_FLOOR"))

    def decimal(self, number: int) -> Decimal:
        """Return the value of that number, exactly."""
        if number <= 0:
            return self.low
        return self.high if number >= self.steps else self.step * (self._before + number)

    def value(self, number: int) -> Value:
        """Return the value of that number as `parse_specification` takes it."""
        decimal = self.decimal(number)
        return float(decimal) if self.written.duration_ns is None else text_of(Duration(int(decimal)))

    def number(self, number: int) -> float:
        """Return the value of that number, a duration in nanoseconds."""
        decimal = self.decimal(number)
        return float(decimal) if self.written.duration_ns is None else int(decimal)

    @property
    def written_number(self) -> float:
        """The value in the text, a duration in nanoseconds."""
        return self.written.value if self.written.duration_ns is None else self.written.duration_ns

    def text(self, number: int) -> str:
        """Return the value of that number as written in a text: `70`, `2.5s`."""
        return _text(self.decimal(number), self.written)

    def nearest(self, value: Decimal) -> int:
        """Return the number of the value next to another one."""
        inside = min(max(value, self.low), self.high)
        return min(max(int((inside / self.step).to_integral_value()) - self._before, 0), self.steps)

    @property
    def start(self) -> int:
        """The number of the value next to the written one."""
        return self.nearest(_decimal(self.name, _written_value(self.written), self.written))

    def roundest(self, first: int, last: int) -> int:
        """Return the number of a short value near the middle of a range of numbers."""
        middle = (self.decimal(first) + self.decimal(last)) / 2
        width = (self.decimal(last) - self.decimal(first)) / 2
        exponent = width.adjusted() + 1 if width else self.step.adjusted()
        while exponent > self.step.adjusted():
            unit = Decimal(1).scaleb(exponent)
            number = self.nearest((middle / unit).to_integral_value() * unit)
            if first <= number <= last and 4 * abs(self.decimal(number) - middle) <= 2 * width:
                return number
            exponent -= 1
        return self.nearest(middle)


def varied_constants(
    specification: Specification, ranges: Mapping[str, tuple[Value, Value] | None]
) -> tuple[VariedConstant, ...]:
    """Return the constants to tune: those with a range in `ranges`; without any, those with one in the text.

    Args:
        ranges: the values to try, by name; None takes the range in the text.

    Raises:
        UsageError: no such constant, one without a range, an empty range, none at all.
    """
    constants = specification.constants
    with_range = [
        name
        for name, constant in constants.items()
        if constant.range is not None and not constant.is_computed
    ]
    ends_by_name = ranges or dict.fromkeys(with_range)
    if not ends_by_name:
        example = next(iter(constants), None)
        raise UsageError(
            f"{specification.filename} has no constant to tune; "
            "name a number in it: const NAME = VALUE in [LOW, HIGH]"
            if example is None
            else f"no constant of {specification.filename} has a range to tune it in; "
            f"vary one ({example}=LOW:HIGH), or write const {example} = "
            f"{text_of_constant(constants[example])} in [LOW, HIGH]"
        )
    varied = []
    for name, ends in ends_by_name.items():
        if name not in constants:
            hint = nearest_hint(name, constants) or f"the constants are: {', '.join(constants) or 'none'}"
            raise UsageError(f"{specification.filename} has no constant {name!r} to vary; {hint}")
        if constants[name].is_computed:
            raise UsageError(f"{name} is computed from other constants; vary those")
        if ends is None:
            span = constants[name].range
            if span is None:
                raise UsageError(f"{name} has no range in the text; give one: {name}=LOW:HIGH")
            ends = (_end(span[0], constants[name]), _end(span[1], constants[name]))
        varied.append(VariedConstant.of(name, constants[name], *ends))
    return tuple(varied)


def text_of_constant(constant: Constant) -> str:
    """Write a constant as a text does."""
    return text_of(constant.value if constant.duration_ns is None else Duration(constant.duration_ns))


def _written_value(constant: Constant) -> Value:
    return constant.value if constant.duration_ns is None else text_of_constant(constant)


def _end(value: float, constant: Constant) -> Value:
    return value if constant.duration_ns is None else text_of(Duration(round(value * 1e9)))


def _decimal(name: str, value: Value, written: Constant) -> Decimal:
    read = value_from_outside(name, value)
    if isinstance(read, Duration) != (written.duration_ns is not None):
        kind = "a number" if written.duration_ns is None else "a duration such as 2s"
        raise UsageError(f"{name} cannot be {value!r}: it is {kind} ({text_of_constant(written)} as written)")
    return Decimal(read.ns) if isinstance(read, Duration) else Decimal(repr(read))


def _text(value: Decimal, written: Constant) -> str:
    return text_of(float(value) if written.duration_ns is None else Duration(int(value)))


Direction: TypeAlias = Literal[-1, 0, 1]
"""1: looser, its robustness is at least that of the other in every log; -1: tighter; 0: the same."""


def direction(before: Specification, after: Specification) -> Direction | None:
    """Return how the results of one specification compare with those of another, of the same shape.

    Returns:
        None where one is looser in some logs and tighter in others, or where that is not known.
    """
    if before.regions != after.regions or len(before.results) != len(after.results):
        return None
    return _common(
        _of_formula(old.formula, new.formula) for old, new in zip(before.results, after.results, strict=True)
    )


def _common(directions: Iterable[Direction | None]) -> Direction | None:
    """Return the direction of something that rises with each of its parts."""
    signs = set(directions) - {0}
    if not signs:
        return 0
    return signs.pop() if len(signs) == 1 else None


def _opposite(direction: Direction | None) -> Direction | None:
    return _times(direction, -1)


def _times(direction: Direction | None, sign: int) -> Direction | None:
    return None if direction is None else _sign(direction * sign)


def _sign(difference: float) -> Direction:
    return 1 if difference > 0 else -1 if difference < 0 else 0


def _of_formula(before: Formula, after: Formula) -> Direction | None:
    if before == after:
        return 0
    if isinstance(before, Boolean) and before.operator in ("xor", "<->"):
        return None
    match expand(before), expand(after):
        case Atom() as old, Atom() as new:
            return _of_expression(old.expression, new.expression)
        case Quantified() as old, Quantified() as new:
            same = (old.quantifier, old.variables, old.group) == (
                new.quantifier,
                new.variables,
                new.group,
            )
            return _of_formula(old.body, new.body) if same else None
        case Boolean() as old, Boolean() as new if _alike(old, new):
            parts = _common(map(_of_formula, old.operands, new.operands))
            return _opposite(parts) if old.operator == "not" else parts
        case Temporal() as old, Temporal() as new if _alike(old, new):
            window = _of_bound(old.bound, new.bound)
            window = _opposite(window) if old.operator in ("G", "H") else window
            return _common([window, *map(_of_formula, old.operands, new.operands)])
    return None


def _alike(old: Boolean | Temporal, new: Boolean | Temporal) -> bool:
    return old.operator == new.operator and len(old.operands) == len(new.operands)


def _of_bound(before: Bound | None, after: Bound | None) -> Direction | None:
    """Return 1 if the window of an operator such as F grew: it has more samples to choose from."""
    if before == after:
        return 0
    if before is None or after is None or before.unit != after.unit:
        return None
    ends = [float("inf") if bound.upper is None else bound.upper for bound in (before, after)]
    return _common([_sign(before.lower - after.lower), _sign(ends[1] - ends[0])])


def _of_expression(before: Expression, after: Expression) -> Direction | None:
    if before == after:
        return 0
    match before, after:
        case Number() as old, Number() as new:
            return _sign(new.value - old.value)
        case Sum() as old, Sum() as new:
            return _common([_of_expression(old.first, new.first), _of_expression(old.second, new.second)])
        case Negative() as old, Negative() as new:
            return _opposite(_of_expression(old.operand, new.operand))
        case Product() as old, Product() as new if old.factor == new.factor:
            return _of_expression(old.operand, new.operand)
        case Scaled() as old, Scaled() as new if old.divisor == new.divisor:
            return _of_expression(old.operand, new.operand)
        case Minimum() as old, Minimum() as new if len(old.operands) == len(new.operands):
            return _common(map(_of_expression, old.operands, new.operands))
        case Maximum() as old, Maximum() as new if len(old.operands) == len(new.operands):
            return _common(map(_of_expression, old.operands, new.operands))
        case Measurement() as old, Measurement() as new if old.quantity == new.quantity:
            changes = zip(old.radius_effects, map(_of_term, old.terms, new.terms), strict=True)
            return _common([_times(change, effect) for effect, change in changes])
    return None


def _of_term(before: Term, after: Term) -> Direction | None:
    """Return 1 if a footprint is enlarged more."""
    if before == after:
        return 0
    if isinstance(before, Enlarged) and isinstance(after, Enlarged):
        return _common([_of_term(before.term, after.term), _sign(after.radius - before.radius)])
    return None


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
    files = [log for log in (*good, *bad) if not isinstance(log, Trace)]
    names_of_good, names_of_bad = _names(good), _names(bad)
    both = names_of_good.keys() & names_of_bad.keys()
    if both:
        names = ", ".join(sorted(names_of_good[place] for place in both))
        raise UsageError(f"{names} cannot be good and bad at once; leave it out of one of them")
    has_own_names = len({file.name for file in files}) == len(files)
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
    files = [log for log in logs if not isinstance(log, Trace)]
    return {file.resolve() if isinstance(file, Path) else _place(file): file.name for file in files}


def _place(file: LogFile) -> str:
    return file.as_posix() if isinstance(file, Path) else str(file)


class Robustness(NamedTuple):
    """The ends of the least robustness of all results of a specification, over one run."""

    lower: float
    upper: float


class _Result(NamedTuple):
    """A result of a specification with some values, compiled.

    Attributes:
        regions: those of the specification.
        same_measurements: whether it needs no other measurements than the first one.
    """

    order: Sequence[Atom | Quantified]
    formula: OfflineFormula
    regions: Mapping[str, Outline]
    same_measurements: bool


class _Prepared(NamedTuple):
    """A run with what it needs to be evaluated again: instances of each result, and their samples."""

    scene: TraceScene
    instances: Mapping[str, Sequence[tuple[Instance, slice]]]


class Margins:
    """The margins of runs at points of the constants' grids; of each run, all that stays equal is kept.

    Attributes:
        runs: those evaluated, by their numbers.
        varied: the constants, in the order of a point; sample counts have whole numbers.
        directions: for each, whether a greater value is looser (1), tighter (-1), or neither for sure (None).
        axes: for each result of the specification, by name, the constants that it depends on.
        evaluations: how many times a result was evaluated on a run.
        specification: returns that with the values of a point, or None if it is invalid with them.
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
        self.specification = lru_cache(_REMEMBERED)(self._parsed_at)
        self._compiled: OrderedDict[tuple[str, Point], _Result] = OrderedDict()
        self._robustness: dict[tuple[int, str, Point], Robustness] = {}
        self._base = parse({})
        self._first = {spec.name: new_leaves(spec.formula, ()) for spec in self._base.results}
        self.start: Point = tuple(constant.start for constant in self.varied)
        tried = [self._probe(constant) for constant in self.varied]
        self.directions = tuple(map(self._direction, self.varied, tried))
        self.axes = {name: self._axes(name, tried) for name in self._first}
        self._formulas = {name: self._formula(name, tried) for name in self._first}
        self._prepared: list[_Prepared] = []
        for run in self.runs:
            self._prepared.append(self._prepare(run))
            advance(1)

    def _parsed_at(self, point: Point) -> Specification | None:
        values = {
            constant.name: constant.value(number) for constant, number in zip(self.varied, point, strict=True)
        }
        try:
            return self._parse(values)
        except SpecificationError:
            # such as a window whose ends are reversed, between two constants
            return None

    def robustness(self, run: int, point: Point, results: Iterable[str] | None = None) -> Robustness | None:
        """Return that of a run, of all results or some of them; None where the specification is invalid."""
        lower = upper = np.inf
        for name in self.axes if results is None else results:
            robustness = self._of_result(run, name, point)
            if robustness is None:
                return None
            lower, upper = min(lower, robustness.lower), min(upper, robustness.upper)
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
        robustness = self.robustness(run, point, results)
        if robustness is None:
            return -np.inf
        return robustness.lower if self.runs[run].is_good else -robustness.upper

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
            return replace(constant, step=Decimal(1))
        return constant

    def _probe(self, constant: VariedConstant) -> dict[int, Specification]:
        """Return the specification with some values of a constant, the others as written."""
        numbers = sorted({constant.steps * part // 4 for part in range(5)})
        return {number: self._parse({constant.name: constant.value(number)}) for number in numbers}

    def _direction(self, constant: VariedConstant, tried: Mapping[int, Specification]) -> Direction | None:
        directions = {direction(before, after) for before, after in pairwise(tried.values())}
        if directions == {0} and len({str(specification.regions) for specification in tried.values()}) == 1:
            raise UsageError(f"no result of {self._base.filename} depends on {constant.name}; vary another")
        directions -= {0}
        return directions.pop() if len(directions) == 1 else None

    def _axes(self, name: str, tried: Sequence[Mapping[int, Specification]]) -> tuple[int, ...]:
        """Return the constants that change a result; any may that changes a region."""

        def changes(specification: Specification) -> bool:
            return specification.regions != self._base.regions or _result_of(
                specification, name
            ) != _result_of(self._base, name)

        return tuple(
            axis for axis, specifications in enumerate(tried) if any(map(changes, specifications.values()))
        )

    def _formula(
        self, name: str, tried: Sequence[Mapping[int, Specification]]
    ) -> Callable[[Numbers], Formula] | None:
        """Return what gives the formula of a result with other values, if that can be had without parsing."""
        written_numbers = {constant.name: constant.written_number for constant in self.varied}
        probes = [Probe(_result_of(self._base, name), written_numbers)]
        for constant, specifications in zip(self.varied, tried, strict=True):
            for number, specification in specifications.items():
                if specification.regions != self._base.regions:
                    return None
                numbers = {**written_numbers, constant.name: constant.number(number)}
                probes.append(Probe(_result_of(specification, name), numbers))
        return formula_with(probes)

    def _compile(self, name: str, point: Point) -> _Result | None:
        key = name, tuple([point[axis] for axis in self.axes[name]])
        if key in self._compiled:
            self._compiled.move_to_end(key)
            return self._compiled[key]
        if (formula_of := self._formulas[name]) is not None:
            numbers = {
                constant.name: constant.number(number)
                for constant, number in zip(self.varied, point, strict=True)
            }
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
        is_same = regions == self._base.regions and _measurements(order) <= _measurements(first)
        return _Result(order, OfflineFormula.of(formula, order), regions, is_same)

    def _prepare(self, run: LabelledRun) -> _Prepared:
        scene = TraceScene(run.trace, self._base.regions)
        times_ns = run.trace.times_ns
        if not len(times_ns):
            raise UsageError(f"{run.name} has no sample; leave it out")
        remarks = check_names(self._base, run.trace.names, tuple(run.trace.signals))
        missing = [remark.message for remark in remarks if remark.severity == "error"]
        if missing:
            raise UsageError(
                f"{run.name} does not fit {self._base.filename}: {'; '.join(missing)}; leave it out, or "
                "give names that it has"
            )
        instances: dict[str, list[tuple[Instance, slice]]] = {}
        for instance in find_instances(self._base, self._each, [run.trace], 0, FOREVER):
            inside = slice(*window_of(times_ns, instance.start_ns, instance.end_ns))
            instances.setdefault(instance.name, []).append((instance, inside))
        if not instances:
            raise UsageError(f"{run.name} has no object for the template to stand for; leave it out")
        return _Prepared(scene, instances)

    def _evaluate(self, prepared: _Prepared, name: str, result: _Result) -> Robustness:
        scene = prepared.scene
        if not result.same_measurements:
            # a new trace, so that measurements for values that are only tried stay out of the run's cache
            scene = TraceScene(replace(scene.trace), result.regions, scene.skip)
        lower = upper = np.inf
        for instance, inside in prepared.instances.get(name, ()):
            leaves = leaf_values(scene, result.order, instance.bindings)
            times_ns = scene.trace.times_ns[inside]
            low, high = result.formula.evaluate(leaves[:, :, inside], times_ns).ends(0)
            lower, upper = min(lower, float(low[0])), min(upper, float(high[0]))
        return Robustness(lower, upper)


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

"""Tuned constants: grids of values, directions of change, and margins of labelled runs."""

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
"""Values of constants by name; durations in nanoseconds."""
_Fill: TypeAlias = Callable[[Numbers], Any]


class Probe(NamedTuple):
    """Formula that was parsed with some values of constants."""

    formula: Formula
    numbers: Numbers


class _NeedsParsingError(Exception):
    """A changing part of a formula is neither a constant nor a negated constant."""


def formula_with(probes: Sequence[Probe]) -> Callable[[Numbers], Formula] | None:
    """Return a function from values of constants to the formula; None if the text must be parsed for it.

    A number that equals a constant or its negative in all probes gets the new value of that constant. Texts
    of atoms stay as in the first probe. Windows whose ends may cross need the parser, which checks the ends.
    """
    try:
        return _fill([probe.formula for probe in probes], [probe.numbers for probe in probes])
    except _NeedsParsingError:
        return None


def _fill(nodes: Sequence[Any], probe_numbers: Sequence[Numbers]) -> _Fill:
    first_node = nodes[0]
    if all(type(node) is type(first_node) for node in nodes) and all(node == first_node for node in nodes):
        return lambda _: first_node
    if isinstance(first_node, float | int):
        return _number(nodes, probe_numbers)
    if any(type(node) is not type(first_node) for node in nodes):
        raise _NeedsParsingError
    if isinstance(first_node, tuple):
        if any(len(node) != len(first_node) for node in nodes):
            raise _NeedsParsingError
        fills = [_fill(elements, probe_numbers) for elements in zip(*nodes, strict=True)]
        return lambda numbers: tuple(fill(numbers) for fill in fills)
    if not is_dataclass(first_node) or isinstance(first_node, type):
        raise _NeedsParsingError
    fill_by_name = {}
    for name in (field.name for field in fields(first_node) if field.init and field.compare):
        field_values = [getattr(node, name) for node in nodes]
        if any(value != field_values[0] for value in field_values) and not (
            isinstance(first_node, Atom) and name == "text"
        ):
            fill_by_name[name] = _fill(field_values, probe_numbers)
    if isinstance(first_node, Bound) and "lower" in fill_by_name and first_node.upper is not None:
        raise _NeedsParsingError
    return lambda numbers: replace(first_node, **{name: fill(numbers) for name, fill in fill_by_name.items()})


def _number(nodes: Sequence[Any], probe_numbers: Sequence[Numbers]) -> _Fill:
    number_type = type(nodes[0])
    if number_type is bool or any(type(node) is not number_type for node in nodes):
        raise _NeedsParsingError
    for name in probe_numbers[0]:
        for sign in (1, -1):
            if all(node == sign * numbers[name] for node, numbers in zip(nodes, probe_numbers, strict=True)):
                return lambda numbers, name=name, sign=sign: number_type(sign * numbers[name])  # type: ignore[misc]
    raise _NeedsParsingError


Value: TypeAlias = float | str
"""Number, or duration as a text, as in the arguments of `parse_specification`."""

_PARTS: Final = 1_000_000
"""Least number of steps in a grid; a step is a power of ten, so that values are short decimals."""


@dataclass(frozen=True)
class VariedConstant:
    """Constant with a grid of values: `low`, `high` and the multiples of `step` between them.

    A value is identified by its index in the grid.

    Attributes:
        written: value in the text.
        low, high, step: numbers; nanoseconds for a duration.
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
            UsageError: an invalid end, a number for a duration or the reverse, an empty range, or a range
                outside of the range in the text.
        """
        ends = [_decimal(name, end, written) for end in (low, high)]
        width = ends[1] - ends[0]
        range_text = f"[{_text(ends[0], written)}, {_text(ends[1], written)}]"
        if width <= 0:
            raise UsageError(f"{name}: the range {range_text} is empty; give a lower and a greater end")
        if written.range is not None:
            # the range in the text limits the tried range
            text_range = [Decimal(repr(end)) for end in written.range]
            if written.duration_ns is not None:
                text_range = [end * 10**9 for end in text_range]
            if not text_range[0] <= ends[0] < ends[1] <= text_range[1]:
                allowed_text = f"[{_text(text_range[0], written)}, {_text(text_range[1], written)}]"
                raise UsageError(
                    f"{name}: {range_text} is outside of {allowed_text}, the range in the text; "
                    "choose within it, or widen it there"
                )
        step = Decimal(1).scaleb((width / _PARTS).adjusted())
        return cls(
            name, written, ends[0], ends[1], step if written.duration_ns is None else max(step, Decimal(1))
        )

    @property
    def is_whole(self) -> bool:
        """Whether both ends are whole numbers, so that the constant may be a number of samples."""
        return self.written.duration_ns is None and all(end % 1 == 0 for end in (self.low, self.high))

    @cached_property
    def steps(self) -> int:
        """Index of the last value; the first value has index 0."""
        return max(1, int(-(-self.high // self.step)) - self._before)

    @cached_property
    def _before(self) -> int:
        """Number of whole steps from 0 to `low`, rounded down."""
        return int((self.low / self.step).to_integral_value(rounding="ROUND_FLOOR"))

    def decimal(self, number: int) -> Decimal:
        """Return the exact value at an index."""
        if number <= 0:
            return self.low
        return self.high if number >= self.steps else self.step * (self._before + number)

    def value(self, number: int) -> Value:
        """Return the value at an index, as an argument of `parse_specification`."""
        decimal = self.decimal(number)
        return float(decimal) if self.written.duration_ns is None else text_of(Duration(int(decimal)))

    def number(self, number: int) -> float:
        """Return the value at an index as a number; nanoseconds for a duration."""
        decimal = self.decimal(number)
        return float(decimal) if self.written.duration_ns is None else int(decimal)

    @property
    def written_number(self) -> float:
        """The value in the text as a number; nanoseconds for a duration."""
        return self.written.value if self.written.duration_ns is None else self.written.duration_ns

    def text(self, number: int) -> str:
        """Return the text of the value at an index: `70`, `2.5s`."""
        return _text(self.decimal(number), self.written)

    def nearest(self, value: Decimal) -> int:
        """Return the index of the value nearest to a number."""
        clamped_value = min(max(value, self.low), self.high)
        return min(max(int((clamped_value / self.step).to_integral_value()) - self._before, 0), self.steps)

    @property
    def start(self) -> int:
        """Index of the value nearest to the value in the text."""
        return self.nearest(_decimal(self.name, _written_value(self.written), self.written))

    def roundest(self, first: int, last: int) -> int:
        """Return the index of a short decimal near the middle between two indices."""
        middle = (self.decimal(first) + self.decimal(last)) / 2
        width = (self.decimal(last) - self.decimal(first)) / 2
        exponent = width.adjusted() + 1 if width else self.step.adjusted()
        while exponent > self.step.adjusted():
            unit = Decimal(1).scaleb(exponent)
            index = self.nearest((middle / unit).to_integral_value() * unit)
            if first <= index <= last and 4 * abs(self.decimal(index) - middle) <= 2 * width:
                return index
            exponent -= 1
        return self.nearest(middle)


def varied_constants(
    specification: Specification, ranges: Mapping[str, tuple[Value, Value] | None]
) -> tuple[VariedConstant, ...]:
    """Return the constants in `ranges`; if `ranges` is empty, all constants with a range in the text.

    Args:
        ranges: range to try by name; None for the range in the text.

    Raises:
        UsageError: an unknown or computed constant, a constant without a range, an empty range, or no
            constant to tune.
    """
    constants = specification.constants
    names_with_range = [
        name
        for name, constant in constants.items()
        if constant.range is not None and not constant.is_computed
    ]
    ends_by_name = ranges or dict.fromkeys(names_with_range)
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
    tuned_constants = []
    for name, ends in ends_by_name.items():
        if name not in constants:
            hint = nearest_hint(name, constants) or f"the constants are: {', '.join(constants) or 'none'}"
            raise UsageError(f"{specification.filename} has no constant {name!r} to vary; {hint}")
        if constants[name].is_computed:
            raise UsageError(f"{name} is computed from other constants; vary those")
        if ends is None:
            text_range = constants[name].range
            if text_range is None:
                raise UsageError(f"{name} has no range in the text; give one: {name}=LOW:HIGH")
            ends = (_end(text_range[0], constants[name]), _end(text_range[1], constants[name]))
        tuned_constants.append(VariedConstant.of(name, constants[name], *ends))
    return tuple(tuned_constants)


def text_of_constant(constant: Constant) -> str:
    """Return the text of a constant's value."""
    return text_of(constant.value if constant.duration_ns is None else Duration(constant.duration_ns))


def _written_value(constant: Constant) -> Value:
    return constant.value if constant.duration_ns is None else text_of_constant(constant)


def _end(value: float, constant: Constant) -> Value:
    return value if constant.duration_ns is None else text_of(Duration(round(value * 1e9)))


def _decimal(name: str, value: Value, written: Constant) -> Decimal:
    parsed_value = value_from_outside(name, value)
    if isinstance(parsed_value, Duration) != (written.duration_ns is not None):
        kind = "a number" if written.duration_ns is None else "a duration such as 2s"
        raise UsageError(f"{name} cannot be {value!r}: it is {kind} ({text_of_constant(written)} as written)")
    # repr gives the digits of the text; Decimal(0.1) would have the digits of the binary float
    return Decimal(parsed_value.ns) if isinstance(parsed_value, Duration) else Decimal(repr(parsed_value))


def _text(value: Decimal, written: Constant) -> str:
    return text_of(float(value) if written.duration_ns is None else Duration(int(value)))


Direction: TypeAlias = Literal[-1, 0, 1]
"""1 is looser (the robustness is at least as high in every log), -1 is tighter, 0 is equal."""


def direction(before: Specification, after: Specification) -> Direction | None:
    """Return whether `after` is looser or tighter than `before`, a specification of the same shape.

    Returns:
        Direction of `after`; None if it is unknown, or differs between logs.
    """
    if before.regions != after.regions or len(before.results) != len(after.results):
        return None
    return _common(
        _of_formula(old.formula, new.formula) for old, new in zip(before.results, after.results, strict=True)
    )


def _common(directions: Iterable[Direction | None]) -> Direction | None:
    """Return the common direction of several parts; None if directions differ or a direction is unknown."""
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


def _of_formula(old_formula: Formula, new_formula: Formula) -> Direction | None:
    if old_formula == new_formula:
        return 0
    # these operators rise with an operand in some samples, and fall with it in others
    if isinstance(old_formula, Boolean) and old_formula.operator in ("xor", "<->"):
        return None
    match expand(old_formula), expand(new_formula):
        case Atom() as old, Atom() as new:
            return _of_expression(old.expression, new.expression)
        case Quantified() as old, Quantified() as new:
            has_same_binding = (old.quantifier, old.variables, old.group) == (
                new.quantifier,
                new.variables,
                new.group,
            )
            return _of_formula(old.body, new.body) if has_same_binding else None
        case Boolean() as old, Boolean() as new if _alike(old, new):
            operand_direction = _common(map(_of_formula, old.operands, new.operands))
            return _opposite(operand_direction) if old.operator == "not" else operand_direction
        case Temporal() as old, Temporal() as new if _alike(old, new):
            window_direction = _of_bound(old.bound, new.bound)
            window_direction = _opposite(window_direction) if old.operator in ("G", "H") else window_direction
            return _common([window_direction, *map(_of_formula, old.operands, new.operands)])
    return None


def _alike(old: Boolean | Temporal, new: Boolean | Temporal) -> bool:
    return old.operator == new.operator and len(old.operands) == len(new.operands)


def _of_bound(old_bound: Bound | None, new_bound: Bound | None) -> Direction | None:
    """Return 1 (looser) if the window of an operator such as F grew; -1 if the window shrank."""
    if old_bound == new_bound:
        return 0
    if old_bound is None or new_bound is None or old_bound.unit != new_bound.unit:
        return None
    upper_ends = [float("inf") if bound.upper is None else bound.upper for bound in (old_bound, new_bound)]
    return _common([_sign(old_bound.lower - new_bound.lower), _sign(upper_ends[1] - upper_ends[0])])


def _of_expression(old_expression: Expression, new_expression: Expression) -> Direction | None:
    if old_expression == new_expression:
        return 0
    match old_expression, new_expression:
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
            term_changes = zip(old.radius_effects, map(_of_term, old.terms, new.terms), strict=True)
            return _common([_times(change, effect) for effect, change in term_changes])
    return None


def _of_term(old_term: Term, new_term: Term) -> Direction | None:
    """Return 1 if a footprint is enlarged more, -1 if less."""
    if old_term == new_term:
        return 0
    if isinstance(old_term, Enlarged) and isinstance(new_term, Enlarged):
        return _common([_of_term(old_term.term, new_term.term), _sign(new_term.radius - old_term.radius)])
    return None


Point: TypeAlias = tuple[int, ...]
"""Grid index of each constant."""
Parse: TypeAlias = Callable[[Mapping[str, Value]], Specification]

_REMEMBERED: Final = 64
"""Number of cached specifications; a search returns to recent points."""


@dataclass(frozen=True, eq=False)
class LabelledRun:
    """Recorded run with its label, good or bad."""

    name: str
    is_good: bool
    trace: Trace


def load_runs(
    good: Sequence[LogFile | Trace],
    bad: Sequence[LogFile | Trace],
    read: Callable[[LogFile], Trace],
    advance: Callable[[int], None] = lambda runs: None,
) -> list[LabelledRun]:
    """Read runs, named after their files; if two files have the same name, runs are named by paths.

    Args:
        read: function that returns the samples of a log.
        advance: function that is called with the number of logs read since its last call.

    Raises:
        UsageError: a log is both good and bad.
    """
    files = [log for log in (*good, *bad) if not isinstance(log, Trace)]
    names_of_good, names_of_bad = _names(good), _names(bad)
    shared_places = names_of_good.keys() & names_of_bad.keys()
    if shared_places:
        shared_names = ", ".join(sorted(names_of_good[place] for place in shared_places))
        raise UsageError(f"{shared_names} cannot be good and bad at once; leave it out of one of them")
    has_own_names = len({file.name for file in files}) == len(files)
    runs = []
    for is_good, logs in ((True, good), (False, bad)):
        for run_number, log in enumerate(logs, 1):
            if isinstance(log, Trace):
                name, trace = f"{'good' if is_good else 'bad'} run {run_number}", log
            else:
                name = log.name if has_own_names else _place(log)
                trace = read(log)
                advance(1)
            runs.append(LabelledRun(name, is_good, trace))
    return runs


def _names(logs: Sequence[LogFile | Trace]) -> dict[Path | str, str]:
    """Return the names of files by resolved path or address; traces are left out."""
    files = [log for log in logs if not isinstance(log, Trace)]
    return {file.resolve() if isinstance(file, Path) else _place(file): file.name for file in files}


def _place(file: LogFile) -> str:
    return file.as_posix() if isinstance(file, Path) else str(file)


class Robustness(NamedTuple):
    """Least lower end and least upper end of the robustness of some results over one run."""

    lower: float
    upper: float


class _Result(NamedTuple):
    """Compiled result of a specification with some values of constants.

    Attributes:
        order: leaves of the formula in the order of their numbers.
        formula: compiled formula.
        regions: regions of the specification.
        same_measurements: whether the formula has only measurements of the specification as written, and the
            regions are unchanged.
    """

    order: Sequence[Atom | Quantified]
    formula: OfflineFormula
    regions: Mapping[str, Outline]
    same_measurements: bool


class _Prepared(NamedTuple):
    """Run prepared for repeated evaluation: instances of each result, with their samples."""

    scene: TraceScene
    instances: Mapping[str, Sequence[tuple[Instance, slice]]]


class Margins:
    """Margins of runs at points in the grids of constants; results and measurements are cached.

    Attributes:
        runs: evaluated runs; methods identify a run by its index.
        varied: constants in the order of a point; numbers of samples are whole numbers.
        directions: for each constant, 1 if a greater value is looser, -1 if it is tighter, None if unknown.
        axes: indices of the constants that a result depends on, by name of the result.
        evaluations: number of evaluations of a result on a run.
        specification: function that returns the specification at a point; None if it is invalid there.
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
            parse: function that returns the specification with values of some constants.
            each: objects by template parameter.
            advance: function that is called with the number of runs prepared since its last call.

        Raises:
            SpecificationError: the specification is invalid at a value between the ends of a range.
            UsageError: the specification is invalid at an end of a range, no result depends on a constant, or
                a run does not fit the specification.
        """
        self.runs, self._parse, self._each = tuple(runs), parse, each
        self.varied = tuple(self._fitting(constant) for constant in varied)
        self.evaluations = 0
        # one cache for each instance; a cache of the method would keep all instances alive
        self.specification = lru_cache(_REMEMBERED)(self._parsed_at)
        self._compiled: OrderedDict[tuple[str, Point], _Result] = OrderedDict()
        self._robustness: dict[tuple[int, str, Point], Robustness] = {}
        self._base = parse({})
        self._base_leaves = {spec.name: new_leaves(spec.formula, ()) for spec in self._base.results}
        self.start: Point = tuple(constant.start for constant in self.varied)
        probe_specifications = [self._probe(constant) for constant in self.varied]
        self.directions = tuple(map(self._direction, self.varied, probe_specifications))
        self.axes = {name: self._axes(name, probe_specifications) for name in self._base_leaves}
        self._formulas = {name: self._formula(name, probe_specifications) for name in self._base_leaves}
        self._prepared: list[_Prepared] = []
        for run in self.runs:
            self._prepared.append(self._prepare(run))
            advance(1)

    def _parsed_at(self, point: Point) -> Specification | None:
        value_by_name = {
            constant.name: constant.value(number) for constant, number in zip(self.varied, point, strict=True)
        }
        try:
            return self._parse(value_by_name)
        except SpecificationError:
            # some values are invalid together, such as reversed ends of a window
            return None

    def robustness(self, run: int, point: Point, results: Iterable[str] | None = None) -> Robustness | None:
        """Return the robustness of all or some results over a run; None if the specification is invalid."""
        lower = upper = np.inf
        for name in self.axes if results is None else results:
            robustness = self._of_result(run, name, point)
            if robustness is None:
                return None
            lower, upper = min(lower, robustness.lower), min(upper, robustness.upper)
        return Robustness(lower, upper)

    def _of_result(self, run: int, name: str, point: Point) -> Robustness | None:
        # the key has only the constants of a result, because other constants do not change the result
        cache_key = run, name, tuple([point[axis] for axis in self.axes[name]])
        if cache_key not in self._robustness:
            result = self._compile(name, point)
            if result is None:
                return None
            self.evaluations += 1
            self._robustness[cache_key] = self._evaluate(self._prepared[run], name, result)
        return self._robustness[cache_key]

    def margin(self, run: int, point: Point, results: Iterable[str] | None = None) -> float:
        """Return the margin of a run from the wrong verdict: its robustness, negated for a bad run.

        The margin is negative if the verdict is wrong, and -inf if the specification is invalid.

        Args:
            results: names of results; None for all.
        """
        robustness = self.robustness(run, point, results)
        if robustness is None:
            return -np.inf
        return robustness.lower if self.runs[run].is_good else -robustness.upper

    def holds(self, run: int, point: Point, least: float = 0.0, results: Iterable[str] | None = None) -> bool:
        """Return whether a run has the right verdict and a margin of at least `least`.

        A robustness of 0 satisfies.
        """
        margin = self.margin(run, point, results)
        return margin >= least and (margin > 0.0 or self.runs[run].is_good or least < 0.0)

    def _fitting(self, constant: VariedConstant) -> VariedConstant:
        """Return a constant with a grid of valid values: whole numbers for a number of samples."""
        end_by_value = {constant.value(0): "least", constant.value(constant.steps): "greatest"}
        for value, end_name in end_by_value.items():
            try:
                self._parse({constant.name: value})
            except SpecificationError as error:
                first_fault = error.diagnoses[0]
                raise UsageError(
                    f"{constant.name}={value}, the {end_name} value to try, makes the specification invalid: "
                    f"line {first_fault.line}: {first_fault.message}; narrow its range"
                ) from error
        if not constant.is_whole:
            return constant
        try:
            self._parse({constant.name: float(constant.low + constant.step)})
        except SpecificationError:
            return replace(constant, step=Decimal(1))
        return constant

    def _probe(self, constant: VariedConstant) -> dict[int, Specification]:
        """Return specifications with five values of one constant, by index of the value."""
        indices = sorted({constant.steps * quarter // 4 for quarter in range(5)})
        return {index: self._parse({constant.name: constant.value(index)}) for index in indices}

    def _direction(
        self, constant: VariedConstant, specifications: Mapping[int, Specification]
    ) -> Direction | None:
        directions = {direction(before, after) for before, after in pairwise(specifications.values())}
        if (
            directions == {0}
            and len({str(specification.regions) for specification in specifications.values()}) == 1
        ):
            raise UsageError(f"no result of {self._base.filename} depends on {constant.name}; vary another")
        directions -= {0}
        return directions.pop() if len(directions) == 1 else None

    def _axes(
        self, name: str, probe_specifications: Sequence[Mapping[int, Specification]]
    ) -> tuple[int, ...]:
        """Return the constants that may change a result; a constant in a region may change all results."""

        def changes(specification: Specification) -> bool:
            return specification.regions != self._base.regions or _result_of(
                specification, name
            ) != _result_of(self._base, name)

        return tuple(
            axis
            for axis, specifications in enumerate(probe_specifications)
            if any(map(changes, specifications.values()))
        )

    def _formula(
        self, name: str, probe_specifications: Sequence[Mapping[int, Specification]]
    ) -> Callable[[Numbers], Formula] | None:
        """Return the function from values to the formula of a result; None if the text must be parsed."""
        written_numbers = {constant.name: constant.written_number for constant in self.varied}
        probes = [Probe(_result_of(self._base, name), written_numbers)]
        for constant, specifications in zip(self.varied, probe_specifications, strict=True):
            for number, specification in specifications.items():
                if specification.regions != self._base.regions:
                    return None
                numbers = {**written_numbers, constant.name: constant.number(number)}
                probes.append(Probe(_result_of(specification, name), numbers))
        return formula_with(probes)

    def _compile(self, name: str, point: Point) -> _Result | None:
        cache_key = name, tuple([point[axis] for axis in self.axes[name]])
        if cache_key in self._compiled:
            self._compiled.move_to_end(cache_key)
            return self._compiled[cache_key]
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
        self._compiled[cache_key] = compiled_result = self._compiled_from(name, formula, regions)
        if len(self._compiled) > _REMEMBERED * len(self.axes):
            self._compiled.popitem(last=False)
        return compiled_result

    def _compiled_from(self, name: str, formula: Formula, regions: Mapping[str, Outline]) -> _Result:
        leaves, base_leaves = new_leaves(formula, ()), self._base_leaves[name]
        is_same = regions == self._base.regions and _measurements(leaves) <= _measurements(base_leaves)
        return _Result(leaves, OfflineFormula.of(formula, leaves), regions, is_same)

    def _prepare(self, run: LabelledRun) -> _Prepared:
        scene = TraceScene(run.trace, self._base.regions)
        times_ns = run.trace.times_ns
        if not len(times_ns):
            raise UsageError(f"{run.name} has no sample; leave it out")
        remarks = check_names(self._base, run.trace.names, tuple(run.trace.signals))
        error_messages = [remark.message for remark in remarks if remark.severity == "error"]
        if error_messages:
            raise UsageError(
                f"{run.name} does not fit {self._base.filename}: {'; '.join(error_messages)}; "
                "leave it out, or give names that it has"
            )
        instances: dict[str, list[tuple[Instance, slice]]] = {}
        for instance in find_instances(self._base, self._each, [run.trace], 0, FOREVER):
            sample_slice = slice(*window_of(times_ns, instance.start_ns, instance.end_ns))
            instances.setdefault(instance.name, []).append((instance, sample_slice))
        if not instances:
            raise UsageError(f"{run.name} has no object for the template to stand for; leave it out")
        return _Prepared(scene, instances)

    def _evaluate(self, prepared: _Prepared, name: str, result: _Result) -> Robustness:
        scene = prepared.scene
        if not result.same_measurements:
            # a new trace, so that measurements for tried values do not fill the cache of the run
            scene = TraceScene(replace(scene.trace), result.regions, scene.skip)
        lower = upper = np.inf
        for instance, sample_slice in prepared.instances.get(name, ()):
            leaves = leaf_values(scene, result.order, instance.bindings)
            times_ns = scene.trace.times_ns[sample_slice]
            lower_ends, upper_ends = result.formula.evaluate(leaves[:, :, sample_slice], times_ns).ends(0)
            lower, upper = min(lower, float(lower_ends[0])), min(upper, float(upper_ends[0]))
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

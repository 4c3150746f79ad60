"""Constants to tune, each with the finite grid of values that are tried for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cached_property
from typing import Final, TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.spec.constants import text_of, value_given
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import Constant, Specification
from spatial_replay.spec.syntax import Duration

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
        ends = [_decimal(name, each, written) for each in (low, high)]
        width = ends[1] - ends[0]
        shown = f"[{_text(ends[0], written)}, {_text(ends[1], written)}]"
        if width <= 0:
            raise UsageError(f"{name}: the range {shown} is empty; give a lower and a greater end")
        if written.range is not None:
            # what a text allows is decided there
            inner = [Decimal(repr(each)) for each in written.range]
            if written.duration_ns is not None:
                inner = [each * 10**9 for each in inner]
            if not inner[0] <= ends[0] < ends[1] <= inner[1]:
                allowed = f"[{_text(inner[0], written)}, {_text(inner[1], written)}]"
                raise UsageError(
                    f"{name}: {shown} is outside of {allowed}, the range in the text; "
                    "choose within it, or widen it there"
                )
        step = Decimal(1).scaleb((width / _PARTS).adjusted())
        return cls(
            name, written, ends[0], ends[1], step if written.duration_ns is None else max(step, Decimal(1))
        )

    @property
    def is_whole(self) -> bool:
        """Whether both ends are whole numbers, so that it may count samples."""
        return self.written.duration_ns is None and all(each % 1 == 0 for each in (self.low, self.high))

    def in_whole_numbers(self) -> VariedConstant:
        """Return the constant with a grid of whole numbers."""
        return replace(self, step=Decimal(1))

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
        return self.nearest(_decimal(self.name, _written(self.written), self.written))

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
    known = specification.constants
    with_range = [name for name, each in known.items() if each.range is not None and not each.is_computed]
    chosen = ranges or dict.fromkeys(with_range)
    if not chosen:
        example = next(iter(known), None)
        raise UsageError(
            f"{specification.filename} has no constant to tune; "
            "name a number in it: const NAME = VALUE in [LOW, HIGH]"
            if example is None
            else f"no constant of {specification.filename} has a range to tune it in; "
            f"vary one ({example}=LOW:HIGH), or write const {example} = "
            f"{text_of_constant(known[example])} in [LOW, HIGH]"
        )
    varied = []
    for name, ends in chosen.items():
        if name not in known:
            hint = nearest_hint(name, known) or f"the constants are: {', '.join(known) or 'none'}"
            raise UsageError(f"{specification.filename} has no constant {name!r} to vary; {hint}")
        if known[name].is_computed:
            raise UsageError(f"{name} is computed from other constants; vary those")
        if ends is None:
            span = known[name].range
            if span is None:
                raise UsageError(f"{name} has no range in the text; give one: {name}=LOW:HIGH")
            ends = (_end(span[0], known[name]), _end(span[1], known[name]))
        varied.append(VariedConstant.of(name, known[name], *ends))
    return tuple(varied)


def text_of_constant(constant: Constant) -> str:
    """Write a constant as a text does."""
    return text_of(constant.value if constant.duration_ns is None else Duration(constant.duration_ns))


def _written(constant: Constant) -> Value:
    return constant.value if constant.duration_ns is None else text_of_constant(constant)


def _end(value: float, constant: Constant) -> Value:
    return value if constant.duration_ns is None else text_of(Duration(round(value * 1e9)))


def _decimal(name: str, value: Value, written: Constant) -> Decimal:
    read = value_given(name, value)
    if isinstance(read, Duration) != (written.duration_ns is not None):
        kind = "a number" if written.duration_ns is None else "a duration such as 2s"
        raise UsageError(f"{name} cannot be {value!r}: it is {kind} ({text_of_constant(written)} as written)")
    return Decimal(read.ns) if isinstance(read, Duration) else Decimal(repr(read))


def _text(value: Decimal, written: Constant) -> str:
    return text_of(float(value) if written.duration_ns is None else Duration(int(value)))

"""Values of constants: arithmetic, ranges, and new values from callers or the command line."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from fractions import Fraction
from typing import TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.spec.diagnostics import Span, nearest_hint
from spatial_replay.spec.format import format_duration, format_number
from spatial_replay.spec.formula import Constant, NamedNumber
from spatial_replay.spec.parser import MAX_DURATION_NS, StatementError, read_number
from spatial_replay.spec.syntax import Arithmetic, ConstStatement, Duration, Name, NumberSyntax, Quantity

Value: TypeAlias = float | Duration

_DURATION = re.compile(r"-?\d+(\.\d*)?([eE][+-]?\d{1,3})?m?s")
_NUMBER = re.compile(r"-?\d+(\.\d*)?([eE][+-]?\d{1,3})?")
_WORDS = {"+": "added", "-": "subtracted", "*": "multiplied", "/": "divided"}


class _ImpossibleError(Exception):
    """Operands that an operator cannot combine; the message says why."""


def value_of(
    written: Quantity, named: Callable[[Name], Value | None], report: Callable[[Span, str, str], None]
) -> Value | None:
    """Return the value of a quantity; report a fault and return None if it has no value.

    Args:
        named: function from a name to its value; for a name without value, it reports a fault and returns
            None.
        report: function that receives a fault: place, message and hint.
    """
    if isinstance(written, NumberSyntax):
        return written.value
    if isinstance(written, Name):
        return named(written)
    operand_values = [value_of(operand, named, report) for operand in written.operands]
    if any(value is None for value in operand_values):
        return None
    try:
        result = _compute(written, [value for value in operand_values if value is not None])
    except _ImpossibleError as fault:
        report(written.span, str(fault), "durations are added to durations, and multiplied by numbers")
    except (OverflowError, ZeroDivisionError) as fault:
        message = "division by zero" if isinstance(fault, ZeroDivisionError) else "a result that is too large"
        report(written.span, message, "numbers reach up to about 1.7e308, durations up to 9e9s")
    else:
        constants = [
            name for value in operand_values if isinstance(value, NamedNumber) for name in value.constants
        ]
        return NamedNumber(result, tuple(constants)) if constants and isinstance(result, float) else result
    return None


def names_in(written: Quantity) -> Iterator[Name]:
    """Yield the names in a quantity."""
    if isinstance(written, Name):
        yield written
    elif isinstance(written, Arithmetic):
        for operand in written.operands:
            yield from names_in(operand)


def _compute(written: Arithmetic, values: list[Value]) -> Value:
    """Return the result of an operation in exact decimal arithmetic, rounded once: 0.1 * 30 is 3."""
    first_value, *other_values = values
    if not other_values:
        # 0.0 - x, because the negative of 0.0 is -0.0
        return Duration(-first_value.ns) if isinstance(first_value, Duration) else 0.0 - first_value
    duration_flags = [isinstance(value, Duration) for value in values]
    left, right = _exact(first_value), _exact(other_values[0])
    match written.operator:
        case "+" | "-" if duration_flags[0] == duration_flags[1]:
            return _round(left + right if written.operator == "+" else left - right, duration_flags[0])
        case "*" if not all(duration_flags):
            return _round(left * right, any(duration_flags))
        case "/" if duration_flags[0] or not duration_flags[1]:
            return _round(left / right, duration_flags[0] and not duration_flags[1])
    kinds = " and ".join("a duration" if is_duration else "a number" for is_duration in duration_flags)
    raise _ImpossibleError(f"{kinds} cannot be {_WORDS[written.operator]}")


def _exact(value: Value) -> Fraction:
    # repr gives the decimal digits of the text; Fraction(0.1) would be the binary float nearest to 0.1
    return Fraction(value.ns) if isinstance(value, Duration) else Fraction(repr(value))


def _round(result: Fraction, is_duration: bool) -> Value:
    if not is_duration:
        return float(result)
    ns = round(result)
    if abs(ns) > MAX_DURATION_NS:
        raise OverflowError
    return Duration(ns)


# ------------------------------------------------------------------------------------------------ ranges


def constant_of(written: Quantity, value: Value, ends: tuple[Value, Value] | None) -> Constant:
    """Return the entry of `Specification.constants` for a constant; `ends` are the ends of its range."""
    is_computed = any(True for _ in names_in(written))
    span = None if ends is None else (_plain(ends[0]), _plain(ends[1]))
    return Constant(_plain(value), value.ns if isinstance(value, Duration) else None, span, is_computed)


def _plain(value: Value) -> float:
    return value.ns / 1e9 if isinstance(value, Duration) else value


def range_fault(value: Value, ends: tuple[Value, Value]) -> tuple[str, str] | None:
    """Return the message and hint of a faulty range; None if the range contains the value."""
    kinds = {isinstance(number, Duration) for number in (value, *ends)}
    if len(kinds) > 1:
        return "a range from numbers to durations", "write both ends like the constant itself"
    low, high = ends
    text = f"[{text_of(low)}, {text_of(high)}]"
    if _exact(low) > _exact(high):
        return f"the range {text} is empty: its ends are reversed", "the smaller end comes first"
    if not _exact(low) <= _exact(value) <= _exact(high):
        return f"{text_of(value)} is outside of the range {text}", "give a value in it, or widen the range"
    return None


def text_of(value: Value) -> str:
    """Return the text of a value in a specification."""
    return format_duration(value.ns) if isinstance(value, Duration) else format_number(value)


# ------------------------------------------------------------------------------------ from the outside


def replace_constants(
    text: str,
    statements: Mapping[str, ConstStatement],
    values: Mapping[str, Value | None],
    given: Mapping[str, float | str],
) -> str:
    """Return a text with new values in some `const` lines; everything else stays unchanged.

    Args:
        statements: `const` lines of the text by name.
        values: values in the text by name.
        given: new values by name: numbers, or durations as texts.

    Raises:
        UsageError: an unknown constant, an invalid value, a number for a duration or the reverse.
    """
    replacements: list[tuple[Span, str]] = []
    for name, value in given.items():
        if name not in statements:
            hint = nearest_hint(name, statements) or f"its constants are: {', '.join(statements) or 'none'}"
            raise UsageError(f"constants: the specification has no const {name!r}; {hint}")
        replacements.append((statements[name].value.span, _new_text(name, value, values[name])))
    # values are replaced backwards, so that the offsets of earlier lines stay valid
    for span, new_text in sorted(replacements, key=lambda replacement: replacement[0].start, reverse=True):
        text = text[: span.start] + new_text + text[span.end :]
    return text


def _new_text(name: str, value: object, written: Value | None) -> str:
    new_value = value_from_outside(name, value)
    if written is not None and isinstance(new_value, Duration) != isinstance(written, Duration):
        kind, example = (
            ("a duration", "'2s' or '500ms'") if isinstance(written, Duration) else ("a number", "80")
        )
        message = f"constants: {name!r} cannot be {value!r}: it is {kind}, {text_of(written)} in the text"
        raise UsageError(f"{message}; give one, such as {example}")
    return text_of(new_value)


def value_from_outside(name: str, value: object) -> Value:
    """Return the value of a constant that a caller or the command line sets.

    Raises:
        UsageError: the value is not a finite number, and not the text of a number or duration.
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        # float() of an integer above 1.8e308 raises OverflowError
        with suppress(OverflowError):
            if math.isfinite(value):
                return float(value)
    if isinstance(value, str) and (_DURATION.fullmatch(value) or _NUMBER.fullmatch(value)):
        try:
            number = read_number(value.removeprefix("-"), Span(0, 0))
        except StatementError as fault:
            raise UsageError(f"constants: {name!r}: {fault.message}; {fault.hint}") from fault
        if not value.startswith("-"):
            return number
        return Duration(-number.ns) if isinstance(number, Duration) else 0.0 - number
    raise UsageError(
        f"constants: {name!r} cannot be {value!r}; give a finite number, or a duration such as '2s', '500ms'"
    )

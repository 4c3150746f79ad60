"""Values of constants put straight into a formula, so that a candidate needs no parsing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple, TypeAlias

from spatial_replay.spec.formula import Atom, Bound, Formula

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
        fills = [_fill(each, values) for each in zip(*parts, strict=True)]
        return lambda numbers: tuple(fill(numbers) for fill in fills)
    if not is_dataclass(first) or isinstance(first, type):
        raise _NeedsParsingError
    changing = {}
    for name in (field.name for field in fields(first) if field.init and field.compare):
        own = [getattr(part, name) for part in parts]
        if any(each != own[0] for each in own) and not (isinstance(first, Atom) and name == "text"):
            changing[name] = _fill(own, values)
    if isinstance(first, Bound) and "lower" in changing and first.upper is not None:
        raise _NeedsParsingError
    return lambda numbers: replace(first, **{name: fill(numbers) for name, fill in changing.items()})


def _number(parts: Sequence[Any], values: Sequence[Numbers]) -> _Fill:
    kind = type(parts[0])
    if kind is bool or any(type(part) is not kind for part in parts):
        raise _NeedsParsingError
    for name in values[0]:
        for sign in (1, -1):
            if all(part == sign * each[name] for part, each in zip(parts, values, strict=True)):
                return lambda numbers, name=name, sign=sign: kind(sign * numbers[name])  # type: ignore[misc]
    raise _NeedsParsingError

"""What is wrong with the values of settings, in words: all of it at once."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from spatial_replay.errors import UsageError


def refuse_faults(faults: Iterable[str]) -> None:
    """That there are no faults.

    Raises:
        UsageError: with each of them on a line.
    """
    told = "\n".join(faults)
    if told:
        raise UsageError(told)


def is_number(value: object) -> bool:
    """Whether a value is a number but NaN; truth values are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)


def number_faults(values: Mapping[str, Any], least: float = -math.inf) -> list[str]:
    """Values by name, to be finite numbers of at least so much."""
    wanted = "a finite number" if least == -math.inf else f"a finite number of at least {least:g}"
    return [
        f"{name} is {value!r}; give {wanted}"
        for name, value in values.items()
        if not (is_number(value) and math.isfinite(value) and value >= least)
    ]


def point_faults(name: str, value: Any) -> list[str]:
    """A value to be a point (x, y) of finite numbers."""
    if not isinstance(value, tuple) or len(value) != 2:
        return [f"{name} is {value!r}; give (x, y)"]
    return number_faults({f"{name}[{place}]": number for place, number in enumerate(value)})


def count_faults(values: Mapping[str, Any]) -> list[str]:
    """Values by name, to be whole numbers of at least 1."""
    return [
        f"{name} is {value!r}; give a whole number of at least 1"
        for name, value in values.items()
        if not isinstance(value, int) or isinstance(value, bool) or value < 1
    ]


def kind_faults(name: str, value: object, kind: type, wanted: str) -> list[str]:
    """A value to be of a kind."""
    return [] if isinstance(value, kind) else [f"{name} is {value!r}; give {wanted}"]


def member_faults(
    name: str, members: Collection[Any], collection: type, member: type, wanted: str
) -> list[str]:
    """A value to be a collection of members of one kind."""
    return kind_faults(name, members, collection, wanted) or [
        f"{name} has {each!r}; give {wanted}" for each in members if not isinstance(each, member)
    ]

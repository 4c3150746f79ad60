"""How many examples a law, and how many cases a test is tried with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from hypothesis import settings

Case = TypeVar("Case")

ALL = 100
"""Examples that `tools/test --thorough` tries a law with, unless the law names a number."""


def examples(count: int, **others: Any) -> settings:
    """Settings for so many examples in a thorough run, and for the same share of those of another profile."""
    return settings(max_examples=max(count * settings().max_examples // ALL, 5), **others)


def cases(every: Sequence[Case], quick: Sequence[Case]) -> Sequence[Case]:
    """Return every case in a thorough run, and the quick ones otherwise."""
    return every if settings().max_examples >= ALL else quick

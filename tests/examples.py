"""How many examples a law is tried with."""

from __future__ import annotations

from typing import Any

from hypothesis import settings

ALL = 100
"""Examples that `tools/test --thorough` tries a law with, unless the law names a number."""


def examples(count: int, **others: Any) -> settings:
    """Settings for so many examples in a thorough run, and for the same share of those of another profile."""
    return settings(max_examples=max(count * settings().max_examples // ALL, 5), **others)

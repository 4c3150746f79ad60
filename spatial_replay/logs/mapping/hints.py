"""Which known name somebody may have meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_LONGEST = 100
_MOST = 2_000


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """The hint that names the known name most like `name`, or ""."""
    if len(name) > _LONGEST:
        return ""
    candidates = [candidate for candidate in known if len(candidate) <= _LONGEST][:_MOST]
    matches = difflib.get_close_matches(name, candidates, n=1)
    return f"did you mean {matches[0]!r}?" if matches else ""

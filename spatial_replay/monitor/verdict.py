"""Verdicts, online and at the end of a log, and the semantics that they are of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from enum import StrEnum
from reprlib import repr as shortened
from typing import Final, Literal, TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.text import nearest_hint

Semantics: TypeAlias = Literal["ltlf", "paper"]
"""Robustness over finite traces, or the paper's Def. 16 to the letter."""

FAILING_KINDS: Final = ("vacuous", "cut", "unknown", "left", "doubtful")
"""Kinds of results that fail where asked (`fail_on`)."""
ALLOWED_KINDS: Final = ("vacuous", "dropped", "doubtful")
"""Kinds of results that pass where asked (`allow`)."""


def checked_kinds(name: str, kinds: object, known: Sequence[str]) -> frozenset[str]:
    """Return kinds of results as a set.

    Raises:
        UsageError: something else than a sequence of known kinds.
    """
    if isinstance(kinds, str) or not isinstance(kinds, Iterable):
        raise UsageError(f"{name} is {shortened(kinds)}; give a sequence, as in ({known[0]!r},)")
    for kind in kinds:
        if kind not in known:
            hint = nearest_hint(str(kind), known) or f"the kinds are {', '.join(known)}"
            raise UsageError(f"{name}: {shortened(kind)} is not a kind of result; {hint}")
    return frozenset(kinds)


class Verdict(StrEnum):
    """The verdict of a formula.

    At the end of a log it is satisfied, violated or unknown. While samples still come it is satisfied or
    violated if no continuation can change that, and pending otherwise.
    """

    SATISFIED = "satisfied"
    VIOLATED = "violated"
    PENDING = "pending"
    UNKNOWN = "unknown"

    def __bool__(self) -> bool:
        """Refuse: "violated" would be true as every text is.

        Raises:
            UsageError: always.
        """
        raise UsageError(f'a verdict is no truth value; write verdict == "satisfied" (it is {self.value!r})')


def final_verdict(lower: float, upper: float) -> Verdict:
    """Return the verdict of a finished log, from the interval of its value."""
    if lower >= 0.0:
        return Verdict.SATISFIED
    return Verdict.VIOLATED if upper < 0.0 else Verdict.UNKNOWN


def online_verdict(lower: float, upper: float) -> Verdict:
    """Return the verdict while samples still come, from the interval over every continuation.

    Without an interval (NaN: the paper's semantics has no continuations) it is unknown.
    """
    if lower >= 0.0:
        return Verdict.SATISFIED
    if upper < 0.0:
        return Verdict.VIOLATED
    # NaN alone differs from itself
    is_nan = lower != lower
    return Verdict.UNKNOWN if is_nan else Verdict.PENDING


def counts_text(verdicts: Iterable[str]) -> str:
    """Return how many of some verdicts are of each kind, the worst first: "26 violated, 2 satisfied"."""
    counts = Counter(map(str, verdicts))
    return ", ".join(f"{counts[verdict]:,} {verdict}" for verdict in reversed(_BEST_FIRST) if counts[verdict])


_BEST_FIRST: Final = (Verdict.SATISFIED, Verdict.PENDING, Verdict.UNKNOWN, Verdict.VIOLATED)


def worst_verdict(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the worst: violated, unknown, pending, satisfied; satisfied if there are none."""
    return max(verdicts, key=_BEST_FIRST.index, default=Verdict.SATISFIED)


def require_ltlf(semantics: Semantics, what: str) -> None:
    """Check that results have signals, windows and witnesses, which only "ltlf" defines.

    Raises:
        UsageError: other semantics.
    """
    if semantics != "ltlf":
        raise UsageError(f"{what} is not defined under the semantics {semantics!r}; evaluate with 'ltlf'")

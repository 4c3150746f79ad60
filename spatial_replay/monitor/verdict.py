"""Verdicts during a run and at the end of a log, and the names of the semantics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from enum import StrEnum
from reprlib import repr as shortened
from typing import Final, Literal, TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.text import nearest_hint

Semantics: TypeAlias = Literal["ltlf", "paper"]
"""Finite-trace robustness ("ltlf"), or Definition 16 of the paper."""

FAILING_KINDS: Final = ("vacuous", "cut", "unknown", "left", "doubtful")
"""Kinds of results that `fail_on` can turn into failures."""
ALLOWED_KINDS: Final = ("vacuous", "dropped", "doubtful")
"""Kinds of results that `allow` can accept."""


def checked_kinds(name: str, kinds: object, known: Sequence[str]) -> frozenset[str]:
    """Return kinds of results as a set.

    Raises:
        UsageError: `kinds` is not a sequence of known kinds.
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

    At the end of a log, the verdict is satisfied, violated or unknown. During a run, it is pending until
    no continuation can change it.
    """

    SATISFIED = "satisfied"
    VIOLATED = "violated"
    PENDING = "pending"
    UNKNOWN = "unknown"

    def __bool__(self) -> bool:
        """Refuse a truth value, because the text "violated" would be true.

        Raises:
            UsageError: always.
        """
        raise UsageError(f'a verdict has no truth value; write verdict == "satisfied" (it is {self.value!r})')


def final_verdict(lower: float, upper: float) -> Verdict:
    """Return the verdict on a finished log from the interval of the robustness."""
    if lower >= 0.0:
        return Verdict.SATISFIED
    return Verdict.VIOLATED if upper < 0.0 else Verdict.UNKNOWN


def online_verdict(lower: float, upper: float) -> Verdict:
    """Return the verdict during a run from the interval of the robustness over all continuations.

    The verdict is unknown for NaN, because the paper's semantics has no continuations.
    """
    if lower >= 0.0:
        return Verdict.SATISFIED
    if upper < 0.0:
        return Verdict.VIOLATED
    # NaN alone differs from itself
    is_nan = lower != lower
    return Verdict.UNKNOWN if is_nan else Verdict.PENDING


def counts_text(verdicts: Iterable[str]) -> str:
    """Return the number of verdicts of each kind, the worst kind first: "26 violated, 2 satisfied"."""
    counts = Counter(map(str, verdicts))
    return ", ".join(f"{counts[verdict]:,} {verdict}" for verdict in reversed(_BEST_FIRST) if counts[verdict])


_BEST_FIRST: Final = (Verdict.SATISFIED, Verdict.PENDING, Verdict.UNKNOWN, Verdict.VIOLATED)


def worst_verdict(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the worst verdict, in the order violated, unknown, pending, satisfied.

    Without verdicts, the result is satisfied.
    """
    return max(verdicts, key=_BEST_FIRST.index, default=Verdict.SATISFIED)


def require_ltlf(semantics: Semantics, what: str) -> None:
    """Check that the semantics is "ltlf". The paper's semantics defines no signals, windows or witnesses.

    Args:
        what: subject of the error message.

    Raises:
        UsageError: the semantics is "paper".
    """
    if semantics != "ltlf":
        raise UsageError(f"{what} is not defined under the semantics {semantics!r}; evaluate with 'ltlf'")

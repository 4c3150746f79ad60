"""Sentences of events: what a node began to be, what it was before, and its verdict at the end of the log."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from spatial_replay.annotate.verdict_changes import FAILING, HOLDING, SATISFIED, VIOLATED, Period
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.text import time_text, with_unit

_NOW: Final[Mapping[int, str]] = {
    HOLDING: "holds so far",
    FAILING: "is pending",
    SATISFIED: "is satisfied, whatever comes",
    VIOLATED: "is violated, whatever comes",
}


def leaf_words(text: str, number: float, amount: str, *, past: bool = False) -> str:
    """Return a leaf and its number in words, as in "`a closeto[1] b` fails by 3.2".

    Args:
        amount: the number without its sign, in words.
    """
    holds, fails = ("held", "failed") if past else ("holds", "fails")
    how = holds if number >= 0.0 else fails
    if math.isinf(number):
        return f"`{text}` {how}"
    is_residue = amount.split(" ")[0] == "0"
    return f"`{text}` just {how}" if is_residue else f"`{text}` {how} by {amount}"


def change_sentence(title: str, after: Period, witness: str, unit: str = "") -> str:
    """Return a sentence on what has begun.

    Args:
        title: what the node is called.
        witness: the leaf that its number is that of, in words; "" for none.
        unit: the declared one of its number, or "".
    """
    is_short = after.code == FAILING
    because = ""
    if math.isfinite(after.worst):
        number = with_unit(abs(after.worst), unit)
        because = f", {number} short of holding" if is_short else f", by {number}"
    if witness:
        because = f": {witness}"
    return f"{title} {_NOW[after.code]}{because}."


def end_sentence(title: str, verdict: Verdict, ends: tuple[float, float], witness: str, unit: str) -> str:
    """Return a sentence on the verdict over the finished log.

    Args:
        ends: of the interval of its value; NaN where that is not determined.
        unit: their declared one, or "".
    """
    amount, because = "", f": {witness}" if witness else ""
    number = ends[verdict is Verdict.VIOLATED]
    if verdict is Verdict.UNKNOWN:
        low, high = (with_unit(end, unit) for end in ends)
        because = f": robustness {'not determined' if math.isnan(number) else f'between {low} and {high}'}"
    elif not witness and math.isfinite(number):
        amount = f" by {with_unit(abs(number), unit)}"
    return f"{title} is {verdict}{amount}, for the log has ended{because}."


def past_sentence(before: Period, unknown_ns: int, until_ns: int, witness: str, unit: str) -> str:
    """Return a sentence on the period before, until another began.

    Args:
        unknown_ns: from when on nothing was known, if that is before `until_ns`.
    """
    seconds = time_text(min(unknown_ns, until_ns), before.start_ns)
    unknown = f", then unknown for {time_text(until_ns, unknown_ns)}" if unknown_ns < until_ns else ""
    if before.code == FAILING:
        return f"Before, it was pending for {seconds}{unknown}."
    worst = ""
    if witness:
        worst = f"; its worst was that {witness}"
    elif math.isfinite(before.worst):
        worst = f", by {with_unit(abs(before.worst), unit)} or more"
    return f"Before, it held for {seconds}{unknown}{worst}."

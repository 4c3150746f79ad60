"""Changes of a node, and what it is in the end, as sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from spatial_replay.inspection.standings import FAILING, HOLDING, SATISFIED, VIOLATED, Period
from spatial_replay.inspection.words import number_text
from spatial_replay.monitor.verdict import Verdict

_NOW: Final[Mapping[int, str]] = {
    HOLDING: "holds so far",
    FAILING: "fails so far",
    SATISFIED: "is satisfied, whatever comes",
    VIOLATED: "is violated, whatever comes",
}


def leaf_words(text: str, number: float, *, past: bool = False) -> str:
    """A leaf and its number, as in "`a closeto[1] b` fails by 3.2"."""
    if number == 0.0:
        return f"`{text}` just {'held' if past else 'holds'}"
    holds, fails = ("held", "failed") if past else ("holds", "fails")
    return f"`{text}` {holds if number > 0.0 else fails} by {number_text(abs(number))}"


def change_sentence(title: str, after: Period, witness: str) -> str:
    """What has begun.

    Args:
        title: what the node is called.
        witness: the leaf that its number is that of, in words; "" for none.
    """
    because = f", by {number_text(abs(after.worst))}" if math.isfinite(after.worst) else ""
    if witness:
        because = f": {witness}"
    return f"{title} {_NOW[after.code]}{because}."


def end_sentence(title: str, verdict: Verdict, ends: tuple[float, float], witness: str) -> str:
    """What it is over the finished log.

    Args:
        ends: of the interval of its value; NaN where that is not determined.
    """
    amount, because = "", f": {witness}" if witness else ""
    number = ends[verdict is Verdict.VIOLATED]
    if verdict is Verdict.UNKNOWN:
        low, high = map(number_text, ends)
        because = f": robustness {'not determined' if math.isnan(number) else f'between {low} and {high}'}"
    elif not witness and math.isfinite(number):
        amount = f" by {number_text(abs(number))}"
    return f"{title} is {verdict}{amount}, for the log has ended{because}."


def past_sentence(before: Period, until_ns: int, witness: str) -> str:
    """What was before, until something else began."""
    did = "held" if before.code == HOLDING else "failed"
    seconds = f"{(until_ns - before.start_ns) / 1e9:.3f} s"
    worst = ""
    if witness:
        worst = f"; its worst was that {witness}"
    elif math.isfinite(before.worst):
        number = number_text(abs(before.worst))
        worst = f", by {number} or more" if before.code == HOLDING else f", by up to {number}"
    return f"Before, it {did} for {seconds}{worst}."

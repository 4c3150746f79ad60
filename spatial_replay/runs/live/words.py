"""What an evaluation comes to, in a line."""

from __future__ import annotations

import math

from spatial_replay.monitor.verdict import Verdict
from spatial_replay.replay.found import ReplayedSpec
from spatial_replay.replay.tuning import Tuned, constant_text
from spatial_replay.runs.live.outlet import Level, Note

VERDICT = "verdict"
CONSTANTS = "constants"
LOG = "log"
"""What notes are about."""

_MOST = 5
"""Results, and constants, that a line names."""


def verdict_note(tuned: Tuned) -> Note:
    """The verdict of each result, the worst first, and the constants that are not as they are written."""
    order = (Verdict.VIOLATED, Verdict.UNKNOWN, Verdict.SATISFIED)
    results = sorted(tuned.replayed.results, key=lambda result: order.index(result.verdict))
    text = "; ".join(map(_result, results[:_MOST])) or "no object was there for a template to stand for"
    if len(results) > _MOST:
        text += f"; and {len(results) - _MOST} more, none worse"
    level = Level.INFO if tuned.verdict is Verdict.SATISFIED else Level.WARNING
    return Note(VERDICT, level, text + _changes(tuned))


def _result(result: ReplayedSpec) -> str:
    title = result.name if result.object is None else f"{result.name}({result.object})"
    robustness = float(result.robustness[0])
    number = "not determined" if math.isnan(robustness) else f"{robustness:.6g}"
    return f"`{title}` is {result.verdict}: robustness {number}"


def _changes(tuned: Tuned) -> str:
    written = tuned.tuning.constants
    changed = [
        f"{name} = {constant_text(constant)}"
        for name, constant in tuned.constants.items()
        if constant != written[name]
    ]
    more = ", …" if len(changed) > _MOST else ""
    return f" ({', '.join(changed[:_MOST])}{more})" if changed else ""

"""Tuning: the constants with which good runs satisfy a specification and bad ones do not.

`varied` is a constant with the values to try, `direction` says which way they loosen the specification,
`substitution` puts values into formulas, `margins` says how far each run is from the other verdict, `search`
finds the values, `exact` several of them at once, both with `number_search`; `tuned` says what was found.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.tuning.margins import LabelledRun, load_runs
    from spatial_replay.tuning.tuned import Conflict, RunMargin, Surface, TunedConstant, Tuning, tune_runs

__all__ = [
    "Conflict",
    "LabelledRun",
    "RunMargin",
    "Surface",
    "TunedConstant",
    "Tuning",
    "load_runs",
    "tune_runs",
]

__getattr__, __dir__ = loaded_when_used(globals())
